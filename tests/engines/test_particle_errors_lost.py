"""What a particle filter that has lost its way says of it: errors that are infinite, or large enough."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.engines.particles import genealogy, record
from bayesmc.engines.particles.rare_states import Scouting
from bayesmc.engines.particles.tracking import Compass, Sight
from bayesmc.errors import BayesmcWarning, LowEssWarning


def switch(stay: float, come: float, size: float = 4.0) -> bmc.DynamicBayesNet:
    """A rare switch that moves what is seen."""
    dbn = bmc.DynamicBayesNet()
    start = bmc.Bernoulli(come)
    dbn.add("s", lambda s_prev: bmc.Bernoulli(np.where(s_prev == 1, stay, come)), initial=start)
    dbn.add("y", lambda s: bmc.Normal(size * s, 1.0))
    return dbn


def three() -> bmc.DynamicBayesNet:
    """Two rare states among three; no single row says much."""
    step = np.array([[0.9996, 0.0002, 0.0002], [0.001, 0.999, 0.0], [0.001, 0.0, 0.999]])
    start = bmc.Categorical([0.999, 0.0005, 0.0005])
    dbn = bmc.DynamicBayesNet()
    dbn.add("s", lambda s_prev: bmc.Categorical(step[s_prev]), initial=start)
    dbn.add("y", lambda s: bmc.Normal(np.array([0.0, 2.0, -2.0])[s], 1.0))
    return dbn


def jumps() -> bmc.DynamicBayesNet:
    """A number that a rare switch throws far."""
    dbn = bmc.DynamicBayesNet()
    start = bmc.Bernoulli(0.001)
    dbn.add("s", lambda s_prev: bmc.Bernoulli(np.where(s_prev == 1, 0.5, 0.001)), initial=start)
    dbn.add(
        "x", lambda x_prev, s: bmc.Normal(0.9 * x_prev + 10 * s, 0.3), initial=bmc.Normal(0.0, 0.3)
    )
    dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    return dbn


def modes() -> bmc.DynamicBayesNet:
    """Two places that rows do not tell apart, and a filter stays in one of them."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.02), initial=bmc.Normal(0.0, 5.0))
    dbn.add("y", lambda x: bmc.Normal(x**2, 0.1))
    return dbn


LOST: dict[str, tuple[bmc.DynamicBayesNet, list[float], str, int, tuple[float, float] | None]] = {
    "first slice": (switch(0.9, 0.001), [4.5, 0.0, 0.0, 0.0], "s", 1000, None),
    "a later one": (switch(0.9, 0.001), [0.0, 0.3, 0.0, 4.5, 4.0, 0.0, 0.0, 0.0], "s", 1000, None),
    "it stays": (switch(0.9997, 0.0003), [0.0, 0.3, 0.0, *[4.0] * 3, *[0.0] * 5], "s", 300, None),
    "row by row": (three(), [0.0, 0.2, -0.3, *[2.2] * 6, 0.0, 0.0, 0.0], "s", 300, None),
    "jump": (jumps(), [0.0, 0.2, -0.1, 10.0, 9.0, 8.0, 7.0, 6.5, 6.0, 5.0], "x", 300, (-10.0, 30.0)),
    "two modes": (modes(), [9.0] * 40, "x", 300, (-20.0, 20.0)),
}  # fmt: skip


def filtered(dbn: bmc.DynamicBayesNet, rows: Any, engine: Any, **options: Any) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", BayesmcWarning)
        return bmc.filter(dbn, {"y": rows}, engine=engine, **options)


def beyond(kind: str) -> int:
    """Runs among eight in which a mean, a share or a query is more than five stated errors off."""
    dbn, rows, name, particles, span = LOST[kind]
    engine = None if span is None else bmc.GridFilter(grid={name: (*span, 4000)})
    right = filtered(dbn, rows, engine).mean(name)
    queries: Any = {"q": (lambda s: s * 1.0) if name == "s" else (lambda x: x)}
    count = 0
    for seed in range(8):
        found = filtered(dbn, rows, bmc.ParticleFilter(particles), rng=seed, queries=queries)
        off = np.abs(found.mean(name) - right)
        count += bool((off > 5 * np.minimum(found.mcse(name), found.queries_mcse["q"])).any())
    return count


