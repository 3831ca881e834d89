"""A log density of free numbers held against the model at probe points, before its first use.

Three things are compared: every log factor that counts, element by element, with what the model's function
gives at the same values (which shows a mask, a coefficient or a constant that went wrong); the change of
volume with that of the maps; and the sum that is used, which is written for free numbers far out, with the
sum of these.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import islice

import numpy as np
import scipy

from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BayesmcError, UnsupportedError
from bayesmc.expression import Expression, Program
from bayesmc.structure.free_density import FREE, UnconstrainedDensity
from bayesmc.structure.summing import Summed
from bayesmc.structure.target import Term, Values

#: points, and how far the free numbers of each are from zero
_SPREADS = (0.0, 3.0, 0.1, 5.0, 1.0, 2.0, 0.3, 1.0)
#: terms from which on half as many points do: most of them are alike
_MANY = 100
#: reachable values farther out are tried at zero
_FAR = 30.0
#: points among which some of positive density are looked for, numbers that these may take, and how many do
_SEARCHED, _NUMBERS, _FOUND = 8192, 4_000_000, 4
#: what climbs are told where the density is none
_LOWEST = 1e300
#: how far log factors may be off, relative to themselves and to their largest part
_RTOL = 1e-9
#: how much lower the log density may be than where all agree, for something that differs to count: far out a
#: solver of differential equations makes much of rounding, and nobody ever gets there
_NOWHERE_NEAR = 1000.0
#: points at the end of a climb, and beside it, that are compared before that
_AT_HEIGHT = 4
#: how far those may be that are written for free numbers far out: where probabilities are near 0 or 1 the
#: model's own lose digits
_WRITTEN = 1e-7


def hold_against_model(
    density: UnconstrainedDensity,
    terms: Sequence[Term],
    plain: Sequence[Expression],
    used: Sequence[Expression],
    tables: Sequence[Summed] = (),
) -> None:
    """Refuse a log density that gives something else than the model's own functions.

    Parameters
    ----------
    density : UnconstrainedDensity
    terms : sequence of Term
    plain : sequence of Expression
        Of each term the log factors that count, then each node's log change of volume, of free numbers, as
        they are written.
    used : sequence of Expression
        The same as they are added up.
    tables : sequence of Summed
        Terms for all states of nodes that are summed out.

    Raises
    ------
    UnsupportedError
        Says which term differs, or is zero at all points.
    """
    compared = _Compared(density, terms, plain, used, tables)
    told, is_positive = np.zeros(density.size, dtype=bool), False
    highest, doubts = -np.inf, list[tuple[float, UnsupportedError]]()

    def is_enough() -> bool:
        return compared.is_complete and bool(told.all())

    def points() -> Iterator[tuple[np.ndarray, Values]]:
        yield from _points(density)
        yield from _positive(density, is_enough)
        yield from _uphill(density, is_enough)
        if doubts:  # they are only let pass where the density agrees at its height
            yield from islice(_uphill(density, lambda: False), _AT_HEIGHT)

    for u, values in points():
        log = float(density.value(u, values))
        try:
            if not compared.hold(u, values):
                continue
        except UnsupportedError as error:
            doubts.append((max(log, _own_log(density, values)), error))
            continue
        highest = max(highest, log)
        if not told.all() and log > -np.inf:
            is_positive = True
            told |= density.is_told(u, values)
    for log, doubt in doubts:
        if not log < highest - _NOWHERE_NEAR:
            raise doubt
    compared.refuse()
    if is_positive and not told.all():
        label = density.labels[int(np.argmin(told))]
        raise UnsupportedError(
            f"the derivative of the log density by {label!r} is no number wherever it was tried"
        )


def other_values(density: UnconstrainedDensity, k: int) -> Values:
    """Stored values of all nodes that do not move, in one of the reachable states."""
    target, states = density.target, density.target.states
    values: Values = dict(target.known)
    for name in target.chain:
        if name not in density.names:
            if states is None:
                raise UnsupportedError(f"no reachable value of node {name!r} is known to try it on")
            values[name] = target.with_seen(name, states[name][k % len(states[name])])
    return values


# ---- private ------------------------------------------------------------------------------------


class _Compared:
    """All parts of a log density beside the model's, point by point; see ``hold_against_model``."""

    def __init__(
        self,
        density: UnconstrainedDensity,
        terms: Sequence[Term],
        plain: Sequence[Expression],
        used: Sequence[Expression],
        tables: Sequence[Summed],
    ) -> None:
        self._density, self._terms, self._tables = density, terms, tables
        self._program, self._plain = Program([*plain, *used]), len(plain)
        self._totals = Program([table.total for table in tables])
        self._inside = {t.name for table in tables for t in table.terms}
        self._names = [t.name for t in terms]
        self._seen, self._agreed = [False] * len(terms), [False] * len(plain)

    @property
    def is_complete(self) -> bool:
        """Whether each part was a number somewhere, and was compared there."""
        return all(self._seen) and all(self._agreed)

    def hold(self, u: np.ndarray, values: Values) -> bool:
        """Compare all at one point; whether there is anything to compare.

        Raises
        ------
        UnsupportedError
        """
        density, terms, names = self._density, self._terms, self._names
        found = [np.asarray(v) for v in self._program({**values, FREE: u})]
        given, written = found[: self._plain], found[self._plain :]
        wanted = [_counted(term, values) for term in terms]
        # parameters out of range: where its own density is zero, a node's value may be anything
        nowhere = [
            w is not None and t.name in density.names and not np.isfinite(w).all()
            for t, w in zip(terms, wanted, strict=True)
        ]
        for k, own in enumerate(wanted):
            if own is not None and nowhere[k] >= any(nowhere):
                self._seen[k] |= _compare(terms[k], given[k], own)
        if any(nowhere):
            return False
        sums = {t.name: float(log.sum()) for t, log in zip(terms, given, strict=False)}
        _check_tables(self._tables, sums, u, values)
        volume = sum(float(v) for v in given[len(terms) :])
        if not np.isclose(volume, density.log_volume(u, values), rtol=1e-8, atol=1e-8):
            raise UnsupportedError("the change of volume differs from that of the maps")
        outside = [
            float(w.sum()) for w, n in zip(written, names, strict=False) if n not in self._inside
        ]
        outside += [float(w) for w in (*written[len(terms) :], *self._totals({**values, FREE: u}))]
        _check_sum(density, outside, u, values)
        for k, (a, b) in enumerate(zip(given, written, strict=True)):
            self._agreed[k] |= _is_written(a, b)
        return True

    def refuse(self) -> None:
        """Raise for what was no number at all points, or differs as it is written for free numbers."""
        for name, is_seen in zip(self._names, self._seen, strict=True):
            if not is_seen:
                raise UnsupportedError(
                    f"the density of {name!r} is zero, or no number, at all points where it was tried "
                    "(is the evidence possible?), so that its expression cannot be held against its function"
                )
        if not all(self._agreed):
            name = [*self._names, *self._density.names][self._agreed.index(False)]
            raise UnsupportedError(
                f"the term of {name!r}, written for free numbers, differs from it"
            )


