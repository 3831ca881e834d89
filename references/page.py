"""The page ``docs/accuracy.md``: what came of every case, and what it costs beside JAGS and PyMC."""

from __future__ import annotations

import platform
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

import bayesmc as bmc
from references.peers.figures import Figures, Peer
from references.run import Outcome, said

#: what a peer's figures may be of: the size that our runs are judged at, and one at which starts count less
JUDGED, MORE = 1000, 4000


def report(
    outcomes: Sequence[Outcome],
    plain: Mapping[str, Peer],
    more: Mapping[str, Peer],
    peers: Figures,
    rng: int = 1,
) -> str:
    """The page.

    Parameters
    ----------
    outcomes : sequence of Outcome
        With the extra ``fast``.
    plain, more : mapping
        Case -> our run without it, and with it asked for an effective size of 4,000.
    peers : Figures
    rng : int
        The seed.
    """
    parts = [
        _INTRODUCTION.format(
            rng=rng,
            passed=sum(outcome.passed for outcome in outcomes),
            count=len(outcomes),
            python=platform.python_version(),
            numpy=np.__version__,
            version=bmc.__version__,
        ),
        *_accuracy(outcomes),
        *_failures(outcomes),
        *_warned(outcomes),
        *_speed(outcomes, plain, more, peers),
    ]
    return "\n".join(parts) + "\n"


_INTRODUCTION = """\
# Accuracy against published posteriors

Written by `make references` (bayesmc {version}, Python {python}, NumPy {numpy}, seed {rng}); not edited by
hand. {passed} of {count} models are as published. The models stand in `references/`, one function each; all
are asked as a user asks who says nothing else: `bmc.infer(net, evidence)`, which takes an engine by itself
and draws until the smallest effective sample size (ESS) is 1,000.

- **BUGS**: every monitored parameter of every test, against long runs of JAGS (of OpenBUGS for surgical
  and stacks). Means within 0.15 published standard deviations, standard deviations within 10 % or 4
  standard errors (ours and the published run's together). Parameters without a fourth moment
  (`sigma2.between` of dyes, `sigma` and `tau` of line) by their quartiles against quadrature, within 4
  standard errors.
- **posteriordb**: means within 4 combined standard errors of the reference draws (or exact answers),
  standard deviations within 10 %.
- **both**: ESS 1,000 or more of each, R-hat below 1.01 (nested R-hat of many short chains: or below what
  chance gives chains that agree once in 10,000 times).

*Worst* is the largest deviation of any parameter in units of what its rule allows: up to 1 is fine. *ESS*
is the smallest, R-hat the largest of all monitored parameters. *Draws* are chains x draws of each after
warmup.
"""

_TITLES = {"bugs": "BUGS", "posteriordb": "posteriordb"}


def _accuracy(outcomes: Sequence[Outcome]) -> Iterator[str]:
    for rule, title in _TITLES.items():
        chosen = [outcome for outcome in outcomes if outcome.case.rule == rule]
        if chosen:
            yield f"## {title}\n"
            yield "| model | engine | draws | ESS | R-hat | worst | of | |"
            yield "|---|---|--:|--:|--:|--:|---|---|"
            yield from map(_row, chosen)
            yield ""


def _row(outcome: Outcome) -> str:
    if outcome.judged is None or outcome.worst is None:
        return f"| {outcome.case.name} | | | | | | {_cell(outcome.error)} | **error** |"
    run, worst = outcome.judged, outcome.worst
    rhat = "" if np.isnan(run.rhat) else f"{run.rhat:.3f}"
    return (
        f"| {outcome.case.name} | {run.engine} | {run.draws} | {_count(run.ess)} | {rhat} | "
        f"{worst.units:.2f} | {worst.what} of `{worst.name}` | {'ok' if outcome.passed else '**far**'} |"
    )


def _failures(outcomes: Sequence[Outcome]) -> Iterator[str]:
    far = [outcome for outcome in outcomes if outcome.failures]
    if far:
        yield "## Beyond what is allowed\n"
        for outcome in far:
            yield f"- {outcome.case.name}: " + "; ".join(said(d) for d in outcome.failures)
        yield ""


