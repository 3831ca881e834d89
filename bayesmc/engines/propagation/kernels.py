"""The table of pairs: how a factor's moments with its cavity come about.

Finite tables, Gaussians that finite variables switch and the probit have closed forms. Whatever else reads
Gaussian coordinates along one line is integrated there, with breaks where it jumps or bends, in two and three
dimensions on lattices, and beyond by importance sampling from the belief.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import numpy as np

from bayesmc.expression import Program
from bayesmc.factors.quadrature import along_line, importance, on_lattice
from bayesmc.factors.tilted import (
    Tilt,
    gaussians,
    inverses,
    log_integral,
    probit,
    probit_messages,
)

#: numbers that a density is evaluated for at a time
_AT_ONCE = 1 << 21


@dataclass(frozen=True, eq=False)
class Tables:
    """Factors of finite variables alone: logs, shape (count, *cards)."""

    logs: np.ndarray
    how: str = "table"

    def tilted(
        self,
        members: np.ndarray,
        precision: np.ndarray,
        linear: np.ndarray,
        near: tuple[np.ndarray, np.ndarray],
    ) -> Tilt:
        return Tilt(self.logs[members], linear, precision)


@dataclass(frozen=True, eq=False)
class Switched:
    """Gaussians, one for every configuration of finite variables.

    Attributes
    ----------
    rows : ndarray, shape (count, *cards, m, k + 1)
    log_scale : ndarray, shape (count, *cards)
    """

    rows: np.ndarray
    log_scale: np.ndarray
    how: str = "mixture of Gaussians"

    def tilted(
        self,
        members: np.ndarray,
        precision: np.ndarray,
        linear: np.ndarray,
        near: tuple[np.ndarray, np.ndarray],
    ) -> Tilt:
        rows, scale = self.rows[members], self.log_scale[members]
        shape, k = scale.shape, linear.shape[-1]
        flat = rows.reshape(len(members), -1, *rows.shape[-2:])
        found = gaussians(flat, scale.reshape(len(members), -1), precision, linear)
        return Tilt(
            found.log.reshape(shape), found.mean.reshape(*shape, k),
            found.cov.reshape(*shape, k, k),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Probit:
    """The standard normal cdf of ``sign * (offset + gain u)``, shapes (count,)."""

    sign: np.ndarray
    offset: np.ndarray
    gain: np.ndarray
    how: str = "probit"
    is_log_concave: ClassVar[bool] = True

    @cached_property
    def shift(self) -> np.ndarray:
        return self.sign * self.offset

    @cached_property
    def slope(self) -> np.ndarray:
        return self.sign * self.gain

    def tilted(
        self,
        members: np.ndarray,
        precision: np.ndarray,
        linear: np.ndarray,
        near: tuple[np.ndarray, np.ndarray],
    ) -> Tilt:
        sign, offset, gain = self.sign, self.offset, self.gain
        if len(members) < len(sign):
            sign, offset, gain = (a[members] for a in (sign, offset, gain))
        return probit(sign, offset, gain, precision[:, 0, 0], linear[:, 0])

    def messages(
        self, members: np.ndarray, precision: np.ndarray, linear: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Precisions and linear terms of messages, given proper cavities, all of shape (f,)."""
        shift, slope = self.shift, self.slope
        if len(members) < len(shift):
            shift, slope = shift[members], slope[members]
        return probit_messages(shift, slope, precision, linear)


