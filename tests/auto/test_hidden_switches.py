"""Switches above hidden numbers or many finite nodes: chains cross between states, or their errors say so.

Answers may be off by 4.5 of their errors, which has a chance of 7e-6 in each of the fourteen figures.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy import stats

import bayesmc as bmc
from bayesmc.engines.mcmc import gibbs
from bayesmc.errors import ConvergenceWarning
from bayesmc.testing import session

QUICK = bmc.Gibbs(draws=350, warmup=100, chains=8)
Question = tuple[bmc.BayesNet, dict[str, Any], str, np.ndarray]


def switch() -> Question:
    """A rare switch, whose level fits the datum."""
    net = bmc.BayesNet()
    net.add("s", bmc.Bernoulli(0.01))
    net.add("m", lambda s: bmc.Normal(8 * s, 0.5))
    net.add("y", lambda m: bmc.StudentT(3, m, 1))
    return net, {"y": 6.0}, "s", np.array(_share([0.99, 0.01], [0.0, 8.0], 0.5, 6.0))


def devices() -> Question:
    """Two switches, one datum."""
    net = bmc.BayesNet()
    for s, m in (("s", "m"), ("t", "n")):
        net.add(s, bmc.Bernoulli(0.02))
        net.add(m, lambda s: bmc.Normal(5 * s, 0.3), parents=[s])
    net.add("y", lambda m, n: bmc.StudentT(3, m + n, 1))
    prior = [0.98, 0.98 * 0.02, 0.02 * 0.98, 0.02 * 0.02]
    like = [_evidence(c, 0.3 * np.sqrt(2), 4.5) for c in (0.0, 5.0, 5.0, 10.0)]
    joint = np.multiply(prior, like)
    return net, {"y": 4.5}, "s", np.array(joint[2:].sum() / joint.sum())


def outliers() -> Question:
    """A flag for each datum."""
    y = np.array([0.2, -0.5, 8.5, 1.0, 5.0])
    net = bmc.BayesNet(plates={"i": len(y)})
    net.add("z", bmc.Bernoulli(0.05), plates="i")
    net.add("e", lambda z: bmc.Normal(8 * z, 0.5), plates="i")
    net.add("y", lambda e: bmc.StudentT(3, e, 1), plates="i")
    return net, {"y": y}, "z", np.array([_share([0.95, 0.05], [0.0, 8.0], 0.5, v) for v in y])


def spikes() -> Question:
    """Coefficients that are small or not, of a logistic regression."""
    x = np.random.default_rng(5).normal(size=(30, 2))
    y = (np.random.default_rng(6).random(30) < 1 / (1 + np.exp(-2 * x[:, 0]))).astype(int)
    net = bmc.BayesNet(plates={"j": 2, "i": 30})
    net.add("z", bmc.Bernoulli(0.3), plates="j")
    net.add("b", lambda z: bmc.Normal(0, np.where(z, 3.0, 0.02)), plates="j")
    net.add("y", lambda b: bmc.Bernoulli(logits=x[:, 0] * b[0] + x[:, 1] * b[1]), plates="i")
    nodes, weights = np.polynomial.hermite_e.hermegauss(80)
    joint = np.zeros((2, 2))
    for first, second in np.ndindex(2, 2):
        one, two = (nodes * (3.0 if z else 0.02) for z in (first, second))
        eta = one[:, None, None] * x[:, 0] + two[:, None] * x[:, 1]
        log = np.where(y == 1, -np.logaddexp(0, -eta), -np.logaddexp(0, eta)).sum(axis=-1)
        prior = np.prod([0.3 if z else 0.7 for z in (first, second)])
        joint[first, second] = prior * (weights[:, None] * weights * np.exp(log)).sum()
    joint /= joint.sum()
    return net, {"y": y}, "z", np.array([joint[1].sum(), joint[:, 1].sum()])


def class_of_items() -> Question:
    """A class above the hidden answers to eight items, of which only the number is seen, roughly."""
    items = 8
    net = bmc.BayesNet(plates={"i": items})
    net.add("c", bmc.Bernoulli(0.4))
    net.add("right", lambda c: bmc.Bernoulli(np.where(c == 1, 0.97, 0.05)), plates="i")
    net.add("y", lambda right: bmc.Normal(right.sum(), 4.0))
    counts = np.arange(items + 1)
    like = stats.norm.pdf(5.0, counts, 4.0)
    joint = [
        p * (like * stats.binom.pmf(counts, items, q)).sum() for p, q in ((0.6, 0.05), (0.4, 0.97))
    ]
    return net, {"y": 5.0}, "c", np.array(joint[1] / sum(joint))


def _evidence(centre: float, sd: float, y: float) -> float:
    at = np.linspace(centre - 9 * sd, centre + 9 * sd, 4001)
    return float(np.trapezoid(stats.norm.pdf(at, centre, sd) * stats.t.pdf(y - at, 3), at))


def _share(prior: list[float], centres: list[float], sd: float, y: float) -> float:
    joint = np.multiply(prior, [_evidence(c, sd, y) for c in centres])
    return float(joint[1] / joint.sum())


ALL = [switch, devices, outliers, spikes, class_of_items]


def answered(build: Callable[[], Question], **options: Any) -> tuple[np.ndarray, np.ndarray]:
    """By how many of its errors an answer is off, and these errors."""
    net, evidence, name, truth = build()
    found = bmc.infer(net, evidence, rng=session.seed(), **options)
    error = found.mcse(name)
    return np.abs(found.mean(name) - truth) / error, error


@pytest.mark.filterwarnings("ignore::bayesmc.errors.ConvergenceWarning")  # of draws, which are few
@pytest.mark.parametrize("build", ALL[1:])
def test_chains_cross(build: Callable[[], Question]) -> None:
    off, error = answered(build, engine=QUICK)
    assert (off < 4.5).all() and (error < 0.06).all()


@pytest.mark.parametrize("build", [switch, class_of_items])
def test_metropolis_crosses(build: Callable[[], Question]) -> None:
    off, error = answered(build, engine=bmc.MetropolisHastings(draws=350, warmup=100, chains=8))
    assert (off < 4.5).all() and (error < 0.06).all()


def test_the_default_answers() -> None:
    off, error = answered(switch)
    assert off < 4.5 and error < 0.03


@pytest.mark.filterwarnings("ignore::bayesmc.errors.ConvergenceWarning")
@pytest.mark.parametrize("build", [switch, outliers, class_of_items])
def test_without_joint_moves_they_do_not(
    build: Callable[[], Question], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The negative control; and what never moved is not held for known."""
    monkeypatch.setattr(gibbs, "redrawn_kernels", lambda *_: [])
    off, error = answered(build, engine=QUICK)
    assert error.max() > 0.2 and (off < 4.5).all()


