"""Likelihood weighting by pgmpy and by pyAgrum: all marginals of a BIF network.

Each peer is used as its documentation shows, with its own reader, and prepared once; a call samples
and computes every marginal. Runs in the peers' environment and imports nothing of bayesmc::

    python benchmarks/peers/lw.py pyagrum alarm.bif.gz HRBP=HIGH CVP=NORMAL --draws 100000
"""

from __future__ import annotations

import argparse
import gzip
import json
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

Marginals = dict[str, dict[str, float]]
Run = Callable[[dict[str, str]], Marginals]


def pgmpy(path: str, draws: int) -> Run:
    """``BayesianModelSampling.likelihood_weighted_sample``, then a weighted count per column."""
    warnings.simplefilter("ignore")  # pgmpy deprecates parts of itself on import
    from pgmpy.factors.discrete import State
    from pgmpy.readwrite import BIFReader
    from pgmpy.sampling import BayesianModelSampling

    with plain_file(path) as name:
        sampling = BayesianModelSampling(BIFReader(name).get_model())

    def run(evidence: dict[str, str]) -> Marginals:
        states = [State(name, label) for name, label in evidence.items()]
        frame = sampling.likelihood_weighted_sample(states, size=draws, show_progress=False)
        total = frame["_weight"].sum()
        return {
            name: (frame.groupby(name)["_weight"].sum() / total).to_dict()
            for name in frame.columns
            if name != "_weight"
        }

    return run


def pyagrum(path: str, draws: int) -> Run:
    """``WeightedSampling`` stopped by its number of iterations alone."""
    import pyagrum as gum

    with plain_file(path) as name:
        net = gum.loadBN(name)

    def run(evidence: dict[str, str]) -> Marginals:
        engine = gum.WeightedSampling(net)
        engine.setEpsilon(1e-300)
        engine.setMinEpsilonRate(1e-300)
        engine.setMaxTime(1e6)
        engine.setMaxIter(draws)
        engine.setPeriodSize(draws)  # convergence is looked at once
        engine.setEvidence(evidence)
        engine.makeInference()
        if engine.nbrIterations() != draws:
            raise RuntimeError(f"pyAgrum made {engine.nbrIterations()} draws instead of {draws}")
        return agrum_marginals(net, engine)

    return run


def agrum_marginals(net: Any, engine: Any) -> Marginals:
    """Every posterior of a pyAgrum engine, by node and state label."""
    return {
        name: dict(zip(net.variable(name).labels(), engine.posterior(name).tolist(), strict=True))
        for name in net.names()
    }


class plain_file:  # noqa: N801
    """A context that gives the path of an unpacked copy where ``path`` ends in ``.gz``."""

    def __init__(self, path: str) -> None:
        self.path, self.folder = path, tempfile.TemporaryDirectory()

    def __enter__(self) -> str:
        if not self.path.endswith(".gz"):
            return self.path
        copy = Path(self.folder.name) / "network.bif"
        copy.write_bytes(gzip.decompress(Path(self.path).read_bytes()))
        return str(copy)

    def __exit__(self, *error: object) -> None:
        self.folder.cleanup()


def main() -> None:
    """Time one peer in a run of its own and print JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("peer", choices=["pgmpy", "pyagrum"])
    parser.add_argument("network")
    parser.add_argument("evidence", nargs="*", metavar="NODE=STATE")
    parser.add_argument("--draws", type=int, default=100_000)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    run = {"pgmpy": pgmpy, "pyagrum": pyagrum}[options.peer](options.network, options.draws)
    evidence = dict(pair.split("=", 1) for pair in options.evidence)
    seconds = []
    for _ in range(options.repeats):
        start = time.perf_counter()
        run(evidence)
        seconds.append(time.perf_counter() - start)
    print(json.dumps({"peer": options.peer, "draws": options.draws, "seconds": seconds}))


if __name__ == "__main__":
    main()
