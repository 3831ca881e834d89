"""Children that meet their plate through one label only: mixtures, summed by label.

The child's function is called on every label instead of every element, which was found to say the same,
and data are summed by label. Where tracing shows that its parameters are nothing but nodes looked up by
the label, times a constant, even that call is left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution, LogNormal, MvNormal, Normal
from bayesmc.kernels.conjugate_data import Groups, groups_of
from bayesmc.kernels.conjugate_evaluation import Evaluated, Looked, padded
from bayesmc.kernels.conjugate_pairs import Pair
from bayesmc.kernels.conjugate_sums import ByElement, Collector
from bayesmc.kernels.precisions import Precision, kept_precision, precision_of
from bayesmc.network.model import arguments_of, call
from bayesmc.plates import Lookups, PlateArray
from bayesmc.structure.blanket import Blanket, Child
from bayesmc.structure.target import Values
from bayesmc.structure.traced import Untraceable, traced_term
from bayesmc.tracing import TracedCall, Tracer

#: elements per label from which on sums by label pay
_PER_LABEL = 4
#: families whose parameters may be read off nodes, with the axes of each parameter's event
_FAMILIES: dict[Any, dict[str, int]] = {
    Normal: {"loc": 0, "scale": 0},
    LogNormal: {"loc": 0, "scale": 0},
    MvNormal: {"loc": 1, "cov": 2},
}


class ByLabel:
    """A child evaluated label by label.

    Attributes
    ----------
    groups : Groups
        Sums of its data.
    shape : tuple of int
        Of its plates, with the labels on the last.
    direct : dict or None
        Parameters that are nodes looked up by label, where all are.
    """

    def __init__(self, blanket: Blanket, child: Child, groups: Groups) -> None:
        self.blanket, self.child, self.groups = blanket, child, groups
        self.node = blanket.target.model[child.term.name]
        self.shape = (1,) * (len(child.term.shape) - 1) + (groups.states,)
        domain = blanket.target.model[groups.label].domain
        assert domain is not None
        self._labels = np.arange(groups.states, dtype=domain.dtype).reshape(self.shape)
        self.direct: dict[str, _Source] | None = None

    def evaluated(self, values: Values, candidate: np.ndarray, steps: bool) -> Evaluated:
        """The child's function on all labels, with the node at a candidate."""
        data = self.groups.at(values)
        dist, keys = self.at_labels(values, candidate)
        term = self.child.term
        if dist.invalid is not None and (dist.invalid & (data.count > 0)).any():
            state = self.blanket.placed(values, candidate)
            full, batch, _ = self.blanket.distribution(self.child, state)
            term.refuse_out_of_range(full, batch, values[term.name])
        collector = Collector(self.child.relation, self.shape, keys, None)
        return Evaluated(dist, steps, len(self.shape), data, collector)

    def looked(self, values: Values) -> Looked:
        """The same without a call, where ``direct`` is known."""
        data = self.groups.at(values)
        if self.blanket.node.plates:
            return Looked(self.parameters(values), data, ByElement(self.shape))
        collector = Collector(self.child.relation, self.shape, (), None)
        return Looked(self.parameters(values), data, collector)

    def parameters(self, values: Values) -> dict[str, np.ndarray]:
        """Parameters by label read off the nodes, shape ``(lead, *ones, labels or 1, *event)``."""
        assert self.direct is not None
        return {name: self.parameter(name, values) for name in self.direct}

    def parameter(self, name: str, values: Values) -> np.ndarray:
        """One of them."""
        assert self.direct is not None
        source = self.direct[name]
        if source.node is None:
            return source.factor
        value = values[source.node]
        value = value.reshape(value.shape[: value.ndim - source.trailing] + source.shape)
        return value if source.is_copy else source.factor * value**source.power

    def precision(self, values: Values) -> Precision:
        """Of vectors by label, batch ``(lead, labels or 1)``."""
        assert self.direct is not None
        source = self.direct["cov"]
        if source.node is None or not source.is_copy:
            cov = self.parameter("cov", values)
            return precision_of(cov.reshape((len(cov), -1, *cov.shape[-2:])))
        cov = values[source.node]
        found = kept_precision(self.blanket.target, source.node, cov)
        if source.trailing == 3:
            return found
        return found.reshaped((-1, 1))

    def at_labels(
        self, values: Values, candidate: np.ndarray
    ) -> tuple[Distribution, tuple[Any, ...]]:
        """The child's distribution for every label, and the index by which it looked the node up."""
        state = self.blanket.placed(values, candidate)
        state[self.groups.label] = self._labels
        arguments, batch = arguments_of(self.node.links, state)
        watched = None
        for i, (parent, _) in enumerate(self.node.links):
            if self.child.relation.kind == "lookup" and parent == self.child.relation.source:
                a = arguments[i]
                assert isinstance(a, PlateArray)
                watched = Lookups(a.array, a.plates, a.own, a.event_ndim, parent)
                arguments[i] = watched
        dist = call(self.node.declaration, arguments, batch + self.shape, self.node.links)
        return dist, () if watched is None else watched.keys[0]


