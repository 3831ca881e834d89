"""``DiscreteFilter``: exact answers over time where everything hidden is finite.

Options, and what they refuse; tables of slices are made in ``slices``, passed along in
``chain`` and read in ``answers``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from bayesmc.dbn import SeriesProblem
from bayesmc.engines.discrete.answers import best_path
from bayesmc.engines.discrete.finite import FiniteFilter
from bayesmc.engines.discrete.limits import size_refusal
from bayesmc.engines.discrete.posterior import DiscreteBelief
from bayesmc.engines.discrete.slices import DiscreteSlices
from bayesmc.engines.discrete.states import path_values
from bayesmc.errors import BudgetError


@dataclass(frozen=True)
class DiscreteFilter(FiniteFilter):
    """Exact filtering, smoothing and decoding where all hidden nodes have finitely many values.

    The nodes that the next slice reads form one joint state; whatever else is hidden is summed out within
    its slice. Variables that never meet are passed separately, and elements of plates that never meet are
    one more array axis, so 64 sequences cost little more than one. Observed nodes may have any density,
    and be read by the next slice; where one is missing, it is averaged over if nothing depends on it.

    Parameters
    ----------
    max_states : int
        Joint states of one chain above which it refuses.
    max_bytes : float
        Memory above which it refuses, with the figure, before allocating.

    Notes
    -----
    A slice costs the square of the number of joint states. ``most_likely`` maximises over all hidden finite
    nodes together, missing observations included; a missing continuous observation is averaged over.

    References
    ----------
    Rabiner (1989), A tutorial on hidden Markov models; Murphy (2002), Dynamic Bayesian networks, sec. 3.4
    (the interface algorithm); Koller and Friedman (2009), sec. 15.2.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc import DiscreteFilter
    >>> dbn = bmc.DynamicBayesNet("umbrella world")
    >>> dbn.table("rain", ["rain_prev"], [[0.7, 0.3], [0.3, 0.7]], ("no", "yes"), initial=[0.5, 0.5])
    >>> dbn.table("umbrella", ["rain"], [[0.8, 0.2], [0.1, 0.9]], ("no", "yes"))
    >>> seen = {"umbrella": ["yes", "yes", "no"]}
    >>> smoothed = bmc.smooth(dbn, seen, engine=DiscreteFilter())
    >>> smoothed.probabilities("rain")[:, 1].round(3).tolist()
    [0.862, 0.799, 0.191]
    >>> bmc.most_likely(dbn, seen, engine=DiscreteFilter())["rain"].tolist()
    ['yes', 'yes', 'no']
    """

    max_states: int = 1 << 16
    max_bytes: float = 2.0 * 2**30

    label: ClassVar[str] = "discrete filter"
    is_exact: ClassVar[bool] = True
    belief: ClassVar[type] = DiscreteBelief

    def __post_init__(self) -> None:
        n = self.max_states
        if isinstance(n, bool) or not isinstance(n, (int, np.integer)) or n < 1:
            raise ValueError(
                f"DiscreteFilter(max_states={n!r}): give a number of states, 1 or more"
            )
        if not (isinstance(self.max_bytes, (int, float)) and self.max_bytes > 0):
            raise ValueError(
                f"DiscreteFilter(max_bytes={self.max_bytes!r}): give a positive number of bytes"
            )

    def most_likely(
        self, problem: SeriesProblem, seed: np.random.SeedSequence, progress: bool | None = None
    ) -> dict[str, np.ndarray]:
        self._check(problem, leaves=False)
        run = self._run(self._plan(problem, leaves=False), problem.series)
        path = best_path(run)
        if path is None or run.is_suspect:
            run.forward()  # says what is impossible, or wrong
        assert path is not None
        return path_values(run, path, problem.hidden)

    def is_out_of_room(self, problem: SeriesProblem) -> bool:
        """Whether it refuses for want of room alone: a joint state too large, all else being finite."""
        return isinstance(self._why_not(problem), BudgetError)

    def _too_large(self, plan: DiscreteSlices, steps: int) -> BudgetError | None:
        return size_refusal(plan, steps, self.max_states, self.max_bytes)

    def _kept(self, plan: DiscreteSlices) -> dict[str, str]:
        sizes = {v[1]: chain.size for chain in plan.chains for v in chain.state}
        return {name: f"part of a state with {n} values" for name, n in sizes.items()}
