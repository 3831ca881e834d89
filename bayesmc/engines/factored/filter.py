"""``BoyenKoller`` and ``FactoredFrontier``: where a joint state is too large, beliefs that are products.

Options, refusals and what is said of them; clusters are read in ``clusters`` or found in ``coupling``, slices
passed in ``run`` and ``frontier``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from bayesmc.dbn import Row, Series, SeriesProblem, Slices, read_static
from bayesmc.engines.discrete.finite import FiniteFilter
from bayesmc.engines.discrete.posterior import FiniteBelief, window
from bayesmc.engines.discrete.rows import Variable
from bayesmc.engines.discrete.run import Run
from bayesmc.engines.discrete.slices import DiscreteSlices
from bayesmc.engines.factored.clusters import check_clusters, in_words, named_clusters
from bayesmc.engines.factored.coupling import coupled_clusters, singles
from bayesmc.engines.factored.frontier import FrontierRun
from bayesmc.engines.factored.run import FactoredRun
from bayesmc.engines.factored.slices import FactoredSlices
from bayesmc.engines.slice_steps import plates_apart
from bayesmc.errors import BudgetError, UnsupportedError


class FactoredBelief(FiniteBelief):
    """Probabilities of the nodes of one slice, from tables of clusters, with which it goes on."""


class FrontierBelief(FiniteBelief):
    """Probabilities of the nodes of one slice, each by itself."""


class FactoredFilter(FiniteFilter):
    """Base of the filters whose belief is a product."""

    max_bytes: float

    def __post_init__(self) -> None:
        most = self.max_bytes
        if isinstance(most, bool) or not (isinstance(most, (int, float)) and most > 0):
            raise ValueError(
                f"{self._name}(max_bytes={self.max_bytes!r}): give a positive number of bytes"
            )

    def _chosen(
        self, slices: Slices, static: Mapping[str, np.ndarray], series: Series
    ) -> Callable[[DiscreteSlices], Sequence[tuple[Variable, ...]]]:
        """From a template's variables to clusters."""
        raise NotImplementedError

    def _planned(
        self,
        slices: Slices,
        static: Mapping[str, np.ndarray],
        series: Series,
        seen: frozenset[str] = frozenset(),
        leaves: bool = True,
        absent: frozenset[str] = frozenset(),
    ) -> FactoredSlices:
        choose = self._chosen(slices, static, series)
        apart = plates_apart(slices)
        return FactoredSlices(slices, apart, seen, static, leaves, absent, choose)


