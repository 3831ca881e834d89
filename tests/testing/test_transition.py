"""Exact transition matrices of Gibbs and Metropolis-Hastings kernels, and what they must be.

Chi-square tests of 10**6 steps run at fixed seeds; a fresh seed would fail one of them with chance 1e-4,
as p-values below that are refused (each is uniform for a right matrix).
"""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import BudgetError, ShapeError, UnsupportedError, ZeroProbabilityError
from bayesmc.kernels.enumerate import Enumerate
from bayesmc.kernels.jump import Jump
from bayesmc.kernels.lattice import lattice_kernel
from bayesmc.kernels.tables import table_kernel
from bayesmc.markov import MarkovChain
from bayesmc.network import Problem, pose
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import target_of
from bayesmc.testing import exact_sweep, random_net, transition_matrix, transition_p_value


class Sweeping:
    """An engine whose sweep is one kernel for each node, made by a function of its blanket."""

    def __init__(self, make: Callable[[Blanket], Any]) -> None:
        self.make = make

    def sampler(self, problem: Problem) -> Any:
        target = target_of(problem)
        kernels = [self.make(Blanket(target, name)) for name in target.chain]
        return SimpleNamespace(target=target, kernels=kernels)


ONE_BY_ONE = Sweeping(Enumerate)
TABLES = Sweeping(table_kernel)


def tiny(seed: int) -> tuple[bmc.BayesNet, dict[str, Any]]:
    """A random net of four nodes with two or three states; a leaf is seen, three nodes are hidden."""
    options: Any = {"nodes": (4, 4), "states": 3, "deterministic": False, "zeros": False}
    for attempt in range(1000):
        net = random_net(1000 * seed + attempt, **options)
        for leaf in (n for n in net if not net.graph.out_degree(n)):
            evidence = {leaf: net[leaf].states[0]}
            if len(target_of(pose(net, evidence)).chain) == 3:
                return net, evidence
    raise AssertionError("no such net")


def posterior_law(net: bmc.BayesNet, evidence: dict[str, Any], names: Any) -> np.ndarray:
    """The joint posterior by elimination, over all states in C order."""
    posterior = bmc.infer(net, evidence, engine=bmc.Exact())
    return posterior.probabilities(*names).ravel()


def steps_counted(net: Any, evidence: Any, engine: Any, sweep: Any, rng: int) -> np.ndarray:
    """10**6 steps of the engine's sampler, as counts from state to state: 2000 chains of 500."""
    problem = pose(net, evidence)
    sampler = engine.sampler(problem)
    generator = np.random.default_rng(rng)
    names = sampler.target.chain
    cards = [problem.model[n].domain.size for n in names]
    place = {s: k for k, s in enumerate(sweep.states)}
    labels = [problem.model[n].domain.states for n in names]
    number = np.array([
        place[tuple(labels[i][c] for i, c in enumerate(code))]
        for code in np.ndindex(*cards)
    ])  # fmt: skip

    def now(state: Any) -> np.ndarray:
        return number[np.ravel_multi_index([state["values"][n] for n in names], cards)]

    state = sampler.end_warmup(sampler.start(generator, 2000))
    at, size = now(state), len(sweep.states)
    counts = np.zeros(size * size, dtype=int)
    for _ in range(500):
        state = sampler.step(state, generator, False)
        new = now(state)
        counts += np.bincount(at * size + new, minlength=size * size)
        at = new
    return counts.reshape(size, size)


def proposals(net: bmc.BayesNet, evidence: dict[str, Any]) -> dict[str, Any]:
    """One of each kind: from all states alike, and from the node's own density."""
    target = target_of(pose(net, evidence))
    first, second = target.chain[:2]
    domain = target.model[first].domain
    assert domain is not None
    anywhere = bmc.DiscreteUniform(domain.low, domain.low + domain.size - 1)
    return {first: lambda: anywhere, second: "prior"}


