"""Random walks and jumps of one node: where they must end up, and that an error in them would show.

Chains are compared with exact posteriors by means over 128 or more independent chains, in standard errors
of their own spread: |z| < 4.5 in some 60 comparisons, a false alarm with probability 4e-4 over all
fixed seeds. Rank tests are at 1e-3 each.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy import stats

import bayesmc as bmc
from bayesmc.distributions.base import marking_invalid
from bayesmc.distributions.circular import wrap_angle
from bayesmc.engines.mcmc.starts import start_states
from bayesmc.kernels.adaptation import Steps, best_rate
from bayesmc.kernels.base import Kernel
from bayesmc.kernels.jump import Jump
from bayesmc.kernels.random_walk import AdaptiveWalk
from bayesmc.network import pose
from bayesmc.robotics import PoseNormal
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import target_of
from bayesmc.testing import JointModel, rank_test

LIMIT = 4.5


def chains_of(
    make: Callable[[Blanket], Kernel],
    net: bmc.BayesNet,
    evidence: dict[str, Any],
    name: str,
    chains: int = 128,
    warmup: int = 300,
    draws: int = 300,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Draws of a node that is alone in its chain, (draw, chain, ...), and its acceptance rates."""
    target = target_of(pose(net, evidence))
    kernel = make(Blanket(target, name))
    rng = np.random.default_rng(seed)
    found = []
    with marking_invalid(), np.errstate(all="ignore"):
        values = start_states(target, chains, rng)
        memory = kernel.start(values, chains)
        for t in range(warmup + draws):
            if t == warmup:
                memory = kernel.end_warmup(memory)
            new, memory = kernel.step(values, memory, rng, t < warmup)
            values = {**values, **new}
            target.refresh(values, kernel.names)
            if t >= warmup:
                found.append(values[name])
    rate = kernel.acceptance(memory)
    assert rate is not None
    return np.array(found), rate


def z_scores(draws: np.ndarray, exact: Any) -> np.ndarray:
    """Mean of all chains minus the exact one, in standard errors from independent chains."""
    means = draws.mean(axis=0)
    return (means.mean(axis=0) - exact) / (means.std(axis=0, ddof=1) / np.sqrt(len(means)))


def simplex_net() -> bmc.BayesNet:
    net = bmc.BayesNet()
    net.add("w", bmc.Dirichlet([1.0, 2.0, 0.5]))
    net.add("n", lambda w: bmc.Multinomial(12, w))
    return net


# ---- against exact posteriors -------------------------------------------------------------------


def test_simplex() -> None:
    draws, rate = chains_of(AdaptiveWalk, simplex_net(), {"n": [2, 9, 1]}, "w")
    exact = stats.dirichlet([3.0, 11.0, 1.5])
    assert np.abs(z_scores(draws, exact.mean())).max() < LIMIT
    assert np.abs(z_scores(draws**2, exact.var() + exact.mean() ** 2)).max() < LIMIT
    assert np.allclose(draws.sum(axis=-1), 1.0)
    assert abs(rate.mean() - best_rate(2)) < 0.1


