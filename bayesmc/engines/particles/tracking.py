"""How far a particle filter may be off, followed slice by slice beside the particles.

Families tell what the particles have met (``genealogy``), the drift of means and the rare states what they
may have missed. Nothing here touches the particles, or the numbers that they are drawn with.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from bayesmc.dbn import Row
from bayesmc.engines.particles.blocks import Block
from bayesmc.engines.particles.drift import Compass, Drift
from bayesmc.engines.particles.filter_step import FilterStep
from bayesmc.engines.particles.forgetting import Sight
from bayesmc.engines.particles.genealogy import Families, begun, drifted, followed, scouted
from bayesmc.engines.particles.particles import Particles
from bayesmc.engines.particles.rare_states import Scouting
from bayesmc.resampling import ssp, stratified, systematic


class Tracker:
    """Follows the families of the particles that a step of sequential Monte Carlo makes.

    Parameters
    ----------
    step : FilterStep
    """

    def __init__(self, step: FilterStep) -> None:
        #: large arrays of blocks, which are nobody's once they have been followed
        self.room: dict[Any, np.ndarray] = {}
        self.sight = Sight([step.slices.later[n] for n in step.slices.interface], step.layout)
        self.scouting = Scouting(step.slices, step.plan)
        blind = step.plan.guided or step.first_stage is not None or step.injection is not None
        compass = Compass(self.sight.nodes, step.layout)
        self.compass = compass if compass.nodes and not blind else None
        # after a first stage, what a family should have is not what its weight says
        schemes = (stratified, systematic, ssp)
        self.steady = step.resample in schemes or step.first_stage is not None

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
            families = self._followed(families, earlier, now, row, drift)
            found.append(families)
            earlier = now
        return found

    def after_one(
        self, families: Families | None, earlier: Particles | None, now: Particles, row: Row
    ) -> Families:
        """The same in one slice."""
        compass, drift = self.compass, None if families is None else families.drift
        if compass is not None and compass.is_alone:
            return self._followed(
                families, earlier, now, row, compass.after_one(drift, earlier, now)
            )
        block = Block(self.sight.layout, [now], room=self.room)
        return self.after(families, earlier, block, [row])[0]

    # ---- private -------------------------------------------------------------------------------

    def _followed(
        self,
        families: Families | None,
        earlier: Particles | None,
        now: Particles,
        row: Row,
        drift: Drift | None,
    ) -> Families:
        if families is None or earlier is None:
            families = begun(now, self.sight)
        else:
            families = followed(families, earlier, now, self.steady, self.sight)
        if self.compass is not None:
            families = drifted(families, drift, now, self.sight)
        if self.scouting.nodes:
            scouts = self.scouting.after(families.scouts, earlier, now, row)
            families = scouted(families, scouts, now, self.sight)
        return families
