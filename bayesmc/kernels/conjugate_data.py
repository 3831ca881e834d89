"""What was drawn from a child, as conjugate kernels need it: element by element, or summed by label.

Both answer the same questions (how many, their total, their squares about a mean), so that the table of
pairs is written once. Nothing here knows priors.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, cached_property
from typing import Protocol
from weakref import WeakKeyDictionary

import numpy as np

from bayesmc.gaussian import solve_lower
from bayesmc.structure.target import Target, Term, Values

#: what a pair may ask of the values before anything else
TRANSFORMS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "value": lambda z: np.asarray(z, dtype=float),
    "log": np.log,
    "reciprocal": np.reciprocal,
}
#: numbers of the one-hot matrix that stay in cache
_CHUNK = 1 << 14
#: states from which on sums are taken by scattered adding instead
_MANY = 16


class Sums(Protocol):
    """How elements of a child are summed for elements of a node (``conjugate_sums``)."""

    def sum(self, array: np.ndarray, event_ndim: int = 0) -> np.ndarray: ...

    def outer(self, rows: np.ndarray) -> np.ndarray: ...


class Elements:
    """Values of a child one by one, those that are not seen left out.

    Attributes
    ----------
    count : ndarray
        1 for every element that counts, else 0; broadcasts to ``(1, *plates)``.
    """

    def __init__(self, value: np.ndarray, mask: np.ndarray | None, event_ndim: int) -> None:
        self.event_ndim = event_ndim
        self.value = value
        self.count = np.ones((1,) * (value.ndim - event_ndim))
        self.mask = mask
        if mask is not None:
            self.count = mask.astype(float)[None]
            self.value = np.where(mask.reshape(mask.shape + (1,) * event_ndim), value, 0.0)

    @property
    def total(self) -> np.ndarray:
        """Sum of the values."""
        return self.value

    def deviations(self, loc: np.ndarray) -> np.ndarray:
        """Sum of the values less ``loc``, shape with the event."""
        return self._counted(self.value - loc)

    def squares(self, loc: np.ndarray) -> np.ndarray:
        """Sum of squares about ``loc``."""
        return self._counted((self.value - loc) ** 2)

    def mahalanobis(self, loc: np.ndarray, tril: np.ndarray) -> np.ndarray:
        """Sum of squared Mahalanobis distances from ``loc``."""
        z = solve_lower(tril, self.value - loc)
        return np.vecdot(z, z) * self.count

    def scatter(self, loc: np.ndarray, spread: np.ndarray, into: Sums) -> np.ndarray:
        """Scatter matrices about ``loc``, each over its ``spread``, summed for every element of a node."""
        return into.outer((self.deviations(loc) / np.sqrt(spread)[..., None])[..., None, :])

    def _counted(self, array: np.ndarray) -> np.ndarray:
        if self.mask is None:
            return array
        return array * self.count.reshape(self.count.shape + (1,) * self.event_ndim)


class Grouped:
    """Values of a child summed by its label: the last plate axis runs through the labels.

    Parameters
    ----------
    sums : ndarray, shape (chains, *ones, labels, rows)
        How many, their sum from a centre, and products about it if anybody needs these.
    centre : ndarray
    event_ndim : int
    """

    def __init__(self, sums: np.ndarray, centre: np.ndarray, event_ndim: int) -> None:
        self.sums, self._centre, self.event_ndim = sums, centre, event_ndim

    @cached_property
    def count(self) -> np.ndarray:
        """How many, shape (chains, *ones, labels)."""
        return self.sums[..., 0]

    @cached_property
    def rows(self) -> list[list[float]]:
        """The sums of all chains' labels, one after the other."""
        return self.sums.reshape(-1, self.sums.shape[-1]).tolist()

    @cached_property
    def _wide(self) -> np.ndarray:
        return self.count[..., None] if self.event_ndim else self.count

    @cached_property
    def _first(self) -> np.ndarray:
        if not self.event_ndim:
            return self.sums[..., 1]
        return self.sums[..., 1 : 1 + self._centre.shape[0]]

    @cached_property
    def _second(self) -> np.ndarray:
        if not self.event_ndim:
            return self.sums[..., 2]
        return self.sums.take(_unpacking(self._centre.shape[0]), axis=-1)

    @property
    def total(self) -> np.ndarray:
        return self._first + self._wide * self._centre

    def deviations(self, loc: np.ndarray) -> np.ndarray:
        return self._first - self._wide * (loc - self._centre)

    def squares(self, loc: np.ndarray) -> np.ndarray:
        off = loc - self._centre
        squares = self._second - off * (2.0 * self._first - self.count * off)
        return np.maximum(squares, 0.0)  # an empty label must not have a negative sum by rounding

    def mahalanobis(self, loc: np.ndarray, tril: np.ndarray) -> np.ndarray:
        sums = self._scatter(loc)
        # rows of one solve are columns of the other's argument: trace(L^-1 S L^-T)
        half = solve_lower(tril[..., None, :, :], np.matrix_transpose(sums))
        whole = solve_lower(tril[..., None, :, :], np.matrix_transpose(half))
        return np.maximum(np.linalg.trace(whole), 0.0)

    def scatter(self, loc: np.ndarray, spread: np.ndarray, into: Sums) -> np.ndarray:
        return into.sum(self._scatter(loc) / spread[..., None, None], 2)

    def _scatter(self, loc: np.ndarray) -> np.ndarray:
        off = loc - self._centre
        cross = off[..., :, None] * (
            self._first[..., None, :] - 0.5 * self.count[..., None, None] * off[..., None, :]
        )
        return self._second - cross - np.matrix_transpose(cross)


