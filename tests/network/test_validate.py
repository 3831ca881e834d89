"""validate(): every kind of bad function is caught wherever it stands, and no good one is refused."""

from __future__ import annotations

import math
import re
import tracemalloc
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import (
    BayesmcError,
    BroadcastError,
    DensityError,
    ModelError,
    ParameterError,
    ShapeError,
)
from tests.network.zoo import ZOO, build

# ---- no false alarms ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", ZOO)
def test_good_models_pass(name):
    net, inputs = build(name)
    net.validate(inputs)
    draws = net.sample(7, rng=1, inputs=inputs)
    assert all(len(v) == 7 for v in draws.values())
    # what was sampled is possible, element by element
    density = net.log_prob(
        {k: v for k, v in draws.items() if k not in (inputs or {})}, inputs=inputs
    )
    assert density.shape == (7,) and np.isfinite(density).all()


def test_the_zoo_is_large():
    assert len(ZOO) >= 60


# ---- batches: caught wherever the parent stands -------------------------------------------------

MIXES_BATCH = {
    "mean": lambda x: x - x.mean(),
    "np.mean": lambda x: x - np.mean(x),
    "sum": lambda x: x / np.sum(np.abs(x)),
    "max": lambda x: x - np.max(x),
    "mean of first axis": lambda x: x - x.mean(axis=0) if np.ndim(x) else x,
    "mean of last axis": lambda x: x - x.mean(axis=-1, keepdims=True) if np.ndim(x) else x,
    "cumsum of last axis": lambda x: np.cumsum(x, axis=-1) if np.ndim(x) else x,
    "cumsum of first axis": lambda x: np.cumsum(x, axis=0) if np.ndim(x) else x,
    "sort": lambda x: np.sort(x, axis=-1) if np.ndim(x) else x,
    "reverse": lambda x: x[::-1] if np.ndim(x) else x,
    "roll": lambda x: np.roll(x, 1) if np.ndim(x) else x,
    "rank": lambda x: np.argsort(np.argsort(x, axis=-1), axis=-1) * 1.0 if np.ndim(x) else x,
    "first": lambda x: x + np.ravel(x)[0],
    "norm": lambda x: x / np.linalg.norm(x),
    "size": lambda x: x * np.size(x),
    "ndim": lambda x: x + np.ndim(x),
    "swap axes": lambda x: np.resize(np.swapaxes(x, 0, 1), x.shape) if np.ndim(x) == 2 else x,
    "position": lambda x: x + np.arange(x.size).reshape(np.shape(x)),
    "if": lambda x: x + 1.0 if np.all(x > 0) else x,
    "any": lambda x: np.where(np.any(x > 0), x, -x),
}


@pytest.mark.parametrize("position", range(6))
@pytest.mark.parametrize(
    "mix",
    [m for k, m in MIXES_BATCH.items() if k != "sort"],
    ids=[k for k in MIXES_BATCH if k != "sort"],
)
def test_mixing_the_batch_is_caught(mix, position):
    """The parent is the first to the sixth root, so that no rank of the probe can hide the fault."""
    net = bmc.BayesNet()
    for i in range(position + 1):
        net.add(f"r{i}", bmc.Normal(0.0, 1.0))
    net.add("bad", lambda x: bmc.Normal(mix(x), 1.0), parents=[f"r{position}"])
    with pytest.raises(BroadcastError, match=r"node 'bad'.*(axis=-1|last axis).*vectorize=True"):
        net.validate()


def test_sorting_the_batch_is_caught():
    """Two values are in order by chance every second time, so many positions are tried."""
    for position in range(8):
        net = bmc.BayesNet()
        for i in range(position + 1):
            net.add(f"r{i}", bmc.Normal(0.0, 1.0))
        net.add("bad", lambda x: bmc.Normal(MIXES_BATCH["sort"](x), 1.0), parents=[f"r{position}"])
        with pytest.raises(BroadcastError, match="node 'bad'"):
            net.validate()


@pytest.mark.parametrize(
    "mix", [m for k, m in MIXES_BATCH.items() if k not in ("if", "any", "sort")]
)
def test_mixing_the_batch_in_a_deterministic_node_is_caught(mix):
    net = bmc.BayesNet()
    for i in range(3):
        net.add(f"r{i}", bmc.Gamma(2.0, 1.0))
    net.add("bad", lambda x: mix(x), parents=["r2"])
    with pytest.raises(BayesmcError, match="node 'bad'"):
        net.validate()