def _warned(outcomes: Sequence[Outcome]) -> Iterator[str]:
    warned = [(o.case.name, o.judged.warnings) for o in outcomes if o.judged and o.judged.warnings]
    if warned:
        yield "## Warnings\n"
        for name, messages in warned:
            yield f"- {name}: " + "; ".join(map(_cell, messages))
        yield ""


# ---- what it costs ------------------------------------------------------------------------------


def _speed(
    outcomes: Sequence[Outcome],
    plain: Mapping[str, Peer],
    more: Mapping[str, Peer],
    peers: Figures,
) -> Iterator[str]:
    yield _PROTOCOL.format(about="; ".join(peers.about.values()) or "not measured yet")
    yield (
        "| model | s | s, fast | ESS/s | ESS/s, fast | JAGS | PyMC | ratio | fast at 4,000 | JAGS at 4,000 "
        "| ratio |"
    )
    yield "|---|" + "--:|" * 10
    ratios, later = {}, {}
    for outcome in outcomes:
        run = outcome.judged
        if run is None:
            continue
        name = outcome.case.name
        first, second = peers.of(name, JUDGED), peers.of(name, MORE)
        fast, again = Peer(run.ess, run.seconds, run.draws), more.get(name)
        ratios[name], later[name] = _ratio(fast, first), _ratio(again, second)
        without = plain.get(name)
        cells = [
            _seconds(without),
            _seconds(fast),
            _rate(without),
            _rate(fast),
            _rate(first.get("JAGS")),
            _rate(first.get("PyMC")),
            _times(ratios[name]),
            _rate(again),
            _rate(second.get("JAGS")),
            _times(later[name]),
        ]
        yield f"| {name} | " + " | ".join(cells) + " |"
    yield ""
    for ess, found in ((JUDGED, ratios), (MORE, later)):
        yield from _counted(found, ess)


def _counted(ratios: Mapping[str, float | None], ess: int) -> Iterator[str]:
    known = {name: ratio for name, ratio in ratios.items() if ratio is not None}
    slower = sorted((n for n, r in known.items() if r < 1), key=lambda name: known[name])
    third = [name for name in slower if known[name] < 1 / 3]
    yield (
        f"Asked for {ess:,}: at least the better peer's ESS per second on {len(known) - len(slower)} of "
        f"{len(known)} models; below a third of it on {len(third)}"
        + (f" ({', '.join(third)})." if third else ".")
    )


def _ratio(ours: Peer | None, peers: Mapping[str, Peer]) -> float | None:
    if ours is None or not peers:
        return None
    return ours.rate / max(run.rate for run in peers.values())


def _seconds(run: Peer | None) -> str:
    return "" if run is None else f"{run.seconds:.2f}"


def _rate(run: Peer | None) -> str:
    return "" if run is None else _count(run.rate)


def _times(ratio: float | None) -> str:
    if ratio is None:
        return ""
    return "exact" if np.isinf(ratio) else f"{ratio:.2f}"


def _count(value: float) -> str:
    return "exact" if np.isinf(value) else f"{value:,.0f}"


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


_PROTOCOL = """\
## What it costs

Seconds of one processor, so that nobody else on the machine lengthens them; the ESS is worked out by one
function for all, of the same parameters, and is the smallest of them.

- **bayesmc**: from call to posterior, reading, planning and compiling included, without the extra `[fast]`
  and with it, its cache of machine code empty.
- **JAGS**: the whole process and the reading of its draws; models of our own texts
  (`references/peers/jags`), regressions with all coefficients as one block; four chains, 1,000 sweeps of
  adaptation and warmup, then 1,000 draws of each, doubled until the ESS that is asked for is there (the last
  run alone counts); as it comes or with its module `glm`, whichever is better.
- **PyMC**: its defaults (NUTS, four chains of 1,000 draws after 1,000 of tuning), one core; from the
  model's declaration to its draws, compiling included, imports not. Only where NUTS suits the model and
  its compiling does not decide; a blank where it was not run.

The peers' figures were measured before, by `python -m references --peers` ({about}), and stand in
`references/peers/figures.json`. *Ratio* is ours with `[fast]` over the better peer. JAGS starts in some
.02 s, which is all that it needs for small models: the last three columns ask all for an ESS of 4,000, at
which starts count less.
"""
