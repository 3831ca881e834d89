"""Motion: arcs against an integrated differential equation, densities against quadrature and draws."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

import bayesmc as bmc
from bayesmc.errors import ParameterError, ShapeError, UnsupportedError
from bayesmc.robotics import motion as motion_module
from bayesmc.robotics.motion import OdometryMotion, VelocityMotion
from bayesmc.robotics.pose_distributions import PoseNormal
from bayesmc.robotics.poses import between, compass, compose, pose_errors, wrap
from bayesmc.robotics.steps import euler_step, unicycle

TURN = 2 * np.pi
#: rate of false alarms of each goodness-of-fit test below, were its seed fresh
ALARM = 1e-6

SPEED = st.floats(-3, 3)
RATE = st.floats(-4, 4) | st.sampled_from([0.0, 1e-300, 1e-12, -1e-8, 1e-5])
POSE = st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-9, 9)).map(np.array)


def assert_same(a: Any, b: Any, atol: float = 1e-9) -> None:
    distance, heading = pose_errors(a, b)
    np.testing.assert_allclose(distance, 0.0, atol=atol)
    np.testing.assert_allclose(heading, 0.0, atol=atol)


# ---- where motions end ----------------------------------------------------------------------------


@given(POSE, SPEED, RATE)
def test_unicycle_solves_its_differential_equation(pose: Any, v: float, omega: float) -> None:
    """Simpson's rule for the integral of ``v (cos, sin)(h + omega t)``, whose error here is below 1e-9."""
    t = np.linspace(0.0, 1.5, 401)
    weights = np.full(401, 2.0)
    weights[1::2], weights[[0, -1]] = 4.0, 1.0
    weights *= 1.5 / 400 / 3
    heading = pose[2] + omega * t
    end = [
        pose[0] + v * weights @ np.cos(heading),
        pose[1] + v * weights @ np.sin(heading),
        pose[2] + omega * 1.5,
    ]
    assert_same(unicycle(pose, v, omega, 1.5), end, atol=1e-8)


@given(POSE, SPEED, RATE, st.floats(0, 2), st.floats(0, 2))
def test_two_arcs_are_one(pose: Any, v: float, omega: float, first: float, second: float) -> None:
    apart = unicycle(unicycle(pose, v, omega, first), v, omega, second)
    assert_same(apart, unicycle(pose, v, omega, first + second))
    assert_same(unicycle(unicycle(pose, v, omega, first), -v, -omega, first), pose)


def test_unicycle_is_smooth_where_the_turn_vanishes() -> None:
    omega = np.array([0.0, 1e-300, 1e-16, 1e-9, 1e-6, 1e-3])
    omega = np.concatenate([-omega[:0:-1], omega])
    end = unicycle(np.zeros(3), 2.0, omega, 1.0)
    series = np.stack([2 - omega**2 / 3, omega - omega**3 / 12, omega], axis=-1)
    np.testing.assert_allclose(end, series, rtol=1e-12, atol=0)
    with np.errstate(divide="ignore", invalid="ignore"):  # negative control: the usual formula
        usual = 2 / omega * (1 - np.cos(omega))
    assert not np.allclose(usual, series[:, 1], rtol=1e-3, atol=0)


def test_euler_step_states_its_axis() -> None:
    at = np.array([1.0, 2.0, 0.4])
    np.testing.assert_allclose(
        euler_step(at, 2.0, 0.3, 0.5), [1 + np.cos(0.4), 2 + np.sin(0.4), 0.55]
    )
    np.testing.assert_allclose(
        euler_step(at, 2.0, 0.3, 0.5, heading_zero="y"), [1 + np.sin(0.4), 2 + np.cos(0.4), 0.55]
    )
    assert euler_step(np.zeros(3), 1.0, 0.0, 1.0, heading_zero="y").tolist() == [0.0, 1.0, 0.0]
    with pytest.raises(ValueError, match="heading_zero='north'"):
        euler_step(at, 2.0, 0.3, 0.5, heading_zero="north")


@given(POSE, SPEED, st.floats(-4, 4))
def test_both_conventions_drive_the_same_way(pose: Any, v: float, omega: float) -> None:
    def other(a: np.ndarray) -> np.ndarray:
        return np.array([a[0], a[1], compass(a[2])])

    there = euler_step(other(pose), v, -omega, 0.7, heading_zero="y")
    assert_same(other(there), euler_step(pose, v, omega, 0.7))


