"""What is worth a warning after a run of chains: chains that have not mixed, and bad acceptance rates.

The check must stay cheap beside the run, so it looks at some scalars of every node, in very long chains at
every k-th draw. A rough screen by batch means finds those that look worst, and only these are judged, by
ArviZ's figures, which the warnings quote. It warns; it proves nothing.

Of many short chains R-hat is the nested one, between superchains, which says whether starts are forgotten.
A chain that is held by one mode is seen by its own memory: the means of its first and its last third go
together over chains.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import scipy.special

from bayesmc import diagnostics
from bayesmc.network import CompiledNode, Model
from bayesmc.results import ChainsPosterior, ChainsSums
from bayesmc.results.posterior import near
from bayesmc.results.relabelling import ordered, pivot_of, symmetries

#: R-hat above which chains disagree (Vehtari et al. 2021, sec. 5)
MAX_RHAT = 1.01
#: effective draws of a chain below which neither R-hat nor errors can be trusted, and chains from which on
#: more of them pool what they know
MIN_ESS, _POOLED = 100, 4
#: chance that superchains which agree look apart, or chains that mix as if each kept to where it was; how
#: much of the variance between chains must last to be worth a word; draws of a chain to tell it by
_ALARM, _LASTING, _THIRDS = 1e-4, 0.02, 12
#: scalars looked at
_SCALARS = 200
#: of these, scalars judged by their R-hat, and as many by their effective size
_JUDGED = 6
#: share of the effective size that is asked for below which it may be for names that components exchange
_HOPELESS = 0.1
#: draws of all scalars and chains that are judged: of large scalars fewer are, though at least two
_ELEMENTS = 250_000
#: draws of one scalar in all chains to which more are thinned, though not below ``_DRAWS`` per chain
_ONE = 50_000
_DRAWS = 1000
#: chains looked at; of more, some more or less stuck ones hardly change the figures
_CHAINS = 64
#: batches of a chain in the screen, and draws of a scalar from which it learns its quantiles
_BATCHES = 20
_SAMPLE = 1000


def poor_mixing(
    posterior: ChainsPosterior | ChainsSums, forward: frozenset[str], ess: float | None = None
) -> list[str]:
    """What is wrong with the chains, in words, and the remedy; nodes of ``forward`` are not looked at.

    Parameters
    ----------
    ess : float, optional
        The effective size that was asked for.
    """
    if isinstance(posterior, ChainsSums):
        return _faults(_summed_figures(posterior, forward), posterior, ess)
    found = _faults(_figures(posterior, posterior._stored, forward), posterior, ess)
    return _but_for_labels(posterior, forward, found, ess) if found else []


def share_reached(
    posterior: ChainsPosterior | ChainsSums, forward: frozenset[str], ess: float
) -> float:
    """The smallest effective size as a share of what is asked for; of tails a few hundred are enough.

    Where chains name components differently that the model does not tell apart, by their order.
    """
    if isinstance(posterior, ChainsSums):
        return _share(_summed_figures(posterior, forward), ess)
    share = _share(_figures(posterior, posterior._stored, forward), ess)
    if share < _HOPELESS:
        stored = _named(posterior)[0]
        if stored is not posterior._stored:
            return max(share, _share(_figures(posterior, stored, forward), ess))
    return share


def poor_acceptance(acceptance: Mapping[str, np.ndarray], band: Any) -> Iterator[str]:
    """Blocks whose mean acceptance rate lies outside the useful ``band`` (see ``Sampler``)."""
    for block, rates in acceptance.items():
        limits = band.get(block) if isinstance(band, Mapping) else band
        rate = float(np.mean(rates))
        if limits is None or limits[0] <= rate <= limits[1] or math.isnan(rate):
            continue
        low = rate < limits[0]
        yield (
            f"{block!r} accepts {100 * rate:.3g} % of its proposals, "
            + (f"under {100 * limits[0]:g} %" if low else f"over {100 * limits[1]:g} %")
            + (
                "; use narrower proposals"
                if low
                else ", by steps too small to get far; use wider ones"
            )
            + ", or a longer warmup= where they adapt"
        )


def by_chance(ess: Any, groups: int) -> Any:
    """R-hat of so many groups that agree, or ``MAX_RHAT``, seldom exceeded where draws are worth ``ess``."""
    limit = scipy.special.chdtri(groups - 1, _ALARM)
    return np.maximum(MAX_RHAT, np.sqrt(1.0 + groups / (groups - 1) * limit / np.maximum(ess, 1.0)))


def scalar_name(model: Model, name: str, index: tuple[int, ...]) -> str:
    """A scalar's name with its plate labels, as in a summary."""
    if not index:
        return name
    node = model[name]
    labels: list[Any] = [
        model.labels.get(plate, range(size))[i]
        for plate, size, i in zip(node.plates, node.plate_shape, index, strict=False)
    ]
    return f"{name}[{', '.join(map(str, [*labels, *index[len(labels) :]]))}]"


