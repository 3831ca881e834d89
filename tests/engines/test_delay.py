"""``ParticleFilter(delay=)`` and fixed lags of what is integrated out, against exact fixed-lag answers.

Comparisons that chance has a part in have a false-alarm rate of 1e-3 or less, at fixed seeds.
"""

from __future__ import annotations

import gc
import pickle
import tracemalloc
import warnings
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import (
    BudgetError,
    InterruptWarning,
    LowEssWarning,
    ModelError,
    QueryError,
    UnsupportedError,
)
from bayesmc.testing import exact, repeated_test, session
from bayesmc.testing.makers.linear_dbns import random_linear_dbn
from bayesmc.testing.makers.switching_dbns import random_switching_dbn
from tests.engines.test_marginal import ROWS, off, switching
from tests.stated import stated_errors_test

OPTIONS: list[dict[str, Any]] = [
    {},
    {"marginalize": "auto"},
    {"marginalize": "auto", "proposal": "optimal"},
]
Y = [0.3, 1.2, 3.0, 2.5, np.nan, 1.0]


def up_to(rows: dict[str, Any], t: int, static: Any = ()) -> dict[str, Any]:
    return {n: v if n in static else v[: t + 1] for n, v in rows.items()}


def moments(found: Any, t: int) -> dict[str, np.ndarray]:
    """Of the switching level: first and second moments, and the regime."""
    mean = found.mean("x")[t]
    return {
        "x": mean,
        "square": found.var("x")[t] + mean**2,
        "s": found.probabilities("s")[t],
    }


# ---- where nothing is sampled -------------------------------------------------------------------


def test_without_sampled_nodes_fixed_lags_are_those_of_the_kalman_smoother() -> None:
    """Plates apart, vectors, computed lags, inputs, rows seen in part, noise that is none: to rounding."""
    for seed in range(session.scaled(6, 6)):
        case = random_linear_dbn(seed)
        given: dict[str, Any] = {"inputs": case.inputs or None}
        for lag in (1, 4):
            right = bmc.smooth(
                case.dbn, case.observations, engine=bmc.KalmanFilter(), lag=lag, **given
            )
            engine = bmc.ParticleFilter(3, marginalize="auto", delay=lag)
            found = bmc.filter(case.dbn, case.observations, engine=engine, **given)
            for name in set(case.hidden) & set(right.names):
                assert off(found.mean(name), right.mean(name)) < 1e-9, (seed, lag, name)
                assert off(found.var(name), right.var(name)) < 1e-9, (seed, lag, name)


def test_a_vague_start_loses_no_digits() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1e7))
    dbn.add("y", lambda x: bmc.Normal(x, 1e-3))
    rows = {"y": [np.nan, 3.0, 4.0, 5.0]}
    engine = bmc.ParticleFilter(2, marginalize="auto", delay=3)
    found = bmc.filter(dbn, rows, engine=engine)
    right = bmc.smooth(dbn, rows, engine=bmc.KalmanFilter())
    np.testing.assert_allclose(found.mean("x"), right.mean("x"), rtol=1e-9)
    np.testing.assert_allclose(found.std("x"), right.std("x"), rtol=1e-9)


# ---- against exact answers ----------------------------------------------------------------------


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_every_slice_is_given_the_rows_up_to_so_many_later(options: dict[str, Any]) -> None:
    """Figures times estimated over exact evidence of these rows, which have no bias."""
    dbn, delay = switching(), 2
    last = [min(t + delay, len(Y) - 1) for t in range(len(Y))]
    right = [exact(dbn, up_to(ROWS, k)) for k in last]
    engine = bmc.ParticleFilter(300, delay=delay, **options)

    def estimate(rng: np.random.Generator) -> dict[str, Any]:
        found = bmc.filter(dbn, ROWS, engine=engine, rng=rng)
        logs = np.cumsum(found.log_marginal_increments)
        return {
            f"{name} {t}": np.exp(logs[k] - right[t].log_marginal_likelihood) * figure
            for t, k in enumerate(last)
            for name, figure in moments(found, t).items()
        }

    truth = {
        f"{name} {t}": figure
        for t in range(len(Y))
        for name, figure in moments(right[t], t).items()
    }
    runs = session.scaled(15, 12)
    assert repeated_test(estimate, truth, replications=runs, alpha=1e-3, rng=1)


