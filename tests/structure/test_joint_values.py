"""Values of many nodes as one array: never stale, whoever moved one of them, and smaller programs."""

from __future__ import annotations

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.expression import Pick, elementwise, evaluate, leaf, ordered, pick
from bayesmc.kernels.conjugate import Conjugate, conjugate_kernel
from bayesmc.kernels.forest_block import ForestBlock
from bayesmc.network import pose
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.programs import FEWEST, JointValues
from bayesmc.structure.target import Target, target_of

STEPS = FEWEST + 4


def hidden_chain() -> Target:
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("level", bmc.Normal(0.0, 3.0))
    dbn.add_static("stay", bmc.Beta(2.0, 2.0))
    dbn.add(
        "s",
        lambda s_prev, stay: bmc.Bernoulli(np.where(s_prev == 1, stay, 1 - stay)),
        initial=bmc.Bernoulli(0.5),
    )
    dbn.add("y", lambda s, level: bmc.Normal(level * s, 1.0))
    rows = np.random.default_rng(0).normal(size=STEPS)
    return target_of(pose(dbn.unroll(STEPS), dbn.unrolled_evidence({"y": rows})))


@pytest.fixture(scope="module")
def target() -> Target:
    return hidden_chain()


@pytest.fixture(scope="module")
def block(target: Target) -> ForestBlock:
    return ForestBlock(target, [f"s[{t}]" for t in range(STEPS)])


def state_of(target: Target) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    states = {f"s[{t}]": rng.integers(0, 2, 3).astype(np.uint8) for t in range(STEPS)}
    return {**target.known, **states, "level": rng.normal(size=3), "stay": rng.random(3)}


@pytest.mark.parametrize("name", ["level", "stay"])
def test_conditionals_are_the_same(target: Target, block: ForestBlock, name: str) -> None:
    """Whether nobody, the block that draws them, or somebody else since then has left the values."""
    plain = conjugate_kernel(Blanket(target, name))
    assert isinstance(plain, Conjugate) and block.joint is not None
    reading = plain.reading([block.joint])
    state = state_of(target)
    left = {**state, **block.step(state, {}, np.random.default_rng(2), False)[0]}
    assert block.joint.key in left
    moved = {**left, "s[3]": 1 - left["s[3]"]}
    for values in (state, left, moved):
        (own, _), (other, _) = plain.forms[0](values), reading.forms[0](values)
        for a, b in zip(own, other, strict=True):
            np.testing.assert_allclose(*np.broadcast_arrays(a, b), rtol=1e-12)
    assert block.joint.placed(left) is left
    assert block.joint.placed(moved) is not moved


def test_parts_of_one_array_are_one_pick() -> None:
    whole = leaf("whole", (5,))
    parts = [elementwise(np.negative, pick([whole], [k])) for k in (3, 1)]
    joined = pick([pick([whole], k) for k in (4, 0, 2)], [2, 0, 0, 1])
    assert [type(n) for n in ordered(joined)][1:] == [Pick]
    value = np.arange(10.0).reshape(2, 5)
    np.testing.assert_array_equal(evaluate([joined], {"whole": value})[0], value[:, [2, 4, 4, 0]])
    mixed = pick([*parts, pick([whole], 0)], [[2], [0], [1]])
    expected = np.stack([value[:, 0], -value[:, 3], -value[:, 1]], axis=1)[..., None]
    np.testing.assert_array_equal(evaluate([mixed], {"whole": value})[0].reshape(2, 3, 1), expected)


def test_values_of_one_row_join_values_of_many() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("b", bmc.Normal(0.0, 1.0))
    joint = JointValues(net.model(), ["a", "b"])
    state = joint.placed({"a": np.ones(3), "b": np.zeros(1)})
    np.testing.assert_array_equal(state[joint.key], [[1.0, 0.0]] * 3)
