"""A helper, not a script: one question put to several engines, and the table of their answers."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import bayesmc as bmc

SEED = 1
EXACT = "exact"


@dataclass(frozen=True)
class Row:
    """One engine's answers to a question, each with its Monte Carlo error."""

    engine: str
    answers: tuple[float, ...] = ()
    errors: tuple[float, ...] | str = ""
    ess: float | None = None
    seconds: float | None = None
    refusal: str = ""


@dataclass(frozen=True)
class Table:
    """A question, what was asked for, and a row for each engine."""

    question: str
    asked: tuple[str, ...]
    rows: tuple[Row, ...]
    warned: tuple[str, ...] = ()


def infer(
    net: bmc.BayesNet,
    evidence: Mapping[str, Any],
    engine: Any,
    ask: Callable[[Any], list[tuple[float, float]]],
) -> Row:
    """One engine's answers, or its refusal; what takes over a second shows its progress."""
    name = type(engine).__name__
    refusal = engine.unsupported(net, evidence)
    if refusal is not None:
        return Row(name, refusal=refusal)
    start = time.perf_counter()
    posterior = bmc.infer(net, evidence, engine=engine, rng=SEED, progress=True)
    answers, errors = zip(*ask(posterior), strict=True)
    seconds = time.perf_counter() - start
    if posterior.weight_ess is None:
        return Row(name, answers, EXACT, seconds=seconds)
    return Row(name, answers, errors, posterior.weight_ess, seconds)


def count(
    net: bmc.BayesNet,
    draws: int,
    matches: Callable[[Mapping[str, Any]], np.ndarray],
    asked: Callable[[Mapping[str, Any]], list[np.ndarray]],
) -> Row:
    """Ancestral sampling: of the draws that match the evidence, the mean of what is asked."""
    start = time.perf_counter()
    values = net.sample(draws, rng=SEED)
    match = matches(values)
    kept = {name: value[match] for name, value in values.items()}
    columns = [np.asarray(column, dtype=float) for column in asked(kept)]
    answers = tuple(column.mean() for column in columns)
    errors = tuple(column.std() / np.sqrt(len(column)) for column in columns)
    seconds = time.perf_counter() - start
    return Row("sample and count", answers, errors, float(match.sum()), seconds)


def print_table(table: Table) -> None:
    """The question, and a line for each engine."""
    cells = [["engine", ", ".join(table.asked), "Monte Carlo error", "ESS", "seconds"]]
    for row in table.rows:
        refused = f"refuses: {row.refusal}"
        error = row.errors if isinstance(row.errors, str) else _numbers(row.errors, "{:.1g}")
        cells.append([
            row.engine,
            refused if row.refusal else _numbers(row.answers, "{:.4f}"),
            error,
            "" if row.ess is None else f"{row.ess:,.0f}",
            "" if row.seconds is None else f"{row.seconds:.3f}",
        ])  # fmt: skip
    shown = [line for line in cells if not line[1].startswith("refuses")]
    widths = [max(len(line[i]) for line in shown) for i in range(5)]
    print(table.question)
    for line in cells:
        left = [cell.ljust(width) for cell, width in zip(line[:3], widths, strict=False)]
        right = [cell.rjust(width) for cell, width in zip(line[3:], widths[3:], strict=True)]
        print(("  " + "  ".join(left + right)).rstrip())
    for message in table.warned:
        print(f"  warned: {message}")
    print()


def _numbers(values: Sequence[float], form: str) -> str:
    return "  ".join(form.format(float(value)) for value in values)