# ---- the law is kept ----------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", ["one by one", "jumps", "proposals"])
def test_stationary_law_is_the_posterior(seed: int, kind: str) -> None:
    net, evidence = tiny(seed)
    engine: Any = ONE_BY_ONE
    if kind != "one by one":
        given = proposals(net, evidence) if kind == "proposals" else None
        engine = bmc.MetropolisHastings(proposal=given)
    sweep = exact_sweep(net, evidence, engine)
    law = posterior_law(net, evidence, sweep.elements)
    chain = MarkovChain(sweep.matrix, sweep.states)
    assert chain.is_ergodic
    np.testing.assert_allclose(chain.stationary[0], law, rtol=0, atol=1e-12)
    np.testing.assert_allclose(sweep.law, law, rtol=0, atol=1e-12)
    for kernel in sweep.kernels:
        assert kernel.resolution == 2.0**-53
        assert MarkovChain(kernel.matrix).is_reversible(law, 1e-12), kernel.names
    assert not chain.is_reversible()


@pytest.mark.parametrize("seed", range(4))
def test_gibbs_by_tables_keeps_the_posterior(seed: int) -> None:
    net, evidence = tiny(seed)
    exact = exact_sweep(net, evidence, ONE_BY_ONE)
    for engine in (TABLES, bmc.Gibbs()):
        sweep = exact_sweep(net, evidence, engine)
        chain = MarkovChain(sweep.matrix)
        np.testing.assert_allclose(chain.stationary[0], exact.law, rtol=0, atol=1e-12)
        assert sweep.resolution == 2.0**-53
    for kernel, right in zip(
        exact_sweep(net, evidence, TABLES).kernels, exact.kernels, strict=True
    ):
        assert np.abs(kernel.matrix - right.matrix).max() < 1e-14


@pytest.mark.parametrize("seed", range(2))
def test_a_sweep_of_table_look_ups_is_the_product_of_its_parts(seed: int) -> None:
    net, evidence = tiny(seed)
    for kernel in exact_sweep(net, evidence, bmc.Gibbs()).kernels:
        assert len(kernel.parts) == 3
        product = np.linalg.multi_dot([part.matrix for part in kernel.parts])
        np.testing.assert_allclose(product, kernel.matrix, rtol=0, atol=1e-15)
        law = exact_sweep(net, evidence, ONE_BY_ONE).law
        for part in kernel.parts:
            assert len(part.names) == 1
            assert MarkovChain(part.matrix).is_reversible(law, 1e-6)
        assert not MarkovChain(kernel.matrix).is_reversible(law, 1e-6)


def test_sweep_matrix_is_the_product_in_the_order_of_the_sweep() -> None:
    net, evidence = tiny(0)
    sweep = exact_sweep(net, evidence, ONE_BY_ONE)
    first, second = (k.matrix for k in sweep.kernels[:2])
    rest = [k.matrix for k in sweep.kernels[2:]]
    np.testing.assert_allclose(
        sweep.matrix, np.linalg.multi_dot([first, second, *rest, np.eye(len(first))]), atol=1e-15
    )
    states, matrix = transition_matrix(net, evidence, ONE_BY_ONE)
    assert states == sweep.states
    np.testing.assert_array_equal(matrix, sweep.matrix)
    with pytest.raises(ValueError):
        matrix[0, 0] = 1.0


# ---- by hand ------------------------------------------------------------------------------------


