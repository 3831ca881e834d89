"""Exact inference by pyAgrum's LazyPropagation: all marginals, new evidence, net prepared once.

Runs in the peers' environment and imports nothing of bayesmc. From the command line it times the
scenarios of reference files, which are asked in turn so that every call has new evidence nodes, and
prints JSON::

    python benchmarks/peers/exact.py alarm.bif.gz alarm.ref.json.gz --repeats 20
"""

from __future__ import annotations

import argparse
import gzip
import json
import statistics
import time
from pathlib import Path

from lw import Marginals, Run, agrum_marginals, plain_file


def pyagrum(path: str, draws: int = 0) -> Run:
    """A lazy propagation that keeps its net; a call replaces all evidence. ``draws`` is unused."""
    import pyagrum as gum

    with plain_file(path) as name:
        net = gum.loadBN(name)
    engine = gum.LazyPropagation(net)

    def run(evidence: dict[str, str]) -> Marginals:
        engine.eraseAllEvidence()
        engine.setEvidence(evidence)
        engine.makeInference()
        return agrum_marginals(net, engine)

    return run


def main() -> None:
    """Median milliseconds over the scenarios of one or more networks."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="+", metavar="NETWORK REFERENCE")
    parser.add_argument("--repeats", type=int, default=9)
    options = parser.parse_args()
    medians = {}
    for network, reference in zip(options.files[::2], options.files[1::2], strict=True):
        scenarios = json.loads(gzip.decompress(Path(reference).read_bytes()))["scenarios"]
        scenarios.pop("prior", None)
        run, seconds = pyagrum(network), []
        for _ in range(options.repeats):
            for scenario in scenarios.values():
                start = time.perf_counter()
                run(scenario["evidence"])
                seconds.append(time.perf_counter() - start)
        medians[Path(network).name.split(".")[0]] = 1e3 * statistics.median(seconds)
    print(json.dumps({"peer": "pyagrum LazyPropagation", "milliseconds": medians}))


if __name__ == "__main__":
    main()
