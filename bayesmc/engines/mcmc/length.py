"""How many chains, how long a warmup, how many draws: where a run is asked for an effective size.

Chains are an array axis: up to some thousand numbers a sweep costs Python's calls and hardly more for many
chains than for few. Their number depends on the model's size alone, never on a clock, so that a seed gives
the same answer everywhere. Many chains are short, and their starts must be forgotten: groups of them
(superchains) start as one, and nested R-hat compares the groups.

References
----------
Margossian et al. (2024), Nested R-hat: assessing the convergence of Markov chain Monte Carlo when running
many short chains, Bayesian Analysis.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from bayesmc import diagnostics
from bayesmc.engines.mcmc.convergence import MAX_RHAT, by_chance
from bayesmc.engines.mcmc.loop import Lengths
from bayesmc.engines.mcmc.screening import some_scalars, uncut
from bayesmc.network import Model, Problem
from bayesmc.results.relabelling import ordered, pivot_of, symmetries
from bayesmc.structure.target import target_of

#: numbers of all chains up to which a sweep costs little more than that of one chain
_NUMBERS = 4096
#: chains, least and most; effective draws that each must give at least, so that its own memory is judged
LEAST, _MOST, _EACH = 4, 256, 8
#: superchains where there are enough chains, and chains that each has at least
_SUPERCHAINS, _MEMBERS = 8, 2
#: sweeps of a warmup where none are said, at most where its end is judged
WARMUP = 1000
#: draws of each chain after which one gives up that has not got to its effective size, nor nearly so, and
#: numbers that are kept at most by then if these are enough for ``_FEWEST`` draws
_BUDGET, _KEPT, _FEWEST = 4000, 1 << 24, 1000
#: numbers by which the end of a warmup is judged, at most, and draws of each chain that are not thinned away
_FEW = 16
#: effective draws from which on chance is an excuse
_ENOUGH = 400
_WINDOW = 1 << 16


def chosen(
    problem: Problem,
    warmup: int | None,
    chains: int | None,
    ess: float,
    *,
    judges: bool,
    ensembles: bool,
    kept: Sequence[str] | None,
) -> Lengths:
    """What a run makes that is asked for an effective size: what else is said is done, the rest chosen.

    Parameters
    ----------
    problem : Problem
    warmup, chains : int or None
    ess : float
    judges : bool
        Whether the engine's kernels learn in few sweeps, so that a warmup may end early.
    ensembles : bool
        Whether each chain is an array of members itself.
    kept : sequence of str or None
        Nodes whose draws are held; None where draws are summed.
    """
    if chains is None:
        chains = LEAST
        if not ensembles and kept is not None:
            most = min(_MOST, ess / _EACH, _NUMBERS / size_of(problem))
            chains = max(LEAST, 1 << int(math.log2(max(most, 1.0))))
    groups = 0 if ensembles else _superchains(chains)
    judge = None
    if judges and warmup is None:
        judge = partial(settled, problem=problem, superchains=groups)
    budget = _BUDGET
    if kept is not None:
        numbers = sum(math.prod(problem.model[n].value_shape) for n in kept)
        budget = min(budget, max(_KEPT // max(numbers * chains, 1), _FEWEST))
    return Lengths(chains, WARMUP if warmup is None else warmup, budget, groups, ess, judge)


def settled(stored: Mapping[str, np.ndarray], problem: Problem, superchains: int) -> bool:
    """Whether a warmup's draws have forgotten where they started, but for names that components exchange."""
    if forgotten(stored, problem.model, superchains):
        return True
    last = {**target_of(problem).known, **{n: v[:, -1] for n, v in stored.items()}}
    if last.keys() < problem.model.nodes.keys():
        return False
    named: Mapping[str, np.ndarray] = stored
    for symmetry in symmetries(problem, last):
        pivot = pivot_of(symmetry, problem.model)
        if pivot is not None and pivot in stored:
            named = ordered(problem, named, symmetry, pivot)
    return named is not stored and forgotten(named, problem.model, superchains)


def forgotten(stored: Mapping[str, np.ndarray], model: Model, superchains: int) -> bool:
    """Whether some draws of a warmup tell neither where chains started nor whether they are early or late.

    Parameters
    ----------
    stored : dict
        Node -> stored values, shape ``(chain, draw, *plates, *event)``.
    """
    columns = []
    nodes = [model[n] for n, v in stored.items() if v.size and v.shape[1] > 1]
    for name, index in some_scalars(nodes, model):
        at: tuple[Any, ...] = (slice(None), slice(None), *index)
        values = stored[name][at]
        if (values != values[0, 0]).any():
            columns.append(uncut(model[name], index, values))
    if not columns:
        return True
    chains, count = columns[0].shape
    every = min(-(-len(columns) * chains * count // _WINDOW), max(count // _FEW, 1))
    some = -(-len(columns) * chains * (count // every) // _WINDOW)
    looked = [column[:, ::every] for column in columns[::some]]
    # a state that is rare may differ in what is left out alone: nothing is known of it
    looked = [column for column in looked if (column != column[0, 0]).any()]
    if not looked:
        return True
    draws = np.stack(looked, axis=-1)
    half = draws.shape[1] // 2
    times = np.concatenate([draws[:, :half], draws[:, -half:]])  # the early ones as a superchain
    figures = diagnostics.chain_figures(draws, superchains=superchains)
    starts, ess = figures.rhat, figures.ess
    drift = diagnostics.chain_statistic("rhat", times, superchains=2)
    enough = (ess >= _ENOUGH) | (np.fmax(starts, drift) <= MAX_RHAT)
    agree = (starts <= by_chance(ess, superchains or 2 * chains)) & (drift <= by_chance(ess, 2))
    return bool((enough & agree).all())


def in_words(lengths: Lengths, problem: Problem) -> str:
    """What a run will do, for those who ask before."""
    many = f"{lengths.chains} chains"
    if lengths.superchains:
        many += f" from {lengths.superchains} starts"
    warm = f"{'' if lengths.judge is None else 'at most '}{lengths.warmup} sweeps of warmup"
    if lengths.ess is None:
        return f"{many}, {warm}, {lengths.draws} draws of each"
    return (
        f"{many} of some {size_of(problem)} numbers each, {warm}, then draws until the smallest effective "
        f"size is {lengths.ess:g}, at most {lengths.draws} of each chain, "
        f"or up to {lengths.most} if these will do"
    )


def size_of(problem: Problem) -> int:
    """Numbers that the terms of one chain's density are made of: what a sweep's arithmetic grows with."""
    size = 0
    for term in target_of(problem).terms.values():
        event = () if term.is_potential else problem.model[term.name].event_shape
        size += math.prod(term.shape) * max(math.prod(event), 1)
    return max(size, 1)


# ---- private ------------------------------------------------------------------------------------


def _superchains(chains: int) -> int:
    """How many equal groups there may be; 0 where chains are few, and long enough to be judged alone."""
    for count in range(_SUPERCHAINS, LEAST - 1, -1):
        if chains % count == 0 and chains // count >= _MEMBERS and chains >= 2 * _SUPERCHAINS:
            return count
    return 0
