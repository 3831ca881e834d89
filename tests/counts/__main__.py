"""``python -m tests.counts [lines] [hops] [followed] [-v]``: what the house measures, as tables."""

from __future__ import annotations

import argparse

from tests.counts import followed, hops, lines


def main() -> None:
    """Print the tables that are asked for."""
    parser = argparse.ArgumentParser(prog="python -m tests.counts", description=__doc__)
    parser.add_argument("tables", nargs="*", metavar="lines | hops | followed")
    parser.add_argument("-v", "--verbose", action="store_true", help="list modules, too")
    options = parser.parse_args()
    tables = {
        "lines": lines.report,
        "hops": lambda: hops.report(options.verbose),
        "followed": followed.report,
    }
    unknown = set(options.tables) - set(tables)
    if unknown:
        parser.error(f"no table {', '.join(sorted(unknown))}")
    for name in options.tables or tables:
        print(f"{name}:", *tables[name](), sep="\n")


if __name__ == "__main__":
    main()
