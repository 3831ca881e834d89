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

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BayesmcError, DensityError
from bayesmc.kernels.base import Kernel, Memory
from bayesmc.kernels.slice import EVALUATIONS, slice_move
from bayesmc.shapes import Shape
from bayesmc.structure.like_terms import TermSum
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
    """

    label = "rescaled"
    evaluations = EVALUATIONS

    def __init__(
        self, target: Target, name: str, below: Sequence[str], power: int, every: int = 1
    ) -> None:
        self.target, self.every = target, every
        self.name, self.below, self.power = name, tuple(below), power
        self.names = (name, *below)
        self.terms = TermSum(target, target.terms_of(self.names))
        self.path = target.below(self.names)
        self.numbers = sum(math.prod(target.model[n].value_shape) for n in below)
        support = target.model[name].support
        assert support is not None
        self.high = float(np.asarray(support.high))

    def words(self, name: str) -> tuple[str, str]:
        if name == self.name:
            return self.label, f"{', '.join(self.below)} in proportion"
        return self.label, f"in proportion to {self.name}"

    def start(self, values: Values, chains: int) -> Memory:
        return {"width": 1.0, "moved": 0.0, "count": 0, "sweep": 0}

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        memory = {**memory, "sweep": memory["sweep"] + 1}
        if memory["sweep"] % self.every:
            return {n: values[n] for n in self.names}, memory
        centres = {n: centre_of(self.target, n, values) for n in self.below}
        start = np.zeros(len(values[self.name]))
        # heavy tails may have no mean: such chains stay, and are the same wherever the move would lead
        fixed = ~self._all(np.isfinite, centres, start.shape)
        centres = {n: np.where(np.isfinite(c), c, 0.0) for n, c in centres.items()}

        def log_density(t: np.ndarray) -> np.ndarray:
            return self._log(values, centres, t, fixed)

        try:
            t = slice_move(log_density, start, np.full(start.shape, memory["width"]), rng)
        except DensityError as error:
            raise DensityError(f"nodes {', '.join(map(repr, self.names))}: {error}") from error
        t = np.where(fixed, 0.0, t)
        if warmup:
            count = memory["count"] + 1
            rate = max(1.0 / count, 0.02)
            moved = (1 - rate) * memory["moved"] + rate * float(np.abs(t).mean())
            memory |= {"width": 3.0 * moved or 1.0, "moved": moved, "count": count}
        return self._scaled(values, centres, t), memory

    # ---- private -------------------------------------------------------------------------------

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


def rescaled_kernels(target: Target, slow: Collection[str], every: int = 1) -> list[Kernel]:
    """The kernels for all scales of nodes that have no closed form.

    Parameters
    ----------
    target : Target
    slow : collection of str
        Nodes that are moved number by number.
    every : int
        Sweeps of which one moves them.

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
        Rescaled(target, scale, below, power, every)
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
