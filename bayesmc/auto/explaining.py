"""``explain``: which engine answers a question, of one slice or of many, and why."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Never

from bayesmc.auto.choosing import explained_series
from bayesmc.auto.explanation import Explanation
from bayesmc.auto.static import explained
from bayesmc.dbn import DynamicBayesNet
from bayesmc.distributions.parameters import by_keyword, refuse_positions
from bayesmc.engines.base import Engine
from bayesmc.engines.filtering import FilterEngine
from bayesmc.errors import UnsupportedError
from bayesmc.network import BayesNet, FactorGraph


@by_keyword
def explain(
    net: BayesNet | FactorGraph | DynamicBayesNet,
    evidence: Mapping[str, Any] | None = None,
    engine: Any = None,
    *beyond: Never,
    inputs: Mapping[str, Any] | None = None,
    question: str = "filter",
    keep: str | None = None,
    queries: Mapping[str, Any] | None = None,
) -> Explanation:
    """Which engine would answer, why, what it does to each node, and why anything better was refused.

    It prints the explanation and returns it.

    Parameters
    ----------
    net : BayesNet, FactorGraph or DynamicBayesNet
    evidence : dict, optional
        Evidence; for a template, observations with time first.
    engine : optional
        One to ask about; None for the one that would be chosen.
    inputs : dict, optional
    question : str
        For templates: ``"filter"``, ``"smooth"``, ``"fixed-lag"``, ``"forecast"`` or ``"most_likely"``.
    keep, queries : optional
        As the call would have them: they may ask for more than an engine answers.

    Raises
    ------
    UnsupportedError
        No engine can answer.

    Notes
    -----
    Where no engine over time can answer for a template (static nodes are unknown, say), it says so, and
    explains what ``infer`` does with the template unrolled.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet()
    >>> net.add("a", bmc.Bernoulli(0.2))
    >>> _ = bmc.explain(net)
    engine: Exact(max_bytes=2147483648.0)
      because hidden nodes are finite or linear-Gaussian: induced width 0, ...bytes
      a  eliminated
    """
    if beyond:
        refuse_positions(explain, beyond)
    over_time = isinstance(engine, FilterEngine) or not isinstance(engine, Engine)
    if isinstance(net, DynamicBayesNet) and over_time:
        try:
            explanation = explained_series(net, evidence, engine, inputs, question, keep, queries)
        except UnsupportedError as error:
            if engine is not None:
                raise
            explanation = _by_infer(net, evidence, inputs, question, error)
    else:
        explanation = explained(net, evidence, engine, inputs)
    print(explanation)
    return explanation


# ---- private ------------------------------------------------------------------------------------


def _by_infer(
    net: DynamicBayesNet,
    observations: Mapping[str, Any] | None,
    inputs: Mapping[str, Any] | None,
    question: str,
    refused: UnsupportedError,
) -> Explanation:
    """What ``infer`` does with a template that no engine over time answers for."""
    try:
        found = explained(net, observations, None, inputs)
    except UnsupportedError:
        raise refused from None
    reasons = (
        f"infer(dbn, observations) takes it, and over time no engine does: {refused}",
        *found.reasons,
    )
    return replace(found, reasons=reasons)
