"""Log densities of what was observed, one for each draw and each observed number or vector."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution, marking_invalid
from bayesmc.errors import QueryError, UnsupportedError
from bayesmc.network import Model, Observed
from bayesmc.network.model import deterministic_above
from bayesmc.results.over_time import slices_of


def log_likelihood(
    model: Model,
    observed: Mapping[str, Observed],
    stored: Mapping[str, np.ndarray],
    shape: tuple[int, int],
    names: Sequence[str],
) -> dict[str, np.ndarray]:
    """See ``Posterior.log_likelihood``.

    Parameters
    ----------
    stored : dict
        Node -> stored values, leading axes (chain, draw); those that the named nodes read.
    names : sequence of str
        Nodes, or a template's nodes.
    """
    found = {}
    values: dict[str, np.ndarray] = dict(stored)
    for name in names:
        rows = slices_of(model, name)
        parts = [_of_node(model, observed, values, shape, row) for row in rows or (name,)]
        found[name] = parts[0] if rows is None else np.stack(parts, axis=2)
    return found


def observed_nodes(model: Model, observed: Mapping[str, Observed], what: str) -> tuple[str, ...]:
    """Stochastic nodes that were observed; those of an unrolled template by the template's names.

    Raises
    ------
    QueryError
        There are none.
    """
    found: dict[str, None] = {}
    for name in model.nodes:
        if name not in observed or not model[name].is_stochastic:
            continue
        base = name.rpartition("[")[0]
        found[base if name.endswith("]") and slices_of(model, base) else name] = None
    if not found:
        raise QueryError(f"{what}: nothing was observed, so that there is no likelihood")
    return tuple(found)


# ---- private ------------------------------------------------------------------------------------


def _of_node(
    model: Model,
    observed: Mapping[str, Observed],
    values: dict[str, np.ndarray],
    shape: tuple[int, int],
    name: str,
) -> np.ndarray:
    """Shape ``(chain, draw, *plates)``; NaN where nothing was observed."""
    node = model[name]
    seen = observed.get(name)
    if seen is None:
        return np.full(shape + node.plate_shape, np.nan)
    with marking_invalid(), np.errstate(all="ignore"):
        for above in deterministic_above(model, name, values):
            values[above], _ = model.evaluate(above, values)
        missing = [p for p in node.parents if p not in values]
        if missing:
            raise UnsupportedError(
                f"log_likelihood({name!r}): the draws of {missing[0]!r} were not kept; add it to keep="
            )
        dist, _ = model.evaluate(name, values)
        value: Any = values[name] if seen.mask is not None else seen.value
        found = model.log_density(name, dist, value)
        full = np.array(np.broadcast_to(found, shape + node.plate_shape))
        if seen.mask is not None:
            full = np.where(seen.mask, full, np.nan)
        if seen.parts is not None:
            full = _with_parts(dist, seen, full)
    return full


def _with_parts(dist: Distribution, seen: Observed, log: np.ndarray) -> np.ndarray:
    """With the log densities of what was seen of vectors seen in part."""
    assert seen.parts is not None
    for pattern in np.unique(seen.parts.reshape(-1, seen.parts.shape[-1]), axis=0):
        if pattern.any():
            here = (seen.parts == pattern).all(axis=-1)
            log = np.where(here, dist.log_prob_of(seen.value, pattern), log)
    return log


def refuse_unobserved(model: Model, observed: Mapping[str, Observed], names: Sequence[str]) -> None:
    """Only what was observed has a likelihood.

    Raises
    ------
    QueryError
    """
    for name in names:
        rows = slices_of(model, name) or (name,)
        if not any(row in observed for row in rows):
            raise QueryError(
                f"log_likelihood({name!r}): the node was not observed; ask of one that was: "
                f"{', '.join(map(repr, list(observed)[:6])) or 'there is none'}"
            )
