"""MOTA and IDF1 of tracks, by py-motmetrics: run in the peers' environment, an object in, one out.

On stdin ``{"found": [frame, ...], "true": [frame, ...]}``, each frame a list of rows (x, y, width, height,
which) by the middle; on stdout a figure for each name. Pairs overlap by half or more, as MOT has it.
"""

from __future__ import annotations

import json
import sys

import motmetrics
import numpy as np

NAMES = ["mota", "idf1", "precision", "recall", "num_switches"]


def overlap(one: list, other: list) -> np.ndarray:
    """Intersection over union; motmetrics 1.4.0 has it, but not for NumPy 2."""
    a = np.array(one, dtype=float).reshape(-1, 5)[:, None]
    b = np.array(other, dtype=float).reshape(-1, 5)[None]
    shared: float | np.ndarray = 1.0
    for k in (0, 1):
        high = np.minimum(a[..., k] + a[..., k + 2] / 2, b[..., k] + b[..., k + 2] / 2)
        low = np.maximum(a[..., k] - a[..., k + 2] / 2, b[..., k] - b[..., k + 2] / 2)
        shared = shared * np.maximum(high - low, 0.0)
    return shared / (a[..., 2] * a[..., 3] + b[..., 2] * b[..., 3] - shared)


def main() -> None:
    given = json.load(sys.stdin)
    accumulator = motmetrics.MOTAccumulator(auto_id=True)
    for found, true in zip(given["found"], given["true"], strict=True):
        shared = overlap(true, found)
        distance = np.where(shared >= 0.5, 1 - shared, np.nan)
        accumulator.update([int(row[4]) for row in true], [int(row[4]) for row in found], distance)
    summary = motmetrics.metrics.create().compute(accumulator, metrics=NAMES, name="tracks")
    print(json.dumps({name: float(summary[name].iloc[0]) for name in NAMES}))


if __name__ == "__main__":
    main()
