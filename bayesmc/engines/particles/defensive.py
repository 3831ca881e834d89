"""Drawing a block by looking ahead, with a defence against guesses that are too narrow."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from bayesmc.network.forward import Pass, Step, run

#: share of the particles that a guarded block draws from its own densities
SHARE = 0.1


class Guarded:
    """Draws a block by looking ahead, a share of the particles from its own densities instead; weighs by p/q.

    A Gaussian can be far too narrow where means are not affine. In the mixture no weight is more than
    1 / ``SHARE`` of what it is when all are drawn from their own densities (Hesterberg 1995, Weighted average
    importance sampling and defensive mixture distributions, Technometrics 37).

    Parameters
    ----------
    look : LookAhead or ByCase
    own : sequence of steps
        Draw the block from its own densities, and compute what lies between.
    factors : sequence of steps
        Compute what lies between, and weigh by the block's own densities.
    """

    def __init__(self, look: Any, own: Sequence[Step], factors: Sequence[Step]) -> None:
        self.look, self.own, self.factors = look, own, factors

    def __call__(self, state: Pass) -> None:
        look = self.look
        belief = look.believed(state)
        shape = belief.log_density.shape
        alive = state.alive.reshape(state.batch + (1,) * len(look.apart))
        dead = np.where(alive, 0.0, -np.inf)  # bad parameters are excused there
        plain = run(self.own, Pass(state.rng, state.batch, dict(state.values), dead))
        look.draw(state, belief)
        valid: dict[str, np.ndarray] = {}
        plainly = state.rng.random(shape) < SHARE
        for name in look.block:
            at = look.along(plainly, look.model[name])
            mixed = np.where(at, plain.values[name], state.values[name])
            mixed.flags.writeable = False
            state.values[name] = mixed
        drawn = run(self.factors, Pass(state.rng, state.batch, dict(state.values), dead))
        log_p = np.broadcast_to(drawn.log_weight, shape)
        lost = log_p == -np.inf
        if lost.any():  # such as below zero: without weight, but what comes later has to stand them
            for name in look.block:
                at = look.along(lost, look.model[name])
                kept = np.where(at, plain.values[name], state.values[name])
                kept.flags.writeable = False
                valid[name] = kept
        log_q = look.log_density(state.values, belief)
        mixture = np.logaddexp(math.log1p(-SHARE) + log_q, math.log(SHARE) + log_p)
        state.weigh(np.where(lost, -np.inf, log_p - mixture))
        state.values.update(valid)
