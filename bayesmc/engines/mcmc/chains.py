"""The loop of all engines that run Markov chains: warmup, draws, what is kept, interruption, going on.

An engine supplies a sampler, which moves all chains by one sweep; what a sweep does is not known here.
Whether the chains have mixed is judged in ``convergence``.
"""

from __future__ import annotations

import copy
import signal
import threading
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import fields
from typing import Any, ClassVar, Protocol

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.base import Engine
from bayesmc.engines.mcmc.convergence import poor_acceptance, poor_mixing
from bayesmc.engines.mcmc.funnels import missed_ends
from bayesmc.engines.mcmc.question import difference
from bayesmc.engines.mcmc.start_values import frozen_start, read_start
from bayesmc.engines.mcmc.unvisited import never_left
from bayesmc.engines.unrolled import series_of
from bayesmc.engines.weighted.drawing import check_count, no_memory
from bayesmc.errors import (
    BayesmcError,
    ConvergenceWarning,
    DensityError,
    InterruptWarning,
    ParameterError,
    ReducibleWarning,
    UnsupportedError,
)
from bayesmc.network import Model, Problem
from bayesmc.progress import Progress
from bayesmc.randomness import Purpose, stream
from bayesmc.results import ChainsPosterior, ChainsSums, Checkpoint, Posterior, RunningChains
from bayesmc.results.sums import stored_dtype

#: what a sampler moves: arrays, numbers and nested dicts of them, picklable
State = Mapping[str, Any]
#: share of accepted proposals outside of which a random walk is ill adapted
_BAND = (0.1, 0.9)


class Sampler(Protocol):
    """Moves all chains of one problem at once; it holds neither state nor random numbers.

    Notes
    -----
    Four attributes are optional. ``ensemble`` (default 1): every chain is an ensemble of that many
    members, and consecutive calls of ``values`` hand out one member after the other, draw by draw.
    ``forward_nodes`` (none): nodes drawn afresh for each draw, which tell nothing about mixing.
    ``acceptance_band`` (0.1, 0.9): useful acceptance rates, or a dict from block to a pair, or to None
    where any rate will do. ``given`` (none): stored values at which the user wants chains to start.
    A method is, too: ``renewals(state)`` says how often finite nodes were moved with what hangs on them.

    Ctrl-C waits for the end of a draw. A second one does not: then the loop goes back to the draw before,
    which is exact if ``step`` writes into no array of the state it is given.
    """

    def start(self, rng: np.random.Generator, chains: int) -> State:
        """Starting points of all chains."""
        ...

    def step(self, state: State, rng: np.random.Generator, warmup: bool) -> State:
        """One sweep. Arrays that ``values`` handed out are never written to."""
        ...

    def end_warmup(self, state: State) -> State:
        """The state with its adaptation frozen."""
        ...

    def values(self, state: State, rng: np.random.Generator) -> Mapping[str, np.ndarray]:
        """Stored values of all nodes, ``(chain, *plates, *event)``, without chains where constant.

        It is called once per kept draw, and draws what is not part of the chain. Inputs and what is
        wholly observed may be left out.
        """
        ...

    def acceptance(self, state: State) -> Mapping[str, np.ndarray]:
        """Block -> share of proposals accepted since the warmup, shape (chain,)."""
        ...


