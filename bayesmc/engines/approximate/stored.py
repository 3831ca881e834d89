"""Draws of an approximation as draws of all nodes: completed by the net, and as a posterior holds them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.approximate.approximation import Drawn
from bayesmc.engines.forward import fast_steps
from bayesmc.errors import UnsupportedError
from bayesmc.network import Problem
from bayesmc.network.forward import Pass, run
from bayesmc.structure.target import Values, target_of


def completed(
    problem: Problem, names: Sequence[str], drawn: Drawn, rng: np.random.Generator
) -> Values:
    """Stored values of all nodes: what is known, what was drawn, and what follows from these."""
    target = target_of(problem, names)
    bare = replace(problem.model, potentials={})  # none reads what is drawn forward
    steps = fast_steps(bare, problem.observed, problem.inputs)
    by_name = dict(zip(bare.nodes, steps, strict=True))
    known: Values = {**target.known, **drawn.values}
    with marking_invalid(), np.errstate(all="ignore"):
        target.compute(known, target.links)
        forward = [by_name[n] for n in target.forward]
        batch = (len(drawn.log_density),)
        return run(forward, Pass(rng, batch, known)).values if forward else known


def as_stored(problem: Problem, values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Values of all nodes but inputs as a posterior of one chain holds them."""
    stored = {}
    for name, node in problem.model.nodes.items():
        if node.kind == "input":
            continue
        if name not in values:
            raise UnsupportedError(f"node {name!r} has no value in the draws of the approximation")
        value = np.asarray(values[name])
        lead = value.ndim - len(node.value_shape)
        stored[name] = value[None] if lead else value[None, None]
        stored[name].flags.writeable = False
    return stored
