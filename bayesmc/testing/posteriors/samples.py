"""Draws as evidence: how much a posterior's draws say of an average, and whether two samples have one law.

Draws of all kinds (weighted, resampled, of chains, independent) are read the same way here: an average comes
with its own standard error and skewness, a share with its effective number of draws, and a joint sample as
rows that are independent of each other. Two such samples are told apart by their energy distance, with
labels moved between them (an exact test). Engines and exact answers are unknown to this room; comparing
stands in ``matching``.

References
----------
Szekely and Rizzo (2004), Testing for equal distributions in high dimension, InterStat 5.
Hall (1992), On the removal of skewness by transformation, JRSS B 54.
Besag and Clifford (1991), Sequential Monte Carlo p-values, Biometrika 78.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.special

from bayesmc import diagnostics
from bayesmc.errors import ShapeError
from bayesmc.randomness import seed_sequence
from bayesmc.results.draws import DrawsPosterior
from bayesmc.states import StateArray
from bayesmc.testing.posteriors.skewed import unskewed
from bayesmc.testing.verdict import Comparison, Verdict, counted

#: relabellings at least as far apart after which no more are drawn (Besag and Clifford 1991)
_ENOUGH = 20
#: relabellings at most; smaller p-values are extrapolated
_MOST = 2000
#: relabellings done in one product of matrices
_AT_ONCE = 64
#: rows of one sample, at most: the distances of all pairs are kept
_ROWS = 1000
#: chains are thinned to one draw in so many of those that count as one
_APART = 2.0


#: digits of a column's largest number to which two samples are held against each other
_DIGITS = 10


def same_distribution(
    first: Any,
    second: Any,
    *,
    angles: Sequence[str] = (),
    alpha: float = 1e-3,
    rng: Any = None,
) -> Verdict:
    """Do two samples of independent draws come from one joint distribution?

    By the energy distance of the rows, whose law under the hypothesis comes from moving rows between the
    samples. Of every number its rank among both samples is taken (labels: one column for each, angles: their
    cosine and sine), so that no moments are needed. It sees wrong dependences between right marginals, too.

    The false-alarm rate is exact (at most ``alpha``) where all rows are independent, whatever their law and
    number. Relabelling goes on until 20 of them are as far apart as what was found, or enough to decide at
    ``alpha``, so that like samples are told quickly. After 2000 of them, which an ``alpha`` below 1e-3 asks
    for, what is left is read off the gamma law with their first three moments (Knijnenburg et al. 2009).

    Parameters
    ----------
    first, second : dict or array_like
        Variable -> draws of shape ``(n, ...)``, with one ``n`` for all of a sample; or a single array. More
        than 1000 rows are thinned evenly.
    angles : sequence of str
        Variables in radians.
    alpha : float
        False-alarm rate.
    rng : seed, Generator or None

    Returns
    -------
    Verdict
        Of one comparison: the energy distance against its mean over relabellings.

    Raises
    ------
    ShapeError
        Samples of other variables or shapes, or with fewer than two rows.

    References
    ----------
    Szekely and Rizzo (2004), InterStat 5, eq. 2; Besag and Clifford (1991), Biometrika 78; Knijnenburg et
    al. (2009), Fewer permutations, more accurate P-values, Bioinformatics 25.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.testing import same_distribution
    >>> rng = np.random.default_rng(0)
    >>> x, y, z = rng.normal(size=(3, 300))
    >>> coupled = {"x": x, "y": 0.8 * x + 0.6 * z}
    >>> bool(same_distribution({"x": x, "y": z}, coupled, rng=1))
    False
    """
    a, b = _named(first), _named(second)
    _check_samples(a, b)
    generator = np.random.default_rng(seed_sequence(rng))
    labels = [n for n, v in a.items() if isinstance(v, StateArray) or v.dtype.kind not in "biuf"]
    comparison = energy_comparison(a, b, alpha, generator, angles, labels)
    return counted(Verdict("same_distribution", alpha, [comparison]))


def energy_comparison(
    first: Mapping[str, np.ndarray],
    second: Mapping[str, np.ndarray],
    level: float,
    rng: np.random.Generator,
    angles: Sequence[str] = (),
    labels: Sequence[str] = (),
    what: str = "joint draws",
) -> Comparison:
    """The comparison behind `same_distribution`, whose p-value can fall below ``level``."""
    first, second = _thinned(first), _thinned(second)
    columns = []
    for name in first:
        both = np.concatenate([_plain(first[name]), _plain(second[name])])
        columns += _features(both, name in angles, name in labels)
    size = len(next(iter(first.values())))
    title = f"{what} of {', '.join(map(repr, list(first)[:6]))}" + (", ..." * (len(first) > 6))
    if not columns:
        return Comparison(f"{title} (all constant)", 0.0, 0.0, 0.0, 1.0)
    rows = np.stack(columns, axis=1)
    found, mean, spread, p_value = _relabelled(_distances(rows), size, level, rng)
    errors = (found - mean) / spread if spread > 0 else 0.0
    return Comparison(f"{title} (energy distance)", found, mean, errors, p_value)


@dataclass(frozen=True)
class Average:
    """A mean of draws with what is needed to judge it.

    Attributes
    ----------
    value, error : float
        The mean and its standard error.
    skewness : float
        Of the mean itself (that of one draw over the root of their number).
    support : float
        How many equal draws would leave the error as uncertain as it is: the square of a few heavy draws
        decides nothing.
    """

    value: float
    error: float
    skewness: float
    support: float

    @classmethod
    def of(cls, draws: np.ndarray, ess: float | None = None) -> Average:
        """Mean of draws that are worth ``ess`` independent ones, by default all of them."""
        value, n = float(draws.mean()), float(draws.size if ess is None else ess)
        off = draws - value
        return cls._of_sums(draws, value, *((off**k).mean() / n ** (k - 1) for k in (2, 3, 4)))

    @classmethod
    def weighted(cls, draws: np.ndarray, weights: np.ndarray) -> Average:
        """Mean of draws with weights that sum to 1."""
        used = weights > 0
        w, x = weights[used], np.broadcast_to(draws, weights.shape)[used]
        value = float(w @ x)
        terms = w * (x - value)
        return cls._of_sums(x, value, *((terms**k).sum() for k in (2, 3, 4)))

    @classmethod
    def _of_sums(
        cls, draws: np.ndarray, value: float, second: float, third: float, fourth: float
    ) -> Average:
        """Of the sums of powers of what each draw adds to the mean's error."""
        if draws.min() == draws.max():  # the mean of equal numbers is off by a rounding error
            return cls(float(draws.flat[0]), 0.0, 0.0, 0.0)
        if not 0 < second < math.inf or not 0 < fourth < math.inf:
            return cls(value, 0.0 if second == 0 else math.nan, 0.0, 0.0)
        error = math.sqrt(second)
        return cls(value, error, float(third) / error**3, float(second**2 / fourth))

    def p_value(self, exact: float, tolerance: float = 0.0) -> tuple[float, float]:
        """Distance in standard errors, and its two-sided p-value corrected for skewness.

        The studentised mean is transformed so that its law is normal to the next order (Hall 1992, eq.
        2.2). What the tolerance explains does not count.
        """
        off = self.value - exact
        off = math.copysign(max(abs(off) - tolerance, 0.0), off)
        if not self.error > 0:
            return (0.0, 1.0) if off == 0 else (math.inf, 0.0)
        t, g = off / self.error, self.skewness
        # cut where the cubic has left the centre: all is decided there
        t = min(max(t, -1e3), 1e3)
        corrected = unskewed(t, g) if off else 0.0
        return abs(t), 2.0 * float(scipy.special.ndtr(-abs(corrected)))


