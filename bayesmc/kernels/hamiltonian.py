"""Hamiltonian moves: continuous nodes together, along trajectories that follow the gradient of their density.

What a transition is stands in ``no_u_turn``, what the warmup learns in ``hamiltonian_warmup``; here they
become a kernel of nodes, and what was seen of trajectories is counted.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from bayesmc.errors import DensityError, EngineWarning, TraceError, UnsupportedError
from bayesmc.kernels.base import Kernel, Memory, counted
from bayesmc.kernels.centring import Centring
from bayesmc.kernels.hamiltonian_warmup import (
    Bends,
    Metric,
    MetricLearning,
    StepSize,
    first_steps,
    fitting,
    windows,
)
from bayesmc.kernels.lost_chains import LostChains
from bayesmc.kernels.moving_density import MovingDensity
from bayesmc.kernels.no_u_turn import Gradient, Place, Scale, Transition, transition
from bayesmc.structure.centring import Effects
from bayesmc.structure.compiled_density import in_machine_code
from bayesmc.structure.free_density import UnconstrainedDensity
from bayesmc.structure.target import Values

#: gradients that a trajectory takes at least, on the whole
GRADIENTS = 8
#: doublings of a trajectory before a metric is learnt, at most: long ones tell no more
_EARLY = 5
#: gradients that pay for machine code of any density
_MANY = 10**9


class Density(Protocol):
    """A log density of some nodes on free numbers, with its gradient: ``structure.unconstrained``."""

    @property
    def names(self) -> tuple[str, ...]: ...
    @property
    def size(self) -> int: ...
    def with_gradient(
        self, u: np.ndarray, values: Values | None = None
    ) -> tuple[np.ndarray, np.ndarray]: ...
    def constrain(self, u: np.ndarray, values: Values | None = None) -> Values: ...
    def unconstrain(self, values: Values) -> np.ndarray: ...


class Hamiltonian(Kernel):
    """The No-U-Turn sampler on all continuous nodes of a density.

    Parameters
    ----------
    density : Density
    given : tuple of str
        Nodes that the density reads and others move, so that it differs from step to step.
    warmup : int or None
        Sweeps of the warmup, where they are known.
    target_accept : float
        Mean acceptance that the step's length is learnt for.
    max_depth : int
        Doublings of a trajectory, at most.
    metric : "auto", "diagonal" or "dense"
    reparametrize : bool
        Whether effects are moved apart from their scale as far as suits them (``kernels.centring``).
    match : str
        Why these nodes move so, for the table of kernels.
    threads : int
        Threads that share the chains where trajectories are machine code; the result is the same.
    compiled : bool, optional
        Whether trajectories are machine code; by default where a run is long enough to pay for it.
    debug : bool
        Compare machine code with NumPy at every step.

    Notes
    -----
    The free numbers of the last draw are kept beside the values that they stand for, so that nothing is
    lost to rounding near a bound; other values than those that it returned are read anew. The density and
    its gradient are kept, too, where nobody else moves what they depend on.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.kernels.hamiltonian import Hamiltonian
    >>> class Normal:
    ...     names, size = ("x",), 1
    ...     def with_gradient(self, u, values=None):
    ...         return -0.5 * (u[:, 0] - 3.0) ** 2, 3.0 - u
    ...     def constrain(self, u, values=None):
    ...         return {"x": u[:, 0]}
    ...     def unconstrain(self, values):
    ...         return values["x"][:, None]
    >>> kernel, rng = Hamiltonian(Normal(), warmup=100), np.random.default_rng(0)
    >>> values = {"x": np.zeros(500)}
    >>> memory = kernel.start(values, 500)
    >>> for _ in range(100):
    ...     values, memory = kernel.step(values, memory, rng, warmup=True)
    >>> memory = kernel.end_warmup(memory)
    >>> values, memory = kernel.step(values, memory, rng, warmup=False)
    >>> float(values["x"].mean().round(1)), bool(kernel.acceptance(memory).mean() > 0.7)
    (3.0, True)
    """

    label = "Hamiltonian"
    evaluations = 3.0 * GRADIENTS  # a gradient takes about three
    band = None

    def __init__(
        self,
        density: Density,
        given: tuple[str, ...] = (),
        *,
        warmup: int | None = None,
        target_accept: float = 0.8,
        max_depth: int = 10,
        metric: Metric = "auto",
        reparametrize: bool = True,
        match: str = "",
        threads: int = 1,
        compiled: bool | None = None,
        debug: bool = False,
    ) -> None:
        self.names = density.names
        self.given = given
        self.max_depth = max_depth
        self.match = match
        self.threads, self.compiled, self.debug = threads, compiled, debug
        self.step_size = StepSize(target_accept)
        #: a warmup whose length is said learns for the acceptance that is said
        self.bends = Bends() if warmup is None else None
        self.metric = MetricLearning(fitting(metric, density.size))
        #: what moves otherwise, too, is another density in each chain: none compares with the others
        self.lost = LostChains(0) if given else LostChains()
        self.centring = Centring()
        self._effects: Effects | None = None
        if reparametrize and isinstance(density, UnconstrainedDensity):
            self._effects = Effects(density)
        self._moving = MovingDensity(density, threads, debug)
        self.ends, self.beginning = windows(warmup)

    @property
    def density(self) -> Density:
        """The one that is followed: effects may be moved apart from their scale."""
        return self._moving.density

    def expect(self, steps: int, chains: int) -> None:
        """Gradients are machine code where so many steps pay for it."""
        self._moving.expect(self._calls(steps), chains)

    def told(self, steps: int, chains: int) -> str:
        if not isinstance(self.density, UnconstrainedDensity):
            return ""
        return in_machine_code(self.density, self._calls(steps), chains).told

    def start(self, values: Values, chains: int) -> Memory:
        self._moving.centre(np.ones(self.density.size))
        u = self.density.unconstrain(values)
        log, slope = self._gradient(values)(u, np.arange(chains))
        if not (log > -np.inf).all():
            raise DensityError(
                f"nodes {', '.join(map(repr, self.names[:6]))}: the density is zero where chains start"
            )
        nobody = np.zeros(chains, dtype=bool)
        return {
            "place": {"u": u, "log": log, "slope": slope},
            "values": {n: values[n] for n in self.density.names},
            "metric": self.metric.start(slope),
            "lost": self.lost.start(*u.shape),
            "shares": self._moving.shares,
            "effects": self._new_effects(),
            "step": self.step_size.start(np.zeros(chains)),
            "machine": self._moving.compiled is not None,
            "sweep": 0,
            "windows": 0,
            "bends": np.zeros(2),
            "raised": 0,
            "work": np.zeros(2),
            "accepted": np.zeros(chains),
            "moves": 0,
            "divergent": nobody,
            "divergences": np.zeros(chains, dtype=int),
            "saturated": np.zeros(chains, dtype=int),
            "energy": {"last": np.zeros(chains), "steps": np.zeros(chains), "mean": np.zeros(chains),
                       "square": np.zeros(chains)},
        }  # fmt: skip

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        self._moving.centre(memory["shares"])
        gradient = self._gradient(values)
        place = self._place(values, memory, gradient)
        if warmup and memory["sweep"] == 0:
            memory = self._first_steps(gradient, place, memory, rng, pooled=False)
        scale = Scale(memory["metric"]["root"])
        length = np.exp(memory["step"]["log"])
        early = warmup and memory["windows"] < min(self.beginning + 1, len(self.ends))
        depth = min(self.max_depth, _EARLY) if early else self.max_depth
        memory = {**memory}
        found = self._moved(gradient, place, length, scale, rng, depth, values, memory)
        place = found.place
        new = self.density.constrain(place.u, values)
        kept = {**memory, "place": place._asdict(), "values": new, "divergent": found.divergent}
        kept["work"] = memory["work"] + np.array([found.calls, found.points])
        if warmup:
            kept = self._learnt(values, place, kept, found.acceptance, rng)
            return kept["values"], kept
        kept["divergences"] = kept["divergences"] + found.divergent
        kept["saturated"] = kept["saturated"] + (found.depth == self.max_depth)
        kept["energy"] = _with_energy(kept["energy"], found.energy, kept["moves"])
        return new, counted(kept, found.acceptance)

    def end_warmup(self, memory: Memory) -> Memory:
        return {**memory, "step": self.step_size.frozen(memory["step"])}

    def unsettled(self, memory: Memory) -> bool:
        """Whether a warmup should not end yet: steps were found too long when its last window ended."""
        return bool(memory["raised"] and memory["raised"] == memory["windows"])

    def apart(self, memory: Mapping[str, Any]) -> frozenset[str]:
        """Effects that are moved apart from their scale."""
        places = {} if self._effects is None else self._effects.places
        return frozenset(n for n, at in places.items() if (memory["shares"][at] < 1.0).any())

    def energy_ratio(self, memory: Memory) -> np.ndarray:
        """E-BFMI of every chain: mean square step of the energy over its variance.

        Far below 1, fresh momenta are too weak to take a chain through all the energies there are.

        References
        ----------
        Betancourt (2016), Diagnosing suboptimal cotangent disintegrations in Hamiltonian Monte Carlo.
        """
        energy = memory["energy"]
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(energy["steps"] / energy["square"])

    # ---- private -------------------------------------------------------------------------------

    def _calls(self, steps: int) -> int:
        """Gradients that a run asks for at least; where it is said, as many as pay for it, or none."""
        if self.compiled is None:
            return GRADIENTS * steps
        return _MANY if self.compiled else 0

    def _gradient(self, values: Values) -> Gradient:
        def gradient(u: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return self.density.with_gradient(u, {n: values[n][rows] for n in self.given} or None)

        return gradient

    def _moved(
        self,
        gradient: Gradient,
        place: Place,
        step: np.ndarray,
        scale: Scale,
        rng: np.random.Generator,
        depth: int,
        values: Values,
        memory: Memory,
    ) -> Transition:
        """A transition in machine code where there is some, and it grows the trees that NumPy grows.

        Which of both a run began with, and has come to, is part of its memory: so a resumed run draws the
        same numbers.
        """
        if self._moving.compiled is not None and memory["machine"]:
            try:
                return self._moving.compiled(gradient, place, step, scale, rng, depth, values)
            except TraceError as error:
                if self.debug:
                    raise
                memory["machine"] = False
                names = ", ".join(map(repr, self.names[:6]))
                text = f"nodes {names}: trajectories go on in NumPy, more slowly: {error}"
                warnings.warn(text, EngineWarning, stacklevel=2)
        return transition(gradient, place, step, scale, rng, depth)

    def _place(self, values: Values, memory: Memory, gradient: Gradient) -> Place:
        """Where the chains are: as the last step left them, or as somebody else has."""
        known, last = memory["place"], memory["values"]
        same = all(
            values[n] is last[n] or np.array_equal(values[n], last[n]) for n in self.density.names
        )
        if same and not self.given:
            return Place(**known)
        u = known["u"] if same else self.density.unconstrain(values)
        return Place(u, *gradient(u, np.arange(len(u))))

    def _first_steps(
        self,
        gradient: Gradient,
        place: Place,
        memory: Memory,
        rng: np.random.Generator,
        pooled: bool,
    ) -> Memory:
        """The memory with dual averaging begun anew."""
        scale = Scale(memory["metric"]["root"])
        step, target = memory["step"], memory["step"]["target"]
        log = step["log"]
        if pooled:
            log = np.full_like(log, log.mean())
        log = first_steps(gradient, place, log, scale, rng, target, pooled)
        return {**memory, "step": self.step_size.start(log, target)}

    def _learnt(
        self,
        values: Values,
        place: Place,
        memory: Memory,
        acceptance: np.ndarray,
        rng: np.random.Generator,
    ) -> Memory:
        """The memory after a sweep of the warmup: the step always, the metric within windows.

        Chains that are lost at the end of a window have other values then.
        """
        sweep, pooled = memory["sweep"] + 1, self._is_pooled(memory)
        memory = {**memory, "sweep": sweep}
        memory["step"] = self.step_size.learnt(memory["step"], acceptance, pooled)
        if memory["windows"] == len(self.ends):
            return memory
        memory["metric"] = self.metric.learnt(memory["metric"], place.u, place.slope)
        if pooled:
            memory = self._bent(memory)
            memory["lost"] = self.lost.seen(memory["lost"], place.u, place.log)
            if self._effects is not None and self._effects.at.size:
                told = self._effects.told({**values, **memory["values"]})
                memory["effects"] = self.centring.seen(memory["effects"], *told)
        if sweep < self.ends[memory["windows"]]:
            return memory
        memory["windows"] += 1
        lost = self.lost.found(memory["lost"])
        memory["lost"] = self.lost.start(*place.u.shape)
        if lost.any():
            place, memory = self._found_again(place, memory, lost, rng)
        else:
            memory["metric"] = self.metric.renewed(memory["metric"])
            place, memory = self._recentred(values, place, memory)
        memory["effects"] = self._new_effects()
        gradient = self._gradient(values)
        return self._first_steps(gradient, place, memory, rng, self._is_pooled(memory))

    def _recentred(self, values: Values, place: Place, memory: Memory) -> tuple[Place, Memory]:
        """Effects as far apart from their scale as suits them, if a window is left to learn from."""
        if self._effects is None or memory["windows"] == len(self.ends):
            return place, memory
        at, shares = self._effects.at, memory["shares"].copy()
        shares[at] = self.centring.found(memory["effects"], shares[at])
        if (shares == memory["shares"]).all():
            return place, memory
        try:
            self._moving.centre(shares)
        except UnsupportedError:
            self._moving.centre(memory["shares"])
            return place, memory
        u = self.density.unconstrain({**values, **memory["values"]})
        moved = Place(u, *self._gradient(values)(u, np.arange(len(u))))
        if not all(np.isfinite(part).all() for part in moved):
            self._moving.centre(memory["shares"])
            return place, memory
        step = {**memory["step"], "target": self.step_size.target}
        metric = self.metric.start(moved.slope)
        changed = {"place": moved._asdict(), "metric": metric, "shares": shares, "step": step}
        return moved, {**memory, **changed, "raised": memory["windows"]}

    def _new_effects(self) -> dict[str, Any]:
        return self.centring.start(0 if self._effects is None else self._effects.at.size)

    def _found_again(
        self, place: Place, memory: Memory, lost: np.ndarray, rng: np.random.Generator
    ) -> tuple[Place, Memory]:
        """Lost chains go on among the others, and the window that they have part in tells nothing."""
        rows = self.lost.moved(lost, rng)
        place = Place(*(a[rows] for a in place))
        values = {n: memory["values"][n][rows] for n in self.density.names}
        metric = self.metric.emptied(memory["metric"])
        moved = {"place": place._asdict(), "values": values, "metric": metric}
        return place, {**memory, **moved, "raised": memory["windows"]}

    def _is_pooled(self, memory: Memory) -> bool:
        """Whether all chains take the same step: after the beginning, which a short warmup is all of."""
        return 0 < self.beginning <= memory["windows"]

    def _bent(self, memory: Memory) -> Memory:
        """The memory with divergences of this window counted, and at its end a target nearer to 1, once."""
        step, said = memory["step"], self.step_size.target
        if self.bends is None or step["target"] != said:
            return memory
        sweep, (begun, end) = memory["sweep"], self.ends[memory["windows"] - 1 :][:2]
        found = self.bends.seen(memory["bends"], memory["divergent"], sweep, begun, end)
        if sweep < end:
            return {**memory, "bends": found}
        target = self.bends.target(found, said)
        raised = memory["windows"] + 1 if target != said else 0
        step = {**step, "target": target}
        return {**memory, "bends": self.bends.start(), "step": step, "raised": raised}


# ---- private ------------------------------------------------------------------------------------


def _with_energy(known: dict[str, np.ndarray], energy: np.ndarray, before: int) -> dict[str, Any]:
    """Running sums of the energy: of its squared steps, and of its squares about the mean (Welford)."""
    count = before + 1
    away = energy - known["mean"]
    mean = known["mean"] + away / count
    step = np.square(energy - known["last"]) if before else np.zeros_like(energy)
    return {
        "last": energy,
        "steps": known["steps"] + step,
        "mean": mean,
        "square": known["square"] + away * (energy - mean),
    }
