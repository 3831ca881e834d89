"""What of a node can be looked at before it is drawn or weighed: moments, components, or its log density.

Gaussian nodes, and those on a circle, are described by their moments, to rounding where means are affine. A
mixture of Gaussians is as many Gaussians as it has components. Any other seen node is described by the first
two derivatives of its log density (``curved``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.distributions import (
    DiscreteUniform,
    Distribution,
    Laplace,
    Mixture,
    MvNormal,
    Normal,
    Uniform,
    VonMises,
    WrappedNormal,
)
from bayesmc.errors import BayesmcError
from bayesmc.network import CompiledNode, Model, Observed

#: states of a finite node that a mean and a variance describe
_TWO = 2
#: components of all mixtures of a block together, up to which each combination is looked at
CASES = 16
#: numbers in which derivatives of a log density are taken, at most
NUMBERS = 6
_GAUSSIAN = (Normal, MvNormal)
#: families that moments describe better than derivatives: Gaussian ones, those on a circle, and those whose
#: log density has no curvature
_BY_MOMENTS = (*_GAUSSIAN, VonMises, WrappedNormal, Uniform, Laplace)


def family_of(model: Model, name: str) -> type[Distribution]:
    """The family that a node's function returns."""
    return once(model, ("family", name), lambda: type(_probed(model, name)))


def is_gaussian(model: Model, name: str) -> bool:
    """Whether a node is Normal or MvNormal."""
    return issubclass(family_of(model, name), _GAUSSIAN)


def is_of_components(model: Model, name: str) -> bool:
    """Whether a node is a mixture whose components have moments each: of numbers, or of MvNormals."""

    def find() -> bool:
        dist = _probed(model, name)
        if not isinstance(dist, Mixture) or dist.is_discrete:
            return False
        listed = isinstance(dist.components, (list, tuple))
        parts = dist.components if listed else [dist.components]
        if model[name].event_shape:
            return all(isinstance(part, MvNormal) for part in parts)
        return all(_has_moments(part, 0) for part in parts)

    return once(model, ("mixture", name), find)


def components_of(model: Model, name: str, apart: Sequence[str]) -> int:
    """Components of a mixture that are looked at one by one; 1 for all other nodes.

    The elements of a plate that are filtered together would choose in too many ways.
    """
    if not set(model[name].plates) <= set(apart) or not is_of_components(model, name):
        return 1
    return once(model, ("components", name), lambda: int(_probed(model, name).weights.shape[-1]))


def moments(dist: Any, event_ndim: int, choice: int | None = None) -> tuple[Any, Any]:
    """Mean, and variance or covariance, of a distribution or of one component of a mixture."""
    if choice is None and event_ndim and isinstance(dist, Mixture):
        return _moments_together(dist)
    if choice is None:
        return dist.mean, dist.cov if event_ndim else dist.var
    parts = dist.components
    if isinstance(parts, (list, tuple)):
        part = parts[choice]
        return part.mean, part.cov if event_ndim else part.var
    shape = parts.batch_shape
    mean = np.broadcast_to(parts.mean, shape + parts.event_shape)
    if not event_ndim:
        return mean[..., choice], np.broadcast_to(parts.var, shape)[..., choice]
    cov = np.broadcast_to(parts.cov, shape + parts.event_shape * 2)
    return mean[..., choice, :], cov[..., choice, :, :]


def spreads(dist: Any, event_ndim: int) -> list[np.ndarray]:
    """Variances or covariances: of a distribution, or of each component of a mixture."""
    choices = range(dist.weights.shape[-1]) if isinstance(dist, Mixture) else [None]
    return [np.asarray(moments(dist, event_ndim, k)[1]) for k in choices]


def has_moments(model: Model, name: str) -> bool:
    """Whether a node has a mean and a variance that say where its value is."""

    def find() -> bool:
        node = model[name]
        if node.domain is not None and node.domain.size > _TWO:
            return False
        return _has_moments(_probed(model, name), len(node.event_shape))

    return once(model, ("moments", name), find)


def by_moments(model: Model, name: str) -> bool:
    """Whether a seen node is described by its moments rather than by derivatives of its log density."""
    return issubclass(family_of(model, name), _BY_MOMENTS) and has_moments(model, name)


