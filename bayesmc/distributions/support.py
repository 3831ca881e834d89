"""Supports: where a distribution puts its mass, as a small value that can be asked.

Engines read it to refuse evidence that cannot happen and to enumerate finite nodes; ``transforms``
maps it to the whole line. It holds no parameters beyond the bounds.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.errors import ShapeError, UnsupportedError
from bayesmc.gaussian import try_cholesky

_EVENT_NDIM = {
    "simplex": 1,
    "real vector": 1,
    "positive definite": 2,
    "counts": 1,
    "product": 1,
    "increasing": 1,
    "correlation": 2,
}


@dataclass(frozen=True, eq=False)
class Support:
    """Where a distribution's mass lies.

    Parameters
    ----------
    kind : str
        ``"real"``, ``"interval"``, ``"circle"``, ``"integers"``, ``"simplex"``, ``"real vector"``,
        ``"counts"``, ``"positive definite"``, ``"correlation"``, ``"increasing"`` or ``"product"``.
    low, high : float or array
        Bounds of an interval, of integers (inclusive) or of numbers in order, possibly infinite; arrays when
        they depend on parents.
    open_low, open_high : bool
        Whether the bound itself is excluded.
    parts : tuple of (Support, int)
        Of a product: each part's support and how many components it takes (0: one number).

    Notes
    -----
    Two supports are equal when kind, bounds (their shapes, too), openness and parts are.

    Examples
    --------
    >>> from bayesmc.distributions.support import integers, positive
    >>> integers(0, 3).size, integers(0, 3).contains([0, 4]).tolist()
    (4, [True, False])
    >>> positive.describe()
    'numbers > 0'
    """

    kind: str
    low: Any = -np.inf
    high: Any = np.inf
    open_low: bool = False
    open_high: bool = False
    parts: tuple[tuple[Support, int], ...] = ()

    def __eq__(self, other: object) -> bool:
        if self is other or not isinstance(other, Support):
            return self is other
        return (
            self._tag() == other._tag()
            and _same(self.low, other.low)
            and _same(self.high, other.high)
        )

    def __hash__(self) -> int:
        return hash(self._tag())

    @property
    def is_discrete(self) -> bool:
        return self.kind in ("integers", "counts")

    @property
    def event_ndim(self) -> int:
        return _EVENT_NDIM.get(self.kind, 0)

    @property
    def is_constant(self) -> bool:
        """Whether the bounds are the same for every batch element."""
        parts_are = all(part.is_constant for part, _ in self.parts)
        return parts_are and _constant(self.low) and _constant(self.high)

    @property
    def is_single(self) -> bool:
        """Whether each bound is one number, and no array that may differ for other parents."""
        parts_are = all(part.is_single for part, _ in self.parts)
        return parts_are and np.size(self.low) == 1 and np.size(self.high) == 1

    @property
    def at_most(self) -> Support:
        """What it lies in whatever the parents are: bounds that may differ for others are infinite."""
        if self.kind not in ("interval", "integers", "increasing") or self.is_single:
            return self
        low, high = np.asarray(self.low), np.asarray(self.high)
        return Support(
            self.kind,
            float(_first(low)) if low.size == 1 else -np.inf,
            float(_first(high)) if high.size == 1 else np.inf,
            self.open_low,
            self.open_high,
        )

    @property
    def size(self) -> int | None:
        """Number of values, where finite and the same for every batch element; else None."""
        if self.kind != "integers" or not self.is_constant:
            return None
        low, high = _first(self.low), _first(self.high)
        if not (np.isfinite(low) and np.isfinite(high)):
            return None
        return int(high) - int(low) + 1

    @property
    def values(self) -> np.ndarray | None:
        """The values of a finite support in order, shape ``(size,)``; else None."""
        size = self.size
        if size is None:
            return None
        return np.arange(size) + int(_first(self.low))

    def angles(self, size: int) -> np.ndarray:
        """Which of the ``size`` components of a value are angles, shape (size,)."""
        if self.kind != "product":
            return np.full(size, self.kind == "circle")
        return np.concatenate([part.angles(max(count, 1)) for part, count in self.parts])

    def contains(self, x: Any) -> np.ndarray:
        """Whether each value lies in the support; event axes are reduced, NaN never does."""
        x = np.asarray(x)
        if self.kind == "real" or self.kind == "circle":
            return np.isfinite(x)
        if self.kind == "real vector":
            return np.isfinite(x).all(axis=-1)
        if self.kind == "simplex":
            return (x >= 0).all(axis=-1) & (np.abs(x.sum(axis=-1) - 1) <= 1e-6)
        if self.kind == "counts":
            return ((x >= 0) & (x == np.floor(x))).all(axis=-1)
        if self.kind == "positive definite":
            bad = try_cholesky(x)[1]
            return np.ones(x.shape[:-2], dtype=bool) if bad is None else ~bad
        if self.kind == "correlation":
            ones = (np.abs(np.linalg.diagonal(x) - 1) <= 1e-6).all(axis=-1)
            return ones & positive_definite.contains(x)
        if self.kind == "product":
            return self._parts_contain(x)
        if self.kind == "increasing":
            inside = ((x >= self.low) & (x <= self.high) & np.isfinite(x)).all(axis=-1)
            return inside & (x[..., 1:] >= x[..., :-1]).all(axis=-1)
        above = x > self.low if self.open_low else x >= self.low
        below = x < self.high if self.open_high else x <= self.high
        inside = above & below & np.isfinite(x)
        if self.kind == "integers":
            inside = inside & (x == np.floor(x))
        return inside

    def covers(self, other: Support) -> bool:
        """Whether draws of a distribution on this support can fall everywhere on ``other``.

        False only where they surely cannot; whether a bound itself is included does not matter.
        Between discrete and continuous supports nothing is covered. Bounds that depend on parents
        are compared batch element by batch element.

        Parameters
        ----------
        other : Support

        Examples
        --------
        >>> from bayesmc.distributions.support import integers, interval, positive, real
        >>> real.covers(positive), positive.covers(real), positive.covers(interval(0.0, 2.0))
        (True, False, True)
        >>> real.covers(integers(0)), integers(0).covers(integers(1, 6))
        (False, True)
        """
        if self.is_discrete != other.is_discrete:
            return False
        mine, theirs = _components(self), _components(other)
        if len(mine) != len(theirs) and 1 not in (len(mine), len(theirs)):
            return True  # vectors of unlike lengths: nothing can be said
        size = max(len(mine), len(theirs))
        mine, theirs = (ones * (size // len(ones)) for ones in (mine, theirs))
        return all(_covers(a, b) for a, b in zip(mine, theirs, strict=True))

    def describe(self) -> str:
        """The support in words, for messages."""
        if self.kind in ("interval", "integers"):
            noun = "integers" if self.kind == "integers" else "numbers"
            if not self.is_constant:
                return f"{noun} between bounds that depend on the parents"
            low, high = _first(self.low), _first(self.high)
            if np.isfinite(low) and np.isfinite(high):
                if self.kind == "integers":
                    return f"integers {low:g}..{high:g}"
                left, right = "(" if self.open_low else "[", ")" if self.open_high else "]"
                return f"numbers in {left}{low:g}, {high:g}{right}"
            if not (np.isfinite(low) or np.isfinite(high)):
                return noun
            if np.isfinite(low):
                return f"{noun} {'>' if self.open_low else '>='} {low:g}"
            return f"{noun} {'<' if self.open_high else '<='} {high:g}"
        if self.kind == "increasing" and self != increasing():
            inner = interval(self.low, self.high).describe()
            return f"vectors whose components increase, {inner}"
        return {
            "real": "real numbers",
            "circle": "angles in radians",
            "simplex": "vectors of probabilities that sum to 1",
            "real vector": "real vectors",
            "counts": "vectors of counts",
            "positive definite": "positive definite matrices",
            "correlation": "correlation matrices",
            "increasing": "vectors whose components increase",
            "product": f"vectors whose parts are {'; '.join(_part(*part) for part in self.parts)}",
        }[self.kind]

    def _tag(self) -> tuple[Any, ...]:
        return self.kind, self.open_low, self.open_high, self.parts

    def _parts_contain(self, x: np.ndarray) -> np.ndarray:
        size = sum(max(count, 1) for _, count in self.parts)
        if x.shape[-1:] != (size,):
            raise ShapeError(f"{self!r} has {size} components; got values of shape {x.shape}")
        inside: Any = True
        start = 0
        for part, count in self.parts:
            here = part.contains(x[..., start : start + count] if count else x[..., start])
            if count and not part.event_ndim:  # a support of numbers, several components
                here = np.asarray(here.all(axis=-1))
            inside = inside & here
            start += max(count, 1)
        return np.asarray(inside)

    def __repr__(self) -> str:
        return f"<support: {self.describe()}>"


real = Support("real")
positive = Support("interval", 0.0, np.inf, open_low=True)
nonnegative = Support("interval", 0.0, np.inf)
unit_interval = Support("interval", 0.0, 1.0)
circle = Support("circle")
simplex = Support("simplex")
real_vector = Support("real vector")
positive_definite = Support("positive definite")
correlation = Support("correlation")


def interval(low: Any, high: Any, open_low: bool = False, open_high: bool = False) -> Support:
    """The numbers from ``low`` to ``high``."""
    return Support("interval", low, high, open_low, open_high)


def increasing(low: float = -np.inf, high: float = np.inf) -> Support:
    """Vectors of numbers between two bounds, each at least the one before it."""
    return Support("increasing", low, high)


def integers(low: Any, high: Any = np.inf) -> Support:
    """The integers ``low .. high``, both included."""
    return Support("integers", low, high)


def product(parts: Iterable[tuple[Support, int]]) -> Support:
    """Vectors whose components, in order, lie in supports of their own.

    Parameters
    ----------
    parts : sequence of (Support, int)
        A support and the number of components it takes; 0 for a single number.

    Raises
    ------
    UnsupportedError
        A part is discrete, or takes matrices.

    Examples
    --------
    >>> from bayesmc.distributions.support import positive, product, simplex
    >>> both = product([(positive, 0), (simplex, 2)])
    >>> both.contains([[1.0, 0.5, 0.5], [-1.0, 0.5, 0.5]]).tolist()
    [True, False]
    """
    parts = tuple((part, int(count)) for part, count in parts)
    for part, count in parts:
        if part.is_discrete or part.event_ndim > 1:
            raise UnsupportedError(
                f"product: {part.describe()} cannot be components of a real vector"
            )
        if part.event_ndim and not count:
            raise ShapeError(f"product: {part.describe()} take a number of components, not 0")
    return Support("product", parts=parts)


def as_support(spec: Any) -> Support:
    """A support from its name ("real", "positive", "unit interval", ...), bounds or itself."""
    if isinstance(spec, Support):
        return spec
    if isinstance(spec, tuple) and len(spec) == 2:
        return interval(float(spec[0]), float(spec[1]))
    try:
        return _NAMED[str(spec).replace("_", " ").lower()]
    except KeyError:
        names = ", ".join(repr(name) for name in _NAMED)
        raise ValueError(
            f"support={spec!r} is not known; use one of {names}, a pair (low, high), or a Support"
        ) from None


_NAMED = {
    "real": real,
    "positive": positive,
    "nonnegative": nonnegative,
    "unit": unit_interval,
    "unit interval": unit_interval,
    "circle": circle,
    "simplex": simplex,
    "real vector": real_vector,
    "integer": Support("integers"),
    "integers": Support("integers"),
    "nonnegative integer": integers(0),
    "counts": Support("counts"),
    "positive definite": positive_definite,
    "correlation": correlation,
    "increasing": increasing(),
}


def is_half_line(support: Support) -> bool:
    """Whether a support is everything above one constant."""
    if support.kind != "interval" or not support.is_single:
        return False
    return bool(np.isfinite(support.low).all() and np.all(support.high == np.inf))


def _constant(bound: Any) -> bool:
    array = np.asarray(bound)
    return array.ndim == 0 or array.size <= 1 or bool((array == array.flat[0]).all())


def _first(bound: Any) -> Any:
    return np.asarray(bound).flat[0]


def _same(a: Any, b: Any) -> bool:
    return np.shape(a) == np.shape(b) and bool(np.all(np.asarray(a) == np.asarray(b)))


def _components(support: Support) -> list[Support]:
    """The support of each component of a product; of anything else, the one that serves them all."""
    if support.kind != "product":
        return [support]
    return [part for part, count in support.parts for _ in range(max(count, 1))]


def _covers(mine: Support, other: Support) -> bool:
    if mine.kind in ("simplex", "positive definite", "correlation"):
        return mine.kind == other.kind
    (low, high), (least, most) = _range(mine), _range(other)
    return not (_above(low, least) or _above(most, high))


def _range(support: Support) -> tuple[Any, Any]:
    """Between which numbers each component lies."""
    return {"circle": (-np.pi, np.pi), "simplex": (0.0, 1.0), "counts": (0.0, np.inf)}.get(
        support.kind, (support.low, support.high)
    )


def _above(a: Any, b: Any) -> bool:
    """Whether some ``a`` exceeds its ``b``; of batches that do not fit, whether each exceeds all."""
    try:
        return bool(np.any(np.greater(a, b)))
    except ValueError:
        return bool(np.min(a) > np.max(b))


def _part(part: Support, count: int) -> str:
    return part.describe() + (f" ({count} components)" if count else "")
