"""Geweke's test and the rank test put to the kernels of real models, each with deliberate errors.

A `Model` is a net whose hidden nodes are the state of the tests and whose observed nodes are the data; both
are drawn from the net itself, forwards. A `Case` is a kernel on a model and faults that both tests must find.
Every row of a test has its own data. Kernels get them in one of three ways:

* ``given``: the evidence is a placeholder, and rows of data stand in the state in its place; for kernels that
  read what is observed when they step.
* ``moving``: the data's nodes are hidden and belong to the chain, but nothing moves them; for any kernel.
* ``posed``: every row's data are evidence of their own; for what kernels work out of the evidence beforehand.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

import bayesmc as bmc
from bayesmc.distributions.base import marking_invalid
from bayesmc.kernels.base import Kernel, Memory
from bayesmc.network import pose
from bayesmc.structure.target import Target, Values, target_of
from bayesmc.testing import JointModel, geweke_test, rank_test, session
from bayesmc.testing.kernels.joint import NetJoint

#: shifts all seeds; in a thorough run, tests are longer, too
SHIFT, LONGER = session.seed(), session.scaled(1)
#: chance that a right kernel fails one test at a fresh seed
ALPHA = 1e-4

#: the two tests
TESTS = ("geweke", "ranks")

T = TypeVar("T")
Rows = dict[str, np.ndarray]
Statistic = Callable[[Rows, Rows], np.ndarray]


class Still(Kernel):
    """Moves nothing: what stands beside it is tested alone."""

    def __init__(self, names: Sequence[str]) -> None:
        self.names = tuple(names)

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        return {n: values[n] for n in self.names}, memory


@dataclass(frozen=True, eq=False)
class Model:
    """A net, what of it is data, and how to draw both.

    Attributes
    ----------
    seen : tuple of str
        The data; no hidden node depends on them.
    moved : tuple of str
        Nodes that statistics look at; all hidden ones by default.
    draw : callable, optional
        ``draw(rng, n)``: hidden nodes from their prior, where the net cannot be drawn forwards.
    respond : callable, optional
        ``respond(state, rng)``: data, in the same case.
    """

    net: Any
    seen: tuple[str, ...]
    moved: tuple[str, ...] = ()
    draw: Callable[[np.random.Generator, int], Rows] | None = None
    respond: Callable[[Rows, np.random.Generator], Rows] | None = None
    _targets: dict[str, Target] = field(default_factory=dict)

    @property
    def compiled(self) -> Any:
        return self.target("moving").model

    def target(self, how: str) -> Target:
        """The posed model with placeholders for data, or with data that are hidden."""
        if how not in self._targets:
            if how == "moving":
                found = target_of(pose(self.net, {}), also=self._stochastic())
            else:
                placeholder = self.data(self.prior(np.random.default_rng(0), 1))
                found = target_of(pose(self.net, self.user(placeholder)))
            self._targets[how] = found
        return self._targets[how]

    def _stochastic(self) -> list[str]:
        model = pose(self.net, {}).model
        return [n for n, node in model.nodes.items() if node.is_stochastic]

    @property
    def hidden(self) -> tuple[str, ...]:
        return tuple(n for n in self.target("moving").chain if n not in self.seen)

    def user(self, data: Rows, row: int = 0) -> dict[str, Any]:
        """One row of stored data as evidence."""
        return {n: self.compiled[n].decode(v[row]) for n, v in data.items()}

    def prior(self, rng: np.random.Generator, rows: int) -> Rows:
        return self._joint.prior(rng, rows) if self.draw is None else self.draw(rng, rows)

    def data(self, state: Rows, rng: np.random.Generator | int = 0) -> Rows:
        rng = np.random.default_rng(rng) if isinstance(rng, int) else rng
        return (
            self._joint.simulate(state, rng) if self.respond is None else self.respond(state, rng)
        )

    @cached_property
    def _joint(self) -> NetJoint:
        return NetJoint(self.net, self.seen)

    def statistics(self) -> dict[str, Statistic]:
        """Numbers that show wrong places, spreads and dependences of what moves."""
        target = self.target("moving")
        first = self.seen[0]

        def log_density(state: Rows, data: Rows) -> np.ndarray:
            values = {**target.known, **state, **data}
            with running():
                target.refresh(values, target.chain)
                return np.asarray(target.log_density(values))

        def fit(name: str) -> Statistic:
            return lambda s, y: self._free(name, s)[:, 0] * np.arctan(_flat(y[first]).mean(axis=1))

        found: dict[str, Statistic] = {"log density": log_density}
        for name in self.moved or self.hidden:
            found |= {
                f"first of {name}": lambda s, y, n=name: self._free(n, s)[:, 0],
                f"square of {name}": lambda s, y, n=name: (self._free(n, s) ** 2).mean(axis=1),
                f"{name} and {first}": fit(name),
            }
            if math.prod(self.compiled[name].value_shape) > 1:
                found |= {
                    f"last of {name}": lambda s, y, n=name: self._free(n, s)[:, -1],
                    f"product of {name}": lambda s, y, n=name: self._free(n, s)[:, :2].prod(axis=1),
                }
        return found

    def _free(self, name: str, state: Rows) -> np.ndarray:
        """A node's numbers, those above zero as logarithms: heavy tails make means uncertain."""
        node = self.compiled[name]
        value = _flat(state[name])
        support = node.support
        if node.domain is None and support is not None and support.kind == "interval":
            if np.all(support.low == 0) and np.all(support.high == np.inf):
                return np.log(value)
        if support is not None and support.kind == "positive definite":
            diagonal = np.diagonal(state[name], axis1=-2, axis2=-1)
            ratio = state[name][..., 0, 1] / np.sqrt(diagonal.prod(axis=-1))
            return np.concatenate([_flat(np.log(diagonal)), _flat(ratio)], axis=1)
        return value


