"""What all rules of tracing share: the stand-in as they see it, and its bare numbers.

The rules (``affine``, ``margins``) read stand-ins; ``tracer`` makes them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.shapes import Shape


class StandIn:
    """A stand-in for an array, as the rules see it."""

    __slots__ = ()

    _value: np.ndarray
    sources: frozenset[str]
    reason: str | None
    margin: Any

    @property
    def is_affine(self) -> bool:
        """Whether it is proved to be an affine function of its sources jointly."""
        return self.reason is None

    @property
    def shape(self) -> Shape:
        return self._value.shape

    @property
    def ndim(self) -> int:
        return self._value.ndim


@dataclass(frozen=True, eq=False)
class TracedCall:
    """A call that was not made because an argument is traced: what was called, and with what.

    Attributes
    ----------
    function : callable
    arguments : dict
        By name, in the order of the signature.
    """

    function: Callable[..., Any]
    arguments: dict[str, Any]


def is_traced(value: Any) -> bool:
    """Whether a value is traced, or is a sequence that holds something traced."""
    if isinstance(value, (list, tuple)):
        return any(is_traced(v) for v in value)
    return isinstance(value, (StandIn, TracedCall))


def leaves(value: Any) -> list[Any]:
    """What lists and tuples hold, however deep."""
    if isinstance(value, (list, tuple)):
        return [leaf for v in value for leaf in leaves(v)]
    return [value]


def stand_ins(values: Any) -> list[StandIn]:
    """The stand-ins among arguments."""
    return [x for x in leaves(values) if isinstance(x, StandIn)]


def bare(value: Any) -> Any:
    """Numbers in place of what stands for them; arrays of others can be read only, not written to."""
    if isinstance(value, StandIn):
        return value._value
    if isinstance(value, np.ndarray):
        return locked(value)
    if isinstance(value, (list, tuple)):
        return type(value)(bare(v) for v in value)
    return value


def locked(array: np.ndarray) -> np.ndarray:
    """A view that refuses to be written to (asking a broadcast array whether it does makes NumPy warn)."""
    view = array.view()
    view.flags.writeable = False
    return view


def is_foreign(value: Any) -> bool:
    """Whether a value has rules of its own for NumPy, and is no plain array."""
    if isinstance(value, np.ma.MaskedArray):
        return True  # masked entries are not what was computed
    return (
        not isinstance(value, (np.ndarray, StandIn, np.generic))
        and getattr(value, "__array_ufunc__", None) is not None
    )
