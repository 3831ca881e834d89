"""Coefficients of features rebuild the log density, for every conjugate pair and some more."""

from __future__ import annotations

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import TraceError
from bayesmc.expression import Program, TracedArray, leaf, trace
from bayesmc.passes.features import LOG, LOG1M, statistics
from bayesmc.passes.log_density import log_density
from bayesmc.plates import PlateArray

T = np.array([0.5, 1.0, 2.0, -1.0])

#: a child of x (a number between 0 and 1, or any number), its values, and the features that it has in x
PAIRS = {
    "a mean": (lambda x, s: bmc.Normal(x, s), "real", {1.0, 2.0}),
    "an affine mean": (lambda x, s: bmc.Normal(2 * x * T - 1, s), "real", {1.0, 2.0}),
    "a precision": (lambda x, s: bmc.Normal(T, 1 / np.sqrt(x)), "real", {1.0, LOG}),
    "a scaled precision": (lambda x, s: bmc.Normal(T, s * x**-0.5), "real", {1.0, LOG}),
    "a variance": (lambda x, s: bmc.Normal(T, np.sqrt(x)), "real", {-1.0, LOG}),
    "a standard deviation": (lambda x, s: bmc.Normal(T, x), "real", {-2.0, LOG}),
    "a rate of counts": (lambda x, s: bmc.Poisson(s * x), "count", {1.0, LOG}),
    "a rate": (lambda x, s: bmc.Gamma(s, 3 * x), "positive", {1.0, LOG}),
    "an exponential's rate": (lambda x, s: bmc.Exponential(x * s), "positive", {1.0, LOG}),
    "an inverse gamma's scale": (lambda x, s: bmc.InverseGamma(s, x), "positive", {1.0, LOG}),
    "a Weibull's scale": (lambda x, s: bmc.Weibull(1.5, x), "positive", {-1.5, LOG}),
    "a probability": (lambda x, s: bmc.Bernoulli(x), "bit", {LOG, LOG1M}),
    "a probability of counts": (lambda x, s: bmc.Binomial(5, x), "count", {LOG, LOG1M}),
    "a geometric's": (lambda x, s: bmc.Geometric(x), "count", {LOG, LOG1M}),
    "a negative binomial's": (lambda x, s: bmc.NegativeBinomial(3.0, 1 - x), "count", {LOG, LOG1M}),
    "a picked mean": (lambda x, s: bmc.Normal(np.where(s > 1, x, 0.3), s), "real", {1.0, 2.0}),
}
VALUES = {
    "real": np.array([0.3, -1.0, 2.0, 0.0]),
    "count": np.array([0, 1, 4, 2]),
    "positive": np.array([0.3, 1.0, 2.0, 0.1]),
    "bit": np.array([0, 1, 1, 0]),
}


def total(coefficients, logs, x):
    found = 0.0
    for feature, c in zip(coefficients, logs, strict=True):
        value = (
            {LOG: np.log(x), LOG1M: np.log1p(-x)}.get(feature)
            if isinstance(feature, str)
            else x**feature
        )
        found = found + c * value
    return found


@pytest.mark.parametrize("name", PAIRS)
def test_features_rebuild_the_density(name):
    function, kind, features = PAIRS[name]
    y = VALUES[kind]
    x, s = TracedArray(leaf("x", (1,))), TracedArray(leaf("s", (4,)))
    density = log_density(trace(function, [x, s]), leaf("y", (4,), y.dtype))
    found = statistics(density, "x")
    assert set(found.coefficients) == features
    program = Program(list(found.coefficients.values()))
    scales = np.array([0.5, 1.5, 2.0, 0.7])
    logs = program({"y": y, "s": scales})
    offs = []
    for value in (0.2, 0.5, 0.9):
        expected = function(np.array([value]), scales).log_prob(y)
        offs.append(expected - total(found.coefficients, logs, value))
    np.testing.assert_allclose(offs[1], offs[0], rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(offs[2], offs[0], rtol=1e-10, atol=1e-10)
    np.testing.assert_array_equal(Program([found.at])({})[0], 0)


def test_elements_of_a_plate_are_read_by_label():
    mean = PlateArray(TracedArray(leaf("mean", (1, 3))), ("cluster",), own=1)
    label = TracedArray(leaf("label", (4,), int, states=3))
    family = trace(lambda mean, label: bmc.Normal((2 * mean)[label] + 1, 0.5), [mean, label])
    found = statistics(log_density(family, leaf("y", (4,))), "mean")
    drawn = np.array([2, 0, 0, 1])
    at, linear, square = Program([found.at, found.coefficients[1.0], found.coefficients[2.0]])(
        {"label": drawn, "y": np.arange(4.0)}
    )
    assert at.tolist() == drawn.tolist()
    np.testing.assert_allclose(linear, 2 * (np.arange(4.0) - 1) / 0.25)
    np.testing.assert_allclose(np.broadcast_to(square, 4), -0.5 * 4 / 0.25)


BENT = {
    "an exponential": lambda x, s: bmc.Normal(np.exp(x), s),
    "two elements": lambda x, s: bmc.Normal(x[..., 0] + x[..., 1], 1.0),
    "a branch on it": lambda x, s: bmc.Normal(np.where(x > 0, x, 2 * x), s),
    "logits": lambda x, s: bmc.Bernoulli(logits=x),
    "a sum of powers": lambda x, s: bmc.Normal(0.0, np.sqrt(x + s)),
    "a location of heavy tails": lambda x, s: bmc.StudentT(3.0, x, s),
}


@pytest.mark.parametrize("name", BENT)
def test_what_has_no_features_is_refused(name):
    shape = (2,) if name == "two elements" else (1,)
    x, s = TracedArray(leaf("x", shape)), TracedArray(leaf("s", (1,)))
    density = log_density(trace(BENT[name], [x, s]), leaf("y", ()))
    with pytest.raises(TraceError):
        statistics(density, "x")


def test_what_is_nested_without_end_is_refused():
    """A recursion over time nests a level or more in every slice: refused, and no stack runs out."""

    def density(steps):
        def child(x, s):
            mean = 0.0 * x
            for y in np.linspace(-1.0, 1.0, steps):
                mean = 0.2 + s * (y - mean)
            return bmc.Normal(mean * x, 1.0)

        family = trace(child, [TracedArray(leaf(n, ())) for n in "xs"])
        return log_density(family, leaf("y", ()))

    assert set(statistics(density(5), "x").coefficients) == {1.0, 2.0}
    with pytest.raises(TraceError, match="nested too deep"):
        statistics(density(400), "s")


def test_a_recursion_of_products_is_no_polynomial_of_a_thousand_powers():
    """Each step of a logistic map doubles the degree: what is followed has few powers, and the rest none."""

    def mapped(x, steps):
        for _ in range(steps):
            x = 3.0 * x * (1 - x)
        return x

    few = trace(lambda x: mapped(x, 2), [TracedArray(leaf("x", ()))])
    assert sorted(statistics(few, "x").coefficients) == [1.0, 2.0, 3.0, 4.0]
    many = trace(lambda x: mapped(x, 60), [TracedArray(leaf("x", ()))])
    with pytest.raises(TraceError, match="more than 16 powers"):
        statistics(many, "x")
