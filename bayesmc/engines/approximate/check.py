"""``posterior.check``: an approximation held against the model by importance sampling.

Draws of the approximation q are weighed by p/q, with p the model's own functions (not what an engine read of
them, so that faults of reading show, too). The largest weights are replaced by quantiles of a generalised
Pareto distribution that is fitted to them, whose shape k says whether averages of the weights can be trusted.
Corrected answers come from draws with heavier tails, where the approximation has some, and from some of the
prior (``defensive``): what lies beyond the tails of q, or elsewhere, none of its own draws has met, and their
weights cannot tell.

References
----------
Vehtari, Simpson, Gelman, Yao and Gabry (2024), Pareto smoothed importance sampling, JMLR 25, algorithm 1 and
sec. 3.3; Chatterjee and Diaconis (2018), The sample size required in importance sampling, Annals of Applied
Probability 28, sec. 1; Yao, Vehtari, Simpson and Gelman (2018), Yes, but did it work?: Evaluating variational
inference, ICML, sec. 3.1.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from bayesmc.diagnostics import MAX_PARETO_K
from bayesmc.engines.approximate.approximation import Approximation
from bayesmc.engines.approximate.defensive import SHARE, prior_draws
from bayesmc.engines.approximate.weights import (
    EQUAL,
    FINITE,
    CheckedPosterior,
    defended,
    evaluated,
    weighed,
)
from bayesmc.errors import LowEssWarning
from bayesmc.results import DrawsPosterior, Posterior
from bayesmc.results.table import row_names

#: draws of which a tail can be told at all
_FEWEST = 25
#: share of a standard deviation up to which answers are near
_NEAR = 0.15
#: root of how many draws in a rare state tell its deviation to a part of that
_COUNTED = 10.0
#: rows of the summary
_ROWS = 12


class _Row(NamedTuple):
    """A scalar: plain and corrected mean, the error of this, both deviations, and how far both have moved.

    ``wider`` is the share by which the deviation changed; ``moved`` is in corrected deviations.
    """

    name: str
    plain: float
    found: float
    error: float
    before: float
    after: float
    wider: float
    moved: float


@dataclass(frozen=True, eq=False)
class Check:
    """What ``posterior.check`` found; it prints as a summary.

    Attributes
    ----------
    k : float
        Shape of the tail of the weights p/q, or of those of draws with heavier tails (whichever is larger):
        below 0.5 the weights carry corrected answers well, above ``bound`` not. Minus infinity where the
        largest weights are equal, as where the approximation is exact, or states are few.
    bound : float
        The largest k at which as many draws can be trusted, 0.7 of some 2,200 draws or more.
    ok : bool
        Whether ``k`` is below it, and the engine settled.
    moved : float
        How far the mean that is farthest off moved when it was corrected, in standard deviations.
    posterior : Posterior
        Corrected answers: draws with smoothed weights, and Monte Carlo errors that count these. Beside the
        approximation's own there are a quarter as many of the prior, unless all its weights are equal and
        none of these exceeds them.
    log_marginal_likelihood, log_marginal_likelihood_mcse : float
        The corrected log evidence, and its error.
    approximate, approximation : Posterior, Approximation
        What was checked.
    draws : int
    """

    k: float
    bound: float
    posterior: CheckedPosterior
    approximate: Posterior = field(repr=False)
    approximation: Approximation = field(repr=False)
    draws: int

    @property
    def ok(self) -> bool:
        return bool(self.k < self.bound) and self._is_settled

    @property
    def moved(self) -> float:
        return max(
            (abs(row.moved) if np.isfinite(row.moved) else np.inf for row in self._rows),
            default=0.0,
        )

    @property
    def log_marginal_likelihood(self) -> float:
        assert self.posterior.log_marginal_likelihood is not None
        return self.posterior.log_marginal_likelihood

    @property
    def log_marginal_likelihood_mcse(self) -> float:
        assert self.posterior.log_marginal_likelihood_mcse is not None
        return self.posterior.log_marginal_likelihood_mcse

    def __str__(self) -> str:
        own, ess = self.posterior.k, self.posterior.weight_ess
        words = "right within their errors"
        if not own < self.bound:
            words = "not to be trusted, either: ask HamiltonianMonteCarlo() or Gibbs()"
        besides, unseen = "", "the approximation never reaches"
        if self.posterior.of_prior:
            besides = f" and {self.posterior.of_prior} of the prior"
            unseen = "the approximation and these never reach"
        lines = [
            f"Check of {type(self.approximate.engine).__name__} by {self.draws} draws{besides}, weighed in "
            f"the nodes' own coordinates (made in {self.approximation.coordinates})",
            f"Pareto k {self.k:.2f} (bound {self.bound:.2f}): plain answers are {self._plain_words()}",
            f"corrected ones, by draws with k {own:.2f} worth {ess:.0f}, are {words}",
            f"neither k nor the errors tell of regions that {unseen}: other modes, states with numbers far "
            "off",
        ]
        plain = self.approximate.log_marginal_likelihood
        if plain is not None:
            lines.append(
                f"log evidence {plain:.4f}, corrected {self.log_marginal_likelihood:.4f} "
                f"+- {self.log_marginal_likelihood_mcse:.4f}"
            )
        return "\n".join([*lines, *self._moved()])

    @cached_property
    def _unweighted(self) -> DrawsPosterior:
        own = self.posterior
        return DrawsPosterior(
            own._live("check"), own.engine, own._stored, own._shape, independent=True
        )

    @property
    def _is_settled(self) -> bool:
        return bool(getattr(self.approximate, "converged", True))

    def _plain_words(self) -> str:
        if not self.ok:
            return "not to be trusted" if self._is_settled else "of a run that did not settle"
        off = max(self.moved, max((abs(row.wider) for row in self._rows), default=0.0))
        return "near" if self.k < FINITE and off < _NEAR else "off by what is printed"

    @cached_property
    def _rows(self) -> list[_Row]:
        """Hidden scalars by how far their means moved."""
        rows: list[_Row] = []
        for name in self.posterior.names:
            node = self.posterior.model[name]
            if not self.posterior._is_free(name) or (node.domain and node.domain.labels):
                continue
            # of what draws answer, the same draws without weights, unless these have heavier tails
            own = self.approximation
            closed = own.marginal(name) is not None or own.probabilities(name) is not None
            others = getattr(own, "spread", None) is not None or self.posterior.of_prior
            is_plain = closed or others
            before_weights = self.approximate if is_plain else self._unweighted
            plain, found = (p.mean(name).ravel() for p in (before_weights, self.posterior))
            before, after = (p.std(name).ravel() for p in (before_weights, self.posterior))
            error = np.broadcast_to(self.posterior.mcse(name), node.value_shape).ravel()
            least = self._least_deviation(name)
            one, two = np.maximum(before, least), np.maximum(after, least)
            with np.errstate(all="ignore"):
                certain = np.where(np.abs(found - plain) > EQUAL, np.inf, 0.0)
                moved = np.where(two > EQUAL * one, (found - plain) / two, certain)
                one, two = (np.maximum(sd, _COUNTED * least) for sd in (before, after))
                wider = np.where(one > 0, two / one - 1.0, 0.0)
            labels = row_names(node, self.posterior.model.labels)
            both = zip(labels, plain, found, error, before, after, wider, moved, strict=True)
            hidden = self._hidden(name).ravel()
            rows += [_Row(*row) for row, is_hidden in zip(both, hidden, strict=True) if is_hidden]
        rows.sort(key=lambda row: -abs(row.moved) if np.isfinite(row.moved) else -np.inf)
        return rows

    def _hidden(self, name: str) -> np.ndarray:
        """Which scalars of a node were not seen."""
        shape = self.posterior.model[name].value_shape
        problem = self.posterior.problem
        seen = None if problem is None else problem.observed.get(name)
        if seen is None or seen.mask is None:
            return np.ones(shape, dtype=bool)
        inner = (1,) * (len(shape) - seen.mask.ndim)
        hidden = ~np.broadcast_to(seen.mask.reshape(seen.mask.shape + inner), shape)
        return hidden if seen.parts is None else hidden & ~np.broadcast_to(seen.parts, shape)

    def _least_deviation(self, name: str) -> float:
        """What so many draws can tell of a state that is next to certain: one draw in another."""
        domain, ess = self.posterior.model[name].domain, self.posterior.weight_ess
        if domain is None or not ess:
            return 0.0
        return float(np.ptp(np.asarray(domain.numbers, dtype=float))) / float(np.sqrt(ess))

    def _moved(self) -> list[str]:
        """The scalars whose means moved most, in standard deviations."""
        rows = self._rows
        if not rows:
            return []
        width = max(len(row[0]) for row in rows[:_ROWS])
        lines = [
            f"{'':{width}}  {'mean':>10} {'corrected':>10} {'mcse':>9} {'sd':>10} {'corrected':>10}"
            f" {'moved/sd':>9}"
        ]
        lines += [
            f"{n:{width}}  {a:10.4g} {b:10.4g} {e:9.2g} {c:10.4g} {d:10.4g} {m:9.2f}"
            for n, a, b, e, c, d, _, m in rows[:_ROWS]
        ]
        if len(rows) > _ROWS:
            lines.append(f"... and {len(rows) - _ROWS} that moved less")
        return lines


def checked(
    posterior: Posterior, approximation: Approximation, draws: int, rng: np.random.Generator
) -> Check:
    """See ``ApproximatePosterior.check``."""
    if isinstance(draws, bool) or not isinstance(draws, (int, np.integer)) or draws < _FEWEST:
        raise ValueError(
            f"check(draws={draws!r}): draws is a whole number, {_FEWEST} or more, such as 4000"
        )
    batch = evaluated(posterior, approximation, approximation.draw(rng, int(draws)), rng)
    own = weighed(posterior, batch, batch.ratio)
    spread, found = getattr(approximation, "spread", None), own
    # equal weights say that it is exact, unless it has left states out that no draw meets
    exact = own.k == -np.inf and not (spread is not None and hasattr(approximation, "tied"))
    if spread is not None and not exact:
        batch = evaluated(posterior, approximation, spread(rng, int(draws)), rng)
        found = weighed(posterior, batch, batch.ratio)
    others = prior_draws(posterior._live("check"), approximation, _others(int(draws)), rng)
    if others is not None:
        besides = evaluated(posterior, approximation, others, rng)
        # what is drawn from with heavier tails has half the approximation's own density at least
        slack = np.log(2.0) if spread is not None else 0.0
        if not (exact and besides.ratio.max() < batch.ratio.max() + slack + EQUAL):
            found = defended(posterior, batch, besides)
    # mass that the approximation's own draws never meet shows in others
    k = max(own.k, found.k)
    result = Check(k, _bound(int(draws)), found, posterior, approximation, int(draws))
    if not k < result.bound:
        warnings.warn(_doubt(result), LowEssWarning, stacklevel=3)
    return result


# ---- private ------------------------------------------------------------------------------------


def _others(draws: int) -> int:
    """Draws of the prior beside so many others."""
    return max(round(draws * SHARE / (1.0 - SHARE)), 1)


def _doubt(check: Check) -> str:
    words = (
        f"check: the weights of {check.draws} draws of {type(check.approximate.engine).__name__} have a "
        f"heavy tail (Pareto k = {check.k:.2f}, above {check.bound:.2f}): its answers cannot be trusted, "
    )
    own = check.posterior.k
    if own < check.bound:
        return (
            words
            + f"those corrected by draws with heavier tails (k = {own:.2f}) with care, since they rest "
            f"on {check.posterior.weight_ess:.0f} draws' worth; better ask a sampling engine "
            "(HamiltonianMonteCarlo(), Gibbs())"
        )
    return (
        words
        + "nor can the corrected ones; ask a sampling engine (HamiltonianMonteCarlo(), Gibbs())"
    )


def _bound(draws: int) -> float:
    """The largest k at which so many draws do (Vehtari et al. 2024, eq. 13), 0.7 at most."""
    return min(1.0 - 1.0 / float(np.log10(draws)), MAX_PARETO_K)
