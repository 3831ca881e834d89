"""What a user hands to a chain, checked; every message names the call, the fault and the fix."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

import numpy as np

from bayesmc.errors import ParameterError, ShapeError, StateError
from bayesmc.shapes import first_index

#: how far a row or a law may be from summing to 1
SUM_TOLERANCE = 1e-9


def check_labels(labels: tuple[Any, ...], size: int) -> None:
    """As many as states, all different."""
    if len(labels) != size:
        raise ShapeError(
            f"MarkovChain(states): {len(labels)} labels for {size} states; give one for each row"
        )
    seen: set[Hashable] = set()
    for label in labels:
        if not isinstance(label, Hashable):
            raise StateError(
                f"MarkovChain(states): {label!r} cannot be hashed; use text or numbers"
            )
        if label in seen:
            raise StateError(f"MarkovChain(states): {label!r} occurs twice; labels must differ")
        seen.add(label)


def check_rows(transition: np.ndarray, labels: tuple[Any, ...]) -> None:
    """Every row is a distribution."""
    for k, row in enumerate(transition):
        if not (row >= 0).all():  # written so that NaN fails it
            bad = first_index(~(row >= 0))[0]
            fault = f"row {k} has {row[bad]} in column {bad}; probabilities are 0 or more"
        elif not abs(row.sum() - 1) <= SUM_TOLERANCE:
            fault = f"row {k} sums to {row.sum():.12g}; rows must sum to 1 (transpose columns?)"
        else:
            continue
        name = "" if labels[k] == k else f" (state {labels[k]!r})"
        raise ParameterError(f"MarkovChain(transition): {fault}{name}", (k,))


def law_array(law: Any, size: int, call: str, ndim: int | None = None) -> np.ndarray:
    """Laws of ``size`` states along the last axis, as an array."""
    p = np.asarray(law, dtype=float)
    if p.ndim == 0 or p.shape[-1] != size or (ndim and p.ndim != ndim):
        raise ShapeError(
            f"{call}(law): it has shape {p.shape}; one probability for each of the {size} states "
            "is needed"
        )
    # written so that NaN fails it
    if not ((p >= 0).all() and (np.abs(p.sum(axis=-1) - 1) <= SUM_TOLERANCE).all()):
        raise ParameterError(f"{call}(law): it must be nonnegative and sum to 1")
    return p


def check_eps(call: str, eps: float, least: float = 0.0) -> None:
    """A distance that total variation can have, and not too small to be computed."""
    if 0 < eps < least:
        raise ParameterError(
            f"{call}(eps={eps!r}): distances below {least:g} are rounding errors; take a larger eps, "
            "or mixing_time_bounds"
        )
    if not 0 < eps < 1:
        raise ParameterError(f"{call}(eps={eps!r}): eps must lie between 0 and 1, both excluded")


def whole_number(call: str, n: Any) -> int:
    """A number of steps."""
    if isinstance(n, (bool, np.bool_)) or not isinstance(n, (int, np.integer)) or n < 0:
        raise ParameterError(f"{call}: give a whole number, 0 or more")
    return int(n)


def shortened(states: tuple[Any, ...]) -> str:
    """The first states, for a message."""
    return ", ".join(map(repr, states[:10])) + (", ..." if len(states) > 10 else "")