Make = Callable[[Target], Kernel]


@dataclass(frozen=True, eq=False)
class Case:
    """A kernel on a model.

    Attributes
    ----------
    make : callable
        The kernel of a target.
    faults : dict
        Name -> a wrong kernel.
    reverse : callable, optional
        ``reverse(make, target, memory)``: the reverse of a kernel, and its memory; by default itself.
    how : str
        How it gets data: ``given``, ``moving`` or ``posed``.
    warmup : int
        Steps in which it adapts before it is tested.
    pilots : int, optional
        Rows that it adapts with, where its memory does not depend on their number.
    statistics : dict
        Of its own, besides those of the model.
    sizes : dict
        Options of the tests, where errors are harder to see than elsewhere.
    members : int
        Rows that a kernel moves in dependence of each other: an ensemble is then one state of the tests,
        every member with data of its own, so that all are independent under the joint law.
    """

    model: Model
    make: Make
    faults: Mapping[str, Make] = field(default_factory=dict)
    reverse: Callable[[Make, Target, Memory], tuple[Kernel, Memory]] | None = None
    how: str = "given"
    warmup: int = 0
    pilots: int | None = None
    statistics: Mapping[str, Statistic] = field(default_factory=dict)
    sizes: Mapping[str, int] = field(default_factory=dict)
    members: int = 1
    _memories: dict[tuple[str, int], Memory] = field(default_factory=dict)

    def geweke(self, fault: str = "", seed: int = 0, **sizes: Any) -> Any:
        own = {k: v for k, v in self.sizes.items() if k in ("draws", "chains")}
        sizes = {"draws": 30, "chains": 160, **own, **sizes}
        sizes["draws"] *= LONGER
        kernel, _ = self._kernels(fault, sizes["chains"])
        return geweke_test(kernel, self._joint(), alpha=ALPHA, rng=seed + SHIFT, **sizes)

    def ranks(self, fault: str = "", seed: int = 0, **sizes: Any) -> Any:
        own = {k: v for k, v in self.sizes.items() if k in ("steps", "replications", "thinning")}
        sizes = {"steps": 4, "replications": 1000, **own, **sizes}
        sizes["replications"] *= LONGER
        kernel, reverse = self._kernels(fault, sizes["replications"])
        return rank_test(kernel, self._joint(), reverse, alpha=ALPHA, rng=seed + SHIFT, **sizes)

    def check(self, test: str, fault: str = "", **sizes: Any) -> None:
        """A right kernel passes, a wrong one fails."""
        result = (self.geweke if test == "geweke" else self.ranks)(fault, **sizes)
        assert bool(result) != bool(fault), result

    # ---- private -------------------------------------------------------------------------------

    def _joint(self) -> JointModel:
        return JointModel(self._prior, self._data, self._statistics())

    def _prior(self, rng: np.random.Generator, rows: int) -> Rows:
        return self._grouped(self.model.prior(rng, rows * self.members))

    def _data(self, state: Rows, rng: np.random.Generator) -> Rows:
        return self._grouped(self.model.data(self._flat(state), rng))

    def _grouped(self, rows: Rows) -> Rows:
        """Members of an ensemble side by side, on a second axis."""
        if self.members == 1:
            return rows
        return {n: v.reshape(-1, self.members, *v.shape[1:]) for n, v in rows.items()}

    def _flat(self, rows: Rows) -> Rows:
        if self.members == 1:
            return rows
        return {n: v.reshape(-1, *v.shape[2:]) for n, v in rows.items()}

    def _statistics(self) -> dict[str, Statistic]:
        """Of ensembles: means over their members, and products of two."""
        plain = {**self.model.statistics(), **self.statistics}
        if self.members == 1:
            return plain
        found: dict[str, Statistic] = {}
        for name, statistic in plain.items():

            def each(s: Rows, y: Rows, statistic: Statistic = statistic) -> np.ndarray:
                return statistic(self._flat(s), self._flat(y)).reshape(-1, self.members)

            found[f"{name}, mean"] = lambda s, y, each=each: each(s, y).mean(axis=1)
            found[f"{name}, two members"] = lambda s, y, each=each: each(s, y)[:, :2].prod(axis=1)
        return found

    def _kernels(self, fault: str, rows: int) -> tuple[Callable, Callable]:
        make = self.faults[fault] if fault else self.make
        if self.how == "posed":
            return self._posed(make, False), self._posed(make, True)
        target = self.model.target(self.how)
        with running():
            kernel = make(target)
            pilots = self.pilots or rows * self.members
            key = (fault, pilots)
            if key not in self._memories:
                self._memories[key] = self._adapted(kernel, target, pilots)
            memory = self._memories[key]
            other, theirs = kernel, memory
            if self.reverse is not None:
                other, theirs = self.reverse(make, target, memory)
        return self._stepping(target, kernel, memory), self._stepping(target, other, theirs)

    def _stepping(self, target: Target, kernel: Kernel, memory: Memory) -> Callable:
        def step(state: Rows, data: Rows, rng: np.random.Generator) -> Rows:
            with running():
                values = _placed(target, self._flat(state), self._flat(data))
                new, _ = kernel.step(values, memory, rng, False)
            return {**state, **self._grouped({n: new[n] for n in state if n in new})}

        return step

    def _adapted(self, kernel: Kernel, target: Target, rows: int) -> Memory:
        """The memory after the warmup, which has draws of its own."""
        rng = np.random.default_rng(12345 + SHIFT)
        state = self.model.prior(rng, rows)
        data = self.model.data(state, rng)
        values = _placed(target, state, data)
        memory = kernel.start(values, rows)
        for _ in range(self.warmup):
            new, memory = kernel.step(values, memory, rng, True)
            values = _placed(target, {**state, **new}, data)
            state = {n: values[n] for n in state}
        return kernel.end_warmup(memory)

    def _posed(self, make: Make, backwards: bool) -> Callable:
        made: dict[bytes, tuple[Target, Kernel, Memory]] = {}

        def one(data: Rows, row: int) -> tuple[Target, Kernel, Memory]:
            target = target_of(pose(self.model.net, self.model.user(data, row)))
            state = self.model.prior(np.random.default_rng(1), 1)
            kernel = make(target)
            memory = kernel.start({**target.known, **state}, 1)
            if backwards and self.reverse is not None:
                kernel, memory = self.reverse(make, target, memory)
            return target, kernel, kernel.end_warmup(memory)

        def step(state: Rows, data: Rows, rng: np.random.Generator) -> Rows:
            keys = [
                b"".join(v[row].tobytes() for v in data.values()) for row in range(_rows(state))
            ]
            alike: dict[bytes, list[int]] = {}
            for row, key in enumerate(keys):
                alike.setdefault(key, []).append(row)
            found = {n: v.copy() for n, v in state.items()}
            with running():
                for key, rows in alike.items():
                    if key not in made:
                        made[key] = one(data, rows[0])
                    target, kernel, memory = made[key]
                    values = _placed(target, {n: v[rows] for n, v in state.items()}, {})
                    new, _ = kernel.step(values, memory, rng, False)
                    for name in found.keys() & new.keys():
                        found[name][rows] = new[name]
            return found

        return step


