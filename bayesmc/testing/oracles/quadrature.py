"""Posteriors of few continuous unknowns by adaptive quadrature, to a stated accuracy.

Where `enumerate_posterior` lays one fixed rule over the prior, cells follow the posterior here: peaks a
thousand times narrower than the prior, several far modes, bounded supports with singular ends, heavy
tails, funnels. Finite unknowns are summed over. No random number enters an answer: draws of the prior (from a
fixed seed) only tell where to look for peaks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.special

from bayesmc.distributions import Distribution, marking_invalid
from bayesmc.errors import BudgetError, UnsupportedError, ZeroProbabilityError
from bayesmc.network import BayesNet, CompiledNode, Problem, pose
from bayesmc.network.forward import refuse_bare
from bayesmc.testing.oracles.enumeration import Configurations, Enumerated, difference, visit
from bayesmc.testing.oracles.hidden import HiddenPart
from bayesmc.testing.oracles.integral import REACH, Integral

#: free numbers beyond which no grid is tried
_MOST = 4
#: relative error asked for, by dimension
_RTOLS = (1e-9, 1e-8, 1e-7, 1e-6, 1e-4)
#: relative error that is better than no answer, where nobody asked for another
_ENOUGH = 1e-4
#: share of the mass that the weighted points may leave out
_DROPPED = 1e-13
#: hidden leaves are represented by so many points
_LEAF_POINTS = 32


@dataclass(frozen=True, eq=False, repr=False)
class Quadrature(Enumerated):
    """The posterior as weighted points of a quadrature rule; it answers what `Enumerated` does, and more.

    ``accuracy`` is the largest of the relative error of the integral and of the errors of probabilities
    and of means (in standard deviations), from rules of half the order: it overstates the error unless a
    peak went unseen.

    Attributes
    ----------
    left_out : tuple of str
        Nodes without bearing on the evidence that could not be represented; they cannot be asked about.
    evaluations : int
        Of the joint density.
    """

    left_out: tuple[str, ...] = ()
    evaluations: int = 0
    _integral: Integral | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        return (
            f"Quadrature(log_marginal_likelihood={self.log_marginal_likelihood:.6g}, "
            f"accuracy={self.accuracy:.2g}, {len(self.weights)} points of {', '.join(self.names)})"
        )

    def cdf(self, name: str, x: Any) -> np.ndarray:
        """Posterior probability of a value at most ``x``, shape ``(*x.shape, *plates, *event)``.

        As accurate as the integral for numbers that are integrated over, discrete ones and leaves.
        Others (deterministic nodes, components of a simplex, bounds that depend on parents) are read off
        the weighted points, to about the largest of their weights.
        """
        node = self.model[name]
        points = np.asarray(x, dtype=float)
        values = np.asarray(self.values(name), dtype=float)
        out = np.empty((*points.shape, *node.value_shape))
        for at in np.ndindex(node.value_shape):
            out[(..., *at)] = self._cdf_of(node, at, values[(slice(None), *at)])(points)
        return out

    def quantile(self, name: str, q: Any) -> np.ndarray:
        """Posterior quantiles, shape ``(*q.shape, *plates, *event)``; as accurate as ``cdf`` is.

        Raises
        ------
        ValueError
            ``q`` is no probability strictly between 0 and 1.
        """
        node = self.model[name]
        levels = np.asarray(q, dtype=float)
        if not ((levels > 0) & (levels < 1)).all():
            raise ValueError(
                f"quantile({name!r}, q={q}): give probabilities strictly between 0 and 1"
            )
        values = np.asarray(self.values(name), dtype=float)
        out = np.empty((*levels.shape, *node.value_shape))
        for at in np.ndindex(node.value_shape):
            column = values[(slice(None), *at)]
            out[(..., *at)] = self._quantile_of(node, at, column, levels)
        return out

    def _quantile_of(
        self, node: CompiledNode, at: tuple[int, ...], column: np.ndarray, levels: np.ndarray
    ) -> np.ndarray:
        if node.is_discrete or column.max() == column.min():
            order = np.argsort(column, kind="stable")
            total = np.cumsum(self.weights[order])
            place = np.searchsorted(total, levels * (1 - 1e-12))
            return column[order][np.minimum(place, len(order) - 1)]
        smooth = self._smooth(node, at)
        if smooth is not None:
            cdf, value_of = smooth
            low, high = np.full(levels.shape, -REACH), np.full(levels.shape, REACH)
            for _ in range(100):
                middle = 0.5 * (low + high)
                below = cdf(middle) < levels
                low, high = np.where(below, middle, low), np.where(below, high, middle)
            return value_of(0.5 * (low + high))
        return _inverted(self._cdf_of(node, at, column), column, levels)

    def _cdf_of(
        self, node: CompiledNode, at: tuple[int, ...], column: np.ndarray
    ) -> Callable[[np.ndarray], np.ndarray]:
        """The cdf of one number of a node, the best way there is."""
        if node.is_discrete or column.max() == column.min():
            return lambda x: at_most(column, self.weights, x)
        if self._integral is not None and self._integral.free_number(node.name, at) is not None:
            found = self._integral.marginal(node.name, at)
            if found is not None:
                return found.cdf
        leaf = self._leaf(node, at)
        return leaf if leaf is not None else lambda x: _smoothed(column, self.weights, x)

    def _smooth(self, node: CompiledNode, at: tuple[int, ...]) -> Any:
        found = self._integral.marginal(node.name, at) if self._integral is not None else None
        return None if found is None else (found.of_coordinate, found.value_of)

    def _leaf(
        self, node: CompiledNode, at: tuple[int, ...]
    ) -> Callable[[np.ndarray], np.ndarray] | None:
        """Of a hidden leaf: the average of its own conditional cdf."""
        integral = self._integral
        if not node.is_stochastic or node.event_shape or integral is None:
            return None
        if integral.is_core(node.name, at):
            return None
        with marking_invalid(), np.errstate(all="ignore"):
            dist, _ = self.model.evaluate(node.name, self.stored)
            try:
                dist.cdf(0.5)
            except UnsupportedError:
                return None

        element = int(np.ravel_multi_index(at, node.plate_shape)) if at else 0

        def cdf(x: np.ndarray) -> np.ndarray:
            out = np.empty(x.shape)
            for place in np.ndindex(x.shape):
                below = np.broadcast_to(dist.cdf(x[place]), (len(self.weights), *node.plate_shape))
                out[place] = self.weights @ below.reshape(len(below), -1)[:, element]
            return out

        return cdf


def quadrature_posterior(
    net: BayesNet,
    evidence: Mapping[str, Any] | None = None,
    inputs: Mapping[str, Any] | None = None,
    *,
    rtol: float | None = None,
    max_evaluations: int = 12_000_000,
    max_configurations: int = 4096,
    starts: int = 16,
) -> Quadrature:
    """The posterior by adaptive quadrature over what is continuous and sums over what is finite.

    Hidden numbers are mapped to the whole line, standardised at the highest peak of the posterior, and
    stretched by ``sinh``, so that tails as heavy as a Cauchy's are in reach. Peaks are looked for from
    draws of the prior by quasi-Newton steps, in every configuration of the finite unknowns; cells are
    halved until they fit the peaks, and then where the integral errs most. One or two unknowns take
    thousands of evaluations, four about a million.

    A peak that no search meets is not seen: a needle far from where any slope leads. Hidden nodes that
    nothing observed depends on are no dimensions; they are put back as points of their conditional
    distributions, or left out where that takes too many.

    Parameters
    ----------
    net : BayesNet
    evidence, inputs : dict, optional
        As for ``infer``.
    rtol : float, optional
        Relative error of the integral (of the estimate, which overstates it); by default 1e-8, 1e-7, 1e-6
        and 1e-4 for one to four continuous unknowns; where that is out of reach, 1e-4 is taken for it, and
        ``accuracy`` says so.
    max_evaluations : int
        Of the joint density, over all configurations.
    max_configurations : int
        Joint states of the finite unknowns.
    starts : int
        Searches for peaks, over all configurations; at least two in each that is searched.

    Returns
    -------
    Quadrature

    Raises
    ------
    UnsupportedError
        Too many continuous unknowns (4 at most), or unknowns with infinitely many discrete values.
    BudgetError
        ``rtol`` (1e-4 by default) is out of reach of ``max_evaluations``, or there are too many
        configurations.
    ZeroProbabilityError
        The evidence is impossible.
    ParameterError, DensityError
        A node has bad parameters, or no density, where there is posterior mass.

    References
    ----------
    Genz and Kass (1997), Subregion-adaptive integration of functions having a dominant peak, JCGS 6.

    Examples
    --------
    A thousand heads in 3000 throws: the peak is 60 times narrower than the prior.

    >>> import bayesmc as bmc
    >>> from bayesmc.testing import quadrature_posterior
    >>> net = bmc.BayesNet()
    >>> net.add("p", bmc.Beta(0.5, 0.5))
    >>> net.add("heads", lambda p: bmc.Binomial(3000, p))
    >>> found = quadrature_posterior(net, {"heads": 1000})
    >>> float(found.mean("p").round(8)), bool(abs(found.mean("p") - 1000.5 / 3001) < 1e-9)
    (0.33338887, True)
    >>> found.quantile("p", [0.05, 0.95]).round(4).tolist()
    [0.3193, 0.3476]
    """
    _check(rtol, max_evaluations, starts)
    problem = pose(net, evidence, inputs)
    refuse_bare(problem.model, problem.observed, "quadrature_posterior")
    try:
        hidden = HiddenPart(problem, max_configurations)
    except UnsupportedError as error:
        raise type(error)(f"quadrature_posterior: {error}") from error
    if hidden.dimension > _MOST:
        names = ", ".join(repr(n) for n in dict.fromkeys(f.name for f in hidden.free))
        raise UnsupportedError(
            f"quadrature_posterior: {hidden.dimension} continuous unknowns ({names}), {_MOST} at most; "
            "observe some, take a smaller net, or where it is linear and Gaussian ask exact()"
        )
    wanted = _RTOLS[hidden.dimension] if rtol is None else rtol
    try:
        integral = Integral(hidden, wanted, max_evaluations, starts)
    except BudgetError:
        if rtol is not None or wanted >= _ENOUGH:
            raise
        # an answer that says how good it is tells more than none
        integral = Integral(hidden, _ENOUGH, max_evaluations, starts)
    return _answer(problem, hidden, integral)


def check_rtol(call: str, rtol: Any) -> None:
    """Raise ValueError unless a relative error that can be asked for, or None."""
    number = isinstance(rtol, (int, float, np.number)) and not isinstance(rtol, bool)
    if rtol is not None and not (number and 1e-13 <= rtol < 1.0):
        raise ValueError(f"{call}(rtol={rtol!r}): give a number from 1e-13 to below 1")


# ---- private ------------------------------------------------------------------------------------


def _check(rtol: float | None, max_evaluations: int, starts: int) -> None:
    check_rtol("quadrature_posterior", rtol)
    if max_evaluations < 1 or starts < 1:
        raise ValueError(
            f"quadrature_posterior(max_evaluations={max_evaluations}, starts={starts}): give at least 1"
        )


def _answer(problem: Problem, hidden: HiddenPart, integral: Integral) -> Quadrature:
    """Weighted points, with what was integrated out put back."""
    if not hidden.dimension:
        logs, suspect, _ = hidden.log_density(np.zeros((1, 0)))
        log_weights = logs.ravel()
        total = float(scipy.special.logsumexp(log_weights))
        if total == -math.inf:
            raise ZeroProbabilityError("quadrature_posterior: the evidence has probability zero")
        if hidden.trouble is not None and suspect.max() > -np.inf:
            raise hidden.trouble
        rows = np.flatnonzero(log_weights > -np.inf)
        core = _enumerated(hidden, rows, np.zeros((len(rows), 0)), log_weights[rows] - total, total)
        return _answered(problem, hidden, core, integral, 0.0, hidden.count)
    coordinates, cells = integral.cells_by(0)
    weights = np.exp(cells.log_weights()).transpose(0, 2, 1)
    coarse = np.exp(cells.log_weights(coarse=True)).transpose(0, 2, 1)
    u = coordinates.free(cells.points()).reshape(-1, hidden.dimension)
    rows = _heaviest(np.maximum(weights, coarse).ravel())
    points, configurations = np.divmod(rows, hidden.count)
    exact, rough = (
        _enumerated(hidden, configurations, u[points], _log(w.ravel()[rows]), cells.log_integral)
        for w in (weights, coarse)
    )
    apart = difference(exact, rough, problem.observed)
    # what a cell errs in the integral moves a mean by as many standard deviations as the cell is off
    accuracy = max(
        4.0 * cells.error, integral.lost, apart * min(1.0, 10.0 * math.sqrt(apart)), 1e-12
    )
    return _answered(problem, hidden, exact, integral, accuracy, cells.evaluations)


def _log(weights: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore"):
        return np.log(weights)


def _heaviest(weights: np.ndarray) -> np.ndarray:
    """The points that hold all but a negligible share of the mass, in place."""
    order = np.argsort(weights)
    small = np.cumsum(weights[order]) <= _DROPPED * weights.sum()
    return np.sort(order[~small])


def _enumerated(
    hidden: HiddenPart, rows: np.ndarray, free: np.ndarray, log_weights: np.ndarray, total: float
) -> Enumerated:
    values = hidden.values_at(rows, free)
    model = hidden.model
    stored = {n: np.broadcast_to(v, (len(rows), *model[n].value_shape)) for n, v in values.items()}
    mass = float(scipy.special.logsumexp(log_weights))
    return Enumerated(model, total + mass, np.exp(log_weights - mass), stored)


def _answered(
    problem: Problem,
    hidden: HiddenPart,
    core: Enumerated,
    integral: Integral,
    accuracy: float,
    evaluations: int,
) -> Quadrature:
    """The answer, with leaves, whose own error comes from a coarser rule for them."""
    points = _LEAF_POINTS if len(core.weights) < 10_000 else _LEAF_POINTS // 2
    fine, left_out, continuous = _with_leaves(problem, hidden, core, points, 6.5, ())
    if continuous:
        coarse, _, _ = _with_leaves(problem, hidden, core, points // 2 + 2, 5.5, left_out)
        accuracy = max(accuracy, difference(fine, coarse, problem.observed))
    return Quadrature(
        problem.model, core.log_marginal_likelihood, fine.weights, fine.stored, accuracy,
        tuple(left_out), evaluations, integral,
    )  # fmt: skip


def _with_leaves(
    problem: Problem,
    hidden: HiddenPart,
    core: Enumerated,
    points: int,
    reach: float,
    skipped: Sequence[str],
) -> tuple[Enumerated, list[str], bool]:
    """The points, each once for every value that stands for a hidden leaf; what was left out; and whether
    there are continuous leaves."""
    state = Configurations(problem, 1 << 20)
    state.log_weight = _log(core.weights)
    state.invalid = np.zeros(len(core.weights), dtype=bool)
    state.values.update({n: v for n, v in core.stored.items() if n in hidden.read})
    scores = np.linspace(-reach, reach, points)
    rule = np.exp(-0.5 * scores**2)
    grid = (scipy.special.ndtr(scores), np.log(rule / rule.sum()))
    left_out: list[str] = []
    with marking_invalid(), np.errstate(all="ignore"):
        for name, node in problem.model.nodes.items():
            if name in state.values or node.kind == "input":
                continue
            if name in skipped or set(node.parents) & set(left_out):
                left_out.append(name)
                continue
            seen = problem.observed.get(name)
            if seen is not None and seen.mask is None:
                state.values[name] = seen.value[None]
                continue
            result, _ = problem.model.evaluate(name, state.values)
            if not isinstance(result, Distribution):
                state.values[name] = state.full(name, result)
                continue
            try:
                visit(state, node, result, seen, grid, weigh=False)
            except UnsupportedError:
                left_out.append(name)
    stored = {n: state.full(n, v) for n, v in state.values.items()}
    weights = np.exp(state.log_weight - scipy.special.logsumexp(state.log_weight))
    found = Enumerated(problem.model, core.log_marginal_likelihood, weights, stored)
    return found, left_out, state.has_quadrature


def at_most(column: np.ndarray, weights: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The weight of values at most ``x``."""
    order = np.argsort(column, kind="stable")
    total = np.concatenate([[0.0], np.cumsum(weights[order])])
    return total[np.searchsorted(column[order], x, side="right")]


def _smoothed(column: np.ndarray, weights: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The cdf of weighted points, where each counts half at its own place, linear in between."""
    places, inverse = np.unique(column, return_inverse=True)
    mass = np.bincount(inverse, weights)
    return np.interp(x, places, np.cumsum(mass) - 0.5 * mass, left=0.0, right=1.0)


def _inverted(
    cdf: Callable[[np.ndarray], np.ndarray], column: np.ndarray, levels: np.ndarray
) -> np.ndarray:
    """Quantiles by bisection between the outermost points."""
    low, high = np.full(levels.shape, column.min()), np.full(levels.shape, column.max())
    for _ in range(100):
        middle = 0.5 * (low + high)
        below = cdf(middle) < levels
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return 0.5 * (low + high)
