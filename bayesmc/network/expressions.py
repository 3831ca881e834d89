"""Densities of a model as expressions of its stochastic nodes, checked against the functions themselves."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.errors import BayesmcError, TraceError
from bayesmc.expression import (
    Constant,
    Expression,
    Family,
    Program,
    TracedArray,
    broadcast,
    call,
    constant,
    elementwise,
    expressions_of,
    gather,
    leaf,
    mapped,
    replaced,
)
from bayesmc.network.calling import Aligner, RowAligner
from bayesmc.network.model import CompiledNode, Model, deterministic_above, potential_shape
from bayesmc.network.node import Numbered, identity
from bayesmc.network.readings import (
    VARIANTS,
    Argument,
    Probe,
    Reading,
    hold_against,
    hold_form,
    numbers_of,
    read_function,
    read_table,
)
from bayesmc.passes.log_density import family_of, has_own_form, log_density

#: readings of one shape, and uses of one reading, that are checked at all probe points
_CHECKED = 3


@dataclass(frozen=True, eq=False)
class Followed:
    """A function of a model, read once.

    Attributes
    ----------
    reading : Reading
        What the function computes of its arguments; nodes that share a function share it.
    parents : tuple of str
        The nodes that the function receives.
    arguments : tuple of Argument
        How it receives them.
    numbers : tuple of ndarray
        What stands for the reading's ``number 0``, ...
    cut : frozenset of str
        Deterministic nodes that are leaves, with what they store.
    """

    model: Model
    reading: Reading
    parents: tuple[str, ...] = ()
    arguments: tuple[Argument, ...] = ()
    numbers: tuple[np.ndarray, ...] = ()
    cut: frozenset[str] = frozenset()

    @cached_property
    def result(self) -> Any:
        """A Family or Distribution, the value of a deterministic node, or a log factor.

        Of the stored values of stochastic nodes and inputs: deterministic nodes are substituted.
        """
        instead: dict[Expression, Expression] = dict(self.inside)
        for parent, argument in zip(self.parents, self.arguments, strict=True):
            node = self.model[parent]
            if argument.known is not None:
                continue
            instead.setdefault(argument.leaf, _stored_value(self.model, parent, self.cut))
            follows = node.kind == "deterministic" and parent not in self.cut
            if follows and node.domain and node.domain.labels is None:
                value = value_of(self.model, parent, self.cut)
                instead[numbers_of(argument.leaf, node.domain)] = value
        return mapped(self.reading.result, lambda e: replaced(e, instead))

    @cached_property
    def inside(self) -> dict[Expression, Expression]:
        """The numbers in the function, by their leaves in the reading."""
        return {
            leaf(f"number {k}", n.shape, n.dtype): constant(n) for k, n in enumerate(self.numbers)
        }

    @cached_property
    def leaves(self) -> frozenset[str]:
        """Names of the nodes that it depends on."""
        return frozenset().union(*(e.leaves for e in expressions_of(self.result)))

    def local(self, values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Stored values by the names of the reading's leaves."""
        found = {
            f"argument {a.place}": values[p]
            for p, a in zip(self.parents, self.arguments, strict=True)
        }
        return {**found, **{f"number {k}": n for k, n in enumerate(self.numbers)}}


@dataclass(frozen=True, eq=False)
class Opaque:
    """A function of a model that could not be followed.

    Attributes
    ----------
    reason : str
    leaves : frozenset of str
        The nodes that it depends on, through deterministic ones.
    """

    reason: str
    leaves: frozenset[str]


def density(model: Model, name: str, cut: frozenset[str] = frozenset()) -> Followed | Opaque:
    """What a node's function, or a potential's, computes; it is read, and checked, once for each model.

    Deterministic nodes in ``cut`` are leaves as stochastic ones are, others are substituted.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.network.expressions import density
    >>> net = bmc.BayesNet()
    >>> net.add("a", bmc.Normal(0.0, 1.0))
    >>> net.add("b", lambda a: 2 * a)
    >>> net.add("y", lambda b: bmc.Normal(b, 1.0))
    >>> density(net.model({}, {}), "y").result.parameters["loc"]
    <Elementwise multiply ()>
    """
    known = model.cache.setdefault("expressions", {})
    if name not in known:
        for above in deterministic_above(model, name, known):
            known[above] = found = _read(model, above)
            if isinstance(found, Followed):
                _ = found.result  # one after the other, however many follow from each other
        known[name] = _read(model, name)
    found = known[name]
    if not cut or cut.isdisjoint(deterministic_above(model, name, ())):
        return found
    if (name, cut) not in known:
        if isinstance(found, Followed):
            # a leaf that has one value in this model may have others where it is cut
            anew = found.arguments != _arguments(model, _links(model, name), cut)
            known[name, cut] = _read(model, name, cut) if anew else replace(found, cut=cut)
        else:
            known[name, cut] = Opaque(found.reason, _leaves_above(model, name, cut))
    return known[name, cut]


