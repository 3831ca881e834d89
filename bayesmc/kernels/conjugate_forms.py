"""A full conditional whose natural parameters are expressions of the state: one program."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from bayesmc.errors import BayesmcError
from bayesmc.expression import Expression
from bayesmc.expression.scalars import SmallProgram
from bayesmc.kernels.conjugate_children import Child
from bayesmc.kernels.conjugate_families import (
    Bounds,
    Conditional,
    DirichletConditional,
    InverseWishartConditional,
    MvNormalConditional,
    Naturals,
    NormalConditional,
)
from bayesmc.kernels.conjugate_labels import Counts
from bayesmc.kernels.conjugate_range import refuse
from bayesmc.kernels.label_sums import LabelSums
from bayesmc.kernels.vector_draws import DirichletDraw, InverseWishartDraw, NormalDraw
from bayesmc.passes.arithmetic import multiply
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.joint_values import JointValues
from bayesmc.structure.target import Values

#: numbers that are added up one by one
_FEW = 64


class Form:
    """The full conditional of a class of elements.

    Parameters
    ----------
    family : Conditional
    words : str
        The prior and the children that it rests on.
    naturals : sequence of Expression
        With the node's plates in front, or the members of the class.
    bounds : sequence of Expression
        Of the support, none or two.
    positive : sequence of tuple
        What must be positive, and the child that it is a parameter of.
    placed : sequence
        What it reads beside the state: sums by label, and values of many nodes as one array.
    """

    def __init__(
        self,
        family: Conditional,
        words: str,
        naturals: list[Expression],
        bounds: list[Expression],
        positive: list[tuple[Expression, Child]],
        placed: Sequence[LabelSums | Counts | JointValues],
    ) -> None:
        self.family, self.words, self._placed = family, words, placed
        self._naturals, self._bounds, self._least = naturals, bounds, positive
        self._positive = [child for _, child in positive]
        roots = [*naturals, *bounds, *(e for e, _ in positive)]
        self._program = SmallProgram(roots)
        self._count, self._ends = len(naturals), len(naturals) + len(bounds)
        self._ndims = [len(r.shape) for r in roots]
        self._kept: tuple[Naturals, Bounds | None] | None = None
        self._draw = None if bounds or positive else _one_program(family, naturals)
        if not any(r.leaves for r in roots):
            self._kept = self({})

    def reading(self, joint: JointValues) -> Form:
        """The same, with an array of many nodes' values in their place where it reads several of them."""

        def changed(found: list[Expression]) -> list[Expression]:
            return [joint.read_by(e) for e in found]

        naturals, bounds = changed(self._naturals), changed(self._bounds)
        positive = [(joint.read_by(e), child) for e, child in self._least]
        before = [*self._naturals, *self._bounds, *(e for e, _ in self._least)]
        after = [*naturals, *bounds, *(e for e, _ in positive)]
        if all(a is b for a, b in zip(before, after, strict=True)):
            return self
        return Form(self.family, self.words, naturals, bounds, positive, [*self._placed, joint])

    def __call__(self, values: Values) -> tuple[Naturals, Bounds | None]:
        """Natural parameters, ``(lead, *plates, ...)`` or ``(lead, members, ...)``, and bounds."""
        if self._kept is not None:
            return self._kept
        values = self._with_placed(values)
        found = [
            a if a.ndim > n else a[None]
            for a, n in zip(self._program(values), self._ndims, strict=True)
        ]
        k, end = self._count, self._ends
        for least, child in zip(found[end:], self._positive, strict=True):
            if (least <= 0.0).any():
                refuse(child, values)
        return tuple(found[:k]), (found[k], found[k + 1]) if end > k else None

    def drawn(self, values: Values, rng: np.random.Generator, chains: int) -> np.ndarray | None:
        """A draw by one program, where there is one and it is a number; else None.

        Raises
        ------
        LinAlgError
            A matrix is not positive definite to rounding.
        """
        if self._draw is None:
            return None
        found = self._draw(self._with_placed(values), rng, chains)
        return found if found is None or _is_finite(found) else None

    def left(self, values: Values) -> Values:
        """Sums by label that it reads and that are not in the state yet, for others that read them."""
        found: Values = {}
        for placed in self._placed:
            if isinstance(placed, JointValues):  # left by who draws them
                continue
            sums = placed.sums if isinstance(placed, Counts) else placed
            state = values if sums is None else sums.placed(values)
            if sums is not None and state is not values:
                found |= sums.kept(state[sums.label], state[sums.key])
        return found

    def _with_placed(self, values: Values) -> Values:
        for placed in self._placed:
            values = placed.placed(values)
        return values


def is_closed(form: Form, blanket: Blanket) -> bool:
    """Whether there is a closed form at some states."""
    states: Values | None = blanket.target.states
    if states is None:
        return False
    try:
        naturals, _ = form(states)
    except BayesmcError:
        return False
    return all(bool(np.isfinite(n).all()) for n in naturals)


# ---- private ------------------------------------------------------------------------------------


def _is_finite(numbers: np.ndarray) -> bool:
    if numbers.size <= _FEW:
        return math.isfinite(sum(numbers.ravel().tolist()))
    return math.isfinite(np.add.reduce(numbers, axis=None))


def _one_program(
    family: Conditional, naturals: list[Expression]
) -> NormalDraw | InverseWishartDraw | DirichletDraw | None:
    """Natural parameters and draw as one."""
    if isinstance(family, NormalConditional):
        linear, square = naturals
        return NormalDraw(multiply(square, -2.0), linear)
    if isinstance(family, MvNormalConditional):
        return NormalDraw(*naturals)
    if isinstance(family, InverseWishartConditional):
        return InverseWishartDraw(*naturals)
    return DirichletDraw(*naturals) if isinstance(family, DirichletConditional) else None