@pytest.mark.parametrize("depth", range(1, 5))
def test_mixing_the_batch_deep_in_a_chain_is_caught(depth):
    net = bmc.BayesNet()
    net.add("x0", bmc.Normal(0.0, 1.0))
    for i in range(depth):
        net.add(f"x{i + 1}", lambda x: bmc.Normal(x, 1.0), parents=[f"x{i}"])
    net.add("bad", lambda x: bmc.Normal(x - x.mean(), 1.0), parents=[f"x{depth}"])
    with pytest.raises(BroadcastError, match="node 'bad' does not broadcast"):
        net.validate()


@pytest.mark.parametrize("position", range(5))
def test_mixing_a_discrete_batch_is_caught(position):
    net = bmc.BayesNet()
    for i in range(position + 1):
        net.add(f"r{i}", bmc.Bernoulli(0.5) if i % 2 == 0 else bmc.Poisson(4.0))
    net.add("bad", lambda x: bmc.Normal(np.cumsum(x)[-1] + x, 1.0), parents=[f"r{position}"])
    with pytest.raises(BroadcastError, match="node 'bad'"):
        net.validate()


NOT_ARRAYS = {
    "if": lambda x: bmc.Normal(1.0 if x > 0 else 0.0, 1.0),
    "float": lambda x: bmc.Normal(float(x), 1.0),
    "math": lambda x: bmc.Normal(__import__("math").exp(x), 1.0),
    "min": lambda x: bmc.Normal(min(x, 0.0), 1.0),
    "list": lambda x: bmc.MvNormal([x, 0.0], np.eye(2)),
    "range": lambda x: bmc.Normal(sum(range(int(x * x))), 1.0),
    "and": lambda x: bmc.Bernoulli(0.9 if (x > 0 and x < 1) else 0.1),
}


@pytest.mark.parametrize("function", NOT_ARRAYS.values(), ids=NOT_ARRAYS)
def test_functions_of_single_values_are_told_how_to_broadcast(function):
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", function)
    with pytest.raises(
        BroadcastError,
        match=r"node 'y' (works on one value at a time but not on arrays|does not broadcast)",
    ) as caught:
        net.validate()
    assert re.search("np.where for if|np.exp for math.exp", str(caught.value))
    assert "vectorize=True" in str(caught.value)


def test_math_is_told_to_be_numpy():
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda x: bmc.Normal(math.exp(x), 1.0))
    with pytest.raises(BroadcastError, match=r"np\.exp for math\.exp"):
        net.validate()


def test_components_stacked_on_the_first_axis_are_sent_to_the_last():
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda x: bmc.MvNormal(np.array([x, 2 * x]), np.eye(2)))
    with pytest.raises(
        BayesmcError, match=r"node 'y'.*(components of a vector on the last axis|axis=-1)"
    ):
        net.validate()


def test_a_constant_over_a_foreign_plate_is_not_taken_for_a_batch():
    """A plain array is a value of the child; constants along foreign plates meet v.array."""
    weight = np.array([0.2, 0.5, 0.9])
    net = bmc.BayesNet(plates={"k": 3})
    net.add("x", bmc.Bernoulli(0.5), plates="k")
    net.add("y", lambda x: bmc.Normal((weight * x).sum("k"), 1.0))
    with pytest.raises(BayesmcError, match="node 'y'"):
        net.validate()


@pytest.mark.parametrize("name", ["if", "float", "math", "min", "and"])
def test_vectorize_takes_functions_of_single_values(name):
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", NOT_ARRAYS[name], vectorize=True)
    draws = net.sample(5, rng=0)
    expected = net.log_prob({"x": draws["x"]} | {"y": draws["y"]})
    one = [net.log_prob({"x": draws["x"][i], "y": draws["y"][i]}) for i in range(5)]
    np.testing.assert_allclose(expected, one, rtol=1e-12)


def test_a_wrong_axis_of_a_vector_is_caught():
    """v[0] instead of v[..., 0]; a sum over all axes instead of the last."""
    for bad in (lambda v: v[0], lambda v: v.sum(), lambda v: v.sum(axis=0), lambda v: v[:, 0]):
        net = bmc.BayesNet()
        net.add("v", bmc.MvNormal(np.zeros(4), np.eye(4)))
        net.add("y", lambda v, bad=bad: bmc.Normal(bad(v), 1.0))
        with pytest.raises(BayesmcError, match="node 'y'"):
            net.validate()


