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
import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.special

from bayesmc import diagnostics
from bayesmc.engines.mcmc.screening import Looked, looked_at, screened, spread
from bayesmc.errors import ReducibleWarning
from bayesmc.network import CompiledNode, Model
from bayesmc.results import ChainsPosterior, ChainsSums
from bayesmc.results.relabelling import ordered, pivot_of, symmetries

#: R-hat above which chains disagree (Vehtari et al. 2021, sec. 5)
MAX_RHAT = 1.01
#: effective draws of a chain below which neither R-hat nor errors can be trusted, and chains from which on
#: more of them pool what they know
MIN_ESS, _POOLED = 100, 4
#: chance that superchains which agree look apart, or chains that mix as if each kept to where it was; how
#: much of the variance between chains must last to be worth a word; draws of a chain to tell it by
_ALARM, _LASTING, _THIRDS = 1e-4, 0.02, 12
#: scalars looked at where draws were summed
_SCALARS = 200
#: scalars judged by their R-hat, and as many by their effective size
_JUDGED = 6
#: how far the rough screen may be off: whoever seems to have less than so many times what is needed is
#: judged as well, as far as their draws are few
_DOUBT = 4.0
#: share of the effective size that is asked for below which it may be for names that components exchange
_HOPELESS = 0.1
#: draws of all scalars and chains that are judged: of large scalars fewer are, though at least two
_ELEMENTS = 250_000


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
    found = _faults(_figures(posterior, posterior._stored, forward, ess), posterior, ess)
    return _but_for_labels(posterior, forward, found, ess) if found else []


def share_reached(
    posterior: ChainsPosterior | ChainsSums,
    forward: frozenset[str],
    ess: float,
    agree: bool = True,
) -> float:
    """The smallest effective size as a share of what is asked for; of tails a few hundred are enough.

    Of few chains R-hat, too, must not tell them apart if they are to ``agree``: what it exceeds 1 by falls
    with the draws.
    Where chains name components differently that the model does not tell apart, by their order.
    """
    if isinstance(posterior, ChainsSums):
        return _share(_summed_figures(posterior, forward), ess)
    stored: Mapping[str, np.ndarray] = posterior._stored
    share = _share(_sizes(posterior, stored, forward, ess), ess)
    if share < _HOPELESS:
        stored = _named(posterior)[0]
        if stored is not posterior._stored:
            share = max(share, _share(_sizes(posterior, stored, forward, ess), ess))
    if share < 1 or posterior.superchains or not agree:
        return share
    judged = _figures(posterior, stored, forward, ess)
    worst = max(np.nan_to_num(list(judged.rhat.values()), nan=0.0), default=0.0)
    return min(share, (MAX_RHAT - 1.0) / max(worst - 1.0, 1e-9))


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


def warn_of_ties(engine: str, names: Sequence[str]) -> None:
    """Warn that zeros in tables may hold chains."""
    shown = ", ".join(map(repr, names[:6]))
    if len(names) > 6:
        shown += f" and {len(names) - 6} more"
    warnings.warn(
        f"{engine}: zero probabilities tie {shown} together, so a chain may not reach every configuration "
        "that is possible; compare with Exact() or LikelihoodWeighting(draws)",
        ReducibleWarning,
        stacklevel=5,
    )


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
    left = _faults(_figures(posterior, stored, forward, ess), posterior, ess)
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
            "those of the starts; begin near the mode that counts (start=), use more warmup= and draws=, or "
            "another engine"
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
    posterior: ChainsPosterior,
    stored: Mapping[str, np.ndarray],
    forward: frozenset[str],
    ess: float | None,
) -> _Judged:
    """What ArviZ says of those scalars that the screen finds worst; scalars that never move are left out."""
    block, groups = posterior.ensemble_size, posterior.superchains
    looked, names, apart, slow = _worst(posterior, stored, forward, ess)
    if not names:
        return _Judged(0, {}, {})
    these = np.union1d(apart, slow)
    draws = looked.draws[these]
    figures = diagnostics.chain_figures(np.moveaxis(draws, 0, -1), block, groups)
    at = {scalar: k for k, scalar in enumerate(these.tolist())}
    sizes, ratios, chance = {}, {}, {}
    for scalar in slow.tolist():
        k = at[scalar]
        sizes[names[scalar]] = (
            float(figures.ess[k] / looked.share),
            float(figures.tail_ess[k] / looked.share),
        )
    for scalar in apart.tolist():
        k = at[scalar]
        ratios[names[scalar]] = float(figures.rhat[k])
        # the means of superchains, of values or of their distances from the median, then have the variance
        # of ``ess / groups`` independent draws
        chance[names[scalar]] = (
            float(by_chance(min(figures.ess[k], figures.spread_ess[k]), groups)) if groups else 0.0
        )
    if not groups:
        return _Judged(len(names), ratios, sizes)
    memory = {names[s]: m for s, m in zip(these.tolist(), _memory(draws), strict=True) if m > 0}
    return _Judged(len(names), ratios, sizes, chance, memory)


