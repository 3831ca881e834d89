"""A posed problem as beliefs and batches of factors between them, ready for messages.

Everything that is linear-Gaussian whatever finite nodes are is entered exactly and never approximated; factors
of finite nodes alone are tables; all others are approximated. Batches stand in the order of declaration,
parents first.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby

import numpy as np

from bayesmc.distributions import MvNormal, Normal
from bayesmc.engines.approximate.evidence import log_constants
from bayesmc.engines.propagation.batch import Batch, Edge
from bayesmc.engines.propagation.beliefs import IMPOSSIBLE, Beliefs, components
from bayesmc.engines.propagation.coordinates import Numbers, numbers_of
from bayesmc.engines.propagation.density import Read, Terms
from bayesmc.engines.propagation.kernels import Switched, Tables
from bayesmc.engines.propagation.linear import linear_rows, score_rows
from bayesmc.engines.propagation.scopes import Rows, basis, padded
from bayesmc.errors import BudgetError, UnsupportedError
from bayesmc.expression import Family
from bayesmc.factors import FactorLike, LogTable
from bayesmc.network import Model, Problem
from bayesmc.network.expressions import Followed, density
from bayesmc.structure import Variable, constants_of, discrete_net, known_values
from bayesmc.structure.target import Target, target_of

#: coordinates of one component, whose covariance is kept whole
_WIDEST = 4000


@dataclass(eq=False)
class System:
    """Beliefs, and the factors that they come of.

    Attributes
    ----------
    target : Target
        Its ``chain`` are the nodes that are described.
    beliefs : Beliefs
    batches : list of Batch
    numbers : dict
        Coordinates of the continuous ones.
    places : dict
        Finite variable -> (group, place) of the beliefs.
    log_scale : float
        Of all that is exact, and of what no hidden node changes.
    exact : dict
        Node -> number of its elements that are entered exactly.
    loops : bool
        Whether tables of finite nodes hang together in loops.
    """

    target: Target
    beliefs: Beliefs
    batches: list[Batch]
    numbers: dict[str, Numbers]
    places: dict[Variable, tuple[int, int]]
    log_scale: float
    exact: dict[str, int] = field(default_factory=dict)
    loops: bool = False

    @property
    def is_exact(self) -> bool:
        """Whether nothing is approximated: all is linear-Gaussian, and tables hang together in trees."""
        return not self.loops and all(not b.k for b in self.batches)


def system_of(problem: Problem, who: str = "ExpectationPropagation") -> System:
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
            return _assembled(problem, target_of(problem, chosen), who)
        except _Barren as found:
            left_out.add(found.name)


# ---- private ------------------------------------------------------------------------------------


class _Barren(Exception):  # noqa: N818 - no error: control within this module
    """A node on which nothing observed depends cannot be described, and is drawn instead."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.name = name


def _chosen(problem: Problem, plain: Target, left_out: set[str], who: str) -> list[str]:
    """Nodes to describe although nothing observed depends on them: finite and Normal ones, as far as it goes."""
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


def _assembled(problem: Problem, target: Target, who: str) -> System:
    model, observed = problem.model, problem.observed
    barren = set(target.chain) - set(target_of(problem).chain)
    known = {**known_values(model, constants_of(model, problem.inputs), observed)}
    known.update({n: o.value for n, o in observed.items() if o.mask is None})
    chain = [model[n] for n in target.chain]
    numbers = numbers_of(model, [n for n in chain if n.domain is None], observed)
    finite = _finite(model, target, known, numbers)
    states = {
        (n, int(e)): int(o.value.flat[e])
        for n, o in observed.items()
        if model[n].domain is not None and o.mask is not None
        for e in np.flatnonzero(o.mask)
    }
    parts: list[Rows | Read] = []
    terms = Terms(model, known, numbers, finite)
    tabled: set[str] = set()
    for name in target.terms:
        above = _numbers_above(model, name, numbers)
        if not above and name not in numbers and (name not in model.nodes or _is_tabled(target, name)):
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
    return _Assembly(problem, target, numbers, parts, tables, states).system()


def _is_tabled(target: Target, name: str) -> bool:
    seen = target.seen(name)
    return target.model[name].domain is not None or seen is None or seen.mask is None


