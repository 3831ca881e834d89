"""Named nodes whose means are not affine: linearised at each particle's own mean.

As the extended Kalman filter does, level by level of the slice: what reads the slice before is linearised at
what is believed of that, what reads this slice at what is expected of it. Derivatives are those of the
declared functions' expressions, of all particles in one call. What comes of it is an approximation, the
evidence included. Scales that depend on what is integrated out have no place in it, nor have other families.

References
----------
Doucet, de Freitas, Murphy and Russell (2000), UAI 16, sec. 4 (extended Kalman filters in particles); Särkkä
and Svensson (2023), Bayesian Filtering and Smoothing, 2nd ed., ch. 7; Thrun, Burgard and Fox (2005),
Probabilistic Robotics, sec. 13.3 (FastSLAM's landmarks).
"""

from __future__ import annotations

import copy
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from bayesmc.dbn import PREVIOUS
from bayesmc.distributions import (
    Distribution,
    Joint,
    MvNormal,
    Normal,
    VonMises,
    WrappedNormal,
)
from bayesmc.engines.kalman.levels import Followed, Level, Part, Plan
from bayesmc.engines.kalman.reading import Linear
from bayesmc.engines.kalman.slices import Layout, put_noise
from bayesmc.engines.marginal.gaussians import Coefficients, Gaussians
from bayesmc.engines.marginal.predictive import Expected
from bayesmc.engines.marginal.reading import Kinds, SliceReader, Values, leaves_of
from bayesmc.errors import TraceError
from bayesmc.expression import Family, expressions_of
from bayesmc.network.expressions import Opaque, density

#: balances the rounding of a central difference against its curvature
_STEP = float(np.finfo(float).eps ** (1 / 3))
#: families whose location may be bent, and those of angles, which may be seen only
_FAMILIES, _CIRCULAR = (Normal, MvNormal), (VonMises, WrappedNormal)
_NOT_NORMAL = "depends on what is integrated out and is not Normal or MvNormal"


def why_not_bent(layout: Layout, name: str, values: Mapping[str, np.ndarray]) -> str | None:
    """Why a node cannot be linearised in what is unknown, to follow its name; or None.

    Parameters
    ----------
    values : dict
        What is known of the slice, and of the one before.
    """
    model, node = layout.model, layout.model[name]
    if node.is_discrete or node.domain is not None or len(node.event_shape) > 1:
        return "is no number or vector"
    hidden = {n + PREVIOUS for n in layout.before}.union(layout.drawn)
    known = [n for n in (*values, *layout.computed) if n in model.nodes]
    cut = frozenset(n for n in (*hidden, *known) if model[n].kind == "deterministic")
    found = density(model, name, cut)
    if isinstance(found, Opaque):
        return f"cannot be followed ({found.reason})"
    result, above = found.result, hidden & found.leaves
    if node.is_stochastic and above:
        why = _why_no_place(result, hidden)
        if why is not None:
            return why
    try:
        if not Followed(model, [name], sorted(above), known).has_slopes:
            return "has no derivative that is known"
    except TraceError as error:
        return f"cannot be followed ({error})"
    return None


def _why_no_place(result: Any, hidden: Collection[str]) -> str | None:
    """Why a distribution cannot be normal around a mean that moves with what is hidden, or None."""
    if not isinstance(result, Family):
        return None if isinstance(result, Distribution) else _NOT_NORMAL
    if isinstance(result.make, type) and issubclass(result.make, Joint):
        parts = [p for p in result.parameters.values() if isinstance(p, (Family, Distribution))]
        if len(parts) < len(result.parameters):
            return _NOT_NORMAL
        return next((why for p in parts if (why := _why_no_place(p, hidden))), None)
    if result.make not in (*_FAMILIES, *_CIRCULAR):
        return _NOT_NORMAL
    for key, value in result.parameters.items():
        bent = set().union(*(e.leaves for e in expressions_of(value))) & set(hidden)
        if key != "loc" and bent:
            return f"has a {key} that depends on {', '.join(map(repr, sorted(bent)))}"
    return None