def test_a_walk_without_the_jacobian_is_caught() -> None:
    """Negative control of the test above."""

    class Wrong(AdaptiveWalk):
        def _volume(self, transform: Any, free: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
            return np.zeros(shape)

    draws, _ = chains_of(Wrong, simplex_net(), {"n": [2, 9, 1]}, "w")
    assert np.abs(z_scores(draws, stats.dirichlet([3.0, 11.0, 1.5]).mean())).max() > 10


def test_positive_definite_matrix() -> None:
    x = np.array([[0.4, -1.2], [1.5, 0.3], [-0.6, 0.9], [0.2, 1.1], [-1.0, -0.5]])
    net = bmc.BayesNet(plates={"i": 5})
    net.add("cov", bmc.InverseWishart(9.0, np.array([[2.0, 0.5], [0.5, 1.0]])))
    net.add("x", lambda cov: bmc.MvNormal(np.zeros(2), cov), plates="i")
    draws, _ = chains_of(AdaptiveWalk, net, {"x": x}, "cov")
    posterior = np.array([[2.0, 0.5], [0.5, 1.0]]) + x.T @ x
    z = z_scores(draws, posterior / (14.0 - 3.0))
    assert np.abs(z[np.tril_indices(2)]).max() < LIMIT
    assert (np.linalg.eigvalsh(draws) > 0).all()


def test_every_element_of_a_plate_has_its_own_scale() -> None:
    """Shapes that differ by a factor of 400 in scale; the elements are independent."""
    net = bmc.BayesNet(plates={"i": 3})
    sd = np.array([0.05, 1.0, 20.0])
    net.add("x", bmc.Normal(1.0, sd), plates="i")
    net.add("y", lambda x: bmc.Normal(x, sd), plates="i")
    y = np.array([1.1, 3.0, -20.0])
    draws, rate = chains_of(AdaptiveWalk, net, {"y": y}, "x")
    assert np.abs(z_scores(draws, (1.0 + y) / 2)).max() < LIMIT
    assert np.abs(z_scores((draws - (1.0 + y) / 2) ** 2, sd**2 / 2)).max() < LIMIT
    assert abs(rate.mean() - best_rate(1)) < 0.1


@pytest.mark.parametrize("unconstrained", [True, False])
def test_bounds_that_depend_on_parents(unconstrained: bool) -> None:
    """x ~ U(0, b) given b, with an exponential factor: a truncated exponential."""
    net = bmc.BayesNet()
    net.add("b", bmc.Uniform(1.0, 1.0 + 1e-9))
    net.add("x", lambda b: bmc.Uniform(0.0, 2.0 * b))
    net.potential("f", lambda x: -1.5 * x)
    draws, _ = chains_of(
        lambda b: AdaptiveWalk(b, unconstrained=unconstrained, scale=0.7), net, {"b": 1.0}, "x"
    )
    assert ((draws > 0) & (draws < 2)).all()
    assert abs(z_scores(draws, stats.truncexpon(3.0, scale=1 / 1.5).mean())) < LIMIT


def test_angles() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.VonMises(3.0, 1.5))
    net.add("b", lambda a: bmc.VonMises(a, 2.0))
    draws, _ = chains_of(AdaptiveWalk, net, {"b": -2.8}, "a")
    resultant = 1.5 * np.exp(3.0j) + 2.0 * np.exp(-2.8j)
    turned = draws - np.angle(resultant)
    mean = stats.vonmises(np.abs(resultant)).expect(np.cos, lb=-np.pi, ub=np.pi)
    assert abs(z_scores(np.cos(turned), mean)) < LIMIT
    assert abs(z_scores(np.sin(turned), 0.0)) < LIMIT


def test_a_walk_finds_the_mass_from_far_away() -> None:
    """The prior is 10^5 times as wide as the posterior."""
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1e4))
    net.add("y", lambda x: bmc.Normal(x, 0.1))
    draws, rate = chains_of(AdaptiveWalk, net, {"y": 2500.0}, "x", chains=4, warmup=600)
    assert abs(draws.mean() - 2500.0) < 0.05
    assert ((rate > 0.25) & (rate < 0.65)).all()


def test_observed_elements_stay() -> None:
    net = bmc.BayesNet(plates={"i": 3})
    net.add("x", bmc.Normal(0.0, 1.0), plates="i")
    net.add("y", lambda x: bmc.Normal(x, 1.0), plates="i")
    evidence = {"x": [np.nan, 7.0, np.nan], "y": [2.0, 2.0, -2.0]}
    draws, _ = chains_of(AdaptiveWalk, net, evidence, "x")
    assert (draws[:, :, 1] == 7.0).all()
    assert np.abs(z_scores(draws[:, :, [0, 2]], [1.0, -1.0])).max() < LIMIT


# ---- discrete nodes -----------------------------------------------------------------------------


def table_net() -> bmc.BayesNet:
    net = bmc.BayesNet()
    net.table("a", probs=[0.1, 0.2, 0.3, 0.4])
    net.table("b", ["a"], [[0.9, 0.1], [0.5, 0.5], [0.0, 1.0], [0.2, 0.8]])
    return net


def test_finite_states() -> None:
    draws, _ = chains_of(Jump, table_net(), {"b": 0}, "a")
    exact = np.array([0.09, 0.1, 0.0, 0.08]) / 0.27
    assert not (draws == 2).any()
    for state in (0, 1, 3):
        assert abs(z_scores((draws == state).astype(float), exact[state])) < LIMIT


