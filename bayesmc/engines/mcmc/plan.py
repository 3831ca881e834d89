"""The kernels of a sweep, and the table that says of each node which of them move it, and why."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from bayesmc.engines.base import Treatment
from bayesmc.engines.mcmc.cost import shares
from bayesmc.engines.weighted.drawing import treatment
from bayesmc.kernels.base import Kernel
from bayesmc.network import Problem
from bayesmc.structure.blanket import Blanket, colours
from bayesmc.structure.target import Target


@dataclass(frozen=True, eq=False)
class Plan:
    """The kernels of a sweep.

    Attributes
    ----------
    kernels : list of Kernel
        In the order of a sweep: children before parents.
    refusals : dict
        Node -> why it has no closed form.
    constraints : tuple of str
        Nodes among which zeros in tables may keep a chain from reaching every configuration.
    """

    problem: Problem
    target: Target
    blankets: Mapping[str, Blanket] = field(default_factory=dict)
    kernels: list[Kernel] = field(default_factory=list)
    refusals: dict[str, str] = field(default_factory=dict)
    constraints: tuple[str, ...] = ()

    def table(self, steps: int = 0, chains: int = 1) -> list[Treatment]:
        """What happens to each node, in a run of so many sweeps of warmup."""
        model = self.problem.model
        by_name: dict[str, list[Kernel]] = {}
        for kernel in self.kernels:
            for name in kernel.names:
                by_name.setdefault(name, []).append(kernel)
        number, cost = self._colours(), shares(self.kernels, self.target)
        rows = []
        for name, node in model.nodes.items():
            plates = ", ".join(f"{p}={model.sizes[p]}" for p in node.plates)
            if name not in by_name:
                forward = name in self.target.forward and node.is_stochastic
                barren = forward and self.target.seen(name) is None
                why = "nothing observed depends on it" if barren else self._given(name)
                rows.append(Treatment(name, "forward" if barren else "", why, plates))
                continue
            kinds, words = zip(*(k.words(name) for k in by_name[name]), strict=True)
            why = "; then ".join(dict.fromkeys(w for w in words if w))
            if name in self.refusals:
                why += f"{', ' if why else ''}since {self.refusals[name]}"
            told = dict.fromkeys(k.told(steps, chains) for k in by_name[name])
            why = "; ".join(part for part in (why, *told) if part)
            classes = len(self.blankets[name].classes)
            colour = f"{number[name]}" + (f" (elements: {classes})" if classes > 1 else "")
            kinds_told = " + ".join(dict.fromkeys(kinds))
            rows.append(Treatment(name, kinds_told, why, plates, colour, cost.get(name, 0.0)))
        return rows

    def _given(self, name: str) -> str:
        """What is said of a node that no kernel moves."""
        seen = self.target.seen(name)
        if seen is None:
            return treatment(self.problem, name)
        return "observed" if seen.mask is None else "observed in part; the rest is drawn forward"

    def in_short(self) -> str:
        """How many nodes each kind of kernel moves."""
        kinds: dict[str, set[str]] = {}
        for kernel in self.kernels:
            for name in kernel.names:
                kinds.setdefault(kernel.words(name)[0], set()).add(name)
        return ", ".join(f"{kind} ({len(names)})" for kind, names in kinds.items())

    def _colours(self) -> dict[str, int]:
        """Colour of every chain node: those of one colour share no factor."""
        chain = self.target.chain
        place = {n: i for i, n in enumerate(chain)}
        edges = set()
        for term in self.target.terms.values():
            inside = self._entering(term.scope)
            edges |= {(place[a], place[b]) for a in inside for b in inside if place[a] < place[b]}
        found = colours(len(chain), np.array(sorted(edges), dtype=np.intp).reshape(-1, 2))
        return {chain[i]: c for c, members in enumerate(found, 1) for i in members}

    def _entering(self, scope: Sequence[str]) -> set[str]:
        """Chain nodes that reach a scope, through deterministic nodes as well."""
        found: set[str] = set()
        todo = list(scope)
        while todo:
            name = todo.pop()
            if name in self.blankets:
                found.add(name)
            elif name in self.target.links:
                todo += self.problem.model[name].parents
        return found
