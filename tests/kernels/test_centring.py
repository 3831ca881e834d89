"""Effects moved apart from their scale: the maps, which is learnt, and posteriors that funnels had spoilt."""

from __future__ import annotations

import pickle
import warnings
from typing import Any

import numpy as np
import pytest
from scipy import stats

import bayesmc as bmc
from bayesmc.kernels import centring
from bayesmc.kernels.hamiltonian import Hamiltonian
from bayesmc.network import pose
from bayesmc.structure.centring import Centred, Effects
from bayesmc.structure.free_density import UnconstrainedDensity
from bayesmc.structure.target import target_of
from bayesmc.structure.unconstrained import unconstrained_density


def funnel() -> bmc.BayesNet:
    """Neal's: nothing is seen that tells of ``v`` or of the effects."""
    net = bmc.BayesNet(plates={"i": 9})
    net.add("v", bmc.Normal(0.0, 3.0))
    net.add("x", lambda v: bmc.Normal(0.0, np.exp(v / 2)), plates="i")
    net.add("y", lambda x: bmc.Normal(0.0 * x, 1.0), plates="i")
    return net


def schools(family: Any = bmc.Normal) -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"school": 8})
    net.input("error", plates="school")
    net.add("mu", bmc.Normal(0.0, 5.0))
    net.add("tau", bmc.HalfCauchy(5.0))
    net.add("theta", lambda mu, tau: family(loc=mu, scale=tau), plates="school")
    net.add("y", lambda theta, error: bmc.Normal(theta, error), plates="school")
    return net


ERRORS = {"error": [15.0, 10.0, 16.0, 11.0, 9.0, 11.0, 10.0, 18.0]}
SEEN = {"y": [28.0, 8.0, -3.0, 7.0, -1.0, 1.0, 18.0, 12.0]}


def pairs(kind: str) -> bmc.BayesNet:
    """Vectors of two effects of each group, by one way or the other of giving their covariance."""
    net = bmc.BayesNet(plates={"group": 3, "row": 6})
    net.add("mu", bmc.MvNormal([0.0, 1.0], scale_diag=[1.0, 1.0]))
    net.add("sd", bmc.Joint(bmc.Exponential(1.0), bmc.Exponential(1.0)))
    ways = {
        "cov": lambda sd: {"cov": sd[..., :, None] * np.array([[1, 0.5], [0.5, 1]]) * sd[..., None, :]},
        "scale_tril": lambda sd: {"scale_tril": sd[..., :, None] * np.array([[1, 0], [0.6, 0.8]])},
        "scale_diag": lambda sd: {"scale_diag": sd},
    }  # fmt: skip
    net.add("effect", lambda mu, sd: bmc.MvNormal(mu, **ways[kind](sd)), plates="group")
    at = np.arange(6) % 3
    net.add("y", lambda effect: bmc.Poisson(np.exp(effect.array[..., 0, at, 0])), plates="row")
    return net


def made(
    net: bmc.BayesNet, evidence: Any, inputs: Any = None, shares: Any = None
) -> UnconstrainedDensity:
    return unconstrained_density(target_of(pose(net, evidence, inputs=inputs)), shares=shares)  # fmt: skip


