"""Smoothing of what marginalised filters leave: paths of what is sampled, and beliefs given each of them.

Backward simulation draws paths of the sampled nodes alone. A particle of slice k is drawn with its weight
times the density of the path drawn after it, of which rows are a part,

    p(u_k | u_{k+1:T}, y) ~ w_k  p(u_{k+1} | u_k)  E[ p(y_{k+1:T} | m_k, u_{k:T}) ],

where the mean is by the particle's belief about the numbers m_k that the next slice reads: what is integrated
out stays so (``messages``). Every path then has its own Kalman filter forwards, whose beliefs with the
messages of the rows after them are smoothed ones: the answer is a mixture of Gaussians, one for each path.
Draws of what is integrated out, which stand beside it, are joint ones over all slices.

Where particles are many, a path tries some of them by weight, and the ancestor that the filter knows of what
it has drawn after them: a Gibbs step over which of these it is, as in ``particles.backward``.

Fixed lags need no such draws: each particle's ancestors are its path.

References
----------
Whiteley, Andrieu and Doucet (2010), Efficient Bayesian inference for switching state-space models using
discrete particle Markov chain Monte Carlo methods; Särkkä, Bunch and Godsill (2012), A backward-simulation
based Rao-Blackwellized particle smoother for conditionally linear Gaussian models, SYSID 45; Lindsten, Bunch,
Särkkä, Schön and Godsill (2016), IEEE J. Sel. Topics Signal Process. 10; Dau and Chopin (2023), On backward
smoothing algorithms, Ann. Statist. 51 (moves from the ancestor).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from bayesmc.categorical import pick
from bayesmc.dbn import PREVIOUS, Series, Slices
from bayesmc.engines.marginal.gaussians import Gaussians, nothing, take_in
from bayesmc.engines.marginal.messages import (
    Message,
    combined,
    log_evidence,
    pulled,
    sizes_of,
    uninformative,
)
from bayesmc.engines.marginal.reading import Values
from bayesmc.engines.marginal.split import Split, layouts_of
from bayesmc.engines.marginal.step import seen_of
from bayesmc.engines.marginal.tables.afterwards import drawn_afterwards
from bayesmc.engines.marginal.tables.backwards import (
    Along,
    along,
    log_evidence_of,
    nothing_after,
    pulled_tables,
    told_by,
)
from bayesmc.engines.marginal.tables.step import Known
from bayesmc.engines.particles.layers import carried_on
from bayesmc.engines.particles.smc import Layout, Particles, evenly_weighted
from bayesmc.engines.slice_steps import plates_apart
from bayesmc.network.forward import Compute, Pass, Step, WeighDrawn
from bayesmc.resampling import systematic

#: particles that a path tries, besides the one that its filter came from: of 32, errors of paths that never
#: forget (Kim's model of GNP) were 1.33 times those that are stated, of 96 1.07, of all .85
_TRIED = 96
#: particles up to which all are tried
_ALL = 128
#: pairs of paths and particles that are looked at at once
_PAIRS = 1 << 16


class MarginalBackward:
    """Draws paths of what is sampled backwards, and gives the beliefs about the rest given each.

    Parameters
    ----------
    step : MarginalStep
        The filter's.
    few : bool
        Try some particles alone where there are many.

    Attributes
    ----------
    positions : list of ndarray
        Of the paths drawn last, in each slice's particles, shape ``(paths,)``.
    """

    def __init__(self, step: Any, few: bool = True) -> None:
        self.step, self.few = step, few
        self.positions: list[np.ndarray] = []

    def trajectories(
        self, filtered: Sequence[Particles], series: Series, count: int, rng: np.random.Generator
    ) -> list[Particles]:
        """So many paths, as particles of equal weights in each slice."""
        paths = _Paths(self.step, filtered, series)
        index = rng.permuted(systematic(filtered[-1].weights, count, rng))
        positions = [index]
        here = filtered[-1]
        values, message = paths.taken(paths.sampled(here), index), paths.uninformative(count)
        drawn, messages = [values], [message]
        for k in range(len(filtered) - 2, -1, -1):
            index = self._drawn(paths, k, values, message, _parents(filtered[k + 1], index), rng)
            before = paths.taken(paths.sampled(filtered[k]), index)
            message, _ = paths.pulled(k, before, values, message)
            values = before
            positions.append(index)
            drawn.append(values)
            messages.append(message)
        self.positions = positions[::-1]
        return paths.believed(drawn[::-1], messages[::-1], rng)

    # ---- private -------------------------------------------------------------------------------

    def _drawn(
        self,
        paths: _Paths,
        k: int,
        values: Mapping[str, np.ndarray],
        message: _Later,
        parents: np.ndarray,
        rng: np.random.Generator,
    ) -> np.ndarray:
        """For every path a particle of the k-th slice."""
        weights, count = paths.filtered[k].weights, len(parents)
        everyone = not self.few or len(weights) <= _ALL
        tried = len(weights) if everyone else _TRIED + 1
        found, step = np.empty(count, dtype=np.intp), max(1, _PAIRS // tried)
        for low in range(0, count, step):
            rows = np.arange(low, min(low + step, count))
            if everyone:
                which = np.broadcast_to(np.arange(tried), (len(rows), tried))
                otherwise = own = paths.filtered[k].log_weights
            else:
                some = pick(weights, rng.random(len(rows) * _TRIED)).reshape(-1, _TRIED)
                which = np.concatenate([parents[rows, None], some], axis=1)
                own, otherwise = np.zeros(tried), np.where(np.arange(tried) == 0, 0.0, -np.inf)
            log = own + paths.log_after(k, which, rows, values, message)
            top = log.max(axis=1, keepdims=True)
            log = np.where(
                top > -np.inf, log - top, otherwise - otherwise.max()
            )  # the filter's word
            shares = np.exp(log).cumsum(axis=1)
            at = (shares <= rng.random((len(rows), 1)) * shares[:, -1:]).sum(axis=1)
            found[rows] = np.take_along_axis(which, np.minimum(at, tried - 1)[:, None], 1)[:, 0]
        return found


def why_not_backwards(slices: Slices, split: Split) -> str | None:
    """Why paths cannot be drawn backwards with the rest integrated out, or None."""
    apart = plates_apart(slices)
    if apart:
        return f"elements of plate {apart[0]!r} are filtered separately"
    if split.linearised:
        return f"{min(split.linearised)!r} is linearised at each particle's own mean, which paths change"
    carried = carried_on(slices, split.seen) - layouts_of(slices, split.inner, ())[1].unknown
    if carried:
        return f"{min(carried)!r} is computed from sampled nodes of the slice before, and read by the next"
    return None


# ---- private ------------------------------------------------------------------------------------


class _Later(NamedTuple):
    """What rows after a slice say of it, for every path: of its numbers, and of finite nodes."""

    numbers: Message
    states: tuple[np.ndarray, ...]

    def taken(self, index: np.ndarray) -> _Later:
        """Of some paths."""
        return _Later(self.numbers.taken(index), tuple(m.take(index, axis=0) for m in self.states))


class _Paths:
    """What there is between slices of a filter.

    Parameters
    ----------
    step : MarginalStep
    filtered : sequence of Particles
        Of slices in a row.
    series : Series
    """

    def __init__(self, step: Any, filtered: Sequence[Particles], series: Series) -> None:
        self.step, self.filtered, self.series = step, filtered, series
        self._crossing: dict[Any, tuple[list[Step], bool]] = {}

    def uninformative(self, count: int) -> _Later:
        """What is said to the last slice."""
        layout, tables = self.filtered[-1].inner.layout, self.step.tables
        own = () if tables is None else nothing_after(tables, count)
        return _Later(uninformative(count, layout.lead, layout.carried), own)

    def sampled(self, here: Particles) -> dict[str, np.ndarray]:
        """Values that particles of a slice have, but for those that are integrated out."""
        split, out = self.step.split, set(here.inner.layout.rows)
        if split.tables is not None:
            out |= split.waiting - {*split.inner}
        return {n: v for n, v in here.values.items() if n not in out}

    def taken(self, values: Mapping[str, np.ndarray], index: np.ndarray) -> dict[str, np.ndarray]:
        """Values of some draws; what all agree on stays as it is."""
        return {n: v.take(index, axis=0) if self._own(n, v) else v for n, v in values.items()}

    def log_after(
        self,
        k: int,
        which: np.ndarray,
        rows: np.ndarray,
        values: Mapping[str, np.ndarray],
        message: _Later,
    ) -> np.ndarray:
        """Log density of what paths have after the k-th slice, given particles of that one.

        Parameters
        ----------
        which : ndarray of int, shape (rows, tried)
            Particles.
        rows : ndarray of int, shape (rows,)
            Paths.
        values, message
            Of all paths, in the slice after the k-th.
        """
        here = self.filtered[k]
        before = self.sampled(here)
        steps, reads = self._between(k + 1, before)
        log: Any = 0.0
        if steps:
            known = dict(self.step.sampling.known(self.series.row(k + 1)))
            known |= {n: v[rows, None] if self._own(n, v) else v for n, v in values.items()}
            known |= {
                n + PREVIOUS: v[which] if self._own(n, v) else v
                for n, v in before.items()
                if n in self.step.slices.interface
            }
            state = Pass(np.random.default_rng(0), which.shape, known)
            for step in steps:
                step(state)
            log = np.asarray(state.log_weight, dtype=float)
        pairs, flat = np.repeat(rows, which.shape[1]), which.reshape(-1)
        if reads:  # what is said depends on the particle it is said to
            now, of = self.taken(values, pairs), np.arange(len(pairs))
            said, own = self.pulled(k, self.taken(before, flat), now, message.taken(pairs))
            found = own + log_evidence(said.numbers, of, here.inner, flat)
        else:
            of = np.repeat(np.arange(len(rows)), which.shape[1])
            now = self.taken(values, rows)
            said, _ = self.pulled(k, before, now, message.taken(rows))
            found = log_evidence(said.numbers, of, here.inner, flat)
        found = found.sum(axis=tuple(range(1, found.ndim)))
        if here.tables is not None:
            found = found + log_evidence_of(said.states, of, here.tables, flat)
        return np.broadcast_to(found.reshape(which.shape) + log, which.shape)

    def pulled(
        self,
        k: int,
        before: Mapping[str, np.ndarray],
        values: Mapping[str, np.ndarray],
        message: _Later,
    ) -> tuple[_Later, np.ndarray]:
        """What is said to the k-th slice, given what is said to the next and values of both."""
        place, row = self._place(k + 1), self.series.row(k + 1)
        count = len(message.numbers.vector)
        known = self._values(place, row, before, values, count)
        pattern, target, _ = seen_of(place.layout, row)
        found = place.reader.read(known)
        numbers, own = pulled(
            message.numbers, place.layout, pattern, found, target, sizes_of(self.filtered[k].inner)
        )
        if self.step.tables is None:
            return _Later(numbers, ()), own
        told = told_by(self.step.tables, row, self._known(row, before, values, count))
        return _Later(numbers, pulled_tables(told, message.states)), own

    def believed(
        self,
        drawn: Sequence[Mapping[str, np.ndarray]],
        messages: Sequence[_Later],
        rng: np.random.Generator,
    ) -> list[Particles]:
        """Smoothed beliefs given each path, and one draw of them for all slices."""
        count, found = len(messages[0].numbers.vector), []
        layout = Layout(count, (), ())
        filtered: Gaussians | None = None
        joint: Gaussians | None = None
        tables: Along | None = None
        past: dict[str, np.ndarray] = {}
        for k, values in enumerate(drawn):
            row, place = self.series.row(k), self._place(k)
            own = self._values(place, row, drawn[k - 1] if k else {}, values, count)
            pattern, target, given = seen_of(place.layout, row)
            coefficients = place.reader.read(own)
            start = nothing(place.layout, count)
            filtered, alone = (
                take_in(
                    place.layout,
                    pattern,
                    start if before is None else before.carried(),
                    coefficients,
                    target,
                    given,
                ).chosen(None)
                for before in (filtered, joint)
            )
            smoothed, sample = (
                combined(messages[k].numbers, filtered),
                combined(messages[k].numbers, alone).drawn(rng),
            )
            joint = _point(smoothed, sample)
            whole, states = {**values, **smoothed.values_of(sample)}, None
            if self.step.tables is not None:
                tables, more = self._finite(k, (past, whole), messages[k].states, tables, rng)
                whole, states = {**whole, **more}, tables.smoothed
            past = {n + PREVIOUS: v for n, v in whole.items()}
            made = evenly_weighted(self.filtered[k].t, whole, layout)
            found.append(made._replace(inner=smoothed, tables=states))
        return found

    # ---- private -------------------------------------------------------------------------------

    def _finite(
        self,
        k: int,
        values: tuple[Mapping[str, np.ndarray], Mapping[str, np.ndarray]],
        message: tuple[np.ndarray, ...],
        before: Along | None,
        rng: np.random.Generator,
    ) -> tuple[Along, dict[str, np.ndarray]]:
        """Tables of a slice, and a draw of what has them and of what waits for it, given values of two."""
        step, row = self.step, self.series.row(k)
        past, now = values
        count = len(message[0])
        stems = {n.removesuffix(PREVIOUS): v for n, v in past.items()}
        known = self._known(row, stems, now, count)
        found = along(told_by(step.tables, row, known), message, before, step.tables, rng)
        nodes = [step.slices.first[n] for n in step.tables.plan.names]
        drawn = found.smoothed.values(found.codes, nodes)
        late = step.tables.left_out(not k) - step.tables.plan.names
        drawn |= {n: row.seen[n].value for n in late if n in row.seen and row.seen[n].mask is None}
        every = {**known.values, **past, **now, **drawn}
        return found, drawn | drawn_afterwards(step.slices, row, late, every, count, rng)

    def _known(
        self,
        row: Any,
        before: Mapping[str, np.ndarray],
        values: Mapping[str, np.ndarray],
        count: int,
    ) -> Known:
        """Values that tables may read, of a slice and the one before."""
        found = dict(self.step.sampling.known(row))
        found |= {n + PREVIOUS: v for n, v in before.items() if n in self.step.slices.interface}
        found |= values
        ranks = self.step.ranks
        own = {n for n, v in found.items() if v.ndim == ranks.get(n.removesuffix(PREVIOUS), -1)}
        return Known(found, frozenset(own), count)

    def _own(self, name: str, value: np.ndarray) -> bool:
        """Whether particles have values of their own of a node."""
        return value.ndim == self.step.ranks[name]

    def _place(self, k: int) -> Any:
        inner = self.filtered[k - 1].inner if k else None
        return self.step.place(self.series.row(k), inner)

    def _values(
        self,
        place: Any,
        row: Any,
        before: Mapping[str, np.ndarray],
        values: Mapping[str, np.ndarray],
        count: int,
    ) -> Values:
        """What coefficients of a slice are read with."""
        plain, own = dict(self.step.sampling.known(row)), dict[str, np.ndarray]()
        taken = {n + PREVIOUS: v for n, v in before.items() if n in self.step.slices.interface}
        taken = {n: v for n, v in taken.items() if n in place.reader.needed}
        now = {n: v for n, v in values.items() if n in place.layout.certain}
        for name, value in {**taken, **now}.items():
            (own if self._own(name.removesuffix(PREVIOUS), value) else plain)[name] = value
        return Values(plain, own, count)

    def _between(self, k: int, before: Mapping[str, np.ndarray]) -> tuple[list[Step], bool]:
        """Factors of sampled nodes that read the slice before the k-th; whether coefficients read it."""
        place, interface = self._place(k), self.step.slices.interface
        entering = frozenset(n for n, v in before.items() if n in interface and self._own(n, v))
        key = id(place), entering
        if key not in self._crossing:
            layout, reached = place.layout, {n + PREVIOUS for n in entering}
            reads = bool(place.reader.leaves & reached)
            if self.step.tables is not None:
                row = self.series.row(k)
                reads |= any(s.reads_before(row, entering) for s in self.step.tables.steps)
            steps: list[Step] = []
            for name in layout.order:
                node = layout.model[name]
                if not reached & set(node.parents):
                    continue
                if name in layout.computed:
                    steps.append(Compute(layout.model, node))
                    reached.add(name)
                elif name in layout.certain:
                    steps.append(WeighDrawn(layout.model, node, ()))
            self._crossing[key] = steps, reads
        return self._crossing[key]


def _point(like: Gaussians, values: np.ndarray) -> Gaussians:
    """Beliefs without doubt."""
    factors = np.zeros((1, *like.factors.shape[1:]))
    which = np.zeros(len(values), dtype=np.intp)
    return like._replace(mean=values, factors=factors, which=which, over=None)


def _parents(here: Particles, index: np.ndarray) -> np.ndarray:
    return index if here.ancestors is None else here.ancestors[index]
