"""What Gaussian filters answer: means, variances, and joint covariances of the nodes of a slice."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.dbn import DynamicBayesNet, Slices
from bayesmc.distributions.circular import wrap_angle
from bayesmc.engines.beliefs import OnlineBelief
from bayesmc.engines.filtering import refuse_forecast
from bayesmc.engines.kalman.innovations import Innovations
from bayesmc.engines.kalman.queries import View, expectation, quantiles
from bayesmc.engines.kalman.rows import RowTaker, Taken
from bayesmc.engines.kalman.slices import Layout
from bayesmc.errors import QueryError, UnknownNodeError, UnsupportedError
from bayesmc.network import CompiledNode
from bayesmc.results import SeriesPosterior


@dataclass(frozen=True, eq=False)
class Spreads:
    """Covariances of the unknown numbers of every slice, kept as roots.

    Attributes
    ----------
    roots : ndarray, shape (kinds, [*lead], n, n)
    which : ndarray of int, shape (time,)
        Which root is a slice's.
    noise : ndarray, shape (time, [*lead], c, c), or None
        Covariance of the first c numbers that a root multiplies, where it is not the identity.
    """

    roots: np.ndarray
    which: np.ndarray
    noise: np.ndarray | None = None

    def covariances(self) -> np.ndarray:
        """Of all slices, shape (time, [*lead], n, n)."""
        if self.noise is None:
            return (self.roots @ np.matrix_transpose(self.roots))[self.which]
        left, alone, noise = self._parts(self.noise)
        return left @ noise @ np.matrix_transpose(left) + alone[self.which]

    def variances(self) -> np.ndarray:
        """Their diagonals, shape (time, [*lead], n)."""
        if self.noise is None:
            return np.vecdot(self.roots, self.roots)[self.which]
        left, alone, noise = self._parts(self.noise)
        return np.vecdot(left @ noise, left) + alone.diagonal(0, -2, -1)[self.which]

    def last(self, steps: int) -> Spreads:
        """Of the last so many slices."""
        noise = None if self.noise is None else self.noise[-steps:]
        return Spreads(self.roots, self.which[-steps:], noise)

    def _parts(self, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Roots on that noise by slice, covariances by the rest by kind, and the noise, of one dimension."""
        c = noise.shape[-1]
        left, rest = self.roots[..., :c], self.roots[..., c:]
        ndim = max(left.ndim, noise.ndim)
        left, alone, noise = (
            a.reshape(len(a), *(1,) * (ndim - a.ndim), *a.shape[1:])
            for a in (left, rest @ np.matrix_transpose(rest), noise)
        )
        return left[self.which], alone, noise


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

    layout: Layout
    spreads: Spreads
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
        places = [self._place(n) for n in names]
        return joined(self.layout, places, self.spreads.covariances(), self.steps)

    def last(self, steps: int, kind: str) -> SeriesPosterior:
        """The last so many slices by themselves."""
        refuse_forecast(self, kind)
        cut = super().last(steps, kind)
        found = GaussianSeries(
            self.model, self.engine, kind, None, tables=cut._tables, means=cut._means,
            variances=cut._variances, queries=cut.queries, steps=steps, start=cut.start,
        )  # fmt: skip
        found.layout, found.spreads = self.layout, self.spreads.last(steps)
        found.queries_mcse = cut.queries_mcse
        found.view = self.view.last(steps, found.spreads)
        return found

    def _node(self, name: str) -> CompiledNode:
        if name in self.layout.silent:
            raise _no_answer(name)
        return super()._node(name)

    def _place(self, name: str) -> np.ndarray | int:
        """Places of a node's numbers among the unknown ones, or how many known ones it has."""
        self._node(name)
        return place_of(self.layout, name, name in self._tables)


