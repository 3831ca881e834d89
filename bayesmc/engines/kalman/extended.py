"""``ExtendedKalmanFilter``: Gaussian beliefs by derivatives at the mean."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from bayesmc.engines.kalman.levels import Level, Made
from bayesmc.engines.kalman.nonlinear import NonlinearFilter
from bayesmc.engines.kalman.slices import Moments

#: balances the rounding of a central difference against its curvature
_STEP = float(np.finfo(float).eps ** (1 / 3))


@dataclass(frozen=True)
class ExtendedKalmanFilter(NonlinearFilter):
    """Approximate beliefs about nonlinear templates: means become their tangents at the belief's mean.

    Hidden nodes, and observed ones that depend on them, may have any smooth means and scales. Families other
    than Normal and MvNormal are matched by their mean and variance, vectors of other families by ``mean`` and
    ``cov_root``, any square root of their covariance. Numbers on a circle (``VonMises``, ``WrappedNormal``,
    headings of poses) count angles the short way round: innovations and differences are wrapped to
    [-pi, pi), and their variance is ``-2 log R`` with R the mean resultant length.

    Counts that are missing in a row are answered by mean and variance where nothing with a density reads
    them. What is computed from hidden nodes and takes no continuous values (truth values, whole numbers,
    states) is not answered for; functions of the same slice read it as it is.

    Derivatives are those of the declared functions' expressions (forward mode), to rounding; at a kink they
    are the mean of both sides. Central differences, all in one call, where a function cannot be followed
    (``vectorize=True``, SciPy functions that are no ufuncs, ...) or jumps just there. Where functions are
    affine the results are those of ``KalmanFilter``.

    Notes
    -----
    The log marginal likelihood is that of the linearised model. Where the belief is wide beside the curvature
    of a mean, the filter can be far off and sure of itself; hold it against a ``ParticleFilter``.
    ``most_likely`` is answered for linear-Gaussian templates only, where smoothed means are the mode.

    References
    ----------
    Jazwinski (1970), Stochastic Processes and Filtering Theory, ch. 8; Särkkä and Svensson (2023), Bayesian
    Filtering and Smoothing, 2nd ed., ch. 7; Griewank and Walther (2008), Evaluating Derivatives, 2nd ed.,
    sec. 3.1, for the forward mode.

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
        """Derivatives at the mean."""
        slopes = level.slopes(mean)
        if slopes is None:
            found, moments, slopes = self._differences(level, mean)
        else:
            found, moments = level(mean[None])
        scales = [None if m.scale is None else m.scale[0] for m in moments]
        return Made(found[0], slopes @ rows, level.noise(scales))

    @staticmethod
    def _differences(
        level: Level, mean: np.ndarray
    ) -> tuple[np.ndarray, list[Moments], np.ndarray]:
        """What a level makes of the mean, first, and central differences there, shape (*lead, e, c)."""
        c = mean.shape[-1]
        share = 1.0 if level.part.affine else _STEP  # of what is affine a long step loses no digits
        steps = 2.0 ** np.round(np.log2(share * np.maximum(np.abs(mean), level.part.sizes)))
        moves = np.moveaxis(steps[..., None, :] * np.eye(c), -2, 0)  # (c, *lead, c): one move each
        found, moments = level(np.concatenate([mean[None], mean + moves, mean - moves]))
        off = level.off(found[1 : c + 1], found[c + 1 :])
        return found, moments, np.moveaxis(off, 0, -1) / (2 * steps[..., None, :])
