"""Likelihood weighting on the hybrid turbine net by hand-tuned NumPy, one thread.

Chunks of 8,192 draws; every continuous node is a row of one buffer, written in place; discrete
nodes are uint8 codes; the constants of the log-likelihoods are left out of the loop; sums of ``w``,
``w x`` and ``w x**2`` come from matrix-vector products. The generator is SFC64. It answers for this
one model (``benchmarks.models.declare``) and keeps no draws.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from benchmarks import models as m

CHUNK = 8192
_AGE, _WEAR, _AMBIENT, _WIND, _LOAD, _SEVERITY, _FRICTION, _NOISE, _LIFE, _COST = range(10)
_SITE, _SEASON, _MAINTAINED, _FAULT, _MODE = 0, 2, 5, 6, 7  # first row of each in the booleans
_BOOLEANS = 9


@dataclass(frozen=True)
class Answer:
    """Posterior mean and sd by continuous node, probabilities by discrete node."""

    mean: dict[str, float]
    std: dict[str, float]
    probabilities: dict[str, np.ndarray]
    log_evidence: float
    ess: float


def likelihood_weighting(draws: int, seed: int) -> Answer:
    """The posterior of the turbine given ``models.EVIDENCE``.

    ``draws`` forward samples, weighted by the likelihood of the five readings; ``seed`` is that of
    the SFC64 generator.
    """
    rng = np.random.Generator(np.random.SFC64(seed))
    values, passed = np.empty((10, CHUNK)), np.empty((_BOOLEANS, CHUNK), bool)
    scratch, log_weights = np.empty((3, CHUNK)), np.empty(CHUNK)
    shift, sums, total = -np.inf, np.zeros(20 + _BOOLEANS), np.zeros(2)
    for start in range(0, draws, CHUNK):
        size = min(CHUNK, draws - start)
        x, b, s, logw = values[:, :size], passed[:, :size], scratch[:, :size], log_weights[:size]
        _sample(rng, x, b, s)
        _weigh(x, s, logw)
        top = logw.max()
        if top > shift:
            scale = np.exp(shift - top)
            shift, sums, total = top, sums * scale, total * [scale, scale**2]
        weights = np.exp(np.subtract(logw, shift, out=logw), out=logw)
        total += weights.sum(), weights @ weights
        sums[:10] += x @ weights
        sums[10:20] += np.multiply(x, x, out=x) @ weights
        sums[20:] += b.astype(float) @ weights
    return _answer(sums / total[0], shift + _CONSTANT + np.log(total[0] / draws), total)


def _sample(rng: np.random.Generator, x: np.ndarray, b: np.ndarray, s: np.ndarray) -> None:
    """Fill the hidden nodes, in place: ``x`` the continuous rows, ``b`` the comparisons."""
    size = x.shape[1]
    uniforms = rng.random((4, size), dtype=np.float32)
    codes = b.view(np.uint8)
    for row, bound in enumerate(_SITE_BOUNDS, _SITE):
        np.greater_equal(uniforms[0], bound, out=b[row])
    for row, bound in enumerate(_SEASON_BOUNDS, _SEASON):
        np.greater_equal(uniforms[1], bound, out=b[row])
    np.less(uniforms[2], np.float32(0.85), out=b[_MAINTAINED])
    site = (codes[0] + codes[1]).astype(np.intp)
    where = (codes[2] + codes[3] + codes[4]) * np.uint8(3) + codes[0] + codes[1]

    ambient = rng.standard_normal(out=x[_AMBIENT])
    ambient *= m.AMBIENT_SD.take(site, out=s[0], mode="clip")
    ambient += m.AMBIENT.ravel().take(where, out=s[0], mode="clip")

    wind = rng.standard_gamma(m.WIND_SHAPE.take(site, out=s[0], mode="clip"), out=x[_WIND])
    wind /= m.WIND_RATE.take(site, out=s[0], mode="clip")
    load = np.minimum(np.multiply(wind, 1.0 / 12.0, out=s[0]), 1.0, out=s[0])
    np.multiply(np.multiply(load, load, out=s[1]), load, out=x[_LOAD])

    age = rng.standard_gamma(2.5, out=x[_AGE])
    age /= 0.35
    wear = np.exp(np.multiply(age, -1.0 / 15.0, out=x[_WEAR]), out=x[_WEAR])
    np.subtract(1.0, wear, out=wear)

    maintained = codes[_MAINTAINED].astype(np.intp)
    chance = np.multiply(m.FAULT_SLOPE.take(maintained, out=s[0], mode="clip"), wear, out=s[0])
    chance += m.FAULT_FLOOR.take(maintained, out=s[1], mode="clip")
    np.less(rng.random(out=s[1]), chance, out=b[_FAULT])
    fault = codes[_FAULT].astype(np.intp)
    severity = x[_SEVERITY]
    severity[:] = rng.beta(m.SEVERITY_A.take(fault), m.SEVERITY_B.take(fault))

    friction = rng.standard_normal(out=x[_FRICTION])
    friction *= 0.08
    friction += np.multiply(severity, 0.9, out=s[0])
    friction += np.multiply(wear, 0.3, out=s[0])
    friction += 0.2

    which = fault * 2 + maintained
    np.greater_equal(uniforms[3], _MODE_BOUNDS[0].take(which), out=b[_MODE])
    np.greater_equal(uniforms[3], _MODE_BOUNDS[1].take(which), out=b[_MODE + 1])
    mode = (codes[_MODE] + codes[_MODE + 1]).astype(np.intp)
    noise = rng.standard_normal(out=x[_NOISE])
    noise *= 1.5
    noise += m.NOISE.take(mode, out=s[0], mode="clip")
    noise += np.multiply(x[_LOAD], 6.0, out=s[0])

    rate = np.multiply(severity, severity, out=s[0])
    rate *= 2.0
    rate += 0.1
    np.divide(rng.standard_exponential(out=x[_LIFE]), rate, out=x[_LIFE])

    scale = np.multiply(severity, 5.0, out=s[0])
    scale += 1.0
    cost = rng.standard_gamma(m.COST_SHAPE.take(mode, out=s[1], mode="clip"), out=x[_COST])
    cost *= scale


def _weigh(x: np.ndarray, s: np.ndarray, logw: np.ndarray) -> None:
    """Log-likelihood of the five readings, without its constants, into ``logw``."""
    load, severity, friction = x[_LOAD], x[_SEVERITY], x[_FRICTION]
    e = m.EVIDENCE
    # power: residual 2000 load (1 - 0.3 severity) - power, over its sd of 150
    z = np.multiply(severity, -600.0 / 150.0, out=s[0])
    z += 2000.0 / 150.0
    z *= load
    z -= e["power"] / 150.0
    np.multiply(z, z, out=logw)
    # oil
    z = np.multiply(load, 25.0 / 4.0, out=s[0])
    z += np.multiply(friction, 35.0 / 4.0, out=s[1])
    z += np.multiply(x[_AMBIENT], 0.25, out=s[1])
    z -= e["oil"] / 4.0
    logw += np.multiply(z, z, out=z)
    logw *= -0.5
    # vibration
    z = np.multiply(severity, 4.0 / 0.5, out=s[0])
    z += 1.5 / 0.5
    z *= load
    z -= (e["vibration"] - 0.8) / 0.5
    np.multiply(z, z, out=z)
    z *= 0.2
    z += 1.0
    np.log(z, out=z)  # np.log1p costs twice as much, and z is at least 1
    z *= 3.0
    logw -= z
    # debris: k eta - exp(eta)
    eta = np.multiply(severity, 3.0, out=s[0])
    eta += x[_WEAR]
    eta += 0.5
    logw -= np.exp(eta, out=s[1])
    eta *= e["debris"]
    logw += eta
    # warning = 1: -log(1 + exp(3 - 4 friction - load))
    eta = np.multiply(friction, -4.0, out=s[0])
    eta -= load
    eta += 3.0
    np.exp(eta, out=eta)
    eta += 1.0
    logw -= np.log(eta, out=eta)


def _answer(sums: np.ndarray, log_evidence: float, total: np.ndarray) -> Answer:
    mean, square, tails = sums[:10], sums[10:20], sums[20:]
    std = np.sqrt(square - mean**2)
    rows = {
        "site": tails[_SITE:_SEASON],
        "season": tails[_SEASON:_MAINTAINED],
        "maintained": tails[_MAINTAINED:_FAULT],
        "fault": tails[_FAULT:_MODE],
        "mode": tails[_MODE:],
    }
    return Answer(
        dict(zip(m.HIDDEN_CONTINUOUS, mean.tolist(), strict=True)),
        dict(zip(m.HIDDEN_CONTINUOUS, std.tolist(), strict=True)),
        {name: -np.diff(own, prepend=1.0, append=0.0) for name, own in rows.items()},
        float(log_evidence),
        float(total[0] ** 2 / total[1]),
    )


_SITE_BOUNDS = np.cumsum(m.SITE)[:-1].astype(np.float32)
_SEASON_BOUNDS = np.cumsum(m.SEASON)[:-1].astype(np.float32)
_MODE_BOUNDS = np.ascontiguousarray(np.cumsum(m.MODE.reshape(4, 3), axis=1)[:, :-1].T, np.float32)
_CONSTANT = float(
    -np.log(2.0 * np.pi)
    - np.log(150.0)
    - np.log(4.0)
    + gammaln(3.0)
    - gammaln(2.5)
    - 0.5 * np.log(5.0 * np.pi)
    - np.log(0.5)
    - gammaln(m.EVIDENCE["debris"] + 1.0)
)
