"""Where chains start beside labels that are known: the known ones say which component is which.

In a mixture some of whose labels are known only one order of the components is right, and single-site moves
do not get from another one to it: what was seen under known labels must count before what was not.
"""

from __future__ import annotations

import numpy as np

from bayesmc.categorical import pick_log
from bayesmc.errors import DensityError, ParameterError
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Target, Values

#: states of a node whose missing elements are drawn given all else, at most
_LABELS = 64


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
        with np.errstate(all="ignore"):
            states = (np.full_like(now, k) for k in range(domain.size))
            logs = [blanket.log_density(values, state, members) for state in states]
            known = np.flatnonzero(seen.mask)
            told = blanket.log_density(values, blanket.current(values, known), known)
    except (DensityError, ParameterError):  # where it is told why
        return None
    log = np.stack([np.broadcast_to(own, now.shape) for own in logs])
    log = np.where(np.isnan(log), -np.inf, log)
    is_told = (log > -np.inf).any(axis=0)
    drawn = pick_log(np.where(is_told, log, 0.0), rng.random(now.shape), f"node {name!r}")
    new = np.where(is_told, drawn, now).astype(now.dtype)
    moved = blanket.moved(values, new, members)
    values[name] = np.where(seen.mask, values[name], moved)
    target.refresh(values, (name,))
    terms = {child.term.name for child in blanket.children} | {name}
    return terms, np.asarray(told.sum(axis=-1))
