"""Runs that are stopped anywhere go on to the same bits, in the file that is theirs and in no other."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import CheckpointError, DamagedFileError, UnsupportedError
from bayesmc.storage import Saver
from tests import kills

pytest.importorskip("h5netcdf", reason="needs the extra netcdf")

CASES = kills.cases(0.05)


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


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("saves", [2, 4])
def test_the_same_bits(name: str, saves: int, tmp_path: Path) -> None:
    path, case = tmp_path / "run.nc", CASES[name]
    with pytest.raises(Stopped), stopped_after(saves if name != "weighting" else 1):
        case.run(path)
    assert kills.bits(case.run(path)) == reference(name)
    assert kills.bits(case.run(path)) == reference(name)  # the answer that is in the file
    assert kills.bits(bmc.load(path)) == reference(name)
    assert [p.name for p in tmp_path.iterdir()] == ["run.nc"]


def test_a_fault_in_the_state_shows(tmp_path: Path) -> None:
    path, case = tmp_path / "run.nc", CASES["Gibbs"]
    with pytest.raises(Stopped), stopped_after(9):
        case.run(path)
    with pytest.MonkeyPatch.context() as patch:  # random numbers that begin anew
        plain = Saver.__init__

        def forgetful(self: Saver, *args: Any, **options: Any) -> None:
            plain(self, *args, **options)
            if self.state is not None:
                self.state["generator"]["state"]["state"][0] += 1

        patch.setattr(Saver, "__init__", forgetful)
        assert kills.bits(case.run(path)) != reference("Gibbs")


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
