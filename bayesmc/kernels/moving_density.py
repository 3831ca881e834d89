"""The density that trajectories follow: with effects centred by any shares, in machine code where it pays."""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.kernels.compiled_transition import CompiledTransition
from bayesmc.structure.compiled_density import in_machine_code
from bayesmc.structure.free_density import UnconstrainedDensity
from bayesmc.structure.unconstrained import unconstrained_density

#: densities that are kept for chains with other shares
_KEPT = 8


class MovingDensity:
    """A density as it was declared, and as it is followed.

    Parameters
    ----------
    declared : Density
        One that is no `UnconstrainedDensity` stays as it is.
    threads : int
    debug : bool

    Attributes
    ----------
    density : Density
        The one that is followed.
    compiled : CompiledTransition or None
    shares : ndarray, shape (size,)
        How far its effects are centred, 1 as declared (``structure.centring``).

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.kernels.moving_density import MovingDensity
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.target import target_of
    >>> from bayesmc.structure.unconstrained import unconstrained_density
    >>> net = bmc.BayesNet(plates={"group": 2})
    >>> net.add("sd", bmc.LogNormal(0.0, 1.0))
    >>> net.add("effect", lambda sd: bmc.Normal(0.0, sd), plates="group")
    >>> net.add("y", lambda effect: bmc.Laplace(effect, 1.0), plates="group")
    >>> moving = MovingDensity(unconstrained_density(target_of(pose(net, {"y": [1.0, 2.0]}))))
    >>> moving.centre(np.array([1.0, 0.0, 0.0]))
    >>> moving.density.constrain(np.array([np.log(3.0), 1.0, -1.0]))["effect"]
    array([ 3., -3.])
    """

    def __init__(self, declared: Any, threads: int = 1, debug: bool = False) -> None:
        self.declared, self.density = declared, declared
        self.threads, self.debug = threads, debug
        self.compiled: CompiledTransition | None = None
        self.shares = np.ones(declared.size)
        self._calls: int | None = None  # before it is said, nothing is compiled
        self._chains = 1
        self._kept: dict[bytes, tuple[Any, CompiledTransition | None]] = {}

    def expect(self, calls: int, chains: int) -> None:
        """Gradients are machine code where so many calls pay for it."""
        self._calls, self._chains = calls, chains
        self._kept.clear()
        self._follow(self.density)

    def centre(self, shares: np.ndarray) -> None:
        """Follow the density with these shares.

        Raises
        ------
        UnsupportedError
            It cannot be followed so, and the one before is.
        """
        if np.array_equal(shares, self.shares):
            return
        before, known = (self.density, self.compiled), self._kept.get(shares.tobytes())
        if known is not None:  # groups of chains take turns, each with its own
            self.density, self.compiled = known
        elif isinstance(self.declared, UnconstrainedDensity) and (shares != 1.0).any():
            names, summed = self.declared.names, self.declared.summed
            self._follow(unconstrained_density(self.declared.target, names, summed, shares))
        else:
            self._follow(self.declared)
        self._kept[self.shares.tobytes()] = before
        self.shares = shares
        if len(self._kept) > _KEPT:
            self._kept.pop(next(iter(self._kept)))

    # ---- private -------------------------------------------------------------------------------

    def _follow(self, density: Any) -> None:
        self.density, self.compiled = density, None
        if isinstance(density, UnconstrainedDensity) and self._calls is not None:
            made = in_machine_code(density, self._calls, self._chains, self.debug)
            self.density = made
            if made.trajectories is not None:
                self.compiled = CompiledTransition(made.trajectories, made, self.threads)
