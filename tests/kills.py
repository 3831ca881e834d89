"""Runs that are killed at random moments, and go on: ``python -m tests.kills`` (50 kills of every engine).

Every run is a process of its own, which ends by SIGKILL wherever it is (in a sweep, in a warmup, in the
middle of a block, while its answer is written), or whose disk is full, or whose file is cut off afterwards.
What must hold: the file can be read, every block that was reported as saved is in it, and the same call
ends with the bits of a run that was never stopped.
"""

from __future__ import annotations

import argparse
import hashlib
import mmap
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.errors import CheckpointError, DamagedFileError
from bayesmc.storage import Blocks, Saver, open_image

#: seconds between blocks
EVERY = 0.01
#: where in the memory that a run shares its answer begins
_SAID = 512


def mixture() -> tuple[Any, dict[str, Any]]:
    net = bmc.BayesNet("mixture", plates={"cluster": 2, "point": 40})
    net.add("mean", bmc.Normal(0.0, 10.0), plates="cluster")
    net.add("weight", bmc.Beta(1.0, 1.0))
    net.add("label", lambda weight: bmc.Bernoulli(weight), plates="point")
    net.add("x", lambda label, mean: bmc.Normal(mean[label], 1.0), plates="point")
    rng = np.random.default_rng(1)
    return net, {"x": np.r_[rng.normal(-2.0, 1.0, 15), rng.normal(2.0, 1.0, 25)]}


def regression() -> tuple[Any, dict[str, Any]]:
    rng = np.random.default_rng(2)
    design = rng.normal(size=(30, 2))
    net = bmc.BayesNet("regression", plates={"row": 30})
    net.add("slope", bmc.MvNormal(np.zeros(2), np.eye(2)))
    net.add("scale", bmc.HalfCauchy(1.0))
    net.add(
        "y", lambda slope, scale: bmc.StudentT(4.0, np.vecdot(design, slope), scale), plates="row"
    )
    return net, {"y": design @ [1.0, -2.0] + rng.normal(size=30)}


def walk(static: bool, steps: int) -> tuple[Any, dict[str, Any]]:
    dbn = bmc.DynamicBayesNet("walk")
    if static:
        dbn.add_static("precision", bmc.Gamma(2.0, 1.0))
    dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    if static:
        dbn.add("y", lambda x, precision: bmc.Normal(x, precision**-0.5))
    else:
        dbn.add("y", lambda x: bmc.StudentT(4.0, x, 0.5))
    return dbn, {"y": np.random.default_rng(3).normal(size=steps).cumsum() * 0.5}


@dataclass(frozen=True)
class Case:
    """A question, and how it is asked."""

    make: Callable[[], tuple[Any, Any]]
    engine: Any
    ask: Callable[..., Any] = bmc.infer
    options: dict[str, Any] = field(default_factory=dict)

    def run(self, path: Path | None) -> Any:
        net, seen = self.make()
        saved = {} if path is None else {"checkpoint": bmc.CheckpointFile(path, every=EVERY)}
        options = {n: v for n, v in self.options.items() if path is not None or v != "file"}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return self.ask(net, seen, engine=self.engine, rng=7, **options, **saved)


def cases(size: float = 1.0) -> dict[str, Case]:
    """One of every kind; ``size`` times as long as in the trial."""

    def many(count: int) -> int:
        return max(1, round(size * count))

    def series() -> tuple[Any, dict[str, Any]]:
        return walk(False, many(1500))

    def several() -> tuple[Any, list[dict[str, Any]]]:
        dbn, seen = walk(False, many(700))
        return dbn, [seen, {"y": seen["y"][: many(400)]}]

    filter_ = bmc.ParticleFilter(300, compiled=False)
    particle = bmc.ParticleGibbs(many(60), warmup=many(30), chains=2, particles=20)
    metropolis = bmc.ParticleMetropolis(many(60), warmup=many(60), chains=2, particles=30)
    return {
        "Gibbs": Case(mixture, bmc.Gibbs(many(600), warmup=many(200))),
        "Hamiltonian": Case(regression, bmc.HamiltonianMonteCarlo(many(150), warmup=many(150))),
        "Metropolis": Case(regression, bmc.MetropolisHastings(many(500), warmup=many(200))),
        "weighting": Case(
            lambda: regression(), bmc.LikelihoodWeighting(many(250_000)), options={"keep": "draws"}
        ),
        "particle filter": Case(series, filter_, bmc.filter),
        "islands": Case(series, bmc.IslandFilter(filter_, islands=3, threshold=0.99), bmc.filter),
        "particle Gibbs": Case(lambda: walk(True, 12), particle),
        "particle Metropolis": Case(lambda: walk(True, 12), metropolis),
        "particle filter, late": Case(series, bmc.ParticleFilter(100, delay=4), bmc.filter),
        "Gibbs, in groups": Case(
            mixture, bmc.Gibbs(many(600), warmup=many(200), chains=4, groups=2)
        ),
        "Hamiltonian, in groups, in the file": Case(
            regression,
            bmc.HamiltonianMonteCarlo(many(60), warmup=many(60), chains=4, groups=2),
            options={"keep": "file"},
        ),
        "several series": Case(several, filter_, bmc.filter),
        "Gibbs, in the file": Case(
            mixture, bmc.Gibbs(many(600), warmup=many(200)), options={"keep": "file"}
        ),
        "Gibbs, summed": Case(
            mixture, bmc.Gibbs(many(600), warmup=many(200)), options={"keep": "summaries"}
        ),
    }


