"""Where chains start: wherever some density is finite, or where the user says; never without a word."""

from __future__ import annotations

import tracemalloc
from typing import Any

import numpy as np
import pytest
from scipy.special import expit

import bayesmc as bmc
from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.mcmc.gibbs import plan_of
from bayesmc.engines.mcmc.given import read_start
from bayesmc.engines.mcmc.starts import start_states
from bayesmc.errors import (
    EvidenceError,
    ModelError,
    ShapeError,
    UnknownNodeError,
    ZeroProbabilityError,
)
from bayesmc.lowering import is_available
from bayesmc.network import pose
from bayesmc.structure.target import target_of

# few draws say nothing of mixing, which is no matter here
pytestmark = pytest.mark.filterwarnings("ignore::bayesmc.errors.ConvergenceWarning")

X = np.linspace(0.0, 10.0, 12)


def started(net: bmc.BayesNet, evidence: dict[str, Any], chains: int = 4) -> np.ndarray:
    """Log density of the start of every chain."""
    with marking_invalid(), np.errstate(all="ignore"):  # as engines do
        target = target_of(pose(net, evidence))
        values = start_states(target, chains, np.random.default_rng(0))
        return np.asarray(target.log_density(values))


# ---- functions that overflow at vague draws -----------------------------------------------------


def logistic() -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"i": 12})
    for name in "abc":
        net.add(name, bmc.Normal(0.0, 100.0))
    net.add("s", bmc.HalfNormal(10.0))
    net.add("y", lambda a, b, c, s: bmc.Normal(a / (1 + b * np.exp(-c * X)), s), plates="i")
    return net


def gompertz() -> bmc.BayesNet:
    """The curve in a node of its own."""
    net = bmc.BayesNet(plates={"i": 12})
    for name in "abc":
        net.add(name, bmc.Normal(0.0, 300.0))
    net.add("s", bmc.Gamma(1.0, 0.01))
    net.add("mean", lambda a, b, c: a * np.exp(-b * np.exp(-c * X)), plates="i")
    net.add("y", lambda mean, s: bmc.Normal(mean, s), plates="i")
    return net


def saturation() -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"i": 12})
    net.add("v", bmc.Normal(0.0, 1000.0))
    net.add("k", bmc.Normal(0.0, 1000.0))
    net.add("t", bmc.Gamma(0.001, 0.001))
    net.add("y", lambda v, k, t: bmc.Normal(v * X / (k + X), t**-0.5), plates="i")
    return net


CURVES = {"logistic": logistic, "gompertz": gompertz, "saturation": saturation}


@pytest.mark.parametrize("name", CURVES)
def test_growth_curves_are_compiled_and_started(name: str) -> None:
    y = 10.0 / (1.0 + 20.0 * np.exp(-0.9 * X))
    assert np.isfinite(started(CURVES[name](), {"y": y})).all()


def test_a_curve_gets_its_answer() -> None:
    noise = np.random.default_rng(0).normal(size=12)
    net = bmc.BayesNet(plates={"i": 12})
    for name, width in (("a", 20.0), ("b", 5.0), ("c", 2.0)):
        net.add(name, bmc.Normal(0.0, width))
    net.add("y", lambda a, b, c: bmc.Normal(a / (1 + np.exp(b - c * X)), 0.2), plates="i")
    y = 10.0 / (1.0 + np.exp(3.0 - 0.9 * X)) + 0.2 * noise
    engine = bmc.Gibbs(200, 300, start={"a": 9.0, "b": 2.0, "c": 0.5})
    posterior = bmc.infer(net, {"y": y}, engine=engine, rng=0)
    for name, true in (("a", 10.0), ("b", 3.0), ("c", 0.9)):  # false alarm 2e-5
        assert abs(posterior.mean(name) - true) < 4.5 * posterior.std(name)
        assert posterior.std(name) < 0.5


# ---- densities that are zero at vague draws ------------------------------------------------------


