"""What a discrete filter says of every slice, of slices in a row, and of one slice as its rows come in."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from bayesmc.dbn import Row, Series, Slices
from bayesmc.engines.averages import as_event
from bayesmc.engines.beliefs import SliceBelief
from bayesmc.engines.discrete.answers import SliceAnswers
from bayesmc.engines.discrete.mixtures import SliceMixtures
from bayesmc.errors import QueryError, UnknownNodeError, UnsupportedError
from bayesmc.network import Observed
from bayesmc.results import SeriesPosterior
from bayesmc.results.laws import Laws
from bayesmc.results.posterior import quantile_levels

#: rows that a slice may read: its own and two before
_ROWS = 3


class DiscretePosterior(SeriesPosterior):
    """What a ``DiscreteFilter`` says of every slice: tables, means, and joint tables of two slices in a row.

    Numbers whose density is known given the states (counts that are forecast, say) are exact mixtures of such
    densities: ``cdf``, ``quantile``, ``hdi``, ``mode`` and ``entropy`` are theirs.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc import DiscreteFilter
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.table("x", ["x_prev"], [[0.9, 0.1], [0.2, 0.8]], initial=[0.5, 0.5])
    >>> dbn.table("y", ["x"], [[0.7, 0.3], [0.1, 0.9]])
    >>> smoothed = bmc.smooth(dbn, {"y": [0, 1, 1]}, engine=DiscreteFilter())
    >>> smoothed.pairs("x").shape, smoothed.pairs("x").sum(axis=(1, 2)).round(6).tolist()
    ((2, 2, 2), [1.0, 1.0])
    """

    _answers: SliceAnswers | None = None
    #: the same, and of slices ahead, too
    _source: SliceAnswers | None = None

    def read_from(self, answers: SliceAnswers) -> DiscretePosterior:
        """With the beliefs that joint tables and mixtures are worked out from."""
        self._answers = self._source = answers
        return self

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_answers": None, "_source": None}

    def last(self, steps: int, kind: str) -> SeriesPosterior:
        """The last so many slices by themselves."""
        found = object.__new__(DiscretePosterior)
        found.__dict__.update(super().last(steps, kind).__dict__)
        found._source = self._source
        return found

    def quantile(self, name: str, q: Any) -> np.ndarray:
        """Quantiles, shape ``(time, *q.shape, *plates, *event)``."""
        mixtures = None if self._is_known(name) else self._mixtures(name)
        if mixtures is None:
            return super().quantile(name, q)
        levels = quantile_levels(name, q)
        at = levels.reshape(-1, *(1,) * len(mixtures.shape))
        found = mixtures.ppf(np.broadcast_to(at, (levels.size, *mixtures.shape)))
        found = np.moveaxis(found, 0, 1)
        return found.reshape(len(found), *levels.shape, *found.shape[2:])

    def _held_laws(self, name: str) -> Laws:
        mixtures = self._mixtures(name)
        return super()._held_laws(name) if mixtures is None else mixtures.laws()

    def _mixtures(self, name: str) -> SliceMixtures | None:
        """A number in every slice as a mixture; None where it is none."""
        if self._source is None:
            return None
        try:
            return SliceMixtures(self._source, name, self.steps)
        except UnsupportedError:
            return None

    def expectation(self, function: Callable[..., Any]) -> np.ndarray:
        """Means of a function of nodes of a slice, time first, its arguments with an axis of states first.

        Raises
        ------
        UnknownNodeError, QueryError, UnsupportedError, BudgetError
        """
        return self._asked("expectation").expectation(function)

    def probability(self, function: Callable[..., Any]) -> np.ndarray:
        """Probabilities of an event (a function that returns booleans), time first."""
        return self._asked("probability").expectation(function, as_event)

    def pairs(self, name: str) -> np.ndarray:
        """Joint tables of a node in two slices in a row, ``(time - 1, *plates, states before, states)``.

        Entry ``t - 1`` is of slices ``t - 1`` and ``t``, given the rows that the answer of slice ``t`` rests
        on.

        Raises
        ------
        UnknownNodeError, QueryError
        """
        if name not in self.model.nodes:
            raise UnknownNodeError(f"there is no node {name!r}; answered are {list(self.names)}")
        answers = self._asked(f"pairs({name!r})")
        if (1, name, 0) not in answers.plan.cards or not answers.hands_on(name):
            raise QueryError(
                f"pairs({name!r}): the node is no hidden finite node that the next slice reads"
            )
        return answers.pairs(name)

    def _asked(self, what: str) -> SliceAnswers:
        if self._answers is None:
            raise QueryError(
                f"{what}: joint tables need the run behind the answers, which neither a forecast nor a "
                "pickle carries; ask the result of filter or smooth itself, or give queries= to the call"
            )
        return self._answers


class Held(NamedTuple):
    """What a belief goes on with once it has its functions again; what it says of a ``Run`` is the same.

    Attributes
    ----------
    series : Series
        The last rows.
    before : list of ndarray or None
        Logs of the beliefs in the slice before, by chain.
    """

    series: Series
    before: Sequence[np.ndarray] | None


class FiniteBelief(SliceBelief):
    """Base of the beliefs of filters of finite nodes, each family's of a class of its own."""

    def __getstate__(self) -> dict[str, Any]:
        """Pickles travel without functions; ``start(dbn, belief=...)`` gives them back."""
        if self.dbn is not None and not self.dbn.template.has_functions:
            return {**self.__dict__}  # tables alone travel
        return super().__getstate__()

    def _without_functions(self) -> Held:
        return Held(self.state.series, self.state.before)

    def _answered(self) -> SeriesPosterior:
        answers = SliceAnswers(self.state)
        slices = answers.plan.slices
        found = answers.of(slices.dynamic)
        return DiscretePosterior(
            slices.first, None, "filter", None, tables=found.tables, means=found.means,
            variances=found.variances, steps=1, start=self.t,
        ).read_from(answers)  # fmt: skip


