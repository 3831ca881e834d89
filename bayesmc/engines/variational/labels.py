"""What the elements of a plate say by one label alone: products of statistics with coefficients by label."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions import LogNormal, MvNormal, Normal
from bayesmc.engines.variational.factors import IMPOSSIBLE
from bayesmc.expression import (
    Constant,
    Expression,
    Family,
    Leaf,
    as_expression,
    broadcast,
    elementwise,
    expressions_of,
    leaf,
    mapped,
    ordered,
    pick,
    reduction,
    reshape,
)
from bayesmc.expression.graph import substituted
from bayesmc.kernels.label_sums import label_sums
from bayesmc.passes.arithmetic import add, multiply, subtract, tidied
from bayesmc.passes.expectation import Expectation
from bayesmc.passes.expected_density import plain_density, quadratic_moments
from bayesmc.structure.free_terms import known_values
from bayesmc.structure.target import Target, Term

#: axes of one value of each parameter
_NDIM: dict[Any, Mapping[str, int]] = {
    Normal: {"loc": 0, "scale": 0},
    LogNormal: {"loc": 0, "scale": 0},
    MvNormal: {"loc": 1, "cov": 2, "scale_tril": 2, "scale_diag": 1},
}


@dataclass(frozen=True, eq=False)
class LabelTerm:
    """What elements of a plate say by a label, ``sum_j statistics[j, n] * coefficients[label_n, j]``.

    Attributes
    ----------
    label : str
    statistics : ndarray, shape (rows, elements)
    coefficients : Expression, shape (states, rows)
        Of moments.
    sums : Leaf, shape (states, rows)
        Expected sums of the statistics by label.
    """

    label: str
    statistics: np.ndarray
    coefficients: Expression
    sums: Leaf

    @property
    def total(self) -> Expression:
        return reduction(np.add, multiply(self.sums, self.coefficients), (0, 1))


def possible(log: Expression) -> Expression:
    """A log factor that is finite, so that products with a probability of 0 are 0."""
    for node in _constants(log):
        if (node.value == -np.inf).any():
            return elementwise(np.maximum, log, IMPOSSIBLE)
    return log


def by_label(
    target: Target,
    of: Expectation,
    term: Term,
    family: Family,
    value: Expression,
    label: str,
    above: Mapping[str, Expression],
) -> LabelTerm | None:
    """The expectation of a term by the only finite node that it reads.

    Parameters
    ----------
    of : Expectation
    family : Family
        The term's, of what is hidden.
    value : Expression
        That of its node.
    above : mapping
        Node -> its value, of those that are values and have no moments.

    Returns
    -------
    LabelTerm or None
        None where the label is not all that tells the elements of the plate apart, or the family is no normal
        one; a label's own probabilities may be of any family.
    """
    node = target.model[label]
    if term.shape != node.plate_shape or not node.plate_shape or term.mask is not None:
        return None
    domain = node.domain
    assert domain is not None
    states = domain.size
    if term.name == label:
        return _prior(target, of, term, family, states)
    if family.make not in (Normal, LogNormal, MvNormal) or not isinstance(value, Constant):
        return None
    found = _at_labels(target, term, label, states, above)
    if found is None:
        return None
    return _normal(of, term, found, value.value, label, states)


# ---- private ------------------------------------------------------------------------------------


def _constants(root: Expression) -> Iterator[Constant]:
    for node in ordered(root):
        if isinstance(node, Constant) and node.dtype.kind == "f":
            yield node


def _normal(
    of: Expectation, term: Term, family: Family, value: np.ndarray, label: str, states: int
) -> LabelTerm:
    """Coefficients of ``1, y_i, y_i y_j``, of values about their mean, so that nothing cancels."""
    is_vector = family.make is MvNormal
    y = np.log(value) if family.make is LogNormal else value
    y = y.reshape(-1, y.shape[-1] if is_vector else 1)
    centre = y.mean(axis=0)
    off, d = y - centre, y.shape[1]
    loc = family.parameters["loc"]
    loc = subtract(loc if is_vector else reshape(loc, (*loc.shape, 1)), centre)
    precision, b, form, logs = quadratic_moments(of, loc, family.parameters, is_vector)
    first = multiply(0.5, subtract(subtract(logs, form), d * math.log(2 * math.pi)))
    if family.make is LogNormal:
        first = add(first, -float(y.mean()))
    b, precision = broadcast(b, (states, d)), broadcast(precision, (states, d, d))
    k = np.arange(states)
    parts = [broadcast(first, (states,)), *(pick([b], k * d + i) for i in range(d))]
    rows = [np.ones(len(off)), *off.T]
    for i, j in np.transpose(np.tril_indices(d)).tolist():
        entry = pick([precision], k * d * d + i * d + j)
        parts.append(multiply(-0.5 if i == j else -1.0, entry))
        rows.append(off[:, i] * off[:, j])
    at = np.arange(states * len(parts)).reshape(len(parts), states).T
    return _label_term(term, label, np.array(rows), pick(parts, at))


def _at_labels(
    target: Target, term: Term, label: str, states: int, above: Mapping[str, Expression]
) -> Family | None:
    """A term's family at every label, parameters ``(states, *event)`` or one for all."""
    found = label_sums(target, term, label)
    if found is None or found.repeats > 1:
        return None
    family = found.family
    parts = [*expressions_of(family)]
    given = {**known_values(target, parts), **above}
    family = mapped(family, lambda e: substituted(e, given))
    made: dict[str, Any] = {}
    for name, value in family.parameters.items():
        made[name] = value
        if value is not None:
            inner = value.shape[len(value.shape) - _NDIM[family.make][name] :]
            count = value.size // math.prod(inner)
            if count not in (1, states):
                return None
            made[name] = reshape(value, (count, *inner))
    return Family(family.make, made)


def _prior(
    target: Target, of: Expectation, term: Term, family: Family, states: int
) -> LabelTerm | None:
    """A label's own probabilities, where they are the same for all elements."""
    node = target.model[term.name]
    ndim = getattr(family.make, "parameter_ndim", None)
    low = 0 if node.domain is None else node.domain.low
    if ndim is None:
        return None
    made: dict[str, Any] = {}
    for name, value in family.parameters.items():
        if value is None:
            made[name] = None
            continue
        if not isinstance(value, Expression) or name not in ndim:
            return None
        inner = value.shape[len(value.shape) - ndim[name] :]
        if value.size != math.prod(inner):
            return None
        made[name] = reshape(value, (1, *inner))
    value = as_expression(np.arange(states) + low)
    log = broadcast(plain_density(Family(family.make, made), value), (states,))
    found = possible(of(tidied(log)))
    rows = np.ones((1, math.prod(node.plate_shape)))
    return _label_term(term, term.name, rows, reshape(broadcast(found, (states,)), (states, 1)))


def _label_term(term: Term, label: str, rows: np.ndarray, coefficients: Expression) -> LabelTerm:
    sums = leaf(f"sums of \0{term.name}", coefficients.shape)
    return LabelTerm(label, rows, coefficients, sums)
