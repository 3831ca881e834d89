"""Factors that were found, as distributions: drawn from, weighed, and asked in closed form."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from bayesmc.distributions import (
    Beta,
    Dirichlet,
    Gamma,
    InverseGamma,
    InverseWishart,
    StudentT,
    Wishart,
)
from bayesmc.distributions.transforms import Bounded, Identity
from bayesmc.engines.approximate.approximation import Marginal
from bayesmc.engines.approximate.free_gaussian import BoundedMarginal, NormalMarginal
from bayesmc.engines.variational.factors import (
    Factor,
    NormalFactor,
    ScatterFactor,
    ShareFactor,
    State,
    TableFactor,
)
from bayesmc.engines.variational.free import FreeFactor
from bayesmc.errors import UnsupportedError
from bayesmc.structure.target import Target, Values

_LOG_2PI = math.log(2 * math.pi)


class Part(Protocol):
    """One factor as a distribution."""

    @property
    def names(self) -> tuple[str, ...]: ...

    def draw(self, rng: np.random.Generator, draws: int) -> tuple[Values, np.ndarray]:
        """Stored values of its nodes, and the log density of each draw."""
        ...

    def log_density(self, values: Values) -> np.ndarray:
        """The log density of stored values, shape (draws,)."""
        ...

    def marginal(self, name: str) -> Marginal | None: ...
    def moments(self, name: str) -> tuple[np.ndarray, np.ndarray] | None:
        """Means and variances, where quantiles have no closed form."""
        ...

    def covariance(self, name: str) -> np.ndarray | None: ...


@dataclass(frozen=True, eq=False)
class Known:
    """Elements that were seen, and their values; none by default."""

    mask: np.ndarray | None = None
    value: np.ndarray | None = None

    def put(self, drawn: np.ndarray, inner: int = 0) -> np.ndarray:
        """Values with what was seen in its place; ``inner`` axes are inside an element."""
        if self.mask is None or self.value is None:
            return drawn
        return np.where(self.mask.reshape(self.mask.shape + (1,) * inner), self.value, drawn)

    def total(self, logs: np.ndarray) -> np.ndarray:
        """Log densities ``(draws, *plates)`` added up over elements that were not seen."""
        logs = logs if self.mask is None else np.where(self.mask, 0.0, logs)
        return logs.reshape(len(logs), -1).sum(axis=1)


@dataclass(frozen=True, eq=False)
class NormalPart:
    """Normal numbers, in groups."""

    names: tuple[str, ...]
    mean: np.ndarray
    cov: np.ndarray
    seen: np.ndarray | None

    def draw(self, rng: np.random.Generator, draws: int) -> tuple[Values, np.ndarray]:
        groups, w = self.cov.shape[:2]
        free = np.ones((groups, w)) if self.seen is None else (~self.seen).reshape(groups, w) * 1.0
        root = np.linalg.cholesky(self.cov + (1.0 - free)[:, :, None] * np.eye(w))
        z = rng.standard_normal((draws, groups, w)) * free
        value = self.mean + np.matvec(root, z).reshape(draws, *self.mean.shape)
        diagonal = np.log(np.linalg.diagonal(root)) * free
        log = -0.5 * (z**2 + _LOG_2PI * free).sum(axis=(1, 2)) - diagonal.sum()
        return {self.names[0]: value}, log

    def log_density(self, values: Values) -> np.ndarray:
        groups, w = self.cov.shape[:2]
        free = np.ones((groups, w)) if self.seen is None else (~self.seen).reshape(groups, w) * 1.0
        root = np.linalg.cholesky(self.cov + (1.0 - free)[:, :, None] * np.eye(w))
        away = (values[self.names[0]] - self.mean).reshape(-1, groups, w) * free
        z = np.linalg.solve(root, away[..., None])[..., 0]
        diagonal = np.log(np.linalg.diagonal(root)) * free
        return -0.5 * (z**2 + _LOG_2PI * free).sum(axis=(1, 2)) - diagonal.sum()

    def marginal(self, name: str) -> Marginal | None:
        var = np.linalg.diagonal(self.cov).reshape(self.mean.shape)
        return NormalMarginal(self.mean, var)

    def moments(self, name: str) -> tuple[np.ndarray, np.ndarray] | None:
        return None

    def covariance(self, name: str) -> np.ndarray | None:
        groups, w = self.cov.shape[:2]
        found = np.zeros((groups, w, groups, w))
        at = np.arange(groups)
        found[at, :, at, :] = self.cov
        return found.reshape(groups * w, groups * w)


@dataclass(frozen=True, eq=False)
class ScatterPart:
    """A gamma or Wishart precision, or its inverse, with a mean that is normal given it."""

    names: tuple[str, ...]
    own: str
    is_matrix: bool
    is_inverse: bool
    df: np.ndarray
    inverse_scale: np.ndarray
    known: Known
    location: np.ndarray | None = None
    spread: np.ndarray | None = None

    @property
    def distribution(self) -> Any:
        if self.is_matrix:
            if self.is_inverse:
                return InverseWishart(self.df, self.inverse_scale)
            return Wishart(self.df, np.linalg.inv(self.inverse_scale))
        rate = 0.5 * self.inverse_scale[..., 0, 0]
        return (InverseGamma if self.is_inverse else Gamma)(0.5 * self.df, rate)

    def draw(self, rng: np.random.Generator, draws: int) -> tuple[Values, np.ndarray]:
        family = self.distribution
        value = family.sample_to(rng, (draws, *self.df.shape))
        with np.errstate(all="ignore"):
            log = self.known.total(family.log_prob(value))
        found = {self.own: self.known.put(value, 2 if self.is_matrix else 0)}
        if self.location is None or self.spread is None:
            return found, log
        d = self.inverse_scale.shape[-1]
        cov = value if self.is_matrix else value[..., None, None]
        cov = cov if self.is_inverse else np.linalg.inv(cov)
        root = np.linalg.cholesky(cov * self.spread[..., None, None])
        z = rng.standard_normal((draws, *self.df.shape, d))
        away = np.matvec(root, z).reshape(draws, *self.location.shape)
        found[self.names[0]] = self.location + away
        each = -0.5 * (z**2 + _LOG_2PI) - np.log(np.linalg.diagonal(root))
        return found, log + each.reshape(draws, -1).sum(axis=1)

    def log_density(self, values: Values) -> np.ndarray:
        value = values[self.own]
        with np.errstate(all="ignore"):
            log = self.known.total(self.distribution.log_prob(value))
        if self.location is None or self.spread is None:
            return log
        cov = value if self.is_matrix else value[..., None, None]
        cov = (cov if self.is_inverse else np.linalg.inv(cov)) * self.spread[..., None, None]
        away = (values[self.names[0]] - self.location).reshape(*cov.shape[:-1])
        root = np.linalg.cholesky(cov)
        z = np.linalg.solve(root, away[..., None])[..., 0]
        each = -0.5 * (z**2 + _LOG_2PI) - np.log(np.linalg.diagonal(root))
        return log + each.reshape(len(log), -1).sum(axis=1)

    def marginal(self, name: str) -> Marginal | None:
        if name != self.own:
            return self._location()
        return None if self.is_matrix or self.known.mask is not None else self.distribution

    def moments(self, name: str) -> tuple[np.ndarray, np.ndarray] | None:
        if name != self.own:
            return None
        family, inner = self.distribution, 2 if self.is_matrix else 0
        var = family.var
        if self.known.mask is not None:
            var = np.where(self.known.mask.reshape(self.known.mask.shape + (1,) * inner), 0.0, var)
        return self.known.put(family.mean, inner), var

    def covariance(self, name: str) -> np.ndarray | None:
        return None

    def _location(self) -> Marginal:
        """Student's t, component by component."""
        assert self.location is not None and self.spread is not None
        d = self.inverse_scale.shape[-1]
        df = self.df - d + 1.0
        square = np.linalg.diagonal(self.inverse_scale) * (self.spread / df)[..., None]
        df = np.broadcast_to(df[..., None], square.shape)
        shape = self.location.shape
        return StudentT(df.reshape(shape), self.location, np.sqrt(square).reshape(shape))


