"""What a run keeps of slices: those that wait to be written, and what is written of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from bayesmc.dbn import Row
from bayesmc.engines.particles.families import Families
from bayesmc.engines.particles.smc import Particles


class Waiting(NamedTuple):
    """A slice that is not written yet: its families, where they are known, and values of queries."""

    k: int
    particles: Particles
    row: Row | None
    families: Families | None
    values: Mapping[str, np.ndarray]


#: arrays by node or query, slices first, by what they are
Rows = dict[str, dict[str, np.ndarray]]
KINDS = ("tables", "means", "variances", "queries", "errors", "query errors", "filter")


class Written(NamedTuple):
    """What is kept of slices in a row; particles are those of the last, where they are not held."""

    rows: Rows
    families: list[Families]
    particles: list[Particles]


def joined(written: Sequence[Written], what: str) -> dict[str, np.ndarray]:
    """Arrays of one kind, of all slices that are written."""
    names = {n: None for w in written for n in w.rows[what]}
    pieces = {n: [w.rows[what][n] for w in written if n in w.rows[what]] for n in names}
    return {n: np.concatenate(rows) for n, rows in pieces.items()}


def together(written: Sequence[Written]) -> Written:
    """Slices without their particles, as one."""
    return Written({what: joined(written, what) for what in KINDS}, [], [])


def count(written: Written) -> int:
    """How many slices are written there."""
    return len(written.rows["filter"]["increments"])


def last_rows(written: Written, first: int) -> Written:
    """The slices from one on; particles, where there are any, stay."""
    if not first:
        return written
    rows = {what: {n: a[first:] for n, a in own.items()} for what, own in written.rows.items()}
    return written._replace(rows=rows)
