"""Hamiltonian Monte Carlo as an engine: answers, options, refusals, what it counts and warns of, going on.

Answers are held against exact ones at a chance of false alarm of 1e-5 each, at fixed seeds; the matrix of
random nets, Geweke's test and calibration of engines are in ``tests/test_engines_agree.py``, its law in
``tests/kernels/test_no_u_turn.py``.
"""

from __future__ import annotations

import pickle
import warnings
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import UnsupportedError
from bayesmc.testing import assert_matches, exact

EFFECTS = np.array([28.0, 8.0, -3.0, 7.0, -1.0, 1.0, 18.0, 12.0])
ERRORS = np.array([15.0, 10.0, 16.0, 11.0, 9.0, 11.0, 10.0, 18.0])
#: posterior mean of ``tau``, by quadrature of the marginal density of two million points
TAU = 3.59771


def schools(centred: bool) -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"school": 8})
    net.add("mu", bmc.Normal(0.0, 5.0))
    net.add("tau", bmc.HalfCauchy(5.0))
    if centred:
        net.add("theta", lambda mu, tau: bmc.Normal(mu, tau), plates="school")
        net.add("y", lambda theta: bmc.Normal(theta, ERRORS), plates="school")
    else:
        net.add("z", bmc.Normal(0.0, 1.0), plates="school")
        net.add("y", lambda mu, tau, z: bmc.Normal(mu + tau * z, ERRORS), plates="school")
    return net


def line() -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"i": 5})
    net.add("a", bmc.Normal(0.0, 3.0))
    net.add("b", bmc.Normal(0.0, 3.0))
    net.add("y", lambda a, b: bmc.Normal(a + b * np.linspace(-1.0, 2.0, 5), 0.5), plates="i")
    return net


LINE = {"y": [1.0, 1.4, 1.6, 2.2, 2.1]}


def quietly(*arguments: Any, **options: Any) -> tuple[Any, list[str]]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        posterior = bmc.infer(*arguments, **options)
    return posterior, [str(w.message) for w in caught]


# ---- answers -----------------------------------------------------------------------------------------


def share() -> bmc.BayesNet:
    net = bmc.BayesNet()
    net.add("p", bmc.Beta(1.0, 2.0))
    net.add("n", lambda p: bmc.Binomial(9, p))
    return net


def bounds() -> bmc.BayesNet:
    net = bmc.BayesNet()
    net.add("top", bmc.Gamma(3.0, 1.0))
    net.add("x", lambda top: bmc.Uniform(0.0, top))
    net.add("y", lambda x: bmc.Normal(x, 0.5))
    return net


def switch() -> bmc.BayesNet:
    net = bmc.BayesNet()
    net.add("on", bmc.Bernoulli(0.3))
    net.add("level", lambda on: bmc.Normal(1.5 * on, 1.0))
    net.add("y", lambda level: bmc.Normal(level, 0.8))
    return net


CASES: dict[str, tuple[Any, dict[str, Any]]] = {
    "correlated": (line, LINE),
    "partly seen": (line, {"y": [1.0, np.nan, 1.6, 2.2, np.nan]}),
    "share": (share, {"n": 7}),
    "bounds of parents": (bounds, {"y": 1.2}),
    "finite beside": (switch, {"y": 1.0}),
}


@pytest.mark.parametrize("metric", ["diagonal", "dense"])
@pytest.mark.parametrize("name", CASES)
def test_answers_are_exact(name: str, metric: Any) -> None:
    net, evidence = CASES[name][0](), CASES[name][1]
    engine = bmc.HamiltonianMonteCarlo(1000, warmup=400, chains=8, metric=metric)
    posterior = bmc.infer(net, evidence, engine=engine, rng=3)
    assert assert_matches(posterior, exact(net, evidence), alpha=1e-5)