def lifetimes() -> tuple[bmc.BayesNet, dict[str, Any]]:
    net = bmc.BayesNet(plates={"i": 30})
    net.add("b", bmc.Normal(0.0, 100.0))
    net.add("r", bmc.Gamma(1.0, 1e-4))
    net.add("t", lambda b, r: bmc.Weibull(r, np.exp(-b / r)), plates="i")
    return net, {"t": 20.0 * np.random.default_rng(0).weibull(1.5, 30)}


def regression() -> tuple[bmc.BayesNet, dict[str, Any]]:
    rng = np.random.default_rng(0)
    z = rng.normal(size=80)
    net = bmc.BayesNet(plates={"i": 80})
    net.add("b", bmc.MvNormal(np.zeros(2), 1e4 * np.eye(2)))
    net.add("r", bmc.Gamma(1.0, 1e-4))
    net.add("t", lambda b, r: bmc.Weibull(r, np.exp(-(b[..., 0] + b[..., 1] * z) / r)), plates="i")
    return net, {"t": np.exp(3.0 + 0.5 * z) * rng.weibull(1.5, 80)}


def far_off() -> tuple[bmc.BayesNet, dict[str, Any]]:
    """Fifty standard deviations from the prior mean: only the way to the support leads there."""
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda x: bmc.Uniform(x + 50.0, x + 51.0))
    return net, {"y": 0.0}


def ordinal() -> tuple[bmc.BayesNet, dict[str, Any]]:
    """Effects of 286 groups, of a spread that is as good as unknown."""
    rng = np.random.default_rng(0)
    group = np.repeat(np.arange(286), 4)
    net = bmc.BayesNet(plates={"g": 286, "i": len(group)})
    net.add("spread", bmc.HalfCauchy(100.0))
    for k in range(3):
        net.add(f"c{k}", bmc.Normal(0.0, 10.0))
    net.add("u", lambda spread: bmc.Normal(0.0, spread), plates="g")

    def y(c0: Any, c1: Any, c2: Any, u: Any) -> Any:
        below = expit(bmc.stack([c0, c1, c2], axis=-1) - u[group][..., None])
        ends = np.zeros((*below.shape[:-1], 1))
        return bmc.Categorical(np.diff(np.concatenate([ends, below, 1.0 + ends], axis=-1)))

    net.add("y", y, plates="i")
    seen = rng.normal(size=286)[group] + rng.logistic(size=len(group))
    return net, {"y": np.digitize(seen, [-1.0, 0.0, 1.0])}


def captures() -> tuple[bmc.BayesNet, dict[str, Any]]:
    """Whoever was caught is there: forward draws of all that are there are never right."""
    rng = np.random.default_rng(0)
    there, effect = rng.random(150) < 0.7, rng.normal(size=150)
    caught = (rng.random((150, 4)) < expit(effect)[:, None]) & there[:, None]
    net = bmc.BayesNet(plates={"animal": 150, "day": 4})
    net.add("share", bmc.Uniform(0.0, 1.0))
    net.add("chance", bmc.Uniform(0.0, 1.0), plates="day")
    net.add("sigma", bmc.Uniform(0.0, 5.0))
    net.add("eps", lambda sigma: bmc.Normal(0.0, sigma), plates="animal")
    net.add("z", lambda share: bmc.Bernoulli(share), plates="animal")

    def y(z: Any, eps: Any, chance: Any) -> Any:
        odds = np.log(chance / (1 - chance)) + eps
        return bmc.Bernoulli(np.where(z == 1, 1 / (1 + np.exp(-odds)), 0.0))

    net.add("y", y, plates=("animal", "day"))
    return net, {"y": caught.astype(int)}


def occupancy() -> tuple[bmc.BayesNet, dict[str, Any]]:
    """Labels that depend on labels."""
    rng = np.random.default_rng(0)
    site = rng.random(40) < 0.6
    visit = (rng.random((40, 3)) < 0.7) & site[:, None]
    net = bmc.BayesNet(plates={"site": 40, "visit": 3, "test": 3})
    for name in ("psi", "theta", "p"):
        net.add(name, bmc.Beta(1.0, 1.0))
    net.add("z", lambda psi: bmc.Bernoulli(psi), plates="site")
    net.add("w", lambda z, theta: bmc.Bernoulli(z * theta), plates=("site", "visit"))
    net.add("y", lambda w, p: bmc.Bernoulli(w * p), plates=("site", "visit", "test"))
    seen = (rng.random((40, 3, 3)) < 0.5) & visit[..., None]
    return net, {"y": seen.astype(int)}


