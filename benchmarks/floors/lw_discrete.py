"""Likelihood weighting on a discrete network by hand-tuned NumPy: all marginals, one thread.

The recipe: chunks of 8,192 draws so that every buffer stays in cache; states as uint8 codes; tables
with the evidence already sliced in; the cumulative row of a draw gathered by a mixed-radix index of
its parents; a code is the number of cumulative values that its uniform has passed. Those
comparisons are kept as rows of one boolean matrix, whose product with the weights gives all
marginals at once (the weighted count of "code >= j" for every node and j).

Uniforms are 32-bit integers, two from each 64-bit draw of the generator, which costs half of
``Generator.random(dtype=float32)``; ``uniforms="float32"`` takes the latter.

It is tuned for speed alone: no checks, no names, no draws kept.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

CHUNK = 8192
_ROWS_AT_ONCE = 8  # of the boolean matrix, cast to float32: 256 KiB, within a core's L2 cache
_TOP = 2**32 - 1

Node = tuple[str, int, tuple[int, ...], np.ndarray]


@dataclass(frozen=True)
class Answer:
    """Marginals in the order of the nodes (evidence nodes: one-hot), ``log p(evidence)``, ESS."""

    marginals: list[np.ndarray]
    log_evidence: float
    ess: float


@dataclass(frozen=True)
class _Hidden:
    node: int
    index: tuple[tuple[int, int], ...]  # (parent, stride) of each parent that is not evidence
    configurations: int
    thresholds: np.ndarray  # (card - 1, configurations): the cumulative table, transposed
    row: int  # its first row in the boolean matrix
    has_children: bool
    has_ones: bool  # a cumulative value of 1 before the last state: that state is impossible


@dataclass(frozen=True)
class _Observed:
    index: tuple[tuple[int, int], ...]
    configurations: int
    log_likelihood: np.ndarray  # (configurations,)


def likelihood_weighting(
    nodes: Sequence[Node],
    evidence: Mapping[str, int],
    draws: int,
    seed: int,
    *,
    uniforms: str = "uint32",
) -> Answer:
    """Weight ``draws`` forward samples by the likelihood of the evidence.

    Parameters
    ----------
    nodes
        ``(name, card, parent indices, table)``, parents first; the table has shape
        ``(card(parent_1), ..., card(parent_n), card)``.
    evidence
        Node name to state index.
    draws, seed
        Number of draws; seed of the SFC64 generator.
    uniforms
        ``"uint32"`` or ``"float32"``.

    Raises
    ------
    ValueError
        Where every draw has weight zero.
    """
    rng = np.random.Generator(np.random.SFC64(seed))
    plan = _plan(nodes, evidence, uniforms)
    rows = sum(step.thresholds.shape[0] for step in plan if isinstance(step, _Hidden))
    hidden = sum(isinstance(step, _Hidden) for step in plan)
    passed = np.empty((rows, CHUNK), bool)
    fill = _uint32_filler(rng, hidden) if uniforms == "uint32" else _float32_filler(rng, hidden)
    log_weights = np.empty(CHUNK)
    run = _Chunk(plan, passed, {})
    shift, total, squares = -np.inf, 0.0, 0.0
    tails = np.zeros(rows)
    for start in range(0, draws, CHUNK):
        size = min(CHUNK, draws - start)
        logw = log_weights[:size]
        run(fill(), logw)
        top = logw.max()
        if top > shift:
            scale = float(np.exp(shift - top))
            shift, total, squares = top, total * scale, squares * scale**2
            tails *= scale
        if shift == -np.inf:
            continue
        weights = np.exp(np.subtract(logw, shift, out=logw), out=logw)
        total += float(weights.sum())
        squares += float(weights @ weights)
        _add_tails(tails, passed[:, :size], weights.astype(np.float32))
    if total == 0.0:
        raise ValueError("every draw has weight zero: likelihood weighting cannot do this evidence")
    return Answer(
        _marginals(nodes, evidence, plan, tails / total),
        float(shift + np.log(total / draws)),
        float(total**2 / squares),
    )


class _Chunk:
    """One chunk of draws: walks the plan with buffers that are allocated once."""

    def __init__(self, plan: list[_Hidden | _Observed], passed: np.ndarray, codes: dict) -> None:
        self.plan, self.passed, self.codes = plan, passed, codes
        self.small = np.empty(CHUNK, np.uint8), np.empty(CHUNK, np.uint8)
        self.wide = np.empty(CHUNK, np.uint16), np.empty(CHUNK, np.uint16)
        self.index = np.empty(CHUNK, np.intp)
        dtype = next(step.thresholds.dtype for step in plan if isinstance(step, _Hidden))
        self.gathered = np.empty(CHUNK, dtype)
        self.log_likelihood = np.empty(CHUNK)
        for step in plan:
            if isinstance(step, _Hidden):
                binary = step.thresholds.shape[0] == 1
                row = passed[step.row].view(np.uint8)
                codes[step.node] = row if binary else np.empty(CHUNK, np.uint8)

    def __call__(self, uniforms: np.ndarray, log_weights: np.ndarray) -> None:
        size = log_weights.size
        log_weights.fill(0.0)
        k = 0
        for step in self.plan:
            index = self._index(step, size) if step.index else None
            if isinstance(step, _Observed):
                if index is None:
                    log_weights += step.log_likelihood[0]
                else:
                    out = self.log_likelihood[:size]
                    step.log_likelihood.take(index, out=out, mode="clip")
                    log_weights += out
                continue
            self._sample(step, index, uniforms[k, :size])
            k += 1

    def _index(self, step: _Hidden | _Observed, size: int) -> np.ndarray:
        (first, stride), *others = step.index
        if not others and stride == 1:
            code = self.codes[first][:size]
        else:
            code, term = self.small if step.configurations <= 256 else self.wide
            code, term = code[:size], term[:size]
            np.multiply(self.codes[first][:size], code.dtype.type(stride), out=code)
            for parent, stride in others:
                if stride == 1:
                    np.add(code, self.codes[parent][:size], out=code)
                else:
                    scale = code.dtype.type(stride)
                    np.add(code, np.multiply(self.codes[parent][:size], scale, out=term), out=code)
        index = self.index[:size]
        np.copyto(index, code)  # once, where take would cast for every threshold
        return index

    def _sample(self, step: _Hidden, index: np.ndarray | None, uniforms: np.ndarray) -> None:
        size = uniforms.size
        if step.has_ones and uniforms.dtype == np.uint32:
            # A threshold of 2**32 - 1 stands for 1 and must never be passed.
            np.minimum(uniforms, np.uint32(_TOP - 1), out=uniforms)
        for j, column in enumerate(step.thresholds):
            if index is None:
                bound = column[0]
            else:
                bound = column.take(index, out=self.gathered[:size], mode="clip")
            np.greater_equal(uniforms, bound, out=self.passed[step.row + j, :size])
        if step.has_children and len(step.thresholds) > 1:
            code, rows = self.codes[step.node][:size], self.passed.view(np.uint8)
            np.add(rows[step.row, :size], rows[step.row + 1, :size], out=code)
            for j in range(2, len(step.thresholds)):
                np.add(code, rows[step.row + j, :size], out=code)


def _plan(
    nodes: Sequence[Node], evidence: Mapping[str, int], uniforms: str
) -> list[_Hidden | _Observed]:
    """The steps in order, with the evidence sliced out of every table."""
    seen = {i: evidence[name] for i, (name, *_) in enumerate(nodes) if name in evidence}
    used = {p for _, _, parents, _ in nodes for p in parents}
    plan: list[_Hidden | _Observed] = []
    row = 0
    for i, (_, card, parents, table) in enumerate(nodes):
        table = table[tuple(seen.get(p, slice(None)) for p in parents)]
        free = [p for p in parents if p not in seen]
        index = tuple((p, math.prod(table.shape[k + 1 : -1])) for k, p in enumerate(free))
        table = table.reshape(-1, card)
        if i in seen:
            with np.errstate(divide="ignore"):
                plan.append(_Observed(index, len(table), np.log(table[:, seen[i]])))
            continue
        cumulative = np.cumsum(table, axis=1)[:, :-1].T
        # Rounding in the sum must not leave a state of probability zero within reach.
        cumulative = np.where(cumulative > 1.0 - 1e-12, 1.0, cumulative)
        ones = bool((cumulative == 1.0).any())
        thresholds = _thresholds(cumulative, uniforms)
        plan.append(_Hidden(i, index, len(table), thresholds, row, i in used, ones))
        row += card - 1
    return plan


def _thresholds(cumulative: np.ndarray, uniforms: str) -> np.ndarray:
    if uniforms == "float32":
        return np.ascontiguousarray(cumulative, np.float32)
    return np.ascontiguousarray(np.rint(cumulative * _TOP), np.uint32)


def _uint32_filler(rng: np.random.Generator, hidden: int) -> Callable[[], np.ndarray]:
    shape = hidden, CHUNK // 2
    return lambda: rng.integers(0, 2**64, shape, dtype=np.uint64).view(np.uint32)


def _float32_filler(rng: np.random.Generator, hidden: int) -> Callable[[], np.ndarray]:
    buffer = np.empty((hidden, CHUNK), np.float32)
    return lambda: rng.random(out=buffer, dtype=np.float32)


def _add_tails(tails: np.ndarray, passed: np.ndarray, weights: np.ndarray) -> None:
    # float32 sums over one chunk err by about 1e-6 of the total, far below the Monte Carlo error.
    block = np.empty((_ROWS_AT_ONCE, weights.size), np.float32)
    for start in range(0, len(passed), _ROWS_AT_ONCE):
        rows = passed[start : start + _ROWS_AT_ONCE]
        part = block[: len(rows)]
        np.copyto(part, rows)
        tails[start : start + len(rows)] += part @ weights


def _marginals(
    nodes: Sequence[Node],
    evidence: Mapping[str, int],
    plan: list[_Hidden | _Observed],
    tails: np.ndarray,
) -> list[np.ndarray]:
    marginals = [np.eye(card)[evidence.get(name, 0)] for name, card, _, _ in nodes]
    for step in plan:
        if isinstance(step, _Hidden):
            own = tails[step.row : step.row + len(step.thresholds)]
            probs = np.maximum(-np.diff(own, prepend=1.0, append=0.0), 0.0)
            marginals[step.node] = probs / probs.sum()
    return marginals
