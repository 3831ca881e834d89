"""An exact belief about one slice, as ``DiscreteFilter.start`` and ``step`` give it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from bayesmc.dbn import DynamicBayesNet, Row, Series, Slices
from bayesmc.engines.averages import as_event
from bayesmc.engines.beliefs import OnlineBelief
from bayesmc.engines.discrete.answers import SliceAnswers
from bayesmc.engines.discrete.run import Run
from bayesmc.errors import QueryError
from bayesmc.network import Observed
from bayesmc.results import SeriesPosterior

#: rows that a slice may read: its own and two before
_ROWS = 3


class Held(NamedTuple):
    """What a belief goes on with once it has its functions again.

    Attributes
    ----------
    slices : Slices
    series : Series
        The last rows.
    before : list of ndarray or None
        Logs of the beliefs in the slice before, by chain.
    answers : SeriesPosterior or None
        What it says of its slice, for a belief without functions.
    """

    slices: Slices
    series: Series
    before: Sequence[np.ndarray] | None
    answers: SeriesPosterior | None = None


@dataclass(frozen=True, eq=False)
class DiscreteBelief(OnlineBelief):
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

    dbn: DynamicBayesNet | None = field(repr=False)
    static: Mapping[str, Any] = field(repr=False)
    t: int = -1
    log_marginal_likelihood: Any = 0.0
    run: Run | Held | None = field(default=None, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        """Pickles travel without functions; ``start(dbn, belief=...)`` gives them back."""
        if self.dbn is not None and not self.dbn.template.has_functions:
            return {**self.__dict__}  # tables alone travel
        run = None if self.run is None else self.held._replace(answers=self._posterior)
        state = {**self.__dict__, "dbn": None, "run": run}
        state.pop("_posterior", None)
        return state

    @property
    def held(self) -> Held:
        """The last rows, and the beliefs before them."""
        if isinstance(self.run, Held):
            return self.run
        assert self.run is not None
        return Held(self.run.plan.slices, self.run.series, self.run.before)

    @property
    def slices(self) -> Slices | None:
        """What rows are read against; None before the first."""
        return None if self.run is None else self.held.slices

    @property
    def inputs(self) -> dict[str, np.ndarray]:
        """Inputs of the slice."""
        if self.run is None:
            return {}
        return {n: v[-1] for n, v in self.held.series.inputs.items()}

    @property
    def names(self) -> tuple[str, ...]:
        """Nodes that are answered for, parents first."""
        return self._posterior.names

    def mean(self, name: str) -> np.ndarray:
        """Mean, shape ``(*plates, *event)``; circular for angles; labels have none."""
        return self._posterior.mean(name)[0]

    def var(self, name: str) -> np.ndarray:
        """Variance, shape ``(*plates, *event)``; for angles ``-2 log R``."""
        return self._posterior.var(name)[0]

    def std(self, name: str) -> np.ndarray:
        """Standard deviation, shape ``(*plates, *event)``."""
        return np.sqrt(self.var(name))

    def probabilities(self, name: str) -> np.ndarray:
        """Probabilities of the states of a finite node, shape ``(*plates, states)``."""
        return self._posterior.probabilities(name)[0]

    def expectation(self, function: Callable[..., Any]) -> np.ndarray:
        """Mean of a function of nodes of the slice, whose arguments have a leading axis of states."""
        return self._slice.expectation(function)[-1]

    def probability(self, function: Callable[..., Any]) -> np.ndarray:
        """Probability of an event (a function that returns booleans)."""
        return self._slice.expectation(function, as_event)[-1]

    @property
    def _slice(self) -> SliceAnswers:
        if self.run is None:
            raise QueryError(
                "the belief has absorbed nothing yet (t is -1); step(belief, row) takes in slice 0"
            )
        if isinstance(self.run, Held):
            raise QueryError(
                "this belief was unpickled, and pickles carry no functions: it says means, variances and "
                "probabilities of nodes; for the rest give it the template again, engine.start(dbn, "
                "belief=belief)"
            )
        return SliceAnswers(self.run)

    @cached_property
    def _posterior(self) -> SeriesPosterior:
        if isinstance(self.run, Held):
            assert self.run.answers is not None
            return self.run.answers
        answers = self._slice
        slices = answers.plan.slices
        found = answers.of(slices.dynamic)
        return SeriesPosterior(
            slices.first, None, "filter", None, tables=found.tables, means=found.means,
            variances=found.variances, steps=1, start=self.t,
        )  # fmt: skip


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