@pytest.mark.parametrize("kind", LOST)
def test_means_of_a_filter_that_is_lost_claim_nothing(kind: str) -> None:
    """Five errors hold any figure of all slices, but once in 10,000 runs."""
    assert beyond(kind) == 0


@pytest.mark.parametrize("kind", ["a later one", "it stays", "two modes"])
def test_without_looking_means_claim_too_much(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The negative control."""
    monkeypatch.setattr(Sight, "after", lambda *given, **options: None)
    monkeypatch.setattr(Scouting, "after", lambda *given: None)
    assert beyond(kind) >= 3


def test_a_filter_that_can_find_back_says_when_it_has() -> None:
    """One row that next to no particle explains; the state forgets it."""
    dbn = bmc.DynamicBayesNet()
    start = bmc.Normal(0.0, 1.0)
    dbn.add("x", lambda x_prev: bmc.Normal(0.5 * x_prev, 1.0), initial=start)
    dbn.add("y", lambda x: bmc.Normal(x, 0.1))
    rows = np.zeros(60)
    rows[20] = 4.5
    found = filtered(dbn, rows, bmc.ParticleFilter(300), rng=0)
    right = filtered(dbn, rows, None)
    lost = np.isinf(found.mcse("x"))
    assert lost[20] and not lost[:20].any() and not lost[50:].any()
    off = np.abs(found.mean("x") - right.mean("x")) / found.mcse("x")
    assert (off < 5).all()


# ---- healthy filters ----------------------------------------------------------------------------


def walk(dbn: bmc.DynamicBayesNet) -> None:
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.3), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))


def heavy(dbn: bmc.DynamicBayesNet) -> None:
    dbn.add("x", lambda x_prev: bmc.StudentT(4.0, 0.9 * x_prev, 0.4), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 0.7))


def counts(dbn: bmc.DynamicBayesNet) -> None:
    dbn.add("x", lambda x_prev: bmc.Normal(0.95 * x_prev, 0.2), initial=bmc.Normal(0.0, 0.6))
    dbn.add("y", lambda x: bmc.Poisson(np.exp(1.0 + x)))


def volatility(dbn: bmc.DynamicBayesNet) -> None:
    dbn.add("x", lambda x_prev: bmc.Normal(0.95 * x_prev, 0.25), initial=bmc.Normal(0.0, 0.8))
    dbn.add("y", lambda x: bmc.Normal(0.0, np.exp(x / 2)))


def rare(dbn: bmc.DynamicBayesNet) -> None:
    start = bmc.Bernoulli(0.001)
    dbn.add("s", lambda s_prev: bmc.Bernoulli(np.where(s_prev == 1, 0.5, 0.001)), initial=start)
    dbn.add("y", lambda s: bmc.Normal(1.0 * s, 1.0))


@pytest.mark.parametrize("declare", [walk, heavy, counts, volatility, rare])
def test_healthy_filters_tell_their_error(declare: Callable[..., None]) -> None:
    """Of 20 runs, all but one are finite, and all but one within three errors, but once in 500 times."""
    dbn = bmc.DynamicBayesNet()
    declare(dbn)
    rows = np.asarray(dbn.sample(60, rng=1)["y"][0])
    engine = None if declare in (walk, rare) else bmc.GridFilter(grid={"x": (-8.0, 8.0, 800)})
    right = filtered(dbn, rows, engine)
    off, told = [], []
    for seed in range(20):
        found = filtered(dbn, rows, bmc.ParticleFilter(1000), rng=seed)
        error = found.log_marginal_likelihood_mcse
        off.append((found.log_marginal_likelihood - right.log_marginal_likelihood) / error)
        told.append(np.isfinite(error) and np.isfinite(found.mcse(found.names[0])).all())
    assert sum(told) >= 19
    assert (np.abs(off) > 3).sum() <= 1


def test_speeds_that_rows_reveal_are_no_accident() -> None:
    """Positions seen with noise: many families differ a little, and the error holds."""
    step, half = (
        np.array([[1.0, 0, 1, 0], [0, 1, 0, 1], [0, 0, 1, 0], [0, 0, 0, 1]]),
        0.5 * np.eye(2),
    )
    push = np.concatenate([half, np.eye(2)])
    noise = 0.09 * push @ push.T + 1e-6 * np.eye(4)
    dbn = bmc.DynamicBayesNet()
    start = bmc.MvNormal(np.zeros(4), np.diag([25.0, 25.0, 4.0, 4.0]))
    dbn.add("x", lambda x_prev: bmc.MvNormal(x_prev @ step.T, noise), initial=start)
    dbn.add("y", lambda x: bmc.MvNormal(x[..., :2], np.eye(2)))
    rows = np.asarray(dbn.sample(60, rng=1)["y"][0])[:30]
    right = filtered(dbn, rows, None).log_marginal_likelihood
    off = []
    for seed in range(6):
        found = filtered(dbn, rows, bmc.ParticleFilter(32_000), rng=seed)
        off.append((found.log_marginal_likelihood - right) / found.log_marginal_likelihood_mcse)
    assert np.count_nonzero(off) >= 4  # others cannot tell
    assert (np.abs(off) < 3).all()


def test_nodes_that_all_particles_share_now_and_then_do_not_matter() -> None:
    """One of them is seen in the first slice."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("a", lambda a_prev: bmc.Normal(0.9 * a_prev, 0.5), initial=bmc.Normal(0.0, 1.0))
    dbn.add("x", lambda x_prev, a: bmc.Normal(0.5 * x_prev + a, 0.5), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    rows = {"y": [0.1, 0.4, 0.2], "a": [0.3, np.nan, np.nan]}
    found = bmc.filter(dbn, rows, engine=bmc.ParticleFilter(300), rng=0)
    assert np.isfinite(found.log_marginal_likelihood_mcse)


# ---- rows that pull the same way ----------------------------------------------------------------


def shifted() -> tuple[bmc.DynamicBayesNet, np.ndarray]:
    """A level that moves once, by far more than next to all particles do."""
    dbn = bmc.DynamicBayesNet()

    def move(x_prev: Any) -> Any:
        return bmc.Mixture([0.99, 0.01], [bmc.Normal(x_prev, 0.1), bmc.Normal(x_prev, 2.0)])

    dbn.add("x", move, initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    return dbn, np.repeat([0.0, 2.0], 30) + np.random.default_rng(1).normal(size=60)


def small_errors() -> int:
    """Runs of 30 that are off by more than four finite errors."""
    dbn, rows = shifted()
    exact = filtered(dbn, rows, bmc.GridFilter(grid={"x": (-10.0, 10.0, 1001)}))
    count = 0
    for seed in range(30):
        found = filtered(dbn, rows, bmc.ParticleFilter(300), rng=seed)
        off = found.log_marginal_likelihood - exact.log_marginal_likelihood
        count += abs(off) > 4 * found.log_marginal_likelihood_mcse
    return count


def test_a_level_that_no_particle_has_followed_is_told() -> None:
    """Of a rate of 1 %, more than two come once in 300 times."""
    assert small_errors() <= 2


def test_without_looking_a_level_claims_too_much(monkeypatch: pytest.MonkeyPatch) -> None:
    """The negative control."""
    monkeypatch.setattr(Compass, "after", lambda self, drift, earlier, block: [None])
    monkeypatch.setattr(record, "TOGETHER", 1)
    monkeypatch.setattr(genealogy, "_at_edge", lambda *given: (np.array(False), np.array(False)))
    assert small_errors() > 2


def test_words_name_what_set_the_number_of_particles() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.01), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 0.05))
    rows = {"y": [0.0] * 14 + [2.0] + [0.0] * 15}
    with pytest.warns(LowEssWarning, match=r"100_000 that are tried at most.*400_000"):
        bmc.filter(dbn, rows, engine=bmc.ParticleFilter(), rng=0)
    with pytest.warns(LowEssWarning, match=r"a larger budget= than 300_000"):
        bmc.filter(dbn, rows, engine=bmc.ParticleFilter(budget=300_000), rng=0)


def test_a_look_at_the_row_is_paid_for() -> None:
    """Of the same budget, particles that look at the row are fewer."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(0.95 * x_prev, 0.3), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Poisson(np.exp(1.0 + x)))
    rows = np.asarray(dbn.sample(30, rng=0)["y"][0])
    options: dict[str, Any] = {"budget": 1_200_000, "tolerance": 0.01}
    plain = filtered(dbn, rows, bmc.ParticleFilter(**options), rng=0)
    guided = filtered(dbn, rows, bmc.ParticleFilter(**options, proposal="optimal"), rng=0)
    assert (plain.counts[0], guided.counts[0]) == (40_000, 2_000)
