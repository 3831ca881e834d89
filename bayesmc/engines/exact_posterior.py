"""An exact posterior over finite nodes, answered from a calibrated clique tree."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bayesmc.errors import BudgetError, UnknownNodeError, UnsupportedError
from bayesmc.factors import Calibrated
from bayesmc.network import Problem
from bayesmc.network.forward import Compute, Pass, run
from bayesmc.randomness import Purpose, seed_sequence, stream
from bayesmc.results.draws import DrawsPosterior
from bayesmc.results.marginal import Marginal
from bayesmc.results.posterior import Plates, Posterior, table_variance, whole_draws
from bayesmc.results.query import Query
from bayesmc.structure import DiscreteNet, Variable, configure, known_values

#: configurations up to which a function is averaged over a joint table
_QUERY_ENTRIES = 1 << 22


class ExactPosterior(Posterior):
    """Queries answered from tables, without Monte Carlo error.

    Parameters
    ----------
    net : DiscreteNet
    calibrated : Calibrated
        Both passes done, evidence entered.
    """

    log_marginal_likelihood_mcse = 0.0

    def __init__(
        self, problem: Problem, engine: Any, net: DiscreteNet, calibrated: Calibrated
    ) -> None:
        super().__init__(problem, engine)
        self._net = net
        self._known_values = known_values(problem.model, net.constants, problem.observed)
        self._calibrated = calibrated
        self.log_marginal_likelihood = float(calibrated.log_z)

    # ---- tables ------------------------------------------------------------------------------

    def probabilities(self, *names: str) -> np.ndarray:
        if not names:
            raise UnknownNodeError("probabilities(): name at least one node")
        nodes = [self._finite(name) for name in names]
        if len(nodes) == 1:
            return self._table(names[0])
        plates = tuple(dict.fromkeys(p for node in nodes for p in node.plates))
        sizes = tuple(self.model.sizes[p] for p in plates)
        cards = tuple(node.domain.size for node in nodes if node.domain is not None)
        tables = [
            self._joint([self._element(name, plates, at) for name in names])
            for at in np.ndindex(sizes)
        ]
        return np.reshape(np.stack(tables) if tables else np.zeros(sizes + cards), sizes + cards)

    def _table(self, name: str) -> np.ndarray:
        """Marginal tables of all elements of a finite node, shape ``(*plates, states)``."""
        node = self.model[name]
        assert node.domain is not None
        if node.kind == "fixed":
            assert node.declaration.value is not None
            return np.eye(node.domain.size)[node.declaration.value.astype(np.intp)]
        if not node.plate_shape:
            return self._calibrated.marginal((name, 0)).copy()
        count = math.prod(node.plate_shape)
        rows = [self._calibrated.marginal((name, e)) for e in range(count)]
        if not rows:
            return np.zeros((*node.plate_shape, node.domain.size))
        return np.reshape(np.stack(rows), (*node.plate_shape, node.domain.size))

    def _joint(self, variables: Sequence[Variable]) -> np.ndarray:
        """Joint table of variables that may repeat or be fixed by ``do``."""
        free = [v for v in dict.fromkeys(variables) if v in self._net.cards]
        table = self._calibrated.joint(free)
        grid = np.ix_(*(range(self._card(v)) for v in variables))
        index = tuple(grid[variables.index(v)] for v in free)
        shape = tuple(self._card(v) for v in variables)
        full = np.array(np.broadcast_to(table[index], shape))
        for axis, variable in enumerate(variables):
            first = variables.index(variable)
            if first < axis:
                full = np.where(grid[first] == grid[axis], full, 0.0)
            elif variable not in self._net.cards:
                value = self.model[variable[0]].declaration.value
                assert value is not None
                full = np.where(grid[axis] == value.flat[variable[1]], full, 0.0)
        return full

    def _card(self, variable: Variable) -> int:
        domain = self.model[variable[0]].domain
        assert domain is not None
        return domain.size

    def _element(self, name: str, plates: Sequence[str], at: Sequence[int]) -> Variable:
        node = self.model[name]
        own = tuple(at[plates.index(p)] for p in node.plates)
        return name, int(np.ravel_multi_index(own, node.plate_shape)) if own else 0

    # ---- moments -----------------------------------------------------------------------------

    def mean(self, name: str) -> np.ndarray:
        node = self._numeric(name, "mean")
        if node.domain is not None:
            return self._table(name) @ np.asarray(node.domain.numbers, dtype=float)
        return self._moment(name, lambda x: x)

    def var(self, name: str) -> np.ndarray:
        node = self._numeric(name, "var")
        if node.domain is not None:
            numbers = np.asarray(node.domain.numbers, dtype=float)
            return table_variance(self._table(name), numbers)
        mean = self.mean(name)
        return self._moment(name, lambda x: (x - mean) ** 2)

    def _moment(self, name: str, power: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """Of an observed node, or of a deterministic one without a finite domain."""
        seen = self._known(name)
        if seen is not None:
            return np.asarray(power(seen), dtype=float)
        return self.expectation(lambda x: power(x), names={"x": name})

    def _known(self, name: str) -> np.ndarray | None:
        """The value of a node without a domain that does not vary."""
        return self._known_values.get(name) if self.model[name].domain is None else None

    def cov(self, *names: str) -> np.ndarray:
        if not names:
            raise UnknownNodeError("cov(): name at least one node")
        scalars: list[tuple[Variable, np.ndarray]] = []
        for name in names:
            node = self._numeric(name, "cov")
            if node.domain is None:
                raise self._cannot(f"cov of {name!r}, which has no finite set of values,")
            numbers = np.asarray(node.domain.numbers, dtype=float)
            count = math.prod(node.plate_shape)
            scalars += [((name, e), numbers) for e in range(count)]
        matrix = np.empty((len(scalars), len(scalars)))
        for i, (a, x) in enumerate(scalars):
            for j, (b, y) in enumerate(scalars[: i + 1]):
                table = self._joint([a, b])
                x0, y0 = x - table.sum(1) @ x, y - table.sum(0) @ y
                matrix[i, j] = matrix[j, i] = x0 @ table @ y0
        return matrix[0, 0] if matrix.size == 1 else matrix

    def quantile(self, name: str, q: Any) -> np.ndarray:
        node = self._numeric(name, "quantile")
        levels = np.asarray(q, dtype=float)
        if not ((levels >= 0) & (levels <= 1)).all():
            raise ValueError(f"quantile({name!r}, {q!r}): quantiles lie between 0 and 1")
        if node.domain is None:
            seen = self._known(name)
            if seen is None:
                raise self._cannot(f"quantile of {name!r}, which has no finite set of values,")
            return np.broadcast_to(seen, levels.shape + seen.shape).copy()
        numbers = np.asarray(node.domain.numbers)
        order = np.argsort(numbers)
        below = np.cumsum(self._table(name)[..., order], axis=-1)
        reach = below >= levels.reshape(levels.shape + (1,) * below.ndim) - 1e-12
        return numbers[order][np.argmax(reach, axis=-1)]

    def _figures(self, name: str) -> dict[str, np.ndarray]:
        node = self.model[name]
        if node.domain is not None or self._known(name) is not None or self.problem is not None:
            return super()._figures(name)
        empty = np.full(node.value_shape, np.nan)  # its function stayed behind when it was pickled
        columns = ("mean", "sd", *self._quantile_columns(name), "mcse", "ess", "rhat")
        return dict.fromkeys(columns, empty)

    def _quantile_columns(self, name: str) -> dict[str, np.ndarray]:
        node = self.model[name]
        if node.domain is not None or self._known(name) is not None:
            return super()._quantile_columns(name)
        return {column: np.full(node.value_shape, np.nan) for column in self._quantile_names()}

    # ---- functions ---------------------------------------------------------------------------

    def expectation(
        self,
        function: Callable[..., Any] | str,
        plates: Plates = (),
        names: Mapping[str, str] | None = None,
    ) -> np.ndarray:
        return self._average(function, plates, names)

    def probability(
        self,
        function: Callable[..., Any],
        plates: Plates = (),
        names: Mapping[str, str] | None = None,
    ) -> np.ndarray:
        return self._average(function, plates, names, events=True)

    def _average(
        self,
        function: Callable[..., Any] | str,
        plates: Plates,
        names: Mapping[str, str] | None,
        events: bool = False,
    ) -> np.ndarray:
        """The function on every configuration of what it needs, averaged over their joint table."""
        query = Query(self.model, function, plates, names)
        if 0 in query.plate_shape:
            return np.zeros(query.plate_shape)
        if self._missing(query.nodes):
            self._live("expectation of a deterministic node")
        finite = self._above(query.nodes)
        alone = tuple(n for n in finite if set(self.model[n].plates) <= set(query.plates))
        if any(set(self.model[n].plates) - set(query.plates) for n in self._passed(query.nodes)):
            alone = ()
        whole = tuple(n for n in finite if n not in alone)
        variables = [self._element(n, query.plates, (0,) * len(query.plates)) for n in alone]
        rest = [(n, e) for n in whole for e in range(math.prod(self.model[n].plate_shape))]
        entries = float(math.prod([self._card(v) for v in [*variables, *rest]]))
        if entries > _QUERY_ENTRIES:
            raise BudgetError(
                f"expectation: the function needs the joint table of {len(variables) + len(rest)} nodes "
                f"({entries:.3g} entries); draw from the posterior with resample(draws)",
                int(min(8 * entries, 2**62)),
            )
        with np.errstate(all="ignore"):
            values, cards = configure(
                self.model, self._known_values, alone, whole, self._missing(query.nodes)
            )
        flat = {n: _flat(values[n], cards, self.model[n].value_shape) for n in query.nodes}
        results = query(flat, (math.prod(cards),))
        if events and results.dtype.kind != "b":
            raise UnsupportedError(
                f"probability: the function returns {results.dtype} values, not booleans; use expectation"
            )
        sizes = query.plate_shape
        out = np.empty(sizes + results.shape[1 + len(sizes) :])
        for at in np.ndindex(sizes):
            table = self._joint([self._element(n, query.plates, at) for n in alone] + rest).ravel()
            part = results[(slice(None), *at)].astype(float)
            possible = table > 0  # elsewhere the function may give anything
            out[at] = np.tensordot(table[possible], part[possible], axes=1)
        return out

    def _above(self, nodes: Sequence[str]) -> tuple[str, ...]:
        """Finite nodes that the named ones are, or are computed from."""
        found: dict[str, None] = {}
        todo = list(nodes)
        while todo:
            name = todo.pop(0)
            node = self.model[name]
            if node.domain is not None and node.kind != "fixed":
                found[name] = None
            elif self._known(name) is None and not node.is_stochastic:
                todo += node.parents
        return tuple(found)

    def _passed(self, nodes: Sequence[str]) -> tuple[str, ...]:
        """Deterministic nodes without a domain on the way to the finite ones."""
        found: list[str] = []
        todo = [n for n in nodes if self.model[n].domain is None and self._known(n) is None]
        while todo:
            name = todo.pop()
            found.append(name)
            todo += [p for p in self.model[name].parents if self.model[p].domain is None]
        return tuple(n for n in found if not self.model[n].is_stochastic)

    def _missing(self, nodes: Sequence[str]) -> list[str]:
        return [n for n in nodes if self.model[n].domain is None and self._known(n) is None]

    # ---- draws and diagnostics ----------------------------------------------------------------

    def mcse(self, what: Any) -> np.ndarray:
        return np.zeros(self._shape_of(what))

    def ess(self, what: Any) -> np.ndarray:
        return np.full(self._shape_of(what), np.inf)

    def rhat(self, what: Any) -> np.ndarray:
        return np.full(self._shape_of(what), np.nan)

    def _shape_of(self, what: Any) -> tuple[int, ...]:
        if callable(what):
            return self.expectation(what).shape
        node = self._node(what)
        if node.domain is not None and node.domain.labels is not None:
            return (*node.plate_shape, node.domain.size)
        return node.value_shape

    def marginal(self, name: str, index: Any = ()) -> Marginal:
        node = self._finite(name)
        assert node.domain is not None
        values = np.arange(node.domain.size) if node.domain.labels else node.domain.numbers
        table = self._table(name)[index if isinstance(index, tuple) else (index,)]
        return Marginal(name, np.asarray(values), table, node.domain.states)

    def resample(self, draws: int | None = None, rng: Any = None) -> DrawsPosterior:
        problem = self._live("resample")
        count = 1000 if draws is None else whole_draws(draws)
        generator = stream(seed_sequence(rng), Purpose.RESAMPLE)
        drawn = self._calibrated.sample(generator, count)
        values = dict(self._known_values)
        for name, node in self.model.nodes.items():
            if node.domain is not None and node.kind != "fixed":
                elements = range(math.prod(node.plate_shape))
                empty = np.zeros((count, 0))
                columns = np.stack([drawn[(name, e)] for e in elements], -1) if elements else empty
                values[name] = columns.reshape((count, *node.plate_shape)).astype(node.domain.dtype)
        rest = [
            Compute(self.model, n) for name, n in self.model.nodes.items() if name not in values
        ]
        with np.errstate(all="ignore"):
            values = run(rest, Pass(generator, (count,), values)).values
        stored = {
            name: value[None]
            if value.ndim > len(self.model[name].value_shape)
            else value[None, None]
            for name, value in values.items()
        }
        return DrawsPosterior(problem, self.engine, stored, (1, count), independent=True)

    def predict(
        self,
        names: str | Sequence[str],
        inputs: Mapping[str, Any] | None = None,
        plates: Mapping[str, int] | None = None,
        rng: Any = None,
        draws: int | None = None,
    ) -> DrawsPosterior:
        seed = seed_sequence(rng)
        source = self.resample(4000 if draws is None else draws, seed)
        return source.predict(names, inputs, plates, seed)

    def to_datatree(self, resample: int | None = None, rng: Any = None) -> Any:
        if resample is None:
            raise UnsupportedError(
                "to_datatree: an exact posterior has no draws; pass resample=draws"
            )
        return self.resample(resample, rng).to_datatree()

    def __getstate__(self) -> dict[str, Any]:
        state = super().__getstate__()
        return {**state, "_net": replace(self._net, model=state["model"], evidence_sources=[])}


def _flat(values: np.ndarray, cards: tuple[int, ...], shape: tuple[int, ...]) -> np.ndarray:
    """Values over all configurations, with one batch axis."""
    return np.broadcast_to(values, cards + shape).reshape((math.prod(cards), *shape))
