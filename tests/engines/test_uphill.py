"""Starts moved towards the mass: textbook models on which draws of the prior start chains far away."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.special import expit, ndtr

import bayesmc as bmc
from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.mcmc import uphill as module
from bayesmc.engines.mcmc.starts import start_states
from bayesmc.engines.mcmc.uphill import uphill
from bayesmc.engines.unrolled import pose_any
from bayesmc.errors import ZeroProbabilityError
from bayesmc.structure.target import Target, Values, target_of

Asked = tuple[bmc.BayesNet, dict[str, Any]]
RNG = np.random.default_rng(20)
AGE = np.array([118.0, 484, 664, 1004, 1231, 1372, 1582])
DOSE = np.linspace(1.69, 1.88, 8)
TREATED, KILLED = [59, 60, 62, 56, 63, 59, 62, 60], [6, 13, 18, 28, 52, 53, 61, 60]


def growth() -> Asked:
    """Orange trees (Pinheiro and Bates 2000), vaguely."""
    net = bmc.BayesNet(plates={"t": 7})
    for name in ("size", "middle", "scale"):
        net.add(name, bmc.Normal(0.0, 1000.0))
    net.add("sigma", bmc.HalfCauchy(25.0))
    net.add(
        "y",
        lambda size, middle, scale, sigma: bmc.Normal(
            size / (1 + np.exp(-(AGE - middle) / scale)), sigma
        ),
        plates="t",
    )
    return net, {"y": [30.0, 58, 87, 115, 120, 142, 145]}


def beetles(link: Callable[[Any], Any]) -> Asked:
    """Bliss's beetles, not centred, vaguely: links are 0 or 1 to the last digit at most draws."""
    net = bmc.BayesNet(plates={"dose": 8})
    for name in ("a", "b"):
        net.add(name, bmc.Normal(0.0, 1000.0))
    net.add("r", lambda a, b: bmc.Binomial(np.array(TREATED), link(a + b * DOSE)), plates="dose")
    return net, {"r": KILLED}


def survival() -> Asked:
    """Hours to failure, by shape and log rate: exponents of many thousands."""
    net = bmc.BayesNet(plates={"i": 30})
    net.add("shape", bmc.Exponential(1.0))
    net.add("rate", bmc.Normal(0.0, 100.0))
    net.add("t", lambda shape, rate: bmc.Weibull(shape, np.exp(-rate / shape)), plates="i")
    return net, {"t": 80_000 * np.random.default_rng(1).weibull(2.5, 30)}


def frailty() -> Asked:
    """Kidney (McGilchrist and Aisbett 1991) in kind: a Weibull regression on age, two times for a patient."""
    rng = np.random.default_rng(2)
    age, patient = 44 + 10 * rng.normal(size=76), np.repeat(np.arange(38), 2)
    net = bmc.BayesNet(plates={"i": 76, "patient": 38})
    net.add("a", bmc.Normal(0.0, 100.0))
    net.add("b", bmc.Normal(0.0, 100.0))
    net.add("r", bmc.Gamma(1.0, 1e-3))
    net.add("tau", bmc.Gamma(1e-3, 1e-3))
    net.add("f", lambda tau: bmc.Normal(0.0, tau**-0.5), plates="patient")
    net.add(
        "t",
        lambda a, b, f, r: bmc.Weibull(r, np.exp(-(a + b * age + f[patient]) / r)),
        plates="i",
    )
    return net, {"t": np.exp(rng.normal(4.0, 1.0, 76))}


def counts() -> Asked:
    """A log-linear trend of counts."""
    x = np.linspace(0.0, 10.0, 25)
    net = bmc.BayesNet(plates={"i": 25})
    net.add("a", bmc.Normal(0.0, 100.0))
    net.add("b", bmc.Normal(0.0, 100.0))
    net.add("y", lambda a, b: bmc.Poisson(np.exp(a + b * x)), plates="i")
    return net, {"y": np.random.default_rng(3).poisson(np.exp(2 + 0.5 * x))}


def logistic_growth() -> Asked:
    """Numbers of a population that starts small and fills its room."""
    t = np.arange(20.0)
    net = bmc.BayesNet(plates={"t": 20})
    for name in ("room", "rate", "first"):
        net.add(name, bmc.LogNormal(0.0, 10.0))
    net.add(
        "y",
        lambda room, rate, first: bmc.Poisson(room / (1 + (room / first - 1) * np.exp(-rate * t))),
        plates="t",
    )
    return net, {"y": np.random.default_rng(4).poisson(500 / (1 + np.exp(4 - 0.6 * t)))}


