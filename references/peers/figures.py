"""What the peers were measured to take for each case, kept in a small file beside this module.

``python -m references --peers`` measures JAGS (and PyMC, where an environment of its own is named) and writes
it; the page of ``python -m references`` is written from it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

FILE = Path(__file__).parent / "figures.json"


class Peer(NamedTuple):
    """One run of a peer: its effective size, its processor seconds, and how it was asked."""

    ess: float
    seconds: float
    how: str

    @property
    def rate(self) -> float:
        """Effective draws in a second."""
        return self.ess / self.seconds


class Figures(NamedTuple):
    """All that was measured: of each peer its version and date, and its runs by case and size asked for."""

    about: Mapping[str, str]
    runs: Mapping[str, Mapping[str, Peer]]

    def of(self, case: str, ess: int) -> dict[str, Peer]:
        """Runs of a case that were asked for ``ess``, by peer; PyMC's is its default for any."""
        found = self.runs.get(case, {})
        jags, pymc = found.get(f"JAGS {ess}"), found.get("PyMC")
        named = {"JAGS": jags, "PyMC": pymc}
        return {name: run for name, run in named.items() if run is not None}


def read(path: Path = FILE) -> Figures:
    """What is kept; nothing where there is no file."""
    if not path.exists():
        return Figures({}, {})
    content = json.loads(path.read_text(encoding="utf-8"))
    runs = {c: {n: Peer(*run) for n, run in of.items()} for c, of in content["runs"].items()}
    return Figures(content["about"], runs)


def keep(
    about: Mapping[str, str], runs: Mapping[str, Mapping[str, Peer]], path: Path = FILE
) -> None:
    """Write new figures over those of the same case and kind, and leave the others."""
    old = read(path)
    merged: dict[str, dict[str, Any]] = {c: dict(of) for c, of in old.runs.items()}
    for case, found in runs.items():
        merged.setdefault(case, {}).update(found)
    lines = [
        f'  "{case}": {{\n'
        + ",\n".join(f'   "{name}": {json.dumps(list(run))}' for name, run in of.items())
        + "\n  }"
        for case, of in merged.items()
    ]
    abouts = json.dumps({**old.about, **about}, indent=2)
    text = f'{{\n "about": {abouts},\n "runs": {{\n' + ",\n".join(lines) + "\n }\n}\n"
    path.write_text(text, encoding="utf-8")
