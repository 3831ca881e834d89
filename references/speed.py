"""Effective draws per second of all cases, in a process of its own that finds no machine code made before.

``python -m references.speed WITH ESS RNG CASE=ENGINE...`` prints one line of JSON for each case; ``WITH`` is
``fast`` or ``plain``, which does without the extra of that name. An effective size is asked of the engine
named, as one that is chosen gets its own.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Literal

import bayesmc as bmc
from references import CASES, data_folder
from references.peers.figures import Peer
from references.run import asked_for, sampled


def measured(
    engines: Mapping[str, str], kind: Literal["fast", "plain"], ess: int | None, rng: int
) -> dict[str, Peer]:
    """Effective size and seconds of each case, by name; those that fail are left out.

    Parameters
    ----------
    engines : mapping
        Case -> the engine's name.
    kind : {"fast", "plain"}
    ess : int or None
        What is asked for; None for what a user gets who asks for nothing.
    rng : int
    """
    names = [f"{case}={engine}" for case, engine in engines.items()]
    with compiled_anew():
        done = subprocess.run(
            [sys.executable, "-m", "references.speed", kind, str(ess or 0), str(rng), *names],
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        )
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    return {name: Peer(*run) for name, *run in rows}


@contextmanager
def compiled_anew() -> Iterator[None]:
    """A cache of machine code of one's own, empty: compiling counts."""
    before = os.environ.get("XDG_CACHE_HOME")
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_CACHE_HOME"] = folder
        try:
            yield
        finally:
            del os.environ["XDG_CACHE_HOME"]
            if before is not None:
                os.environ["XDG_CACHE_HOME"] = before


def main(arguments: Sequence[str]) -> None:
    """Measure and print."""
    kind, ess, rng, *names = arguments
    if kind == "plain":
        sys.modules["llvmlite"] = None  # type: ignore[assignment]
    by_name, root = {case.name: case for case in CASES}, data_folder()
    for name, _, named in (pair.partition("=") for pair in names):
        case = by_name[name]
        try:
            engine = asked_for(getattr(bmc, named)(), int(ess)) if int(ess) else case.engine()
            run, _ = sampled(case, engine, root, int(rng))
        except Exception as error:  # the others go on
            print(f"{name}: {error}", file=sys.stderr, flush=True)
            continue
        print(json.dumps([name, run.ess, run.seconds, run.draws]), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
