"""Numbers whose density is known given finite variables: in every slice an exact mixture of densities."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.distributions.discrete import whole_ppf
from bayesmc.distributions.mixture import invert
from bayesmc.engines.discrete.answers import SliceAnswers
from bayesmc.engines.discrete.rows import Rows, Term
from bayesmc.engines.filtering import quiet
from bayesmc.errors import UnsupportedError
from bayesmc.results.laws import CurveLaws, Laws, TableLaws
from bayesmc.shapes import padded

#: what is left out beyond both ends of a table of counts, and how many entries one may have
_LEFT_OUT, _MOST = 1e-14, 20_000_000


class SliceMixtures:
    """A node that is no finite variable, in the last slices of a run: mixtures over configurations.

    Parameters
    ----------
    answers : SliceAnswers
    name : str
    steps : int

    Raises
    ------
    UnsupportedError
        The node is computed, its values are vectors or angles, or its family has no closed cdf.
    """

    def __init__(self, answers: SliceAnswers, name: str, steps: int) -> None:
        self.answers, self.name, self.node = answers, name, answers.model[name]
        self.first = answers.run.first + answers.run.steps - steps
        self.shape = (steps, *self.node.plate_shape)
        if not self.node.is_stochastic or self.node.event_shape or self.node.angles is not None:
            raise UnsupportedError(f"{name!r} is no number with a density of its own")
        self.seen, self.mask = self._seen(steps)
        self._ends(np.full((1, *self.shape), 0.5))  # whether the family has them

    def cdf(self, points: np.ndarray) -> np.ndarray:
        """At points of shape ``(*lead, *shape)``."""
        found = self._at(points, "cdf")
        return np.where(self.mask, self.seen <= points, np.minimum(found, 1.0))

    def log_density(self, points: np.ndarray) -> np.ndarray:
        """Of such points; 0 of what was seen."""
        with np.errstate(divide="ignore"):
            return np.where(self.mask, 0.0, np.log(self._at(points, "density")))

    def ppf(self, levels: np.ndarray) -> np.ndarray:
        """Quantiles at levels of such a shape, between the least and the greatest of the components."""
        levels = np.asarray(levels, dtype=float)
        lead = levels.shape[: levels.ndim - len(self.shape)]
        low, high = (
            end.reshape(levels.shape)
            for end in self._ends(levels.reshape(math.prod(lead), *self.shape))
        )
        if self.node.is_discrete:
            inner = np.where((levels > 0) & (levels < 1) & ~self.mask, levels, np.nan)
            start, stop = (np.where(np.isnan(inner), 0.0, end) for end in (low, high))
            found = whole_ppf(self.cdf, inner, start, stop)
            found = np.where(levels <= 0, low, np.where(levels >= 1, high, found))
        elif np.array_equal(low, high, equal_nan=True):
            found = low
        else:
            found = invert(self.cdf, self.log_density, levels, low, high)
        return np.where(self.mask, self.seen, found)

    def laws(self) -> Laws:
        """Their laws: of counts a table as long as their mass, of others a curve."""
        if not self.node.is_discrete:
            return CurveLaws(self.shape, self.ppf, self.cdf, self.log_density)
        return _CountLaws(self)

    # ---- private ----------------------------------------------------------------------------

    def _seen(self, steps: int) -> tuple[np.ndarray, np.ndarray]:
        """What was seen of the node, and where."""
        seen = self.answers.run.series.observed.get(self.name)
        if seen is None:
            return np.zeros(self.shape), np.zeros(self.shape, bool)
        value = np.asarray(seen.value[-steps:], dtype=float)
        if seen.mask is None:
            return value, np.ones(self.shape, bool)
        return np.where(seen.mask[-steps:], value, 0.0), np.asarray(seen.mask[-steps:])

    def _at(self, points: np.ndarray, what: str) -> np.ndarray:
        """Averages over configurations of what components say of points."""
        points = np.asarray(points, dtype=float)
        lead = points.shape[: points.ndim - len(self.shape)]
        flat = points.reshape(math.prod(lead), *self.shape)
        (found,) = self._read(flat, what, [_average])
        return found.reshape(points.shape)

    def _ends(self, levels: np.ndarray) -> list[np.ndarray]:
        """The least and the greatest quantile of the components that are possible."""
        return self._read(levels, "ppf", [_least, _greatest])

    def _read(self, points: np.ndarray, what: str, ways: list[Any]) -> list[np.ndarray]:
        """What components say of points ``(points, *shape)``, put together in some ways."""
        answers, reader = self.answers, self.answers.reader
        found = [np.empty((*self.shape, len(points))) for _ in ways]
        cards = float(math.prod(reader.cards(answers.plan.terms[self.name, 2])))
        for start, stop in answers.stretches_of(self.name, cards * len(points)):
            start = max(start, self.first)
            if start >= stop:
                continue
            rows = answers.plan.rows(answers.run.series, start, stop)
            term = answers.plan.terms[self.name, rows.kind]
            axes = len(reader.cards(term))
            (values,) = reader.over_rows(
                term, rows, partial(self._values, points=points, what=what)
            )
            for element in range(reader.elements(self.name)):
                weights = answers.run.joint(reader.scope(term, element), start, stop)
                own = reader.at_element(values, self.node, axes, element, 1)
                for out, way in zip(found, ways, strict=True):
                    part = out[start - self.first : stop - self.first]
                    reader.put_element(part, self.node, element, way(weights, own))
        return [np.moveaxis(out, -1, 0) for out in found]

    def _values(self, term: Term, rows: Rows, points: np.ndarray, what: str) -> tuple[np.ndarray]:
        """What each configuration says, shape ``(rows, *cards, *plates, points)``."""
        reader = self.answers.reader
        cards = len(reader.cards(term))
        x = points[:, rows.start - self.first : rows.stop - self.first]
        x = x.reshape(*x.shape[:2], *(1,) * cards, *x.shape[2:])
        with quiet():
            result, _ = reader.evaluate(term, rows)
            assert isinstance(result, Distribution)
            if what == "density":
                values = np.exp(result.log_prob(x))
            else:
                values = result.cdf(x) if what == "cdf" else result.ppf(x)
        return (np.moveaxis(padded(np.asarray(values), 2 + cards + len(self.node.plates)), 0, -1),)


class _CountLaws:
    """Counts: a table where it is short enough, and the cdf anywhere."""

    def __init__(self, mixtures: SliceMixtures) -> None:
        self.mixtures = mixtures

    def cdf(self, points: np.ndarray) -> np.ndarray:
        shape = self.mixtures.shape
        points = np.asarray(points, dtype=float)
        full = np.broadcast_shapes(points.shape, shape)
        return self.mixtures.cdf(np.broadcast_to(points, full))

    def hdi(self, prob: float) -> np.ndarray:
        return self._table().hdi(prob)

    def mode(self) -> np.ndarray:
        table = self._table()
        assert table.numbers is not None
        return table.numbers[table.mode()]

    def entropy(self) -> np.ndarray:
        return self._table().entropy()

    def _table(self) -> TableLaws:
        mixtures = self.mixtures
        ends = np.array([_LEFT_OUT, 1.0 - _LEFT_OUT]).reshape(2, *(1,) * len(mixtures.shape))
        low, high = mixtures.ppf(np.broadcast_to(ends, (2, *mixtures.shape)))
        least, most = float(low.min()), float(high.max())
        if not (most - least) * math.prod(mixtures.shape) < _MOST:
            raise UnsupportedError(
                f"{mixtures.name!r}: its counts lie between {least:.3g} and {most:.3g}, too many for a table "
                "of all; ask cdf or quantile"
            )
        numbers = np.arange(least - 1.0, most + 1.0)
        at = numbers.reshape(-1, *(1,) * len(mixtures.shape))
        below = mixtures.cdf(np.broadcast_to(at, (len(numbers), *mixtures.shape)))
        table = np.moveaxis(np.diff(below, axis=0), 0, -1)
        return TableLaws(table / table.sum(axis=-1, keepdims=True), numbers[1:], mixtures.name)


# ---- private ------------------------------------------------------------------------------------


def _average(weights: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Over configurations: weights ``(rows, sequences, *cards)``, values with an axis of points behind."""
    full = weights[..., None]
    return np.where(full > 0, full * values, 0.0).sum(axis=_cards(weights))


def _least(weights: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.where(weights[..., None] > 0, values, np.inf).min(axis=_cards(weights))


def _greatest(weights: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.where(weights[..., None] > 0, values, -np.inf).max(axis=_cards(weights))


def _cards(weights: np.ndarray) -> tuple[int, ...]:
    return tuple(range(2, weights.ndim))
