"""Particles that begin anew: steps of a slice that draw its state from given densities.

*Rejuvenation* begins anew where no particle explains what was seen, and takes the given density for the
model's there. *Lost* particles do so with a small probability in every slice (``recovery``); they may be
drawn from where the sensor says, and are weighted by density over proposal.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.dbn import Row
from bayesmc.engines.particles.recovery import Recovery
from bayesmc.engines.proposal import FUNCTION, as_function, bound
from bayesmc.engines.proposing import Propose
from bayesmc.engines.slice_steps import SlicePlan, check_target
from bayesmc.errors import ModelError
from bayesmc.kernels.proposal import Key, Proposal, blaming, names_of
from bayesmc.network import Model, Observed
from bayesmc.network.forward import Pass, Step, summed


class Rejuvenation:
    """Steps of a slice whose nodes are drawn from given densities, without a look at the slice before.

    The weights are those of what was seen, as if the given densities were the model's: the answers of the
    slice, and the evidence, are biased by that.
    """

    def __init__(
        self, plan: SlicePlan, given: Mapping[Key, Any], option: str = "rejuvenation="
    ) -> None:
        self.plan = plan
        for key in given:
            for name in names_of(key):
                check_target(plan.slices, name, f"ParticleFilter: {option} for {key!r}")
        self.drawn = {n for key in given for n in names_of(key)}
        self.first = [self._bound(plan.slices.first, k, v) for k, v in given.items()]
        self.later = [self._bound(plan.slices.later, k, v) for k, v in given.items()]
        short = [n for n in plan.slices.interface if plan.slices.later[n].is_stochastic]
        missing = sorted(set(short) - self.drawn)
        if missing:
            raise ModelError(
                f"ParticleFilter: {option} says nothing of {missing[0]!r}, which the next slice reads; "
                "give a density for each of " + ", ".join(map(repr, short))
            )

    def __call__(self, row: Row) -> Sequence[Step]:
        model = self.plan.slices.model(row.t)
        by_target = {n: p for p in (self.first if row.t == 0 else self.later) for n in p.names}
        found: list[Step] = []
        done: set[str] = set()
        for name in self.plan.slices.dynamic:
            if name in row.seen or name not in by_target:
                found.append(self.plan.step(row, name))
            elif name not in done:
                found.append(Anew(model, row.seen, by_target[name], self.plan.apart))
                done |= set(by_target[name].names)
        return found

    def _bound(self, model: Model, key: Key, spec: Any) -> Any:
        function = as_function("ParticleFilter", key, spec, FUNCTION)
        return bound("ParticleFilter", model, key, function)


class Lost:
    """Steps of the particles that recovery lets begin anew."""

    def __init__(self, plan: SlicePlan, options: Recovery) -> None:
        self.plan, self.options = plan, options
        model = plan.slices.later
        self._prior = Rejuvenation(plan, options.density, "recovery=")
        self._aimed: dict[str, Proposal] = {}
        for name, spec in (options.proposal or {}).items():
            check_target(plan.slices, name, f"Recovery: proposal for {name!r}")
            function = as_function("Recovery", name, spec, FUNCTION)
            self._aimed[name] = bound("Recovery", model, name, function)

    def steps(self, row: Row) -> Sequence[Step]:
        """The steps of a row's slice; a proposal that looks at what is missing does not apply."""
        model, seen = self.plan.slices.later, row.seen
        found: list[Step] = []
        done: set[str] = set()
        for name in self.plan.slices.dynamic:
            prior = next((p for p in self._prior.later if name in p.names), None)
            if name in seen or prior is None:
                found.append(self.plan.step(row, name))
                continue
            aimed = self._aimed.get(name)
            unknown = set() if aimed is None else set(aimed.parents) & set(self.plan.slices.dynamic)
            unknown -= done | {n for n, o in seen.items() if o.mask is None}
            if aimed is None or unknown:
                found.append(Anew(model, seen, prior, self.plan.apart))
            else:
                found += [Aimed(model, seen, aimed, self.plan.apart), _Density(model, prior)]
            done.add(name)
        return found


class Aimed(Propose):
    """Draws from a proposal for a given density, which may be narrower than the node's support."""

    def __init__(
        self,
        model: Model,
        observed: Mapping[str, Observed],
        proposal: Proposal,
        apart: tuple[str, ...] = (),
    ) -> None:
        super().__init__(model, observed, proposal, apart)
        self._compared = set(proposal.names)


class Anew(Aimed):
    """Draws that are taken as they come: nothing is divided out of the weight."""

    def _divide(
        self, log_q: np.ndarray, outside: np.ndarray, alive: np.ndarray, state: Pass
    ) -> None:
        if outside.any():
            state.weigh(np.where(outside, -np.inf, 0.0))


# ---- private ------------------------------------------------------------------------------------


class _Density:
    """A given density at a value in place, as a factor of the weight."""

    def __init__(self, model: Model, given: Proposal) -> None:
        self.model, self.given, self.node = model, given, model[given.names[0]]

    def __call__(self, state: Pass) -> None:
        with blaming(self.given):
            dist, _ = self.given.distribution(self.model, state.values)
            value = state.values[self.node.name]
            state.weigh(summed(self.model.log_density(self.node.name, dist, value), self.node, ()))
