"""Metropolis-Hastings: what proposals may be, the corrections they get, and the defaults.

Answers are compared with exact ones in standard errors of the posterior (``mcse``), at |z| < 4.5, some 50
comparisons: a false alarm with probability 4e-4 over all fixed seeds. Where the chain is finite, one step's
transition matrix is estimated from many chains started in every state.
"""

from __future__ import annotations

import pickle
import warnings
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.mcmc.metropolis import (
    LARGEST_BLOCK,
    MetropolisHastings,
    MetropolisSampler,
    plan_of,
)
from bayesmc.engines.mcmc.proposals import Independence, RandomWalk
from bayesmc.errors import (
    BroadcastError,
    ConvergenceWarning,
    DensityError,
    EvidenceError,
    ModelError,
    ParameterError,
    ShapeError,
    SupportWarning,
    UnknownNodeError,
    UnsupportedError,
)
from bayesmc.kernels.proposed import Proposed, ProposedBlock
from bayesmc.network import pose

LIMIT = 4.5


def ask(
    net: bmc.BayesNet, evidence: Any = None, proposal: Any = None, rng: int = 0, **options: Any
) -> Any:
    """A posterior; that chains as short as these may not have mixed is no news here.

    Draws are counted for 8 chains. Unless these are asked for, 32 of a quarter of the length give as
    many: a sweep costs much the same for 8 and for 32.
    """
    options = {"draws": 1000, "warmup": 300, **options}
    if "chains" not in options:
        options |= {"chains": 32, "draws": options["draws"] // 4}
    keep = options.pop("keep", "draws")
    engine = MetropolisHastings(proposal=proposal, **options)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        return bmc.infer(net, evidence, engine=engine, rng=rng, keep=keep)


def assert_mean(posterior: Any, name: str, exact: Any) -> None:
    z = (posterior.mean(name) - exact) / posterior.mcse(name)
    assert np.abs(z).max() < LIMIT, (name, posterior.mean(name), exact, z)


def gamma_net() -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"i": 3})
    net.add("rate", bmc.Gamma(2.0, 1.0), plates="i")
    net.add("n", lambda rate: bmc.Poisson(rate), plates="i")
    return net


SEEN = {"n": [0, 3, 12]}
EXACT = (2.0 + np.array(SEEN["n"])) / 2.0

PROPOSALS: dict[str, Any] = {
    "asymmetric": {"rate": lambda rate: bmc.LogNormal(np.log(rate), 0.6)},
    "drifting": {"rate": lambda rate, n: bmc.Gamma(2.0, 2.0 / (0.5 * rate + 0.5 * (n + 1.0)))},
    "outside the support": {"rate": lambda rate: bmc.Normal(rate, 1.5)},
    "whole plate": {("rate",): lambda rate: {"rate": bmc.LogNormal(np.log(rate.array), 0.4)}},
    "one vector": {
        ("rate",): lambda rate: bmc.MvNormal(
            rate.array + 0.05, scale_diag=np.array([0.4, 0.7, 1.0])
        )
    },
    "walk": {"rate": RandomWalk([1.0, 1.5, 2.5])},
    "walk of logs": {"rate": RandomWalk(0.7, unconstrained=True)},
    "adaptive walk": {"rate": RandomWalk(9.0, adaptive=True)},
    "walk of a tuple": {("rate",): RandomWalk(1.0)},
    "independent": {"rate": Independence(lambda n: bmc.Gamma(1.0 + n, 0.8))},
    "one distribution": {"rate": bmc.Gamma(1.0, 0.15)},
    "own density": {"rate": "prior"},
    "own densities": {("rate",): "prior"},
    "default": {},
}
SLOW = ("own density", "own densities", "independent")


@pytest.mark.parametrize("kind", PROPOSALS)
def test_proposals_are_corrected(kind: str) -> None:
    # these get stuck, and only long chains know their error
    slow = {"chains": 8, "draws": 2500 if "own" in kind else 1000}
    options = slow if kind in SLOW else {"draws": 1000}
    posterior = ask(gamma_net(), SEEN, PROPOSALS[kind], **options)
    assert_mean(posterior, "rate", EXACT)
    (rate,) = posterior.acceptance.values()
    assert rate.shape == (8 if kind in SLOW else 32,) and ((rate > 0.005) & (rate < 1)).all()


