"""The compiled net: nodes in topological order, with everything engines need to evaluate them.

``Model`` is frozen. It is made from declarations and plate sizes by calling every function once on
values drawn from its ancestors, which tells event shapes, supports and finite domains; the same draws
serve ``validate``. Values it takes and gives are *stored values*: positions for finite discrete nodes,
the values themselves for all others, shape ``(*batch, *plates, *event)``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.distributions.support import Support
from bayesmc.errors import (
    BayesmcError,
    DensityError,
    ModelError,
    ParameterError,
    ShapeError,
    UnsupportedError,
)
from bayesmc.network.calling import Aligner, RowAligner, call
from bayesmc.network.clashing import data_around, sizes_beyond
from bayesmc.network.labels import Domain
from bayesmc.network.node import Declaration, Node, Potential
from bayesmc.shapes import Shape, broadcast_shapes, broadcasts_to, first_index, read_only

#: in a model's cache: the same model without functions
_BARE = "without functions"


@dataclass(frozen=True, eq=False)
class CompiledNode:
    """One node as engines see it. ``table`` holds a finite deterministic node's positions by parent;
    ``unsampled`` says that its density has no sampler, ``noiseless`` that some element has no noise
    whatever its parents are, and so no density, ``splits`` that some components may be seen alone;
    ``support`` is the same for all parents, ``reach`` holds those of all parents; ``is_object`` says that
    values are frozen objects."""

    declaration: Declaration
    links: tuple[tuple[str, Aligner], ...]
    plate_shape: Shape
    event_shape: Shape = ()
    is_discrete: bool = False
    is_stochastic: bool = True
    domain: Domain | None = None
    support: Support | None = None
    table: np.ndarray | None = None
    unsampled: bool = False
    noiseless: bool = False
    splits: bool = False
    reach: Support | None = None
    is_object: bool = False

    @property
    def name(self) -> str:
        return self.declaration.name

    @property
    def parents(self) -> tuple[str, ...]:
        return self.declaration.parents

    @property
    def plates(self) -> tuple[str, ...]:
        return self.declaration.plates

    @cached_property
    def angles(self) -> np.ndarray | None:
        """Which components of a value are angles, shape ``event_shape``; None where none is."""
        if self.support is None:
            return None
        found = self.support.angles(math.prod(self.event_shape)).reshape(self.event_shape)
        return found if found.any() else None

    @property
    def value_shape(self) -> Shape:
        """Shape of one value, plates included."""
        return self.plate_shape + self.event_shape

    @property
    def kind(self) -> str:
        source = self.declaration.source
        if source in ("input", "fixed"):
            return source
        return "stochastic" if self.is_stochastic else "deterministic"

    @property
    def has_foreign_parents(self) -> bool:
        return any(link.foreign for _, link in self.links)

    def called(self, values: Mapping[str, np.ndarray]) -> tuple[Any, Shape]:
        """What its function returns for stored values of its parents, and the batch shape of those."""
        arguments, batch = arguments_of(self.links, values)
        return call(self.declaration, arguments, batch + self.plate_shape, self.links), batch

    def record(self) -> Node:
        """The public, frozen view."""
        states = self.domain.states if self.domain is not None and self.is_discrete else None
        shown = self.name, self.parents, self.plates, self.event_shape
        return Node(*shown, states, self.is_discrete, self.kind)

    def decode(self, stored: np.ndarray) -> np.ndarray:
        """Stored values as user values."""
        return self.domain.decode(stored) if self.domain is not None else stored

    def stored_dtype(self, values: np.ndarray) -> np.dtype:
        """The type that draws are kept in: the smallest for positions of a finite node."""
        return values.dtype if self.domain is None else self.domain.dtype


@dataclass(frozen=True, eq=False)
class Model:
    """A net compiled for given plate sizes.

    Attributes
    ----------
    nodes : dict
        Name -> ``CompiledNode``, parents before children.
    potentials : dict
        Name -> (potential, links).
    sizes : dict
        Plate -> size.
    labels : dict
        Plate -> labels, where given.
    probe : dict
        Name -> one batch of jointly reachable stored values, with batch shapes that differ but broadcast.
    """

    name: str | None
    nodes: dict[str, CompiledNode]
    potentials: dict[str, tuple[Potential, tuple[tuple[str, Aligner], ...]]]
    sizes: dict[str, int]
    labels: dict[str, tuple[Any, ...]] = field(default_factory=dict)
    probe: dict[str, np.ndarray] = field(default_factory=dict, repr=False)
    probe_shape: Shape = ()
    #: what others derived from this model and may use again; it lives as long as the model
    cache: dict[str, Any] = field(default_factory=dict, repr=False)

    def __getitem__(self, name: str) -> CompiledNode:
        return self.nodes[name]

    def parents(self, name: str) -> tuple[str, ...]:
        """The nodes that a node's function, or a potential's, receives."""
        return self.nodes[name].parents if name in self.nodes else self.potentials[name][0].parents

    def above(self, names: Iterable[str], passes: Callable[[str], bool]) -> list[str]:
        """Some nodes, the parents of those that pass, the parents of these that do, and so on."""
        found = list(dict.fromkeys(names))
        met = set(found)
        for name in found:  # which grows
            new = [p for p in self.parents(name) if p not in met] if passes(name) else ()
            met.update(new)
            found += dict.fromkeys(new)
        return found

    def without_functions(self) -> Model:
        """The same model for results that are stored: it describes nodes but evaluates none."""
        found: Model | None = self.cache.get(_BARE)
        if found is not None:  # many answers on one model are stored with one
            return found
        nodes = {
            name: replace(node, declaration=replace(node.declaration, function=None, captured=()))
            for name, node in self.nodes.items()
        }
        found = self.cache[_BARE] = replace(self, nodes=nodes, potentials={}, probe={}, cache={})
        return found

    def evaluate(self, name: str, values: Mapping[str, np.ndarray]) -> tuple[Any, Shape]:
        """What node ``name`` is given its parents' stored values, and the batch shape of those.

        Returns a ``Distribution`` whose batch broadcasts to ``batch + plates``, or for a deterministic
        node its stored values, shape ``(*batch, *plates, *event)``.
        """
        node = self.nodes[name]
        if node.declaration.value is not None:
            return node.declaration.value, ()
        if node.table is not None:
            return lookup(node, values), arguments_of(node.links, values)[1]
        result, batch = node.called(values)
        if isinstance(result, Distribution):
            fit(node.declaration, result, batch, node.plate_shape)
            return result, batch
        return deterministic_fit(node, result, batch), batch

    def log_density(self, name: str, distribution: Distribution, stored: np.ndarray) -> np.ndarray:
        """Log density of stored values, shape the broadcast of batch and plates; NaN never passes."""
        node = self.nodes[name]
        value = node.domain.to_support(stored) if node.domain is not None else stored
        with np.errstate(all="ignore"):
            result = distribution.log_prob_unchecked(np.asarray(value))
        if not result.size or result.max() < np.inf:  # false for NaN, too
            return result
        bad = ~(result < np.inf)
        if distribution.invalid is not None:
            bad = bad & ~distribution.invalid
            result = np.where(distribution.invalid, -np.inf, result)
        if bad.any():
            index = first_index(bad)
            found = np.broadcast_to(result, bad.shape)[index]
            raise DensityError(
                f"node {name!r}: the log density of {distribution!r} is {found}; a log density must "
                "be below infinity and not NaN (check the function at the edges of its support)",
                index,
            )
        return result

    def potential(
        self, name: str, values: Mapping[str, np.ndarray], total: bool = True
    ) -> np.ndarray:
        """Log factor ``name``, shape the batch: summed over its plates or rows, unless ``total`` is false.

        Without ``total`` the shape is ``(*batch, *plates)``, or ``(*batch, rows)`` for one with an index.
        """
        potential, links = self.potentials[name]
        arguments, batch = arguments_of(links, values)
        result = self._log_factors(potential, links, arguments, batch)
        if not (total and result.ndim > len(batch)):
            return result
        return result.sum(axis=tuple(range(len(batch), result.ndim)))

    def potential_at(self, name: str, rows: Sequence[np.ndarray]) -> np.ndarray:
        """Log factors of a potential with an index, given what stands in each entry of its scope.

        Parameters
        ----------
        rows : sequence of ndarray
            For each entry of the scope stored values, shape ``(*batch, rows or 1, *event)``; so one entry
            can run through candidates while another of the same variable stays.

        Returns
        -------
        ndarray, shape ``(*batch, rows)``
        """
        potential, links = self.potentials[name]
        batch: Shape = ()
        arguments = []
        for (_, link), stored in zip(links, rows, strict=True):
            assert isinstance(link, RowAligner)
            batch = broadcast_shapes(batch, stored.shape[: stored.ndim - 1 - link.event_ndim])
            arguments.append(link.argument(stored))
        return self._log_factors(potential, links, arguments, batch)

    def _log_factors(
        self,
        potential: Potential,
        links: tuple[tuple[str, Aligner], ...],
        arguments: Sequence[Any],
        batch: Shape,
    ) -> np.ndarray:
        """What a potential's function returns, checked, shape ``(*batch, *plates or rows)``."""
        name = potential.name
        plates = potential_shape(self.sizes, potential)
        what = Declaration(
            f"potential {name}", "function", plates=potential.plates, function=potential.function
        )
        raw = np.asarray(call(what, arguments, batch + plates, links, wants_array=True))
        if raw.dtype.kind == "b":
            raise ModelError(
                f"potential {name!r} returns booleans; a log factor is a number, so for a constraint "
                "return np.where(condition, 0.0, -np.inf)"
            )
        result = raw.astype(float)
        if not broadcasts_to(result.shape, batch + plates):
            raise ShapeError(
                f"potential {name!r} returns shape {result.shape}, which does not fit "
                f"{batch + plates}; "
                + (
                    "reduce foreign plates with .sum(plate) or name plates="
                    if potential.index is None
                    else "it receives one array per entry of the scope, with the rows of index= on the "
                    "last axis before the event's, and returns one log factor per row"
                )
            )
        if not (result < np.inf).all():
            raise DensityError(
                f"potential {name!r} is NaN or plus infinity; a log factor must be finite (or -inf)"
            )
        return np.broadcast_to(result, batch + plates)

    def sample_stored(
        self, name: str, distribution: Distribution, rng: np.random.Generator, batch: Shape
    ) -> np.ndarray:
        """Stored draws of node ``name``, shape ``(*batch, *plates, *event)``, frozen."""
        node = self.nodes[name]
        try:
            draws = distribution.sample_to(rng, batch + node.plate_shape)
        except BayesmcError as error:
            raise type(error)(f"node {name!r}: {error}") from error
        if node.domain is not None:
            draws = node.domain.from_support(draws)
        draws.flags.writeable = False
        return draws


