"""Which finite nodes are drawn as forests: found among the factors, the longest families of like nodes first.

Blocks may overlap: each is as large a forest as fits, and what one had to leave out, since it closes a cycle
or since a factor reads three, the next one takes up, the nodes beside it held again.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BayesmcError
from bayesmc.kernels.enumerate import FiniteTerms
from bayesmc.kernels.forest_block import ForestBlock, members_of
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.like_terms import FEWEST
from bayesmc.structure.target import Target

#: states of a node of a forest
_STATES = 64
#: log factors that one term may make, and all together, for one chain
_ENTRIES, _TOTAL = 1 << 20, 1 << 22
#: blocks for the nodes of the same plates: where more are needed, nodes are tied too densely for it to pay
_BLOCKS = 8
#: a node in plates that is mostly observed is drawn where it is hidden, and there alone
_HIDDEN = 0.5


def forest_blocks(
    target: Target, blankets: Mapping[str, Blanket], names: Sequence[str], terms: FiniteTerms
) -> list[ForestBlock]:
    """The blocks of finite nodes that are drawn jointly; nodes that stand in none are left to others.

    Nodes all of whose factors are fixed tables move very fast one by one, and are joined only where they,
    or those beside them, are many of a kind: the slices of a template, or what a loop declared.

    Parameters
    ----------
    names : sequence of str
        Finite chain nodes.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.kernels.enumerate import FiniteTerms
    >>> from bayesmc.kernels.forest_search import forest_blocks
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.blanket import Blanket
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet()
    >>> net.add("stay", bmc.Beta(2.0, 1.0))
    >>> net.add("s[0]", bmc.Bernoulli(0.5))
    >>> for t in range(1, 5):
    ...     net.add(
    ...         f"s[{t}]",
    ...         lambda s, stay: bmc.Bernoulli(np.where(s == 1, stay, 1 - stay)),
    ...         parents=[f"s[{t - 1}]", "stay"],
    ...     )
    >>> net.add("y", lambda s: bmc.Normal(s, 1.0), parents=["s[4]"])
    >>> target = target_of(pose(net, {"y": 0.7}))
    >>> blankets = {name: Blanket(target, name) for name in target.chain}
    >>> finite = [name for name in target.chain if name != "stay"]
    >>> (block,) = forest_blocks(target, blankets, finite, FiniteTerms(target))
    >>> block.names
    ('s[0]', 's[1]', 's[2]', 's[3]', 's[4]')
    """
    eligible = [n for n in names if _is_eligible(target, blankets[n])]
    families = _families(target, eligible)
    tabulated = {n for n in eligible if terms.around((n,)) is not None and not _plated(target, n)}
    wanted = {n for n in eligible if n not in tabulated or families[n][1] >= FEWEST}
    beside = {n for m in members_of(target, eligible).values() if wanted & set(m) for n in m}
    chosen = [n for n in eligible if n in wanted | beside]
    by_plates: dict[tuple[str, ...], list[str]] = {}
    for name in chosen:
        by_plates.setdefault(target.model[name].plates, []).append(name)
    found = []
    for group in by_plates.values():
        if len(group) < 2:
            continue
        order = sorted(group, key=lambda n: (-families[n][1], families[n][0]))
        for block in _forests(target, order):
            made = _made(target, [n for n in group if n in block])
            if made is not None:
                found.append(made)
    return found


# ---- private ------------------------------------------------------------------------------------


def _plated(target: Target, name: str) -> bool:
    return bool(target.model[name].plates)


def _is_eligible(target: Target, blanket: Blanket) -> bool:
    """Whether all elements of a node may move at once, and it has few states."""
    domain = blanket.node.domain
    if domain is None or domain.size > _STATES or len(blanket.classes) != 1:
        return False
    if any(c.relation.kind != "aligned" for c in blanket.children):
        return False
    free = target.free_elements(blanket.name)
    return free is None or len(free) >= _HIDDEN * blanket.size


def _families(target: Target, names: Sequence[str]) -> dict[str, tuple[int, int]]:
    """For each node the place of its kind, and how many are of it."""
    if len(names) == 1:
        return {names[0]: (0, 1)}
    kinds: dict[Hashable, list[str]] = {}
    for name in names:
        signature = target.signatures.of(name) if name in target.terms else None
        table = target.model[name].declaration.probs
        what = (
            None if table is None else table.tobytes()
        )  # tables of one shape are not of a kind yet
        key = ("alone", name) if signature is None else (signature.key, what)
        kinds.setdefault(key, []).append(name)
    return {n: (i, len(these)) for i, these in enumerate(kinds.values()) for n in these}


def _forests(target: Target, order: Sequence[str]) -> list[set[str]]:
    """Forests that together hold every node that shares a term with another, as large as they come."""
    members = members_of(target, order)
    entries = [_entries(target, term, these) for term, these in members.items()]
    if max(entries) > _ENTRIES or sum(entries) > _TOTAL:
        return []
    touching: dict[str, list[tuple[str, ...]]] = {n: [] for n in order}
    for these in members.values():
        for name in these:
            touching[name].append(these)
    left = [n for n in order if any(len(m) > 1 for m in touching[n])]
    found: list[set[str]] = []
    while left:
        block = _grown(left, touching, set())
        others = [n for n in order if n not in block]
        beside = {m for n in block for these in touching[n] for m in these}
        if found:  # what was drawn before is taken along as far as it hangs together with the rest
            while True:
                more = _grown([n for n in others if n in beside], touching, block)
                if more == block:
                    break
                beside |= {m for n in more - block for these in touching[n] for m in these}
                block = more
        found.append(block)
        left = [n for n in left if n not in block]
        if len(found) > _BLOCKS:
            return []
    joined = [b for b in found if any(len(set(m) & b) > 1 for n in b for m in touching[n])]
    return joined


def _grown(
    names: Sequence[str], touching: Mapping[str, Sequence[tuple[str, ...]]], block: set[str]
) -> set[str]:
    """A block with those of some nodes, in their order, that leave it a forest."""
    block = set(block)
    tree: dict[str, str] = {}

    def root(name: str) -> str:
        while tree.setdefault(name, name) != name:
            tree[name] = tree[tree[name]]
            name = tree[name]
        return name

    for name in block:
        for these in touching[name]:
            inside = [m for m in these if m in block]
            for other in inside[1:]:
                tree[root(other)] = root(inside[0])
    for name in names:
        if name in block:
            continue
        near: dict[str, None] = {}
        fits = True
        for these in touching[name]:
            inside = [m for m in these if m in block]
            fits = fits and len(inside) <= 1
            near |= dict.fromkeys(inside)
        roots = [root(m) for m in near]
        if not fits or len(set(roots)) < len(roots):
            continue
        block.add(name)
        for other in roots:
            tree[other] = root(name)
    return block


def _entries(target: Target, term: str, members: Sequence[str]) -> int:
    """Log factors of one term on all states of a pair."""
    cards = sorted(target.model[n].domain.size for n in members)[-2:]  # type: ignore[union-attr]
    return math.prod(cards) * math.prod(target.terms[term].shape)


def _made(target: Target, names: Sequence[str]) -> ForestBlock | None:
    """The block, where its factors can be read at some states."""
    states = target.states
    if states is None:
        return None
    try:
        block = ForestBlock(target, names)
        with marking_invalid(), np.errstate(all="ignore"):
            block.log_factors(states)
    except BayesmcError:  # at a state that is impossible, perhaps
        return None
    return block
