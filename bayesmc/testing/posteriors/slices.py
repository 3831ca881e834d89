"""Beliefs over time as one posterior about the slices of the unrolled net, which exact answers are about.

What a posterior is compared with is not known here.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np

from bayesmc.dbn.unroll import indexed
from bayesmc.errors import ShapeError, UnknownNodeError, UnsupportedError
from bayesmc.network import Model
from bayesmc.results.series import SeriesPosterior


class SlicePosterior:
    """A `SeriesPosterior` without Monte Carlo error, with a node for each slice: ``"x[0]"``, ``"x[1]"``.

    Of a filter, and of smoothing with a fixed lag, the last slice alone is there: earlier ones are not given
    all rows (or, within the lag, are, and left out all the same).

    Parameters
    ----------
    test : str
        Who asks, for messages.
    series : SeriesPosterior
    exact : object
        What it is compared with, whose ``model`` is that of the unrolled net.

    Raises
    ------
    UnsupportedError
        It holds particles, or forecasts.
    UnknownNodeError
        The exact answer is about another template.
    ShapeError
        The exact answer is about more slices, or fewer.
    """

    log_marginal_likelihood_mcse = 0.0
    weight_ess = None

    def __init__(self, test: str, series: SeriesPosterior, exact: Any) -> None:
        if series.weight_ess is not None:
            raise UnsupportedError(
                f"{test}: one run of particles does not say what its error is; test many: "
                "repeated_test(function of rng that runs the filter, exact figures), "
                "unbiased_evidence_test(engine, dbn, observations)"
            )
        if series.kind not in ("smooth", "filter", "fixed-lag"):
            raise UnsupportedError(
                f"{test}: {series!r} is given none of the rows it is about; compare what bmc.smooth or "
                "bmc.filter answers"
            )
        self._series, self.model = series, exact.model
        self._check(test, series)
        first = 0 if series.kind == "smooth" else series.steps - 1
        self._places = {
            indexed(name, series.start + t): (name, t)
            for t in range(first, series.steps)
            for name in series.names
        }
        self.log_marginal_likelihood = self._log_evidence(series, exact)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._places)

    def mean(self, name: str) -> np.ndarray:
        return self._at("mean", name)

    def var(self, name: str) -> np.ndarray:
        return self._at("var", name)

    def cov(self, name: str) -> np.ndarray:
        size = math.prod(self.model[name].value_shape)
        if not hasattr(self._series, "cov"):
            raise UnsupportedError(f"{self!r} has no covariances")
        found = self._at("cov", name)
        if found.shape != (size, size):  # plates that are filtered apart
            raise UnsupportedError(f"{self!r} has no covariances between the elements of {name!r}")
        return found

    def probabilities(self, name: str) -> np.ndarray:
        return self._at("probabilities", name)

    def ess(self, name: str) -> np.ndarray:
        """Infinite: there is no Monte Carlo error."""
        return np.full((), np.inf)

    def mcse(self, name: str) -> np.ndarray:
        return np.zeros(())

    def __repr__(self) -> str:
        return repr(self._series)

    # ---- private -------------------------------------------------------------------------------

    def _check(self, test: str, series: SeriesPosterior) -> None:
        """The exact answer is about the same nodes and slices."""
        theirs = dict.fromkeys(map(_of_slice, self.model.nodes))
        mine = (*_stochastic(series.model), *series.names)
        unknown = [name for name in mine if name not in theirs]
        stochastic = map(_of_slice, _stochastic(self.model))
        unknown += [name for name in stochastic if name not in series.model.nodes]
        if unknown:
            raise UnknownNodeError(
                f"{test}: only one of the two knows a node {unknown[0]!r}; give beliefs and an exact answer "
                "about the same template: compare(bmc.smooth(dbn, rows), exact(dbn, rows))"
            )
        reached = series.start + series.steps
        steps = next(t for t in itertools.count() if not self._has(series.names, t))
        if steps != reached:
            raise ShapeError(
                f"{test}: {series!r} is about {reached} slices, the exact answer about {steps}; give both "
                "the same rows"
            )

    def _has(self, names: tuple[str, ...], t: int) -> bool:
        return any(indexed(name, t) in self.model.nodes for name in names)

    def _log_evidence(self, series: SeriesPosterior, exact: Any) -> float | None:
        """Log density of all data; None where it is not known what static nodes, no part of it, add."""
        known = getattr(exact, "log_static", None)
        if known is None and all(_of_slice(n) != n for n in _stochastic(self.model)):
            known = 0.0
        found = series.log_marginal_likelihood
        return None if found is None or known is None else float(np.sum(found)) + known

    def _at(self, figure: str, name: str) -> np.ndarray:
        of, t = self._places[name]
        return np.asarray(getattr(self._series, figure)(of))[t]


def _stochastic(model: Model) -> list[str]:
    return [name for name, node in model.nodes.items() if node.is_stochastic]


def _of_slice(name: str) -> str:
    """The template's name of an unrolled node."""
    return name.rpartition("[")[0] or name
