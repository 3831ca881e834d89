"""What a kernel is: ``start`` makes its memory, ``step`` moves its nodes; the sweep lives elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.errors import DensityError
from bayesmc.structure.target import Values

#: what a kernel keeps from step to step: arrays and numbers by name
Memory = dict[str, Any]
#: how far the log ratio may be from zero, relative to the sizes of the terms it is made of
TOLERANCE = 1e-9


@dataclass(frozen=True)
class How:
    """What of kernels is machine code.

    Attributes
    ----------
    compiled : bool or None
        Always, never, or where a run is long enough to pay for it.
    threads : int
        Threads that share the chains then; the result is the same.
    """

    compiled: bool | None = None
    threads: int = 1


#: where nobody says
ANYHOW = How()


class Kernel:
    """A move of some nodes that leaves their full conditional invariant.

    Attributes
    ----------
    names : tuple of str
        The nodes it moves.
    label : str
        The kind of move, in a word or two.
    match : str
        What it rests on: the conjugate pair, the number of states, ...
    """

    names: tuple[str, ...] = ()
    label: str = ""
    match: str = ""
    #: rates of acceptance that are no reason to worry; None where any will do
    band: tuple[float, float] | None = (0.1, 0.9)
    #: how often a move asks for the densities that its nodes enter, about
    evaluations: float = 1.0

    def words(self, name: str) -> tuple[str, str]:
        """What it does to one of its nodes: the kind of move, and what that rests on."""
        return self.label, self.match

    def expect(self, steps: int, chains: int) -> None:  # noqa: B027 - most need not know
        """Told before a run how many steps its warmup takes, and of how many chains."""

    def told(self, steps: int, chains: int) -> str:
        """What else there is to say of such a run: whether it is machine code, and why not."""
        return ""

    def start(self, values: Values, chains: int) -> Memory:
        """Its memory before the first step."""
        return {}

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        """New values of its nodes, and its memory; neither argument is changed.

        With the values may come what follows from them and other kernels ask for (``label_sums``), under
        names that no node has.

        Parameters
        ----------
        values : dict
            Stored values of all nodes, hidden ones ``(chains, *plates, *event)``.
        warmup : bool
            Whether it may adapt.
        """
        raise NotImplementedError

    def moved(self, values: Values, memory: Memory) -> Memory:
        """Its memory where somebody else has put its nodes elsewhere; what it knew of the old place goes."""
        return memory

    def unsettled(self, memory: Memory) -> bool:
        """Whether it has only just begun to learn anew, so that a warmup should not end yet."""
        return False

    def end_warmup(self, memory: Memory) -> Memory:
        """Adaptation ends: what was learnt is frozen."""
        return memory

    def acceptance(self, memory: Memory) -> np.ndarray | None:
        """Rate of accepted proposals per chain since the warmup; None where nothing is rejected."""
        return memory["accepted"] / max(memory["moves"], 1) if "accepted" in memory else None


def counted(memory: Memory, share: np.ndarray) -> Memory:
    """The memory with one more step, of which each chain accepted a share."""
    return {**memory, "accepted": memory["accepted"] + share, "moves": memory["moves"] + 1}


def check_ratio(
    name: str, match: str, target: np.ndarray, proposal: np.ndarray, sizes: np.ndarray
) -> None:
    """Refuse a draw whose log density ratio is not that of the distribution it was drawn from.

    Parameters
    ----------
    target, proposal : ndarray
        Log density at the new value minus at the old one, by the model and by the closed form.
    sizes : ndarray
        Sum of the absolute values of all terms on both sides.

    Raises
    ------
    DensityError
        Naming the node, the conjugate pair and the ratio.
    """
    ratio = np.asarray(target - proposal)
    wrong = ~(np.abs(ratio) <= TOLERANCE * (1.0 + sizes))
    if wrong.any():
        worst = ratio[wrong].flat[np.abs(ratio[wrong]).argmax()]
        raise DensityError(
            f"node {name!r}: the closed form ({match}) is not the full conditional: log ratio {worst:.3g} "
            "instead of 0"
        )