def above_another() -> tuple[bmc.BayesNet, dict[str, Any]]:
    """A rate whose density, which cannot be drawn from, is zero below that of the other component."""

    def above(low: Any) -> Any:
        return bmc.Density(
            lambda x: np.where(x > low, -0.5 * (x - 3.0) ** 2, -np.inf), support="positive"
        )

    rng = np.random.default_rng(0)
    net = bmc.BayesNet(plates={"row": 60})
    net.add("slow", bmc.HalfNormal(1.0))
    net.add("fast", above, parents=["slow"])
    net.add("z", bmc.Categorical([0.5, 0.5]), plates="row")
    net.add("u", lambda z, slow, fast: bmc.Exponential(np.where(z == 0, slow, fast)), plates="row")
    return net, {"u": rng.exponential(np.where(np.arange(60) % 2 == 0, 1.0, 0.2))}


MODELS = {
    f.__name__: f
    for f in (lifetimes, regression, far_off, ordinal, captures, occupancy, above_another)
}


@pytest.mark.parametrize("name", MODELS)
def test_a_finite_density_somewhere_is_enough(name: str) -> None:
    net, evidence = MODELS[name]()
    tracemalloc.start()
    try:
        assert np.isfinite(started(net, evidence)).all()
        assert tracemalloc.get_traced_memory()[1] < 300e6  # bytes; it was 2.5e9
    finally:
        tracemalloc.stop()


def test_labels_that_the_data_leave_one_state_are_no_cause_to_leave_the_prior() -> None:
    """Chains began at a scale of 1e-250 with all effects 0, where the density has no end, and stayed."""
    net, evidence = captures()
    with marking_invalid(), np.errstate(all="ignore"):
        target = target_of(pose(net, evidence))
        values = start_states(target, 16, np.random.default_rng(0))
    assert (values["sigma"] > 1e-3).all()  # of 16 draws of the prior one is below once in 300
    assert (values["z"] >= evidence["y"].any(axis=1)).all()
    posterior = bmc.infer(net, evidence, engine=bmc.Gibbs(5, 5, compiled=False), rng=0)
    assert (posterior["sigma"].std(axis=-1) > 0.0).all()


def test_a_climb_stays_out_of_the_neck_of_a_funnel() -> None:
    """The way to the data is long, and on it the density of all effects grew without end."""
    net = bmc.BayesNet(plates={"i": 30})
    net.add("m", bmc.Normal(0.0, 1.0))
    net.add("s", bmc.HalfNormal(1.0))
    net.add("u", lambda s: bmc.Normal(0.0, s), plates="i")
    net.add("y", lambda m, u: bmc.Uniform(m + u + 50.0, m + u + 51.0), plates="i")
    with marking_invalid(), np.errstate(all="ignore"):
        target = target_of(pose(net, {"y": np.linspace(0.0, 0.5, 30)}))
        values = start_states(target, 4, np.random.default_rng(0))
        assert np.isfinite(target.log_density(values)).all()
    assert (values["s"] > 1e-3).all()


def test_both_engines_start_and_agree() -> None:
    net, evidence = lifetimes()
    one = bmc.infer(net, evidence, engine=bmc.Gibbs(300, 200), rng=0)
    two = bmc.infer(net, evidence, engine=bmc.MetropolisHastings(500, 300), rng=0)
    for name in ("b", "r"):  # false alarm 1e-6
        error = np.hypot(one.mcse(name), two.mcse(name))
        assert abs(one.mean(name) - two.mean(name)) < 5.0 * error
        assert one.std(name) > 5.0 * error  # and a standard deviation off would be seen


# ---- what cannot be ------------------------------------------------------------------------------


