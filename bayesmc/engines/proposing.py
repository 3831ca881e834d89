"""Drawing from proposals: the steps of a pass, and the order they are taken in.

What a proposal draws weighs 1/q here, and p where the net's density comes in as a factor. Nodes are drawn in
an order that respects the proposals; a proposal may even run against the net's arrows, as long as nothing
needs itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.errors import CycleError, UnsupportedError
from bayesmc.kernels.proposal import (
    Parts,
    Proposal,
    blaming,
    check_kind,
    check_vector,
    cut,
    refuse_infinite,
    to_stored,
    warn_of_gaps,
)
from bayesmc.network import CompiledNode, Model, Observed
from bayesmc.network.forward import (
    Pass,
    Step,
    WeighDrawn,
    nothing,
    potential_factors,
    summed,
    with_factors,
)
from bayesmc.network.model import fit, invalid_error
from bayesmc.network.node import topological_order
from bayesmc.shapes import Shape


def proposal_steps(
    model: Model,
    observed: Mapping[str, Observed],
    steps: Mapping[str, Step],
    proposals: Sequence[Proposal],
    apart: tuple[str, ...] = (),
) -> list[Step]:
    """The steps of a pass that draws from proposals where there are some.

    ``steps`` are the plain steps of every node. The net's own density of what was proposed comes in as
    a factor, as soon as its parents have values. Elements of the plates ``apart`` have weights of their own.
    """
    by_target = {name: p for p in proposals for name in p.names}
    ordered: dict[str, Step] = {}
    engine = proposals[0].engine if proposals else ""
    for name in _order(model, observed, by_target, engine):
        proposal = by_target.get(name)
        if proposal is None:
            ordered[name] = steps[name]
            continue
        ordered.update(dict.fromkeys(proposal.names, nothing))
        ordered[name] = Propose(model, observed, proposal, apart)
    factors: list[tuple[Sequence[str], Step]] = [
        ((name, *model[name].parents), WeighDrawn(model, model[name], apart))
        for name in model.nodes  # parents first: a parent of probability zero excuses its children
        if name in by_target
    ]
    return with_factors(ordered, [*factors, *potential_factors(model)])


class Propose:
    """Draw the targets of one proposal and divide the weight by its density at the draw."""

    #: whether a proposal that is narrower than its target is warned of
    warns: ClassVar[bool] = True

    def __init__(
        self,
        model: Model,
        observed: Mapping[str, Observed],
        proposal: Proposal,
        apart: tuple[str, ...] = (),
    ) -> None:
        self.proposal = proposal
        self.model, self.observed, self.apart = model, observed, apart
        self.nodes = [model[name] for name in proposal.names]
        self._compared: set[str] = set() if self.warns else set(proposal.names)

    def __call__(self, state: Pass) -> None:
        with blaming(self.proposal):
            dist, batch = self.proposal.distribution(self.model, state.values)
            if isinstance(dist, Parts):
                for node in self.nodes:
                    self._draw(node, dist.parts[node.name], batch, state)
            elif isinstance(self.proposal.key, str):
                self._draw(self.nodes[0], dist, batch, state)
            else:
                self._draw_split(dist, batch, state)

    def _draw(self, node: CompiledNode, dist: Distribution, batch: Shape, state: Pass) -> None:
        """Draw a node whose distribution has its batch and plates."""
        check_kind(node, dist)
        fit(node.declaration, dist, batch, node.plate_shape)
        if node.name not in self._compared:
            self._compared.add(node.name)
            warn_of_gaps(self.proposal, node, dist)
        alive = state.alive
        error = invalid_error(node, dist, alive, state.batch)
        if error is not None:
            raise error
        draws = dist.sample_to(state.rng, state.batch + node.plate_shape)
        log_q = np.broadcast_to(dist.log_prob(draws), state.batch + node.plate_shape)
        seen = self.observed.get(node.name)
        if seen is not None:  # partly observed: only the missing elements were drawn
            assert seen.mask is not None
            log_q = np.where(seen.mask, 0.0, log_q)
        values, outside = to_stored(node, draws)
        if seen is not None:
            assert seen.mask is not None
            outside = outside & ~seen.mask
            mask = seen.mask.reshape(seen.mask.shape + (1,) * len(node.event_shape))
            values = np.where(mask, seen.value, values)
        if node.plates:
            log_q = summed(log_q, node, self.apart)
            outside = summed(outside.astype(np.intp), node, self.apart) > 0
        self._divide(log_q, outside, alive, state)
        values.flags.writeable = False
        state.values[node.name] = values

    def _draw_split(self, dist: Distribution, batch: Shape, state: Pass) -> None:
        """Draw a block as one vector and split it in order."""
        if self.apart:
            raise UnsupportedError(
                f"{self.proposal.what}: it returns one vector, but elements of plate {self.apart[0]!r} are "
                "filtered separately and need a density each; return a dict, {node: distribution}"
            )
        check_vector(self.nodes, dist, self.observed.keys())
        fit(self.proposal.declaration, dist, batch, ())
        alive = state.alive
        if dist.invalid is not None:
            bad = np.broadcast_to(dist.invalid, state.batch) & alive
            if bad.any() and dist.problem is not None:
                raise dist.problem
        draws = dist.sample_to(state.rng, state.batch)
        outside = np.zeros(state.batch, dtype=bool)
        for node, part in zip(self.nodes, cut(self.nodes, draws), strict=True):
            values, beyond = to_stored(node, part)
            outside |= beyond.reshape((*state.batch, -1)).any(axis=-1)
            values = np.ascontiguousarray(values)
            values.flags.writeable = False
            state.values[node.name] = values
        log_q = np.broadcast_to(dist.log_prob(draws), state.batch)
        self._divide(log_q, outside, alive, state)

    def _divide(
        self, log_q: np.ndarray, outside: np.ndarray, alive: np.ndarray, state: Pass
    ) -> None:
        """Divide the weight by q; draws outside the target's values have p = 0."""
        spare = alive.reshape(alive.shape + (1,) * (log_q.ndim - alive.ndim))
        refuse_infinite(np.where(spare, log_q, 0.0))
        state.weigh(-np.where(np.isfinite(log_q), log_q, 0.0))
        if outside.any():
            state.weigh(np.where(outside, -np.inf, 0.0))


