"""Vectors seen in part: what is missing of them drawn from the node's own density given the rest.

Where nothing depends on the vectors, that is their full conditional; where something does, its densities
decide (Metropolis-Hastings), element by element.
"""

from __future__ import annotations

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.kernels.base import Kernel, Memory, counted
from bayesmc.kernels.densities import accepted, instead
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Values


class Completed(Kernel):
    """Draws the missing components of a node's vectors given those that were seen.

    Parameters
    ----------
    blanket : Blanket
        Of a node of which some vectors are seen in part.

    References
    ----------
    Tanner and Wong (1987), JASA 82 (data augmentation); Schafer (1997), Analysis of Incomplete Multivariate
    Data, ch. 5.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.kernels.completed import Completed
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.blanket import Blanket
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet(plates={"row": 2})
    >>> net.add("x", bmc.MvNormal([0.0, 0.0], [[1.0, 0.8], [0.8, 1.0]]), plates="row")
    >>> target = target_of(pose(net, {"x": [[1.0, np.nan], [0.0, 2.0]]}))
    >>> kernel = Completed(Blanket(target, "x"))
    >>> values = {**target.known, "x": np.tile([[1.0, 0.0], [0.0, 2.0]], (4000, 1, 1))}
    >>> new, _ = kernel.step(values, kernel.start(values, 4000), np.random.default_rng(0), True)
    >>> new["x"].mean(axis=0).round(1).tolist(), new["x"].std(axis=0).round(1).tolist()
    ([[1.0, 0.8], [0.0, 2.0]], [[0.0, 0.6], [0.0, 0.0]])
    """

    label = "completed"
    band = None

    def __init__(self, blanket: Blanket) -> None:
        self.blanket = blanket
        self.names = (blanket.name,)
        seen = blanket.target.seen(blanket.name)
        assert seen is not None and seen.parts is not None and blanket.own is not None
        event = len(blanket.event_shape)
        known = np.broadcast_to(seen.numbers(event), blanket.node.value_shape)
        self.known = known.reshape(blanket.size, -1)
        self.match = "what is missing of its vectors given what was seen of them"
        if blanket.children:
            self.match += "; accepted or not by what depends on them"

    def start(self, values: Values, chains: int) -> Memory:
        return {"accepted": np.zeros(chains), "moves": 0} if self.blanket.children else {}

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        blanket, name = self.blanket, self.blanket.name
        drawn = self._drawn(values, rng)
        if not blanket.children:
            return {name: drawn}, memory
        state, taken = values, []
        for members in blanket.classes:
            now = blanket.current(state, members)
            new = drawn if members is None else self._flat(drawn)[:, members]
            both = blanket.placed(state, np.stack([now, new]), members)
            shape = now.shape[: now.ndim - len(blanket.event_shape)]
            gain = np.zeros(shape)
            for child in blanket.children:
                log = np.broadcast_to(blanket.child_log(child, both, members), (2, *shape))
                gain = gain + log[1] - log[0]
            accept = accepted(gain, rng)
            state = {**state, name: blanket.moved(state, instead(~accept, new, now), members)}
            taken.append(accept.reshape(len(accept), -1))
        if not warmup:
            memory = counted(memory, np.concatenate(taken, axis=1).mean(axis=1))
        return {name: state[name]}, memory

    # ---- private -------------------------------------------------------------------------------

    def _drawn(self, values: Values, rng: np.random.Generator) -> np.ndarray:
        """The node's whole value with what is missing drawn anew, shape ``(chains, *plates, *event)``."""
        blanket, now = self.blanket, values[self.blanket.name]
        assert blanket.own is not None
        dist, _ = blanket.own.distribution(values)
        shape = (len(now), *blanket.node.plate_shape)
        drawn = self._flat(now).copy()
        for pattern in np.unique(self.known, axis=0):
            if pattern.all():
                continue
            here = (self.known == pattern).all(axis=1)
            completed = dist.completed(rng, shape, now, pattern)
            drawn[:, here] = self._flat(completed)[:, here]
        return drawn.reshape(now.shape)

    def _flat(self, value: np.ndarray) -> np.ndarray:
        """Values with their plates in one axis."""
        return value.reshape(len(value), self.blanket.size, *self.blanket.event_shape)


def completed_kernel(blanket: Blanket) -> Completed:
    """The kernel of a node whose vectors are seen in part.

    Raises
    ------
    UnsupportedError
        Its family has no marginal of some components that were seen.
    """
    kernel = Completed(blanket)
    target = blanket.target
    if target.states is not None:
        with marking_invalid(), np.errstate(all="ignore"):
            kernel.step(target.first_state, kernel.start({}, 1), np.random.default_rng(0), True)
    return kernel