@dataclass(frozen=True)
class BoyenKoller(FactoredFilter):
    """Filtering and smoothing of finite nodes with beliefs that are products over clusters of them.

    Each slice is exact given the belief before it, and a slice never costs the joint state: that belief, the
    slice's densities and what is seen are calibrated on the clique tree of two slices, and the probabilities
    of each cluster, which are exact for that slice, are all that the next one is told. What clusters of the
    slice have to do with each other is forgotten, which is the one approximation; where nodes mix, errors die
    out and do not add up (Boyen and Koller's contraction). One cluster of everything is the exact filter.

    Parameters
    ----------
    clusters : list of lists of str, optional
        Nodes that the next slice reads, each in at least one; ``("x", 3)`` is one element of a node in a
        plate, and a cluster that names nodes in plates stands for one of each element. Clusters may overlap
        where they form a tree (what two share is in all between): the belief is then their product over that
        of what neighbours share, conditionally factored. By default those nodes are put together that have
        most mutual information after one slice, measured on a short series drawn from the template: parts of
        up to 16 joint states, each in clusters with its neighbours of the tree that has most of what is left
        (256 joint states). They are the same for any data.
    max_bytes : float
        Memory above which it refuses, with the figure, before allocating.

    Notes
    -----
    ``log_marginal_likelihood`` is the sum of what each slice says given a factored belief: an approximation
    without a stated error, as are all probabilities. Larger clusters are the way to see how far they are off.
    What is asked of several clusters of one slice is answered from the densities of that slice, before the
    belief is projected. ``smooth`` passes back with the same projection: rows after a slice tell it about its
    clusters, one by one, and the answer is calibrated within the slice; exact with one cluster.

    References
    ----------
    Boyen and Koller (1998), Tractable inference for complex stochastic processes, UAI; Koller and Friedman
    (2009), Probabilistic Graphical Models, sec. 15.3.2.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> dbn = bmc.DynamicBayesNet("three machines; each wears the next")
    >>> dbn.table("a", ["a_prev"], [[0.9, 0.1], [0.0, 1.0]], initial=[1.0, 0.0])
    >>> wear = [[[0.9, 0.1], [0.0, 1.0]], [[0.7, 0.3], [0.0, 1.0]]]
    >>> dbn.table("b", ["a_prev", "b_prev"], wear, initial=[1.0, 0.0])
    >>> dbn.table("c", ["b_prev", "c_prev"], wear, initial=[1.0, 0.0])
    >>> dbn.table("noise", ["c"], [[0.9, 0.1], [0.2, 0.8]])
    >>> engine = bmc.BoyenKoller(clusters=[["a"], ["b", "c"]])
    >>> filtered = bmc.filter(dbn, {"noise": [0, 0, 1, 1]}, engine=engine)
    >>> filtered.probabilities("b")[:, 1].round(3).tolist()
    [0.0, 0.1, 0.262, 0.409]
    """

    clusters: Sequence[Sequence[Any]] | None = None
    max_bytes: float = 2.0 * 2**30

    label: ClassVar[str] = "Boyen-Koller filter"
    belief: ClassVar[type] = FactoredBelief

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.clusters is not None:
            object.__setattr__(self, "clusters", check_clusters(self.clusters))

    def effort(self, problem: SeriesProblem) -> str:
        plan: Any = self._plan(problem)
        if all(len(clusters) < 2 for clusters in plan.clusters):
            return "with all that ever meets in one cluster: exact"
        sizes = [c.size for clusters in plan.clusters for c in clusters]
        found = "found" if self.clusters is None else "given"
        return (
            f"with beliefs that are products over {len(sizes)} clusters ({found}), of {max(sizes)} joint "
            "states or fewer: approximate, the log marginal likelihood too, without a stated error"
        )

    def reasons(self, problem: SeriesProblem) -> tuple[str, ...]:
        plan: Any = self._plan(problem)
        if all(len(clusters) < 2 for clusters in plan.clusters):
            return ("all hidden nodes are finite, and on a clique tree there is room to be exact",)
        return (
            "all hidden nodes are finite, but too many for one joint state: beliefs are products over "
            "clusters, an approximation without a stated error",
        )

    def _kept(self, plan: Any) -> dict[str, str]:
        found: dict[str, str] = {}
        for cluster in (c for clusters in plan.clusters for c in clusters):
            for _, name, _ in cluster.scope:
                members = in_words(cluster.scope, plan.slices)
                words = f"in a cluster of {cluster.size} joint states ({members})"
                if len(cluster.scope) == 1:
                    words = f"by itself, {cluster.size} states"
                found.setdefault(name, words)
        return found

    def _chosen(
        self, slices: Slices, static: Mapping[str, np.ndarray], series: Series
    ) -> Callable[[DiscreteSlices], Sequence[tuple[Variable, ...]]]:
        def choose(plan: DiscreteSlices) -> Sequence[tuple[Variable, ...]]:
            if self.clusters is not None:
                return named_clusters(self.clusters, plan)
            inputs = {n: v[0] for n, v in series.inputs.items()}
            return coupled_clusters(slices, plates_apart(slices), static, inputs)

        return choose

    def _plan_of(self, belief: Any, slices: Slices) -> DiscreteSlices:
        """With the clusters that it has: those found may be others where inputs have moved on."""
        before = belief.state.before
        if before is None:
            return super()._plan_of(belief, slices)
        scopes = [scope for chain in before for scope in chain]
        static = read_static(slices, belief.static)
        apart, nothing = plates_apart(slices), frozenset[str]()
        return FactoredSlices(slices, apart, nothing, static, True, nothing, lambda plan: scopes)

    def _run(self, plan: Any, series: Series, first: int = 0, before: Any = None) -> Run:
        return FactoredRun(plan, series, first, before)

    def _too_large(self, plan: Any, steps: int) -> BudgetError | None:
        total = 0.0
        for number, clusters in enumerate(plan.clusters):
            tree = plan.tree(number, 2)
            kept = sum(float(c.size) for c in clusters) + sum(
                math.prod(float(plan.cards[v]) for v in s) for s in plan.beside(number, 2)
            )
            kept *= plan.reader.sequences
            total += 8.0 * (6.0 * tree.entries + 3.0 * steps * kept)
            if total > self.max_bytes:
                names = ", ".join(dict.fromkeys(v[1] for v in plan.chains[number].state))
                return BudgetError(
                    f"BoyenKoller: the clique tree of two slices of {names} has {tree.entries:.3g} entries "
                    f"and needs about {total:.3g} bytes, above max_bytes={self.max_bytes:.3g}; give smaller "
                    "clusters=, or use FactoredFrontier() or ParticleFilter(particles)",
                    int(min(total, 2**62)),
                )
        return None


