"""``ExtendedKalmanFilter``: Gaussian beliefs by derivatives at the mean."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from bayesmc.engines.kalman.levels import Level, Made
from bayesmc.engines.kalman.nonlinear import NonlinearFilter

#: balances the rounding of a central difference against its curvature
_STEP = float(np.finfo(float).eps ** (1 / 3))


@dataclass(frozen=True)
class ExtendedKalmanFilter(NonlinearFilter):
    """Approximate beliefs about nonlinear templates: means become their tangents at the belief's mean.

    Hidden nodes, and observed ones that depend on them, may have any smooth means and scales. Families other
    than Normal and MvNormal are matched by their mean and variance. Nodes on a circle (``VonMises``,
    ``WrappedNormal``) count angles the short way round: innovations and differences are wrapped to
    [-pi, pi), and their variance is ``-2 log R`` with R the mean resultant length.

    Derivatives are central differences of the declared functions, all in one call. Where functions are affine
    the results are those of ``KalmanFilter`` to about ten digits.

    Notes
    -----
    The log marginal likelihood is that of the linearised model. Where the belief is wide beside the curvature
    of a mean, the filter can be far off and sure of itself; hold it against a ``ParticleFilter``.

    References
    ----------
    Jazwinski (1970), Stochastic Processes and Filtering Theory, ch. 8; Särkkä and Svensson (2023), Bayesian
    Filtering and Smoothing, 2nd ed., ch. 7.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc import ExtendedKalmanFilter
    >>> dbn = bmc.DynamicBayesNet("pendulum")
    >>> dbn.add("v", lambda v_prev, a_prev: bmc.Normal(v_prev - 0.1 * np.sin(a_prev), 0.05),
    ...         initial=bmc.Normal(0.0, 0.1))
    >>> dbn.add("a", lambda a_prev, v: bmc.Normal(a_prev + 0.1 * v, 0.01), initial=bmc.Normal(1.0, 0.2))
    >>> dbn.add("y", lambda a: bmc.Normal(np.sin(a), 0.1))
    >>> filtered = bmc.filter(dbn, {"y": [0.8, 0.85, 0.8]}, engine=ExtendedKalmanFilter())
    >>> filtered.mean("a").shape, filtered.cov("a", "v").shape
    ((3,), (3, 2, 2))
    """

    label: ClassVar[str] = "extended Kalman filter"

    def made_linear(self, level: Level, mean: np.ndarray, rows: np.ndarray) -> Made:
        """Central differences at the mean."""
        c = mean.shape[-1]
        share = 1.0 if level.part.affine else _STEP  # of what is affine a long step loses no digits
        steps = 2.0 ** np.round(np.log2(share * np.maximum(np.abs(mean), level.part.sizes)))
        moves = steps[..., None, :] * np.eye(c)  # (*lead, c, c): one move per row
        moves = np.moveaxis(moves, -2, 0)
        points = np.concatenate([mean[None], mean + moves, mean - moves])
        found, moments = level(points)
        slopes = level.off(found[1 : 1 + c], found[1 + c :])
        slopes = np.moveaxis(slopes, 0, -1) / (2 * steps[..., None, :])
        scales = [None if m.scale is None else m.scale[0] for m in moments]
        return Made(found[0], slopes @ rows, level.noise(scales))
