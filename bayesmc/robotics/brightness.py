"""A brightness sensor that looks at a ceiling: one number per step, from a picture seen from below.

It is the sensor of the museum robot of 1999: a camera reduced to the brightness straight above it.
The picture is an array; how it was made, by stitching or by a generator, is not decided here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions import Normal
from bayesmc.distributions.base import as_float
from bayesmc.errors import ParameterError, ShapeError
from bayesmc.expression import as_one_call
from bayesmc.shapes import first_index


@dataclass(frozen=True, eq=False)
class Ceiling:
    """Brightness of a ceiling above each place.

    Parameters
    ----------
    image : array_like, shape (nx, ny)
        Brightness above cell ``[ix, iy]``, along x and y, in any unit. A picture read with rows
        from the top down is ``picture[::-1].T``.
    resolution : float
        Side of a cell in metres.
    origin : (float, float)
        World coordinates (m) of the lower left corner of cell ``[0, 0]``.

    Raises
    ------
    ShapeError
        The image does not have two axes, or is empty.
    ParameterError
        A brightness is not finite, the resolution is not positive, the origin not two finite
        numbers.

    Notes
    -----
    Between the centres of cells brightness is interpolated bilinearly; beyond the image
    the ceiling goes on as it is at the edge.

    References
    ----------
    Dellaert, Burgard, Fox and Thrun (1999), Using the condensation algorithm
    for robust, vision-based mobile robot localization, CVPR.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.robotics.brightness import Ceiling
    >>> ceiling = Ceiling([[0.0, 0.0], [1.0, 1.0]], resolution=1.0)
    >>> ceiling.brightness([[0.5, 1.0], [1.25, 1.0], [9.0, 1.0]]).tolist()
    [0.0, 0.75, 1.0]
    >>> float(ceiling.given([1.5, 0.5, 0.0], scale=0.1).log_prob(0.8).round(4))  # from a pose
    -0.6164
    """

    image: np.ndarray
    resolution: float
    origin: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        image = np.array(self.image, dtype=float)
        if image.ndim != 2 or not image.size:
            raise ShapeError(
                f"Ceiling: the image has shape {image.shape}; give an array (nx, ny) with at least one cell "
                "(grey, not colour)"
            )
        bad = ~np.isfinite(image)
        if bad.any():
            at = first_index(bad)
            raise ParameterError(
                f"Ceiling: brightness must be finite; got {image[at]} at cell {at}", at, image[at]
            )
        if not 0 < self.resolution < math.inf:
            raise ParameterError(
                f"Ceiling: resolution must be positive and finite; got {self.resolution!r}"
            )
        origin = np.asarray(self.origin, dtype=float)
        if origin.shape != (2,) or not np.isfinite(origin).all():
            raise ParameterError(
                f"Ceiling: origin must be two finite numbers; got {self.origin!r:.80}"
            )
        image.flags.writeable = False
        object.__setattr__(self, "image", image)
        object.__setattr__(self, "origin", (float(origin[0]), float(origin[1])))

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """``(left, right, bottom, top)`` in metres, for ``imshow(ceiling.image.T, origin="lower")``."""
        (x, y), (nx, ny) = self.origin, self.image.shape
        return x, x + nx * self.resolution, y, y + ny * self.resolution

    @as_one_call
    def brightness(self, places: Any) -> np.ndarray:
        """Brightness above places, interpolated.

        Parameters
        ----------
        places : array_like, shape (..., >= 2)
            World coordinates (m) in the first two components: positions or poses; NaN gives NaN.

        Returns
        -------
        ndarray, shape (...)
        """
        places = as_float(places)
        if places.ndim == 0 or places.shape[-1] < 2:
            raise ShapeError(
                f"Ceiling: places have shape {places.shape}; give (..., 2) positions or (..., 3) poses"
            )
        (low_x, high_x, u), (low_y, high_y, v) = (self._between(places, axis) for axis in (0, 1))
        image = self.image
        left = (1 - v) * image[low_x, low_y] + v * image[low_x, high_y]
        right = (1 - v) * image[high_x, low_y] + v * image[high_x, high_y]
        return (1 - u) * left + u * right

    def given(self, place: Any, scale: Any) -> Normal:
        """The sensor's reading at places, normal about the brightness there.

        Parameters
        ----------
        place : array_like, shape (..., >= 2)
            Positions or poses.
        scale : array_like
            Standard deviation of a reading; broadcasts with ``...``.

        Returns
        -------
        Normal
        """
        return Normal(self.brightness(place), scale)

    def likelihood_image(self, reading: float, scale: float) -> np.ndarray:
        """How well a reading fits each cell: likelihoods over the greatest one, shape (nx, ny).

        Parameters
        ----------
        reading : float
        scale : float
            Standard deviation of a reading.
        """
        log = Normal(self.image, scale).log_prob(reading)
        return np.exp(log - log.max())

    def _between(self, places: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The cells whose centres a coordinate lies between, and how far it is on the way."""
        last = self.image.shape[axis] - 1
        with np.errstate(invalid="ignore", over="ignore"):
            at = (places[..., axis] - self.origin[axis]) / self.resolution - 0.5
            at = np.clip(at, 0, last)
            low = np.minimum(np.nan_to_num(at).astype(np.int64), max(last - 1, 0))
        return low, np.minimum(low + 1, last), at - low
