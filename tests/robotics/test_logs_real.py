"""The readers on the logs of real robots, where these are present: what is in them, by count."""

from __future__ import annotations

import gzip
import json
import math

import numpy as np
import pytest

from bayesmc.errors import FileFormatError, LogWarning
from bayesmc.robotics.logs import (
    UNKNOWN_SUBJECT,
    Laser,
    Odometry,
    keyframes,
    merge,
    pose_at,
    read_carmen,
    read_freiburg,
    read_freiburg_world,
    read_mrclam,
    read_plaza,
    read_plaza_ranges,
    read_wean,
    stack,
    write_carmen,
)
from bayesmc.robotics.poses import wrap


@pytest.fixture(scope="module")
def robot(reference_data):
    folder = reference_data / "robot"
    if not folder.is_dir():
        pytest.skip(f"reference data absent: {folder}")
    return folder


def test_intel(robot):
    path = robot / "intel" / "intel.gfs.log.gz"
    log = read_carmen(path, tolerance=math.inf)
    records = list(log)
    scans = [r for r in records if isinstance(r, Laser)]
    assert len(scans) == 910 and {s.ranges.size for s in scans} == {180}
    assert len(records) - 910 == 14541 and dict(log.ignored) == {"NEFF": 910}
    # GMapping writes the particles' past as ODOM again and again, so time runs backwards; scans do
    # so by less than a second
    with pytest.raises(
        FileFormatError, match=r"intel\.gfs\.log\.gz:28: time runs backwards by 0\.00587"
    ):
        list(read_carmen(path))
    assert list(read_carmen(path, messages=("FLASER",), tolerance=1.0)) == scans
    with np.load(robot / "intel" / "intel_laser_odom_corrected.npz") as table:
        # whose rows are in order of time
        np.testing.assert_allclose(stack(merge(scans))["ranges"], table["ranges"], atol=1e-5)


def test_intel_written_and_read_back(robot, tmp_path):
    path = robot / "intel" / "intel.gfs.log.gz"
    records = list(read_carmen(path, tolerance=math.inf))
    write_carmen(tmp_path / "again.log.gz", records, tolerance=math.inf)
    assert list(read_carmen(tmp_path / "again.log.gz", tolerance=math.inf)) == records


@pytest.mark.parametrize(
    ("name", "scans", "odometry"), [("robotdata1", 713, 1505), ("robotdata4", 600, 823)]
)
def test_wean(robot, name, scans, odometry):
    reference = json.loads((robot / "wean" / "wean.dev.ref.json").read_text())["results"][name]
    log = read_wean(robot / "wean" / f"{name}.log.gz")
    records = list(log)
    lasers = [r for r in records if isinstance(r, Laser)]
    assert len(lasers) == scans == reference["n_scans"] and log.lines == len(records)
    assert sum(isinstance(r, Odometry) for r in records) == odometry
    np.testing.assert_allclose([s.offset for s in lasers], [[0.25, 0, 0]] * scans, atol=1e-4)
    assert 0.4 < min(s.ranges.min() for s in lasers) < 0.8
    assert sum(1 for _ in keyframes(records)) == reference["n_keyframes"]
    assert records[-1].t - records[0].t == pytest.approx(reference["duration_s"], abs=0.3)