def test_a_jump_that_takes_its_own_density_twice_is_caught() -> None:
    """Negative control: jumps as if they were draws from the node's own density."""

    class Wrong(Jump):
        def _proposed(self, values: Any, memory: Any, rng: np.random.Generator) -> Any:
            new, dead, drawn = super()._proposed(values, memory, rng)
            return new, dead, np.ones_like(drawn)

    draws, _ = chains_of(Wrong, table_net(), {"b": 0}, "a")
    assert abs(z_scores((draws == 0).astype(float), 0.09 / 0.27)) > 10


def test_unbounded_integers_learn_how_far_to_jump() -> None:
    net = bmc.BayesNet()
    net.add("n", bmc.NegativeBinomial(2.0, 0.998))
    net.add("k", lambda n: bmc.Binomial(n, 0.5))
    target = target_of(pose(net, {"k": 400}))
    draws, _ = chains_of(Jump, net, {"k": 400}, "n")
    grid = np.arange(400, 3000)
    log = target.log_density({**target.known, "n": grid})
    weights = np.exp(log - log.max())
    weights /= weights.sum()
    assert abs(z_scores(draws, weights @ grid)) < LIMIT
    assert (
        abs(z_scores((draws - weights @ grid) ** 2, weights @ (grid - weights @ grid) ** 2)) < LIMIT
    )
    kernel = Jump(Blanket(target, "n"))
    values = {**target.known, "n": np.full(64, 800)}
    memory, rng = kernel.start(values, 64), np.random.default_rng(1)
    for _ in range(200):
        new, memory = kernel.step(values, memory, rng, True)
        values = {**values, **new}
    assert 20 < np.exp(memory["log_size"]) < 500  # the posterior's sd is about 28


def test_vectors_of_counts() -> None:
    """Multinomial counts, thinned: the posterior of what was missed is multinomial again."""
    probs, keep = np.array([0.5, 0.3, 0.2]), np.array([0.9, 0.5, 0.1])
    net = bmc.BayesNet()
    net.add("n", bmc.Multinomial(10, probs))
    net.potential("seen", lambda n: np.vecdot(n, np.log(keep)))
    draws, _ = chains_of(Jump, net, {}, "n")
    posterior = probs * keep / (probs @ keep)
    assert (draws.sum(axis=-1) == 10).all() and (draws >= 0).all()
    assert np.abs(z_scores(draws, 10 * posterior)).max() < LIMIT


def test_two_free_nodes_do_not_move_in_lockstep() -> None:
    """Two fair coins that accept every jump: their parity must change, too."""
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.5))
    net.add("b", bmc.Bernoulli(0.5))
    net.potential("flat", lambda a, b: 0.0 * a * b)
    target = target_of(pose(net, {}))
    kernels = [Jump(Blanket(target, n)) for n in "ab"]
    rng = np.random.default_rng(0)
    values = {**target.known, "a": np.zeros(1000, np.uint8), "b": np.zeros(1000, np.uint8)}
    for kernel in kernels * 6:
        new, _ = kernel.step(values, kernel.start(values, 1000), rng, False)
        values = {**values, **new}
    # 1000 pairs of fair coins: 4.5 standard errors
    assert abs((values["a"] != values["b"]).mean() - 0.5) < 4.5 * np.sqrt(0.25 / 1000)


# ---- exact rank tests ---------------------------------------------------------------------------


def mixture_target() -> Any:
    net = bmc.BayesNet(plates={"cluster": 3, "point": 4})
    net.add("weights", bmc.Dirichlet([1.0, 1.0, 2.0]))
    net.add("mean", bmc.Normal(0.0, 1.0), plates="cluster")
    net.add("label", lambda weights: bmc.Categorical(weights), plates="point")
    net.add("x", lambda label, mean: bmc.Normal(mean[label], 1.0), plates="point")
    return net, target_of(pose(net, {"x": np.zeros(4)}))


