"""Deterministic nodes recomputed as one against one by one."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.unrolled import pose_any
from bayesmc.errors import BayesmcError
from bayesmc.kernels.conjugate import conjugate_kernel
from bayesmc.network import pose
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.like_functions import LikeLinks, LinkSteps, Slots
from bayesmc.structure.recursion import LinkPlan, Recursion
from bayesmc.structure.target import Target, Values, target_of
from tests.structure.test_stacked import CHAINS, DATA, a_state

#: net, evidence, sizes of groups in the order of their steps (1: alone)
Case = tuple[Any, dict[str, Any], list[int]]


def seen(net: Any, links: list[str], plates: Any = ()) -> dict[str, Any]:
    """Something observed below each link."""
    shape = tuple(net.plates[p] for p in plates)
    for link in links:
        net.add(f"y {link}", lambda m: bmc.Laplace(1.0 * m, 1.0), parents=[link], plates=plates)
    return {f"y {link}": DATA.normal(size=shape) for link in links}


def slices() -> Case:
    """Two levels, the time in functions, and one node that all read; the last slice is unlike."""
    net = bmc.BayesNet(plates={"i": 3})
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("x[0]", bmc.Laplace(0.0, 1.0), plates="i")
    for t in range(7):
        if t:
            net.add(f"x[{t}]", lambda x: bmc.Laplace(x, 1.0), parents=[f"x[{t - 1}]"], plates="i")
        net.add(f"m[{t}]", lambda x, a, t=t: np.exp(x / (1 + t)) + a,
                parents=[f"x[{t}]", "a"], plates="i")  # fmt: skip
        twice = (lambda m, x: m - 2 * x) if t < 6 else (lambda m, x: m + x)
        net.add(f"n[{t}]", twice, parents=[f"m[{t}]", f"x[{t}]"], plates="i")
    return net, seen(net, [f"n[{t}]" for t in range(7)], ("i",)), [7, 6, 1]


def recursive() -> Case:
    """Each follows from the one before: none can be one with another, but what feeds them can."""
    net = bmc.BayesNet()
    net.add("v[0]", bmc.Laplace(0.0, 1.0))
    net.add("at[0]", lambda v: v, parents=["v[0]"])
    for t in range(1, 6):
        net.add(f"v[{t}]", lambda v: bmc.Laplace(v, 1.0), parents=[f"v[{t - 1}]"])
        net.add(f"step[{t}]", lambda v: np.tanh(v), parents=[f"v[{t}]"])
        net.add(f"at[{t}]", lambda x, d: x + d, parents=[f"at[{t - 1}]", f"step[{t}]"])
    return net, seen(net, [f"at[{t}]" for t in range(6)]), [1, 5, 1, 1, 1, 1, 1]


def shared() -> Case:
    """All read the same nodes, and differ by number."""
    net = bmc.BayesNet()
    net.add("tau", bmc.Gamma(2.0, 1.0))
    for t in range(5):
        net.add(f"s[{t}]", lambda tau, t=t: (tau * (1 + t)) ** -0.5, parents=["tau"])
        net.add(f"y[{t}]", lambda s: bmc.Normal(0.0, s), parents=[f"s[{t}]"])
    return net, {f"y[{t}]": DATA.normal() for t in range(5)}, [5]


def vectors() -> Case:
    """Vectors, and numbers of theirs; some neighbours are known."""
    net = bmc.BayesNet()
    for t in range(6):
        net.add(f"x[{t}]", bmc.MvNormal(np.zeros(2), np.eye(2)))
        net.add(f"far[{t}]", lambda x, t=t: np.linalg.norm(x, axis=-1) + t, parents=[f"x[{t}]"])
        net.add(f"c[{t}]", bmc.Laplace(0.0, 1.0))
        net.add(f"z[{t}]", lambda far, c: far * c, parents=[f"far[{t}]", f"c[{t}]"])
    evidence = seen(net, [f"z[{t}]" for t in range(6)])
    return net, evidence | {"c[1]": 0.5, "c[4]": -1.0}, [6, 6]


def states() -> Case:
    """Finite nodes: tables, and functions of labels."""
    net = bmc.BayesNet()
    for t in range(5):
        net.add(f"z[{t}]", bmc.Categorical([0.2, 0.3, 0.5]))
        net.add(f"odd[{t}]", lambda z: z % 2 == 1, parents=[f"z[{t}]"])
    return net, seen(net, [f"odd[{t}]" for t in range(5)]), [5]


CASES = [slices, recursive, shared, vectors, states]


def posed(case: Callable[[], Case]) -> tuple[Target, list[int]]:
    net, evidence, sizes = case()
    return target_of(pose(net, evidence)), sizes


def one_by_one(target: Target, values: Values) -> Values:
    values = dict(values)
    for link in target.links:
        values[link], _ = target.model.evaluate(link, values)
    return values


def worst_difference(target: Target, found: Values, expected: Values) -> float:
    worst = 0.0
    for link in target.links:
        a, b = (np.asarray(v[link], dtype=float) for v in (found, expected))
        assert found[link].dtype == expected[link].dtype
        worst = max(worst, float(np.max(np.abs(a - b) / (1 + np.abs(b)))))
    return worst


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.__name__)
def test_values(case: Callable[[], Case]) -> None:
    target, sizes = posed(case)
    steps = LinkSteps(target, target.links)
    assert [1 if isinstance(s, str) else len(s.names) for s in steps.steps] == sizes
    values = a_state(target, 3)
    found = {n: v for n, v in values.items() if n not in target.links}
    steps.compute(found)
    expected = one_by_one(target, values)
    assert worst_difference(target, found, expected) < 1e-12
    for link in target.links:
        assert found[link].shape == expected[link].shape


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.__name__)
def test_candidates_in_front_of_some_values(case: Callable[[], Case]) -> None:
    """As kernels try them: what moves has more axes than what stays."""
    target, _ = posed(case)
    values = a_state(target, 3)
    moved = target.chain[:2]
    tried = {n: np.stack([a_state(target, 10 + k)[n] for k in range(3)]) for n in moved}
    found = {**values, **tried}
    target.refresh(found, moved)
    expected = {**values, **tried}
    for link in target.below(moved):
        expected[link], _ = target.model.evaluate(link, expected)
    for link in target.links:
        np.testing.assert_allclose(
            *np.broadcast_arrays(found[link].astype(float), expected[link].astype(float)),
            rtol=1e-12,
        )


def test_functions_are_called_once() -> None:
    calls = []

    def doubled(x: Any) -> Any:
        calls.append(1)
        return 2 * x

    net = bmc.BayesNet()
    for t in range(30):
        net.add(f"x[{t}]", bmc.Normal(0.0, 1.0))
        net.add(f"m[{t}]", doubled, parents=[f"x[{t}]"])
    target = target_of(pose(net, seen(net, [f"m[{t}]" for t in range(30)])))
    values = a_state(target, 0)
    calls.clear()
    target.refresh(values, target.chain)
    assert len(calls) == 1
    target.refresh(values, ("x[3]", "x[4]"))
    assert len(calls) == 3


def test_the_wrong_neighbours_are_noticed() -> None:
    """Negative control: the values of other slices in their places, and the numbers of one for all."""
    target, _ = posed(slices)
    steps = LinkSteps(target, target.links)
    values = a_state(target, 3)
    expected = one_by_one(target, values)
    group = steps.steps[0]
    assert isinstance(group, LikeLinks)
    sources = group.slots.sources
    turned = {**sources, "x[0]": (*sources["x[0]"][1:], "x[0]")}
    for wrong in (
        {"slots": Slots(target, turned, 7)},
        {"evaluate": functools.partial(target.model.evaluate, group.names[0])},
    ):
        right = dict(vars(group))
        vars(group).update(wrong)
        found = dict(values)
        steps.compute(found)
        vars(group).update(right)
        assert worst_difference(target, found, expected) > 1e-3


def test_what_does_not_broadcast_stays_alone() -> None:
    """A number by which functions differ is asked in an if."""
    net = bmc.BayesNet()
    for t in range(5):
        net.add(f"x[{t}]", bmc.Normal(0.0, 1.0))
        net.add(f"m[{t}]", lambda x, t=t: x if t > 2 else -x, parents=[f"x[{t}]"])
    target = target_of(pose(net, seen(net, [f"m[{t}]" for t in range(5)])))
    values = a_state(target, 0)
    found = dict(values)
    target.refresh(found, target.chain)
    assert LinkSteps(target, target.links).steps == target.links
    assert worst_difference(target, found, one_by_one(target, values)) == 0.0


def test_an_error_names_the_node_at_fault() -> None:
    def root(x: Any, least: float) -> Any:
        if np.any(x < least):
            raise ValueError("negative")
        return np.sqrt(x - least)

    net = bmc.BayesNet()
    above = lambda x: root(x, -1.0)  # noqa: E731
    for t in range(5):
        net.add(f"x[{t}]", bmc.Exponential(1.0))
        net.add(f"m[{t}]", above, parents=[f"x[{t}]"])
    target = target_of(pose(net, seen(net, [f"m[{t}]" for t in range(5)])))
    assert isinstance(LinkSteps(target, target.links).steps[0], LikeLinks)
    values = a_state(target, 0)
    values["x[3]"] = np.full(CHAINS, -2.0)
    with marking_invalid(), pytest.raises(BayesmcError, match=r"node 'm\[3\]'"):
        target.refresh(values, target.chain)


def test_links_below_a_node() -> None:
    target, _ = posed(slices)
    assert target.below(("x[2]",)) == ("m[2]", "n[2]")


def averages(steps: int, factor: float = 1.0) -> tuple[Any, dict[str, Any]]:
    """A moving average: each expected value is made of the one before."""
    dbn = bmc.DynamicBayesNet("averages")
    dbn.add_static("level", bmc.Normal(0.0, 1.0))
    dbn.add_static("share", bmc.Normal(0.0, 0.5))
    dbn.add_static("sd", bmc.HalfNormal(1.0))
    dbn.add(
        "mean",
        lambda y_prev, mean_prev, level, share: level + factor * share * (y_prev - mean_prev),
        initial=lambda level: level + 0.0,
    )
    dbn.add("y", lambda mean, sd: bmc.Normal(mean, sd))
    return dbn, {"y": DATA.normal(size=steps)}


def test_a_recursion_is_one_program() -> None:
    dbn, data = averages(30)
    target = target_of(pose_any(dbn, data, None))
    plan = LinkPlan(target, target.links)
    (step,) = [s for s in plan.steps if isinstance(s, Recursion)]
    assert len(step.names) >= 28
    for seed in (0, 1):  # the first call is that of the functions themselves
        values = a_state(target, seed)
        found = {n: v for n, v in values.items() if n not in target.links}
        plan.compute(found)
        assert worst_difference(target, found, one_by_one(target, values)) < 1e-12
    assert step.holds


def test_a_program_that_differs_is_not_used() -> None:
    """Negative control: the program of another recursion."""
    data = averages(30)[1]
    target, other = (target_of(pose_any(averages(30, f)[0], data, None)) for f in (1.0, 1.001))
    plan, wrong = LinkPlan(target, target.links), LinkPlan(other, other.links)
    values = a_state(target, 0)
    expected = one_by_one(target, values)
    for step, unlike in zip(plan.steps, wrong.steps, strict=True):
        if isinstance(step, Recursion):
            assert isinstance(unlike, Recursion)
            step.program = unlike.program
    for _ in range(2):
        found = dict(values)
        plan.compute(found)
        assert worst_difference(target, found, expected) == 0.0
    assert [s.holds for s in plan.steps if isinstance(s, Recursion)] == [False]


def test_recursions_are_not_written_out_term_by_term() -> None:
    dbn, data = averages(80)
    for steps, is_long in ((80, True), (8, False)):
        problem = pose_any(dbn, {"y": data["y"][:steps]}, None)
        said = conjugate_kernel(Blanket(target_of(problem), "level"))
        assert (isinstance(said, str) and "made of each other" in said) is is_long
    text = str(bmc.explain(dbn, data))
    assert "3 free numbers jointly" in text