def test_matrices_by_hand() -> None:
    """One node of three states: Gibbs draws the posterior, Metropolis-Hastings moves by the textbook."""
    net = bmc.BayesNet()
    net.add("a", bmc.Categorical([0.2, 0.3, 0.5]), states=("low", "mid", "high"))
    net.table("b", ["a"], [[0.9, 0.1], [0.5, 0.5], [0.2, 0.8]])
    law = np.array([0.2 * 0.1, 0.3 * 0.5, 0.5 * 0.8])
    law /= law.sum()
    sweep = exact_sweep(net, {"b": 1}, ONE_BY_ONE)
    assert sweep.elements == ("a",) and sweep.states == (("low",), ("mid",), ("high",))
    np.testing.assert_allclose(sweep.matrix, np.tile(law, (3, 1)), atol=4e-16)

    q = np.array([0.1, 0.3, 0.6])
    engine = bmc.MetropolisHastings(proposal={"a": lambda: bmc.Categorical(q)})
    accept = np.minimum(1.0, law * q[:, None] / (law[:, None] * q))
    expected = q * accept
    np.fill_diagonal(expected, 0.0)
    expected += np.diag(1.0 - expected.sum(axis=1))
    np.testing.assert_allclose(exact_sweep(net, {"b": 1}, engine).matrix, expected, atol=4e-16)


def test_reducible_gibbs_has_a_law_for_each_class() -> None:
    """Two equal bits cannot change one at a time; as one block, which Gibbs takes, they can."""
    net = bmc.BayesNet()
    net.add("x", bmc.Bernoulli(0.3))
    net.add("y", bmc.Bernoulli(0.5))
    net.add("equal", lambda x, y: bmc.Bernoulli(1.0 * (x == y)))
    evidence = {"equal": 1}
    stuck = exact_sweep(net, evidence, ONE_BY_ONE)
    assert stuck.states == ((0, 0), (1, 1))
    np.testing.assert_array_equal(stuck.matrix, np.eye(2))
    free = exact_sweep(net, evidence, bmc.Gibbs())
    np.testing.assert_allclose(MarkovChain(free.matrix).stationary, [[0.7, 0.3]], atol=1e-12)


def test_plates_and_partial_evidence() -> None:
    """Hidden elements of a plate are the states; what is observed stays."""
    net = bmc.BayesNet(plates={"i": 3})
    net.add("k", bmc.Bernoulli(0.4))
    net.add("z", lambda k: bmc.Bernoulli(0.2 + 0.5 * k), plates="i")
    net.add("y", lambda z: bmc.Bernoulli(0.3 + 0.4 * z), plates="i")
    evidence = {"z": np.ma.MaskedArray([0, 1, 0], mask=[True, False, True]), "y": [1, 1, 0]}
    for engine in (ONE_BY_ONE, bmc.MetropolisHastings()):
        sweep = exact_sweep(net, evidence, engine)
        assert sweep.elements == ("k", "z[0]", "z[2]") and len(sweep.states) == 8
        values = np.array(sweep.states)
        z = np.column_stack([values[:, 1], np.ones(8, dtype=int), values[:, 2]])
        y = np.broadcast_to([1, 1, 0], (8, 3))
        law = np.exp(net.log_prob({"k": values[:, 0], "z": z, "y": y}))
        chain = MarkovChain(sweep.matrix)
        np.testing.assert_allclose(chain.stationary[0], law / law.sum(), rtol=0, atol=1e-12)


def test_factor_graph_of_four_spins() -> None:
    """An Ising square with a field, site by site and by colours."""
    graph = bmc.FactorGraph(plates={"site": 4})
    graph.variable("s", (-1, 1), plates="site")
    i = np.array([0, 1, 2, 3])
    graph.factor(lambda a, b: 0.6 * a * b, scope=("s", "s"), index=(i, (i + 1) % 4))
    graph.factor([[0.0, 0.3]], scope="s", index=[np.array([0])])
    sweep = exact_sweep(graph, None, ONE_BY_ONE)
    spins = np.array(sweep.states)
    log = 0.6 * (spins * np.roll(spins, -1, axis=1)).sum(axis=1) + 0.3 * (spins[:, 0] == 1)
    law = np.exp(log) / np.exp(log).sum()
    np.testing.assert_allclose(MarkovChain(sweep.matrix).stationary[0], law, rtol=0, atol=1e-12)


