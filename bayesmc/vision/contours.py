"""Outlines as B-splines, and the shapes they can take: a template moved and deformed linearly.

A state is what moves a template: an affine map about its middle, written so that zero is the template as it
was drawn and every component is in pixels. The outline is linear in the state, which is what Gaussian filters
and learned dynamics rest on.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.interpolate import BSpline

from bayesmc.distributions.base import as_float
from bayesmc.errors import ParameterError, ShapeError
from bayesmc.shapes import read_only

#: components of a state beyond the two of its place, as 2 x 2 matrices
_DEFORMATIONS = {
    "translation": np.zeros((0, 2, 2)),
    "similarity": np.array([[[1.0, 0.0], [0.0, 1.0]], [[0.0, -1.0], [1.0, 0.0]]]),
    "affine": np.array(
        [
            [[1.0, 0.0], [0.0, 0.0]],
            [[0.0, 0.0], [0.0, 1.0]],
            [[0.0, 1.0], [0.0, 0.0]],
            [[0.0, 0.0], [1.0, 0.0]],
        ]
    ),
}


@dataclass(frozen=True, eq=False)
class Contour:
    """An outline: a uniform B-spline of degree three.

    Parameters
    ----------
    control : array_like, shape (points, 2)
        Control points in px, in order along the outline; four at least. Neighbours may not all coincide.
    closed : bool
        Whether the last leads back to the first.

    Raises
    ------
    ShapeError, ParameterError
        Too few control points, ones that are no pairs of finite numbers, or all on one spot.

    References
    ----------
    Blake and Isard (1998), Active Contours, chapter 3.

    Examples
    --------
    >>> from bayesmc.vision import Contour
    >>> outline = Contour.ellipse((50.0, 40.0), (20.0, 30.0))
    >>> outline.center.round(6).tolist(), outline.points(4).round(0).tolist()
    ([50.0, 40.0], [[70.0, 40.0], [50.0, 70.0], [30.0, 40.0], [50.0, 10.0]])
    """

    control: np.ndarray
    closed: bool = True

    def __post_init__(self) -> None:
        control = np.array(self.control, dtype=float)
        if control.ndim != 2 or control.shape[1] != 2 or len(control) < 4:
            raise ShapeError(
                f"Contour: control has shape {control.shape}; give four or more points (x, y)"
            )
        if not np.isfinite(control).all() or np.ptp(control, axis=0).max() == 0:
            raise ParameterError("Contour: control points must be finite and not all on one spot")
        object.__setattr__(self, "control", read_only(control))

    @classmethod
    def through(cls, points: Any, control: int = 12, closed: bool = True) -> Contour:
        """The contour nearest to points along an outline, by least squares.

        Parameters
        ----------
        points : array_like, shape (n, 2)
            In px, in order along the outline, no fewer than ``control``; a closed one's first point need not
            be repeated.
        control : int
            Number of control points: the more, the finer the detail.
        closed : bool

        Raises
        ------
        ShapeError
            Fewer points than control points.
        """
        points = as_float(points)
        if points.ndim != 2 or points.shape[1:] != (2,) or len(points) < max(control, 4):
            raise ShapeError(
                f"Contour.through: points have shape {points.shape}; give {max(control, 4)} or more (x, y), "
                "or fewer control points"
            )
        ring = np.vstack([points, points[:1]]) if closed else points
        along = np.concatenate([[0.0], np.hypot(*np.diff(ring, axis=0).T).cumsum()])
        if along[-1] == 0:
            raise ParameterError("Contour.through: all points are on one spot")
        places = (along[:-1] if closed else along) / along[-1]
        basis = _basis(max(control, 4), places, closed)
        return cls(np.linalg.lstsq(basis, points, rcond=None)[0], closed)

    @classmethod
    def ellipse(cls, center: Any, semi_axes: Any, angle: float = 0.0, control: int = 12) -> Contour:
        """An ellipse.

        Parameters
        ----------
        center, semi_axes : pair of float
            In px.
        angle : float
            By which the first semi-axis is turned from +x towards +y (clockwise on the screen), in rad.
        control : int

        Raises
        ------
        ShapeError
            The centre or the semi-axes are no pair of numbers.
        ParameterError
            A semi-axis is not positive, or a number not finite.
        """
        middle, axes = _pair("center", center), _pair("semi_axes", semi_axes)
        if not (axes > 0).all():
            raise ParameterError(
                f"Contour.ellipse: semi_axes must be positive (px); got {semi_axes!r:.60}"
            )
        turn = np.linspace(0, 2 * np.pi, 20 * control, endpoint=False)
        x, y = np.cos(turn) * axes[0], np.sin(turn) * axes[1]
        c, s = np.cos(angle), np.sin(angle)
        points = np.stack([c * x - s * y, s * x + c * y], axis=-1) + middle
        basis = _basis(control, turn / (2 * np.pi), True)
        return cls(np.linalg.lstsq(basis, points, rcond=None)[0])

    @cached_property
    def center(self) -> np.ndarray:
        """Middle of the control points, (x, y) in px; of an ellipse its centre."""
        return self.control.mean(axis=0)

    @cached_property
    def radius(self) -> float:
        """Root mean square distance of the outline from its middle, in px."""
        return float(np.sqrt(((self.points(200) - self.center) ** 2).sum(axis=-1).mean()))

    def points(self, count: int = 100) -> np.ndarray:
        """Points along the outline at even steps of the spline's parameter, (count, 2)."""
        return self._at(count)[0] @ self.control

    def _at(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """What makes points, and tangents, of control points."""
        places = np.arange(count) / count if self.closed else np.linspace(0, 1, count)
        control = len(self.control)
        return _basis(control, places, self.closed), _basis(control, places, self.closed, 1)


@dataclass(frozen=True, eq=False)
class ShapeSpace:
    """The outlines that a template can become, each by a state: a vector of pixels, zero for the template.

    The first two components move the template by (x, y). The others deform it about its middle: ``a`` px
    moves the points at the template's root mean square distance from its middle by about ``a`` px.

    Parameters
    ----------
    template : Contour
    kind : str
        ``"affine"`` (6 components: place; growth in x, in y; shears of x by y, of y by x), ``"similarity"``
        (4: place, size, turn) or ``"translation"`` (2).

    Raises
    ------
    ParameterError
        Another kind.
    TypeError
        The template is no Contour.

    References
    ----------
    Isard and Blake (1998), CONDENSATION: conditional density propagation for visual tracking, IJCV 29,
    section 4.1 and the shape space of planar affine maps; Blake and Isard (1998), Active Contours,
    section 4.3.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.vision import Contour, ShapeSpace
    >>> space = ShapeSpace(Contour.ellipse((50.0, 40.0), (20.0, 20.0)), "similarity")
    >>> space.size, space.center([3.0, 0.0, 5.0, 0.0]).round(6).tolist()
    (4, [53.0, 40.0])
    >>> points = space.points([0.0, 0.0, 5.0, 0.0], 4)  # five pixels larger
    >>> np.hypot(*(points - [50.0, 40.0]).T).round(0).tolist()
    [25.0, 25.0, 25.0, 25.0]
    """

    template: Contour
    kind: str = "affine"

    def __post_init__(self) -> None:
        if not isinstance(self.template, Contour):
            raise TypeError(
                f"ShapeSpace: template must be a Contour, such as Contour.ellipse(...); got "
                f"{self.template!r:.60}"
            )
        if self.kind not in _DEFORMATIONS:
            raise ParameterError(
                f"ShapeSpace: kind must be one of {', '.join(map(repr, _DEFORMATIONS))}; got {self.kind!r}"
            )

    @property
    def size(self) -> int:
        """Components of a state."""
        return 2 + len(_DEFORMATIONS[self.kind])

    def points(self, state: Any, count: int = 100) -> np.ndarray:
        """Points along the outlines of states.

        Parameters
        ----------
        state : array_like, shape (..., size)
        count : int

        Returns
        -------
        ndarray, shape (..., count, 2)
            In px.
        """
        return self.place(state, self.template.points(count))

    def center(self, state: Any) -> np.ndarray:
        """The middles of the outlines of states, shape (..., 2), in px."""
        return self._checked(state)[..., :2] + self.template.center

    def place(self, state: Any, points: np.ndarray) -> np.ndarray:
        """Points of the template (n, 2) as states move them, shape (..., n, 2)."""
        state = self._checked(state)
        apart = points - self.template.center
        moved = apart @ np.swapaxes(self._matrix(state), -1, -2)
        return moved + (state[..., :2] + self.template.center)[..., None, :]

    def lines(self, state: Any, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Points along the outlines of states and unit normals there, both shape (..., count, 2)."""
        points, normals, _ = self._lines(state, count)
        return points, normals

    def _lines(self, state: Any, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """And how far apart they are, over how far on the template, (..., count)."""
        state = self._checked(state)
        at, along = self.template._at(count)
        apart = at @ self.template.control - self.template.center
        turned = np.swapaxes(self._matrix(state), -1, -2)
        points = apart @ turned + (state[..., :2] + self.template.center)[..., None, :]
        directions = along @ self.template.control
        tangents = directions @ turned
        normals = np.stack([tangents[..., 1], -tangents[..., 0]], axis=-1)
        length = np.sqrt(np.vecdot(normals, normals))
        normals /= np.where(length > 0, length, 1.0)[..., None]
        own = np.hypot(*directions.T)
        return points, normals, length / np.where(own > 0, own, 1.0)

    def basis(self, count: int) -> np.ndarray:
        """How points along the outline move with the state, shape (count, 2, size): linear throughout."""
        unit = np.eye(self.size)
        return np.moveaxis(
            self.points(unit, count) - self.points(np.zeros(self.size), count), 0, -1
        )

    def state_of(self, contour: Contour) -> np.ndarray:
        """The state whose outline is nearest to a contour of as many control points, by least squares.

        Raises
        ------
        ShapeError
            The contours have different numbers of control points, or one is closed and the other not.
        """
        if (
            contour.control.shape != self.template.control.shape
            or contour.closed != self.template.closed
        ):
            raise ShapeError(
                f"ShapeSpace.state_of: the contour has {len(contour.control)} control points (closed: "
                f"{contour.closed}), the template {len(self.template.control)} (closed: "
                f"{self.template.closed})"
            )
        design = self.basis(200).reshape(400, self.size)
        apart = contour.points(200) - self.template.points(200)
        return np.linalg.lstsq(design, apart.reshape(400), rcond=None)[0]

    def _checked(self, state: Any) -> np.ndarray:
        state = as_float(state)
        if state.shape[-1:] != (self.size,):
            raise ShapeError(
                f"ShapeSpace: states have shape {state.shape}; {self.kind} ones have {self.size} "
                f"components on "
                "the last axis"
            )
        return state

    def _matrix(self, state: np.ndarray) -> np.ndarray:
        """The deformations of states, shape (..., 2, 2)."""
        rest = state[..., 2:] / self.template.radius
        return np.eye(2) + np.tensordot(rest, _DEFORMATIONS[self.kind], axes=1)


# ---- private ------------------------------------------------------------------------------------


def _pair(name: str, value: Any) -> np.ndarray:
    found = as_float(value)
    if found.shape != (2,):
        raise ShapeError(
            f"Contour.ellipse: {name} is {value!r:.60}; give a pair of numbers in px, such as (20.0, 30.0)"
        )
    if not np.isfinite(found).all():
        raise ParameterError(f"Contour.ellipse: {name} must be finite; got {value!r:.60}")
    return found


def _basis(control: int, places: np.ndarray, closed: bool, derivative: int = 0) -> np.ndarray:
    """Values (or derivatives) of the spline's basis at places in 0..1, shape (places, control)."""
    if closed:
        # control points repeat past the end
        knots = np.arange(-3, control + 4, dtype=float)
        at = np.mod(places * control + 1.0, control)
        wide = BSpline(knots, np.eye(control + 3), 3).derivative(derivative)(at)
        found = wide[:, :control].copy()
        found[:, :3] += wide[:, control:]
        return np.roll(found, -2, axis=1)  # the weights at place 0 are greatest at point 0
    knots = np.concatenate([np.zeros(3), np.linspace(0, 1, control - 2), np.ones(3)])
    return BSpline(knots, np.eye(control), 3).derivative(derivative)(places)