class Draws:
    """The draws of a posterior, whatever their kind, as the tests read them.

    Parameters
    ----------
    posterior : DrawsPosterior
        Weighted, resampled, of chains, or independent.
    """

    def __init__(self, posterior: DrawsPosterior) -> None:
        self.posterior = posterior
        self.weights = posterior.weights
        self._picked: np.ndarray | None = None
        ancestors = posterior.ancestors
        if ancestors is not None:
            # copies of one draw count once, with their number for a weight
            _, self._picked, copies = np.unique(ancestors, return_index=True, return_counts=True)
            self.weights = (copies / copies.sum())[None]
        # 0: independent; else members of an ensemble that draws come from in turn
        self.block = 0 if posterior.independent else getattr(posterior, "ensemble_size", 1)

    def values(self, name: str) -> np.ndarray:
        """Draws of a node as numbers, shape ``(chain, draw, *plates, *event)``; of labels their codes."""
        values = _plain(self.posterior[name])
        return values if self._picked is None else values[:, self._picked]

    def average(self, values: np.ndarray) -> Average:
        """Mean of one scalar, shape ``(chain, draw)``."""
        values = values.astype(float)
        if self.weights is not None:
            return Average.weighted(values, self.weights)
        return Average.of(values, None if self.block == 0 else self._chain_ess(values))

    def share(self, indicator: np.ndarray, p: float) -> tuple[float, float]:
        """Share of draws where the indicator holds, and its effective number of draws were it ``p``."""
        if self.weights is not None:
            share = float(self.weights[indicator].sum())
            error = float((self.weights**2 * (indicator - p) ** 2).sum())
            weight_ess = 1.0 / float((self.weights**2).sum())
            return share, min(p * (1 - p) / error, weight_ess)
        values = indicator.astype(float)
        if self.block == 0:
            return float(values.mean()), float(values.size)
        return float(values.mean()), self._chain_ess(values)

    def lies_at(self, values: np.ndarray, x: float, q: float) -> bool:
        """Whether ``x`` is a ``q``-quantile of the draws, to one of them either side."""
        if self.weights is None:
            below, upto, one = (values < x).mean(), (values <= x).mean(), 1.0 / values.size
        else:
            w = np.broadcast_to(self.weights, values.shape)
            below, upto, one = w[values < x].sum(), w[values <= x].sum(), w.max()
        return bool(below - one - 1e-9 <= q <= upto + one + 1e-9)

    def independent(
        self, names: Sequence[str], most: int, rng: np.random.Generator
    ) -> dict[str, np.ndarray]:
        """Rows that are independent draws, node -> ``(rows, *plates, *event)``; perhaps few, or none.

        Weighted draws are accepted with probability ``w / max(w)``, the heaviest one left out: given the
        largest weight, what is accepted is independent and follows the posterior (where weights stay
        below it). Chains are thinned to half their smallest effective number of draws; then rows are as
        good as independent.
        """
        values = {name: self.values(name) for name in names}
        chains, draws = self._shape(values)
        full = {n: np.broadcast_to(v, (chains, draws, *v.shape[2:])) for n, v in values.items()}
        if self.weights is not None:
            at = self._accepted(self.weights, most, rng)
        elif self.block == 0:
            at = rng.permutation(chains * draws)[:most]
        else:
            at = self._apart(full, most)
        return {n: v.reshape(chains * draws, *v.shape[2:])[at] for n, v in full.items()}

    def _chain_ess(self, values: np.ndarray) -> float:
        ess = float(diagnostics.chain_statistic("mean_ess", values, self.block))
        return min(ess, float(values.size)) if ess > 0 else math.nan

    def _shape(self, values: Mapping[str, np.ndarray]) -> tuple[int, int]:
        if self.weights is not None:
            return self.weights.shape
        return np.broadcast_shapes(*(v.shape[:2] for v in values.values()))

    @staticmethod
    def _accepted(weights: np.ndarray, most: int, rng: np.random.Generator) -> np.ndarray:
        flat = weights.ravel()
        top = flat.argmax()
        accepted = rng.random(flat.size) * flat[top] < flat
        if not (flat == flat[top]).all():
            accepted[top] = False
        return rng.permutation(np.flatnonzero(accepted))[:most]

    def _apart(self, values: Mapping[str, np.ndarray], most: int) -> np.ndarray:
        """Positions of draws of chains far enough apart."""
        chains, draws = next(iter(values.values())).shape[:2]
        sizes = [
            self._chain_ess(column)
            for value in values.values()
            for column in np.moveaxis(value.reshape(chains, draws, -1).astype(float), 2, 0)
            if column.min() < column.max()
        ]
        ess = min(sizes, default=float(chains * draws))
        if not ess >= 1:
            return np.empty(0, dtype=int)
        # members of an ensemble take turns: each is a chain of its own
        members = draws // self.block
        gap = max(1, math.ceil(_APART * chains * draws / ess))
        kept = np.arange(members - 1, -1, -gap)
        at = kept[:, None] * self.block + np.arange(self.block)
        rows = (np.arange(chains)[:, None] * draws + at.ravel()).ravel()
        return rows[np.linspace(0, len(rows) - 1, min(most, len(rows))).astype(int)]


