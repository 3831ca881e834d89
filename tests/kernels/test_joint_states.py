"""Blocks of finite nodes: which are found, whether they connect what is possible, and what they draw."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from scipy import stats

import bayesmc as bmc
from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import UnsupportedError, ZeroProbabilityError
from bayesmc.kernels.coupling import coupled_blocks, deterministic_constraints
from bayesmc.kernels.enumerate import FiniteTerms, JointStates
from bayesmc.kernels.tables import TableSweep, joint_states
from bayesmc.network import BayesNet, pose
from bayesmc.structure.target import Target, Values, target_of

#: false alarms of every statistical test here
ALPHA = 1e-4


@pytest.fixture(autouse=True)
def _as_in_a_sweep():
    """Engines silence floating-point warnings around all kernels."""
    with np.errstate(all="ignore"):
        yield


def asia() -> BayesNet:
    """Lauritzen and Spiegelhalter (1988)."""
    net = bmc.BayesNet()
    net.table("asia", [], [0.99, 0.01])
    net.table("tub", ["asia"], [[0.99, 0.01], [0.95, 0.05]])
    net.table("smoke", [], [0.5, 0.5])
    net.table("lung", ["smoke"], [[0.99, 0.01], [0.9, 0.1]])
    net.table("bronc", ["smoke"], [[0.7, 0.3], [0.4, 0.6]])
    net.table("either", ["tub", "lung"], [[[1, 0], [0, 1]], [[0, 1], [0, 1]]])
    net.table("xray", ["either"], [[0.95, 0.05], [0.02, 0.98]])
    net.table("dysp", ["either", "bronc"], [[[0.9, 0.1], [0.2, 0.8]], [[0.3, 0.7], [0.1, 0.9]]])
    return net


def parity(plates: int | None = None) -> BayesNet:
    net = bmc.BayesNet(plates=None if plates is None else {"i": plates})
    own = {} if plates is None else {"plates": "i"}
    net.add("x", bmc.Bernoulli(0.3), **own)
    net.add("y", bmc.Categorical([0.2, 0.3, 0.5]), **own)
    net.add("odd", lambda x, y: bmc.Bernoulli(((x + y) % 2) * 1.0), **own)
    return net


def everything(target: Target) -> tuple[Values, np.ndarray, list[int]]:
    """All joint states of finite chain nodes without plates, as chains, and their probabilities."""
    domains = [target.model[n].domain for n in target.chain]
    cards = [d.size for d in domains if d is not None]
    assert len(cards) == len(target.chain)
    grid = np.indices(cards).reshape(len(cards), -1).astype(np.uint8)
    values: Values = {**target.known, **dict(zip(target.chain, grid, strict=True))}
    with marking_invalid(), np.errstate(all="ignore"):
        target.refresh(values, target.chain)
        log = target.log_density(values)
    probs = np.exp(log - log.max())
    return values, probs / probs.sum(), cards


def is_connected(
    possible: np.ndarray, names: Sequence[str], blocks: Sequence[Sequence[str]]
) -> bool:
    """Whether single moves and blocks connect the possible states, by growing from the first."""
    moves = [(i,) for i in range(possible.ndim)]
    moves += [tuple(names.index(n) for n in block) for block in blocks]
    reached = np.zeros_like(possible)
    reached[tuple(np.argwhere(possible)[0])] = True
    while True:
        before = reached.sum()
        for move in moves:
            reached = reached.any(axis=move, keepdims=True) & possible
        if reached.sum() == before:
            return bool((reached == possible).all())


def test_the_asia_net_moves_tub_lung_and_either_together() -> None:
    target = target_of(pose(asia(), {"xray": 1, "dysp": 1}))
    assert coupled_blocks(target) == [("tub", "lung", "either")]
    assert deterministic_constraints(target) == ()
    # negative control: one at a time either is frozen whenever tub or lung says so
    assert deterministic_constraints(target, blocks=()) == ("tub", "lung", "either")
    # where either is seen, its parents are tied by it
    seen = target_of(pose(asia(), {"either": 1}))
    assert coupled_blocks(seen) == []  # both at once is possible, and connects
    assert deterministic_constraints(seen) == ()


def test_positive_tables_make_no_blocks() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Bernoulli(0.5))
    net.add("y", lambda x: bmc.Bernoulli(0.1 + 0.8 * x))
    net.add("z", lambda y: bmc.Bernoulli(0.1 + 0.8 * y))
    assert coupled_blocks(target_of(pose(net, {"z": 1}))) == []
    # nearly deterministic is as bad as deterministic for mixing, but no constraint
    near = bmc.BayesNet()
    near.add("x", bmc.Bernoulli(0.5))
    near.add("y", lambda x: bmc.Bernoulli(1e-9 + (1 - 2e-9) * x))
    near.add("z", lambda y: bmc.Bernoulli(0.1 + 0.8 * y))
    target = target_of(pose(near, {"z": 1}))
    assert coupled_blocks(target) == [("x", "y")]
    assert deterministic_constraints(target, blocks=()) == ()


def test_chains_of_copies_grow_up_to_a_limit() -> None:
    net = bmc.BayesNet()
    net.add("x0", bmc.Bernoulli(0.5))
    for k in range(1, 12):
        net.table(f"x{k}", [f"x{k - 1}"], np.eye(2))
    net.table("seen", ["x11"], [[0.8, 0.2], [0.3, 0.7]])
    target = target_of(pose(net, {"seen": 1}))
    blocks = coupled_blocks(target)
    assert max(map(len, blocks)) == 8  # 2**8 = 256
    # twelve copies need one block of 4,096 states: said, not hidden
    assert deterministic_constraints(target, blocks) == target.chain
    short = [f"x{k}" for k in range(12)]
    assert deterministic_constraints(target, [short]) == ()


def sparse_net(rng: np.random.Generator) -> tuple[BayesNet, dict[str, int]]:
    """A net many of whose entries are zero, and evidence that can be."""
    net = bmc.BayesNet()
    cards: dict[str, int] = {}
    for k in range(int(rng.integers(4, 8))):
        count = min(len(cards), int(rng.integers(3)))
        parents = (
            [str(n) for n in rng.choice(list(cards), size=count, replace=False)] if cards else []
        )
        cards[f"x{k}"] = int(rng.integers(2, 4))
        probs = rng.dirichlet(np.ones(cards[f"x{k}"]), size=tuple(cards[p] for p in parents))
        probs = np.where(rng.random(probs.shape) < 0.5, 0.0, probs)
        probs[..., 0] += probs.sum(axis=-1) == 0
        net.table(f"x{k}", parents, probs / probs.sum(axis=-1, keepdims=True))
    draw = net.sample(1, rng=int(rng.integers(1000)))
    seen = [n for n in cards if rng.random() < 0.3] or [f"x{len(cards) - 1}"]
    return net, {n: int(draw[n][0]) for n in seen}


def test_what_is_called_connected_is() -> None:
    connected = blocked = apart = flagged = 0
    for seed in range(300):
        net, evidence = sparse_net(np.random.default_rng([seed, 9]))
        target = target_of(pose(net, evidence))
        if len(target.chain) < 2:
            continue
        _, probs, cards = everything(target)
        possible = (probs > 0).reshape(cards)
        blocks = coupled_blocks(target)
        for moves in ([], blocks):
            if deterministic_constraints(target, moves):
                flagged += is_connected(possible, target.chain, moves)
            else:
                assert is_connected(possible, target.chain, moves), seed
                connected += 1
        apart += not is_connected(possible, target.chain, [])
        blocked += bool(blocks)
    assert connected > 150 and blocked > 10 and apart > 10
    # and it does not cry wolf: what is small is settled
    assert flagged <= connected // 20


@pytest.mark.parametrize("kind", [TableSweep, JointStates, "row sums"])
def test_draws_follow_the_joint_law(kind: Any) -> None:
    target = target_of(pose(parity(), {"odd": 1}))
    kernel = joint_states(target, ("x", "y"))
    assert isinstance(kernel, TableSweep)
    if kind is JointStates:
        kernel = JointStates(target, ("x", "y"))
    if kind == "row sums":
        kernel = JointStates(target, ("x", "y"), FiniteTerms(target))
    everyone, probs, cards = everything(target)
    chains = 100_000
    start = {"x": np.ones(chains, dtype=np.uint8), "y": np.zeros(chains, dtype=np.uint8)}
    rng = np.random.Generator(np.random.SFC64(2))
    new, _ = kernel.step({**target.known, **start}, {}, rng, False)
    counts = np.bincount(new["x"].astype(int) * cards[1] + new["y"], minlength=len(probs))
    assert not counts[probs == 0].any()
    keep = probs > 0
    assert stats.chisquare(counts[keep], probs[keep] * chains)[1] > ALPHA
    # negative control
    even = keep / keep.sum()
    assert stats.chisquare(counts[keep], even[keep] * chains)[1] < ALPHA


def test_a_block_with_continuous_children_equals_the_model() -> None:
    net = bmc.BayesNet(plates={"n": 5})
    net.add("a", bmc.Categorical([0.2, 0.3, 0.5]))
    net.add("b", lambda a: bmc.Bernoulli(0.2 + 0.3 * a))
    net.add("shift", bmc.Normal(0.0, 1.0))
    net.add("level", lambda a, b: 1.5 * a - b)
    net.add("y", lambda level, shift: bmc.Normal(level + shift, 0.7), plates="n")
    target = target_of(pose(net, {"y": [0.3, 1.0, 0.2, -0.5, 0.9]}))
    kernel = joint_states(target, ("a", "b"))
    assert isinstance(kernel, JointStates)
    chains = 4
    rng = np.random.default_rng(0)
    values: Values = {
        **target.known,
        "a": rng.integers(3, size=chains).astype(np.uint8),
        "b": rng.integers(2, size=chains).astype(np.uint8),
        "shift": rng.normal(size=chains),
    }
    target.refresh(values, target.chain)
    found = kernel.log_density(values)
    for k, (a, b) in enumerate(np.ndindex(3, 2)):
        other = {**values, "a": np.full(chains, a), "b": np.full(chains, b)}
        target.refresh(other, target.chain)
        expected = target.log_density(other)
        if k == 0:
            offset = found[0] - expected
        np.testing.assert_allclose(found[k] - expected, offset, atol=1e-9)
    new, _ = kernel.step(values, {}, rng, False)
    assert set(new) == {"a", "b"} and new["a"].dtype == np.uint8


def test_blocks_with_large_blankets_sum_rows() -> None:
    rng = np.random.default_rng(0)
    net = bmc.BayesNet()
    net.add("a", bmc.Categorical([0.2, 0.3, 0.5]))
    net.table("b", ["a"], rng.dirichlet(np.ones(2), size=3))
    for k in range(7):
        net.add(f"p{k}", bmc.Categorical(rng.dirichlet(np.ones(5))))
        net.table(f"y{k}", ["b", f"p{k}", "a"], rng.dirichlet(np.ones(2), size=(2, 5, 3)))
    target = target_of(pose(net, {f"y{k}": k % 2 for k in range(7)}))
    kernel = joint_states(target, ("b", "a"))
    assert isinstance(kernel, JointStates) and not kernel.evaluated
    values: Values = {**target.known}
    for name in target.chain:
        domain = target.model[name].domain
        assert domain is not None
        values[name] = rng.integers(domain.size, size=9).astype(np.uint8)
    found = kernel.log_density(values)
    expected = JointStates(target, ("b", "a")).log_density(values)
    np.testing.assert_allclose(found - found[0], expected - expected[0], atol=1e-9)
    # negative control: other states of the rest give another law
    other = {**values, "p0": ((values["p0"] + 1) % 5).astype(np.uint8)}
    moved = kernel.log_density(other)
    assert abs((moved - moved[0]) - (found - found[0])).max() > 1e-3


def test_blocks_of_a_plate() -> None:
    seen = np.ma.masked_array([0, 1, 0, 1], mask=[True, False, True, True])
    target = target_of(pose(parity(4), {"odd": [1, 0, 0, 1], "x": seen}))
    assert coupled_blocks(target) == [("x", "y")]
    assert deterministic_constraints(target) == ()
    kernel = joint_states(target, ("x", "y"))
    assert isinstance(kernel, JointStates)
    chains = 100_000
    values: Values = {
        **target.known,
        "x": np.tile(np.array([1, 1, 0, 1], dtype=np.uint8), (chains, 1)),
        "y": np.tile(np.array([0, 1, 0, 0], dtype=np.uint8), (chains, 1)),
    }
    new, _ = kernel.step(values, {}, np.random.Generator(np.random.SFC64(0)), False)
    assert (new["x"][:, 1] == 1).all()
    assert ((new["x"] + new["y"]) % 2 == [1, 0, 0, 1]).all()
    joint = np.outer([0.7, 0.3], [0.2, 0.3, 0.5])
    odd = np.add.outer(np.arange(2), np.arange(3)) % 2
    for element, wanted in ((0, 1), (2, 0), (3, 1)):
        law = np.where(odd == wanted, joint, 0.0).ravel()
        counts = np.bincount(new["x"][:, element] * 3 + new["y"][:, element], minlength=6)
        keep = law > 0
        expected = law[keep] / law.sum() * chains
        assert stats.chisquare(counts[keep], expected)[1] > ALPHA


def test_what_makes_no_block_is_refused() -> None:
    net = parity(4)
    net.add("alone", bmc.Bernoulli(0.5))
    net.add("sum", lambda x, alone: bmc.Normal(x.sum("i") + alone, 1.0))
    net.add("number", bmc.Poisson(2.0))
    net.add("tally", lambda number, alone: bmc.Normal(number + alone, 1.0))
    target = target_of(pose(net, {"odd": [1, 0, 0, 1], "sum": 1.0, "tally": 2.0}))
    with pytest.raises(UnsupportedError, match="across elements"):
        joint_states(target, ("x", "y"))
    with pytest.raises(UnsupportedError, match="different plates"):
        joint_states(target, ("x", "alone"))
    with pytest.raises(UnsupportedError, match="no joint states"):
        joint_states(target, ("alone", "number"))


def test_an_impossible_configuration_is_named() -> None:
    net = bmc.BayesNet()
    net.add("top", bmc.Bernoulli(0.5))
    net.add("x", bmc.Bernoulli(0.5))
    net.add("y", bmc.Bernoulli(0.5))
    table = np.zeros((2, 2, 2, 2))
    table[0, ..., 0] = table[1, ..., 0] = 0.5
    table[0, ..., 1] = table[1, ..., 1] = 0.5
    table[1] = [1.0, 0.0]
    net.table("seen", ["top", "x", "y"], table)
    target = target_of(pose(net, {"seen": 1}))
    values = {**target.known, **{n: np.ones(2, dtype=np.uint8) for n in ("top", "x", "y")}}
    for kernel in (joint_states(target, ("x", "y")), JointStates(target, ("x", "y"))):
        with pytest.raises(ZeroProbabilityError, match="'x', 'y'"):
            kernel.step(values, {}, np.random.default_rng(0), False)
