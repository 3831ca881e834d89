"""Random log weights as importance samplers and particle filters meet them, the awkward ones included.

Ties, minus infinity (a draw that is impossible given the evidence), and ranges that a plain ``exp`` would
overflow or round away.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.testing.makers.choices import Choices, read_options, read_range, seeded

#: powers of two that log weights are multiples of: within a factor of 3, and far beyond any ``exp``
_FINE, _WIDE = 0.125, 2.0**14


@dataclass(frozen=True)
class WeightOptions:
    """Which log weights.

    Attributes
    ----------
    size : int or (int, int)
        How many, or fewest and most.
    ties : bool
        Often of two values alone. Without it few values may still be equal.
    zeros : bool
        Weights of zero, minus infinity.
    huge : bool
        Values up to some 1e5 away from zero and from each other.
    all_zero : bool
        They may all be minus infinity.
    """

    size: int | tuple[int, int] = (1, 32)
    ties: bool = True
    zeros: bool = True
    huge: bool = True
    all_zero: bool = False

    def __post_init__(self) -> None:
        read_range("size", self.sizes, 1)
        if self.all_zero and not self.zeros:
            raise ValueError("all_zero=True needs zeros=True, which allows minus infinity")

    @property
    def sizes(self) -> tuple[int, int]:
        """Fewest and most."""
        return self.size if isinstance(self.size, tuple) else (self.size, self.size)


def random_log_weights(rng: Any, **options: Any) -> np.ndarray:
    """Random log weights, not normalised.

    Parameters
    ----------
    rng : seed or Generator
        The same seed gives the same weights.
    **options
        Fields of `WeightOptions`: ``size``, ``ties``, ``zeros``, ``huge``, ``all_zero``.

    Returns
    -------
    ndarray, shape (size,)
        Never NaN or plus infinity; all minus infinity only with ``all_zero``.

    Raises
    ------
    ValueError, TypeError
        An option that is out of range, or unknown.

    Examples
    --------
    >>> from bayesmc.testing import random_log_weights
    >>> random_log_weights(0, size=5, huge=False).tolist()
    [0.0, 0.0, 0.0, -0.125, -0.125]
    """
    choices = seeded(np.random.default_rng(rng))
    return build_log_weights(choices, read_options("random_log_weights", WeightOptions, options))


def build_log_weights(choices: Choices, options: WeightOptions) -> np.ndarray:
    """``random_log_weights`` from any source of choices."""
    # of the whole array, so that single values can be dropped without a change of the others
    step = _WIDE if options.huge and choices.flag(0.4) else _FINE
    shift = step * choices.integer(0, 8) if options.huge and choices.flag(0.3) else 0.0
    levels = 2 if options.ties and choices.flag(0.4) else 16
    may_vanish = options.zeros and choices.flag(0.6)
    low, high = options.sizes
    values: list[float] = []
    while len(values) < high and (len(values) < low or choices.integer(0, high - low) > 0):
        if may_vanish and choices.flag(0.3):
            values.append(-np.inf)
        else:
            values.append(shift - step * choices.integer(0, levels - 1))
    if options.all_zero and choices.flag(0.1):
        values = [-np.inf] * len(values)
    elif not np.isfinite(values).any():
        values[choices.integer(0, len(values) - 1)] = shift
    return np.array(values)
