"""Random means and scales, each said twice: as a user writes it, and as numbers.

An ``Expression`` holds what a function computes from its arguments (gathers, ``np.where``, arithmetic,
``np.matvec``, reductions of foreign plates), and what that is at one plate element and one joint state of
the discrete elements. The two are written side by side and share the random numbers only. Which nodes a
net has, and what they are, is `gaussians`' affair.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.plates import stack
from bayesmc.testing.makers.choices import Choices
from bayesmc.testing.oracles.conditional_gaussian import PlainNode, Scalar, Variable, element_of

At = Mapping[str, int]
States = Callable[[Variable], int]
Arguments = Mapping[str, Any]


@dataclass(frozen=True)
class Affine:
    """A number (or a vector) that is affine in continuous scalars; all parts have one shape."""

    constant: Any
    slopes: dict[Scalar, Any]

    def __add__(self, other: Affine) -> Affine:
        keys = dict.fromkeys([*self.slopes, *other.slopes])
        slopes = {k: self.slopes.get(k, 0.0) + other.slopes.get(k, 0.0) for k in keys}
        return Affine(self.constant + other.constant, slopes)

    def map(self, linear: Callable[[Any], Any]) -> Affine:
        return Affine(linear(self.constant), {k: linear(v) for k, v in self.slopes.items()})


@dataclass(frozen=True)
class Expression:
    """One expression in both forms: what a function computes from its arguments, and what that is at one
    plate element and one joint state of the discrete elements."""

    names: tuple[str, ...]
    call: Callable[[Arguments], Any]
    plain: Callable[[At, States], Any]


@dataclass(frozen=True)
class Known:
    """What later nodes need to know of an earlier one: ``length`` is 0 for a scalar."""

    node: PlainNode
    length: int = 0

    @property
    def name(self) -> str:
        return self.node.name

    @property
    def states(self) -> tuple[Any, ...]:
        return self.node.states or ()

    @property
    def card(self) -> int:
        return len(self.states)

    @property
    def is_number(self) -> bool:
        return not isinstance(self.states[0], str)

    @property
    def is_position(self) -> bool:
        """Whether functions receive it as a position or a label, which picks rows of constant arrays."""
        return not self.is_number or self.states == tuple(range(self.card))

    def foreign(self, plates: Sequence[str]) -> list[str]:
        return [p for p in self.node.plates if p not in plates]


class Terms:
    """Random expressions of the nodes that a net has so far.

    Parameters
    ----------
    choices : Choices
    sizes : dict
        Plate name -> size.
    known : list of Known
        The nodes, as they come in; it is read, never written.
    most : int
        Most terms of a sum.
    """

    def __init__(
        self, choices: Choices, sizes: Mapping[str, int], known: list[Known], most: int
    ) -> None:
        self.choices = choices
        self.sizes = sizes
        self.known = known
        self.most = most

    def score(self, plates: tuple[str, ...]) -> Expression:
        """A sum of terms, and a constant that may differ by plate element."""
        count = self.choices.integer(0, self.most) if self.known else 0
        return _sum([self._constant(plates), *(self._term(plates) for _ in range(count))])

    def scale(self, plates: tuple[str, ...]) -> Expression:
        finite = [k for k in self.known if k.card]
        if finite and self.choices.flag(0.6):
            return self.switch(self.some(finite, 1), plates, 0.5, 2.0)
        array = self._array(plates, 0.5, 2.0)
        return Expression((), lambda v: array, lambda at, s: _entry(array, plates, at))

    def switch(
        self, chosen: Sequence[Known], plates: tuple[str, ...], low: float, high: float
    ) -> Expression:
        """A number between ``low`` and ``high`` that discrete parents choose."""
        inside = [k for k in chosen if not k.foreign(plates)]
        able = [k for k in inside if k.is_position]
        if len(able) == 2:
            a, b = able
            table = self.choices.reals(low, high, (a.card, b.card))
            return Expression(
                (a.name, b.name),
                lambda v: table[v[a.name], v[b.name]],
                lambda at, s: float(table[position_of(a, at, s), position_of(b, at, s)]),
            )
        a = chosen[0]
        foreign = a.foreign(plates)
        position = self.choices.integer(0, a.card - 1)
        value = a.states[position]
        yes, no = self.choices.real(low, high), self.choices.real(low, high)
        if foreign:
            each = self.places(foreign)
            return Expression(
                (a.name,),
                lambda v: np.where((v[a.name] == value).any(*foreign), yes, no),
                lambda at, s: (
                    yes if max([position_of(a, {**at, **e}, s) == position for e in each]) else no
                ),
            )
        kinds = (
            ["where", "indicator"]
            + ["gather"] * a.is_position
            + ["number"] * (a.is_number and low < 0)
        )
        kind = self.choices.pick(kinds)
        if kind == "gather":
            return self._rows(a, low, high, ())
        if kind == "number":
            numbers = a.states
            return Expression(
                (a.name,),
                lambda v: yes * v[a.name],
                lambda at, s: yes * numbers[position_of(a, at, s)],
            )
        if kind == "indicator":
            call: Callable[[Arguments], Any] = lambda v: no + (yes - no) * (v[a.name] == value)  # noqa: E731
        else:
            call = lambda v: np.where(v[a.name] == value, yes, no)  # noqa: E731
        return Expression(
            (a.name,), call, lambda at, s: yes if position_of(a, at, s) == position else no
        )

    def vector(self, plates: tuple[str, ...], d: int) -> Expression:
        """A mean of length ``d``."""
        vectors = [k for k in self.known if k.length]
        inside = [k for k in self.known if k.card and k.is_position and not k.foreign(plates)]
        equal = [k for k in vectors if k.length == d]
        smooth = [k for k in self.known if not k.card]
        kinds = ["stack", "rows"] + ["matrix", "matrix", "moved"] * bool(smooth)
        kind = self.choices.pick(kinds + ["branch"] * bool(equal and inside))
        if kind == "stack":
            return _stacked([self.score(plates) for _ in range(d)])
        a = self.choices.pick(inside) if inside and self.choices.flag(0.6) else None
        if kind == "rows":
            rows = self._rows(a, -1.5, 1.5, (d,))
            return _lifted(rows)
        if kind == "branch":
            return self._vector_branch(self.choices.pick(equal), self.choices.pick(inside), plates)
        if vectors and self.choices.flag(0.75):
            parent = self.choices.pick(vectors)
            x, length = self._whole(parent, plates), parent.length
        else:
            length = self.choices.integer(2, 3)
            x = _stacked([self._reading(self.choices.pick(smooth), plates) for _ in range(length)])
        matrix = self._rows(a, -1.0, 1.0, (d, length))
        moved = _product(matrix, x, np.matvec)
        if kind == "matrix":
            return moved
        offset = self._rows(None, -1.0, 1.0, (d,))
        return _sum([moved, _lifted(offset)])

    def covariance(
        self, plates: tuple[str, ...], d: int
    ) -> tuple[Expression, Callable[[At, States], np.ndarray]]:
        """What `MvNormal` is given beside the mean, and the covariance that this is."""
        inside = [k for k in self.known if k.card and k.is_position and not k.foreign(plates)]
        a = self.choices.pick(inside) if inside and self.choices.flag() else None
        kind = self.choices.pick(["scale_diag", "cov", "scale_tril"])
        count = a.card if a else 1
        diagonal = self.choices.reals(0.5, 1.5, (count, d))
        tril = np.tril(self.choices.reals(-0.75, 0.75, (count, d, d)), -1) * (kind != "scale_diag")
        tril[:, range(d), range(d)] = diagonal
        covs = tril @ np.matrix_transpose(tril)
        given = {"scale_diag": diagonal, "cov": covs, "scale_tril": tril}[kind]
        names = (a.name,) if a else ()
        noise = Expression(
            names, lambda v: {kind: given[v[a.name]] if a else given[0]}, lambda at, s: None
        )
        return noise, lambda at, s: covs[position_of(a, at, s) if a else 0]

    def some(self, candidates: Sequence[Known], at_least: int = 0) -> list[Known]:
        chosen = [k for k in candidates if self.choices.flag()][:2]
        return chosen if len(chosen) >= at_least else [self.choices.pick(candidates)]

    def places(self, plates: Sequence[str]) -> list[dict[str, int]]:
        """Every element of these plates."""
        shape = [self.sizes[p] for p in plates]
        return [dict(zip(plates, at, strict=True)) for at in np.ndindex(*shape)]

    def _term(self, plates: tuple[str, ...]) -> Expression:
        smooth = [k for k in self.known if not k.card]
        finite = [k for k in self.known if k.card]
        if not smooth or (finite and self.choices.flag(0.2)):
            return _lifted(self.switch(self.some(finite, 1), plates, -2.0, 2.0))
        x = self._reading(self.choices.pick(smooth), plates)
        w, c = self.choices.real(-1.5, 1.5), self.choices.real(-1.0, 1.0)
        inside = [k for k in finite if not k.foreign(plates)]
        kind = self.choices.pick(
            ["weight", "arithmetic"] + ["switched", "branch", "choice"] * bool(inside)
        )
        if kind == "weight":
            return Expression(x.names, lambda v: w * x.call(v), _mapped(x, lambda y: w * y))
        if kind == "arithmetic":
            call = lambda v: -(x.call(v) - c) / 2  # noqa: E731
            half = _mapped(x, lambda y: -y / 2)
            return Expression(x.names, call, lambda at, s: half(at, s) + Affine(c / 2, {}))
        if kind == "switched":
            return _product(self.switch(self.some(inside, 1), plates, -1.5, 1.5), x, operator.mul)
        return self._branch(x, self.choices.pick(inside), plates, both=kind == "choice")

    def _branch(self, x: Expression, a: Known, plates: tuple[str, ...], both: bool) -> Expression:
        """``np.where(a == value, w * x, -y + c)``, where ``y`` is another reading, or ``x`` itself."""
        other = self._reading(self.choices.pick([k for k in self.known if not k.card]), plates)
        y = other if both else x
        w, c = self.choices.real(-1.5, 1.5), self.choices.real(-1.0, 1.0)
        position = self.choices.integer(0, a.card - 1)
        value = a.states[position]

        def plain(at: At, s: States) -> Affine:
            yes = x.plain(at, s).map(lambda u: w * u)
            no = y.plain(at, s).map(lambda u: -u) + Affine(c, {})
            return yes if position_of(a, at, s) == position else no

        call = lambda v: np.where(v[a.name] == value, w * x.call(v), -y.call(v) + c)  # noqa: E731
        return Expression((*x.names, *y.names, a.name), call, plain)

    def _vector_branch(self, x: Known, a: Known, plates: tuple[str, ...]) -> Expression:
        """``np.where((a == value)[..., None], x, w * x + b)``."""
        whole, w = self._whole(x, plates), self.choices.real(-1.0, 1.0)
        b = self.choices.reals(-1.0, 1.0, (x.length,))
        position = self.choices.integer(0, a.card - 1)
        value = a.states[position]

        def call(v: Arguments) -> Any:
            u = whole.call(v)
            return np.where((v[a.name] == value)[..., None], u, w * u + b)

        def plain(at: At, s: States) -> Affine:
            u = whole.plain(at, s)
            return (
                u if position_of(a, at, s) == position else u.map(lambda y: w * y) + Affine(b, {})
            )

        return Expression((*whole.names, a.name), call, plain)

    def _reading(self, known: Known, plates: tuple[str, ...]) -> Expression:
        """One number of a continuous parent."""
        whole = self._whole(known, plates)
        if not known.length:
            return whole
        if self.choices.flag():
            k = self.choices.integer(0, known.length - 1)
            return Expression(
                whole.names, lambda v: whole.call(v)[..., k], _mapped(whole, lambda u: u[k])
            )
        w = self.choices.reals(-1.0, 1.0, (known.length,))
        return Expression(
            whole.names,
            lambda v: np.vecdot(whole.call(v), w),
            _mapped(whole, lambda u: float(w @ u)),
        )

    def _whole(self, known: Known, plates: tuple[str, ...]) -> Expression:
        """A continuous parent, a foreign plate reduced or gathered."""
        name, foreign = known.name, known.foreign(plates)
        if not foreign:
            return Expression((name,), lambda v: v[name], lambda at, s: _value(known, at))
        if len(foreign) == 2 or self.choices.flag():
            how = self.choices.pick(("sum", "mean"))
            each = self.places(foreign)
            share = 1.0 if how == "sum" else 1.0 / len(each)

            def reduced(at: At, s: States) -> Affine:
                parts = [_value(known, {**at, **e}).map(lambda y: share * y) for e in each]
                return sum(parts[1:], parts[0])

            return Expression((name,), lambda v: getattr(v[name], how)(*foreign), reduced)
        return self._gathered(known, plates, foreign[0])

    def _gathered(self, known: Known, plates: tuple[str, ...], plate: str) -> Expression:
        """An element of a foreign plate: by a number, by a constant array, or by a discrete parent."""
        name, size = known.name, self.sizes[plate]
        pickers = [
            k for k in self.known if k.states == tuple(range(size)) and not k.foreign(plates)
        ]
        if pickers and self.choices.flag(0.75):
            a = self.choices.pick(pickers)
            return Expression(
                (name, a.name),
                lambda v: v[name][v[a.name]],
                lambda at, s: _value(known, {**at, plate: position_of(a, at, s)}),
            )
        index = np.array(self.choices.integer(0, size - 1))
        if plates and self.choices.flag():
            shape = tuple(self.sizes[p] for p in plates)
            draws = [self.choices.integer(0, size - 1) for _ in range(math.prod(shape))]
            index = np.reshape(draws, shape)
        given = index if index.ndim else int(index)
        return Expression(
            (name,),
            lambda v: v[name][given],
            lambda at, s: _value(known, {**at, plate: int(_entry(index, plates, at))}),
        )

    def _rows(self, a: Known | None, low: float, high: float, shape: tuple[int, ...]) -> Expression:
        """A constant array, or a row of one that the parent ``a`` picks."""
        array = self.choices.reals(low, high, (a.card if a else 1, *shape))
        if a is None:
            return Expression((), lambda v: array[0], lambda at, s: array[0])
        return Expression(
            (a.name,), lambda v: array[v[a.name]], lambda at, s: array[position_of(a, at, s)]
        )

    def _constant(self, plates: tuple[str, ...]) -> Expression:
        array = self._array(plates, -1.0, 1.0)
        return Expression((), lambda v: array, lambda at, s: Affine(_entry(array, plates, at), {}))

    def _array(self, plates: tuple[str, ...], low: float, high: float) -> Any:
        """A number, or one for each plate element."""
        if plates and self.choices.flag():
            return self.choices.reals(low, high, tuple(self.sizes[p] for p in plates))
        return self.choices.real(low, high)


def _sum(parts: Sequence[Expression]) -> Expression:
    names = tuple(dict.fromkeys(n for part in parts for n in part.names))

    def call(v: Arguments) -> Any:
        total = parts[0].call(v)
        for part in parts[1:]:
            total = total + part.call(v)
        return total

    def plain(at: At, s: States) -> Affine:
        values = [part.plain(at, s) for part in parts]
        return sum(values[1:], values[0])

    return Expression(names, call, plain)


def position_of(known: Known, at: At, states: States) -> int:
    """Position of a discrete parent's element."""
    return states((known.name, element_of(known.node, at)))


