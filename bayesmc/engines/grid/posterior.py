"""What a grid filter says: of every slice of a run, of one slice as its rows come in, and as draws."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from bayesmc.categorical import pick
from bayesmc.dbn import SeriesProblem, Slices
from bayesmc.engines.averages import as_event, naming
from bayesmc.engines.beliefs import SliceBelief
from bayesmc.engines.exact.exact import readable_bytes
from bayesmc.engines.filtering import Answers as Seen
from bayesmc.engines.filtering import (
    Queries,
    first_slices,
    observed_answers,
    quiet,
    refuse_forecast,
)
from bayesmc.engines.grid.answers import Answers
from bayesmc.engines.grid.moves import Cells, GridMover
from bayesmc.engines.grid.slice import Placed
from bayesmc.engines.grid.tables import GridModel
from bayesmc.engines.particles.predictive import Draws
from bayesmc.engines.particles.smc import along_plates
from bayesmc.errors import BudgetError, QueryError, UnsupportedError
from bayesmc.network import Model
from bayesmc.results import SeriesPosterior
from bayesmc.results.posterior import quantile_levels


class GridRecord:
    """Answers written slice by slice, in any order.

    Parameters
    ----------
    model : GridModel
    names : sequence of str
        Nodes that are answered for.
    steps : int
    queries : dict
    densities : bool
        Keep the densities of all nodes with a grid, too.
    """

    def __init__(
        self,
        model: GridModel,
        names: Sequence[str],
        steps: int,
        queries: Queries,
        densities: bool,
    ) -> None:
        self.model, self.steps, self.asked = model, steps, queries
        self.tables: dict[str, np.ndarray] = {}
        self.means: dict[str, np.ndarray] = {}
        self.variances: dict[str, np.ndarray] = {}
        self.densities: dict[str, np.ndarray] = {}
        self.answers: dict[int, Answers] | None = {} if densities else None
        self.queries: dict[str, list[Any]] = {n: [None] * steps for n in queries}
        self.errors: dict[str, list[Any]] = {n: [None] * steps for n in queries}
        for name in names:
            node = model.slices.first[name]
            if _one_domain(model.slices, name):
                assert node.domain is not None
                self.tables[name] = np.empty((steps, *node.plate_shape, node.domain.size))
                continue
            self.means[name] = np.empty((steps, *node.value_shape))
            self.variances[name] = np.empty((steps, *node.value_shape))
            if densities and name in model.axes.of and name not in model.leaves:
                cells = tuple(a.size for a in model.axes.of[name])
                shape = (steps, *node.plate_shape, *cells)
                _check_kept(name, shape, model.max_bytes)
                self.densities[name] = np.empty(shape)

    def add(self, k: int, answers: Answers) -> None:
        """Take in the k-th slice."""
        with quiet():
            self._add(k, answers)

    def _add(self, k: int, answers: Answers) -> None:
        if self.answers is not None:
            self.answers[k] = answers
        for name in list(self.tables):
            table = answers.table(name)
            if table is None:
                del self.tables[name]
                continue
            self.tables[name][k] = table
        for name in list(self.means):
            found = answers.moments(name)
            if found is None:
                del self.means[name], self.variances[name]
                continue
            self.means[name][k], self.variances[name][k] = found
        for name, kept in self.densities.items():
            kept[k] = answers.density(name)
        for name, function in self.asked.items():
            with naming(name):
                self.queries[name][k], self.errors[name][k] = answers.expectation(function)

    def posterior(
        self,
        engine: Any,
        kind: str,
        increments: np.ndarray | None,
        problem: SeriesProblem | None = None,
        steps: int | None = None,
    ) -> GridPosterior:
        """The answers of all slices, or of the first so many, with what was seen of a problem's."""
        k = self.steps if steps is None else steps
        seen = Seen({}, {}, {}) if problem is None else observed_answers(problem, k)
        axes = self.model.axes.of
        found = GridPosterior(
            self.model.slices.first, engine, kind, None if increments is None else increments[:k],
            {n: tuple(a.points for a in axes[n]) for n in self.densities},
            first_slices(self.densities, k),
            tables={**seen.tables, **first_slices(self.tables, k)},
            means={**seen.means, **first_slices(self.means, k)},
            variances={**seen.variances, **first_slices(self.variances, k)},
            queries={n: np.stack(rows[:k]) for n, rows in self.queries.items()},
            start=0 if problem is None else problem.series.start,
        )  # fmt: skip
        found.queries_mcse = {n: np.stack(rows[:k]) for n, rows in self.errors.items()}
        if self.answers is not None:
            found.answers = [self.answers[t] for t in range(k)]
        return found


