"""Runs that are stopped anywhere go on to the same bits, in the file that is theirs and in no other."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import (
    CheckpointError,
    DamagedFileError,
    FileFormatError,
    UnsupportedError,
)
from bayesmc.storage import Blocks, Saver
from tests import kills
from tests.workers.test_units import Elsewhere

pytest.importorskip("h5netcdf", reason="needs the extra netcdf")

CASES = kills.cases(0.05)
UNITS = (
    "Gibbs, in groups",
    "Hamiltonian, in groups, in the file",
    "several series",
    "particle filter, late",
)


class Stopped(BaseException):
    """The end of a process."""


@contextmanager
def stopped_after(saves: int) -> Iterator[None]:
    """Let nothing go on after so many blocks."""
    plain, count = Saver.save, 0

    def save(self: Saver, rows: Any, state: Any) -> None:
        nonlocal count
        plain(self, rows, state)
        count += 1
        if count == saves:
            raise Stopped

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Saver, "save", save)
        yield


@pytest.fixture(autouse=True)
def always(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kills, "EVERY", 0.0)


@functools.cache
def reference(name: str) -> str:
    return kills.bits(CASES[name].run(None))


@pytest.mark.parametrize(
    ("name", "saves"), [(n, k) for n in CASES for k in (2, 4) if k == 4 or n not in UNITS]
)
def test_the_same_bits(name: str, saves: int, tmp_path: Path) -> None:
    path, case = tmp_path / "run.nc", CASES[name]
    with pytest.raises(Stopped), stopped_after(saves if name != "weighting" else 1):
        case.run(path)
    assert kills.bits(case.run(path)) == reference(name)
    assert kills.bits(case.run(path)) == reference(name)  # the answer that is in the file
    each = sorted(path.iterdir()) if path.is_dir() else None
    loaded = bmc.load(path) if each is None else [bmc.load(own) for own in each]
    assert kills.bits(loaded) == reference(name)
    assert [p.name for p in tmp_path.iterdir()] == ["run.nc"]  # what groups kept is in it


@pytest.mark.parametrize("name", ["Gibbs", "Gibbs, in groups", "particle filter, late"])
def test_a_fault_in_the_state_shows(name: str, tmp_path: Path) -> None:
    path, case = tmp_path / "run.nc", CASES[name]
    with pytest.raises(Stopped), stopped_after(9):
        case.run(path)
    with pytest.MonkeyPatch.context() as patch:  # random numbers that begin anew
        plain = Saver.__init__

        def forgetful(self: Saver, *args: Any, **options: Any) -> None:
            plain(self, *args, **options)
            if self.state is not None:
                self.state["generator"]["state"]["state"][0] += 1

        patch.setattr(Saver, "__init__", forgetful)
        assert kills.bits(case.run(path)) != reference(name)


@pytest.fixture
def workers() -> Iterator[Any]:
    with ThreadPoolExecutor(2) as pool:
        yield pool


@pytest.mark.parametrize(("name", "saves"), [("Gibbs, in groups", 65), ("several series", 45)])
def test_units_of_workers_go_on(name: str, saves: int, workers: Any, tmp_path: Path) -> None:
    path, case = tmp_path / "run.nc", CASES[name]
    with pytest.raises(Stopped), stopped_after(saves):  # in the second unit
        case.run(path)
    left = {p.name for p in kills.files(path)}
    assert len(left) > 1  # of the run itself, or of another series
    case = replace(case, options={"executor": workers})
    assert kills.bits(case.run(path)) == reference(name)
    assert kills.bits(case.run(path)) == reference(name)


class Losing(Elsewhere):
    """Loses the first worker after it has saved so many blocks."""

    def __init__(self, saves: int) -> None:
        super().__init__()
        self.saves = saves

    def submit(self, fn: Any, /, *args: Any, **options: Any) -> Future[Any]:
        if self.sent:
            return super().submit(fn, *args, **options)
        self.sent += 1
        found: Future[Any] = Future()
        with pytest.raises(Stopped), stopped_after(self.saves):
            fn(*args, **options)
        found.set_exception(ConnectionError("the worker is gone"))
        return found


@pytest.mark.parametrize("name", ["Gibbs, in groups", "several series"])
def test_a_lost_unit_goes_on_from_its_file(name: str, tmp_path: Path) -> None:
    pytest.importorskip("cloudpickle", reason="units travel by cloudpickle: bayesmc[workers]")
    counts = []
    for k, executor in enumerate((Elsewhere(), Losing(25))):
        (tmp_path / str(k)).mkdir()
        saved, plain = [], Saver.save

        def save(
            self: Saver, rows: Any, state: Any, saved: Any = saved, plain: Any = plain
        ) -> None:
            saved.append(self.path)
            plain(self, rows, state)

        case = replace(CASES[name], options={"executor": executor})
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Saver, "save", save)
            assert kills.bits(case.run(tmp_path / str(k) / "run.nc")) == reference(name)
        counts.append(len(saved))
    assert counts[0] > 50 and counts[1] <= counts[0] + 1  # and not 25 blocks more


def test_groups_so_far(tmp_path: Path) -> None:
    path, case = tmp_path / "run.nc", CASES["Gibbs, in groups"]
    with pytest.raises(Stopped), stopped_after(65):  # in the second group
        case.run(path)
    assert {p.name for p in tmp_path.iterdir()} == {"run.nc", "run.g0.nc", "run.g1.nc"}
    found, first = bmc.load(path), bmc.load(tmp_path / "run.g0.nc")
    whole = case.run(path)
    chains, draws = found["mean"].shape[:2]
    np.testing.assert_array_equal(found["mean"], whole["mean"][:chains, :draws])
    np.testing.assert_array_equal(first["mean"], whole["mean"][:2])


def test_a_file_of_another_group_is_refused(tmp_path: Path) -> None:
    path, case = tmp_path / "run.nc", CASES["Gibbs, in groups"]
    with pytest.raises(Stopped), stopped_after(5):
        case.run(path)
    path.unlink()  # the run is begun anew, and its groups are still there
    with pytest.raises(CheckpointError, match=r"run\.g0\.nc.*seed \(rng=\) was 7 and is 8"):
        bmc.infer(*case.make(), engine=case.engine, rng=8, checkpoint=path)
    group = tmp_path / "run.g0.nc"
    group.write_bytes(group.read_bytes()[:-100])
    path.unlink()
    with pytest.raises(DamagedFileError, match=r"CheckpointFile\('.*run\.nc', repair=True"):
        case.run(path)


def test_a_folder_of_series(tmp_path: Path) -> None:
    folder, case = tmp_path / "runs", CASES["several series"]
    dbn, series = case.make()
    found = bmc.filter(dbn, series, engine=case.engine, rng=7, checkpoint=folder)
    assert kills.bits(found) == reference("several series")
    (folder / "series1.nc").unlink()
    again = bmc.filter(
        dbn, series, checkpoint=folder
    )  # engine and seed are those of the other file
    assert kills.bits(again) == reference("several series")
    with pytest.raises(CheckpointError, match="series 1: .*the observations of 'y' is another"):
        bmc.filter(dbn, [series[0], {"y": series[1]["y"] + 1}], checkpoint=folder)
    for wrong, series_, words in (
        (folder / "series0.nc", series, "give the path of a folder"),
        (folder, series[0], "give the path of a file"),
        (tmp_path / "nowhere" / "runs", series, "the folder cannot be made"),
    ):
        with pytest.raises(CheckpointError, match=words):
            bmc.filter(dbn, series_, checkpoint=wrong)
    with pytest.raises(FileFormatError, match="that is a folder"):
        bmc.load(folder)


def test_states_that_are_not_even_stay_right(tmp_path: Path) -> None:
    made = bmc.BayesNet()
    made.add("k", bmc.Categorical([0.2, 0.3, 0.5]), states=(1, 2, 5))
    made.add("y", lambda k: bmc.Normal(k, 2.0))
    asked = {"engine": bmc.Gibbs(30, warmup=5, chains=2, groups=2), "rng": 0}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        plain = bmc.infer(made, {"y": 3.0}, **asked)
        path = tmp_path / "run.nc"
        found = bmc.infer(made, {"y": 3.0}, keep="file", checkpoint=path, **asked)
    np.testing.assert_array_equal(found["k"], plain["k"])
    np.testing.assert_array_equal(bmc.load(path)["k"], plain["k"])


def net(scale: float = 1.0, plate: int = 3) -> bmc.BayesNet:
    made = bmc.BayesNet(plates={"i": plate})
    made.add("x", bmc.Normal(0.0, 1.0))
    made.add("y", lambda x: bmc.Normal(x, scale), plates="i")
    return made


Y = [0.3, 0.1, np.nan]
GIBBS = bmc.Gibbs(20, warmup=5, chains=2)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"net": net(2.0)}, "the density of node 'y' is another one"),
        ({"y": [0.3, 0.2, np.nan]}, "the evidence of 'y' is another one"),
        ({"y": [0.3, 0.1, 0.0]}, "the evidence of 'y' is another one"),
        ({"net": net(plate=4), "y": [*Y, 0.0]}, r"sizes of plates is another one"),
        ({"engine": bmc.Gibbs(30, warmup=5, chains=2)}, r"Gibbs\(draws=\) was 20 and is 30 now"),
        ({"engine": bmc.MetropolisHastings(20)}, "the engine was Gibbs and is MetropolisHastings"),
        ({"rng": 2}, r"the seed \(rng=\) was 1 and is 2 now"),
        ({"keep": ["x"]}, r"keep= was 'draws' and is \['x'\] now"),
    ],
)
def test_what_differs_is_said(change: dict[str, Any], words: str, tmp_path: Path) -> None:
    path = tmp_path / "run.nc"

    def ask(net: Any, y: Any, engine: Any, rng: Any, keep: Any) -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return bmc.infer(net, {"y": y}, engine=engine, rng=rng, keep=keep, checkpoint=path)

    first = {"net": net(), "y": Y, "engine": GIBBS, "rng": 1, "keep": "draws"}
    found = ask(**first)
    again = {**first, "net": net(), "engine": None, "rng": None}  # declared anew; the file's own
    assert kills.bits(ask(**again)) == kills.bits(found)
    before = path.read_bytes()
    with pytest.raises(CheckpointError, match=words):
        ask(**{**first, **change})
    assert path.read_bytes() == before


def test_a_version_is_part_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "run.nc"
    bmc.infer(net(), {"y": Y}, checkpoint=path)
    monkeypatch.setattr(np, "__version__", "3.0.0")
    with pytest.raises(CheckpointError, match=r"version of numpy was .* and is 3\.0\.0 now"):
        bmc.infer(net(), {"y": Y}, checkpoint=path)


def test_a_file_that_was_cut_off(tmp_path: Path) -> None:
    path, case = tmp_path / "run.nc", CASES["Metropolis"]
    with pytest.raises(Stopped), stopped_after(9):
        case.run(path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(DamagedFileError, match=r"8 of its blocks are whole.*repair=True"):
        case.run(path)
    with pytest.raises(DamagedFileError):
        bmc.load(path)
    made, seen = case.make()
    file = bmc.CheckpointFile(path, repair=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = bmc.infer(made, seen, engine=case.engine, rng=7, checkpoint=file)
    assert kills.bits(found) == reference("Metropolis")


def test_draws_so_far(tmp_path: Path) -> None:
    path, case = tmp_path / "run.nc", CASES["Gibbs"]
    with pytest.raises(Stopped), stopped_after(2):
        case.run(path)
    with pytest.raises(UnsupportedError, match="no answer yet"):  # the warmup
        bmc.load(path)
    with pytest.raises(Stopped), stopped_after(9):
        case.run(path)
    found = bmc.load(path)
    whole = case.run(path)
    draws = found["mean"].shape[1]
    assert 0 < draws < whole["mean"].shape[1]
    np.testing.assert_array_equal(found["mean"], whole["mean"][:, :draws])


def test_draws_stay_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "run.nc"
    asked = {"engine": bmc.LikelihoodWeighting(70_000), "rng": 0}
    found = bmc.infer(net(), {"y": Y}, keep={"file": ["x"]}, checkpoint=path, **asked)
    assert isinstance(found._stored["x"], np.memmap) and isinstance(found.log_weights, np.memmap)
    plain = bmc.infer(net(), {"y": Y}, keep=["x"], **asked)
    np.testing.assert_array_equal(found["x"], plain["x"])
    np.testing.assert_allclose(found.mean("x"), plain.mean("x"), rtol=1e-12)
    np.testing.assert_allclose(found.weight_ess, plain.weight_ess, rtol=1e-9)


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"keep": "file"}, ValueError, 'in which file.*checkpoint="run.nc"'),
        (
            {"keep": "file", "checkpoint": "?", "engine": bmc.Exact()},
            UnsupportedError,
            "Exact makes no draws",
        ),
        ({"checkpoint": 3}, TypeError, "give the path of a file"),
        ({"checkpoint": "nowhere/run.nc"}, CheckpointError, "there is no folder"),
    ],
)
def test_wrong_words(
    options: dict[str, Any], error: type[Exception], words: str, tmp_path: Path
) -> None:
    path = options.get("checkpoint")
    given = {**options, "checkpoint": tmp_path / path} if isinstance(path, str) else options
    if path == "?":
        given["checkpoint"] = tmp_path / "run.nc"
    with pytest.raises(error, match=words):
        bmc.infer(net(), {"y": Y}, **given)


def test_a_posterior_that_was_saved_is_no_run(tmp_path: Path) -> None:
    path = tmp_path / "answer.nc"
    bmc.infer(net(), {"y": Y}).save(path)
    with pytest.raises(CheckpointError, match="an answer that was saved"):
        bmc.infer(net(), {"y": Y}, checkpoint=path)
    with pytest.raises(ValueError, match="seconds, 0 or more"):
        bmc.CheckpointFile(path, every=-1)


def test_a_smoothed_series_is_kept(tmp_path: Path) -> None:
    dbn, seen = kills.walk(False, 12)
    engine = bmc.ParticleFilter(60)
    wanted = bmc.smooth(dbn, seen, engine=engine, rng=1).mean("x")
    path = tmp_path / "smooth.nc"
    first = bmc.smooth(dbn, seen, engine=engine, rng=1, checkpoint=path)
    with pytest.MonkeyPatch.context() as patch:  # the second call reads
        patch.setattr(bmc.ParticleFilter, "smooth", None)
        again = bmc.smooth(dbn, seen, checkpoint=path)
    assert np.array_equal(first.mean("x"), wanted) and np.array_equal(again.mean("x"), wanted)
    with pytest.raises(CheckpointError, match="lag= was None and is 2 now"):
        bmc.smooth(dbn, seen, engine=engine, rng=1, lag=2, checkpoint=path)
    with pytest.raises(CheckpointError, match="belongs to a call of smooth"):
        bmc.filter(dbn, seen, engine=engine, rng=1, checkpoint=path)
    several = [seen, {"y": seen["y"][:5]}]
    answers = bmc.smooth(dbn, several, engine=engine, rng=1, checkpoint=tmp_path / "all")
    alone = bmc.smooth(dbn, several, engine=engine, rng=1)
    assert all(
        np.array_equal(a.mean("x"), b.mean("x")) for a, b in zip(answers, alone, strict=True)
    )
    assert sorted(p.name for p in (tmp_path / "all").iterdir()) == ["series0.nc", "series1.nc"]


def test_islands_of_workers_go_on_anywhere(tmp_path: Path) -> None:
    """Begun by threads, and gone on with here, where particles lie in no shared memory."""
    dbn, seen = kills.walk(False, 100)
    engine = bmc.IslandFilter(bmc.ParticleFilter(60, compiled=False), islands=3, threshold=0.99)
    wanted = kills.bits(bmc.filter(dbn, seen, engine=engine, rng=2))
    file = bmc.CheckpointFile(tmp_path / "islands.nc", every=0)
    with ThreadPoolExecutor(2) as threads, stopped_after(4), pytest.raises(Stopped):
        bmc.filter(dbn, seen, engine=engine, rng=2, checkpoint=file, executor=threads)
    assert Blocks(tmp_path / "islands.nc").count == 4
    found = bmc.filter(dbn, seen, engine=engine, checkpoint=file)
    assert kills.bits(found) == wanted and len(found.exchanged)
