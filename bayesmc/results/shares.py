"""The errors of shares: probabilities of states and of events, which draws may never have shown.

A state that no draw has met leaves nothing to estimate a variance from, and yet it may have a probability.
What an unseen part may weigh stands here, and on how many effective draws that rests; how the error of what
was seen is made is the posteriors' own affair.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from bayesmc import diagnostics
from bayesmc.network import CompiledNode, Observed

#: scalars that are asked how fast chains move, at most, and numbers that are looked at for it
_SCALARS = 48
_ELEMENTS = 2_000_000


def steps(node: CompiledNode, seen: Observed | None, exact: bool) -> np.ndarray | float:
    """By how much one unseen state may move each figure of a node: 0 where there is none.

    It is 1 for the probability of a state, and for the mean of a node with numbers the least distance
    between two of them. What is observed or the same by the model (``exact``) has no unseen states.

    Parameters
    ----------
    node : CompiledNode
    seen : Observed or None
        What is observed of it.
    exact : bool
        It was no part of the sampling.

    Returns
    -------
    ndarray or float
        Broadcasts to ``(*plates, *event)``, for labels to ``(*plates, states)``.
    """
    if exact or not node.is_discrete:
        return 0.0
    labelled = node.domain is not None and node.domain.labels is not None
    step = 1.0
    if node.domain is not None and not labelled:
        numbers = np.unique(np.asarray(node.domain.numbers, dtype=float))
        step = float(np.diff(numbers).min()) if len(numbers) > 1 else 0.0
    if node.domain is not None and node.domain.size == 1:
        step = 0.0
    if seen is None:
        return step
    if seen.mask is None:
        return 0.0
    hidden = np.where(seen.mask, 0.0, step)
    hidden = hidden.reshape(hidden.shape + (1,) * len(node.event_shape))
    return hidden[..., None] if labelled else hidden


def is_share(values: np.ndarray) -> bool:
    """Whether values of a function are those of an event: booleans, or zeros and ones alone."""
    if values.dtype.kind == "b":
        return True
    return values.dtype.kind in "iuf" and bool(((values == 0) | (values == 1)).all())


def weighted_count(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Effective draws behind shares of weighted draws, shape ``values.shape[2:]``.

    Of figures with more than two values those of the weights, as long as more than one was seen.
    """
    heaviest, squares = float(weights.max()), float(np.sum(weights**2))
    alive, weight = values[weights > 0], weights[weights > 0]
    top, low = alive.max(axis=0), alive.min(axis=0)
    upper, lower = alive == top, alive != top
    many = ~(upper | (alive == low)).all(axis=0) & (top > low)
    above, below = (np.tensordot(weight, side, axes=(0, 0)) for side in (upper, lower))
    smaller = np.where(above > below, lower, upper)  # summed itself: a difference would be rounding
    heavy = np.tensordot(weight**2, smaller, axes=(0, 0))
    two = weighted_share_count(np.minimum(above, below), heavy, heaviest)
    return np.where(many, 1.0 / squares, two)


def weighted_share_count(mine: Any, heavy: Any, heaviest: float) -> Any:
    """Effective draws behind shares of weighted draws, as far as what was not seen is concerned.

    What one more draw of the smaller side would weigh is guessed from those that are there: their mean
    weight, by weight; or the heaviest of all draws, where there are none, and with a chance of ``exp(-k)``
    where there are k effective ones. (Draws that a proposal makes of a rare event, with tiny weights, leave
    little room.)

    Parameters
    ----------
    mine, heavy : array_like
        Sum of the weights on the smaller side, and of their squares; all weights sum to 1.
    heaviest : float
        The largest weight.
    """
    mine, heavy = np.asarray(mine, dtype=float), np.asarray(heavy, dtype=float)
    seen = (mine > 1e-300) & (heavy > 1e-300)
    mine, heavy = np.where(seen, mine, 1.0), np.where(seen, heavy, 1.0)
    typical = np.where(seen, np.minimum(heavy / mine, heaviest), heaviest)
    missed = np.where(seen, heaviest**2 * np.exp(-(mine**2) / heavy), 0.0)
    return 1.0 / np.sqrt(typical**2 + missed)


def chain_count(values: np.ndarray, moving: Any, block: int, step: Any) -> np.ndarray:
    """Effective draws behind shares of chains, shape ``values.shape[2:]``.

    Those of its own mean; of a share that never changed, as many as behind the slowest scalar that did
    (``moving``), since how fast the chains would have found it is not known, or fewer, where what waits for
    the node was seldom drawn anew.
    """
    total = float(values.shape[0] * values.shape[1])
    moving = np.broadcast_to(np.minimum(moving, total), values.shape[2:])
    asked = np.broadcast_to(step, values.shape[2:]) > 0
    count = np.full(values.shape[2:], total)
    still = (values == values[:1, :1]).all(axis=(0, 1))
    count[asked & still] = moving[asked & still]
    moved = asked & ~still
    if moved.any():
        own = diagnostics.chain_statistic("mean_ess", values[:, :, moved], block)
        count[moved] = np.where(np.isnan(own), moving[moved], np.minimum(own, total))
    return count


def slowest(stored: Mapping[str, np.ndarray], names: Iterable[str], block: int) -> float:
    """Effective draws of the slowest of some scalars of chains that ever moved; the chains where none did.

    Parameters
    ----------
    stored : dict
        Node -> stored values, shape ``(chain, draw, ...)``.
    names : iterable of str
        Nodes to look at.
    block : int
        Members of an ensemble.
    """
    moving = [stored[n] for n in names if stored[n].shape[1] > 1 and stored[n].size]
    if not moving:
        return math.inf
    chains, draws = moving[0].shape[:2]
    many = max(6, min(_SCALARS, _ELEMENTS // (chains * draws)))
    found = float(chains)
    sizes = []
    each = max(1, many // len(moving))
    for values in moving[:: max(1, len(moving) // many)]:
        flat = values.reshape(chains, draws, -1)
        width = flat.shape[2]
        for at in np.unique(np.linspace(0, width - 1, min(each, width)).round().astype(int)):
            column = flat[:, :, at].astype(float)
            if (column != column[0, 0]).any():
                sizes.append(float(diagnostics.chain_statistic("ess", column, block)))
    known = [size for size in sizes if not math.isnan(size)]
    return min(known) if known else found
