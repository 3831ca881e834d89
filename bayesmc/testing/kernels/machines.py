"""Engines and kernels of bayesmc as moves of rows, each with data of its own.

A kernel gets a warmup of its own and is frozen; whether it stays so is checked.

Engines read the evidence when they compile, and tests have other data in every row. Where a kernel reads
what is observed only when it steps, rows of data stand in the state in the place of a placeholder
("given"); that it does so is seen on a few data sets, where it must draw, bit for bit, what one compiled
for those data draws. Else every row's data are evidence of their own ("posed"), at the cost of compiling
for each.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.mcmc.chains import ChainEngine
from bayesmc.engines.mcmc.sweep import SweepSampler
from bayesmc.errors import UnsupportedError
from bayesmc.kernels.base import Kernel
from bayesmc.kernels.conjugate import Conjugate
from bayesmc.kernels.ensemble import BlockWalk
from bayesmc.kernels.enumerate import Enumerate, JointStates
from bayesmc.kernels.factor_slice import FactorSlice
from bayesmc.kernels.gaussian_block import GaussianBlock
from bayesmc.kernels.hamiltonian import Hamiltonian
from bayesmc.kernels.jump import Jump
from bayesmc.kernels.labels import Labels
from bayesmc.kernels.lattice import SiteCounts, SiteSums
from bayesmc.kernels.proposed import Proposed, ProposedBlock
from bayesmc.kernels.random_walk import AdaptiveWalk
from bayesmc.kernels.redrawn import Redrawn
from bayesmc.kernels.slice import Slice
from bayesmc.kernels.stacked import Stacked
from bayesmc.kernels.tables import TableSweep
from bayesmc.network import pose
from bayesmc.structure.target import Target, target_of
from bayesmc.testing.kernels.joint import Move, NetJoint, Rows, Statistics
from bayesmc.testing.kernels.steps import positional
from bayesmc.testing.kernels.transition import in_classes
from bayesmc.testing.verdict import Comparison

#: data sets (of so many drawn), rows of each and steps on which two ways to run a kernel are compared
_COMPARED, _DRAWN, _ALIKE, _STEPS = 6, 24, 64, 2
#: sweeps of warmup by default, at most: for all rows at once, and where every data set has its own
_WARMUP, _OWN_WARMUP = 200, 20
#: steps after which a frozen kernel must move as it did at first
_AGED = 60
#: data sets whose compiled kernels are kept
_KEPT = 4000
#: draws of the kit's own are none of those of any test
_ENTROPY = 0x6B1E5_7E57_0F_4B17


def sampler_of(call: str, kernel: Any, problem: Any) -> SweepSampler:
    """The sampler of an engine, of a kernel of ours, or of a function that makes one of a target."""
    if isinstance(kernel, ChainEngine):
        found: Any = kernel.sampler(problem)
    elif isinstance(kernel, Kernel):
        target = getattr(getattr(kernel, "blanket", kernel), "target", None)
        if not isinstance(target, Target):
            raise UnsupportedError(
                f"{call}: {type(kernel).__name__} does not say which target it moves; give a function that "
                f"makes one of a target, such as lambda target: {type(kernel).__name__}(...)"
            )
        found = SweepSampler(target, [kernel])
    elif callable(kernel) and positional(kernel) == 1:
        target = target_of(problem)
        made = kernel(target)
        if not isinstance(made, Kernel):
            raise UnsupportedError(
                f"{call}: {kernel!r} made {type(made).__name__} of a target, not a bayesmc kernel; a "
                "function of your own takes two arguments, step(state, rng)"
            )
        found = SweepSampler(target, [made])
    else:
        raise UnsupportedError(
            f"{call}: {kernel!r} moves no states; give an engine of Markov chains (Gibbs(...), "
            "MetropolisHastings(...)), a function step(state, rng) -> state, or one that makes a "
            "bayesmc kernel of a target"
        )
    if not isinstance(found, SweepSampler):
        raise UnsupportedError(
            f"{call}: the sampler of {kernel!r} is no sweep of kernels over a net"
        )
    return found


@dataclass(frozen=True, eq=False)
class _Moving:
    """Rows of a state with the memories of the kernels that move it."""

    values: Rows
    memory: Any = None


class Machine:
    """An engine's sweep on rows of states, each with data of its own.

    Where chains are ensembles, a row of the test is one ensemble, whose members have data of their own:
    then all members are independent under the joint law.
    """

    def __init__(self, call: str, kernel: Any, joint: NetJoint, warmup: int | None) -> None:
        self.call, self.kernel, self.joint = call, kernel, joint
        rng = private_stream(1)
        state = joint.prior(rng, 1)
        self.placeholder = joint.simulate(state, rng)
        self.sampler = self._compiled(self.placeholder)
        self.members = int(getattr(self.sampler, "ensemble", 1))
        trusted = not isinstance(kernel, ChainEngine)
        self.reversed, self.why, self.is_own_reverse = _reversed(
            call, self.sampler.kernels, trusted
        )
        self.is_given = not joint.observed or self._is_given(rng)
        most = _WARMUP if self.is_given else _OWN_WARMUP
        asked = getattr(kernel, "warmup", None)  # None where the engine chooses
        own = most if asked is None else min(asked, most)
        self.warmup = own if warmup is None else warmup
        if not self.is_given and self.members > 1:
            raise UnsupportedError(
                f"{call}: {kernel!r} moves ensembles, and reads what is observed when it compiles; test it "
                "with simulation_based_calibration"
            )
        self.faults: tuple[Comparison, ...] = ()
        self._posed: dict[bytes, Any] = {}
        self._memory: dict[int, Any] = {}

    # ---- what tests take -----------------------------------------------------------------------

    def prior(self, rng: np.random.Generator, rows: int) -> _Moving:
        values = self.joint.prior(rng, rows * self.members)
        return _Moving(values, self._frozen(rows * self.members) if self.is_given else None)

    def simulate(self, state: _Moving, rng: np.random.Generator) -> Rows:
        return self.joint.simulate(state.values, rng)

    def grouped(self, statistics: Statistics) -> Statistics:
        """Statistics of rows: of an ensemble, means over its members and products of two."""
        found: dict[str, Callable[[_Moving, Rows], Any]] = {}
        for name, statistic in statistics.items():
            found[name] = partial(self._mean, statistic)
            if self.members > 1:
                found[f"{name}, two members"] = partial(self._two, statistic)
        return found

    def forward(self, state: _Moving, data: Rows, rng: np.random.Generator) -> _Moving:
        return self._step(state, data, rng, backwards=False)

    def from_elsewhere(self, state: _Moving, data: Rows, rng: np.random.Generator) -> _Moving:
        """A step from the state of another machine, by its own frozen kernels."""
        memory = self._frozen(len(next(iter(state.values.values())))) if self.is_given else None
        return self.forward(_Moving(state.values, memory), data, rng)

    @property
    def backward(self) -> Move | None:
        if self.reversed is None:
            return None
        return lambda state, data, rng: self._step(state, data, rng, backwards=True)

    def prepare(self, rows: int) -> None:
        """Look for what is wrong for certain: a kernel that goes on learning."""
        rows = min(rows, 8) * self.members
        rng = private_stream(3)
        values = self.joint.prior(rng, rows)
        data = self.joint.simulate(values, rng)
        if not self.is_given:
            self.sampler = self._compiled({n: v[:1] for n, v in data.items()})
            values, data, rows = {n: v[:1] for n, v in values.items()}, {}, 1
        memory = self._warmed(self.sampler, values, rng, data)
        aged, now = memory, values
        for _ in range(_AGED):
            now, aged = _swept(self.sampler, self.sampler.kernels, now, data, aged, rng)
        faults = []
        for i, kernel in enumerate(self.sampler.kernels):
            if not self._moves_alike(i, values, data, memory, aged):
                what = f"kernel of {', '.join(map(repr, kernel.names))} goes on adapting after the warmup"
                faults.append(Comparison(what, 1.0, 0.0, np.inf, 0.0))
        self.faults = tuple(faults)

    # ---- private -------------------------------------------------------------------------------

    def _each(self, statistic: Callable[..., Any], state: _Moving, data: Rows) -> np.ndarray:
        value = np.asarray(statistic(state.values, data), dtype=float)
        return value.reshape(-1, self.members, *value.shape[1:])

    def _mean(self, statistic: Callable[..., Any], state: _Moving, data: Rows) -> np.ndarray:
        return self._each(statistic, state, data).mean(axis=1)

    def _two(self, statistic: Callable[..., Any], state: _Moving, data: Rows) -> np.ndarray:
        return self._each(statistic, state, data)[:, :2].prod(axis=1)

    def _compiled(self, data: Rows, row: int = 0) -> SweepSampler:
        problem = pose(self.joint.net, self.joint.evidence(data, row), self.joint.user_inputs)
        sampler = sampler_of(self.call, self.kernel, problem)
        if not sampler.kernels:
            raise UnsupportedError(
                f"{self.call}: {self.kernel!r} has no kernel to test: nothing observed depends on what is "
                "hidden, so all of it is drawn forward"
            )
        return sampler

    def _is_given(self, rng: np.random.Generator) -> bool:
        """Whether the kernels read what is observed only when they step.

        Few data sets are not tried: to compile for each is cheap, and among few a rare one would be missed.
        """
        sets = self._data_sets(rng)
        if len(sets) < _COMPARED:
            return False
        for k, (state, data) in enumerate(sets[:_COMPARED]):
            alike = _ALIKE if self.members == 1 else self.members
            state, many = _repeated(state, alike), _repeated(data, alike)
            posed = self._compiled(data)
            if [k.label for k in posed.kernels] != [k.label for k in self.sampler.kernels]:
                return False
            found = []
            for sampler, rows in ((self.sampler, many), (posed, {})):
                values, draws = state, private_stream(6, k)
                try:
                    memory = _started(sampler, values, rows)
                    for _ in range(_STEPS):
                        values, memory = _swept(
                            sampler, sampler.kernels, values, rows, memory, draws
                        )
                except ValueError:  # rows of data do not fit where it has one observation in mind
                    if sampler is posed:
                        raise
                    return False
                found.append(values)
            if not all(np.allclose(found[0][n], found[1][n], rtol=1e-9) for n in found[0]):
                return False
        return True

    def _data_sets(self, rng: np.random.Generator) -> list[tuple[Rows, Rows]]:
        """A few draws of the joint law whose data are unlike the placeholder and each other."""
        kept: dict[bytes, tuple[Rows, Rows]] = {_key(self.placeholder): ({}, {})}
        for _ in range(_DRAWN):
            state = self.joint.prior(rng, 1)
            data = self.joint.simulate(state, rng)
            kept.setdefault(_key(data), (state, data))
        finite = all(self.joint.model[n].domain is not None for n in self.joint.observed)
        found = list(kept.values())[1:]
        return [] if finite and len(found) <= _DRAWN // 2 else found

    def _frozen(self, rows: int) -> Any:
        if rows not in self._memory:
            rng = private_stream(2)
            values = self.joint.prior(rng, rows)
            data = self.joint.simulate(values, rng)
            self._memory[rows] = self._warmed(self.sampler, values, rng, data)
        return self._memory[rows]

    def _warmed(
        self, sampler: SweepSampler, values: Rows, rng: np.random.Generator, data: Rows
    ) -> Any:
        """Frozen memories after a warmup from a state of its own; data stay what they are."""
        memory = _started(sampler, values, data)
        if any(memory):
            for _ in range(self.warmup):
                values, memory = _swept(sampler, sampler.kernels, values, data, memory, rng, True)
        return [k.end_warmup(m) for k, m in zip(sampler.kernels, memory, strict=True)]

    def _moves_alike(self, i: int, values: Rows, data: Rows, young: Any, aged: Any) -> bool:
        found = []
        for memory in (young, aged):
            sampler, draws = self.sampler, private_stream(4)
            full = _placed(sampler.target, values, data)
            with marking_invalid(), np.errstate(all="ignore"):
                new, _ = sampler.kernels[i].step(full, memory[i], draws, False)
            found.append(new)
        return all(np.array_equal(found[0][n], found[1][n]) for n in found[0])

    def _step(
        self, state: _Moving, data: Rows, rng: np.random.Generator, backwards: bool
    ) -> _Moving:
        if self.is_given:
            kernels = self.reversed if backwards else self.sampler.kernels
            memory = state.memory[::-1] if backwards else state.memory
            values, memory = _swept(self.sampler, kernels or (), state.values, data, memory, rng)
            return _Moving(values, memory[::-1] if backwards else memory)
        return _Moving(self._step_posed(state.values, data, rng, backwards))

    def _step_posed(
        self, state: Rows, data: Rows, rng: np.random.Generator, backwards: bool
    ) -> Rows:
        rows = len(next(iter(state.values())))
        alike: dict[bytes, list[int]] = {}
        for row in range(rows):
            alike.setdefault(_key(data, row), []).append(row)
        found = {n: np.array(v) for n, v in state.items()}
        for key, members in alike.items():
            if len(self._posed) > _KEPT:
                self._posed.clear()
            if key not in self._posed:
                self._posed[key] = self._own(data, members[0])
            sampler, memory, back = self._posed[key]
            kernels, each = (back, memory[::-1]) if backwards else (sampler.kernels, memory)
            part = {n: v[members] for n, v in state.items()}
            wide = _for_rows(each, len(members))
            new, _ = _swept(sampler, kernels, part, {}, wide, rng)
            for name, value in new.items():
                found[name][members] = value
        return found

    def _own(self, data: Rows, row: int) -> tuple[SweepSampler, Any, Sequence[Kernel]]:
        sampler = self._compiled(data, row)
        rng = private_stream(5)
        with marking_invalid(), np.errstate(all="ignore"):
            start = sampler.start(rng, 1)["values"]  # possible given these data, whatever they are
        memory = self._warmed(sampler, {n: start[n] for n in sampler.target.chain}, rng, {})
        back, _, _ = _reversed(self.call, sampler.kernels, trusted=True)
        return sampler, memory, back or ()


def private_stream(*key: int) -> np.random.Generator:
    """Random numbers of the kit's own, for what it prepares before a test."""
    return np.random.default_rng(np.random.SeedSequence(_ENTROPY, spawn_key=key))


