"""States that no chain ever left, though what hangs on them was hardly drawn anew: they may be stuck."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bayesmc.results import ChainsPosterior, ChainsSums

#: times that what waits for a node is drawn anew, below which a state that was never left is worth a word
_FEW = 25.0


def never_left(posterior: ChainsPosterior | ChainsSums) -> Iterator[str]:
    """What is said of finite nodes that stood still in all chains, and of which too little is known.

    Parameters
    ----------
    posterior : ChainsPosterior or ChainsSums
        With its ``renewals``.
    """
    for name, renewed in posterior.renewals.items():
        suspect = _still(posterior, name) & (renewed < _FEW)
        if not suspect.any():
            continue
        count = int(suspect.sum())
        which = (
            f"{count} of {suspect.size} elements of {name!r}" if suspect.size > 1 else f"{name!r}"
        )
        yield (
            f"no chain ever left the state of {which} in which all of them started, and "
            f"{_below(posterior, name)} was hardly ever drawn anew with it: other states may "
            f"have been missed, so errors of these probabilities are those of "
            f"{renewed[suspect].min():.0f} independent draws; compare with LikelihoodWeighting(draws)"
        )


# ---- private ------------------------------------------------------------------------------------


def _below(posterior: ChainsPosterior | ChainsSums, name: str) -> str:
    """The hidden numbers that depend on a node, in words."""
    nodes = posterior.model.nodes.items()
    found = [
        repr(n) for n, c in nodes
        if name in c.parents and c.is_stochastic and c.domain is None and n not in posterior._observed
    ]  # fmt: skip
    return f"what depends on it ({', '.join(found[:3])})" if found else "what depends on it"


def _still(posterior: ChainsPosterior | ChainsSums, name: str) -> np.ndarray:
    """Which elements of a node had one value in all draws, shape (*plates,)."""
    shape = posterior.model[name].plate_shape
    if isinstance(posterior, ChainsSums):
        moves = posterior.moves(name) if name in posterior._running.names else np.ones(shape, bool)
        return np.asarray(~moves.reshape(*shape, -1).any(axis=-1))
    stored = posterior._stored.get(name)
    if stored is None:
        return np.zeros(shape, dtype=bool)
    seen = posterior._seen.get(name)
    still = (stored == stored[:1, :1]).all(axis=(0, 1)).reshape(*shape, -1).all(axis=-1)
    if seen is None or seen.mask is None:
        return np.asarray(still)
    return np.asarray(still & ~seen.mask)