class LinearisedReader(SliceReader):
    """Reads the coefficients of slices of one layout off their tangents at a belief.

    Parameters
    ----------
    layout : Layout
    """

    before: Gaussians

    def __init__(self, layout: Layout) -> None:
        super().__init__(layout)
        #: shared by all copies of the reader; with True what is seen is a level of its own
        self._plans: dict[bool, Plan] = {}

    def at(self, before: Gaussians) -> LinearisedReader:
        found = copy.copy(self)
        found.before = before
        return found

    def kinds(self, values: Values, names: object) -> Kinds | None:
        """Every particle by itself: none has another's mean."""
        return None

    def read(self, values: Values) -> Coefficients:
        made = self._linearised(values.at(None), self.before.mean)
        return Coefficients(made.offset[:, None], made.moves[:, None], made.noise[:, None], None)

    def read_choices(self, values: Mapping[str, np.ndarray], kinds: int, choices: int) -> Linear:
        made = self._linearised(dict(values), self.before.mean.repeat(choices, axis=0))
        return Linear(*(a.reshape(kinds, choices, *a.shape[1:]) for a in made))

    def seen_alone(self, names: Collection[str], values: Mapping[str, np.ndarray]) -> bool:
        """Whether, of all numbers of the slice, only seen ones depend on some known nodes.

        Parameters
        ----------
        values : dict
            What is known of the slice, and of the one before, to trace functions with.
        """
        parts, _ = self._apart(self._completed(values))
        return not any(leaves_of(self.layout, part.order) & set(names) for part in parts)

    def expected(
        self, own: Mapping[str, np.ndarray], both: Mapping[str, np.ndarray], choices: int
    ) -> Expected:
        """The slice linearised once for each particle, and what is seen of it for each choice as well.

        Parameters
        ----------
        own : dict
            Known values, without those of the choices.
        both : dict
            With them; an axis of particles and choices together first.
        """
        layout, before = self.layout, self.before
        n = layout.n_prev
        unknown, seen = self._completed(own, partly=True), self._completed(both)
        parts, last = self._apart(seen)
        centre, rows = self._begun(before.mean)
        for part in parts:
            centre, rows = self._passed(part, unknown, centre, rows)
        split, k, places = (len(centre), choices), rows.shape[-1], last.places - n
        level = _Batch(layout, last, seen)
        found, slopes, fresh = level.tangents(centre[:, last.reads].repeat(choices, axis=0))
        means = np.zeros((*split, layout.p))
        means[..., places] = found.reshape(*split, -1)
        slopes = slopes.reshape(*split, *slopes.shape[1:])
        seen_rows = np.zeros((*split, layout.p, k + layout.p))
        seen_rows[..., places, :k] = slopes @ rows[:, None, last.reads]
        seen_rows[..., places, k:] = fresh.reshape(*split, *fresh.shape[1:])
        roots = before.roots()

        def by_normals(moved: np.ndarray, left: np.ndarray) -> np.ndarray:
            """Coefficients of normals, in place of the numbers of the slice before."""
            return np.concatenate([moved[..., :n] @ left, moved[..., n:]], axis=-1)

        at = slice(n + layout.p, None)
        unknown_rows, seen_rows = (
            by_normals(rows[:, at], roots),
            by_normals(seen_rows, roots[:, None]),
        )
        return Expected(centre[:, at], unknown_rows, means, seen_rows)

    # ---- private -------------------------------------------------------------------------------

    def _completed(
        self, values: Mapping[str, np.ndarray], partly: bool = False
    ) -> dict[str, np.ndarray]:
        """With what is computed from known values; ``partly`` from those there are."""
        layout, found = self.layout, dict(values)
        for name in layout.computed:
            if partly and not all(p in found for p in layout.model[name].parents):
                continue
            found[name] = layout.model.evaluate(name, found)[0]
        return found

    def _plan(self, values: Mapping[str, np.ndarray], seen_last: bool = False) -> Plan:
        if seen_last not in self._plans:
            self._plans[seen_last] = Plan(self.layout, values, seen_last)
        return self._plans[seen_last]

    def _apart(self, values: Mapping[str, np.ndarray]) -> tuple[list[Part], Part]:
        """The levels of unknown numbers, and what is seen as a level after these."""
        *parts, last = self._plan(values, seen_last=True).levels
        return parts, last

    def _begun(self, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places and rows of all numbers, those of the slice before filled in."""
        n = self.layout.n_prev
        total, shape = n + self.layout.p + self.layout.n, mean.shape[:-1]
        centre, rows = np.zeros((*shape, total)), np.zeros((*shape, total, n))
        centre[..., :n] = mean
        rows[..., np.arange(n), np.arange(n)] = 1.0
        return centre, rows

    def _passed(
        self, part: Part, values: Mapping[str, np.ndarray], centre: np.ndarray, rows: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """A level put in its places: values at means, and rows of what they read and of noise."""
        level = _Batch(self.layout, part, values)
        found, slopes, fresh = level.tangents(centre[..., part.reads])
        wider = np.zeros((*rows.shape[:-1], fresh.shape[-1]))
        rows = np.concatenate([rows, wider], axis=-1)
        own = slopes @ rows[..., part.reads, :]
        own[..., own.shape[-1] - fresh.shape[-1] :] += fresh
        centre[..., part.places], rows[..., part.places, :] = found, own
        return centre, rows

    def _linearised(self, values: dict[str, np.ndarray], mean: np.ndarray) -> Linear:
        """Tangents at means, shape ``(batch, *lead, n_prev)``."""
        n, values = self.layout.n_prev, self._completed(values)
        centre, rows = self._begun(mean)
        for part in self._plan(values).levels:
            centre, rows = self._passed(part, values, centre, rows)
        moves = rows[..., n:, :n]
        return Linear(centre[..., n:] - np.matvec(moves, mean), moves, rows[..., n:, n:])


class _Batch(Level):
    """The nodes of a level, of all particles at once."""

    part: Part

    def tangents(self, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Values at means, shape ``(batch, *lead, c)``, derivatives there, and rows of the nodes' noise."""
        found, moments = self(mean)
        slopes = self.slopes(mean, mean.shape[:1])
        if slopes is None:
            slopes = self._differences(mean)
        count = found.shape[-1]
        fresh, at = np.zeros((*found.shape, count)), 0
        for name, own in zip(self.part.nodes, moments, strict=True):
            place = slice(at, at + self.layout.size(name))
            if own.scale is not None:
                put_noise(fresh[..., place, place], own.scale)
            at = place.stop
        return found, slopes, fresh

    def _differences(self, mean: np.ndarray) -> np.ndarray:
        """Central differences, where a function has no derivative just there."""
        steps = 2.0 ** np.round(np.log2(_STEP * np.maximum(np.abs(mean), self.part.sizes)))
        columns = []
        for j in range(mean.shape[-1]):
            move = steps * (np.arange(mean.shape[-1]) == j)
            off = self.off(self(mean + move)[0], self(mean - move)[0])
            columns.append(off / (2 * steps[..., j, None]))
        return np.stack(columns, axis=-1)
