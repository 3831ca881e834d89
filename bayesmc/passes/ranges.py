"""Where the parameters of a family are in their range, as an expression: elsewhere there is no density.

A logarithm of a parameter that must be positive is no number where it is not, and says so by itself. What is
listed here are parameters out of whose range a closed form goes on: ``Poisson(-1)`` at 0, ``Gamma(-0.5, 1)``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from scipy import special

from bayesmc import distributions as d
from bayesmc.distributions.categorical import TOLERANCE
from bayesmc.expression import (
    Constant,
    Elementwise,
    Expression,
    Family,
    Gather,
    Pick,
    as_expression,
    elementwise,
    pick,
    reduction,
)
from bayesmc.passes.arithmetic import is_all
from bayesmc.passes.logarithms import log_of

TRUE = as_expression(True)


def in_range(density: Any) -> Expression:
    """Whether parameters are in their range, for each element of the batch; ``TRUE`` where that is seen.

    Parameters
    ----------
    density : Family, Distribution, or parts of a mixture

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.expression import TracedArray, evaluate, leaf, trace
    >>> from bayesmc.passes.ranges import TRUE, in_range
    >>> rate = TracedArray(leaf("rate", ()))
    >>> evaluate([in_range(trace(bmc.Poisson, [rate]))], {"rate": np.array([-1.0, 1.0])})
    [array([False,  True])]
    >>> in_range(trace(lambda rate: bmc.Poisson(np.exp(rate)), [rate])) is TRUE
    True
    """
    if isinstance(density, (list, tuple)):
        return _all([in_range(part) for part in density])
    if not isinstance(density, Family):
        return TRUE
    found = [
        rule(density.parameters[name])
        for name, rule in _RANGES.get(density.make, {}).items()
        if isinstance(density.parameters.get(name), Expression)
    ]
    for part in density.parameters.values():
        inner = in_range(part) if isinstance(part, (Family, list, tuple)) else TRUE
        if inner is not TRUE and density.make is d.Mixture:  # components are the last axis
            inner = reduction(np.logical_and, inner, [len(inner.shape) - 1])
        found.append(inner)
    return _all(found)


# ---- private ------------------------------------------------------------------------------------


def _all(conditions: list[Expression]) -> Expression:
    found = TRUE
    for condition in conditions:
        if not is_all(condition, True):
            found = condition if found is TRUE else elementwise(np.logical_and, found, condition)
    return found


def _positive(x: Expression) -> Expression:
    return TRUE if _seen_positive(x) else elementwise(np.greater, x, 0.0)


def _nonnegative(x: Expression) -> Expression:
    return TRUE if _seen_positive(x) else elementwise(np.greater_equal, x, 0.0)


def _seen_positive(x: Expression) -> bool:
    return not isinstance(x, Constant) and log_of(x) is not None


def _unit(p: Expression) -> Expression:
    if _seen_unit(p):
        return TRUE
    inside = elementwise(np.greater_equal, p, 0.0), elementwise(np.less_equal, p, 1.0)
    return elementwise(np.logical_and, *inside)


def _seen_unit(p: Expression) -> bool:
    if isinstance(p, Constant):
        return bool(((p.value >= 0) & (p.value <= 1)).all())
    if isinstance(p, (Pick, Gather)):
        return all(map(_seen_unit, p.operands[:1] if isinstance(p, Gather) else p.operands))
    if not isinstance(p, Elementwise):
        return False
    if p.function in (special.expit, special.ndtr):
        return True
    if p.function is np.where:
        return all(map(_seen_unit, p.operands[1:]))
    if p.function is np.subtract:
        return is_all(p.operands[0], 1.0) and _seen_unit(p.operands[1])
    return p.function is np.multiply and all(map(_seen_unit, p.operands))


def _simplex(p: Expression) -> Expression:
    last = [len(p.shape) - 1]
    sums = reduction(np.add, p, last)
    near = elementwise(np.absolute, elementwise(np.subtract, sums, 1.0))
    found = elementwise(np.less_equal, near, TOLERANCE)
    least = _nonnegative(p)
    if least is TRUE:
        return found
    return elementwise(np.logical_and, found, reduction(np.logical_and, least, last))


def _positive_vector(x: Expression) -> Expression:
    each = _positive(x)
    return each if each is TRUE else reduction(np.logical_and, each, [len(x.shape) - 1])


def _increasing(x: Expression) -> Expression:
    """Vectors whose components are in order."""
    last, size = len(x.shape) - 1, x.shape[-1]
    if size == 1:
        return TRUE
    at = np.arange(x.size).reshape(x.shape)
    pair = elementwise(np.greater_equal, pick([x], at[..., 1:]), pick([x], at[..., :-1]))
    return reduction(np.logical_and, pair, [last])


def _whole(n: Expression) -> Expression:
    if n.dtype.kind == "i" and not isinstance(n, Constant):
        return elementwise(np.greater_equal, n, 0)
    whole = elementwise(np.equal, n, elementwise(np.floor, n))
    return elementwise(np.logical_and, whole, elementwise(np.greater_equal, n, 0))


#: family -> parameter -> where it is in its range; those that a logarithm keeps are left out
_RANGES: Mapping[Any, Mapping[str, Callable[[Expression], Expression]]] = {
    d.Beta: {"concentration1": _positive, "concentration0": _positive},
    d.Gamma: {"concentration": _positive},
    d.InverseGamma: {"concentration": _positive},
    d.Dirichlet: {"concentration": _positive_vector},
    d.LKJ: {"concentration": _positive},
    d.VonMises: {"concentration": _nonnegative},
    d.Poisson: {"rate": _nonnegative},
    d.Bernoulli: {"probs": _unit},
    d.Binomial: {"probs": _unit, "total_count": _whole},
    d.BetaBinomial: {
        "total_count": _whole,
        "concentration1": _positive,
        "concentration0": _positive,
    },
    d.OrderedLogistic: {"cutpoints": _increasing},
    d.Geometric: {"probs": _unit},
    d.NegativeBinomial: {"probs": _unit, "total_count": _positive},
    d.Categorical: {"probs": _simplex},
    d.Multinomial: {"probs": _simplex, "total_count": _whole},
    d.Mixture: {"weights": _simplex},
}
