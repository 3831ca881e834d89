"""The lazy result of a gather of vectors: rows of a table, taken only when somebody needs them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from bayesmc.shapes import Shape


class Gathered(NDArrayOperatorsMixin):
    """``table[rows]``, not yet taken: rows of vectors picked by an index.

    It is an array for every NumPy purpose; a distribution that needs few entries (``Categorical(phi[z])``)
    reads ``table`` and ``rows`` instead and never builds the whole.

    Attributes
    ----------
    table : ndarray, shape (R, *event)
    rows : ndarray of int, shape (*batch, *plates)
    """

    __slots__ = ("_array", "rows", "table")

    def __init__(self, table: np.ndarray, rows: np.ndarray) -> None:
        self.table = table
        self.rows = rows
        self._array: np.ndarray | None = None

    @property
    def shape(self) -> Shape:
        return self.rows.shape + self.table.shape[1:]

    @property
    def ndim(self) -> int:
        return self.rows.ndim + self.table.ndim - 1

    @property
    def dtype(self) -> np.dtype:
        return self.table.dtype

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        if self._array is None:
            self._array = np.take(self.table, self.rows, axis=0)
            self._array.flags.writeable = False
        if dtype is not None and np.dtype(dtype) != self._array.dtype:
            return self._array.astype(dtype)
        return self._array.copy() if copy else self._array

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **kwargs: Any) -> Any:
        if any(isinstance(x, Gathered) for x in kwargs.get("out", ())):
            raise ValueError("output array is read-only")
        plain = [np.asarray(x) if isinstance(x, Gathered) else x for x in inputs]
        return getattr(ufunc, method)(*plain, **kwargs)

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        return func(*_materialised(args), **{k: _materialised(v) for k, v in kwargs.items()})

    def __getitem__(self, key: Any) -> np.ndarray:
        return np.asarray(self)[key]

    def __len__(self) -> int:
        return len(np.asarray(self))

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(np.asarray(self), name)


def _materialised(value: Any) -> Any:
    if isinstance(value, Gathered):
        return np.asarray(value)
    if isinstance(value, (list, tuple)):
        return type(value)(_materialised(v) for v in value)
    return value
