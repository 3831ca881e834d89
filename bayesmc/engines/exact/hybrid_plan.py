"""Plans for exact answers: the discrete part as a clique tree, the Gaussian part integrated into it.

A plan knows its cost before any large table exists. That of a discrete net belongs to the net and outlives
the question; that of a hybrid net depends on which elements are observed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.exact.noiseless import clusters
from bayesmc.factors import BoundTree, Calibrated, CliqueTree, LogTable
from bayesmc.factors.gaussian import (
    Conditional,
    GaussianFactor,
    StrongPlan,
    integrate,
    likelihood_rows,
    strong_plan,
)
from bayesmc.factors.moments import Moments, mixture_scopes
from bayesmc.network import Problem
from bayesmc.structure import (
    DiscreteNet,
    InvalidRows,
    LinearGaussian,
    Variable,
    core_size,
    discrete_net,
    linear_gaussian,
    why_not_discrete,
    why_not_linear,
)

#: variables up to which an elimination order is looked for unasked
_SEARCHED = 2000


@dataclass(frozen=True, eq=False)
class Solved:
    """Both parts of an answer.

    Attributes
    ----------
    net : DiscreteNet
    calibrated : Calibrated
        The finite nodes given the evidence.
    moments : Moments or None
        Hidden continuous elements given the finite nodes.
    invalid : list
        Configurations with bad parameters, to be refused if they are possible.
    """

    net: DiscreteNet
    calibrated: Calibrated
    moments: Moments | None
    invalid: list[InvalidRows]


@dataclass(frozen=True)
class Cost:
    """What an exact answer takes.

    Attributes
    ----------
    bytes : float
    words : str
        The figures behind it.
    """

    bytes: float
    words: str


class DiscretePlan:
    """The variables, factors and clique tree of a net whose hidden nodes are all finite."""

    def __init__(self, problem: Problem) -> None:
        self.net: DiscreteNet = discrete_net(problem.model, problem.observed, problem.inputs)
        self.tree = CliqueTree(self.net.cards, self.net.scopes)
        self._static: BoundTree | None = None
        cost = self.tree.cost
        self.cost = Cost(
            cost.bytes,
            f"induced width {cost.induced_width}, largest table {cost.largest_entries:.3g} entries",
        )

    def solve(self, problem: Problem, states: Mapping[Variable, int]) -> Solved:
        bound, invalid = self._bound(problem)
        return Solved(self.net, bound.calibrate(states), None, invalid)

    def _bound(self, problem: Problem) -> tuple[BoundTree, list[InvalidRows]]:
        """The tree with its tables (kept between calls when none depends on the evidence), and the
        configurations with bad parameters."""
        if self._static is not None:
            return self._static, self.net.invalid
        with marking_invalid(), np.errstate(all="ignore"):
            extra, invalid = self.net.evidence_factors(problem.observed)
        bound = self.tree.bind([*self.net.static, *extra])
        if not self.net.evidence_sources:
            self._static = bound
        return bound, self.net.invalid + invalid


class HybridPlan:
    """A conditional linear-Gaussian net: blocks integrated out, then a clique tree of what is left.

    Blocks that nothing observed depends on are not integrated at all: they are read off forwards.
    """

    def __init__(self, problem: Problem) -> None:
        model, observed, inputs = problem.model, problem.observed, problem.inputs
        self.part: LinearGaussian = linear_gaussian(model, observed, inputs)
        self.net: DiscreteNet = discrete_net(model, observed, inputs, self.part.nodes)
        self.barren, informed = _split(self.part)
        self.clusters, self.informed, self.likelihoods = clusters(
            informed, self.part.likelihoods, self.part.exact
        )
        dims = self.part.dims
        shapes = [(f.scope, f.blocks, f.rows.shape[-2]) for f in self.likelihoods]
        shapes += [(c.scope, (c.block, *c.parents), dims[c.block]) for c in self.informed]
        blocks = {c.block: dims[c.block] for c in self.informed}
        tables = [s for s, _ in self.part.tables] + [c.scope for c in self.clusters]
        key = (tuple(shapes), tuple(tables), frozenset(self.part.nodes))
        kept = model.cache.setdefault("exact hybrid plans", {})
        found = kept.get(key)
        if found is None:
            if len(kept) > 8:
                kept.clear()
            found = kept[key] = self._planned(blocks, shapes)
        self.strong: StrongPlan
        self.tree: CliqueTree
        self.strong, self.tree = found
        links: dict[Any, Any] = {s.block: (s.scope, s.parents) for s in self.strong.steps}
        links.update({c.block: (c.scope, c.parents) for c in self.barren})
        for cluster in self.clusters:
            links[cluster.noise] = ((), ())
            blocks_of = (c.block for c in cluster.conditionals)
            links.update(dict.fromkeys(blocks_of, (cluster.scope, (cluster.noise,))))
        self.mixtures = mixture_scopes(links)
        self.cost = self._cost()

    def solve(self, problem: Problem, states: Mapping[Variable, int]) -> Solved:
        cards = self.net.cards
        dims = {**self.part.dims, **{c.block: c.offset.shape[-1] for c in self.part.computed}}
        with marking_invalid(), np.errstate(all="ignore"):
            extra, invalid = self.net.evidence_factors(problem.observed)
        factors = [*self.likelihoods, *(_as_factor(c, dims) for c in self.informed)]
        conditionals, tables = integrate(self.strong, factors, dims, cards)
        solved = [cluster.solve(dims, cards) for cluster in self.clusters]
        bound = self.tree.bind(
            [
                *self.net.static,
                *extra,
                *(table for _, table in self.part.tables),
                *(table for _, table, _ in solved),
                *(LogTable(table) for table in tables),
            ]
        )
        calibrated = bound.calibrate(states)
        dims.update(
            {c.noise: width for c, (_, _, width) in zip(self.clusters, solved, strict=True)}
        )
        noisy = [c for blocks, _, _ in solved for c in blocks]
        read_off = [*conditionals, *noisy, *self.barren, *self.part.computed]
        moments = Moments(read_off, dims, cards, calibrated.joint)
        return Solved(self.net, calibrated, moments, self.net.invalid + invalid + self.part.invalid)

    def _planned(self, blocks: Any, shapes: Any) -> tuple[StrongPlan, CliqueTree]:
        """How to integrate blocks out, and the clique tree of what that leaves."""
        cards = self.net.cards
        strong = strong_plan(blocks, cards, shapes)
        scopes = [*self.net.scopes, *(s for s, _ in self.part.tables)]
        scopes += [*(c.scope for c in self.clusters), *strong.table_scopes]
        return strong, CliqueTree(cards, scopes)

    def _cost(self) -> Cost:
        cards = self.net.cards
        dims = self.part.dims
        size = self.tree.cost.bytes + self.strong.bytes
        size += sum(c.bytes(dims, cards) for c in self.clusters)
        elements = len(self.informed) + sum(len(c.conditionals) for c in self.clusters)
        words = f"{elements} continuous elements integrated out"
        if cards:
            words += (
                f", induced width {self.tree.cost.induced_width}, "
                f"largest table {self.tree.cost.largest_entries:.3g} entries"
            )
        widest: Variable | None = None
        most = 1.0
        for block in (c.block for c in self.informed):
            scope = self.mixtures[block]
            count = math.prod([float(cards[v]) for v in scope])
            if count > most:
                widest, most = block, count
        if widest is not None:
            size += 32.0 * most * (1 + dims[widest] ** 2)
            name, element = widest
            where = f"[{element}]" if self._count(name) > 1 else ""
            switches = len(self.mixtures[widest])
            words += (
                f"; {name}{where} is a mixture of {most:.3g} Gaussians, one for every configuration of "
                f"{switches} discrete variables"
            )
        return Cost(size, words)

    def _count(self, name: str) -> int:
        return math.prod(self.net.model[name].plate_shape)


Plan = DiscretePlan | HybridPlan


def why_no_plan(problem: Problem) -> str | None:
    """Why a net is neither discrete nor conditional linear-Gaussian given the evidence, or None."""
    model, observed = problem.model, problem.observed
    why = why_not_discrete(model, observed)
    if why is None or any(n.declaration.source == "variable" for n in model.nodes.values()):
        return why
    return why_not_linear(model, observed, problem.inputs)


def too_large_to_search(problem: Problem) -> str | None:
    """Why looking for an elimination order would itself cost too much to call the answer cheap, or None."""
    model = problem.model
    finite = (math.prod(n.plate_shape) for n in model.nodes.values() if n.domain is not None)
    if sum(finite) <= _SEARCHED or why_not_discrete(model, problem.observed) is not None:
        return None
    core = model.cache.get("core size")
    if core is None:
        core = model.cache["core size"] = core_size(model, problem.observed)
    if core <= _SEARCHED:
        return None
    return (
        f"{core} discrete variables have three neighbours or more, also once simpler ones are summed out: "
        "too many to look for an elimination order first; engine=bmc.Exact() looks all the same"
    )


def plan_for(problem: Problem) -> Plan:
    """The plan, kept as long as the compiled model lives (of a hybrid net only the latest).

    Raises
    ------
    BudgetError
        A function has too many configurations to be tabulated.
    """
    cache = problem.model.cache
    if why_not_discrete(problem.model, problem.observed) is not None:
        latest = cache.get("exact hybrid plan")
        if latest is None or latest[0] is not problem:
            latest = cache["exact hybrid plan"] = (problem, HybridPlan(problem))
        return latest[1]
    plans: dict[Any, DiscretePlan] = cache.setdefault("exact plans", {})
    key = (
        tuple(sorted((n, v.tobytes()) for n, v in problem.inputs.items())),
        frozenset(n for n in problem.observed if problem.model[n].domain is None),
    )
    plan = plans.get(key)
    if plan is None:
        if len(plans) > 8:
            plans.clear()
        plan = plans[key] = DiscretePlan(problem)
    return plan


# ---- private ------------------------------------------------------------------------------------


def _split(part: LinearGaussian) -> tuple[list[Conditional], list[Conditional]]:
    """Conditionals of blocks that nothing observed depends on, and of the others."""
    needed = {b for f in part.likelihoods for b in f.blocks}
    needed |= {b for c, _ in part.exact for b in c.parents}
    of = {c.block: c for c in part.conditionals}
    todo = list(needed)
    while todo:
        for parent in of[todo.pop()].parents:
            if parent not in needed:
                needed.add(parent)
                todo.append(parent)
    barren = [c for c in part.conditionals if c.block not in needed]
    return barren, [c for c in part.conditionals if c.block in needed]


def _as_factor(given: Conditional, dims: Mapping[Any, int]) -> GaussianFactor:
    """A conditional density as a function of its block and the parents together."""
    d = dims[given.block]
    identity = np.broadcast_to(np.eye(d), (*given.gain.shape[:-1], d))
    rows, log_scale = likelihood_rows(
        np.concatenate([identity, -given.gain], axis=-1), given.offset, given.root
    )
    return GaussianFactor(given.scope, (given.block, *given.parents), rows, log_scale)
