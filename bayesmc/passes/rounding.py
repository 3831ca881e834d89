"""What rounding makes of an expression: the same with matrices that are off in the last place.

Two right ways to factor a matrix that is nearly singular differ by much more than rounding; so do the two
values here, which says how near to each other two results can be asked to be.

References
----------
Higham, Accuracy and Stability of Numerical Algorithms, 2nd ed., sec. 1.5 (backward errors) and 10.1.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bayesmc.expression import Call, Expression, as_expression, ordered
from bayesmc.passes.arithmetic import multiply, rewritten
from bayesmc.passes.reads import matrix_function

_FACTORED = frozenset(("cholesky", "inv", "solve", "det"))


def disturbed(roots: Sequence[Expression]) -> list[Expression]:
    """The same expressions, where what is factored or inverted is off by a rounding error in each element.

    Nothing is changed where there are no matrices.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import TracedArray, evaluate, leaf
    >>> from bayesmc.passes.rounding import disturbed
    >>> root = np.linalg.det(TracedArray(leaf("a", (2, 2)))).expression
    >>> near = {"a": np.array([[[1.0, 1.0], [1.0, 1.0 + 1e-9]]])}
    >>> [f"{evaluate([r], near)[0][0]:.9e}" for r in (root, *disturbed([root]))]  # six digits are known
    ['1.000000083e-09', '9.999996387e-10']
    """
    if not any(isinstance(n, Call) and matrix_function(n) in _FACTORED for n in ordered(*roots)):
        return list(roots)
    rng = np.random.default_rng(0)

    def change(node: Expression, operands: list[Expression]) -> Expression | None:
        if not isinstance(node, Call) or matrix_function(node) not in _FACTORED:
            return None
        first, *others = operands
        off = 1.0 + np.finfo(float).eps * rng.choice([-1.0, 1.0], first.shape)
        return node.with_operands([multiply(first, as_expression(off)), *others])

    return rewritten(roots, change)
