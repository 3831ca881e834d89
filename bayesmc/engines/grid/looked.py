"""Draws from the cells of a belief, so that rows can be held against those that a grid expects."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from bayesmc.categorical import pick
from bayesmc.engines.grid.moves import Cells
from bayesmc.engines.grid.slice import Placed
from bayesmc.engines.grid.tables import GridModel
from bayesmc.engines.particles.predictive import Draws
from bayesmc.engines.particles.smc import along_plates


def draws_of(model: GridModel, cells: Cells | None) -> Draws | None:
    """Draws from a belief, of the nodes that the next slice reads; None before slice 0."""
    return None if cells is None else partial(_drawn, model, cells)


# ---- private ------------------------------------------------------------------------------------


def _drawn(
    model: GridModel, cells: Cells, rng: np.random.Generator, count: int
) -> dict[str, np.ndarray]:
    """Values of so many draws, first axis, of each node; without that axis where it is seen."""
    at = _positions(cells, model.lead, rng, count)
    return {n: _taken(model, cells.placed, n, at) for n in model.slices.interface}


def _positions(
    cells: Cells, lead: tuple[int, ...], rng: np.random.Generator, count: int
) -> tuple[np.ndarray, ...]:
    """Cells in proportion to their probabilities: along every axis positions, shape (count, *lead)."""
    shape = cells.placed.shape
    if not shape:
        return ()
    probs = np.broadcast_to(cells.probs, (*shape, *lead)).reshape(math.prod(shape), -1)
    flat = pick(probs, rng.random((probs.shape[1], count)).T)
    return tuple(np.unravel_index(flat.reshape(count, *lead), shape))


def _taken(model: GridModel, placed: Placed, name: str, at: tuple[np.ndarray, ...]) -> np.ndarray:
    """A node's values at cells; elements of plates that are filtered separately have cells of their own."""
    node, value = model.slices.later[name], placed.values[name]
    batch = value.ndim - len(node.value_shape)
    axes = [k for k in range(batch) if value.shape[k] > 1]
    if not axes:
        return value.reshape(value.shape[batch:])
    sizes = [value.shape[k] for k in axes]
    index = np.ravel_multi_index([at[k] for k in axes], sizes)
    each = np.broadcast_to(value, value.shape[:batch] + node.value_shape)
    each = each.reshape(-1, *node.value_shape)
    return along_plates(each, index, node.plates, model.apart) if model.apart else each[index]
