"""Finite Markov chains analysed: what Markov chain Monte Carlo rests on, on a handful of states.

A chain of three states settles at one law from every start; a chain of four does not, because it is
reducible: it has two stationary laws, and between two of its states it swings for ever. Detailed
balance is a recipe for a chain with a wanted law: Metropolis' rule builds one for the law of the first
chain, which itself settles at that law without being balanced. A last chain climbs between two hills
by short steps, as a random walk does on a bimodal density; its eigenvalue gap bounds its mixing time
from below and from above.

The chain of three states is the one of Andrieu, de Freitas, Doucet and Jordan, An introduction to
MCMC for machine learning, Machine Learning 50, 2003, section 3.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from bayesmc.markov import MarkovChain, total_variation
from examples import picture

THREE = MarkovChain([[0.0, 1.0, 0.0], [0.0, 0.1, 0.9], [0.6, 0.4, 0.0]], states=(1, 2, 3))
REDUCIBLE = MarkovChain(
    [[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.3, 0.3, 0.4], [0.0, 0.0, 0.0, 1.0]],
    states=(1, 2, 3, 4),
)
HILLS = np.exp(-0.5 * ((np.abs(np.arange(-6, 7)) - 4.0) / 1.6) ** 2)
EPS = 0.01
STEPS = 1500


def metropolis(weights: np.ndarray, proposal: np.ndarray) -> np.ndarray:
    """Metropolis' transition matrix for a symmetric proposal: accept with min(1, p_j / p_i)."""
    moves = proposal * np.minimum(1.0, weights / weights[:, None])
    np.fill_diagonal(moves, 0.0)
    return moves + np.diag(1.0 - moves.sum(axis=1))


def neighbours(size: int) -> np.ndarray:
    """One step to the left or to the right, each with probability a half; nowhere at the ends."""
    return 0.5 * (np.eye(size, k=1) + np.eye(size, k=-1))


BALANCED = MarkovChain(metropolis(THREE.stationary[0], np.full((3, 3), 1 / 3)), states=(1, 2, 3))
CLIMBER = MarkovChain(metropolis(HILLS, neighbours(len(HILLS))), states=range(-6, 7))

CHAINS = {
    "three states": THREE,
    "Metropolis, same law": BALANCED,
    "reducible": REDUCIBLE,
    "two hills": CLIMBER,
}


def distances(chain: MarkovChain, steps: int) -> np.ndarray:
    """Total variation from the stationary law after 0, 1, ... steps, from the worst start."""
    laws, found = np.eye(len(chain.states)), []
    for _ in range(steps + 1):
        found.append(total_variation(laws, chain.stationary[0]).max())
        laws = chain.step(laws)
    return np.array(found)


def report(name: str, chain: MarkovChain) -> None:
    """Print what the theory says of a chain."""
    print(f"  {name}: {chain!r}")
    for law in chain.stationary:
        print(f"    stationary law    {' '.join(f'{p:.3f}' for p in law)}")
    balance = chain.detailed_balance()
    verdict = "holds"
    if not balance:
        (i, j), (there, back) = balance.states, balance.flows
        verdict = f"fails most from {i} to {j}: {there:.3f} there, {back:.3f} back"
    print(f"    detailed balance  {verdict}")
    if not chain.is_ergodic:
        return
    print(f"    eigenvalue gap    {chain.spectral_gap:.4f}, so {chain.relaxation_time:.1f} steps "
          "to relax")  # fmt: skip
    bounds = ""
    if balance:
        lower, upper = chain.mixing_time_bounds(EPS)
        bounds = f"; the gap bounds them by {lower:.1f} and {upper}"
    print(f"    steps to mix      {chain.mixing_time(EPS)} to within {EPS}{bounds}")


