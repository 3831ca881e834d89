"""Runs cases, prints what comes of them, and writes the table of a whole run.

A case is run with its own settings, by which it is judged; one that has any is also run with the
engine's defaults, which tells how far these go.
"""

from __future__ import annotations

import platform
import time
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import bayesmc as bmc
from references.case import Case
from references.verdict import Deviation, deviations, effective_sizes

#: an effective sample size that a minute at default settings should reach
ENOUGH, MINUTE = 400, 60.0


@dataclass(frozen=True)
class Sampled:
    """One run of one engine: how long it took and how good the worst parameter is."""

    engine: Any
    seconds: float
    ess: float
    ess_at: str
    warnings: tuple[str, ...] = ()

    @property
    def ess_in_a_minute(self) -> float:
        """Effective sample size that a minute of such runs would reach."""
        return self.ess * MINUTE / self.seconds


@dataclass(frozen=True)
class Outcome:
    """What came of a case.

    Attributes
    ----------
    case : Case
    judged, default : Sampled or None
        The run that is judged, and the one at default settings (the same, if the case has none of its
        own); None where an error prevented it.
    worst : Deviation or None
        The comparison closest to, or farthest beyond, what is allowed.
    failures : tuple of Deviation
        Comparisons beyond what is allowed.
    error : str
        Why there is no posterior.
    """

    case: Case
    judged: Sampled | None = None
    default: Sampled | None = None
    worst: Deviation | None = None
    failures: tuple[Deviation, ...] = ()
    error: str = ""

    @property
    def passed(self) -> bool:
        """Whether everything lies within what is allowed."""
        return self.worst is not None and not self.failures


def run_case(case: Case, root: Path, rng: int = 1, *, defaults: bool = True) -> Outcome:
    """Run one case; an error of the library becomes part of the outcome, so that a long run goes on.

    ``defaults=False`` leaves out the run at default settings where the case has its own.
    """
    try:
        judged, posterior = _sample(case, case.engine(), root, rng)
        found = deviations(case, posterior, root)
        default: Sampled | None = judged
        if case.settings:
            default = _sample(case, case.factory(), root, rng)[0] if defaults else None
    except Exception as error:  # whatever it is, it belongs in the table
        return Outcome(case, error=f"{type(error).__name__}: {error}")
    worst = max(found, key=lambda deviation: deviation.units)
    failures = tuple(d for d in found if d.units > 1)
    return Outcome(case, judged, default, worst, failures)


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


def report(outcomes: Sequence[Outcome], rng: int = 1) -> str:
    """The page ``docs/accuracy.md``."""
    passed = sum(outcome.passed for outcome in outcomes)
    parts = [
        _INTRODUCTION.format(
            rng=rng,
            passed=passed,
            count=len(outcomes),
            python=platform.python_version(),
            numpy=np.__version__,
            version=bmc.__version__,
        ),
        *_judged_tables(outcomes),
        *_failures(outcomes),
        *_defaults(outcomes),
    ]
    return "\n".join(parts) + "\n"


def _sample(case: Case, engine: Any, root: Path, rng: int) -> tuple[Sampled, bmc.Posterior]:
    question = case.question(root)
    nodes = sorted({case.locate(name)[0] for name in case.published(root)})
    start = time.perf_counter()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        posterior = question.infer(engine, rng=rng, keep=nodes)
    seconds = time.perf_counter() - start
    sizes = effective_sizes(case, posterior, root)
    at = min(sizes, key=lambda name: sizes[name])
    messages = tuple(str(warning.message) for warning in caught)
    return Sampled(engine, seconds, sizes[at], at, messages), posterior


_HEADER = (
    f"{'model':32}{'chains x draws':>16}{'seconds':>9}{'ESS':>8}  {'of what is allowed':20}verdict"
)


def _line(outcome: Outcome) -> str:
    name = f"{outcome.case.name:32}"
    if outcome.judged is None or outcome.worst is None:
        return f"{name}{outcome.error}"
    run, worst = outcome.judged, outcome.worst
    text = (
        f"{name}{_effort(run.engine):>16}{run.seconds:9.1f}{run.ess:8.0f}  "
        f"{worst.units:5.2f} {worst.what + ' ' + worst.name:14} {'ok' if outcome.passed else 'FAR'}"
    )
    return "\n".join([text, *(f"    {_said(d)}" for d in outcome.failures)])


