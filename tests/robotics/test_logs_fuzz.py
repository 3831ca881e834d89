"""Mangled logs: nothing but the documented error, every line accounted for, sound lines untouched."""

from __future__ import annotations

import gzip
import math
import warnings

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bayesmc.errors import FileFormatError, LogWarning
from bayesmc.robotics.logs import (
    read_carmen,
    read_freiburg,
    read_mrclam_barcodes,
    read_mrclam_landmarks,
    read_mrclam_measurements,
    read_mrclam_truth,
    read_mrclam_velocities,
    read_plaza_increments,
    read_plaza_ranges,
    read_wean,
)
from bayesmc.testing import session

FORMATS = {
    "carmen": (
        read_carmen,
        [
            "# comment",
            "PARAM robot_length 0.4",
            "ODOM 1.5 -2.0 0.25 0.3 0.1 0.0 {t} robot 0.5",
            "FLASER 4 1.0 2.5 81.83 0.5 1.75 -2.0 0.25 1.5 -2.0 0.25 {t} robot 0.6",
            "ROBOTLASER1 0 -1.5 3.0 0.75 50.0 0.01 1 3 1.0 2.0 3.0 1 7 "
            "1.75 -2.0 0.25 1.5 -2.0 0.25 0.3 0.1 0.5 0.5 0.0 {t} robot 0.7",
        ],
    ),
    "wean": (
        lambda lines, **o: read_wean(lines, beams=3, **o),
        ["O -94.2 -139.9 -1.34 {t}", "L -94.2 -139.9 -1.34 -88.5 -164.3 -1.34 66 67 8183 {t}"],
    ),
    "velocities": (read_mrclam_velocities, ["# Time v w", "{t} \t 0.086 \t -0.398"]),
    "measurements": (
        lambda lines, **o: read_mrclam_measurements(lines, {61: 14}, **o),
        ["{t} \t 61 \t 6.6 \t -0.022", "{t} 9 1.1 0.4"],
    ),
    "truth": (read_mrclam_truth, ["{t} \t 1.41 \t -3.89 \t 2.2696"]),
    "landmarks": (read_mrclam_landmarks, ["6 0.588 -4.28 0.00004 0.0002"]),
    "barcodes": (read_mrclam_barcodes, ["  1 \t   5", "# Subject"]),
    "increments": (read_plaza_increments, ["  {t}\t  2.3e-004\t -5.2e-005\t"]),
    "ranges": (read_plaza_ranges, ["  {t}\t  2.0e+000\t  5.0e+000\t  6.5e+001\t"]),
    "freiburg": (read_freiburg, ["ODOMETRY 0.1 0.1 0.0001", "SENSOR 1 1.89 0.37"]),
}
TIMED = [name for name, (_, lines) in FORMATS.items() if any("{t}" in line for line in lines)]
UNTOLD = {"landmarks", "barcodes", "freiburg"}  # these take no tolerance

NASTY = st.sampled_from(
    ["nan", "inf", "-inf", "-1", "0", "1e400", "1e308", "1_0", "\u0661", "", "0x1F", "999999999999",
     "9" * 400, "#", "FLASER", "--1", "1,5", "\x00", "\ufffd", "True", "1e", "\u00a0", "\x1c", "ODOM"]
)  # fmt: skip


@st.composite
def mangled(draw, line: str) -> str:
    """The line after an accident or two."""
    for _ in range(draw(st.integers(1, 2))):
        kind = draw(st.sampled_from(["cut", "drop", "insert", "field", "double", "any"]))
        k = draw(st.integers(0, len(line)))
        if kind == "cut":
            line = line[:k]
        elif kind == "drop":
            line = line[:k] + line[k + 1 :]
        elif kind == "insert":
            line = line[:k] + draw(st.characters(exclude_characters="\n\r")) + line[k:]
        elif kind == "field":
            fields = line.split(" ")
            fields[k % len(fields)] = draw(NASTY)
            line = " ".join(fields)
        elif kind == "double":
            line = line[k:] + line
        else:
            line = draw(st.text(st.characters(exclude_characters="\n\r"), max_size=60))
    return line