@pytest.mark.parametrize(
    ("kind", "kernel", "method"),
    [
        ("asymmetric", Proposed, "_backward"),
        ("drifting", Proposed, "_backward"),
        ("whole plate", ProposedBlock, "_log_density"),
        ("one vector", ProposedBlock, "_log_density"),
    ],
)
def test_a_missing_correction_is_caught(
    kind: str, kernel: type, method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Negative control: the proposal is taken for a symmetric one."""

    def symmetric(self: Any, values: Any, rng: Any) -> Any:
        new, dead, log = drawn(self, values, rng)
        return new, dead, 0.0 * log

    drawn = kernel._drawn  # type: ignore[attr-defined]
    monkeypatch.setattr(kernel, "_drawn", symmetric)
    monkeypatch.setattr(kernel, method, lambda self, *_: 0.0)
    posterior = ask(gamma_net(), SEEN, PROPOSALS[kind], draws=2000)
    z = (posterior.mean("rate") - EXACT) / posterior.mcse("rate")
    assert np.abs(z).max() > 6


def test_elements_are_accepted_one_by_one() -> None:
    posterior = ask(gamma_net(), SEEN, PROPOSALS["walk"], draws=200)
    moved = np.diff(posterior["rate"], axis=1) != 0
    assert (moved.any(axis=-1) & ~moved.all(axis=-1)).any()
    whole = ask(gamma_net(), SEEN, PROPOSALS["whole plate"], draws=200)
    moved = np.diff(whole["rate"], axis=1) != 0
    assert (moved.any(axis=-1) == moved.all(axis=-1)).all()


def test_elements_that_are_not_independent_move_in_turn() -> None:
    """y sees the sum of x: given y its elements depend on each other."""
    net = bmc.BayesNet(plates={"i": 2})
    net.add("x", bmc.Normal(0.0, 1.0), plates="i")
    net.add("y", lambda x: bmc.Normal(x.sum("i"), 0.5))
    posterior = ask(net, {"y": 3.0}, {"x": lambda x: bmc.Normal(x, 1.0)}, draws=2000)
    assert_mean(posterior, "x", [3.0 / 2.25] * 2)
    x = posterior["x"]
    product = (x[..., 0] * x[..., 1]).mean(axis=1)
    exact = (3.0 / 2.25) ** 2 - 1.0 / 2.25  # the posterior covariance is -1 / 2.25
    z = (product.mean() - exact) / (product.std(ddof=1) / np.sqrt(len(product)))
    assert abs(z) < LIMIT  # Student's t with 31 degrees of freedom: 1e-4


def test_a_joint_block_of_a_dict() -> None:
    net = bmc.BayesNet(plates={"i": 2})
    net.add("k", bmc.Categorical([0.2, 0.3, 0.5]))
    net.add("x", lambda k: bmc.Normal(1.0 * k, 1.0), plates="i")
    net.add("y", lambda x: bmc.Normal(x, 1.0), plates="i")
    evidence = {"x": [np.nan, 2.5], "y": [0.5, 1.0]}

    def block(k: Any, x: Any) -> dict[str, Any]:
        return {
            "k": bmc.Categorical(np.where(np.arange(3) == k[..., None], 0.2, 0.4)),
            "x": bmc.Normal(0.5 * x.array + 0.2, 1.0),
        }

    exact = bmc.infer(net, evidence, engine=bmc.Exact())
    posterior = ask(net, evidence, {("k", "x"): block}, draws=1500)
    assert_mean(posterior, "k", exact.mean("k"))
    z = (posterior.mean("x") - exact.mean("x"))[0] / posterior.mcse("x")[0]
    assert abs(z) < LIMIT
    assert (posterior["x"][..., 1] == 2.5).all()
    prior = ask(net, evidence, {("k", "x"): "prior"}, draws=1500)
    assert_mean(prior, "k", exact.mean("k"))


def test_labels_and_numeric_states() -> None:
    """Proposals speak the values of the support, 0, 1, ..."""
    net = bmc.BayesNet()
    net.add("c", bmc.Categorical([0.2, 0.5, 0.3]), states=("red", "green", "blue"))
    net.add("s", lambda c: bmc.Bernoulli(np.where(c == "red", 0.9, 0.3)), states=(-1, 1))
    net.add("y", lambda s: bmc.Normal(s, 1.0))

    def turn(c: Any) -> Any:
        return bmc.Categorical(np.where((c == "red")[..., None], [0.1, 0.6, 0.3], [0.5, 0.2, 0.3]))

    exact = bmc.infer(net, {"y": 0.4}, engine=bmc.Exact())
    proposal = {"c": turn, "s": bmc.Bernoulli(0.4)}
    for given in (proposal, {"c": "prior", "s": "prior"}, {}):
        posterior = ask(net, {"y": 0.4}, given)
        for name in ("c", "s"):
            found = posterior.probabilities(name)
            draws = posterior[name] if name == "s" else None
            assert np.abs(found - exact.probabilities(name)).max() < 0.05, (name, found)
            assert draws is None or set(np.unique(draws)) == {-1, 1}


def test_transition_matrices_keep_the_posterior() -> None:
    """One sweep from every state, by 40,000 chains each: the posterior is kept to 4.5 standard errors."""
    net = bmc.BayesNet()
    net.table("a", probs=[0.5, 0.2, 0.3])
    net.table("b", ["a"], [[0.7, 0.1, 0.2], [0.3, 0.3, 0.4], [0.05, 0.05, 0.9]])
    net.table("c", ["a", "b"], np.array([[[0.9, 0.1], [0.5, 0.5], [0.3, 0.7]]] * 3))
    exact = bmc.infer(net, {"c": 1}, engine=bmc.Exact()).probabilities("a", "b")

    def lazy(b: Any, a: Any) -> Any:  # not symmetric, and dependent on another node
        at = (np.asarray(b)[..., None] + np.asarray(a)[..., None] + np.arange(3)) % 3
        return bmc.Categorical(np.array([0.6, 0.3, 0.1])[at])

    for proposal in ({}, {"b": lazy}, {("a", "b"): "prior"}):
        plan = plan_of(pose(net, {"c": 1}), proposal, 4)
        sampler = MetropolisSampler(plan)
        rng, count = np.random.default_rng(0), 40_000
        a, b = (v.repeat(count).astype(np.uint8) for v in np.mgrid[:3, :3].reshape(2, -1))
        values = {**plan.target.known, "a": a, "b": b}
        with marking_invalid(), np.errstate(all="ignore"):
            memory = [k.start(values, len(a)) for k in plan.kernels]
            state = {"values": {"a": a, "b": b}, "memory": memory, "sweep": 0, "chains": len(a)}
            state = sampler.step(state, rng, False)
        moved = 3 * state["values"]["a"].astype(int) + state["values"]["b"]
        matrix = np.stack([np.bincount(row, minlength=9) / count for row in moved.reshape(9, -1)])
        pi = exact.ravel()
        error = np.sqrt((pi[:, None] ** 2 * matrix * (1 - matrix)).sum(axis=0) / count)
        assert (np.abs(pi @ matrix - pi) < 4.5 * error).all(), proposal
        assert (np.diag(matrix) < 0.999).all()


def test_integers_walk() -> None:
    net = bmc.BayesNet()
    net.add("n", bmc.Poisson(6.0))
    net.add("k", lambda n: bmc.Binomial(n, 0.5))
    posterior = ask(net, {"k": 4}, {"n": RandomWalk(3)}, draws=2000)
    assert_mean(posterior, "n", 4.0 + 3.0)  # what was missed is Poisson(3)
    assert (np.abs(np.diff(posterior["n"], axis=1)) <= 3).all()


def test_factor_graphs() -> None:
    """Variables have no density of their own; what proposes from it is refused."""
    graph = bmc.FactorGraph()
    graph.variable("x", "positive")
    graph.variable("s", 3)
    graph.factor(lambda x, s: -((x - s) ** 2) - 0.5 * x, scope=("x", "s"))
    x, s = np.meshgrid(np.linspace(1e-4, 9.0, 4001), np.arange(3.0))
    weight = np.exp(-((x - s) ** 2) - 0.5 * x)
    for proposal in ({}, {"x": RandomWalk(1.0)}, {"x": bmc.Exponential(1.0), "s": "prior"}):
        if "s" in proposal:
            with pytest.raises(ModelError, match="variable of a factor graph"):
                ask(graph, {}, proposal)
            proposal = {"x": bmc.Exponential(1.0)}
        posterior = ask(graph, {}, proposal)
        assert_mean(posterior, "x", (weight * x).sum() / weight.sum())
        assert_mean(posterior, "s", (weight * s).sum() / weight.sum())


# ---- defaults -----------------------------------------------------------------------------------


def hybrid() -> tuple[bmc.BayesNet, dict[str, Any]]:
    net = bmc.BayesNet(plates={"i": 4})
    net.add("z", bmc.Bernoulli(0.4), plates="i")
    net.add("m", bmc.Normal(0.0, 2.0))
    net.add("x", lambda m, z: bmc.Normal(m + 2.0 * z, 1.0), plates="i")
    net.add("y", lambda x: bmc.Normal(x, 0.5), plates="i")
    net.add("later", lambda x: bmc.Normal(x, 1.0), plates="i")
    return net, {"y": [0.1, 2.3, np.nan, 1.2]}


def test_discrete_and_continuous_nodes_together() -> None:
    net, evidence = hybrid()
    exact = bmc.infer(net, evidence, engine=bmc.Exact())
    posterior = ask(net, evidence, draws=1500)
    assert posterior.ensemble_size == 12
    for name in ("m", "x", "y", "later"):
        free = 2 if name == "y" else ...
        z = (posterior.mean(name) - exact.mean(name))[free] / posterior.mcse(name)[free]
        assert np.abs(z).max() < LIMIT, (name, z)
    z = (posterior.mean("z") - exact.probabilities("z")[:, 1]) / posterior.mcse("z")
    assert np.abs(z).max() < LIMIT


def test_members_of_an_ensemble_take_turns() -> None:
    """Draw t of a chain is member t mod their number."""
    net, evidence = hybrid()
    engine = MetropolisHastings(draws=24, warmup=0, chains=2, thinning=2)
    sampler = engine.sampler(pose(net, evidence))
    rng = np.random.default_rng(0)
    state = sampler.end_warmup(sampler.start(rng, 2))
    for t in range(24):
        for _ in range(2):
            state = sampler.step(state, rng, False)
        values = sampler.values(state, rng)
        member = t % sampler.ensemble
        expected = state["values"]["m"].reshape(2, -1)[:, member]
        assert np.array_equal(values["m"], expected)
        assert values["later"].shape == (2, 4)


def test_members_that_start_far_out_are_brought_back() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Cauchy(0.0, 1e5))
    net.add("s", bmc.HalfCauchy(10.0))
    net.add("y", lambda x, s: bmc.Normal(x, 1.0 + 0.0 * s))
    posterior = ask(net, {"y": 1.0}, warmup=500)
    assert_mean(posterior, "x", 1.0)
    assert abs(posterior.std("x") - 1.0) < 0.1


@pytest.mark.parametrize(
    "engine", [MetropolisHastings(), bmc.Gibbs(warmup=100)], ids=["MH", "Gibbs"]
)
@pytest.mark.parametrize(
    ("reading", "y", "deviation"),
    [(np.sin, 0.1, 0.3), (lambda h: 1.0 * h, 1.0, 1.0)],
    ids=["its sine", "read as a number"],
)
def test_a_heading_near_the_cut(reading: Any, y: float, deviation: float, engine: Any) -> None:
    """Options are the default ones; exact is a sum over the circle."""
    prior = bmc.VonMises(np.pi, 4.0)
    net = bmc.BayesNet()
    net.add("h", prior)
    net.add("y", lambda h: bmc.Normal(reading(h), deviation))
    posterior = bmc.infer(net, {"y": y}, engine=engine, rng=0)
    turn = (np.arange(20_000) + 0.5) * 2 * np.pi / 20_000 - np.pi
    log = prior.log_prob(turn) - 0.5 * ((y - reading(turn)) / deviation) ** 2
    weight = np.exp(log - log.max()) / np.exp(log - log.max()).sum()
    for ask_for in (lambda h: np.cos(h), lambda h: np.sin(h), lambda h: np.cos(2 * h)):
        error = posterior.mcse(ask_for)
        assert abs(posterior.expectation(ask_for) - weight @ ask_for(turn)) < LIMIT * error
        assert error < 0.05


def test_many_numbers_walk_by_node() -> None:
    size = LARGEST_BLOCK + 1
    net = bmc.BayesNet(plates={"i": size})
    net.add("x", bmc.Normal(0.0, 1.0), plates="i")
    net.add("y", lambda x: bmc.Normal(x, 1.0), plates="i")
    y = np.linspace(-3.0, 3.0, size)
    posterior = ask(net, {"y": y}, chains=4, draws=1000)
    z = (posterior.mean("x") - y / 2) / posterior.mcse("x")
    assert np.abs(z).max() < 5.5 and posterior.ensemble_size == 1
    described = MetropolisHastings().describe(pose(net, {"y": y}))
    assert "201 continuous numbers are too many" in described["x"]


def test_what_nothing_observed_depends_on_is_drawn_forward() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.3))
    net.add("x", lambda a: bmc.Normal(a, 1.0))
    posterior = ask(net, draws=4000)
    assert posterior.acceptance == {}
    # 32,000 independent draws
    assert abs(posterior.mean("x") - 0.3) < 4.5 * np.sqrt(1.21 / 32_000)
    assert len(np.unique(posterior["x"])) == 32_000  # of every chain its own


def test_a_proposal_puts_a_node_into_the_chain() -> None:
    """The lecture's example has no evidence: two modes, and walks of three widths."""
    net = bmc.BayesNet()
    net.add("x", bmc.Mixture([0.3, 0.7], bmc.Normal([0.0, 10.0], [1.0, 1.0])))
    rates = []
    for width in (1.0, 8.0, 500.0):
        posterior = ask(net, proposal={"x": RandomWalk(width)}, draws=2000)
        rates.append(posterior.acceptance["x"].mean())
        if width == 8.0:
            assert_mean(posterior, "x", 7.0)
    assert 0.6 < rates[0] < 0.8 and 0.15 < rates[1] < 0.3 and rates[2] < 0.01


def test_a_density_without_a_sampler_needs_no_evidence() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Density(lambda x: -(np.abs(x) ** 3)))
    net.add("y", lambda x: bmc.Normal(x, 1.0))
    posterior = ask(net, draws=4000)
    grid = np.linspace(-5, 5, 4001)
    weight = np.exp(-(np.abs(grid) ** 3))
    assert_mean(posterior, "x", 0.0)
    exact = (weight @ grid**2) / weight.sum()
    assert abs(posterior.var("x") - exact) < 0.02


