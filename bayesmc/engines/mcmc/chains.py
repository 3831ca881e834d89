"""Engines that run Markov chains: options, where the user wants chains to start, and what is warned of.

An engine supplies a sampler, which the ``loop`` asks for one sweep of all chains after the other. Whether
these have mixed is judged in ``convergence``.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any, ClassVar

import numpy as np

from bayesmc.engines.base import Engine, kept_names
from bayesmc.engines.mcmc.convergence import (
    poor_acceptance,
    poor_mixing,
    share_reached,
    warn_of_ties,
)
from bayesmc.engines.mcmc.given import frozen_start, read_start
from bayesmc.engines.mcmc.groups import (
    GROUPS,
    check_groups,
    groups_of,
    groups_so_far,
    in_groups,
    state_of,
)
from bayesmc.engines.mcmc.length import LEAST, WARMUP, chosen, in_words
from bayesmc.engines.mcmc.loop import Kept, Lengths, Loop, Sampler, State
from bayesmc.engines.mcmc.missed import missed_ends, never_left, stood_still
from bayesmc.engines.mcmc.question import difference
from bayesmc.engines.mcmc.saved import SavedChains, answer_so_far
from bayesmc.engines.mcmc.trajectories import faulty_trajectories
from bayesmc.engines.unrolled import series_of
from bayesmc.engines.weighted.drawing import check_count, no_memory
from bayesmc.errors import (
    ConvergenceWarning,
    InterruptWarning,
    UnsupportedError,
)
from bayesmc.network import Problem
from bayesmc.progress import Patience, Progress
from bayesmc.randomness import Purpose, stream
from bayesmc.results import ChainsPosterior, ChainsSums, Posterior, RunFile, RunningChains

#: share of accepted proposals outside of which a random walk is ill adapted
_BAND = (0.1, 0.9)
#: effective size that is asked for where nothing is said
_ESS = 1000


class ChainEngine(Engine):
    """Draws from Markov chains; a family supplies the sampler.

    Attributes
    ----------
    draws : int or None
        Draws kept of every chain; None: as many as it takes to ``ess``.
    warmup : int or None
        Sweeps before the first draw, during which the sampler adapts; None chooses.
    chains : int or None
        None chooses.
    thinning : int
        Sweeps per kept draw.
    ess : float
        Effective size of every number of the answer that is asked for where ``draws`` is None.
    start : dict or None
        Node -> where its chains start.
    groups : int or None
        Equal groups of chains that run apart, units of work for an ``executor``; None: where a sweep is
        mostly arithmetic, and one elsewhere.
    """

    draws: int | None
    warmup: int | None
    chains: int | None
    thinning: int = 1
    ess: float = _ESS
    start: Mapping[str, Any] | None = None
    groups: int | None = None
    spreads: ClassVar[bool] = True
    #: whether what is worth a warning is left to whoever puts groups together
    silent: ClassVar[bool] = False
    #: what the engine does, beside the progress bar
    label: ClassVar[str]
    #: whether its kernels learn in few sweeps, so that a warmup may end as soon as starts are forgotten
    judges: ClassVar[bool] = False
    saves: ClassVar[bool] = True
    #: whether each chain may be an array of members itself, so that more chains are not for free
    ensembles: ClassVar[bool] = False

    def __post_init__(self) -> None:
        name = type(self).__name__
        if self.draws is not None:
            check_count(self, "draws", self.draws, "1000")
        if self.warmup is not None and (isinstance(self.warmup, bool) or self.warmup != 0):
            check_count(self, "warmup", self.warmup, "1000 (or 0 for none)")
        if self.chains is not None:
            check_count(self, "chains", self.chains, "4")
        number = isinstance(self.ess, (int, float)) and not isinstance(self.ess, bool)
        if not number or not 0 < self.ess < math.inf:
            raise ValueError(f"{name}(ess={self.ess!r}): give an effective size, such as 1000")
        if self.draws is not None and self.ess != _ESS:
            raise ValueError(f"{name}(draws={self.draws}, ess={self.ess:g}): give one of both")
        check_count(self, "thinning", self.thinning, "1")
        object.__setattr__(self, "start", frozen_start(name, self.start))
        if self.groups is not None:
            check_groups(self)

    def __repr__(self) -> str:
        """What was said, and the effective size where that says how many draws there are."""
        said = {f.name: getattr(self, f.name) for f in fields(self) if f.repr}  # type: ignore[arg-type]
        if self.draws is not None:
            said.pop("ess", None)
        shown = ", ".join(f"{n}={v!r}" for n, v in said.items() if v is not None)
        return f"{type(self).__name__}({shown})"

    def sampler(self, problem: Problem) -> Sampler:
        """What moves the chains of a posed problem."""
        raise NotImplementedError

    def tied(self, problem: Problem) -> Sequence[str]:
        """Nodes among which zeros in tables may hold the chains."""
        return ()

    def continues(self, other: Any) -> bool:
        """Whether this engine goes on as ``other`` would have: all but how many draws is the same."""
        if type(other) is not type(self):
            return False
        options = [f.name for f in fields(self) if f.compare and f.name not in ("draws", "ess")]  # type: ignore[arg-type]
        return all(getattr(self, name) == getattr(other, name) for name in options)

    def lengths(self, problem: Problem, keep: Any = "draws") -> Lengths:
        """How many chains it runs for a question, and how long.

        Parameters
        ----------
        keep : "draws", "summaries" or sequence of str
            As in ``infer``.
        """
        if self.draws is not None:
            chains = LEAST if self.chains is None else self.chains
            return Lengths(chains, WARMUP if self.warmup is None else self.warmup, self.draws)
        names, summed, spilled = kept_names(keep, problem)
        if spilled:
            raise UnsupportedError(
                f"{type(self).__name__}: keep={keep!r} leaves draws in the file, and with draws=None their "
                "number follows from them; give draws="
            )
        kept = None if summed else names
        return chosen(
            problem,
            self.warmup,
            self.chains,
            self.ess,
            judges=self.judges,
            ensembles=self.ensembles,
            kept=kept,
        )

    def effort(self, problem: Problem) -> str:
        """How many chains it would run, and how long, in words."""
        return in_words(self.lengths(problem), problem)

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
        many = self.draws is not None and (self.chains or LEAST) >= 2 * LEAST
        if self.groups is not None or many:
            groups = groups_of(self, problem)
            if groups > 1:
                own = executor, groups, checkpoint
                return in_groups(self, problem, seed, keep, progress, resume, *own)
        return self._together(problem, seed, keep, progress, resume, checkpoint)

    def _together(
        self,
        problem: Problem,
        seed: np.random.SeedSequence,
        keep: Any,
        progress: bool | None,
        resume: Posterior | None,
        checkpoint: RunFile | None = None,
    ) -> Posterior:
        """All chains in one array."""
        names, summed, spilled = kept_names(keep, problem)
        asked = lengths = self.lengths(problem, keep)
        if resume is not None:
            lengths = self._refuse_another(resume, problem, names, summed, lengths)
        sampler = self._ready(problem, asked, lengths, resume is None)
        saving = None
        if checkpoint is not None:
            saving = SavedChains(checkpoint, problem, names, spilled)
        try:
            held = self._held(problem, sampler, names, summed, resume, lengths, saving)
            rng = stream(seed, Purpose.INFER)
            loop = Loop(sampler, rng, problem, lengths, self.thinning)
            loop.saving = saving
            sweeps = lengths.draws * self.thinning + (lengths.warmup if resume is None else 0)
            with Progress(sweeps, self.label, progress) as bar, Patience() as stop:
                state = loop.begun(bar, resume, stop)
                if isinstance(resume, (ChainsPosterior, ChainsSums)):
                    loop.warmup = resume.warmup

                def reached(ess: float, agree: bool = True) -> float:
                    made = self._posterior(problem, sampler, held, loop)
                    return share_reached(made, self._forward(sampler), ess, agree)

                finished = self._drawn(loop, state, held, bar, stop, reached)
        except MemoryError as error:
            raise no_memory(self, lengths.draws * lengths.chains, names) from error
        if spilled and isinstance(held, Kept) and saving is not None:
            if not finished:  # draws are in the file, which is gone on with by the same call
                raise KeyboardInterrupt
            held.put(saving.stand_ins(lengths.chains, held.draws))
        posterior = self._posterior(problem, sampler, held, loop)
        loop.tell_trajectories(posterior, resume)
        if checkpoint is not None and saving is not None and finished:
            lazily = saving.lazily(lengths.chains, held.draws) if spilled else None
            checkpoint.finish(posterior, lazily)
        if not self.silent:
            self._warn(posterior, sampler, finished, lengths, checkpoint is not None)
        return posterior

    def _ready(self, problem: Problem, asked: Lengths, lengths: Lengths, is_new: bool) -> Sampler:
        """The sampler of a run, told how long that is and where chains start."""
        ready = replace(  # type: ignore[type-var]
            self,
            draws=lengths.draws,
            warmup=None if lengths.judge else lengths.warmup,
            chains=lengths.chains,
            **({} if self.ess == _ESS else {"ess": _ESS}),
        )
        sampler = ready.sampler(problem)
        if self.start and is_new:
            given = read_start(type(self).__name__, problem, self.start, lengths.chains)
            sampler.given = given  # type: ignore[attr-defined]
        if lengths.superchains:
            sampler.superchains = lengths.superchains  # type: ignore[attr-defined]
        for kernel in getattr(sampler, "kernels", ()):
            kernel.expect(asked.warmup, asked.chains)  # the same where it is resumed
        tied = self.tied(problem)
        if tied and not self.silent:
            warn_of_ties(type(self).__name__, tied)
        return sampler

    def so_far(self, problem: Problem, file: RunFile) -> Posterior | None:
        """What a run has come to that has not ended; None where that is nothing."""
        return answer_so_far(self, problem, file) or groups_so_far(self, problem, file)

    def _drawn(
        self,
        loop: Loop,
        state: State,
        held: Kept | RunningChains,
        bar: Progress,
        stop: Patience,
        reached: Callable[..., float],
    ) -> bool:
        """Draws made, until they are enough where it is an effective size that is asked for."""
        lengths = loop.lengths
        before, draws, wanted = held.draws, lengths.first(), lengths.ess
        if loop.round is not None:  # where another process was
            before, draws = 0, loop.round - held.draws
        elif (
            wanted is not None and before
        ):  # what is there has its own, and as much again is asked for
            wanted += wanted * reached(wanted, agree=False)
        while True:
            if loop.round is not None and held.draws + draws > loop.round:
                held.more(draws) if isinstance(held, Kept) else None
            loop.round = held.draws + draws
            if not loop.draw(state, held, draws, bar, stop):
                return False
            done = held.draws - before
            if wanted is None or done >= lengths.most:
                return True
            share = reached(wanted)
            if share >= 1:
                return True
            draws = lengths.further(done, share)
            if not draws:
                return True
            state = loop.last.state

    def _forward(self, sampler: Sampler) -> frozenset[str]:
        return frozenset(getattr(sampler, "forward_nodes", ()))

    def _held(
        self,
        problem: Problem,
        sampler: Sampler,
        names: tuple[str, ...],
        summed: bool,
        resume: Posterior | None,
        lengths: Lengths,
        saving: SavedChains | None,
    ) -> Kept | RunningChains:
        """Where draws go: new, or with those of an earlier run in it."""
        if saving is not None and not summed:
            return saving.held(lengths.chains, lengths.first())
        if saving is not None and saving.state is not None and "sums" in saving.state:
            sums: RunningChains = saving.state["sums"]
            return sums.with_model(problem.model)
        if isinstance(resume, ChainsSums):
            return resume._running.with_model(problem.model)
        if summed:
            ensemble = getattr(sampler, "ensemble", 1)
            return RunningChains(problem.model, names, lengths.chains, ensemble)
        kept = Kept(problem.model, names, lengths.chains, lengths.first())
        if isinstance(resume, ChainsPosterior):
            kept.begin_with(resume._stored, resume._shape[1])
        return kept

    def _posterior(
        self, problem: Problem, sampler: Sampler, held: Kept | RunningChains, loop: Loop
    ) -> ChainsPosterior | ChainsSums:
        checkpoint, lengths, warmup = loop.last.noted(problem), loop.lengths, loop.warmup
        acceptance = {k: np.asarray(v) for k, v in sampler.acceptance(checkpoint.state).items()}
        found: ChainsPosterior | ChainsSums
        if isinstance(held, RunningChains):
            found = ChainsSums(problem, self, held, acceptance, warmup, checkpoint)
        else:
            found = ChainsPosterior(
                problem,
                self,
                held.frozen(),
                (lengths.chains, held.draws),
                acceptance,
                getattr(sampler, "ensemble", 1),
                warmup,
                checkpoint,
            )
            found.superchains = lengths.superchains
        if hasattr(sampler, "renewals"):
            found.renewals = sampler.renewals(checkpoint.state)
        return found

    def _refuse_another(
        self,
        old: Posterior,
        problem: Problem,
        names: tuple[str, ...],
        summed: bool,
        lengths: Lengths,
    ) -> Lengths:
        """Only the same question, asked the same way, can be gone on with: by the chains that it has."""
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
                why = None
            if why is None:
                groups = old.superchains
                return replace(lengths, chains=old._chains_and_draws[0], superchains=groups)
        raise UnsupportedError(
            f"infer: resume= takes an earlier {type(self).__name__} posterior of the same net, evidence, "
            f"inputs, keep= and options (but draws), as infer returned it; {why}"
        )

    def _warn(
        self,
        posterior: ChainsPosterior | ChainsSums,
        sampler: Sampler,
        finished: bool,
        lengths: Lengths,
        saved: bool,
    ) -> None:
        name = type(self).__name__
        point = {} if posterior.checkpoint is None else posterior.checkpoint.state
        if not finished:
            chains, draws = posterior._chains_and_draws
            more = "infer(..., resume=posterior) continues them"
            more = "groups that were stopped cannot be continued" if GROUPS in point else more
            more = "the same call goes on where they are" if saved else more
            made = f"the {draws} draws of each of {chains} chains made so far"
            message = f"{name}: interrupted; the posterior has {made}, and {more}"
            warnings.warn(message, InterruptWarning, stacklevel=5)
        forward = self._forward(sampler)
        found = poor_mixing(posterior, forward, lengths.ess)
        band = getattr(sampler, "acceptance_band", _BAND)
        problem = posterior.problem
        timed = problem is not None and series_of(problem) is not None
        if found and timed and "Particle" not in name:
            found[0] += "; ParticleGibbs(draws) draws whole trajectories of a template at once"
        found += [*never_left(posterior), *stood_still(posterior, forward)]
        if isinstance(posterior, ChainsPosterior):
            found += missed_ends(posterior, forward)
        assert posterior.checkpoint is not None
        count = getattr(sampler, "divergences", None)
        state = posterior.checkpoint.state
        if GROUPS in state:
            state = state_of(state)
        if count is not None and count(state) is not None:
            found += faulty_trajectories(posterior, sampler.kernels, state)  # type: ignore[attr-defined]
        for fault in [*found, *poor_acceptance(posterior.acceptance, band)]:
            warnings.warn(f"{name}: {fault}", ConvergenceWarning, stacklevel=5)
