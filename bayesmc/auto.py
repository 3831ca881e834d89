"""The way in: ``infer`` poses a problem and runs an engine on it; ``explain`` says which and why."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

from bayesmc.engines.base import Engine, Treatment
from bayesmc.engines.exact import Exact, readable_bytes
from bayesmc.engines.exact_plan import too_large_to_search
from bayesmc.engines.gibbs import Gibbs
from bayesmc.engines.gibbs_plan import plan_of
from bayesmc.engines.weighting import LikelihoodWeighting
from bayesmc.errors import UnknownNodeError, UnsupportedError
from bayesmc.network import BayesNet, FactorGraph, Problem, pose
from bayesmc.randomness import seed_sequence
from bayesmc.results import Posterior

#: bytes up to which an exact answer counts as cheap
_CHEAP = 256 * 2**20


@dataclass(frozen=True)
class Explanation:
    """Which engine answers a question, and why.

    Attributes
    ----------
    engine : object
        The engine that would run.
    reasons : tuple of str
    refused : dict
        Engine name -> why it was not taken.
    nodes : dict
        Node -> what the engine does to it.
    table : tuple of Treatment
        The same in columns (node, kernel, why, plates, colour), for engines that move nodes one by one.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet()
    >>> net.add("x", bmc.Normal(0.0, 1.0))
    >>> explanation = bmc.explain(net, engine=bmc.LikelihoodWeighting(100))
    engine: LikelihoodWeighting(draws=100)
      because it was asked for
      x  sampled given its parents
    >>> explanation.nodes
    {'x': 'sampled given its parents'}
    """

    engine: Any
    reasons: tuple[str, ...]
    refused: dict[str, str] = field(default_factory=dict)
    nodes: dict[str, str] = field(default_factory=dict)
    table: tuple[Treatment, ...] = ()

    def __str__(self) -> str:
        lines = [f"engine: {self.engine!r}", *(f"  because {r}" for r in self.reasons)]
        lines += [f"not {name}: {why}" for name, why in self.refused.items()]
        if self.table:
            return "\n".join([*lines, *_columns(self.table)])
        shown = list(self.nodes.items())
        width = max((len(n) for n, _ in shown), default=0)
        lines += [f"  {name.ljust(width)}  {what}" for name, what in shown[:40]]
        if len(shown) > 40:
            lines.append(f"  ... and {len(shown) - 40} more nodes")
        return "\n".join(lines)


def infer(
    net: BayesNet | FactorGraph,
    evidence: Mapping[str, Any] | None = None,
    *,
    inputs: Mapping[str, Any] | None = None,
    engine: Any = None,
    rng: Any = None,
    progress: bool | None = None,
    keep: str | Sequence[str] = "draws",
    resume: Posterior | None = None,
) -> Posterior:
    """The posterior of a net, or of a factor graph, given evidence.

    Parameters
    ----------
    net : BayesNet or FactorGraph
    evidence : dict, optional
        Node name -> value, an array over the node's plates, or a state label. A masked entry, NaN in a
        plated node, or None is unobserved.
    inputs : dict, optional
        Values of the net's input nodes.
    engine : optional
        ``Exact()``, ``LikelihoodWeighting(draws)``, ...; None chooses (see ``explain``).
    rng : seed, SeedSequence, Generator or None
        The same seed gives the same result.
    progress : bool, optional
        Show a bar for what takes over a second; None: on a terminal.
    keep : "draws", "summaries" or a list of node names
        What to hold: all draws; means, variances and probabilities alone, in constant memory; or the
        draws of some nodes.
    resume : Posterior, optional
        An earlier posterior of the same question whose draws are continued.

    Returns
    -------
    Posterior

    Raises
    ------
    ModelError, EvidenceError, UnsupportedError
        With the node's name, the fault and the fix.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet()
    >>> net.add("rain", bmc.Bernoulli(0.2), states=("no", "yes"))
    >>> net.table("wet", ["rain"], [[0.9, 0.1], [0.1, 0.9]], states=("no", "yes"))
    >>> bmc.infer(net, {"wet": "yes"}).probabilities("rain").round(4).tolist()
    [0.3077, 0.6923]
    """
    problem = pose(net, evidence, inputs)
    _check_keep(keep, problem)
    chosen = _choose(problem)[0] if engine is None else _checked(engine)
    reason = None if isinstance(chosen, Exact) else chosen.refusal(problem)
    if reason is not None:
        raise UnsupportedError(_with_alternative(reason, chosen, problem))
    return chosen.run(problem, seed_sequence(rng), keep, progress, resume)


def explain(
    net: BayesNet | FactorGraph,
    evidence: Mapping[str, Any] | None = None,
    engine: Any = None,
    *,
    inputs: Mapping[str, Any] | None = None,
) -> Explanation:
    """Which engine would answer, why, what it does to each node, and why anything better was refused.

    It prints the explanation and returns it.

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
    problem = pose(net, evidence, inputs)
    if engine is None:
        chosen, reasons, refused = _choose(problem)
    else:
        chosen, reasons, refused = _checked(engine), ("it was asked for",), {}
        why = chosen.refusal(problem)
        if why is not None:
            refused = {type(chosen).__name__: why}
            reasons = ("it was asked for, but it cannot answer",)
    nodes = {} if type(chosen).__name__ in refused else chosen.describe(problem)
    table = () if type(chosen).__name__ in refused else tuple(chosen.table(problem))
    explanation = Explanation(chosen, tuple(reasons), refused, nodes, table)
    print(explanation)
    return explanation


