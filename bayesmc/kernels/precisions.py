"""Inverses of the covariances that nodes hold, kept while a value stays the same.

The kernels of a mixture all ask for the precisions of one array of covariances; each is worked out once
per sweep, or handed in by the kernel that drew the covariances from their factors.
"""

from __future__ import annotations

from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np

from bayesmc.structure.target import Target

#: elements 00, 10 and 11 of a matrix of two rows, and half its log determinant
Entry = tuple[float, float, float, float]


class Precision:
    """Of covariances ``(*batch, d, d)``, as arrays and, where d is 2, as Python's floats.

    Parameters
    ----------
    batch : tuple of int
    arrays : tuple of ndarray, optional
        The precisions ``(*batch, d, d)``, and half their log determinants ``(*batch)``.
    entries : list, optional
        The same as floats, matrix by matrix.
    """

    def __init__(
        self,
        batch: tuple[int, ...],
        arrays: tuple[np.ndarray, np.ndarray] | None = None,
        entries: list[Entry] | None = None,
    ) -> None:
        self.batch = batch
        self._arrays, self._entries = arrays, entries

    @property
    def matrix(self) -> np.ndarray:
        """The precisions, ``(*batch, d, d)``."""
        return self._made[0]

    @property
    def half_log_det(self) -> np.ndarray:
        """Half the log determinants of the precisions, ``(*batch)``."""
        return self._made[1]

    @cached_property
    def entries(self) -> list[Entry]:
        """One after the other as floats."""
        if self._entries is not None:
            return self._entries
        matrix, half = self._made
        flat = matrix.reshape(-1, 4).tolist()
        halves = half.ravel().tolist()
        return [(a, b, c, h) for (a, _, b, c), h in zip(flat, halves, strict=True)]

    def reshaped(self, batch: tuple[int, ...]) -> Precision:
        """The same with another batch shape."""
        matrix, half = self._made
        return Precision(batch, (matrix.reshape(batch + matrix.shape[-2:]), half.reshape(batch)))

    @cached_property
    def _made(self) -> tuple[np.ndarray, np.ndarray]:
        if self._arrays is not None:
            return self._arrays
        assert self._entries is not None
        table = np.array(self._entries)
        matrix = table[:, (0, 1, 1, 2)].reshape((*self.batch, 2, 2))
        return matrix, table[:, 3].reshape(self.batch)


def precision_of(cov: np.ndarray) -> Precision:
    """Precisions of positive definite matrices.

    Raises
    ------
    LinAlgError
        One is not positive definite to rounding.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.kernels.precisions import precision_of
    >>> precision_of(np.diag([4.0, 0.25])).matrix.tolist()
    [[0.25, 0.0], [0.0, 4.0]]
    """
    tril = np.linalg.cholesky(cov)
    # inverting an upper triangle is back substitution: nothing is pivoted
    return from_root(np.linalg.inv(tril.swapaxes(-1, -2)))


def from_root(root: np.ndarray) -> Precision:
    """Precisions ``root @ root.T`` from triangles with positive diagonals."""
    half = np.log(root.diagonal(0, -2, -1)).sum(axis=-1)
    return Precision(half.shape, (root @ root.swapaxes(-1, -2), half))


def kept_precision(target: Target, node: str, cov: np.ndarray) -> Precision:
    """The precision of a node's value, made once for every array."""
    kept = _KEPT.get(target)
    found = None if kept is None else kept.get(node)
    if found is None or found[0] is not cov:
        found = cov, precision_of(cov)
        keep_precision(target, node, *found)
    return found[1]


def keep_precision(target: Target, node: str, cov: np.ndarray, precision: Precision) -> None:
    """Hand in the precision of a node's value, known from how it was drawn."""
    _KEPT.setdefault(target, {})[node] = cov, precision


#: a cache beside the target, which is frozen; it goes when the target goes
_KEPT: WeakKeyDictionary[Target, dict[str, tuple[np.ndarray, Precision]]] = WeakKeyDictionary()
