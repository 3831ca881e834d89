"""Discrete nodes by Metropolis-Hastings: symmetric jumps, mixed with draws from the node's own density.

A finite node without an order jumps to any other state; integers jump a few steps up or down, by a size
that adapts until the warmup ends; vectors of counts carry some from one cell to another. Every element is
accepted by itself. The draws from the node's own density cross what jumps do not, and keep two nodes that
accept every jump from moving in lockstep for ever.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.kernels.adaptation import SCALE_DECAY, best_rate, chance
from bayesmc.kernels.base import Kernel, Memory, counted
from bayesmc.kernels.densities import accepted, compare, instead
from bayesmc.kernels.proposal import to_stored
from bayesmc.kernels.random_walk import picked
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Values

#: finite nodes with more states than this, if they have an order, jump to neighbours
_FEW = 8
#: share of draws from the node's own density, and of rest where there is none to draw from
_OWN, _REST = 0.5, 0.1


class Jump(Kernel):
    """Metropolis-Hastings of a discrete node.

    Parameters
    ----------
    blanket : Blanket
    size : int, optional
        Largest jump of an integer, which does not adapt then; no draws from the node's own density.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.kernels.jump import Jump
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.blanket import Blanket
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet()
    >>> net.add("n", bmc.Poisson(4.0))
    >>> net.add("k", lambda n: bmc.Binomial(n, 0.5))
    >>> target = target_of(pose(net, {"k": 3}))
    >>> kernel = Jump(Blanket(target, "n"))
    >>> values = {**target.known, "n": np.full(4, 6)}
    >>> new, _ = kernel.step(values, kernel.start(values, 4), np.random.default_rng(0), True)
    >>> bool((new["n"] >= 3).all())
    True
    """

    def __init__(self, blanket: Blanket, size: int | None = None) -> None:
        self.blanket = blanket
        self.names = (blanket.name,)
        node = blanket.node
        self.size = size
        domain = node.domain
        self.anywhere = (
            size is None
            and domain is not None
            and (domain.labels is not None or domain.size <= _FEW)
        )
        #: share of draws from the node's own density
        self.own = 0.0
        if size is None and blanket.own is not None and not node.unsampled:
            self.own = _OWN
        self.label = "jumps to another state" if self.anywhere else "jumps up and down"
        if node.event_shape:
            self.label = "counts carried from cell to cell"
        self.match = "half of the proposals from its own density" if self.own else ""

    def start(self, values: Values, chains: int) -> Memory:
        log_size = np.full(self.blanket.size, np.log(float(self.size or 1)))
        return {"log_size": log_size, "count": 0, "accepted": np.zeros(chains), "moves": 0}

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        blanket, name = self.blanket, self.blanket.name
        state, taken = values, []
        rates = np.full((len(values[name]), blanket.size), np.nan)
        for members in blanket.classes:
            proposal, dead, drawn = self._proposed(state, memory, rng)
            new, dead = picked(proposal, dead, members, blanket)
            _, drawn = picked(proposal, drawn, members, blanket)
            found = compare(blanket, state, new, members, dead)
            # a draw from the node's own density is corrected by that density, which cancels
            own = np.where(drawn & ~found.dead, 0.0, found.own)
            log_ratio = own + found.rest
            accept = accepted(log_ratio, rng)
            new = instead(~accept, found.new, blanket.current(state, members))
            moved = blanket.moved(state, new.astype(values[name].dtype, copy=False), members)
            state = {**state, name: moved}
            at = slice(None) if members is None else members
            jumped = np.where(drawn, np.nan, chance(log_ratio))
            rates[:, at] = jumped.reshape(len(rates), -1)
            taken.append(accept.reshape(len(rates), -1))
        if warmup:
            return {name: state[name]}, self._learnt(memory, rates)
        share = np.concatenate(taken, axis=1).mean(axis=1)
        return {name: state[name]}, counted(memory, share)

    # ---- private -------------------------------------------------------------------------------

    def _proposed(
        self, values: Values, memory: Memory, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stored proposals of all elements, which are impossible, and which come from the own density."""
        node = self.blanket.node
        now = values[node.name]
        shape = (len(now), *node.plate_shape)
        new, dead = self._jumped(now, memory, rng, shape)
        drawn = np.zeros(shape, dtype=bool)
        if self.own:
            assert self.blanket.own is not None
            dist, _ = self.blanket.own.distribution(values)
            stored, outside = to_stored(node, dist.sample_to(rng, shape))
            drawn = rng.random(shape) < self.own
            new = instead(drawn, new, stored)
            dead = np.where(drawn, outside, dead)
        elif self.anywhere:
            new = np.where(rng.random(shape) < _REST, now, new)
        return new, dead, drawn

    def _jumped(
        self, now: np.ndarray, memory: Memory, rng: np.random.Generator, shape: tuple[int, ...]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Symmetric jumps, and which of them leave the node's values."""
        node = self.blanket.node
        if self.anywhere:
            assert node.domain is not None
            if node.domain.size < 2:
                return now, np.zeros(shape, dtype=bool)
            by = rng.integers(1, node.domain.size, size=shape)
            return ((now.astype(np.int64) + by) % node.domain.size).astype(now.dtype), np.zeros(
                shape, dtype=bool
            )
        largest = np.exp(memory["log_size"]).reshape(node.plate_shape)
        by = 1 + np.floor(rng.random(shape) * np.round(largest)).astype(np.int64)
        wide = now.astype(np.int64) if now.dtype.kind in "iu" else now
        if node.event_shape:
            return self._carried(wide, by, rng, shape)
        new = wide + np.where(rng.random(shape) < 0.5, by, -by)
        if node.domain is not None:
            dead = (new < 0) | (new >= node.domain.size)
            return np.where(dead, wide, new).astype(now.dtype), dead
        return new, self._outside(new)

    def _carried(
        self, now: np.ndarray, by: np.ndarray, rng: np.random.Generator, shape: tuple[int, ...]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Vectors of counts with some carried from one component to another."""
        (cells,) = self.blanket.event_shape
        if cells < 2:
            return now, np.zeros(shape, dtype=bool)
        source = rng.integers(cells, size=shape)
        sink = (source + rng.integers(1, cells, size=shape)) % cells
        cell = np.arange(cells)
        change = (cell == sink[..., None]).astype(now.dtype) - (cell == source[..., None])
        new = now + by[..., None] * change
        return new, (new < 0).any(axis=-1)

    def _outside(self, new: np.ndarray) -> np.ndarray:
        """Integers outside the support, as far as that does not depend on parents."""
        support = self.blanket.node.support
        if self.blanket.own is not None or support is None:
            return np.zeros(new.shape, dtype=bool)
        return ~support.contains(new)

    def _learnt(self, memory: Memory, rates: np.ndarray) -> Memory:
        """Sizes of jumps that follow the acceptance rate of all chains."""
        if self.anywhere or self.size is not None:
            return memory
        count = memory["count"] + 1
        error: Any = np.where(np.isnan(rates), 0.0, rates / best_rate(1) - 1.0).mean(axis=0)
        log_size = memory["log_size"] + 2.0 * (count + 1.0) ** -SCALE_DECAY * error
        return {**memory, "log_size": np.clip(log_size, 0.0, 40.0), "count": count}
