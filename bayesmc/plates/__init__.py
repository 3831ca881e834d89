"""Foreign plates: how a child sees a parent that lives in plates the child lacks."""

from bayesmc.plates.array import PlateArray, align, stack
from bayesmc.plates.gathered import Gathered
from bayesmc.plates.lookups import Lookups

__all__ = ["Gathered", "Lookups", "PlateArray", "align", "stack"]
