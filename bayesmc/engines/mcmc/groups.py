"""Chains in groups: each group is a run of its own, with a seed of its own, and all are one posterior.

Chains are an array axis, so that many small ones cost hardly more than one, and there is nothing to share
out. Where a sweep is mostly arithmetic, groups cost nothing, and workers share them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from bayesmc.engines.base import in_file
from bayesmc.engines.mcmc.convergence import warn_of_ties
from bayesmc.engines.mcmc.length import LEAST, size_of
from bayesmc.errors import UnsupportedError
from bayesmc.network import Problem
from bayesmc.randomness import child
from bayesmc.results import (
    ChainsPosterior,
    ChainsSums,
    Checkpoint,
    Posterior,
    RunFile,
    RunningChains,
)
from bayesmc.results.run_files import UnitFile, remove_units, units_so_far
from bayesmc.storage import Lazy
from bayesmc.workers import completed

#: numbers of a group's chains from which on a sweep is mostly arithmetic
_NUMBERS = 1 << 15
#: bytes of draws that are copied at a time from the file of a group
_PIECE = 16 << 20
#: in a checkpoint's state: those of the groups, and of their random numbers
GROUPS, GENERATORS = "groups", "generators"

Chains = ChainsPosterior | ChainsSums


class _Group(NamedTuple):
    """What of a group is its own: where it starts, what it goes on with, where it saves itself."""

    number: int
    start: Any
    resume: Any
    file: UnitFile | None


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


def in_groups(
    engine: Any,
    problem: Problem,
    seed: np.random.SeedSequence,
    keep: Any,
    progress: bool | None,
    resume: Posterior | None,
    executor: Any,
    groups: int,
    file: RunFile | None = None,
) -> Chains:
    """The posterior of all chains, by groups that run apart; once all have ended it is in the run's file."""
    lengths = engine.lengths(problem, keep)
    if resume is not None:
        summed = isinstance(resume, ChainsSums)
        kept = resume._running.names if summed else tuple(resume._stored)  # type: ignore[attr-defined]
        names = kept if isinstance(keep, str) else tuple(keep)
        lengths = engine._refuse_another(resume, problem, names, summed, lengths)
    ready = replace(engine, warmup=lengths.warmup, chains=lengths.chains)
    tied = engine.tied(problem)
    if tied:
        warn_of_ties(type(engine).__name__, tied)
    before = 0 if resume is None else resume._chains_and_draws[1]  # type: ignore[attr-defined]
    draws = before + engine.draws
    member = replace(ready, chains=lengths.chains // groups, groups=1, start=None)
    units = _units(ready, problem, member, groups, resume, file)
    shared = {"engine": member, "problem": problem, "seed": seed, "keep": keep}
    parts = _run(shared, units, draws, executor, engine.label, progress)
    finished = len(parts) == groups and {p._chains_and_draws[1] for p in parts} == {draws}
    lazily = None
    if in_file(keep):
        if not finished:  # draws are in the files, which are gone on with by the same call
            raise KeyboardInterrupt
        lazily = _lazily(parts)
    posterior = joined(engine, problem, parts, lazily)
    if file is not None and finished:
        file.finish(posterior, lazily)
        remove_units(file.path, file.header["identity"])
    engine._warn(posterior, member.sampler(problem), finished, lengths, file is not None)
    if not finished:
        posterior.checkpoint = None
    return posterior


def groups_so_far(engine: Any, problem: Problem, file: RunFile) -> Chains | None:
    """The posterior of the draws that groups have saved, as many of each as all have; None without any."""
    parts: list[Chains] = units_so_far(file, problem)
    unlike = len({part._chains_and_draws for part in parts}) > 1
    if not parts or (unlike and isinstance(parts[0], ChainsSums)):
        return None
    found = joined(engine, problem, parts)
    found.checkpoint = None  # the run's own files go on with it
    return found


def joined(
    engine: Any, problem: Problem, parts: Sequence[Chains], lazily: Mapping[str, Any] | None = None
) -> Chains:
    """The chains of several runs as those of one; of unlike lengths what all have.

    ``lazily`` are draws that stay in files: arrays that take no room stand in their place.
    """
    one = parts[0]
    chains = sum(part._chains_and_draws[0] for part in parts)
    draws = min(part._chains_and_draws[1] for part in parts)
    acceptance = {n: np.concatenate([p.acceptance[n] for p in parts]) for n in one.acceptance}
    point = _joined_point([part.checkpoint for part in parts])
    found: Chains
    if isinstance(one, ChainsSums):
        running = RunningChains.joined([p._running for p in parts])  # type: ignore[union-attr]
        found = ChainsSums(problem, engine, running, acceptance, one.warmup, point)  # type: ignore[arg-type]
    else:
        if lazily is None:
            stored = {n: _chains_of([p._stored[n] for p in parts], draws) for n in one._stored}  # type: ignore[union-attr]
        else:
            stored = {n: _stand_in(v) for n, v in lazily.items()}
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


def _units(
    engine: Any,
    problem: Problem,
    member: Any,
    groups: int,
    resume: Posterior | None,
    file: RunFile | None,
) -> list[_Group]:
    """What of every group is its own."""
    earlier = _parts(resume, problem, member, groups)
    found = []
    for g in range(groups):
        start = _start_of(engine, problem, g, member.chains, engine.chains)
        own = None if file is None else UnitFile.belonging(file, g, groups, member)
        found.append(_Group(g, start, earlier[g], own))
    return found


def _run(
    shared: Mapping[str, Any],
    units: Sequence[_Group],
    draws: int,
    executor: Any,
    label: str,
    progress: bool | None,
) -> list[Chains]:
    """The groups' posteriors; only those that are there at Ctrl-C."""
    results = completed(
        _group_run, shared, units, executor, label=label, total=len(units), progress=progress
    )
    found: dict[int, Chains] = {}
    try:
        for number, part in results:
            saved = units[number].file
            if part is None and saved is not None:
                part = saved.answer(shared["problem"])
            found[number] = part
            if executor is None and part._chains_and_draws[1] < draws:
                break  # Ctrl-C was in this one
    except KeyboardInterrupt:
        if not found:
            raise
    return [found[g] for g in sorted(found)]


def _group_run(shared: Mapping[str, Any], unit: _Group) -> Chains | None:
    """One group, silent: all are judged together. None where its draws stay in its file."""
    engine = replace(shared["engine"], start=unit.start)
    object.__setattr__(engine, "silent", True)
    seed = child(shared["seed"], unit.number)
    problem, keep = shared["problem"], shared["keep"]
    found: Chains
    if unit.file is None:
        found = engine.run(problem, seed, keep, False, unit.resume)
        return found
    file, found = unit.file.begun(problem, in_file(keep))
    if file is not None:
        try:
            found = engine.run(problem, seed, keep, False, None, checkpoint=file)
        finally:
            file.close()
    return None if in_file(keep) else found


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


def _lazily(parts: Sequence[Chains]) -> dict[str, Any]:
    """Draws of all chains as arrays that are read piece by piece; what is the same for all as it is."""
    found: dict[str, Any] = {}
    draws = parts[0]._chains_and_draws[1]
    for name in parts[0]._stored:  # type: ignore[union-attr]
        arrays = [part._stored[name] for part in parts]  # type: ignore[union-attr]
        one = arrays[0]
        if one.shape[:2] == (1, 1) and all(np.array_equal(a, one) for a in arrays):
            found[name] = one
        else:
            shape = (sum(len(a) for a in arrays), draws, *one.shape[2:])
            found[name] = Lazy(shape, one.dtype, partial(_pieces, arrays))
    return found


def _pieces(arrays: Sequence[np.ndarray]) -> Iterator[tuple[Any, np.ndarray]]:
    first = 0
    for array in arrays:
        step = max(1, _PIECE // max(1, array[:, :1].nbytes))
        for at in range(0, array.shape[1], step):
            some = array[:, at : at + step]
            yield (slice(first, first + len(array)), slice(at, at + some.shape[1])), some
        first += len(array)


def _stand_in(value: Any) -> np.ndarray:
    if isinstance(value, Lazy):
        return np.broadcast_to(np.zeros((), value.dtype), value.shape)
    found: np.ndarray = value
    return found


def _joined_point(points: Sequence[Checkpoint | None]) -> Checkpoint | None:
    """Where all groups stand; None where some do not know."""
    known = [point for point in points if point is not None]
    if len(known) < len(points):
        return None
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
