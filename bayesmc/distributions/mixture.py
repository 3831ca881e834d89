"""Mixtures: one of K component distributions, chosen by a categorical weight.

The components are one distribution whose last batch axis counts them, or a list of distributions of
any families.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from bayesmc.distributions.adapt import as_distribution
from bayesmc.distributions.base import Distribution, as_float, as_quantile
from bayesmc.distributions.categorical import Categorical
from bayesmc.distributions.discrete import whole_ppf
from bayesmc.distributions.support import Support, product, real, real_vector
from bayesmc.errors import ShapeError, UnsupportedError
from bayesmc.shapes import Shape, broadcast_shapes

_AT_ONCE = 1 << 22  # component draws held at a time
_EPS = 2.0**-52
_NEWTON = 40  # turns, before what has not settled is bisected


class Mixture(Distribution):
    """Mixture distribution ``sum_k weights[..., k] * component_k``.

    Parameters
    ----------
    weights : array_like, shape (..., K)
        Mixing probabilities; a row off one by at most 1e-6 is renormalised.
    components : Distribution or sequence of Distribution
        One distribution whose last batch axis has length K, or K distributions of any families
        (frozen ``scipy.stats`` ones, too) with one event shape and supports of one kind.

    Raises
    ------
    ParameterError
        ``weights`` has a negative entry or a row that does not sum to one.
    ShapeError
        The number of weights and of components differ, or event shapes do.
    UnsupportedError
        Discrete and continuous components, or supports that have no common kind.

    References
    ----------
    Murphy, Probabilistic Machine Learning: An Introduction, 2022, section 3.5.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> mixture = bmc.Mixture([0.5, 0.5], bmc.Normal([-1.0, 1.0], 1.0))
    >>> float(mixture.log_prob(0.0).round(4)), float(mixture.mean), float(mixture.var)
    (-1.4189, 0.0, 2.0)
    """

    def __init__(self, weights: Any, components: Any) -> None:
        weights = as_float(weights)
        if weights.ndim < 1:
            raise ShapeError("Mixture: weights must have shape (..., K); got a scalar")
        self._parts = _parts(components)
        if weights.shape[-1] != self._parts.count:
            raise ShapeError(
                f"Mixture: {weights.shape[-1]} weights for {self._parts.count} components"
            )
        self.components = components
        self.event_shape = self._parts.event_shape
        self.is_discrete = self._parts.support.is_discrete  # type: ignore[misc]
        self._set_batch(weights.shape[:-1], self._parts.batch)
        self._choice = _Weights(weights)
        self._adopt(self._choice)
        for part, mask in self._parts.marked():
            self._adopt(part, mask)

    @property
    def weights(self) -> np.ndarray:
        """Mixing probabilities, shape ``(..., K)``."""
        return self._choice.probs

    def parameters(self) -> list[tuple[np.ndarray, int]]:
        return [(self.weights, 1), *self._parts.parameters()]

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        choice = self._choice.sample_to(rng, shape)
        return self._parts.sample(rng, choice)

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        weights = self.weights
        terms = self._parts.evaluate("log_prob", x)
        # a component without weight counts for nothing, whatever its density
        terms = np.where(weights > 0, terms + np.log(weights), -np.inf)
        # reducing a contiguous leading axis is several times faster than a short last one
        terms = np.array(np.moveaxis(terms, -1, 0), order="C")
        peak = terms.max(axis=0)
        peak = np.where(np.isfinite(peak), peak, 0.0)
        terms -= peak
        return np.log(np.exp(terms, out=terms).sum(axis=0)) + peak

    @property
    def mean(self) -> np.ndarray:
        """Mean; on the circle the mean direction."""
        if self.support.kind == "circle":
            return np.angle(self._resultant())
        return self._average(self._parts.moments("mean"))

    @property
    def var(self) -> np.ndarray:
        """Variance of each component; on the circle ``-2 log R`` of the mean resultant length R."""
        if self.support.kind == "circle":
            return -2 * np.log(np.abs(self._resultant()))
        means = self._parts.moments("mean")
        axis = -1 - len(self.event_shape)
        with np.errstate(invalid="ignore"):
            spread = (means - np.expand_dims(self._average(means), axis)) ** 2
        return self._average(self._parts.moments("var") + spread)

    @property
    def support(self) -> Support:
        return self._parts.support

    def cdf(self, x: Any) -> np.ndarray:
        return self._weigh(self._parts.evaluate("cdf", np.asarray(x)))

    def ppf(self, q: Any) -> np.ndarray:
        """Quantile, found between the least and the greatest quantile of the components."""
        q = as_quantile(q)
        quantiles = self._parts.evaluate("ppf", q)
        used = self.weights > 0
        low = np.where(used, quantiles, np.inf).min(axis=-1)
        high = np.where(used, quantiles, -np.inf).max(axis=-1)
        low, high = (np.where(np.isnan(q), np.nan, bound) for bound in (low, high))
        if self.is_discrete:
            inner = np.where((q > 0) & (q < 1), q, np.nan)
            start, stop = (np.where(np.isnan(inner), 0.0, bound) for bound in (low, high))
            return np.where(
                q == 0, low, np.where(q == 1, high, whole_ppf(self.cdf, inner, start, stop))
            )
        if np.array_equal(low, high, equal_nan=True):  # one component, or all alike
            return low
        return invert(self.cdf, self.log_prob, q, low, high)

    @property
    def parts(self) -> tuple[Distribution, ...]:
        """The distributions of the components; one where its last batch axis counts them."""
        return (self._parts.part,) if isinstance(self._parts, _Stacked) else self._parts.parts

    def component_ppf(self, q: float) -> np.ndarray:
        """A quantile of every component, shape ``(..., K)``."""
        return self._parts.evaluate("ppf", np.asarray(q, dtype=float))

    def _average(self, values: np.ndarray) -> np.ndarray:
        """Weighted sum of ``(..., K, *event)`` over the components, in full batch shape."""
        extra = len(self.event_shape)
        weights = self.weights.reshape(self.weights.shape + (1,) * extra)
        with np.errstate(invalid="ignore"):
            terms = np.where(weights > 0, weights * values, 0.0)
        total = terms.sum(axis=-1 - extra)
        return np.broadcast_to(total, self.batch_shape + self.event_shape)

    def _resultant(self) -> np.ndarray:
        """Mean of ``exp(i x)``."""
        length = np.exp(-0.5 * self._parts.moments("var"))
        direction = self._parts.moments("mean")
        real, imaginary = length * np.cos(direction), length * np.sin(direction)
        return self._average(real) + 1j * self._average(imaginary)

    def _weigh(self, values: np.ndarray) -> np.ndarray:
        return np.where(self.weights > 0, self.weights * values, 0.0).sum(axis=-1)


class _Weights(Categorical):
    """The choice of a component, whose faults are the mixture's."""

    _family = "Mixture"
    _probs_name = "weights"


