"""The full conditional of one node as a program of its expressions, for those who ask for it at many values.

What does not depend on the node is computed once for a state and not at every value that is tried. Before it
is used the program is held against the model's own functions; where it cannot be made, or gives anything but
numbers, these are asked.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BayesmcError, TraceError, UnsupportedError
from bayesmc.expression import Constant, Expression, Leaf, Program, broadcast, leaf, ordered
from bayesmc.expression.graph import replaced
from bayesmc.network.expressions import stored_leaf
from bayesmc.passes.alike import sums_of
from bayesmc.passes.arithmetic import add
from bayesmc.passes.arrays import for_arrays
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.element_sums import own_elements, sums_by_element
from bayesmc.structure.free_terms import elements_of
from bayesmc.structure.target import Term, Values

#: terms up to which it pays: more are evaluated together where they are alike
_TERMS = 64
#: how far it may be off at the probe points, relative to itself and to the largest part
_RTOL = 1e-9
#: classes of elements whose sums are held against the functions; the others' are added up alike
_CLASSES = 4


class Conditional:
    """The log full conditional of all elements of a node.

    Of elements that move in turn those of one class are right: others may count what they share twice.

    Parameters
    ----------
    blanket : Blanket
    reads_data : bool
        Whether what is known is read from the state, too: for like nodes as one, whose data differ.

    Attributes
    ----------
    root : Expression
        What it is of stored values, shape the node's plates.

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

    def __init__(self, blanket: Blanket, reads_data: bool = False) -> None:
        self.blanket, self.name = blanket, blanket.name
        self.terms = _terms(blanket)
        model, known = blanket.target.model, blanket.target.known
        read = {n for t in self.terms for n in t.scope} & known.keys() if reads_data else set()
        above = {n: stored_leaf(model, model[n]) for n in read}
        logs = [log.anywhere for log in elements_of(blanket.target, self.terms, above)]
        #: log full conditionals of all elements, shape the node's plates
        self.root = _sum(blanket, self.terms, logs)
        parts = standing(self.root, self.name)
        self._parts = [part.name for part in parts.values()]
        self._standing = Program(for_arrays(parts))
        self._moving = Program(for_arrays([replaced(self.root, dict(parts))]))
        put_in = {p for t in self.terms for p in model.above(t.scope, lambda _: True)}
        self._known = [] if reads_data else [(n, known[n]) for n in sorted(put_in & known.keys())]
        _hold(blanket, self.terms, logs, self.root)

    def given(self, values: Mapping[str, np.ndarray]) -> At | None:
        """The conditional in a state; None where somebody has put other data there than those it knows."""
        if not self.knows(values):
            return None
        found = dict(values)
        found.update(zip(self._parts, self._standing(values), strict=True))
        return At(self._moving, found, self.name)

    def knows(self, values: Mapping[str, np.ndarray]) -> bool:
        """Whether a state has the data that it knows."""
        return all(values[name] is array for name, array in self._known)


class At:
    """A full conditional in a state: log densities at candidates, shape ``(*lead, *plates)``."""

    def __init__(self, program: Program, values: Values, name: str) -> None:
        self._program, self._values, self._name = program, values, name

    def __call__(self, candidate: np.ndarray) -> np.ndarray:
        self._values[self._name] = candidate
        (found,) = self._program(self._values)
        return found


def conditional_or_reason(blanket: Blanket, reads_data: bool = False) -> Conditional | str:
    """The full conditional as a program, or why there is none."""
    try:
        with np.errstate(all="ignore"):
            return Conditional(blanket, reads_data)
    except (BayesmcError, TraceError) as error:
        return str(error)


def conditional_of(blanket: Blanket) -> Conditional | None:
    """The full conditional as a program, where it can be had."""
    found = conditional_or_reason(blanket)
    return None if isinstance(found, str) else found


def standing(root: Expression, name: str) -> dict[Expression, Leaf]:
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


# ---- private ------------------------------------------------------------------------------------


def _terms(blanket: Blanket) -> list[Term]:
    """The node's own term and those that it enters.

    Raises
    ------
    UnsupportedError
        There are many, or one stands for several.
    """
    own = [] if blanket.own is None else [blanket.own]
    terms = own + [child.term for child in blanket.children]
    if len(terms) > _TERMS:
        raise UnsupportedError(f"it enters {len(terms)} terms")
    if any(type(t) is not Term or (t.mask is not None and t.mask.shape != t.shape) for t in terms):
        raise UnsupportedError("a term stands for several")
    return terms


def _sum(blanket: Blanket, terms: Sequence[Term], logs: Sequence[Expression]) -> Expression:
    """The sum of all terms, whose log factors are given, shape the node's plates."""
    if not blanket.node.plates:
        sums = sums_of(logs)
    else:
        own = 0 if blanket.own is None else 1
        sums = [own_elements(terms[0], logs[0])] if own else []
        for child, log in zip(blanket.children, logs[own:], strict=True):
            sums.append(sums_by_element(blanket, child, log))
    total = sums[0]
    for other in sums[1:]:
        total = add(total, other)
    return broadcast(total, blanket.node.plate_shape)


