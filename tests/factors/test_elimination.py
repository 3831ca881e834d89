"""Elimination orders and the cliques they make."""

from __future__ import annotations

import itertools

import networkx as nx
import numpy as np
import pytest

from bayesmc.factors import HEURISTICS, elimination_order
from bayesmc.factors.structure import build_cliques


def random_scopes(seed, count, edges):
    rng = np.random.default_rng(seed)
    return [tuple(rng.choice(count, size=2, replace=False).tolist()) for _ in range(edges)]


def replayed(order, scopes):
    """Cliques and fill edges of an order, by the definition."""
    neighbours = {v: set() for v in order}
    for scope in scopes:
        for a, b in itertools.permutations(scope, 2):
            neighbours[a].add(b)
    cliques, fill = [], 0
    for v in order:
        around = neighbours.pop(v)
        cliques.append({v, *around})
        for a, b in itertools.combinations(around, 2):
            fill += b not in neighbours[a]
            neighbours[a].add(b)
            neighbours[b].add(a)
        for a in around:
            neighbours[a].discard(v)
    return cliques, fill


@pytest.mark.parametrize("heuristic", [*HEURISTICS, None])
def test_reported_cliques_fill_and_entries_are_those_of_the_order(heuristic):
    for seed in range(40):
        rng = np.random.default_rng(seed)
        count = int(rng.integers(1, 14))
        cards = rng.integers(1, 5, size=count).tolist()
        scopes = random_scopes(seed, count, int(rng.integers(0, 2 * count))) if count > 1 else []
        found = elimination_order(cards, scopes, heuristic)
        assert sorted(found.order) == list(range(count))
        cliques, fill = replayed(found.order, scopes)
        assert [set(c) for c in found.cliques] == cliques
        assert found.fill == fill
        entries = sum(np.prod([cards[v] for v in clique]) for clique in cliques)
        assert found.entries == pytest.approx(entries)


def test_each_step_of_min_fill_adds_the_fewest_edges():
    """The counts kept up to date must equal counts made anew at every step."""
    for seed in range(30):
        scopes = random_scopes(seed, 12, 20)
        graph = nx.Graph(scopes)
        graph.add_nodes_from(range(12))
        for v in elimination_order([2] * 12, scopes, "min-fill").order:
            fill = {u: missing_edges(graph, u) for u in graph}
            assert fill[v] == min(fill.values())
            graph.add_edges_from(itertools.combinations(list(graph[v]), 2))
            graph.remove_node(v)


def missing_edges(graph, v):
    return sum(not graph.has_edge(a, b) for a, b in itertools.combinations(graph[v], 2))


def test_chordal_graphs_need_no_fill():
    for seed in range(20):
        graph = nx.gnp_random_graph(14, 0.25, seed=seed)
        chordal, _ = nx.complete_to_chordal_graph(graph)
        found = elimination_order([2] * 14, list(chordal.edges), "min-fill")
        assert found.fill == 0


def test_known_fill_of_cycles():
    for length in range(4, 12):
        scopes = [(i, (i + 1) % length) for i in range(length)]
        assert elimination_order([2] * length, scopes).fill == length - 3


def test_min_weight_prefers_small_tables():
    scopes = [("abcd".index(a), "abcd".index(b)) for a, b in ("ab", "bc", "cd", "da")]
    found = elimination_order([100, 2, 100, 2], scopes, "min-weight")
    assert {0, 2} not in [set(c) for c in found.cliques]
    assert max(np.prod([[100, 2, 100, 2][v] for v in c]) for c in found.cliques) == 400


def test_cliques_of_the_tree_are_the_maximal_cliques_and_run_together():
    for seed in range(40):
        scopes = random_scopes(seed, 10, 14)
        found = elimination_order([2] * 10, scopes)
        cliques = build_cliques(found)
        filled = nx.Graph()
        filled.add_nodes_from(range(10))
        for clique in found.cliques:
            filled.add_edges_from(itertools.combinations(clique, 2))
        maximal = {frozenset(c) for c in nx.find_cliques(filled)}
        assert {frozenset(c.variables) for c in cliques} == maximal
        assert len(cliques) == len(maximal)
        for v in range(10):  # running intersection: each variable's cliques form one subtree
            holding = {k for k, c in enumerate(cliques) if v in c.variables}
            tops = [k for k in holding if cliques[k].parent not in holding]
            assert len(tops) == 1 and v in cliques[tops[0]].residual
        for k, clique in enumerate(cliques):
            assert clique.parent < k
            if clique.parent >= 0:
                shared = set(clique.variables) & set(cliques[clique.parent].variables)
                assert set(clique.separator) == shared


def test_unknown_heuristic():
    with pytest.raises(ValueError, match="unknown heuristic 'best'; choose one of"):
        elimination_order([2], [], "best")
