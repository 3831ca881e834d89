"""Gibbs sampling on any net: every node from its full conditional, by the best kernel that fits it.

Which kernel moves which node, and why, is the table that ``explain`` shows.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.base import Treatment
from bayesmc.engines.mcmc.chains import ChainEngine
from bayesmc.engines.mcmc.given import note_start
from bayesmc.engines.mcmc.jointly import trajectories_of
from bayesmc.engines.mcmc.plan import Plan
from bayesmc.engines.mcmc.sweep import SweepSampler, refused
from bayesmc.engines.weighted.drawing import check_count
from bayesmc.kernels.accepted import Accepted, finite_kernel, number_kernel
from bayesmc.kernels.base import ANYHOW, How, Kernel
from bayesmc.kernels.collapsed import CollapsedBlock, governing
from bayesmc.kernels.completed import completed_kernel
from bayesmc.kernels.conjugate import Conjugate, conjugate_kernel
from bayesmc.kernels.coupling import coupled_blocks, deterministic_constraints
from bayesmc.kernels.ensemble import BlockWalk
from bayesmc.kernels.enumerate import Enumerate, FiniteTerms
from bayesmc.kernels.factor_slice import FactorSlice
from bayesmc.kernels.forest_block import ForestBlock
from bayesmc.kernels.forest_search import forest_blocks
from bayesmc.kernels.gaussian_block import gaussian_blocks, vector_blocks
from bayesmc.kernels.hamiltonian import Hamiltonian
from bayesmc.kernels.jump import Jump
from bayesmc.kernels.labels import Labels, label_kernel
from bayesmc.kernels.lattice import lattice_kernel, site_forest
from bayesmc.kernels.random_walk import AdaptiveWalk, may_be_drawn_anew, some_support
from bayesmc.kernels.redrawn import redrawn_kernels
from bayesmc.kernels.rescaled import rescaled_kernels
from bayesmc.kernels.slice import Slice
from bayesmc.kernels.stacked import Stacked
from bayesmc.kernels.tables import joint_states, table_kernel, table_kernels
from bayesmc.network import Problem
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.stacked import FEWEST, Forms, stacks
from bayesmc.structure.target import Target, target_of

#: sweeps of which one draws all numbers anew where trajectories move them, too
_SELDOM = 4
#: components that move together along learnt directions, at most
_FACTOR_SIZE = 24
#: supports that are boxes: every number on its own
_BOXES = ("real", "interval", "circle", "real vector", "product", "integers")


@dataclass(frozen=True, repr=False)
class Gibbs(ChainEngine):
    """Markov chains that draw every node in turn from its distribution given all others.

    What kernel a node gets is found, not declared (`explain` shows the table): nodes on which nothing
    observed depends are drawn forward; conjugate pairs in closed form; chains and trees of finite nodes as
    one, by filtering and sampling along them; other finite nodes by trying all states; up to 64 numbers that
    share terms jointly along trajectories of the No-U-Turn sampler, with what has a closed form among them;
    more by slices, and so what has no derivative; simplices and matrices without one by an adaptive random
    walk. All chains and all elements of a plate move in one array operation.

    Parameters
    ----------
    draws : int, optional
        Draws kept of every chain; by default as many as it takes to ``ess``, or 4,000 of each chain
        (up to twice that where it is nearly there) and a warning that names the node.
    warmup : int, optional
        Sweeps before that, in which widths and scales adapt; by default until chains have forgotten where
        they started, 1,000 at most (with ``draws``: 1,000).
    chains : int, optional
        Chains, all in one array: many cost little more than one. By default as many as the model's size lets
        run at little cost, 4 to 256, in groups that start as one (with ``draws``: 4).
    thinning : int
        Sweeps per kept draw.
    debug : bool
        Check every conjugate draw against the densities of the model, and every move in machine code against
        that in NumPy (slow): an error names the node.
    compiled : bool, optional
        Whether slices and trajectories are machine code, which needs the extra `[fast]`: always, never, or by
        default where the sweeps of the warmup would take longer in NumPy than compiling. `explain` says of
        each node what it is, and why; what has no machine code goes on in NumPy.
    threads : int
        Threads that share the chains in machine code; the answer is the same.
    ess : float
        Effective size that every number of the answer is to have where ``draws`` is left out.
    start : dict, optional
        Node -> where its chains start: what broadcasts to ``(*plates, *event)`` for all of them, or to
        ``(chains, *plates, *event)`` for each; labels for states. Nodes that are left out are drawn given
        these. What nothing observed depends on is drawn forward, wherever it starts.
    groups : int, optional
        Equal groups of chains that run apart, each with random numbers of its own: units of work for
        ``infer(executor=)``. It belongs to the question, so that a seed gives the same draws whoever works.
        By default one, and groups of four or more where a sweep is mostly arithmetic; it needs ``draws``.

    References
    ----------
    Geman and Geman (1984), IEEE PAMI 6; Gelfand and Smith (1990), JASA 85; Plummer (2003), JAGS.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet(plates={"i": 4})
    >>> net.add("mean", bmc.Normal(0.0, 10.0))
    >>> net.add("precision", bmc.Gamma(1.0, 1.0))
    >>> net.add("x", lambda mean, precision: bmc.Normal(mean, precision**-0.5), plates="i")
    >>> posterior = bmc.infer(net, {"x": [1.2, 0.8, 1.5, 0.5]}, engine=bmc.Gibbs(), rng=0)
    >>> bool(abs(posterior.mean("mean") - 1.0) < 0.05)
    True
    """

    draws: int | None = None
    warmup: int | None = None
    chains: int | None = None
    thinning: int = 1
    debug: bool = False
    compiled: bool | None = None
    threads: int = field(default=1, compare=False, repr=False)
    ess: float = 1000
    start: Mapping[str, Any] | None = field(default=None, compare=False, repr=False)
    groups: int | None = None

    label: ClassVar[str] = "Gibbs sampling"
    judges: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count(self, "threads", self.threads, "2")
        if self.compiled is not None and not isinstance(self.compiled, bool):
            raise ValueError(f"Gibbs(compiled={self.compiled!r}): compiled is True, False or None")

    def refusal(self, problem: Problem) -> str | None:
        def planned(problem: Problem) -> None:
            self._plan(problem)

        return refused(problem, "Gibbs", "has no kernel for this net", planned, takes_parts=True)

    def describe(self, problem: Problem) -> dict[str, str]:
        return {row.node: str(row) for row in self.table(problem)}

    def table(self, problem: Problem) -> list[Treatment]:
        lengths = self.lengths(problem)
        return self._plan(problem).table(lengths.warmup, lengths.chains)

    def tied(self, problem: Problem) -> Sequence[str]:
        return self._plan(problem).constraints

    def sampler(self, problem: Problem) -> SweepSampler:
        plan = self._plan(problem)
        sampler = SweepSampler(plan.target, plan.kernels)
        sampler.climbs = any(_is_slice(k) for k in plan.kernels)
        return sampler

    def _plan(self, problem: Problem) -> Plan:
        note_start(problem, self.start)
        return plan_of(problem, self.debug, how=How(self.compiled, self.threads))


def plan_of(
    problem: Problem,
    debug: bool = False,
    only: Collection[str] | None = None,
    how: How = ANYHOW,
) -> Plan:
    """The plan for a posed problem, made once.

    Parameters
    ----------
    only : collection of str, optional
        Nodes that the plan is to move; the rest of the chain is moved by others. By default all of it.
    how : How
        What of it is machine code.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.engines.mcmc.gibbs import plan_of
    >>> from bayesmc.network import pose
    >>> net = bmc.BayesNet()
    >>> net.add("rate", bmc.Gamma(1.0, 1.0))
    >>> net.add("n", lambda rate: bmc.Poisson(rate))
    >>> net.add("seen", lambda n: bmc.Binomial(n, 0.5))
    >>> [kernel.names for kernel in plan_of(pose(net, {"seen": 3}), only=("rate",)).kernels]
    [('rate',)]
    """
    key = f"gibbs plan, debug={debug}, {how}"
    if only is not None:
        key += f", only {sorted(only)}"
    if key not in problem.cache:
        # kernels are tried on reachable values, at which numbers may put a parameter out of range
        with marking_invalid(), np.errstate(all="ignore"):
            problem.cache[key] = _planned(problem, debug, only, how)
    return problem.cache[key]


# ---- private ------------------------------------------------------------------------------------


def _planned(problem: Problem, debug: bool, only: Collection[str] | None, how: How) -> Plan:
    target = target_of(problem)
    names = tuple(n for n in target.chain if only is None or n in only)
    blankets = {name: Blanket(target, name) for name in names}
    blocks = gaussian_blocks(target, blankets, debug)
    joined = {n for b in blocks for n in b.names}
    vectors = [
        b for b in vector_blocks(target, blankets, joined, debug) if governing(target, b, blankets)
    ]
    in_part = [n for n in blankets if target.is_seen_in_part(n)]
    blocks += vectors
    joined |= {n for b in vectors for n in b.names}
    forms = Forms(target)
    kernels, constraints = _finite(target, blankets, forms, debug)
    completed = [completed_kernel(blankets[n]) for n in in_part if n not in joined]
    joined |= set(in_part)
    left = [n for n in names if n not in joined and target.model[n].domain is None]
    conjugate, refusals = _conjugate(blankets, forms, left, debug)
    joints = [k.joint for k in kernels if isinstance(k, ForestBlock) and k.joint is not None]
    kernels += [k.reading(joints) if isinstance(k, Conjugate) else k for k in conjugate]
    kernels += completed
    scales_of = [governing(target, block, blankets) for block in blocks]
    governed = {n for scales in scales_of for n in scales}
    closed = [n for k in kernels if isinstance(k, Conjugate) for n in k.names]
    keys = {n: forms.key(blankets[n]) for n in refusals} if len(refusals) >= FEWEST else {}
    joint = (
        trajectories_of(problem, refusals, closed, governed, keys, debug, how) if refusals else []
    )
    moved = {n for k in joint for n in k.names}
    kernels = [k for k in kernels if not (isinstance(k, Conjugate) and moved >= set(k.names))]
    left = [n for n in refusals if n not in moved]
    kernels += [*joint, *_numbers(blankets, forms, left, debug, how)]
    for block, scales in zip(blocks, scales_of, strict=True):
        alone = {k.names[0]: k for k in kernels if len(k.names) == 1 and k.names[0] in scales}
        kernels = [k for k in kernels if k not in alone.values()]
        kernels.append(CollapsedBlock(target, block, scales, alone) if scales else block)
    order = {n: i for i, n in enumerate(target.chain)}
    # labels of mixtures first: others read the sums that they leave in the state
    kernels.sort(key=lambda k: (not isinstance(k, Labels), -max(order[n] for n in k.names)))
    slow = [n for k in kernels if _is_slice(k) for n in k.names]
    moved = set(names)
    if slow:
        found = rescaled_kernels(target, slow, how=how, debug=debug)
        kernels += [k for k in found if moved >= set(k.names)]
    kernels += redrawn_kernels(target, blankets, kernels)
    if slow and may_be_drawn_anew(target, names):
        every = _SELDOM if any(isinstance(k, Hamiltonian) for k in kernels) else 1
        kernels.append(BlockWalk(target, names, anew=1.0, every=every))
    return Plan(problem, target, blankets, kernels, refusals, constraints)


def _conjugate(
    blankets: Mapping[str, Blanket], forms: Forms, names: Sequence[str], debug: bool
) -> tuple[list[Kernel], dict[str, str]]:
    """Kernels of nodes with a closed form, and why others have none: of like nodes one is asked."""
    kernels: list[Kernel] = []
    refusals: dict[str, str] = {}
    asked: dict[Hashable, str] = {}
    for name in names:
        key = forms.key(blankets[name]) if len(names) >= FEWEST else None
        first = None if key is None else asked.get(key)
        if first is not None:
            one, other = forms.of(blankets[first]), forms.of(blankets[name])
            assert one is not None and other is not None
            refusals[name] = one.said_of(other, refusals[first])
            continue
        kernel = conjugate_kernel(blankets[name], debug)
        if isinstance(kernel, Kernel):
            kernels.append(kernel)
        else:
            refusals[name] = kernel
            if key is not None:
                asked[key] = name
    return kernels, refusals


def _is_slice(kernel: Kernel) -> bool:
    if isinstance(kernel, Accepted):
        other = kernel.other
        return other is not None and not kernel.constraints and _is_slice(other)
    return isinstance(
        kernel.kernel if isinstance(kernel, Stacked) else kernel, (Slice, FactorSlice, Hamiltonian)
    )


def _finite(
    target: Target, blankets: Mapping[str, Blanket], forms: Forms, debug: bool
) -> tuple[list[Kernel], tuple[str, ...]]:
    """Kernels of the finite nodes that have a blanket, and those that these may leave stuck."""
    names = [n for n in blankets if target.model[n].domain is not None]
    if not names:
        return [], ()
    kernels: list[Kernel] = []
    for name in names:
        mixture = _mixture_label(target, blankets[name], debug)
        kernels += [] if mixture is None else [mixture]
    names = [n for n in names if all(n not in k.names for k in kernels)]
    if not names:
        return kernels, ()
    lattices: dict[str, Kernel] = {}
    for name in names:
        sites = site_forest(blankets[name]) or lattice_kernel(blankets[name])
        if sites is not None:
            lattices[name] = sites
    kernels += lattices.values()
    tight = tuple(n for n, k in lattices.items() if getattr(k, "constrained", False))
    if len(lattices) == len(names):
        return kernels, tight
    terms = FiniteTerms(target)
    forests = forest_blocks(target, blankets, [n for n in names if n not in lattices], terms)
    kernels += forests
    joined = [f.names for f in forests]
    blocks = coupled_blocks(target, terms, joined)
    blocks = [b for b in blocks if blankets.keys() >= set(b)]
    drawn = {n for f in forests for n in f.names}
    wanted = [(n,) for n in names if n not in lattices and n not in drawn] + blocks
    tabulated, left = table_kernels(target, wanted, terms)
    kernels += tabulated
    alone = []
    for block in left:
        if len(block) > 1:
            kernels.append(joint_states(target, block, terms))
        elif (kernel := table_kernel(blankets[block[0]], terms)) is not None:
            kernels.append(kernel)
        elif (labels := label_kernel(blankets[block[0]], debug)) is not None:
            kernels.append(labels)
        else:
            alone.append(block[0])
    groups, alone = stacks(target, blankets, alone, forms)
    kernels += [Stacked(group, Enumerate) for group in groups]
    kernels += [finite_kernel(blankets[n]) for n in alone]
    tied = deterministic_constraints(target, [*joined, *blocks], terms)
    return kernels, (*tight, *(n for n in tied if n in blankets))


def _mixture_label(target: Target, blanket: Blanket, debug: bool) -> Labels | None:
    """The kernel of a label of hidden components that no other finite node governs: nothing else fits it."""
    above = () if blanket.own is None else target.hidden_above(blanket.own)
    if any(target.model[n].domain is not None for n in above if n != blanket.name):
        return None
    found = label_kernel(blanket, debug)
    return None if found is None or not all(t.is_asked for t in found.terms) else found


def _numbers(
    blankets: Mapping[str, Blanket], forms: Forms, names: Sequence[str], debug: bool, how: How
) -> list[Kernel]:
    """Kernels of nodes without a closed form that have too many values to try."""
    target = forms.target
    kernels: list[Kernel] = []
    left = []
    for name in names:
        if _kind(target, blankets[name]) in _BOXES:
            left.append(name)
        elif target.model[name].is_discrete:  # vectors of counts
            kernels.append(Jump(blankets[name]))
        else:
            kernels.append(AdaptiveWalk(blankets[name]))
    stacked, left = stacks(target, blankets, left, forms)
    alike = partial(Slice, debug=debug, how=how, reads_data=True)
    kernels += [Stacked(group, alike) for group in stacked]
    for group in _together(target, blankets, left):
        if len(group) > 1 or target.model[group[0]].event_shape:
            kernels.append(FactorSlice(target, group))
            left = [n for n in left if n not in group]
    return kernels + [number_kernel(blankets[n], debug, how) for n in left]


def _kind(target: Target, blanket: Blanket) -> str:
    """The kind of a node's support, its bounds apart."""
    return some_support(target.model, blanket.name, target.known).kind


def _together(
    target: Target, blankets: Mapping[str, Blanket], names: Sequence[str]
) -> list[tuple[str, ...]]:
    """Groups of unplated continuous nodes that share terms, small enough to move along learnt axes."""
    groups: list[list[str]] = []
    for name in names:
        node = target.model[name]
        size = math.prod(node.event_shape)
        if node.plates or node.is_discrete or blankets[name].own is None or size > _FACTOR_SIZE:
            continue
        if node.support is None or node.support.kind in ("circle", "product"):
            continue  # bounds that move, or turns
        mine = {id(t) for t in target.terms_of((name,))}
        merged = [name]
        for group in list(groups):
            meets = any(id(t) in mine for other in group for t in target.terms_of((other,)))
            sizes = sum(math.prod(target.model[n].event_shape) for n in (*group, *merged))
            if meets and sizes <= _FACTOR_SIZE:
                merged = [*group, *merged]
                groups.remove(group)
        groups.append(merged)
    return [tuple(n for n in target.chain if n in g) for g in groups]