# ---- private ------------------------------------------------------------------------------------


class _Judged(NamedTuple):
    """Figures of the scalars that were judged, and how many were looked at."""

    looked: int
    #: name of a scalar -> its R-hat
    rhat: dict[str, float]
    #: name of a scalar -> its effective sizes, in bulk and in the tails (NaN where that is not known)
    ess: dict[str, tuple[float, float]]
    #: name of a scalar -> R-hat that superchains may have by chance
    chance: dict[str, float] = {}
    #: name of a scalar -> correlation over chains of means of the first and the last third, where it lasts
    lasting: dict[str, float] = {}


def _faults(
    judged: _Judged, posterior: ChainsPosterior | ChainsSums, ess: float | None
) -> list[str]:
    if not judged.looked:
        return []
    few = _few_draws(judged, *posterior._chains_and_draws, ess)
    return [*_disagreement(judged), *_lasting(judged), *few]


def _share(judged: _Judged, ess: float) -> float:
    tails = min(ess, MIN_ESS * _POOLED)
    shares = [min(b / ess, np.nan_to_num(t, nan=np.inf) / tails) for b, t in judged.ess.values()]
    return float(np.nan_to_num(min(shares, default=np.inf), nan=0.0))


def _but_for_labels(
    posterior: ChainsPosterior, forward: frozenset[str], found: list[str], ess: float | None
) -> list[str]:
    """What is wrong once components that the model does not tell apart are named by their order.

    Where nothing is, the posterior says so, and there is no reason to warn.
    """
    stored, orders, words = _named(posterior)
    if not words:
        return found
    left = _faults(_figures(posterior, stored, forward), posterior, ess)
    if left:
        return [_ordered(fault, orders) for fault in left]
    posterior.label_switching = "; ".join(words)
    return []


def _named(
    posterior: ChainsPosterior,
) -> tuple[Mapping[str, np.ndarray], dict[str, str], list[str]]:
    """The draws with components named by their order; by which order of which nodes; and what to say."""
    point = posterior.checkpoint
    stored: Mapping[str, np.ndarray] = posterior._stored
    orders: dict[str, str] = {}
    words: list[str] = []
    if posterior.problem is None or point is None:
        return stored, orders, words
    for symmetry in symmetries(posterior.problem, point.values):
        pivot = pivot_of(symmetry, posterior.model)
        if pivot is not None and pivot in stored:
            stored = ordered(posterior.problem, stored, symmetry, pivot)
            of = f"plate {symmetry.plate!r}" if symmetry.plate else f"{pivot!r}"
            labels = posterior.model.labels.get(symmetry.plate or "")
            shown = f" ({', '.join(map(str, labels[:6]))})" if labels is not None else ""
            order = f"with the components of {of}{shown} named by the order of {pivot!r}"
            orders |= dict.fromkeys(symmetry.names, order)
            words.append(
                f"the {symmetry.size} components of {of} are named differently from draw to draw, as the "
                f"model does not tell them apart; by the order of {pivot!r} they have mixed: ask "
                f"relabelled({pivot!r}), or for what does not depend on names"
            )
    return stored, orders, words


