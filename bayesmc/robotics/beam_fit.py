"""Learning the beam model by EM: the parameters of a range finder, from ranges and what was expected.

The model itself, and the density of a scan, are in ``beams``.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from bayesmc.distributions.base import as_float
from bayesmc.errors import ConvergenceWarning, ParameterError, ShapeError
from bayesmc.robotics.beams import (
    PARTS,
    BeamModel,
    as_model,
    log_bell,
    log_parts,
    log_short_ranges,
    log_total,
)
from bayesmc.robotics.grid import as_number


class BeamFit(NamedTuple):
    """What ``fit_beams`` found.

    Attributes
    ----------
    model : BeamModel
    log_likelihood : ndarray, shape (iterations + 1,)
        Of the data (not tempered) under the model before each iteration and after the last; it
        never falls.
    converged : bool
        Whether the last iteration gained less than the tolerance, and ``sigma_hit`` did not end at its bound.
    at_bound : tuple of str
        Parameters that the data would have smaller than they may be: ``"sigma_hit"``, and ``"lambda_short"``
        where short readings do not thin out along the beam.
    """

    model: BeamModel
    log_likelihood: np.ndarray
    converged: bool
    at_bound: tuple[str, ...] = ()


def fit_beams(
    ranges: Any,
    expected: Any,
    start: BeamModel | None = None,
    *,
    iterations: int = 200,
    tolerance: float = 1e-7,
    least_sigma: float = 1e-3,
) -> BeamFit:
    """The intrinsic parameters of greatest likelihood, learned from ranges by EM.

    Parameters
    ----------
    ranges, expected : array_like, same shape
        Readings and expected ranges (m); pairs with a NaN or a negative reading are left out.
    start : BeamModel, optional
        Where to begin; its ``max_range`` and ``tempering`` are kept. A share that is 0 stays 0.
    iterations : int
        At most so many.
    tolerance : float
        Gain in mean log likelihood per beam below which it has converged.
    least_sigma : float
        The least ``sigma_hit`` in m. Readings that equal what is expected, such as simulated ones without
        noise, have no greatest likelihood: it grows without end as ``sigma_hit`` shrinks.

    Returns
    -------
    BeamFit

    Raises
    ------
    ParameterError
        An expected range is NaN or negative, ``start`` gives some reading probability zero or has a
        ``sigma_hit`` below ``least_sigma``, or that is not positive and finite.
    ShapeError
        The two arrays differ in shape, or there is no usable reading.
    TypeError
        ``start`` is no BeamModel.

    Warns
    -----
    ConvergenceWarning
        ``sigma_hit`` ended at ``least_sigma``.

    Notes
    -----
    Short readings that are spread evenly, or are more the nearer to what is expected, have no rate above 0
    that is best; ``lambda_short`` is kept at ``0.001 / max_range`` or more, which is even to a thousandth.

    The scale of hits and the rate of short ones are maximised with the truncation that
    the density has (the closed forms of the table ignore it and can lower the likelihood), one
    number at a time.

    References
    ----------
    Thrun, Burgard and Fox, Probabilistic Robotics, 2005, table 6.2.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.robotics import BeamModel, Beams, fit_beams
    >>> truth = BeamModel(0.6, 0.2, 0.1, 0.1, sigma_hit=0.1, lambda_short=0.8, max_range=8.0)
    >>> expected = np.random.default_rng(0).uniform(1.0, 8.0, 4000)
    >>> fit = fit_beams(Beams(expected, truth).sample(1), expected, BeamModel(max_range=8.0))
    >>> [round(share, 2) for share in fit.model.shares], round(fit.model.sigma_hit, 2)
    ([0.61, 0.19, 0.1, 0.1], 0.1)
    """
    model = BeamModel() if start is None else as_model("fit_beams", start)
    least = _least(model, least_sigma)
    z, expected = _pairs(ranges, expected, model)
    history: list[float] = []
    converged = False
    for _ in range(iterations + 1):
        with np.errstate(all="ignore"):
            parts = log_parts(model, z, expected)
            each = log_total(model, z, parts)
            share = np.exp(parts - each)
        log = float(each.sum())
        if not math.isfinite(log):
            at = int(np.argmin(each))
            raise ParameterError(
                f"fit_beams: the model gives the reading {z[at]:g} m (expected {expected[at]:g} m) "
                "probability zero; start with z_rand and z_max above 0"
            )
        converged = bool(history) and log - history[-1] < tolerance * len(z)
        history.append(log)
        if converged or len(history) > iterations:
            break
        model = _maximised(model, z, expected, share, least)
    stuck = _at_bound(model, least, len(z))
    return BeamFit(model, np.array(history), converged and "sigma_hit" not in stuck, stuck)


# ---- private ------------------------------------------------------------------------------------


class _Least(NamedTuple):
    """What the scale and the rate may not fall below."""

    sigma_hit: float
    lambda_short: float


def _least(start: BeamModel, sigma: float) -> _Least:
    if not 0 < as_number(sigma) < math.inf:
        raise ParameterError(
            f"fit_beams: least_sigma must be positive and finite; got {sigma!r:.80}"
        )
    if start.sigma_hit < sigma:
        raise ParameterError(
            f"fit_beams: start has sigma_hit={start.sigma_hit:g}, below least_sigma={sigma:g}; give a "
            "smaller least_sigma"
        )
    return _Least(float(sigma), min(1e-3 / start.max_range, start.lambda_short))


def _at_bound(model: BeamModel, least: _Least, count: int) -> tuple[str, ...]:
    """Parameters that ended at their bounds, and a warning about the one that spoils the fit."""
    found = []
    if model.sigma_hit <= least.sigma_hit * (1 + 1e-4):
        found.append("sigma_hit")
        warnings.warn(
            f"fit_beams: sigma_hit ended at least_sigma={least.sigma_hit:g} m: hits hardly differ from what "
            "is expected; are these real readings, and is expected not made of them?",
            ConvergenceWarning,
            stacklevel=3,
        )
    # a rate of short readings that there are none of says nothing
    if model.lambda_short <= least.lambda_short * (1 + 1e-4) and model.z_short * count > 1:
        found.append("lambda_short")
    return tuple(found)


def _maximised(
    model: BeamModel, z: np.ndarray, expected: np.ndarray, share: np.ndarray, least: _Least
) -> BeamModel:
    """The M step: shares in closed form, scale and rate one at a time."""
    hit, short = share[0], share[1]
    blind, empty = expected >= model.max_range, expected == 0
    # what is expected at 0 is hit or short, undivided; the old shares divide it
    both = model.z_hit + model.z_short
    moved = (hit * empty).sum() * (model.z_short / both if both else 0.0)
    totals = share.sum(axis=1) + np.array([-moved, moved, 0.0, 0.0])
    parts = dict(zip(PARTS, (totals / totals.sum()).tolist(), strict=True))
    bells = ~blind & (hit > 0)
    sigma = _improved(
        lambda s: float(hit[bells] @ log_bell(z[bells], expected[bells], s, model.max_range)),
        model.sigma_hit,
        least.sigma_hit,
    )
    exponentials = short > 0
    rate = _improved(
        lambda r: float(
            short[exponentials] @ log_short_ranges(z[exponentials], expected[exponentials], r)
        ),
        model.lambda_short,
        least.lambda_short,
    )
    return replace(model, **parts, sigma_hit=sigma, lambda_short=rate)


def _improved(gain: Callable[[float], float], now: float, least: float) -> float:
    """A number near ``now``, at least ``least``, of the greatest ``gain``; ``now`` where none is greater."""
    from scipy.optimize import minimize_scalar

    low = max(-1.5, math.log(least / now))
    with np.errstate(all="ignore"):
        found = minimize_scalar(
            lambda log: -gain(now * math.exp(log)),
            bounds=(low, 1.5),
            method="bounded",
            options={"xatol": 1e-6},
        )
        others = [now, max(now * math.exp(found.x), least)]
        if low > -1.5:  # the search comes close to its ends and never there
            others.append(least)
        gains = [gain(other) for other in others]
        return others[int(np.argmax(gains))]


def _pairs(ranges: Any, expected: Any, model: BeamModel) -> tuple[np.ndarray, np.ndarray]:
    """Usable readings and what was expected of them, flat."""
    z, expected = as_float(ranges), as_float(expected)
    if z.shape != expected.shape:
        raise ShapeError(
            f"fit_beams: ranges have shape {z.shape}, expected ranges {expected.shape}; give one for each"
        )
    z, expected = z.ravel(), expected.ravel()
    usable = z >= 0
    z, expected = z[usable], expected[usable]
    if not len(z):
        raise ShapeError("fit_beams: there is no usable reading (all are NaN or negative)")
    bad = ~(expected >= 0)
    if bad.any():
        at = int(np.argmax(bad))
        raise ParameterError(
            f"fit_beams: expected ranges must be nonnegative; got {expected[at]} at usable reading {at}"
        )
    return np.minimum(z, model.max_range), np.minimum(expected, model.max_range)