class ChainEngine(Engine):
    """Draws from Markov chains; a family supplies the sampler.

    Attributes
    ----------
    draws : int
        Draws kept of every chain.
    warmup : int
        Sweeps before the first draw, during which the sampler adapts.
    chains : int
    thinning : int
        Sweeps per kept draw.
    start : dict or None
        Node -> where its chains start.
    """

    draws: int
    warmup: int
    chains: int
    thinning: int = 1
    start: Mapping[str, Any] | None = None
    #: what the engine does, beside the progress bar
    label: ClassVar[str]

    def __post_init__(self) -> None:
        check_count(self, "draws", self.draws, "1000")
        if isinstance(self.warmup, bool) or self.warmup != 0:
            check_count(self, "warmup", self.warmup, "1000 (or 0 for none)")
        check_count(self, "chains", self.chains, "4")
        check_count(self, "thinning", self.thinning, "1")
        object.__setattr__(self, "start", frozen_start(type(self).__name__, self.start))

    def sampler(self, problem: Problem) -> Sampler:
        """What moves the chains of a posed problem."""
        raise NotImplementedError

    def tied(self, problem: Problem) -> Sequence[str]:
        """Nodes among which zeros in tables may hold the chains."""
        return ()

    def continues(self, other: Any) -> bool:
        """Whether this engine goes on as ``other`` would have: its options but ``draws`` are the same."""
        if type(other) is not type(self):
            return False
        options = [f.name for f in fields(self) if f.compare and f.name != "draws"]  # type: ignore[arg-type]
        return all(getattr(self, name) == getattr(other, name) for name in options)

    def run(
        self,
        problem: Problem,
        seed: np.random.SeedSequence,
        keep: Any = "draws",
        progress: bool | None = None,
        resume: Posterior | None = None,
    ) -> Posterior:
        listed = not isinstance(keep, str)
        summed = not listed and keep == "summaries"
        free = (n for n, c in problem.model.nodes.items() if c.kind != "input")
        names = tuple(keep) if listed else tuple(free)
        if resume is not None:
            self._refuse_another(resume, problem, names, summed)
        sampler = self.sampler(problem)
        if self.start and resume is None:
            given = read_start(type(self).__name__, problem, self.start, self.chains)
            sampler.given = given  # type: ignore[attr-defined]
        tied = self.tied(problem)
        if tied:
            _warn_of_ties(type(self).__name__, tied)
        try:
            held = self._held(problem, sampler, names, summed, resume)
            loop = _Loop(sampler, self, stream(seed, Purpose.INFER), problem)
            with Progress(self._sweeps(resume), self.label, progress) as bar, _Patience() as stop:
                state = loop.begun(bar, resume, stop)
                finished = loop.draw(state, held, self.draws, bar, stop)
        except MemoryError as error:
            raise no_memory(self, self.draws * self.chains, names) from error
        posterior = self._posterior(problem, sampler, held, loop.last.noted(problem))
        self._warn(posterior, sampler, finished)
        return posterior

    def _sweeps(self, resume: Posterior | None) -> int:
        return self.draws * self.thinning + (self.warmup if resume is None else 0)

    def _held(
        self,
        problem: Problem,
        sampler: Sampler,
        names: tuple[str, ...],
        summed: bool,
        resume: Posterior | None,
    ) -> _Kept | RunningChains:
        """Where draws go: new, or with those of an earlier run in it."""
        if isinstance(resume, ChainsSums):
            return resume._running.with_model(problem.model)
        if summed:
            ensemble = getattr(sampler, "ensemble", 1)
            return RunningChains(problem.model, names, self.chains, ensemble)
        kept = _Kept(problem.model, names, self.chains, self.draws)
        if isinstance(resume, ChainsPosterior):
            kept.begin_with(resume._stored, resume._shape[1])
        return kept

    def _posterior(
        self,
        problem: Problem,
        sampler: Sampler,
        held: _Kept | RunningChains,
        checkpoint: Checkpoint,
    ) -> ChainsPosterior | ChainsSums:
        acceptance = {k: np.asarray(v) for k, v in sampler.acceptance(checkpoint.state).items()}
        found: ChainsPosterior | ChainsSums
        if isinstance(held, RunningChains):
            found = ChainsSums(problem, self, held, acceptance, self.warmup, checkpoint)
        else:
            found = ChainsPosterior(
                problem,
                self,
                held.frozen(),
                (self.chains, held.draws),
                acceptance,
                getattr(sampler, "ensemble", 1),
                self.warmup,
                checkpoint,
            )
        if hasattr(sampler, "renewals"):
            found.renewals = sampler.renewals(checkpoint.state)
        return found

    def _refuse_another(
        self, old: Posterior, problem: Problem, names: tuple[str, ...], summed: bool
    ) -> None:
        """Only the same question, asked the same way, can be gone on with."""
        kind = ChainsSums if summed else ChainsPosterior
        why: str | None = "this one answers another question"
        if isinstance(old, kind) and old.checkpoint is not None:
            kept = old._running.names if isinstance(old, ChainsSums) else tuple(old._stored)
            if not self.continues(old.engine):
                why = f"this one was made by {old.engine!r}"
            elif set(kept) != set(names):
                why = "this one kept other nodes"
            elif old.problem is not None:
                point = old.checkpoint
                why = difference(old.problem, problem, point.values, point.densities)
            elif old.checkpoint.fits(old.model, problem):
                return
            if why is None:
                return
        raise UnsupportedError(
            f"infer: resume= takes an earlier {type(self).__name__} posterior of the same net, evidence, "
            f"inputs, keep= and options (but draws), as infer returned it; {why}"
        )

    def _warn(
        self, posterior: ChainsPosterior | ChainsSums, sampler: Sampler, finished: bool
    ) -> None:
        name = type(self).__name__
        if not finished:
            draws = posterior._chains_and_draws[1]
            message = (
                f"{name}: interrupted; the posterior has the {draws} draws of each of {self.chains} chains "
                "made so far, and infer(..., resume=posterior) continues them"
            )
            warnings.warn(message, InterruptWarning, stacklevel=4)
        found = poor_mixing(posterior, frozenset(getattr(sampler, "forward_nodes", ())))
        band = getattr(sampler, "acceptance_band", _BAND)
        problem = posterior.problem
        timed = problem is not None and series_of(problem) is not None
        if found and timed and "Particle" not in name:
            found[0] += "; ParticleGibbs(draws) draws whole trajectories of a template at once"
        found += never_left(posterior)
        if isinstance(posterior, ChainsPosterior):
            found += missed_ends(posterior, frozenset(getattr(sampler, "forward_nodes", ())))
        for fault in [*found, *poor_acceptance(posterior.acceptance, band)]:
            warnings.warn(f"{name}: {fault}", ConvergenceWarning, stacklevel=4)


