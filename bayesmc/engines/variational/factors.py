"""The factors of a mean-field approximation: of one node, or of a mean with its precision.

A factor is found from the derivatives of the expected log joint density by its own moments: these are natural
parameters, since the expectation is linear in the moments (Hoffman, Blei, Wang and Paisley 2013, sec. 2.3).
It supplies its moments to the others and its entropy to the bound. Elements that were seen are points.

References
----------
Winn and Bishop (2005), Variational Message Passing, JMLR 6; Bishop (2006), sec. 10.1 to 10.4 and appendix B.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping

import numpy as np
from scipy import special

from bayesmc.errors import UnsupportedError
from bayesmc.passes.moments import Hidden, moment

State = dict[str, np.ndarray]
_LOG_2PI = math.log(2 * math.pi)
#: log weights below this are taken for impossible
IMPOSSIBLE = -1e300


class Factor(ABC):
    """A factor of the approximation.

    Attributes
    ----------
    names : tuple of str
        Its nodes.
    moments : tuple of str
        The leaves that stand for its expectations.
    shapes : dict
        Of these.
    seen : ndarray of bool or None
        Elements whose values are known.
    """

    names: tuple[str, ...]
    moments: tuple[str, ...]
    shapes: dict[str, tuple[int, ...]]
    seen: np.ndarray | None

    @abstractmethod
    def start(self, state: State, values: Mapping[str, np.ndarray]) -> None:
        """Put the moments of points into a state, from stored values."""

    @abstractmethod
    def update(self, state: State, slopes: Mapping[str, np.ndarray]) -> None:
        """Put the best factor given all others into the state, from derivatives by its moments."""

    @abstractmethod
    def entropy(self, state: State) -> float:
        """Of what was found last."""

    def spreads(self, state: State) -> list[np.ndarray]:
        """Figures that have settled when the factor has, each on a scale on which 1 is much."""
        return []


class NormalFactor(Factor):
    """Numbers that are normal: groups of ``width`` jointly, all groups independent."""

    def __init__(self, own: Hidden, seen: np.ndarray | None) -> None:
        self.own, self.names = own, (own.name,)
        self.mean, self.cov = moment(own.name, "mean"), moment(own.name, "cov")
        self.moments = (self.mean, self.cov)
        self.shapes = {self.mean: own.shape, self.cov: own.moment("cov").shape}
        self.seen = None if seen is None else np.broadcast_to(_expanded(seen, own.shape), own.shape)
        self._entropy = 0.0

    def start(self, state: State, values: Mapping[str, np.ndarray]) -> None:
        groups, w = math.prod(self.own.shape) // self.own.width, self.own.width
        state[self.mean] = np.array(values[self.own.name], dtype=float)
        state[self.cov] = np.zeros((groups, w, w))

    def update(self, state: State, slopes: Mapping[str, np.ndarray]) -> None:
        w = self.own.width
        precision = -2.0 * slopes[self.cov]
        step = slopes[self.mean].reshape(-1, w)
        free = None if self.seen is None else ~self.seen.reshape(-1, w)
        if w == 1:
            lost = precision[:, 0, 0] <= 0
            lost = lost if free is None else lost & free[:, 0]
            if lost.any() or not np.isfinite(precision).all():
                raise improper(self.own.name)
            with np.errstate(divide="ignore"):
                cov = 1.0 / precision
            if free is not None:
                cov = np.where(free[:, :, None], cov, 0.0)
            moved = cov[:, :, 0] * step
            count = len(cov) if free is None else int(free.sum())
            logs = np.log(cov[:, 0, 0] if free is None else cov[free[:, 0], 0, 0]).sum()
        else:
            cov, logs, count = self._inverted(precision, free)
            moved = np.matvec(cov, step)
        state[self.cov] = cov
        state[self.mean] = state[self.mean] + moved.reshape(self.own.shape)
        self._entropy = 0.5 * (count * (1.0 + _LOG_2PI) + float(logs))

    def _inverted(
        self, precision: np.ndarray, free: np.ndarray | None
    ) -> tuple[np.ndarray, float, int]:
        precision = 0.5 * (precision + precision.swapaxes(-1, -2))
        if (
            free is not None
        ):  # seen components stand still: a large precision of their own, and no spread
            both = free[:, :, None] & free[:, None, :]
            precision = np.where(both, precision, np.eye(precision.shape[-1]))
        try:
            root = np.linalg.cholesky(precision)
        except np.linalg.LinAlgError:
            raise improper(self.own.name) from None
        cov = np.linalg.inv(precision)
        cov = 0.5 * (cov + cov.swapaxes(-1, -2))
        if free is not None:
            cov = np.where(both, cov, 0.0)
        logs = -2.0 * np.log(np.linalg.diagonal(root)).sum()
        return (
            cov,
            float(logs),
            precision.shape[0] * precision.shape[-1] if free is None else int(free.sum()),
        )

    def entropy(self, state: State) -> float:
        return self._entropy

    def spreads(self, state: State) -> list[np.ndarray]:
        sd = np.sqrt(np.linalg.diagonal(state[self.cov]).reshape(self.own.shape))
        with np.errstate(divide="ignore"):
            scale = np.where(sd > 0, sd, 1.0)
        return [state[self.mean] / scale, np.log(scale)]


class ScatterFactor(Factor):
    """A precision that is gamma or Wishart, or a variance whose inverse is; with a mean, normal-Wishart.

    Numbers are matrices of one row: Gamma(a, b) is the Wishart distribution of ``2 a`` degrees of freedom
    whose inverse scale is ``2 b``.

    Parameters
    ----------
    own : Hidden
        Of kind positive or matrix.
    is_inverse : bool
        Whether the node is the inverse of what is gamma or Wishart.
    mean : Hidden or None
        What has a normal distribution given the precision.
    """

    def __init__(
        self, own: Hidden, is_inverse: bool, mean: Hidden | None, seen: np.ndarray | None
    ) -> None:
        self.own, self.is_inverse, self.location, self.seen = own, is_inverse, mean, seen
        self.size = own.shape[-1] if own.kind == "matrix" else 1
        self.names = (own.name,) if mean is None else (mean.name, own.name)
        self.precision = moment(own.name, "inv" if is_inverse else "x")
        self.log = moment(own.name, "log")
        self.moments: tuple[str, ...] = (self.precision, self.log)
        self.shapes = {self.precision: own.shape, self.log: own.moment("log").shape}
        if mean is not None:
            self.mean, self.spread = moment(mean.name, "mean"), moment(mean.name, "spread")
            self.moments += (self.mean, self.spread)
            self.shapes |= {self.mean: mean.shape, self.spread: mean.moment("spread").shape}
        inner = 2 if own.kind == "matrix" else 0
        self.plates = own.shape[: len(own.shape) - inner]
        #: degrees of freedom and inverse scales of the precisions; how many observations a mean is worth
        self.df = np.zeros(self.plates)
        self.inverse_scale = np.zeros((*self.plates, self.size, self.size))
        self.count = np.ones(self.plates)

    def start(self, state: State, values: Mapping[str, np.ndarray]) -> None:
        x = np.array(values[self.own.name], dtype=float)
        matrix = self.own.kind == "matrix"
        if self.is_inverse:
            state[self.precision] = np.linalg.inv(x) if matrix else 1.0 / x
        else:
            state[self.precision] = x
        state[self.log] = np.linalg.slogdet(x)[1] if matrix else np.log(x)
        if self.location is not None:
            state[self.mean] = np.array(values[self.location.name], dtype=float)
            state[self.spread] = np.zeros(self.plates)

    def update(self, state: State, slopes: Mapping[str, np.ndarray]) -> None:
        d = self.size
        own = (-2.0 * slopes[self.precision]).reshape((*self.plates, d, d))
        df = (-2.0 if self.is_inverse else 2.0) * slopes[self.log]
        df = df - (d + 1.0) if self.is_inverse else df + (d + 1.0)
        if self.location is not None:
            df = df - 1.0
            own = own - self._moved(state, slopes)
        own = 0.5 * (own + own.swapaxes(-1, -2))
        if self.seen is not None:  # what was seen keeps its moments; any proper values do here
            own = np.where(self.seen[..., None, None], np.eye(d), own)
            df = np.where(self.seen, d + 1.0, df)
        try:
            root = np.linalg.cholesky(own)
        except np.linalg.LinAlgError:
            raise improper(self.own.name) from None
        if not (df > d - 1).all():
            raise improper(self.own.name)
        self.df, self.inverse_scale = df, own
        self._log_det = 2.0 * np.log(np.linalg.diagonal(root)).sum(axis=-1)
        halves = 0.5 * (df[..., None] - np.arange(d))
        log = special.digamma(halves).sum(axis=-1) + (d * math.log(2.0) - self._log_det)
        self._log, self._norm = log, special.gammaln(halves).sum(axis=-1)
        expected = np.linalg.inv(own)
        expected = (0.5 * df[..., None, None]) * (expected + expected.swapaxes(-1, -2))
        expected = expected.reshape(self.own.shape)
        log = -log if self.is_inverse else log
        if self.seen is not None:
            wide = _expanded(self.seen, self.own.shape)
            expected = np.where(wide, state[self.precision], expected)
            log = np.where(self.seen, state[self.log], log)
        state[self.precision], state[self.log] = expected, log

    def _moved(self, state: State, slopes: Mapping[str, np.ndarray]) -> np.ndarray:
        """Update the mean; what its step takes from the inverse scale."""
        assert self.location is not None
        d = self.size
        self.count = count = (-2.0 / d) * slopes[self.spread]
        if not (count > 0).all():
            raise improper(self.location.name)
        step = slopes[self.mean].reshape((*self.plates, d, 1))
        old = state[self.precision].reshape((*self.plates, d, d))
        moved = np.linalg.solve(old, step) / count[..., None, None]
        state[self.mean] = state[self.mean] + moved.reshape(self.location.shape)
        state[self.spread] = 1.0 / count
        return (count[..., None, None] * moved) * moved.swapaxes(-1, -2)

    def entropy(self, state: State) -> float:
        d, df, log = self.size, self.df, self._log
        norm = (0.5 * d * math.log(2.0)) * df + self._norm
        norm = norm + 0.25 * d * (d - 1) * math.log(math.pi)
        power = 0.5 * (df + d + 1) if self.is_inverse else 0.5 * (df - d - 1)
        found = norm + (0.5 * df) * (d - self._log_det) - power * log
        if self.location is not None:
            found = found + 0.5 * (d * (1.0 + _LOG_2PI) - d * np.log(self.count) - log)
        return float((found if self.seen is None else found[~self.seen]).sum())

    def spreads(self, state: State) -> list[np.ndarray]:
        found = [np.log(self.df), self._log_det]
        if self.location is not None:
            precision = state[self.precision].reshape((*self.plates, self.size, self.size))
            root = np.sqrt(np.linalg.diagonal(precision) * self.count[..., None])
            found += [state[self.mean].reshape(root.shape) * root, np.log(self.count)]
        return found


class ShareFactor(Factor):
    """Probabilities: beta, or Dirichlet."""

    def __init__(self, own: Hidden, seen: np.ndarray | None) -> None:
        self.own, self.names, self.seen = own, (own.name,), seen
        logs = ("log",) if own.kind == "simplex" else ("log", "log1m")
        self.moments = tuple(moment(own.name, f) for f in logs)
        self.shapes = dict.fromkeys(self.moments, own.shape)
        self.concentration = np.zeros(0)

    def start(self, state: State, values: Mapping[str, np.ndarray]) -> None:
        x = np.asarray(values[self.own.name], dtype=float)
        with np.errstate(divide="ignore"):
            found = [np.log(x), np.log1p(-x)]
        for name, value in zip(self.moments, found, strict=False):
            state[name] = np.maximum(value, IMPOSSIBLE)

    def update(self, state: State, slopes: Mapping[str, np.ndarray]) -> None:
        parts = [1.0 + slopes[name] for name in self.moments]
        a = parts[0] if self.own.kind == "simplex" else np.stack(parts, axis=-1)
        free = np.ones(a.shape[:-1], bool) if self.seen is None else ~self.seen
        if not (a[free] > 0).all():
            raise improper(self.own.name)
        self.concentration = a = np.where(free[..., None], a, 1.0)
        logs = special.digamma(a) - special.digamma(a.sum(axis=-1, keepdims=True))
        made = [logs] if self.own.kind == "simplex" else [logs[..., 0], logs[..., 1]]
        for name, value in zip(self.moments, made, strict=True):
            keep = self.seen if self.seen is None else _expanded(self.seen, value.shape)
            state[name] = value if keep is None else np.where(keep, state[name], value)

    def entropy(self, state: State) -> float:
        a = self.concentration
        total = a.sum(axis=-1)
        logs = special.digamma(a) - special.digamma(total)[..., None]
        found = special.gammaln(a).sum(axis=-1) - special.gammaln(total)
        found = found - ((a - 1.0) * logs).sum(axis=-1)
        return float((found if self.seen is None else found[~self.seen]).sum())

    def spreads(self, state: State) -> list[np.ndarray]:
        return [np.log(self.concentration)]


class TableFactor(Factor):
    """A finite node, or several with the same plates: tables of probabilities of every element.

    Joint states are the first axis, the last node changing fastest. Tables, and the derivatives that they
    come from, are written over.
    """

    def __init__(
        self,
        names: tuple[str, ...],
        sizes: tuple[int, ...],
        shape: tuple[int, ...],
        seen: np.ndarray | None,
        one_by_one: bool = False,
    ) -> None:
        self.names, self.seen, self.sizes = names, seen, sizes
        self.size = size = math.prod(sizes)
        #: elements meet in a term, so that they are updated in turn
        self.one_by_one, self.elements = one_by_one, math.prod(shape)
        self.table = table_of(names)
        self.moments = (self.table,)
        self.shape = (size, *shape)
        self.shapes = {self.table: self.shape}
        self._entropy = 0.0

    def start(self, state: State, values: Mapping[str, np.ndarray]) -> None:
        each = tuple(np.asarray(values[name]).astype(np.intp) for name in self.names)
        joint = np.ravel_multi_index(each, self.sizes)
        states = np.arange(self.size).reshape((-1,) + (1,) * (len(self.shape) - 1))
        state[self.table] = (joint == states).astype(float)

    def update(self, state: State, slopes: Mapping[str, np.ndarray]) -> None:
        logs, old = slopes[self.table], state[self.table]
        logs -= logs.max(axis=0)
        fresh = self.seen is not None or old.shape != logs.shape
        table = np.exp(logs, out=None if fresh else old)  # large: memory is used again
        total = table.sum(axis=0)
        table /= total
        if self.seen is None:
            self._entropy = float(np.log(total).sum() - np.vdot(table, logs))
        else:
            inner = np.log(total) - (table * logs).sum(axis=0)
            self._entropy = float(inner[~self.seen].sum())
            table = np.where(self.seen, old, table)
        state[self.table] = table

    def update_one(self, state: State, slopes: Mapping[str, np.ndarray], element: int) -> None:
        """The same for one element alone."""
        if self.seen is not None and self.seen.reshape(-1)[element]:
            return
        logs = slopes[self.table].reshape(self.size, -1)[:, element]
        flat = state[self.table].reshape(self.size, -1).copy()
        column = np.exp(logs - logs.max())
        flat[:, element] = column / column.sum()
        state[self.table] = table = flat.reshape(self.shape)
        hidden = table if self.seen is None else table[:, ~self.seen]
        self._entropy = float(special.entr(hidden).sum())

    def entropy(self, state: State) -> float:
        return self._entropy

    def spreads(self, state: State) -> list[np.ndarray]:
        return [state[self.table].copy()]


def table_of(names: tuple[str, ...]) -> str:
    """The name of the leaf of a table's probabilities."""
    return moment("\0".join(names), "table")


def improper(name: str) -> UnsupportedError:
    """The error of a factor that does not integrate."""
    return UnsupportedError(
        f"MeanField: given the others' moments node {name!r} has no proper distribution; give it a proper "
        "prior, or use HamiltonianMonteCarlo()"
    )


# ---- private ------------------------------------------------------------------------------------


def _expanded(seen: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Truths of elements, with axes for what is inside an element."""
    return seen.reshape(seen.shape + (1,) * (len(shape) - seen.ndim))