@given(POSE, SPEED, st.floats(-0.01, 0.01))
def test_euler_is_the_arc_to_first_order(pose: Any, v: float, omega: float) -> None:
    distance, heading = pose_errors(euler_step(pose, v, omega, 1.0), unicycle(pose, v, omega, 1.0))
    assert distance <= 0.51 * abs(v * omega) + 1e-9
    assert abs(heading) < 1e-12


# ---- densities ------------------------------------------------------------------------------------

START = np.array([2.0, -1.0, 2.6])
ARC = [0.05, 0.02, 0.3, 0.05, 0.08, 0.02]
WHEELS = [0.2, 0.1, 0.05, 0.02]

#: name -> the density, and the largest distance from its start that it reaches
CASES: dict[str, tuple[Any, float]] = {
    "arc": (VelocityMotion(START, 1.0, 0.6, 1.0, ARC), 3.5),
    "arc, backing up": (VelocityMotion(START, -1.0, 0.6, 1.0, ARC), 3.5),
    "arc of more than a turn": (VelocityMotion(START, 4.0, 9.0, 1.0, [0.01, 0, 0, 0.003, 0, 0.002]), 3.0),
    "arc with a wild turn": (VelocityMotion(START, 1.0, 0.2, 1.0, [0.1, 0, 3.0, 0, 0.1, 0]), 4.0),
    "standing, by velocity": (VelocityMotion(START, 0.0, 0.0, 1.0, ARC, floor=[0.2, 0.4, 0.3]), 1.6),
    "turning on the spot": (VelocityMotion(START, 0.0, 1.0, 1.0, ARC, floor=0.2), 2.5),
    "no time": (VelocityMotion(START, 3.0, 1.0, 0.0, ARC, floor=[0.2, 0.4, 0.3]), 1.6),
    "odometry": (OdometryMotion(START, [1.0, 0.3, 0.8], WHEELS), 3.5),
    "odometry, backing up": (OdometryMotion(START, [-1.0, 0.3, -0.8], WHEELS), 3.5),
    "odometry, wild rotations": (OdometryMotion(START, [0.9, 0.9, 0.5], [3.0, 0.5, 0.2, 0.05]), 6.0),
    "standing, by odometry": (OdometryMotion(START, [0.0, 0.0, 0.0], WHEELS, floor=[0.5, 0.2, 0.4]), 1.6),
    "odometry turns on the spot": (OdometryMotion(START, [0.0, 0.0, 1.2], WHEELS, floor=0.2), 3.0),
}  # fmt: skip
BY_NAME = pytest.mark.parametrize("name", CASES)
CELLS = (60, 72, 72)


