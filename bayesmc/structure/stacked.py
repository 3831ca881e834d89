"""Like nodes as one: the slices of an unrolled template get a group axis instead of a loop.

Nodes are alike where the same functions say what they are and what depends on them, in the same places. The
blanket of one of them then serves all: its neighbours' names stand for arrays in which the neighbours of all
of them are stacked, with the group as one more batch axis, after the chains. Functions broadcast over batch
axes, so nothing else has to know.

Numbers by which the functions of a group differ (``t=t``) are stacked as well, but a function need not
broadcast over those; the stacked blanket is compared with the single ones on a few states, and what does not
agree is left alone.
"""

from __future__ import annotations

import itertools
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BayesmcError
from bayesmc.network import CompiledNode
from bayesmc.network.domain import Domain
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.colouring import colours
from bayesmc.structure.like_functions import (
    GROUP,
    LikeFunctions,
    close,
    gather,
    in_model,
    some_states,
    stack_arrays,
)
from bayesmc.structure.likeness import Skeleton, skeleton
from bayesmc.structure.target import Target, Values

#: nodes that are worth a group
FEWEST = 4
#: values of finite nodes that are tried, to compare a stack with its members
_TRIED = 6


class StackedBlanket:
    """The full conditionals of several like nodes, no two of which share a term.

    Attributes
    ----------
    names : tuple of str
        The group, in the order of its axis.
    blankets : tuple of Blanket
        Of each node alone.
    one : Blanket
        The blanket of the first, to be asked about what ``gathered`` returns: there the values of its
        neighbours are those of all, ``(chains, group, *plates, *event)``, and so are its answers.
    """

    def __init__(self, one: Blanket, blankets: Sequence[Blanket], slots: Mapping[str, Any]) -> None:
        self.one = one
        self.blankets = tuple(blankets)
        self.names = tuple(b.name for b in blankets)
        self._slots = dict(slots)
        model, known = one.target.model, one.target.known
        self._trailing = {name: len(model[name].value_shape) for name in self._slots}
        self._known = {
            name: [known[n] for n in sources]
            for name, sources in self._slots.items()
            if all(n in known for n in sources)
        }
        self._fixed = {
            name: stack_arrays(values, self._trailing[name]) for name, values in self._known.items()
        }

    def gathered(self, values: Mapping[str, np.ndarray]) -> Values:
        """Values by the names of the first node's neighbours, the group as an axis after the chains."""
        found: Values = {GROUP: np.zeros(len(self.names))}
        for name, sources in self._slots.items():
            arrays = [values[n] for n in sources]
            known = self._known.get(name)
            if known is not None and all(map(_is, arrays, known)):
                found[name] = self._fixed[name]
            else:
                found[name] = stack_arrays(arrays, self._trailing[name])
        return found

    def spread(self, value: np.ndarray) -> Values:
        """Values of every node, from those of the group ``(chains, group, *plates, *event)``."""
        rows = np.ascontiguousarray(np.moveaxis(value, 1, 0))
        rows.flags.writeable = False
        return dict(zip(self.names, rows, strict=True))

    def current(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """The nodes' values ``(chains, group, *plates, *event)``."""
        return stack_arrays([values[n] for n in self.names], self._trailing[self.one.name])

    def log_density(self, values: Mapping[str, np.ndarray], candidate: np.ndarray) -> np.ndarray:
        """Log full conditionals of all nodes at candidate values, up to constants.

        Parameters
        ----------
        candidate : ndarray, shape (*lead, group, *plates, *event)
            ``lead`` broadcasts with the chains.

        Returns
        -------
        ndarray, shape (*lead, group, *plates), or what broadcasts to it
        """
        return self.one.log_density(self.gathered(values), candidate)


def stacks(
    target: Target, blankets: Mapping[str, Blanket], names: Sequence[str]
) -> tuple[list[StackedBlanket], list[str]]:
    """Groups of like nodes that may be updated as one, and the nodes that are left.

    Parameters
    ----------
    blankets : dict
        Of every chain node (or of ``names`` at least).
    names : sequence of str
        Chain nodes to be grouped.

    Returns
    -------
    list of StackedBlanket
        Of at least ``FEWEST`` nodes each.
    list of str
        All other names, in their order.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.blanket import Blanket
    >>> from bayesmc.structure.stacked import stacks
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet()
    >>> net.add("x[0]", bmc.Laplace(0.0, 1.0))
    >>> for t in range(1, 12):
    ...     net.add(f"x[{t}]", lambda x, t=t: bmc.Laplace(x / t, 1.0), parents=[f"x[{t - 1}]"])
    >>> net.add("y", lambda x: bmc.Normal(x, 1.0), parents=["x[11]"])
    >>> target = target_of(pose(net, {"y": 1.0}))
    >>> found, left = stacks(target, {n: Blanket(target, n) for n in target.chain}, target.chain)
    >>> [s.names for s in found]
    [('x[1]', 'x[3]', 'x[5]', 'x[7]', 'x[9]'), ('x[2]', 'x[4]', 'x[6]', 'x[8]', 'x[10]')]
    >>> left
    ['x[0]', 'x[11]']
    """
    if len(names) < FEWEST:
        return [], list(names)
    forms = _Forms(target)
    alike: dict[Hashable, list[_Form]] = {}
    for name in names:
        form = forms.of(blankets[name])
        if form is not None:
            alike.setdefault(form.key, []).append(form)
    found: list[StackedBlanket] = []
    states = None
    for group in alike.values():
        for members in _apart(group):
            if len(members) < FEWEST:
                continue
            states = some_states(target) if states is None else states
            if states is None:
                return [], list(names)
            stack = _stacked(target, members, states)
            if stack is not None:
                found.append(stack)
    taken = {n for stack in found for n in stack.names}
    return found, [n for n in names if n not in taken]


# ---- private ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Form:
    """A blanket in a way that can be compared.

    Attributes
    ----------
    parts : tuple of str
        Deterministic nodes on its path, its own term and its children, like ones in like places.
    skeletons : tuple of Skeleton
        Of the parts' functions.
    others : tuple of str
        All other nodes that the parts read, in the order in which they first appear.
    """

    key: Hashable
    blanket: Blanket
    parts: tuple[str, ...]
    skeletons: tuple[Skeleton, ...]
    others: tuple[str, ...]


class _Forms:
    """Reads blankets; what functions are is found once for each."""

    def __init__(self, target: Target) -> None:
        self.target = target
        self._skeletons: dict[str, Skeleton] = {}
        self._numbers: dict[Hashable, int] = {}

    def of(self, blanket: Blanket) -> _Form | None:
        """The form of a blanket; None where its node is updated in turns, or in other ways."""
        node, target = blanket.node, self.target
        if blanket.classes != (None,) or target.seen(blanket.name) is not None:
            return None
        if any(c.relation.kind != "aligned" for c in blanket.children):
            return None
        own = [] if blanket.own is None else [(self._part(blanket, blanket.own.name), "own")]
        path = [(self._part(blanket, link), "link") for link in blanket.path]
        children = [(self._part(blanket, c.term.name), "child") for c in blanket.children]
        children.sort(key=lambda part: part[0][0])
        ordered = [*path, *own, *children]
        if any(number < 0 for (number, _, _), _ in ordered):
            return None
        parts = tuple(name for (_, name, _), _ in ordered)
        others = tuple(dict.fromkeys(n for (_, _, scope), _ in ordered for n in scope))
        place = {n: i for i, n in enumerate(others)}
        key = (
            _value_key(node),
            node.support,
            tuple(
                (number, role, tuple(place[n] for n in scope))
                for (number, _, scope), role in ordered
            ),
        )
        return _Form(key, blanket, parts, tuple(self._skeletons[p] for p in parts), others)

    def _part(self, blanket: Blanket, name: str) -> tuple[int, str, list[str]]:
        """A number for what a link or term is (-1 where it cannot be stacked), its name, others it reads."""
        model, target = self.target.model, self.target
        roles = {blanket.name: "self", **{link: i for i, link in enumerate(blanket.path)}}
        term = target.terms.get(name)
        if term is not None and term.is_potential:
            potential, _ = model.potentials[name]
            function: Any = potential.function
            scope = list(potential.parents)
            what: Hashable = ("potential", potential.plates, potential.is_table)
            plain = potential.index is None
        else:
            node = model[name]
            declaration = node.declaration
            function, scope = declaration.function, [*node.parents, name]
            tables = (declaration.probs, node.table)
            what = (
                _value_key(node),
                tuple(None if t is None else (t.shape, t.dtype.str, t.tobytes()) for t in tables),
            )
            plain = not declaration.vectorize
        if name not in self._skeletons:
            self._skeletons[name] = skeleton(function)
        read = tuple((roles.get(n), _value_key(model[n])) for n in scope)
        key = (self._skeletons[name].key, what, read)
        number = self._numbers.setdefault(key, len(self._numbers)) if plain else -1
        return number, name, [n for n in scope if n not in roles]


def _value_key(node: CompiledNode) -> Hashable:
    """What a node's values are."""
    return node.plates, node.event_shape, node.is_discrete, _domain_key(node.domain)


def _domain_key(domain: Domain | None) -> Hashable:
    if domain is None:
        return None
    values = None if domain.values is None else (domain.values.dtype.str, domain.values.tobytes())
    return domain.size, domain.low, values, domain.labels


def _apart(group: Sequence[_Form]) -> Iterator[list[_Form]]:
    """Like nodes by colour: those of one share no term."""
    if len(group) < FEWEST:
        return
    entered: dict[str, list[int]] = {}
    for i, form in enumerate(group):
        for part in form.parts:
            if part not in form.blanket.path:
                entered.setdefault(part, []).append(i)
    edges = [pair for members in entered.values() for pair in itertools.combinations(members, 2)]
    for members in colours(len(group), np.array(edges, dtype=np.intp).reshape(-1, 2)):
        yield [group[i] for i in members]


def _stacked(target: Target, forms: Sequence[_Form], states: Values) -> StackedBlanket | None:
    """The stack of some nodes that are alike and apart; None where it would not say what they say."""
    try:
        one = _representative(target, forms, states)
        if one is None:
            return None
        stack = StackedBlanket(one, [f.blanket for f in forms], _slots(forms))
        return stack if _agrees(stack, states) else None
    except BayesmcError:  # at some state, perhaps one that is impossible
        return None


def _slots(forms: Sequence[_Form]) -> dict[str, tuple[str, ...]]:
    """What each name around the first node stands for: one name for all, or one for each."""
    first = forms[0]
    slots = {first.blanket.name: tuple(f.blanket.name for f in forms)}
    for at, name in enumerate(first.others):
        sources = tuple(f.others[at] for f in forms)
        slots[name] = sources[:1] if len(set(sources)) == 1 else sources
    return slots


def _representative(target: Target, forms: Sequence[_Form], states: Values) -> Blanket | None:
    """The first node's blanket, where need be in a model whose functions have the numbers of all."""
    first = forms[0]
    slots = _slots(forms)
    slots |= {
        name: tuple(f.parts[at] for f in forms)
        for at, name in enumerate(first.parts)
        if name in first.blanket.path
    }
    gathered = gather(target, slots, states, len(forms))
    model, terms = target.model, dict(target.terms)
    for at, name in enumerate(first.parts):
        alike = LikeFunctions(
            tuple(f.parts[at] for f in forms), tuple(f.skeletons[at] for f in forms)
        )
        if name in terms:
            terms[name] = replace(terms[name], mask=alike.mask(target))
        if alike.varying:
            made = alike.as_one(target, model, gathered, states)
            if made is None:
                return None
            model = made
    if model is target.model and all(terms[n].mask is t.mask for n, t in target.terms.items()):
        return first.blanket
    return Blanket(in_model(target, model, terms), first.blanket.name)


def _is(a: Any, b: Any) -> bool:
    return a is b


def _agrees(stack: StackedBlanket, states: Values) -> bool:
    """Whether the stack says of some states, with values in other states' places, what its members say."""
    now = stack.current(states)
    if stack.one.node.domain is not None:
        size = stack.one.node.domain.size
        tried = [(now + k) % size for k in range(min(size, _TRIED))]
    else:
        tried = [now, np.roll(now, 1, axis=0), np.roll(now, 1, axis=1)]
    candidate = np.stack(tried).astype(now.dtype)
    shape = candidate.shape[: candidate.ndim - len(stack.one.event_shape)]
    with marking_invalid(), np.errstate(all="ignore"):
        together = np.broadcast_to(stack.log_density(states, candidate), shape)
        for i, blanket in enumerate(stack.blankets):
            alone = blanket.log_density(states, candidate[:, :, i])
            if not close(together[:, :, i], np.broadcast_to(alone, shape[:2] + shape[3:])):
                return False
    return True
