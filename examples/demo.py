"""The demonstration behind ``make demo``: two nets, and every engine that can answer about them.

It prints one table per question and writes pictures to ``out/``. ``--fast`` takes few draws.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import bayesmc as bmc
from examples import diagnosis, old_faithful


@dataclass(frozen=True)
class Row:
    """One engine's answer to a question."""

    engine: str
    answer: str
    error: str = ""
    ess: str = ""
    seconds: float | None = None


def main(arguments: list[str] | None = None) -> None:
    """Ask all questions, print the tables, write the pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fast", action="store_true", help="few draws, for a smoke test")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the pictures")
    options = parser.parse_args(arguments)
    draws = 20_000 if options.fast else 1_000_000
    options.out.mkdir(parents=True, exist_ok=True)

    ask_diagnosis(draws)
    ask_eruption(draws)
    ask_all_eruptions(min(draws, 20_000))
    ask_typical_wait(draws)
    for path in draw_pictures(options.out, min(draws, 100_000)):
        print(f"wrote {path}")


def ask_diagnosis(draws: int) -> None:
    """The chest clinic: which disease, before and after the X-ray."""
    net = diagnosis.chest_clinic()
    for when, evidence in (
        ("a smoker back from Asia, short of breath", diagnosis.AT_FIRST),
        ("the same, and the X-ray is positive", diagnosis.WITH_XRAY),
    ):
        rows = []
        for engine in (bmc.Exact(), bmc.LikelihoodWeighting(draws)):
            posterior, seconds = timed(net, evidence, engine)
            p = [posterior.probabilities(name)[1] for name in diagnosis.DISEASES]
            errors = [posterior.mcse(name)[1] for name in diagnosis.DISEASES]
            rows.append(row(posterior, numbers(p), errors, seconds))
        rows.append(
            counted(
                net,
                draws,
                lambda values, evidence=evidence: np.all(
                    [values[name] == state for name, state in evidence.items()], axis=0
                ),
                lambda kept: [kept[name] == "yes" for name in diagnosis.DISEASES],
            )
        )
        print_table(f"P({', '.join(diagnosis.DISEASES)} | {when})", rows)


def ask_eruption(draws: int) -> None:
    """One eruption of Old Faithful: its kind, then its length, from what was timed."""
    net = old_faithful.two_kinds(1)
    evidence: dict[str, Any] = {"duration": [2.9], "waiting": [66.0]}
    rows = []
    for engine in (bmc.Exact(), bmc.LikelihoodWeighting(draws)):
        posterior, seconds = timed(net, evidence, engine)
        p = posterior.probabilities("kind")[0, 1]
        rows.append(row(posterior, numbers([p]), posterior.mcse("kind")[0, 1:], seconds))
    print_table("P(long | it lasted 2.9 min and the next came 66 min later)", rows)

    evidence = {"waiting": [66.0]}
    truth = old_faithful.kind_and_duration_given(66.0)
    rows = [Row("closed form", numbers(truth))]
    rows.append(Row("Exact", "refuses: the duration is continuous and not observed"))
    if bmc.Exact().unsupported(net, evidence) is None:
        raise AssertionError("Exact takes what the table says it refuses")
    posterior, seconds = timed(net, evidence, bmc.LikelihoodWeighting(draws))
    answers = [posterior.probabilities("kind")[0, 1], posterior.mean("duration")[0]]
    errors = [posterior.mcse("kind")[0, 1], posterior.mcse("duration")[0]]
    rows.append(row(posterior, numbers(answers), errors, seconds))
    rows.append(
        counted(
            net,
            draws,
            # times are recorded to the minute
            lambda values: np.abs(values["waiting"][:, 0] - 66.0) < 0.5,
            lambda kept: [kept["kind"][:, 0] == "long", kept["duration"][:, 0]],
        )
    )
    print_table("P(long), mean minutes it lasted | the next came 66 min later", rows)


def ask_all_eruptions(draws: int) -> None:
    """All 272 eruptions at once: easy for elimination, hopeless for importance weights."""
    net = old_faithful.two_kinds()
    evidence = {"duration": old_faithful.DURATIONS, "waiting": old_faithful.WAITS}
    rows = [Row("published fit", f"log P = {old_faithful.LOG_LIKELIHOOD:.3f}")]
    warned: list[warnings.WarningMessage] = []
    for engine in (bmc.Exact(), bmc.LikelihoodWeighting(draws)):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            posterior, seconds = timed(net, evidence, engine)
            long = posterior.probabilities("kind")[:, 1].sum()
            answer = f"log P = {posterior.log_marginal_likelihood:.3f}, {long:.1f} long"
            rows.append(row(posterior, answer, [posterior.log_marginal_likelihood_mcse], seconds))
        warned += caught
    print_table("The kinds of all 272 eruptions", rows)
    for message in {str(warning.message) for warning in warned}:
        print(f"  warned: {message}\n")


def ask_typical_wait(draws: int) -> None:
    """An unknown mean, learnt from the first eight waits after long eruptions."""
    evidence = {"wait": old_faithful.FIRST_LONG_WAITS}
    mean, sd, log_p = old_faithful.typical_given(old_faithful.FIRST_LONG_WAITS)
    rows = [Row("closed form", numbers([mean, sd, log_p]))]
    posterior, seconds = timed(
        old_faithful.typical_wait(), evidence, bmc.LikelihoodWeighting(draws)
    )
    answers = [
        posterior.mean("typical"),
        posterior.std("typical"),
        posterior.log_marginal_likelihood,
    ]
    rows.append(row(posterior, numbers(answers), [posterior.mcse("typical")], seconds))
    print_table("Typical wait after a long eruption: mean, sd, log P(data) | eight waits", rows)


def draw_pictures(folder: Path, draws: int) -> list[Path]:
    """Graphs with their plates, and marginals before and after the evidence."""
    import matplotlib

    matplotlib.use("agg")
    from bayesmc import plotting

    clinic = diagnosis.chest_clinic()
    before, after = (bmc.infer(clinic, e, engine=bmc.Exact()) for e in ({}, diagnosis.WITH_XRAY))
    wait = old_faithful.typical_wait()
    engine = bmc.LikelihoodWeighting(draws)
    waits = {"wait": old_faithful.FIRST_LONG_WAITS}
    guess, learnt = (bmc.infer(wait, e, engine=engine, rng=1) for e in ({}, waits))
    pictures = {
        "asia_graph": plotting.plot_dag(clinic, observed=diagnosis.WITH_XRAY),
        "asia_prior_posterior": plotting.plot_prior_posterior(
            before, after, [*diagnosis.DISEASES, "either"]
        )[0],
        "old_faithful_graph": plotting.plot_dag(
            old_faithful.two_kinds(272), observed=["duration", "waiting"]
        ),
        "old_faithful_prior_posterior": plotting.plot_prior_posterior(guess, learnt, ["typical"])[
            0
        ],
    }
    paths = []
    for name, ax in pictures.items():
        paths.append(folder / f"{name}.png")
        ax.figure.savefig(paths[-1], dpi=150)
        matplotlib.pyplot.close(ax.figure)
    return paths


def timed(net: bmc.BayesNet, evidence: Mapping[str, Any], engine: Any) -> tuple[Any, float]:
    """The posterior, and the seconds that it took; what takes long shows its progress."""
    start = time.perf_counter()
    posterior = bmc.infer(net, evidence, engine=engine, rng=2024, progress=True)
    return posterior, time.perf_counter() - start


def row(posterior: Any, answer: str, errors: Any, seconds: float) -> Row:
    """A row for any engine; exact answers have no Monte Carlo error and no ESS."""
    name = type(posterior.engine).__name__
    if posterior.weight_ess is None:
        return Row(name, answer, "exact", "", seconds)
    return Row(name, answer, numbers(errors, "{:.1g}"), f"{posterior.weight_ess:,.0f}", seconds)


def counted(
    net: bmc.BayesNet,
    draws: int,
    matches: Callable[[Mapping[str, Any]], np.ndarray],
    asked: Callable[[Mapping[str, Any]], list[np.ndarray]],
) -> Row:
    """Ancestral sampling: of the draws that match the evidence, the mean of what is asked."""
    start = time.perf_counter()
    values = net.sample(draws, rng=2024)
    match = matches(values)
    kept = {name: value[match] for name, value in values.items()}
    count = int(match.sum())
    seconds = time.perf_counter() - start
    if count < 2:
        return Row("sample and count", f"{count} draws match", "", str(count), seconds)
    columns = [np.asarray(column, dtype=float) for column in asked(kept)]
    errors = [column.std(ddof=1) / np.sqrt(count) for column in columns]
    answer = numbers([column.mean() for column in columns])
    return Row("sample and count", answer, numbers(errors, "{:.1g}"), f"{count:,}", seconds)


def numbers(values: Any, form: str = "{:.4f}") -> str:
    """Several numbers in one cell."""
    return "  ".join(form.format(float(value)) for value in values)


def print_table(title: str, rows: list[Row]) -> None:
    """A table with a line for each engine."""
    cells = [["engine", "answer", "Monte Carlo error", "ESS", "seconds"]]
    for r in rows:
        seconds = "" if r.seconds is None else f"{r.seconds:.3f}"
        cells.append([r.engine, r.answer, r.error, r.ess, seconds])
    widths = [max(len(line[i]) for line in cells) for i in range(5)]
    print(title)
    for line in cells:
        left = [cell.ljust(width) for cell, width in zip(line[:3], widths, strict=False)]
        right = [cell.rjust(width) for cell, width in zip(line[3:], widths[3:], strict=True)]
        print("  " + "  ".join(left + right).rstrip())
    print()


if __name__ == "__main__":
    main()
