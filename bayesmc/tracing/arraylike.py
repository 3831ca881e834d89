"""What stand-ins have of arrays: attributes, methods that are NumPy functions, what they refuse to show."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from bayesmc.tracing.standin import StandIn

#: functions of an array's shape alone
SHAPE_FUNCTIONS = frozenset((np.shape, np.ndim, np.size, np.zeros_like, np.ones_like))


class ArrayLike(NDArrayOperatorsMixin, StandIn):
    """Base of the stand-ins that are handed to functions; NumPy comes in by ``__array_function__``."""

    __slots__ = ()

    # ---- what an array tells of itself --------------------------------------------------------

    @property
    def size(self) -> int:
        return self._value.size

    @property
    def dtype(self) -> np.dtype:
        return self._value.dtype

    @property
    def flags(self) -> SimpleNamespace:
        return SimpleNamespace(writeable=False)

    @property
    def T(self) -> Any:  # noqa: N802
        return np.transpose(self)

    @property
    def mT(self) -> Any:  # noqa: N802
        return np.matrix_transpose(self)

    # ---- methods of arrays -------------------------------------------------------------------

    def transpose(self, *axes: Any) -> Any:
        order = axes[0] if len(axes) == 1 and not isinstance(axes[0], int) else axes or None
        return np.transpose(self, order)

    def reshape(self, *shape: Any) -> Any:
        wanted = shape[0] if len(shape) == 1 and not isinstance(shape[0], int) else shape
        return np.reshape(self, wanted)

    def sum(self, *args: Any, **kwargs: Any) -> Any:
        return np.sum(self, *args, **kwargs)

    def mean(self, *args: Any, **kwargs: Any) -> Any:
        return np.mean(self, *args, **kwargs)

    def cumsum(self, *args: Any, **kwargs: Any) -> Any:
        return np.cumsum(self, *args, **kwargs)

    def dot(self, other: Any) -> Any:
        return np.dot(self, other)

    def take(self, indices: Any, axis: int | None = None) -> Any:
        return np.take(self, indices, axis=axis)

    def squeeze(self, axis: Any = None) -> Any:
        return np.squeeze(self, axis=axis)

    def swapaxes(self, first: int, second: int) -> Any:
        return np.swapaxes(self, first, second)

    def ravel(self) -> Any:
        return self.reshape(-1)

    flatten = ravel

    # ---- what would show the numbers -----------------------------------------------------------

    def _refuse(self, what: str) -> Exception:
        """The error for a function that looks at the numbers."""
        raise NotImplementedError

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        raise self._refuse("a plain array")

    def __bool__(self) -> bool:
        raise self._refuse("the truth")

    def __float__(self) -> float:
        raise self._refuse("float()")

    def __int__(self) -> int:
        raise self._refuse("int()")

    def __complex__(self) -> complex:
        raise self._refuse("complex()")

    def __index__(self) -> int:
        raise self._refuse("an index")

    def __iter__(self) -> Any:
        raise self._refuse("iteration")

    def __contains__(self, item: Any) -> bool:
        raise self._refuse("membership")

    def __hash__(self) -> int:
        raise self._refuse("the hash")
