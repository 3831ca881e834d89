"""Components of vectors that an input or an array picks for each element of a plate."""

from __future__ import annotations

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import BroadcastError, ShapeError, TraceError
from bayesmc.expression import TracedArray, constant, evaluate, leaf
from bayesmc.expression.indexing import indexed
from bayesmc.network.expressions import Followed, density
from bayesmc.network.problem import pose


def random_keys(rng: np.random.Generator, shape: tuple[int, ...]) -> list:
    """An index of the kinds that NumPy knows, whose arrays have one shape."""
    wide = tuple(rng.integers(1, 4, size=rng.integers(0, 3)))
    keys: list = []
    axis, is_open = 0, True
    while axis < len(shape):
        size = shape[axis]
        if is_open and rng.random() < 0.2:
            keys.append(Ellipsis)
            axis, is_open = axis + int(rng.integers(0, len(shape) - axis + 1)), False
            continue
        if rng.random() < 0.15:
            keys.append(None)
        one = slice(None, None, int(rng.choice([1, 2, -1])))
        at = rng.integers(-size, size, size=wide)
        keys.append([one, int(rng.integers(-size, size)), at, at][rng.integers(4)])
        axis += 1
    return keys


def test_an_index_that_varies_picks_as_numpys_does():
    rng, seen = np.random.default_rng(0), 0
    while seen < 400:
        shape = tuple(int(n) for n in rng.integers(1, 4, size=rng.integers(1, 5)))
        value, keys = rng.normal(size=shape), random_keys(rng, shape)
        given = {f"k{n}": k for n, k in enumerate(keys) if isinstance(k, np.ndarray)}
        known = (
            dict(list(given.items())[1:]) if rng.random() < 0.3 else {}
        )  # beside one that varies
        named = [
            TracedArray(leaf(f"k{n}", k.shape, int))
            if f"k{n}" in given and f"k{n}" not in known
            else k
            for n, k in enumerate(keys)
        ]
        try:
            wanted = value[tuple(keys)]
        except IndexError:  # an ellipsis over more axes than are left
            continue
        if not given:
            continue
        seen += 1
        for table in (leaf("x", shape), constant(value)):
            (found,) = evaluate([indexed(table, tuple(named))], {"x": value, **given})
            np.testing.assert_array_equal(found, wanted)
            assert found.shape == wanted.shape


def test_an_index_that_is_no_whole_number_or_beyond_is_refused():
    x, k = leaf("x", (1, 3)), leaf("k", (4,), int)
    (found,) = (indexed(x, (..., 0, k)),)
    with pytest.raises(IndexError, match=r"outside of 0\.\.2"):
        evaluate([found], {"x": np.zeros((1, 3)), "k": np.array([0, 1, 2, 3])})
    for key in ((..., 0, leaf("f", (4,))), (..., leaf("b", (1,), bool), k), (0, 0, k)):
        with pytest.raises(TraceError):
            indexed(x, key)


YEAR = np.arange(6) % 3
PICKED = {
    "input": lambda beta, year: bmc.Normal(2 * beta[..., 0, year] + 1, 0.5),
    "array": lambda beta, year, at=YEAR: bmc.Normal(2 * beta[..., 0, at] + 1, 0.5),
}
EVIDENCE = {"y": np.array([0.1, 1.7, np.nan, -0.4, 2.0, 0.9])}
INPUTS = {"year": YEAR}


def as_vector(function) -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"row": 6})
    net.input("year", plates="row")
    net.add("beta", bmc.MvNormal([0.0, 1.0, -1.0], np.eye(3)))
    net.add("y", function, plates="row")
    return net


def as_plate() -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"row": 6, "level": 3})
    net.input("year", plates="row")
    net.add("mean", lambda: np.array([0.0, 1.0, -1.0]), plates="level")
    net.add("beta", lambda mean: bmc.Normal(mean, 1.0), plates="level")
    net.add("y", lambda beta, year: bmc.Normal(2 * beta[year] + 1, 0.5), plates="row")
    return net


@pytest.mark.parametrize("how", PICKED)
def test_picked_components_are_followed_and_conjugate(how):
    net = as_vector(PICKED[how])
    problem = pose(net, EVIDENCE, INPUTS)
    assert isinstance(density(problem.model, "y"), Followed)
    found = bmc.infer(net, EVIDENCE, inputs=INPUTS, engine=bmc.Exact())
    wanted = bmc.infer(as_plate(), EVIDENCE, inputs=INPUTS, engine=bmc.Exact())
    np.testing.assert_allclose(found.mean("beta"), wanted.mean("beta"), atol=1e-10)
    np.testing.assert_allclose(found.std("beta"), wanted.std("beta"), atol=1e-10)
    assert found.log_marginal_likelihood == pytest.approx(wanted.log_marginal_likelihood)
    shown = bmc.Gibbs().describe(problem)["beta"]
    assert "conjugate" in str(shown).lower(), shown


