"""Data files of JAGS, BUGS, R and Stan."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import FileFormatError
from bayesmc.io.rdump import parse_rdump


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("N <- 3", {"N": 3}),
        ("`N` <-\n3L; 'x' = -2.5e-1", {"N": 3, "x": -0.25}),
        ("y <- c(1, NA, -Inf, 2)  # rain", {"y": [1, np.nan, -np.inf, 2]}),
        ("y <- 3:1\nz <- c(1:3, 7, c(8, 9))", {"y": [3, 2, 1], "z": [1, 2, 3, 7, 8, 9]}),
        ("y <- -2:2", {"y": [-2, -1, 0, 1, 2]}),
        ("y <- structure(c(1,2,3,4,5,6), .Dim = c(2L, 3L))", {"y": [[1, 3, 5], [2, 4, 6]]}),
        ("y <- structure(.Data = c(1,2,3,4,5,6), .Dim = c(2, 3))", {"y": [[1, 3, 5], [2, 4, 6]]}),
        ("list(N=2, y=structure(.Data=c(1,2,3,4,5,6), .Dim=c(2,3)))", {"N": 2, "y": [[1, 2, 3], [4, 5, 6]]}),
        ("list(y = structure(c(1,2,3,4), .Dim = c(2,2)))", {"y": [[1, 3], [2, 4]]}),
        ("none <- integer(0)\nzeros <- numeric(2)", {"none": [], "zeros": [0.0, 0.0]}),
        ("is <- c(TRUE, FALSE)", {"is": [True, False]}),
        ("y <- structure(c(1,2,3,4), .Dim = as.integer(c(2, 2)))", {"y": [[1, 3], [2, 4]]}),
        ("y <- as.double(c(NA, 2L))", {"y": [np.nan, 2]}),
        ("y <- as.integer(c(-1.7, NA, 2.9))", {"y": [-1, np.nan, 2]}),
        ("y <- as.logical(c(0, 3, NA))\nnone <- logical(0)", {"y": [0, 1, np.nan], "none": []}),
        ("y <- as.vector(structure(1:4, dim = c(2L, 2L)))", {"y": [1, 2, 3, 4]}),
        ("y <- c(structure(1:4, dim = c(2L, 2L)), NA_integer_)", {"y": [1, 2, 3, 4, np.nan]}),
        ('y <- structure(c(2L, 1L), .Label = c("a, (b", "c"), class = "factor")', {"y": [2, 1]}),
        ('y <- structure(c(2L, 1L), levels = c("a", "b"), class = "factor")', {"y": [2, 1]}),
        ('y <- c(a = 1, "b c" = 2)\nz <- structure(1:2, .Names = c("a", "b"))', {"y": [1, 2], "z": [1, 2]}),
        ('y <- structure(1:4, .Dim = 4L, .Dimnames = list(c("a", "b", "c", "d")))', {"y": [1, 2, 3, 4]}),
        ('y <- structure(1:4, dim = c(2, 2), dimnames = list(NULL, NULL))', {"y": [[1, 3], [2, 4]]}),
        ("", {}),
    ],
)  # fmt: skip
def test_numbers_of_r(text: str, wanted: dict) -> None:
    found = parse_rdump(text)
    assert list(found) == list(wanted)
    for name, value in wanted.items():
        np.testing.assert_array_equal(found[name], value)
    assert all(a.dtype.kind in "ib" for n, a in found.items() if n in ("N", "none", "is"))


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        (
            "rc <- c(2, 23)\ny <- matrix(rep(rc, each=2), nrow=2, ncol=2)",
            {"rc": [2, 23], "y": [[2, 23], [2, 23]]},
        ),
        ("T <- 3\ny <- rep(0, T)\nz <- 1:T", {"T": 3, "y": [0, 0, 0], "z": [1, 2, 3]}),
        (
            "y <- rep(c(1, 2), times = c(2, 1))\nz <- rep(1:2, length.out = 3)",
            {"y": [1, 1, 2], "z": [1, 2, 1]},
        ),
        (
            "y <- seq(0, 1, by = 0.25)\nz <- seq(2, 8, length = 4)",
            {"y": [0, 0.25, 0.5, 0.75, 1], "z": [2, 4, 6, 8]},
        ),
        (
            "y <- seq(3)\nz <- seq(3, 1)\nw <- seq(5, by = 2, len = 3)",
            {"y": [1, 2, 3], "z": [3, 2, 1], "w": [5, 7, 9]},
        ),
        (
            "y <- matrix(1:6, 2)\nz <- matrix(1:4, ncol = 2, byrow = TRUE)",
            {"y": [[1, 3, 5], [2, 4, 6]], "z": [[1, 2], [3, 4]]},
        ),
        (
            "y <- matrix(NA, 1, 2)\nz <- array(1:4, dim = c(2, 1, 2))",
            {"y": [[np.nan, np.nan]], "z": [[[1, 3]], [[2, 4]]]},
        ),
        ('y <- matrix(0, 1, 2, dimnames = list(NULL, c("a", "b")))', {"y": [[0, 0]]}),
        (
            "y <- seq(to = 5, length.out = 3)\nz <- seq(to = 10, by = 2, len = 3)",
            {"y": [3, 4, 5], "z": [6, 8, 10]},
        ),
        (
            "y <- seq(5, by = -2)\nz <- seq(0)\nw <- seq(-2)",
            {"y": [5, 3, 1], "z": [1, 0], "w": [1, 0, -1, -2]},
        ),
        ("y <- seq(0, 0.3, by = 0.1)", {"y": [0, 0.1, 0.2, 0.3]}),
        ("y <- seq(0, 1, length.out = 2.5)\nz <- seq(2, 2, by = 0)", {"y": [0, 0.5, 1], "z": [2]}),
        ("y <- seq(c(4, 7, 9))\nb <- TRUE\nz <- -b", {"y": [1, 2, 3], "b": 1, "z": -1}),
    ],
)
def test_what_people_write_by_hand(text: str, wanted: dict) -> None:
    found = parse_rdump(text)
    assert list(found) == list(wanted)
    for name, value in wanted.items():
        np.testing.assert_allclose(found[name], value, rtol=1e-15)


def test_the_last_number_of_a_sequence_is_not_passed() -> None:
    assert parse_rdump("y <- seq(0, 0.3, by = 0.1)")["y"][-1] == 0.3


def test_a_copy_of_a_name_is_an_array_of_its_own() -> None:
    found = parse_rdump("x <- c(1, 2)\ny <- x")
    found["x"][0] = 7
    assert found["y"].tolist() == [1, 2]


def test_cubes_run_by_the_first_index_in_r_and_by_the_last_in_bugs() -> None:
    by_r = parse_rdump("y <- structure(1:24, .Dim = c(2, 3, 4))")["y"]
    by_bugs = parse_rdump("list(y = structure(.Data = c(1:24), .Dim = c(2, 3, 4)))")["y"]
    assert by_r[1, 0, 0] == 2 and by_r[0, 0, 1] == 7
    assert by_bugs[0, 0, 1] == 2 and by_bugs[1, 0, 0] == 13


@pytest.mark.parametrize(
    ("text", "line", "said"),
    [
        ("N <- 3\ny <- c(1, 2", 2, "',' is wanted, and the end is there"),
        ("N 3", 1, "'<-' is wanted after 'N', and '3' is there"),
        ("y <- factor(c(1))", 1, "factor(...) is not known here"),
        ("\n\ny <- structure(c(1,2,3), .Dim = c(2,2))", 3, "takes 4 numbers, and 3 are given"),
        ("y <- matrix(1:6, 4)", 1, "matrix(...) has 8 places, and 6 values do not fill them"),
        ("y <- matrix(1:4, foo = 2)", 1, "no argument 'foo' here (it has data, nrow, ncol, byrow)"),
        ("y <- matrix(1:4, n = 2)", 1, "no argument 'n' here"),
        ("y <- array(1, 2, 3)", 1, "array(...) is given too much (it has data, dim)"),
        ("\ny <- rep(1:3, times = c(1, 2))", 2, "rep(...) has 3 values, and times has 2"),
        ("y <- rep()", 1, "nothing to repeat"),
        ("y <- rep(1, -1)", 1, "times is one number, 0 or more"),
        ("y <- rep(1, each = 2, each = 2)", 1, "is given 'each' twice"),
        ("y <- seq(1, 5, by = -1)", 1, "does not get from 1 to 5 by -1"),
        ("y <- seq(c(1, 2), 5)", 1, "seq(...) takes single numbers"),
        ("y <- seq(5, by = 2)", 1, "does not get from 5 to 1 by 2"),
        ("y <- seq(1, 10, by = 2, length.out = 3)", 1, "three of from, to, by and length.out"),
        ("\ny <- rep(0, 1e12)", 2, "rep(...) makes 1e+12 numbers"),
        ("y <- rep(0, 1e300)", 1, "rep(...) makes 1e+300 numbers"),
        ("y <- rep(c(1, 2), each = 1e8)", 1, "rep(...) makes 2e+08 numbers"),
        ("y <- seq(0, 1e12)", 1, "seq(...) makes 1e+12 numbers"),
        ("y <- array(0, dim = c(1e10, 1e10))", 1, "array(...) makes 1e+10 numbers"),
        ("y <- matrix(0, 1e8, 1e8)", 1, "matrix(...) makes 1e+16 numbers"),
        ("y <- matrix(0, 2, 2, byrow = c(T, F))", 1, "byrow is TRUE or FALSE"),
        ("NA <- 3", 1, "'NA' is a word of R"),
        ("y <- matrix(c(), 2, 2)", 1, "no values to fill 4 places with"),
        ("y <- later\nlater <- 2", 1, "'later' is no number, and nothing before gives it one"),
        ("list(N = 3, y = c(N))", 1, "'N' is no number"),
        ("y <- 'red'", 1, "a number is wanted, and \"'red'\" is there"),
        ("y <- 1\ny <- 2", 2, "'y' is given twice"),
        ("list(1, 2)", 1, "has no name"),
        ("y <- {1}", 1, "'{' is not expected here"),
        ("y <- c(1,2):3", 1, "single numbers"),
        ("y <- NA:3", 1, "single numbers"),
        ("<- 3", 1, "a name is wanted"),
        (
            "\ny <- structure(list(a = 1:2), row.names = 1:2, class = 'data.frame')",
            2,
            "a data frame is one, too",
        ),
        ("y <- list(a = 1, b = c(1, 2))", 1, "dump its columns as variables of their own"),
        ("y <- as.raw(c(1))", 1, "as.raw(...) is not known here (known are c, structure,"),
        ("y <- as.integer(1, 2)", 1, "takes one value, and 2 are given"),
        ("y <- integer(-1)", 1, "integer(n) takes one length"),
        ("y <- as.integer(c('a'))", 1, "a number is wanted"),
        ("y <- structure(1:2, class = c('a'", 1, "',' is wanted, and the end is there"),
    ],
)
def test_what_is_wrong_is_said_with_its_line(
    tmp_path: Path, text: str, line: int, said: str
) -> None:
    path = tmp_path / "data.R"
    path.write_text(text)
    with pytest.raises(FileFormatError) as caught:
        bmc.io.read_data(path)
    assert said in str(caught.value)
    assert caught.value.line == line


def test_json_of_stan(tmp_path: Path) -> None:
    path = tmp_path / "eight.data.json.gz"
    text = '{"J": 3, "y": [[1, null], [2.5, "-Infinity"]], "group": [1, 2], "none": []}'
    path.write_bytes(gzip.compress(text.encode()))
    found = bmc.io.read_data(path)
    assert found["J"] == 3 and found["group"].dtype.kind == "i" and found["none"].size == 0
    np.testing.assert_array_equal(found["y"], [[1, np.nan], [2.5, -np.inf]])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{\n,", "not JSON"),
        ("[1, 2]", "holds no names"),
        ('{"y": [[1, 2], [3]]}', "the rows of 'y' differ in length"),
        ('{"y": "red"}', "'y' holds something that is no number"),
        ('{"y": {"a": 1}}', "'y' holds something that is no number"),
    ],
)
def test_json_that_is_none(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "data.json"
    path.write_text(text)
    with pytest.raises(FileFormatError, match=said):
        bmc.io.read_data(path)
