"""Which NumPy operations keep a value affine: tables of ufuncs and functions, and how they are read."""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.tracing.standin import StandIn, is_traced, leaves, stand_ins

#: ufuncs that are affine in all arguments together
_ADDITIVE = frozenset((np.add, np.subtract, np.negative, np.positive))
#: ufuncs that are affine in each argument while the other is constant
_BILINEAR = frozenset((np.multiply, np.matmul, np.matvec, np.vecmat, np.vecdot))
#: functions that are linear in their first argument (an array, or a sequence of arrays)
_LINEAR_FUNCTIONS = frozenset(
    (
        np.sum, np.mean, np.average, np.cumsum, np.diff, np.trace, np.diagonal,
        np.stack, np.concatenate, np.vstack, np.hstack, np.dstack, np.column_stack, np.broadcast_to,
        np.copy, np.reshape, np.ravel, np.transpose, np.matrix_transpose, np.squeeze, np.expand_dims,
        np.moveaxis, np.swapaxes, np.rollaxis, np.repeat, np.tile, np.take, np.take_along_axis,
        np.flip, np.flipud, np.fliplr, np.rot90, np.roll, np.atleast_1d, np.atleast_2d, np.atleast_3d,
        np.triu, np.tril, np.diag, np.array_split, np.split, np.real,
        np.linalg.trace, np.linalg.diagonal, np.linalg.matrix_transpose,
    )
)  # fmt: skip
_BILINEAR_FUNCTIONS = frozenset(
    (
        np.dot, np.inner, np.outer, np.tensordot, np.kron, np.convolve,
        np.linalg.matmul, np.linalg.vecdot, np.linalg.outer, np.linalg.tensordot,
    )
)  # fmt: skip


def ufunc_keeps_affine(ufunc: Any, method: str, inputs: Any, kwargs: Any) -> bool:
    """Whether a ufunc of affine values is affine in them jointly."""
    if set(kwargs) - {"axis", "axes", "keepdims", "dtype", "initial"} or _narrows(kwargs):
        return False
    if method in ("reduce", "accumulate", "reduceat"):
        return ufunc is np.add and not is_traced(inputs[1:])
    if method not in ("__call__", "outer"):
        return False
    if ufunc in _ADDITIVE:
        return method == "__call__"
    traced = [is_traced(x) for x in inputs]
    if ufunc in _BILINEAR:
        return sum(traced) == 1
    return ufunc is np.true_divide and traced == [True, False]


def function_keeps_affine(func: Any, args: Any, kwargs: Any) -> bool:
    """Whether a NumPy function of affine values is affine in them jointly."""
    if stand_ins(list(kwargs.values())) or _narrows(kwargs):
        return False
    if any(isinstance(x, (type, np.dtype)) for x in args):
        return False  # a type by place
    if func is np.where:
        return len(args) == 3 and not is_traced(args[0])
    if func is np.choose:
        return len(args) == 2 and not is_traced(args[0])
    if func is np.select:
        return len(args) > 1 and not is_traced(args[0])
    if func is np.broadcast_arrays:
        return True
    if func is np.einsum:
        return sum(map(is_traced, args)) == 1
    if func in _BILINEAR_FUNCTIONS:
        return len(stand_ins(list(args[:2]))) == 1
    rest = [x for x in leaves(list(args[1:])) if isinstance(x, StandIn)]
    return func in _LINEAR_FUNCTIONS and not rest


def _narrows(kwargs: Any) -> bool:
    """Whether ``dtype=`` asks for numbers that round."""
    dtype = kwargs.get("dtype")
    return dtype is not None and np.dtype(dtype) != np.float64
