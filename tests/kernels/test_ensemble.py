"""Blocks that move as one, by Gaussian steps and by differences of an ensemble.

Comparisons with exact posteriors are by means of 32 or more independent ensembles, in standard errors of
their own spread: |z| < 4.5 in some 70 of them, a false alarm with probability 5e-4 over all fixed seeds.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

import bayesmc as bmc
from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.mcmc.starts import start_states
from bayesmc.kernels.adaptation import Steps
from bayesmc.kernels.densities import Block
from bayesmc.kernels.ensemble import BlockWalk, stragglers
from bayesmc.kernels.random_walk import parts_of
from bayesmc.network import pose
from bayesmc.robotics import AndAngle, PoseNormal
from bayesmc.structure.target import Target, target_of
from bayesmc.testing import JointModel, rank_test

LIMIT = 4.5


def draws_of(
    target: Target,
    names: list[str],
    members: int,
    ensembles: int = 32,
    warmup: int = 250,
    draws: int = 250,
    kind: type[BlockWalk] = BlockWalk,
    **options: Any,
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Draws of every node, (draw, ensemble, member, ...), and the acceptance rates of all members."""
    kernel = kind(target, names, members, **options)
    rng = np.random.default_rng(0)
    found: dict[str, list[np.ndarray]] = {name: [] for name in (*names, *target.links)}
    with marking_invalid(), np.errstate(all="ignore"):
        values = start_states(target, members * ensembles, rng)
        memory = kernel.start(values, members * ensembles)
        for t in range(warmup + draws):
            if t == warmup:
                memory = kernel.end_warmup(memory)
            new, memory = kernel.step(values, memory, rng, t < warmup)
            values = {**values, **new}
            target.refresh(values, kernel.names)
            if t >= warmup:
                for name, kept in found.items():
                    kept.append(values[name].reshape(ensembles, members, *values[name].shape[1:]))
    return {n: np.array(v) for n, v in found.items()}, kernel.acceptance(memory)  # type: ignore[return-value]


def z_scores(draws: np.ndarray, exact: Any) -> np.ndarray:
    """Mean minus the exact one, in standard errors from independent ensembles."""
    means = draws.mean(axis=(0, 2))
    return (means.mean(axis=0) - exact) / (means.std(axis=0, ddof=1) / np.sqrt(len(means)))


def regression() -> tuple[bmc.BayesNet, dict[str, Any], np.ndarray, np.ndarray]:
    """Three correlated coefficients, with the exact mean and covariance of their posterior."""
    rng = np.random.default_rng(5)
    x = rng.normal(size=(20, 3)) @ np.array([[1.0, 0.9, 0.0], [0.0, 0.4, 0.0], [0.0, 0.0, 3.0]])
    y = x @ [1.0, -2.0, 0.5] + rng.normal(size=20)
    net = bmc.BayesNet(plates={"row": 20})
    net.add("a", bmc.Normal(0.0, 2.0))
    net.add("b", bmc.MvNormal(np.zeros(2), np.eye(2) * 4.0))
    net.add("y", lambda a, b: bmc.Normal(a * x[:, 0] + np.vecdot(x[:, 1:], b), 1.0), plates="row")
    cov = np.linalg.inv(np.eye(3) / 4.0 + x.T @ x)
    return net, {"y": y}, cov @ x.T @ y, cov


@pytest.mark.parametrize("members", [1, 4, 16])
def test_gaussian_posterior(members: int) -> None:
    net, evidence, mean, cov = regression()
    target = target_of(pose(net, evidence))
    found, rate = draws_of(target, ["a", "b"], members)
    draws = np.concatenate([found["a"][..., None], found["b"]], axis=-1)
    away = draws - mean
    assert np.abs(z_scores(draws, mean)).max() < LIMIT
    assert np.abs(z_scores(away[..., :, None] * away[..., None, :], cov)).max() < LIMIT
    assert 0.15 < rate.mean() < 0.5


