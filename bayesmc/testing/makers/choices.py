"""Where random choices come from: a seeded generator, or draws of a property-testing library.

Both make the same nets, because every choice is one bounded integer; small integers stand for the
simple options, so that a search for the smallest failing net (shrinking) goes the right way.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from typing import Any, TypeVar

import numpy as np

#: steps between the ends of a real number's range: few, so that numbers stay readable
_STEPS = 16
#: largest relative weight of a state
_WEIGHT = 8

T = TypeVar("T")


class Choices:
    """A source of choices.

    Parameters
    ----------
    integer : callable
        ``integer(low, high)`` chooses an integer, both ends included; ``low`` is the simplest.
    group : callable, optional
        ``group(make)`` returns ``make(choices)`` and marks what it chooses as belonging together, so that
        shrinking can drop it as a whole.
    zero_first : bool
        Whether zero, not the lower end, is the simplest real number. It makes other numbers of the same
        integers.
    """

    def __init__(
        self,
        integer: Callable[[int, int], int],
        group: Callable[[Callable[[Choices], Any]], Any] | None = None,
        *,
        zero_first: bool = False,
    ) -> None:
        self.integer = integer
        self._zero_first = zero_first
        self._group = group

    def group(self, make: Callable[[Choices], Any]) -> Any:
        """``make(choices)``, as one part that can be left out."""
        return make(self) if self._group is None else self._group(make)

    def flag(self, chance: float = 0.5) -> bool:
        """True with about this chance; False is the simple answer."""
        return self.integer(0, 15) >= 16 - round(16 * chance)

    def pick(self, options: Sequence[Any]) -> Any:
        """One of the options; the first is the simplest."""
        return options[self.integer(0, len(options) - 1)] if len(options) > 1 else options[0]

    def real(self, low: float, high: float) -> float:
        """A number between ``low`` and ``high``, of a coarse grid."""
        step = self.integer(0, _STEPS)
        if self._zero_first and low == -high:  # 0, 1, -1, 2, -2, ... steps from the middle
            step = _STEPS // 2 + (step + 1) // 2 * (1 if step % 2 else -1)
        return low + (high - low) * step / _STEPS

    def reals(self, low: float, high: float, shape: tuple[int, ...]) -> np.ndarray:
        """An array of such numbers."""
        count = math.prod(shape)
        return np.reshape([self.real(low, high) for _ in range(count)], shape)

    def rows(self, count: int, states: int, zeros: bool = True) -> np.ndarray:
        """Rows of probabilities, shape ``(count, states)``, in the ratios of small integers."""
        lowest = 0 if zeros else 1
        weights = [[self.integer(lowest, _WEIGHT) for _ in range(states)] for _ in range(count)]
        table = np.array(weights, dtype=float).reshape(count, states)
        table[table.sum(axis=1) == 0] = 1.0
        return table / table.sum(axis=1, keepdims=True)


def read_options(call: str, kind: type[T], options: Mapping[str, Any]) -> T:
    """The options of a call, fields of the dataclass ``kind``, by name."""
    names = [f.name for f in fields(kind)]  # type: ignore[arg-type]
    unknown = [name for name in options if name not in names]
    if unknown:
        raise TypeError(f"{call}({unknown[0]}=...): no such option; it takes {', '.join(names)}")
    for field in fields(kind):  # type: ignore[arg-type]
        given = options.get(field.name, field.default)
        if field.type == "bool" and not isinstance(given, (bool, np.bool_)):
            raise TypeError(f"{call}({field.name}={given!r}): give True or False")
        if field.type == "float" and not isinstance(given, (int, float, np.integer, np.floating)):
            raise TypeError(f"{call}({field.name}={given!r}): give a number")
    try:
        return kind(**options)
    except ValueError as error:
        raise ValueError(f"{call}: {error}") from None


def read_range(name: str, value: Any, least: int) -> tuple[int, int]:
    """A pair (fewest, most) of whole numbers, ``least <= fewest <= most``."""
    if isinstance(value, Sequence) and len(value) == 2:
        low, high = value
        if all(isinstance(v, (int, np.integer)) for v in value) and least <= low <= high:
            return int(low), int(high)
    raise ValueError(f"{name}={value!r}: give (fewest, most) with {least} <= fewest <= most")


def seeded(rng: np.random.Generator) -> Choices:
    """Choices of a NumPy generator."""
    return Choices(lambda low, high: int(rng.integers(low, high, endpoint=True)))
