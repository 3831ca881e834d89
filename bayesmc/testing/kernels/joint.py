"""The joint law of state and data, which tests of kernels and engines hold these against.

A net says it: its hidden nodes are the state, its observed ones the data, and both are drawn forwards. A
model that is no net gives two simulators and its statistics (`JointModel`). What moves states is not
known here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions.base import Distribution, marking_invalid
from bayesmc.errors import DensityError, ModelError, ShapeError, UnknownNodeError, UnsupportedError
from bayesmc.network import BayesNet, FactorGraph, Model, pose
from bayesmc.network.forward import refuse_unsampled
from bayesmc.results.query import Query
from bayesmc.structure.target import Target, target_of
from bayesmc.testing.verdict import as_real

#: stored values, a row for each draw: ``(rows, *plates, *event)``
Rows = dict[str, np.ndarray]
#: ``prior(rng, n)``: ``n`` draws of the state, in arrays (or a container of arrays) of ``n`` rows
Prior = Callable[[np.random.Generator, int], Any]
#: ``simulate(state, rng)``: data for every row of the state
Simulate = Callable[[Any, np.random.Generator], Any]
#: ``move(state, data, rng)``: the next state of every row
Move = Callable[[Any, Any, np.random.Generator], Any]
#: name -> ``statistic(state, data)``, one real number for every row
Statistics = Mapping[str, Callable[[Any, Any], Any]]


@dataclass(frozen=True, eq=False)
class JointModel:
    """A model that is no net, as tests of kernels take it.

    A kernel of it is a function ``kernel(state, data, rng)`` that moves *all rows at once*, each with random
    numbers of its own (``rng.normal(size=n)``, not ``rng.normal()``), and returns the next state.

    Attributes
    ----------
    prior : callable
        ``prior(rng, n)`` returns ``n`` independent states; arrays with ``n`` rows, in any container.
    simulate : callable
        ``simulate(state, rng)`` returns data given each row of ``state``.
    statistics : dict
        Name -> ``statistic(state, data)``, which returns one finite number for each row.

    Examples
    --------
    >>> from bayesmc.testing import JointModel, rank_test
    >>> model = JointModel(
    ...     prior=lambda rng, n: rng.normal(size=n),
    ...     simulate=lambda x, rng: rng.normal(x, 1.0),
    ...     statistics={"x": lambda x, y: x, "x^2": lambda x, y: x**2},
    ... )
    >>> def draw(x, y, rng):
    ...     return rng.normal(y / 2, 0.5**0.5)
    >>> bool(rank_test(draw, model, replications=200, rng=0))
    True
    """

    prior: Prior
    simulate: Simulate
    statistics: Statistics


def check_statistics(call: str, statistics: Any, functions: str) -> None:
    """Raise unless these are functions by name; ``functions`` says in words of what."""
    fix = f"give a dict of name -> {functions}"
    if not isinstance(statistics, Mapping):
        kind = type(statistics).__name__
        raise TypeError(f"{call}: statistics is a {kind}, not a dict; {fix}")
    if not statistics:
        raise ValueError(f"{call}: no statistics; {fix}")
    for name, function in statistics.items():
        if not isinstance(name, str):
            raise TypeError(f"{call}: the name {name!r} of a statistic is not a string; {fix}")
        if isinstance(function, type) or not callable(function):
            raise TypeError(
                f"{call}: statistics[{name!r}] is {function!r}, which is not a function; {fix}"
            )


class NetStates:
    """Which nodes of a compiled net are the state, and what their values say of all others.

    Attributes
    ----------
    model : Model
    hidden, observed : tuple of str
        Stochastic nodes, parents first.
    inputs : dict
        Stored inputs.
    """

    def __init__(
        self, model: Model, inputs: Rows, hidden: Sequence[str], observed: Sequence[str]
    ) -> None:
        self.model, self.inputs = model, inputs
        self.hidden, self.observed = tuple(hidden), tuple(observed)

    def complete(self, state: Rows, data: Rows) -> Rows:
        """Values of all nodes: deterministic ones computed, inputs with them."""
        return self._forward({**state, **data}, (), None, 0)

    def _forward(
        self, given: Rows, names: Sequence[str], rng: np.random.Generator | None, rows: int
    ) -> Rows:
        """The given values, with ``names`` drawn and deterministic nodes computed as far as they can be."""
        values: Rows = {**self.inputs, **given}
        with marking_invalid(), np.errstate(all="ignore"):
            for name, node in self.model.nodes.items():
                if name in values or not all(p in values for p in node.parents):
                    continue
                if node.is_stochastic and name not in names:
                    continue
                result, _ = self.model.evaluate(name, values)
                if isinstance(result, Distribution):
                    assert rng is not None
                    result = self.model.sample_stored(name, result, rng, (rows,))
                values[name] = result
        return values


class NetJoint(NetStates):
    """The joint law that a net declares.

    Parameters
    ----------
    net : BayesNet
        Without potentials: it is drawn forwards.
    observed : sequence of str, optional
        Nodes that are data; by default the stochastic nodes without stochastic descendants, where others
        remain.
    inputs : dict, optional

    Raises
    ------
    UnknownNodeError
        An observed name is no node.
    ModelError
        It is no stochastic one; or a hidden node depends on it, so that data cannot be drawn given the state.
    UnsupportedError
        The net cannot be drawn forwards.
    """

    def __init__(
        self, net: Any, observed: str | Sequence[str] | None = None, inputs: Any = None
    ) -> None:
        if isinstance(net, FactorGraph):
            raise UnsupportedError(
                "a FactorGraph cannot be drawn forwards, so there is no joint law of state and data to test "
                "against; test its kernels with invariant(kernel, graph), or give a JointModel"
            )
        if not isinstance(net, BayesNet):
            raise UnsupportedError(
                f"the joint law is that of a BayesNet (or JointModel), not of {type(net).__name__}; "
                "arguments are (kernel, net), and a template is unrolled first: dbn.unroll(steps)"
            )
        self.net: BayesNet = net
        problem = pose(net, None, inputs)
        super().__init__(problem.model, problem.inputs, (), ())
        self.user_inputs = inputs
        if self.model.potentials:
            raise UnsupportedError(
                f"the potential {next(iter(self.model.potentials))!r} reweights the net, which then cannot "
                "be drawn forwards; write it as an observed node, or give a JointModel"
            )
        refusal = refuse_unsampled(self.model, (), "this test")
        if refusal:
            raise UnsupportedError(refusal)
        self.observed = self._observed(observed)
        self.hidden = tuple(n for n in self.stochastic if n not in self.observed)
        if not self.hidden:
            raise ModelError(
                f"observed={list(self.observed)} leaves nothing hidden, so there is nothing to test"
            )

    @property
    def stochastic(self) -> tuple[str, ...]:
        return tuple(n for n, node in self.model.nodes.items() if node.is_stochastic)

    def prior(self, rng: np.random.Generator, rows: int) -> Rows:
        """Draws of the hidden nodes."""
        values = self._forward({}, self.hidden, rng, rows)
        return {n: values[n] for n in self.hidden}

    def simulate(self, state: Rows, rng: np.random.Generator) -> Rows:
        """Data given hidden nodes, row by row."""
        values = self._forward(state, self.observed, rng, _count(state))
        return {n: values[n] for n in self.observed}

    def evidence(self, data: Rows, row: int = 0) -> dict[str, Any]:
        """One row of data as a user gives it."""
        return {n: as_evidence(self.model[n].decode(v[row])) for n, v in data.items()}

    def target(self) -> Target:
        """Log densities of the joint law: all stochastic nodes are in the chain."""
        return target_of(pose(self.net, None, self.user_inputs), also=self.stochastic)

    def read(self, call: str, statistics: Mapping[str, Callable[..., Any]]) -> Statistics:
        """Users' statistics, functions whose argument names are nodes, as functions of state and data."""
        check_statistics(call, statistics, "function of nodes, {'x squared': lambda x: x**2}")
        return {name: self._reading(call, name, f) for name, f in statistics.items()}

    # ---- private -------------------------------------------------------------------------------

    def _observed(self, observed: str | Sequence[str] | None) -> tuple[str, ...]:
        nodes = self.model.nodes
        above: set[str] = set()  # all that something stochastic depends on
        for name in reversed(list(nodes)):
            if nodes[name].is_stochastic or name in above:
                above |= set(nodes[name].parents)
        if observed is None:
            leaves = tuple(n for n in self.stochastic if n not in above)
            return leaves if len(leaves) < len(self.stochastic) else ()
        if not isinstance(observed, Iterable):
            raise TypeError(f"observed={observed!r}: give the name of a node, or a list of names")
        chosen = (observed,) if isinstance(observed, str) else tuple(observed)
        for name in chosen:
            if name not in nodes:
                raise UnknownNodeError(
                    f"observed={list(chosen)}: the net has no node {name!r}; it has {list(nodes)}"
                )
            if not nodes[name].is_stochastic:
                raise ModelError(f"observed={list(chosen)}: {name!r} is not a stochastic node")
        below = set(chosen)
        for name, node in nodes.items():
            if below & set(node.parents):
                if node.is_stochastic and name not in chosen:
                    source = next(iter(below & set(node.parents)))
                    raise ModelError(
                        f"observed={list(chosen)}: the hidden node {name!r} depends on {source!r}, so that "
                        f"data cannot be drawn given the state; observe {name!r}, too, or leave "
                        f"{source!r} hidden"
                    )
                below.add(name)
        return tuple(n for n in self.stochastic if n in chosen)

    def _reading(
        self, call: str, name: str, function: Callable[..., Any]
    ) -> Callable[[Rows, Rows], Any]:
        try:
            query = Query(self.model, function)
        except UnknownNodeError as error:
            unknown = str(error).split(";")[0].removeprefix("query: ")
            raise UnknownNodeError(
                f"{call}: statistic {name!r}: {unknown}; the net has {', '.join(self.model.nodes)}"
            ) from None

        def statistic(state: Rows, data: Rows) -> np.ndarray:
            rows = _count(state)
            stored = {
                n: np.broadcast_to(v, (rows, *self.model[n].value_shape))
                for n, v in self.complete(state, data).items()
            }
            value = query(stored, (rows,))
            if value.shape != (rows,):
                raise ShapeError(
                    f"statistic {name!r} returned shape {value.shape} for {rows} rows; return one number for "
                    "each: keep the leading axis and reduce the others (axis=-1)"
                )
            return as_real(f"{call}: statistic {name!r}", value)

        return statistic