def gamma_regression() -> Asked:
    x = np.linspace(0.0, 1.0, 30)
    net = bmc.BayesNet(plates={"i": 30})
    net.add("a", bmc.Normal(0.0, 1000.0))
    net.add("b", bmc.Normal(0.0, 1000.0))
    net.add("k", bmc.Gamma(1e-3, 1e-3))
    net.add("y", lambda a, b, k: bmc.Gamma(k, k * np.exp(-a - b * x)), plates="i")
    return net, {"y": np.random.default_rng(5).gamma(5.0, np.exp(10 + 3 * x) / 5)}


def enzyme() -> Asked:
    """Puromycin (Bates and Watts 1988)."""
    s = np.array([0.02, 0.02, 0.06, 0.06, 0.11, 0.11, 0.22, 0.22, 0.56, 0.56, 1.1, 1.1])
    net = bmc.BayesNet(plates={"i": 12})
    for name, top in (("most", 1e4), ("half", 1e3), ("sd", 1e3)):
        net.add(name, bmc.Uniform(0.0, top))
    net.add("v", lambda most, half, sd: bmc.Normal(most * s / (half + s), sd), plates="i")
    return net, {"v": [76.0, 47, 97, 107, 123, 139, 159, 152, 191, 201, 207, 200]}


MODELS: dict[str, Callable[[], Asked]] = {
    "growth": growth,
    "logit": lambda: beetles(expit),
    "probit": lambda: beetles(ndtr),
    "cloglog": lambda: beetles(lambda eta: 1 - np.exp(-np.exp(eta))),
    "survival": survival,
    "frailty": frailty,
    "counts": counts,
    "logistic growth": logistic_growth,
    "gamma regression": gamma_regression,
    "enzyme": enzyme,
}


def begun(name: str, seed: int) -> tuple[Target, Values, Values]:
    """A target, eight starts by draws, and these moved uphill."""
    net, evidence = MODELS[name]()
    target = target_of(pose_any(net, evidence, None, None))
    rng = np.random.default_rng(seed)
    with marking_invalid(), np.errstate(all="ignore"):
        drawn = start_states(target, 8, rng)
        return target, drawn, uphill(target, drawn, rng)


def log_of(target: Target, values: Values) -> np.ndarray:
    with marking_invalid(), np.errstate(all="ignore"):
        return np.asarray(target.log_density({**target.known, **values}))


@pytest.mark.parametrize("name", MODELS)
def test_starts_are_near_and_apart(name: str) -> None:
    """All have positive density, and within what a path leaves of the best; and no two are the same."""
    for seed in range(2):
        target, drawn, moved = begun(name, seed)
        before, after = log_of(target, drawn), log_of(target, moved)
        assert np.isfinite(before).all()
        assert np.isfinite(after).all()
        assert after.min() >= before.min() - 1e-6
        size = sum(int(np.prod(target.model[n].value_shape)) for n in target.chain)
        assert np.ptp(after) < 12 * (20.0 + 2.0 * size)
        first = moved[target.chain[0]]
        assert len(np.unique(first)) >= 4


def test_the_frailty_model_is_found_from_far_away() -> None:
    target, drawn, moved = begun("frailty", 1)
    assert log_of(target, drawn).max() < -10_000
    assert log_of(target, moved).min() > -2_000


