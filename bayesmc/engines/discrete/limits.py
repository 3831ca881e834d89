"""What an exact pass over time cannot take, found before it starts: missing numbers that count, and size."""

from __future__ import annotations

import math

import numpy as np

from bayesmc.dbn import PREVIOUS, Series
from bayesmc.engines.discrete.rows import Term
from bayesmc.engines.discrete.slices import DiscreteSlices
from bayesmc.errors import BudgetError


def why_unreadable(plan: DiscreteSlices, series: Series, last: bool = False) -> str | None:
    """Why the hidden nodes are not all finite, or None: a missing value that something needs.

    With ``last`` only the last row counts.
    """
    for name in plan.densities:
        needed = None
        if name not in plan.reader.variables:
            seen = series.observed.get(name)
            if seen is None:
                continue
            needed = seen.mask
        if needed is None:
            needed = np.ones((series.steps, *plan.slices.first[name].plate_shape), dtype=bool)
        if last:
            needed = needed.copy()
            needed[:-1] = False
        for kind in (0, 1, 2):
            gap = first_gap(plan, series, plan.terms[name, kind], needed)
            if gap is not None:
                parent, missing, t = gap
                return (
                    f"node {parent!r} has no finite set of states and is missing in slice {missing}, where "
                    f"{name!r} of slice {t} depends on it"
                )
    return None


def size_refusal(
    plan: DiscreteSlices, steps: int, max_states: int, max_bytes: float
) -> BudgetError | None:
    """Why the tables would be too large; None where they are not."""
    sequences = plan.reader.sequences
    total = 0.0
    for chain, widest in zip(plan.chains, plan.widest, strict=True):
        names = ", ".join(dict.fromkeys(n for _, n, _ in chain.state))
        if chain.size > max_states:
            size = math.prod(
                float(plan.cards[v]) for v in chain.state
            )  # it may be beyond any float
            why = f"the joint state of {names} has {size:.3g} values, above max_states={max_states}"
            return _too_large(why, 8.0 * size)
        total += 8.0 * (4.0 * widest + 3.0 * steps * sequences * chain.size)
        if total > max_bytes:
            why = (
                f"{chain.size:.3g} joint states of {names} in {steps} slices need about {total:.3g} bytes, "
                f"above max_bytes={max_bytes:.3g}; raise DiscreteFilter(max_bytes=) where there is room"
            )
            return _too_large(why, total)
    return None


def first_gap(
    plan: DiscreteSlices, series: Series, term: Term, needed: np.ndarray | None = None
) -> tuple[str, int, int] | None:
    """Where a term reads a value that is missing: the node read, the slice of it, and the reading slice.

    ``needed`` (steps, *plates of the term's node) says where the term counts; None: everywhere.
    """
    for lag, parent in term.reads:
        seen = series.observed.get(parent)
        if seen is not None and seen.mask is None:
            continue
        above = plan.slices.first[parent]
        mask = np.zeros((series.steps, *above.plate_shape), dtype=bool)
        if seen is not None and seen.mask is not None:
            mask = seen.mask
        known = np.ones_like(mask)
        known[lag:] = mask[: series.steps - lag]
        bad = _missed(plan, term, parent, known, needed) & _of_kind(plan, series, term.kind)
        if bad.any():
            t = int(np.argmax(bad)) + series.start
            return parent, t - lag, t
    return None


def is_untold(plan: DiscreteSlices, series: Series, name: str, steps: int | None = None) -> bool:
    """Whether a node that is no variable reads something missing where it is missing itself.

    ``steps`` rows count, the last ones; all by default.
    """
    node = plan.slices.first[name]
    needed = np.ones((series.steps, *node.plate_shape), dtype=bool)
    seen = series.observed.get(name)
    if node.is_stochastic and seen is not None:
        needed = np.zeros_like(needed) if seen.mask is None else ~seen.mask
    if steps is not None:
        needed[: series.steps - steps] = False
    terms = (plan.terms[name, kind] for kind in (0, 1, 2))
    return any(first_gap(plan, series, term, needed) is not None for term in terms)


# ---- private ------------------------------------------------------------------------------------


def _too_large(why: str, count: float) -> BudgetError:
    return BudgetError(
        f"DiscreteFilter: {why}; use BoyenKoller() or FactoredFrontier(), whose beliefs are products over "
        "clusters of nodes or single ones (approximate), or ParticleFilter(particles)",
        int(min(count, 2**62)),
    )


def _missed(
    plan: DiscreteSlices, term: Term, parent: str, known: np.ndarray, needed: np.ndarray | None
) -> np.ndarray:
    """Slices in which a term is needed at an element whose parent is not known."""
    steps, above = len(known), plan.slices.first[parent]
    own = plan.slices.first.nodes.get(term.name)
    if own is None or needed is None:
        missing = ~known.reshape(steps, -1).all(axis=1)
        wanted = True if needed is None else needed.reshape(steps, -1).any(axis=1)
        return np.asarray(missing & wanted)
    if set(above.plates) <= set(own.plates) and not _gathers(plan, term.name):
        order = [above.plates.index(p) for p in own.plates if p in above.plates]
        index = tuple(slice(None) if p in above.plates else None for p in own.plates)
        known = known.transpose(0, *(1 + k for k in order))[(slice(None), *index)]
        return np.asarray((needed & ~known).reshape(steps, -1).any(axis=1))
    every = known.reshape(steps, -1).all(axis=1)
    return np.asarray(needed.reshape(steps, -1).any(axis=1) & ~every)


def _of_kind(plan: DiscreteSlices, series: Series, kind: int) -> np.ndarray:
    """Which slices of a series are of a kind."""
    kinds = np.minimum(np.arange(series.start, series.start + series.steps), 2)
    return np.asarray((kinds if plan.has_second else np.where(kinds > 0, 2, 0)) == kind)


def _gathers(plan: DiscreteSlices, name: str) -> bool:
    """Whether a node, or something computed, reads across plates."""
    for model in (plan.slices.first, plan.slices.later):
        for other in plan.slices.dynamic:
            if model[other].is_stochastic and other != name:
                continue
            for source, link in model[other].links:
                if link.foreign and source.removesuffix(PREVIOUS) in plan.slices.dynamic:
                    return True
    return False
