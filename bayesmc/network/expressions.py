"""Densities of a model as expressions of its stochastic nodes, checked against the functions themselves."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions import Categorical, Density, Distribution, as_distribution
from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BayesmcError, TraceError
from bayesmc.expression import (
    Expression,
    Family,
    Program,
    TracedArray,
    TracedStates,
    broadcast,
    call,
    constant,
    elementwise,
    expressions_of,
    gather,
    leaf,
    rebuilt,
    trace,
)
from bayesmc.network.align import Aligner
from bayesmc.network.domain import Domain
from bayesmc.network.model import CompiledNode, Model
from bayesmc.passes.log_density import family_of, has_own_form, log_density
from bayesmc.passes.templates import template
from bayesmc.plates import PlateArray
from bayesmc.shapes import Shape

#: how far an expression may be off what the function gives, relative to the largest entry
_RTOL = 1e-11
#: nodes with one function, such as slices of a template, that are checked
_CHECKED = 3


@dataclass(frozen=True, eq=False)
class Followed:
    """A function of a model, read once.

    Attributes
    ----------
    result : Family, Expression or Distribution
        A density, the value of a deterministic node or a log factor, of the stored values of stochastic
        nodes and inputs; a distribution that depends on none.
    """

    result: Any

    @property
    def leaves(self) -> frozenset[str]:
        """Names of the nodes that it depends on."""
        return frozenset().union(*(e.leaves for e in expressions_of(self.result)))


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


def density(model: Model, name: str) -> Followed | Opaque:
    """What a node's function computes; it is read, and checked, once for each model."""
    known = model.cache.setdefault("expressions", {})
    if name not in known:
        known[name] = _read(model, name)
    return known[name]


def log_density_of(model: Model, name: str) -> Expression:
    """The log density of a stochastic node at its stored value, shape its plates.

    Raises
    ------
    TraceError
        Its function cannot be followed, or its family has no closed form.
    """
    node, found = model[name], density(model, name)
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
        _check_form(model, node, result)
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
    try:
        found = _traced(model, model[name], given)
    except (BayesmcError, ValueError, IndexError) as error:
        raise TraceError(str(error)) from error
    return family_of(found) if isinstance(found, Distribution) else found


def argument(
    model: Model, parent: str, link: Aligner, given: Mapping[str, np.ndarray] | None = None
) -> Any:
    """The stand-in that a function receives for a parent."""
    node = model[parent]
    if given and parent in given:
        value: Any = _decoded(TracedArray(constant(given[parent])), link)
    elif node.kind == "deterministic":
        value = TracedArray(value_of(model, parent))
        labels = None if node.domain is None else node.domain.labels
        value = value if labels is None else TracedStates(value, labels)
    else:
        value = _decoded(TracedArray(stored_leaf(model, node)), link)
    placed = link.place(value)
    if link.foreign:
        return PlateArray(placed, link.foreign, link.own, link.event_ndim)
    return placed


def value_of(model: Model, name: str) -> Expression:
    """The user value of a deterministic node; a call of its function where that cannot be followed."""
    node = model[name]
    found = density(model, name)
    if isinstance(found, Followed):
        return broadcast(found.result, node.value_shape)
    parents = tuple(dict.fromkeys(node.parents))
    operands = [
        _stored_value(model, p)
        if model[p].kind == "deterministic"
        else stored_leaf(model, model[p])
        for p in parents
    ]
    stored = call(_NodeCall(model, name, parents), operands, node.value_shape, _dtype(model, node))
    return stored if node.domain is None else _decoded_values(stored, node)


def stored_leaf(model: Model, node: CompiledNode) -> Expression:
    """A node's stored value as a leaf."""
    states = None if node.domain is None else node.domain.size
    return leaf(node.name, node.value_shape, _dtype(model, node), states)


# ---- private ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _NodeCall:
    """A deterministic node's function, on stored values of its parents."""

    model: Model
    name: str
    parents: tuple[str, ...]

    def __call__(self, *values: np.ndarray) -> np.ndarray:
        return self.model.evaluate(self.name, dict(zip(self.parents, values, strict=True)))[0]

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, _NodeCall) and other.model is self.model and other.name == self.name
        )

    def __hash__(self) -> int:
        return hash((id(self.model), self.name))

    def __str__(self) -> str:
        return self.name


