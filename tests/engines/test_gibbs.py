"""Gibbs as an engine: which kernels, where chains start, going on, and what goes wrong."""

from __future__ import annotations

import pickle
import warnings
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.engines.mcmc.gibbs import plan_of
from bayesmc.errors import (
    ConvergenceWarning,
    DensityError,
    EvidenceError,
    ReducibleWarning,
    ZeroProbabilityError,
)
from bayesmc.kernels.accepted import Accepted
from bayesmc.network import pose

pytestmark = pytest.mark.filterwarnings("ignore::bayesmc.errors.ConvergenceWarning")


def mixture() -> tuple[bmc.BayesNet, dict]:
    rng = np.random.default_rng(3)
    net = bmc.BayesNet("mixture", plates={"cluster": 3, "point": 40})
    net.add("weights", bmc.Dirichlet(np.ones(3)))
    net.add("mean", bmc.Normal(0.0, 10.0), plates="cluster")
    net.add("precision", bmc.Gamma(2.0, 1.0))
    net.add("label", lambda weights: bmc.Categorical(weights), plates="point")
    net.add(
        "x",
        lambda label, mean, precision: bmc.Normal(mean[label], precision**-0.5),
        plates="point",
    )
    net.add("unseen", lambda mean: bmc.Normal(mean, 1.0), plates="cluster")
    return net, {"x": rng.normal(size=40)}


def hierarchical() -> tuple[bmc.BayesNet, dict]:
    net = bmc.BayesNet("schools", plates={"school": 8})
    se = np.array([15.0, 10, 16, 11, 9, 11, 10, 18])
    net.add("mu", bmc.Normal(0.0, 5.0))
    net.add("tau", bmc.HalfCauchy(5.0))
    net.add("theta", lambda mu, tau: bmc.Normal(mu, tau), plates="school")
    net.add("y", lambda theta: bmc.Normal(theta, se), plates="school")
    net.add("best", lambda theta: theta.array.max(axis=-1))
    return net, {"y": [28.0, 8, -3, 7, -1, 1, 18, 12]}


def everything() -> tuple[bmc.BayesNet, dict]:
    """A node for every kind of kernel."""
    net = bmc.BayesNet("everything", plates={"i": 6})
    net.add("p", bmc.Beta(1.0, 2.0))
    net.add("coin", lambda p: bmc.Bernoulli(p), plates="i")
    net.add("rate", lambda coin: bmc.Gamma(1.0 + coin, 1.0), plates="i")
    net.add("count", lambda rate: bmc.Poisson(rate), plates="i")
    net.add("shape", bmc.Exponential(1.0))
    net.add("slope", bmc.Laplace(0.0, 1.0))
    net.add("hidden", bmc.Poisson(3.0))
    net.add("simplex", bmc.Dirichlet([1.0, 2.0, 3.0]))
    net.add(
        "y",
        lambda rate, shape, slope, hidden: bmc.Weibull(
            0.5 + shape, np.exp(0.1 * slope * rate) + 0.2 * hidden
        ),
        plates="i",
    )
    net.add("z", lambda simplex: bmc.Normal(simplex[..., 0] ** 2, 0.2))
    return net, {"count": [0, 1, 2, 3, 1, 0], "y": np.linspace(0.5, 2.0, 6), "z": 0.3}


# ---- which kernels ------------------------------------------------------------------------------


def kernels(net: bmc.BayesNet, evidence: dict) -> dict[str, str]:
    explanation = bmc.explain(net, evidence, engine=bmc.Gibbs())
    return {row.node: row.kernel for row in explanation.table}


def test_the_table_of_a_mixture(capsys: pytest.CaptureFixture) -> None:
    found = kernels(*mixture())
    assert found == {
        "weights": "conjugate",
        "mean": "conjugate",
        "precision": "conjugate",
        "label": "enumerate",
        "x": "",
        "unseen": "forward",
    }
    shown = capsys.readouterr().out
    assert "point=40" in shown and "Gamma with Normal scale" in shown and "colour" in shown


