"""A scale moved together with what it scales, in proportion: hierarchies whose effects have no closed form.

Given many effects, their scale can hardly move, and given the scale neither can they: one at a time they
crawl, most of all in the neck of a funnel. Here both are multiplied by a number, drawn by a slice, so that
effects in units of their scale stay what they are. What is a scale, a variance or a precision is found by
trying.

References
----------
Liu and Sabatti (2000), Generalised Gibbs sampler and multigrid Monte Carlo, Biometrika 87, theorem 1; Yu and
Meng (2011), To center or not to center, J. Comp. Graph. Statist. 20 (interweaving).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BayesmcError, DensityError, TraceError
from bayesmc.expression import Program
from bayesmc.kernels.base import ANYHOW, How, Kernel, Memory
from bayesmc.kernels.compiled_slice import CompiledMoves, Streams, compare, why_not
from bayesmc.kernels.slice import BESIDE, EVALUATIONS, GROWTH, slice_move
from bayesmc.lowering import Turns, is_available, is_worth_it
from bayesmc.passes.arrays import for_arrays
from bayesmc.shapes import Shape
from bayesmc.structure.like_terms import TermSum
from bayesmc.structure.orbit import STEP, Orbit, centre_key
from bayesmc.structure.target import Target, Values

#: powers of a scale that a parameter may be: a scale, a variance, their inverses
_POWERS = (1, 2, -2, -1)
#: by how much it is tried, on a log scale, and how close an identity must hold
_TRIED, _CLOSE = 0.7, 1e-8


class Rescaled(Kernel):
    """Multiplies a scale's power and the deviations of what it scales (generalised Gibbs).

    Parameters
    ----------
    target : Target
    name : str
        The scale, or a power of it.
    below : sequence of str
        What it scales.
    power : int
    every : int
        Sweeps of which one moves.
    how : How
        Whether moves are machine code.
    debug : bool
        Compare every move in machine code with that in NumPy.
    """

    label = "rescaled"
    evaluations = EVALUATIONS

    def __init__(
        self,
        target: Target,
        name: str,
        below: Sequence[str],
        power: int,
        every: int = 1,
        how: How = ANYHOW,
        debug: bool = False,
    ) -> None:
        self.target, self.every, self.how, self.debug = target, every, how, debug
        self.name, self.below, self.power = name, tuple(below), power
        self.names = (name, *below)
        self.terms = TermSum(target, target.terms_of(self.names))
        self.path = target.below(self.names)
        self.numbers = sum(math.prod(target.model[n].value_shape) for n in below)
        support = target.model[name].support
        assert support is not None
        self.high = float(np.asarray(support.high))
        self._expects = False

    def words(self, name: str) -> tuple[str, str]:
        if name == self.name:
            return self.label, f"{', '.join(self.below)} in proportion"
        return self.label, f"in proportion to {self.name}"

    def expect(self, steps: int, chains: int) -> None:
        """Moves are machine code where so many steps pay for it."""
        self._expects = self._pays(steps, chains)

    def told(self, steps: int, chains: int) -> str:
        if not is_available() or not self._pays(steps, chains):
            return ""
        orbit = self._orbit
        why = orbit if isinstance(orbit, str) else why_not(orbit.root, STEP)
        return f"rescaled in NumPy: {why}" if why else "in machine code"

    def start(self, values: Values, chains: int) -> Memory:
        machine = self._expects and isinstance(self._code, CompiledMoves)
        return {"width": 1.0, "moved": 0.0, "count": 0, "sweep": 0, "machine": machine}

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        memory = {**memory, "sweep": memory["sweep"] + 1}
        if memory["sweep"] % self.every:
            return {n: values[n] for n in self.names}, memory
        if memory.get("machine"):
            t, centres, memory = self._by_machine(values, memory, rng)
        else:
            t, centres = self._by_numpy(values, memory, rng)
        if warmup:
            count = memory["count"] + 1
            rate = max(1.0 / count, 0.02)
            moved = (1 - rate) * memory["moved"] + rate * float(np.abs(t).mean())
            memory |= {"width": 3.0 * moved or 1.0, "moved": moved, "count": count}
        return self._scaled(values, centres, t), memory

    # ---- private -------------------------------------------------------------------------------

    def _by_numpy(
        self, values: Values, memory: Memory, rng: Any
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """How far the chains move, and where deviations are counted from."""
        centres, fixed = self._centres(values)

        def log_density(t: np.ndarray) -> np.ndarray:
            return self._log(values, centres, t, fixed)

        start = np.zeros(fixed.shape)
        try:
            t = slice_move(log_density, start, np.full(start.shape, memory["width"]), rng)
        except DensityError as error:
            raise self._of_nodes(error) from error
        return np.where(fixed, 0.0, t), centres

    def _by_machine(
        self, values: Values, memory: Memory, rng: np.random.Generator
    ) -> tuple[np.ndarray, dict[str, np.ndarray], Memory]:
        """The same in machine code, where it says what NumPy does."""
        chains = len(values[self.name])
        seeds = rng.integers(0, 1 << 64, (chains, 1, 4), np.uint64)
        code, orbit = self._code, self._orbit
        given = {} if isinstance(orbit, str) else self._given(orbit, values)
        if isinstance(code, str) or not given or code.differs:
            kept = isinstance(code, str) or not code.differs
            return *self._by_numpy(values, memory, Streams(seeds[:, 0])), {
                **memory,
                "machine": kept,
            }
        centres = {n: given[centre_key(n)] for n in self.below}

        def ask(chain: int, t: np.ndarray) -> np.ndarray:
            one, target = slice(chain, chain + 1), self.target
            nodes = ((n, v) for n, v in values.items() if n in target.model.nodes)
            state = {n: v if v is target.known.get(n) else v[one] for n, v in nodes}
            own = {n: c[one] for n, c in centres.items()}
            return self._log(state, own, t[None], np.zeros(1, bool))

        ends = np.full((chains, 1), np.inf)
        width = np.full((chains, 1), float(memory["width"]))
        try:
            t = code({**values, **given}, width, -ends, ends, seeds, ask)
        except DensityError as error:
            raise self._of_nodes(error) from error
        if not (self.debug or not code.is_checked):
            return t, centres, memory
        wanted, _ = self._by_numpy(values, memory, Streams(seeds[:, 0]))
        code.differs = compare(t, wanted, np.full((), memory["width"]))
        if code.differs and self.debug:
            raise self._of_nodes(DensityError(code.differs))
        code.is_checked = True
        return (wanted if code.differs else t), centres, {**memory, "machine": not code.differs}

    def _given(self, orbit: Orbit, values: Values) -> Values:
        """Values of the leaves that are no stored ones; none where a state has other data, or no centre."""
        if any(values[n] is not array for n, array in orbit.known):
            return {}
        start = np.zeros(len(values[self.name]))
        given: Values = {STEP: start}
        for name in self.below:
            key = centre_key(name)
            found = np.broadcast_to(self._centre_programs[key](values)[0], values[name].shape)
            if not np.isfinite(found).all():
                return {}
            given[key] = np.array(found, float)
        return given

    def _centres(self, values: Values) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Where deviations are counted from, and chains that stay.

        Heavy tails may have no mean: such chains are the same wherever the move would lead.
        """
        found = {n: centre_of(self.target, n, values) for n in self.below}
        fixed = ~self._all(np.isfinite, found, (len(values[self.name]),))
        return {n: np.where(np.isfinite(c), c, 0.0) for n, c in found.items()}, fixed

    def _of_nodes(self, error: DensityError) -> DensityError:
        """An error that names the nodes."""
        return DensityError(f"nodes {', '.join(map(repr, self.names))}: {error}")

    def _pays(self, steps: int, chains: int) -> bool:
        """Whether so many steps take longer in NumPy than compiling."""
        if self.how.compiled is not None:
            return self.how.compiled
        if isinstance(self._orbit, str):
            return False
        calls = int(self.evaluations * steps) // self.every
        return is_worth_it([self._orbit.root], calls, chains, BESIDE)

    @cached_property
    def _orbit(self) -> Orbit | str:
        """Its log density as an expression, or why there is none."""
        try:
            return Orbit(self.target, self.name, self.below, self.power, _CLOSE)
        except (BayesmcError, TraceError) as error:
            return str(error)

    @cached_property
    def _centre_programs(self) -> dict[str, Program]:
        assert isinstance(self._orbit, Orbit)
        return {key: Program(for_arrays([c])) for key, c in self._orbit.centres.items()}

    @cached_property
    def _code(self) -> CompiledMoves | str:
        """Its moves in machine code, or why there are none."""
        if isinstance(self._orbit, str):
            return self._orbit
        first = np.zeros(1, int)
        try:
            turns = Turns([first], [first], ["real"], [GROWTH])
            return CompiledMoves(self._orbit.root, STEP, turns, self.how.threads)
        except TraceError as error:
            return str(error)

    def _scaled(self, values: Values, centres: Mapping[str, np.ndarray], t: np.ndarray) -> Values:
        """The nodes' values, multiplied: shape ``(*t.shape, ...)``."""
        found = {self.name: values[self.name] * np.exp(self.power * t)}
        for name in self.below:
            now, centre = values[name], centres[name]
            factor = np.exp(t).reshape(t.shape + (1,) * (now.ndim - 1))
            found[name] = centre + (now - centre) * factor
        return found

    def _log(
        self, values: Values, centres: Mapping[str, np.ndarray], t: np.ndarray, fixed: np.ndarray
    ) -> np.ndarray:
        """Log density along the orbit, with the change of volume."""
        new = self._scaled(values, centres, t)
        inside = (new[self.name] > 0) & (new[self.name] < self.high)
        for name in self.below:
            flat = new[name].reshape(*t.shape, -1)
            inside = inside & np.isfinite(flat).all(axis=-1)
        if not inside.all():
            new = self._scaled(values, centres, np.where(inside, t, 0.0))
        state = {**values, **new}
        self.target.compute(state, self.path)
        inside = inside & (fixed | self._keeps_centres(state, centres, t.shape))
        log = self.terms.log_density(state) + (self.power + self.numbers) * t
        return np.where(inside, np.broadcast_to(log, t.shape), -np.inf)

    def _keeps_centres(
        self, state: Values, centres: Mapping[str, np.ndarray], lead: Shape
    ) -> np.ndarray:
        """Whether deviations are counted from where they were: else there is no way back."""
        same = {
            n: np.isclose(centre_of(self.target, n, state), c, rtol=_CLOSE, atol=0)
            for n, c in centres.items()
        }
        return self._all(lambda kept: kept, same, lead)

    def _all(
        self,
        test: Callable[[np.ndarray], np.ndarray],
        figures: Mapping[str, np.ndarray],
        lead: Shape,
    ) -> np.ndarray:
        """Whether a test holds of all figures of a chain."""
        found: np.ndarray = np.ones(lead, dtype=bool)
        for name in self.below:
            found = found & test(figures[name]).reshape(*lead, -1).all(axis=-1)
        return found


