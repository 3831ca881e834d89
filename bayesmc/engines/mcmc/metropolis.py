"""Metropolis-Hastings on any net: the user's proposals, and adaptive moves for all other nodes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np

from bayesmc.engines.mcmc.chains import ChainEngine
from bayesmc.engines.mcmc.proposals import RandomWalk, Read, check_given, read_proposals
from bayesmc.engines.mcmc.sweep import SweepSampler, block_name
from bayesmc.engines.weighted.drawing import treatment
from bayesmc.errors import UnsupportedError
from bayesmc.kernels.base import Kernel
from bayesmc.kernels.coupling import deterministic_constraints
from bayesmc.kernels.ensemble import AFRESH, BlockWalk, stragglers
from bayesmc.kernels.jump import Jump
from bayesmc.kernels.proposal import Key, Proposal, names_of
from bayesmc.kernels.proposed import Proposed, ProposedBlock
from bayesmc.kernels.random_walk import AdaptiveWalk, may_be_drawn_anew, parts_of
from bayesmc.kernels.redrawn import Redrawn, redrawn_kernels, waiting
from bayesmc.network import Problem
from bayesmc.network.forward import refuse_noiseless, refuse_parts, refuse_unsampled
from bayesmc.network.sameness import same
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Target, Values, target_of

#: first sweep of the warmup after which stragglers are brought back; later ones follow at twice that, ...
_FIRST_RESCUE = 16
#: chains where none are asked for
_CHAINS = 4
#: numbers beyond which continuous nodes no longer move as one block
LARGEST_BLOCK = 200
#: members of an ensemble, least and most
_LEAST, _MOST = 8, 64
#: numbers that one evaluation of all terms may take, for all members of all ensembles together
_ELEMENTS = 2e7


@dataclass(frozen=True, repr=False)
class MetropolisHastings(ChainEngine):
    """Markov chains that propose a move and accept it by the ratio of densities.

    Nodes with a proposal move by it. All other continuous nodes of the chain move as one block on the
    unconstrained scale: by a random walk whose covariance and scale adapt in the warmup and are then
    frozen, mixed with differential evolution. For the latter every chain is an ensemble of some ten to
    64 members, half of which move given the other half; ensembles are independent, draw t of a chain is
    member t mod their number, and ``ess``, ``mcse`` and ``rhat`` take that into account. Beyond 200
    numbers each node walks by itself. Other discrete nodes propose symmetric jumps and draws from their
    own density. Nodes on which nothing observed depends are drawn forward.

    Parameters
    ----------
    draws : int, optional
        Draws kept of every chain; by default as many as it takes to ``ess``, or 4,000 of each chain
        (up to twice that where it is nearly there) and a warning that names the node.
    warmup : int, optional
        Sweeps before that, in which scales and covariances adapt; 1,000 by default.
    chains : int, optional
        Chains, all in one array; 4 by default, as each may be an ensemble.
    proposal : dict, optional
        Node name, or a tuple of names that move as one -> one of

        * a function whose argument names are nodes and which returns the distribution to propose from. It
          receives current values, that of the node itself among them if it names it, aligned as at the
          target. A tuple's function, which sees plated nodes as foreign, returns a dict from name to
          distribution, or one vector distribution whose components go to the names in order;
        * ``RandomWalk(scale)``, ``Independence(distribution)``;
        * ``"prior"``: the node's own density given its parents.

        Elements of a plate are accepted one by one where they are independent given the rest, a tuple as a
        whole.
    thinning : int
        Sweeps per kept draw.
    ess : float
        Effective size that every number of the answer is to have where ``draws`` is left out.
    start : dict, optional
        Node -> where its chains start: what broadcasts to ``(*plates, *event)`` for all of them, or to
        ``(chains, *plates, *event)`` for each; labels for states. Nodes that are left out are drawn given
        these. What nothing observed depends on is drawn forward, wherever it starts.
    groups : int, optional
        Groups of chains that run apart, as for `Gibbs`.

    Raises
    ------
    TypeError, ModelError
        Proposals that cannot be any, whatever the net. What does not fit the net or the evidence raises
        when asked, with the proposal's name.

    Notes
    -----
    A finite node's proposal speaks the values of its support (0, 1, ... for a Categorical), as its
    conditional density does. A proposal that does not look at the current value must be able to reach
    whatever the posterior allows; where supports tell that it does not, there is a ``SupportWarning``.

    References
    ----------
    Metropolis et al. (1953), Journal of Chemical Physics 21; Hastings (1970), Biometrika 57; Haario,
    Saksman and Tamminen (2001), Bernoulli 7; ter Braak (2006), Statistics and Computing 16.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.engines.mcmc.metropolis import MetropolisHastings
    >>> net = bmc.BayesNet()
    >>> net.add("x", bmc.Gamma(2.0, 1.0))
    >>> net.add("y", lambda x: bmc.Poisson(x))
    >>> exact = (2.0 + 3) / (1.0 + 1)
    >>> default = bmc.infer(net, {"y": 3}, engine=MetropolisHastings(), rng=0)
    >>> bool(abs(default.mean("x") - exact) < 0.2)
    True
    >>> proposal = {"x": lambda x: bmc.LogNormal(np.log(x), 0.8)}  # not symmetric: corrected
    >>> own = bmc.infer(net, {"y": 3}, engine=MetropolisHastings(proposal=proposal), rng=0)
    >>> bool(abs(own.mean("x") - exact) < 0.2)
    True
    """

    draws: int | None = None
    warmup: int | None = None
    chains: int | None = None
    proposal: Mapping[Any, Any] | None = field(default=None, hash=False)
    thinning: int = 1
    ess: float = 1000
    start: Mapping[str, Any] | None = field(default=None, compare=False, repr=False)
    groups: int | None = None

    label: ClassVar[str] = "Metropolis-Hastings"
    ensembles: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        checked = MappingProxyType(check_given(self.proposal))
        object.__setattr__(self, "proposal", checked)

    def refusal(self, problem: Problem) -> str | None:
        parts = refuse_parts(problem.observed, "MetropolisHastings")
        if parts is not None:
            return parts
        plan = self._plan(problem)
        terms = [n for n in plan.target.terms if n in problem.model.nodes]
        return plan.refusal or refuse_noiseless(problem.model, terms, "MetropolisHastings")

    def describe(self, problem: Problem) -> dict[str, str]:
        return self._plan(problem).describe()

    def sampler(self, problem: Problem) -> MetropolisSampler:
        return MetropolisSampler(self._plan(problem), self.warmup or 0, self.thinning)

    def tied(self, problem: Problem) -> Sequence[str]:
        jointly = {n for key in self._given if isinstance(key, tuple) for n in key}
        found = deterministic_constraints(self._plan(problem).target, ())
        return [n for n in found if n not in jointly]

    def continues(self, other: Any) -> bool:
        if type(other) is not type(self) or list(other._given) != list(self._given):
            return False
        options = ("warmup", "chains", "thinning")
        if any(getattr(self, o) != getattr(other, o) for o in options):
            return False
        # a pickle has lost its functions
        return all(old is None or same(old, self._given[k]) for k, old in other._given.items())

    def _plan(self, problem: Problem) -> Plan:
        if any(spec is None for spec in self._given.values()):
            raise UnsupportedError(
                "MetropolisHastings: this engine is a pickle's or a file's, which hold no functions; give it "
                "anew"
            )
        return plan_of(problem, self._given, self.chains or _CHAINS)

    @property
    def _given(self) -> Mapping[Any, Any]:
        assert self.proposal is not None
        return self.proposal

    def __getstate__(self) -> dict[str, Any]:
        """Pickles travel without the proposals' functions."""
        kept = {k: v if isinstance(v, (str, RandomWalk)) else None for k, v in self._given.items()}
        return {**self.__dict__, "proposal": kept}

    def __copy__(self) -> MetropolisHastings:
        return self

    def __deepcopy__(self, memo: Any) -> MetropolisHastings:
        return self

    def __repr__(self) -> str:
        said = {"draws": self.draws, "warmup": self.warmup, "chains": self.chains}
        options = [f"{n}={v}" for n, v in said.items() if v is not None]
        if self._given:
            shown = (
                f"{k!r}: {v!r}" if isinstance(v, (str, RandomWalk)) else f"{k!r}: ..."
                for k, v in self._given.items()
            )
            options.append(f"proposal={{{', '.join(shown)}}}")
        if self.thinning != 1:
            options.append(f"thinning={self.thinning}")
        if self.draws is None:
            options.append(f"ess={self.ess:g}")
        return f"MetropolisHastings({', '.join(options)})"


