"""Whether chains have missed an end of a parameter that governs others: the neck of a funnel.

Where effects are weak, their scale may be near zero, and the effects with it. Steps that suit the wide part
are refused in the neck, so chains turn back at its mouth and look well mixed where they are. What shows it is
an identity that holds for every density that vanishes at its ends: with u the parameter as a free number, s
its score ``d log p / d u`` and h any smooth bounded function, ``E[h s + h'] = 0``. Draws that turn back at a
wall violate it by the density at the wall, and most so with an h that looks at one end alone. So do right
draws where the density itself has an edge or a jump: before an alarm it is looked for one.

References
----------
Neal (2003), Slice sampling, Annals of Statistics 31, sec. 8; Gorham and Mackey (2015), Measuring sample
quality with Stein's method, NIPS 28; Hall (1992), JRSS B 54, eq. 2.4; Betancourt and Girolami (2015),
Hamiltonian Monte Carlo for hierarchical models.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from bayesmc import diagnostics
from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BayesmcError
from bayesmc.network import CompiledNode, Model, Problem
from bayesmc.results import ChainsPosterior

#: standard errors that the identity may be off: a false alarm in a thousand parameters of a right sampler
_LIMIT = 4.0
#: effective draws at an end below which it is not judged: squares of effects are skewed
_AT_END = 100.0
#: shares of the draws at an end that the functions h look at, and their width in standard deviations
_ENDS, _WIDTH = (0.25, 0.1, 0.05), 0.25
#: numbers that densities are evaluated of, at most; parameters looked at; draws below which none is judged
_NUMBERS, _PARAMETERS, _FEW = 2_000_000, 12, 400
#: draws at each end, and as many between, around which a jump is looked for, and bisections to find it
_LOOKED, _HALVES = 100, 32
#: difference of a log density that is left at a jump; share of draws without a score that are left out
_JUMP, _BAD = 1e-3, 0.01
#: step of the derivative, in standard deviations
_STEP = 1e-4


def missed_ends(posterior: ChainsPosterior, forward: frozenset[str]) -> Iterator[str]:
    """Parameters of hidden nodes at an end of which the draws turn back though the density goes on, in words.

    Parameters
    ----------
    posterior : ChainsPosterior
    forward : frozenset of str
        Nodes outside of the chain.
    """
    problem = posterior.problem
    if problem is None:
        return
    looked = 0
    for name, children in _governing(problem, forward):
        if looked == _PARAMETERS:
            return
        stored = _thinned(posterior, [name, *_involved(problem.model, name, forward)])
        if stored is None:
            continue
        looked += 1
        try:
            with marking_invalid(), np.errstate(all="ignore"):
                found = _worst(problem.model, name, stored, forward, posterior.ensemble_size)
                if found is None or not found[0] > _LIMIT:
                    continue
                if _has_jump(problem.model, name, stored, forward):
                    continue
        except (BayesmcError, ValueError, FloatingPointError):
            continue  # a function that minds being asked beside a draw must not cost a run
        z, end, edge = found
        shown = ", ".join(map(repr, children[:3]))
        yield (
            f"draws of {name!r} turn back at its {end} end, near {edge:.3g}, where their density goes on "
            f"(its score is off by {z:.1f} standard errors): the chains have not entered a funnel, and what "
            f"they say of {name!r} is wrong by more than its error; declare {shown} without it and scale "
            f"afterwards (b = {name} * z, with z of scale 1), or compare with another engine"
        )


# ---- private ------------------------------------------------------------------------------------


def _governing(problem: Problem, forward: frozenset[str]) -> Iterator[tuple[str, list[str]]]:
    """Hidden scalars with hidden children of several numbers, and these children."""
    model = problem.model
    for name, node in model.nodes.items():
        if not _is_hidden(problem, name, forward) or node.value_shape or _ends(node) is None:
            continue
        terms = _terms(model, name)[1]
        children = [
            n for n in terms
            if n != name and _is_hidden(problem, n, forward) and not model[n].is_discrete
        ]  # fmt: skip
        if sum(math.prod(model[n].value_shape) for n in children) >= 2:
            yield name, children


def _is_hidden(problem: Problem, name: str, forward: frozenset[str]) -> bool:
    node = problem.model[name]
    return (
        node.is_stochastic
        and name not in problem.observed
        and name not in forward
        and node.kind not in ("input", "fixed")
    )


def _ends(node: CompiledNode) -> tuple[float, float] | None:
    """Bounds of a continuous scalar's support, if they are fixed."""
    support = node.support
    if node.is_discrete or support is None or support.kind not in ("real", "interval"):
        return None
    if support.kind == "real":
        return -np.inf, np.inf
    low, high = np.asarray(support.low, dtype=float), np.asarray(support.high, dtype=float)
    return (float(low), float(high)) if low.size == high.size == 1 else None