def _effort(engine: Any) -> str:
    thinning = getattr(engine, "thinning", 1)
    thinned = f" / {thinning}" if thinning > 1 else ""
    return f"{getattr(engine, 'chains', 1)} x {engine.draws}{thinned}"


def _said(d: Deviation) -> str:
    if d.what == "ess":
        return f"{d.name}: ESS {d.ours:.0f}, needed {d.published:.0f}"
    return f"{d.name}: {d.what} {d.ours:.5g}, published {d.published:.5g} +- {d.allowed:.2g}"


_INTRODUCTION = """\
# Accuracy against published posteriors

Written by `make references` (bayesmc {version}, Python {python}, NumPy {numpy}, seed {rng}); not edited by
hand. {passed} of {count} models are as published. The models stand in `references/`, one function each.

- **BUGS**: every monitored parameter of every test, against long runs of JAGS (of OpenBUGS for surgical
  and stacks). Means within 0.15 published standard deviations, standard deviations within 10 % or 4
  standard errors (ours and the published run's together), effective sample size (ESS) 1,000 or more.
  Parameters without a fourth moment (`sigma2.between` of dyes, `sigma` and `tau` of line) by their
  quartiles against quadrature, within 4 standard errors.
- **posteriordb**: means within 4 combined standard errors of the reference draws (or exact answers),
  standard deviations within 10 %.

*Worst* is the largest deviation of any parameter in units of what its rule allows: up to 1 is fine. *ESS*
is the smallest of all monitored parameters. *Draws* are chains x kept draws per chain; ` / k` says that
every k-th sweep is kept. Seconds are those from call to posterior.
"""

_TITLES = {"bugs": "BUGS", "posteriordb": "posteriordb"}


def _judged_tables(outcomes: Sequence[Outcome]) -> Iterable[str]:
    for rule, title in _TITLES.items():
        chosen = [outcome for outcome in outcomes if outcome.case.rule == rule]
        if not chosen:
            continue
        yield f"## {title}\n"
        yield "| model | engine | warmup | draws | ESS | seconds | worst | of | |"
        yield "|---|---|--:|--:|--:|--:|--:|---|---|"
        for outcome in chosen:
            yield _row(outcome)
        yield ""


def _row(outcome: Outcome) -> str:
    if outcome.judged is None or outcome.worst is None:
        return f"| {outcome.case.name} | | | | | | | {_cell(outcome.error)} | **error** |"
    run, worst = outcome.judged, outcome.worst
    return (
        f"| {outcome.case.name} | {type(run.engine).__name__} | {getattr(run.engine, 'warmup', 0)} | "
        f"{_effort(run.engine)} | {run.ess:.0f} | {run.seconds:.1f} | {worst.units:.2f} | "
        f"{worst.what} of `{worst.name}` | {'ok' if outcome.passed else '**far**'} |"
    )


def _failures(outcomes: Sequence[Outcome]) -> Iterable[str]:
    far = [outcome for outcome in outcomes if outcome.failures]
    if far:
        yield "## Beyond what is allowed\n"
        for outcome in far:
            yield f"- {outcome.case.name}: " + "; ".join(_said(d) for d in outcome.failures)
        yield ""


def _defaults(outcomes: Sequence[Outcome]) -> Iterable[str]:
    yield "## At default settings\n"
    yield (
        f"`bmc.Gibbs()` as it stands: 1,000 draws of each of 4 chains. ESS within {MINUTE:.0f} s is what a "
        "minute of such runs comes to.\n"
    )
    yield "| model | ESS | of | seconds | ESS in a minute |"
    yield "|---|--:|---|--:|--:|"
    short = []
    for outcome in outcomes:
        run = outcome.default
        if run is None:
            continue
        if run.ess_in_a_minute < ENOUGH:
            short.append(outcome)
        yield (
            f"| {outcome.case.name} | {run.ess:.0f} | `{run.ess_at}` | {run.seconds:.1f} | "
            f"{run.ess_in_a_minute:.0f} |"
        )
    yield ""
    if not short:
        yield f"All reach an ESS of {ENOUGH} within a minute."
        return
    yield f"These do not reach an ESS of {ENOUGH} within a minute:\n"
    for outcome in short:
        yield f"- {outcome.case.name}: {outcome.case.remark or 'no remark yet'}"


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
