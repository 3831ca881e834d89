"""Frames as arrays, and densities of a whole frame: what every other module of the room stands on.

A frame is an array (height, width) of grey values, or (height, width, 3) of colours. Points in it are (x, y)
in pixels: x to the right, y down, and (0, 0) the middle of the first pixel, as ``imshow`` has it.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import numpy as np

from bayesmc.distributions import Density
from bayesmc.distributions.base import as_float
from bayesmc.errors import ParameterError, ShapeError
from bayesmc.shapes import Shape, broadcast_shapes

#: frames whose filtered versions are kept: blocks of particles ask for the same one, one after the other
_KEPT = 4


def as_frames(frames: Any) -> np.ndarray:
    """Frames of a clip as one array of floats.

    Parameters
    ----------
    frames : array_like or sequence of array_like
        Each (height, width) or (height, width, 3), all of one size.

    Returns
    -------
    ndarray, shape (time, height, width) or (time, height, width, 3)

    Raises
    ------
    ShapeError
        There is no frame, frames differ in size, or they are no pictures; the message names the frame.
    ParameterError
        A frame holds a number that is not finite.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.vision import as_frames
    >>> as_frames([np.zeros((4, 6)), np.ones((4, 6))]).shape
    (2, 4, 6)
    >>> as_frames([np.zeros((4, 6)), np.ones((6, 4))])
    Traceback (most recent call last):
        ...
    bayesmc.errors.ShapeError: as_frames: frame 1 has shape (6, 4), and frame 0 (4, 6); give ...
    """
    several = list(frames) if isinstance(frames, np.ndarray) or np.iterable(frames) else [frames]
    if not several:
        raise ShapeError("as_frames: there are no frames; give at least one, (height, width)")
    found = [_as_frame(frame, k) for k, frame in enumerate(several)]
    for k, frame in enumerate(found):
        if frame.shape != found[0].shape:
            raise ShapeError(
                f"as_frames: frame {k} has shape {frame.shape}, and frame 0 {found[0].shape}; give frames of "
                "one size"
            )
    return np.stack(found)


def grey(frames: Any) -> np.ndarray:
    """Frames in grey: luma of colours (Rec. 601), grey frames as they are.

    Parameters
    ----------
    frames : array_like, shape (..., height, width) or (..., height, width, 3)

    Returns
    -------
    ndarray, shape (..., height, width)

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.vision import grey
    >>> grey(np.ones((5, 4, 6, 3))).shape
    (5, 4, 6)
    """
    frames = as_float(frames)
    if frames.ndim >= 3 and frames.shape[-1] == 3:
        return frames @ np.array([0.299, 0.587, 0.114])
    return frames


class OfFrame(Density):
    """The density of a frame given numbers (where a thing is), up to a constant: a ratio of likelihoods.

    It cannot be drawn from: nothing here says what a picture as a whole looks like.

    Parameters
    ----------
    score : callable
        ``score(frame, states)``: log densities, shape (n,), of one frame at states of shape (n, size).
    states : ndarray, shape (..., size)
    frame_shape : tuple of int

    Raises
    ------
    ParameterError
        A state is not finite.
    """

    def __init__(
        self,
        score: Callable[[np.ndarray, np.ndarray], np.ndarray],
        states: np.ndarray,
        frame_shape: Shape,
    ) -> None:
        self._score, self.states = score, states
        super().__init__(self._of, event_shape=frame_shape, batch_shape=states.shape[:-1])
        if not np.isfinite(np.add.reduce(states, axis=None)):  # cheaper than every element
            ok = np.isfinite(states).all(axis=-1)
            self.states = self._check("states", states, ok, 0.0, "finite")

    def parameters(self) -> list[tuple[np.ndarray, int]]:
        return [(self.states, 1)]

    def _of(self, x: np.ndarray) -> np.ndarray:
        lead = x.shape[: x.ndim - len(self.event_shape)]
        batch, size = self.states.shape[:-1], self.states.shape[-1:]
        if all(n == 1 for n in lead):
            found = self._score(x.reshape(self.event_shape), self.states.reshape(-1, *size))
            return found.reshape(broadcast_shapes(lead, batch))
        # as many frames as there are places in the leading axes: each is looked at once
        whole = broadcast_shapes(lead, batch)
        lead = (1,) * (len(whole) - len(lead)) + lead
        pictures = x.reshape(lead + self.event_shape)
        states, found = np.broadcast_to(self.states, whole + size), np.empty(whole)
        for index in np.ndindex(*lead):
            at = tuple(i if n > 1 else slice(None) for i, n in zip(index, lead, strict=True))
            part = states[at]
            scores = self._score(pictures[index], part.reshape(-1, *size))
            found[at] = scores.reshape(part.shape[:-1])
        return found


class Kept:
    """What is computed of a frame, kept for the last few: many particles are weighed against the same one."""

    def __init__(self, function: Callable[[np.ndarray], Any]) -> None:
        self._function = function
        self._kept: OrderedDict[tuple[Shape, bytes], Any] = OrderedDict()
        self._lock = threading.Lock()

    def __call__(self, frame: np.ndarray) -> Any:
        key = frame.shape, frame.tobytes()
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key]
        found = self._function(frame)
        with self._lock:
            self._kept[key] = found
            while len(self._kept) > _KEPT:
                self._kept.popitem(last=False)
        return found

    def __reduce__(self) -> Any:
        return Kept, (self._function,)


def check_frame_shape(what: str, frame_shape: Any) -> Shape:
    """The shape of a frame, as a tuple.

    Raises
    ------
    ShapeError
    """
    found = tuple(int(n) for n in np.atleast_1d(frame_shape))
    if len(found) not in (2, 3) or min(found) < 2 or (len(found) == 3 and found[2] != 3):
        raise ShapeError(
            f"{what}: frame_shape is {frame_shape!r:.80}; give (height, width) of grey frames or (height, "
            "width, 3) of colour, such as frames.shape[1:]"
        )
    return found


def _as_frame(frame: Any, k: int) -> np.ndarray:
    try:
        found = np.asarray(frame, dtype=float)
    except (TypeError, ValueError):
        raise ShapeError(f"as_frames: frame {k} is no array of numbers: {frame!r:.60}") from None
    if found.ndim not in (2, 3) or (found.ndim == 3 and found.shape[2] != 3) or not found.size:
        raise ShapeError(
            f"as_frames: frame {k} has shape {found.shape}; give (height, width), or (height, width, 3) in "
            "colour; a clip is a sequence of these"
        )
    if not np.isfinite(found).all():
        raise ParameterError(f"as_frames: frame {k} holds numbers that are not finite")
    return found