def _terms(model: Model, name: str) -> tuple[list[str], list[str], list[str]]:
    """Computed nodes that depend on a node, in order; nodes whose density does; and potentials."""
    place, children = _children(model)
    moved, computed, terms = {name}, [], [name]
    todo = list(children[name])
    while todo:
        other = todo.pop()
        if other in moved or other in terms:
            continue
        if model[other].kind == "deterministic":
            moved.add(other)
            computed.append(other)
            todo += children[other]
        elif model[other].is_stochastic:
            terms.append(other)
    computed.sort(key=place.__getitem__)
    factors = [n for n, (p, _) in model.potentials.items() if moved & set(p.parents)]
    return computed, terms, factors


def _children(model: Model) -> tuple[dict[str, int], dict[str, list[str]]]:
    """Place of every node in topological order, and its children; found once."""
    if "children" not in model.cache:
        children: dict[str, list[str]] = {n: [] for n in model.nodes}
        for name, node in model.nodes.items():
            for parent in dict.fromkeys(node.parents):
                children[parent].append(name)
        model.cache["children"] = {n: i for i, n in enumerate(model.nodes)}, children
    return model.cache["children"]


def _involved(model: Model, name: str, forward: frozenset[str]) -> list[str]:
    """All nodes whose values are needed for the terms of one."""
    computed, terms, factors = _terms(model, name)
    found = {n for n in terms if n not in forward}
    for n in [*computed, *found]:
        found |= set(model[n].parents)
    for factor in factors:
        found |= set(model.potentials[factor][0].parents)
    return sorted(found)


