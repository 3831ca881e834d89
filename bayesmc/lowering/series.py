"""Slices of one template as machine code: what ``filter_slices`` is given, and the arrays that it fills."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from bayesmc.errors import TraceError
from bayesmc.expression import Expression
from bayesmc.lowering import filter_slices, generator, lineage
from bayesmc.lowering.compiled import Way, address_of
from bayesmc.lowering.filter_slices import MOMENTS, TOLD, passes
from bayesmc.lowering.generator import is_numpys, put_state, state_of, ziggurat
from bayesmc.lowering.kernel import Kernel
from bayesmc.lowering.machine import is_available, is_kept
from bayesmc.lowering.ufuncs import kind_of
from bayesmc.lowering.writer import DTYPES
from bayesmc.shapes import Shape


class Cloud(NamedTuple):
    """Particles of the slice before.

    Attributes
    ----------
    values : dict
        Leaf -> values, particles first.
    log : ndarray, shape (particles,)
        Log weights that particles bring along where they are not resampled.
    weights : ndarray, shape (particles,)
    total, log_total, ess, worst : float
        As ``filter_slices.TOLD`` says.
    moves : ndarray, shape (2, numbers)
        What the moments of ``filter_slices`` go on from.
    rows : ndarray of int64, optional
        Ancestors, where particles are not resampled; by default everybody has itself.
    """

    values: Mapping[str, np.ndarray]
    log: np.ndarray
    weights: np.ndarray
    total: float
    log_total: float
    ess: float
    worst: float = 0.0
    moves: np.ndarray | None = None
    rows: np.ndarray | None = None


class Made(NamedTuple):
    """Slices that were made; row 0 of what ``filter_slices`` fills is that of the slice before.

    Attributes
    ----------
    slices : int
        How many.
    told : ndarray, shape (slices + 1, len(filter_slices.TOLD))
    moments : ndarray, shape (slices + 1, numbers, len(filter_slices.MOMENTS))
    at : ndarray of int64, shape (slices + 1, columns)
    held : list of ndarray
        What the addresses point to.
    """

    slices: int
    told: np.ndarray
    moments: np.ndarray
    at: np.ndarray
    held: list[np.ndarray]


class Numbers(NamedTuple):
    """Of which numbers moments are taken, and how what rows do to them is followed.

    Attributes
    ----------
    where : ndarray of int64, shape (numbers, 4)
        As ``filter_slices.passes`` says.
    fading, kept, least : float
        The same of its ``fading``, ``kept`` and ``least_expected``.
    """

    where: np.ndarray
    fading: float
    kept: float
    least: float


#: where none are
NO_NUMBERS = Numbers(np.zeros((0, 4), np.int64), 0.0, 0.0, 0.0)


class Noise(NamedTuple):
    """Random numbers that each particle has of its own: standard normals, or uniform ones from [0, 1)."""

    shape: Shape
    is_uniform: bool = False


class SliceKernel:
    """Expressions of many particles, whose values in the slice before are those of their ancestors.

    Parameters
    ----------
    roots : sequence of Expression
        Values of nodes, and last the log density of what is seen.
    own : dict
        Leaf of random numbers -> which, in the order of drawing.
    chosen : frozenset of str
        Leaves with a value for each particle before. Of all others there is one value.

    only_kept : bool, optional
        Take what an earlier run has compiled, and compile nothing.

    Attributes
    ----------
    known : list of Leaf
        Of which there is one value.

    Raises
    ------
    TraceError
    """

    def __init__(
        self,
        roots: Sequence[Expression],
        own: Mapping[str, Noise],
        chosen: frozenset[str],
        only_kept: bool = False,
    ) -> None:
        if not is_available():
            raise TraceError("machine code needs llvmlite: pip install bayesmc[fast]")
        if any(r.dtype.kind != "f" for r in roots):
            raise TraceError("particles that are not real numbers")
        varying = chosen | own.keys()
        if not all(r.leaves & varying for r in roots) or not own:
            raise TraceError("what is the same for all particles is made by plain steps")
        kernel = Kernel(roots, varying, chosen)
        texts = (kernel.text, *(module.text()[0] for module in (generator, filter_slices, lineage)))
        if only_kept and not all(map(is_kept, texts)):
            raise TraceError("it would have to be compiled")
        if not is_numpys():
            raise TraceError("this NumPy draws normals in a way of its own")
        self.shapes = [r.shape for r in roots[:-1]]
        self.own, self.chosen = dict(own), chosen
        self.way = Way(roots, varying, kernel)
        self.known = [n for n in self.way.kernel.leaves if n.name not in varying]


class SliceCall:
    """Calls of a kernel for filters of so many particles, not from two threads at once.

    Parameters
    ----------
    kernel : SliceKernel
    before : sequence of (str or None)
        For each node of the kernel's results, the leaf of its value in the slice before.
    particles : int
        At most.
    block : int
        Particles that are worked on at a time.
    """

    def __init__(
        self, kernel: SliceKernel, before: Sequence[str | None], particles: int, block: int
    ) -> None:
        way, self._kernel, self._block = kernel.way, kernel, min(block, particles)
        results = len(kernel.shapes) + 1
        self._table, self._memory = way.table(results)
        first = len(self._table) - results
        at = {n.name: k for k, n in enumerate(way.kernel.leaves)}
        own = [(k, 8 * math.prod(s)) for k, s in enumerate(kernel.shapes, first)]
        #: leaves that are no results of the slice before, in columns behind those of results
        self._others = [n for n in at if n in kernel.chosen and n not in before]
        self._leaves = [*before, *self._others]
        leaves = [at.get(leaf or "", -1) for leaf in before]
        node = [(place, leaf, size) for leaf, (place, size) in zip(leaves, own, strict=True)]
        node += [(-1, at[leaf], 0) for leaf in self._others]
        self._node = np.array(node, np.int64)
        sizes = {n: math.prod(z.shape) for n, z in kernel.own.items()}
        self._noise = {n: np.empty(self._block * size) for n, size in sizes.items()}
        self._noises = np.array(
            [(address_of(self._noise[n]), sizes[n], z.is_uniform) for n, z in kernel.own.items()],
            np.int64,
        )
        for name in self._noise.keys() & at.keys():
            self._table[at[name]] = address_of(self._noise[name])
        self._places = [at[n.name] for n in kernel.known]
        self._rows_place = first - 1 if kernel.chosen else -1
        self._identity = np.arange(particles, dtype=np.int64)
        self._running, self._points = np.empty(particles), np.empty(particles + 1)
        self._run = passes()
        self._fixed = [
            *(way.loaded.address, address_of(self._table)),
            *(address_of(a) for a in (ziggurat(), self._node, self._noises)),
        ]

    def __call__(
        self,
        least: float,
        cloud: Cloud,
        known: Sequence[tuple[int, int]],
        arrays: Sequence[np.ndarray],
        rng: np.random.Generator,
        numbers: Numbers = NO_NUMBERS,
        strata: bool = False,
    ) -> Made:
        """As many slices as arrays have rows, up to one that is to be made in another way.

        Parameters
        ----------
        least : float
            Effective number of particles below which they are resampled.
        cloud : Cloud
        known : sequence of (int, int)
            Of each of the kernel's known leaves, where its value in the first slice lies, and the bytes to
            that of the next one.
        arrays : sequence of ndarray
            To be filled: log weights, weights, ancestors (one more than there are particles), values of each
            node, each ``(slices, particles, ...)``.
        rng : Generator
            It goes on behind the last slice that was made.
        numbers : Numbers, optional
        strata : bool, optional
            Particles are resampled by a point in each stratum, not by a comb.
        """
        slices, particles = arrays[0].shape
        at = np.zeros((slices + 1, 3 + len(self._leaves)), np.int64)
        sizes = np.array([a.nbytes // slices for a in arrays])
        at[1:, : len(arrays)] = [address_of(a) for a in arrays] + np.arange(slices)[:, None] * sizes
        held = [cloud.log, cloud.weights, *arrays]
        at[0, :2] = [address_of(a) for a in held[:2]]
        for k, leaf in enumerate(self._leaves, 3):
            if leaf in self._kernel.chosen:
                held.append(np.ascontiguousarray(cloud.values[leaf], float))
                at[0, k] = address_of(held[-1])
        moving = np.array(
            [(place, *each) for place, each in zip(self._places, known, strict=True)]
            or [(0, 0, 0)],
            np.int64,
        )
        told, state = np.empty((slices + 1, len(TOLD))), state_of(rng)
        told[0] = cloud.total, cloud.log_total, cloud.ess, 0.0, 0.0, 0.0, cloud.worst
        many = len(numbers.where)
        moments = np.zeros((slices + 1, many, len(MOMENTS)))
        if cloud.moves is not None:
            moments[0, :, -2:] = cloud.moves.T
        rows = self._identity if cloud.rows is None else np.ascontiguousarray(cloud.rows, np.int64)
        kernel, table, *fixed = self._fixed
        made = self._run(
            slices, particles, self._block, len(self._leaves), len(self._noise), len(self._places),
            self._rows_place, len(self._table) - 1, many, strata, least, math.log(particles), numbers.fading,
            numbers.kept, numbers.least, kernel, table, address_of(state), *fixed,
            *(address_of(a) for a in (moving, at, rows, self._running, told)),
            numbers.where.ctypes.data, moments.ctypes.data, address_of(self._points),
        )  # fmt: skip
        put_state(rng, state)
        return Made(made, told, moments, at, held)


def known_column(leaf: Expression, values: np.ndarray) -> np.ndarray:
    """Values of a leaf as its kernel reads them, whatever comes first."""
    lead = values.shape[: values.ndim - len(leaf.shape)]
    return np.ascontiguousarray(
        np.broadcast_to(values, (*lead, *leaf.shape)), DTYPES[kind_of(leaf)]
    )
