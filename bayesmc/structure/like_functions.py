"""Several like functions evaluated as one: the group becomes a batch axis, before the plates.

Terms and deterministic nodes are alike where what was read of their functions is equal up to constants
(slices of a template, nodes that a loop declared), and what they read has the same shapes. The first of them
then stands for all: its parents' names stand for arrays in which the parents of all are stacked. Where no
constant differs its function is called as it is; constants that differ are stacked, too, in the expressions
that were read.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from operator import is_, itemgetter
from typing import Any, Protocol

import numpy as np

from bayesmc.errors import BayesmcError, ModelError
from bayesmc.expression import (
    Expression,
    Program,
    expressions_of,
    leaf,
    mapped,
    ordered,
    rebuilt,
    replaced,
)
from bayesmc.network import CompiledNode, Model
from bayesmc.network.expressions import Followed, density
from bayesmc.network.node import identity
from bayesmc.network.readings import Reading, with_axes
from bayesmc.passes.templates import stacked_rows
from bayesmc.shapes import Shape, broadcast_shapes

#: stored values by node
Values = dict[str, np.ndarray]
#: links that are worth a group
FEWEST = 4
#: elements of one link from which on arrays, not calls, take the time
_LARGE = 512


class Facts(Protocol):
    """What is asked of a target: a model, values that never change, and what its functions are."""

    @property
    def model(self) -> Model: ...

    @property
    def known(self) -> Values: ...

    @property
    def signatures(self) -> Signatures: ...


@dataclass(frozen=True, eq=False)
class Signature:
    """What a term or a deterministic node is.

    Attributes
    ----------
    key : hashable
        Equal where functions are, up to constants, and values have the same shapes and states.
    scope : tuple of str
        What it reads: parents in the order of arguments, and itself.
    rank : int
        Axes of what its function computes, of a density those of the plates.
    read : Followed or None
        What its function computes; None where that cannot be followed.
    """

    key: Hashable
    scope: tuple[str, ...]
    rank: int
    read: Followed | None


class Signatures:
    """Signatures of a target's terms and deterministic nodes, each found once."""

    def __init__(self, target: Facts) -> None:
        self.target = target
        self._found: dict[str, Signature | None] = {}
        self._values: dict[str, Hashable] = {}

    def of(self, name: str) -> Signature | None:
        """The signature; None for what is called element by element or over the rows of an index."""
        if name not in self._found:
            self._found[name] = self._read(name)
        return self._found[name]

    def _read(self, name: str) -> Signature | None:
        model = self.target.model
        table: Hashable = None
        if name in model.nodes:
            node = model[name]
            declaration = node.declaration
            if declaration.vectorize:
                return None
            function, scope = declaration.function, (*node.parents, name)
            rank = len(node.plate_shape if node.is_stochastic else node.value_shape)
            if node.table is not None:  # of a deterministic node: its positions
                table = node.table.shape, node.table.tobytes()
        else:
            potential, _ = model.potentials[name]
            if potential.index is not None:
                return None
            function, scope = potential.function, potential.parents
            table, rank = potential.plates, len(potential.plates)
        found = density(model, name)
        what: Hashable
        if isinstance(found, Followed):
            open_numbers = found.reading.may_differ
            what = found.reading.key, () if open_numbers else tuple(map(int, found.numbers))
        else:
            what = identity(function)
        read = tuple(self._value(n) for n in scope)
        followed = found if isinstance(found, Followed) else None
        return Signature((what, table, read), scope, rank, followed)

    def _value(self, name: str) -> Hashable:
        if name not in self._values:
            self._values[name] = value_key(self.target.model[name])
        return self._values[name]