def test_every_kind_of_kernel_is_found() -> None:
    found = kernels(*everything())
    assert found["p"] == "conjugate" and found["coin"] == "enumerate + redrawn"
    assert found["shape"] == found["slope"] == found["simplex"] == "Hamiltonian"
    assert found["hidden"] == "slice"


def test_kernels_of_what_has_no_derivative() -> None:
    """A function that is not followed leaves numbers to slices, and simplices to walks."""
    net = bmc.BayesNet()
    net.add("a", bmc.Laplace(0.0, 1.0))
    net.add("b", bmc.Laplace(0.0, 1.0))
    net.add("w", bmc.Dirichlet([1.0, 2.0, 3.0]))

    def seen(a: float, b: float, w: np.ndarray) -> bmc.Normal:
        return bmc.Normal(a + b if a > 0 else w[0], 1.0)

    net.add("y", seen, vectorize=True)
    found = kernels(net, {"y": 0.3})
    assert found["a"].startswith("factor slice") and found["b"].startswith("factor slice")
    assert "walk" in found["w"]


def test_few_numbers_move_jointly_and_many_by_slices() -> None:
    """Whatever shares terms joins while the covariance of all is learnt; a plate of more does not."""
    net = bmc.BayesNet(plates={"group": 100})
    for name in ("low", "high", "rate"):
        net.add(name, bmc.Laplace(0.0, 1.0))
    net.add("effect", bmc.StudentT(4.0, 0.0, 1.0), plates="group")
    net.add(
        "y",
        lambda low, high, rate, effect: bmc.Normal(low + high / (1 + np.exp(-rate)) + effect, 1.0),
        plates="group",
    )
    evidence = {"y": np.linspace(-1.0, 3.0, 100)}
    table = {row.node: row for row in bmc.explain(net, evidence, engine=bmc.Gibbs()).table}
    assert "Hamiltonian" in table["rate"].kernel
    assert "3 free numbers jointly, dense metric" in table["rate"].why
    assert table["effect"].kernel == "slice"


def test_plates_that_share_terms_move_jointly_and_one_alone_by_slices() -> None:
    """Components of a declared mixture hang together, whichever comes first; rows by themselves do not."""
    net = bmc.BayesNet(plates={"part": 2, "row": 50, "lone": 3})
    net.add("mu", bmc.Normal(0.0, 2.0), plates="part")
    net.add("sigma", bmc.HalfNormal(2.0), plates="part")
    net.add("shares", bmc.Dirichlet([5.0, 5.0]))
    net.add(
        "y",
        lambda mu, sigma, shares: bmc.Mixture(shares, bmc.Normal(mu.array, sigma.array)),
        plates="row",
    )
    net.add("heavy", bmc.StudentT(4.0, 0.0, 1.0), plates="lone")
    net.add("wide", bmc.HalfCauchy(1.0), plates="lone")
    net.add("z", lambda heavy, wide: bmc.StudentT(4.0, heavy, wide), plates="lone")
    evidence = {"y": np.linspace(-2.0, 2.0, 50), "z": [0.1, 0.5, -0.3]}
    table = {row.node: row for row in bmc.explain(net, evidence, engine=bmc.Gibbs()).table}
    assert all("5 free numbers jointly" in table[n].why for n in ("mu", "sigma", "shares"))
    assert all(table[n].kernel.startswith("slice") for n in ("heavy", "wide"))


def test_the_reason_of_a_refusal_is_told(capsys: pytest.CaptureFixture) -> None:
    bmc.explain(*everything(), engine=bmc.Gibbs())
    assert "Weibull" in capsys.readouterr().out


def test_nodes_of_one_colour_share_no_term() -> None:
    net, evidence = mixture()
    rows = {r.node: r for r in bmc.explain(net, evidence, engine=bmc.Gibbs()).table}
    assert rows["mean"].colour != rows["label"].colour != rows["weights"].colour
    assert rows["weights"].colour == rows["mean"].colour  # they meet in nothing


def test_gibbs_is_chosen_where_exact_cannot() -> None:
    net, evidence = mixture()
    chosen = bmc.explain(net, evidence)
    assert chosen.engine == bmc.Gibbs() and "conjugate" in chosen.reasons[0]
    assert isinstance(bmc.explain(net).engine, bmc.LikelihoodWeighting)  # nothing was observed


