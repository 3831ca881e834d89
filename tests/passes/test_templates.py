"""Slices of a template are one expression, with the constants of all of them."""

from __future__ import annotations

import numpy as np

from bayesmc.expression import Program, TracedArray, leaf, trace
from bayesmc.passes.templates import stacked, template


def slice_of(t):
    x, y = TracedArray(leaf(f"x[{t}]", ())), TracedArray(leaf(f"y[{t}]", ()))
    return trace(lambda x, y, t=t: 0.5 * x + 8 * np.cos(1.2 * t) - y, [x, y])


def test_slices_are_one_template(rng):
    roots = [slice_of(t) for t in range(200)]
    assert len({template(r).key for r in roots}) == 1
    one = stacked(roots)
    assert one is not None
    assert list(one.constants) == ["constant 0"]
    x, y = rng.normal(size=(2, 200))
    together = Program([one.root])({"x[0]": x, "y[0]": y, **one.constants})[0]
    apart = [Program([r])({f"x[{t}]": x[t], f"y[{t}]": y[t]})[0] for t, r in enumerate(roots)]
    np.testing.assert_allclose(together, apart, rtol=1e-14)


def test_others_are_not():
    x = TracedArray(leaf("x", ()))
    roots = [trace(f, [x]) for f in (lambda x: x + 1, lambda x: x - 1, lambda x: x * x + 1)]
    assert len({template(r).key for r in roots}) == 3
    assert stacked(roots) is None
