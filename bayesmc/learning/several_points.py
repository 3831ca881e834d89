"""The log evidence of a series at several values of its static nodes in one pass: points as one more plate.

A filter treats elements of a plate that never meet side by side, in arrays. So a template with all nodes in a
plate of points, and each point's values of the static nodes, tells all evidences in a little more time.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from bayesmc.dbn import UNCOMPARED, DynamicBayesNet, SeriesProblem
from bayesmc.dbn.series import Series
from bayesmc.dbn.slices import PREVIOUS, Slices, SliceStore
from bayesmc.engines.filtering import FilterEngine
from bayesmc.engines.grid.filter import GridFilter
from bayesmc.errors import BayesmcError
from bayesmc.network.declaring import DeclaredPlates
from bayesmc.network.evidence import Observed
from bayesmc.network.node import Declaration

#: what the plate of points is called; no name of a user's
_POINT = "\u200bpoint"
#: numbers in a slice beyond which points side by side save nothing, and in all that are held at once
_LARGE, _HELD = 1000, 2e7
#: points that are asked in one pass at most
_MOST = 64
#: how close evidences must be to those of a pass each, and misses in a row after which nobody asks again
_CLOSE, _FAILURES = 1e-8, 10


class SeveralPoints:
    """Evidences of one problem at several values of its static nodes.

    Parameters
    ----------
    problem : SeriesProblem
        In which the static nodes have some values.
    engine : FilterEngine
    """

    def __init__(self, problem: SeriesProblem, engine: FilterEngine) -> None:
        self.problem, self.engine = problem, engine
        self._made: dict[int, tuple[DynamicBayesNet, Slices, Series]] = {}
        self._trusted, self._failed = False, 0
        self._most = min(_MOST, _numbers_that_fit(problem, engine))

    def log_evidences(self, points: Sequence[Mapping[str, np.ndarray]]) -> np.ndarray | None:
        """The log evidence at each point; None where it cannot be told for all at once.

        Parameters
        ----------
        points : sequence of dict
            Static node -> stored value, the same nodes in all.
        """
        if self._failed >= _FAILURES or self._most < 2:
            return None
        starts = range(0, len(points), self._most)
        parts = [self._asked(points[k : k + self._most]) for k in starts]
        if any(part is None for part in parts):
            return None
        self._failed = 0
        return np.concatenate([part for part in parts if part is not None])

    def missed(self) -> None:
        """Note that it did not tell what one pass after the other does."""
        self._failed += 1

    def holds(self, found: float, alone: float) -> bool:
        """Whether an evidence is that of a pass of its own; where one is not, nobody asks again."""
        same = abs(found - alone) <= _CLOSE * (1.0 + abs(alone))
        self._trusted = same
        if not same:
            self._failed = _FAILURES
        return same

    @property
    def is_trusted(self) -> bool:
        """Whether its answers were held against passes of their own."""
        return self._trusted

    # ---- private ----------------------------------------------------------------------------

    def _asked(self, points: Sequence[Mapping[str, np.ndarray]]) -> np.ndarray | None:
        count = len(points)
        try:
            if count not in self._made:
                self._made[count] = _plated(self.problem, count)
            dbn, slices, series = self._made[count]
            own = {n: Observed(np.stack([p[n] for p in points])) for n in points[0]}
            series = replace(series, static={**series.static, **own})
            asked = SeriesProblem(dbn, slices, series)
            asked.cache[UNCOMPARED] = True
            with warnings.catch_warnings(), np.errstate(all="ignore"):
                warnings.simplefilter("ignore")
                found = self.engine.filter(
                    asked, np.random.SeedSequence(0), progress=False
                ).log_marginal_likelihood
        except (
            BayesmcError,
            ArithmeticError,
            LookupError,
            MemoryError,
            TypeError,
            ValueError,
        ):  # one by one says what is wrong
            return None
        found = np.asarray(found, dtype=float)
        if not found.ndim or found.shape[0] != count:
            return None
        return found.reshape(count, -1).sum(axis=1)


# ---- private ------------------------------------------------------------------------------------


def _numbers_that_fit(problem: SeriesProblem, engine: FilterEngine) -> int:
    """How many points may be asked at once, by what a filter would hold; 0 where it saves nothing."""
    model, names = problem.model, problem.slices.dynamic
    width = sum(math.prod(model[n].value_shape) for n in names)
    if width > _LARGE or problem.series.start or any(model[n].is_object for n in names):
        return 0
    hidden = [model[n] for n in problem.hidden if model[n].is_stochastic]
    if isinstance(engine, GridFilter) and (
        len(engine.grid or ()) != 1
        or any(n.domain is None and n.value_shape for n in hidden)
        or any(n.domain is not None for n in hidden)
    ):
        return 0  # pairs of cells, not calls, are what takes its time
    joint = math.prod(
        float(n.domain.size) ** math.prod(n.plate_shape) for n in hidden if n.domain is not None
    )
    return int(_HELD / (problem.steps * (width + joint**2)))


def _plated(problem: SeriesProblem, count: int) -> tuple[DynamicBayesNet, Slices, Series]:
    """The template with its nodes in a plate of points, and the same rows for each of them."""
    template, series = problem.dbn.template, problem.series
    plates = template.plates
    own = DeclaredPlates(plates.owner, {_POINT: count, **plates.sizes}, dict(plates.labels))

    def raised(declared: Mapping[str, Declaration]) -> dict[str, Declaration]:
        return {
            n: d if n in template.inputs else replace(d, plates=(_POINT, *d.plates))
            for n, d in declared.items()
        }

    dbn = problem.dbn.copy()
    later, first = raised(template.later), raised(template.first)
    dbn._store = SliceStore(replace(template, later=later, first=first, plates=own))
    rows = series.inputs
    two = {n: v[min(1, series.steps - 1)] for n, v in rows.items()}
    two |= {n + PREVIOUS: v[0] for n, v in rows.items()}
    slices = dbn.slices({_POINT: count, **problem.slices.later.sizes}, two)
    observed = {n: _repeated(seen, count, 1) for n, seen in series.observed.items()}
    static = {n: _repeated(seen, count, 0) for n, seen in series.static.items()}
    return dbn, slices, replace(series, observed=observed, static=static)


def _repeated(seen: Observed, count: int, axis: int) -> Observed:
    """The same for every point."""

    def along(values: np.ndarray | None) -> np.ndarray | None:
        if values is None:
            return None
        return np.repeat(np.expand_dims(values, axis), count, axis=axis)

    value = along(seen.value)
    assert value is not None
    return Observed(value, along(seen.mask), along(seen.parts))