# ---- what the loop asks of a sampler ------------------------------------------------------------


@pytest.mark.parametrize("keep", ["draws", "summaries"])
def test_going_on_is_the_same_as_never_stopping(keep: str) -> None:
    net, evidence = hybrid()
    one = ask(net, evidence, draws=50, warmup=40, chains=8, keep=keep)
    engine = MetropolisHastings(30, 40, 8)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        for earlier in (one, pickle.loads(pickle.dumps(one))):
            more = bmc.infer(net, evidence, engine=engine, keep=keep, resume=earlier)
            whole = ask(net, evidence, draws=80, warmup=40, chains=8, keep=keep)
            for name in ("m", "x", "z", "later"):
                assert np.array_equal(more.mean(name), whole.mean(name))
            for block, rate in whole.acceptance.items():
                assert np.array_equal(more.acceptance[block], rate)


def test_options() -> None:
    walk = {"x": RandomWalk([1.0, 2.0]), ("a", "b"): "prior"}
    engine = MetropolisHastings(10, 5, 2, proposal=walk)
    assert engine.continues(MetropolisHastings(99, 5, 2, proposal=dict(walk)))
    assert not engine.continues(MetropolisHastings(10, 5, 2))
    assert not engine.continues(MetropolisHastings(10, 6, 2, proposal=walk))
    assert not engine.continues(
        MetropolisHastings(10, 5, 2, proposal={**walk, "x": RandomWalk(1.0)})
    )
    assert "RandomWalk([1.0, 2.0])" in repr(engine) and "'prior'" in repr(engine)
    walk["x"] = "prior"  # the engine has its own copy
    assert isinstance(engine.proposal["x"], RandomWalk)  # type: ignore[index]
    lost = pickle.loads(
        pickle.dumps(MetropolisHastings(proposal={"x": lambda x: bmc.Normal(x, 1.0)}))
    )
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    with pytest.raises(UnsupportedError, match="give it anew"):
        bmc.infer(net, engine=lost)


