"""What the extended and the unscented Kalman filter share: refusals, and a slice at a time by some rule."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np

from bayesmc.dbn import SeriesProblem
from bayesmc.engines.filtering import Asked, pass_slices
from bayesmc.engines.kalman.answers import filter_answers
from bayesmc.engines.kalman.base import GaussianFilter
from bayesmc.engines.kalman.data import Pattern, SeriesData
from bayesmc.engines.kalman.filter import KalmanFilter
from bayesmc.engines.kalman.innovations import Innovations
from bayesmc.engines.kalman.levels import Level, Made, Plan, expected_slice, why_not_matched
from bayesmc.engines.kalman.passes import Filtered, State, Turns
from bayesmc.engines.kalman.posterior import GaussianSeries
from bayesmc.engines.kalman.rows import Expected, Memory, RowTaker, Taken
from bayesmc.engines.kalman.slices import Layout
from bayesmc.errors import UnsupportedError
from bayesmc.linalg.square_root import multiplied, turned


class NonlinearFilter(GaussianFilter):
    """Base of the filters that make every slice linear where the belief is."""

    def made_linear(self, level: Level, mean: np.ndarray, rows: np.ndarray) -> Made:
        """See ``levels.Rule``."""
        raise NotImplementedError

    def unable(self, problem: SeriesProblem, asked: Asked) -> str | None:
        if asked.what == "most_likely" and (why := self._no_mode(problem)) is not None:
            return why
        return super().unable(problem, asked)

    def most_likely(
        self, problem: SeriesProblem, seed: np.random.SeedSequence, progress: bool | None = None
    ) -> dict[str, np.ndarray]:
        """Smoothed means, of templates proved linear-Gaussian only.

        Elsewhere they are no mode: of y = x^2 + noise they lie between two of them.

        Raises
        ------
        UnsupportedError
            The template is not linear-Gaussian.
        """
        why = self._no_mode(problem)
        if why is not None:
            raise UnsupportedError(why)
        return super().most_likely(problem, seed, progress)

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
    ) -> Expected:
        """See ``rows.Family``."""
        plan = memory(("plan", layout), lambda: Plan(layout, values))
        return Expected(*expected_slice(layout, values, state, pattern, self.made_linear, plan))

    def _no_mode(self, problem: SeriesProblem) -> str | None:
        """Why smoothed means are not the most likely trajectory, or None."""
        refused = KalmanFilter().refusal(problem)
        if refused is None:
            return None
        why = refused.removeprefix("KalmanFilter: ").partition("; use ")[0]
        return (
            f"most_likely: the smoothed means of {type(self).__name__} are the most likely trajectory of "
            f"linear-Gaussian templates only, and {why}; use GridFilter(grid={{...}}), which finds the mode "
            "over the points of a grid"
        )

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
        n, c, shape = whole.n, whole.carried, (steps, *whole.lead)
        turns = None
        if smoothing:
            square = (*shape, c, c)
            turns = Turns(np.zeros(square), np.zeros(square), np.zeros((*shape, c)))
        found = Filtered(
            np.empty((*shape, n)), np.zeros((*shape, n, n)), np.arange(steps), np.empty(shape), turns,
            Innovations(whole, data.series.observed, steps),
        )  # fmt: skip
        taker = RowTaker(self, problem.slices, data.static)
        before: Taken | None = None

        def move(k: int) -> None:
            nonlocal before
            taken = taker.take(data.series.row(k), before, smoothing)
            _write(found, k, whole, taken)
            if turns is not None and before is not None:
                _write_turn(turns, k, whole, before.layout, taken)
            before = taken

        def so_far(k: int) -> GaussianSeries:
            return filter_answers(self, problem, data, found.first(k))

        pass_slices(data.series.start, steps, move, so_far, partial(advance, 1))
        return found


# ---- private ------------------------------------------------------------------------------------


def _write(found: Filtered, k: int, whole: Layout, taken: Taken) -> None:
    """A slice's mean and root in the layout of the series; what is known there has no spread."""
    own = taken.layout
    found.increments[k] = taken.log_density
    found.innovations.put(k, own, taken.pattern, taken.made.root, taken.eta)
    for name, place in whole.rows.items():
        if name in own.rows:
            found.means[k][..., place] = taken.mean[..., own.rows[name]]
        else:
            node = whole.slices.first[name]
            value = np.broadcast_to(taken.known[name], node.value_shape).astype(float)
            found.means[k][..., place] = whole.packed(node, value)
    if own.n == whole.n:
        found.factors[k] = taken.factor
        return
    rows = _placed(whole, tuple(own.rows))
    carried = rows[: own.carried]
    columns = np.concatenate([carried, whole.carried + np.arange(own.n - own.carried)])
    found.factors[k][..., rows[:, None], columns] = taken.factor


def _write_turn(turns: Turns, k: int, whole: Layout, before: Layout, taken: Taken) -> None:
    """What carries a smoother back, in the layout of the series."""
    own, made = taken.layout, taken.made
    assert made.turn is not None
    turn = turned(made.turn, made.root.shape[-1], own.carried)
    there, here = _placed(whole, before.after), _placed(whole, own.after)
    turns.shifts[k][..., there] = multiplied(turn.shift, taken.eta)
    turns.links[k][..., there[:, None], here] = turn.link
    turns.spreads[k][..., there[:, None], there] = turn.spread


def _placed(whole: Layout, names: tuple[str, ...]) -> np.ndarray:
    """Where the numbers of some nodes stand in the layout of the series."""
    places = [np.arange(whole.rows[n].start, whole.rows[n].stop) for n in names]
    return np.concatenate([np.zeros(0, dtype=np.intp), *places])
