"""Plates integrated out element by element: against one large Gaussian for each particle, and exactly.

Comparisons that chance has a part in have a false-alarm rate of 1e-3 or less, at fixed seeds.
"""

from __future__ import annotations

import itertools
import pickle
import warnings
from typing import Any

import numpy as np
import pytest
from scipy.stats import multivariate_normal

import bayesmc as bmc
from bayesmc.engines.marginal.elements.filter import ElementStep
from bayesmc.engines.marginal.elements.pool import Pool
from bayesmc.engines.marginal.gaussians import Gaussians
from bayesmc.robotics import PoseNormal, bearing, compose, range_and_bearing, range_only
from bayesmc.testing import session
from tests.mutants.elements import unbiased

STEPS, MARKS = 8, 4
ZERO = np.zeros(2)


@pytest.fixture
def same_chance(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is drawn beside beliefs takes nothing from the stream of the filter."""
    drawn, later = Gaussians.drawn, ElementStep._completed_later
    monkeypatch.setattr(Gaussians, "drawn", lambda self, rng: drawn(self, np.random.default_rng(0)))
    monkeypatch.setattr(
        ElementStep,
        "_completed_later",
        lambda self, *given: later(self, *given[:-1], np.random.default_rng(0)),
    )


def base(**plates: int) -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet(plates={"mark": MARKS, **plates})
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.3), initial=bmc.Normal(0.0, 1.0))
    return dbn


def still(rng: np.random.Generator) -> tuple[Any, ...]:
    """One reading in a row, whose label is known, and which is missing once; a mark is surveyed."""
    dbn = base()
    dbn.input("which")
    start = bmc.Normal(0.0, 3.0)
    dbn.add("mark", lambda mark_prev: bmc.Normal(mark_prev, 0.0), plates="mark", initial=start)
    dbn.add("y", lambda x, mark, which: bmc.Normal(mark[which] - x, 0.5))
    rows, surveyed = rng.normal(size=STEPS), np.full((STEPS, MARKS), np.nan)
    rows[3], surveyed[4, 2] = np.nan, 0.5
    inputs = {"which": rng.integers(0, MARKS, STEPS)}
    return dbn, {"y": rows, "mark": surveyed}, inputs, ("mark", "x", "y")


def moving(rng: np.random.Generator) -> tuple[Any, ...]:
    """Vectors that move, two sensors that pick, one of them in part; one mark is often read twice."""
    dbn = base(look=3)
    dbn.input("which", plates="look")
    dbn.add(
        "mark",
        lambda mark_prev: bmc.MvNormal(0.9 * mark_prev, scale_diag=[0.1, 0.2]),
        plates="mark",
        initial=bmc.MvNormal([0.0, 1.0], np.array([[2.0, 0.5], [0.5, 1.0]])),
    )
    dbn.add(
        "y",
        lambda x, mark, which: bmc.MvNormal(
            mark[which] - bmc.stack([x, 0 * x]), scale_diag=[0.5, 0.4]
        ),
        plates="look",
    )
    dbn.add(
        "z",
        lambda x, mark, which: bmc.Normal(2 * mark[which][..., 0] + mark[which][..., 1] * x, 0.7),
        plates="look",
    )
    y, z = rng.normal(size=(STEPS, 3, 2)), rng.normal(size=(STEPS, 3))
    y[2, 1], z[4], y[5, 0, 1], z[6, 2] = np.nan, np.nan, np.nan, np.nan
    inputs = {"which": rng.integers(0, MARKS, (STEPS, 3))}
    return dbn, {"y": y, "z": z}, inputs, ("mark", "x", "y", "z")


def sampled(rng: np.random.Generator) -> tuple[Any, ...]:
    """A label that is sampled, and that something else is seen of."""
    dbn = base()
    dbn.add(
        "mark",
        lambda mark_prev: bmc.Normal(mark_prev, 0.0),
        plates="mark",
        initial=lambda x: bmc.Normal(x, 3.0),
    )
    dbn.add("which", lambda: bmc.Categorical(np.ones(MARKS) / MARKS))
    dbn.add("n", lambda which: bmc.Normal(which * 1.0, 0.5))
    dbn.add("y", lambda x, mark, which: bmc.Normal(mark[which] - x, 0.5))
    rows = {"y": rng.normal(size=STEPS), "n": 2 + rng.normal(size=STEPS)}
    return dbn, rows, {}, ("mark", "x")


def robots(rng: np.random.Generator) -> tuple[Any, ...]:
    """Robots that never meet, each with landmarks of its own."""
    dbn = bmc.DynamicBayesNet(plates={"robot": 2, "mark": MARKS})
    dbn.input("which", plates="robot")
    start = bmc.Normal(0.0, 1.0)
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.3), plates="robot", initial=start)
    dbn.add(
        "mark",
        lambda mark_prev: bmc.Normal(mark_prev, 0.0),
        plates=("mark", "robot"),
        initial=bmc.Normal(0.0, 3.0),
    )
    dbn.add("y", lambda x, mark, which: bmc.Normal(mark[which] - x, 0.5), plates="robot")
    rows = rng.normal(size=(STEPS, 2))
    rows[3, 1] = np.nan
    inputs = {"which": rng.integers(0, MARKS, (STEPS, 2))}
    return dbn, {"y": rows}, inputs, ("mark", "x", "y")


def bent(rng: np.random.Generator) -> tuple[Any, ...]:
    """Ranges and bearings of landmarks that are known so well that tangents hold."""
    dbn = slam([2.0, 0.5], 0.05, looks=2)
    which = np.array([rng.permutation(MARKS)[:2] for _ in range(STEPS)])
    rows = np.stack(
        [2 + 0.2 * rng.normal(size=(STEPS, 2)), 0.2 + 0.1 * rng.normal(size=(STEPS, 2))], -1
    )
    rows[3, 0] = np.nan
    return dbn, {"seen": rows}, {"which": which}, ("mark", "pose")


def slam(mean: Any, scale: float, looks: int, apart: bool = False) -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet(plates={"mark": MARKS, "look": looks})
    dbn.input("which", plates="look")
    dbn.add(
        "pose",
        lambda pose_prev: PoseNormal(compose(pose_prev, [0.2, 0, 0.1]), scale_diag=[0.02] * 3),
        initial=PoseNormal(np.zeros(3), scale_diag=[0.01] * 3),
    )
    dbn.add(
        "mark",
        lambda mark_prev: bmc.MvNormal(mark_prev, scale_diag=ZERO),
        plates="mark",
        initial=bmc.MvNormal(mean, scale_diag=[scale, scale]),
    )
    if not apart:
        dbn.add(
            "seen",
            lambda pose, mark, which: range_and_bearing(pose, mark[which], 0.3, 0.2),
            plates="look",
        )
        return dbn
    dbn.add("r", lambda pose, mark, which: range_only(pose, mark[which], 0.1), plates="look")
    dbn.add("b", lambda pose, mark, which: bearing(pose, mark[which], 0.05), plates="look")
    return dbn


@pytest.mark.parametrize("make", [still, moving, sampled, robots, bent])
@pytest.mark.usefixtures("same_chance")
def test_elements_say_what_one_large_gaussian_says(
    make: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To rounding, whatever is missing, moves, or is read twice."""
    dbn, rows, inputs, nodes = make(np.random.default_rng(2))
    engine, answers = bmc.ParticleFilter(60, marginalize=["mark"]), []
    counted = []
    for whole in (False, True):
        monkeypatch.setattr(ElementStep, "whole", whole)
        passed = ElementStep._completed_later
        monkeypatch.setattr(
            ElementStep,
            "_completed_later",
            lambda self, *given, passed=passed: counted.append(1) or passed(self, *given),
        )
        found = bmc.filter(dbn, rows, inputs=inputs, engine=engine, rng=1, keep="particles")
        monkeypatch.setattr(ElementStep, "_completed_later", passed)
        answers.append([found.log_marginal_increments, found.mcse("mark")])
        answers[-1] += [f(n) for n in nodes for f in (found.mean, found.var)]
        if make is not robots:
            answers[-1] += [found.cov("mark"), found.quantile("mark", [0.3])]
    assert len(counted) == STEPS  # and none of one large Gaussian
    for one, other in zip(*answers, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("unknown", "proposal"), [(False, None), (False, "optimal"), (True, "optimal")]
)
def test_answers_are_those_of_kalman_filters_of_all_labels(
    unknown: bool, proposal: str | None
) -> None:
    """Evidence and moments without bias: Holm at 1e-6 for each; thorough sessions take more runs."""
    runs = session.scaled(30)
    assert unbiased(3, unknown, proposal, runs=runs)


@pytest.mark.parametrize("mean", [[0.0, 0.0], [-60.0, 5.0]])
@pytest.mark.parametrize("apart", [False, True])
def test_a_first_sight_is_placed_by_what_is_read(mean: list[float], apart: bool) -> None:
    """Though the prior says nothing, and its mean may be where the robot stands."""
    dbn = slam(mean, 100.0, looks=1, apart=apart)
    rows = {"r": [[3.0]], "b": [[2.5]]} if apart else {"seen": [[[3.0, 2.5]]]}
    engine = bmc.ParticleFilter(20, marginalize=["mark"])
    found = bmc.filter(dbn, rows, inputs={"which": [[1]]}, engine=engine, rng=0)
    place = 3.0 * np.array([np.cos(2.5), np.sin(2.5)])
    np.testing.assert_allclose(found.mean("mark")[0, 1], place, atol=0.06)
    np.testing.assert_allclose(found.mean("mark")[0, 0], mean)
    assert found.std("mark")[0, 1].max() < 0.7 and found.std("mark")[0, 0].min() == 100.0


def test_what_is_done_is_told() -> None:
    dbn, rows, inputs, _ = bent(np.random.default_rng(0))
    engine = bmc.ParticleFilter(10, marginalize=["mark"], proposal="optimal")
    told = bmc.explain(dbn, rows, inputs=inputs, engine=engine).nodes
    assert "element of 'mark', where it is read" in told["mark"]
    assert told["pose"].startswith("sampled given the slice before and the row")
    assert "linearised" in told["seen"]


def test_elements_that_meet_stay_one_gaussian() -> None:
    """A reading of two of them, or a neighbour that is read: nothing is proven, and nothing claimed."""
    dbn = base()
    start = bmc.Normal(0.0, 3.0)
    dbn.add("mark", lambda mark_prev: bmc.Normal(mark_prev, 0.0), plates="mark", initial=start)
    dbn.add("y", lambda x, mark: bmc.Normal(mark[0] - mark[1] - x, 0.5))
    engine = bmc.ParticleFilter(10, marginalize=["mark"])
    told = bmc.explain(dbn, {"y": np.zeros(3)}, engine=engine).nodes
    assert told["mark"] == "integrated out, a Kalman filter for each particle"
    found = bmc.filter(dbn, {"y": np.zeros(3)}, engine=engine, rng=0, keep="particles")
    assert found.clouds is not None and isinstance(found.clouds[-1].inner, Gaussians)
    assert abs(found.cov("mark")[-1, 0, 1]) > 0.1


def test_beliefs_go_on_one_by_one_and_stay_what_they_were() -> None:
    dbn, rows, inputs, _ = bent(np.random.default_rng(0))
    engine = bmc.ParticleFilter(15, marginalize=["mark"])
    found = bmc.filter(dbn, rows, inputs=inputs, engine=engine, rng=4)
    belief, held = engine.start(dbn, rng=4), []
    for k in range(STEPS):
        row = {"seen": rows["seen"][k]}
        belief = engine.step(belief, row, inputs={"which": inputs["which"][k]})
        held.append((belief, belief.mean("mark")))
        if k == 3:
            belief = engine.start(dbn, belief=pickle.loads(pickle.dumps(belief)))
    for k, (old, mean) in enumerate(held):
        np.testing.assert_allclose(mean, found.mean("mark")[k], atol=1e-12)
        np.testing.assert_array_equal(old.mean("mark"), mean)


def test_answers_about_elements_that_few_slices_read_are_those_of_every_step() -> None:
    """Of 40 elements one is read in a slice; the others are carried over from answers before."""
    rng, steps, marks = np.random.default_rng(0), 40, 40
    dbn = base(mark=marks)
    dbn.input("which")
    start = bmc.Normal(np.arange(marks), 3.0)
    dbn.add("mark", lambda mark_prev: bmc.Normal(mark_prev, 0.0), plates="mark", initial=start)
    dbn.add("y", lambda x, mark, which: bmc.Normal(mark[which] - x, 0.5))
    rows, which = rng.normal(size=steps), rng.integers(0, marks // 3, steps)
    engine = bmc.ParticleFilter(10, marginalize=["mark"])
    found = bmc.filter(dbn, {"y": rows}, inputs={"which": which}, engine=engine, rng=4)
    belief = engine.start(dbn, rng=4)
    for k in range(steps):
        belief = engine.step(belief, {"y": rows[k]}, inputs={"which": which[k]})
        np.testing.assert_allclose(found.mean("mark")[k], belief.mean("mark"), atol=1e-12)
        np.testing.assert_allclose(found.var("mark")[k], belief.var("mark"), atol=1e-12)


def test_pools_hold_what_was_put_whatever_was_resampled() -> None:
    rng = np.random.default_rng(0)
    for groups in (1, 3):
        count, elements, n = 7, 24, 2
        group = np.repeat(np.arange(groups), elements // groups)
        pool = Pool.of(
            rng.normal(size=(1, elements, n)), rng.normal(size=(1, elements, n, n)), group, count
        )
        every = np.arange(elements)
        mean, root = (np.array(a) for a in pool.at(every))
        for _ in range(200):
            if rng.random() < 0.5:
                chosen = np.sort(rng.integers(0, count, (count, groups)), axis=0)
                pool = pool.taken(chosen[:, 0] if groups == 1 else chosen)
                mean = np.take_along_axis(mean, chosen[:, group][..., None], 0)
                root = np.take_along_axis(root, chosen[:, group][..., None, None], 0)
            ids, before = rng.choice(elements, rng.integers(1, 4), replace=False), pool
            mean[:, ids] = rng.normal(size=(count, len(ids), n))
            root[:, ids] = rng.normal(size=(count, len(ids), n, n))
            pool = pool.put(ids, mean[:, ids], root[:, ids])
            for one, other in zip(pool.at(every), (mean, root), strict=True):
                np.testing.assert_array_equal(one, other)
            stays = np.setdiff1d(every, pool.written_since(before))
            assert not np.isin(ids, stays).any()
            for one, other in zip(pool.at(stays), before.at(stays), strict=True):
                np.testing.assert_array_equal(one, other)
        assert len(pool.generations) < 8


def test_elements_where_all_that_is_sampled_is_finite() -> None:
    """Unbiased against all paths enumerated; no scouts go out for elements (4 standard errors: 6e-5)."""
    turn = np.array([[0.98, 0.01, 0.01], [0.01, 0.98, 0.01], [0.01, 0.01, 0.98]])
    dbn = bmc.DynamicBayesNet(plates={"m": 3})
    dbn.add(
        "at",
        lambda at_prev: bmc.Categorical(turn[at_prev]),
        initial=bmc.Categorical([1 / 3] * 3),
    )
    dbn.add(
        "level",
        lambda level_prev: bmc.Normal(level_prev, 0.0),
        plates="m",
        initial=bmc.Normal(0.0, 2.0),
    )
    dbn.add("y", lambda level, at: bmc.Normal(level[at], 0.8))
    y = np.array([1.1, 0.9, -2.1, -1.8, 1.2])
    exact = -np.inf
    for path in itertools.product(range(3), repeat=len(y)):
        prior = np.log(turn[path[:-1], path[1:]]).sum() - np.log(3)
        same = np.equal.outer(path, path)
        cov = 4.0 * same + 0.64 * np.eye(len(y))
        exact = np.logaddexp(exact, prior + multivariate_normal(np.zeros(len(y)), cov).logpdf(y))
    engine = bmc.ParticleFilter(40, marginalize="level")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = [
            bmc.filter(dbn, {"y": y}, engine=engine, rng=k).log_marginal_likelihood
            for k in range(50)
        ]
    ratio = np.exp(np.array(found) - exact)
    assert abs(ratio.mean() - 1) < 4 * ratio.std() / np.sqrt(len(ratio))
