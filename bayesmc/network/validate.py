"""The checks that a net keeps the array rules: element by element, no random numbers, no mixing.

Every function is evaluated on batch shapes (), (p,) and (q, p), with p and q unlike each other and every
plate and event size, on parents whose batch shapes differ but broadcast and whose values are reachable.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BayesmcError, BroadcastError, ModelError
from bayesmc.network.calling import call, to_mix
from bayesmc.network.clashing import data_around, sizes_beyond
from bayesmc.network.model import (
    CompiledNode,
    Model,
    arguments_of,
    potential_shape,
)
from bayesmc.network.node import Declaration, Numbered, identity
from bayesmc.network.probing import entry
from bayesmc.plates import PlateArray
from bayesmc.shapes import Shape, masks, nearly_equal
from bayesmc.states import as_numbers

#: nodes of one function that are checked, the first and some among the others, besides those whose parents'
#: values are extreme
_ALIKE, _SPREAD = 10, 10


def validate_model(model: Model) -> None:
    """Raise on the first node whose function breaks a rule.

    Of nodes that have one function and parents of the same kinds, as the slices of a template have, the
    first few are checked, some later ones and the last, and those whose parents' values are the largest and
    the smallest.

    Raises
    ------
    ModelError, BroadcastError
        With the node's name, the entry or plate element, and what to write instead.
    """
    with marking_invalid(), np.errstate(all="ignore"):
        alike: dict[Hashable, list[CompiledNode]] = {}
        for node in model.nodes.values():
            if node.declaration.source == "function":
                alike.setdefault(_kind(model, node), []).append(node)
        chosen = {n.name for nodes in alike.values() for n in _unlike(model, nodes)}
        for name in model.nodes:
            if name in chosen:
                _check_node(model, model[name])
        for name, (potential, links) in model.potentials.items():
            model.potential(name, model.probe)  # its shape, said in its own words
            what = Declaration(
                f"potential {name}", "function", potential.parents, potential.plates,
                function=potential.function,
            )  # fmt: skip
            shape = potential_shape(model.sizes, potential)
            node = CompiledNode(what, links, shape, is_stochastic=False)
            _check_node(model, node)
            if potential.index is not None:
                _check_rows(model, node)


def _kind(model: Model, node: CompiledNode) -> Hashable:
    """Equal for nodes with one function, of parents whose values have the same shapes and states."""
    parents = tuple(
        (p.kind, p.plates, p.value_shape, p.is_discrete, p.domain and p.domain.key)
        for p in map(model.__getitem__, node.parents)
    )
    own = node.declaration
    function = own.function
    what = identity(function)
    if isinstance(function, Numbered):  # a slice of a template, whose number may be any
        what = identity(function.func), function.places
    return what, own.vectorize, node.plates, node.value_shape, parents


def _unlike(model: Model, nodes: list[CompiledNode]) -> list[CompiledNode]:
    """Nodes that stand for others with their function: the first, some later ones, those at the extremes."""
    if len(nodes) <= _ALIKE:
        return nodes
    spread = np.linspace(_ALIKE, len(nodes) - 1, _SPREAD).astype(int).tolist()
    found = dict.fromkeys([*range(_ALIKE), *spread])
    for k in range(len(nodes[0].parents)):
        values = [np.asarray(model.probe[n.parents[k]]) for n in nodes]
        if not values[0].size or values[0].dtype.kind not in "fiub":
            continue
        found[int(np.argmax([v.max() for v in values]))] = None
        found[int(np.argmin([v.min() for v in values]))] = None
    return [nodes[k] for k in sorted(found)]


def _check_node(model: Model, node: CompiledNode) -> None:
    arguments, batch = arguments_of(node.links, model.probe)
    lead = batch + node.plate_shape
    whole = _signature(node, arguments, lead)
    again = _signature(node, [_guarded(a) for a in arguments], lead)
    if not _same(whole, again):
        raise ModelError(
            f"{_what(node)}: two calls with the same parents differ; a conditional density must "
            "not draw random numbers or change state (randomness belongs in a parent node)"
        )
    if not node.links:
        return
    try:
        _check_entries(model, node, whole, batch)
    except BroadcastError:
        _check_mixing(model, node)  # which says more, where that is what it is
        raise
    _check_mixing(model, node)


def _check_entries(model: Model, node: CompiledNode, whole: _Signature, batch: Shape) -> None:
    """Each entry of a batched call must equal the unbatched call, whatever the parents' ranks."""
    shape = model.probe_shape
    _compare_entries(node, model.probe, shape, whole, np.ndindex(batch), batch)
    if not batch:
        return
    # backwards, so that a function that sorts the batch cannot find it sorted both times
    row = _signature_at(node, _parts(node, model.probe, [1] * len(node.links)))
    for a, b in zip(whole.arrays, row.arrays, strict=True):
        if not nearly_equal(a[0, ::-1], b):
            raise BroadcastError(_broadcast_message(node, (0,), whole, row))
    if len(set(node.parents)) < 2:
        return
    mixed = _parts(node, model.probe, range(len(node.links)))
    batch = arguments_of(node.links, mixed)[1]
    try:
        ranks = _signature_at(node, mixed)
    except BayesmcError as error:
        if not _works_alone(node, mixed, shape):
            return  # ranks mix draws, and what they make together need not be reachable
        raise BroadcastError(
            f"{_what(node)} does not broadcast parents of unlike batch shapes: {error}; use bmc.stack for "
            "np.stack, give the parts of np.concatenate one batch first (a + 0 * b[..., :1], b + 0 * "
            "a[..., :1]), and let every operation broadcast"
        ) from error
    q, p = shape
    _compare_entries(node, mixed, shape, ranks, [(0, 0), (q - 1, 0), (q - 1, p - 1)], batch)


