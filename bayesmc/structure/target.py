"""The posterior up to a constant, as terms over a state: what every kernel of a Markov chain moves on.

A *term* is one log factor of the joint density: a node's conditional density, or a potential. The state
holds stored values of all nodes, hidden ones with a leading axis of chains. What is not part of the chain
is found here, too: nodes on which nothing observed depends are drawn forward afterwards.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BayesmcError, DensityError, TraceError
from bayesmc.expression import Expression
from bayesmc.network import Model, Observed, Problem
from bayesmc.network.expressions import Followed, Opaque, density, log_density_of, log_factor_of
from bayesmc.network.model import invalid_error, potential_shape
from bayesmc.network.probing import depends_on_numbers
from bayesmc.shapes import Shape, broadcast_shapes
from bayesmc.structure.like_functions import FEWEST, Signatures, StackedFunction, Values
from bayesmc.structure.recursion import LinkPlan

#: rows of the states on which functions are compared
_STATES = 6


@dataclass(frozen=True, eq=False)
class Term:
    """One log factor: of a node (its conditional density) or of a potential.

    Attributes
    ----------
    plates : tuple of str
        Its elements; a potential over rows of an index has one nameless plate.
    parents : tuple of str
        What its function reads.
    mask : ndarray of bool or None
        Elements that count: those seen of a partly observed node whose missing ones are drawn forward.
    """

    model: Model = field(repr=False)
    name: str
    plates: tuple[str, ...]
    shape: Shape
    parents: tuple[str, ...]
    is_potential: bool = False
    mask: np.ndarray | None = None

    @property
    def scope(self) -> tuple[str, ...]:
        """The nodes it reads directly, its own among them."""
        return self.parents if self.is_potential else (*self.parents, self.name)

    @cached_property
    def read(self) -> Followed | Opaque:
        """What its function computes of stochastic nodes and inputs."""
        return density(self.model, self.name)

    @cached_property
    def expression(self) -> Expression | None:
        """Its log factors, shape its plates, of stored values of stochastic nodes and inputs.

        None where the function could not be followed, or the family has no closed form. Its mask is left
        to those who sum.
        """
        if isinstance(self.read, Opaque):
            return None
        try:
            if self.is_potential:
                return log_factor_of(self.model, self.name)
            return log_density_of(self.model, self.name)
        except TraceError:
            return None

    @cached_property
    def summaries(self) -> dict[str, Any]:
        """Label -> its sums by that label, or None where they do not suffice (``kernels.label_sums``)."""
        return {}

    @cached_property
    def rejects(self) -> bool:
        """Whether its parameters depend on numbers: points where they are out of range are rejected."""
        return depends_on_numbers(self.model, self.model[self.name])

    def distribution(self, values: Mapping[str, np.ndarray]) -> tuple[Distribution, Shape]:
        """A node's distribution given its parents, and the batch shape of those."""
        return self.model.evaluate(self.name, values)

    def log(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Log factor of every element, shape ``(*lead, *plates)`` (or what broadcasts to it)."""
        if self.is_potential:
            return self.model.potential(self.name, values, total=False)
        dist, batch = self.distribution(values)
        try:
            return self.log_of(dist, batch, values[self.name])
        except DensityError as error:
            shown = f"{error}{self.shown_at(values, error.index)}"
            raise DensityError(shown, error.index) from error

    def shown_at(self, values: Mapping[str, np.ndarray], index: Shape) -> str:
        """The values of the node and its parents at a place of its batch and plates, in words."""
        shown = []
        for name in self.scope[:8]:
            node = self.model[name]
            value = np.asarray(node.decode(values[name]))
            lead = value.ndim - len(node.value_shape)
            batch = index[: len(index) - len(self.plates)][-lead:] if lead else ()
            at = tuple(min(i, n - 1) for i, n in zip(batch, value.shape, strict=False))
            place = dict(zip(self.plates, index[len(index) - len(self.plates) :], strict=False))
            if all(p in place for p in node.plates):
                at += tuple(place[p] for p in node.plates)
            shown.append(_shown(name, value[at]))
        return f"; there {', '.join(shown)}"

    def log_of(self, dist: Distribution, batch: Shape, value: np.ndarray) -> np.ndarray:
        """Log density of stored values under a distribution that was evaluated before.

        Parameters that over- or underflowed have density zero, and so have those out of their range where
        they depend on numbers that a chain moves; of finite parents they are the model's fault and raise.
        """
        node = self.model[self.name]
        if dist.invalid is None:  # the short way, for the innermost of all loops
            known = value if node.domain is None else node.domain.to_support(value)
            result = dist.log_prob_unchecked(known)
            if not result.size or result.max() < np.inf:
                return result if self.mask is None else np.where(self.mask, result, 0.0)
        result = self.model.log_density(self.name, dist, value)
        if dist.invalid is not None:
            if not self.rejects:
                self.refuse_out_of_range(dist, batch, value)
            result = np.where(dist.invalid, -np.inf, result)
        return result if self.mask is None else np.where(self.mask, result, 0.0)

    def refuse_out_of_range(self, dist: Distribution, batch: Shape, value: np.ndarray) -> None:
        """Raise for parameters out of range, unless they over- or underflowed, where a chain is."""
        if dist.problem is not None and dist.problem.is_overflow:
            return
        node = self.model[self.name]
        lead = broadcast_shapes(batch, value.shape[: value.ndim - len(node.value_shape)])
        error = invalid_error(node, dist, np.broadcast_to(True, lead), lead)
        if error is not None:
            raise error


@dataclass(frozen=True, eq=False)
class Target:
    """A posed problem as terms.

    Attributes
    ----------
    chain : tuple of str
        Hidden nodes that something observed depends on, parents first.
    forward : tuple of str
        All other nodes that are not known, parents first: they are computed or drawn from the rest.
    known : dict
        Stored values that never change: inputs, fixed nodes, what was observed, and what follows from it.
    terms : dict
        Name -> ``Term``; those that do not depend on the chain are left out.
    """

    problem: Problem
    chain: tuple[str, ...]
    forward: tuple[str, ...]
    known: Values
    terms: dict[str, Term]
    #: deterministic nodes between the chain and the terms, parents first
    links: tuple[str, ...]
    #: deterministic nodes that stand for like ones, with other constants than the model's
    stacked_links: Mapping[str, StackedFunction] = field(default_factory=dict, repr=False)
    _below: dict[str, tuple[str, ...]] = field(default_factory=dict, repr=False)

    @property
    def model(self) -> Model:
        return self.problem.model

    @property
    def observed(self) -> Mapping[str, Observed]:
        return self.problem.observed

    def seen(self, name: str) -> Observed | None:
        return self.problem.observed.get(name)

    def is_known(self, name: str) -> bool:
        """Whether a node's values never change (of a partly seen one in the chain they do)."""
        return name in self.known and name not in self._inside

    def hidden_above(self, term: Term) -> tuple[str, ...]:
        """Nodes of the chain that a term's function varies with, through deterministic ones, too."""
        model = self.model
        reached = model.above(
            term.parents, lambda n: not (model[n].is_stochastic or self.is_known(n))
        )
        hidden = (n for n in reached if model[n].is_stochastic and not self.is_known(n))
        return self._in_order(hidden)

    def free_elements(self, name: str) -> np.ndarray | None:
        """Flat plate elements of a chain node that are hidden; None where all are."""
        seen = self.seen(name)
        return None if seen is None else np.flatnonzero(~seen.mask)  # type: ignore[operator]

    def is_seen_in_part(self, name: str) -> bool:
        """Whether of some of a chain node's vectors only some components were seen."""
        seen = self.seen(name)
        return seen is not None and seen.parts is not None

    def with_seen(self, name: str, value: np.ndarray) -> np.ndarray:
        """Values of a chain node with what was seen of it put in place."""
        seen = self.seen(name)
        if seen is None:
            return value
        return np.where(seen.numbers(len(self.model[name].event_shape)), seen.value, value)

    @cached_property
    def _inside(self) -> frozenset[str]:
        """The chain."""
        return frozenset(self.chain)

    @cached_property
    def _order(self) -> dict[str, int]:
        """Hidden node -> its place, nodes of the chain and deterministic ones apart."""
        return {name: k for names in (self.chain, self.links) for k, name in enumerate(names)}

    def _in_order(self, names: Iterable[str]) -> tuple[str, ...]:
        """Nodes of the chain, or links, as they stand there; others are left out."""
        found = [n for n in names if n in self._order]
        return tuple(sorted(found, key=self._order.__getitem__))

    @cached_property
    def _link_steps(self) -> dict[tuple[str, ...], LinkPlan]:
        """How some deterministic nodes are recomputed."""
        return {}

    @cached_property
    def _place(self) -> dict[str, int]:
        """Name of a term -> its place among all."""
        return {name: k for k, name in enumerate(self.terms)}

    @cached_property
    def _entered(self) -> dict[str, list[str]]:
        """Node -> names of the terms that it enters directly, in their order."""
        found: dict[str, list[str]] = {}
        for key, term in self.terms.items():
            for name in dict.fromkeys(term.scope):
                found.setdefault(name, []).append(key)
        return found

    @cached_property
    def _link_children(self) -> dict[str, list[str]]:
        """Node -> deterministic nodes between the chain and the terms that read it."""
        found: dict[str, list[str]] = {}
        for link in self.links:
            for parent in dict.fromkeys(self.model[link].parents):
                found.setdefault(parent, []).append(link)
        return found

    def below(self, names: Iterable[str]) -> tuple[str, ...]:
        """Deterministic nodes that follow from some nodes on the way to terms, parents first."""
        key = "\0".join(names)
        found = self._below.get(key)
        if found is None:
            reached: set[str] = set()
            todo = key.split("\0")
            while todo:
                for link in self._link_children.get(todo.pop(), ()):
                    if link not in reached:
                        reached.add(link)
                        todo.append(link)
            found = self._below[key] = self._in_order(reached)
        return found

    def refresh(self, values: Values, moved: Iterable[str]) -> None:
        """Recompute the deterministic nodes that depend on nodes that moved."""
        self.compute(values, self.below(moved))

    def compute(self, values: Values, links: tuple[str, ...]) -> None:
        """Recompute some deterministic nodes, given parents first; many like ones in one call."""
        if len(links) < FEWEST or self.stacked_links:
            for link in links:
                stacked = self.stacked_links.get(link)
                found = self.model.evaluate(link, values) if stacked is None else stacked(values)
                values[link] = found[0]
            return
        steps = self._link_steps.get(links)
        if steps is None:
            steps = self._link_steps[links] = LinkPlan(self, links)
        steps.compute(values)

    @cached_property
    def signatures(self) -> Signatures:
        """What its terms and deterministic nodes are, to find like ones."""
        return Signatures(self)

    @cached_property
    def states(self) -> Values | None:
        """Reachable values of all nodes, to compare functions on, ``(states, *plates, *event)``; or None."""
        model, start = self.model, self.problem.cache.get("start", {})  # of ``mcmc.given``
        values: Values = dict(self.known)
        for name in self.chain:
            shape = model[name].value_shape
            rows = np.broadcast_to(model.probe[name], model.probe_shape + shape).reshape(-1, *shape)
            first = start.get(name, rows[:1]) if start else rows[:0]
            values[name] = np.concatenate([first, rows])[:_STATES]
        try:
            with marking_invalid(), np.errstate(all="ignore"):
                for link in self.links:
                    values[link], _ = model.evaluate(link, values)
        except BayesmcError:
            return None
        return values

    @property
    def first_state(self) -> Values:
        """The first of the reachable values, shape ``(1, *plates, *event)``."""
        assert self.states is not None
        return {n: v if self.is_known(n) else v[:1] for n, v in self.states.items()}

    def terms_of(self, names: Iterable[str]) -> tuple[Term, ...]:
        """The terms that some chain nodes enter, directly or through deterministic nodes."""
        reached = (*names, *self.below(names))
        if len(reached) == 1:
            return tuple(self.terms[t] for t in self._entered.get(reached[0], ()))
        entered = {t for n in reached for t in self._entered.get(n, ())}
        return tuple(self.terms[t] for t in sorted(entered, key=self._place.__getitem__))

    def log_density(
        self,
        values: Mapping[str, np.ndarray],
        terms: Iterable[Term] | None = None,
        log_of: Callable[[Term, Mapping[str, np.ndarray]], np.ndarray] = Term.log,
    ) -> Any:
        """Sum of terms (all of them by default), shape the batch."""
        total: Any = 0.0
        for term in self.terms.values() if terms is None else terms:
            log = log_of(term, values)
            if term.shape:
                lead = log.shape[: log.ndim - len(term.shape)]
                log = np.broadcast_to(log, lead + term.shape)
                log = log.sum(axis=tuple(range(-len(term.shape), 0)))
            total = total + log
        return total


def target_of(problem: Problem, also: Iterable[str] = ()) -> Target:
    """Chain, forward nodes, terms and constants of a posed problem, found once.

    Parameters
    ----------
    also : iterable of str
        Nodes that belong to the chain even where nothing observed depends on them; so do those whose
        density has no sampler, and those of which vectors are seen in part.
    """
    kept: dict[frozenset[str], Target] = problem.cache.setdefault("targets", {})
    key = frozenset(also)
    if key not in kept:
        kept[key] = _target(problem, key)
    return kept[key]


# ---- private ------------------------------------------------------------------------------------


def _target(problem: Problem, also: frozenset[str]) -> Target:
    model, observed = problem.model, problem.observed
    known: Values = dict(problem.inputs)
    varying: set[str] = set()
    for name, node in model.nodes.items():
        seen = observed.get(name)
        if node.kind == "input":
            continue
        if node.kind == "deterministic":
            if varying & set(node.parents):
                varying.add(name)
            else:
                known[name], _ = model.evaluate(name, known)
        elif node.kind == "fixed":
            known[name], _ = model.evaluate(name, known)
        elif seen is not None and seen.mask is None:
            known[name] = seen.value
        elif 0 in node.plate_shape:  # no element of it is hidden
            known[name] = np.zeros(
                node.value_shape, float if node.domain is None else node.domain.dtype
            )
        else:
            varying.add(name)
    also &= varying
    moved = {n for n in varying if model[n].is_stochastic and model[n].unsampled}
    moved |= {n for n, seen in observed.items() if n in varying and seen.parts is not None}
    wanted = _ancestors(model, observed, varying, moved | also)
    chain = tuple(
        n for n, node in model.nodes.items() if n in wanted and n in varying and node.is_stochastic
    )
    inside = set(chain)
    links = tuple(
        n
        for n, node in model.nodes.items()
        if n in varying and n in wanted and not node.is_stochastic
    )
    forward = tuple(n for n in model.nodes if n in varying and n not in inside and n not in links)
    terms = _terms(model, observed, inside, varying)
    for name in forward:
        if name in observed:  # its term reads what was seen; what is missing is masked
            known[name] = observed[name].value
    return Target(problem, chain, forward, known, terms, links)


def _shown(name: str, value: np.ndarray) -> str:
    return f"{name} = {np.array2string(value, precision=6, threshold=6)}"


def _ancestors(
    model: Model, observed: Mapping[str, Observed], varying: set[str], also: set[str]
) -> set[str]:
    """Varying nodes above something observed or a potential, and some besides."""
    wanted = set(also)
    for potential, _ in model.potentials.values():
        wanted |= {p for p in potential.parents if p in varying}
    for name in reversed(list(model.nodes)):
        if name in wanted or (name in observed and 0 not in model[name].plate_shape):
            wanted |= {p for p in model[name].parents if p in varying}
    return wanted


def _terms(
    model: Model, observed: Mapping[str, Observed], inside: set[str], varying: set[str]
) -> dict[str, Term]:
    terms: dict[str, Term] = {}
    for name, node in model.nodes.items():
        if not node.is_stochastic or node.declaration.source == "variable":
            continue
        seen = observed.get(name)
        if name not in inside and (seen is None or not varying & set(node.parents)):
            continue
        if 0 in node.plate_shape:
            continue
        mask = None if name in inside or seen is None else seen.mask
        terms[name] = Term(model, name, node.plates, node.plate_shape, node.parents, mask=mask)
    for name, (potential, _) in model.potentials.items():
        if not varying & set(potential.parents):
            continue
        shape = potential_shape(model.sizes, potential)
        terms[name] = Term(model, name, potential.plates, shape, potential.parents, True)
    return terms
