"""What terms say, put together: beliefs, what is exact about them, and batches of factors in order."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import groupby

import numpy as np

from bayesmc.engines.approximate.evidence import log_constants
from bayesmc.engines.propagation.batch import Batch, Edge, Kernel
from bayesmc.engines.propagation.beliefs import IMPOSSIBLE, Beliefs, components
from bayesmc.engines.propagation.centring import centre_of, moved_read, moved_rows
from bayesmc.engines.propagation.conjugate import ConjugateBatch
from bayesmc.engines.propagation.coordinates import Numbers
from bayesmc.engines.propagation.density import Read
from bayesmc.engines.propagation.kernels import Switched, Tables
from bayesmc.engines.propagation.lines import LineBatch
from bayesmc.engines.propagation.scopes import Rows, basis, is_one_row, padded
from bayesmc.engines.propagation.statistics import Kept, Linear, OwnFamilies
from bayesmc.errors import BudgetError, UnsupportedError, ZeroProbabilityError
from bayesmc.network import Problem
from bayesmc.structure import Variable
from bayesmc.structure.target import Target

#: coordinates of one component, whose covariance is kept whole
_WIDEST = 4000
_EPSILON = float(np.finfo(float).eps)
#: name, scope and logs of a factor of finite variables
Table = tuple[str, tuple[Variable, ...], np.ndarray]


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
    kept : dict
        Nodes that keep their own family.
    """

    target: Target
    beliefs: Beliefs
    batches: list[Batch]
    numbers: dict[str, Numbers]
    places: dict[Variable, tuple[int, int]]
    log_scale: float
    exact: dict[str, int] = field(default_factory=dict)
    loops: bool = False
    kept: dict[str, Kept] = field(default_factory=dict)

    @property
    def is_exact(self) -> bool:
        """Whether nothing is approximated: all is linear-Gaussian, and tables hang together in trees."""
        return not self.loops and all(b.is_exact for b in self.batches)


