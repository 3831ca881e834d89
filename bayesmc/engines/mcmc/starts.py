"""Where chains start: forward draws given the evidence, the most likely of several attempts.

Vague priors put most draws where the evidence is as good as impossible, so some attempts are drawn closer
to the prior mean; where none has positive density, free numbers are moved until one has (``climbing``). What
no hidden node can make possible is named at once, and so is the element of a term that stands in the way.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

import numpy as np

from bayesmc.categorical import pick_log
from bayesmc.distributions.transforms import transform_of
from bayesmc.engines.mcmc.climbing import MOST_NUMBERS, Climb, in_order, largest_term, row_logs
from bayesmc.engines.mcmc.labelled import Labels, relabelled
from bayesmc.errors import (
    BayesmcError,
    DensityError,
    ParameterError,
    UnsupportedError,
    ZeroProbabilityError,
)
from bayesmc.network import CompiledNode
from bayesmc.network.model import invalid_error
from bayesmc.network.probing import nearer
from bayesmc.shapes import Shape, first_index
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Target, Term, Values

#: how far draws go from the prior mean, for successive attempts
_SPREADS = (1.0, 0.3, 0.1, 0.03, 0.01, 1e-3, 1e-4, 0.0)
_ATTEMPTS = 8
#: how many times as many where some labels are known
_LOOKED = 8
#: power of the likelihood by which one of several attempts is drawn
_TEMPERED = 0.25
#: numbers of one node drawn in all attempts, at most, where possible states are rare
_MOST = 1 << 19
#: chains that search for themselves; others start where one of them does
_SEARCHERS = 8


def start_states(
    target: Target,
    chains: int,
    rng: np.random.Generator,
    given: Values | None = None,
    search: bool = True,
) -> Values:
    """Stored values of all nodes, one state of positive density per chain.

    Parameters
    ----------
    given : dict, optional
        Stored values at which some nodes of the chain start, shape ``(chains, *plates, *event)``.
    search : bool
        Whether to go on where draws find nothing.

    Raises
    ------
    ZeroProbabilityError
        None was found; the message names the term that no attempt could satisfy.
    ParameterError, DensityError
        Parameters are out of range, or a density is NaN, wherever it was tried.
    """
    found = _Search(target, chains, rng, given or {})
    continuous = any(not target.model[n].is_discrete for n in target.chain)
    # a start that known labels agree with is worth looking for
    some_labels = any(target.seen(n) and target.model[n].domain for n in target.chain)
    for spread in _SPREADS:
        found.attempt(spread, _ATTEMPTS * (_LOOKED if some_labels and spread == 1.0 else 1))
        if found.complete and not continuous:
            break
        if spread == 1.0 and not found.alive:
            refuse_impossible(target, found.tried, found.given)
            found.ask_for_labels()
    free = [n for n in target.chain if n not in found.given]
    moves = any(target.model[n].domain is None for n in free)  # numbers and counts
    if search and moves and not found.alive:
        found.climb()
    largest = max((math.prod(target.model[n].value_shape) for n in target.chain), default=1)
    attempts = _ATTEMPTS
    while not found.complete and free and attempts * chains * largest <= _MOST:
        attempts *= 8
        found.attempt(1.0, attempts)
    return {**target.known, **found.found()}


class _Search:
    """The best start state of every chain so far."""

    def __init__(
        self, target: Target, chains: int, rng: np.random.Generator, given: Values
    ) -> None:
        self.target, self.chains, self.rng, self.given = target, chains, rng, given
        self.best: Values = {}
        self.log = np.full(chains, -np.inf)
        self.attempts = 0
        self.culprits: dict[str, int] = {}
        self.failure: BayesmcError | None = None
        #: some states, whatever their density, and the best of those that were searched for
        self.tried: Values = {}
        self.nearest: Values = {}
        #: hidden labels, where they are drawn given all else
        self.labels: Labels | None = None

    @property
    def complete(self) -> bool:
        return bool((self.log > -np.inf).all())

    @property
    def alive(self) -> bool:
        return bool((self.log > -np.inf).any())

    def attempt(self, spread: float, attempts: int) -> None:
        """Some more draws, which replace what is much less likely."""
        room = max(MOST_NUMBERS // (largest_term(self.target) * self.chains), 1)
        while attempts > 0:
            self._attempt(spread, min(attempts, max(room, _ATTEMPTS)))
            attempts -= max(room, _ATTEMPTS)

    def ask_for_labels(self) -> None:
        """From now on labels are drawn given all else: forward draws of all of them were impossible."""
        labels = Labels(self.target, self.given)
        if labels:
            self.labels = labels
            self.attempt(1.0, _ATTEMPTS)

    def climb(self) -> None:
        """Free numbers moved uphill, for some chains."""
        rows = min(self.chains, _SEARCHERS)
        given = {n: v[:rows] for n, v in self.given.items()}

        def draw(count: int) -> Values:
            spread = float(self.rng.choice(_SPREADS))
            filled = {n: np.repeat(v, count // rows, axis=0) for n, v in given.items()}
            drawn = _drawn_all(self.target, count, spread, self.rng, filled)[0]
            if self.labels is not None:
                self.labels.draw(drawn, self.rng)
            return drawn

        try:
            values, scores = Climb(self.target, given, rows, self.rng, draw).climbed()
        except ParameterError as error:
            self.failure = error
            return
        order = np.argsort(scores.lost, kind="stable")
        self.nearest = {n: v[order[:1]] for n, v in values.items()}
        rows_of = np.resize(np.arange(rows), self.chains)
        self.best = {n: v[rows_of] for n, v in values.items()}
        self.log = np.where(scores.lost == 0, scores.log, -np.inf)[rows_of]

    def _attempt(self, spread: float, attempts: int) -> None:
        self.attempts += attempts
        given = {n: np.tile(v, (attempts,) + (1,) * (v.ndim - 1)) for n, v in self.given.items()}
        try:
            values, log, is_told = _attempt(
                self.target,
                self.chains * attempts,
                spread,
                self.rng,
                self.culprits,
                given,
                self.labels,
            )
        except ParameterError as error:
            self.failure = error
            return
        self.tried = self.tried or values
        log = np.where(np.isnan(log), -np.inf, log).reshape(attempts, self.chains)
        # a power of the likelihood as weight: starts as wide as the posterior, or wider; but what is to go
        # with a start that the user gave goes with it as well as it can
        power = 1.0 if is_told else _TEMPERED  # few labels are known, and starts are wide anyhow
        key = log if self.given else power * log + self.rng.gumbel(size=log.shape)
        pick = key.argmax(axis=0), np.arange(self.chains)
        # closer to the prior mean only where that helps a lot: starts ought to differ
        better = log[pick] > self.log + (10.0 if self.best else 0.0)
        for name, value in values.items():
            rows = value.reshape(attempts, self.chains, *value.shape[1:])[pick]
            if name in self.best:
                at = better.reshape((-1,) + (1,) * (rows.ndim - 1))
                rows = np.where(at, rows, self.best[name])
            self.best[name] = rows
        self.log = np.where(better, log[pick], self.log)

    def found(self) -> Values:
        """The states; a chain that found none starts where another does."""
        alive = np.flatnonzero(self.log > -np.inf)
        whole = bool(self.given) and set(self.given) >= set(self.target.chain)
        if not len(alive) or (whole and len(alive) < self.chains):
            raise self._fault()
        rows = np.arange(self.chains)
        rows[self.log == -np.inf] = self.rng.choice(alive, int((self.log == -np.inf).sum()))
        return {n: v[rows] for n, v in self.best.items()}

    def _fault(self) -> BayesmcError:
        """What stands in the way, at the nearest state that was found."""
        if self.failure is not None and not self.culprits:
            return self.failure
        at = int(np.argmin(self.log))
        nearest = self.nearest or {n: v[at : at + 1] for n, v in self.best.items()}
        if nearest:
            fault = fault_at(self.target, {**self.target.known, **nearest}, self.attempts)
            if fault is not None:
                return fault
        return impossible(self.culprits, self.attempts)


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
        nodes = [target.model[n] for n in above]
        if any(n.name in given or n.is_discrete or n.domain is not None for n in nodes):
            continue  # another value, or a state or count that was not drawn, may allow it
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


def _attempt(
    target: Target,
    count: int,
    spread: float,
    rng: np.random.Generator,
    culprits: dict[str, int],
    given: Values,
    labels: Labels | None = None,
) -> tuple[Values, np.ndarray, bool]:
    """Forward draws of the chain's nodes, and the log density of what was seen given them.

    And whether that is of known labels alone, where others are missing.
    """
    values, undefined, elsewhere = _drawn_all(target, count, spread, rng, given)
    log, told = np.zeros(count), set[str]()
    for name in target.chain:
        if target.seen(name) is not None and name not in given:
            found = relabelled(target, name, values, rng)
            if found is not None:
                log, told = log + found[1], told | found[0]
    if labels is not None:
        labels.draw(values, rng)
    for name, wrong in undefined.items():
        log = np.where(wrong, -np.inf, log)
        if wrong.all():
            culprits[name] = culprits.get(name, 0) + 1
    inside = set(target.chain)
    for term in target.terms.values():
        is_drawn = term.name in inside and target.seen(term.name) is None and term.name not in given
        is_drawn = is_drawn and term.name not in elsewhere
        if is_drawn and labels is None:
            continue
        part = row_logs(term, values, count)
        part = part.sum(axis=tuple(range(1, part.ndim)))
        is_counted = is_drawn or term.name in told
        log = np.where(part > -np.inf, log, -np.inf) if is_counted else log + part
        if not (log > -np.inf).any():
            culprits[term.name] = culprits.get(term.name, 0) + 1
            break
    inside |= set(target.links)
    chosen = {n: v for n, v in values.items() if n in inside}
    return chosen, log, bool(told)


def _drawn_all(
    target: Target, count: int, spread: float, rng: np.random.Generator, given: Values
) -> tuple[Values, dict[str, np.ndarray], set[str]]:
    """Values of all nodes: forward draws of the chain's, and what follows from them.

    With them, by node, the draws whose own parameters are out of range, shape ``(count,)``; and nodes that
    are not drawn from their own density, which may be zero there.
    """
    undefined, elsewhere = dict[str, np.ndarray](), set[str]()

    def value(node: CompiledNode, values: Values) -> np.ndarray:
        if node.name in given:
            return given[node.name]
        drawn = _drawn(target, node, values, count, spread, rng, undefined)
        if drawn is None:
            elsewhere.add(node.name)
        return _of_support(node, count, rng) if drawn is None else drawn

    return in_order(target, count, value), undefined, elsewhere


def _drawn(
    target: Target,
    node: CompiledNode,
    values: Values,
    count: int,
    spread: float,
    rng: np.random.Generator,
    undefined: dict[str, np.ndarray],
) -> np.ndarray | None:
    """Draws of one node; None where its density cannot be drawn from."""
    if node.name not in target.terms:
        log = _alone(target, node, values, count)
        if log is None:
            return None
        assert node.domain is not None
        states = pick_log(log, rng.random(log.shape[1:]), f"node {node.name!r}")
        return states.astype(node.domain.dtype)
    dist, _ = target.model.evaluate(node.name, values)
    if dist.invalid is not None:
        wrong = np.broadcast_to(dist.invalid, (count, *node.plate_shape)).reshape(count, -1)
        undefined[node.name] = np.asarray(wrong.any(axis=1))
    try:
        draws = target.model.sample_stored(node.name, dist, rng, (count,))
    except UnsupportedError:
        return None
    if node.domain is not None or node.is_discrete:
        return draws
    return nearer(dist, draws, spread, (count, *node.value_shape), len(node.event_shape))


def _alone(target: Target, node: CompiledNode, values: Values, count: int) -> np.ndarray | None:
    """What factors of a finite variable alone say of its states, shape ``(states, count, *plates)``."""
    if node.domain is None:
        return None
    blanket = Blanket(target, node.name)
    state = {**target.known}
    log: np.ndarray = np.zeros((node.domain.size, 1, *(1 for _ in node.plates)))
    states = np.arange(node.domain.size, dtype=node.domain.dtype).reshape(log.shape)
    state[node.name] = np.broadcast_to(states, (node.domain.size, 1, *node.plate_shape))
    found = False
    for child in blanket.children:
        rows = len(child.relation.rows)
        if set(child.term.scope) <= {node.name, *target.known} and rows <= 1:
            log = log + blanket.child_log(child, state)
            found = True
    return np.broadcast_to(log, (node.domain.size, count, *node.plate_shape)) if found else None


def _of_support(node: CompiledNode, count: int, rng: np.random.Generator) -> np.ndarray:
    """Values of a node that has no sampler: uniform over states, else near the middle of the free scale."""
    shape = (count, *node.value_shape)
    if node.domain is not None:
        return rng.integers(node.domain.size, size=shape).astype(node.domain.dtype)
    assert node.support is not None
    if node.support.is_discrete:
        low = node.support.low if np.all(np.isfinite(node.support.low)) else 0
        return np.broadcast_to(np.asarray(low) + rng.integers(0, 3, size=shape), shape).copy()
    transform = transform_of(node.support, node.event_shape)
    free = rng.normal(size=(count, *node.plate_shape, *transform.unconstrained_shape))
    return transform.constrain(free)


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
