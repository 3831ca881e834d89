"""Proposals of Metropolis-Hastings: functions, which may name any current value, their target's too, and
those that have a name. How they move a chain is the kernels' affair.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.engines.proposal import (
    FUNCTION,
    as_function,
    bound,
    check_specification,
    check_targets,
)
from bayesmc.errors import ModelError
from bayesmc.kernels.proposal import Key, Proposal, names_of
from bayesmc.kernels.random_walk import some_support
from bayesmc.network import Model, Problem


@dataclass(frozen=True, eq=False, repr=False)
class RandomWalk:
    """A proposal of `MetropolisHastings`: the current value plus a Gaussian step.

    Parameters
    ----------
    scale : float or array_like
        Standard deviation of the step. For one node it broadcasts to its shape, plates first; for a
        tuple of nodes it is one number, or one for each of their components in order. For a discrete
        node it is the largest jump, up or down.
    unconstrained : bool
        Step on the unconstrained scale of the node's support (log, logit, ...), with the Jacobian in
        the acceptance ratio. By default steps are on the node's own scale, and one that leaves the
        support is rejected.
    adaptive : bool
        Let size and shape of the steps adapt in the warmup, from ``scale`` on.

    References
    ----------
    Metropolis et al. (1953), Journal of Chemical Physics 21.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.engines.mcmc.metropolis import MetropolisHastings
    >>> from bayesmc.engines.mcmc.proposals import RandomWalk
    >>> net = bmc.BayesNet()
    >>> net.add("x", bmc.Normal(0.0, 1.0))
    >>> net.add("y", lambda x: bmc.Normal(x, 1.0))
    >>> engine = MetropolisHastings(2000, proposal={"x": RandomWalk(1.5)})
    >>> posterior = bmc.infer(net, {"y": 2.0}, engine=engine, rng=0)
    >>> bool(abs(posterior.mean("x") - 1.0) < 0.1)
    True
    """

    scale: Any
    unconstrained: bool = False
    adaptive: bool = False

    def __post_init__(self) -> None:
        try:
            scale = np.array(self.scale, dtype=float)
        except (TypeError, ValueError):
            scale = np.array(np.nan)
        if not (np.isfinite(scale) & (scale > 0)).all():
            raise ValueError(
                f"RandomWalk(scale={self.scale!r}): the scale is a positive number, or an array of them"
            )
        scale.flags.writeable = False
        object.__setattr__(self, "scale", scale)

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, RandomWalk)
            and np.array_equal(self.scale, other.scale)
            and self.unconstrained == other.unconstrained
            and self.adaptive == other.adaptive
        )

    def __hash__(self) -> int:
        return hash((self.scale.tobytes(), self.unconstrained, self.adaptive))

    def __repr__(self) -> str:
        more = ", unconstrained=True" if self.unconstrained else ""
        more += ", adaptive=True" if self.adaptive else ""
        return f"RandomWalk({self.scale.tolist()}{more})"


@dataclass(frozen=True)
class Independence:
    """A proposal of `MetropolisHastings` that does not look at the current value of its target.

    Parameters
    ----------
    distribution : Distribution or callable
        What to propose from: a distribution, or a function of other nodes that returns one. It must
        reach whatever the posterior allows; heavier tails than the posterior's are safe.

    References
    ----------
    Tierney (1994), Annals of Statistics 22.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.engines.mcmc.metropolis import MetropolisHastings
    >>> from bayesmc.engines.mcmc.proposals import Independence
    >>> net = bmc.BayesNet()
    >>> net.add("x", bmc.Normal(0.0, 1.0))
    >>> net.add("y", lambda x: bmc.Normal(x, 1.0))
    >>> proposal = {"x": Independence(lambda y: bmc.StudentT(5.0, y / 2, 1.0))}
    >>> engine = MetropolisHastings(proposal=proposal)
    >>> posterior = bmc.infer(net, {"y": 2.0}, engine=engine, rng=0)
    >>> bool(abs(posterior.mean("x") - 1.0) < 0.1)
    True
    """

    distribution: Any


#: what a proposal is read as: a function, a walk, or None for the nodes' own densities
Read = Proposal | RandomWalk | None

_ENGINE = "MetropolisHastings"
_ACCEPTED = f"{FUNCTION}, RandomWalk(scale), Independence(distribution) or 'prior'"


def check_given(proposal: Any) -> dict[Key, Any]:
    """A copy of what a user gave as proposals, refused where it cannot be one whatever the net."""
    given = check_specification(_ENGINE, {} if proposal is None else proposal, _ACCEPTED)
    for key, spec in given.items():
        if not _is_named(spec):
            as_function(_ENGINE, key, _plain(spec), _ACCEPTED)
    return given


def read_proposals(problem: Problem, specification: Mapping[Key, Any]) -> dict[Key, Read]:
    """Proposals read against a problem; every fault names the proposal.

    Raises
    ------
    UnknownNodeError, EvidenceError, ModelError
        A target or an argument that cannot be one, or a walk that cannot be on such a node.
    """
    return {key: _read(problem, key, given) for key, given in specification.items()}


# ---- private ------------------------------------------------------------------------------------


def _is_named(given: Any) -> bool:
    return isinstance(given, RandomWalk) or (isinstance(given, str) and given == "prior")


def _plain(given: Any) -> Any:
    return given.distribution if isinstance(given, Independence) else given


def _read(problem: Problem, key: Key, given: Any) -> Read:
    check_targets(_ENGINE, problem, key)
    what = f"{_ENGINE}: proposal for {key!r}"
    if isinstance(given, RandomWalk):
        _check_walk(problem.model, key, given, what)
        return given
    if isinstance(given, str):
        _check_own(problem.model, names_of(key), what)
        return None
    function = as_function(_ENGINE, key, _plain(given), _ACCEPTED)
    proposal = bound(_ENGINE, problem.model, key, function)
    if isinstance(given, Independence) and not proposal.is_independent:
        own = next(p for p in proposal.parents if p in proposal.names)
        raise ModelError(
            f"{what}: an Independence proposal names {own!r}, which it is to propose; give the function "
            "itself, without Independence"
        )
    return proposal


def _check_walk(model: Model, key: Key, walk: RandomWalk, what: str) -> None:
    """Refuse a random walk on values that have no such steps."""
    for name in names_of(key):
        node, support = model[name], some_support(model, name)
        if node.is_discrete:
            labelled = node.domain is not None and node.domain.labels is not None
            if isinstance(key, tuple) or walk.unconstrained or labelled:
                why = "has states without an order" if labelled else "is discrete"
                raise ModelError(
                    f"{what}: {name!r} {why}, and a Gaussian step leads nowhere; give a function or 'prior', "
                    "or leave it to the default"
                )
            if walk.scale.size != 1 or walk.scale.flat[0] < 1 or walk.adaptive:
                raise ModelError(
                    f"{what}: {name!r} is discrete, so the scale is one number, the largest jump, 1 or more, "
                    "and does not adapt; for jumps that adapt leave it to the default"
                )
        elif (
            support.kind in ("simplex", "positive definite", "correlation")
            and not walk.unconstrained
        ):
            raise ModelError(
                f"{what}: {name!r} takes {support.describe()}, and a step on that scale leaves them; "
                "use RandomWalk(scale, unconstrained=True)"
            )


def _check_own(model: Model, names: tuple[str, ...], what: str) -> None:
    for name in names:
        if model[name].declaration.source == "variable":
            raise ModelError(
                f"{what}: {name!r} is a variable of a factor graph and has no density of its own to propose "
                "from; give a function or RandomWalk(scale)"
            )
        if model[name].unsampled:
            raise ModelError(
                f"{what}: {name!r} is a Density without sample=, so it cannot be proposed from; give one, or "
                "a function or RandomWalk(scale)"
            )
