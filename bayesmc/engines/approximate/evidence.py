"""What of the evidence no hidden node changes, and what of it has no density that could be followed."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import UnsupportedError, ZeroProbabilityError
from bayesmc.network import Problem
from bayesmc.network.forward import refuse_noiseless, refuse_parts
from bayesmc.network.model import potential_shape
from bayesmc.structure.target import Target, Term


def log_constants(target: Target) -> float:
    """The log of all factors of what was observed whose values are known.

    Raises
    ------
    ZeroProbabilityError
        One is impossible, whatever the hidden nodes are.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.engines.approximate.evidence import log_constants
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet()
    >>> net.add("coin", bmc.Bernoulli(0.25))
    >>> net.add("rate", bmc.Gamma(2.0, 1.0))
    >>> net.add("count", lambda rate: bmc.Poisson(rate))
    >>> round(log_constants(target_of(pose(net, {"coin": 1, "count": 3}))), 4)  # log 0.25
    -1.3863
    """
    total = 0.0
    for term in _left(target):
        with marking_invalid(), np.errstate(all="ignore"):
            log = np.broadcast_to(term.log(target.known), term.shape)
        if not (log > -np.inf).all():
            what = "potential" if term.is_potential else "node"
            raise ZeroProbabilityError(
                f"{what} {term.name!r} has probability zero whatever hidden nodes are; check that evidence"
            )
        total += float(log.sum())
    return total


def why_not(problem: Problem, name: str, target: Callable[[], Target]) -> str | None:
    """Why an engine of that name takes no such evidence: vectors seen in part, no noise, or no target."""
    reason = refuse_parts(problem.observed, name)
    if reason is not None:
        return reason
    try:
        terms = [n for n in target().terms if n in problem.model.nodes]
    except UnsupportedError as error:
        return str(error)
    return refuse_noiseless(problem.model, terms, name)


# ---- private ------------------------------------------------------------------------------------


def _left(target: Target) -> Iterator[Term]:
    model = target.model
    for name, seen in target.observed.items():
        node = model[name]
        if name in target.terms or not node.is_stochastic or name in target.chain:
            continue
        if 0 in node.plate_shape:
            continue
        if node.declaration.source != "variable":
            yield Term(model, name, node.plates, node.plate_shape, node.parents, mask=seen.mask)
    for name, (potential, _) in model.potentials.items():
        if name not in target.terms:
            shape = potential_shape(model.sizes, potential)
            yield Term(model, name, potential.plates, shape, potential.parents, True)
