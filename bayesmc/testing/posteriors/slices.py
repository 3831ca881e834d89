"""Beliefs over time as one posterior about the slices of the unrolled net, which exact answers are about.

What a posterior is compared with is not known here.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.errors import ShapeError, UnsupportedError
from bayesmc.network import Model
from bayesmc.results.series import SeriesPosterior

#: kinds of beliefs that are given all rows in every slice, and those that are only in the last
_SMOOTHED, _FILTERED = ("smooth",), ("filter", "fixed-lag")


class Slices:
    """A `SeriesPosterior` without Monte Carlo error, with a node for each slice: ``"x[0]"``, ``"x[1]"``.

    Of a filter, and of smoothing with a fixed lag, only the last slice is given all rows; it alone is there.

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
        if series.kind not in (*_SMOOTHED, *_FILTERED):
            raise UnsupportedError(
                f"{test}: {series!r} is given none of the rows it is about; compare what bmc.smooth or "
                "bmc.filter answers"
            )
        steps, reached = getattr(exact, "steps", None), series.start + series.steps
        if steps not in (None, reached):
            raise ShapeError(
                f"{test}: {series!r} is about {reached} slices, the exact answer about {steps}; give both "
                "the same rows"
            )
        self._series, self.model = series, exact.model
        first = 0 if series.kind in _SMOOTHED else series.steps - 1
        self._places = {
            _unrolled(name, series.start + t, self.model): (name, t)
            for t in range(first, series.steps)
            for name in series.names
        }
        found = series.log_marginal_likelihood
        known = getattr(exact, "log_static", None)  # static nodes are no part of its evidence
        self.log_marginal_likelihood = (
            None if found is None or known is None else float(np.sum(found)) + known
        )

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._places)

    def mean(self, name: str) -> np.ndarray:
        return self._at("mean", name)

    def var(self, name: str) -> np.ndarray:
        return self._at("var", name)

    def probabilities(self, name: str) -> np.ndarray:
        return self._at("probabilities", name)

    def ess(self, name: str) -> np.ndarray:
        """Infinite: there is no Monte Carlo error."""
        return np.full((), np.inf)

    def mcse(self, name: str) -> np.ndarray:
        return np.zeros(())

    def __repr__(self) -> str:
        return repr(self._series)

    def _at(self, figure: str, name: str) -> np.ndarray:
        of, t = self._places[name]
        return np.asarray(getattr(self._series, figure)(of))[t]


# ---- private ------------------------------------------------------------------------------------


def _unrolled(name: str, t: int, model: Model) -> str:
    """The name of a slice's node; static ones have one name for all slices."""
    own = f"{name}[{t}]"
    return own if own in model.nodes else name
