"""The plates that a net or a factor graph declares: their sizes, where known, and labels."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.errors import ModelError, PlateError, did_you_mean


@dataclass(frozen=True)
class DeclaredPlates:
    """Plates by name.

    Attributes
    ----------
    owner : str
        The class that declares them, for messages.
    sizes : dict
        Plate -> size; None where data will tell.
    labels : dict
        Plate -> labels, for those that have some.
    """

    owner: str
    sizes: dict[str, int | None]
    labels: dict[str, tuple[Any, ...]]

    @classmethod
    def read(cls, owner: str, name: Any, plates: Any, open_sizes: bool = True) -> DeclaredPlates:
        """The plates that a constructor was given, after a look at the name that precedes them.

        Raises
        ------
        ModelError
            The name is no string (plates given first, say).
        PlateError
            No dict, a size that is none, or one left to data where there will be none.
        """
        if name is not None and not isinstance(name, str):
            raise ModelError(
                f"{owner}({name!r}): the name is a string; plates are given as plates="
            )
        if plates is not None and not isinstance(plates, Mapping):
            kinds = "size, labels or None" if open_sizes else "size or labels"
            raise PlateError(f"{owner}(plates={plates!r}): give a dict from plate name to {kinds}")
        sizes, labels = {}, {}
        for plate, size in (plates or {}).items():
            sizes[plate] = _size(plate, size)
            if sizes[plate] is None and not open_sizes:
                raise PlateError(
                    f"{owner}(plates={{{plate!r}: None}}): no data will tell its size; give it"
                )
            if size is not None and not isinstance(size, (int, np.integer)):
                labels[plate] = tuple(size)
        return cls(owner, sizes, labels)

    def of(self, what: str, plates: str | Sequence[str] | None) -> tuple[str, ...]:
        """The plates that a declaration names, as a tuple.

        Raises
        ------
        PlateError
            One is not declared, or named twice.
        """
        names = (plates,) if isinstance(plates, str) else tuple(plates or ())
        for plate in names:
            if plate not in self.sizes:
                raise PlateError(
                    f"{what} is in plate {plate!r}, which is not declared"
                    f"{did_you_mean(plate, self.sizes)} (plates: {list(self.sizes) or 'none'}); "
                    f"declare {self.owner}(plates={{{plate!r}: size}})"
                )
        if len(set(names)) != len(names):
            raise PlateError(f"{what}: plates={names} names a plate twice")
        return names

    def only(self, names: Collection[str]) -> DeclaredPlates:
        """Those of some names."""
        sizes = {plate: size for plate, size in self.sizes.items() if plate in names}
        labels = {plate: own for plate, own in self.labels.items() if plate in names}
        return DeclaredPlates(self.owner, sizes, labels)

    def copy(self) -> DeclaredPlates:
        return DeclaredPlates(self.owner, dict(self.sizes), dict(self.labels))


# ---- private ------------------------------------------------------------------------------------


def _size(plate: str, size: Any) -> int | None:
    """Size of a plate from an int, a list of labels or None; what is neither raises."""
    if not isinstance(plate, str):
        raise PlateError(f"a plate's name is a string, not {plate!r}")
    if size is None:
        return None
    if isinstance(size, str):
        raise PlateError(
            f"plate {plate!r}: {size!r} is one string; give a size or a list of labels"
        )
    if not isinstance(size, (int, np.integer, Sequence, np.ndarray)) or isinstance(size, bool):
        raise PlateError(
            f"plate {plate!r}: {size!r} is no size; give an int, a list of labels or None"
        )
    count = int(size) if isinstance(size, (int, np.integer)) else len(size)
    if not isinstance(size, (int, np.integer)) and len(set(size)) != count:
        raise PlateError(f"plate {plate!r}: a label stands twice in {list(size)}")
    if count < 0:
        raise PlateError(f"plate {plate!r}: size {count} is negative")
    return count
