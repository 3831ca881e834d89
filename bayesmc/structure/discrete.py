"""A net whose hidden nodes are finite, as discrete variables and factors."""

from __future__ import annotations

import math
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BudgetError, UnsupportedError
from bayesmc.factors import FactorLike, LogTable
from bayesmc.network import Model, Observed
from bayesmc.network.model import potential_shape
from bayesmc.network.node import Potential
from bayesmc.network.noiseless import point_log_density
from bayesmc.shapes import Shape
from bayesmc.structure.tables import (
    TABLE_ENTRIES,
    configure,
    constants_of,
    indexed_table,
    reads_of,
)

#: one element of a finite node
Variable = tuple[str, int]
#: node, element, scope and the configurations of it at which the parameters are bad
InvalidRows = tuple[str, int, tuple[Variable, ...], np.ndarray]


@dataclass(frozen=True, eq=False)
class FactorSource:
    """How one node or potential becomes factors: over which variables, at which plate elements.

    Attributes
    ----------
    alone : tuple of str
        Finite nodes whose element follows the factor's own.
    whole : tuple of str
        Finite nodes all of whose elements matter (foreign plates), one axis each.
    from_evidence : bool
        Its tables depend on the values of observed continuous nodes.
    index : tuple, optional
        Of a potential over rows of an index: for each node of ``alone``, which may stand there more than
        once, the element that every row takes; and which entries of the index these are.
    """

    name: str
    plates: tuple[str, ...]
    alone: tuple[str, ...]
    whole: tuple[str, ...]
    from_evidence: bool
    is_potential: bool = False
    index: tuple[list[int], ...] | None = None
    entries: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class DiscreteNet:
    """A net as discrete variables and factors, the tables of its static part filled in.

    Attributes
    ----------
    constants : dict
        Stored values of inputs and fixed nodes.
    cards : dict
        Variable -> number of states.
    scopes : list of tuple
        Scope of every factor: first the static ones, then those that depend on the evidence.
    static : list of FactorLike
    evidence_sources : list of FactorSource
    invalid : list
        Configurations with bad parameters, to be refused if they turn out to be possible.
    """

    model: Model
    constants: dict[str, np.ndarray]
    cards: dict[Variable, int]
    scopes: list[tuple[Variable, ...]] = field(default_factory=list)
    static: list[FactorLike] = field(default_factory=list)
    evidence_sources: list[FactorSource] = field(default_factory=list)
    invalid: list[InvalidRows] = field(default_factory=list)

    def evidence_factors(
        self, observed: Mapping[str, Observed]
    ) -> tuple[list[FactorLike], list[InvalidRows]]:
        """Factors that depend on continuous evidence, in the order of their scopes.

        Where a function gives bad parameters the factor is neutral, and the configuration is listed.
        """
        factors: list[FactorLike] = []
        bad: list[InvalidRows] = []
        known = known_values(self.model, self.constants, observed)
        for source in self.evidence_sources:
            _fill(self.model, source, known, factors, bad)
        return factors, bad


def known_values(
    model: Model, constants: Mapping[str, np.ndarray], observed: Mapping[str, Observed]
) -> dict[str, np.ndarray]:
    """Constants and the values of wholly observed nodes without a finite domain."""
    seen = {n: o.value for n, o in observed.items() if model[n].domain is None and o.mask is None}
    return {**constants, **seen}


def why_not_discrete(model: Model, observed: Mapping[str, Observed]) -> str | None:
    """Why a net with this evidence is no discrete net, or None."""
    for name, node in model.nodes.items():
        if not node.is_stochastic or node.domain is not None:
            continue
        seen = observed.get(name)
        if seen is None or seen.mask is not None:
            partly = "is only partly observed and " if seen is not None else ""
            many = node.support is not None and node.support.size is not None
            what = (
                f"has too many values to enumerate ({node.support.describe()})"  # type: ignore[union-attr]
                if many
                else f"has infinitely many values ({node.support.describe()})"
                if node.is_discrete and node.support is not None
                else "has values that depend on its parents"
                if node.is_discrete
                else "is continuous"
            )
            return f"node {name!r} {partly}{what}"
    return None