def known_values(problem: Problem) -> dict[str, np.ndarray]:
    """Stored values that no chain moves: inputs, and nodes that are wholly observed."""
    seen = {n: o.value for n, o in problem.observed.items() if o.mask is None}
    return {**problem.inputs, **seen}


# ---- private ------------------------------------------------------------------------------------


def _warn_of_ties(engine: str, names: Sequence[str]) -> None:
    """Warn that zeros in tables may hold chains."""
    shown = ", ".join(map(repr, names[:6]))
    if len(names) > 6:
        shown += f" and {len(names) - 6} more"
    warnings.warn(
        f"{engine}: zero probabilities tie {shown} together, so a chain may not reach every configuration "
        "that is possible; compare with Exact() or LikelihoodWeighting(draws)",
        ReducibleWarning,
        stacklevel=4,
    )


class _Loop:
    """Sweeps of one run, and the last point that it can return to."""

    last: Checkpoint

    def __init__(
        self,
        sampler: Sampler,
        engine: ChainEngine,
        rng: np.random.Generator,
        problem: Problem,
    ) -> None:
        self.sampler = sampler
        self.engine = engine
        self.rng = rng
        self.observed = problem.observed
        self.known = known_values(problem)
        self.sweep = 0
        self.phase = ""

    def begun(self, bar: Progress, resume: Posterior | None, stop: _Patience) -> State:
        """The state from which draws are made: after the warmup, or where an earlier run ended."""
        if isinstance(resume, (ChainsPosterior, ChainsSums)):
            assert resume.checkpoint is not None
            self.last = resume.checkpoint
            self.sweep = resume._chains_and_draws[1] * self.engine.thinning
            self.rng.bit_generator.state = self.last.generator
            # a sampler may write into its state, and the earlier posterior stays as it is
            return copy.deepcopy(self.last.state)
        with marking_invalid(), np.errstate(all="ignore"):
            try:
                state = self.sampler.start(self.rng, self.engine.chains)
            except (DensityError, ParameterError) as error:
                error.args = (f"{error}, at iteration 0 (start)", *error.args[1:])
                raise
            self.phase = " (warmup)"
            for _ in range(self.engine.warmup):
                stop.check()
                state = self._stepped(state, True)
                bar.advance()
            self.sweep, self.phase = 0, ""
            return self.sampler.end_warmup(state)

    def draw(
        self,
        state: State,
        held: _Kept | RunningChains,
        draws: int,
        bar: Progress,
        stop: _Patience,
    ) -> bool:
        """Make and keep draws; whether it was left to finish."""
        thinning, known, wanted = self.engine.thinning, self.known, held.draws + draws
        point: tuple[State, Mapping[str, Any], Mapping[str, np.ndarray]] | None = None
        try:
            with marking_invalid(), np.errstate(all="ignore"):
                for _ in range(draws):
                    stop.check()
                    for _ in range(thinning):
                        state = self._stepped(state, False)
                        bar.advance()
                    values = self._values(state)
                    if known:
                        values = {**known, **values}
                    held.add(values)
                    point = state, self.rng.bit_generator.state, values
        except KeyboardInterrupt:
            if not held.draws:
                raise
        if point is not None:
            self.last = Checkpoint(*point, self.observed)
        return held.draws == wanted

    def _stepped(self, state: State, warmup: bool) -> State:
        self.sweep += 1
        try:
            return self.sampler.step(state, self.rng, warmup)
        except BayesmcError as error:
            self._place(error)
            raise

    def _values(self, state: State) -> Mapping[str, np.ndarray]:
        try:
            return self.sampler.values(state, self.rng)
        except BayesmcError as error:
            self._place(error)
            raise

    def _place(self, error: BayesmcError) -> None:
        """Say in the message when it happened."""
        error.args = (f"{error}, at iteration {self.sweep}{self.phase}", *error.args[1:])


