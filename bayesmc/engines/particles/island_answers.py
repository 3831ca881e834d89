"""What islands say of each row, put together by their weights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.categorical import log_sum_exp
from bayesmc.dbn import SeriesProblem
from bayesmc.engines.particles.families import LONGEST
from bayesmc.engines.particles.written import KINDS, Rows


class IslandRows:
    """Answers of all islands about the rows so far, put together stretch by stretch.

    Parameters
    ----------
    islands : int
    """

    def __init__(self, islands: int) -> None:
        self.islands, self.steps = islands, 0
        #: answers of islands, their shares of the weight, and who descends from whom, of each stretch
        self.stretches: list[tuple[Sequence[Rows], np.ndarray, np.ndarray]] = []
        self.increments: list[np.ndarray] = []
        self.exchanges: list[int] = []
        #: of each island its ancestor among the islands, after each of the last exchanges
        self._lines: list[tuple[int, np.ndarray]] = []
        self._base = np.zeros(islands)
        self._variance = 0.0

    def add(
        self,
        rows: Sequence[Rows],
        paths: np.ndarray,
        before: np.ndarray,
        errors: Sequence[float],
    ) -> None:
        """Take in a stretch of rows.

        Parameters
        ----------
        rows : sequence of Rows
            Of each island.
        paths : ndarray, shape (rows, islands)
            Log weights after each row.
        before : ndarray, shape (islands,)
            Before the first.
        errors : sequence of float
            Of each island's own log evidence after the last.
        """
        totals = log_sum_exp(paths, 1)
        earlier = np.concatenate([[log_sum_exp(before)], totals[:-1]])
        shares = np.exp(paths - totals[:, None])
        groups = self._groups()
        self.stretches.append((rows, shares, groups))
        self.increments.append(totals - earlier)
        variances = _variance_of(np.asarray(errors, dtype=float))
        with np.errstate(invalid="ignore"):
            grown = np.maximum(variances - self._base, 0.0)
        grown = _where_known(grown, shares[-1])
        self._variance += _together(shares[-1:], grown[None], groups).item()
        self._base = variances
        self.steps += len(paths)

    def exchanged(self, source: Sequence[int]) -> None:
        """Islands have become copies of others after the rows so far."""
        chosen = np.asarray(source)
        self.exchanges.append(self.steps - 1)
        self._base = self._base[chosen]
        recent = [(at, line[chosen]) for at, line in self._lines if at > self.steps - LONGEST]
        self._lines = [*recent, (self.steps, chosen)]

    @property
    def error(self) -> float:
        """Of the log evidence so far, with its bias of minus half its variance."""
        return float(np.sqrt(self._variance + 0.25 * self._variance**2))

    @property
    def state(self) -> dict[str, Any]:
        """What is known besides the stretches."""
        return {
            "steps": self.steps, "exchanges": list(self.exchanges), "lines": list(self._lines),
            "base": self._base, "variance": self._variance,
        }  # fmt: skip

    def since(self, stretches: int) -> list[tuple[Any, ...]]:
        """Stretches from one on, with the increments of their rows."""
        increments = self.increments[stretches:]
        pairs = zip(self.stretches[stretches:], increments, strict=True)
        return [(*stretch, own) for stretch, own in pairs]

    def go_on(self, stretches: Sequence[tuple[Any, ...]], state: Mapping[str, Any]) -> None:
        """Be where another one was, which gave its stretches and its state."""
        self.stretches = [(rows, shares, groups) for rows, shares, groups, _ in stretches]
        self.increments = [own for *_, own in stretches]
        self.steps, self.exchanges = state["steps"], list(state["exchanges"])
        self._lines = [(at, line) for at, line in state["lines"]]
        self._base, self._variance = state["base"], state["variance"]

    def _groups(self) -> np.ndarray:
        """A number for each island, the same for those with an ancestor in common not long ago."""
        recent = [line for at, line in self._lines if at > self.steps - LONGEST]
        return recent[0] if recent else np.arange(self.islands)


def answered(rows: IslandRows, problem: SeriesProblem) -> dict[str, dict[str, np.ndarray]]:
    """Answers by kind and node, slices first."""
    found: dict[str, dict[str, list[np.ndarray]]] = {kind: {} for kind in KINDS}
    for increments, (parts, shares, groups) in zip(rows.increments, rows.stretches, strict=True):
        stretch = _Stretch(parts, shares, groups)
        for kind in ("tables", "queries"):
            for name in parts[0][kind]:
                found[kind].setdefault(name, []).append(stretch.mean(kind, name))
        for name in parts[0]["means"]:
            mean, variance = stretch.moments(name, problem.model[name].angles)
            found["means"].setdefault(name, []).append(mean)
            found["variances"].setdefault(name, []).append(variance)
        for kind in ("errors", "query errors"):
            for name in parts[0][kind]:
                found[kind].setdefault(name, []).append(stretch.error(kind, name))
        for name, value in stretch.figures().items():
            found["filter"].setdefault(name, []).append(value)
        found["filter"].setdefault("increments", []).append(increments)
    return {k: {n: np.concatenate(v) for n, v in own.items()} for k, own in found.items()}


# ---- private ------------------------------------------------------------------------------------


class _Stretch:
    """Rows between two looks at the islands."""

    def __init__(self, parts: Sequence[Rows], shares: np.ndarray, groups: np.ndarray) -> None:
        self.parts, self.shares, self.groups = parts, shares, groups

    def stacked(self, kind: str, name: str) -> tuple[np.ndarray, np.ndarray]:
        """What islands say, shape (rows, islands, ...), and their shares in as many axes.

        Of an island without weight left there is nothing: it counts for nothing.
        """
        steps, count = self.shares.shape
        one = next(p[kind][name] for p in self.parts if len(p[kind].get(name, ())) >= steps)
        found = np.zeros((steps, count, *one.shape[1:]), dtype=float)
        for i, part in enumerate(self.parts):
            own = part[kind].get(name)
            if own is not None:
                low = min(len(own), steps)
                found[:low, i] = own[:low]
        shares = self.shares.reshape(steps, count, *[1] * (found.ndim - 2))
        return found, shares

    def mean(self, kind: str, name: str) -> np.ndarray:
        found, shares = self.stacked(kind, name)
        return np.asarray((found * shares).sum(axis=1))

    def moments(self, name: str, angles: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Mean and variance; of angles the direction, and -2 log of the mean resultant length."""
        means, shares = self.stacked("means", name)
        variances, _ = self.stacked("variances", name)
        mean = (means * shares).sum(axis=1)
        variance = ((variances + (means - mean[:, None]) ** 2) * shares).sum(axis=1)
        if angles is None:
            return mean, variance
        length = np.exp(-0.5 * variances) * shares
        cosine, sine = (length * np.cos(means)).sum(axis=1), (length * np.sin(means)).sum(axis=1)
        turned = np.arctan2(sine, cosine)
        with np.errstate(divide="ignore"):
            spread = -np.log(np.minimum(cosine**2 + sine**2, 1.0))
        return np.where(angles, turned, mean), np.where(angles, spread, variance)

    def error(self, kind: str, name: str) -> np.ndarray:
        found, _ = self.stacked(kind, name)
        return np.sqrt(_together(self.shares, found**2, self.groups))

    def figures(self) -> dict[str, np.ndarray]:
        """Figures of the filter itself."""
        ess, shares = self.stacked("filter", "weight_ess")
        with np.errstate(divide="ignore", invalid="ignore"):
            worth = 1.0 / np.where(shares > 0, shares**2 / ess, 0.0).sum(axis=1)
        found = {"weight_ess": worth}
        for name in ("counts", "injected", "unique_ancestors"):
            found[name] = self.stacked("filter", name)[0].sum(axis=1).astype(int)
        for name in ("resampled", "rejuvenated"):
            found[name] = self.stacked("filter", name)[0].any(axis=1)
        return found


