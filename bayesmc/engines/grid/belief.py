"""A belief on a grid about one slice, as ``GridFilter.start`` and ``step`` give it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, suppress
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from bayesmc.dbn import DynamicBayesNet, Slices
from bayesmc.engines.averages import as_event
from bayesmc.engines.beliefs import OnlineBelief
from bayesmc.engines.grid.answers import Answers
from bayesmc.engines.grid.moves import Cells, GridMover
from bayesmc.errors import QueryError, UnknownNodeError, UnsupportedError
from bayesmc.network import CompiledNode
from bayesmc.results.posterior import quantile_levels, table_variance


class Kept(NamedTuple):
    """What a belief without functions still says of its slice.

    Attributes
    ----------
    slices : Slices
    tables, moments, densities, points : dict
        By node, for those that have them.
    """

    slices: Slices
    tables: dict[str, np.ndarray]
    moments: dict[str, tuple[np.ndarray, np.ndarray]]
    densities: dict[str, np.ndarray]
    points: dict[str, Any]


class GridBelief(OnlineBelief):
    """Probabilities of cells of one slice.

    Attributes
    ----------
    t : int
        The slice; -1 before anything was absorbed.
    log_marginal_likelihood : float or ndarray
        Log density of all rows absorbed so far; one for each element of plates filtered separately.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc import GridFilter
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    >>> dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    >>> engine = GridFilter({"x": (-8.0, 8.0, 200)})
    >>> belief = engine.step(engine.start(dbn), {"y": 0.8})
    >>> belief.t, float(belief.mean("x").round(4)), belief.density("x").shape
    (0, 0.64, (200,))
    """

    def __init__(
        self,
        dbn: DynamicBayesNet | None,
        static: Mapping[str, Any],
        quiet: Callable[[], AbstractContextManager[None]],
        mover: GridMover | Kept | None = None,
        cells: Cells | None = None,
        before: Cells | None = None,
        log_marginal_likelihood: Any = 0.0,
        inputs: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        self.dbn, self.static, self.mover = dbn, dict(static), mover
        self.cells, self.before, self._quiet = cells, before, quiet
        self.inputs = dict(inputs or {})
        self.log_marginal_likelihood = log_marginal_likelihood
        self.t = -1 if cells is None else cells.placed.row.t

    def __getstate__(self) -> dict[str, Any]:
        """Pickles travel without functions; ``start(dbn, belief=...)`` gives them back."""
        state = {**self.__dict__, "dbn": None}
        state.pop("_answers", None)
        if self.slices is not None:
            state["mover"] = self._kept(self.slices)
        return state

    @property
    def slices(self) -> Slices | None:
        """What rows are read against; None before the first."""
        if isinstance(self.mover, Kept):
            return self.mover.slices
        return None if self.mover is None else self.mover.model.slices

    @property
    def names(self) -> tuple[str, ...]:
        """Nodes of the slice, parents first."""
        return () if self.slices is None else self.slices.dynamic

    def mean(self, name: str) -> np.ndarray:
        """Mean, shape ``(*plates, *event)``; circular for angles; labels have none."""
        return self._moments(name)[0]

    def var(self, name: str) -> np.ndarray:
        """Variance, shape ``(*plates, *event)``; for angles ``-2 log R``."""
        return self._moments(name)[1]

    def std(self, name: str) -> np.ndarray:
        """Standard deviation, shape ``(*plates, *event)``."""
        return np.sqrt(self.var(name))

    def probabilities(self, name: str) -> np.ndarray:
        """Probabilities of the states of a finite node, shape ``(*plates, states)``."""
        node = self._node(name)
        if node.domain is None:
            raise QueryError(
                f"probabilities({name!r}): the node has no finite set of states; use mean, var or density"
            )
        if isinstance(self.mover, Kept):
            return self.mover.tables[name]
        with self._quiet():
            return self._answers.table(name)

    def density(self, name: str) -> np.ndarray:
        """Density at the points of the grid, shape ``(*plates, *cells)``; NaN where the node is seen."""
        if isinstance(self.mover, Kept) and name in self.mover.densities:
            return self.mover.densities[name]
        self._axes(name)
        return self._answers.density(name)

    def grid(self, name: str) -> Any:
        """The points of a node's grid; of a vector a tuple, one per component."""
        if isinstance(self.mover, Kept) and name in self.mover.points:
            return self.mover.points[name]
        axes = self._axes(name)
        points = tuple(a.points for a in axes)
        return points if self._node(name).event_shape else points[0]

    def expectation(self, function: Callable[..., Any]) -> np.ndarray:
        """Mean of a function of nodes of the slice, whose arguments have a leading axis of cells."""
        with self._quiet():
            return self._answers.expectation(function)[0]

    def probability(self, function: Callable[..., Any]) -> np.ndarray:
        """Probability of an event (a function that returns booleans)."""
        with self._quiet():
            return self._answers.expectation(function, as_event)[0]

    def quantile(self, name: str, q: Any) -> np.ndarray:
        """Quantiles of a node of one number, shape ``(*q.shape, *plates)``."""
        self._node(name)
        return self._answers.quantile(name, quantile_levels(name, q))

    def __repr__(self) -> str:
        if self.cells is None:
            return "GridBelief(nothing absorbed yet)"
        return f"GridBelief(t={self.t}, cells {self.cells.placed.shape})"

    # ---- private -------------------------------------------------------------------------------

    @cached_property
    def _answers(self) -> Answers:
        if isinstance(self.mover, Kept):
            raise QueryError(
                "this belief was unpickled, and pickles carry no functions: it says means, variances, "
                "probabilities and densities; for the rest give it the template again, engine.start(dbn, "
                "belief=belief)"
            )
        if self.cells is None or self.mover is None:
            raise QueryError(
                "the belief has absorbed nothing yet (t is -1); step(belief, row) takes in slice 0"
            )
        cells, before, mover = self.cells, self.before, self.mover

        def pair() -> Any:
            assert before is not None
            return mover.pair(before, cells, cells.probs)

        placed = None if before is None else before.placed
        with self._quiet():
            return Answers(mover.model, placed, cells.placed, cells.probs, pair)

    def _kept(self, slices: Slices) -> Kept:
        """Its answers, for a pickle."""
        if isinstance(self.mover, Kept):
            return self.mover
        kept = Kept(slices, {}, {}, {}, {})
        for name in self.names:
            node = slices.first[name]
            if node.domain is not None:
                kept.tables[name] = self.probabilities(name)
            if node.domain is None or node.domain.labels is None:
                with suppress(UnsupportedError):  # it has neither
                    kept.moments[name] = self._moments(name)
            with suppress(UnsupportedError):  # it has no grid
                kept.densities[name], kept.points[name] = self.density(name), self.grid(name)
        return kept

    def _node(self, name: str) -> CompiledNode:
        if self.slices is None:
            return self._answers.model.slices.first[name]  # says that there are none
        if name not in self.names:
            raise UnknownNodeError(f"{name!r} is no node of a slice; there are {list(self.names)}")
        return self.slices.first[name]

    def _axes(self, name: str) -> Any:
        node, model = self._node(name), self._answers.model
        if node.domain is not None or name in model.leaves or name not in model.axes.of:
            raise UnsupportedError(
                f"density({name!r}): the node has no grid; finite ones have probabilities(name), others are "
                "given one by grid="
            )
        return model.axes.of[name]

    def _moments(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        node = self._node(name)
        if isinstance(self.mover, Kept) and name in self.mover.moments:
            return self.mover.moments[name]
        with self._quiet():
            if node.domain is not None:
                if node.domain.labels is not None:
                    raise QueryError(f"{name!r} has labels, which have no mean; use probabilities")
                numbers = np.asarray(node.domain.numbers, dtype=float)
                table = self._answers.table(name)
                return table @ numbers, table_variance(table, numbers)
            found = self._answers.moments(name)
        if found is None:
            raise UnsupportedError(
                f"mean({name!r}): its density has no closed mean and variance; give it a grid, grid="
                f"{{{name!r}: (low, high, cells)}}"
            )
        return found
