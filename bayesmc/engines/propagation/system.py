"""A posed problem read as factors: which nodes are described, and what each term says of them.

Everything that is linear-Gaussian whatever finite nodes are is entered exactly and never approximated;
factors of finite nodes alone are tables; all others are approximated.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from bayesmc.distributions import MvNormal, Normal
from bayesmc.engines.propagation.assembly import Assembly, System, Table
from bayesmc.engines.propagation.coordinates import numbers_of
from bayesmc.engines.propagation.density import Read, Terms
from bayesmc.engines.propagation.linear import linear_rows, score_rows
from bayesmc.engines.propagation.scopes import Rows
from bayesmc.engines.propagation.statistics import OwnFamilies
from bayesmc.errors import UnsupportedError
from bayesmc.expression import Family
from bayesmc.factors import FactorLike, LogTable
from bayesmc.network import Model, Problem
from bayesmc.network.expressions import Followed, density
from bayesmc.structure import Variable, constants_of, discrete_net, known_values
from bayesmc.structure.target import Target, target_of


def system_of(
    problem: Problem, who: str = "ExpectationPropagation", mapped: Collection[str] = ()
) -> System:
    """The system of a posed problem.

    Raises
    ------
    UnsupportedError, BudgetError
        With the node's name.
    """
    left_out: set[str] = set()
    while True:
        plain = target_of(problem)
        chosen = _chosen(problem, plain, left_out, who)
        try:
            return _assembled(problem, target_of(problem, chosen), who, mapped)
        except _Barren as found:
            left_out.add(found.name)


# ---- private ------------------------------------------------------------------------------------


class _Barren(Exception):  # noqa: N818 - no error: control within this module
    """A node on which nothing observed depends cannot be described, and is drawn instead."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.name = name


def _chosen(problem: Problem, plain: Target, left_out: set[str], who: str) -> list[str]:
    """Nodes to describe although nothing observed depends on them: finite and Normal ones, where it goes."""
    model = problem.model
    inside = set(plain.chain)
    found = []
    for name, node in model.nodes.items():
        if not node.is_stochastic or node.declaration.value is not None:
            continue
        seen = problem.observed.get(name)
        if (seen is not None and seen.mask is None) or name in left_out:
            continue
        if name in inside:
            if node.domain is None and node.is_discrete:
                raise UnsupportedError(
                    f"{who}: node {name!r} is hidden and has infinitely many values; use Gibbs"
                )
            continue
        above = [
            p
            for p in model.above(node.parents, lambda n: not model[n].is_stochastic)
            if model[p].is_stochastic and p not in plain.known
        ]
        if any(p not in inside for p in above):
            continue
        if node.domain is not None:
            fits = all(model[p].domain is not None for p in above)
        else:
            read = density(model, name)
            result = read.result if isinstance(read, Followed) else None
            family = result.make if isinstance(result, Family) else type(result)
            fits = family in (Normal, MvNormal)
        if fits:
            inside.add(name)
            found.append(name)
    return found


def _assembled(problem: Problem, target: Target, who: str, mapped: Collection[str]) -> System:
    model, observed = problem.model, problem.observed
    barren = set(target.chain) - set(target_of(problem).chain)
    known = {**known_values(model, constants_of(model, problem.inputs), observed)}
    known.update({n: o.value for n, o in observed.items() if o.mask is None})
    chain = [model[n] for n in target.chain]
    hidden = {n.name for n in chain if n.domain is None}
    finite = _finite(model, target, hidden)
    given = {**known, **_filled(target)}
    own = OwnFamilies(model, target, given, finite, observed, mapped)
    free = [n for n in chain if n.name in hidden and n.name not in own.nodes]
    numbers = numbers_of(model, free, observed)
    states = {
        (n, int(e)): int(o.value.flat[e])
        for n, o in observed.items()
        if model[n].domain is not None and o.mask is not None
        for e in np.flatnonzero(o.mask)
    }
    parts: list[Rows | Read] = []
    terms = Terms(model, given, numbers, finite)
    tabled: set[str] = set()
    for name in target.terms:
        if name in own.nodes or name in own.factors:
            continue
        above = _numbers_above(model, name, hidden)
        if not above and name not in hidden and _is_tabled(target, name):
            tabled.add(name)
            continue
        if name in numbers and numbers[name].is_score:
            parts += score_rows(numbers[name], observed.get(name))
            continue
        rows = None
        if name in model.nodes and model[name].domain is None and not model[name].is_discrete:
            computed = _computed_of(model, name, finite)
            if not computed:
                rows = linear_rows(model, name, observed, known, states, numbers)
        if rows is not None:
            parts += list(rows)
            continue
        if name in barren:
            raise _Barren(name)
        seen = observed.get(name)
        elements = None
        if seen is not None and seen.mask is not None and name not in target.chain:
            elements = np.flatnonzero(seen.mask)
        parts.append(terms.read(name, elements))
    tables = _tables(problem, target, tabled, finite, states, who)
    return Assembly(problem, target, numbers, parts, tables, states, own).system()


