"""The one loop of all readers: every kind of fault, in every kind of source, and what is kept."""

from __future__ import annotations

import gzip
import io
import math
import os
import threading
import warnings
from pathlib import Path

import numpy as np
import pytest

from bayesmc.errors import FileFormatError, LogWarning
from bayesmc.robotics.logs import (
    Odometry,
    read_carmen,
    read_mrclam_velocities,
    read_wean,
)
from bayesmc.robotics.logs.reading import floats, numbers, whole
from bayesmc.robotics.logs.sources import LONGEST_LINE

GOOD = [f"O {100 * k} 0 0 {0.1 * k:.1f}" for k in range(6)]


def skipped(source, read=read_wean, **options):
    """Records and the exhausted reader, with its one warning of faults, or its error where no line read."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        log = read(source, on_error="skip", **options)
        try:
            records = list(log)
        except FileFormatError as error:
            assert "no line reads" in str(error) and not log.records and not caught
            assert list(log) == [], "no second error"
            return [], log
    assert log.lines == len(records) + len(log.faults) + sum(log.ignored.values())
    assert log.records == len(records)
    assert [w.category for w in caught] == [LogWarning] * bool(log.faults)
    return records, log


def with_line(bad: str, place: int = 3) -> list[str]:
    return [*GOOD[:place], bad, *GOOD[place:]]


@pytest.mark.parametrize(
    ("bad", "why"),
    [
        ("O 1 2", "O has 3 fields, not 5"),
        ("O 1 2 0 0.25 7", "O has 6 fields, not 5"),
        ("O 1 x 0 0.25", "field 3 is not a number ('x')"),
        ("O 1 2 nan 0.25", "field 4 is not finite (nan)"),
        ("O 1 2 0 inf", "field 5 is not finite (inf)"),
        ("O 1 2 0 1e999", "field 5 is not finite (1e999)"),
        ("O 1_0 2 0 0.25", "field 2 is not a number ('1_0')"),
        ("O \u0661 2 0 0.25", "field 2 is not a number"),  # an Arabic 1, which float() takes
        ("O 1 2 0 0.05", "time runs backwards by 0.15 s"),
        ("O 1 2 0 9e9", "time leaps ahead by 9e+09 s"),
        ("\x00\x07\x1b[2J", "the line begins with neither O nor L"),
        ("L 1 2 0 1 2 0 5 5 5", "L of 180 beams has 10 fields, not 188"),
    ],
)
def test_a_bad_line_is_skipped_with_its_number_and_reason_or_raised(bad, why):
    records, log = skipped(with_line(bad))
    assert records == list(read_wean(GOOD))
    (fault,) = log.faults
    assert (fault.line, fault.text) == (4, bad)
    assert fault.why.startswith(why)

    log = read_wean(with_line(bad))
    kept = []
    with pytest.raises(FileFormatError) as caught:
        kept.extend(log)  # extend keeps what came before the error
    assert caught.value.line == 4 and caught.value.path == "<lines>"
    assert why in str(caught.value) and "on_error='skip'" in str(caught.value)
    assert kept == records[:3]
    assert list(log) == records[3:], "the iterator can be asked on"


def test_a_good_log_has_no_faults_and_no_warning():
    records, log = skipped(GOOD)
    assert len(records) == 6 and log.faults == () and "6 records" in repr(log)


def test_the_warning_comes_once_at_the_end_and_points_to_the_caller():
    log = read_wean(["O x", *GOOD, "garbage"], on_error="skip")
    for _ in range(6):
        next(log)  # warnings are errors in these tests
    with pytest.warns(
        LogWarning, match=r"2 of 8 lines were skipped, the first at line 1: O has 2"
    ) as w:
        assert list(log) == []
    assert [v.filename for v in w] == [__file__]
    assert list(log) == [], "and no second warning"


@pytest.mark.parametrize(
    ("lines", "read", "kind"),
    [
        (["O x y", "", "# comment", "P 1 2"], read_wean, "a Wean Hall log"),
        (GOOD, read_carmen, "a CARMEN log"),
        (["\x00\x01\x02"] * 300, read_carmen, "a CARMEN log"),
        (GOOD, read_mrclam_velocities, "a table of MRCLAM"),
    ],
)
def test_a_log_of_another_kind_is_an_error_in_both_modes(lines, read, kind):
    log = read(lines, on_error="skip")
    with pytest.raises(FileFormatError, match=f"no line reads.*is this {kind}\\?"):
        list(log)
    assert log.lines == len(lines) and log.records == 0 and list(log) == []
    with pytest.raises(FileFormatError, match=f"<lines>:1: .*is this {kind}\\?") as caught:
        list(read(lines))
    assert "on_error" not in str(caught.value)


def test_skipping_is_advised_where_lines_after_the_fault_read():
    with pytest.raises(FileFormatError, match="on_error='skip' leaves such lines out") as caught:
        list(read_wean(["garbage", *GOOD]))
    assert "is this" not in str(caught.value)
    log = read_wean(["garbage", *GOOD])
    with pytest.raises(FileFormatError):
        next(log)
    assert len(list(log)) == 6, "nothing that was looked at is lost"


def test_a_log_of_wean_hall_names_its_reader():
    scan = "L 1 2 0 1 2 0 " + "5 " * 180 + "0.5"
    for line in (GOOD[1], scan):
        with pytest.raises(FileFormatError, match="Wean Hall log, which read_wean reads"):
            list(read_carmen([line]))
    with pytest.raises(FileFormatError, match=r"cut off \('O'\)"):
        list(read_carmen(["O"]))


def test_records_before_the_error_are_all_handed_out():
    # the first record waits for a second time to confirm its own
    log = read_wean([GOOD[0], "garbage"])
    assert next(log).t == 0.0
    with pytest.raises(FileFormatError, match="<lines>:2: "):
        next(log)


class TestTime:
    def lines(self, *times):
        return [f"O 0 0 0 {t}" for t in times]

    def kept(self, *times, **options):
        records, log = skipped(self.lines(*times), **options)
        return [r.t for r in records], [f.line for f in log.faults]

    def test_backwards_is_a_fault_beyond_the_tolerance(self):
        assert self.kept(0, 1, 0.7, 2) == ([0, 1, 2], [3])
        assert self.kept(0, 1, 0.7, 2, tolerance=0.3) == ([0, 1, 0.7, 2], [])
        assert self.kept(0, 1, 0.7, 2, tolerance=0.29) == ([0, 1, 2], [3])

    def test_equal_times_are_in_order(self):
        assert self.kept(0, 0, 1, 1) == ([0, 0, 1, 1], [])

    def test_the_tolerance_counts_from_the_latest_time_and_does_not_creep(self):
        assert self.kept(1, 0.8, 0.6, 0.4, tolerance=0.3) == ([1, 0.8], [3, 4])

    def test_any_order_goes_with_an_infinite_tolerance(self):
        times = [5, 1e9, -3, 4, 0]
        assert self.kept(*times, tolerance=math.inf) == (times, [])

    def test_one_time_far_ahead_does_not_condemn_the_rest(self):
        assert self.kept(0, 1, 1e12, 2, 3, 4) == ([0, 1, 2, 3, 4], [3])
        assert self.kept(1e12, 2, 3, 4) == ([2, 3, 4], [1])
        assert self.kept(0, 1, 1e12, 1e6, 2, 3) == ([0, 1, 2, 3], [3, 4])

    def test_a_gap_is_no_fault(self):
        assert self.kept(0, 1, 5000, 5001, 5000.5, 5002) == ([0, 1, 5000, 5001, 5002], [5])
        assert self.kept(0, 1000, 2000, 3000) == ([0, 1000, 2000, 3000], [])
        assert self.kept(0, 1, 5000) == ([0, 1, 5000], [])

    def test_what_comes_between_keeps_its_place(self):
        lines = self.lines(0, 1, 5000)
        lines += ["# hm", "garbage", *self.lines(0.5, 5001)]
        records, log = skipped(lines)
        assert [r.t for r in records] == [0, 1, 5000, 5001]
        assert [f.line for f in log.faults] == [5, 6]

    def test_nan_is_no_tolerance(self):
        with pytest.raises(ValueError, match=r"tolerance=nan: give seconds"):
            read_wean([], tolerance=math.nan)


class TestSources:
    """The same lines out of everything that lines come in."""

    def read(self, source):
        assert [r.t for r in read_wean(source)] == [pytest.approx(0.1 * k) for k in range(6)]

    def test_paths(self, tmp_path):
        for end in ("\n", "\r\n", "\r"):
            for packed in (False, True):
                data = end.join(GOOD).encode()  # no end after the last
                path = tmp_path / "a.log"  # what it is called does not matter
                path.write_bytes(gzip.compress(data) if packed else data)
                self.read(path)
                self.read(str(path))

    def test_byte_order_mark(self, tmp_path):
        path = tmp_path / "a.log"
        path.write_bytes(b"\xef\xbb\xbf" + "\n".join(GOOD).encode())
        self.read(path)
        self.read(["\ufeff" + GOOD[0], *GOOD[1:]])

    def test_streams_and_iterables(self, tmp_path):
        path = tmp_path / "a.log"
        path.write_text("\n".join(GOOD))
        with open(path) as text:
            self.read(text)
        with open(path, "rb") as data:
            self.read(data)
            assert not data.closed, "who opened it closes it"
        self.read(io.StringIO("\r\n".join(GOOD)))
        self.read(line for line in GOOD)
        self.read([line.encode() for line in GOOD])

    def test_members_of_a_gzip_in_a_row_and_padding(self, tmp_path):
        path = tmp_path / "a.gz"
        data = [("\n".join(part) + "\n").encode() for part in (GOOD[:2], GOOD[2:])]
        path.write_bytes(b"".join(map(gzip.compress, data)) + b"\0" * 512)
        self.read(path)
        path.write_bytes(gzip.compress(data[0]) + b"\0" * 40_000 + gzip.compress(data[1]))
        self.read(path)
        lines = [gzip.compress((line + "\n").encode()) for line in GOOD]
        path.write_bytes(b"".join(lines))
        self.read(path)
        path.write_bytes(b"".join(lines) + b"\x1f")
        assert len(skipped(path)[0]) == 6 and len(skipped(path)[1].faults) == 1

    def test_a_file_that_is_not_read_is_not_left_open(self, tmp_path):
        path = tmp_path / "a.log"
        path.write_text("\n".join(GOOD))
        read_wean(path)
        next(iter(read_wean(path)))  # a ResourceWarning is an error here

    @pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
    def test_a_pipe_is_opened_once(self, tmp_path):
        path = tmp_path / "pipe"
        os.mkfifo(path)
        log = read_wean(path)
        writer = threading.Thread(target=path.write_text, args=("\n".join(GOOD),))
        writer.start()
        assert len(list(log)) == 6
        writer.join()

    def test_missing_and_wrong(self, tmp_path):
        with pytest.raises(FileNotFoundError):
            read_wean(tmp_path / "no.log")
        with pytest.raises(IsADirectoryError):
            read_wean(tmp_path)
        with pytest.raises(FileFormatError, match=r"pass text\.splitlines\(\)"):
            read_wean("\n".join(GOOD))
        with pytest.raises(TypeError, match="int is no log"):
            read_wean(7)
        with pytest.raises(TypeError, match="bytes is no log"):
            read_wean(b"O 0 0 0 0")
        with pytest.raises(TypeError, match="line 2 is of type int"):
            list(read_wean(["O 0 0 0 0", 3]))
        with pytest.raises(ValueError, match="on_error='ignore'"):
            read_wean([], on_error="ignore")

    @pytest.mark.parametrize("encoding", ["utf-16", "utf-32"])
    def test_wide_characters_are_refused_at_once(self, tmp_path, encoding):
        path = tmp_path / "a.log"
        path.write_text("\n".join(GOOD), encoding=encoding)
        with pytest.raises(FileFormatError, match="save it as UTF-8"):
            read_wean(path, on_error="skip")

    def test_latin_1_harms_only_the_fields_it_is_in(self, tmp_path):
        path = tmp_path / "a.log"
        path.write_text("\n".join(["# Büro", *GOOD, "O 1ä 0 0 0.7"]), encoding="latin-1")
        records, log = skipped(path)
        assert len(records) == 6
        assert dict(log.ignored) == {"comment": 1} and [f.line for f in log.faults] == [8]

    def test_a_stream_that_cannot_be_decoded_keeps_what_came_before(self, tmp_path):
        path = tmp_path / "a.log"
        path.write_bytes(("\n".join(GOOD) + "\n").encode() * 3000 + b"\xff\xfe\n")
        with open(path, encoding="utf-8") as text:
            records, log = skipped(text, tolerance=math.inf)
        assert len(records) > 10_000 and "breaks off" in log.faults[-1].why

    def test_empty(self, tmp_path):
        path = tmp_path / "empty.log"
        for data in (b"", gzip.compress(b"")):
            path.write_bytes(data)
            with pytest.raises(FileFormatError, match=r"empty\.log:1: the file is empty") as caught:
                list(read_wean(path))
            assert "is this a Wean Hall log?" in str(caught.value)
            assert "on_error='skip'" not in str(caught.value), "which would not help"
            with pytest.raises(FileFormatError, match="no line reads, .* is this a Wean Hall log"):
                list(read_wean(path, on_error="skip"))
            assert skipped(path)[0] == []
        assert skipped([])[1].faults[0].why == "there is no line"

    def test_a_line_without_end(self, tmp_path):
        path = tmp_path / "a.log"
        path.write_bytes(
            (GOOD[0] + "\n").encode() + b"x" * (3 * LONGEST_LINE) + b"\n" + GOOD[1].encode()
        )
        records, log = skipped(path)
        assert len(records) == 2 and len(log.faults[0].text) == 200
        assert (log.faults[0].line, log.faults[0].why[:19]) == (2, "the line is longer ")

    def test_random_bytes(self, tmp_path):
        path = tmp_path / "noise"
        path.write_bytes(np.random.default_rng(6).bytes(200_000))
        for read in (read_wean, read_carmen, read_mrclam_velocities):
            records, log = skipped(path, read)
            assert records == [] and len(log.faults) > 500


class TestDamagedGzip:
    lines = [f"O {k} 0 0 {k}.25" for k in range(400)]
    data = gzip.compress(("\n".join(lines) + "\n").encode(), mtime=0)

    def damaged(self, tmp_path: Path, data: bytes):
        path = tmp_path / "a.log.gz"
        path.write_bytes(data)
        return skipped(path)

    def test_cut_off_anywhere_it_gives_all_whole_lines_and_one_fault(self, tmp_path):
        clean = list(read_wean(self.lines))
        lengths = []
        for cut in range(2, len(self.data), 11):
            records, log = self.damaged(tmp_path, self.data[:cut])
            assert records == clean[: len(records)]
            assert [f.why for f in log.faults] == ["the gzip stream is cut off"]
            assert log.faults[0].line == len(records) + 1
            lengths.append(len(records))
        assert lengths == sorted(lengths) and lengths[0] == 0 and lengths[-1] > 390

    def test_a_number_cut_in_half_is_not_taken_for_one(self, tmp_path):
        for cut in range(len(self.data) // 2, len(self.data) - 8, 5):
            records, _ = self.damaged(tmp_path, self.data[:cut])
            assert all(r.t % 1 == 0.25 for r in records)

    def test_bytes_changed_on_the_way(self, tmp_path):
        kept = []
        for place in [
            *range(10, len(self.data) - 8, 23),
            *range(len(self.data) - 8, len(self.data)),
        ]:
            data = bytearray(self.data)
            data[place] ^= 0x55
            records, log = self.damaged(tmp_path, bytes(data))
            assert log.faults, "at least the checksum finds it"
            kept.append(len(records))
        assert min(kept[-8:]) == 400, "a wrong checksum loses no line"
        assert min(kept) < 100 < max(kept)

    def test_rubbish_after_the_end(self, tmp_path):
        records, log = self.damaged(tmp_path, self.data + b"rubbish")
        assert len(records) == 400
        assert [f.why for f in log.faults] == ["the gzip stream is followed by other bytes"]

    def test_a_wrong_checksum_is_raised_at_the_end(self, tmp_path):
        path = tmp_path / "a.log.gz"
        path.write_bytes(self.data[:-8] + b"12345678")
        kept = []
        with pytest.raises(FileFormatError, match=r"a\.log\.gz:401: .*incorrect data check"):
            kept.extend(read_wean(path))
        assert len(kept) == 400

    def test_a_gzip_opened_by_the_user(self, tmp_path):
        path = tmp_path / "a.log.gz"
        path.write_bytes(self.data[:-30])
        with gzip.open(path, "rt") as text:
            _, log = skipped(text)
        assert "give the path instead" in log.faults[-1].why


def test_numbers():
    assert numbers(["1", "-2.5e3", "+.5"]) == [1.0, -2500.0, 0.5]
    assert numbers(["1e308", "1e308"]) == [1e308, 1e308]  # their sum is not finite
    assert numbers([]) == []
    assert floats(["nan", "inf"])[1] == math.inf
    assert whole("007", 1) == 7
    for wrong in ("-1", "1.0", "\u0663", "", "1_0", "9" * 5000):
        with pytest.raises(FileFormatError, match="field 4 is not a whole number"):
            whole(wrong, 4)


def test_a_record_is_equal_where_its_values_are():
    a = Odometry(0.0, [1.0, 2.0, math.nan])
    assert a == Odometry(0.0, [1.0, 2.0, math.nan])
    assert a != Odometry(0.0, [1.0, 2.5, math.nan]) and a != (0.0, [1.0, 2.0, math.nan])
