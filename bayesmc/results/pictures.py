"""``posterior.plot``: pictures by name. What draws them stands above, and is handed in by the package."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, ClassVar


class Pictures:
    """Pictures of one answer: ``posterior.plot.trace("x")`` is ``plotting.plot_trace(posterior, "x")``.

    Raises
    ------
    AttributeError
        There is no such picture; the message has those there are.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet()
    >>> net.add("x", bmc.Normal(0.0, 1.0))
    >>> bmc.infer(net).plot
    <pictures of ExactPosterior: ancestry, bands, dag, energy, ... trace, weights>
    """

    #: hands out all of them, by name
    known: ClassVar[Callable[[], Mapping[str, Callable[..., Any]]]] = dict

    def __init__(self, answer: Any) -> None:
        self._answer = answer

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name.startswith("__"):
            raise AttributeError(name)
        every = type(self).known()
        if name not in every:
            raise AttributeError(
                f"there is no picture {name!r}; there are {', '.join(sorted(every))}",
                name=name,
                obj=self,
            )
        return partial(every[name], self._answer)

    def __dir__(self) -> list[str]:
        return sorted(type(self).known())

    def __repr__(self) -> str:
        return f"<pictures of {type(self._answer).__name__}: {', '.join(dir(self))}>"