def test_impossible_evidence_is_named_at_once() -> None:
    net = bmc.BayesNet(plates={"i": 4})
    totals = np.array([10, 10, 60, 10])
    net.add("p", bmc.Normal(0.0, 1.0))
    net.add("k", lambda p: bmc.Binomial(totals, logits=p), plates="i")
    with pytest.raises(ZeroProbabilityError, match=r"'k' \(plate element 3\): 50.*from 0 to 10"):
        bmc.infer(net, {"k": [3, 4, 50, 50]}, engine=bmc.Gibbs(), rng=0)
    posterior = bmc.infer(net, {"k": [3, 4, 50, 5]}, engine=bmc.Gibbs(10, 10), rng=0)
    assert posterior["p"].shape == (4, 10)
    net.add("t", lambda p: bmc.Truncated(bmc.Normal(p, 1.0), 0.0, totals / 10.0), plates="i")
    with pytest.raises(ZeroProbabilityError, match=r"'t' \(plate element 1\): 2.5.*from 0 to 1"):
        bmc.infer(net, {"t": [0.5, 2.5, 5.0, 0.5]}, engine=bmc.Gibbs(), rng=0)


def test_what_other_counts_allow_is_not_impossible() -> None:
    """Under so vague a rate all counts that were tried were 0, and what was seen was called impossible."""
    net = bmc.BayesNet(plates={"site": 20, "visit": 3})
    net.add("rate", bmc.Gamma(0.01, 0.01))
    net.add("p", bmc.Beta(1.0, 1.0))
    net.add("n", lambda rate: bmc.Poisson(rate), plates="site")
    net.add("y", lambda n, p: bmc.Binomial(n, p), plates=("site", "visit"))
    seen = np.random.default_rng(0).binomial(5, 0.4, (20, 3))
    for seed in range(4):
        with marking_invalid(), np.errstate(all="ignore"):
            target = target_of(pose(net, {"y": seen}))
            values = start_states(target, 4, np.random.default_rng(seed))
        assert (values["n"] >= seen.max(axis=1)).all()


def test_where_nothing_is_found_the_nearest_state_is_shown() -> None:
    net = bmc.BayesNet(plates={"i": 3})
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda x: bmc.Density(lambda y: np.where(y == 2, -np.inf, -x * x)), plates="i")
    with pytest.raises(
        ZeroProbabilityError, match=r"'y' \(plate element 1\).*1 of 3 elements.*x = .*start="
    ):
        bmc.infer(net, {"y": [0.0, 2.0, 1.0]}, engine=bmc.Gibbs(), rng=0)


# ---- the user's starts ---------------------------------------------------------------------------


def mixed() -> tuple[bmc.BayesNet, dict[str, Any]]:
    net = bmc.BayesNet(plates={"i": 3})
    net.add("m", bmc.Normal(0.0, 10.0))
    net.add("s", bmc.HalfNormal(1.0))
    net.add("c", bmc.Bernoulli(0.5), states=("no", "yes"))
    net.add("v", bmc.Normal(0.0, 1.0), plates="i")
    net.add("y", lambda m, s, c, v: bmc.Normal(m + (c == "yes") + v, s), plates="i")
    return net, {"y": [1.0, 2.0, 3.0]}


@pytest.mark.parametrize("engine", [bmc.Gibbs, bmc.MetropolisHastings])
def test_chains_start_where_the_user_says(engine: Any) -> None:
    net, evidence = mixed()
    each = np.arange(4.0)
    start = {"m": each, "s": 0.5, "c": ["no", "yes", "no", "yes"], "v": [0.1, 0.2, 0.3]}
    asked = engine(draws=1, warmup=0, start=start)
    problem = pose(net, evidence)
    sampler = asked.sampler(problem)
    asked.run(problem, np.random.SeedSequence(0))
    from_user = bmc.infer(net, evidence, engine=asked, rng=0)
    assert from_user["m"].shape == (4, 1)
    sampler.given = {"m": each}
    state = sampler.start(np.random.default_rng(0), 4)["values"]
    assert (state["m"].reshape(4, -1) == each[:, None]).all()
    each[:] = 9.0  # what the user passes in stays the user's
    assert asked.start["m"].tolist() == [0.0, 1.0, 2.0, 3.0]


