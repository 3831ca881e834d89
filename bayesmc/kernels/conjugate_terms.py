"""What a prior and the terms of children are, as features of a node: expressions of the state of a chain.

A prior has a base, whose features or parameters it brings, and ends that truncate it. Values that are known
are constants here, so that what does not change from sweep to sweep is worked out once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bayesmc.distributions import (
    Beta,
    Dirichlet,
    Distribution,
    Exponential,
    Gamma,
    InverseGamma,
    InverseWishart,
    LogNormal,
    Normal,
    Truncated,
    Uniform,
    Weibull,
    Wishart,
)
from bayesmc.errors import TraceError
from bayesmc.expression import (
    Constant,
    Elementwise,
    Expression,
    Family,
    Program,
    Reduction,
    TracedArray,
    as_expression,
    broadcast,
    elementwise,
    ordered,
    pick,
    replaced,
    reshape,
)
from bayesmc.kernels.conjugate_families import Conditional
from bayesmc.network.expressions import Opaque, stored_leaf
from bayesmc.passes.arithmetic import ONE, ZERO, add, is_all, multiply, tidied
from bayesmc.passes.branches import branches_up
from bayesmc.passes.features import Feature, statistics
from bayesmc.passes.log_density import family_of, has_own_form, log_density
from bayesmc.passes.reads import element_read, reads, same_along, sunk
from bayesmc.passes.totals import parts_of, total
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.relation import with_known


@dataclass(frozen=True, eq=False)
class Moving:
    """The elements of a node that move together, all others given.

    Attributes
    ----------
    numbers : ndarray of int, shape of the node's value
        The element that each number belongs to; -1 for those that do not move.
    count : int
        Elements of the node, or of its numbers where these are elements.
    """

    blanket: Blanket
    numbers: np.ndarray
    count: int

    @property
    def name(self) -> str:
        return self.blanket.name


@dataclass(frozen=True, eq=False)
class Added:
    """Coefficients of features, summed for every element.

    Attributes
    ----------
    coefficients : dict
        Feature -> expression of shape ``(count,)``.
    is_picked : bool
        Whether it hangs on other nodes which entries read an element.
    """

    coefficients: Mapping[Feature, Expression] = field(default_factory=dict)
    is_picked: bool = False


def moving(blanket: Blanket, members: np.ndarray | None, by_number: bool = False) -> Moving:
    """The elements of a class of a node; with ``by_number``, their numbers one by one."""
    elements = np.arange(blanket.size)
    if len(blanket.classes) > 1 and members is not None:
        elements = np.full(blanket.size, -1)
        elements[members] = members
    event = int(np.prod(blanket.event_shape, dtype=int))
    if by_number:
        inner = elements[:, None] * event + np.arange(event)
        numbers = np.where(elements[:, None] < 0, -1, inner)
        return Moving(blanket, numbers.reshape(blanket.node.value_shape), blanket.size * event)
    numbers = np.repeat(elements, event).reshape(blanket.node.value_shape)
    return Moving(blanket, numbers, blanket.size)


def features_of(
    expression: Expression,
    of: Moving,
    mask: Any = None,
    strict: bool = False,
    is_share: bool = True,
) -> Added:
    """The features of a log density, summed over all entries for every element.

    Parameters
    ----------
    strict : bool
        Whether every entry must have them for all values of other nodes.
    is_share : bool
        Whether the node is between 0 and 1.

    Raises
    ------
    TraceError
        It is no sum of features.
    """
    found: dict[Feature, Expression] = {}
    picked = False
    for part in parts_of(sunk(tidied(expression), of.name), of.name, mask):
        some = statistics(part.expression, of.name, of.numbers, strict, is_share)
        picked = picked or some.is_picked or part.is_picked
        for feature, coefficient in some.coefficients.items():
            whole = multiply(coefficient, broadcast(part.factor, coefficient.shape))
            sums = total(whole, some.at, of.count, part.mask)
            found[feature] = add(found.get(feature, ZERO), sums)
    return Added(found, picked)


def refuse_moving_support(expression: Expression, name: str) -> None:
    """Raise where what is possible under a density depends on a node: its features alone say less.

    Raises
    ------
    TraceError
    """
    for node in ordered(expression):
        if isinstance(node, Elementwise) and node.function is np.where:
            condition, _, impossible = node.operands
            if name in condition.leaves and is_all(impossible, -np.inf):
                raise TraceError("what is possible under it depends on the node")


def shares_sum_to_one(expression: Expression, blanket: Blanket) -> Expression:
    """An expression in which the sum of all of a node's shares is 1."""
    size = blanket.event_shape[-1]
    name = blanket.name
    flat = np.arange(blanket.size * size).reshape(blanket.node.value_shape)
    whole = sunk(branches_up(sunk(tidied(expression), name), name), name)
    instead: dict[Expression, Expression] = {}
    pure = set(reads(whole, name))
    for node in ordered(whole):
        if isinstance(node, Reduction) and node.ufunc is np.add and node.operands[0] in pure:
            (axis, *more), operand = node.axes, node.operands[0]
            rows = element_read(operand, name, flat // size)
            places = element_read(operand, name, flat % size)
            if more or same_along(rows, [axis]) is None or not isinstance(places, Constant):
                continue
            every = np.sort(np.moveaxis(places.value, axis, -1), axis=-1)
            if every.shape[-1] == size and (every == np.arange(size)).all():
                instead[node] = broadcast(ONE, node.shape)
    return replaced(whole, instead) if instead else whole


@dataclass(frozen=True, eq=False)
class Prior:
    """A prior without its bounds.

    Attributes
    ----------
    low, high : Expression
    is_bounded : bool
        Whether they cut off some of the base.
    support : tuple of float
        Of the base.
    """

    base: Family
    words: str
    low: Expression
    high: Expression
    is_bounded: bool
    support: tuple[float, float]

    def ends(self, blanket: Blanket) -> tuple[float, float]:
        """The least and the largest value that it allows, as far as this is seen."""
        states = blanket.target.states
        if states is None:
            return self.support
        low, high = Program([self.low, self.high])(states)
        least, most = self.support
        return max(float(np.min(low)), least), min(float(np.max(high)), most)


def prior_of(blanket: Blanket) -> Prior:
    """The prior of a node.

    Raises
    ------
    TraceError
        It cannot be followed, or has no conjugate pair.
    """
    assert blanket.own is not None
    read = blanket.own.read
    if isinstance(read, Opaque):
        raise TraceError(f"its prior cannot be followed ({read.reason})")
    family = _as_family(read.result)
    low: Any = as_expression(-np.inf)
    high: Any = as_expression(np.inf)
    words, bounded = getattr(family.make, "__name__", str(family.make)), False
    if family.make is Truncated and isinstance(family.parameters["base"], Family | Distribution):
        low, high = (_known(blanket, family.parameters[k]) for k in ("low", "high"))
        family = _as_family(family.parameters["base"])
        words, bounded = f"truncated {family.make.__name__}", True
    if family.make is Uniform:
        ends = [_known(blanket, family.parameters[k]) for k in ("low", "high")]
        low, high = elementwise(np.maximum, low, ends[0]), elementwise(np.minimum, high, ends[1])
        words, bounded = "Uniform", True
    support = _SUPPORTS.get(family.make)
    if support is None:
        support = -np.inf, np.inf
        if not blanket.event_shape:  # of numbers, what the distribution itself says
            low, high = _own_bounds(blanket, low, high)
            bounded = bounded or not (_is(low, -np.inf) and _is(high, np.inf))
    return Prior(family, words, low, high, bounded, support)


def own_features(blanket: Blanket, prior: Prior, of: Moving) -> dict[Feature, Expression]:
    """Features of the prior itself."""
    if prior.base.make is Uniform:
        return {}
    if has_own_form(prior.base) and blanket.own is not None and blanket.own.expression is None:
        raise TraceError("its form gives other values than its log_prob")
    model = blanket.target.model
    density = log_density(prior.base, stored_leaf(model, model[blanket.name]))
    density = broadcast(_known(blanket, density), blanket.node.plate_shape)
    return dict(features_of(density, of, None, True).coefficients)


def naturals_of(blanket: Blanket, base: Family) -> list[Expression]:
    """Natural parameters of the prior, one block for each element."""
    count = blanket.size
    parameters: dict[str, Any] = {
        k: _by_element(_known(blanket, v), blanket, 2 if k in ("cov", "scale", "scale_tril") else 1)
        for k, v in base.parameters.items()
        if isinstance(v, Expression) and k != "df"
    }
    if base.make is Dirichlet:
        return [add(parameters["concentration"].expression, -1.0)]
    if base.make in _MATRICES:
        df = broadcast(_known(blanket, base.parameters["df"]), blanket.node.plate_shape)
        scale = parameters["scale"]
        if base.make is Wishart:
            scale = _inverse(np.linalg.cholesky(scale))
        return [reshape(df, (count,)), as_expression(scale)]
    if "scale_diag" in parameters:
        d = blanket.event_shape[-1]
        precision = parameters["scale_diag"][..., None] ** -2.0 * np.eye(d)
    else:
        factor = parameters.get("scale_tril")
        factor = np.linalg.cholesky(parameters["cov"]) if factor is None else factor
        precision = _inverse(factor)
    linear = np.matvec(precision, parameters["loc"])
    return [
        a.expression if isinstance(a, TracedArray) else as_expression(a)
        for a in (precision, linear)
    ]


def bounds_of(
    blanket: Blanket, members: np.ndarray | None, prior: Prior, family: Conditional
) -> list[Expression]:
    """The ends of the support, where they cut off some of the family's."""
    low, high = prior.low, prior.high
    least, most = prior.support
    if not prior.is_bounded and least <= family.low and most >= family.high:
        return []
    low, high = elementwise(np.maximum, low, least), elementwise(np.minimum, high, most)
    shape, size = blanket.node.plate_shape, blanket.size
    ends = [reshape(broadcast(e, shape), (size,)) for e in (low, high)]
    return [of_members(e, blanket, members) for e in ends]


def of_members(natural: Expression, blanket: Blanket, members: np.ndarray | None) -> Expression:
    """Of all elements as the node's plates, or of those of a class."""
    shape = blanket.node.plate_shape
    block = natural.shape[1:]
    if natural.shape[0] != blanket.size:  # number by number
        block = blanket.event_shape
        natural = reshape(natural, (blanket.size, *block))
    if members is None:
        return reshape(natural, (*shape, *block))
    at = np.arange(natural.size).reshape(natural.shape)
    return pick([natural], at[members])


# ---- private ------------------------------------------------------------------------------------


_MATRICES = (InverseWishart, Wishart)
#: supports of families that any parameters leave as they are; Uniform's ends stand apart
_SUPPORTS: dict[Any, tuple[float, float]] = {
    Normal: (-np.inf, np.inf),
    Uniform: (-np.inf, np.inf),
    Beta: (0.0, 1.0),
    **dict.fromkeys((Gamma, InverseGamma, Exponential, LogNormal, Weibull), (0.0, np.inf)),
}


def _own_bounds(
    blanket: Blanket, low: Expression, high: Expression
) -> tuple[Expression, Expression]:
    """Bounds that a family's support adds, the same for all parents."""
    support = blanket.node.support
    if support is None or support.kind not in ("real", "interval"):
        raise TraceError(
            "its support is no interval that stays the same, so that it has no conjugate pair"
        )
    return elementwise(np.maximum, low, support.low), elementwise(np.minimum, high, support.high)


def _is(bound: Expression, value: float) -> bool:
    return isinstance(bound, Constant) and bool((bound.value == value).all())


def _as_family(result: Any) -> Family:
    if isinstance(result, Family):
        return result
    if isinstance(result, _MATRICES):
        kept = {k: as_expression(getattr(result, k)) for k in ("df", "scale")}
        return Family(type(result), kept)
    try:
        return family_of(result)
    except TraceError:
        raise TraceError(f"the prior, {type(result).__name__}, has no conjugate pair") from None


def _inverse(factor: Any) -> Any:
    """The inverse of ``factor @ factor.T``."""
    inverse = np.linalg.inv(factor)
    return np.matmul(np.matrix_transpose(inverse), inverse)


def _known(blanket: Blanket, value: Any) -> Expression:
    return with_known(blanket.target, as_expression(value))


def _by_element(value: Expression, blanket: Blanket, event_ndim: int) -> Any:
    """A parameter for each element: ``(count, *event)``."""
    d = blanket.event_shape[-1]
    event = (d,) * event_ndim
    whole = broadcast(value, (*blanket.node.plate_shape, *event))
    return TracedArray(reshape(whole, (blanket.size, *event)))