class Slots:
    """What names stand for: of each one name for all of a group, or one for each.

    Parameters
    ----------
    sources : dict
        Name -> tuple of one name, or of one for each.
    count : int
        Size of the group.
    """

    def __init__(self, target: Facts, sources: Mapping[str, Sequence[str]], count: int) -> None:
        self.sources = {name: _once(these) for name, these in sources.items()}
        self.count = count
        self._trailing = {name: len(target.model[name].value_shape) for name in self.sources}
        known = target.known
        self._taken = {name: _taking(these) for name, these in self.sources.items()}
        self._known = {
            name: self._taken[name](known)
            for name, these in self.sources.items()
            if all(n in known for n in these)
        }
        self._fixed = {
            name: stack_arrays(arrays, self._trailing[name]) for name, arrays in self._known.items()
        }

    def gathered(self, values: Mapping[str, np.ndarray]) -> Values:
        """Values by these names, ``(*lead, group, *plates, *event)``; the group is 1 for a shared one."""
        found: Values = {}
        for name, taken in self._taken.items():
            arrays = taken(values)
            known = self._known.get(name)
            if known is not None and all(map(is_, arrays, known)):
                found[name] = self._fixed[name]
            else:
                found[name] = stack_arrays(arrays, self._trailing[name])
        return found


