"""Options of a grid filter, why it cannot answer, and its search for a grid: where there is one to find, and
when it is taken unasked.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from bayesmc.dbn import SeriesProblem, Slices
from bayesmc.engines.filtering import quiet
from bayesmc.engines.grid.automatic import TAKEN_FAR, TARGET, FoundGrid, find_grid
from bayesmc.engines.grid.axes import CELLS, Axes, Axis, check_rule, line_of, read_axes
from bayesmc.engines.grid.moves import GridMover
from bayesmc.engines.grid.posterior import GridPosterior
from bayesmc.engines.grid.sources import Label, is_previous, previous
from bayesmc.engines.grid.tables import GridModel
from bayesmc.errors import BayesmcError, GridWarning, UnsupportedError
from bayesmc.factors.named import largest
from bayesmc.network.node import nodes_read


@dataclass(frozen=True)
class GridOptions:
    """The options of ``GridFilter``, which says what they are."""

    grid: Mapping[str, Any] = field(default_factory=dict)
    cells: int | None = None
    quadrature: str = "midpoint"
    max_bytes: float = float(2**30)
    tolerance: float = 0.01

    def __post_init__(self) -> None:
        if not isinstance(self.grid, Mapping):
            raise ValueError(
                f"GridFilter(grid={type(self.grid).__name__}): give a dict from node to (low, high, cells) "
                "or an array of points"
            )
        cells = CELLS if self.cells is None else self.cells
        if isinstance(cells, bool) or not isinstance(cells, (int, np.integer)) or cells < 2:
            raise ValueError(f"GridFilter(cells={cells!r}): give a number of cells, 2 or more")
        check_rule(self.quadrature)
        for what in ("max_bytes", "tolerance"):
            if not getattr(self, what) > 0:
                raise ValueError(
                    f"GridFilter({what}={getattr(self, what)!r}): give a number above 0"
                )

    def model_on_grid(
        self,
        slices: Slices,
        static: Mapping[str, np.ndarray],
        logs: bool = False,
        axis: tuple[str, Axis] | None = None,
    ) -> GridModel:
        """The template on its grid; ``axis`` is a node's that was found."""
        cells = CELLS if self.cells is None else self.cells
        axes = read_axes(slices, self.grid, cells, self.quadrature)
        if axis is not None:
            name, own = axis
            missing = {n: why for n, why in axes.missing.items() if n != name}
            axes = Axes({**axes.of, name: (own,)}, axes.asked, missing)
        return GridModel(slices, axes, static, self.max_bytes, logs)


def too_large(model: GridModel, problem: SeriesProblem, max_bytes: float) -> str | None:
    """Why the tables do not fit, found from their sizes alone."""
    hidden = frozenset(n for n in problem.hidden if n in model.own and n not in model.leaves)
    sizes: dict[Any, int] = dict(zip(model.apart, model.lead, strict=True))
    labels: list[Label] = []
    for name in sorted(hidden):
        axes = model.axes.of[name]
        for e in range(model.elements(name)):
            label = (name, e)
            labels.append(label)
            sizes[label] = sizes[previous(label)] = axes[e % len(axes)].size
    scopes = []
    for first in (True, False) if problem.steps > 1 else (True,):
        for name in hidden | set(problem.series.observed):
            if name not in model.own or (
                name in model.leaves and name not in problem.series.observed
            ):
                continue
            scope = model.scope(first, name, hidden)
            cells = [sizes[x] for x in scope]
            if 8 * math.prod(map(float, cells)) > max_bytes:
                return model.too_large(name, cells, 8 * math.prod(map(float, cells)))
            if any(map(is_previous, scope)):
                scopes.append(scope)
    belief: set[Any] = {previous(x) for x in labels} | set(model.apart)
    entries = largest([belief, *scopes], (*labels, *model.apart), sizes)
    if 8 * entries > max_bytes:
        names = ", ".join(sorted(hidden))
        return model.too_large(names, [sizes[x] for x in labels], 8 * entries)
    return None


def without_density(problem: SeriesProblem) -> str | None:
    """A node whose density cannot be evaluated, tried where its parents can be."""
    for model in (problem.slices.first, problem.slices.later):
        for name in problem.slices.stochastic:
            try:
                with quiet():
                    dist, _ = model.evaluate(name, model.probe)
                    model.log_density(name, dist, model.probe[name])
            except (BayesmcError, NotImplementedError) as error:
                why = str(error) or "it is not implemented"
                return f"GridFilter evaluates every density, and that of {name!r} cannot be: {why}"
    return None


def unread(
    model: GridModel, queries: Mapping[str, Callable[..., Any]], hidden: Collection[str]
) -> str | None:
    """Why a query cannot be answered: it reads a node that has no axes."""
    for query, function in queries.items():
        for name in nodes_read(function):
            if name in model.leaves and name in hidden:
                return (
                    f"queries={{{query!r}: ...}} reads {name!r}, which is hidden and not on the grid, "
                    "since nothing depends on it"
                )
    return None