def ranks(make: Callable[[Blanket], Kernel], name: str, statistic: Any, seed: int) -> Any:
    """The rank test of one frozen kernel in a mixture of three overlapping components."""
    net, target = mixture_target()
    kernel = make(Blanket(target, name))
    hidden = ("weights", "mean", "label")

    def prior(rng: np.random.Generator, n: int) -> dict[str, np.ndarray]:
        drawn = net.sample(n, rng=rng)
        return {k: drawn[k].astype(np.uint8 if k == "label" else float) for k in hidden}

    def simulate(state: Any, rng: np.random.Generator) -> np.ndarray:
        return rng.normal(
            np.take_along_axis(state["mean"], state["label"].astype(int), axis=1), 1.0
        )

    def move(state: Any, data: np.ndarray, rng: np.random.Generator) -> Any:
        values = {**target.known, **state, "x": data}
        with marking_invalid(), np.errstate(all="ignore"):
            new, _ = kernel.step(values, kernel.end_warmup(memory(values)), rng, False)
        return {**state, **new}

    def memory(values: Any) -> Any:
        return kernel.start({**values, **fixed}, len(values["x"]))

    fixed = {"weights": np.tile([[0.3, 0.3, 0.4], [0.6, 0.2, 0.2]], (500, 1)),
             "mean": np.tile([[0.5, -0.5, 0.0], [-0.5, 0.5, 1.0]], (500, 1)),
             "label": np.zeros((1000, 4), np.uint8)}  # fmt: skip
    statistics = {"one": statistic, "fit": lambda s, y: (y * s["mean"][:, :1]).sum(axis=1)}
    model = JointModel(prior, simulate, statistics)
    return rank_test(move, model, thinning=3, rng=seed)


KERNELS: dict[str, tuple[Any, str, Any]] = {
    "simplex": (AdaptiveWalk, "weights", lambda s, y: s["weights"][:, 0]),
    "gathered plate": (AdaptiveWalk, "mean", lambda s, y: (s["mean"] ** 2).sum(axis=1)),
    "own scale": (
        lambda b: AdaptiveWalk(b, scale=0.8, unconstrained=False, adaptive=False),
        "mean",
        lambda s, y: (s["mean"] ** 2).sum(axis=1),
    ),
    "labels": (Jump, "label", lambda s, y: (s["label"] == 1) @ np.arange(1.0, 5.0)),
}


@pytest.mark.parametrize("kind", KERNELS)
def test_ranks_are_uniform(kind: str) -> None:
    make, name, statistic = KERNELS[kind]
    assert ranks(make, name, statistic, 3)


@pytest.mark.parametrize("kind", KERNELS)
def test_the_rank_test_sees_an_error(kind: str) -> None:
    """Negative controls: the node's own density is left out of the acceptance ratio."""
    make, name, statistic = KERNELS[kind]

    def wrong(blanket: Blanket) -> Kernel:
        kernel = make(blanket)
        kernel.blanket.own_log = lambda state, members=None: np.zeros(1)
        return kernel

    assert not ranks(wrong, name, statistic, 3)


# ---- adaptation ---------------------------------------------------------------------------------


def test_frozen_steps_do_not_change() -> None:
    net = simplex_net()
    target = target_of(pose(net, {"n": [2, 9, 1]}))
    kernel = AdaptiveWalk(Blanket(target, "w"))
    rng = np.random.default_rng(0)
    values = start_states(target, 8, rng)
    memory = kernel.start(values, 8)
    for _ in range(50):
        new, memory = kernel.step(values, memory, rng, True)
        values = {**values, **new}
    memory = kernel.end_warmup(memory)
    assert (memory["steps"]["log_scale"] == memory["steps"]["average"]).all()
    _, later = kernel.step(values, memory, rng, False)
    assert later["steps"] is memory["steps"]


def test_covariances_are_learnt() -> None:
    """Points that are independent draws: the pooled covariance comes within 10 % of theirs."""
    rng = np.random.default_rng(0)
    cov = np.array([[4.0, 1.5], [1.5, 1.0]])
    steps = Steps(2)
    draw = lambda: rng.multivariate_normal([1.0, -1.0], cov, size=(64, 3))  # noqa: E731
    memory = steps.start(draw())
    for _ in range(400):
        memory = steps.learnt(memory, draw(), np.full((64, 3), 0.337))
    assert np.allclose(memory["cov"], cov, rtol=0.1)
    # 0.337 is the best rate of two numbers: the first length, from the points' spread, is right
    length = 2.38 / np.sqrt(2.0) * 4.0**0.25
    assert np.allclose(np.exp(memory["log_scale"]), length, rtol=0.3)
    moves = np.concatenate([steps.draw(steps.frozen(memory), rng) for _ in range(200)])
    found = np.cov(moves[:, 0].T)
    assert np.allclose(
        found / np.sqrt(np.linalg.det(found)), cov / np.sqrt(np.linalg.det(cov)), rtol=0.1
    )


