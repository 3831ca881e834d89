"""Full conditionals against the joint density, for every way in which elements can relate."""

from __future__ import annotations

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.mcmc.starts import start_states
from bayesmc.network import pose
from bayesmc.structure.blanket import Blanket, colours
from bayesmc.structure.target import target_of

CHAINS = 3
DATA = np.random.default_rng(7)
ONES, OTHERS = np.array([1, 1, 3]), np.array([0, 2, 0])


def _net(**plates: int) -> bmc.BayesNet:
    return bmc.BayesNet(plates=plates)


def aligned():
    net = _net(row=3, column=4)
    net.add("scale", bmc.Gamma(2.0, 1.0))
    net.add("row_effect", lambda scale: bmc.Normal(0.0, scale), plates="row")
    net.add("cell", lambda row_effect: bmc.Laplace(row_effect, 1.0), plates=("row", "column"))
    net.add("y", lambda cell, scale: bmc.StudentT(4.0, cell, scale), plates=("column", "row"))
    return net, {"y": DATA.normal(size=(4, 3))}, {"row_effect": "aligned", "cell": "aligned"}


def mixture():
    net = _net(cluster=3, point=9)
    net.add("weights", bmc.Dirichlet(np.ones(3)))
    net.add("mean", bmc.Normal(0.0, 3.0), plates="cluster")
    net.add("label", lambda weights: bmc.Categorical(weights), plates="point")
    net.add("x", lambda label, mean: bmc.Normal(np.tanh(mean[label]), 1.0), plates="point")
    return net, {"x": DATA.normal(size=9)}, {"mean": "lookup", "label": "aligned"}


def constant_index():
    net = _net(school=4, pupil=10)
    school = np.arange(10) % 4
    net.add("effect", bmc.Laplace(0.0, 1.0), plates="school")
    net.add("grade", lambda effect: bmc.Poisson(np.exp(effect[school])), plates="pupil")
    return net, {"grade": DATA.poisson(1.0, 10)}, {"effect": "rows"}


def pairs():
    net = _net(player=6, game=8)
    first = np.array([0, 1, 2, 3, 4, 0, 1, 2])
    second = np.array([1, 2, 3, 4, 5, 5, 4, 0])
    net.add("skill", bmc.Normal(0.0, 1.0), plates="player")
    net.add(
        "won",
        lambda skill: bmc.Bernoulli(logits=skill[first] - skill[second]),
        plates="game",
    )
    return net, {"won": DATA.integers(0, 2, 8)}, {"skill": "rows"}


def whole():
    net = _net(site=5)
    net.add("c", bmc.Laplace(0.0, 1.0), plates="site")
    net.add("centre", lambda c: c.mean("site"))
    net.add("b", lambda c, centre: c - centre, plates="site")
    net.add("y", lambda b: bmc.Poisson(np.exp(b)), plates="site")
    return net, {"y": DATA.poisson(1.0, 5)}, {"c": "whole"}


def cumulative():
    net = _net(time=5)
    net.add("step", bmc.Laplace(0.0, 1.0), plates="time")
    net.add("path", lambda step: np.cumsum(step.array, axis=-1), parents=["step"])
    net.add("end", lambda path: bmc.Normal(path[..., -1] * path[..., 1], 1.0))
    return net, {"end": 1.0}, {"step": "whole"}


def through_deterministic():
    net = _net(group=3, i=6)
    group = np.array([0, 1, 2, 2, 1, 0])
    net.add("a", bmc.Normal(0.0, 1.0), plates="group")
    net.add("b", lambda a: np.exp(a), plates="group")
    net.add("y", lambda b: bmc.Exponential(b[group]), plates="i")
    return net, {"y": DATA.exponential(size=6)}, {"a": "rows"}


