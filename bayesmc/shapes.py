"""Arithmetic of shapes: a value is an array of shape ``(*batch, *plates, *event)``.

Batch axes (draws, chains, particles, candidate values) always lead, plates follow, event axes come
last; batch shapes of different values may differ but broadcast. This room knows arrays only, not nodes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

Shape = tuple[int, ...]

_RTOL = 1e-7
#: of the largest value of a parameter, for what cancels
_ATOL = 1e-12


def as_shape(shape: int | Iterable[int]) -> Shape:
    """``shape`` as a tuple of ints; a bare int is one axis."""
    if isinstance(shape, tuple):
        return shape
    if isinstance(shape, (int, np.integer)):
        return (int(shape),)
    return tuple(int(n) for n in shape)


def broadcast_shapes(*shapes: Shape) -> Shape:
    """NumPy's broadcast of shapes, with the common cases (one shape, equal, empty) made cheap."""
    first: Shape = ()
    for shape in shapes:
        if shape == first or not shape:
            continue
        if not first:
            first = shape
            continue
        return np.broadcast_shapes(*shapes)
    return first


def read_only(value: np.ndarray) -> np.ndarray:
    """A view of ``value`` that refuses to be written to (the array itself when it already does)."""
    if not value.flags.writeable:
        return value
    view = value.view()
    view.flags.writeable = False
    return view


def owned(value: Any, dtype: Any = None) -> np.ndarray:
    """A private read-only copy of ``value``, so that nobody's array is shared or mutated."""
    array = np.array(value, dtype=dtype)
    array.flags.writeable = False
    return array


def broadcasts_to(shape: Shape, target: Shape) -> bool:
    """Whether ``shape`` broadcasts to exactly ``target``, never beyond it."""
    if shape == target or not shape:
        return True
    if len(shape) > len(target):
        return False
    return all(a == b or a == 1 for a, b in zip(reversed(shape), reversed(target), strict=False))


def unused_sizes(taken: Iterable[int], count: int) -> Sequence[int]:
    """The ``count`` smallest sizes from 2 that differ from each other and from all ``taken``."""
    used, candidate = set(taken), 2
    sizes: list[int] = []
    while len(sizes) < count:
        if candidate not in used:
            sizes.append(candidate)
        candidate += 1
    return sizes


def unravelled(codes: np.ndarray, shape: Shape) -> tuple[np.ndarray, ...]:
    """What ``np.unravel_index`` gives, digit by digit.

    NumPy 2.4 gives wrong indices for arrays of shape ``(n, 1)`` with more than 8,192 rows.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.shapes import unravelled
    >>> [part.tolist() for part in unravelled(np.array([0, 5]), (2, 3))]
    [[0, 1], [0, 2]]
    """
    found = []
    for size in reversed(shape):
        codes, digit = np.divmod(codes, size)
        found.append(digit)
    return tuple(reversed(found))


def padded(array: np.ndarray, ndim: int) -> np.ndarray:
    """With axes of size one in front, up to so many in all."""
    return array.reshape((1,) * (ndim - array.ndim) + array.shape) if array.ndim < ndim else array


def first_index(mask: np.ndarray) -> Shape:
    """Index of the first True in ``mask``, in C order."""
    return tuple(int(i) for i in np.unravel_index(int(np.argmax(mask)), mask.shape))


def at_index(index: Shape) -> str:
    """An index in words, for messages."""
    return f" at index {index if len(index) > 1 else index[0]}" if index else ""


def from_one(low: int, high: int, size: int) -> str:
    """What to do about positions beyond the last that look as if counted from 1; nothing where they do not.

    Examples
    --------
    >>> from bayesmc.shapes import from_one
    >>> from_one(1, 3, 3), from_one(0, 3, 3)
    ('; positions count from 0: if these count from 1, subtract 1', '')
    """
    counted = low >= 1 and high == size
    return "; positions count from 0: if these count from 1, subtract 1" if counted else ""


def masks(size: int) -> list[np.ndarray]:
    """Sets of elements such that for any two, one set holds the first and not the second."""
    bits = [(np.arange(size) >> k) & 1 == 1 for k in range(max((size - 1).bit_length(), 1))]
    return [mask for bit in bits for mask in (bit, ~bit)]


def nearly_equal(a: np.ndarray, b: np.ndarray, rtol: float = _RTOL, atol: float = _ATOL) -> bool:
    """Equal up to rounding (vectorised and scalar loops may differ in the last digits).

    ``rtol`` is relative to each entry, ``atol`` to the largest.
    """
    if a.shape != b.shape:
        return False
    if a is b or np.logical_and.reduce(a == b, axis=None):
        return True
    if a.dtype.kind != "f":
        return False
    scale = np.maximum(np.abs(a), np.abs(b))
    scale = np.where(np.isfinite(scale), scale, 0.0)
    near = np.abs(a - b) <= rtol * scale + atol * scale.max(initial=0.0)
    return bool((near | (a == b) | (np.isnan(a) & np.isnan(b))).all())