# ---- private ------------------------------------------------------------------------------------


def _order(
    model: Model,
    observed: Mapping[str, Observed],
    by_target: Mapping[str, Proposal],
    engine: str,
) -> list[str]:
    """Names in an order of drawing, a block by its first name.

    Targets come after their parents in the net where that is possible, so that draws of probability zero
    are known as such before anything else depends on them.
    """
    cycle = CycleError("")
    for after_parents in (True, False):
        try:
            return topological_order(_needs(model, observed, by_target, after_parents))
        except CycleError as error:
            cycle = error
    partly = [n for n in cycle.path if n in observed]
    hint = f" ({partly[0]!r} is observed only in part, so it is drawn)" if partly else ""
    raise CycleError(
        f"{engine}: the proposals need each other in a cycle: {' -> '.join(cycle.path)}{hint}; a "
        "proposal may name evidence, inputs and nodes that do not depend on its targets",
        cycle.path,
    )


def _needs(
    model: Model,
    observed: Mapping[str, Observed],
    by_target: Mapping[str, Proposal],
    after_parents: bool,
) -> dict[str, list[str]]:
    """What must have values before each node is drawn."""
    known = {n for n, seen in observed.items() if seen.mask is None}
    needs: dict[str, list[str]] = {}
    for name, node in model.nodes.items():
        proposal = by_target.get(name)
        if proposal is None:
            above = [p for p in node.parents if after_parents or p not in known]
        elif proposal.names[0] != name:
            continue
        else:
            above = [p for p in proposal.parents if p not in known]
            if after_parents:
                above += [p for n in proposal.names for p in model[n].parents]
        first = [by_target[p].names[0] if p in by_target else p for p in above]
        needs[name] = [p for p in dict.fromkeys(first) if p != name]
    return needs