def test_debug_runs_on_every_closed_form() -> None:
    for build in (mixture, hierarchical, everything):
        net, evidence = build()
        engine = bmc.Gibbs(draws=20, warmup=20, chains=3, debug=True)
        bmc.infer(net, evidence, engine=engine, rng=0)


@pytest.mark.parametrize("debug", [True, False])
def test_debug_reaches_the_kernels(debug: bool) -> None:
    """What they do with it is tested with them."""
    sampler = bmc.Gibbs(debug=debug).sampler(pose(*mixture()))
    told = {name: k.debug for k in sampler.kernels if hasattr(k, "debug") for name in k.names}
    assert {"weights", "mean", "precision", "label"} <= told.keys()
    assert set(told.values()) == {debug}


# ---- going on -----------------------------------------------------------------------------------


@pytest.mark.parametrize("build", [mixture, hierarchical, everything])
@pytest.mark.parametrize("keep", ["draws", "summaries"])
def test_resume_is_bit_for_bit(build, keep) -> None:
    net, evidence = build()
    options = {"warmup": 15, "chains": 3, "thinning": 2}
    whole = bmc.infer(net, evidence, engine=bmc.Gibbs(25, **options), rng=5, keep=keep)
    part = bmc.infer(net, evidence, engine=bmc.Gibbs(10, **options), rng=5, keep=keep)
    part = pickle.loads(pickle.dumps(part))
    both = bmc.infer(net, evidence, engine=bmc.Gibbs(15, **options), resume=part, keep=keep)
    for name in net.graph.nodes:
        if keep == "draws":
            np.testing.assert_array_equal(whole[name], both[name])
        np.testing.assert_array_equal(whole.mean(name), both.mean(name))


def test_resumed_by_the_engine_that_made_it() -> None:
    net, evidence = mixture()
    first = bmc.infer(net, evidence, engine=bmc.Gibbs(5, warmup=2, chains=2), rng=1)
    assert bmc.infer(net, evidence, resume=first)["mean"].shape[:2] == (2, 10)


def test_the_same_seed_gives_the_same_draws() -> None:
    net, evidence = everything()
    engine = bmc.Gibbs(draws=15, warmup=15, chains=2)
    one, two = (bmc.infer(net, evidence, engine=engine, rng=8) for _ in range(2))
    other = bmc.infer(net, evidence, engine=engine, rng=9)
    np.testing.assert_array_equal(one["slope"], two["slope"])
    assert (one["slope"] != other["slope"]).any()


def test_interrupted_chains_keep_what_they_have(monkeypatch: pytest.MonkeyPatch) -> None:
    from bayesmc.engines.mcmc.sweep import SweepSampler

    net, evidence = mixture()
    step, calls = SweepSampler.step, []

    def interrupted(self, state, rng, warmup):
        calls.append(1)
        if len(calls) == 36:
            raise KeyboardInterrupt
        return step(self, state, rng, warmup)

    monkeypatch.setattr(SweepSampler, "step", interrupted)
    with pytest.warns(bmc.errors.InterruptWarning, match="25 draws"):
        part = bmc.infer(net, evidence, engine=bmc.Gibbs(50, warmup=10), rng=1)
    assert part["mean"].shape == (4, 25, 3)


def test_a_name_that_looks_like_an_index_is_a_name() -> None:
    """A mean adds nodes of a block, x and w, and one outside: it is not frozen whatever that is called."""
    draws = []
    for outside in ("x[0]", "c"):
        net = bmc.BayesNet(plates={"p": 3})
        net.add("x", bmc.Normal(0.0, 1.0))
        net.add("w", lambda x: bmc.Normal(x, 1.0))
        net.add(outside, bmc.StudentT(3.0, 0.0, 2.0))
        net.add(
            "y",
            lambda x, w, c: bmc.Normal(x + w + c, 0.5),
            parents=["x", "w", outside],
            plates="p",
        )
        assert "block" in kernels(net, {"y": [2.0, 3.0, 2.5]})["x"]
        posterior = bmc.infer(net, {"y": [2.0, 3.0, 2.5]}, engine=bmc.Gibbs(40, 26, 4), rng=1)
        draws.append(posterior["x"])
    assert np.array_equal(*draws)


