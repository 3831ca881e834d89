"""Chains in groups: each group is a run of its own, with a seed of its own, and all are one posterior.

Chains are an array axis, so that many small ones cost hardly more than one, and there is nothing to share
out. Where a sweep is mostly arithmetic, groups cost nothing, and workers share them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bayesmc.engines.mcmc.length import LEAST, size_of
from bayesmc.errors import UnsupportedError
from bayesmc.network import Problem
from bayesmc.randomness import child
from bayesmc.results import ChainsPosterior, ChainsSums, Checkpoint, Posterior, RunningChains
from bayesmc.workers import completed

#: numbers of a group's chains from which on a sweep is mostly arithmetic
_NUMBERS = 1 << 15
#: in a checkpoint's state: those of the groups, and of their random numbers
GROUPS, GENERATORS = "groups", "generators"

Chains = ChainsPosterior | ChainsSums


def check_groups(engine: Any) -> None:
    """Refuse groups that chains cannot be cut into.

    Raises
    ------
    ValueError
    """
    name, groups = type(engine).__name__, engine.groups
    if groups is None:
        return
    whole = isinstance(groups, (int, np.integer)) and not isinstance(groups, bool)
    if not whole or groups < 1:
        raise ValueError(f"{name}(groups={groups!r}): groups is a whole number, 1 or more, or None")
    if groups > 1 and engine.draws is None:
        raise ValueError(
            f"{name}(groups={groups}): groups run apart, each to the same number of draws; say draws="
        )
    chains = LEAST if engine.chains is None else engine.chains
    if chains % groups:
        raise ValueError(
            f"{name}(groups={groups}): {chains} chains do not make {groups} equal groups; choose numbers "
            "that divide"
        )


def groups_of(engine: Any, problem: Problem) -> int:
    """Into how many groups the chains of a run are cut: by what is asked, never by who works."""
    if engine.groups is not None:
        return int(engine.groups)
    chains = LEAST if engine.chains is None else engine.chains
    if engine.draws is None or engine.ensembles or chains < 2 * LEAST:
        return 1
    most = min(chains // LEAST, chains * size_of(problem) // _NUMBERS)
    return max((n for n in range(1, most + 1) if chains % n == 0), default=1)


def run_groups(
    engine: Any,
    problem: Problem,
    seed: np.random.SeedSequence,
    keep: Any,
    progress: bool | None,
    resume: Posterior | None,
    executor: Any,
    groups: int,
) -> tuple[Chains, bool]:
    """The posterior of all groups, and whether all of them came to their end."""
    chains = LEAST if engine.chains is None else engine.chains
    own = chains // groups
    member = replace(engine, chains=own, groups=1, start=None)
    earlier = _parts(resume, problem, member, groups)
    units = [(g, _start_of(engine, problem, g, own, chains), earlier[g]) for g in range(groups)]
    shared = {"engine": member, "problem": problem, "seed": seed, "keep": keep}
    before = 0 if resume is None else resume._chains_and_draws[1]  # type: ignore[attr-defined]
    results = completed(
        _group_run, shared, units, executor, label=engine.label, total=groups, progress=progress
    )
    found: dict[int, Chains] = {}
    try:
        for number, part in results:
            found[number] = part
            if executor is None and part._chains_and_draws[1] < before + engine.draws:
                break  # Ctrl-C was in this one
    except KeyboardInterrupt:
        if not found:
            raise
    parts = [found[g] for g in sorted(found)]
    draws = {part._chains_and_draws[1] for part in parts}
    whole = len(parts) == groups and draws == {before + engine.draws}
    return joined(engine, problem, parts), whole


def joined(engine: Any, problem: Problem, parts: Sequence[Chains]) -> Chains:
    """The chains of several runs as those of one; of unlike lengths what all have."""
    one = parts[0]
    chains = sum(part._chains_and_draws[0] for part in parts)
    draws = min(part._chains_and_draws[1] for part in parts)
    acceptance = {n: np.concatenate([p.acceptance[n] for p in parts]) for n in one.acceptance}
    point = _joined_point([part.checkpoint for part in parts])
    found: Chains
    if isinstance(one, ChainsSums):
        running = RunningChains.joined([p._running for p in parts])  # type: ignore[union-attr]
        found = ChainsSums(problem, engine, running, acceptance, one.warmup, point)
    else:
        stored = {n: _chains_of([p._stored[n] for p in parts], draws) for n in one._stored}  # type: ignore[union-attr]
        shape = (chains, draws)
        found = ChainsPosterior(
            problem, engine, stored, shape, acceptance, one.ensemble_size, one.warmup, point
        )
        for what in ("divergences", "energies"):
            rows = [getattr(part, what) for part in parts]
            if all(row is not None for row in rows):
                setattr(found, what, np.concatenate([row[:, :draws] for row in rows]))
    found.renewals = {n: sum(p.renewals[n] for p in parts) for n in one.renewals}  # type: ignore[misc]
    return found


def state_of(state: Mapping[str, Any]) -> Mapping[str, Any]:
    """A sampler's state in a checkpoint; of groups what their kernels remember, of all chains together."""
    if GROUPS not in state:
        return state
    each = [own["memory"] for own in state[GROUPS] if "memory" in own]
    return {"memory": [_beside(memories) for memories in zip(*each, strict=True)]}