def _value(known: Known, at: At) -> Affine:
    """A continuous parent's element, as an affine function of its own scalars."""
    element = element_of(known.node, at)
    if not known.length:
        return Affine(0.0, {(known.name, element, 0): 1.0})
    unit = np.eye(known.length)
    slopes = {(known.name, element, k): unit[k] for k in range(known.length)}
    return Affine(np.zeros(known.length), slopes)


def _product(factor: Expression, x: Expression, function: Callable[[Any, Any], Any]) -> Expression:
    """``function(factor, x)``, linear in ``x``, where discrete parents choose the factor."""

    def plain(at: At, s: States) -> Affine:
        chosen = factor.plain(at, s)
        return x.plain(at, s).map(lambda u: function(chosen, u))

    names = (*x.names, *factor.names)
    return Expression(names, lambda v: function(factor.call(v), x.call(v)), plain)


def _mapped(x: Expression, linear: Callable[[Any], Any]) -> Callable[[At, States], Affine]:
    return lambda at, s: x.plain(at, s).map(linear)


def _lifted(number: Expression) -> Expression:
    """An expression of discrete parents as an affine one."""
    return Expression(number.names, number.call, lambda at, s: Affine(number.plain(at, s), {}))


def _stacked(parts: Sequence[Expression]) -> Expression:
    """Numbers as a vector."""

    def plain(at: At, s: States) -> Affine:
        values = [part.plain(at, s) for part in parts]
        keys = dict.fromkeys(k for value in values for k in value.slopes)
        slopes = {k: np.array([value.slopes.get(k, 0.0) for value in values]) for k in keys}
        return Affine(np.array([value.constant for value in values]), slopes)

    names = tuple(dict.fromkeys(n for part in parts for n in part.names))
    return Expression(names, lambda v: stack([part.call(v) for part in parts]), plain)


def _entry(array: Any, plates: Sequence[str], at: At) -> float:
    return float(array[tuple(at[p] for p in plates)]) if np.ndim(array) else float(array)
