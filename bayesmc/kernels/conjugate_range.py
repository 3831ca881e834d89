"""Parameters of children that may leave their range, where a model is at fault."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bayesmc.expression import (
    Constant,
    Elementwise,
    Expression,
    Gather,
    Leaf,
    Pick,
    Reduction,
    ordered,
    reduction,
)
from bayesmc.kernels.conjugate_children import Child
from bayesmc.network import Model
from bayesmc.structure.target import Values

#: parameters that must be positive
_POSITIVE = frozenset(
    ("scale", "rate", "concentration", "concentration1", "concentration0", "df", "scale_diag")
)


def least_values(child: Child, name: str, model: Model) -> Iterator[Expression]:
    """The least value of each parameter that should be positive and is not known to be.

    Those that depend on the node itself are left out: there its prior's support looks after that.
    """
    for key, value in child.family.parameters.items():
        if key not in _POSITIVE or not isinstance(value, Expression) or not value.leaves:
            continue
        if name not in value.leaves and not _is_positive(value, model):
            yield reduction(np.minimum, value, range(len(value.shape)))


def refuse(child: Child, values: Values) -> None:
    """Raise where a child's parameters are out of range and did not overflow, naming it."""
    for term in child.terms:
        dist, batch = term.distribution(values)
        if dist.invalid is not None:
            term.refuse_out_of_range(dist, batch, values[term.name])


# ---- private ------------------------------------------------------------------------------------

_ALWAYS = (np.exp, np.logaddexp)
_KEEPING = (np.multiply, np.divide, np.add, np.sqrt, np.square, np.power, np.reciprocal, np.maximum)


def _is_positive(root: Expression, model: Model) -> bool:
    """Whether an expression is positive wherever it is a number."""
    found: dict[Expression, bool] = {}
    for node in ordered(root):
        inner = [found[a] for a in node.operands]
        if isinstance(node, Constant):
            found[node] = bool((node.value > 0).all())
        elif isinstance(node, Leaf):
            support = model[node.name].support
            low = getattr(support, "low", None)
            found[node] = low is not None and bool(np.min(low) >= 0)
        elif isinstance(node, Elementwise):
            rest = inner[:1] if node.function is np.power else inner
            kept = node.function in _KEEPING and all(rest)
            found[node] = kept or node.function in _ALWAYS
        elif isinstance(node, Gather):
            found[node] = inner[0]
        else:
            sums = not isinstance(node, Reduction) or node.ufunc is np.add
            found[node] = isinstance(node, (Pick, Reduction)) and sums and all(inner)
    return found[root]
