"""What waits for the tables of a slice: nodes computed from finite ones, and what is missing of sensors.

It is computed, or drawn, given one draw from each particle's tables. No weight depends on it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from bayesmc.dbn import Row, Slices
from bayesmc.network.forward import Compute, Draw, Pass


def drawn_afterwards(
    slices: Slices,
    row: Row,
    names: Collection[str],
    values: Mapping[str, np.ndarray],
    particles: int,
    rng: np.random.Generator,
) -> dict[str, np.ndarray]:
    """Values of nodes that are not seen in full, given those of all others.

    Parameters
    ----------
    names : collection of str
    values : dict
        By the names that functions of the slice have for them.
    """
    model, found = slices.model(row.t), {}
    state = Pass(rng, (particles,), dict(values))
    for name in model.nodes:
        if name not in names:
            continue
        node, seen = model[name], row.seen.get(name)
        if seen is not None and seen.mask is None:
            continue
        (Draw if node.is_stochastic else Compute)(model, node)(state)
        if seen is not None and seen.mask is not None:
            mask = seen.mask.reshape(seen.mask.shape + (1,) * len(node.event_shape))
            value = np.where(mask, seen.value, state.values[name])
            value.flags.writeable = False
            state.values[name] = value
        found[name] = state.values[name]
    return found