def test_matmul_with_the_batch_is_caught():
    """X @ beta works on one vector and goes wrong on a batch of them."""
    design = np.arange(12.0).reshape(4, 3)
    net = bmc.BayesNet(plates={"point": 4})
    net.add("beta", bmc.MvNormal(np.zeros(3), np.eye(3)))
    net.add("y", lambda beta: bmc.Normal(design @ beta, 1.0), plates="point")
    with pytest.raises(BayesmcError, match="node 'y'"):
        net.validate()


def test_a_family_that_depends_on_the_batch_is_caught():
    for position in range(4):
        net = bmc.BayesNet()
        for i in range(position + 1):
            net.add(f"r{i}", bmc.Normal(0.0, 1.0))
        net.add(
            "y",
            lambda x: bmc.Normal(x, 1.0) if np.ndim(x) == 0 else bmc.StudentT(3.0, x, 1.0),
            parents=[f"r{position}"],
        )
        with pytest.raises(
            BroadcastError, match=r"node 'y' does not broadcast.*StudentT against Normal"
        ):
            net.validate()


def test_a_fault_on_mixed_ranks_only_is_caught():
    """np.stack works where all parents have one batch shape; bmc.stack is the remedy."""
    net = bmc.BayesNet()
    for name in "abcd":
        net.add(name, bmc.Normal(0.0, 1.0))
    net.add("v", lambda a, b, c, d: bmc.MvNormal(np.stack([a, b, c, d], axis=-1), np.eye(4)))
    with pytest.raises(BroadcastError, match="node 'v'"):
        net.validate()


# ---- plates -------------------------------------------------------------------------------------

MIXES_PLATE = {
    "mean": lambda x: x.mean(axis=-1, keepdims=True) + 0 * x,
    "centre": lambda x: x - x.mean(axis=-1, keepdims=True),
    "normalise": lambda x: x / np.abs(x).sum(axis=-1, keepdims=True),
    "cumsum": lambda x: np.cumsum(x, axis=-1),
    "cumsum backwards": lambda x: np.cumsum(x[..., ::-1], axis=-1)[..., ::-1],
    "sort": lambda x: np.sort(x, axis=-1),
    "roll": lambda x: np.roll(x, 1, axis=-1),
    "roll back": lambda x: np.roll(x, -1, axis=-1),
    "reverse": lambda x: x[..., ::-1],
    "previous": lambda x: np.concatenate([x[..., :1], x[..., :-1]], axis=-1),
    "difference": lambda x: np.diff(x, axis=-1, prepend=0.0),
    "first": lambda x: x - x[..., :1],
    "last": lambda x: x - x[..., -1:],
    "middle": lambda x: x - x[..., 2:3],
    "swap of the middle": lambda x: x[..., [0, 1, 3, 2, 4, 5, 6]],
    "softmax": lambda x: np.exp(x) / np.exp(x).sum(axis=-1, keepdims=True),
    "max": lambda x: np.maximum(x, x.max(axis=-1, keepdims=True)),
    "rank": lambda x: np.argsort(np.argsort(x, axis=-1), axis=-1) * 1.0,
    "neighbour in the middle": lambda x: (
        x + np.where(np.arange(7) == 3, np.roll(x, 1, axis=-1), 0.0)
    ),
}


@pytest.mark.parametrize("deterministic", [False, True], ids=["distribution", "array"])
@pytest.mark.parametrize("mix", MIXES_PLATE.values(), ids=MIXES_PLATE)
def test_mixing_a_shared_plate_is_caught(mix, deterministic):
    net = bmc.BayesNet(plates={"p": 7})
    net.add("x", bmc.Normal(0.0, 1.0), plates="p")
    net.add("bad", lambda x: mix(x) if deterministic else bmc.Normal(mix(x), 1.0), plates="p")
    with pytest.raises(
        BroadcastError, match=r"node 'bad'.*element by element.*unplated deterministic node"
    ):
        net.validate()


@pytest.mark.parametrize(
    "family",
    [
        bmc.Poisson(1e-3),
        bmc.Poisson(5.0),
        bmc.Bernoulli(1e-6),
        bmc.Uniform(0.0, 1.0),
        bmc.Beta(1.0, 1.0),
    ],
    ids=["rare counts", "counts", "rare bits", "unit interval", "beta"],
)
@pytest.mark.parametrize("mix", ["cumsum", "first", "middle", "last"])
def test_mixing_is_caught_whatever_the_parent(family, mix):
    net = bmc.BayesNet(plates={"p": 7})
    net.add("x", family, plates="p")
    net.add("bad", lambda x: bmc.Normal(MIXES_PLATE[mix](x), 1.0), plates="p")
    with pytest.raises(BroadcastError, match=r"node 'bad'.*element by element"):
        net.validate()