class MetropolisSampler(SweepSampler):
    """Sweeps of ensembles; rows of the state are their members, those of a chain one after the other.

    Parameters
    ----------
    plan : Plan
    warmup, thinning : int
        Sweeps of the warmup, and per draw.
    """

    def __init__(self, plan: Plan, warmup: int = 0, thinning: int = 1) -> None:
        super().__init__(plan.target, plan.kernels)
        self.ensemble = plan.ensemble
        self.warmup, self.thinning = warmup, thinning
        bands = {block_name(k): _band(k) for k in self.kernels}
        self.acceptance_band = bands

    def start(self, rng: np.random.Generator, chains: int) -> dict[str, Any]:
        return {**self._started(rng, chains, chains * self.ensemble), "sweep": 0}

    def step(self, state: Mapping[str, Any], rng: np.random.Generator, warmup: bool) -> Any:
        sweep = state["sweep"] + 1
        found = {**super().step(state, rng, warmup), "sweep": sweep}
        if warmup and self.ensemble > 1 and self._is_rescue(sweep):
            return self._rescued(found, rng)
        return found

    def end_warmup(self, state: Mapping[str, Any]) -> Any:
        return {**super().end_warmup(state), "sweep": 0}

    def values(self, state: Mapping[str, Any], rng: np.random.Generator) -> Values:
        member = (state["sweep"] // self.thinning - 1) % self.ensemble
        now = {n: v[member :: self.ensemble] for n, v in state["values"].items()}
        return self.completed(now, state["chains"], rng)

    def acceptance(self, state: Mapping[str, Any]) -> dict[str, np.ndarray]:
        rates = super().acceptance(state)
        return {n: r.reshape(-1, self.ensemble).mean(axis=1) for n, r in rates.items()}

    def _is_rescue(self, sweep: int) -> bool:
        """Whether stragglers are brought back: at some sweeps in the first half of the warmup."""
        times, rest = divmod(sweep, _FIRST_RESCUE)
        return rest == 0 and times & (times - 1) == 0 and 2 * sweep <= self.warmup

    def _rescued(self, state: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
        """The state with members that never found the mass replaced by copies of others of their ensemble.

        Vague priors start some members so far out that they would walk all warmup long.
        """
        log = self.target.log_density({**self.target.known, **state["values"]})
        log = np.asarray(log).reshape(-1, self.ensemble)
        lost = stragglers(log)
        if not lost.any():
            return state
        members = np.arange(log.size).reshape(log.shape)
        rows = members.copy()
        for chain in np.flatnonzero(lost.any(axis=1)):
            others = members[chain][~lost[chain]]
            rows[chain][lost[chain]] = rng.choice(others, size=int(lost[chain].sum()))
        flat = rows.ravel()
        memory = [
            k.replaced(m, flat) if isinstance(k, BlockWalk) else m
            for k, m in zip(self.kernels, state["memory"], strict=True)
        ]
        values = {n: v[flat] for n, v in state["values"].items()}
        return {**state, "values": values, "memory": memory}


@dataclass(frozen=True, eq=False)
class Plan:
    """The kernels of a sweep.

    Attributes
    ----------
    kernels : list of Kernel
        In the order of a sweep.
    ensemble : int
        Members of the ensemble that each chain is; 1 where chains are ordinary.
    refusal : str or None
        Why the engine cannot answer.
    """

    problem: Problem
    target: Target
    kernels: list[Kernel] = field(default_factory=list)
    ensemble: int = 1
    refusal: str | None = None

    def describe(self) -> dict[str, str]:
        """What happens to each node."""
        found = {n: treatment(self.problem, n) for n in self.problem.model.nodes}
        for name in self.target.forward:
            if self.problem.model[name].is_stochastic and self.target.seen(name) is None:
                found[name] = "drawn forward: nothing observed depends on it"
        for kernel in self.kernels:
            if isinstance(kernel, Redrawn):
                found[kernel.names[0]] += f", then {kernel.label} {kernel.match}"
                continue
            for name in kernel.names:
                others = ", ".join(repr(n) for n in kernel.names if n != name)
                how = f"{kernel.label}: {kernel.match}" if kernel.match else kernel.label
                found[name] = how + (f", together with {others}" if others else "")
        return found


def plan_of(problem: Problem, proposal: Mapping[Key, Any], chains: int) -> Plan:
    """The plan for a posed problem.

    Raises
    ------
    UnknownNodeError, EvidenceError, ModelError
        A proposal that does not fit the net or the evidence.
    """
    read = read_proposals(problem, proposal)
    target = target_of(problem, _inside(problem, read))
    refusal = refuse_unsampled(
        problem.model,
        {*problem.observed, *target.chain},
        "MetropolisHastings",
    )
    given = {n for key in read for n in names_of(key)}
    kernels = [_asked_for(target, key, what) for key, what in read.items()]
    rest = [n for n in target.chain if n not in given]
    discrete = [n for n in rest if problem.model[n].is_discrete]
    continuous = [n for n in rest if not problem.model[n].is_discrete]
    kernels += [Jump(Blanket(target, n)) for n in reversed(discrete)]
    ensemble = 1
    if continuous:
        size = parts_of(target, continuous)[-1].stop
        if size > LARGEST_BLOCK:
            why = f"{size} continuous numbers are too many to move as one"
            kernels += [AdaptiveWalk(Blanket(target, n), why) for n in reversed(continuous)]
        else:
            ensemble = _members(target, size, chains)
            anew = AFRESH if may_be_drawn_anew(target, continuous) else 0.0
            kernels.append(BlockWalk(target, continuous, ensemble, alone=not kernels, anew=anew))
    if waiting(target):  # blankets of all nodes are not made for nothing
        kernels += redrawn_kernels(target, {n: Blanket(target, n) for n in rest}, kernels)
    return Plan(problem, target, kernels, ensemble, refusal)


# ---- private ------------------------------------------------------------------------------------


def _band(kernel: Kernel) -> tuple[float, float] | None:
    """Acceptance rates that tell of a useful move; None where any is."""
    if isinstance(kernel, (Jump, Proposed, ProposedBlock)):
        return (0.01, 1.0)
    return (0.1, 0.9)


def _inside(problem: Problem, read: Mapping[Key, Read]) -> list[str]:
    """Nodes of the chain whether or not anything observed depends on them.

    These are nodes with proposals, those that proposals look at, and those that cannot be drawn forward.
    """
    found: list[str] = []
    for key, what in read.items():
        found += names_of(key)
        if isinstance(what, Proposal):
            found += what.parents
    found += [n for n, node in problem.model.nodes.items() if node.is_stochastic and node.unsampled]
    return list(dict.fromkeys(found))


def _asked_for(target: Target, key: Key, what: Read) -> Kernel:
    """The kernel of a proposal."""
    if isinstance(what, RandomWalk):
        if isinstance(key, tuple):
            scale = what.scale if what.scale.ndim else float(what.scale)
            return BlockWalk(
                target,
                key,
                scale=scale,
                unconstrained=what.unconstrained,
                adaptive=what.adaptive,
            )
        blanket = Blanket(target, key)
        if blanket.node.is_discrete:
            return Jump(blanket, int(what.scale.flat[0]))
        return AdaptiveWalk(
            blanket,
            scale=what.scale,
            unconstrained=what.unconstrained,
            adaptive=what.adaptive,
        )
    if isinstance(key, tuple):
        return ProposedBlock(target, key, what)
    return Proposed(Blanket(target, key), what)


def _members(target: Target, size: int, chains: int) -> int:
    """Members of an ensemble for a block of so many numbers; 1 where they would take too much memory."""
    wanted = min(max(2 * (size + 1), _LEAST), _MOST)
    elements = sum(max(math.prod(term.shape), 1) for term in target.terms.values())
    affordable = int(_ELEMENTS / (elements * chains)) // 2 * 2
    return min(wanted, affordable) if affordable >= 4 else 1
