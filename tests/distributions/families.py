"""Univariate families beside SciPy's, with Hypothesis strategies of wide parameters."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from scipy import special, stats

import bayesmc.distributions as d
from bayesmc.testing import session

FEW = settings(max_examples=session.scaled(30, 5))


def magnitudes(low: float, high: float) -> st.SearchStrategy[float]:
    """Positive numbers spread evenly over orders of magnitude, with some round ones."""
    logs = st.floats(np.log10(low), np.log10(high)).map(lambda e: 10.0**e)
    round_ones = [v for v in (0.5, 1.0, 2.0, 10.0) if low <= v <= high]
    return logs | st.sampled_from(round_ones)


def signed(high: float) -> st.SearchStrategy[float]:
    return st.builds(lambda s, m: s * m, st.sampled_from([-1.0, 0.0, 1.0]), magnitudes(1e-6, high))


#: whose complement is exact, for families that SciPy gives the complement
DYADIC = st.integers(1, 255).map(lambda k: k / 256)
PROBABILITY = st.floats(0, 1) | magnitudes(1e-12, 1.0) | magnitudes(1e-12, 1.0).map(lambda v: 1 - v)


@dataclass(frozen=True)
class Family:
    """A family, SciPy's of the same parameters, and a strategy for each parameter."""

    make: Callable[..., d.Distribution]
    scipy: Callable[..., Any]
    parameters: tuple[st.SearchStrategy, ...]
    moderate: tuple[tuple[float, ...], ...]


def _discrete_uniform(low: Any, width: Any) -> d.Distribution:
    return d.DiscreteUniform(low, np.asarray(low) + np.asarray(width))


def _uniform(low: Any, width: Any) -> d.Distribution:
    return d.Uniform(low, np.asarray(low) + np.asarray(width))


