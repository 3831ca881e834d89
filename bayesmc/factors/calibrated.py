"""What a calibrated clique tree answers: marginals, beliefs, joint tables and exact draws.

It reads the tables that both passes left and runs no pass of its own.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from ..categorical import pick_rows
from ..errors import BudgetError, ZeroProbabilityError
from .named import Named, aligned, contract, largest, without_ones
from .propagation import Collected, Semiring
from .structure import Program, TreeStructure

JOINT_BYTES = 1e9
"""Default limit on the tables of a joint query."""


@dataclass(frozen=True)
class Context:
    """The tree, shapes and arithmetic that an answer was made with, and the observed states."""

    tree: TreeStructure
    program: Program
    semiring: Semiring
    states: Mapping[int, int]


class Calibrated:
    """The exact distribution of all variables given evidence.

    Attributes
    ----------
    log_z : float
        Natural log of the total of the product at the evidence: log P(evidence) where the factors
        are a net's conditional probabilities. ``-inf`` where the evidence is impossible; then
        marginals are NaN, and draws and joint tables raise `ZeroProbabilityError`.
    """

    def __init__(
        self,
        context: Context,
        log_z: float,
        collected: Sequence[Collected] | None,
        ratios: Sequence[np.ndarray],
        flat: np.ndarray,
    ) -> None:
        self.log_z = log_z
        self._context = context
        self._collected = collected
        self._ratios = ratios
        self._flat = flat
        flat.flags.writeable = False

    def marginal(self, variable: Hashable) -> np.ndarray:
        """The probabilities of the variable's states, shape ``(cardinality,)``, read-only."""
        return self._marginal(self._context.tree.index[variable])

    def marginals(self) -> list[np.ndarray]:
        """The marginals of all variables, in the order of ``tree.variables``."""
        return [self._marginal(v) for v in range(len(self._context.tree.variables))]

    def belief(self, clique: int) -> Named:
        """The normalised joint table of a clique's variables; sliced ones keep one state."""
        found, names = self._belief(clique), self._context.tree.variables
        return Named(tuple(names[cast(int, v)] for v in found.scope), found.values)

    def joint(self, variables: Sequence[Hashable], max_bytes: float = JOINT_BYTES) -> np.ndarray:
        """The joint probabilities of any variables.

        Parameters
        ----------
        variables : sequence of hashable
            Distinct; the axes of the result follow them.
        max_bytes : float
            Limit on the result and on any table needed on the way.

        Raises
        ------
        BudgetError
            Before anything is allocated, if a table would exceed ``max_bytes``.
        ZeroProbabilityError
            If the evidence is impossible.
        """
        tree, states = self._context.tree, self._context.states
        positions = [tree.index[v] for v in variables]
        if len(set(positions)) != len(positions):
            raise ValueError(f"Calibrated.joint: a variable is repeated in {tuple(variables)}")
        self._possible("joint")
        shape = tuple(tree.cardinalities[v] for v in positions)
        size = 8.0 * math.prod(map(float, shape))
        if size > max_bytes:
            raise BudgetError(
                f"Calibrated.joint of {len(positions)} variables: the table would take {size:.3g} "
                f"bytes, above the {max_bytes:.3g} allowed; ask for fewer variables, or draw "
                "samples",
                int(size),
            )
        free = [v for v in positions if v not in states]
        table = aligned(self._joint(free, max_bytes), free)
        full = np.zeros(shape)
        full[tuple(states.get(v, slice(None)) for v in positions)] = table / table.sum()
        return full

    def sample(self, rng: np.random.Generator, draws: int) -> dict[Hashable, np.ndarray]:
        """Independent exact draws from the joint distribution.

        Parameters
        ----------
        rng : numpy.random.Generator
        draws : int

        Returns
        -------
        dict of variable to ndarray, shape (draws,)
            Positions of states, in the smallest unsigned integer type that holds them.

        Raises
        ------
        ZeroProbabilityError
            If the evidence is impossible.
        """
        self._possible("sample")
        tree, program = self._context.tree, self._context.program
        codes: dict[int, np.ndarray] = {
            v: np.full(
                draws, self._context.states[v], np.min_scalar_type(tree.cardinalities[v] - 1)
            )
            for v in program.sliced
        }
        for k, clique in enumerate(tree.cliques):
            rows = np.zeros(draws, dtype=np.intp)
            for v in clique.separator:
                if v not in program.sliced:
                    rows = rows * tree.cardinalities[v] + codes[v]
            picked = pick_rows(self._weights(k), rows, rng)
            for v in reversed(clique.residual):
                if v not in program.sliced:
                    n = tree.cardinalities[v]
                    picked, code = np.divmod(picked, n)
                    codes[v] = code.astype(np.min_scalar_type(n - 1))
        return {name: codes[v] for v, name in enumerate(tree.variables)}

    def _marginal(self, v: int) -> np.ndarray:
        tree, program = self._context.tree, self._context.program
        if self._collected is not None and v not in program.sliced:
            start, stop = program.place[v]
            return self._flat[start:stop]
        found = np.full(tree.cardinalities[v], math.nan if self._collected is None else 0.0)
        if self._collected is not None:
            found[self._context.states[v]] = 1.0
        found.flags.writeable = False
        return found

    def _possible(self, call: str) -> None:
        if self._collected is None:
            raise ZeroProbabilityError(
                f"Calibrated.{call}: the evidence has probability zero, so nothing is defined "
                "given it; check log_z first"
            )

    def _belief(self, k: int) -> Named:
        """In positions of variables rather than their names."""
        self._possible("belief")
        assert self._collected is not None
        context = self._context
        with np.errstate(all="ignore"):
            values = context.semiring.to_linear(
                context.semiring.multiply(self._collected[k].work, self._ratios[k][:, None])
            )
        shape = context.program.cliques[k].shape
        return Named(context.tree.cliques[k].variables, values.reshape(shape))

    def _conditional(self, k: int) -> Named:
        """The distribution of a clique's residual given its separator."""
        assert self._collected is not None
        context, one = self._context, self._collected[k]
        with np.errstate(all="ignore"):
            scaled = context.semiring.ratio(one.work, one.total[:, None])
            values = context.semiring.to_linear(scaled)
        shape = context.program.cliques[k].shape
        return Named(context.tree.cliques[k].variables, values.reshape(shape))

    def _joint(self, free: Sequence[int], max_bytes: float) -> Named:
        """The joint of unobserved variables: from one clique, or along the paths between them."""
        if not free:
            return Named((), np.ones(()))
        tree, shapes = self._context.tree, self._context.program.cliques
        if len(free) == 1:
            return Named(tuple(free), self._marginal(free[0]))
        shared = set.intersection(*(set(tree.containing[v]) for v in free))
        if shared:
            smallest = min(shared, key=lambda k: math.prod(shapes[k].matrix))
            return contract([_of_several(self._belief(smallest))], free)
        tops, others = _connecting(tree, free)
        parts = [*map(self._belief, tops), *map(self._conditional, others)]
        tables, sizes = [_of_several(p) for p in parts], dict(enumerate(tree.cardinalities))
        count = 8.0 * largest([t.scope for t in tables], free, sizes)
        if count > max_bytes:
            raise BudgetError(
                f"Calibrated.joint of {len(free)} variables: the largest intermediate table would take "
                f"{count:.3g} bytes, above the {max_bytes:.3g} allowed; ask for fewer variables at once, or "
                "raise the budget",
                int(count),
            )
        return contract(tables, free)

    def _weights(self, k: int) -> np.ndarray:
        """For each state of a clique's separator the residual's probabilities, unnormalised."""
        assert self._collected is not None
        work = self._collected[k].work
        if self._context.semiring.zero == 0.0:
            return work
        top = work.max(axis=1, keepdims=True)
        with np.errstate(under="ignore"):
            return np.exp(work - np.where(top == -math.inf, 0.0, top))


def _of_several(table: Named) -> Named:
    """Without the variables of one state, sliced ones above all."""
    return without_ones(table.values, table.scope)


def _connecting(tree: TreeStructure, free: Sequence[int]) -> tuple[list[int], list[int]]:
    """The cliques on the paths between the variables' homes: one top per component, the rest."""
    homes = {tree.home[v] for v in free}
    marked: set[int] = set()
    for k in homes:
        while k >= 0 and k not in marked:
            marked.add(k)
            k = tree.cliques[k].parent
    tops = []
    for k in sorted(marked):
        parent = tree.cliques[k].parent
        if parent in marked:
            continue
        below = [c for c in tree.cliques[k].children if c in marked]
        if k not in homes and len(below) == 1:
            marked.discard(k)  # the path only passes through: start further down
        else:
            tops.append(k)
    return tops, sorted(marked.difference(tops))
