"""Frozen ``scipy.stats`` distributions as distributions of this package.

``scipy.stats`` is slow to import and is never imported here: whoever hands over one of its objects
has done so already.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from bayesmc.distributions.base import Distribution, as_quantile, draw_to
from bayesmc.distributions.dirichlet import Dirichlet
from bayesmc.distributions.mvnormal import MvNormal
from bayesmc.distributions.support import Support, integers, interval, real, real_vector
from bayesmc.errors import ParameterError, ShapeError, UnsupportedError
from bayesmc.shapes import Shape, first_index

_POSITIVE_DEFINITE = {"wishart_frozen", "invwishart_frozen"}


def as_distribution(obj: Any) -> Distribution | None:
    """``obj`` as a Distribution: itself, or a wrapped frozen ``scipy.stats`` distribution.

    Parameters
    ----------
    obj : object

    Returns
    -------
    Distribution or None
        None when ``obj`` is no distribution (an array, a number).

    Raises
    ------
    ParameterError
        A SciPy distribution's parameters are out of range.
    UnsupportedError
        An object of ``scipy.stats`` that is not a frozen distribution with a density.

    References
    ----------
    Virtanen et al., SciPy 1.0, Nature Methods 17, 2020.

    Examples
    --------
    >>> from scipy import stats
    >>> from bayesmc.distributions import as_distribution
    >>> float(as_distribution(stats.norm(1.0, 2.0)).mean)
    1.0
    >>> as_distribution([1.0, 2.0]) is None
    True
    """
    if isinstance(obj, Distribution):
        return obj
    if isinstance(obj, np.ndarray) or not type(obj).__module__.startswith("scipy.stats"):
        return None
    name = type(obj).__name__
    if hasattr(obj, "dist") and hasattr(obj, "args"):
        return ScipyUnivariate(obj)
    if name == "multivariate_normal_frozen" and obj.cov_object.rank == len(obj.mean):
        return MvNormal(obj.mean, obj.cov)
    if name == "dirichlet_frozen":
        return Dirichlet(obj.alpha)
    if name.endswith("_frozen") and (hasattr(obj, "logpdf") or hasattr(obj, "logpmf")):
        return ScipyMultivariate(obj)
    if all(hasattr(obj, key) for key in ("logpdf", "icdf", "sample")):
        return ScipyVariable(obj)
    raise UnsupportedError(
        f"scipy.stats object of type {name!r} is not a frozen distribution with a density; freeze "
        "it by calling it with its parameters, as in scipy.stats.norm(0.0, 1.0)"
    )


class _ScipyScalar(Distribution):
    """Numbers from an object of SciPy, whichever interface it has; a subclass knows which.

    Each call goes through SciPy and is slow beside the families of this package.
    """

    #: the object of SciPy
    scipy: Any
    _low: Any
    _high: Any

    def _draw(self, rng: np.random.Generator, sample_shape: Shape) -> np.ndarray:
        """Draws of shape ``sample_shape + batch_shape``."""
        raise NotImplementedError

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        draws = draw_to(lambda lead: self._draw(rng, lead), self.batch_shape, shape, ())
        return draws.astype(np.int64 if self.is_discrete else float, copy=False)

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        if not self.is_discrete:  # at infinity some of SciPy's formulas give NaN
            return np.where(np.isinf(x), -np.inf, self.scipy.logpdf(x))
        whole = x == np.floor(x)
        return np.where(whole, self.scipy.logpmf(np.where(whole, x, 0)), -np.inf)

    @property
    def mean(self) -> np.ndarray:
        return np.broadcast_to(self.scipy.mean(), self.batch_shape)

    @property
    def support(self) -> Support:
        if self.is_discrete:
            return integers(self._low, self._high)
        if np.all(np.isneginf(self._low)) and np.all(np.isposinf(self._high)):
            return real
        return interval(self._low, self._high)

    def cdf(self, x: Any) -> np.ndarray:
        with np.errstate(all="ignore"):
            return np.asarray(self.scipy.cdf(np.asarray(x)))


class ScipyUnivariate(_ScipyScalar):
    """A frozen univariate ``scipy.stats`` distribution, continuous or discrete.

    Made by ``as_distribution``.

    Parameters
    ----------
    frozen : scipy.stats rv_frozen

    Raises
    ------
    ParameterError
        SciPy calls the parameters out of range.
    UnsupportedError
        A discrete distribution whose values are not whole numbers.

    References
    ----------
    Virtanen et al., SciPy 1.0, Nature Methods 17, 2020.

    Examples
    --------
    >>> from scipy import stats
    >>> from bayesmc.distributions import as_distribution
    >>> as_distribution(stats.gumbel_r([0.0, 1.0])).batch_shape
    (2,)
    """

    def __init__(self, frozen: Any) -> None:
        self.is_discrete = not hasattr(frozen.dist, "logpdf")  # type: ignore[misc]
        self.scipy = frozen
        values = [*frozen.args, *frozen.kwds.values()]
        self._set_batch(*(np.shape(value) for value in values))
        low, high = frozen.support()
        ok = ~(np.isnan(low) | np.isnan(high))
        for value in values:  # SciPy lets some infinite and NaN parameters pass
            ok = ok & ~np.isnan(np.asarray(value, dtype=float))
        if not ok.all():
            ok = np.broadcast_to(ok, self.batch_shape)
            shown = self._arguments(first_index(~ok))
            self._reject("parameters", shown, ~ok, "in SciPy's range")
            low, high = self._replace_invalid(ok)
        self._low, self._high = low, high
        if self.is_discrete and _fractional(self._low):
            raise UnsupportedError(
                f"{self._family}: discrete values that are not whole numbers are not supported; "
                "shift by a whole loc, and scale in a deterministic node"
            )

    @property
    def _family(self) -> str:
        return f"scipy.stats.{self.scipy.dist.name}"

    def parameters(self) -> list[tuple[np.ndarray, int]]:
        keywords = [self.scipy.kwds[key] for key in sorted(self.scipy.kwds)]
        return [(np.asarray(value), 0) for value in (*self.scipy.args, *keywords)]

    def _draw(self, rng: np.random.Generator, sample_shape: Shape) -> np.ndarray:
        size = sample_shape + self.batch_shape
        return np.asarray(self.scipy.rvs(size=size, random_state=rng)).reshape(size)

    @property
    def var(self) -> np.ndarray:
        return np.broadcast_to(self.scipy.var(), self.batch_shape)

    def ppf(self, q: Any) -> np.ndarray:
        with np.errstate(all="ignore"):
            return np.asarray(self.scipy.ppf(q))

    def _arguments(self, index: Shape) -> np.ndarray:
        values = [*self.scipy.args, *self.scipy.kwds.values()]
        return np.array(
            [np.broadcast_to(value, self.batch_shape)[index] for value in values], float
        )

    def _replace_invalid(self, ok: np.ndarray) -> tuple[Any, Any]:
        """Give the invalid elements a valid one's parameters, so that the object can be used."""
        if not ok.any():
            from scipy import stats

            half = np.full(self.batch_shape, 0.5)
            self.scipy = stats.bernoulli(half) if self.is_discrete else stats.norm(half)
            return self.scipy.support()
        good = tuple(np.argwhere(ok)[0])

        def mend(value: Any) -> np.ndarray:
            value = np.broadcast_to(value, self.batch_shape)
            return np.where(ok, value, value[good])

        keywords = {key: mend(value) for key, value in self.scipy.kwds.items()}
        self.scipy = self.scipy.dist(*(mend(value) for value in self.scipy.args), **keywords)
        return self.scipy.support()


