"""What a net is made of: what a user gives for a node, read, and the models compiled of it.

A distribution, a function or a table becomes a declaration. Models are kept for the plate sizes and inputs
that they were made for.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from bayesmc.distributions import Distribution, as_distribution
from bayesmc.errors import (
    DensityError,
    ModelError,
    ParameterError,
    PlateError,
    UnknownNodeError,
    did_you_mean,
)
from bayesmc.network.captured import captured, check_captured
from bayesmc.network.compile import compile_model
from bayesmc.network.evidence import plate_sizes
from bayesmc.network.model import Model
from bayesmc.network.node import (
    Declaration,
    Potential,
    bind,
    checked_rows,
    plain_states,
    topological_order,
)
from bayesmc.network.validate import validate_model
from bayesmc.shapes import owned, unused_sizes

Parents = Sequence[str] | Mapping[str, str] | None


class Constant:
    """A function of no parents that returns one distribution."""

    def __init__(self, distribution: Distribution) -> None:
        self.distribution = distribution

    def __call__(self) -> Distribution:
        return self.distribution


def declared(
    name: str,
    cpd: Any,
    parents: Parents,
    plates: tuple[str, ...],
    states: Sequence[Any] | None,
    vectorize: bool,
) -> Declaration:
    """A node by whatever says its density.

    Raises
    ------
    ModelError, ParameterError
    """
    if cpd is None or isinstance(cpd, str):
        raise ModelError(
            f"node {name!r}: {cpd!r} is no density; give a distribution, a function or a table"
        )
    dist = cpd if isinstance(cpd, Distribution) else as_distribution(cpd)
    if dist is not None:
        if parents:
            raise ModelError(
                f"node {name!r}: a distribution has no arguments for parents={parents!r}; pass a "
                "function of them that returns it"
            )
        own = copy.deepcopy(dist)  # the user's arrays stay the user's
        return declared_function(name, Constant(own), (), plates, states, False)
    if callable(cpd):
        return declared_function(name, cpd, parents, plates, states, vectorize)
    if isinstance(parents, Mapping):
        raise ModelError(f"node {name!r}: a table lists its parents in the order of its axes")
    return declared_table(name, parents or (), cpd, states, plates)


def declared_function(
    name: str,
    function: Callable[..., Any],
    parents: Parents,
    plates: tuple[str, ...],
    states: Sequence[Any] | None,
    vectorize: bool,
) -> Declaration:
    """A node by a function of its parents."""
    names, bound = bind(name, function, parents)
    if isinstance(function, type) and issubclass(function, Distribution) and not names:
        raise ModelError(
            f"node {name!r}: {function.__name__} is a class; call it, {function.__name__}(...), or "
            "list parents= for its arguments"
        )
    labels = None if states is None else plain_states(states)
    around = captured(function)
    return Declaration(name, "function", names, plates, labels, bound, vectorize, captured=around)


def declared_potential(
    name: str, function: Callable[..., Any], parents: Parents, plates: tuple[str, ...]
) -> Potential:
    """A log factor by a function of nodes."""
    if not isinstance(name, str):
        raise ModelError(f"net.potential({name!r}, ...): the name comes first, then the function")
    names, bound = bind(name, function, parents)
    return Potential(name, names, bound, plates, captured=captured(function))


def declared_table(
    name: str,
    parents: Sequence[str],
    probs: Any,
    states: Sequence[Any] | None,
    plates: tuple[str, ...],
) -> Declaration:
    """A node by its conditional probability table."""
    if probs is None:
        raise ModelError(f"node {name!r}: table() needs probs=")
    if isinstance(parents, str):
        raise ModelError(f"node {name!r}: parents={parents!r} is one string; give a list of names")
    try:
        table = np.array(probs, dtype=float)
    except (TypeError, ValueError):
        raise ModelError(
            f"node {name!r}: a {type(probs).__name__} is no density; give a distribution, a function, or a "
            "table of probabilities, its rows of one length"
        ) from None
    if table.ndim != len(parents) + 1:
        raise ModelError(
            f"node {name!r}: probs has {table.ndim} axes, but {len(parents)} parents and the node "
            f"itself make {len(parents) + 1}"
        )
    states = None if states is None else plain_states(states)
    if states is not None and len(states) != table.shape[-1]:
        raise ModelError(
            f"node {name!r}: states= has {len(states)} entries, but the last axis of probs has "
            f"{table.shape[-1]}"
        )
    table = checked_rows(name, table)
    return Declaration(name, "table", tuple(parents), plates, states, probs=table)


def settled_sizes(
    declared: DeclaredPlates,
    declarations: Mapping[str, Declaration],
    evidence: Mapping[str, Any] | None,
    inputs: Mapping[str, Any] | None,
    given: Mapping[str, int] | None,
) -> dict[str, int]:
    """The size of every plate, declared, ``given`` or read off the data; 0 where no node is in it.

    Raises
    ------
    PlateError
    """
    for plate, size in (given or {}).items():
        if plate not in declared.sizes:
            raise PlateError(
                f"plates= gives {plate!r}{did_you_mean(plate, declared.sizes)}; the net's plates are "
                f"{list(declared.sizes)}"
            )
        if isinstance(size, bool) or not isinstance(size, (int, np.integer)) or size < 0:
            raise PlateError(f"plates={{{plate!r}: {size!r}}}: the size is a whole number")
    sizes = plate_sizes(
        {**declared.sizes, **(given or {})}, declarations, evidence, inputs, labels=declared.labels
    )
    used = {p for d in declarations.values() for p in d.plates}
    open_plates = [p for p, n in sizes.items() if n is None and p in used]
    if open_plates:
        raise PlateError(
            f"the size of plate {open_plates[0]!r} is not known; observe a node in it, or declare "
            f"plates={{{open_plates[0]!r}: size}}"
        )
    return {p: n if n is not None else 0 for p, n in sizes.items()}


@dataclass(frozen=True)
class DeclaredPlates:
    """Plates by name.

    Attributes
    ----------
    owner : str
        The class that declares them, for messages.
    sizes : dict
        Plate -> size; None where data will tell.
    labels : dict
        Plate -> labels, for those that have some.
    """

    owner: str
    sizes: dict[str, int | None]
    labels: dict[str, tuple[Any, ...]]

    @classmethod
    def read(cls, owner: str, name: Any, plates: Any, open_sizes: bool = True) -> DeclaredPlates:
        """The plates that a constructor was given, after a look at the name that precedes them.

        Raises
        ------
        ModelError
            The name is no string (plates given first, say).
        PlateError
            No dict, a size that is none, or one left to data where there will be none.
        """
        if name is not None and not isinstance(name, str):
            raise ModelError(
                f"{owner}({name!r}): the name is a string; plates are given as plates="
            )
        if plates is not None and not isinstance(plates, Mapping):
            kinds = "size, labels or None" if open_sizes else "size or labels"
            raise PlateError(f"{owner}(plates={plates!r}): give a dict from plate name to {kinds}")
        sizes, labels = {}, {}
        for plate, size in (plates or {}).items():
            sizes[plate] = _size(plate, size)
            if sizes[plate] is None and not open_sizes:
                raise PlateError(
                    f"{owner}(plates={{{plate!r}: None}}): no data will tell its size; give it"
                )
            if size is not None and not isinstance(size, (int, np.integer)):
                labels[plate] = tuple(size)
        return cls(owner, sizes, labels)

    def of(self, what: str, plates: str | Sequence[str] | None) -> tuple[str, ...]:
        """The plates that a declaration names, as a tuple.

        Raises
        ------
        PlateError
            One is not declared, or named twice.
        """
        names = (plates,) if isinstance(plates, str) else tuple(plates or ())
        for plate in names:
            if plate not in self.sizes:
                raise PlateError(
                    f"{what} is in plate {plate!r}, which is not declared"
                    f"{did_you_mean(plate, self.sizes)} (plates: {list(self.sizes) or 'none'}); "
                    f"declare {self.owner}(plates={{{plate!r}: size}})"
                )
        if len(set(names)) != len(names):
            raise PlateError(f"{what}: plates={names} names a plate twice")
        return names

    def fitting(self, sizes: Mapping[str, int]) -> dict[str, tuple[Any, ...]]:
        """Labels of plates that have the size they were declared with."""
        return {p: names for p, names in self.labels.items() if len(names) == sizes[p]}

    def only(self, names: Collection[str]) -> DeclaredPlates:
        """Those of some names."""
        sizes = {plate: size for plate, size in self.sizes.items() if plate in names}
        labels = {plate: own for plate, own in self.labels.items() if plate in names}
        return DeclaredPlates(self.owner, sizes, labels)

    def copy(self) -> DeclaredPlates:
        return DeclaredPlates(self.owner, dict(self.sizes), dict(self.labels))


#: bytes of inputs up to which a compiled model is kept for the next call with the same inputs
_KEEP_INPUTS = 1 << 20
#: compiled models kept for other plate sizes and inputs
_KEEP_MODELS = 8


class Declared:
    """What a net and a factor graph are made of: plates, declarations, and the models compiled of them."""

    def __init__(self, name: str | None, plates: DeclaredPlates) -> None:
        self.name = name
        self._plates = plates
        self._declarations: dict[str, Declaration] = {}
        self._potentials: dict[str, Potential] = {}
        self._kept_store: ModelStore | None = None

    def copy(self) -> Self:
        """An independent one with the same declarations."""
        other = type(self)(self.name)  # type: ignore[call-arg]
        other._declarations = dict(self._declarations)
        other._potentials = dict(self._potentials)
        other._plates = self._plates.copy()
        return other

    def snapshot(self) -> Self:
        """A copy that shares what is compiled already; what holds it never sees later declarations."""
        other = self.copy()
        other._kept_store = self._store
        return other

    def __contains__(self, name: object) -> bool:
        return name in self._declarations or name in self._potentials

    def _refuse_name(self, what: str, name: Any) -> None:
        if not isinstance(name, str) or not name:
            raise ModelError(f"a {what}'s name is a non-empty string, not {name!r}")

    def _changed(self) -> None:
        self._kept_store = None

    @property
    def _store(self) -> ModelStore:
        if self._kept_store is None:
            self._kept_store = ModelStore(
                self.name, self._declarations, self._potentials, self._plates
            )
        return self._kept_store


class ModelStore:
    """Compiles a net's declarations as they stand now, and remembers the last few models.

    A net that changes takes a new store; snapshots share the one they were taken with.
    """

    def __init__(
        self,
        name: str | None,
        declarations: Mapping[str, Declaration],
        potentials: Mapping[str, Potential],
        plates: DeclaredPlates,
    ) -> None:
        self.name = name
        self.declarations = dict(declarations)
        self.potentials = dict(potentials)
        self.plates = plates.copy()
        self._models: dict[Any, Model] = {}
        self._valid = False
        self._around = [d for d in declarations.values() if d.captured]

    def model(self, sizes: Mapping[str, int], inputs: Mapping[str, np.ndarray]) -> Model:
        """The net compiled for these plate sizes and inputs."""
        self.check_captured()
        small = sum(v.nbytes for v in inputs.values()) <= _KEEP_INPUTS
        key = (tuple(sizes.items()), tuple((n, v.tobytes()) for n, v in inputs.items() if small))
        model = self._models.get(key) if small else None
        if model is None:
            model = self._compile(sizes, inputs)
            if small:
                while len(self._models) >= _KEEP_MODELS:
                    self._models.pop(next(iter(self._models)), None)
                self._models[key] = model
        return model

    def check_captured(self) -> None:
        """Refuse functions that read a name which has changed since they were declared."""
        if self._around:
            check_captured(self._around)
        if self.potentials:
            check_captured(self.potentials.values(), "factor")

    def probe(self, sizes: Mapping[str, int | None]) -> Model:
        """A model when nobody has given data: open plates and inputs get stand-ins."""
        open_ = [p for p, n in sizes.items() if n is None]
        stand_in = unused_sizes([n for n in sizes.values() if n is not None], len(open_) + 2)[2:]
        settled = {p: n for p, n in sizes.items() if n is not None}
        settled.update(zip(open_, stand_in, strict=True))
        try:
            return self.model(settled, {})
        except (ModelError, ParameterError, DensityError):  # inputs may have to be integers
            zeros = {
                n: owned(np.zeros(tuple(settled[p] for p in d.plates) + d.event_shape, dtype=int))
                for n, d in self.declarations.items()
                if d.source == "input"
            }
            if not zeros:
                raise
            return self.model(settled, zeros)

    def validate(self, model: Model) -> None:
        """Once for a net, and again while a plate has been too small to show mixing."""
        if self._valid:
            return
        if not model.cache.get("valid"):
            validate_model(model)
            model.cache["valid"] = True
        used = {p for d in self.declarations.values() for p in d.plates}
        self._valid = all(model.sizes[p] > 1 for p in used)

    def _compile(self, sizes: Mapping[str, int], inputs: Mapping[str, np.ndarray]) -> Model:
        for name, declaration in self.declarations.items():
            check_parents(self.declarations, name, declaration.parents)
        for name, potential in self.potentials.items():
            check_parents(self.declarations, name, potential.parents, "potential")
        order = topological_order({n: d.parents for n, d in self.declarations.items()})
        labels = self.plates.fitting(sizes)
        return compile_model(
            self.name, self.declarations, self.potentials, sizes, labels, inputs, order
        )


def check_parents(
    declarations: Mapping[str, Declaration],
    name: str,
    parents: Sequence[str],
    what: str = "node",
) -> None:
    """Refuse a parent that was never declared."""
    others = [n for n in declarations if n != name]
    for parent in parents:
        if parent not in declarations:
            raise UnknownNodeError(
                f"{what} {name!r} has the parent {parent!r}: {unknown(others, parent)}. Declare it, "
                "give the argument a default if it is no parent, or name the parents with parents="
            )


def unknown(declarations: Iterable[str], name: str) -> str:
    """That there is no such node, and which one may be meant."""
    others = list(declarations)
    known = (
        f" (its nodes are {', '.join(others[:12])}{', ...' * (len(others) > 12)})" if others else ""
    )
    return f"the net has no node {name!r}{did_you_mean(name, declarations) or known}"


# ---- private ------------------------------------------------------------------------------------


def _size(plate: str, size: Any) -> int | None:
    """Size of a plate from an int, a list of labels or None; what is neither raises."""
    if not isinstance(plate, str):
        raise PlateError(f"a plate's name is a string, not {plate!r}")
    if size is None:
        return None
    if isinstance(size, str):
        raise PlateError(
            f"plate {plate!r}: {size!r} is one string; give a size or a list of labels"
        )
    if not isinstance(size, (int, np.integer, Sequence, np.ndarray)) or isinstance(size, bool):
        raise PlateError(
            f"plate {plate!r}: {size!r} is no size; give an int, a list of labels or None"
        )
    count = int(size) if isinstance(size, (int, np.integer)) else len(size)
    if not isinstance(size, (int, np.integer)) and len(set(size)) != count:
        raise PlateError(f"plate {plate!r}: a label stands twice in {list(size)}")
    if count < 0:
        raise PlateError(f"plate {plate!r}: size {count} is negative")
    return count
