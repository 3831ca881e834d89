"""Which components of a vector each part of a joint takes: independent distributions side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from bayesmc import distributions as d
from bayesmc.errors import TraceError
from bayesmc.expression import Expression, Family

#: families of vectors, whose size is that of a parameter
VECTORS = frozenset((d.MvNormal, d.Dirichlet, d.Multinomial, d.Ordered))


def is_joint(family: Family) -> bool:
    """Whether a family is its parts side by side and nothing else, and its arguments are these, in order.

    A class says so of itself (``parts_as_given``); one that extends it may do anything.
    """
    return bool(getattr(family.make, "parts_as_given", False)) and "parts_as_given" in vars(
        family.make
    )


def places(
    family: Family, as_family: Callable[[Any], Family]
) -> Iterator[tuple[Family, int | slice]]:
    """The parts, those of parts that are joints themselves in their place, and the components of each.

    Parameters
    ----------
    family : Family
    as_family : callable
        Makes a family of what stands among the arguments.

    Raises
    ------
    TraceError
        It is not told how many components a part takes.
    """
    at = 0
    for part in _side_by_side(family, as_family):
        size = _size(part, as_family)
        yield part, slice(at, at + size) if size else at
        at += max(size, 1)


# ---- private ------------------------------------------------------------------------------------


def _side_by_side(family: Family, as_family: Callable[[Any], Family]) -> Iterator[Family]:
    if not is_joint(family):
        yield family
        return
    parts = list(family.parameters.get("parts", family.parameters.values()))
    for part in parts[0] if isinstance(parts[0], (list, tuple)) else parts:
        yield from _side_by_side(as_family(part), as_family)


def _size(part: Family, as_family: Callable[[Any], Family]) -> int:
    """Components of a vector; 0 of a number."""
    if part.make is d.Ordered:
        return int(np.asarray(getattr(part.parameters["size"], "value", part.parameters["size"])))
    if part.make in VECTORS:
        known = [v for v in part.parameters.values() if isinstance(v, Expression) and v.shape]
        if known:
            return known[0].shape[-1]
    within = [
        v
        for value in part.parameters.values()
        for v in (value if isinstance(value, (list, tuple)) else [value])
        if isinstance(v, (Family, d.Distribution))
    ]
    inner = [as_family(v) for v in within]
    if part.make in VECTORS or any(is_joint(i) or _size(i, as_family) for i in inner):
        name = getattr(part.make, "__name__", str(part.make))
        raise TraceError(
            f"no closed log density of a joint with a {name} of vectors is known to derivatives"
        )
    return 0
