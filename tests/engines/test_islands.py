"""Islands of particles: the plain filter where there is one, unbiased where there are more."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import DegeneracyError, UnsupportedError
from bayesmc.testing import session

pytestmark = pytest.mark.filterwarnings("ignore::bayesmc.errors.LowEssWarning")

ROWS = {"y": np.cumsum(np.random.default_rng(5).normal(size=24))}


def walk() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 1.0), initial=bmc.Normal(0.0, 2.0))
    dbn.add("y", lambda x: bmc.Normal(x, 0.7))
    return dbn


def evidence(islands: int, runs: int, seed: int, particles: int = 192) -> np.ndarray:
    """Estimates of the evidence of some rows over the exact one."""
    dbn, rows = walk(), {"y": ROWS["y"][:10]}
    exact = bmc.filter(dbn, rows, engine=bmc.KalmanFilter()).log_marginal_likelihood
    engine = bmc.IslandFilter(bmc.ParticleFilter(particles), islands=islands)
    seeds = np.random.SeedSequence(seed).spawn(runs)
    logs = [bmc.filter(dbn, rows, engine=engine, rng=s).log_marginal_likelihood for s in seeds]
    return np.exp(np.array(logs) - exact)


def test_one_island_is_the_plain_filter() -> None:
    cloud = bmc.ParticleFilter(500)
    plain = bmc.filter(walk(), ROWS, engine=cloud, rng=2)
    one = bmc.filter(walk(), ROWS, engine=bmc.IslandFilter(cloud, islands=1), rng=2)
    assert np.array_equal(plain.mean("x"), one.mean("x"))
    assert np.array_equal(plain.mcse("x"), one.mcse("x"))
    assert plain.log_marginal_likelihood == one.log_marginal_likelihood
    smoothed = bmc.smooth(walk(), ROWS, engine=bmc.IslandFilter(cloud, islands=1), rng=2)
    assert np.array_equal(
        smoothed.mean("x"), bmc.smooth(walk(), ROWS, engine=cloud, rng=2).mean("x")
    )


def check_unbiased(islands: int, runs: int) -> None:
    found = evidence(islands, runs, session.seed())
    assert abs(found.mean() - 1.0) < 4.5 * found.std(ddof=1) / np.sqrt(runs)


def test_evidence_is_unbiased() -> None:
    """A normal test of the mean of 40 estimates at 4.5 standard errors: one false alarm in 10^5 runs."""
    check_unbiased(4, 40)


@pytest.mark.thorough
@pytest.mark.parametrize("islands", [1, 4, 16])
def test_evidence_is_unbiased_to_two_per_cent(islands: int) -> None:
    check_unbiased(islands, 2000)


def test_a_mean_of_logs_is_found_to_be_biased(monkeypatch: pytest.MonkeyPatch) -> None:
    """A fault: islands put together by the mean of their logs; the test above sees it."""

    def of_logs(log: np.ndarray, axis: int | None = None) -> Any:
        return np.mean(log, axis=axis) + np.log(4)

    monkeypatch.setattr("bayesmc.engines.particles.island_answers.log_sum_exp", of_logs)
    found = evidence(4, 40, 3, particles=24)
    assert abs(found.mean() - 1.0) > 4.5 * found.std(ddof=1) / np.sqrt(40)


def test_answers_are_those_of_the_exact_filter() -> None:
    """Means within six of their stated errors (120 figures: a false alarm in ten million runs)."""
    exact = bmc.filter(walk(), ROWS, engine=bmc.KalmanFilter())
    engine = bmc.IslandFilter(bmc.ParticleFilter(8000), islands=4)
    found = bmc.filter(walk(), ROWS, engine=engine, rng=1, queries={"square": lambda x: x**2})
    off = np.abs(found.mean("x") - exact.mean("x"))
    assert (off < 6 * found.mcse("x")).all()
    assert found.var("x") == pytest.approx(exact.var("x"), rel=0.2)
    square = exact.var("x") + exact.mean("x") ** 2
    assert (np.abs(found.queries["square"] - square) < 6 * found.queries_mcse["square"]).all()
    assert found.counts.tolist() == [8000] * 24 and (found.weight_ess > 100).all()
    assert found.log_marginal_increments.sum() == pytest.approx(found.log_marginal_likelihood)


def test_states_and_angles_are_put_together() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.table("s", ["s_prev"], [[0.9, 0.1], [0.2, 0.8]], ("low", "high"), initial=[0.5, 0.5])
    dbn.add("a", lambda a_prev: bmc.VonMises(a_prev, 4.0), initial=bmc.VonMises(3.0, 1.0))
    dbn.add("y", lambda s: bmc.Normal(2.0 * (s == "high"), 1.0))
    dbn.add("z", lambda a: bmc.VonMises(a, 3.0))
    rows = {"y": np.array([0.1, 1.9, 2.2, 0.3]), "z": np.array([3.0, -3.0, 3.1, -3.1])}
    plain = bmc.filter(dbn, rows, engine=bmc.ParticleFilter(4000), rng=0)
    found = bmc.filter(dbn, rows, engine=bmc.IslandFilter(bmc.ParticleFilter(4000), 4), rng=1)
    assert found.probabilities("s") == pytest.approx(plain.probabilities("s"), abs=0.06)
    turned = np.angle(np.exp(1j * (found.mean("a") - plain.mean("a"))))
    assert np.abs(turned).max() < 0.1
    assert found.var("a") == pytest.approx(plain.var("a"), rel=0.25)


def test_how_rows_are_handed_out_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether islands exchange is decided row by row, however many rows they pass on their own."""
    engine = bmc.IslandFilter(bmc.ParticleFilter(160), islands=4)
    logs, after = [], []
    for first in (3, 16, 64):
        monkeypatch.setattr("bayesmc.engines.particles.islands._FIRST", first)
        found = bmc.filter(walk(), ROWS, engine=engine, rng=4)
        logs.append(found.log_marginal_increments)
        after.append(found.exchanged.tolist())
    assert after[0] == after[1] == after[2] and after[0]
    np.testing.assert_allclose(logs[0], logs[1], atol=1e-12)
    np.testing.assert_allclose(logs[0], logs[2], atol=1e-12)