def log_density_of(model: Model, name: str, cut: frozenset[str] = frozenset()) -> Expression:
    """The log density of a stochastic node at its stored value, shape its plates.

    Deterministic nodes in ``cut`` are leaves.

    Raises
    ------
    TraceError
        Its function cannot be followed, or its family has no closed form.
    """
    node, found = model[name], density(model, name, cut)
    if isinstance(found, Opaque):
        raise TraceError(f"node {name!r}: {found.reason}")
    family = found.result
    if isinstance(family, Distribution):
        family = family_of(family)
    value: Expression = stored_leaf(model, node)
    if node.domain is not None and node.domain.low:
        value = elementwise(np.add, value, node.domain.low)
    result = broadcast(log_density(family, value), node.plate_shape)
    if has_own_form(family):
        hold_form(model, name, result)
    return result


def density_at(model: Model, name: str, given: Mapping[str, np.ndarray]) -> Any:
    """What a node's function computes where some parents have other stored values, of any plate sizes.

    So a function of a label is read at every label in place of every element: whether that says the same
    is the caller's to check, as it is here not.

    Parameters
    ----------
    given : mapping
        Stochastic parent -> whole numbers with its plates' axes.

    Raises
    ------
    TraceError
        The function cannot be followed, or does not broadcast so.
    """
    _refuse_objects(model, name)
    node = model[name]
    declaration, links = node.declaration, node.links
    if declaration.vectorize or declaration.value is not None:
        raise TraceError("it is called element by element, or not at all")
    parents = tuple(parent for parent, _ in links)
    arguments = tuple(
        replace(a, known=constant(given[parent])) if parent in given else a
        for a, parent in zip(_arguments(model, links), parents, strict=True)
    )
    try:
        if declaration.probs is not None:
            reading = read_table(declaration.probs, arguments, links)
        else:
            is_steady = isinstance(density(model, name), Followed)
            function = declaration.function
            reading = read_function(function, arguments, links, is_steady=is_steady)
        found = Followed(model, reading, parents, arguments).result
        found = family_of(found) if isinstance(found, Distribution) else found
        if isinstance(found, Family):
            np.broadcast_shapes(*_batches(found))  # an array of the function's own may fit no more
    except (BayesmcError, ValueError, IndexError) as error:
        raise TraceError(str(error)) from error
    return found


def log_factor_of(model: Model, name: str) -> Expression:
    """A potential's log factors, shape its plates or the rows of its index.

    Raises
    ------
    TraceError
        Its function cannot be followed.
    """
    found = density(model, name)
    if isinstance(found, Opaque):
        raise TraceError(f"potential {name!r}: {found.reason}")
    return broadcast(found.result, potential_shape(model.sizes, model.potentials[name][0]))


def value_of(model: Model, name: str, cut: frozenset[str] = frozenset()) -> Expression:
    """The user value of a deterministic node; a call of its function where that cannot be followed."""
    node = model[name]
    found = density(model, name, cut)
    if isinstance(found, Followed):
        return broadcast(found.result, node.value_shape)
    _refuse_objects(model, name)
    parents = tuple(dict.fromkeys(node.parents))
    operands = [_stored_value(model, p, cut) for p in parents]
    stored = call(NodeCall(model, name, parents), operands, node.value_shape, _dtype(model, node))
    if node.domain is None or node.domain.labels is not None:
        return stored
    return numbers_of(stored, node.domain)


def stored_leaf(model: Model, node: CompiledNode) -> Expression:
    """A node's stored value as a leaf."""
    states = None if node.domain is None else node.domain.size
    return leaf(node.name, node.value_shape, _dtype(model, node), states)


# ---- private ------------------------------------------------------------------------------------


def _batches(family: Family) -> Iterator[tuple[int, ...]]:
    """Shapes of a family's parameters, without those of an event."""
    for name, ndim in getattr(family.make, "parameter_ndim", {}).items():
        value = family.parameters.get(name)
        if isinstance(value, Expression):
            yield value.shape[: len(value.shape) - ndim]


@dataclass(frozen=True, eq=False)
class NodeCall:
    """A deterministic node's function, on stored values of its parents."""

    model: Model
    name: str
    parents: tuple[str, ...]

    def __call__(self, *values: np.ndarray) -> np.ndarray:
        return self.model.evaluate(self.name, dict(zip(self.parents, values, strict=True)))[0]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, NodeCall) and other.model is self.model and other.name == self.name

    def __hash__(self) -> int:
        return hash((id(self.model), self.name))

    def __str__(self) -> str:
        return self.name


def _dtype(model: Model, node: CompiledNode) -> Any:
    if node.kind in ("input", "fixed") and node.domain is None:
        kind = model.probe[node.name].dtype.kind
        return {"b": bool, "i": int, "u": int}.get(kind, float)
    return int if node.is_discrete or node.domain is not None else float


def _stored_value(model: Model, name: str, cut: frozenset[str]) -> Expression:
    """A node's stored value; that of a deterministic one follows from others, or is cut."""
    node = model[name]
    if node.kind != "deterministic" or name in cut:
        return stored_leaf(model, node)
    value = value_of(model, name, cut)
    if node.domain is None or node.domain.labels is not None:
        return value
    numbers = node.domain.numbers
    assert numbers is not None
    order = np.argsort(numbers)
    found: Any = np.searchsorted(numbers[order], TracedArray(value))
    return gather(constant(order), found.expression)