def _finite(
    model: Model, target: Target, known: Mapping[str, np.ndarray], numbers: Mapping[str, Numbers]
) -> frozenset[str]:
    """Finite nodes that are variables: hidden ones, and those computed of finite ones alone."""
    found = {n for n in target.chain if model[n].domain is not None}
    for name, node in model.nodes.items():
        if node.kind == "deterministic" and node.domain is not None:
            above = model.above(node.parents, lambda n: not model[n].is_stochastic)
            if not any(p in numbers for p in above):
                found.add(name)
    return frozenset(found)


def _numbers_above(model: Model, name: str, numbers: Mapping[str, Numbers]) -> list[str]:
    """Hidden continuous nodes that a function reads, through computed ones."""
    reached = model.above(model.parents(name), lambda n: not model[n].is_stochastic)
    return [n for n in reached if n in numbers]


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
) -> list[tuple[str, tuple[Variable, ...], np.ndarray]]:
    """Factors of finite variables alone: name, scope, logs."""
    model, observed = problem.model, problem.observed
    read = {n for t in target.terms for n in model.above(model.parents(t), lambda n: not model[n].is_stochastic)}
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
    seen = {n: o.value.reshape(-1) for n, o in observed.items() if o.mask is None and n not in finite}
    seen.update({n: model[n].declaration.value.reshape(-1) for n in model.nodes
                 if model[n].declaration.value is not None})  # fmt: skip
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


