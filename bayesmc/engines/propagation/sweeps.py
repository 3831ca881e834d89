"""Messages passed until beliefs settle: batches in turn, forth and back, each in array operations.

All factors of a batch are made anew from the same beliefs and move them together, by a share of the way
(parallel updates); batches follow each other. Where that does not come closer the share gets smaller.
Assumed-density filtering visits one factor after the other, once, in the order of declaration.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from bayesmc.engines.propagation.batch import Batch, cautious
from bayesmc.engines.propagation.beliefs import NOTHING, Beliefs
from bayesmc.engines.propagation.conjugate import ConjugateBatch
from bayesmc.engines.propagation.contradiction import (
    Bounds,
    are_squeezed,
    bounds_of,
    contradictory,
    deviations,
    spreads,
)
from bayesmc.engines.propagation.lines import LineBatch
from bayesmc.engines.propagation.pace import Pace
from bayesmc.engines.propagation.system import System
from bayesmc.errors import UnsupportedError, ZeroProbabilityError
from bayesmc.structure.target import target_of

#: probabilities below this do not count as changed
_TINY = 1e-12
#: a belief that is narrower than it was by this factor, with messages that are open, has run off
_GONE = 1e-8


@dataclass(frozen=True)
class Settled:
    """How it ended.

    Attributes
    ----------
    converged : bool
    sweeps : int
    change : float
        By how much the last sweep changed the scalar's marginal that it changed most: the root of the
        symmetric Kullback-Leibler divergence.
    skipped, open : int
        Improper messages left out, in all sweeps and in the last.
    log_total : float
        Approximate log evidence; NaN where some factor has no integral with its cavity, or was left out.
    error : float
        Of quadrature and importance sampling, the worst: what coarser rules differ by.
    share : float
        The share of the way that beliefs moved in the end.
    log_as_met : float or None
        Of one pass: the sum of the logs of factors' integrals with the belief that each of them met.
    silent : dict
        Node or potential -> number of its factors that were left out to the end and never sent a message.
    untold : tuple of str
        Of one pass: nodes of which nothing that reads them said anything, though something observed depends
        on them.
    """

    converged: bool
    sweeps: int
    change: float
    skipped: int
    open: int
    log_total: float
    error: float
    share: float
    log_as_met: float | None = None
    silent: Mapping[str, int] = field(default_factory=dict)
    untold: tuple[str, ...] = ()


def settle(
    system: System,
    *,
    sweeps: int,
    damping: float,
    tolerance: float,
    advance: Callable[[], None] | None = None,
) -> Settled:
    """Pass messages until nothing changes, or ``sweeps`` times."""
    beliefs, batches = system.beliefs, system.batches
    order = [*batches, *reversed(batches[:-1])] if len(batches) > 1 else batches
    pace, skipped, left, change, done = Pace(damping, _is_easy(batches)), 0, 0, np.inf, 0
    skips: list[tuple[Batch, int]] = []
    step = pace.share
    if not any(b.count for b in batches):
        _refresh(beliefs)
        return Settled(True, 0, 0.0, 0, 0, _evidence(system), 0.0, pace.share)
    bounds = [b for b in map(bounds_of, batches) if b is not None]
    room = spreads(bounds, beliefs)
    wide = deviations(beliefs)
    after = _marginals(beliefs)
    while done < sweeps:
        before = after
        for batch in batches:
            batch.error = 0.0
        skips = [(batch, _visited(batch, beliefs, pace)) for batch in order]
        left = sum(n for _, n in skips)
        after = _marginals(beliefs)
        change = _distance(before, after)
        done, skipped = done + 1, skipped + left
        if advance is not None:
            advance()
        # a share of the way leaves the rest of it: what is ahead is judged, not the step
        step = cautious(pace.share, max(b.error for b in batches))
        if change > tolerance * step:
            pace.saw(change, _moved(before, after))
        # beliefs that rest while messages are open have not settled: shorter moves may yet be proper
        elif not left or (change == 0.0 and pace.is_slowest):
            break
        else:
            pace.shorten()
    _refuse_impossible(system)
    error = max((b.error for b in batches), default=0.0)
    settled = bool(change <= tolerance * step and not left)
    total = np.nan if left and not settled else _evidence(system)
    if not settled or np.isnan(total) or are_squeezed(room, spreads(bounds, beliefs)):
        _refuse_contradictory(bounds)
    if left and change <= tolerance:  # at rest, without the messages that are open
        _refuse_endless(system, [b.name for b, n in skips if n], wide)
    silent = _silent([b for b, n in skips if n]) if left else {}
    return Settled(
        settled, done, float(change), skipped, left, total, error, pace.share, silent=silent
    )


def pass_once(system: System) -> Settled:
    """Every factor visited once, one after the other, in the order of declaration."""
    beliefs, skipped = system.beliefs, 0
    for batch in system.batches:
        for k in range(batch.count):
            skipped += batch.visit(beliefs, 1.0, np.array([k])).skipped
    _refuse_impossible(system, at_all=True)
    _refuse_contradictory([b for b in map(bounds_of, system.batches) if b is not None])
    met = system.log_scale + beliefs.log_total + sum(float(b.logs.sum()) for b in system.batches)
    total = np.nan if skipped else _evidence(system)
    error = max((b.error for b in system.batches), default=0.0)
    silent = _silent(system.batches) if skipped else {}
    untold = _untold(system)
    return Settled(not skipped, 1, 0.0, skipped, skipped, total, error, 1.0, met, silent, untold)


# ---- private ------------------------------------------------------------------------------------


def _silent(batches: Sequence[Batch]) -> dict[str, int]:
    """How many factors have never sent a message, by node."""
    found: dict[str, int] = {}
    for batch in dict.fromkeys(batches):
        if not batch.k or batch.is_prior:
            continue
        sent = batch.precision.any(axis=(-2, -1)) | batch.linear.any(axis=-1)
        count = int((~sent).sum())
        if count:
            found[batch.name] = found.get(batch.name, 0) + count
    return found


def _untold(system: System) -> tuple[str, ...]:
    """Nodes whose every message from others is flat: what could tell of them was taken in too late."""
    names = {place: name for (name, _), place in system.places.items()}
    heard: dict[str, bool] = {}
    for batch in system.batches:
        for edge, table in zip(batch.edges, batch.tables, strict=True):
            said = np.ptp(table, axis=-1) > _TINY
            for at, is_said in zip(edge.at.tolist(), said.tolist(), strict=True):
                name = names[edge.group, at]
                if name != batch.name:
                    heard[name] = heard.get(name, False) or is_said
        if isinstance(batch, ConjugateBatch):
            for name, kept in system.kept.items():
                mine = (kept.field == batch.field) & np.isin(batch.at, kept.rows)
                if name != batch.name and np.any(mine):
                    said = np.abs(batch.sites[mine]).max() > _TINY
                    heard[name] = heard.get(name, False) or bool(said)
    above = target_of(system.target.problem).chain
    return tuple(name for name in above if not heard.get(name, True))


def _visited(batch: Batch, beliefs: Beliefs, pace: Pace) -> int:
    """Visit all factors, rows of one number in as many parts as the pace says; how many were skipped."""
    parts = min(pace.parts, batch.count) if isinstance(batch, LineBatch) else 1
    if parts == 1:
        return batch.visit(beliefs, pace.share).skipped
    groups = (batch.everyone[k::parts] for k in range(parts))
    return sum(batch.visit(beliefs, pace.share, group).skipped for group in groups)


def _is_easy(batches: Sequence[Batch]) -> bool:
    """Whether all that is approximated is one batch of log-concave factors, whose messages are never improper
    (Seeger 2008, JMLR 9, sec. 4)."""
    inexact = [b for b in batches if not b.is_exact]
    return len(inexact) == 1 and getattr(inexact[0].kernel, "is_log_concave", False)


def _refresh(beliefs: Beliefs) -> None:
    for block in beliefs.blocks:
        if len(block.linear):
            block.refreshed()


def _marginals(beliefs: Beliefs) -> list[tuple[np.ndarray, ...]]:
    found: list[tuple[np.ndarray, ...]] = [
        (b.mean.copy(), b.cov.diagonal(0, -2, -1).copy()) for b in beliefs.blocks
    ]
    found += [
        (c.naturals.copy(), c.family.expected(c.naturals), c.naturals) for c in beliefs.families
    ]
    return found + [(f.probabilities,) for f in beliefs.finite]


def _distance(before: list[tuple[np.ndarray, ...]], after: list[tuple[np.ndarray, ...]]) -> float:
    """The root of the symmetric Kullback-Leibler divergence of the marginal that differs most."""
    worst = 0.0
    for one, two in zip(before, after, strict=True):
        if not one[0].size:
            continue
        if len(one) == 2:
            ratio = one[1] / two[1]
            square = (one[0] - two[0]) ** 2
            apart = 0.5 * (ratio + 1.0 / ratio - 2.0) + 0.5 * square * (1.0 / one[1] + 1.0 / two[1])
        elif len(one) == 3:
            apart = ((two[0] - one[0]) * (two[1] - one[1])).sum(axis=-1)
        else:
            p, q = (np.maximum(a[0], _TINY) for a in (one, two))
            apart = ((p - q) * np.log(p / q)).sum(axis=-1)
        most = float(apart.max())  # NaN where any is
        worst = max(worst, np.inf if np.isnan(most) else most)
    return float(np.sqrt(max(worst, 0.0)))


def _moved(before: list[tuple[np.ndarray, ...]], after: list[tuple[np.ndarray, ...]]) -> np.ndarray:
    """Where a sweep went: of numbers in standard deviations, of the rest in what describes it."""
    found = []
    for one, two in zip(before, after, strict=True):
        step = two[0] - one[0]
        found.append((step / np.sqrt(two[1]) if len(one) == 2 else step).ravel())
    return np.concatenate(found)


def _evidence(system: System) -> float:
    beliefs = system.beliefs
    parts = [float(b.constants(beliefs).sum()) for b in system.batches if b.count]
    return system.log_scale + beliefs.log_total + sum(parts)


def _refuse_contradictory(bounds: Sequence[Bounds]) -> None:
    names = contradictory(bounds)
    if names:
        raise ZeroProbabilityError(
            "ExpectationPropagation: the evidence has probability zero: what is said by "
            f"{', '.join(map(repr, names[:6]))} contradicts itself, since no numbers satisfy all of these "
            "comparisons"
        )


def _refuse_endless(system: System, names: Sequence[str], wide: np.ndarray) -> None:
    """Beliefs that narrowed to nothing while factors had no integral with them."""
    now = deviations(system.beliefs)
    for name, x in system.numbers.items():
        at = x.at[x.at >= 0]
        ratio = now[at] / wide[at]
        if (~(ratio > _GONE)).any():
            least = now[at][~(ratio > _GONE)][0]
            factors = ", ".join(map(repr, dict.fromkeys(names)))
            raise UnsupportedError(
                f"ExpectationPropagation: what is believed of node {name!r} narrows without end (its "
                f"standard deviation has come to {least:.2g}), and factors of {factors} have no integral "
                "with it. Either the posterior has no integral, or next to all of its mass at the edge of a "
                "support, as with a scale whose readings are all equal: give the scale a prior that vanishes "
                "there (LogNormal, InverseGamma), or the readings the noise of their rounding. Or messages "
                "do not find it, under very vague priors above all: give narrower ones, or take Gibbs"
            )


def _refuse_impossible(system: System, at_all: bool = False) -> None:
    """Tables that contradict each other give every state of a variable no probability."""
    for finite in system.beliefs.finite:
        if finite.logs.size and (finite.logs.max(axis=-1) < NOTHING).any():
            raise ZeroProbabilityError("ExpectationPropagation: the evidence has probability zero")
    for batch in system.batches:
        if (batch.logs < batch.floor).any():
            raise ZeroProbabilityError(
                f"ExpectationPropagation: the evidence has probability zero at node {batch.name!r}"
            )
