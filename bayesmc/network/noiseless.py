"""What is seen without noise beside what it must be: as close as rounding lets it be.

A mean may be a small difference of large parents. Rounding is relative to those, and what a user writes into
a row was rounded like them.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayesmc.distributions.base import Distribution, marking_invalid
from bayesmc.distributions.noiseless import plane_log_density
from bayesmc.errors import BayesmcError
from bayesmc.network.model import Model

#: share by which parents are moved to see what their roundings do
_SHARE = 2.0**-20


def point_log_density(
    model: Model, name: str, result: Distribution, values: Mapping[str, np.ndarray]
) -> np.ndarray | None:
    """Log density of a seen node that may lack noise, ``plane_log_density`` with rounded parents.

    Parameters
    ----------
    result : Distribution
        What the node is given its parents.
    values : mapping of str to ndarray
        Stored values of the node and its parents, batch axes first.
    """
    log = plane_log_density(result, values[name])
    if log is None or not (log == -np.inf).any():
        return log
    return plane_log_density(result, values[name], _terms(model, name, result, values))


def _terms(
    model: Model, name: str, result: Distribution, values: Mapping[str, np.ndarray]
) -> np.ndarray:
    """How large the terms are that a mean is the sum of: slopes times parents."""
    at = np.asarray(result.loc)  # type: ignore[attr-defined]
    total = np.zeros(())
    for parent in model[name].parents:
        value = np.asarray(values[parent])
        if value.dtype.kind != "f" or model[parent].domain is not None:
            continue
        try:
            with marking_invalid(), np.errstate(all="ignore"):
                moved = model.evaluate(name, {**values, parent: value * (1 + _SHARE)})[0].loc
        except (BayesmcError, ValueError, FloatingPointError):
            continue  # no such value of the parent is allowed
        change = np.abs(moved - at) / _SHARE
        total = total + np.where(np.isfinite(change), change, 0.0)
    return total
