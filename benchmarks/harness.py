"""What every benchmark shares: interleaved timing, peers in another process, tables with ratios.

Absolute times drift with the machine and with what else it does; ratios of medians of interleaved
runs are what holds. A hand-written floor counts only if, in the same run, it is as much faster than
a peer as the baselines say, less 15 per cent; otherwise the comparison says nothing.
"""

from __future__ import annotations

import gzip
import json
import os
import statistics
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from benchmarks import THREADS

HERE = Path(__file__).parent
TOLERANCE = 0.15
DOES_NOT_COUNT = "floor did not reach its baseline: figure does not count"

# Peer time over hand-NumPy time, likelihood weighting on ALARM at 10^5 draws with 5 evidence nodes.
LW_BASELINE = {"lw-pgmpy": 91 / 1.42, "lw-pyagrum": 354 / 1.42}


class SelfTimed:
    """A callable that returns its own seconds, for :func:`interleave`."""

    def __init__(self, function: Callable[[], float]) -> None:
        self.function = function


@dataclass(frozen=True)
class Timing:
    """Median, best and number of the runs of one entry, in seconds."""

    median: float
    best: float
    runs: int


def interleave(
    entries: Mapping[str, Callable[[], object] | SelfTimed],
    repeats: int = 7,
    *,
    warmup: int = 1,
    budget: float = 30.0,
    least: float = 0.2,
) -> dict[str, Timing]:
    """Run the entries in turn, ``repeats`` rounds, and give each one's median.

    ``warmup`` rounds are not counted, but those of self-timed entries (which prepare elsewhere) are
    left out. Within a round an entry is run again until it has had ``least`` seconds: a short one
    that follows a long one would otherwise be timed with cold caches only. An entry that has used
    its ``budget`` of seconds sits out the rounds that remain, so that a slow peer does not make the
    run last for ever.

    >>> timings = interleave({"sum": lambda: sum(range(1000))}, repeats=3, least=0.0)
    >>> timings["sum"].runs
    3
    """
    for _ in range(warmup):
        for entry in entries.values():
            if not isinstance(entry, SelfTimed):
                entry()
    seconds: dict[str, list[float]] = {name: [] for name in entries}
    for _ in range(repeats):
        for name, entry in entries.items():
            if sum(seconds[name]) < budget:
                seconds[name] += _for_a_while(entry, least)
    return {
        name: Timing(statistics.median(times), min(times), len(times))
        for name, times in seconds.items()
    }


def reached(floor: float, peer: float, baseline: float) -> bool:
    """Is the floor as much faster than the peer as the baselines have it, less 15 per cent?

    >>> reached(floor=1.0, peer=86.0, baseline=100.0), reached(1.0, 84.0, 100.0)
    (True, False)
    """
    return peer / floor >= (1.0 - TOLERANCE) * baseline


class Worker:
    """A process that answers one line of JSON with another. Use it as a context: it ends with it.

    Parameters
    ----------
    name
        What messages call it.
    command, cwd, env
        As ``subprocess.Popen`` takes them.
    """

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        cwd: Path | None = None,
        env: Mapping[str, str] | None = None,
    ) -> None:
        self.name = name
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            cwd=cwd,
            env=env,
        )

    def ask(self, **question: Any) -> dict[str, Any]:
        """The reply to a question; ``RuntimeError`` where the process has ended or failed."""
        assert self._process.stdin is not None
        try:
            print(json.dumps(question), file=self._process.stdin, flush=True)
        except BrokenPipeError:
            pass  # the missing reply says so
        return self.reply()

    def reply(self) -> dict[str, Any]:
        """The next line that the process prints."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(
                f"{self.name} ended (exit status {self._process.wait()}); "
                "is its environment complete? Run `make peers`"
            )
        found = json.loads(line)
        if "error" in found:
            raise RuntimeError(f"{self.name} failed: {found['error']}")
        return found

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        assert self._process.stdin is not None and self._process.stdout is not None
        try:
            self._process.stdin.close()
        except BrokenPipeError:
            pass
        self._process.wait(timeout=60)
        self._process.stdout.close()


class Peer(Worker):
    """A peer library in its own environment, one job on one network, asked over a pipe.

    ``job`` is one of ``lw-pgmpy``, ``lw-pyagrum``, ``exact-pyagrum``; the protocol is that of
    ``peers/server.py``. Use it as a context: the process ends with it.
    """

    def __init__(
        self, job: str, network: str | Path, draws: int = 100_000, python: str | Path | None = None
    ) -> None:
        python = python or peer_python()
        if python is None:
            raise FileNotFoundError(
                f"the peer {job} has no environment; run `make peers`, or name one in BAYESMC_PEERS"
            )
        script = HERE / "peers" / "server.py"
        super().__init__(
            f"the peer {job}",
            [str(python), str(script), job, str(network), str(draws)],
            env={name: value for name, value in os.environ.items() if name not in THREADS},
        )
        self.reply()

    def seconds(self, evidence: Mapping[str, str]) -> float:
        """Seconds for one run with this evidence."""
        return float(self.ask(evidence=dict(evidence), answer=False)["seconds"])

    def cpu_seconds(self, evidence: Mapping[str, str]) -> float:
        """The same in seconds of its process, which other processes do not stretch."""
        return float(self.ask(evidence=dict(evidence), answer=False)["cpu_seconds"])

    def marginals(self, evidence: Mapping[str, str]) -> dict[str, dict[str, float]]:
        """The peer's answer: node to state label to probability."""
        return self.ask(evidence=dict(evidence), answer=True)["marginals"]

    def timed(self, *evidence: Mapping[str, str]) -> SelfTimed:
        """An entry for :func:`interleave` that asks each evidence in turn and times all of them."""
        return SelfTimed(lambda: sum(self.seconds(one) for one in evidence))


