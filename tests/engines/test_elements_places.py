"""Elements of which a reading says something that is not Gaussian: against sums over a fine lattice.

Nothing here is left to chance: points are the same always, and poses are known to a thousandth.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.distributions.circular import wrap_angle
from bayesmc.engines.marginal.elements.places import linearised, moments
from bayesmc.engines.marginal.elements.updates import Belief, Row, Tangent, conditioned, placed
from bayesmc.robotics import PoseNormal, bearing

NOISE = 0.05


def bearing_at(x: np.ndarray, which: Any = None) -> Tangent:
    square = np.square(x).sum(axis=-1)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes = np.stack([-x[:, 1], x[:, 0]], -1) / square
    return Tangent(
        np.arctan2(x[:, 1], x[:, 0])[:, None], slopes[:, None], np.full((len(x), 1, 1), NOISE)
    )


def range_at(x: np.ndarray, which: Any = None) -> Tangent:
    far = np.sqrt(np.square(x).sum(axis=-1))[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes = (x / far)[:, None]
    return Tangent(far, slopes, np.full((len(x), 1, 1), NOISE))


def exactly(at: Any, mean: Any, scale: float, value: float) -> tuple[Any, Any, float]:
    """Mean, standard deviations and log evidence by sums over a polar lattice about the sensor."""
    rings, rays = (400, 1200) if at is bearing_at else (5000, 100)
    r = np.linspace(0, 6 * scale + 10, rings + 1)[1:]
    turn = np.linspace(-np.pi, np.pi, rays, endpoint=False)
    x = (r[:, None, None] * np.stack([np.cos(turn), np.sin(turn)], -1)).reshape(-1, 2)
    off = value - at(x).mean[:, 0]
    off = wrap_angle(off) if at is bearing_at else off
    log = -0.5 * np.square((x - mean) / scale).sum(-1) - 0.5 * (off / NOISE) ** 2
    log += np.log(np.repeat(r, len(turn)) * r[0] * (turn[1] - turn[0]))
    log -= np.log(2 * np.pi * scale**2) + np.log(NOISE * np.sqrt(2 * np.pi))
    share = np.exp(log - log.max())
    total, share = np.log(share.sum()) + log.max(), share / share.sum()
    found = share @ x
    return found, np.sqrt(share @ np.square(x - found)), total


CASES = [
    (bearing_at, (5.0, 0.0), 10.0, -3.0),  # behind the prior's mean
    (bearing_at, (5.0, 0.0), 3.0, 0.5),  # the tangent at the mean meets the reading, and is wrong
    (bearing_at, (5.0, 0.0), 100.0, 1.0),
    (bearing_at, (0.0, 0.0), 10.0, 1.0),  # where there is no tangent
    (range_at, (0.0, 0.0), 10.0, 6.0),
    (range_at, (5.0, 0.0), 3.0, 7.0),
]


def taken(at: Any, mean: Any, scale: float, value: float) -> tuple[Any, Any, Any, Any]:
    prior = Belief(np.array([mean]), scale * np.eye(2)[None])
    row = Row(np.array([[value]]), np.ones((1, 1), bool), np.array([at is bearing_at]))
    return prior, row, at, True


@pytest.mark.parametrize(("at", "mean", "scale", "value"), CASES)
def test_one_number_leaves_its_moments(at: Any, mean: Any, scale: float, value: float) -> None:
    """Of a wedge or a ring: means to .15 of their standard deviations, these to .15, the evidence to .15."""
    given = taken(at, mean, scale, value)
    found = linearised(*given)
    assert found.wild is not None and found.wild.all()
    after, log = found.conditioned(given[0])
    exact, sizes, evidence = exactly(at, np.array(mean), scale, value)
    own = np.sqrt(np.square(after.root[0]).sum(axis=-1))
    assert (np.abs(after.mean[0] - exact) < 0.15 * sizes + 1e-3).all()
    assert (np.abs(np.log(own / sizes)) < 0.15).all()
    assert abs(log[0] - evidence) < 0.15
    assert log[0] == found.log_predictive(given[0])[0]
    tangent, turned, holds = placed(*given[:3])  # the fault that this would not let pass
    assert not holds.any()
    if np.hypot(*mean) > 0 and at is bearing_at:
        plain, _ = conditioned(given[0], turned, tangent)
        own = np.sqrt(np.square(plain.root[0]).sum(axis=-1))
        misses = np.abs(plain.mean[0] - exact) > 0.15 * sizes
        assert misses.any() or (np.abs(np.log(own / sizes)) > 0.15).any()


def test_points_say_what_a_tangent_says_where_that_holds() -> None:
    """And nothing where no point fits: another belief is asked for by name."""
    given = taken(range_at, (300.0, 5.0), 2.0, 301.0)
    found = linearised(*given)
    assert found.wild is None
    (after, log), (own, own_log, lost) = found.conditioned(given[0]), moments(*given[:3])
    assert not lost.any() and abs(log - own_log) < 0.1
    np.testing.assert_allclose(own.mean, after.mean, atol=0.2)
    np.testing.assert_allclose(np.square(own.root).sum(-1), np.square(after.root).sum(-1), rtol=0.3)
    far = taken(range_at, (300.0, 5.0), 2.0, -1e6)
    assert moments(*far[:3])[2].all() and np.isfinite(linearised(*far).conditioned(far[0])[1]).all()


def test_a_range_in_space_leaves_a_sphere() -> None:
    """Of radius r its coordinates have mean 0 and standard deviation r / sqrt(3)."""
    prior = Belief(np.zeros((1, 3)), 10 * np.eye(3)[None])
    row = Row(np.array([[6.0]]), np.ones((1, 1), bool), np.zeros(1, bool))
    after, _, lost = moments(prior, row, range_at)
    size = 6 / np.sqrt(3)
    assert not lost.any() and np.abs(after.mean[0]).max() < 0.15 * size
    assert np.abs(np.log(np.sqrt(np.square(after.root[0]).sum(-1)) / size)).max() < 0.15


def net(mean: Any, scale: float, looks: int = 1) -> bmc.DynamicBayesNet:
    start = PoseNormal(np.zeros(3), scale_diag=[1e-3] * 3)
    dbn = bmc.DynamicBayesNet(plates={"mark": 2, "look": looks})
    dbn.input("which", plates="look")
    dbn.add("pose", lambda pose_prev: PoseNormal(pose_prev, scale_diag=[1e-3] * 3), initial=start)
    dbn.add(
        "mark",
        lambda mark_prev: bmc.MvNormal(mark_prev, scale_diag=np.zeros(2)),
        plates="mark",
        initial=bmc.MvNormal(mean, scale_diag=[scale, scale]),
    )
    dbn.add("seen", lambda pose, mark, which: bearing(pose, mark[which], NOISE), plates="look")
    return dbn


@pytest.mark.parametrize(("proposal", "mean"), [(None, (0.0, 0.0)), ("optimal", (5.0, 0.0))])
def test_filters_place_a_mark_behind_the_mean_of_its_prior(mean: Any, proposal: Any) -> None:
    """A bearing of -3: on that side, and as far off as the prior has it; no place is no bare error."""
    engine = bmc.ParticleFilter(30, marginalize="mark", proposal=proposal)
    rows, inputs = {"seen": [[-3.0]]}, {"which": [[1]]}
    found = bmc.filter(net(mean, 10.0), rows, inputs=inputs, engine=engine, rng=0)
    exact, sizes, evidence = exactly(bearing_at, np.array(mean), 10.0, -3.0)
    assert (np.abs(found.mean("mark")[0, 1] - exact) < 0.15 * sizes).all()
    assert (np.abs(np.log(found.std("mark")[0, 1] / sizes)) < 0.15).all()
    assert abs(found.log_marginal_likelihood - evidence) < 0.2
    np.testing.assert_allclose(found.mean("mark")[0, 0], mean)


def test_a_flat_reading_is_of_the_element_that_explains_it() -> None:
    """tanh tells nothing far out: a tangent there would say that what is read was expected.

    Element 1.2 +- .3 has tanh(x) = -.98 at twelve standard deviations; -1.6 +- .3 is near it.
    """
    dbn = bmc.DynamicBayesNet(plates={"mark": 2})
    dbn.add(
        "mark",
        lambda mark_prev: bmc.Normal(mark_prev, 0.0),
        plates="mark",
        initial=lambda: bmc.Normal(np.array([1.2, -1.6]), 0.3),
    )
    dbn.add("which", bmc.Categorical([0.5, 0.5]))
    dbn.add("seen", lambda mark, which: bmc.Normal(np.tanh(mark[which]), 0.05))
    engine = bmc.ParticleFilter(200, marginalize="mark")
    found = bmc.filter(dbn, {"seen": [-0.983]}, engine=engine, rng=0)
    x = np.linspace(-6.0, 6.0, 200_001)
    like = bmc.Normal(np.tanh(x), 0.05).log_prob(-0.983)
    each = [np.trapezoid(np.exp(like + bmc.Normal(m, 0.3).log_prob(x)), x) for m in (1.2, -1.6)]
    assert each[0] < 1e-12 * each[1]
    assert found.mean("which")[0] == 1.0
    assert abs(found.log_marginal_likelihood - np.log(0.5 * sum(each))) < 0.1