def test_shares() -> None:
    """The conjugate posterior of a simplex: means by hand."""
    net = bmc.BayesNet()
    net.add("w", bmc.Dirichlet([1.0, 2.0, 1.5]))
    net.add("n", lambda w: bmc.Multinomial(12, w))
    engine = bmc.HamiltonianMonteCarlo(500, warmup=300, chains=8)
    posterior = bmc.infer(net, {"n": [3, 2, 7]}, engine=engine, rng=1)
    off = np.abs(posterior.mean("w") - np.array([4.0, 4.0, 8.5]) / 16.5) / posterior.mcse("w")
    assert off.max() < 4.9


def test_what_nothing_depends_on_is_drawn_forward() -> None:
    net = line()
    net.add("later", lambda a, b: bmc.Normal(a + 2.5 * b, 0.5))
    posterior = bmc.infer(net, LINE, engine=bmc.HamiltonianMonteCarlo(300, warmup=300), rng=0)
    table = {row.node: row for row in bmc.explain(net, LINE, engine=posterior.engine).table}
    assert table["later"].kernel == "forward"
    assert table["a"].kernel == "Hamiltonian"
    assert "all 2 free numbers, dense metric" in table["a"].why
    assert_matches(posterior, exact(net, LINE), alpha=1e-5)


# ---- going on ----------------------------------------------------------------------------------------


def test_resumed_as_if_never_stopped() -> None:
    net, seed = schools(centred=True), {"y": EFFECTS}
    half, whole = (bmc.HamiltonianMonteCarlo(n, warmup=60, chains=3) for n in (40, 80))
    first, _ = quietly(net, seed, engine=half, rng=5)
    first = pickle.loads(pickle.dumps(first))
    more, _ = quietly(net, seed, engine=half, rng=5, resume=first)
    once, _ = quietly(net, seed, engine=whole, rng=5)
    for name in ("mu", "tau", "theta"):
        assert np.array_equal(more[name], once[name])
    assert more.divergences.shape == (3, 80)
    assert np.array_equal(more.divergences, once.divergences)
    assert more.energies.shape == (3, 80) and np.array_equal(more.energies, once.energies)


def test_summaries_and_starts() -> None:
    engine = bmc.HamiltonianMonteCarlo(400, warmup=300, start={"a": -1.0, "b": 0.3})
    kept = bmc.infer(line(), LINE, engine=engine, rng=2)
    summed = bmc.infer(line(), LINE, engine=engine, rng=2, keep="summaries")
    assert summed.divergences is None
    np.testing.assert_allclose(kept.mean("a"), summed.mean("a"))
    still = bmc.HamiltonianMonteCarlo(1, warmup=0, max_depth=1, start={"a": -1.0, "b": 0.3})
    posterior, _ = quietly(line(), LINE, engine=still, rng=2)
    assert np.abs(posterior["a"] + 1.0).max() < 3.0


# ---- what is counted and warned of -----------------------------------------------------------------------


def test_divergences_are_told_with_where_they_are() -> None:
    engine = bmc.HamiltonianMonteCarlo(500, warmup=500, reparametrize=False)
    posterior, told = quietly(schools(centred=True), {"y": EFFECTS}, engine=engine, rng=0)
    assert posterior.divergences.shape == (4, 500)
    count = int(posterior.divergences.sum())
    assert count > 10
    (words,) = [t for t in told if "diverged" in t]
    assert f"{count} of 2000 trajectories diverged" in words
    assert "'tau' is low" in words
    apart, told = quietly(line(), LINE, engine=engine, rng=0)
    assert not apart.divergences.any()
    assert not told


def test_energies_that_hardly_change_are_told() -> None:
    """A funnel whose scale is an exponential, so that nothing moves it with what it scales."""
    net = bmc.BayesNet(plates={"i": 9})
    net.add("v", bmc.Normal(0.0, 3.0))
    net.add("x", lambda v: bmc.Normal(0.0, np.exp(0.5 * v)), plates="i")
    net.add("y", lambda x: bmc.Normal(x, 100.0), plates="i")
    for apart in (False, True):
        engine = bmc.HamiltonianMonteCarlo(500, warmup=500, reparametrize=apart)
        _, told = quietly(net, {"y": np.zeros(9)}, engine=engine, rng=0)
        assert any("E-BFMI" in t for t in told) != apart


