"""What checks of a density have found: comparisons, faults in words, and what could not be looked at."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bayesmc.testing.posteriors.samples import Average
from bayesmc.testing.verdict import Comparison

#: draws that effectively decide an error, at least
_SUPPORT = 30.0


@dataclass(frozen=True)
class Fault(Comparison):
    """Something wrong that no chance explains, in words."""

    def __str__(self) -> str:
        return self.what


class Report:
    """Comparisons and remarks as they come in.

    Parameters
    ----------
    alpha : float
        Of the whole call.
    rng : Generator
    """

    def __init__(self, alpha: float, rng: np.random.Generator) -> None:
        self.alpha, self.rng = alpha, rng
        self.comparisons: list[Comparison] = []
        self.remarks: list[str] = []
        self.place = ""

    def fault(self, what: str) -> None:
        self.comparisons.append(Fault(self.place + what, math.nan, math.nan, math.inf, 0.0))

    def judge(
        self,
        what: str,
        found: float,
        exact: float,
        errors: float,
        p_value: float,
        kind: str = "exact",
    ) -> None:
        self.comparisons.append(
            Comparison(
                self.place + what, float(found), float(exact), float(errors), float(p_value), kind
            )
        )

    def fine(self, what: str, found: float = 0.0, exact: float = 0.0) -> None:
        """Something that was looked at, and is as it should be."""
        self.judge(what, found, exact, 0.0, 1.0)

    def agree(self, what: str, found: float, exact: float, tolerance: float, words: str) -> None:
        """A figure without chance in it."""
        if abs(found - exact) <= tolerance:
            self.fine(what, found, exact)
        else:
            self.fault(words)

    def average(self, what: str, drawn: Average, exact: float, unit: float) -> None:
        """A mean of draws, unless too few of them decide."""
        if drawn.support < _SUPPORT or not np.isfinite(exact):
            self.remark(f"{what.split(' of ')[0]}: too few draws decide it")
            return
        errors, p_value = drawn.p_value(exact, 1e-9 * unit)
        self.judge(what, drawn.value, exact, errors, p_value)

    def remark(self, text: str) -> None:
        if self.place + text not in self.remarks:
            self.remarks.append(self.place + text)

    @property
    def level(self) -> float:
        """Smallest level at which a further comparison may have to be judged."""
        return self.alpha / (len(self.comparisons) + 64)