@dataclass(frozen=True, eq=False)
class StackedFunction:
    """Functions that differ in constants as one.

    Attributes
    ----------
    result : Family or Expression
        Of leaves by the names of the first one's parents, and of the constants.
    constants : dict
        Leaf -> the constants of all, shape ``(group, *shape)``.
    shapes : dict
        Parent of the first -> shape of one value.
    count : int
        Size of the group.
    """

    result: Any
    constants: dict[str, np.ndarray]
    shapes: dict[str, Shape]
    count: int

    def __call__(self, values: Mapping[str, np.ndarray]) -> tuple[Any, Shape]:
        """What the functions compute of values ``(*lead, group, *plates, *event)``, and the batch shape."""
        return rebuilt(self.result, iter(self._evaluated(self._program, values))), self.batch(
            values
        )

    def batch(self, values: Mapping[str, np.ndarray]) -> Shape:
        """The batch shape of the parents, the group last."""
        leads = (values[n].shape[: values[n].ndim - len(s)] for n, s in self.shapes.items())
        return broadcast_shapes((self.count,), *leads)

    def found(self, program: Program, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """What a program of one expression finds of the same leaves, ``(*lead, group, *shape)``."""
        (found,) = self._evaluated(program, values)
        return found

    @cached_property
    def _program(self) -> Program:
        return Program(list(expressions_of(self.result)))

    def _evaluated(self, program: Program, values: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        try:
            full = {n: _full(values[n], shape) for n, shape in self.shapes.items()}
            return program({**self.constants, **full})
        except IndexError as error:
            raise ModelError(str(error)) from error


def as_one(signatures: Sequence[Signature]) -> StackedFunction | None:
    """Functions of equal signatures as one; None where they do not differ: the first is that of all."""
    read = [s.read for s in signatures if s.read is not None]
    if len(read) < len(signatures):
        return None
    first = read[0]
    reading, constants = _of_all([r.reading for r in read])
    for k, numbers in enumerate(zip(*(r.numbers for r in read), strict=True)):
        constants[f"number {k}"] = np.stack(numbers)
    if all(_is_one(c) for c in constants.values()):
        return None
    instead: dict[Expression, Expression] = {
        a.leaf: leaf(parent, a.shape, a.dtype, a.states)
        for parent, a in zip(first.parents, first.arguments, strict=True)
    }
    rank = signatures[0].rank
    result = with_axes(mapped(reading.open, lambda e: replaced(e, instead)), rank)
    shapes = {p: a.shape for p, a in zip(first.parents, first.arguments, strict=True)}
    return StackedFunction(*_computed_once(result, constants), shapes, len(signatures))


def stack_arrays(arrays: Sequence[np.ndarray], trailing: int) -> np.ndarray:
    """Arrays ``(*lead, *trailing)`` as one, the new axis in between: of size one for a single hidden one."""
    first = arrays[0]
    lead = first.ndim - trailing
    if len(arrays) == 1:
        return first if not lead else first.reshape(*first.shape[:lead], 1, *first.shape[lead:])
    rows = _rows(arrays)
    if rows is None:  # some of them are known, or have more candidates
        rows = _broadcast_rows(arrays)
        lead = rows.ndim - 1 - trailing
    return rows.swapaxes(0, 1) if lead == 1 else np.moveaxis(rows, 0, lead)


def value_key(node: CompiledNode) -> Hashable:
    """What a node's values are: equal where shapes and states are."""
    return node.plates, node.event_shape, node.is_discrete, node.domain and node.domain.key


class LinkSteps:
    """Deterministic nodes that are recomputed together, parents first.

    Parameters
    ----------
    target : Target
    links : sequence of str
        In an order in which they can be computed.
    also : callable, optional
        What of a link must be equal within a group, besides what it is.

    Attributes
    ----------
    steps : tuple
        Names that are computed alone, and groups of like ones.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.like_functions import LinkSteps
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet()
    >>> net.add("x", bmc.Normal(0.0, 1.0))
    >>> for t in range(5):
    ...     net.add(f"m[{t}]", lambda x, t=t: x * t)
    ...     net.add(f"y[{t}]", lambda m: bmc.Normal(m, 1.0), parents=[f"m[{t}]"])
    >>> target = target_of(pose(net, {f"y[{t}]": 0.0 for t in range(5)}))
    >>> steps = LinkSteps(target, target.links)
    >>> len(steps.steps)
    1
    >>> values = {**target.known, "x": np.array([1.0, 2.0])}
    >>> steps.compute(values)
    >>> values["m[3]"].tolist()
    [3.0, 6.0]
    """

    def __init__(
        self,
        target: Facts,
        links: Sequence[str],
        also: Callable[[str], Hashable] | None = None,
    ) -> None:
        self.target = target
        self.steps: tuple[Any, ...] = tuple(_steps(target, links, also))

    def compute(self, values: Values) -> None:
        """Put the links' values, given all others, in place."""
        for step in self.steps:
            if isinstance(step, str):
                values[step], _ = self.target.model.evaluate(step, values)
            else:
                values.update(step.computed(values))


class LikeLinks:
    """Links that are alike, none of which follows from another, as one call.

    Attributes
    ----------
    names : tuple of str
    """

    def __init__(self, target: Facts, names: Sequence[str]) -> None:
        self.target = target
        self.names = tuple(names)
        found = [target.signatures.of(n) for n in names]
        signatures = [s for s in found if s is not None]
        self.evaluate = as_one(signatures) or partial(target.model.evaluate, names[0])
        scopes = [s.scope[:-1] for s in signatures]  # the last is the link itself
        sources = {name: tuple(s[i] for s in scopes) for i, name in enumerate(scopes[0])}
        self.slots = Slots(target, sources, len(names))

    def computed(self, values: Values) -> Values:
        """Values of all, each with the batch of the parents of all."""
        try:
            found, batch = self.evaluate(self.slots.gathered(values))
        except BayesmcError:
            for name in self.names:  # the group knows the first one's name only
                self.target.model.evaluate(name, values)
            raise
        shape = self.target.model[self.names[0]].value_shape
        full = np.broadcast_to(found, (*batch[:-1], len(self.names), *shape))
        rows = np.ascontiguousarray(np.moveaxis(full, len(batch) - 1, 0))
        rows.flags.writeable = False
        return dict(zip(self.names, rows, strict=True))


# ---- private ------------------------------------------------------------------------------------


def _rows(arrays: Sequence[np.ndarray]) -> np.ndarray | None:
    """Arrays of one shape as the rows of one; None where they merely broadcast against each other."""
    shape = arrays[0].shape
    try:
        rows = np.concatenate(arrays) if shape else np.array(arrays)
    except ValueError:
        return None
    # of first axes that broadcast, those that are not of the first one's size are all longer, or all shorter
    if rows.size != len(arrays) * arrays[0].size:
        return None
    return rows.reshape(len(arrays), *shape)


def _broadcast_rows(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """Arrays of few shapes as the rows of one."""
    places: dict[Shape, list[int]] = {}
    for i, array in enumerate(arrays):
        places.setdefault(array.shape, []).append(i)
    full = np.broadcast_shapes(*places)
    rows = np.empty((len(arrays), *full), np.result_type(*{a.dtype for a in arrays}))
    for shape, at in places.items():
        part = np.array([arrays[i] for i in at])
        rows[at] = part.reshape(len(at), *(1,) * (len(full) - len(shape)), *shape)
    return rows


def _taking(names: Sequence[str]) -> Callable[[Any], tuple[np.ndarray, ...]]:
    """What takes the values of some names from a mapping: for thousands, as fast as can be."""
    if len(names) > 1:
        return itemgetter(*names)
    (name,) = names
    return lambda values: (values[name],)


def _once(names: Sequence[str]) -> tuple[str, ...]:
    return (names[0],) if len(set(names)) == 1 else tuple(names)


def _of_all(readings: Sequence[Reading]) -> tuple[Reading, dict[str, np.ndarray]]:
    """Readings that are alike as one, and the constants by which they differ."""
    first = readings[0]
    if all(r is first for r in readings):
        return first, {}
    one = stacked_rows([r.roots for r in readings], [r.template for r in readings])
    assert one is not None
    roots = iter(one.roots)
    return Reading(mapped(first.open, lambda _: next(roots))), one.constants


def _computed_once(
    result: Any, constants: dict[str, np.ndarray]
) -> tuple[Any, dict[str, np.ndarray]]:
    """The same with what follows from the constants alone as constants."""
    roots = tuple(expressions_of(result))
    fixed = {n for n in ordered(*roots) if n.leaves and n.leaves <= constants.keys()}
    used = [a for n in ordered(*roots) if n not in fixed for a in n.operands]
    needed = [n for n in dict.fromkeys([*used, *roots]) if n in fixed]
    names = [f"constant {k}" for k in range(len(needed))]
    instead: dict[Expression, Expression] = {
        n: leaf(name, n.shape, n.dtype) for n, name in zip(needed, names, strict=True)
    }
    values = dict(zip(names, Program(needed)(constants), strict=True))
    return mapped(result, lambda e: replaced(e, instead)), values


def _is_one(stack: np.ndarray) -> bool:
    return bool((stack == stack[:1]).all())


def _full(value: np.ndarray, shape: Shape) -> np.ndarray:
    """A value with all its elements, where candidates have one for all of a plate."""
    lead = value.shape[: value.ndim - len(shape)]
    return value if value.shape == lead + shape else np.broadcast_to(value, lead + shape)


def _steps(
    target: Facts, links: Sequence[str], also: Callable[[str], Hashable] | None
) -> list[str | LikeLinks]:
    """Each link alone, or in the first group of its like that comes after all it is computed from."""
    groups: list[list[str]] = []
    place: dict[str, int] = {}
    last: dict[Hashable, int] = {}
    signatures = target.signatures
    for link in links:
        after = max((place[p] for p in target.model[link].parents if p in place), default=-1)
        signature = signatures.of(link)
        at = -1
        if signature is not None and math.prod(target.model[link].value_shape) < _LARGE:
            repeated = tuple(signature.scope.index(n) for n in signature.scope)
            key = signature.key, repeated, None if also is None else also(link)
            at = last.get(key, -1)
            if at <= after:
                at = last[key] = len(groups)
        if at < 0 or at == len(groups):
            at = len(groups)
            groups.append([])
        groups[at].append(link)
        place[link] = at
    many = (group if len(group) < FEWEST else [LikeLinks(target, group)] for group in groups)
    return [step for steps in many for step in steps]
