"""The textbook factor: a table over named discrete variables, for small general queries.

Factors align by name, never by axis position, so that elimination reads as in the book. Speed over
a whole net is the business of `bayesmc.factors.cliquetree`; nothing here plans or caches.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import BudgetError
from .named import Variable, aligned, largest, sizes_of, steps


@dataclass(frozen=True, eq=False)
class Factor:
    """A non-negative function of discrete variables: ``values * exp(log_scale)``.

    Attributes
    ----------
    scope : tuple of hashable
        The variables, one per axis of ``values``.
    values : ndarray
        Linear, not log.
    log_scale : float
        Natural log of a common multiplier, so that long products neither vanish nor overflow.

    Examples
    --------
    >>> prior = Factor(("rain",), np.array([0.2, 0.8]))
    >>> wet = Factor(("wet", "rain"), np.array([[0.9, 0.1], [0.1, 0.9]]))
    >>> (prior * wet).sum_out(["rain"]).values
    array([0.26, 0.74])
    """

    scope: tuple[Variable, ...]
    values: np.ndarray
    log_scale: float = 0.0

    def __post_init__(self) -> None:
        if np.ndim(self.values) != len(self.scope) or len(set(self.scope)) != len(self.scope):
            raise ValueError(
                f"Factor: the scope {self.scope} must name each of the {np.ndim(self.values)} axes "
                "of the values once"
            )

    def __mul__(self, other: Factor) -> Factor:
        """The product, over the union of both scopes."""
        scope = self.scope + tuple(v for v in other.scope if v not in self.scope)
        values = aligned(self, scope) * aligned(other, scope)
        return Factor(scope, values, self.log_scale + other.log_scale)

    def sum_out(self, variables: Collection[Variable]) -> Factor:
        """The factor with these variables summed out; those it does not have are ignored."""
        axes = tuple(k for k, v in enumerate(self.scope) if v in variables)
        scope = tuple(v for v in self.scope if v not in variables)
        return Factor(scope, self.values.sum(axis=axes), self.log_scale)

    def reduce(self, evidence: Mapping[Variable, int]) -> Factor:
        """The factor at the given states of some of its variables, which leave the scope."""
        index = tuple(evidence[v] if v in evidence else slice(None) for v in self.scope)
        scope = tuple(v for v in self.scope if v not in evidence)
        return Factor(scope, self.values[index], self.log_scale)

    def rescaled(self) -> Factor:
        """The same function with its largest value at 1 (unchanged where all are zero)."""
        top = float(self.values.max(initial=0.0))
        if top == 0.0:
            return self
        return Factor(self.scope, self.values / top, self.log_scale + math.log(top))

    def table(self, scope: Sequence[Variable]) -> np.ndarray:
        """The values with axes in the order of ``scope``, normalised to sum to 1."""
        values = np.transpose(self.values, [self.scope.index(v) for v in scope])
        return values / values.sum()


def sum_product(
    factors: Iterable[Factor], keep: Collection[Variable], max_bytes: float = math.inf
) -> Factor:
    """The product of all factors with every variable outside ``keep`` summed out.

    Variables go in the order of least product first (min-weight); the cost is known, and refused,
    before anything is multiplied.

    Raises
    ------
    BudgetError
        If the largest intermediate table would take more than ``max_bytes``.

    Notes
    -----
    Variable elimination: Koller and Friedman (2009), Algorithm 9.1.
    """
    pending = list(factors)
    sizes = sizes_of(pending)
    entries = largest([f.scope for f in pending], keep, sizes)
    if 8.0 * entries > max_bytes:
        raise BudgetError(
            f"sum_product over {len(keep)} variables: the largest intermediate table would take "
            f"{8.0 * entries:.3g} bytes, above the {max_bytes:.3g} allowed; ask for fewer "
            "variables at once, or raise the budget",
            int(8.0 * entries),
        )
    for touched, gone, _ in steps([f.scope for f in pending], keep, sizes):
        made = _product([pending[k] for k in touched]).sum_out(gone).rescaled()
        pending = [f for k, f in enumerate(pending) if k not in touched] + [made]
    return _product(pending)


def _product(factors: Sequence[Factor]) -> Factor:
    result = Factor((), np.ones(()))
    for factor in sorted(factors, key=lambda f: f.values.size):
        result = result * factor
    return result
