"""Monte Carlo integration: expectations, importance sampling, and hit or miss in a box."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from bayesmc.diagnostics import MIN_WEIGHT_ESS, share_mcse, weight_ess
from bayesmc.errors import (
    EnvelopeError,
    LowEssWarning,
    ParameterError,
    QueryError,
    ShapeError,
    ZeroProbabilityError,
)
from bayesmc.montecarlo.estimate import Estimate
from bayesmc.montecarlo.target import (
    check_callable,
    check_proposal,
    chunk_sizes,
    count_of,
    evaluate,
    log_density,
    number,
    show,
    single,
    streams,
)


def integrate(
    function: Callable[[np.ndarray], Any],
    distribution: Any,
    draws: int = 10_000,
    rng: Any = None,
    *,
    proposal: Any = None,
    normalised: bool = False,
) -> Estimate:
    """Monte Carlo estimate of the expectation of ``function`` under ``distribution``.

    Parameters
    ----------
    function : callable
        Maps points of shape ``(n, *event)`` to values of shape ``(n, *out)``.
    distribution : Distribution, frozen scipy.stats distribution or callable
        The density p. With ``proposal`` it is only evaluated, and may be a function that gives log
        densities of points ``(n, *event)``.
    draws : int
        At least 2.
    rng : seed, SeedSequence, Generator or None
    proposal : Distribution, optional
        The density q to draw from instead; values are weighted by p/q. It must not vanish where
        ``p`` times the function does not.
    normalised : bool
        Divide by the sum of the weights rather than by ``draws``: for densities p known up to a
        factor, at the cost of a bias of order ``1 / draws``.

    Returns
    -------
    Estimate
        The integral of function times p; its error is the values' standard deviation over
        ``sqrt(draws)``, or the delta method's where ``normalised``. Of booleans it is never
        zero (``diagnostics.share_mcse``).

    Raises
    ------
    QueryError
        The function fails on arrays, or returns another first axis than the points', complex
        numbers, NaN or infinity.
    ZeroProbabilityError
        All weights are zero.
    UnsupportedError
        What is to be drawn from cannot be sampled, or one of density and proposal is discrete and
        the other continuous.

    Warns
    -----
    SupportWarning
        The proposal's support is narrower than the declared one of the density.
    LowEssWarning
        The weighted values (with ``normalised`` the weights) amount to fewer than 100 draws.

    References
    ----------
    Owen, Monte Carlo Theory, Methods and Examples, 2013, chapter 2 and sections 9.1 to 9.3.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.montecarlo import integrate
    >>> square = integrate(lambda x: x**2, bmc.Normal(0.0, 1.0), draws=100_000, rng=0)
    >>> low, high = square.interval(0.999)
    >>> bool(low < 1.0 < high)
    True
    """
    count = count_of("integrate", draws, 2)
    check_callable("integrate", function)
    if proposal is None and normalised:
        raise ParameterError(
            "integrate: normalised=True weights draws of another density; give it with proposal="
        )
    source = single(
        "integrate",
        "distribution" if proposal is None else "proposal",
        distribution if proposal is None else proposal,
    )
    if proposal is not None:
        check_proposal("integrate", distribution, source)
    values, log_weights, is_event = [], [], False
    log_p = log_density("integrate", "distribution", distribution) if proposal is not None else None
    log_q = log_density("integrate", "proposal", source)
    for size, generator in zip(chunk_sizes(count, source.event_shape), streams(rng), strict=False):
        points = source.sample(generator, size)
        value = evaluate("integrate", function, points)
        weight = np.zeros(size) if log_p is None else log_p(points) - log_q(points)
        is_event = value.dtype == bool
        values.append(_finite(value, weight, points))
        log_weights.append(weight)
    value = np.concatenate(values)
    weight = np.concatenate(log_weights)
    if log_p is None:
        found = _plain(value)
    else:
        _warn(value, weight, normalised)
        found = _ratio(value, weight) if normalised else _weighted(value, weight)
    return _not_certain(found, value, weight, normalised) if is_event else found


def hit_or_miss(
    function: Callable[[np.ndarray], Any],
    low: Any,
    high: Any,
    draws: int = 10_000,
    rng: Any = None,
    *,
    height: float | None = None,
) -> Estimate:
    """Volume of a region in a bounding box, or the integral of a function under a lid.

    Parameters
    ----------
    function : callable
        Maps points of the box, shape ``(n,)`` (bounds are numbers) or ``(n, d)``, to ``n`` booleans
        (inside or not); with ``height`` to ``n`` values between 0 and ``height``.
    low, high : array_like
        Corners of the box: numbers, or d of them.
    draws : int
        Points thrown, at least 1.
    rng : seed, SeedSequence, Generator or None
    height : float, optional
        Lid of the box over ``[low, high]``: then the integral of the function is estimated.

    Returns
    -------
    Estimate
        With the binomial standard error of the hit rate, to which ``diagnostics.share_mcse`` adds, so that
        no hit at all is not taken for certainty.

    Raises
    ------
    EnvelopeError
        The function leaves ``[0, height]`` at a point, which is named.
    ParameterError
        The box is empty or not finite.
    QueryError
        The function does not return one boolean (one number) per point.

    References
    ----------
    Hammersley and Handscomb, Monte Carlo Methods, 1964, section 5.2.

    Examples
    --------
    >>> from bayesmc.montecarlo import hit_or_miss
    >>> quarter = hit_or_miss(lambda p: (p**2).sum(axis=-1) <= 1, [0.0, 0.0], [1.0, 1.0], 100_000, 0)
    >>> bool(abs(4 * float(quarter) - 3.14159) < 4 * 4 * quarter.standard_error)
    True
    """
    count = count_of("hit_or_miss", draws, 1)
    check_callable("hit_or_miss", function)
    low, high = _box(low, high)
    if height is not None and not 0 < number("hit_or_miss", "height", height) < np.inf:
        raise ParameterError(f"hit_or_miss: height must be positive and finite; got {height!r}")
    hits = 0
    for size, generator in zip(chunk_sizes(count, low.shape), streams(rng), strict=False):
        points = low + (high - low) * generator.random((size, *low.shape))
        value = evaluate("hit_or_miss", function, points)
        if value.shape != (size,):
            raise QueryError(
                f"hit_or_miss: the function returned shape {value.shape} for {size} points; it must "
                "give one value per point (reduce the components with axis=-1)"
            )
        hits += int(np.count_nonzero(_hit(value, points, height, generator)))
    volume = float(np.prod(high - low)) * (1.0 if height is None else float(height))
    rate = hits / count
    error = float(share_mcse(np.sqrt(rate * (1.0 - rate) / count), count))
    return Estimate(volume * rate, volume * error, count)


def _hit(
    value: np.ndarray, points: np.ndarray, height: float | None, rng: np.random.Generator
) -> np.ndarray:
    if height is None:
        if value.dtype != bool:
            raise QueryError(
                f"hit_or_miss: the function returned {value.dtype}, not booleans; compare (as in "
                "x**2 < 1), or give height= to integrate it"
            )
        return value
    outside = ~((value >= 0) & (value <= height))
    if outside.any():
        at = int(np.argmax(outside))
        raise EnvelopeError(
            f"hit_or_miss: the function is {value[at]:.6g} at {show(points[at])}, outside the box "
            f"from 0 to height={height:g}; raise height, or shift the function to be nonnegative",
            points[at],
            float(value[at] / height),
        )
    return height * rng.random(len(points)) < value


def _box(low: Any, high: Any) -> tuple[np.ndarray, np.ndarray]:
    try:
        low, high = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    except (TypeError, ValueError):
        raise ParameterError(
            f"hit_or_miss: low and high must be numbers or vectors; got {low!r:.60} and {high!r:.60}"
        ) from None
    if low.ndim > 1 or high.ndim > 1:
        raise ShapeError("hit_or_miss: low and high must be numbers or vectors")
    try:
        low, high = np.broadcast_arrays(low, high)
    except ValueError:
        raise ShapeError(
            f"hit_or_miss: low has {low.size} components and high {high.size}"
        ) from None
    if not (np.isfinite(low) & np.isfinite(high) & (low < high)).all():
        raise ParameterError(
            f"hit_or_miss: the box needs finite low < high; got {show(low)} and {show(high)}"
        )
    return low, high


def _finite(value: np.ndarray, log_weight: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The values as floats, zero where they have no weight."""
    value = value.astype(float)
    lead = (-1,) + (1,) * (value.ndim - 1)
    value = np.where((log_weight > -np.inf).reshape(lead), value, 0.0)
    bad = ~np.isfinite(value)
    if bad.any():
        at = int(np.argmax(bad.reshape(len(value), -1).any(axis=1)))
        raise QueryError(
            f"integrate: the function is {show(value[at])} at {show(points[at])}; it must be finite "
            "wherever the density is positive"
        )
    return value


