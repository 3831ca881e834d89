"""A data frame as evidence and inputs: columns to nodes, rows to elements of plates.

A column called like a plate says by its labels which element a row is about; so rows may come in any order,
and of nodes in several plates as a long table. Without such a column rows go to elements in order, or by the
index where that has labels. Over time, time is one plate more, the first (``dbn/frames``).
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.errors import EvidenceError, did_you_mean
from bayesmc.network.columns import Labelled, columns_of, is_frame
from bayesmc.network.node import Declaration

_COMPONENT = re.compile(r"^(.*)\[([^\[\]]*)\]$", re.DOTALL)


@dataclass(frozen=True, eq=False)
class Table:
    """Rows of a data frame, and what they are about.

    Attributes
    ----------
    what : str
        For messages.
    columns : dict
        Name -> array, rows first.
    keys : dict
        Plate -> position of the element that each row is about.
    given : dict
        Plate -> the labels as they were given.
    sizes : dict
        Plate -> size, of those.
    rows : int
    index : sequence or None
        Labels of rows without a name.
    """

    what: str
    columns: dict[str, np.ndarray]
    keys: dict[str, np.ndarray]
    given: dict[str, np.ndarray]
    sizes: dict[str, int]
    rows: int
    index: Any = None

    def values(
        self,
        name: str,
        plates: Sequence[str],
        labels: Mapping[str, tuple[Any, ...]],
        finer: bool = False,
    ) -> Any:
        """What the rows say of a node, over its plates; NaN or None for elements without a row.

        ``finer`` says that other columns have more to say of each element, so that rows may repeat this one.

        Raises
        ------
        EvidenceError
        """
        if is_frame(self.columns.get(name)):  # of columns in two levels
            return self.columns[name]
        parts = components(name, self.columns)
        where = {p: k for k, p in enumerate(plates)}
        if parts is None:
            values, wide = self.columns[name], []
        else:
            open_ = [p for p in plates if p not in self.keys]
            long = [p for p in plates if p in self.keys]
            wide = open_ if long or not plates else _across(self.what, name, parts, open_, labels)
            values, wide = _widened(self.what, name, parts, self.columns, wide, labels)
        keyed = [p for p in plates if p in self.keys]
        by_row = [p for p in plates if p not in keyed and p not in wide]
        if len(by_row) > 1 or (by_row and keyed):
            raise EvidenceError(
                f"{self.what}: {name!r} is in the plates {tuple(plates)}, and the rows do not say of which "
                f"{by_row[-1]!r} they are; give a column {by_row[-1]!r} with its labels, or "
                f"{name!r} as an array"
            )
        if keyed:
            values = self._placed(name, values, keyed, finer)
        elif not by_row:
            values = self._single(name, values, finer)
        order = [*keyed, *by_row, *wide]
        places = sorted(range(len(order)), key=lambda k: where[order[k]])
        values = values.transpose(*places, *range(len(order), values.ndim))
        return values if self.index is None or not by_row else Labelled(values, self.index)

    def _single(self, name: str, values: np.ndarray, constant: bool) -> np.ndarray:
        if self.rows == 1 or (constant and all(_same(v, values[0]) for v in values)):
            return values[0, ...]
        raise EvidenceError(
            f"{self.what}: {name!r} has no plates, and there are {self.rows} rows; one question for "
            f"each row is "
            "infer_many(net, frame), several observations of one node are a plate"
        )

    def _placed(
        self, name: str, values: np.ndarray, keyed: Sequence[str], finer: bool
    ) -> np.ndarray:
        """Rows put where their labels say."""
        shape = [self.sizes[p] for p in keyed]
        at = np.ravel_multi_index(tuple(self.keys[p] for p in keyed), shape)
        unique, first, which = np.unique(at, return_index=True, return_inverse=True)
        for k in np.setdiff1d(np.arange(len(at)), first).tolist():
            one = int(first[which[k]])
            if not finer or not _same(values[k], values[one]):
                raise EvidenceError(
                    f"{self.what}: rows {one} and {k} are both about {self._element(keyed, k)}, and say "
                    f"{_shown(values[one])} and {_shown(values[k])} of {name!r}; drop one of them, "
                    f"or put the "
                    "node in one plate more, which tells them apart"
                )
        values, count = values[first], math.prod(shape)
        tail = values.shape[1:]
        if len(unique) == count:
            placed = np.empty((count, *tail), dtype=values.dtype)
        elif values.dtype.kind in "biuf":
            placed = np.full((count, *tail), np.nan)
        else:
            placed = np.full((count, *tail), None, dtype=object)
        placed[unique] = values
        return placed.reshape(*shape, *tail)

    def _element(self, keyed: Sequence[str], row: int) -> str:
        return ", ".join(f"{p} {_shown(self.given[p][row])}" for p in keyed)


def unframed(
    declarations: Mapping[str, Declaration],
    plates: Mapping[str, int | None],
    labels: Mapping[str, tuple[Any, ...]],
    evidence: Any,
    inputs: Any,
) -> tuple[Any, Any]:
    """Evidence and inputs as dicts where they are data frames (pandas, polars, pyarrow); others as they are.

    A column is about the node or input that it is called like; those of the evidence that are called like
    inputs are inputs. One that is called like a plate says by its labels which element a row is about;
    without it rows are the plate's elements, by the index where that has labels, else in order. Parts of a
    node are columns ``"x[a]"``, ``"x[0]"``.

    Raises
    ------
    EvidenceError
        A column is nothing of the net; labels are unknown, missing, or there twice.

    Examples
    --------
    >>> import pandas as pd  # doctest: +SKIP
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet(plates={"city": ["Bonn", "Ulm"]})
    >>> net.add("y", bmc.Normal(0.0, 1.0), plates="city")
    >>> frame = pd.DataFrame({"city": ["Ulm", "Bonn"], "y": [2.0, 1.0]})  # doctest: +SKIP
    >>> net.unframed(frame)[0]["y"].tolist()  # doctest: +SKIP
    [1.0, 2.0]
    """
    if is_frame(evidence):
        table = read_table("evidence", evidence, declarations, plates, labels)
        found = _by_name(table, declarations, labels)
        evidence = {n: v for n, v in found.items() if declarations[n].source != "input"}
        inputs = with_inputs(found, inputs, declarations)
    if is_frame(inputs):
        table = read_table("inputs", inputs, declarations, plates, labels)
        inputs = _by_name(table, declarations, labels)
    for what, data in (("evidence", evidence), ("inputs", inputs)):
        if data is not None and not isinstance(data, Mapping):
            said = "inputs are" if what == "inputs" else f"{what} is"
            raise EvidenceError(
                f"{said} a {type(data).__name__}; give a dict from node name to value, or a data frame"
            )
    return evidence, inputs


def with_inputs(
    found: Mapping[str, Any], inputs: Any, declarations: Mapping[str, Declaration]
) -> Any:
    """Inputs, and those that a frame of evidence has columns for.

    Raises
    ------
    EvidenceError
        Of one input there are two.
    """
    own = {n: v for n, v in found.items() if declarations[n].source == "input"}
    if not own:
        return inputs
    if is_frame(inputs):
        inputs = columns_of(inputs, "inputs")
    for name in inputs or {}:
        if name in own:
            raise EvidenceError(
                f"the input {name!r} is a column of the data and is in inputs=, too; give it once"
            )
    return {**(inputs or {}), **own}


def read_table(
    what: str,
    frame: Any,
    declarations: Mapping[str, Declaration],
    plates: Mapping[str, int | None],
    labels: Mapping[str, tuple[Any, ...]],
    others: Sequence[str] = (),
) -> Table:
    """The rows of a frame, with what they are about; ``others`` are columns that are no nodes.

    Raises
    ------
    EvidenceError
    """
    columns = columns_of(frame, what)
    named = getattr(getattr(frame, "index", None), "names", None) or ()
    used = {}
    for name, column in columns.items():
        base = _COMPONENT.match(name)
        if name in declarations or (base is not None and base[1] in declarations):
            used[name] = column
        elif name not in plates and name not in others and name not in named:
            raise EvidenceError(
                f"{what}: column {name!r} is no node, input or plate"
                f"{did_you_mean(name, [*declarations, *plates])}; drop it, or rename it (the nodes are "
                f"{', '.join(map(repr, list(declarations)[:8]))})"
            )
    keys, given, sizes = {}, {}, {}
    for plate, size in plates.items():
        own = declarations.get(plate)
        is_value = own is not None and (own.source != "input" or plate in own.plates)
        if plate not in columns or is_value:
            continue
        given[plate] = np.asarray(columns[plate])
        known = labels.get(plate)
        keys[plate] = _positions(what, plate, given[plate], size, known)
        sizes[plate] = len(known) if known is not None else int(keys[plate].max(initial=-1)) + 1
        if own is not None:  # an input that says which element a row belongs to
            used[plate] = keys[plate]
    rows = len(next(iter(columns.values()), ()))
    return Table(what, used, keys, given, sizes, rows, _index(frame, plates))


def components(name: str, columns: Mapping[str, Any]) -> dict[tuple[str, ...], str] | None:
    """Columns ``name[...]`` by what is in the brackets; None where there is a column of the name itself."""
    if name in columns:
        return None
    found = {}
    for column in columns:
        match = _COMPONENT.match(column)
        if match is not None and match[1] == name:
            found[tuple(part.strip() for part in match[2].split(","))] = column
    return found


def names_of(columns: Mapping[str, Any], declarations: Mapping[str, Declaration]) -> list[str]:
    """The nodes that columns are about, in the order of the columns."""
    found: dict[str, None] = {}
    for column in columns:
        base = _COMPONENT.match(column)
        found[column if column in declarations or base is None else base[1]] = None
    return list(found)


# ---- private ------------------------------------------------------------------------------------


def _by_name(
    table: Table, declarations: Mapping[str, Declaration], labels: Mapping[str, tuple[Any, ...]]
) -> dict[str, Any]:
    names = names_of(table.columns, declarations)
    rows = {}
    for name in names:
        own = declarations[name].plates
        if len(own) == 1 and own[0] not in table.keys:
            rows[own[0]] = name
    if len(rows) > 1:
        (one, name), (other, second) = list(rows.items())[:2]
        raise EvidenceError(
            f"{table.what}: rows cannot be elements of {one!r} ({name!r}) and of {other!r} "
            f"({second!r}) at once; "
            f"give a column {other!r} with labels, or a dict of columns"
        )
    return {
        n: table.values(n, declarations[n].plates, labels, _is_coarse(n, names, declarations))
        for n in names
    }


def _is_coarse(name: str, names: Sequence[str], declarations: Mapping[str, Declaration]) -> bool:
    """Whether other columns are about elements of more plates, so that this one is repeated in them."""
    own = set(declarations[name].plates)
    if not own and declarations[name].source != "input":
        return False  # several observations of one node, and not one that is repeated
    return any(set(declarations[other].plates) - own for other in names)


def _index(frame: Any, plates: Mapping[str, Any]) -> Any:
    """Labels of rows, where they are no column of labels."""
    index = getattr(frame, "index", None)
    if index is None or callable(index) or getattr(index, "nlevels", 1) > 1:
        return None
    return None if getattr(index, "name", None) in plates else index


def _positions(
    what: str, plate: str, column: np.ndarray, size: int | None, labels: tuple[Any, ...] | None
) -> np.ndarray:
    """Which elements of a plate labels stand for."""
    given = np.asarray(column)
    if given.ndim > 1:
        raise EvidenceError(
            f"{what}: column {plate!r} has shape {given.shape}; give one label a row"
        )
    if given.dtype.kind == "f" and (given == np.floor(given)).all():
        given = given.astype(np.int64)
    values = given.tolist()
    gap = next((k for k, v in enumerate(values) if v is None or v != v), None)
    if gap is not None:
        raise EvidenceError(f"{what}: row {gap} has no label of plate {plate!r}; drop the row")
    if labels is None:
        top = max(values) if given.dtype.kind in "iu" and values else -1
        if given.dtype.kind not in "iu" or min(values, default=0) < 0 or (size or top + 1) <= top:
            raise EvidenceError(
                f"{what}: column {plate!r} has {_shown(values[0]) if values else 'nothing'}, and "
                f"the plate has "
                f"no labels, only positions 0, 1, 2, ...; declare plates={{{plate!r}: "
                f"[{', '.join(map(repr, list(dict.fromkeys(values))[:3]))}, ...]}}"
            )
        labels = tuple(range(top + 1 if size is None else size))
    where = {label: k for k, label in enumerate(labels)}
    for row, value in enumerate(values):
        if value not in where:
            known = ", ".join(map(repr, labels[:8]))
            raise EvidenceError(
                f"{what}: row {row} is about {value!r}, which is no element of plate {plate!r}"
                f"{did_you_mean(value, labels) or f' (its labels are {known})'}"
            )
    seen = set(values)
    missing = [label for label in labels if label not in seen]
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise EvidenceError(
            f"{what}: no row is about {missing[0]!r} of plate {plate!r}{more}; elements that were "
            f"not observed "
            "have a row, too, with NaN"
        )
    return np.array([where[value] for value in values], dtype=np.intp)


def _widened(
    what: str,
    name: str,
    parts: Mapping[tuple[str, ...], str] | None,
    columns: Mapping[str, np.ndarray],
    plates: Sequence[str],
    labels: Mapping[str, tuple[Any, ...]],
) -> tuple[np.ndarray, list[str]]:
    """Columns ``name[...]`` as one array, rows first: labels of plates, then positions in a vector."""
    parts = parts or {}
    depth = {len(key) for key in parts}
    if len(depth) != 1 or (width := depth.pop()) < len(plates):
        raise EvidenceError(
            f"{what}: the columns {', '.join(map(repr, list(parts.values())[:4]))} do not make one array of "
            f"{name!r}; name them alike, one entry in the brackets for each of {tuple(plates)} and "
            f"each axis of "
            "a vector"
        )
    axes: list[dict[str, int]] = []
    for k in range(width):
        if k < len(plates) and plates[k] in labels:
            axes.append({str(label): i for i, label in enumerate(labels[plates[k]])})
        else:
            axes.append({str(i): i for i in range(len({key[k] for key in parts}))})
    shape = tuple(map(len, axes))
    extra = [
        c for key, c in parts.items() if any(p not in a for p, a in zip(key, axes, strict=True))
    ]
    for at in np.ndindex(shape):
        wanted = tuple(list(axis)[i] for axis, i in zip(axes, at, strict=True))
        if wanted not in parts:
            column = f"{name}[{', '.join(wanted)}]"
            raise EvidenceError(
                f"{what}: there is no column {column!r}{did_you_mean(column, extra)}, which "
                f"{name!r} needs beside "
                f"{next(iter(parts.values()))!r}; a column of NaN says that it was not observed"
            )
    if extra:
        raise EvidenceError(
            f"{what}: column {extra[0]!r} is no part of {name!r}; its parts are "
            f"{', '.join(f'{name}[{label}]' for label in list(axes[0])[:6])}, ...; drop it"
        )
    stacked = [
        columns[parts[tuple(list(axis)[i] for axis, i in zip(axes, at, strict=True))]]
        for at in np.ndindex(shape)
    ]
    array = np.stack(stacked, axis=1)
    return array.reshape(len(array), *shape), list(plates)


def _across(
    what: str,
    name: str,
    parts: Mapping[tuple[str, ...], str],
    plates: Sequence[str],
    labels: Mapping[str, tuple[Any, ...]],
) -> list[str]:
    """Which plates columns ``name[...]`` go across: all but the one of the rows, by what is in brackets.

    Over time rows are slices.
    """
    first = list(plates[1:])
    if plates[0] == "time":
        return first

    def fits(across: Sequence[str]) -> bool:
        return all(
            len(key) >= len(across)
            and all(
                k in map(str, labels[p]) for k, p in zip(key, across, strict=False) if p in labels
            )
            for key in parts
        ) and any(p in labels for p in across)

    ways = [w for w in ([p for p in plates if p != row] for row in plates) if fits(w)]
    if len(ways) > 1:
        raise EvidenceError(
            f"{what}: the columns {', '.join(map(repr, list(parts.values())[:4]))} may be the elements of "
            f"{ways[0][-1]!r} or of {ways[1][-1]!r}; give a column for each of the plates "
            f"{tuple(plates)} with its labels, or {name!r} as an array"
        )
    return ways[0] if ways else first


def _same(one: Any, other: Any) -> bool:
    a, b = np.asarray(one, dtype=object), np.asarray(other, dtype=object)
    return bool(np.all((a == b) | ((a != a) & (b != b))))


def _shown(value: Any) -> str:
    return repr(value.item() if isinstance(value, np.generic) else value)