class _Kept:
    """Draws of some nodes, put in place one by one.

    Attributes
    ----------
    stored : dict
        Node -> stored values, shape ``(chain, draw, *plates, *event)``; ``(1, 1, ...)`` where constant.
    draws : int
        Draws in place so far.
    """

    def __init__(self, model: Model, names: Sequence[str], chains: int, draws: int) -> None:
        self.model = model
        self.names = names
        self.chains = chains
        self.room = draws
        self.stored: dict[str, np.ndarray] = {}
        self.draws = 0
        self._moving: list[tuple[str, np.ndarray]] = []
        self._together: list[tuple[list[str], np.ndarray]] = []
        self._earlier: Mapping[str, np.ndarray] = {}

    def begin_with(self, stored: Mapping[str, np.ndarray], draws: int) -> None:
        """Put earlier draws before those that there is room for."""
        self._earlier = stored
        self.room += draws
        self.draws = draws

    def add(self, values: Mapping[str, np.ndarray]) -> None:
        """Take in one draw of every chain."""
        if not self.stored:
            self._make_room(values)
        at = self.draws
        for name, array in self._moving:
            array[:, at] = values[name]
        for names, rows in self._together:
            row = [values[n] for n in names]
            try:
                rows[..., at] = np.concatenate(row).reshape(rows.shape[:2])
            except ValueError:  # some of them come without chains this time
                for array, value in zip(rows, row, strict=True):
                    array[:, at] = value
        self.draws = at + 1

    def frozen(self) -> dict[str, np.ndarray]:
        """The draws in place, read-only."""
        if not self.stored:
            return dict(self._earlier)
        moving = {n for n, _ in self._moving} | {n for names, _ in self._together for n in names}
        for name in moving if self.draws < self.room else ():
            self.stored[name] = self.stored[name][:, : self.draws].copy()
        for array in self.stored.values():
            array.flags.writeable = False
        return self.stored

    def _make_room(self, values: Mapping[str, np.ndarray]) -> None:
        """Decide from the first draw what is constant; single numbers of a type are kept in one array."""
        alike: dict[np.dtype[Any], list[str]] = {}
        for name in self.names:
            node, value = self.model[name], values[name]
            dtype = stored_dtype(node, value)
            if value.ndim == len(node.value_shape):
                self.stored[name] = np.array(value, dtype=dtype)[None, None]
                continue
            self.stored[name] = np.empty(0)  # in its place
            if value.shape == (self.chains,) and value.dtype == dtype:
                alike.setdefault(dtype, []).append(name)
                continue
            self.stored[name] = np.empty((self.chains, self.room, *node.value_shape), dtype)
            self._moving.append((name, self.stored[name]))
        for dtype, names in alike.items():
            rows = np.empty((len(names), self.chains, self.room), dtype)
            self.stored.update(zip(names, rows, strict=True))
            self._together.append((names, rows))
        if self._earlier:
            for name, array in self.stored.items():
                if array.shape[1:2] == (self.room,):
                    array[:, : self.draws] = self._earlier[name]


class _Patience(AbstractContextManager["_Patience"]):
    """Within it, Ctrl-C waits until it is asked for, so that it cannot cut a sweep; a second one does not.

    Only Python's own handling is put off, which a program that handles the signal itself has replaced.
    """

    def __init__(self) -> None:
        self._pressed = False
        self._own: Callable[..., Any] | None = None

    def check(self) -> None:
        """Raise what was put off."""
        if self._pressed:
            raise KeyboardInterrupt

    def __enter__(self) -> _Patience:
        main = threading.current_thread() is threading.main_thread()
        if main and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            self._own = signal.default_int_handler
            signal.signal(signal.SIGINT, self._note)
        return self

    def __exit__(self, *exc: object) -> None:
        if self._own is not None:
            signal.signal(signal.SIGINT, self._own)

    def _note(self, number: int, frame: Any) -> None:
        if self._pressed:
            raise KeyboardInterrupt
        self._pressed = True