@dataclass(frozen=True, eq=False)
class Density:
    """Any log factor of directions, evaluated.

    Attributes
    ----------
    program : Program
        Of the log factor, shape its plates, and of numbers that are zero where it jumps or bends.
    leaves : dict
        Direction -> its shape, that of the plates and what is inside of an element.
    known : dict
        Values of all other leaves, the states of finite variables along batch axes of their own.
    cards : tuple of int
        Their sizes.
    plates : tuple of int
    offset : ndarray, shape (count, states, d)
    gain : ndarray, shape (count, states, d, k)
        Directions, one after the other, are ``offset + gain @ u``.
    elements : ndarray of int, shape (count,)
        Which of the plates' elements these factors are.
    scale : ndarray, shape (count, *cards)
        Added to the log factor.
    """

    program: Program
    leaves: Mapping[str, tuple[int, ...]]
    known: Mapping[str, np.ndarray]
    cards: tuple[int, ...]
    plates: tuple[int, ...]
    offset: np.ndarray
    gain: np.ndarray
    elements: np.ndarray
    bends: int = 0
    how: str = field(default="", init=False)

    def __post_init__(self) -> None:
        d = min(self.gain.shape[-2:])
        how = "quadrature along its own direction" if d == 1 else f"quadrature in {d} dimensions"
        if d > 3:
            how = f"importance sampling in {d} dimensions"
        object.__setattr__(self, "how", how)

    @property
    def _has_few(self) -> bool:
        """Whether every state reads fewer numbers than all states together."""
        return self.gain.shape[-2] < self.gain.shape[-1]

    def log_factor(self, members: np.ndarray, u: np.ndarray) -> np.ndarray:
        """At directions, shape (points, f, states, d), of some factors: shape (points, f, states)."""
        return self._evaluated(members, u)[0]

    def tilted(
        self,
        members: np.ndarray,
        precision: np.ndarray,
        linear: np.ndarray,
        near: tuple[np.ndarray, np.ndarray],
    ) -> Tilt:
        k = self.gain.shape[-1]
        shape = (len(members), *self.cards)
        if self._has_few:
            found = self._by_states(members, precision, linear)
        else:
            lead = len(members), self.offset.shape[1]
            wide = np.broadcast_to(precision[:, None], (*lead, k, k))
            h = np.broadcast_to(linear[:, None], (*lead, k))
            mean = np.broadcast_to(near[0][:, None], (*lead, k))
            cov = np.broadcast_to(near[1][:, None], (*lead, k, k))
            found = self._integrated(members, self.gain[members], wide, h, (mean, cov))
        return Tilt(
            found.log.reshape(shape), found.mean.reshape(*shape, k),
            found.cov.reshape(*shape, k, k), found.error,
        )  # fmt: skip

    def interval(self, members: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Outside of which bounds of their one number factors are zero, shape (f,); None where nowhere.

        Of factors with several stretches, from the first to the last.
        """
        breaks = self._breaks(members, self.offset[members], self.gain[members])
        if breaks is None:
            return None
        edges = np.sort(breaks[:, 0], axis=-1)  # NaN, where there is none, last
        last = np.isfinite(edges).sum(axis=-1, keepdims=True)
        ends = np.take_along_axis(edges, np.maximum(last - 1, 0), axis=-1)
        wide = 1.0 + np.abs(np.nan_to_num(edges)).max(axis=-1, keepdims=True)
        filled = np.where(np.isfinite(edges), edges, ends)
        points = np.concatenate(
            [filled[:, :1] - wide, 0.5 * (filled[:, 1:] + filled[:, :-1]), ends + wide], axis=-1
        )
        u = (
            self.offset[members][None]
            + self.gain[members][None, ..., 0] * points.T[..., None, None]
        )
        alive = self.log_factor(members, u)[..., 0].T > -np.inf
        alive[:, 1:-1] &= np.diff(filled, axis=-1) > 0
        sides = np.concatenate(
            [np.full_like(ends, -np.inf), filled, np.full_like(ends, np.inf)], -1
        )
        rows = np.arange(len(members))
        known = (last[:, 0] > 0) & alive.any(axis=-1)
        low = np.where(known, sides[rows, alive.argmax(axis=-1)], -np.inf)
        top = alive.shape[1] - alive[:, ::-1].argmax(axis=-1)
        high = np.where(known, sides[rows, top], np.inf)
        return low, high

    # ---- private -------------------------------------------------------------------------------

    def _integrated(
        self,
        members: np.ndarray,
        gain: np.ndarray,
        precision: np.ndarray,
        linear: np.ndarray,
        near: tuple[np.ndarray, np.ndarray],
    ) -> Tilt:
        """Over numbers of every state, shapes (f, states, ...), that directions are made of by ``gain``."""

        def log_factor(u: np.ndarray) -> np.ndarray:
            return self.log_factor(members, self.offset[members] + np.matvec(gain, u))

        k = gain.shape[-1]
        if k == 1:
            spread = np.sqrt(near[1][..., 0, 0])
            breaks = self._breaks(members, self.offset[members], gain)
            line = precision[..., 0, 0], linear[..., 0]
            return along_line(log_factor, *line, (near[0][..., 0], spread), breaks)
        rule = on_lattice if k <= 3 else importance
        return rule(log_factor, precision, linear, near)

    def _by_states(self, members: np.ndarray, precision: np.ndarray, linear: np.ndarray) -> Tilt:
        """Every state over the numbers that it reads; others follow as they do in the cavity."""
        gain = self.gain[members]
        cov = inverses(precision)
        mean = np.matvec(cov, linear)
        turned = cov[:, None] @ np.matrix_transpose(gain)
        spread, middle = gain @ turned, np.matvec(gain, mean[:, None])
        idle = (spread.diagonal(0, -2, -1) <= 0).all(axis=-1)  # a state that reads nothing
        d = gain.shape[-2]
        spread = np.where(idle[..., None, None], np.eye(d), spread)
        middle = np.where(idle[..., None], 0.0, middle)
        own = inverses(spread)
        h = np.matvec(own, middle)
        plain = np.where(idle[..., None, None], 0.0, np.eye(d))
        found = self._integrated(members, plain, own, h, (middle, spread))
        log = found.log - log_integral(own, h) + log_integral(precision, linear)[:, None]
        pull = turned @ own
        pull = np.where(idle[..., None, None], 0.0, pull)
        shrink = pull @ (spread - found.cov) @ np.matrix_transpose(pull)
        moved = np.matvec(pull, found.mean - middle)
        return Tilt(log, mean[:, None] + moved, cov[:, None] - shrink, found.error)

    def _breaks(
        self, members: np.ndarray, offset: np.ndarray, gain: np.ndarray
    ) -> np.ndarray | None:
        """Where the log factor jumps or bends along a line, shape (f, states, b)."""
        if not self.bends:
            return None
        base = self._evaluated(members, offset[None])[1:]
        ahead = self._evaluated(members, (offset + gain[..., 0])[None])[1:]
        found = []
        for zero, one in zip(base, ahead, strict=True):
            slope = one[0] - zero[0]
            with np.errstate(all="ignore"):
                found.append(np.where(slope == 0, np.nan, -zero[0] / slope))
        return np.stack(found, axis=-1)

    def _evaluated(self, members: np.ndarray, u: np.ndarray) -> list[np.ndarray]:
        """All roots of the program at directions, shape (points, f, states) each."""
        size = math.prod(self.plates) * math.prod(self.cards) * u.shape[-1]
        most = max(1, _AT_ONCE // max(size, 1))
        if len(u) > most:
            parts = [self._evaluated(members, u[k : k + most]) for k in range(0, len(u), most)]
            return [np.concatenate(p) for p in zip(*parts, strict=True)]
        count, states = math.prod(self.plates), math.prod(self.cards)
        at = self.elements[members]
        if len(at) == count and (at == np.arange(count)).all():
            full = np.moveaxis(u, 2, 1)
        else:
            full = np.zeros((len(u), states, count, u.shape[-1]))
            full[:] = np.moveaxis(u[:, :1], 2, 1)
            full[:, :, at] = np.moveaxis(u, 2, 1)
        values, start = dict(self.known), 0
        for name, shape in self.leaves.items():
            inner = math.prod(shape) // max(count, 1)
            part = full[..., start : start + inner]
            values[name] = part.reshape(len(u), *self.cards, *shape)
            start += inner
        found = []
        for root in self.program(values):
            lead = root.shape[: root.ndim - len(self.plates)]
            batch = (len(u), *self.cards)
            lead = (1,) * (len(batch) - len(lead)) + lead
            wide = np.broadcast_to(root.reshape(*lead, *self.plates), (*batch, *self.plates))
            found.append(np.moveaxis(wide.reshape(len(u), states, count)[:, :, at], 2, 1))
        return found
