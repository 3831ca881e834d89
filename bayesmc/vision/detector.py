"""A detector of things in frames: AdaBoost over Haar features, trained on patches cut from frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions.base import as_float
from bayesmc.errors import ParameterError, ShapeError, missing_extra
from bayesmc.vision.boxes import iou
from bayesmc.vision.haar import HaarFeatures
from bayesmc.vision.pictures import as_frames, grey

#: overlap (intersection over union) up to which a window is background, and from which on two are one thing
APART, SAME = 0.3, 0.3
#: one scale of windows over the next, and how far beyond those of training
_STEP, _BEYOND = 1.12, 1.15
#: windows are moved by this share of their size
_STRIDE = 1 / 12
_CHUNK = 20_000


@dataclass(frozen=True, eq=False)
class Detector:
    """Boxes in frames, with the probability that each holds a thing. ``train_detector`` makes one.

    Attributes
    ----------
    features : HaarFeatures
        Those that the classifier looks at.
    heights : ndarray
        Heights of windows in px, from small to large.
    """

    features: HaarFeatures
    heights: np.ndarray
    _classifier: Any
    _calibration: Any

    def detect(self, frame: Any, least: float = 0.5) -> np.ndarray:
        """Things in a frame: of windows that overlap the surest one.

        Parameters
        ----------
        frame : array_like, shape (height, width) or (height, width, 3)
        least : float
            Probability from which on a window counts.

        Returns
        -------
        ndarray, shape (found, 5)
            Rows (x, y, width, height, score), the surest first.
        """
        windows = self._windows(grey(as_frames([frame])[0]), least)
        kept: list[np.ndarray] = []
        for row in windows[np.argsort(-windows[:, 4], kind="stable")]:
            if not kept or iou(row[None], kept).max() < SAME:
                kept.append(row)
        return np.array(kept).reshape(-1, 5)

    def _windows(self, frame: np.ndarray, least: float) -> np.ndarray:
        found = [np.zeros((0, 5))]
        ours = self.features
        for height in self.heights:
            scale = ours.height / height
            small = resized(frame, scale)
            spare = small.shape[0] - ours.height, small.shape[1] - ours.width
            if min(spare) < 0:
                continue
            step = [max(1, round(_STRIDE * size)) for size in (ours.height, ours.width)]
            top, left = (
                part.ravel()
                for part in np.meshgrid(
                    np.arange(0, spare[0] + 1, step[0]),
                    np.arange(0, spare[1] + 1, step[1]),
                    indexing="ij",
                )
            )
            score = self._probability(ours.of(small, top, left))
            sure = score >= least
            rows = np.stack(
                [
                    (left[sure] + ours.width / 2) / scale - 0.5,
                    (top[sure] + ours.height / 2) / scale - 0.5,
                    np.full(sure.sum(), ours.width / scale),
                    np.full(sure.sum(), height),
                    score[sure],
                ],
                axis=-1,
            )
            found.append(rows)
        return np.concatenate(found)

    def _probability(self, values: np.ndarray) -> np.ndarray:
        found = np.empty(len(values))
        for start in range(0, len(values), _CHUNK):
            part = slice(start, start + _CHUNK)
            margin = self._classifier.decision_function(values[part])
            found[part] = self._calibration.predict_proba(margin[:, None])[:, 1]
        return found


def train_detector(
    frames: Any,
    boxes: Sequence[Any],
    *,
    window: int = 24,
    features: int = 500,
    rounds: int = 80,
    background: int = 20,
    mining: int = 2,
    rng: Any = None,
) -> Detector:
    """A detector of what lies in boxes, against everything else in the same frames.

    Patches are cut at the boxes, moved and scaled a little, and elsewhere at random; stumps on Haar
    features are boosted. Windows of training frames that are taken for the thing and are not are added to the
    background, and it is trained again. Probabilities are those of a logistic regression on the margins of
    patches that were held back.

    Parameters
    ----------
    frames : array_like, shape (time, height, width) or (time, height, width, 3)
    boxes : sequence of array_like, one for each frame, of rows (x, y, width, height, ...)
        All things of the kind that are in the frame; there may be none.
    window : int
        Height in px to which patches are scaled; their width is that of the boxes on average.
    features : int
        Haar features to choose from, drawn at random.
    rounds : int
        Stumps.
    background : int
        Patches of background for each frame.
    mining : int
        How many times mistakes are added.
    rng : seed, Generator or None

    Raises
    ------
    MissingExtraError
        scikit-image or scikit-learn is not installed.
    ShapeError
        Not as many sets of boxes as frames, or boxes that are no rows.
    ParameterError
        There are fewer than two boxes, one has no size, or lies wholly outside its frame.

    References
    ----------
    Okuma et al. (2004), A boosted particle filter, ECCV, section 3; Viola and Jones (2001), Rapid object
    detection using a boosted cascade of simple features, CVPR; Freund and Schapire (1997), A
    decision-theoretic generalization of on-line learning, JCSS 55; Platt (1999), Probabilistic outputs
    for support vector machines.
    """
    pictures = grey(as_frames(frames))
    given = _checked(pictures, boxes)
    rng = np.random.default_rng(rng)
    every = np.concatenate(given)
    aspect = float(np.exp(np.log(every[:, 2] / every[:, 3]).mean()))
    drawn = HaarFeatures.drawn(window, max(4, round(window * aspect)), features, rng)
    things = _things(pictures, given, drawn, rng)
    others = _others(pictures, given, drawn, background, rng)
    low, high = every[:, 3].min() / _BEYOND, every[:, 3].max() * _BEYOND
    heights = low * _STEP ** np.arange(int(np.ceil(np.log(high / low) / np.log(_STEP))) + 1)
    for turn in range(mining + 1):
        found = _trained(drawn, heights, things, others, rounds, rng)
        if turn < mining:
            mistaken = _mistaken(found, pictures, given, drawn)
            if not len(mistaken):
                break
            others = np.concatenate([others, mistaken])
    return found


def resized(frame: np.ndarray, scale: float) -> np.ndarray:
    """A grey frame at another scale, smoothed where it gets smaller."""
    try:
        from skimage.transform import resize
    except ImportError:
        raise missing_extra("scikit-image", "vision") from None
    size = tuple(max(1, round(n * scale)) for n in frame.shape)
    return resize(frame, size, order=1, anti_aliasing=scale < 1, mode="edge")


# ---- private ------------------------------------------------------------------------------------


def _checked(pictures: np.ndarray, boxes: Sequence[Any]) -> list[np.ndarray]:
    if len(boxes) != len(pictures):
        raise ShapeError(
            f"train_detector: there are {len(pictures)} frames and boxes of {len(boxes)}; give one "
            f"set for each"
        )
    found = [
        as_float(rows).reshape(-1, 4) if np.size(rows) == 0 else as_float(rows) for rows in boxes
    ]
    height, width = pictures.shape[1:]
    for k, rows in enumerate(found):
        if rows.ndim != 2 or rows.shape[1] < 4:
            raise ShapeError(
                f"train_detector: the boxes of frame {k} have shape {rows.shape}; give rows (x, y, "
                f"width, height)"
            )
        if not np.isfinite(rows).all() or not (rows[:, 2:4] > 0).all():
            raise ParameterError(f"train_detector: a box of frame {k} is not finite or has no size")
        near = np.abs(rows[:, :2] - [width / 2, height / 2]) < (rows[:, 2:4] + [width, height]) / 2
        if not near.all():
            raise ParameterError(
                f"train_detector: a box of frame {k} lies outside the frame: {rows[~near.all(axis=1)][0]}"
            )
    if sum(map(len, found)) < 2:
        raise ParameterError("train_detector: give two boxes or more")
    return [rows[:, :4] for rows in found]


def _things(
    pictures: np.ndarray, boxes: list[np.ndarray], drawn: HaarFeatures, rng: np.random.Generator
) -> np.ndarray:
    """Features at the boxes, moved by a pixel or two of the window and at three scales."""
    found = []
    for frame, rows in zip(pictures, boxes, strict=True):
        for box in rows:
            for grown in (0.95, 1.0, 1.05):
                scale = drawn.height / (grown * box[3])
                small = resized(frame, scale)
                top = (box[1] + 0.5) * scale - drawn.height / 2 + rng.integers(-1, 2, 4)
                left = (box[0] + 0.5) * scale - drawn.width / 2 + rng.integers(-1, 2, 4)
                found.append(
                    _cut(small, np.rint(top).astype(int), np.rint(left).astype(int), drawn)
                )
    return np.concatenate(found)


def _cut(small: np.ndarray, top: np.ndarray, left: np.ndarray, drawn: HaarFeatures) -> np.ndarray:
    """Features of windows that may reach beyond the frame, whose last pixels go on."""
    beyond = max(
        0, -int(top.min()), -int(left.min()), int(top.max()) + drawn.height - small.shape[0],
        int(left.max()) + drawn.width - small.shape[1],
    )  # fmt: skip
    return drawn.of(np.pad(small, beyond, mode="edge"), top + beyond, left + beyond)


def _others(
    pictures: np.ndarray,
    boxes: list[np.ndarray],
    drawn: HaarFeatures,
    count: int,
    rng: np.random.Generator,
) -> np.ndarray:
    """Features of windows of background, at the scales of the boxes."""
    heights, found = np.concatenate(boxes)[:, 3], []
    for frame, rows in zip(pictures, boxes, strict=True):
        for scale in drawn.height / (rng.choice(heights, 4) * rng.uniform(1 / _BEYOND, _BEYOND, 4)):
            small = resized(frame, scale)
            spare = small.shape[0] - drawn.height, small.shape[1] - drawn.width
            if min(spare) < 0:
                continue
            top, left = rng.integers(0, spare[0] + 1, count), rng.integers(0, spare[1] + 1, count)
            windows = np.stack(
                [(left + drawn.width / 2) / scale - 0.5, (top + drawn.height / 2) / scale - 0.5,
                 np.full(count, drawn.width / scale), np.full(count, drawn.height / scale)], axis=-1,
            )  # fmt: skip
            far = iou(windows, rows).max(axis=1, initial=0.0) < APART
            keep = np.flatnonzero(far)[: max(1, count // 4)]
            found.append(drawn.of(small, top[keep], left[keep]))
    if not sum(map(len, found)):
        raise ParameterError(
            "train_detector: the boxes leave no room for background of their size; give larger frames"
        )
    return np.concatenate(found)


def _trained(
    drawn: HaarFeatures, heights: np.ndarray, things: np.ndarray, others: np.ndarray, rounds: int,
    rng: np.random.Generator,
) -> Detector:  # fmt: skip
    try:
        from sklearn.ensemble import AdaBoostClassifier
        from sklearn.linear_model import LogisticRegression
    except ImportError:
        raise missing_extra("scikit-learn", "vision") from None
    values = np.concatenate([things, others])
    labels = np.repeat([1, 0], [len(things), len(others)])
    order = rng.permutation(len(values))
    held, kept = order[: len(order) // 4], order[len(order) // 4 :]
    if len(set(labels[held])) < 2:
        held = kept = order
    classifier = AdaBoostClassifier(n_estimators=rounds, random_state=int(rng.integers(2**31)))
    classifier.fit(values[kept], labels[kept])
    margin = classifier.decision_function(values[held])
    calibration = LogisticRegression().fit(margin[:, None], labels[held])
    used = np.flatnonzero(classifier.feature_importances_ > 0)
    return Detector(drawn.picked(used), heights, classifier, calibration)


def _mistaken(
    found: Detector, pictures: np.ndarray, boxes: list[np.ndarray], drawn: HaarFeatures
) -> np.ndarray:
    """Features of windows that were taken for things and are none."""
    wrong = [np.zeros((0, len(drawn.signs)))]
    for frame, rows in zip(pictures, boxes, strict=True):
        for box in found.detect(frame):
            if iou(box[None], rows).max(initial=0.0) < APART:
                scale = drawn.height / box[3]
                top = np.array([round((box[1] + 0.5) * scale - drawn.height / 2)])
                left = np.array([round((box[0] + 0.5) * scale - drawn.width / 2)])
                wrong.append(_cut(resized(frame, scale), top, left, drawn))
    return np.concatenate(wrong)
