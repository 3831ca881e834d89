"""Stacked blankets against the single ones, and what must not be stacked."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.distributions.base import marking_invalid
from bayesmc.network import pose
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.like_functions import Slots
from bayesmc.structure.like_terms import TermSum
from bayesmc.structure.stacked import StackedBlanket, stacks
from bayesmc.structure.target import Target, Values, target_of
from bayesmc.testing import random_dbn

CHAINS = 5
DATA = np.random.default_rng(11)
Case = tuple[Any, dict[str, Any], list[tuple[str, ...]]]


def names(what: str, *slices: range) -> list[tuple[str, ...]]:
    return [tuple(f"{what}[{t}]" for t in part) for part in slices]


def hidden_markov(steps: int = 12) -> Case:
    """Shared hidden parameters, and the ends unlike the rest."""
    net = bmc.BayesNet(plates={"state": 3})
    net.add("theta", bmc.Dirichlet(np.ones(3)), plates="state")
    net.add("mu", bmc.Laplace(0.0, 1.0), plates="state")
    net.add("z[0]", bmc.Categorical(np.ones(3) / 3))
    for t in range(1, steps):
        net.add(
            f"z[{t}]",
            lambda before, theta: bmc.Categorical(theta[before]),
            parents=[f"z[{t - 1}]", "theta"],
        )
    for t in range(steps):
        net.add(f"y[{t}]", lambda z, mu: bmc.Normal(mu[z], 1.0), parents=[f"z[{t}]", "mu"])
    evidence = {f"y[{t}]": DATA.normal() for t in range(steps)}
    return net, evidence, names("z", range(1, steps - 1, 2), range(2, steps - 1, 2))


def numbered(t_of: Callable[[int], Any] = int) -> Case:
    """De Freitas' growth model: functions that differ in the time."""
    net = bmc.BayesNet()
    net.add("x[0]", bmc.Normal(0.0, 3.0))
    for t in range(1, 13):
        time = t_of(t)
        net.add(
            f"x[{t}]",
            lambda p, t=time: bmc.Normal(0.5 * p + 25 * p / (1 + p**2) + 8 * np.cos(1.2 * t), 3.0),
            parents=[f"x[{t - 1}]"],
        )
    for t in range(13):
        net.add(f"y[{t}]", lambda x: bmc.Normal(x**2 / 20, 1.0), parents=[f"x[{t}]"])
    evidence = {f"y[{t}]": DATA.normal() ** 2 for t in range(13)}
    return net, evidence, names("x", range(1, 12, 2), range(2, 12, 2))


def closed_over() -> Case:
    """The time in a closure, and in that of a function closed over."""
    net = bmc.BayesNet()
    net.add("s", bmc.Gamma(2.0, 1.0))

    def transition(t: int) -> Callable[..., Any]:
        def drift(x: Any) -> Any:
            return np.tanh(x) + 0.1 * t

        return lambda before, s: bmc.Laplace(drift(before) / t, s)

    net.add("x[0]", bmc.Normal(0.0, 1.0))
    for t in range(1, 11):
        net.add(f"x[{t}]", transition(t), parents=[f"x[{t - 1}]", "s"])
    net.add("y", lambda x, s: bmc.Laplace(x, s), parents=["x[10]", "s"])
    return net, {"y": 0.5}, names("x", range(1, 10, 2), range(2, 10, 2))


def roots() -> Case:
    """No parents at all, or shared ones only: the batch is the numbers' alone."""
    net = bmc.BayesNet()
    net.add("slope", bmc.Gamma(2.0, 1.0))
    for j in range(5):
        net.add(f"a[{j}]", lambda j=j: bmc.Laplace(j, 1.0))
        net.add(f"b[{j}]", lambda slope, j=j: bmc.Laplace(slope * j, 1.0), parents=["slope"])
        net.add(
            f"y[{j}]",
            lambda a, b, slope, j=j: bmc.Poisson(np.exp(0.1 * a * b + slope - j)),
            parents=[f"a[{j}]", f"b[{j}]", "slope"],
        )
    evidence = {f"y[{j}]": j for j in range(5)}
    return net, evidence, names("a", range(5)) + names("b", range(5))


