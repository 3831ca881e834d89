"""Supports: where a distribution puts its mass, as a small value that can be asked.

Engines read it to refuse evidence that cannot happen, to enumerate finite nodes and, later, to map
bounded values to the whole line. It holds no parameters beyond the bounds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

_EVENT_NDIM = {"simplex": 1, "real vector": 1, "positive definite": 2, "counts": 1}


@dataclass(frozen=True, eq=False)
class Support:
    """Where a distribution's mass lies.

    Parameters
    ----------
    kind : str
        ``"real"``, ``"interval"``, ``"circle"``, ``"integers"``, ``"simplex"``, ``"real vector"``,
        ``"counts"`` or ``"positive definite"``.
    low, high : float or array
        Bounds of an interval or of integers (inclusive), possibly infinite; arrays when they
        depend on parents.
    open_low, open_high : bool
        Whether the bound itself is excluded.

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

    @property
    def is_discrete(self) -> bool:
        return self.kind in ("integers", "counts")

    @property
    def event_ndim(self) -> int:
        return _EVENT_NDIM.get(self.kind, 0)

    @property
    def is_constant(self) -> bool:
        """Whether the bounds are the same for every batch element."""
        return _constant(self.low) and _constant(self.high)

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
            return np.linalg.eigvalsh(x)[..., 0] > 0
        above = x > self.low if self.open_low else x >= self.low
        below = x < self.high if self.open_high else x <= self.high
        inside = above & below & np.isfinite(x)
        if self.kind == "integers":
            inside = inside & (x == np.floor(x))
        return inside

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
            if np.isfinite(low):
                return f"{noun} {'>' if self.open_low else '>='} {low:g}"
            return f"{noun} {'<' if self.open_high else '<='} {high:g}"
        return {
            "real": "real numbers",
            "circle": "angles in radians",
            "simplex": "vectors of probabilities that sum to 1",
            "real vector": "real vectors",
            "counts": "vectors of counts",
            "positive definite": "positive definite matrices",
        }[self.kind]

    def __repr__(self) -> str:
        return f"<support: {self.describe()}>"


real = Support("real")
positive = Support("interval", 0.0, np.inf, open_low=True)
nonnegative = Support("interval", 0.0, np.inf)
unit_interval = Support("interval", 0.0, 1.0)
simplex = Support("simplex")
real_vector = Support("real vector")


def interval(low: Any, high: Any, open_low: bool = False, open_high: bool = False) -> Support:
    """The numbers from ``low`` to ``high``."""
    return Support("interval", low, high, open_low, open_high)


def integers(low: Any, high: Any = np.inf) -> Support:
    """The integers ``low .. high``, both included."""
    return Support("integers", low, high)


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
    "circle": Support("circle"),
    "simplex": simplex,
    "real vector": real_vector,
    "integer": Support("integers"),
    "integers": Support("integers"),
    "nonnegative integer": integers(0),
    "counts": Support("counts"),
    "positive definite": Support("positive definite"),
}


def _constant(bound: Any) -> bool:
    array = np.asarray(bound)
    return array.ndim == 0 or array.size <= 1 or bool((array == array.flat[0]).all())


def _first(bound: Any) -> Any:
    return np.asarray(bound).flat[0]
