"""Metropolis-Hastings with proposals that are conditional densities: a user's, or the node's own.

The Hastings correction is computed from the proposal itself: its density at the proposed value, and at
the old value with the proposed one in place.

References
----------
Hastings (1970), Biometrika 57; Koller and Friedman (2009), sec. 12.3.4.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.errors import BroadcastError
from bayesmc.kernels.base import Kernel, Memory, counted
from bayesmc.kernels.densities import Block, accepted, compare, instead
from bayesmc.kernels.proposal import (
    Parts,
    Proposal,
    blaming,
    check_kind,
    check_vector,
    cut,
    refuse_infinite,
    to_stored,
    to_support,
    warn_of_gaps,
)
from bayesmc.kernels.random_walk import picked
from bayesmc.network import CompiledNode
from bayesmc.shapes import masks, nearly_equal
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Target, Values


class Proposed(Kernel):
    """One node, every element proposed and accepted by itself.

    Parameters
    ----------
    blanket : Blanket
    proposal : Proposal or None
        None: from the node's own density given its parents.
    """

    def __init__(self, blanket: Blanket, proposal: Proposal | None = None) -> None:
        self.blanket = blanket
        self.names = (blanket.name,)
        self.proposal = proposal
        self.label = "proposed by a function" if proposal else "proposed from its own density"
        if proposal is not None and not proposal.parents:
            self.label = "proposed from one distribution"

    def start(self, values: Values, chains: int) -> Memory:
        if self.proposal is not None:
            with blaming(self.proposal):
                dist = self._distribution(values)
                check_kind(self.blanket.node, dist)
                self._check_elements(values, dist)
            if self.proposal.is_independent:
                warn_of_gaps(self.proposal, self.blanket.node, dist)
        return {"accepted": np.zeros(chains), "moves": 0}

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        blanket, name = self.blanket, self.blanket.name
        state, share, count = values, np.zeros(len(values[name])), 0
        for members in blanket.classes:
            with blaming(self.proposal):
                drawn, dead, forward = self._drawn(state, rng)
            new, forward = picked(drawn, forward, members, blanket)
            _, dead = picked(drawn, dead, members, blanket)
            found = compare(blanket, state, new, members, dead)
            log_ratio = found.own + found.rest - forward
            log_ratio = log_ratio + self._backward(state, found.new, members)
            accept = accepted(log_ratio, rng)
            new = instead(~accept, found.new, blanket.current(state, members))
            state = {**state, name: blanket.moved(state, new, members)}
            taken = accept.reshape(len(accept), -1)
            share, count = share + taken.sum(axis=1), count + taken.shape[1]
        if warmup:
            return {name: state[name]}, memory
        return {name: state[name]}, counted(memory, share / max(count, 1))

    # ---- private -------------------------------------------------------------------------------

    def _distribution(self, values: Values) -> Distribution:
        if self.proposal is not None:
            return self.proposal.fitted(self.blanket.target.model, values)
        assert self.blanket.own is not None
        return self.blanket.own.distribution(values)[0]

    def _drawn(
        self, values: Values, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stored proposals of all elements, which are none of the node's values, and their densities."""
        node = self.blanket.node
        dist = self._distribution(values)
        shape = (len(values[node.name]), *node.plate_shape)
        draws = dist.sample_to(rng, shape)
        log = np.broadcast_to(dist.log_prob(draws), shape)
        refuse_infinite(log)
        stored, outside = to_stored(node, draws)
        return stored, np.broadcast_to(outside, shape), log

    def _backward(self, values: Values, new: np.ndarray, members: np.ndarray | None) -> np.ndarray:
        """Log density of proposing the old values from the new ones."""
        blanket = self.blanket
        proposal, name = self.proposal, blanket.name
        state = values
        if proposal is not None and {name, *blanket.path} & set(proposal.parents):
            state = blanket.placed(values, new, members)
        with blaming(proposal):
            dist = self._distribution(state)
            now = values[name]
            log = dist.log_prob(to_support(blanket.node, now))
        shape = (len(now), *blanket.node.plate_shape)
        return picked(now, np.broadcast_to(log, shape), members, blanket)[1]

    def _check_elements(self, values: Values, dist: Distribution) -> None:
        """Refuse a function that mixes elements: they are accepted one by one."""
        blanket, node = self.blanket, self.blanket.node
        if blanket.size < 2:
            return
        now = values[node.name]
        shape = (len(now), *node.plate_shape)
        draws = dist.sample_to(np.random.default_rng(0), shape)
        stored, outside = to_stored(node, draws)
        support = (
            node.support if blanket.own is None else blanket.own.distribution(values)[0].support
        )
        assert support is not None
        outside = outside | ~support.contains(draws)
        stored = instead(np.broadcast_to(outside, shape), stored, now)
        before = np.broadcast_to(dist.log_prob(to_support(node, now)), shape)
        for moved in masks(blanket.size):
            mask = np.broadcast_to(moved.reshape(node.plate_shape), shape)
            state = blanket.placed(values, instead(~mask, stored, now))
            after = self._distribution(state).log_prob(to_support(node, now))
            after = np.broadcast_to(after, shape)
            if not nearly_equal(after[~mask], before[~mask]):
                raise BroadcastError(
                    "it proposes an element of the plate by looking at others of the same node, but "
                    f"elements are accepted one by one; give it for the tuple ({node.name!r},), which moves "
                    "as one"
                )