def answers_of(mover: GridMover, before: Cells | None, cells: Cells, probs: np.ndarray) -> Answers:
    """What a belief about a slice says, given cells of the slice before."""

    def pair() -> Any:
        assert before is not None
        return mover.pair(before, cells, probs)

    placed = None if before is None else before.placed
    return Answers(mover.model, placed, cells.placed, probs, pair)


class GridPosterior(SeriesPosterior):
    """Beliefs on a grid about the nodes of every slice: a ``SeriesPosterior`` with densities.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc import GridFilter
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    >>> dbn.add("y", lambda x: bmc.Normal(np.abs(x), 0.5))
    >>> filtered = bmc.filter(dbn, {"y": [2.0, 2.5]}, engine=GridFilter({"x": (-10.0, 10.0, 400)}))
    >>> x, density = filtered.grid("x"), filtered.density("x")
    >>> density.shape, float(abs(x[density[1].argmax()]).round(2))
    ((2, 400), 2.32)
    """

    def __init__(
        self,
        model: Model,
        engine: Any,
        kind: str,
        increments: np.ndarray | None,
        grids: dict[str, tuple[np.ndarray, ...]],
        densities: dict[str, np.ndarray],
        **answers: Any,
    ) -> None:
        super().__init__(model, engine, kind, increments, **answers)
        self._grids, self._densities = grids, densities

    #: what beliefs say of every slice; pickles travel without
    answers: list[Answers] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "answers": None}

    def expectation(self, function: Callable[..., Any]) -> np.ndarray:
        """Means of a function of nodes of a slice, time first, its arguments with an axis of cells first.

        Raises
        ------
        UnknownNodeError, QueryError
        """
        return self._of_all("expectation", lambda one: one.expectation(function)[0])

    def probability(self, function: Callable[..., Any]) -> np.ndarray:
        """Probabilities of an event (a function that returns booleans), time first."""
        return self._of_all("probability", lambda one: one.expectation(function, as_event)[0])

    def quantile(self, name: str, q: Any) -> np.ndarray:
        """Quantiles of a node, number by number, shape ``(time, *q.shape, *plates, *event)``."""
        self._node(name)
        levels = quantile_levels(name, q)
        if name in self._tables or not np.any(self._variances[name]):  # finite, or seen
            return super().quantile(name, q)
        return self._of_all(f"quantile({name!r})", lambda one: one.quantile(name, levels))

    def _of_all(self, what: str, ask: Callable[[Answers], np.ndarray]) -> np.ndarray:
        if self.answers is None:
            raise QueryError(
                f'{what}: beliefs were not kept, since a pickle carries none and keep="summaries" keeps '
                "none; give queries= to the call"
            )
        with quiet():
            return np.stack([ask(one) for one in self.answers])

    def density(self, name: str) -> np.ndarray:
        """Densities at the points of the grid, shape ``(time, *plates, *cells)``.

        A vector has one axis of cells per component; counts have probabilities; where the node is seen
        stands NaN.

        Raises
        ------
        UnknownNodeError, UnsupportedError
        """
        self._node(name)
        return self._kept(name, "density", self._densities).copy()

    def grid(self, name: str) -> Any:
        """The points of a node's grid, shape ``(cells,)``; of a vector a tuple, one per component."""
        self._node(name)
        axes = self._kept(name, "grid", self._grids)
        return tuple(axes) if self.model[name].event_shape else axes[0]

    def last(self, steps: int, kind: str) -> GridPosterior:
        """The last so many slices by themselves."""
        refuse_forecast(self, kind)
        found = object.__new__(GridPosterior)
        found.__dict__.update(super().last(steps, kind).__dict__)
        found._grids = self._grids
        found._densities = {n: v[-steps:] for n, v in self._densities.items()}
        found.answers = None if self.answers is None else self.answers[-steps:]
        return found

    def _kept(self, name: str, what: str, kept: dict[str, Any]) -> Any:
        if name not in kept:
            raise UnsupportedError(
                f'{what}({name!r}): no density was kept of it; nodes with a grid have one unless keep="'
                'summaries" is given, finite ones have probabilities(name), others are given one by grid='
            )
        return kept[name]


