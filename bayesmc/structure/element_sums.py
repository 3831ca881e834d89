"""Log factors of a term summed for every element of a node, as an expression: what ``Relation.collect`` does.

Elements of one class do not meet in a factor, so that the sums of a class are right whatever the others are;
those of all elements are made at once.
"""

from __future__ import annotations

import math
from functools import reduce

import numpy as np

from bayesmc.errors import TraceError, UnsupportedError
from bayesmc.expression import Expression, pick, reduction, reshape
from bayesmc.passes.adjoints import gathered, scattered
from bayesmc.passes.arithmetic import ZERO
from bayesmc.shapes import Shape
from bayesmc.structure.blanket import Blanket, Child
from bayesmc.structure.relation import Relation
from bayesmc.structure.target import Term


def own_elements(term: Term, log: Expression) -> Expression:
    """The log factors of a node's own term, shape its plates.

    Parameters
    ----------
    log : Expression
        Those that count, one after the other (``free_terms.elements``).
    """
    return reshape(_whole(term, log), term.shape)


def sums_by_element(blanket: Blanket, child: Child, log: Expression) -> Expression:
    """A term's log factors, summed for every element of the node, shape its plates.

    Parameters
    ----------
    blanket : Blanket
        Of a node in plates.
    child : Child
    log : Expression
        The log factors that count, one after the other.

    Raises
    ------
    UnsupportedError
        Which elements belong together cannot be told from the expression.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.expression import evaluate, leaf
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.blanket import Blanket
    >>> from bayesmc.structure.element_sums import sums_by_element
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet(plates={"group": 2, "point": 3})
    >>> net.add("mean", bmc.Normal(0.0, 1.0), plates="group")
    >>> net.add("y", lambda mean: bmc.Normal(mean[np.array([0, 1, 1])], 1.0), plates="point")
    >>> blanket = Blanket(target_of(pose(net, {"y": [0.0, 1.0, 2.0]})), "mean")
    >>> sums = sums_by_element(blanket, blanket.children[0], leaf("log", (3,)))
    >>> evaluate([sums], {"log": np.array([1.0, 10.0, 100.0])})[0]
    array([  1., 110.])
    """
    term, relation = child.term, child.relation
    whole = _whole(term, log)
    if relation.kind == "aligned":
        return _aligned(term, relation, whole)
    if relation.kind == "whole":
        return _coupled(term, relation, whole)
    if relation.kind == "rows":
        return _in_rows(relation, whole)
    if relation.place is None or set(relation.place.leaves) & {blanket.name, *blanket.path}:
        raise UnsupportedError(f"what {term.name!r} looks up depends on where it looks")
    return reshape(
        gathered(whole, reshape(relation.place, whole.shape), (relation.size,)), relation.shape
    )


# ---- private ------------------------------------------------------------------------------------


def _whole(term: Term, log: Expression) -> Expression:
    """All log factors, one after the other: zero where they do not count."""
    if term.mask is None:
        return log
    counts = np.broadcast_to(term.mask, term.shape).reshape(-1)
    places = np.where(counts, np.cumsum(counts) - 1, log.size)
    return pick([log, reshape(ZERO, (1,))], places)


def _summed(whole: Expression, term_shape: Shape, first: list[int]) -> Expression:
    """Sums over all axes of a term but some, these in their order."""
    others = [k for k in range(len(term_shape)) if k not in first]
    places = np.arange(whole.size).reshape(term_shape).transpose(*first, *others)
    ends = range(len(first), len(term_shape))
    return reduction(np.add, pick([whole], places), list(ends))


def _aligned(term: Term, relation: Relation, whole: Expression) -> Expression:
    kept = [term.plates.index(p) for p in relation.plates]
    return _summed(whole, term.shape, kept)


def _coupled(term: Term, relation: Relation, whole: Expression) -> Expression:
    """Every element reads what all of its set do."""
    plates = [p for p in relation.plates if p not in relation.coupled]
    if len(term.plates) != len(term.shape):  # rows of an index have a plate of their own
        plates = []
    sums = _summed(whole, term.shape, [term.plates.index(p) for p in plates])
    wide = tuple(
        n if p in plates else 1 for p, n in zip(relation.plates, relation.shape, strict=True)
    )
    # they stand in the node's order already
    places = np.broadcast_to(np.arange(math.prod(wide)).reshape(wide), relation.shape)
    return pick([sums], places)


def _in_rows(relation: Relation, whole: Expression) -> Expression:
    """Each log factor goes to all elements that it reads, once."""
    entries, elements = [], []
    roles = [np.ravel(role) for role in relation.rows]
    for k, role in enumerate(roles):
        fresh = reduce(
            np.logical_and, (role != other for other in roles[:k]), np.full(role.shape, True)
        )
        entries.append(np.flatnonzero(fresh))
        elements.append(role[fresh])
    if entries[0].size != whole.size:
        raise TraceError("its rows are not one for each log factor")
    part = pick([whole], np.concatenate(entries))
    return scattered(part, np.concatenate(elements), relation.shape)
