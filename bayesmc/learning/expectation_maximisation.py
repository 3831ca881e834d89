"""Expectation-maximisation of tables: the loop, Dirichlet counts, and standard errors at its end."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from bayesmc.errors import ZeroProbabilityError

Tables = dict[str, np.ndarray]
#: from tables to the log likelihood and the expected counts of their entries
Expected = Callable[[Mapping[str, np.ndarray]], tuple[float, Mapping[str, np.ndarray]]]
#: entries of tables up to which their curvature is worked out
_MOST = 300


@dataclass(frozen=True, eq=False)
class Learned:
    """Where expectation-maximisation ended.

    Attributes
    ----------
    tables : dict
    log_likelihood : float
    objective : float
    history : ndarray
    converged : bool
    errors : dict
        Standard errors of all entries; NaN where they are not told.
    """

    tables: Tables
    log_likelihood: float
    objective: float
    history: np.ndarray
    converged: bool
    errors: Tables


def maximised(
    expected: Expected, start: Tables, counts: Mapping[str, np.ndarray], tolerance: float, most: int
) -> Learned:
    """Tables from where they start; each iteration leaves the objective as high as it was, or higher.

    Parameters
    ----------
    expected : callable
    start : dict
        Rows over the last axis sum to 1.
    counts : dict
        Dirichlet counts, added to those expected; the objective has their log prior in it.
    tolerance : float
        Rise of the objective by one plain step below which it ends, in nats.

    Notes
    -----
    After two plain steps it goes further the way these went, by what their difference tells, and stays
    there if the objective has not fallen (squared extrapolation).

    References
    ----------
    Varadhan and Roland (2008), Simple and globally convergent methods for accelerating the convergence of any
    EM algorithm, Scandinavian Journal of Statistics 35, eq. 12.
    """
    tables = {n: np.array(t) for n, t in start.items()}
    log_likelihood, found = expected(tables)
    history = [log_likelihood + _log_prior(tables, counts)]
    converged, reach = False, 4.0
    before: Tables | None = None
    while not converged and len(history) <= most:
        ahead = {n: _normalised(found[n] + counts[n], tables[n]) for n in tables}
        far, length = _extrapolated(before, tables, ahead, reach)
        told = None if far is None else _told(expected, far)
        if far is not None and told is not None:
            objective = told[0] + _log_prior(far, counts)
            if objective >= history[-1]:
                reach = 4.0 * reach if length == reach else reach
                tables, before, (log_likelihood, found) = far, None, told
                history.append(objective)
                continue
        if far is not None:
            reach = max(1.0, 0.5 * reach)
        before, tables = tables, ahead
        log_likelihood, found = expected(tables)
        history.append(log_likelihood + _log_prior(tables, counts))
        converged = history[-1] - history[-2] < tolerance
    errors = _errors(expected, tables, counts)
    return Learned(tables, log_likelihood, history[-1], np.array(history), converged, errors)


def inside(table: np.ndarray) -> np.ndarray:
    """Which entries are not at an edge, 0 or 1."""
    return (table > 1e-6) & (table < 1 - 1e-6)


# ---- private ------------------------------------------------------------------------------------


def _extrapolated(
    before: Tables | None, now: Tables, ahead: Tables, most: float
) -> tuple[Tables | None, float]:
    """Tables further the way of two steps, and how many steps far; None where that is no further."""
    if before is None:
        return None, 0.0
    first = {n: now[n] - before[n] for n in now}
    bend = {n: ahead[n] - now[n] - first[n] for n in now}
    moved, bent = (
        math.sqrt(sum(float((d**2).sum()) for d in part.values())) for part in (first, bend)
    )
    length = min(moved / bent, most) if bent > 0 else most
    if length <= 1.0 or not moved:
        return None, length
    found = {}
    for n in now:
        far = before[n] + 2.0 * length * first[n] + length**2 * bend[n]
        far = np.where(
            far > 0, far, ahead[n]
        )  # entries that would leave it stay where they were going
        found[n] = far / far.sum(axis=-1, keepdims=True)
    return found, length


def _told(expected: Expected, tables: Tables) -> tuple[float, Mapping[str, np.ndarray]] | None:
    """What is expected of tables; None where they make a case impossible."""
    try:
        return expected(tables)
    except ZeroProbabilityError:
        return None


def _normalised(counts: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Rows in proportion to counts; a row that nothing was counted in stays."""
    total = counts.sum(axis=-1, keepdims=True)
    return np.where(total > 0, counts / np.where(total > 0, total, 1.0), before)


