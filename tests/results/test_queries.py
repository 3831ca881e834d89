"""Query functions act on each draw by itself: what mixes draws or drops their axes is refused.

A function that mixes draws would be weighted as if it did not, and the answer would be wrong.
"""

from __future__ import annotations

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import QueryError, ShapeError, UnsupportedError


def regression() -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"p": 3})
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda x: bmc.Normal(x, 0.5))
    net.add("g", lambda x: bmc.Normal(x, 1.0), plates="p")
    net.add("v", lambda x: bmc.MvNormal(bmc.stack([x, -x]), np.eye(2)))
    net.add("k", bmc.Categorical([0.2, 0.5, 0.3]), plates="p", states=("a", "b", "c"))
    return net


@pytest.fixture(scope="module")
def weighted() -> bmc.Posterior:
    return bmc.infer(regression(), {"y": 2.0}, engine=bmc.LikelihoodWeighting(4000), rng=0)


@pytest.fixture(scope="module")
def exact() -> bmc.Posterior:
    """The plate is as long as there are states, so that shapes may agree by chance."""
    net = bmc.BayesNet(plates={"w": 2})
    net.add("z", bmc.Bernoulli(0.3))
    net.add("s", lambda z: bmc.Bernoulli(0.2 + 0.5 * z), plates="w")
    return bmc.infer(net, {}, engine=bmc.Exact())


MIXING = {
    "variance": lambda x: (x - x.mean()) ** 2,
    "above the mean": lambda x: 1.0 * (x > x.mean()),
    "sort": lambda x: np.sort(x, axis=-1),
    "sort all": lambda x: np.sort(x, axis=None).reshape(x.shape),
    "cumsum": lambda x: np.cumsum(x, axis=-1),
    "rank": lambda x: 1.0 * np.argsort(np.argsort(x, axis=-1), axis=-1),
    "roll": lambda x: np.roll(x, 1, axis=-1),
    "reverse": lambda x: x[..., ::-1],
    "standardised": lambda x: x / x.std(),
    "largest": lambda x: 1.0 * (x == x.max()),
    "position": lambda x: x + np.arange(x.size).reshape(x.shape),
    "random": lambda x: x + np.random.default_rng().normal(size=x.shape),
    "plate and draws": lambda g: g.max(axis=-1) - g.max(),
    "vector and draws": lambda v: v[..., 0] / np.linalg.norm(v),
}


@pytest.mark.parametrize("what", ["expectation", "mcse", "ess"])
@pytest.mark.parametrize("mix", MIXING)
def test_mixing_draws_is_refused(weighted, mix: str, what: str) -> None:
    with pytest.raises(QueryError, match="the function mixes draws.*posterior.mean"):
        getattr(weighted, what)(MIXING[mix])


def test_mixing_draws_is_refused_in_probabilities(weighted) -> None:
    with pytest.raises(QueryError, match="the function mixes draws"):
        weighted.probability(lambda x: x > x.mean())
    mean = float(weighted.mean("x"))
    assert weighted.probability(lambda x: x > mean) == pytest.approx(0.5, abs=0.1)
    # the right way gives the right number: variance 0.2 after y
    assert weighted.expectation(lambda x: (x - mean) ** 2) == pytest.approx(weighted.var("x"))


@pytest.mark.parametrize(
    "function",
    [lambda s: s[0], lambda s: s.sum(axis=0), lambda s: s[0, :], lambda z: z[0], lambda s: s.sum()],
    ids=["first", "sum of first axis", "first row", "a number", "sum of all"],
)
def test_functions_that_drop_the_batch_are_refused(exact, function) -> None:
    draws = exact.resample(2, rng=0)  # as many draws as elements
    for posterior in (exact, draws):
        with pytest.raises((ShapeError, QueryError), match="query: the function"):
            posterior.expectation(function)


GOOD = {
    "square": (lambda x: x**2, ()),
    "plate reduced": (lambda g: g.max(axis=-1) - g.min(axis=-1), ()),
    "plate kept": (lambda g: g, ()),
    "centred in the plate": (lambda g: g - g.mean(axis=-1, keepdims=True), ()),
    "sorted in the plate": (lambda g: np.sort(g, axis=-1), ()),
    "component": (lambda v: v[..., 1], ()),
    "outer product": (lambda v: v[..., None] * v[..., None, :], ()),
    "label": (lambda k: (k == "b") * 1.0, ()),
    "any label": (lambda k: (k == "b").any(axis=-1), ()),
    "element by element": (lambda g, x: g * x, "p"),
    "label by element": (lambda k, g: np.where(k == "a", g, 0.0), "p"),
    "constant": (lambda x: 0 * x + 3.0, ()),
    "not a number": (lambda x: np.where(x > 0, x, np.nan), ()),
}