def refuse_objects(model: Model) -> None:
    """Refuse nodes of objects in a plain net, which no static engine takes.

    Raises
    ------
    UnsupportedError
    """
    for name, node in model.nodes.items():
        if node.is_object:
            raise UnsupportedError(
                f"node {name!r} holds objects ({type(model.probe[name].flat[0]).__name__}), which no "
                "engine on a plain "
                "net takes; declare a DynamicBayesNet and filter it with ParticleFilter(particles)"
            )


def deterministic_above(model: Model, name: str, known: Container[str]) -> list[str]:
    """Deterministic nodes above one that are not known, those first on which others depend."""
    found: dict[str, None] = {}
    todo = [(name, False)]
    while todo:
        above, is_done = todo.pop()
        if is_done:
            found[above] = None
            continue
        if above != name:
            todo.append((above, True))
        todo += [
            (p, False)
            for p in model.parents(above)
            if model[p].kind == "deterministic" and p not in known and p not in found
        ]
    return list(found)


def potential_shape(sizes: Mapping[str, int], potential: Potential) -> Shape:
    """Shape of a potential's factors: the rows of its index, or its plates."""
    if potential.rows is not None:
        return (potential.rows,)
    return tuple(sizes[p] for p in potential.plates)


def arguments_of(
    links: Sequence[tuple[str, Aligner]], values: Mapping[str, np.ndarray]
) -> tuple[list[Any], Shape]:
    """Arguments for a function and the broadcast of its parents' batch shapes."""
    arguments = []
    batch: Shape = ()
    for parent, link in links:
        value = values[parent]
        batch = broadcast_shapes(batch, link.batch_shape(value))
        arguments.append(link(value))
    return arguments, batch


