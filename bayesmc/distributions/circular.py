"""Families of angles: VonMises and WrappedNormal.

Angles are in radians. Values may be any finite angle (densities have period 2 pi); draws and means
lie in ``[-pi, pi)``, and a cdf goes from 0 at ``-pi`` to 1 at ``pi``. Moments are circular: ``mean`` is the
mean direction, ``var`` the squared circular standard deviation ``-2 log R`` with R the mean
resultant length. A linear mean of angles is nowhere here.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import special

from bayesmc.distributions.base import Distribution, as_float, as_quantile
from bayesmc.distributions.location_scale import LocationScale
from bayesmc.distributions.support import Support
from bayesmc.shapes import Shape

_CIRCLE = Support("circle")
_PI, _TURN = np.pi, 2 * np.pi
_LOG_TURN = np.log(2 * np.pi)
_SERIES_UP_TO = 30.0  # concentration from which on erf and its corrections beat the Fourier series
_SMOOTH = 1.25  # scale from which on the Fourier series needs fewer terms than the wrapped sum
_UNIFORM = 20.0  # a normal of this scale, wrapped, is uniform to exp(-200)
_ALONE = 41.0  # exp(-41) is lost beside one
_FAR = 100.0  # angles beyond are wrapped exactly, which takes longer
_TINY = 1e-300  # what is divided by is at least this
_REACH = 40.0  # standard deviations that hold all mass that a double can tell from none


class _Circular(Distribution):
    """What both families share: symmetry about ``loc``, and a density of period 2 pi."""

    loc: np.ndarray

    @property
    def mean(self) -> np.ndarray:
        """Mean direction in ``[-pi, pi)``; ``loc`` by convention where no direction is preferred."""
        return np.broadcast_to(wrap_angle(self.loc), self.batch_shape)

    @property
    def support(self) -> Support:
        return _CIRCLE

    def cdf(self, x: Any) -> np.ndarray:
        """Probability of an angle from ``-pi`` up to ``x``: 0 below ``-pi``, 1 above ``pi``."""
        x = np.asarray(x, dtype=float)
        first, start = self._start()
        at = np.clip(x, -_PI, _PI) - wrap_angle(self.loc)
        turns = (at < -_PI) * -1.0 + (at > _PI)
        value = self._below(np.clip(at - turns * _TURN, -_PI, _PI)) - start
        # past the point opposite loc, the mass up to there is counted as well
        value = np.clip(value + (turns - first), 0.0, 1.0)
        value = np.where(x <= -_PI, 0.0, np.where(x >= _PI, 1.0, value))
        return np.where(np.isnan(x), np.nan, value)

    def ppf(self, q: Any) -> np.ndarray:
        """Angle in ``[-pi, pi]`` up to which, from ``-pi``, there is probability ``q``; by bisection."""
        q = as_quantile(q)
        first, start = self._start()
        mass = q + start
        passed = (mass >= 1) * 1.0
        x = wrap_angle(self.loc) + (self._bisect(mass - passed) + (passed + first) * _TURN)
        return np.where(q == 0, -_PI, np.where(q == 1, _PI, np.clip(x, -_PI, _PI)))

    def _start(self) -> tuple[np.ndarray, np.ndarray]:
        """Turns of ``-pi - loc``, and the mass from opposite ``loc`` up to there."""
        at = -_PI - wrap_angle(self.loc)
        turns = (at < -_PI) * -1.0
        return turns, self._below(np.clip(at - turns * _TURN, -_PI, _PI))

    def _bisect(self, mass: np.ndarray) -> np.ndarray:
        """Distance from ``loc``, within half a turn, up to which there is ``mass``."""
        spread = self._spread()
        mass, reach = np.broadcast_arrays(mass, np.minimum(_REACH * spread, _PI))
        low, high = -reach, np.array(reach)
        for _ in range(60):  # 2**-60 of the reach is below the last digit of the spread
            middle = 0.5 * (low + high)
            short = self._below(middle) < mass
            low, high = np.where(short, middle, low), np.where(short, high, middle)
        return np.where(np.isnan(mass), np.nan, high)

    def _below(self, distance: np.ndarray) -> np.ndarray:
        """Mass from opposite ``loc`` to ``loc + distance``, for distances within half a turn."""
        raise NotImplementedError

    def _spread(self) -> np.ndarray:
        """About a standard deviation, where mass is concentrated; large where not."""
        raise NotImplementedError


class VonMises(_Circular):
    """Von Mises distribution of an angle, ``exp(concentration * cos(x - loc))`` normalised.

    Parameters
    ----------
    loc : array_like
        Mean direction in radians, any finite angle.
    concentration : array_like
        Nonnegative and finite: 0 is uniform on the circle, large ones are close to a normal of
        variance ``1 / concentration``.

    Raises
    ------
    ParameterError
        ``loc`` not finite, or ``concentration`` negative or not finite.

    Notes
    -----
    ``cdf`` counts from ``-pi``, unlike SciPy's, which counts from opposite ``loc``.

    References
    ----------
    Mardia and Jupp, Directional Statistics, 2000, section 3.5.4. The cdf of moderate concentrations
    after Hill, Algorithm 518, ACM TOMS 3(3), 1977.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> heading = bmc.VonMises(3.0, 4.0)
    >>> heading.log_prob([3.0, 3.0 - 2 * np.pi, 0.0]).round(4).tolist()
    [-0.2628, -0.2628, -8.2228]
    >>> float(heading.cdf(-3.0).round(4))  # the arc from -pi to -3
    0.0992
    """

    parameter_ndim = {"loc": 0, "concentration": 0}

    def __init__(self, loc: Any = 0.0, concentration: Any = 1.0) -> None:
        loc, concentration = as_float(loc), as_float(concentration)
        self._set_batch(loc.shape, concentration.shape)
        self.loc = self._finite("loc", loc)
        ok = (concentration >= 0) & (concentration < np.inf)
        self.concentration = self._check(
            "concentration", concentration, ok, 1.0, "nonnegative and finite"
        )

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        draws = np.asarray(rng.vonmises(wrap_angle(self.loc), self.concentration, shape))
        draws[draws >= _PI] = -_PI
        return draws

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        # cos(d) - 1 = -2 sin(d / 2)**2, of period 2 pi and exact near the mode
        value = np.asarray(np.sin(np.asarray(0.5 * (x - self.loc))))
        value *= value
        value *= -2.0
        value = np.asarray(value * self.concentration)
        value -= _LOG_TURN + np.log(special.i0e(self.concentration))
        return _only_angles(x, value)

    @property
    def var(self) -> np.ndarray:
        """Squared circular standard deviation ``-2 log(I1(k) / I0(k))``; infinite for uniform."""
        k = self.concentration
        series, inverse = 0.0 * k, 1 / np.maximum(k, 500.0)
        for coefficient in (1073 / 1024, 13 / 32, 25 / 128, 1 / 8, 1 / 8, 1 / 2):
            series = (series + coefficient) * inverse  # 1 - I1 / I0 of large k, without cancelling
        with np.errstate(divide="ignore"):
            direct = -2 * np.log(special.i1e(k) / special.i0e(k))
        return np.broadcast_to(np.where(k > 500, -2 * np.log1p(-series), direct), self.batch_shape)

    def _below(self, distance: np.ndarray) -> np.ndarray:
        k = self.concentration
        lower = -np.abs(distance)
        if not k.size or k.max() < _SERIES_UP_TO:
            mass = _von_mises_series(lower, k)
        elif k.min() >= _SERIES_UP_TO:
            mass = _von_mises_tail(lower, k)
        else:
            series = _von_mises_series(lower, np.minimum(k, _SERIES_UP_TO))
            tail = _von_mises_tail(lower, np.maximum(k, _SERIES_UP_TO))
            mass = np.where(k < _SERIES_UP_TO, series, tail)
        return np.where(distance > 0, 1.0 - mass, mass)

    def _spread(self) -> np.ndarray:
        return 1 / np.sqrt(np.maximum(self.concentration, 1.0))


class WrappedNormal(_Circular, LocationScale):
    """Wrapped normal distribution: a normal number taken as an angle.

    Parameters
    ----------
    loc : array_like
        Mean direction in radians, any finite angle.
    scale : array_like
        Standard deviation of the normal, positive; it is also the circular standard deviation.

    Raises
    ------
    ParameterError
        ``loc`` not finite, or ``scale`` not positive and finite.

    References
    ----------
    Mardia and Jupp, Directional Statistics, 2000, section 3.5.7: equation 3.5.61 where ``scale`` is
    small, the Fourier series 3.5.66 (a theta function) where it is large.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> heading = bmc.WrappedNormal(3.0, 0.5)
    >>> heading.log_prob([3.0, 3.0 - 2 * np.pi, 0.0]).round(4).tolist()
    [-0.2258, -0.2258, -18.1977]
    >>> float(heading.mean), float(heading.var)
    (3.0, 0.25)
    """

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        draws = np.asarray(rng.standard_normal(shape))
        draws *= np.minimum(self.scale, _UNIFORM)
        draws += wrap_angle(self.loc)
        return wrap_angle(draws)

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        distance = _short_way(x - self.loc)
        value = self._by_scale(_log_wrapped_sum, _log_fourier, distance)
        return _only_angles(x, value)

    @property
    def var(self) -> np.ndarray:
        return np.broadcast_to(self.scale**2, self.batch_shape)

    def _below(self, distance: np.ndarray) -> np.ndarray:
        with np.errstate(over="ignore"):
            mass = self._by_scale(_wrapped_tail, _fourier_tail, -np.abs(distance))
        return np.where(distance > 0, 1.0 - mass, mass)

    def _spread(self) -> np.ndarray:
        return self.scale

    def _by_scale(self, narrow: Any, wide: Any, distance: np.ndarray) -> np.ndarray:
        scale = self.scale
        if not scale.size or scale.max() < _SMOOTH:
            return narrow(distance, scale)
        if scale.min() >= _SMOOTH:
            return wide(distance, scale)
        near, far = np.minimum(scale, _SMOOTH), np.maximum(scale, _SMOOTH)
        return np.where(scale < _SMOOTH, narrow(distance, near), wide(distance, far))


def wrap_angle(x: Any) -> np.ndarray:
    """The same angle in ``[-pi, pi)``; angles there already keep every digit."""
    x = np.asarray(x, dtype=float)
    outside = (x < -_PI) | (x >= _PI)
    if not outside.any():
        return x
    with np.errstate(invalid="ignore"):
        wrapped = np.remainder(x, _TURN)  # exact, in [0, 2 pi)
        wrapped = np.where(wrapped >= _PI, wrapped - _TURN, wrapped)
    return np.where(outside, wrapped, x)


def _only_angles(x: np.ndarray, value: np.ndarray) -> np.ndarray:
    """``value``, minus infinity where ``x`` is infinite and so no angle."""
    if not np.isnan(value).any():
        return value
    return np.where(np.isinf(x), -np.inf, value)


def _von_mises_series(distance: np.ndarray, k: np.ndarray) -> np.ndarray:
    """Mass from ``-pi`` to ``distance`` by the Fourier series, summed backwards.

    The ratios of Bessel functions come from their continued fraction on the way.
    """
    terms = 12 + int(9 * np.sqrt(k.max(initial=0.0)))
    sine, cosine = np.sin(distance), np.cos(distance)
    sine_n, cosine_n = np.sin(terms * distance), np.cos(terms * distance)
    ratio, total = np.zeros(k.shape), np.zeros(np.shape(distance))
    with np.errstate(divide="ignore", over="ignore"):
        for n in range(terms - 1, 0, -1):
            sine_n, cosine_n = sine_n * cosine - cosine_n * sine, cosine_n * cosine + sine_n * sine
            ratio = 1 / (2 * n / k + ratio)
            total = ratio * (sine_n / n + total)
    return np.maximum(0.5 + distance / _TURN + total / _PI, 0.0)


def _von_mises_tail(distance: np.ndarray, k: np.ndarray) -> np.ndarray:
    """Mass from ``-pi`` to ``distance <= 0`` for large concentrations.

    With ``s = sin(d / 2)`` the density is that of a normal times ``1 / sqrt(1 - s**2)``; its power
    series is integrated term by term into incomplete gamma functions, all of them positive. What
    is missing (the terms beyond, and the gammas' tails past ``s = 1``) is below ``exp(-2 k)``.
    """
    sine = np.abs(np.sin(0.5 * distance))
    width = np.sqrt(2.0) * np.sqrt(k)
    root = width * sine
    upper = np.sqrt(_PI) * special.erfc(root)  # Gamma(n + 1/2, root**2) / (2 k)**n, from n = 0 on
    edge = sine * np.exp(-root * root) / width
    coefficient, total = 1.0, upper
    for n in range(1, 25):
        upper = 0.5 * (n - 0.5) / k * upper + edge
        edge = edge * (sine * sine)
        coefficient *= (n - 0.5) / n
        total = total + coefficient * upper
    return total / (width * _TURN * special.i0e(k))


def _short_way(off: np.ndarray) -> np.ndarray:
    """Size of an angle taken the short way, in ``[0, pi]``; NaN where it is no angle."""
    if (np.abs(off) > _FAR).any():
        return np.abs(wrap_angle(off))
    turns = np.asarray(np.rint(off * (1 / _TURN)))  # up to two, their product is exact
    turns *= _TURN
    np.subtract(off, turns, out=turns)
    np.abs(turns, out=turns)
    return np.minimum(turns, _PI, out=turns)


def _log_wrapped_sum(distance: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Log density at ``distance`` in [0, pi]: the nearest normal, times what the others add.

    They add something where the distance is close to half a turn, for narrow scales almost nowhere.
    """
    value = np.asarray(distance / scale)
    value *= value
    value *= -0.5
    value -= np.log(scale) + 0.5 * _LOG_TURN
    shared = np.asarray(distance >= _PI - _ALONE / _TURN * (scale * scale))
    count = np.count_nonzero(shared)
    if 4 * count > shared.size:
        value += np.log1p(_others(distance, scale))
    elif count:
        distance, scale = (np.broadcast_to(a, shared.shape)[shared] for a in (distance, scale))
        value[shared] += np.log1p(_others(distance, scale))
    return value


def _others(distance: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Densities of the next three normals, beside the nearest's."""
    inverse = np.minimum(1 / scale, 1 / _TINY)
    total = np.exp(-_TURN * inverse * ((_PI - distance) * inverse))  # the square would overflow
    if not scale.size or scale.max() ** 2 * _ALONE < _TURN * _PI:
        return total
    # the second is q / first and the third q * first**2, with q as below
    q = np.exp(-((_TURN * inverse) ** 2))
    return total + q * (1 / np.maximum(total, _TINY) + total * total)


def _log_fourier(distance: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Log density by the Fourier series, whose coefficients are ``exp(-(n scale)**2 / 2)``; by Clenshaw."""
    terms = int(np.clip(np.sqrt(2 * _ALONE) / scale.min(), 1, 7))
    first = np.exp(-0.5 * scale * scale)
    coefficient, ratio = [first], first
    for _ in range(1, terms):  # powers 1, 4, 9 ... of the first
        ratio = ratio * first * first
        coefficient.append(coefficient[-1] * ratio)
    cosine = np.asarray(np.cos(distance))
    current = np.array(
        np.broadcast_to(coefficient[-1], np.broadcast_shapes(cosine.shape, scale.shape))
    )
    before, spare = np.zeros_like(current), np.empty_like(current)
    twice = 2 * cosine
    for a in coefficient[-2::-1]:
        np.multiply(twice, current, out=spare)
        spare -= before
        spare += a
        before, current, spare = current, spare, before
    current *= twice
    before *= 2
    current -= before  # twice the sum
    current += 1.0
    return np.log(current, out=current) - _LOG_TURN


def _wrapped_tail(distance: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Mass from ``-pi`` to ``distance <= 0``: that of each normal whose mean is turns away."""
    total = special.ndtr(distance / scale)
    for turn in (_TURN, 2 * _TURN):  # their masses from -pi on cancel in pairs
        total = total + special.ndtr((distance - turn) / scale)
        total = total - special.ndtr((-distance - turn) / scale)
    return np.maximum(total, 0.0)


def _fourier_tail(distance: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Mass from ``-pi`` to ``distance <= 0`` by the integrated Fourier series."""
    total = 0.5 * distance
    for n in range(1, 8):
        total = total + np.exp(-0.5 * (n * scale) ** 2) / n * np.sin(n * distance)
    return np.maximum(0.5 + total / _PI, 0.0)
