"""A slice as the coefficients of every particle's Kalman filter, given what was sampled.

Coefficients are worked out once for particles that agree on all finite nodes that they depend on, and kept
where they depend on nothing else; else for every particle. Where they come out the same, particles share
them, and with them their covariances.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from bayesmc.dbn import PREVIOUS
from bayesmc.engines.kalman.reading import Linear, composed
from bayesmc.engines.kalman.slices import Layout
from bayesmc.engines.marginal.gaussians import Coefficients, Gaussians

#: joint states of finite nodes up to which they are told apart by a table
_STATES = 4096


class Kinds:
    """Particles by the joint states of finite nodes.

    Attributes
    ----------
    codes : ndarray of int, shape (kinds,)
    of_kind : ndarray of int, shape (kinds,)
        A particle of each.
    kind : ndarray of int, shape (particles,)
    """

    def __init__(self, columns: Sequence[np.ndarray], sizes: Sequence[int], particles: int) -> None:
        code = np.zeros(particles, dtype=np.intp)
        for column, size in zip(columns, sizes, strict=True):
            code = code * size + column
        states = math.prod(sizes)
        if states <= _STATES:
            present = np.bincount(code, minlength=states)
            self.codes = np.flatnonzero(present)
            place = np.zeros(states, dtype=np.intp)
            place[self.codes] = np.arange(len(self.codes))
            self.kind = place.take(code)
            of_kind = np.zeros(states, dtype=np.intp)
            of_kind[code] = np.arange(particles)
            self.of_kind = of_kind.take(self.codes)
        else:
            found = np.unique(code, return_index=True, return_inverse=True)
            self.codes, self.of_kind, self.kind = found


class Values:
    """Stored values in a slice and in the one before it, of all particles or of some.

    Parameters
    ----------
    plain : dict
        Values that all particles agree on.
    own : dict
        Values with an axis of particles.
    particles : int
    """

    def __init__(
        self, plain: Mapping[str, np.ndarray], own: Mapping[str, np.ndarray], particles: int
    ) -> None:
        self.plain, self.own, self.particles = dict(plain), dict(own), particles

    def at(self, which: np.ndarray | None) -> dict[str, np.ndarray]:
        """Of some particles; of all with None."""
        if which is None:
            return {**self.plain, **self.own}
        return {**self.plain, **{n: v.take(which, axis=0) for n, v in self.own.items()}}


class SliceReader:
    """Reads the coefficients of slices of one layout.

    Parameters
    ----------
    layout : Layout
    """

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        #: known values that the slice's numbers depend on
        self.leaves = leaves_of(layout, layout.placed)
        #: and those that anything known depends on, too
        self.needed = leaves_of(layout, layout.order)
        self.hidden_before = frozenset(n + PREVIOUS for n in layout.before)
        self._kept: dict[int, int] = {}
        self._made: Linear | None = None

    def at(self, before: Gaussians) -> SliceReader:
        """A reader for particles with these beliefs about the slice before."""
        return self

    def kinds(self, values: Values, names: Sequence[str]) -> Kinds | None:
        """Particles by what they have of some nodes; None where any of these is not finite."""
        columns: list[np.ndarray] = []
        sizes: list[int] = []
        for name in names:
            domain = self.layout.model[name].domain
            if domain is None:
                return None
            flat = values.own[name].reshape(values.particles, -1).T
            columns += [*flat]
            sizes += [domain.size] * len(flat)
        if math.prod(map(float, sizes)) > 2.0**52:
            return None
        return Kinds(columns, sizes, values.particles)

    def read(self, values: Values) -> Coefficients:
        """The coefficients of every particle.

        Raises
        ------
        UnsupportedError, ParameterError
        """
        varying = sorted(self.leaves & values.own.keys())
        kinds = self.kinds(values, varying)
        if kinds is None:
            finite = [n for n in varying if self.layout.model[n].domain is not None]
            return self._shared(self._composed(values, None), self.kinds(values, finite), values)
        if self.changing(values, self.leaves):
            found, kind = self._composed(values, kinds.of_kind), kinds.kind
        else:
            found, kind = self._remembered(values, kinds)
        offset = found.offset.take(kind, axis=0)
        return _with_choices(offset, found.moves, found.noise, kind)

    def changing(self, values: Values, leaves: frozenset[str]) -> bool:
        """Whether anything is read that is the same for all particles, and not in all slices."""
        return bool(leaves & values.plain.keys() - set(self.layout.slices.template.static))

    def read_choices(self, values: Mapping[str, np.ndarray], kinds: int, choices: int) -> Linear:
        """The same by kind and choice of finite nodes; ``values`` have an axis of both together first."""
        made = composed(self.layout, dict(values), (kinds * choices,))
        return Linear(*(a.reshape(kinds, choices, *a.shape[1:]) for a in made))

    # ---- private -------------------------------------------------------------------------------

    def _composed(self, values: Values, which: np.ndarray | None) -> Linear:
        count = values.particles if which is None else len(which)
        return composed(self.layout, values.at(which), (count,))

    def _remembered(self, values: Values, kinds: Kinds) -> tuple[Linear, np.ndarray]:
        """Coefficients of all kinds so far, and which each particle has."""
        new = [k for k, code in enumerate(kinds.codes.tolist()) if code not in self._kept]
        if new:
            if len(self._kept) > _STATES:
                self._kept, self._made, new = {}, None, list(range(len(kinds.codes)))
            fresh = self._composed(values, kinds.of_kind[new])
            for k in new:
                self._kept[int(kinds.codes[k])] = len(self._kept)
            old = self._made
            self._made = (
                fresh
                if old is None
                else Linear(*(np.concatenate(p) for p in zip(old, fresh, strict=True)))
            )
        assert self._made is not None
        place = np.array([self._kept[c] for c in kinds.codes.tolist()], dtype=np.intp)
        return self._made, place.take(kinds.kind)

    def _shared(self, found: Linear, kinds: Kinds | None, values: Values) -> Coefficients:
        """Without copies of matrices that particles have in common."""
        for own in (Kinds([], [], values.particles), kinds):
            if own is None:
                continue
            parts = [a.take(own.of_kind, axis=0) for a in (found.moves, found.noise)]
            if all(
                np.array_equal(part.take(own.kind, axis=0), whole)
                for part, whole in zip(parts, (found.moves, found.noise), strict=True)
            ):
                return _with_choices(found.offset, parts[0], parts[1], own.kind)
        return _with_choices(found.offset, found.moves, found.noise, None)


def leaves_of(layout: Layout, names: Sequence[str]) -> frozenset[str]:
    """Known values that some nodes' functions read, directly or through computed nodes that are known."""
    hidden = layout.unknown | {n + PREVIOUS for n in layout.before}
    found: set[str] = set()
    todo, met = list(names), set(names)
    while todo:
        for parent in layout.model[todo.pop()].parents:
            if parent in met or parent in hidden:
                continue
            if parent in layout.computed:
                met.add(parent)
                todo.append(parent)
            else:
                found.add(parent)
    return frozenset(found)


# ---- private ------------------------------------------------------------------------------------


def _with_choices(
    offset: np.ndarray, moves: np.ndarray, noise: np.ndarray, kind: np.ndarray | None
) -> Coefficients:
    """Of a single choice."""
    return Coefficients(offset[:, None], moves[:, None], noise[:, None], kind)
