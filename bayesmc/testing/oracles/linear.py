"""Exact posteriors of conditional linear-Gaussian nets, read off their functions by calling them.

With the finite unknowns fixed, every hidden number is normal around something affine in the others. Each
function is called at zero and at unit vectors, which gives all coefficients; whitened residuals are then
one dense least-squares problem per configuration. That the functions are affine is not proved but
tried, at random points far and near and at draws from the answer itself. Nothing here is shared with
the exact engine: no tracing, no elimination, no Gaussian factors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution, MvNormal, Normal, marking_invalid
from bayesmc.errors import BudgetError, ParameterError, UnsupportedError, ZeroProbabilityError
from bayesmc.network import CompiledNode, Problem
from bayesmc.testing.oracles.conditional_gaussian import GaussianAnswer, PlainNode, Scalar, Variable
from bayesmc.testing.oracles.hidden import HiddenPart, needed_nodes

#: numbers that the arrays of an answer may hold
_MOST = 40_000_000
#: random points at which affine functions must be affine, and how far out they lie
_TRIALS = (0.3, 1.0, 1.0, 5.0, 30.0, 1000.0)
_DRAWS = 8
#: what differs by less, against the size of the terms, is affine
_TOLERANCE = 1e-8


def linear_posterior(problem: Problem, max_configurations: int = 4096) -> GaussianAnswer:
    """The exact posterior of a conditional linear-Gaussian net.

    Nodes that nothing observed depends on and that are not linear-Gaussian are left out, with what
    depends on them. Observed nodes may be of any family where their density does not depend on hidden
    numbers; observed numbers may enter functions in any way.

    Parameters
    ----------
    problem : Problem
        As ``bayesmc.network.pose`` makes it.
    max_configurations : int
        Joint states of the finite unknowns.

    Raises
    ------
    UnsupportedError
        Something that matters is not linear-Gaussian; the message names the node.
    BudgetError
        Too many configurations or numbers.
    ZeroProbabilityError
        No configuration explains the evidence.

    References
    ----------
    Lauritzen (1992), Propagation of probabilities, means and variances in mixed graphical association
    models, JASA 87.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.network import pose
    >>> from bayesmc.testing.oracles.linear import linear_posterior
    >>> net = bmc.BayesNet()
    >>> net.add("x", bmc.Normal(0.0, 1.0))
    >>> net.add("y", lambda x: bmc.Normal(2.0 * x + 1.0, 1.0))
    >>> answer = linear_posterior(pose(net, {"y": 2.0}))
    >>> float(answer.mean("x").round(12)), float(answer.var("x").round(12))
    (0.4, 0.2)
    """
    needed = needed_nodes(problem)
    read = set(problem.model.nodes)
    while True:
        try:
            return _solved(HiddenPart(problem, max_configurations, read), needed)
        except _NotLinearError as error:
            if error.node in needed or error.node in problem.observed:
                raise UnsupportedError(str(error)) from error
            read -= _with_descendants(problem, error.node)


# ---- private ------------------------------------------------------------------------------------


class _NotLinearError(Exception):
    def __init__(self, node: str, why: str) -> None:
        super().__init__(f"node {node!r} {why}")
        self.node = node


@dataclass(frozen=True, eq=False)
class _Read:
    """A net at some points: by configuration and point, whitened residuals ``(C, R, M)`` with the node of
    each; log densities that do not depend on the point, ``(C,)``; where parameters are bad, ``(C,)``; and the
    values of all nodes."""

    residuals: np.ndarray
    owners: list[str]
    log_density: np.ndarray
    bad: np.ndarray
    values: dict[str, np.ndarray]


def _with_descendants(problem: Problem, name: str) -> set[str]:
    found = {name}
    for child, node in problem.model.nodes.items():
        if found & set(node.parents):
            found.add(child)
    return found


def _solved(hidden: HiddenPart, needed: set[str]) -> GaussianAnswer:
    n, count = hidden.dimension, hidden.count
    rng = np.random.default_rng(20_012)
    trials = np.array(_TRIALS)[:, None] * rng.standard_normal((len(_TRIALS), n))
    points = np.concatenate([np.zeros((1, n)), np.eye(n), trials])
    _check_size(count * len(points) * hidden.weight + count * hidden.weight**2)
    found = _read(hidden, points[None])
    start, slopes = _affine(hidden, found, points[None])
    mean, root, log_evidence = _least_squares(start, slopes)
    log_weights = found.log_density + log_evidence
    total = float(np.logaddexp.reduce(log_weights))
    if total == -math.inf or np.isnan(total):
        raise ZeroProbabilityError("exact: the evidence has probability zero")
    if hidden.trouble is not None and (found.bad & (log_weights > -np.inf)).any():
        raise hidden.trouble
    draws = mean[:, None] + np.matvec(
        root[:, None],
        rng.standard_normal((count, _DRAWS, n)) if n else np.zeros((count, _DRAWS, 0)),
    )
    _affine(hidden, _read(hidden, draws), draws, (start, slopes), found)
    return _answer(hidden, found, mean, root, log_weights - total, total)


def _check_size(numbers: int) -> None:
    if numbers > _MOST:
        raise BudgetError(
            f"the dense answer would hold {numbers} numbers, more than {_MOST}; observe more, or take "
            "a smaller net",
            8 * numbers,
        )


def _read(hidden: HiddenPart, points: np.ndarray) -> _Read:
    """The net at points ``(1 or configurations, R, dimension)``."""
    states = {n: v[:, None] for n, v in hidden.states.items()}
    batch = (hidden.count, points.shape[1])
    values = {n: v[None, None] for n, v in hidden.problem.inputs.items()}
    rows: list[np.ndarray] = []
    owners: list[str] = []
    log_density: Any = np.zeros(hidden.count)
    bad = np.zeros(hidden.count, dtype=bool)
    with marking_invalid(), np.errstate(all="ignore"):
        for name, node in hidden.visited():
            dist, _ = hidden.model.evaluate(name, values)
            if not isinstance(dist, Distribution):
                values[name] = dist
                continue
            values[name], density, _ = hidden.weigh(node, dist, states, points)
            density = np.broadcast_to(density, batch)
            if dist.invalid is not None:
                hidden.trouble = ParameterError(f"node {name!r}: {dist.problem}")
                full = np.broadcast_to(dist.invalid, (*batch, *node.plate_shape))
                bad |= full.reshape(hidden.count, -1).any(axis=1)
            if not any(f.name == name for f in hidden.free) and _is_constant(density):
                log_density = log_density + density[:, 0]
                continue
            white, log_scale = _whitened(hidden, node, dist, values[name], batch)
            rows.append(white)
            owners += [name] * white.shape[-1]
            log_density = log_density - log_scale
        for name in hidden.model.potentials:
            density = np.broadcast_to(hidden.model.potential(name, values), batch)
            if not _is_constant(density):
                raise UnsupportedError(f"the potential {name!r} depends on hidden numbers")
            log_density = log_density + density[:, 0]
    residuals = np.concatenate([np.zeros((*batch, 0)), *rows], axis=-1)
    return _Read(residuals, owners, log_density, bad, values)


def _is_constant(density: np.ndarray) -> bool:
    """Whether log densities are the same at all points."""
    return bool(np.isclose(density, density[:, :1], rtol=1e-13, atol=1e-13).all())


def _whitened(
    hidden: HiddenPart,
    node: CompiledNode,
    dist: Distribution,
    value: np.ndarray,
    batch: tuple[int, int],
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals in standard deviations ``(C, R, m)``, and the log of what they were divided by ``(C,)``."""
    if not (type(dist) is Normal or type(dist) is MvNormal):
        raise _NotLinearError(
            node.name,
            f"is {type(dist).__name__}, no Normal or MvNormal, and is hidden or reads hidden numbers",
        )
    elements = math.prod(node.plate_shape)
    full = (*batch, *node.plate_shape)
    if isinstance(dist, Normal):
        off = np.broadcast_to(value - dist.loc, full)[..., None]
        scale = np.broadcast_to(dist.scale, full)[..., None, None]
    else:
        off = np.broadcast_to(value - dist.loc, full + node.event_shape)
        scale = np.broadcast_to(dist.scale_tril, full + node.event_shape * 2)
    off = off.reshape(*batch, elements, -1)
    scale = scale.reshape(*batch, elements, off.shape[-1], off.shape[-1])
    if node.name not in hidden.read:
        off, scale = (a[:, :, hidden.seen(node, elements)] for a in (off, scale))
    if not np.allclose(scale, scale[:, :1], rtol=1e-10, atol=0.0):
        raise _NotLinearError(node.name, "has a scale that depends on hidden numbers")
    scale = scale[:, :1]
    white = np.linalg.solve(scale, off[..., None])[..., 0]
    logs = np.log(np.diagonal(scale, axis1=-2, axis2=-1)) + 0.5 * math.log(2 * math.pi)
    return white.reshape(*batch, -1), logs.reshape(batch[0], -1).sum(axis=1)