@pytest.mark.parametrize("plates", [("p", "q"), ("q", "p")])
@pytest.mark.parametrize("axis", [-1, -2])
def test_mixing_either_of_two_plates_is_caught(plates, axis):
    net = bmc.BayesNet(plates={"p": 3, "q": 3})
    net.add("x", bmc.Normal(0.0, 1.0), plates=("p", "q"))
    net.add("bad", lambda x: bmc.Normal(np.cumsum(x, axis=axis), 1.0), plates=plates)
    with pytest.raises(BroadcastError, match=rf"node 'bad'.*'{plates[axis]}'.*element by element"):
        net.validate()


def test_mixing_through_one_of_two_parents_is_caught():
    net = bmc.BayesNet(plates={"p": 5})
    net.add("x", bmc.Normal(0.0, 1.0), plates="p")
    net.add("z", bmc.DiscreteUniform(0, 3), plates="p")
    net.add("bad", lambda x, z: bmc.Normal(x + np.cumsum(z, axis=-1), 1.0), plates="p")
    with pytest.raises(BroadcastError, match="node 'bad'"):
        net.validate()


def test_mixing_a_vector_plate_is_caught_and_components_are_free_to_mix():
    net = bmc.BayesNet(plates={"p": 5})
    net.add("v", bmc.MvNormal(np.zeros(3), np.eye(3)), plates="p")
    net.add("good", lambda v: bmc.MvNormal(np.cumsum(v, axis=-1), np.eye(3)), plates="p")
    net.validate()
    net.add("bad", lambda v: bmc.MvNormal(np.cumsum(v, axis=-2), np.eye(3)), plates="p")
    with pytest.raises(BroadcastError, match="node 'bad'.*element by element"):
        net.validate()


def test_mixing_states_is_caught():
    net = bmc.BayesNet(plates={"p": 5})
    net.add("z", bmc.Bernoulli(0.5), plates="p", states=("no", "yes"))
    net.add("bad", lambda z: bmc.Bernoulli(0.1 + 0.1 * np.cumsum(z == "yes", axis=-1)), plates="p")
    with pytest.raises(BroadcastError, match="node 'bad'.*element by element"):
        net.validate()


def test_mixing_two_elements_inside_a_large_plate_is_caught():
    def bad(x):
        if x.shape[-1] < 50:
            return bmc.Normal(x, 1.0)
        moved = np.array(x)
        moved[..., 30] = x[..., 20]
        return bmc.Normal(moved, 1.0)

    net = bmc.BayesNet(plates={"p": 50})
    net.add("x", bmc.Normal(0.0, 1.0), plates="p")
    net.add("bad", bad, plates="p")
    with pytest.raises(BroadcastError, match="node 'bad'.*element by element"):
        net.validate()


def test_mixing_in_parameters_of_small_scale_is_caught():
    net = bmc.BayesNet(plates={"p": 7})
    net.add("x", bmc.Normal(0.0, 1.0), plates="p")
    net.add(
        "bad",
        lambda x: bmc.Normal(x, 1e-15 * (2 + np.tanh(x.sum(axis=-1, keepdims=True)))),
        plates="p",
    )
    with pytest.raises(BroadcastError, match="node 'bad'.*element by element"):
        net.validate()


@pytest.mark.filterwarnings("ignore:evidence on .* is empty:bayesmc.errors.EvidenceWarning")
def test_mixing_is_looked_for_again_after_a_plate_of_size_one():
    """One data point cannot show mixing, so a net is not taken for good by it."""

    def net():
        n = bmc.BayesNet(plates={"p": None})
        n.add("x", bmc.Normal(0.0, 1.0), plates="p")
        n.add("y", lambda x: bmc.Normal(np.cumsum(x, axis=-1), 1.0), plates="p")
        return n

    draws = bmc.LikelihoodWeighting(2000)
    for earlier in ([[]], [[1.0]], [[1.0], [2.0]]):
        n = net()
        for data in earlier:
            bmc.infer(n, {"y": data}, engine=draws, rng=0)
        with pytest.raises(BroadcastError, match="node 'y'.*element by element"):
            bmc.infer(n, {"y": [1.0, 2.0, 3.0]}, engine=draws, rng=0)
    with pytest.raises(BroadcastError, match="node 'y'.*element by element"):
        n.sample(2, rng=0, plates={"p": 3})


