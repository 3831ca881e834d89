"""What a discrete filter says of every slice, and of slices in a row."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from bayesmc.engines.averages import as_event
from bayesmc.engines.discrete.answers import SliceAnswers
from bayesmc.errors import QueryError, UnknownNodeError
from bayesmc.results import SeriesPosterior


class DiscretePosterior(SeriesPosterior):
    """What a ``DiscreteFilter`` says of every slice: tables, means, and joint tables of two slices in a row.

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

    def read_from(self, answers: SliceAnswers) -> DiscretePosterior:
        """With the beliefs that joint tables are worked out from."""
        self._answers = answers
        return self

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_answers": None}

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
