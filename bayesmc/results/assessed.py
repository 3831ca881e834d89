"""What a posterior says of its model: likelihoods point by point, leave-one-out, WAIC, predictive checks.

Mixins: what is asked of every posterior, and how posteriors that hold draws answer.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from bayesmc import diagnostics
from bayesmc.errors import UnsupportedError
from bayesmc.network import Problem
from bayesmc.results.criteria import Elpd, leave_one_out, widely_applicable
from bayesmc.results.over_time import slices_of
from bayesmc.results.pointwise import log_likelihood, observed_nodes, refuse_unobserved
from bayesmc.results.predicted import check_predictions
from bayesmc.results.scales import Scale, scale_of
from bayesmc.results.table import Summary


class Assessed:
    """Questions about the model, which a posterior without draws refuses."""

    def _cannot(self, what: str) -> UnsupportedError:
        raise NotImplementedError

    def log_likelihood(self, *names: str) -> dict[str, np.ndarray]:
        """Log densities of what was observed, given each draw of what it depends on.

        Parameters
        ----------
        names : str
            Observed nodes; all of them where none is named.

        Returns
        -------
        dict of ndarray
            Node -> shape ``(chain, draw, *plates)``; NaN where nothing was observed. Of a template that was
            unrolled ``(chain, draw, time, *plates)``.

        Raises
        ------
        UnknownNodeError, QueryError
        UnsupportedError
            The posterior keeps no draws.
        """
        raise self._cannot("log_likelihood")

    def loo(self, *names: str, log_jacobian: Any = None) -> Elpd:
        """Expected log predictive density by leaving out one observation at a time (PSIS-LOO).

        Parameters
        ----------
        names : str
            Observed nodes; all of them where none is named, each element of their plates by itself.
        log_jacobian : array_like or dict, optional
            Where a node observes z = f(y) and y is to be predicted: ``log |dz/dy|`` of each observation,
            which broadcasts to the node's plates (``-np.log(y)`` for z = log y); a dict from node to array
            where there are several.

        Returns
        -------
        Elpd
            ``elpd``, ``se``, ``p``, ``pointwise``, ``pareto_k``; ``bayesmc.compare`` ranks several.

        Raises
        ------
        UnknownNodeError, QueryError
        UnsupportedError
            The posterior keeps no draws, or weighted ones.

        Warns
        -----
        LowEssWarning
            Some observations cannot be left out by reweighting.

        References
        ----------
        Vehtari, Gelman and Gabry (2017), Practical Bayesian model evaluation using leave-one-out
        cross-validation and WAIC, Statistics and Computing 27.

        Examples
        --------
        >>> import bayesmc as bmc
        >>> net = bmc.BayesNet(plates={"day": 5})
        >>> net.add("mean", bmc.Normal(0.0, 10.0))
        >>> net.add("y", lambda mean: bmc.Normal(mean, 1.0), plates="day")
        >>> posterior = bmc.infer(net, {"y": [0.1, 1.4, -0.3, 0.8, 0.5]}).resample(4000, rng=0)
        >>> posterior.log_likelihood()["y"].shape
        (1, 4000, 5)
        >>> round(posterior.loo().elpd)
        -6
        """
        raise self._cannot("loo")

    def waic(self, *names: str, log_jacobian: Any = None) -> Elpd:
        """The widely applicable information criterion, on the scale of ``loo``, mostly the better one."""
        raise self._cannot("waic")

    def predictive_check(
        self,
        name: str,
        statistics: Mapping[str, Callable[[np.ndarray], Any]] | None = None,
        rng: Any = None,
        draws: int | None = None,
    ) -> Summary:
        """Whether data like those observed would come from the posterior: statistics of both, side by side.

        Parameters
        ----------
        name : str
            An observed node of numbers; of an unrolled template its name there.
        statistics : dict, optional
            Name -> function of one data set, an array of the node's shape (time first), which returns a
            number; by default its mean, standard deviation, smallest and largest value.
        rng : seed, SeedSequence, Generator or None
        draws : int, optional
            How many data sets are drawn, where the posterior is weighted or keeps no draws.

        Returns
        -------
        Summary
            A row for each statistic: ``observed``, ``predicted`` (mean), ``5%`` and ``95%`` of predicted
            ones, and ``p``, the share of those that are larger (half of what is equal): near 0 or 1 where
            the model misses it.

        Raises
        ------
        UnknownNodeError, QueryError, UnsupportedError

        References
        ----------
        Gelman, Meng and Stern (1996), Posterior predictive assessment of model fitness, Statistica Sinica 6.

        Examples
        --------
        >>> import numpy as np
        >>> import bayesmc as bmc
        >>> net = bmc.BayesNet(plates={"day": 6})
        >>> net.add("mean", bmc.Normal(0.0, 10.0))
        >>> net.add("y", lambda mean: bmc.Normal(mean, 1.0), plates="day")
        >>> posterior = bmc.infer(net, {"y": [0.1, 1.4, -0.3, 0.8, 0.5, 9.0]})
        >>> bool(posterior.predictive_check("y", {"max": np.max}, rng=0)["max"]["p"] < 0.01)
        True
        """
        return check_predictions(self, name, statistics, rng, draws)


class AssessedByDraws(Assessed):
    """The answers of posteriors that hold draws."""

    model: Any
    weights: np.ndarray | None
    independent: bool
    ancestors: np.ndarray | None
    ensemble_size: int
    _shape: tuple[int, int]
    _seen: dict[str, Any]
    _inputs: dict[str, np.ndarray]
    _stored: dict[str, np.ndarray]
    _node: Callable[[str], Any]
    _live: Callable[[str], Problem]
    _is_free: Callable[[str], bool]
    _full: Callable[[str, str], np.ndarray]

    def log_likelihood(self, *names: str) -> dict[str, np.ndarray]:
        problem = self._live("log_likelihood")
        seen = self._seen
        chosen = names or observed_nodes(self.model, seen, "log_likelihood")
        for name in chosen:
            self._node((slices_of(self.model, name) or (name,))[0])
        refuse_unobserved(self.model, seen, chosen)
        stored = {**{n: v[None, None] for n, v in self._inputs.items()}, **self._stored}
        return log_likelihood(problem.model, seen, stored, self._shape, chosen)

    def loo(self, *names: str, log_jacobian: Any = None) -> Elpd:
        distinct = None if self.ancestors is None else len(np.unique(self.ancestors))
        told, scale = self._scaled_likelihood("loo", names, log_jacobian)
        return replace(leave_one_out(told, self._relative_ess(), distinct), scale=scale)

    def waic(self, *names: str, log_jacobian: Any = None) -> Elpd:
        told, scale = self._scaled_likelihood("waic", names, log_jacobian)
        return replace(widely_applicable(told), scale=scale)

    def _scaled_likelihood(
        self, what: str, names: tuple[str, ...], log_jacobian: Any
    ) -> tuple[dict[str, np.ndarray], Scale]:
        """Log densities of what is to be predicted, and what these are densities of."""
        told = self._unweighted_likelihood(what, names)
        scale, added = scale_of(what, self.model, self._seen, told, log_jacobian)
        return {n: log + added[n] if n in added else log for n, log in told.items()}, scale

    def _unweighted_likelihood(self, what: str, names: tuple[str, ...]) -> dict[str, np.ndarray]:
        if self.weights is not None:
            raise UnsupportedError(
                f"{what}: these draws are weighted, and their weights would be smoothed as if they "
                "were equal; ask "
                f"resample(draws).{what}()"
            )
        return self.log_likelihood(*names)

    def _relative_ess(self) -> float:
        """Effective over actual draws, on average over all numbers that are not known, as ArviZ has it."""
        if self._shape[0] == 1 or self.independent:
            return 1.0
        found = []
        for name in self.model.nodes:
            if name in self._stored and self._is_free(name):
                stored, trailing = self._stored[name], self.model[name].value_shape
                values = np.broadcast_to(stored, self._shape + trailing).astype(float)
                ess = diagnostics.chain_statistic("mean_ess", values, self.ensemble_size)
                still = (values == values[:1, :1]).all(axis=(0, 1))
                found.append(np.ravel(np.where(still, math.prod(self._shape), ess)))
        sizes = np.concatenate([np.zeros(0), *found])
        sizes = sizes[np.isfinite(sizes)]
        return float(sizes.mean() / math.prod(self._shape)) if sizes.size else 1.0
