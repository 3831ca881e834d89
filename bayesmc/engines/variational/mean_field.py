"""Mean-field variational inference as an engine."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from bayesmc.engines.approximate.approximation import Drawn, Marginal
from bayesmc.engines.approximate.evidence import log_constants, why_not
from bayesmc.engines.approximate.posterior import DRAWS, ApproximatePosterior
from bayesmc.engines.base import Engine
from bayesmc.engines.variational.ascent import Ascent, best_of
from bayesmc.engines.variational.excluded import left_out
from bayesmc.engines.variational.free import FREE, finer_rule, fresh_points
from bayesmc.engines.variational.jumping import refuse_endless, refuse_jumps
from bayesmc.engines.variational.parts import Part, TablePart, part_of
from bayesmc.engines.variational.places import other_places, told
from bayesmc.engines.variational.plan import plan_for
from bayesmc.engines.variational.steps import Plan
from bayesmc.engines.weighted.drawing import check_count
from bayesmc.errors import (
    ConvergenceWarning,
    EngineWarning,
    ReducibleWarning,
    UnsupportedError,
)
from bayesmc.network import Problem
from bayesmc.progress import Progress
from bayesmc.randomness import Purpose, stream
from bayesmc.results import Posterior
from bayesmc.structure.target import Values, target_of

#: bounds below this are of what is impossible
NEVER = -1e250
#: how much farther than the points of a rule it is looked for an edge, and how many draws look
_REACH, _DRAWS = 1.6, 2048
#: sets of fresh points that measure a bound
_REPEATS = 16
#: share of even tables in draws that check the others
_EVEN = 0.5


@dataclass(frozen=True, eq=False)
class MeanFieldApproximation:
    """A product of independent parts."""

    parts: tuple[Part, ...]
    coordinates: str = "the nodes' own coordinates"
    tied: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(n for part in self.parts for n in part.names)

    def draw(self, rng: np.random.Generator, draws: int) -> Drawn:
        """Independent joint draws of all nodes, with their log density."""
        values: dict[str, np.ndarray] = {}
        log = np.zeros(draws)
        for part in self.parts:
            found, own = part.draw(rng, draws)
            values |= found
            log = log + own
        return Drawn(values, log)

    @property
    def spread(self) -> Callable[[np.random.Generator, int], Drawn] | None:
        """Draws that meet the states which tied nodes have left out; None where no nodes are tied."""
        if not self.tied:
            return None
        return replace(self, parts=tuple(_evened(part, self.tied) for part in self.parts)).draw

    def log_density(self, values: Values) -> np.ndarray:
        """Of given values: that of ``spread``, or of ``draw`` where there is none, shape (draws,)."""
        parts = [_evened(part, self.tied) for part in self.parts]
        return np.asarray(sum(part.log_density(values) for part in parts))

    def part(self, name: str) -> Part | None:
        return next((p for p in self.parts if name in p.names), None)

    def marginal(self, name: str) -> Marginal | None:
        part = self.part(name)
        return None if part is None else part.marginal(name)

    def probabilities(self, name: str) -> np.ndarray | None:
        part = self.part(name)
        return part.probabilities(name) if isinstance(part, TablePart) else None

    def covariance(self, *names: str) -> np.ndarray | None:
        parts = [self.part(name) for name in names]
        if len(set(map(id, parts))) < len(names):  # of one part, or the same twice
            return None
        blocks = [None if p is None else p.covariance(n) for p, n in zip(parts, names, strict=True)]
        sizes = [0 if b is None else len(b) for b in blocks]
        found = np.zeros((sum(sizes), sum(sizes)))
        start = 0
        for block in blocks:
            if block is None:
                return None
            found[start : start + len(block), start : start + len(block)] = block
            start += len(block)
        return found


class MeanFieldPosterior(ApproximatePosterior):
    """Answers of a mean-field approximation.

    Attributes
    ----------
    elbo : float
        The evidence lower bound that it ended with; ``log_marginal_likelihood`` is the same number. Where
        nodes have no closed form it is measured by other points than it was climbed with, and so may differ
        from the last of ``elbos``.
    elbo_mcse : float
        The error of its integrals: 0 where all factors have closed forms, else a standard error.
    elbos : ndarray
        After every sweep of the start that answers.
    bounds : ndarray, shape (restarts,)
        What each start reached, the best first; the first few went on until they had settled.
    sweeps : int
    converged : bool
    """

    elbo: float = np.nan
    elbo_mcse: float = 0.0
    elbos: np.ndarray
    bounds: np.ndarray
    sweeps: int = 0
    converged: bool = False

    def mean(self, name: str) -> np.ndarray:
        found = self._closed_moments(name)
        return super().mean(name) if found is None else np.array(found[0])

    def var(self, name: str) -> np.ndarray:
        found = self._closed_moments(name)
        return super().var(name) if found is None else np.array(found[1])

    def _closed_moments(self, name: str) -> tuple[np.ndarray, np.ndarray] | None:
        self._node(name)
        part = self.approximation.part(name)  # type: ignore[attr-defined]
        return None if part is None else part.moments(name)

    def _is_closed(self, what: Any) -> bool:
        if isinstance(what, str) and self._closed_moments(what) is not None:
            return True
        return super()._is_closed(what)


@dataclass(frozen=True)
class MeanField(Engine):
    """Mean-field variational inference by coordinate ascent.

    The posterior is approximated by a product of independent factors, one for each hidden node and each
    element of its plates, that comes closest in the sense of the evidence bound (the Kullback-Leibler
    divergence from the approximation to the posterior). Where nodes and their neighbours are
    conjugate-exponential the best factor given all others has a closed form; a sweep takes every factor in
    turn, so that the bound never falls. Nodes without a closed form are jointly normal in unconstrained
    coordinates and climb the same bound.

    Means are mostly good. Variances are too small where factors are torn from what they depend on, the more
    so the stronger it is; of several modes it answers one. ``posterior.check()`` tells how far it is off.

    Parameters
    ----------
    restarts : int
        Starts far apart; the best bound answers, and ``bounds`` has all.
    tolerance : float
        A start has settled when a sweep gains less than this share of the bound, and moves no figure (means
        in their standard deviations, log scales, probabilities) by more than ten times as much.
    blocks : sequence of tuples of str, optional
        Nodes that share one factor: ``[("mean", "cov")]`` for a normal mean and the gamma, inverse gamma,
        Wishart or inverse Wishart node that scales it. Other blocks of numbers become jointly normal;
        finite nodes with the same plates have one table of joint states.
    sweeps : int
        At most, of one start.
    draws : int
        Draws that answer what has no closed form: functions of nodes, for example.

    Notes
    -----
    ``log_marginal_likelihood`` is the evidence bound, below the log evidence by that divergence. Components
    of a mixture that the model does not tell apart: one labelling answers, and the bound is lower than the
    log evidence by up to ``log K!`` for that alone. Finite nodes are tables, one for each element,
    independent of one another; numbers of a plate that meet in one term are jointly normal. The bound of
    nodes without closed forms is a sum over fixed points, exact for quadratic functions; ``elbo_mcse`` is its
    error, measured with fresh draws at the end.

    Raises
    ------
    UnsupportedError
        A density cannot be followed; a node has infinitely many states; a node has no proper factor; the
        bound rises without end.

    Warns
    -----
    ConvergenceWarning
        The best start had not settled after all sweeps.
    EngineWarning
        Starts settled in places that differ, by more than the order of a plate's elements, with bounds no
        farther from the best than the logarithm of a hundredth.
    ReducibleWarning
        Zero probabilities tie finite nodes, and states were left out that may be probable.

    References
    ----------
    Winn and Bishop (2005), Variational Message Passing, JMLR 6; Bishop (2006), Pattern Recognition and
    Machine Learning, ch. 10; Blei, Kucukelbir and McAuliffe (2017), Variational Inference: A Review for
    Statisticians, JASA 112.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet(plates={"i": 4})
    >>> net.add("mean", bmc.Normal(0.0, 10.0))
    >>> net.add("precision", bmc.Gamma(2.0, 2.0))
    >>> net.add("x", lambda mean, precision: bmc.Normal(mean, precision**-0.5), plates="i")
    >>> posterior = bmc.infer(net, {"x": [1.0, 2.0, 2.5, 2.2]}, engine=bmc.MeanField(), rng=0)
    >>> posterior.converged, posterior.mean("mean").round(2), round(posterior.elbo, 2)
    (True, np.float64(1.92), -7.56)
    """

    restarts: int = 10
    tolerance: float = 1e-8
    blocks: Sequence[Sequence[str]] | None = None
    sweeps: int = 2000
    draws: int = DRAWS

    label: ClassVar[str] = "mean-field variational inference"

    def __post_init__(self) -> None:
        check_count(self, "restarts", self.restarts, "10")
        check_count(self, "sweeps", self.sweeps, "2000")
        check_count(self, "draws", self.draws, "4000")
        good = isinstance(self.tolerance, (int, float)) and not isinstance(self.tolerance, bool)
        if not good or not 0 < self.tolerance < 1:
            raise ValueError(
                f"MeanField(tolerance={self.tolerance!r}): give a share of the bound, such as 1e-8"
            )
        listed = [] if self.blocks is None else self.blocks
        fine = isinstance(listed, Sequence) and not isinstance(listed, str)
        fine = fine and all(
            isinstance(b, Sequence)
            and not isinstance(b, str)
            and all(isinstance(n, str) for n in b)
            for b in listed
        )
        flat = [n for b in listed for n in b] if fine else []
        if not fine or len(set(flat)) < len(flat):
            raise ValueError(
                f'MeanField(blocks={self.blocks!r}): give tuples of nodes, each in one: [("mean", "cov")]'
            )

    def refusal(self, problem: Problem) -> str | None:
        return why_not(problem, type(self).__name__, lambda: self._plan(problem).target)

    def describe(self, problem: Problem) -> dict[str, str]:
        plan = self._plan(problem)
        found = {}
        for name, node in problem.model.nodes.items():
            seen = problem.observed.get(name)
            if node.kind in ("input", "fixed"):
                found[name] = "given"
            elif name in plan.why:
                found[name] = plan.why[name]
            elif seen is not None and seen.mask is None:
                found[name] = "observed"
            elif node.kind == "deterministic":
                found[name] = "computed from draws"
            else:
                found[name] = "drawn from the net given the others"
        return found

    def effort(self, problem: Problem) -> str:
        plan = self._plan(problem)
        closed = sum(why.startswith("closed form") for why in plan.why.values())
        return (
            f"{len(plan.why)} nodes in {len(plan.factors)} factors, {closed} of them in closed form, from "
            f"{self.restarts} starts; the log marginal likelihood is a lower bound, and variances are too "
            "small where factors depend on each other (posterior.check() tells how far)"
        )

    def run(
        self,
        problem: Problem,
        seed: np.random.SeedSequence,
        keep: Any = "draws",
        progress: bool | None = None,
        resume: Posterior | None = None,
    ) -> MeanFieldPosterior:
        reason = self.refusal(problem)
        if resume is not None:
            reason = "MeanField: there is nothing to go on with; ask for more sweeps"
        if reason is not None:
            raise UnsupportedError(reason)
        plan, rng = self._plan(problem), stream(seed, Purpose.INFER, 1)
        with Progress(int(self.restarts), self.label, progress) as bar:
            found = best_of(plan, self.restarts, self.sweeps, self.tolerance, rng, bar.advance)
            places = other_places(plan, found, self.sweeps, self.tolerance)
        best, constant = found[0], log_constants(plan.target)
        if best.bounds[-1] < NEVER:
            raise UnsupportedError(
                "MeanField: independent factors put mass where the joint density is zero, wherever they "
                "started (nodes follow from others without noise); use Exact() or Gibbs()"
            )
        refuse_endless(plan)
        parts = tuple(part_of(f, best.state, plan.target) for f in plan.factors)
        where = "the nodes' own coordinates"
        if plan.free is not None:
            where = f"unconstrained numbers of {', '.join(plan.free.names)}"
        tied = left_out(plan, best.state)
        found_by = MeanFieldApproximation(parts, where, tuple(tied))
        posterior = MeanFieldPosterior(problem, self, found_by, seed, None, self.draws)
        posterior.elbos = np.array(best.bounds) + constant
        posterior.bounds = np.array([a.bounds[-1] for a in found]) + constant
        posterior.elbo, posterior.elbo_mcse = float(posterior.elbos[-1]), 0.0
        if plan.free is not None:
            posterior.elbo, posterior.elbo_mcse = measured(plan, best, rng, constant)
        posterior.log_marginal_likelihood = posterior.elbo
        posterior.sweeps, posterior.converged = len(best.bounds), best.converged
        if tied:
            warnings.warn(
                f"MeanField: zero probabilities tie {', '.join(map(repr, tied[:6]))} to others, and "
                "independent factors hold that in one of several ways: states that were left out may be "
                "probable; use Exact() or Gibbs(), or give such nodes one table (blocks=)",
                ReducibleWarning,
                stacklevel=3,
            )
        elif len(places) > 1:
            warnings.warn(told(places, constant), EngineWarning, stacklevel=3)
        if not best.converged:
            gain = best.bounds[-1] - best.bounds[-2] if len(best.bounds) > 1 else np.inf
            warnings.warn(
                f"MeanField: after {len(best.bounds)} sweeps the bound still gained {gain:.2g} in one; ask "
                "for more (sweeps=), or take a larger tolerance",
                ConvergenceWarning,
                stacklevel=3,
            )
        return posterior

    # ---- private -------------------------------------------------------------------------------

    def _plan(self, problem: Problem) -> Plan:
        """The plan of a problem, or the error that there is none, made once."""
        key = tuple(map(tuple, self.blocks or ()))
        kept: dict[Any, Any] = problem.cache.setdefault("mean-field plans", {})
        if key not in kept:
            try:
                kept[key] = plan_for(target_of(problem), self.blocks or ())
            except UnsupportedError as error:
                kept[key] = str(error)
        if isinstance(kept[key], str):
            raise UnsupportedError(kept[key])
        return kept[key]


def measured(
    plan: Plan, best: Ascent, rng: np.random.Generator, constant: float
) -> tuple[float, float]:
    """The bound by other points of the free numbers than it was climbed with, and its error.

    Of a rule of Gauss and Hermite the difference from a finer one, else the standard error of independent
    scrambled sequences.
    """
    assert plan.free is not None
    refuse_jumps(plan, best.state, edges=True)
    free = plan.free
    entropy = sum(f.entropy(best.state) for f in plan.factors) + constant

    def values(z: np.ndarray) -> np.ndarray:
        u = free.placed(z)
        with np.errstate(all="ignore"):
            logs = plan.values({**best.state, FREE: u}) + free.log_volumes(u)
        return np.broadcast_to(logs, len(z))

    def average(z: np.ndarray, weights: np.ndarray) -> float:
        return float(weights @ values(z))

    reach = np.concatenate([_REACH * free.points, rng.standard_normal((_DRAWS, free.size))])
    if (values(reach) == -np.inf).any():  # factors shrink until their points are inside
        raise UnsupportedError(
            f"MeanField: the density of {', '.join(map(repr, free.names[:4]))} is zero within reach of a "
            "normal factor (bounds that depend on other nodes), which would be squeezed in between; use "
            "Gibbs() or HamiltonianMonteCarlo()"
        )
    finer = finer_rule(free.size)
    if finer is not None:
        found = average(*finer)
        return found + entropy, abs(found - average(free.points, free.weights))
    each = [average(*fresh_points(free.size, rng)) for _ in range(_REPEATS)]
    return float(np.mean(each)) + entropy, float(np.std(each, ddof=1)) / np.sqrt(_REPEATS)


def _evened(part: Part, tied: Sequence[str]) -> Part:
    """A table of tied nodes with a share of an even one, but for what was seen."""
    if not isinstance(part, TablePart) or not set(part.names) & set(tied):
        return part
    mixed = (1.0 - _EVEN) * part.table + _EVEN / len(part.table)
    return replace(
        part, table=mixed if part.seen is None else np.where(part.seen, part.table, mixed)
    )
