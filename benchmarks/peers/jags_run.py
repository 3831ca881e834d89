"""JAGS as a subprocess: a model, data and a command script in; draws and seconds out.

It needs the program ``jags`` (Debian package ``jags``) and imports neither bayesmc nor a peer's
Python. Models stand beside this file as ``jags_*.bug``; that of a discrete network is written by
:func:`network_model`.
"""

from __future__ import annotations

import resource
import shutil
import subprocess
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent


@dataclass(frozen=True)
class Run:
    """One run of JAGS.

    ``seconds`` is the whole process, start and writing of draws included; ``sampling`` is the kept
    sweeps alone; ``cpu`` is what the process and the reading of its draws used of a processor, which
    others on the machine do not lengthen. ``draws`` maps names such as ``theta[3]`` to (chain, draw).
    """

    seconds: float
    sampling: float
    cpu: float
    draws: dict[str, np.ndarray]


def installed() -> bool:
    """Is there a program ``jags``?"""
    return shutil.which("jags") is not None


def run(
    model: str,
    data: Mapping[str, Any],
    monitors: Sequence[str],
    *,
    chains: int = 4,
    warmup: int = 1000,
    draws: int = 1000,
    thin: int = 1,
    starts: Mapping[str, Any] | None = None,
    seed: int = 1,
    modules: Sequence[str] = (),
) -> Run:
    """Run a model's text; ``draws`` are sweeps after warmup, of which every ``thin``-th is kept.

    ``modules`` are JAGS's own to load beside the usual ones, such as ``glm``.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "model.bug").write_text(model)
        (folder / "data.R").write_text(_dump(data))
        lines = [f"load {module}" for module in modules]
        lines += ['model in "model.bug"', 'data in "data.R"', f"compile, nchains({chains})"]
        for chain in range(1, chains + 1):
            own = {".RNG.name": "base::Mersenne-Twister", ".RNG.seed": 1000 * seed + chain}
            (folder / f"start{chain}.R").write_text(_dump({**(starts or {}), **own}))
            lines.append(f'parameters in "start{chain}.R", chain({chain})')
        lines += ["initialize", f"update {warmup}"]
        lines += [f"monitor {node}, thin({thin})" for node in monitors]
        lines += [f"update {draws}", "pwd", "coda *", "exit"]
        (folder / "script.txt").write_text("\n".join(lines) + "\n")
        before = _used()
        seconds, sampling = _watch(folder)
        found = _coda(folder, chains)
        return Run(seconds, sampling, _used() - before, found)


def packaged(name: str) -> str:
    """The text of ``jags_<name>.bug``."""
    return (HERE / f"jags_{name}.bug").read_text()


def network_model(
    nodes: Sequence[tuple[str, int, tuple[int, ...], np.ndarray]], evidence: Mapping[str, int]
) -> tuple[str, dict[str, Any]]:
    """A discrete network as text and data; states count from 1.

    ``nodes`` are ``(name, card, parent indices, table)`` as the discrete floors take them.
    """
    lines, data = ["model {"], {}
    for name, _, parents, table in nodes:
        index = "".join(f"{nodes[p][0]}, " for p in parents)
        row = f"p.{name}[{index}1:{table.shape[-1]}]" if parents else f"p.{name}"
        lines.append(f"  {name} ~ dcat({row})")
        data[f"p.{name}"] = table
    data.update({name: code + 1 for name, code in evidence.items()})
    return "\n".join([*lines, "}"]) + "\n", data


def _watch(folder: Path) -> tuple[float, float]:
    """Seconds of the process, and from the last "Updating" to the working directory's name."""
    start = time.perf_counter()
    process = subprocess.Popen(
        ["stdbuf", "-oL", "jags", "script.txt"],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert process.stdout is not None
    said, began, ended = [], start, start
    for line in process.stdout:
        said.append(line)
        if line.startswith("Updating"):
            began = time.perf_counter()
        elif folder.name in line:
            ended = time.perf_counter()
    process.stdout.close()
    if process.wait() != 0 or not (folder / "CODAindex.txt").exists():
        raise RuntimeError("JAGS failed:\n" + "".join(said))
    return time.perf_counter() - start, ended - began


def _used() -> float:
    """Seconds of processor time of this process and of its children that have ended."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def _coda(folder: Path, chains: int) -> dict[str, np.ndarray]:
    places = [line.split() for line in (folder / "CODAindex.txt").read_text().splitlines()]
    values = np.stack(
        [np.loadtxt(folder / f"CODAchain{chain + 1}.txt", usecols=1) for chain in range(chains)]
    )
    return {name: values[:, int(a) - 1 : int(b)] for name, a, b in places}


def _dump(values: Mapping[str, Any]) -> str:
    """R's dump format; arrays are column-major."""
    return "\n".join(f'"{name}" <- {_literal(value)}' for name, value in values.items()) + "\n"


def _literal(value: Any) -> str:
    if isinstance(value, str):
        return f'"{value}"'
    array = np.asarray(value)
    text = ", ".join("NA" if x != x else repr(x) for x in array.ravel(order="F").tolist())
    if array.ndim == 0:
        return text
    if array.ndim == 1:
        return f"c({text})"
    return f"structure(c({text}), .Dim = c({', '.join(map(str, array.shape))}))"