def test_what_is_said_about_the_nodes() -> None:
    net, evidence = hybrid()
    said = MetropolisHastings(proposal={"z": "prior"}).describe(pose(net, evidence))
    assert said["z"].startswith("proposed from its own density")
    assert "ensembles of 12" in said["m"] and "'x'" in said["m"]
    assert said["later"].startswith("drawn forward")


# ---- what is wrong is said ----------------------------------------------------------------------


def chain_net() -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"i": 3})
    net.input("u")
    net.add("s", bmc.HalfNormal(1.0))
    net.add("w", bmc.Dirichlet([1.0, 1.0]))
    net.add("x", lambda s: bmc.Normal(0.0, s), plates="i")
    net.add("c", bmc.Bernoulli(0.5), states=("no", "yes"))
    net.add("double", lambda s: 2.0 * s)
    net.add("y", lambda x, c, w: bmc.Normal(x + (c == "yes") + w[..., 0], 1.0), plates="i")
    return net


FAULTS: dict[str, tuple[Any, type[Exception], str]] = {
    "unknown node": ({"q": "prior"}, UnknownNodeError, "'q'"),
    "observed": ({"y": "prior"}, EvidenceError, "observed"),
    "deterministic": ({"double": "prior"}, ModelError, "never drawn"),
    "input": ({"u": "prior"}, ModelError, "an input"),
    "unknown argument": ({"s": lambda q: bmc.Normal(q, 1.0)}, UnknownNodeError, "argument 'q'"),
    "starred": ({"s": lambda *a: bmc.Normal(0.0, 1.0)}, ModelError, "refused"),
    "overlap": ({"s": "prior", ("s", "x"): "prior"}, ModelError, "two proposals"),
    "array": ({"s": lambda s: s + 1.0}, ModelError, "returns an array"),
    "kind": ({"s": lambda s: bmc.Poisson(s)}, ModelError, "continuous"),
    "shape": ({"s": lambda s: bmc.MvNormal(np.zeros(2), np.eye(2))}, ShapeError, r"shape \(2,\)"),
    "batch": ({"s": lambda s: bmc.Normal(np.zeros(7), 1.0)}, ShapeError, "batch shape"),
    "parameter": ({"s": lambda s: bmc.Normal(s, -1.0)}, ParameterError, "positive"),
    "vector": ({("s", "x"): lambda s: bmc.MvNormal(np.zeros(2), np.eye(2))}, ShapeError, "4 comp"),
    "dict": ({("s", "x"): lambda: {"s": bmc.Normal(0.0, 1.0)}}, ModelError, "one for each"),
    "not one": ({("s", "x"): lambda: {"s": 1.0, "x": 2.0}}, ModelError, "return a distribution"),
    "simplex": ({"w": RandomWalk(0.1)}, ModelError, "unconstrained=True"),
    "labels": ({"c": RandomWalk(1.0)}, ModelError, "without an order"),
    "independence": (
        {"s": Independence(lambda s: bmc.Normal(s, 1.0))},
        ModelError,
        "Independence proposal names 's'",
    ),
    "mixing": (
        {"x": lambda x: bmc.Normal(x.mean(axis=-1, keepdims=True), 1.0)},
        BroadcastError,
        r"\('x',\)",
    ),
    "own draws": (
        {"s": bmc.Density(lambda x: np.where(x > 1, 0.0, -np.inf), lambda rng, n: rng.random(n))},
        DensityError,
        "own draws",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_name_the_proposal(fault: str) -> None:
    proposal, error, message = FAULTS[fault]
    with pytest.raises(error, match=message) as raised, warnings.catch_warnings():
        warnings.simplefilter("ignore", SupportWarning)
        engine = MetropolisHastings(10, 5, 2, proposal=proposal)
        bmc.infer(chain_net(), {"y": [0.1, 0.2, 0.3]}, inputs={"u": 1.0}, engine=engine, rng=0)
    assert "MetropolisHastings" in str(raised.value)


@pytest.mark.parametrize("bad", [["x"], {1: "prior"}, {(): "prior"}, {"x": "own"}, {"x": 3.0}])
def test_what_can_be_no_proposal_raises_at_once(bad: Any) -> None:
    with pytest.raises(TypeError, match="MetropolisHastings"):
        MetropolisHastings(proposal=bad)


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan, "wide", [1.0, 0.0]])
def test_scales_are_positive(scale: Any) -> None:
    with pytest.raises(ValueError, match="positive number"):
        RandomWalk(scale)


def test_a_proposal_that_never_gets_somewhere_warns() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda x: bmc.Normal(x, 1.0))
    with pytest.warns(SupportWarning, match="never gives"):
        ask(net, {"y": 1.0}, {"x": bmc.Gamma(1.0, 1.0)}, draws=10)
    with warnings.catch_warnings():  # a walk gets there step by step: nothing to warn about
        warnings.simplefilter("error", SupportWarning)
        ask(net, {"y": 1.0}, {"x": lambda x: bmc.Uniform(x - 1.0, x + 1.0)}, draws=10)


def test_a_nan_density_names_the_node_and_the_iteration() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda x: bmc.Density(lambda y: np.where(x > 1.2, np.nan, -x)))
    with pytest.raises(DensityError, match=r"node 'y'.*nan.*at iteration \d+"):
        ask(net, {"y": 0.0}, {"x": RandomWalk(0.5)}, chains=2)
