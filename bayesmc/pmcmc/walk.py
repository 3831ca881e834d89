"""Static nodes moved by a random walk whose likelihood is a filter's estimate: particle marginal Metropolis.

The estimate that a chain stands on is kept until the chain moves: made anew, it would no longer leave the
posterior invariant.

Where chains start, and how many particles they need, is told by a look at the posterior beforehand:
candidates from the prior are weighed by filters of few particles, and drawn anew where they weigh most, a few
times over. It is adaptive importance sampling with weights that are flattened until enough candidates count,
so nothing is claimed of its answer.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import scipy.special

from bayesmc.engines.mcmc.starts import start_states
from bayesmc.kernels.adaptation import chance
from bayesmc.kernels.base import Memory, counted
from bayesmc.kernels.densities import accepted, instead
from bayesmc.kernels.ensemble import BlockWalk
from bayesmc.pmcmc.filters import Filter
from bayesmc.resampling import systematic
from bayesmc.structure.target import Target, Values

#: sweeps of the warmup between two looks at the error of the estimate, and how much of what was seen is kept
_EVERY, _KEPT = 20, 256
#: median of the absolute difference of two normal numbers, in standard deviations of one
_MEDIAN = 0.9539
#: the error of the log likelihood that is taken for granted before the first look
_FIRST_ERROR = 1.0
#: share of accepted steps of length zero below which the walk no longer makes up for the error
_LEAST = 0.25
#: chance of a step to anywhere; in more than so many dimensions, where few are accepted
_ANEW, _FEW, _SELDOM = 0.5, 8, 0.1
#: times the error to aim at, above which the warmup takes more particles than the first look said
_MORE = 1.25
#: particles of the first look, and how many are taken for the error of the log likelihood to aim at
_PILOT, PARTICLES = 100, (50, 5000)
#: degrees of freedom of such steps, and how much wider than what was learnt they are
_DF, _WIDER = 5.0, 1.2

#: candidates of a round, at least; rounds, at most
CANDIDATES, _ROUNDS = 64, 8
#: share of the candidates that are to count
_COUNTING = 0.25
#: width of the noise about the candidates that are drawn again, in standard deviations of all
_WIDTH = 0.5

#: log prior density of points, and an estimate of their log likelihood
Weigh = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


class ParameterWalk(BlockWalk):
    """An adaptive random walk of static nodes, and the trajectory of the filter that was accepted with them.

    Parameters
    ----------
    target : Target
        Of the unrolled net.
    statics : tuple of str
        Continuous static nodes of the chain.
    filter : Filter

    Notes
    -----
    Half of the steps do not start from where a chain is: they are drawn from a Student distribution with the
    mean and the covariance that the warmup has learnt (for angles, and in many dimensions, there are none or
    few).

    An error of the log likelihood lowers the rate at which steps are accepted, by ``erfc(sd / 2)`` for steps
    of length zero. The warmup measures it, and aims at that share of the usual rate, so that steps do not
    shrink because particles are few.

    References
    ----------
    Andrieu, Doucet and Holenstein (2010), JRSS B 72, sec. 2.4.2 (PMMH); Pitt, Silva, Giordani and Kohn
    (2012), J. Econometrics 171, and Sherlock, Thiery, Roberts and Rosenthal (2015), Ann. Statist. 43, on the
    error.
    """

    label = "adaptive random walk"

    def __init__(self, target: Target, statics: tuple[str, ...], filter: Filter) -> None:
        super().__init__(prior_of(target, statics), statics, alone=True)
        self.filter = filter
        self.statics = self.names
        self.names = (*self.statics, *filter.trellis.names)
        #: chance of a step to anywhere
        self.anew = (
            0.0 if self.steps.angles is not None else _ANEW if self.size <= _FEW else _SELDOM
        )
        self.match += f", likelihood by {_particles(filter)}"

    def words(self, name: str) -> tuple[str, str]:
        if name in self.statics:
            return self.label, self.match
        return "particle filter", "drawn with the static nodes"

    def start(self, values: Values, chains: int) -> Memory:
        u, log = self._placed(values)
        return {
            "steps": self.steps.start(u[:, None]),
            "u": u,
            "log": log,
            "log_likelihood": None,
            "particles": self.filter.particles,
            "error": _FIRST_ERROR,
            "looks": np.zeros(0),
            "sweep": 0,
            "accepted": np.zeros(chains),
            "moves": 0,
        }

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        now = {n: values[n] for n in self.names}
        if memory["log_likelihood"] is None:
            found, likelihood = self._estimated(values, memory, rng)
            now = {**now, **found}
            memory = {**memory, "log_likelihood": likelihood}
        u, log, likelihood = memory["u"], memory["log"], memory["log_likelihood"]
        tried, anew, backward = self._tried(memory, rng)
        moved, grown = self._evaluated({**values, **now}, tried)
        state = {**values, **moved}
        self.block.target.refresh(state, self.statics)
        found, estimate = self._estimated(state, memory, rng)
        log_ratio = (grown - log) + (estimate - likelihood) + backward
        accept = accepted(log_ratio, rng)
        new = {n: instead(~accept, v, now[n]) for n, v in {**moved, **found}.items()}
        memory = {
            **memory,
            "u": instead(~accept, tried, u),
            "log": np.where(accept, grown, log),
            "log_likelihood": np.where(accept, estimate, likelihood),
        }
        if not warmup:
            return new, counted(memory, accept)
        rates = np.where(anew, np.nan, chance(log_ratio))
        return new, self._adapted({**values, **new}, memory, rates, rng)

    def located(
        self, values: Values, chains: int, rng: np.random.Generator
    ) -> tuple[Values, int] | None:
        """Values of the static nodes near the mass of their posterior, and how many particles to take.

        None where no candidate is possible; ``values`` has those of other nodes, and as many rows.
        """
        prior, count = self.block.target, max(chains, CANDIDATES)
        start = start_states(prior, count, rng)
        u, _ = self._placed(start)
        start = {**{n: values[n] for n in self.names}, **start}  # trajectories are not looked at
        filter = self.filter.of(_PILOT) if self.filter.chosen else self.filter

        def weigh(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            moved, log = self._evaluated(start, points)
            state = {**start, **moved}
            prior.refresh(state, self.statics)
            return log, filter.run(state, len(points), rng).log_likelihood

        first = weigh(u)[1]
        if not np.isfinite(first).any():
            return None
        points, weights = located(u, first, weigh, rng)
        chosen = points[systematic(weights, chains, rng)]
        rows = {n: v[:chains] if n in self.statics else v for n, v in start.items()}
        moved = {n: v for n, v in self._evaluated(rows, chosen)[0].items() if n in self.statics}
        if not self.filter.chosen:
            return moved, self.filter.particles
        best = points[np.argmin(np.square(points - weights @ points).sum(axis=1))]
        estimates = weigh(np.tile(best, (count, 1)))[1]
        return moved, particles_for(estimates, _PILOT, self.filter.best, *PARTICLES)

    # ---- private -------------------------------------------------------------------------------

    def _estimated(
        self, values: Values, memory: Memory, rng: np.random.Generator
    ) -> tuple[Values, np.ndarray]:
        """A trajectory given the static nodes, and the log of an estimate of their likelihood."""
        filter = self.filter.of(memory["particles"])
        history = filter.run(values, len(values[self.statics[0]]), rng)
        return filter.drawn(history, rng), history.log_likelihood

    def _tried(
        self, memory: Memory, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where chains might go, which go anywhere, and the log chance of the way back less that of the way.

        Which kind a step is does not depend on where a chain is, so that each leaves the posterior invariant.
        """
        u = memory["u"]
        tried = u + self.steps.draw(memory["steps"], rng)[:, 0]
        anew = rng.random(len(u)) < self.anew
        if not anew.any():
            return tried, anew, np.zeros(len(u))
        factor = np.linalg.cholesky(_widened(memory["steps"]["cov"][0]))
        mean = memory["steps"]["mean"][0]
        normal = rng.standard_normal(u.shape) @ factor.T
        heavy = np.sqrt(_DF / rng.chisquare(_DF, len(u)))[:, None]
        tried = np.where(anew[:, None], mean + heavy * normal, tried)
        backward = _student(u - mean, factor) - _student(tried - mean, factor)
        return tried, anew, np.where(anew, backward, 0.0)

    def _adapted(
        self, values: Values, memory: Memory, rates: np.ndarray, rng: np.random.Generator
    ) -> Memory:
        """What the warmup learns: steps, and the error of the estimate."""
        sweep = memory["sweep"] + 1
        memory = {**memory, "sweep": sweep}
        share = max(float(scipy.special.erfc(memory["error"] / 2.0)), _LEAST)
        rates = np.minimum(rates / share, 1.0)[:, None]  # NaN where no step was one of the walk's
        steps = self.steps.learnt(memory["steps"], memory["u"][:, None], rates)
        memory["steps"] = steps
        if sweep % _EVERY:
            return memory
        self.block.target.refresh(values, self.statics)
        once, twice = (self._estimated(values, memory, rng)[1] for _ in range(2))
        with np.errstate(invalid="ignore"):
            apart = np.abs(once - twice)
        looks = np.concatenate([memory["looks"], apart[~np.isnan(apart)]])[-_KEPT:]
        error = float(np.median(looks)) / _MEDIAN if len(looks) else memory["error"]
        memory = {**memory, "error": error, "looks": looks}
        least, most = PARTICLES
        if self.filter.chosen and error > _MORE * self.filter.best and memory["particles"] < most:
            wanted = memory["particles"] * (error / self.filter.best) ** 2
            memory |= {"particles": int(np.clip(wanted, least, most)), "looks": np.zeros(0)}
            memory["log_likelihood"] = None  # made anew, as at the start
        return memory


