"""Try every mutant at fresh seeds and print the table: ``python -m tests.mutants --help``.

Exit status 1 unless each fault is caught at every seed, and no test sounds an alarm without its fault. As all
tests have a false-alarm rate of 1e-6, a whole table of right tests fails less than once in a hundred runs.
"""

from __future__ import annotations

import argparse
import secrets
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

from tests.mutants.catalogue import MUTANTS
from tests.mutants.mutant import Row, Trial, examined

HEADER = ("fault", "where", "caught by", "caught", "alarms", "seconds")


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; 0 where all is well."""
    options = _read(arguments)
    chosen = [
        k
        for k, mutant in enumerate(MUTANTS)
        if options.only.lower() in f"{mutant.name} {mutant.where} {mutant.by}".lower()
    ]
    if not chosen:
        print(f"no mutant has {options.only!r} in its name, place or test")
        return 1
    first = secrets.randbelow(2**31) if options.seed is None else options.seed
    print(f"{len(chosen)} mutants, {options.seeds} seeds each (--seed {first} repeats them)\n")
    print(_line(HEADER), _line(["---"] * len(HEADER)), sep="\n", flush=True)
    failed = 0
    for row in _rows(chosen, range(first, first + options.seeds), options.jobs):
        print(_line(_cells(row)), flush=True)
        for problem in row.problems:
            print(f"    ! {problem}", flush=True)
        failed += bool(row.problems)
    print(
        f"\n{len(chosen) - failed} of {len(chosen)} mutants caught at every seed, without false alarms"
    )
    return 1 if failed else 0


# ---- private ------------------------------------------------------------------------------------


def _read(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m tests.mutants",
        description="Plant faults in the library one by one; tests of bayesmc.testing must catch them.",
    )
    parser.add_argument("--seeds", type=_count, default=100, help="seeds for each mutant (100)")
    parser.add_argument("--only", default="", help="mutants with this in name, place or test")
    parser.add_argument("--jobs", type=_count, default=2, help="processes (2)")
    parser.add_argument(
        "--seed", type=int, help="first seed; by default a fresh one, which is printed"
    )
    return parser.parse_args(arguments)


def _count(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError("give a whole number, 1 or more")
    return value


def _rows(chosen: Sequence[int], seeds: range, jobs: int) -> Iterator[Row]:
    """Rows in the order of the catalogue; every process plants its faults in its own memory."""
    if jobs == 1:
        yield from (examined(MUTANTS[k], seeds) for k in chosen)
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("fork")) as pool:
        found = pool.map(_trials, chosen, [seeds] * len(chosen))
        for k, trials in zip(chosen, found, strict=True):
            yield Row(MUTANTS[k], trials)


def _trials(number: int, seeds: range) -> Sequence[Trial]:
    """What travels between processes: tests are functions, which do not."""
    return examined(MUTANTS[number], seeds).trials


def _cells(row: Row) -> list[str]:
    mutant, count = row.mutant, len(row.trials)
    return [
        mutant.name,
        mutant.where,
        mutant.by,
        f"{row.caught} of {count}",
        str(row.alarms),
        f"{row.seconds:.2f}",
    ]


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    sys.exit(main())