@dataclass(frozen=True)
class GridSearch:
    """The search for the grid of one hidden number, by the options of a filter.

    Parameters
    ----------
    options : GridOptions
    """

    options: GridOptions

    def why_not(self, problem: SeriesProblem) -> str | None:
        """Why no grid is taken unasked: it is where a slice has one hidden number and its error is small."""
        if self.automatic(problem) is None:
            return "a grid is taken unasked where one number of a slice is hidden, and here it is not one"
        try:
            found = self.found(problem)
        except BayesmcError as error:
            return str(error)
        except FloatingPointError as error:  # of a user who has numpy raise, at points of the grid
            return f"a function fails on the grid: {error!r}"
        assert found is not None
        off = float(np.max(found.error))
        most = TAKEN_FAR if found.far else TARGET
        if not off <= most:
            return (
                f"a grid of {found.described} for {found.name!r} has an error of {off:.2g} in the log "
                f"evidence, above {most}"
            )
        each = found.axis.size * math.prod(found.mover.model.lead)
        if 16 * problem.steps * each > self.options.max_bytes:
            return f"the beliefs of {problem.steps} slices on {found.axis.size} cells do not fit max_bytes"
        return None

    def said(self, problem: SeriesProblem) -> tuple[str, ...]:
        """What was found, for users."""
        found = self.found(problem)
        if found is None:
            return ()
        return (
            f"{found.name!r} is the one hidden number of a slice: {found.described}, found from the model "
            f"and the data, give the log evidence to within {float(np.max(found.error)):.1g}",
        )

    def automatic(self, problem: SeriesProblem) -> str | None:
        """The one hidden number of a slice, whose grid is found; None where there is none."""
        if self.options.quadrature != "midpoint":
            return None
        model = self.options.model_on_grid(problem.slices, problem.known_static)
        numbers = _numbers(problem, model)
        if len(numbers) != 1 or numbers[0] in self.options.grid:
            return None
        name = numbers[0]
        if problem.model[name].event_shape or model.elements(name) != 1:
            return None
        bounded = name in model.axes.of
        return (
            None
            if line_of(problem.slices, name) is None or (bounded and self.options.cells)
            else name
        )

    def found(self, problem: SeriesProblem) -> FoundGrid | None:
        """The grid of the one hidden number, found once for a problem; None where there is none to find."""
        if self._key not in problem.cache:
            with quiet():
                problem.cache[self._key] = self._sought(problem)
        return problem.cache[self._key]

    def take(self, problem: SeriesProblem, found: FoundGrid | None) -> None:
        """Answer a problem on the grid found for another with the same nodes, whatever that loses."""
        if found is not None:
            axis = found.name, found.axis
            with quiet():
                model = self.options.model_on_grid(problem.slices, problem.known_static, axis=axis)
            unknown = np.full_like(found.error, np.nan)
            mover = GridMover(model, np.inf)
            found = replace(found, error=unknown, mover=mover, kept=None)
        problem.cache[self._key] = found

    @property
    def _key(self) -> str:
        return f"grid {self.options!r}"

    def _sought(self, problem: SeriesProblem) -> FoundGrid | None:
        name = self.automatic(problem)
        line = None if name is None else line_of(problem.slices, name)
        if name is None or line is None:
            return None
        static = problem.known_static
        rows = [problem.series.row(k) for k in range(problem.steps)]

        def make(axis: Axis) -> GridModel:
            return self.options.model_on_grid(problem.slices, static, axis=(name, axis))

        try:
            return find_grid(name, line, make, rows, self.options.cells)
        except UnsupportedError as error:
            raise UnsupportedError(
                f"GridFilter: {error}; give it one, grid={{{name!r}: (low, high, cells)}}, or use "
                "ParticleFilter(particles)"
            ) from None

    def with_error(self, problem: SeriesProblem, posterior: GridPosterior) -> GridPosterior:
        """With the error of the log evidence, which is not known of a grid that was given."""
        found = self.found(problem)
        if found is not None:
            error = found.error
            posterior.log_marginal_likelihood_mcse = error if error.ndim else float(error)
            if not np.max(error) <= TARGET and np.isfinite(self.options.tolerance):
                other = (
                    "; some of it lands far from the rest, where particles seldom come"
                    if found.far
                    else ", or use ParticleFilter(particles)"
                )
                warnings.warn(
                    f"GridFilter: {found.described} for {found.name!r} have an error of "
                    f"{float(np.max(error)):.2g} in the log evidence; give a grid of your own, "
                    f"grid={{{found.name!r}: (low, high, cells)}}{other}",
                    GridWarning,
                    stacklevel=5,
                )
        elif _numbers(problem, self.options.model_on_grid(problem.slices, problem.known_static)):
            nothing = np.full(np.shape(posterior.log_marginal_likelihood), np.nan)
            posterior.log_marginal_likelihood_mcse = nothing if nothing.ndim else np.nan
        return posterior


def _numbers(problem: SeriesProblem, model: GridModel) -> list[str]:
    """Hidden nodes that have cells and no states."""
    return [
        n
        for n in problem.hidden
        if n in model.own and n not in model.leaves and problem.model[n].domain is None
    ]