def _points(density: UnconstrainedDensity) -> Iterator[tuple[np.ndarray, Values]]:
    """Free numbers, and the stored values of all nodes there, one point after the other."""
    target, rng = density.target, np.random.default_rng(len(density.labels))
    states = target.states
    many = len(target.terms) > _MANY
    for k, spread in enumerate(_SPREADS[-4:] if many else _SPREADS):
        values = other_values(density, k)
        u = rng.normal(size=density.size) * spread
        if states is not None and k % 2:  # reachable ones, moved a little
            row = {n: states[n][k % len(states[n])] for n in density.names}
            reached = density.unconstrain({**values, **row})
            u = np.where(np.abs(reached) < _FAR, reached, 0.0) + 0.1 * u
        if _completed(density, u, values):
            yield u, values


def _positive(
    density: UnconstrainedDensity, is_enough: Callable[[], bool]
) -> Iterator[tuple[np.ndarray, Values]]:
    """Where the density is positive, found among many: where it is nowhere so at the points before.

    Cutpoints that must be in order, say, hardly ever are by chance.
    """
    if is_enough():
        return
    elements = sum(math.prod(t.shape) for t in density.target.terms.values())
    count = min(_SEARCHED, max(_NUMBERS // max(elements, 1), 1))
    rng, found = np.random.default_rng(density.size), 0
    for k in range(_FOUND):
        values = other_values(density, k)
        u = rng.normal(size=(count, density.size)) * rng.choice(_SPREADS[1:], size=(count, 1))
        with np.errstate(all="ignore"):
            log = np.broadcast_to(density.value(u, values), (count,))
        for row in u[log > -np.inf][: _FOUND - found]:
            at = dict(values)
            if _completed(density, row, at):
                found += 1
                yield row, at


def _uphill(
    density: UnconstrainedDensity, is_enough: Callable[[], bool]
) -> Iterator[tuple[np.ndarray, Values]]:
    """Where climbs of the density end: far from zero, probabilities of what was seen may be none before.

    Probabilities that the model's functions round to 0 have logs in expressions that are written for free
    numbers far out, and these lead to where they are none too small.
    """
    rng = np.random.default_rng(density.size)
    for k in range(_FOUND):
        if is_enough():
            return
        values = other_values(density, k)

        def lost(u: np.ndarray, values: Values = values) -> tuple[float, np.ndarray]:
            with np.errstate(all="ignore"):
                log, slopes = density.with_gradient(u, values)
            return (-float(log), -slopes) if np.isfinite(log) else (_LOWEST, np.zeros(len(u)))

        start = rng.normal(size=density.size) * (k > 0)
        end = scipy.optimize.minimize(lost, start, jac=True, method="L-BFGS-B").x
        for u in (end, end + 0.1 * rng.normal(size=density.size)):
            at = dict(values)
            if np.isfinite(u).all() and _completed(density, u, at):
                yield u, at


def _completed(density: UnconstrainedDensity, u: np.ndarray, values: Values) -> bool:
    """Put values of the nodes that move beside the others; whether they can be."""
    values.update(density.constrain(u, values))
    try:
        with marking_invalid(), np.errstate(all="ignore"):
            density.target.compute(values, density.target.links)
    except BayesmcError:
        return False
    return True


def _own_log(density: UnconstrainedDensity, values: Values) -> float:
    """The model's own log density at a point; infinite where it cannot say."""
    try:
        with marking_invalid(), np.errstate(all="ignore"):
            log = float(density.target.log_density(values))
    except BayesmcError:
        return np.inf
    return np.inf if np.isnan(log) else log


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
    if found.shape != wanted.shape:
        raise UnsupportedError(
            f"of {term.name!r} {found.size} elements are counted in place of {wanted.size}"
        )
    finite = np.isfinite(wanted)
    with np.errstate(all="ignore"):
        near = np.abs(found - wanted) <= _RTOL * (1.0 + np.abs(wanted))
    agree = np.where(finite, near, ~np.isfinite(found))
    if agree.all():
        return bool(finite.any()) or not finite.size
    at = int(np.argmin(agree))
    raise UnsupportedError(
        f"what was read of {term.name!r} gives {found[at]:.9g} at element {at} of those that count, and its "
        f"function {wanted[at]:.9g}"
    )


def _is_written(plain: np.ndarray, used: np.ndarray) -> bool:
    """Whether all log factors agree that are finite as they are written, and some are."""
    finite = np.isfinite(plain)
    with np.errstate(all="ignore"):
        near = np.abs(used - plain) <= _WRITTEN * (1.0 + np.abs(plain))
    return bool(near[finite].all() and (finite.any() or not finite.size))


def _check_sum(
    density: UnconstrainedDensity, parts: Sequence[float], u: np.ndarray, values: Values
) -> None:
    """Refuse a function that gives something else than the sum of its parts, where that is finite.

    Raises
    ------
    UnsupportedError
    """
    wanted, found = sum(parts), float(density.value(u, values))
    size = 1.0 + sum(map(abs, parts))
    if np.isfinite(wanted) and not abs(found - wanted) <= _RTOL * size:
        raise UnsupportedError(
            f"the log density is {found:.9g}, and the sum of its terms {wanted:.9g}"
        )


def _check_tables(
    tables: Sequence[Summed], sums: Mapping[str, float], u: np.ndarray, values: Values
) -> None:
    """Refuse tables that give other sums than the terms at the states that nodes have.

    Raises
    ------
    UnsupportedError
    """
    for summed in tables:
        wanted = sum(sums[t.name] for t in summed.terms)
        roots = [summed.rest] if summed.table is None else [summed.rest, summed.table]
        rest, *table = Program(roots)({**values, FREE: u})
        shape = () if summed.table is None else summed.table.shape
        wide = np.broadcast_to(table[0], shape) if table else None
        found = summed.at(values, np.broadcast_to(rest, summed.rest.shape), wide)
        if np.isfinite(wanted) and not abs(found - wanted) <= _WRITTEN * (1.0 + abs(wanted)):
            names = ", ".join([*summed.labels, *summed.listed[0]])
            raise UnsupportedError(f"the sum over the states of {names} differs from its terms")
