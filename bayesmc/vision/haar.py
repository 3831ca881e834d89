"""Haar features: differences of brightness between neighbouring rectangles, by way of integral images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.errors import ParameterError, missing_extra
from bayesmc.shapes import read_only

#: the kinds of Viola and Jones, and those of three rectangles
KINDS = ("type-2-x", "type-2-y", "type-3-x", "type-3-y", "type-4")


def integral(frame: np.ndarray) -> np.ndarray:
    """Sums of all pixels above and to the left, with a row and a column of zeros before."""
    found = np.zeros((frame.shape[0] + 1, frame.shape[1] + 1))
    found[1:, 1:] = frame.cumsum(axis=0).cumsum(axis=1)
    return found


def rectangle_sums(
    sums: np.ndarray, low_y: Any, low_x: Any, high_y: Any, high_x: Any
) -> np.ndarray:
    """Sums over rows low_y..high_y - 1 and columns low_x..high_x - 1 of an ``integral``."""
    width, flat = sums.shape[1], sums.ravel()
    top, bottom = np.asarray(low_y) * width, np.asarray(high_y) * width
    found = flat[bottom + high_x] - flat[top + high_x]
    return found - flat[bottom + low_x] + flat[top + low_x]


@dataclass(frozen=True, eq=False)
class HaarFeatures:
    """Features of windows of one size: signed sums over rectangles, of pixels that are standardised.

    Parameters
    ----------
    height, width : int
        Of a window, in px.
    corners : ndarray of int, shape (features, 4, 4)
        Of up to four rectangles: first row, first column, one past the last row and column.
    signs : ndarray, shape (features, 4)
        1, -1, or 0 for a rectangle that is not there.

    References
    ----------
    Viola and Jones (2001), Rapid object detection using a boosted cascade of simple features, CVPR, sections
    2.1 and 5 (windows of variance one).
    """

    height: int
    width: int
    corners: np.ndarray
    signs: np.ndarray

    @classmethod
    def drawn(cls, height: int, width: int, count: int, rng: np.random.Generator) -> HaarFeatures:
        """Some of all features that fit into a window, as many of each kind.

        Raises
        ------
        MissingExtraError
            scikit-image is not installed.
        ParameterError
            The window is too small for them.
        """
        try:
            from skimage.feature import haar_like_feature_coord
        except ImportError:
            raise missing_extra("scikit-image", "vision") from None
        corners, signs = [], []
        for kind in KINDS:
            every, _ = haar_like_feature_coord(width, height, kind)
            if not len(every):
                raise ParameterError(f"HaarFeatures: no {kind} fits into {height} x {width} px")
            for k in rng.choice(
                len(every), min(len(every), -(-count // len(KINDS))), replace=False
            ):
                corner, sign = np.zeros((4, 4), dtype=np.intp), np.zeros(4)
                for j, ((top, left), (bottom, right)) in enumerate(every[k]):
                    corner[j] = top, left, bottom + 1, right + 1
                    sign[j] = _sign(kind, j)
                corners.append(corner)
                signs.append(sign)
        return cls(height, width, read_only(np.array(corners)), read_only(np.array(signs)))

    def picked(self, which: Any) -> HaarFeatures:
        """Those with given numbers, the others left at zero: they are not computed."""
        signs = np.zeros_like(self.signs)
        signs[which] = self.signs[which]
        return HaarFeatures(self.height, self.width, self.corners, read_only(signs))

    def of(self, frame: np.ndarray, top: Any, left: Any) -> np.ndarray:
        """Features of windows of a grey frame by their first rows and columns, shape (windows, features).

        Examples
        --------
        >>> import numpy as np
        >>> from bayesmc.vision.haar import HaarFeatures
        >>> halves = HaarFeatures(2, 4, np.array([[[0, 0, 2, 2], [0, 2, 2, 4]]]), np.array([[1.0, -1.0]]))
        >>> halves.of(np.array([[0.0, 0.0, 0.0, 1.0, 1.0]] * 2), [0, 0], [0, 1]).round(2).tolist()
        [[-0.58], [-1.0]]
        """
        sums, squares = integral(frame), integral(frame.astype(float) ** 2)
        top, left = np.asarray(top, dtype=np.intp), np.asarray(left, dtype=np.intp)
        bottom, right, area = top + self.height, left + self.width, self.height * self.width
        mean = rectangle_sums(sums, top, left, bottom, right) / area
        var = rectangle_sums(squares, top, left, bottom, right) / area - mean**2
        scale = area * np.sqrt(np.maximum(var, 1e-6 * np.maximum(mean**2, 1e-12)))
        found = np.zeros((len(self.signs), len(top)))
        for values, corners, signs in zip(found, self.corners, self.signs, strict=True):
            size = 0.0
            for (low_y, low_x, high_y, high_x), sign in zip(corners, signs, strict=False):
                if sign:
                    values += sign * rectangle_sums(
                        sums, top + low_y, left + low_x, top + high_y, left + high_x
                    )
                    size += sign * (high_y - low_y) * (high_x - low_x)
            values -= size * mean
        return (found / scale).T


def _sign(kind: str, rectangle: int) -> float:
    """As scikit-image has them: every second rectangle counts against the others."""
    return -1.0 if rectangle % 2 == 0 else 1.0
