"""The loop that runs Markov chains: warmup, draws, what is kept of them, interruption, going on.

A sampler moves all chains by one sweep; what a sweep does is not known here.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BayesmcError, DensityError, ParameterError
from bayesmc.network import Model, Problem
from bayesmc.progress import Patience, Progress
from bayesmc.results import ChainsPosterior, ChainsSums, Checkpoint, Posterior, RunningChains

#: draws of each chain from which on a run may be seen not to get to its effective size, and how many times
#: what is announced one makes at most that would get there so
_HOPELESS, _FURTHER = 500, 2
#: the first sweep at which a warmup may end where that is judged; draws of each chain in the first round, at
#: least, and how much longer a later round may make a run
_END, _ROUND, _GROWTH = 100, 16, 3.0

#: what a sampler moves: arrays, numbers and nested dicts of them, which can be saved
State = Mapping[str, Any]
#: after a draw: the state, that of the random numbers, and the values of all nodes
Point = tuple[State, Mapping[str, Any], Mapping[str, np.ndarray]]


class Sampler(Protocol):
    """Moves all chains of one problem at once; it holds neither state nor random numbers.

    Notes
    -----
    Some attributes are optional. ``ensemble`` (default 1): every chain is an ensemble of that many
    members, and consecutive calls of ``values`` hand out one member after the other, draw by draw.
    ``forward_nodes`` (none): nodes in which the chains have no part, which tell nothing about mixing.
    ``acceptance_band`` (0.1, 0.9): useful acceptance rates, or a dict from block to a pair, or to None
    where any rate will do. ``given`` (none): stored values at which the user wants chains to start.
    Methods are, too: ``renewals(state)`` says how often finite nodes were moved with what hangs on them,
    ``moving(state)`` hands out the values that chains move, by which the end of a warmup is judged,
    ``unsettled(state)`` says whether it should not end yet, ``divergences(state)`` how many trajectories of
    each chain diverged since the warmup, or None, ``energies(state)`` the energy of each chain's last one.
    ``superchains`` (0) is set before the start, where so many groups of chains are to start as one.

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


