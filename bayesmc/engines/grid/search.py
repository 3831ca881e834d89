"""The search of ``GridFilter`` for a grid: where there is one to find, and when it is taken unasked."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

import numpy as np

from bayesmc.dbn import SeriesProblem
from bayesmc.engines.filtering import quiet
from bayesmc.engines.grid.automatic import TAKEN_FAR, TARGET, FoundGrid, find_grid
from bayesmc.engines.grid.axes import Axis, line_of
from bayesmc.engines.grid.options import GridOptions, known_static
from bayesmc.engines.grid.posterior import GridPosterior
from bayesmc.engines.grid.tables import GridModel
from bayesmc.errors import BayesmcError, GridWarning, UnsupportedError


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
        model = self.options.model_on_grid(problem.slices, known_static(problem))
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
        key = f"grid {self.options!r}"
        if key not in problem.cache:
            with quiet():
                problem.cache[key] = self._sought(problem)
        return problem.cache[key]

    def _sought(self, problem: SeriesProblem) -> FoundGrid | None:
        name = self.automatic(problem)
        line = None if name is None else line_of(problem.slices, name)
        if name is None or line is None:
            return None
        static = known_static(problem)
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
        elif _numbers(problem, self.options.model_on_grid(problem.slices, known_static(problem))):
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