def _sizes(
    posterior: ChainsPosterior,
    stored: Mapping[str, np.ndarray],
    forward: frozenset[str],
    ess: float | None,
) -> _Judged:
    """Of the same scalars the effective sizes alone."""
    looked, names, _, slow = _worst(posterior, stored, forward, ess)
    if not names:
        return _Judged(0, {}, {})
    draws, block = np.moveaxis(looked.draws[slow], 0, -1), posterior.ensemble_size
    bulk, tail = (diagnostics.chain_statistic(k, draws, block) for k in ("ess", "tail_ess"))
    sizes = np.stack([bulk, tail], axis=1) / looked.share
    return _Judged(
        len(names), {}, {names[s]: tuple(f) for s, f in zip(slow, sizes.tolist(), strict=True)}
    )


def _worst(
    posterior: ChainsPosterior,
    stored: Mapping[str, np.ndarray],
    forward: frozenset[str],
    asked: float | None,
) -> tuple[Looked, list[str], np.ndarray, np.ndarray]:
    """What was looked at, the scalars' names; which of them differ most between chains, and are slowest."""
    block, model = posterior.ensemble_size, posterior.model
    looked = looked_at(_moving(posterior, forward), model, stored, block, posterior.superchains)
    names = [scalar_name(model, name, index) for name, index in looked.scalars]
    most = max(2, _ELEMENTS // max(math.prod(looked.draws.shape[1:]), 1))
    many = min(_JUDGED, most)
    disagreement, ess = screened(looked.draws, block)
    if asked is None:
        asked = MIN_ESS * min(posterior._chains_and_draws[0], _POOLED)
    doubtful = int((ess < _DOUBT * asked * looked.share).sum())
    apart = np.argsort(-disagreement, kind="stable")[:many]  # NaN, of which nothing is known, last
    return looked, names, apart, np.argsort(ess, kind="stable")[: max(many, min(doubtful, most))]


def _memory(draws: np.ndarray) -> np.ndarray:
    """Correlation over chains of the means of the first and the last third of each; 0 by chance."""
    count, chains, length = draws.shape
    if length < _THIRDS or chains < 2 * _POOLED:
        return np.zeros(count)
    scores = diagnostics.normal_scores(draws)
    third = length // 3
    first, last = scores[..., :third].mean(axis=-1), scores[..., -third:].mean(axis=-1)
    with np.errstate(all="ignore"):
        correlation, together = _going_together(first, last)
        lasting = together / scores.var(axis=(1, 2))
        # one chain that met a rare state twice says nothing of the others
        most = np.argmax(
            (first - first.mean(1, keepdims=True)) * (last - last.mean(1, keepdims=True)), axis=1
        )
        rest = np.arange(chains) != most[:, None]
        without, _ = _going_together(first[rest].reshape(count, -1), last[rest].reshape(count, -1))
        z = np.arctanh(np.minimum(correlation, without)) * math.sqrt(chains - 4)
    found = (z > scipy.special.ndtri(1 - _ALARM)) & (lasting > _LASTING)
    return np.where(found, correlation, 0.0)


def _going_together(first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Correlation and covariance over chains, each of shape (scalars, chains)."""
    first, last = (m - m.mean(axis=1, keepdims=True) for m in (first, last))
    together = (first * last).mean(axis=1)
    return together / (first.std(axis=1) * last.std(axis=1)), together


def _summed_figures(posterior: ChainsSums, forward: frozenset[str]) -> _Judged:
    """The same from sums, whose own figures are cheap and know no tails: of all scalars looked at."""
    ratios: dict[str, float] = {}
    sizes: dict[str, tuple[float, float]] = {}
    for name, node in posterior.model.nodes.items():
        if name in forward or not posterior._running.is_batched(name):
            continue
        rhat, ess = posterior.rhat(name), posterior.ess(name)
        moves = posterior.moves(name)
        for index in spread(moves.shape, _SCALARS):
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
