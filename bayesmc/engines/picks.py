"""Inputs that pick an element which their plate does not have: told by name, once something went wrong."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np

from bayesmc.dbn import Row, SeriesProblem, Slices
from bayesmc.errors import EvidenceError
from bayesmc.expression import Program
from bayesmc.network.model import Model
from bayesmc.structure.picked import picked_element


@contextmanager
def picks_told(slices: Slices, rows: Iterable[Row]) -> Iterator[None]:
    """Has an index that is outside of a plate say which input it comes from, in which of some rows.

    Raises
    ------
    EvidenceError
    """
    try:
        yield
    except IndexError as error:
        for row in rows:
            why = _outside(slices.model(row.t), row.inputs)
            if why is not None:
                raise EvidenceError(f"slice {row.t}: {why}") from error
        raise


def rows_of(problem: SeriesProblem) -> Iterator[Row]:
    """The rows of a series, one after the other."""
    return (problem.series.row(k) for k in range(problem.steps))


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