def test_an_island_without_weight_is_replaced_and_all_without_are_an_error() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Uniform(x - 0.4, x + 0.4))
    rows = {"y": np.array([0.0, 0.5, 2.4, 2.0])}
    engine = bmc.IslandFilter(bmc.ParticleFilter(96), islands=8)
    found = bmc.filter(dbn, rows, engine=engine, rng=0)
    assert np.isfinite(found.log_marginal_likelihood) and found.exchanged.size
    with pytest.raises(DegeneracyError, match="slice 3") as caught:
        bmc.filter(dbn, {"y": np.array([0.0, 0.5, 1.0, 40.0])}, engine=engine, rng=0)
    assert caught.value.filtered.steps == 3


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        ((bmc.KalmanFilter(),), "give the particle filter"),
        ((bmc.ParticleFilter(100), 0), "1 or more"),
        ((bmc.ParticleFilter(100), 3), "do not make 3 equal islands"),
        ((bmc.ParticleFilter(), 4), "how many particles"),
        ((bmc.ParticleFilter(100), 4, 1.5), "a share of the islands"),
        ((bmc.ParticleFilter(100, delay=3), 4), "delay="),
    ],
)
def test_wrong_options_are_refused(arguments: Any, fault: str) -> None:
    with pytest.raises((TypeError, ValueError), match=fault):
        bmc.IslandFilter(*arguments)


def test_what_islands_cannot_do_is_refused() -> None:
    dbn = bmc.DynamicBayesNet(plates={"k": 3})
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0), plates="k")
    dbn.add("y", lambda x: bmc.Normal(x, 1.0), plates="k")
    engine = bmc.IslandFilter(bmc.ParticleFilter(100), islands=4)
    with pytest.raises(UnsupportedError, match="plate 'k' never meet"):
        bmc.filter(dbn, {"y": np.zeros((4, 3))}, engine=engine)
    with pytest.raises(UnsupportedError, match="does not smooth"):
        bmc.smooth(walk(), ROWS, engine=engine)
    with pytest.raises(UnsupportedError, match="keeps no particles"):
        bmc.filter(walk(), ROWS, engine=engine, keep="particles")
    assert "4 islands of 25 particles" in str(bmc.explain(walk(), ROWS, engine=engine))
