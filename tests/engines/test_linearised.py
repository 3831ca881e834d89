"""``marginalize=`` of nodes with means that bend, against extended Kalman filters, loops and a grid."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import UnsupportedError
from tests.engines.test_marginal import off, told

TURN = np.array([[1.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 1.0], [0.0, 0.0, 1.0, 0.0], [0, 0, 0, 1]])


def pendulum(plates: Any = None) -> bmc.DynamicBayesNet:
    """Angle and speed, seen through a sine; a computed node between, and the time."""
    dbn = bmc.DynamicBayesNet(plates=plates)
    own = tuple(plates or ())
    dbn.add(
        "v",
        lambda v_prev, a_prev, t: bmc.Normal(v_prev - 0.3 * np.sin(a_prev) + 0.01 * t, 0.05),
        initial=bmc.Normal(0.0, 0.1),
        plates=own,
    )
    dbn.add(
        "a",
        lambda a_prev, v: bmc.Normal(a_prev + 0.3 * v, 0.05),
        initial=bmc.Normal(1.0, 0.3),
        plates=own,
    )
    dbn.add("height", lambda a: 1.0 - np.cos(a), plates=own)
    dbn.add("y", lambda height: bmc.Normal(height**2, 0.1), plates=own)
    dbn.add("z", lambda a: bmc.Normal(np.sin(a), 0.3), plates=own)
    return dbn


def radar(angles: Any) -> bmc.DynamicBayesNet:
    """A target that flies round a radar: bearings go through pi."""
    dbn = bmc.DynamicBayesNet()
    dbn.add(
        "x",
        lambda x_prev: bmc.MvNormal(np.matvec(TURN, x_prev), 0.01 * np.eye(4)),
        initial=bmc.MvNormal(np.array([-2.0, 0.3, 0.0, -0.2]), 0.1 * np.eye(4)),
    )
    dbn.add("r", lambda x: bmc.Normal(np.hypot(x[..., 0], x[..., 1]), 0.1))
    dbn.add("b", lambda x: angles(np.arctan2(x[..., 1], x[..., 0]), 0.05))
    return dbn


def landmarks(known: bool = False, variance: float = 0.2) -> bmc.DynamicBayesNet:
    """Three places in a plate, and ranges and bearings of them from a pose that is read, or hidden."""
    dbn = bmc.DynamicBayesNet(plates={"mark": 3})
    if known:
        dbn.input("pose", event_shape=(3,))
    else:
        dbn.add(
            "pose",
            lambda pose_prev: bmc.MvNormal(
                pose_prev + np.array([0.5, 0.1, 0.1]), np.diag([0.05, 0.05, 0.02]) ** 2
            ),
            initial=bmc.MvNormal(np.zeros(3), 1e-4 * np.eye(3)),
        )
    places = np.array([[3.0, 2.0], [1.0, -3.0], [-2.0, 0.1]])
    dbn.add(
        "mark",
        lambda mark_prev: bmc.MvNormal(mark_prev, 1e-4 * np.eye(2)),
        initial=lambda: bmc.MvNormal(places, variance * np.eye(2)),
        plates="mark",
    )

    @dbn.node(plates="mark")
    def reach(mark, pose):
        return bmc.Normal(np.hypot(mark[..., 0] - pose[..., 0], mark[..., 1] - pose[..., 1]), 0.1)

    @dbn.node(plates="mark")
    def bearing(mark, pose):
        angle = np.arctan2(mark[..., 1] - pose[..., 1], mark[..., 0] - pose[..., 0])
        return bmc.WrappedNormal(angle - pose[..., 2], 0.05)

    return dbn


def with_gaps(rows: np.ndarray, *at: Any) -> np.ndarray:
    found = np.array(rows, dtype=float)
    for place in at:
        found[place] = np.nan
    return found


# ---- where nothing is sampled -------------------------------------------------------------------


def same_as_extended(
    dbn: Any, rows: Any, names: list[str], hidden: list[str], **given: Any
) -> None:
    right = bmc.filter(dbn, rows, engine=bmc.ExtendedKalmanFilter(), **given)
    engine = bmc.ParticleFilter(3, marginalize=names)
    found = bmc.filter(dbn, rows, engine=engine, rng=0, **given)
    total = right.log_marginal_increments.reshape(right.steps, -1).sum(axis=1)
    assert off(found.log_marginal_increments.reshape(found.steps, -1).sum(axis=1), total) < 1e-9
    for name in hidden:
        assert off(found.mean(name), right.mean(name)) < 1e-9, name
        assert off(found.var(name), right.var(name)) < 1e-9, name
    late = bmc.filter(
        dbn, rows, engine=bmc.ParticleFilter(2, marginalize=names, delay=2), rng=0, **given
    )
    lagged = bmc.smooth(dbn, rows, engine=bmc.ExtendedKalmanFilter(), lag=2, **given)
    for name in hidden:
        assert off(late.mean(name), lagged.mean(name)) < 1e-9, name
        assert off(late.var(name), lagged.var(name)) < 1e-9, name


def test_a_pendulum_is_the_extended_kalman_filters() -> None:
    """Computed nodes, time, rows that are missing; elements of a plate that are filtered apart."""
    drawn = pendulum().sample(10, rng=1)
    rows = {"y": with_gaps(drawn["y"][0], 3), "z": with_gaps(drawn["z"][0], 3, 6)}
    same_as_extended(pendulum(), rows, ["a", "v"], ["a", "v", "height", "y", "z"])
    both = pendulum({"i": 2}).sample(8, rng=2)
    rows = {"y": with_gaps(both["y"][0], (2, 1)), "z": both["z"][0]}
    same_as_extended(pendulum({"i": 2}), rows, ["a", "v"], ["a", "v"])


@pytest.mark.filterwarnings("ignore::bayesmc.errors.ModelMisfitWarning")
@pytest.mark.parametrize("angles", [bmc.Normal, bmc.WrappedNormal])
def test_bearings_are_taken_the_short_way_round(angles: Any) -> None:
    """Vectors; of angles alone the residual is wrapped, as they are declared."""
    drawn = radar(bmc.WrappedNormal).sample(12, rng=3)
    bearing = np.asarray(drawn["b"][0])
    assert bearing.max() > 2.5 and np.abs(np.diff(bearing)).max() > 1.0
    rows = {"r": with_gaps(drawn["r"][0], 4), "b": with_gaps(bearing, 6)}
    same_as_extended(radar(angles), rows, ["x"], ["x"])


def test_landmarks_seen_from_a_known_pose_have_a_filter_each() -> None:
    """Some are not seen in every slice."""
    poses = np.cumsum(np.tile([0.5, 0.1, 0.1], (6, 1)), axis=0)
    dbn = landmarks(known=True)
    drawn = dbn.sample(6, rng=4, inputs={"pose": poses})
    rows = {
        "reach": with_gaps(drawn["reach"][0], (2, 1), 4),
        "bearing": with_gaps(drawn["bearing"][0], (2, 1), (3, 0), 4),
    }
    same_as_extended(dbn, rows, ["mark"], ["mark"], inputs={"pose": poses})


# ---- where something is -------------------------------------------------------------------------


def test_each_particle_is_linearised_at_its_own_mean() -> None:
    """A regime drives a number that is seen through its square: a loop over particles with their regimes."""
    dbn = bmc.DynamicBayesNet()
    dbn.table("s", ["s_prev"], [[0.7, 0.3], [0.4, 0.6]], initial=[0.5, 0.5])
    dbn.add(
        "x",
        lambda x_prev, s: bmc.Normal(np.tanh(x_prev) + s, np.where(s == 1, 0.5, 0.2)),
        initial=bmc.Normal(1.0, 0.3),
    )
    dbn.add("y", lambda x, s: bmc.Normal(x**2 + 0.5 * s * x, 0.4))
    ys = [1.1, 2.0, 0.7, 3.0]
    engine = bmc.ParticleFilter(30, marginalize=["x"], ess_threshold=0.0)
    found = bmc.filter(dbn, {"y": ys}, engine=engine, rng=0, keep="particles")
    paths, mean, var, log = found.particles("s"), np.ones(30), np.full(30, 0.09), np.zeros(30)
    for t, y in enumerate(ys):
        s = paths[t]
        if t:
            slope = 1.0 - np.tanh(mean) ** 2
            var = slope**2 * var + np.where(s == 1, 0.25, 0.04)
            mean = np.tanh(mean) + s
        slope = 2.0 * mean + 0.5 * s
        total, away = slope**2 * var + 0.16, y - mean**2 - 0.5 * s * mean
        log += -0.5 * away**2 / total - 0.5 * np.log(2 * np.pi * total)
        mean, var = mean + var * slope / total * away, var * 0.16 / total
    assert found.clouds is not None
    inner = found.clouds[-1].inner
    np.testing.assert_allclose(inner.mean_of(found.model["x"]), mean, rtol=1e-9)
    np.testing.assert_allclose(inner.variance_of(found.model["x"]), var, rtol=1e-9)
    np.testing.assert_allclose(found.clouds[-1].log_weights, log, rtol=1e-9)


def test_landmarks_have_a_filter_for_each_particle_and_element() -> None:
    """The second landmark given each particle's poses, by a loop: known so well that its tangents hold."""
    dbn = landmarks(variance=0.0025)
    drawn = dbn.sample(4, rng=6)
    rows = {"reach": drawn["reach"][0], "bearing": drawn["bearing"][0]}
    engine = bmc.ParticleFilter(20, marginalize=["mark"], ess_threshold=0.0)
    found = bmc.filter(dbn, rows, engine=engine, rng=0, keep="particles")
    assert "and element of 'mark'" in told(dbn, rows, engine)["mark"]
    assert found.clouds is not None
    poses, inner = found.particles("pose"), found.clouds[-1].inner
    for k in range(20):
        mean, cov = np.array([1.0, -3.0]), 0.0025 * np.eye(2)
        for t in range(4):
            cov = cov + (1e-4 * np.eye(2) if t else 0.0)
            dx, dy = mean - poses[t, k, :2]
            reach = np.hypot(dx, dy)
            slope = np.array([[dx / reach, dy / reach], [-dy / reach**2, dx / reach**2]])
            expected = np.array([reach, np.arctan2(dy, dx) - poses[t, k, 2]])
            away = np.array([rows["reach"][t, 1], rows["bearing"][t, 1]]) - expected
            away[1] = np.remainder(away[1] + np.pi, 2 * np.pi) - np.pi
            gain = cov @ slope.T @ np.linalg.inv(slope @ cov @ slope.T + np.diag([0.01, 0.0025]))
            mean, cov = mean + gain @ away, cov - gain @ slope @ cov
        node = found.model["mark"]
        np.testing.assert_allclose(inner.mean_of(node)[k, 1], mean, rtol=1e-8)
        np.testing.assert_allclose(inner.variance_of(node)[k, 1], np.diag(cov), rtol=1e-7)