def _dtype(model: Model, node: CompiledNode) -> Any:
    if node.kind in ("input", "fixed") and node.domain is None:
        kind = model.probe[node.name].dtype.kind
        return {"b": bool, "i": int, "u": int}.get(kind, float)
    return int if node.is_discrete or node.domain is not None else float


def _decoded(stored: TracedArray, link: Aligner) -> Any:
    """User values of stored ones, as a link hands them on."""
    domain = link.domain
    if domain is None:
        return stored
    if domain.labels is not None:
        return TracedStates(stored, domain.labels)
    return TracedArray(_numbers(stored.expression, domain))


def _numbers(stored: Expression, domain: Domain) -> Expression:
    """Numeric user values of positions."""
    if domain.values is not None:
        return gather(constant(domain.values), stored)
    return elementwise(np.add, stored, domain.low) if domain.low else stored


def _decoded_values(stored: Expression, node: CompiledNode) -> Expression:
    assert node.domain is not None
    if node.domain.labels is not None:
        return stored
    return _numbers(stored, node.domain)


def _stored_value(model: Model, name: str) -> Expression:
    """The stored value of a deterministic node."""
    node = model[name]
    value = value_of(model, name)
    if node.domain is None or node.domain.labels is not None:
        return value
    numbers = node.domain.numbers
    assert numbers is not None
    order = np.argsort(numbers)
    found: Any = np.searchsorted(numbers[order], TracedArray(value))
    return gather(constant(order), found.expression)


def _read(model: Model, name: str) -> Followed | Opaque:
    node = model[name]
    try:
        result = _traced(model, node)
        if node.is_stochastic and not isinstance(result, (Family, Distribution)):
            raise TraceError(f"it returns {type(result).__name__}")
        if isinstance(result, Density) and node.links:
            raise TraceError("its Density may read parents where that cannot be seen")
        found = Followed(result)
        if not _is_known(model, node, found):
            _check(model, node, found)
        return found
    except TraceError as error:
        return Opaque(str(error), _leaves_above(model, name))


def _leaves_above(model: Model, name: str) -> frozenset[str]:
    found: frozenset[str] = frozenset()
    for parent in model[name].parents:
        above = _leaves_above(model, parent) if model[parent].kind == "deterministic" else {parent}
        found = found | above
    return found


def _traced(model: Model, node: CompiledNode, given: Mapping[str, np.ndarray] | None = None) -> Any:
    declaration = node.declaration
    if declaration.value is not None:
        return constant(declaration.value)
    if declaration.probs is not None:
        return _of_table(model, node, given or {})
    if declaration.vectorize:
        raise TraceError("it is called element by element (vectorize=True)")
    assert declaration.function is not None
    arguments = [argument(model, parent, link, given) for parent, link in node.links]
    return trace(declaration.function, arguments)


def _of_table(model: Model, node: CompiledNode, given: Mapping[str, np.ndarray]) -> Family:
    probs = node.declaration.probs
    assert probs is not None
    rows: Any = 0
    for card, (parent, link) in zip(probs.shape[:-1], node.links, strict=True):
        parent_node = model[parent]
        if parent in given:
            stored: Expression = constant(given[parent])
        elif parent_node.kind == "deterministic":
            stored = _stored_value(model, parent)
        else:
            stored = stored_leaf(model, parent_node)
        placed: Any = TracedArray(stored)
        rows = rows * card + link.place(placed)
    table = constant(probs.reshape(-1, probs.shape[-1]))
    rows = rows.expression if isinstance(rows, TracedArray) else constant(rows)
    return Family(Categorical, {"probs": gather(table, rows), "logits": None})


def _is_known(model: Model, node: CompiledNode, found: Followed) -> bool:
    """Whether the same function has been read in the same way, but for constants, a few times before."""
    code = getattr(node.declaration.function, "__code__", None)
    if code is None:
        return False
    keys = tuple(template(e).key for e in expressions_of(found.result))
    times = model.cache.setdefault("expressions checked", {})
    times[code, keys] = times.get((code, keys), 0) + 1
    return times[code, keys] > _CHECKED