@pytest.mark.parametrize("proposal", [None, "optimal"])
def test_random_templates_under_holm(proposal: str | None) -> None:
    """Plates, several finite nodes, inputs: the last slice but one, one row late, and fixed lags alike."""
    engine = bmc.ParticleFilter(150, marginalize="auto", proposal=proposal, delay=1)
    asked = 0
    for seed in range(33, 33 + session.scaled(1, 16)):
        case = random_switching_dbn(seed)
        try:
            right = exact(case.dbn, case.observations, case.inputs or None)
        except (UnsupportedError, BudgetError):
            continue
        log = right.log_marginal_likelihood - right.log_static
        finite = {n for n in case.hidden if case.dbn[n].is_discrete}
        given: dict[str, Any] = {"inputs": case.inputs or None}

        def figures(answer: Any, finite: Any = finite, names: Any = case.hidden) -> dict[str, Any]:
            of = {n: answer.probabilities if n in finite else answer.mean for n in names}
            return {n: figure(n)[-2] for n, figure in of.items()}

        def estimate(
            rng: Any, case: Any = case, log: Any = log, given: Any = given, figures: Any = figures
        ) -> dict[str, Any]:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", LowEssWarning)
                found = bmc.filter(case.dbn, case.observations, engine=engine, rng=rng, **given)
            ratio = np.exp(np.sum(found.log_marginal_likelihood) - log)
            return {n: ratio * f for n, f in figures(found).items()}

        truth = {n: np.asarray(f) for n, f in figures(right).items()}
        verdict = repeated_test(estimate, truth, replications=25, alpha=1e-3, rng=[seed, 2])
        assert verdict, (seed, verdict)
        asked += 1
    assert asked >= session.scaled(1, 8)


def test_elements_that_are_filtered_apart_have_ancestors_and_beliefs_of_their_own() -> None:
    """Each element alone, by the exact answer of its own rows."""
    dbn = bmc.DynamicBayesNet(plates={"i": 2})
    dbn.table("s", ["s_prev"], [[0.9, 0.1], [0.2, 0.8]], initial=[0.5, 0.5], plates="i")
    dbn.add(
        "x",
        lambda x_prev, s: bmc.Normal(0.9 * x_prev + s, np.where(s == 1, 2.0, 0.3)),
        initial=bmc.Normal(0.0, 1.0),
        plates="i",
    )
    dbn.add("y", lambda x: bmc.Normal(x, 0.5), plates="i")
    rows = np.array([[0.3, 1.2, 3.0, 2.5], [0.0, -0.4, 1.9, 3.4]]).T
    right = [exact(switching(), {"y": rows[:, i]}) for i in range(2)]
    engine = bmc.ParticleFilter(200, marginalize="auto", delay=3, ess_threshold=2.0)

    def estimate(rng: np.random.Generator) -> dict[str, Any]:
        found = bmc.filter(dbn, {"y": rows}, engine=engine, rng=rng)
        logs = [r.log_marginal_likelihood for r in right]
        ratio = np.exp(found.log_marginal_increments.sum(axis=0) - logs)
        return {name: ratio[:, None] * f.reshape(2, -1) for name, f in moments(found, 1).items()}

    each = [moments(r, 1) for r in right]
    truth = {n: np.stack([np.reshape(e[n], -1) for e in each]) for n in each[0]}
    assert repeated_test(estimate, truth, replications=40, alpha=1e-3, rng=3)


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_errors_are_those_that_runs_have(options: dict[str, Any]) -> None:
    """Means of all slices but the last against their stated errors."""
    dbn, delay = switching(), 2
    last = [min(t + delay, len(Y) - 1) for t in range(len(Y))]
    each = [exact(dbn, up_to(ROWS, k)) for k in last]
    right = {
        "x": np.array([r.mean("x")[t] for t, r in enumerate(each)]),
        "s": np.array([r.mean("s")[t] for t, r in enumerate(each)]),
    }
    engine = bmc.ParticleFilter(500, delay=delay, **options)
    assert stated_errors_test(
        lambda seed: bmc.filter(dbn, ROWS, engine=engine, rng=seed),
        each[-1].log_marginal_likelihood,
        right,
        lambda found: {n: (found.mean(n), found.mcse(n)) for n in right},
        runs=session.scaled(20, 8), alpha=1e-3, rng=5,
    )  # fmt: skip