def prior_of(target: Target, statics: tuple[str, ...]) -> Target:
    """The static nodes by themselves: their own densities, and what is computed from them."""
    inside = set(statics)
    terms = {n: target.terms[n] for n in target.chain if n in inside}
    reached, links = set(statics), []
    for link in target.links:
        parents = {p for p in target.model[link].parents if not target.is_known(p)}
        if parents and parents <= reached:
            reached.add(link)
            links.append(link)
    return replace(target, chain=tuple(terms), links=tuple(links), terms=terms, _below={})


def located(
    points: np.ndarray, log_likelihood: np.ndarray, weigh: Weigh, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Points near the mass of a posterior.

    Parameters
    ----------
    points : ndarray, shape (candidates, size)
        Draws from the prior, of free numbers.
    log_likelihood : ndarray, shape (candidates,)
        Of these, estimated; some may be ``-inf``, not all.
    weigh : callable
        From points to the log of their prior density and an estimate of their log likelihood.

    Returns
    -------
    points : ndarray, shape (candidates, size)
        Candidates of the last round.
    weights : ndarray, shape (candidates,)
        How much each is worth there; they sum to one.

    References
    ----------
    Cappé, Guillin, Marin and Robert (2004), JCGS 13, 907-929 (population Monte Carlo); Koblents and Míguez
    (2015), Statistics and Computing 25 (flattened weights).

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.pmcmc.walk import located
    >>> rng = np.random.default_rng(0)
    >>> def weigh(x):
    ...     return -0.5 * (x[:, 0] / 100) ** 2, -0.5 * ((x[:, 0] - 30) / 0.1) ** 2
    >>> start = rng.normal(0.0, 100.0, (64, 1))
    >>> points, weights = located(start, weigh(start)[1], weigh, rng)
    >>> bool(abs(weights @ points[:, 0] - 30) < 0.1)
    True
    """
    log = log_likelihood
    weights, power = _flattened(log)
    for _ in range(_ROUNDS):
        mean = weights @ points
        away = points - mean
        cov = (weights * away.T) @ away
        cov[np.diag_indices_from(cov)] += 1e-8 * (1.0 + np.diagonal(cov))
        factor = _WIDTH * np.linalg.cholesky(cov)
        noise = rng.standard_normal(points.shape) @ factor.T
        tried = points[systematic(weights, len(points), rng)] + noise
        prior, likelihood = weigh(tried)
        log = prior + likelihood - _log_mixture(tried, points, weights, factor)
        if not (log > -np.inf).any():
            break
        points, done = tried, power == 1.0
        weights, power = _flattened(log)
        if done and power == 1.0:
            break
    return points, weights


def particles_for(
    estimates: np.ndarray, particles: int, error: float, least: int, most: int
) -> int:
    """How many particles give the log likelihood some error, from estimates with ``particles`` at one point.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.pmcmc.walk import particles_for
    >>> estimates = np.random.default_rng(0).normal(-50.0, 2.4, 1000)
    >>> 350 < particles_for(estimates, 100, 1.2, 10, 5000) < 450
    True
    """
    from scipy.stats import median_abs_deviation  # slow to import

    finite = estimates[np.isfinite(estimates)]
    if len(finite) < 2:
        return most
    spread = median_abs_deviation(finite, scale="normal")
    # its variance falls with the number of particles
    return int(np.clip(math.ceil(particles * (spread / error) ** 2), least, most))


# ---- private ------------------------------------------------------------------------------------


def _particles(filter: Filter) -> str:
    return "as many particles as it takes" if filter.chosen else f"{filter.particles} particles"


def _widened(cov: np.ndarray) -> np.ndarray:
    """A covariance made wider, and positive definite where chains have hardly moved."""
    wider = _WIDER**2 * cov
    at = np.diag_indices_from(wider)
    wider[at] += 1e-6 * wider[at] + 1e-300
    return wider


def _student(away: np.ndarray, factor: np.ndarray) -> np.ndarray:
    """Log density of a Student distribution up to a constant."""
    from scipy.linalg import solve_triangular  # slow to import

    scaled = solve_triangular(factor, away.T, lower=True)
    square = np.square(scaled).sum(axis=0)
    return -0.5 * (_DF + away.shape[1]) * np.log1p(square / _DF)


def _flattened(log: np.ndarray) -> tuple[np.ndarray, float]:
    """Weights to the largest power up to one with which enough count, and that power."""
    log = np.where(np.isnan(log), -np.inf, log)
    wanted = min(_COUNTING * len(log), 0.9 * np.isfinite(log).sum())

    def at(power: float) -> np.ndarray:
        return scipy.special.softmax(np.where(log == -np.inf, -np.inf, power * log))

    if 1.0 / np.square(at(1.0)).sum() >= wanted:
        return at(1.0), 1.0
    low, high = 0.0, 1.0
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if 1.0 / np.square(at(middle)).sum() >= wanted else (low, middle)
    return at(low), low


def _log_mixture(
    x: np.ndarray, centres: np.ndarray, weights: np.ndarray, factor: np.ndarray
) -> np.ndarray:
    """Log density of Gaussian noise about weighted centres, up to a constant."""
    from scipy.linalg import solve_triangular  # slow to import

    apart = (x[:, None] - centres[None]).reshape(-1, x.shape[1])
    scaled = solve_triangular(factor, apart.T, lower=True)
    square = np.square(scaled).sum(axis=0).reshape(len(x), len(centres))
    volume = np.log(np.diagonal(factor)).sum()
    return scipy.special.logsumexp(-0.5 * square, b=weights, axis=1) - volume
