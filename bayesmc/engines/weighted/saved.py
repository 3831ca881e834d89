"""Runs of weighted draws that are saved chunk by chunk, and draws that stay in the file.

Every chunk has a random stream of its own, so that all there is to know of a run is how many were made.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from bayesmc import diagnostics
from bayesmc.network import Problem
from bayesmc.results import DrawsPosterior, Posterior, RunFile, Sums, SumsPosterior
from bayesmc.results.running import Tail
from bayesmc.storage import Lazy

#: bytes of draws that are held before they go into the file, where they are kept there
_HELD = 16 << 20


class SpilledDraws(DrawsPosterior):
    """Draws in a file, which are read where they are looked at."""

    #: Pareto k of the largest weights, which were gathered as they came
    tail_pareto_k: float | None = None

    @property
    def pareto_k(self) -> float | None:  # type: ignore[override]
        """Tail shape of the weights; None where uniform."""
        return self.tail_pareto_k


class WeightTail:
    """Sums of weights and of their squares, in units of the largest, and what tells their tail."""

    def __init__(self) -> None:
        self.top, self.weight, self.tail = -np.inf, np.zeros(2), Tail()

    def add(self, log: np.ndarray) -> None:
        """Take in log weights."""
        highest = float(log.max(initial=-np.inf))
        if highest > self.top:
            if self.top > -np.inf:
                self.weight *= np.exp(np.array([1.0, 2.0]) * (self.top - highest))
            self.top = highest
        if self.top > -np.inf:
            scaled = np.exp(log - self.top)
            self.weight += scaled.sum(), scaled @ scaled
        self.tail.add(log, len(log))

    @property
    def pareto_k(self) -> float:
        """Shape of the tail."""
        found = self.tail.values()
        return diagnostics.pareto_k(found[np.isfinite(found)], self.tail.draws)


class SavedDraws:
    """Saves one run.

    Parameters
    ----------
    saver : RunFile
    problem : Problem
    names : sequence of str
        Nodes whose draws are kept.
    spilled : bool
        Draws are kept in the file alone.
    """

    def __init__(
        self, saver: RunFile, problem: Problem, names: Sequence[str], spilled: bool
    ) -> None:
        self.saver, self.problem, self.names, self.spilled = saver, problem, names, spilled
        saved = saver.state
        #: chunks that were made, and draws
        self.chunks: int = 0 if saved is None else saved["chunks"]
        self.count: int = 0 if saved is None else saved["draws"]
        self._waiting: list[tuple[dict[str, np.ndarray], np.ndarray, int]] = []
        self._size = 0

    @property
    def state(self) -> Mapping[str, Any] | None:
        """What was saved last."""
        return self.saver.state

    def drawn(self, chunk: tuple[Mapping[str, np.ndarray], Any, int]) -> None:
        """Take in a chunk of draws (values, log weights, count), and save those that wait if it is time."""
        drawn, log_weight, count = chunk
        values = {n: drawn[n] for n in self.names}
        logs = np.broadcast_to(np.asarray(log_weight, dtype=float), (count,))
        self._waiting.append((values, logs, count))
        self._size += sum(v.nbytes for v in values.values()) + logs.nbytes
        self.chunks += 1
        self.count += count
        if self.saver.due() or (self.spilled and self._size >= _HELD):
            self.flush()

    def passed(self, sums: Sums, chunks: int) -> None:
        """Save the sums after some more chunks if it is time."""
        self.chunks += chunks
        self.count = sums.draws
        if self.saver.due():
            self.saver.save(None, self._state(sums.without_model()))

    def flush(self) -> None:
        """Save the draws that wait."""
        if not self._waiting:
            return
        count = sum(c for _, _, c in self._waiting)
        sizes = [c for _, _, c in self._waiting]
        rows: dict[str, Any] = {"draws": count, "sizes": sizes, "moving": {}, "still": {}}
        for name in self.names:
            parts = [values[name] for values, _, _ in self._waiting]
            still = parts[0].ndim == len(self.problem.model[name].value_shape)
            rows["still" if still else "moving"][name] = (
                parts[0] if still else np.concatenate(parts)
            )
        rows["log_weights"] = np.concatenate([logs for _, logs, _ in self._waiting])
        self.saver.save(rows, self._state(None))
        self._waiting, self._size = [], 0

    # ---- going on ------------------------------------------------------------------------------

    def earlier(self) -> Iterator[tuple[dict[str, np.ndarray], np.ndarray, int]]:
        """Values, log weights and number of the draws of every block."""
        for rows in self.saver.rows():
            yield {**rows["still"], **rows["moving"]}, rows["log_weights"], rows["draws"]

    def sums(self) -> Sums:
        """What was summed."""
        assert self.saver.state is not None
        found: Sums = self.saver.state["sums"]
        found.model = self.problem.model
        return found

    def stored(self) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """All draws that were saved, with axes for chains and draws, and their log weights."""
        every = list(self.earlier())
        first = next(self.saver.rows())
        found = {n: v[None, None] for n, v in first["still"].items()}
        for name in first["moving"]:
            found[name] = np.concatenate([values[name] for values, _, _ in every])[None]
        return found, np.concatenate([logs for _, logs, _ in every])[None]

    # ---- draws that stay in the file -----------------------------------------------------------

    def tail(self) -> WeightTail:
        """What is to be known of the weights."""
        found = WeightTail()
        for piece in self._log_weights():
            found.add(piece)
        return found

    def _log_weights(self) -> Iterator[np.ndarray]:
        """Chunk by chunk, so that no sum of them depends on when they were saved."""
        for rows in self.saver.rows():
            yield from np.split(rows["log_weights"], np.cumsum(rows["sizes"])[:-1])

    def lazily(self, draws: int, weighted: bool, top: float) -> dict[str, Any]:
        """The draws, as arrays that are read block by block; constants as they are."""
        first = next(self.saver.rows())
        found: dict[str, Any] = {n: v[None, None] for n, v in first["still"].items()}
        for name, part in first["moving"].items():
            shape = (1, draws, *part.shape[1:])
            found[name] = Lazy(shape, part.dtype, partial(self._pieces, "moving", name))
        if weighted:
            kind = np.dtype(float)
            found["log_weights"] = Lazy((1, draws), kind, partial(self._pieces, "log_weights"))
            found["weights"] = Lazy((1, draws), kind, partial(self._weights, top))
        return found

    def posterior(
        self, engine: Any, tail: WeightTail, weighted: bool, streams: int
    ) -> tuple[SpilledDraws, dict[str, Any]]:
        """The posterior of draws in the file, and these."""
        lazily = self.lazily(engine.draws, weighted, tail.top)
        stand_ins = self.stand_ins(lazily)
        log_weights, weights = stand_ins.pop("log_weights", None), stand_ins.pop("weights", None)
        found = SpilledDraws(
            self.problem, engine, stand_ins, (1, engine.draws), independent=True, streams=streams
        )
        found.log_weights, found.weights = log_weights, weights
        if weighted:
            found.weight_ess = float(tail.weight[0] ** 2 / tail.weight[1])
            found.tail_pareto_k = tail.pareto_k
        return found, lazily

    @staticmethod
    def stand_ins(lazily: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """Arrays of the same shapes that take no room."""
        return {
            n: np.broadcast_to(np.zeros((), a.dtype), a.shape) if isinstance(a, Lazy) else a
            for n, a in lazily.items()
        }

    # ---- private -------------------------------------------------------------------------------

    def _state(self, sums: Any) -> dict[str, Any]:
        return {"chunks": self.chunks, "draws": self.count, "sums": sums}

    def _pieces(self, kind: str, name: str | None = None) -> Iterator[tuple[Any, np.ndarray]]:
        at = 0
        for rows in self.saver.rows():
            found = rows[kind] if name is None else rows[kind][name]
            yield (0, slice(at, at + rows["draws"])), found
            at += rows["draws"]

    def _weights(self, top: float) -> Iterator[tuple[Any, np.ndarray]]:
        """Weights that sum to one."""
        total = sum(float(np.exp(piece - top).sum()) for piece in self._log_weights())
        for at, piece in self._pieces("log_weights"):
            yield at, np.exp(piece - top) / total


def drawn_so_far(engine: Any, problem: Problem, file: RunFile) -> Posterior | None:
    """What a run has come to that has not ended; None where that is nothing."""
    saving = SavedDraws(file, problem, (), False)
    if not saving.count or saving.state is None:
        return None
    weighted = engine.is_weighted(problem)
    if saving.state["sums"] is not None:
        return SumsPosterior(problem, engine, saving.sums(), weighted)
    stored, log_weights = saving.stored()
    given = log_weights if weighted else None
    return DrawsPosterior(problem, engine, stored, log_weights.shape, given, independent=True)
