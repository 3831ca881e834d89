"""The loop by hand that robots' updates are timed against answers what bayesmc answers."""

from __future__ import annotations

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.robotics import FreeSpace, PoseNormal, range_and_bearing, wrap
from benchmarks import bench_robot_logs, bench_robots
from benchmarks.floors import localization
from examples.robot_logs import Log, first

STEPS, PARTICLES, RUNS, LIMIT = 12, 400, 30, 5.0
NEAR, START = (0.1, 0.1, 0.3), PoseNormal([0.0, 0.0, 3.0], scale_diag=[0.5, 0.5, 0.3])
MARKS, RATES = np.array([[-4.0, -2.0], [3.0, 4.0], [-5.0, 0.0]]), np.array([1.0, 2.0, 3.0])


@pytest.fixture(scope="module")
def log() -> Log:
    return first(bench_robots.drive(), STEPS)


def test_floor_weighs_poses_as_the_field_does(log: Log) -> None:
    """On the map, beyond it, and where a robot may be; single precision, about 1e-5 a beam."""
    rng = np.random.default_rng(0)
    poses = FreeSpace(log.grid).sample(rng, sample_shape=500)
    poses[:20, :2] += 100.0  # beyond the map
    poses[20:40, 2] += 4 * np.pi
    loop, field = bench_robots.by_hand(log), bench_robots.sensor(log)
    found = np.empty(len(poses))
    for scan in log.scans[:3]:
        loop.weigh(np.ascontiguousarray(poses.T), scan, found)
        wanted = field.given(poses, log.angles).log_prob(scan)
        assert (np.abs(found - wanted) < 0.02).mean() > 0.99  # an end point on a cell's border
        assert np.abs(found - wanted).max() < 1.0
        mirrored = field.given(poses, -log.angles).log_prob(scan)
        assert (np.abs(found - mirrored) < 0.02).mean() < 0.3
    loop.weigh(np.ascontiguousarray(poses.T), np.full_like(log.scans[0], np.nan), found)
    assert not found.any()


def test_floor_has_the_law_of_the_engine(log: Log) -> None:
    """Means and increments of independent runs, by Welch's t.

    Beyond 5 with about 58 degrees of freedom has probability 6e-6; of the 49 compared some one is, in
    fewer than 3 of 10,000 choices of the seeds, which are fixed.
    """
    assert _worst(log, log) < LIMIT