def _columns(table: Sequence[Treatment]) -> list[str]:
    """A table of nodes in aligned columns; columns that are empty throughout are left out."""
    names = [f.name for f in fields(Treatment) if f.name != "why"] + ["why"]
    shown = [n for n in names if any(getattr(row, n) for row in table)]
    cells = [shown, *([getattr(row, n) for n in shown] for row in table[:60])]
    widths = [max(len(row[i]) for row in cells) for i in range(len(shown))]
    lines = [
        "  " + "  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip()
        for row in cells
    ]
    if len(table) > 60:
        lines.append(f"  ... and {len(table) - 60} more nodes")
    return lines


def _choose(problem: Problem) -> tuple[Any, tuple[str, ...], dict[str, str]]:
    """Exact where cheap; Gibbs where something was observed and its chains can move; else weighting."""
    exact = Exact(max_bytes=_CHEAP)
    too_large = too_large_to_search(problem)
    why_not = too_large if too_large is not None else exact.refusal(problem)
    if why_not is None:
        cost = exact.cost(problem)
        size = readable_bytes(cost.bytes)
        return (
            Exact(),
            (f"hidden nodes are finite or linear-Gaussian: {cost.words}, about {size}",),
            {},
        )
    if too_large is None and Exact().refusal(problem) is None:
        cost = Exact().cost(problem)
        why_not = (
            f"it would take about {readable_bytes(cost.bytes)} ({cost.words}), more than counts as cheap; "
            "engine=bmc.Exact() answers all the same"
        )
    refused = {"Exact": why_not}
    weighting = LikelihoodWeighting()
    forward = weighting.refusal(problem)
    no_plan = Gibbs().refusal(problem)
    if no_plan is not None:
        if forward is not None:
            raise UnsupportedError(f"infer: no engine can answer. {why_not}. {forward}. {no_plan}")
        refused["Gibbs"] = no_plan
        return weighting, ("every hidden node can be sampled given its parents",), refused
    plan = plan_of(problem)
    if plan.kernels and (forward is not None or not plan.constraints):
        if forward is not None:
            refused["LikelihoodWeighting"] = forward
        return Gibbs(), (f"the full conditionals can be drawn from: {plan.in_short()}",), refused
    if forward is not None:
        raise UnsupportedError(f"infer: no engine can answer. {why_not}. {forward}")
    if not plan.kernels:
        return weighting, ("nothing observed depends on a hidden node",), refused
    refused["Gibbs"] = (
        f"zero probabilities tie {', '.join(map(repr, plan.constraints[:4]))} together, so that its chains "
        "may be stuck"
    )
    return weighting, ("every hidden node can be sampled given its parents",), refused


def _checked(engine: Any) -> Any:
    if isinstance(engine, type):
        raise TypeError(
            f"engine={engine.__name__} is a class; give an instance: {engine.__name__}()"
        )
    if not isinstance(engine, Engine):
        raise TypeError(
            f"engine={engine!r} is not an engine; use Exact(), Gibbs(draws), LikelihoodWeighting(draws), ..."
        )
    return engine


def _with_alternative(reason: str, engine: Any, problem: Problem) -> str:
    try:
        other = _choose(problem)[0]
    except UnsupportedError:
        return reason
    if type(other) is type(engine):
        return reason
    return f"{reason}; {type(other).__name__}() can answer this"


def _check_keep(keep: Any, problem: Problem) -> None:
    if isinstance(keep, str):
        if keep not in ("draws", "summaries"):
            raise ValueError(
                f'infer(keep={keep!r}): give "draws", "summaries" or a list of node names'
            )
        return
    if not isinstance(keep, Sequence):
        raise ValueError(f'infer(keep={keep!r}): give "draws", "summaries" or a list of node names')
    for name in keep:
        if name not in problem.model.nodes:
            raise UnknownNodeError(f"infer: keep= names {name!r}, which is not a node")
