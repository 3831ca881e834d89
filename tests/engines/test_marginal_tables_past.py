"""Tables that particles carry, asked about slices before: ``smooth``, ``lag=``, ``delay=``; exact answers.

Comparisons have a false-alarm rate of 1e-3 each (``repeated_test``), at fixed seeds; planted faults are seen.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import UnsupportedError
from bayesmc.testing import Verdict, exact, repeated_test, session
from tests.engines.test_marginal_tables import ring
from tests.mutants.faults import Edit, planted

Answers = Callable[[], tuple[bmc.DynamicBayesNet, dict[str, Any], bmc.ParticleFilter]]


def colours() -> tuple[bmc.DynamicBayesNet, dict[str, Any], bmc.ParticleFilter]:
    """Cells that change, of which one is seen by a sampled place."""
    rows = {"reading": [1, 0, 1, 0, 0]}
    return ring(2, 0.2), rows, bmc.ParticleFilter(300, marginalize=["color"])


def by_the_last_place() -> tuple[bmc.DynamicBayesNet, dict[str, Any], bmc.ParticleFilter]:
    """What is said of the tables depends on the sampled node of the slice before, and its move does."""
    dbn = bmc.DynamicBayesNet()
    dbn.table("u", ["u_prev"], [[0.8, 0.2], [0.3, 0.7]], initial=[0.6, 0.4])
    follow = np.array([[[0.9, 0.1], [0.1, 0.9]], [[0.3, 0.7], [0.6, 0.4]]])
    dbn.add(
        "z",
        lambda z_prev, u_prev: bmc.Categorical(follow[u_prev, z_prev]),
        initial=bmc.Categorical([0.7, 0.3]),
    )
    dbn.add(
        "y",
        lambda z, u, u_prev: bmc.Normal(1.0 * z - 0.5 * u + 0.7 * u_prev, 0.6),
        initial=lambda z: bmc.Normal(1.0 * z, 0.6),
    )
    rows = {"y": [0.3, 1.4, 0.2, -0.4, 1.2]}
    return dbn, rows, bmc.ParticleFilter(300, marginalize=["z"])


def beside_a_level() -> tuple[bmc.DynamicBayesNet, dict[str, Any], bmc.ParticleFilter]:
    """Particles with a regime, a Kalman filter and a table; something waits for the table."""
    dbn = bmc.DynamicBayesNet()
    dbn.table("s", ["s_prev"], [[0.9, 0.1], [0.3, 0.7]], initial=[0.5, 0.5])
    dbn.add("x", lambda x_prev, s: bmc.Normal(x_prev, 0.2 + s), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 0.4))
    dbn.table("z", ["z_prev"], [[0.8, 0.2], [0.3, 0.7]], initial=[0.4, 0.6])
    dbn.add("o", lambda z, s: bmc.Bernoulli(0.1 + 0.6 * z + 0.2 * s))
    rows = {"y": [0.1, np.nan, 1.8, 2.1], "o": [0, 1, 1, 0]}
    return dbn, rows, bmc.ParticleFilter(300, marginalize=["x", "y", "z"])


MODELS: dict[str, Answers] = {
    "colours": colours, "by the last place": by_the_last_place, "beside a level": beside_a_level,
}  # fmt: skip


def hidden(dbn: bmc.DynamicBayesNet, rows: dict[str, Any]) -> list[str]:
    """Names of nodes that are not seen."""
    return [n for n in dbn.sample(1, rng=0) if n not in rows]


def figures(found: Any, dbn: bmc.DynamicBayesNet, names: list[str]) -> dict[str, np.ndarray]:
    return {
        n: found.probabilities(n)[..., 1:] if dbn[n].is_discrete else found.mean(n) for n in names
    }


def judged(name: str, question: str, runs: int = 12) -> Verdict:
    """Mean answers of some runs; .008 is allowed for the bias of normalised weights."""
    dbn, rows, engine = MODELS[name]()
    names, lag = hidden(dbn, rows), 2
    late = bmc.ParticleFilter(engine.particles, marginalize=engine.marginalize, delay=lag)

    def estimate(rng: np.random.Generator) -> dict[str, np.ndarray]:
        if question == "delay":
            found = bmc.filter(dbn, rows, engine=late, rng=rng)
        else:
            more = {"lag": lag} if question == "lag" else {}
            found = bmc.smooth(dbn, rows, engine=engine, rng=rng, **more)
        return figures(found, dbn, names)

    right = figures(exact(dbn, rows), dbn, names)
    if question != "smooth":
        steps = len(next(iter(rows.values())))
        for t in range(steps):
            some = {n: v[: t + lag + 1] for n, v in rows.items()}
            for n, value in figures(exact(dbn, some), dbn, names).items():
                right[n][t] = value[t]
    return repeated_test(estimate, right, replications=runs, accuracy=0.008, rng=1)


@pytest.mark.parametrize("question", ["smooth", "lag", "delay"])
@pytest.mark.parametrize("name", MODELS)
def test_answers_about_the_past_are_those_of_enumeration(name: str, question: str) -> None:
    if (name, question) == ("beside a level", "delay") and not session.is_thorough():
        pytest.skip("as lag=; with --bayesmc-thorough")
    verdict = judged(name, question, session.scaled(10, 6))
    assert verdict, verdict


def test_every_particle_is_the_exact_smoother_where_nothing_is_sampled() -> None:
    dbn, rows = ring(3, 0.1), {"reading": [1, 0, None, 1, 1]}
    engine = bmc.ParticleFilter(7, marginalize="auto")
    found = bmc.smooth(dbn, rows, engine=engine, rng=0)
    right = bmc.smooth(dbn, rows, engine=bmc.DiscreteFilter())
    for name in ("color", "place"):
        gap = np.abs(found.probabilities(name) - right.probabilities(name))
        assert gap.max() < 1e-10
    full = {"reading": [1, 0, 0, 1, 1]}
    late = bmc.ParticleFilter(7, marginalize="auto", delay=2)
    belief = late.start(dbn, rng=0)
    for row in full["reading"]:
        belief = late.step(belief, {"reading": row})
    right = bmc.smooth(dbn, full, engine=bmc.DiscreteFilter())
    for ago in (0, 1, 2):
        gap = belief.back(ago).probabilities("color") - right.probabilities("color")[4 - ago]
        assert np.abs(gap).max() < 1e-10, ago


def test_draws_along_paths_are_joint_over_slices() -> None:
    """A state that never changes is the same in every slice of a path."""
    dbn = ring(3)
    rows = {"reading": [1, 0, None, 1, 1]}
    engine = bmc.ParticleFilter(80, marginalize=["color"])
    found = bmc.smooth(dbn, rows, engine=engine, rng=0)
    draws = np.asarray(found.particles("color"))
    assert (draws == draws[:1]).all() and draws.std(axis=1).any()


def test_what_was_drawn_before_later_rows_came_is_no_late_answer() -> None:
    """A missing sensor waits for a table: by name it is refused, "auto" samples then, and says why."""
    dbn, rows = ring(3, 0.1), {"reading": [1, None, 1]}
    named = bmc.ParticleFilter(50, marginalize=["color"])
    with pytest.raises(UnsupportedError, match="'color', .*'reading' is computed .* or missing"):
        bmc.smooth(dbn, rows, engine=named, rng=0, lag=1)
    for question in ("smooth", "fixed-lag"):
        nodes = bmc.explain(
            dbn, rows, engine=bmc.ParticleFilter(50, marginalize="auto"), question=question
        ).nodes
        assert ("a table of" in nodes["color"]) == (question == "smooth")


PAST = "bayesmc.engines.marginal.tables."
FAULTS = {
    "rows that follow do not choose among particles": (
        "by the last place", "smooth",
        Edit("bayesmc.engines.marginal.smoothing:_Paths.log_after", "found = found + log_evidence_of(",
             "found = found + 0.0 * log_evidence_of("),
    ),
    "tables of a path are those of the filter": (
        "colours", "smooth", Edit(PAST + "backwards:along", "_normalised(now + message)", "_normalised(now)"),
    ),
    "states before are not moved on": (
        "colours", "lag", Edit(PAST + "beliefs:Tables.looking_back", "a @ b for a, b", "a for a, b"),
    ),
    "a late answer is that of the filter": (
        "colours", "lag", Edit(PAST + "beliefs:_given_next", "log[..., :, None] + pair", "pair"),
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_a_planted_fault_is_caught(fault: str) -> None:
    name, question, edit = FAULTS[fault]
    with planted(edit):
        assert not judged(name, question, 10)
