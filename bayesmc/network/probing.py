"""Reachable values at which a node's function makes sense: ancestors drawn anew, nearer to their middle.

What overflows, or is out of range, at some draws of vague priors says nothing about the model; what is so at
all of them is the model's fault, and the caller raises it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.distributions.support import Support, is_half_line
from bayesmc.distributions.transforms import transform_of
from bayesmc.errors import BayesmcError, UnsupportedError
from bayesmc.network.model import CompiledNode, Model, invalid_error
from bayesmc.shapes import Shape, broadcasts_to, read_only

#: how far draws go from the prior's middle, one after the other
_SPREADS = (1.0, 0.3, 0.1, 0.03, 0.01, 1e-3)
#: draws of all ancestors at each of them
_DRAWS = 64
#: how often the nodes of one net are drawn anew, at most
_MOST = 16

#: the most that draws of a half line go from the middle
_FROM_ZERO = 0.9
#: supports that hold every point between two of theirs
_CONVEX = (
    "real",
    "interval",
    "simplex",
    "real vector",
    "positive definite",
    "correlation",
    "product",
    "increasing",
)


def made_possible(model: Model, node: CompiledNode, result: Any, batch: Shape) -> bool:
    """Whether, where a function goes wrong on the probe, it does not at other draws, which take their place.

    Configurations of finite parents that are out of range stay the model's fault.
    """
    plates = node.plate_shape
    if not batch or not depends_on_numbers(model, node):
        return False
    if isinstance(result, Distribution) and not broadcasts_to(result.batch_shape, batch + plates):
        return False
    try:
        wrong = wrong_elements(result, batch, plates).any()
    except ValueError:  # a shape that does not fit is refused in its own words
        return False
    if not wrong or (isinstance(result, Distribution) and result.problem.is_overflow):  # type: ignore[union-attr]
        return False
    anew = model.cache["drawn anew"] = model.cache.get("drawn anew", 0) + 1
    if anew > _MOST:
        return not wrong_elements(result, batch, plates).all(axis=tuple(range(len(batch)))).any()
    return _drawn_anew(model, node, result, batch, np.random.default_rng([20, anew]))


def depends_on_numbers(model: Model, node: CompiledNode) -> bool:
    """Whether a node depends, through deterministic ones as well, on one that is not finite."""
    parents: Iterable[str] = node.parents
    if any(model[name].kind == "deterministic" for name in parents):
        parents = model.above(parents, lambda name: model[name].kind == "deterministic")
    return any(model[name].is_stochastic and model[name].domain is None for name in parents)


def wrong_elements(result: Any, batch: Shape, plates: Shape) -> np.ndarray:
    """Where a function's result has parameters out of range, or is NaN, shape ``batch + plates``."""
    shape = batch + plates
    if isinstance(result, Distribution):
        invalid = False if result.invalid is None else result.invalid
        return np.broadcast_to(invalid, shape)
    array = np.asarray(result)
    if array.dtype.kind != "f":
        return np.zeros(shape, dtype=bool)
    axes = tuple(range(len(shape), array.ndim))
    return np.broadcast_to(np.isnan(array).any(axis=axes), shape)


def nearer(
    dist: Distribution, draws: np.ndarray, spread: float, shape: Shape, event_ndim: int
) -> np.ndarray:
    """Draws moved towards the middle of a distribution, where the support holds what lies between.

    Parameters
    ----------
    draws : ndarray, shape ``shape``
    spread : float
        How much of their distance to the middle is left, 0 to 1.
    event_ndim : int
        Number of the last axes that are one value's.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.network.probing import nearer
    >>> nearer(bmc.Normal(1.0, 100.0), np.array([-99.0, 201.0]), 0.01, (2,), 0).tolist()
    [0.0, 3.0]
    """
    if dist.support.kind not in _CONVEX:
        return draws
    half_line = dist.support.kind == "interval" and is_half_line(dist.support)
    if half_line:  # a vague scale is drawn at 1e-200 as likely as not, and a chain never comes back
        spread = min(spread, _FROM_ZERO)
    if spread == 1.0:
        return draws
    middle = middle_of(dist, shape)
    axes = tuple(range(len(shape) - event_ndim, len(shape)))
    fine = np.isfinite(middle).all(axis=axes, keepdims=True)
    moved = middle + max(spread, 1e-9) * (np.where(np.isfinite(draws), draws, middle) - middle)
    return np.where(fine, moved, draws)


