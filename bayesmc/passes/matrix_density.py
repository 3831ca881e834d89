"""Log densities of random matrices, of values and parameters that may be stand-ins."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy import special

from bayesmc.distributions.lkj import log_volume


def _log_det(root: Any) -> Any:
    """Of a matrix, by its Cholesky factor."""
    return 2.0 * np.sum(np.log(np.linalg.diagonal(root)), axis=-1)


def wishart(x: Any, df: Any, scale: Any, is_inverse: bool) -> Any:
    """Of Wishart's family, or its inverses."""
    size = x.shape[-1]
    root, of_scale = np.linalg.cholesky(x), np.linalg.cholesky(scale)
    first, second = (root, of_scale) if is_inverse else (of_scale, root)
    z = np.matmul(np.linalg.inv(first), second)
    trace_of = np.sum(z * z, axis=(-2, -1))
    halves = 0.5 * (np.reshape(df, (*np.shape(df), 1)) - np.arange(size))
    norm = 0.5 * df * size * math.log(2.0) + 0.25 * size * (size - 1) * math.log(math.pi)
    norm = norm + np.sum(special.gammaln(halves), axis=-1)
    if is_inverse:
        logs = 0.5 * df * _log_det(of_scale) - 0.5 * (df + size + 1) * _log_det(root)
    else:
        logs = 0.5 * (df - size - 1) * _log_det(root) - 0.5 * df * _log_det(of_scale)
    # fewer degrees of freedom have no density, though the gamma function has values there
    return logs - 0.5 * trace_of - norm + np.where(df > size - 1, 0.0, -np.inf)


def correlations(x: Any, size: Any, concentration: Any) -> Any:
    """Of ``LKJ``."""
    count = x.shape[-1]
    if count == 1:
        return 0.0 * concentration
    return (concentration - 1.0) * _log_det(np.linalg.cholesky(x)) - log_volume(
        count, concentration
    )