def test_mixing_is_looked_for_again_while_one_of_two_plates_is_of_size_one():
    n = bmc.BayesNet(plates={"p": None, "q": None})
    n.add("x", bmc.Normal(0.0, 1.0), plates="p")
    n.add("z", bmc.Normal(0.0, 1.0), plates="q")
    n.add("y", lambda x: bmc.Normal(x, 1.0), plates="p")
    n.add("w", lambda z: bmc.Normal(z - z.max(axis=-1, keepdims=True), 1.0), plates="q")
    n.sample(2, rng=0, plates={"p": 4, "q": 1})
    with pytest.raises(BroadcastError, match="node 'w'.*'q'.*element by element"):
        n.sample(2, rng=0, plates={"p": 4, "q": 4})


# ---- configurations that cannot happen ----------------------------------------------------------


def bounded_sum(table=(0.1, 0.2, 0.3, 0.4)):
    """``b`` looks up ``a + c`` in a table, which holds because c <= 3 - a always."""
    table = np.array(table)
    net = bmc.BayesNet()
    net.add("a", bmc.DiscreteUniform(0, 3))
    net.add(
        "c",
        lambda a: bmc.Categorical(
            np.where(np.arange(4) <= 3 - a[..., None], 1.0, 0.0) / (4 - a[..., None])
        ),
    )
    net.add("b", lambda a, c: bmc.Bernoulli(table[a + c]))
    return net


def test_functions_that_fail_only_where_parents_never_are_pass():
    """Parents of unlike ranks put draws together that are impossible together."""
    bounded_sum().validate()
    draws = bounded_sum().sample(500, rng=0)
    assert (draws["a"] + draws["c"]).max() == 3


def test_functions_that_fail_where_parents_can_be_do_not_pass():
    with pytest.raises(ModelError, match=r"node 'b': IndexError"):
        bounded_sum(table=(0.1, 0.2)).validate()


@pytest.mark.parametrize("count", [2, 3, 4])
@pytest.mark.parametrize("stack", [np.stack, np.concatenate], ids=["stack", "concatenate"])
def test_stacks_that_do_not_broadcast_are_refused(count, stack):
    """They fail on parents of unlike ranks, though every entry alone is fine."""
    names = "abcd"[:count]

    def v(*parts):
        if stack is np.concatenate:
            return bmc.MvNormal(np.concatenate([p[..., None] for p in parts], -1), np.eye(count))
        return bmc.MvNormal(np.stack(parts, -1), np.eye(count))

    net = bmc.BayesNet()
    for name in names:
        net.add(name, bmc.Normal(0.0, 1.0))
    net.add("v", v, parents=list(names))
    with pytest.raises(BroadcastError, match=r"node 'v' does not broadcast.*bmc\.stack"):
        net.validate()
    net.add(
        "v",
        lambda *parts: bmc.MvNormal(bmc.stack(parts), np.eye(count)),
        parents=list(names),
        replace=True,
    )
    net.validate()


# ---- potentials ---------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["batch", "plate", "random"])
def test_bad_potentials_are_caught(kind):
    rng = np.random.default_rng(0)
    net = bmc.BayesNet(plates={"p": 4})
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("x", bmc.Normal(0.0, 1.0), plates="p")
    if kind == "batch":
        net.potential("bad", lambda a: -((a - a.mean()) ** 2))
    elif kind == "plate":
        net.potential("bad", lambda x: -(np.cumsum(x, axis=-1) ** 2), plates="p")
    else:
        net.potential("bad", lambda a: -(a**2) * rng.random())
    with pytest.raises(ModelError, match="'?bad'?"):
        net.validate()


def test_boolean_potentials_are_refused():
    """A condition is no log factor: True would be the log factor 1."""
    for condition in (lambda x: x > 0, lambda x: np.isfinite(x)):
        net = bmc.BayesNet()
        net.add("x", bmc.Normal(0.0, 1.0))
        net.potential("positive", condition)
        with pytest.raises(
            ModelError,
            match=r"'positive' returns booleans.*np\.where\(condition, 0\.0, -np\.inf\)",
        ):
            net.validate()
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.potential("positive", lambda x: np.where(x > 0, 0.0, -np.inf))
    posterior = bmc.infer(net, engine=bmc.LikelihoodWeighting(2000), rng=0)
    assert posterior.probability(lambda x: x > 0) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_potentials_that_are_no_log_factors_are_refused(value):
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.potential("odd", lambda x: np.full(np.shape(x), value))
    with pytest.raises(DensityError, match="'odd' is NaN or plus infinity.*or -inf"):
        net.validate()