def peer_answer(script: str, question: Mapping[str, Any]) -> dict[str, Any] | None:
    """What a script of ``peers/`` answers, JSON for JSON; None without the peers, or if it fails."""
    python = peer_python()
    if python is None:
        return None
    command = [str(python), str(HERE / "peers" / script)]
    done = subprocess.run(command, input=json.dumps(question), capture_output=True, text=True)
    if done.returncode:
        print(f"the peer's {question['job']} failed: {done.stderr.strip().splitlines()[-1]}")
        return None
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def peer_python() -> Path | None:
    """The Python of the peers' environment (``BAYESMC_PEERS``, else ``.venv-peers``), if there."""
    folder = Path(os.environ.get("BAYESMC_PEERS", HERE.parent / ".venv-peers"))
    python = folder / "bin" / "python"
    return python if python.exists() else None


def data_folder() -> Path:
    """Where the reference data lies: ``BAYESMC_DATA``, else ``../shared/data``."""
    return Path(os.environ.get("BAYESMC_DATA", HERE.parent.parent / "shared" / "data"))


def network(name: str) -> Path:
    """The BIF file of a network of the reference data."""
    return data_folder() / "bn_discrete" / "bif" / f"{name}.bif.gz"


def scenarios(name: str) -> list[dict[str, str]]:
    """The evidence sets for which a network of the reference data has exact answers."""
    path = data_folder() / "bn_discrete" / "refs" / f"{name}.ref.json.gz"
    found = json.loads(gzip.decompress(path.read_bytes()))["scenarios"]
    return [scenario["evidence"] for scenario in found.values() if scenario["evidence"]]


def table(title: str, header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Text in columns, numbers to three significant digits.

    >>> print(table("speed", ["what", "ms", "ratio"], [["floor", 12.345, 1.0]]))
    speed
    what   |   ms | ratio
    -------+------+------
    floor  | 12.3 |     1
    """
    cells = [[*map(_cell, row)] + [""] * (len(header) - len(row)) for row in rows]
    widths = [max(len(line[k]) for line in [list(header), *cells]) for k in range(len(header))]
    widths[0] += 1
    lines = [title, _line(header, widths), "-+-".join("-" * w for w in widths)]
    return "\n".join(lines + [_line(row, widths) for row in cells])


def _for_a_while(entry: Callable[[], object] | SelfTimed, least: float) -> list[float]:
    times = [_once(entry)]
    while sum(times) < least:
        times.append(_once(entry))
    return times


def _once(entry: Callable[[], object] | SelfTimed) -> float:
    if isinstance(entry, SelfTimed):
        return entry.function()
    start = time.perf_counter()
    entry()
    return time.perf_counter() - start


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 1e3 else f"{value:.0f}"
    return str(value)


def _line(row: Sequence[str], widths: Sequence[int]) -> str:
    first, *others = (
        text.ljust(w) if k == 0 else text.rjust(w)
        for k, (text, w) in enumerate(zip(row, widths, strict=True))
    )
    return " | ".join([first, *others]).rstrip()
