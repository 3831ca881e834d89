"""Which scalars of a run are worth judging: some of every node, ranked by a rough screen of batch means.

In very long chains every k-th draw is looked at. The screen ranks scalars and no more: figures that anybody
is told are those of ``diagnostics``.

References
----------
Flegal and Jones (2010), Batch means and spectral variance estimators in Markov chain Monte Carlo, Annals of
Statistics 38.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from bayesmc.network import CompiledNode, Model
from bayesmc.results.statistics import near

#: scalars looked at
_SCALARS = 200
#: draws of one scalar in all chains to which more are thinned, though not below ``_DRAWS`` per chain
_ONE = 50_000
_DRAWS = 1000
#: chains looked at; of more, some more or less stuck ones hardly change the figures
_CHAINS = 64
#: chains from which on their whole means are compared, too
_MANY = 8
#: batches of a chain in the screen, and draws of a scalar from which it learns its quantiles
_BATCHES = 20
_SAMPLE = 1000
#: numbers that are screened at once
_AT_ONCE = 1 << 17


class Looked(NamedTuple):
    """Scalars that move, and their draws.

    Attributes
    ----------
    scalars : list
        Node and index of each.
    draws : ndarray, shape (scalar, chain, draw)
    share : float
        Share of the chains that these are.
    """

    scalars: list[tuple[str, tuple[int, ...]]]
    draws: np.ndarray
    share: float


def looked_at(
    nodes: Sequence[CompiledNode],
    model: Model,
    stored: Mapping[str, np.ndarray],
    block: int,
    superchains: int,
) -> Looked:
    """Up to ``_SCALARS`` scalars of some nodes that moved in any chain, long chains thinned.

    Parameters
    ----------
    stored : dict
        Node -> stored values, shape ``(chain, draw, *plates, *event)``; nodes that it lacks are left out.
    block : int
        Draws of a chain come in turn from this many members: they are kept together.
    superchains : int
        Where there are some, all chains are looked at.
    """
    scalars: list[tuple[str, tuple[int, ...]]] = []
    parts, share = [], 1.0
    for name, group in itertools.groupby(some_scalars(nodes, model), key=lambda s: s[0]):
        values = stored.get(name)
        indices = [index for _, index in group]
        if values is None or values.shape[:2] == (1, 1):
            continue
        flat = values.reshape(*values.shape[:2], -1)
        if model[name].value_shape:
            flat = flat[..., np.ravel_multi_index(np.transpose(indices), values.shape[2:])]
        rows = np.moveaxis(flat, -1, 0)
        some = _thinned(rows, block, superchains)
        share = some.shape[1] / rows.shape[1]
        moves = (some != some[:, :1, :1]).any(axis=(1, 2))
        for k in np.flatnonzero(~moves):  # a state never left in any chain is nothing to judge by
            moves[k] = (rows[k] != rows[k, 0, 0]).any()
        kept = np.flatnonzero(moves)
        if kept.size:
            scalars += [(name, indices[k]) for k in kept]
            parts.append(_uncut(model[name], [indices[k] for k in kept], some[kept]))
    draws = np.concatenate(parts) if parts else np.empty((0, 0, 0))
    return Looked(scalars, draws, share)


def screened(draws: np.ndarray, block: int) -> tuple[np.ndarray, np.ndarray]:
    """How far halves of chains differ, and an effective size, of each scalar: to rank scalars by and no more.

    Both come from batch means, the first as the variance between halves over the whole one, of the values
    and of their distance from the median, both squashed so that heavy tails do not hide anything; the second
    as the smallest of the squashed values' and both tails'. No ranks are taken and nothing is corrected for
    few batches. NaN if there are fewer than four blocks of draws.

    Parameters
    ----------
    draws : ndarray, shape (scalar, chain, draw)
    """
    count, chains, length = draws.shape
    if length < 4 * block:
        return np.full(count, np.nan), np.full(count, np.nan)
    step = max(_AT_ONCE // (chains * length), 1)
    found = [_screened(draws[at : at + step], block) for at in range(0, count, step)]
    disagreement, ess = (np.concatenate(f) for f in zip(*found, strict=True))
    return disagreement, ess


def some_scalars(
    nodes: Sequence[CompiledNode], model: Model
) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Node and index of up to ``_SCALARS`` scalars, spread evenly over nodes and within them."""
    if len(nodes) > _SCALARS:
        picked = np.linspace(0, len(nodes) - 1, _SCALARS).round().astype(int)
        nodes = [nodes[i] for i in picked]
    left = _SCALARS
    small_first = sorted(nodes, key=lambda node: math.prod(node.value_shape))
    for position, node in enumerate(small_first):
        share = left // (len(small_first) - position)
        chosen = list(spread(node.value_shape, share))
        left -= len(chosen)
        for index in chosen:
            yield node.name, index