def test_wean_cut_off(robot, tmp_path):
    data = (robot / "wean" / "robotdata1.log.gz").read_bytes()
    (tmp_path / "cut.log.gz").write_bytes(data[: len(data) // 2])
    whole = list(read_wean(robot / "wean" / "robotdata1.log.gz"))
    log = read_wean(tmp_path / "cut.log.gz", on_error="skip")
    with pytest.warns(LogWarning, match="the gzip stream is cut off"):
        records = list(log)
    assert 1000 < len(records) < 1250 and records == whole[: len(records)]


def test_mrclam(robot):
    reference = json.loads((robot / "mrclam6" / "mrclam6.ref.json").read_text())["results"]
    data = read_mrclam(robot / "mrclam6", robots=[1, 3])
    assert sorted(data.landmarks) == list(range(6, 21)) and len(data.barcodes) == 20
    assert data.faults == {}
    for k, one in data.robots.items():
        expected = reference[f"mrclam6_robot{k}"]
        subjects = stack(one.measurements)["subject"]
        assert np.sum(subjects > 5) == expected["n_landmark_meas"]
        assert np.sum((subjects >= 1) & (subjects <= 5)) == expected["n_robot_meas"]
        assert np.sum(subjects == UNKNOWN_SUBJECT) == expected["n_unknown_barcode"]
    one = data.robots[1]
    assert (len(one.velocities), len(one.truth)) == (61785, 49241)
    assert [reference["mrclam6_robot1"][k] for k in ("n_landmark_meas", "n_robot_meas")] == [
        1534,
        407,
    ]
    # the right subjects, times and headings: what was measured agrees with the truth
    seen = [m for m in one.measurements if m.subject > 5]
    poses = pose_at(one.truth, [m.t for m in seen])
    lines = np.array([data.landmarks[m.subject] for m in seen]) - poses[:, :2]
    ranges = np.array([m.range for m in seen]) - np.hypot(*lines.T)
    bearings = wrap([m.bearing for m in seen] - np.arctan2(*lines.T[::-1]) + poses[:, 2])
    assert abs(np.median(ranges)) < 0.05 and np.median(np.abs(ranges)) < 0.1
    assert abs(np.median(bearings)) < 0.005 and np.median(np.abs(bearings)) < 0.02


def test_plaza(robot):
    drive = read_plaza(robot / "plaza")
    assert (len(drive.ranges), len(drive.increments), len(drive.truth)) == (3529, 9657, 9658)
    assert sorted(drive.beacons) == [0, 1, 5, 6] and drive.faults == {}
    times = stack(drive.ranges)["t"]
    assert np.all(np.diff(times) >= 0.0)
    # its lines go back by a minute twice, which are no faults: see the ranges on either side
    log = list(read_plaza_ranges(robot / "plaza" / "Plaza1_TD.txt"))
    back = np.flatnonzero(np.diff(stack(log)["t"]) < 0.0)
    assert back.tolist() == [1987, 2865]
    places = np.array([drive.beacons[r.beacon] for r in log])
    at = pose_at(drive.truth, [r.t for r in log])[:, :2]
    residuals = np.array([r.range for r in log]) - np.hypot(*(at - places).T)
    expected = json.loads((robot / "plaza" / "plaza1.ref.json").read_text())["results"]
    assert np.nanmedian(residuals) == pytest.approx(expected["range_residual_median"], abs=0.02)
    for part in (residuals[1676:1988], residuals[1988:2300], residuals[2866:3000]):
        assert np.nanmedian(np.abs(part - 2.84)) < 1.2


def test_freiburg(robot):
    folder = robot / "freiburg_course"
    records = list(read_freiburg(folder / "sensor_data.dat"))
    assert len(records) == 331 + 1212 and records[-1].t in (330.0, 331.0)
    assert len(read_freiburg_world(folder / "world.dat")) == 9
    # one range of the simulation is negative, and is kept
    assert min(getattr(r, "range", 0.0) for r in records) == pytest.approx(-0.035065641258)


def test_a_line_of_a_real_log_garbled(robot):
    with gzip.open(robot / "wean" / "robotdata4.log.gz", "rt") as file:
        lines = file.read().splitlines()
    whole = list(read_wean(lines))
    for k in range(3, 300, 37):
        garbled = [*lines[:k], lines[k][: len(lines[k]) // 2], *lines[k + 1 :]]
        log = read_wean(garbled, on_error="skip")
        with pytest.warns(LogWarning, match=f"the first at line {k + 1}:"):
            assert list(log) == [*whole[:k], *whole[k + 1 :]]
