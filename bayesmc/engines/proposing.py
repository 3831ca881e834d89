"""Drawing from proposals: the steps of a pass, and the order they are taken in.

What a proposal draws weighs 1/q here, and p where the net's density comes in as a factor. Nodes are drawn in
an order that respects the proposals; a proposal may even run against the net's arrows, as long as nothing
needs itself.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.engines.proposal import Parts, Proposal
from bayesmc.errors import (
    BayesmcError,
    CycleError,
    DensityError,
    ModelError,
    ShapeError,
    SupportWarning,
    UnsupportedError,
)
from bayesmc.network import CompiledNode, Problem
from bayesmc.network.forward import (
    Pass,
    Step,
    WeighDrawn,
    nothing,
    potential_factors,
    with_factors,
)
from bayesmc.network.model import arguments_of, call, fit, invalid_error
from bayesmc.network.ordering import topological_order
from bayesmc.shapes import Shape


def proposal_steps(
    problem: Problem, steps: Mapping[str, Step], proposals: Sequence[Proposal]
) -> list[Step]:
    """The steps of a pass that draws from proposals where there are some.

    ``steps`` are the plain steps of every node. The net's own density of what was proposed comes in as
    a factor, as soon as its parents have values.
    """
    model = problem.model
    by_target = {name: p for p in proposals for name in p.names}
    ordered: dict[str, Step] = {}
    for name in _order(problem, by_target):
        proposal = by_target.get(name)
        if proposal is None:
            ordered[name] = steps[name]
            continue
        ordered.update(dict.fromkeys(proposal.names, nothing))
        ordered[name] = Propose(problem, proposal)
    factors: list[tuple[Sequence[str], Step]] = [
        ((name, *model[name].parents), WeighDrawn(model, model[name]))
        for name in model.nodes  # parents first: a parent of probability zero excuses its children
        if name in by_target
    ]
    return with_factors(ordered, [*factors, *potential_factors(model)])


class Propose:
    """Draw the targets of one proposal and divide the weight by its density at the draw."""

    def __init__(self, problem: Problem, proposal: Proposal) -> None:
        self.proposal = proposal
        self.model = problem.model
        self.nodes = [problem.model[name] for name in proposal.names]
        self.observed = problem.observed
        self._compared: set[str] = set()

    def __call__(self, state: Pass) -> None:
        with _blaming(self.proposal):
            dist, batch = self._distribution(state)
            if isinstance(dist, Parts):
                for node in self.nodes:
                    self._draw(node, dist.parts[node.name], batch, state)
            elif isinstance(self.proposal.key, str):
                self._draw(self.nodes[0], dist, batch, state)
            else:
                self._draw_split(dist, batch, state)

    def _distribution(self, state: Pass) -> tuple[Distribution, Shape]:
        declaration, links = self.proposal.declaration, self.proposal.links
        arguments, batch = arguments_of(links, state.values)
        plates = tuple(self.model.sizes[p] for p in declaration.plates)
        dist = call(declaration, arguments, batch + plates, links)
        if not isinstance(dist, Distribution):
            raise ModelError(
                f"the function returns an array of shape {np.shape(dist)}; return the distribution to "
                "draw from"
            )
        return dist, batch

    def _draw(self, node: CompiledNode, dist: Distribution, batch: Shape, state: Pass) -> None:
        """Draw a node whose distribution has its batch and plates."""
        _check_kind(node.name, node.is_discrete, node.event_shape, dist)
        fit(node.declaration, dist, batch, node.plate_shape)
        if node.name not in self._compared:
            self._compared.add(node.name)
            self._warn_of_gaps(node, dist)
        alive = _alive(state)
        error = invalid_error(node, dist, alive, state.batch)
        if error is not None:
            raise error
        draws = dist.sample_to(state.rng, state.batch + node.plate_shape)
        log_q = np.broadcast_to(dist.log_prob(draws), state.batch + node.plate_shape)
        seen = self.observed.get(node.name)
        if seen is not None:  # partly observed: only the missing elements were drawn
            assert seen.mask is not None
            log_q = np.where(seen.mask, 0.0, log_q)
        values, outside = _stored(node, draws)
        if seen is not None:
            assert seen.mask is not None
            outside = outside & ~seen.mask
            mask = seen.mask.reshape(seen.mask.shape + (1,) * len(node.event_shape))
            values = np.where(mask, seen.value, values)
        plate_axes = tuple(range(-len(node.plates), 0))
        if plate_axes:
            log_q = log_q.sum(axis=plate_axes)
            outside = np.asarray(outside.any(axis=plate_axes))
        self._divide(log_q, outside, alive, state)
        values.flags.writeable = False
        state.values[node.name] = values

    def _warn_of_gaps(self, node: CompiledNode, dist: Distribution) -> None:
        """Warn where the proposal never reaches what its target may be, as far as supports tell."""
        never = _never_proposed(node, dist)
        if never is not None:
            warnings.warn(
                f"importance sampling: {self.proposal.what} is on {dist.support.describe()} and never gives "
                f"{never}, which {node.name!r} may take; what is never proposed is missing from all answers, "
                "and no weight shows it: propose from a distribution that covers the node's support",
                SupportWarning,
                stacklevel=2,
            )

    def _draw_split(self, dist: Distribution, batch: Shape, state: Pass) -> None:
        """Draw a block as one vector and split it in order."""
        sizes = [math.prod(node.value_shape) for node in self.nodes]
        self._check_vector(dist, sum(sizes))
        fit(self.proposal.declaration, dist, batch, ())
        alive = _alive(state)
        if dist.invalid is not None:
            bad = np.broadcast_to(dist.invalid, state.batch) & alive
            if bad.any() and dist.problem is not None:
                raise dist.problem
        draws = dist.sample_to(state.rng, state.batch)
        outside = np.zeros(state.batch, dtype=bool)
        for node, part in zip(
            self.nodes, np.split(draws, np.cumsum(sizes)[:-1], axis=-1), strict=True
        ):
            values, beyond = _stored(node, part.reshape(state.batch + node.value_shape))
            outside |= beyond.reshape((*state.batch, -1)).any(axis=-1)
            values = np.ascontiguousarray(values)
            values.flags.writeable = False
            state.values[node.name] = values
        log_q = np.broadcast_to(dist.log_prob(draws), state.batch)
        self._divide(log_q, outside, alive, state)

    def _check_vector(self, dist: Distribution, size: int) -> None:
        parts = ", ".join(f"{node.name} {math.prod(node.value_shape)}" for node in self.nodes)
        if dist.event_shape != (size,):
            raise ShapeError(
                f"the distribution draws values of shape {dist.event_shape}, but the block has {size} "
                f"components ({parts}); return one vector of them, or a dict from name to distribution"
            )
        for node in self.nodes:
            _check_kind(node.name, node.is_discrete, (), dist, shaped=False)
            if node.name in self.observed:
                raise UnsupportedError(
                    f"{node.name!r} is partly observed, and a vector cannot be drawn in part; propose "
                    "its missing elements by a dict from name to distribution"
                )

    def _divide(
        self, log_q: np.ndarray, outside: np.ndarray, alive: np.ndarray, state: Pass
    ) -> None:
        """Divide the weight by q; draws outside the target's values have p = 0."""
        ok = np.isfinite(log_q)
        if not ok.all():
            bad = ~ok & alive
            if bad.any():
                raise DensityError(
                    f"the log density at one of its own draws is {log_q[bad].flat[0]}; sample= and "
                    "log_prob of a proposal must describe the same, finite density"
                )
            log_q = np.where(ok, log_q, 0.0)
        state.weigh(-log_q)
        if outside.any():
            state.weigh(np.where(outside, -np.inf, 0.0))


