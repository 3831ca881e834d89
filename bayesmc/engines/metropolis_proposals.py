"""Proposals of Metropolis-Hastings, as a user writes them and as they are read.

A proposal is read like a node: its argument names are what it depends on, aligned as for its target; here
they may be the target itself, and any other current value. How it moves a chain is the kernels' affair.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions import as_distribution
from bayesmc.errors import EvidenceError, ModelError, UnknownNodeError
from bayesmc.kernels.proposal import Conditional, Parts
from bayesmc.kernels.random_walk import some_support
from bayesmc.network import Model, Problem
from bayesmc.network.align import Aligner
from bayesmc.network.node import Declaration, bind
from bayesmc.network.store import unknown

#: a node's name, or several that move as one
Key = str | tuple[str, ...]


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
    >>> from bayesmc.engines.metropolis import MetropolisHastings
    >>> from bayesmc.engines.metropolis_proposals import RandomWalk
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
    >>> from bayesmc.engines.metropolis import MetropolisHastings
    >>> from bayesmc.engines.metropolis_proposals import Independence
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
Read = Conditional | RandomWalk | None


def check_specification(proposal: Any) -> dict[Key, Any]:
    """A copy of what a user gave as proposals, refused where it cannot be one whatever the net."""
    if proposal is None:
        return {}
    if not isinstance(proposal, Mapping):
        raise TypeError(
            f"MetropolisHastings(proposal={proposal!r}): give a dict from node name to a function of named "
            "nodes that returns a distribution, RandomWalk(scale), Independence(distribution) or 'prior'"
        )
    seen: set[str] = set()
    for key, given in proposal.items():
        names = (key,) if isinstance(key, str) else key
        if not isinstance(names, tuple) or not names or not all(isinstance(n, str) for n in names):
            raise TypeError(
                f"MetropolisHastings: the key {key!r} of proposal= is no node name; give a name, or a "
                "tuple of names that move as one"
            )
        for name in names:
            if name in seen:
                raise ModelError(
                    f"MetropolisHastings: {name!r} has two proposals; every node is moved by one, so keep "
                    "one of them"
                )
            seen.add(name)
        if not _is_named(given):
            _as_function(key, given)
    return dict(proposal)


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


def _as_function(key: Key, given: Any) -> Callable[..., Any]:
    """The function of a proposal; a distribution (for a block, also a dict of them) is a constant one."""
    spec = given.distribution if isinstance(given, Independence) else given
    if isinstance(key, tuple) and isinstance(spec, Mapping):
        return lambda: spec
    distribution = as_distribution(spec)
    if distribution is not None:
        return lambda: distribution
    if not callable(spec) or isinstance(spec, type):
        raise TypeError(
            f"MetropolisHastings: the proposal for {key!r} is {spec!r}; give a function of named nodes that "
            "returns a distribution, RandomWalk(scale), Independence(distribution) or 'prior'"
        )
    return spec


def _read(problem: Problem, key: Key, given: Any) -> Read:
    names = key if isinstance(key, tuple) else (key,)
    what = f"MetropolisHastings: proposal for {key!r}"
    for name in names:
        _check_target(problem, name, what)
    if isinstance(given, RandomWalk):
        _check_walk(problem.model, key, given, what)
        return given
    if isinstance(given, str):
        _check_own(problem.model, names, what)
        return None
    return _conditional(problem.model, key, given, what)


def _conditional(model: Model, key: Key, given: Any, what: str) -> Conditional:
    """A user's function, bound to the nodes that it names."""
    names = key if isinstance(key, tuple) else (key,)
    function = _as_function(key, given)
    _check_signature(function, what)
    parents, bound = bind(what, function, None)
    for parent in parents:
        if parent not in model.nodes:
            raise UnknownNodeError(
                f"{what}: its argument {parent!r} is no node ({_unknown(model, parent)}); for a constant use "
                f"a default, {parent}={parent}"
            )
        if isinstance(given, Independence) and parent in names:
            raise ModelError(
                f"{what}: an Independence proposal names {parent!r}, which it is to propose; give the "
                "function itself, without Independence"
            )
    plates: tuple[str, ...] = ()
    if isinstance(key, tuple):
        bound = _jointly(bound, names)
    else:
        plates = model[key].plates
    label = key if isinstance(key, str) else ", ".join(key)
    declaration = Declaration(label, "function", parents, plates, function=bound)
    links = tuple(
        (p, Aligner(plates, model[p].plates, len(model[p].event_shape), model[p].domain))
        for p in parents
    )
    return Conditional(key, names, declaration, links)


def _check_target(problem: Problem, name: str, what: str) -> None:
    node = problem.model.nodes.get(name)
    if node is None:
        raise UnknownNodeError(f"{what}: {_unknown(problem.model, name)}")
    if node.kind != "stochastic":
        kind = {"fixed": "fixed by do()", "input": "an input"}.get(node.kind, "deterministic")
        raise ModelError(f"{what}: {name!r} is {kind} and never moves; propose a stochastic node")
    seen = problem.observed.get(name)
    if seen is not None and seen.mask is None:
        raise EvidenceError(
            f"{what}: {name!r} is observed, so there is nothing to move; leave out the proposal or the "
            "evidence"
        )


def _check_walk(model: Model, key: Key, walk: RandomWalk, what: str) -> None:
    """Refuse a random walk on values that have no such steps."""
    names = key if isinstance(key, tuple) else (key,)
    for name in names:
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
        elif support.kind in ("simplex", "positive definite") and not walk.unconstrained:
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


def _check_signature(function: Callable[..., Any], what: str) -> None:
    """Argument names are all that says what a proposal depends on, so they must be readable."""
    try:
        arguments = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        raise ModelError(
            f"{what}: the arguments of {function!r} cannot be read; wrap it in a function whose arguments "
            "are the nodes it needs"
        ) from None
    for argument in arguments:
        if argument.kind in (argument.VAR_POSITIONAL, argument.VAR_KEYWORD):
            raise ModelError(
                f"{what}: *{argument.name} is refused, since argument names say what a proposal depends on; "
                "name the nodes"
            )


def _unknown(model: Model, name: str) -> str:
    return unknown({n: c.declaration for n, c in model.nodes.items()}, name)


def _jointly(function: Callable[..., Any], names: tuple[str, ...]) -> Callable[..., Any]:
    """A block's function, with a dict of distributions in one piece."""

    def joint(*arguments: Any) -> Any:
        result = function(*arguments)
        if not isinstance(result, Mapping):
            return result
        if set(result) != set(names):
            raise ModelError(
                f"the function returns distributions for {sorted(map(str, result))}, but the block is "
                f"{list(names)}; give one for each"
            )
        parts = {}
        for name, part in result.items():
            parts[name] = as_distribution(part)
            if parts[name] is None:
                raise ModelError(
                    f"the function returns {type(part).__name__} for {name!r}; return a distribution"
                )
        return Parts(parts)  # type: ignore[arg-type]

    return joint
