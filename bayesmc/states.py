"""Labelled states: integer codes that compare with labels.

A node declared with ``states=("yes", "no")`` reaches functions and queries as a ``StateArray`` of
positions 0, 1, ... for which ``== "yes"`` means what it says and an unknown label raises.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from bayesmc.errors import StateError, did_you_mean

#: NumPy functions that move elements about without changing them, so that labels survive
_MOVERS = frozenset(
    (
        np.stack, np.concatenate, np.vstack, np.hstack, np.broadcast_to, np.broadcast_arrays,
        np.copy, np.reshape, np.ravel, np.transpose, np.squeeze, np.expand_dims, np.moveaxis,
        np.swapaxes, np.repeat, np.tile, np.take, np.take_along_axis, np.flip, np.roll,
        np.atleast_1d, np.atleast_2d, np.where,
    )
)  # fmt: skip


class NumberArray(np.ndarray):
    """Numbers that refuse to be compared with labels, where NumPy would quietly answer False.

    Functions are tried on it and queries receive it, so that a forgotten ``states=`` is heard of.
    """

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **kwargs: Any) -> Any:
        if ufunc in (np.equal, np.not_equal):
            _refuse_labels(inputs)
        plain = [_bare(x) for x in inputs]
        if ufunc is np.invert and plain[0].dtype.kind in "iu" and np.isin(plain[0], (0, 1)).all():
            raise StateError(
                "~ on the integers 0 and 1 gives -1 and -2, which are both true; write k == 0, or 1 - k"
            )
        if "out" in kwargs:
            kwargs["out"] = tuple(_bare(x) for x in kwargs["out"])
        result = getattr(ufunc, method)(*plain, **kwargs)
        return _numbers_too(result)

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        if func is np.isin:
            _refuse_labels(args)
        return _numbers_too(func(*_bare(args), **{k: _bare(v) for k, v in kwargs.items()}))

    def __repr__(self) -> str:
        return repr(self.view(np.ndarray))


def as_numbers(array: np.ndarray) -> np.ndarray:
    """The array as one that refuses labels."""
    return array.view(NumberArray) if type(array) is np.ndarray else array


class StateArray(np.ndarray):
    """Integer codes whose ``==`` and ``!=`` accept labels; arithmetic gives plain integers.

    Parameters
    ----------
    codes : array_like of int
        Positions in ``states``.
    states : sequence
        The labels, in the order of the support.

    Examples
    --------
    >>> from bayesmc.states import StateArray
    >>> x = StateArray([0, 1, 1], ("yes", "no"))
    >>> x == "no", x + 1
    (array([False,  True,  True]), array([1, 2, 2]))
    >>> x
    StateArray(['yes', 'no', 'no'])
    """

    states: tuple[Any, ...]

    def __new__(cls, codes: Any, states: Sequence[Any]) -> StateArray:
        array = np.asarray(codes).view(cls)
        array.states = tuple(states)
        return array

    def __array_finalize__(self, obj: Any) -> None:
        self.states = getattr(obj, "states", ())

    @property
    def codes(self) -> np.ndarray:
        """The positions as numbers."""
        return self.view(NumberArray)

    @property
    def labels(self) -> np.ndarray:
        """The labels, same shape."""
        return label_array(self.states)[self.codes]

    def isin(self, labels: Sequence[Any]) -> np.ndarray:
        """Whether each element is one of ``labels``."""
        return np.isin(self.codes, [label_code(self.states, label) for label in labels])

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **kwargs: Any) -> Any:
        if ufunc in (np.equal, np.not_equal) and method == "__call__":
            inputs = _comparable(*inputs)
            return getattr(ufunc, method)(*(_bare(x) for x in inputs), **kwargs)
        result = getattr(ufunc, method)(*(_bare(x) for x in inputs), **kwargs)
        return _numbers_too(result)

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        if func is np.isin and isinstance(args[0], StateArray):
            return args[0].isin(
                np.atleast_1d(np.asarray(args[1], dtype=object)).ravel().tolist(), **kwargs
            )
        result = func(*_bare(args), **{k: _bare(v) for k, v in kwargs.items()})
        moved = args[1:] if func is np.where else args
        states = {x.states for x in _leaves(moved) if isinstance(x, StateArray)}
        keeps = func in _MOVERS and len(states) == 1 and _all_labelled(func, moved)
        if keeps and isinstance(result, (list, tuple)):
            return type(result)(StateArray(r, next(iter(states))) for r in result)
        if keeps and isinstance(result, np.ndarray):
            return StateArray(result, next(iter(states)))
        return _numbers_too(result)

    def __getitem__(self, key: Any) -> Any:
        item = super().__getitem__(key)
        return item if isinstance(item, StateArray) else StateArray(item, self.states)

    def __iter__(self) -> Any:
        return (self[i] for i in range(len(self)))

    def __hash__(self) -> int:  # type: ignore[override]
        if self.ndim:
            raise TypeError("unhashable: an array of states")
        return hash(self.states[int(self.codes)])

    def astype(self, dtype: Any, *args: Any, **kwargs: Any) -> np.ndarray:
        return as_numbers(self.view(np.ndarray).astype(dtype, *args, **kwargs))

    def tolist(self) -> Any:
        """The labels as (nested) lists."""
        return self.labels.tolist() if self.ndim else self.states[int(self.codes)]

    def __repr__(self) -> str:
        return f"StateArray({np.array2string(self.labels, separator=', ', threshold=20)})"

    def __str__(self) -> str:
        return str(self.labels) if self.ndim else str(self.states[int(self.codes)])

    def __format__(self, spec: str) -> str:
        return format(str(self), spec)

    def __reduce__(self) -> Any:
        return StateArray, (self.codes.copy(), self.states)


def label_array(states: Sequence[Any]) -> np.ndarray:
    """The labels as an array (of strings where all are strings, else of objects)."""
    if all(isinstance(s, str) for s in states):
        return np.array(states)
    labels = np.empty(len(states), dtype=object)
    labels[:] = list(states)
    return labels


def label_code(states: Sequence[Any], label: Any) -> int:
    """Position of ``label`` among ``states``; an unknown one raises with the allowed labels."""
    if isinstance(label, np.generic):
        label = label.item()
    for code, state in enumerate(states):
        if type(state) is type(label) and state == label:
            return code
    if not isinstance(label, str):
        for code, state in enumerate(states):
            if not isinstance(state, str) and state == label:
                return code
    known = ", ".join(map(repr, states))
    hint = did_you_mean(label, states)
    raise StateError(f"{label!r} is not a state; the states are {known}{hint}")


def _refuse_labels(values: Any) -> None:
    """Raise if a label is among what numbers are compared with."""
    labels = (leaf for leaf in _leaves(list(values)) if isinstance(leaf, (str, np.str_)))
    label = next(labels, None)
    if label is not None:
        raise StateError(
            f"numbers are compared with the label {str(label)!r}: the node has no labels (or they were lost "
            "on the way); declare it with states="
        )


def _numbers_too(result: Any) -> Any:
    """Arrays and NumPy scalars as numbers that refuse labels; anything else as it is."""
    plain = type(result) is np.ndarray or isinstance(result, (np.number, np.bool_))
    return as_numbers(np.asarray(result)) if plain else result


def _bare(value: Any) -> Any:
    """Plain arrays in place of those defined here, also inside lists and tuples."""
    if isinstance(value, (StateArray, NumberArray)):
        return value.view(np.ndarray)
    if isinstance(value, (list, tuple)):
        return type(value)(_bare(v) for v in value)
    return value


def _leaves(value: Any) -> list[Any]:
    if isinstance(value, (list, tuple)):
        return [leaf for v in value for leaf in _leaves(v)]
    if isinstance(value, np.ndarray) and value.dtype.kind in "USO":
        return value.ravel().tolist()
    return [value]


def _all_labelled(func: Any, args: Any) -> bool:
    """Whether everything a function moves is labelled; its other arguments say how."""
    moved = args if func in (np.where, np.broadcast_arrays) else args[:1]
    return all(isinstance(leaf, StateArray) for leaf in _leaves(moved))


def _comparable(a: Any, b: Any) -> tuple[Any, Any]:
    """Both sides as codes over the same states."""
    if isinstance(a, StateArray) and isinstance(b, StateArray):
        if a.states == b.states:
            return a, b
        shared = {s: i for i, s in enumerate(a.states)}
        return a.codes, np.array([shared.get(s, -1) for s in b.states])[b.codes]
    if isinstance(b, StateArray):
        other, codes = _comparable(b, a)
        return codes, other
    if isinstance(b, tuple) and b in a.states:  # a label that happens to be a tuple
        return a, np.asarray(a.states.index(b))
    plain = np.asarray(b, dtype=object) if isinstance(b, (str, list, tuple)) else np.asarray(b)
    if plain.dtype.kind in "US" or plain.dtype == object:
        codes = [label_code(a.states, label) for label in plain.ravel().tolist()]
        return a, np.array(codes, dtype=int).reshape(plain.shape)
    return a, b
