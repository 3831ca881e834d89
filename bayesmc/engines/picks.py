"""Inputs that pick an element which their plate does not have: told by name, once something went wrong."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.dbn import Row, Slices
from bayesmc.dbn.series import Series
from bayesmc.expression import Program
from bayesmc.network.model import Model
from bayesmc.structure.picked import picked_element


def pick_outside(slices: Slices, rows: Series | Sequence[Row]) -> str | None:
    """Which input of a row picks an element that is outside of its plate, and what to do, or None."""
    every = rows if isinstance(rows, Sequence) else (rows.row(k) for k in range(rows.steps))
    for row in every:
        why = _outside(slices.model(row.t), row.inputs)
        if why is not None:
            return f"slice {row.t}: {why}"
    return None


# ---- private ------------------------------------------------------------------------------------


def _outside(model: Model, inputs: Mapping[str, np.ndarray]) -> str | None:
    for name in model.nodes:
        if not model[name].is_stochastic:
            continue
        for source in model[name].parents:
            if source not in model.nodes or not model[source].plates:
                continue
            at = picked_element(model, name, [source])
            if at is None or not at.leaves or not at.leaves <= inputs.keys():
                continue
            found = np.asarray(Program([at])({n: np.asarray(inputs[n]) for n in at.leaves})[0])
            if (found < -1).any():
                return _told(model, name, source, sorted(at.leaves), inputs, found < -1)
    return None


def _told(
    model: Model,
    name: str,
    source: str,
    labels: list[str],
    inputs: Mapping[str, Any],
    bad: np.ndarray,
) -> str:
    value = np.asarray(inputs[labels[0]])
    where = f" is {value[bad][0]}" if value.shape == bad.shape and bad.ndim else " is outside"
    where = f" is {value}" if not value.ndim else where
    plates = " and ".join(map(repr, model[source].plates))
    size = " and ".join(f"0..{k - 1}" for k in model[source].plate_shape)
    return (
        f"input {labels[0]!r}{where}, but picks elements of plate {plates}, which are {size}, for {name!r}; "
        "where a reading is missing, too, it is one of these: give any, 0 for instance"
    )
