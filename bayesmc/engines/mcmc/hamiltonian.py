"""Hamiltonian Monte Carlo on any net whose densities have derivatives: options, and which kernel moves what.

Continuous nodes move together by the No-U-Turn sampler; finite ones, and whole numbers, by the kernels that
Gibbs has for them, in turn with it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, get_args

from bayesmc.engines.base import Treatment
from bayesmc.engines.mcmc.chains import ChainEngine
from bayesmc.engines.mcmc.gibbs import Plan, plan_of
from bayesmc.engines.mcmc.given import note_start
from bayesmc.engines.mcmc.jointly import continuous, density_of, jumping, summed_with
from bayesmc.engines.mcmc.sweep import SweepSampler, refused
from bayesmc.engines.weighted.drawing import check_count
from bayesmc.kernels.hamiltonian import GRADIENTS, Hamiltonian
from bayesmc.kernels.hamiltonian_warmup import Metric, fitting
from bayesmc.kernels.redrawn import redrawn_kernels
from bayesmc.kernels.rescaled import rescaled_kernels
from bayesmc.kernels.summed_out import SummedOut
from bayesmc.network import Problem
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.compiled_density import in_machine_code
from bayesmc.structure.target import target_of

#: sweeps of which one moves scales with what they scale: a trajectory in machine code costs far less
_RESCALED = 4
_JUMPS = "the density jumps where it is compared, which no gradient sees"


@dataclass(frozen=True, repr=False)
class HamiltonianMonteCarlo(ChainEngine):
    """Markov chains that follow the gradient of the log posterior: multinomial No-U-Turn sampling.

    All continuous nodes move together on an unconstrained scale, which mixes where one at a time they would
    crawl: correlated coefficients, hierarchies, hundreds of effects. Every density must be one that can be
    followed and has a derivative; finite nodes and whole numbers are drawn in between, as `Gibbs` does, and
    nodes on which nothing observed depends are drawn forward. A scale of effects also moves in proportion
    with them, since no one length of a step suits both the neck and the mouth of such a funnel.

    Parameters
    ----------
    draws : int, optional
        Draws kept of every chain; by default as many as it takes to ``ess``, or 4,000 of each chain
        (up to twice that where it is nearly there) and a warning that names the node.
    warmup : int, optional
        Draws before that, in which the step and the metric are learnt from all chains together; by default
        until chains have forgotten where they started, 1,000 at most (with ``draws``: 1,000).
    chains : int, optional
        Chains, all in one array. By default as many as the model's size lets run at little cost, 4 to 256,
        in groups that start as one (with ``draws``: 4).
    thinning : int
        Transitions per kept draw.
    target_accept : float
        Mean acceptance that the step is learnt for; nearer to 1 steps are shorter, and follow sharper bends.
        Where the warmup's length is left open and trajectories diverge in it, the step is learnt anew for one
        nearer to 1: 0.95 in place of 0.8.
    max_depth : int
        Doublings of a trajectory, at most: up to ``2**max_depth - 1`` evaluations of the gradient for a draw.
    marginalize : bool
        Whether finite nodes are summed out of the density where they can be, and drawn given the numbers:
        labels of a plate element by element, others by their joint states, at most 512 (`bmc.log_density`).
        Labels and numbers that cling to each other mix so. Without it they are drawn in turn.
    reparametrize : bool
        Whether effects (``Normal``, ``StudentT``, ``Laplace``, ``Cauchy`` or ``MvNormal`` nodes of several
        numbers) are moved apart from their location and scale where these move, too, as far as suits each:
        the warmup learns it from its draws. Without it trajectories follow the numbers as they are declared,
        and a scale that the data say little of makes a funnel of them. The answer is in the nodes' own
        numbers either way.
    metric : "auto", "diagonal" or "dense"
        Whether scales of all numbers are learnt, or their correlations, too. Dense up to 200 numbers where
        it is left open: by the draws and the gradients there correlations are learnt fast, and more numbers
        make each step dearer.
    threads : int
        Threads that share the chains where trajectories are machine code; the answer is the same.
    debug : bool
        Compare machine code with NumPy after every trajectory: an error says what differs.
    ess : float
        Effective size that every number of the answer is to have where ``draws`` is left out.
    start : dict, optional
        Node -> where its chains start, as for `Gibbs`.
    groups : int, optional
        Groups of chains that run apart, as for `Gibbs`.

    Notes
    -----
    The posterior has ``divergences``, shape (chain, draw): draws whose trajectory left the level set that
    it should follow, as it does where the density bends more sharply than elsewhere. A run warns where they
    are more than chance, and names the numbers near which they are; so it does of trajectories that were
    cut short, and of energies that momenta hardly change.

    References
    ----------
    Hoffman and Gelman (2014), JMLR 15; Betancourt (2017), A conceptual introduction to Hamiltonian Monte
    Carlo, arXiv 1701.02434, appendix A; Stan Reference Manual, version 2.36, chapter "MCMC Sampling";
    Gorinova, Moore and Hoffman (2020), Automatic reparameterisation of probabilistic programs, ICML.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> dose = np.array([-0.86, -0.3, -0.05, 0.73])
    >>> net = bmc.BayesNet(plates={"group": 4})
    >>> net.add("a", bmc.Normal(0.0, 2.0))
    >>> net.add("b", bmc.Normal(0.0, 10.0))
    >>> net.add("dead", lambda a, b: bmc.Binomial(5, logits=a + b * dose), plates="group")
    >>> posterior = bmc.infer(net, {"dead": [0, 1, 3, 5]}, engine=bmc.HamiltonianMonteCarlo(), rng=0)
    >>> bool(abs(posterior.mean("b") - 8.4) < 0.6), int(posterior.divergences.sum())
    (True, 0)
    """

    draws: int | None = None
    warmup: int | None = None
    chains: int | None = None
    thinning: int = 1
    target_accept: float = 0.8
    max_depth: int = 10
    marginalize: bool = False
    reparametrize: bool = True
    metric: Metric = "auto"
    threads: int = field(default=1, compare=False)
    debug: bool = False
    ess: float = 1000
    start: Mapping[str, Any] | None = field(default=None, compare=False, repr=False)
    groups: int | None = None

    label: ClassVar[str] = "Hamiltonian Monte Carlo"
    judges: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count(self, "max_depth", self.max_depth, "10")
        check_count(self, "threads", self.threads, "2")
        what = type(self).__name__
        if not isinstance(self.target_accept, (int, float)) or not 0 < self.target_accept < 1:
            raise ValueError(
                f"{what}(target_accept={self.target_accept!r}): target_accept is a share between 0 and "
                "1, such as 0.8"
            )
        for name in ("marginalize", "reparametrize"):
            value = getattr(self, name)
            if not isinstance(value, bool):
                raise ValueError(f"{what}({name}={value!r}): {name} is True or False")
        if self.metric not in get_args(Metric):
            raise ValueError(
                f'{what}(metric={self.metric!r}): metric is "auto", "diagonal" or "dense"'
            )

    def refusal(self, problem: Problem) -> str | None:
        return refused(
            problem,
            type(self).__name__,
            "follows gradients, and this net has none",
            self._fits,
            takes_parts=True,
        )

    def describe(self, problem: Problem) -> dict[str, str]:
        return {row.node: str(row) for row in self.table(problem)}

    def table(self, problem: Problem) -> list[Treatment]:
        return self._plan(problem).table()

    def effort(self, problem: Problem) -> str:
        lengths, moving = self.lengths(problem), self._moving(problem)
        text = super().effort(problem)
        if not moving:
            return text
        density = density_of(problem, moving, self.summed(problem))
        told = in_machine_code(density, GRADIENTS * lengths.warmup, lengths.chains).told
        return f"{text}; {told}" if told else text

    def tied(self, problem: Problem) -> Sequence[str]:
        return self._plan(problem).constraints

    def sampler(self, problem: Problem) -> SweepSampler:
        plan = self._plan(problem)
        sampler = SweepSampler(plan.target, plan.kernels)
        sampler.climbs = True
        return sampler

    def summed(self, problem: Problem) -> tuple[str, ...]:
        """Finite nodes that are summed out."""
        moving = self._moving(problem) if self.marginalize else ()
        return summed_with(problem, moving) if moving else ()

    def _fits(self, problem: Problem) -> str | None:
        """Why it has nothing to move."""
        target = target_of(problem)
        if target.chain and not continuous(target):
            return (
                f"{type(self).__name__} moves continuous nodes, and what observations depend on is finite: "
                f"{', '.join(map(repr, target.chain[:4]))}"
            )
        self._plan(problem)
        return None

    def _moving(self, problem: Problem) -> tuple[str, ...]:
        """Nodes that move along trajectories."""
        names = continuous(target_of(problem))
        jump = jumping(problem, density_of(problem, names)) if names else ()
        return tuple(n for n in names if n not in jump)

    def _plan(self, problem: Problem) -> Plan:
        """Kernels of what is finite, and one for all that is continuous."""
        note_start(problem, self.start)
        target = target_of(problem)
        moving = self._moving(problem)
        summed = self.summed(problem)
        rest = [n for n in target.chain if n not in (*moving, *summed)]
        plan = plan_of(problem, only=rest)
        if not moving:
            return plan
        density = density_of(problem, moving, summed)
        kernel = (SummedOut if summed else Hamiltonian)(
            density,
            density.others,
            warmup=self.warmup,
            target_accept=self.target_accept,
            max_depth=self.max_depth,
            metric=self.metric,
            reparametrize=self.reparametrize,
            match=f"with all {density.size} free numbers, {fitting(self.metric, density.size)} metric",
            threads=self.threads,
            debug=self.debug,
        )
        blankets = {n: plan.blankets.get(n) or Blanket(target, n) for n in target.chain}
        kernels = [*plan.kernels, kernel, *rescaled_kernels(target, moving, _RESCALED)]
        kernels += redrawn_kernels(target, blankets, kernels) if rest else []
        jump = dict.fromkeys((n for n in rest if n in continuous(target)), _JUMPS)
        refusals = {**plan.refusals, **jump}
        return replace(plan, kernels=kernels, blankets=blankets, refusals=refusals)