def _plain(value: np.ndarray) -> Estimate:
    n = len(value)
    return Estimate(value.mean(axis=0), value.std(axis=0, ddof=1) / np.sqrt(n), n)


def _weighted(value: np.ndarray, log_weight: np.ndarray) -> Estimate:
    top = float(log_weight.max())
    weight = np.exp(log_weight - top).reshape((-1,) + (1,) * (value.ndim - 1))
    relative = _plain(value * weight)
    scale = np.exp(top)
    return Estimate(relative.value * scale, relative.standard_error * scale, len(value))


def _ratio(value: np.ndarray, log_weight: np.ndarray) -> Estimate:
    """Self-normalised, with the delta method's error (Owen 2013, equation 9.9)."""
    weight = np.exp(log_weight - log_weight.max())
    weight = (weight / weight.sum()).reshape((-1,) + (1,) * (value.ndim - 1))
    mean = (weight * value).sum(axis=0)
    error = np.sqrt((weight**2 * (value - mean) ** 2).sum(axis=0))
    return Estimate(mean, error, len(value))


def _not_certain(
    found: Estimate, value: np.ndarray, log_weight: np.ndarray, normalised: bool
) -> Estimate:
    """Booleans that came out all equal, or nearly so, leave the error of an unseen one."""
    used = value[log_weight > -np.inf]
    equal = (used == used[:1]).all(axis=0)
    weight = np.exp(log_weight - log_weight.max())
    size = 1.0 if normalised else float(np.exp(log_weight.max()) * weight.mean())
    count = float(weight.sum() ** 2 / (weight**2).sum())  # effective draws
    # what a proposal was made to find is seen often, with weights however small
    counts = np.where(equal | (weight == 1.0).all(), count, np.inf)
    error = share_mcse(found.standard_error / size, counts)
    return Estimate(found.value, size * error, found.draws)


def _warn(value: np.ndarray, log_weight: np.ndarray, normalised: bool) -> None:
    """Refuse weights that are all zero, warn of few that decide: of the terms, or of the ratio."""
    if not (log_weight > -np.inf).any():
        raise ZeroProbabilityError(
            "integrate: every draw of the proposal has density zero; use one that covers the density"
        )
    deciding = log_weight
    if not normalised:
        with np.errstate(divide="ignore"):
            deciding = log_weight + np.log(np.abs(value).reshape(len(value), -1).sum(axis=1))
        if not (deciding > -np.inf).any():
            return
    ess = weight_ess(deciding)
    if ess < MIN_WEIGHT_ESS:
        warnings.warn(
            f"integrate: the answer rests on {ess:.1f} effective draws of {len(log_weight)}; use a "
            "proposal nearer to the density, with heavier tails, or more draws",
            LowEssWarning,
            stacklevel=3,
        )
