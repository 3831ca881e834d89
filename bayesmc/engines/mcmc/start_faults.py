"""Why chains find no start: which element of which term stands in the way, and at which values."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from bayesmc.errors import BayesmcError, DensityError, ParameterError, ZeroProbabilityError
from bayesmc.network.model import invalid_error
from bayesmc.shapes import Shape, first_index
from bayesmc.structure.target import Target, Term, Values


def refuse_impossible(target: Target, tried: Values, given: Collection[str] = ()) -> None:
    """Raise for an observed element that no value of the hidden nodes makes possible.

    Parameters
    ----------
    tried : dict
        Some values of the chain's nodes and of what follows from them, shape ``(rows, *plates, *event)``.
    given : collection of str
        Nodes that are the same in all of them because the user says so.

    Raises
    ------
    ZeroProbabilityError
        An element whose support is the same in all of them, and leaves out what was seen.
    """
    values = {**target.known, **tried}
    for name, term in target.terms.items():
        if term.is_potential or name in target.chain or name not in target.known:
            continue
        above = target.hidden_above(term)
        if any(n in given or target.model[n].domain is not None for n in above):
            continue  # another value, or a state that was not drawn, may allow it
        dist, _ = term.distribution(values)
        support, value = dist.support, np.asarray(target.known[name])
        if support.kind not in ("interval", "integers") or target.model[name].event_shape:
            continue
        low, high = _by_row(support.low, term), _by_row(support.high, term)
        fixed = (low == low[:1]).all(axis=0) & (high == high[:1]).all(axis=0)
        node = target.model[name]
        seen = value if node.domain is None else node.domain.to_support(value)
        outside = fixed & ((seen < low[0]) | (seen > high[0]))
        if term.mask is not None:
            outside = outside & term.mask
        if dist.invalid is not None:
            outside = outside & ~_by_row(dist.invalid, term).any(axis=0)
        if outside.any():
            at = first_index(outside)
            raise ZeroProbabilityError(
                f"node {name!r}{_place(at)}: {value[at]} is impossible whatever the hidden nodes are, since "
                f"{type(dist).__name__} gives values from {low[0][at]:g} to {high[0][at]:g} there; check "
                "that evidence"
            )


def fault_at(target: Target, values: Values, attempts: int) -> BayesmcError | None:
    """What has density zero in one state, by its first element; None where nothing has.

    Parameters
    ----------
    values : dict
        Of all nodes, one row of those that are hidden.
    """
    for term in target.terms.values():
        try:
            log = np.asarray(term.log(values))
        except (DensityError, ParameterError) as error:
            return error
        log = np.broadcast_to(log, (1, *term.shape)).reshape(term.shape)
        lost = ~(log > -np.inf)
        if not lost.any():
            continue
        at = first_index(lost)
        wrong = None if term.is_potential else _out_of_range(target, term, values, at)
        if wrong is not None:
            return wrong
        what = "potential" if term.is_potential else "node"
        there = "" if term.is_potential else term.shown_at(values, (0, *at))
        return ZeroProbabilityError(
            f"no start state of positive density in {attempts} attempts per chain: at the nearest found "
            f"{what} {term.name!r}{_place(at)} has probability zero ({int(lost.sum())} of {lost.size} "
            f"elements){there}; check that evidence, give start={{...}}, or give LikelihoodWeighting or "
            "Exact a try"
        )
    return None


def impossible(culprits: Mapping[str, int], attempts: int) -> ZeroProbabilityError:
    """The error where only the terms are known that no attempt could satisfy."""
    names = sorted(culprits, key=lambda n: -culprits[n])
    what = f"the term of {names[0]!r} has probability zero" if names else "some term is impossible"
    return ZeroProbabilityError(
        f"no start state of positive density in {attempts} attempts per chain: {what} in all of them; "
        "check that evidence, give start={...}, or give LikelihoodWeighting or Exact a try"
    )


# ---- private ------------------------------------------------------------------------------------


def _by_row(array: np.ndarray, term: Term) -> np.ndarray:
    """Numbers of a term's elements, shape ``(rows or 1, *term shape)``."""
    array = np.asarray(array)
    lead = array.shape[: max(array.ndim - len(term.shape), 0)]
    return np.broadcast_to(array, (*lead, *term.shape)).reshape(-1, *term.shape)


def _out_of_range(target: Target, term: Term, values: Values, at: Shape) -> ParameterError | None:
    """The error of an element whose parameters are out of range, rather than improbable."""
    dist, batch = term.distribution(values)
    if dist.invalid is None or dist.problem is None or not _by_row(dist.invalid, term)[0][at]:
        return None
    if dist.problem.has_grown:
        return None
    error = invalid_error(target.model[term.name], dist, np.broadcast_to(True, batch), batch)
    if error is not None:
        error.args = (f"{error}; so it is at every start that was tried", *error.args[1:])
    return error


def _place(at: Shape) -> str:
    return f" (plate element {at if len(at) > 1 else at[0]})" if at else ""
