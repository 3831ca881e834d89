"""Like children and like terms as one against one by one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import DensityError
from bayesmc.kernels.slice import Slice
from bayesmc.network import pose
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.like_functions import Slots
from bayesmc.structure.like_terms import GroupedBlanket, LikeTerms, TermSum, with_like_children
from bayesmc.structure.target import Target, Values, target_of
from tests.structure import test_stacked
from tests.structure.test_stacked import CHAINS, DATA, a_state

Asked = tuple[Any, dict[str, Any], dict[str, int]]


def emissions() -> Asked:
    """Looked up by a label that moves, time in the function."""
    net = bmc.BayesNet(plates={"state": 3})
    net.add("mu", bmc.Laplace(0.0, 1.0), plates="state")
    net.add("s", bmc.HalfCauchy(1.0))
    for t in range(7):
        net.add(f"z[{t}]", bmc.Categorical([0.2, 0.3, 0.5]))
        net.add(
            f"y[{t}]",
            lambda z, mu, s, t=t: bmc.Normal(mu[z] + 0.1 * t, s),
            parents=[f"z[{t}]", "mu", "s"],
        )
    return net, {f"y[{t}]": DATA.normal() for t in range(7)}, {"mu": 7, "s": 7}


def constant_index() -> Asked:
    """Rows that never change, the same in every group, and the time besides."""
    net = bmc.BayesNet(plates={"site": 4, "i": 6})
    site = np.array([0, 1, 1, 3, 2, 0])
    net.add("effect", bmc.Laplace(0.0, 1.0), plates="site")
    for t in range(5):
        net.add(
            f"y[{t}]",
            lambda effect, t=t: bmc.Poisson(np.exp(effect[site]) * (1 + t)),
            parents=["effect"],
            plates="i",
        )
    return net, {f"y[{t}]": DATA.poisson(1.0, 6) for t in range(5)}, {"effect": 5}


def pairs() -> Asked:
    """Two rows for each element: classes of elements."""
    net = bmc.BayesNet(plates={"player": 5, "game": 4})
    first, second = np.array([0, 1, 2, 3]), np.array([1, 2, 3, 4])
    net.add("skill", bmc.Normal(0.0, 1.0), plates="player")
    for t in range(4):
        net.add(
            f"won[{t}]",
            lambda skill: bmc.Bernoulli(logits=skill[first] - skill[second]),
            parents=["skill"],
            plates="game",
        )
    return net, {f"won[{t}]": DATA.integers(0, 2, 4) for t in range(4)}, {"skill": 4}


def whole() -> Asked:
    net = bmc.BayesNet(plates={"i": 3})
    net.add("x", bmc.Laplace(0.0, 1.0), plates="i")
    for t in range(4):
        net.add(
            f"y[{t}]",
            lambda x, t=t: bmc.Laplace(np.max(x.array, axis=-1) ** 2 / (1 + t), 1.0),
            parents=["x"],
        )
    return net, {f"y[{t}]": DATA.normal() for t in range(4)}, {"x": 4}


def potentials() -> Asked:
    net = bmc.BayesNet()
    net.add("field", bmc.Laplace(0.0, 1.0))
    for t in range(6):
        net.add(f"s[{t}]", bmc.Bernoulli(0.5))
        net.potential(
            f"p[{t}]",
            lambda s, field, t=t: 0.3 * t * s * field,
            parents=[f"s[{t}]", "field"],
        )
    return net, {}, {"field": 6}


def through_links() -> Asked:
    """One deterministic node for all, and one for each."""
    net = bmc.BayesNet(plates={"i": 2, "k": 3})
    net.add("a", bmc.Laplace(0.0, 1.0), plates="i")
    net.add("b", lambda a: np.exp(a), plates="i")
    for t in range(5):
        net.add(f"m[{t}]", lambda b, t=t: b * (1.0 + t), parents=["b"], plates="i")
        net.add(
            f"y[{t}]",
            lambda m, b: bmc.Exponential(m + 0.1 * b),
            parents=[f"m[{t}]", "b"],
            plates=("k", "i"),
        )
    evidence = {f"y[{t}]": DATA.exponential(size=(3, 2)) for t in range(5)}
    evidence["y[2]"][0, 1] = np.nan
    return net, evidence, {"a": 5}


def a_switch() -> Asked:
    """A finite node with many children, hidden ones."""
    net = bmc.BayesNet()
    net.add("on", bmc.Categorical([0.3, 0.3, 0.4]))
    for t in range(6):
        net.add(f"x[{t}]", lambda on, t=t: bmc.Laplace(on * t, 1.0 + on), parents=["on"])
        net.add(f"y[{t}]", lambda x: bmc.Laplace(x, 1.0), parents=[f"x[{t}]"])
    return net, {f"y[{t}]": DATA.normal() for t in range(6)}, {"on": 6}


CASES = [emissions, constant_index, pairs, whole, potentials, through_links, a_switch]


def candidates(blanket: Blanket, target: Target, members: Any, lead: int) -> np.ndarray:
    return np.stack([blanket.current(a_state(target, 10 + k), members) for k in range(lead)])


def worst_difference(target: Target, single: Blanket, grouped: Blanket, lead: int) -> float:
    values = a_state(target, 3)
    worst = 0.0
    with marking_invalid(), np.errstate(all="ignore"):
        for members in single.classes:
            tried = candidates(single, target, members, lead)
            one = single.log_density(values, tried, members)
            two = grouped.log_density(values, tried, members)
            worst = max(worst, float(np.max(np.abs(one - two) / (1 + np.abs(one)))))
    return worst


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.__name__)
def test_full_conditionals(case: Callable[[], Asked]) -> None:
    net, evidence, expected = case()
    target = target_of(pose(net, evidence))
    for name, count in expected.items():
        single = Blanket(target, name)
        grouped = with_like_children(single)
        assert isinstance(grouped, GroupedBlanket)
        assert [len(terms.names) for terms, _ in grouped.groups] == [count]
        for lead in (1, 3):
            assert worst_difference(target, single, grouped, lead) < 1e-12


@pytest.mark.parametrize("case", test_stacked.CASES, ids=lambda c: c.__name__)
def test_parameters_of_series(case: Callable[[], Any]) -> None:
    """All nodes of the models of like nodes, whose neighbours may be few: some have none that are alike."""
    net, evidence, _ = case()
    target = target_of(pose(net, evidence))
    asked = 0
    for name in target.chain:
        single = Blanket(target, name)
        grouped = with_like_children(single)
        if grouped is not single:
            assert worst_difference(target, single, grouped, 2) < 1e-12
            asked += 1
    assert (asked > 0) == (case.__name__ not in ("numbered", "vectors", "partly_known"))


@pytest.mark.parametrize("case", [*CASES, *test_stacked.CASES], ids=lambda c: c.__name__)
def test_sums(case: Callable[[], Any]) -> None:
    net, evidence, _ = case()
    target = target_of(pose(net, evidence))
    total = TermSum(target, target.terms.values())
    assert total.groups
    values = a_state(target, 4)
    with marking_invalid(), np.errstate(all="ignore"):
        one, two = target.log_density(values), total.log_density(values)
    np.testing.assert_allclose(two, one, rtol=1e-12)


def test_sums_with_candidates_in_front() -> None:
    """Values that move have more axes in front than those that stay."""
    net, evidence, _ = test_stacked.numbered()
    target = target_of(pose(net, evidence))
    moved = ("x[2]", "x[3]", "x[7]")
    terms = target.terms_of(moved)
    total = TermSum(target, terms)
    assert total.groups
    values = a_state(target, 4)
    rng = np.random.default_rng(0)
    values |= {n: rng.normal(size=(3, CHAINS)) for n in moved}
    found = total.log_density(values)
    assert found.shape == (3, CHAINS)
    np.testing.assert_allclose(found, target.log_density(values, terms), rtol=1e-12)


def test_functions_are_called_once() -> None:
    calls = []

    def emission(rate: Any) -> Any:
        calls.append(1)
        return bmc.Poisson(rate)

    net = bmc.BayesNet()
    net.add("rate", bmc.LogNormal(0.0, 1.0))
    for t in range(20):
        net.add(f"y[{t}]", emission)
    target = target_of(pose(net, {f"y[{t}]": t for t in range(20)}))
    grouped = with_like_children(Blanket(target, "rate"))
    total = TermSum(target, target.terms.values())
    values: Values = {**target.known, "rate": np.ones(2)}
    for ask in (
        lambda: grouped.log_density(values, np.ones((3, 2))),
        lambda: total.log_density(values),
    ):
        calls.clear()
        ask()
        assert len(calls) == 1


def test_the_wrong_neighbours_are_noticed() -> None:
    """Negative control: labels of other children in their places, and the numbers of one for all."""
    net, evidence, _ = emissions()
    target = target_of(pose(net, evidence))
    single = Blanket(target, "mu")
    grouped = with_like_children(single)
    assert isinstance(grouped, GroupedBlanket)
    ((terms, child),) = grouped.groups
    sources = terms.slots.sources
    turned = {**sources, "z[0]": (*sources["z[0]"][1:], "z[0]")}
    plain = target.terms[terms.term.name]
    for wrong in (
        LikeTerms(terms.term, terms.names, Slots(target, turned, 7)),
        LikeTerms(plain, terms.names, terms.slots),
    ):
        other = GroupedBlanket(single, [(wrong, replace(child, term=wrong.term))])
        assert worst_difference(target, single, other, 2) > 1e-3


def test_few_and_unlike_children_stay_alone() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Laplace(0.0, 1.0))
    for t in range(3):
        net.add(f"a[{t}]", lambda x: bmc.Laplace(x, 1.0))
    for t in range(4):
        net.add(f"b[{t}]", lambda x, t=t: bmc.Laplace(np.exp(x) if t > 1 else -x, 1.0))
    seen = {f"a[{t}]": 1.0 for t in range(3)} | {f"b[{t}]": 1.0 for t in range(4)}
    target = target_of(pose(net, seen))
    single = Blanket(target, "x")
    assert with_like_children(single) is single
    assert not TermSum(target, target.terms.values()).groups


def test_an_error_names_the_child_at_fault() -> None:
    def density(x: Any, scale: Any) -> Any:  # at zero infinite, or minus infinity
        return bmc.Gamma(np.where(x * scale > 30, 0.5, 2.0), 1.0)

    net = bmc.BayesNet()
    net.add("x", bmc.Laplace(0.0, 1.0))
    for t in range(5):
        net.add(f"y[{t}]", lambda x, scale=t: density(x, scale))
    target = target_of(pose(net, {f"y[{t}]": 0.0 for t in range(5)}))
    grouped = with_like_children(Blanket(target, "x"))
    assert isinstance(grouped, GroupedBlanket)
    total = TermSum(target, target.terms.values())
    values: Values = {**target.known, "x": np.array([1.0, 8.0])}
    with marking_invalid(), np.errstate(all="ignore"):
        with pytest.raises(DensityError, match=r"node 'y\[4\]'.*x = 8"):
            grouped.log_density(values, values["x"])
        with pytest.raises(DensityError, match=r"node 'y\[4\]'.*x = 8"):
            total.log_density(values)


def test_a_slice_moves_as_before() -> None:
    """The same numbers, whether children are asked together or one by one."""
    net, evidence, _ = emissions()
    target = target_of(pose(net, evidence))
    single = Blanket(target, "mu")
    values = a_state(target, 5)
    moved = []
    for blanket in (single, with_like_children(single)):
        kernel = Slice(blanket)
        with marking_invalid(), np.errstate(all="ignore"):
            new, _ = kernel.step(
                values, kernel.start(values, CHAINS), np.random.default_rng(1), False
            )
        moved.append(new["mu"])
    np.testing.assert_allclose(moved[0], moved[1], rtol=1e-9)
