"""One call for the exact posterior: whichever oracle applies, or why none does.

The oracles are brute force and share no code with the engines, but for how a net evaluates a node:
listing all states, one dense Gaussian per configuration, adaptive quadrature. A template with a series is
unrolled first, so that long series are out of reach.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.dbn import DynamicBayesNet
from bayesmc.dbn.series import read_series
from bayesmc.dbn.unroll import indexed
from bayesmc.distributions import marking_invalid
from bayesmc.errors import BudgetError, ModelError, UnknownNodeError, UnsupportedError
from bayesmc.network import BayesNet, Model, Problem, pose
from bayesmc.network.forward import refuse_bare
from bayesmc.network.joint import node_log_prob
from bayesmc.testing.oracles.conditional_gaussian import GaussianAnswer
from bayesmc.testing.oracles.enumeration import Enumerated, averaged, enumerate_posterior
from bayesmc.testing.oracles.linear import linear_posterior
from bayesmc.testing.oracles.marginals import cdf, marginals, quantile
from bayesmc.testing.oracles.quadrature import Quadrature, check_rtol, quadrature_posterior

#: scalars over which a function is integrated under a Gaussian, and the points for each
_MOST_SCALARS = 3
_HERMITE = 24


@dataclass(frozen=True, eq=False)
class ExactAnswer:
    """An exact posterior, whichever oracle it comes from.

    Attributes
    ----------
    method : str
        ``"enumeration"``, ``"linear-Gaussian"`` or ``"quadrature"``.
    answer : Enumerated, GaussianAnswer or Quadrature
        The oracle's own, with more to ask.
    steps : int or None
        Of a template: number of slices. A node of the template is then answered for all slices, time
        leading, and ``"x[3]"`` for one.
    passed_over : dict
        Oracle -> why it was not the one.
    observed : frozenset of str
        Nodes that are data in all their elements.
    log_static : float or None
        Of a template whose static nodes are observed: their log density. Filters take them as known, so that
        their log evidence, which is that of the rows, is ``log_marginal_likelihood`` less this.
    """

    method: str
    answer: Enumerated | GaussianAnswer
    steps: int | None
    passed_over: dict[str, str]
    observed: frozenset[str] = frozenset()
    log_static: float | None = None

    @property
    def model(self) -> Model:
        """Of the net that was asked."""
        return self.answer.model

    @property
    def accuracy(self) -> float:
        """What probabilities, log evidence, and means in standard deviations are good to."""
        return float(self.answer.accuracy)

    @property
    def log_marginal_likelihood(self) -> float:
        """Log probability (density) of the evidence."""
        return self.answer.log_marginal_likelihood

    @property
    def names(self) -> tuple[str, ...]:
        """Nodes that can be asked about."""
        return self.answer.names

    def probabilities(self, *names: str) -> np.ndarray:
        """Probabilities of the states, ``(*plates, states)``; of several nodes jointly."""
        return self._by_slice(self.answer.probabilities, *names)

    def sample(self, draws: int, rng: Any = None) -> dict[str, np.ndarray]:
        """Independent joint draws of all nodes, ``(draws, *plates, *event)``; labels as their positions.

        ``rng`` is a seed or generator.

        Raises
        ------
        UnsupportedError
            An answer by quadrature.
        """
        return self.answer.sample(draws, rng)

    def mean(self, name: str) -> np.ndarray:
        """Posterior mean, ``(*plates, *event)``."""
        return self._by_slice(self.answer.mean, name)

    def var(self, name: str) -> np.ndarray:
        """Posterior variance of every scalar, ``(*plates, *event)``."""
        return self._by_slice(self.answer.var, name)

    def std(self, name: str) -> np.ndarray:
        """Posterior standard deviation, ``(*plates, *event)``."""
        return np.sqrt(np.maximum(self.var(name), 0.0))

    def cov(self, *names: str) -> np.ndarray:
        """Posterior covariances of all scalars of the nodes, one after the other, shape ``(d, d)``."""
        self._known(*names)
        if isinstance(self.answer, Enumerated):

            def products(*values: np.ndarray) -> np.ndarray:
                columns = np.concatenate([np.reshape(v, (len(v), -1)) for v in values], axis=1)
                off = columns.astype(float) - means
                return off[:, :, None] * off[:, None]

            means = np.concatenate([np.ravel(self.mean(name)) for name in names])
            return self.answer.expectation(products, *names)
        return np.atleast_2d(self.answer.cov(*names))

    def expectation(self, function: Callable[..., Any], *names: str) -> np.ndarray:
        """Posterior mean of a function of nodes, which keeps the leading axis.

        The nodes are ``names``, or the function's arguments. Under Gaussians the function is integrated
        by Gauss-Hermite rules over at most three scalars: exact for polynomials of degree below 48,
        good for smooth functions, and poor (off by some 0.05) for those that jump: ask ``cdf`` for chances.

        Raises
        ------
        UnsupportedError
            More than three scalars of a linear-Gaussian answer.
        """
        names = names or tuple(inspect.signature(function).parameters)
        self._known(*names)
        if isinstance(self.answer, Enumerated):
            return self.answer.expectation(function, *names)
        return _hermite(self.answer, function, names)

    def cdf(self, name: str, x: Any) -> np.ndarray:
        """Posterior probability of a value at most ``x``, ``(*x.shape, *plates, *event)``."""
        points = np.asarray(x, dtype=float)
        return self._by_slice(lambda one: self._cdf(one, points), name, lead=points.ndim)

    def quantile(self, name: str, q: Any) -> np.ndarray:
        """Posterior quantiles, ``(*q.shape, *plates, *event)``: the smallest values whose cdf is ``q``."""
        levels = np.asarray(q, dtype=float)
        if not ((levels > 0) & (levels < 1)).all():
            raise ValueError(
                f"quantile({name!r}, q={q}): give probabilities strictly between 0 and 1"
            )
        return self._by_slice(lambda one: self._quantile(one, levels), name, lead=levels.ndim)

    def __repr__(self) -> str:
        return (
            f"ExactAnswer({self.method!r}, log_marginal_likelihood="
            f"{self.log_marginal_likelihood:.6g}, accuracy={self.accuracy:.2g})"
        )

    # ---- private ----------------------------------------------------------------------------

    def _known(self, *names: str) -> None:
        for name in names:
            if name not in self.names:
                raise UnknownNodeError(
                    f"exact: {name!r} is no node that this answer has; ask {', '.join(self.names)}"
                )

    def _by_slice(self, ask: Callable[..., np.ndarray], *names: str, lead: int = 0) -> np.ndarray:
        """The answer, or those of all slices with time as the first axis of the node."""
        if self.steps is None or all(name in self.names for name in names):
            self._known(*names)
            return ask(*names)
        self._known(*(n for n in names if indexed(n, 0) not in self.names))
        slices = [
            tuple(n if n in self.names else indexed(n, t) for n in names) for t in range(self.steps)
        ]
        for one in slices:
            self._known(*one)
        return np.stack([ask(*one) for one in slices], axis=lead)

    def _cdf(self, name: str, points: np.ndarray) -> np.ndarray:
        if isinstance(self.answer, Quadrature):
            return self.answer.cdf(name, points)
        shape = self.model[name].value_shape
        out = np.empty((*points.shape, *shape))
        for at, part in marginals(self.answer, name):
            place: Any = (..., *at)
            out[place] = cdf(part, points)
        return out

    def _quantile(self, name: str, levels: np.ndarray) -> np.ndarray:
        if isinstance(self.answer, Quadrature):
            return self.answer.quantile(name, levels)
        out = np.empty((*levels.shape, *self.model[name].value_shape))
        for at, part in marginals(self.answer, name):
            place: Any = (..., *at)
            out[place] = quantile(part, levels)
        return out


def exact(
    net: BayesNet | DynamicBayesNet,
    evidence: Mapping[str, Any] | None = None,
    inputs: Mapping[str, Any] | None = None,
    *,
    rtol: float | None = None,
) -> ExactAnswer:
    """The exact posterior, by the first oracle that applies.

    1. Enumeration, where everything hidden is finite.
    2. One dense Gaussian per configuration of what is finite, where what is continuous is linear and
       Gaussian. This is also what a Kalman smoother computes.
    3. Adaptive quadrature, for up to four continuous unknowns of any kind (`quadrature_posterior`).

    Parameters
    ----------
    net : BayesNet or DynamicBayesNet
        A template is unrolled over the rows of its observations; the answer is that of smoothing.
        Give fewer rows for filtering.
    evidence, inputs : dict, optional
        As for ``infer``; of a template, observations and inputs as for ``smooth``.
    rtol : float, optional
        Relative error of the integral, where it comes to quadrature (`quadrature_posterior`).

    Returns
    -------
    ExactAnswer
        Its ``accuracy`` says what it is good to.

    Raises
    ------
    UnsupportedError
        No oracle applies; the message says why, for each.
    ZeroProbabilityError
        The evidence is impossible.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.testing import exact
    >>> net = bmc.BayesNet()
    >>> net.add("a", bmc.Bernoulli(0.3))
    >>> net.add("x", lambda a: bmc.Normal(2.0 * a, 1.0))
    >>> exact(net, {"x": 1.0}).method, exact(net).method
    ('enumeration', 'linear-Gaussian')
    >>> float(exact(net, {"x": 1.0}).mean("a").round(12)), float(exact(net).var("x").round(12))
    (0.3, 1.84)

    A random walk seen with noise, two slices:

    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    >>> dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    >>> exact(dbn, {"y": [1.0, 3.0]}).mean("x").round(12).tolist()
    [1.0, 2.0]
    """
    check_rtol("exact", rtol)
    steps, static = None, None
    if isinstance(net, DynamicBayesNet):
        static = net.static_nodes
        net, evidence, steps = _unrolled(net, evidence, inputs)
        inputs = None
    elif not isinstance(net, BayesNet):
        raise ModelError(
            f"exact: expected a BayesNet or a DynamicBayesNet, not {type(net).__name__}"
        )
    problem = pose(net, evidence, inputs)
    refuse_bare(problem.model, problem.observed, "exact")
    observed = frozenset(n for n, seen in problem.observed.items() if seen.mask is None)
    log_static = None if static is None else _log_static(problem, static)
    oracles: dict[str, Callable[[], Enumerated | GaussianAnswer]] = {
        "enumeration": lambda: _enumerated(problem, net, evidence, inputs),
        "linear-Gaussian": lambda: linear_posterior(problem),
        "quadrature": lambda: quadrature_posterior(net, evidence, inputs, rtol=rtol),
    }
    passed_over: dict[str, str] = {}
    partial: dict[str, Enumerated | GaussianAnswer] = {}
    about: dict[str, Any] = {"steps": steps, "observed": observed, "log_static": log_static}
    wanted = [n for n, node in problem.model.nodes.items() if node.kind != "input"]
    for method, oracle in oracles.items():
        try:
            answer = oracle()
        except UnsupportedError as error:
            passed_over[method] = str(error)
            continue
        left_out = [name for name in wanted if name not in answer.names]
        if not left_out:
            return ExactAnswer(method, answer, passed_over=passed_over, **about)
        partial[method] = answer
        passed_over[method] = f"it leaves out {', '.join(map(repr, left_out))}"
    if partial:  # what nothing observed depends on, and no oracle can say
        method = max(partial, key=lambda m: len(partial[m].names))
        others = {m: why for m, why in passed_over.items() if m != method}
        return ExactAnswer(method, partial[method], passed_over=others, **about)
    reasons = "".join(f"\n  {method}: {why}" for method, why in passed_over.items())
    raise UnsupportedError(
        f"exact: no oracle answers this net:{reasons}\nObserve more, take fewer elements or steps, or "
        "use tests that need no exact answer (rank_test, geweke_test)"
    )


# ---- private ------------------------------------------------------------------------------------


def _unrolled(
    dbn: DynamicBayesNet, observations: Mapping[str, Any] | None, inputs: Mapping[str, Any] | None
) -> tuple[BayesNet, dict[str, Any], int]:
    """The plain net of a series, its evidence, and the number of slices."""
    _, series = read_series(dbn, observations, inputs)
    net = dbn.unroll(series.steps, inputs)
    return net, dbn.unrolled_evidence(observations or {}), series.steps


def _log_static(problem: Problem, static: Sequence[str]) -> float | None:
    """Log density of static nodes, whose parents are static, too; None where one of them is hidden."""
    values = {name: value[None] for name, value in problem.inputs.items()}
    total: Any = 0.0
    with marking_invalid(), np.errstate(all="ignore"):
        for name, node in problem.model.nodes.items():
            if name not in static or node.kind == "input":
                continue
            if not node.is_stochastic:
                values[name], _ = problem.model.evaluate(name, values)
                continue
            seen = problem.observed.get(name)
            if seen is None or seen.mask is not None:
                return None
            values[name] = seen.value[None]
            total = total + node_log_prob(problem.model, name, values[name], values, total)
    return float(np.sum(total))


def _enumerated(
    problem: Problem,
    net: BayesNet,
    evidence: Mapping[str, Any] | None,
    inputs: Mapping[str, Any] | None,
) -> Enumerated:
    """All joint states, where there is nothing else: no fixed quadrature rule stands in for an exact one."""
    for name, node in problem.model.nodes.items():
        found = problem.observed.get(name)
        hidden = found is None or found.mask is not None
        if node.is_stochastic and hidden and not node.is_discrete:
            raise UnsupportedError(f"the hidden node {name!r} is continuous")
    return enumerate_posterior(net, evidence, inputs)


def _hermite(
    answer: GaussianAnswer, function: Callable[..., Any], names: tuple[str, ...]
) -> np.ndarray:
    """The mean of a function under weighted Gaussians of few scalars."""
    smooth = [n for n in names if answer.nodes[n].states is None]
    sizes = [math.prod(answer.model[n].value_shape) for n in smooth]
    total = sum(sizes)
    if total > _MOST_SCALARS:
        raise UnsupportedError(
            f"exact: the expectation of a function of {total} numbers ({', '.join(smooth)}) under a "
            f"linear-Gaussian answer; {_MOST_SCALARS} at most. Ask for means and covariances of the "
            "answer (.answer.cov), or for fewer nodes"
        )
    kept = np.flatnonzero(answer.weights > 1e-16)
    if len(kept) * _HERMITE**total > 1 << 22:
        raise BudgetError(
            f"exact: the expectation takes {len(kept)} x {_HERMITE}^{total} points; ask for fewer nodes"
        )
    _, means, covs = (
        answer.mixture(*smooth) if smooth else (None, np.zeros((len(answer.weights), 0)), None)
    )
    nodes, rule = np.polynomial.hermite_e.hermegauss(_HERMITE)
    grid = np.stack(np.meshgrid(*[nodes] * total, indexing="ij"), -1).reshape(-1, total)
    weights = np.ones(1)
    for _ in range(total):
        weights = np.multiply.outer(weights, rule / rule.sum()).ravel()
    points = means[kept][:, None] + np.zeros((1, len(grid), total))
    if covs is not None:
        found, axes = np.linalg.eigh(covs[kept])
        roots = axes * np.sqrt(np.maximum(found, 0.0))[:, None]
        points = points + grid @ np.matrix_transpose(roots)
    joint = (answer.weights[kept][:, None] * weights).ravel()
    flat, start, arguments = points.reshape(-1, total), 0, []
    for name in names:
        node = answer.model[name]
        if name in smooth:
            stop = start + math.prod(node.value_shape)
            arguments.append(flat[:, start:stop].reshape(-1, *node.value_shape))
            start = stop
            continue
        columns = [answer.states[name, e][kept] for e in range(answer.nodes[name].elements)]
        stored = np.stack(columns, axis=-1).reshape(len(kept), *node.plate_shape)
        arguments.append(node.decode(np.repeat(stored, len(grid), axis=0)))
    result = np.asarray(function(*arguments), dtype=float)
    return averaged(result, joint)
