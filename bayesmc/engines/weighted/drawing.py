"""What engines that weight independent draws share: the loop over chunks, what is kept, and its error.

Chunks are small enough for their arrays to stay in cache, and each draws from its own random stream. An
engine supplies the steps of a pass; how a step samples or weighs is not known here.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from bayesmc import diagnostics
from bayesmc.categorical import log_sum_exp
from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.base import Engine, kept_names
from bayesmc.engines.forward import chunk_count, chunk_sizes
from bayesmc.engines.mcmc.question import difference
from bayesmc.engines.weighted.saved import SavedDraws, drawn_so_far
from bayesmc.errors import (
    BudgetError,
    InterruptWarning,
    LowEssWarning,
    UnsupportedError,
    ZeroProbabilityError,
)
from bayesmc.network import Model, Problem
from bayesmc.network.forward import Pass, Step, run
from bayesmc.randomness import Purpose, stream
from bayesmc.results import DrawsPosterior, Posterior, RunFile, Sums, SumsPosterior
from bayesmc.results.chains import noted_densities
from bayesmc.workers import in_order

#: share of the draws above which weights are even: they have a heavy tail only if the largest one counts
_EVEN = 0.5
#: share of the sum of squared weights from which one weight counts; of weights that are bounded every share
#: falls as 1 / draws, while k is large wherever a rare state has a larger weight than the others
_COUNTS = 0.004

#: chunks in a unit of work, which are summed up together
_CHUNKS = 8

#: stored values of some nodes for some draws, their log weights, and how many they are
Chunk = tuple[dict[str, np.ndarray], Any, int]

#: draws at which the densities of a net that was declared anew are compared
_COMPARED = 16


class WeightedEngine(Engine):
    """Independent weighted draws in one pass per chunk; a family supplies the steps.

    Attributes
    ----------
    draws : int
    """

    draws: int
    #: what the engine does, in warnings and beside the progress bar
    label: ClassVar[str]
    #: what helps where the weights are too uneven
    remedy: ClassVar[str]

    @property
    def zero_remedy(self) -> str:
        """What to check where no draw is possible."""
        return "check the evidence, or use Exact() where explain(net, evidence) says it can"

    def steps(self, problem: Problem) -> list[Step]:
        """The steps of one pass."""
        raise NotImplementedError

    def known(self, problem: Problem) -> dict[str, np.ndarray]:
        """Stored values in place before a pass starts."""
        return dict(problem.inputs)

    def is_weighted(self, problem: Problem) -> bool:
        """Whether the draws have weights at all."""
        return bool(problem.observed or problem.model.potentials)

    def continues(self, other: Any) -> bool:
        """Whether draws of an ``other`` engine may be joined with this one's."""
        return type(other) is type(self)

    saves: ClassVar[bool] = True
    spreads: ClassVar[bool] = True

    def run(
        self,
        problem: Problem,
        seed: np.random.SeedSequence,
        keep: Any = "draws",
        progress: bool | None = None,
        resume: Posterior | None = None,
        executor: Any = None,
        checkpoint: RunFile | None = None,
    ) -> Posterior:
        names, summed, spilled = kept_names(keep, problem)
        first = resume.streams if isinstance(resume, DrawsPosterior) else 0
        if summed and resume is not None:
            raise UnsupportedError('infer: resume= continues draws; give keep="draws"')
        saving = None if checkpoint is None else SavedDraws(checkpoint, problem, names, spilled)
        done = 0 if saving is None else saving.chunks
        shared = {
            "engine": self, "problem": problem, "seed": seed, "names": names, "summed": summed,
        }  # fmt: skip
        parts = in_order(
            _unit_drawn, shared, _units(problem.model, self.draws, first, done), executor,
            label=self.label, total=-(-(chunk_count(problem.model, self.draws) - done) // _CHUNKS),
            progress=progress,
        )  # fmt: skip
        try:
            if summed:
                found: Posterior = self._summaries(problem, parts, names, saving)
            elif saving is not None and spilled:
                return self._spilled(problem, parts, saving)
            else:
                found = self._draws(problem, parts, names, resume, saving)
        except MemoryError as error:
            raise no_memory(self, self.draws, names) from error
        if checkpoint is not None:
            checkpoint.finish(found)
        return found

    def so_far(self, problem: Problem, file: RunFile) -> Posterior | None:
        """What a run has come to that has not ended; None where that is nothing."""
        return drawn_so_far(self, problem, file)

    def _summaries(
        self,
        problem: Problem,
        parts: Iterator[Sums],
        names: tuple[str, ...],
        saving: SavedDraws | None,
    ) -> SumsPosterior:
        sums = Sums(problem.model, names)
        if saving is not None and saving.count:
            sums = saving.sums()
        try:
            for part in parts:
                sums.merge(part)
                if saving is not None:
                    saving.passed(sums, _CHUNKS)
        except KeyboardInterrupt:
            self._interrupted(0 if saving is not None else sums.draws)
        self._refuse_zero(sums.top, sums.draws)
        weighted = self.is_weighted(problem)
        posterior = SumsPosterior(problem, self, sums, weighted)
        log_total = sums.top + float(np.log(sums.weight[0]))
        self._set_evidence(posterior, log_total, sums.draws, weighted, sums.tail.values())
        return posterior

    def _draws(
        self,
        problem: Problem,
        parts: Iterator[list[Chunk]],
        names: Sequence[str],
        resume: Posterior | None,
        saving: SavedDraws | None,
    ) -> DrawsPosterior:
        kept = Kept(problem.model, names, self.draws)
        log_weights = np.zeros((1, self.draws))
        if saving is not None:
            for values, logs, count in saving.earlier():
                log_weights[0, kept.count : kept.count + count] = logs
                kept.add(values, count)
        chunks = 0 if saving is None else saving.chunks
        try:
            for part in parts:
                for chunk in part:
                    values, log_weight, count = chunk
                    log_weights[0, kept.count : kept.count + count] = log_weight
                    kept.add(values, count)
                    if saving is not None:
                        saving.drawn(chunk)
                chunks += len(part)
        except KeyboardInterrupt:
            self._interrupted(0 if saving is not None else kept.count)
            log_weights = log_weights[:, : kept.count]
        stored = kept.finished()
        if resume is not None:
            stored, log_weights = self._joined(resume, stored, log_weights, problem)
        total = log_weights.shape[1]
        self._refuse_zero(float(log_weights.max()), total)
        for array in stored.values():
            array.flags.writeable = False
        log_weights.flags.writeable = False
        before = resume.streams if isinstance(resume, DrawsPosterior) else 0
        weighted = self.is_weighted(problem)
        posterior = DrawsPosterior(
            problem,
            self,
            stored,
            (1, total),
            log_weights if weighted else None,
            independent=True,
            streams=before + chunks,
        )
        few = _first(stored, problem)
        posterior.densities = None if few is None else noted_densities(problem, few)
        log_total = float(log_sum_exp(log_weights))
        self._set_evidence(posterior, log_total, total, weighted, log_weights)
        return posterior

    def _interrupted(self, count: int) -> None:
        """Go on with the draws made so far, or raise where there are none."""
        if not count:
            raise KeyboardInterrupt
        warnings.warn(
            f"{type(self).__name__}: interrupted; the posterior has the {count} draws made so far, and "
            "infer(..., resume=posterior) adds to draws that were kept",
            InterruptWarning,
            stacklevel=5,
        )

    def _spilled(
        self, problem: Problem, parts: Iterator[list[Chunk]], saving: SavedDraws
    ) -> DrawsPosterior:
        """Draws that are never here all at once: they stay in the file."""
        for part in parts:
            for chunk in part:
                saving.drawn(chunk)
        saving.flush()
        tail = saving.tail()
        self._refuse_zero(tail.top, self.draws)
        streams = chunk_count(problem.model, self.draws)
        posterior, lazily = saving.posterior(self, tail, self.is_weighted(problem), streams)
        log_total = tail.top + float(np.log(tail.weight[0]))
        weighted = self.is_weighted(problem)
        self._set_evidence(posterior, log_total, self.draws, weighted, tail.tail.values())
        saving.saver.finish(posterior, lazily)
        few = _first(posterior._stored, problem)
        posterior.densities = None if few is None else noted_densities(problem, few)
        return posterior

    def _joined(
        self,
        old: Posterior,
        stored: dict[str, np.ndarray],
        log_weights: np.ndarray,
        problem: Problem,
    ) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Earlier draws of the same question and the new ones, end to end."""
        why = self._unlike(old, problem, set(stored))
        if why is not None:
            raise UnsupportedError(
                f"infer: resume= takes an earlier {type(self).__name__} posterior of the same net, "
                f"evidence, inputs and keep=, as infer returned it; {why}"
            )
        assert isinstance(old, DrawsPosterior)
        before = old._shape[1]
        joined = {}
        for name, new in stored.items():
            tail = problem.model[name].value_shape
            parts = [
                np.broadcast_to(old._stored[name], (1, before, *tail)),
                np.broadcast_to(new, (1, log_weights.shape[1], *tail)),
            ]
            constant = new.shape[1] == 1 == old._stored[name].shape[1]
            joined[name] = new if constant else np.concatenate(parts, axis=1)
        earlier = np.zeros((1, before)) if old.log_weights is None else old.log_weights
        return joined, np.concatenate([earlier, log_weights], axis=1)

    def _unlike(self, old: Posterior, problem: Problem, names: set[str]) -> str | None:
        """Why draws of ``old`` cannot be joined with new ones for ``problem``."""
        if not isinstance(old, DrawsPosterior) or not self.continues(old.engine):
            return f"this one is {old!r}"
        if old.problem is None:
            return "this one was loaded or unpickled, and files and pickles carry no functions"
        if set(old._stored) != names:
            return "this one kept other nodes"
        if (old.log_weights is not None) != self.is_weighted(problem):
            return "this one answers another question"
        return difference(old.problem, problem, _first(old._stored, problem), old.densities)

    def _refuse_zero(self, top: float, draws: int) -> None:
        if top == -np.inf:
            raise ZeroProbabilityError(
                f"{type(self).__name__}: none of {draws} draws is compatible with the evidence, so its "
                f"probability is zero or far too small for this engine; {self.zero_remedy}"
            )

    def _set_evidence(
        self, posterior: Any, log_total: float, draws: int, weighted: bool, largest: np.ndarray
    ) -> None:
        """Log evidence, its error by the delta method, and a warning where it rests on too little.

        ``largest`` are at least the largest log weights.
        """
        posterior.log_marginal_likelihood = log_total - float(np.log(draws)) if weighted else 0.0
        posterior.log_marginal_likelihood_mcse = 0.0
        if not weighted:
            return
        ess = posterior.weight_ess
        posterior.log_marginal_likelihood_mcse = float(np.sqrt(max(1 / ess - 1 / draws, 0.0)))
        if ess < min(diagnostics.MIN_WEIGHT_ESS, 0.9 * draws):
            warnings.warn(
                f"{self.label}: the {draws} draws are worth only {ess:.1f} equally weighted ones "
                f"(weight_ess); answers and their error bars are unreliable: {self.remedy}",
                LowEssWarning,
                stacklevel=5,
            )
        elif posterior.pareto_k > diagnostics.MAX_PARETO_K and (
            ess < _EVEN * draws or _rests_on_one(largest, log_total, ess)
        ):
            warnings.warn(
                f"{self.label}: the weights have a heavy tail (Pareto k = {posterior.pareto_k:.2f}, "
                f"above {diagnostics.MAX_PARETO_K}); answers converge slowly: {self.remedy}",
                LowEssWarning,
                stacklevel=5,
            )


def _rests_on_one(largest: np.ndarray, log_total: float, ess: float) -> bool:
    """Whether the largest weight counts among the squares, and no other is equal to it.

    Where it has equals, weights are those of states and bounded.
    """
    top = float(largest.max())
    if np.count_nonzero(largest > top - 1e-9) > 1:
        return False
    return ess * float(np.exp(2 * (top - log_total))) > _COUNTS


class Kept:
    """Draws of some nodes put in place chunk by chunk.

    Attributes
    ----------
    stored : dict
        Node -> stored values, shape ``(1, draws, *plates, *event)``; what is the same for all draws has
        one draw.
    count : int
        Draws in place so far.
    """

    def __init__(self, model: Model, names: Iterable[str], draws: int) -> None:
        self.model = model
        self.names = tuple(names)
        self.draws = draws
        self.stored: dict[str, np.ndarray] = {}
        self.count = 0

    def add(self, values: Mapping[str, np.ndarray], count: int) -> None:
        """Take in the values of ``count`` more draws."""
        for name in self.names:
            value = values[name]
            if value.ndim == len(self.model[name].value_shape):
                self.stored.setdefault(name, np.array(value)[None, None])
                continue
            if name not in self.stored:
                self.stored[name] = np.empty((1, self.draws, *value.shape[1:]), dtype=value.dtype)
            self.stored[name][0, self.count : self.count + count] = value
        self.count += count

    def finished(self) -> dict[str, np.ndarray]:
        """The draws in place."""
        if self.count == self.draws:
            return self.stored
        return {n: v[:, : self.count] for n, v in self.stored.items()}


def passes(
    steps: Sequence[Step],
    sizes: Iterable[int],
    seed: np.random.SeedSequence,
    known: Mapping[str, np.ndarray],
    first: int = 0,
) -> Iterator[Pass]:
    """One pass per chunk; chunk ``k`` of ``sizes[k]`` draws uses random stream ``first + k``.

    ``known`` are stored values in place before a pass starts.
    """
    for number, count in enumerate(sizes):
        rng = stream(seed, Purpose.INFER, first + number)
        with marking_invalid(), np.errstate(all="ignore"):
            state = run(steps, Pass(rng, (count,), dict(known)))
        yield state


def check_count(engine: Any, field: str, value: Any, example: str) -> None:
    """Refuse an option that is not a whole number of 1 or more."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise ValueError(
            f"{type(engine).__name__}({field}={value!r}): {field} is a whole number, 1 or more, such as "
            f"{example}"
        )


