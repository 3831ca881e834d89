"""Lags that slice 0 draws and later ones copy: the answers of a point mass, and of a node before slice 0."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import ModelError, UnsupportedError

Y = np.array([0.3, -1.2, np.nan, 2.0, 2.4, 1.1, -0.4])
STATES = ("low", "middle", "high")


def waves(form: str) -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()

    @dbn.node(initial=bmc.Normal(0.5, 2.0))
    def x(x_prev: Any, x_lag_prev: Any) -> Any:
        return bmc.Normal(1.3 * x_prev - 0.6 * x_lag_prev, 0.8)

    start = bmc.Normal(-1.0, 2.0)
    if form == "lag":
        dbn.add("x_lag", lambda x_prev: x_prev, initial=start)
    elif form == "point":
        dbn.add("x_lag", lambda x_prev: bmc.Normal(x_prev, 0.0), initial=start)
    else:
        dbn.add("before", start)
        dbn.add("x_lag", lambda x_prev: x_prev, initial=lambda before: before)
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    return dbn


def plated(form: str) -> bmc.DynamicBayesNet:
    """Vectors in a plate, whose lag starts by what slice 0 holds."""
    dbn = bmc.DynamicBayesNet(plates={"k": 2})
    wide = 2.0 * np.eye(2)
    dbn.add("x", lambda x_prev: bmc.MvNormal(0.9 * x_prev, np.eye(2)), plates="k",
            initial=bmc.MvNormal(np.zeros(2), np.eye(2)))  # fmt: skip
    later: Callable[..., Any] = lambda x_prev: x_prev  # noqa: E731
    if form == "point":
        later = lambda x_prev: bmc.MvNormal(x_prev, np.zeros((2, 2)))  # noqa: E731
    dbn.add("x_lag", later, initial=lambda x: bmc.MvNormal(0.5 * x, wide), plates="k")
    dbn.add("y", lambda x, x_lag: bmc.MvNormal(x + 0.5 * x_lag, np.eye(2)), plates="k")
    return dbn


def regimes(form: str, labels: bool) -> bmc.DynamicBayesNet:
    """States, with labels or as 0, 1, 2, and where the last one was."""
    dbn = bmc.DynamicBayesNet()
    names = STATES if labels else (0, 1, 2)
    states = STATES if labels else None
    rows = [[0.8, 0.1, 0.1], [0.2, 0.7, 0.1], [0.1, 0.3, 0.6]]
    dbn.table("s", ["s_prev"], rows, states, initial=[0.2, 0.3, 0.5])

    def one(value: Any) -> Any:
        return bmc.Categorical(np.stack([1.0 * (value == name) for name in names], axis=-1))

    start = [0.5, 0.2, 0.3]
    if form == "lag":
        dbn.add("s_lag", lambda s_prev: s_prev, states=states, initial=start)
    elif form == "point":
        dbn.add("s_lag", one, ["s_prev"], states=states, initial=start)
    dbn.add("y", lambda s, s_lag: bmc.Normal(
        1.0 * (s == names[1]) + 2.0 * (s == names[2]) + 0.5 * (s_lag == names[2]), 0.7))  # fmt: skip
    return dbn


@pytest.mark.parametrize(
    "engine", [None, bmc.KalmanFilter(), bmc.ExtendedKalmanFilter(), bmc.UnscentedKalmanFilter()]
)
def test_gaussian_filters_tell_a_lag_by_chance(engine: Any) -> None:
    answers = []
    for form in ("lag", "point", "before"):
        dbn, rows = waves(form), {"y": Y}
        filtered = bmc.filter(dbn, rows, engine=engine)
        smoothed = bmc.smooth(dbn, rows, engine=engine)
        ahead = bmc.forecast(dbn, rows, steps=2, engine=engine)
        parts = [filtered.mean("x"), filtered.log_marginal_likelihood, smoothed.mean("x_lag")]
        answers.append([*parts, smoothed.std("x_lag"), ahead.mean("y"), ahead.std("x_lag")])
    for other in answers[1:]:
        for a, b in zip(answers[0], other, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-9)
    np.testing.assert_allclose(answers[0][2][1:], bmc.smooth(waves("lag"), {"y": Y}).mean("x")[:-1])


def test_unrolled_chains_and_exact_nets_agree_with_filters() -> None:
    smoothed = bmc.smooth(waves("lag"), {"y": Y})
    exact = bmc.infer(waves("lag"), {"y": Y}, engine=bmc.Exact())
    np.testing.assert_allclose(exact.mean("x_lag"), smoothed.mean("x_lag"), atol=1e-9)
    drawn = bmc.infer(waves("lag"), {"y": Y}, engine=bmc.Gibbs(draws=400, warmup=50), rng=0)
    # six standard errors: by chance at most once in 10^7 runs of these numbers
    assert (abs(drawn.mean("x_lag") - smoothed.mean("x_lag")) < 6 * drawn.mcse("x_lag")).all()
    explained = bmc.explain(waves("lag"), {"y": Y}, engine=bmc.HamiltonianMonteCarlo())
    assert "NUTS" in str(explained) or "Hamilton" in str(explained)


def test_vectors_and_plates_are_copied_too() -> None:
    rows = {"y": plated("lag").sample(5, rng=0)["y"][0]}
    one, other = (bmc.smooth(plated(form), rows) for form in ("lag", "point"))
    np.testing.assert_allclose(one.mean("x_lag"), other.mean("x_lag"), atol=1e-9)
    np.testing.assert_allclose(one.mean("x_lag")[1:], one.mean("x")[:-1], atol=1e-9)


@pytest.mark.parametrize("labels", [True, False])
def test_finite_lags_are_one_state_for_certain(labels: bool) -> None:
    rows = {"y": [0.1, 1.2, None, 2.6, 2.4]}
    lag, point = regimes("lag", labels), regimes("point", labels)
    for engine in (None, bmc.DiscreteFilter(), bmc.GridFilter(), bmc.ParticleFilter(200)):
        found = [bmc.smooth(d, rows, engine=engine, rng=1) for d in (lag, point)]
        a, b = (each.probabilities("s_lag") for each in found)
        np.testing.assert_allclose(a, b, atol=1e-12)
    exact = bmc.smooth(lag, rows)
    np.testing.assert_allclose(exact.probabilities("s_lag")[1:], exact.probabilities("s")[:-1])
    assert bmc.most_likely(lag, rows)["s_lag"][1:].tolist() == (
        bmc.most_likely(lag, rows)["s"][:-1].tolist()
    )
    for engine in (bmc.Exact(), bmc.Gibbs(draws=600, warmup=50)):
        drawn = bmc.infer(lag, rows, engine=engine, rng=2)
        # an indicator's error at 600 draws and next to no autocorrelation is at most 0.011
        found = drawn.probabilities("s_lag") - exact.probabilities("s_lag")
        assert np.abs(found).max() < 0.1


def test_particles_carry_a_lag_and_say_how_they_smooth_it() -> None:
    dbn, point, engine = waves("lag"), waves("point"), bmc.ParticleFilter(200)
    one, other = (bmc.filter(d, {"y": Y}, engine=engine, rng=3) for d in (dbn, point))
    np.testing.assert_array_equal(one.mean("x_lag"), other.mean("x_lag"))
    lagged = bmc.smooth(dbn, {"y": Y}, engine=engine, rng=3, lag=2)
    assert np.isfinite(lagged.mean("x_lag")).all()
    for ask in (
        lambda: bmc.smooth(dbn, {"y": Y}, engine=engine, rng=3),
        lambda: bmc.filter(
            dbn, {"y": Y}, engine=bmc.GridFilter({"x": (-9, 9, 9), "x_lag": (-9, 9, 9)})
        ),
    ):
        with pytest.raises(UnsupportedError, match=r"dbn.add\('x_lag_before'"):
            ask()
    smoothed = bmc.smooth(waves("before"), {"y": Y}, engine=engine, rng=3)
    np.testing.assert_array_equal(smoothed.particles("x_lag")[1:], smoothed.particles("x")[:-1])


def test_bits_and_counts() -> None:
    def added(later: Any, initial: Any) -> bmc.DynamicBayesNet:
        dbn = bmc.DynamicBayesNet()
        dbn.add("s", lambda s_prev: bmc.Bernoulli(0.2 + 0.6 * s_prev), initial=bmc.Bernoulli(0.5))
        dbn.add("n", bmc.Poisson(3.0))
        dbn.add("l", later, initial=initial)
        dbn.add("y", lambda s, lag: bmc.Normal(s + lag, 1.0), ["s", "l"])
        return dbn

    rows = {"y": [0.2, 1.9, 1.3]}
    one = bmc.filter(added(lambda s_prev: s_prev, lambda s: bmc.Bernoulli(0.3 + 0.4 * s)), rows)
    wanted = added(
        lambda s_prev: bmc.Bernoulli(1.0 * s_prev), lambda s: bmc.Bernoulli(0.3 + 0.4 * s)
    )
    np.testing.assert_allclose(one.mean("l"), bmc.filter(wanted, rows).mean("l"))
    counts = added(lambda n_prev: n_prev, bmc.Poisson(3.0))
    kept = bmc.filter(counts, rows, engine=bmc.ParticleFilter(300), rng=0, keep="particles")
    assert (np.sort(np.unique(kept.particles("l")[1])) % 1 == 0).all()
    draws = counts.sample(3, draws=5, rng=0)
    np.testing.assert_array_equal(draws["l"][:, 1:], draws["n"][:, :-1])


def test_what_cannot_be_certain_is_refused_by_name() -> None:
    def asked(later: Any, initial: Any, **options: Any) -> Callable[[], Any]:
        dbn = bmc.DynamicBayesNet()
        dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
        dbn.add("c", bmc.Categorical([0.2, 0.3, 0.5]))
        dbn.add("w", bmc.WrappedNormal(0.0, 1.0))
        dbn.add("l", later, initial=initial, **options)
        return dbn.validate

    cases: list[tuple[Callable[[], Any], str]] = [
        (asked(lambda w_prev: w_prev, bmc.WrappedNormal(0.0, 1.0)), "circle"),
        (asked(lambda c_prev: c_prev, bmc.DiscreteUniform(1, 3)), r"numbers 1\.\.3"),
        (asked(lambda c_prev: c_prev, bmc.Bernoulli(0.5)), "2 is none of the 2 states"),
        (asked(lambda c_prev: c_prev + 1, [0.2, 0.2, 0.6]), "3 is none of the 3 states"),
        (asked(lambda x_prev: x_prev, bmc.Bernoulli(0.5)), "a state, the other a number"),
        (asked(lambda x_prev: x_prev, bmc.Poisson(2.0)), "whole number"),
        (asked(lambda x_prev: x_prev, bmc.MvNormal(np.zeros(2), np.eye(2))), "shapes"),
    ]
    for ask, message in cases:
        with pytest.raises(ModelError, match=rf"node 'l': .*{message}.*l_before"):
            ask()


def test_parameters_are_fitted_behind_a_lag() -> None:
    rows = {"y": waves("lag").sample(40, rng=1)["y"][0]}
    found = []
    for form in ("lag", "point"):
        dbn = waves(form)
        dbn.add_static("r", bmc.HalfNormal(3.0))
        dbn.add("y", lambda x, r: bmc.Normal(x, r), replace=True)
        found.append(bmc.fit(dbn, rows, restarts=1))
    assert found[0].log_likelihood == pytest.approx(found[1].log_likelihood, abs=1e-8)
    assert found[0].converged


def test_switching_filters_carry_both_kinds_of_lag() -> None:
    def modes(form: str) -> bmc.DynamicBayesNet:
        lag = form == "lag"
        dbn = bmc.DynamicBayesNet()
        dbn.add("s", lambda s_prev: bmc.Bernoulli(0.1 + 0.8 * s_prev), initial=bmc.Bernoulli(0.5))
        copy = (lambda s_prev: s_prev) if lag else lambda s_prev: bmc.Bernoulli(1.0 * s_prev)
        dbn.add("s_lag", copy, initial=bmc.Bernoulli(0.3))

        @dbn.node(initial=bmc.Normal(0.0, 1.0))
        def x(x_prev: Any, x_lag_prev: Any, s: Any, s_lag: Any) -> Any:
            return bmc.Normal(1.1 * x_prev - 0.3 * x_lag_prev + s - 0.5 * s_lag, 0.5)

        same = (lambda x_prev: x_prev) if lag else lambda x_prev: bmc.Normal(x_prev, 0.0)
        dbn.add("x_lag", same, initial=bmc.Normal(0.0, 1.0))
        dbn.add("y", lambda x: bmc.Normal(x, 0.5))
        return dbn

    rows = {"y": [0.1, 0.9, 2.2, 2.0]}
    for engine in (None, bmc.SwitchingKalmanFilter()):
        one, other = (bmc.filter(modes(form), rows, engine=engine) for form in ("lag", "point"))
        np.testing.assert_allclose(one.mean("x_lag"), other.mean("x_lag"), atol=1e-9)
        np.testing.assert_allclose(one.mean("s_lag"), other.mean("s_lag"), atol=1e-9)
        assert one.log_marginal_likelihood == pytest.approx(other.log_marginal_likelihood)
    exact = bmc.infer(modes("lag"), rows, engine=bmc.Exact())
    assert exact.log_marginal_likelihood == pytest.approx(one.log_marginal_likelihood, abs=0.05)