def numbers_of(model: Model, name: str, apart: Sequence[str]) -> int:
    """How many numbers a node has in each element of the plates apart."""
    node = model[name]
    sizes = zip(node.plates, node.plate_shape, strict=True)
    return math.prod(n for p, n in sizes if p not in apart) * math.prod(node.event_shape)


def why_not_drawn(model: Model, name: str) -> str | None:
    """Why a hidden node cannot be drawn with a look at what is seen, or None.

    What can is taken as Gaussian given its parents, by its mean and variance; its weight makes up for that.
    """
    node = model[name]
    if node.domain is not None or node.is_discrete:
        return "it is finite" if node.domain is not None else "its values are whole numbers"
    if is_gaussian(model, name):
        return None
    family = family_of(model, name).__name__
    if node.angles is not None:
        return f"{family} lies on a circle"
    vector = bool(node.event_shape) and not is_of_components(model, name)
    if vector or not has_moments(model, name):
        return (
            f"{family} has no mean and {'covariance' if node.event_shape else 'variance'} to go by"
        )
    return None


def why_not_looked_at(model: Model, name: str) -> str | None:
    """Why a seen node tells nothing of the hidden numbers that it depends on, or None."""
    if issubclass(family_of(model, name), DiscreteUniform):
        return "DiscreteUniform has a flat density, which no derivative sees"
    return None


def once(model: Model, key: Any, find: Callable[[], Any]) -> Any:
    """What was found of a model before, or is found now: rows with gaps have their steps built anew."""
    kept = model.cache.setdefault("looking ahead", {})
    if key not in kept:
        kept[key] = find()
    return kept[key]


def mask_of(seen: Observed) -> np.ndarray | None:
    """What is seen of a node: None for all, a mask of elements, or of components where some miss a few."""
    if seen.parts is None:
        return seen.mask
    assert seen.mask is not None
    return np.asarray(seen.mask[..., None] | seen.parts)


def elements_seen(
    mask: np.ndarray | None, node: CompiledNode, which: Callable[..., Any] = np.all
) -> np.ndarray | None:
    """Elements of which all components are seen, or any with ``np.any``, by what ``mask_of`` says."""
    if mask is None or mask.ndim == len(node.plates):
        return mask
    return np.asarray(which(mask, axis=tuple(range(len(node.plates), mask.ndim))))


def density_at(
    model: Model, name: str, values: Mapping[str, np.ndarray], mask: np.ndarray | None
) -> np.ndarray:
    """A seen node's log density, shape ``(*batch, *plates)``; minus infinity where it is not defined."""
    node = model[name]
    dist, batch = model.evaluate(name, values)
    stored = values[name]
    value = node.domain.to_support(stored) if node.domain is not None else stored
    with np.errstate(all="ignore"):
        log = np.asarray(dist.log_prob_unchecked(np.asarray(value)), dtype=float)
    log = np.where(np.isfinite(log), log, -np.inf)
    if dist.invalid is not None:
        log = np.where(dist.invalid, -np.inf, log)
    if mask is not None:
        log = np.where(mask, log, 0.0)
    return log


# ---- private ------------------------------------------------------------------------------------


def _has_moments(dist: Any, event_ndim: int) -> bool:
    try:
        mean, spread = moments(dist, event_ndim)
        return bool(np.isfinite(np.asarray(mean)).all() and np.isfinite(spread).all())
    except (BayesmcError, AttributeError, NotImplementedError):
        return False


def _moments_together(dist: Mixture) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of a mixture of vectors."""
    each = [moments(dist, 1, k) for k in range(dist.weights.shape[-1])]
    weights = [dist.weights[..., k, None] for k in range(len(each))]
    centre = sum(w * m for w, (m, _) in zip(weights, each, strict=True))
    cov: Any = 0.0
    for w, (m, c) in zip(weights, each, strict=True):
        off = m - centre
        cov = cov + w[..., None] * (c + off[..., :, None] * off[..., None, :])
    return np.asarray(centre), cov


def _probed(model: Model, name: str) -> Any:
    return model.evaluate(name, model.probe)[0]
