"""The step of a particle filter on a template, with what may go beside it.

As many particles as a belief needs, a share of them drawn where the sensor says, a new start where none is
left, and an error that names the node which no particle explains.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.dbn import Row
from bayesmc.engines.particles.kld import KLD
from bayesmc.engines.particles.rare_states import Scouting
from bayesmc.engines.particles.rejuvenation import Injection
from bayesmc.engines.particles.smc import BLOCK, Layout, Particles, Selection, SMCStep
from bayesmc.engines.slice_steps import SlicePlan, size_of
from bayesmc.errors import DegeneracyError
from bayesmc.network.forward import Pass, Step, WeighDrawn
from bayesmc.shapes import first_index

#: log factors by which particles of the slice before are chosen, from its values and the row
FirstStage = Callable[[Mapping[str, np.ndarray], Row, np.random.Generator], np.ndarray]

#: numbers up to which all particles are one block: a little too large is better than two
WHOLE = 12288


class FilterStep(SMCStep):
    """The step of a particle filter on a template.

    Parameters
    ----------
    plan : SlicePlan
    particles : int
    resample : callable
        ``(weights, draws, rng) -> indices``.
    threshold : float
        Share of the particles below which their effective number has them resampled.
    first_stage : callable, optional
        ``(before, row, rng) -> log factors``, by which particles are chosen for their future.
    rejuvenate : callable, optional
        ``row -> steps`` of a slice that does not look at the slice before, for where all weights vanish.
    kept : sequence of str, optional
        Nodes whose values particles hold besides those that the next slice reads; all by default.
    counts : KLD, optional
        How many particles a slice needs, ``particles`` at most.
    injection : Injection, optional
        Lets a share of the particles begin anew.
    """

    #: nodes that are integrated out, of which particles hold but a draw each
    integrated: frozenset[str] = frozenset()
    #: how many slices back answers are wanted
    lag: int = 0
    #: whether beliefs must be about all of a slice together, as what goes back over slices takes them
    whole: bool = False
    #: nodes of so many numbers that drawing them all costs more than all the rest: rows are not held against
    #: some that are drawn then, and what is lost is told by the other nodes
    too_wide: frozenset[str] = frozenset()

    def __init__(
        self,
        plan: SlicePlan,
        particles: int,
        resample: Callable[..., np.ndarray],
        threshold: float,
        first_stage: FirstStage | None = None,
        rejuvenate: Callable[[Row], Sequence[Step]] | None = None,
        kept: Sequence[str] | None = None,
        counts: KLD | None = None,
        injection: Injection | None = None,
    ) -> None:
        slices, numbers = plan.slices, max(size_of(plan.slices), 1)
        block = block_of(particles, numbers)
        lead = tuple(slices.first.sizes[p] for p in plan.apart)
        nodes = {n: slices.later[n] for n in slices.dynamic}
        super().__init__(
            Layout(particles, plan.apart, lead, block), nodes, slices.interface,
            slices.dynamic if kept is None else kept, resample, threshold,
        )  # fmt: skip
        self.plan, self.slices, self.is_guided = plan, slices, plan.guided
        self.steps, self.known = plan.steps, plan.known  # type: ignore[method-assign]
        self.first_stage, self.rejuvenate = first_stage, rejuvenate
        self.counts, self.injection = counts, injection
        #: makes the particles of a slice, or None where the plain steps must
        self.machine: Any = None

    def __call__(self, earlier: Particles | None, row: Row, rng: np.random.Generator) -> Particles:
        before, selection = self.chosen(earlier, row, rng)
        if self.machine is not None:
            made: Particles | None = self.machine(row, before, selection, rng)
            if made is not None:
                return made
        values, log = self.propagated(self.steps(row), row, before, selection, rng)
        averages, injected = None, 0
        if self.injection is not None and earlier is not None:
            passed = values, log
            mixed = self.injection.mixed(row, before, earlier, selection, passed, rng)
            (values, log, selection, injected), averages = mixed, earlier.averages
        found = self.weighted(row, values, log, selection)
        if not has_weight(found) and self.rejuvenate is not None:
            steps = self.rejuvenate(row)
            found = self._renewed(steps, row, before, found, selection, rng)
        if not has_weight(found):
            raise self._degenerate(row, before, found.values, selection)
        if self.injection is None:
            return found
        if row.seen:
            averages = self.injection.options.averaged(averages, row, found.increment)
        return found._replace(averages=averages, injected=injected)

    def scouting(self) -> Scouting:
        """What sends scouts to states that next to no particle has."""
        return Scouting(self.slices, self.plan)

    def log_first_stage(
        self, before: Mapping[str, np.ndarray], row: Row, rng: np.random.Generator
    ) -> np.ndarray | None:
        return self.first_stage(before, row, rng) if self.first_stage and row.seen else None

    def selected(
        self,
        earlier: Particles,
        before: Mapping[str, np.ndarray],
        row: Row,
        rng: np.random.Generator,
    ) -> Selection:
        """With KLD adaptation as many as the belief needs, left alone where that is what there are."""
        if self.counts is None:
            return super().selected(earlier, before, row, rng)
        n, most = len(earlier.weights), self.layout.particles
        chosen = self.resample(earlier.weights, most, rng)
        taken = {k: self.taken(k, earlier.values[k], chosen) for k in self.counts.widths}
        needed = min(self.counts.needed(self.counts.bins(taken)), most)
        if earlier.ess >= self.threshold * n and 0.8 * n <= needed <= n:
            return Selection(n, None, False, earlier.log_weights, earlier.log_total)
        if needed < most:
            chosen = self.resample(earlier.weights, needed, rng)
        return Selection(needed, chosen, True, 0.0, math.log(needed))

    def recycle(self, particles: Particles) -> None:
        if self.counts is None:
            super().recycle(particles)

    # ---- private -------------------------------------------------------------------------------

    def _renewed(
        self,
        steps: Sequence[Step],
        row: Row,
        before: Mapping[str, np.ndarray],
        old: Particles,
        selection: Selection,
        rng: np.random.Generator,
    ) -> Particles:
        """Begun anew where no weight is left; plate elements that have some stay as they are."""
        dead = ~np.asarray(old.total > 0)
        values, log = self.propagated(steps, row, before, selection, rng)
        everyone = math.log(selection.particles)
        fresh = selection._replace(resampled=True, log_weights=0.0, log_normaliser=everyone)
        new = self.weighted(row, values, log, fresh)
        if not self.layout.lead:
            return new._replace(rejuvenated=True)
        mixed = {k: self._either(k, dead, v, old.values[k]) for k, v in new.values.items()}
        either = selection._replace(
            resampled=dead | selection.resampled,
            log_weights=0.0,
            log_normaliser=np.where(dead, everyone, selection.log_normaliser),
        )
        log = np.where(dead, new.log_weights, old.log_weights)
        return self.weighted(row, mixed, log, either)._replace(rejuvenated=dead)

    def _either(self, name: str, dead: np.ndarray, new: np.ndarray, old: np.ndarray) -> np.ndarray:
        """A node's values: new ones in some elements of the plates apart, old ones in the others."""
        plates, apart = self.plates[name], self.layout.apart
        if any(p not in plates for p in apart):
            return new  # it hangs on nothing that was drawn
        at = [apart.index(p) for p in plates if p in apart]
        shape = [self.slices.first.sizes[p] if p in apart else 1 for p in plates]
        rank = self.ranks[name] - 1 - len(plates)
        return np.where(dead.transpose(at).reshape(*shape, *(1,) * rank), new, old)

    def _degenerate(
        self,
        row: Row,
        before: Mapping[str, np.ndarray],
        values: Mapping[str, np.ndarray],
        selection: Selection,
    ) -> DegeneracyError:
        """The error, with the first observed node at which no weight was left."""
        taken = {k: self.taken(k, v, selection.ancestors) for k, v in before.items()}
        known = {**self.known(row), **taken, **values}
        state = Pass(np.random.default_rng(0), (selection.particles,), known)
        model, node, which = self.slices.model(row.t), None, ""
        for name in (n for n in self.slices.dynamic if n in row.seen):
            WeighDrawn(model, model[name], self.layout.apart)(state)
            alive = np.asarray(np.any(np.asarray(state.log_weight) > -np.inf, axis=0))
            if not alive.all():
                node, at = name, first_index(~alive)
                which = f" (plate element {at if len(at) > 1 else at[0]})" if at else ""
                break
        what = f"the value of {node!r}{which}" if node else "what was seen"
        return DegeneracyError(
            f"none of {selection.particles} particles explains {what} in slice {row.t}: every weight is "
            "zero; use more particles, a proposal= that looks at the observations, less narrow noise, "
            'recovery=, or on_degeneracy="rejuvenate"',
            row.t,
            node,
        )


def block_of(particles: int, numbers: int) -> int:
    """Particles that are passed at a time, where the largest node has so many numbers."""
    return particles if particles * numbers <= WHOLE else max(1, BLOCK // numbers)


def has_weight(particles: Particles) -> bool:
    """Whether any weight is left, in all elements of the plates apart."""
    total = particles.total
    return bool(total > 0 if isinstance(total, float) else (total > 0).all())
