"""Exact marginals with new evidence, the net prepared once, beside pyAgrum's LazyPropagation."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from itertools import cycle
from typing import Any

import bayesmc as bmc
from benchmarks.harness import Peer, SelfTimed, interleave, network, peer_python, scenarios, table

NETWORKS = ("alarm", "hepar2", "pigs", "mildew")
GOALS = {"alarm": 2.0, "hepar2": 2.0}


def main() -> None:
    """Print medians over the networks' evidence scenarios; every call answers all marginals."""
    rows: list[list[object]] = []
    for name in NETWORKS:
        net, evidence = bmc.io.read(network(name)), scenarios(name)
        entries: dict[str, Any] = {"bayesmc": _ours(net, evidence)}
        with ExitStack() as stack:
            if peer_python() is not None:
                peer = stack.enter_context(Peer("exact-pyagrum", network(name), 0))
                entries["pyAgrum"] = _in_turn(peer, evidence)
            times = interleave(entries, repeats=15, budget=10.0)
        own = times["bayesmc"].median
        theirs = times["pyAgrum"].median if "pyAgrum" in times else None
        ratio: object = theirs / own if theirs else ""
        rows.append([name, 1e3 * own, 1e3 * theirs if theirs else "", ratio, GOALS.get(name, "")])
    header = ["all marginals, new evidence", "bayesmc, ms", "pyAgrum, ms", "pyAgrum / it", "goal"]
    print(table("exact inference, infer(...) and every probabilities(...)", header, rows) + "\n")


def _ours(net: Any, evidence: list[dict[str, str]]) -> Callable[[], object]:
    turn = cycle(evidence)
    names = list(net)

    def ask() -> object:
        posterior = bmc.infer(net, next(turn), engine=bmc.Exact())
        return [posterior.probabilities(name) for name in names]

    return ask


def _in_turn(peer: Peer, evidence: list[dict[str, str]]) -> SelfTimed:
    turn = cycle(evidence)
    return SelfTimed(lambda: peer.seconds(next(turn)))


if __name__ == "__main__":
    main()