# ---- 10**6 steps --------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["Gibbs", "jumps", "proposals"])
def test_simulated_steps_have_the_matrix(kind: str) -> None:
    net, evidence = tiny(1)
    given = proposals(net, evidence) if kind == "proposals" else None
    engine: Any = bmc.Gibbs() if kind == "Gibbs" else bmc.MetropolisHastings(proposal=given)
    sweep = exact_sweep(net, evidence, engine)
    counts = steps_counted(net, evidence, engine, sweep, rng=3)
    assert counts.sum() == 10**6
    assert transition_p_value(sweep.matrix, counts) > 1e-4
    # a chain that stays a little more often is told apart
    assert transition_p_value(0.98 * sweep.matrix + 0.02 * np.eye(len(sweep.law)), counts) < 1e-8


# ---- what is wrong is found ---------------------------------------------------------------------


class ForgetsAChild(Enumerate):
    """Gibbs without the likelihood: the full conditional lacks all children."""

    def __init__(self, blanket: Blanket) -> None:
        super().__init__(blanket)
        self.blanket = Blanket(blanket.target, blanket.name)
        self.blanket.children = ()


class NoCorrection(Jump):
    """Draws from the node's own density that are accepted as if they were symmetric."""

    def _proposed(self, *arguments: Any) -> Any:
        new, dead, drawn = super()._proposed(*arguments)
        return new, dead, np.zeros_like(drawn)


@pytest.mark.parametrize("broken", [ForgetsAChild, NoCorrection])
def test_a_broken_kernel_has_another_law(broken: Callable[[Blanket], Any]) -> None:
    net, evidence = tiny(0)
    sweep = exact_sweep(net, evidence, Sweeping(broken))
    law = posterior_law(net, evidence, sweep.elements)
    assert np.abs(MarkovChain(sweep.matrix).stationary[0] - law).max() > 1e-3
    assert not all(MarkovChain(k.matrix).is_reversible(law) for k in sweep.kernels)


class Stays(Enumerate):
    """Holds with a chance of one in a million: invisible in 10**6 steps, harmless to the law."""

    hold = 1e-6

    def step(self, values: Any, memory: Any, rng: Any, warmup: bool) -> Any:
        new, memory = super().step(values, memory, rng, warmup)
        name = self.names[0]
        hold = rng.random(values[name].shape) < self.hold
        return {name: np.where(hold, values[name], new[name])}, memory


def test_a_chance_of_one_in_a_million_is_read() -> None:
    net, evidence = tiny(2)
    plain = exact_sweep(net, evidence, ONE_BY_ONE)
    held = exact_sweep(net, evidence, Sweeping(Stays))
    for kernel, right in zip(held.kernels, plain.kernels, strict=True):
        expected = (1 - Stays.hold) * right.matrix + Stays.hold * np.eye(len(plain.states))
        np.testing.assert_allclose(kernel.matrix, expected, rtol=0, atol=1e-15)


class LooksAround(Enumerate):
    """A chain that takes the next one's state."""

    def step(self, values: Any, memory: Any, rng: Any, warmup: bool) -> Any:
        new, memory = super().step(values, memory, rng, warmup)
        return {n: np.roll(v, 1, axis=0) for n, v in new.items()}, memory


class Otherwise(Enumerate):
    """Draws by a method that is not followed, or in another layout, or where nothing is possible."""

    def __init__(self, blanket: Blanket, how: str) -> None:
        super().__init__(blanket)
        self.how = how

    def step(self, values: Any, memory: Any, rng: Any, warmup: bool) -> Any:
        now = values[self.names[0]]
        if self.how == "normal":
            return {self.names[0]: now + (rng.normal(size=now.shape) > 0)}, memory
        if self.how == "layout":
            return {self.names[0]: (rng.random((3, *now.shape))[0] < 0.5).astype(now.dtype)}, memory
        if self.how == "ranges":
            return {self.names[0]: rng.integers(0, np.arange(2) + 1, size=2)}, memory
        return {self.names[0]: 1 - now}, memory


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (LooksAround, "no step function of its own draws"),
        (lambda blanket: Otherwise(blanket, "normal"), "rng.normal"),
        (lambda blanket: Otherwise(blanket, "layout"), "chains must come first"),
        (lambda blanket: Otherwise(blanket, "ranges"), "several ranges"),
    ],
)
def test_what_cannot_be_read_is_refused(make: Callable[[Blanket], Any], words: str) -> None:
    net, evidence = tiny(0)
    with pytest.raises(UnsupportedError, match=words):
        exact_sweep(net, evidence, Sweeping(make))


