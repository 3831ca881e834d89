"""Where messages ended, as a distribution: Gaussian components and finite variables side by side."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy import special

from bayesmc.distributions import Distribution, Normal
from bayesmc.distributions.transforms import Transform
from bayesmc.engines.approximate.approximation import Drawn, Marginal
from bayesmc.engines.propagation.beliefs import Conjugates, normalised
from bayesmc.engines.propagation.coordinates import Numbers
from bayesmc.engines.propagation.system import System
from bayesmc.factors.families import Shares

#: points of Gauss and Hermite for moments of mapped numbers
_POINTS = 96
#: degrees of freedom of heavier tails, and the share of even states there
_DEGREES, _EVEN = 4.0, 0.2


@dataclass(frozen=True, eq=False)
class Mapped:
    """Numbers between bounds whose free numbers are normal.

    Attributes
    ----------
    transform : Transform
    centre, spread : ndarray, shape (*plates, *event)
        Of the free numbers.
    seen : ndarray of bool
        Where they are known.
    """

    transform: Transform
    centre: np.ndarray
    spread: np.ndarray

    @cached_property
    def _values(self) -> tuple[np.ndarray, np.ndarray]:
        """Values at points of the rule, and their weights."""
        x, w = np.polynomial.hermite_e.hermegauss(_POINTS)
        shape = (-1, *(1,) * self.centre.ndim)
        values = self.transform.constrain(self.centre + self.spread * x.reshape(shape))
        return values, (w / w.sum()).reshape(shape)

    @property
    def coefficients(self) -> np.ndarray:
        """By normalised Hermite polynomials of the standardised free numbers, shape (points, scalars).

        The polynomials are orthonormal under the rule, so that squares from the first on sum to ``var``.
        """
        x, _ = np.polynomial.hermite_e.hermegauss(_POINTS)
        values, weight = self._values
        flat = (weight * values).reshape(_POINTS, -1)
        before, one = np.zeros(_POINTS), np.ones(_POINTS)
        found = []
        for k in range(_POINTS):
            found.append(one @ flat)
            before, one = one, (x * one - np.sqrt(k) * before) / np.sqrt(k + 1.0)
        return np.array(found)

    @cached_property
    def _moments(self) -> tuple[np.ndarray, np.ndarray]:
        values, weight = self._values
        mean = (weight * values).sum(axis=0)
        return mean, (weight * (values - mean) ** 2).sum(axis=0)

    @property
    def mean(self) -> np.ndarray:
        return self._moments[0]

    @property
    def var(self) -> np.ndarray:
        return self._moments[1]

    def ppf(self, q: np.ndarray) -> np.ndarray:
        """Quantiles: the map keeps the order, or turns it round."""
        up, down = (
            self.transform.constrain(self.centre + self.spread * special.ndtri(level))
            for level in (q, 1.0 - np.asarray(q))
        )
        rises = self.transform.constrain(self.centre + 1.0) >= self.transform.constrain(self.centre)
        return np.where(rises, up, down)


class Messages:
    """What ``ApproximatePosterior`` asks of where messages ended.

    Finite variables, and each set of numbers that hang together, are independent of each other in it,
    whatever they are in the model; numbers of one set are jointly normal in their free coordinates.
    """

    coordinates = "numbers jointly Gaussian (mapped where bounded), finite nodes each by itself"

    def __init__(self, system: System) -> None:
        self.model = system.target.model
        self.names = system.target.chain
        self._beliefs, self._numbers, self._places = system.beliefs, system.numbers, system.places
        self._kept = system.kept
        #: where elements of finite nodes are observed, flat
        self._seen = {
            n: np.flatnonzero(o.mask)
            for n, o in system.target.observed.items()
            if n in self.names and o.mask is not None
        }

    def draw(self, rng: np.random.Generator, draws: int) -> Drawn:
        """Independent joint draws of all nodes in ``names``."""
        values, own, _ = self._drawn(rng, np.zeros(draws, dtype=bool))
        return Drawn(values, own)

    def spread(self, rng: np.random.Generator, draws: int) -> Drawn:
        """Half of the draws its own, half with heavier tails: a defensive mixture (Hesterberg 1995).

        Numbers that hang together are of a multivariate t, states are mixed with even ones, members of other
        families have half the weight.
        """
        values, own, wide = self._drawn(rng, rng.random(draws) < 0.5)
        return Drawn(values, np.logaddexp(own, wide) - np.log(2.0))

    def log_density(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """The log density of what ``spread`` draws from, at given values, shape (draws,)."""
        beliefs, draws = self._beliefs, len(values[self.names[0]])
        free, both = np.zeros((draws, len(beliefs.size))), np.zeros((2, draws))
        for name, x in self._numbers.items():
            free[:, x.at[x.at >= 0]] = x.freed(np.asarray(values[name], dtype=float))[:, x.at >= 0]
        for k, block in enumerate(beliefs.blocks):
            mine = np.flatnonzero(beliefs.size == k)
            away = np.zeros((draws, *block.linear.shape))
            at = beliefs.component[mine], beliefs.place[mine]
            away[:, *at] = free[:, mine] - beliefs.centre[mine] - block.mean[at]
            root = np.linalg.cholesky(block.cov)
            noise = np.linalg.solve(root, away[..., None])[..., 0]
            size = np.log(root.diagonal(0, -2, -1)).sum()
            logs = _log_densities((noise**2).sum(axis=-1), noise.shape[-1])
            both += np.stack([log.sum(axis=-1) for log in logs]) - size
        for name in self.names:
            if name in self._numbers:
                both -= _volume(self._numbers[name], free)
            elif name in self._kept:
                event = self.model[name].event_shape
                value = np.asarray(values[name]).reshape(draws, -1, *event)
                if not event and isinstance(self._held(name)[0].family, Shares):
                    value = np.stack([value, 1.0 - value], axis=-1)
                members = self._both_members(name)
                both += np.stack([dist.log_prob(value).sum(axis=-1) for dist in members])
            else:
                codes = np.asarray(values[name]).reshape(draws, -1).astype(np.intp)
                both += np.stack([_picked(table, codes) for table in self._both_tables(name)])
        return np.logaddexp(*both) - np.log(2.0)

    def marginal(self, name: str) -> Marginal | None:
        """Of a node by itself; of simplexes and matrices by draws."""
        if name in self._kept:
            held, rows = self._held(name)
            node = self.model[name]
            natural = held.naturals[rows].reshape(*node.plate_shape, -1)
            return held.family.marginal(natural, bool(node.event_shape))
        x = self._numbers.get(name)
        if x is None or x.transform.unconstrained_shape != x.node.event_shape:
            return None
        mean, var = self._beliefs.variances(np.maximum(x.at, 0).reshape(-1))
        shape = x.node.value_shape
        hidden = (x.at >= 0).reshape(-1)
        centre = np.where(hidden, mean, x.seen.reshape(-1)).reshape(shape)
        spread = np.where(hidden, np.sqrt(var), 0.0).reshape(shape)
        if x.is_plain and hidden.all():
            found: Distribution = Normal(centre, spread)
            return found
        return Mapped(x.transform, centre, spread)

    def probabilities(self, name: str) -> np.ndarray | None:
        """Probabilities of the states of a finite node."""
        node = self.model[name]
        if name not in self.names or node.domain is None:
            return None
        table = np.exp(normalised(self._logs(name)))
        return table.reshape(*node.plate_shape, node.domain.size)

    def covariance(self, *names: str) -> np.ndarray | None:
        """Of all scalars; None, answered by draws, where vectors or matrices are mapped as a whole.

        Numbers of one set are one-to-one functions of jointly normal ones: covariances are sums over Hermite
        coefficients (Mehler's formula), whose diagonal is ``var``. All else is independent.
        """
        parts = [self._numbers.get(n) for n in names]
        for x in parts:
            if x is not None and x.transform.unconstrained_shape != x.node.event_shape:
                return None
        sizes = [math.prod(self.model[n].value_shape) for n in names]
        ends = np.cumsum([0, *sizes])
        places = [np.arange(a, b) for a, b in itertools.pairwise(ends)]
        found = np.zeros((ends[-1], ends[-1]))
        mine = [k for k, x in enumerate(parts) if x is not None]
        if mine:
            at = np.concatenate([places[k] for k in mine])
            found[np.ix_(at, at)] = self._mapped_covariance([x for x in parts if x is not None])
        for j, k in itertools.product(range(len(names)), repeat=2):
            if names[j] == names[k] and parts[j] is None:
                block = self._own_covariance(names[j])
                if block is None:
                    return None
                found[np.ix_(places[j], places[k])] = block
        return found

    def __getstate__(self) -> dict[str, Any]:
        """Pickles travel without functions."""
        model = self.model.without_functions()
        numbers = {n: replace(x, node=model[n]) for n, x in self._numbers.items()}
        return {**self.__dict__, "model": model, "_numbers": numbers}

    # ---- private -------------------------------------------------------------------------------

    def _drawn(
        self, rng: np.random.Generator, is_wide: np.ndarray
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
        """Draws, some with heavier tails; log densities of all of them without these, and with."""
        beliefs, draws = self._beliefs, len(is_wide)
        free = np.zeros((draws, len(beliefs.size)))
        own, wide = np.zeros(draws), np.zeros(draws)
        for k, block in enumerate(beliefs.blocks):
            mine = np.flatnonzero(beliefs.size == k)
            root = np.linalg.cholesky(block.cov)
            noise = rng.standard_normal((draws, *block.linear.shape))
            longer = np.sqrt(_DEGREES / rng.chisquare(_DEGREES, noise.shape[:2]))
            noise *= np.where(is_wide[:, None], longer, 1.0)[..., None]
            value = block.mean + np.matvec(root, noise)
            free[:, mine] = value[:, beliefs.component[mine], beliefs.place[mine]]
            size = np.log(root.diagonal(0, -2, -1)).sum()
            normal, heavy = _log_densities((noise**2).sum(axis=-1), noise.shape[-1])
            own, wide = own + normal.sum(axis=-1) - size, wide + heavy.sum(axis=-1) - size
        free += beliefs.centre
        values = {}
        for name in self.names:
            node, x = self.model[name], self._numbers.get(name)
            if x is not None:
                values[name], size = x.whole(free), _volume(x, free)
                own, wide = own - size, wide - size
            elif name in self._kept:
                both = self._both_members(name)
                one, two = (dist.sample(rng, (draws,)) for dist in both)
                drawn = np.where(is_wide.reshape(-1, *(1,) * (one.ndim - 1)), two, one)
                own, wide = (
                    log + dist.log_prob(drawn).sum(axis=-1)
                    for log, dist in zip((own, wide), both, strict=True)
                )
                if not node.event_shape and drawn.ndim == 3:  # the first of two shares
                    drawn = drawn[..., 0]
                values[name] = drawn.reshape(draws, *node.value_shape)
            else:
                assert node.domain is not None
                table, even = self._both_tables(name)
                chosen = np.where(is_wide[:, None, None], even, table)
                codes = (chosen + rng.gumbel(size=(draws, *table.shape))).argmax(axis=-1)
                own, wide = own + _picked(table, codes), wide + _picked(even, codes)
                values[name] = codes.reshape(draws, *node.plate_shape).astype(node.domain.dtype)
        return values, own, wide

    def _mapped_covariance(self, parts: Sequence[Numbers]) -> np.ndarray:
        at = np.concatenate([x.at.reshape(-1) for x in parts])
        _, free = self._beliefs.moments(np.maximum(at, 0))
        known = at < 0
        free = np.where(known[:, None] | known, 0.0, free)
        if all(x.is_plain for x in parts):
            return free
        spread = np.sqrt(free.diagonal())
        scale = np.where(spread > 0, spread, 1.0)
        correlation = np.clip(free / scale / scale[:, None], -1.0, 1.0)
        series = []
        for x in parts:
            own = self.marginal(x.node.name)
            if isinstance(own, Mapped):
                series.append(own.coefficients)
            else:
                plain = np.zeros((_POINTS, x.at.size))
                plain[1] = np.sqrt(np.asarray(own.var)).reshape(-1)  # type: ignore[union-attr]
                series.append(plain)
        coefficients = np.concatenate(series, axis=1)
        found, power = np.zeros_like(free), np.ones_like(free)
        for one in coefficients[1:]:
            power = power * correlation
            found += power * one * one[:, None]
        return found

    def _own_covariance(self, name: str) -> np.ndarray | None:
        """Of a node that is independent of all others, and so are its elements."""
        node = self.model[name]
        if name in self._kept:
            own = self.marginal(name)
            assert own is not None
            mean, var = np.asarray(own.mean), np.asarray(own.var)
            found = np.diag(var.reshape(-1))
            if node.event_shape:  # shares: m_i m_j / (a + 1) is what moves between them
                n = node.event_shape[-1]
                rows, shares = mean.reshape(-1, n), var.reshape(-1, n)
                unit = (shares.sum(axis=-1) / (rows * (1.0 - rows)).sum(axis=-1))[:, None, None]
                block = unit * (rows[:, :, None] * np.eye(n) - rows[:, :, None] * rows[:, None])
                for k, one in enumerate(block):
                    found[k * n : (k + 1) * n, k * n : (k + 1) * n] = one
            return found
        table = self.probabilities(name)
        if table is None or node.domain is None:
            return None
        numbers = np.asarray(node.domain.numbers, dtype=float)
        away = numbers - (table @ numbers)[..., None]
        return np.diag((table * away**2).sum(axis=-1).reshape(-1))

    def _held(self, name: str) -> tuple[Conjugates, np.ndarray]:
        kept = self._kept[name]
        return self._beliefs.families[kept.field], kept.rows

    def _both_members(self, name: str) -> list[Distribution]:
        """The distribution of a node that keeps its family, and that with heavier tails."""
        held, rows = self._held(name)
        natural = held.naturals[rows]
        return [held.family.member(n) for n in (natural, held.family.widened(natural))]

    def _both_tables(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Log probabilities of the states of all elements, and mixed with even ones."""
        table, domain = normalised(self._logs(name)), self.model[name].domain
        assert domain is not None
        even = np.logaddexp(table + np.log(1 - _EVEN), np.log(_EVEN / domain.size))
        if name in self._seen:  # what was seen is never drawn anew
            even[self._seen[name]] = table[self._seen[name]]
        return table, even

    def _logs(self, name: str) -> np.ndarray:
        """Log beliefs of all elements of a finite node."""
        places = [self._places[name, e] for e in range(math.prod(self.model[name].plate_shape))]
        if not places:
            domain = self.model[name].domain
            assert domain is not None
            return np.zeros((0, domain.size))
        return self._beliefs.finite[places[0][0]].logs[[at for _, at in places]]


# ---- private ------------------------------------------------------------------------------------


def _picked(table: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """Log probabilities of states, (draws, elements), summed over elements."""
    return np.take_along_axis(table[None], codes[..., None], axis=-1)[..., 0].sum(axis=-1)


def _log_densities(square: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Of standard normal vectors of n numbers, and of standard t ones, by their squared lengths."""
    normal = -0.5 * (square + n * np.log(2.0 * np.pi))
    half = 0.5 * (_DEGREES + n)
    heavy = (
        special.gammaln(half) - special.gammaln(0.5 * _DEGREES) - half * np.log1p(square / _DEGREES)
    )
    return normal, heavy - 0.5 * n * np.log(_DEGREES * np.pi)


def _volume(x: Numbers, free: np.ndarray) -> np.ndarray:
    """Log changes of volume of a node's hidden elements, shape (draws,)."""
    if x.is_plain:
        return np.zeros(len(free))
    own = np.where(x.at >= 0, free[:, np.maximum(x.at, 0)], x.seen)
    shape = x.node.plate_shape + x.transform.unconstrained_shape
    logs = x.transform.log_abs_det_jacobian(own.reshape(len(free), *shape))
    logs = np.broadcast_to(logs, (len(free), *x.node.plate_shape)).reshape(len(free), -1)
    return np.where((x.at >= 0).all(axis=-1), logs, 0.0).sum(axis=-1)