def _thinned(posterior: ChainsPosterior, names: list[str]) -> dict[str, np.ndarray] | None:
    """Some draws of these nodes, ``(chain, draw, ...)``; None where some were not kept, or are too few."""
    known: Mapping[str, np.ndarray] = {**posterior._inputs}
    stored = {n: posterior._stored[n] for n in names if n in posterior._stored}
    if any(n not in stored and n not in known for n in names):
        return None
    chains, draws = posterior._shape
    block = posterior.ensemble_size
    numbers = sum(math.prod(v.shape[2:]) for v in stored.values())
    most = max(_NUMBERS // max(numbers * chains, 1), 1)
    step = -(-draws // min(draws, most))
    if chains * draws // step < _FEW:
        return None
    places = np.arange(draws // block * block).reshape(-1, block)[::step].ravel()
    return {n: v if v.shape[1] == 1 else v[:, places] for n, v in stored.items()} | {
        n: v[None, None] for n, v in known.items() if n in names
    }


def _worst(
    model: Model, name: str, stored: dict[str, np.ndarray], forward: frozenset[str], block: int
) -> tuple[float, str, float] | None:
    """Standard errors that the identity is off at the worse end, which end, and where it lies."""
    ends = _ends(model[name])
    assert ends is not None
    x = stored[name]
    if x.shape[1] == 1:
        return None
    free, back, slope = _free(*ends)
    u = free(x)
    spread = float(u[np.isfinite(u)].std()) if np.isfinite(u).any() else 0.0
    if not spread > 0:
        return None
    step = _STEP * spread
    log = [_log_terms(model, name, {**stored, name: back(u + s)}, forward) for s in (step, -step)]
    score = (log[0] - log[1]) / (2 * step) + slope(u)
    if score.shape != u.shape:
        return None
    fit = np.isfinite(score) & np.isfinite(u)
    if not fit.mean() > 1 - _BAD:
        return None
    u = np.where(fit, u, np.median(u[fit]))
    effective = float(diagnostics.chain_statistic("ess", u, block))
    found = []
    for end, turned in (("lower", u), ("upper", -u)):
        sign = 1.0 if end == "lower" else -1.0
        for share in _ENDS:
            t = (turned - np.quantile(turned, share)) / (_WIDTH * spread)
            h = 1.0 / (1.0 + np.exp(t))
            figure = h * sign * score - h * (1 - h) / (_WIDTH * spread)
            figure = np.where(fit, figure, figure[fit].mean())
            if share * effective >= _AT_END:
                edge = float(back(np.asarray(sign * turned.min())))
                found.append((_errors_below(figure, block), end, edge))
    return max(found, default=None)


def _has_jump(
    model: Model, name: str, stored: dict[str, np.ndarray], forward: frozenset[str]
) -> bool:
    """Whether the density jumps, or ends, near some of the draws as a parameter alone is moved.

    An interval about a draw is halved again and again, towards where the log density differs more: at last
    nothing is left of the difference but at a jump.
    """
    ends = _ends(model[name])
    assert ends is not None
    free, back, _ = _free(*ends)
    u = free(stored[name])
    shape = u.shape
    order = np.argsort(u, axis=None)[: np.isfinite(u).sum()]
    between = order[:: max(order.size // _LOOKED, 1)]
    at = np.unravel_index(np.r_[order[:_LOOKED], between, order[-_LOOKED:]], shape)
    few = {n: np.broadcast_to(v, shape + v.shape[2:])[at][None] for n, v in stored.items()}

    def log(x: np.ndarray) -> np.ndarray:
        return _log_terms(model, name, {**few, name: back(x)}, forward)

    wide = _WIDTH * float(u.ravel()[order].std())
    low, high = u[at][None] - wide, u[at][None] + wide
    left, right = log(low), log(high)
    for _ in range(_HALVES):
        centre = 0.5 * (low + high)
        middle = log(centre)
        lower = _apart(left, middle) > _apart(middle, right)
        low, left = np.where(lower, low, centre), np.where(lower, left, middle)
        high, right = np.where(lower, centre, high), np.where(lower, middle, right)
    return bool((_apart(left, right) > _JUMP).any())


def _apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distance of two log densities; none between two that are both minus infinity."""
    return np.nan_to_num(np.abs(a - b), nan=0.0, posinf=np.inf)


def _errors_below(figure: np.ndarray, block: int) -> float:
    """Standard errors by which a mean lies below zero, or fewer where skewness explains it (Hall 1992)."""
    error = float(diagnostics.chain_statistic("mcse", figure, block))
    if not error > 0:
        return 0.0
    z = -float(figure.mean()) / error
    skewness = -float(((figure - figure.mean()) ** 3).mean()) / float(figure.std()) ** 3
    a = skewness * error / float(figure.std())  # over the root of the effective draws
    return min(z, z + a * (z * z / 3 + 1 / 6) + a * a * z**3 / 27)


def _free(low: float, high: float) -> tuple[Any, Any, Any]:
    """A number as a free one, back, and the slope of the log of the derivative of the way back."""
    if np.isfinite(low) and np.isfinite(high):
        return (
            lambda x: np.log((x - low) / (high - x)),
            lambda u: low + (high - low) / (1 + np.exp(-u)),
            lambda u: -np.tanh(0.5 * u),
        )
    if np.isfinite(low):
        return lambda x: np.log(x - low), lambda u: low + np.exp(u), np.ones_like
    if np.isfinite(high):
        return lambda x: np.log(high - x), lambda u: high - np.exp(u), np.ones_like
    return lambda x: x, lambda u: u, np.zeros_like


def _log_terms(
    model: Model, name: str, values: dict[str, np.ndarray], forward: frozenset[str]
) -> np.ndarray:
    """Sum of the log densities that a node enters, for every draw."""
    computed, terms, factors = _terms(model, name)
    for other in computed:
        values[other] = np.asarray(model.evaluate(other, values)[0])
    total: Any = 0.0
    for other in terms:
        if other not in forward:
            given, _ = model.evaluate(other, values)
            log = _log_density(model[other], given, values[other])
            total = total + log.sum(axis=tuple(range(2, log.ndim)))
    for factor in factors:
        total = total + model.potential(factor, values)
    return np.asarray(total)


def _log_density(node: CompiledNode, given: Any, stored: np.ndarray) -> np.ndarray:
    """Log density of stored values; NaN where there is none, so that one draw does not cost the others."""
    value = node.domain.to_support(stored) if node.domain is not None else stored
    log = given.log_prob_unchecked(np.asarray(value))
    return log if given.invalid is None else np.where(given.invalid, -np.inf, log)
