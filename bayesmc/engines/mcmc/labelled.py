"""Labels where chains start: those that are missing drawn given all else, not forward.

In a mixture some of whose labels are known only one order of the components is right, and single-site moves
do not get from another one to it: what was seen under known labels must count before what was not.

Forward draws of many labels are as good as never right all at once where the data leave each but one state
(whoever was caught is there): given all else they are.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from bayesmc.categorical import pick_log
from bayesmc.errors import DensityError, ParameterError
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Target, Values

#: states of a node whose missing elements are drawn given all else, at most
_LABELS = 64
#: rounds over all nodes, since labels may depend on one another, and calls of densities that these may take
_ROUNDS, _CALLS = 3, 300


def relabelled(
    target: Target, name: str, values: Values, rng: np.random.Generator
) -> tuple[set[str], np.ndarray] | None:
    """Labels that are missing among known ones are drawn anew given all else that was drawn.

    Drawn forward they say nothing, and components that are averaged over them forget what the known ones say:
    chains would start, and stay, with components in any order.

    Returns
    -------
    set of str
        Terms that read them.
    ndarray, shape (count,)
        The log of what these say at known labels, by which starts are to be chosen.
    """
    domain, seen = target.model[name].domain, target.seen(name)
    assert seen is not None
    if domain is None or seen.mask is None or not seen.mask.any() or domain.size > _LABELS:
        return None
    blanket = Blanket(target, name)
    if len(blanket.classes) != 1:  # elements that depend on each other
        return None
    members = blanket.classes[0]
    now = blanket.current(values, members)
    try:
        log = _logs(blanket, values, members)
        with np.errstate(all="ignore"):
            known = np.flatnonzero(seen.mask)
            told = blanket.log_density(values, blanket.current(values, known), known)
    except (DensityError, ParameterError):  # where it is told why
        return None
    is_told, drawn = _picked(blanket, log, rng)
    new = np.where(is_told, drawn, now).astype(now.dtype)
    moved = blanket.moved(values, new, members)
    values[name] = np.where(seen.mask, values[name], moved)
    target.refresh(values, (name,))
    terms = {child.term.name for child in blanket.children} | {name}
    return terms, np.asarray(told.sum(axis=-1))


class Labels:
    """The hidden labels of a chain, drawn given all else.

    Parameters
    ----------
    target : Target
    given : iterable of str
        Nodes that stay.
    """

    def __init__(self, target: Target, given: Iterable[str] = ()) -> None:
        self.target = target
        free, nodes = set(target.chain).difference(given), target.model
        domains = {n: nodes[n].domain for n in target.chain if n in free}
        sizes = {n: d.size for n, d in domains.items() if d is not None and d.size <= _LABELS}
        names, few = list(sizes), _ROUNDS * sum(sizes.values()) <= _CALLS
        self.blankets = [Blanket(target, n) for n in names] if few else []

    def __bool__(self) -> bool:
        return 0 < self._calls <= _CALLS

    def draw(self, values: Values, rng: np.random.Generator) -> None:
        """Draw them anew in place; where no state has a density, any will do for the next round."""
        for _ in range(_ROUNDS):
            for blanket in self.blankets:
                for members in blanket.classes:
                    try:
                        log = _logs(blanket, values, members)
                    except (DensityError, ParameterError):  # where it is told why
                        return
                    _, drawn = _picked(blanket, log, rng)
                    now = values[blanket.name]
                    new = drawn.astype(now.dtype)
                    values[blanket.name] = blanket.moved(values, new, members)
                    self.target.refresh(values, (blanket.name,))

    @property
    def _calls(self) -> int:
        """Densities that are asked in one draw."""
        sizes = [b.node.domain.size * len(b.classes) for b in self.blankets]  # type: ignore[union-attr]
        return _ROUNDS * sum(sizes)


# ---- private ------------------------------------------------------------------------------------


def _logs(blanket: Blanket, values: Values, members: np.ndarray | None) -> np.ndarray:
    """What all else says of the states of a node's elements, shape ``(states, chains, *elements)``."""
    now, domain = blanket.current(values, members), blanket.node.domain
    assert domain is not None
    with np.errstate(all="ignore"):
        states = (np.full_like(now, k) for k in range(domain.size))
        logs = [blanket.log_density(values, state, members) for state in states]
    log = np.stack([np.broadcast_to(own, now.shape) for own in logs])
    return np.where(np.isnan(log), -np.inf, log)


def _picked(
    blanket: Blanket, log: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Which elements can be in some state, and states drawn: any where none can be."""
    can = np.asarray((log > -np.inf).any(axis=0))
    chance = rng.random(log.shape[1:])
    return can, pick_log(np.where(can, log, 0.0), chance, f"node {blanket.name!r}")
