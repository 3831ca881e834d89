"""Expressions of like terms on the state of chains, as one program.

Members of a group stand in an axis between chains and plates. What depends on nothing that a chain moves
is computed once, as long as the known values are the same arrays.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import is_, itemgetter
from typing import Any

import numpy as np

from bayesmc.expression import Expression, Program
from bayesmc.shapes import Shape
from bayesmc.structure.target import Target, Values


class StateProgram:
    """Values of some expressions for several members at once.

    Parameters
    ----------
    target : Target
    roots : sequence of Expression
        Of the names that the first member reads, and of ``constants``.
    leaves : sequence of tuple of str
        For each member what it reads, in the order in which they correspond.
    constants : dict
        Leaf -> what it is for each member, shape ``(members, *shape)``; of one member none.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.expression import elementwise, leaf
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.programs import StateProgram
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet()
    >>> net.add("rate", bmc.LogNormal(0.0, 1.0))
    >>> for t in range(3):
    ...     net.add(f"y[{t}]", lambda rate: bmc.Poisson(rate), parents=["rate"])
    >>> target = target_of(pose(net, {f"y[{t}]": t for t in range(3)}))
    >>> root = elementwise(np.multiply, leaf("rate", ()), leaf("y[0]", (), int, None))
    >>> program = StateProgram(target, [root], [("rate", f"y[{t}]") for t in range(3)], {})
    >>> program({**target.known, "rate": np.array([1.0, 10.0])})[0].tolist()  # chains, members
    [[0.0, 1.0, 2.0], [0.0, 10.0, 20.0]]
    """

    def __init__(
        self,
        target: Target,
        roots: Sequence[Expression],
        leaves: Sequence[tuple[str, ...]],
        constants: Mapping[str, np.ndarray],
    ) -> None:
        self.target, self.count = target, len(leaves)
        read = frozenset().union(*(r.leaves for r in roots))
        self._constants = dict(constants)
        self._sources: dict[str, tuple[str, ...]] = {}
        for these in zip(*leaves, strict=True):
            if these[0] in read:
                self._sources[these[0]] = these[:1] if len(set(these)) == 1 else these
        self._shapes = {n: target.model[n].value_shape for n in self._sources}
        self._standing = {n for n, s in self._sources.items() if all(map(target.is_known, s))}
        #: names of known values, and the arrays that they were
        self.watched = tuple(dict.fromkeys(n for m in self._standing for n in self._sources[m]))
        self._taken = _taking(self.watched)
        self._arrays = self._taken(target.known)
        self._places = {k: self.is_known(r) for k, r in enumerate(roots)}
        self._whole = Program(roots)
        self._moving = Program([r for r in roots if not self.is_known(r)])
        self._still = Program([r for r in roots if self.is_known(r)])
        self._found: list[np.ndarray] | None = None
        self._gathered: Values | None = None

    def is_known(self, root: Expression) -> bool:
        """Whether an expression depends on nothing that a chain moves."""
        return root.leaves <= self._standing | self._constants.keys()

    def are_known(self, values: Mapping[str, np.ndarray]) -> bool:
        """Whether what is known still is what it was."""
        return all(map(is_, self._taken(values), self._arrays))

    def known(self) -> list[Any]:
        """Values of what is known, None for the rest."""
        if self._found is None:
            self._found = self._still(self._known_values())
        still = iter(self._found)
        return [next(still) if known else None for known in self._places.values()]

    def __call__(self, values: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        """Values of all expressions, shape ``(*lead, members, *shape)`` or what broadcasts to it.

        Of a single member there is no axis of members. A lead of chains is there where something that has
        one is read.
        """
        if not self.are_known(values):
            every = {n: self._stacked(n, values) for n in self._sources}
            return self._whole({**self._constants, **every})
        found = self.known()
        if not all(self._places.values()):
            hidden = {n: self._stacked(n, values) for n in self._sources if n not in self._standing}
            moving = iter(self._moving({**self._known_values(), **hidden}))
            found = [next(moving) if v is None else v for v in found]
        return found

    # ---- private -------------------------------------------------------------------------------

    def _known_values(self) -> Values:
        if self._gathered is None:
            known = self.target.known
            self._gathered = {n: self._stacked(n, known) for n in self._standing}
            self._gathered.update(self._constants)
        return self._gathered

    def _stacked(self, name: str, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Values of all members of what stands in one place."""
        names, shape = self._sources[name], self._shapes[name]
        first = values[names[0]]
        if self.count == 1:
            return first
        if len(names) == 1:
            return _with_members(first, shape)
        arrays = [values[n] for n in names]
        if first.ndim == len(shape):
            return np.stack(np.broadcast_arrays(*arrays))
        try:
            rows = np.concatenate(arrays).reshape(len(arrays), *first.shape)
        except ValueError:  # some have one row for all chains
            rows = np.stack(np.broadcast_arrays(*arrays))
        axis = rows.ndim - 1 - len(shape)
        return rows.swapaxes(0, 1) if axis == 1 else np.moveaxis(rows, 0, axis)


# ---- private ------------------------------------------------------------------------------------


def _with_members(value: np.ndarray, shape: Shape) -> np.ndarray:
    """One value for all members."""
    lead = value.shape[: value.ndim - len(shape)]
    return value.reshape(*lead, 1, *value.shape[len(lead) :]) if lead else value


def _taking(names: Sequence[str]) -> Any:
    """What takes the values of some names from a mapping: for thousands, as fast as can be."""
    if len(names) > 1:
        return itemgetter(*names)
    return lambda values: tuple(values[n] for n in names)