class _Assembly:
    """Parts put together into batches."""

    def __init__(
        self,
        problem: Problem,
        target: Target,
        numbers: dict[str, Numbers],
        parts: Sequence[Rows | Read],
        tables: Sequence[tuple[str, tuple[Variable, ...], np.ndarray]],
        states: Mapping[Variable, int],
    ) -> None:
        self.problem, self.target, self.numbers = problem, target, numbers
        self.model, self.states = problem.model, states
        self.rows = [p for p in parts if isinstance(p, Rows)]
        self.reads = [p for p in parts if isinstance(p, Read)]
        self.tables = [t for t in tables if t[1]]
        self.log_scale = float(sum(t[2] for t in tables if not t[1])) + log_constants(target)
        self.order = {n: k for k, n in enumerate([*problem.model.nodes, *problem.model.potentials])}

    def system(self) -> System:
        self._name_variables()
        count = 1 + max((int(x.at.max(initial=-1)) for x in self.numbers.values()), default=-1)
        component = components(count, self._groups())
        widest = np.bincount(component).max(initial=0) if count else 0
        if widest > _WIDEST:
            raise BudgetError(
                f"ExpectationPropagation: {widest} numbers hang together, whose covariance is kept whole; "
                f"above {_WIDEST} use Gibbs or HamiltonianMonteCarlo",
                int(8 * widest**2),
            )
        cards = sorted({c for c, _ in self.groups})
        counts = [sum(1 for c, _ in self.groups if c == card) for card in cards]
        self.beliefs = Beliefs.of(component, cards, counts)
        self._clamp()
        exact = self._enter_exact()
        batches = [*self._table_batches(), *self._row_batches(), *self._read_batches()]
        batches.sort(key=lambda b: self.order.get(b.name, -1))
        places = self.places
        found = System(
            self.target, self.beliefs, batches, self.numbers, places, self.log_scale, exact, self._has_loops()
        )
        _begin(self.problem, found)
        return found

    # ---- private -------------------------------------------------------------------------------

    def _name_variables(self) -> None:
        used: dict[Variable, None] = {}
        for _, scope, _ in self.tables:
            used.update(dict.fromkeys(scope))
        for row in self.rows:
            used.update(dict.fromkeys(row.scope))
        for read in self.reads:
            for name, at in read.scope:
                used.update(dict.fromkeys((name, int(e)) for e in at))
        for name in self.target.chain:
            node = self.model[name]
            if node.domain is not None:
                used.update(dict.fromkeys((name, e) for e in range(math.prod(node.plate_shape))))
        self.groups: list[tuple[int, Variable]] = []
        cards = sorted({self._card(v) for v in used})
        at = dict.fromkeys(cards, 0)
        self.places: dict[Variable, tuple[int, int]] = {}
        for variable in used:
            card = self._card(variable)
            self.places[variable] = cards.index(card), at[card]
            at[card] += 1
            self.groups.append((card, variable))

    def _card(self, variable: Variable) -> int:
        domain = self.model[variable[0]].domain
        assert domain is not None
        return domain.size

    def _groups(self) -> Iterable[Sequence[int]]:
        """Coordinates that one factor reads."""
        for row in self.rows:
            if len(row.coordinates):
                yield row.coordinates.tolist()
        for read in self.reads:
            if read.coordinates.shape[1]:
                yield from np.unique(read.coordinates, axis=0).tolist()

    def _clamp(self) -> None:
        """Elements of partly observed finite nodes are what was seen."""
        for variable, state in self.states.items():
            if variable in self.places:
                group, at = self.places[variable]
                logs = self.beliefs.finite[group].logs
                logs[at] = IMPOSSIBLE
                logs[at, state] = 0.0

    def _enter_exact(self) -> dict[str, int]:
        """Gaussians that no finite variable switches."""
        beliefs, found = self.beliefs, dict[str, int]()
        for row in self.rows:
            if row.scope:
                continue
            matrix, value = row.rows[..., :-1], row.rows[..., -1]
            self.log_scale += float(row.log_scale) - 0.5 * float(value @ value)
            found[row.name] = found.get(row.name, 0) + 1
            at = row.coordinates
            if not len(at):
                continue
            block = beliefs.blocks[beliefs.size[at[0]]]
            c, places = beliefs.component[at[0]], beliefs.place[at]
            np.add.at(block.precision, (c, places[:, None], places[None, :]), matrix.T @ matrix)
            np.add.at(block.linear, (c, places), matrix.T @ value)
        return found

    def _table_batches(self) -> list[Batch]:
        found = []
        for (name, shape), group in groupby(self.tables, key=lambda t: (t[0], t[2].shape)):
            members = list(group)
            logs = np.maximum(np.stack([t[2] for t in members]), IMPOSSIBLE)
            edges = tuple(
                self._edge([t[1][k] for t in members]) for k in range(len(shape))
            )
            found.append(Batch(name, Tables(logs), len(members), edges, shape))
        return found

    def _row_batches(self) -> list[Batch]:
        switched = sorted((r for r in self.rows if r.scope), key=lambda r: (self.order[r.name], r.element))
        kinds: dict[object, list[Rows]] = {}
        for row in switched:
            kinds.setdefault(row.key, []).append(row)
        found = []
        for members in kinds.values():
            first = members[0]
            cards = first.log_scale.shape
            rows = np.stack([r.rows for r in members])
            logs = np.stack([r.log_scale for r in members])
            edges = tuple(self._edge([r.scope[k] for r in members]) for k in range(len(cards)))
            elements = np.array([r.element for r in members])
            q = len(first.coordinates)
            if not q:  # of finite variables alone
                value = rows[..., -1]
                logs = logs - 0.5 * (value**2).sum(axis=-1)
                found.append(Batch(first.name, Tables(logs), len(members), edges, cards))
                continue
            coordinates = padded([r.coordinates for r in members])
            weights, inner = basis(rows[..., :-1].reshape(len(members), -1, q))
            inner = inner.reshape(*rows.shape[:-1], -1)
            kernel = Switched(np.concatenate([inner, rows[..., -1:]], axis=-1), logs)
            found += self._placed(
                first.name, kernel, edges, cards, coordinates, weights, first.is_prior, elements
            )
        return found

    def _read_batches(self) -> list[Batch]:
        found = []
        for read in self.reads:
            edges = tuple(self._edge([(name, int(e)) for e in at]) for name, at in read.scope)
            cards = tuple(self._card((name, 0)) for name, _ in read.scope)
            if not read.coordinates.shape[1]:
                found.append(Batch(read.name, read.kernel, len(read.elements), edges, cards))
                continue
            found += self._placed(
                read.name, read.kernel, edges, cards, read.coordinates, read.weights,
                read.name in self.numbers, read.elements,
            )  # fmt: skip
        return found

    def _edge(self, variables: Sequence[Variable]) -> Edge:
        places = [self.places[v] for v in variables]
        return Edge(places[0][0], np.array([p for _, p in places]))

    def _placed(
        self, name: str, kernel: object, edges: Sequence[Edge], cards: tuple[int, ...],
        coordinates: np.ndarray, weights: np.ndarray, is_prior: bool, elements: np.ndarray,
    ) -> list[Batch]:  # fmt: skip
        """Batches of factors in components of one size each."""
        beliefs, found = self.beliefs, []
        sizes = beliefs.size[coordinates[:, 0]]
        for block in np.unique(sizes):
            mine = np.flatnonzero(sizes == block)
            at = coordinates[mine]
            found.append(
                Batch(
                    name, kernel, len(mine), tuple(Edge(e.group, e.at[mine]) for e in edges), cards,  # type: ignore[arg-type]
                    int(block), beliefs.component[at[:, 0]], beliefs.place[at], weights[mine],
                    is_prior, elements[mine], mine,
                )  # fmt: skip
            )
        return found

    def _has_loops(self) -> bool:
        """Whether finite variables and their factors are no forest."""
        variables = list(self.places)
        index = {v: k for k, v in enumerate(variables)}
        scopes = [t[1] for t in self.tables if len(t[1]) > 1]
        scopes += [r.scope for r in self.rows if len(r.scope) > 1]
        for read in self.reads:
            if len(read.scope) > 1:
                scopes += [
                    tuple((n, int(at[k])) for n, at in read.scope) for k in range(len(read.elements))
                ]
        total = len(variables) + len(scopes)
        edges = [(len(variables) + k, index[v]) for k, s in enumerate(scopes) for v in set(s)]
        parts = components(total, edges).max(initial=-1) + 1
        return len(edges) > total - parts