def _ordered(fault: str, orders: Mapping[str, str]) -> str:
    """A fault, and by which order the component that it names is known, if it names one."""
    for name, order in orders.items():
        if f"{name!r}" in fault or f"'{name}[" in fault:
            return f"{order}, {fault}"
    return fault


def _disagreement(judged: _Judged) -> Iterator[str]:
    limits = {name: judged.chance.get(name, MAX_RHAT) for name in judged.rhat}
    over = {
        name: np.nan_to_num(r, nan=0.0, posinf=np.inf) - limits[name]
        for name, r in judged.rhat.items()
    }
    worst = max(over, key=lambda name: over[name])
    rhat = judged.rhat[worst]
    if not over[worst] > 0:
        return
    still = (
        "every chain stands still, at different values"
        if np.isinf(rhat)
        else f"above {limits[worst]:.3g}"
    )
    others = _others([value > 0 for value in over.values()], judged.looked)
    nested = "nested R-hat" if worst in judged.chance else "R-hat"
    yield (
        f"the chains have not mixed: {nested} of {worst!r} is {rhat:.3f} ({still}{others}); use more warmup= "
        "and draws= (infer(..., resume=posterior) adds draws), or another engine"
    )


def _lasting(judged: _Judged) -> Iterator[str]:
    if judged.lasting:
        worst = max(judged.lasting, key=lambda name: judged.lasting[name])
        yield (
            "chains keep to where they are: the means of the first and the last third of each go together "
            f"for {worst!r} (correlation {judged.lasting[worst]:.2f} over chains): shares of modes are "
            "those of the starts; use more warmup= and draws=, or another engine"
        )


def _few_draws(judged: _Judged, chains: int, draws: int, asked: float | None) -> Iterator[str]:
    sizes = {n: (b, "bulk") if not t < b else (t, "tail") for n, (b, t) in judged.ess.items()}
    if asked is not None and not _share(judged, asked) >= 1:
        sizes = {n: (b, "bulk") for n, (b, _) in judged.ess.items()} | {
            n: size for n, size in sizes.items() if size[0] < MIN_ESS * _POOLED
        }
    worst = min(sizes, key=lambda name: np.nan_to_num(sizes[name][0], nan=np.inf))
    ess, kind = sizes[worst]
    needed = float(MIN_ESS * min(chains, _POOLED))
    if asked is not None:
        needed = asked if kind == "bulk" else min(needed, asked)
    if ess < needed:
        others = _others([value < needed for value, _ in sizes.values()], judged.looked)
        worth = f"the {chains} x {draws} draws of {worst!r} are worth {ess:.0f} independent ones ({kind} ESS,"
        if asked is not None:
            yield (
                f"{worth} of {needed:g} that ess={asked:g} asks for{others}); use more "
                "(infer(..., resume=posterior) adds some), another engine, or declare the model in numbers "
                "that depend less on each other"
            )
            return
        each = f"{MIN_ESS} per chain" if chains <= _POOLED else f"{needed:.0f}"
        yield (
            f"{worth} under {each}{others}), too few for error bars; use more draws= "
            "(infer(..., resume=posterior) adds some) or thinning=, or another engine"
        )
    elif not ess >= needed:
        yield (
            f"{draws} draws per chain are too few to tell whether the chains have mixed; use more draws="
        )


def _others(bad: list[bool], looked: int) -> str:
    count = sum(bad) - 1
    if count <= 0:
        return ""
    if len(bad) == looked:
        return f", and so are {count} more of {looked} looked at"
    return f", and so are {count} more of the {len(bad)} that look worst of {looked}"


