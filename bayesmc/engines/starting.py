"""Where chains start: forward draws given the evidence, the most likely of several attempts.

Vague priors put most draws where the evidence is as good as impossible, so some attempts are drawn closer
to the prior mean.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.distributions.transforms import transform_of
from bayesmc.errors import BayesmcError, ParameterError, UnsupportedError, ZeroProbabilityError
from bayesmc.kernels.enumerate import draw_states
from bayesmc.kernels.slice import is_half_line
from bayesmc.network import CompiledNode
from bayesmc.shapes import Shape
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Target, Values

#: how far draws go from the prior mean, for successive attempts
_SPREADS = (1.0, 0.3, 0.1, 0.03, 0.01, 1e-3, 1e-4, 0.0)
_ATTEMPTS = 8
#: numbers of one node drawn at once, at most, where possible states are rare
_MOST = 1 << 19
#: the most that draws of a half line go from the middle
_FROM_ZERO = 0.9
#: supports that hold every point between two of theirs
_CONVEX = ("real", "interval", "simplex", "real vector", "positive definite", "product")


def start_states(target: Target, chains: int, rng: np.random.Generator) -> Values:
    """Stored values of all nodes, one state of positive density per chain.

    Raises
    ------
    ZeroProbabilityError
        None was found; the message names the term that no attempt could satisfy.
    """
    search = _Search(target, chains, rng)
    continuous = any(not target.model[n].is_discrete for n in target.chain)
    for spread in _SPREADS:
        search.attempt(spread, _ATTEMPTS)
        if search.complete and not continuous:
            break
    largest = max((math.prod(target.model[n].value_shape) for n in target.chain), default=1)
    attempts = _ATTEMPTS
    while not search.complete and attempts * chains * largest <= _MOST:
        attempts *= 8
        search.attempt(1.0, attempts)
    return {**target.known, **search.found()}


class _Search:
    """The best start state of every chain so far."""

    def __init__(self, target: Target, chains: int, rng: np.random.Generator) -> None:
        self.target, self.chains, self.rng = target, chains, rng
        self.best: Values = {}
        self.log = np.full(chains, -np.inf)
        self.attempts = 0
        self.culprits: dict[str, int] = {}
        self.failure: BayesmcError | None = None

    @property
    def complete(self) -> bool:
        return bool((self.log > -np.inf).all())

    def attempt(self, spread: float, attempts: int) -> None:
        """Some more draws, which replace what is much less likely."""
        self.attempts += attempts
        try:
            values, log = _attempt(
                self.target, self.chains * attempts, spread, self.rng, self.culprits
            )
        except ParameterError as error:
            self.failure = error
            return
        log = np.where(np.isnan(log), -np.inf, log).reshape(attempts, self.chains)
        pick = log.argmax(axis=0), np.arange(self.chains)
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
        if not len(alive):
            if self.failure is not None and not self.culprits:
                raise self.failure
            raise _impossible(self.culprits, self.attempts)
        rows = np.arange(self.chains)
        rows[self.log == -np.inf] = self.rng.choice(alive, int((self.log == -np.inf).sum()))
        return {n: v[rows] for n, v in self.best.items()}


# ---- private ------------------------------------------------------------------------------------


def _attempt(
    target: Target,
    count: int,
    spread: float,
    rng: np.random.Generator,
    culprits: dict[str, int],
) -> tuple[Values, np.ndarray]:
    """Forward draws of the chain's nodes, and the log density of what was seen given them."""
    model = target.model
    values: Values = dict(target.known)
    log = np.zeros(count)
    inside = set(target.chain)
    for name in model.nodes:
        if name in inside:
            value = _drawn(target, model[name], values, count, spread, rng)
            seen = target.seen(name)
            if seen is not None:
                assert seen.mask is not None
                mask = seen.mask.reshape(seen.mask.shape + (1,) * len(model[name].event_shape))
                value = np.where(mask, seen.value, value)
            values[name] = value
        elif name in target.links:
            computed, _ = model.evaluate(name, values)
            shape = (count, *model[name].value_shape)
            values[name] = np.array(np.broadcast_to(computed, shape))
    for term in target.terms.values():
        if term.name in inside and target.seen(term.name) is None:
            continue
        part = np.asarray(term.log(values))
        lead = part.shape[: part.ndim - len(term.shape)]
        part = np.broadcast_to(part, lead + term.shape)
        log = log + part.sum(axis=tuple(range(len(lead), part.ndim)))
        if not (log > -np.inf).any():
            culprits[term.name] = culprits.get(term.name, 0) + 1
            break
    chosen = {n: v for n, v in values.items() if n in inside or n in target.links}
    return chosen, log


def _drawn(
    target: Target,
    node: CompiledNode,
    values: Values,
    count: int,
    spread: float,
    rng: np.random.Generator,
) -> np.ndarray:
    if node.name not in target.terms:
        log = _alone(target, node, values, count)
        if log is None:
            return _of_support(node, count, rng)
        return draw_states(log, rng, node.name).astype(node.domain.dtype)  # type: ignore[union-attr]
    dist, _ = target.model.evaluate(node.name, values)
    try:
        draws = target.model.sample_stored(node.name, dist, rng, (count,))
    except UnsupportedError:
        return _of_support(node, count, rng)
    if node.domain is not None or node.is_discrete:
        return draws
    return _shrunk(dist, draws, spread, (count, *node.value_shape), len(node.event_shape))


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


def _shrunk(
    dist: Distribution, draws: np.ndarray, spread: float, shape: Shape, event_ndim: int
) -> np.ndarray:
    """Draws moved towards the middle of the prior, where the support holds what lies between."""
    if dist.support.kind not in _CONVEX:
        return draws
    half_line = dist.support.kind == "interval" and is_half_line(dist.support)
    if half_line:  # a vague scale is drawn at 1e-200 as likely as not, and a chain never comes back
        spread = min(spread, _FROM_ZERO)
    if spread == 1.0:
        return draws
    middle = _middle(dist, shape, half_line)
    axes = tuple(range(len(shape) - event_ndim, len(shape)))
    fine = np.isfinite(middle).all(axis=axes, keepdims=True)
    moved = middle + max(spread, 1e-9) * (np.where(np.isfinite(draws), draws, middle) - middle)
    return np.where(fine, moved, draws)


def _middle(dist: Distribution, shape: Shape, half_line: bool) -> np.ndarray:
    """The prior mean, else the median, else one above a half line's end; NaN where nothing is known."""
    found = np.full(shape, dist.support.low + 1.0 if half_line else np.nan)
    for question in (lambda: dist.ppf(0.5), lambda: dist.mean):
        try:
            answer = np.broadcast_to(question(), shape)
        except (UnsupportedError, ValueError):
            continue
        sane = np.isfinite(answer)
        if half_line:
            sane &= (answer < 1e10) & (answer > 1e-10)
        found = np.where(sane, answer, found)
    return found


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


def _impossible(culprits: dict[str, int], attempts: int) -> ZeroProbabilityError:
    names: Sequence[str] = sorted(culprits, key=lambda n: -culprits[n])
    what = f"the term of {names[0]!r} has probability zero" if names else "some term is impossible"
    return ZeroProbabilityError(
        f"no start state of positive density in {attempts} attempts per chain: {what} in all of them; "
        "check that evidence, or give LikelihoodWeighting or Exact a try"
    )
