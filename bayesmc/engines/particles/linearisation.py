"""A block of hidden numbers as a Gaussian, given the slice before and what was seen below the block.

Means are linearised where the block is expected (central differences) and moments are taken there: an
extended Kalman update from a known start, one for every particle. What is seen and is not Gaussian (a count,
a failure time) corrects that by the derivatives of its log density (``curved``). It gives a density to draw
the block from and the density of what was seen. Mixtures of Gaussians make a block a mixture, of one such
belief for each combination of components. Which nodes make a block is not decided here (``optimal``).

Differences of nodes on a circle are wrapped.

References
----------
Doucet, Godsill and Andrieu (2000), On sequential Monte Carlo sampling methods for Bayesian filtering,
Statistics and Computing 10, sec. II-D.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from bayesmc.distributions import WrappedNormal
from bayesmc.distributions.circular import wrap_angle
from bayesmc.engines.particles.laplace import corrected
from bayesmc.engines.particles.looking import (
    NUMBERS,
    by_moments,
    density_at,
    elements_seen,
    has_moments,
    moments,
    numbers_of,
    once,
    spreads,
)
from bayesmc.network import CompiledNode, Model
from bayesmc.network.forward import Pass, summed

#: balances the rounding of a central difference against its curvature
_STEP = float(np.finfo(float).eps ** (1 / 3))
#: times that means are linearised anew, where the block is now expected
_TURNS = 5
#: standard deviations by which the block may still have moved in the last of them
_STILL = 0.01
_HALF_LOG_2PI = 0.5 * math.log(2 * math.pi)
#: variance in square radians from which on a Gaussian is no picture of an angle: it has more than one mode
_TURNED = 1.0


class Belief(NamedTuple):
    """A block given what was seen, for every particle.

    Attributes
    ----------
    mean : ndarray, shape (*batch, *apart, numbers)
    cov : ndarray, shape (*batch, *apart, numbers, numbers)
    log_density : ndarray, shape (*batch, *apart)
        Of what was seen, the block integrated out.
    """

    mean: np.ndarray
    cov: np.ndarray
    log_density: np.ndarray


class LookAhead:
    """Draws a block of numbers from their law given what was seen, made Gaussian, and weighs by 1/q.

    Parameters
    ----------
    model : Model
    block : sequence of str
        Normal and MvNormal nodes, parents first.
    seen : dict
        Node that depends on the block -> what is seen of it (``mask_of``).
    order : sequence of str
        Nodes of the slice, parents first.
    apart : tuple of str
        Plates whose elements have blocks of their own.
    affine : bool
        Whether all means are affine in the block: differences may take long steps, which lose no digits.
    choices : dict, optional
        Mixture of Gaussians -> the component that stands for it.
    """

    def __init__(
        self,
        model: Model,
        block: Sequence[str],
        seen: Mapping[str, np.ndarray | None],
        order: Sequence[str],
        apart: tuple[str, ...],
        affine: bool = False,
        choices: Mapping[str, int] = MappingProxyType({}),
    ) -> None:
        self.model, self.block, self.seen = model, list(block), dict(seen)
        self.choices = choices
        self.apart, self.affine = apart, affine
        self.share = 1.0 if affine else _STEP
        self.lead = tuple(model.sizes[p] for p in apart)
        self.sizes = [numbers_of(model, n, apart) for n in self.block]
        self.total = sum(self.sizes)
        self.between = {n: _between(model, order, block, n) for n in (*self.block, *self.seen)}
        masks = {n: _over_events(m, model[n]) for n, m in self.seen.items() if m is not None}
        self.masks = {
            n: self._flat(model[n], np.broadcast_to(m, model[n].value_shape))
            for n, m in masks.items()
        }
        self.straight = [
            n
            for n in self.seen
            if n in choices
            or (by_moments(model, n) and (affine or not spread_varies(model, order, block, n)))
        ]
        self.curved = [n for n in self.seen if n not in self.straight]
        self.within = self._within(self.curved)
        if (
            len(self.within) > NUMBERS
        ):  # too many for derivatives: what has moments is taken by them
            self.straight += [n for n in self.curved if has_moments(model, n)]
            self.curved = []
        #: what is seen and tells nothing all the same
        self.ignored = [n for n in self.seen if n not in (*self.straight, *self.curved)]

    def __call__(self, state: Pass) -> None:
        state.weigh(-self.draw(state, self.believed(state)))

    def believed(self, state: Pass) -> Belief:
        """The block given its parents, whose values are in place, and what was seen.

        Means that are not affine are linearised again where the block is then expected (Gauss-Newton steps).
        """
        shape = (*state.batch, *self.lead)
        mean, cov = np.zeros((*shape, self.total)), np.zeros((*shape, self.total, self.total))
        at = 0
        for name, size in zip(self.block, self.sizes, strict=True):
            own = slice(at, at + size)
            centre, slopes, noise = self._linear(state, name, size, mean, cov, at)
            cross = _times(slopes, cov[..., :at, :at])
            mean[..., own] = centre
            cov[..., own, :at] = cross
            cov[..., :at, own] = np.swapaxes(cross, -1, -2)
            cov[..., own, own] = _times(cross, np.swapaxes(slopes, -1, -2)) + noise
            at += size
        mean, cov = _where_finite(mean), _where_finite(cov)
        start = belief = Belief(mean, cov, self._log_choices(state, mean))
        for turn in range(1 if self.affine or not self.straight else _TURNS):
            at_mean, belief = belief.mean, start
            for name in self.straight:
                point = belief.mean if turn == 0 else at_mean
                belief = self._updated(state, name, belief, point)
            if self.curved:
                belief = self._corrected(state, belief, at_mean if turn else None)
            moved = np.abs(belief.mean - at_mean)
            spread = np.sqrt(np.diagonal(belief.cov, axis1=-2, axis2=-1))
            if not (moved > _STILL * spread).any():
                break
        return belief

    def draw(self, state: Pass, belief: Belief) -> np.ndarray:
        """Put a draw of the block among the values; its log density, shape ``(*batch, *apart)``."""
        root = _root(belief.cov)
        noise = state.rng.standard_normal(belief.mean.shape)
        state.values.update(self._split(belief.mean + _applied(root, noise)))
        return self._log_normal(noise, root)

    def log_density(self, values: Mapping[str, np.ndarray], belief: Belief) -> np.ndarray:
        """The log density of a block's values, shape ``(*batch, *apart)``."""
        batch = belief.mean.shape[: belief.mean.ndim - 1]
        parts = [self._flat(self.model[n], values[n], batch) for n in self.block]
        root, off = _root(belief.cov), np.concatenate(parts, axis=-1) - belief.mean
        one = self.total == 1
        noise = off / root[..., 0] if one else np.linalg.solve(root, off[..., None])[..., 0]
        return self._log_normal(noise, root)

    def along(self, flags: np.ndarray, node: CompiledNode) -> np.ndarray:
        """What is said of every block, shape ``(*batch, *apart)``, laid along a node's values."""
        more = len(node.plates) - len(self.apart) + len(node.event_shape)
        wide = flags.reshape(*flags.shape, *(1,) * more)
        return np.moveaxis(wide, *self._places(node, flags.ndim - len(self.apart)))

    # ---- private -------------------------------------------------------------------------------

    def _log_normal(self, noise: np.ndarray, root: np.ndarray) -> np.ndarray:
        log = -0.5 * np.vecdot(noise, noise) - self.total * _HALF_LOG_2PI
        found: np.ndarray = log - np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(axis=-1)
        return found

    def _within(self, names: Sequence[str]) -> np.ndarray:
        """Positions in the block of the numbers that some nodes depend on."""
        read = {p for n in names for m in (n, *self.between[n]) for p in self.model[m].parents}
        ends = np.cumsum([0, *self.sizes])
        parts = zip(self.block, ends, ends[1:], strict=False)
        found = [np.arange(low, high) for name, low, high in parts if name in read]
        return np.concatenate(found) if found else np.arange(0)

    def _log_choices(self, state: Pass, mean: np.ndarray) -> np.ndarray:
        """Log weights of the components that stand for mixtures, where the block is expected."""
        total = np.zeros(mean.shape[:-1])
        for name, choice in self.choices.items():
            node = self.model[name]
            dist, _ = self.model.evaluate(name, self._computed(state, name, mean))
            weights = np.broadcast_to(dist.weights, (*dist.batch_shape, dist.weights.shape[-1]))
            with np.errstate(divide="ignore"):
                log = np.log(weights[..., choice])
            mask = elements_seen(self.seen.get(name), node, np.any)
            if mask is not None:
                log = np.where(mask, log, 0.0)
            total = total + summed(
                np.broadcast_to(log, (*state.batch, *node.plate_shape)), node, self.apart
            )
        return total

    def _computed(self, state: Pass, name: str, block: np.ndarray) -> dict[str, np.ndarray]:
        """Values with the block's, and what is computed from them on the way to a node."""
        values = {**state.values, **self._split(block)}
        for other in self.between[name]:
            found, _ = self.model.evaluate(other, values)
            values[other] = np.asarray(found)
        return values

    def _corrected(self, state: Pass, belief: Belief, at: np.ndarray | None) -> Belief:
        """The belief given what is seen and not Gaussian, by derivatives of its log density."""
        mean, cov, log_before = belief
        inner = self.within
        block = cov[..., inner[:, None], inner]

        def log_density(points: np.ndarray) -> np.ndarray:
            full = np.broadcast_to(mean, (len(points), *mean.shape)).copy()
            full[..., inner] = points
            total = np.zeros(points.shape[:-1])
            batch = (len(points), *state.batch)
            for name in self.curved:
                values = self._computed(state, name, full)
                node = self.model[name]
                mask = elements_seen(self.seen[name], node)
                log = density_at(self.model, name, values, mask)
                log = np.broadcast_to(log, batch + node.plate_shape)
                total = total + summed(log, node, self.apart)
            return total

        start = None if at is None else at[..., inner]
        mode, spread, log = corrected(log_density, mean[..., inner], _root(block), start)
        if len(inner) == self.total:
            return Belief(mode, spread, log_before + log)
        gain = np.swapaxes(np.linalg.solve(_settled(block), cov[..., inner, :]), -1, -2)
        moved = mean + _applied(gain, mode - mean[..., inner])
        cov = cov - _times(_times(gain, block - spread), np.swapaxes(gain, -1, -2))
        return Belief(moved, cov, log_before + log)

    def _updated(self, state: Pass, name: str, belief: Belief, point: np.ndarray) -> Belief:
        """The belief given the value of one seen node, linearised at a point."""
        mean, cov, log_density = belief
        node = self.model[name]
        size = numbers_of(self.model, name, self.apart)
        centre, slopes, noise = self._linear(state, name, size, point, cov, self.total)
        off = self._flat(node, np.asarray(state.values[name], dtype=float)) - centre
        off = wrap_angle(off) if node.angles is not None else off
        off = off - _applied(slopes, mean - point)
        gain = _times(cov, np.swapaxes(slopes, -1, -2))
        inner = _times(slopes, gain) + noise
        var = np.diagonal(inner, axis1=-2, axis2=-1)
        alone: Any = 0.0
        blind = ~(np.isfinite(off) & np.isfinite(var) & (var > 0))
        if name in self.masks:
            blind |= ~self.masks[name]
        if node.angles is not None:
            wide = (var > _TURNED) & ~blind
            spread, at = np.sqrt(np.where(wide, var, 1.0)), np.where(wide, off, 0.0)
            alone = np.where(wide, WrappedNormal(0.0, spread).log_prob(at), 0.0).sum(axis=-1)
            blind |= wide
        if blind.any():  # these tell nothing of the block: no slope, and noise of their own
            slopes = np.where(blind[..., None], 0.0, slopes)
            off = np.where(blind, 0.0, off)
            apart = blind[..., :, None] | blind[..., None, :]
            noise = np.where(apart, np.eye(size), noise)
            alone = alone + _HALF_LOG_2PI * blind.sum(axis=-1)
            gain = _times(cov, np.swapaxes(slopes, -1, -2))
            inner = _times(slopes, gain) + noise
        if size == 1:
            weights = gain / inner
            log = -0.5 * (off[..., 0] ** 2 / inner[..., 0, 0] + np.log(inner[..., 0, 0]))
        else:
            weights = np.swapaxes(np.linalg.solve(inner, np.swapaxes(gain, -1, -2)), -1, -2)
            distance = np.vecdot(off, np.linalg.solve(inner, off[..., None])[..., 0])
            log = -0.5 * (distance + np.linalg.slogdet(inner)[1])
        log_density = log_density + log - size * _HALF_LOG_2PI + alone
        rest = np.eye(self.total) - _times(weights, slopes)
        # Joseph's form: it stays positive, however sharp the row is
        cov = _times(_times(rest, cov), np.swapaxes(rest, -1, -2))
        cov = cov + _times(_times(weights, noise), np.swapaxes(weights, -1, -2))
        return Belief(mean + _applied(weights, off), cov, log_density)

    def _linear(
        self, state: Pass, name: str, size: int, mean: np.ndarray, cov: np.ndarray, count: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A node's mean where the block is expected, its slopes in the first ``count`` numbers, its noise."""
        spread = np.sqrt(np.maximum(np.diagonal(cov, axis1=-2, axis2=-1), 0.0))
        steps = self.share * np.maximum(np.abs(mean), np.maximum(spread, 1e-3))
        points = np.broadcast_to(mean, (1 + 2 * count, *mean.shape)).copy()
        for k in range(count):
            points[1 + k, ..., k] += steps[..., k]
            points[1 + count + k, ..., k] -= steps[..., k]
        dist, _ = self.model.evaluate(name, self._computed(state, name, points))
        node = self.model[name]
        centre, noise = moments(dist, len(node.event_shape), self.choices.get(name))
        lead = (len(points), *mean.shape[:-1])
        loc = self._spread_out(node, np.asarray(centre, dtype=float), lead, len(node.event_shape))
        loc = loc.reshape(*lead, size)
        slopes = np.zeros((*mean.shape[:-1], size, count))
        for k in range(count):
            rise = loc[1 + k] - loc[1 + count + k]
            rise = wrap_angle(rise) if node.angles is not None else rise
            slopes[..., k] = rise / (2 * steps[..., k, None])
        return loc[0], slopes, self._noise(node, noise, lead, size)

    def _noise(
        self, node: CompiledNode, noise: Any, lead: tuple[int, ...], size: int
    ) -> np.ndarray:
        """Covariance of a node given the block where that is expected."""
        inner = node.event_shape[-1] if node.event_shape else 1
        cov = self._spread_out(
            node, np.asarray(noise, dtype=float), lead, 2 * bool(node.event_shape)
        )
        cov = cov.reshape(*lead, size // inner, inner, inner)[0]
        if size == inner:  # of one element
            return cov[..., 0, :, :]
        full = np.zeros((*lead[1:], size // inner, inner, size // inner, inner))
        each = np.arange(size // inner)
        full[..., each, :, each, :] = np.moveaxis(cov, -3, 0)
        return full.reshape(*lead[1:], size, size)

    def _spread_out(
        self, node: CompiledNode, array: np.ndarray, lead: tuple[int, ...], event_ndim: int
    ) -> np.ndarray:
        """With all axes, plates apart right after the batch, shape ``(*lead, *other plates, *event)``."""
        event = array.shape[array.ndim - event_ndim :]
        batch = lead[: len(lead) - len(self.lead)]
        shape = (*batch, *node.plate_shape, *event)
        full = array if array.shape == shape else np.broadcast_to(array, shape)
        return np.moveaxis(full, *self._places(node, len(batch))[::-1]) if self.apart else full

    def _places(self, node: CompiledNode, first: int) -> tuple[list[int], list[int]]:
        """Where plates apart lie: after so many axes of the batch, and among the node's plates there."""
        own = [first + node.plates.index(p) for p in self.apart]
        return list(range(first, first + len(own))), own

    def _flat(
        self, node: CompiledNode, value: np.ndarray, lead: tuple[int, ...] | None = None
    ) -> np.ndarray:
        """A value, shape ``(*lead, numbers)``; ``lead`` ends in the plates apart, and is these by default."""
        lead = self.lead if lead is None else lead
        moved = self._spread_out(node, value, lead, len(node.event_shape))
        return moved.reshape(*lead, -1)

    def _split(self, joined: np.ndarray) -> dict[str, np.ndarray]:
        """Values of the block's nodes, ``(*batch, *plates, *event)``."""
        found, at = {}, 0
        batch = joined.shape[: joined.ndim - 1 - len(self.lead)]
        for name, size in zip(self.block, self.sizes, strict=True):
            node = self.model[name]
            plates = zip(node.plates, node.plate_shape, strict=True)
            others = [n for p, n in plates if p not in self.apart]
            part = joined[..., at : at + size]
            part = part.reshape(*batch, *self.lead, *others, *node.event_shape)
            at += size
            if self.apart:
                part = np.moveaxis(part, *self._places(node, len(batch)))
            part = np.ascontiguousarray(part)
            part.flags.writeable = False
            found[name] = part
        return found


def spread_varies(model: Model, order: Sequence[str], block: Sequence[str], name: str) -> bool:
    """Whether a block moves the variance of what is seen: then moments at one point do not describe it."""

    def find() -> bool:
        moved = dict(model.probe)
        for other in block:
            moved[other] = np.asarray(moved[other]) + 0.1 * (1 + np.abs(moved[other]))
        for other in _between(model, order, block, name):
            moved[other] = np.asarray(model.evaluate(other, moved)[0])
        dists = [model.evaluate(name, values)[0] for values in (model.probe, moved)]
        each = [spreads(dist, len(model[name].event_shape)) for dist in dists]
        return not all(np.allclose(a, b, equal_nan=True) for a, b in zip(*each, strict=True))

    return once(model, ("spread", name, tuple(block)), find)


# ---- private ------------------------------------------------------------------------------------


def _between(
    model: Model, order: Sequence[str], block: Sequence[str], name: str
) -> tuple[str, ...]:
    """What is computed from a block on the way to a node, parents first."""
    reached, above = set(block), {name}
    for other in order:
        if not model[other].is_stochastic and reached & set(model[other].parents):
            reached.add(other)
    for other in reversed(order):
        computed = other in reached and not model[other].is_stochastic
        if computed and any(other in model[n].parents for n in above):
            above.add(other)
    return tuple(n for n in order if n in above - {name})


def _times(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """``a @ b``; with one number between them, which is the common case, many times faster."""
    return a * b if a.shape[-1] == 1 else a @ b


def _applied(a: np.ndarray, x: np.ndarray) -> np.ndarray:
    return a[..., 0] * x if a.shape[-1] == 1 else np.matvec(a, x)


def _where_finite(values: np.ndarray) -> np.ndarray:
    """Zero where a moment is none: the weight makes up for whatever is drawn there."""
    good = np.isfinite(values)
    return values if good.all() else np.where(good, values, 0.0)


def _settled(cov: np.ndarray) -> np.ndarray:
    """A covariance that can be divided by."""
    spread = np.diagonal(cov, axis1=-2, axis2=-1)
    return cov + np.maximum(1e-14 * spread, 1e-300)[..., None] * np.eye(cov.shape[-1])


def _over_events(mask: np.ndarray, node: CompiledNode) -> np.ndarray:
    return mask.reshape(mask.shape + (1,) * (len(node.value_shape) - mask.ndim))


def _root(cov: np.ndarray) -> np.ndarray:
    """Lower Cholesky factors; rounding is made up for on the diagonal."""
    if cov.shape[-1] == 1:
        return np.sqrt(np.maximum(cov, 1e-300))
    try:
        return np.linalg.cholesky(cov)
    except np.linalg.LinAlgError:
        size = np.maximum(np.diagonal(cov, axis1=-2, axis2=-1), 1e-300)
        scale = np.sqrt(size)
        unit = cov / (scale[..., :, None] * scale[..., None, :])
        values, vectors = np.linalg.eigh(unit)
        fixed = (vectors * np.maximum(values, 1e-12)[..., None, :]) @ np.swapaxes(vectors, -1, -2)
        return scale[..., :, None] * np.linalg.cholesky(fixed)