def centre_of(target: Target, name: str, values: Values) -> np.ndarray:
    """Where a node's deviations are counted from: the mean that its density has, shape of its values."""
    dist, _ = target.terms[name].distribution(values)
    return np.broadcast_to(np.asarray(dist.mean, dtype=float), values[name].shape)


def rescaled_kernels(
    target: Target,
    slow: Collection[str],
    every: int = 1,
    how: How = ANYHOW,
    debug: bool = False,
) -> list[Kernel]:
    """The kernels for all scales of nodes that have no closed form.

    Parameters
    ----------
    target : Target
    slow : collection of str
        Nodes that are moved number by number.
    every : int
        Sweeps of which one moves them.
    how : How
        Whether moves are machine code.
    debug : bool
        Compare every move in machine code with that in NumPy.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.kernels.rescaled import rescaled_kernels
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet(plates={"i": 3})
    >>> net.add("tau", bmc.Gamma(1.0, 1.0))
    >>> net.add("b", lambda tau: bmc.Normal(0.0, tau**-0.5), plates="i")
    >>> net.add("y", lambda b: bmc.Poisson(np.exp(b)), plates="i")
    >>> target = target_of(pose(net, {"y": [1, 2, 0]}))
    >>> [(k.names, k.power) for k in rescaled_kernels(target, ("b",))]
    [(('tau', 'b'), -2)]
    """
    states = target.states
    if states is None:
        return []
    above: dict[tuple[str, int], list[str]] = {}
    terms = [target.terms[n] for n in slow if n in target.terms]
    # in a random walk, to scale one step would move where the next one begins
    begins = {n for term in terms for n in target.hidden_above(term)}
    for name in target.chain:
        node, term = target.model[name], target.terms.get(name)
        if name not in slow or term is None or target.seen(name) is not None:
            continue
        if node.is_discrete or node.support is None or node.support.kind != "real":
            continue
        if name in begins:
            continue
        for scale in target.hidden_above(term):
            power = _power(target, scale, name, states) if _is_scale(target, scale) else None
            if power is not None:
                above.setdefault((scale, power), []).append(name)
    return [
        Rescaled(target, scale, below, power, every, how, debug)
        for (scale, power), below in above.items()
        if sum(math.prod(target.model[n].value_shape) for n in below) > 1
    ]