def test_kept_densities_are_those_of_the_state() -> None:
    """Alone, a block keeps its densities: the same chain, draw for draw, as when they are made anew."""
    net, evidence, _, _ = regression()
    target = target_of(pose(net, evidence))
    kept, _ = draws_of(target, ["a", "b"], 4, 2, 30, 30, alone=True)
    anew, _ = draws_of(target, ["a", "b"], 4, 2, 30, 30)
    assert np.allclose(kept["b"], anew["b"])


def test_bounds_and_links_within_a_block() -> None:
    """0 < x < b with b ~ Beta: x / b is uniform given b; the observed link ties them."""
    net = bmc.BayesNet()
    net.add("b", bmc.Beta(2.0, 2.0))
    net.add("x", lambda b: bmc.Uniform(0.0, b))
    net.add("log_share", lambda x, b: np.log(x / b))
    net.add("y", lambda log_share: bmc.Exponential(np.exp(2.0 * log_share)))
    found, _ = draws_of(target_of(pose(net, {"y": 1.0})), ["b", "x"], 6)
    assert (found["x"] < found["b"]).all()
    share = found["x"] / found["b"]
    grid = np.linspace(0.0, 1.0, 20001)
    weight = grid**2 * np.exp(-(grid**2))
    assert abs(z_scores(share, (weight @ grid) / weight.sum())) < LIMIT
    assert abs(z_scores(found["b"], 0.5)) < LIMIT  # independent of the share
    assert np.allclose(found["log_share"], np.log(share))


@pytest.mark.parametrize("unconstrained", [True, False])
def test_modes_are_weighed_right(unconstrained: bool) -> None:
    """Modes 30 standard deviations apart: a random walk alone never crosses."""
    net = bmc.BayesNet()
    net.add("x", bmc.StudentT(2.0, 0.0, 5.0))
    net.potential(
        "modes", lambda x: np.logaddexp(-0.5 * (x + 15) ** 2, np.log(3.0) - 0.5 * (x - 15) ** 2)
    )
    target = target_of(pose(net, {}))
    found, _ = draws_of(target, ["x"], 10, 48, 300, 600, unconstrained=unconstrained)
    # the prior is symmetric, so the modes weigh 1 to 3
    assert abs(z_scores((found["x"] > 0).astype(float), 0.75)) < LIMIT
    crossed = (np.diff(found["x"] > 0, axis=0)).mean()
    assert crossed > 0.003
    alone, _ = draws_of(target, ["x"], 1, 48, 300, 600)  # negative control: without an ensemble
    assert not np.diff(alone["x"] > 0, axis=0).any()


def test_observed_elements_of_a_block_stay() -> None:
    net = bmc.BayesNet(plates={"i": 3})
    net.add("m", bmc.Normal(0.0, 1.0))
    net.add("x", lambda m: bmc.Normal(m, 1.0), plates="i")
    net.add("y", lambda x: bmc.Normal(x, 1.0), plates="i")
    target = target_of(pose(net, {"x": [np.nan, 2.0, np.nan], "y": [0.0, 0.0, 3.0]}))
    assert parts_of(target, ["m", "x"])[-1].stop == 3
    found, _ = draws_of(target, ["m", "x"], 8)
    assert (found["x"][..., 1] == 2.0).all()
    # m has precision 1 + 1 + 1/2 + 1/2 and sees 2, 0/2 and 3/2
    assert abs(z_scores(found["m"], 3.5 / 3.0)) < LIMIT
    assert np.abs(z_scores(found["x"][..., [0, 2]], [3.5 / 6, 3.5 / 6 + 1.5])).max() < LIMIT


def test_an_impossible_proposal_is_not_shown_to_the_terms_below() -> None:
    """On its own scale a standard deviation may propose to be negative; no Normal may see it."""
    net = bmc.BayesNet(plates={"i": 4})
    net.add("s", bmc.Exponential(1.0))
    net.add("m", bmc.Normal(0.0, 1.0))
    net.add("y", lambda m, s: bmc.Normal(m, s), plates="i")
    y = np.array([1.0, -0.5, 0.3, 2.0])
    target = target_of(pose(net, {"y": y}))
    found, _ = draws_of(
        target, ["s", "m"], 1, 64, 100, 600, unconstrained=False, scale=0.8, adaptive=False
    )
    assert (found["s"] > 0).all()
    s, m = np.meshgrid(np.linspace(1e-4, 15.0, 1500), np.linspace(-5.0, 5.0, 801))
    weight = np.exp(-s - 0.5 * m**2) * stats.norm.pdf(y[:, None, None], m, s).prod(axis=0)
    assert abs(z_scores(found["m"], (weight * m).sum() / weight.sum())) < LIMIT
    assert abs(z_scores(found["s"], (weight * s).sum() / weight.sum())) < LIMIT