def _started(sampler: SweepSampler, values: Rows, data: Rows) -> list[Any]:
    full = _placed(sampler.target, values, data)
    rows = len(next(iter(values.values())))
    with marking_invalid(), np.errstate(all="ignore"):
        return [kernel.start(full, rows) for kernel in sampler.kernels]


def _swept(
    sampler: SweepSampler,
    kernels: Sequence[Kernel],
    state: Rows,
    data: Rows,
    memory: Sequence[Any],
    rng: np.random.Generator,
    warmup: bool = False,
) -> tuple[Rows, list[Any]]:
    """One sweep of all rows, and a draw of what the engine draws forward."""
    target, after = sampler.target, list(memory)
    values = _placed(target, state, data)
    if (
        not data
    ):  # else kernels see that rows have data of their own, and keep nothing of their place
        memory = [k.moved(values, m) for k, m in zip(kernels, memory, strict=True)]
    rows = len(next(iter(state.values())))
    with marking_invalid(), np.errstate(all="ignore"):
        for i, kernel in enumerate(kernels):
            new, after[i] = kernel.step(values, memory[i], rng, warmup)
            values.update(new)
            target.refresh(values, kernel.names)
        outside = [n for n in state if n not in target.chain]
        if outside:
            drawn = {n: v for n, v in values.items() if n not in target.forward or n in data}
            values |= sampler.completed(drawn, rows, rng)
    return {n: values[n] for n in state}, after