def partly_seen():
    net = _net(i=5)
    net.add("scale", bmc.Gamma(2.0, 1.0))
    net.add("x", lambda scale: bmc.Normal(0.0, scale), plates="i")
    net.add("y", lambda x: bmc.Laplace(x, 1.0), plates="i")
    net.add("last", lambda x, scale: bmc.Normal(x, scale), plates="i")
    evidence = {
        "x": [np.nan, 0.5, np.nan, -1.0, np.nan],
        "y": DATA.normal(size=5),
        "last": [np.nan, 1.0, 2.0, np.nan, 0.0],
    }
    return net, evidence, {"x": "aligned"}


def own_and_foreign():
    net = _net(school=2, year=3, pupil=4)
    school = np.array([0, 1, 1, 0])[:, None]
    net.add("effect", bmc.Laplace(0.0, 1.0), plates=("school", "year"))
    net.add("y", lambda effect: bmc.Normal(effect[school], 1.0), plates=("pupil", "year"))
    return net, {"y": DATA.normal(size=(4, 3))}, {"effect": "rows"}


def two_labels():
    net = _net(cluster=3, point=6)
    net.add("mean", bmc.Laplace(0.0, 3.0), plates="cluster")
    net.add("label", bmc.Categorical(np.ones(3) / 3), plates="point")
    net.add("other", bmc.Categorical(np.ones(3) / 3), plates="point")
    net.add(
        "x", lambda label, other, mean: bmc.Normal(mean[label] - mean[other], 1.0), plates="point"
    )
    return net, {"x": DATA.normal(size=6)}, {"mean": "whole", "label": "aligned"}


def vectors():
    net = _net(cluster=3, point=6)
    net.add("mean", bmc.MvNormal(np.zeros(2), 4 * np.eye(2)), plates="cluster")
    net.add("label", bmc.Categorical(np.ones(3) / 3), plates="point")
    net.add("x", lambda label, mean: bmc.MvNormal(mean[label], np.eye(2)), plates="point")
    return net, {"x": DATA.normal(size=(6, 2))}, {"mean": "lookup"}


def seen_labels():
    net, evidence, _ = mixture()
    return net, {**evidence, "label": DATA.integers(0, 3, 9)}, {"mean": "rows"}


def in_two_parameters():
    net = _net(i=4, j=3)
    net.add("a", bmc.Laplace(0.0, 1.0), plates="i")
    net.add("y", lambda a: bmc.Normal(a[OTHERS] - a[ONES], np.exp(a[ONES])), plates="j")
    return net, {"y": DATA.normal(size=3)}, {"a": "rows"}


def no_closed_form():
    net = _net(cluster=3, point=6)
    net.add("mean", bmc.Laplace(0.0, 3.0), plates="cluster")
    net.add("label", bmc.Categorical(np.ones(3) / 3), plates="point")
    net.add("x", lambda label, mean: bmc.WrappedNormal(mean[label], 1.0), plates="point")
    return net, {"x": DATA.normal(size=6)}, {"mean": "lookup"}


def potential():
    net = _net(i=4)
    net.add("x", bmc.Normal(0.0, 1.0), plates="i")
    net.potential("ring", lambda x: -np.abs(x.array - np.roll(x.array, 1, axis=-1)).sum(axis=-1))
    return net, {}, {"x": "whole"}


CASES = [
    aligned, mixture, constant_index, pairs, whole, cumulative, through_deterministic, partly_seen,
    own_and_foreign, two_labels, vectors, seen_labels, in_two_parameters, no_closed_form, potential,
]  # fmt: skip


def _posed(case):
    net, evidence, expected = case()
    target = target_of(pose(net, evidence))
    with marking_invalid(), np.errstate(all="ignore"):
        values = start_states(target, CHAINS, np.random.default_rng(1))
    return target, values, expected


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.__name__)
def test_relations(case) -> None:
    target, _, expected = _posed(case)
    for name, kind in expected.items():
        kinds = {c.relation.kind for c in Blanket(target, name).children}
        assert kind in kinds, (name, kinds)