@pytest.mark.parametrize("seed", [1, 2])
def test_starts_that_paths_leave_far_off_begin_near_zero(
    monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    """Effects in the thousands fit each patient, and no path leads out of there in time."""
    target, _, moved = begun("frailty", seed)
    near = log_of(target, moved)

    def kept(target: Any, density: Any, points: Any, logs: Any, *rest: Any) -> Any:
        return points, logs, np.arange(points.shape[1])

    monkeypatch.setattr(module, "_from_near", kept)
    target, _, moved = begun("frailty", seed)
    assert near.max() > log_of(target, moved).max() + 100.0
    assert near.max() > -450.0  # the mode is at -307


def test_paths_near_zero_into_a_neck_replace_no_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """Effects of a flat scale: the density has no bound there, but starts are no worse than the posterior."""
    net = bmc.BayesNet(plates={"i": 40})
    net.add("a", bmc.Normal(0.0, 100.0))
    net.add("s", bmc.Uniform(0.0, 100.0))
    net.add("b", lambda a, s: bmc.Normal(a, s), plates="i")
    net.add("y", lambda b: bmc.Poisson(np.exp(b)), plates="i")
    evidence = {"y": RNG.poisson(np.exp(2.0 + 0.7 * RNG.normal(size=40)))}
    target = target_of(pose_any(net, evidence, None, None))
    asked: list[bool] = []
    from_near = module._from_near

    def watched(*args: Any) -> Any:
        found = from_near(*args)
        asked.append(found[0] is args[2])
        return found

    monkeypatch.setattr(module, "_from_near", watched)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        with marking_invalid(), np.errstate(all="ignore"):
            moved = uphill(target, start_states(target, 8, rng), rng)
        assert np.median(moved["s"]) > 0.3
    assert asked
    assert all(asked)


def test_one_bad_path_leaves_the_others_good() -> None:
    """A seed at which one row of eight ends where the model's own density is none."""
    target, _, moved = begun("frailty", 3)
    assert log_of(target, moved).min() > -2_000


def test_a_good_start_stays_where_it_is() -> None:
    """And so does one in a funnel, whose mode is its neck."""
    net = bmc.BayesNet(plates={"i": 8})
    net.add("tau", bmc.HalfCauchy(5.0))
    net.add("theta", lambda tau: bmc.StudentT(5.0, 0.0, tau), plates="i")
    net.add("y", lambda theta: bmc.StudentT(4.0, theta, 10.0), plates="i")
    target = target_of(pose_any(net, {"y": [28.0, 8, -3, 7, -1, 1, 18, 12]}, None, None))
    rng = np.random.default_rng(1)
    with marking_invalid(), np.errstate(all="ignore"):
        drawn = start_states(target, 8, rng)
        moved = uphill(target, drawn, rng)
    assert np.median(moved["tau"]) > 0.3 * np.median(drawn["tau"])
    assert (moved["tau"] == drawn["tau"]).any()


def test_models_without_a_gradient_start_as_they_did() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 100.0))
    net.add("y", lambda x: bmc.Normal(float(np.asarray(x).ravel()[0]) if x.size == 1 else x, 1.0))
    target = target_of(pose_any(net, {"y": 50.0}, None, None))
    rng = np.random.default_rng(1)
    drawn = start_states(target, 8, rng)
    assert uphill(target, drawn, rng) is drawn


def test_a_wrong_gradient_moves_nothing_out_of_the_support(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Whatever the paths say, the model's own functions have the last word."""

    def nowhere(density: Any, start: np.ndarray, *rest: Any) -> tuple[np.ndarray, np.ndarray]:
        far = np.full_like(start, 1e6)
        return np.stack([start, far]), np.stack([np.full(len(start), -1e9), np.zeros(len(start))])

    monkeypatch.setattr(module, "_paths", nowhere)
    target, drawn, moved = begun("survival", 1)
    np.testing.assert_array_equal(drawn["shape"], moved["shape"])
    assert np.isfinite(log_of(target, moved)).all()


def test_what_no_start_makes_possible_is_named() -> None:
    net, _ = beetles(expit)
    with pytest.raises(ZeroProbabilityError, match=r"'r'.*61 is impossible"):
        bmc.infer(net, {"r": [6, 13, 18, 28, 52, 53, 61, 61]}, engine=bmc.Gibbs(), rng=1)


def test_starts_are_as_wide_as_the_posterior() -> None:
    """Of a posterior that is known: eight starts have half its spread or more (an alarm in 2,000 seeds).

    The best of many draws each, as starts once were, are seen to be narrower.
    """
    net = bmc.BayesNet(plates={"i": 4})
    net.add("mean", bmc.Normal(0.0, 10.0))
    net.add("x", lambda mean: bmc.Normal(mean, 4.0), plates="i")
    target = target_of(pose_any(net, {"x": [3.0, -2.0, 4.0, 1.0]}, None, None))
    widths = [start_states(target, 8, np.random.default_rng(s))["mean"].std() for s in range(20)]
    assert np.mean(widths) > 2.0  # sd of the posterior 1.96
