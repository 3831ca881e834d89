"""The beam model of a range finder: a mixture of four causes for each range, given the range expected.

A beam hits what the map expects, or something unexpected before it (short), or nothing (max), or
reads anything (random); a scan is the product over its beams. Where the expected ranges come from,
rays cast on a map or anything else, is not decided here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

from bayesmc.distributions import Distribution
from bayesmc.distributions.base import as_float
from bayesmc.distributions.support import Support, nonnegative, product
from bayesmc.errors import ParameterError, ShapeError
from bayesmc.robotics.grid import as_number
from bayesmc.shapes import Shape

_HALF_LOG_2PI = 0.5 * math.log(2 * math.pi)
PARTS = ("z_hit", "z_short", "z_max", "z_rand")


@dataclass(frozen=True)
class BeamModel:
    """The intrinsic parameters of a range finder.

    Parameters
    ----------
    z_hit, z_short, z_max, z_rand : float
        Shares of the four causes, nonnegative, of sum 1.
    sigma_hit : float
        Standard deviation (m) of a range about the one expected.
    lambda_short : float
        Rate (1/m) at which unexpected obstacles turn up along a beam.
    max_range : float
        Reading (m) of a beam that meets nothing.
    tempering : float
        Exponent of the density of a scan: beams are less independent than the product makes them.
        Positive; 1 leaves it as it is.

    Raises
    ------
    ParameterError
        A parameter is out of range, or the shares do not sum to 1.

    References
    ----------
    Thrun, Burgard and Fox, Probabilistic Robotics, 2005, section 6.3.

    Examples
    --------
    >>> from bayesmc.robotics.beams import BeamModel
    >>> BeamModel(z_hit=0.7, z_short=0.1, z_max=0.1, z_rand=0.1, max_range=8.0).sigma_hit
    0.2
    """

    z_hit: float = 0.75
    z_short: float = 0.1
    z_max: float = 0.05
    z_rand: float = 0.1
    sigma_hit: float = 0.2
    lambda_short: float = 0.5
    max_range: float = 80.0
    tempering: float = 1.0

    def __post_init__(self) -> None:
        for name in PARTS:
            _require(0 <= as_number(getattr(self, name)) <= 1, self, name, "between 0 and 1")
        total = sum(self.shares)
        if abs(total - 1) > 1e-6:
            raise ParameterError(
                f"BeamModel: z_hit, z_short, z_max and z_rand must sum to 1; they sum to {total:.6g}"
            )
        for name in ("sigma_hit", "lambda_short", "max_range", "tempering"):
            ok = 0 < as_number(getattr(self, name)) < math.inf
            _require(ok, self, name, "positive and finite")

    @property
    def shares(self) -> tuple[float, float, float, float]:
        """Of hit, short, max and random."""
        return self.z_hit, self.z_short, self.z_max, self.z_rand


class Beams(Distribution):
    """Ranges (m) of the beams of a range finder, each about the range expected of it.

    The density of one range z is that with respect to length on ``[0, max_range)`` plus a unit mass
    at ``max_range``:

    - hit: normal about the expected range, truncated to ``[0, max_range]``;
    - short: exponential, truncated to ``[0, expected]``;
    - max: the mass at ``max_range``;
    - random: uniform on ``[0, max_range)``.

    Each is normalised. Where ``max_range`` or more is expected, a hit reads ``max_range``; where 0
    is expected there is no room for a short one, which then is a hit.

    Parameters
    ----------
    expected : array_like, shape (..., beams)
        Expected ranges, nonnegative; ``max_range`` and above (infinite included): nothing is met.
    model : BeamModel

    Raises
    ------
    ParameterError
        An expected range is negative or NaN.
    TypeError
        ``model`` is no BeamModel.

    Notes
    -----
    - A reading of ``max_range`` or above (infinite included) is the max reading, a negative one is
      impossible, NaN is a beam that is left out (its factor is 1). Evidence of a net is finite, so put
      scans through ``clean_ranges`` before they become a net's rows: it makes max readings of all these.
    - With ``tempering`` other than 1, ``log_prob`` is the tempered log density, which is not
      normalised; draws come from the density without the exponent.

    References
    ----------
    Thrun, Burgard and Fox, Probabilistic Robotics, 2005, equations 6.4 to
    6.13. There, the random and the max reading share no common measure; the mass at ``max_range``
    is made explicit here.

    Examples
    --------
    >>> from bayesmc.robotics.beams import BeamModel, Beams
    >>> scan = Beams([2.0, 8.0], BeamModel(max_range=8.0))
    >>> scan.log_prob([[2.0, 8.0], [1.0, 8.0], [2.0, 3.0]]).round(2).tolist()
    [0.21, -3.03, -3.31]
    >>> scan.sample(rng=0).shape, scan.event_shape
    ((2,), (2,))
    """

    parameter_ndim = {"expected": 1}

    def __init__(self, expected: Any, model: BeamModel) -> None:
        expected, model = as_float(expected), as_model("Beams", model)
        if expected.ndim == 0:
            raise ShapeError("Beams: expected ranges are one number; give (..., beams)")
        self.batch_shape, self.event_shape = expected.shape[:-1], expected.shape[-1:]
        if not (expected.size and expected.min() >= 0):  # NaN fails as well
            ok = (expected >= 0).all(axis=-1)
            expected = self._check("expected", expected, ok, 0.0, "nonnegative")
        self.expected = np.minimum(expected, model.max_range)
        self.model = model

    @property
    def support(self) -> Support:
        return product([(nonnegative, self.event_shape[0])])

    @property
    def tempering(self) -> float:
        """Exponent of the density: so much of an independent number is each beam taken for."""
        return self.model.tempering

    def log_prob_by_beam(self, x: Any) -> np.ndarray:
        """Log density of each range, without the exponent, shape (..., beams); 0 where NaN.

        Parameters
        ----------
        x : array_like, shape (..., beams)
        """
        with np.errstate(all="ignore"):
            x = np.asarray(x, dtype=float)
            return log_total(self.model, x, log_parts(self.model, x, self.expected))

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        if x.shape[-1:] != self.event_shape:
            raise ShapeError(f"ranges have shape {x.shape}, not (..., {self.event_shape[0]})")
        return self.model.tempering * self.log_prob_by_beam(x).sum(axis=-1)

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        model, full = self.model, shape + self.event_shape
        expected = np.broadcast_to(self.expected, full)
        cause = np.searchsorted(np.cumsum(model.shares)[:3], rng.random(full), side="right")
        cause = np.where((cause == 1) & (expected == 0), 0, cause)
        u = rng.random(full)
        low = special.ndtr(-expected / model.sigma_hit)
        high = special.ndtr((model.max_range - expected) / model.sigma_hit)
        hit = expected + model.sigma_hit * special.ndtri(low + u * (high - low))
        hit = np.where(expected >= model.max_range, model.max_range, hit)
        short = np.log1p(u * np.expm1(-model.lambda_short * expected)) / -model.lambda_short
        draws = np.choose(cause, [hit, short, model.max_range, u * model.max_range])
        return np.clip(draws, 0.0, model.max_range)


def clean_ranges(ranges: Any, max_range: float) -> np.ndarray:
    """Readings as a range finder's evidence: what is no return reads ``max_range``.

    Parameters
    ----------
    ranges : array_like
        As logged, m; NaN, infinite, negative or beyond ``max_range`` where nothing was seen.
    max_range : float
        In m, positive and finite.

    Returns
    -------
    ndarray
        In ``[0, max_range]``.

    Raises
    ------
    ParameterError
        ``max_range`` is not positive and finite.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.robotics.beams import clean_ranges
    >>> clean_ranges([1.5, np.nan, 81.8, -1.0], 80.0).tolist()
    [1.5, 80.0, 80.0, 80.0]
    """
    if not 0 < as_number(max_range) < math.inf:
        raise ParameterError(
            f"clean_ranges: max_range must be positive and finite; got {max_range!r:.80}"
        )
    ranges = np.asarray(ranges, dtype=float)
    return np.where((ranges >= 0) & (ranges < max_range), ranges, max_range)


# ---- private ------------------------------------------------------------------------------------


def log_parts(model: BeamModel, z: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Logs of share times density of hit, short, max and random, shape (4, ...); none is tempered."""
    sigma, rate, end = model.sigma_hit, model.lambda_short, model.max_range
    log_hit, log_short, log_max, log_rand = (_log(share) for share in model.shares)
    at_end, within = z >= end, (z >= 0) & (z < end)
    blind, empty = expected >= end, expected == 0
    own = np.where(empty, np.logaddexp(log_hit, log_short), log_hit)
    bell = log_bell(z, expected, sigma, end)
    hit = np.where(blind, np.where(at_end, own, -np.inf), np.where(within, own + bell, -np.inf))
    before = within & (z <= expected) & ~empty
    short = np.where(before, log_short + log_short_ranges(z, expected, rate), -np.inf)
    largest = np.where(at_end, log_max, -np.inf)
    uniform = np.where(within, log_rand - math.log(end), -np.inf)
    return np.stack(np.broadcast_arrays(hit, short, largest, uniform))


