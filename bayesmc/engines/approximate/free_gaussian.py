"""A Gaussian in free numbers as an approximation of a posterior: its answers in the nodes' own coordinates.

Nodes without bounds, and what is computed of them in an affine way, are Gaussian themselves. Single numbers
with bounds are one-to-one functions of a Gaussian one, whose moments are integrals along a line. All else
(simplices, covariances, bounds that depend on parents, functions that bend) is left to draws.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import scipy
from scipy import special

from bayesmc.distributions.circular import wrap_angle
from bayesmc.distributions.transforms import Bounded, Identity, Transform, Wrapped
from bayesmc.engines.approximate.approximation import Drawn, Marginal
from bayesmc.errors import TraceError, UnsupportedError
from bayesmc.expression import Program
from bayesmc.network.expressions import Followed, density, value_of
from bayesmc.passes.affine import affine
from bayesmc.structure.free_density import UnconstrainedDensity
from bayesmc.structure.free_nodes import FreeNode
from bayesmc.structure.summed_states import drawn_states
from bayesmc.structure.target import Values

#: points of the integral along a line, in standard deviations from the middle on either side
_POINTS, _REACH = 801, 9.0
#: degrees of freedom of what has heavier tails
_DEGREES = 5.0
#: entries of a matrix of coefficients, at most
_ENTRIES = 1 << 24


@dataclass(frozen=True, eq=False)
class NormalMarginal:
    """Normal scalars."""

    mean: np.ndarray
    var: np.ndarray

    def ppf(self, q: Any) -> np.ndarray:
        return self.mean + np.sqrt(self.var) * special.ndtri(q)


@dataclass(frozen=True, eq=False)
class BoundedMarginal:
    """Scalars with bounds whose free numbers are Normal: log-normal, logit-normal; some may be known.

    Attributes
    ----------
    loc, scale : ndarray, shape (*plates, *event)
        Of the free numbers.
    low, high : ndarray
    seen : ndarray or None
        Values of those whose scale is 0.
    """

    loc: np.ndarray
    scale: np.ndarray
    low: np.ndarray
    high: np.ndarray
    seen: np.ndarray | None = None

    @cached_property
    def mean(self) -> np.ndarray:
        return self._with_seen(self._moments[0])

    @cached_property
    def var(self) -> np.ndarray:
        found = self._moments[1]
        return found if self.seen is None else np.where(self.scale > 0, found, 0.0)

    def ppf(self, q: Any) -> np.ndarray:
        falls = ~np.isfinite(self.low) & np.isfinite(self.high)
        z = special.ndtri(q)
        u = self.loc + self.scale * np.where(falls, -z, z)
        return self._with_seen(self._map.constrain(u))

    @cached_property
    def _moments(self) -> tuple[np.ndarray, np.ndarray]:
        z = np.linspace(-_REACH, _REACH, _POINTS)
        weights = np.exp(-0.5 * z * z)
        weights /= weights.sum()  # the trapezoidal rule, all but exact for what is smooth
        mean, square = np.zeros(self.loc.shape), np.zeros(self.loc.shape)
        middle = self._map.constrain(self.loc)
        for at, weight in zip(z, weights, strict=True):
            value = self._map.constrain(self.loc + self.scale * at) - middle
            mean += weight * value
            square += weight * value * value
        one_sided = np.isfinite(self.low) ^ np.isfinite(self.high)
        with np.errstate(over="ignore", invalid="ignore"):
            # exp of a Normal: in closed form, however wide
            size = np.exp(self.loc + 0.5 * self.scale**2)
            exact = np.where(np.isfinite(self.low), self.low + size, self.high - size)
            spread = size**2 * np.expm1(self.scale**2)
        found = np.where(one_sided, exact, middle + mean)
        return found, np.where(one_sided, spread, np.maximum(square - mean**2, 0.0))

    @property
    def _map(self) -> Bounded:
        return Bounded((), self.low, self.high)

    def _with_seen(self, value: np.ndarray) -> np.ndarray:
        return value if self.seen is None else np.where(self.scale > 0, value, self.seen)


@dataclass(frozen=True, eq=False)
class FreeGaussian:
    """A Gaussian of the free numbers of a log density, and of states that are summed out given these.

    Parameters
    ----------
    density : UnconstrainedDensity
    center : ndarray, shape (size,)
    root : ndarray, shape (size, size)
        Lower Cholesky factor of its precision.
    """

    density: UnconstrainedDensity | None = field(repr=False)
    center: np.ndarray
    root: np.ndarray
    coordinates: str = "unconstrained numbers"
    _closed: dict[str, Any] = field(default_factory=dict, repr=False)

    @cached_property
    def names(self) -> tuple[str, ...]:
        if self.density is None:
            return ()
        return (*self.density.names, *self.density.summed)

    def draw(self, rng: np.random.Generator, draws: int) -> Drawn:
        z = rng.standard_normal((draws, len(self.center)))
        return self._placed(z, _log_normal(z), rng)

    def spread(self, rng: np.random.Generator, draws: int) -> Drawn:
        """Half of the draws its own, half of a multivariate t about it: a defensive mixture.

        References
        ----------
        Hesterberg (1995), Technometrics 37, sec. 2; Owen and Zhou (2000), JASA 95, sec. 4.
        """
        z = rng.standard_normal((draws, len(self.center)))
        wide = np.sqrt(_DEGREES / rng.chisquare(_DEGREES, draws))
        z *= np.where(rng.random(draws) < 0.5, wide, 1.0)[:, None]
        return self._placed(z, np.logaddexp(_log_normal(z), _log_t(z)) - np.log(2.0), rng)

    def log_density(self, values: Values) -> np.ndarray:
        """The log density of what ``spread`` draws from, at given values, shape (draws,)."""
        assert self.density is not None
        with np.errstate(all="ignore"):
            u = self.density.unconstrain(values)
            away = u - self.center
            turned = np.mod(away + np.pi, 2.0 * np.pi) - np.pi
            z = np.where(self.density.angles, turned, away) @ self.root
            log = np.logaddexp(_log_normal(z), _log_t(z)) - np.log(2.0)
            log = log + np.log(np.diag(self.root)).sum() - self.density.log_volume(u)
        return log + drawn_states(self.density, u, None, values)[1]

    def _placed(self, z: np.ndarray, log: np.ndarray, rng: np.random.Generator) -> Drawn:
        """Draws in standard coordinates, with their log density there, as draws of nodes."""
        if self.density is None:
            raise UnsupportedError(
                "this approximation was loaded or unpickled, and files and pickles carry no functions"
            )
        away = scipy.linalg.solve_triangular(self.root, z.T, lower=True, trans="T").T
        u = self.center + away
        log = log + np.log(np.diag(self.root)).sum()
        with np.errstate(all="ignore"):
            values = self.density.constrain(u)
            log = log - self.density.log_volume(u)
        states, given = drawn_states(self.density, u, rng)
        round_and_round = (np.abs(away) > np.pi) & self.density.angles
        log = np.where(round_and_round.any(axis=1), np.inf, log + given)
        return Drawn({**values, **states}, log)

    def marginal(self, name: str) -> Marginal | None:
        if name not in self._closed:
            self._closed[name] = self._marginal(name)
        return self._closed[name]

    def probabilities(self, name: str) -> np.ndarray | None:
        return None

    def covariance(self, *names: str) -> np.ndarray | None:
        parts = [self._affine(name) for name in names]
        if any(part is None for part in parts) or self.density is None:
            return None
        gains = np.concatenate([part[1] for part in parts if part is not None])
        scaled = scipy.linalg.solve_triangular(self.root, gains.T, lower=True)
        return scaled.T @ scaled

    @cached_property
    def sds(self) -> np.ndarray:
        """Standard deviations of the free numbers."""
        size = len(self.center)
        inverse = scipy.linalg.solve_triangular(self.root, np.eye(size), lower=True)
        return np.sqrt(np.square(inverse).sum(axis=0))

    # ---- private -------------------------------------------------------------------------------

    @cached_property
    def _by_name(self) -> dict[str, FreeNode]:
        assert self.density is not None
        return {node.name: node for node in self.density.nodes}

    def _marginal(self, name: str) -> Marginal | None:
        if self.density is None:
            return None
        node = self._by_name.get(name)
        if node is not None and isinstance(node.transform, (Bounded, Wrapped)):
            return self._of_bounded(node, node.transform)
        found = self._affine(name)
        if found is None:
            return None
        offset, gains = found
        shape = self.density.target.model[name].value_shape
        mean = offset + gains @ self.center
        if node is not None and (gains.sum(axis=1) <= 1.0).all() and node.size == len(gains):
            var = np.square(self.sds[node.start : node.start + node.size])
        else:
            var = np.square(scipy.linalg.solve_triangular(self.root, gains.T, lower=True)).sum(
                axis=0
            )
        return NormalMarginal(mean.reshape(shape), var.reshape(shape))

    def _of_bounded(self, node: FreeNode, transform: Transform) -> Marginal | None:
        at = _places(node)
        hidden = at >= 0
        loc = np.where(hidden, self.center[at], 0.0)
        scale = np.where(hidden, self.sds[at], 0.0)
        if isinstance(transform, Wrapped):
            mean = (
                wrap_angle(loc)
                if node.seen is None
                else np.where(hidden, wrap_angle(loc), node.seen)
            )
            return NormalMarginal(mean, scale**2)
        assert isinstance(transform, Bounded)
        low, high = (self._whole(node, bound) for bound in (transform.low, transform.high))
        if node.node.event_shape and np.ndim(transform.low) > 0:
            return None
        return BoundedMarginal(loc, scale, low, high, node.seen)

    def _whole(self, node: FreeNode, bound: np.ndarray) -> np.ndarray:
        """A bound of all elements, those that were seen among them."""
        shape = node.node.value_shape
        if np.ndim(bound) == 0 or node.elements is None:
            return np.broadcast_to(bound, shape)
        found = np.full(int(np.prod(node.node.plate_shape)), np.nan)
        found[node.elements] = bound
        return np.broadcast_to(
            np.where(np.isnan(found), -np.inf, found).reshape(node.node.plate_shape), shape
        )

    def _affine(self, name: str) -> tuple[np.ndarray, np.ndarray] | None:
        """A node as offsets and coefficients of free numbers, shapes (k,) and (k, size); or None."""
        key = f"affine \0{name}"
        if key not in self._closed:
            self._closed[key] = self._read_affine(name)
        return self._closed[key]

    def _read_affine(self, name: str) -> tuple[np.ndarray, np.ndarray] | None:
        if self.density is None:
            return None
        target, size = self.density.target, len(self.center)
        model = target.model
        count = int(np.prod(model[name].value_shape))
        if count * size > _ENTRIES:
            return None
        node = self._by_name.get(name)
        if node is not None:
            if not isinstance(node.transform, (Identity, Wrapped)):
                return None
            at = _places(node).ravel()
            gains = np.zeros((count, size))
            gains[np.flatnonzero(at >= 0), at[at >= 0]] = 1.0
            seen = (
                np.zeros(count) if node.seen is None else np.where(at >= 0, 0.0, node.seen.ravel())
            )
            return seen, gains
        if target.is_known(name) and name not in target.forward:
            value = np.broadcast_to(target.known[name], model[name].value_shape)
            if value.dtype.kind not in "fiu" or model[name].domain is not None:
                return None
            return value.ravel().astype(float), np.zeros((count, size))
        return self._read_computed(name, count) if model[name].kind == "deterministic" else None

    def _read_computed(self, name: str, count: int) -> tuple[np.ndarray, np.ndarray] | None:
        assert self.density is not None
        target, size = self.density.target, len(self.center)
        if target.model[name].domain is not None or not isinstance(
            density(target.model, name), Followed
        ):
            return None
        root = value_of(target.model, name)
        moving = [
            leaf
            for leaf in root.leaves
            if not (target.is_known(leaf) and leaf not in target.forward)
        ]
        if root.dtype.kind != "f" or any(leaf not in self._by_name for leaf in moving):
            return None
        parts = {leaf: self._affine(leaf) for leaf in moving}
        try:
            form = affine(root, moving)
        except TraceError:
            return None
        order = list(form.reads)
        roots = [form.offset, *(e for n in order for e in (form.reads[n].gain, form.reads[n].at))]
        offset, *reads = Program(roots)(target.known)
        total, gains = np.broadcast_to(offset, root.shape).ravel().copy(), np.zeros((count, size))
        for k, leaf in enumerate(order):
            part = parts[leaf]
            if part is None:
                return None
            gain, at = reads[2 * k], reads[2 * k + 1]
            width = int(np.prod(form.reads[leaf].gain.shape[len(root.shape) :]))
            gain = np.broadcast_to(gain, (*root.shape, width)).reshape(count, width)
            at = np.broadcast_to(at, (*root.shape, width)).reshape(count, width)
            for column in range(width):
                total += gain[:, column] * part[0][at[:, column]]
                gains += gain[:, column, None] * part[1][at[:, column]]
        return total, gains

    def __getstate__(self) -> dict[str, Any]:
        """Pickles travel without functions: with the answers that are closed."""
        if self.density is not None:
            for name, node in self.density.target.model.nodes.items():
                if node.kind != "input":
                    self.marginal(name)
        state = {k: v for k, v in self.__dict__.items() if k in ("center", "root", "coordinates")}
        closed = {k: v for k, v in self._closed.items() if not k.startswith("affine \0")}
        return {**state, "density": None, "_closed": closed, "names": self.names}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)


# ---- private ------------------------------------------------------------------------------------


def _log_normal(z: np.ndarray) -> np.ndarray:
    return -0.5 * np.square(z).sum(axis=1) - 0.5 * z.shape[1] * np.log(2.0 * np.pi)


def _log_t(z: np.ndarray) -> np.ndarray:
    """Of a multivariate t."""
    size, degrees = z.shape[1], _DEGREES
    constant = special.gammaln(0.5 * (degrees + size)) - special.gammaln(0.5 * degrees)
    constant -= 0.5 * size * np.log(degrees * np.pi)
    return constant - 0.5 * (degrees + size) * np.log1p(np.square(z).sum(axis=1) / degrees)


def _places(node: FreeNode) -> np.ndarray:
    """For every number of a node's value its place among the free numbers, -1 where it was seen."""
    shape, width = node.node.value_shape, int(np.prod(node.node.event_shape))
    own = node.start + np.arange(node.size)
    if node.elements is None:
        return own.reshape(shape)
    found = np.full((int(np.prod(node.node.plate_shape)), width), -1)
    found[node.elements] = own.reshape(-1, width)
    return found.reshape(shape)