@contextmanager
def running() -> Iterator[None]:
    """What engines set while chains run."""
    with marking_invalid(), np.errstate(all="ignore"):
        yield


def each_fault(cases: Mapping[str, Case]) -> list[tuple[str, str]]:
    """All kernels with each of their faults, and each without."""
    return [(name, fault) for name, case in cases.items() for fault in ("", *case.faults)]


def each_test(cases: Mapping[str, Case]) -> list[tuple[str, str, str]]:
    """Names, faults and tests: all with both tests in a thorough run.

    In an ordinary run the tests take turns at kernels, whose faults the same test has to see.
    """
    return in_turn(each_fault(cases))


def in_turn(kernels: Sequence[tuple[T, str]]) -> list[tuple[T, str, str]]:
    """The same of pairs of a name, or what else is meant, and a fault."""
    turn = itertools.cycle(TESTS)
    own = {name: next(turn) for name in dict.fromkeys(name for name, _ in kernels)}
    return [
        (name, fault, test)
        for name, fault in kernels
        for test in (TESTS if session.is_thorough() else (own[name],))
    ]


def backwards(make: Make, target: Target, memory: Memory) -> tuple[Kernel, Memory]:
    """The reverse of a kernel with a blanket: elements of different colours move in the other order."""
    kernel: Any = make(target)
    kernel.blanket.classes = kernel.blanket.classes[::-1]
    return kernel, memory


def mixture(prior: Any, child: Callable[..., Any], points: int = 12) -> bmc.BayesNet:
    """A node ``x`` in three overlapping categories, and children ``y`` that look it up by ``label``."""
    net = bmc.BayesNet(plates={"k": 3, "i": points})
    net.add("x", prior, plates="k")
    net.add("label", bmc.Categorical([0.2, 0.3, 0.5]), plates="i")
    net.add("y", lambda x, label: child(x[label]), plates="i")
    return net


# ---- private ------------------------------------------------------------------------------------


def _rows(state: Rows) -> int:
    return len(next(iter(state.values())))


def _flat(value: np.ndarray) -> np.ndarray:
    return value.reshape(len(value), -1).astype(float)


def _placed(target: Target, state: Rows, data: Rows) -> Values:
    values = {**target.known, **data, **state}
    target.refresh(values, target.chain)
    return values