class Groups:
    """Sums of a term's known values by the label of each, kept while the labels stay the same.

    All kernels that read the same term by the same label share one, so that a sweep goes once through
    the data.
    """

    def __init__(self, value: np.ndarray, term: Term, label: str, states: int, how: str) -> None:
        self.label, self.states, self.plates = label, states, len(term.shape)
        self.event_ndim = value.ndim - len(term.shape)
        self.used = False  # whether some kernel sums by it
        self.second = False  # whether one needs squares
        flat = value.reshape((-1, *value.shape[len(term.shape) :]))
        self.seen = None if term.mask is None else np.flatnonzero(term.mask)
        if self.seen is not None:
            flat = flat[self.seen]
        flat = TRANSFORMS[how](flat)
        # about their mean, so that squares about a cluster's mean do not cancel; counts stay whole
        is_count = term.model[term.name].is_discrete
        self.centre = np.zeros(flat.shape[1:]) if is_count else flat.mean(axis=0)
        self.values = flat - self.centre
        self._features: np.ndarray | None = None
        self._kept: tuple[np.ndarray | None, bool, Grouped | None] = (None, False, None)
        self._ones = (1,) * (self.plates - 1)

    def at(self, values: Values) -> Grouped:
        """The sums for the labels of a state."""
        label = values[self.label]
        known, second, grouped = self._kept
        if label is known and second == self.second:
            assert grouped is not None
            return grouped
        grouped = self._summed(label)
        self._kept = (label, self.second, grouped)
        return grouped

    def feed(self, label: np.ndarray, sums: np.ndarray) -> None:
        """Take in the sums for a state's labels from whoever drew them, ``(chains, states, rows)``."""
        self._kept = (label, self.second, self._grouped(sums))

    @property
    def rows(self) -> int:
        """Number of features: 1, the values, and their products where somebody needs squares."""
        wanted = 1 if not self.event_ndim else self.values.shape[-1]
        return 1 + wanted + (wanted * (wanted + 1) // 2 if self.second else 0)

    def made(self) -> np.ndarray:
        """1, the values, and their products where needed: shape (rows, elements)."""
        if self._features is None or len(self._features) != self.rows:
            wanted = 1 if not self.event_ndim else self.values.shape[-1]
            v = self.values.reshape(len(self.values), wanted).T
            rows = [np.ones((1, v.shape[1])), v]
            if self.second:
                i, j = np.tril_indices(wanted)
                rows.append(v[i] * v[j])
            self._features = np.concatenate(rows)
        return self._features

    # ---- private -------------------------------------------------------------------------------

    def _summed(self, label: np.ndarray) -> Grouped:
        flat = label.reshape((*label.shape[: label.ndim - self.plates], -1))
        flat = flat.reshape(-1, flat.shape[-1])
        if self.seen is not None:
            flat = flat[:, self.seen]
        return self._grouped(sums_by_label(flat, self.made(), self.states))

    def _grouped(self, sums: np.ndarray) -> Grouped:
        """Sums ``(chains, states, rows)`` with one axis for every plate, the labels on the last."""
        if self._ones:
            sums = sums.reshape((len(sums), *self._ones, *sums.shape[1:]))
        return Grouped(sums, self.centre, self.event_ndim)


@cache
def _unpacking(d: int) -> np.ndarray:
    """Where the products stand in a row of sums, as a symmetric matrix."""
    i, j = np.tril_indices(d)
    place = np.empty((d, d), dtype=np.intp)
    place[i, j] = place[j, i] = 1 + d + np.arange(len(i))
    return place


def sums_by_label(label: np.ndarray, features: np.ndarray, states: int) -> np.ndarray:
    """Sums of ``features`` ``(f, n)`` over the elements of every label ``(chains, n)``.

    Returns
    -------
    ndarray, shape (chains, states, f)

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.kernels.conjugate_data import sums_by_label
    >>> sums_by_label(np.array([[0, 1, 0]]), np.array([[1.0, 10.0, 100.0]]), 2).tolist()
    [[[101.0], [10.0]]]
    """
    chains, n = label.shape
    found = np.zeros((chains, states, len(features)))
    if states > _MANY:
        index = label.astype(np.intp) + (np.arange(chains) * states)[:, None]
        for k, row in enumerate(features):
            weights = np.broadcast_to(row, index.shape).ravel()
            summed = np.bincount(index.ravel(), weights=weights, minlength=chains * states)
            found[:, :, k] = summed.reshape(chains, states)
        return found
    every = np.arange(states, dtype=label.dtype)[:, None]
    width = max(_CHUNK // (chains * states), 256)
    for start in range(0, n, width):
        part = slice(start, start + width)
        one_hot = (label[:, None, part] == every).astype(float)
        found += one_hot @ features[:, part].T
    return found


def groups_of(target: Target, term: Term, label: str, how: str) -> Groups:
    """The sums that all kernels of a target share."""
    kept = _GROUPS.setdefault(target, {})
    key = (term.name, label, how)
    if key not in kept:
        model = target.model
        domain = model[label].domain
        assert domain is not None
        value = target.known[term.name]
        own = model[term.name].domain
        if own is not None:
            value = own.to_support(value)
        kept[key] = Groups(value, term, label, domain.size, how)
    return kept[key]


def counted(target: Target, term: Term) -> Groups | None:
    """Sums whose label is this very node, if somebody takes any over all its elements."""
    for (_, label, _), groups in _GROUPS.get(target, {}).items():
        if label == term.name and groups.used and groups.seen is None:
            return groups
    return None


#: a cache beside the target, which is frozen; it goes when the target goes
_GROUPS: WeakKeyDictionary[Target, dict[tuple[str, str, str], Groups]] = WeakKeyDictionary()
