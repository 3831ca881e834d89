"""The log evidence of a series as a function of static nodes, by a filter without random errors."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from bayesmc.auto.choosing import evidence_engine
from bayesmc.dbn import UNCOMPARED, DynamicBayesNet, SeriesProblem, pose_series
from bayesmc.engines.filtering import FilterEngine
from bayesmc.engines.grid.filter import GridFilter
from bayesmc.errors import BayesmcError, UnsupportedError
from bayesmc.learning.objectives import Evidence
from bayesmc.learning.unknowns import Unknowns


class SeriesEvidence(Evidence):
    """What a filter says of a series, given static nodes.

    A grid that is found for one point is kept for those near it: finding one takes most of the time, and
    grids that change from point to point make differences rough.
    """

    def __init__(
        self,
        unknowns: Unknowns,
        engine: FilterEngine,
        dbn: DynamicBayesNet,
        data: Mapping[str, Any],
        inputs: Any,
        with_prior: bool,
    ) -> None:
        super().__init__(unknowns, self._log_evidence, with_prior)
        self.engine, self.dbn, self.data, self.inputs = engine, dbn, data, inputs
        self._grid: Any = None
        #: whether something is found anew for points that lie far from each other
        self.is_costly = isinstance(engine, GridFilter)

    def settle(self, u: np.ndarray) -> bool:
        """Keep for points near ``u`` what is found there; False where nothing is, and nothing changes."""
        if not isinstance(self.engine, GridFilter):
            return False
        self._grid = None  # so that this point's is sought
        try:
            with np.errstate(all="ignore"):
                self._grid = self.engine.grid_for(self._posed(self.unknowns.values(u)))
        except BayesmcError as error:
            self.refused = error
        return self._grid is not None

    def _posed(self, values: Mapping[str, np.ndarray]) -> SeriesProblem:
        return pose_series(self.dbn, {**self.data, **values}, self.inputs)

    def _log_evidence(self, values: Mapping[str, np.ndarray]) -> float:
        asked = self._posed(values)
        asked.cache[UNCOMPARED] = True
        if self._grid is not None and isinstance(self.engine, GridFilter):
            self.engine.taking(asked, self._grid)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # at parameters that do not fit, filters say so
            found = self.engine.filter(asked, np.random.SeedSequence(0)).log_marginal_likelihood
        return float(np.sum(found))


def of_template(
    dbn: DynamicBayesNet,
    problem: SeriesProblem,
    data: Mapping[str, Any],
    inputs: Any,
    names: tuple[str, ...],
    prior: bool,
    engine: FilterEngine | None,
) -> tuple[SeriesEvidence, Unknowns]:
    """The objective of static nodes, and the numbers behind them.

    Raises
    ------
    UnsupportedError
    """
    for name in names:
        if name not in dbn.static_nodes:
            raise UnsupportedError(
                f"fit: {name!r} has a value in every slice; static nodes are learned (static), and tables"
            )
    left = [n for n in problem.unknown_static if n not in names]
    if left:
        raise UnsupportedError(
            f"fit: the static node {left[0]!r} is neither learned nor observed; name it in learn=, or "
            "observe it"
        )
    unknowns = Unknowns.of(problem.model, names, {})
    first = unknowns.values(unknowns.starts(1, np.random.default_rng(0))[0])
    chosen = evidence_engine(pose_series(dbn, {**data, **first}, inputs), engine)
    return SeriesEvidence(unknowns, chosen, dbn, data, inputs, prior), unknowns
