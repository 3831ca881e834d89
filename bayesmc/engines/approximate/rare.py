"""Log probabilities of rare outcomes, where a model's own functions round their complement to 1.

``Bernoulli(ndtr(x))`` leaves ``log(1 - ndtr(x))`` for an outcome of 0, which is minus infinity from x = 8.3
on and rough before. The expression of the same node knows that it is ``log_ndtr(-x)``. It is believed where
both say the same probability to rounding, so that a fault of reading still shows.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayesmc.distributions import Bernoulli
from bayesmc.expression import Family, Program
from bayesmc.passes.logarithms import stable
from bayesmc.structure.target import Term

#: log probabilities below this are looked at, and by how much probabilities may differ
_RARE, _ROUNDING = -12.0, 1e-14


def log_of(term: Term, values: Mapping[str, np.ndarray]) -> np.ndarray:
    """The log factors of a term by the model's own functions, those of rare outcomes to all digits.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from scipy import special
    >>> from bayesmc.engines.approximate.rare import log_of
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet()
    >>> net.add("x", bmc.Normal(0.0, 5.0))
    >>> net.add("y", lambda x: bmc.Bernoulli(special.ndtr(x)))
    >>> target = target_of(pose(net, {"y": 0}))
    >>> log_of(target.terms["y"], {**target.known, "x": np.array([1.0, 20.0])}).round(4).tolist()
    [-1.841, -203.9172]
    """
    with np.errstate(all="ignore"):
        plain = term.log(values)
    if term.is_potential or not (plain < _RARE).any():
        return plain
    family = getattr(term.read, "result", None)
    made = family.make if isinstance(family, Family) else type(family)
    if made is not Bernoulli or term.expression is None:
        return plain
    with np.errstate(all="ignore"):
        (found,) = Program(list(stable([term.expression])))(values)
        if term.mask is not None:
            found = np.where(term.mask, found, 0.0)
        same = np.abs(np.exp(found) - np.exp(plain)) <= _ROUNDING
    return np.where(same & (plain < _RARE) & np.isfinite(found), found, plain)
