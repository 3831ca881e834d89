"""Beliefs row by row: the particles of one slice, and what follows from them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from bayesmc.dbn import DynamicBayesNet, Slices
from bayesmc.engines.beliefs import OnlineBelief
from bayesmc.engines.particles.accuracy import node_errors, value_errors
from bayesmc.engines.particles.answers import (
    covariance,
    elsewhere,
    evaluated,
    expectation,
    mean_of,
    moments,
    probability,
    quantiles,
    table_of_states,
    variance_of,
    weighted_mean,
)
from bayesmc.engines.particles.cloud import Bare, Cloud
from bayesmc.engines.particles.families import Families, evidence_error
from bayesmc.engines.particles.mover import Mover
from bayesmc.errors import QueryError, UnknownNodeError
from bayesmc.network import CompiledNode


class ParticleBelief(OnlineBelief):
    """Particles of one slice, as ``ParticleFilter.start`` and ``step`` give them.

    Attributes
    ----------
    t : int
        The slice; -1 before anything was absorbed.
    log_marginal_likelihood : float or ndarray
        Log density of all rows absorbed so far.
    log_marginal_likelihood_mcse : float or ndarray
        Its root mean square error.
    weight_ess : float or ndarray
        Equally weighted particles that these are worth.
    resampled : bool or ndarray of bool
        Whether they were resampled on the way into this slice.
    weights : ndarray, shape (particles, *plates)
        Normalised weights; the plates are those that are filtered separately.
    ancestors : ndarray of int or None
        Positions among the particles of the slice before; None where everybody has itself.
    rejuvenated : bool or ndarray of bool
        Whether they were drawn anew, since no weight was left (``on_degeneracy="rejuvenate"``).

    Examples
    --------
    >>> import bayesmc as bmc
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    >>> dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    >>> engine = bmc.ParticleFilter(1000)
    >>> belief = engine.start(dbn, rng=0)
    >>> belief = engine.step(belief, {"y": 0.8})
    >>> belief.t, bool(abs(belief.mean("x") - 0.64) < 0.05)
    (0, True)
    """

    def __init__(
        self,
        dbn: DynamicBayesNet | None,
        seed: np.random.SeedSequence,
        static: Mapping[str, Any],
        mover: Mover | Bare | None = None,
        cloud: Cloud | None = None,
        log_marginal_likelihood: Any = 0.0,
        chance: Mapping[str, Any] | None = None,
        inputs: Mapping[str, np.ndarray] | None = None,
        families: Families | None = None,
    ) -> None:
        self.dbn, self.seed, self.static = dbn, seed, dict(static)
        self.mover, self.cloud, self.chance = mover, cloud, chance
        self.inputs = dict(inputs or {})
        self.families = families
        self.log_marginal_likelihood = log_marginal_likelihood
        self.t = -1 if cloud is None else cloud.t

    def __getstate__(self) -> dict[str, Any]:
        """Pickles travel without functions; ``start(dbn, belief=...)`` gives them back."""
        mover = None if self.mover is None else Bare(self.mover.slices, self.mover.layout)
        return {**self.__dict__, "dbn": None, "mover": mover}

    @property
    def slices(self) -> Slices | None:
        """What rows are read against; None before the first."""
        return None if self.mover is None else self.mover.slices

    @property
    def weights(self) -> np.ndarray:
        cloud = self._cloud
        return cloud.weights / cloud.total

    @property
    def weight_ess(self) -> Any:
        ess = self._cloud.ess
        return ess if np.ndim(ess) else float(ess)

    @property
    def resampled(self) -> Any:
        found = self._cloud.resampled
        return found if np.ndim(found) else bool(found)

    @property
    def ancestors(self) -> np.ndarray | None:
        return self._cloud.ancestors

    @property
    def rejuvenated(self) -> Any:
        found = self._cloud.rejuvenated
        return found if np.ndim(found) else bool(found)

    @property
    def names(self) -> tuple[str, ...]:
        """Nodes whose particles are kept."""
        return tuple(self._cloud.values)

    @property
    def log_marginal_likelihood_mcse(self) -> Any:
        """Root mean square error of ``log_marginal_likelihood``; infinite where particles cannot tell it."""
        if self.cloud is None or self.families is None:
            return 0.0
        return evidence_error(self.families, self.cloud)

    def mcse(self, what: str | Callable[..., Any]) -> np.ndarray:
        """Monte Carlo standard error of ``mean(name)`` or of a function's expectation or probability.

        Its shape; of each state's probability, for labels.
        """
        cloud, layout = self._cloud, self._mover.layout
        assert self.families is not None
        if callable(what):
            values = evaluated(layout, cloud, self._mover.slices.first, what)
            mean = weighted_mean(cloud, values)
            there = elsewhere(layout, cloud, self._mover.slices.first, what)
            return value_errors(layout, cloud, self.families, values, mean, there)
        node, value = self._found(what)
        if value.ndim == len(node.value_shape):  # the same for all particles
            labelled = node.domain is not None and node.domain.labels is not None
            return np.zeros(np.shape(self.probabilities(what) if labelled else self.mean(what)))
        if node.domain is not None:
            centre: Any = (self.probabilities(what)[None], None)
        else:
            mean, variance = moments(layout, cloud, node, value)
            centre = (np.asarray(mean)[None], np.asarray(variance)[None])
        return node_errors(layout, cloud, self.families, node, centre)

    def particles(self, name: str) -> np.ndarray:
        """Values of all particles, ``(particles, *plates, *event)``, not weighted."""
        node, value = self._found(name)
        full = np.broadcast_to(value, (len(self._cloud.weights), *node.value_shape))
        return np.array(node.decode(full), subok=True)

    def mean(self, name: str) -> np.ndarray:
        """Mean, shape ``(*plates, *event)``; circular for angles."""
        node, value = self._found(name)
        return mean_of(self._mover.layout, self._cloud, node, value)

    def var(self, name: str) -> np.ndarray:
        """Variance, shape ``(*plates, *event)``; for angles ``-2 log R``."""
        node, value = self._found(name)
        return variance_of(self._mover.layout, self._cloud, node, value)

    def std(self, name: str) -> np.ndarray:
        """Standard deviation, shape ``(*plates, *event)``."""
        return np.sqrt(self.var(name))

    def probabilities(self, name: str) -> np.ndarray:
        """Probabilities of the states of a finite node, shape ``(*plates, states)``."""
        node, value = self._found(name)
        if node.domain is None:
            raise QueryError(
                f"probabilities({name!r}): the node has no finite set of states; use mean, var or expectation"
            )
        return table_of_states(self._mover.layout, self._cloud, node, value)

    def expectation(self, function: Callable[..., Any]) -> np.ndarray:
        """Mean of a function of nodes of the slice, whose arguments have a leading axis of particles."""
        return expectation(self._mover.layout, self._cloud, self._mover.slices.first, function)

    def probability(self, function: Callable[..., Any]) -> np.ndarray:
        """Probability of an event: a function of nodes of the slice that returns booleans."""
        return probability(self._mover.layout, self._cloud, self._mover.slices.first, function)

    def quantile(self, name: str, q: Any) -> np.ndarray:
        """Quantiles, shape ``(*q.shape, *plates, *event)``; those of angles are cut opposite the mean."""
        node, value = self._found(name)
        return quantiles(self._mover.layout, self._cloud, node, value, q)

    def cov(self, *names: str) -> np.ndarray:
        """Covariance matrix of all numbers of the named nodes, in order; of one number, its variance."""
        found = [self._found(name) for name in names]
        return covariance(self._mover.layout, self._cloud, found)

    def __repr__(self) -> str:
        if self.cloud is None:
            return "ParticleBelief(nothing absorbed yet)"
        ess = np.round(self.weight_ess, 1)
        return f"ParticleBelief(t={self.t}, {len(self._cloud.weights)} particles, ess={ess})"

    # ---- private -------------------------------------------------------------------------------

    @property
    def _cloud(self) -> Cloud:
        if self.cloud is None:
            raise QueryError(
                "the belief has absorbed nothing yet (t is -1); step(belief, row) takes in slice 0"
            )
        return self.cloud

    @property
    def _mover(self) -> Mover | Bare:
        assert self.mover is not None
        return self.mover

    def _found(self, name: str) -> tuple[CompiledNode, np.ndarray]:
        cloud = self._cloud
        if name not in cloud.values:
            raise UnknownNodeError(
                f"particles of {name!r} are not kept; there are those of {list(cloud.values)}"
            )
        return self._mover.slices.first[name], cloud.values[name]