@dataclass(frozen=True, eq=False)
class SharePart:
    """Beta or Dirichlet probabilities."""

    names: tuple[str, ...]
    concentration: np.ndarray
    is_simplex: bool
    known: Known

    @property
    def distribution(self) -> Any:
        a = self.concentration
        return Dirichlet(a) if self.is_simplex else Beta(a[..., 0], a[..., 1])

    def draw(self, rng: np.random.Generator, draws: int) -> tuple[Values, np.ndarray]:
        family = self.distribution
        value = family.sample_to(rng, (draws, *self.concentration.shape[:-1]))
        with np.errstate(all="ignore"):
            log = self.known.total(family.log_prob(value))
        return {self.names[0]: self.known.put(value, int(self.is_simplex))}, log

    def log_density(self, values: Values) -> np.ndarray:
        with np.errstate(all="ignore"):
            return self.known.total(self.distribution.log_prob(values[self.names[0]]))

    def marginal(self, name: str) -> Marginal | None:
        if self.known.mask is not None:
            return None
        a = self.concentration
        if not self.is_simplex:
            return self.distribution
        if a.shape[-1] == 1:
            return None
        return Beta(a, a.sum(axis=-1, keepdims=True) - a)

    def moments(self, name: str) -> tuple[np.ndarray, np.ndarray] | None:
        family, inner = self.distribution, int(self.is_simplex)
        var = family.var
        if self.known.mask is not None:
            var = np.where(self.known.mask.reshape(self.known.mask.shape + (1,) * inner), 0.0, var)
        return self.known.put(family.mean, inner), var

    def covariance(self, name: str) -> np.ndarray | None:
        return None