def test_a_start_in_part_leaves_the_rest_to_draws() -> None:
    net, evidence = mixed()
    target = plan_of(pose(net, evidence)).target
    given = {"m": np.full(4, 2.0)}
    values = start_states(target, 4, np.random.default_rng(0), given)
    assert (values["m"] == 2.0).all() and len(np.unique(values["v"])) == 12


STARTS: dict[str, tuple[Any, Any]] = {
    "one number for all elements": ({"v": 0.5}, np.full((4, 3), 0.5)),
    "one for each element": ({"v": [1.0, 2.0, 3.0]}, np.tile([1.0, 2.0, 3.0], (4, 1))),
    "one for each chain": ({"v": np.arange(4.0)[:, None]}, np.arange(4.0)[:, None] * np.ones(3)),
    "a label": ({"c": "yes"}, np.ones(4)),
}


@pytest.mark.parametrize("what", STARTS)
def test_a_start_broadcasts(what: str) -> None:
    start, wanted = STARTS[what]
    found = read_start("Gibbs", pose(*mixed()), start, 4)
    (name,) = start
    assert found[name].tolist() == wanted.tolist()


def test_a_start_broadcasts_over_the_numbers_of_one_value() -> None:
    net = bmc.BayesNet(plates={"i": 2})
    net.add("p", bmc.Dirichlet(np.ones(4)), plates="i")
    net.add("y", lambda p: bmc.Categorical(p), plates="i")
    problem = pose(net, {"y": [0, 1]})
    assert (read_start("Gibbs", problem, {"p": 0.25}, 3)["p"] == np.full((3, 2, 4), 0.25)).all()
    one = [0.1, 0.2, 0.3, 0.4]
    assert read_start("Gibbs", problem, {"p": one}, 3)["p"].tolist() == [[one, one]] * 3
    with pytest.raises(EvidenceError, match="cannot be"):
        read_start("Gibbs", problem, {"p": 0.5}, 3)


BAD: dict[str, tuple[Any, type[Exception], str]] = {
    "unknown": ({"mm": 1.0}, UnknownNodeError, "start for 'mm'.*did you mean 'm'"),
    "observed": ({"y": [1.0, 2.0, 3.0]}, EvidenceError, "observed"),
    "support": ({"s": -1.0}, EvidenceError, "'s' is -1.0.*numbers >= 0"),
    "shape": ({"v": [1.0, 2.0]}, ShapeError, r"shape \(2,\); give \(3,\).*\(4, 3\)"),
    "label": ({"c": "maybe"}, EvidenceError, "'maybe' is not a state"),
    "nan": ({"v": [0.0, np.nan, 0.0]}, EvidenceError, "'v' is nan at index 1"),
    "no dict": (3, TypeError, r"Gibbs\(start=3\).*dict from node name"),
}


@pytest.mark.parametrize("name", BAD)
def test_starts_that_are_wrong(name: str) -> None:
    start, error, message = BAD[name]
    net, evidence = mixed()
    with pytest.raises(error, match=message):
        bmc.infer(net, evidence, engine=bmc.Gibbs(1, 0, start=start), rng=0)


def test_computed_nodes_have_no_start() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("d", lambda x: 2.0 * x)
    net.add("y", lambda d: bmc.Normal(d, 1.0))
    with pytest.raises(ModelError, match="'d' is deterministic"):
        bmc.infer(net, {"y": 1.0}, engine=bmc.Gibbs(1, 0, start={"d": 1.0}), rng=0)


def test_a_start_that_is_impossible_says_where() -> None:
    net = bmc.BayesNet()
    net.add("low", bmc.Normal(0.0, 1.0))
    net.add("y", lambda low: bmc.Uniform(low, low + 1.0))
    with pytest.raises(ZeroProbabilityError, match=r"'y' has probability zero.*low = 7"):
        bmc.infer(net, {"y": 0.5}, engine=bmc.Gibbs(1, 0, start={"low": 7.0}), rng=0)


