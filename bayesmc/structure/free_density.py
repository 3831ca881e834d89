"""A log density as a function of free numbers, with its gradient: two programs, and the maps to and fro."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from bayesmc.errors import UnsupportedError
from bayesmc.expression import Expression, Program
from bayesmc.passes.arithmetic import ZERO
from bayesmc.passes.arrays import for_arrays
from bayesmc.structure.free_nodes import FreeNode
from bayesmc.structure.summing import Summed
from bayesmc.structure.target import Target, Values

#: the leaf of all free numbers
FREE = "\0free numbers"


@dataclass(frozen=True, eq=False)
class UnconstrainedDensity:
    """A log density of unconstrained numbers.

    Made by ``unconstrained_density``. Arrays of free numbers have any leading axes, and so have the values of
    other hidden nodes, which broadcast with them.

    Attributes
    ----------
    names : tuple of str
        Continuous nodes that move, parents first.
    root : Expression
        The log density, of the leaf ``FREE`` and the stored values of hidden nodes that do not move.
    slopes : Expression, shape (size,)
        Its derivatives by the free numbers.
    summed : tuple of str
        Finite nodes that are summed out.
    volume : Expression
        The logarithm of the change of volume, which is part of ``root``.
    tables : tuple of Summed
        What they are summed out of, in terms of the same leaves.
    """

    target: Target = field(repr=False)
    nodes: tuple[FreeNode, ...] = field(repr=False)
    root: Expression = field(repr=False)
    slopes: Expression = field(repr=False)
    summed: tuple[str, ...] = ()
    volume: Expression = field(default=ZERO, repr=False)
    tables: tuple[Summed, ...] = field(default=(), repr=False)

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(node.name for node in self.nodes)

    @cached_property
    def size(self) -> int:
        """How many free numbers there are."""
        return sum(node.size for node in self.nodes)

    @cached_property
    def others(self) -> tuple[str, ...]:
        """Hidden nodes that do not move and that it depends on."""
        return tuple(sorted(self.root.leaves - {FREE}))

    @cached_property
    def labels(self) -> list[str]:
        """A name for every free number: ``sd[2]``."""
        return [label for node in self.nodes for label in node.labels]

    @cached_property
    def angles(self) -> np.ndarray:
        """Which free numbers are angles, shape (size,)."""
        return np.concatenate([np.zeros(0, bool), *(node.angles for node in self.nodes)])

    def value(self, u: np.ndarray, values: Mapping[str, np.ndarray] | None = None) -> np.ndarray:
        """The log density, shape the batch; minus infinity where it is zero or no number.

        Parameters
        ----------
        u : ndarray, shape (*batch, size)
        values : mapping, optional
            Stored values of hidden nodes that do not move; what else it holds is not read.
        """
        (found,) = self._value(self._given(u, values))
        found = np.where(np.isfinite(found), found, -np.inf)
        return found if found.shape else found[()]

    def with_gradient(
        self, u: np.ndarray, values: Mapping[str, np.ndarray] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """The log density and its gradient, shape ``(*batch, size)``.

        The gradient is 0 where the log density is minus infinity, and so is a derivative that is no number:
        steps that follow it stay reversible.
        """
        value, slopes = self._both(self._given(u, values))
        if slopes.shape[:-1] != value.shape:
            slopes = np.broadcast_to(slopes, (*value.shape, self.size)).copy()
        finite = np.isfinite(value)
        if not finite.all():
            value = np.where(finite, value, -np.inf)
            slopes = np.where(finite[..., None], slopes, 0.0)
        if not np.isfinite(slopes).all():
            slopes = np.where(np.isfinite(slopes), slopes, 0.0)
        return value, slopes

    def is_told(self, u: np.ndarray, values: Mapping[str, np.ndarray] | None = None) -> np.ndarray:
        """Which derivatives are numbers at one point of positive density, shape ``(size,)``."""
        _, slopes = self._both(self._given(u, values))
        return np.broadcast_to(np.isfinite(slopes), (self.size,))

    def constrain(self, u: np.ndarray, values: Mapping[str, np.ndarray] | None = None) -> Values:
        """Node -> stored value, shape ``(*batch, *plates, *event)``, inside its support."""
        above = self._above(values)
        for node in self.nodes:
            above[node.name] = node.constrained(u[..., node.start : node.start + node.size], above)
        return {name: above[name] for name in self.names}

    def unconstrain(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """The free numbers behind stored values of all nodes that move, shape ``(*batch, size)``."""
        above = self._above(values)
        parts = [node.freed(np.asarray(values[node.name], float), above) for node in self.nodes]
        if not parts:
            return np.zeros(0)
        batch = np.broadcast_shapes(*(p.shape[:-1] for p in parts))
        return np.concatenate([np.broadcast_to(p, (*batch, p.shape[-1])) for p in parts], axis=-1)

    def log_volume(
        self, u: np.ndarray, values: Mapping[str, np.ndarray] | None = None
    ) -> np.ndarray:
        """The logarithm of the change of volume, shape the batch."""
        above: Mapping[str, np.ndarray] = {
            **self._above(values),
            **self.constrain(u, values),
        }
        parts = [n.log_volume(u[..., n.start : n.start + n.size], above) for n in self.nodes]
        return np.asarray(sum(parts, np.zeros(u.shape[:-1])))

    # ---- private -------------------------------------------------------------------------------

    @cached_property
    def _value(self) -> Program:
        return Program(for_arrays([self.root]))

    @cached_property
    def _both(self) -> Program:
        return Program(for_arrays([self.root, self.slopes]))

    def _given(self, u: np.ndarray, values: Mapping[str, np.ndarray] | None) -> Values:
        found: Values = {FREE: u}
        for name in self.others:
            if values is None or name not in values:
                raise UnsupportedError(f"the log density needs a value of node {name!r}")
            found[name] = values[name]
        return found

    def _above(self, values: Mapping[str, np.ndarray] | None) -> Values:
        return {**self.target.known, **(values or {})}
