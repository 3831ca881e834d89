"""Posteriors over time: what a filter or smoother says of every slice, time first.

One class for all families: tables of probabilities for finite nodes, means and variances for numbers, worked
out while the slices passed by. What a family keeps besides (particles, joint covariances) it says itself.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesmc.errors import QueryError, UnknownNodeError, UnsupportedError, did_you_mean
from bayesmc.network import CompiledNode, Model
from bayesmc.results.laws import Laws, NormalLaws, TableLaws, curve_between
from bayesmc.results.marginal_answers import MarginalAnswers
from bayesmc.results.posterior import quantile_levels
from bayesmc.results.saving import save
from bayesmc.results.series_checks import SeriesChecks
from bayesmc.results.shown import ShownSeries
from bayesmc.results.statistics import table_variance

#: what is asked of answers over time that has another name here, or that only some filters have
_INSTEAD = {
    "ess": "weight_ess has the effective number of particles of each slice (of a ParticleFilter)",
    "interval": "ask hdi(name, prob) or quantile(name, [0.05, 0.95])",
    "draws": 'a ParticleFilter has particles(name), with keep="particles"',
    "samples": 'a ParticleFilter has particles(name), with keep="particles"',
    "particles": "a ParticleFilter has those",
    "summary": "mean(name), std(name) and quantile(name, q) are arrays, time first",
    "density": "a GridFilter has those",
    "grid": "a GridFilter has those",
    "pairs": "a DiscreteFilter has those",
    "cov": 'Kalman filters have those, and a ParticleFilter with keep="particles"',
    "expectation": "give queries={name: function} to the call",
    "probability": "give queries={name: function} to the call, whose mean is the probability of an event",
    "nis": "Kalman filters have those; row_deficits are every filter's",
    "nis_df": "Kalman filters have those",
}


class SeriesPosterior(SeriesChecks, MarginalAnswers, ShownSeries):
    """Beliefs about the nodes of every slice.

    Attributes
    ----------
    engine : object
    kind : str
        ``"filter"`` (slice t given rows 0 to t), ``"smooth"`` (given all rows), ``"fixed-lag"`` or
        ``"forecast"``.
    steps : int
    start : int
        The slice that the first entry belongs to.
    times : ndarray or None, shape (time,)
        What labels the slices in the data (dates), where they said.
    log_marginal_likelihood : float or ndarray
        Log density of all rows; one for each element of the plates that are filtered separately. Given static
        nodes that are known, whose own densities are not part of it (of ``infer`` on a template they are).
    log_marginal_increments : ndarray, shape (time,) or (time, *plates)
        Log density of each row given those before; they add up to the above.
    log_marginal_likelihood_mcse : float, ndarray or None
        Its error: the root mean square error of filters that draw (bias included, infinite where the
        particles cannot tell it), a bound for a grid that was found (NaN for one that was given), 0 where it
        is exact, None where nothing is known of it (tangents and sigma points).
    weight_ess : ndarray or None, shape (time,) or (time, *plates)
        Equally weighted particles that those of each slice are worth, before they are resampled.
    resampled : ndarray of bool or None
        Whether particles were resampled on the way into a slice.
    unique_ancestors : ndarray of int or None
        Particles of the slice before that have offspring in this one.
    rejuvenated : ndarray of bool or None
        Whether particles were drawn anew, since no weight was left; evidence and answers are biased then.
    queries : dict
        Name -> expectation of a function in every slice, time first.
    row_ranks : ndarray or None, shape (time,) or (time, *plates)
        Share of the rows that the filter expected which are less likely than the one that came: uniform where
        the model is right, near 0 where rows surprise it. NaN where nothing was seen or compared: Gaussian
        filters compare all rows, the others 8 or every 12th, and more after an unlikely one (of wide ones,
        such as scans, 16 or every 32nd; discrete filters 60 at most), with a few rows drawn from their
        particles, cells or states. None from other engines, and of fewer than five rows.
    row_deficits : ndarray or None, shape (time,) or (time, *plates)
        By how many nats per observed number each row is less likely than expected; 0 on average.
    queries_mcse : dict
        Name -> standard errors of ``queries``, where the engine states some. Of an event that no point of a
        quadrature or grid saw, or every one, the largest probability between neighbouring points.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.table("rain", ["rain_prev"], [[0.7, 0.3], [0.3, 0.7]], initial=[0.5, 0.5])
    >>> dbn.table("umbrella", ["rain"], [[0.8, 0.2], [0.1, 0.9]])
    >>> filtered = bmc.filter(dbn, {"umbrella": [1, 1]})
    >>> filtered.probabilities("rain").round(3).tolist()
    [[0.182, 0.818], [0.117, 0.883]]
    """

    times: np.ndarray | None = None
    weight_ess: np.ndarray | None = None
    resampled: np.ndarray | None = None
    unique_ancestors: np.ndarray | None = None
    rejuvenated: np.ndarray | None = None
    log_marginal_likelihood_mcse: Any = None
    #: errors of means by node, time first; a node that is left out has none
    mean_errors: Mapping[str, np.ndarray] | None = None

    def __init__(
        self,
        model: Model,
        engine: Any,
        kind: str,
        increments: np.ndarray | None,
        *,
        tables: Mapping[str, np.ndarray] | None = None,
        means: Mapping[str, np.ndarray] | None = None,
        variances: Mapping[str, np.ndarray] | None = None,
        queries: Mapping[str, np.ndarray] | None = None,
        steps: int | None = None,
        start: int = 0,
    ) -> None:
        self.model = model
        self.engine = engine
        self.kind = kind
        self._tables = dict(tables or {})
        self._means = dict(means or {})
        self._variances = dict(variances or {})
        self.queries = dict(queries or {})
        self.queries_mcse: dict[str, np.ndarray] = {}
        self.start = start
        self.log_marginal_increments = increments
        self.log_marginal_likelihood: Any = None
        if increments is not None:
            total = increments.sum(axis=0)
            self.log_marginal_likelihood = total if increments.ndim > 1 else float(total)
            if getattr(engine, "is_exact", False):
                self.log_marginal_likelihood_mcse = np.zeros(total.shape) if total.ndim else 0.0
        answered = next(iter([*self._tables.values(), *self._means.values()]), None)
        if steps is None:
            found = increments if increments is not None else answered
            steps = 0 if found is None else len(found)
        self.steps = steps

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            hint = f"; {_INSTEAD[name]}" if name in _INSTEAD else ""
            raise AttributeError(
                f"{type(self).__name__!r} has no {name!r}{hint}", name=name, obj=self
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Nodes that are answered for, parents first."""
        return tuple(n for n in self.model.nodes if n in self._tables or n in self._means)

    def mean(self, name: str) -> np.ndarray:
        """Means, shape ``(time, *plates, *event)``; circular for angles; labels have none.

        Raises
        ------
        UnknownNodeError, QueryError, UnsupportedError
        """
        node = self._node(name)
        if name in self._tables:
            return self._tables[name] @ self._numbers(node)
        return self._means[name].copy()

    def var(self, name: str) -> np.ndarray:
        """Variances, shape ``(time, *plates, *event)``; for angles ``-2 log R``."""
        node = self._node(name)
        if name in self._tables:
            return table_variance(self._tables[name], self._numbers(node, "variance"))
        return self._variances[name].copy()

    def std(self, name: str) -> np.ndarray:
        """Standard deviations, shape ``(time, *plates, *event)``."""
        return np.sqrt(self.var(name))

    def probabilities(self, name: str, *others: str) -> np.ndarray:
        """Probabilities of the states of a finite node, shape ``(time, *plates, states)``.

        Raises
        ------
        UnknownNodeError, UnsupportedError
        QueryError
            The node is not finite, or several are named: answers are kept node by node.
        """
        self._node(name)
        if others:
            raise no_joint_table((name, *others), "give", "queries={'both': %s} to the call")
        if name not in self._tables:
            raise QueryError(
                f"probabilities({name!r}): the node has no finite set of states; use mean or var, or give "
                "queries={name: function} to the call"
            )
        return self._tables[name].copy()

    def quantile(self, name: str, q: Any) -> np.ndarray:
        """Quantiles, shape ``(time, *q.shape, *plates, *event)``.

        Here of nodes with finitely many numbers, the least at or below which so much lies, and of what was
        seen; other answers have those of their kind.

        Raises
        ------
        UnknownNodeError, QueryError
        UnsupportedError
            Means and variances alone do not tell them.
        """
        node, levels = self._node(name), quantile_levels(name, q)
        if name in self._tables:
            numbers, table = self._numbers(node, "quantile"), self._tables[name]
            below = table.cumsum(axis=-1)
            # rounding of the sum must not carry a level to the next number
            wanted = levels.reshape(1, -1, *(1,) * (table.ndim - 1)) * (1 - 1e-12)
            at = (below[:, None] < wanted * below[:, None, ..., -1:]).sum(axis=-1)
            found = numbers[np.minimum(at, len(numbers) - 1)]
            return found.reshape((len(table), *levels.shape, *table.shape[1:-1]))
        mean = self._means[name]
        if np.any(self._variances[name] != 0):
            raise UnsupportedError(
                f"{name!r} has no quantile, median, hdi, cdf, mode or entropy here: this result ({self.kind} "
                f"by {type(self.engine).__name__}) knows its means and variances alone; ask for the mean of "
                "an event, queries={name: function}, or take a ParticleFilter with "
                'keep="particles" or another engine'
            )
        every = np.repeat(mean[:, None], levels.size, axis=1)
        return every.reshape((len(mean), *levels.shape, *mean.shape[1:]))

    def mcse(self, what: Any) -> Any:
        """Monte Carlo standard errors of ``mean(name)``, time first; of each probability, for labels.

        Exact answers have none: 0. Those of a filter that approximates and draws nothing (Gaussians that are
        merged, clusters, tangents, a grid) have an error that is not of chance, and unknown: None. Those of
        particles come from the families of particles of earlier slices, those of trajectories drawn backwards
        from which of them share particles (see ``ParticleFilter``); infinite where nobody can tell.

        Raises
        ------
        UnknownNodeError
        UnsupportedError
            Functions, unless particles are kept, as ``smooth`` does without ``lag=``.
        """
        if callable(what):
            raise UnsupportedError(
                "mcse: give a node's name, or the function in queries=, whose errors are in queries_mcse"
            )
        node = self._node(what)
        if self.mean_errors is not None and what in self.mean_errors:
            return self.mean_errors[what].copy()
        if self.mean_errors is None and not getattr(self.engine, "is_exact", True):
            return None
        labelled = node.domain is not None and node.domain.labels is not None
        return np.zeros(np.shape(self.probabilities(what) if labelled else self.mean(what)))

    def last(self, steps: int, kind: str) -> SeriesPosterior:
        """The last so many slices by themselves."""

        def cut(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
            return {n: v[-steps:] for n, v in arrays.items()}

        found = SeriesPosterior(
            self.model, self.engine, kind, None,
            tables=cut(self._tables), means=cut(self._means), variances=cut(self._variances),
            queries=cut(self.queries), steps=steps, start=self.start + self.steps - steps,
        )  # fmt: skip
        if self.weight_ess is not None:
            found.weight_ess = self.weight_ess[-steps:]
        if self.mean_errors is not None:
            found.mean_errors = cut(self.mean_errors)
        found.queries_mcse = cut(self.queries_mcse)
        return found

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write it to a file that ``bmc.load`` reads, and xarray: as ``Posterior.save`` does.

        Means, variances and probabilities stand under ``answers``, time first.

        Raises
        ------
        MissingExtraError, CheckpointError

        Examples
        --------
        >>> import bayesmc as bmc
        >>> dbn = bmc.DynamicBayesNet()
        >>> dbn.table("rain", ["rain_prev"], [[0.7, 0.3], [0.3, 0.7]], initial=[0.5, 0.5])
        >>> dbn.table("umbrella", ["rain"], [[0.8, 0.2], [0.1, 0.9]])
        >>> bmc.filter(dbn, {"umbrella": [1, 1]}).save("rain.nc")  # doctest: +SKIP
        >>> bmc.load("rain.nc").probabilities("rain").shape  # doctest: +SKIP
        (2, 2)
        """
        save(self, path)

    def __copy__(self) -> Any:
        """The same answers; unlike a pickle a copy keeps the model's functions."""
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__)
        return other

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        """With arrays of its own, so that what is done to them leaves this one; functions are kept."""
        other = memo[id(self)] = self.__copy__()
        for name, value in other.__dict__.items():
            if name not in ("model", "engine"):
                other.__dict__[name] = _with_own_arrays(value, memo)
        return other

    def __getstate__(self) -> dict[str, Any]:
        """Pickles travel without the model's functions."""
        return {**self.__dict__, "model": self.model.without_functions(), "paths": None}

    def __repr__(self) -> str:
        engine = type(self.engine).__name__
        found = f"{self.kind} by {engine}, {self.steps} slices"
        return f"{type(self).__name__}({found}: {', '.join(self.names)})"

    # ---- private -------------------------------------------------------------------------------

    def _laws(self, name: str) -> Laws:
        """Of every slice: tables, what is known, and otherwise what quantiles tell."""
        node = self._node(name)
        if name in self._tables:
            domain = node.domain
            assert domain is not None
            labels = domain.labels is not None
            numbers = None if labels else np.asarray(domain.numbers, dtype=float)
            return TableLaws(self._tables[name], numbers, name)
        if self._is_known(name):
            mean = np.asarray(self._means[name])
            return NormalLaws(mean, np.zeros(mean.shape))
        return self._held_laws(name)

    def _held_laws(self, name: str) -> Laws:
        """Of numbers that are not known."""
        mean = np.asarray(self._means[name])
        self.quantile(name, 0.5)  # says why there are none, where there are none
        return curve_between(mean.shape, lambda q: np.moveaxis(self.quantile(name, q), 1, 0))

    def _is_known(self, name: str) -> bool:
        """Whether a table or a value says all there is to say."""
        self._node(name)
        return name in self._tables or not np.any(self._variances[name])

    def _lead(self) -> int:
        return 1

    def _answer_shape(self, name: str) -> tuple[int, ...]:
        node = self._node(name)
        if name in self._tables:
            return tuple(self._tables[name].shape[:-1])
        return (len(self._means[name]), *node.value_shape)

    def _node(self, name: str) -> CompiledNode:
        node = self.model.nodes.get(name)
        if node is None:
            raise UnknownNodeError(
                f"there is no node {name!r}{did_you_mean(name, self.names)}; answered are {list(self.names)}"
            )
        if node.is_object:
            raise QueryError(
                f"{name!r} holds objects, which have no mean, variance or probabilities; give "
                "queries={name: function} that makes numbers of them, or go by start and step, where "
                f"belief.particles({name!r}) hands them out"
            )
        if name not in self._tables and name not in self._means:
            raise UnsupportedError(
                f"{name!r} is not answered for by this result (answered are {list(self.names)}); inputs and "
                "static nodes are known, what has no sampler has no value where it is not observed, and of "
                "other nodes of a slice ask with queries={name: function}"
            )
        return node

    def _not_kept(self, what: str) -> UnsupportedError:
        return UnsupportedError(
            f'{what}: the particles of past slices were not held; give keep="particles" to the call'
        )

    def _numbers(self, node: CompiledNode, what: str = "mean") -> np.ndarray:
        return numbers_of_states(node, what)


