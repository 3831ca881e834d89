"""Is a posterior over finitely many states the law that a kernel keeps, and does it keep detailed balance?

Where the transition matrix can be had, the answer is exact: kernels of bayesmc are read from the code
that draws (`transition`), and chains bring their own. Functions that a user wrote are run from draws of
the exact posterior, and their steps are counted; the counts have binomial laws, so that no limit is
needed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.special

from bayesmc.engines.mcmc.chains import ChainEngine
from bayesmc.errors import BudgetError, ShapeError, UnsupportedError
from bayesmc.kernels.base import Kernel
from bayesmc.network import BayesNet, FactorGraph, pose
from bayesmc.randomness import seed_sequence
from bayesmc.testing.kernels.joint import NetStates, Rows, check_sizes
from bayesmc.testing.kernels.machines import sampler_of
from bayesmc.testing.kernels.steps import StepFunction, is_step
from bayesmc.testing.kernels.transition import KernelMatrix, Sweep, exact_sweep
from bayesmc.testing.oracles.enumeration import enumerate_posterior
from bayesmc.testing.verdict import Comparison, Verdict, check_level, counted

#: joint states, at most
_STATES = 1024
#: rounding that exact answers may show, and steps of the coarsest random number
_ROUNDING, _STEPS = 1e-9, 16.0
#: states of which fewer are expected are taken together
_RARE = 5.0


def invariant(
    kernel: Any,
    net: BayesNet | FactorGraph,
    evidence: Mapping[str, Any] | None = None,
    *,
    inputs: Mapping[str, Any] | None = None,
    draws: int = 20_000,
    batched: bool = False,
    alpha: float = 1e-3,
    rng: Any = None,
) -> Verdict:
    """Does one step of a kernel leave the posterior of a finite net as it is?

    Exact for engines and kernels of bayesmc, whose transition matrix is read from the code that draws,
    and for anything with a ``transition`` matrix: ``p P = p``, to rounding, for every kernel of a sweep.
    A function ``step(state, rng) -> state`` is run once from each of ``draws`` independent draws of the
    exact posterior; then the states after the step are draws of it, too, which binomial tails judge: each
    joint state, each state of each node, and that no state of probability zero was reached. The chance of
    a false alarm is at most ``alpha`` (Holm's method), and zero where the answer is exact.

    Parameters
    ----------
    kernel : engine, callable, bayesmc kernel, or MarkovChain
        As `geweke_test` takes it; or an object with ``transition``, shape (K, K), and ``states``, the K joint
        states of the hidden nodes in the order of the net, each a tuple (one label for a single node).
    net : BayesNet or FactorGraph
        Its hidden nodes are finite, with at most 1024 joint states (a function needs a BayesNet).
    evidence, inputs : dict, optional
    draws : int
        Steps of a function that are counted.
    batched : bool
        Whether ``step`` takes and returns arrays with one row for each of many states.
    alpha : float
        Chance of any false alarm.
    rng : optional
        Seed or generator.

    Returns
    -------
    Verdict
        True where the posterior is kept.

    Raises
    ------
    UnsupportedError
        Hidden nodes with infinitely many values, or a kernel that cannot be read.
    BudgetError
        Too many states.

    References
    ----------
    Tierney (1994), Markov chains for exploring posterior distributions, Annals of Statistics 22, sec. 2.

    Examples
    --------
    Two binary nodes that agree more often than not. To update both given each other's *old* value, as if
    they did not meet, does not keep their law.

    >>> import bayesmc as bmc
    >>> from bayesmc.testing import invariant
    >>> net = bmc.BayesNet()
    >>> net.add("a", bmc.Bernoulli(0.5))
    >>> net.add("b", lambda a: bmc.Bernoulli(0.1 + 0.8 * a))
    >>> def together(state, rng):
    ...     return {"a": rng.random() < 0.1 + 0.8 * state["b"], "b": rng.random() < 0.1 + 0.8 * state["a"]}
    >>> def in_turn(state, rng):
    ...     a = rng.random() < 0.1 + 0.8 * state["b"]
    ...     return {"a": a, "b": rng.random() < 0.1 + 0.8 * a}
    >>> bool(invariant(together, net, draws=2000, rng=0)), bool(invariant(in_turn, net, draws=2000, rng=0))
    (False, True)
    """
    check_level("invariant", alpha)
    law, found = _prepared("invariant", kernel, net, evidence, inputs, draws, batched, rng)
    if isinstance(found, Sweep):
        tolerance = _ROUNDING + _STEPS * found.resolution
        parts = [
            *found.updates,
            *found.kernels,
            KernelMatrix((), "the whole sweep", found.matrix, 0.0),
        ]
        return Verdict("invariant", alpha, [_kept(part, law, tolerance) for part in parts])
    comparisons = [*_left(law, found), *_joint(law, found), *_single(law, found)]
    return counted(Verdict("invariant", alpha, comparisons))


def detailed_balance(
    kernel: Any,
    net: BayesNet | FactorGraph,
    evidence: Mapping[str, Any] | None = None,
    *,
    inputs: Mapping[str, Any] | None = None,
    draws: int = 20_000,
    batched: bool = False,
    alpha: float = 1e-3,
    rng: Any = None,
) -> Verdict:
    """Does a kernel go from one state to another as often as back, under the posterior of a finite net?

    Exact where `invariant` is; of an engine each single update is judged, as sweeps of several updates in
    fixed order keep the posterior, but not detailed balance. (An update of a lattice takes its colours in
    turn, too, and is judged as it is.) For a function, steps are counted from draws
    of the exact posterior: under detailed balance the steps between two states go either way with
    probability one half, which is a binomial law whatever the kernel. Detailed balance implies
    invariance; a function may be right without it.

    Parameters
    ----------
    kernel, net, evidence, inputs, draws, batched, alpha, rng
        As `invariant` takes them.

    Returns
    -------
    Verdict
        True where detailed balance holds.

    Raises
    ------
    UnsupportedError, BudgetError
        As `invariant`.

    References
    ----------
    Tierney (1994), Annals of Statistics 22, sec. 2.

    Examples
    --------
    A cycle through three states keeps the even law, but goes round one way only.

    >>> import bayesmc as bmc
    >>> from bayesmc.testing import detailed_balance, invariant
    >>> net = bmc.BayesNet()
    >>> net.add("a", bmc.Categorical([1 / 3, 1 / 3, 1 / 3]))
    >>> def cycle(state, rng):
    ...     return {"a": (state["a"] + 1) % 3}
    >>> bool(invariant(cycle, net, draws=1000, rng=0)), bool(detailed_balance(cycle, net, draws=1000, rng=0))
    (True, False)
    """
    check_level("detailed_balance", alpha)
    law, found = _prepared("detailed_balance", kernel, net, evidence, inputs, draws, batched, rng)
    if isinstance(found, Sweep):
        tolerance = _ROUNDING + _STEPS * found.resolution
        balanced = [_balanced(part, law, tolerance) for part in found.updates]
        return Verdict("detailed_balance", alpha, balanced)
    comparisons = [*_left(law, found), *_either_way(law, found)]
    return counted(Verdict("detailed_balance", alpha, comparisons))


# ---- private ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Law:
    """The posterior over joint states."""

    states: tuple[tuple[Any, ...], ...]
    elements: tuple[str, ...]
    probs: np.ndarray

    def named(self, i: int) -> str:
        pairs = zip(self.elements, self.states[i], strict=True)
        return "(" + ", ".join(f"{name}={value!r}" for name, value in pairs) + ")"


@dataclass(frozen=True, eq=False)
class _Counted:
    """Steps of a function from draws of the law: numbers of states, -1 outside of its support."""

    before: np.ndarray
    after: np.ndarray


def _prepared(
    call: str,
    kernel: Any,
    net: Any,
    evidence: Any,
    inputs: Any,
    draws: int,
    batched: bool,
    rng: Any,
) -> tuple[_Law, Sweep | _Counted]:
    """The exact law, and either matrices or counts."""
    check_sizes(call, draws=(draws, 100))
    if isinstance(kernel, (ChainEngine, Kernel)) or (callable(kernel) and not is_step(kernel)):
        if inputs is not None:
            raise UnsupportedError(
                f"{call}: inputs= is for functions; put the numbers into the net"
            )
        sweep = exact_sweep(net, evidence, _Sampling(call, kernel))
        return _Law(sweep.states, sweep.elements, sweep.law), sweep
    problem = pose(net, evidence, inputs)
    law, codes = _finite(call, net, problem, evidence, inputs)
    if hasattr(kernel, "transition") and hasattr(kernel, "states"):
        return law, _of_matrix(call, kernel, law)
    if not callable(kernel):
        sampler_of(call, kernel, problem)  # says what is a kernel
    hidden = [n for n, _ in codes]
    states = NetStates(
        problem.model, problem.inputs, hidden, [n for n in problem.observed if n not in hidden]
    )
    step = StepFunction(call, kernel, states, batched)
    generator = np.random.default_rng(seed_sequence(rng))
    before = generator.choice(len(law.probs), size=draws, p=law.probs / law.probs.sum())
    data = {n: _many(problem.observed[n].value, draws) for n in states.observed}
    after = step({n: v[before] for n, v in codes}, data, generator)
    return law, _Counted(before, _numbers(codes, after))


@dataclass(frozen=True)
class _Sampling:
    """What `exact_sweep` takes: anything that has a sampler."""

    call: str
    kernel: Any

    def sampler(self, problem: Any) -> Any:
        return sampler_of(self.call, self.kernel, problem)


def _finite(
    call: str, net: Any, problem: Any, evidence: Any, inputs: Any
) -> tuple[_Law, list[tuple[str, np.ndarray]]]:
    """The posterior by enumeration, and the stored values of its states."""
    if isinstance(net, FactorGraph):
        raise UnsupportedError(f"{call}: a function needs a BayesNet; give engines a FactorGraph")
    hidden = []
    for name, node in problem.model.nodes.items():
        seen = problem.observed.get(name)
        if not node.is_stochastic or (seen is not None and seen.mask is None):
            continue
        if node.domain is None:
            raise UnsupportedError(
                f"{call}: node {name!r} is hidden and has infinitely many values, so that steps between "
                "states cannot be counted; observe it, or use rank_test or geweke_test"
            )
        hidden.append(name)
    if not hidden:
        raise UnsupportedError(f"{call}: nothing is hidden, so there is nothing to move")
    exact = enumerate_posterior(net, evidence, inputs)
    if len(exact.weights) > _STATES:
        raise BudgetError(
            f"{call}: {len(exact.weights)} joint states; at most {_STATES} are counted. Observe more, or use "
            "rank_test"
        )
    codes = [(n, exact.stored[n]) for n in hidden]
    elements: list[str] = []
    columns = []
    for name, values in codes:
        flat = values.reshape(len(values), -1)
        places = [
            f"[{', '.join(map(str, at))}]" if at else "" for at in np.ndindex(values.shape[1:])
        ]
        elements += [name + place for place in places]
        states = problem.model[name].domain.states
        columns += [[states[k] for k in column] for column in flat.T]
    return _Law(tuple(zip(*columns, strict=True)), tuple(elements), exact.weights), codes


def _numbers(codes: list[tuple[str, np.ndarray]], after: Rows) -> np.ndarray:
    """Which state each row is."""
    keys = [_keys([v for _, v in codes]), _keys([after[n] for n, _ in codes])]
    number = {key: i for i, key in enumerate(keys[0])}
    return np.array([number.get(key, -1) for key in keys[1]])


def _keys(values: list[np.ndarray]) -> list[bytes]:
    flat = np.concatenate([v.reshape(len(v), -1).astype(np.int64) for v in values], axis=1)
    return [row.tobytes() for row in np.ascontiguousarray(flat)]


def _many(value: np.ndarray, rows: int) -> np.ndarray:
    return np.broadcast_to(value, (rows, *value.shape))


def _of_matrix(call: str, kernel: Any, law: _Law) -> Sweep:
    """A chain's own matrix, its states in the order of the law."""
    matrix = np.asarray(kernel.transition, dtype=float)
    labels = [s if isinstance(s, tuple) else (s,) for s in kernel.states]
    if matrix.shape != (len(labels),) * 2 or set(labels) != set(law.states):
        raise ShapeError(
            f"{call}: the chain has states {labels[:4]} ..., the posterior of {law.elements} has "
            f"{law.states[:4]} ...; give the same joint states, values of the hidden nodes in the order "
            "of the net"
        )
    order = [labels.index(state) for state in law.states]
    matrix = matrix[np.ix_(order, order)]
    return Sweep(law.elements, law.states, law.probs, (KernelMatrix((), "the chain", matrix, 0.0),))


# ---- exact --------------------------------------------------------------------------------------


def _title(part: KernelMatrix) -> str:
    return f"{part.label} of {', '.join(map(repr, part.names))}" if part.names else part.label


def _kept(part: KernelMatrix, law: _Law, tolerance: float) -> Comparison:
    after = law.probs @ part.matrix
    at = int((np.abs(after - law.probs) / np.sqrt(law.probs)).argmax())
    what = f"{_title(part)}: probability of {law.named(at)} after a step"
    return _exactly(what, after[at], law.probs[at], np.sqrt(law.probs[at]), tolerance)


def _balanced(part: KernelMatrix, law: _Law, tolerance: float) -> Comparison:
    flow = law.probs[:, None] * part.matrix
    scale = np.sqrt(law.probs[:, None] * law.probs)
    i, j = np.unravel_index((np.abs(flow - flow.T) / scale).argmax(), flow.shape)
    what = f"{_title(part)}: {law.named(int(i))} -> {law.named(int(j))} against the way back"
    return _exactly(what, flow[i, j], flow[j, i], scale[i, j], tolerance)


def _exactly(what: str, found: float, exact: float, scale: float, tolerance: float) -> Comparison:
    near = abs(found - exact) <= tolerance * scale
    return Comparison(
        what, float(found), float(exact), 0.0 if near else np.inf, 1.0 if near else 0.0
    )


# ---- counted ------------------------------------------------------------------------------------


def _left(law: _Law, found: _Counted) -> list[Comparison]:
    """Steps to states of probability zero, of which one is too many."""
    outside = np.flatnonzero(found.after < 0)
    if not len(outside):
        return []
    start = law.named(int(found.before[outside[0]]))
    what = f"steps to states of probability zero, the first from {start}"
    return [Comparison(what, float(len(outside)), 0.0, np.inf, 0.0)]


def _joint(law: _Law, found: _Counted) -> list[Comparison]:
    """Joint states after a step; rare ones together."""
    draws = len(found.after)
    counts = np.bincount(found.after[found.after >= 0], minlength=len(law.probs))
    common = draws * law.probs >= _RARE
    made = [
        _binomial(f"{law.named(int(i))} after a step", counts[i], draws, law.probs[i])
        for i in np.flatnonzero(common)
    ]
    rest = law.probs[~common].sum()
    if draws * rest >= _RARE:
        made.append(_binomial("rare states after a step", counts[~common].sum(), draws, rest))
    return made


def _single(law: _Law, found: _Counted) -> list[Comparison]:
    """States of single elements after a step, where there are several elements."""
    draws, made = len(found.after), []
    if len(law.elements) < 2:
        return []
    inside = found.after[found.after >= 0]
    for k, element in enumerate(law.elements):
        column = [state[k] for state in law.states]
        for value in dict.fromkeys(column):
            has = np.array([v == value for v in column])
            p = float(law.probs[has].sum())
            if draws * p * (1 - p) >= _RARE:
                what = f"{element} = {value!r} after a step"
                made.append(_binomial(what, has[inside].sum(), draws, p))
    return made


def _either_way(law: _Law, found: _Counted) -> list[Comparison]:
    inside = found.after >= 0
    size = len(law.probs)
    flat = np.bincount(found.before[inside] * size + found.after[inside], minlength=size * size)
    steps = flat.reshape(size, size)
    made = []
    for i, j in zip(*np.nonzero(np.triu(steps + steps.T, 1)), strict=True):
        what = f"steps {law.named(int(i))} -> {law.named(int(j))} of those either way"
        made.append(_binomial(what, steps[i, j], int(steps[i, j] + steps[j, i]), 0.5))
    return made


def _binomial(what: str, count: Any, draws: int, p: float) -> Comparison:
    """A count against its binomial law, by exact tails."""
    k, p = float(count), min(float(p), 1.0)
    below = float(scipy.special.bdtr(k, draws, p))
    above = float(scipy.special.bdtrc(k - 1, draws, p)) if k >= 1 else 1.0
    error = np.sqrt(draws * p * (1 - p)) or 1.0
    errors = abs(k - draws * p) / error
    return Comparison(
        what, k, draws * p, float(errors), min(1.0, 2.0 * min(below, above)), "expected"
    )
