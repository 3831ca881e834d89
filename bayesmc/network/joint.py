"""The joint distribution of a whole net: its log density at complete values, and draws from it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BayesmcError, EvidenceError, UnsupportedError
from bayesmc.network import forward
from bayesmc.network.evidence import store
from bayesmc.network.labels import by_label
from bayesmc.network.model import CompiledNode, Model, invalid_error


def joint_log_prob(
    model: Model, values: Mapping[str, Any], inputs: Mapping[str, np.ndarray]
) -> np.ndarray:
    """Joint log density at complete user values, shape their batch; see ``BayesNet.log_prob``."""
    stored = dict(inputs)
    total: Any = np.zeros(())
    with marking_invalid(), np.errstate(all="ignore"):
        for name, node in model.nodes.items():
            if node.kind == "input":
                continue
            if not node.is_stochastic:
                stored[name], _ = model.evaluate(name, stored)
                if name in values:
                    total = total + _agreement(node, stored[name], values[name])
                continue
            if name not in values:
                raise EvidenceError(
                    f"log_prob: node {name!r} has no value; give all stochastic nodes"
                )
            ahead = max(np.ndim(values[name]) - len(node.value_shape), 0)
            stored_value = store(
                node,
                by_label(f"log_prob: {name!r}", values[name], node.plates, model.labels, ahead),
            )
            try:
                total = total + node_log_prob(model, name, stored_value, stored, total)
            except ValueError as error:
                if isinstance(error, BayesmcError):
                    raise
                batch = stored_value.shape[: stored_value.ndim - len(node.value_shape)]
                raise EvidenceError(
                    f"log_prob: the values of {name!r} have batch shape {batch}, which does not broadcast "
                    "with that of the nodes before it"
                ) from error
            stored[name] = stored_value
        for name in model.potentials:
            total = total + model.potential(name, stored)
    return total


def joint_sample(
    model: Model, draws: int, rng: np.random.Generator, inputs: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Ancestral draws of every node as user values; see ``BayesNet.sample``."""
    if model.potentials:
        raise UnsupportedError(
            f"sample: the potential {next(iter(model.potentials))!r} reweights the joint density, which "
            "ancestral sampling cannot follow; use infer with LikelihoodWeighting and resample"
        )
    refusal = forward.refuse_unsampled(model, (), "sample")
    if refusal:
        raise UnsupportedError(refusal)
    with marking_invalid(), np.errstate(all="ignore"):
        start = forward.Pass(rng, (draws,), dict(inputs))
        values = forward.run(forward.steps_for(model, {}), start).values
    return {
        name: _full(node.decode(values[name]), (draws, *node.value_shape))
        for name, node in model.nodes.items()
    }


def node_log_prob(
    model: Model, name: str, value: np.ndarray, stored: Mapping[str, np.ndarray], total: Any
) -> np.ndarray:
    """Log density of one node's values given its parents', summed over its plates."""
    node = model[name]
    result, batch = model.evaluate(name, stored)
    axes = tuple(range(-len(node.plates), 0))
    if result.invalid is not None:
        counts = np.broadcast_to(
            np.asarray(total) > -np.inf, np.broadcast_shapes(np.shape(total), batch)
        )
        error = invalid_error(node, result, counts, counts.shape)
        if error is not None:
            raise error
    density = model.log_density(name, result, value)
    if axes:
        lead = density.shape[: max(density.ndim - len(axes), 0)]
        density = np.broadcast_to(density, lead + node.plate_shape).sum(axis=axes)
    return density


def _agreement(node: CompiledNode, computed: np.ndarray, given: Any) -> np.ndarray:
    """0 where a given deterministic value is the computed one, minus infinity elsewhere."""
    own = tuple(range(-len(node.value_shape), 0))
    return np.where((node.decode(computed) == np.asanyarray(given)).all(axis=own), 0.0, -np.inf)


def _full(value: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The user's own writable array of the full shape."""
    return (
        value.copy()
        if value.shape == shape
        else np.array(np.broadcast_to(value, shape, subok=True), subok=True)
    )
