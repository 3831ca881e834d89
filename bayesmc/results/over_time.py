"""Nodes of a template that was unrolled, asked by the template's name: the slices as one array over time.

An unrolled net has nodes ``"x[0]"``, ``"x[1]"``, ... Posteriors answer for ``"x"``, too: what they say of
the slices, stacked. It is told by the names alone, so nets that were written with such names in a loop are
answered for, too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import wraps
from typing import Any

import numpy as np

from bayesmc.errors import QueryError
from bayesmc.network import Model
from bayesmc.states import StateArray

#: where a model that was unrolled keeps what the data label its slices with
TIMES = "times of slices"
#: methods whose first argument is a node -> the axis that time gets
STACKED: Mapping[str, int] = {
    "mean": 0, "var": 0, "std": 0, "quantile": 0, "median": 0, "hdi": 0, "mode": 0, "cdf": 0, "mcse": 0,
    "ess": 0, "rhat": 0, "__getitem__": 2,
}  # fmt: skip
#: methods that take several nodes, each slice by itself
JOINT = ("probabilities", "entropy")


def without_functions(model: Model) -> Model:
    """A model for results that are stored, what labels its slices with it."""
    found = model.without_functions()
    if TIMES in model.cache:
        found.cache[TIMES] = model.cache[TIMES]
    return found


def slices_of(model: Model, name: Any) -> tuple[str, ...] | None:
    """The nodes that are a template's node in every slice; None where the name is a node's own, or none's.

    Raises
    ------
    QueryError
        Slices are missing in between.
    """
    if not isinstance(name, str) or name in model.nodes or f"{name}[0]" not in model.nodes:
        return None
    found: dict[str, tuple[str, ...]] = model.cache.setdefault("slices by name", {})
    if name not in found:
        steps = 0
        while f"{name}[{steps}]" in model.nodes:
            steps += 1
        rows = tuple(f"{name}[{t}]" for t in range(steps))
        shapes = {model.nodes[row].value_shape for row in rows}
        if len(shapes) > 1:
            raise QueryError(
                f"{name!r}: its slices have shapes {sorted(shapes)}, which make no one array; ask "
                "slice by slice, "
                f"{rows[0]!r}, ..."
            )
        found[name] = rows
    return found[name]


def expanded(model: Model, names: Iterable[Any]) -> list[Any]:
    """Names with those of a template's nodes written out."""
    return [row for name in names for row in slices_of(model, name) or (name,)]


def take_templates(cls: type) -> type:
    """Has a class's answers about nodes take a template's nodes, too; what it inherits stays as it is."""
    for name, method in list(vars(cls).items()):
        if name in STACKED:
            setattr(cls, name, _stacking(method, STACKED[name]))
        elif name in JOINT:
            setattr(cls, name, _stacking_joint(method))
    return cls


# ---- private ------------------------------------------------------------------------------------


def _stacking(method: Callable[..., Any], axis: int) -> Callable[..., Any]:
    """A method that asks about one node, which takes a template's node for all its slices."""

    @wraps(method)
    def asked(self: Any, name: Any, *rest: Any, **options: Any) -> Any:
        rows = slices_of(self.model, name)
        if rows is None:
            return method(self, name, *rest, **options)
        return _stacked([method(self, row, *rest, **options) for row in rows], axis)

    return asked


def _stacking_joint(method: Callable[..., Any]) -> Callable[..., Any]:
    """A method that asks about several nodes together, which takes templates' nodes slice by slice."""

    @wraps(method)
    def asked(self: Any, *names: Any) -> Any:
        rows = [slices_of(self.model, name) for name in names]
        steps = {len(row) for row in rows if row is not None}
        if not steps:
            return method(self, *names)
        if len(steps) > 1:
            raise QueryError(
                f"{method.__name__}{names}: these have {sorted(steps)} slices; ask slice by slice"
            )
        every = [
            [name if row is None else row[t] for name, row in zip(names, rows, strict=True)]
            for t in range(steps.pop())
        ]
        return _stacked([method(self, *each) for each in every], 0)

    return asked


def _stacked(parts: list[Any], axis: int) -> Any:
    if isinstance(parts[0], StateArray):
        return StateArray(np.stack([p.codes for p in parts], axis=axis), parts[0].states)
    return np.stack(parts, axis=axis)
