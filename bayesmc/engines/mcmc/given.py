"""Where the user wants chains to start: ``start={"x": 1.0}`` read, every fault named."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bayesmc.engines.proposal import check_targets
from bayesmc.errors import BayesmcError, EvidenceError, ShapeError
from bayesmc.network import CompiledNode, Problem
from bayesmc.network.evidence import store
from bayesmc.shapes import broadcasts_to, first_index


def frozen_start(engine: str, start: Any) -> dict[str, Any] | None:
    """A copy of the option that nobody else changes.

    Raises
    ------
    TypeError
        It is no dict from node to value.
    """
    if start is None:
        return None
    if not isinstance(start, Mapping) or not all(isinstance(name, str) for name in start):
        raise TypeError(
            f"{engine}(start={start!r:.80}): start is a dict from node name to where its chains "
            "start, such as start={'x': 1.0}"
        )
    kept = {}
    for name, value in start.items():
        copied = np.array(value)
        copied.flags.writeable = False
        kept[name] = copied
    return kept


def read_start(
    engine: str, problem: Problem, start: Mapping[str, Any], chains: int
) -> dict[str, np.ndarray]:
    """Stored values at which chains start.

    Parameters
    ----------
    start : dict
        Node -> value that broadcasts to ``(*plates, *event)``, or, with more axes than that, to
        ``(chains, *plates, *event)``: one for each chain.

    Returns
    -------
    dict
        Node -> stored values, shape ``(chains, *plates, *event)``.

    Raises
    ------
    UnknownNodeError, ModelError, EvidenceError, ShapeError
        A name that is no hidden node, or a value that it cannot have.
    """
    found = {}
    for name, value in start.items():
        check_targets(engine, problem, name, "start")
        found[name] = _read(engine, problem, problem.model[name], value, chains)
    return found


def note_start(problem: Problem, start: Mapping[str, Any] | None) -> None:
    """Have functions compared where chains start, too: orders may rule out all other values that are tried.

    ``Target.states`` has them. What is wrong with a start the run says.
    """
    if not start or "start" in problem.cache:
        return
    one = {}
    for name, value in start.items():
        node = problem.model.nodes.get(name)
        many = node is not None and np.ndim(value) > len(node.value_shape)
        one[name] = np.asarray(value)[:1] if many else value
    try:
        problem.cache["start"] = read_start("", problem, one, 1)
    except (BayesmcError, TypeError, ValueError):
        problem.cache["start"] = {}


# ---- private ------------------------------------------------------------------------------------


def _read(engine: str, problem: Problem, node: CompiledNode, value: Any, chains: int) -> np.ndarray:
    what = f"{engine}: start for {node.name!r}"
    shape, wanted = np.shape(value), node.value_shape
    each = len(shape) > len(wanted)
    if not broadcasts_to(shape, (chains, *wanted) if each else wanted):
        raise ShapeError(
            f"{what} has shape {shape}; give {wanted} for all chains (plates {node.plates}, then one value's "
            f"shape) or what broadcasts to it, such as one number, or {(chains, *wanted)} for each of the "
            f"{chains}"
        )
    try:
        stored = store(node, np.broadcast_to(value, (chains, *wanted) if each else wanted))
    except EvidenceError as error:
        raise EvidenceError(f"{what}: {error}") from None
    seen = problem.observed.get(node.name)
    hidden = np.ones(node.plate_shape, dtype=bool)
    if seen is not None and seen.mask is not None:
        hidden = ~seen.mask
    _check(what, node, stored, hidden)
    return np.array(np.broadcast_to(stored, (chains, *wanted)))


def _check(what: str, node: CompiledNode, stored: np.ndarray, hidden: np.ndarray) -> None:
    """Refuse what is not finite, or outside of a support that does not depend on parents."""
    event = tuple(range(stored.ndim - len(node.event_shape), stored.ndim))
    wrong = np.zeros(stored.shape, dtype=bool)
    if stored.dtype.kind == "f":
        wrong = ~np.isfinite(stored)
    support = node.support
    if node.domain is None and support is not None:
        inside = np.asarray(
            support.contains(np.where(wrong, 0.0, stored) if wrong.any() else stored)
        )
        wrong = wrong | (np.expand_dims(~inside, event) if inside.ndim < stored.ndim else ~inside)
    wrong = wrong & np.expand_dims(hidden, tuple(range(hidden.ndim, hidden.ndim + len(event))))
    if wrong.any():
        at = first_index(wrong)
        within = f" ({support.describe()})" if support is not None else ""
        where = f" at index {at if len(at) > 1 else at[0]}" if at else ""
        raise EvidenceError(f"{what} is {stored[at]}{where}, which the node cannot be{within}")
