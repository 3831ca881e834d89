"""ALARM's tables from cases with entries missing, beside pyAgrum's EM: the same start, the same iterates.

What EM ends at follows from where it starts, iterate by iterate. Both begin with the tables of the net,
without a prior, and pyAgrum without the noise that it adds by itself; where their iterates are the same, so
are their ends, and how many plain iterations lead there can be counted without waiting for the peer.

pyAgrum watches the expected log likelihood of completed cases in place of the log likelihood, and ends where
that falls or rests, which may be before an optimum.
"""

from __future__ import annotations

import gzip
import tempfile
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.learning.cases import MISSING, Cases
from benchmarks.harness import network, peer_answer, table

GAPS, COUNTS = 0.2, (300, 1_000, 3_000, 10_000)
#: iterations of the peer's that are compared; nats that count as equal; iterations of ours at most
COMPARED, NEAR, MOST = 5, 1e-3, 3_000
#: cases whose probability is asked of three ways to work it out
CHECKED = 300
#: the least change of what the peer watches at which it goes on, and its seconds at most
DIFFERENCE, PATIENCE = 5e-3, 2_400.0

Tables = Mapping[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Question:
    """Cases of a net of tables, for both."""

    net: bmc.BayesNet
    columns: Mapping[str, list[str | None]]
    cases: Cases

    def step(self, tables: Tables) -> tuple[float, dict[str, np.ndarray]]:
        """The log likelihood of tables, and what one plain iteration of EM makes of them."""
        log_likelihood, counts = self.cases.expected(tables)
        ahead = {}
        for name, count in counts.items():
            total = count.sum(axis=-1, keepdims=True)
            ahead[name] = np.where(total > 0, count / np.where(total > 0, total, 1.0), tables[name])
        return log_likelihood, ahead


def question(count: int) -> Question:
    """Cases drawn from ALARM, of whose entries a fifth is left out; fewer are the first of more."""
    net = bmc.io.read(network("alarm"))
    drawn, rng = net.sample(COUNTS[-1], rng=1), np.random.default_rng(2)
    columns, codes, cards = {}, [], []
    for name in net:
        values = np.asarray(drawn[name].labels, dtype=object)
        values[rng.random(COUNTS[-1]) < GAPS] = None
        columns[name] = values[:count].tolist()
        states = net.declarations[name].states
        at = {state: k for k, state in enumerate(states)} | {None: MISSING}
        codes.append([at[value] for value in columns[name]])
        cards.append(len(states))
    parents = {n: d.parents for n, d in net.declarations.items()}
    return Question(net, columns, Cases(list(net), cards, parents, np.array(codes).T))


def main(cases: int, whole: bool = False) -> None:
    """Print ours for up to so many cases, then the peer's beside; ``whole``: which is run until it ends."""
    asked = {count: question(count) for count in COUNTS if count <= cases}
    found = {count: _ours(q) for count, q in asked.items()}
    head = ["cases", "log likelihood", "iterations", "never fell", "CPU s", "left to rise"]
    title = (
        f"ALARM's tables, {GAPS:.0%} of the entries missing: bmc.fit (pgmpy's EM drops such cases)"
    )
    print(table(title, head, [[n, *row[1:]] for n, row in found.items()]) + "\n", flush=True)
    fits = {count: row[0] for count, row in found.items()}
    print(_same_map(asked, fits, {n: row[4] for n, row in found.items()}) + "\n")
    print(_same_likelihood(asked, fits) + "\n")
    if whole:
        print(_whole(asked, fits, {n: row[4] for n, row in found.items()}) + "\n")


# ---- private ------------------------------------------------------------------------------------


def _ours(q: Question) -> list[Any]:
    """What is found, its row, and how much higher a fit goes on that ends later."""
    found, seconds = _timed(lambda: bmc.fit(q.net, q.columns))
    later, _ = _timed(lambda: bmc.fit(q.net, q.columns, start=found.values, tolerance=1e-9))
    never = bool((np.diff(found.history) >= 0).all())
    left = later.log_likelihood - found.log_likelihood
    shown = f"{found.log_likelihood:.5f}"
    return [found, shown, found.iterations, str(never), seconds, f"{left:.1e}"]


def _same_map(
    asked: Mapping[int, Question], fits: Mapping[int, Any], spent: Mapping[int, float]
) -> str:
    head = [
        "cases",
        f"iterate {COMPARED} off by",
        "rises from our end",
        "its end less ours",
        f"iterations to {NEAR:g}",
        "CPU s each",
        "all of them",
        "over ours",
    ]
    rows: list[list[object]] = []
    for count, q in asked.items():
        goal = fits[count].log_likelihood
        row: list[object] = [count]
        own: Tables = _start(q)
        for _ in range(COMPARED):
            _, own = q.step(own)
        first = _theirs(q, _start(q), COMPARED)
        on = _theirs(q, fits[count].values, 1)
        short, needed = _plain(q, goal)
        if first is None or on is None:
            rows.append([count, "", "", f"{short:+.1e}", needed])
            continue
        apart = max(float(np.abs(own[n] - t).max()) for n, t in first["tables"].items())
        rise = q.step(on["tables"])[0] - goal
        # a run sums over all cases once more than it iterates, for what it watches
        each = first["cpu_seconds"] / (COMPARED + 1)
        row += [f"{apart:.1e}", f"{rise:+.1e}", f"{short:+.1e}", needed, each]
        rows.append(row + [needed * each, needed * each / spent[count]])
    title = f"plain EM from the same tables by pyAgrum: what it costs to come within {NEAR:g} nats of its end"
    return table(title, head, rows)


def _plain(q: Question, goal: float) -> tuple[float, int]:
    """Where plain EM ends, less the goal, and after how many iterations it is near that end."""
    at: Tables = _start(q)
    heights: list[float] = []
    while len(heights) < MOST:
        height, at = q.step(at)
        heights.append(height)
        if len(heights) > 1 and height - heights[-2] < 1e-8:
            break
    return heights[-1] - goal, int(np.argmax(np.array(heights) > heights[-1] - NEAR))


def _same_likelihood(asked: Mapping[int, Question], fits: Mapping[int, Any]) -> str:
    """Of cases under the tables that were learned from most: by ``fit``, ``Exact``, and the peer."""
    count = max(asked)
    q, tables = asked[count], fits[count].values
    few = min(CHECKED, count)
    columns = {n: c[:few] for n, c in q.columns.items()}
    begun, _ = _timed(lambda: bmc.fit(fits[count].net, columns, max_iterations=1))
    rows = [
        {n: c[k] for n, c in columns.items() if c[k] is not None}  # what the case shows
        for k in range(few)
    ]
    exact = bmc.Exact()
    by_exact = sum(
        float(bmc.infer(fits[count].net, row, engine=exact).log_marginal_likelihood) for row in rows
    )
    lines = [["bmc.fit", f"{begun.history[0]:.9f}"], ["bmc.Exact, case by case", f"{by_exact:.9f}"]]
    answer = _ask(q, {"job": "likelihood", "start": _sent(q, tables), "rows": rows})
    if answer is not None:
        lines.append(["pyAgrum's LazyPropagation", f"{answer['log_likelihood']:.9f}"])
    return table(f"log likelihood of {few} cases under tables from {count}", ["by", "nats"], lines)


def _whole(
    asked: Mapping[int, Question], fits: Mapping[int, Any], spent: Mapping[int, float]
) -> str:
    rows: list[list[object]] = []
    for count, q in asked.items():
        answer = _theirs(q, _start(q), MOST, DIFFERENCE)
        if answer is None:
            continue
        less = q.step(answer["tables"])[0] - fits[count].log_likelihood
        taken = answer["cpu_seconds"]
        iterations = answer["iterations"]
        rows.append([count, f"{less:+.1e}", iterations, taken, taken / spent[count]])
    head = ["cases", "log likelihood less ours", "iterations", "CPU s", "over ours"]
    return table(f"pyAgrum's EM until it ends (difference {DIFFERENCE:g})", head, rows)


def _start(q: Question) -> dict[str, np.ndarray]:
    """The tables of the net."""
    return {n: np.array(d.probs) for n, d in q.net.declarations.items()}


def _theirs(
    q: Question, start: Tables, iterations: int, difference: float = 1e-12
) -> dict[str, Any] | None:
    """The peer's EM, no longer than so many iterations; its tables as arrays."""
    answer = _ask(
        q,
        {
            "job": "tables",
            "cases": q.columns,
            "start": _sent(q, start),
            "difference": difference,
            "iterations": iterations,
            "milliseconds": 1e3 * PATIENCE,
        },
    )
    if answer is not None:
        answer["tables"] = {n: np.array(t) for n, t in answer["tables"].items()}
    return answer


def _sent(q: Question, tables: Tables) -> dict[str, Any]:
    return {n: [q.net.declarations[n].parents, t.tolist()] for n, t in tables.items()}


def _ask(q: Question, asked: Mapping[str, Any]) -> dict[str, Any] | None:
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "alarm.bif"
        plain.write_bytes(gzip.decompress(network("alarm").read_bytes()))
        return peer_answer("fit_run.py", {**asked, "network": str(plain)})


def _timed(call: Callable[[], Any]) -> tuple[Any, float]:
    start = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = call()
    return found, time.process_time() - start
