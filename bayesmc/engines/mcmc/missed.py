"""What chains may have missed: an end of a parameter that governs others, or states that none ever left.

Where effects are weak, their scale may be near zero, and the effects with it: the neck of a funnel. Steps
that suit the wide part are refused in the neck, so chains turn back at its mouth and look well mixed where
they are. What shows it is an identity that holds for every density that vanishes at its ends: with u the
parameter as a free number, s its score ``d log p / d u`` and h any smooth bounded function, ``E[h s + h'] =
0``. Draws that turn back at a wall violate it by the density at the wall, and most so with an h that looks
at one end alone. So do right draws where the density itself has an edge or a jump: before an alarm it is
looked for one.

References
----------
Neal (2003), Slice sampling, Annals of Statistics 31, sec. 8; Gorham and Mackey (2015), Measuring sample
quality with Stein's method, NIPS 28; Hall (1992), JRSS B 54, eq. 2.4; Betancourt and Girolami (2015),
Hamiltonian Monte Carlo for hierarchical models.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from bayesmc import diagnostics
from bayesmc.distributions.base import marking_invalid
from bayesmc.distributions.support import Support
from bayesmc.distributions.transforms import Transform, transform_of
from bayesmc.errors import BayesmcError
from bayesmc.results import ChainsPosterior, ChainsSums
from bayesmc.structure.target import Target, Term, Values, target_of

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
#: times that what waits for a node is drawn anew, below which a state that was never left is worth a word
_RENEWED = 25.0


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
    nodes = problem.model.nodes.items()
    target = target_of(problem, [n for n, c in nodes if c.is_stochastic and n not in forward])
    looked = 0
    for name, children in _governing(target):
        if looked == _PARAMETERS:
            return
        stored = _thinned(posterior, _involved(target, name))
        if stored is None:
            continue
        looked += 1
        support = target.model[name].support
        assert support is not None
        transform = transform_of(support)
        try:
            with marking_invalid(), np.errstate(all="ignore"):
                u = transform.unconstrain(stored[name])
                log_density = _density(target, name, stored, transform)
                found = _worst(log_density, u, posterior.ensemble_size)
                if found is None or not found[0] > _LIMIT:
                    continue
                if _has_jump(target, name, stored, transform):
                    continue
        except (BayesmcError, ValueError, FloatingPointError):
            continue  # a function that minds being asked beside a draw must not cost a run
        z, end, edge = found
        where = float(transform.constrain(np.asarray(edge)))
        shown = ", ".join(map(repr, children[:3]))
        yield (
            f"draws of {name!r} turn back at its {end} end, near {where:.3g}, where their "
            f"density goes on (its score is off by {z:.1f} standard errors): the chains have not entered a "
            f"funnel, and what they say of {name!r} is wrong by more than its error; declare {shown} without "
            f"it and scale afterwards (b = {name} * z, with z of scale 1), or compare with another engine"
        )


def never_left(posterior: ChainsPosterior | ChainsSums) -> Iterator[str]:
    """What is said of finite nodes that stood still in all chains, and of which too little is known.

    Parameters
    ----------
    posterior : ChainsPosterior or ChainsSums
        With its ``renewals``.
    """
    for name, renewed in posterior.renewals.items():
        suspect = _still(posterior, name) & (renewed < _RENEWED)
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


def stood_still(posterior: ChainsPosterior | ChainsSums, forward: frozenset[str]) -> Iterator[str]:
    """What is said of numbers with a density that never moved: their draws tell nothing of an error.

    Parameters
    ----------
    posterior : ChainsPosterior or ChainsSums
    forward : frozenset of str
        Nodes outside of the chain.
    """
    for name, node in posterior.model.nodes.items():
        if not node.is_stochastic or node.is_discrete or node.domain is not None or name in forward:
            continue
        seen = posterior._seen.get(name)
        if (seen is not None and seen.mask is None) or posterior._chains_and_draws[1] < 2:
            continue
        still = _still(posterior, name)
        if still.any():
            which = f"{int(still.sum())} of {still.size} elements of " if still.size > 1 else ""
            yield (
                f"{which}{name!r} never moved, in any chain: effective sizes and errors that are told of "
                "them mean nothing; check start=, the scale of what was seen, or use another engine"
            )


# ---- private ------------------------------------------------------------------------------------


def _governing(target: Target) -> Iterator[tuple[str, list[str]]]:
    """Hidden scalars with hidden children of several numbers, and these children."""
    model = target.model
    hidden = {n for n in target.chain if target.seen(n) is None}
    for name in target.chain:
        node = model[name]
        if (
            name not in hidden
            or node.value_shape
            or node.is_discrete
            or not _is_fixed(node.support)
        ):
            continue
        below = [t.name for t in target.terms_of((name,)) if t.name in hidden - {name}]
        children = [n for n in below if not model[n].is_discrete]
        if sum(math.prod(model[n].value_shape) for n in children) >= 2:
            yield name, children


def _is_fixed(support: Support | None) -> bool:
    """Whether a support is that of a number, with the same bounds whatever its parents are."""
    if support is None or support.kind not in ("real", "interval"):
        return False
    return support.kind == "real" or (np.size(support.low) == 1 and np.size(support.high) == 1)


def _involved(target: Target, name: str) -> list[str]:
    """What varies of all that is read by the terms of a node, and by what is computed on the way to them."""
    path = target.below((name,))
    found = {n for term in target.terms_of((name,)) for n in term.scope}
    found |= {name, *(p for link in path for p in target.model[link].parents)}
    return sorted(n for n in found if n not in path and not target.is_known(n))


def _thinned(posterior: ChainsPosterior, names: list[str]) -> Values | None:
    """Some draws of these nodes, ``(chain, draw, ...)``; None where some were not kept, or are too few."""
    stored = {n: posterior._stored[n] for n in names if n in posterior._stored}
    if len(stored) < len(names):
        return None
    chains, draws = posterior._shape
    block = posterior.ensemble_size
    numbers = sum(math.prod(v.shape[2:]) for v in stored.values())
    most = max(_NUMBERS // max(numbers * chains, 1), 1)
    step = -(-draws // min(draws, most))
    if chains * draws // step < _FEW:
        return None
    places = np.arange(draws // block * block).reshape(-1, block)[::step].ravel()
    return {n: v if v.shape[1] == 1 else v[:, places] for n, v in stored.items()}


def _density(
    target: Target, name: str, stored: Mapping[str, np.ndarray], transform: Transform
) -> Callable[[np.ndarray], np.ndarray]:
    """The log density of a node as a free number, for every draw of the others."""
    path, terms = target.below((name,)), target.terms_of((name,))

    def log_density(u: np.ndarray) -> np.ndarray:
        state = {**target.known, **stored, name: transform.constrain(u)}
        target.compute(state, path)
        total: Any = transform.log_abs_det_jacobian(u)
        for term in terms:
            log = _log_of(term, state)
            lead = log.shape[: log.ndim - len(term.shape)]
            full = np.broadcast_to(log, lead + term.shape)
            total = total + full.sum(axis=tuple(range(len(lead), full.ndim)))
        return np.asarray(total)

    return log_density


def _log_of(term: Term, values: Values) -> np.ndarray:
    """Log factors; NaN where there is none, so that one draw does not cost the others."""
    if term.is_potential:
        return term.log(values)
    node, (dist, _) = term.model[term.name], term.distribution(values)
    value = values[term.name] if node.domain is None else node.domain.to_support(values[term.name])
    log = dist.log_prob_unchecked(np.asarray(value))
    if dist.invalid is not None:
        log = np.where(dist.invalid, -np.inf, log)
    return log if term.mask is None else np.where(term.mask, log, 0.0)


def _worst(
    log_density: Callable[[np.ndarray], np.ndarray], u: np.ndarray, block: int
) -> tuple[float, str, float] | None:
    """Standard errors that the identity is off at the worse end, which end, and where it lies."""
    if u.shape[1] == 1:
        return None
    spread = float(u[np.isfinite(u)].std()) if np.isfinite(u).any() else 0.0
    if not spread > 0:
        return None
    step = _STEP * spread
    score = (log_density(u + step) - log_density(u - step)) / (2 * step)
    if score.shape != u.shape:
        return None
    fit = np.isfinite(score) & np.isfinite(u)
    if not fit.mean() > 1 - _BAD:
        return None
    u = np.where(fit, u, np.median(u[fit]))
    effective = float(diagnostics.chain_statistic("ess", u, block))
    found = []
    for end, sign in (("lower", 1.0), ("upper", -1.0)):
        turned = sign * u
        for share in _ENDS:
            t = (turned - np.quantile(turned, share)) / (_WIDTH * spread)
            h = 1.0 / (1.0 + np.exp(t))
            figure = h * sign * score - h * (1 - h) / (_WIDTH * spread)
            figure = np.where(fit, figure, figure[fit].mean())
            if share * effective >= _AT_END:
                found.append((_errors_below(figure, block), end, sign * float(turned.min())))
    return max(found, default=None)


def _has_jump(
    target: Target, name: str, stored: Mapping[str, np.ndarray], transform: Transform
) -> bool:
    """Whether the density jumps, or ends, near some of the draws as a parameter alone is moved.

    An interval about a draw is halved again and again, towards where the log density differs more: at last
    nothing is left of the difference but at a jump.
    """
    u = transform.unconstrain(stored[name])
    shape = u.shape
    order = np.argsort(u, axis=None)[: np.isfinite(u).sum()]
    between = order[:: max(order.size // _LOOKED, 1)]
    at = np.unravel_index(np.r_[order[:_LOOKED], between, order[-_LOOKED:]], shape)
    few = {n: np.broadcast_to(v, shape + v.shape[2:])[at][None] for n, v in stored.items()}
    log = _density(target, name, few, transform)
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
    """Standard errors by which a mean lies below zero, or fewer where skewness explains it (Hall 1992).

    Zero where they cannot be worth a word: an effective size is at most n log10(n).
    """
    least = float(figure.std()) / math.sqrt(figure.size * max(math.log10(figure.size), 1.0))
    if not -float(figure.mean()) > _LIMIT * least:
        return 0.0
    error = float(diagnostics.chain_statistic("mcse", figure, block))
    if not error > 0:
        return 0.0
    z = -float(figure.mean()) / error
    skewness = -float(((figure - figure.mean()) ** 3).mean()) / float(figure.std()) ** 3
    a = skewness * error / float(figure.std())  # over the root of the effective draws
    return min(z, z + a * (z * z / 3 + 1 / 6) + a * a * z**3 / 27)


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
    if 0 in shape:
        return np.zeros(shape, dtype=bool)
    seen = posterior._seen.get(name)
    still = (stored == stored[:1, :1]).all(axis=(0, 1)).reshape(*shape, -1).all(axis=-1)
    if seen is None or seen.mask is None:
        return np.asarray(still)
    return np.asarray(still & ~seen.mask)
