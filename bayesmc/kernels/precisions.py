"""Inverses of the covariances that nodes hold, kept while a value stays the same.

The kernels of a mixture all ask for the precisions of one array of covariances; each is worked out once
per sweep, or handed in by the kernel that drew the covariances from their factors.
"""

from __future__ import annotations

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np

from bayesmc.structure.target import Target


@dataclass(frozen=True, eq=False)
class Precision:
    """Of covariances ``(..., d, d)``.

    Attributes
    ----------
    root : ndarray, shape (..., d, d)
        ``root @ root.T`` is the precision.
    matrix : ndarray, shape (..., d, d)
        The precision, symmetric.
    half_log_det : ndarray, shape (...)
        Half the log determinant of the precision.
    """

    root: np.ndarray
    matrix: np.ndarray
    half_log_det: np.ndarray

    def reshaped(self, batch: tuple[int, ...]) -> Precision:
        """The same with another batch shape."""
        if self.half_log_det.shape == batch:
            return self
        shape = batch + self.root.shape[-2:]
        half = self.half_log_det.reshape(batch)
        return Precision(self.root.reshape(shape), self.matrix.reshape(shape), half)


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
    return Precision(root, root @ root.swapaxes(-1, -2), half)


def kept_precision(target: Target, node: str, cov: np.ndarray) -> Precision:
    """The precision of a node's value, made once for every array."""
    kept = _KEPT.setdefault(target, {})
    found = kept.get(node)
    if found is None or found[0] is not cov:
        found = kept[node] = cov, precision_of(cov)
    return found[1]


def keep_precision(target: Target, node: str, cov: np.ndarray, precision: Precision) -> None:
    """Hand in the precision of a node's value, known from how it was drawn."""
    _KEPT.setdefault(target, {})[node] = cov, precision


#: a cache beside the target, which is frozen; it goes when the target goes
_KEPT: WeakKeyDictionary[Target, dict[str, tuple[np.ndarray, Precision]]] = WeakKeyDictionary()