FAMILIES = {
    "Normal": Family(
        d.Normal, stats.norm, (signed(1e6), magnitudes(1e-6, 1e6)), ((0.0, 1.0), (-3.0, 0.1))
    ),
    "StudentT": Family(
        d.StudentT,
        stats.t,
        (magnitudes(0.05, 1e6), signed(1e4), magnitudes(1e-4, 1e4)),
        ((5.0, 0.0, 1.0), (30.0, 2.0, 3.0)),
    ),
    "Uniform": Family(
        _uniform,
        lambda low, width: stats.uniform(low, (low + width) - low),
        (signed(1e3), magnitudes(1e-3, 1e3)),
        ((0.0, 1.0), (-5.0, 3.0)),
    ),
    "Beta": Family(
        d.Beta,
        stats.beta,
        (magnitudes(0.05, 1e4), magnitudes(0.05, 1e4)),
        ((2.0, 3.0), (0.5, 0.5), (1.0, 8.0)),
    ),
    "Gamma": Family(
        d.Gamma,
        lambda a, rate: stats.gamma(a, scale=1 / rate),
        (magnitudes(0.02, 1e5), magnitudes(1e-5, 1e5)),
        ((2.0, 3.0), (0.5, 1.0), (20.0, 0.1)),
    ),
    "Exponential": Family(
        d.Exponential,
        lambda rate: stats.expon(scale=1 / rate),
        (magnitudes(1e-8, 1e8),),
        ((1.0,), (20.0,)),
    ),
    "Laplace": Family(
        d.Laplace, stats.laplace, (signed(1e6), magnitudes(1e-6, 1e6)), ((0.0, 1.0), (-3.0, 0.1))
    ),
    # no moderate parameters for the Cauchy families: their draws have no mean to test
    "Cauchy": Family(d.Cauchy, stats.cauchy, (signed(1e4), magnitudes(1e-4, 1e4)), ()),
    "HalfNormal": Family(
        d.HalfNormal,
        lambda scale: stats.halfnorm(scale=scale),
        (magnitudes(1e-6, 1e6),),
        ((1.0,), (20.0,)),
    ),
    "HalfCauchy": Family(
        d.HalfCauchy, lambda scale: stats.halfcauchy(scale=scale), (magnitudes(1e-6, 1e6),), ()
    ),
    "LogNormal": Family(
        d.LogNormal,
        lambda loc, scale: stats.lognorm(scale, scale=np.exp(loc)),
        (signed(20.0), magnitudes(0.01, 5.0)),
        ((0.0, 0.25), (3.0, 0.5)),
    ),
    "InverseGamma": Family(
        d.InverseGamma,
        lambda a, scale: stats.invgamma(a, scale=scale),
        (magnitudes(0.02, 1e5), magnitudes(1e-5, 1e5)),
        ((20.0, 3.0), (50.0, 0.1)),
    ),
    "Weibull": Family(
        d.Weibull,
        lambda c, scale: stats.weibull_min(c, scale=scale),
        (magnitudes(0.05, 1e3), magnitudes(1e-5, 1e5)),
        ((2.0, 3.0), (1.0, 0.1), (8.0, 1.0)),
    ),
    "Bernoulli": Family(d.Bernoulli, stats.bernoulli, (PROBABILITY,), ((0.3,), (0.95,))),
    "Bernoulli logits": Family(
        lambda logits: d.Bernoulli(logits=logits),
        lambda logits: stats.bernoulli(special.expit(logits)),
        (st.floats(-9, 9),),  # further out SciPy loses digits in 1 - p
        ((0.3,), (-2.0,)),
    ),
    "Binomial": Family(
        d.Binomial,
        stats.binom,
        (st.integers(0, 100_000), PROBABILITY),
        ((12, 0.3), (1000, 0.01)),
    ),
    "Binomial logits": Family(
        lambda n, logits: d.Binomial(n, logits=logits),
        lambda n, logits: stats.binom(n, special.expit(logits)),
        (st.integers(0, 1000), st.floats(-5, 5)),
        ((12, 0.3),),
    ),
    "Poisson": Family(d.Poisson, stats.poisson, (magnitudes(1e-6, 1e5),), ((3.5,), (200.0,))),
    "Geometric": Family(
        d.Geometric,
        lambda p: stats.geom(p, loc=-1),
        # nearer one SciPy's mean, 1 / p - 1, loses digits
        (magnitudes(1e-9, 0.9) | magnitudes(1e-4, 0.9).map(lambda v: 1 - v),),
        ((0.3,), (0.9,)),
    ),
    "Geometric logits": Family(
        lambda logits: d.Geometric(logits=logits),
        lambda logits: stats.geom(special.expit(logits), loc=-1),
        (st.floats(-9, 5),),  # further out SciPy loses digits in 1 - p
        ((-1.0,),),
    ),
    "NegativeBinomial": Family(
        d.NegativeBinomial,
        lambda n, p: stats.nbinom(n, 1 - np.asarray(p)),
        (magnitudes(0.05, 50.0), DYADIC),
        ((5.5, 0.4), (40.0, 0.9)),
    ),
    "NegativeBinomial logits": Family(
        lambda n, logits: d.NegativeBinomial(n, logits=logits),
        lambda n, logits: stats.nbinom(n, special.expit(-np.asarray(logits))),
        (magnitudes(0.5, 50.0), st.floats(-3, 5)),
        ((3.0, 0.5),),
    ),
    "DiscreteUniform": Family(
        _discrete_uniform,
        lambda low, width: stats.randint(low, np.asarray(low) + np.asarray(width) + 1),
        (st.integers(-1000, 1000), st.integers(0, 10_000)),
        ((-2, 7), (5, 0)),
    ),
}


@st.composite
def parameters_of(draw: st.DrawFn, name: str) -> list[np.ndarray]:
    """Parameters of a family, of shapes that broadcast: scalars, a row, a column."""
    shapes = st.sampled_from([(), (3,), (2, 1), (2, 3), (1, 3)])
    result = []
    for strategy in FAMILIES[name].parameters:
        shape = draw(shapes)
        size = int(np.prod(shape))
        result.append(
            np.array(draw(st.lists(strategy, min_size=size, max_size=size))).reshape(shape)
        )
    return result


def points_of(frozen: Any, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Values from deep in the tails to the centre, by SciPy's quantiles, and some far outside."""
    q = rng.choice([1e-12, 1e-4, 0.05, 0.3, 0.5, 0.8, 0.999, 1 - 1e-9], size=shape)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # SciPy's beta quantile gives up on some tails, aloud
        x = frozen.ppf(q)
    return np.where(np.isfinite(x), x, 0.5)


def assert_close(ours: np.ndarray, theirs: np.ndarray, relative: float = 1e-10) -> None:
    """Equal to ``relative``; where terms have cancelled to below 1e-8, to an absolute 1e-15."""
    ours, theirs = np.broadcast_arrays(ours, theirs)
    same = ours == theirs  # infinities included
    with np.errstate(invalid="ignore"):
        error = np.abs(ours - theirs)
        good = same | (error <= relative * np.abs(theirs))
        good |= (np.abs(theirs) <= 1e-8) & (error <= 1e-15)
    assert good.all(), (ours[~good][:3], theirs[~good][:3])