def _works_alone(node: CompiledNode, values: Mapping[str, np.ndarray], shape: Shape) -> bool:
    """Whether every entry of a batch can be evaluated by itself."""
    try:
        for index in np.ndindex(shape):
            _signature_at(node, entry(node, values, shape, index))
    except BayesmcError:
        return False
    return True


def _parts(
    node: CompiledNode, values: Mapping[str, np.ndarray], kinds: Iterable[int]
) -> dict[str, np.ndarray]:
    """Parents' values with batch axes (q, p), cut to other ranks: (q, p), (p,), (q, 1) or ()."""
    found = {}
    for kind, (name, link) in zip(kinds, dict(node.links).items(), strict=False):
        value = found[name] = values[name]
        if len(link.batch_shape(value)) == 2:
            found[name] = (value, value[0, ::-1], value[:, :1], value[0, 0, ...])[kind % 4]
    return found


def _compare_entries(
    node: CompiledNode,
    values: Mapping[str, np.ndarray],
    shape: Shape,
    whole: _Signature,
    indices: Iterable[Shape],
    batch: Shape,
) -> None:
    for index in indices:
        full = (0,) * (len(shape) - len(index)) + index
        at = full[len(full) - len(batch) :]
        at = tuple(i if n > 1 else 0 for i, n in zip(at, batch, strict=True))
        part: Any = (*at, Ellipsis)  # an array still, of objects too
        alone = _signature_at(node, entry(node, values, shape, full))
        if whole.family != alone.family or not all(
            nearly_equal(a[part], b) for a, b in zip(whole.arrays, alone.arrays, strict=True)
        ):
            raise BroadcastError(_broadcast_message(node, at, whole, alone))


def _check_mixing(model: Model, node: CompiledNode) -> None:
    """Perturbing one element of a shared plate must move only that element."""
    shape = model.probe_shape
    base = entry(node, model.probe, shape)
    other = entry(node, model.probe, shape, tuple(n - 1 for n in shape))
    before: _Signature | None = None
    for axis, plate in enumerate(node.plates):
        sharing = [p for p in dict.fromkeys(node.parents) if plate in model.nodes[p].plates]
        size = node.plate_shape[axis]
        if size < 2 or not sharing:
            continue
        if before is None:
            before = _signature_at(node, base)
        for chosen in masks(size):
            moved = dict(base)
            for parent in sharing:
                moved[parent] = _perturbed(
                    model.nodes[parent], base[parent], other[parent], plate, chosen
                )
            try:
                after = _signature_at(node, moved)
            except BayesmcError:
                continue  # the perturbed values may not be reachable
            rest = (slice(None),) * axis + (~chosen,)
            for a, b in zip(before.arrays, after.arrays, strict=True):
                if not nearly_equal(a[rest], b[rest]):
                    raise BroadcastError(
                        f"{_what(node)}: changing some elements of {sharing} along plate {plate!r} "
                        "moves other elements too; a function acts element by element on a shared "
                        f"plate; {to_mix(node.declaration, [*sharing, *node.parents], plate)}"
                    )