def test_modes_drawn_given_the_row_weigh_by_each_modes_tangent() -> None:
    """One slice: the evidence of a switching filter that is linearised, with any number of particles."""
    dbn = bmc.DynamicBayesNet()
    dbn.table("s", ["s_prev"], [[0.7, 0.3], [0.4, 0.6]], initial=[0.3, 0.7])
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.2), initial=lambda s: bmc.Normal(1.0 + s, 0.3))
    dbn.add("y", lambda x, s: bmc.Normal(np.sin(x) + s, 0.2))
    engine = bmc.ParticleFilter(4, marginalize=["x"], proposal="optimal", delay=1)
    found = bmc.filter(dbn, {"y": [1.2]}, engine=engine, rng=0)
    right = bmc.filter(dbn, {"y": [1.2]}, engine=bmc.SwitchingKalmanFilter(linearize=True))
    assert found.log_marginal_likelihood == pytest.approx(right.log_marginal_likelihood, rel=1e-10)


def test_a_gently_bent_mean_is_near_the_answer_of_a_grid() -> None:
    """Approximate: within a twentieth of a standard deviation, and .02 of the log evidence but for chance."""
    dbn = bmc.DynamicBayesNet()
    dbn.table("s", ["s_prev"], [[0.9, 0.1], [0.2, 0.8]], initial=[0.5, 0.5])
    dbn.add(
        "x",
        lambda x_prev, s: bmc.Normal(x_prev + 0.1 * np.sin(x_prev) + 0.5 * s, 0.15),
        initial=bmc.Normal(0.5, 0.2),
    )
    dbn.add("y", lambda x: bmc.Normal(x + 0.1 * np.cos(x), 0.2))
    rows = {"y": [0.7, 0.8, 1.5, 2.1, 2.0]}
    right = bmc.filter(dbn, rows, engine=bmc.GridFilter({"x": (-3.0, 6.0, 400)}))
    engine = bmc.ParticleFilter(2000, marginalize=["x"], proposal="optimal")
    found = bmc.filter(dbn, rows, engine=engine, rng=0)
    assert np.abs((found.mean("x") - right.mean("x")) / right.std("x")).max() < 0.05
    assert np.abs(found.probabilities("s") - right.probabilities("s")).max() < 0.03
    away = abs(found.log_marginal_likelihood - right.log_marginal_likelihood)
    assert away < 0.02 + 3 * found.log_marginal_likelihood_mcse