def _together(shares: np.ndarray, variances: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Variances of weighted means over islands, of which those of a group are as one.

    Parameters
    ----------
    shares : ndarray, shape (rows, islands)
    variances : ndarray, shape (rows, islands, ...)
    groups : ndarray of int, shape (islands,)
    """
    found: Any = 0.0
    for group in np.unique(groups):
        own = groups == group
        part = shares[:, own]
        whole = part.sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            within = np.where(whole[:, None] > 0, part / whole[:, None], 0.0)
        shape = (*within.shape, *[1] * (variances.ndim - 2))
        within = within.reshape(shape)
        with np.errstate(invalid="ignore"):
            mean = np.where(within > 0, within * variances[:, own], 0.0).sum(axis=1)
            square = (whole**2).reshape(-1, *[1] * (variances.ndim - 2))
            found = found + np.where(square > 0, square * mean, 0.0)
    return np.asarray(found)


def _where_known(variances: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Variances; of an island that cannot tell its own the largest of the others, where most can."""
    known = np.isfinite(variances)
    if shares[known].sum() <= 0.5:
        return np.full(len(variances), np.inf)
    return np.where(known, variances, variances[known].max())


def _variance_of(error: np.ndarray) -> np.ndarray:
    """Variances of logs v behind errors sqrt(v + v**2 / 4)."""
    return 2.0 * (np.sqrt(1.0 + error**2) - 1.0)