# ---- private ------------------------------------------------------------------------------------


@contextmanager
def _blaming(proposal: Proposal) -> Iterator[None]:
    """What goes wrong inside is the proposal's fault, not the node's."""
    try:
        yield
    except BayesmcError as error:
        node = f"node {proposal.declaration.name!r}"
        text = str(error)
        rest = text.removeprefix(node) if text.startswith(node) else f": {text}"
        error.args = (f"Importance: {proposal.what}{rest}", *error.args[1:])
        raise


def _never_proposed(node: CompiledNode, dist: Distribution) -> str | None:
    """Values of a target, in words, that no draw of its proposal can have; None if none is known."""
    if node.domain is None:
        known = node.support is not None and node.support.is_constant
        if not known or dist.support.covers(node.support):  # type: ignore[arg-type]
            return None
        return f"others of the {node.support.describe()}"  # type: ignore[union-attr]
    values = node.domain.low + np.arange(node.domain.size)
    with np.errstate(all="ignore"):
        at = values.reshape((-1,) + (1,) * len(dist.batch_shape))
        reached = np.isfinite(dist.log_prob(at)).reshape(len(values), -1).any(axis=1)
    missed = [node.domain.states[k] for k in np.flatnonzero(~reached)]
    return (
        ", ".join(map(repr, missed[:5])) + (", ..." if len(missed) > 5 else "") if missed else None
    )