def fit(declaration: Declaration, dist: Distribution, batch: Shape, plates: Shape) -> None:
    """Refuse a distribution whose batch goes beyond the batch of the parents and the plates."""
    if not broadcasts_to(dist.batch_shape, batch + plates):
        names = declaration.plates
        where = f"plates {names} of sizes {plates}" if names else "no plates"
        around = data_around(declaration, plates, sizes_beyond(dist.batch_shape, batch + plates))
        fix = around or (
            "declare the axes that are elements with plates=, the components of a vector on the last "
            "axis with a vector distribution"
        )
        raise ShapeError(
            f"node {declaration.name!r}: {type(dist).__name__} has batch shape {dist.batch_shape}, "
            f"which does not fit {batch + plates} (batch {batch} of the parents, {where}); {fix}"
        )


def lookup(node: CompiledNode, values: Mapping[str, np.ndarray]) -> np.ndarray:
    """Stored values of a tabulated deterministic node."""
    assert node.table is not None
    index = tuple(link.place(values[parent]).astype(np.intp) for parent, link in node.links)
    plates = node.plate_shape
    if node.table.ndim > len(index):
        index = (*index, *np.ix_(*(np.arange(n) for n in plates)))
    result = node.table[index] if index else node.table
    return read_only(np.asarray(result))


