"""Labels: of states, which functions and evidence speak, and of plates, by which data may be given.

A node with finitely many values is stored as *positions* 0..size-1 in the smallest integer type.
A distribution speaks *support values* (position plus the support's first value); functions, evidence
and results speak *user values*: the support value itself, a numeric state, or a labelled code.

Of a pandas Series or DataFrame, or an xarray DataArray, labels, not the order, say which element of a
plate a number belongs to; what has none, or the default 0, 1, 2, ..., goes by position. Nothing here
imports those packages; what looks like them is taken as such.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.errors import EvidenceError, ModelError, did_you_mean
from bayesmc.network.columns import array_of, is_column
from bayesmc.states import StateArray, label_code

Labels = Mapping[str, tuple[Any, ...]]


def by_label(what: str, value: Any, plates: Sequence[str], labels: Labels, ahead: int = 0) -> Any:
    """The numbers of labelled data in the order of the plates; other values as they are.

    Parameters
    ----------
    what : str
        Whose data they are, for messages.
    value : Any
    plates : sequence of str
        Of the node or input.
    labels : dict
        Plate -> labels, of those that have some.
    ahead : int
        How many axes stand before those of the plates (1: time).

    Raises
    ------
    EvidenceError
        A label stands twice, is none of the plate's, or is missing.
    """
    value = oriented(what, value, plates, labels, ahead)
    found = _labelled(value, plates, ahead)
    if found is None:
        plain = isinstance(value, np.ndarray) or not is_column(value)
        return value if plain else array_of(value)
    array, own = found
    for k, plate in enumerate(plates):
        axis = k + ahead
        here = own[axis] if axis < len(own) else None
        if plate in labels and here is not None:
            order = _order(what, plate, here, labels[plate])
            if order is not None:
                array = np.take(array, order, axis=axis)
    return array


def oriented(what: str, value: Any, plates: Sequence[str], labels: Labels, ahead: int = 0) -> Any:
    """A table with rows along the first plate and columns along the second; other values as they are.

    The name of its index or columns tells which plate they are, else a plate's labels; where neither does,
    they are in the order of the plates.

    Raises
    ------
    EvidenceError
        Names and labels settle it both ways; over time (``ahead``), rows are no slices.

    Examples
    --------
    >>> import pandas as pd  # doctest: +SKIP
    >>> from bayesmc.network.labels import oriented
    >>> table = pd.DataFrame([[1, 2]], columns=["Bonn", "Ulm"])  # doctest: +SKIP
    >>> labels = {"city": ("Bonn", "Ulm")}
    >>> oriented("y", table, ("city", "year"), labels).shape  # doctest: +SKIP
    (2, 1)
    """
    if isinstance(value, (np.ndarray, list, tuple, str, int, float)):
        return value
    index, columns = getattr(value, "index", None), getattr(value, "columns", None)
    axes = [*([None] * ahead), *plates][:2]
    if index is None or columns is None or callable(index) or not axes or not hasattr(value, "T"):
        return value
    if getattr(columns, "nlevels", 1) > 1 or getattr(index, "nlevels", 1) > 1:
        return value
    axes += [None] * (2 - len(axes))
    sides = (index, columns)
    ways = (axes, axes[::-1])
    straight, crossed = (any(map(_names, sides, way)) for way in ways)
    own, other = (any(_fits(s, p, labels) for s, p in zip(sides, way, strict=True)) for way in ways)
    if not straight and not crossed:
        straight, crossed = own, other
    elif own != other:  # labels that are told apart say the same as names
        straight, crossed = straight or own, crossed or other
    if not crossed or (straight and None in axes):
        return value
    if straight:
        raise EvidenceError(
            f"{what}: rows and columns of the table may be either of the plates {tuple(plates)}, by what "
            f"labels them; name them, .rename_axis(index={axes[0]!r}, columns={axes[1]!r}), or give "
            ".to_numpy() with an axis for each plate in this order"
        )
    if ahead:
        raise EvidenceError(
            f"{what}: by its labels the table has the plate {plates[0]!r} along its rows; time comes first, "
            "so give its .T"
        )
    return value.T


def refuse_crossed(
    data: Sequence[tuple[str, Any, Sequence[str]]], labels: Labels, timed: bool = False
) -> None:
    """Refuse data whose labels of one plate without declared labels (or of time) are not the same.

    Parameters
    ----------
    data : sequence of (str, Any, sequence of str)
        Name, value and plates.
    timed : bool
        The first axis is time.

    Raises
    ------
    EvidenceError
    """
    seen: dict[str, tuple[str, list[Any]]] = {}
    data = [(n, oriented(f"data of {n!r}", v, p, labels, int(timed)), p) for n, v, p in data]
    for name, value, plates in data:
        ahead = 1 if timed else 0
        found = _labelled(value, plates, ahead)
        if found is None:
            continue
        for plate, own in zip([*(["time"] * ahead), *plates], found[1], strict=False):
            if own is None or plate in labels:
                continue
            other, before = seen.setdefault(plate, (name, own))
            if _differ(own, before, timed and plate == "time"):
                k = next(
                    (k for k, (a, b) in enumerate(zip(own, before, strict=False)) if a != b), 0
                )
                raise EvidenceError(
                    f"{name!r} and {other!r} are labelled unlike along {plate!r}: from position {k} on "
                    f"{_some(own[k:])} and {_some(before[k:])}; {_remedy(plate)}"
                )


def refuse_backwards(what: str, value: Any) -> None:
    """Refuse rows over time whose index says that they are not in the order of time.

    Raises
    ------
    EvidenceError
    """
    found = _labelled(value, (), 1)
    own = None if found is None else found[1][0]
    if not own or isinstance(own[0], str):
        return
    try:
        at = next((k for k in range(1, len(own)) if own[k] < own[k - 1]), None)
    except TypeError:
        return
    if at is not None:
        raise EvidenceError(
            f"{what}: row {at} is labelled {own[at]!r}, before {own[at - 1]!r} of row {at - 1}; row k "
            "belongs to slice k, so sort the rows by time (sort_index()), or give .to_numpy() if they are"
        )


def is_default(own: list[Any]) -> bool:
    """Whether labels are 0, 1, 2, ..., which say nothing."""
    return all(type(x) is not bool and x == k for k, x in enumerate(own))


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


# ---- private ------------------------------------------------------------------------------------


def _labelled(
    value: Any, plates: Sequence[str], ahead: int
) -> tuple[np.ndarray, list[list[Any] | None]] | None:
    """Numbers and labels along each axis; None for what has no labels."""
    if isinstance(value, (np.ndarray, list, tuple, str, int, float, dict)) or value is None:
        return None
    if hasattr(value, "dims") and hasattr(value, "coords") and hasattr(value, "transpose"):
        return _of_dims(value, plates, ahead)
    index = getattr(value, "index", None)
    if index is None or callable(index) or not hasattr(value, "to_numpy"):
        return None
    array = array_of(value)
    own: list[list[Any] | None] = [list(index)]
    columns = getattr(value, "columns", None)
    own += [] if columns is None else [list(columns)]
    return array, own + [None] * (array.ndim - len(own))


def _of_dims(
    value: Any, plates: Sequence[str], ahead: int
) -> tuple[np.ndarray, list[list[Any] | None]]:
    """Of an array with named axes, those called like plates are put where they belong."""
    dims = list(value.dims)
    if plates and all(p in dims for p in plates):
        rest = [d for d in dims if d not in plates]
        dims = [*rest[:ahead], *plates, *rest[ahead:]]
        value = value.transpose(*dims)
    own = [np.asarray(value.coords[d]).tolist() if d in value.coords else None for d in dims]
    return np.asarray(value), own


def _names(side: Any, plate: str | None) -> bool:
    return plate is not None and getattr(side, "name", None) == plate


def _fits(side: Any, plate: str | None, labels: Labels) -> bool:
    """Whether labels are a plate's: all of them, of texts some (a wrong one is told later)."""
    own = list(side)
    if plate is None or plate not in labels or is_default(own):
        return False
    shared = set(labels[plate]) & set(own)
    return len(shared) == len(own) or any(isinstance(label, str) for label in shared)


