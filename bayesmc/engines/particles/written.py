"""What a run keeps of slices: those that wait to be written, and what is written of them."""

from __future__ import annotations

from collections.abc import Mapping
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