@dataclass(frozen=True, eq=False)
class _Source:
    """A parameter by label: ``factor * node**power``, or the factor alone.

    ``trailing`` axes of the node's value become ``shape``.
    """

    factor: np.ndarray
    node: str | None = None
    power: float = 1.0
    is_copy: bool = False
    trailing: int = 0
    shape: tuple[int, ...] = ()


def by_label(blanket: Blanket, child: Child, pair: Pair) -> ByLabel | None:
    """The way by labels, where it is found to be right and worth while."""
    target, model, term = blanket.target, blanket.target.model, child.term
    if child.relation.kind not in ("aligned", "lookup") or not target.is_known(term.name):
        return None
    own = set(term.plates)
    if not own or own & set(blanket.node.plates):
        return None
    inside = [p for p in term.parents if own & set(model[p].plates)]
    if len(inside) != 1 or model[inside[0]].plates != term.plates:
        return None
    label = inside[0]
    domain, size = model[label].domain, math.prod(term.shape)
    if domain is None or label in blanket.path or domain.size * _PER_LABEL > size:
        return None
    if domain.size in term.shape:  # an array of the function's own might fit by chance
        return None
    found = ByLabel(blanket, child, groups_of(target, term, label, pair.transform))
    if not _suffices(found):
        return None
    found.groups.used = True
    found.groups.second = found.groups.second or pair.squares
    return found


def read_directly(way: ByLabel, neutral: np.ndarray, above: tuple[str, ...]) -> Values | None:
    """Find out whether every parameter is one node looked up by label, and the node enters in order.

    The node is that of the blanket, which may also be the label itself.

    Returns
    -------
    dict or None
        Where that is so, an example of the hidden nodes, ``(1, *plates, *event)``.
    """
    target, name = way.blanket.target, way.blanket.name
    hidden = [n for n in target.chain if n in above and n != way.groups.label]
    if any(target.model[n].is_discrete for n in hidden):
        return None
    state = way.blanket.target.example(above)
    dist, keys = way.at_labels(state, state[name])
    wanted = _FAMILIES.get(type(dist))
    if wanted is None or dist.invalid is not None:
        return None
    if name != way.groups.label and not _is_in_order(way, keys):
        return None
    entered: dict[str, tuple[str, Tracer]] = {}
    for node in hidden:
        found = _entered(way, node)
        if found is None or not set(found) <= set(wanted) or set(found) & set(entered):
            return None
        entered |= {parameter: (node, value) for parameter, value in found.items()}
    ones = {n: np.ones_like(state[n]) for n in hidden if not target.model[n].event_shape}
    plain = {**state, **ones}
    target.refresh(plain, ones)
    at_one, _ = way.at_labels(plain, neutral)
    sources: dict[str, _Source] = {}
    for parameter, event_ndim in wanted.items():
        factor = padded(getattr(at_one, parameter), 1 + len(way.shape) + event_ndim)
        source = _source(way, factor, *entered.get(parameter, (name, None)))
        if source is None:
            return None
        sources[parameter] = source
    way.direct = sources
    if not _is_right(way, state, dist, {p for p, (n, _) in entered.items() if n == name}):
        way.direct = None
        return None
    return state


