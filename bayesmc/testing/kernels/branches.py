"""One step of a kernel followed through all the ways that its draws can send it.

A small target has few joint states, and a step is a function of a state and some draws. Each draw is cut,
one after the other, into cells of values that act alike; the cells' lengths are probabilities. This room
finds the branches of that tree; what they add up to stands in ``transition``.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import numpy as np

from bayesmc.errors import BudgetError, UnsupportedError, ZeroProbabilityError
from bayesmc.kernels.base import Kernel, Memory
from bayesmc.shapes import owned
from bayesmc.structure.target import Target, Values
from bayesmc.testing.kernels.scripted import ScriptedGenerator

#: draws of fewer values are tried with all of them
FEW = 64
#: joint states, draws of one step, and branches of the tree of draws, at most
_STATES, _DRAWS, _BRANCHES = 1024, 24, 1 << 18
#: rows of one call of a kernel; even, so that raw words never straddle two draws
_ROWS = 4096
#: parts into which a draw's values are cut before bisection
_PROBES = 12
#: settings of later draws under which two values of a draw are told apart
_CORNERS, _INNER, _SETTINGS = 7, 4, 512
#: times that the tree is grown anew from what was found, at most
_ROUNDS = 8
#: cells whose predicted outcome is checked at random places
_CHECKED = 8192


class StateSpace:
    """Joint states of the chain's hidden elements, as numbers and as stored values."""

    def __init__(self, target: Target) -> None:
        self.target = target
        self.parts: list[tuple[str, np.ndarray, int]] = []
        elements: list[str] = []
        cards: list[int] = []
        for name in target.chain:
            node = target.model[name]
            if node.domain is None:
                raise UnsupportedError(
                    f"exact_sweep: node {name!r} is hidden and has infinitely many values; observe it, or "
                    "give it finitely many"
                )
            size = math.prod(node.plate_shape)
            free = target.free_elements(name)
            free = np.arange(size) if free is None else free
            self.parts.append((name, free, node.domain.size))
            cards += [node.domain.size] * len(free)
            places = (np.unravel_index(i, node.plate_shape) for i in free)
            elements += [_element(name, place) for place in places]
        self.elements, self.cards = tuple(elements), tuple(cards)
        if not cards:
            raise UnsupportedError(
                "exact_sweep: no hidden node has anything observed below it, so the engine moves nothing; "
                "give evidence"
            )
        if math.prod(cards) > _STATES:
            raise BudgetError(
                f"exact_sweep: {math.prod(cards)} joint states; at most {_STATES} are enumerated"
            )

    def find_states(self) -> None:
        """The states of positive density, and their law."""
        codes = np.indices(self.cards).reshape(len(self.cards), -1).T
        log = self.target.log_density(self._values(codes))
        log = np.broadcast_to(np.asarray(log, dtype=float), len(codes))
        possible = log > -np.inf
        if not possible.any():
            raise ZeroProbabilityError("exact_sweep: the evidence has probability zero")
        self.codes = codes[possible]
        weights = np.exp(log[possible] - log[possible].max())
        self.law = weights / weights.sum()
        self.number = np.full(len(codes), -1)
        self.number[possible] = np.arange(len(self.codes))

    def values(self, states: np.ndarray) -> Values:
        """Stored values of all nodes, a row for each state number."""
        return self._values(self.codes[states])

    def states(self, values: Values) -> np.ndarray:
        """State numbers; -1 for states of probability zero."""
        columns = []
        for name, free, _ in self.parts:
            value = values[name]
            columns.append(value.reshape(len(value), -1)[:, free])
        codes = np.concatenate(columns, axis=1).T
        return self.number[np.ravel_multi_index(tuple(codes), self.cards)]

    def labels(self) -> tuple[tuple[Hashable, ...], ...]:
        """The states as users name them."""
        columns, at = [], 0
        for name, free, _ in self.parts:
            domain = self.target.model[name].domain
            assert domain is not None
            for _ in free:
                columns.append([domain.states[k] for k in self.codes[:, at]])
                at += 1
        return tuple(zip(*columns, strict=True))

    def _values(self, codes: np.ndarray) -> Values:
        target, at = self.target, 0
        values: Values = dict(target.known)
        for name, free, _ in self.parts:
            node, seen = target.model[name], target.seen(name)
            assert node.domain is not None
            flat = np.zeros((len(codes), math.prod(node.plate_shape)), dtype=node.domain.dtype)
            if seen is not None:
                flat[:] = seen.value.reshape(-1)
            flat[:, free] = codes[:, at : at + len(free)]
            at += len(free)
            values[name] = owned(flat.reshape(len(codes), *node.plate_shape))
        target.refresh(values, target.chain)
        return values


