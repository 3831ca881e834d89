"""What all rules of tracing share: the stand-in as they see it, what is claimed of it, and its bare numbers.

The rules (``affine``, ``margins``, ``axes``, ``claims``) read stand-ins; ``tracer`` makes them.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bayesmc.shapes import Shape


@dataclass(frozen=True, slots=True, eq=False)
class Claims:
    """What is certain of a value besides being affine; the default claims nothing.

    Attributes
    ----------
    power : float or None
        It is ``c * x**power`` element by element, wherever that is a real number.
    is_copy : bool
        Every element is an element of a source.
    event_ndim : int
        Event axes of the sources.
    whole_event : bool
        Its last axes are those, in order, and of a power ``c`` is the same all over the event.
    form : hashable or None
        Values of equal form, broadcast against each other, have equal elements of the source in equal places.
    behind : int
        Axes behind those of the plates; means something while ``places`` is not empty.
    places : mapping
        Sources that are read at one place for each element of the plates (``x[0]``), and what they are
        called where that is no longer certain (``x[*]``).
    spread : frozenset of str
        Sources called so by now.
    """

    power: float | None = None
    is_copy: bool = False
    event_ndim: int = 0
    whole_event: bool = True
    form: Hashable = None
    behind: int = 0
    places: Mapping[str, str] = field(default_factory=dict)
    spread: frozenset[str] = frozenset()


class StandIn:
    """A stand-in for an array, as the rules see it."""

    __slots__ = ()

    _value: np.ndarray
    sources: frozenset[str]
    reason: str | None
    margin: Any
    claims: Claims

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

    @property
    def traced(self) -> dict[str, Any]:
        """The arguments that are traced, or hold something traced."""
        return {name: value for name, value in self.arguments.items() if is_traced(value)}


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
