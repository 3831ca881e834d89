"""Precision matrices with a pattern: many small ones side by side, or a band. Storage and Cholesky solving.

A part of a block is eliminated first because its matrix is mostly zeros. Both kinds keep only what need not
be zero, flat; rows of a stored array are chains, or one that stands for all. Which kind suits a block, and in
which order its components stand, is not decided here.

References
----------
Rue and Held (2005), Gaussian Markov Random Fields, sec. 2.4.
"""

from __future__ import annotations

import functools
import math
from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from bayesmc.gaussian import try_cholesky

#: rows up to which a triangle is solved row by row for all matrices at once
_BY_ROW = 4
#: triangles from which on one vector each is solved row by row, however large: NumPy would factorise them
_MANY = 32


class Pattern(ABC):
    """Symmetric matrices whose entries outside a pattern are zero.

    Attributes
    ----------
    size : int
        Rows of the matrix.
    entries : int
        Numbers that are stored of it.
    """

    size: int
    entries: int

    @abstractmethod
    def entry(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Where entries are stored; -1 for what is not (the other half of a band)."""

    @abstractmethod
    def dense(self, stored: np.ndarray) -> np.ndarray:
        """Stored numbers ``(lead, entries)`` as matrices ``(lead, size, size)``."""

    @abstractmethod
    def factored(self, stored: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Cholesky factors, log determinants and which matrices have none, each with ``lead`` in front."""

    @abstractmethod
    def lower(self, root: np.ndarray, right: np.ndarray) -> np.ndarray:
        """``root^-1 right`` for ``right (lead, size, columns)``; one factor may serve all."""

    @abstractmethod
    def upper(self, root: np.ndarray, right: np.ndarray) -> np.ndarray:
        """``root'^-1 right``, likewise."""


class Blocks(Pattern):
    """Many small matrices along the diagonal.

    Parameters
    ----------
    count, width : int
        How many, and their rows.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.linalg.patterns import Blocks
    >>> blocks = Blocks(2, 1)
    >>> root, log_det, wrong = blocks.factored(np.array([[4.0, 9.0]]))
    >>> blocks.lower(root, np.ones((1, 2, 1))).ravel().tolist()
    [0.5, 0.3333333333333333]
    """

    def __init__(self, count: int, width: int) -> None:
        self.count, self.width = count, width
        self.size = count * width
        self.entries = count * width * width

    def entry(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        width = max(self.width, 1)
        return row * width + column % width

    def dense(self, stored: np.ndarray) -> np.ndarray:
        lead, width = len(stored), self.width
        full = np.zeros((lead, self.size, self.size))
        for k, block in enumerate(np.moveaxis(self._apart(stored), 1, 0)):
            at = slice(k * width, (k + 1) * width)
            full[:, at, at] = block
        return full

    def factored(self, stored: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        root, wrong = cholesky(self._apart(stored))
        log_det = 2.0 * np.log(np.linalg.diagonal(root)).sum(axis=(-2, -1))
        return root, log_det, np.asarray(wrong.any(axis=-1))

    def lower(self, root: np.ndarray, right: np.ndarray) -> np.ndarray:
        return triangular(root, self._columns(right), False).reshape(right.shape)

    def upper(self, root: np.ndarray, right: np.ndarray) -> np.ndarray:
        return triangular(root, self._columns(right), True).reshape(right.shape)

    def _columns(self, right: np.ndarray) -> np.ndarray:
        return right.reshape(len(right), self.count, self.width, -1)

    def _apart(self, stored: np.ndarray) -> np.ndarray:
        return stored.reshape(len(stored), self.count, self.width, self.width)


class Band(Pattern):
    """Matrices whose entries stand at most ``width`` off the diagonal; the lower half is stored.

    The matrices of several chains go to LAPACK as one long band: no entry joins two of them.

    Parameters
    ----------
    size, width : int

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.linalg.patterns import Band
    >>> band = Band(3, 1)
    >>> stored = np.array([[4.0, 2.0, 5.0, 2.0, 5.0, 0.0]])  # diagonal, below it, next column
    >>> root, log_det, wrong = band.factored(stored)
    >>> right = np.array([[[8.0], [18.0], [19.0]]])
    >>> band.upper(root, band.lower(root, right)).ravel().round(12).tolist()
    [1.0, 2.0, 3.0]
    """

    def __init__(self, size: int, width: int) -> None:
        self.size, self.width = size, width
        self.entries = size * (width + 1)

    def entry(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        below = row - column
        return np.where(below < 0, -1, column * (self.width + 1) + below)

    def dense(self, stored: np.ndarray) -> np.ndarray:
        lead, size = len(stored), self.size
        columns = stored.reshape(lead, size, self.width + 1)
        full = np.zeros((lead, size, size))
        for below in range(min(self.width + 1, size)):
            at = np.arange(size - below)
            full[:, at + below, at] = full[:, at, at + below] = columns[:, at, below]
        return full

    def factored(self, stored: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        lead = len(stored)
        root, refused = self._pbtrf(stored.reshape(-1, self.width + 1))
        root = root.reshape(lead, self.size, self.width + 1)
        wrong = np.zeros(lead, dtype=bool)
        if refused or not np.isfinite(root).all():  # in a chain whose NaN may have reached the next
            for k, row in enumerate(stored.reshape(root.shape)):
                root[k], refused = self._pbtrf(row)
                wrong[k] = refused or not np.isfinite(root[k]).all()
            root[wrong] = np.eye(1, self.width + 1)
        log_det = 2.0 * np.log(root[:, :, 0]).sum(axis=-1)
        return root, log_det, wrong

    def lower(self, root: np.ndarray, right: np.ndarray) -> np.ndarray:
        return self._solved(root, right, "N")

    def upper(self, root: np.ndarray, right: np.ndarray) -> np.ndarray:
        return self._solved(root, right, "T")

    def _pbtrf(self, columns: np.ndarray) -> tuple[np.ndarray, bool]:
        """The factor in the same form, and whether there is none."""
        found, info = lapack().dpbtrf(columns.T, lower=1)
        return np.ascontiguousarray(found.T), info != 0

    def _solved(self, root: np.ndarray, right: np.ndarray, trans: str) -> np.ndarray:
        lead, size, count = right.shape
        if len(root) == lead:
            found = _tbtrs(root.reshape(-1, self.width + 1), right.reshape(-1, count), trans)
            if (
                lead > 1 and not np.isfinite(found).all()
            ):  # what overflows must not reach other chains
                pairs = zip(root, right, strict=True)
                found = np.concatenate([_tbtrs(own, columns, trans) for own, columns in pairs])
            return found.reshape(right.shape)
        # one factor, and the chains as columns
        joined = np.moveaxis(right, 0, 1).reshape(size, lead * count)
        found = _tbtrs(root[0], joined, trans)
        return np.ascontiguousarray(np.moveaxis(found.reshape(size, lead, count), 1, 0))


def triangular(root: np.ndarray, right: np.ndarray, transposed: bool) -> np.ndarray:
    """Many small lower triangles, or their transposes, solved for columns.

    Parameters
    ----------
    root : ndarray, shape (*lead, width, width)
        Zero above the diagonal.
    right : ndarray, shape (*lead, width, columns)

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.linalg.patterns import triangular
    >>> triangular(np.array([[2.0, 0.0], [1.0, 4.0]]), np.array([[2.0], [9.0]]), False).ravel().tolist()
    [1.0, 2.0]
    """
    width = root.shape[-1]
    if width > _BY_ROW and right.shape[-1] == 1 and math.prod(root.shape[:-2]) >= _MANY:
        return _by_dots(root, right[..., 0], transposed)[..., None]
    if width > _BY_ROW:
        return np.linalg.solve(np.swapaxes(root, -1, -2) if transposed else root, right)
    lead = np.broadcast_shapes(root.shape[:-2], right.shape[:-2])
    found = np.empty((*lead, *right.shape[-2:]))
    done: list[int] = []
    for k in reversed(range(width)) if transposed else range(width):
        row = right[..., k, :]
        for j in done:
            factor = root[..., j, k, None] if transposed else root[..., k, j, None]
            row = row - factor * found[..., j, :]
        np.divide(row, root[..., k, k, None], out=found[..., k, :])
        done.append(k)
    return found


def cholesky(matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cholesky factors, and which matrices have none (those get the identity)."""
    try:
        if matrices.shape[-1] == 1:
            wrong = np.asarray(~((matrices > 0) & (matrices < np.inf))[..., 0, 0])
            return np.sqrt(np.where(wrong[..., None, None], 1.0, matrices)), wrong
        factor = _of_two(matrices) if matrices.shape[-1] == 2 else np.linalg.cholesky(matrices)
        wrong = np.asarray(~np.isfinite(factor).all(axis=(-2, -1)))
        if not wrong.any():
            return factor, wrong
    except np.linalg.LinAlgError:
        pass
    factor, refused = try_cholesky(matrices)
    found = np.zeros(matrices.shape[:-2], dtype=bool) if refused is None else refused
    return factor, found


@functools.cache
def lapack() -> Any:
    """SciPy's LAPACK, loaded when first used: importing scipy.linalg takes long."""
    from scipy.linalg import lapack as found

    return found


# ---- private ------------------------------------------------------------------------------------


def _by_dots(root: np.ndarray, right: np.ndarray, transposed: bool) -> np.ndarray:
    """Triangles solved for a vector each, row by row."""
    lead = np.broadcast_shapes(root.shape[:-2], right.shape[:-1])
    width, diagonal = root.shape[-1], np.linalg.diagonal(root)
    found = np.empty((*lead, width))
    for k in reversed(range(width)) if transposed else range(width):
        at = slice(k + 1, None) if transposed else slice(k)
        factor = root[..., at, k] if transposed else root[..., k, at]
        off = right[..., k] - np.vecdot(factor, found[..., at])
        np.divide(off, diagonal[..., k], out=found[..., k])
    return found


def _of_two(matrices: np.ndarray) -> np.ndarray:
    """Cholesky factors of matrices of two rows."""
    factor = np.zeros(matrices.shape)
    with np.errstate(all="ignore"):
        first = np.sqrt(matrices[..., 0, 0])
        below = matrices[..., 1, 0] / first
        last = np.sqrt(matrices[..., 1, 1] - below * below)
    if not (last > 0).all():  # NaN, too, where the first is no number
        raise np.linalg.LinAlgError
    factor[..., 0, 0], factor[..., 1, 0], factor[..., 1, 1] = first, below, last
    return factor


def _tbtrs(root: np.ndarray, right: np.ndarray, trans: str) -> np.ndarray:
    """A band's factor ``(size, width + 1)``, or its transpose, solved for columns ``(size, count)``."""
    found, info = lapack().dtbtrs(root.T, right, uplo="L", trans=trans)
    assert info == 0, "a factor has a positive diagonal"
    return np.ascontiguousarray(found)
