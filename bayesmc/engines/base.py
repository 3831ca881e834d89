"""What an engine is: frozen options, a reason to refuse, and one ``run``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bayesmc.errors import BayesmcError
from bayesmc.network import BayesNet, Problem, pose
from bayesmc.results import Posterior


class Engine:
    """Base of the engines; a family supplies ``refusal``, ``describe`` and ``run``.

    ``infer`` is the way in. An engine that cannot answer says why and names one that can.
    """

    def unsupported(
        self,
        net: BayesNet,
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
        raise NotImplementedError

    def describe(self, problem: Problem) -> dict[str, str]:
        """What the engine does to each node."""
        raise NotImplementedError

    def run(
        self,
        problem: Problem,
        seed: np.random.SeedSequence,
        keep: Any = "draws",
        progress: bool | None = None,
        resume: Posterior | None = None,
    ) -> Posterior:
        """Answer a posed problem, or raise the refusal."""
        raise NotImplementedError
