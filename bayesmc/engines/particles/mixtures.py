"""A block of hidden numbers as a mixture of Gaussians: one look ahead for each combination of components."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from bayesmc.categorical import pick
from bayesmc.engines.particles.linearisation import Belief, LookAhead, spread_varies
from bayesmc.engines.particles.looking import CASES, components_of
from bayesmc.network import Model
from bayesmc.network.forward import Pass


class Cases(NamedTuple):
    """A block given what was seen, as a mixture of Gaussians, for every particle.

    Attributes
    ----------
    beliefs : tuple of Belief
    log_shares : ndarray, shape (cases, *batch, *apart)
    log_density : ndarray, shape (*batch, *apart)
        Of what was seen, the block integrated out.
    """

    beliefs: tuple[Belief, ...]
    log_shares: np.ndarray
    log_density: np.ndarray


class ByCase:
    """Looks ahead for every combination of components of mixtures of Gaussians, and draws from them all.

    Where means are affine this is the exact law of a block given its mixtures, the choices of components
    integrated out.

    Parameters
    ----------
    looks : sequence of LookAhead
        Of one block, with choices of their own.
    """

    def __init__(self, looks: Sequence[LookAhead]) -> None:
        self.looks = tuple(looks)
        first = self.looks[0]
        self.model, self.block, self.apart = first.model, first.block, first.apart
        self.between, self.along, self.ignored = first.between, first.along, first.ignored

    def __call__(self, state: Pass) -> None:
        state.weigh(-self.draw(state, self.believed(state)))

    def believed(self, state: Pass) -> Cases:
        """The block given its parents, whose values are in place, and what was seen."""
        beliefs = tuple(look.believed(state) for look in self.looks)
        logs = np.stack([belief.log_density for belief in beliefs])
        logs = np.where(np.isnan(logs), -np.inf, logs)
        whole = np.logaddexp.reduce(logs, axis=0)
        even = -math.log(len(logs))  # where no case explains what was seen
        shares = np.where(np.isfinite(whole), logs - np.where(np.isfinite(whole), whole, 0.0), even)
        return Cases(beliefs, shares, whole)

    def draw(self, state: Pass, cases: Cases) -> np.ndarray:
        """Put a draw of the block among the values; its log density, shape ``(*batch, *apart)``."""
        uniform = state.rng.random(cases.log_density.shape)
        chosen = pick(np.exp(cases.log_shares), uniform)
        mean, cov = cases.beliefs[0].mean, cases.beliefs[0].cov
        for k, belief in enumerate(cases.beliefs[1:], start=1):
            mean = np.where((chosen == k)[..., None], belief.mean, mean)
            cov = np.where((chosen == k)[..., None, None], belief.cov, cov)
        self.looks[0].draw(state, Belief(mean, cov, cases.log_density))
        return self.log_density(state.values, cases)

    def log_density(self, values: Mapping[str, np.ndarray], cases: Cases) -> np.ndarray:
        """The log density of a block's values, shape ``(*batch, *apart)``."""
        each = zip(self.looks, cases.beliefs, cases.log_shares, strict=True)
        # a case that explains nothing may have no density: without a share it counts for nothing
        logs = [
            np.where(share == -np.inf, -np.inf, share + look.log_density(values, belief))
            for look, belief, share in each
        ]
        found: np.ndarray = np.logaddexp.reduce(logs, axis=0)
        return found


def look_ahead(
    model: Model,
    block: Sequence[str],
    seen: Mapping[str, np.ndarray | None],
    order: Sequence[str],
    apart: tuple[str, ...],
    affine: bool = False,
) -> LookAhead | ByCase:
    """A ``LookAhead``, or one for each combination of components where mixtures are few and small."""
    counts = {n: components_of(model, n, apart) for n in (*block, *seen)}
    counts = {
        n: k
        for n, k in counts.items()
        if k > 1 and (n in block or not spread_varies(model, order, block, n))
    }
    if not counts:
        return LookAhead(model, block, seen, order, apart, affine)
    while math.prod(counts.values()) > CASES:  # the largest are taken as a whole, seen ones first
        counts.pop(max(counts, key=lambda n: (n in seen, counts[n])))
    cases = [dict(zip(counts, index, strict=True)) for index in np.ndindex(*counts.values())]
    return ByCase([LookAhead(model, block, seen, order, apart, affine, c) for c in cases])