def _check_rows(model: Model, node: CompiledNode) -> None:
    """What some rows of an index take must not move the log factors of other rows."""
    shape = model.probe_shape
    first, last = (
        arguments_of(node.links, entry(node, model.probe, shape, at))[0]
        for at in ((0,) * len(shape), tuple(n - 1 for n in shape))
    )
    before = _signature(node, first, node.plate_shape).arrays[0]
    for chosen in masks(node.plate_shape[0]):
        moved = [
            np.where(chosen.reshape((-1,) + (1,) * link.event_ndim), b, a)
            for a, b, (_, link) in zip(first, last, node.links, strict=True)
        ]
        after = _signature(node, moved, node.plate_shape).arrays[0]
        if not nearly_equal(before[~chosen], after[~chosen]):
            raise BroadcastError(
                f"{_what(node)}: changing some rows of its arguments moves the log factors of others; "
                "row r of the result may depend on row r of every argument only"
            )


def _perturbed(
    parent: CompiledNode, value: np.ndarray, other: np.ndarray, plate: str, chosen: np.ndarray
) -> np.ndarray:
    """``value`` with the chosen elements along ``plate`` changed, to reachable ones where there are."""
    at = (slice(None),) * parent.plates.index(plate) + (chosen,)
    moved = np.array(value)
    new = np.array(other)[at]
    same = new == moved[at]
    if parent.domain is not None:
        new = np.where(same, (new + 1) % parent.domain.size, new)
    elif new.dtype.kind == "f":
        new = np.where(same, new * 1.1 + 0.1, new)
    elif new.dtype.kind in "iu":
        new = np.where(same, new + 1, new)
    moved[at] = new
    return moved


def _guarded(argument: Any) -> Any:
    """Numbers that refuse to be compared with labels."""
    if isinstance(argument, PlateArray):
        array = as_numbers(argument.array)
        return PlateArray(array, argument.plates, argument.own, argument.event_ndim)
    return as_numbers(argument)


def _what(node: CompiledNode) -> str:
    """How messages name the node (or potential)."""
    return node.name if node.name.startswith("potential ") else f"node {node.name!r}"


class _Signature(NamedTuple):
    """What a call returned, as arrays of shape ``lead + own axes`` that can be compared."""

    family: str
    arrays: list[np.ndarray]


def _signature_at(node: CompiledNode, values: Mapping[str, np.ndarray]) -> _Signature:
    """Of a call on stored values of the parents."""
    arguments, batch = arguments_of(node.links, values)
    return _signature(node, arguments, batch + node.plate_shape)


def _signature(node: CompiledNode, arguments: Any, lead: Shape) -> _Signature:
    result = call(node.declaration, arguments, lead, node.links)
    if isinstance(result, Distribution):
        parts = result.parameters()
        family = type(result).__name__
    else:
        parts = [(result, len(node.event_shape))]
        family = "array"
    arrays = []
    for array, own in parts:
        array = np.asarray(array)
        full = lead + array.shape[array.ndim - own :]
        try:
            arrays.append(array if array.shape == full else np.broadcast_to(array, full))
        except ValueError:
            beyond = sizes_beyond(array.shape[: array.ndim - own], lead)
            around = data_around(node.declaration, node.plate_shape, beyond)
            raise BroadcastError(
                f"{_what(node)}: a parameter of shape {array.shape} does not fit the batch and "
                f"plates {lead}; {around or 'write the function so that it broadcasts'}"
            ) from None
    return _Signature(family, arrays)


def _same(a: _Signature, b: _Signature) -> bool:
    return a.family == b.family and all(map(nearly_equal, a.arrays, b.arrays))


def _broadcast_message(
    node: CompiledNode, index: Shape, whole: _Signature, alone: _Signature
) -> str:
    return (
        f"{_what(node)} does not broadcast: entry {index} of a call on a batch differs from the "
        f"call on that entry alone ({whole.family} against {alone.family} with other parameters); "
        "every operation must act on the last axes or element by element (axis=-1, np.where for if, "
        "components as v[..., k]), or declare vectorize=True (slow)"
    )
