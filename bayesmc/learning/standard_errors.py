"""How sharp an estimate is in its own coordinates, and what to say where it is none."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bayesmc.learning.edges import Settled
from bayesmc.learning.unknowns import Unknowns


def covariance_of(unknowns: Unknowns, end: Settled, covariance: np.ndarray) -> np.ndarray:
    """Of the values, by the delta method; NaN at edges, and where the curvature is none of a maximum's.

    Parameters
    ----------
    covariance : ndarray
        Of the unconstrained numbers that are free.
    """
    free = np.flatnonzero(end.free)
    jacobian = np.zeros((len(unknowns.flat(end.u)), len(free)))
    for column, k in enumerate(free):
        step = 1e-6 * max(1.0, abs(end.u[k]))
        at = np.array([end.u, end.u])
        at[0, k] -= step
        at[1, k] += step
        jacobian[:, column] = (unknowns.flat(at[1]) - unknowns.flat(at[0])) / (2 * step)
    with np.errstate(invalid="ignore"):
        spread = np.where(np.isnan(covariance), 0.0, covariance)
        result = jacobian @ spread @ jacobian.T
        lost = (np.abs(jacobian) > 0) @ np.isnan(np.diagonal(covariance))
    lost |= np.abs(jacobian).max(axis=1, initial=0.0) < 1e-9  # at the edge for good
    lost[end.labels] = True
    for group in end.untold:
        lost |= unknowns.reads(group)
    result[lost], result[:, lost] = np.nan, np.nan
    return result


def why_not(
    unknowns: Unknowns, steps: int, untold: Sequence[np.ndarray], lost: Sequence[str], prior: bool
) -> str:
    """Why this is no maximum, or none that the data tell, and in which numbers."""
    remedy = "priors that say more" if prior else "prior=True with priors that say more"
    if untold:
        of = "posterior density" if prior else "likelihood"
        flat = "; ".join(unknowns.direction(group) for group in untold[:4])
        more = "; and more" if len(untold) > 4 else ""
        return (
            f"fit: at the estimate the {of} is next to flat in {flat}{more}: the data do not tell it, or it "
            "runs off to infinity (several with each other: only a combination of them); what is returned is "
            f"one point of many; observe more, simplify the model, or use {remedy}"
        )
    edge = f" {', '.join(lost[:4])} may run to an edge:" if lost else ""
    return (
        f"fit: the climb ended after {steps} steps before a maximum:{edge} look at history, give start=, or "
        f"use {remedy}"
    )
