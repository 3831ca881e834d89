"""Affine forms hold what functions compute, and are refused where functions are not affine."""

from __future__ import annotations

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import TraceError
from bayesmc.expression import Program, TracedArray, leaf, trace
from bayesmc.passes.affine import affine
from bayesmc.plates import PlateArray

DESIGN = np.sin(np.arange(12.0)).reshape(4, 3)
SQUARE = np.cos(np.arange(9.0)).reshape(3, 3)


def arguments():
    return {
        "x": TracedArray(leaf("x", (4,))),
        "v": TracedArray(leaf("v", (1, 3))),
        "m": PlateArray(TracedArray(leaf("m", (1, 5))), ("group",), own=1),
        "k": TracedArray(leaf("k", (4,), int, states=5)),
        "s": TracedArray(leaf("s", (1,))),
    }


AFFINE = {
    "a sum": lambda x, v, m, k, s: 2 * x - v[..., 0] / 4 + 1,
    "a design matrix": lambda x, v, m, k, s: np.vecdot(DESIGN, v) + x,
    "a matrix": lambda x, v, m, k, s: (
        np.matvec(SQUARE, v)[..., 1] - np.einsum("...i,i->...", v, SQUARE[0])
    ),
    "a gather": lambda x, v, m, k, s: m[k] * s - 3.0,
    "two of one": lambda x, v, m, k, s: m[k] - m.mean("group"),
    "a branch": lambda x, v, m, k, s: np.where(k > 2, x, m[k] + v[..., 2]),
    "a stack": lambda x, v, m, k, s: bmc.stack([x, v[..., 1], m[k], 1.0]).sum(axis=-1),
    "a difference": lambda x, v, m, k, s: np.diff(v, axis=-1)[..., 0] + np.mean(v, axis=-1) + s * x,
    "numbers of states": lambda x, v, m, k, s: 0.5 * k * x + np.exp(0.1 * s) * v.sum(axis=-1),
    "nothing": lambda x, v, m, k, s: s + k,
    "running sums": lambda x, v, m, k, s: np.cumsum(v, axis=-1)[..., 1] + x,
    "a solution": lambda x, v, m, k, s: (
        np.linalg.solve(SQUARE + 3 * np.eye(3), (v * s[..., None])[..., None])[..., 2, 0] - x
    ),
    "a contraction": lambda x, v, m, k, s: (
        np.tensordot(v, SQUARE, axes=1)[..., 0] * x.shape[-1] + s
    ),
}
BENT = {
    "a square": (lambda x, v, m, k, s: x**2, "np.power"),
    "a product": (lambda x, v, m, k, s: x * v[..., 0], "np.multiply"),
    "a quotient": (lambda x, v, m, k, s: 1 / (x + 9), "np.divide"),
    "a branch on it": (lambda x, v, m, k, s: np.where(x > 0, x, 0.0), "np.greater"),
    "a maximum": (lambda x, v, m, k, s: m.max("group") + x, "np.maximum.reduce"),
    "a largest sum": (
        lambda x, v, m, k, s: np.maximum.accumulate(v, axis=-1)[..., 2] + x,
        "accumulate",
    ),
    "a matrix of it": (
        lambda x, v, m, k, s: np.linalg.solve(3 * np.eye(3) + v[..., None], SQUARE[0])[..., 0] + x,
        "solve",
    ),
    "an absolute value": (lambda x, v, m, k, s: np.abs(v[..., 0]) + x, "np.absolute"),
}


@pytest.mark.parametrize("name", AFFINE)
def test_what_is_read_off_is_what_is_computed(name, rng):
    function, given = AFFINE[name], arguments()
    root = trace(function, list(given.values()))
    form = affine(root, ["x", "v", "m"])
    names = [n for n in ("x", "v", "m") if n in form.reads]
    parts = [e for n in names for e in (form.reads[n].gain, form.reads[n].at)]
    assert not any(e.leaves & {"x", "v", "m"} for e in (form.offset, *parts))
    for batch in ((), (7,), (2, 6)):
        values = {
            n: rng.normal(size=batch + a.array.shape if n == "m" else batch + a.shape)
            for n, a in given.items()
            if n != "k"
        }
        values["k"] = rng.integers(5, size=(*batch, 4))
        expected, offset, *read = Program([root, form.offset, *parts])(values)
        total = np.asarray(offset, dtype=float)
        for n, gain, at in zip(names, read[::2], read[1::2], strict=True):
            flat = values[n].reshape(*batch, 1, -1)
            at = np.broadcast_to(at, (*batch, *at.shape[at.ndim - 2 :]))
            elements = np.take_along_axis(
                np.broadcast_to(flat, (*batch, at.shape[-2], flat.shape[-1])), at, axis=-1
            )
            total = total + (gain * elements).sum(axis=-1)
        np.testing.assert_allclose(
            np.broadcast_to(total, expected.shape), expected, rtol=1e-12, atol=1e-12
        )


@pytest.mark.parametrize("name", BENT)
def test_what_is_not_affine_is_refused_by_name(name):
    function, why = BENT[name]
    root = trace(function, list(arguments().values()))
    with pytest.raises(TraceError, match=why):
        affine(root, ["x", "v", "m"])