def _hold(
    blanket: Blanket, terms: Sequence[Term], logs: Sequence[Expression], root: Expression
) -> None:
    """Refuse what differs from the model's functions at reachable values of all nodes.

    Term by term, as all together may be impossible wherever it is tried; then their sums, of any numbers.
    """
    target, name = blanket.target, blanket.name
    if target.states is None:
        raise UnsupportedError("no reachable values are known to try it on")
    states: Values = {**target.states, **target.known}
    program, total = Program(for_arrays(logs)), Program(for_arrays([root]))
    seen = [False] * len(terms)
    with marking_invalid(), np.errstate(all="ignore"):
        for k in range(3):
            candidate = np.roll(states[name], k, axis=0)
            _hold_total(blanket, states, candidate, total)
            try:
                state = blanket.placed(states, candidate)
            except BayesmcError:
                continue
            for at, (term, given) in enumerate(zip(terms, program(state), strict=True)):
                seen[at] |= _is_alike(term, state, given)
    if not all(seen):
        raise UnsupportedError("some term is zero at all reachable values")
    if blanket.node.plates:
        _hold_sums(blanket, terms, states)


def _is_alike(term: Term, state: Values, given: np.ndarray) -> bool:
    """Whether the log factors of a term were compared: some of them are numbers."""
    try:
        wanted = np.asarray(term.log(state))
    except BayesmcError:
        return False
    lead = wanted.shape[: max(wanted.ndim - len(term.shape), 0)]
    wanted = np.broadcast_to(wanted, lead + term.shape).reshape(*lead, math.prod(term.shape))
    if term.mask is not None:
        wanted = wanted[..., np.flatnonzero(term.mask)]
    if given.shape[-1] != wanted.shape[-1]:
        raise UnsupportedError("it differs from the model's functions in its elements")
    given, wanted = np.broadcast_arrays(given, wanted)
    finite = np.isfinite(given)
    scale = 1.0 + np.abs(given[finite]).max(initial=0.0)
    if not (np.abs(given - wanted)[finite] <= _RTOL * scale).all():
        raise UnsupportedError("it differs from the model's functions at reachable values")
    if np.isfinite(wanted[given == -np.inf]).any():
        raise UnsupportedError("it is zero where the model's functions are not")
    return bool(finite.any()) or not given.size


def _hold_total(blanket: Blanket, states: Values, candidate: np.ndarray, total: Program) -> None:
    """Refuse a sum of all terms that is not the blanket's, where both are numbers."""
    shape = blanket.size, *blanket.event_shape
    for members in blanket.classes[:_CLASSES]:
        at: Any = slice(None) if members is None else members
        own = candidate if members is None else candidate.reshape(-1, *shape)[:, at]
        try:
            wanted = blanket.log_density(states, own, members)
        except BayesmcError:
            continue
        (found,) = total({**states, blanket.name: blanket.filled(states, own, members)})
        given = found.reshape(-1, blanket.size)[:, at]
        given, wanted = np.broadcast_arrays(given, wanted.reshape(len(wanted), -1))
        both = np.isfinite(given) & np.isfinite(wanted)
        scale = 1.0 + np.abs(given[both]).max(initial=0.0)
        if not (np.abs(given - wanted)[both] <= _RTOL * scale).all():
            raise UnsupportedError("it differs from the model's functions at reachable values")


def _hold_sums(blanket: Blanket, terms: Sequence[Term], states: Values) -> None:
    """Refuse sums by element that are not those of the blanket."""
    rng, own = np.random.default_rng(0), 0 if blanket.own is None else 1
    names = [f"\0log {k}" for k in range(len(terms))]
    wide, given = [], {}
    for name, term in zip(names, terms, strict=True):
        log = rng.normal(size=(len(states[blanket.name]), math.prod(term.shape)))
        if term.mask is not None:
            counts = np.broadcast_to(term.mask, term.shape).reshape(-1)
            log = np.where(counts, log, 0.0)
            given[name] = log[:, counts]
        else:
            given[name] = log
        wide.append(log.reshape(-1, *term.shape))
    leaves = [leaf(n, given[n].shape[1:]) for n in names]
    (found,) = Program([_sum(blanket, terms, leaves)])({**states, **given})
    for members in blanket.classes:
        at: Any = slice(None) if members is None else members
        wanted = wide[0].reshape(len(wide[0]), -1)[:, at] if own else np.zeros(())
        for child, log in zip(blanket.children, wide[own:], strict=True):
            sums = child.relation.collect(log, child.term.shape, members, states)
            wanted = wanted + sums.reshape(len(log), -1)
        if not np.allclose(found.reshape(len(found), -1)[:, at], wanted, rtol=_RTOL, atol=_RTOL):
            raise UnsupportedError("elements of a term do not stand as the node's do")
