"""Discrete nets of pyAgrum."""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.errors import UnsupportedError
from bayesmc.io.rows import without_rounding
from bayesmc.network import BayesNet

#: pyAgrum's kinds of variables whose values are numbers, and the type of those
_NUMBERS = {"Range": int, "Integer": int, "NumericalDiscrete": float}
#: kinds whose values are named: by labels, or by the interval they stand for
_NAMED = ("Labelized", "Discretized")


def from_pyagrum(bn: Any) -> BayesNet:
    """A net with the nodes of a pyAgrum ``BayesNet``; pyAgrum itself is not imported.

    Parameters
    ----------
    bn : pyagrum.BayesNet
        Labels become states. Range, integer and numerical variables get their numbers as states.
        A discretised variable gets its intervals as labels, ``"[0;1["``, since its table says which
        interval a value falls into and not where: evidence has to name the interval. Noisy-or and
        other aggregators become the tables that they stand for. Evidence, descriptions and
        properties are not taken over.

    Raises
    ------
    TypeError
        For what is no Bayes net of pyAgrum.
    UnsupportedError
        Influence diagrams, and variables of another kind.
    ParameterError
        A table with a row that is no probability vector (one that nobody filled, say).

    Examples
    --------
    >>> import bayesmc as bmc
    >>> import pyagrum  # doctest: +SKIP
    >>> net = bmc.io.from_pyagrum(pyagrum.fastBN("age{young|old}->ill[0,1]"))  # doctest: +SKIP
    >>> net["age"].states, net["ill"].states  # doctest: +SKIP
    (('young', 'old'), (0, 1))
    """
    if hasattr(bn, "isUtilityNode"):
        raise UnsupportedError(
            "from_pyagrum: influence diagrams have decisions and utilities, which have no counterpart "
            "in a Bayes net; give a pyagrum.BayesNet"
        )
    for method in ("nodes", "variable", "cpt"):
        if not callable(getattr(bn, method, None)):
            raise TypeError(
                f"from_pyagrum: {type(bn).__name__} is no discrete Bayes net (it has no {method}()); "
                "give a pyagrum.BayesNet"
            )
    net = BayesNet()
    for number in sorted(bn.nodes()):  # the order in which they were added
        variable = bn.variable(number)
        cpt = bn.cpt(number)
        name, *parents = cpt.names
        # cpt[:] has the axes of `names` from the last to the first; toarray() would read memory
        # that aggregators do not fill
        probs = np.moveaxis(np.array(cpt[:], dtype=float).T, 0, -1)
        net.table(name, parents, without_rounding(probs), states=_states(name, variable))
    return net


def _states(name: str, variable: Any) -> tuple[Any, ...]:
    kind = variable.stype()
    if kind in _NAMED:
        return tuple(variable.labels())
    if kind in _NUMBERS:
        number = _NUMBERS[kind]
        return tuple(number(variable.numerical(k)) for k in range(variable.domainSize()))
    raise UnsupportedError(
        f"from_pyagrum: {name!r} is a variable of kind {kind!r}; known are "
        f"{', '.join((*_NAMED, *_NUMBERS))}"
    )
