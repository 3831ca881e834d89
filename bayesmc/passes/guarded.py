"""Linear algebra that answers for every matrix: NaN where there is no factor or inverse, instead of an error.

One chain whose covariance is singular, far out, would else stop all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bayesmc.expression import Call, Expression, call
from bayesmc.expression.functions import Repeated
from bayesmc.passes.arithmetic import rewritten


def guarded(roots: Iterable[Expression]) -> list[Expression]:
    """The same expressions, with factors and inverses that are NaN where there are none.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import TracedArray, evaluate, leaf
    >>> from bayesmc.passes.guarded import guarded
    >>> root = np.linalg.cholesky(TracedArray(leaf("a", (1, 1)))).expression
    >>> evaluate(guarded([root]), {"a": np.array([[[4.0]], [[-1.0]]])})[0].ravel()
    array([ 2., nan])
    """

    def change(node: Expression, operands: list[Expression]) -> Expression | None:
        if isinstance(node, Call) and isinstance(node.call, Repeated):
            return call(_guarded(node.call), operands, node.shape, node.dtype)
        return None

    return rewritten(list(roots), change)


# ---- private ------------------------------------------------------------------------------------

_RAISING = (np.linalg.cholesky, np.linalg.inv, np.linalg.solve)


@dataclass(frozen=True)
class _OrNan:
    """A function of matrices, NaN where it raises."""

    function: Callable[..., Any]

    @property
    def __name__(self) -> str:  # noqa: A003
        return getattr(self.function, "__name__", "")

    def __call__(self, *arrays: np.ndarray) -> np.ndarray:
        try:
            return self.function(*arrays)
        except np.linalg.LinAlgError:
            pass
        batch = np.broadcast_shapes(*(a.shape[:-2] for a in arrays))
        wide = [np.broadcast_to(a, (*batch, *a.shape[-2:])) for a in arrays]
        found = np.full((*batch, *arrays[-1].shape[-2:]), np.nan)
        for entry in np.ndindex(*batch):
            try:
                found[entry] = self.function(*(w[entry] for w in wide))
            except np.linalg.LinAlgError:
                continue
        return found


def _guarded(repeated: Repeated) -> Repeated:
    if repeated.function not in _RAISING or repeated.kwargs or repeated.output is not None:
        return repeated
    made = _OrNan(repeated.function)
    assert isinstance(repeated.key, tuple)
    return replace(repeated, function=made, key=(made, *repeated.key[1:]))