def _check_kind(
    name: str, is_discrete: bool, event_shape: Shape, dist: Distribution, shaped: bool = True
) -> None:
    """A draw must be a value of the target's kind, or its density p is no density of that draw."""
    if bool(dist.is_discrete) != is_discrete:
        kinds = {True: "discrete", False: "continuous"}
        raise ModelError(
            f"{name!r} is {kinds[is_discrete]}, but {type(dist).__name__} is "
            f"{kinds[not is_discrete]}; propose a {kinds[is_discrete]} distribution"
        )
    if shaped and dist.event_shape != event_shape:
        raise ShapeError(
            f"{type(dist).__name__} draws values of shape {dist.event_shape}, but one value of {name!r} "
            f"has shape {event_shape}"
        )


def _stored(node: CompiledNode, draws: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Draws as stored values, and which are no value of a finite node (shape batch and plates)."""
    if node.domain is None:
        return draws, np.zeros(draws.shape[: draws.ndim - len(node.event_shape)], dtype=bool)
    positions = draws - node.domain.low
    outside = (positions < 0) | (positions >= node.domain.size)
    if outside.any():
        positions = np.where(outside, 0, positions)
    return positions.astype(node.domain.dtype), outside


def _alive(state: Pass) -> np.ndarray:
    """Draws whose weight is not zero yet, shape ``batch``."""
    return np.broadcast_to(np.asarray(state.log_weight) > -np.inf, state.batch)


def _order(problem: Problem, by_target: Mapping[str, Proposal]) -> list[str]:
    """Names in an order of drawing, a block by its first name.

    Targets come after their parents in the net where that is possible, so that draws of probability zero
    are known as such before anything else depends on them.
    """
    cycle = CycleError("")
    for after_parents in (True, False):
        try:
            return topological_order(_needs(problem, by_target, after_parents))
        except CycleError as error:
            cycle = error
    partly = [n for n in cycle.path if n in problem.observed]
    hint = f" ({partly[0]!r} is observed only in part, so it is drawn)" if partly else ""
    raise CycleError(
        f"Importance: the proposals need each other in a cycle: {' -> '.join(cycle.path)}{hint}; a "
        "proposal may name evidence, inputs and nodes that do not depend on its targets",
        cycle.path,
    )


def _needs(
    problem: Problem, by_target: Mapping[str, Proposal], after_parents: bool
) -> dict[str, list[str]]:
    """What must have values before each node is drawn."""
    model = problem.model
    known = {n for n, seen in problem.observed.items() if seen.mask is None}
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
