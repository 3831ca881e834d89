"""What the extended and the unscented Kalman filter share: refusals, and a slice at a time by some rule."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from bayesmc.dbn import SeriesProblem
from bayesmc.engines.kalman.base import GaussianFilter
from bayesmc.engines.kalman.data import Pattern, SeriesData
from bayesmc.engines.kalman.levels import Level, Made, Plan, expected_slice, why_not_matched
from bayesmc.engines.kalman.passes import Filtered, State
from bayesmc.engines.kalman.rows import Memory, RowTaker, Taken
from bayesmc.engines.kalman.slices import Layout
from bayesmc.kernels.kalman import Turned, turned


class NonlinearFilter(GaussianFilter):
    """Base of the filters that make every slice linear where the belief is."""

    def made_linear(self, level: Level, mean: np.ndarray, rows: np.ndarray) -> Made:
        """See ``levels.Rule``."""
        raise NotImplementedError

    def refused_row(self, layout: Layout, values: Mapping[str, np.ndarray]) -> str | None:
        """See ``rows.Family``."""
        why = why_not_matched(layout)
        return None if why is None else f"{why}; use ParticleFilter"

    def expected(
        self,
        layout: Layout,
        values: Mapping[str, np.ndarray],
        state: State,
        pattern: Pattern,
        memory: Memory,
    ) -> tuple[np.ndarray, np.ndarray]:
        """See ``rows.Family``."""
        plan = memory(("plan", layout), lambda: Plan(layout, values))
        return expected_slice(layout, values, state, pattern, self.made_linear, plan)

    def _own_refusal(self, problem: SeriesProblem, data: SeriesData) -> str | None:
        for layout in data.layouts:
            why = self.refused_row(layout, {})
            if why is not None:
                return why
        return None

    def _forward(
        self,
        problem: SeriesProblem,
        data: SeriesData,
        smoothing: bool,
        advance: Callable[[int], None],
    ) -> Filtered:
        """Row by row; every row has its own layout, which is put into the one of the series."""
        steps, whole = data.steps, data.layouts[0]
        found = Filtered(
            np.empty((steps, *whole.lead, whole.n)), [], [], np.arange(steps),
            np.empty((steps, *whole.lead)), [],
        )  # fmt: skip
        taker = RowTaker(self, problem.slices, data.static)
        before: Taken | None = None
        for k in range(steps):
            taken = taker.take(data.series.row(k), before, smoothing)
            _write(found, k, whole, taken)
            if smoothing:
                found.innovations.append(taken.eta)
                turn = None if before is None else _turn(whole, before.layout, taken)
                found.turns.append(turn)
            before = taken
            advance(1)
        return found


# ---- private ------------------------------------------------------------------------------------


def _write(found: Filtered, k: int, whole: Layout, taken: Taken) -> None:
    """A slice's mean and root in the layout of the series; what is known there has no spread."""
    own = taken.layout
    found.increments[k] = taken.log_density
    for name, place in whole.rows.items():
        if name in own.rows:
            found.means[k][..., place] = taken.mean[..., own.rows[name]]
        else:
            node = whole.slices.first[name]
            value = np.broadcast_to(taken.known[name], node.value_shape).astype(float)
            found.means[k][..., place] = whole.packed(node, value)
    if own.n == whole.n:
        found.factors.append(taken.factor)
        return
    rows = _placed(whole, tuple(own.rows))
    carried = rows[: own.carried]
    columns = np.concatenate([carried, whole.carried + np.arange(own.n - own.carried)])
    factor = np.zeros((*taken.factor.shape[:-2], whole.n, whole.n))
    factor[..., rows[:, None], columns] = taken.factor
    found.factors.append(factor)


def _turn(whole: Layout, before: Layout, taken: Taken) -> Turned:
    """What carries a smoother back, in the layout of the series."""
    own, c = taken.layout, whole.carried
    turn = turned(taken.made, own.carried)
    if before.carried == own.carried == c:
        return turn
    there, here = _placed(whole, before.after), _placed(whole, own.after)
    lead = turn.link.shape[:-2]
    shift = np.zeros((*lead, c, turn.shift.shape[-1]))
    link, spread = np.zeros((*lead, c, c)), np.zeros((*lead, c, c))
    shift[..., there, :] = turn.shift
    link[..., there[:, None], here] = turn.link
    spread[..., there[:, None], there] = turn.spread
    return Turned(shift, link, spread)


def _placed(whole: Layout, names: tuple[str, ...]) -> np.ndarray:
    """Where the numbers of some nodes stand in the layout of the series."""
    places = [np.arange(whole.rows[n].start, whole.rows[n].stop) for n in names]
    return np.concatenate([np.zeros(0, dtype=np.intp), *places])
