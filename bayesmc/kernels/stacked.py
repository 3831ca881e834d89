"""Any kernel of one node, moving a group of like nodes as one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bayesmc.errors import BayesmcError
from bayesmc.kernels.base import Kernel, Memory
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.stacked import StackedBlanket
from bayesmc.structure.target import Values


class Stacked(Kernel):
    """A kernel that moves all nodes of a stack at once.

    Parameters
    ----------
    stack : StackedBlanket
    make : callable
        From a blanket to the kernel that moves its node alone. It must be one to which the node's values may
        have further axes after the chains: all it does with values goes through the blanket.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.kernels.slice import Slice
    >>> from bayesmc.kernels.stacked import Stacked
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.blanket import Blanket
    >>> from bayesmc.structure.stacked import stacks
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet()
    >>> for j in range(5):
    ...     net.add(f"x[{j}]", lambda: bmc.Laplace(0.0, 1.0))
    ...     net.add(f"y[{j}]", lambda x: bmc.Poisson(np.exp(x)), parents=[f"x[{j}]"])
    >>> target = target_of(pose(net, {f"y[{j}]": j for j in range(5)}))
    >>> blankets = {name: Blanket(target, name) for name in target.chain}
    >>> (stack,), _ = stacks(target, blankets, target.chain)
    >>> kernel = Stacked(stack, Slice)
    >>> state = {**target.known, **{name: np.zeros(3) for name in kernel.names}}
    >>> moved, _ = kernel.step(state, kernel.start(state, 3), np.random.default_rng(0), False)
    >>> list(moved), moved["x[0]"].shape
    (['x[0]', 'x[1]', 'x[2]', 'x[3]', 'x[4]'], (3,))
    """

    def __init__(self, stack: StackedBlanket, make: Callable[[Blanket], Kernel]) -> None:
        self.stack = stack
        self.names = stack.names
        self._make = make
        self.kernel = make(stack.one)
        self.label = self.kernel.label
        self.match = self.kernel.match
        self.evaluations = self.kernel.evaluations

    def words(self, name: str) -> tuple[str, str]:
        label, match = self.kernel.words(self.stack.one.name)
        return label, f"{match}{', ' if match else ''}{len(self.names)} like nodes at once"

    def expect(self, steps: int, chains: int) -> None:
        self.kernel.expect(steps, chains * len(self.names))

    def told(self, steps: int, chains: int) -> str:
        return self.kernel.told(steps, chains * len(self.names))

    def start(self, values: Values, chains: int) -> Memory:
        return self.kernel.start(self.stack.gathered(values), chains)

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        state = self.stack.gathered(values)
        try:
            new, memory = self.kernel.step(state, memory, rng, warmup)
        except BayesmcError:
            self._blame(values)
            raise
        return self.stack.spread(new[self.stack.one.name]), memory

    def end_warmup(self, memory: Memory) -> Memory:
        return self.kernel.end_warmup(memory)

    def acceptance(self, memory: Memory) -> np.ndarray | None:
        return self.kernel.acceptance(memory)

    def _blame(self, values: Values) -> None:
        """Raise the error of the node that is at fault: the stack knows the first one's names only."""
        rng = np.random.default_rng(0)
        for blanket in self.stack.blankets:
            kernel = self._make(blanket)
            chains = len(values[blanket.name])
            kernel.step(values, kernel.start(values, chains), rng, False)