class GridState(NamedTuple):
    """What a belief goes on with: what moves it (None out of a pickle), its cells, and those before."""

    mover: GridMover | None
    cells: Cells
    before: Cells | None


class GridBelief(SliceBelief):
    """Probabilities of cells of one slice.

    Attributes
    ----------
    t : int
        The slice; -1 before anything was absorbed.
    log_marginal_likelihood : float or ndarray
        Log density of all rows absorbed so far; one for each element of plates filtered separately.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc import GridFilter
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    >>> dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    >>> engine = GridFilter({"x": (-8.0, 8.0, 200)})
    >>> belief = engine.step(engine.start(dbn), {"y": 0.8})
    >>> belief.t, float(belief.mean("x").round(4)), belief.density("x").shape
    (0, 0.64, (200,))
    """

    def density(self, name: str) -> np.ndarray:
        """Density at the points of the grid, shape ``(*plates, *cells)``; NaN where the node is seen."""
        return self._posterior.density(name)[0]

    def grid(self, name: str) -> Any:
        """The points of a node's grid; of a vector a tuple, one per component."""
        return self._posterior.grid(name)

    # ---- private -------------------------------------------------------------------------------

    def _without_functions(self) -> GridState:
        return self.state._replace(mover=None)

    def _answered(self) -> GridPosterior:
        mover, cells, before = self.state
        model = mover.model
        record = GridRecord(model, model.slices.dynamic, 1, {}, True)
        record.add(0, answers_of(mover, before, cells, cells.probs))
        return record.posterior(None, "filter", None)


def draws_of(model: GridModel, cells: Cells | None) -> Draws | None:
    """Draws from a belief, of the nodes that the next slice reads; None before slice 0."""
    return None if cells is None else partial(_drawn, model, cells)


def values_at(
    model: GridModel, placed: Placed, name: str, at: tuple[np.ndarray, ...]
) -> np.ndarray:
    """A node's values at cells, whose positions along every axis have shape ``(count, *apart)``.

    Elements of plates that are filtered separately have cells of their own; where the node is seen the first
    axis may be 1.
    """
    node, value = model.slices.later[name], placed.values[name]
    batch = value.ndim - len(node.value_shape)
    axes = [k for k in range(batch) if value.shape[k] > 1]
    each = np.broadcast_to(value, value.shape[:batch] + node.value_shape)
    each = each.reshape(-1, *node.value_shape)
    if not axes:
        return each
    sizes = [value.shape[k] for k in axes]
    index = np.ravel_multi_index([at[k] for k in axes], sizes)
    return along_plates(each, index, node.plates, model.apart) if model.apart else each[index]


# ---- private ------------------------------------------------------------------------------------


def _one_domain(slices: Slices, name: str) -> bool:
    """Whether a node has the same finite set of states in all slices; a computed one may not."""
    domains = [m[name].domain for m in (slices.first, slices.later)]
    states = [None if d is None else d.states for d in domains]
    return states[0] is not None and states[0] == states[1]


def _check_kept(name: str, shape: tuple[int, ...], max_bytes: float) -> None:
    count = 8 * float(np.prod(shape, dtype=float))
    if count > max_bytes:
        raise BudgetError(
            f"GridFilter: the densities of {name!r} in all slices take {readable_bytes(count)}, and "
            f'max_bytes is {readable_bytes(max_bytes)}; give keep="summaries" to filter, fewer cells, or '
            "raise max_bytes=",
            int(count),
        )


def _drawn(
    model: GridModel, cells: Cells, rng: np.random.Generator, count: int
) -> dict[str, np.ndarray]:
    """Values of so many draws, first axis, of each node; without that axis where it is seen."""
    at = _positions(cells, model.lead, rng, count)
    found = {n: values_at(model, cells.placed, n, at) for n in model.slices.interface}
    return {n: v[0] if len(v) == 1 else v for n, v in found.items()}


def _positions(
    cells: Cells, lead: tuple[int, ...], rng: np.random.Generator, count: int
) -> tuple[np.ndarray, ...]:
    """Cells in proportion to their probabilities: along every axis positions, shape (count, *lead)."""
    shape = cells.placed.shape
    if not shape:
        return ()
    probs = np.broadcast_to(cells.probs, (*shape, *lead)).reshape(math.prod(shape), -1)
    flat = pick(probs, rng.random((probs.shape[1], count)).T)
    return tuple(np.unravel_index(flat.reshape(count, *lead), shape))