class DiscreteBelief(FiniteBelief):
    """Probabilities of the nodes of one slice.

    Attributes
    ----------
    t : int
        The slice; -1 before anything was absorbed.
    log_marginal_likelihood : float or ndarray
        Log density of all rows absorbed so far.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc import DiscreteFilter
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.table("rain", ["rain_prev"], [[0.7, 0.3], [0.3, 0.7]], initial=[0.5, 0.5])
    >>> dbn.table("umbrella", ["rain"], [[0.8, 0.2], [0.1, 0.9]])
    >>> engine = DiscreteFilter()
    >>> belief = engine.step(engine.start(dbn), {"umbrella": 1})
    >>> belief.t, belief.probabilities("rain").round(3).tolist()
    (0, [0.182, 0.818])
    """


def window(slices: Slices, before: Series | None, row: Row) -> Series:
    """The last few rows as a series that ends with ``row``."""
    names = {*row.seen, *(before.observed if before is not None else ())}
    kept = 0 if before is None else min(before.steps, _ROWS - 1)
    observed = {}
    for name in names:
        node = slices.first[name]
        old = None if before is None else before.observed.get(name)
        new = row.seen.get(name)
        sample = new.value if new is not None else old.value[-1]  # type: ignore[union-attr]
        value = np.empty((kept + 1, *node.value_shape), dtype=sample.dtype)
        mask = np.zeros((kept + 1, *node.plate_shape), dtype=bool)
        value[:] = sample
        if old is not None and kept:
            value[:kept] = old.value[-kept:]
            mask[:kept] = True if old.mask is None else old.mask[-kept:]
        if new is not None:
            mask[kept] = True if new.mask is None else new.mask
        if mask.any():
            observed[name] = Observed(value, mask)
    inputs = {}
    for name in slices.template.inputs:
        now = row.inputs[name][None]
        past = [] if before is None or not kept else [before.inputs[name][-kept:]]
        inputs[name] = np.concatenate([*past, now])
    return Series(kept + 1, observed, inputs, {}, row.t - kept)