def _figures(
    posterior: ChainsPosterior, stored: Mapping[str, np.ndarray], forward: frozenset[str]
) -> _Judged:
    """What ArviZ says of those scalars that the screen finds worst; scalars that never move are left out."""
    block, chains = posterior.ensemble_size, posterior._chains_and_draws[0]
    groups = posterior.superchains
    names, columns = [], []
    for name, index in some_scalars(_moving(posterior, forward), posterior.model):
        if name not in stored:
            continue
        at: tuple[Any, ...] = (slice(None), slice(None), *index)
        values = stored[name][at]
        if (values != values[0, 0]).any():  # a state never left in any chain is nothing to judge by
            names.append(scalar_name(posterior.model, name, index))
            columns.append(uncut(posterior.model[name], index, _thinned(values, block, groups)))
    if not names:
        return _Judged(0, {}, {})
    share = len(columns[0]) / chains
    many = min(_JUDGED, max(2, _ELEMENTS // max(columns[0].size, 1)))
    disagreement, ess = np.transpose([_screen(values, block) for values in columns])
    apart = np.argsort(-disagreement, kind="stable")[:many]  # NaN, of which nothing is known, last
    slow = np.argsort(ess, kind="stable")[:many]

    def figure(kind: str, at: int) -> float:
        found = diagnostics.chain_statistic(kind, columns[at], block, groups)
        return float(found.item() if kind == "rhat" else found.item() / share)

    sizes = {names[at]: (figure("ess", at), figure("tail_ess", at)) for at in slow}
    ratios = {names[at]: figure("rhat", at) for at in apart}
    if not groups:
        return _Judged(len(names), ratios, sizes)
    chance = {names[at]: _chance(columns[at], block, groups) for at in apart}
    lasting = {names[at]: _memory(columns[at]) for at in {*apart, *slow}}
    lasting = {name: memory for name, memory in lasting.items() if memory > 0}
    return _Judged(len(names), ratios, sizes, chance, lasting)


def _chance(values: np.ndarray, block: int, groups: int) -> float:
    """Nested R-hat of so many superchains that have mixed, or ``MAX_RHAT``, seldom exceeded.

    The means of superchains, of values or of their distances from the median, then have the variance of
    ``ess / groups`` independent draws.
    """
    far = np.abs(values - np.median(values))
    ess = min(float(diagnostics.chain_statistic("ess", x, block)) for x in (values, far))
    return float(by_chance(ess, groups))


def _memory(values: np.ndarray) -> float:
    """Correlation over chains of the means of their first and last thirds; 0 where it is chance."""
    chains, draws = values.shape
    if draws < _THIRDS or chains < 2 * _POOLED:
        return 0.0
    scores = diagnostics.normal_scores(values[None])[0]
    third = draws // 3
    first, last = scores[:, :third].mean(axis=1), scores[:, -third:].mean(axis=1)
    with np.errstate(all="ignore"):
        correlation = float(np.corrcoef(first, last)[0, 1])
        z = np.arctanh(correlation) * math.sqrt(chains - 3)
        lasting = correlation * first.std() * last.std() / scores.var()
    return correlation if z > scipy.special.ndtri(1 - _ALARM) and lasting > _LASTING else 0.0


def _screen(values: np.ndarray, block: int) -> tuple[float, float]:
    """How far halves of chains differ, and an effective size: rough, to rank scalars by and no more.

    Both come from batch means (Flegal and Jones 2010), the first as the variance between halves over the
    whole one, of the values and of their distance from the median, both squashed so that heavy tails do
    not hide anything; the second as the smallest of the squashed values' and both tails'. No ranks are
    taken and nothing is corrected for few batches. NaN if there are fewer than four blocks of draws.
    """
    chains, draws = values.shape
    if draws < 4 * block:
        return np.nan, np.nan
    count = min(_BATCHES, draws // block)
    values = values[:, : draws // block // count * block * count].astype(float, copy=False)  # flags
    sample = values.ravel()[:: (values.size // _SAMPLE) | 1]
    with np.errstate(all="ignore"):  # infinite draws, and scalars that hardly ever move
        low, middle, high = np.quantile(sample, [0.05, 0.5, 0.95])
        offset = (values - middle) / (high - low or values.std())
        far = np.abs(offset)
        far /= 1.0 + far
        series = np.stack([np.copysign(far, offset), far, values <= low, values <= high])
        means = series.reshape(4, chains, count, -1).mean(axis=-1)
        variance = of_blocks = series.var(axis=(1, 2))
        if block > 1:
            of_blocks = series.reshape(4, chains, -1, block).mean(axis=-1).var(axis=(1, 2))
        half = count // 2
        halves = np.stack([means[..., :half].mean(axis=-1), means[..., -half:].mean(axis=-1)])
        between = halves.var(axis=(0, 2)) / of_blocks
        ess = chains * count * variance / means.var(axis=(1, 2))
        if chains >= 2 * _POOLED:  # what batches of few draws do not show of each other
            ess = np.fmin(ess, chains * variance / means.mean(axis=2).var(axis=1))
    return float(np.fmax(*between[:2])), float(np.fmin.reduce(ess[[0, 2, 3]]))


def _summed_figures(posterior: ChainsSums, forward: frozenset[str]) -> _Judged:
    """The same from sums, whose own figures are cheap and know no tails: of all scalars looked at."""
    ratios: dict[str, float] = {}
    sizes: dict[str, tuple[float, float]] = {}
    for name, node in posterior.model.nodes.items():
        if name in forward or not posterior._running.is_batched(name):
            continue
        rhat, ess = posterior.rhat(name), posterior.ess(name)
        moves = posterior.moves(name)
        for index in _spread(moves.shape, _SCALARS):
            if moves[index]:
                scalar = scalar_name(posterior.model, name, index[: len(node.value_shape)])
                if len(index) > len(node.value_shape) and node.domain is not None:
                    scalar += f" == {node.domain.states[index[-1]]!r}"
                ratios[scalar] = float(rhat[index])
                sizes[scalar] = float(ess[index]), np.nan
    return _Judged(len(ratios), ratios, sizes)


def _moving(posterior: ChainsPosterior, forward: frozenset[str]) -> list[CompiledNode]:
    """Nodes whose draws vary, as far as their shapes tell."""
    return [
        posterior.model[name]
        for name, values in posterior._stored.items()
        if name not in forward and name not in posterior._observed and values.size
        and posterior.model[name].kind not in ("input", "fixed")
    ]  # fmt: skip


def some_scalars(nodes: list[CompiledNode], model: Model) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Node and index of up to ``_SCALARS`` scalars, spread evenly over nodes and within them."""
    if len(nodes) > _SCALARS:
        picked = np.linspace(0, len(nodes) - 1, _SCALARS).round().astype(int)
        nodes = [nodes[i] for i in picked]
    left = _SCALARS
    small_first = sorted(nodes, key=lambda node: math.prod(node.value_shape))
    for position, node in enumerate(small_first):
        share = left // (len(small_first) - position)
        chosen = list(_spread(node.value_shape, share))
        left -= len(chosen)
        for index in chosen:
            yield node.name, index


def _spread(shape: tuple[int, ...], count: int) -> Iterator[tuple[int, ...]]:
    total = math.prod(shape)
    flat = np.unique(np.linspace(0, total - 1, min(count, total)).round().astype(int))
    for at in zip(*np.unravel_index(flat, shape), strict=True) if shape else [()]:
        yield tuple(int(i) for i in at)


def _thinned(values: np.ndarray, block: int, superchains: int = 0) -> np.ndarray:
    """Every k-th block of draws of long chains, of some chains if there are many; shape (chain, draw)."""
    if len(values) > _CHAINS and not superchains:
        values = values[np.linspace(0, len(values) - 1, _CHAINS).round().astype(int)]
    chains, draws = values.shape
    step = max(1, min(draws // _DRAWS, -(-chains * draws // _ONE)))
    whole = draws // block * block
    return values[:, :whole].reshape(chains, -1, block)[:, ::step].reshape(chains, -1)


def uncut(node: CompiledNode, index: tuple[int, ...], values: np.ndarray) -> np.ndarray:
    """The draws of a scalar, those of an angle near their mean: cut in two they would look faster mixed."""
    if node.angles is None or not node.angles[index[len(node.plates) :]]:
        return values
    return near(values, np.angle(np.exp(1j * values).mean()))
