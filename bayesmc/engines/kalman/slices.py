"""Where the numbers of a slice stand in the one vector that Gaussian filters work on.

A slice's unknown numbers are stacked: first those that the next slice reads, then the others. Deterministic
nodes that depend on unknown ones are in it, too, as rows without noise. Nodes seen in full are known numbers
wherever functions read them; their own densities are rows of their own. Plates whose elements never meet are
leading axes of everything; elements of other plates are stacked.

Reading coefficients is elsewhere (``reading``); so is everything that happens over time.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from bayesmc.dbn import PREVIOUS, Slices
from bayesmc.distributions import Distribution, MvNormal
from bayesmc.errors import UnsupportedError
from bayesmc.network import CompiledNode
from bayesmc.network.model import invalid_error
from bayesmc.shapes import Shape


def unknown_nodes(
    slices: Slices, first: bool, known: Iterable[str], before: Iterable[str]
) -> frozenset[str]:
    """Nodes of a slice whose values are not known: hidden ones, and what is computed from them.

    Parameters
    ----------
    first : bool
        Slice 0, or a later one.
    known : iterable of str
        Nodes with a density that are seen in full.
    before : iterable of str
        Nodes that are not known in the slice before.
    """
    model = slices.first if first else slices.later
    known, found = set(known), {n + PREVIOUS for n in before}
    for name in _ordered(slices, first):
        node = model[name]
        if node.is_stochastic:
            hidden = name not in known
        else:
            hidden = any(p in found for p in node.parents)
        if hidden:
            found.add(name)
    return frozenset(n for n in slices.dynamic if n in found)


def always_unknown(slices: Slices, known: Iterable[str]) -> frozenset[str]:
    """Nodes that are unknown in some slice of a series in which ``known`` are seen in full throughout."""
    known = tuple(known)
    found = unknown_nodes(slices, True, known, ())
    while True:
        more = found | unknown_nodes(slices, False, known, found)
        if more == found:
            return found
        found = more


class Moments(NamedTuple):
    """Mean and noise of a node for a batch of parents.

    Attributes
    ----------
    mean : ndarray, shape (*batch, *lead, e)
    scale : ndarray or None
        Standard deviations, shape like ``mean``, or roots of covariances, shape (*batch, *lead, elements, d,
        d), one for each element of the stacked plates; None without noise.
    """

    mean: np.ndarray
    scale: np.ndarray | None


class Layout:
    """The vector of a slice.

    Parameters
    ----------
    slices : Slices
    apart : tuple of str
        Plates that are leading axes.
    first : bool
    before : tuple of str
        Nodes of the slice before that this one reads and that are not known there, in order.
    unknown : frozenset of str
        Nodes that are not known in this one.

    Attributes
    ----------
    order : tuple of str
        Nodes of the slice, parents first.
    lead : tuple of int
        Sizes of the plates apart.
    prev : dict
        Node of the slice before -> its place among ``n_prev`` numbers.
    rows : dict
        Unknown node -> its place among ``n`` numbers; those of the first ``carried`` are read by the next.
    seen : dict
        Known node whose density depends on unknown ones -> its place among ``p`` numbers.
    certain : tuple of str
        Known nodes whose density does not.
    computed : tuple of str
        Deterministic nodes whose value is known.
    silent : tuple of str
        Deterministic nodes computed from unknown ones that jump from value to value: truth values, whole
        numbers, states. They have no place in the vector and no answer; functions that read them do.
    """

    def __init__(
        self,
        slices: Slices,
        apart: tuple[str, ...],
        first: bool,
        before: tuple[str, ...],
        unknown: frozenset[str],
    ) -> None:
        self.slices, self.apart, self.first = slices, apart, first
        self.model = slices.first if first else slices.later
        self.lead = tuple(self.model.sizes[p] for p in apart)
        self.unknown = unknown
        self.before = () if first else before
        self.order = _ordered(slices, first)
        self.silent = tuple(n for n in self.order if n in unknown and _jumps(slices, n))
        loud = unknown.difference(self.silent)
        own = (*(n for n in slices.interface if n in loud),
               *(n for n in slices.dynamic if n in loud and n not in slices.interface))  # fmt: skip
        self.after = tuple(n for n in own if n in slices.interface)
        self.prev, self.n_prev = self._places(self.before)
        self.rows, self.n = self._places(own)
        self.carried = sum(self.size(n) for n in self.after)
        depends = self._dependent()
        nodes = [self.model[n] for n in self.order if n not in unknown]
        self.seen, self.p = self._places(
            n.name for n in nodes if n.is_stochastic and n.name in depends
        )
        self.certain = tuple(n.name for n in nodes if n.is_stochastic and n.name not in depends)
        self.computed = tuple(n.name for n in nodes if not n.is_stochastic)
        #: nodes with a place among the seen or the unknown numbers, parents first
        self.placed = tuple(n for n in self.order if n in self.seen or n in self.rows)
        #: unknown nodes with a density: those that functions of the same slice can be moved along
        self.drawn = tuple(n for n in self.order if n in unknown and self.model[n].is_stochastic)
        self.depends = depends

    def __getstate__(self) -> dict[str, Any]:
        """Pickles travel without functions."""
        return {**self.__dict__, "model": self.model.without_functions()}

    def size(self, name: str) -> int:
        """How many numbers a node has, plates apart not counted."""
        node = self.slices.first[name]
        return math.prod(node.value_shape) // max(
            math.prod(n for p, n in zip(node.plates, node.plate_shape, strict=True) if p in self.apart), 1
        )  # fmt: skip

    def place(self, name: str) -> slice:
        """Where the numbers of a node stand among the seen and the unknown ones."""
        if name in self.seen:
            return self.seen[name]
        rows = self.rows[name]
        return slice(self.p + rows.start, self.p + rows.stop)

    def angles_of(self, name: str) -> np.ndarray:
        """Which of a node's numbers are angles, shape (size,): as in later slices, which all but one are."""
        node = self.slices.later[name]
        if node.angles is None:
            return np.zeros(self.size(name), dtype=bool)
        full = self.packed(node, np.broadcast_to(node.angles, node.value_shape))
        return full.reshape(-1, self.size(name))[0]

    @cached_property
    def angles(self) -> np.ndarray | None:
        """Which of the seen and the unknown numbers are angles, shape (p + n,); None where none is."""
        found = np.zeros(self.p + self.n, dtype=bool)
        for name, place in self.seen.items():
            found[place] = self.angles_of(name)
        for name, place in self.rows.items():
            found[self.p + place.start : self.p + place.stop] = self.angles_of(name)
        return found if found.any() else None

    def packed(self, node: CompiledNode, value: np.ndarray) -> np.ndarray:
        """Stored values, shape (*batch, *plates, *event), as (*batch, *lead, e)."""
        count = value.ndim - len(node.value_shape)
        batch = value.shape[:count]
        if self.apart:
            ahead = [node.plates.index(p) for p in self.apart]
            rest = [k for k in range(len(node.value_shape)) if k not in ahead]
            value = value.transpose(*range(count), *(count + k for k in (*ahead, *rest)))
        return value.reshape((*batch, *self.lead, -1))

    def unpacked(self, node: CompiledNode, value: np.ndarray) -> np.ndarray:
        """The inverse of ``packed``."""
        count = value.ndim - 1 - len(self.lead)
        if not self.apart:
            return value.reshape(value.shape[:count] + node.value_shape)
        ahead = [node.plates.index(p) for p in self.apart]
        order = [*ahead, *(k for k in range(len(node.value_shape)) if k not in ahead)]
        shape = tuple(node.value_shape[k] for k in order)
        value = value.reshape(value.shape[:count] + shape)
        return value.transpose(*range(count), *(count + k for k in np.argsort(order)))

    def moments(
        self, node: CompiledNode, result: Any, batch: Shape, own: Shape | None = None
    ) -> Moments:
        """What a function makes of parents with a batch ``own`` that broadcasts to ``batch``.

        Raises
        ------
        ParameterError
        """
        full, own = batch + node.value_shape, batch if own is None else own
        if not isinstance(result, Distribution):
            return Moments(self.packed(node, np.broadcast_to(result, full)), None)
        if result.invalid is not None:
            error = invalid_error(node, result, np.ones(own, dtype=bool), own, noiseless=True)
            if error is not None:
                raise error
        mean = self.packed(node, np.broadcast_to(result.mean, full))
        root = covariance_root(result)
        if root is not None:
            d = full[-1]
            root = np.broadcast_to(root, batch + node.plate_shape + (d, d))
            return Moments(mean, self._blocks(node, root, d))
        return Moments(mean, self.packed(node, np.broadcast_to(np.sqrt(_variance(result)), full)))

    # ---- private -------------------------------------------------------------------------------

    def _places(self, names: Iterable[str]) -> tuple[dict[str, slice], int]:
        found, at = {}, 0
        for name in names:
            size = self.size(name)
            found[name] = slice(at, at + size)
            at += size
        return found, at

    def _dependent(self) -> frozenset[str]:
        """Nodes whose function reads unknown ones, directly or through deterministic nodes."""
        given = {n + PREVIOUS for n in self.before} | self.unknown
        return frozenset(n for n in self.order if any(p in given for p in self.model[n].parents))

    def _blocks(self, node: CompiledNode, tril: np.ndarray, d: int) -> np.ndarray:
        """Roots of vectors, shape (*batch, *lead, elements, d, d)."""
        count = tril.ndim - 2 - len(node.plates)
        if self.apart:
            ahead = [node.plates.index(p) for p in self.apart]
            rest = [k for k in range(len(node.plates) + 2) if k not in ahead]
            tril = tril.transpose(*range(count), *(count + k for k in (*ahead, *rest)))
        return tril.reshape((*tril.shape[:count], *self.lead, -1, d, d))


