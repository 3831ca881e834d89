"""Exact posteriors by brute force: every joint state of the hidden nodes, each with its weight.

Nodes are visited parents first, and every hidden scalar multiplies the list of configurations by its
states; continuous ones by the points of a quadrature rule in their own conditional distribution. It
shares with the engines how a net evaluates a node given its parents, and nothing else: no tables, no
factors, no elimination, no random numbers. It is slow, and refuses what it cannot enumerate.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.special

from bayesmc.distributions import Distribution, marking_invalid
from bayesmc.errors import (
    BudgetError,
    ParameterError,
    ShapeError,
    UnknownNodeError,
    UnsupportedError,
    ZeroProbabilityError,
)
from bayesmc.network import BayesNet, CompiledNode, Model, Observed, Problem, pose
from bayesmc.network.forward import refuse_bare
from bayesmc.randomness import seed_sequence
from bayesmc.results.statistics import circular_variance

#: normal scores between which a continuous node is integrated: 8e-11 of the mass lies outside
_REACH = 6.5


@dataclass(frozen=True, eq=False)
class Enumerated:
    """The posterior as weighted configurations.

    Attributes
    ----------
    model : Model
        Of the net that was asked.
    log_marginal_likelihood : float
        Log probability (density) of the evidence.
    weights : ndarray, shape (configurations,)
        Posterior probabilities of the configurations; they sum to 1.
    stored : dict
        Node -> stored values, shape ``(configurations, *plates, *event)``.
    accuracy : float
        Estimated error of log evidence and probabilities (in units of the standard deviation for
        means): 0 without quadrature, else the change from a coarser rule, which overstates it.
    names : tuple of str
        Nodes that can be asked about.
    """

    model: Model
    log_marginal_likelihood: float
    weights: np.ndarray
    stored: dict[str, np.ndarray]
    accuracy: float = 0.0

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(n for n in self.stored if self.model[n].kind != "input")

    def values(self, name: str) -> np.ndarray:
        """What functions receive of a node: ``(configurations, *plates, *event)``."""
        return self.model[name].decode(self._of(name))

    def sample(self, draws: int, rng: Any = None) -> dict[str, np.ndarray]:
        """Independent joint draws of all nodes, ``(draws, *plates, *event)``; labels as their positions.

        ``rng`` is a seed or generator.

        Raises
        ------
        UnsupportedError
            Where points of a quadrature rule stand for continuous values.
        """
        if self.accuracy:
            raise UnsupportedError(
                "an answer by quadrature has points and no draws of continuous nodes; draw with an engine"
            )
        generator = np.random.default_rng(seed_sequence(rng))
        at = generator.choice(len(self.weights), size=draws, p=self.weights / self.weights.sum())
        return {n: np.asarray(self.values(n)).view(np.ndarray)[at] for n in self.names}

    def probabilities(self, *names: str) -> np.ndarray:
        """Probabilities of the states, ``(*plates, states)``, or of several nodes jointly, whose plates
        lead in order of appearance and are shared by name."""
        nodes = [self.model[name] for name in names]
        plates = tuple(dict.fromkeys(p for node in nodes for p in node.plates))
        shape = tuple(self.model.sizes[p] for p in plates)
        out = np.zeros(shape + tuple(_states_of(node) for node in nodes))
        for at in np.ndindex(shape):
            picked = []
            for node in nodes:
                own = tuple(at[plates.index(p)] for p in node.plates)
                picked.append(self._of(node.name)[(slice(None), *own)].astype(int))
            np.add.at(out[at], tuple(picked), self.weights)
        return out

    def mean(self, name: str) -> np.ndarray:
        """Posterior mean of a numeric node, shape ``(*plates, *event)``; circular for angles."""
        mean = self.expectation(lambda x: x, name)
        angles = self.model[name].angles
        if angles is None:
            return mean
        turned = np.arctan2(self.expectation(np.sin, name), self.expectation(np.cos, name))
        return np.where(angles, turned, mean)

    def var(self, name: str) -> np.ndarray:
        """Posterior variance, shape ``(*plates, *event)``; for angles ``-2 log R``."""
        mean = self.expectation(lambda x: x, name)
        var = self.expectation(lambda x: (x - mean) ** 2, name)
        angles = self.model[name].angles
        if angles is None:
            return var
        turned = circular_variance(self.expectation(np.cos, name), self.expectation(np.sin, name))
        return np.where(angles, turned, var)

    def expectation(self, function: Callable[..., Any], *names: str) -> np.ndarray:
        """Posterior mean of a function of the named nodes, which keeps the leading axis."""
        result = np.asarray(function(*(self.values(n) for n in names)), dtype=float)
        return averaged(result, self.weights)

    def _of(self, name: str) -> np.ndarray:
        if name not in self.stored:
            raise UnknownNodeError(
                f"enumerated posterior: {name!r} is no node, or one with infinitely many values that "
                "nothing depends on and that was left out"
            )
        return self.stored[name]


def averaged(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Mean over the leading axis of what a user's function returned."""
    if values.shape[:1] != weights.shape:
        raise ShapeError(
            f"expectation: the function returned shape {values.shape} for {len(weights)} rows; keep the "
            "leading axis: one value for each row"
        )
    return np.tensordot(weights, values, axes=(0, 0))


