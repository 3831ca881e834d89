"""How probable modes are: what depends on modes and data alone, for all slices and pairs of modes at once."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from bayesmc.engines.kalman.slices import Layout
from bayesmc.engines.switching.modes import Modes
from bayesmc.network import Observed
from bayesmc.network.forward import summed
from bayesmc.network.model import invalid_error
from bayesmc.network.noiseless import point_log_density


def along_time(timed: Mapping[str, np.ndarray], behind: int) -> dict[str, np.ndarray]:
    """Values with time first and so many further batch axes of length 1 behind it."""
    return {n: v.reshape(len(v), *(1,) * behind, *v.shape[1:]) for n, v in timed.items()}


def modes_along(values: Mapping[str, np.ndarray], behind: int) -> dict[str, np.ndarray]:
    """Values by configuration as a batch: time and, for the last of two, the mode before are in front.

    With ``behind`` 2 they are those of the slice before, and this slice's mode has the axis behind them.
    """
    shape = {0: (1, -1), 1: (1, 1, -1), 2: (1, -1, 1)}[behind]
    return {
        n: v.reshape(*(len(v) if s < 0 else s for s in shape), *v.shape[1:])
        for n, v in values.items()
    }


def log_factors(
    layout: Layout,
    modes: Modes,
    values: dict[str, np.ndarray],
    observed: Mapping[str, Observed],
    start: np.ndarray | None = None,
) -> np.ndarray:
    """Log densities of all nodes that depend on modes and data alone, shape (time, before, now, *lead).

    Parameters
    ----------
    values : dict
        Known values and those of modes, with batch axes of time, the modes before and the modes now.
    observed : dict
        What is seen of modes and of nodes that may be missing, time first.
    start : ndarray, optional
        To be added, of the same shape; minus infinity where modes are known to be impossible.

    Raises
    ------
    ParameterError
        Bad parameters where modes are possible.
    """
    found = np.zeros((1, 1, 1, *(1,) * len(layout.lead))) if start is None else start
    for _, total in running_totals(layout, modes, values, observed, found):
        found = total
    return found


def running_totals(
    layout: Layout,
    modes: Modes,
    values: dict[str, np.ndarray],
    observed: Mapping[str, Observed],
    total: Any,
) -> Iterator[tuple[str, Any]]:
    """A total of log densities after every node that has one; see ``log_factors``."""
    for name in (n for n in layout.order if n in (*layout.certain, *layout.computed)):
        node, model = layout.model[name], layout.model
        is_mode = name in modes.names
        if name in layout.computed:
            result = model.evaluate(name, values)[0]
            if is_mode:
                log = np.where(result == values[name], 0.0, -np.inf)
                total = total + summed(log, node, layout.apart)
            else:
                values[name] = result
        else:
            seen = observed.get(name)
            mask = None
            if not is_mode and name in modes.leaves:
                if seen is None:
                    continue
                values[name], mask = _behind_time(seen.value), seen.mask
            result, batch = model.evaluate(name, values)
            if result.invalid is not None:
                error = invalid_error(node, result, _counts(total, batch), batch, noiseless=True)
                if error is not None:
                    raise error
            log = None
            if result.noiseless is not None:
                log = point_log_density(model, name, result, values)
            if log is None:
                log = model.log_density(name, result, values[name])
            if mask is not None:
                log = np.where(_behind_time(mask), log, 0.0)
            total = total + summed(np.asarray(log), node, layout.apart)
        if is_mode and name in observed:
            seen = observed[name]
            off = values[name] != _behind_time(seen.value)
            if seen.mask is not None:
                off = off & _behind_time(seen.mask)
            total = total + summed(np.where(off, -np.inf, 0.0), node, layout.apart)
        yield name, total


# ---- private ------------------------------------------------------------------------------------


def _behind_time(array: np.ndarray) -> np.ndarray:
    return array.reshape(len(array), 1, 1, *array.shape[1:])


def _counts(total: np.ndarray, batch: tuple[int, ...]) -> np.ndarray:
    """Which parts of a batch are possible so far."""
    single = tuple(axis for axis in range(3) if not batch or batch[axis] == 1)
    largest = np.max(total.reshape(*total.shape[:3], -1), axis=3)
    possible = np.max(largest, axis=single, keepdims=True) > -np.inf
    return np.broadcast_to(possible, batch) if batch else possible.reshape(())
