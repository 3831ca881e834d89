"""Programs give the same for shapes that came often as for those that came once."""

import numpy as np
import pytest

from bayesmc.expression import Program, call, elementwise, leaf, pick, reduction

X, M = leaf("x", (3,)), leaf("m", (3, 3))


def expressions():
    wide = elementwise(np.add, M, X)
    turned = pick([wide], np.arange(9).reshape(3, 3).T)
    joined = pick([X, M], np.array([[0, 11], [4, 2]]))
    part = pick([M], np.arange(9).reshape(3, 3)[1:, ::2])
    row = pick([M], np.arange(9))
    product = call(np.matmul, [turned, M])
    total = reduction(np.add, elementwise(np.power, product, 2.0), (1,))
    return [turned, joined, part, row, product, total, elementwise(np.where, True, row, 0.0)]


def values_of(batch_x, batch_m, seed):
    rng = np.random.default_rng(seed)
    return {"x": rng.normal(size=(*batch_x, 3)), "m": rng.normal(size=(*batch_m, 3, 3))}


@pytest.mark.parametrize("batch_x", [(), (1,), (4,), (2, 4)])
@pytest.mark.parametrize("batch_m", [(), (1,), (4,)])
def test_the_tenth_call_says_what_a_first_one_does(batch_x, batch_m):
    program = Program(expressions())
    for seed in range(10):
        values = values_of(batch_x, batch_m, seed)
        for found, once in zip(program(values), Program(expressions())(values), strict=True):
            assert found.shape == once.shape and np.array_equal(found, once)


def test_shapes_and_layouts_that_change_are_no_matter():
    program = Program(expressions())
    for seed in range(60):
        values = values_of([(), (4,), (1,)][seed % 3], [(4,), (1,)][seed % 2], seed)
        values["m"] = np.asfortranarray(values["m"])
        for found, once in zip(program(values), Program(expressions())(values), strict=True):
            assert found.shape == once.shape and np.array_equal(found, once)


def test_a_call_whose_shape_varies_is_followed():
    """One that drops the batch at some values: code made for the other shape would misplace it."""
    dropped = call(lambda x: x[0] if (x < 0).all() else x, [X], (3,))
    program = Program([elementwise(np.add, dropped, M)])
    for sign in (1.0, -1.0) * 6:
        x = np.full((3, 3), sign) * np.arange(1.0, 4.0)[:, None]
        m = np.zeros((3, 3, 3))
        expected = m + (x[0] if sign < 0 else x[:, None])
        assert np.array_equal(program({"x": x, "m": m})[0], expected)