# ---- where chains start -------------------------------------------------------------------------


def test_vague_priors_do_not_keep_chains_from_starting() -> None:
    net = bmc.BayesNet(plates={"i": 4})
    net.add("a", bmc.Normal(0.0, 1e3))
    net.add("b", bmc.Normal(0.0, 1e3))
    net.add("tau", bmc.Gamma(0.001, 0.001))
    net.add("effect", lambda tau: bmc.Normal(0.0, tau**-0.5), plates="i")
    x = np.array([-1.5, -0.5, 0.5, 1.5])
    net.add("r", lambda a, b, effect: bmc.Binomial(20, logits=a + b * x + effect), plates="i")
    posterior = bmc.infer(net, {"r": [3, 8, 11, 17]}, engine=bmc.Gibbs(200, 200), rng=0)
    # shares .15 .4 .55 .85: a slope near 1.1 on the logit scale; the prior has |a|, |b| near 1000
    assert abs(posterior.mean("a")) < 0.6 and 0.5 < posterior.mean("b") < 2.0


def test_impossible_evidence_names_the_culprit() -> None:
    net = bmc.BayesNet()
    net.add("scale", bmc.Uniform(0.0, 2.0))
    net.add("y", lambda scale: bmc.Uniform(0.0, scale))
    net.add("z", lambda scale: bmc.Normal(scale, 1.0))
    with pytest.raises(ZeroProbabilityError, match="'y'"):
        bmc.infer(net, {"y": 3.0, "z": 0.0}, engine=bmc.Gibbs(), rng=0)
    with pytest.raises(EvidenceError, match="'y' is -1.0, outside its support"):
        bmc.infer(net, {"y": -1.0, "z": 0.0}, engine=bmc.Gibbs(), rng=0)


def test_hard_evidence_is_found_by_many_attempts() -> None:
    """One start in some hundred is possible."""
    net = bmc.BayesNet(plates={"i": 4})
    net.add("k", bmc.Categorical(np.ones(4) / 4), plates="i")
    net.add("low", bmc.Gamma(2.0, 1.0))
    net.add("sum", lambda k, low: bmc.Bernoulli(np.where(k.sum("i") >= 10, 1.0, 0.0)))
    net.add("y", lambda low: bmc.Exponential(low))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        posterior = bmc.infer(net, {"sum": 1, "y": 0.4}, engine=bmc.Gibbs(300, 50), rng=0)
    assert (posterior["k"].sum(axis=-1) >= 10).all()


# ---- what goes wrong ----------------------------------------------------------------------------


def test_a_nan_density_names_node_values_and_iteration() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Gamma(20.0, 20.0))
    net.add(
        "y",
        lambda x: bmc.Density(lambda v: np.where(x > 3.0, np.nan, -((v - x) ** 2)), lambda *_: 0),
    )
    with pytest.raises(DensityError, match=r"'y'.*nan.*x = [3-9].*y = 40.*iteration"):
        bmc.infer(net, {"y": 40.0}, engine=bmc.Gibbs(), rng=0)


def test_chains_that_zeros_may_hold_are_told_of() -> None:
    """Twelve coins that must all agree are too many for one block."""
    net = bmc.BayesNet()
    for k in range(12):
        net.add(f"x{k}", bmc.Bernoulli(0.5))
    names = [f"x{k}" for k in range(12)]
    net.add(
        "agree",
        lambda *x: bmc.Bernoulli((sum(x) % 12 == 0) * 1.0),
        parents=names,
    )
    with pytest.warns(ReducibleWarning, match="'x0'"):
        bmc.infer(net, {"agree": 1}, engine=bmc.Gibbs(20, 5), rng=0)


