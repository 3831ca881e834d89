"""Blocks and observations of which some have no noise: conditioned in terms of the noise that there is.

Information form has no place for a scale of 0. So what hangs together with such a node is written as ``mean +
rows @ noise``, with independent standard normal noise, and conditioned by one triangularisation for every
configuration of the discrete variables that switch it (``linalg.square_root``). What follows from other observed
numbers counts as a probability, one where it is right.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.distributions.noiseless import ALLOWED, FLOOR, ROUNDED
from bayesmc.errors import UnsupportedError
from bayesmc.factors import LogTable
from bayesmc.factors.gaussian import Conditional, GaussianFactor, along
from bayesmc.linalg.square_root import (
    HALF_LOG_2PI,
    condition,
    log_densities,
    multiplied,
    standardised,
    went_in,
)


@dataclass(frozen=True, eq=False)
class NoiseCluster:
    """Hidden blocks that hang together, and what is observed of them.

    Attributes
    ----------
    conditionals : list of Conditional
        Of the hidden blocks, parents first.
    factors : list of GaussianFactor
        Observations with noise.
    seen : list of (Conditional, ndarray)
        Observed elements of which some components have none, and their values.
    """

    conditionals: list[Conditional]
    factors: list[GaussianFactor]
    seen: list[tuple[Conditional, np.ndarray]]

    @cached_property
    def scope(self) -> tuple[Any, ...]:
        """Discrete variables that switch any of it."""
        scopes = [c.scope for c in self.conditionals] + [f.scope for f in self.factors]
        scopes += [c.scope for c, _ in self.seen]
        return tuple(dict.fromkeys(v for scope in scopes for v in scope))

    @property
    def noise(self) -> Any:
        """The block of the noise that is left."""
        return (None, self.conditionals[0].block)

    def bytes(self, dims: Mapping[Any, int], cards: Mapping[Any, int]) -> float:
        """Memory that conditioning takes, about."""
        hidden, observed = self._sizes(dims)
        rows = float(hidden + observed)
        return 32.0 * rows * (rows + observed) * math.prod(float(cards[v]) for v in self.scope)

    def solve(
        self, dims: Mapping[Any, int], cards: Mapping[Any, int]
    ) -> tuple[list[Conditional], LogTable, int]:
        """The blocks in terms of the noise that is left, the evidence's table, and how much noise that is.

        Raises
        ------
        UnsupportedError
            What is observed without noise has some at other configurations.
        """
        lead = tuple(cards[v] for v in self.scope)
        hidden, p = self._sizes(dims)
        mean, terms, rows, target, log = self._written(dims, lead, hidden, p)
        chosen = np.concatenate([rows[..., hidden:, :], rows[..., :hidden, :]], axis=-2)
        made = condition(chosen, p)
        eta = standardised(made.root, target - mean[..., hidden:])
        log = log + log_densities(made.root, eta, None, made.certain)
        if made.certain is not None:
            flat = made.certain.reshape(-1, p)
            if (flat != flat[:1]).any():
                raise self._unlike()
            off = np.abs(eta) * made.root.diagonal(0, -2, -1)
            size = np.abs(target) + np.abs(mean[..., hidden:])
            terms = np.abs(target) + terms[..., hidden:]
            allowed = ALLOWED * size + ROUNDED * went_in(made.root, terms) + FLOOR
            wrong = (made.certain & (off > allowed)).any(axis=-1)
            log = np.where(wrong, -np.inf, log)
        after = mean[..., :hidden] + multiplied(made.gain, eta)
        width = made.factor.shape[-1]
        found = [
            Conditional(self.noise, (), (), np.zeros(width), np.zeros((width, 0)), np.eye(width))
        ]
        at = 0
        for c in self.conditionals:
            place = slice(at, at + dims[c.block])
            at = place.stop
            d = dims[c.block]
            found.append(
                Conditional(
                    c.block, self.scope, (self.noise,), after[..., place],
                    made.factor[..., place, :], np.zeros((*lead, d, d)),
                )
            )  # fmt: skip
        return found, LogTable(np.broadcast_to(log, lead)), width

    def _sizes(self, dims: Mapping[Any, int]) -> tuple[int, int]:
        """Hidden numbers, and observed ones."""
        observed = sum(f.rows.shape[-2] for f in self.factors)
        observed += sum(len(value) for _, value in self.seen)
        return sum(dims[c.block] for c in self.conditionals), observed

    def _written(
        self, dims: Mapping[Any, int], lead: tuple[int, ...], hidden: int, p: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Any]:
        """Means of all numbers, hidden ones first; how large their terms are; rows; what was seen; logs of
        constant factors.
        """
        total = hidden + p
        mean, rows = np.zeros((*lead, total)), np.zeros((*lead, total, total))
        terms = np.zeros((*lead, total))
        target, log = np.zeros((*lead, p)), np.zeros(lead)
        places: dict[Any, np.ndarray] = {}
        at = 0

        def put(c: Conditional, d: int) -> None:
            nonlocal at
            own = slice(at, at + d)
            offset, gain, root = (along(a, c.scope, self.scope) for a in (c.offset, c.gain, c.root))
            mean[..., own], terms[..., own] = offset, np.abs(offset)
            if c.parents:
                above = np.concatenate([places[b] for b in c.parents])
                mean[..., own] += np.matvec(gain, mean[..., above])
                terms[..., own] += np.matvec(np.abs(gain), terms[..., above])
                rows[..., own, :] = gain @ rows[..., above, :]
            rows[..., own, own] += root
            at = own.stop

        for c in self.conditionals:
            places[c.block] = np.arange(at, at + dims[c.block])
            put(c, dims[c.block])
        for factor in self.factors:
            made = along(factor.rows, factor.scope, self.scope)
            m = made.shape[-2]
            target[..., at - hidden : at - hidden + m] = made[..., -1]
            # exp(-|A x - z|^2 / 2) is the density of z given x, but for a constant
            log = log + along(factor.log_scale, factor.scope, self.scope) + m * HALF_LOG_2PI
            zero = np.zeros((*made.shape[:-2], m))
            put(Conditional(None, self.scope, factor.blocks, zero, made[..., :-1], np.eye(m)), m)
        for c, value in self.seen:
            target[..., at - hidden : at - hidden + len(value)] = value
            put(c, len(value))
        return mean, terms, rows, target, log

    def _unlike(self) -> UnsupportedError:
        names = ", ".join(dict.fromkeys(repr(c.block[0]) for c, _ in self.seen))
        return UnsupportedError(
            f"{names} is observed with noise at some configurations of the finite nodes and without at "
            "others, and densities do not compare with probabilities; give it a little noise at all of them"
        )


def without_noise(conditional: Conditional) -> bool:
    """Whether some component has no noise of its own at some configuration."""
    return bool((np.linalg.diagonal(conditional.root) == 0).any())


def clusters(
    conditionals: Sequence[Conditional],
    factors: Sequence[GaussianFactor],
    seen: Sequence[tuple[Conditional, np.ndarray]],
) -> tuple[list[NoiseCluster], list[Conditional], list[GaussianFactor]]:
    """What hangs together with something that has no noise, and all the rest."""
    bare = [c.block for c in conditionals if without_noise(c)]
    bare += [c.parents[0] for c, _ in seen]
    if not bare:
        return [], list(conditionals), list(factors)
    near: dict[Any, list[Any]] = {c.block: [] for c in conditionals}
    groups = [(c.block, *c.parents) for c in conditionals] + [f.blocks for f in factors]
    for group in [*groups, *(c.parents for c, _ in seen)]:
        for other in group[1:]:
            near[group[0]].append(other)
            near[other].append(group[0])
    number: dict[Any, int] = {}
    for block in bare:
        todo = [block] if block not in number else []
        count = len(set(number.values()))
        while todo:
            here = todo.pop()
            if here not in number:
                number[here] = count
                todo += near[here]
    found = [NoiseCluster([], [], []) for _ in set(number.values())]
    for c in conditionals:
        if c.block in number:
            found[number[c.block]].conditionals.append(c)
    for f in factors:
        if f.blocks[0] in number:
            found[number[f.blocks[0]]].factors.append(f)
    for pair in seen:
        found[number[pair[0].parents[0]]].seen.append(pair)
    rest = [c for c in conditionals if c.block not in number]
    return found, rest, [f for f in factors if f.blocks[0] not in number]