def enumerate_posterior(
    net: BayesNet,
    evidence: Mapping[str, Any] | None = None,
    inputs: Mapping[str, Any] | None = None,
    *,
    points: int = 32,
    max_configurations: int = 1 << 20,
) -> Enumerated:
    """The posterior by enumerating all configurations of the hidden nodes.

    A hidden continuous scalar takes ``points`` values ``ppf(Phi(z))`` with ``z`` on an even grid over
    +-6.5, weighted by the normal density (the trapezoidal rule in normal scores, whose error falls
    exponentially for smooth integrands). With ``points=32`` log evidence and means are good to about
    1e-5 where the likelihood is no narrower than a third of the node's conditional distribution; the
    result's ``accuracy`` estimates it. Moments of heavy tails are cut at those scores.

    Hidden nodes that cannot be enumerated (infinitely many values, vectors) are left out where nothing
    observed and no potential depends on them, and refused elsewhere.

    Parameters
    ----------
    net : BayesNet
    evidence, inputs : dict, optional
        As for ``infer``.
    points : int
        Quadrature points of a continuous scalar, at least 8.
    max_configurations : int
        Refuse above this many.

    Raises
    ------
    UnsupportedError
        A hidden node has infinitely many values, or no quantile function.
    BudgetError
        Too many configurations.
    ZeroProbabilityError
        The evidence is impossible.
    ParameterError
        A node has bad parameters at a configuration of positive probability.

    References
    ----------
    Goodwin (1949), The evaluation of integrals of the form ..., Proc. Camb. Phil. Soc. 45.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.testing import enumerate_posterior
    >>> net = bmc.BayesNet()
    >>> net.add("x", bmc.Normal(0.0, 1.0))
    >>> net.add("y", lambda x: bmc.Normal(x, 1.0))
    >>> exact = enumerate_posterior(net, {"y": 1.0})
    >>> float(exact.mean("x").round(6)), float(exact.var("x").round(6))
    (0.5, 0.5)
    """
    if points < 8:
        raise ValueError(f"enumerate_posterior(points={points}): give at least 8")
    problem = pose(net, evidence, inputs)
    refuse_bare(problem.model, problem.observed, "enumerate_posterior")
    fine = _enumerate(problem, points, _REACH, max_configurations)
    if not fine.has_quadrature:
        return fine.result(0.0)
    coarse = _enumerate(problem, points // 2 + 2, _REACH - 1.0, max_configurations).result(0.0)
    result = fine.result(0.0)
    return fine.result(difference(result, coarse))


# ---- private ------------------------------------------------------------------------------------


class Configurations:
    """The list of configurations so far: their values and log weights."""

    def __init__(self, problem: Problem, limit: int) -> None:
        self.problem = problem
        self.model = problem.model
        self.limit = limit
        self.values: dict[str, np.ndarray] = {n: v[None] for n, v in problem.inputs.items()}
        self.log_weight = np.zeros(1)
        self.has_quadrature = False
        #: configurations at which a node had bad parameters, with what was wrong
        self.invalid = np.zeros(1, dtype=bool)
        self.problems: list[ParameterError] = []

    def full(self, name: str, value: np.ndarray) -> np.ndarray:
        """A stored value with the one batch axis."""
        return np.broadcast_to(value, (len(self.log_weight), *self.model[name].value_shape))

    def take(self, rows: np.ndarray) -> None:
        """Keep (or repeat) these configurations."""
        self.values = {n: v if len(v) == 1 else v[rows] for n, v in self.values.items()}
        self.log_weight = self.log_weight[rows]
        self.invalid = self.invalid[rows]

    def result(self, accuracy: float) -> Enumerated:
        total = scipy.special.logsumexp(self.log_weight) if len(self.log_weight) else -np.inf
        if total == -np.inf:
            raise ZeroProbabilityError("enumerate_posterior: the evidence has probability zero")
        if (self.invalid & (self.log_weight > -np.inf)).any():
            raise self.problems[0]
        self.take(np.flatnonzero(self.log_weight > -np.inf))
        stored = {n: self.full(n, v) for n, v in self.values.items()}
        weights = np.exp(self.log_weight - total)
        return Enumerated(self.model, float(total), weights, stored, accuracy)


def _enumerate(problem: Problem, points: int, reach: float, limit: int) -> Configurations:
    state = Configurations(problem, limit)
    left_out = _barren(problem)
    scores = np.linspace(-reach, reach, points)
    rule = np.exp(-0.5 * scores**2)
    grid = (scipy.special.ndtr(scores), np.log(rule / rule.sum()))
    with marking_invalid(), np.errstate(all="ignore"):
        for name, node in problem.model.nodes.items():
            if name in left_out or node.kind == "input":
                continue
            result, _ = problem.model.evaluate(name, state.values)
            if not isinstance(result, Distribution):
                state.values[name] = state.full(name, result)
                continue
            visit(state, node, result, problem.observed.get(name), grid)
        for name in problem.model.potentials:
            state.log_weight = state.log_weight + problem.model.potential(name, state.values)
    return state


def visit(
    state: Configurations,
    node: CompiledNode,
    dist: Distribution,
    seen: Observed | None,
    grid: tuple[np.ndarray, np.ndarray],
    weigh: bool = True,
) -> None:
    """Weigh by the observed elements of a node, multiply the configurations by its hidden ones."""
    count = len(state.log_weight)
    elements = int(np.prod(node.plate_shape, dtype=int))
    mask = np.zeros(elements, dtype=bool)
    known: Any = None
    if seen is not None:
        mask = np.ones(elements, dtype=bool) if seen.mask is None else seen.mask.ravel()
        known = seen.value.reshape(elements, *node.event_shape)
    _note_invalid(state, node, dist)
    if mask.any() and weigh:
        density = state.model.log_density(node.name, dist, seen.value)  # type: ignore[union-attr]
        density = np.broadcast_to(density, (count, *node.plate_shape)).reshape(count, elements)
        state.log_weight = state.log_weight + density[:, mask].sum(axis=1)
    columns: list[Any] = [known[e] if mask[e] else None for e in range(elements)]
    origin = np.arange(count)
    if not mask.all():
        options, log_probs = _options(state, node, dist, grid)
        for element in np.flatnonzero(~mask).tolist():
            origin, columns = _multiply(
                state, origin, columns, element, options[:, element], log_probs[:, element]
            )
    dtype = node.domain.dtype if node.domain is not None else None
    wide = [np.broadcast_to(c, (len(origin), *node.event_shape)) for c in columns]
    value = np.stack(wide, axis=1) if wide else np.zeros((len(origin), 0, *node.event_shape))
    value = value.reshape(len(origin), *node.value_shape).astype(dtype or value.dtype, copy=False)
    state.values[node.name] = value


def _multiply(
    state: Configurations,
    origin: np.ndarray,
    columns: list[Any],
    element: int,
    options: np.ndarray,
    log_probs: np.ndarray,
) -> tuple[np.ndarray, list[Any]]:
    """Every configuration once for every possible value of one element.

    ``options`` and ``log_probs`` have shape ``(configurations before this node, values)``.
    """
    extended = state.log_weight[:, None] + log_probs[origin]
    rows, picks = np.nonzero(extended > -np.inf)
    if len(rows) > state.limit:
        raise BudgetError(
            f"enumerate_posterior: more than {state.limit} configurations; observe more, use a smaller "
            "net, or raise max_configurations",
            8 * len(rows),
        )
    weights = extended[rows, picks]
    new = [c if c is None or np.ndim(c) == 0 else c[rows] for c in columns]
    new[element] = options[origin[rows], picks]
    state.take(rows)
    state.log_weight = weights
    return origin[rows], new


def _options(
    state: Configurations,
    node: CompiledNode,
    dist: Distribution,
    grid: tuple[np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Stored values and log probabilities of each hidden element, ``(configurations, elements, m)``."""
    if node.event_shape:
        raise UnsupportedError(
            f"enumerate_posterior: the hidden node {node.name!r} is a vector; observe it, or split it"
        )
    shape = (len(state.log_weight), *node.plate_shape)
    if dist.is_discrete:
        low, high = np.min(dist.support.low), np.max(dist.support.high)
        if not (np.isfinite(low) and np.isfinite(high)):
            raise UnsupportedError(
                f"enumerate_posterior: the hidden node {node.name!r} has infinitely many values "
                f"({dist.support.describe()}); observe it"
            )
        support = np.arange(int(low), int(high) + 1)
        logs = np.stack([np.broadcast_to(dist.log_prob(v), shape) for v in support], axis=-1)
        stored = node.domain.from_support(support) if node.domain is not None else support
        values = np.broadcast_to(stored, logs.shape)
    else:
        state.has_quadrature = True
        levels, log_rule = grid
        values = np.stack([np.broadcast_to(dist.ppf(u), shape) for u in levels], axis=-1)
        logs = np.broadcast_to(log_rule, values.shape)
    merged = (shape[0], -1, logs.shape[-1])
    return values.reshape(merged), logs.reshape(merged)


def _note_invalid(state: Configurations, node: CompiledNode, dist: Distribution) -> None:
    """Remember configurations with bad parameters: they are a fault only if they turn out possible."""
    if dist.invalid is None:
        return
    lead = (len(state.log_weight), *node.plate_shape)
    bad = np.broadcast_to(dist.invalid, lead).reshape(lead[0], -1).any(axis=1)
    state.invalid = state.invalid | bad
    state.problems.append(ParameterError(f"node {node.name!r}: {dist.problem}"))


def _barren(problem: Problem) -> set[str]:
    """Hidden nodes that cannot be enumerated and that no evidence or potential depends on, with all that
    is computed or drawn from them (Shachter 1986)."""
    model = problem.model
    needed = set(problem.observed)
    needed |= {p for potential, _ in model.potentials.values() for p in potential.parents}
    for name in reversed(model.nodes):
        if name in needed:
            needed |= set(model[name].parents)
    left_out: set[str] = set()
    for name, node in model.nodes.items():
        infinite = (
            node.is_stochastic
            and node.domain is None
            and (bool(node.event_shape) or (node.is_discrete and _is_infinite(node)))
        )
        if name not in needed and (infinite or left_out & set(node.parents)):
            left_out.add(name)
    return left_out


def _is_infinite(node: CompiledNode) -> bool:
    return node.support is not None and node.support.size is None


def _states_of(node: CompiledNode) -> int:
    if node.domain is None:
        raise UnsupportedError(
            f"probabilities({node.name!r}): the node has no finite set of states"
        )
    return node.domain.size


def difference(fine: Enumerated, coarse: Enumerated, without: Collection[str] = ()) -> float:
    """Largest change of log evidence, probabilities, and means in standard deviations, over all nodes but
    those ``without``."""
    changes = [abs(fine.log_marginal_likelihood - coarse.log_marginal_likelihood)]
    for name in (n for n in fine.names if n not in without):
        node = fine.model[name]
        if node.domain is not None:
            change = np.abs(fine.probabilities(name) - coarse.probabilities(name))
        else:
            spread = np.sqrt(np.maximum(fine.var(name), 1e-300))
            change = np.abs(fine.mean(name) - coarse.mean(name)) / np.maximum(spread, 1e-9)
        changes.append(float(change.max(initial=0.0)))
    return max(changes)