def _order(what: str, plate: str, own: list[Any], wanted: tuple[Any, ...]) -> list[int] | None:
    """Places of a plate's labels among the data's own; None where those go by position."""
    if own == list(wanted):
        return None
    where = {label: k for k, label in enumerate(own)}
    if is_default(own):
        if set(own) != set(wanted):
            return None
        raise EvidenceError(
            f"{what}: its index 0..{len(own) - 1} may mean positions or the labels of plate {plate!r}, which "
            f"are in another order ({_some(list(wanted))}); give .to_numpy() for positions, or "
            ".loc[labels].to_numpy()"
        )
    if len(where) < len(own):
        twice = next(label for k, label in enumerate(own) if where[label] != k)
        raise EvidenceError(f"{what}: the label {twice!r} of plate {plate!r} stands twice")
    known = set(wanted)
    strange = [label for label in own if label not in known]
    if strange:
        hint = did_you_mean(strange[0], wanted) or f" (its labels are {_some(list(wanted))})"
        raise EvidenceError(
            f"{what}: plate {plate!r} has no element labelled {strange[0]!r}{hint}; what is labelled goes "
            "by label, .to_numpy() by position"
        )
    missing = [label for label in wanted if label not in where]
    if missing:
        raise EvidenceError(
            f"{what}: nothing is labelled {missing[0]!r} of plate {plate!r}"
            f"{f' and {len(missing) - 1} more' if len(missing) > 1 else ''}; unobserved elements are NaN "
            "(reindex(labels))"
        )
    return [where[label] for label in wanted]


def _differ(own: list[Any], before: list[Any], timed: bool) -> bool:
    """Whether labels differ; over time inputs may go on longer than observations."""
    shared = min(len(own), len(before)) if timed else None
    return own[:shared] != before[:shared]


def _remedy(plate: str) -> str:
    if plate == "time":
        return "row k belongs to slice k, so bring them to the same index (reindex), or give .to_numpy()"
    return f"declare plates={{{plate!r}: labels}} to have them lined up, or give .to_numpy()"


def _some(labels: list[Any]) -> str:
    shown = ", ".join(map(repr, labels[:4]))
    return shown + (", ..." if len(labels) > 4 else "")
