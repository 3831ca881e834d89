"""Do the hand-written Gibbs samplers answer rightly? ``python -m benchmarks.floors.gibbs_check``

The discrete ones are held against the exact marginals of a reference file, the Ising ones against
exact lattice energies, the mixtures against each other. Errors come from independent runs: 20 of
each, so that a difference over its standard error follows Student's t with 19 degrees of freedom
(two runs: 38), which is beyond 6.5 with probability 3e-6 (1e-7); of the 180 or so compared, some
one is in fewer than 1 of 1,000 choices of the seeds, which are fixed.
"""

from __future__ import annotations

import gzip
import json
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks import models_gibbs
from benchmarks.floors import bif, gibbs_discrete, gibbs_ising, gibbs_mixture
from benchmarks.harness import data_folder, network

LIMIT, RUNS = 6.5, 20


def main() -> int:
    """Print the worst difference of each; 1 if any is beyond the limit, or a control is not."""
    worst = {
        "discrete, multiplied": discrete(gibbs_discrete.Multiplied),
        "discrete, tabulated": discrete(gibbs_discrete.Tabulated),
        "discrete, one table rolled (must fail)": -discrete(gibbs_discrete.Multiplied, wrong=True),
        "Ising, checkerboard": ising(_checkerboard, 0.4),
        "Ising, parity": ising(_parity, 0.4),
        "Ising, parity, coupling off by 2 % (must fail)": -ising(_parity, 0.408),
        "mixture": mixture(1.0),
        "mixture, points stretched by 5 % (must fail)": -mixture(1.05),
    }
    for name, z in worst.items():
        print(f"{name:48s} worst difference {abs(z):8.2f} standard errors")
    return int(any(z > LIMIT or -LIMIT < z < 0 for z in worst.values()))


def discrete(kind: Callable[..., Any], wrong: bool = False) -> float:
    """ALARM, the reference file's evidence on leaves: worst |z| over states of the hidden nodes."""
    path = data_folder() / "bn_discrete" / "refs" / "alarm.ref.json.gz"
    scenario = json.loads(gzip.decompress(path.read_bytes()))["scenarios"]["E1_quarter_of_leaves"]
    records = bif.read(network("alarm"))
    nodes, codes = bif.as_arrays(records), bif.codes(records, scenario["evidence"])
    if wrong:
        place = [name for name, *_ in nodes].index("KINKEDTUBE")
        name, card, parents, table = nodes[place]
        nodes[place] = (name, card, parents, np.roll(table, 1, axis=-1))
    found = []
    for seed in range(RUNS):
        sampler = kind(nodes, codes, 256, seed)
        sampler.run(256)
        sampler.counts.total[:] = 0.0
        sampler.run(256)
        found.append(np.concatenate(sampler.counts.marginals()))
    wanted = np.concatenate([np.array(scenario["marginals"][n]) for n in sampler.net.names])
    carried = wanted * (1.0 - wanted) > 1e-3  # rarer states are too skew for Student's t
    return _worst(np.array(found)[:, carried] - wanted[carried])


def ising(run: Callable[[float, int], float], coupling: float) -> float:
    """|z| of the mean energy of a 4 by 4 lattice against the exact one at a coupling of 0.4."""
    data = json.loads((data_folder() / "ising" / "ising.dev.ref.json").read_text())
    exact = data["lattice_exact"]["L4_J0.4"]["mean_sum_xixj"]
    return _worst(np.array([[run(coupling, seed) - exact] for seed in range(RUNS)]))


def mixture(stretch: float) -> float:
    """Worst |z| between the two samplers' means and spreads, components sorted by their first coordinate."""
    points = models_gibbs.mixture_points(400)
    found = []
    for kind, factor in ((gibbs_mixture.Plain, 1.0), (gibbs_mixture.Tuned, stretch)):
        runs = []
        for seed in range(RUNS):
            sampler = kind(points * factor, seed)
            sampler.run(200)
            means = sampler.run(600)
            order = np.argsort(means[:, :, 0].mean(axis=0))
            runs.append([means[:, order].mean(axis=0), means[:, order].std(axis=0)])
        found.append(np.array(runs).reshape(RUNS, -1))
    difference = found[0].mean(axis=0) - found[1].mean(axis=0)
    error = np.sqrt((found[0].var(axis=0, ddof=1) + found[1].var(axis=0, ddof=1)) / RUNS)
    return float(np.abs(difference / error).max())


def _worst(differences: np.ndarray) -> float:
    error = differences.std(axis=0, ddof=1) / np.sqrt(RUNS)
    return float(np.abs(differences.mean(axis=0) / error).max())


def _parity(coupling: float, seed: int) -> float:
    sampler = gibbs_ising.Parity(4, coupling, 0.0, seed)
    sampler.run(100)
    energies = []
    for _ in range(5_000):
        sampler.run(1)
        energies.append(_energy(sampler.spins()))
    return float(np.mean(energies))


def _checkerboard(coupling: float, seed: int) -> float:
    spins = np.ones((4, 4), int)
    energies = []
    for sweep in range(2_000):
        gibbs_ising.checkerboard(spins, coupling, 0.0, 1, 2_000 * seed + sweep)
        energies.append(_energy(spins))
    return float(np.mean(energies[100:]))


def _energy(spins: np.ndarray) -> int:
    wide = spins.astype(int)
    return int((wide[1:] * wide[:-1]).sum() + (wide[:, 1:] * wide[:, :-1]).sum())


if __name__ == "__main__":
    sys.exit(main())