def vectors() -> Case:
    """Vector states; the time meets the components, matrices differ from slice to slice."""
    net = bmc.BayesNet()
    turns = [np.eye(2) + 0.1 * DATA.normal(size=(2, 2)) for _ in range(12)]
    net.add("x[0]", bmc.MvNormal(np.zeros(2), np.eye(2)))
    for t in range(1, 12):
        net.add(
            f"x[{t}]",
            lambda x, t=t, turn=turns[t]: bmc.MvNormal(
                np.matvec(turn, np.tanh(x)), 0.5 * np.eye(2)
            ),
            parents=[f"x[{t - 1}]"],
        )
        net.add(
            f"y[{t}]",
            lambda x, t=t: bmc.Normal(np.linalg.norm(x + 0.1 * t, axis=-1), 1.0),
            parents=[f"x[{t}]"],
        )
    evidence = {f"y[{t}]": DATA.normal() ** 2 for t in range(1, 12)}
    return net, evidence, []


def lattice(rows: int = 6, columns: int = 7) -> Case:
    """A lattice of named sites: children on two sides, through different arguments."""
    net = bmc.BayesNet()
    net.add("coupling", bmc.Gamma(2.0, 1.0))
    sites = list(itertools.product(range(rows), range(columns)))
    for i, j in sites:
        parents = [f"s[{a},{b}]" for a, b in ((i - 1, j), (i, j - 1)) if a >= 0 and b >= 0]
        if len(parents) == 2:
            net.add(
                f"s[{i},{j}]",
                lambda up, left, c: bmc.Bernoulli(logits=c * (up + 2.0 * left - 1.5)),
                parents=[*parents, "coupling"],
            )
        else:
            net.add(f"s[{i},{j}]", bmc.Bernoulli(0.4))
        net.add(f"y[{i},{j}]", lambda s: bmc.Normal(s, 1.0), parents=[f"s[{i},{j}]"])
    evidence = {f"y[{i},{j}]": DATA.normal() for i, j in sites}
    inner = [(i, j) for i, j in sites if 0 < i < rows - 1 and 0 < j < columns - 1]
    # sites that share a child are diagonal neighbours, others share an edge: three colours or more
    return net, evidence, [tuple(f"s[{i},{j}]" for i, j in inner)]


def pairs_of_variables() -> Case:
    """A factor graph of named variables: no densities of their own."""
    graph = bmc.FactorGraph()
    for i in range(10):
        graph.variable(f"s{i}", (-1, 1))
    graph.variable("field", "real")
    graph.factor(lambda f: -(f**2), scope="field")
    for i in range(9):
        graph.factor(lambda a, b: 0.4 * a * b, scope=(f"s{i}", f"s{i + 1}"))
    for i in range(10):
        graph.factor(lambda a, f, i=i: 0.1 * (i - 4) * a * f, scope=(f"s{i}", "field"))
    return (
        graph,
        {},
        [tuple(f"s{i}" for i in range(1, 9, 2)), tuple(f"s{i}" for i in range(2, 9, 2))],
    )


def plated() -> Case:
    """Slices in plates, children in more, links on the way, and elements that nobody saw."""
    net = bmc.BayesNet(plates={"i": 3, "k": 2})
    net.add("s", bmc.Gamma(2.0, 1.0), plates="i")
    net.add("x[0]", bmc.Laplace(0.0, 1.0), plates="i")
    for t in range(1, 12):
        net.add(
            f"x[{t}]",
            lambda x, s, t=t: bmc.Laplace(x / t, s),
            parents=[f"x[{t - 1}]", "s"],
            plates="i",
        )
    for t in range(12):
        net.add(f"m[{t}]", lambda x: np.tanh(x), parents=[f"x[{t}]"], plates="i")
        net.add(
            f"y[{t}]", lambda m: bmc.Laplace(2 * m, 1.0), parents=[f"m[{t}]"], plates=("k", "i")
        )
    evidence = {f"y[{t}]": DATA.normal(size=(2, 3)) for t in range(12)}
    evidence["y[4]"][1, 2] = np.nan
    evidence["y[5]"][0, 0] = np.nan
    return net, evidence, names("x", range(1, 11, 2), range(2, 11, 2))