def no_memory(engine: Any, draws: int, kept: Sequence[str]) -> BudgetError:
    """The error for draws that do not fit in memory."""
    return BudgetError(
        f"{type(engine).__name__}: {draws} draws of {len(kept)} nodes do not fit in memory; "
        'ask for keep="summaries", or name the nodes to keep'
    )


def treatment(problem: Problem, name: str) -> str:
    """What a forward pass does to a node, in words."""
    node = problem.model[name]
    if node.kind in ("input", "fixed"):
        return "given"
    slow = ", element by element (vectorize=True): slow" if node.declaration.vectorize else ""
    if not node.is_stochastic:
        return "computed from its parents" + slow
    seen = problem.observed.get(name)
    if seen is None:
        return "sampled given its parents" + slow
    partly = " (missing elements sampled)" if seen.mask is not None else ""
    return "weights the draws" + partly + slow


# ---- private ------------------------------------------------------------------------------------


def _units(model: Model, draws: int, first: int, done: int) -> Iterator[tuple[int, list[int]]]:
    """Units of work: the random stream of the first of some chunks, and how many draws each has.

    They are not listed before there is memory for the draws. Some chunks may have been ``done`` before.
    """
    sizes = chunk_sizes(model, draws)
    for k in range(done, len(sizes), _CHUNKS):
        yield first + k, sizes[k : k + _CHUNKS]


def _unit_drawn(shared: Mapping[str, Any], unit: tuple[int, list[int]]) -> Sums | list[Chunk]:
    """The draws of some chunks: their sums, or the values of nodes that are kept."""
    engine, problem, names = shared["engine"], shared["problem"], shared["names"]
    steps, known = engine.steps(problem), engine.known(problem)
    chunks = passes(steps, unit[1], shared["seed"], known, unit[0])
    if not shared["summed"]:
        return [({n: c.values[n] for n in names}, c.log_weight, c.batch[0]) for c in chunks]
    sums = Sums(problem.model, names)
    for chunk in chunks:
        sums.add(chunk.values, chunk.log_weight, chunk.batch[0])
    return sums


def _first(stored: Mapping[str, np.ndarray], problem: Problem) -> dict[str, np.ndarray] | None:
    """Values of all nodes at the first draws; None where some were not kept."""
    if any(n not in stored and c.kind != "input" for n, c in problem.model.nodes.items()):
        return None
    return {n: v[0, :_COMPARED] for n, v in stored.items()}
