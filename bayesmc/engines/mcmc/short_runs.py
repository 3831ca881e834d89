"""Starts that short runs found: of several for each chain, the one that got to where the data are likeliest.

Labels of data cling to the numbers of their components. Where priors are vague, a component that starts far
from all data is left without any, follows its prior from then on, and comes back once in hundreds of sweeps:
chains with an empty component stay in a mode that may weigh nothing. So a few starts of each chain run for
some sweeps, half of them as they are drawn, and half with the numbers moved to where the drawn labels ask
for them before any label moves, so that no component is empty. Runs are cheap beside one another, as rows of
the same arrays. The density of the data alone is compared, without that of the labels, which is highest where
all are the same: a chain that has too many components in use leaves some soon.

References
----------
Gelman and Rubin (1992), Statistical Science 7 (starts from where the modes are); Biernacki, Celeux and
Govaert (2003), Computational Statistics and Data Analysis 41 (short runs before the long one, for EM).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from bayesmc.engines.mcmc.climbing import data_logs
from bayesmc.kernels.base import Kernel
from bayesmc.structure.target import Target, Values

#: starts for each chain, rows of all of them, and numbers of all rows, at most
_TRIED, _ROWS, _NUMBERS = 4, 64, 1_000_000
#: sweeps of a run, and those before labels move
_SWEEPS, _BEFORE = 30, 5
#: labels from which on numbers are held by them
_LABELS = 20

#: ``draw(rows)``: stored values of all nodes, one start in each row
Draw = Callable[[int], Values]


def has_labels(target: Target) -> bool:
    """Whether a chain moves numbers, and many finite nodes beside them."""
    nodes = [target.model[n] for n in target.chain]
    labels = sum(math.prod(n.value_shape) for n in nodes if n.domain is not None)
    return labels >= _LABELS and any(n.domain is None for n in nodes)


def by_short_runs(
    target: Target,
    kernels: Sequence[Kernel],
    draw: Draw,
    starts: int,
    rng: np.random.Generator,
) -> Values:
    """One start for each chain: where the best of its runs ended.

    Parameters
    ----------
    target : Target
    kernels : sequence of Kernel
    draw : callable
    starts : int
    rng : Generator

    Returns
    -------
    dict
        As ``draw(starts)``, which it is where there is no room for more, or where runs fail.
    """
    numbers_of = sum(math.prod(target.model[n].value_shape) for n in target.chain)
    tried = min(_TRIED, _ROWS // starts, _NUMBERS // (starts * numbers_of)) // 2
    if not tried or not kernels:
        return draw(starts)
    moving = (*target.chain, *target.links)
    finite = {n for n in target.chain if target.model[n].domain is not None}
    numbers = [k for k in kernels if not finite.intersection(k.names)]
    found, logs = [], []
    for before in (0, _BEFORE):
        values = draw(starts * tried)
        first = dict(values)
        try:
            _run(target, numbers, values, before, rng)
            _run(target, kernels, values, _SWEEPS - before, rng)
            log = data_logs(target, values, starts * tried)
        except Exception:  # also of somebody's own kernel: the run itself will say what is wrong
            return {**first, **{n: first[n][:starts] for n in moving}}
        found.append({n: values[n].reshape(tried, starts, *values[n].shape[1:]) for n in moving})
        logs.append(np.where(np.isnan(log), -np.inf, log).reshape(tried, starts))
    together = np.concatenate(logs)
    if not (together > -np.inf).any(axis=0).all():
        return draw(starts)
    best = together.argmax(axis=0), np.arange(starts)
    return {**values, **{n: np.concatenate([f[n] for f in found])[best] for n in moving}}


# ---- private ------------------------------------------------------------------------------------


def _run(
    target: Target,
    kernels: Sequence[Kernel],
    values: Values,
    sweeps: int,
    rng: np.random.Generator,
) -> None:
    """Some sweeps of a warmup; ``values`` are changed in place."""
    if not sweeps or not kernels:
        return
    rows = len(values[target.chain[0]])
    memory = [kernel.start(values, rows) for kernel in kernels]
    for _ in range(sweeps):
        for i, kernel in enumerate(kernels):
            new, memory[i] = kernel.step(values, memory[i], rng, True)
            values.update(new)
            target.refresh(values, kernel.names)
