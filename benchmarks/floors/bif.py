"""A small BIF reader for the benchmarks: enough for the networks of the bnlearn repository.

It trusts its input. It does not report errors with file and line, does not read properties, and
does not write; the floors need a reader of their own so that no timing depends on the library's.
"""

from __future__ import annotations

import gzip
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

_VARIABLE = re.compile(r"variable\s+(\S+)\s*\{[^{}]*\[\s*\d+\s*\]\s*\{([^{}]*)\}\s*;[^{}]*\}")
_PROBABILITY = re.compile(r"probability\s*\(([^()]*)\)\s*\{([^{}]*)\}")
_ROW = re.compile(r"\(([^()]*)\)\s*([^;]*);")


@dataclass(frozen=True)
class Record:
    """One node of a discrete network.

    ``probs`` has shape ``(card(parent_1), ..., card(parent_n), card(name))``, rows summing to 1.
    """

    name: str
    states: tuple[str, ...]
    parents: tuple[str, ...]
    probs: np.ndarray


def read(path: str | Path) -> list[Record]:
    """Read a ``.bif`` or ``.bif.gz`` file into records, parents before children."""
    raw = Path(path).read_bytes()
    text = (gzip.decompress(raw) if str(path).endswith(".gz") else raw).decode()
    states = {name: _split(body) for name, body in _VARIABLE.findall(text)}
    records = {}
    for head, body in _PROBABILITY.findall(text):
        name, _, given = (part.strip() for part in head.partition("|"))
        parents = _split(given)
        records[name] = Record(name, states[name], parents, _table(name, parents, body, states))
    return _parents_first(records)


def as_arrays(records: Sequence[Record]) -> list[tuple[str, int, tuple[int, ...], np.ndarray]]:
    """The records as ``(name, card, parent indices, table)``: the input of the discrete floor."""
    place = {record.name: i for i, record in enumerate(records)}
    return [(r.name, len(r.states), tuple(place[p] for p in r.parents), r.probs) for r in records]


def codes(records: Sequence[Record], evidence: Mapping[str, str]) -> dict[str, int]:
    """Evidence by state label as evidence by state index."""
    states = {record.name: record.states for record in records}
    return {name: states[name].index(label) for name, label in evidence.items()}


def _split(text: str) -> tuple[str, ...]:
    return tuple(part.strip().strip('"') for part in text.split(",") if part.strip())


def _table(
    name: str, parents: tuple[str, ...], body: str, states: dict[str, tuple[str, ...]]
) -> np.ndarray:
    table = np.full([len(states[p]) for p in (*parents, name)], np.nan)
    if parents:
        code = [{label: i for i, label in enumerate(states[p])} for p in parents]
        for labels, numbers in _ROW.findall(body):
            row = tuple(c[label] for c, label in zip(code, _split(labels), strict=True))
            table[row] = np.fromiter(map(float, numbers.split(",")), float)
    else:
        table[:] = [float(x) for x in body.split("table", 1)[1].rstrip("; \n").split(",")]
    if np.isnan(table).any():
        raise ValueError(f"{name}: some rows of its table are missing")
    return table / table.sum(axis=-1, keepdims=True)  # the files are rounded to a few digits


def _parents_first(records: dict[str, Record]) -> list[Record]:
    ordered: dict[str, Record] = {}
    waiting = list(records.values())
    while waiting:
        ready = [r for r in waiting if all(p in ordered for p in r.parents)]
        if not ready:
            raise ValueError("the network has a cycle")
        ordered.update({r.name: r for r in ready})
        waiting = [r for r in waiting if r.name not in ordered]
    return list(ordered.values())