def partly_known() -> Case:
    """Some neighbours are seen and others are not."""
    net, evidence, _ = numbered()
    groups = [(1, 3, 5, 7, 9, 11), (2, 4, 6, 8)]
    return (
        net,
        evidence | {"x[10]": 1.5, "x[12]": -0.5},
        [tuple(f"x[{t}]" for t in g) for g in groups],
    )


def tables() -> Case:
    """Transition tables that are equal, but not the same object; labels instead of numbers."""
    net = bmc.BayesNet()
    states = ("low", "high")
    net.add("mu", bmc.Laplace(0.0, 1.0))
    net.table("z[0]", [], [0.3, 0.7], states=states)
    for t in range(1, 11):
        net.table(f"z[{t}]", [f"z[{t - 1}]"], [[0.8, 0.2], [0.3, 0.7]], states=states)
    for t in range(11):
        net.add(
            f"y[{t}]",
            lambda z, mu: bmc.Normal(np.where(z == "low", mu, 2 * mu), 1.0),
            parents=[f"z[{t}]", "mu"],
        )
    evidence = {f"y[{t}]": DATA.normal() for t in range(11)}
    return net, evidence, names("z", range(1, 10, 2), range(2, 10, 2))


CASES = [
    hidden_markov, numbered, closed_over, roots, vectors, lattice, pairs_of_variables, plated,
    partly_known, tables,
]  # fmt: skip


def posed(net: Any, evidence: dict[str, Any]) -> tuple[Target, dict[str, Blanket]]:
    target = target_of(pose(net, evidence))
    return target, {n: Blanket(target, n) for n in target.chain}


def found_in(net: Any, evidence: dict[str, Any]) -> tuple[list[StackedBlanket], list[str]]:
    target, blankets = posed(net, evidence)
    return stacks(target, blankets, target.chain)


def a_state(target: Target, seed: int) -> Values:
    """Values of all nodes that have nothing to do with those that were looked at when stacking."""
    rng = np.random.default_rng(seed)
    values = dict(target.known)
    for name in target.chain:
        node = target.model[name]
        shape = (CHAINS, *node.value_shape)
        if node.domain is not None:
            values[name] = rng.integers(node.domain.size, size=shape).astype(node.domain.dtype)
        else:
            values[name] = np.abs(rng.normal(size=shape)) + 0.1
            if node.support is not None and node.support.kind == "simplex":
                values[name] /= values[name].sum(axis=-1, keepdims=True)
    target.refresh(values, target.chain)
    return values


def worst_difference(target: Target, stack: StackedBlanket, lead: int, seed: int = 0) -> float:
    """Between the stack's and the single log densities, candidates as engines try them."""
    with marking_invalid(), np.errstate(all="ignore"):
        values = a_state(target, seed)
        others = [a_state(target, seed + 1 + k) for k in range(lead)]
        candidate = np.stack([stack.current(v) for v in others])
        together = stack.log_density(values, candidate)
        worst = 0.0
        for i, blanket in enumerate(stack.blankets):
            one = candidate[:, :, i]
            alone = blanket.log_density(values, one)
            shape = one.shape[: one.ndim - len(blanket.event_shape)]
            row = np.broadcast_to(together, (*shape[:2], len(stack.names), *shape[2:]))[:, :, i]
            worst = max(worst, float(np.max(np.abs(row - alone) / (1 + np.abs(alone)))))
    return worst


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.__name__)
def test_log_densities(case: Callable[[], Case]) -> None:
    net, evidence, _ = case()
    target, blankets = posed(net, evidence)
    found, _ = stacks(target, blankets, target.chain)
    assert found
    for stack in found:
        for lead in (1, 3):
            assert worst_difference(target, stack, lead) < 1e-12, stack.names


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.__name__)
def test_groups(case: Callable[[], Case]) -> None:
    """Who is stacked: as expected, or (lattice) all inside, those of a group sharing no term."""
    net, evidence, expected = case()
    target, blankets = posed(net, evidence)
    found, left = stacks(target, blankets, target.chain)
    groups = [s.names for s in found]
    if case is lattice:
        assert len(set(expected[0]) - set(left)) > len(expected[0]) // 2
    elif expected:
        assert set(groups) == set(expected)
    stacked = [n for g in groups for n in g]
    assert sorted([*stacked, *left]) == sorted(target.chain)
    for group in groups:
        entered = [t.name for n in group for t in target.terms_of((n,))]
        assert len(entered) == len(set(entered))