def test_shares_that_few_ancestors_have_are_not_told_as_if_they_had_many() -> None:
    """A regime that next to no ancestor has: errors beyond six stated ones are none by chance."""
    right = exact(switching(), up_to(ROWS, 4)).mean("s")[2]
    engine = bmc.ParticleFilter(500, delay=2)
    for seed in range(session.scaled(30, 8)):
        found = bmc.filter(switching(), ROWS, engine=engine, rng=seed)
        assert abs(found.mean("s")[2] - right) < 6 * found.mcse("s")[2], seed


# ---- one row after the other --------------------------------------------------------------------


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_beliefs_answer_as_late_and_as_a_series_does(options: dict[str, Any]) -> None:
    """To the bit, through a pickle; ``back`` answers for every slice that is held."""
    dbn, delay = switching(), 2
    engine = bmc.ParticleFilter(50, delay=delay, **options)

    def asked(x: np.ndarray, s: np.ndarray) -> np.ndarray:
        return x * (s == 1)

    found = bmc.filter(dbn, ROWS, engine=engine, rng=3, keep="particles", queries={"q": asked})
    belief = engine.start(dbn, rng=3)
    assert belief.about == -1
    for t, y in enumerate(Y):
        belief = engine.step(belief, {"y": y})
        assert (belief.t, belief.about) == (t, max(t - delay, 0))
        if t == 3:
            belief = engine.start(dbn, belief=pickle.loads(pickle.dumps(belief)))
        if t >= delay:
            at = belief.about
            assert np.array_equal(belief.mean("x"), found.mean("x")[at])
            assert np.array_equal(belief.var("x"), found.var("x")[at])
            assert np.array_equal(belief.mcse("x"), found.mcse("x")[at])
            assert np.array_equal(belief.probabilities("s"), found.probabilities("s")[at])
            assert belief.expectation(asked) == pytest.approx(found.queries["q"][at], rel=1e-12)
            assert np.array_equal(belief.particles("s"), found.particles("s")[at])
    for slices in range(delay + 1):
        own = belief.back(slices)
        assert own.about == 5 - slices
        assert np.array_equal(own.mean("x"), found.mean("x")[5 - slices])
    with pytest.raises(QueryError, match="3 slices, 0 to 2 back"):
        belief.back(3)
    assert "about=3" in repr(belief)


def test_a_longer_delay_after_a_pickle_begins_with_what_is_held() -> None:
    short, long = (bmc.ParticleFilter(20, marginalize="auto", delay=d) for d in (None, 3))
    belief = short.step(short.start(switching(), rng=0), {"y": 0.3})
    belief = long.start(switching(), belief=pickle.loads(pickle.dumps(belief)))
    for y in (1.2, 3.0, 2.5, 1.0):
        belief = long.step(belief, {"y": y})
        assert np.isfinite(belief.mean("x"))
    assert belief.about == 1


