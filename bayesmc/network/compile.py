"""From declarations to a ``Model``: call every function once on reachable values and note what it is."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from bayesmc.distributions import Density, Distribution
from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import (
    BayesmcError,
    BroadcastError,
    DensityError,
    ModelError,
    PlateError,
    ShapeError,
    StateError,
)
from bayesmc.network.calling import Aligner, RowAligner
from bayesmc.network.clashing import data_around, picked_by_row, sizes_in
from bayesmc.network.labels import Domain, domain_with_states, states_domain
from bayesmc.network.model import (
    CompiledNode,
    Model,
    deterministic_fit,
    fit,
    lookup,
)
from bayesmc.network.node import Declaration, Potential
from bayesmc.network.probing import (
    entry,
    made_possible,
    overflows,
    reachable,
    refuse_parameters,
)
from bayesmc.shapes import Shape, read_only, unused_sizes
from bayesmc.states import StateArray

#: configurations of finite parents up to which a deterministic node is tabulated
_DETERMINISTIC_TABLE = 4096
#: values up to which a finite support is enumerated
_DOMAIN_SIZE = 1 << 16


def compile_model(
    name: str | None,
    declarations: Mapping[str, Declaration],
    potentials: Mapping[str, Potential],
    sizes: Mapping[str, int],
    labels: Mapping[str, tuple[Any, ...]],
    inputs: Mapping[str, np.ndarray],
    order: Sequence[str],
) -> Model:
    """Call every node once on reachable values of its parents and note what it is."""
    events = [n for d in declarations.values() for n in d.event_shape]
    shape = tuple(unused_sizes([*sizes.values(), *events], 2))[::-1]
    model = Model(name, {}, {}, dict(sizes), dict(labels), {}, shape)
    rng = np.random.default_rng(20)
    with marking_invalid(), np.errstate(all="ignore"):
        for count, key in enumerate(order):
            declaration = declarations[key]
            links = _links(declaration.parents, declaration, model.nodes)
            plates = tuple(sizes[p] for p in declaration.plates)
            bare = CompiledNode(
                declaration, links, plates, declaration.event_shape, is_stochastic=False
            )
            if declaration.source == "table":
                _check_table_parents(bare, model)
            model.nodes[key], model.probe[key] = _discover(model, bare, count, rng, inputs)
    for key, potential in potentials.items():
        model.potentials[key] = (potential, _potential_links(potential, model.nodes))
    return model


def _links(
    parents: Sequence[str], child: Declaration, nodes: Mapping[str, CompiledNode]
) -> tuple[tuple[str, Aligner], ...]:
    table = child.source == "table"
    return tuple(
        (
            p,
            Aligner(
                child.plates,
                nodes[p].plates,
                len(nodes[p].event_shape),
                nodes[p].domain,
                positions=table,
            ),
        )
        for p in parents
    )


def _potential_links(
    potential: Potential, nodes: Mapping[str, CompiledNode]
) -> tuple[tuple[str, Aligner], ...]:
    if potential.index is None:
        source = "table" if potential.is_table else "function"
        what = Declaration(potential.name, source, potential.parents, potential.plates)
        return _links(potential.parents, what, nodes)
    return tuple(
        (
            name,
            RowAligner(
                nodes[name].plates,
                len(nodes[name].event_shape),
                nodes[name].domain,
                flat,
                math.prod(nodes[name].plate_shape),
                positions=potential.is_table,
            ),
        )
        for name, flat in zip(potential.parents, potential.index, strict=True)
    )


def _discover(
    model: Model,
    bare: CompiledNode,
    count: int,
    rng: np.random.Generator,
    inputs: Mapping[str, np.ndarray],
) -> tuple[CompiledNode, np.ndarray]:
    """The compiled node, and reachable values of it for its children to be tried on."""
    declaration, probe = bare.declaration, model.probe
    if declaration.source == "input":
        value = inputs.get(declaration.name)
        if value is None:
            value = 1.0 + rng.random(bare.value_shape)
        return bare, read_only(value)
    if declaration.source == "fixed":
        assert declaration.value is not None
        domain = declaration.domain
        return replace(bare, is_discrete=domain is not None, domain=domain), declaration.value
    result, batch = _called(model, bare)
    possible = made_possible(model, bare, result, batch)
    if possible:
        result, batch = _called(model, bare)
    if not isinstance(result, Distribution):
        return _deterministic(model, bare, result, batch, possible)
    try:
        node = _stochastic(bare, result, batch)
    except ShapeError as error:
        picked = _picked_by_row(model, bare, str(error))
        if picked is None:
            raise
        raise ShapeError(f"node {bare.name!r}: {picked}") from error
    value = reachable(node, result, model.probe_shape, count, rng)
    if not possible:
        refuse_parameters(node, result, probe, batch)
    return node, read_only(value)


def _called(model: Model, node: CompiledNode) -> tuple[Any, Shape]:
    """Call on the whole probe; if that fails but one entry works, the function does not broadcast."""
    try:
        return node.called(model.probe)
    except BayesmcError as error:
        if not node.links or node.declaration.source == "table" or _is_plain(error):
            raise
        whole = error
    alone = _fault_alone(model, node)  # outside, so that no error shows twice
    if alone is not None:
        raise alone from alone.__cause__
    if isinstance(whole, PlateError):  # which names the parent, and what to do about it
        raise whole from whole.__cause__
    sizes = sizes_in(str(whole.__cause__), model.probe_shape)
    around = data_around(node.declaration, node.plate_shape, sizes)
    around = around or _picked_by_row(model, node, str(whole.__cause__))
    if around is not None:
        raise BroadcastError(f"node {node.name!r}: {around}") from whole
    instead = "np.exp for math.exp" if "Python scalars" in str(whole) else "np.where for if"
    raise BroadcastError(
        f"node {node.name!r} works on one value at a time but not on arrays of them: "
        f"{str(whole).removeprefix(f'node {node.name!r}: ')}; write it with NumPy "
        f"({instead}, axis=-1 for components), or declare vectorize=True (slow)"
    ) from whole


def _fault_alone(model: Model, node: CompiledNode) -> BayesmcError | None:
    """What goes wrong on one entry of the probe, if anything."""
    try:
        node.called(entry(node, model.probe, model.probe_shape))
    except BayesmcError as error:
        return error
    return None


def _picked_by_row(model: Model, node: CompiledNode, message: str) -> str | None:
    """What to write where components of a vector parent are picked beside the plates."""
    sizes = dict(zip(node.plates, node.plate_shape, strict=True))
    vectors, elsewhere = {}, {}
    for parent, link in node.links:
        above = model.nodes[parent]
        if len(above.event_shape) > 1 or not sizes:
            continue
        if link.foreign:
            elsewhere[parent] = above.plates, above.event_shape
        elif above.event_shape:
            own = (n if p in above.plates else 1 for p, n in sizes.items())
            vectors[parent] = (*own, *above.event_shape)
    return picked_by_row(sizes, vectors, model.probe_shape, message, elsewhere)


def _is_plain(error: BayesmcError) -> bool:
    """A fault of its own, which an unbatched call may only have missed."""
    return isinstance(error, StateError) or isinstance(error.__cause__, IndexError)


def _stochastic(bare: CompiledNode, dist: Distribution, batch: Shape) -> CompiledNode:
    """What is to be known of a node from its distribution at the probe."""
    declaration, support = bare.declaration, dist.support
    fit(declaration, dist, batch, bare.plate_shape)
    domain = None
    varies = declaration.domain is not None  # known by who declares: not the same in all slices
    constant = support.is_single and not varies
    small = support.size is not None and support.size <= _DOMAIN_SIZE
    if small and constant and not dist.event_shape:
        assert support.size is not None
        low = int(np.asarray(support.low).flat[0])
        with _naming(bare):
            domain = domain_with_states(support.size, low, declaration.states)
    elif declaration.states is not None:
        raise ModelError(
            f"node {bare.name!r}: states= need a distribution with finitely many values (at most "
            f"{_DOMAIN_SIZE}) that do not depend on the parents; {type(dist).__name__} is on "
            f"{support.describe()}"
        )
    return CompiledNode(
        declaration,
        bare.links,
        bare.plate_shape,
        dist.event_shape,
        bool(dist.is_discrete),
        True,
        domain,
        support if constant else None,
        unsampled=isinstance(dist, Density) and not dist.can_sample,
        noiseless=_is_noiseless(dist, batch + bare.plate_shape, len(batch)),
        splits=dist.splits,
        reach=None if varies else support.at_most,
    )


def _is_noiseless(dist: Distribution, lead: Shape, batch: int) -> bool:
    """Whether some element of the plates has no noise at any value of the parents."""
    if dist.noiseless is None:
        return False
    return bool(np.broadcast_to(dist.noiseless, lead).all(axis=tuple(range(batch))).any())


def _deterministic(
    model: Model, bare: CompiledNode, result: Any, batch: Shape, possible: bool
) -> tuple[CompiledNode, np.ndarray]:
    """Event shape from one unbatched call; a table where all parents are finite."""
    one, _ = bare.called(entry(bare, model.probe, model.probe_shape))
    node = replace(bare, event_shape=one.shape[len(bare.plates) :])
    value = deterministic_fit(node, result, batch)
    if value.dtype == object:
        return _objects(node, value)
    undefined = not possible and value.dtype.kind == "f" and np.isnan(value).any()
    if undefined and not overflows(node, model.probe):
        raise DensityError(f"node {node.name!r}: the function returns NaN on reachable values")
    node = replace(node, is_discrete=value.dtype.kind in "biu")
    labels, wanted = node.declaration.states, node.declaration.domain
    if labels is None and isinstance(one, StateArray):
        labels = one.states  # labels that a function passes on stay labels
    domain = None
    if labels is not None:
        if node.event_shape or not node.is_discrete or _is_beyond(value, len(labels)):
            raise ModelError(
                f"node {node.name!r}: with states= a deterministic node returns scalar positions "
                f"0..{len(labels) - 1}, not {np.unique(value)[:6].tolist()}"
            )
        with _naming(node):
            domain = states_domain(labels)
    elif wanted is not None:  # where other functions compute the same node, too
        if not wanted.size:
            return node, value
        if not (node.links or node.event_shape) and node.is_discrete:
            return _constant_of(node, wanted, value)
    tabulated = _tabulated(node, domain, wanted)
    if tabulated is not None:
        return tabulated, lookup(tabulated, model.probe)
    return replace(node, domain=domain), value


def _objects(node: CompiledNode, value: np.ndarray) -> tuple[CompiledNode, np.ndarray]:
    """A computed node whose values are frozen objects."""
    if node.event_shape or node.declaration.states is not None:
        what = "states=" if node.declaration.states is not None else f"axes {node.event_shape}"
        raise ModelError(
            f"node {node.name!r}: it returns objects, one for each element of the batch and the plates, "
            "and these "
            f"have no {what}"
        )
    return replace(node, is_object=True), value


def _constant_of(
    node: CompiledNode, domain: Domain, value: np.ndarray
) -> tuple[CompiledNode, np.ndarray]:
    """A computed node without parents, as positions in a domain."""
    numbers = domain.numbers
    assert numbers is not None
    if not np.isin(value, numbers).all():
        return node, value
    table = np.searchsorted(numbers, np.broadcast_to(value, node.plate_shape))
    table = table.astype(domain.dtype)
    return replace(node, domain=domain, table=table), read_only(table)


@contextmanager
def _naming(node: CompiledNode) -> Iterator[None]:
    """What is wrong with states names the node."""
    try:
        yield
    except ModelError as error:
        raise ModelError(f"node {node.name!r}: {error}") from None


def _is_beyond(positions: np.ndarray, states: int) -> bool:
    """Whether some are no positions of so many states."""
    return bool(positions.size) and not 0 <= positions.min() <= positions.max() < states


def _tabulated(
    node: CompiledNode, domain: Domain | None, wanted: Domain | None
) -> CompiledNode | None:
    """``node`` with the table of its positions over all configurations of its parents, if small.

    ``domain`` says what positions its function returns; ``wanted`` which values it shall have.
    """
    domains = [link.domain for _, link in node.links]
    if node.event_shape or not node.links or node.has_foreign_parents or None in domains:
        return None
    cards = tuple(d.size for d in domains if d is not None)
    if math.prod(cards) * max(math.prod(node.plate_shape), 1) > _DETERMINISTIC_TABLE:
        return None
    try:
        result, _ = node.called(configurations(node.links, cards))
    except BayesmcError:
        return None  # some configuration, perhaps an impossible one, cannot be evaluated
    full = np.broadcast_to(result, cards + node.plate_shape)
    if full.dtype.kind == "f" and not np.isfinite(full).all():
        return None
    if domain is not None:
        if _is_beyond(full, domain.size):
            raise ModelError(
                f"node {node.name!r}: with states= a deterministic node returns positions "
                f"0..{domain.size - 1}, not {np.unique(full)[:6].tolist()}"
            )
        return replace(node, domain=domain, table=full.astype(domain.dtype))
    unique, positions = np.unique(full, return_inverse=True)
    numbers = None if wanted is None else wanted.numbers
    if wanted is not None and numbers is not None and np.isin(unique, numbers).all():
        domain, positions = wanted, np.searchsorted(numbers, unique)[positions]
    else:
        domain = Domain(len(unique), values=read_only(unique))
    return replace(node, domain=domain, table=positions.reshape(full.shape).astype(domain.dtype))


def configurations(
    links: Sequence[tuple[str, Aligner]], cards: Sequence[int]
) -> dict[str, np.ndarray]:
    """Every joint configuration of finite parents: parent i varies along batch axis i.

    Plated parents hold the same state in all their elements.
    """
    values: dict[str, np.ndarray] = {}
    for axis, ((parent, link), card) in enumerate(zip(links, cards, strict=True)):
        if parent in values:
            continue
        shape = (1,) * axis + (card,) + (1,) * (len(cards) - 1 - axis + link.trailing)
        values[parent] = np.arange(card).reshape(shape)
    return values


def _check_table_parents(node: CompiledNode, model: Model) -> None:
    probs = node.declaration.probs
    assert probs is not None
    for (parent, link), card in zip(node.links, probs.shape[:-1], strict=True):
        if link.foreign:
            raise PlateError(
                f"node {node.name!r}: the table's parent {parent!r} is in plates "
                f"{link.foreign}, which the table lacks; add them to plates="
            )
        domain = model[parent].domain
        if domain is None:
            raise ShapeError(
                f"node {node.name!r}: the table's parent {parent!r} has no finite set of states; "
                "use a function of it that returns a distribution"
            )
        if domain.size != card:
            raise ShapeError(
                f"node {node.name!r}: probs has {card} rows along the axis of parent {parent!r}, "
                f"which has {domain.size} states"
            )