class ProposedBlock(Kernel):
    """Several nodes proposed jointly, accepted or not as one.

    Parameters
    ----------
    target : Target
    names : sequence of str
    proposal : Proposal or None
        None: from the nodes' own densities, parents first.
    """

    def __init__(
        self, target: Target, names: Sequence[str], proposal: Proposal | None = None
    ) -> None:
        self.block = Block(target, names)
        self.names = tuple(names)
        self.target = target
        self.nodes = [target.model[name] for name in names]
        self.proposal = proposal
        self.label = (
            "proposed jointly by a function" if proposal else "proposed from their own densities"
        )

    def start(self, values: Values, chains: int) -> Memory:
        if self.proposal is not None:
            with blaming(self.proposal):
                dist = self.proposal.fitted(self.target.model, values)
                parts = dist.parts if isinstance(dist, Parts) else {}
                for node in self.nodes:
                    if node.name in parts:
                        check_kind(node, parts[node.name])
                if not parts:
                    partly = {n for n in self.names if self.target.seen(n) is not None}
                    check_vector(self.nodes, dist, partly)
            for node in self.nodes:
                if node.name in parts and self.proposal.is_independent:
                    warn_of_gaps(self.proposal, node, parts[node.name])
        return {"accepted": np.zeros(chains), "moves": 0}

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        with blaming(self.proposal):
            new, dead, forward = self._drawn(values, rng)
        new = {n: instead(dead, v, values[n]) for n, v in new.items()}
        _, log = self.block.log(values)
        state, grown = self.block.log(values, lambda name, _: (new[name], 0.0))
        with blaming(self.proposal):
            backward = self._log_density(state, values)
        log_ratio = np.where(dead, -np.inf, grown - log + backward - forward)
        accept = accepted(log_ratio, rng)
        moved = {n: instead(~accept, state[n], values[n]) for n in self.names}
        if warmup:
            return moved, memory
        return moved, counted(memory, accept.astype(float))

    # ---- private -------------------------------------------------------------------------------

    def _drawn(
        self, values: Values, rng: np.random.Generator
    ) -> tuple[Values, np.ndarray, np.ndarray]:
        """Stored proposals, which chains have one that is no value of a node, and log densities."""
        if self.proposal is None:
            return self._from_own(values, rng)
        dist = self.proposal.fitted(self.target.model, values)
        chains = len(values[self.names[0]])
        if not isinstance(dist, Parts):
            draws = dist.sample_to(rng, (chains,))
            log = np.broadcast_to(dist.log_prob(draws), (chains,))
            refuse_infinite(log)
            new, dead = {}, np.zeros(chains, dtype=bool)
            for node, part in zip(self.nodes, cut(self.nodes, draws), strict=True):
                new[node.name], outside = to_stored(node, part)
                dead |= outside.reshape(chains, -1).any(axis=1)
            return new, dead, log
        new, dead, log = {}, np.zeros(chains, dtype=bool), np.zeros(chains)
        for node in self.nodes:
            draws = dist.parts[node.name].sample_to(rng, (chains, *node.plate_shape))
            one = np.broadcast_to(
                dist.parts[node.name].log_prob(draws), draws.shape[: 1 + len(node.plates)]
            )
            refuse_infinite(one)
            stored, outside = to_stored(node, draws)
            new[node.name] = self._with_seen(node, stored, values)
            log = log + self._summed(node, one)
            dead |= self._summed(node, outside.astype(float)) > 0
        return new, dead, log

    def _log_density(self, given: Values, values: Values) -> np.ndarray:
        """Log density of proposing ``values`` from the state ``given``."""
        if self.proposal is None:
            return self._own_log(values)
        dist = self.proposal.fitted(self.target.model, given)
        if not isinstance(dist, Parts):
            flat = [
                to_support(n, values[n.name]).reshape(len(values[n.name]), -1) for n in self.nodes
            ]
            return dist.log_prob(np.concatenate(flat, axis=1))
        total = np.zeros(len(values[self.names[0]]))
        for node in self.nodes:
            log = dist.parts[node.name].log_prob(to_support(node, values[node.name]))
            log = np.broadcast_to(log, (len(total), *node.plate_shape))
            total = total + self._summed(node, log)
        return total

    def _from_own(
        self, values: Values, rng: np.random.Generator
    ) -> tuple[Values, np.ndarray, np.ndarray]:
        """Draws from the nodes' own densities, parents first."""
        model, state = self.target.model, dict(values)
        chains = len(values[self.names[0]])
        for name in self.block.order:
            if name not in self.block.names:
                state[name], _ = model.evaluate(name, state)
                continue
            dist, _ = self.block.own[name].distribution(state)
            stored = model.sample_stored(name, dist, rng, (chains,))
            state[name] = self._with_seen(model[name], stored, values)
        log = self._own_log(state)
        return {n: state[n] for n in self.names}, np.zeros(chains, dtype=bool), log

    def _own_log(self, values: Values) -> np.ndarray:
        """Log density of drawing the values of all nodes from their own densities."""
        total = np.zeros(len(values[self.names[0]]))
        for node in self.nodes:
            log = self.block.own[node.name].log(values)
            total = total + self._summed(
                node, np.broadcast_to(log, (len(total), *node.plate_shape))
            )
        return total

    def _with_seen(self, node: CompiledNode, new: np.ndarray, values: Values) -> np.ndarray:
        """A proposal with the observed elements of a partly observed node in place."""
        seen = self.target.seen(node.name)
        if seen is None:
            return new
        assert seen.mask is not None
        return instead(
            np.broadcast_to(seen.mask, new.shape[: 1 + len(node.plates)]), new, values[node.name]
        )

    def _summed(self, node: CompiledNode, log: np.ndarray) -> np.ndarray:
        """Sum over the elements that move, shape (chains,)."""
        flat = log.reshape(len(log), -1)
        free = self.target.free_elements(node.name)
        return (flat if free is None else flat[:, free]).sum(axis=1)
