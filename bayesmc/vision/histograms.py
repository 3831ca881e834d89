"""How like a box's colours are to those of a thing: histograms, whatever the thing's pose."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bayesmc.distributions.base import as_float
from bayesmc.distributions.parameters import as_number
from bayesmc.errors import ParameterError, ShapeError, missing_extra
from bayesmc.expression import as_one_call
from bayesmc.shapes import Shape
from bayesmc.vision.pictures import Kept, OfFrame, check_frame_shape

#: colours with less saturation or value than this have no hue to speak of
_FAINT = 0.1
#: values may be above white by this factor, of noise
_OVER = 1.1


@dataclass(frozen=True, eq=False)
class Histograms:
    """Densities of frames given the box of a thing whose histogram is known.

    With the Bhattacharyya distance ``d^2 = 1 - sum_b sqrt(h_b reference_b)`` of a box's histogram h, the
    density over that of background alone is ``exp(sharpness (background - d^2))``. Of grey frames the
    bins are of brightness; of colour, of hue and saturation (bins x bins), and of value where there is
    no hue.

    Parameters
    ----------
    frame_shape : tuple of int
        (height, width) or (height, width, 3).
    reference : array_like, shape (cells,), optional
        Histogram of the thing, such as ``of`` gives it; needed for ``given``.
    bins : int
    sharpness : float
        The greater, the more a difference counts.
    background : float
        ``d^2`` of a box of background.
    white : float
        The largest value that a frame can have: 255, 1 of frames in 0..1, 65535 of 16 bits.

    Raises
    ------
    ParameterError
        A number out of range. From ``of`` and ``log_prob``: values of a frame are beyond ``white``, or so
        small against it that all are in one bin; frames of zeros are dark, and taken.
    ShapeError
        The reference has another number of cells.

    References
    ----------
    Perez, Hue, Vermaak and Gangnet (2002), Color-based probabilistic tracking, ECCV, sections 2.2 and 2.3, as
    Okuma et al. (2004), A boosted particle filter, section 2.2, have it (sharpness 20).

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.vision import Histograms
    >>> frame = np.zeros((40, 60))
    >>> frame[10:20, 30:40] = 200.0
    >>> plain = Histograms(frame.shape)
    >>> seen = Histograms(frame.shape, plain.of(frame, [34.5, 14.5, 10.0, 10.0]))
    >>> at = [[x, 14.5, np.log(10.0), np.log(10.0), 0.0, 0.0] for x in (34.5, 39.5, 50.0)]
    >>> seen.given(at).log_prob(frame).round(1).tolist()
    [10.0, 4.1, -10.0]
    """

    frame_shape: Shape
    reference: np.ndarray | None = None
    bins: int = 8
    sharpness: float = 20.0
    background: float = 0.5
    white: float = 255.0
    _cells: Kept = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "frame_shape", check_frame_shape("Histograms", self.frame_shape))
        if (
            isinstance(self.bins, bool)
            or not isinstance(self.bins, (int, np.integer))
            or self.bins < 2
        ):
            raise ParameterError(f"Histograms: bins must be 2 or more; got {self.bins!r:.60}")
        if not 0 < as_number(self.sharpness) < math.inf:
            raise ParameterError(
                f"Histograms: sharpness must be positive; got {self.sharpness!r:.60}"
            )
        if not 0 < as_number(self.white) < math.inf:
            raise ParameterError(
                f"Histograms: white must be positive and finite; got {self.white!r:.60}"
            )
        if not 0 <= as_number(self.background) <= 1:
            raise ParameterError(
                f"Histograms: background must lie in 0..1; got {self.background!r:.60}"
            )
        if self.reference is not None:
            reference = as_float(self.reference)
            if reference.shape != (self.cells,):
                raise ShapeError(
                    f"Histograms: reference has shape {reference.shape}; these frames have {self.cells} cells"
                )
            if not (reference >= 0).all() or not 0 < reference.sum() < math.inf:
                raise ParameterError("Histograms: reference must be counts or shares, not all zero")
            object.__setattr__(self, "reference", reference / reference.sum())
        object.__setattr__(self, "_cells", Kept(self._counted))

    @property
    def cells(self) -> int:
        """Cells of a histogram."""
        return self.bins if len(self.frame_shape) == 2 else self.bins * (self.bins + 1)

    def of(self, frame: Any, boxes: Any) -> np.ndarray:
        """Histograms of boxes, as shares; even where a box lies outside the frame.

        Parameters
        ----------
        frame : array_like, of ``frame_shape``
        boxes : array_like, shape (..., 4 or more)
            (x, y, width, height, ...).

        Returns
        -------
        ndarray, shape (..., cells)

        Raises
        ------
        ShapeError
            The frame has another shape.
        ParameterError
            A box has no size, or the frame's values are of another range than ``white`` says.
        """
        frame, boxes = as_float(frame), as_float(boxes)
        if frame.shape != self.frame_shape:
            raise ShapeError(
                f"Histograms: the frame has shape {frame.shape}, not {self.frame_shape}"
            )
        if not (boxes[..., 2:4] > 0).all():
            raise ParameterError(
                "Histograms.of: a box has no width or height; give (x, y, width, height)"
            )
        self._check_levels(frame, whole=True)
        return self._shares(frame, boxes)

    @as_one_call
    def given(self, box: Any, present: Any = True) -> OfFrame:
        """The density of a frame given states (..., 6): x, y, log width, log height, and speeds.

        ``present`` is of shape (...); of what is absent the density is that of background.

        Raises
        ------
        ParameterError
            There is no reference.
        """
        if self.reference is None:
            raise ParameterError(
                "Histograms.given: there is no reference= to compare with; Histograms.of makes one"
            )
        box, present = as_float(box), np.asarray(present, dtype=float)
        lead = np.broadcast_shapes(box.shape[:-1], present.shape)
        states = np.empty((*lead, 5))
        states[..., :2], states[..., 2:4] = (
            box[..., :2],
            np.exp(np.clip(box[..., 2:4], -20.0, 20.0)),
        )
        states[..., 4] = present
        return OfFrame(self._score, states, self.frame_shape)

    # ---- private -------------------------------------------------------------------------------

    def _score(self, frame: np.ndarray, states: np.ndarray) -> np.ndarray:
        assert self.reference is not None
        alike = np.sqrt(self._shares(frame, states) * self.reference).sum(axis=-1)
        return np.where(states[:, 4] != 0, self.sharpness * (self.background - 1 + alike), 0.0)

    def _shares(self, frame: np.ndarray, boxes: np.ndarray) -> np.ndarray:
        sums = self._cells(frame)
        height, width = self.frame_shape[:2]
        sides = []
        for axis, size in ((0, width), (1, height)):
            half = boxes[..., axis + 2] / 2
            low = np.rint(np.clip(boxes[..., axis] - half + 0.5, 0, size)).astype(np.intp)
            high = np.rint(np.clip(boxes[..., axis] + half + 0.5, 0, size)).astype(np.intp)
            sides.append((low, high))
        (left, right), (top, bottom) = sides
        found = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
        total = found.sum(axis=-1, keepdims=True)
        return np.where(total > 0, found / np.where(total > 0, total, 1.0), 1.0 / self.cells)

    def _counted(self, frame: np.ndarray) -> np.ndarray:
        """Integral histogram (Porikli 2005): counts of each cell above and to the left of a pixel."""
        self._check_levels(frame)
        height, width = self.frame_shape[:2]
        found = np.zeros((height + 1, width + 1, self.cells))
        which = self._cell_of(frame)
        found[1:, 1:] = which[..., None] == np.arange(self.cells)
        return found.cumsum(axis=0, out=found).cumsum(axis=1, out=found)

    def _check_levels(self, frame: np.ndarray, whole: bool = False) -> None:
        """Refuse values of another range; whole numbers may be those of a frame that is nearly dark."""
        high = float(frame.max())
        if high > _OVER * self.white:
            raise ParameterError(
                f"Histograms: a frame has values up to {high:g}, and white={self.white:g}: all above would "
                "be in one bin; say what white is (white=65535 of 16 bits, 4095 of 12), or scale the frames"
            )
        dark = 0 < high <= self.white / 255
        if dark and (whole or (frame != np.rint(frame)).any()):
            raise ParameterError(
                f"Histograms: a frame has no values above {high:g}, and white={self.white:g}: all would be "
                "in one bin; say white=1 of frames in 0..1, or scale the frames"
            )

    def _cell_of(self, frame: np.ndarray) -> np.ndarray:
        def binned(share: np.ndarray) -> np.ndarray:
            return np.clip((share * self.bins).astype(np.intp), 0, self.bins - 1)

        if frame.ndim == 2:
            return binned(frame * (255.0 / 256.0 / self.white))
        try:
            from skimage.color import rgb2hsv
        except ImportError:
            raise missing_extra("scikit-image", "vision") from None
        hue, saturation, value = np.moveaxis(rgb2hsv(np.clip(frame / self.white, 0, 1)), -1, 0)
        coloured = (saturation > _FAINT) & (value > _FAINT)
        return np.where(
            coloured, binned(hue) * self.bins + binned(saturation), self.bins**2 + binned(value)
        )