def test_tied_nodes_move_together() -> None:
    """One at a time an exclusive or could never change; as a block it does."""
    net = bmc.BayesNet()
    net.add("x", bmc.Bernoulli(0.3))
    net.add("y", bmc.Bernoulli(0.3))
    net.add("parity", lambda x, y: bmc.Bernoulli((x + y) % 2 * 1.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error", ReducibleWarning)
        posterior = bmc.infer(net, {"parity": 0}, engine=bmc.Gibbs(2000, 10), rng=0)
    exact = bmc.infer(net, {"parity": 0}, engine=bmc.Exact()).mean("x")
    # 8,000 independent draws: five standard errors, a false alarm in two million
    assert abs(posterior.mean("x") - exact) < 5 * np.sqrt(exact * (1 - exact) / 8000)


@pytest.mark.parametrize(
    "potential",
    [lambda x: 0.36 * x**2, lambda x: np.where(x > 4.0, 12.0, 0.0), lambda x: -((x - 6.0) ** 2)],
    ids=["heavier tails", "a rare place", "far away"],
)
def test_potentials_may_outgrow_what_is_drawn_without_them(potential: Any) -> None:
    """Draws that know nothing of them are accepted often, and never where most of the mass is.

    Squared errors of 6 runs, in their standard errors, are chi-squared: 40 is passed by chance in 1 of 10^6.
    """
    net = bmc.BayesNet("potential")
    net.add("x", bmc.Normal(0.0, 10.0))
    net.add("y", lambda x: bmc.Normal(x, 1.0))
    net.potential("p", potential)
    grid = np.linspace(-60.0, 60.0, 200_001)
    log = bmc.Normal(0.0, 10.0).log_prob(grid) + bmc.Normal(grid, 1.0).log_prob(0.0)
    weights = np.exp(log + potential(grid) - np.max(log + potential(grid)))
    weights /= weights.sum()
    mean = weights @ grid
    errors = []
    for seed in range(6):
        found = bmc.infer(net, {"y": 0.0}, engine=bmc.Gibbs(), rng=seed)
        around = found.expectation(lambda x: (x - mean) ** 2) - weights @ (grid - mean) ** 2
        errors.append(
            [
                (found.mean("x") - mean) / found.mcse("x"),
                around / found.mcse(lambda x: (x - mean) ** 2),
            ]
        )
    assert np.all(np.sum(np.square(errors), axis=0) < 40.0), errors


def test_numbers_that_are_cut_to_whole_ones_have_no_closed_form() -> None:
    """A cast is no part of an affine mean. False-alarm rate: 2 figures at 4.9 standard errors, 2e-6."""
    seen = np.array([1.4, 1.8, 0.6, 1.1, 2.0, 0.9])
    net = bmc.BayesNet(plates={"i": 6})
    net.add("c", bmc.Normal(0.0, 2.0))
    net.add("y", lambda c: bmc.Normal(c.astype(int) * 1.0, 1.0), plates="i")
    grid = np.linspace(-12.0, 12.0, 240_001)
    log = -0.125 * grid**2 - 0.5 * np.square(seen[:, None] - np.trunc(grid)).sum(axis=0)
    weights = np.exp(log - log.max()) / np.exp(log - log.max()).sum()
    found = bmc.infer(net, {"y": seen}, engine=bmc.Gibbs(), rng=1)
    for function in (lambda c: c, lambda c: c**2):
        wanted = weights @ function(grid)
        assert abs(found.expectation(function) - wanted) < 4.9 * found.mcse(function)


def test_a_logarithm_of_a_number_is_no_feature_below_a_line(capsys: pytest.CaptureFixture) -> None:
    net = bmc.BayesNet(plates={"i": 3})
    net.add("b", bmc.Normal(0.0, 1.0))
    net.add("y", lambda b: bmc.Normal(0.0, np.log(b**2 + 4.0)), plates="i")
    bmc.explain(net, {"y": [0.1, 1.0, -0.4]}, engine=bmc.Gibbs())
    assert "makes no conjugate pair with a Normal prior" in capsys.readouterr().out


def test_constraints_alone_decide_where_they_refuse_little() -> None:
    """Draws in order are accepted with one probability wherever the chain stands."""
    net = bmc.BayesNet("order", plates={"k": 2})
    net.add("x", bmc.Normal([0.0, 2.0], 1.0), plates="k")
    net.add("y", lambda x: bmc.Normal(x, 1.0), plates="k")
    net.potential("ordered", lambda x: np.log(x[0] < x[1]))
    (kernel,) = plan_of(pose(net, {"y": [0.5, 1.5]})).kernels[:1]
    assert isinstance(kernel, Accepted) and kernel.constraints


def test_a_run_that_has_not_mixed_says_so() -> None:
    """Signs of more numbers than independent proposals are fitted to."""
    net = bmc.BayesNet(plates={"number": 8})
    net.add("x", bmc.Normal(0.0, 10.0), plates="number")
    net.add("y", lambda x: bmc.Normal(np.abs(x), 0.3), plates="number")
    with pytest.warns(ConvergenceWarning, match="'x'"):
        bmc.infer(net, {"y": np.full(8, 8.0)}, engine=bmc.Gibbs(200, 100), rng=0)


def test_nodes_that_nothing_observed_depends_on_are_drawn_afresh() -> None:
    """Near-deterministic tables below the evidence would trap a chain that moved through them."""
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.5))
    net.table("b", ["a"], [[0.999, 0.001], [0.001, 0.999]])
    net.table("c", ["b"], [[0.9999, 0.0001], [0.0001, 0.9999]])
    net.add("y", lambda a: bmc.Normal(a, 2.0))
    posterior = bmc.infer(net, {"y": 0.5}, engine=bmc.Gibbs(2000, 10), rng=0)
    # 8,000 independent draws: five standard errors, a false alarm in two million
    assert posterior.ess("c") > 4000
    assert abs(posterior.mean("c") - 0.5) < 5 * 0.5 / np.sqrt(8000)