def test_good_potentials_pass():
    net = bmc.BayesNet(plates={"p": 4})
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("x", bmc.Normal(0.0, 1.0), plates="p")
    net.potential("each", lambda a, x: -((x - a) ** 2), plates="p")
    net.potential("whole", lambda x: -(x.sum("p") ** 2))
    net.potential(
        "order", lambda x: np.where(np.diff(x.array, axis=-1) > 0, 0.0, -9.0).sum(axis=-1)
    )
    net.validate()


# ---- randomness, state, mutation ----------------------------------------------------------------


def test_random_numbers_inside_are_caught():
    rng = np.random.default_rng(0)
    for with_parent in (False, True):
        net = bmc.BayesNet()
        net.add("x", bmc.Normal(0.0, 1.0))
        net.add(
            "bad",
            (lambda x: bmc.Normal(x + rng.normal(), 1.0))
            if with_parent
            else (lambda: bmc.Normal(rng.normal(), 1.0)),
        )
        with pytest.raises(
            ModelError,
            match=r"node 'bad': two calls with the same parents differ; .*random numbers",
        ):
            net.validate()
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("bad", lambda x: x + rng.normal())
    with pytest.raises(ModelError, match="node 'bad': two calls with the same parents differ"):
        net.validate()


def test_functions_with_a_memory_are_caught():
    calls = []

    def bad(x):
        calls.append(1)
        return bmc.Normal(x + len(calls), 1.0)

    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("bad", bad)
    with pytest.raises(ModelError, match="node 'bad': two calls with the same parents differ"):
        net.validate()


def _iadd(x):
    x += 1.0
    return bmc.Normal(x, 1.0)


def _setitem(x):
    x[..., 0] = 0.0
    return bmc.Normal(x, 1.0)


def _sort(x):
    x.sort()
    return bmc.Normal(x, 1.0)


def _out(x):
    np.exp(x, out=x)
    return bmc.Normal(x, 1.0)


@pytest.mark.parametrize("function", [_iadd, _setitem, _sort, _out])
def test_changing_a_parent_in_place_names_the_node(function):
    net = bmc.BayesNet(plates={"p": 3})
    net.add("x", bmc.Normal(0.0, 1.0), plates="p")
    net.add("y", function, plates="p")
    with pytest.raises(
        ModelError, match=r"node 'y'.*changes a parent in place; parents are read-only"
    ) as caught:
        net.validate()
    assert not isinstance(caught.value, BroadcastError)


def test_changing_a_scalar_parent_in_place_names_the_node():
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", _iadd)
    with pytest.raises(ModelError, match=r"node 'y'.*changes a parent in place") as caught:
        net.validate()
    assert not isinstance(caught.value, BroadcastError)


def test_changing_a_gathered_vector_in_place_names_the_node():
    def y(beta):
        b = beta[0]
        b += 1.0
        return bmc.Normal(b[..., 0], 1.0)

    net = bmc.BayesNet(plates={"k": 3})
    net.add("beta", bmc.MvNormal(np.zeros(2), np.eye(2)), plates="k")
    net.add("y", y)
    with pytest.raises(ModelError, match=r"node 'y'.*changes a parent in place") as caught:
        net.validate()
    assert not isinstance(caught.value, BroadcastError)


# ---- shapes and parameters ----------------------------------------------------------------------


def test_a_batch_beyond_the_plates_points_at_plates():
    net = bmc.BayesNet(plates={"p": 3})
    net.add("x", bmc.Normal(np.zeros(3), 1.0))
    with pytest.raises(
        ShapeError, match=r"node 'x': Normal has batch shape \(3,\).*no plates.*declare .* plates="
    ):
        net.validate()
    net = bmc.BayesNet(plates={"p": 3})
    net.add("x", bmc.Normal(np.zeros(4), 1.0), plates="p")
    with pytest.raises(ShapeError, match=r"node 'x': .*\(4,\).*plates \('p',\) of sizes \(3,\)"):
        net.validate()
    net = bmc.BayesNet()
    net.add("m", bmc.Normal(0.0, 1.0))
    net.add("x", lambda m: bmc.Normal(m + np.zeros(7), 1.0))
    with pytest.raises(BayesmcError, match=r"node 'x'"):
        net.validate()


