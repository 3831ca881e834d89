"""How much of a discrete net's graph is left once its easy variables are gone.

A search for an elimination order on a large graph can cost far more than it finds out; the core tells
beforehand whether there is much to search.
"""

from __future__ import annotations

from collections.abc import Mapping

from bayesmc.network import Model, Observed
from bayesmc.structure.discrete import Variable, discrete_scopes


def core_size(model: Model, observed: Mapping[str, Observed]) -> int:
    """Variables left when those with at most two neighbours have been eliminated, one after the other.

    Eliminating such a variable never makes the best order worse, so a chain or a tree has no core. The
    number of scopes is all that it takes: no order is searched for and no table made.
    """
    neighbours: dict[Variable, set[Variable]] = {}
    for scope in discrete_scopes(model, observed):
        for variable in scope:
            neighbours.setdefault(variable, set()).update(scope)
    for variable, others in neighbours.items():
        others.discard(variable)
    todo = [v for v, others in neighbours.items() if len(others) <= 2]
    while todo:
        variable = todo.pop()
        if variable not in neighbours or len(neighbours[variable]) > 2:
            continue
        others = neighbours.pop(variable)
        for other in others:
            neighbours[other] |= others - {other}
            neighbours[other].discard(variable)
            if len(neighbours[other]) <= 2:
                todo.append(other)
    return len(neighbours)
