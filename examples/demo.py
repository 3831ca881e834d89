"""The demonstration behind ``make demo``: two nets, and every engine that can answer about them.

It prints one table per question and writes pictures to ``out/``, then does what the scripts of the
figures do, each of which also runs by itself. ``--fast`` takes few draws.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import bayesmc as bmc
from examples import (
    central_limit,
    diagnosis,
    expectation_and_marginal,
    old_faithful,
    parzen,
    pushforward,
    rejection_and_importance,
)

FIGURES = (
    parzen, central_limit, pushforward, rejection_and_importance, expectation_and_marginal
)  # fmt: skip
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


def main(arguments: Sequence[str] | None = None) -> None:
    """Ask all questions, print the tables, write the pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fast", action="store_true", help="few draws, for a smoke test")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the pictures")
    options = parser.parse_args(arguments)
    for table in questions(20_000 if options.fast else 1_000_000):
        print_table(table)
    options.out.mkdir(parents=True, exist_ok=True)
    for path in draw_pictures(options.out, 20_000 if options.fast else 50_000):
        print(f"wrote {path}")
    for figure in FIGURES:
        print()
        figure.main([*(["--fast"] if options.fast else []), "--out", str(options.out)])


def questions(draws: int) -> Iterator[Table]:
    """Every question with the answers of every engine that takes it."""
    yield which_disease(draws, "a smoker back from Asia, short of breath", diagnosis.AT_FIRST)
    yield which_disease(draws, "the same, and the X-ray is positive", diagnosis.WITH_XRAY)
    yield which_kind(draws)
    yield how_long(draws)
    yield which_kinds_all(draws // 50)
    yield typical_wait(draws)


def which_disease(draws: int, when: str, evidence: Mapping[str, str]) -> Table:
    """The chest clinic: a discrete net."""
    net = diagnosis.chest_clinic()

    def ask(posterior: Any) -> list[tuple[float, float]]:
        return [
            (posterior.probabilities(name)[1], posterior.mcse(name)[1])
            for name in diagnosis.DISEASES
        ]

    counted = count(
        net,
        draws,
        lambda values: np.all([values[name] == evidence[name] for name in evidence], axis=0),
        lambda kept: [kept[name] == "yes" for name in diagnosis.DISEASES],
    )
    rows = (
        infer(net, evidence, bmc.Exact(), ask),
        infer(net, evidence, bmc.LikelihoodWeighting(draws), ask),
        counted,
    )
    return Table(f"Which disease? {when}", diagnosis.DISEASES, rows)


def which_kind(draws: int) -> Table:
    """One eruption of Old Faithful: the kind is hidden, both times are measured."""
    net = old_faithful.two_kinds(1)
    evidence = {"duration": [2.9], "waiting": [66.0]}

    def ask(posterior: Any) -> list[tuple[float, float]]:
        return [(posterior.probabilities("kind")[0, 1], posterior.mcse("kind")[0, 1])]

    rows = (
        infer(net, evidence, bmc.Exact(), ask),
        infer(net, evidence, bmc.LikelihoodWeighting(draws), ask),
    )
    return Table("Old Faithful: it lasted 2.9 min, the next came 66 min later", ("long",), rows)


def how_long(draws: int) -> Table:
    """The same when nobody timed it: the duration is hidden, too, and is integrated out."""
    net = old_faithful.two_kinds(1)
    evidence = {"waiting": [66.0]}

    def ask(posterior: Any) -> list[tuple[float, float]]:
        return [
            (posterior.probabilities("kind")[0, 1], posterior.mcse("kind")[0, 1]),
            (posterior.mean("duration")[0], posterior.mcse("duration")[0]),
        ]

    counted = count(
        net,
        draws,
        # waiting times are recorded to the minute
        lambda values: np.abs(values["waiting"][:, 0] - 66.0) < 0.5,
        lambda kept: [kept["kind"][:, 0] == "long", kept["duration"][:, 0]],
    )
    rows = (
        Row("closed form", old_faithful.kind_and_duration_given(66.0), EXACT),
        infer(net, evidence, bmc.Exact(), ask),
        infer(net, evidence, bmc.LikelihoodWeighting(draws), ask),
        counted,
    )
    question = "Old Faithful: nobody timed it, the next came 66 min later"
    return Table(question, ("long", "mean minutes"), rows)


def which_kinds_all(draws: int) -> Table:
    """All 272 eruptions at once: easy for elimination, hopeless for importance weights."""
    net = old_faithful.two_kinds()
    evidence = {"duration": old_faithful.DURATIONS, "waiting": old_faithful.WAITS}

    def ask(posterior: Any) -> list[tuple[float, float]]:
        return [(posterior.log_marginal_likelihood, posterior.log_marginal_likelihood_mcse)]

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        rows = (
            Row("published fit", (old_faithful.LOG_LIKELIHOOD,), EXACT),
            infer(net, evidence, bmc.Exact(), ask),
            infer(net, evidence, bmc.LikelihoodWeighting(draws), ask),
        )
    warned = tuple(dict.fromkeys(str(warning.message) for warning in caught))
    return Table("Old Faithful: all 272 eruptions at once", ("log P(times)",), rows, warned)


def typical_wait(draws: int) -> Table:
    """An unknown mean, learnt from the first eight waits after long eruptions."""
    net = old_faithful.typical_wait()
    evidence = {"wait": old_faithful.FIRST_LONG_WAITS}

    def ask(posterior: Any) -> list[tuple[float, float]]:
        return [
            (posterior.mean("typical"), posterior.mcse("typical")),
            (posterior.log_marginal_likelihood, posterior.log_marginal_likelihood_mcse),
        ]

    mean, _, log_p = old_faithful.typical_given(old_faithful.FIRST_LONG_WAITS)
    rows = (
        Row("closed form", (mean, log_p), EXACT),
        infer(net, evidence, bmc.Exact(), ask),
        infer(net, evidence, bmc.LikelihoodWeighting(draws), ask),
    )
    question = "Old Faithful: the typical wait after a long eruption, from eight of them"
    return Table(question, ("mean minutes", "log P(waits)"), rows)


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


def draw_pictures(folder: Path, draws: int) -> list[Path]:
    """Graphs with their plates, and marginals before and after the evidence."""
    import matplotlib

    matplotlib.use("agg")  # write files; open no window
    from matplotlib import pyplot

    from bayesmc import plotting

    clinic, times, wait = (
        diagnosis.chest_clinic(), old_faithful.two_kinds(272), old_faithful.typical_wait()
    )  # fmt: skip
    healthy, ill = (bmc.infer(clinic, e, engine=bmc.Exact()) for e in ({}, diagnosis.WITH_XRAY))
    engine = bmc.LikelihoodWeighting(draws)
    waits = {"wait": old_faithful.FIRST_LONG_WAITS}
    guess, learnt = (bmc.infer(wait, e, engine=engine, rng=SEED) for e in ({}, waits))
    pictures = {
        "chest_clinic": plotting.plot_dag(clinic, observed=diagnosis.WITH_XRAY),
        "chest_clinic_marginals": plotting.plot_prior_posterior(healthy, ill)[0],
        "old_faithful": plotting.plot_dag(times, observed=["duration", "waiting"]),
        "old_faithful_marginals": plotting.plot_prior_posterior(guess, learnt)[0],
    }
    paths = []
    for name, ax in pictures.items():
        paths.append(folder / f"{name}.png")
        ax.figure.savefig(paths[-1], dpi=150)
        pyplot.close(ax.figure)
    return paths


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


if __name__ == "__main__":
    main()