def _affine(
    hidden: HiddenPart,
    found: _Read,
    points: np.ndarray,
    known: tuple[np.ndarray, np.ndarray] | None = None,
    base: _Read | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Intercepts ``(C, M)`` and slopes ``(C, M, n)`` of the residuals; refused where points disagree."""
    n = hidden.dimension
    start, slopes = _coefficients(found.residuals, n) if known is None else known
    owners = (found if base is None else base).owners
    _compare(found.residuals, start, slopes, points, owners, "its mean")
    base = found if base is None else base
    for name, node in hidden.visited():
        if node.is_stochastic:
            continue
        flat = _flat(hidden, found, name)
        if node.domain is not None:
            if (flat != flat[:, :1]).any():
                raise _NotLinearError(
                    name, "has finitely many values and depends on hidden numbers"
                )
            continue
        first, slope = _coefficients(_flat(hidden, base, name), n)
        _compare(flat, first, slope, points, [name] * flat.shape[-1], "its value")
    return start, slopes


def _flat(hidden: HiddenPart, found: _Read, name: str) -> np.ndarray:
    """A node's scalars by configuration and point, ``(C, R, scalars)``."""
    value = found.values[name]
    rows = found.residuals.shape[:2]
    full = np.broadcast_to(value, (*rows, *hidden.model[name].value_shape))
    return full.reshape(*rows, -1).astype(float)


def _coefficients(values: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    start = values[:, 0]
    return start, np.moveaxis(values[:, 1 : n + 1] - start[:, None], 1, -1)


def _compare(
    values: np.ndarray,
    start: np.ndarray,
    slopes: np.ndarray,
    points: np.ndarray,
    owners: Sequence[str],
    what: str,
) -> None:
    """Refuse values ``(C, R, m)`` that are not what intercepts and slopes say."""
    across = np.broadcast_to(points, (len(slopes), *points.shape[1:]))
    predicted = start[:, None] + across @ np.matrix_transpose(slopes)
    terms = np.abs(across) @ np.matrix_transpose(np.abs(slopes))
    near = np.abs(values - predicted) <= _TOLERANCE * (1.0 + np.abs(start)[:, None] + terms)
    if not near.all():
        column = int(np.argwhere(~near)[0][-1])
        raise _NotLinearError(
            owners[column], f"is not linear: {what} is no affine function of the hidden numbers"
        )


def _least_squares(
    start: np.ndarray, slopes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means ``(C, n)``, roots of the covariances ``(C, n, n)`` and log integrals of the Gaussians whose
    exponents are half the squared lengths of ``start + slopes @ h``."""
    n = slopes.shape[-1]
    q, r = np.linalg.qr(slopes)
    along = np.vecmat(start, q)
    mean = -np.linalg.solve(r, along[..., None])[..., 0] if n else along
    rest = start + np.matvec(slopes, mean)
    log_det = np.log(np.abs(np.diagonal(r, axis1=-2, axis2=-1))).sum(axis=-1)
    log_integral = -0.5 * np.vecdot(rest, rest) + 0.5 * n * math.log(2 * math.pi) - log_det
    return mean, np.linalg.inv(r), log_integral


def _answer(
    hidden: HiddenPart,
    found: _Read,
    mean: np.ndarray,
    root: np.ndarray,
    log_weights: np.ndarray,
    total: float,
) -> GaussianAnswer:
    """Every scalar as an affine function of the hidden numbers, in the words of `GaussianAnswer`."""
    nodes: dict[str, PlainNode] = {}
    states: dict[Variable, np.ndarray] = {}
    index: dict[Scalar, int] = {}
    firsts, slopes = [], []
    for name, node in hidden.visited():
        if name not in hidden.read and not hidden.seen(node, math.prod(node.plate_shape)).all():
            continue
        labels = node.domain.states if node.domain is not None else None
        nodes[name] = plain = PlainNode(
            name, node.plates, node.plate_shape, node.event_shape, labels
        )
        flat = _flat(hidden, found, name)
        if labels is not None:
            columns = flat[:, 0].astype(int)
            states.update({(name, e): columns[:, e] for e in range(plain.elements)})
            continue
        length = math.prod(node.event_shape)
        for place in range(flat.shape[-1]):
            index[name, place // length, place % length] = len(index)
        first, slope = _coefficients(flat, hidden.dimension)
        firsts.append(first)
        slopes.append(slope)
    count, n = hidden.count, hidden.dimension
    first = np.concatenate([np.zeros((count, 0)), *firsts], axis=1)
    slope = np.concatenate([np.zeros((count, 0, n)), *slopes], axis=1)
    wide = slope @ root
    return GaussianAnswer(
        hidden.model, nodes, total, np.exp(log_weights), states, index,
        first + np.matvec(slope, mean), wide @ np.matrix_transpose(wide),
    )  # fmt: skip
