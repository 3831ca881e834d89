"""Queries by argument name: which nodes a function asks for, and how they reach it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.errors import (
    BayesmcError,
    QueryError,
    ShapeError,
    UnknownNodeError,
    UnsupportedError,
    did_you_mean,
)
from bayesmc.network import Model
from bayesmc.network.calling import Aligner
from bayesmc.network.node import nodes_read
from bayesmc.plates import PlateArray
from bayesmc.shapes import Shape, broadcasts_to, masks, nearly_equal, read_only, unused_sizes
from bayesmc.states import StateArray, as_numbers

#: draws on which a function is tried alone
_DRAWS_TRIED = 8
#: pairs of draws between which elements of a plate are changed: one pair may hide a mixing by luck
_PAIRS_TRIED = 8


class Query:
    """A function of named nodes, resolved against a model.

    Parameters
    ----------
    function : callable or str
        Arguments name nodes (a string asks for that node itself).
    plates : str or tuple of str
        With plates, arguments arrive as at a node in those plates; without, as
        ``(*batch, *plates, *event)``.
    names : dict, optional
        Argument name -> node name, for nodes whose names are no identifiers.
    is_event : bool
        It must return booleans, whose mean is a probability.
    """

    def __init__(
        self,
        model: Model,
        function: Callable[..., Any] | str,
        plates: str | Sequence[str] = (),
        names: Mapping[str, str] | None = None,
        is_event: bool = False,
    ) -> None:
        self.is_event = is_event
        self.plates = (plates,) if isinstance(plates, str) else tuple(plates)
        for plate in self.plates:
            if plate not in model.sizes:
                raise UnknownNodeError(
                    f"query: no plate {plate!r}{did_you_mean(plate, model.sizes)}; the plates are "
                    f"{list(model.sizes)}"
                )
        if isinstance(function, str):
            self.nodes: tuple[str, ...] = (function,)
            self.function: Callable[..., Any] = _identity
        else:
            self.nodes = _arguments(function, names or {})
            self.function = function
        for name in self.nodes:
            if name not in model.nodes:
                raise UnknownNodeError(
                    f"query: argument {name!r} is not a node{did_you_mean(name, model.nodes)}; name nodes by "
                    "argument, or map them with names={argument: node}"
                )
        self.model = model
        self.plate_shape = tuple(model.sizes[p] for p in self.plates)

    def __call__(self, stored: Mapping[str, np.ndarray], batch: Shape) -> np.ndarray:
        """The function's values, shape ``(*batch, *plates, ...)``.

        Like a node's function it acts draw by draw, and on ``plates`` element by element; it is
        called again on a few draws to see that it does.
        """
        values = self._evaluate(stored, batch)
        if self.function is not _identity and values.size:
            self._check_draws(stored, batch, values)
            self._check_plates(stored, batch)
        if self.is_event and values.dtype.kind != "b":
            raise UnsupportedError(
                f"probability: the function returns {values.dtype} values, not booleans; use expectation"
            )
        return values

    def raw(self, stored: Mapping[str, Any]) -> Any:
        """What the function itself returns; stored values may be traced."""
        arguments = [self._argument(name, stored[name]) for name in self.nodes]
        try:
            return self.function(*arguments)
        except BayesmcError:
            raise
        except Exception as error:
            shapes = ", ".join(str(np.shape(getattr(a, "array", a))) for a in arguments)
            raise QueryError(
                f"query: the function fails on arrays of shape {shapes} ({type(error).__name__}: {error}); "
                "it gets all draws at once, so write it with NumPy (& for and, np.where for if, "
                "np.maximum for max)"
            ) from error

    def fitted(self, result: Any, batch: Shape) -> np.ndarray:
        """A result of the function, checked and broadcast to batch and plates."""
        if isinstance(result, PlateArray):
            raise result.ungathered()
        if isinstance(result, StateArray):
            raise UnsupportedError(
                f"query: the function returns labels {result.states}, which have no mean; compare them, as "
                f"in {self.nodes[0]} == {result.states[0]!r}"
            )
        return self._fitted(np.asarray(result), batch)

    def _evaluate(self, stored: Mapping[str, np.ndarray], batch: Shape) -> np.ndarray:
        return self.fitted(self.raw(stored), batch)

    def _argument(self, name: str, value: np.ndarray) -> Any:
        node = self.model.nodes[name]
        if not self.plates:
            return as_numbers(read_only(node.decode(value)))
        link = Aligner(self.plates, node.plates, len(node.event_shape), node.domain)
        argument = link(value)
        return as_numbers(argument) if isinstance(argument, np.ndarray) else argument

    def _fitted(self, array: np.ndarray, batch: Shape) -> np.ndarray:
        """The result broadcast to batch and plates; one without its batch axes is refused."""
        lead = batch + self.plate_shape
        if array.shape[: len(batch)] != batch or not broadcasts_to(array.shape[: len(lead)], lead):
            raise ShapeError(
                f"query: the function returns shape {array.shape} for draws of batch shape {batch}; keep "
                "the leading axes (reduce with axis=-1, take components as v[..., k])"
            )
        if array.ndim < len(lead):
            raise ShapeError(
                f"query: the result's shape {array.shape} lacks the plates {self.plates}"
            )
        if array.dtype.kind not in "biufc":
            raise ShapeError(f"query: the function returns {array.dtype} values; return numbers")
        return np.broadcast_to(array, lead + array.shape[len(lead) :])

    def _check_draws(
        self, stored: Mapping[str, np.ndarray], batch: Shape, values: np.ndarray
    ) -> None:
        """A few draws by themselves, in another order, must give the same values."""
        taken = [*range(_DRAWS_TRIED), *batch, *values.shape, *self.model.sizes.values()]
        count = int(unused_sizes(taken, 1)[0])
        flat = np.linspace(math.prod(batch) - 1, 0, count).round().astype(int)
        for chosen in (flat, *flat[:_DRAWS_TRIED, None]):  # together, and one by one
            at = np.unravel_index(chosen, batch)
            few = {name: stored[name][at] for name in self.nodes}
            try:
                alone = self._evaluate(few, chosen.shape)
            except BayesmcError as error:
                raise QueryError(self._mixed(str(error))) from error
            if not nearly_equal(values[at], alone):
                raise QueryError(self._mixed("a few draws alone give other values"))

    def _mixed(self, why: str) -> str:
        return (
            f"query: the function mixes draws ({why}); it must act on each draw by itself, so that its "
            "values can be weighted: take x.mean() and the like from posterior.mean, var or quantile"
        )

    def _check_plates(self, stored: Mapping[str, np.ndarray], batch: Shape) -> None:
        """Changing some elements of a plate must leave the values of the others."""
        total = math.prod(batch)
        rows = np.linspace(0, total - 1, min(_PAIRS_TRIED, total)).round().astype(int)
        base, other = (np.unravel_index(r, batch) for r in (rows, np.roll(rows, -1)))
        for axis, plate in enumerate(self.plates):
            size = self.plate_shape[axis]
            for chosen in masks(size) if size > 1 else ():
                pairs = {
                    n: self._blend(n, stored[n][base], stored[n][other], plate, chosen)
                    for n in self.nodes
                }
                before, after = np.split(self._evaluate(pairs, (2 * len(rows),)), 2)
                rest = (slice(None),) * (axis + 1) + (~chosen,)
                if not nearly_equal(before[rest], after[rest]):
                    raise QueryError(
                        f"query: the function mixes elements of plate {plate!r}; with plates= it acts "
                        "element by element. Leave plates= out to reduce over a plate"
                    )

    def _blend(
        self, name: str, base: np.ndarray, other: np.ndarray, plate: str, chosen: np.ndarray
    ) -> np.ndarray:
        """Draws, and after them the same with the chosen elements of a plate taken from others."""
        node = self.model.nodes[name]
        if plate not in node.plates:
            return np.concatenate([base, base])
        axis = 1 + node.plates.index(plate)
        mask = chosen.reshape((-1,) + (1,) * (base.ndim - axis - 1))
        return np.concatenate([base, np.where(mask, other, base)])


def _arguments(function: Callable[..., Any], names: Mapping[str, str]) -> tuple[str, ...]:
    return tuple(names.get(a, a) for a in nodes_read(function))


def _identity(value: Any) -> Any:
    return value.array if isinstance(value, PlateArray) else value