class ScipyVariable(_ScipyScalar):
    """A random variable of SciPy's newer interface, such as ``scipy.stats.Normal(mu=0, sigma=1)``.

    Made by ``as_distribution``.

    Parameters
    ----------
    variable : scipy.stats ContinuousDistribution or DiscreteDistribution

    References
    ----------
    Virtanen et al., SciPy 1.0, Nature Methods 17, 2020.

    Examples
    --------
    >>> from scipy import stats
    >>> from bayesmc.distributions import as_distribution
    >>> float(as_distribution(stats.Normal(mu=1.0, sigma=2.0)).var)
    4.0
    """

    def __init__(self, variable: Any) -> None:
        self.scipy = variable
        low, high = variable.support()
        self._set_batch(np.shape(low), np.shape(high), np.shape(variable.mean()))
        ok = ~(np.isnan(low) | np.isnan(high))
        ok = ok if np.shape(ok) else np.asarray(ok)
        if not ok.all():
            raise ParameterError(
                f"scipy.stats.{type(variable).__name__}: parameters out of SciPy's range",
                tuple(int(i) for i in np.argwhere(~ok)[0]),
            )
        self._low, self._high = low, high
        # the interface gives both kinds both methods; a discrete one has a bounded probability mass
        self.is_discrete = any(  # type: ignore[misc]
            base.__name__ == "DiscreteDistribution" for base in type(variable).__mro__
        )

    def parameters(self) -> list[tuple[np.ndarray, int]]:
        points = (0.25, 0.75)
        return [(np.broadcast_to(self.ppf(q), self.batch_shape), 0) for q in points]

    def _draw(self, rng: np.random.Generator, sample_shape: Shape) -> np.ndarray:
        return np.asarray(self.scipy.sample(sample_shape, rng=rng))

    @property
    def var(self) -> np.ndarray:
        return np.broadcast_to(self.scipy.variance(), self.batch_shape)

    def ppf(self, q: Any) -> np.ndarray:
        return np.asarray(self.scipy.icdf(as_quantile(q)))


