"""Geweke's and the rank test on kernels written by hand: right ones pass as often as they should, and every
kind of deliberate error is found.

False alarms: a right kernel is tested at many fixed seeds at a large alpha, and the number of
rejections held against the binomial law; such a count is itself wrong with chance 1e-4. Single runs are
at alpha = 1e-3 for right kernels, i.e. a fresh seed would fail one run in a thousand.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.special

from bayesmc.errors import DensityError, ShapeError
from bayesmc.testing import GewekeResult, JointModel, geweke_test, rank_test
from bayesmc.testing.verdict import Comparison

# ---- a conjugate Normal model: unknown mean and precision, five observations -----------------------

SHAPE, RATE, PRIOR_MEAN, POINTS = 4.0, 3.0, 0.5, 5


def normal_prior(rng: np.random.Generator, n: int) -> dict[str, np.ndarray]:
    return {"mean": rng.normal(PRIOR_MEAN, 1.0, n), "precision": rng.gamma(SHAPE, 1 / RATE, n)}


def normal_data(state: dict, rng: np.random.Generator) -> np.ndarray:
    scale = state["precision"] ** -0.5
    return rng.normal(state["mean"][:, None], scale[:, None], (len(scale), POINTS))


def draw_mean(state: dict, data: np.ndarray, rng: np.random.Generator, fault: str = "") -> dict:
    total = data[:, fault == "off by one" :].sum(axis=1)
    prior = 0.0 if fault == "no prior" else 1.0
    precision = prior + state["precision"] * POINTS
    centre = (prior * PRIOR_MEAN + state["precision"] * total) / precision
    return state | {
        "mean": rng.normal(centre, 1 / precision if fault == "variance" else precision**-0.5)
    }


def draw_precision(state: dict, data: np.ndarray, rng: np.random.Generator) -> dict:
    rate = RATE + 0.5 * ((data - state["mean"][:, None]) ** 2).sum(axis=1)
    return state | {"precision": rng.gamma(SHAPE + 0.5 * POINTS, 1 / rate)}


def scale_precision(
    state: dict, data: np.ndarray, rng: np.random.Generator, fault: str = ""
) -> dict:
    """Metropolis-Hastings on the log scale: the proposal is not symmetric in the precision itself."""
    new = state["precision"] * np.exp(rng.normal(0.0, 0.7, len(data)))
    squares = ((data - state["mean"][:, None]) ** 2).sum(axis=1)

    def log_density(value: np.ndarray) -> np.ndarray:
        return (SHAPE + 0.5 * POINTS - 1) * np.log(value) - (RATE + 0.5 * squares) * value

    log_ratio = log_density(new) - log_density(state["precision"])
    if fault != "no Hastings":
        log_ratio += np.log(new / state["precision"])
    accepted = np.log(rng.random(len(data))) < log_ratio
    return state | {"precision": np.where(accepted, new, state["precision"])}


def normal_kernel(fault: str = "") -> Callable:
    """A sweep mean, precision by Gibbs, then precision by Metropolis-Hastings."""

    def kernel(state: dict, data: np.ndarray, rng: np.random.Generator) -> dict:
        state = draw_mean(state, data, rng, fault)
        if fault != "no Hastings":  # a Gibbs draw before it would hide half of its error
            state = draw_precision(state, data, rng)
        return scale_precision(state, data, rng, fault)

    return kernel


def normal_reverse(fault: str = "") -> Callable:
    def kernel(state: dict, data: np.ndarray, rng: np.random.Generator) -> dict:
        state = scale_precision(state, data, rng, fault)
        if fault != "no Hastings":
            state = draw_precision(state, data, rng)
        return draw_mean(state, data, rng, fault)

    return kernel


NORMAL_STATISTICS = {
    "mean": lambda s, y: s["mean"],
    "precision": lambda s, y: s["precision"],
    "distance": lambda s, y: (s["mean"] - y.mean(axis=1)) ** 2,
    "first": lambda s, y: s["mean"] * y[:, 0],
}
NORMAL = (normal_prior, normal_data)

# ---- a mixture of three overlapping categories, eight points, known spread -------------------------

ALPHA = np.array([1.0, 2.0, 4.0])
CENTRES = np.array([-1.0, 0.0, 1.5])
MEMBERS = 8


def mixture_prior(rng: np.random.Generator, n: int) -> dict[str, np.ndarray]:
    weights = rng.dirichlet(ALPHA, n)
    return {
        "weights": weights,
        "means": rng.normal(CENTRES, 1.0, (n, 3)),
        "labels": categories(np.broadcast_to(weights[:, None], (n, MEMBERS, 3)), rng),
    }


def mixture_data(state: dict, rng: np.random.Generator) -> np.ndarray:
    return rng.normal(np.take_along_axis(state["means"], state["labels"], axis=1), 1.0)


def categories(weights: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    cumulative = weights.cumsum(axis=-1)
    u = rng.random(weights.shape[:-1] + (1,)) * cumulative[..., -1:]
    return (u > cumulative[..., :-1]).sum(axis=-1)


def draw_labels(state: dict, data: np.ndarray, rng: np.random.Generator, fault: str = "") -> dict:
    log_weight = -0.5 * (data[..., None] - state["means"][:, None]) ** 2
    weights = np.exp(log_weight)
    if fault != "category prior":
        weights = weights * state["weights"][:, None]
    return state | {"labels": categories(weights, rng)}


def draw_weights(state: dict, data: np.ndarray, rng: np.random.Generator, fault: str = "") -> dict:
    prior = np.ones(3) if fault == "no prior" else ALPHA
    counts = (state["labels"][..., None] == np.arange(3)).sum(axis=1)
    gammas = rng.gamma(counts + prior)
    return state | {"weights": gammas / gammas.sum(axis=1, keepdims=True)}


def draw_means(state: dict, data: np.ndarray, rng: np.random.Generator, fault: str = "") -> dict:
    member = state["labels"][..., None] == np.arange(3)
    if fault == "off by one":  # each point is credited to its neighbour's category
        member = np.roll(member, 1, axis=1)
    precision = 1.0 + member.sum(axis=1)
    centre = (CENTRES + (member * data[..., None]).sum(axis=1)) / precision
    spread = 1 / precision if fault == "variance" else precision**-0.5
    return state | {"means": rng.normal(centre, spread)}


def sweep(*updates: Callable, fault: str = "") -> Callable:
    def kernel(state: dict, data: np.ndarray, rng: np.random.Generator) -> dict:
        for update in updates:
            state = update(state, data, rng, fault)
        return state

    return kernel


def mixture_kernel(fault: str = "") -> Callable:
    return sweep(draw_labels, draw_weights, draw_means, fault=fault)


def mixture_reverse(fault: str = "") -> Callable:
    return sweep(draw_means, draw_weights, draw_labels, fault=fault)


MIXTURE_STATISTICS = {
    "rare weight": lambda s, y: s["weights"][:, 0],
    "mean 0": lambda s, y: s["means"][:, 0],
    "square of mean 2": lambda s, y: s["means"][:, 2] ** 2,
    "members of 0": lambda s, y: (s["labels"] == 0).sum(axis=1),  # has ties
    "fit": lambda s, y: ((y - np.take_along_axis(s["means"], s["labels"], axis=1)) ** 2).sum(
        axis=1
    ),
}
MIXTURE = (mixture_prior, mixture_data)

NORMAL_FAULTS = ("no prior", "variance", "off by one", "no Hastings")
MIXTURE_FAULTS = ("no prior", "variance", "off by one", "category prior")


def names(result: Any) -> tuple[str, ...]:
    """Statistics that deviate."""
    return tuple(c.what.split(", rank ")[0] for c in result.rejected)


def assert_binomial(rejections: int, runs: int, alpha: float, low: bool = False) -> None:
    """No more rejections than chance allows at the rate alpha (once in 1e4), and not far fewer."""
    assert scipy.special.bdtrc(rejections - 1, runs, alpha) > 1e-4
    if low:
        assert scipy.special.bdtr(rejections, runs, alpha / 4) > 1e-4 and rejections > 0


# ---- Geweke ------------------------------------------------------------------------------------


def geweke(model: tuple, kernel: Callable, statistics: dict, seed: int = 0, **sizes: Any) -> Any:
    sizes = {"draws": 150, "chains": 64} | sizes
    return geweke_test(kernel, JointModel(*model, statistics), rng=seed, **sizes)


@pytest.mark.parametrize("fault", ["", *NORMAL_FAULTS])
def test_geweke_normal(fault: str) -> None:
    result = geweke(NORMAL, normal_kernel(fault), NORMAL_STATISTICS)
    assert bool(result) != bool(fault), result


@pytest.mark.parametrize("fault", ["", *MIXTURE_FAULTS])
def test_geweke_mixture(fault: str) -> None:
    result = geweke(MIXTURE, mixture_kernel(fault), MIXTURE_STATISTICS, draws=400)
    assert bool(result) != bool(fault), result


def test_geweke_false_alarms() -> None:
    """At alpha = 0.1 over 100 seeds; short chains, where effective sizes are known least."""
    runs, alpha = 100, 0.1
    results = [
        geweke(NORMAL, normal_kernel(), NORMAL_STATISTICS, seed, draws=40, chains=32, alpha=alpha)
        for seed in range(runs)
    ]
    assert_binomial(sum(not r for r in results), runs, alpha)
    # the same for single statistics, where Holm's caution does not hide an excess
    for name in NORMAL_STATISTICS:
        assert_binomial(sum(r.p_values[name] < alpha for r in results), runs, alpha)


def test_geweke_does_not_mind_a_sweep_without_its_reverse() -> None:
    """Invariance is all it asks for."""
    for kernel in (mixture_kernel(), mixture_reverse()):
        assert geweke(MIXTURE, kernel, MIXTURE_STATISTICS, seed=1)


def test_geweke_alarms_on_chains_that_stand_still() -> None:
    """A kernel that never moves is invariant; its chains count as one draw each, or there would be alarm."""
    runs, alpha = 200, 0.1
    statistics = {n: NORMAL_STATISTICS[n] for n in ("mean", "precision")}
    results = [
        geweke(NORMAL, lambda s, y, rng: s, statistics, seed, draws=20, alpha=alpha)
        for seed in range(runs)
    ]
    assert_binomial(sum(not r for r in results), runs, alpha)
    assert max(r.ess["mean"] for r in results) < 1.1 * 64


def test_geweke_constants() -> None:
    def kernel(state: dict, data: np.ndarray, rng: np.random.Generator) -> dict:
        return state | {"sign": -state["sign"]}

    def prior(rng: np.random.Generator, n: int) -> dict:
        return {"sign": np.ones(n)}

    model = (prior, lambda s, rng: s["sign"])
    statistics = {"size": lambda s, y: abs(s["sign"]), "sign": lambda s, y: s["sign"]}
    result = geweke(model, kernel, statistics, draws=11, chains=8)
    assert names(result) == ("sign",)
    assert result.p_values["size"] == 1.0
    assert result.p_values["sign"] < 1e-3


# ---- ranks -------------------------------------------------------------------------------------


def ranks(model: tuple, kernel: Callable, statistics: dict, seed: int = 0, **options: Any) -> Any:
    options = {"steps": 7, "replications": 1000, "alpha": 1e-3} | options
    return rank_test(kernel, JointModel(*model, statistics), rng=seed, **options)


@pytest.mark.parametrize("fault", ["", *NORMAL_FAULTS])
def test_ranks_normal(fault: str) -> None:
    reverse = normal_reverse(fault)
    result = ranks(NORMAL, normal_kernel(fault), NORMAL_STATISTICS, reverse=reverse)
    assert bool(result) != bool(fault), result


@pytest.mark.parametrize("fault", ["", *MIXTURE_FAULTS])
def test_ranks_mixture(fault: str) -> None:
    reverse = mixture_reverse(fault)
    result = ranks(MIXTURE, mixture_kernel(fault), MIXTURE_STATISTICS, reverse=reverse)
    assert bool(result) != bool(fault), result


def test_sweep_is_not_its_own_reverse() -> None:
    """The kernel is right, and its reverse is; taking it for its own reverse is the error. It is a small
    one, in statistics of blocks that the sweep draws apart, and takes many replications."""
    kernel, reverse, sizes = (
        mixture_kernel(),
        mixture_reverse(),
        {"replications": 20000, "steps": 3},
    )
    result = ranks(MIXTURE, kernel, MIXTURE_STATISTICS, **sizes)
    assert not result, result
    right = ranks(MIXTURE, kernel, MIXTURE_STATISTICS, **sizes, reverse=reverse)
    assert right, right


def test_rotation_needs_the_rotation_back() -> None:
    """A deterministic cycle of three keeps the uniform law, and nothing is less reversible."""
    model = (lambda rng, n: rng.integers(0, 3, n), lambda s, rng: None)
    statistics = {"state": lambda s, y: s}
    forward, back = (lambda s, y, rng, by=by: (s + by) % 3 for by in (1, -1))
    right = ranks(model, forward, statistics, steps=2, replications=200, reverse=back)
    assert right, right
    wrong = ranks(model, forward, statistics, steps=2, replications=200)
    assert names(wrong) == ("state",)


def test_symmetric_sweep_is_its_own_reverse() -> None:
    palindrome = sweep(draw_labels, draw_weights, draw_means, draw_weights, draw_labels)
    result = ranks(MIXTURE, palindrome, MIXTURE_STATISTICS, replications=2000, steps=4)
    assert result, result


def test_rank_false_alarms() -> None:
    """At alpha = 0.1 over 300 seeds, of all statistics together and of each; the test is exact, so there
    are not far fewer either."""
    runs, alpha = 300, 0.1
    results = [
        ranks(MIXTURE, mixture_kernel(), MIXTURE_STATISTICS, seed, steps=4, replications=60,
              alpha=alpha, reverse=mixture_reverse())
        for seed in range(runs)
    ]  # fmt: skip
    assert_binomial(sum(not r for r in results), runs, alpha, low=True)
    for name in MIXTURE_STATISTICS:
        assert_binomial(sum(r.p_values[name] < alpha for r in results), runs, alpha, low=True)


def independence(state: np.ndarray, data: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return rng.normal(size=len(state))


def plain(shift: float = 0.0) -> tuple:
    """A standard normal without data; the kernel draws anew, shifted by an error."""
    model = (lambda rng, n: rng.normal(size=n), lambda s, rng: None)
    return model, lambda s, y, rng: independence(s, y, rng) + shift


def test_sequential_false_alarms() -> None:
    """At alpha = 0.2 in up to 4 stages: each at its own level, all together at most alpha."""
    runs, alpha = 400, 0.2
    model, kernel = plain()
    statistics = {"x": lambda s, y: s, "|x|": lambda s, y: abs(s)}
    results = [
        ranks(model, kernel, statistics, seed, steps=4, replications=40, alpha=alpha, stages=4)
        for seed in range(runs)
    ]
    assert_binomial(sum(not r for r in results), runs, alpha, low=True)
    assert {r.stage for r in results} >= {1, 2}
    assert all(r.counts["x"].sum() == (40 if r.stage == 1 else 160) for r in results)
    level, doubt = alpha / 4, (alpha / 4) ** 0.25
    assert all(r.level == pytest.approx(level / doubt ** (r.stage - 1)) for r in results)


def test_sequential_finds_what_one_stage_leaves_in_doubt() -> None:
    """An error too small for the first stage at 1e-5 is found in most runs, mostly in a later stage; at a
    right kernel, the first stage is nearly always the last."""
    statistics = {"x": lambda s, y: s}
    options = {"steps": 4, "replications": 300, "alpha": 1e-5}
    model, wrong = plain(0.3)
    once = [ranks(model, wrong, statistics, s, **options) for s in range(20)]
    often = [ranks(model, wrong, statistics, s, **options, stages=7) for s in range(20)]
    assert sum(not r for r in once) + 4 < sum(not r for r in often)
    assert any(r.stage > 1 and not r for r in often)
    model, right = plain()
    calm = [ranks(model, right, statistics, s, **options, stages=7) for s in range(20)]
    assert not any(not r for r in calm)
    assert np.mean([r.stage for r in calm]) < 1.8


def test_ties_are_broken_at_random() -> None:
    """A statistic of two values has uniform ranks; breaking ties one way would pile them at one end."""
    model, kernel = plain()
    result = ranks(model, kernel, {"sign": lambda s, y: s > 0})
    assert result
    assert result.counts["sign"].min() > 50
    constant = ranks(model, kernel, {"zero": lambda s, y: 0 * s})
    assert constant.counts["zero"].min() > 50


def test_kernels_may_work_in_place() -> None:
    """A state that is overwritten, and statistics that are views of it, give the same as fresh arrays."""
    model, _ = plain()

    def fresh(state: np.ndarray, data: None, rng: np.random.Generator) -> np.ndarray:
        return 0.8 * state + rng.normal(0.0, 0.6, len(state))

    def in_place(state: np.ndarray, data: None, rng: np.random.Generator) -> np.ndarray:
        state[...] = fresh(state, data, rng)
        return state

    statistics = {"x": lambda s, y: s}
    found = [ranks(model, k, statistics).counts["x"] for k in (fresh, in_place)]
    np.testing.assert_array_equal(*found)
    means = [geweke(model, k, statistics).p_values["x"] for k in (fresh, in_place)]
    assert means[0] == means[1]


def test_geweke_on_chains_that_run_off() -> None:
    """An explosive chain is an error, and not an overflow."""
    model, _ = plain()
    result = geweke(model, lambda s, y, rng: 10.0 * s, {"x^2": lambda s, y: s * s})
    assert names(result) == ("x^2",)
    assert result.ess["x^2"] > 0


def test_thinning_applies_the_kernel_more_often() -> None:
    """Moves much smaller than the posterior's spread leave the first state's rank undisturbed."""
    calls = []

    def kernel(state: np.ndarray, data: None, rng: np.random.Generator) -> np.ndarray:
        calls.append(len(state))
        return state

    model, _ = plain()
    ranks(model, kernel, {"x": lambda s, y: s}, steps=3, thinning=5, replications=20)
    assert calls == [20] * (2 * 3 * 5)
    calls.clear()
    geweke(model, kernel, {"x": lambda s, y: s}, draws=10, thinning=3, chains=8)
    assert calls == [8] * (10 * 3)


# ---- both: results, seeds, errors ------------------------------------------------------------------


def test_same_seed_same_result() -> None:
    model, kernel = plain()
    statistics = {"x": lambda s, y: s}
    for test in (geweke, ranks):
        one, two, other = (test(model, kernel, statistics, seed) for seed in (3, 3, 4))
        assert one.p_values == two.p_values != other.p_values
        with pytest.raises(TypeError):
            one.p_values["x"] = 0.0


def test_results_print_the_least_likely_first() -> None:
    model, kernel = plain(1.0)
    statistics = {"good": lambda s, y: 0 * s, "bad": lambda s, y: s, "worse": lambda s, y: s + s}
    for test in (geweke, ranks):
        result = test(model, kernel, statistics)
        lines = repr(result).splitlines()
        assert "2 of 3 figures deviate (false-alarm rate 0.001)" in lines[0]
        figures = [line for line in lines[1:] if "standard errors" in line]
        assert {line.split()[0].rstrip(",:") for line in figures} == {"bad", "worse"}
        assert set(names(result)) == {"bad", "worse"}


def test_holm_lets_the_last_one_through_at_the_full_level() -> None:
    found = {"a": 0.01, "b": 0.04, "c": 0.02}
    planted = [Comparison(name, 0.0, 0.0, 1.0, p) for name, p in found.items()]
    for alpha, expected in ((0.05, ("a", "c", "b")), (0.035, ("a",)), (0.03, ())):
        assert names(GewekeResult("planted", alpha, planted)) == expected


@pytest.mark.parametrize("test", [geweke, ranks])
def test_statistics_at_fault_are_named(test: Callable) -> None:
    model, kernel = plain()
    with pytest.raises(ShapeError, match="'pair' returned shape"):
        test(model, kernel, {"pair": lambda s, y: np.stack([s, s], axis=-1)})
    with pytest.raises(ShapeError, match="'total' returned shape"):
        test(model, kernel, {"total": lambda s, y: s.sum()})
    with pytest.raises(DensityError, match="'log' is nan in row"):
        test(model, kernel, {"log": lambda s, y: np.where(s < 0, np.nan, s)})
    with pytest.raises(ValueError, match="statistics"):
        test(model, kernel, {})


@pytest.mark.parametrize(
    ("test", "option"),
    [
        (geweke, {"draws": 9}),
        (geweke, {"chains": 1}),
        (geweke, {"thinning": 0}),
        (ranks, {"steps": 0}),
        (ranks, {"replications": 2.5}),
        (ranks, {"stages": 0}),
        (ranks, {"growth": 0}),
        (ranks, {"alpha": 0.0}),
        (ranks, {"alpha": 1.0}),
    ],
)
def test_sizes_at_fault_are_named(test: Callable, option: dict) -> None:
    model, kernel = plain()
    with pytest.raises(ValueError, match=next(iter(option))):
        test(model, kernel, {"x": lambda s, y: s}, **option)
