"""A sweep: every kernel in turn on one state, deterministic nodes recomputed after each.

What the kernels are, and how rows of the state make chains, is each engine's affair.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bayesmc.engines.forward import fast_steps
from bayesmc.engines.mcmc.short_runs import by_short_runs, has_labels
from bayesmc.engines.mcmc.starts import start_states
from bayesmc.engines.mcmc.uphill import uphill
from bayesmc.errors import ModelError, UnsupportedError
from bayesmc.kernels.base import Kernel
from bayesmc.kernels.redrawn import renewals
from bayesmc.network import Problem
from bayesmc.network.forward import Pass, refuse_noiseless, refuse_parts, run
from bayesmc.structure.target import Target, Values, target_of


class SweepSampler:
    """A ``chains.Sampler`` that moves a state by kernels.

    Parameters
    ----------
    target : Target
    kernels : sequence of Kernel
        In the order of a sweep.
    """

    def __init__(self, target: Target, kernels: Sequence[Kernel]) -> None:
        self.target = target
        self.kernels = list(kernels)
        self._checked = 0
        problem = target.problem
        bare = replace(problem.model, potentials={})  # none reads what is drawn forward
        steps = fast_steps(bare, problem.observed, problem.inputs)
        by_name = dict(zip(bare.nodes, steps, strict=True))
        self._forward = [by_name[n] for n in target.forward]
        self.forward_nodes = _apart(target)
        #: useful rates of acceptance, where some are
        self.acceptance_band: dict[str, tuple[float, float] | None]
        self.acceptance_band = {block_name(k): k.band for k in self.kernels}
        #: where the user wants chains to start: node -> stored values, shape (chains, *plates, *event)
        self.given: Values = {}
        #: groups of consecutive chains that start as one; 0 where each starts by itself
        self.superchains = 0
        #: whether starts are moved uphill first: kernels that move one number at a time may never get there
        self.climbs = False

    def start(self, rng: np.random.Generator, chains: int) -> dict[str, Any]:
        return self._started(rng, chains, chains)

    def step(self, state: Mapping[str, Any], rng: np.random.Generator, warmup: bool) -> Any:
        values: Values = {**self.target.known, **state["values"]}
        memory = list(state["memory"])
        for i, kernel in enumerate(self.kernels):
            new, memory[i] = kernel.step(values, memory[i], rng, warmup)
            if i >= self._checked:  # each kernel once
                _check_moved(self.target, kernel, new, values)
                self._checked = i + 1
            values.update(new)
            self.target.refresh(values, kernel.names)
        return {**state, "values": {n: values[n] for n in state["values"]}, "memory": memory}

    def end_warmup(self, state: Mapping[str, Any]) -> Any:
        memory = [k.end_warmup(m) for k, m in zip(self.kernels, state["memory"], strict=True)]
        return {**state, "memory": memory}

    def unsettled(self, state: Mapping[str, Any]) -> bool:
        """Whether a kernel has only just begun to learn anew, so that a warmup should not end yet."""
        return any(k.unsettled(m) for k, m in zip(self.kernels, state["memory"], strict=True))

    def values(self, state: Mapping[str, Any], rng: np.random.Generator) -> Values:
        return self.completed(state["values"], state["chains"], rng)

    def moving(self, state: Mapping[str, Any]) -> Values:
        """Values of the nodes that chains move, and of what follows from them."""
        return state["values"]

    def acceptance(self, state: Mapping[str, Any]) -> dict[str, np.ndarray]:
        rates = {
            block_name(kernel): kernel.acceptance(memory)
            for kernel, memory in zip(self.kernels, state["memory"], strict=True)
        }
        return {name: rate for name, rate in rates.items() if rate is not None}

    def renewals(self, state: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """How often each finite node that may wait for hidden numbers below it was moved with them.

        Never less than there are rows, which start one by one.
        """
        found = renewals(self.target, self.kernels, state["memory"])
        rows = max((len(state["values"][n]) for n in found), default=0)
        return {name: np.asarray(np.maximum(count, rows)) for name, count in found.items()}

    def divergences(self, state: Mapping[str, Any]) -> np.ndarray | None:
        """Trajectories of each chain that diverged since the warmup; None where none are made."""
        counts = [m["divergences"] for m in state["memory"] if "divergences" in m]
        return np.asarray(sum(counts)) if counts else None

    def energies(self, state: Mapping[str, Any]) -> np.ndarray | None:
        """The energy of each chain's last trajectory; None where none or several kernels make some."""
        found = [m["energy"]["last"] for m in state["memory"] if "energy" in m]
        return np.array(found[0]) if len(found) == 1 else None

    # ---- for engines whose rows are no chains --------------------------------------------------

    def _started(self, rng: np.random.Generator, chains: int, rows: int) -> dict[str, Any]:
        """A state of ``rows`` rows for ``chains`` chains."""
        given = self.given_rows(rows)
        starts = rows if given or not self.superchains else self.superchains

        def draw(count: int) -> Values:
            values = start_states(self.target, count, rng, given)
            return uphill(self.target, values, rng) if self.climbs and not given else values

        values = (
            by_short_runs(self.target, self.kernels, draw, starts, rng)
            if not given and has_labels(self.target)
            else draw(starts)
        )
        inside = {n: values[n] for n in (*self.target.chain, *self.target.links)}
        if starts < rows:
            inside = {n: np.repeat(v, rows // starts, axis=0) for n, v in inside.items()}
            values = {**values, **inside}
        memory = [kernel.start(values, rows) for kernel in self.kernels]
        return {"values": inside, "memory": memory, "chains": chains}

    def given_rows(self, rows: int) -> Values:
        """Where the user wants the rows of the state to start, those of a chain alike."""
        inside = {n: v for n, v in self.given.items() if n in self.target.chain}
        return {n: np.repeat(v, rows // len(v), axis=0) for n, v in inside.items()}

    def completed(
        self, values: Mapping[str, np.ndarray], chains: int, rng: np.random.Generator
    ) -> Values:
        """All nodes' values: what is known, what the chains say, and what is drawn forward from these."""
        known: Values = {**self.target.known, **values}
        return run(self._forward, Pass(rng, (chains,), known)).values if self._forward else known


def block_name(kernel: Kernel) -> str:
    """What a kernel's acceptance rate stands under."""
    return ", ".join(kernel.names)


def refused(
    problem: Problem,
    who: str,
    words: str,
    planned: Callable[[Problem], str | None],
    takes_parts: bool = False,
) -> str | None:
    """Why an engine whose kernels sweep over a net cannot answer; None where it can.

    Parameters
    ----------
    problem : Problem
    who : str
        The engine.
    words : str
        What is said before the reason where something is unsupported: "has no kernel for this net".
    planned : callable
        Makes the plan, or says why there is none.
    takes_parts : bool
        Whether its kernels leave components alone that were seen of vectors seen in part.
    """
    parts = None if takes_parts else refuse_parts(problem.observed, who)
    if parts is not None:
        return parts
    try:
        terms = [n for n in target_of(problem).terms if n in problem.model.nodes]
        return refuse_noiseless(problem.model, terms, who) or planned(problem)
    except UnsupportedError as error:
        return f"{who} {words}: {error}"


# ---- private ------------------------------------------------------------------------------------


def _apart(target: Target) -> frozenset[str]:
    """Nodes in which the chains have no part: all else, if only computed from them, shows how they mix."""
    moved = {*target.chain, *target.links}
    for name in target.forward:  # parents first
        if moved.intersection(target.problem.model[name].parents):
            moved.add(name)
    return frozenset(target.forward) - moved


def _check_moved(
    target: Target, kernel: Kernel, new: Mapping[str, Any], values: Mapping[str, Any]
) -> None:
    """Refuse what is no move of a kernel's nodes: of a kernel that somebody wrote, this may be."""
    step = f"{type(kernel).__name__}.step"
    for name in kernel.names:
        if name not in new:
            raise ModelError(f"{step} moves {name!r} (names), but returned only {', '.join(new)}")
        shape = np.shape(new[name])
        if shape != values[name].shape:
            raise ModelError(
                f"{step} returned shape {shape} for node {name!r}, whose state has shape "
                f"{values[name].shape}: chains first, then plates"
            )
        if not np.isfinite(new[name]).all():
            raise ModelError(f"{step} returned {name!r} with values that are not finite")
        if (target.with_seen(name, new[name]) != new[name]).any():
            raise ModelError(
                f"{step} returned {name!r} with other values than were observed of it; put these in their "
                "place (target.with_seen)"
            )
