"""Each format, on lines typed in: what is read, what is a fault, what is passed over."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from bayesmc.errors import FileFormatError, LogWarning, ParameterError, ShapeError
from bayesmc.robotics.logs import (
    MAX_RANGE,
    UNKNOWN_SUBJECT,
    Barcode,
    GroundTruth,
    Increment,
    Landmark,
    Laser,
    Measurement,
    Odometry,
    RangeOnly,
    RotTransRot,
    Velocity,
    read_carmen,
    read_freiburg,
    read_freiburg_world,
    read_mrclam,
    read_mrclam_barcodes,
    read_mrclam_landmarks,
    read_mrclam_measurements,
    read_plaza,
    read_plaza_increments,
    read_plaza_ranges,
    read_wean,
    sick_angles,
    write_carmen,
)

ODOM = "ODOM 1.5 -2.0 0.25 0.3 0.1 0.0 10.5 robot 0.5"
FLASER = "FLASER 4 1.0 2.5 81.83 0.5 1.75 -2.0 0.25 1.5 -2.0 0.25 10.6 robot 0.6"
ROBOTLASER = (
    "ROBOTLASER1 0 -1.5 3.0 0.75 50.0 0.01 1 5 1.0 2.0 3.0 4.0 50.0 2 7 8 "
    "1.75 -2.0 0.25 1.5 -2.0 0.25 0.3 0.1 0.5 0.5 0.0 10.7 robot 0.7"
)


def fault_of(read, line: str, **options) -> str:
    with pytest.raises(FileFormatError) as caught:
        list(read([line], **options))
    assert caught.value.line == 1
    return str(caught.value)


class TestCarmen:
    def test_the_three_messages(self):
        odometry, flaser, robotlaser = read_carmen([ODOM, FLASER, ROBOTLASER])
        assert odometry == Odometry(10.5, [1.5, -2.0, 0.25])
        at, robot = [1.75, -2.0, 0.25], [1.5, -2.0, 0.25]
        angles = np.radians([-90.0, -45.0, 0.0, 45.0])
        assert flaser == Laser(10.6, [1.0, 2.5, 81.83, 0.5], angles, robot, at, 80.0)
        assert flaser.returned.tolist() == [True, True, False, True]
        angles = [-1.5, -0.75, 0.0, 0.75, 1.5]
        assert robotlaser == Laser(10.7, [1.0, 2.0, 3.0, 4.0, 50.0], angles, robot, at, 50.0)
        assert not robotlaser.returned[-1]
        # 25 cm ahead in the world's x, seen by a robot that heads elsewhere
        c, s = math.cos(0.25), math.sin(0.25)
        np.testing.assert_allclose(flaser.offset, [0.25 * c, -0.25 * s, 0.0], atol=1e-12)

    def test_records_cannot_be_changed(self):
        _, flaser, _ = read_carmen([ODOM, FLASER, ROBOTLASER])
        with pytest.raises(ValueError, match="read-only"):
            flaser.ranges[0] = 0.0
        given_ranges = np.array([1.0, 2.0])
        scan = Laser(0.0, given_ranges, [0.0, 0.1], [0.0, 0.0, 0.0])
        given_ranges[0] = 9.0
        assert scan.ranges[0] == 1.0

    def test_other_lines_are_counted(self):
        log = read_carmen(
            ["# c", "", "  ", "PARAM a b", "NMEA-GGA 1", "RLASER 1 2", "PARAM c d", ODOM]
        )
        assert len(list(log)) == 1 and log.faults == ()
        assert log.ignored == {"comment": 1, "blank": 2, "PARAM": 2, "NMEA-GGA": 1, "RLASER": 1}

    def test_messages_can_be_chosen(self):
        log = read_carmen([ODOM, FLASER, ROBOTLASER], messages=("FLASER",))
        assert [r.t for r in log] == [10.6]
        assert log.ignored == {"ODOM": 1, "ROBOTLASER1": 1}
        with pytest.raises(ValueError, match="give some of"):
            read_carmen([], messages=("LASER",))
        with pytest.raises(ValueError, match="give some of"):
            read_carmen([], messages="ODOM")

    @pytest.mark.parametrize(
        ("line", "why"),
        [
            (ODOM.rsplit(" ", 1)[0], "ODOM has 9 fields, not 10"),
            (ODOM + " 3", "ODOM has 11 fields, not 10"),
            ("ODO", "the name of the message is cut off ('ODO')"),
            ("odom 1 2 3", "does not begin with the name of a message"),
            ("1.5 -2.0 0.25", "does not begin with the name of a message"),
            (FLASER.replace("4 1.0", "5 1.0"), "FLASER of 5 beams has 15 fields, not 16"),
            (FLASER.replace("4 1.0", "3 1.0"), "FLASER of 3 beams has 15 fields, not 14"),
            (FLASER.replace("4 1.0", "x 1.0"), "field 2 is not a whole number ('x')"),
            (FLASER.replace("4 1.0", "-4 1.0"), "field 2 is not a whole number ('-4')"),
            ("FLASER", "breaks off before its number of beams"),
            ("FLASER 0 1 2 3 4 5 6 7 robot 8", "FLASER has no beams"),
            (FLASER.replace("2.5", "nan"), "field 4 is not finite (nan)"),
            (FLASER.replace("2.5", "inf"), "field 4 is not finite (inf)"),
            (FLASER.replace("2.5", "-2.5"), "range 2 is negative (-2.5)"),
            (FLASER.replace("1.75", "1.7.5"), "field 7 is not a number ('1.7.5')"),
            (FLASER.replace("10.6", "late"), "field 13 is not a number ('late')"),
            (ROBOTLASER.replace("4.0 50.0 2 7", "4.0 50.0 3 7"), "has 31 fields, not 32"),
            (
                " ".join(ROBOTLASER.split()[:13]),
                "ROBOTLASER1 of 5 beams breaks off after 13 fields",
            ),
            (ROBOTLASER.replace("0.75 50", "0 50"), "the angle between beams is not positive"),
            (ROBOTLASER.replace("0.75 50.0", "0.75 -1"), "the maximal range is not positive"),
            (ROBOTLASER.replace(" 7 8 ", " 7 a "), "field 17 is not a number ('a')"),
            (ROBOTLASER.replace("10.7", "nan"), "field 29 is not finite"),
        ],
    )
    def test_faults(self, line, why):
        assert why in fault_of(read_carmen, line)

    def test_bad_ranges_can_count_as_nothing_seen(self):
        line = FLASER.replace("1.0 2.5 81.83 0.5", "nan -1 inf 0.5")
        (scan,) = read_carmen([line], bad_ranges="max", max_range=20.0)
        assert scan.ranges.tolist() == [20.0, 20.0, 20.0, 0.5]
        assert scan.returned.tolist() == [False, False, False, True]
        assert "not a number" in fault_of(read_carmen, line.replace("nan", "x"), bad_ranges="max")
        with pytest.raises(ValueError, match="bad_ranges='drop'"):
            read_carmen([], bad_ranges="drop")
        with pytest.raises(ValueError, match="max_range=nan"):
            read_carmen([], max_range=math.nan)

    def test_angles_of_another_laser(self):
        (scan,) = read_carmen([FLASER], angles=[-0.3, -0.1, 0.1, 0.3])
        assert scan.angles.tolist() == [-0.3, -0.1, 0.1, 0.3]
        assert "of 4 beams, where 2 angles" in fault_of(read_carmen, FLASER, angles=[0.0, 1.0])
        with pytest.raises(ValueError, match="finite angles"):
            read_carmen([FLASER], angles=[0.0, math.nan, 0.0, 0.0])

    @pytest.mark.parametrize(
        ("beams", "last"), [(180, 89.0), (181, 90), (360, 89.5), (361, 90), (1, -90)]
    )
    def test_a_sick_looks_half_around(self, beams, last):
        degrees = np.degrees(sick_angles(beams))
        assert degrees.size == beams and degrees[0] == -90 and degrees[-1] == pytest.approx(last)


FINITE = st.floats(allow_nan=False, allow_infinity=False, min_value=-1e9, max_value=1e9)
RANGE = st.floats(min_value=0.0, max_value=100.0)
POSE = arrays(float, 3, elements=FINITE)


@st.composite
def scans(draw, t=0.0):
    beams = draw(st.integers(1, 40))
    angles = sick_angles(beams)
    max_range = MAX_RANGE
    if draw(st.booleans()):
        angles = draw(st.floats(-3, 3)) + draw(st.floats(1e-3, 0.1)) * np.arange(beams)
        max_range = draw(st.floats(1.0, 100.0))
    ranges = draw(arrays(float, beams, elements=RANGE))
    return Laser(t, ranges, angles, draw(POSE), draw(POSE), max_range)


def _without_angles(record):
    if not isinstance(record, Laser):
        return record
    return replace(record, angles=np.zeros(record.ranges.size))


class TestWriting:
    @given(st.lists(st.one_of(scans(), POSE.map(lambda p: Odometry(0.0, p))), max_size=4))
    def test_round_trip(self, tmp_path_factory, records):
        path = tmp_path_factory.getbasetemp() / "round_trip.log"
        write_carmen(path, [Odometry(0.0, [0.0, 0.0, 0.0]), *records])
        back = list(read_carmen(path))[1:]
        assert [_without_angles(r) for r in back] == [_without_angles(r) for r in records]
        for a, b in zip(back, records, strict=True):
            if isinstance(b, Laser):
                np.testing.assert_allclose(a.angles, b.angles, rtol=0, atol=1e-9)

    def test_gzipped_it_is_the_same_bytes_each_time(self, tmp_path):
        records = list(read_carmen([ODOM, FLASER, ROBOTLASER]))
        for name in ("a.log.gz", "b.log.gz"):
            write_carmen(tmp_path / name, records)
        a, b = (tmp_path / name for name in ("a.log.gz", "b.log.gz"))
        assert a.read_bytes() == b.read_bytes() and a.read_bytes()[:2] == b"\x1f\x8b"
        assert list(read_carmen(a)) == records

    def test_a_scan_that_a_flaser_states_is_one(self, tmp_path):
        write_carmen(tmp_path / "a.log", read_carmen([FLASER, ROBOTLASER]))
        lines = (tmp_path / "a.log").read_text().splitlines()
        assert [line.split()[0] for line in lines] == ["FLASER", "ROBOTLASER1"]

    def test_beams_spaced_by_linspace_are_a_sicks(self, tmp_path):
        scan = Laser(1.0, np.ones(181), np.linspace(-np.pi / 2, np.pi / 2, 181), [0.0, 0.0, 0.0])
        write_carmen(tmp_path / "a.log", [scan])
        assert (tmp_path / "a.log").read_text().startswith("FLASER 181 1.0 ")

    def test_nothing_is_written_unless_all_can_be(self, tmp_path):
        path = tmp_path / "a.log"
        path.write_text("precious")
        good = Odometry(0.0, [0.0, 0.0, 0.0])
        pose = [0.0, 0.0, 0.0]
        for bad, why in [
            (Laser(1.0, [math.nan], [0.0], pose), "record 1 is not fit to be written: field"),
            (Laser(1.0, [1.0, -1.0], [0.0, 0.1], pose), "range 2 is negative"),
            (Laser(1.0, [], [], pose), "no beams"),
            (Odometry(math.inf, pose), "not finite"),
            (Laser(1.0, [1.0] * 3, [0.0, 0.1, 0.5], pose), "beams that are not evenly spaced"),
        ]:
            with pytest.raises(FileFormatError, match=why):
                write_carmen(path, [good, bad])
        with pytest.raises(TypeError, match="record 0 is of type Velocity"):
            write_carmen(path, [Velocity(0.0, 1.0, 0.0)])
        with pytest.raises(ValueError, match="without blanks"):
            write_carmen(path, [good], host="my robot")
        assert path.read_text() == "precious"

    @pytest.mark.parametrize(
        ("times", "why"),
        [
            ([0.0, 2.0, 1.0, 3.0], "record 2 .*: time runs backwards by 1 s"),
            ([0.0, 1e6, 1.0], "record 1 .*: time leaps ahead by 999999 s"),
            ([1e6, 1.0, 2.0], "record 0 .*: time leaps ahead"),
            ([], "there are no records"),
        ],
    )
    def test_what_the_reader_would_refuse_is_not_written(self, tmp_path, times, why):
        path = tmp_path / "a.log"
        records = [Odometry(t, [0.0, 0.0, 0.0]) for t in times]
        with pytest.raises(FileFormatError, match=why):
            write_carmen(path, records)
        assert not path.exists()

    def test_times_run_back_where_the_reader_is_told(self, tmp_path):
        path = tmp_path / "a.log"
        records = [Odometry(t, [0.0, 0.0, 0.0]) for t in (0.0, 2.0, 1.5, 3.0)]
        for tolerance in (0.5, math.inf):
            write_carmen(path, records, tolerance=tolerance)
            assert list(read_carmen(path, tolerance=tolerance)) == records
        with pytest.raises(FileFormatError, match="runs backwards"):
            write_carmen(path, records, tolerance=0.4)
        with pytest.raises(ValueError, match="tolerance=nan"):
            write_carmen(path, records, tolerance=math.nan)

    def test_a_silence_is_no_leap(self, tmp_path):
        records = [Odometry(t, [0.0, 0.0, 0.0]) for t in (0.0, 1e6, 1e6 + 1.0)]
        write_carmen(tmp_path / "a.log", iter(records))
        assert list(read_carmen(tmp_path / "a.log")) == records


def test_angles_of_a_flaser_in_degrees_are_refused():
    with pytest.raises(
        ValueError, match=r"read_carmen: angles are in radians; got -90.*np\.deg2rad"
    ):
        read_carmen([FLASER], angles=[-90.0, 0.0])


@pytest.mark.parametrize(
    ("time", "reach", "message"),
    [
        (math.nan, 80.0, "t must be finite; got nan"),
        (math.inf, 80.0, "t must be finite"),
        (0.0, -1.0, "max_range must be positive; got -1"),
        (0.0, math.nan, "max_range must be positive; got nan"),
    ],
)
def test_scans_at_no_time_or_of_no_reach(time, reach, message):
    with pytest.raises(ParameterError, match=f"Laser: {message}"):
        Laser(time, [1.0], [0.0], [0.0, 0.0, 0.0], max_range=reach)


def test_wean():
    ranges = " ".join(["100"] * 179)
    scan, odometry = read_wean([f"L 100 -200 0.5 120 -210 0.5 8183 {ranges} 0.1", "O 10 20 -3 0.2"])
    np.testing.assert_allclose(scan.pose, [1.0, -2.0, 0.5])
    np.testing.assert_allclose(scan.laser_pose, [1.2, -2.1, 0.5])
    assert scan.ranges[0] == pytest.approx(81.83) and scan.ranges[1] == 1.0
    assert np.degrees(scan.angles[[0, 90]]).tolist() == [-90.0, 0.0]
    assert odometry == Odometry(0.2, [0.1, 0.2, -3.0])
    line = "L 0 0 0 0 0 0 nan 50 0.1"
    assert "field 8 is not finite" in fault_of(read_wean, line, beams=2)
    (scan,) = read_wean([line], beams=2, bad_ranges="max", max_range=81.91)
    assert scan.ranges.tolist() == [81.91, 0.5] and not scan.returned[0]
    with pytest.raises(ValueError, match="beams=0"):
        read_wean([], beams=0)


class TestMrclam:
    def folder(self, path: Path, **changed: str) -> Path:
        files = {
            "Barcodes": "# Subject Barcode\n 1 \t 5\n 2 \t 14\n 6 \t 63\n",
            "Landmark_Groundtruth": "# Subject x y sd sd\n 6 \t 0.5 \t -4.25 \t 0.01 \t 0.02\n",
            "Robot1_Odometry": "# t v w\n10.0 0.1 0.2\n10.1 0.1 0.0\n",
            "Robot1_Measurement": (
                "# t subject range bearing\n10.05 63 2.5 -0.1\n10.05 14 1.0 0.3\n10.06 77 3.0 0.0\n"
            ),
            "Robot1_Groundtruth": "# t x y theta\n10.0 1.0 2.0 3.0\n10.1 1.01 2.0 -3.1\n",
        } | changed
        for stem, text in files.items():
            if text:
                (path / f"{stem}.dat").write_text(text)
        return path

    def test_a_dataset(self, tmp_path):
        data = read_mrclam(self.folder(tmp_path))
        assert list(data.robots) == [1] and data.faults == {}
        assert data.barcodes == {5: 1, 14: 2, 63: 6}
        assert data.landmarks[6].tolist() == [0.5, -4.25]
        robot = data.robots[1]
        assert robot.velocities == (Velocity(10.0, 0.1, 0.2), Velocity(10.1, 0.1, 0.0))
        assert robot.measurements == (
            Measurement(10.05, 6, 2.5, -0.1),
            Measurement(10.05, 2, 1.0, 0.3),
            Measurement(10.06, UNKNOWN_SUBJECT, 3.0, 0.0),
        )
        assert robot.truth[1] == GroundTruth(10.1, [1.01, 2.0, -3.1])

    def test_faults_are_named_by_file(self, tmp_path):
        folder = self.folder(tmp_path, Robot1_Odometry="10.0 0.1 0.2\n10.1 0.1\n10.2 0.1 0.0")
        with pytest.raises(
            FileFormatError, match=r"Robot1_Odometry\.dat:2: a line of odometry has 2"
        ):
            read_mrclam(folder)
        with pytest.warns(LogWarning, match="1 of 3 lines"):
            data = read_mrclam(folder, on_error="skip")
        assert [f.line for f in data.faults["Robot1_Odometry.dat"]] == [2]
        assert len(data.robots[1].velocities) == 2

    def test_missing_files(self, tmp_path):
        folder = self.folder(tmp_path, Robot1_Groundtruth="")
        with pytest.raises(FileNotFoundError, match=r"neither Robot1_Groundtruth\.dat nor"):
            read_mrclam(folder)
        with pytest.raises(FileNotFoundError, match="Robot4_Odometry"):
            read_mrclam(folder, robots=[4])
        assert read_mrclam(folder, robots=[]).robots == {}

    def test_two_subjects_with_one_barcode(self, tmp_path):
        with pytest.raises(FileFormatError, match="barcode 5 is worn by subjects 1 and 2"):
            read_mrclam(self.folder(tmp_path, Barcodes="1 5\n2 5\n"))

    def test_lines(self):
        assert list(read_mrclam_barcodes(["1 5"])) == [Barcode(1, 5)]
        assert list(read_mrclam_landmarks(["6 1 2 0.1 0.2"])) == [Landmark(6, [1, 2], [0.1, 0.2])]
        read = lambda lines, **o: read_mrclam_measurements(lines, {63: 6}, **o)  # noqa: E731
        assert "the range is negative (-1)" in fault_of(read, "1 63 -1 0")
        assert "field 2 is not a whole number ('6.5')" in fault_of(read, "1 6.5 1 0")
        assert "field 4 is not finite" in fault_of(read, "1 63 1 nan")
        assert "a measurement has 3 fields, not 4" in fault_of(read, "1 63 1")


class TestPlaza:
    def folder(self, path: Path, **tables) -> Path:
        from scipy.io import savemat

        (path / "P_DR.txt").write_bytes(
            b"  1.0e+000\t  2.0e-001\t -1.0e-002\t\r\n  1.2 0.2 0.0\r\n"
        )
        (path / "P_TD.txt").write_bytes(b"1.5 2 5 60.5\t\r\n1.1 2 0.0e+000 30.5\r\n")
        content = {
            "TL": [[0, 1.5, 2.5], [5, -3.5, 4.5]],
            "GT": [[1.0, 0.0, 0.5, 4.0], [2.0, 1.0, 0.5, 4.1]],
        }
        savemat(path / "P_.mat", {k: v for k, v in (content | tables).items() if v is not None})
        return path

    def test_a_drive(self, tmp_path):
        drive = read_plaza(self.folder(tmp_path), "P")
        assert drive.increments == (Increment(1.0, 0.2, -0.01), Increment(1.2, 0.2, 0.0))
        assert drive.ranges == (RangeOnly(1.1, 0, 30.5), RangeOnly(1.5, 5, 60.5)), "sorted"
        assert {k: v.tolist() for k, v in drive.beacons.items()} == {0: [1.5, 2.5], 5: [-3.5, 4.5]}
        assert drive.truth[1] == GroundTruth(2.0, [1.0, 0.5, 4.1]) and drive.faults == {}

    @pytest.mark.parametrize(
        ("tables", "why"),
        [
            ({"TL": None}, "needs a table TL of 3 columns"),
            ({"GT": [[1.0, 2.0]]}, "needs a table GT of 4 columns"),
            ({"TL": [[0, math.nan, 1]]}, "the table TL holds what are no finite numbers"),
            ({"GT": [["a", "b", "c", "d"]]}, "table GT"),
        ],
    )
    def test_tables(self, tmp_path, tables, why):
        with pytest.raises(FileFormatError, match=why):
            read_plaza(self.folder(tmp_path, **tables), "P")

    def test_a_mat_file_that_is_none(self, tmp_path):
        folder = self.folder(tmp_path)
        path = folder / "P_.mat"
        whole = path.read_bytes()
        for data in (b"", b"garbage" * 50, whole[: len(whole) // 2], whole[:200]):
            path.write_bytes(data)
            with pytest.raises(FileFormatError, match=r"P_\.mat: "):
                read_plaza(folder, "P")
        path.unlink()
        with pytest.raises(FileNotFoundError):
            read_plaza(folder, "P")

    def test_faults(self, tmp_path):
        assert "has 2 fields, not 3" in fault_of(read_plaza_increments, "1 2")
        assert "not the number of a beacon" in fault_of(read_plaza_ranges, "1 2 0.5 60")
        assert "the range is negative" in fault_of(read_plaza_ranges, "1 2 5 -60")
        folder = self.folder(tmp_path)
        with open(folder / "P_TD.txt", "a") as file:
            file.write("1.6 2 5")
        with pytest.warns(LogWarning):
            drive = read_plaza(folder, "P", on_error="skip")
        assert [f.line for f in drive.faults["P_TD.txt"]] == [3] and len(drive.ranges) == 2


def test_freiburg():
    lines = ["SENSOR 2 1.0 0.1", "ODOMETRY 0.1 1.0 -0.1", "SENSOR 1 2.0 0.5", "", "ODOMETRY 0 1 0"]
    assert list(read_freiburg(lines)) == [
        Measurement(0.0, 2, 1.0, 0.1),
        RotTransRot(1.0, 0.1, 1.0, -0.1),
        Measurement(1.0, 1, 2.0, 0.5),
        RotTransRot(2.0, 0.0, 1.0, 0.0),
    ]
    lines[1] = "ODOMETRY 0.1 1.0 -0."[:14]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LogWarning)
        assert [r.t for r in read_freiburg(lines, on_error="skip")] == [0.0, 1.0, 2.0]
    assert "neither ODOMETRY nor SENSOR" in fault_of(read_freiburg, "SENSO 1 2 3")
    assert "field 2 is not a whole number" in fault_of(read_freiburg, "SENSOR 1.5 2 3")
    world = read_freiburg_world(["1 2 1", "", "2 0.5 4"])
    assert {k: v.tolist() for k, v in world.items()} == {1: [2.0, 1.0], 2: [0.5, 4.0]}
    with pytest.raises(FileFormatError, match="<lines>:2: a landmark has 2 fields"):
        read_freiburg_world(["1 2 1", "2 0"])


def test_records_say_what_shape_is_wrong():
    with pytest.raises(ShapeError, match="2 ranges and 1 angles"):
        Laser(0.0, [1.0, 2.0], [0.0], [0.0, 0.0, 0.0])
    with pytest.raises(ShapeError, match="Odometry: pose has shape \\(2,\\); give 3 numbers"):
        Odometry(0.0, [0.0, 0.0])
    with pytest.raises(ShapeError, match="Laser: ranges has shape \\(1, 1\\); give a vector"):
        Laser(0.0, [[1.0]], [0.0], [0.0, 0.0, 0.0])
