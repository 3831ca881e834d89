"""The proposal that looks at the row, derived from the declared densities: ``proposal="optimal"``.

For every particle the hidden numbers of a slice are taken as jointly Gaussian given the slice before, and
what was seen as Gaussian given them, both made linear at the prediction: an extended Kalman update from a
known start. Where transitions are Normal and means of what is seen are affine this is exactly
p(x_t | x_{t-1}, y_t), the proposal of least variance; elsewhere weights p/q make up for the difference.

References
----------
Doucet, Godsill and Andrieu (2000), On sequential Monte Carlo sampling methods for Bayesian filtering,
Statistics and Computing 10, sec. II-D; van der Merwe et al. (2000), The unscented particle filter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from bayesmc.dbn import Row, Slices
from bayesmc.distributions import MvNormal, Normal
from bayesmc.engines.slice_steps import SlicePlan
from bayesmc.errors import BayesmcError
from bayesmc.network import CompiledNode, Model
from bayesmc.network.forward import Pass, Step

#: balances the rounding of a central difference against its curvature
_STEP = float(np.finfo(float).eps ** (1 / 3))
_HALF_LOG_2PI = 0.5 * math.log(2 * math.pi)


class OptimalPlan(SlicePlan):
    """Steps of slices whose hidden numbers are drawn with a look at the row."""

    def _build(self, row: Row) -> list[Step]:
        model = self.slices.model(row.t)
        block = [n for n in hidden_numbers(self.slices, row) if n in model.nodes]
        seen = _looked_at(model, self.slices, row, block)
        if not block or not seen:
            return super()._build(row)
        order = [n for n in model.nodes if n in self.slices.dynamic]
        below = _below(model, order, block)
        first = [n for n in order if n not in below and n not in block]
        steps = [self.step(row, n) for n in first]
        steps.append(LookAhead(model, block, seen, order, self.apart))
        for name in order:
            if name in block:
                steps.append(self.factor(row, name))
            elif name in below:
                steps.append(self.step(row, name))
        return steps


def why_not_optimal(slices: Slices, observed: Sequence[str]) -> str | None:
    """Why no such proposal can be derived, or None."""
    for model in (slices.first, slices.later):
        for name in slices.dynamic:
            node = model[name]
            if not node.is_stochastic or node.is_discrete or name in observed:
                continue
            dist, _ = model.evaluate(name, model.probe)
            if not isinstance(dist, (Normal, MvNormal)):
                return (
                    f'ParticleFilter(proposal="optimal"): {name!r} is {type(dist).__name__}, and such a '
                    "proposal is derived for Normal and MvNormal nodes only; give proposal={...} yourself"
                )
    return None


def hidden_numbers(slices: Slices, row: Row) -> list[str]:
    """Hidden continuous nodes of a slice, parents first."""
    model = slices.model(row.t)
    return [
        n
        for n in model.nodes
        if n in slices.dynamic
        and model[n].is_stochastic
        and not model[n].is_discrete
        and n not in row.seen
    ]


class LookAhead:
    """Draws a block of numbers from their law given what was seen, made Gaussian, and weighs by 1/q."""

    def __init__(
        self,
        model: Model,
        block: Sequence[str],
        seen: Sequence[str],
        order: Sequence[str],
        apart: tuple[str, ...],
    ) -> None:
        self.model, self.block, self.seen = model, list(block), list(seen)
        self.order, self.apart = list(order), apart
        self.lead = tuple(model.sizes[p] for p in apart)
        self.sizes = [_numbers_of(model[n], apart) for n in self.block]
        self.total = sum(self.sizes)

    def __call__(self, state: Pass) -> None:
        shape = (*state.batch, *self.lead)
        mean, cov = np.zeros((*shape, self.total)), np.zeros((*shape, self.total, self.total))
        at = 0
        for name, size in zip(self.block, self.sizes, strict=True):
            spread = np.sqrt(np.maximum(np.diagonal(cov, axis1=-2, axis2=-1), 0.0))
            centre, slopes, noise = self._linear(state, name, size, mean, spread, at)
            mean[..., at : at + size] = centre
            cross = slopes @ cov[..., :at, :at]
            cov[..., at : at + size, :at] = cross
            cov[..., :at, at : at + size] = np.swapaxes(cross, -1, -2)
            cov[..., at : at + size, at : at + size] = cross @ np.swapaxes(slopes, -1, -2) + noise
            at += size
        for name in self.seen:
            mean, cov = self._updated(state, name, mean, cov)
        root = _root(cov)
        noise = state.rng.standard_normal((*shape, self.total))
        draw = mean + np.matvec(root, noise)
        log_q = -0.5 * np.vecdot(noise, noise) - self.total * _HALF_LOG_2PI
        log_q -= np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(axis=-1)
        state.values.update(self._split(draw))
        state.weigh(-log_q)

    # ---- private -------------------------------------------------------------------------------

    def _updated(
        self, state: Pass, name: str, mean: np.ndarray, cov: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Mean and covariance given the value of one seen node."""
        size = _numbers_of(self.model[name], self.apart)
        spread = np.sqrt(np.maximum(np.diagonal(cov, axis1=-2, axis2=-1), 0.0))
        centre, slopes, noise = self._linear(state, name, size, mean, spread, self.total)
        value = self._flat(self.model[name], np.asarray(state.values[name], dtype=float))
        gain = cov @ np.swapaxes(slopes, -1, -2)
        inner = slopes @ gain + noise
        weights = np.swapaxes(np.linalg.solve(inner, np.swapaxes(gain, -1, -2)), -1, -2)
        mean = mean + np.matvec(weights, value - centre)
        cov = cov - weights @ np.swapaxes(gain, -1, -2)
        return mean, 0.5 * (cov + np.swapaxes(cov, -1, -2))

    def _linear(
        self, state: Pass, name: str, size: int, mean: np.ndarray, spread: np.ndarray, count: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A node's mean where the block is expected, its slopes in the first ``count`` numbers, its noise."""
        steps = _STEP * np.maximum(np.abs(mean), np.maximum(spread, 1e-3))
        points = np.broadcast_to(mean, (1 + 2 * count, *mean.shape)).copy()
        for k in range(count):
            points[1 + k, ..., k] += steps[..., k]
            points[1 + count + k, ..., k] -= steps[..., k]
        values = {**state.values, **self._split(points)}
        for other in self.order:  # what is computed between the block and the node
            node = self.model[other]
            if other == name:
                break
            if not node.is_stochastic and all(p in values for p in node.parents):
                found, _ = self.model.evaluate(other, values)
                values[other] = np.asarray(found)
        dist, _ = self.model.evaluate(name, values)
        node = self.model[name]
        lead = (len(points), *mean.shape[:-1])
        loc = self._spread_out(
            node, np.asarray(dist.mean, dtype=float), lead, len(node.event_shape)
        )
        loc = loc.reshape(*lead, size)
        slopes = np.zeros((*mean.shape[:-1], size, count))
        for k in range(count):
            rise = loc[1 + k] - loc[1 + count + k]
            slopes[..., k] = rise / (2 * steps[..., k, None])
        return loc[0], slopes, self._noise(node, dist, lead, size)

    def _noise(self, node: CompiledNode, dist: Any, lead: tuple[int, ...], size: int) -> np.ndarray:
        """Covariance of a node given the block where that is expected."""
        if node.event_shape:
            cov = self._spread_out(node, np.asarray(dist.cov, dtype=float), lead, 2)
            inner = node.event_shape[-1]
            cov = cov.reshape(*lead, size // inner, inner, inner)[0]
            full = np.zeros((*cov.shape[:-3], size, size))
            for k in range(size // inner):
                part = slice(k * inner, (k + 1) * inner)
                full[..., part, part] = cov[..., k, :, :]
            return full
        var = self._spread_out(node, np.asarray(dist.var, dtype=float), lead, 0)
        return var.reshape(*lead, size)[0][..., None] * np.eye(size)

    def _spread_out(
        self, node: CompiledNode, array: np.ndarray, lead: tuple[int, ...], event_ndim: int
    ) -> np.ndarray:
        """With all axes, plates apart right after the batch, shape ``(*lead, *other plates, *event)``."""
        event = array.shape[array.ndim - event_ndim :]
        batch = lead[: len(lead) - len(self.lead)]
        full = np.broadcast_to(array, (*batch, *node.plate_shape, *event))
        order = [node.plates.index(p) for p in self.apart]
        order += [k for k, p in enumerate(node.plates) if p not in self.apart]
        first = len(batch)
        tail = range(first + len(node.plates), full.ndim)
        return full.transpose(*range(first), *(first + k for k in order), *tail)

    def _flat(self, node: CompiledNode, value: np.ndarray) -> np.ndarray:
        """A seen value, shape ``(*apart, numbers)``."""
        moved = self._spread_out(node, value, self.lead, len(node.event_shape))
        return moved.reshape(*self.lead, -1)

    def _split(self, joined: np.ndarray) -> dict[str, np.ndarray]:
        """Values of the block's nodes, ``(*batch, *plates, *event)``."""
        found, at = {}, 0
        batch = joined.shape[: joined.ndim - 1 - len(self.lead)]
        for name, size in zip(self.block, self.sizes, strict=True):
            node = self.model[name]
            others = [
                n for p, n in zip(node.plates, node.plate_shape, strict=True) if p not in self.apart
            ]
            part = joined[..., at : at + size].reshape(
                *batch, *self.lead, *others, *node.event_shape
            )
            at += size
            back = [*self.apart, *(p for p in node.plates if p not in self.apart)]
            first = len(batch)
            order = [first + back.index(p) for p in node.plates]
            tail = range(first + len(node.plates), part.ndim)
            part = np.ascontiguousarray(part.transpose(*range(first), *order, *tail))
            part.flags.writeable = False
            found[name] = part
        return found


# ---- private ------------------------------------------------------------------------------------


def _numbers_of(node: CompiledNode, apart: tuple[str, ...]) -> int:
    others = [n for p, n in zip(node.plates, node.plate_shape, strict=True) if p not in apart]
    return math.prod(others) * math.prod(node.event_shape)


def _below(model: Model, order: Sequence[str], block: Sequence[str]) -> set[str]:
    """Nodes of a slice that depend on a block."""
    reached = set(block)
    for name in order:
        if reached & set(model[name].parents):
            reached.add(name)
    return reached - set(block)


def _looked_at(model: Model, slices: Slices, row: Row, block: Sequence[str]) -> list[str]:
    """Seen nodes, in full, that depend on the block and have a mean and a variance."""
    order = [n for n in model.nodes if n in slices.dynamic]
    found = []
    for name in order:
        seen = row.seen.get(name)
        if seen is None or seen.mask is not None or name not in _below(model, order, block):
            continue
        try:
            dist, _ = model.evaluate(name, model.probe)
            spread = dist.cov if model[name].event_shape else dist.var
            if np.isfinite(np.asarray(dist.mean)).all() and np.isfinite(np.asarray(spread)).all():
                found.append(name)
        except (BayesmcError, AttributeError, NotImplementedError):
            continue
    return found


def _root(cov: np.ndarray) -> np.ndarray:
    """Lower Cholesky factors; rounding is made up for on the diagonal."""
    try:
        return np.linalg.cholesky(cov)
    except np.linalg.LinAlgError:
        size = np.maximum(np.diagonal(cov, axis1=-2, axis2=-1), 1e-300)
        scale = np.sqrt(size)
        unit = cov / (scale[..., :, None] * scale[..., None, :])
        values, vectors = np.linalg.eigh(unit)
        fixed = (vectors * np.maximum(values, 1e-12)[..., None, :]) @ np.swapaxes(vectors, -1, -2)
        return scale[..., :, None] * np.linalg.cholesky(fixed)
