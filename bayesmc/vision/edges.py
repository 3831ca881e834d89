"""How well a frame's edges lie along a contour: features on its normals, among clutter.

Along each normal of a contour the strongest changes of brightness are features. One of them may be the
outline of the thing that is followed; the others are clutter, and the outline may have been missed. What
comes out is a ratio: the density of the features with the thing there over that without it.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.special import ndtr

from bayesmc.distributions.base import as_float
from bayesmc.distributions.parameters import as_number
from bayesmc.errors import ModelError, ModelMisfitWarning, ParameterError
from bayesmc.expression import as_one_call
from bayesmc.shapes import Shape
from bayesmc.vision.contours import ShapeSpace
from bayesmc.vision.pictures import Kept, OfFrame, check_frame_shape, grey

#: states whose normals are looked at together, times points on these
_AT_ONCE = 1 << 18
#: features per px of a picture without any
_LEAST_CLUTTER = 1e-3
#: stands for no change at all along an axis
_NO_STEP = 1e-12

#: fields with a margin of one px and their width; the least change that is a feature; features per px
_Prepared = tuple[tuple[np.ndarray, np.ndarray, int], float, float]


@dataclass(frozen=True, eq=False)
class ContourEdges:
    """Densities of frames given where a contour is.

    On each of ``lines`` normals, ``reach`` px to both sides, features are the places where the frame changes
    most along the normal. With features at distances ``v_j`` from the outline a normal counts::

        1 - (1 - missed) * seen + (1 - missed) / clutter * sum_j Normal(v_j; 0, sigma)

    which is the density of what was found over that of clutter alone: features of clutter come as a Poisson
    process of rate ``clutter``, and the outline gives one, at most. ``seen`` is the probability that this one
    lies where it is looked for: the mass of the normal density over that part of the line which is within
    ``reach`` and in the frame. In the middle of a frame it is 1, all but. A line outside the frame was not
    searched, and counts 1: it says neither that the outline is there nor that it is not. So outlines of
    which different parts are in the frame compare with each other, and with one that is out of sight, whose
    log density is 0. The log density is the sum of the logarithms over the normals, times ``tempering``.
    Where normals are closer together than on the template they see one edge several times: what they find (a
    logarithm above 0) counts by how close they are, and what they miss counts in full.

    Parameters
    ----------
    space : ShapeSpace
    frame_shape : tuple of int
        ``frames.shape[1:]``: (height, width), or (height, width, 3), which is looked at in grey.
    sigma : float
        Standard deviation (px) of a feature about the outline, the roughness of the template included.
    reach : float
        Length (px) of the normals to either side; by default four times ``sigma``.
    lines : int
        Normals, at even steps along the template; by default one every five px.
    missed : float
        Probability that the outline gives no feature on a normal, between 0 and 1, both excluded.
    clutter : float, optional
        Features of clutter per px of a normal. By default those on the frame's own rows and columns.
    contrast : float
        What counts as a feature: a change of brightness per px, over the root mean square of the frame's.
    smoothing : float
        Standard deviation (px) of the Gaussian by which frames are smoothed.
    tempering : float
        Power of the density. Normals that stand close together err together, and 1 takes all of them for
        independent.

    Raises
    ------
    ParameterError
        A number out of range.
    ShapeError
        ``frame_shape`` is no frame's.
    ModelError
        From ``log_prob``: several outlines are all farther off the frame than it is wide.

    Warns
    -----
    ModelMisfitWarning
        From ``log_prob``: of several outlines none is in sight, so that the frame weighs all the same.

    References
    ----------
    Isard and Blake (1998), CONDENSATION: conditional density propagation for visual tracking, IJCV 29,
    section 4.3 (one normal, with ``alpha = missed * clutter / (1 - missed)``) and 4.4. That ``seen`` is below
    1 where a line is cut off follows from their generative model, of which they have whole lines only.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.vision import Contour, ContourEdges, ShapeSpace
    >>> y, x = np.mgrid[:60, :80]
    >>> frame = 100.0 * (np.hypot(x - 40, y - 30) < 15)
    >>> space = ShapeSpace(Contour.ellipse((40.0, 30.0), (15.0, 15.0)), "translation")
    >>> edges = ContourEdges(space, frame.shape)
    >>> there = edges.given([[0.0, 0.0], [4.0, 0.0], [20.0, 0.0]]).log_prob(frame)
    >>> (np.diff(there) < 0).tolist(), bool(there[0] > 0 > there[2])
    ([True, True], True)
    """

    space: ShapeSpace
    frame_shape: Shape
    sigma: float = 2.5
    reach: float | None = None
    lines: int | None = None
    missed: float = 0.3
    clutter: float | None = None
    contrast: float = 1.0
    smoothing: float = 1.5
    tempering: float = 0.5
    _fields: Kept = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not isinstance(self.space, ShapeSpace):
            raise TypeError(f"ContourEdges: space must be a ShapeSpace; got {self.space!r:.60}")
        frame_shape = check_frame_shape("ContourEdges", self.frame_shape)
        object.__setattr__(self, "frame_shape", frame_shape)
        if self.reach is None:
            object.__setattr__(self, "reach", 4.0 * as_number(self.sigma))
        if self.lines is None:
            outline = self.space.template.points(200)
            length = np.hypot(*np.diff(outline, axis=0).T).sum()
            object.__setattr__(self, "lines", max(12, round(length / 5.0)))
        for name in ("sigma", "reach", "contrast", "smoothing", "tempering", "clutter"):
            value = getattr(self, name)
            if value is not None and not 0 < as_number(value) < math.inf:
                raise ParameterError(
                    f"ContourEdges: {name} must be positive and finite; got {value!r:.60}"
                )
        if not 0 < as_number(self.missed) < 1:
            raise ParameterError(
                f"ContourEdges: missed must lie between 0 and 1; got {self.missed!r:.60}: at 0 a "
                f"single normal "
                "without a feature would rule a state out"
            )
        if not isinstance(self.lines, (int, np.integer)) or self.lines < 1:
            raise ParameterError(f"ContourEdges: lines must be 1 or more; got {self.lines!r:.60}")
        object.__setattr__(self, "_fields", Kept(self._prepared))

    @as_one_call
    def given(self, state: Any) -> OfFrame:
        """The density of a frame at states.

        Parameters
        ----------
        state : array_like, shape (..., space.size)

        Returns
        -------
        OfFrame
            Batch shape (...), event shape ``frame_shape``.
        """
        return OfFrame(self._score, self.space._checked(state), self.frame_shape)

    def nearest(self, frame: Any, state: Any) -> tuple[np.ndarray, np.ndarray]:
        """What a tracker of one hypothesis measures: on each normal of a state the feature nearest to it.

        Parameters
        ----------
        frame : array_like, of ``frame_shape``
        state : array_like, shape (space.size,)

        Returns
        -------
        rows : ndarray, shape (lines, space.size)
            How far each point moves along its normal with the state.
        values : ndarray, shape (lines,)
            What ``rows @ state`` was measured to be, in px; NaN where no feature is within reach.

        References
        ----------
        Blake, Curwen and Zisserman (1993), A framework for spatiotemporal control in the tracking of visual
        contours, IJCV 11.
        """
        state = self.space._checked(state)
        prepared, lines = self._fields(as_float(frame)), int(self.lines or 0)
        found, offsets = self._features(prepared, *self.space.lines(state[None], lines))
        apart = np.where(found[0], np.abs(offsets), np.inf)
        at = apart.argmin(axis=-1)
        moved = np.where(np.isfinite(apart.min(axis=-1)), offsets[at], np.nan)
        _, normals = self.space.lines(state, lines)
        rows = np.einsum("li,lis->ls", normals, self.space.basis(lines))
        return rows, rows @ state + moved

    # ---- private -------------------------------------------------------------------------------

    def _score(self, frame: np.ndarray, states: np.ndarray) -> np.ndarray:
        prepared, lines = self._fields(frame), int(self.lines or 0)
        rate = prepared[2] if self.clutter is None else self.clutter
        log, in_sight, there = np.empty(len(states)), False, np.float32(1 - self.missed)
        step = max(1, _AT_ONCE // (lines * (2 * self._reach + 1)))
        for start in range(0, len(states), step):
            part = slice(start, start + step)
            points, normals, share = self.space._lines(states[part], lines)
            found, offsets = self._features(prepared, points, normals)
            near = np.exp(-0.5 * (offsets / self.sigma) ** 2) / (
                math.sqrt(2 * math.pi) * self.sigma
            )
            near = (near / rate).astype(np.float32)
            seen = self._seen(points, normals)
            in_sight |= bool(seen.any())
            ratio = 1 + there * (found.astype(np.float32) @ near - seen)
            each = np.log(ratio)
            log[part] = np.where(each > 0, each * np.minimum(share, 1.0), each).sum(axis=-1)
        if not in_sight and len(states) > 1:
            self._out_of_sight(states)
        return self.tempering * log

    @property
    def _reach(self) -> int:
        """Whole px of a normal to either side."""
        return int(np.ceil(float(self.reach or 0)))

    def _seen(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Probability that the outline's own feature lies where it would be found, (n, lines).

        Found is what stands out from both neighbours along the normal, so these are in the frame, too.
        """
        height, width = self.frame_shape[:2]
        whole = np.float32(2 * ndtr((self._reach + 0.5) / self.sigma) - 1)
        margin = self._reach + 2
        x, y = points[..., 0], points[..., 1]
        if (
            x.min(initial=margin) >= margin
            and y.min(initial=margin) >= margin
            and x.max(initial=0) <= width - 1 - margin
            and y.max(initial=0) <= height - 1 - margin
        ):
            return np.broadcast_to(whole, x.shape)
        low, high = np.full(x.shape, -np.inf), np.full(x.shape, np.inf)
        for axis, size in ((0, width), (1, height)):
            step = normals[..., axis]
            step = np.where(np.abs(step) < _NO_STEP, _NO_STEP, step)
            with np.errstate(over="ignore"):
                one, other = ((end - points[..., axis]) / step for end in (-0.5, size - 0.5))
            np.maximum(low, np.minimum(one, other), out=low)
            np.minimum(high, np.maximum(one, other), out=high)
        first = np.clip(np.ceil(low + 1), -self._reach, self._reach + 1)
        last = np.clip(np.floor(high - 1), -self._reach - 1, self._reach)
        mass = ndtr((last + 0.5) / self.sigma) - ndtr((first - 0.5) / self.sigma)
        return np.where(last >= first, mass, 0.0).astype(np.float32)

    def _out_of_sight(self, states: np.ndarray) -> None:
        """Say that no outline is in sight; so far off that none can have meant it, refuse."""
        height, width = self.frame_shape[:2]
        points, _ = self.space.lines(states, int(self.lines or 0))
        x, y = points[..., 0], points[..., 1]
        away = float(
            np.maximum(np.maximum(-x, x - width + 1), np.maximum(-y, y - height + 1)).min()
        )
        if away > max(self._reach, math.hypot(width, height)):
            raise ModelError(
                f"ContourEdges: all of {len(states)} outlines are {away:.3g} px or more off the picture, "
                f"which spans x 0 to {width - 1} and y 0 to {height - 1} px; no normal reaches that far: is "
                "the start given in pixels, as (x, y), and where the template is?"
            )
        warnings.warn(
            "ContourEdges: none of several outlines is in the picture, so that a frame weighs all of them "
            "the same: where they are is what their dynamics say. It may be that the thing has left; it is "
            "found again if some outline goes where it comes back",
            ModelMisfitWarning,
            stacklevel=2,
        )

    def _prepared(self, frame: np.ndarray) -> _Prepared:
        """Changes of brightness to the right and down, what is a feature, and how many there are per px."""
        smooth = gaussian_filter(grey(frame), self.smoothing, mode="nearest")
        down, right = np.gradient(smooth)
        least = max(self.contrast * float(np.sqrt((right**2 + down**2).mean() / 2)), 1e-9)
        features = _peaks(np.abs(right), least).sum() + _peaks(np.abs(down.T), least).sum()
        rate = max(float(features) / (2 * smooth.size), _LEAST_CLUTTER)
        right, down = (
            np.pad(part.astype(np.float32), 1, constant_values=np.nan) for part in (right, down)
        )
        return (right.ravel(), down.ravel(), right.shape[1]), least, rate

    def _features(
        self, prepared: _Prepared, points: np.ndarray, normals: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Where on normals (n, lines, 2) there are features, (n, lines, offsets), and the offsets in px."""
        (right, down, width), least, _ = prepared
        # one more at either end, to tell peaks
        offsets = np.arange(-self._reach - 1.0, self._reach + 2.0)
        nx, ny = (normals[..., None, axis].astype(np.float32) for axis in (0, 1))
        along = offsets.astype(np.float32)
        height = len(right) // width
        # the fields have a margin of one, where nothing is known
        x = points[..., None, 0].astype(np.float32) + along * nx
        y = points[..., None, 1].astype(np.float32) + along * ny
        for place, size in ((x, width), (y, height)):
            place += 1.5
            np.clip(place, 0, size - 1, out=place)
        flat = y.astype(np.int32)
        flat *= width
        flat += x.astype(np.int32)
        change = np.take(right, flat, out=x, mode="clip")
        change *= nx
        across = np.take(down, flat, out=y, mode="clip")
        across *= ny
        change += across
        np.abs(change, out=change)
        return _peaks(change, least)[..., 1:-1], offsets[1:-1]


# ---- private ------------------------------------------------------------------------------------


def _peaks(change: np.ndarray, least: float) -> np.ndarray:
    """Where changes are at least so great, and greater than those before and no less than those after."""
    found = change >= least
    found[..., 1:] &= change[..., 1:] > change[..., :-1]
    found[..., :-1] &= change[..., :-1] >= change[..., 1:]
    return found
