"""Slice sampling of a block along directions that the warmup learns.

Coefficients of one regression are correlated, and one at a time they crawl. The block moves along the
principal axes of its own covariance instead, each step a univariate slice; before anything is known the axes
are the coordinates.

References
----------
Tibbits, Groendyke, Haran and Liechty (2014), Automated factor slice sampling, J. Comp. Graph. Statist. 23.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bayesmc.distributions.transforms import Transform, transform_of
from bayesmc.errors import DensityError
from bayesmc.kernels.base import Kernel, Memory
from bayesmc.kernels.slice import EVALUATIONS, slice_move
from bayesmc.network import CompiledNode
from bayesmc.structure.like_terms import TermSum
from bayesmc.structure.target import Target, Values

#: sweeps at which the directions are learnt anew, in powers of two from here
_FIRST = 32


class FactorSlice(Kernel):
    """Moves several continuous nodes together, along learnt directions.

    Parameters
    ----------
    target : Target
    names : tuple of str
        Nodes that share terms; numbers or vectors whose support is a box.
    """

    label = "factor slice"

    def __init__(self, target: Target, names: tuple[str, ...]) -> None:
        self.target = target
        self.names = names
        self.terms = TermSum(target, target.terms_of(names))
        self.path = target.below(names)
        self.shapes = [target.model[n].value_shape for n in names]
        self.sizes = [int(np.prod(s, dtype=int)) for s in self.shapes]
        self.size = sum(self.sizes)
        self.evaluations = EVALUATIONS * self.size
        self.order = range(self.size)
        self.transforms = [_transform(target.model[n]) for n in names]
        self.match = "jointly with " + ", ".join(names) if len(names) > 1 else "as one vector"

    def start(self, values: Values, chains: int) -> Memory:
        return {
            "directions": np.eye(self.size),
            "width": np.ones(self.size),
            "moved": np.zeros(self.size),
            "sum": np.zeros(self.size),
            "square": np.zeros((self.size, self.size)),
            "count": 0,
            "sweep": 0,
            "learnt": _FIRST,
        }

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        x = self._joined(values)
        for k in self.order:
            direction = memory["directions"][k]

            def log_density(t: np.ndarray, x: Any = x, direction: Any = direction) -> np.ndarray:
                return self._log(values, x + t[..., None] * direction)

            width = np.full(len(x), memory["width"][k])
            try:
                t = slice_move(log_density, np.zeros(len(x)), width, rng)
            except DensityError as error:
                if "node" in str(error):
                    raise
                raise DensityError(f"nodes {', '.join(map(repr, self.names))}: {error}") from error
            x = x + t[:, None] * direction
            if warmup:
                memory = self._widened(memory, k, np.abs(t).mean())
        if warmup:
            memory = self._learnt(memory, x)
        return self._split(x)[0], memory

    # ---- private -------------------------------------------------------------------------------

    def _joined(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """The block on its free scale, shape (chains, size)."""
        chains = len(values[self.names[0]])
        parts = []
        for name, transform in zip(self.names, self.transforms, strict=True):
            value = values[name] if transform is None else transform.unconstrain(values[name])
            parts.append(value.reshape(chains, -1))
        return np.concatenate(parts, axis=1)

    def _split(self, x: np.ndarray) -> tuple[Values, Any]:
        """Values of the nodes, and the log volume that their free scale stretches."""
        lead = x.shape[:-1]
        values: Values = {}
        volume: Any = 0.0
        at = 0
        for name, size, shape, transform in zip(
            self.names, self.sizes, self.shapes, self.transforms, strict=True
        ):
            part = np.ascontiguousarray(x[..., at : at + size]).reshape(lead + shape)
            at += size
            if transform is None:
                values[name] = part
            else:
                values[name] = transform.constrain(part)
                volume = volume + transform.log_abs_det_jacobian(part)
        return values, volume

    def _log(self, values: Values, x: np.ndarray) -> np.ndarray:
        """Log density of the block on its free scale, shape the lead of ``x``."""
        new, volume = self._split(x)
        state = {**values, **new}
        inside: Any = True
        for name, transform in zip(self.names, self.transforms, strict=True):
            if transform is None:  # bounds that move with parents
                good = self.target.terms[name].distribution(state)[0].support.contains(new[name])
            else:
                good = np.isfinite(new[name])
            inside = inside & good.all(axis=tuple(range(x.ndim - 1, good.ndim)))
        inside = np.broadcast_to(inside, x.shape[:-1])
        if not inside.all():  # outside of the support children may have no meaning
            now = np.broadcast_to(self._joined(values), x.shape)
            state.update(self._split(np.where(inside[..., None], x, now))[0])
        for link in self.path:
            state[link], _ = self.target.model.evaluate(link, state)
        log = np.broadcast_to(self.terms.log_density(state) + volume, x.shape[:-1])
        return log if inside.all() else np.where(inside, log, -np.inf)

    def _widened(self, memory: Memory, k: int, step: float) -> Memory:
        moved = memory["moved"].copy()
        width = memory["width"].copy()
        rate = max(1.0 / (memory["sweep"] + 1), 0.05)
        moved[k] = (1 - rate) * moved[k] + rate * step
        if moved[k] > 0:
            width[k] = 3.0 * moved[k]
        return {**memory, "moved": moved, "width": width}

    def _learnt(self, memory: Memory, x: np.ndarray) -> Memory:
        """Moments over chains and sweeps; at every power of two the directions are learnt anew."""
        sweep = memory["sweep"] + 1
        memory = {
            **memory,
            "sum": memory["sum"] + x.sum(axis=0),
            "square": memory["square"] + x.T @ x,
            "count": memory["count"] + len(x),
            "sweep": sweep,
        }
        if sweep < memory["learnt"]:
            return memory
        mean = memory["sum"] / memory["count"]
        cov = memory["square"] / memory["count"] - np.outer(mean, mean)
        scale = np.sqrt(np.maximum(np.diag(cov), 1e-300))
        fresh = {"learnt": 2 * memory["learnt"], "sum": np.zeros(self.size), "count": 0}
        fresh["square"] = np.zeros((self.size, self.size))
        if memory["count"] > 4 * self.size and np.isfinite(scale).all():
            # axes of the correlation, so that units do not matter
            values, vectors = np.linalg.eigh(cov / np.outer(scale, scale))
            spread = np.sqrt(np.maximum(values, 1e-12))
            fresh["directions"] = (vectors * spread).T * scale
            fresh["width"] = np.full(self.size, 2.0)
            fresh["moved"] = np.zeros(self.size)
        return {**memory, **fresh}


# ---- private ------------------------------------------------------------------------------------


def _transform(node: CompiledNode) -> Transform | None:
    """The map to a free scale, where the support is the same whatever the parents are."""
    support = node.support
    assert support is not None
    if support.kind in ("interval", "product") and not support.is_single:
        return None
    return None if support.kind == "circle" else transform_of(support, node.event_shape)