def _begin(problem: Problem, system: System) -> None:
    """Messages to start with: of densities that are approximated, moments of draws from the prior."""
    beliefs = system.beliefs
    priors = [b for b in system.batches if b.k and b.is_prior]
    if priors:
        mean, spread = _prior_draws(problem, system)
        for batch in priors:
            at = _global(beliefs, batch)
            middle = np.matvec(batch.weights, mean[at])
            wide = batch.weights * spread[at][:, None, :] ** 2
            cov = wide @ np.matrix_transpose(batch.weights)
            batch.begin(beliefs, middle, cov)
    for block in beliefs.blocks:
        if len(block.linear) and block.refreshed().any():
            raise UnsupportedError(
                "ExpectationPropagation: some numbers have no proper prior; give every node a density that "
                "has an integral"
            )


def _global(beliefs: Beliefs, batch: Batch) -> np.ndarray:
    """Coordinates of a batch's columns."""
    found = np.zeros(batch.columns.shape, dtype=int)
    mine = np.flatnonzero(beliefs.size == batch.block)
    n = beliefs.blocks[batch.block].linear.shape[1]
    table = np.zeros((len(beliefs.blocks[batch.block].linear), n), dtype=int)
    table[beliefs.component[mine], beliefs.place[mine]] = mine
    found[:] = table[batch.component[:, None], batch.columns]
    return found


def _prior_draws(problem: Problem, system: System) -> tuple[np.ndarray, np.ndarray]:
    """Middles and spreads of all coordinates under the prior, roughly: medians and quartiles."""
    count = len(system.beliefs.size)
    mean, spread = np.zeros(count), np.full(count, 10.0)
    try:
        model = problem.model
        probe = {
            n: model.probe[n].reshape(-1, *model[n].value_shape)
            for n in system.numbers
        }
    except (KeyError, ValueError):  # what the prior is like is not known: anything will do
        return mean, spread
    for name, x in system.numbers.items():
        with np.errstate(all="ignore"):
            free = x.freed(probe[name])
        low, middle, high = np.nanquantile(free, [0.2, 0.5, 0.8], axis=0)
        wide = np.maximum((high - low) / 1.6, 1e-3)
        good = np.isfinite(middle) & np.isfinite(wide) & (x.at >= 0)
        mean[x.at[good]], spread[x.at[good]] = middle[good], 2.0 * wide[good]
    return mean, spread
