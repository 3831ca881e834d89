"""Foreign plates: how a child sees a parent that lives in plates the child lacks."""

from bayesmc.plates.array import PlateArray, align, stack
from bayesmc.plates.gathered import Gathered

__all__ = ["Gathered", "PlateArray", "align", "stack"]
