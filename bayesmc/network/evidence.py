"""Evidence and inputs: from what a user passes to stored values, with every fault named.

A masked entry, NaN in a plated node or None is unobserved. Labels, shapes, supports and missing
entries are settled here once, so that engines never look at user values.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from bayesmc.errors import EvidenceError, PlateError, did_you_mean
from bayesmc.network.clashing import many_axes, refuse_misplaced, surplus
from bayesmc.network.labels import by_label, oriented, refuse_crossed
from bayesmc.network.model import CompiledNode, Model
from bayesmc.network.node import Declaration, observed_links
from bayesmc.shapes import Shape, at_index, first_index

_NO_READING = "put in what stands for no reading (of ranges: robotics.clean_ranges)"
_ARTICLE = {"deterministic": "a deterministic", "input": "an input", "fixed": "a fixed (do)"}


@dataclass(frozen=True, eq=False)
class Observed:
    """What is known of one node.

    Attributes
    ----------
    value : ndarray
        Stored values, shape ``(*plates, *event)``; unobserved elements hold a filler.
    mask : ndarray of bool or None
        Plate elements observed in full; None where all are.
    parts : ndarray of bool or None
        Of the other elements the components that are observed all the same, shape that of ``value``; None
        where there are none.
    """

    value: np.ndarray
    mask: np.ndarray | None = None
    parts: np.ndarray | None = None

    def numbers(self, event_ndim: int) -> np.ndarray:
        """Which numbers were seen, those of vectors seen in part included; it broadcasts to values."""
        mask = np.asarray(True if self.mask is None else self.mask)
        mask = np.expand_dims(mask, tuple(range(mask.ndim, mask.ndim + event_ndim)))
        return mask if self.parts is None else mask | self.parts


def read_evidence(model: Model, evidence: Mapping[str, Any] | None) -> dict[str, Observed]:
    """Check and store evidence; nodes given as None are left out."""
    if evidence is not None and not isinstance(evidence, Mapping):
        raise EvidenceError(
            f"evidence is a {type(evidence).__name__}; give a dict from node name to value"
        )
    observed = {}
    for name, value in (evidence or {}).items():
        node = model.nodes.get(name)
        if node is None:
            raise EvidenceError(
                f"evidence on {name!r}, which the net does not have{_close(name, model)}"
            )
        if not node.is_stochastic:
            raise EvidenceError(
                f"evidence on {name!r}, which is {_ARTICLE[node.kind]} node and takes none; "
                "observe a stochastic node, or give it a narrow distribution"
            )
        if value is None:
            continue
        ordered = by_label(f"evidence on {name!r}", value, node.plates, model.labels)
        found = observe(node, ordered)
        if found is not None:
            observed[name] = found
    return observed


def observe(node: CompiledNode, value: Any) -> Observed | None:
    """Check and store what was observed of one node; None where all of it is missing."""
    try:
        array, missing = _missing(node, value)
    except (TypeError, ValueError) as error:
        if isinstance(error, EvidenceError):
            raise
        raise EvidenceError(_no_array(node, value, error)) from error
    if array.shape != node.value_shape:
        raise EvidenceError(_shape_message(node, array.shape))
    event = tuple(range(len(node.plate_shape), array.ndim))
    some = missing.any(axis=event) if event else missing
    every = missing.all(axis=event) if event else missing
    partly = some & ~every
    if partly.any() and not node.splits:
        at = first_index(missing & np.expand_dims(partly, event))
        raise EvidenceError(
            f"evidence on {node.name!r}: of one vector the entry at {at if len(at) > 1 else at[0]} is "
            "missing and others are not, which is not supported; split the vector into nodes of its parts, "
            f"leave all of it out, or {_NO_READING}"
        )
    if every.all() and array.size:
        return None
    filled = np.where(missing, array[first_index(~missing)], array) if missing.any() else array
    stored = store(node, filled)
    observed = np.asarray(~some)
    _check_support(node, stored, np.asarray(~every), observed)
    parts = np.expand_dims(partly, event) & ~missing if partly.any() else None
    return Observed(stored, None if observed.all() else observed, parts)


def read_question(
    net: Any, evidence: Mapping[str, Any] | None, inputs: Mapping[str, Any] | None
) -> tuple[Any, Model, dict[str, Observed], dict[str, np.ndarray]]:
    """A snapshot of a net, its model for the data, and evidence and inputs as stored values."""
    given = evidence if isinstance(evidence, Mapping) else {}
    try:
        model = net.model(given, inputs)
    except EvidenceError:
        refuse_misplaced(net, given, inputs)
        raise
    links = observed_links(model.nodes, given)
    if links:
        net = net.with_links(links)
        model = net.model(given, inputs)
    observed = read_evidence(model, evidence)
    declarations = {n: c.declaration for n, c in model.nodes.items()}
    known = read_inputs(declarations, model.sizes, inputs, model.labels)
    return net.snapshot(), model, observed, known


def read_inputs(
    declarations: Mapping[str, Declaration],
    sizes: Mapping[str, int],
    inputs: Mapping[str, Any] | None,
    labels: Mapping[str, tuple[Any, ...]],
) -> dict[str, np.ndarray]:
    """Check the values of input nodes; all that are declared must be given."""
    if inputs is not None and not isinstance(inputs, Mapping):
        raise EvidenceError(f"inputs is a {type(inputs).__name__}; give a dict from name to value")
    given = dict(inputs or {})
    wanted = {n: d for n, d in declarations.items() if d.source == "input"}
    for name in given:
        if name not in wanted:
            raise EvidenceError(
                f"inputs= gives {name!r}, which is not a declared input{did_you_mean(name, wanted)}; the "
                f"inputs are {list(wanted)}"
            )
    read = {}
    for name, declaration in wanted.items():
        if name not in given:
            raise EvidenceError(f"input {name!r} has no value; pass inputs={{{name!r}: value}}")
        value = by_label(f"input {name!r}", given[name], declaration.plates, labels)
        read[name] = checked_input(declaration, value, sizes)
    return read


def checked_input(
    declaration: Declaration, given: Any, sizes: Mapping[str, int], steps: int | None = None
) -> np.ndarray:
    """The value of an input as finite numbers of its shape; with ``steps``, of so many slices, time first."""
    name, value = declaration.name, np.array(given)
    if value.dtype.kind not in "biuf":
        raise EvidenceError(f"input {name!r} has dtype {value.dtype}; give numbers")
    shape = tuple(sizes[p] for p in declaration.plates) + declaration.event_shape
    slices, also = "", ""
    if steps is not None:
        shape, slices = (steps, *shape), f"{steps} slices, "
        also = ", also where observations are missing"
    if value.shape != shape:
        raise EvidenceError(
            f"input {name!r} has shape {value.shape}, but {slices}its plates {declaration.plates} and "
            f"event_shape {declaration.event_shape} make {shape}"
        )
    if value.dtype.kind == "f" and not np.isfinite(value).all():
        at = first_index(~np.isfinite(value))
        raise EvidenceError(
            f"input {name!r} is {value[at]} at index {at}; inputs must be finite{also}"
        )
    value.flags.writeable = False
    return value


def plate_sizes(
    plates: Mapping[str, int | None],
    declarations: Mapping[str, Declaration],
    *data: Mapping[str, Any] | None,
    labels: Mapping[str, tuple[Any, ...]] = MappingProxyType({}),
) -> dict[str, int | None]:
    """Sizes of all plates: declared ones, else read off the leading axes of the data.

    Data that bring labels of their own must agree on them, but for plates that declare ``labels``.
    """
    sizes = dict(plates)
    source: dict[str, str] = {}
    fixed = {n: d.value for n, d in declarations.items() if d.value is not None}
    for values in (fixed, *data):
        if values is not None and not isinstance(values, Mapping):
            raise EvidenceError(
                f"evidence or inputs are a {type(values).__name__}; give a dict of node -> value"
            )
        for name, value in (values or {}).items():
            declaration = declarations.get(name)
            if declaration is None or value is None or not declaration.plates:
                continue
            value = oriented(f"data of {name!r}", value, declaration.plates, labels)
            shape = value.shape if isinstance(value, np.ndarray) else _shape(value)
            if len(shape) < len(declaration.plates):
                continue  # said with the node's full shape when the value is read
            for plate, size in zip(declaration.plates, shape, strict=False):
                if sizes[plate] is None:
                    sizes[plate], source[plate] = size, name
                elif sizes[plate] != size and plate in source:
                    shapes = {n: _shape(v) for data_of in data for n, v in (data_of or {}).items()}
                    raise PlateError(
                        f"plate {plate!r} has size {sizes[plate]} in the data of {source[plate]!r} but "
                        f"{size} in that of {name!r}"
                        + many_axes(shapes, declarations, (source[plate], name))
                    )
    known = [(n, v) for values in data for n, v in (values or {}).items() if n in declarations]
    refuse_crossed([(n, v, declarations[n].plates) for n, v in known], labels)
    return sizes


def brought_sizes(model: Model, inputs: Mapping[str, Any] | None) -> dict[str, int]:
    """Sizes of plates that new values of inputs bring along, where they are not the model's.

    Raises
    ------
    PlateError
        Two inputs bring different ones.
    """
    found: dict[str, int] = {}
    for name, value in (inputs or {}).items():
        node = model.nodes.get(name)
        shape = _shape(value)
        if node is None or node.kind != "input" or len(shape) < len(node.plates):
            continue  # said when the value is read
        for plate, size in zip(node.plates, shape, strict=False):
            if found.setdefault(plate, size) != size:
                raise PlateError(
                    f"the new inputs bring {found[plate]} and {size} ({name!r}) elements of plate "
                    f"{plate!r}; give all "
                    "inputs of a plate for the same elements"
                )
    return {plate: size for plate, size in found.items() if model.sizes[plate] != size}


def store(node: CompiledNode, value: Any) -> np.ndarray:
    """Complete user values (any batch axes in front) as stored values; faults name the node."""
    try:
        if node.domain is not None:
            stored = node.domain.encode(value)
        else:
            stored = np.array(value)
            if stored.dtype.kind not in "biuf":
                raise EvidenceError(f"values of dtype {stored.dtype}; give numbers")
            if not node.is_discrete:
                stored = stored.astype(float, copy=False)
            elif stored.dtype.kind != "i" and (stored == np.floor(stored)).all():
                stored = stored.astype(np.int64)
    except (EvidenceError, TypeError) as error:  # a list among labels is unhashable
        raise EvidenceError(f"node {node.name!r}: {error}") from None
    trailing = len(node.value_shape)
    if stored.shape[stored.ndim - trailing :] != node.value_shape or stored.ndim < trailing:
        raise EvidenceError(_shape_message(node, stored.shape))
    stored.flags.writeable = False
    return stored


def _missing(node: CompiledNode, value: Any) -> tuple[np.ndarray, np.ndarray]:
    """The value as an array and which entries are missing; a lone NaN is refused."""
    masked = np.ma.getmaskarray(value) if isinstance(value, np.ma.MaskedArray) else None
    data = value.data if isinstance(value, np.ma.MaskedArray) else value
    if node.domain is not None and node.domain.labels is not None:
        if hasattr(data, "labels") and hasattr(data, "codes"):
            data = data.labels
        array = np.array(data, dtype=object)
        flat = [v is None or (isinstance(v, float) and v != v) for v in array.ravel().tolist()]
        missing = np.array(flat, dtype=bool).reshape(array.shape)
    else:
        array = np.asarray(data)
        if array.dtype == object:
            try:
                if any(isinstance(entry, str) for entry in array.ravel().tolist()):
                    raise ValueError  # texts of numbers are no numbers
                array = np.array(data, dtype=float)
            except (TypeError, ValueError):
                raise EvidenceError(
                    f"evidence on {node.name!r}: {_peek(data)} is not a number"
                ) from None
        if array.dtype.kind not in "biuf":
            raise EvidenceError(
                f"evidence on {node.name!r}: {_peek(data)} is not among its values "
                f"({_allowed(node)})"
            )
        missing = np.isnan(array) if array.dtype.kind == "f" else np.zeros(array.shape, dtype=bool)
    if missing.any() and not node.plates and (missing.all() or not node.event_shape):
        raise EvidenceError(
            f"evidence on {node.name!r} is {_peek(data)}, which means nothing for a node without "
            "plates; leave it out (or give None) if it is unobserved"
        )
    return array, missing if masked is None else missing | masked


def _check_support(
    node: CompiledNode, stored: np.ndarray, observed: np.ndarray, whole: np.ndarray
) -> None:
    event = tuple(range(len(node.plate_shape), stored.ndim))
    if stored.dtype.kind == "f":
        bad = ~np.isfinite(stored) & np.expand_dims(observed, event)
        if bad.any():
            at = first_index(bad)
            raise EvidenceError(
                f"evidence on {node.name!r} is {stored[at]:g}{at_index(at)}; it must be finite"
                + (f"; {_NO_READING}" if event else "")
            )
    support = node.support or node.reach
    if node.domain is not None or support is None:
        return
    if support.event_ndim not in (0, len(node.event_shape)):
        return
    inside = np.asarray(support.contains(stored))
    alone = bool(event) and support.event_ndim == 0  # an interval, for every component of a vector
    # what fills a vector that was seen in part need not be in its support
    outside = ~inside & (np.expand_dims(observed, event) if alone else whole)
    if outside.any():
        at = first_index(outside)
        raise EvidenceError(
            f"evidence on {node.name!r} is {_short(stored[at])}{at_index(at)}, outside its support "
            f"({support.describe()})"
        )


def _short(value: np.ndarray) -> str:
    """A value in a line: of a long vector its least and largest number."""
    if value.size <= 6:
        return str(value)
    return f"a vector of {value.size} numbers from {value.min():g} to {value.max():g}"


def _allowed(node: CompiledNode) -> str:
    if node.domain is not None:
        return node.domain._allowed()
    return node.support.describe() if node.support is not None else "numbers"


def _shape_message(node: CompiledNode, shape: Shape) -> str:
    plates = ", ".join(f"{p}={n}" for p, n in zip(node.plates, node.plate_shape, strict=True))
    fix = surplus(node.name, node.plates, node.value_shape, shape)
    return (
        f"evidence on {node.name!r} has shape {shape}, but the node's plates ({plates or 'none'}) and "
        f"event shape {node.event_shape} make {node.value_shape}{fix}"
    )


def _no_array(node: CompiledNode, value: Any, error: Exception) -> str:
    """What keeps nested lists from being an array."""
    shapes = [_shape(v) for v in value] if isinstance(value, (list, tuple)) else []
    odd = next((k for k, s in enumerate(shapes) if s != shapes[0]), None)
    if odd is None:
        return f"evidence on {node.name!r} is no array: {error}"
    plates = ", ".join(f"{p}={n}" for p, n in zip(node.plates, node.plate_shape, strict=True))
    return (
        f"evidence on {node.name!r} is ragged: entry 0 has shape {shapes[0]} and entry {odd} has shape "
        f"{shapes[odd]}; give an array of shape {node.value_shape} (plates {plates or 'none'}, event shape "
        f"{node.event_shape}), with NaN where nothing was seen"
    )


def _shape(value: Any) -> Shape:
    try:
        return np.shape(value)
    except ValueError:
        return ()


def _peek(value: Any) -> str:
    array = np.asarray(value, dtype=object)
    return (
        repr(array.item()) if array.size == 1 else repr(array.ravel()[:3].tolist())[:-1] + ", ...]"
    )


def _close(name: str, model: Model) -> str:
    return did_you_mean(name, model.nodes) or f"; its nodes are {_some(list(model.nodes))}"


def _some(names: list[str]) -> str:
    return ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