def as_evidence(value: Any) -> Any:
    """One decoded value of a node in the form of evidence: labels, numbers or arrays of them."""
    labels = getattr(value, "labels", value)
    return labels.item() if np.ndim(labels) == 0 else np.array(labels)


def values_of(call: str, statistics: Statistics, state: Any, data: Any, rows: int) -> np.ndarray:
    """All statistics, shape ``(statistics, rows)``; a copy, for kernels that work in place."""
    out = np.empty((len(statistics), rows))
    for i, (name, statistic) in enumerate(statistics.items()):
        value = np.asarray(statistic(state, data))
        if value.shape != (rows,):
            raise ShapeError(
                f"{call}: statistic {name!r} returned shape {value.shape} for {rows} rows; return one number "
                f"for each row, shape ({rows},), and let states and data of a JointModel have as many rows"
            )
        out[i] = as_real(f"{call}: statistic {name!r}", value)
        if not np.isfinite(out[i]).all():
            row = int(np.flatnonzero(~np.isfinite(out[i]))[0])
            raise DensityError(
                f"{call}: statistic {name!r} is {out[i, row]} in row {row}; "
                "look for a kernel that leaves the support, or use a bounded statistic"
            )
    return out


def check_sizes(call: str, **sizes: tuple[Any, int]) -> None:
    """Raise ValueError unless every size is a whole number that is large enough."""
    for name, (size, least) in sizes.items():
        if isinstance(size, bool) or not isinstance(size, (int, np.integer)) or size < least:
            raise ValueError(f"{call}({name}={size!r}): give a whole number, at least {least}")


def _count(state: Rows) -> int:
    return len(next(iter(state.values())))