def _placed(target: Target, state: Rows, data: Rows) -> Rows:
    """Values of all nodes of the chain and above: what is known, rows of data in the place of evidence."""
    values: Rows = {**target.known, **data, **state}
    with marking_invalid(), np.errstate(all="ignore"):
        target.refresh(values, target.chain)
    return values


def _key(data: Rows, row: int = 0) -> bytes:
    return b"".join(v[row].tobytes() for v in data.values())


def _repeated(rows: Rows, count: int) -> Rows:
    return {n: np.repeat(v, count, axis=0) for n, v in rows.items()}


def _for_rows(memory: Iterable[Any], rows: int) -> list[Any]:
    """Memories of one row as those of several: what has an entry for each row is repeated."""

    def wide(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {k: wide(v) for k, v in value.items()}
        if isinstance(value, np.ndarray) and value.ndim and len(value) == 1:
            return np.repeat(value, rows, axis=0)
        return value

    return [wide(m) for m in memory]


def _reversed(
    call: str, kernels: Sequence[Kernel], trusted: bool
) -> tuple[tuple[Kernel, ...] | None, str, bool]:
    """The kernels of the time-reversed sweep; None, and why, where one of them is not known.

    The third answer says whether a kernel that is not known was taken for its own reverse: one that a user
    brought (``trusted``), as functions are.
    """
    found, taken = [], False
    for kernel in reversed(kernels):
        back = _reverse_of(kernel)
        if back is None and trusted:
            back, taken = kernel, True
        if back is None:
            shown = ", ".join(map(repr, kernel.names))
            why = (
                f"{call}: of the kernel of {shown} ({kernel.label}) its reverse is not known; give reverse= "
                "(the same again, if it is its own reverse), or use geweke_test or "
                "simulation_based_calibration"
            )
            return None, why, False
        found.append(back)
    return tuple(found), "", taken


def _reverse_of(kernel: Any) -> Kernel | None:
    """The reverse of a kernel that is known: itself, or its parts in the other order."""
    if isinstance(kernel, TableSweep):
        return _with(kernel, groups=kernel.groups[::-1])
    if isinstance(kernel, FactorSlice):
        return _with(kernel, order=kernel.order[::-1])
    if isinstance(kernel, Stacked):
        inner = _reverse_of(kernel.kernel)
        return None if inner is None else _with(kernel, kernel=inner)
    if isinstance(kernel, Slice):
        back = in_classes(kernel, kernel.blanket.classes[::-1])
        return _with(back, components=kernel.components[::-1])
    if isinstance(kernel, (AdaptiveWalk, Enumerate, Jump, Proposed)):
        return in_classes(kernel, kernel.blanket.classes[::-1])
    if isinstance(kernel, Redrawn):
        return _with(kernel, from_last=not kernel.from_last) if kernel.turns == 1 else None
    if isinstance(kernel, (BlockWalk, GaussianBlock, Hamiltonian, JointStates, ProposedBlock)):
        return kernel
    if isinstance(kernel, (Conjugate, Labels, SiteCounts, SiteSums)):
        return kernel if len(kernel.blanket.classes) == 1 else None
    return None


def _with(kernel: Kernel, /, **changes: Any) -> Kernel:
    other = copy.copy(kernel)
    for name, value in changes.items():
        setattr(other, name, value)
    return other