@st.composite
def logs(draw, name: str):
    """Lines of the format, and which of them were mangled."""
    patterns = FORMATS[name][1]
    lines, bad = [], []
    for k in range(draw(st.integers(1, 12))):
        line = draw(st.sampled_from(patterns)).replace("{t}", f"{10 + k / 8:.3f}")
        is_bad = draw(st.booleans())
        lines.append(draw(mangled(line)) if is_bad else line)
        bad.append(is_bad)
    return lines, bad


def read_all(log):
    """All records of a reader that raises, asked on after each error; and the lines of the errors."""
    records, lines = [], []
    while True:
        try:
            records.append(next(log))
        except StopIteration:
            return records, lines
        except FileFormatError as error:
            lines.append(error.line)


def quiet(log):
    """All records; none where no line reads, which is an error also where faults are skipped."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LogWarning)
        try:
            return list(log)
        except FileFormatError as error:
            assert "no line reads" in str(error) and log.faults and not log.records
            return []


@pytest.mark.parametrize("name", FORMATS)
@settings(max_examples=session.scaled(60, 5))
@given(data=st.data())
def test_every_line_is_accounted_for_and_both_modes_agree(name, data):
    read = FORMATS[name][0]
    lines, _ = data.draw(logs(name))
    log = read(lines, on_error="skip")
    records = quiet(log)
    assert len(records) + len(log.faults) + sum(log.ignored.values()) == len(lines) == log.lines
    numbers = [fault.line for fault in log.faults]
    assert len(set(numbers)) == len(numbers) and all(1 <= n <= len(lines) for n in numbers)
    assert all(lines[f.line - 1].startswith(f.text[:50].rstrip("\r\n")) for f in log.faults)
    assert read_all(read(lines)) == (records, numbers)


@pytest.mark.parametrize("name", sorted(set(FORMATS) - {"freiburg"}))
@settings(max_examples=session.scaled(40, 5))
@given(data=st.data())
def test_sound_lines_read_as_if_they_were_alone(name, data):
    read = FORMATS[name][0]
    options = {} if name in UNTOLD else {"tolerance": math.inf}
    lines, bad = data.draw(logs(name))
    sound = [line for line, is_bad in zip(lines, bad, strict=True) if not is_bad]
    records = quiet(read(lines, on_error="skip", **options))
    remaining = iter(records)
    # those of the sound lines come in their order among what mangled lines gave by luck
    for expected in quiet(read(sound, on_error="skip", **options)):
        assert any(record == expected for record in remaining)


@pytest.mark.parametrize("name", TIMED)
@settings(max_examples=session.scaled(30, 5))
@given(
    place=st.integers(0, 39),
    wrong=st.floats(allow_nan=False, allow_infinity=False),
    step=st.sampled_from([1.0, 20.0, 70.0]),
)
def test_one_wrong_time_costs_little(name, place, wrong, step):
    """At most the lines of one minute, and the line itself, whatever the time."""
    read, patterns = FORMATS[name]
    pattern = next(line for line in patterns if "{t}" in line)
    times = [step * k for k in range(40)]
    times[place] = wrong
    log = read([pattern.replace("{t}", repr(t)) for t in times], on_error="skip", tolerance=0.0)
    quiet(log)
    assert len(log.faults) <= 1 + 60.0 / step


@settings(max_examples=session.scaled(60, 5))
@given(st.binary(max_size=400), st.booleans(), st.integers(0, 400))
def test_any_bytes_in_a_file(tmp_path_factory, data, packed, cut):
    path = tmp_path_factory.getbasetemp() / "fuzz.log"
    path.write_bytes(gzip.compress(data)[: cut + 2] if packed else data)
    for read in (read_carmen, read_mrclam_truth, read_plaza_ranges):
        try:
            log = read(path, on_error="skip")
        except FileFormatError as error:
            assert "UTF-16" in str(error)
            continue
        records = quiet(log)
        assert log.lines == len(records) + len(log.faults) + sum(log.ignored.values()) > 0