@pytest.mark.parametrize("t_of", [float, np.float64, np.int64, lambda t: np.array(float(t))])
def test_kinds_of_numbers(t_of: Callable[[int], Any]) -> None:
    net, evidence, expected = numbered(t_of)
    found, _ = found_in(net, evidence)
    assert {s.names for s in found} == set(expected)


def test_numbers_meet_the_right_axes() -> None:
    """A scalar by which functions differ meets the components of vectors from the left."""
    net, evidence, _ = vectors()
    target, blankets = posed(net, evidence)
    found, _ = stacks(target, blankets, target.chain)
    assert {n for s in found for n in s.names} == {f"x[{t}]" for t in range(1, 11)}


def test_random_templates() -> None:
    """Slices of random templates of finite nodes: stacks, terms and links as one say what each says alone."""
    stacked = terms = 0
    for seed in range(16):
        case = random_dbn(seed, nodes=(1, 3), steps=(9, 9), zeros=False)
        net = case.dbn.unroll(case.steps, inputs=case.inputs)
        evidence = case.dbn.unrolled_evidence(case.observations)
        target, blankets = posed(net, evidence)
        found, _ = stacks(target, blankets, target.chain)
        for stack in found:
            assert worst_difference(target, stack, 2) < 1e-12, (seed, stack.names)
        total = TermSum(target, target.terms.values())
        values = a_state(target, seed)
        with marking_invalid(), np.errstate(all="ignore"):
            np.testing.assert_allclose(
                total.log_density(values), target.log_density(values), rtol=1e-11
            )
        stacked, terms = stacked + len(found), terms + len(total.groups)
    assert stacked > 10 and terms > 20


def test_values_are_spread() -> None:
    net, evidence, _ = plated()
    target, blankets = posed(net, evidence)
    values = a_state(target, 0)
    for stack in stacks(target, blankets, target.chain)[0]:
        now = stack.current(values)
        assert now.shape == (CHAINS, len(stack.names), 3)
        for name, value in stack.spread(now).items():
            np.testing.assert_array_equal(value, values[name])


def test_data_that_move() -> None:
    """Known values are stacked once, but others in their place are seen."""
    net, evidence, _ = numbered()
    target, blankets = posed(net, evidence)
    stack = stacks(target, blankets, target.chain)[0][0]
    values = a_state(target, 0)
    before = stack.log_density(values, stack.current(values))
    name = stack.names[2].replace("x", "y")
    after = stack.log_density({**values, name: values[name] + 1.0}, stack.current(values))
    assert (np.delete(before, 2, axis=1) == np.delete(after, 2, axis=1)).all()
    assert (before[:, 2] != after[:, 2]).all()


# ---- what must not be stacked -------------------------------------------------------------------


def chain_of(functions: dict[int, Any], default: Any) -> set[str]:
    """Which of x[1..10] are stacked, where some have functions of their own."""
    net = bmc.BayesNet()
    net.add("x[0]", bmc.Laplace(0.0, 1.0))
    for t in range(1, 12):
        net.add(f"x[{t}]", functions.get(t, default(t)), parents=[f"x[{t - 1}]"])
    net.add("y", lambda x: bmc.Laplace(x, 1.0), parents=["x[11]"])
    return {n for s in found_in(net, {"y": 1.0})[0] for n in s.names}


def plain(t: int) -> Any:
    return lambda x: bmc.Laplace(0.9 * x, 1.0)


ALL = {f"x[{t}]" for t in range(1, 11)}


def test_an_unlike_function_is_left_alone() -> None:
    """It, its parent (whose child is unlike) and no other."""
    assert chain_of({}, plain) == ALL
    other = lambda x: bmc.Laplace(0.8 * np.tanh(x), 1.0)  # noqa: E731
    # too few are left at the end of a colour only if a colour falls below four
    assert chain_of({10: other}, plain) == ALL - {"x[9]", "x[10]"}