def test_scales_move_with_what_they_scale() -> None:
    """Effects declared about their mean; the mean of their scale is off by 4.9 errors once in a million."""
    posterior, _ = quietly(
        schools(centred=True), {"y": EFFECTS}, engine=bmc.HamiltonianMonteCarlo(ess=2000), rng=0
    )
    assert posterior.ess("tau") > 1500
    table = {
        row.node: row.kernel
        for row in bmc.explain(schools(centred=True), {"y": EFFECTS}, engine=posterior.engine).table
    }
    assert table["tau"] == "Hamiltonian + rescaled"
    assert abs(posterior.mean("tau") - TAU) < 4.9 * posterior.mcse("tau")


def test_trajectories_that_are_cut_are_told() -> None:
    engine = bmc.HamiltonianMonteCarlo(200, warmup=200, max_depth=1)
    _, told = quietly(line(), LINE, engine=engine, rng=0)
    assert any("of 800 trajectories were cut at 1 doublings" in t for t in told)


def test_thinned_draws_know_all_their_trajectories() -> None:
    """A draw has diverged if one of the trajectories since the last one has."""
    net, evidence = schools(centred=True), {"y": EFFECTS}
    fine = bmc.HamiltonianMonteCarlo(200, warmup=100)
    coarse = bmc.HamiltonianMonteCarlo(100, warmup=100, thinning=2)
    one, _ = quietly(net, evidence, engine=fine, rng=4)
    two, _ = quietly(net, evidence, engine=coarse, rng=4)
    assert np.array_equal(one["tau"][:, 1::2], two["tau"])
    assert np.array_equal(one.divergences.reshape(4, 100, 2).any(axis=2), two.divergences)


# ---- options and refusals ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"target_accept": 1.0}, "target_accept is a share between 0 and 1"),
        ({"target_accept": "high"}, "target_accept is a share between 0 and 1"),
        ({"max_depth": 0}, "max_depth is a whole number"),
        ({"metric": "full"}, 'metric is "auto", "diagonal" or "dense"'),
        ({"draws": -1}, "draws is a whole number"),
    ],
)
def test_options(options: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        bmc.HamiltonianMonteCarlo(**options)


def test_refusals() -> None:
    finite = bmc.BayesNet()
    finite.add("a", bmc.Bernoulli(0.3))
    finite.add("b", lambda a: bmc.Bernoulli(0.2 + 0.5 * a))
    with pytest.raises(UnsupportedError, match="moves continuous nodes, .* finite: 'a'"):
        bmc.infer(finite, {"b": 1}, engine=bmc.HamiltonianMonteCarlo())
    opaque = bmc.BayesNet()
    opaque.add("x", bmc.Normal(0.0, 1.0))
    opaque.add("y", lambda x: bmc.Normal(1.0 if x > 0 else -1.0, 1.0), vectorize=True)
    with pytest.raises(UnsupportedError, match=r"this net has none: .*'y'"):
        bmc.infer(opaque, {"y": 1.0}, engine=bmc.HamiltonianMonteCarlo())


def test_advice_about_cut_trajectories_leaves_out_what_is_done() -> None:
    deep = bmc.HamiltonianMonteCarlo(200, warmup=200, max_depth=1, metric="dense")
    _, told = quietly(line(), LINE, engine=deep, rng=0)
    (text,) = [t for t in told if "were cut" in t]
    assert "metric=" not in text and "max_depth=3" in text
    shallow = bmc.HamiltonianMonteCarlo(200, warmup=200, max_depth=1, metric="diagonal")
    _, told = quietly(line(), LINE, engine=shallow, rng=0)
    (text,) = [t for t in told if "were cut" in t]
    assert 'metric="dense"' in text
