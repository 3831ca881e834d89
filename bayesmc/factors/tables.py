"""Turning a list of factor tables into one potential per clique, linear or logarithmic.

It knows where each factor goes and on which axes; it passes no messages.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import DensityError, ShapeError


@dataclass(frozen=True, eq=False)
class LogTable:
    """A factor given by its natural logarithms; ``-inf`` is a zero entry.

    Examples
    --------
    >>> LogTable(np.array([-1000.0, -2000.0])).values.shape
    (2,)
    """

    values: np.ndarray


FactorLike = np.ndarray | LogTable | tuple[np.ndarray, float]
"""A table of linear values, of logarithms, or a pair (linear values, log of a multiplier)."""


def factor_from_log(log_values: np.ndarray) -> tuple[np.ndarray, float]:
    """Linear values with their largest at 1, and the log of what was divided out.

    Entries below e**-745 of the largest become zero; pass a `LogTable` where that could matter.

    Examples
    --------
    >>> values, log_scale = factor_from_log(np.array([-1000.0, -1000.0 + np.log(0.5)]))
    >>> values.round(9), log_scale
    (array([1. , 0.5]), -1000.0)
    """
    top = float(np.max(log_values, initial=-math.inf))
    if top == -math.inf:
        return np.zeros(np.shape(log_values)), 0.0
    return np.exp(log_values - top), top


@dataclass(frozen=True, slots=True)
class Placement:
    """Where a factor goes: its clique, and the transposition and shape that align its axes."""

    clique: int
    axes: tuple[int, ...]
    shape: tuple[int, ...]
    own_shape: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Given:
    """One checked factor: linear values (None where only logarithms are safe) and their scale."""

    linear: np.ndarray | None
    logs: np.ndarray | None
    log_scale: float

    def as_log(self) -> np.ndarray:
        if self.logs is not None:
            return self.logs
        assert self.linear is not None
        with np.errstate(divide="ignore"):
            return np.log(self.linear)


def check_factor(factor: FactorLike, placement: Placement, index: int) -> Given:
    """The factor as arrays of float64, refused if its shape or an entry is not a factor's."""
    if isinstance(factor, LogTable):
        logs = np.asarray(factor.values, dtype=float)
        _check_shape(logs, placement, index)
        if np.isnan(logs).any() or (logs == math.inf).any():
            raise DensityError(
                f"CliqueTree.bind: log-factor {index} has a NaN or plus infinity; give finite "
                "values or minus infinity"
            )
        linear, log_scale = factor_from_log(logs)
        shifted = logs - log_scale
        finite = shifted[shifted > -math.inf]
        safe = finite.size == 0 or finite.min() > -600.0
        return Given(linear if safe else None, shifted, log_scale)
    values, log_scale = factor if isinstance(factor, tuple) else (factor, 0.0)
    linear = np.asarray(values, dtype=float)
    _check_shape(linear, placement, index)
    if not (linear.min(initial=0.0) >= 0.0 and linear.max(initial=0.0) < math.inf):
        raise DensityError(
            f"CliqueTree.bind: factor {index} has a negative, infinite or NaN entry; give finite "
            "values of at least 0"
        )
    return Given(linear, None, float(log_scale))


def multiply_linear(
    shapes: Sequence[tuple[int, ...]], placements: Sequence[Placement], givens: Sequence[Given]
) -> tuple[list[np.ndarray], float] | None:
    """The potentials, each with its largest entry near 1; None if one would underflow."""
    if any(given.linear is None for given in givens):
        return None
    log_scale = math.fsum(given.log_scale for given in givens)
    tables: list[np.ndarray | None] = [None] * len(shapes)
    try:
        with np.errstate(under="raise", over="raise"):
            for given, where in zip(givens, placements, strict=True):
                linear = given.linear
                assert linear is not None
                if where.clique < 0:
                    if linear == 0.0:
                        return [np.zeros(shape) for shape in shapes], -math.inf
                    log_scale += math.log(float(linear))
                    continue
                aligned = linear.transpose(where.axes).reshape(where.shape)
                table = tables[where.clique]
                table = aligned if table is None else table * aligned
                top = float(table.max())
                if 0.0 < top and not 1e-100 < top < 1e100:
                    table, log_scale = table / top, log_scale + math.log(top)
                tables[where.clique] = table
    except FloatingPointError:
        return None
    return [_filled(table, shape, 1.0) for table, shape in zip(tables, shapes, strict=True)], (
        log_scale
    )


def add_logs(
    shapes: Sequence[tuple[int, ...]], placements: Sequence[Placement], givens: Sequence[Given]
) -> tuple[list[np.ndarray], float]:
    """The logs of the potentials, and the log of the multiplier they lack."""
    log_scale = math.fsum(given.log_scale for given in givens)
    tables: list[np.ndarray | None] = [None] * len(shapes)
    for given, where in zip(givens, placements, strict=True):
        if where.clique < 0:
            log_scale += float(given.as_log())
            continue
        aligned = given.as_log().transpose(where.axes).reshape(where.shape)
        table = tables[where.clique]
        tables[where.clique] = aligned if table is None else table + aligned
    return [_filled(table, shape, 0.0) for table, shape in zip(tables, shapes, strict=True)], (
        log_scale
    )


def _filled(table: np.ndarray | None, shape: tuple[int, ...], neutral: float) -> np.ndarray:
    """A C-ordered private array of the full shape."""
    if table is None:
        return np.full(shape, neutral)
    return np.array(np.broadcast_to(table, shape), dtype=float, order="C")


def _check_shape(values: np.ndarray, placement: Placement, index: int) -> None:
    if values.shape != placement.own_shape:
        raise ShapeError(
            f"CliqueTree.bind: factor {index} has shape {values.shape}, but its scope has the "
            f"cardinalities {placement.own_shape}"
        )
