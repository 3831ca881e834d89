"""The full conditional of one node as a program of its expressions, for those who ask for it at many values.

What does not depend on the node is computed once for a state and not at every value that is tried. Before it
is used the program is held against the model's own functions; where it cannot be made, or gives anything but
numbers, these are asked.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BayesmcError, TraceError, UnsupportedError
from bayesmc.expression import Constant, Expression, Leaf, Program, leaf, ordered, pick, reduction
from bayesmc.expression.graph import replaced
from bayesmc.passes.alike import sums_of
from bayesmc.passes.arithmetic import add
from bayesmc.passes.arrays import for_arrays
from bayesmc.structure.blanket import Blanket, Child
from bayesmc.structure.free_terms import elements
from bayesmc.structure.target import Term, Values

#: terms up to which it pays: more are evaluated together where they are alike
_TERMS = 64
#: how far it may be off at the probe points, relative to itself and to the largest part
_RTOL = 1e-9


class Conditional:
    """The log full conditional of all elements of a node that move together.

    Parameters
    ----------
    blanket : Blanket

    Raises
    ------
    UnsupportedError
        A term cannot be followed, elements do not stand as the node's do, or the program differs from the
        model's functions at reachable values.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.blanket import Blanket
    >>> from bayesmc.structure.conditional import Conditional
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet(plates={"point": 3})
    >>> net.add("rate", bmc.LogNormal(0.0, 1.0))
    >>> net.add("y", lambda rate: bmc.Poisson(rate), plates="point")
    >>> target = target_of(pose(net, {"y": [1, 2, 3]}))
    >>> blanket = Blanket(target, "rate")
    >>> values = {**target.known, "rate": np.array([1.0])}
    >>> at = Conditional(blanket).given(values)
    >>> np.allclose(at(np.array([[1.0], [2.0]])), blanket.log_density(values, np.array([[1.0], [2.0]])))
    True
    """

    def __init__(self, blanket: Blanket) -> None:
        self.blanket, self.name = blanket, blanket.name
        root = _root(blanket)
        parts = _standing(root, self.name)
        self._parts = [part.name for part in parts.values()]
        self._standing = Program(for_arrays(parts))
        self._moving = Program(for_arrays([replaced(root, dict(parts))]))
        target = blanket.target
        read = {p for t in _terms(blanket) for p in target.model.above(t.scope, lambda _: True)}
        self._known = [(n, target.known[n]) for n in sorted(read) if n in target.known]
        self._hold()

    def given(self, values: Mapping[str, np.ndarray]) -> At | None:
        """The conditional in a state; None where somebody has put other data there than those it knows."""
        if any(values[name] is not array for name, array in self._known):
            return None
        found = dict(values)
        found.update(zip(self._parts, self._standing(values), strict=True))
        return At(self._moving, found, self.name)

    # ---- private -------------------------------------------------------------------------------

    def _hold(self) -> None:
        """Refuse what differs from the model's functions at reachable values of all nodes."""
        target = self.blanket.target
        if target.states is None:
            raise UnsupportedError("no reachable values are known to try it on")
        states: Values = {**target.states, **target.known}
        own = states[self.name]
        candidates = np.stack([np.roll(own, k, axis=0) for k in range(3)])
        at = self.given(states)
        assert at is not None
        seen = False
        with marking_invalid(), np.errstate(all="ignore"):
            found = at(candidates)
            for k, candidate in enumerate(candidates):
                try:
                    wanted = self.blanket.log_density(states, candidate)
                except BayesmcError:
                    continue
                wanted = np.broadcast_to(
                    wanted, own.shape[: own.ndim - len(self.blanket.event_shape)]
                )
                given = np.broadcast_to(found, (3, *wanted.shape))[k]
                finite = np.isfinite(given)
                scale = 1.0 + np.abs(given[finite]).max(initial=0.0)
                if not (np.abs(given - wanted)[finite] <= _RTOL * scale).all():
                    raise UnsupportedError(
                        "it differs from the model's functions at reachable values"
                    )
                seen |= bool(finite.any())
        if not seen:
            raise UnsupportedError("it is zero at all reachable values")


class At:
    """A full conditional in a state: log densities at candidates, shape ``(*lead, *plates)``."""

    def __init__(self, program: Program, values: Values, name: str) -> None:
        self._program, self._values, self._name = program, values, name

    def __call__(self, candidate: np.ndarray) -> np.ndarray:
        self._values[self._name] = candidate
        (found,) = self._program(self._values)
        return found


def conditional_of(blanket: Blanket) -> Conditional | None:
    """The full conditional as a program, where it can be had."""
    try:
        with np.errstate(all="ignore"):
            return Conditional(blanket)
    except (BayesmcError, TraceError):
        return None


# ---- private ------------------------------------------------------------------------------------


def _terms(blanket: Blanket) -> list[Term]:
    own = [] if blanket.own is None else [blanket.own]
    return own + [child.term for child in blanket.children]


def _root(blanket: Blanket) -> Expression:
    """The sum of all terms, shape the node's plates."""
    target, node = blanket.target, blanket.node
    terms = _terms(blanket)
    if len(blanket.classes) > 1 or blanket.classes[0] is not None or len(terms) > _TERMS:
        raise UnsupportedError("its elements move in turn, or there are many terms")
    if any(type(t) is not Term or (t.mask is not None and t.mask.shape != t.shape) for t in terms):
        raise UnsupportedError("a term stands for several")
    logs = [elements(target, term, {}) for term in terms]
    if not node.plates:
        sums = sums_of(logs)
    else:
        children: Sequence[Child | None] = [None] * (len(terms) - len(blanket.children))
        sums = [
            _by_element(blanket, term, child, log)
            for term, child, log in zip(terms, [*children, *blanket.children], logs, strict=True)
        ]
    total = sums[0]
    for other in sums[1:]:
        total = add(total, other)
    return total


def _by_element(blanket: Blanket, term: Term, child: Child | None, log: Expression) -> Expression:
    """A term's log factors, summed for every element of the node."""
    if term.mask is not None:
        raise UnsupportedError("some elements of a term do not count")
    if child is None:
        return pick([log], np.arange(log.size).reshape(term.shape))
    kept = [p for p in term.plates if p in blanket.node.plates]
    if child.relation.kind != "aligned" or kept != list(blanket.node.plates):
        raise UnsupportedError("elements of a term do not stand as the node's do")
    full = pick([log], np.arange(log.size).reshape(term.shape))
    return reduction(
        np.add, full, [k for k, p in enumerate(term.plates) if p not in blanket.node.plates]
    )


def _standing(root: Expression, name: str) -> dict[Expression, Leaf]:
    """The largest parts that do not depend on a node, and the leaves that stand for them."""
    found: dict[Expression, Leaf] = {}
    for node in ordered(root):
        if name not in node.leaves:
            continue
        for part in node.operands:
            if name in part.leaves or isinstance(part, (Constant, Leaf)) or part.dtype != float:
                continue
            if part.leaves and part not in found:
                found[part] = leaf(f"\0part {len(found)}", part.shape)
    return found