def _errors(target, values, blanket, members, rng) -> float:
    """How far changes of full conditionals, all of a class moved, are from changes of the joint density:

    of the whole class, and of one element moved alone.
    """
    name = blanket.name
    now = blanket.current(values, members)
    new = _candidate(blanket, values, members, rng)
    change = blanket.log_density(values, new, members) - blanket.log_density(values, now, members)
    shape = new.shape[: new.ndim - len(blanket.event_shape)]
    change = np.broadcast_to(change, shape).reshape(CHAINS, -1)
    element = int(rng.integers(change.shape[1]))
    one = now.reshape(CHAINS, change.shape[1], -1).copy()
    one[:, element] = new.reshape(one.shape)[:, element]
    worst = 0.0
    for moved, expected in ((new, change.sum(axis=1)), (one, change[:, element])):
        after = {**values, name: blanket.moved(values, moved.reshape(new.shape), members)}
        target.refresh(after, (name,))
        joint = target.log_density(after) - target.log_density(values)
        worst = max(worst, float(np.max(np.abs(joint - expected) / (1 + np.abs(joint)))))
    return worst


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.__name__)
def test_full_conditionals_are_the_joint(case) -> None:
    """Moving a whole class, or one element of it, changes the joint log density as told."""
    target, values, _ = _posed(case)
    rng = np.random.default_rng(2)
    with marking_invalid(), np.errstate(all="ignore"):
        for name in target.chain:
            blanket = Blanket(target, name)
            for members in blanket.classes:
                assert _errors(target, values, blanket, members, rng) < 1e-9


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.__name__)
def test_candidates_in_front(case) -> None:
    """Several candidates at once give what each gives alone."""
    target, values, _ = _posed(case)
    rng = np.random.default_rng(3)
    with marking_invalid(), np.errstate(all="ignore"):
        for name in target.chain:
            blanket = Blanket(target, name)
            for members in blanket.classes:
                some = [_candidate(blanket, values, members, rng) for _ in range(2)]
                both = blanket.log_density(values, np.stack(some), members)
                for k, one in enumerate(some):
                    alone = blanket.log_density(values, one, members)
                    np.testing.assert_allclose(both[k], alone, rtol=1e-12, atol=1e-12)


def test_a_wrong_relation_is_seen() -> None:
    """Negative control: taking coupled elements for independent ones fails the first test."""
    target, values, _ = _posed(pairs)
    blanket = Blanket(target, "skill")
    assert len(blanket.classes) > 1
    rng = np.random.default_rng(2)
    assert _errors(target, values, blanket, np.arange(6), rng) > 1e-3


def test_what_is_not_in_the_chain() -> None:
    net = _net(i=3)
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("b", lambda a: bmc.Normal(a, 1.0))
    net.add("c", lambda b: b + 1.0)
    net.add("y", lambda a: bmc.Normal(a, 1.0), plates="i")
    target = target_of(pose(net, {"y": [1.0, np.nan, 2.0]}))
    assert target.chain == ("a",)
    assert set(target.forward) == {"b", "c", "y"}
    assert set(target.terms) == {"a", "y"}
    np.testing.assert_array_equal(target.terms["y"].mask, [True, False, True])


def test_colours_of_a_grid_are_two() -> None:
    sites = np.arange(30).reshape(5, 6)
    edges = np.concatenate(
        [
            np.stack([sites[:, :-1].ravel(), sites[:, 1:].ravel()], axis=1),
            np.stack([sites[:-1].ravel(), sites[1:].ravel()], axis=1),
        ]
    )
    found = colours(30, edges)
    assert len(found) == 2
    number = np.empty(30, dtype=int)
    for c, members in enumerate(found):
        number[members] = c
    assert (number[edges[:, 0]] != number[edges[:, 1]]).all()


def _candidate(blanket, values, members, rng):
    now = blanket.current(values, members)
    node = blanket.node
    if node.domain is not None:
        return rng.integers(node.domain.size, size=now.shape).astype(now.dtype)
    if node.support.kind == "simplex":
        return rng.dirichlet(np.ones(now.shape[-1]), size=now.shape[:-1])
    moved = now * np.exp(0.3 * rng.normal(size=now.shape))
    return moved if node.support.kind == "interval" else moved + 0.3 * rng.normal(size=now.shape)