# ---- private ------------------------------------------------------------------------------------


def _group_run(shared: Mapping[str, Any], unit: tuple[int, Any, Any]) -> Chains:
    """One group, silent: all are judged together."""
    number, start, resume = unit
    engine = replace(shared["engine"], start=start)
    object.__setattr__(engine, "silent", True)
    seed = child(shared["seed"], number)
    found: Chains = engine.run(shared["problem"], seed, shared["keep"], False, resume)
    return found


def _start_of(
    engine: Any, problem: Problem, group: int, own: int, chains: int
) -> dict[str, Any] | None:
    """Where the user wants a group's chains to start."""
    if not engine.start:
        return None
    rows = slice(group * own, (group + 1) * own)
    found = {}
    for name, value in engine.start.items():
        node = problem.model.nodes.get(name)
        each = node is not None and np.shape(value) == (chains, *node.value_shape)
        found[name] = value[rows] if each else value
    return found


def _parts(resume: Any, problem: Problem, member: Any, groups: int) -> list[Any]:
    """An earlier posterior group by group."""
    if resume is None:
        return [None] * groups
    point = resume.checkpoint
    if isinstance(resume, ChainsSums) or point is None or GROUPS not in point.state:
        raise UnsupportedError(
            f"infer: resume= goes on with the draws of {groups} groups where all of them came to their end; "
            'sums, and runs that were stopped, cannot be: keep="draws", or groups=1'
        )
    chains, draws = resume._shape
    own = chains // groups
    found = []
    for g in range(groups):
        rows = slice(g * own, (g + 1) * own)
        at = {n: _rows(problem, n, v, rows) for n, v in point.values.items()}
        state, generator = point.state[GROUPS][g], point.state[GENERATORS][g]
        stored = {n: v[rows] if v.shape[0] == chains else v for n, v in resume._stored.items()}
        acceptance = {n: v[rows] for n, v in resume.acceptance.items()}
        before = Checkpoint(state, generator, at, point.observed)
        part = ChainsPosterior(
            problem,
            member,
            stored,
            (own, draws),
            acceptance,
            resume.ensemble_size,
            resume.warmup,
            before,
        )
        for what in ("divergences", "energies"):
            if getattr(resume, what) is not None:
                setattr(part, what, getattr(resume, what)[rows])
        found.append(part)
    return found


def _rows(problem: Problem, name: str, value: np.ndarray, rows: slice) -> np.ndarray:
    varies = value.ndim > len(problem.model[name].value_shape)
    return value[rows] if varies else value


def _joined_point(points: Sequence[Checkpoint | None]) -> Checkpoint:
    """Where all groups stand."""
    known = [point for point in points if point is not None]
    values: dict[str, Any] = {}
    for name, one in known[0].values.items():
        all_ = [point.values[name] for point in known]
        same = all(v.shape == one.shape and np.array_equal(v, one) for v in all_)
        values[name] = one if same else np.concatenate(all_)
    state = {
        GROUPS: tuple(point.state for point in known),
        GENERATORS: tuple(point.generator for point in known),
    }
    return Checkpoint(state, known[0].generator, values, known[0].observed)


def _chains_of(arrays: Sequence[np.ndarray], draws: int) -> np.ndarray:
    """Draws of one node in all chains; what is the same for all has one draw."""
    one = arrays[0]
    if one.shape[:2] == (1, 1) and all(np.array_equal(a, one) for a in arrays):
        return one
    found = np.concatenate([a[:, :draws] for a in arrays])
    found.flags.writeable = False
    return found


def _beside(memories: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Arrays of all chains, one after the other; what is no array is that of the first group."""
    found = dict(memories[0])
    for name, one in found.items():
        if isinstance(one, np.ndarray) and one.ndim:
            found[name] = np.concatenate([memory[name] for memory in memories])
        elif isinstance(one, Mapping):
            found[name] = _beside([memory[name] for memory in memories])
    return found
