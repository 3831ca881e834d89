"""What an engine is: frozen options, a reason to refuse, and one ``run``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from bayesmc.distributions.faults import missing
from bayesmc.engines.options import Options
from bayesmc.errors import BayesmcError
from bayesmc.network import BayesNet, FactorGraph, Problem, pose
from bayesmc.results import Posterior


@dataclass(frozen=True)
class Treatment:
    """A row of the table of ``explain``: what an engine does to a node.

    Attributes
    ----------
    node : str
    kernel : str
        The kind of move; empty where there is none.
    why : str
        The matched pair, the number of states, or why nothing better was taken.
    plates : str
        Plates with their sizes.
    colour : str
        Nodes of one colour share no factor.
    cost : float
        Share of a sweep that is spent on the node, by counted numbers; 0 where there is none to tell.
    """

    node: str
    kernel: str
    why: str = ""
    plates: str = ""
    colour: str = ""
    cost: float = 0.0

    def __str__(self) -> str:
        return f"{self.kernel}: {self.why}" if self.kernel and self.why else self.kernel or self.why


def kept_names(keep: Any, problem: Problem) -> tuple[tuple[str, ...], bool, bool]:
    """The nodes whose draws are wanted, whether as sums alone, and whether they stay in the file of a run.

    Parameters
    ----------
    keep : "draws", "summaries", "file", sequence of str, or {"file": sequence of str}
        As in ``infer``.
    """
    free = tuple(n for n, c in problem.model.nodes.items() if c.kind != "input")
    if isinstance(keep, str):
        return free, keep == "summaries", in_file(keep)
    if isinstance(keep, Mapping):
        return tuple(keep["file"]), False, True
    return tuple(keep), False, False


def in_file(keep: Any) -> bool:
    """Whether draws stay in the file of a run."""
    return keep == "file" or isinstance(keep, Mapping)


class Engine(Options):
    """Base of the engines; a family supplies ``refusal``, ``describe`` and ``run``.

    ``infer`` is the way in. An engine that cannot answer says why and names one that can.
    """

    #: whether ``run`` takes ``checkpoint=`` and saves itself as it goes on; others are saved at the end
    saves: ClassVar[bool] = False
    #: whether its work comes in units, so that ``run`` takes an ``executor``
    spreads: ClassVar[bool] = False

    def unsupported(
        self,
        net: BayesNet | FactorGraph,
        evidence: Mapping[str, Any] | None = None,
        inputs: Mapping[str, Any] | None = None,
    ) -> str | None:
        """Why this engine cannot answer (too costly included), or None."""
        problem = pose(net, evidence, inputs)
        try:
            return self.refusal(problem)
        except BayesmcError as error:  # options that do not fit the net
            return str(error)

    def refusal(self, problem: Problem) -> str | None:
        """Why this engine cannot answer a posed problem, or None."""
        raise missing(self, "method refusal(problem)")

    def describe(self, problem: Problem) -> dict[str, str]:
        """What the engine does to each node."""
        raise missing(self, "method describe(problem)")

    def table(self, problem: Problem) -> list[Treatment]:
        """What the engine does to each node, in columns; empty where ``describe`` says all."""
        return []

    def effort(self, problem: Problem) -> str:
        """What an answer takes, or how far it is to be trusted, in words; empty: nothing to say."""
        return ""

    def run(
        self,
        problem: Problem,
        seed: np.random.SeedSequence,
        keep: Any = "draws",
        progress: bool | None = None,
        resume: Posterior | None = None,
    ) -> Posterior:
        """Answer a posed problem, or raise the refusal."""
        raise missing(self, "method run(problem, seed, keep, progress, resume)")
