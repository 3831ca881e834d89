"""What a run over many slices keeps of its clouds: answers of constant size, or the particles themselves."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from bayesmc.dbn import SeriesProblem
from bayesmc.engines.averages import naming
from bayesmc.engines.filtering import Queries, first_slices, observed_answers, refuse_forecast
from bayesmc.engines.particles.accuracy import MeanErrors, value_errors
from bayesmc.engines.particles.answers import (
    covariance,
    elsewhere,
    evaluated,
    expectation,
    moments,
    probability,
    quantiles,
    table_of_states,
    weighted_mean,
)
from bayesmc.engines.particles.cloud import Cloud, Layout
from bayesmc.engines.particles.families import Families, evidence_error
from bayesmc.engines.particles.sharing import Sharing, function_errors
from bayesmc.engines.particles.sharing import node_errors as smoothed_errors
from bayesmc.errors import QueryError
from bayesmc.results import SeriesPosterior


class Record:
    """Answers about each slice, written as the slices pass.

    Parameters
    ----------
    problem : SeriesProblem
    layout : Layout
    queries : dict
    keep : bool
        Hold the clouds, too.
    """

    def __init__(
        self, problem: SeriesProblem, layout: Layout, queries: Queries, keep: bool
    ) -> None:
        self.problem, self.layout, self.asked = problem, layout, queries
        steps, model = problem.steps, problem.model
        self.clouds: list[Cloud] | None = [] if keep else None
        self.tables: dict[str, np.ndarray] = {}
        self.means: dict[str, np.ndarray] = {}
        self.variances: dict[str, np.ndarray] = {}
        for name in problem.hidden:
            node = model[name]
            if node.domain is not None:
                self.tables[name] = np.empty((steps, *node.plate_shape, node.domain.size))
            else:
                self.means[name] = np.empty((steps, *node.value_shape))
                self.variances[name] = np.empty((steps, *node.value_shape))
        self.queries: dict[str, list[np.ndarray]] = {n: [] for n in queries}
        self.increments = np.empty((steps, *layout.lead))
        self.ess = np.empty((steps, *layout.lead))
        self.resampled = np.zeros((steps, *layout.lead), dtype=bool)
        self.rejuvenated = np.zeros((steps, *layout.lead), dtype=bool)
        self.unique = np.full((steps, *layout.lead), layout.particles)
        self.counts = np.empty(steps, dtype=np.intp)
        self.anew = np.zeros(steps, dtype=np.intp)
        self._nodes = [(n, model[n], len(model[n].value_shape)) for n in problem.hidden]
        self.errors = MeanErrors(
            layout,
            [model[n] for n in problem.hidden],
            steps,
            (self.means, self.variances, self.tables),
        )
        self.query_errors: dict[str, list[np.ndarray]] = {n: [] for n in queries}
        self._last: tuple[Families, Cloud] | None = None
        self.families: list[Families] | None = [] if keep else None

    def add(self, k: int, cloud: Cloud, families: Families | None = None) -> None:
        """Take in the cloud of the k-th slice, and whose descendants its particles are."""
        layout = self.layout
        self.increments[k] = cloud.increment
        self.ess[k] = cloud.ess
        self.resampled[k] = cloud.resampled
        self.counts[k], self.anew[k] = len(cloud.weights), cloud.anew
        if cloud.ancestors is not None:
            changes = cloud.ancestors[1:] != cloud.ancestors[:-1]
            along = 0 if layout.apart else None  # without an axis it is ten times faster
            self.unique[k] = np.count_nonzero(changes, axis=along) + 1
        if cloud.rejuvenated is not False:
            self.rejuvenated[k] = cloud.rejuvenated
            self.unique[k] = np.where(cloud.rejuvenated, 0, self.unique[k])
        for name, node, rank in self._nodes:
            value = cloud.values[name]
            if node.domain is not None:
                self.tables[name][k] = table_of_states(layout, cloud, node, value)
            elif value.ndim == rank:  # seen here, or the same for all particles
                self.means[name][k], self.variances[name][k] = value, 0.0
            else:
                self.means[name][k], self.variances[name][k] = moments(layout, cloud, node, value)
        for name, function in self.asked.items():
            with naming(name):
                values = evaluated(layout, cloud, self.problem.model, function)
            mean = weighted_mean(cloud, values)
            self.queries[name].append(mean)
            if families is not None:
                there = elsewhere(layout, cloud, self.problem.model, function)
                errors = value_errors(layout, cloud, families, values, mean, there)
                self.query_errors[name].append(errors)
        if families is not None:
            self.errors.add(k, cloud, families)
            self._last = (families, cloud)
        if self.clouds is not None:
            self.clouds.append(cloud)
            if self.families is not None and families is not None:
                self.families.append(families)

    def posterior(
        self, engine: Any, kind: str = "filter", steps: int | None = None
    ) -> FilteredParticles:
        """The answers of all slices, or of the first so many."""
        k = self.problem.steps if steps is None else steps
        seen = observed_answers(self.problem, k)
        found = FilteredParticles(
            self.problem.model,
            engine,
            kind,
            self.increments[:k],
            tables={**seen.tables, **first_slices(self.tables, k)},
            means={**seen.means, **first_slices(self.means, k)},
            variances={**seen.variances, **first_slices(self.variances, k)},
            queries={n: np.stack(rows[:k]) for n, rows in self.queries.items()},
            start=self.problem.series.start,
        )
        found.weight_ess, found.resampled = self.ess[:k], self.resampled[:k]
        found.unique_ancestors, found.rejuvenated = self.unique[:k], self.rejuvenated[:k]
        found.counts, found.anew = self.counts[:k], self.anew[:k]
        found.clouds = None if self.clouds is None else self.clouds[:k]
        found.layout = self.layout
        if self._last is not None:
            found.log_marginal_likelihood_mcse = evidence_error(*self._last)
            found.mean_errors = first_slices(self.errors.found(), k)
            rows = self.query_errors.items()
            found.queries_mcse = {n: np.stack(errors[:k]) for n, errors in rows}
            found.families = self.families and self.families[:k]
        return found

    def smoothed(
        self, engine: Any, sharing: Sharing, filtered: FilteredParticles
    ) -> FilteredParticles:
        """The answers of trajectories, with their errors: infinite where the filter's are."""
        found = self.posterior(engine, "smooth")
        assert found.clouds is not None and filtered.mean_errors is not None
        found.sharing, found.mean_errors = sharing, {}
        for name, node, _ in self._nodes:
            labels = node.domain is not None
            centre: Any = (
                (self.tables[name], None) if labels else (self.means[name], self.variances[name])
            )
            errors = smoothed_errors(sharing, self.layout, found.clouds, node, centre)
            lost = np.isinf(filtered.mean_errors[name])
            found.mean_errors[name] = np.where(lost, np.inf, errors)
        found.queries_mcse = {n: found.mcse(function) for n, function in self.asked.items()}
        return found