@dataclass(frozen=True, eq=False)
class TablePart:
    """Tables of joint states, shape (states, *plates)."""

    names: tuple[str, ...]
    table: np.ndarray
    sizes: tuple[int, ...]
    dtypes: tuple[np.dtype, ...]
    seen: np.ndarray | None = None

    def draw(self, rng: np.random.Generator, draws: int) -> tuple[Values, np.ndarray]:
        levels = np.cumsum(self.table, axis=0)
        levels /= levels[-1]
        shape = self.table.shape[1:]
        u = rng.random((draws, *shape))
        state = np.zeros((draws, *shape), np.intp)
        for level in levels[:-1]:
            state += u >= level
        with np.errstate(divide="ignore"):
            logs = np.log(self.table)
        log = np.take_along_axis(logs[None], state[:, None], axis=1)[:, 0]
        each = np.unravel_index(state, self.sizes)
        values = {
            name: own.astype(dtype)
            for name, own, dtype in zip(self.names, each, self.dtypes, strict=True)
        }
        return values, log.reshape(draws, -1).sum(axis=1)

    def log_density(self, values: Values) -> np.ndarray:
        states = tuple(values[name].astype(np.intp) for name in self.names)
        state = np.ravel_multi_index(states, self.sizes)
        with np.errstate(divide="ignore"):
            logs = np.log(self.table / self.table.sum(axis=0))
        log = np.take_along_axis(logs[None], state[:, None], axis=1)[:, 0]
        return log.reshape(len(log), -1).sum(axis=1)

    def probabilities(self, name: str) -> np.ndarray:
        """Of one node, shape (*plates, states)."""
        whole = self.table.reshape(*self.sizes, *self.table.shape[1:])
        others = tuple(k for k, n in enumerate(self.names) if n != name)
        return np.moveaxis(whole.sum(axis=others), 0, -1)

    def marginal(self, name: str) -> Marginal | None:
        return None

    def moments(self, name: str) -> tuple[np.ndarray, np.ndarray] | None:
        return None

    def covariance(self, name: str) -> np.ndarray | None:
        return None


