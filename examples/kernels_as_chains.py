"""Our own kernels as finite Markov chains: the transition matrix of a sweep, read from the code that draws.

The grass is wet: was it the sprinkler, or rain? Three nodes are hidden, each with two states, so that one
sweep of a sampler is a matrix of eight rows. ``testing.exact_sweep`` finds it by running the kernels' own
steps on draws that it sets, without a second formula; ``markov`` says the rest. Every update is in detailed
balance with the posterior, one sweep through all of them is not, and keeps it all the same. Where a table
forbids what lies between two states, updates of one node at a time are a reducible chain with two
stationary laws; Gibbs draws the two nodes together.

Pearl, Probabilistic Reasoning in Intelligent Systems, 1988 (the net, in the form of Russell and Norvig);
Levin, Peres and Wilmer, Markov Chains and Mixing Times, 2017, chapters 1, 4 and 12.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc import testing
from bayesmc.errors import ConvergenceWarning
from bayesmc.markov import MarkovChain, total_variation
from examples import picture

HIDDEN = ("cloudy", "sprinkler", "rain")
WET = {"wet": "yes"}
STATES = ("no", "yes")
ENGINES = {"Gibbs": bmc.Gibbs, "Metropolis-Hastings": bmc.MetropolisHastings}
EPS = 0.01
LONGEST = 60


def wet_grass() -> bmc.BayesNet:
    """Clouds bring rain and keep the sprinkler off; either wets the grass."""
    net = bmc.BayesNet("wet grass")
    net.table("cloudy", [], [0.5, 0.5], states=STATES)
    net.table("sprinkler", ["cloudy"], [[0.5, 0.5], [0.9, 0.1]], states=STATES)
    net.table("rain", ["cloudy"], [[0.8, 0.2], [0.2, 0.8]], states=STATES)
    wet = np.array([[0.01, 0.90], [0.90, 0.99]])  # sprinkler, rain
    net.table("wet", ["sprinkler", "rain"], np.stack([1 - wet, wet], axis=-1), states=STATES)
    return net


def two_switches() -> bmc.BayesNet:
    """A lamp that is on if two switches agree, as at both ends of a stairway."""
    net = bmc.BayesNet("two switches")
    net.add("below", bmc.Bernoulli(0.3))
    net.add("above", bmc.Bernoulli(0.5))
    net.add("lamp", lambda below, above: bmc.Bernoulli(1.0 * (below == above)))
    return net


def posterior_law() -> np.ndarray:
    """The exact joint posterior of the hidden nodes, by elimination, in the order of the states."""
    return bmc.infer(wet_grass(), WET, engine=bmc.Exact()).probabilities(*HIDDEN).ravel()


def simulated(engine: Any, sweep: testing.Sweep, steps: int) -> np.ndarray:
    """Counts of the steps from state to state of 500 chains that an engine ran, shape (states, states)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # there are few draws for a smoke test
        ran = engine(draws=steps // 500 + 1, warmup=0, chains=500)
        posterior = bmc.infer(wet_grass(), WET, engine=ran, rng=1)
    place = {state: k for k, state in enumerate(sweep.states)}
    bits = np.stack([posterior[name] == "yes" for name in sweep.elements]).astype(int)
    number = np.zeros((2,) * len(HIDDEN), dtype=int)
    for code in np.ndindex(number.shape):
        number[code] = place[tuple(STATES[k] for k in code)]
    at = number[tuple(bits)]
    counts = np.zeros((len(place),) * 2, dtype=int)
    np.add.at(counts, (at[:, :-1], at[:, 1:]), 1)
    return counts


def distances(matrix: np.ndarray, law: np.ndarray, steps: int = LONGEST) -> np.ndarray:
    """Total variation from the posterior after 0, 1, ... sweeps, from the worst start."""
    chain, laws, found = MarkovChain(matrix), np.eye(len(law)), []
    for _ in range(steps + 1):
        found.append(total_variation(laws, law).max())
        laws = chain.step(laws)
    return np.array(found)


def in_random_order(sweep: testing.Sweep) -> MarkovChain:
    """The chain of single updates, each chosen at random: reversible, as no order is preferred.

    It is averaged with its own reverse, which evens out that random numbers have a last digit.
    """
    matrix = np.mean([update.matrix for update in sweep.updates], axis=0)
    law = MarkovChain(matrix).stationary[0]
    return MarkovChain(0.5 * (matrix + matrix.T * law / law[:, None]))


def report(name: str, sweep: testing.Sweep, law: np.ndarray, counts: np.ndarray) -> None:
    """What the theory says of an engine's matrices, and whether a simulation agrees."""
    chain = MarkovChain(sweep.matrix, sweep.states)
    print(f"  {name}: {chain!r}")
    off = np.abs(chain.stationary[0] - law).max()
    print(f"    stationary law    {_numbers(chain.stationary[0])}")
    print(f"    off the posterior by {off:.0e}; random numbers are {sweep.resolution:.0e} apart")
    for update in sweep.updates:
        what = f"{', '.join(update.names)} ({update.label})"
        print(f"    detailed balance  {_balance(update.matrix, sweep, law)}: {what}")
    print(f"    detailed balance  {_balance(sweep.matrix, sweep, law)}: the sweep")
    print(f"    eigenvalue gap    {chain.spectral_gap:.4f}; {chain.mixing_time(EPS)} sweeps to within "
          f"{EPS} of the posterior from the worst start")  # fmt: skip
    random = in_random_order(sweep)
    lower, upper = random.mixing_time_bounds(EPS)
    print(f"    in random order   {random.mixing_time(EPS)} updates; the gap {random.spectral_gap:.4f} "
          f"bounds them by {lower:.1f} and {upper}")  # fmt: skip
    p = testing.transition_p_value(sweep.matrix, counts)
    visited = counts.sum(axis=0) / counts.sum()
    print(f"    {counts.sum():,} simulated steps visited {_numbers(visited)}; p-value {p:.2f}")


def report_reducible() -> None:
    """Two switches and a lamp: one at a time, and together."""
    evidence = {"lamp": 1}
    apart = bmc.MetropolisHastings(proposal={"below": "prior", "above": "prior"})
    for name, engine in (("one at a time", apart), ("by Gibbs, as one block", bmc.Gibbs())):
        sweep = testing.exact_sweep(two_switches(), evidence, engine)
        chain = MarkovChain(sweep.matrix, sweep.states)
        laws = " and ".join(_numbers(law) for law in chain.stationary)
        print(f"  two switches that agree, {name}: {chain!r}")
        print(f"    stationary        {laws}; posterior {_numbers(sweep.law)}")


def draw(sweeps: dict[str, testing.Sweep], counts: dict[str, np.ndarray], law: np.ndarray) -> Any:
    """The matrices of both sweeps, the distance from the posterior, and what a simulation visited."""
    figure, panels = picture.axes([["Gibbs", "Metropolis-Hastings"], ["far", "law"]], (10.5, 9))
    first = next(iter(sweeps.values()))
    labels = ["".join("+" if s == "yes" else "-" for s in state) for state in first.states]
    colours = dict(zip(sweeps, (picture.DRAWS, picture.OTHER), strict=True))
    for name, sweep in sweeps.items():
        ax = panels[name]
        shown = ax.imshow(sweep.matrix, cmap="Blues", vmin=0)
        ticks = range(len(labels))
        ax.set(xticks=ticks, yticks=ticks, xlabel="to", ylabel="from", title=f"{name}: one sweep")
        ax.set_xticklabels(labels)
        ax.set_yticklabels(labels)
        figure.colorbar(shown, ax=ax, shrink=0.8)
        far = distances(sweep.matrix, law)
        panels["far"].semilogy(far, ".-", ms=4, color=colours[name], label=name)
    panels["far"].axhline(EPS, color=picture.FAINT, ls=":", lw=1)
    panels["far"].set(
        title="from the worst start",
        xlabel="sweeps",
        ylabel="total variation distance",
        ylim=(1e-8, 2),
    )
    panels["far"].legend(frameon=False)
    ax, place = panels["law"], np.arange(len(law))
    ax.bar(place, law, 0.8, color=picture.FAINT, alpha=0.5, label="posterior")
    for shift, (name, found) in zip((-0.2, 0.2), counts.items(), strict=True):
        visited = found.sum(axis=0) / found.sum()
        ax.plot(place + shift, visited, "o", ms=5, color=colours[name], label=f"{name}, visited")
    ax.set(title=", ".join(HIDDEN) + ", given wet grass", ylabel="probability", xticks=place)
    ax.set_xticklabels(labels)
    ax.legend(frameon=False, loc="upper left", fontsize=8)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the analysis of both engines' matrices, and draw them."""
    options = picture.options(__doc__, arguments)
    steps = 10_000 if options.fast else 1_000_000
    law = posterior_law()
    print(f"The kernels as Markov chains: {', '.join(HIDDEN)} given wet grass")
    print(f"  posterior           {_numbers(law)}")
    sweeps = {name: testing.exact_sweep(wet_grass(), WET, make()) for name, make in ENGINES.items()}
    counts = {name: simulated(ENGINES[name], sweep, steps) for name, sweep in sweeps.items()}
    for name, sweep in sweeps.items():
        report(name, sweep, law, counts[name])
    report_reducible()
    picture.save(draw(sweeps, counts, law), options.out, "kernels_as_chains")


def _balance(matrix: np.ndarray, sweep: testing.Sweep, law: np.ndarray) -> str:
    # a hundred times what the coarsest random numbers can be off
    balance = MarkovChain(matrix, sweep.states).detailed_balance(
        law, 100 * max(sweep.resolution, 1e-14)
    )
    return "holds" if balance else f"fails by {balance.violation:.2g}"


def _numbers(law: np.ndarray) -> str:
    return " ".join(f"{p:.3f}" for p in law)


if __name__ == "__main__":
    main()
