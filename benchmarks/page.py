"""The page ``docs/speed.md``, written by the benchmarks: ``python -m benchmarks.page`` (``make speed``).

Each section is what one benchmark prints, with the machine and the day.
``python -m benchmarks.page exact filters`` measures these sections anew and leaves the others as they
stand. Peers stand beside where ``make peers`` has put them; a benchmark that fails leaves the page as it was.
"""

from __future__ import annotations

import argparse
import datetime
import os
import platform
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

PAGE = Path(__file__).resolve().parents[1] / "docs" / "speed.md"
HEAD = """# How long things take

Each table below is what a benchmark of the repository printed, on the machine and the day that
stand above it; `make speed` measures them all anew, `make bench` more of them. Absolute times are
those of that machine, and of what else it did: what holds elsewhere are the *ratios*, since runs of
ours and of others take turns (peers in processes of their own). A *floor* is code written by hand
for that one model. Chains, and what an effective draw costs beside JAGS and PyMC, are in
[accuracy](accuracy.md#what-it-costs); why a model of yours is slow, in
[mixing](mixing.md#it-mixes-but-a-sweep-is-slow).
"""


@dataclass(frozen=True)
class Section:
    """What a benchmark has to say: a heading, a sentence before its table, the module and its arguments."""

    title: str
    words: str
    module: str
    arguments: tuple[str, ...] = ()


SECTIONS = {
    "scale": Section(
        "Importing and declaring",
        "What is paid before any question: the import, and nets of many nodes without plates (with plates, a "
        "thousand elements are one node).",
        "benchmarks.bench_scale",
    ),
    "exact": Section(
        "Exact answers on networks of tables",
        "All marginals for new evidence, the net prepared once, beside pyAgrum's LazyPropagation.",
        "benchmarks.bench_exact",
    ),
    "weighting": Section(
        "Likelihood weighting",
        "All marginals with five observed nodes, beside NumPy tuned by hand and peers.",
        "benchmarks.bench_weighting",
    ),
    "filters": Section(
        "Filters",
        "Whole calls on prepared templates, beside loops by hand, the same loops compiled, and peers.",
        "benchmarks.bench_time",
        ("--short",),
    ),
    "waiting": Section(
        "What a user waits for",
        "A process that starts, imports, declares, asks and ends.",
        "benchmarks.bench_waiting",
    ),
}


def main(arguments: Sequence[str]) -> None:
    """Measure the sections that are named, or all, and write the page."""
    asked = argparse.ArgumentParser(prog="python -m benchmarks.page", description=__doc__)
    asked.add_argument("sections", nargs="*", metavar="section", help=", ".join(SECTIONS))
    names = asked.parse_args(arguments).sections
    if unknown := [name for name in names if name not in SECTIONS]:
        asked.error(f"unknown section {unknown[0]!r}; there are {', '.join(SECTIONS)}")
    measured = {name: measure(SECTIONS[name]) for name in names or SECTIONS}
    old = PAGE.read_text("utf-8") if PAGE.exists() else ""
    PAGE.write_text(page(measured, old), "utf-8")
    print(f"wrote {PAGE}")


def measure(section: Section) -> str:
    """What the section's benchmark prints, and where and when it did."""
    print(f"{section.title} ...", file=sys.stderr, flush=True)
    where = machine()
    done = subprocess.run(
        [sys.executable, "-m", section.module, *section.arguments],
        stdout=subprocess.PIPE,
        text=True,
        cwd=PAGE.parents[1],
    )
    if done.returncode:
        raise SystemExit(
            f"{section.module} failed (exit status {done.returncode}); page not written"
        )
    shown = f"python -m {' '.join([section.module, *section.arguments])}"
    today = datetime.datetime.now(datetime.UTC).date().isoformat()
    return f"{section.words}\n`{shown}`, {today}, {where}:\n\n```\n{done.stdout.strip()}\n```\n"


def page(measured: Mapping[str, str], old: str = "") -> str:
    """The page with sections as measured; the others as they stand in the old one, if they do.

    >>> first = page({"scale": "ours 1 s\\n"})
    >>> "## Importing and declaring" in page({"exact": "2 ms\\n"}, first)
    True
    """
    kept = dict(re.findall(r"^## (.+?)\n\n(.*?)(?=^## |\Z)", old, re.M | re.S))
    parts = [HEAD]
    for name, section in SECTIONS.items():
        text = measured.get(name, kept.get(section.title))
        if text is not None:
            parts.append(f"## {section.title}\n\n{text.strip()}\n")
    return "\n".join(parts)


def machine() -> str:
    """Processor, cores, versions, and what else ran at that moment, in one line."""
    try:
        listed = Path("/proc/cpuinfo").read_text("utf-8")
    except OSError:
        listed = ""
    model = re.search(r"^model name\s*:\s*(.+)$", listed, re.M)
    name = model[1].strip() if model else platform.processor() or platform.machine()
    python = f"Python {platform.python_version()}, NumPy {version('numpy')}"
    load = f", load {os.getloadavg()[0]:.1f} before it began" if hasattr(os, "getloadavg") else ""
    return f"{os.cpu_count()} cores of {name}, {python}{load}"


if __name__ == "__main__":
    main(sys.argv[1:])
