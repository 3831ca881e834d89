"""Things followed in pictures: outlines, edges, boxes, detectors, each a density for any dynamic Bayes net.

Nothing here filters: what is believed about a thing is that of a ``DynamicBayesNet`` whose transition is
one of ``dynamics`` or ``boxes`` and whose frames are weighed by ``edges``, ``histograms`` or ``boxes``.
Lengths are pixels, times frames; points are (x, y), y down.
"""

from __future__ import annotations

from bayesmc.vision.association import claims, left_free
from bayesmc.vision.boxes import (
    BoxDetections,
    BoxMotion,
    Scores,
    boosted,
    iou,
    padded,
    precision_recall,
)
from bayesmc.vision.contours import Contour, ShapeSpace
from bayesmc.vision.detector import Detector, train_detector
from bayesmc.vision.dynamics import SecondOrder, fit_dynamics
from bayesmc.vision.edges import ContourEdges
from bayesmc.vision.histograms import Histograms
from bayesmc.vision.pictures import as_frames, grey

__all__ = [
    "BoxDetections",
    "BoxMotion",
    "Contour",
    "ContourEdges",
    "Detector",
    "Histograms",
    "Scores",
    "SecondOrder",
    "ShapeSpace",
    "as_frames",
    "boosted",
    "claims",
    "fit_dynamics",
    "grey",
    "iou",
    "left_free",
    "padded",
    "precision_recall",
    "train_detector",
]
