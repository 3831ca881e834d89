"""Log densities as NumPy evaluates them best: products of matrices, and sigmoids of exponentials.

The last pass before a program is made: of what it puts in no derivatives are known.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from scipy import special

from bayesmc.expression import Elementwise, Expression, elementwise, ordered
from bayesmc.passes.contractions import contracted
from bayesmc.passes.guarded import guarded
from bayesmc.passes.scaling import rescaled

#: elements of an entry from which on several functions of NumPy are quicker than one of SciPy
_MANY = 32


def for_arrays(roots: Iterable[Expression]) -> list[Expression]:
    """The same expressions, to be evaluated many times; values may differ by rounding.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy import special
    >>> from bayesmc.expression import elementwise, evaluate, leaf
    >>> from bayesmc.passes.arrays import for_arrays
    >>> root = elementwise(special.log_expit, leaf("x", (100,)))
    >>> made = for_arrays([root])
    >>> made, float(evaluate(made, {"x": np.full(100, -800.0)})[0][0])
    ([<Elementwise log_expit_by_exp (100,)>], -800.0)
    """
    return contracted(rescaled(guarded(_quick(list(roots)))))


def expit_by_exp(x: Any) -> np.ndarray:
    """``scipy.special.expit`` to some units in the last place, four times as fast."""
    found = np.negative(x)
    out: dict[str, Any] = {"out": found} if isinstance(found, np.ndarray) else {}
    found = np.add(np.exp(found, **out), 1.0, **out)
    return np.reciprocal(found, **out)


def log_expit_by_exp(x: Any) -> np.ndarray:
    """``scipy.special.log_expit`` to 1e-16, less than a last digit where it is near 0; twice as fast."""
    found = np.abs(x)
    out: dict[str, Any] = {"out": found} if isinstance(found, np.ndarray) else {}
    found = np.log(np.add(np.exp(np.negative(found, **out), **out), 1.0, **out), **out)
    return np.subtract(np.minimum(x, 0.0), found, **out)


# ---- private ------------------------------------------------------------------------------------

_QUICK = {special.expit: expit_by_exp, special.log_expit: log_expit_by_exp}


def _quick(roots: list[Expression]) -> list[Expression]:
    """Sigmoids of many numbers by exponentials; of numbers and their negatives, once."""
    found: dict[Expression, Expression] = {}
    nodes = ordered(*roots)
    present = set(nodes)
    for node in nodes:
        operands = [found[a] for a in node.operands]
        same = all(a is b for a, b in zip(operands, node.operands, strict=True))
        made = node if same else node.with_operands(operands)
        if isinstance(node, Elementwise) and node.function in _QUICK and node.size >= _MANY:
            made = elementwise(_QUICK[node.function], operands[0])
            twin = _of_negative(node)
            if twin is not None and twin in present and twin in found:
                inner = found[twin.operands[0]]
                if node.function is special.expit:
                    made = elementwise(np.subtract, 1.0, found[twin])
                else:
                    made = elementwise(np.subtract, found[twin], inner)
        found[node] = made
    return [found[r] for r in roots]


def _of_negative(node: Elementwise) -> Expression | None:
    """The same function of what the operand is the negative of."""
    (x,) = node.operands
    if isinstance(x, Elementwise) and x.function is np.negative:
        return elementwise(node.function, x.operands[0])
    return None
