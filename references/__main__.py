"""``python -m references``: hold bayesmc against published posteriors, and beside JAGS and PyMC.

``--only rats pump`` runs the cases whose names hold one of the words; a run of all writes
``docs/accuracy.md``. ``--peers`` measures the peers instead, for the page to quote.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from references import CASES, data_folder
from references.page import report
from references.peers import figures, measure
from references.run import run_all
from references.speed import compiled_anew, measured

_PAGE = Path(__file__).resolve().parents[1] / "docs" / "accuracy.md"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is asked for; 1 where a case is not as published."""
    parser = argparse.ArgumentParser(prog="python -m references", description=__doc__)
    parser.add_argument("--only", nargs="+", metavar="WORD", help="cases whose names hold a word")
    parser.add_argument("--list", action="store_true", help="print the names of the cases")
    parser.add_argument("--rng", type=int, default=1, help="seed of every run (default 1)")
    parser.add_argument(
        "--out", type=Path, help="write the page there, also for a part of the cases"
    )
    parser.add_argument(
        "--peers",
        nargs="*",
        choices=measure.PEERS,
        help="measure these (all that are installed, if none is named) and keep their figures",
    )
    options = parser.parse_args(arguments)
    cases = [c for c in CASES if not options.only or any(w in c.name for w in options.only)]
    if options.list:
        print(*(case.name for case in cases), sep="\n")
        return 0
    root = data_folder()
    if not root.is_dir():
        print(f"no reference data at {root}: set BAYESMC_DATA", file=sys.stderr)
        return 2
    if not cases:
        print(f"no case is called like {' or '.join(options.only)}; see --list", file=sys.stderr)
        return 2
    if options.peers is not None:
        return measure.main(cases, root, options.peers)
    with compiled_anew():
        outcomes = run_all(cases, root, options.rng)
    page = options.out or (None if options.only else _PAGE)
    if page is not None:
        engines = {o.case.name: o.judged.engine for o in outcomes if o.judged is not None}
        plain = measured(engines, "plain", None, options.rng)
        more = measured(engines, "fast", 4000, options.rng)
        text = report(outcomes, plain, more, figures.read(), options.rng)
        page.write_text(text, encoding="utf-8")
        print(f"written: {page}")
    return 0 if all(outcome.passed for outcome in outcomes) else 1


if __name__ == "__main__":
    raise SystemExit(main())
