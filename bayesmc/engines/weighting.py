"""Likelihood weighting: the forward pass, with evidence as weights."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc import diagnostics
from bayesmc.engines.base import Engine
from bayesmc.engines.forward import chunk_sizes, forward_chunks
from bayesmc.errors import BudgetError, LowEssWarning, UnsupportedError, ZeroProbabilityError
from bayesmc.network import Model, Problem
from bayesmc.network.forward import refuse_unsampled
from bayesmc.progress import Progress
from bayesmc.results import DrawsPosterior, Posterior, Sums, SumsPosterior

#: share of the draws above which weights are even enough to leave their tail unfitted
_EVEN = 0.5


@dataclass(frozen=True)
class LikelihoodWeighting(Engine):
    """Draw every hidden node given its parents and weight by the density of what is observed.

    It runs on any net that can be sampled forwards, and gives ``log_marginal_likelihood`` without bias
    (of the likelihood itself). Its error grows with the surprise of the evidence: ``weight_ess`` tells
    how many equally weighted draws the answer is worth, ``pareto_k`` whether even that can be trusted.

    Parameters
    ----------
    draws : int

    References
    ----------
    Fung and Chang (1990); Shachter and Peot (1990); Koller and Friedman (2009), sec. 12.3.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet()
    >>> net.add("a", bmc.Bernoulli(0.5))
    >>> net.add("x", lambda a: bmc.Normal(2.0 * a, 1.0))
    >>> posterior = bmc.infer(net, {"x": 1.0}, engine=bmc.LikelihoodWeighting(20_000), rng=0)
    >>> bool(abs(posterior.probability(lambda a: a == 1) - 0.5) < 0.02)
    True
    """

    draws: int = 10_000

    def __post_init__(self) -> None:
        if (
            isinstance(self.draws, bool)
            or not isinstance(self.draws, (int, np.integer))
            or self.draws < 1
        ):
            raise ValueError(
                f"LikelihoodWeighting(draws={self.draws!r}): draws is a whole number, 1 or more, such as "
                "100_000"
            )

    def refusal(self, problem: Problem) -> str | None:
        return refuse_unsampled(problem.model, problem.observed, "LikelihoodWeighting")

    def describe(self, problem: Problem) -> dict[str, str]:
        return {name: _treatment(problem, name) for name in problem.model.nodes}

    def run(
        self,
        problem: Problem,
        seed: np.random.SeedSequence,
        keep: Any = "draws",
        progress: bool | None = None,
        resume: Posterior | None = None,
    ) -> Posterior:
        names = tuple(n for n, c in problem.model.nodes.items() if c.kind != "input")
        weighted = bool(problem.observed or problem.model.potentials)
        with Progress(self.draws, "likelihood weighting", progress) as bar:
            first = resume.streams if isinstance(resume, DrawsPosterior) else 0
            chunks = forward_chunks(problem, self.draws, seed, bar, first)
            if isinstance(keep, str) and keep == "summaries":
                if resume is not None:
                    raise UnsupportedError('infer: resume= continues draws; give keep="draws"')
                return self._summaries(problem, chunks, names, weighted)
            kept = names if isinstance(keep, str) else tuple(keep)
            try:
                return self._draws(problem, chunks, kept, weighted, resume)
            except MemoryError as error:
                raise BudgetError(
                    f"LikelihoodWeighting: {self.draws} draws of {len(kept)} nodes do not fit in memory; "
                    'ask for keep="summaries", or name the nodes to keep'
                ) from error

    def _summaries(
        self, problem: Problem, chunks: Any, names: Any, weighted: bool
    ) -> SumsPosterior:
        sums = Sums(problem.model, names)
        for chunk in chunks:
            sums.add(chunk.values, chunk.log_weight, chunk.batch[0])
        _refuse_zero(sums.top, self.draws)
        posterior = SumsPosterior(problem, self, sums, weighted)
        _set_evidence(posterior, sums.top + float(np.log(sums.weight[0])), self.draws, weighted)
        return posterior

    def _draws(
        self, problem: Problem, chunks: Any, names: Any, weighted: bool, resume: Posterior | None
    ) -> DrawsPosterior:
        stored: dict[str, np.ndarray] = {}
        log_weights = np.zeros((1, self.draws))
        start = 0
        for chunk in chunks:
            stop = start + chunk.batch[0]
            log_weights[0, start:stop] = chunk.log_weight
            for name in names:
                _keep(stored, name, chunk.values[name], problem.model, self.draws, start, stop)
            start = stop
        if resume is not None:
            stored, log_weights = _joined(resume, stored, log_weights, problem)
        total = log_weights.shape[1]
        _refuse_zero(float(log_weights.max()), total)
        for array in stored.values():
            array.flags.writeable = False
        log_weights.flags.writeable = False
        before = resume.streams if isinstance(resume, DrawsPosterior) else 0
        posterior = DrawsPosterior(
            problem,
            self,
            stored,
            (1, total),
            log_weights if weighted else None,
            independent=True,
            streams=before + len(chunk_sizes(problem.model, self.draws)),
        )
        _set_evidence(posterior, float(diagnostics.log_sum_exp(log_weights)), total, weighted)
        return posterior


def _keep(
    stored: dict[str, np.ndarray],
    name: str,
    value: np.ndarray,
    model: Model,
    draws: int,
    start: int,
    stop: int,
) -> None:
    """Put a chunk's values in place; values without a batch axis are the same for all draws."""
    trailing = len(model[name].value_shape)
    if value.ndim == trailing:
        stored.setdefault(name, np.array(value)[None, None])
        return
    if name not in stored:
        stored[name] = np.empty((1, draws, *value.shape[1:]), dtype=value.dtype)
    stored[name][0, start:stop] = value


