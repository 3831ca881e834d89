"""A posterior held as an approximation: closed answers where it has them, draws of it for the rest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.engines.approximate.approximation import Approximation
from bayesmc.engines.approximate.check import Check, checked
from bayesmc.engines.approximate.stored import as_stored, completed
from bayesmc.errors import UnknownNodeError, UnsupportedError
from bayesmc.network import Problem
from bayesmc.randomness import Purpose, seed_sequence, stream
from bayesmc.results import DrawsPosterior, Marginal, Posterior
from bayesmc.results.criteria import Elpd
from bayesmc.results.laws import CurveLaws, Laws
from bayesmc.results.over_time import expanded
from bayesmc.results.posterior import quantile_levels, whole_draws
from bayesmc.results.query import Query

#: draws of an approximation that answer what it has no closed form for
DRAWS = 4000


class ApproximatePosterior(Posterior):
    """Answers of an approximation: biased, by how much ``check`` tells.

    Means, variances, quantiles, probabilities and covariances come from the approximation itself where it
    has them in closed form or by quadrature; these have no Monte Carlo error (``mcse`` 0, ``ess`` infinite).
    All else (functions, nodes on which nothing observed depends) is answered from ``draws`` independent
    draws of it, with their Monte Carlo error. What neither says is how far the approximation is from the
    posterior: ``check`` does. ``log_marginal_likelihood`` is an approximation, too.

    Parameters
    ----------
    problem : Problem
    engine : object
    approximation : Approximation
    seed : SeedSequence
        Of the draws.
    log_marginal_likelihood : float or None
    draws : int
    """

    def __init__(
        self,
        problem: Problem,
        engine: Any,
        approximation: Approximation,
        seed: np.random.SeedSequence,
        log_marginal_likelihood: float | None,
        draws: int = DRAWS,
    ) -> None:
        super().__init__(problem, engine)
        self.approximation = approximation
        self.log_marginal_likelihood = log_marginal_likelihood
        self._seed, self._draws = seed, draws
        self._kept: DrawsPosterior | None = None

    # ---- the approximation's own ---------------------------------------------------------------

    def mean(self, name: str) -> np.ndarray:
        node = self._numeric(name, "mean")
        found = self.approximation.marginal(name)
        if found is not None:
            return np.array(found.mean)
        table = self._table(name)
        if table is None:
            return self._drawn.mean(name)
        assert node.domain is not None
        return table @ np.asarray(node.domain.numbers, dtype=float)

    def var(self, name: str) -> np.ndarray:
        node = self._numeric(name, "var")
        found = self.approximation.marginal(name)
        if found is not None:
            return np.array(found.var)
        table = self._table(name)
        if table is None:
            return self._drawn.var(name)
        assert node.domain is not None
        numbers = np.asarray(node.domain.numbers, dtype=float)
        away = numbers - (table @ numbers)[..., None]
        return (table * away**2).sum(axis=-1)

    def cov(self, *names: str) -> np.ndarray:
        """Covariance matrix of all scalars of the named nodes, in order; of one scalar, its variance.

        Where draws answer, they tell the correlations: the diagonal is that of ``var``.
        """
        if not names:
            raise UnknownNodeError("cov(): name at least one node")
        names = tuple(expanded(self.model, names))
        for name in names:
            self._numeric(name, "cov")
        found = self.approximation.covariance(*names)
        if found is None:
            return self._rescaled(self._drawn.cov(*names), names)
        return found[0, 0] if found.size == 1 else np.array(found)

    def quantile(self, name: str, q: Any) -> np.ndarray:
        self._numeric(name, "quantile")
        levels, found = quantile_levels(name, q), self.approximation.marginal(name)
        if found is None:
            return self._drawn.quantile(name, q)
        shape = self.model[name].value_shape
        return np.array(found.ppf(levels.reshape(levels.shape + (1,) * len(shape))))

    def _laws(self, name: str) -> Laws:
        node = self._node(name)
        found = None if node.domain is not None else self.approximation.marginal(name)
        if found is None:
            return super()._laws(name) if self._is_closed(name) else self._drawn._laws(name)

        def ppf(levels: np.ndarray) -> np.ndarray:
            shape = np.broadcast_shapes(levels.shape, node.value_shape)
            return np.broadcast_to(found.ppf(levels), shape)

        return CurveLaws(node.value_shape, ppf)

    def probabilities(self, *names: str) -> np.ndarray:
        if len(names) == 1:
            self._finite(names[0])
            table = self._table(names[0])
            if table is not None:
                return np.array(table)
        return self._drawn.probabilities(*names)

    def marginal(self, name: str, index: Any = ()) -> Marginal:
        return self._drawn.marginal(name, index)

    def __getitem__(self, name: str) -> np.ndarray:
        return self._drawn[name]

    def resample(self, draws: int | None = None, rng: Any = None) -> DrawsPosterior:
        """Independent draws of the approximation, of equal weight."""
        self._live("resample")
        count = self._draws if draws is None else whole_draws(draws)
        return self._sampled(count, stream(seed_sequence(rng), Purpose.RESAMPLE))

    def predict(
        self,
        names: str | Sequence[str],
        inputs: Mapping[str, Any] | None = None,
        plates: Mapping[str, int] | None = None,
        rng: Any = None,
        draws: int | None = None,
    ) -> Posterior:
        source = self._drawn if draws is None else self.resample(draws, rng)
        return source.predict(names, inputs, plates, rng)

    def log_likelihood(self, *names: str) -> dict[str, np.ndarray]:
        return self._drawn.log_likelihood(*names)

    def loo(self, *names: str, log_jacobian: Any = None) -> Elpd:
        return self._drawn.loo(*names, log_jacobian=log_jacobian)

    def waic(self, *names: str, log_jacobian: Any = None) -> Elpd:
        return self._drawn.waic(*names, log_jacobian=log_jacobian)

    def to_datatree(self, resample: int | None = None, rng: Any = None, **groups: Any) -> Any:
        return self._drawn.to_datatree(resample, rng, **groups)

    # ---- the truth about it --------------------------------------------------------------------

    def check(self, draws: int = DRAWS, rng: Any = None) -> Check:
        """Whether the approximation is near enough to the posterior to be trusted, and corrected answers.

        Draws of the approximation are weighed by the model's own density over that of the approximation.
        Where the shape k of the weights' tail is small, weighted answers are right up to an error that they
        state, and the plain ones are near; where it is above 0.7 neither can be trusted.

        Parameters
        ----------
        draws : int
            25 or more; k wants some thousands.
        rng : seed, SeedSequence, Generator or None

        Returns
        -------
        Check
            ``k``, ``ok``, ``posterior`` (the corrected one, of weighted draws), ``log_marginal_likelihood``;
            it prints as a summary.

        Warns
        -----
        LowEssWarning
            k is above its bound: the corrected answers are as little to be trusted as the plain ones.

        References
        ----------
        Yao, Vehtari, Simpson and Gelman (2018), Yes, but did it work?: Evaluating variational inference,
        ICML, sec. 3.1; Vehtari, Simpson, Gelman, Yao and Gabry (2024), Pareto smoothed importance sampling,
        JMLR 25.

        Examples
        --------
        >>> import bayesmc as bmc
        >>> net = bmc.BayesNet()
        >>> net.add("rate", bmc.Gamma(3.0, 1.0))
        >>> net.add("count", lambda rate: bmc.Poisson(rate))
        >>> posterior = bmc.infer(net, {"count": 4}, engine=bmc.LaplaceApproximation())
        >>> check = posterior.check(rng=0)
        >>> check.ok, float(check.posterior.mean("rate").round(1))  # exactly 3.5
        (True, 3.5)
        """
        return checked(self, self.approximation, draws, stream(seed_sequence(rng), Purpose.CHECK))

    # ---- private -------------------------------------------------------------------------------

    @property
    def _drawn(self) -> DrawsPosterior:
        """Draws of the approximation, made once."""
        if self._kept is None:
            self._kept = self._sampled(self._draws, stream(self._seed, Purpose.INFER))
        return self._kept

    def _sampled(self, draws: int, rng: np.random.Generator) -> DrawsPosterior:
        problem = self._live("draws of an approximation")
        values = completed(
            problem, self.approximation.names, self.approximation.draw(rng, draws), rng
        )
        stored = as_stored(problem, values)
        return DrawsPosterior(problem, self.engine, stored, (1, draws), independent=True)

    def _rescaled(self, drawn: np.ndarray, names: Sequence[str]) -> np.ndarray:
        """Covariances of draws with the variances that ``var`` tells."""
        own = np.concatenate([np.asarray(self.var(n), dtype=float).ravel() for n in names])
        matrix = np.reshape(drawn, (len(own), len(own)))
        with np.errstate(all="ignore"):
            scale = np.sqrt(own / matrix.diagonal())
        scale = np.where(np.isfinite(scale), scale, 1.0)
        found = matrix * scale * scale[:, None]
        np.fill_diagonal(found, own)
        return found[0, 0] if found.size == 1 else found

    def _table(self, name: str) -> np.ndarray | None:
        node = self.model[name]
        return None if node.domain is None else self.approximation.probabilities(name)

    def _is_closed(self, what: str | Query) -> bool:
        if isinstance(what, Query):
            return False
        return self.approximation.marginal(what) is not None or self._table(what) is not None

    def _averaged(self, query: Query) -> np.ndarray:
        return self._drawn._averaged(query)

    def _mcse(self, what: str | Query) -> np.ndarray:
        if self._is_closed(what):
            return np.zeros(self._shape_of(what))
        return self._drawn._mcse(what)

    def _ess(self, what: str | Query) -> np.ndarray:
        if self._is_closed(what):
            return np.full(self._shape_of(what), np.inf)
        return self._drawn._ess(what)

    def _rhat(self, what: str | Query) -> np.ndarray:
        if self._is_closed(what):
            return np.full(self._shape_of(what), np.nan)
        return self._drawn._rhat(what)

    def _shape_of(self, name: Any) -> tuple[int, ...]:
        node = self._node(name)
        labels = node.domain is not None and node.domain.labels is not None
        return (*node.value_shape, node.domain.size) if labels else node.value_shape  # type: ignore[union-attr]

    def bind(self, problem: Problem) -> None:
        """Not possible: what the approximation works out from functions is not in a file.

        Raises
        ------
        UnsupportedError
        """
        raise UnsupportedError(
            f"load(net=): an approximation by {type(self.engine).__name__} goes without its functions; load "
            "it without net= (it answers from its moments and draws), or call infer again"
        )

    def __getstate__(self) -> dict[str, Any]:
        """Pickles travel without the model's functions: draws are made before."""
        if self.problem is not None:
            _ = self._drawn
        return super().__getstate__()
