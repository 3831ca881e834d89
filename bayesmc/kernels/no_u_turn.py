"""One transition of the No-U-Turn sampler, of all chains in one array.

A chain's tree is doubled until its ends turn towards each other, here or in one of its balanced subtrees. All
chains that go on are at the same leaf of trees of the same depth, so that one loop grows all trees; a chain
that has ended leaves the arrays, so that the work does not grow with the longest tree of all. A subtree is
a sum of momenta and those of its first and last leaf; pending ones wait as the digits of a binary counter.

Momenta are those of whitened numbers, in which the metric is the identity: ``u`` moves along ``scale @ p``.

References
----------
Hoffman and Gelman (2014), JMLR 15; Betancourt (2017), A conceptual introduction to Hamiltonian Monte Carlo,
arXiv 1701.02434, appendix A.3 to A.5 (multinomial draws, the generalised criterion); Stan Development Team
(2020), Stan 2.24 (the criterion across neighbouring subtrees).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

#: error of the energy beyond which a trajectory has left the level set that it should follow
DIVERGENT = 1000.0

#: ``gradient(u, rows)``: log densities ``(rows,)`` and their gradients ``(rows, size)`` of some chains
Gradient = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


class Place(NamedTuple):
    """Where chains are: free numbers ``(chains, size)``, log densities and gradients there."""

    u: np.ndarray
    log: np.ndarray
    slope: np.ndarray


@dataclass(frozen=True)
class Scale:
    """A square root of the inverse metric: standard deviations ``(size,)``, or a matrix ``(size, size)``.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.kernels.no_u_turn import Scale
    >>> Scale(np.array([1.0, 10.0])).pushed(np.ones((1, 2)))
    array([[ 1., 10.]])
    """

    root: np.ndarray

    def pushed(self, momenta: np.ndarray) -> np.ndarray:
        """Velocities of the free numbers, given whitened momenta."""
        return momenta * self.root if self.root.ndim == 1 else momenta @ self.root.T

    def pulled(self, slope: np.ndarray) -> np.ndarray:
        """Gradients by whitened numbers, given those by free ones."""
        return slope * self.root if self.root.ndim == 1 else slope @ self.root


@dataclass(frozen=True)
class Transition:
    """Where a transition ended, and what was seen on the way, each ``(chains,)``.

    Attributes
    ----------
    place : Place
    acceptance : ndarray
        Mean of the chances with which a Metropolis step would have taken each leaf.
    divergent : ndarray of bool
    depth : ndarray of int
        Doublings of the tree.
    energy : ndarray
        Of the first point of the trajectory.
    calls, points : int
        Evaluations of the gradient, and points that it was evaluated at.
    """

    place: Place
    acceptance: np.ndarray
    divergent: np.ndarray
    depth: np.ndarray
    energy: np.ndarray
    calls: int
    points: int


def transition(
    gradient: Gradient,
    place: Place,
    step: np.ndarray,
    scale: Scale,
    rng: np.random.Generator,
    max_depth: int = 10,
) -> Transition:
    """One step of every chain, which leaves the density invariant and is its own reverse.

    Parameters
    ----------
    gradient : callable
    place : Place
    step : ndarray, shape (chains,)
        Length of a leapfrog step, in whitened numbers.
    scale : Scale
    max_depth : int
        Doublings, at most.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.kernels.no_u_turn import Place, Scale, transition
    >>> def gradient(u, rows):
    ...     return -0.5 * (u**2).sum(axis=1), -u
    >>> rng = np.random.default_rng(0)
    >>> u = rng.normal(size=(1000, 2))
    >>> for _ in range(20):
    ...     place = Place(u, *gradient(u, None))
    ...     moved = transition(gradient, place, np.full(1000, 0.5), Scale(np.ones(2)), rng)
    ...     u = moved.place.u
    >>> u.var(axis=0).round(1)
    array([1., 1.])
    """
    grown = _Forest(gradient, place, step, scale, rng)
    for depth in range(max_depth):
        if not grown.double(depth):
            break
    return grown.found()


def leapfrog(
    gradient: Gradient,
    u: np.ndarray,
    momenta: np.ndarray,
    slope: np.ndarray,
    half: np.ndarray,
    scale: Scale,
    rows: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A step of the leapfrog integrator: numbers, momenta, whitened gradient; log density and gradient.

    Parameters
    ----------
    slope : ndarray
        The whitened gradient at ``u``.
    half : ndarray, shape (rows, 1)
        Half of the step, with its sign.
    """
    momenta = momenta + half * slope
    u = u + scale.pushed(2.0 * half * momenta)
    log, plain = gradient(u, rows)
    slope = scale.pulled(plain)
    return u, momenta + half * slope, slope, log, plain


def energy_of(momenta: np.ndarray, log: np.ndarray) -> np.ndarray:
    """The Hamiltonian; infinite where it is no number."""
    found = 0.5 * np.vecdot(momenta, momenta) - log
    return np.where(np.isnan(found), np.inf, found)


# ---- private ------------------------------------------------------------------------------------


#: whitened momenta of the first leaf of a tree and of its last, and the sum of all, each ``(rows, size)``
Tree = tuple[np.ndarray, np.ndarray, np.ndarray]


def turning_back(first: Tree, second: Tree) -> np.ndarray:
    """Whether two neighbouring trees make one that turns, or turn across where they meet, shape (rows,).

    Leaves stand in the order of growth.
    """
    whole = first[2] + second[2]
    into, out_of = first[2] + second[0], second[2] + first[1]
    least = np.minimum(np.vecdot(first[0], whole), np.vecdot(second[1], whole))
    least = np.minimum(least, np.vecdot(first[0], into))
    least = np.minimum(least, np.vecdot(second[0], into))
    least = np.minimum(least, np.vecdot(first[1], out_of))
    least = np.minimum(least, np.vecdot(second[1], out_of))
    return ~(least > 0)