# ---- private ------------------------------------------------------------------------------------


def _is_scale(target: Target, name: str) -> bool:
    """Whether a node is a number above zero."""
    node, support = target.model[name], target.model[name].support
    if node.is_discrete or node.value_shape or target.seen(name) is not None or support is None:
        return False
    if support.kind != "interval" or np.size(support.low) != 1 or np.size(support.high) != 1:
        return False
    return name in target.terms and float(np.asarray(support.low)) == 0.0


def _power(target: Target, scale: str, name: str, states: Values) -> int | None:
    """Which power of the scale of a node a parameter is, if any, by trying."""
    try:
        with marking_invalid(), np.errstate(all="ignore"):
            centre = centre_of(target, name, states)
            before = target.terms[name].log(states)
            for power in _POWERS:
                tried = dict(states)
                tried[scale] = states[scale] * np.exp(power * _TRIED)
                tried[name] = centre + (states[name] - centre) * np.exp(_TRIED)
                target.compute(tried, target.below((scale, name)))
                numbers = math.prod(target.model[name].event_shape)
                after = target.terms[name].log(tried) + numbers * _TRIED
                same = np.isclose(after, before, rtol=_CLOSE, atol=_CLOSE)
                stays = np.isclose(centre_of(target, name, tried), centre, rtol=_CLOSE, atol=0)
                if same.all() and stays.all() and np.isfinite(before).all():
                    return power
    except (BayesmcError, ValueError, FloatingPointError):
        pass
    return None