def test_raw_bits_in_another_layout_are_refused() -> None:
    graph = bmc.FactorGraph(plates={"row": 2, "column": 3})
    graph.variable("s", (-1, 1), plates=("row", "column"))
    r, c = np.indices((2, 2)).reshape(2, -1)
    graph.factor(lambda a, b: 0.3 * a * b, scope=("s", "s"), index=((r, c), (r, c + 1)))
    with pytest.raises(UnsupportedError, match="exact_sweep: the kernel of 's'"):
        exact_sweep(graph, None, Sweeping(lattice_kernel))


def test_an_impossible_state_is_reported() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Bernoulli(0.3))
    net.add("y", bmc.Bernoulli(0.5))
    net.add("equal", lambda x, y: bmc.Bernoulli(1.0 * (x == y)))
    with pytest.raises(ZeroProbabilityError, match=r"from {'x': 0, 'y': 0} the kernel of 'x'"):
        exact_sweep(net, {"equal": 1}, Sweeping(lambda blanket: Otherwise(blanket, "flip")))


def test_nets_that_have_no_matrix_are_refused() -> None:
    net = bmc.BayesNet()
    net.add("n", bmc.Poisson(3.0))
    net.add("k", lambda n: bmc.Binomial(n, 0.5))
    with pytest.raises(UnsupportedError, match="'n' is hidden and has infinitely many"):
        exact_sweep(net, {"k": 1}, bmc.MetropolisHastings())
    with pytest.raises(UnsupportedError, match="give evidence"):
        exact_sweep(net, {"n": 4}, bmc.MetropolisHastings())
    wide = bmc.BayesNet(plates={"i": 11})
    wide.add("z", bmc.Bernoulli(0.5), plates="i")
    wide.add("y", lambda z: bmc.Bernoulli(0.2 + 0.6 * z), plates="i")
    with pytest.raises(BudgetError, match="2048 joint states"):
        exact_sweep(wide, {"y": np.zeros(11, dtype=int)}, ONE_BY_ONE)


# ---- the chi-square test itself -----------------------------------------------------------------


def test_p_values_of_a_right_matrix_are_uniform() -> None:
    """500 dependent paths: the share below 0.1 is off by three standard errors with chance 0.003."""
    chain = MarkovChain([[0.7, 0.2, 0.1], [0.3, 0.4, 0.3], [0.05, 0.15, 0.8]])
    found = []
    for seed in range(500):
        path = chain.simulate(0, 400, rng=seed)
        counts = np.zeros((3, 3), dtype=int)
        np.add.at(counts, (path[:-1], path[1:]), 1)
        found.append(transition_p_value(chain.transition, counts))
    assert abs(np.mean(np.array(found) < 0.1) - 0.1) < 3 * np.sqrt(0.09 / 500)
    assert abs(np.mean(found) - 0.5) < 3 * np.sqrt(1 / 12 / 500)


def test_p_value_checks_its_arguments() -> None:
    with pytest.raises(ShapeError, match="two square arrays"):
        transition_p_value(np.eye(2), np.eye(3))
    assert transition_p_value(np.eye(2), [[5, 0], [0, 5]]) == 1.0
    assert transition_p_value(np.eye(2), [[5, 1], [0, 5]]) == 0.0
    # states that are hardly visited are taken together, or left out
    assert transition_p_value([[0.99, 0.01], [0.5, 0.5]], [[97, 3], [1, 2]]) > 0.01
