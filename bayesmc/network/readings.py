"""What functions compute of their arguments: read once for all nodes that share it, and held against them.

A reading speaks of leaves ``argument 0``, ``argument 1``, ... for what a node's parents store, and of
``number 0``, ... for numbers that were put into the function, as the index of a slice is. The slices of an
unrolled template have one reading, and so do nodes that were given one function. What was read must give what
the function gives, at probe points."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.distributions import (
    Affine,
    Categorical,
    Density,
    Distribution,
    Joint,
    Mixture,
    Ordered,
    Truncated,
    as_distribution,
)
from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BayesmcError, TraceError
from bayesmc.expression import (
    Expression,
    Family,
    Leaf,
    Program,
    TracedArray,
    TracedStates,
    constant,
    elementwise,
    expressions_of,
    gather,
    leaf,
    rebuilt,
    reduction,
    reshape,
    trace,
)
from bayesmc.network.calling import Aligner, RowAligner
from bayesmc.network.labels import Domain
from bayesmc.network.model import CompiledNode, Model, deterministic_above
from bayesmc.network.node import Numbered
from bayesmc.passes.log_density import family_of
from bayesmc.passes.templates import Template, template
from bayesmc.plates import PlateArray
from bayesmc.shapes import Shape, nearly_equal


@dataclass(frozen=True, eq=False)
class Reading:
    """What a function computes.

    Attributes
    ----------
    result : Family, Expression or Distribution
        Of leaves ``argument k`` and ``number k``; a distribution that depends on none.
    """

    result: Any

    @cached_property
    def open(self) -> Any:
        """The result with the parameters of a known distribution as constants, where it has a family."""
        if not isinstance(self.result, Distribution):
            return self.result
        try:
            return family_of(self.result)
        except TraceError:
            return self.result

    @cached_property
    def roots(self) -> tuple[Expression, ...]:
        """The expressions of ``open``."""
        return tuple(expressions_of(self.open))

    @cached_property
    def template(self) -> Template:
        """What the roots are, apart from their constants."""
        return template(*self.roots)

    @cached_property
    def key(self) -> Hashable:
        """Equal for readings that differ in constants only, if these may differ."""
        exact = () if self.may_differ else tuple(map(_content, self.template.constants))
        return frame(self.open), self.template.key, self.template.leaves, exact

    @cached_property
    def may_differ(self) -> bool:
        """Whether constants of several such functions can be put in one: ``with_axes`` knows the family."""
        try:
            with_axes(self.open, 0)
        except TraceError:
            return False
        return True

    @cached_property
    def program(self) -> Program:
        """Values of the expressions of the result."""
        return Program(list(expressions_of(self.result)))


@dataclass(frozen=True)
class Argument:
    """What a function receives for a parent, apart from the parent's name.

    Attributes
    ----------
    place : int
        Of the first argument that is the same node.
    shape, dtype, states : tuple of int, str, int or None
        Of what the parent stores.
    how : hashable
        How it is decoded and aligned.
    known : Expression or None
        Its value, where that never changes, or what it follows from.
    """

    place: int
    shape: Shape
    dtype: str
    states: int | None
    how: Hashable
    known: Expression | None = None

    @property
    def leaf(self) -> Leaf:
        return leaf(f"argument {self.place}", self.shape, self.dtype, self.states)

    @property
    def stored(self) -> Expression:
        """What the parent stores."""
        return self.leaf if self.known is None else self.known


def read_function(
    function: Any,
    arguments: Sequence[Argument],
    links: Sequence[tuple[str, Aligner]],
    open_number: bool = False,
    is_steady: bool = False,
) -> Reading:
    """The reading of a function; of a ``Numbered`` one for all numbers, if asked for.

    One that ``is_steady`` has been followed before, with other arguments.

    Raises
    ------
    TraceError
        It cannot be followed.
    """
    given = [_argument(a, link) for a, (_, link) in zip(arguments, links, strict=True)]
    if isinstance(function, Numbered):
        number: Any = TracedArray(leaf("number 0", (), int)) if open_number else function.number
        function, given = function.func, function.filled(given, number)
    found = trace(function, given, is_steady)
    if isinstance(found, Density) and links:
        raise TraceError("its Density may read parents where that cannot be seen")
    return Reading(found)


def read_table(
    probs: np.ndarray, arguments: Sequence[Argument], links: Sequence[tuple[str, Aligner]]
) -> Reading:
    """The reading of a conditional probability table."""
    rows: Any = 0
    for card, argument, (_, link) in zip(probs.shape[:-1], arguments, links, strict=True):
        placed: Any = TracedArray(argument.stored)
        rows = rows * card + link.place(placed)
    table = constant(probs.reshape(-1, probs.shape[-1]))
    rows = rows.expression if isinstance(rows, TracedArray) else constant(rows)
    return Reading(Family(Categorical, {"probs": gather(table, rows), "logits": None}))


def numbers_of(stored: Expression, domain: Domain) -> Expression:
    """Numeric user values of positions."""
    if domain.values is not None:
        return gather(constant(domain.values), stored)
    return elementwise(np.add, stored, domain.low) if domain.low else stored


def frame(traced: Any) -> Hashable:
    """What is around the expressions of something traced; equal where these are used alike."""
    if isinstance(traced, Expression):
        return "expression"
    if isinstance(traced, Family):
        return traced.make, tuple((k, frame(v)) for k, v in traced.parameters.items())
    if isinstance(traced, (list, tuple)):
        return type(traced), tuple(map(frame, traced))
    if traced is None or isinstance(traced, (bool, str)):
        return type(traced), traced
    return _content(traced)


def with_axes(traced: Any, rank: int) -> Any:
    """What was traced with an axis for every plate in all parameters, before those of one value.

    A batch in front of a constant parameter is else taken for plates of the others.

    Raises
    ------
    TraceError
        It is not known how many axes one value of a parameter has.
    """
    if isinstance(traced, Expression):
        missing = rank - len(traced.shape)
        return traced if missing <= 0 else reshape(traced, (1,) * missing + traced.shape)
    if isinstance(traced, Family):
        ranks = _ranks(traced)
        return Family(
            traced.make,
            {k: with_axes(v, rank + ranks.get(k, 0)) for k, v in traced.parameters.items()},
        )
    if isinstance(traced, (list, tuple)):
        return type(traced)(with_axes(v, rank) for v in traced)
    return traced


def by_element(traced: Any, event_ndim: int = 0) -> Iterator[Expression]:
    """What was traced as expressions of its plates alone: sums over all that one element is made of.

    They tell what an element depends on, not its density.

    Raises
    ------
    TraceError
        It is not known how many axes one value of a parameter has.
    """
    if isinstance(traced, Expression):
        ndim = len(traced.shape)
        yield reduction(np.add, traced, range(max(ndim - event_ndim, 0), ndim))
    elif isinstance(traced, Family):
        ranks = _ranks(traced)
        for key, value in traced.parameters.items():
            yield from by_element(value, event_ndim + ranks.get(key, 0))
    elif isinstance(traced, (list, tuple)):
        for value in traced:
            yield from by_element(value, event_ndim)


#: how far an expression may be off what the function gives, relative to the largest entry
_RTOL = 1e-11


class Probe(dict[str, np.ndarray]):
    """Stored values of all nodes at probe points; of deterministic ones as they are asked for."""

    def __init__(self, model: Model, variant: int) -> None:
        super().__init__()
        self.model, self.variant = model, variant
        self._place = {n: k for k, n in enumerate(model.nodes)}

    @classmethod
    def of(cls, model: Model, variant: int) -> Probe:
        known = model.cache.setdefault("expression probes", {})
        if variant not in known:
            known[variant] = cls(model, variant)
        return known[variant]

    def __missing__(self, name: str) -> np.ndarray:
        node = self.model[name]
        if node.kind == "deterministic":
            for above in deterministic_above(self.model, name, self):
                self[above] = self.model.evaluate(above, self)[0]
            value = self.model.evaluate(name, self)[0]
        else:
            value = self.model.probe[name]
            rank = value.ndim - len(node.value_shape)
            value = VARIANTS[self.variant](value, rank, self._place[name])
        self[name] = value
        return value


#: unlike batch shapes: all of the probe, one entry, mixed ranks; that a function gives the same whatever
#: the rank is for ``validate`` to see
VARIANTS: tuple[Callable[[np.ndarray, int, int], np.ndarray], ...] = (
    lambda v, rank, _: v,
    lambda v, rank, _: v[(0,) * rank],
    lambda v, rank, k: (v, v[0], v[:, :1], v[0, 0])[k % 4] if rank == 2 else v,
)


def hold_against(
    model: Model,
    name: str,
    result: Any,
    program: Program,
    given: Callable[[Probe], Mapping[str, np.ndarray]],
    values: Probe,
) -> None:
    """Refuse what was read of a node or potential where its function gives something else.

    Parameters
    ----------
    result : Family, Expression or Distribution
    program : Program
        Of its expressions.
    given : callable
        From values of all nodes to those of the program's leaves.
    values : Probe

    Raises
    ------
    TraceError
    """
    is_node = name in model.nodes
    with marking_invalid(), np.errstate(all="ignore"):
        try:
            if is_node:
                expected, batch = model.evaluate(name, values)
                shape = batch + model[name].plate_shape
            else:
                expected = model.potential(name, values, total=False)
                shape = expected.shape
            leaves = given(values)
        except BayesmcError:
            return  # the function's own fault, or out of range: nothing to compare
        try:
            made = rebuilt(result, iter(program(leaves)))
            if is_node and model[name].is_stochastic and not isinstance(made, Distribution):
                made = as_distribution(made)
        except (BayesmcError, ValueError, TypeError, IndexError) as error:
            raise TraceError(f"what was read of it fails: {error}") from error
        if not _agree(model.nodes.get(name), expected, made, shape):
            raise TraceError("what was read of it gives other values than the function")


def hold_form(model: Model, name: str, form: Expression) -> None:
    """Refuse a family's own log density where ``log_prob`` gives something else.

    Raises
    ------
    TraceError
    """
    program = Program([form])
    for variant in range(len(VARIANTS)):
        values = Probe.of(model, variant)
        with marking_invalid(), np.errstate(all="ignore"):
            dist, _ = model.evaluate(name, values)
            expected = model.log_density(name, dist, values[name])
            (found,) = program(values)
        if not _near(*np.broadcast_arrays(expected, found)):
            raise TraceError("its log_density gives other values than its log_prob")


# ---- private ------------------------------------------------------------------------------------


def _argument(argument: Argument, link: Aligner) -> Any:
    """The stand-in that a function receives."""
    placed = link.place(_decoded(argument.stored, link.domain))
    if isinstance(link, RowAligner):  # one element for all rows broadcasts
        event = placed.shape[placed.ndim - link.event_ndim :]
        return np.broadcast_to(placed, (len(link.flat), *event))
    if link.foreign:
        return PlateArray(placed, link.foreign, link.own, link.event_ndim)
    return placed


def _decoded(stored: Expression, domain: Domain | None) -> Any:
    """User values of stored ones."""
    if domain is None:
        return TracedArray(stored)
    if domain.labels is not None:
        return TracedStates(stored, domain.labels)
    return TracedArray(numbers_of(stored, domain))


def _content(value: Any) -> Hashable:
    """A value by what it holds, where that can be told; otherwise it is like itself alone."""
    if isinstance(value, np.ndarray) and value.dtype.kind in "biufSU":
        return "array", value.shape, value.dtype.str, value.tobytes()
    if isinstance(value, Distribution) and type(value).__module__.startswith(
        "bayesmc.distributions"
    ):
        inside = sorted(vars(value).items())
        return type(value), tuple((k, _content(v)) for k, v in inside)
    if value is None or isinstance(value, (bool, int, float, str)):
        return type(value), value
    return "object", id(value)


def _ranks(family: Family) -> dict[str, int]:
    """Axes of one value of each parameter, of parts of a mixture one for the part."""
    make, parameters = family.make, family.parameters
    if make in (Affine, Ordered, Truncated) and _is_scalar(parameters["base"]):
        return {}
    if make is Mixture:
        return {"weights": 1, "components": int(isinstance(parameters["components"], Family))}
    if isinstance(make, type) and issubclass(make, Joint):
        return {}
    known = getattr(make, "parameter_ndim", None)
    if not known:
        raise TraceError("the axes of its parameters are not known")
    return {**known, "logits": known.get("probs", 0), "scale_tril": 2, "scale_diag": 1}


def _is_scalar(base: Any) -> bool:
    if isinstance(base, Distribution):
        return not base.event_shape
    return isinstance(base, Family) and not any(_ranks(base).get(k, 0) for k in base.parameters)


def _agree(node: CompiledNode | None, expected: Any, made: Any, shape: Shape) -> bool:
    if isinstance(expected, Distribution) != isinstance(made, Distribution):
        return False
    if not isinstance(expected, Distribution):
        full = shape if node is None else shape + node.event_shape
        stored = np.asarray(expected)
        value = node.decode(stored) if node is not None and node.domain is not None else stored
        return _near(np.asarray(value), np.broadcast_to(np.asarray(made), full))
    if type(expected) is not type(made):
        return False
    pairs = zip(expected.parameters(), made.parameters(), strict=True)
    return all(n == m and _alike(a, b, shape, n) for (a, n), (b, m) in pairs)


def _alike(a: np.ndarray, b: np.ndarray, shape: Shape, own: int) -> bool:
    """Whether parameters are the same, whose last axes are their own and the others broadcast."""
    if a.shape != b.shape:
        a, b = (np.broadcast_to(x, (*shape, *x.shape[x.ndim - own :])) for x in (a, b))
    return _near(a, b)


def _near(a: np.ndarray, b: np.ndarray) -> bool:
    return nearly_equal(a, b, _RTOL, 1e-3 * _RTOL)