class FilteredParticles(SeriesPosterior):
    """What a particle filter says of every slice.

    Attributes
    ----------
    clouds : list of Cloud or None
        Particles of all slices, with ``keep="particles"``; functions of nodes, quantiles and covariances can
        be asked for then.
    counts : ndarray of int, shape (time,)
        Particles of each slice: always as many, unless ``adapt=`` says otherwise.
    anew : ndarray of int, shape (time,)
        How many of them ``recovery=`` let begin anew.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 1.0), initial=bmc.Normal(0.0, 2.0))
    >>> dbn.add("y", lambda x: bmc.StudentT(4.0, x, 0.5))
    >>> engine = bmc.ParticleFilter(1000)
    >>> filtered = bmc.filter(dbn, {"y": [1.2, 0.4]}, engine=engine, rng=0, keep="particles")
    >>> filtered.quantile("x", [0.1, 0.9]).shape, filtered.probability(lambda x: x > 0).shape
    ((2, 2), (2,))
    """

    counts: np.ndarray | None = None
    anew: np.ndarray | None = None
    clouds: list[Cloud] | None = None
    layout: Layout | None = None
    families: list[Families] | None = None
    #: of trajectories that were drawn backwards
    sharing: Sharing | None = None

    def mcse(self, what: str | Callable[..., Any]) -> np.ndarray:
        """As of any series; with ``keep="particles"`` a function of nodes has errors, too."""
        if not callable(what):
            return super().mcse(what)
        clouds, layout = self._kept("mcse of a function")
        if self.sharing is not None:
            values = np.stack([evaluated(layout, c, self.model, what) for c in clouds])
            return function_errors(self.sharing, values, values.mean(axis=1))
        assert self.families is not None
        rows = []
        for cloud, families in zip(clouds, self.families, strict=True):
            values = evaluated(layout, cloud, self.model, what)
            mean = weighted_mean(cloud, values)
            there = elsewhere(layout, cloud, self.model, what)
            rows.append(value_errors(layout, cloud, families, values, mean, there))
        return np.stack(rows)

    def particles(self, name: str) -> np.ndarray:
        """Particles of all slices, shape ``(time, particles, *plates, *event)``, not weighted."""
        clouds, layout = self._alike("particles")
        node = self._node(name)
        shape = (layout.particles, *node.value_shape)
        rows = [np.broadcast_to(c.values[name], shape) for c in clouds]
        return np.array(node.decode(np.stack(rows)), subok=True)

    @property
    def weights(self) -> np.ndarray:
        """Normalised weights of all slices, shape ``(time, particles, *plates)``."""
        clouds, _ = self._alike("weights")
        return np.stack([c.weights / c.total for c in clouds])

    @property
    def ancestors(self) -> np.ndarray:
        """Positions of the ancestors in the slice before, shape ``(time, particles, *plates)``.

        Particles that were drawn anew have none: -1.
        """
        clouds, layout = self._alike("ancestors")
        own = np.arange(layout.particles).reshape((-1,) + (1,) * len(layout.apart))
        shape = (layout.particles, *layout.lead)
        rows = []
        for cloud in clouds:
            found = own if cloud.ancestors is None else cloud.ancestors
            rows.append(np.broadcast_to(np.where(cloud.rejuvenated, -1, found), shape))
        return np.stack(rows)

    def last(self, steps: int, kind: str) -> SeriesPosterior:
        """The last so many slices by themselves."""
        refuse_forecast(self, kind)
        return super().last(steps, kind)

    def expectation(self, function: Callable[..., Any]) -> np.ndarray:
        """Means of a function of nodes of a slice, time first; see ``ParticleBelief.expectation``."""
        clouds, layout = self._kept("expectation")
        return np.stack([expectation(layout, c, self.model, function) for c in clouds])

    def probability(self, function: Callable[..., Any]) -> np.ndarray:
        """Probabilities of an event (a function that returns booleans), time first."""
        clouds, layout = self._kept("probability")
        return np.stack([probability(layout, c, self.model, function) for c in clouds])

    def quantile(self, name: str, q: Any) -> np.ndarray:
        """Quantiles, shape ``(time, *q.shape, *plates, *event)``."""
        clouds, layout = self._kept("quantile")
        node = self._node(name)
        return np.stack([quantiles(layout, c, node, c.values[name], q) for c in clouds])

    def cov(self, *names: str) -> np.ndarray:
        """Covariance matrices of all numbers of the named nodes, time first; of one number, its variance."""
        clouds, layout = self._kept("cov")
        nodes = [self._node(name) for name in names]
        rows = [covariance(layout, c, [(n, c.values[n.name]) for n in nodes]) for c in clouds]
        return np.stack(rows)

    def _alike(self, what: str) -> tuple[list[Cloud], Layout]:
        """The clouds, where each has as many particles."""
        clouds, layout = self._kept(what)
        if any(len(c.weights) != layout.particles for c in clouds):
            raise QueryError(
                f"{what}: the number of particles changes from slice to slice (adapt=); see .clouds"
            )
        return clouds, layout

    def _kept(self, what: str) -> tuple[list[Cloud], Layout]:
        if self.clouds is None or self.layout is None:
            raise self._not_kept(what)
        return self.clouds, self.layout