def middle_of(dist: Distribution, shape: Shape) -> np.ndarray:
    """The prior mean, else the median, else one above a half line's end; NaN where nothing is known."""
    half_line = dist.support.kind == "interval" and is_half_line(dist.support)
    found = np.full(shape, dist.support.low + 1.0 if half_line else np.nan)
    for question in (lambda: dist.ppf(0.5), lambda: dist.mean):
        try:
            answer = np.broadcast_to(question(), shape)
        except (UnsupportedError, ValueError):
            continue
        sane = np.isfinite(answer)
        if half_line:
            sane &= (answer < 1e10) & (answer > 1e-10)
        found = np.where(sane, answer, found)
    return found


def reachable(
    node: CompiledNode, dist: Distribution, batch: Shape, count: int, rng: np.random.Generator
) -> np.ndarray:
    """Distinct values of positive density: states in turn for finite nodes, draws for all others."""
    lead = batch + node.plate_shape
    if node.domain is not None:
        table = dist.probs_table
        assert table is not None
        possible = np.broadcast_to(table > 0, (*lead, node.domain.size))
        rank = np.cumsum(possible, axis=-1)
        turn = (np.arange(math.prod(lead)).reshape(lead) + count) % np.maximum(rank[..., -1], 1)
        return np.argmax(rank > turn[..., None], axis=-1).astype(node.domain.dtype)
    try:
        return np.asarray(dist.sample_to(rng, lead))
    except BayesmcError:
        return _point_in(dist.support, lead, dist.event_shape, rng)


def refuse_parameters(
    node: CompiledNode, dist: Distribution, probe: Mapping[str, np.ndarray], batch: Shape
) -> None:
    """Raise for parameters out of range, unless they over- or underflowed, as vague priors make them:
    for some draws of the parents, or for all of those tried where the arithmetic says so itself (then they
    may be NaN as well).
    """
    bad = invalid_error(node, dist, np.ones(batch, dtype=bool), batch, noiseless=True)
    if bad is None:
        return
    assert dist.invalid is not None and dist.problem is not None
    full = np.broadcast_to(dist.invalid, batch + node.plate_shape).reshape(math.prod(batch), -1)
    if dist.problem.is_overflow and not full.all(axis=0).any():
        return
    if not dist.problem.has_grown or not overflows(node, probe):
        raise bad


def overflows(node: CompiledNode, probe: Mapping[str, np.ndarray]) -> bool:
    """Whether a parent is infinite already, or the function's arithmetic over- or underflows on them."""
    numbers = [probe[name] for name in node.parents if probe[name].dtype != object]
    if any(np.isinf(value.astype(float)).any() for value in numbers):
        return True
    try:
        with np.errstate(over="raise", under="raise"):
            node.called(probe)
    except BayesmcError as error:
        return isinstance(error.__cause__, FloatingPointError)
    return False


def entry(
    node: CompiledNode, probe: Mapping[str, np.ndarray], shape: Shape, index: Shape | None = None
) -> dict[str, np.ndarray]:
    """The parents' values at one entry (the first) of the probe's broadcast batch, without batch axes."""
    picked = {}
    index = (0,) * len(shape) if index is None else index
    for parent, link in node.links:
        value = probe[parent]
        batch = link.batch_shape(value)
        own = index[len(shape) - len(batch) :]
        at: tuple[Any, ...] = tuple(i if n > 1 else 0 for i, n in zip(own, batch, strict=True))
        picked[parent] = value[(*at, Ellipsis)]  # an array still, also without axes
    return picked


# ---- private ------------------------------------------------------------------------------------