# ---- angles -------------------------------------------------------------------------------------

PRIORS = {"von Mises": bmc.VonMises(3.0, 4.0), "wrapped normal": bmc.WrappedNormal(-3.1, 0.5)}
SEEN = [0.6, -0.2]


def compass(prior: Any) -> Target:
    """A heading whose mass lies on both sides of the cut at pi, and a number that goes with it."""
    net = bmc.BayesNet(plates={"i": 2})
    net.add("a", bmc.Normal(0.0, 0.5))
    net.add("h", prior)
    net.add("y", lambda a, h: bmc.Normal(a + np.sin(h), 0.3), plates="i")
    return target_of(pose(net, {"y": SEEN}))


def figures(a: Any, h: Any) -> np.ndarray:
    """What is compared: directions do not mind the cut."""
    return np.stack([a, a * a, np.cos(h), np.sin(h), a * np.sin(h)], axis=-1)


def by_quadrature(prior: Any) -> np.ndarray:
    a, h = np.meshgrid(np.linspace(-3.0, 3.0, 601), np.linspace(-np.pi, np.pi, 1001)[:-1])
    y = np.reshape(SEEN, (2, 1, 1))
    log = prior.log_prob(h) - 2.0 * a**2 - 0.5 * (((y - a - np.sin(h)) / 0.3) ** 2).sum(axis=0)
    weight = np.exp(log - log.max())
    return np.tensordot(weight, figures(a, h), 2) / weight.sum()