# ---- private ------------------------------------------------------------------------------------


def _suffices(way: ByLabel) -> bool:
    """Whether parameters at every label are those of the elements with that label."""
    target, term = way.blanket.target, way.child.term
    state = target.example(target.hidden_above(term))
    states = way.groups.states
    label = np.random.default_rng(0).permutation(np.arange(math.prod(term.shape)) % states)
    label = label.reshape(term.shape)
    domain = target.model[way.groups.label].domain
    assert domain is not None
    state[way.groups.label] = label.astype(domain.dtype)
    candidate = np.asarray(state[way.blanket.name])
    try:
        placed = way.blanket.placed(state, candidate)
        full, _, _ = way.blanket.distribution(way.child, placed)
        short, _ = way.at_labels(state, candidate)
    except Exception:  # a function that does not broadcast like this tells so in its own way
        return False
    plates = label.ndim
    return type(full) is type(short) and all(
        _agrees(padded(a, plates + n), padded(b, plates + n), label, n)
        for (a, n), (b, _) in zip(full.parameters(), short.parameters(), strict=True)
    )


def _agrees(full: np.ndarray, short: np.ndarray, label: np.ndarray, event_ndim: int) -> bool:
    """Whether a parameter of every element is that of its label, ``short`` holding one row per label."""
    end = short.ndim - event_ndim
    lead, plates = short.shape[: end - label.ndim], short.shape[end - label.ndim : end]
    if any(n != 1 for n in plates[:-1]):
        return False
    if plates[-1] != 1:
        table = short.reshape((*lead, plates[-1], *short.shape[end:]))
        short = np.take(table, label, axis=len(lead))
    return bool(((full == short) | (np.isnan(full) & np.isnan(short))).all())


def _is_in_order(way: ByLabel, keys: tuple[Any, ...]) -> bool:
    """Whether label k looks up element k of the node (or the node has one element)."""
    shape = way.blanket.node.plate_shape
    if not shape:
        return True
    if shape != (way.groups.states,) or len(keys) != 1:
        return False
    return np.array_equal(np.ravel(np.asarray(keys[0])), np.arange(way.groups.states))


def _entered(way: ByLabel, node: str) -> dict[str, Tracer] | None:
    """The parameters that a node enters; None where that is not known."""
    try:
        result = traced_term(way.blanket.target, (node,), way.child.term).result
    except Untraceable:
        return None
    if isinstance(result, Distribution):
        return {}
    traced = result.traced if isinstance(result, TracedCall) else {}
    fine = len(traced) == 1 and all(isinstance(t, Tracer) for t in traced.values())
    return traced if fine else None


def _source(way: ByLabel, factor: np.ndarray, node: str, value: Tracer | None) -> _Source | None:
    """How a parameter is read off a node; of the node itself, what it is at the neutral value."""
    if factor.shape[0] != 1:
        return None
    if value is None or node == way.blanket.name:
        return _Source(factor)
    compiled = way.blanket.target.model[node]
    if compiled.plate_shape not in ((), (way.groups.states,)) or len(value.sources) != 1:
        return None
    labels = compiled.plate_shape or (1,)
    shape = (*way.shape[:-1], *labels, *compiled.event_shape)
    trailing = len(compiled.value_shape)
    if value.is_copy and value.whole_event and factor.ndim == 1 + len(shape):
        return _Source(factor, node, is_copy=True, trailing=trailing, shape=shape)
    if value.power is None or compiled.event_shape or factor.ndim != 1 + len(shape):
        return None
    return _Source(factor, node, value.power, trailing=trailing, shape=shape)


def _is_right(way: ByLabel, state: Values, dist: Distribution, own: set[str]) -> bool:
    """Whether the parameters read off the nodes are the function's."""
    for parameter, value in way.parameters(state).items():
        expected = padded(getattr(dist, parameter), value.ndim)
        if parameter not in own and not np.allclose(value, expected, rtol=1e-12, atol=0.0):
            return False
    return True