def log_total(model: BeamModel, z: np.ndarray, parts: np.ndarray) -> np.ndarray:
    """Log density of each range from that of its parts."""
    top = parts.max(axis=0)
    top = np.where(np.isfinite(top), top, 0.0)
    total = top + np.log(np.exp(parts - top).sum(axis=0))
    return np.where(np.isnan(z), 0.0, total)


def log_bell(z: np.ndarray, expected: np.ndarray, sigma: float, end: float) -> np.ndarray:
    """Log density of a normal truncated to ``[0, end]``."""
    mass = special.ndtr((end - expected) / sigma) - special.ndtr(-expected / sigma)
    return -0.5 * ((z - expected) / sigma) ** 2 - (_HALF_LOG_2PI + math.log(sigma)) - np.log(mass)


def log_short_ranges(z: np.ndarray, expected: np.ndarray, rate: float) -> np.ndarray:
    """Log density of an exponential truncated to ``[0, expected]``."""
    return math.log(rate) - rate * z - np.log(-np.expm1(-rate * expected))


def _log(share: float) -> float:
    return math.log(share) if share > 0 else -math.inf


def as_model(call: str, model: Any) -> BeamModel:
    """``model``, or a TypeError that names the call."""
    if not isinstance(model, BeamModel):
        raise TypeError(
            f"{call}: give a BeamModel, such as BeamModel(max_range=8.0); got {model!r:.80}"
        )
    return model


def _require(ok: Any, model: BeamModel, name: str, requirement: str) -> None:
    if not ok:
        raise ParameterError(
            f"BeamModel: {name} must be {requirement}; got {getattr(model, name)!r}"
        )