def differing(functions: Callable[[int], Any]) -> tuple[set[str], float]:
    """Which of x[1..10] are stacked, and how far off their stacks are."""
    net = bmc.BayesNet()
    net.add("x[0]", bmc.Laplace(0.0, 1.0))
    for t in range(1, 12):
        net.add(f"x[{t}]", functions(t), parents=[f"x[{t - 1}]"])
    net.add("y", lambda x: bmc.Laplace(x, 1.0), parents=["x[11]"])
    target, blankets = posed(net, {"y": 1.0})
    found, _ = stacks(target, blankets, target.chain)
    worst = max([worst_difference(target, s, 2) for s in found], default=0.0)
    return {n for s in found for n in s.names}, worst


def test_what_is_closed_over_counts() -> None:
    def with_list(scales: list[float]) -> Any:
        return lambda x: bmc.Laplace(x * scales[0], 1.0)

    shared = [0.5]
    assert differing(lambda t: with_list(shared)) == (ALL, 0.0)
    stacked, worst = differing(lambda t: with_list([0.1 * t]))
    assert stacked == ALL and worst < 1e-12


def test_distributions_that_are_closed_over_are_compared_by_value() -> None:
    def stepping(scale: float) -> Any:
        noise = bmc.Laplace(0.0, scale)
        return lambda x: bmc.Affine(noise, 0.5 * x, 1.0)

    assert chain_of({}, lambda t: stepping(2.0)) == ALL
    assert not chain_of({}, lambda t: stepping(float(t)))


def test_what_cannot_be_followed_is_stacked_only_where_it_is_one_function() -> None:
    def density(x: Any) -> Any:
        return bmc.Density(lambda y: -np.abs(y - x), support="real")

    assert chain_of({}, lambda t: density) == ALL
    assert chain_of({}, lambda t: lambda x: density(x)) == ALL
    assert not chain_of({}, lambda t: lambda x, t=t: density(x + 0 * t))


@pytest.mark.parametrize(
    "function",
    [
        lambda x, t: bmc.Laplace(x if t > 5 else -x, 1.0),
        lambda x, t: bmc.Laplace(x + np.sum(t), 1.0),
        lambda x, t: bmc.Laplace(x + np.size(t), 1.0),
        lambda x, t: bmc.Laplace(x + [0.1 * k for k in range(24)][t], 1.0),
        lambda x, t: bmc.Laplace(x + float(10**t) ** 0.01 if t else x, 1.0),
        lambda x, t: bmc.Laplace(x + np.asarray(10**t % 7.0, dtype=float) * (t < 99), 1.0),
    ],
    ids=["branch", "sum", "size", "list", "float", "overflow"],
)
def test_numbers_need_not_broadcast(function: Any) -> None:
    """Functions of numbers only, right for one at a time: what an array would give is wrong, or fails."""
    stacked, worst = differing(lambda t: lambda x, t=2 * t: function(x, t))
    assert stacked and worst < 1e-12


def test_seen_nodes_and_few_nodes_are_left() -> None:
    net, evidence, _ = numbered()
    found, left = found_in(net, evidence | {"x[4]": 0.0})
    assert "x[4]" not in {n for s in found for n in s.names} and "x[4]" not in left
    target, blankets = posed(net, evidence)
    assert stacks(target, blankets, ["x[1]", "x[3]", "x[5]"]) == ([], ["x[1]", "x[3]", "x[5]"])


def test_the_wrong_neighbours_are_noticed() -> None:
    """Negative control: neighbours of the wrong nodes, and the numbers of one for all, are seen."""
    net, evidence, _ = numbered()
    target, blankets = posed(net, evidence)
    stack = stacks(target, blankets, target.chain)[0][0]
    sources = stack.slots.sources
    at = next(n for n, s in sources.items() if len(s) > 1 and n != stack.one.name)
    turned = {**sources, at: (*sources[at][1:], sources[at][0])}
    wrong = StackedBlanket(stack.one, stack.blankets, Slots(target, turned, len(stack.names)))
    assert worst_difference(target, wrong, 1) > 1e-3
    alike = StackedBlanket(stack.blankets[0], stack.blankets, stack.slots)
    assert worst_difference(target, alike, 1) > 1e-3
