"""Random generators that begin anew often, for programs that are run again and again.

Seeding costs more than most steps of such a program; going back to a remembered state does not.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np


class Restarted:
    """One generator; ``at(seed)`` is it where ``np.random.default_rng(seed)`` would begin.

    What was handed out before begins anew, too: two at a time need two of these.
    """

    def __init__(self) -> None:
        self._generator = np.random.default_rng(0)

    def at(self, seed: int | tuple[int, ...]) -> np.random.Generator:
        self._generator.bit_generator.state = _begun(seed)
        return self._generator


@functools.lru_cache(maxsize=256)
def _begun(seed: int | tuple[int, ...]) -> dict[str, Any]:
    state: dict[str, Any] = np.random.default_rng(seed).bit_generator.state
    return state