@pytest.mark.parametrize("count", [1, 2, 3, 8, 9, 500])
@pytest.mark.parametrize("how", GOOD)
def test_good_functions_pass_at_any_number_of_draws(how: str, count: int) -> None:
    function, plates = GOOD[how]
    posterior = bmc.infer(regression(), engine=bmc.LikelihoodWeighting(count), rng=0)
    got = posterior.expectation(function, plates=plates)
    draws = [posterior[n] for n in function.__code__.co_varnames]
    if plates:
        draws = [d if d.ndim == 3 else d[..., None] for d in draws]
    expected = np.asarray(function(*draws)).mean(axis=(0, 1))
    np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize(
    "function",
    [
        lambda g: g - g.mean(axis=-1, keepdims=True),
        lambda g: np.cumsum(g, axis=-1),
        lambda g: 1.0 * (g == g.max(axis=-1, keepdims=True)),
        lambda g: g[..., ::-1],
    ],
    ids=["centred", "cumsum", "largest", "reverse"],
)
def test_mixing_elements_is_refused_where_plates_are_named(weighted, function) -> None:
    with pytest.raises(QueryError, match="mixes elements of plate 'p'.*Leave plates= out"):
        weighted.expectation(function, plates="p")
    assert weighted.expectation(function).shape == (3,)  # without plates= it may


def test_mixing_elements_is_refused_whatever_the_draws() -> None:
    # one pair of draws leaves the largest element where it is in 1 of 6 cases
    net = bmc.BayesNet(plates={"p": 3})
    net.add("g", bmc.Normal(0.0, 1.0), plates="p")
    for seed in range(20):
        posterior = bmc.infer(net, engine=bmc.LikelihoodWeighting(100), rng=seed)
        with pytest.raises(QueryError, match="mixes elements of plate 'p'"):
            posterior.expectation(lambda g: 1.0 * (g == g.max(axis=-1, keepdims=True)), plates="p")
        assert posterior.expectation(lambda g: 1.0 * (g > 0), plates="p").shape == (3,)


@pytest.mark.parametrize(
    "function",
    [
        lambda x, y: 1.0 if x > 0 and y > 0 else 0.0,
        lambda x: max(x, 0.0),
        lambda x: __import__("math").exp(x),
    ],
    ids=["if", "max", "math"],
)
def test_functions_of_single_values_are_told_how_to_write_it(weighted, function) -> None:
    with pytest.raises(QueryError, match=r"query: .*write it with NumPy \(& for and, np.where for"):
        weighted.expectation(function)


def test_labels_have_no_mean(weighted) -> None:
    with pytest.raises(UnsupportedError, match=r"returns labels .*k == 'a'"):
        weighted.expectation(lambda k: k)


@pytest.mark.parametrize("what", ["mcse", "ess", "rhat"])
@pytest.mark.parametrize(
    "engine", [bmc.Exact(), bmc.LikelihoodWeighting(300), bmc.Gibbs(draws=50, warmup=20)]
)
def test_errors_take_the_plates_and_names_of_expectations(what: str, engine) -> None:
    net = bmc.BayesNet(plates={"cluster": 2, "point": 5})
    net.add("mean[0]", bmc.DiscreteUniform(0, 3), plates="cluster")
    net.add("label", bmc.Bernoulli(0.4), plates="point")
    posterior = bmc.infer(net, {}, engine=engine, rng=0)
    names = {"mean": "mean[0]"}
    of_point = getattr(posterior, what)(
        lambda mean, label: 1.0 * mean[label], plates="point", names=names
    )
    assert of_point.shape == (5,)
    of_node = getattr(posterior, what)(lambda mean: mean, names=names)
    by_name = getattr(posterior, what)("mean[0]")  # knows that a state may be unseen
    np.testing.assert_allclose(of_node, by_name, rtol=0.05)
    with pytest.raises(bmc.errors.UnknownNodeError, match="mean"):
        getattr(posterior, what)(lambda mean: mean)
