"""Coordinate ascent: sweeps over factors from several starts, the best of which go on until settled."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.mcmc.starts import start_states
from bayesmc.engines.variational.factors import ScatterFactor, ShareFactor, State, TableFactor
from bayesmc.engines.variational.steps import Plan
from bayesmc.errors import BayesmcError
from bayesmc.structure.target import Values

#: how far a bound may fall by rounding, of its size
ROUNDING = 1e-9
#: sweeps that every start has before the best of them go on, and how many go on
_FIRST, _KEPT = 60, 3
#: gain of one sweep, of the bound's size, below which a start is taken to be near its end
_NEAR = 1e-6
#: how far a figure may be from its end, as the rate of its steps tells; steps that may be rounding
_AHEAD, _STILL = 1e-3, 1e-10
#: the smallest of positive numbers to begin with
_LEAST = 1e-200
#: how much coarser than the bound's tolerance that of the figures is
_FIGURES = 10.0


class BoundError(BayesmcError):
    """The bound fell in a sweep: a fault of the library."""


@dataclass(eq=False)
class Ascent:
    """One start, and how far it has come.

    Attributes
    ----------
    state : dict
        Moments.
    bounds : list of float
        The evidence bound after every sweep, up to what is known.
    converged : bool
    """

    plan: Plan
    state: State
    memory: list[dict[str, Any]]
    bounds: list[float] = field(default_factory=list)
    converged: bool = False

    def sweep(self) -> float:
        """Improve every factor once; how much the bound has gained."""
        for step in self.plan.steps:
            step.update(self.state)
        bound = self.plan.bound(self.state)
        gain = np.inf
        if self.bounds:
            check_bound(self.bounds[-1], bound)
            gain = bound - self.bounds[-1]
        self.bounds.append(bound)
        return gain

    def climb(self, sweeps: int, tolerance: float, near: float = 0.0) -> None:
        """Sweep until it has settled, or the gain is below a share of the bound."""
        before, last = None, np.inf
        for _ in range(sweeps):
            gain = self.sweep()
            size = 1.0 + abs(self.bounds[-1])
            if gain <= tolerance * size:  # only then is it worth to look how far figures move
                with np.errstate(all="ignore"):
                    now = [f for factor in self.plan.factors for f in factor.spreads(self.state)]
                if before is not None:
                    moved = _moved(before, now)
                    if moved <= _FIGURES * tolerance and _ahead(last, moved) <= _AHEAD:
                        self.converged = True
                        return
                    last = moved
                before = now
            else:
                before, last = None, np.inf
            if near and gain < near * size:
                return


def check_bound(before: float, now: float) -> None:
    """Raise where a bound has fallen, or is no number.

    Raises
    ------
    BoundError

    Examples
    --------
    >>> from bayesmc.engines.variational.ascent import check_bound
    >>> check_bound(-3.0, -2.5)
    >>> check_bound(-3.0, -3.5)
    Traceback (most recent call last):
    ...
    bayesmc.engines.variational.ascent.BoundError: MeanField: the evidence bound fell ...
    """
    if not now >= before - ROUNDING * max(1.0, 1e-3 * abs(before)):
        small = before - now < 1e-6 * (1.0 + abs(before))
        raise BoundError(
            f"MeanField: the evidence bound fell from {before!r} to {now!r} in a sweep, which no coordinate "
            "ascent does"
            + (
                ": rounding, as of noise that is tiny beside other spreads; give it more, or use Gibbs()"
                if small
                else "; please report this net"
            )
        )


def ascents(plan: Plan, restarts: int, rng: np.random.Generator) -> Iterator[Ascent]:
    """Starts far apart, one by one."""
    with marking_invalid(), np.errstate(all="ignore"):
        values = start_states(plan.target, restarts, rng)
    for k in range(restarts):
        yield started(plan, values, k, rng)


def best_of(
    plan: Plan,
    restarts: int,
    sweeps: int,
    tolerance: float,
    rng: np.random.Generator,
    told: Callable[[int], object] = id,
) -> list[Ascent]:
    """All starts, the best first; it has settled, or used up its sweeps."""
    found = []
    for ascent in ascents(plan, restarts, rng):
        ascent.climb(min(_FIRST, sweeps), tolerance, _NEAR)
        found.append(stored(plan, ascent))
        told(1)
    found.sort(key=lambda a: -a.bounds[-1])
    best, rest = found[:_KEPT], found[_KEPT:]
    for ascent in best:
        restored(plan, ascent)
        if not ascent.converged:
            ascent.climb(sweeps - len(ascent.bounds), tolerance)
        stored(plan, ascent)
    best.sort(key=lambda a: -a.bounds[-1])
    restored(plan, best[0])
    return best + rest


def started(plan: Plan, values: Values, k: int, rng: np.random.Generator) -> Ascent:
    """Moments of the k-th start state; labels are seeded.

    Of the many elements of a plate a few are given to each state, others are left out until tables are
    updated: so components begin about random elements, and the first of the restarts with one element each.
    """
    state: State = {}
    target = plan.target
    own = {n: v if target.is_known(n) else v[k] for n, v in values.items()}
    for factor in plan.factors:  # draws of vague priors may have underflowed
        if isinstance(factor, (ScatterFactor, ShareFactor)) and factor.own.kind != "matrix":
            name = factor.own.name
            own[name] = np.clip(own[name], _LEAST, 1.0 / _LEAST)
    plan.start(state, own)
    for step in plan.steps:
        factor = step.factor
        if isinstance(factor, TableFactor):
            state[factor.table] = _seeded(factor, state[factor.table], k, rng)
            step.tell(state)
    return Ascent(plan, state, [])


def stored(plan: Plan, ascent: Ascent) -> Ascent:
    """What the factors know besides moments is kept with the start."""
    ascent.memory = [dict(f.__dict__) for f in plan.factors]
    return ascent


def restored(plan: Plan, ascent: Ascent) -> None:
    """Make the factors know what they did at the end of a start."""
    for factor, known in zip(plan.factors, ascent.memory, strict=True):
        factor.__dict__.update(known)


# ---- private ------------------------------------------------------------------------------------


def _seeded(factor: TableFactor, table: np.ndarray, k: int, rng: np.random.Generator) -> np.ndarray:
    size, count = factor.size, int(np.prod(factor.shape[1:], dtype=int))
    if count < 2 * size or factor.one_by_one:
        found = rng.dirichlet(np.ones(size), count).T.reshape(factor.shape)
    else:
        each = (1, max(1, count // (4 * size)), 3)[k % 3]
        picked = rng.choice(count, size=(size, min(each, count // size)), replace=False)
        flat = np.zeros((size, count))
        flat[np.arange(size)[:, None], picked] = 1.0
        found = flat.reshape(factor.shape)
    return found if factor.seen is None else np.where(factor.seen, table, found)


def _moved(before: Sequence[np.ndarray], now: Sequence[np.ndarray]) -> float:
    """How far the figure that moved most has moved."""
    with np.errstate(invalid="ignore"):
        return max(
            (
                float(np.nanmax(np.abs(b - a), initial=0.0))
                for a, b in zip(before, now, strict=True)
            ),
            default=0.0,
        )


def _ahead(last: float, moved: float) -> float:
    """How far there is to go if every step is the same share of the one before."""
    if moved <= _STILL:
        return 0.0
    if last == np.inf:
        return np.inf
    rate = moved / last if last > 0 else 1.0
    return moved * rate / (1.0 - rate) if rate < 1.0 else np.inf
