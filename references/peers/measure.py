"""Measures the peers, one case after the other, and keeps their figures."""

from __future__ import annotations

import datetime
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks.harness import peer_python
from benchmarks.peers import jags_run
from references.case import Case
from references.peers import figures, jags, nuts
from references.peers.figures import Peer

PEERS = ("JAGS", "PyMC")
#: effective sizes that JAGS is run for: that which our page judges, and one at which its start counts less
SIZES = (1000, 4000)


def main(cases: Sequence[Case], root: Path, named: Sequence[str]) -> int:
    """Measure and keep; 2 where a peer that is named is not there."""
    there = {"JAGS": jags_run.installed(), "PyMC": peer_python() is not None}
    if any(not there[name] for name in named):
        print("not installed: " + ", ".join(name for name in named if not there[name]))
        return 2
    today = datetime.date.today().isoformat()
    for peer in named or [name for name in PEERS if there[name]]:
        version, measure = _PEERS[peer]
        about = {peer: f"{version()}, {today}"}
        for case in cases:
            try:
                found = measure(case, root)
            except RuntimeError as error:  # the others go on
                print(f"{case.name}: {error}", flush=True)
                continue
            for name, run in found.items():
                said = f"{run.how:24}{run.ess:9.0f}{run.seconds:9.2f} s{run.rate:10.0f} / s"
                print(f"{case.name:28}{name:10}{said}", flush=True)
            figures.keep(about, {case.name: found})
    return 0


def _jags(case: Case, root: Path) -> dict[str, Peer]:
    return {f"JAGS {ess}": jags.best(case, root, ess) for ess in SIZES}


def _pymc(case: Case, root: Path) -> dict[str, Peer]:
    if case.name not in nuts.MODELS:
        return {}
    return {"PyMC": nuts.run(case, root)}


def _jags_version() -> str:
    said = subprocess.run(["jags"], input="exit\n", capture_output=True, text=True).stdout
    return "JAGS " + said.split("JAGS ", 1)[1].split()[0]


_PEERS: dict[str, tuple[Callable[[], str], Callable[[Case, Path], dict[str, Peer]]]] = {
    "JAGS": (_jags_version, _jags),
    "PyMC": (nuts.version, _pymc),
}
