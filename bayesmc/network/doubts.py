"""Angles that are possible but hardly meant: those in degrees, readings that a density doubts.

What is impossible is refused where evidence is read (``evidence``).
"""

from __future__ import annotations

import math
import warnings

import numpy as np

from bayesmc.errors import BayesmcError, EvidenceWarning
from bayesmc.network.evidence import Observed
from bayesmc.network.model import CompiledNode, Model

_FULL_TURN = 2 * math.pi * (1 + 1e-6)
#: share of angles beyond a full turn from which on they are no slips, and what degrees do not go beyond
_MANY, _DEGREES = 0.25, 361.0


def warn_of_doubts(model: Model, name: str, found: Observed) -> None:
    """Look at what was observed of one node with angles.

    Warns
    -----
    EvidenceWarning
        It is possible, but looks like degrees, or as its density says (``doubt`` of a distribution).
    """
    values = found.value if found.mask is None else found.value[found.mask]
    doubt = _doubt(model, name, values) or _degrees(model[name], values)
    if doubt is not None:
        warnings.warn(f"evidence on {name!r}: {doubt}", EvidenceWarning, stacklevel=2)


# ---- private ------------------------------------------------------------------------------------


def _doubt(model: Model, name: str, values: np.ndarray) -> str | None:
    """What the density itself finds strange."""
    try:
        dist = model.evaluate(name, model.probe)[0]
    except BayesmcError:  # of parameters that are out of range; engines say so where it counts
        return None
    look = getattr(dist, "doubt", None)
    return None if look is None else look(values)


def _degrees(node: CompiledNode, values: np.ndarray) -> str | None:
    """Whether angles go beyond a full turn, as those in degrees do."""
    angles = np.abs(values[..., node.angles] if node.event_shape else values)
    beyond = angles > _FULL_TURN
    if not angles.size or beyond.mean() < _MANY or angles.max() > _DEGREES:
        return None  # what goes beyond 361, too, was unwrapped by somebody
    return (
        f"angles are in radians, and {int(beyond.sum())} of {angles.size} lie beyond a full turn (the "
        f"largest is {angles.max():.4g}); of degrees give np.deg2rad(...), of turns that add up "
        "np.remainder(..., 2 * np.pi)"
    )