@dataclass(frozen=True)
class FactoredFrontier(FactoredFilter):
    """Filtering and smoothing of finite nodes, each by itself: cheap where even one exact slice is too dear.

    A node's probabilities come from its density and its parents' probabilities, as if the parents were
    independent; what is seen of several nodes is shared out among them the same way. A slice costs the tables
    of its densities and no more. It is one iteration of loopy belief propagation on the unrolled template
    (Murphy and Weiss), less exact than ``BoyenKoller`` with single nodes, whose slices are exact.

    Takes templates that are regular: hidden nodes have their hidden parents in the slice before, and readings
    are of nodes that the next slice reads.

    Parameters
    ----------
    max_bytes : float
        Memory above which it refuses, with the figure, before allocating.

    Notes
    -----
    ``log_marginal_likelihood`` and all probabilities are approximations without a stated error. What is asked
    of several nodes is answered as if they were independent. ``smooth`` passes back once, each node telling
    its parents what is known of it, the other parents being as the filter has them.

    References
    ----------
    Murphy and Weiss (2001), The factored frontier algorithm for approximate inference in DBNs, UAI.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> dbn = bmc.DynamicBayesNet()
    >>> infects = [[[0.95, 0.05], [0.3, 0.7]], [[0.7, 0.3], [0.2, 0.8]]]
    >>> dbn.table("a", ["b_prev", "a_prev"], infects, initial=[0.9, 0.1])
    >>> dbn.table("b", ["a_prev", "b_prev"], infects, initial=[0.9, 0.1])
    >>> dbn.table("test", ["a"], [[0.9, 0.1], [0.2, 0.8]])
    >>> filtered = bmc.filter(dbn, {"test": [0, 1, 1]}, engine=bmc.FactoredFrontier())
    >>> filtered.probabilities("b")[:, 1].round(3).tolist()
    [0.1, 0.121, 0.231]
    """

    max_bytes: float = 2.0 * 2**30

    label: ClassVar[str] = "factored frontier"
    belief: ClassVar[type] = FrontierBelief
    _inside: ClassVar[str] = "by itself, in its slice alone"

    def refusal(self, problem: SeriesProblem) -> str | None:
        return super().refusal(problem) or _why_irregular(self._plan(problem))

    def _absorbed(self, belief: FiniteBelief, slices: Slices, row: Row) -> FiniteBelief:
        seen = frozenset(n for n, o in row.seen.items() if o.mask is None)
        absent = frozenset(n for n in slices.dynamic if n not in row.seen)
        kept = slices.later.cache.setdefault("irregular rows", {})
        if (seen, absent) not in kept:
            series = window(slices, None if belief.state is None else belief.state.series, row)
            static = read_static(slices, belief.static)
            plan = self._planned(slices, static, series, seen, True, absent)
            kept[seen, absent] = _why_irregular(plan)
        reason = kept[seen, absent]
        if reason is not None:
            raise UnsupportedError(reason)
        return super()._absorbed(belief, slices, row)

    def effort(self, problem: SeriesProblem) -> str:
        return (
            "with every node by itself, parents taken to be independent: approximate, the log marginal "
            "likelihood too, without a stated error"
        )

    def _kept(self, plan: Any) -> dict[str, str]:
        own = {v: plan.cards[v] for chain in plan.chains for v in chain.state}
        return {name: f"by itself, {n} states" for (_, name, _), n in own.items()}

    def _chosen(
        self, slices: Slices, static: Mapping[str, np.ndarray], series: Series
    ) -> Callable[[DiscreteSlices], Sequence[tuple[Variable, ...]]]:
        return singles

    def _run(self, plan: Any, series: Series, first: int = 0, before: Any = None) -> Run:
        return FrontierRun(plan, series, first, before)

    def _too_large(self, plan: Any, steps: int) -> BudgetError | None:
        sequences, total = plan.reader.sequences, 0.0
        for kind in (0, 2):
            for name, scope in plan.scopes(kind):
                total += 16.0 * float(np.prod([float(plan.cards[v]) for v in scope])) * sequences
                if total > self.max_bytes:
                    return BudgetError(
                        f"FactoredFrontier: the densities of a slice, that of {name!r} last, need about "
                        f"{total:.3g} bytes, above max_bytes={self.max_bytes:.3g}; give nodes fewer parents, "
                        "or use ParticleFilter(particles)",
                        int(min(total, 2**62)),
                    )
        return None


# ---- private ------------------------------------------------------------------------------------


def _why_irregular(plan: Any) -> str | None:
    """Why what is seen would not reach what later slices read, node by node; or None."""
    inside = {v for chain in plan.chains for v in chain.inside}
    for kind in (0, 2):
        scopes = [(n, s) for n, s in plan.scopes(kind) if plan.has_density(n)]
        hidden = {s[-1]: n for n, s in scopes if n in plan.reader.variables and len(s) > 1}
        for name, scope in scopes:
            parents = [v for v in scope[:-1] if v[0] == 0]
            if name in plan.reader.variables and parents:
                return (
                    f"FactoredFrontier adds hidden nodes one by one, and what is seen of {name!r} would not "
                    f"reach its parent {parents[0][1]!r} in the same slice; use BoyenKoller()"
                )
            told = scope if name not in plan.reader.variables else ()
            if name in plan.reader.variables and name not in plan.absent:
                told = scope[-1:]
            for v in told:
                if v in inside and v in hidden:
                    return (
                        f"FactoredFrontier adds hidden nodes one by one, and what is seen of {name!r} would "
                        f"tell {v[1]!r}, which no later slice reads, and nothing else; use BoyenKoller()"
                    )
    return None