def covariance_root(result: Any) -> np.ndarray | None:
    """A root of the covariance of a vector, shape (*batch, d, d), which may be singular; or None.

    ``MvNormal`` has one; any other family is matched by its moments if it has ``mean`` and ``cov_root``, such
    that ``cov_root @ cov_root.T`` is its covariance. That of an angle is of its deviation from the mean.
    """
    if isinstance(result, MvNormal):
        return result.scale_tril
    return getattr(result, "cov_root", None)


def put_noise(rows: np.ndarray, scale: np.ndarray) -> None:
    """Write a node's own noise into its rows, ``(..., e, e)``, where there are zeros."""
    e = rows.shape[-1]
    if scale.ndim == rows.ndim - 1:
        index = np.arange(e)
        rows[..., index, index] = scale
        return
    d = scale.shape[-1]
    for k in range(e // d):
        at = slice(k * d, (k + 1) * d)
        rows[..., at, at] = scale[..., k, :, :]


# ---- private ------------------------------------------------------------------------------------


def _ordered(slices: Slices, first: bool) -> tuple[str, ...]:
    """Nodes of a slice, parents first: in slice 0 they may have other parents than later."""
    model = slices.first if first else slices.later
    wanted = set(slices.dynamic)
    return tuple(n for n in model.nodes if n in wanted)


def _jumps(slices: Slices, name: str) -> bool:
    """Whether a node is computed and takes no continuous values."""
    nodes = (slices.first[name], slices.later[name])
    return any(not n.is_stochastic and (n.is_discrete or n.domain is not None) for n in nodes)


def _variance(result: Any) -> np.ndarray:
    """The variance that a family is matched by; that of angles is ``-2 log R``.

    It is the variance of the wrapped normal distribution with the same mean resultant length R.
    """
    found = np.asarray(result.var)
    if np.isfinite(found).all():
        return found
    raise UnsupportedError(
        f"{type(result).__name__} has no finite variance, which Gaussian filters need; use a ParticleFilter"
    )
