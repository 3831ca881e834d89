"""Boxes around things: what a detector says of them, where a detector sends particles, and how well it does.

A detector's boxes in a frame are rows ``(x, y, width, height, score)``: the middle in px, the size in
px, and the probability that there is something, as the detector has it. Frames have different numbers of
them, so arrays over time are filled up with rows of zeros; a row without width is no detection
(``padded`` makes them).

What is followed has a state ``(x, y, log width, log height, speed_x, speed_y)``, in px and px per frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from bayesmc.distributions import Density, Distribution, Mixture, MvNormal
from bayesmc.distributions.base import as_float
from bayesmc.distributions.parameters import as_number
from bayesmc.errors import ParameterError, ShapeError
from bayesmc.expression import as_one_call
from bayesmc.vision.pictures import check_frame_shape

#: components of a state
STATE = 6
#: scores are taken to be at least this far from 0 and 1
_SURE = 1e-3
#: what to do with scores that are none
_LOGISTIC = (
    ": make one of a margin by a logistic, 1 / (1 + exp(-margin)), fitted where the truth is known"
)


class Scores(NamedTuple):
    """How many boxes are right: see ``precision_recall``."""

    precision: float
    recall: float
    hits: int
    found: int
    true: int


def padded(frames: Sequence[Any], most: int | None = None) -> np.ndarray:
    """Detections of frames as one array, filled up with rows of zeros.

    Parameters
    ----------
    frames : sequence of array_like, each of shape (n, 5)
    most : int, optional
        Rows for each frame, by default what the fullest one needs, and one at least.

    Returns
    -------
    ndarray, shape (time, most, 5)

    Raises
    ------
    ShapeError
        A frame's detections are not rows of five, or more than ``most``.
    ParameterError
        One that is not finite, or without width or height, or with a score that is no probability.

    Examples
    --------
    >>> from bayesmc.vision import padded
    >>> padded([[[10.0, 20.0, 4.0, 8.0, 0.9]], []]).shape
    (2, 1, 5)
    """
    rows = [
        as_float(frame).reshape(-1, 5) if np.size(frame) == 0 else as_float(frame)
        for frame in frames
    ]
    for k, row in enumerate(rows):
        if row.ndim != 2 or row.shape[1] != 5:
            raise ShapeError(
                f"padded: the detections of frame {k} have shape {row.shape}; give rows (x, y, width, "
                f"height, score)"
            )
        if not np.isfinite(row).all() or not (row[:, 2:4] > 0).all():
            raise ParameterError(
                f"padded: a detection of frame {k} is not finite, or has no width or height"
            )
        _probabilities(f"padded: of frame {k}", "scores", row[:, 4], _LOGISTIC)
    needed = max([1, *map(len, rows)])
    most = needed if most is None else most
    if needed > most:
        raise ShapeError(f"padded: a frame has {needed} detections, and most={most}")
    found = np.zeros((len(rows), most, 5))
    for whole, row in zip(found, rows, strict=True):
        whole[: len(row)] = row
    return found


def iou(one: Any, other: Any) -> np.ndarray:
    """Intersection over union of every box with every other, shape (n, m).

    Parameters
    ----------
    one, other : array_like, shapes (n, 4 or more) and (m, 4 or more)
        Rows (x, y, width, height, ...), by the middle.

    Examples
    --------
    >>> from bayesmc.vision import iou
    >>> iou([[0.0, 0.0, 2.0, 2.0]], [[1.0, 0.0, 2.0, 2.0]]).round(3).tolist()
    [[0.333]]
    """
    a, b = as_float(one)[:, None], as_float(other)[None]
    if not (a[..., 2:4] >= 0).all() or not (b[..., 2:4] >= 0).all():
        raise ParameterError("iou: a width or height is negative, or NaN; boxes go by their middle")
    shared = 1.0
    for axis in (0, 1):
        high = np.minimum(a[..., axis] + a[..., axis + 2] / 2, b[..., axis] + b[..., axis + 2] / 2)
        low = np.maximum(a[..., axis] - a[..., axis + 2] / 2, b[..., axis] - b[..., axis + 2] / 2)
        shared = shared * np.maximum(high - low, 0.0)
    union = a[..., 2] * a[..., 3] + b[..., 2] * b[..., 3] - shared
    return np.divide(shared, union, out=np.zeros_like(union), where=union > 0)


def precision_recall(found: Sequence[Any], true: Sequence[Any], overlap: float = 0.5) -> Scores:
    """Which share of found boxes is right, and which share of the true ones is found.

    Boxes of a frame are paired one to one so that as many as can be overlap enough.

    Parameters
    ----------
    found, true : sequence of array_like, one for each frame, of rows (x, y, width, height, ...)
    overlap : float
        Intersection over union from which on a pair counts.

    Returns
    -------
    Scores
        NaN where there is nothing to take a share of.

    Raises
    ------
    ShapeError
        As many frames of the one as of the other are needed.

    References
    ----------
    Everingham et al. (2010), The PASCAL visual object classes challenge, IJCV 88, section 4.2.
    """
    if len(found) != len(true):
        raise ShapeError(
            f"precision_recall: boxes of {len(found)} frames were found, and {len(true)} frames are true"
        )
    hits = claimed = there = 0
    for ours, theirs in zip(found, true, strict=True):
        claimed, there = claimed + len(ours), there + len(theirs)
        if len(ours) and len(theirs):
            good = iou(ours, theirs) >= overlap
            hits += int(good[linear_sum_assignment(good, maximize=True)].sum())
    return Scores(
        hits / claimed if claimed else math.nan,
        hits / there if there else math.nan,
        hits,
        claimed,
        there,
    )


@dataclass(frozen=True)
class BoxMotion:
    """How boxes go on: at their speed, which changes, and with a size that changes.

    Parameters
    ----------
    place, speed : float
        Standard deviations of a step, as shares of the box's height: of the place, and of the speed.
    size : float
        Standard deviation of the change of log width and log height in a step.
    damping : float
        Share of the speed that is lost in a step.

    Raises
    ------
    ParameterError
        A number that is not positive, or damping outside 0..1.

    Examples
    --------
    >>> from bayesmc.vision import BoxMotion
    >>> BoxMotion().given([10.0, 20.0, 3.0, 4.0, 2.0, 0.0]).mean.round(1).tolist()
    [12.0, 20.0, 3.0, 4.0, 1.9, 0.0]
    """

    place: float = 0.02
    speed: float = 0.01
    size: float = 0.03
    damping: float = 0.05

    def __post_init__(self) -> None:
        for name in ("place", "speed", "size"):
            if not 0 < as_number(getattr(self, name)) < math.inf:
                raise ParameterError(
                    f"BoxMotion: {name} must be positive; got {getattr(self, name)!r:.60}"
                )
        if not 0 <= as_number(self.damping) <= 1:
            raise ParameterError(f"BoxMotion: damping must lie in 0..1; got {self.damping!r:.60}")

    @as_one_call
    def given(self, box: Any) -> MvNormal:
        """The next state given this one, shape (..., 6)."""
        box = _states("BoxMotion.given", box)
        mean = box.copy()
        mean[..., :2] += box[..., 4:]
        mean[..., 4:] *= 1 - self.damping
        height = np.exp(np.clip(box[..., 3:4], -20.0, 20.0))
        shares = np.array([self.place] * 2 + [0.0] * 2 + [self.speed] * 2)
        return MvNormal(mean, scale_diag=shares * height + self.size * (shares == 0))


@dataclass(frozen=True)
class BoxDetections:
    """Densities of a detector's boxes in a frame, given whether a thing is there, and where.

    The thing gives one box at most, with probability ``detected``; all others are clutter. The density of all
    boxes over that of clutter alone is 1 where the thing is absent, and where it is present::

        1 - detected + detected * sum_j free_j s_j / (1 - s_j) p(box_j | state) / clutter

    with the scores ``s_j``. ``free_j`` is the probability that box j is no other thing's (``claims`` tells).

    Parameters
    ----------
    frame_shape : tuple of int
        (height, width) or (height, width, 3): clutter lies anywhere in it.
    detected : float
        Between 0 and 1, both excluded.
    place : float
        Standard deviation of a box's middle, as a share of its height.
    size : float
        Standard deviation of its log width and log height.
    clutter : float
        Boxes of clutter per frame, as sure as ``s = 1/2``.

    Raises
    ------
    ParameterError
        A number out of range; from ``given`` and ``log_prob``, ``free`` or scores that are no probabilities.
    ShapeError
        ``frame_shape`` is no frame's.

    References
    ----------
    Bar-Shalom and Fortmann (1988), Tracking and Data Association, section 6.3 (one target in clutter, without
    a gate); Schulz, Burgard, Fox and Cremers (2001), Tracking multiple moving targets with a mobile robot
    using particle filters and statistical data association, ICRA (several).
    """

    frame_shape: tuple[int, ...]
    detected: float = 0.9
    place: float = 0.05
    size: float = 0.15
    clutter: float = 1.0

    def __post_init__(self) -> None:
        shape = check_frame_shape("BoxDetections", self.frame_shape)
        object.__setattr__(self, "frame_shape", shape)
        for name in ("place", "size", "clutter"):
            if not 0 < as_number(getattr(self, name)) < math.inf:
                raise ParameterError(
                    f"BoxDetections: {name} must be positive; got {getattr(self, name)!r:.60}"
                )
        if not 0 < as_number(self.detected) < 1:
            raise ParameterError(
                f"BoxDetections: detected must lie between 0 and 1; got {self.detected!r:.60}"
            )

    @as_one_call
    def given(self, box: Any, present: Any, free: Any) -> Density:
        """The density of a frame's boxes.

        Parameters
        ----------
        box : array_like, shape (..., 6)
        present : array_like of bool, shape (...)
        free : array_like, shape (..., most)
            Between 0 and 1.

        Returns
        -------
        Density
            Of arrays (most, 5), up to the density of clutter; it cannot be drawn from.
        """
        box, present, free = (
            _states("BoxDetections.given", box),
            np.asarray(present),
            _probabilities("BoxDetections.given:", "free", as_float(free)),
        )
        most = free.shape[-1]
        batch = np.broadcast_shapes(box.shape[:-1], present.shape, free.shape[:-1])

        def log_prob(seen: np.ndarray) -> np.ndarray:
            scores = np.where(seen[..., 2] > 0, seen[..., 4], 0.0)
            _probabilities("BoxDetections:", "scores", scores, _LOGISTIC)
            ratio = (free * self.ratios(box, seen)).sum(axis=-1)
            return np.log(np.where(present != 0, 1 - self.detected + ratio, 1.0))

        return Density(log_prob, event_shape=(most, 5), batch_shape=batch)

    def ratios(self, box: Any, seen: Any, spread: Any = 0.0) -> np.ndarray:
        """Of each box: ``detected s / (1 - s) p(box | state) / clutter``, 0 where there is none.

        Parameters
        ----------
        box : array_like, shape (..., 6)
        seen : array_like, shape (..., most, 5)
        spread : array_like, shape (..., 4)
            Variances of x, y, log width and log height of the state, where it is not known exactly.

        Returns
        -------
        ndarray, shape (..., most)
        """
        box, seen = _states("BoxDetections.ratios", box)[..., None, :], as_float(seen)
        there = seen[..., 2] > 0
        height = np.exp(np.clip(box[..., 3], -20.0, 20.0))
        extra = np.broadcast_to(as_float(spread), (*np.shape(spread)[:-1], 4))[..., None, :]
        log = -math.log(self.clutter) - 0.5 * 4 * math.log(2 * math.pi)
        sizes = np.log(np.where(there[..., None], seen[..., 2:4], 1.0))
        for k, (value, sd) in enumerate(
            ((seen[..., 0], self.place * height), (seen[..., 1], self.place * height),
             (sizes[..., 0], self.size), (sizes[..., 1], self.size))
        ):  # fmt: skip
            var = sd**2 + extra[..., k]
            log = log - 0.5 * ((value - box[..., k]) ** 2 / var + np.log(var))
        score = np.clip(seen[..., 4], _SURE, 1 - _SURE)
        # clutter is spread evenly over the frame, and over a factor of e^2 in width and in height
        log = (
            log
            + np.log(score / (1 - score))
            + math.log(4.0 * self.frame_shape[0] * self.frame_shape[1])
        )
        return np.where(there, self.detected * np.exp(np.minimum(log, 500.0)), 0.0)


def boosted(
    prior: MvNormal,
    seen: Any,
    free: Any,
    place: float = 0.05,
    size: float = 0.15,
    share: float = 0.5,
) -> Distribution:
    """A transition mixed with a detector's boxes: the proposal of the boosted particle filter.

    ``(1 - share w) prior + share sum_j w_j Normal(box_j)``: each box has the weight ``free`` times its
    score (over their sum, where that is above 1), and speeds are those of ``prior``. Where no box is
    free it is ``prior``.

    Parameters
    ----------
    prior : MvNormal
        Of states (..., 6) with independent components: ``BoxMotion().given(box_prev)``, or where boxes begin.
    seen : array_like, shape (..., most, 5)
    free : array_like, shape (..., most)
        Weights of the boxes, between 0 and 1; 0 leaves one out.
    place, size : float
        Standard deviations about a box: of its middle, as a share of its height, and of its log sizes.
    share : float
        How much is drawn from the boxes; below 1, so that what the detector misses can still be drawn.

    Raises
    ------
    ParameterError
        ``share`` is not in 0..1, 1 excluded; ``free`` or scores that are no probabilities.

    References
    ----------
    Okuma, Taleghani, de Freitas, Little and Lowe (2004), A boosted particle filter: multitarget detection and
    tracking, ECCV, section 4 (equation 8).

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.vision import BoxMotion, boosted
    >>> motion = BoxMotion().given([10.0, 20.0, 1.0, 2.0, 0.0, 0.0])
    >>> proposal = boosted(motion, [[90.0, 50.0, 3.0, 7.0, 1.0]], [1.0], share=0.25)
    >>> x = proposal.sample(rng=0, sample_shape=10_000)[:, 0]
    >>> float((x > 50).mean().round(2))
    0.25
    """
    if not 0 <= as_number(share) < 1:
        raise ParameterError(
            f"boosted: share must be 0 or more and below 1, or what the detector misses is never "
            f"drawn; got {share!r:.60}"
        )
    seen, free = as_float(seen), as_float(free)
    there = seen[..., 2] > 0
    scores = np.where(there, seen[..., 4], 0.0)
    _probabilities("boosted:", "scores", scores, _LOGISTIC)
    weights = np.where(there, _probabilities("boosted:", "free", free) * scores, 0.0)
    weights = share * weights / np.maximum(weights.sum(axis=-1, keepdims=True), 1.0)
    rest = 1 - weights.sum(axis=-1, keepdims=True)
    mean, spread = as_float(prior.mean)[..., None, :], np.sqrt(prior.var)[..., None, :]
    box = np.where(there[..., None], seen, 1.0)
    middle = np.concatenate([box[..., :2], np.log(box[..., 2:4])], axis=-1)
    near = np.stack(
        [
            place * box[..., 3],
            place * box[..., 3],
            np.full(there.shape, size),
            np.full(there.shape, size),
        ],
        axis=-1,
    )
    lead = np.broadcast_shapes(mean.shape[:-2], there.shape[:-1])
    most = there.shape[-1]
    loc = np.broadcast_to(mean, (*lead, most, STATE)).copy()
    scale = np.broadcast_to(spread, (*lead, most, STATE)).copy()
    loc[..., :4], scale[..., :4] = middle, near
    loc = np.concatenate([np.broadcast_to(mean, (*lead, 1, STATE)), loc], axis=-2)
    scale = np.concatenate([np.broadcast_to(spread, (*lead, 1, STATE)), scale], axis=-2)
    weights = np.concatenate([rest, weights], axis=-1)
    return Mixture(weights, MvNormal(loc, scale_diag=scale))


# ---- private ------------------------------------------------------------------------------------


def _probabilities(what: str, name: str, values: np.ndarray, way: str = "") -> np.ndarray:
    """Values that are all between 0 and 1.

    Raises
    ------
    ParameterError
    """
    low, high = values.min(initial=0.0), values.max(initial=1.0)
    if not (low >= 0 and high <= 1):  # NaN, too
        off = values[~((values >= 0) & (values <= 1))].flat[0]
        raise ParameterError(f"{what} {name} are probabilities, between 0 and 1; got {off:g}{way}")
    return values


def _states(what: str, box: Any) -> np.ndarray:
    box = as_float(box)
    if box.shape[-1:] != (STATE,):
        raise ShapeError(
            f"{what}: states have shape {box.shape}; give (..., 6): x, y, log width, log height, "
            f"speed_x, speed_y"
        )
    return box
