"""From declarations to a ``Model``: call every function once on reachable values and note what it is."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
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
from bayesmc.network.calling import Aligner, RowAligner, call
from bayesmc.network.labels import Domain, domain_with_states, states_domain
from bayesmc.network.model import (
    CompiledNode,
    Model,
    arguments_of,
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
    nodes: dict[str, CompiledNode] = {}
    model = Model(name, nodes, {}, dict(sizes), dict(labels), {}, shape)
    rng = np.random.default_rng(20)
    with marking_invalid(), np.errstate(all="ignore"):
        for count, key in enumerate(order):
            declaration = declarations[key]
            links = _links(declaration.parents, declaration, nodes)
            plates = tuple(sizes[p] for p in declaration.plates)
            if declaration.source == "table":
                _check_table_parents(declaration, links, nodes)
            node, value = _discover(declaration, links, plates, model, shape, count, rng, inputs)
            nodes[key] = node
            model.probe[key] = value
    for key, potential in potentials.items():
        model.potentials[key] = (potential, _potential_links(potential, nodes))
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
    declaration: Declaration,
    links: tuple[tuple[str, Aligner], ...],
    plates: Shape,
    model: Model,
    shape: Shape,
    count: int,
    rng: np.random.Generator,
    inputs: Mapping[str, np.ndarray],
) -> tuple[CompiledNode, np.ndarray]:
    """The compiled node, and reachable values of it for its children to be tried on."""
    probe = model.probe
    if declaration.source == "input":
        value = inputs.get(declaration.name)
        if value is None:
            value = 1.0 + rng.random(plates + declaration.event_shape)
        node = CompiledNode(declaration, links, plates, declaration.event_shape, False, False)
        return node, read_only(value)
    if declaration.source == "fixed":
        assert declaration.value is not None
        discrete = declaration.domain is not None
        node = CompiledNode(
            declaration, links, plates, declaration.event_shape, discrete, False, declaration.domain
        )
        return node, declaration.value
    _, batch = arguments_of(links, probe)
    result = _call_batched(declaration, links, probe, shape, batch + plates)
    possible = made_possible(declaration, links, plates, result, batch, model)
    if possible:
        result = _call_batched(declaration, links, probe, shape, batch + plates)
    if isinstance(result, Distribution):
        node, value = _discover_stochastic(
            declaration, links, plates, result, batch, shape, count, rng
        )
        if not possible:
            refuse_parameters(node, result, probe, batch)
        return node, value
    return _discover_deterministic(
        declaration, links, plates, result, batch, probe, shape, possible
    )


def _call_batched(
    declaration: Declaration,
    links: tuple[tuple[str, Aligner], ...],
    probe: Mapping[str, np.ndarray],
    shape: Shape,
    lead: Shape,
) -> Any:
    """Call on the whole probe; if that fails but one entry works, the function does not broadcast."""
    arguments, _ = arguments_of(links, probe)
    try:
        return call(declaration, arguments, lead, links)
    except BayesmcError as error:
        if not links or declaration.source == "table" or _is_plain(error):
            raise
        try:
            one, _ = arguments_of(links, entry(links, probe, shape, (0,) * len(shape)))
            call(declaration, one, lead[len(lead) - len(declaration.plates) :], links)
        except BayesmcError as alone:
            raise alone from alone.__cause__
        raise BroadcastError(
            f"node {declaration.name!r} works on one value at a time but not on arrays of them: "
            f"{str(error).removeprefix(f'node {declaration.name!r}: ')}; write it with NumPy "
            "(np.where for if, axis=-1 for components), or declare vectorize=True (slow)"
        ) from error


def _is_plain(error: BayesmcError) -> bool:
    """A fault of its own, which an unbatched call may only have missed."""
    return isinstance(error, StateError) or isinstance(error.__cause__, IndexError)


def _discover_stochastic(
    declaration: Declaration,
    links: tuple[tuple[str, Aligner], ...],
    plates: Shape,
    dist: Distribution,
    batch: Shape,
    shape: Shape,
    count: int,
    rng: np.random.Generator,
) -> tuple[CompiledNode, np.ndarray]:
    fit(declaration, dist, batch, plates)
    support = dist.support
    domain = None
    varies = declaration.domain is not None  # known by who declares: not the same in all slices
    constant = support.is_single and not varies
    small = support.size is not None and support.size <= _DOMAIN_SIZE
    if small and constant and not dist.event_shape:
        assert support.size is not None
        try:
            domain = domain_with_states(
                support.size, int(np.asarray(support.low).flat[0]), declaration.states
            )
        except ModelError as error:
            raise ModelError(f"node {declaration.name!r}: {error}") from None
    elif declaration.states is not None:
        raise ModelError(
            f"node {declaration.name!r}: states= need a distribution with finitely many values (at most "
            f"{_DOMAIN_SIZE}) that do not depend on the parents; {type(dist).__name__} is on "
            f"{support.describe()}"
        )
    node = CompiledNode(
        declaration,
        links,
        plates,
        dist.event_shape,
        bool(dist.is_discrete),
        True,
        domain,
        support if constant else None,
        unsampled=isinstance(dist, Density) and not dist.can_sample,
        noiseless=_is_noiseless(dist, batch + plates, len(batch)),
        splits=dist.splits,
        reach=None if varies else support.at_most,
    )
    value = reachable(node, dist, shape, count, rng)
    return node, read_only(value)


def _is_noiseless(dist: Distribution, lead: Shape, batch: int) -> bool:
    """Whether some element of the plates has no noise at any value of the parents."""
    if dist.noiseless is None:
        return False
    return bool(np.broadcast_to(dist.noiseless, lead).all(axis=tuple(range(batch))).any())


def _discover_deterministic(
    declaration: Declaration,
    links: tuple[tuple[str, Aligner], ...],
    plates: Shape,
    result: np.ndarray,
    batch: Shape,
    probe: Mapping[str, np.ndarray],
    shape: Shape,
    possible: bool = False,
) -> tuple[CompiledNode, np.ndarray]:
    """Event shape from one unbatched call; a table where all parents are finite."""
    single, _ = arguments_of(links, entry(links, probe, shape, (0,) * len(shape)))
    one = call(declaration, single, plates, links)
    event = one.shape[len(plates) :]
    full = batch + plates + event
    value = deterministic_fit(declaration, result, batch, plates, full)
    undefined = not possible and value.dtype.kind == "f" and np.isnan(value).any()
    if undefined and not overflows(declaration, links, probe, batch + plates):
        raise DensityError(
            f"node {declaration.name!r}: the function returns NaN on reachable values"
        )
    integral = value.dtype.kind in "biu"
    labels = declaration.states
    if labels is None and isinstance(one, StateArray):
        labels = one.states  # labels that a function passes on stay labels
    node = CompiledNode(declaration, links, plates, event, integral, False)
    if labels is None:
        wanted = declaration.domain  # where other functions compute the same node, too
        if wanted is not None and not wanted.size:
            return node, value
        if wanted is not None and not links and not event and integral:
            return _constant_of(node, wanted, value)
        tabulated = _tabulate_deterministic(node, None, wanted)
        return (node, value) if tabulated is None else (tabulated, lookup(tabulated, probe))
    if event or not integral or (value.size and not 0 <= value.min() <= value.max() < len(labels)):
        raise ModelError(
            f"node {declaration.name!r}: with states= a deterministic node returns scalar positions "
            f"0..{len(labels) - 1}, not {np.unique(value)[:6].tolist()}"
        )
    domain = _states_of(declaration.name, labels)
    tabulated = _tabulate_deterministic(node, domain)
    if tabulated is not None:
        return tabulated, lookup(tabulated, probe)
    return replace(node, domain=domain, is_discrete=True), value


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


def _states_of(name: str, states: tuple[Any, ...]) -> Domain:
    try:
        return states_domain(states)
    except ModelError as error:
        raise ModelError(f"node {name!r}: {error}") from None


def _tabulate_deterministic(
    node: CompiledNode, domain: Domain | None, wanted: Domain | None = None
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
    values = configurations(node.links, cards)
    try:
        arguments, batch = arguments_of(node.links, values)
        result = call(node.declaration, arguments, batch + node.plate_shape, node.links)
    except BayesmcError:
        return None  # some configuration, perhaps an impossible one, cannot be evaluated
    full = np.broadcast_to(result, cards + node.plate_shape)
    if full.dtype.kind == "f" and not np.isfinite(full).all():
        return None
    if domain is None:
        unique, positions = np.unique(full, return_inverse=True)
        if (
            wanted is not None
            and wanted.numbers is not None
            and np.isin(unique, wanted.numbers).all()
        ):
            domain, positions = wanted, np.searchsorted(wanted.numbers, unique)[positions]
        else:
            unique.flags.writeable = False
            domain = Domain(len(unique), values=unique)
        positions = positions.reshape(full.shape)
    elif full.size and not 0 <= full.min() <= full.max() < domain.size:
        raise ModelError(
            f"node {node.name!r}: with states= a deterministic node returns positions "
            f"0..{domain.size - 1}, not {np.unique(full)[:6].tolist()}"
        )
    else:
        positions = full
    return CompiledNode(
        node.declaration,
        node.links,
        node.plate_shape,
        (),
        node.is_discrete,
        False,
        domain,
        None,
        positions.astype(domain.dtype),
    )


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


def _check_table_parents(
    declaration: Declaration,
    links: tuple[tuple[str, Aligner], ...],
    nodes: Mapping[str, CompiledNode],
) -> None:
    assert declaration.probs is not None
    for (parent, link), card in zip(links, declaration.probs.shape[:-1], strict=True):
        if link.foreign:
            raise PlateError(
                f"node {declaration.name!r}: the table's parent {parent!r} is in plates "
                f"{link.foreign}, which the table lacks; add them to plates="
            )
        domain = nodes[parent].domain
        if domain is None:
            raise ShapeError(
                f"node {declaration.name!r}: the table's parent {parent!r} has no finite set of states; "
                "use a function of it that returns a distribution"
            )
        if domain.size != card:
            raise ShapeError(
                f"node {declaration.name!r}: probs has {card} rows along the axis of parent {parent!r}, "
                f"which has {domain.size} states"
            )
