"""Factored beliefs on dense arrays, by definition: every joint state of a small template, listed."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

import bayesmc as bmc

Marginals = list[np.ndarray]


@dataclass(frozen=True)
class Coupled:
    """Nodes that read some of the slice before, and readings of one or two of them each.

    Attributes
    ----------
    cards : list of int
    parents, tables : list
        Of each node: positions of the nodes of the slice before, and its table.
    initial : list of ndarray
    seen, readings : list
        Of each reading: positions of the nodes of its slice, and its table.
    """

    cards: list[int]
    parents: list[list[int]]
    tables: list[np.ndarray]
    initial: list[np.ndarray]
    seen: list[list[int]]
    readings: list[np.ndarray]

    @property
    def dbn(self) -> bmc.DynamicBayesNet:
        dbn = bmc.DynamicBayesNet()
        for k, (above, table) in enumerate(zip(self.parents, self.tables, strict=True)):
            dbn.table(f"x{k}", [f"x{j}_prev" for j in above], table, initial=self.initial[k])
        for k, (above, table) in enumerate(zip(self.seen, self.readings, strict=True)):
            dbn.table(f"y{k}", [f"x{j}" for j in above], table)
        return dbn

    def rows(self, steps: int, rng: np.random.Generator, missing: float = 0.2) -> dict[str, Any]:
        """A series drawn from it; some of it is missing."""
        drawn = self.dbn.sample(steps, rng=rng)
        return {
            f"y{k}": np.ma.array(drawn[f"y{k}"][0], mask=rng.random(steps) < missing)
            for k in range(len(self.seen))
        }

    def transition(self) -> np.ndarray:
        """Shape (*cards before, *cards)."""
        found = np.zeros((*self.cards, *self.cards))
        states = list(itertools.product(*map(range, self.cards)))
        for before in states:
            for now in states:
                found[(*before, *now)] = np.prod([
                    table[(*(before[j] for j in above), now[k])]
                    for k, (above, table) in enumerate(zip(self.parents, self.tables, strict=True))
                ])  # fmt: skip
        return found

    def likelihood(self, rows: dict[str, Any], t: int) -> np.ndarray:
        """Shape (*cards,)."""
        found = np.ones(self.cards)
        for k, (above, table) in enumerate(zip(self.seen, self.readings, strict=True)):
            value = rows[f"y{k}"][t]
            if value is np.ma.masked:
                continue
            for state in itertools.product(*map(range, self.cards)):
                found[state] *= table[(*(state[j] for j in above), int(value))]
        return found


def coupled(rng: np.random.Generator, nodes: int = 4, sparse: float = 1.0) -> Coupled:
    """Each node reads itself and its neighbours; the last reading is of two nodes."""
    cards = [int(rng.integers(2, 4)) for _ in range(nodes)]
    parents = [[j for j in (k - 1, k, k + 1) if 0 <= j < nodes] for k in range(nodes)]
    tables = [
        rng.dirichlet(np.full(cards[k], sparse), size=[cards[j] for j in above])
        for k, above in enumerate(parents)
    ]
    initial = [rng.dirichlet(np.ones(n)) for n in cards]
    seen = [[0], [nodes - 1], [1, 2]]
    readings = [rng.dirichlet(np.ones(3), size=[cards[j] for j in above]) for above in seen]
    return Coupled(cards, parents, tables, initial, seen, readings)


def margin(joint: np.ndarray, kept: Any) -> np.ndarray:
    """The marginal of some axes, in their order, with axes of size one for the others."""
    return joint.sum(axis=tuple(k for k in range(joint.ndim) if k not in kept), keepdims=True)


def product(joint: np.ndarray, clusters: list[list[int]]) -> np.ndarray:
    """The product of the marginals of clusters over those of what each shares with the ones before it."""
    found, before = np.ones(()), set()
    for cluster in clusters:
        found = found * margin(joint, cluster)
        shared = before & set(cluster)
        if shared:
            below = margin(joint, shared)
            found = found * np.divide(1.0, below, out=np.zeros_like(below), where=below > 0)
        before |= set(cluster)
    return np.broadcast_to(found, joint.shape)


def boyen_koller(
    model: Coupled, rows: dict[str, Any], clusters: list[list[int]]
) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
    """Increments; joint tables of every slice before they are projected, filtered and smoothed."""
    steps, move = len(rows["y0"]), model.transition()
    nodes = len(model.cards)
    before, found, increments = [], [], []
    belief = None
    for t in range(steps):
        if belief is None:
            joint = np.ones(())
            for p in model.initial:
                joint = np.multiply.outer(joint, p)
        else:
            joint = np.tensordot(belief, move, nodes)
        joint = joint * model.likelihood(rows, t)
        increments.append(np.log(joint.sum()))
        found.append(joint / joint.sum())
        before.append(belief)
        belief = product(found[-1], clusters)
    later, smoothed = found[-1], [np.empty(0)] * steps
    for t in range(steps - 1, -1, -1):
        now = product(found[t], clusters)
        ratio = np.divide(product(later, clusters), now, out=np.zeros_like(now), where=now > 0)
        weighted = model.likelihood(rows, t) * ratio
        if before[t] is None:
            joint = found[t] * ratio
        else:
            both = before[t].reshape(*model.cards, *[1] * nodes) * move * weighted
            joint = both.sum(axis=tuple(range(nodes)))
            later = both.sum(axis=tuple(range(nodes, 2 * nodes)))
            later = later / later.sum()
        smoothed[t] = joint / joint.sum()
    return np.array(increments), found, smoothed


def factored_frontier(
    model: Coupled, rows: dict[str, Any]
) -> tuple[np.ndarray, list[Marginals], list[Marginals]]:
    """Increments; probabilities of each node in every slice, filtered and smoothed."""
    steps, count = len(rows["y0"]), len(model.cards)
    predicted: list[Marginals] = []
    found: list[Marginals] = []
    increments = []
    for t in range(steps):
        if t == 0:
            now = [p.copy() for p in model.initial]
        else:
            now = [
                weighted(table, [found[-1][j] for j in above])
                for above, table in zip(model.parents, model.tables, strict=True)
            ]
        predicted.append(list(now))
        total = 0.0
        for k, (above, table) in enumerate(zip(model.seen, model.readings, strict=True)):
            value = rows[f"y{k}"][t]
            if value is np.ma.masked:
                continue
            joint = table[..., int(value)]
            for axis, j in enumerate(above):
                joint = joint * now[j].reshape([-1 if a == axis else 1 for a in range(len(above))])
            total += np.log(joint.sum())
            for axis, j in enumerate(above):
                now[j] = margin(joint, [axis]).reshape(-1) / joint.sum()
        increments.append(total)
        found.append(now)
    smoothed = [list(m) for m in found]
    for t in range(steps - 1, 0, -1):
        for k, (above, table) in enumerate(zip(model.parents, model.tables, strict=True)):
            says = smoothed[t][k] / predicted[t][k]
            for axis, j in enumerate(above):
                others = [
                    np.ones(model.cards[i]) if a == axis else found[t - 1][i]
                    for a, i in enumerate(above)
                ]
                message = table @ says
                for a, other in enumerate(others):
                    message = message * other.reshape(
                        [-1 if b == a else 1 for b in range(len(above))]
                    )
                smoothed[t - 1][j] = smoothed[t - 1][j] * margin(message, [axis]).reshape(-1)
        smoothed[t - 1] = [p / p.sum() for p in smoothed[t - 1]]
    assert count == len(smoothed[0])
    return np.array(increments), found, smoothed


def weighted(table: np.ndarray, given: Marginals) -> np.ndarray:
    """A table summed over its parents, each with probabilities of its own."""
    for p in given:
        table = np.tensordot(p, table, (0, 0))
    return table