def _log_prior(tables: Tables, counts: Mapping[str, np.ndarray]) -> float:
    total = 0.0
    for name, table in tables.items():
        added = np.broadcast_to(counts[name], table.shape)
        with np.errstate(divide="ignore"):
            logs = np.log(np.where(added > 0, table, 1.0))
        total += float((added * logs).sum())
    return total


def _errors(expected: Expected, tables: Tables, counts: Mapping[str, np.ndarray]) -> Tables:
    """From the observed information in log ratios: its gradient is what counts are off (Fisher's identity).

    Louis (1982), JRSS B 44, eq. 3.1; entries at the edge, and rows with one entry inside, have none.
    """
    within = {n: inside(t) for n, t in tables.items()}
    size = sum(int(mask.sum()) for mask in within.values())
    unknown = {n: np.full(t.shape, np.nan) for n, t in tables.items()}
    if not 0 < size <= _MOST:
        return unknown

    def gradient(at: Tables) -> np.ndarray:
        _, found = expected(at)
        parts = []
        for n, table in at.items():
            seen = found[n] + counts[n]
            parts.append((seen - seen.sum(axis=-1, keepdims=True) * table)[within[n]])
        return np.concatenate(parts)

    def moved(k: int, step: float) -> Tables:
        shift, at = np.zeros(size), {}
        shift[k], start = step, 0
        for n, table in tables.items():
            own = np.zeros(table.shape)
            many = int(within[n].sum())
            own[within[n]] = shift[start : start + many]
            start += many
            new = table * np.exp(own)
            at[n] = new / new.sum(axis=-1, keepdims=True)
        return at

    information = np.empty((size, size))
    for k in range(size):
        information[k] = -(gradient(moved(k, 1e-4)) - gradient(moved(k, -1e-4))) / 2e-4
    information = 0.5 * (information + information.T)
    # each row's log ratios are told up to a constant: the pseudo-inverse leaves it out
    values, vectors = np.linalg.eigh(information)
    told = values > 1e-7 * max(values.max(), 1e-300)
    covariance = (vectors[:, told] / values[told]) @ vectors[:, told].T
    lost = _untold(information, values, vectors, tables, within)
    return _spread(covariance, lost, tables, within)


def _untold(
    information: np.ndarray,
    values: np.ndarray,
    vectors: np.ndarray,
    tables: Tables,
    inside: Mapping[str, np.ndarray],
) -> np.ndarray:
    """Entries that enter directions without curvature besides that of each row's sum."""
    rows = []
    start = 0
    for n in tables:
        flat = inside[n].reshape(-1, inside[n].shape[-1])
        for row in flat:
            many = int(row.sum())
            if many:
                free = np.zeros(len(information))
                free[start : start + many] = 1.0 / math.sqrt(many)
                rows.append(free)
            start += many
    known = np.array(rows).reshape(-1, len(information))
    flat_directions = vectors[:, values <= 1e-7 * max(values.max(), 1e-300)]
    rest = flat_directions - known.T @ (known @ flat_directions)
    return (np.abs(rest) > 1e-3).any(axis=1)


def _spread(
    covariance: np.ndarray, lost: np.ndarray, tables: Tables, inside: Mapping[str, np.ndarray]
) -> Tables:
    """Standard errors of probabilities from the covariance of log ratios (delta method)."""
    found: Tables = {}
    start = 0
    for n, table in tables.items():
        errors = np.full(table.shape, np.nan)
        for at in np.ndindex(table.shape[:-1]):
            mask = inside[n][at]
            many = int(mask.sum())
            own = slice(start, start + many)
            start += many
            if many < 2 or lost[own].any():
                continue
            p = table[at][mask]
            jacobian = np.diag(p) - np.outer(p, p)
            variance = np.diagonal(jacobian @ covariance[own, own] @ jacobian)
            errors[at][mask] = np.sqrt(np.maximum(variance, 0.0))
        found[n] = errors
    return found
