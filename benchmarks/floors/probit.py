"""Expectation propagation of probit regression by hand: row by row, and with all rows at once.

Row by row as in Rasmussen and Williams (2006), Gaussian Processes for Machine Learning, algorithm 3.5, for
weights instead of function values: each row changes the covariance by a rank of one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import special

_LOG_2PI = float(np.log(2.0 * np.pi))
_ROOT, _HALF = float(np.sqrt(2.0 / np.pi)), float(np.sqrt(0.5))


class Found(NamedTuple):
    """Where it ended."""

    mean: np.ndarray
    cov: np.ndarray
    log_evidence: float
    sweeps: int


def one_by_one(
    design: np.ndarray, y: np.ndarray, tolerance: float = 1e-5, most: int = 100
) -> Found:
    """Rows in turn, without damping; standard normal weights."""
    rows, columns = design.shape
    sign = 2.0 * y - 1.0
    tau, nu = np.zeros(rows), np.zeros(rows)
    cov, mean = np.eye(columns), np.zeros(columns)
    done = 0
    while done < most:
        done += 1
        before = mean
        for i in range(rows):
            x = design[i]
            turned = cov @ x
            v, m = x @ turned, x @ mean
            precision, linear = 1 / v - tau[i], m / v - nu[i]
            var = 1 / precision
            centre = linear * var
            root = np.sqrt(1 + var)
            z = sign[i] * centre / root
            ratio = np.exp(-0.5 * z * z - 0.5 * _LOG_2PI - special.log_ndtr(z))
            new_mean = centre + sign[i] * var * ratio / root
            new_var = var - var**2 * ratio * (z + ratio) / (1 + var)
            by = 1 / new_var - precision - tau[i]
            also = new_mean / new_var - linear - nu[i]
            tau[i] += by
            nu[i] += also
            share = by / (1 + by * v)
            cov = cov - share * np.outer(turned, turned)
            mean = mean + (also - share * (m + also * v)) * turned
        if np.abs((mean - before) / np.sqrt(cov.diagonal())).max() < tolerance:
            break
    return Found(mean, cov, _log_evidence(design, sign, tau, nu, mean, cov), done)


def in_parallel(
    design: np.ndarray, y: np.ndarray, tolerance: float = 1e-5, most: int = 100,
    damping: float = 0.0,
) -> Found:  # fmt: skip
    """All rows from one belief, a share of the old messages kept; standard normal weights.

    Signs are put into the design, which lies in memory as products want it; messages come from derivatives of
    the log cdf, without the moments between. Without damping it is fastest, and need not settle.
    """
    rows, columns = design.shape
    signed = design * (2.0 * y - 1.0)[:, None]
    turned, eye = np.ascontiguousarray(signed.T), np.eye(columns)
    tau, nu = np.zeros(rows), np.zeros(rows)
    cov, mean = eye, np.zeros(columns)
    done, kept = 0, 1.0 - damping
    while done < most:
        done += 1
        before = mean
        v = np.einsum("ij,ij->j", cov @ turned, turned)
        precision = 1 / v - tau
        var = 1 / precision
        centre = var * ((mean @ turned) / v - nu)
        whole = 1 + var
        root = np.sqrt(whole)
        z = centre / root
        ratio = _ROOT / special.erfcx(-_HALF * z)
        curve = ratio * (z + ratio) / whole
        new = curve / (1 - var * curve)
        tau += kept * (new - tau)
        nu += kept * (new * centre + ratio / root * (1 + var * new) - nu)
        cov = np.linalg.inv(eye + (turned * tau) @ signed)
        mean = cov @ (turned @ nu)
        if np.abs((mean - before) / np.sqrt(cov.diagonal())).max() < tolerance:
            break
    return Found(mean, cov, _log_evidence(signed, np.ones(rows), tau, nu, mean, cov), done)


# ---- private ------------------------------------------------------------------------------------


def _log_evidence(
    design: np.ndarray, sign: np.ndarray, tau: np.ndarray, nu: np.ndarray, mean: np.ndarray,
    cov: np.ndarray,
) -> float:  # fmt: skip
    """Logs of factors over their messages, and of the integral of all messages."""
    v, m = ((design @ cov) * design).sum(axis=1), design @ mean
    precision, linear = 1 / v - tau, m / v - nu
    z = sign * linear / precision / np.sqrt(1 + 1 / precision)
    cavity = 0.5 * linear**2 / precision - 0.5 * np.log(precision)
    belief = 0.5 * m**2 / v + 0.5 * np.log(v)
    whole = 0.5 * mean @ np.linalg.solve(cov, mean) + 0.5 * np.linalg.slogdet(cov)[1]
    return float((special.log_ndtr(z) + cavity - belief).sum() + whole)