def spread(shape: tuple[int, ...], count: int) -> Iterator[tuple[int, ...]]:
    """Up to so many indices of an array, evenly over it."""
    total = math.prod(shape)
    flat = np.unique(np.linspace(0, total - 1, min(count, total)).round().astype(int))
    for at in zip(*np.unravel_index(flat, shape), strict=True) if shape else [()]:
        yield tuple(int(i) for i in at)


def uncut(node: CompiledNode, index: tuple[int, ...], values: np.ndarray) -> np.ndarray:
    """The draws of a scalar, those of an angle near their mean: cut in two they would look faster mixed."""
    if node.angles is None or not node.angles[index[len(node.plates) :]]:
        return values
    return near(values, np.angle(np.exp(1j * values).mean()))


# ---- private ------------------------------------------------------------------------------------


def _thinned(values: np.ndarray, block: int, superchains: int) -> np.ndarray:
    """Every k-th block of draws of long chains, of some chains if there are many."""
    if values.shape[1] > _CHAINS and not superchains:
        values = values[:, np.linspace(0, values.shape[1] - 1, _CHAINS).round().astype(int)]
    count, chains, draws = values.shape
    step = max(1, min(draws // _DRAWS, -(-chains * draws // _ONE)))
    if step == 1:
        return values[..., : draws // block * block]
    whole = values[..., : draws // block * block].reshape(count, chains, -1, block)
    return whole[:, :, ::step].reshape(count, chains, -1)


def _uncut(node: CompiledNode, indices: Sequence[tuple[int, ...]], draws: np.ndarray) -> np.ndarray:
    draws = draws.astype(float)
    if node.angles is not None:
        for row, index in zip(draws, indices, strict=True):
            row[...] = uncut(node, index, row)
    return draws


def _screened(draws: np.ndarray, block: int) -> tuple[np.ndarray, np.ndarray]:
    """The same of few scalars."""
    scalars, chains, length = draws.shape
    count = min(_BATCHES, length // block)
    values = draws[..., : length // block // count * count * block]
    flat = values.reshape(scalars, -1)
    sample = flat[:, :: (flat.shape[1] // _SAMPLE) | 1]
    inner: Any = (-2, -1)
    with np.errstate(all="ignore"):  # infinite draws, and scalars that hardly ever move
        low, middle, high = np.quantile(sample, [0.05, 0.5, 0.95], axis=1)[..., None, None]
        width = high - low
        if not width.all():
            width = np.where(width != 0, width, values.std(axis=inner, keepdims=True))
        offset = (values - middle) / width
        far = np.abs(offset)
        far /= 1.0 + far
        series = np.stack([np.copysign(far, offset), far, values <= low, values <= high])
        means = series.reshape(4, scalars, chains, count, -1).mean(axis=-1)
        variance = of_blocks = series.var(axis=inner)
        if block > 1:
            of_blocks = series.reshape(4, scalars, chains, -1, block).mean(axis=-1).var(axis=inner)
        half = count // 2
        halves = np.stack([means[..., :half].mean(axis=-1), means[..., -half:].mean(axis=-1)])
        between = halves.var(axis=(0, 3)) / of_blocks
        ess = chains * count * variance / means.var(axis=inner)
        if chains >= _MANY:  # what batches of few draws do not show of each other
            ess = np.fmin(ess, chains * variance / means.mean(axis=-1).var(axis=-1))
    return np.fmax(*between[:2]), np.fmin.reduce(ess[[0, 2, 3]])
