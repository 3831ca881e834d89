"""Closed log densities are those of the families, and so are their derivatives."""

from __future__ import annotations

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import TraceError
from bayesmc.expression import Family, Program, TracedArray, constant, leaf, reduction, trace
from bayesmc.passes.derivatives import gradient
from bayesmc.passes.log_density import log_density
from bayesmc.robotics import AndAngle

A = np.array([0.7, 1.3, 2.1])
P = np.array([0.2, 0.5, 0.9])
ROWS = np.array([[0.2, 0.3, 0.5], [0.1, 0.1, 0.8], [0.6, 0.2, 0.2]])
COV = np.array([[2.0, 0.5], [0.5, 1.0]])


def _lower(a, p):
    return np.stack([bmc.stack([a, 0 * a]), bmc.stack([p, a])], axis=-2)


#: a function of (a, p) in plates of three, and values inside, on the edge and outside of the support
FAMILIES = {
    "Normal": (lambda a, p: bmc.Normal(a, p), [-1.0, 0.3, 8.0]),
    "StudentT": (lambda a, p: bmc.StudentT(a + 1, p, a), [-1.0, 0.3, 80.0]),
    "Laplace": (lambda a, p: bmc.Laplace(p, a), [-1.0, 0.3, 8.0]),
    "Cauchy": (lambda a, p: bmc.Cauchy(p, a), [-1.0, 0.3, 80.0]),
    "HalfNormal": (lambda a, p: bmc.HalfNormal(a), [-1.0, 0.3, 3.0]),
    "HalfCauchy": (lambda a, p: bmc.HalfCauchy(a), [-1.0, 0.3, 30.0]),
    "LogNormal": (lambda a, p: bmc.LogNormal(p, a), [-1.0, 0.3, 30.0]),
    "Uniform": (lambda a, p: bmc.Uniform(-a, p), [-1.0, 0.1, 3.0]),
    "Beta": (lambda a, p: bmc.Beta(a, p + 0.5), [-1.0, 0.3, 0.9]),
    "Gamma": (lambda a, p: bmc.Gamma(a, p), [-1.0, 0.3, 9.0]),
    "InverseGamma": (lambda a, p: bmc.InverseGamma(a, p), [-1.0, 0.3, 9.0]),
    "Exponential": (lambda a, p: bmc.Exponential(a), [-1.0, 0.3, 9.0]),
    "Weibull": (lambda a, p: bmc.Weibull(a, p), [-1.0, 0.3, 2.0]),
    "VonMises": (lambda a, p: bmc.VonMises(p, a), [-3.0, 0.3, 4.0]),
    "Bernoulli": (lambda a, p: bmc.Bernoulli(p), [0, 1, 2]),
    "Bernoulli by log odds": (lambda a, p: bmc.Bernoulli(logits=a - p), [0, 1, 2]),
    "Binomial": (lambda a, p: bmc.Binomial(5, p), [0, 5, 7]),
    "Binomial by log odds": (lambda a, p: bmc.Binomial(5, logits=a), [0, 4, -1]),
    "Poisson": (lambda a, p: bmc.Poisson(a), [0, 4, -1]),
    "Geometric": (lambda a, p: bmc.Geometric(p), [0, 4, -1]),
    "NegativeBinomial": (lambda a, p: bmc.NegativeBinomial(a, p), [0, 4, -1]),
    "DiscreteUniform": (lambda a, p: bmc.DiscreteUniform(0, 4 + (a > 9)), [0, 4, 5]),
    "Categorical": (lambda a, p: bmc.Categorical(bmc.stack([0.5 * p, 0.5 * p, 1 - p])), [0, 2, 1]),
    "Categorical by logits": (
        lambda a, p: bmc.Categorical(logits=bmc.stack([a, p, -a])),
        [0, 2, 1],
    ),
    "Mixture": (
        lambda a, p: bmc.Mixture(bmc.stack([p, 1 - p]), bmc.Normal(bmc.stack([a, -a]), 0.5)),
        [-1.0, 0.3, 8.0],
    ),
    "Affine": (lambda a, p: bmc.Affine(bmc.Gamma(a, 1.0), p, -2.0), [-1.0, -8.0, 3.0]),
    "Truncated": (lambda a, p: bmc.Truncated(bmc.Normal(a, p), 0.0, 5.0), [-1.0, 0.3, 4.0]),
    "Truncated far off": (
        lambda a, p: bmc.Truncated(bmc.Normal(-20 * a, p), 0.0),
        [-1.0, 0.01, 0.3],
    ),
    "MvNormal": (
        lambda a, p: bmc.MvNormal(bmc.stack([a, p]), COV),
        [[0.0, 1.0], [2.0, 2.0], [-9.0, 1.0]],
    ),
    "MvNormal by a factor": (
        lambda a, p: bmc.MvNormal(
            np.zeros(2), scale_tril=np.stack([bmc.stack([a, 0 * a]), bmc.stack([p, a])], axis=-2)
        ),
        [[0.0, 1.0], [2.0, 2.0], [-9.0, 1.0]],
    ),
    "MvNormal by scales": (
        lambda a, p: bmc.MvNormal(np.ones(2), scale_diag=bmc.stack([a, p])),
        [[0.0, 1.0], [2.0, 2.0], [-9.0, 1.0]],
    ),
    "Joint in a joint": (
        lambda a, p: bmc.Joint(
            [bmc.Joint([bmc.Normal(p, a), bmc.Gamma(a, p)]), bmc.Normal(a, 1.0)]
        ),
        [[0.1, 0.5, 1.0], [2.0, 3.0, -1.0], [-9.0, -1.0, 1.0]],
    ),
    "AndAngle": (
        lambda a, p: AndAngle(bmc.Joint(bmc.Gamma(a, p), bmc.Normal(p, a)), bmc.VonMises(p, a)),
        [[0.1, 0.5, 1.0], [2.0, 3.0, -1.0], [-9.0, -1.0, 1.0]],
    ),
    "Dirichlet": (lambda a, p: bmc.Dirichlet(bmc.stack([a, p, 2.0])), ROWS.tolist()),
    "Multinomial": (
        lambda a, p: bmc.Multinomial(4, bmc.stack([0.5 * p, 0.5 * p, 1 - p])),
        [[0, 4, 0], [1, 1, 2], [3, 3, 3]],
    ),
}


