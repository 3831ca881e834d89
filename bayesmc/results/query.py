"""Queries by argument name: which nodes a function asks for, and how they reach it."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.errors import (
    BayesmcError,
    QueryError,
    ShapeError,
    UnknownNodeError,
    UnsupportedError,
)
from bayesmc.network import Model
from bayesmc.network.align import Aligner
from bayesmc.plates import PlateArray
from bayesmc.shapes import Shape, broadcasts_to
from bayesmc.states import StateArray, as_numbers


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
    """

    def __init__(
        self,
        model: Model,
        function: Callable[..., Any] | str,
        plates: str | Sequence[str] = (),
        names: Mapping[str, str] | None = None,
    ) -> None:
        self.plates = (plates,) if isinstance(plates, str) else tuple(plates)
        for plate in self.plates:
            if plate not in model.sizes:
                raise UnknownNodeError(
                    f"query: no plate {plate!r}; the plates are {list(model.sizes)}"
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
                    f"query: argument {name!r} is not a node; name nodes by argument, or map them with "
                    "names={argument: node}"
                )
        self.model = model
        self.plate_shape = tuple(model.sizes[p] for p in self.plates)

    def __call__(self, stored: Mapping[str, np.ndarray], batch: Shape) -> np.ndarray:
        """The function's values, shape ``(*batch, *plates, ...)``."""
        arguments = []
        for name in self.nodes:
            node = self.model.nodes[name]
            value = stored[name]
            if self.plates:
                link = Aligner(self.plates, node.plates, len(node.event_shape), node.domain)
                argument = link(value)
                plain = isinstance(argument, np.ndarray)
                arguments.append(as_numbers(argument) if plain else argument)
            else:
                arguments.append(as_numbers(_frozen(node.decode(value))))
        try:
            result = self.function(*arguments)
        except BayesmcError:
            raise
        except Exception as error:
            shapes = ", ".join(str(np.shape(getattr(a, "array", a))) for a in arguments)
            raise QueryError(
                f"query: the function fails on arrays of shape {shapes} ({type(error).__name__}: {error}); "
                "it gets all draws at once, so write it with NumPy (& for and, np.where for if, "
                "np.maximum for max)"
            ) from error
        if isinstance(result, PlateArray):
            raise result._ungathered()
        if isinstance(result, StateArray):
            raise UnsupportedError(
                f"query: the function returns labels {result.states}, which have no mean; compare them, as "
                f"in {self.nodes[0]} == {result.states[0]!r}"
            )
        array = np.asarray(result)
        lead = batch + self.plate_shape
        short = array.shape[: len(lead)]
        if (
            array.ndim < len(batch)
            or not broadcasts_to(short, lead)
            or array.shape[: len(batch)] != batch
        ):
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


def _arguments(function: Callable[..., Any], names: Mapping[str, str]) -> tuple[str, ...]:
    parameters = inspect.signature(function).parameters.values()
    wanted = [p for p in parameters if p.default is p.empty]
    for p in wanted:
        if p.kind in (p.VAR_KEYWORD, p.VAR_POSITIONAL):
            raise UnknownNodeError(f"query: the argument {p} names no node")
    return tuple(names.get(p.name, p.name) for p in wanted)


def _identity(value: Any) -> Any:
    return value.array if isinstance(value, PlateArray) else value


def _frozen(array: np.ndarray) -> np.ndarray:
    view = array.view()
    view.flags.writeable = False
    return view
