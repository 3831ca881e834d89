"""Several continuous nodes moved as one: adaptive Gaussian steps, and steps along an ensemble's differences.

All numbers of the block, on the unconstrained scale, make one vector per chain. Where chains come in
ensembles, half the members of each move given the other half, whose differences show the directions and
sizes that matter; ensembles never look at each other once the warmup is over. Angles are kept within one
turn, and their differences taken the short way round.

Steps from where a chain stands seldom lead from one hill of a density to another, and chains that start in
one look as if it were all there is. So a few numbers that are a whole posterior are now and then proposed
anew, from a mixture that was fitted to all hills from the prior on (``tempering``).

References
----------
ter Braak (2006), A Markov chain Monte Carlo version of the genetic algorithm differential evolution,
Statistics and Computing 16; Goodman and Weare (2010), Comm. App. Math. Comp. Sci. 5 (halves); Tierney (1994),
Annals of Statistics 22, sec. 2.3.1 (independence chains) and 2.4 (mixtures of kernels).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.distributions.base import marking_invalid
from bayesmc.distributions.transforms import Identity, Transform, Wrapped
from bayesmc.errors import BayesmcError
from bayesmc.kernels.adaptation import SCALE_DECAY, Steps, best_rate, chance
from bayesmc.kernels.base import Kernel, Memory, counted
from bayesmc.kernels.densities import Block, accepted, instead
from bayesmc.kernels.random_walk import Part, angles_of, finite, parts_of, walked
from bayesmc.kernels.tempering import MixtureOfT, fitted_mixture
from bayesmc.structure.target import Target, Values

#: share of steps that follow a difference of two members, and of these with factor one
_DIFFERENCES, _JUMPS = 0.5, 0.2
#: noise of those steps, in Gaussian steps
_NOISE = 1e-2
#: kinds of moves: a Gaussian step, a difference of adapted length, a difference as it is, a draw anew
_GAUSSIAN, _DIFFERENCE, _JUMP, _ANEW = 0, 1, 2, 3
#: draws with which a mixture is fitted; share of moves that draw from it
_DRAWS, AFRESH = 1000, 0.5
#: numbers that one evaluation of the mixture's draws may take
_ELEMENTS = 1 << 23


class BlockWalk(Kernel):
    """Metropolis-Hastings of several continuous nodes at once, by symmetric steps.

    Parameters
    ----------
    target : Target
    names : sequence of str
    ensemble : int
        Members of an ensemble: even, at least 4, or 1 for none. Chains then come as ensembles, one after
        the other: there are ``ensemble`` rows for each.
    scale : array_like, optional
        Standard deviations of the Gaussian steps, one number or one for each number of the block; by
        default they are learnt.
    unconstrained, adaptive : bool
        As for ``AdaptiveWalk``.
    alone : bool
        Nothing else moves what the block depends on, so that densities can be kept between steps.
    anew : float
        Share of moves that are draws from a mixture fitted to the whole density, at the first step of a
        warmup: of all hidden numbers, few and none of them an angle (``parts.may_be_drawn_anew``). With 1
        there are no others.
    every : int
        Steps of which one moves the block.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.kernels.ensemble import BlockWalk
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet()
    >>> net.add("m", bmc.Normal(0.0, 1.0))
    >>> net.add("s", bmc.HalfNormal(1.0))
    >>> net.add("x", lambda m, s: bmc.Normal(m, s))
    >>> target = target_of(pose(net, {"x": 0.5}))
    >>> kernel = BlockWalk(target, ["m", "s"], ensemble=4)
    >>> values = {**target.known, "m": np.zeros(8), "s": np.ones(8)}  # two ensembles
    >>> new, memory = kernel.step(values, kernel.start(values, 8), np.random.default_rng(0), True)
    >>> new["m"].shape, bool((new["s"] > 0).all())
    ((8,), True)
    """

    label = "adaptive random walk"

    def __init__(
        self,
        target: Target,
        names: Sequence[str],
        ensemble: int = 1,
        *,
        scale: Any = None,
        unconstrained: bool = True,
        adaptive: bool = True,
        alone: bool = False,
        anew: float = 0.0,
        every: int = 1,
    ) -> None:
        self.block = Block(target, names)
        self.names = self.block.names
        self.ensemble = ensemble
        self.unconstrained = unconstrained
        self.alone = alone
        self.anew, self.every = anew, every
        self.parts = parts_of(target, self.names, unconstrained)
        size = self.parts[-1].stop
        angles = [angles_of(target, part, unconstrained) for part in self.parts]
        self.steps = Steps(size, scale, adaptive, np.concatenate(angles))
        if ensemble > 1:
            self.label = "adaptive random walk and differential evolution"
            self.match = f"ensembles of {ensemble}"
        elif not adaptive:
            self.label = "random walk"
        if anew:
            self.label = (
                "independent proposals" if anew == 1.0 else f"{self.label}, independent proposals"
            )
        numbers = f"{size} number{'s' if size > 1 else ''}"
        self.match = f"{numbers} at once" + (f", {self.match}" if self.match else "")
        self.evaluations = 1.0 / every

    @property
    def size(self) -> int:
        """Numbers that move."""
        return self.steps.size

    def start(self, values: Values, chains: int) -> Memory:
        u, log = self._placed(values)
        return {
            "steps": self.steps.start(u[:, None]),
            "log_factor": 0.0,
            "u": u,
            "log": log,
            "accepted": np.zeros(chains),
            "moves": 0,
            "mixture": None,
            "fitted": not self.anew,
            "step": 0,
        }

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        if warmup and not memory["fitted"]:
            memory = {**memory, "fitted": True, "mixture": self._fitted(values, rng)}
        memory = {**memory, "step": memory["step"] + 1}
        stays = self.anew == 1.0 and memory["mixture"] is None
        if stays or memory["step"] % self.every:
            return {name: values[name] for name in self.names}, memory
        if self.alone and not self.block.has_own_data(values):
            u, log = memory["u"].copy(), memory["log"].copy()
        else:
            u, log = self._placed(values)
        new = {name: values[name].copy() for name in self.names}
        rates, moves = np.empty(len(u)), np.empty(len(u), dtype=np.int8)
        taken = np.zeros(len(u))
        for rows, others in self._halves(len(u), rng):
            tried, moves[rows], log_backward = self._proposed(u, rows, others, memory, rng)
            state = self.block.rows({**values, **new}, rows)
            moved, grown = self._evaluated(state, tried)
            log_ratio = grown - log[rows] + log_backward
            accept = accepted(log_ratio, rng)
            for name, value in moved.items():
                new[name][rows] = instead(~accept, value, state[name])
            u[rows] = instead(~accept, tried, u[rows])
            log[rows] = np.where(accept, grown, log[rows])
            rates[rows], taken[rows] = chance(log_ratio), accept
        kept = {"u": u, "log": log} if self.alone else {}
        if warmup:
            return new, {**memory, **kept, **self._learnt(memory, u, log, rates, moves)}
        return new, counted({**memory, **kept}, taken)

    def moved(self, values: Values, memory: Memory) -> Memory:
        u, log = self._placed(values)
        return {**memory, "u": u, "log": log}

    def end_warmup(self, memory: Memory) -> Memory:
        return {**memory, "steps": self.steps.frozen(memory["steps"])}

    def acceptance(self, memory: Memory) -> np.ndarray | None:
        if self.anew == 1.0 and memory["mixture"] is None:
            return None
        return super().acceptance(memory)

    def replaced(self, memory: Memory, rows: np.ndarray) -> Memory:
        """The memory once row i of the chains has become what row ``rows[i]`` was."""
        return {**memory, "u": memory["u"][rows], "log": memory["log"][rows]}

    # ---- private -------------------------------------------------------------------------------

    def _halves(self, rows: int, rng: np.random.Generator) -> list[tuple[Any, np.ndarray | None]]:
        """Rows to move in turn, and for each the members of its ensemble that stay, (rows, half)."""
        if self.ensemble == 1:
            return [(np.arange(rows), None)]
        members = np.arange(rows).reshape(-1, self.ensemble)[:, rng.permutation(self.ensemble)]
        half = self.ensemble // 2
        first, second = members[:, :half], members[:, half:]
        return [
            (first.ravel(), np.repeat(second, half, axis=0)),
            (second.ravel(), np.repeat(first, half, axis=0)),
        ]

    def _proposed(
        self,
        u: np.ndarray,
        rows: np.ndarray,
        others: np.ndarray | None,
        memory: Memory,
        rng: np.random.Generator,
    ) -> tuple[np.ndarray, np.ndarray, Any]:
        """Where some rows might go, by which kind of move, and log q(back) - log q(there)."""
        tried, moves = self._stepped(u, rows, others, memory, rng)
        mixture: MixtureOfT | None = memory["mixture"]
        if mixture is None:
            return tried, moves, 0.0
        far = np.flatnonzero(rng.random(len(rows)) < self.anew)
        if not len(far):
            return tried, moves, 0.0
        tried, moves, log_backward = tried.copy(), moves.copy(), np.zeros(len(rows))
        tried[far], moves[far] = mixture.draw(rng, len(far)), _ANEW
        log_q = mixture.log_prob(np.concatenate([u[rows[far]], tried[far]]))
        log_backward[far] = log_q[: len(far)] - log_q[len(far) :]
        return tried, moves, log_backward

    def _stepped(
        self,
        u: np.ndarray,
        rows: np.ndarray,
        others: np.ndarray | None,
        memory: Memory,
        rng: np.random.Generator,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Where steps lead, and of which kind each is.

        Every step is symmetric, on a circle, too. A step d is drawn without a look at where the row stands,
        and -d is as likely: for a difference the two members are as likely the other way round, and the short
        way between angles then changes its sign, unless they stand opposite each other, which has
        probability zero. What is added to an angle is wrapped, and wrapping commutes with adding steps, so
        that the chance to get from one point of the circle to another, summed over turns, is that of the way
        back. Were angles not wrapped, the target would repeat itself along a line for good and have no
        total: nothing holds members in one turn, their differences grow by ever more turns, and the angles
        run off to where doubles tell none apart.
        """
        steps = self.steps.draw(memory["steps"], rng, rows)[:, 0]
        if others is None:
            return self.steps.wrapped(u[rows] + steps), np.full(len(rows), _GAUSSIAN)
        kind, jumps, one, other = rng.random((4, len(rows)))
        along, jump = kind < _DIFFERENCES, jumps < _JUMPS
        count, at = others.shape[1], np.arange(len(rows))
        first = (one * count).astype(np.intp)
        second = (first + 1 + (other * (count - 1)).astype(np.intp)) % count
        factor = 2.38 / math.sqrt(2 * max(self.size, 1)) * math.exp(memory["log_factor"])
        difference = self.steps.wrapped(u[others[at, first]] - u[others[at, second]])
        # a little noise: differences of few members span less than the space
        difference = np.where(jump, 1.0, factor)[:, None] * difference + _NOISE * steps
        moves = np.where(along, np.where(jump, _JUMP, _DIFFERENCE), _GAUSSIAN)
        return self.steps.wrapped(u[rows] + np.where(along[:, None], difference, steps)), moves

    def _fitted(self, values: Values, rng: np.random.Generator) -> MixtureOfT | None:
        """A mixture fitted to the block's posterior, from draws of the prior on; None where none will do."""
        largest = max(math.prod(t.shape) for t in (*self.block.own.values(), *self.block.others))
        count = min(_DRAWS, _ELEMENTS // max(largest, 1))
        if self.block.has_own_data(values) or count < 20 * self.size:
            return None
        rows = np.zeros(count, dtype=np.intp)
        state = self.block.rows(values, rows)
        try:
            with marking_invalid(), np.errstate(all="ignore"):
                drawn, _ = self._placed({**state, **self._drawn(state, count, rng)})
                return fitted_mixture(lambda u: self._evaluated(state, u)[1], drawn, rng)
        except BayesmcError:  # parameters out of range far out: chains do without
            return None

    def _drawn(self, state: Values, count: int, rng: np.random.Generator) -> Values:
        """Draws of the block from the prior, and what follows from them."""
        model, drawn = self.block.target.model, dict(state)
        for name in self.block.order:
            dist, _ = model.evaluate(name, drawn)
            if name in self.names:
                drawn[name] = model.sample_stored(name, dist, rng, (count,))
            else:
                drawn[name] = dist
        return drawn

    def _placed(self, values: Values) -> tuple[np.ndarray, np.ndarray]:
        """The vectors behind current values, and the log densities of these vectors."""
        vectors: list[np.ndarray] = []
        parts = {part.name: part for part in self.parts}

        def read(name: str, dist: Distribution | None) -> tuple[np.ndarray, Any]:
            value, part = values[name], parts[name]
            transform = self._transform(name, dist)
            free = finite(transform.unconstrain(value))
            flat = self._elements(free, part)
            vectors.append(flat.reshape(len(value), -1))
            return value, self._volume(transform, free, part)

        _, log = self.block.log(values, read)
        return np.concatenate(vectors, axis=1), log

    def _evaluated(self, values: Values, u: np.ndarray) -> tuple[Values, np.ndarray]:
        """The nodes' values behind vectors, and the log densities of these."""
        model = self.block.target.model
        parts = {part.name: part for part in self.parts}

        def write(name: str, dist: Distribution | None) -> tuple[np.ndarray, Any]:
            part, node = parts[name], model[name]
            transform = self._transform(name, dist)
            piece = u[:, part.start : part.stop]
            shape = (len(u), *node.plate_shape, *part.shape)
            if part.free is None:
                free = piece.reshape(shape)
            else:
                free = np.zeros((len(u), math.prod(node.plate_shape), *part.shape))
                free[:, part.free] = piece.reshape(len(u), -1, *part.shape)
                free = free.reshape(shape)
            value = free if type(transform) is Identity else transform.constrain(free)
            if dist is None and not self.unconstrained:
                assert node.support is not None
                inside = node.support.contains(value).reshape(len(u), -1).all(axis=1)
                return value, np.where(inside, 0.0, -np.inf)
            if part.free is not None:
                value = self._with_seen(value, values[name], part)
            return value, self._volume(transform, free, part)

        state, log = self.block.log(values, write)
        return {name: state[name] for name in self.names}, log

    def _transform(self, name: str, dist: Distribution | None) -> Transform:
        node = self.block.target.model[name]
        support = node.support if dist is None or node.support is not None else dist.support
        assert support is not None
        return walked(support, node.event_shape, self.unconstrained)

    def _volume(self, transform: Transform, free: np.ndarray, part: Part) -> np.ndarray:
        """Log of the change of volume of one node, all elements together, shape (chains,)."""
        if isinstance(transform, (Identity, Wrapped)):
            return np.zeros(len(free))
        plates = self.block.target.model[part.name].plate_shape
        log = np.broadcast_to(transform.log_abs_det_jacobian(free), (len(free), *plates))
        flat = log.reshape(len(free), -1)
        return (flat if part.free is None else flat[:, part.free]).sum(axis=1)

    def _elements(self, free: np.ndarray, part: Part) -> np.ndarray:
        """The numbers of the elements that move, shape (chains, elements, size)."""
        plates = self.block.target.model[part.name].plate_shape
        flat = free.reshape(len(free), math.prod(plates), -1)
        return flat if part.free is None else flat[:, part.free]

    def _with_seen(self, value: np.ndarray, now: np.ndarray, part: Part) -> np.ndarray:
        """A value whose elements that do not move are what they were."""
        node = self.block.target.model[part.name]
        moves = np.zeros(math.prod(node.plate_shape), dtype=bool)
        moves[part.free] = True
        at = moves.reshape(node.plate_shape + (1,) * len(node.event_shape))
        return np.where(at, value, now)

    def _learnt(
        self,
        memory: Memory,
        u: np.ndarray,
        log: np.ndarray,
        rates: np.ndarray,
        moves: np.ndarray,
    ) -> dict[str, Any]:
        """What adapts: the Gaussian steps, and the length of those along differences."""
        gaussian = np.where(moves == _GAUSSIAN, rates, np.nan)[:, None]
        steps = self.steps.learnt(memory["steps"], u[:, None], gaussian, self._typical(log))
        log_factor, along = memory["log_factor"], moves == _DIFFERENCE
        if self.steps.adaptive and along.any():
            gain = (steps["count"] + 1.0) ** -SCALE_DECAY
            error = rates[along].mean() / best_rate(self.size) - 1.0
            log_factor = float(np.clip(log_factor + gain * error, -6.0, 1.0))
        return {"steps": steps, "log_factor": log_factor}

    def _typical(self, log: np.ndarray) -> np.ndarray | None:
        """Members whose log density is not far below that of the rest of their ensemble."""
        if self.ensemble < 8:
            return None
        return ~stragglers(log.reshape(-1, self.ensemble)).ravel()


def stragglers(log: np.ndarray, ranges: float = 3.0) -> np.ndarray:
    """Members far below the others, shape (ensembles, members), by ranges between the quartiles.

    References
    ----------
    Vrugt et al. (2009), International Journal of Nonlinear Sciences and Numerical Simulation 10 (outlier
    chains in differential evolution).
    """
    low, high = np.quantile(log, [0.25, 0.75], axis=1, keepdims=True)
    with np.errstate(invalid="ignore"):
        return log < low - ranges * (high - low) - 2.0