@dataclass(frozen=True)
class Lengths:
    """What a run makes.

    Attributes
    ----------
    chains : int
    warmup : int
        Sweeps; at most, where there is a ``judge``.
    draws : int
        Of each chain; where there is an ``ess`` at most, or up to ``most`` where these will do.
    superchains : int
        Groups of consecutive chains that start as one; 0 where every chain starts by itself.
    ess : float or None
        Effective size after which nothing more is drawn.
    judge : callable or None
        Whether draws of a warmup, some nodes' stored values, tell nothing of their starts any more.
    """

    chains: int
    warmup: int
    draws: int
    superchains: int = 0
    ess: float | None = None
    judge: Callable[[Mapping[str, np.ndarray]], bool] | None = None

    @property
    def most(self) -> int:
        """Draws of each chain that a run makes that is nearly there after ``draws``."""
        return self.draws if self.ess is None else _FURTHER * self.draws

    def ends(self) -> Iterator[int]:
        """Sweeps at which the warmup may end."""
        end = _END
        while self.judge is not None and end < self.warmup:
            yield end
            end *= 2
        yield self.warmup

    def first(self) -> int:
        """Draws of each chain in the first round."""
        if self.ess is None:
            return self.draws
        return min(max(math.ceil(self.ess / self.chains), _ROUND), self.draws)

    def further(self, made: int, share: float) -> int:
        """Draws of each chain in the next round, where those made are a share of what is wanted.

        0 where even the most that a run makes would not do: whoever is nearly there goes on.
        """
        if made >= min(_HOPELESS, self.draws) and share * self.most < made:
            return 0
        needed = made * min(1.05 / max(share, 1e-9), _GROWTH)
        return min(max(math.ceil(needed) - made, made // 8, 1), self.most - made)


class Begun(NamedTuple):
    """Where an earlier process was: the state, and in the warmup the window that is to be judged."""

    state: State
    warming: bool
    window: Kept | None


class Saving(Protocol):
    """Saves a run as it goes on (``saved``)."""

    @property
    def is_due(self) -> bool:
        """Whether it is time."""
        ...

    def begin(self, loop: Loop) -> Begun | None:
        """Put a loop where the run was; None where nothing is saved yet."""
        ...

    def wants(self, held: Kept | RunningChains) -> bool:
        """Whether draws are to be saved now."""
        ...

    def save_warmup(self, loop: Loop, state: State, window: Kept | None) -> None:
        """Save a state of the warmup."""
        ...

    def save(self, loop: Loop, point: Point, held: Kept | RunningChains) -> None:
        """Save the draws since the last time, and where the chains are."""
        ...


class Loop:
    """Sweeps of one run, and the last point that it can return to."""

    last: Checkpoint

    def __init__(
        self,
        sampler: Sampler,
        rng: np.random.Generator,
        problem: Problem,
        lengths: Lengths,
        thinning: int,
    ) -> None:
        self.sampler, self.rng, self.model = sampler, rng, problem.model
        self.lengths, self.thinning = lengths, thinning
        #: sweeps of the warmup, once it has ended
        self.warmup = lengths.warmup
        self.observed = problem.observed
        seen = {n: o.value for n, o in problem.observed.items() if o.mask is None}
        #: stored values that no chain moves
        self.known = {**problem.inputs, **seen}
        self.sweep = 0
        self.phase = ""
        #: trajectories of each chain that diverged, before the first draw and after each
        self.diverged: list[np.ndarray] = []
        #: energy of each chain's last trajectory, after each draw
        self.energies: list[np.ndarray] = []
        #: saves the run as it goes on, if it is to be saved
        self.saving: Saving | None = None
        #: draws of each chain at which the present round ends
        self.round: int | None = None

    def begun(self, bar: Progress, resume: Posterior | None, stop: Patience) -> State:
        """The state from which draws are made: after the warmup, or where an earlier run ended."""
        if isinstance(resume, (ChainsPosterior, ChainsSums)):
            assert resume.checkpoint is not None
            self.last = resume.checkpoint
            self.sweep = resume._chains_and_draws[1] * self.thinning
            self.rng.bit_generator.state = self.last.generator
            # a sampler may write into its state, and the earlier posterior stays as it is
            return copy.deepcopy(self.last.state)
        saved = None if self.saving is None else self.saving.begin(self)
        if saved is not None and not saved.warming:
            return saved.state
        with marking_invalid(), np.errstate(all="ignore"):
            state = self._started() if saved is None else saved.state
            window = None if saved is None else saved.window
            self.phase = " (warmup)"
            for end in self.lengths.ends():
                if end < self.sweep:  # passed before this process
                    continue
                state, window = self._warmed(state, end, bar, stop, window)
                if window is not None and self._may_end(state, window):
                    break
                window = None
            self.warmup = self.sweep
            self.sweep, self.phase = 0, ""
            return self.sampler.end_warmup(state)

    def _may_end(self, state: State, window: Kept) -> bool:
        """Whether a warmup has forgotten its starts, and no kernel has just begun to learn anew."""
        unsettled = getattr(self.sampler, "unsettled", lambda _: False)
        return not unsettled(state) and self.lengths.judge(window.frozen())  # type: ignore[misc]

    def _started(self) -> State:
        try:
            return self.sampler.start(self.rng, self.lengths.chains)
        except (DensityError, ParameterError) as error:
            error.args = (f"{error}, at iteration 0 (start)", *error.args[1:])
            raise

    def _warmed(
        self, state: State, end: int, bar: Progress, stop: Patience, window: Kept | None
    ) -> tuple[State, Kept | None]:
        """The state after some more sweeps, and the second half of the warmup so far if it is judged."""
        judged = end < self.lengths.warmup
        while self.sweep < end:
            stop.check()
            state = self._stepped(state, True)
            bar.advance()
            if judged and self.sweep > end // 2:
                values = self.sampler.moving(state)  # type: ignore[attr-defined]
                if window is None:
                    window = Kept(self.model, tuple(values), self.lengths.chains, end - end // 2)
                window.add(values)
            if self.saving is not None and self.saving.is_due:
                self.saving.save_warmup(self, state, window)
        return state, window

    def draw(
        self,
        state: State,
        held: Kept | RunningChains,
        draws: int,
        bar: Progress,
        stop: Patience,
    ) -> bool:
        """Make and keep draws; whether it was left to finish."""
        thinning, known, wanted = self.thinning, self.known, held.draws + draws
        counted = self._counting(state, held)
        point: Point | None = None
        try:
            with marking_invalid(), np.errstate(all="ignore"):
                for _ in range(draws):
                    stop.check()
                    for _ in range(thinning):
                        state = self._stepped(state, False)
                        bar.advance()
                    values = self._values(state)
                    if counted is not None:
                        self.diverged.append(counted(state))
                        energies = self.sampler.energies(state)  # type: ignore[attr-defined]
                        if energies is not None:
                            self.energies.append(energies)
                    if known:
                        values = {**known, **values}
                    held.add(values)
                    point = state, self.rng.bit_generator.state, values
                    if self.saving is not None and self.saving.wants(held):
                        self.saving.save(self, point, held)
        except KeyboardInterrupt:
            if not held.draws:
                raise
        if point is not None:
            self.last = Checkpoint(*point, self.observed)
            if self.saving is not None:
                self.saving.save(self, point, held)
        return held.draws == wanted

    def tell_trajectories(self, posterior: Any, before: Any) -> None:
        """Note on a posterior which draws' trajectories diverged, and their energies, after those before."""
        draws = posterior._chains_and_draws[1]
        found: dict[str, np.ndarray] = {}
        if len(self.diverged) > 1:
            counts = np.stack(self.diverged[: draws + 1], axis=1)
            found["divergences"] = np.diff(counts, axis=1) > 0
        if self.energies:
            found["energies"] = np.stack(self.energies[:draws], axis=1)
        for what, rows in found.items():
            earlier = None if before is None else getattr(before, what)
            whole = rows if earlier is None else np.hstack([earlier, rows])
            if whole.shape[1] == draws:  # files of earlier versions have no energies
                setattr(posterior, what, whole)

    def _counting(self, state: State, held: Kept | RunningChains) -> Any:
        """What counts trajectories that diverged, where draws are kept and there are any."""
        count = getattr(self.sampler, "divergences", None)
        if count is None or not isinstance(held, Kept) or count(state) is None:
            return None
        if not self.diverged:
            self.diverged.append(count(state))
        return count

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


class Kept:
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
        #: draws that are no longer held here, since they are in a file
        self.gone = 0

    def begin_with(self, stored: Mapping[str, np.ndarray], draws: int) -> None:
        """Put earlier draws before those that there is room for."""
        self._earlier = stored
        self.room += draws
        self.draws = draws

    def more(self, draws: int) -> None:
        """Make room for some further draws after those in place."""
        stored = self.frozen()
        self.stored, self._moving, self._together, self.room = {}, [], [], draws
        self.begin_with(stored, self.draws)

    def add(self, values: Mapping[str, np.ndarray]) -> None:
        """Take in one draw of every chain."""
        if not self.stored:
            self._make_room(values)
        at = self.draws - self.gone
        for name, array in self._moving:
            array[:, at] = values[name]
        for names, rows in self._together:
            row = [values[n] for n in names]
            try:
                rows[..., at] = np.concatenate(row).reshape(rows.shape[:2])
            except ValueError:  # some of them come without chains this time
                for array, value in zip(rows, row, strict=True):
                    array[:, at] = value
        self.draws += 1

    @property
    def is_full(self) -> bool:
        """Whether there is no room for another draw."""
        return self.draws - self.gone == self.room

    def since(self, first: int) -> dict[str, Any]:
        """Draws from one on, as they are saved: single numbers of a type as one array."""
        part = slice(first - self.gone, self.draws - self.gone)
        moving = {name: array[:, part] for name, array in self._moving}
        together = [(list(names), rows[..., part]) for names, rows in self._together]
        grouped = {n for names, _ in self._together for n in names}
        still = {n: a for n, a in self.stored.items() if n not in moving and n not in grouped}
        return {"moving": moving, "together": together, "still": still}

    def drop(self) -> None:
        """Let go of all draws in place, which are saved."""
        self.gone = self.draws

    def put(self, stored: Mapping[str, np.ndarray]) -> None:
        """Hold other arrays instead, of all draws."""
        self.stored, self._moving, self._together = dict(stored), [], []

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
            dtype = node.stored_dtype(value)
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
            self._earlier = {}
