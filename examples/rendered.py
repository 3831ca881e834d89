"""A helper, not a script: scenes that are drawn, so that the truth is known to a fraction of a pixel.

An outline that moves, grows and turns before clutter; the same with a decoy of its shape; and several things
that come and go, for detectors. All of it in grey, 0..255, by a seed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter

from bayesmc.vision import Contour, ShapeSpace

HEIGHT, WIDTH = 120, 160


class Scene(NamedTuple):
    """Frames of one thing, and the states that it was drawn at.

    Attributes
    ----------
    frames : ndarray, shape (time, height, width)
    states : ndarray, shape (time, space.size)
    space : ShapeSpace
    """

    frames: np.ndarray
    states: np.ndarray
    space: ShapeSpace


class Walkers(NamedTuple):
    """Frames of several things, and their boxes.

    Attributes
    ----------
    frames : ndarray, shape (time, height, width)
    boxes : list of ndarray, shape (n, 5)
        For each frame rows (x, y, width, height, which).
    """

    frames: np.ndarray
    boxes: list[np.ndarray]


def outline(kind: str = "bean", radius: float = 22.0) -> Contour:
    """A template in the middle of the frame: ``bean``, ``star``, ``egg``."""
    turn = np.linspace(0, 2 * np.pi, 120, endpoint=False)
    waves = {
        "bean": 1 + 0.25 * np.cos(turn) - 0.2 * np.cos(2 * turn + 0.5),
        "star": 1 + 0.22 * np.cos(5 * turn),
        "egg": 1 + 0.15 * np.cos(turn),
    }
    stretch = {"bean": (1.0, 1.2), "star": (1.0, 1.0), "egg": (1.35, 0.9)}[kind]
    points = (
        radius * waves[kind][:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1) * stretch
    )
    return Contour.through(points + [WIDTH / 2, HEIGHT / 2], 16 if kind == "star" else 12)


def filled(points: np.ndarray) -> np.ndarray:
    """Pixels inside a polygon (n, 2), as booleans of a frame."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    inside = np.zeros((HEIGHT, WIDTH), dtype=bool)
    for (x0, y0), (x1, y1) in zip(points, np.roll(points, -1, axis=0), strict=True):
        crossed = (y0 > y) != (y1 > y)
        inside ^= crossed & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0 + (y1 == y0)))
    return inside


def clutter(rng: np.random.Generator, strength: float) -> np.ndarray:
    """Blots and stripes of all sizes about a middle grey."""
    found = np.zeros((HEIGHT, WIDTH))
    for scale in (2.0, 5.0, 12.0):
        part = gaussian_filter(rng.normal(size=found.shape), scale)
        found += part / part.std()
    found[:, : WIDTH // 3] += 1.5 * np.sign(np.sin(np.arange(HEIGHT) / 2.5))[:, None]  # blinds
    return 120 + strength * found


def silhouette(
    kind: str = "bean", steps: int = 60, seed: int = 0, strength: float = 14.0, noise: float = 4.0
) -> Scene:
    """A bright outline that swings through clutter, turns, and grows."""
    rng = np.random.default_rng(seed)
    space, t = ShapeSpace(outline(kind), "affine"), np.arange(steps)
    wide, high = rng.uniform(24, 36), rng.uniform(10, 18)
    slow, slower = rng.uniform(11, 16, 2)
    states = np.zeros((steps, 6))  # from rest
    states[:, 0] = rng.choice([-1, 1]) * wide * np.cos(t / slow)
    states[:, 1] = high * np.cos(t / slower)
    turn, grown = 0.25 * np.sin(t / 11), 1 + 0.12 * np.sin(t / 17)
    r = space.template.radius
    states[:, 2] = states[:, 3] = r * (grown * np.cos(turn) - 1)
    states[:, 4], states[:, 5] = -r * grown * np.sin(turn), r * grown * np.sin(turn)
    back = clutter(rng, strength)
    frames = np.array([_painted(back, [(space.points(s, 160), 195.0)], rng, noise) for s in states])
    return Scene(frames, states, space)


def with_decoy(seed: int = 0, speed: float = 2.5, noise: float = 4.0) -> Scene:
    """A thing that meets another of its shape, and both turn back: as if they had passed each other.

    The other one then leaves the frame. Nothing tells the two apart but where they are.
    """
    rng = np.random.default_rng(seed)
    space, t = ShapeSpace(outline("bean", 16.0), "similarity"), np.arange(64)
    states, decoy = np.zeros((2, len(t), 4))
    meet, place = 28, 40.0
    states[:, 0] = place - speed * np.abs(t - meet)
    decoy[:, 0] = place + speed * np.abs(t - meet)
    states[:, 1], decoy[:, 1] = 4 * np.sin(t / 8), 4 * np.sin(t / 8)
    back = clutter(rng, 8.0)
    frames = np.array([
        _painted(back, [(space.points(d, 160), 200.0), (space.points(s, 160), 200.0)], rng, noise)
        for s, d in zip(states, decoy, strict=True)
    ])  # fmt: skip
    return Scene(frames, states, space)


def walkers(seed: int = 0, steps: int = 40, count: int = 4, noise: float = 4.0) -> Walkers:
    """Upright things with a light head and a dark coat that walk through clutter, and come and go."""
    rng = np.random.default_rng(seed)
    back = clutter(rng, 12.0)
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    starts, ways = rng.integers(0, steps // 3, count), rng.choice([-1, 1], count)
    speeds, feet = rng.uniform(2.0, 3.5, count), rng.uniform(70, 112, count)
    frames, boxes = [], []
    for t in range(steps):
        things, rows = [], []
        for k in np.argsort(feet):  # those in front later
            high = 20 + 0.25 * feet[k]
            wide, at = 0.4 * high, speeds[k] * (t - starts[k]) - 10
            at = at if ways[k] > 0 else WIDTH - at
            middle = feet[k] - high / 2
            if t < starts[k] or not 0 <= at < WIDTH:
                continue
            coat = (np.abs(x - at) < wide / 2) & (y > feet[k] - 0.7 * high) & (y < feet[k])
            head = np.hypot((x - at) / 0.8, y - feet[k] + 0.85 * high) < 0.16 * high
            things += [(coat, 40.0), (head, 225.0)]
            rows.append([at, middle, wide, high, k])
        frame = back.copy()
        for mask, brightness in things:
            cover = gaussian_filter(mask.astype(float), 0.7)
            frame += cover * (brightness - frame)
        frames.append(np.clip(frame + noise * rng.normal(size=frame.shape), 0, 255))
        boxes.append(np.array(rows).reshape(-1, 5))
    return Walkers(np.array(frames), boxes)


def _painted(
    back: np.ndarray, things: list[tuple[np.ndarray, float]], rng: np.random.Generator, noise: float
) -> np.ndarray:
    """Things on a background, the later ones in front, with soft edges and noise."""
    frame = back.copy()
    for points, brightness in things:
        cover = gaussian_filter(filled(points).astype(float), 0.7)
        frame += cover * (brightness - frame)
    return np.clip(frame + noise * rng.normal(size=frame.shape), 0, 255)
