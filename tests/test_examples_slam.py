"""Landmark SLAM: what its shares count, and that readings of an instant exclude each other."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from examples import slam_landmarks
from examples.slam_landmarks import Readings


def made(which: list[int], times: list[float], seen: Any = None) -> Readings:
    rows = np.zeros((len(which), 3))
    seen = np.zeros((len(which), 2)) if seen is None else np.asarray(seen)
    return Readings(np.array(times), rows, rows, np.array(which), seen, rows)


def test_shares_by_hand() -> None:
    """Numbers 7 and 2 are landmarks 0 and 1; number 3 is a double of landmark 1, and one is missed."""
    readings = made([0, 0, 1, 1, 1, -1, 2, 1], list(range(8)))
    numbers = np.array([7, 7, 2, 2, 3, -1, 7, -1])
    marks = np.array([[0.0, 0.0], [5.0, 0.0], [0.1, 0.0]])
    assert slam_landmarks.share_right(numbers, readings, 3) == pytest.approx(4 / 7)
    assert slam_landmarks.share_near(numbers, readings, marks) == pytest.approx(6 / 7)


def test_who_knows_all_is_right_where_landmarks_are_apart() -> None:
    marks = np.array([[2.0, 0.0], [0.0, 3.0], [2.0, 0.1]])
    place = [[2.0, 0.0], [3.0, np.pi / 2], [2.0, 0.0]]
    found = slam_landmarks.ceilings(made([0, 1, 2], [0.0, 0.0, 1.0], place), marks)
    assert found["told all: nearest"] == pytest.approx(
        2 / 3
    )  # the third is read as if it were the first
    both = slam_landmarks.ceilings(made([0, 1, 2], [0.0, 0.0, 0.0], place), marks)
    assert both["each once"] == 1.0  # but not where that one is read, too


def test_readings_of_an_instant_are_of_different_landmarks() -> None:
    """Two stand 6 cm apart, less than readings tell; a robot that stands still reads both in each instant."""
    times = np.repeat(np.arange(12.0), 2)
    noise = np.random.default_rng(0).normal(size=(24, 2)) * [0.02, 0.01]
    seen = np.tile([[3.0, 0.0], [3.0, 0.02]], (12, 1)) + noise
    readings = made([0, 1] * 12, times.tolist(), seen)
    drive: Any = SimpleNamespace(start=np.zeros(3))
    engine = slam_landmarks.fast_slam(8, "off")
    numbers = slam_landmarks.assigned(slam_landmarks.without_labels(readings, drive, engine))
    assert (numbers[::2] != numbers[1::2]).all()
    assert set(numbers.tolist()) <= {-1, 0, 1}