def _check(model: Model, node: CompiledNode, found: Followed) -> None:
    """Refuse a reading that gives something else than the function at probe points."""
    program = Program(list(expressions_of(found.result)))
    for values in _probes(model, node, found.leaves):
        with marking_invalid(), np.errstate(all="ignore"):
            try:
                whole = dict(values)
                for name in _between(model, node):
                    whole[name] = model.evaluate(name, whole)[0]
                expected, batch = model.evaluate(node.name, whole)
            except BayesmcError:
                continue  # the function's own fault, or out of range: nothing to compare
            try:
                made = rebuilt(found.result, iter(program(values)))
                if node.is_stochastic and not isinstance(made, Distribution):
                    made = as_distribution(made)
            except (BayesmcError, ValueError, TypeError, IndexError) as error:
                raise TraceError(f"what was read of it fails: {error}") from error
            if not _agree(node, expected, made, batch + node.plate_shape):
                raise TraceError("what was read of it gives other values than the function")


def _check_form(model: Model, node: CompiledNode, form: Expression) -> None:
    """Refuse a family's own form where ``log_prob`` gives something else at probe points."""
    program = Program([form])
    for values in _probes(model, node, form.leaves | {node.name}):
        whole = dict(values)
        with marking_invalid(), np.errstate(all="ignore"):
            for name in _between(model, node):
                whole[name] = model.evaluate(name, whole)[0]
            dist, _ = model.evaluate(node.name, whole)
            expected = model.log_density(node.name, dist, whole[node.name])
            (found,) = program(values)
        if not _near(*np.broadcast_arrays(expected, found)):
            raise TraceError("its log_density gives other values than its log_prob")


def _between(model: Model, node: CompiledNode) -> list[str]:
    """Deterministic nodes above one, those first on which others depend."""
    found: dict[str, None] = {}

    def visit(name: str) -> None:
        for parent in model[name].parents:
            if model[parent].kind == "deterministic" and parent not in found:
                visit(parent)
                found[parent] = None

    visit(node.name)
    return list(found)


def _probes(
    model: Model, node: CompiledNode, leaves: frozenset[str]
) -> Iterator[Mapping[str, np.ndarray]]:
    """Stored values of unlike batch shapes: all of the probe, one row of it, one entry, mixed ranks."""
    above = leaves | _leaves_above(model, node.name)
    whole = {n: model.probe[n] for n in above}
    yield whole
    if not whole or not model.probe_shape:
        return
    ranks = {n: v.ndim - len(model[n].value_shape) for n, v in whole.items()}
    yield {n: v[-1] if ranks[n] == 2 else v for n, v in whole.items()}
    yield {n: v[(0,) * ranks[n]] for n, v in whole.items()}
    yield {
        n: (v, v[0], v[:, :1], v[0, 0])[k % 4] if ranks[n] == 2 else v
        for k, (n, v) in enumerate(sorted(whole.items()))
    }


def _agree(node: CompiledNode, expected: Any, made: Any, shape: Shape) -> bool:
    if isinstance(expected, Distribution) != isinstance(made, Distribution):
        return False
    if not isinstance(expected, Distribution):
        full = shape + node.event_shape
        stored = np.asarray(expected)
        value = node.decode(stored) if node.domain is not None else stored
        return _near(np.asarray(value), np.broadcast_to(np.asarray(made), full))
    if type(expected) is not type(made):
        return False
    pairs = zip(expected.parameters(), made.parameters(), strict=True)
    for (a, n), (b, m) in pairs:
        if n != m:
            return False
        first = np.broadcast_to(a, shape + a.shape[a.ndim - n :] if n else shape)
        second = np.broadcast_to(b, shape + b.shape[b.ndim - n :] if n else shape)
        if not _near(first, second):
            return False
    return True


def _near(a: np.ndarray, b: np.ndarray) -> bool:
    if a.shape != b.shape:
        return False
    a, b = np.asarray(a), np.asarray(b)
    if a.dtype.kind not in "fiub" or b.dtype.kind not in "fiub":
        return bool(np.array_equal(a, b))
    a, b = a.astype(float), b.astype(float)
    scale = np.maximum(np.abs(a), np.abs(b))
    largest = np.max(np.where(np.isfinite(scale), scale, 0.0), initial=0.0)
    near = np.abs(a - b) <= _RTOL * (np.where(np.isfinite(scale), scale, 0.0) + 1e-3 * largest)
    return bool((near | (a == b) | (np.isnan(a) & np.isnan(b))).all())