def _joined(
    old: Posterior, stored: dict[str, np.ndarray], log_weights: np.ndarray, problem: Problem
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Earlier draws of the same question and the new ones, end to end."""
    if not isinstance(old, DrawsPosterior) or not _same_question(old, problem, set(stored)):
        raise UnsupportedError(
            "infer: resume= takes an earlier LikelihoodWeighting posterior of the same net, evidence, "
            "inputs and keep=, as infer returned it; this one answers another question"
        )
    before = old._shape[1]
    joined = {}
    for name, new in stored.items():
        tail = problem.model[name].value_shape
        parts = [
            np.broadcast_to(old._stored[name], (1, before, *tail)),
            np.broadcast_to(new, (1, log_weights.shape[1], *tail)),
        ]
        constant = new.shape[1] == 1 == old._stored[name].shape[1]
        joined[name] = new if constant else np.concatenate(parts, axis=1)
    earlier = np.zeros((1, before)) if old.log_weights is None else old.log_weights
    return joined, np.concatenate([earlier, log_weights], axis=1)


def _same_question(old: DrawsPosterior, problem: Problem, names: set[str]) -> bool:
    """Whether draws of ``old`` may be joined with new ones for ``problem``."""
    was = old.problem
    if was is None or set(old._stored) != names or not isinstance(old.engine, LikelihoodWeighting):
        return False
    weighted = bool(problem.observed or problem.model.potentials)
    same_net = list(was.model.nodes) == list(problem.model.nodes) and all(
        was.model[n].declaration is c.declaration for n, c in problem.model.nodes.items()
    )
    same_net = same_net and list(was.model.potentials) == list(problem.model.potentials)
    same_net = same_net and all(
        was.model.potentials[n][0] is v[0] for n, v in problem.model.potentials.items()
    )
    return (
        same_net
        and was.model.sizes == problem.model.sizes
        and (old.log_weights is not None) == weighted
        and was.observed.keys() == problem.observed.keys()
        and all(
            np.array_equal(o.value, problem.observed[n].value)
            and _same_mask(o.mask, problem.observed[n].mask)
            for n, o in was.observed.items()
        )
        and all(np.array_equal(v, problem.inputs[n]) for n, v in was.inputs.items())
    )


def _same_mask(a: np.ndarray | None, b: np.ndarray | None) -> bool:
    return a is b if a is None or b is None else np.array_equal(a, b)


def _refuse_zero(top: float, draws: int) -> None:
    if top == -np.inf:
        raise ZeroProbabilityError(
            f"LikelihoodWeighting: none of {draws} draws is compatible with the evidence, so its "
            "probability is zero or far too small for this engine; check the evidence, or use Exact()"
        )


def _set_evidence(posterior: Any, log_total: float, draws: int, weighted: bool) -> None:
    """Log evidence with its error by the delta method, and a warning where it rests on too little."""
    posterior.log_marginal_likelihood = log_total - float(np.log(draws)) if weighted else 0.0
    posterior.log_marginal_likelihood_mcse = 0.0
    if not weighted:
        return
    ess = posterior.weight_ess
    posterior.log_marginal_likelihood_mcse = float(np.sqrt(max(1 / ess - 1 / draws, 0.0)))
    remedy = "use more draws, or Exact() where explain(net, evidence) says it can"
    if ess < min(diagnostics.MIN_WEIGHT_ESS, 0.9 * draws):
        warnings.warn(
            f"likelihood weighting: the {draws} draws are worth only {ess:.1f} equally weighted ones "
            f"(weight_ess); answers and their error bars are unreliable: {remedy}",
            LowEssWarning,
            stacklevel=5,
        )
    elif ess < _EVEN * draws and posterior.pareto_k > diagnostics.MAX_PARETO_K:
        warnings.warn(
            f"likelihood weighting: the weights have a heavy tail (Pareto k = {posterior.pareto_k:.2f}, "
            f"above {diagnostics.MAX_PARETO_K}); answers converge slowly: {remedy}",
            LowEssWarning,
            stacklevel=5,
        )


def _treatment(problem: Problem, name: str) -> str:
    node = problem.model[name]
    if node.kind in ("input", "fixed"):
        return "given"
    slow = ", element by element (vectorize=True): slow" if node.declaration.vectorize else ""
    if not node.is_stochastic:
        return "computed from its parents" + slow
    seen = problem.observed.get(name)
    if seen is None:
        return "sampled given its parents" + slow
    return (
        "weights the draws"
        + (" (missing elements sampled)" if seen.mask is not None else "")
        + slow
    )