# ---- what cannot be moved ------------------------------------------------------------------------


def stuck(copies: int = 30) -> tuple[bmc.BayesNet, dict[str, Any]]:
    """A switch above so many numbers that draws of all of them never fit."""
    net = bmc.BayesNet(plates={"i": copies})
    net.add("s", bmc.Bernoulli(0.05), states=("off", "on"))
    net.add("m", lambda s: bmc.Normal(4.0 * (s == "on"), 0.5), plates="i")
    net.add("y", lambda m: bmc.StudentT(3, m, 0.1), plates="i")
    net.add("reversed", lambda s: 1 - (s == "on"))
    y = 2 + 0.5 * np.random.default_rng(0).normal(size=copies)
    return net, {"y": y}


@pytest.mark.parametrize("keep", ["draws", "summaries"])
def test_what_never_moved_is_no_certainty(keep: str) -> None:
    net, evidence = stuck()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        engine = bmc.Gibbs(draws=300, warmup=100)  # the four chains start alike at this seed
        found = bmc.infer(net, evidence, engine=engine, rng=1, keep=keep)
    assert set(found.probabilities("s")) == {0.0, 1.0}  # all chains stand where they started
    assert (found.mcse("s") > 0.2).all() and found.mcse("reversed") > 0.2
    if keep == "draws":
        assert found.mcse(lambda s: s == "on") == found.mcse("reversed")
    said = [str(w.message) for w in caught if issubclass(w.category, ConvergenceWarning)]
    assert any("no chain ever left the state of 's'" in m and "'m'" in m for m in said)


def test_a_state_that_the_data_rule_out_is_known_to_be() -> None:
    """What hangs on a node was drawn anew often: that it never moved tells something."""
    net, evidence, name, _ = outliers()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")  # of draws, which are few
        found = bmc.infer(net, evidence, engine=QUICK, rng=session.seed())
    assert not any("no chain ever left" in str(w.message) for w in caught)
    still = found.mean(name) == 0
    assert still.any() and (found.mcse(name)[still] < 0.02).all()
    assert (found.renewals[name] > 100).all()


# ---- weighting -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("rare", "chosen"), [(0.05, bmc.LikelihoodWeighting), (1e-4, bmc.Gibbs)])
def test_weighting_is_taken_where_it_sees_all_states(rare: float, chosen: type) -> None:
    net = bmc.BayesNet()
    net.add("s", bmc.Bernoulli(rare))
    net.add("m", lambda s: bmc.Gamma(2 + 8 * s, 1))
    net.add("y", lambda m: bmc.Weibull(2.0, m))
    found = bmc.infer(net, {"y": 6.0}, rng=session.seed())
    assert type(found.engine) is chosen
    at = np.linspace(1e-3, 60, 20001)
    joint = [
        p * np.trapezoid(stats.gamma.pdf(at, a) * stats.weibull_min.pdf(6.0, 2.0, scale=at), at)
        for p, a in ((1 - rare, 2), (rare, 10))
    ]
    assert abs(found.mean("s") - joint[1] / sum(joint)) < 4.5 * found.mcse("s") < 0.2


def sensor(steep: bool) -> tuple[bmc.BayesNet, dict[str, Any]]:
    """A reading that is precise or not; if steep, hardly a draw of the level fits a precise one."""
    precise = 1e-4 if steep else 30.0
    net = bmc.BayesNet(plates={"i": 5})
    net.add("on", bmc.Bernoulli(0.5))
    net.add(
        "level", lambda on: bmc.Normal(0.0, np.where(on, 2.0, 1.0) if not steep else 1 + 9 * on)
    )
    net.add(
        "y", lambda on, level: bmc.Normal(np.sinh(level), np.where(on, precise, 1e3)), plates="i"
    )
    return net, {"y": np.sinh(3.0) + 1e-4 * np.array([0.3, -0.8, 1.1, -0.2, 0.5])}


@pytest.mark.parametrize(("steep", "chosen"), [(True, bmc.Gibbs), (False, bmc.LikelihoodWeighting)])
def test_weighting_is_taken_where_it_knows_what_each_state_weighs(
    steep: bool, chosen: type
) -> None:
    """Half of all draws are of the state that is certain, if steep: hardly one of them fits."""
    text = str(bmc.explain(*sensor(steep))).splitlines()
    assert text[0].split()[1].startswith(chosen.__name__)
    assert any("each joint state" in row for row in text) is not steep
