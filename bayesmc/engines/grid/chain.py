"""The log evidence alone, where slices differ by nothing but what was seen: a hidden Markov chain of cells.

Rows then weigh the cells of many slices in one call, and a slice is one product with the same matrix. Whoever
learns static nodes asks for thousands of evidences of one series.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bayesmc.dbn import PREVIOUS
from bayesmc.dbn.series import Series
from bayesmc.dbn.slices import TIME
from bayesmc.engines.grid.moves import LOST, TINY, Cells, GridMover
from bayesmc.engines.grid.tables import BLOCK
from bayesmc.network.evidence import Observed

#: slices that are moved one by one: the first is another, and so are the tables of the second
_ALONE = 2


def increments_along(mover: GridMover, series: Series) -> np.ndarray | None:
    """The log density of each row given those before; None where one slice has to be moved after the other.

    Parameters
    ----------
    mover : GridMover
        Is told how much mass slices lost (``GridMover.off``).
    series : Series

    Raises
    ------
    ZeroProbabilityError, UnsupportedError, BudgetError, ParameterError
        Of the first slices.
    """
    if series.start or series.steps <= _ALONE + 1 or not _is_chain(mover, series):
        return None
    cells: Cells | None = None
    found = np.empty(series.steps)
    for k in range(_ALONE + 1):  # the third for its tables
        before, cells = cells, mover.move(cells, series.row(k))
        found[k] = cells.increment
    assert cells is not None and before is not None
    (moving,) = [f for f in mover.model.factors(before.placed, cells.placed) if f.scale is not None]
    n = cells.placed.shape[0]
    if moving.invalid is not None or moving.table.values.shape != (n, n) or moving.scale is None:
        return None
    (scalar,) = cells.placed.scalars
    share = scalar.widths.reshape(n) * np.exp(moving.scale.values.reshape(-1))
    matrix = moving.table.values * share
    step = max(1, BLOCK // n)
    probs = cells.probs.reshape(n)
    for low in range(_ALONE + 1, series.steps, step):
        rows = slice(low, min(low + step, series.steps))
        logs = _weights(mover, series, rows, cells)
        if logs is None:
            return None
        top = logs.max(axis=1)
        if not np.isfinite(top).all():
            return None
        weights = np.exp(logs - top[:, None])
        for k, own in enumerate(weights):
            predicted = probs @ matrix
            mover.off = max(mover.off, abs(float(predicted.sum()) - 1.0))
            probs = predicted * own
            total = float(probs.sum())
            if not total > 0 or _underflows(predicted, share, own, total):
                return None
            probs /= total
            found[low + k] = np.log(total) + top[k]
    return found


# ---- private ------------------------------------------------------------------------------------


def _is_chain(mover: GridMover, series: Series) -> bool:
    """Whether one number moves from slice to slice in the same way, and rows weigh it slice by slice."""
    model = mover.model
    slices = model.slices
    hidden = [n for n in model.own if n not in series.observed and n not in model.leaves]
    if len(hidden) != 1 or model.apart or model.memory or model.logs:
        return False
    (name,) = hidden
    node = slices.later[name]
    if node.plates or node.event_shape or set(slices.interface) != {name}:
        return False
    sources = model.sources(False, name)
    if sources.timed or sources.now - {name} or sources.before - {name}:
        return False
    for other in series.observed:
        if other not in model.own:
            return False
        mask = series.observed[other].mask
        read = model.sources(False, other)
        if read.before or (mask is not None and not mask.all() and other not in model.leaves):
            return False
    return True


def _weights(mover: GridMover, series: Series, rows: slice, cells: Cells) -> np.ndarray | None:
    """Log densities of rows at every cell, shape (rows, cells); None where parameters are bad."""
    model = mover.model
    (name,) = [s.label[0] for s in cells.placed.scalars]
    at = cells.placed.values[name]
    base: dict[str, Any] = {**model.static, **_inputs(series, rows), name: at.reshape(1, -1)}
    base |= {n: _spread(seen.value[rows]) for n, seen in series.observed.items()}
    total = np.zeros((rows.stop - rows.start, at.size))
    for other, seen in series.observed.items():
        log, bad, _ = model.log(False, other, base, _mask(seen, rows), 2)
        if bad is not None and bad.any():
            return None
        total = total + log
    return total


def _inputs(series: Series, rows: slice) -> Mapping[str, np.ndarray]:
    """What is known of slices beside what was seen, along the first of two batch axes."""
    t = np.arange(rows.start, rows.stop)
    found = {TIME: t, TIME + PREVIOUS: t - 1}
    for name, values in series.inputs.items():
        found[name] = values[rows]
        found[name + PREVIOUS] = values[rows.start - 1 : rows.stop - 1]
    return {name: _spread(values) for name, values in found.items()}


def _spread(values: np.ndarray) -> np.ndarray:
    """Values of rows with an axis for the cells."""
    return np.expand_dims(values, 1)


def _mask(seen: Observed, rows: slice) -> np.ndarray | None:
    return None if seen.mask is None or seen.mask.all() else _spread(seen.mask[rows])


def _underflows(predicted: np.ndarray, share: np.ndarray, own: np.ndarray, total: float) -> bool:
    """Whether cells that the belief cannot tell from zero may hold all there is."""
    lost = predicted < TINY * share
    return bool(lost.any() and TINY * float((share * own)[lost].max(initial=0.0)) > LOST * total)