def bits(answer: Any) -> str:
    """All that an answer says, to the last bit; all answers of a list."""
    if isinstance(answer, list):
        return " ".join(map(bits, answer))
    found = hashlib.sha256()

    def add(value: Any) -> None:
        found.update(np.ascontiguousarray(np.asarray(value, dtype=float)).tobytes())

    for name in answer.names:
        add(answer.mean(name))
        add(answer.var(name))
        if hasattr(answer, "_stored"):
            add(np.asarray(answer[name]))
        else:
            add(answer.mcse(name))
    for name in ("log_weights", "log_marginal_increments", "weight_ess", "row_ranks"):
        value = getattr(answer, name, None)
        add(np.nan if value is None else value)
    add(np.nan if answer.log_marginal_likelihood is None else answer.log_marginal_likelihood)
    return found.hexdigest()


class Child:
    """A process that runs a case; what it saved it counts where this one can see."""

    def __init__(self, case: Case, path: Path | None, limit: int | None = None) -> None:
        self._shared = mmap.mmap(-1, 4096)
        self.path = path
        sys.stdout.flush()
        self.pid = os.fork()
        if not self.pid:
            self._run(case, limit)

    @property
    def saved(self) -> dict[str, int]:
        """Blocks that are saved for sure, by the name of the file."""
        text = self._shared[:_SAID].rstrip(b"\0").decode()
        return {line.split()[0]: int(line.split()[1]) for line in text.splitlines()}

    @property
    def said(self) -> str:
        """The bits of its answer, or its error."""
        return self._shared[_SAID:].rstrip(b"\0").decode()

    def wait(self) -> int:
        """Its exit status."""
        return os.waitpid(self.pid, 0)[1]

    def killed_after(self, seconds: float) -> bool:
        """Whether it was killed before it had ended."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if os.waitpid(self.pid, os.WNOHANG)[0]:
                return False
            time.sleep(0.0005)
        os.kill(self.pid, signal.SIGKILL)
        return os.WIFSIGNALED(self.wait())

    def _run(self, case: Case, limit: int | None) -> None:
        plain, counts = Saver.save, dict[str, int]()

        def save(saver: Saver, rows: Any, state: Any) -> None:
            plain(saver, rows, state)
            counts[saver.path.name] = saver.blocks.count
            text = "".join(f"{name} {count:06d}\n" for name, count in counts.items())
            self._shared[: len(text)] = text.encode()

        status = 1
        try:
            Saver.save = save  # type: ignore[method-assign]
            if limit is not None:
                resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
            told = bits(case.run(self.path))
            status = 0
        except BaseException as error:
            told = f"{type(error).__name__}: {error}"
            if not isinstance(error, (CheckpointError, DamagedFileError)):
                traceback.print_exc()
        data = told.encode()[:3000]
        self._shared[_SAID : _SAID + len(data)] = data
        os._exit(status)


def files(path: Path) -> list[Path]:
    """All that a run has left: its own file and those of its parts."""
    return [p for p in sorted(path.parent.rglob("*")) if p.is_file() and not p.name.startswith(".")]


def clear(path: Path) -> None:
    """Leave nothing of a run."""
    for own in path.parent.iterdir():
        shutil.rmtree(own) if own.is_dir() else own.unlink()


def check_files(path: Path, saved: dict[str, int]) -> None:
    """All files can be read, with all blocks that were saved."""
    found = {own.name: own for own in files(path)}
    kinds = {name: open_image(own).attributes["kind"] for name, own in found.items()}
    ended = kinds.get(path.name) == "answer"  # then those of groups are gone
    for name, count in saved.items():
        assert ended or name in found, f"{name}: {count} blocks are gone"
    for name, own in found.items():
        if kinds[name] == "run":
            there, count = Blocks(own).count, saved.get(name, 0)
            assert there >= count, f"{own}: {there} blocks of {count}"
        check_tree(own)


def check_tree(path: Path) -> None:
    try:
        import xarray
    except ImportError:
        return
    with xarray.open_datatree(path) as tree:
        assert "bayesmc" in tree.children


def trial(case: Case, path: Path, kills: int, rng: np.random.Generator) -> dict[str, Any]:
    """Kill a run again and again.

    Returns
    -------
    dict
        How many runs ended, and whether all of them with the bits of one that was never stopped.
    """
    whole = Child(case, None)
    begun = time.monotonic()
    assert whole.wait() == 0, whole.said
    once = Child(case, path)
    assert once.wait() == 0, once.said
    seconds = (time.monotonic() - begun) / 2
    wanted = whole.said
    same, ended, done, resumed = [once.said == wanted], 1, 0, 0
    clear(path)
    while done < kills:
        child = Child(case, path)
        if child.killed_after(float(rng.uniform(0.0, 0.7 * seconds))):
            done += 1
            check_files(path, child.saved)
            resumed += path.exists()
            continue
        same.append(child.said == wanted)
        ended += 1
        clear(path)
    last = Child(case, path)
    assert last.wait() == 0, last.said
    again = Child(case, path)  # which reads the answer
    assert again.wait() == 0, again.said
    same += [last.said == wanted, again.said == wanted]
    size = sum(own.stat().st_size for own in files(path))
    clear(path)
    return {"kills": done, "ended": ended + 1, "resumed": resumed, "same": all(same), "bytes": size}


def full_disk(case: Case, path: Path, rng: np.random.Generator, times: int) -> bool:
    """Whether a run whose disk is full says so, keeps its file, and goes on to the same bits."""
    whole = Child(case, path)
    assert whole.wait() == 0, whole.said
    left = len(files(path))
    largest, wanted = max(own.stat().st_size for own in files(path)), whole.said
    clear(path)
    for _ in range(times):
        limit = int(rng.uniform(0.05, 1.0) * largest)
        child = Child(case, path, limit)
        if child.wait():
            assert child.said.startswith("CheckpointError"), child.said
            check_files(path, child.saved)
        ended = Child(case, path)
        assert ended.wait() == 0, ended.said
        if ended.said != wanted or len(list(path.parent.iterdir())) > 1 or len(files(path)) > left:
            return False
        clear(path)
    return True


def cut_off(case: Case, path: Path, rng: np.random.Generator, times: int) -> tuple[bool, int]:
    """Whether a file that was cut off is refused, and its whole blocks gone on with; how many there were."""
    whole = Child(case, None)
    assert whole.wait() == 0, whole.said
    kept = 0
    for _ in range(times):
        while not (begun := [own for own in files(path) if in_blocks(own)]):
            clear(path)
            Child(case, path).killed_after(float(rng.uniform(0.2, 1.5)))
        target = begun[int(rng.integers(len(begun)))]
        image = open_image(target)  # what lies behind its end was on its way, and is no loss
        os.truncate(target, int(rng.integers(image.size, image.end)))
        child = Child(case, path)
        if child.wait() == 0 or not child.said.startswith("DamagedFileError"):
            return False, kept
        kept += Blocks(target, repair=True).count
        net, seen = case.make()
        file = bmc.CheckpointFile(path, every=EVERY, repair=True)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            answer = case.ask(net, seen, engine=case.engine, rng=7, **case.options, checkpoint=file)
        if bits(answer) != whole.said:
            return False, kept
        clear(path)
    return True, kept


def in_blocks(path: Path) -> bool:
    """Whether a file is of a run that goes on, with some blocks."""
    return open_image(path).attributes["kind"] == "run" and Blocks(path).count >= 3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument(
        "--folder", default=None, help="where files go; a temporary folder by default"
    )
    parser.add_argument("--only", default=None)
    given = parser.parse_args()
    rng = np.random.default_rng(given.seed)
    with tempfile.TemporaryDirectory(dir=given.folder) as folder:
        path = Path(folder) / "run.nc"
        for name, case in cases().items():
            if given.only is not None and name != given.only:
                continue
            found = trial(case, path, given.kills, rng)
            full = full_disk(case, path, rng, 5)
            cut, kept = cut_off(case, path, rng, 5)
            print(
                f"{name:36s} {found['kills']} kills, {found['resumed']} with a file; "
                f"{found['ended']} runs ended, "
                f"bits {'equal' if found['same'] else 'DIFFER'}; disk full: {'equal' if full else 'DIFFER'}; "
                f"cut off: {'equal' if cut else 'DIFFER'} ({kept} blocks kept)",
                flush=True,
            )


if __name__ == "__main__":
    main()