class _Forest:
    """The trees of all chains; ``going`` has what is known of those that go on, chains first.

    Of each tree: both ``ends`` (numbers, momenta and whitened gradients), the sum of its momenta and the
    logarithm of its weight.
    """

    def __init__(
        self,
        gradient: Gradient,
        place: Place,
        step: np.ndarray,
        scale: Scale,
        rng: np.random.Generator,
    ) -> None:
        chains = len(place.u)
        self.gradient, self.scale, self.rng = gradient, scale, rng
        self.u, self.log, self.slope = (part.copy() for part in place)
        self.acceptance, self.leaves = np.zeros(chains), np.zeros(chains)
        self.depth = np.zeros(chains, dtype=int)
        self.divergent = np.zeros(chains, dtype=bool)
        self.calls = 0
        momenta = rng.standard_normal(place.u.shape)
        self.energy = energy_of(momenta, place.log)
        ends = np.stack([place.u, momenta, scale.pulled(place.slope)], axis=1)
        self.going: dict[str, np.ndarray] = {
            "rows": np.arange(chains),
            "ends": np.stack([ends, ends], axis=1),
            "sum": momenta,
            "weight": np.zeros(chains),
            "step": step,
            "energy": self.energy,
        }

    def found(self) -> Transition:
        place = Place(self.u, self.log, self.slope)
        acceptance = self.acceptance / np.maximum(self.leaves, 1.0)
        points = int(self.leaves.sum())
        return Transition(
            place, acceptance, self.divergent, self.depth, self.energy, self.calls, points
        )

    def double(self, depth: int) -> bool:
        """Double all trees, each forwards or backwards in time; whether any goes on."""
        going = self.going
        ends, count = going["ends"], len(going["rows"])
        side = (self.rng.random(count) < 0.5).astype(int)
        at = np.arange(count)
        grown = ends[at, side]
        going |= {"side": side, "outer": ends[at, 1 - side, 1], "inner": grown[:, 1]}
        going |= {"end": grown[:, 0], "momenta": grown[:, 1], "pull": grown[:, 2]}
        tree = self._subtree(depth)
        if tree is None:
            return False
        going = self.going
        rows = going["rows"]
        self.depth[rows] += 1
        taken = -self.rng.standard_exponential(len(rows)) < going["new"] - going["weight"]
        at = rows[taken]
        self.u[at], self.log[at] = going["u"][taken], going["log"][taken]
        self.slope[at] = going["slope"][taken]
        turned = turning_back((going["outer"], going["inner"], going["sum"]), tree)
        if turned.all():
            return False
        going["weight"] = np.logaddexp(going["weight"], going["new"])
        going["sum"] = going["sum"] + tree[2]
        at = np.arange(len(rows))
        for k, name in enumerate(("end", "momenta", "pull")):
            going["ends"][at, going["side"], k] = going[name]
        self._keep(~turned)
        return True

    # ---- private -------------------------------------------------------------------------------

    def _subtree(self, depth: int) -> Tree | None:
        """A new balanced subtree from the ends of trees on; chains in which it turns or diverges end.

        What grows leaves the arrays with the chains that end. None where all have.
        """
        going = self.going
        count = len(going["rows"])
        going["half"] = 0.5 * ((2 * going["side"] - 1) * going["step"])[:, None]
        going["chances"] = -self.rng.standard_exponential((count, 1 << depth))
        pending: list[Tree] = []
        for leaf in range(1 << depth):
            bad = self._leaf(leaf)
            momenta = self.going["momenta"]
            tree, carry = (momenta, momenta, momenta), leaf
            while carry & 1:
                before = pending.pop()
                bad |= turning_back(before, tree)
                tree = before[0], tree[1], before[2] + tree[2]
                carry >>= 1
            pending.append(tree)
            if bad.any():
                if bad.all():
                    return None
                pending = [(a[~bad], b[~bad], c[~bad]) for a, b, c in pending]
                self._keep(~bad)
        return pending[0]

    def _leaf(self, leaf: int) -> np.ndarray:
        """One more leaf of every subtree; which of them diverge."""
        going = self.going
        rows = going["rows"]
        u, momenta, pull, log, slope = leapfrog(
            self.gradient, going["end"], going["momenta"], going["pull"], going["half"], self.scale, rows
        )  # fmt: skip
        self.calls += 1
        going["end"], going["momenta"], going["pull"] = u, momenta, pull
        weight = going["energy"] - energy_of(momenta, log)
        self.acceptance[rows] += np.exp(np.minimum(weight, 0.0))
        self.leaves[rows] += 1
        bad = ~(weight >= -DIVERGENT)
        self.divergent[rows] |= bad
        if leaf == 0:
            going |= {"new": weight, "u": u, "log": log, "slope": slope}
            return bad
        going["new"] = np.logaddexp(going["new"], weight)
        taken = going["chances"][:, leaf] < weight - going["new"]
        if taken.any():
            going["log"] = np.where(taken, log, going["log"])
            going["u"] = np.where(taken[:, None], u, going["u"])
            going["slope"] = np.where(taken[:, None], slope, going["slope"])
        return bad

    def _keep(self, mask: np.ndarray) -> None:
        if not mask.all():
            self.going = {name: value[mask] for name, value in self.going.items()}
