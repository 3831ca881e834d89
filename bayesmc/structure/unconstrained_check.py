"""A log density of free numbers held against the model at probe points, before its first use.

Three things are compared: every log factor that counts, element by element, with what the model's function
gives at the same values (which shows a mask, a coefficient or a constant that went wrong); the change of
volume with that of the maps; and the sum that is used, which is written for free numbers far out, with the
sum of these.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BayesmcError, UnsupportedError
from bayesmc.expression import Expression, Program
from bayesmc.structure.free_density import FREE, UnconstrainedDensity
from bayesmc.structure.target import Term, Values

#: points, and how far the free numbers of each are from zero
_SPREADS = (0.0, 0.1, 0.3, 1.0, 1.0, 2.0, 3.0, 5.0)
#: reachable values farther out are tried at zero
_FAR = 30.0
#: how far log factors may be off, relative to themselves and to their largest part
_RTOL = 1e-9
#: how far the sum may be off, relative to the sum of sizes, where log factors are written in other ways
_OF_SUM = 1e-7


def hold_against_model(
    density: UnconstrainedDensity, terms: Sequence[Term], plain: Sequence[Expression]
) -> None:
    """Refuse a log density that gives something else than the model's own functions.

    Parameters
    ----------
    density : UnconstrainedDensity
    terms : sequence of Term
    plain : sequence of Expression
        Of each term the log factors that count, then each node's log change of volume, of free numbers, as
        they are written.

    Raises
    ------
    UnsupportedError
        Says which term differs, or is zero at all points.
    """
    program = Program([*plain, density.root])
    seen = dict.fromkeys((t.name for t in terms), not terms)
    seen_sum = False
    for u, values in _points(density):
        found = [np.asarray(v) for v in program({**values, FREE: u})]
        logs, volumes, total = found[: len(terms)], found[len(terms) : -1], found[-1]
        for term, log in zip(terms, logs, strict=True):
            wanted = _counted(term, values)
            if wanted is not None:
                seen[term.name] |= _compare(term, log, wanted)
        volume = sum(float(v) for v in volumes)
        if not np.isclose(volume, density.log_volume(u, values), rtol=1e-8, atol=1e-8):
            raise UnsupportedError("the change of volume differs from that of the maps")
        parts = sum(float(log.sum()) for log in logs) + volume
        size = 1.0 + sum(float(np.abs(log).sum()) for log in logs) + abs(volume)
        if np.isfinite(parts) and abs(float(total) - parts) <= _OF_SUM * size:
            seen_sum = True
    for name, is_seen in seen.items():
        if not is_seen:
            raise UnsupportedError(
                f"the density of {name!r} is zero, or no number, at all points where it was tried, so that "
                "its expression cannot be held against its function"
            )
    if terms and not seen_sum:
        raise UnsupportedError("the sum of the terms, written for free numbers, differs from them")


# ---- private ------------------------------------------------------------------------------------


def _points(density: UnconstrainedDensity) -> Iterator[tuple[np.ndarray, Values]]:
    """Free numbers, and the stored values of all nodes there, one point after the other."""
    target, rng = density.target, np.random.default_rng(len(density.labels))
    moving = set(density.names)
    others = [n for n in target.chain if n not in moving]
    states = target.states
    if others and states is None:
        raise UnsupportedError(f"no reachable value of node {others[0]!r} is known to try it on")
    for k, spread in enumerate(_SPREADS):
        values: Values = dict(target.known)
        for name in others:
            assert states is not None
            values[name] = states[name][k % len(states[name])]
        u = rng.normal(size=density.size) * spread
        if states is not None and k % 2:  # reachable ones, moved a little
            row = {n: states[n][k % len(states[n])] for n in density.names}
            reached = density.unconstrain({**values, **row})
            u = np.where(np.abs(reached) < _FAR, reached, 0.0) + 0.1 * u
        values.update(density.constrain(u, values))
        try:
            with marking_invalid(), np.errstate(all="ignore"):
                target.compute(values, target.links)
        except BayesmcError:
            continue
        yield u, values


def _counted(term: Term, values: Values) -> np.ndarray | None:
    """The model's own log factors that count; None where it cannot say."""
    try:
        with marking_invalid(), np.errstate(all="ignore"):
            log = np.broadcast_to(term.log(values), term.shape).ravel()
    except BayesmcError:
        return None
    return log if term.mask is None else log[np.flatnonzero(term.mask)]


def _compare(term: Term, found: np.ndarray, wanted: np.ndarray) -> bool:
    """Whether some element is finite; all must agree.

    Raises
    ------
    UnsupportedError
    """
    found = np.broadcast_to(found, wanted.shape)
    finite = np.isfinite(wanted)
    near = np.abs(found - wanted) <= _RTOL * (1.0 + np.abs(wanted))
    agree = np.where(finite, near, ~np.isfinite(found))
    if agree.all():
        return bool(finite.any()) or not finite.size
    at = int(np.argmin(agree))
    raise UnsupportedError(
        f"what was read of {term.name!r} gives {found[at]:.9g} at element {at} of those that count, and its "
        f"function {wanted[at]:.9g}"
    )