def test_particles_that_are_kept_are_trajectories() -> None:
    """Ancestors lead from a slice's particles to those of the slice before, to the end of the series."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("b", bmc.Normal(0.0, 1.0))
    dbn.add("before", lambda x_prev: x_prev, initial=lambda b: b)
    dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    engine = bmc.ParticleFilter(40, delay=2, ess_threshold=2.0)
    found = bmc.filter(dbn, {"y": Y}, engine=engine, rng=0, keep="particles")
    x, before, ancestors = found.particles("x"), found.particles("before"), found.ancestors
    for t in range(1, len(Y)):
        assert np.array_equal(before[t], x[t - 1][ancestors[t]])


# ---- the rest -----------------------------------------------------------------------------------


def test_smooth_with_a_lag_gives_the_same_answers() -> None:
    for options in OPTIONS:
        late = bmc.ParticleFilter(100, delay=3, **options)
        plain = bmc.ParticleFilter(100, **options)
        found = bmc.filter(switching(), ROWS, engine=late, rng=2)
        lagged = bmc.smooth(switching(), ROWS, engine=plain, rng=2, lag=3)
        assert np.array_equal(found.mean("x"), lagged.mean("x"))
        assert np.array_equal(found.probabilities("s"), lagged.probabilities("s"))
        now = bmc.filter(switching(), ROWS, engine=plain, rng=2)
        np.testing.assert_allclose(
            found.log_marginal_increments, now.log_marginal_increments, rtol=1e-10
        )
        assert np.abs(found.mean("x")[:4] - now.mean("x")[:4]).max() > 0.01


def test_forecasts_look_at_no_row_that_is_not_there() -> None:
    for options in OPTIONS:
        given: dict[str, Any] = {"steps": 2, "rng": 2}
        late = bmc.forecast(
            switching(), ROWS, engine=bmc.ParticleFilter(100, delay=3, **options), **given
        )
        plain = bmc.forecast(switching(), ROWS, engine=bmc.ParticleFilter(100, **options), **given)
        np.testing.assert_allclose(late.mean("x"), plain.mean("x"), rtol=0.3)


def test_explain_says_how_far_answers_look() -> None:
    engine = bmc.ParticleFilter(10, marginalize="auto", delay=1)
    assert "answers look one row ahead" in bmc.explain(switching(), ROWS, engine=engine).effort
    assert "delay=1 is of filter" in str(
        bmc.explain(switching(), ROWS, engine=engine, question="smooth")
    )
    for lag in (None, 2):
        with pytest.raises(UnsupportedError, match="delay=1 is of filter"):
            bmc.smooth(switching(), ROWS, engine=engine, lag=lag)


def test_no_delay_is_none() -> None:
    assert bmc.ParticleFilter(10, delay=0) == bmc.ParticleFilter(10)
    for wrong in (-1, True, 1.5, "2"):
        with pytest.raises(ValueError, match="a number of rows"):
            bmc.ParticleFilter(10, delay=wrong)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="no machine code"):
        bmc.ParticleFilter(10, delay=1, compiled=True)
    with pytest.raises(ValueError, match="adapt= lets their"):
        bmc.ParticleFilter(10, delay=1, adapt=bmc.KLD({"x": 0.5}))


@pytest.mark.parametrize("error", [ModelError, KeyboardInterrupt])
def test_slices_that_were_done_are_answered_where_it_ends_early(
    error: type[BaseException],
) -> None:
    """The last ones by what there was."""

    def seen(x: Any, clock: Any) -> Any:
        if np.ravel(clock)[0] == 4:
            raise error
        return bmc.Normal(x, 0.5)

    dbn = bmc.DynamicBayesNet()
    dbn.input("clock")
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", seen)
    given: dict[str, Any] = {
        "engine": bmc.ParticleFilter(50, delay=2, compiled=False),
        "rng": 0,
    }
    right = bmc.filter(dbn, {"y": Y[:4]}, inputs={"clock": np.arange(4.0)}, **given)
    asked: dict[str, Any] = {"inputs": {"clock": np.arange(6.0)}, **given}
    if error is KeyboardInterrupt:
        with pytest.warns(InterruptWarning):
            found = bmc.filter(dbn, {"y": Y}, **asked)
    else:
        with pytest.raises(error) as stopped:
            bmc.filter(dbn, {"y": Y}, **asked)
        found = stopped.value.filtered  # type: ignore[attr-defined]
    assert found.steps == 4
    assert np.array_equal(found.mean("x"), right.mean("x"))


def test_long_series_hold_answers_alone() -> None:
    """Bytes per slice: answers and figures are some hundred, in arrays of their own 2,300."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    engine = bmc.ParticleFilter(20, delay=2)
    bmc.filter(dbn, {"y": np.zeros(5)}, engine=engine, rng=0)
    tracemalloc.start()
    peaks = []
    for steps in (105, 605):
        gc.collect()
        tracemalloc.reset_peak()
        before = tracemalloc.get_traced_memory()[0]
        bmc.filter(dbn, {"y": np.zeros(steps)}, engine=engine, rng=0)
        peaks.append(tracemalloc.get_traced_memory()[1] - before)
    tracemalloc.stop()
    assert (peaks[1] - peaks[0]) / 500 < 1500
