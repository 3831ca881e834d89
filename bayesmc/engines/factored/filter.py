"""``BoyenKoller``: filtering where a joint state would be too large, with beliefs over clusters of nodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from bayesmc.dbn import DynamicBayesNet, Series, SeriesProblem, Slices
from bayesmc.engines.discrete.finite import FiniteFilter
from bayesmc.engines.discrete.run import Run
from bayesmc.engines.discrete.slices import DiscreteSlices
from bayesmc.engines.factored.clusters import check_clusters, in_words, named_clusters
from bayesmc.engines.factored.coupling import coupled_clusters
from bayesmc.engines.factored.run import FactoredRun
from bayesmc.engines.factored.slices import FactoredSlices
from bayesmc.engines.slice_steps import plates_apart
from bayesmc.errors import BudgetError


@dataclass(frozen=True)
class BoyenKoller(FiniteFilter):
    clusters: Sequence[Sequence[Any]] | None = None
    max_bytes: float = 2.0 * 2**30

    label: ClassVar[str] = "Boyen-Koller filter"

    def __post_init__(self) -> None:
        if self.clusters is not None:
            object.__setattr__(self, "clusters", check_clusters(self.clusters))

    def treatment(self, problem: SeriesProblem) -> Callable[[str], str]:
        plan = self._plan(problem)
        raise NotImplementedError

    def _planned(
        self,
        dbn: DynamicBayesNet,
        slices: Slices,
        static: Mapping[str, np.ndarray],
        series: Series,
        seen: frozenset[str] = frozenset(),
        leaves: bool = True,
        absent: frozenset[str] = frozenset(),
    ) -> DiscreteSlices:
        apart = plates_apart(slices)

        def choose(plan: DiscreteSlices) -> Sequence[Any]:
            if self.clusters is not None:
                return named_clusters(self.clusters, plan)
            first = {n: v[0] for n, v in series.inputs.items()}
            return coupled_clusters(slices, apart, static, first)

        return FactoredSlices(slices, apart, seen, static, leaves, absent, choose)

    def _run(self, plan: Any, series: Series, first: int = 0, before: Any = None) -> Run:
        return FactoredRun(plan, series, first, before)

    def _too_large(self, plan: Any, steps: int) -> BudgetError | None:
        return None