class GaussianBelief(OnlineBelief):
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

    def __init__(
        self,
        dbn: DynamicBayesNet | None,
        static: Mapping[str, Any],
        t: int = -1,
        taker: RowTaker | None = None,
        taken: Taken | None = None,
        log_marginal_likelihood: Any = 0.0,
        inputs: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        self.dbn, self.static, self.t = dbn, dict(static), t
        self.taker, self.taken = taker, taken
        self.log_marginal_likelihood = log_marginal_likelihood
        self.inputs = dict(inputs or {})

    def __getstate__(self) -> dict[str, Any]:
        """Pickles travel without functions; ``start(dbn, belief=...)`` gives them back."""
        return {**self.__dict__, "dbn": None, "taker": None}

    @property
    def slices(self) -> Slices | None:
        """What rows are read against; None before the first."""
        return None if self.taken is None else self.taken.layout.slices

    @property
    def layout(self) -> Layout:
        """Where the numbers stand."""
        return self._slice.layout

    @property
    def vector(self) -> np.ndarray:
        """Means of the unknown numbers, shape (*plates, n)."""
        return self._slice.mean

    @property
    def factor(self) -> np.ndarray:
        """Lower root of their covariance, shape ([*plates], n, n)."""
        return self._slice.factor

    @property
    def known(self) -> dict[str, np.ndarray]:
        """Values of nodes that are known."""
        return self._slice.known

    @property
    def names(self) -> tuple[str, ...]:
        """Nodes that are answered for."""
        return (*self.layout.rows, *self.known)

    def mean(self, name: str) -> np.ndarray:
        """Mean, shape ``(*plates, *event)``; an angle's lies in [-pi, pi)."""
        place = self._place(name)
        if isinstance(place, int):
            return np.asarray(self.known[name], dtype=float)
        node = self.layout.model[name]
        return self.layout.unpacked(node, on_circle(self.layout, name, self.vector[..., place]))

    def var(self, name: str) -> np.ndarray:
        """Variance, shape ``(*plates, *event)``."""
        place = self._place(name)
        if isinstance(place, int):
            return np.zeros(np.shape(self.known[name]))
        rows = self.factor[..., place, :]
        shape = (*self.layout.lead, len(place))
        return self.layout.unpacked(
            self.layout.model[name], np.broadcast_to(np.vecdot(rows, rows), shape)
        )

    def std(self, name: str) -> np.ndarray:
        """Standard deviation, shape ``(*plates, *event)``."""
        return np.sqrt(self.var(name))

    def cov(self, *names: str) -> np.ndarray:
        """Joint covariance, shape ``(*plates, d, d)``, of nodes one after the other."""
        places = [self._place(n) for n in names]
        whole = self.factor @ np.matrix_transpose(self.factor)
        return joined(self.layout, places, whole[None], 1)[0]

    def expectation(self, function: Callable[..., Any]) -> np.ndarray:
        """Mean of a function of nodes of the slice; see ``GaussianSeries.expectation``."""
        return expectation(self._view, function)[0][0]

    def probability(self, function: Callable[..., Any]) -> np.ndarray:
        """Probability of an event (a function that returns booleans)."""
        return expectation(self._view, function, event=True)[0][0]

    def quantile(self, name: str, q: Any) -> np.ndarray:
        """Quantiles, shape ``(*q.shape, *plates, *event)``."""
        return quantiles(self.mean(name)[None], self.std(name)[None], q, name)[0]

    @property
    def _view(self) -> View:
        spreads = Spreads(self.factor[None], np.zeros(1, dtype=np.intp))
        known = {n: np.asarray(v)[None] for n, v in self.known.items()}
        return View(self.layout, self.vector[None], spreads, known)

    def __repr__(self) -> str:
        if self.taken is None:
            return "GaussianBelief(nothing absorbed yet)"
        return f"GaussianBelief(t={self.t}, {', '.join(self.names)})"

    # ---- private -------------------------------------------------------------------------------

    @property
    def _slice(self) -> Taken:
        if self.taken is None:
            raise QueryError(
                "the belief has absorbed nothing yet (t is -1); step(belief, row) takes in slice 0"
            )
        return self.taken

    def _place(self, name: str) -> np.ndarray | int:
        layout = self.layout
        if name in layout.silent:
            raise _no_answer(name)
        if name not in layout.rows and name not in self.known:
            raise UnknownNodeError(f"there is no node {name!r}; answered are {list(self.names)}")
        return place_of(layout, name, layout.model[name].domain is not None)


def _no_answer(name: str) -> UnsupportedError:
    return UnsupportedError(
        f"{name!r} takes no continuous values, and a Gaussian belief does not answer for it; use a "
        "ParticleFilter"
    )


def on_circle(layout: Layout, name: str, value: np.ndarray) -> np.ndarray:
    """Angles in [-pi, pi); other numbers as they are."""
    angles = layout.angles_of(name)
    return np.where(angles, wrap_angle(value), value) if angles.any() else value


def place_of(layout: Layout, name: str, is_table: bool) -> np.ndarray | int:
    """Places of a node's numbers among the unknown ones, or how many known ones it has."""
    if is_table:
        raise QueryError(f"cov({name!r}): the node has states, not numbers")
    place = layout.rows.get(name)
    return layout.size(name) if place is None else np.arange(place.start, place.stop)


def joined(
    layout: Layout, places: list[np.ndarray | int], whole: np.ndarray, steps: int
) -> np.ndarray:
    """Covariance of some numbers, known ones with zeros, shape (steps, *lead, d, d)."""
    sizes = [p if isinstance(p, int) else len(p) for p in places]
    total, at = sum(sizes), 0
    here: list[int] = []
    there: list[int] = []
    for place, size in zip(places, sizes, strict=True):
        if not isinstance(place, int):
            here += range(at, at + size)
            there += place.tolist()
        at += size
    found = np.zeros((steps, *layout.lead, total, total))
    part = whole[..., there, :][..., there]
    wide = part.reshape(len(part), *(1,) * (found.ndim - part.ndim), *part.shape[1:])
    index = np.asarray(here, dtype=np.intp)
    found[..., index[:, None], index] = wide
    return found
