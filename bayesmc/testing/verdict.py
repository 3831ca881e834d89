"""What a statistical test says: figures, how far each is off, and which of them chance does not explain.

One kind of answer for all tests of the kit. A test makes its comparisons, each with a p-value; all of them
are judged together by Holm's method, so that ``alpha`` is the chance of any false alarm in one call. What
calls have spent of such chances is counted here, for whoever reports it at the end of a run.

References
----------
Holm (1979), A simple sequentially rejective multiple test procedure, Scandinavian Journal of Statistics 6.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from numbers import Real
from typing import Any, TypeVar

import numpy as np

#: figures shown of a verdict
_SHOWN = 10


class NothingToCompare(ValueError):
    """The two answers know no hidden node in common, and not both of them the evidence."""


@dataclass(frozen=True)
class Comparison:
    """One figure against what it should be.

    Attributes
    ----------
    what : str
        Node, element and state, or the statistic.
    found, exact : float
    errors : float
        Distance in standard errors (infinite where none is allowed).
    p_value : float
        Of a distance at least this large, were all right.
    kind : str
        What ``exact`` is, in a word: expected values and other simulations have errors of their own.
    """

    what: str
    found: float
    exact: float
    errors: float
    p_value: float
    kind: str = "exact"

    def __str__(self) -> str:
        return (
            f"{self.what}: {self.found:.6g} against {self.exact:.6g} {self.kind}, "
            f"{self.errors:.3g} standard errors (p = {self.p_value:.2g})"
        )


@dataclass(frozen=True, eq=False, repr=False)
class Verdict:
    """The answer of a test; true where nothing deviates, so that ``assert`` takes it.

    Attributes
    ----------
    test : str
        The call.
    alpha : float
        Chance of any false alarm in this call.
    comparisons : tuple of Comparison
        All that was judged, least likely first.
    skipped : int
        Figures with too few draws to be judged.

    Examples
    --------
    >>> from bayesmc.testing import Comparison, Verdict
    >>> verdict = Verdict("example", 0.01, [Comparison("mean of node 'a'", 1.0, 1.3, 4.2, 3e-5)])
    >>> bool(verdict)
    False
    >>> verdict
    example: 1 of 1 figures deviates (false-alarm rate 0.01)
      mean of node 'a': 1 against 1.3 exact, 4.2 standard errors (p = 3e-05)
    """

    test: str
    alpha: float
    comparisons: Sequence[Comparison]
    skipped: int = 0

    def __post_init__(self) -> None:
        check_level(self.test, self.alpha)
        if any(math.isnan(c.p_value) for c in self.comparisons):
            raise ValueError(f"{self.test}: a comparison has no p-value: {list(self.comparisons)}")
        ordered = sorted(self.comparisons, key=lambda c: (c.p_value, -c.errors))
        object.__setattr__(self, "comparisons", tuple(ordered))

    @property
    def level(self) -> float:
        """Family-wise level at which the comparisons are judged."""
        return self.alpha

    @property
    def rejected(self) -> tuple[Comparison, ...]:
        """Figures that deviate, least likely first (Holm's method); empty when all is well."""
        count = holm([c.p_value for c in self.comparisons], self.level)
        return tuple(self.comparisons[:count])

    @property
    def worst(self) -> Comparison | None:
        """The least likely figure."""
        return self.comparisons[0] if self.comparisons else None

    @property
    def p_value(self) -> float:
        """Of the whole call: the smallest p-value times their number, at most 1."""
        return min(1.0, self.worst.p_value * len(self.comparisons)) if self.worst else 1.0

    def __bool__(self) -> bool:
        return not self.rejected

    def __repr__(self) -> str:
        rejected, count = self.rejected, len(self.comparisons)
        shown = rejected or self.comparisons[:1]
        verb = "deviates" if len(rejected) == 1 else "deviate"
        lines = [
            f"{self.test}: {len(rejected)} of {count} figures {verb} (false-alarm rate {self.alpha:g})",
            *(f"  {c}" for c in shown[:_SHOWN]),
        ]
        if len(shown) > _SHOWN:
            lines.append(f"  ... and {len(shown) - _SHOWN} more")
        if self.skipped:
            lines.append(f"  {self.skipped} not judged: too few effective draws")
        return "\n".join(lines + self._remarks())

    def _remarks(self) -> list[str]:
        """Lines of a test's own, below."""
        return []


def check_level(call: str, alpha: Any) -> None:
    """Raise ValueError unless alpha is a probability strictly between 0 and 1."""
    if not isinstance(alpha, (int, float, np.number)) or not 0.0 < alpha < 1.0:
        raise ValueError(f"{call}(alpha={alpha!r}): give a probability strictly between 0 and 1")


def as_real(what: str, value: Any) -> np.ndarray:
    """Numbers as floats; raises TypeError, in which ``what`` names them, where they are none."""
    found = np.asarray(value)
    exact = found.dtype.kind == "O" and all(isinstance(v, Real) for v in found.flat)
    if found.dtype.kind not in "biuf" and not exact:
        shown = f"{value!r}"[:60] if found.ndim == 0 else f"of type {found.dtype}"
        raise TypeError(f"{what} is {shown}; give real numbers")
    return found.astype(float)


def holm(p_values: Sequence[float], alpha: float) -> int:
    """How many p-values, smallest first, Holm's step-down procedure rejects (Holm 1979)."""
    count = len(p_values)
    kept = (k for k, p in enumerate(p_values) if not p * (count - k) < alpha)
    return next(kept, count)


# ---- the budget of a run ------------------------------------------------------------------------


@dataclass
class Budget:
    """Chances of false alarms that calls have spent, and what became of them.

    Attributes
    ----------
    spent : dict
        Test -> sum of the ``alpha`` of its calls, an upper bound on the expected number of false alarms.
    calls : dict
        Test -> number of calls.
    """

    spent: dict[str, float] = field(default_factory=dict)
    calls: dict[str, int] = field(default_factory=dict)

    def add(self, test: str, alpha: float, calls: int = 1) -> None:
        """Count calls that together spent ``alpha``."""
        self.spent[test] = self.spent.get(test, 0.0) + alpha
        self.calls[test] = self.calls.get(test, 0) + calls


#: of this process
BUDGET = Budget()
#: verdicts of late, for whoever reports a failing test; who reads it clears it
LAST: deque[Verdict] = deque(maxlen=50)

V = TypeVar("V", bound=Verdict)


@contextmanager
def uncounted() -> Iterator[None]:
    """Calls in here leave the budget alone: they are repetitions, whose alarms somebody counts.

    Examples
    --------
    >>> from bayesmc.testing.verdict import BUDGET, Verdict, counted, uncounted
    >>> before = BUDGET.calls.get("example", 0)
    >>> with uncounted():
    ...     _ = counted(Verdict("example", 0.1, []))
    >>> BUDGET.calls.get("example", 0) == before
    True
    """
    kept = dict(BUDGET.spent), dict(BUDGET.calls)
    verdicts = list(LAST)
    try:
        yield
    finally:
        BUDGET.spent, BUDGET.calls = kept
        LAST.clear()
        LAST.extend(verdicts)


def counted(verdict: V) -> V:
    """The verdict, whose ``alpha`` is now in the budget: every test of the kit returns through here."""
    BUDGET.add(verdict.test, verdict.alpha)
    LAST.append(verdict)
    return verdict
