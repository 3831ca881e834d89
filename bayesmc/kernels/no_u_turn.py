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
from typing import Any, NamedTuple

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
    """

    place: Place
    acceptance: np.ndarray
    divergent: np.ndarray
    depth: np.ndarray
    energy: np.ndarray


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


class _Forest:
    """The trees of all chains; ``going`` has what is known of those that go on, chains first.

    Of each tree: ``ends`` (two ends; numbers, momenta and whitened gradients), the sum of its momenta and the
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
        self.energy, self.acceptance = np.empty(chains), np.zeros(chains)
        self.leaves, self.depth = np.zeros(chains), np.zeros(chains, dtype=int)
        self.divergent = np.zeros(chains, dtype=bool)
        momenta = rng.standard_normal(place.u.shape)
        self.energy = energy_of(momenta, place.log)
        end = np.stack([place.u, momenta, scale.pulled(place.slope)], axis=1)
        self.going: dict[str, np.ndarray] = {
            "rows": np.arange(chains),
            "ends": np.stack([end, end], axis=1),
            "sum": momenta,
            "weight": np.zeros(chains),
            "step": step,
            "energy": self.energy,
        }

    def found(self) -> Transition:
        place = Place(self.u, self.log, self.slope)
        acceptance = self.acceptance / np.maximum(self.leaves, 1.0)
        return Transition(place, acceptance, self.divergent, self.depth, self.energy)

    def double(self, depth: int) -> bool:
        """Double all trees, each forwards or backwards in time; whether any goes on."""
        going = self.going
        count = len(going["rows"])
        side = (self.rng.random(count) < 0.5).astype(int)
        going["side"] = side
        end = going["ends"][np.arange(count), side]
        going["outer"] = going["ends"][np.arange(count), 1 - side, 1]
        going["inner"] = end[:, 1]
        new = self._subtree(end, depth)
        if new is None:
            return False
        going = self.going
        rows = going["rows"]
        self.depth[rows] += 1
        taken = -self.rng.standard_exponential(len(rows)) < new["weight"] - going["weight"]
        at = rows[taken]
        self.u[at], self.log[at] = new["u"][taken], new["log"][taken]
        self.slope[at] = new["slope"][taken]
        going["weight"] = np.logaddexp(going["weight"], new["weight"])
        old = np.stack([going["outer"], going["inner"], going["sum"]], axis=1)
        turned = turning_back(old, new["tree"])
        going["sum"] = going["sum"] + new["tree"][:, 2]
        going["ends"][np.arange(len(rows)), going["side"]] = new["end"]
        self._keep(~turned)
        return bool(len(self.going["rows"]))

    # ---- private -------------------------------------------------------------------------------

    def _subtree(self, end: np.ndarray, depth: int) -> dict[str, Any] | None:
        """A new balanced subtree from the ends of trees on; chains in which it turns or diverges end.

        Returns its ``tree`` (momenta of its first and last leaf, and their sum), its new ``end``, its
        ``weight``, and the leaf that was drawn: ``u``, ``log``, ``slope``. None where all chains have ended.
        """
        going = self.going
        # what grows leaves the arrays with the chains that end
        going["end"] = end
        going["half"] = 0.5 * ((2 * going["side"] - 1) * going["step"])[:, None]
        chances = -self.rng.standard_exponential((len(end), 1 << depth))
        going["chances"] = chances
        going["new"] = np.full(len(end), -np.inf)
        pending: list[np.ndarray] = []
        for leaf in range(1 << depth):
            tree, bad = self._leaf(leaf)
            carry = leaf
            while carry & 1:
                before = pending.pop()
                bad |= turning_back(before, tree)
                tree = np.stack([before[:, 0], tree[:, 1], before[:, 2] + tree[:, 2]], axis=1)
                carry >>= 1
            pending.append(tree)
            if bad.any():
                pending = [tree[~bad] for tree in pending]
                self._keep(~bad)
                if not len(self.going["rows"]):
                    return None
        going = self.going
        drawn = {name: going[name] for name in ("u", "log", "slope", "end")}
        return {**drawn, "weight": going["new"], "tree": pending[0]}

    def _leaf(self, leaf: int) -> tuple[np.ndarray, np.ndarray]:
        """One more leaf of every subtree: as a tree, and which diverge."""
        going = self.going
        rows, end = going["rows"], going["end"]
        u, momenta, slope, log, plain = leapfrog(
            self.gradient, end[:, 0], end[:, 1], end[:, 2], going["half"], self.scale, rows
        )
        error = energy_of(momenta, log) - going["energy"]
        weight = -error
        self.acceptance[rows] += np.exp(np.minimum(weight, 0.0))
        self.leaves[rows] += 1
        bad = ~(error <= DIVERGENT)
        self.divergent[rows[bad]] = True
        going["end"] = np.stack([u, momenta, slope], axis=1)
        if leaf == 0:
            going["new"], going["u"], going["log"], going["slope"] = weight, u, log, plain
        else:
            going["new"] = np.logaddexp(going["new"], weight)
            taken = going["chances"][:, leaf] < weight - going["new"]
            for name, value in (("u", u), ("slope", plain)):
                going[name] = np.where(taken[:, None], value, going[name])
            going["log"] = np.where(taken, log, going["log"])
        return np.stack([momenta, momenta, momenta], axis=1), bad

    def _keep(self, mask: np.ndarray) -> None:
        if not mask.all():
            self.going = {name: value[mask] for name, value in self.going.items()}


def turning_back(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Whether two neighbouring trees make one that turns, or turn across where they meet.

    Parameters
    ----------
    first, second : ndarray, shape (rows, 3, size)
        Whitened momenta of the first leaf and of the last, and the sum of all, in the order of growth.

    Returns
    -------
    ndarray of bool, shape (rows,)
    """
    whole = first[:, 2] + second[:, 2]
    into, out_of = first[:, 2] + second[:, 0], second[:, 2] + first[:, 1]
    dots = (
        np.vecdot(first[:, 0], whole),
        np.vecdot(second[:, 1], whole),
        np.vecdot(first[:, 0], into),
        np.vecdot(second[:, 0], into),
        np.vecdot(first[:, 1], out_of),
        np.vecdot(second[:, 1], out_of),
    )
    return ~(np.minimum.reduce(dots) > 0)