PART = {**SEEN, "theta": [np.nan, 3.0, np.nan, np.nan, 5.0, np.nan, np.nan, np.nan]}
WAYS = ("cov", "scale_tril", "scale_diag")
CASES: dict[str, tuple[Any, Any, Any]] = {
    "normal": (schools, SEEN, ERRORS),
    "seen in part": (schools, PART, ERRORS),
    "heavy tails": (lambda: schools(lambda loc, scale: bmc.StudentT(4.0, loc, scale)), SEEN, ERRORS),
    **{k: (lambda k=k: pairs(k), {"y": [1, 0, 3, 2, 1, 4]}, None) for k in WAYS},
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_a_recentred_density_is_the_same(name: str) -> None:
    make, evidence, inputs = CASES[name]
    net = make()
    plain, rng = made(net, evidence, inputs), np.random.default_rng(1)
    effects, shares = Effects(plain), np.ones(plain.size)
    assert effects.at.size == (6 if name in ("seen in part",) or not inputs else 8)
    shares[effects.at] = rng.choice([0.0, 0.25, 0.5, 1.0], effects.at.size)
    other = made(net, evidence, inputs, shares)
    u = rng.normal(size=(5, plain.size))
    values = plain.constrain(u)
    v = other.unconstrain(values)
    back = other.constrain(v)
    for node in values:
        np.testing.assert_allclose(back[node], values[node], rtol=1e-9, atol=1e-12)
    densities = [d.value(a) - d.log_volume(a) for d, a in ((plain, u), (other, v))]
    np.testing.assert_allclose(densities[0], densities[1], rtol=1e-10)
    slopes = other.with_gradient(v)[1]
    for k in range(plain.size):
        step = 1e-5 * np.eye(plain.size)[k]
        slope = (other.value(v + step) - other.value(v - step)) / 2e-5
        np.testing.assert_allclose(slopes[:, k], slope, rtol=1e-5, atol=1e-5)


def test_the_volume_is_that_of_the_map() -> None:
    loc, scale, share = np.array([1.0, -2.0]), np.array([0.5, 3.0]), np.array([0.25, 0.0])
    transform, u = Centred((), loc, scale, share), np.array([0.3, -1.0])
    up, down = transform.constrain(u + 1e-6), transform.constrain(u - 1e-6)
    np.testing.assert_allclose(
        transform.log_abs_det_jacobian(u), np.log((up - down) / 2e-6), rtol=1e-6
    )
    np.testing.assert_allclose(transform.unconstrain(transform.constrain(u)), u, rtol=1e-12)
    z = Centred((), loc, scale, np.zeros(2)).unconstrain(loc + scale)
    np.testing.assert_allclose(z, 1.0)


@pytest.mark.parametrize(
    "net",
    [
        lambda: bmc.Normal(0.0, 1.0),  # no scale that moves
        lambda sd: bmc.LogNormal(0.0, sd),  # not on the whole line
        lambda sd: bmc.Truncated(bmc.Normal(0.0, sd), 0.0, np.inf),
    ],
)
def test_others_are_left_as_they_are(net: Any) -> None:
    found = bmc.BayesNet(plates={"i": 4})
    found.add("sd", bmc.Exponential(1.0))
    found.add("x", net, plates="i")
    found.add("y", lambda x, sd: bmc.Laplace(x, sd), plates="i")
    assert not Effects(made(found, {"y": np.ones(4)})).at.size


# ---- what is learnt ----------------------------------------------------------------------------------


def shares_of(scale_sd: float, width: float, now: float = 1.0, draws: int = 200) -> np.ndarray:
    """Of an effect known to ``width``, under a scale known to a factor ``exp(scale_sd)``."""
    rng, learning = np.random.default_rng(0), centring.Centring()
    memory = learning.start(1)
    for _ in range(draws):
        scale = np.exp(scale_sd * rng.normal(size=(4, 1)))
        tight = 1 / (1 / width**2 + 1 / scale**2)  # given the scale, of a reading of 0
        x = np.sqrt(tight) * rng.normal(size=(4, 1))
        memory = learning.seen(memory, x, np.zeros((4, 1)), scale)
    return learning.found(memory, np.full(1, now))


def test_shares_go_with_what_readings_tell() -> None:
    assert shares_of(1.0, 100.0) == 0.0
    assert shares_of(1.0, 0.01) == 1.0
    assert shares_of(1.0, 0.01, now=0.0) == 1.0
    assert shares_of(2.0, 2.0) == 0.25
    assert shares_of(0.02, 100.0) == 1.0  # hardly better: left
    assert shares_of(1.0, 100.0, draws=10) == 1.0  # too few draws to tell


# ---- posteriors --------------------------------------------------------------------------------------


def spread(seed: int, **options: Any) -> tuple[np.ndarray, int]:
    """Standardised mean and quantiles of Neal's v, and how many trajectories diverged."""
    engine = bmc.HamiltonianMonteCarlo(draws=500, warmup=500, chains=16, **options)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        post = bmc.infer(funnel(), {"y": np.zeros(9)}, engine=engine, rng=seed)
    z = [post.mean("v") / post.mcse("v")]
    for q in (0.05, 0.95):
        below = post.expectation(lambda v, q=q: v < stats.norm.ppf(q, 0, 3))
        error = np.sqrt(q * (1 - q) / post.ess("v"))
        z.append((below - q) / error)
    return np.array(z, float), int(post.divergences.sum())


def test_a_funnel_is_explored_to_its_ends() -> None:
    # false-alarm rate 1e-3 for the mean and two tails of v
    z, diverged = spread(1)
    assert np.abs(z).max() < stats.norm.isf(1e-3 / 6), z
    assert diverged < 40  # of 8000


def test_without_it_the_neck_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(centring, "_FEW", np.inf)
    z, diverged = spread(1)
    assert diverged > 80 or np.abs(z).max() > stats.norm.isf(1e-3 / 6)


def test_a_volume_left_out_shows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Centred, "log_det_formula", lambda self, u: self._summed(0.0 * u))
    z, _ = spread(1)
    assert np.abs(z).max() > stats.norm.isf(1e-3 / 6)