class Stepper:
    """One step of a kernel as a function: state and draws in, state out.

    Attributes
    ----------
    ranges : tuple of int
        How many values each draw of a step has, all equally likely.
    """

    def __init__(self, space: StateSpace, kernel: Kernel) -> None:
        self.space, self.kernel = space, kernel
        self._memories: dict[int, Memory] = {}
        self.ranges: tuple[int, ...] = ()
        first = ScriptedGenerator(np.zeros((2, 0), dtype=np.int64), self.what)
        self._run(np.zeros(2, dtype=np.intp), first)
        self.ranges = tuple(first.ranges)
        if len(self.ranges) > _DRAWS:
            raise BudgetError(
                f"exact_sweep: {self.what} makes {len(self.ranges)} draws in a step; at most {_DRAWS} are "
                "followed: fewer nodes, or smaller plates"
            )

    @property
    def what(self) -> str:
        """The kernel in words."""
        return f"the kernel of {', '.join(map(repr, self.kernel.names))} ({self.kernel.label})"

    def __call__(self, states: np.ndarray, draws: np.ndarray) -> np.ndarray:
        """The states that follow, shape (rows,); draws have shape (rows, len(ranges))."""
        found = []
        for begin in range(0, len(states), _ROWS):
            part = slice(begin, begin + _ROWS)
            found.append(self._padded(states[part], draws[part]))
        return np.concatenate(found)

    def _padded(self, states: np.ndarray, draws: np.ndarray) -> np.ndarray:
        """One call, with rows enough that sizes, and so memories, are few."""
        count = len(states)
        rows = min(1 << max(6, (count - 1).bit_length()), _ROWS)
        at = np.arange(rows) % count
        script = ScriptedGenerator(draws[at], self.what)
        after = self._run(states[at], script)
        if tuple(script.ranges) != self.ranges:
            raise UnsupportedError(
                f"exact_sweep: {self.what} draws differently from step to step; what it draws must not "
                "depend on what it drew"
            )
        lost = np.flatnonzero(after[:count] < 0)
        if len(lost):
            labels = self.space.labels()[states[lost[0]]]
            state = dict(zip(self.space.elements, labels, strict=True))
            raise ZeroProbabilityError(
                f"exact_sweep: from {state} {self.what} goes to a state of probability zero; it does not "
                "keep the posterior"
            )
        return after[:count]

    def _run(self, states: np.ndarray, script: ScriptedGenerator) -> np.ndarray:
        values = self.space.values(states)
        rows = len(states)
        if rows not in self._memories:
            memory = self.kernel.start(values, rows)
            self._memories[rows] = self.kernel.end_warmup(memory)
        new, _ = self.kernel.step(values, self._memories[rows], script, False)  # type: ignore[arg-type]
        return self.space.states({**values, **new})