class _Stacked:
    """Components as one distribution whose last batch axis counts them."""

    def __init__(self, part: Distribution) -> None:
        if not part.batch_shape:
            raise ShapeError(
                f"Mixture: {type(part).__name__} has batch shape (); its last batch axis must "
                "count the components (parameters of shape (..., K)), or pass a list"
            )
        self.part = part
        self.count = part.batch_shape[-1]
        self.batch = part.batch_shape[:-1]
        self.event_shape = part.event_shape

    @property
    def support(self) -> Support:
        return self._joined(self.part.support)

    def _joined(self, support: Support) -> Support:
        """The support of any component, from that with bounds for each."""
        if support.is_single:
            return support
        if support.parts:
            return product([(self._joined(part), size) for part, size in support.parts])
        low = np.broadcast_to(support.low, self.part.batch_shape).min(axis=-1)
        high = np.broadcast_to(support.high, self.part.batch_shape).max(axis=-1)
        return _bounded(support.kind, low, high, support.open_low, support.open_high)

    def marked(self) -> list[tuple[Distribution, Any]]:
        invalid = self.part.invalid
        return [] if invalid is None else [(self.part, invalid.any(axis=-1))]

    def parameters(self) -> list[tuple[np.ndarray, int]]:
        # a parameter that all components share has no component axis of its own
        return [
            (value.reshape((1,) * (n + 1 - value.ndim) + value.shape), n + 1)
            for value, n in self.part.parameters()
        ]

    def evaluate(self, method: str, x: np.ndarray) -> np.ndarray:
        at = np.expand_dims(x, x.ndim - len(self.event_shape) if method == "log_prob" else x.ndim)
        return getattr(self.part, method)(at)

    def moments(self, name: str) -> np.ndarray:
        return np.broadcast_to(getattr(self.part, name), self.part.batch_shape + self.event_shape)

    def sample(self, rng: np.random.Generator, choice: np.ndarray) -> np.ndarray:
        draws_per_item = self.count * max(1, int(np.prod(self.event_shape)))
        lead = choice.ndim - len(self.batch)
        if lead and len(choice) > 1 and choice.size * draws_per_item > _AT_ONCE:
            # all K are drawn and one is kept, so what is held at a time is bounded
            step = max(1, len(choice) * _AT_ONCE // (choice.size * draws_per_item))
            blocks = [self.sample(rng, choice[i : i + step]) for i in range(0, len(choice), step)]
            return np.concatenate(blocks)
        draws = self.part.sample_to(rng, (*choice.shape, self.count))
        index = choice.reshape(choice.shape + (1,) * (1 + len(self.event_shape)))
        return np.take_along_axis(draws, index, axis=choice.ndim).squeeze(axis=choice.ndim)


class _Listed:
    """Components as a list of distributions of any families."""

    def __init__(self, parts: Sequence[Distribution]) -> None:
        found = [as_distribution(part) for part in parts]
        parts = tuple(part for part in found if part is not None)
        if not parts or len(parts) < len(found):
            raise ShapeError(
                "Mixture: components must be a Distribution or a list of Distributions"
            )
        if len({part.event_shape for part in parts}) > 1:
            shapes = ", ".join(str(part.event_shape) for part in parts)
            raise ShapeError(f"Mixture: components have different event shapes: {shapes}")
        self.parts = parts
        self.count = len(parts)
        self.event_shape = parts[0].event_shape
        self.batch = broadcast_shapes(*(part.batch_shape for part in parts))

    @property
    def support(self) -> Support:
        supports = [part.support for part in self.parts]
        first = supports[0]
        if all(support == first for support in supports):
            return first
        return _hull(supports)

    def marked(self) -> list[tuple[Distribution, Any]]:
        return [(part, None) for part in self.parts]

    def parameters(self) -> list[tuple[np.ndarray, int]]:
        return [pair for part in self.parts for pair in part.parameters()]

    def evaluate(self, method: str, x: np.ndarray) -> np.ndarray:
        values = [np.asarray(getattr(part, method)(x), dtype=float) for part in self.parts]
        return np.stack(np.broadcast_arrays(*values), axis=-1)

    def moments(self, name: str) -> np.ndarray:
        shape = self.batch + self.event_shape
        values = [np.broadcast_to(getattr(part, name), shape) for part in self.parts]
        return np.stack(values, axis=len(self.batch))

    def sample(self, rng: np.random.Generator, choice: np.ndarray) -> np.ndarray:
        draws = self.parts[0].sample_to(rng, choice.shape)
        for k, part in enumerate(self.parts[1:], start=1):
            chosen = (choice == k).reshape(choice.shape + (1,) * len(self.event_shape))
            draws = np.where(chosen, part.sample_to(rng, choice.shape), draws)
        return draws


def _parts(components: Any) -> _Stacked | _Listed:
    alone = None if isinstance(components, (list, tuple)) else as_distribution(components)
    if alone is not None:
        return _Stacked(alone)
    if not isinstance(components, Iterable):
        raise ShapeError("Mixture: components must be a Distribution or a list of Distributions")
    return _Listed(list(components))


def _hull(supports: Sequence[Support]) -> Support:
    """The smallest support of one kind that holds all."""
    kinds = {support.kind for support in supports}
    if kinds <= {"real", "interval"} and "real" in kinds:
        return next(support for support in supports if support.kind == "real")
    if kinds <= {"real vector", "product"} and "product" in kinds:
        return _hull_of_products(supports)
    if len(kinds) > 1:
        raise _not_mixed(supports)
    first = supports[0]
    if first.kind not in ("interval", "integers", "increasing"):
        return first
    low, high = first.low, first.high
    for support in supports[1:]:
        low, high = np.minimum(low, support.low), np.maximum(high, support.high)
    open_low = all(support.open_low for support in supports)
    open_high = all(support.open_high for support in supports)
    return _bounded(first.kind, low, high, open_low, open_high)


def _hull_of_products(supports: Sequence[Support]) -> Support:
    """Part by part where all are cut alike; otherwise the real vectors, if all parts fill a volume."""
    sizes = [[size for _, size in support.parts] for support in supports]
    if all(size == sizes[0] for size in sizes):
        columns = zip(*(support.parts for support in supports), strict=True)
        return product([(_hull([part for part, _ in column]), column[0][1]) for column in columns])
    if all(
        part.kind in ("real", "real vector", "interval") for s in supports for part, _ in s.parts
    ):
        return real_vector
    raise _not_mixed(supports)


def _bounded(kind: str, low: Any, high: Any, open_low: bool, open_high: bool) -> Support:
    if kind == "interval" and np.all(np.isneginf(low)) and np.all(np.isposinf(high)):
        return real
    return Support(kind, low, high, open_low, open_high)


def _not_mixed(supports: Sequence[Support]) -> UnsupportedError:
    found = "; ".join(dict.fromkeys(support.describe() for support in supports))
    return UnsupportedError(
        f"Mixture: components on different supports cannot be mixed ({found}); use families whose "
        "values lie in one kind of space"
    )


def invert(
    cdf: Callable[[np.ndarray], np.ndarray],
    log_prob: Callable[[np.ndarray], np.ndarray],
    q: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
) -> np.ndarray:
    """Where a continuous ``cdf`` crosses ``q`` between ``low`` and ``high``, to rounding.

    Newton's steps on the logarithm of the nearer tail, which is nearly straight far out, kept in a
    bracket that is halved where they do not halve themselves. Where the density does not fix the place (a
    gap between components), the crossing is bisected to the last bit.
    """
    answer = np.where(q == 1, high, low)  # at q = 0 or 1 the bounds are the answer, maybe infinite
    active = np.isfinite(low) & np.isfinite(high)
    low, high = np.where(active, low, 0.0), np.where(active, high, 0.0)
    active, q, low, high = np.broadcast_arrays(active, q, low, high)
    found, width = np.where(q == 0, low, high), high - low
    at, move = low + 0.5 * width, width
    done = ~(low < high) | (q == 0)
    with np.errstate(all="ignore"):
        for _ in range(_NEWTON):
            if done.all():
                break
            value, density = cdf(at), np.exp(log_prob(at))
            short = value < q
            low, high = np.where(short, at, low), np.where(short, high, at)
            step = _newton_step(value, density, q)
            missing = np.abs(value - q)
            sure = (missing + _EPS * q) / density <= 1e-10 * width
            fine = np.abs(step) <= 4 * _EPS * np.abs(at)
            settled = sure & (fine | (missing <= 4 * _EPS * q)) & ~done
            found = np.where(settled, at, found)
            done = done | settled
            usable = (at + step > low) & (at + step < high) & (np.abs(step) <= 0.5 * np.abs(move))
            halves = low + 0.5 * (high - low)
            move = np.where(usable, step, halves - at)
            at = np.where(usable, at + step, halves)
        if not done.all():
            found = np.where(done, found, _bisect(cdf, q, low, high, done))
    return np.where(active, found, answer)


def _newton_step(value: np.ndarray, density: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Towards ``q``, along the logarithm of the nearer tail's probability."""
    upper = q > 0.5
    have, wanted = np.where(upper, 1 - value, value), np.where(upper, 1 - q, q)
    step = np.log(have / wanted) * have / density
    return np.where(upper, step, -step)


def _bisect(
    cdf: Callable[[np.ndarray], np.ndarray],
    q: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    done: np.ndarray,
) -> np.ndarray:
    """The least number in the bracket whose ``cdf`` reaches ``q``."""
    for _ in range(2200):  # at most: halving an interval of doubles ends well before
        middle = low + 0.5 * (high - low)
        done = done | (middle <= low) | (middle >= high)
        if done.all():
            break
        short = cdf(middle) < q
        low, high = np.where(short & ~done, middle, low), np.where(short | done, high, middle)
    return high