def draw() -> Any:
    """Above two transition diagrams, below the distance from the stationary law."""
    figure, panels = picture.axes([["three", "reducible"], ["small", "hills"]], (11, 8.4))
    _diagram(panels["three"], THREE, {1: (-1, 0), 2: (0.3, 0.9), 3: (0.3, -0.9)})
    panels["three"].set_title("three states: one stationary law")
    _diagram(panels["reducible"], REDUCIBLE, {1: (-1, 0.8), 2: (-1, -0.8), 3: (0, 0), 4: (1, 0)})
    panels["reducible"].set_title("reducible: a law on {1, 2}, another on {4}")
    ax = panels["small"]
    for name, colour in (("three states", picture.OTHER), ("Metropolis, same law", picture.DRAWS)):
        ax.semilogy(distances(CHAINS[name], 25), ".-", color=colour, label=name)
    swinging = MarkovChain(REDUCIBLE.transition[:2, :2])
    ax.semilogy(
        distances(swinging, 25), ".-", color=picture.FAINT, label="reducible, on {1, 2} alone"
    )
    ax.set(title="from the worst start", ylim=(1e-8, 2))
    ax.legend(frameon=False, loc="lower right")
    ax = panels["hills"]
    ax.semilogy(distances(CLIMBER, STEPS), color=picture.EXACT, label="two hills")
    lower, upper = CLIMBER.mixing_time_bounds(EPS)
    ax.axvspan(lower, upper, color=picture.DRAWS, alpha=0.3, lw=0, label="bounds by the gap")
    mixed = CLIMBER.mixing_time(EPS)
    ax.plot([mixed], [EPS], "o", color=picture.OTHER, label=f"within {EPS} after {mixed} steps")
    ax.set(title="a random walk between two hills")
    ax.legend(frameon=False, loc="lower left")
    for name in ("small", "hills"):
        panels[name].set(xlabel="steps", ylabel="total variation distance")
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the analysis of every chain and a simulation of the first, and draw them."""
    options = picture.options(__doc__, arguments)
    print("Finite Markov chains, analysed as matrices")
    for name, chain in CHAINS.items():
        report(name, chain)
    steps = 10_000 if options.fast else 1_000_000
    visits = np.bincount(THREE.simulate(1, steps, rng=4)[1:], minlength=3) / steps
    print(f"  three states, {steps:,} simulated steps: visited "
          f"{' '.join(f'{share:.3f}' for share in visits)}")  # fmt: skip
    picture.save(draw(), options.out, "markov_chains")


def _diagram(ax: Any, chain: MarkovChain, places: dict[int, tuple[float, float]]) -> None:
    import networkx as nx

    graph = chain.graph()
    recurrent = nx.get_node_attributes(graph, "recurrent")
    colours = [picture.DRAWS if recurrent[state] else picture.FAINT for state in graph]
    nx.draw_networkx_nodes(graph, places, node_color=colours, node_size=1100, ax=ax)
    nx.draw_networkx_labels(graph, places, ax=ax)
    loops = [(i, j) for i, j in graph.edges if i == j]
    for state, _ in loops:  # drawn here: networkx hides short loops behind large nodes
        x, y = places[state]
        ends = [(x + side * 0.09, y + 0.15) for side in (-1, 1)]
        loop = {"arrowstyle": "-|>", "connectionstyle": "arc3,rad=-1.6", "color": "black"}
        ax.annotate("", ends[1], ends[0], arrowprops={**loop, "mutation_scale": 16})
        ax.text(x, y + 0.42, f"{graph.edges[state, state]['weight']:g}", ha="center")
    graph.remove_edges_from(loops)
    options: dict[str, Any] = {"connectionstyle": "arc3,rad=0.18", "ax": ax}
    nx.draw_networkx_edges(graph, places, node_size=1100, arrowsize=16, **options)
    weights = {(i, j): f"{w:g}" for i, j, w in graph.edges(data="weight")}
    nx.draw_networkx_edge_labels(graph, places, weights, rotate=False, **options)
    ax.set(xlim=(-1.4, 1.4), ylim=(-1.3, 1.5))
    ax.axis("off")


if __name__ == "__main__":
    main()