@dataclass(eq=False)
class FreePart:
    """Numbers that are normal in unconstrained coordinates."""

    names: tuple[str, ...]
    mean: np.ndarray
    root: np.ndarray
    factor: FreeFactor | None = field(repr=False)
    closed: dict[str, Any] = field(default_factory=dict)

    def draw(self, rng: np.random.Generator, draws: int) -> tuple[Values, np.ndarray]:
        if self.factor is None:
            raise UnsupportedError(
                "this approximation was loaded or unpickled, and files and pickles carry no functions; "
                "call infer again, or draw before"
            )
        z = rng.standard_normal((draws, len(self.mean)))
        full = self.root.ndim == 2
        u = self.mean + (z @ self.root.T if full else z * self.root)
        diagonal = np.diagonal(self.root) if full else self.root
        log = -0.5 * (z**2 + _LOG_2PI).sum(axis=1) - np.log(np.abs(diagonal)).sum()
        with np.errstate(all="ignore"):
            log = log - self.factor.log_volume(u, self.factor.target.known)
            values = self.factor.constrained(u, self.factor.target.known)
        return values, log

    def log_density(self, values: Values) -> np.ndarray:
        assert self.factor is not None
        known = self.factor.target.known
        with np.errstate(all="ignore"):
            u = self.factor.freed({**known, **values})
            away = u - self.mean
            full = self.root.ndim == 2
            z = np.linalg.solve(self.root, away.T).T if full else away / self.root
            diagonal = np.diagonal(self.root) if full else self.root
            log = -0.5 * (z**2 + _LOG_2PI).sum(axis=1) - np.log(np.abs(diagonal)).sum()
            return log - self.factor.log_volume(u, known)

    def marginal(self, name: str) -> Marginal | None:
        if name not in self.closed:
            self.closed[name] = self._marginal(name)
        return self.closed[name]

    def _marginal(self, name: str) -> Marginal | None:
        if self.factor is None:
            return None
        node = next(n for n in self.factor.nodes if n.name == name)
        if node.elements is not None:
            return None
        shape, at = node.node.value_shape, slice(node.start, node.start + node.size)
        square = (self.root**2).sum(axis=1) if self.root.ndim == 2 else self.root**2
        if isinstance(node.transform, Identity):
            return NormalMarginal(self.mean[at].reshape(shape), square[at].reshape(shape))
        if isinstance(node.transform, Bounded) and not node.node.event_shape:
            low, high = (
                np.broadcast_to(b, shape) for b in (node.transform.low, node.transform.high)
            )
            scale = np.sqrt(square[at]).reshape(shape)
            return BoundedMarginal(self.mean[at].reshape(shape), scale, low, high)
        return None

    def moments(self, name: str) -> tuple[np.ndarray, np.ndarray] | None:
        return None

    def covariance(self, name: str) -> np.ndarray | None:
        return None

    def __getstate__(self) -> dict[str, Any]:
        """Pickles travel without functions: with the answers that are closed."""
        for name in self.names:
            self.marginal(name)
        return {**self.__dict__, "factor": None}


def part_of(factor: Factor, state: State, target: Target) -> Part:
    """A factor that was found as a distribution.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.engines.variational.parts import SharePart, Known
    >>> part = SharePart(("p",), np.array([3.0, 1.0]), False, Known())
    >>> float(part.marginal("p").mean)
    0.75
    """
    if isinstance(factor, FreeFactor):
        return FreePart(factor.names, factor.mean, factor.root, factor)
    if isinstance(factor, NormalFactor):
        return NormalPart(factor.names, state[factor.mean], state[factor.cov], factor.seen)
    if isinstance(factor, TableFactor):
        domains = [target.model[name].domain for name in factor.names]
        dtypes = tuple(d.dtype for d in domains if d is not None)
        return TablePart(factor.names, state[factor.table], factor.sizes, dtypes, factor.seen)
    assert isinstance(factor, (ShareFactor, ScatterFactor))
    seen, known = target.seen(factor.own.name), Known()
    if seen is not None and factor.seen is not None:
        known = Known(factor.seen, seen.value)
    if isinstance(factor, ShareFactor):
        return SharePart(factor.names, factor.concentration, factor.own.kind == "simplex", known)
    assert isinstance(factor, ScatterFactor)
    safe = factor.df, factor.inverse_scale
    if known.mask is not None:
        d = factor.size
        safe = (
            np.where(known.mask, d + 1.0, factor.df),
            np.where(known.mask[..., None, None], np.eye(d), factor.inverse_scale),
        )
    where = None if factor.location is None else (state[factor.mean], state[factor.spread])
    return ScatterPart(
        factor.names, factor.own.name, factor.own.kind == "matrix", factor.is_inverse, *safe, known,
        *(where or ()),
    )  # fmt: skip
