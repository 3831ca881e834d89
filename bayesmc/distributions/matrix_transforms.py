"""Maps between matrices and unconstrained numbers: positive definite ones, and correlations.

Those of the Stan Reference Manual (version 2.36, chapter "Constraint Transforms").
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy import special

from bayesmc.distributions.transform import Transform
from bayesmc.gaussian import try_cholesky
from bayesmc.shapes import Shape

#: exp(2 * 354) is near the largest double, exp(-2 * 354) near the least normal one
_LOG_ROOT = 354.0


class LogCholesky(Transform):
    """Positive definite matrices ``L L'``, from the lower triangle of L with logs on its diagonal.

    The d (d + 1) / 2 numbers go row by row. Beyond 354 logs on the diagonal count as 354, for the
    squares of larger ones are no doubles.
    """

    @property
    def unconstrained_shape(self) -> Shape:
        d = self.event_shape[0]
        return (d * (d + 1) // 2,)

    def formula(self, u: Any) -> Any:
        d, lead = self.event_shape[0], u.shape[:-1]
        row, column = np.tril_indices(d)
        logs = u[..., np.flatnonzero(row == column)]
        roots = np.exp(np.clip(logs, -_LOG_ROOT, _LOG_ROOT))
        parts = [u, roots, np.zeros((*lead, 1))]
        at = np.full((d, d), row.size + d)  # the zero behind them
        at[row, column] = np.arange(row.size)
        at[np.arange(d), np.arange(d)] = row.size + np.arange(d)
        factor = np.take(np.concatenate(parts, axis=-1), at, axis=-1)
        x = np.reshape(factor @ np.matrix_transpose(factor), (*lead, d * d))
        return np.take(x, _mirrored(d), axis=-1)

    def _unconstrain(self, x: np.ndarray) -> np.ndarray:
        d = self.event_shape[0]
        i = np.arange(d)
        factor, bad = try_cholesky(x)
        factor = np.array(factor)
        factor[..., i, i] = np.log(factor[..., i, i])
        u = factor[..., *np.tril_indices(d)]
        return u if bad is None else np.where(bad[..., None], np.nan, u)

    def log_det_formula(self, u: Any) -> Any:
        d = self.event_shape[0]
        row, column = np.tril_indices(d)
        # L -> L L' stretches by 2^d prod L_ii^(d - i), i from 0; the logarithm adds one L_ii each
        logs = u[..., np.flatnonzero(row == column)]
        return d * math.log(2.0) + logs @ np.arange(d + 1.0, 1.0, -1.0)


class PartialCorrelations(Transform):
    """Correlation matrices ``L L'``, from the inverse hyperbolic tangents of partial correlations.

    The d (d - 1) / 2 numbers go row by row below the diagonal; zeros are no correlation. Entry j of a row of
    L is the partial correlation times what the entries before it left of the row's length, which is one.
    """

    @property
    def unconstrained_shape(self) -> Shape:
        d = self.event_shape[0]
        return (d * (d - 1) // 2,)

    def formula(self, u: Any) -> Any:
        d, lead = self.event_shape[0], u.shape[:-1]
        share, left = np.tanh(u), np.exp(0.5 * self._log_left(u))
        one, number = np.ones(lead), 0
        entries = []
        for i in range(d):
            length: Any = one
            for _ in range(i):
                entries.append(share[..., number] * length)
                length, number = left[..., number] * length, number + 1
            entries.append(length)
        at = np.full((d, d), len(entries))  # the zero behind them
        at[np.tril_indices(d)] = np.arange(len(entries))
        factor = np.take(np.stack([*entries, 0.0 * one], axis=-1), at, axis=-1)
        x = np.reshape(factor @ np.matrix_transpose(factor), (*lead, d * d))
        lower = _mirrored(d)
        lower[np.arange(d), np.arange(d)] = d * d  # ones to the last bit
        return np.take(np.concatenate([x, one[..., None]], axis=-1), lower, axis=-1)

    def _unconstrain(self, x: np.ndarray) -> np.ndarray:
        row, column = np.tril_indices(self.event_shape[0], -1)
        factor, bad = try_cholesky(x)
        rest = np.flip(np.cumsum(np.flip(np.square(factor), -1), axis=-1), -1)
        u = np.arcsinh(factor[..., row, column] / np.sqrt(rest[..., row, column + 1]))
        off = (np.abs(np.linalg.diagonal(x) - 1) > 1e-6).any(axis=-1)
        bad = off if bad is None else bad | off
        return np.where(bad[..., None], np.nan, u)

    def log_det_formula(self, u: Any) -> Any:
        d = self.event_shape[0]
        _, column = np.tril_indices(d, -1)
        return np.sum(0.5 * (d - column) * self._log_left(u), axis=-1)

    def _log_left(self, u: Any) -> Any:
        """``log(1 - tanh(u)^2)``."""
        return special.log_expit(2 * u) + special.log_expit(-2 * u) + math.log(4.0)


def _mirrored(d: int) -> np.ndarray:
    """Where the entries of a matrix lie in its lower triangle: symmetric to the last bit."""
    here = np.arange(d * d).reshape(d, d)
    return np.tril(here) + np.tril(here, -1).T
