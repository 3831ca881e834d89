"""Readings of a vector that is drawn with a look at the row, which read no element: a compass, a GPS.

They weigh the vector by their density, and lead where it is drawn by their means, made linear in it. Where a
mean has no known derivative they weigh alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from bayesmc.dbn import PREVIOUS, Row, Slices
from bayesmc.distributions.circular import wrap_angle
from bayesmc.engines.kalman.slices import covariance_root
from bayesmc.engines.marginal.tables.step import Known
from bayesmc.errors import TraceError, UnsupportedError
from bayesmc.expression import Program, broadcast, leaf
from bayesmc.network import Observed
from bayesmc.network.expressions import Opaque, density
from bayesmc.network.model import Model
from bayesmc.passes.derivatives import tangent
from bayesmc.passes.mean import mean


class Beside:
    """Some observed nodes that read one sampled vector.

    Parameters
    ----------
    slices : Slices
    name : str
        The vector.
    others : sequence of str
    """

    def __init__(self, slices: Slices, name: str, others: Sequence[str]) -> None:
        self.slices, self.name, self.others = slices, name, tuple(others)
        self._slopes = [
            {n: _slopes(model, n, name) for n in self.others}
            for model in (slices.first, slices.later)
        ]

    def log(self, row: Row, known: Known) -> np.ndarray:
        """Log densities of what is seen, shape (particles,)."""
        model, total = self.slices.model(row.t), np.zeros(known.particles)
        for name, seen in self._seen(row):
            result = model.evaluate(name, known.values)[0]
            log = model.log_density(name, result, seen.value)
            shape = (known.particles, *model[name].plate_shape)
            total = total + np.broadcast_to(log, shape).reshape(known.particles, -1).sum(axis=-1)
        return total

    def rows(self, row: Row, known: Known) -> list[tuple[np.ndarray, np.ndarray]]:
        """Of each: how readings move with the vector, and how far they are off, standardised."""
        found = []
        for name, seen in self._seen(row):
            slopes = self._slopes[min(row.t, 1)][name]
            if slopes is not None:
                made = self._standardised(row, name, seen, slopes, known)
                found.extend([] if made is None else [made])
        return found

    # ---- private -------------------------------------------------------------------------------

    def _seen(self, row: Row) -> list[tuple[str, Observed]]:
        found = []
        for name in self.others:
            seen = row.seen.get(name)
            if seen is None:
                continue
            if seen.mask is None:
                found.append((name, seen))
            elif seen.mask.any() or (seen.parts is not None and seen.parts.any()):
                raise UnsupportedError(
                    f'ParticleFilter: with marginalize=, proposal="optimal" takes {name!r} in full or not at '
                    f"all, and slice {row.t} has some of its numbers; leave proposal= out"
                )
        return found

    def _standardised(
        self, row: Row, name: str, seen: Observed, slopes: Program, known: Known
    ) -> tuple[np.ndarray, np.ndarray] | None:
        model, n = self.slices.model(row.t), known.particles
        node, value = model[name], known.values[self.name]
        result = model.evaluate(name, known.values)[0]
        d, size = math.prod(node.event_shape), math.prod(value.shape[1:])
        try:
            root = covariance_root(result)
            if root is None:
                scale = np.sqrt(np.broadcast_to(result.var, (n, *node.value_shape)))
                root = scale.reshape(*scale.shape[: scale.ndim - len(node.event_shape)], d, 1)
                root = root * np.eye(d)
            expected = np.broadcast_to(result.mean, (n, *node.value_shape))
        except (AttributeError, NotImplementedError):  # moments that nobody knows
            return None
        root = np.broadcast_to(root, (n, *node.plate_shape, d, d)).reshape(n, -1, d, d)
        off = seen.value - expected
        if node.angles is not None:
            off = np.where(node.angles, wrap_angle(off), off)
        unit = np.eye(size).reshape(size, 1, *value.shape[1:])
        (found,) = slopes({**known.values, f"move of {self.name}": unit})
        along = np.broadcast_to(found, (size, n, *node.value_shape)).reshape(size, n, -1, d)
        along, off = np.moveaxis(along, 0, -1), off.reshape(n, -1, d)
        good = np.isfinite(root).all((-2, -1)) & np.isfinite(along).all((-2, -1))
        good &= np.isfinite(off).all(-1) & (np.abs(np.diagonal(root, 0, -2, -1)) > 0).all(-1)
        root = np.where(good[..., None, None], root, np.eye(d))
        seen_by = np.linalg.solve(root, np.where(good[..., None, None], along, 0.0))
        away = np.linalg.solve(root, np.where(good[..., None], off, 0.0)[..., None])[..., 0]
        return seen_by.reshape(n, -1, size), away.reshape(n, -1)


# ---- private ------------------------------------------------------------------------------------


def _slopes(model: Model, name: str, along: str) -> Program | None:
    """How the mean of a node moves with another, or None where that is not known."""
    cut = [n for n in model.nodes if n.endswith(PREVIOUS) and not model[n].is_stochastic]
    read = density(model, name, frozenset(cut))
    if isinstance(read, Opaque) or model[name].is_discrete or model[name].domain is not None:
        return None
    try:
        whole = broadcast(mean(read.result), model[name].value_shape)
        moves = {along: leaf(f"move of {along}", model[along].value_shape)}
        return Program([tangent(whole, moves)]) if along in whole.leaves else None
    except TraceError:
        return None