# ---- vectors ------------------------------------------------------------------------------------


def effects(likelihood: Any, as_vector: bool) -> bmc.BayesNet:
    """Three effects of one scale, apart or as one vector."""
    x = np.random.default_rng(0).normal(size=(60, 3))
    net = bmc.BayesNet(plates={"i": 60})
    net.add("tau", bmc.HalfNormal(5.0))
    if as_vector:
        net.add("b", lambda tau: bmc.MvNormal(np.zeros(3), scale_diag=tau[..., None] * np.ones(3)))
        net.add("y", lambda b: likelihood(np.vecdot(x, b)), plates="i")
        return net
    for k in range(3):
        net.add(f"b{k}", lambda tau: bmc.Normal(0.0, tau))
    net.add(
        "y",
        lambda b0, b1, b2: likelihood(b0 * x[:, 0] + b1 * x[:, 1] + b2 * x[:, 2]),
        plates="i",
    )
    return net


LIKELIHOODS: dict[str, tuple[Any, Any]] = {
    "normal": (lambda m: bmc.Normal(m, 20.0), lambda u: 20.0 * u),
    "logistic": (lambda m: bmc.Bernoulli(logits=m), lambda u: u > 0),
    "student": (lambda m: bmc.StudentT(4.0, m, 20.0), lambda u: 20.0 * u),
}


@pytest.mark.filterwarnings("ignore::bayesmc.errors.ConvergenceWarning")
@pytest.mark.parametrize(
    "name",
    ["normal", *(pytest.param(n, marks=pytest.mark.thorough) for n in list(LIKELIHOODS)[1:])],
)
def test_a_vector_mixes_as_its_components_apart_do(name: str) -> None:
    """The normal one's scale had an effective size of a sixth."""
    likelihood, data = LIKELIHOODS[name]
    y = data(np.random.default_rng(1).normal(size=60))
    engine = bmc.Gibbs(400, 400)
    apart, vector = (
        bmc.infer(effects(likelihood, v), {"y": y}, engine=engine, rng=0) for v in (False, True)
    )
    assert vector.ess("tau") > 0.5 * apart.ess("tau")
    least = min(float(apart.ess(f"b{k}")) for k in range(3))
    assert np.min(vector.ess("b")) > 0.5 * least
    error = np.hypot(apart.mcse("tau"), vector.mcse("tau"))
    assert abs(apart.mean("tau") - vector.mean("tau")) < 5.0 * error  # false alarm 6e-7