def test_inputs_of_the_next_question_pick_anew():
    net = as_vector(PICKED["input"])
    for shift in (0, 1):
        inputs = {"year": (np.arange(6) + shift) % 3}
        found = bmc.infer(net, EVIDENCE, inputs=inputs, engine=bmc.Exact())
        wanted = bmc.infer(as_plate(), EVIDENCE, inputs=inputs, engine=bmc.Exact())
        np.testing.assert_allclose(found.mean("beta"), wanted.mean("beta"), atol=1e-10)


def test_gradients_go_to_the_components_that_are_picked():
    net = bmc.BayesNet(plates={"row": 40})
    net.input("year", plates="row")
    net.add("beta", bmc.MvNormal(np.zeros(4), np.eye(4)))
    net.add("n", lambda beta, year: bmc.Poisson(np.exp(beta[..., 0, year])), plates="row")
    inputs = {"year": np.arange(40) % 4}
    evidence = {"n": np.arange(40) % 4 + np.arange(40) // 20}
    found = bmc.infer(net, evidence, inputs=inputs, engine=bmc.HamiltonianMonteCarlo(), rng=0)
    at = np.linspace(-4, 4, 4001)
    for k in range(4):  # independent of each other: one grid each; 4.5 standard errors, 1e-5 each
        n = evidence["n"][inputs["year"] == k]
        log = -0.5 * at**2 + n.sum() * at - n.size * np.exp(at)
        weight = np.exp(log - log.max())
        assert abs(found.mean("beta")[k] - weight @ at / weight.sum()) < 4.5 * found.mcse("beta")[k]


def fault(function, plates=(), node=None) -> str:
    net = bmc.BayesNet(plates={"row": 7})
    net.input("year", plates="row")
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("beta", bmc.MvNormal(np.zeros(3), np.eye(3)), plates=plates)
    if node is not None:
        net.add("z", node, plates="row")
    net.add("y", function, plates="row")
    with pytest.raises((BroadcastError, ShapeError)) as error:
        bmc.infer(net, {"y": np.zeros(7)}, inputs={"year": np.arange(7) % 3})
    return str(error.value)


@pytest.mark.parametrize(
    "function",
    [
        lambda beta, year: bmc.Normal(beta[..., year], 1.0),
        lambda a, beta, year: bmc.Normal(a + beta[..., year], 1.0),
    ],
)
def test_a_component_beside_the_plate_is_told_with_the_index_that_picks_it(function):
    told = fault(function)
    assert "'beta' is a vector and arrives as (*batch, 1, 3)" in told
    assert "beta[..., 0, k]" in told and "be a plate and write beta[k]" in told
    assert "beta[..., np.arange(7), k]" in fault(function, plates="row")


REGION, YEAR = np.array([0, 0, 1, 1]), np.array([0, 2, 0, 2])


def of_regions(function, vector=False):
    net = bmc.BayesNet(plates={"region": 2, "row": 4})
    net.add("curve", bmc.MvNormal(np.zeros(3), np.eye(3)), plates="region")
    net.add("effect", bmc.Normal(0.0, 1.0), plates="region")
    net.add("sd", bmc.Dirichlet(np.ones(5)) if vector else bmc.Gamma(1.0, 1.0))
    net.add("y", function, plates="row")
    return net


@pytest.mark.parametrize("vector", [False, True])
def test_elements_of_another_plate_are_told_with_the_axis_before_them(vector):
    """Vectors, also where another parent is a vector as well, and may be the one; and numbers."""
    scale = (lambda sd: sd[..., 0]) if vector else (lambda sd: sd)
    functions = {
        "curve.array[..., 0, region, k]": lambda curve, sd: bmc.Normal(
            scale(sd) + curve.array[..., REGION, YEAR], 1.0
        ),
        "np.vecdot(X, effect.array)": lambda effect, sd: bmc.Normal(
            scale(sd) + np.matvec(np.ones((4, 2)), effect.array), 1.0
        ),
    }
    for words, function in functions.items():
        with pytest.raises((BroadcastError, ShapeError)) as error:
            of_regions(function, vector).sample(3, rng=0)
        assert words in str(error.value)


def test_what_they_are_told_to_write_works():
    for function in (
        lambda curve: bmc.Normal(curve.array[..., 0, REGION, YEAR], 1.0),
        lambda effect: bmc.Normal(np.vecdot(np.ones((4, 2)), effect.array), 1.0),
    ):
        assert of_regions(function).sample(3, rng=0)["y"].shape == (3, 4)


def test_a_component_that_a_node_picks_is_told_to_be_a_plate():
    three = bmc.Categorical(np.ones(3) / 3)
    told = fault(lambda beta, z: bmc.Normal(beta[..., 0, z], 1.0), node=three)
    assert "let the components be a plate and write beta[k]" in told
