"""Verified conjugacy: a closed-form draw is a Metropolis-Hastings proposal that must always be accepted."""

from __future__ import annotations

import numpy as np

from bayesmc.errors import DensityError

#: how far the log ratio may be from zero, relative to the sizes of the terms it is made of
TOLERANCE = 1e-9


def check_ratio(
    name: str, match: str, target: np.ndarray, proposal: np.ndarray, sizes: np.ndarray
) -> None:
    """Refuse a draw whose log density ratio is not that of the distribution it was drawn from.

    Parameters
    ----------
    target, proposal : ndarray
        Log density at the new value minus at the old one, by the model and by the closed form.
    sizes : ndarray
        Sum of the absolute values of all terms on both sides.

    Raises
    ------
    DensityError
        Naming the node, the conjugate pair and the ratio.
    """
    ratio = np.asarray(target - proposal)
    wrong = ~(np.abs(ratio) <= TOLERANCE * (1.0 + sizes))
    if wrong.any():
        worst = ratio[wrong].flat[np.abs(ratio[wrong]).argmax()]
        raise DensityError(
            f"node {name!r}: the closed form ({match}) is not the full conditional: log ratio {worst:.3g} "
            "instead of 0"
        )
