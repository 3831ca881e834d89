"""Moments of leaves: what is known of a leaf's distribution, and what stands for its expectations."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from bayesmc.errors import TraceError
from bayesmc.expression import Leaf, leaf
from bayesmc.shapes import Shape


@dataclass(frozen=True)
class Hidden:
    """What is known of a leaf's distribution.

    Attributes
    ----------
    name : str
    kind : str
        ``"number"`` (normal), ``"positive"``, ``"unit"``, ``"simplex"`` or ``"matrix"``.
    shape : tuple of int
    width : int
        Of numbers: so many in a row vary together, others are independent.
    scale : str or None
        Of numbers: the leaf of the precision that they share a distribution with; given it, their covariance
        is a multiple of its inverse.
    """

    name: str
    kind: str
    shape: Shape
    width: int = 1
    scale: str | None = None

    def moment(self, feature: str) -> Leaf:
        """The leaf that stands for the expectation of a feature of every element.

        Of numbers ``"mean"``, ``"cov"`` (groups, width, width) and, with a scale, ``"spread"``; of others
        ``"x"``, ``"inv"``, ``"log"`` (of a matrix: of its determinant) and ``"log1m"``.
        """
        shape = self.shape
        if feature == "cov":
            groups = int(np.prod(shape, dtype=int)) // self.width
            shape = (groups, self.width, self.width)
        elif feature == "spread" or (feature == "log" and self.kind == "matrix"):
            inner = {"matrix": 2}.get(self.kind, 1 if self.width > 1 else 0)
            shape = shape[: len(shape) - inner]
        return leaf(moment(self.name, feature), shape)


def moment(name: str, feature: str) -> str:
    """The name of a moment's leaf."""
    return f"{feature} of \0{name}"


class NoMoment(TraceError):
    """There is no expectation in closed form.

    Attributes
    ----------
    names : frozenset of str
        Leaves without which there might be one.
    """

    def __init__(self, message: str, names: Iterable[str]) -> None:
        super().__init__(message)
        self.names = frozenset(names)


class Meeting(NoMoment):
    """Elements of a leaf that are independent meet in one entry: they had better be jointly normal."""
