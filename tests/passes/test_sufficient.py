"""Statistics and natural parameters found in densities: against the families' own log densities."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import TraceError
from bayesmc.expression import (
    Expression,
    Family,
    TracedArray,
    evaluate,
    expressions_of,
    leaf,
    rebuilt,
    trace,
)
from bayesmc.passes.sufficient import VALUE, NaturalForm, log_probabilities, natural_form, tabulated

K, N = 4, 30
RNG = np.random.default_rng(11)
POSITIVE = RNG.gamma(2.0, size=N) + 0.01
COUNTS = RNG.integers(12, size=N)
#: the function of a number, a positive number and a share; its data
FAMILIES: dict[str, tuple[Callable[..., Any], np.ndarray, int]] = {
    "normal": (lambda r, p, u: bmc.Normal(r, p), RNG.normal(size=N), 3),
    "normal, known sd": (lambda r, p, u: bmc.Normal(r, 2.0), RNG.normal(size=N), 2),
    "normal, known mean": (lambda r, p, u: bmc.Normal(1.0, p), RNG.normal(size=N), 3),
    "lognormal": (lambda r, p, u: bmc.LogNormal(r, p), POSITIVE, 3),
    "half normal": (lambda r, p, u: bmc.HalfNormal(p), POSITIVE, 3),
    "laplace about zero": (lambda r, p, u: bmc.Laplace(0.0, p), RNG.normal(size=N), 2),
    "truncated": (
        lambda r, p, u: bmc.Truncated(bmc.Normal(r, 1.0), 0.0, 3.0), 3 * RNG.random(N), 2
    ),
    "poisson": (lambda r, p, u: bmc.Poisson(p), COUNTS, 2),
    "exponential": (lambda r, p, u: bmc.Exponential(p), POSITIVE, 2),
    "gamma": (lambda r, p, u: bmc.Gamma(p, 2 * p + u), POSITIVE, 3),
    "inverse gamma": (lambda r, p, u: bmc.InverseGamma(p, u), POSITIVE, 3),
    "beta": (lambda r, p, u: bmc.Beta(p, 1 + u), RNG.random(N), 3),
    "bernoulli": (lambda r, p, u: bmc.Bernoulli(u), COUNTS % 2, 3),
    "bernoulli by logits": (lambda r, p, u: bmc.Bernoulli(logits=r), COUNTS % 2, 3),
    "binomial": (lambda r, p, u: bmc.Binomial(12, u), COUNTS, 4),
    "geometric": (lambda r, p, u: bmc.Geometric(u), COUNTS, 2),
    "negative binomial": (lambda r, p, u: bmc.NegativeBinomial(3.0, u), COUNTS, 2),
}  # fmt: skip
LEAVES = {"r": leaf("r", (K,)), "p": leaf("p", (K,)), "u": leaf("u", (K,))}


def _family(function: Callable[..., Any]) -> Family:
    return trace(function, [TracedArray(v) for v in LEAVES.values()])


def _values(rng: np.random.Generator) -> dict[str, np.ndarray]:
    return {"r": rng.normal(size=K), "p": rng.gamma(3.0, size=K) + 0.1, "u": rng.random(K)}


def _of(form: NaturalForm, values: dict[str, np.ndarray], y: np.ndarray) -> np.ndarray:
    """Log densities ``(K, N)`` up to what depends on the value alone."""
    batch = y.shape[:1]
    t = [np.broadcast_to(a, batch) for a in evaluate(form.statistics, {VALUE: y})]
    c = [np.broadcast_to(a, (K,)) for a in evaluate(form.coefficients, values)]
    return sum(a[:, None] * b for a, b in zip(c, t, strict=True))


def _log_prob(family: Family, values: dict[str, np.ndarray], y: np.ndarray) -> np.ndarray:
    parts: list[Expression] = list(expressions_of(family))
    dist = rebuilt(family, iter(evaluate(parts, values)))
    return np.broadcast_to(dist.log_prob(y[:, None]), (len(y), K)).T


def _odds(log: np.ndarray) -> np.ndarray:
    return log - log[:1]


@pytest.mark.parametrize("name", FAMILIES)
def test_coefficients_times_statistics_are_the_log_density(name: str) -> None:
    """On random parameters, to 1e-12, up to what no parameter changes; as few statistics as there are."""
    function, y, count = FAMILIES[name]
    family = _family(function)
    centre = 0.0 if y.dtype.kind == "i" else y.mean()
    logs = np.log(y).mean() if (y > 0).all() else 0.0
    form = natural_form(family, centre, logs)
    assert len(form.statistics) == count
    for seed in range(5):
        values = _values(np.random.default_rng(seed))
        expected = _odds(_log_prob(family, values, y))
        size = np.abs(_log_prob(family, values, y)).max()
        found = _odds(_of(form, values, y - centre))
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12 * size)


@pytest.mark.parametrize("d", [1, 2, 3])
@pytest.mark.parametrize("given", ["cov", "scale_tril", "scale_diag"])
def test_normal_vectors(d: int, given: str) -> None:
    shape = (K, d) if given == "scale_diag" else (K, d, d)
    family = trace(
        lambda loc, spread: bmc.MvNormal(loc, **{given: spread}),
        [TracedArray(leaf("loc", (K, d))), TracedArray(leaf("spread", shape))],
    )
    rng = np.random.default_rng(d)
    root = np.tril(rng.normal(size=(K, d, d))) + 2 * np.eye(d)
    spread = {
        "cov": root @ root.swapaxes(-1, -2), "scale_tril": root,
        "scale_diag": rng.gamma(2.0, size=(K, d)),
    }[given]  # fmt: skip
    if given == "scale_tril":
        spread = np.linalg.cholesky(root @ root.swapaxes(-1, -2))
    values = {"loc": rng.normal(size=(K, d)) + 5, "spread": spread}
    y = rng.normal(size=(N, d)) + 5
    found = _of(natural_form(family, np.full(d, 5.0)), values, y - 5.0)
    dist = bmc.MvNormal(values["loc"], **{given: spread})
    expected = dist.log_prob(y[:, None]).T
    np.testing.assert_allclose(_odds(found), _odds(expected), rtol=1e-11, atol=1e-11)


def test_values_far_from_zero_lose_no_digits() -> None:
    """Data of size 1e8 with components of size 1: about a centre, as exact as those near zero."""
    family = _family(lambda r, p, u: bmc.Normal(r + 1e8, p))
    near = _family(lambda r, p, u: bmc.Normal(r, p))
    values, y = _values(np.random.default_rng(0)), np.round(RNG.normal(size=N) * 8) / 8
    far = _odds(_of(natural_form(family, 1e8), values, y))
    np.testing.assert_allclose(far, _odds(_log_prob(near, values, y)), rtol=1e-7, atol=1e-7)
    lost = _odds(_of(natural_form(family), values, y + 1e8))  # what it is that the centre saves
    assert np.abs(lost - far).max() > 1e-2


@pytest.mark.parametrize("name", ["bernoulli", "poisson", "binomial", "geometric"])
def test_few_values_are_counted(name: str) -> None:
    function, y, _ = FAMILIES[name]
    family, values = _family(function), _values(np.random.default_rng(1))
    form = tabulated(family, np.unique(y))
    assert form.indicators
    expected = _log_prob(family, values, y)
    np.testing.assert_allclose(_of(form, values, y), expected, rtol=1e-12)


def test_categories_whose_probabilities_do_not_sum_to_one_are_no_numbers() -> None:
    family = trace(lambda p: bmc.Categorical(p), [TracedArray(leaf("p", (2, 3)))])
    logs = log_probabilities(family, np.arange(3))
    p = np.array([[0.2, 0.3, 0.5], [0.2, 0.3, 0.6]])
    (found,) = evaluate([logs], {"p": p})
    np.testing.assert_allclose(found[:, 0], np.log(p[0]))
    assert np.isnan(found[:, 1]).all()


def test_a_concentration_below_zero_is_no_number() -> None:
    """The logarithm of the gamma function is finite there: it must not pass for a density."""
    form = natural_form(_family(lambda r, p, u: bmc.Gamma(r, 1.0)))
    values = {**_values(np.random.default_rng(0)), "r": np.array([1.0, -0.5, 2.0, -1.5])}
    first = evaluate(form.coefficients, values)[0]
    np.testing.assert_array_equal(np.isnan(first), values["r"] < 0)


@pytest.mark.parametrize(
    "function",
    [
        lambda r, p, u: bmc.StudentT(4.0, r, 1.0),
        lambda r, p, u: bmc.Cauchy(r, p),
        lambda r, p, u: bmc.Laplace(r, 1.0),
        lambda r, p, u: bmc.Weibull(p, 1.0),
        lambda r, p, u: bmc.VonMises(r, p),
        lambda r, p, u: bmc.NegativeBinomial(p, 0.5),
        lambda r, p, u: bmc.Uniform(0.0, p),
    ],
)
def test_what_is_of_no_exponential_family_is_refused(function: Callable[..., Any]) -> None:
    with pytest.raises(TraceError):
        natural_form(_family(function))