def read(name):
    function, values = FAMILIES[name]
    x = np.array(values)
    family = trace(function, [TracedArray(leaf("a", (3,))), TracedArray(leaf("p", (3,)))])
    return function, x, log_density(family, leaf("x", x.shape, x.dtype))


@pytest.mark.parametrize("name", FAMILIES)
def test_a_closed_form_is_the_families_own(name):
    function, x, density = read(name)
    program = Program([density])
    for scale in (1.0, np.array([[1.0], [0.7]])):
        expected = function(A * scale, P * scale).log_prob(x)
        (found,) = program({"x": x, "a": A * scale, "p": P * scale})
        np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("name", FAMILIES)
def test_derivatives_are_those_of_differences(name):
    function, x, density = read(name)
    finite = np.isfinite(function(A, P).log_prob(x))
    masked = trace(lambda y: np.where(finite, y, 0.0), [TracedArray(density)])
    slopes = gradient(reduction(np.add, masked, [0]), ["x", "a", "p"])

    def total(**given):
        logs = function(given["a"], given["p"]).log_prob(given["x"])
        return float(np.where(finite, logs, 0.0).sum())

    base = {"x": x, "a": A, "p": P}
    for leaf_name, slope in slopes.items():
        if base[leaf_name].dtype.kind != "f" or (name, leaf_name) in {
            ("Dirichlet", "x"),
            ("Uniform", "x"),
        }:
            continue
        (found,) = Program([slope])(base)
        for index in np.ndindex(base[leaf_name].shape):
            at = []
            for step in (-2e-4, -1e-4, 1e-4, 2e-4):
                moved = base[leaf_name].copy()
                moved[index] += step
                at.append(total(**{**base, leaf_name: moved}))
            expected = (at[0] - 8 * at[1] + 8 * at[2] - at[3]) / 12e-4
            assert found[index] == pytest.approx(expected, rel=1e-6, abs=1e-6), (leaf_name, index)


def test_student_t_of_many_degrees_is_the_normal_density() -> None:
    df = np.array([0.3, 5.0, 1e4, 1e12, 1e18, 1e300])
    x = np.array([0.1, 5.0, -2.0, 1.0, 30.0, 2.0])
    shown = Family(
        bmc.StudentT, {"df": leaf("df", (6,), float), "loc": constant(0.5), "scale": constant(2.0)}
    )
    (found,) = Program([log_density(shown, leaf("x", (6,), float))])({"df": df, "x": x})
    np.testing.assert_allclose(found, bmc.StudentT(df, 0.5, 2.0).log_prob(x), rtol=1e-10)
    np.testing.assert_allclose(found[3:], bmc.Normal(0.5, 2.0).log_prob(x[3:]), rtol=1e-9)


class Turned(bmc.Joint):
    """A joint whose arguments are its parts the other way round."""

    def __init__(self, first, second):
        super().__init__(second, first)


class Summed(bmc.Joint):
    """One with a form of its own, whose arguments are numbers."""

    parameter_ndim = {"low": 0, "high": 0}

    def __init__(self, low, high):
        self.low, self.high = low, high
        super().__init__(bmc.Normal(low, 1.0), bmc.Normal(high, 1.0))

    @staticmethod
    def log_density(x, low, high):
        squares = np.square(x[..., 0] - low) + np.square(x[..., 1] - high)
        return -0.5 * squares - np.log(2 * np.pi)


def test_a_class_that_extends_a_joint_is_not_taken_for_its_arguments():
    read_as = lambda f: log_density(trace(f, [TracedArray(leaf("a", ()))]), leaf("x", (2,)))  # noqa: E731
    with pytest.raises(TraceError, match="Turned"):
        read_as(lambda a: Turned(bmc.Normal(a, 1.0), bmc.Gamma(2.0, 1.0)))
    (found,) = Program([read_as(lambda a: Summed(a, a + 1))])(
        {"a": np.array(0.5), "x": np.array([2.0, 3.0])}
    )
    assert found == pytest.approx(Summed(0.5, 1.5).log_prob([2.0, 3.0]))


def test_a_part_of_unknown_size_is_refused():
    vectors = bmc.Mixture(
        [0.3, 0.7], [bmc.MvNormal([0.0, 1.0], COV), bmc.MvNormal([1.0, 0.0], COV)]
    )
    for part in (vectors, bmc.Affine(bmc.MvNormal([0.0, 1.0], COV), 1.0, 2.0)):
        family = trace(
            lambda a, p=part: bmc.Joint(p, bmc.Normal(a, 1.0)), [TracedArray(leaf("a", ()))]
        )
        with pytest.raises(TraceError, match="of vectors"):
            log_density(family, leaf("x", (3,)))