# ---- what is said -------------------------------------------------------------------------------


def test_it_is_told_and_never_done_unasked() -> None:
    rows = {"y": [0.1, 0.2], "z": [0.5, 0.1]}
    engine = bmc.ParticleFilter(10, marginalize=["a", "v"])
    explained = bmc.explain(pendulum(), rows, engine=engine)
    assert "linearised at each particle's own mean" in explained.nodes["v"]
    assert "linearised" not in explained.nodes["a"]
    assert "approximation of unknown error ('v', 'height', 'z', 'y' linearised)" in explained.effort
    unasked = told(pendulum(), rows, bmc.ParticleFilter(10, marginalize="auto"))
    assert not any("linearised" in how for how in unasked.values())


@pytest.mark.parametrize(
    ("seen", "why"),
    [
        (lambda x: bmc.Normal(np.sin(x), np.exp(x)), "has a scale that depends on"),
        (lambda x: bmc.Poisson(np.exp(x)), "is discrete"),
        (lambda x: bmc.StudentT(4.0, np.sin(x), 1.0), "is StudentT, not Normal"),
        (lambda x: bmc.VonMises(x, np.exp(x)), "has a concentration that depends on"),
    ],
)
def test_what_has_no_tangent_is_refused_by_name(seen: Any, why: str) -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("h", lambda h_prev: bmc.Normal(h_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add(
        "x", lambda x_prev, h: bmc.Normal(np.sin(x_prev) + h, 1.0), initial=bmc.Normal(0.0, 1.0)
    )
    dbn.add("y", seen)
    with pytest.raises(UnsupportedError, match=why):
        bmc.filter(dbn, {"y": [1, 2]}, engine=bmc.ParticleFilter(10, marginalize=["x"]))
    with pytest.raises(UnsupportedError, match="node 'y'"):
        bmc.filter(dbn, {"y": [1, 2]}, engine=bmc.ParticleFilter(10, marginalize=["x"]))


def test_smoothing_draws_trajectories_of_all_nodes_and_says_so() -> None:
    """Their density is the declared one: near the extended smoother, where nothing bends by much."""
    drawn = pendulum().sample(8, rng=1)
    rows = {"y": drawn["y"][0], "z": drawn["z"][0]}
    engine = bmc.ParticleFilter(500, marginalize=["a", "v"])
    told = bmc.explain(pendulum(), rows, engine=engine, question="smooth").effort
    assert "nothing stays integrated out, as 'height' is linearised" in told
    found = bmc.smooth(pendulum(), rows, engine=engine, rng=0)
    right = bmc.smooth(pendulum(), rows, engine=bmc.ExtendedKalmanFilter())
    assert np.abs((found.mean("a") - right.mean("a")) / right.std("a")).max() < 0.5