def test_a_particle_engine_starts_its_static_nodes() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("s", bmc.LogNormal(0.0, 0.5))
    dbn.add("x", lambda x_prev, s: bmc.Normal(x_prev, s), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    engine = bmc.ParticleMetropolis(1, 0, 2, 20, start={"s": [40.0, 50.0]})
    posterior = bmc.infer(dbn, {"y": [0.2, 2.9, 0.4]}, engine=engine, rng=0)
    assert (posterior["s"] > 10.0).all()  # 7 standard deviations of the prior


# ---- labels of which some are known -------------------------------------------------------------


@pytest.mark.parametrize("is_scaled", [False, True])
def test_known_labels_say_which_component_is_which(is_scaled: bool) -> None:
    """Two of each are known among a hundred; chains that start the other way round stay so."""
    rng = np.random.default_rng(0)
    labels = np.arange(100) % 2
    rows = rng.normal(np.where(labels == 1, 4.0, -4.0), 1.0)
    net = bmc.BayesNet(plates={"i": 100, "k": 2})
    net.add("share", bmc.Beta(1.0, 1.0))
    net.add("scale", bmc.HalfNormal(2.0) if is_scaled else bmc.LogNormal(0.0, 0.01))
    net.add("mean", bmc.Normal(0.0, 10.0), plates="k")
    net.add("label", lambda share: bmc.Bernoulli(share), plates="i")
    net.add("y", lambda label, mean, scale: bmc.Normal(mean[label], scale), plates="i")
    seen = {"y": rows, "label": np.ma.masked_array(labels, np.arange(100) >= 4)}
    with marking_invalid(), np.errstate(all="ignore"):
        target = target_of(pose(net, seen))
        values = start_states(target, 64, np.random.default_rng(1))
    right = values["mean"][:, 0] < values["mean"][:, 1]
    assert right.mean() > 0.9  # a coin's 64 throws are so once in 10^11
    assert (values["label"][:, :4] == labels[:4]).all()
    agreed = (values["label"] == labels)[right].mean()
    assert agreed > 0.8  # and those that are missing follow
    posterior = bmc.infer(net, seen, engine=bmc.Gibbs(60, 40, 4), rng=2)
    assert (posterior["mean"].mean(axis=-2)[..., 0] < 0.0).all()


def ordered_rates() -> tuple[bmc.BayesNet, dict[str, Any], dict[str, Any]]:
    """Rates whose order none of the values that are tried by themselves has."""
    net = bmc.BayesNet(plates={"k": 9})
    net.add("rate", bmc.Uniform(0.0, 10.0), plates="k")

    @net.potential
    def order(rate: Any) -> Any:
        below = [rate[k] < rate[k + 1] for k in range(8)]
        return np.where(np.all(bmc.stack(below), axis=-1), 0.0, -np.inf)

    net.add("y", lambda rate: bmc.StudentT(4.0, rate, 0.5), plates="k")
    return net, {"y": [0.1, 1.2, 0.8, 2, 4, 3, 6, 9, 7.5]}, {"rate": np.arange(9) + 0.5}


@pytest.mark.skipif(not is_available(), reason="llvmlite is not installed")
def test_functions_are_compared_where_the_user_says_that_chains_start() -> None:
    net, evidence, start = ordered_rates()
    told = str(bmc.explain(net, evidence, engine=bmc.Gibbs(start=start)))
    assert "in machine code" in told
    assert "in machine code" not in str(bmc.explain(net, evidence, engine=bmc.Gibbs()))
    post = bmc.infer(net, evidence, engine=bmc.Gibbs(start=start, ess=400), rng=0)
    rates = np.asarray(post["rate"])
    assert (np.diff(rates, axis=-1) > 0).all()
    # a start for each chain, and one that is wrong, which the run names
    many = {"rate": np.tile(start["rate"], (4, 1))}
    bmc.infer(net, evidence, engine=bmc.Gibbs(draws=20, warmup=20, chains=4, start=many), rng=0)
    with pytest.raises(bmc.errors.EvidenceError, match="start for 'rate' is -1"):
        bmc.infer(net, evidence, engine=bmc.Gibbs(start={"rate": -1.0}), rng=0)
