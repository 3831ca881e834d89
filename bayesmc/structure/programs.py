"""Expressions of like terms on the state of chains, as one program.

The group stands in an axis between chains and plates. What depends on nothing that a chain moves is computed
once, as long as the known values are the same arrays.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import is_
from typing import Any

import numpy as np

from bayesmc.expression import Expression, Program
from bayesmc.structure.like_functions import Slots
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
        Leaf -> what it is for each member, shape ``(members, *shape)``.

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
    >>> values = {**target.known, "rate": np.array([1.0, 10.0])}
    >>> program(values, program.are_known(values))[0].tolist()  # chains, members
    [[0.0, 1.0, 2.0], [0.0, 10.0, 20.0]]
    """

    def __init__(
        self,
        target: Target,
        roots: Sequence[Expression],
        leaves: Sequence[tuple[str, ...]],
        constants: Mapping[str, np.ndarray],
    ) -> None:
        self.target = target
        read = frozenset().union(*(r.leaves for r in roots))
        places = {these[0]: these for these in zip(*leaves, strict=True) if these[0] in read}
        still = {n: these for n, these in places.items() if all(map(target.is_known, these))}
        hidden = {n: these for n, these in places.items() if n not in still}
        self._known_slots = Slots(target, still, len(leaves))
        self._hidden_slots = Slots(target, hidden, len(leaves))
        self._constants = dict(constants)
        self._given = still.keys() | self._constants.keys()
        #: names of known values, and the arrays that they were
        self.watched = tuple({n for these in still.values() for n in these})
        self._arrays = [target.known[n] for n in self.watched]
        self._is_known = [self.is_known(r) for r in roots]
        self._moving = Program([r for r in roots if not self.is_known(r)])
        self._still = Program([r for r in roots if self.is_known(r)])
        self._cache: tuple[Values, list[np.ndarray]] | None = None

    def is_known(self, root: Expression) -> bool:
        """Whether an expression depends on nothing that a chain moves."""
        return root.leaves <= self._given

    def are_known(self, values: Mapping[str, np.ndarray]) -> bool:
        """Whether what is known still is what it was."""
        return all(map(is_, map(values.__getitem__, self.watched), self._arrays))

    def known(self) -> list[Any]:
        """Values of what is known, None for the rest."""
        return self._merged(self._standing(self.target.known, True)[1], None)

    def __call__(self, values: Mapping[str, np.ndarray], still: bool) -> list[np.ndarray]:
        """Values of all expressions, shape ``(*lead, group, *shape)`` or what broadcasts to it.

        A lead of chains is there where something that has one is read.

        Parameters
        ----------
        values : mapping
        still : bool
            Whether what is known is what it was (``are_known``).
        """
        given, found = self._standing(values, still)
        if all(self._is_known):
            return found
        return self._merged(found, self._moving({**given, **self._hidden_slots.gathered(values)}))

    # ---- private -------------------------------------------------------------------------------

    def _standing(
        self, values: Mapping[str, np.ndarray], still: bool
    ) -> tuple[Values, list[np.ndarray]]:
        """What is known, stacked, and the values of what follows from it."""
        if still and self._cache is not None:
            return self._cache
        given = {**self._known_slots.gathered(values), **self._constants}
        found = given, self._still(given)
        if still:
            self._cache = found
        return found

    def _merged(self, still: Sequence[Any], moving: Sequence[Any] | None) -> list[Any]:
        """In the order of the expressions."""
        a, b = iter(still), iter(moving or [None] * len(self._is_known))
        return [next(a) if known else next(b) for known in self._is_known]
