"""Like nodes as one: the slices of an unrolled template get a group axis instead of a loop.

Nodes are alike where the same functions say what they are and what depends on them, in the same places. The
blanket of one of them then serves all: its neighbours' names stand for arrays in which the neighbours of all
of them are stacked, with the group as one more batch axis, after the chains. Functions broadcast over batch
axes, so nothing else has to know.

Constants by which the functions of a group differ (``t=t``) are stacked as well (``like_functions``).
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayesmc.structure.blanket import Blanket, colours
from bayesmc.structure.like_functions import (
    Signature,
    Slots,
    StackedFunction,
    as_one,
    stack_arrays,
    value_key,
)
from bayesmc.structure.like_terms import one_term
from bayesmc.structure.target import Target, Values

#: nodes that are worth a group
FEWEST = 4


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

    def __init__(self, one: Blanket, blankets: Sequence[Blanket], slots: Slots) -> None:
        self.one = one
        self.blankets = tuple(blankets)
        self.names = tuple(b.name for b in blankets)
        self.slots = slots

    def gathered(self, values: Mapping[str, np.ndarray]) -> Values:
        """Values by the names of the first node's neighbours, the group as an axis after the chains."""
        return self.slots.gathered(values)

    def spread(self, value: np.ndarray) -> Values:
        """Values of every node, from those of the group ``(chains, group, *plates, *event)``."""
        rows = np.ascontiguousarray(np.moveaxis(value, 1, 0))
        rows.flags.writeable = False
        return dict(zip(self.names, rows, strict=True))

    def current(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """The nodes' values ``(chains, group, *plates, *event)``."""
        return stack_arrays([values[n] for n in self.names], len(self.one.node.value_shape))

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
    target: Target,
    blankets: Mapping[str, Blanket],
    names: Sequence[str],
    forms: Forms | None = None,
) -> tuple[list[StackedBlanket], list[str]]:
    """Groups of like nodes that may be updated as one, and the nodes that are left.

    Parameters
    ----------
    blankets : dict
        Of every chain node (or of ``names`` at least).
    names : sequence of str
        Chain nodes to be grouped.
    forms : Forms, optional
        Of the target, where they are known.

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
    forms = Forms(target) if forms is None else forms
    alike: dict[Hashable, list[Form]] = {}
    for name in names:
        form = forms.of(blankets[name])
        if form is not None:
            alike.setdefault(form.key, []).append(form)
    found: list[StackedBlanket] = []
    for group in alike.values():
        for members in _apart(group):
            if len(members) >= FEWEST:
                found.append(_stacked(target, members))
    taken = {n for stack in found for n in stack.names}
    return found, [n for n in names if n not in taken]


@dataclass(frozen=True, eq=False)
class Form:
    """A blanket in a way that can be compared.

    Attributes
    ----------
    parts : tuple of str
        Deterministic nodes on its path, its own term and its children, like ones in like places.
    signatures : tuple of Signature
        Of the parts.
    others : tuple of str
        All other nodes that the parts read, in the order in which they first appear.
    """

    key: Hashable
    blanket: Blanket
    parts: tuple[str, ...]
    signatures: tuple[Signature, ...]
    others: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """All nodes around, like ones in like places."""
        return (self.blanket.name, *self.parts, *self.others)

    def said_of(self, like: Form, words: str) -> str:
        """What is said of this node as it is of one that is like it."""
        names = dict(zip(self.names, like.names, strict=True))
        return re.sub(r"'([^']*)'", lambda m: f"'{names.get(m[1], m[1])}'", words)


class Forms:
    """The forms of a target's nodes, each found once; parts are brought into one order."""

    def __init__(self, target: Target) -> None:
        self.target = target
        self._numbers: dict[Hashable, int] = {}
        self._found: dict[str, Form | None] = {}

    def of(self, blanket: Blanket) -> Form | None:
        """The form of a blanket; None where its node is updated in turns, or in other ways."""
        if blanket.name not in self._found:
            self._found[blanket.name] = self._read(blanket)
        return self._found[blanket.name]

    def key(self, blanket: Blanket) -> Hashable | None:
        """Equal for nodes around which functions, and what is known, are alike; None of no form."""
        form = self.of(blanket)
        return form and (form.key, tuple(map(self.target.is_known, form.names)))

    def _read(self, blanket: Blanket) -> Form | None:
        node = blanket.node
        if not blanket.classes or blanket.classes[0] is not None:
            return None
        if self.target.seen(blanket.name) is not None:
            return None
        if any(c.relation.kind != "aligned" for c in blanket.children):
            return None
        roles: dict[str, Hashable] = {link: i for i, link in enumerate(blanket.path)}
        roles[blanket.name] = "self"
        children = [(self._number(c.term.name, roles), c.term.name) for c in blanket.children]
        own = () if blanket.own is None else (blanket.own.name,)
        parts = (*blanket.path, *own, *(name for _, name in sorted(children, key=lambda c: c[0])))
        found = [self.target.signatures.of(p) for p in parts]
        signatures = tuple(s for s in found if s is not None)
        if len(signatures) < len(parts):
            return None
        read = [tuple(n for n in s.scope if n not in roles) for s in signatures]
        others = tuple(dict.fromkeys(n for scope in read for n in scope))
        place = {n: i for i, n in enumerate(others)}
        numbers = tuple(self._number(p, roles) for p in parts)
        pattern = tuple(tuple(place[n] for n in scope) for scope in read)
        shape = (len(blanket.path), len(own))
        key = (value_key(node), node.support, shape, numbers, pattern)
        return Form(key, blanket, parts, signatures, others)

    def _number(self, name: str, roles: Mapping[str, Hashable]) -> int:
        """A number for what a part is, and where it reads the node and what is on its path."""
        signature = self.target.signatures.of(name)
        if signature is None:
            return -1
        key = (signature.key, tuple(roles.get(n) for n in signature.scope))
        return self._numbers.setdefault(key, len(self._numbers))


# ---- private ------------------------------------------------------------------------------------


def _apart(group: Sequence[Form]) -> Iterator[list[Form]]:
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


def _stacked(target: Target, forms: Sequence[Form]) -> StackedBlanket:
    """The stack of some nodes that are alike and apart."""
    slots = Slots(target, _sources(forms), len(forms))
    return StackedBlanket(_representative(target, forms), [f.blanket for f in forms], slots)


def _sources(forms: Sequence[Form]) -> dict[str, tuple[str, ...]]:
    """What each name around the first node stands for."""
    first = forms[0]
    found = {first.blanket.name: tuple(f.blanket.name for f in forms)}
    for at, name in enumerate(first.others):
        found[name] = tuple(f.others[at] for f in forms)
    return found


def _representative(target: Target, forms: Sequence[Form]) -> Blanket:
    """The first node's blanket, where need be with functions that have the constants of all."""
    first = forms[0]
    terms, links = dict(target.terms), dict[str, StackedFunction]()
    for at, name in enumerate(first.parts):
        signatures = [f.signatures[at] for f in forms]
        if name in terms:
            terms[name] = one_term([target.terms[f.parts[at]] for f in forms], signatures)
            continue
        function = as_one(signatures)
        if function is not None:
            links[name] = function
    if not links and all(terms[n] is t for n, t in target.terms.items()):
        return first.blanket
    return Blanket(replace(target, terms=terms, stacked_links=links, _below={}), first.blanket.name)
