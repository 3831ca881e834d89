"""What Gaussian filters answer: means, variances, and joint covariances of the nodes of a slice."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from bayesmc.dbn import SeriesProblem
from bayesmc.engines.averages import naming
from bayesmc.engines.beliefs import SliceBelief
from bayesmc.engines.filtering import Queries, refuse_forecast
from bayesmc.engines.kalman.data import SeriesData
from bayesmc.engines.kalman.means import Innovations
from bayesmc.engines.kalman.passes import Filtered, RowTaker, Smoothed, Taken
from bayesmc.engines.kalman.queries import Spreads, View, expectation, on_circle, quantiles
from bayesmc.engines.kalman.slices import Layout
from bayesmc.errors import QueryError, UnknownNodeError, UnsupportedError
from bayesmc.network import CompiledNode
from bayesmc.results import SeriesPosterior
from bayesmc.results.laws import Laws, NormalLaws


class GaussianSeries(SeriesPosterior):
    """Gaussian beliefs about every slice.

    Answers what ``SeriesPosterior`` does, ``cov``, and by how much rows were off what was expected of them.

    Attributes
    ----------
    nis : ndarray, shape (time, *plates)
        Normalised innovations squared: each row's squared distance from what was expected of it, in units of
        its covariance; chi-square with ``nis_df`` degrees of freedom where the model is right, so that their
        sums should be about alike. 0 where nothing was seen. Plates are those filtered separately.
    nis_df : ndarray of int, shape (time, *plates)
        How many numbers were observed in each slice, of nodes that depend on hidden ones.

    References
    ----------
    Bar-Shalom, Li and Kirubarajan (2001), Estimation with Applications to Tracking and Navigation, sec. 5.4.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc import KalmanFilter
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.add("v", lambda v_prev: bmc.Normal(v_prev, 0.1), initial=bmc.Normal(0.0, 1.0))
    >>> dbn.add("x", lambda x_prev, v: bmc.Normal(x_prev + v, 0.1), initial=bmc.Normal(0.0, 1.0))
    >>> dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    >>> filtered = bmc.filter(dbn, {"y": [0.1, 1.2, 1.9]}, engine=KalmanFilter())
    >>> filtered.cov("x", "v").shape
    (3, 2, 2)
    >>> filtered.nis.shape, filtered.nis_df.tolist(), filtered.innovations("y").shape
    ((3,), [1, 1, 1], (3,))
    """

    view: View
    normalised: Innovations | None = None

    def expectation(self, function: Callable[..., Any]) -> np.ndarray:
        """Means of a function of nodes of a slice, time first, its arguments with an axis of points first.

        One number is averaged to rounding, jumps included; several over 4,096 points that make cubic
        functions exact (``queries=`` has the standard errors in ``queries_mcse``). An event that no point
        saw, or every point, is known no better than what lies between two points, some 0.002 for one number.
        """
        return expectation(self.view, function)[0]

    def probability(self, function: Callable[..., Any]) -> np.ndarray:
        """Probabilities of an event (a function that returns booleans), time first."""
        return expectation(self.view, function, event=True)[0]

    def quantile(self, name: str, q: Any) -> np.ndarray:
        """Quantiles, shape ``(time, *q.shape, *plates, *event)``; those of angles about the mean."""
        return quantiles(self.mean(name), self.std(name), q, name)

    def _laws(self, name: str) -> Laws:
        if name in self._tables:
            return super()._laws(name)
        return NormalLaws(self.mean(name), self.std(name))

    @property
    def nis(self) -> np.ndarray:
        return self._innovations("nis").nis.copy()

    @property
    def nis_df(self) -> np.ndarray:
        return self._innovations("nis_df").df.copy()

    def innovations(self, name: str) -> np.ndarray:
        """What an observed node was off, in standard deviations of what was expected of it.

        Each number by its own standard deviation given the rows before; angles the short way round. Where the
        model is right they are standard normal, independent from slice to slice.

        Parameters
        ----------
        name : str

        Returns
        -------
        ndarray, shape (time, *plates, *event)
            NaN where it was not seen, and for nodes that depend on nothing hidden.

        Raises
        ------
        UnknownNodeError, QueryError
        """
        normalised = self._innovations(f"innovations({name!r})")
        if name not in self.model.nodes:
            raise UnknownNodeError(f"there is no node {name!r}; answered are {list(self.names)}")
        found = normalised.of(name)
        if found is None:
            raise QueryError(f"innovations({name!r}): the node is not observed; ask of one that is")
        return found

    def _innovations(self, what: str) -> Innovations:
        if self.normalised is None:
            raise QueryError(
                f"{what}: slices ahead of the data have no rows to compare; ask a filter's result"
            )
        return self.normalised

    def cov(self, *names: str) -> np.ndarray:
        """Joint covariances of nodes in every slice.

        Parameters
        ----------
        names : str
            Nodes, whose numbers follow each other in this order; those of plates that are not filtered
            separately are stacked before the event's.

        Returns
        -------
        ndarray, shape (time, *plates, d, d)
            The plates are those that are filtered separately.

        Raises
        ------
        UnknownNodeError, UnsupportedError, QueryError
        """
        for name in names:
            self._node(name)
            if name in self._tables:
                raise QueryError(f"cov({name!r}): the node has states, not numbers")
        return self.view.cov(names)

    def last(self, steps: int, kind: str) -> SeriesPosterior:
        """The last so many slices by themselves."""
        refuse_forecast(self, kind)
        found = object.__new__(GaussianSeries)
        found.__dict__.update(super().last(steps, kind).__dict__)
        found.view = self.view.last(steps)
        return found

    def _node(self, name: str) -> CompiledNode:
        if name in self.view.layout.silent:
            raise UnsupportedError(
                f"{name!r} takes no continuous values, and a Gaussian belief does not answer for it; use a "
                "ParticleFilter"
            )
        return super()._node(name)


class GaussianState(NamedTuple):
    """What a belief goes on with: what takes rows in (None out of a pickle), and the last one taken in."""

    taker: RowTaker | None
    taken: Taken


class GaussianBelief(SliceBelief):
    """A Gaussian belief about one slice, as ``start`` and ``step`` of the Kalman filters give it.

    Attributes
    ----------
    t : int
        The slice; -1 before anything was absorbed.
    log_marginal_likelihood : float or ndarray
        Log density of all rows absorbed so far.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc import KalmanFilter
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    >>> dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    >>> engine = KalmanFilter()
    >>> belief = engine.step(engine.start(dbn), {"y": 0.8})
    >>> belief.t, round(float(belief.mean("x")), 6), round(float(belief.var("x")), 6)
    (0, 0.64, 0.2)
    """

    @property
    def layout(self) -> Layout:
        """Where the numbers stand."""
        return self._posterior.view.layout

    def cov(self, *names: str) -> np.ndarray:
        """Joint covariance, shape ``(*plates, d, d)``, of nodes one after the other."""
        return self._posterior.cov(*names)[0]

    @property
    def _of_functions(self) -> GaussianSeries:
        return self._posterior  # what is averaged is numbers: an unpickled belief has them, too

    def _without_functions(self) -> GaussianState:
        return self.state._replace(taker=None)

    def _answered(self) -> GaussianSeries:
        taken = self.state.taken
        layout = taken.layout
        spreads = Spreads(taken.factor[None], np.zeros(1, dtype=np.intp))
        nodes = layout.slices.first
        known = {n: np.broadcast_to(v, nodes[n].value_shape)[None] for n, v in taken.known.items()}
        view = View(layout, taken.mean[None], spreads, known)
        return _series(view, None, "filter", None, self.t)


def filter_answers(
    engine: Any,
    problem: SeriesProblem,
    data: SeriesData,
    found: Filtered,
    queries: Queries | None = None,
) -> GaussianSeries:
    """Every slice given the rows up to it; of the first so many, where no more were passed."""
    spreads = Spreads(found.factors, found.which)
    return _answers(engine, problem, data, "filter", found, found.means, spreads, queries)


def smooth_answers(
    engine: Any,
    problem: SeriesProblem,
    data: SeriesData,
    found: Filtered,
    smoothed: Smoothed,
    kind: str,
    queries: Queries | None = None,
) -> GaussianSeries:
    """Every slice given later rows, too."""
    layout, roots = data.layouts[0], found.factors
    left = roots[..., : layout.carried][found.which]
    if left.ndim == 3:  # the same in all elements of the plates apart
        left = left.reshape(len(left), *(1,) * len(layout.lead), *left.shape[1:])
    means = found.means + np.matvec(left, smoothed.noise)
    spreads = Spreads(roots, found.which, smoothed.spread)
    return _answers(engine, problem, data, kind, found, means, spreads, queries)


# ---- private ------------------------------------------------------------------------------------


def _answers(
    engine: Any, problem: SeriesProblem, data: SeriesData, kind: str, filtered: Filtered,
    means: np.ndarray, spreads: Spreads, queries: Queries | None,
) -> GaussianSeries:  # fmt: skip
    layout, steps, series = data.layouts[0], len(means), problem.series
    known = {n: o.value[:steps] for n, o in series.observed.items() if o.mask is None}
    known |= problem.known_static | data.computed(steps)
    nodes = layout.slices.first
    known = {n: np.broadcast_to(v, (steps, *nodes[n].value_shape)) for n, v in known.items()}
    view = View(layout, means, spreads, known)
    found = _series(view, engine, kind, filtered.increments, series.start)
    found.normalised = filtered.innovations
    found.predictive = filtered.innovations.predictive()
    for name, function in (queries or {}).items():
        with naming(name):
            found.queries[name], found.queries_mcse[name] = expectation(view, function)
    return found


def _series(
    view: View, engine: Any, kind: str, increments: np.ndarray | None, start: int
) -> GaussianSeries:
    """Tables, means and variances of all nodes: known ones, and those of the vector."""
    layout, mean = view.layout, view.mean
    tables, means, variances = {}, {}, {}
    for name, value in view.known.items():
        node = layout.slices.first[name]
        if name in layout.slices.template.static:
            continue
        if node.domain is not None:
            tables[name] = np.eye(node.domain.size)[value.astype(np.intp)]
        else:
            means[name], variances[name] = value.astype(float), np.zeros(value.shape)
    spread = view.spreads.variances()
    wide = spread.reshape(len(spread), *(1,) * (mean.ndim - spread.ndim), *spread.shape[1:])
    full = np.broadcast_to(wide, mean.shape)
    for name, place in layout.rows.items():
        node = layout.slices.first[name]
        means[name] = layout.unpacked(node, on_circle(layout, name, mean[..., place]))
        variances[name] = layout.unpacked(node, full[..., place])
    found = GaussianSeries(
        layout.slices.first, engine, kind, increments, tables=tables, means=means,
        variances=variances, steps=len(mean), start=start,
    )  # fmt: skip
    found.view = view
    return found
