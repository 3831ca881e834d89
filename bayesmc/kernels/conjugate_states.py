"""All joint states of the finite nodes that children read, at which it is tried what they pick.

An element of a child varies with few of a plate's elements: where it reads one of them, all of the plate
take the same state, and each of its states is tried for all elements at once. So are those of many children,
as long as they do not want a node in different states.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from bayesmc.structure.relation import relation_of
from bayesmc.structure.target import Target, Term, Values

#: joint states that are tried, at most, and how many of them at once
_MOST, _AT_ONCE = 1 << 14, 256


@dataclass(frozen=True, eq=False)
class _Place:
    """Which digits of the number of a joint state are the states of a node's elements."""

    size: int
    #: what the number is divided by for each digit
    strides: tuple[int, ...]
    #: element -> its digit
    digit: np.ndarray

    def same(self, other: _Place) -> bool:
        return self.strides == other.strides and np.array_equal(self.digit, other.digit)

    def at(self, numbers: np.ndarray) -> np.ndarray:
        strides = np.array(self.strides, dtype=np.int64)
        digits = numbers[:, None] // strides % self.size
        return digits[:, self.digit]


def joint_states(target: Target, states: Values, terms: Sequence[Term]) -> Iterator[Values] | None:
    """Values of all nodes that show every term each joint state of the hidden finite nodes it varies with.

    Parameters
    ----------
    states : dict
        Values of all nodes, shape ``(states, *plates, *event)``, of which the numbers are taken.
    terms : sequence of Term

    Returns
    -------
    iterator of dict, or None
        Batches of at most 256 states; None where more than 16384 of them would be needed.

    Raises
    ------
    BayesmcError
        In the iteration, where the model has no value at some state.
    """
    groups: list[dict[str, _Place]] = []
    counts: list[int] = []
    for term in terms:
        places, count = _places(target, term)
        if count > _MOST:
            return None
        for k, group in enumerate(groups):
            if all(n not in group or group[n].same(place) for n, place in places.items()):
                group.update(places)
                counts[k] = max(counts[k], count)
                break
        else:
            groups.append(places)
            counts.append(count)
        if sum(counts) > _MOST:
            return None
    return _batches(target, states, groups, counts)


# ---- private ------------------------------------------------------------------------------------


def _places(target: Target, term: Term) -> tuple[dict[str, _Place], int]:
    """Digits of the finite nodes that a term varies with, and the number of joint states."""
    places, count = {}, 1
    for name in target.hidden_above(term):
        node = target.model[name]
        if node.domain is None:
            continue
        digit = _digits(target, name, term)
        digits = int(digit.max(initial=-1)) + 1
        strides = tuple(count * node.domain.size**k for k in range(min(digits, 64)))
        places[name] = _Place(node.domain.size, strides, digit)
        count *= node.domain.size**digits
        if count > _MOST:
            break
    return places, count


def _digits(target: Target, name: str, term: Term) -> np.ndarray:
    """For each number of a finite node the digit that it has; hidden ones that meet have their own."""
    node = target.model[name]
    relation = relation_of(target, name, term)
    coupled: tuple[str, ...] = ()
    if relation.kind == "whole":
        coupled = relation.coupled
    elif relation.kind == "rows" and len(relation.rows) > 1:
        coupled = node.plates
    axes = [
        size if p in coupled else 1 for p, size in zip(node.plates, node.plate_shape, strict=True)
    ]
    shape = (*axes, *node.event_shape)
    own = np.broadcast_to(np.arange(math.prod(shape)).reshape(shape), node.value_shape)
    seen = target.seen(name)
    if seen is None or seen.mask is None:
        return own
    hidden = ~np.broadcast_to(seen.mask, own.shape)
    found = np.zeros(own.shape, dtype=np.intp)  # what is seen is put there afterwards
    found[hidden] = np.unique(own[hidden], return_inverse=True)[1]
    return found


def _batches(
    target: Target, states: Values, groups: Sequence[dict[str, _Place]], counts: Sequence[int]
) -> Iterator[Values]:
    for places, count in zip(groups, counts, strict=True):
        for start in range(0, count, _AT_ONCE):
            numbers = np.arange(start, min(start + _AT_ONCE, count))
            yield _values(target, states, places, numbers)


def _values(
    target: Target, states: Values, places: dict[str, _Place], numbers: np.ndarray
) -> Values:
    values = dict(target.known)
    for name in target.chain:
        node, now = target.model[name], states[name]
        values[name] = np.resize(now, (len(numbers), *now.shape[1:]))
        if name in places and node.domain is not None:
            found = places[name].at(numbers)
            seen = target.seen(name)
            if seen is not None and seen.mask is not None:
                found = np.where(seen.mask, seen.value, found)
            values[name] = found.astype(node.domain.dtype)
    for link in target.links:
        values[link], _ = target.model.evaluate(link, values)
    return values
