"""A belief on a grid about one slice, as ``GridFilter.start`` and ``step`` give it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bayesmc.dbn import DynamicBayesNet, Slices
from bayesmc.engines.beliefs import SliceBelief
from bayesmc.engines.grid.moves import Cells, GridMover
from bayesmc.engines.grid.record import GridPosterior, GridRecord, answers_of


class GridBelief(SliceBelief):
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
        mover: GridMover | None = None,
        cells: Cells | None = None,
        before: Cells | None = None,
        log_marginal_likelihood: Any = 0.0,
        inputs: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        self.dbn, self.static, self.mover = dbn, dict(static), mover
        self.cells, self.before = cells, before
        self.inputs = dict(inputs or {})
        self.log_marginal_likelihood = log_marginal_likelihood
        self.t = -1 if cells is None else cells.placed.row.t
        #: what rows are read against; None before the first
        self.slices: Slices | None = None if mover is None else mover.model.slices

    def __getstate__(self) -> dict[str, Any]:
        """Pickles travel without functions; ``start(dbn, belief=...)`` gives them back."""
        if self.t >= 0:
            _ = self._posterior  # it goes along
        return {**self.__dict__, "dbn": None, "mover": None}

    def density(self, name: str) -> np.ndarray:
        """Density at the points of the grid, shape ``(*plates, *cells)``; NaN where the node is seen."""
        return self._posterior.density(name)[0]

    def grid(self, name: str) -> Any:
        """The points of a node's grid; of a vector a tuple, one per component."""
        return self._posterior.grid(name)

    def __repr__(self) -> str:
        if self.cells is None:
            return "GridBelief(nothing absorbed yet)"
        return f"GridBelief(t={self.t}, cells {self.cells.placed.shape})"

    # ---- private -------------------------------------------------------------------------------

    def _answered(self) -> GridPosterior:
        assert self.cells is not None and self.mover is not None
        model = self.mover.model
        record = GridRecord(model, model.slices.dynamic, 1, {}, True)
        record.add(0, answers_of(self.mover, self.before, self.cells, self.cells.probs))
        return record.posterior(None, "filter", None)