@pytest.mark.parametrize("turn", [0.3, np.pi, 31 * np.pi - 0.1])
def test_covariances_of_angles_do_not_see_the_cut(turn: float) -> None:
    """What is learnt of positions and headings is the same once all headings are turned."""
    rng = np.random.default_rng(0)
    root = np.array([[1.0, 0.0, 0.0], [0.3, 0.5, 0.0], [0.2, -0.2, 0.3]])
    drawn = [rng.normal(size=(8, 2, 3)) @ root.T for _ in range(400)]
    drawn[0][..., 2] += 4.0  # the mean is found from far away, too

    def learnt(turn: float, angles: bool) -> Any:
        steps = Steps(3, angles=np.array([False, False, angles]))
        wrapped = [
            np.where([False, False, True], wrap_angle(u + [0.0, 0.0, turn]), u) for u in drawn
        ]
        memory = steps.start(wrapped[0])
        for u in wrapped[1:]:
            memory = steps.learnt(memory, u, np.full((8, 2), 0.3))
        return steps.frozen(memory)

    here, there, linear = learnt(0.0, True), learnt(turn, True), learnt(turn, False)
    for what in ("cov", "factor", "log_scale"):
        np.testing.assert_allclose(there[what], here[what], atol=1e-9)
    assert np.abs(wrap_angle(there["mean"][:, 2] - here["mean"][:, 2] - turn)).max() < 1e-9
    np.testing.assert_allclose(there["cov"], np.stack([root @ root.T] * 2), atol=0.15)
    if turn > 3:  # negative control: numbers of the line have a deviation of half a turn
        assert (linear["cov"][:, 2, 2] > 10 * here["cov"][:, 2, 2]).all()


def test_arguments_are_left_alone() -> None:
    target = target_of(pose(simplex_net(), {"n": [2, 9, 1]}))
    kernel = AdaptiveWalk(Blanket(target, "w"))
    values = start_states(target, 4, np.random.default_rng(0))
    before = {k: v.copy() for k, v in values.items()}
    memory = kernel.start(values, 4)
    count = memory["steps"]["count"]
    kernel.step(values, memory, np.random.default_rng(1), True)
    assert all((values[k] == v).all() for k, v in before.items())
    assert memory["steps"]["count"] == count


# ---- angles -------------------------------------------------------------------------------------


def test_a_heading_of_which_nothing_is_known_walks_all_round() -> None:
    net = bmc.BayesNet()
    net.add("h", bmc.VonMises(0.0, 0.0))
    net.add("y", lambda h: bmc.Normal(0.0 * h, 1.0))
    draws, _ = chains_of(AdaptiveWalk, net, {"y": 0.0}, "h", warmup=2000)
    turned = np.stack([np.cos(draws), np.sin(draws), np.cos(3 * draws)], axis=-1)
    assert np.abs(z_scores(turned, 0.0)).max() < LIMIT
    assert len(np.unique(draws)) > 0.3 * draws.size


@pytest.mark.parametrize("unconstrained", [True, False])
def test_a_pose_near_the_cut_is_walked_in_its_shape(unconstrained: bool) -> None:
    """Deviations .1, 2 and .28 about a heading of pi."""
    net = bmc.BayesNet()
    net.add("pose", PoseNormal([1.0, 2.0, 3.0], scale_diag=[0.1, 2.0, 0.4]))
    net.add("read", lambda pose: bmc.WrappedNormal(pose[..., 2], 0.4))

    def walk(blanket: Blanket) -> AdaptiveWalk:
        return AdaptiveWalk(blanket, unconstrained=unconstrained)

    draws, rate = chains_of(walk, net, {"read": -3.0}, "pose", warmup=600)
    heading = draws[..., 2]
    assert (-np.pi <= heading).all() and (heading < np.pi).all()
    figures = np.stack(
        [draws[..., 0], (draws[..., 1] - 2.0) ** 2, np.cos(heading), np.sin(heading)], axis=-1
    )
    assert np.abs(z_scores(figures, [1.0, 4.0, -np.exp(-0.5 * 0.08), 0.0])).max() < LIMIT
    assert 0.15 < rate.mean() < 0.5
