"""Rejuvenation and random-particle injection: steps of a slice that draw its state from given densities.

*Rejuvenation* begins anew where no particle explains what was seen, and takes the given density for the
model's there. *Injected* particles do so with a small probability in every slice (``recovery``); they may be
drawn from where the sensor says, and are weighted by density over proposal.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.categorical import pick
from bayesmc.dbn import PREVIOUS, Row, Slices
from bayesmc.engines.particles.recovery import Recovery
from bayesmc.engines.particles.smc import Particles, Selection
from bayesmc.engines.proposal import FUNCTION, as_function, bound
from bayesmc.engines.proposing import Propose
from bayesmc.engines.slice_steps import SlicePlan, check_target
from bayesmc.errors import ModelError
from bayesmc.kernels.proposal import Key, Proposal, blaming, names_of
from bayesmc.network import Model
from bayesmc.network.forward import Pass, Step, summed


class Rejuvenation:
    """Steps of a slice whose nodes are drawn from given densities, without a look at the slice before.

    The weights are those of what was seen, as if the given densities were the model's: the answers of the
    slice, and the evidence, are biased by that.
    """

    def __init__(self, plan: SlicePlan, given: Mapping[Key, Any]) -> None:
        self.plan = plan
        slices = plan.slices
        self._first = given_densities(slices, slices.first, given, "ParticleFilter", "rejuvenation")
        self._later = given_densities(slices, slices.later, given, "ParticleFilter", "rejuvenation")

    def __call__(self, row: Row) -> Sequence[Step]:
        model = self.plan.slices.model(row.t)
        densities = self._first if row.t == 0 else self._later
        found: list[Step] = []
        done: set[str] = set()
        for name in self.plan.slices.dynamic:
            if name in row.seen or name not in densities:
                found.append(self.plan.step(row, name))
            elif name not in done:
                found.append(Unweighed(model, row.seen, densities[name], self.plan.apart))
                done |= set(densities[name].names)
        return found


class Injection:
    """The particles that recovery lets begin anew.

    They stand for a share of the transition that does not depend on the slice before, so each of them
    starts with an equal part of what all particles stand for, whoever its ancestor was. Where something
    else in the slice looks at the slice before (a reading of how far the robot came, say), they get
    ancestors by the weights these had.
    """

    def __init__(self, plan: SlicePlan, options: Recovery) -> None:
        self.plan, self.options = plan, options
        slices, model = plan.slices, plan.slices.later
        self._prior = given_densities(slices, model, options.density, "Recovery", "density")
        self._aimed: dict[str, Proposal] = {}
        for name, spec in (options.proposal or {}).items():
            check_target(slices, name, f"Recovery: proposal= for {name!r}")
            if name not in self._prior:
                raise ModelError(
                    f"Recovery: proposal= for {name!r}, of which density= says nothing; weights "
                    "are density over proposal, so give both"
                )
            function = as_function("Recovery", name, spec, FUNCTION)
            self._aimed[name] = bound("Recovery", model, name, function)
        self._check_order()
        self._ranks = {n: len(model[n].value_shape) for n in slices.dynamic}
        self._before = {n + PREVIOUS: len(model[n].value_shape) for n in slices.interface}
        rest = [n for n in slices.dynamic if n not in self._prior]
        self._looks_back = any(set(model[n].parents) & self._before.keys() for n in rest)

    def mixed(
        self,
        row: Row,
        before: Mapping[str, np.ndarray],
        earlier: Particles,
        selection: Selection,
        passed: tuple[dict[str, np.ndarray], Any],
        rng: np.random.Generator,
    ) -> tuple[dict[str, np.ndarray], Any, Selection, int]:
        """Values and log weights where some have begun anew, what they start with, and how many these are."""
        (values, log), n = passed, selection.particles
        share = self.options.share_of(earlier.averages)
        drawn = self.options.drawn(share)
        lost = np.flatnonzero(rng.random(n) < drawn) if drawn > 0.0 else np.zeros(0, dtype=np.intp)
        if drawn > share:
            log = log + math.log1p(-share) - math.log1p(-drawn)
        if not lost.size:
            return values, log, selection, 0
        state = self._begun(row, before, self._ancestors(earlier, selection, lost, rng), rng)
        values = {k: self._placed(k, v, state.values[k], lost, n) for k, v in values.items()}
        log = np.array(np.broadcast_to(log, (n,)), dtype=float)
        log[lost] = state.log_weight + math.log(share / drawn)
        selection = selection._replace(log_weights=start_weights(selection, lost))
        return values, log, selection, lost.size

    def steps(self, row: Row) -> Sequence[Step]:
        """The steps of a row's slice; a proposal that looks at what is missing does not apply."""
        model, seen, apart = self.plan.slices.later, row.seen, self.plan.apart
        unknown = set(self.plan.slices.dynamic) - {n for n, o in seen.items() if o.mask is None}
        found: list[Step] = []
        for name in self.plan.slices.dynamic:
            prior, aimed = self._prior.get(name), self._aimed.get(name)
            if aimed is not None and unknown & set(aimed.parents):
                aimed = None
            if prior is None:
                found.append(self.plan.step(row, name))
            elif name not in unknown:
                found.append(_Density(model, prior))
            elif aimed is None and name not in seen:
                found.append(Unweighed(model, seen, prior, apart))
            else:  # what is seen of the node, if it is in part, has its density, too
                found += [Aimed(model, seen, aimed or prior, apart), _Density(model, prior)]
            unknown.discard(name)
        return found

    # ---- private -------------------------------------------------------------------------------

    def _check_order(self) -> None:
        """Densities of what is lost cannot look at what is drawn, or weighed, after it."""
        order = self.plan.slices.dynamic
        for name, density in self._prior.items():
            after = [n for n in order[order.index(name) :] if n in density.parents]
            if after:
                raise ModelError(
                    f"Recovery: density= for {name!r} reads {after[0]!r}, which comes after it: give the "
                    "density from before the row is seen (seen values would count twice), and what looks at "
                    f"them as proposal={{{name!r}: ...}}"
                )

    def _ancestors(
        self, earlier: Particles, selection: Selection, lost: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        """Positions in the slice before, for what looks at that."""
        if self._looks_back:
            return pick(earlier.weights, rng.random(lost.size))
        return lost if selection.ancestors is None else selection.ancestors[lost]

    def _begun(
        self,
        row: Row,
        before: Mapping[str, np.ndarray],
        ancestors: np.ndarray,
        rng: np.random.Generator,
    ) -> Pass:
        """A slice of lost particles."""
        known = self.plan.known(row)
        for name, value in before.items():
            same = value.ndim == self._before[name]  # for all particles
            known[name] = value if same else value[ancestors]
        state = Pass(rng, (len(ancestors),), known)
        for step in self.steps(row):
            step(state)
        return state

    def _placed(
        self, name: str, value: np.ndarray, new: np.ndarray, at: np.ndarray, n: int
    ) -> np.ndarray:
        """A node's values with some particles replaced."""
        rank = self._ranks[name]
        if value.ndim == rank and new.ndim == rank:
            return value  # seen, or the same for all
        found = np.array(value if value.ndim > rank else np.broadcast_to(value, (n, *value.shape)))
        found[at] = new
        return found


def given_densities(
    slices: Slices, model: Model, given: Mapping[Key, Any], engine: str, option: str
) -> dict[str, Proposal]:
    """A user's densities of a state that does not come from the slice before, by the nodes they draw.

    Raises
    ------
    UnknownNodeError, ModelError
        Nodes that are not drawn, or one that the next slice reads and that has no density.
    """
    found: dict[str, Proposal] = {}
    for key, spec in given.items():
        for name in names_of(key):
            check_target(slices, name, f"{engine}: {option}= for {key!r}")
        density = bound(engine, model, key, as_function(engine, key, spec, FUNCTION, option))
        found |= dict.fromkeys(density.names, density)
    short = [n for n in slices.interface if slices.later[n].is_stochastic]
    missing = sorted(set(short) - found.keys())
    if missing:
        raise ModelError(
            f"{engine}: {option}= says nothing of {missing[0]!r}, which the next slice reads; "
            "give a density for each of " + ", ".join(map(repr, short))
        )
    return found


def start_weights(selection: Selection, lost: np.ndarray) -> np.ndarray:
    """Log weights that particles start with: the lost have equal parts of what all stand for."""
    found = np.array(np.broadcast_to(selection.log_weights, (selection.particles,)), dtype=float)
    found[lost] = selection.log_normaliser - math.log(selection.particles)
    return found


class Aimed(Propose):
    """Draws from a proposal for a given density, which may be narrower than the node's support."""

    warns = False


class Unweighed(Aimed):
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
