"""The step of a particle filter whose particles carry a small Gaussian for each element of a plate."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bayesmc.dbn import Row
from bayesmc.engines.marginal.elements.beliefs import DrawnLater
from bayesmc.engines.marginal.elements.guides import Guide
from bayesmc.engines.marginal.elements.plan import ElementPlan
from bayesmc.engines.marginal.elements.step import ElementFilter
from bayesmc.engines.marginal.split import Split
from bayesmc.engines.marginal.step import MarginalStep, degenerate
from bayesmc.engines.marginal.tables.afterwards import drawn_afterwards
from bayesmc.engines.particles.filter_step import block_of, has_weight
from bayesmc.engines.particles.smc import Particles
from bayesmc.engines.slice_steps import SlicePlan, SliceProposals
from bayesmc.errors import UnsupportedError
from bayesmc.network.forward import Step

#: numbers of all elements up to which all of them are drawn to follow how the filter does
_DRAWN = 512


class ElementStep(MarginalStep):
    """The step of a Rao-Blackwellised particle filter whose plates are integrated out element by element.

    Parameters
    ----------
    elements : ElementPlan
    guided : str, optional
        A sampled node that is drawn with a look at what is read of elements.

    The others are those of ``MarginalStep``, which answers about slices that lie back.
    """

    def __init__(
        self,
        plan: SlicePlan,
        split: Split,
        particles: int,
        resample: Callable[..., np.ndarray],
        threshold: float,
        kept: Sequence[str] | None,
        proposals: SliceProposals | None,
        elements: ElementPlan,
        guided: str | None = None,
    ) -> None:
        super().__init__(plan, split, particles, resample, threshold, kept, proposals)
        self.plan_of_elements = elements
        self.elements = ElementFilter(plan.slices, elements, plan.apart)
        self.guide = Guide(plan.slices, self.elements, guided) if guided else None
        # states have no place in the blocks in which particles are passed
        sizes = [math.prod(plan.slices.later[n].value_shape) for n in plan.slices.dynamic
                 if n not in elements.states]  # fmt: skip
        self.layout = replace(self.layout, block=block_of(particles, max(sizes, default=1)))
        numbers = math.prod(self.elements.layouts[0].lead) * self.elements.layouts[0].n
        self.too_wide = frozenset(elements.states if numbers > _DRAWN else ())
        self._late: dict[Any, tuple[list[Step], frozenset[str]]] = {}

    @property
    def by_element(self) -> bool:
        """Whether beliefs are by element: not where slices before are to be told more."""
        return not (self.whole or self.lag)

    def __call__(self, earlier: Particles | None, row: Row, rng: np.random.Generator) -> Particles:
        if not self.by_element:
            return super().__call__(earlier, row, rng)
        steps, late = self._steps(row)
        held = earlier
        if earlier is not None:  # without drawing what nobody has looked at
            held = earlier._replace(values=dict(dict.items(earlier.values)))
        before, selection = self.chosen(held, row, rng)
        hidden = self.elements.hidden_before
        if self.tables is not None:
            hidden = hidden | self.tables.hidden_before
        before = {k: v for k, v in before.items() if k not in hidden}
        inner, tables = None, None
        if earlier is not None:
            inner = earlier.inner.carried().taken(selection.ancestors)
            tables = earlier.tables and earlier.tables.taken(selection.ancestors)
        values, log = self.propagated(steps, row, before, selection, rng)
        values = {k: v for k, v in values.items() if k not in late}
        known = self._known(row, before, values, selection)
        known = known._replace(
            values={k: v for k, v in known.values.items() if k not in self.plan_of_elements.states}
        )
        if self.guide is not None:
            more, guided = self.guide.drawn(row, known, inner, rng)
            log, values = log + more, values | guided
            known = self._known(row, before, values, selection)
        more, inner, drawn = self.elements.advanced(row, known, inner, rng)
        log, values = log + more, values | drawn
        known = self._known(row, before, values, selection)
        after: Any = None
        if self.tables is not None:
            more, after, moves = self.tables.advanced(row, known, tables)
            log = log + more
        for name, seen in row.seen.items():
            if seen.mask is None:
                values.setdefault(name, seen.value)
        found = self.weighted(row, values, log, selection)
        if not has_weight(found):
            raise degenerate(selection.particles, row)
        if self.tables is not None:
            values |= self.completed(row, known, values, (tables, after, moves), rng)
        values = self._completed_later(row, known, values, inner, rng)
        return found._replace(
            values=values, inner=inner._replace(seen=self.split.seen), tables=after
        )

    # ---- private -------------------------------------------------------------------------------

    def _steps(self, row: Row) -> tuple[list[Step], frozenset[str]]:
        """Steps of a slice but for what waits, and what of the slice has no value after them."""
        elements = self.plan_of_elements
        full = frozenset(n for n, o in row.seen.items() if o.mask is None)
        partly = frozenset(row.seen) - full
        wait = elements.late - (elements.pickers & full)
        if self.guide is not None:
            wait = wait | self.guide.waiting
        out = wait
        if self.tables is not None:
            out = out | self.tables.left_out(row.t == 0)
        key = (row.t == 0, full, partly <= wait)
        found = self._late.get(key)
        if found is None:
            self._refuse_unexplained(row, full)
            steps = self.sampling.steps_without(row, out)
            found = steps, frozenset(n for n in wait if n not in full)
            if partly <= wait:
                self._late[key] = found
        return found

    def _refuse_unexplained(self, row: Row, full: frozenset[str]) -> None:
        """What was taken to be seen always, and sampled nodes rest on."""
        pair = None if self.tables is None else self.tables.unexplained(full, self.split.seen)
        if pair is not None:
            raise UnsupportedError(
                f"ParticleFilter(marginalize=...): {pair[0]!r} is missing in slice {row.t}, and "
                f"{pair[1]!r}, which is sampled, depends on it; start with a row that lacks it, or "
                "give marginalize=None"
            )

    def _completed_later(
        self,
        row: Row,
        known: Any,
        values: Mapping[str, Any],
        inner: Any,
        rng: np.random.Generator,
    ) -> DrawnLater:
        """Values of all nodes that are wanted, those of elements once somebody looks at them."""
        plan = self.plan_of_elements
        seen = {n for n, o in row.seen.items() if o.mask is None}
        late = plan.readings | set(() if self.guide is None else self.guide.beside.others)
        missing = [n for n in self.slices.dynamic if n in late and n not in seen]
        names = [n for n in (*plan.states, *missing) if n in self.kept]
        seed, slices = int(rng.integers(1 << 62)), self.slices
        every = {**known.values, **values}

        def draw() -> dict[str, np.ndarray]:
            own = np.random.default_rng(seed)
            found = inner.completed(own)
            if any(n in missing for n in names):
                given = {**every, **found}
                found |= drawn_afterwards(slices, row, missing, given, known.particles, own)
            return found

        kept = {n: v for n, v in values.items() if n in self.kept}
        return DrawnLater(kept, names, draw)
