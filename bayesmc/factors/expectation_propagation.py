"""Expectation propagation: the one loop. Factors and messages say what is done, nothing here knows of what.

A product of factors over variables is approximated by a product of messages, one from every factor to every
variable in its scope. A visit takes the factor's own messages out of the beliefs about its variables (what is
left are the cavities), multiplies the factor itself in, keeps the moments of the result for each variable,
and divides the cavity out again: that is the new message. Quotients need not have a finite integral, and a
factor may have none with its cavities: then the messages that other factors have sent since it last had one
are taken back, half-way and again (a line search), and where that does not help its own are left as they are.
Both are counted.

References
----------
Minka (2001), Expectation propagation for approximate Bayesian inference; Heskes and Zoeter (2002),
Expectation propagation for approximate inference in dynamic Bayesian networks; Minka (2004), Power EP, of the
evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple, Protocol

import numpy as np

from bayesmc.factors.messages import Message


class Tilted(NamedTuple):
    """A factor times the cavities of its variables.

    Attributes
    ----------
    log : ndarray, shape lead
        Log of the integral; NaN where it is not finite or not positive.
    beliefs : sequence of Message
        With its moments, one for each variable asked for; anything where there is no integral.
    """

    log: np.ndarray
    beliefs: Sequence[Message]


class Factor(Protocol):
    """What the loop asks of a factor."""

    @property
    def scope(self) -> tuple[int, ...]:
        """Places of its variables."""

    def tilted(self, cavities: Sequence[Any], ends: Sequence[int]) -> Tilted:
        """The factor times cavities, one for each of its variables, and the moments of some of them."""


class Visit(NamedTuple):
    """A factor whose messages to some of its variables, by their places in the scope, are made anew."""

    factor: int
    ends: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Propagated:
    """Where the loop ended.

    Attributes
    ----------
    beliefs : list of Message
        One for each variable, normalised.
    cavities : list of list of Message
        For every factor and variable of its scope, the product of all other messages to it.
    logs : ndarray, shape (factors, *lead)
        Logs of the integrals of the factors times their cavities; NaN where those are not finite.
    totals : ndarray, shape (variables, *lead)
        Logs of the integrals of the products of messages, before they were normalised.
    sweeps : int
    change : ndarray, shape lead
        By how much the belief that changed most did so in the last sweep (``Message.distance``).
    skipped : ndarray of int, shape lead
        Improper messages that were left out or taken back in part, in all sweeps.
    open : ndarray of int, shape lead
        Those of the last sweep.
    damping : ndarray, shape lead
        In the last sweep.
    converged : ndarray of bool, shape lead
        Whether the last sweep changed no belief by more than the tolerance, and left nothing out.
    """

    beliefs: list[Any]
    cavities: list[list[Any]]
    logs: np.ndarray
    totals: np.ndarray
    sweeps: int
    change: np.ndarray
    skipped: np.ndarray
    open: np.ndarray
    damping: np.ndarray
    converged: np.ndarray

    def log_total(self, factors: Sequence[Factor]) -> np.ndarray:
        """Log of the integral of the product of all factors, approximately, shape lead.

        Every factor stands for its messages, times its integral with its cavities over those of the beliefs
        about its variables (Minka 2004).
        """
        degree = np.zeros(len(self.beliefs), dtype=int)
        for factor in factors:
            for place in factor.scope:
                degree[place] += 1
        return self.logs.sum(axis=0) + np.tensordot(1 - degree, self.totals, axes=1)


def propagate(
    priors: Sequence[Any],
    factors: Sequence[Factor],
    sites: Sequence[Sequence[Any]],
    visits: Sequence[Visit],
    *,
    sweeps: int,
    damping: float | None = 0.0,
    tolerance: float = 1e-6,
    advance: Callable[[], None] | None = None,
) -> Propagated:
    """Pass messages until beliefs no longer change.

    Parameters
    ----------
    priors : sequence of Message
        One for each variable: factors of it alone that are in the family, and never approximated.
    factors : sequence of Factor
    sites : sequence of sequences of Message
        For every factor the messages that it starts with; with them all beliefs are proper.
    visits : sequence of Visit
        One sweep.
    sweeps : int
        At most so many.
    damping : float or None
        Share of the old message that is kept, in natural parameters; 0 keeps none. With None it begins with
        little, and grows for each problem by itself while that does not come closer.
    tolerance : float
        See ``Propagated.converged``; of a damped sweep its share, as the rest of the way is still ahead.
    advance : callable, optional
        Called after every sweep.

    Examples
    --------
    Two tables in a row are a tree, where messages are exact.

    >>> import numpy as np
    >>> from bayesmc.factors.expectation_propagation import Tilted, Visit, propagate
    >>> from bayesmc.factors.messages import ConditionalGaussian
    >>> def table(log):
    ...     return ConditionalGaussian(log, np.zeros((2, 0)), np.zeros((2, 0, 0)))
    >>> class Pair:
    ...     def __init__(self, scope, table):
    ...         self.scope, self.table = scope, table
    ...     def tilted(self, cavities, ends):
    ...         joint = self.table * np.exp(cavities[0].log[:, None] + cavities[1].log)
    ...         sums = [table(np.log(joint.sum(axis=1 - end))) for end in ends]
    ...         return Tilted(np.log(joint.sum()), sums)
    >>> one = ConditionalGaussian.ones(2, (), 0)
    >>> pairs = [Pair((0, 1), np.array([[1.0, 2.0], [3.0, 1.0]])),
    ...          Pair((1, 2), np.array([[5.0, 1.0], [1.0, 1.0]]))]
    >>> visits = [Visit(0, (0, 1)), Visit(1, (0, 1))]
    >>> found = propagate([one] * 3, pairs, [[one, one]] * 2, visits, sweeps=5)
    >>> bool(found.converged), np.exp(found.beliefs[0].log).round(6).tolist()
    (True, [0.333333, 0.666667])
    >>> float(np.exp(found.log_total(pairs)).round(6))  # 4 * 6 + 3 * 2
    30.0
    """
    state = _State(priors, factors, [list(s) for s in sites])
    lead = np.shape(state.beliefs[0].log_total)
    pace = _Pace.of(lead, damping)
    skipped = out = np.zeros(lead, dtype=int)
    change, done = np.full(lead, np.inf), 0
    rests = np.zeros(lead, dtype=bool)
    while done < sweeps and not rests.all():
        before, out = list(state.beliefs), np.zeros(lead, dtype=int)
        state.share = pace.share
        for visit in visits:
            out = out + state.visited(visit)
        moved = [b.distance(a) for a, b in zip(before, state.beliefs, strict=True)]
        change, skipped, done = np.max(moved, axis=0), skipped + out, done + 1
        rests = change <= tolerance * state.share
        if pace.grows:  # what is left out may be in place once steps are shorter
            rests &= (out == 0) | (state.share <= _LEAST)
            pace = pace.after(change, out)
        if advance is not None:
            advance()
    totals = state.normalise()
    cavities = [state.cavities(f) for f in range(len(factors))]
    logs = [f.tilted(c, ()).log for f, c in zip(factors, cavities, strict=True)]
    settled = (change <= tolerance * state.share) & (out == 0)
    beliefs = [b.normalised() for b in state.beliefs]
    return Propagated(
        beliefs, cavities, np.reshape(logs, (len(factors), *lead)), totals,
        done, change, skipped, out, 1.0 - state.share, settled,
    )  # fmt: skip


# ---- private ------------------------------------------------------------------------------------


#: sweeps that are looked back over; rises of the change in them from which on it goes to and fro
_PATIENCE, _RISES = 8, 3
#: what becomes of the share where changes grow, or go to and fro and do not halve; and where none rises
_CUT, _GROWN, _LEAST = 0.5, 1.25, 0.02
#: share of the new message that a search for damping begins with
_BOLD = 0.8
#: times that messages are taken back half-way, before all of the way
_HALVED = 4


@dataclass(frozen=True, eq=False)
class _Pace:
    """Which share of new messages is taken, problem by problem.

    Attributes
    ----------
    share : ndarray, shape lead
    grows : bool
        Whether damping grows while changes do not get smaller.
    since : ndarray of int, shape lead
        Sweeps since the share changed.
    history : tuple of ndarray
        The last changes.
    """

    share: np.ndarray
    grows: bool
    since: np.ndarray
    history: tuple[np.ndarray, ...] = ()

    @classmethod
    def of(cls, lead: tuple[int, ...], damping: float | None) -> _Pace:
        share = _BOLD if damping is None else 1.0 - damping
        return cls(np.full(lead, share), damping is None, np.zeros(lead, dtype=int))

    def after(self, change: np.ndarray, out: np.ndarray) -> _Pace:
        """With what a sweep did."""
        history = (*self.history, np.where(out > 0, np.inf, change))[-1 - _PATIENCE :]
        since = self.since + 1
        ready = since > _PATIENCE
        rises = sum(np.greater(b, a) | ~np.isfinite(b) for a, b in pairwise(history))
        ratio = history[-1] > 0.5 * history[0]
        worse = ~(history[-1] < history[0]) | (ratio & (rises >= _RISES))
        share = np.where(worse, _CUT, np.where(rises == 0, _GROWN, 1.0)) * self.share
        share = np.minimum(share, 1.0)
        share = np.where(ready, np.maximum(share, _LEAST), self.share)
        return _Pace(share, True, np.where(ready, 0, since), history)


class _State:
    """Messages, and the beliefs that they make."""

    def __init__(
        self, priors: Sequence[Any], factors: Sequence[Factor], sites: list[list[Any]]
    ) -> None:
        self.priors, self.factors, self.sites = priors, factors, sites
        self.share: np.ndarray = np.ones(())
        self.around: list[list[tuple[int, int]]] = [[] for _ in priors]
        for f, factor in enumerate(factors):
            for end, place in enumerate(factor.scope):
                self.around[place].append((f, end))
        self.beliefs = [self._product(place, None) for place in range(len(priors))]
        #: for every factor the messages of others with which it last had an integral
        self.fine = [
            {at: sites[at[0]][at[1]] for at in self._others(f)} for f in range(len(factors))
        ]

    def visited(self, visit: Visit) -> np.ndarray:
        """How many messages were left out or taken back, shape lead."""
        factor, own = self.factors[visit.factor], self.sites[visit.factor]
        cavities = self.cavities(visit.factor)
        found = factor.tilted(cavities, visit.ends)
        fine = np.isfinite(found.log)
        out = np.where(fine, 0, len(visit.ends))
        for halved in range(_HALVED + 1):
            if fine.all() or not self.fine[visit.factor]:
                break
            self._take_back(visit.factor, fine, 0.5 if halved < _HALVED else 0.0)
            cavities = self.cavities(visit.factor)
            found = factor.tilted(cavities, visit.ends)
            fine = np.isfinite(found.log)
        for at, last in self.fine[visit.factor].items():
            self.fine[visit.factor][at] = self.sites[at[0]][at[1]].where(fine, last)
        if not fine.any():
            return out
        for end, belief in zip(visit.ends, found.beliefs, strict=True):
            new = own[end].towards(belief.over(cavities[end], own[end]), self.share)
            belief = cavities[end].times(new.where(fine, own[end]))
            proper = fine & np.isfinite(belief.log_total)
            if not proper.all():
                out = out + (fine & ~proper)
                new = new.where(proper, own[end])
                belief = cavities[end].times(new)
            own[end], self.beliefs[factor.scope[end]] = new, belief
        return out

    def normalise(self) -> np.ndarray:
        """Have messages integrate to 1 where they have an integral; logs of their products' integrals."""
        self.sites = [[site.normalised() for site in own] for own in self.sites]
        self.beliefs = [self._product(place, None) for place in range(len(self.priors))]
        return np.array([b.log_total for b in self.beliefs])

    def cavities(self, f: int) -> list[Any]:
        """Of a factor, without its own messages."""
        return [self._product(place, (f, end)) for end, place in enumerate(self.factors[f].scope)]

    def _take_back(self, f: int, fine: np.ndarray, share: float) -> None:
        """Have others' messages go back towards those with which a factor last had an integral."""
        for (g, end), last in self.fine[f].items():
            now = self.sites[g][end]
            if now is last:
                continue
            back = last.towards(now, np.full(np.shape(fine), share)) if share else last
            self.sites[g][end] = now.where(fine, back)
        for place in self.factors[f].scope:
            self.beliefs[place] = self._product(place, None)

    def _others(self, f: int) -> list[tuple[int, int]]:
        """Messages of other factors to the variables of one."""
        return [at for place in self.factors[f].scope for at in self.around[place] if at[0] != f]

    def _product(self, place: int, without: tuple[int, int] | None) -> Any:
        """Of a variable's messages but one: nothing is divided out, so large messages hide no small ones."""
        found = self.priors[place]
        for f, end in self.around[place]:
            if (f, end) != without:
                found = found.times(self.sites[f][end])
        return found