class Unwrapped(BlockWalk):
    """A deliberate error: angles are taken for numbers of the line."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.steps.angles = None


@pytest.mark.parametrize("members", [1, 4, 16])
@pytest.mark.parametrize("prior", PRIORS.values(), ids=PRIORS)
def test_angles_near_the_cut(prior: Any, members: int) -> None:
    """Alone, a block keeps its vectors from step to step, and so the angles that it walked to."""
    found, rate = draws_of(compass(prior), ["a", "h"], members, alone=True)
    assert np.abs(z_scores(figures(found["a"], found["h"]), by_quadrature(prior))).max() < LIMIT
    assert 0.15 < rate.mean() < 0.5
    assert 0.1 < (found["h"] > 0).mean() < 0.9


@pytest.mark.parametrize(
    ("kind", "right"),
    [(BlockWalk, True), pytest.param(Unwrapped, False, marks=pytest.mark.thorough)],
)
def test_angles_do_not_run_off(kind: type[BlockWalk], right: bool) -> None:
    """Differences that take in turns double every few sweeps: in the end doubles tell none apart."""
    prior = PRIORS["wrapped normal"]
    found, _ = draws_of(compass(prior), ["a", "h"], 16, warmup=1800, kind=kind, alone=True)
    worst = np.abs(z_scores(figures(found["a"], found["h"]), by_quadrature(prior))).max()
    assert worst < LIMIT if right else worst > 20


@pytest.mark.parametrize(
    "options", [{}, {"alone": True}, {"unconstrained": False, "alone": True}], ids=str
)
def test_a_pose_near_the_cut(options: dict[str, Any]) -> None:
    """One component of a vector is an angle: its normal posterior, wrapped, in closed form."""
    deviations = np.array([0.1, 2.0, 0.4])
    net = bmc.BayesNet()
    net.add("pose", PoseNormal([1.0, 2.0, 3.0], scale_diag=deviations))
    net.add("read", lambda pose: bmc.WrappedNormal(pose[..., 2], 0.4))
    target = target_of(pose(net, {"read": -3.0}))
    found, _ = draws_of(target, ["pose"], 8, **options)
    drawn = found["pose"]
    heading = drawn[..., 2]
    assert (-np.pi <= heading).all() and (heading < np.pi).all()
    assert np.abs(z_scores(drawn[..., :2], [1.0, 2.0])).max() < LIMIT
    assert np.abs(z_scores((drawn[..., :2] - [1.0, 2.0]) ** 2, deviations[:2] ** 2)).max() < LIMIT
    # half way between 3 and -3 lies pi; the weight of modes a turn away is below 1e-13
    turned = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    assert np.abs(z_scores(turned, [-np.exp(-0.5 * 0.08), 0.0])).max() < LIMIT


def test_a_heading_of_which_nothing_is_known() -> None:
    """All directions are as likely: every step is accepted, however long, and steps stop at a turn."""
    net = bmc.BayesNet(plates={"i": 3})
    net.add("h", bmc.VonMises(0.0, 0.0), plates="i")
    net.add("y", lambda h: bmc.Normal(0.0 * h, 1.0), plates="i")
    target = target_of(pose(net, {"y": np.zeros(3)}))
    found, _ = draws_of(target, ["h"], 8, warmup=600, alone=True)
    h = found["h"]
    assert (
        np.abs(z_scores(np.stack([np.cos(h), np.sin(h), np.cos(3 * h)], axis=-1), 0.0)).max()
        < LIMIT
    )
    start = Steps(1, angles=np.array([True])).start(np.zeros((4, 1, 1)))
    for angles, longest in (([True], 2 * np.pi), ([False], np.inf)):  # the latter: negative control
        steps, memory = Steps(1, angles=np.array(angles)), start
        for _ in range(5000):
            memory = steps.learnt(memory, np.zeros((4, 1, 1)), np.ones((4, 1)))
        scale = float(np.exp(steps.frozen(memory)["log_scale"].max()))
        assert scale <= longest * (1 + 1e-12)
        assert (scale > 1e30) == (longest == np.inf)


def test_which_numbers_of_a_block_are_angles() -> None:
    """A simplex of three walks by two numbers, on its own scale by three; observed elements do not walk."""
    net = bmc.BayesNet(plates={"i": 3})
    net.add("m", bmc.Normal(0.0, 1.0))
    net.add("x", AndAngle(bmc.Dirichlet(np.ones(3)), bmc.VonMises(0.0, 1.0)), plates="i")
    net.add("h", bmc.VonMises(0.0, 1.0), plates="i")
    net.add("y", lambda m, x, h: bmc.Normal(m + x[..., 0] + h, 1.0), plates="i")
    seen = {"y": np.zeros(3), "h": [np.nan, 0.0, np.nan]}
    target = target_of(pose(net, seen))
    for unconstrained, of_simplex in ((True, 2), (False, 3)):
        kernel = BlockWalk(target, ["m", "x", "h"], unconstrained=unconstrained)
        one = [*[False] * of_simplex, True]
        expected = {"m": [False], "x": one * 3, "h": [True] * 2}
        assert kernel.steps.angles.tolist() == [
            k for part in kernel.parts for k in expected[part.name]
        ]


# ---- errors -------------------------------------------------------------------------------------


class Pulled(BlockWalk):
    """A deliberate error: proposals lean towards the other half, and nothing corrects for it."""

    def _stepped(self, u: Any, rows: Any, others: Any, memory: Any, rng: Any) -> Any:
        tried, moves = super()._stepped(u, rows, others, memory, rng)
        return tried + 0.2 * (u[others].mean(axis=1) - u[rows]), moves


def ensemble_ranks(kind: type[BlockWalk]) -> Any:
    """The rank test of frozen ensembles of 6, each member with data of its own.

    Members of an ensemble depend on each other, so one ensemble is one row of the test.
    """
    members = 6
    net = bmc.BayesNet(plates={"i": 3})
    net.add("s", bmc.Gamma(2.0, 2.0))
    net.add("w", bmc.Dirichlet([1.0, 2.0, 1.0]))
    net.add("y", lambda s, w: bmc.Normal(s * w[..., 0], s), plates="i")
    target = target_of(pose(net, {"y": np.zeros(3)}))
    kernel = kind(target, ["s", "w"], members)

    def flat(state: Any) -> Any:
        return {k: v.reshape(-1, *v.shape[2:]) for k, v in state.items()}

    def folded(state: Any) -> Any:
        return {k: v.reshape(-1, members, *v.shape[1:]) for k, v in state.items()}

    def prior(rng: np.random.Generator, n: int) -> Any:
        drawn = net.sample(n * members, rng=rng)
        return folded({k: drawn[k] for k in ("s", "w")})

    def simulate(state: Any, rng: np.random.Generator) -> np.ndarray:
        s, w = state["s"][..., None], state["w"]
        return rng.normal(s * w[..., :1], s, size=(*s.shape[:2], 3))

    def move(state: Any, data: np.ndarray, rng: np.random.Generator) -> Any:
        now = flat(state)
        values = {**target.known, **now, "y": data.reshape(-1, 3)}
        fixed = {k: np.resize(v, values[k].shape) for k, v in start.items()}
        with marking_invalid(), np.errstate(all="ignore"):
            memory = kernel.end_warmup(kernel.start({**values, **fixed}, len(now["s"])))
            new, _ = kernel.step(values, memory, rng, False)
        return folded(new)

    start = {"s": np.array([0.5, 1.0, 2.0]), "w": np.array([[0.3, 0.5, 0.2], [0.2, 0.3, 0.5]])}
    statistics = {
        "mean": lambda s, y: s["s"].mean(axis=1),
        "spread": lambda s, y: np.log(s["s"]).std(axis=1),
        "one": lambda s, y: s["w"][:, 0, 0] * s["s"][:, 0],
        "fit": lambda s, y: (y.std(axis=2) / s["s"]).mean(axis=1),
    }
    model = JointModel(prior, simulate, statistics)
    return rank_test(move, model, replications=500, thinning=3, rng=2)


def test_ranks_of_ensembles_are_uniform() -> None:
    """At 1e-3."""
    assert ensemble_ranks(BlockWalk)


def test_the_rank_test_sees_proposals_that_lean() -> None:
    """Negative control."""
    assert not ensemble_ranks(Pulled)


# ---- parts --------------------------------------------------------------------------------------


def test_densities_of_a_block_are_those_of_the_net() -> None:
    """Differences of the joint log density, whatever the values; impossible ones go back."""
    net, evidence, _, _ = regression()
    target = target_of(pose(net, evidence))
    rng = np.random.default_rng(0)
    block = Block(target, ["a", "b"])
    values = start_states(target, 5, rng)
    new = {"a": rng.normal(size=5), "b": rng.normal(size=(5, 2))}
    new["a"][2] = np.inf
    with marking_invalid(), np.errstate(all="ignore"):
        _, before = block.log(values)
        state, after = block.log(values, lambda name, _: (new[name], 0.0))
    assert after[2] == -np.inf and state["a"][2] == values["a"][2]
    assert np.array_equal(state["b"][2], values["b"][2])
    fine = [0, 1, 3, 4]
    joint = [net.log_prob({**v, "y": evidence["y"]}) for v in (values_of(values), new)]
    assert np.allclose((after - before)[fine], (joint[1] - joint[0])[fine])


def values_of(values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {k: values[k] for k in ("a", "b")}


def test_stragglers() -> None:
    log = np.random.default_rng(0).normal(size=(50, 20))
    assert not stragglers(log).any()
    log[7, 3] = -1e6
    log[9, :4] = -np.inf
    lost = stragglers(log)
    assert lost[7, 3] and lost[9, :4].all() and lost.sum() == 5


def test_members_that_move_see_only_the_other_half() -> None:
    net, evidence, _, _ = regression()
    kernel = BlockWalk(target_of(pose(net, evidence)), ["a", "b"], 6)
    (first, others), (second, rest) = kernel._halves(12, np.random.default_rng(0))
    assert sorted([*first, *second]) == list(range(12))
    for rows, fixed in ((first, others), (second, rest)):
        assert not set(rows) & set(fixed.ravel())
        assert (rows[:, None] // 6 == fixed // 6).all()  # of the same ensemble
