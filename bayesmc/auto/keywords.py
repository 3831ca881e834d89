"""Arguments that are given by keyword, told where they are given by position."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

_Call = TypeVar("_Call", bound=Callable[..., Any])


def by_keyword(call: _Call) -> _Call:
    """A call that says what to write where an argument that goes by keyword comes by position.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> bmc.infer(bmc.BayesNet(), {}, {"x": 1.0})
    Traceback (most recent call last):
        ...
    TypeError: infer takes what follows evidence by keyword; write infer(net, evidence, inputs=...)
    """
    parameters = inspect.signature(call).parameters.values()
    leading = [p.name for p in parameters if p.kind is p.POSITIONAL_OR_KEYWORD]
    named = [p.name for p in parameters if p.kind is p.KEYWORD_ONLY]

    @functools.wraps(call)
    def checked(*args: Any, **options: Any) -> Any:
        if len(args) > len(leading):
            meant = _meant(args[len(leading)], named)
            raise TypeError(
                f"{call.__name__} takes what follows {leading[-1]} by keyword; write "
                f"{call.__name__}({', '.join([*leading, f'{meant}=...'])})"
            )
        return call(*args, **options)

    return checked  # type: ignore[return-value]


# ---- private ------------------------------------------------------------------------------------


def _meant(value: Any, named: list[str]) -> str:
    """The keyword that a value looks like."""
    looks = "rng" if isinstance(value, int) else "engine"
    if isinstance(value, Mapping) or hasattr(value, "columns"):
        looks = "inputs"
    return looks if looks in named else named[0]
