"""Shape arithmetic against NumPy itself."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bayesmc.shapes import (
    as_shape,
    broadcast_shapes,
    broadcasts_to,
    first_index,
    owned,
    read_only,
    unused_sizes,
)

shapes = st.lists(st.sampled_from((0, 1, 2, 3)), max_size=4).map(tuple)


@given(st.lists(shapes, max_size=4))
def test_broadcast_shapes_is_numpys(parts):
    try:
        expected = np.broadcast_shapes(*parts)
    except ValueError:
        with pytest.raises(ValueError, match="broadcast"):
            broadcast_shapes(*parts)
    else:
        assert broadcast_shapes(*parts) == expected


@given(shapes, shapes)
def test_broadcasts_to_never_goes_beyond(shape, target):
    try:
        expected = np.broadcast_shapes(shape, target) == target
    except ValueError:
        expected = False
    assert broadcasts_to(shape, target) == expected


@given(st.lists(st.integers(0, 12), max_size=8), st.integers(0, 4))
def test_unused_sizes_are_unlike_everything(taken, count):
    sizes = list(unused_sizes(taken, count))
    assert len(sizes) == len(set(sizes)) == count
    assert not set(sizes) & set(taken)
    assert all(n >= 2 for n in sizes)


@pytest.mark.parametrize(
    ("given_", "expected"),
    [
        (3, (3,)),
        (np.int64(2), (2,)),
        ((2, 3), (2, 3)),
        ([4], (4,)),
        ((), ()),
        (np.array([1, 2]), (1, 2)),
    ],
)
def test_as_shape(given_, expected):
    shape = as_shape(given_)
    assert shape == expected
    assert all(type(n) is int for n in shape)


def test_read_only_is_a_view_and_leaves_the_original_writable():
    mine = np.zeros(3)
    view = read_only(mine)
    with pytest.raises(ValueError, match="read-only"):
        view[0] = 1.0
    mine[0] = 2.0
    assert view[0] == 2.0
    assert read_only(view) is view


def test_owned_is_a_private_copy():
    mine = np.zeros(3)
    copy = owned(mine)
    mine[0] = 5.0
    assert copy[0] == 0.0 and not copy.flags.writeable and mine.flags.writeable


@given(st.lists(st.booleans(), min_size=6, max_size=6).filter(any))
def test_first_index_is_in_c_order(bits):
    mask = np.array(bits).reshape(2, 3)
    assert first_index(mask) == tuple(np.argwhere(mask)[0].tolist())
