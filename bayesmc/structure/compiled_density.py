"""A log density of free numbers as machine code: held against NumPy before its first use."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.errors import TraceError
from bayesmc.expression import Program
from bayesmc.lowering import (
    Compiled,
    Kernel,
    Trajectories,
    held_against_numpy,
    is_available,
    is_worth_it,
)
from bayesmc.passes.arrays import for_arrays
from bayesmc.passes.guarded import guarded
from bayesmc.passes.rounding import disturbed
from bayesmc.structure.free_density import FREE, UnconstrainedDensity

#: how far the free numbers of the points where it is compared are from zero
_SPREADS = np.array([0.0, 0.1, 0.3, 0.6, 1.0, 1.0, 2.0, 3.0])


def in_machine_code(
    density: UnconstrainedDensity, calls: int, chains: int = 1, debug: bool = False
) -> CompiledDensity:
    """The same log density, whose gradient is machine code where that saves time.

    Nothing is compiled before the gradient is first asked for, nor where there is no compiler, something has
    no machine code, or so many calls take less than a tenth of a second in NumPy.

    Parameters
    ----------
    density : UnconstrainedDensity
    calls, chains : int
        How many gradients will be asked for at least, and of how many points each.
    debug : bool
        Compare with NumPy at every call.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.compiled_density import in_machine_code
    >>> from bayesmc.structure.target import target_of
    >>> from bayesmc.structure.unconstrained import unconstrained_density
    >>> net = bmc.BayesNet(plates={"point": 3})
    >>> net.add("rate", bmc.Exponential(1.0))
    >>> net.add("y", lambda rate: bmc.Poisson(rate), plates="point")
    >>> density = unconstrained_density(target_of(pose(net, {"y": [1, 2, 3]})))
    >>> fast = in_machine_code(density, calls=10)
    >>> fast.code, fast.with_gradient(np.array([0.0]))[1]
    ('NumPy: 10 gradients take no time', array([3.]))
    """
    known = {f.name: getattr(density, f.name) for f in fields(UnconstrainedDensity)}
    return CompiledDensity(**known, calls=calls, chains=chains, debug=debug)


@dataclass(frozen=True, eq=False)
class CompiledDensity(UnconstrainedDensity):
    """A log density whose gradient may be machine code.

    Attributes
    ----------
    calls, chains : int
    debug : bool
    """

    calls: int = 0
    chains: int = 1
    debug: bool = False

    @property
    def code(self) -> str:
        """What computes the gradient, and why nothing faster does."""
        return self._made[1]

    @property
    def told(self) -> str:
        """What will compute the gradient, where there is something to say; nothing is compiled to know."""
        roots = guarded([self.root, self.slopes])
        if not is_available() or not is_worth_it(roots, self.calls, self.chains):
            return ""
        try:
            Kernel(roots, frozenset(self.root.leaves | self.slopes.leaves))
        except TraceError as error:
            return f"gradients in NumPy: {error}"
        return "trajectories in machine code"

    def bound(self, values: Mapping[str, np.ndarray] | None = None) -> Any:
        """The log density and its gradient as a function in C (``lowering.compiled.Bound``).

        ``int32_t f(int64_t points, const double *u, double *value, double *gradient, void **arguments)``.

        Parameters
        ----------
        values : mapping, optional
            Stored values of hidden nodes that do not move.

        Raises
        ------
        TraceError
            It is not machine code.
        """
        run = self._made[0]
        if not isinstance(run, Compiled):
            raise TraceError(f"the log density has no address: {self.code}")
        given = self._given(np.zeros(self.size), values)
        return run.bound({n: v for n, v in given.items() if n != FREE})

    @cached_property
    def trajectories(self) -> Trajectories | None:
        """What runs along it in machine code; None where its gradient is none."""
        run = self._made[0]
        run = getattr(run, "run", run)  # of one that is compared
        if not isinstance(run, Compiled):
            return None
        try:
            return Trajectories(run, FREE)
        except TraceError:
            return None

    def __getstate__(self) -> dict[str, Any]:
        """Machine code stays where it was made."""
        made = ("_made", "_both", "trajectories")
        return {k: v for k, v in self.__dict__.items() if k not in made}

    # ---- private -------------------------------------------------------------------------------

    @cached_property
    def _both(self) -> Any:
        return self._made[0]

    @cached_property
    def _made(self) -> tuple[Any, str]:
        roots = guarded([self.root, self.slopes])
        if not is_worth_it(roots, self.calls, self.chains):
            return Program(for_arrays(roots)), f"NumPy: {self.calls} gradients take no time"
        try:
            near = disturbed(roots)
            return held_against_numpy(roots, self._points(), self.debug, near), "machine code"
        except TraceError as error:
            return Program(for_arrays(roots)), f"NumPy: {error}"

    def _points(self) -> Iterator[dict[str, np.ndarray]]:
        """Values of all leaves, in a batch and alone."""
        rng, states = np.random.default_rng(self.size), self.target.states
        values = {FREE: rng.normal(size=(_SPREADS.size, self.size)) * _SPREADS[:, None]}
        for name in self.others:
            if states is None:
                raise TraceError(f"no reachable value of node {name!r} is known to try it on")
            rows = np.arange(_SPREADS.size) % len(states[name])
            values[name] = np.asarray(states[name])[rows]
        yield values
        yield {name: value[3] for name, value in values.items()}
