"""A log density along the line on which a scale and what it scales move in proportion, as an expression."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from bayesmc import distributions as d
from bayesmc.errors import UnsupportedError
from bayesmc.expression import Expression, Family, broadcast, elementwise, leaf, reduction
from bayesmc.expression.graph import substituted
from bayesmc.network.expressions import stored_leaf
from bayesmc.passes.alike import sums_of
from bayesmc.passes.arithmetic import add
from bayesmc.structure.free_terms import elements_of, known_values
from bayesmc.structure.programs import family_read
from bayesmc.structure.target import Target

#: the leaf of how far they move, on a log scale
STEP = "\0step"
#: families whose location is their mean
_CENTRED = (d.Normal, d.Laplace, d.MvNormal)


class Orbit:
    """What ``kernels.rescaled`` asks for, of stored values and of where deviations are counted from.

    Parameters
    ----------
    target : Target
    name : str
        The scale.
    below : sequence of str
        What it scales.
    power : int
    close : float
        How close centres must stay, relative to themselves.

    Attributes
    ----------
    root : Expression
        The log density of the leaf ``STEP``, with the change of volume.
    centres : dict
        Leaf of a centre -> the centre, of stored values.

    Raises
    ------
    UnsupportedError
        A term cannot be followed, or has no centre that can.
    """

    def __init__(
        self, target: Target, name: str, below: Sequence[str], power: int, close: float
    ) -> None:
        model = target.model
        step = leaf(STEP, ())
        scale = stored_leaf(model, model[name])
        moved = {name: _times(scale, elementwise(np.exp, _times(step, float(power))))}
        factor, self.centres = elementwise(np.exp, step), dict[str, Expression]()
        for other in below:
            now = stored_leaf(model, model[other])
            key = centre_key(other)
            self.centres[key] = _centre(target, other)
            centre = leaf(key, now.shape)
            away = elementwise(np.subtract, now, centre)
            moved[other] = add(centre, broadcast(_times(away, factor), now.shape))
        terms = target.terms_of((name, *below))
        logs = [log.anywhere for log in elements_of(target, terms, moved)]
        numbers = sum(math.prod(model[n].value_shape) for n in below)
        total = _times(step, float(power + numbers))
        for part in sums_of(logs):
            total = add(total, part)
        for key, own in self.centres.items():
            total = _where_it_stays(total, leaf(key, own.shape), own, moved, close)
        high = float(np.asarray(model[name].support.high))  # type: ignore[union-attr]
        inside = elementwise(np.less, moved[name], high)
        self.root = elementwise(np.where, inside, total, -np.inf)
        read = {p for t in terms for p in model.above(t.scope, lambda _: True)}
        self.known = [(n, target.known[n]) for n in sorted(read) if n in target.known]


def centre_key(name: str) -> str:
    """The leaf of a node's centre."""
    return f"\0centre of {name}"


# ---- private ------------------------------------------------------------------------------------


def _times(a: Expression, b: Expression | float) -> Expression:
    return elementwise(np.multiply, a, b)


def _centre(target: Target, name: str) -> Expression:
    """The mean that a node's density has, shape of its values."""
    term = target.terms[name]
    family = family_read(term) if term.expression is not None else None
    if not isinstance(family, Family) or family.make not in _CENTRED:
        raise UnsupportedError(f"the centre of node {name!r} is no location that can be followed")
    loc = family.parameters["loc"]
    if not isinstance(loc, Expression):
        raise UnsupportedError(f"the location of node {name!r} is no expression")
    loc = substituted(loc, known_values(target, [loc]))
    return broadcast(loc, target.model[name].value_shape)


def _where_it_stays(
    total: Expression,
    before: Expression,
    centre: Expression,
    moved: dict[str, Expression],
    close: float,
) -> Expression:
    """Minus infinity where deviations would be counted from elsewhere: there is no way back."""
    if not centre.leaves & moved.keys():
        return total
    after = substituted(centre, moved)
    off = elementwise(np.absolute, elementwise(np.subtract, after, before))
    near = elementwise(np.less_equal, off, _times(elementwise(np.absolute, before), close))
    if near.shape:
        near = reduction(np.logical_and, near, range(len(near.shape)))
    return elementwise(np.where, near, total, -np.inf)