# ---- private ------------------------------------------------------------------------------------


def _named(sample: Any) -> dict[str, np.ndarray]:
    if isinstance(sample, Mapping):
        return {name: np.asanyarray(values) for name, values in sample.items()}
    return {"x": np.asanyarray(sample)}


def _check_samples(a: Mapping[str, np.ndarray], b: Mapping[str, np.ndarray]) -> None:
    call = "same_distribution"
    if a.keys() != b.keys() or not a:
        raise ShapeError(
            f"{call}: the samples hold {sorted(a)} and {sorted(b)}; give the same variables in both"
        )
    for sample in (a, b):
        sizes = {name: v.shape[:1] for name, v in sample.items()}
        if len(set(sizes.values())) > 1 or min(sizes.values()) < (2,):
            raise ShapeError(
                f"{call}: the variables have {sizes} rows; give one number of draws, 2 or more, for all "
                "of a sample, on the first axis"
            )
    for name, values in a.items():
        if values.shape[1:] != b[name].shape[1:]:
            raise ShapeError(
                f"{call}: draws of {name!r} have shape {values.shape[1:]} in the first sample and "
                f"{b[name].shape[1:]} in the second"
            )


def _thinned(sample: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    size = len(next(iter(sample.values())))
    if size <= _ROWS:
        return dict(sample)
    at = np.linspace(0, size - 1, _ROWS).astype(int)
    return {name: values[at] for name, values in sample.items()}


def _plain(values: np.ndarray) -> np.ndarray:
    return np.asarray(values.codes if isinstance(values, StateArray) else values).view(np.ndarray)


def _features(both: np.ndarray, is_angle: bool, is_label: bool) -> list[np.ndarray]:
    """Columns of the two samples together, each of variance 1; constant ones are dropped."""
    columns = []
    for column in both.reshape(len(both), -1).T:
        if is_label:
            states = np.unique(column)
            columns += [(column == s).astype(float) for s in states]
        elif is_angle:
            columns += [np.cos(column), np.sin(column)]
        else:
            columns.append(_ranks(column))
    spreads = [c.std() for c in columns]
    return [c / s for c, s in zip(columns, spreads, strict=True) if s > 1e-12]


def _ranks(column: np.ndarray) -> np.ndarray:
    """Ranks with ties at their mean; numbers that differ by rounding errors are tied."""
    if column.dtype.kind == "f":
        column = np.round(column / (np.abs(column).max(initial=0.0) or 1.0), _DIGITS)
    _, inverse, counts = np.unique(column, return_inverse=True, return_counts=True)
    last = np.cumsum(counts)
    return (last - (counts - 1) / 2)[inverse]


def _distances(rows: np.ndarray) -> np.ndarray:
    squares = (rows**2).sum(axis=1)
    return np.sqrt(np.maximum(squares[:, None] + squares - 2 * rows @ rows.T, 0.0))


def _relabelled(
    distances: np.ndarray, size: int, level: float, rng: np.random.Generator
) -> tuple[float, float, float, float]:
    """Energy distance of the first ``size`` rows from the others; its mean, spread and p-value.

    With ``h`` of 1/n on one sample and -1/m on the other, the distance is ``-h' D h``.
    """
    total = len(distances)
    signs = np.full(total, -1.0 / (total - size))
    signs[:size] = 1.0 / size
    found = -float(signs @ distances @ signs)
    needed = min(_MOST, math.ceil(2.0 / level))
    drawn: list[float] = []
    above = 0
    while len(drawn) < needed and above < _ENOUGH:
        batch = rng.permuted(np.tile(signs, (min(_AT_ONCE, needed - len(drawn)), 1)), axis=1)
        energies = -((batch @ distances) * batch).sum(axis=1)
        # one after the other, so that stopping does not depend on how many are done at once
        for energy in energies.tolist():
            drawn.append(energy)
            above += energy >= found * (1 - 1e-12)
            if above == _ENOUGH:
                break
    mean, spread = float(np.mean(drawn)), float(np.std(drawn))
    p_value = above / len(drawn) if above == _ENOUGH else (above + 1) / (len(drawn) + 1)
    if above == 0 and needed == _MOST:
        p_value = min(p_value, _gamma_tail(np.array(drawn), found))
    return found, mean, spread, p_value


def _gamma_tail(drawn: np.ndarray, found: float) -> float:
    """Chance to exceed ``found`` under the gamma law with the mean, variance and skewness of ``drawn``."""
    off = drawn - drawn.mean()
    spread = math.sqrt((off**2).mean())
    skewness = float((off**3).mean()) / spread**3 if spread > 0 else 0.0
    if not skewness > 1e-6:
        return 1.0
    shape = 4.0 / skewness**2
    z = (found - float(drawn.mean())) / spread
    return float(scipy.special.gammaincc(shape, max(shape + z * math.sqrt(shape), 0.0)))
