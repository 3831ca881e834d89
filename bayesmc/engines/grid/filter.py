"""``GridFilter``: options, refusals, and the runs over a series."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np

from bayesmc.dbn import UNCOMPARED, DynamicBayesNet, Row, SeriesProblem, Slices, read_static
from bayesmc.engines.exact.exact import readable_bytes
from bayesmc.engines.filtering import (
    Asked,
    FilterEngine,
    Queries,
    answer_so_far,
    pass_slices,
    quiet,
)
from bayesmc.engines.grid.automatic import FoundGrid
from bayesmc.engines.grid.chain import increments_along
from bayesmc.engines.grid.moves import Cells, GridMover
from bayesmc.engines.grid.posterior import (
    GridBelief,
    GridPosterior,
    GridRecord,
    GridState,
    answers_of,
    draws_of,
    values_at,
)
from bayesmc.engines.grid.search import (
    GridOptions,
    GridSearch,
    too_large,
    unread,
    without_density,
)
from bayesmc.engines.grid.slice import same_points
from bayesmc.engines.particles.predictive import Replicates
from bayesmc.engines.slice_steps import SlicePlan
from bayesmc.errors import BayesmcError, BudgetError
from bayesmc.network.forward import refuse_noiseless, refuse_parts
from bayesmc.progress import Progress
from bayesmc.randomness import Purpose, stream
from bayesmc.results.predictive import warn_of_misfit


@dataclass(frozen=True)
class GridFilter(GridOptions, FilterEngine):
    """Histogram filter (Markov localisation): beliefs as probabilities of the cells of a grid.

    Exact but for the grid: sums over points stand for integrals. With points closer than the narrowest
    density is wide and a grid that holds all mass, the error of the midpoint rule falls faster than any power
    of the distance.

    Parameters
    ----------
    grid : dict
        Node -> the tuple ``(low, high, cells)``, or an increasing list or array of points; for a vector one
        for all components, or a list of one each; for counts the values. Finite nodes need none (their
        states are their cells), nor do nodes on a bounded interval or circle. Where a slice has one hidden
        number, its range and its cells are found from the model and the data.
    cells : int, optional
        Cells of nodes without a grid. None finds how many one hidden number needs, and takes 200 where there
        are several.
    quadrature : str
        ``"midpoint"``; or ``"trapezoid"``, ``"simpson"``, ``"gauss-legendre"``, for which ``(low, high, n)``
        are n points. Points given as an array stand for what is nearest to them.
    max_bytes : float
        What one table may take, and the beliefs of all slices in ``smooth``. A density of a node is a
        table over its own cells and those of the nodes that it reads, in this slice and the one before;
        one that does not fit is refused ahead.
    tolerance : float
        Mass lost or gained in one slice from which on a ``GridWarning`` says that the grid is too small or
        too coarse, and share of the highest density from which on one says that a belief goes on beyond its
        grid: in an outer cell whose node's support does not end there. ``inf`` for never. Each is said once
        a run, of the first slice.

    Notes
    -----
    Every component of a hidden node is an axis, so three or four are what a grid can hold; nodes that move
    independently cost the sum of their tables, not the product. Plates whose elements never meet are filtered
    separately on the same grid. Noise narrower than a cell falls between the points: widen it, refine the
    grid, or take another engine; a state without noise has no density at all and is refused. Hidden nodes
    that nothing reads (missing observations) go without axes unless ``grid`` names them. Vectors are seen
    whole or not at all: one of which some components are missing is refused. Some rows are held against rows
    drawn from the cells (``row_ranks``); a ``ModelMisfitWarning`` says where they do not fit.

    References
    ----------
    Thrun, Burgard and Fox (2005), Probabilistic Robotics, sec. 4.1 (histogram filter) and ch. 8; Kitagawa
    (1987), Non-Gaussian state-space modeling of nonstationary time series, JASA 82.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc import GridFilter
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 1.0), initial=bmc.Normal(0.0, 2.0))
    >>> dbn.add("y", lambda x: bmc.Normal(0.0, np.exp(x / 2)))
    >>> engine = GridFilter(grid={"x": (-12.0, 12.0, 300)})
    >>> filtered = bmc.filter(dbn, {"y": [0.3, -2.1, 4.0]}, engine=engine)
    >>> filtered.mean("x").round(3).tolist(), round(filtered.log_marginal_likelihood, 4)
    ([-0.907, 1.044, 2.179], -8.3043)
    """

    label: ClassVar[str] = "grid filter"
    belief: ClassVar[type] = GridBelief

    # ---- what it can do ---------------------------------------------------------------------

    def refusal(self, problem: SeriesProblem) -> str | None:
        common = super().refusal(problem)
        if common is not None:
            return common
        parts = refuse_parts(problem.series.observed, "GridFilter")
        if parts is not None:
            return parts
        names = problem.slices.stochastic
        for compiled in (problem.slices.first, problem.slices.later):
            reason = refuse_noiseless(compiled, names, "GridFilter")
            if reason is not None:
                return reason
        try:
            with quiet():
                model = self.model_on_grid(problem.slices, problem.known_static)
        except BayesmcError as error:
            return str(error)
        name = self._search.automatic(problem)
        if name is not None:
            return without_density(problem)
        for name in problem.hidden:
            if name in model.own and name not in model.leaves and name not in model.axes.of:
                return f"GridFilter: {model.axes.missing[name]}"
        return too_large(model, problem, self.max_bytes) or without_density(problem)

    def unanswered(self, problem: SeriesProblem) -> tuple[str, ...]:
        """Hidden nodes that are integrated out and have no closed moments, and what is computed from any."""
        found = []
        model = self.model_on_grid(problem.slices, problem.known_static)
        for name in problem.hidden:
            node = problem.model[name]
            if name not in model.own:
                now = model.sources(True, name).now | model.sources(False, name).now
                found += [name] if now & model.leaves & {*problem.hidden} else []
                continue
            if name not in model.leaves or node.domain is not None:
                continue
            with quiet():
                try:
                    later = problem.slices.later
                    _ = later.evaluate(name, later.probe)[0].var
                except (BayesmcError, NotImplementedError):
                    found.append(name)
        return tuple(found)

    def grid_for(self, problem: SeriesProblem) -> FoundGrid | None:
        """The grid that it finds for a problem, which serves like problems, too; None where none is found."""
        return self._search.found(problem)

    def taking(self, problem: SeriesProblem, found: FoundGrid | None) -> None:
        """Let a problem be filtered on a grid found for another, so that like evidences differ smoothly."""
        self._search.take(problem, found)

    def log_evidence(self, problem: SeriesProblem) -> tuple[float, float]:
        """The log evidence alone, and the mass that the worst slice after the first lost, or had too much."""
        mover, _ = self._start(problem)
        with quiet():
            increments = increments_along(mover, problem.series)
        if increments is not None:
            return float(increments.sum()), mover.off
        asked = self.filter(problem, np.random.SeedSequence(0), progress=False)
        return float(np.sum(asked.log_marginal_likelihood)), mover.off

    @property
    def _search(self) -> GridSearch:
        """The search for a grid of one hidden number, by these options."""
        return GridSearch(self)

    def unasked(self, problem: SeriesProblem, asked: Asked) -> str | None:
        return self._search.why_not(problem)

    def unable(self, problem: SeriesProblem, asked: Asked) -> str | None:
        reason = super().unable(problem, asked)
        if reason is not None:
            return reason
        model = self.model_on_grid(problem.slices, problem.known_static)
        return unread(model, asked.queries, problem.hidden)

    def is_displaced(self, problem: SeriesProblem) -> bool:
        return self._search.automatic(problem) is not None and super().is_displaced(problem)

    def reasons(self, problem: SeriesProblem) -> tuple[str, ...]:
        return self._search.said(problem)

    def treatment(self, problem: SeriesProblem) -> Callable[[str], str]:
        grid = self._search.found(problem)
        model = self.model_on_grid(problem.slices, problem.known_static)
        model = model if grid is None else grid.mover.model

        def treated(name: str) -> str:
            node = problem.model[name]
            if name not in model.own:
                return "computed"
            if name in problem.seen:
                return "observed, weights the cells"
            if name in model.leaves:
                return "integrated out in closed form where it is hidden"
            sizes = " x ".join(str(a.size) for a in model.axes.of[name])
            count = 1 if node.event_shape else model.elements(name)
            each = f" for each of {count} elements" if count > 1 else ""
            return f"on a grid of {sizes} {'cells' if node.domain is None else 'states'}{each}"

        return treated

    # ---- runs over a series -----------------------------------------------------------------

    def filter(
        self,
        problem: SeriesProblem,
        seed: np.random.SeedSequence,
        *,
        keep: str | None = None,
        queries: Queries | None = None,
        progress: bool | None = None,
    ) -> GridPosterior:
        if keep not in (None, "summaries"):
            raise ValueError(
                f'keep={keep!r}: a grid has no particles; give "summaries" for answers of constant size, or '
                "None, which keeps densities, too"
            )
        mover, kept = self._start(problem)
        alone = bool(problem.cache.get(UNCOMPARED))  # the evidence is all that is asked
        names = () if alone else problem.hidden
        record = GridRecord(
            mover.model, names, problem.steps, queries or {}, keep is None and not alone
        )
        looks = None if alone else _looks(problem, mover)
        increments = np.empty((problem.steps, *mover.model.lead))
        before: Cells | None = None

        def move(k: int) -> None:
            nonlocal before
            row = problem.series.row(k)
            if looks is not None:
                looks.look(k, draws_of(mover.model, before), row)
            cells = kept[k] if kept else mover.move(before, row)
            increments[k] = cells.increment
            record.add(k, answers_of(mover, before, cells, cells.probs))
            before = cells

        so_far = partial(record.posterior, self, "filter", increments, problem)
        try:
            with Progress(problem.steps, self.label, progress) as bar, quiet():
                pass_slices(problem.series.start, problem.steps, move, so_far, bar.advance)
            found = so_far()
        except KeyboardInterrupt as stop:
            found = answer_so_far(stop, self)
        return self._judged(problem, found, looks)

    def smooth(
        self,
        problem: SeriesProblem,
        seed: np.random.SeedSequence,
        *,
        lag: int | None = None,
        queries: Queries | None = None,
        progress: bool | None = None,
    ) -> GridPosterior:
        """Every slice given all rows by one pass forwards and one back, or ``lag`` back from every slice."""
        mover, kept = self._start(problem)
        record = GridRecord(mover.model, problem.hidden, problem.steps, queries or {}, True)
        looks = _looks(problem, mover)
        steps = problem.steps
        increments = np.empty((steps, *mover.model.lead))
        reach = steps if lag is None else int(lag)
        held: deque[Cells] = deque(maxlen=reach + 2)

        def move(k: int) -> None:
            before = held[-1] if held else None
            row = problem.series.row(k)
            looks.look(k, draws_of(mover.model, before), row)
            cells = kept[k] if kept else mover.move(before, row)
            increments[k] = cells.increment
            held.append(cells)
            if k == 0:
                self._check_held(cells.probs.nbytes, min(steps, reach + 2), lag)
            if k >= reach and k < steps - 1:
                self._smoothed(mover, record, held, k, k - reach, k - reach)

        with Progress(steps, self.label, progress) as bar, quiet():
            pass_slices(problem.series.start, steps, move, None, bar.advance)
            self._smoothed(mover, record, held, steps - 1, max(steps - 1 - reach, 0), steps - 1)
        found = record.posterior(
            self, "smooth" if lag is None else "fixed-lag", increments, problem
        )
        return self._judged(problem, found, looks)

    def most_likely(
        self, problem: SeriesProblem, seed: np.random.SeedSequence, progress: bool | None = None
    ) -> dict[str, np.ndarray]:
        """The most likely trajectory over the points of the grid (Viterbi), by density.

        Hidden nodes that nothing reads and that have no grid are integrated out and left out.
        """
        static = problem.known_static
        with quiet(), Progress(problem.steps, self.label, progress) as bar:
            found_grid = self._search.found(problem)
            axis = None if found_grid is None else (found_grid.name, found_grid.axis)
            model = self.model_on_grid(problem.slices, static, logs=True, axis=axis)
            mover = GridMover(model, self.tolerance)
            rows = [problem.series.row(k) for k in range(problem.steps)]
            path = mover.best(rows, bar.advance)
        found = {}
        for name in problem.hidden:
            node = problem.model[name]
            if name not in model.own or name in model.leaves:
                continue
            values = [values_at(model, placed, name, at)[0] for placed, at in path]
            found[name] = np.array(node.decode(np.stack(values)), subok=True)
        return found

    # ---- one slice at a time ----------------------------------------------------------------

    def _bound(self, belief: GridBelief, dbn: DynamicBayesNet, slices: Slices) -> GridBelief:
        cells = belief.state.cells
        with quiet():
            model = self.model_on_grid(slices, read_static(slices, belief.static))
            placed = model.place(cells.placed.row)
        if not same_points(placed, cells.placed):
            raise ValueError(
                "GridFilter().start: the belief lies on another grid; go on with the engine that it was "
                "started with"
            )
        mover = GridMover(model, self.tolerance)
        return belief.bound(dbn, slices, belief.state._replace(mover=mover))

    def _absorbed(self, belief: GridBelief, slices: Slices, row: Row) -> GridBelief:
        mover, before, _ = belief.state or (None, None, None)
        with quiet():
            if mover is None:
                model = self.model_on_grid(slices, read_static(slices, belief.static))
                mover = GridMover(model, self.tolerance)
            cells = mover.move(before, row)
        return belief.after(slices, row, cells.increment, GridState(mover, cells, before))

    # ---- private -------------------------------------------------------------------------------

    def _start(self, problem: SeriesProblem) -> tuple[GridMover, list[Cells] | None]:
        """What moves beliefs, and the beliefs of all slices where a search for the grid left them."""
        found = self._search.found(problem)
        if found is not None:
            return found.mover, found.kept
        with quiet():
            model = self.model_on_grid(problem.slices, problem.known_static)
            return GridMover(model, self.tolerance), None

    def _judged(
        self, problem: SeriesProblem, found: GridPosterior, looks: Replicates | None
    ) -> GridPosterior:
        """With the error of the log evidence, and how rows compare with what was expected."""
        if looks is None:
            return found
        found = self._search.with_error(problem, found)
        found.predictive = looks.found(found.steps)
        warn_of_misfit(found.predictive, "GridFilter", found.start, 4)
        return found

    def _smoothed(
        self,
        mover: GridMover,
        record: GridRecord,
        held: deque[Cells],
        k: int,
        low: int,
        high: int,
    ) -> None:
        """Back from slice k, whose belief stands last in ``held``, recording slices low to high."""
        probs = held[-1].probs
        for t in range(k, low - 1, -1):
            at = len(held) - 1 - (k - t)
            if t < k:
                probs = mover.back(held[at], held[at + 1], probs)
            if t <= high:
                before = held[at - 1] if t else None
                record.add(t, answers_of(mover, before, held[at], probs))

    def _check_held(self, each: int, slices: int, lag: int | None) -> None:
        """Refuse a pass back over more beliefs than fit."""
        count = 2 * each * slices  # of every slice what was predicted, too
        if count > self.max_bytes:
            advice = "give lag= to smooth, " if lag is None else "a smaller lag, "
            raise BudgetError(
                f"GridFilter: the beliefs of {slices} slices take {readable_bytes(count)}, and max_bytes is "
                f"{readable_bytes(self.max_bytes)}; {advice}fewer cells, or raise max_bytes=",
                count,
            )


# ---- private ------------------------------------------------------------------------------------


def _looks(problem: SeriesProblem, mover: GridMover) -> Replicates:
    """What holds rows against those that the grid expects; the same draws always, as of all it answers."""
    plan = SlicePlan(problem.slices, mover.model.apart, problem.known_static)
    return Replicates(problem, plan, stream(np.random.SeedSequence(0), Purpose.CHECK))