def discrete_net(
    model: Model,
    observed: Mapping[str, Observed],
    inputs: Mapping[str, np.ndarray],
    without: Container[str] = (),
) -> DiscreteNet:
    """Variables, scopes and static tables of a net whose hidden nodes are finite, but for some left out.

    Parameters
    ----------
    without : container of str
        Nodes whose conditional densities somebody else turns into factors.

    Raises
    ------
    BudgetError
        A function has too many configurations to be tabulated.
    """
    cards = {
        (name, element): node.domain.size
        for name, node in model.nodes.items()
        if node.domain is not None and node.kind != "fixed"
        for element in range(math.prod(node.plate_shape))
    }
    net = DiscreteNet(model, constants_of(model, inputs), cards)
    for source in _sources(model, observed, without):
        _check_size(net, source)
        for element in np.ndindex(_plate_shape(model, source)):
            net.scopes.append(_full_scope(model, source, element))
        if source.from_evidence:
            net.evidence_sources.append(source)
        else:
            _fill(model, source, net.constants, net.static, net.invalid)
    return net


def discrete_scopes(
    model: Model, observed: Mapping[str, Observed]
) -> Iterator[tuple[Variable, ...]]:
    """The scope of every factor of a net whose hidden nodes are finite, without its table."""
    for source in _sources(model, observed):
        for element in np.ndindex(_plate_shape(model, source)):
            yield _full_scope(model, source, element)


def core_size(model: Model, observed: Mapping[str, Observed]) -> int:
    """Variables left when those with at most two neighbours have been eliminated, one after the other.

    Eliminating such a variable never makes the best order worse, so a chain or a tree has no core. The
    number of scopes is all that it takes: no order is searched for and no table made.
    """
    neighbours: dict[Variable, set[Variable]] = {}
    for scope in discrete_scopes(model, observed):
        for variable in scope:
            neighbours.setdefault(variable, set()).update(scope)
    for variable, others in neighbours.items():
        others.discard(variable)
    todo = [v for v, others in neighbours.items() if len(others) <= 2]
    while todo:
        variable = todo.pop()
        if variable not in neighbours or len(neighbours[variable]) > 2:
            continue
        others = neighbours.pop(variable)
        for other in others:
            neighbours[other] |= others - {other}
            neighbours[other].discard(variable)
            if len(neighbours[other]) <= 2:
                todo.append(other)
    return len(neighbours)


# ---- private ------------------------------------------------------------------------------------


def _sources(
    model: Model, observed: Mapping[str, Observed], without: Container[str] = ()
) -> list[FactorSource]:
    """What becomes factors: first what is static, then what depends on the evidence."""
    continuous = {n for n, o in observed.items() if model[n].domain is None and o.mask is None}
    sources = [
        _source(model, name, node.parents, node.plates, continuous)
        for name, node in model.nodes.items()
        if node.kind not in ("input", "fixed")
        and node.declaration.source != "variable"  # its density is flat
        and (node.domain is not None or node.is_stochastic)
        and name not in without
    ]
    sources += [
        _source(model, name, potential.parents, potential.plates, continuous, is_potential=True)
        if potential.index is None
        else _indexed_source(model, potential)
        for name, (potential, _) in model.potentials.items()
    ]
    return sorted(sources, key=lambda s: s.from_evidence)


def _source(
    model: Model,
    name: str,
    parents: Sequence[str],
    plates: tuple[str, ...],
    continuous: set[str],
    is_potential: bool = False,
) -> FactorSource:
    """The finite nodes a factor depends on, through deterministic nodes without a domain."""
    alone, whole, others = reads_of(
        model, parents, plates, lambda n: model[n].kind in ("input", "fixed")
    )
    # the others are observed, since hidden ones are refused before
    from_evidence = name in continuous or bool(others)
    return FactorSource(name, plates, alone, whole, from_evidence, is_potential)


def _indexed_source(model: Model, potential: Potential) -> FactorSource:
    """A potential over rows of an index, whose scope is all stochastic nodes."""
    assert potential.index is not None
    entries = tuple(i for i, n in enumerate(potential.scope) if model[n].domain is not None)
    alone = tuple(potential.scope[i] for i in entries)
    index = tuple(potential.index[i].tolist() for i in entries)
    from_evidence = len(entries) < len(potential.scope)
    return FactorSource(potential.name, (), alone, (), from_evidence, True, index, entries)


def _plate_shape(model: Model, source: FactorSource) -> Shape:
    if source.is_potential:
        return potential_shape(model.sizes, model.potentials[source.name][0])
    return tuple(model.sizes[p] for p in source.plates)


def _scope(model: Model, source: FactorSource, element: Shape) -> tuple[Variable, ...]:
    if source.index is not None:
        return tuple((n, at[element[0]]) for n, at in zip(source.alone, source.index, strict=True))
    scope: list[Variable] = []
    for name in source.alone:
        node = model[name]
        own = tuple(element[source.plates.index(p)] for p in node.plates)
        flat = int(np.ravel_multi_index(own, node.plate_shape)) if own else 0
        scope.append((name, flat))
    for name in source.whole:
        scope += [(name, e) for e in range(math.prod(model[name].plate_shape))]
    return tuple(scope)


