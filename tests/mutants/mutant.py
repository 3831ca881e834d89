"""A mutant: a fault, and the test of ``bayesmc.testing`` that must catch it; what comes of trying it.

A test is run at the same seed with the fault and without it. It must fail with the fault, pass without, and
show other figures with it than without: else the fault is one that the test does not run into.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from bayesmc.errors import BayesmcWarning
from bayesmc.testing.verdict import Verdict, uncounted
from tests.mutants.faults import Fault, planted

#: false-alarm rate of every test here: a table of 100 seeds has one but once in some hundred runs
ALPHA = 1e-6


@dataclass(frozen=True)
class Mutant:
    """A fault, and who must notice.

    Attributes
    ----------
    name : str
        The fault in words.
    faults : tuple
        Places of the library that are changed.
    test : callable
        ``test(seed) -> Verdict``: makes everything anew, as compiled models are kept.
    by : str
        The test in words, with its documented number of draws.
    is_long : bool
        Its test takes seconds, and its neighbours' are like it: for ``make mutants`` and thorough runs.
    """

    name: str
    faults: tuple[Fault, ...]
    test: Callable[[int], Verdict]
    by: str
    is_long: bool = False

    @property
    def where(self) -> str:
        """Modules and functions that are changed."""
        short = (f.where.removeprefix("bayesmc.") for f in self.faults)
        return ", ".join(dict.fromkeys(short))


@dataclass(frozen=True)
class Trial:
    """One seed: what the test said with the fault, and without it.

    Attributes
    ----------
    seed : int
    caught, alarm : bool
        Whether the test failed with the fault; without it.
    idle : bool
        Whether the figures were the same.
    p_value : float
        With the fault.
    seconds : float
        Of processor time for one test.
    broken : str
        The error that the test ended in, with the fault or without it; empty if in none.
    """

    seed: int
    caught: bool
    alarm: bool
    idle: bool
    p_value: float
    seconds: float
    broken: str = ""


@dataclass(frozen=True)
class Row:
    """A mutant at some seeds.

    Attributes
    ----------
    mutant : Mutant
    trials : tuple of Trial
    """

    mutant: Mutant
    trials: Sequence[Trial] = field(repr=False)

    @property
    def caught(self) -> int:
        return sum(t.caught for t in self.trials)

    @property
    def alarms(self) -> int:
        return sum(t.alarm for t in self.trials)

    @property
    def seconds(self) -> float:
        """Mean of one test, of processor time."""
        return sum(t.seconds for t in self.trials) / len(self.trials)

    @property
    def problems(self) -> list[str]:
        """All that is wrong with it, in words; empty where the fault was caught at every seed."""
        found = []
        missed = [t.seed for t in self.trials if not t.caught]
        if missed:
            found.append(f"not caught at {len(missed)} of {len(self.trials)} seeds, as {missed[0]}")
        if all(t.idle for t in self.trials):
            found.append("the test shows the same figures with the fault and without it")
        alarms = [t.seed for t in self.trials if t.alarm]
        if alarms:
            found.append(f"an alarm without the fault at {len(alarms)} seeds, as {alarms[0]}")
        found += dict.fromkeys(t.broken for t in self.trials if t.broken)
        return found


def tried(mutant: Mutant, seed: int) -> Trial:
    """A mutant at one seed. The library is then as it was before."""
    start = time.process_time()
    right = _said(mutant.test, seed)
    middle = time.process_time()
    with planted(*mutant.faults):
        wrong = _said(mutant.test, seed)
    seconds = (time.process_time() - start) / 2
    if not isinstance(right, Verdict) or not isinstance(wrong, Verdict):
        parts = (("without the fault", right), ("with the fault", wrong))
        broken = "; ".join(f"{when}: {e}" for when, e in parts if not isinstance(e, Verdict))
        return Trial(seed, False, False, False, 1.0, middle - start, broken)
    idle = [_figures(c) for c in right.comparisons] == [_figures(c) for c in wrong.comparisons]
    return Trial(seed, not wrong, not right, idle, wrong.p_value, seconds)


def examined(mutant: Mutant, seeds: Iterable[int]) -> Row:
    """A mutant at all seeds."""
    return Row(mutant, tuple(tried(mutant, seed) for seed in seeds))


# ---- private ------------------------------------------------------------------------------------


def _said(test: Callable[[int], Verdict], seed: int) -> Verdict | str:
    """The verdict, or the error in its place: an error is no catch, as another net may not raise it."""
    try:
        with uncounted(), warnings.catch_warnings():
            warnings.simplefilter("ignore", BayesmcWarning)  # chains are as short as they may be
            verdict: Any = test(seed)
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return verdict if isinstance(verdict, Verdict) else f"no verdict but {verdict!r}"


def _figures(comparison: Any) -> tuple[Any, ...]:
    return comparison.what, repr(comparison.found), repr(comparison.errors)
