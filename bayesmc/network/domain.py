"""Finite domains: the three faces of a discrete value.

A node with finitely many values is stored as *positions* 0..size-1 in the smallest integer type.
A distribution speaks *support values* (position plus the support's first value); functions, evidence
and results speak *user values*: the support value itself, a numeric state, or a labelled code.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.errors import EvidenceError, ModelError
from bayesmc.states import StateArray, label_code


@dataclass(frozen=True, eq=False)
class Domain:
    """A finite set of values in the order of the support.

    Attributes
    ----------
    size : int
    low : int
        First value of the distribution's support.
    values : ndarray or None
        Numeric user values, shape (size,); None when they are ``low + position`` or labels.
    labels : tuple or None
        Labels of non-numeric states.
    """

    size: int
    low: int = 0
    values: np.ndarray | None = None
    labels: tuple[Any, ...] | None = None

    @property
    def dtype(self) -> np.dtype:
        """Smallest unsigned integer type that holds the positions."""
        return np.min_scalar_type(max(self.size - 1, 0))

    @property
    def key(self) -> Hashable:
        """Equal for sets of the same values."""
        values = None if self.values is None else (self.values.dtype.str, self.values.tobytes())
        return self.size, self.low, values, self.labels

    @property
    def states(self) -> tuple[Any, ...]:
        """The user values as a tuple."""
        if self.labels is not None:
            return self.labels
        if self.values is not None:
            return tuple(self.values.tolist())
        return tuple(range(self.low, self.low + self.size))

    @property
    def numbers(self) -> np.ndarray | None:
        """The user values as numbers, shape (size,); None for labels."""
        if self.labels is not None:
            return None
        return self.values if self.values is not None else np.arange(self.size) + self.low

    def decode(self, positions: np.ndarray) -> np.ndarray:
        """Positions as what functions and results receive."""
        if self.labels is not None:
            return StateArray(positions.astype(np.intp), self.labels)
        if self.values is not None:
            return np.take(self.values, positions)
        if self.low:
            return positions.astype(np.intp) + self.low
        return positions.astype(np.intp)

    def from_support(self, values: np.ndarray) -> np.ndarray:
        """Values of the distribution as positions."""
        return (values - self.low if self.low else values).astype(self.dtype, copy=False)

    def to_support(self, positions: np.ndarray) -> np.ndarray:
        """Positions as values of the distribution."""
        return positions.astype(np.int64) + self.low

    def encode(self, value: Any) -> np.ndarray:
        """User values as positions; one that is not a state raises with the allowed states."""
        if self.labels is not None:
            return self._encode_labels(value)
        array = np.asarray(value)
        if array.dtype.kind not in "biuf":
            raise EvidenceError(f"{_first(array)!r} is not among the values {self._allowed()}")
        numbers = self.numbers
        assert numbers is not None
        positions = np.searchsorted(np.sort(numbers), array)
        order = np.argsort(numbers, kind="stable")
        positions = np.asarray(order[np.minimum(positions, self.size - 1)])
        wrong = numbers[positions] != array
        if np.any(wrong):
            raise EvidenceError(
                f"{np.asarray(array)[wrong].flat[0]:g} is not among the values {self._allowed()}"
            )
        return positions.astype(self.dtype)

    def _encode_labels(self, value: Any) -> np.ndarray:
        assert self.labels is not None
        if isinstance(value, StateArray):
            if value.states == self.labels:
                return value.codes.astype(self.dtype)
            value = value.labels
        array = np.asarray(value, dtype=None if isinstance(value, np.ndarray) else object)
        unique, inverse = _unique_labels(array)
        try:
            codes = [label_code(self.labels, label) for label in unique]
        except ValueError as error:
            hint = ""
            if any(isinstance(u, (int, np.integer)) for u in unique):
                hint = "; give the label, not its position"
            raise EvidenceError(f"{error}{hint}") from None
        return np.array(codes, dtype=self.dtype)[inverse].reshape(array.shape)

    def _allowed(self) -> str:
        states = self.states
        if len(states) > 12:
            return f"{states[0]}..{states[-1]}"
        return ", ".join(map(str, states))


def domain_with_states(size: int, low: int, states: tuple[Any, ...] | None) -> Domain:
    """The domain of a support of ``size`` values under the ``states`` a node declares (or None)."""
    if states is None:
        return Domain(size, low)
    if len(states) != size:
        raise ModelError(
            f"states= has {len(states)} entries, but the distribution has {size} values; give one each"
        )
    return states_domain(states, low)


def states_domain(states: tuple[Any, ...], low: int = 0) -> Domain:
    """Numeric states arrive as numbers, all others as labelled codes."""
    if len({(type(s) is str, s) for s in states}) != len(states):
        raise ModelError(f"states= names a state twice: {states}")
    numbers = [isinstance(s, (int, float, bool, np.number, np.bool_)) for s in states]
    if any(numbers) and not all(numbers):
        raise ModelError(f"states= mixes numbers and labels: {states}; give one kind")
    if any(s is None or s != s for s in states):
        raise ModelError(f"states= has an entry that names nothing: {states}")
    if all(isinstance(s, (int, float, bool, np.number, np.bool_)) for s in states):
        values = np.asarray(states)
        values.flags.writeable = False
        return Domain(len(states), low, values=values)
    return Domain(len(states), low, labels=tuple(states))


def _unique_labels(array: np.ndarray) -> tuple[list[Any], np.ndarray]:
    flat = array.ravel().tolist()
    order: dict[Any, int] = {}
    inverse = np.empty(len(flat), dtype=int)
    for i, label in enumerate(flat):
        inverse[i] = order.setdefault(label, len(order))
    return list(order), inverse


def _first(array: np.ndarray) -> Any:
    return array.ravel().tolist()[0] if array.size else None
