"""Functions that do not broadcast, called element by element: slow, and asked for by name."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution, as_distribution
from bayesmc.distributions.support import Support
from bayesmc.plates import PlateArray
from bayesmc.shapes import Shape


def call_elementwise(
    function: Callable[..., Any], arguments: Sequence[Any], event_ndims: Sequence[int], lead: Shape
) -> Any:
    """``function`` called once per element of the batch and plates ``lead``, results put together.

    Events stay whole: a vector parent reaches the function as a vector.
    """
    results = []
    for index in np.ndindex(lead):
        picked = [_pick(a, n, index) for a, n in zip(arguments, event_ndims, strict=True)]
        results.append(function(*picked))
    parts = [as_distribution(r) for r in results]
    if any(p is None for p in parts) and not all(p is None for p in parts):
        raise TypeError("it returns a distribution for some elements and a number for others")
    if results and parts[0] is not None:
        return Elementwise([p for p in parts if p is not None], lead)
    values = [np.asarray(r) for r in results]
    event = values[0].shape if values else ()
    return np.reshape(np.stack(values) if values else np.zeros(lead), lead + event)


def _pick(argument: Any, event_ndim: int, index: Shape) -> Any:
    """The element of one argument; its lead is right-aligned with the index and may have size 1."""
    if isinstance(argument, PlateArray):
        lead = argument.array.ndim - len(argument.plates) - argument.event_ndim
        part = argument.array[_own(index, argument.array.shape[:lead])]
        return PlateArray(part, argument.plates, 0, argument.event_ndim)
    array = np.asanyarray(argument)
    lead = array.ndim - event_ndim
    return array[(*_own(index, array.shape[:lead]), Ellipsis)]


def _own(index: Shape, shape: Shape) -> Shape:
    tail = index[len(index) - len(shape) :]
    return tuple(i if n > 1 else 0 for i, n in zip(tail, shape, strict=True))


class Elementwise(Distribution):
    """A batch made of one distribution object per element; every operation loops over them."""

    def __init__(self, parts: Sequence[Distribution], shape: Shape) -> None:
        self.parts = tuple(parts)
        self.batch_shape = shape
        self.event_shape = parts[0].event_shape
        self.is_discrete = parts[0].is_discrete  # type: ignore[misc]
        marks = [p.invalid is not None and bool(np.any(p.invalid)) for p in parts]
        if any(marks):
            self.invalid = np.reshape(marks, shape)
            self.problem = parts[marks.index(True)].problem

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        index = np.broadcast_to(np.arange(len(self.parts)).reshape(self.batch_shape), shape)
        draws = [self.parts[i].sample(rng) for i in index.ravel()]
        return np.reshape(np.stack(draws), shape + self.event_shape)

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        lead = x.shape[: x.ndim - len(self.event_shape)]
        shape = np.broadcast_shapes(lead, self.batch_shape)
        index = np.broadcast_to(np.arange(len(self.parts)).reshape(self.batch_shape), shape)
        values = np.broadcast_to(x, shape + self.event_shape).reshape((-1, *self.event_shape))
        result = [self.parts[i].log_prob(v) for i, v in zip(index.ravel(), values, strict=True)]
        return np.reshape(np.array(result, dtype=float), shape)

    @property
    def mean(self) -> np.ndarray:
        return self._each("mean")

    @property
    def var(self) -> np.ndarray:
        return self._each("var")

    @property
    def support(self) -> Support:
        first = self.parts[0].support
        # bounds stay one per element, even if all are equal here: elsewhere they need not be
        if not self.batch_shape or first.kind not in ("interval", "integers"):
            return first
        low = np.array([np.asarray(p.support.low).flat[0] for p in self.parts])
        high = np.array([np.asarray(p.support.high).flat[0] for p in self.parts])
        low, high = low.reshape(self.batch_shape), high.reshape(self.batch_shape)
        return Support(first.kind, low, high, first.open_low, first.open_high)

    def parameters(self) -> list[tuple[np.ndarray, int]]:
        """Three numbers per element that tell its family and parameters: families may be mixed."""
        rows = []
        for part in self.parts:
            family = float(zlib.crc32(type(part).__name__.encode()))
            values = np.concatenate([[0.0], *(np.ravel(a) for a, _ in part.parameters())])
            rows.append([family, values.sum(), values @ np.sin(np.arange(values.size))])
        return [(np.reshape(rows, (*self.batch_shape, 3)), 1)]

    def _each(self, what: str) -> np.ndarray:
        values = np.stack([getattr(p, what) for p in self.parts])
        return values.reshape(self.batch_shape + self.event_shape)
