"""Means of families as expressions: their values, their derivatives, and what has no formula."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import TraceError
from bayesmc.expression import Program, TracedArray, as_expression, leaf, trace
from bayesmc.passes.derivatives import tangent
from bayesmc.passes.mean import FORMULAS, mean

FAMILIES: dict[type, Callable[[Any], Any]] = {
    bmc.Normal: lambda x: bmc.Normal(x**2, 1 + x),
    bmc.MvNormal: lambda x: bmc.MvNormal(np.stack([x, x**2], axis=-1), np.eye(2)),
    bmc.Laplace: lambda x: bmc.Laplace(np.sin(x), 1.0),
    bmc.StudentT: lambda x: bmc.StudentT(5.0, np.exp(x), x),
    bmc.VonMises: lambda x: bmc.VonMises(2.0 * x, 3.0),
    bmc.WrappedNormal: lambda x: bmc.WrappedNormal(2.0 * x, 3.0),
    bmc.Affine: lambda x: bmc.Affine(bmc.Gamma(2 + x, 1 + x), x**2, -x),
    bmc.HalfNormal: lambda x: bmc.HalfNormal(x),
    bmc.Weibull: lambda x: bmc.Weibull(1.0 + x, 2.0 * x),
    bmc.LogNormal: lambda x: bmc.LogNormal(x, 0.5 * x),
    bmc.Uniform: lambda x: bmc.Uniform(-(x**2), 1 + x),
    bmc.Beta: lambda x: bmc.Beta(x, 2.0 + x**2),
    bmc.Gamma: lambda x: bmc.Gamma(x, 1.0 + x**2),
    bmc.InverseGamma: lambda x: bmc.InverseGamma(3.0 + x, x**2),
    bmc.Exponential: lambda x: bmc.Exponential(x),
    bmc.Poisson: lambda x: bmc.Poisson(np.exp(x)),
    bmc.Binomial: lambda x: bmc.Binomial(7, 1 / (1 + x)),
    bmc.BetaBinomial: lambda x: bmc.BetaBinomial(7, x, 2.0 + x**2),
    bmc.Geometric: lambda x: bmc.Geometric(1 / (1 + x)),
    bmc.NegativeBinomial: lambda x: bmc.NegativeBinomial(2.0 + x, logits=-x),
}


def value_and_slope(function: Callable[[Any], Any], x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mean of what a function returns and its derivative, element by element."""
    root = mean(trace(function, [TracedArray(leaf("x", ()))]))
    value, slope = Program([root, tangent(root, {"x": as_expression(1.0)})])({"x": x})
    return value, slope


@pytest.mark.parametrize("family", FAMILIES, ids=lambda f: f.__name__)
def test_means_of_families(family: type) -> None:
    assert set(FAMILIES) == set(FORMULAS)
    function, x, step = FAMILIES[family], np.array([0.4, 0.9, 1.3]), 1e-5
    value, slope = value_and_slope(function, x)
    wanted = (function(x + step).mean - function(x - step).mean) / (2 * step)
    np.testing.assert_allclose(slope, wanted, rtol=1e-8, atol=1e-9)
    turns = (value - function(x).mean) / (2 * np.pi)
    np.testing.assert_allclose(turns - np.round(turns), 0.0, atol=1e-12)


def test_other_logits_and_families_without_a_formula() -> None:
    x, step = np.array([0.3]), 1e-5
    for other in (lambda x: bmc.Geometric(logits=x), lambda x: bmc.Binomial(3, logits=x)):
        wanted = (other(x + step).mean - other(x - step).mean) / (2 * step)
        np.testing.assert_allclose(value_and_slope(other, x)[1], wanted, rtol=1e-8)
    with pytest.raises(TraceError, match="Truncated"):
        value_and_slope(lambda x: bmc.Truncated(bmc.Normal(x, 1.0), 0.0), x)