def _read(model: Model, name: str, cut: frozenset[str] = frozenset()) -> Followed | Opaque:
    ways = (True, False) if isinstance(_function(model, name), Numbered) else (False,)
    reason = ""
    for for_all_numbers in ways:
        try:
            found = _shared(model, name, for_all_numbers, cut)
            _check(model, name, found)
            return found
        except TraceError as error:
            reason = str(error)
    return Opaque(reason, _leaves_above(model, name, cut))


def _refuse_objects(model: Model, name: str) -> None:
    """Refuse to follow what has to do with objects: expressions are of numbers."""
    if not any(node.is_object for node in model.nodes.values()):
        return
    for other in (name, *model.parents(name), *deterministic_above(model, name, ())):
        if other in model.nodes and model[other].is_object:
            raise TraceError(f"it depends on {other!r}, whose values are objects")


def _function(model: Model, name: str) -> Any:
    if name in model.nodes:
        return model[name].declaration.function
    return model.potentials[name][0].function


def _leaves_above(model: Model, name: str, cut: frozenset[str] = frozenset()) -> frozenset[str]:
    inside = [name, *deterministic_above(model, name, cut)]
    return frozenset(p for n in inside for p in model.parents(n)).difference(inside)


def _links(model: Model, name: str) -> Sequence[tuple[str, Aligner]]:
    return model[name].links if name in model.nodes else model.potentials[name][1]


def _shared(model: Model, name: str, for_all_numbers: bool, cut: frozenset[str]) -> Followed:
    """What is read of a function, which nodes that have it in the same way share."""
    _refuse_objects(model, name)
    function, table = _function(model, name), None
    if name in model.nodes:
        node = model[name]
        declaration, links, plates = node.declaration, node.links, node.plates
        if declaration.value is not None:
            return Followed(model, Reading(constant(declaration.value)))
        if declaration.vectorize:
            raise TraceError("it is called element by element (vectorize=True)")
        table = declaration.probs
    else:
        potential, links = model.potentials[name]
        plates = potential.plates
    parents = tuple(parent for parent, _ in links)
    arguments = _arguments(model, links, cut)
    what: Hashable
    if table is not None:
        what = table.shape, table.tobytes()
    elif for_all_numbers:
        what = identity(function.func), function.places
    else:
        what = identity(function)
    known = model.cache.setdefault("readings", {})
    key = what, plates, arguments
    if key not in known:
        try:
            if table is not None:
                known[key] = read_table(table, arguments, links)
            else:
                known[key] = read_function(function, arguments, links, for_all_numbers)
        except TraceError as error:
            known[key] = error
    reading = known[key]
    if isinstance(reading, TraceError):
        raise reading
    stochastic = name in model.nodes and model[name].is_stochastic
    if stochastic != isinstance(reading.result, (Family, Distribution)):
        raise TraceError(f"it returns {type(reading.result).__name__}")
    numbers = (np.asarray(function.number),) if for_all_numbers else ()
    return Followed(model, reading, parents, arguments, numbers, cut)


def _arguments(
    model: Model, links: Sequence[tuple[str, Aligner]], cut: frozenset[str] = frozenset()
) -> tuple[Argument, ...]:
    first: dict[str, int] = {}
    return tuple(
        _argument(model, first.setdefault(parent, k), parent, link, cut)
        for k, (parent, link) in enumerate(links)
    )


def _argument(
    model: Model, place: int, parent: str, link: Aligner, cut: frozenset[str]
) -> Argument:
    node = model[parent]
    domain = node.domain
    known, dtype = None, np.dtype(_dtype(model, node))
    if node.kind == "deterministic" and domain is None:
        value = value_of(model, parent) if parent in cut else value_of(model, parent, cut)
        is_fixed = isinstance(value, Constant) and parent not in cut
        known, dtype = value if is_fixed else None, value.dtype
    states = None if domain is None else domain.size
    rows = link.flat.tobytes() if isinstance(link, RowAligner) else None
    how = node.plates, node.event_shape, link.domain is None, domain and domain.key, rows
    return Argument(place, node.value_shape, dtype.str, states, how, known)


def _check(model: Model, name: str, found: Followed) -> None:
    """Refuse a reading that gives something else than the function at probe points.

    A function of its own is checked whatever it is like, a shared one a few times.
    """
    times = model.cache.setdefault("expressions checked", {})
    reading = found.reading
    alike = next(times.setdefault(reading.key, count()))
    uses = next(times.setdefault(id(reading), count()))
    if alike < _CHECKED:
        through = any(model[p].kind == "deterministic" for p in found.parents)
        for variant in range(len(VARIANTS)):
            values = Probe.of(model, variant)
            hold_against(model, name, reading.result, reading.program, found.local, values)
            if through:
                whole = Program(list(expressions_of(found.result)))
                hold_against(model, name, found.result, whole, lambda values: values, values)
    elif found.numbers or not uses & (uses - 1):  # another number, or function; else now and then
        values = Probe.of(model, len(VARIANTS) - 1)
        hold_against(model, name, reading.result, reading.program, found.local, values)