def polar(dist: Any, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Midpoints of cells in distance, direction and turn from the start; and the masses there.

    In these coordinates the poles at no displacement are none. The rule converges at once along the
    circles, and with the square of the cell along the distance.
    """
    sizes = reach / CELLS[0], TURN / CELLS[1], TURN / CELLS[2]
    c, b, turn = np.meshgrid(
        *((np.arange(n) + 0.5) * s for n, s in zip(CELLS, sizes, strict=True)), indexing="ij"
    )
    seen = np.stack([c * np.cos(b), c * np.sin(b), turn], axis=-1)
    mass = np.exp(dist.log_prob(compose(START, seen))) * c * np.prod(sizes)
    return seen, mass


@BY_NAME
def test_densities_integrate_to_one(name: str) -> None:
    dist, reach = CASES[name]
    _, mass = polar(dist, reach)
    assert mass.sum() == pytest.approx(1.0, abs=2e-3)


class WithoutJacobian(VelocityMotion):
    """Table 5.1 as printed: the noise's density at the velocities, and no change of variables."""

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        chord, _, _ = motion_module._polar(self.pose_prev, x, self.turn)
        return super()._log_prob(x) + np.log(0.5 * chord)


def test_integrals_see_a_missing_jacobian_or_full_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Negative controls of the test above."""
    _, mass = polar(WithoutJacobian(START, 1.0, 0.6, 1.0, ARC), 3.5)
    assert abs(mass.sum() - 1) > 0.1
    plain = VelocityMotion._log_arc

    def ahead_alone(self: Any, chord: Any, half: Any, sine: Any) -> Any:
        value = plain(self, chord, half, sine)
        return np.where(np.abs(half) < 0.5 * np.pi, value, -np.inf)

    monkeypatch.setattr(VelocityMotion, "_log_arc", ahead_alone)
    for name in ("arc with a wild turn", "arc of more than a turn"):
        dist, reach = CASES[name]
        assert polar(dist, reach)[1].sum() < 0.97


def binned(dist: Any, reach: float, draws: np.ndarray) -> float:
    """p-value of Pearson's chi-square of draws in 5 x 6 x 6 cells of distance, direction and turn."""
    _, mass = polar(dist, reach)
    blocks = (5, 6, 6)
    sizes = [n // k for n, k in zip(CELLS, blocks, strict=True)]
    expected = mass.reshape(5, sizes[0], 6, sizes[1], 6, sizes[2]).sum(axis=(1, 3, 5)).ravel()
    seen = between(START, draws)
    place = [
        np.minimum(np.hypot(seen[:, 0], seen[:, 1]) / reach * 5, 4.999),
        np.remainder(np.arctan2(seen[:, 1], seen[:, 0]), TURN) / TURN * 6,
        np.remainder(seen[:, 2], TURN) / TURN * 6,
    ]
    index = np.ravel_multi_index([np.minimum(p, 5).astype(int) for p in place], blocks)
    counts = np.bincount(index, minlength=180)
    often = expected * len(draws) >= 10  # the rest is one cell
    expected = np.append(expected[often], expected[~often].sum()) / expected.sum() * len(draws)
    counts = np.append(counts[often], counts[~often].sum())
    if expected[-1] < 5:
        expected, counts = expected[:-1] * counts[:-1].sum() / expected[:-1].sum(), counts[:-1]
    return float(stats.chisquare(counts, expected).pvalue)


@BY_NAME
def test_draws_fit_their_density(name: str) -> None:
    dist, reach = CASES[name]
    draws = dist.sample(3, 10_000)
    assert (draws[:, 2] >= -np.pi).all() and (draws[:, 2] < np.pi).all()
    assert binned(dist, reach, draws) > ALARM


@pytest.mark.parametrize("name", ["arc", "odometry", "arc with a wild turn"])
def test_draws_of_another_noise_are_seen(name: str) -> None:
    """Negative control of the test above, at its own number of draws and rate: 15 % more of one noise."""
    dist, reach = CASES[name]
    if isinstance(dist, OdometryMotion):
        other: Any = OdometryMotion(START, dist.motion, np.multiply(WHEELS, [1, 1.32, 1, 1]))
    else:
        alphas = dist.alphas * [1, 1, 1.32, 1.32, 1, 1]
        other = VelocityMotion(START, dist.v, dist.omega, dist.dt, alphas)
    assert binned(dist, reach, other.sample(3, 10_000)) < ALARM


@BY_NAME
def test_moments_are_those_of_draws(name: str) -> None:
    """Position's mean and covariance and the heading's turns, 6 standard errors of 100,000 draws each."""
    dist, _ = CASES[name]
    count = 100_000
    draws = dist.sample(5, count)
    off = draws - dist.mean
    off[:, 2] = wrap(off[:, 2])
    spread = off[:, :2]
    assert (np.abs(spread.mean(axis=0)) < 6 * spread.std(axis=0) / np.sqrt(count)).all()
    for i, j in ((0, 0), (0, 1), (1, 1)):
        product = spread[:, i] * spread[:, j]
        assert abs(product.mean() - dist.cov[i, j]) < 6 * product.std() / np.sqrt(count)
    # on a circle: the mean of cos is exp(-var / 2), and with a position's noise the sine has the
    # covariance times that, exactly where both are normal and nearly where turns are small
    cosine = np.cos(off[:, 2])
    assert abs(cosine.mean() - np.exp(-0.5 * dist.var[2])) < 6 * cosine.std() / np.sqrt(count)
    # of arcs the derivatives hold it, and wild turns are not normal
    if isinstance(dist, OdometryMotion) and dist.var[2] < 1.0:
        for i in (0, 1):
            product = spread[:, i] * np.sin(off[:, 2])
            expected = dist.cov[i, 2] * np.exp(-0.5 * dist.var[2])
            assert abs(product.mean() - expected) < 6 * product.std() / np.sqrt(count)
    np.testing.assert_allclose(dist.cov_root @ dist.cov_root.T, dist.cov, atol=1e-12)


def test_moments_of_little_noise_are_the_derivatives() -> None:
    """The covariance by derivatives of the arc, which small noise reaches; and not with another noise."""
    alphas = 1e-6 * np.array(ARC)
    dist = VelocityMotion(START, 1.0, 0.6, 2.0, alphas, floor=1e-9)
    step = 1e-6
    slopes = np.stack(
        [
            unicycle(START, 1.0 + step, 0.6, 2.0) - unicycle(START, 1.0 - step, 0.6, 2.0),
            unicycle(START, 1.0, 0.6 + step, 2.0) - unicycle(START, 1.0, 0.6 - step, 2.0),
            [0.0, 0.0, 2 * step * 2.0],
        ],
        axis=-1,
    ) / (2 * step)
    variances = alphas.reshape(3, 2) @ [1.0, 0.36]
    linear = slopes @ np.diag(variances) @ slopes.T
    np.testing.assert_allclose(dist.cov, linear, rtol=1e-4, atol=1e-12)
    assert not np.allclose(dist.cov, slopes @ slopes.T * variances[0], rtol=0.1, atol=1e-12)
    assert_same(dist.mean, unicycle(START, 1.0, 0.6, 2.0), atol=1e-5)


@given(POSE, POSE, st.integers(-2, 2))
def test_densities_move_with_the_frame_and_ignore_full_turns(
    frame: np.ndarray, start: np.ndarray, k: int
) -> None:
    near = [[0.9, 0.2, 0.5], [1.2, 0.4, 0.9]]
    turn = np.array([0.0, 0.0, k * TURN])
    for make in (
        lambda pose: VelocityMotion(pose, 1.0, 0.6, 1.0, ARC),
        lambda pose: OdometryMotion(pose, [1.0, 0.3, 0.8], WHEELS),
        lambda pose: PoseNormal(euler_step(pose, 1.0, 0.6, 1.0), scale_diag=[0.3, 0.3, 0.2]),
    ):
        value = make(start).log_prob(compose(start, near))
        moved = make(compose(frame, start)).log_prob(compose(compose(frame, start), near))
        np.testing.assert_allclose(moved, value, atol=1e-6)
        turned = make(start + turn).log_prob(compose(start, near) - turn)
        np.testing.assert_allclose(turned, value, atol=1e-6)


def test_standing_still_keeps_a_finite_density() -> None:
    for dist in (
        VelocityMotion(START, 0.0, 0.0, 1.0, ARC),
        OdometryMotion(START, np.zeros(3), WHEELS),
    ):
        assert np.isfinite(dist.log_prob(START))
        assert dist.log_prob(START) > dist.log_prob(compose(START, [1e-3, 0, 0]))
        draws = dist.sample(0, 1000)
        distance, heading = pose_errors(draws, START)
        assert distance.max() < 1e-3  # the floor is 1e-4 m
        assert np.abs(heading).max() < 1e-3
    bad = [np.nan, 0.0, 0.0]
    assert np.isnan(dist.log_prob(bad))
    assert dist.log_prob([np.inf, 0.0, 0.0]) == -np.inf


def test_backing_up_is_no_turn() -> None:
    ahead = OdometryMotion(START, [0.5, 0.0, 0.0], WHEELS)
    back = OdometryMotion(START, [-0.5, 0.0, 0.0], WHEELS)
    np.testing.assert_array_equal(ahead.scales, back.scales)
    assert_same(ahead.mean, compose(START, [0.5 * np.exp(-0.5 * ahead.scales[0] ** 2), 0, 0]))
    assert_same(back.mean, compose(START, [-0.5 * np.exp(-0.5 * back.scales[0] ** 2), 0, 0]))
    # negative control: as two turns by pi the rotations would be lost in noise
    as_turns = np.sqrt(WHEELS[0] * np.pi**2 + WHEELS[1] * 0.25)
    assert as_turns > 5 * back.scales[0]


def test_directions_of_tiny_translations_are_no_rotations() -> None:
    tiny = OdometryMotion(START, [0.0, 0.004, 0.1], WHEELS)
    assert tiny.scales[0] == pytest.approx(np.hypot(np.sqrt(WHEELS[1]) * 0.004, 1e-4))
    assert_same(tiny.mean, compose(START, [0.0, 0.004, 0.1]), atol=1e-6)
    trusted = OdometryMotion(START, [0.0, 0.004, 0.1], WHEELS, least=0.0)
    assert trusted.scales[0] > 0.6


# ---- batches, faults, and use in a net -------------------------------------------------------------


def test_batches_broadcast_and_every_element_is_its_own() -> None:
    rng = np.random.default_rng(0)
    pose, v = rng.normal(size=(5, 1, 3)), rng.normal(size=4)
    motion, x = rng.normal(size=(4, 3)), rng.normal(size=(2, 5, 4, 3))
    alphas = rng.random((4, 6))
    many: list[Any] = [
        VelocityMotion(pose, v, 0.3, 0.5, alphas),
        OdometryMotion(pose, motion, alphas[:, :4]),
        PoseNormal(unicycle(pose, v, 0.3, 0.5), scale_diag=[0.1, 0.1, 0.2]),
    ]
    for dist in many:
        assert (dist.batch_shape, dist.event_shape) == ((5, 4), (3,))
        assert dist.sample(0, 7).shape == (7, 5, 4, 3)
        assert dist.mean.shape == (5, 4, 3)
        assert dist.cov.shape == (5, 4, 3, 3)
        assert dist.var.shape == (5, 4, 3)
        assert dist.log_prob(x).shape == (2, 5, 4)
        assert len(np.unique(dist.sample_to(rng, (3, 5, 4)))) == 3 * 5 * 4 * 3
    alone: list[Any] = [
        VelocityMotion(pose[2, 0], v[1], 0.3, 0.5, alphas[1]),
        OdometryMotion(pose[2, 0], motion[1], alphas[1, :4]),
        PoseNormal(unicycle(pose[2, 0], v[1], 0.3, 0.5), scale_diag=[0.1, 0.1, 0.2]),
    ]
    for dist, one in zip(many, alone, strict=True):
        np.testing.assert_allclose(dist.log_prob(x)[1, 2, 1], one.log_prob(x[1, 2, 1]))
        np.testing.assert_allclose(dist.cov[2, 1], one.cov, atol=1e-14)
        np.testing.assert_allclose(dist.mean[2, 1], one.mean, atol=1e-14)


def test_single_draws_have_the_noise_of_many() -> None:
    rng = np.random.default_rng(0)
    for dist in (VelocityMotion(START, 1.0, 0.6, 1.0, ARC), OdometryMotion(START, START, WHEELS)):
        alone = np.array([dist.sample(rng) for _ in range(300)])
        distance, heading = pose_errors(alone, dist.mean)
        many = pose_errors(dist.sample(rng, 20_000), dist.mean)
        # a ratio of deviations has a standard error of about 5 %: 6 of them
        assert 0.7 < distance.std() / many[0].std() < 1.3
        assert 0.7 < heading.std() / many[1].std() < 1.3


def test_arguments_are_not_changed() -> None:
    pose = np.random.default_rng(0).normal(size=(6, 3))
    before = pose.copy()
    for dist in (VelocityMotion(pose, 1.0, 0.1, 1.0, ARC), OdometryMotion(pose, pose, WHEELS)):
        kept = dist.scales[0].copy()
        dist.log_prob(dist.sample(0, 3))
        np.testing.assert_array_equal(pose, before)
        np.testing.assert_array_equal(dist.scales[0], kept)


def test_faults_say_what_is_wrong() -> None:
    with pytest.raises(ShapeError, match="VelocityMotion: a pose"):
        VelocityMotion([0.0, 0.0], 1.0, 0.0, 1.0, ARC)
    with pytest.raises(ShapeError, match="give 6 numbers"):
        VelocityMotion(START, 1.0, 0.0, 1.0, WHEELS)
    with pytest.raises(ShapeError, match="give 4 numbers"):
        OdometryMotion(START, START, ARC)
    with pytest.raises(ShapeError, match="floor has shape"):
        OdometryMotion(START, START, WHEELS, floor=[1.0, 1.0])
    with pytest.raises(ParameterError, match="dt must be nonnegative"):
        VelocityMotion(START, 1.0, 0.0, -1.0, ARC)
    with pytest.raises(ParameterError, match="alphas must be nonnegative"):
        VelocityMotion(START, 1.0, 0.0, 1.0, [-1.0, 0, 0, 0, 0, 0])
    with pytest.raises(ParameterError, match="floor must be positive"):
        OdometryMotion(START, START, WHEELS, floor=0.0)
    with pytest.raises(ParameterError, match="least"):
        OdometryMotion(START, START, WHEELS, least=-1.0)
    with pytest.raises(ParameterError, match="v must be finite"):
        VelocityMotion(START, [1.0, np.nan], 0.0, 1.0, ARC)
    with pytest.raises(ParameterError, match=r"pose_prev must be finite.*at index 1"):
        OdometryMotion([START, [0.0, np.inf, 0.0]], START, WHEELS)
    with bmc.distributions.marking_invalid():
        marked = VelocityMotion(START, [1.0, np.nan], 0.0, [1.0, 1.0], ARC)
    assert marked.invalid is not None
    assert marked.invalid.tolist() == [False, True]


def driving(kind: str) -> bmc.DynamicBayesNet:
    """A robot that drives from a known pose and knows its position now and then."""
    dbn = bmc.DynamicBayesNet(kind)
    dbn.input("u", event_shape=(3,))
    noise = [0.02, 0.01, 0.05, 0.05, 0.01, 0.01]
    moves: dict[str, Any] = {
        "velocity": lambda pose_prev, u: VelocityMotion(pose_prev, u[..., 0], u[..., 2], 1.0, noise),
        "odometry": lambda pose_prev, u: OdometryMotion(pose_prev, u, [0.05, 0.02, 0.02, 0.01]),
        "notes": lambda pose_prev, u: PoseNormal(
            euler_step(pose_prev, u[..., 0], u[..., 2], 1.0), scale_diag=[0.1, 0.1, 0.1]
        ),
    }  # fmt: skip
    start = PoseNormal([0.0, 0.0, 3.0], scale_diag=[0.1, 0.1, 0.1])
    dbn.add("pose", moves[kind], initial=start)
    dbn.add("y", lambda pose: bmc.MvNormal(pose[..., :2], scale_diag=[0.3, 0.3]))
    return dbn


@pytest.mark.parametrize("kind", ["velocity", "odometry", "notes"])
def test_a_net_filters_and_smooths_with_them(kind: str) -> None:
    """Errors of 40 slices beside those of the motion alone, which the positions must beat."""
    dbn = driving(kind)
    dbn.validate()
    u = np.tile([1.0, 0.0, 0.5], (40, 1))
    drawn = dbn.sample(40, inputs={"u": u}, rng=2)
    truth, rows = drawn["pose"][0], drawn["y"][0].copy()
    rows[::3] = np.nan
    asked = {
        "x": lambda pose: pose[..., 0],
        "y": lambda pose: pose[..., 1],
        "cos": lambda pose: np.cos(pose[..., 2]),
        "sin": lambda pose: np.sin(pose[..., 2]),
    }

    def error(found: Any) -> tuple[float, float]:
        q = found.queries
        pose = np.stack([q["x"], q["y"], np.arctan2(q["sin"], q["cos"])], axis=-1)
        distance, heading = pose_errors(pose, truth)
        return float(np.sqrt((distance**2).mean())), float(np.sqrt((heading**2).mean()))

    call = {"inputs": {"u": u}, "rng": 0, "queries": asked}
    filtered = error(bmc.filter(dbn, {"y": rows}, engine=bmc.ParticleFilter(2000), **call))
    blind = error(bmc.filter(dbn, {"y": rows * np.nan}, engine=bmc.ParticleFilter(2000), **call))
    smoothed = error(bmc.smooth(dbn, {"y": rows}, engine=bmc.ParticleFilter(400), **call))
    assert filtered[0] < 0.5
    assert filtered[0] < 0.5 * blind[0]
    assert smoothed[0] < filtered[0]  # smoothing reads the densities, not the draws alone
    assert smoothed[1] < 0.5


def test_walks_on_poses_are_not_taken_for_linear_ones() -> None:
    """The mean is affine in the pose, but the heading wraps: an exact filter must refuse."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("pose", lambda pose_prev: PoseNormal(pose_prev, scale_diag=[0.1, 0.1, 0.1]),
            initial=bmc.MvNormal(np.zeros(3), np.eye(3)))  # fmt: skip
    dbn.add("y", lambda pose: bmc.MvNormal(pose, np.eye(3)))
    with pytest.raises(UnsupportedError):
        bmc.filter(dbn, {"y": np.zeros((3, 3))}, engine=bmc.KalmanFilter())