def test_blocks_of_end_points_change_nothing(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    loop = bench_robots.by_hand(log)
    whole = loop.filtered(log.scans, log.motion, 500, 3)
    monkeypatch.setattr(localization, "BLOCK", 60 * 128)  # several blocks, the last one short
    cut = loop.filtered(log.scans, log.motion, 500, 3)
    np.testing.assert_allclose(cut.mean, whole.mean, atol=1e-9)
    np.testing.assert_allclose(cut.increments, whole.increments, atol=1e-6)


@pytest.mark.parametrize("fault", ["turned", "shifted", "noise"])
def test_comparison_of_laws_sees_a_fault(
    log: Log, fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Negative controls: wheels that turn 10 mrad more, ranges 3 cm longer, half as much variance again."""
    other = log
    if fault == "turned":
        other = log._replace(motion=log.motion + [0.0, 0.0, 0.01])
    elif fault == "shifted":
        other = log._replace(scans=np.where(log.scans < log.reach, log.scans + 0.03, log.scans))
    else:
        wider = tuple(1.5 * a for a in bench_robots.ALPHAS)
        loop = bench_robots.by_hand(log)
        loop.alphas = wider
        monkeypatch.setattr(bench_robots, "by_hand", lambda _: loop)
    assert _worst(log, other) > LIMIT


def test_particles_are_resampled_every_time(log: Log) -> None:
    found = bench_robots.run(bench_robots.net(log), log, 200, 0)
    assert found.resampled[1:].all() and not found.resampled[0]


def test_row_by_row_is_the_whole_log(log: Log) -> None:
    dbn = bench_robots.net(log)
    means = bench_robots.step_by_step(dbn, log, 300, 7)
    whole = bench_robots.run(dbn, log, 300, 7).mean("pose")
    np.testing.assert_allclose(np.array(means), whole, atol=1e-9)


def test_answers_of_a_run_are_those_of_its_particles() -> None:
    """Poses, bearings that are missing, counts in a plate: in several blocks, and in one."""
    dbn = bmc.DynamicBayesNet(plates={"mark": 3})
    dbn.add("pose", lambda pose_prev: PoseNormal(pose_prev, scale_diag=NEAR), initial=START)
    dbn.add("seen", lambda pose: range_and_bearing(pose, MARKS, 0.5, 0.2), plates="mark")
    dbn.add("count", lambda pose: bmc.Poisson(1.0 + np.abs(pose[..., 0]) * RATES), plates="mark")
    seen = np.full((3, 3, 2), np.nan)
    seen[:, 0] = [5.0, 0.5]
    for particles in (700, 9_000):
        engine = bmc.ParticleFilter(particles)
        found = bmc.filter(dbn, {"seen": seen}, engine=engine, rng=0, keep="particles")
        for name, angle in (("pose", 2), ("seen", 1), ("count", None)):
            values, weights = found.particles(name).astype(float), found.weights
            weights = weights.reshape(weights.shape + (1,) * (values.ndim - 2))
            mean = (weights * values).sum(axis=1)
            variance = (weights * (values - mean[:, None]) ** 2).sum(axis=1)
            if angle is not None:
                turned = (weights * np.exp(1j * values)).sum(axis=1)[..., angle]
                mean[..., angle] = np.angle(turned)
                variance[..., angle] = -2 * np.log(np.minimum(np.abs(turned), 1.0))
            np.testing.assert_allclose(found.mean(name), mean, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(found.var(name), variance, rtol=1e-9, atol=1e-12)
            plain = (weights * values).sum(axis=1)
            assert angle is None or np.abs(found.mean(name) - plain).max() > 1e-4


def test_figures_without_data_are_named(
    tmp_path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("BAYESMC_DATA", str(tmp_path))
    bench_robot_logs.main(["--seeds", "1"])
    said = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in said] == list(bench_robot_logs.FIGURES)
    assert all("BAYESMC_DATA" in line for line in said)
    with pytest.raises(SystemExit):
        bench_robot_logs.main(["trackng"])


@pytest.mark.parametrize(
    ("good", "said"), [(9 * [True] + [False], "met"), (8 * [True] + 2 * [False], "MISSED")]
)
def test_nine_seeds_of_ten_are_wanted(
    good: list[bool], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    bench_robot_logs._count(good, "found")
    assert capsys.readouterr().out.rstrip().endswith(said)


def test_tracking_is_printed_with_its_seed(
    reference_data, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    bench_robot_logs.tracking(reference_data, [3])
    said = capsys.readouterr().out
    assert "seed 3" in said and said.rstrip().endswith("met")
    monkeypatch.setattr(bench_robot_logs, "GOAL_TRACKING", 0.001)
    bench_robot_logs.tracking(reference_data, [3])
    assert capsys.readouterr().out.rstrip().endswith("MISSED")


# ---- private ------------------------------------------------------------------------------------


def _worst(log: Log, other: Log) -> float:
    """Largest |t| between runs of the engine on a log and of the loop on another."""
    dbn, loop = bench_robots.net(log), bench_robots.by_hand(other)
    engine = [bench_robots.run(dbn, log, PARTICLES, seed) for seed in range(RUNS)]
    hand = [
        loop.filtered(other.scans, other.motion, PARTICLES, 1000 + seed) for seed in range(RUNS)
    ]
    centre = engine[0].mean("pose")
    first_rows = [_row(run.mean("pose"), run.log_marginal_increments, centre) for run in engine]
    return _welch(
        np.array(first_rows),
        np.array([_row(run.mean, run.increments, centre) for run in hand]),
    )


def _row(mean: np.ndarray, increments: np.ndarray, centre: np.ndarray) -> np.ndarray:
    off = mean - centre
    off[:, 2] = wrap(off[:, 2])
    return np.concatenate([off.ravel(), increments, [increments.sum()]])


def _welch(a: np.ndarray, b: np.ndarray) -> float:
    spread = np.sqrt(a.var(axis=0, ddof=1) / len(a) + b.var(axis=0, ddof=1) / len(b))
    return float((np.abs(a.mean(axis=0) - b.mean(axis=0)) / spread).max())
