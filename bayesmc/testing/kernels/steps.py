"""A function that a user wrote, ``step(state, rng) -> state``, as a move of rows of stored values.

The user's states are dicts from node to value, of one state or (batched) of many; what comes back is read as
evidence is, so that faults name the node. What tests make of a move is not known here.
"""

from __future__ import annotations

import copy
import inspect
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from bayesmc.engines.mcmc.chains import ChainEngine
from bayesmc.errors import BayesmcError, EvidenceError, ModelError
from bayesmc.kernels.base import Kernel
from bayesmc.network.evidence import store
from bayesmc.testing.kernels.joint import NetStates, Rows, as_evidence


def is_step(kernel: Any) -> bool:
    """Whether it is a function of state and random numbers."""
    if isinstance(kernel, (ChainEngine, Kernel)) or not callable(kernel):
        return False
    return positional(kernel) in (2, None)


def positional(function: Any) -> int | None:
    """How many arguments a function must be given by position; None where that cannot be seen."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return None
    if any(p.kind is p.KEYWORD_ONLY and p.default is p.empty for p in parameters):
        return 0  # what is asked for by name is not given here
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return sum(p.kind in kinds and p.default is inspect.Parameter.empty for p in parameters)


def takes(function: Callable[..., Any], count: int) -> bool:
    """Whether a function can be called with so many arguments, as far as that can be seen."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return True
    try:
        signature.bind(*[None] * count)
    except TypeError:
        return False
    return True


class StepFunction:
    """A user's ``step(state, rng) -> state``, of one state or of rows of them, on stored values."""

    def __init__(self, call: str, step: Any, joint: NetStates, batched: bool) -> None:
        self.call, self.step, self.joint, self.batched = call, step, joint, batched

    def __call__(self, state: Rows, data: Rows, rng: np.random.Generator) -> Rows:
        joint, rows = self.joint, len(next(iter(state.values())))
        nodes = joint.model.nodes
        full = {
            n: nodes[n].decode(np.broadcast_to(v, (rows, *nodes[n].value_shape)))
            for n, v in joint.complete(state, data).items()
        }
        if self.batched:
            return {**state, **self._read(self._stepped(_copied(full), rng), full, (rows,))}
        moved: list[dict[str, Any]] = []
        for row in range(rows):
            one = {n: as_evidence(v[row]) for n, v in full.items()}
            given = self._stepped(_copied(one), rng)
            moved.append(self._kept(given, one))
        after = {n: [m[n] for m in moved] for n in state if any(n in m for m in moved)}
        return {**state, **self._read(after, full, (rows,))}

    def _stepped(self, state: dict[str, Any], rng: np.random.Generator) -> Mapping[str, Any]:
        result = self.step(state, rng)
        if not isinstance(result, Mapping):
            raise ModelError(
                f"{self.call}: step(state, rng) returned {type(result).__name__}; return the next state, a "
                "dict from node to value (nodes that did not move may be left out)"
            )
        unknown = [n for n in result if n not in self.joint.model.nodes]
        if unknown:
            raise ModelError(
                f"{self.call}: step(state, rng) returned {unknown[0]!r}, which is no node of the net; it has "
                f"{list(self.joint.model.nodes)}"
            )
        return result

    def _kept(self, given: Mapping[str, Any], before: Mapping[str, Any]) -> dict[str, Any]:
        """What a state says of hidden nodes, those that it leaves out as they were."""
        for name in self.joint.observed:
            if name in given and not np.array_equal(given[name], before[name]):
                raise self._moved_data(name)
        return {n: given.get(n, before[n]) for n in self.joint.hidden}

    def _read(self, after: Mapping[str, Any], full: Mapping[str, Any], batch: tuple[int]) -> Rows:
        found = {}
        for name, value in after.items():
            node = self.joint.model[name]
            if name in self.joint.observed and self.batched:
                seen, now = (getattr(v, "codes", v) for v in (full[name], value))
                if not np.array_equal(np.asarray(seen), np.asarray(now)):
                    raise self._moved_data(name)
            if name not in self.joint.hidden:
                continue
            try:
                stored = store(node, value)
            except (BayesmcError, ValueError, TypeError) as error:
                said = str(error).replace("evidence on", "the value of")
                raise EvidenceError(
                    f"{self.call}: step(state, rng) returned what is no value: {said}"
                ) from None
            if np.isnan(stored).any():
                raise EvidenceError(
                    f"{self.call}: step(state, rng) returned NaN for {name!r}; look for a logarithm or a "
                    "root of something negative"
                )
            if stored.shape != batch + node.value_shape:
                lead = 0 if self.batched else 1  # of one state no rows are seen
                raise EvidenceError(
                    f"{self.call}: step(state, rng) returned {name!r} with shape {stored.shape[lead:]}, not "
                    f"{(batch + node.value_shape)[lead:]}"
                )
            found[name] = stored
        return found

    def _moved_data(self, name: str) -> ModelError:
        return ModelError(
            f"{self.call}: step(state, rng) moved {name!r}, which is data; a kernel moves hidden nodes given "
            f"the data, which here are {list(self.joint.observed)}"
        )


def _copied(state: Mapping[str, Any]) -> dict[str, Any]:
    return {n: copy.copy(v) for n, v in state.items()}
