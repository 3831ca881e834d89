"""What one element of a term says, before like elements are put together."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np

from bayesmc.structure import Variable


@dataclass(frozen=True, eq=False)
class Rows:
    """``exp(log_scale - |A x - z|^2 / 2)`` of some coordinates x, for every state of finite variables.

    Attributes
    ----------
    name : str
        Its node.
    element : int
    scope : tuple of (node, element)
    coordinates : ndarray of int, shape (q,)
    rows : ndarray, shape (*cards, m, q + 1)
        ``[A | z]``.
    log_scale : ndarray, shape (*cards,)
    is_prior : bool
        Whether it is the density of some of the coordinates.
    """

    name: str
    element: int
    scope: tuple[Variable, ...]
    coordinates: np.ndarray
    rows: np.ndarray
    log_scale: np.ndarray
    is_prior: bool

    @property
    def key(self) -> Hashable:
        """Equal for those that can be put together."""
        return self.name, self.rows.shape, self.is_prior


def basis(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions that rows span, and the rows in these.

    Parameters
    ----------
    rows : ndarray, shape (count, r, m)

    Returns
    -------
    ndarray, shape (count, k, m)
        Of the largest rank among all; with one row that row itself.
    ndarray, shape (count, r, k)

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.engines.propagation.scopes import basis
    >>> directions, inner = basis(np.array([[[1.0, -1.0], [2.0, -2.0]]]))
    >>> directions.shape, bool(np.allclose(inner @ directions, [[[1.0, -1.0], [2.0, -2.0]]]))
    ((1, 1, 2), True)
    """
    count, r, m = rows.shape
    if r == 1:
        size = np.abs(rows).max(axis=-1, keepdims=True)
        first = np.zeros_like(rows)
        first[..., 0] = 1.0
        return np.where(size > 0, rows, first), np.where(size > 0, 1.0, 0.0)
    if m == 1:
        return np.ones((count, 1, 1)), rows.copy()
    _, values, right = np.linalg.svd(rows, full_matrices=True)
    kept = (values > 1e-11 * values.max(axis=-1, keepdims=True, initial=0.0)) & (values > 0)
    k = max(int(kept.sum(axis=-1).max(initial=1)), 1)
    if k == m:  # all of them: as they are
        return np.broadcast_to(np.eye(m), (count, m, m)).copy(), rows.copy()
    directions = right[:, :k]
    return directions, rows @ np.matrix_transpose(directions)


def is_one_row(rows: np.ndarray) -> bool:
    """Whether all rows are the same; of rows that are one in memory nothing is compared.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.engines.propagation.scopes import is_one_row
    >>> is_one_row(np.broadcast_to(np.arange(3), (5, 3))), is_one_row(np.arange(4).reshape(2, 2))
    (True, False)
    """
    return not rows.strides[0] or bool((rows == rows[:1]).all())


def padded(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Rows of whole numbers as one array; the first of a row stands where it is short."""
    width = max((len(p) for p in parts), default=0)
    found = np.zeros((len(parts), width), dtype=int)
    for k, part in enumerate(parts):
        found[k, : len(part)] = part
        found[k, len(part) :] = part[0] if len(part) else 0
    return found