class Branches:
    """All ways a step can go: the draws one after the other, each cut into cells that act alike.

    Attributes
    ----------
    start : ndarray, shape (branches,)
        State that a branch comes from.
    low, high : ndarray, shape (branches, draws)
        Values of the draws, ``low <= k < high``.
    weight : ndarray, shape (branches,)
        Probability given the start.
    outcome : ndarray, shape (branches,)
        State that it leads to.
    """

    def __init__(self, stepper: Stepper, states: int) -> None:
        self.stepper, self.states = stepper, states
        # Two values of a draw may differ only in where later draws are cut (as two proposals of the same
        # state do), so that those cuts are where to look; hence again, until nothing is found any more.
        self._grow()
        for _ in range(_ROUNDS):
            before = self.low
            self._grow()
            if np.array_equal(self.low, before):
                return
        raise UnsupportedError(self._unread())

    def check(self) -> None:
        """Random places of random cells must lead where the cell does."""
        rng = np.random.default_rng(0)
        branch = np.concatenate([
            rng.permutation(len(self.start))[:_CHECKED],
            rng.choice(len(self.start), size=_CHECKED, p=self.weight / self.weight.sum()),
        ])  # fmt: skip
        draws = rng.integers(self.low[branch], self.high[branch])
        found = self.stepper(self.start[branch], draws)
        if (found != self.outcome[branch]).any():
            raise UnsupportedError(self._unread())

    def _grow(self) -> None:
        """Cut one draw after the other."""
        ranges, states = self.stepper.ranges, self.states
        known = hasattr(self, "outcome")
        settings = [self._settings(depth, known) for depth in range(len(ranges))]
        probes = [self._probes(depth, known) for depth in range(len(ranges))]
        self.start, self.weight = np.arange(states), np.ones(states)
        self.low = self.high = np.zeros((states, 0), dtype=np.int64)
        for depth, count in enumerate(ranges):

            def signature(
                branch: np.ndarray, value: np.ndarray, later: np.ndarray = settings[depth]
            ) -> np.ndarray:
                """Outcomes under all settings of later draws, shape (len(branch), settings)."""
                start, each = self.start[branch], later.shape[1]
                before = np.column_stack([self._middle()[branch], value])
                after = later[start].reshape(len(start) * each, -1)
                draws = np.concatenate([np.repeat(before, each, axis=0), after], axis=1)
                found = self.stepper(np.repeat(start, each), draws)
                return found.reshape(len(start), each)

            tried = probes[depth][self.start]
            branch, begin, end = _cells(signature, tried, count, self.stepper.what)
            self.start = self.start[branch]
            self.low = np.column_stack([self.low[branch], begin])
            self.high = np.column_stack([self.high[branch], end])
            self.weight = self.weight[branch] * ((end - begin) / count)
        self.outcome = self.stepper(self.start, self._middle())

    def _unread(self) -> str:
        return (
            f"exact_sweep: {self.stepper.what} cannot be read: what a chain does is no step function of its "
            "own draws, one after the other; choose another kernel"
        )

    def _middle(self) -> np.ndarray:
        """A value of each cell; all act alike."""
        return self.low + (self.high - self.low) // 2

    def _probes(self, depth: int, known: bool) -> np.ndarray:
        """Values of a draw that are tried at first, for each start, shape (states, probes), in order."""
        count = self.stepper.ranges[depth]
        even = np.array([i * (count - 1) // _PROBES for i in range(_PROBES + 1)])
        if count <= FEW:
            even = np.arange(count)
        found = []
        for state in range(self.states):
            cuts = self.low[self.start == state, depth] if known else even[:1]
            found.append(np.unique(np.concatenate([even, cuts, np.maximum(cuts, 1) - 1])))
        most = max(map(len, found))
        return np.stack([np.append(row, np.full(most - len(row), row[-1])) for row in found])

    def _settings(self, depth: int, known: bool) -> np.ndarray:
        """Settings of the draws after one, for each start, shape (states, settings, later draws).

        Corners of their box and points inside, and the corners of all cells known so far.
        """
        ranges = self.stepper.ranges[depth + 1 :]
        rng = np.random.default_rng(depth)
        top = np.array(ranges, dtype=np.int64) - 1
        if len(ranges) <= _CORNERS:
            corners = np.array(list(itertools.product((0, 1), repeat=len(ranges))))
        else:
            corners = rng.integers(2, size=(1 << _CORNERS, len(ranges)))
        inside = (rng.random((_INNER, len(ranges))) * top).astype(np.int64)
        common = np.concatenate([corners * top, inside])
        found = []
        for state in range(self.states):
            rows = [common]
            if known:
                mine = self.start == state
                rows += [self.low[mine, depth + 1 :], self.high[mine, depth + 1 :] - 1]
            distinct = np.unique(np.concatenate(rows), axis=0)
            found.append(rng.permutation(distinct)[:_SETTINGS])
        most = max(map(len, found))
        return np.stack([rows[np.arange(most) % len(rows)] for rows in found])


# ---- private ------------------------------------------------------------------------------------


def _cells(
    signature: Callable[[np.ndarray, np.ndarray], np.ndarray],
    probes: np.ndarray,
    count: int,
    what: str,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The cells ``begin <= k < end`` of one draw of ``count`` values, for every branch.

    Parameters
    ----------
    signature : callable
        Branches and values of the draw -> what follows, a row for each.
    probes : ndarray, shape (branches, probes)
        In order, the first value and the last among them.
    """
    branches, each = probes.shape
    found = signature(np.repeat(np.arange(branches), each), probes.ravel())
    found = found.reshape(branches, each, -1)
    branch, at = np.nonzero((found[:, 1:] != found[:, :-1]).any(axis=-1))
    low, high = probes[branch, at], probes[branch, at + 1]
    below, above = found[branch, at], found[branch, at + 1]
    edges = [(np.arange(branches), np.zeros(branches, dtype=np.int64))]
    while True:
        closed = high - low == 1
        edges.append((branch[closed], high[closed]))
        branch, low, high = branch[~closed], low[~closed], high[~closed]
        below, above = below[~closed], above[~closed]
        if not len(branch):
            break
        if len(branch) > 64 * branches or len(branch) > _BRANCHES:
            raise UnsupportedError(
                f"exact_sweep: {what} cannot be read: a draw has more than 64 outcomes, or none that "
                "depend on it alone"
            )
        middle = low + (high - low) // 2
        now = signature(branch, middle)
        left, right = (now != below).any(axis=1), (now != above).any(axis=1)
        branch = np.concatenate([branch[left], branch[right]])
        low, high = (
            np.concatenate([low[left], middle[right]]),
            np.concatenate([middle[left], high[right]]),
        )
        below = np.concatenate([below[left], now[right]])
        above = np.concatenate([now[left], above[right]])
    owner, begin = (np.concatenate(column) for column in zip(*edges, strict=True))
    if len(owner) > _BRANCHES:
        raise BudgetError(
            f"exact_sweep: {what} can go more than {_BRANCHES} ways; use a smaller net"
        )
    order = np.lexsort((begin, owner))
    owner, begin = owner[order], begin[order]
    last = np.append(owner[1:] != owner[:-1], True)
    return owner, begin, np.where(last, count, np.append(begin[1:], 0))


def _element(name: str, place: Sequence[Any]) -> str:
    return f"{name}[{', '.join(str(int(i)) for i in place)}]" if len(place) else name