class ScipyMultivariate(Distribution):
    """A frozen multivariate ``scipy.stats`` distribution: batch ``()``, one vector or matrix.

    Made by ``as_distribution``.

    Parameters
    ----------
    frozen : scipy.stats multi_rv_frozen

    References
    ----------
    Virtanen et al., SciPy 1.0, Nature Methods 17, 2020.

    Examples
    --------
    >>> from scipy import stats
    >>> from bayesmc.distributions import as_distribution
    >>> as_distribution(stats.multinomial(3, [0.5, 0.5])).event_shape
    (2,)
    """

    def __init__(self, frozen: Any) -> None:
        self.frozen = frozen
        self.is_discrete = hasattr(frozen, "logpmf")  # type: ignore[misc]
        self._log_density = frozen.logpmf if self.is_discrete else frozen.logpdf
        # Wishart densities take matrices along the last axis, all others along the first
        self._last = type(frozen).__name__ in _POSITIVE_DEFINITE
        batch = f"{self._family}: only one distribution at a time, not a batch"
        try:
            draws = np.asarray(frozen.rvs(size=7, random_state=np.random.default_rng(0)))
            self.event_shape = draws.shape[1:]
            single = np.shape(self._at(draws)) == (7,)
        except ValueError as error:  # seven draws do not broadcast with a batch
            raise UnsupportedError(batch) from error
        if not single:
            raise UnsupportedError(batch)
        self._support = self._find_support()

    @property
    def _family(self) -> str:
        return f"scipy.stats.{type(self.frozen).__name__.removesuffix('_frozen')}"

    def parameters(self) -> list[tuple[np.ndarray, int]]:
        """Log densities at a few draws from a fixed seed stand for the parameters."""
        draws = np.asarray(self.frozen.rvs(size=3, random_state=np.random.default_rng(1)))
        draws = draws.reshape((3, *self.event_shape))
        return [(draws, 1 + len(self.event_shape)), (self.log_prob(draws), 1)]

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        count = int(np.prod(shape))
        draws = np.asarray(self.frozen.rvs(size=max(count, 1), random_state=rng))
        draws = draws.reshape((max(count, 1), *self.event_shape))[:count]
        kind = np.int64 if self.is_discrete else float
        return draws.reshape(shape + self.event_shape).astype(kind)

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        cut = x.ndim - len(self.event_shape)
        if cut < 0 or x.shape[cut:] != self.event_shape:
            raise ShapeError(
                f"{self._family}: x has shape {x.shape}, not (..., *{self.event_shape})"
            )
        lead = x.shape[:cut]
        points = x.reshape((-1, *self.event_shape))
        inside: Any = self._support.contains(points)
        if inside.ndim > 1:
            inside = inside.all(axis=tuple(range(1, inside.ndim)))
        value = np.full(len(points), -np.inf)
        if inside.any():  # SciPy raises for values outside
            value[inside] = np.reshape(self._at(points[inside]), -1)
        return value.reshape(lead)

    @property
    def mean(self) -> np.ndarray:
        return self._moment("mean")

    @property
    def var(self) -> np.ndarray:
        if hasattr(self.frozen, "var"):
            return self._moment("var")
        return np.linalg.diagonal(self._moment("cov"))

    @property
    def support(self) -> Support:
        return self._support

    def _at(self, points: np.ndarray) -> np.ndarray:
        return self._log_density(np.moveaxis(points, 0, -1) if self._last else points)

    def _find_support(self) -> Support:
        if self._last:
            return Support("positive definite")
        if self.is_discrete:
            return Support("counts") if len(self.event_shape) == 1 else integers(0)
        return real_vector if len(self.event_shape) == 1 else real

    def _moment(self, name: str) -> np.ndarray:
        moment: Callable[[], Any] | np.ndarray | None = getattr(self.frozen, name, None)
        if moment is None:
            raise UnsupportedError(f"{self._family} has no closed {name}; use draws instead")
        return np.asarray(moment() if callable(moment) else moment, dtype=float)


def _fractional(bound: Any) -> bool:
    bound = np.asarray(bound, dtype=float)
    finite = bound[np.isfinite(bound)]
    return bool((finite != np.floor(finite)).any())
