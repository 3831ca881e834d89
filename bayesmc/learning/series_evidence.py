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
from bayesmc.learning.objectives import Evidence, steps_around
from bayesmc.learning.several_points import SeveralPoints
from bayesmc.learning.unknowns import Unknowns

#: points whose evidences and slopes are remembered
_REMEMBERED = 8
#: rows beyond which points are no longer next to free, so that slopes are only asked where they are wanted
_LONG = 2000
#: mass of a slice that a grid found for one point may lose besides at another, or have too much
_OFF = 1e-3
#: cells that a trial may always take, and how many times more than the last step took
_CELLS, _FINER = 512, 8


class SeriesEvidence(Evidence):
    """What a filter says of a series, given static nodes.

    A point and those around it, whose differences are the slope there, are asked in one pass where the filter
    can. A grid that is found for one point is kept for those near it, as long as it fits: finding one takes
    most of the time, and grids that change from point to point make differences rough.
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
        self._off: float | None = None
        self._is_of_trial = False
        self._together: SeveralPoints | None = None
        self._known: dict[bytes, tuple[float, np.ndarray | None]] = {}
        #: whether something is found anew for points that lie far from each other
        self.is_costly = isinstance(engine, GridFilter)

    def value(self, u: np.ndarray) -> float:
        key = u.tobytes()
        together = self._together
        if key not in self._known and together is not None and together.problem.steps > _LONG:
            self._remember(key, (super().value(u), None))
        elif key not in self._known:
            around = self._around(u)
            self._remember(key, around if around is not None else (self._alone(u), None))
        return self._known[key][0]

    def gradient(self, u: np.ndarray) -> np.ndarray:
        key = u.tobytes()
        if self._known.get(key, (0.0, None))[1] is None:
            around = self._around(u)
            value = self._known[key][0] if key in self._known else self._alone(u)
            self._remember(key, around if around is not None else (value, super().gradient(u)))
        slope = self._known[key][1]
        assert slope is not None
        return slope

    def values(self, us: np.ndarray) -> np.ndarray:
        """At several points."""
        found = self._at_once(us)
        return (
            np.array([super(SeriesEvidence, self).value(u) for u in us]) if found is None else found
        )

    def settle(self, u: np.ndarray) -> bool:
        """Keep for points near ``u`` what is found there; False where nothing is, and nothing changes."""
        if not isinstance(self.engine, GridFilter):
            return False
        self._grid = self._off = None  # so that this point's is sought
        self._is_of_trial = False
        self._known.clear()
        try:
            with np.errstate(all="ignore"):
                self._grid = self.engine.grid_for(self._posed(self.unknowns.values(u)))
        except BayesmcError as error:
            self.refused = error
        return self._grid is not None

    def step_to(self, u: np.ndarray) -> None:
        """Told of every step that is taken: a grid that a trial further off needed may be too fine here."""
        if self._is_of_trial:
            self.settle(u)

    # ---- private ------------------------------------------------------------------------------

    def _alone(self, u: np.ndarray) -> float:
        """By a pass of its own, where points side by side could not be asked."""
        found = super().value(u)
        if self._together is not None and np.isfinite(found):
            self._together.missed()
        return found

    def _remember(self, key: bytes, found: tuple[float, np.ndarray | None]) -> None:
        self._known.pop(key, None)
        while len(self._known) >= _REMEMBERED:
            self._known.pop(next(iter(self._known)))
        self._known[key] = found

    def _around(self, u: np.ndarray) -> tuple[float, np.ndarray] | None:
        """The value at a point and the slope there, by one pass; None where it takes several."""
        points, steps = steps_around(u)
        found = self._at_once(np.vstack([u, points]))
        if found is None or not np.isfinite(found).all():
            return None
        low, high = found[1:].reshape(-1, 2).T
        return float(found[0]), (high - low) / (2 * steps)

    def _at_once(self, us: np.ndarray) -> np.ndarray | None:
        """Values at several points by one pass, held against single ones until they have agreed."""
        try:
            points = [self.unknowns.values(u) for u in us]
            if self._together is None:
                self._together = SeveralPoints(self._posed(points[0]), self.engine)
        except BayesmcError:
            return None
        found = self._together.log_evidences(points)
        if found is None:
            return None
        if self.with_prior:
            found = found + np.array([self.unknowns.log_prior(u) for u in us])
        found = np.where(np.isfinite(found), found, -np.inf)
        if not self._together.is_trusted:
            for k in {0, len(us) - 1}:
                if not self._together.holds(found[k], super().value(us[k])):
                    return None
        return found

    def _posed(self, values: Mapping[str, np.ndarray]) -> SeriesProblem:
        return pose_series(self.dbn, {**self.data, **values}, self.inputs)

    def _log_evidence(self, values: Mapping[str, np.ndarray]) -> float:
        asked = self._posed(values)
        found, off = self._filtered(asked)
        if self._grid is None or not isinstance(self.engine, GridFilter):
            return found
        if self._off is None:  # at the point that it was found for, or next to it
            self._off = off
        elif (
            off > 2 * self._off + _OFF
        ):  # too coarse here, or too narrow: densities add up to nothing true
            asked = self._posed(values)
            other = self.engine.grid_for(asked)
            if other is not None and other.axis.size > max(_CELLS, _FINER * self._grid.axis.size):
                raise UnsupportedError(
                    f"GridFilter takes {other.described} for {other.name!r}, which no step is worth"
                )
            self._known.clear()
            self._grid, self._off = other, None
            found, self._off = self._filtered(asked)
            self._is_of_trial = True
        return found

    def _filtered(self, asked: SeriesProblem) -> tuple[float, float]:
        """The log evidence, and how much mass a grid lost, or had too much."""
        asked.cache[UNCOMPARED] = True
        if self._grid is not None and isinstance(self.engine, GridFilter):
            self.engine.taking(asked, self._grid)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # at parameters that do not fit, filters say so
            if isinstance(self.engine, GridFilter):
                return self.engine.log_evidence(asked)
            found = self.engine.filter(
                asked, np.random.SeedSequence(0), progress=False
            ).log_marginal_likelihood
        return float(np.sum(found)), 0.0


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
