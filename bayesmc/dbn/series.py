"""Observations and inputs over time: read once, checked as a whole, and given out row by row.

Reading treats time as one more plate, so that labels, shapes, supports and missing entries follow the rules
of evidence; a row that is missing altogether is left out of its slice.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple, Protocol
from weakref import WeakKeyDictionary

import numpy as np

from bayesmc.dbn.given import check_even, check_frame, check_steps, count_of, is_missing
from bayesmc.dbn.slices import PREVIOUS, TIME, Slices, Template
from bayesmc.errors import EvidenceError, PlateError, did_you_mean
from bayesmc.network import Observed
from bayesmc.network.doubts import warn_of_doubts
from bayesmc.network.evidence import checked_input, observe
from bayesmc.network.labels import by_label, refuse_backwards, refuse_crossed
from bayesmc.network.model import CompiledNode
from bayesmc.network.node import Declaration


class Compiled(Protocol):
    """What data are read against: a template that compiles for the sizes that they settle."""

    @property
    def template(self) -> Template: ...

    def slices(self, sizes: Mapping[str, int], inputs: Mapping[str, np.ndarray]) -> Slices: ...


class Row(NamedTuple):
    """What is known of one slice.

    Attributes
    ----------
    t : int
    seen : dict
        Node -> ``Observed``, of nodes seen at least in part.
    inputs : dict
        ``t``, inputs and, after slice 0, ``t_prev`` and the inputs of the slice before, by their names.
    """

    t: int
    seen: dict[str, Observed]
    inputs: dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Series:
    """Data of several slices.

    Attributes
    ----------
    steps : int
    observed : dict
        Node -> ``Observed`` with time as the first plate; its mask has shape (steps, *plates).
    inputs : dict
        Input -> values, shape (steps, *plates, *event).
    static : dict
        Static node -> ``Observed``.
    """

    steps: int
    observed: dict[str, Observed]
    inputs: dict[str, np.ndarray]
    static: dict[str, Observed] = field(default_factory=dict)
    #: the slice that row 0 belongs to
    start: int = 0

    @cached_property
    def _looked_at(self) -> dict[str, tuple[Any, Any, Any]]:
        """Node -> what was seen, and for each row whether all and whether some of it was seen."""
        found: dict[str, tuple[Any, Any, Any]] = {}
        for name, seen in self.observed.items():
            flat = None if seen.mask is None else seen.mask.reshape(self.steps, -1)
            full = None if flat is None else flat.all(axis=1).tolist()
            some = None if flat is None else flat.any(axis=1)
            if some is not None and seen.parts is not None:
                some = some | seen.parts.reshape(self.steps, -1).any(axis=1)
            found[name] = (seen, full, None if some is None else some.tolist())
        return found

    def row(self, k: int) -> Row:
        """What is known of the k-th slice here."""
        seen = {}
        for name, (found, full, some) in self._looked_at.items():
            if full is None or full[k]:
                seen[name] = Observed(found.value[k, ...])
            elif some[k]:
                parts = None if found.parts is None else found.parts[k, ...]
                if parts is not None and not parts.any():
                    parts = None
                seen[name] = Observed(found.value[k, ...], found.mask[k, ...], parts)
        t = self.start + k
        inputs: dict[str, np.ndarray] = {TIME: np.asarray(t)}
        if t:
            inputs[TIME + PREVIOUS] = np.asarray(t - 1)
        for name, values in self.inputs.items():
            inputs[name] = values[k, ...]
            if k:
                inputs[name + PREVIOUS] = values[k - 1, ...]
        return Row(t, seen, inputs)

    def alike(self, k: int, most: int) -> int:
        """How many rows from the k-th on see the same nodes, each in full or not at all; so many at most."""
        last, looked_at = min(k + most, self.steps), self._looked_at.values()
        masked = [(full, some) for _, full, some in looked_at if full is not None]
        if not masked:
            return last - k
        for other in range(k, last):
            if any(full[other] != full[k] or full[other] != some[other] for full, some in masked):
                return other - k
        return last - k


def read_series(
    dbn: Compiled,
    observations: Mapping[str, Any] | None,
    inputs: Mapping[str, Any] | None,
    steps: int | None = None,
    plates: Mapping[str, int] | None = None,
    ahead: int = 0,
) -> tuple[Slices, Series]:
    """The compiled slices for some data, and the data as stored values.

    ``ahead`` slices follow the last row of the observations; inputs have rows for them, too.

    Raises
    ------
    EvidenceError, PlateError
    """
    template = dbn.template
    if observations is not None and not isinstance(observations, Mapping):
        raise EvidenceError(
            f"observations is a {type(observations).__name__}; give a dict from node name to its rows, time "
            "first"
        )
    given = {n: v for n, v in (observations or {}).items() if v is not None}
    for name in given:
        _check_observed(template, name)
    timed = {n: _rows(template, n, v) for n, v in given.items() if n not in template.static}
    timely = {**{n: v for n, v in given.items() if n not in template.static}, **(inputs or {})}
    known = template.later
    refuse_crossed(
        [(n, v, known[n].plates) for n, v in timely.items() if n in known],
        template.plates.labels,
        timed=True,
    )
    if ahead:
        check_steps("forecast", ahead)
    count = count_of(timed, _input_rows(template, inputs), steps, ahead)
    if count == ahead:  # series without rows say nothing
        timed = {}
    sizes = sizes_of(template, {**timed, **(inputs or {})}, plates)
    rows = read_input_rows(template, sizes, inputs, count)
    two = {n: v[min(1, count - 1)] for n, v in rows.items()}
    two |= {n + PREVIOUS: v[0] for n, v in rows.items()}
    slices = dbn.slices(sizes, two)
    observed = {
        n: _padded(_observed(slices.later[n], v, count - ahead), slices.later[n], ahead)
        for n, v in timed.items()
    }
    static = {
        n: observe(slices.first[n], _by_label(template, n, v))
        for n, v in given.items()
        if n in template.static
    }
    for name, found in observed.items():
        if found is not None and slices.later[name].angles is not None:
            warn_of_doubts(slices.later, name, found)
    return slices, Series(
        count,
        {n: o for n, o in observed.items() if o is not None},
        rows,
        {n: o for n, o in static.items() if o is not None},
    )


def read_row(
    dbn: Compiled,
    slices: Slices | None,
    t: int,
    observations: Mapping[str, Any] | None,
    inputs: Mapping[str, Any] | None,
    before: Mapping[str, np.ndarray],
) -> tuple[Slices, Row]:
    """One row by itself, without an axis for time.

    Parameters
    ----------
    slices : Slices or None
        What the rows before were read for; None for the first.
    before : dict
        Inputs of the slice before.

    Raises
    ------
    EvidenceError, PlateError
    """
    template = dbn.template
    for what, given in (("observations", observations), ("inputs", inputs)):
        if given is not None and not isinstance(given, Mapping):
            raise EvidenceError(
                f"{what} is a {type(given).__name__}; give a dict from name to the value in this slice"
            )
    rows = {
        n: _in_time(_by_label(template, n, v))
        for n, v in (observations or {}).items()
        if v is not None
    }
    given = {n: [_by_label(template, n, v)] for n, v in (inputs or {}).items() if v is not None}
    for name in rows:
        _check_observed(template, name)
        if name in template.static:
            raise EvidenceError(
                f"observations of {name!r} in one slice, and that node is static; give its value once, "
                f"start(dbn, static={{{name!r}: value}})"
            )
    _check_inputs(template, slices, rows, given)
    if slices is None:
        slices, series = read_series(dbn, rows, given, steps=1)
    else:
        sizes = slices.later.sizes
        values = read_input_rows(template, sizes, given, 1)
        seen = {n: _observed(slices.later[n], _rows(template, n, v), 1) for n, v in rows.items()}
        series = Series(1, {n: o for n, o in seen.items() if o is not None}, values)
    row = series.row(0)
    row.inputs[TIME] = np.asarray(t)
    if t:
        row.inputs[TIME + PREVIOUS] = np.asarray(t - 1)
        row.inputs.update({n + PREVIOUS: v for n, v in before.items()})
    return slices, Row(t, row.seen, row.inputs)


def read_input_rows(
    template: Template,
    sizes: Mapping[str, int],
    inputs: Mapping[str, Any] | None,
    steps: int,
) -> dict[str, np.ndarray]:
    """Inputs of all slices; every one that is declared must be given, in full.

    Raises
    ------
    EvidenceError
    """
    given = _input_rows(template, inputs)
    read = {}
    for name in template.inputs:
        if name not in given:
            raise EvidenceError(
                f"input {name!r} has no values; pass inputs={{{name!r}: array}}, time first"
            )
        read[name] = checked_input(template.later[name], given[name], sizes, steps)
    return read


def sizes_of(
    template: Template,
    data: Mapping[str, Any],
    plates: Mapping[str, int] | None = None,
) -> dict[str, int]:
    """Sizes of all plates: declared ones, else read off the data behind its axis of time.

    Raises
    ------
    PlateError
    """
    sizes = {**template.plates.sizes, **(plates or {})}
    for name, value in data.items():
        declaration = template.later.get(name)
        if declaration is None:
            continue
        for plate, size in zip(declaration.plates, np.shape(value)[1:], strict=False):
            if sizes[plate] is None:
                sizes[plate] = size
    used = {p for d in template.later.values() for p in d.plates}
    for plate, size in sizes.items():
        if size is None and plate in used:
            raise PlateError(
                f"the size of plate {plate!r} is not known; observe a node in it, or declare "
                f"plates={{{plate!r}: size}}"
            )
    return {p: n if n is not None else 0 for p, n in sizes.items()}


def unrolled(template: Template, observations: Mapping[str, Any]) -> dict[str, Any]:
    """See ``DynamicBayesNet.unrolled_evidence``."""
    if not isinstance(observations, Mapping):
        raise EvidenceError(
            f"observations is a {type(observations).__name__}; give a dict from node name to its rows"
        )
    evidence = {}
    for name, value in observations.items():
        _check_observed(template, name)
        if name in template.static:
            evidence[name] = _by_label(template, name, value)
            continue
        if value is None:
            continue
        for t, row in enumerate(_rows(template, name, value)):
            if not is_missing(row):
                evidence[f"{name}[{t}]"] = row
    return evidence


# ---- private ------------------------------------------------------------------------------------


def _in_time(value: Any) -> Any:
    """One row as a series of one."""
    return value[None] if isinstance(value, (np.ndarray, np.ma.MaskedArray)) else [value]


def _check_inputs(
    template: Template, slices: Slices | None, rows: Mapping[str, Any], given: Mapping[str, Any]
) -> None:
    """Refuse inputs of one slice that are missing or of another shape; the axis for time is ours."""
    missing = [n for n in template.inputs if n not in given]
    if missing:
        raise EvidenceError(
            f"input {missing[0]!r} has no value in this slice; give step(..., inputs={{{missing[0]!r}: "
            "value}), also where observations are missing"
        )
    sizes = sizes_of(template, {**rows, **given}) if slices is None else slices.later.sizes
    for name in template.inputs:
        checked_input(template.later[name], given[name][0], sizes)


def _check_observed(template: Template, name: str) -> None:
    if name in template.inputs:
        raise EvidenceError(f"observations of {name!r}, which is an input; give it with inputs=")
    if name not in template.later:
        raise EvidenceError(f"observations of {name!r}: {template.unknown(name)}")


def _by_label(template: Template, name: str, value: Any, ahead: int = 0) -> Any:
    """What is labelled in the order of the plates; ``ahead`` counts the axis of time."""
    if name not in template.later:
        return value
    plates = template.later[name].plates
    return by_label(f"data of {name!r}", value, plates, template.plates.labels, ahead)


def _input_rows(template: Template, inputs: Mapping[str, Any] | None) -> dict[str, Any]:
    if inputs is not None and not isinstance(inputs, Mapping):
        raise EvidenceError(f"inputs is a {type(inputs).__name__}; give a dict from name to rows")
    for name, given in (inputs or {}).items():
        check_frame(f"inputs of {name!r}", given)
    inputs = {n: _by_label(template, n, v, 1) for n, v in (inputs or {}).items()}
    for name in inputs:
        if name not in template.inputs:
            raise EvidenceError(
                f"inputs= gives {name!r}, which is not a declared input"
                f"{did_you_mean(name, template.inputs)}; the inputs are {list(template.inputs)}"
            )
        check_even(f"inputs of {name!r}", inputs[name], "an input is known in every slice")
        if np.ndim(inputs[name]) == 0:
            raise EvidenceError(
                f"inputs of {name!r}: {inputs[name]!r} has no axis for time; give one row per slice"
            )
    return dict(inputs)


def _rows(template: Template, name: str, value: Any) -> Any:
    """A series with None rows of vectors filled, so that it is an array."""
    refuse_backwards(f"observations of {name!r}", value)
    check_frame(f"observations of {name!r}", value)
    value = _by_label(template, name, value, 1)
    if isinstance(value, (list, tuple)) and any(v is None for v in value):
        shapes = {np.shape(v) for v in value if v is not None}
        if len(shapes) == 1 and (shape := shapes.pop()):
            return [np.full(shape, np.nan) if v is None else v for v in value]
    check_even(f"observations of {name!r}", value, "a missing row is None")
    if np.ndim(value) == 0:
        raise EvidenceError(
            f"observations of {name!r}: {value!r} has no axis for time; give one row per slice"
        )
    return value


def _padded(found: Observed | None, node: CompiledNode, ahead: int) -> Observed | None:
    """With so many missing rows behind."""
    if found is None or not ahead:
        return found
    mask = found.mask
    if mask is None:
        mask = np.ones((len(found.value), *node.plate_shape), dtype=bool)
    value = np.concatenate([found.value, np.repeat(found.value[:1], ahead, axis=0)])
    masks = [None if m is None else np.concatenate([m, np.zeros((ahead, *m.shape[1:]), dtype=bool)])
             for m in (mask, found.parts)]  # fmt: skip
    return Observed(value, *masks)


def _observed(node: CompiledNode, value: Any, steps: int) -> Observed | None:
    if not node.is_stochastic:
        raise EvidenceError(
            f"observations of {node.name!r}, which is a deterministic node and takes none; observe a "
            "stochastic node, or give it a narrow distribution"
        )
    return observe(_over_time(node, steps), value)


def _over_time(node: CompiledNode, steps: int) -> CompiledNode:
    """The node with time as its first plate; that of one slice is kept, for filters that go row by row."""
    found = _ALONE.get(node) if steps == 1 else None
    if found is None:
        declaration: Declaration = node.declaration
        found = replace(
            node,
            declaration=replace(declaration, plates=("time", *declaration.plates)),
            plate_shape=(steps, *node.plate_shape),
        )
        if steps == 1:
            _ALONE[node] = found
    return found


_ALONE: WeakKeyDictionary[CompiledNode, CompiledNode] = WeakKeyDictionary()
