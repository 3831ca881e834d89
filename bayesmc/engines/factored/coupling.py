"""The weakly coupled parts of a template: clusters of nodes that a slice ties together most.

How much two nodes have to do with each other is measured, not read off the graph: by the mutual information
that one slice gives them when the belief before it was a product, along a series drawn from the template
itself. That is what a belief over single nodes would forget in each slice. The parts with most of it between
them are put together first, as long as their joint states stay few; then each part is kept together with its
neighbours in the tree that has most of what is left, so that the clusters overlap and form a junction tree.

References
----------
Boyen and Koller (1999), Exploiting the architecture of dynamic systems, AAAI (weak interaction bounds
the error of the projection; conditionally factored beliefs); Chow and Liu (1968), Approximating discrete
probability distributions with dependence trees, IEEE Transactions on Information Theory 14 (the tree).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping

import numpy as np

from bayesmc.dbn import PREVIOUS, Row, Series, Slices
from bayesmc.engines.discrete.rows import Variable
from bayesmc.engines.discrete.slices import Chain, DiscreteSlices
from bayesmc.engines.factored.clusters import Scope, junction_tree
from bayesmc.engines.factored.run import FactoredRun
from bayesmc.engines.factored.slices import FactoredSlices
from bayesmc.engines.filtering import quiet
from bayesmc.engines.slice_steps import SlicePlan
from bayesmc.errors import BayesmcError
from bayesmc.network import Observed
from bayesmc.network.forward import Pass
from bayesmc.network.forward import run as passed
from bayesmc.randomness import Purpose, stream

#: joint states of a cluster, and entries of a chain's tables in a slice, up to which clusters are merged
STATES, ENTRIES = 1 << 8, 1 << 17
#: numbers that measuring may go through (a second or so); above, nothing is measured
MEASURABLE = 1 << 26
#: nats a slice below which two nodes have nothing to do with each other
_NOTHING = 1e-9
#: slices that are drawn, and those of them in which is measured
_STEPS, _MEASURED = 25, (1, 3, 6, 12, 24)


def coupled_clusters(
    slices: Slices,
    apart: tuple[str, ...],
    static: Mapping[str, np.ndarray],
    inputs: Mapping[str, np.ndarray],
) -> list[Scope]:
    """Clusters of all finite nodes that a slice hands on.

    Parameters
    ----------
    inputs : dict
        Of slice 0; they are taken to stay as they are.
    """
    readings = _readings(slices)
    plan = FactoredSlices(slices, apart, readings, static, True, frozenset(), singles)
    if _work(plan) > MEASURABLE:
        return singles(plan)
    try:
        with quiet():
            series = _drawn(slices, apart, static, inputs, readings)
            weights = _measured(plan, series)
    except (BayesmcError, ArithmeticError):  # nothing that can be drawn: whatever meets is coupled
        weights = {pair: 1.0 for k in range(len(plan.chains)) for pair in _pairs(plan, k)}
    return [
        cluster
        for number, chain in enumerate(plan.chains)
        for cluster in _grown(plan, number, chain, weights)
    ]


def singles(plan: DiscreteSlices) -> list[Scope]:
    """Every node that a slice hands on by itself."""
    return [(v,) for chain in plan.chains for v in chain.state]


# ---- private ------------------------------------------------------------------------------------


def _readings(slices: Slices) -> frozenset[str]:
    """Nodes that will be seen, as far as the template tells: those that no node reads, and numbers."""
    read = {
        parent.removesuffix(PREVIOUS)
        for model in (slices.first, slices.later)
        for name in slices.dynamic
        for parent in model[name].parents
    }
    return frozenset(
        n
        for n in slices.dynamic
        if slices.first[n].is_stochastic and (n not in read or slices.first[n].domain is None)
    )


def _drawn(
    slices: Slices,
    apart: tuple[str, ...],
    static: Mapping[str, np.ndarray],
    inputs: Mapping[str, np.ndarray],
    readings: frozenset[str],
) -> Series:
    """A series of what is seen, drawn from the template; the same at each call."""
    steps = SlicePlan(slices, apart, static)
    rng = stream(np.random.SeedSequence(0), Purpose.CHECK)
    rows = {n: np.repeat(np.asarray(v)[None], _STEPS, axis=0) for n, v in inputs.items()}
    empty = Series(_STEPS, {}, rows)
    before: dict[str, np.ndarray] = {}
    seen: dict[str, list[np.ndarray]] = {n: [] for n in readings}
    for t in range(_STEPS):
        row: Row = empty.row(t)
        values = passed(steps.steps(row), Pass(rng, (1,), {**steps.known(row), **before})).values
        for name, found in seen.items():
            shape = slices.first[name].value_shape
            value = np.asarray(values[name])
            value = value.reshape((1,) * (1 + len(shape) - value.ndim) + value.shape)
            found.append(np.broadcast_to(value, (1, *shape))[0])
        before = {n + PREVIOUS: values[n] for n in slices.interface}
    return Series(_STEPS, {n: Observed(np.stack(v)) for n, v in seen.items()}, rows)


def _work(plan: FactoredSlices) -> float:
    """Numbers that a measurement goes through: a pass over the slices, and a joint table of every pair."""
    return sum(
        plan.tree(k, 2).entries * (_STEPS + len(_MEASURED) * len(_pairs(plan, k)))
        for k in range(len(plan.chains))
    )


def _pairs(plan: FactoredSlices, number: int) -> list[tuple[Variable, Variable]]:
    """Nodes handed on that a density of a slice ties, or that have to do with one variable that is summed."""
    chain = plan.chains[number]
    own = set(chain.state)
    meeting: dict[Variable, dict[Variable, None]] = {}
    for _, scope in plan._later(number):
        here = [v for v in scope if v in own]
        for v in scope:
            meeting.setdefault(v, {}).update(dict.fromkeys(here))
    order = {v: k for k, v in enumerate(chain.state)}
    found = {
        tuple(sorted(pair, key=order.__getitem__)): None
        for tied in meeting.values()
        for pair in itertools.combinations(tied, 2)
    }
    return list(found)  # type: ignore[arg-type]


def _measured(plan: FactoredSlices, series: Series) -> dict[tuple[Variable, Variable], float]:
    """Mean mutual information of pairs of nodes in a slice, in nats."""
    run = FactoredRun(plan, series)
    run.forward()
    found: dict[tuple[Variable, Variable], float] = {}
    for number in range(len(plan.chains)):
        pairs = _pairs(plan, number)
        if not pairs:
            continue
        for t in _MEASURED:
            slice_ = run.calibrated(number, t)
            for pair in pairs:
                joint = slice_.joint(pair)
                found[pair] = found.get(pair, 0.0) + _information(joint) / len(_MEASURED)
    return found


def _information(joint: np.ndarray) -> float:
    """Mean mutual information of tables (sequences, a, b)."""
    product = joint.sum(axis=2, keepdims=True) * joint.sum(axis=1, keepdims=True)
    held = joint > 0
    ratio = np.where(held, joint, 1.0) / np.where(held, product, 1.0)
    return float((joint * np.log(ratio)).sum() / len(joint))


def _grown(
    plan: FactoredSlices,
    number: int,
    chain: Chain,
    weights: Mapping[tuple[Variable, Variable], float],
) -> list[Scope]:
    """Clusters of one chain, as large as its clique tree allows: parts with their neighbours in a tree."""
    states = STATES
    while True:
        parts, ties = _merged(plan, chain, weights, math.isqrt(states))
        found = _neighbours(plan, parts, ties, states)
        if chain.size <= states:
            found = [list(chain.state)]
        order = {v: k for k, v in enumerate(chain.state)}
        scopes = [tuple(sorted(vs, key=order.__getitem__)) for vs in found]
        tree = plan.tree_of(number, 2, junction_tree(scopes, chain.state, plan))
        if states == 1 or tree.entries <= ENTRIES * plan.reader.sequences:
            return scopes
        states //= 4


def _merged(
    plan: DiscreteSlices,
    chain: Chain,
    weights: Mapping[tuple[Variable, Variable], float],
    states: int,
) -> tuple[dict[int, list[Variable]], dict[tuple[int, int], float]]:
    """Parts put together, the most coupled first, and what is left between them.

    Ties go to those that come first.
    """
    members: dict[int, list[Variable]] = {k: [v] for k, v in enumerate(chain.state)}
    sizes = {k: plan.cards[v] for k, v in enumerate(chain.state)}
    at = {v: k for k, v in enumerate(chain.state)}
    ties: dict[tuple[int, int], float] = {}
    for (u, v), weight in weights.items():
        if u in at and weight > _NOTHING:
            ties[at[u], at[v]] = weight
    while True:
        able = {p: w for p, w in ties.items() if sizes[p[0]] * sizes[p[1]] <= states}
        if not able:
            return members, ties
        a, b = max(able, key=lambda p: (able[p], -p[0], -p[1]))
        members[a] += members.pop(b)
        sizes[a] *= sizes.pop(b)
        moved: dict[tuple[int, int], float] = {}
        for (i, j), weight in ties.items():
            pair = tuple(sorted({a if i == b else i, a if j == b else j}))
            if len(pair) == 2:
                moved[pair] = moved.get(pair, 0.0) + weight
        ties = moved


def _neighbours(
    plan: DiscreteSlices,
    parts: Mapping[int, list[Variable]],
    ties: Mapping[tuple[int, int], float],
    states: int,
) -> list[list[Variable]]:
    """Pairs of parts along the maximum spanning tree of what ties them, where they are not too large."""
    sizes = {k: math.prod(plan.cards[v] for v in vs) for k, vs in parts.items()}
    top = {k: k for k in parts}

    def root(k: int) -> int:
        while top[k] != k:
            k = top[k]
        return k

    found = []
    for a, b in sorted(ties, key=lambda p: (-ties[p], p)):
        if root(a) != root(b) and sizes[a] * sizes[b] <= states:
            top[root(b)] = root(a)
            found.append(parts[a] + parts[b])
    held = {v for vs in found for v in vs}
    return found + [vs for vs in parts.values() if vs[0] not in held]
