"""Transitions of the No-U-Turn sampler in machine code: held against those in NumPy before they are used."""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.errors import TraceError
from bayesmc.kernels.no_u_turn import Gradient, Place, Scale, Transition, transition
from bayesmc.lowering import Trajectories
from bayesmc.structure.compiled_density import CompiledDensity
from bayesmc.structure.target import Values

#: chains whose first transition is compared, and doublings of it
_CHAINS, _DEPTH = 8, 3
#: how far draws may be off: a step multiplies errors of rounding
_RTOL = 1e-6
#: how far densities and gradients of draws may be off where every draw is compared
_EACH = 1e-8
_BITS = (1 << 64) - 1


class CompiledTransition:
    """A transition of all chains: the tree that ``no_u_turn.transition`` grows, by random numbers of its own.

    Parameters
    ----------
    run : Trajectories
    density : CompiledDensity
        What is known of places.
    threads : int
        Threads that share the chains; the result is the same.
    """

    def __init__(self, run: Trajectories, density: CompiledDensity, threads: int = 1) -> None:
        self.run, self.density, self.threads = run, density, threads
        self.is_checked = False

    def __call__(
        self,
        gradient: Gradient,
        place: Place,
        step: np.ndarray,
        scale: Scale,
        rng: np.random.Generator,
        max_depth: int,
        values: Values,
    ) -> Transition:
        """See ``no_u_turn.transition``.

        Raises
        ------
        TraceError
            The first one is another than NumPy makes, or any where ``density.debug`` compares all.
        """
        momenta = rng.standard_normal(place.u.shape)
        seeds = rng.integers(0, 1 << 64, (len(place.u), 4), np.uint64)
        if not self.is_checked:
            self._check(gradient, place, step, scale, momenta, seeds, values)
            self.is_checked = True
        found = self._moved(gradient, place, step, scale, momenta, seeds, max_depth, values)
        if self.density.debug:
            _compare_place(found.place, gradient)
        return found

    # ---- private -------------------------------------------------------------------------------

    def _moved(
        self,
        gradient: Gradient,
        place: Place,
        step: np.ndarray,
        scale: Scale,
        momenta: np.ndarray,
        seeds: np.ndarray,
        max_depth: int,
        values: Values,
    ) -> Transition:
        def ask(chain: int, u: np.ndarray) -> tuple[float, np.ndarray]:
            log, slope = gradient(u[None], np.array([chain]))
            return float(log[0]), slope[0]

        u, log, slope = (np.array(part, float, order="C") for part in place)
        root, step = (np.ascontiguousarray(a, float) for a in (scale.root, step))
        others = {n: values[n] for n in self.density.others}
        told = self.run.move(
            (u, log, slope), momenta, step, root, seeds, max_depth, ask, others, self.threads
        )
        leaves, divergent = told.leaves.astype(int), told.divergent > 0
        return Transition(
            Place(u, log, slope), told.acceptance, divergent, told.depth.astype(int), told.energy,
            int(leaves.max(initial=0)), int(leaves.sum()),
        )  # fmt: skip

    def _check(
        self,
        gradient: Gradient,
        place: Place,
        step: np.ndarray,
        scale: Scale,
        momenta: np.ndarray,
        seeds: np.ndarray,
        values: Values,
    ) -> None:
        """Grow some small trees both ways, with the same random numbers."""
        rows = np.arange(min(len(momenta), _CHAINS))
        own = {n: values[n][rows] for n in self.density.others}
        some = Place(*(part[rows] for part in place))
        found = self._moved(
            gradient, some, step[rows], scale, momenta[rows], seeds[rows].copy(), _DEPTH, own
        )
        for row in range(len(rows)):
            one = slice(row, row + 1)
            numbers: Any = SameNumbers(momenta[one], seeds[row])
            wanted = transition(
                lambda u, _, row=row: gradient(u, np.full(len(u), row)),  # type: ignore[misc]
                Place(*(part[one] for part in some)), step[one], scale, numbers, _DEPTH,
            )  # fmt: skip
            _compare(found, wanted, row)


class SameNumbers:
    """The numbers that machine code draws for one chain, as ``transition`` asks for them.

    Parameters
    ----------
    momenta : ndarray, shape (1, size)
    seed : ndarray of uint64, shape (4,)

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.kernels.compiled_transition import SameNumbers
    >>> SameNumbers(np.zeros((1, 1)), np.arange(1, 5, dtype=np.uint64) << 60).random(2)
    array([0.0625, 0.4375])
    """

    def __init__(self, momenta: np.ndarray, seed: np.ndarray) -> None:
        self._momenta, self._state = momenta, [int(s) for s in seed]

    def standard_normal(self, shape: object) -> np.ndarray:
        return self._momenta

    def random(self, count: int) -> np.ndarray:
        """Uniform numbers above 0, by xoshiro256++."""
        return np.array([self._next() for _ in range(count)])

    def standard_exponential(self, shape: int | tuple[int, ...]) -> np.ndarray:
        return -np.log(self.random(int(np.prod(shape)))).reshape(shape)

    def _next(self) -> float:
        s = self._state
        found = (_rotated((s[0] + s[3]) & _BITS, 23) + s[0]) & _BITS
        t = (s[1] << 17) & _BITS
        third, fourth = s[2] ^ s[0], s[3] ^ s[1]
        self._state = [s[0] ^ fourth, s[1] ^ third, third ^ t, _rotated(fourth, 45)]
        return ((found >> 11) + 1) * 2.0**-53


# ---- private ------------------------------------------------------------------------------------


def _rotated(x: int, by: int) -> int:
    return ((x << by) | (x >> (64 - by))) & _BITS


def _compare(found: Transition, wanted: Transition, row: int) -> None:
    same = found.depth[row] == wanted.depth[0] and found.divergent[row] == wanted.divergent[0]
    for a, b in zip(found.place, wanted.place, strict=True):
        same = same and np.allclose(a[row], b[0], rtol=_RTOL, atol=_RTOL)
    if not same:
        raise TraceError(
            f"a trajectory of chain {row} in machine code ends at {found.place.u[row][:3]}..., "
            f"and in NumPy at {wanted.place.u[0][:3]}..."
        )


def _compare_place(place: Place, gradient: Gradient) -> None:
    log, slope = gradient(place.u, np.arange(len(place.u)))
    for what, a, b in (("log density", place.log, log), ("gradient", place.slope, slope)):
        if not np.allclose(a, b, rtol=_EACH, atol=_EACH * (1.0 + np.abs(b).max(initial=0.0))):
            raise TraceError(f"the {what} where machine code ended is another in NumPy")