def _filled(target: Target) -> dict[str, np.ndarray]:
    """Partly observed nodes whose missing elements no term reads, with what stands there for shape alone.

    Factors are read of their seen elements; the others are drawn afterwards.
    """
    found = {}
    for name, seen in target.observed.items():
        if (
            seen.mask is None
            or name in target.chain
            or name not in target.terms
            or not seen.mask.any()
        ):
            continue
        value = np.array(seen.value)
        value[~seen.mask] = value[seen.mask][0]
        found[name] = value
    return found


def _is_tabled(target: Target, name: str) -> bool:
    if name not in target.model.nodes:
        return True
    seen = target.seen(name)
    return target.model[name].domain is not None or seen is None or seen.mask is None


def _finite(model: Model, target: Target, hidden: Collection[str]) -> frozenset[str]:
    """Finite nodes that are variables: hidden ones, and those computed of finite ones alone."""
    found = {n for n in target.chain if model[n].domain is not None}
    for name, node in model.nodes.items():
        if node.kind == "deterministic" and node.domain is not None:
            above = model.above(node.parents, lambda n: not model[n].is_stochastic)
            if not any(p in hidden for p in above):
                found.add(name)
    return frozenset(found)


def _numbers_above(model: Model, name: str, hidden: Collection[str]) -> list[str]:
    """Hidden continuous nodes that a function reads, through computed ones."""
    reached = model.above(model.parents(name), lambda n: not model[n].is_stochastic)
    return [n for n in reached if n in hidden]


def _computed_of(model: Model, name: str, finite: frozenset[str]) -> list[str]:
    """Computed finite nodes above that depend on continuous ones."""
    reached = model.above(model.parents(name), lambda n: not model[n].is_stochastic)
    return [
        n
        for n in reached
        if model[n].kind == "deterministic" and model[n].domain is not None and n not in finite
    ]


def _tables(
    problem: Problem,
    target: Target,
    tabled: set[str],
    finite: frozenset[str],
    states: Mapping[Variable, int],
    who: str,
) -> list[Table]:
    """Factors of finite variables alone: name, scope, logs."""
    model, observed = problem.model, problem.observed
    read = {
        n
        for t in target.terms
        for n in model.above(model.parents(t), lambda n: not model[n].is_stochastic)
    }
    wanted = tabled | {n for n in finite if model[n].kind == "deterministic" and n in read}
    if not wanted:
        return []
    everything = [*model.nodes, *model.potentials]
    without = frozenset(n for n in everything if n not in wanted)
    net = discrete_net(model, observed, problem.inputs, without)
    extra, invalid = net.evidence_factors(observed)
    bad = [*net.invalid, *invalid]
    if bad:
        raise UnsupportedError(
            f"{who}: node {bad[0][0]!r} has bad parameters at some states of its parents; use Exact"
        )
    seen = {
        n: o.value.reshape(-1) for n, o in observed.items() if o.mask is None and n not in finite
    }
    fixed = {n: node.declaration.value for n, node in model.nodes.items()}
    seen.update({n: v.reshape(-1) for n, v in fixed.items() if v is not None})
    found = []
    for scope, factor in zip(net.scopes, [*net.static, *extra], strict=True):
        logs = _logs(factor)
        name = next((n for n in wanted if scope and n == scope[-1][0]), "")
        kept = []
        for axis, (node, e) in reversed(list(enumerate(scope))):
            if node in seen:
                logs = logs.take(int(seen[node][e]), axis=axis)
            elif (node, e) in states:
                logs = logs.take(states[node, e], axis=axis)
            else:
                kept.append((node, e))
        found.append((name, tuple(reversed(kept)), logs))
    return found


def _logs(factor: FactorLike) -> np.ndarray:
    if isinstance(factor, LogTable):
        return np.asarray(factor.values, dtype=float)
    scale = 0.0
    if isinstance(factor, tuple):
        factor, scale = factor
    with np.errstate(divide="ignore"):
        return np.log(np.asarray(factor, dtype=float)) + scale