def invalid_error(
    node: CompiledNode,
    dist: Distribution,
    counts: np.ndarray,
    batch: Shape,
    noiseless: bool | np.ndarray = False,
) -> ParameterError | None:
    """The error for bad parameters at configurations that count, or None.

    ``counts`` (shape ``batch``) tells which batch elements have positive probability. Elements of the
    plates that are ``noiseless`` may have no noise: they are drawn, or nobody asks for their density.
    """
    if dist.invalid is None:
        return None
    invalid = dist.invalid
    if dist.noiseless is not None:
        invalid = invalid & ~(dist.noiseless & noiseless)
    full = np.broadcast_to(invalid, batch + node.plate_shape)
    lead = np.asarray(counts).reshape(np.shape(counts) + (1,) * len(node.plate_shape))
    bad = full & lead
    if not bad.any():
        return None
    index = tuple(int(i) for i in np.argwhere(bad)[0])
    element = index[len(batch) :]
    at = f" (plate element {element if len(element) > 1 else element[0]})" if element else ""
    return ParameterError(f"node {node.name!r}{at}: {dist.problem}", index)


def deterministic_fit(node: CompiledNode, result: Any, batch: Shape) -> np.ndarray:
    """A deterministic node's value broadcast to its full shape; one that does not fit is refused."""
    array, shape = np.asarray(result), batch + node.value_shape
    if isinstance(result, Distribution) or not broadcasts_to(array.shape, shape):
        raise ShapeError(
            f"node {node.name!r}: the function returns shape {array.shape}, which does not fit "
            f"{shape} (batch {batch} of the parents, plates {node.plates} of sizes {node.plate_shape}); "
            "declare the axes that are elements with plates="
        )
    return read_only(np.broadcast_to(array, shape))
