"""Which element an entry reads, sums by it, branches moved up, and one more axis: against loops."""

from __future__ import annotations

import numpy as np
import pytest

from bayesmc.errors import TraceError
from bayesmc.expression import TracedArray, as_expression, evaluate, leaf, trace
from bayesmc.passes.branches import branches_up
from bayesmc.passes.reads import element_read
from bayesmc.passes.totals import total
from bayesmc.passes.widening import widened

RNG = np.random.default_rng(4)
AT = np.array([0, 2, -1, 2, 0, 1])


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("masked", [True, False])
def test_sums_by_element(known, masked):
    """With a factor that all entries share, and one for each element."""
    mask = np.array([True, True, True, False, True, True]) if masked else None
    s, t, x = (TracedArray(leaf(n, k)) for n, k in (("s", ()), ("t", (6,)), ("x", (3,))))
    at = as_expression(AT) if known else leaf("at", (6,), int)
    coefficient = trace(lambda s, t, x: -s * t / np.exp(x[np.maximum(AT, 0)]) ** 2, [s, t, x])
    values = {"s": np.array([1.5, 2.0]), "t": RNG.normal(size=(2, 6)), "x": RNG.normal(size=(2, 3))}
    values["at"] = np.stack([AT, AT])
    (each,) = evaluate([coefficient], values)
    kept = np.ones(6) if mask is None else mask.astype(float)
    expected = np.stack([(each * kept * (AT == k)).sum(-1) for k in range(3)], axis=-1)
    (found,) = evaluate([total(coefficient, at, 3, mask)], values)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


def test_elements_that_meet_are_refused():
    x, z = TracedArray(leaf("x", (3,))), TracedArray(leaf("z", (4,), int, states=3))
    met = trace(lambda x, z: np.take(x, z) * x[0], [x, z])
    with pytest.raises(TraceError):
        element_read(met, "x", np.arange(3))
    assert element_read(met, "x", np.array([0, -1, -1])).shape == (4,)  # all others are given


def test_branches_and_one_more_axis_change_no_value():
    x, y = TracedArray(leaf("x", (2,))), TracedArray(leaf("y", (2, 3)))
    found = trace(lambda x, y: np.log(np.where(y > 0, x[..., None], 2.0) ** 2).sum(-1), [x, y])
    values = {"x": RNG.gamma(2.0, size=(5, 2)), "y": RNG.normal(size=(5, 2, 3))}
    (expected,) = evaluate([found], values)
    (moved,) = evaluate([branches_up(found, "x")], values)
    np.testing.assert_allclose(moved, expected, rtol=1e-13)
    (wide,) = evaluate([widened(found, {k: as_expression(v) for k, v in values.items()}, 5)], {})
    np.testing.assert_allclose(wide, expected, rtol=1e-13)
