"""What a template compiles to: slice 0, and two slices in a row.

``Slices.first`` is the model of slice 0. ``Slices.later`` holds a slice, under the nodes' own names, and the
one before, whose nodes are called ``<node>_prev``; only the first half of it, or what takes its place, needs
values for the second to be evaluated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesmc.dbn.by_chance import lags_by_chance
from bayesmc.dbn.names import far_back, meant
from bayesmc.dbn.travelling import Travelling
from bayesmc.distributions.base import marking_invalid
from bayesmc.distributions.support import Support
from bayesmc.errors import (
    BayesmcError,
    DensityError,
    ModelError,
    ParameterError,
    UnknownNodeError,
)
from bayesmc.network import CompiledNode, Model, Node
from bayesmc.network.captured import check_captured
from bayesmc.network.declaring import DeclaredPlates, ModelStore
from bayesmc.network.labels import Domain
from bayesmc.network.node import Declaration, topological_order
from bayesmc.shapes import owned

if TYPE_CHECKING:
    import networkx

#: what the name of a value in the slice before ends in
PREVIOUS = "_prev"
#: the index of the slice
TIME = "t"

_CLOCK = {
    name: Declaration(name, "input", (), (), event_shape=()) for name in (TIME, TIME + PREVIOUS)
}


@dataclass(frozen=True, eq=False)
class Template:
    """Declarations of a template.

    Attributes
    ----------
    later : dict
        Name -> declaration in slices 1, 2, ...; inputs and static nodes among them.
    first : dict
        Name -> declaration in slice 0, of nodes that have another one there.
    inputs, static : tuple of str
    plates : DeclaredPlates
    """

    name: str | None
    later: dict[str, Declaration]
    first: dict[str, Declaration]
    inputs: tuple[str, ...]
    static: tuple[str, ...]
    plates: DeclaredPlates

    @cached_property
    def dynamic(self) -> tuple[str, ...]:
        """Nodes with one value per slice, inputs apart, parents first."""
        apart = {*self.inputs, *self.static}
        own = {n: d for n, d in self.later.items() if n not in apart}
        order = topological_order({n: [p for p in d.parents if p in own] for n, d in own.items()})
        return tuple(order)

    @cached_property
    def interface(self) -> tuple[str, ...]:
        """Nodes whose value the next slice reads."""
        read = {p for d in self.later.values() for p in d.parents if p.endswith(PREVIOUS)}
        return tuple(n for n in self.dynamic if n + PREVIOUS in read)

    def unknown(self, name: str) -> str:
        """That the template has no such node, and which one may be meant."""
        return meant(name, self.later, self.static)

    def check(self) -> None:
        """Refuse parents that are not there, and what has no slice before it in slice 0.

        Raises
        ------
        UnknownNodeError, ModelError
        """
        known = {*self.later, TIME}
        for name, declaration in self.later.items():
            fixed = name in self.static
            for parent in declaration.parents:
                stem = parent.removesuffix(PREVIOUS)
                previous = stem != parent
                if stem not in known or (previous and stem == TIME):
                    far = far_back(parent, self.later, self.static)
                    why = (
                        f", but {far}"
                        if far is not None
                        else (
                            f": {self.unknown(parent)}. Declare it, give the argument a default if it is no "
                            "parent, or name the parents with parents="
                        )
                    )
                    raise UnknownNodeError(f"node {name!r} has the parent {parent!r}{why}")
                if fixed and parent not in self.static:
                    raise ModelError(
                        f"static node {name!r} has the parent {parent!r}, which has another value in every "
                        "slice; static nodes depend on static nodes only"
                    )
                if previous and stem in self.static:
                    raise ModelError(
                        f"node {name!r} has the parent {parent!r}, but {stem!r} is static; it is the same in "
                        f"every slice, so name it {stem!r}"
                    )
                if previous and name not in self.first:
                    raise ModelError(
                        f"node {name!r} reads {parent!r}, which slice 0 does not have; give its density "
                        "there, initial=a distribution, or a function of nodes of the same slice"
                    )
        for name, declaration in self.first.items():
            for parent in declaration.parents:
                if parent.endswith(PREVIOUS) and parent.removesuffix(PREVIOUS) in known:
                    raise ModelError(
                        f"node {name!r}: initial= reads {parent!r}, but before slice 0 there is no slice; "
                        "name nodes of the same slice, inputs or 't'"
                    )
                if parent not in known:
                    raise UnknownNodeError(
                        f"node {name!r}: initial= has the parent {parent!r}: {self.unknown(parent)}"
                    )

    def __getstate__(self) -> dict[str, Any]:
        """Pickles travel without functions."""

        def bare(declarations: Mapping[str, Declaration]) -> dict[str, Declaration]:
            return {n: replace(d, function=None, captured=()) for n, d in declarations.items()}

        state = {**self.__dict__, "later": bare(self.later), "first": bare(self.first)}
        state.pop("_around", None)
        return state

    def check_captured(self) -> None:
        """Refuse functions that read a name which has changed since they were declared."""
        if self._around:
            check_captured(self._around)

    @cached_property
    def _around(self) -> list[Declaration]:
        return [d for d in (*self.later.values(), *self.first.values()) if d.captured]

    @property
    def has_functions(self) -> bool:
        """Whether any density is given by a function; what is not are tables."""
        declared = (*self.later.values(), *self.first.values())
        return any(d.function is not None for d in declared)

    def slice_zero(self) -> dict[str, Declaration]:
        """Declarations of slice 0."""
        return {TIME: _CLOCK[TIME], **{n: self.first.get(n, d) for n, d in self.later.items()}}

    def two_slices(self) -> dict[str, Declaration]:
        """Declarations of a slice and of the one before, as if that were slice 0."""

        def before(name: str) -> str:
            return name if name in self.static else name + PREVIOUS

        zero = {
            before(n): replace(d, name=before(n), parents=tuple(map(before, d.parents)))
            for n, d in self.slice_zero().items()
        }
        return {**zero, TIME: _CLOCK[TIME], **self.later}

    def graph(self) -> networkx.DiGraph:
        """The two-slice template as a networkx graph."""
        import networkx

        self.check()
        graph = networkx.DiGraph(name=self.name or "")
        read = {p for d in self.later.values() for p in d.parents}
        for name, declaration in self.later.items():
            about = {"source": declaration.source, "plates": declaration.plates}
            graph.add_node(name, slice="static" if name in self.static else "now", **about)
            if name + PREVIOUS in read:
                graph.add_node(name + PREVIOUS, slice="prev", **about)
        for name, declaration in self.later.items():
            graph.add_edges_from((p, name) for p in declaration.parents if p != TIME)
        return graph


@dataclass(frozen=True, eq=False)
class Slices(Travelling):
    """A compiled template.

    Attributes
    ----------
    first : Model
        Slice 0: nodes under their own names, ``t``, inputs and static nodes.
    later : Model
        A slice and the one before it: the same, and ``<node>_prev``, ``t_prev``, ``<input>_prev``.
    """

    template: Template
    first: Model
    later: Model

    def model(self, t: int) -> Model:
        """The model of slice ``t``."""
        return self.first if t == 0 else self.later

    @property
    def dynamic(self) -> tuple[str, ...]:
        """Nodes of a slice, inputs apart, parents first."""
        return self.template.dynamic

    @property
    def interface(self) -> tuple[str, ...]:
        """Nodes whose value the next slice reads."""
        return self.template.interface

    @property
    def stochastic(self) -> tuple[str, ...]:
        """Nodes of a slice that have a density."""
        return tuple(n for n in self.dynamic if self.first[n].is_stochastic)


class SliceStore:
    """Compiles a template as it stands, and remembers the last few models of both kinds."""

    def __init__(self, template: Template) -> None:
        self.template = template
        #: values that computed nodes shall have
        self._domains: dict[str, Domain] = {}
        #: for later slices, of nodes that slice 0 draws and functions compute
        self._lags: dict[str, Declaration] = {}
        self._two: ModelStore | None = None
        self._one: ModelStore | None = None
        self._found: dict[tuple[int, int], Slices] = {}

    def slices(self, sizes: Mapping[str, int], inputs: Mapping[str, np.ndarray]) -> Slices:
        """Both models for these plate sizes; ``inputs`` hold ``u`` and ``u_prev`` of two slices in a row."""
        self.template.check_captured()
        now = {n: inputs[n] for n in inputs if n in self.template.inputs}
        at_zero = {n: inputs.get(n + PREVIOUS, v) for n, v in now.items()}
        for _ in range(_ROUNDS):
            one, two = self._stores()
            zero, t = (owned(np.asarray(k)) for k in (0, 1))
            first = one.model(sizes, {TIME: zero, **at_zero})
            later = two.model(sizes, {TIME: t, TIME + PREVIOUS: zero, **inputs})
            key = (id(first), id(later))
            if key in self._found:
                return self._found[key]
            if self._find_lags(first, later):
                continue
            domains = _computed_domains(self.template, first, later)
            domains |= _counts_that_vary(self.template, first, later)
            if not domains:
                break
            self._settle(domains)
        else:  # values without end, such as a count of slices
            self._settle(dict.fromkeys(domains, _UNCOUNTED))
            return self.slices(sizes, inputs)
        _check_alike(self.template, first, later)
        while len(self._found) >= 8:
            self._found.pop(next(iter(self._found)))
        found = self._found[key] = Slices(self._drawn(), first, later)
        return found

    def probe(self, sizes: Mapping[str, int | None]) -> Slices:
        """Both models when nobody has given data: open plates and inputs get stand-ins."""
        self._stores()
        settled = {p: n if n is not None else _OPEN + k for k, (p, n) in enumerate(sizes.items())}
        inputs = self._stand_ins(settled)
        try:
            return self.slices(settled, inputs)
        except (ModelError, ParameterError, DensityError):  # inputs may have to be integers
            if not inputs:
                raise
            ones = {n: owned(np.ones(v.shape, dtype=int)) for n, v in inputs.items()}
            return self.slices(settled, ones)

    def validate(self, slices: Slices) -> None:
        """Refuse functions that break the array rules."""
        one, two = self._stores()
        one.validate(slices.first)
        two.validate(slices.later)

    def record(self, name: str, sizes: Mapping[str, int | None]) -> Node:
        """The public view of a node."""
        node = self.probe(sizes).later[name].record()
        return replace(node, kind="static") if name in self.template.static else node

    def _find_lags(self, first: Model, later: Model) -> bool:
        """Whether there are nodes, drawn in slice 0 and computed later, that must be compiled again."""
        known, drawn = self.template.first, first.nodes
        lags = [n for n in known if drawn[n].is_stochastic and not later[n].is_stochastic]
        if lags:
            own = {n: self.template.later[n] for n in lags}
            self._lags.update(lags_by_chance(own, first, later))
            self._one = self._two = None
        return bool(lags)

    def _drawn(self) -> Template:
        """The template with every node drawn in all slices, or in none."""
        if not self._lags:
            return self.template
        return replace(self.template, later={**self.template.later, **self._lags})

    def _settle(self, domains: Mapping[str, Domain]) -> None:
        """Compile again, with the values that computed nodes have in any slice."""
        self._domains.update(domains)
        self._one = self._two = None

    def _stores(self) -> tuple[ModelStore, ModelStore]:
        if self._one is None or self._two is None:
            self.template.check()
            template = self._drawn()
            if self._domains:

                def settled(given: Mapping[str, Declaration]) -> dict[str, Declaration]:
                    return {n: replace(d, domain=self._domains.get(n)) for n, d in given.items()}

                template = replace(
                    template, later=settled(template.later), first=settled(template.first)
                )
            self._one = ModelStore(template.name, template.slice_zero(), {}, template.plates)
            self._two = ModelStore(template.name, template.two_slices(), {}, template.plates)
        return self._one, self._two

    def _stand_ins(self, sizes: Mapping[str, int]) -> dict[str, np.ndarray]:
        rng, found = np.random.default_rng(3), {}
        for name in self.template.inputs:
            declaration = self.template.later[name]
            shape = tuple(sizes[p] for p in declaration.plates) + declaration.event_shape
            for key in (name, name + PREVIOUS):
                found[key] = owned(1.0 + rng.random(shape))
        return found


# ---- private ------------------------------------------------------------------------------------

#: size of the first plate that nobody has given a size yet
_OPEN = 3
#: times that models are compiled to find all values of computed nodes
_ROUNDS = 6


#: of a computed node whose values are not counted
_UNCOUNTED = Domain(0)


def _computed_domains(template: Template, first: Model, later: Model) -> dict[str, Domain]:
    """For computed nodes that have other finite values in slice 0 than later, the values of both."""
    found = {}
    for name in template.dynamic:
        nodes = [(first, first[name]), (later, later[name])]
        if any(n.is_stochastic or n.declaration.states is not None for _, n in nodes):
            continue
        values = [_values(model, node) for model, node in nodes]
        if all(node.domain is None for _, node in nodes):
            continue
        if any(v is None for v in values):
            found[name] = _UNCOUNTED
            continue
        union: np.ndarray = np.unique(np.concatenate([v for v in values if v is not None]))
        held = [None if node.domain is None else node.domain.numbers for _, node in nodes]
        if not all(h is not None and np.array_equal(h, union) for h in held):
            union.flags.writeable = False
            found[name] = Domain(len(union), values=union)
    return found


def _counts_that_vary(template: Template, first: Model, later: Model) -> dict[str, Domain]:
    """Drawn nodes whose values are as many as an input or the time says: no finite set serves all slices."""
    found = {}
    given = {n + end for n in (*template.inputs, TIME) for end in ("", PREVIOUS)}
    for model in (first, later):
        for name in template.later:
            node = model.nodes.get(name)
            if node is None or not node.is_stochastic or node.domain is None:
                continue
            read = given & set(node.parents) & set(model.probe)
            plain = read and node.domain.labels is None
            moved = _support_further(model, name, read) if plain else None
            if moved is not None and moved != node.support:
                found[name] = _UNCOUNTED
    return found


def _values(model: Model, node: CompiledNode) -> np.ndarray | None:
    """Values of a computed node: of its domain, or of a constant."""
    if node.domain is not None:
        return node.domain.numbers
    if node.parents or node.event_shape:
        return None
    value = np.asarray(model.probe[node.name])
    return np.unique(value) if value.dtype.kind in "biu" else None


def _support_further(model: Model, name: str, parents: set[str]) -> Support | None:
    """Where a node's mass lies with some parents' values larger; None where that goes wrong."""
    moved = {p: np.asarray(model.probe[p]) + 3 for p in parents}
    try:
        with marking_invalid(), np.errstate(all="ignore"):
            dist, _ = model.evaluate(name, {**model.probe, **moved})
    except BayesmcError:  # a function of the user's, at values that need not be possible
        return None
    return dist.support if dist.invalid is None else None


def _check_alike(template: Template, first: Model, later: Model) -> None:
    """Refuse a node that is another thing in slice 0 than later."""
    for name in template.first:
        for (one, gives), (other, has) in zip(_face(first[name]), _face(later[name]), strict=True):
            if one != other:
                raise ModelError(f"node {name!r}: initial= gives {gives}, its function {has}")


def _face(node: CompiledNode) -> list[tuple[Any, str]]:
    """What must be the same of a node in all slices, each with words for it."""
    lag = "by chance a lag is Bernoulli(1.0 * s_prev) or Normal(x_prev, 0.0)"
    chance = "a distribution" if node.is_stochastic else f"values without chance ({lag})"
    states = node.domain.states if node.domain is not None and node.is_stochastic else None
    return [
        (node.is_stochastic, chance),
        (node.event_shape, f"values of shape {node.event_shape}"),
        ((states, node.is_discrete), f"values on {_on(node)}"),
        (node.is_object, "objects" if node.is_object else "numbers"),
    ]


def _on(node: Any) -> str:
    if node.domain is not None:
        return f"{node.domain.size} states"
    return node.support.describe() if node.support is not None else "a support that varies"
