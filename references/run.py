"""Runs cases on their default engines and prints what comes of them.

Seconds are those that the call takes of a processor, planning and compiling included: the peers' are, too,
and what else the machine does lengthens neither.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.errors import UnsupportedError
from references.case import Case
from references.verdict import Deviation, deviations, figures_of


@dataclass(frozen=True)
class Sampled:
    """One run of one engine.

    Attributes
    ----------
    engine, draws : str
        The engine's name; chains x draws after warmup, as words.
    seconds : float
        Processor time from call to posterior.
    ess, rhat : float
        The smallest effective size and the largest R-hat of all that is published; infinite and NaN where
        the answer is exact.
    ess_at : str
        Whose effective size that is.
    warnings : tuple of str
    """

    engine: str
    draws: str
    seconds: float
    ess: float
    ess_at: str
    rhat: float
    warnings: tuple[str, ...] = ()

    @property
    def rate(self) -> float:
        """Effective draws in a second."""
        return self.ess / self.seconds


@dataclass(frozen=True)
class Outcome:
    """What came of a case.

    Attributes
    ----------
    case : Case
    judged : Sampled or None
        The run that is judged; None where an error prevented it.
    worst : Deviation or None
        The comparison closest to, or farthest beyond, what is allowed.
    failures : tuple of Deviation
        Comparisons beyond what is allowed.
    error : str
        Why there is no posterior.
    """

    case: Case
    judged: Sampled | None = None
    worst: Deviation | None = None
    failures: tuple[Deviation, ...] = ()
    error: str = ""

    @property
    def passed(self) -> bool:
        """Whether everything lies within what is allowed."""
        return self.worst is not None and not self.failures


def run_case(case: Case, root: Path, rng: int = 1) -> Outcome:
    """Run one case; an error of the library becomes part of the outcome, so that a long run goes on."""
    try:
        judged, posterior = sampled(case, case.engine(), root, rng)
        found = deviations(case, posterior, root)
    except Exception as error:  # whatever it is, it belongs in the table
        return Outcome(case, error=f"{type(error).__name__}: {error}")
    worst = max(found, key=lambda deviation: deviation.units)
    return Outcome(case, judged, worst, tuple(d for d in found if d.units > 1))


def run_all(cases: Iterable[Case], root: Path, rng: int = 1) -> list[Outcome]:
    """Run the cases in turn and print a line for each."""
    outcomes = []
    print(_HEADER)
    for case in cases:
        outcomes.append(run_case(case, root, rng))
        print(_line(outcomes[-1]), flush=True)
    passed = sum(outcome.passed for outcome in outcomes)
    print(f"{passed} of {len(outcomes)} as published")
    return outcomes


def sampled(case: Case, engine: Any, root: Path, rng: int) -> tuple[Sampled, bmc.Posterior]:
    """One run by ``engine``, with the nodes kept that something is published of."""
    question = case.question(root)
    nodes = sorted({case.locate(name)[0] for name in case.published(root)})
    start = time.process_time()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        posterior = question.infer(engine, rng=rng, keep=nodes)
    seconds = time.process_time() - start
    figures = figures_of(case, posterior, root)
    at = min(figures, key=lambda name: np.nan_to_num(figures[name][0], nan=np.inf))
    rhat = [r for _, r in figures.values() if not np.isnan(r)]
    messages = tuple(str(warning.message) for warning in caught)
    return Sampled(
        type(posterior.engine).__name__,
        _effort(posterior, nodes[0]),
        seconds,
        figures[at][0],
        at,
        max(rhat, default=float("nan")),
        messages,
    ), posterior


def asked_for(engine: Any, ess: float) -> Any:
    """The same engine, asked for an effective size, where it can be."""
    return replace(engine, ess=ess) if hasattr(engine, "ess") else engine


def said(d: Deviation) -> str:
    """One figure beyond what is allowed, in words."""
    if d.what == "ess":
        return f"{d.name}: ESS {d.ours:.0f}, needed {d.published:.0f}"
    return f"{d.name}: {d.what} {d.ours:.5g}, published {d.published:.5g} +- {d.allowed:.2g}"


_HEADER = f"{'model':28}{'engine':>18}{'draws':>14}{'seconds':>9}{'ESS':>8}{'R-hat':>7}  of what is allowed"


def _line(outcome: Outcome) -> str:
    name = f"{outcome.case.name:28}"
    if outcome.judged is None or outcome.worst is None:
        return f"{name}{outcome.error}"
    run, worst = outcome.judged, outcome.worst
    text = (
        f"{name}{run.engine:>18}{run.draws:>14}{run.seconds:9.2f}{run.ess:8.0f}{run.rhat:7.3f}  "
        f"{worst.units:5.2f} {worst.what + ' ' + worst.name:14} {'ok' if outcome.passed else 'FAR'}"
    )
    more = [*(said(d) for d in outcome.failures), *run.warnings]
    return "\n".join([text, *(f"    {words}" for words in more)])


def _effort(posterior: bmc.Posterior, node: str) -> str:
    try:
        chains, draws = np.asarray(posterior[node]).shape[:2]
    except UnsupportedError:
        return "exact"
    return f"{chains} x {draws}"
