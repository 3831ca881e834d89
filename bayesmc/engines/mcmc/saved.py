"""Runs of chains that are saved as they go on, so that another process can go on with them.

What is saved is all that a sweep depends on: the sampler's state, that of the random numbers, and the number
of sweeps; so a run that was stopped at any draw ends with the same bits. Draws go into blocks, once each.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from bayesmc.engines.mcmc.loop import Begun, Kept, Loop, Point, State
from bayesmc.network import Problem
from bayesmc.results import ChainsPosterior, ChainsSums, Checkpoint, RunningChains
from bayesmc.storage import Lazy, Saver

#: numbers of draws that are held before they go into the file, where they are kept there
_HELD = 1 << 21


class SavedChains:
    """Saves one run (``loop.Saving``).

    Parameters
    ----------
    saver : Saver
    problem : Problem
    names : sequence of str
        Nodes whose draws are kept.
    spilled : bool
        Draws are kept in the file alone.
    """

    def __init__(
        self, saver: Saver, problem: Problem, names: Sequence[str], spilled: bool = False
    ) -> None:
        self.saver, self.problem, self.names, self.spilled = saver, problem, names, spilled
        #: draws that are saved
        self.draws = 0

    @property
    def is_due(self) -> bool:
        return self.saver.due()

    @property
    def state(self) -> Mapping[str, Any] | None:
        """What was saved last."""
        return self.saver.state

    def wants(self, held: Kept | RunningChains) -> bool:
        return self.saver.due() or (self.spilled and isinstance(held, Kept) and held.is_full)

    # ---- saving --------------------------------------------------------------------------------

    def save_warmup(self, loop: Loop, state: State, window: Kept | None) -> None:
        found = None if window is None else {**window.since(0), "draws": window.draws}
        saved = {"warming": True, "state": state, "generator": loop.rng.bit_generator.state}
        self.saver.save(None, {**saved, "sweep": loop.sweep, "window": found})

    def save(self, loop: Loop, point: Point, held: Kept | RunningChains) -> None:
        state, generator, values = point
        own = {n: v for n, v in values.items() if v is not loop.known.get(n)}
        saved = {
            "warming": False,
            "state": state,
            "generator": generator,
            "values": own,
            "sweep": loop.sweep,
            "warmup": loop.warmup,
            "draws": held.draws,
            "round": loop.round,
            "acceptance": dict(loop.sampler.acceptance(state)),
            "ensemble": getattr(loop.sampler, "ensemble", 1),
            "superchains": loop.lengths.superchains,
            "chains": loop.lengths.chains,
        }
        if isinstance(held, RunningChains):
            self.saver.save(None, {**saved, "sums": held.without_model()})
            return
        if held.draws == self.draws:
            return
        rows = held.since(self.draws)
        if loop.diverged:
            rows["diverged"] = np.stack(loop.diverged[self.draws + (self.draws > 0) :])
        if loop.energies:
            rows["energies"] = np.stack(loop.energies[self.draws :])
        self.saver.save({**rows, "draws": held.draws - self.draws}, saved)
        self.draws = held.draws
        if self.spilled:
            held.drop()

    # ---- going on ------------------------------------------------------------------------------

    def begin(self, loop: Loop) -> Begun | None:
        saved = self.saver.state
        if saved is None:
            return None
        loop.rng.bit_generator.state = saved["generator"]
        loop.sweep = saved["sweep"]
        if saved["warming"]:
            return Begun(saved["state"], True, self._window(loop, saved["window"]))
        loop.warmup, loop.round = saved["warmup"], saved["round"]
        values = {**loop.known, **saved["values"]}
        loop.last = Checkpoint(saved["state"], saved["generator"], values, loop.observed)
        counts = [r["diverged"] for r in self.saver.rows() if "diverged" in r]
        loop.diverged = list(np.concatenate(counts)) if counts else []
        energies = [r["energies"] for r in self.saver.rows() if "energies" in r]
        loop.energies = list(np.concatenate(energies)) if energies else []
        return Begun(saved["state"], False, None)

    def held(self, chains: int, first: int) -> Kept:
        """Where draws go, with those that were saved in it.

        Parameters
        ----------
        first : int
            Draws of the first round.
        """
        saved = self.saver.state
        made = 0 if saved is None or saved["warming"] else saved["draws"]
        self.draws = made
        total = first if not made else saved["round"]
        if self.spilled:
            kept = Kept(self.problem.model, self.names, chains, min(self._buffer(chains), total))
            kept.draws = kept.gone = made
            return kept
        kept = Kept(self.problem.model, self.names, chains, total - made)
        if made:
            kept.begin_with(stored_of(self.saver), made)
        return kept

    def stand_ins(self, chains: int, draws: int) -> dict[str, np.ndarray]:
        """Arrays of the draws' shapes that take no room."""
        return {
            n: np.broadcast_to(np.zeros((), lazy.dtype), lazy.shape)
            if isinstance(lazy, Lazy)
            else lazy
            for n, lazy in self.lazily(chains, draws).items()
        }

    def lazily(self, chains: int, draws: int) -> dict[str, Any]:
        """The draws in the file, as arrays that are read block by block; constants as they are."""
        found: dict[str, Any] = {}
        rows = next(self.saver.rows())
        for name, part in _apart(rows).items():
            if part.shape[1:2] == (rows["draws"],) and name not in rows["still"]:
                shape = (chains, draws, *part.shape[2:])
                found[name] = Lazy(shape, part.dtype, partial(self._pieces, name))
            else:
                found[name] = part
        return found

    # ---- private -------------------------------------------------------------------------------

    def _pieces(self, name: str) -> Any:
        at = 0
        for rows in self.saver.rows():
            yield (slice(None), slice(at, at + rows["draws"])), _apart(rows)[name]
            at += rows["draws"]

    def _buffer(self, chains: int) -> int:
        """Draws that are held before they go into the file."""
        sizes = (math.prod(self.problem.model[n].value_shape) for n in self.names)
        return max(1, _HELD // max(1, chains * sum(sizes)))

    def _window(self, loop: Loop, saved: Any) -> Kept | None:
        if saved is None:
            return None
        end = next(e for e in loop.lengths.ends() if e >= loop.sweep)
        stored = _apart(saved)
        room = end - end // 2 - saved["draws"]
        window = Kept(loop.model, tuple(stored), loop.lengths.chains, room)
        window.begin_with(stored, saved["draws"])
        return window


def answer_so_far(
    engine: Any, problem: Problem, saver: Saver
) -> ChainsPosterior | ChainsSums | None:
    """The posterior of the draws that were saved; None where there are none."""
    saved = saver.state
    if saved is None or saved["warming"]:
        return None
    known = {
        **problem.inputs,
        **{n: o.value for n, o in problem.observed.items() if o.mask is None},
    }
    values = {**known, **saved["values"]}
    point = Checkpoint(saved["state"], saved["generator"], values, problem.observed, {})
    found: ChainsPosterior | ChainsSums
    if "sums" in saved:
        sums = saved["sums"].with_model(problem.model)
        found = ChainsSums(problem, engine, sums, saved["acceptance"], saved["warmup"], point)
    else:
        shape = saved["chains"], saved["draws"]
        found = ChainsPosterior(
            problem, engine, stored_of(saver), shape, saved["acceptance"], saved["ensemble"],
            saved["warmup"],
        )  # fmt: skip
        found.superchains = saved["superchains"]
    found.checkpoint = None  # the run's own file goes on with it
    return found


def stored_of(saver: Saver) -> dict[str, np.ndarray]:
    """All draws that were saved: node -> stored values, shape ``(chain, draw, *plates, *event)``."""
    pieces: dict[str, list[np.ndarray]] = {}
    for rows in saver.rows():
        for name, part in _apart(rows).items():
            if name in rows["still"]:
                pieces[name] = [part]
            else:
                pieces.setdefault(name, []).append(part)
    return {n: p[0] if len(p) == 1 else np.concatenate(p, axis=1) for n, p in pieces.items()}


# ---- private ------------------------------------------------------------------------------------


def _apart(rows: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """The draws of a block, node by node."""
    found = {**rows["still"], **rows["moving"]}
    for names, arrays in rows["together"]:
        found.update(zip(names, arrays, strict=True))
    return found
