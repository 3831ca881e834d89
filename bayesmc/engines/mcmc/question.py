"""Whether two posed problems are the same question, so that the draws of one may be gone on with.

The same net may have been declared anew: then functions are compared by what they say, and where that cannot
be told, by the densities that they give at some draws. What functions read from their module may have another
value by now: what it was is known from their declarations, and densities from when the draws were made.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from bayesmc.network import Observed, Problem
from bayesmc.network.captured import redeclared
from bayesmc.network.sameness import same
from bayesmc.results.chains import noted_densities, other_density, outline


def difference(
    was: Problem,
    now: Problem,
    values: Mapping[str, np.ndarray] | None = None,
    densities: Mapping[str, float] | None = None,
) -> str | None:
    """What differs between two questions, in words; None where they are the same.

    Parameters
    ----------
    was, now : Problem
    values : dict, optional
        Stored values of all nodes at some draws, at which densities are compared.
    densities : dict, optional
        ``log_densities`` of ``was`` at these values when the draws were made.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.engines.mcmc.question import difference
    >>> from bayesmc.network import pose
    >>> def asked(scale):
    ...     net = bmc.BayesNet()
    ...     net.add("x", lambda: bmc.Normal(0.0, scale))
    ...     return pose(net, {})
    >>> print(difference(asked(1.0), asked(1.0)))
    None
    >>> difference(asked(1.0), asked(2.0))
    "the function of node 'x' reads 'scale', which was 1.0 then and is 2.0 now"
    """
    for found in (
        _nodes(was, now),
        _data(was.observed, now.observed),
        _inputs(was, now),
        _around(was, now),
    ):
        for words in found:
            return words
    unknown: str | None = None
    for words, known in _functions(was, now):
        if known is False:
            return f"{words} is another one"
        unknown = unknown or (None if known else words)
    if unknown is None and (values is None or densities is None):
        return None
    if values is not None and densities is None:
        densities = noted_densities(was, values)
    if values is None or densities is None:
        return f"{unknown} was declared anew, and whether it is the same cannot be told"
    other = other_density(now, values, densities)
    return None if other is None else f"{other!r} has another density"


# ---- private ------------------------------------------------------------------------------------


def _nodes(was: Problem, now: Problem) -> Iterator[str]:
    old, new = was.model, now.model
    if list(old.nodes) != list(new.nodes):
        apart = [n for n in (*old.nodes, *new.nodes) if (n in old.nodes) != (n in new.nodes)]
        if apart:
            yield f"only one of the two nets has a node {apart[0]!r}"
        else:
            yield "nodes have other parents, or stand in another order"
        return
    for plate, size in old.sizes.items():
        if new.sizes.get(plate) != size:
            yield f"plate {plate!r} has size {new.sizes.get(plate)}, not {size}"
    if old.sizes.keys() != new.sizes.keys():
        yield "the plates have other names"
    for name, node in new.nodes.items():
        parts = zip(
            ("kind", "parents", "plates", "shape", "states", "table", "value"),
            outline(old[name]), outline(node), strict=True,
        )  # fmt: skip
        for what, a, b in parts:
            if a != b:
                other = "other parents" if what == "parents" else f"another {what}"
                yield f"node {name!r} has {other}"
    if list(old.potentials) != list(new.potentials):
        yield "the potentials have other names"


def _around(was: Problem, now: Problem) -> Iterator[str]:
    """Names read from around functions of both that stood for other values when these were declared."""
    for name, node in now.model.nodes.items():
        a, b = was.model[name].declaration, node.declaration
        words = None if a is b else redeclared(a.captured, b.captured)
        if words:
            yield f"the function of node {name!r} reads {words}"
    for name, (new, _) in now.model.potentials.items():
        words = redeclared(was.model.potentials[name][0].captured, new.captured)
        if words:
            yield f"the potential {name!r} reads {words}"


def _functions(was: Problem, now: Problem) -> Iterator[tuple[str, bool | None]]:
    """Every function of both, in words, and whether it is the same."""
    for name, node in now.model.nodes.items():
        a, b = was.model[name].declaration, node.declaration
        if a is not b:
            yield f"the function of node {name!r}", same(a.function, b.function)
    for name, (new, _) in now.model.potentials.items():
        old = was.model.potentials[name][0]
        if old is not new:
            fields = ("parents", "plates", "index", "is_table", "function")
            one, other = ([getattr(p, f) for f in fields] for p in (old, new))
            yield f"the potential {name!r}", same(one, other)


def _data(was: Mapping[str, Observed], now: Mapping[str, Observed]) -> Iterator[str]:
    for name in [*was, *now]:
        if (name in was) != (name in now):
            yield f"{name!r} is observed in one of the two only"
        else:
            a, b = was[name], now[name]
            masks = _same_mask(a.mask, b.mask) and _same_mask(a.parts, b.parts)
            if not (np.array_equal(a.value, b.value) and masks):
                yield f"the evidence of {name!r} is another one"


def _inputs(was: Problem, now: Problem) -> Iterator[str]:
    for name in was.inputs:
        if not np.array_equal(was.inputs[name], now.inputs[name]):
            yield f"input {name!r} has another value"


def _same_mask(a: np.ndarray | None, b: np.ndarray | None) -> bool:
    return a is b if a is None or b is None else np.array_equal(a, b)