def test_what_is_no_distribution_is_refused():
    for result, message in [
        (None, "returns None; return a distribution or an array"),
        ({"a": 1}, "the function returns dict; return a distribution"),
        ([bmc.Normal(0, 1)], "the function returns list; return a distribution"),
        ((np.zeros((3, 2)), 1), "the function returns tuple; return a distribution"),
    ]:
        net = bmc.BayesNet()
        net.add("x", lambda result=result: result)
        with pytest.raises(ModelError, match=f"node 'x'.*{message}"):
            net.validate()


def test_text_is_no_value():
    net = bmc.BayesNet()
    net.add("x", lambda: "text")
    with pytest.raises(ModelError, match="node 'x'"):
        net.validate()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_parameters_that_are_not_finite_name_the_node(value):
    net = bmc.BayesNet()
    net.add("x", lambda: bmc.Normal(value, 1.0))
    with pytest.raises(ParameterError, match=r"node 'x': Normal: loc must be finite; got"):
        net.validate()
    net = bmc.BayesNet(plates={"p": 3})
    net.add("a", bmc.Normal(0.0, 1.0), plates="p")
    net.add("x", lambda a: bmc.Normal(a, np.where(np.arange(3) == 2, value, 1.0)), plates="p")
    with pytest.raises(
        ParameterError, match=r"node 'x' \(plate element 2\): Normal: scale must be"
    ):
        net.validate()


def test_what_overflows_for_every_draw_tried_is_no_fault():
    """Vague priors can make a rate infinite in all tries; the arithmetic, or a parent, says that it grew."""
    net = bmc.BayesNet(plates={"p": 3})
    net.add("log_rate", bmc.Normal(2000.0, 1.0))
    net.add("y", lambda log_rate: bmc.Poisson(np.exp(log_rate)), plates="p")
    net.add("rate", lambda log_rate: np.exp(log_rate))
    net.add("z", lambda rate: bmc.Poisson(rate), plates="p")
    net.add("scale", lambda log_rate: np.exp(-log_rate))
    net.add("x", lambda log_rate: bmc.Normal(0.0, np.exp(-log_rate)))
    net.validate()
    assert net.log_prob({"log_rate": 0.0, "y": [0, 0, 0], "z": [0, 0, 0], "x": 0.0}) < 0.0
    net.add("bad", lambda log_rate: bmc.Normal(log_rate, np.inf))
    with pytest.raises(ParameterError, match="node 'bad': Normal: scale must be"):
        net.validate()


def test_parameters_out_of_range_name_the_node_and_the_first_index():
    net = bmc.BayesNet(plates={"p": 4})
    net.add("x", lambda: bmc.Normal(0.0, np.array([1.0, 2.0, -1.0, -2.0])), plates="p")
    with pytest.raises(
        ParameterError, match=r"node 'x' \(plate element 2\): .*scale must be positive.*got -1"
    ) as caught:
        net.validate()
    assert caught.value.index[-1] == 2


def test_a_deterministic_nan_names_the_node():
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda x: np.sqrt(-1.0 - x * x))
    with pytest.raises(DensityError, match=r"node 'y': the function returns NaN"):
        net.validate()


def test_an_error_inside_a_function_names_node_error_and_shapes():
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda x: bmc.Normal(x.colour, 1.0))
    with pytest.raises(
        ModelError, match=r"node 'y': AttributeError: .*'colour' \(arguments of shapes \(\)\)"
    ) as caught:
        net.validate()
    assert not isinstance(caught.value, BroadcastError)  # it has nothing to do with broadcasting
    assert isinstance(caught.value.__cause__, AttributeError)


def test_it_runs_by_itself_on_first_use_and_again_after_a_change():
    def net():
        n = bmc.BayesNet()
        n.add("x", bmc.Normal(0.0, 1.0))
        n.add("bad", lambda x: bmc.Normal(x.mean(), 1.0))
        return n

    for use in (
        lambda n: n.sample(3, rng=0),
        lambda n: n.log_prob({"x": 0.0, "bad": 0.0}),
        lambda n: bmc.infer(n, rng=0),
    ):
        with pytest.raises(BroadcastError, match="node 'bad'"):
            use(net())
    good = bmc.BayesNet()
    good.add("x", bmc.Normal(0.0, 1.0))
    good.validate()
    good.add("bad", lambda x: bmc.Normal(x.mean(), 1.0))
    with pytest.raises(BroadcastError, match="node 'bad'"):
        good.sample(2, rng=0)


# ---- supports that depend on parents ------------------------------------------------------------