def _full_scope(model: Model, source: FactorSource, element: Shape) -> tuple[Variable, ...]:
    """The scope of a factor at one element, its own variable last where it is a finite node."""
    scope = _scope(model, source, element)
    if source.is_potential or model[source.name].domain is None:
        return scope
    flat = int(np.ravel_multi_index(element, _plate_shape(model, source))) if element else 0
    return (*scope, (source.name, flat))


def _check_size(net: DiscreteNet, source: FactorSource) -> None:
    shape = _plate_shape(net.model, source)
    if 0 in shape:
        return
    scope = _full_scope(net.model, source, (0,) * len(shape))
    entries = float(math.prod(net.cards[v] for v in scope))
    entries *= math.prod(shape)
    if entries > TABLE_ENTRIES:
        what = "potential" if source.is_potential else "node"
        raise BudgetError(
            f"{what} {source.name!r} depends on {len(source.alone)} nodes and all elements of "
            f"{list(source.whole)}: {entries:.3g} configurations to tabulate, above {TABLE_ENTRIES:.3g}",
            int(min(8 * entries, 2**62)),
        )


def _fill(
    model: Model,
    source: FactorSource,
    known: Mapping[str, np.ndarray],
    factors: list[FactorLike],
    bad: list[InvalidRows],
) -> None:
    """Append the factors of a source, one per plate element, and its rows with bad parameters."""
    with marking_invalid(), np.errstate(all="ignore"):
        if source.index is not None:
            cards = tuple(model[n].domain.size for n in source.alone)  # type: ignore[union-attr]
            table = indexed_table(model, source.name, known, source.entries)
            is_log, invalid = True, None
        else:
            values, cards = configure(
                model, known, source.alone, source.whole, _parents_of(model, source)
            )
            table, is_log, invalid = _table(model, source, values, cards)
    for flat, element in enumerate(np.ndindex(_plate_shape(model, source))):
        at = (slice(None),) * len(cards) + element
        part = np.array(table[at])
        factors.append(LogTable(part) if is_log else part)
        if invalid is not None and invalid[at].any():
            bad.append((source.name, flat, _scope(model, source, element), invalid[at]))


def _table(
    model: Model, source: FactorSource, values: Mapping[str, np.ndarray], cards: Shape
) -> tuple[np.ndarray, bool, np.ndarray | None]:
    """Values of a factor ``(*cards, *plates[, states])``, whether they are logs, and bad rows."""
    shape = cards + _plate_shape(model, source)
    if source.is_potential:
        return np.broadcast_to(model.potential(source.name, values, total=False), shape), True, None
    node = model[source.name]
    result, _ = model.evaluate(source.name, values)
    if not isinstance(result, Distribution):
        assert node.domain is not None
        one_hot = np.asarray(result)[..., None] == np.arange(node.domain.size)
        return np.broadcast_to(one_hot, (*shape, node.domain.size)).astype(float), False, None
    invalid, points = result.invalid, None
    if result.noiseless is not None and node.domain is None:
        assert invalid is not None
        points = _point_densities(model, source.name, result, values, shape, len(cards))
        invalid = invalid & ~result.noiseless
    invalid = None if invalid is None or not invalid.any() else np.broadcast_to(invalid, shape)
    if node.domain is not None:
        table = result.probs_table
        assert table is not None
        return np.broadcast_to(table, (*shape, node.domain.size)), False, invalid
    density = points
    if density is None:
        density = model.log_density(source.name, result, values[source.name])
    density = np.broadcast_to(density, shape)
    return (density if invalid is None else np.where(invalid, 0.0, density)), True, invalid


def _point_densities(
    model: Model,
    name: str,
    result: Distribution,
    values: Mapping[str, np.ndarray],
    shape: Shape,
    axes: int,
) -> np.ndarray | None:
    """Log densities where some elements have no noise, which must be the same at all configurations."""
    assert result.noiseless is not None
    full = np.broadcast_to(result.noiseless, shape).reshape(-1, *shape[axes:])
    if (full != full[:1]).any():
        raise UnsupportedError(
            f"node {name!r} is observed with noise at some configurations of the finite nodes and without at "
            "others, and densities do not compare with probabilities; give it a little noise at all of them"
        )
    return point_log_density(model, name, result, values)


def _parents_of(model: Model, source: FactorSource) -> tuple[str, ...]:
    if source.is_potential:
        return model.potentials[source.name][0].parents
    return model[source.name].parents
