"""Affine combinations through which expressions read leaves, and where they jump or bend."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from bayesmc.errors import TraceError
from bayesmc.expression import Program, TracedArray, leaf, trace
from bayesmc.passes.directions import breaks, directions

X, Y = (TracedArray(leaf(name, (3,))) for name in "xy")


def read(function: Any, *names: str) -> Any:
    return directions(trace(function, [X, Y]), names or ("x", "y"))


def test_the_residual_of_combinations_is_the_function() -> None:
    def function(x: Any, y: Any) -> Any:
        return np.exp(2 * x - y) * np.tanh(x + 1.0) + y**2

    found = read(function)
    assert len(found.names) == 3
    rng = np.random.default_rng(0)
    values = {"x": rng.normal(size=3), "y": rng.normal(size=3)}
    inner = {}
    for name, form in zip(found.names, found.combinations, strict=True):
        offset, *parts = Program(
            [form.offset, *(e for r in form.reads.values() for e in (r.gain, r.at))]
        )(values)
        inner[name] = offset + sum(
            (gain * values[leaf_name][at]).sum(axis=-1)
            for leaf_name, gain, at in zip(form.reads, parts[::2], parts[1::2], strict=True)
        )
    (got,) = Program([found.residual])(inner)
    assert got == pytest.approx(function(values["x"], values["y"]))


def test_comparisons_are_of_one_combination() -> None:
    found = read(lambda x, y: np.where(x[..., 0] > y[..., 1], 1.0, 2.0))
    assert len(found.names) == 1 and set(found.combinations[0].reads) == {"x", "y"}


@pytest.mark.parametrize(
    "function, count",
    [
        (lambda x, y: np.where(x > 1.0, 0.0, 1.0), 1),
        (lambda x, y: np.where(np.abs(x) < 2.0, 0.0, 1.0), 3),
        (lambda x, y: np.maximum(x, 0.5), 1),
        (lambda x, y: np.exp(x), 0),
    ],
)
def test_breaks_are_where_it_jumps_or_bends(function: Any, count: int) -> None:
    assert len(breaks(trace(function, [X, Y]), ["x"])) == count


@pytest.mark.parametrize(
    "function", [lambda x, y: np.floor(x), lambda x, y: np.where(x**2 > 1, 0.0, 1.0)]
)
def test_breaks_at_unknown_places_are_refused(function: Any) -> None:
    with pytest.raises(TraceError):
        breaks(trace(function, [X, Y]), ["x"])