class Assembly:
    """Parts put together into batches."""

    def __init__(
        self,
        problem: Problem,
        target: Target,
        numbers: dict[str, Numbers],
        parts: Sequence[Rows | Read],
        tables: Sequence[Table],
        states: Mapping[Variable, int],
        own: OwnFamilies,
    ) -> None:
        self.own = own
        self.problem, self.target, self.numbers = problem, target, numbers
        self.model, self.states = problem.model, states
        self.rows = [p for p in parts if isinstance(p, Rows)]
        self.reads = [p for p in parts if isinstance(p, Read)]
        self.tables = [t for t in tables if t[1]]
        self.log_scale = float(sum(t[2] for t in tables if not t[1])) + log_constants(target)
        self.log_scale += own.log_scale
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
        self._centre(component)
        self._clamp()
        exact = self._enter_exact()
        self.beliefs.families = self.own.fields
        batches = [*self._table_batches(), *self._row_batches(), *self._read_batches()]
        batches += self._own_batches()
        batches.sort(key=lambda b: self.order.get(b.name, -1))
        places = self.places
        found = System(
            self.target,
            self.beliefs,
            batches,
            self.numbers,
            places,
            self.log_scale,
            exact,
            self._has_loops(),
            self.own.nodes,
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
        for read in self._scoped():
            for name, at in read.scope:
                used.update(dict.fromkeys((name, int(e)) for e in at))
        for name in self.target.chain:
            node = self.model[name]
            if node.domain is not None:
                used.update(dict.fromkeys((name, e) for e in range(math.prod(node.plate_shape))))
        self.groups: list[tuple[int, Variable]] = []
        cards = sorted({self._card(v) for v in used})
        filled = dict.fromkeys(cards, 0)
        self.places: dict[Variable, tuple[int, int]] = {}
        for variable in used:
            card = self._card(variable)
            self.places[variable] = cards.index(card), filled[card]
            filled[card] += 1
            self.groups.append((card, variable))

    def _card(self, variable: Variable) -> int:
        domain = self.model[variable[0]].domain
        assert domain is not None
        return domain.size

    def _groups(self) -> Iterable[np.ndarray]:
        """Coordinates that one factor reads, a row for each."""
        for row in self.rows:
            if len(row.coordinates):
                yield row.coordinates[None]
        for read in self.reads:
            if read.coordinates.shape[1]:
                yield read.coordinates[: 1 if is_one_row(read.coordinates) else None]

    def _centre(self, component: np.ndarray) -> None:
        """Count coordinates from where they will end, roughly."""
        prior = partial(_prior_draws, self.problem, self.numbers, len(component))
        centre = centre_of(component, self.rows, self.reads, self.numbers, prior)
        if centre.any():
            self.rows = [moved_rows(row, centre) for row in self.rows]
            self.reads = [moved_read(read, centre) for read in self.reads]
            self.beliefs.centre = centre

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
            if len(row.coordinates):
                beliefs.enter(row.coordinates, matrix, value)
        return found

    def _table_batches(self) -> list[Batch]:
        found = []
        for (name, shape), group in groupby(self.tables, key=lambda t: (t[0], t[2].shape)):
            members = list(group)
            logs = self._levelled(np.stack([t[2] for t in members]))
            edges = tuple(self._edge([t[1][k] for t in members]) for k in range(len(shape)))
            found.append(Batch(name, Tables(logs), len(members), edges, shape))
        return found

    def _row_batches(self) -> list[Batch]:
        switched = sorted(
            (r for r in self.rows if r.scope), key=lambda r: (self.order[r.name], r.element)
        )
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
                logs = self._levelled(logs - 0.5 * (value**2).sum(axis=-1))
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
                assert isinstance(read.kernel, Tables)
                kernel = Tables(self._levelled(read.kernel.logs))
                found.append(Batch(read.name, kernel, len(read.elements), edges, cards))
                continue
            found += self._placed(
                read.name, read.kernel, edges, cards, read.coordinates, read.weights,
                read.name in self.numbers, read.elements,
            )  # fmt: skip
        return found

    def _levelled(self, logs: np.ndarray) -> np.ndarray:
        """Tables with their largest entries at 0; what is taken out goes into the evidence."""
        top = logs.max(axis=tuple(range(1, logs.ndim)), keepdims=True)
        if not np.isfinite(top).all():
            raise ZeroProbabilityError("ExpectationPropagation: the evidence has probability zero")
        self.log_scale += float(top.sum())
        return np.maximum(logs - top, IMPOSSIBLE)

    def _scoped(self) -> list[Read | Linear]:
        """Whatever reads finite variables, but for rows and tables."""
        return [*self.reads, *self.own.factors.values()]

    def _own_batches(self) -> list[Batch]:
        found: list[Batch] = []
        for read in self.own.factors.values():
            edges = tuple(self._edge([(name, int(e)) for e in at]) for name, at in read.scope)
            cards = tuple(self._card((name, 0)) for name, _ in read.scope)
            how = "conjugate in every state" if cards else "conjugate, exact"
            kernel = Tables(np.zeros(0), how)
            found.append(
                ConjugateBatch(
                    read.name,
                    kernel,
                    len(read.at),
                    edges,
                    cards,
                    field=read.field,
                    at=read.at,
                    coefficients=read.coefficients,
                    offsets=read.offsets,
                )  # fmt: skip
            )
        return found

    def _edge(self, variables: Sequence[Variable]) -> Edge:
        places = [self.places[v] for v in variables]
        return Edge(places[0][0], np.array([p for _, p in places]))

    def _placed(
        self, name: str, kernel: Kernel, edges: Sequence[Edge], cards: tuple[int, ...],
        coordinates: np.ndarray, weights: np.ndarray, is_prior: bool, elements: np.ndarray,
    ) -> list[Batch]:  # fmt: skip
        """Batches of factors in components of one size each."""
        beliefs, found = self.beliefs, []
        everyone = np.arange(len(coordinates))
        shared = is_one_row(coordinates)
        if shared:
            sizes = beliefs.size[coordinates[:1, 0]]
        else:
            sizes = beliefs.size[coordinates[:, 0]]
        for block in np.unique(sizes):
            mine = everyone if shared else np.flatnonzero(sizes == block)
            at = coordinates[:1] if shared else coordinates[mine]
            component, places = beliefs.component[at[:, 0]], beliefs.place[at]
            kind = LineBatch if weights.shape[1] == 1 and not edges else Batch
            found.append(
                kind(
                    name,
                    kernel,
                    len(mine),
                    tuple(Edge(e.group, e.at[mine]) for e in edges),
                    cards,
                    int(block),
                    np.broadcast_to(component, (len(mine),)),
                    np.broadcast_to(places, (len(mine), places.shape[1])),
                    weights if len(mine) == len(weights) else weights[mine],
                    is_prior,
                    elements[mine],
                    mine,
                )  # fmt: skip
            )
        return found

    def _has_loops(self) -> bool:
        """Whether finite variables and their factors are no forest."""
        variables = list(self.places)
        index = {v: k for k, v in enumerate(variables)}
        scopes = [t[1] for t in self.tables if len(t[1]) > 1]
        scopes += [r.scope for r in self.rows if len(r.scope) > 1]
        for read in self._scoped():
            if len(read.scope) > 1:
                scopes += [
                    tuple((n, int(at[k])) for n, at in read.scope)
                    for k in range(len(read.scope[0][1]))
                ]
        total = len(variables) + len(scopes)
        edges = [(len(variables) + k, index[v]) for k, s in enumerate(scopes) for v in set(s)]
        parts = components(total, [np.array(edges)] if edges else []).max(initial=-1) + 1
        return len(edges) > total - parts


# ---- private ------------------------------------------------------------------------------------


def _begin(problem: Problem, system: System) -> None:
    """Messages to start with: of densities that are approximated, moments of draws from the prior."""
    beliefs = system.beliefs
    priors = [b for b in system.batches if b.k and b.is_prior]
    if priors:
        mean, spread = _prior_draws(problem, system.numbers, len(beliefs.size))
        mean = mean - beliefs.centre
        for batch in priors:
            at = _global(beliefs, batch)
            middle = np.matvec(batch.weights, mean[at])
            wide = batch.weights * spread[at][:, None, :] ** 2
            cov = wide @ np.matrix_transpose(batch.weights)
            batch.begin(beliefs, middle, cov)
    for block in beliefs.blocks:
        if not len(block.linear):
            continue
        improper = block.refreshed()
        if improper.any():
            _refuse_improper(block.precision[improper][0])


def _refuse_improper(precision: np.ndarray) -> None:
    """Say why numbers have no joint Gaussian: no prior, or one beside which noise is too small to tell."""
    own = precision.diagonal()
    if np.isfinite(precision).all() and (own > 0).all():
        smallest = np.linalg.eigvalsh(precision)[0]
        if abs(smallest) <= 10.0 * len(own) * _EPSILON * own.max():
            raise UnsupportedError(
                "ExpectationPropagation: rounding hides what is known of some numbers beside noise as small "
                f"as a standard deviation of {own.max() ** -0.5:.2g}, or they have no proper prior; give "
                "more noise or a narrower prior, or use Exact() where all is linear-Gaussian"
            )
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


def _prior_draws(
    problem: Problem, numbers: Mapping[str, Numbers], count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Middles and spreads of all coordinates under the prior, roughly: medians and quartiles."""
    mean, spread = np.zeros(count), np.full(count, 10.0)
    try:
        model = problem.model
        probe = {n: model.probe[n].reshape(-1, *model[n].value_shape) for n in numbers}
    except (KeyError, ValueError):  # what the prior is like is not known: anything will do
        return mean, spread
    for name, x in numbers.items():
        with np.errstate(all="ignore"):
            free = x.freed(probe[name])
        low, middle, high = np.nanquantile(free, [0.2, 0.5, 0.8], axis=0)
        wide = np.maximum((high - low) / 1.6, 1e-3)
        good = np.isfinite(middle) & np.isfinite(wide) & (x.at >= 0)
        mean[x.at[good]], spread[x.at[good]] = middle[good], 2.0 * wide[good]
    return mean, spread