def test_schools_as_published() -> None:
    # posteriordb, eight_schools-eight_schools_centered: mu 4.42 +- 3.31, tau 3.58 +- 3.17 (10,000 draws)
    # false-alarm rate 1e-3 for both means
    post = bmc.infer(
        schools(), SEEN, inputs=ERRORS, engine=bmc.HamiltonianMonteCarlo(ess=2000), rng=5
    )
    for name, mean, sd in (("mu", 4.42, 3.31), ("tau", 3.58, 3.17)):
        error = np.hypot(post.mcse(name), sd / 100)
        assert abs(post.mean(name) - mean) / error < stats.norm.isf(1e-3 / 4)
    assert post.divergences.mean() < 1e-3


def test_a_run_that_is_taken_up_again_is_the_same() -> None:
    def kernel() -> Hamiltonian:
        found = Hamiltonian(made(funnel(), {"y": np.zeros(9)}), warmup=300)
        found.expect(300, 8)
        return found

    def run(moving: Hamiltonian, state: tuple[Any, Any], rng: Any, sweeps: int) -> tuple[Any, Any]:
        values, memory = state
        for _ in range(sweeps):
            values, memory = moving.step(values, memory, rng, warmup=True)
        return values, memory

    values = {"v": np.zeros(8), "x": np.random.default_rng(3).normal(size=(8, 9))}
    first, rng = kernel(), np.random.default_rng(4)
    state = run(first, (values, first.start(values, 8)), rng, 200)
    assert (state[1]["shares"] != 1).any()
    kept = pickle.loads(pickle.dumps((state, rng)))
    whole = run(first, state, rng, 60)[0]
    again = run(kernel(), *kept, 60)[0]
    for name in whole:
        np.testing.assert_array_equal(again[name], whole[name])
    # the same kernel serves a run that has not come so far
    fresh = first.step(values, first.start(values, 8), np.random.default_rng(7), warmup=True)[0]
    other = kernel()
    wanted = other.step(values, other.start(values, 8), np.random.default_rng(7), warmup=True)[0]
    np.testing.assert_array_equal(fresh["v"], wanted["v"])


def labelled() -> bmc.BayesNet:
    """Effects of eight groups, each with a label that says which of two laws its readings follow."""
    net = bmc.BayesNet(plates={"group": 8})
    net.add("sd", bmc.HalfNormal(1.0))
    net.add("effect", lambda sd: bmc.Normal(0.0, sd), plates="group")
    net.add("kind", bmc.Bernoulli(0.4), plates="group")
    net.add("y", lambda effect, kind: bmc.StudentT(5.0, effect + 3.0 * kind, 0.7), plates="group")
    return net


READ = {"y": [0.1, 2.2, -0.4, 1.6, 3.4, 0.9, 1.4, 2.6]}


def of_first_label() -> float:
    """P(kind[1] = 1 | y), by sums over a lattice of scales and effects."""
    sd, effect = np.linspace(0.004, 5.0, 500)[:, None], np.linspace(-9.0, 9.0, 3001)
    prior = stats.norm.pdf(effect, 0.0, sd)
    like = {k: stats.t.pdf(np.array(READ["y"])[:, None], 5, effect + 3.0 * k, 0.7) for k in (0, 1)}
    each = {k: p * like[k] @ prior.T for k, p in ((0, 0.6), (1, 0.4))}  # (groups, scales)
    weights = np.exp(-0.5 * sd[:, 0] ** 2) * np.prod(each[0] + each[1], axis=0)
    return float((weights * each[1][1] / (each[0][1] + each[1][1])).sum() / weights.sum())


def label_run() -> tuple[float, float]:
    """How far the probability of a label is from exact, in standard errors; labels unlike their effects."""
    engine = bmc.HamiltonianMonteCarlo(2000, warmup=500, chains=8, marginalize=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        post = bmc.infer(labelled(), READ, engine=engine, rng=1)
    (memory,) = [m for m in post.checkpoint.state["memory"] if "shares" in m]
    assert (memory["shares"] != 1).any()
    found, exact = post.probabilities("kind")[1, 1], of_first_label()
    error = np.sqrt(exact * (1 - exact) / np.min(post.ess("kind")[1]))
    own = (np.asarray(post["kind"]) == 1)[..., 1] != (np.asarray(post["effect"])[..., 1] < 0.7)
    return abs(found - exact) / error, float(own.mean())


def test_labels_that_are_summed_out_go_with_effects_that_are_moved() -> None:
    # false-alarm rate 1e-3
    z, unlike = label_run()
    assert z < stats.norm.isf(5e-4)
    assert unlike < 0.25  # each label goes with the effect of its own draw


def test_labels_drawn_given_other_numbers_show(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Hamiltonian, "apart", lambda self, memory: frozenset())
    z, unlike = label_run()
    assert z > stats.norm.isf(5e-4) or unlike > 0.25