def _drawn_anew(
    model: Model, node: CompiledNode, result: Any, batch: Shape, rng: np.random.Generator
) -> bool:
    """Replace, in the probe, what a function cannot take by other draws; whether it can take any at all.

    Parameters
    ----------
    model : Model
        All nodes before this one; its ``probe`` is changed.
    result : object
        What the function made of the probe.
    batch : tuple of int
        Batch of its parents.

    Returns
    -------
    bool
        For every plate element some draw is in range.
    """
    lead = tuple(range(len(batch)))
    wrong = wrong_elements(result, batch, node.plate_shape)
    fine = ~wrong.all(axis=lead)
    rows = wrong.any(axis=tuple(range(len(batch), wrong.ndim)))
    bad = np.broadcast_to(rows, model.probe_shape).copy()
    for pool, sound in _pools(model, rng):
        found = _tried(node, pool)
        if found is None:
            continue
        fine = fine | ~found.all(axis=0)
        good = np.flatnonzero(sound & ~found.reshape(_DRAWS, -1).any(axis=1))
        at = np.argwhere(bad)[: len(good)]
        if len(at):
            _replaced(model, pool, good[: len(at)], tuple(at.T))
            bad[tuple(at.T)] = False
        if not bad.any():
            break
    return bool(fine.all())


def _pools(
    model: Model, rng: np.random.Generator
) -> Iterator[tuple[dict[str, np.ndarray], np.ndarray]]:
    """Joint draws of all nodes so far, ``(_DRAWS, *plates, *event)``, nearer and nearer to the middle.

    With each, which of the draws are such that nothing above them is out of range.
    """
    for spread in _SPREADS:
        values: dict[str, np.ndarray] = {}
        sound = np.ones(_DRAWS, dtype=bool)
        try:
            for name, node in model.nodes.items():
                if node.kind in ("input", "fixed"):
                    values[name] = model.probe[name]
                    continue
                result, batch = model.evaluate(name, values)
                wrong = wrong_elements(result, batch, node.plate_shape)
                sound = sound & ~wrong.any(axis=tuple(range(len(batch), wrong.ndim)))
                values[name] = _value(model, node, result, spread, rng)
        except BayesmcError:
            continue
        yield values, sound


def _value(
    model: Model, node: CompiledNode, result: Any, spread: float, rng: np.random.Generator
) -> np.ndarray:
    if not node.is_stochastic:
        return np.asarray(result)
    if node.unsampled:  # some of the values that it was tried on
        old = model.probe[node.name].reshape(-1, *node.value_shape)
        return old[rng.integers(len(old), size=_DRAWS)]
    draws = model.sample_stored(node.name, result, rng, (_DRAWS,))
    if node.domain is not None or node.is_discrete:
        return draws
    return nearer(result, draws, spread, (_DRAWS, *node.value_shape), len(node.event_shape))


def _tried(node: CompiledNode, pool: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """Where a function goes wrong on a pool, shape ``(_DRAWS, *plates)``; None where it fails."""
    try:
        found = wrong_elements(*node.called(pool), node.plate_shape)
    except (BayesmcError, ValueError):
        return None
    return np.broadcast_to(found, (_DRAWS, *node.plate_shape))


def _replaced(
    model: Model, pool: Mapping[str, np.ndarray], rows: np.ndarray, at: tuple[np.ndarray, ...]
) -> None:
    """Put rows of a pool into the probe; computed nodes follow."""
    for name, node in model.nodes.items():
        old = model.probe[name]
        if node.is_stochastic:
            new = np.array(old)
            new[at] = np.broadcast_to(pool[name], (_DRAWS, *node.value_shape))[rows]
            model.probe[name] = read_only(new)
        elif node.kind == "deterministic":
            value, _ = model.evaluate(name, model.probe)
            model.probe[name] = read_only(np.broadcast_to(value, old.shape))


def _point_in(support: Support, lead: Shape, event: Shape, rng: np.random.Generator) -> np.ndarray:
    """Some points of a support, for densities that cannot be sampled from."""
    shape = lead + event
    if not support.is_discrete:
        transform = transform_of(support, event)
        free = rng.uniform(-1.0, 1.0, lead + transform.unconstrained_shape)
        return np.broadcast_to(transform.constrain(free), shape)
    low, high = np.asarray(support.low, dtype=float), np.asarray(support.high, dtype=float)
    u = 0.2 + 0.6 * rng.random(shape)
    with np.errstate(invalid="ignore"):
        value = np.where(np.isfinite(low), low + u, np.where(np.isfinite(high), high - u, u))
        value = np.where(np.isfinite(low) & np.isfinite(high), low + u * (high - low), value)
    return np.broadcast_to(np.floor(value), shape)
