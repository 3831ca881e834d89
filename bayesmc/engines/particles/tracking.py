"""How far a particle filter may be off, followed slice by slice beside the particles.

Families tell what the particles have met (``genealogy``). What they may have missed is told by three more:
states that next to no particle has (``rare_states``), the drift of means, and what has been lost for good.
Nothing here touches the particles, or the numbers that they are drawn with.

*Drift.* By how much a row moves a mean is, under the model, a martingale difference: the variance of such
moves is what the rows take from the variance of the belief, whatever the densities (the law of total
variance). Moves that add up to far more come from rows that ask for particles that are not there: a jump of
the state that no particle has made, or a model that is wrong.

*Loss.* Where a slice rests on next to no particles, or its families show that particles are missing, means
are as wrong as the evidence, and so are those of later slices: whoever is lost in one of two modes stays
there, and nothing that is left says so. So the errors of means are infinite from there on, until what is
random in the transition could have carried particles over all that they stood on before. How far that is, is
measured: by what the descendants of one particle differ by after a few slices. Nodes that stay where they are
(parameters, a rare switch) are never found again.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from bayesmc.dbn import Row
from bayesmc.engines.particles.blocks import Block
from bayesmc.engines.particles.families import LONGEST, Drift, Families, Lost
from bayesmc.engines.particles.filter_step import FilterStep
from bayesmc.engines.particles.genealogy import SEEMS, begun, followed, rested, unremarkable
from bayesmc.engines.particles.smc import Layout, Particles
from bayesmc.engines.particles.sums import MANY, NUMBERS, Moments, Summing, Tally
from bayesmc.network import CompiledNode
from bayesmc.resampling import ssp, stratified, systematic

#: weight of what has been at each further slice: about ten are looked at together; and that of the largest
#: sum, which is kept for longer, as families are
FADING, KEPT = 0.9, 0.995
#: sum of moves, in units of their spread, from which on particles are missing
IS = 4.5
#: variance of moves below which nothing has moved
LEAST = 0.05
#: slices from one measurement of what is random to the next: a few, since lags and speeds pass noise on later
STRETCH = 4
#: variance of what is random since, over that of the particles when they were lost, that leads back
BACK = 4.0
#: share of the belief in states without particles, over that of all particles, up to which it is an error
LEFT_OUT = 0.1

#: where nothing was lost, without plates
_NOWHERE = np.asarray(False)
_FADED = np.array([FADING, FADING**2]).reshape(2, 1, 1)


class Tracker:
    """Follows the families of the particles that a step of sequential Monte Carlo makes.

    Parameters
    ----------
    step : FilterStep
    """

    def __init__(self, step: FilterStep) -> None:
        #: large arrays of blocks, which are nobody's once they have been followed
        self.room: dict[Any, np.ndarray] = {}
        self.layout = step.layout
        read = map(step.slices.later.__getitem__, step.slices.interface)
        nodes = [n for n in read if not n.is_object]
        self.sight = Sight([n for n in nodes if n.name not in step.too_wide], step.layout)
        finite = any(step.slices.later[n].domain for n in step.slices.stochastic)
        self.scouting = step.scouting() if finite else None
        blind = step.is_guided or step.first_stage is not None or step.injection is not None
        compass = Compass([n for n in nodes if n.name not in step.integrated], step.layout)
        self.compass = compass if compass.nodes and not blind else None
        # after a first stage, what a family should have is not what its weight says
        self.steady = step.scheme in (stratified, systematic, ssp) or step.first_stage is not None
        plain = self.scouting is None and not step.integrated
        self._is_plain = self.steady and not step.layout.apart and plain

    def after(
        self,
        families: Families | None,
        earlier: Particles | None,
        block: Block,
        rows: Sequence[Row],
    ) -> list[Families]:
        """The families in each slice of a block, given those of the slice before (None before the first)."""
        drift = None if families is None else families.drift
        drifts: Sequence = [None] * len(rows)
        if self.compass is not None:
            drifts = self.compass.after(drift, earlier, block)
        found = []
        for now, row, drift in zip(block.slices, rows, drifts, strict=True):
            families = self.followed_by(families, earlier, now, row, drift)
            found.append(families)
            earlier = now
        return found

    def after_one(
        self, families: Families | None, earlier: Particles | None, now: Particles, row: Row
    ) -> Families:
        """The same in one slice."""
        compass, drift = self.compass, None if families is None else families.drift
        if compass is not None and compass.is_alone:
            drift = compass.after_one(drift, earlier, now)
            return self.followed_by(families, earlier, now, row, drift)
        block = Block(self.layout, [now], room=self.room)
        return self.after(families, earlier, block, [row])[0]

    def summing(self, nodes: Sequence[CompiledNode]) -> Summing | None:
        """What takes the sums of slices with these nodes, where these say all; else None."""
        every = list({n.name: n for n in (*nodes, *self.sight.nodes)}.values())
        few = sum(math.prod(n.value_shape) for n in every) <= NUMBERS
        some = few and self.layout.particles >= MANY and self.is_summed(every)
        return Summing(every, self.layout.particles) if some else None

    def is_summed(self, nodes: Iterable[CompiledNode]) -> bool:
        """Whether sums over particles say all of slices with these nodes."""
        every = (*nodes, *self.sight.nodes)
        return self._is_plain and all(n.domain is None and n.angles is None for n in every)

    def tally(
        self,
        families: Families | None,
        earlier: Particles | None,
        now: Particles,
        row: Row,
        summing: Summing,
    ) -> Tally:
        """A slice by its sums, given the families of the slice before."""
        drift, moments = None, summing.moments(earlier, now)
        if self.compass is not None:
            drift = None if families is None else families.drift
            drift = self.compass.after_moments(drift, moments)
        return summing.tally(now, moments, self.followed_by(families, earlier, now, row, drift))

    def followed_by(
        self,
        families: Families | None,
        earlier: Particles | None,
        now: Particles,
        row: Row,
        drift: Drift | None,
    ) -> Families:
        gained: Any = 0.0
        if self._is_plain and families is not None and earlier is not None:
            found = self._quickly(families, earlier, now, drift)
            if found is not None:
                return found
        if families is None or earlier is None:
            families = begun(now, self.layout)
        else:
            families, gained = followed(families, earlier, now, self.steady)
        missing, scouts = self._missing(families, now, drift), None
        if self.scouting is not None and self.scouting.nodes:
            scouts = self.scouting.after(families.scouts, earlier, now, row)
            missing = missing | (scouts is not None and scouts.share > LEFT_OUT)
        lost, settled = families.lost, families.settled
        if missing is not False or type(gained) is not float:
            missing = np.asarray(missing | np.isinf(gained))
            settled = np.where(missing, np.inf, settled + gained)
        if missing is not False or lost is not None:
            lost = self.sight.after(lost, np.asarray(missing), now)
        return families._replace(settled=settled, lost=lost, scouts=scouts, drift=drift)

    # ---- private -------------------------------------------------------------------------------

    def _quickly(
        self, families: Families, earlier: Particles, now: Particles, drift: Drift | None
    ) -> Families | None:
        """The same where nothing is to be said about a slice, in few calls; None elsewhere."""
        lost = families.lost
        if now.rejuvenated is not False or self._missing(families, now, drift) is not False:
            return None
        moved = unremarkable(families, earlier, now)
        if moved is None:
            return None
        if lost is not None:
            lost = self.sight.after(lost, _NOWHERE, now)
        _, shares, kept, _, born, settled, _, _, _, doubted = families
        bounds, explained = moved
        return Families(bounds, shares, kept, explained, born, settled, lost, None, drift, doubted)

    def _missing(self, families: Families, now: Particles, drift: Drift | None) -> Any:
        """Whether a slice rests on next to none of its particles, or rows go on pulling the same way."""
        missing: Any = ~enough if isinstance(enough := rested(now), np.ndarray) else not enough
        if drift is not None and drift.largest > SEEMS:
            doubted = families.doubted > now.t - LONGEST
            missing = missing | (drift.worst > drift.limit) | ((drift.worst > SEEMS) & doubted)
        return missing


class Sight:
    """Follows what a filter has lost.

    Parameters
    ----------
    nodes : sequence of CompiledNode
        Those that the next slice reads.
    layout : Layout
    """

    def __init__(self, nodes: Any, layout: Layout) -> None:
        self.nodes: tuple[CompiledNode, ...] = tuple(nodes)
        self.layout = layout

    def after(self, lost: Lost | None, where: np.ndarray, now: Particles) -> Lost | None:
        """What is lost after a slice in which some elements ``where`` were, shape (*apart)."""
        if lost is not None:
            lost = self._followed(lost, now)
        if not where.any():
            return lost
        fresh = np.broadcast_to(where, self.layout.lead)
        wide = tuple(self._spread(node, now) for node in self.nodes)
        if lost is None:
            return Lost(fresh, wide, tuple(np.zeros_like(w) for w in wide), now.t)
        rows, still = fresh.reshape(-1, 1), lost.where.reshape(-1, 1)
        both = [(w, np.maximum(w, old), old) for w, old in zip(wide, lost.wide, strict=True)]
        wide = tuple(np.where(rows, np.where(still, more, w), old) for w, more, old in both)
        gone = tuple(np.where(rows, 0.0, g) for g in lost.gone)
        return lost._replace(where=lost.where | fresh, wide=wide, gone=gone)

    def _followed(self, lost: Lost, now: Particles) -> Lost | None:
        """The same one slice later; None where all is found."""
        if now.rejuvenated is not False:
            lost = lost._replace(where=lost.where & ~np.asarray(now.rejuvenated))
        roots = lost.roots
        if now.ancestors is not None:
            chosen = now.ancestors
            if roots is None or chosen.ndim == 1:
                roots = chosen if roots is None else roots.take(chosen)
            else:
                roots = np.take_along_axis(roots, chosen, axis=0)
        if now.t < lost.since + STRETCH or roots is None:
            return lost._replace(roots=roots)
        moved = (self._spread(node, now, roots) for node in self.nodes)
        gone = tuple(g + m for g, m in zip(lost.gone, moved, strict=True))
        where = lost.where.copy().reshape(-1)
        back = np.ones_like(where)
        for wide, own in zip(lost.wide, gone, strict=True):
            back &= (own >= BACK * wide).all(axis=1)
        where &= ~back
        if not where.any():
            return None
        return Lost(where.reshape(lost.where.shape), lost.wide, gone, now.t)

    def _spread(
        self, node: CompiledNode, now: Particles, roots: np.ndarray | None = None
    ) -> np.ndarray:
        """Variances of a node's numbers, shape (many, numbers); with roots, within what descends from each.

        The particles count alike: those that a row has left without weight were there, too.
        """
        many = math.prod(self.layout.lead)
        value, labels = now.values[node.name], node.domain is not None
        if value.ndim == len(node.value_shape):
            return np.zeros((many, 1))
        at = [1 + node.plates.index(p) for p in self.layout.apart if p in node.plates]
        if len(at) < len(self.layout.apart):
            return np.zeros((many, 1))
        n = len(value)
        first = np.moveaxis(value, at, range(1, 1 + len(at))) if at else value
        rows = first.reshape(n, many, -1).astype(float, copy=False)
        if roots is None:
            if labels:
                return np.ones(rows.shape[1:])
            off = rows - np.add.reduce(rows) / n
            if off.size == n:  # without an axis it is faster
                return np.vecdot(off.reshape(n), off.reshape(n)).reshape(1, 1) / n
            return np.einsum("nij,nij->ij", off, off) / n
        found = np.empty(rows.shape[1:])
        for k, own in enumerate(roots.reshape(n, many).T):
            found[k] = _within(rows[:, k], own, labels)
        return found


class Compass:
    """Follows the moves of the means of nodes.

    Parameters
    ----------
    nodes : iterable of CompiledNode
        Of which those that are plain numbers are looked at.
    layout : Layout
    """

    def __init__(self, nodes: Iterable[CompiledNode], layout: Layout) -> None:
        self.layout = layout
        self.nodes = tuple(
            n
            for n in nodes
            if n.domain is None and n.angles is None and set(layout.apart) <= set(n.plates)
        )
        elements = math.prod(layout.lead)
        self.counts = [math.prod(n.value_shape) // elements for n in self.nodes]
        every = max(sum(math.prod(n.value_shape) for n in self.nodes), 1)
        self.limit = math.sqrt(IS**2 + 2.0 * math.log(every))
        #: there is one number, without plates
        self.is_alone = not layout.lead and self.counts == [1]
        self.even = np.ones(layout.particles)

    def after(
        self, drift: Drift | None, earlier: Particles | None, block: Block
    ) -> Sequence[Drift | None]:
        """Moves after each slice of a block, whose particles have been drawn from the model itself.

        A slice whose particles were drawn anew makes a block of its own.
        """
        if block.slices[0].rejuvenated is not False:
            return [None]
        counts = zip(self.nodes, self.counts, strict=True)
        parts = [_moves(block, node, count, earlier) for node, count in counts]
        steps = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=-1)
        if drift is not None:
            steps[:, 0] += _FADED * drift.moves
        if len(steps[0]) > 1:
            faded, kept = _fading(len(steps[0]))
            steps /= faded
            np.add.accumulate(steps, axis=1, out=steps)
            steps *= faded
        worst = np.abs(steps[0])
        worst /= np.sqrt(steps[1] + LEAST)
        worst = worst[..., 0] if worst.shape[-1] == 1 else np.maximum.reduce(worst, axis=-1)
        if drift is not None:
            np.maximum(worst[0], KEPT * np.reshape(drift.worst, -1), out=worst[0])
        if len(worst) > 1:
            worst /= kept
            np.maximum.accumulate(worst, out=worst)
            worst *= kept
        if not self.layout.lead:
            each = worst[:, 0].tolist()
            return [Drift(steps[:, k], own, own, self.limit) for k, own in enumerate(each)]
        largest, worst = worst.max(axis=-1).tolist(), worst.reshape(-1, *self.layout.lead)
        return [Drift(steps[:, k], worst[k], most, self.limit) for k, most in enumerate(largest)]

    def after_moments(self, drift: Drift | None, found: Moments) -> Drift:
        """The same in one slice without plates, by the moments of its few numbers."""
        moves = np.zeros((2, 1, sum(self.counts))) if drift is None else _FADED * drift.moves
        worst, k = 0.0 if drift is None else KEPT * drift.largest, 0
        for node, count in zip(self.nodes, self.counts, strict=True):
            low, high = found.places.get(node.name, (0, 0))
            for at in range(low, high):
                wide, own = found.wide[at], k + at - low
                if wide > 0.0:
                    moves[0, 0, own] -= found.shift[at] / math.sqrt(wide)
                    moves[1, 0, own] += max(1.0 - found.variance[at] / wide, 0.0)
            k += count
        for moved, variance in moves[:, 0].T.tolist():
            worst = max(worst, abs(moved) / math.sqrt(variance + LEAST))
        return Drift(moves, worst, worst, self.limit)

    def after_one(
        self, drift: Drift | None, earlier: Particles | None, now: Particles
    ) -> Drift | None:
        """The same of one number in one slice, by itself, in few calls of NumPy."""
        if now.rejuvenated is not False:
            return None
        moved, variance, worst = 0.0, 0.0, 0.0
        if drift is not None:
            moved, variance = drift.moves.ravel().tolist()
            moved, variance, worst = FADING * moved, FADING**2 * variance, KEPT * drift.largest
        values, n = now.values[self.nodes[0].name].reshape(-1), len(now.weights)
        if len(values) == n:  # not the same for all particles
            prior, total = self.even[:n], float(n)
            if earlier is not None and not now.resampled and len(earlier.weights) == n:
                prior, total = earlier.weights, earlier.total
            off = values - float(prior.dot(values)) / total
            shift, squares = float(now.weights.dot(off)) / now.total, off * off
            wide = float(prior.dot(squares)) / total
            if wide > 0.0:
                left = float(now.weights.dot(squares)) / now.total - shift * shift
                moved += shift / math.sqrt(wide)
                variance += max(1.0 - left / wide, 0.0)
        worst = max(worst, abs(moved) / math.sqrt(variance + LEAST))
        return Drift(np.array([moved, variance]).reshape(2, 1, 1), worst, worst, self.limit)


# ---- private ------------------------------------------------------------------------------------


def _moves(
    block: Block,
    node: CompiledNode,
    count: int,
    earlier: Particles | None,
) -> np.ndarray:
    """What rows do to a node's numbers: moves of means, and the variances that they take away.

    Shape ``(2, slices, elements, numbers)``.
    """
    moments = block.moments(node)
    if moments is None:  # the same for all particles
        return np.zeros((2, len(block.slices), block.elements, count))
    off, n, lead = moments.off, block.particles, block.layout.lead
    shift, wide = np.add.reduce(off, -1), np.vecdot(off, off)
    shift /= n
    wide /= n
    for k, now in enumerate(block.slices):  # where particles bring weights along
        if now.resampled is not True and earlier is not None and len(earlier.weights) == n:
            weights, total = earlier.weights.reshape(n, -1).T[:, None], earlier.total
            part = weights * off[k]
            if lead:
                own, total = ~np.reshape(now.resampled, (-1, 1)), np.reshape(total, (-1, 1))
                np.copyto(shift[k], np.add.reduce(part, -1) / total, where=own)
                np.copyto(wide[k], np.vecdot(part, off[k]) / total, where=own)
            else:
                np.divide(np.add.reduce(part, -1), total, out=shift[k])
                np.divide(np.vecdot(part, off[k]), total, out=wide[k])
        earlier = now
    wide -= shift**2
    found = np.empty((2, *wide.shape))
    np.divide(shift, -np.sqrt(wide), out=found[0])  # whoever filters has silenced warnings
    np.divide(moments.variance, wide, out=found[1])
    np.subtract(1.0, found[1], out=found[1])
    np.maximum(found[1], 0.0, out=found[1])
    some = wide > 0.0
    if not some.all():
        found[:, ~some] = 0.0
    return found


@lru_cache(maxsize=64)
def _fading(slices: int) -> tuple[np.ndarray, np.ndarray]:
    """What is left of each slice's moves, and of their variances, in the last; and of the largest sum."""
    at = np.arange(slices)[:, None]
    found = np.stack([FADING**at, FADING ** (2 * at)])[..., None], KEPT**at
    for array in found:
        array.flags.writeable = False
    return found


def _within(rows: np.ndarray, roots: np.ndarray, labels: bool) -> np.ndarray:
    """Variances of values ``(particles, numbers)`` among those with one root; roots are sorted.

    Of labels, the share that differ from the neighbour.
    """
    same = roots[1:] == roots[:-1]
    free = int(np.count_nonzero(same))
    if free == 0:
        return np.zeros(rows.shape[1])
    if labels:
        return ((rows[1:] != rows[:-1]) & same[:, None]).sum(axis=0) / free
    starts = np.concatenate([[0], np.flatnonzero(~same) + 1])
    counts = np.diff(np.append(starts, len(roots)))
    means = np.add.reduceat(rows, starts, axis=0) / counts[:, None]
    off = rows - means.repeat(counts, axis=0)
    return (off * off).sum(axis=0) / free
