"""What the functions of this room share: densities given in any of three ways, draws in chunks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution, as_distribution
from bayesmc.errors import DensityError, ParameterError, QueryError, ShapeError
from bayesmc.randomness import Purpose, seed_sequence, stream
from bayesmc.shapes import Shape

CHUNK = 32_768  # numbers held at a time, and draws at most


def single(call: str, name: str, dist: Any) -> Distribution:
    """``dist`` as one distribution, not a batch."""
    found = as_distribution(dist)
    if found is None:
        raise ParameterError(f"{call}: {name} must be a distribution; got {type(dist).__name__}")
    if found.batch_shape:
        raise ShapeError(
            f"{call}: {name} is a batch of shape {found.batch_shape}; give one distribution at a time"
        )
    return found


def log_density(call: str, name: str, density: Any) -> Callable[[np.ndarray], np.ndarray]:
    """The log density of a distribution, or a function that is one, checked on use."""
    function = density
    if not callable(density) or as_distribution(density) is not None:
        function = single(call, name, density).log_prob

    def evaluate(points: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            value = np.asarray(function(points), dtype=float)
        if value.shape not in ((), points.shape[:1]):
            raise ShapeError(
                f"{call}: {name} returned shape {value.shape} for {len(points)} points of shape "
                f"{points.shape[1:]}; it must give one log density per point"
            )
        bad = np.broadcast_to(np.isnan(value) | (value == np.inf), points.shape[:1])
        if bad.any():
            index = int(np.argmax(bad))
            shown = np.broadcast_to(value, points.shape[:1])[index]
            raise DensityError(
                f"{call}: the log density {name} is {shown} at {show(points[index])}; it must be a "
                "number or minus infinity"
            )
        return np.broadcast_to(value, points.shape[:1])

    return evaluate


def evaluate(call: str, function: Callable[..., Any], points: np.ndarray) -> np.ndarray:
    """A function on points of shape (n, ...), whose result must have the same first axis."""
    value = np.asarray(function(points))
    if value.ndim < 1 or len(value) != len(points):
        raise QueryError(
            f"{call}: the function returned shape {value.shape} for {len(points)} points; it must "
            "act on arrays, with the points along the first axis"
        )
    return value


def chunk_sizes(draws: int, event_shape: Shape) -> Iterator[int]:
    """Sizes that add up to ``draws``, none too large for memory."""
    step = max(1, CHUNK // max(1, int(np.prod(event_shape))))
    for start in range(0, draws, step):
        yield min(step, draws - start)


def streams(rng: Any) -> Iterator[np.random.Generator]:
    """A generator for each chunk."""
    seed, unit = seed_sequence(rng), 0
    while True:
        yield stream(seed, Purpose.SAMPLE, unit)
        unit += 1


def count_of(call: str, draws: Any, least: int) -> int:
    """``draws`` as a whole number of at least ``least``."""
    if isinstance(draws, bool) or draws != int(draws) or draws < least:
        raise ParameterError(
            f"{call}: draws must be a whole number of at least {least}; got {draws!r}"
        )
    return int(draws)


def show(point: np.ndarray) -> str:
    """A point in a message."""
    return " ".join(np.array2string(np.asarray(point), precision=6, threshold=8).split())