@pytest.mark.parametrize("position", range(5))
def test_a_support_that_depends_on_a_parent_is_never_taken_as_fixed(position):
    net = bmc.BayesNet()
    for i in range(position + 1):
        net.add(f"r{i}", bmc.Gamma(2.0, 1.0))
    net.add("n", bmc.Poisson(3.0))
    net.add("u", lambda r: bmc.Uniform(0.0, r), parents=[f"r{position}"])
    net.add("k", lambda n: bmc.Binomial(n, 0.5))
    assert net["k"].states is None
    draws = net.sample(2000, rng=0)
    assert (draws["k"] <= draws["n"]).all() and draws["k"].max() > 5
    posterior = bmc.infer(net, {"u": 4.0, "k": 4}, engine=bmc.LikelihoodWeighting(20_000), rng=0)
    above = posterior.probability(lambda r: r > 4, names={"r": f"r{position}"})
    assert above == pytest.approx(1.0, abs=1e-12)
    assert posterior.probability(lambda n: n >= 4) == pytest.approx(1.0, abs=1e-12)


def test_a_looped_support_that_depends_on_a_parent_is_never_taken_as_fixed():
    """Of twenty parents' states the probe meets a few, whose supports may happen to be equal."""
    for few in (2, 300):
        net = bmc.BayesNet()
        net.add("n", bmc.DiscreteUniform(0, 19))
        net.add(
            "k",
            lambda n, few=few: bmc.Binomial(few if n < 10 else 302 - few, 0.5),
            vectorize=True,
        )
        assert net["k"].states is None
        draws = net.sample(400, rng=0)
        counts = np.where(draws["n"] < 10, few, 302 - few)
        assert (draws["k"] <= counts).all()
        assert draws["k"].max() > 120  # not cut to the other support, nor wrapped at 256
        at = {2: 150.0, 300: 1.0}[few]
        p = bmc.infer(net, {"n": 15}, engine=bmc.LikelihoodWeighting(400), rng=0)
        assert p.mean("k") == pytest.approx(at, abs=4.5 * float(p.mcse("k")))


@pytest.mark.parametrize("size", [65_536, 65_537, 10**9])
def test_supports_too_large_to_list_have_no_states(size):
    """Nothing as large as the support is made: a billion values would take 7.5 GiB."""
    net = bmc.BayesNet()
    net.add("p", bmc.Beta(1.0, 1.0))
    net.add("k", bmc.DiscreteUniform(0, size - 1))
    net.add("n", lambda p: bmc.Binomial(size - 1, p))
    tracemalloc.start()
    assert (net["k"].states is not None) == (size <= 65_536)
    net.validate()
    draws = net.sample(50, rng=0)
    p = bmc.infer(net, {"p": 0.3}, engine=bmc.LikelihoodWeighting(500), rng=0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**26 and draws["k"].max() > size // 2
    # 4.5 standard errors, false alarm 7e-6 each at a fresh seed
    assert abs(p.mean("k") - (size - 1) / 2) < 4.5 * p.mcse("k")
    assert abs(p.mean("n") - 0.3 * (size - 1)) < 4.5 * p.mcse("n")


def test_of_many_nodes_with_one_function_those_at_the_extremes_are_checked() -> None:
    """A function that mixes elements only where its parent is large, as the parents of some nodes are."""

    def mixing(a: Any) -> Any:
        large = a > 50
        return bmc.Normal(np.where(large, np.sort(a, axis=-1), a), 1.0)

    net = bmc.BayesNet(plates={"i": 3})
    for k in range(40):
        net.add(f"a{k}", bmc.Normal(100.0 if 20 <= k < 25 else 0.0, 1.0), plates="i")
        net.add(f"b{k}", mixing, parents=[f"a{k}"], plates="i")
    with pytest.raises(BroadcastError, match="node 'b2"):
        net.validate()


def test_of_many_nodes_those_with_a_function_of_their_own_are_checked() -> None:
    """One function of many nodes is checked at a few of them; one like it, of the last node, by itself."""
    net = bmc.BayesNet()
    net.add("x[0]", bmc.Normal(0.0, 1.0))

    def step(x: Any) -> Any:
        return bmc.Normal(0.5 * x, 1.0)

    for t in range(1, 40):
        net.add(f"x[{t}]", step, parents=[f"x[{t - 1}]"])
    net.sample(2, rng=0)
    net.add(
        "y", lambda x: bmc.Normal(np.sort(x, axis=0) if np.ndim(x) else x, 1.0), parents=["x[39]"]
    )
    with pytest.raises(BroadcastError, match="node 'y'"):
        net.validate()