def numbers_of_states(node: CompiledNode, what: str = "mean") -> np.ndarray:
    """The numbers that the states of a finite node are.

    Raises
    ------
    QueryError
    """
    domain = without_labels(node, what).domain
    assert domain is not None
    return np.asarray(domain.numbers, dtype=float)


def without_labels(node: CompiledNode, what: str) -> CompiledNode:
    """The node, if its values are numbers.

    Raises
    ------
    QueryError
        They are labels, which do not have what is asked for.
    """
    if node.domain is not None and node.domain.labels is not None:
        raise QueryError(
            f"{node.name!r} has labels, which have no {what}; use probabilities({node.name!r})"
        )
    return node


def no_joint_table(names: tuple[str, ...], verb: str, call: str) -> QueryError:
    """The refusal of a joint table over time; ``call`` has a place for a function that stands for it."""
    event = " & ".join(f"({name} == ...)" for name in names)
    how = call % f"lambda {', '.join(names)}: {event}"
    return QueryError(
        f"probabilities({', '.join(map(repr, names))}): answers about a slice have tables of single nodes; "
        f"of states that come together {verb} {how}, whose mean is their probability"
    )


def _with_own_arrays(value: Any, memo: dict[int, Any]) -> Any:
    """A deep copy of arrays and what holds them; objects that answer from arrays never change them."""
    if isinstance(value, (np.ndarray, SeriesPosterior)):
        return copy.deepcopy(value, memo)
    if isinstance(value, dict):
        return {k: _with_own_arrays(v, memo) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        parts = [_with_own_arrays(part, memo) for part in value]
        return type(value)(*parts) if hasattr(value, "_fields") else type(value)(parts)
    return value
