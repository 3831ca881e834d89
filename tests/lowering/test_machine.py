"""The cache of machine code: private, checked, written all or nothing; and the library without a compiler."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bayesmc.errors import TraceError
from bayesmc.expression import elementwise, leaf
from bayesmc.lowering import compiled, machine

pytest.importorskip("llvmlite", reason="llvmlite is not installed")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "bayesmc" / "machine-code"


def run() -> bool:
    """Compile something and look at what it gives; whether it came from the cache."""
    machine.loaded.cache_clear()
    made = compiled([elementwise(np.exp, leaf("x", (3,)))])
    x = np.arange(6.0).reshape(2, 3)
    np.testing.assert_allclose(made({"x": x})[0], np.exp(x), rtol=1e-15)
    return made.way(frozenset("x")).loaded.was_cached


def test_the_second_time_comes_from_the_cache(folder: Path) -> None:
    assert not run()
    assert run()
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    (kept,) = folder.iterdir()
    assert stat.S_IMODE(kept.stat().st_mode) == 0o600


@pytest.mark.parametrize("fault", ["cut", "turned", "empty", "other", "renamed"])
def test_what_is_not_as_it_was_written_is_ignored(folder: Path, fault: str) -> None:
    run()
    (kept,) = folder.iterdir()
    content = kept.read_bytes()
    wrong = {
        "cut": content[:-10],
        "turned": content[:200] + bytes([content[200] ^ 1]) + content[201:],
        "empty": b"",
        "other": b"#!/bin/sh\n" + content,
        "renamed": content,
    }[fault]
    if fault == "renamed":  # of another text
        compiled([elementwise(np.log, leaf("x", (3,)))])({"x": np.ones((2, 3))})
        (other,) = [f for f in folder.iterdir() if f != kept]
        kept.write_bytes(other.read_bytes())
    else:
        kept.write_bytes(wrong)
    assert not run()
    assert run()  # written anew


@pytest.mark.skipif(os.name != "posix", reason="modes of files are those of POSIX")
def test_a_folder_that_others_may_enter_is_not_used(folder: Path) -> None:
    folder.mkdir(parents=True)
    folder.chmod(0o755)
    assert not run()
    assert not run()
    assert not list(folder.iterdir())


def test_a_link_in_the_place_of_the_folder_is_not_used(folder: Path, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir(mode=0o700)
    folder.parent.mkdir(parents=True)
    folder.symlink_to(elsewhere)
    assert not run()
    assert not run()


def test_a_folder_that_cannot_be_written(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: Any, **kwargs: Any) -> Any:
        raise PermissionError("read only")

    monkeypatch.setattr(machine.tempfile, "mkstemp", refuse)
    assert not run()
    assert not run()


def test_no_place_for_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
    assert not run()


def test_the_oldest_half_goes(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "MOST", 4)
    for k in range(12):
        machine.write(f"{k:064d}", b"code")
        assert machine.read(f"{k:064d}") == b"code" or k > 3
    assert len(list(folder.iterdir())) <= 5


SCRIPT = """
import numpy as np
from bayesmc.expression import elementwise, leaf, reduction
from bayesmc.lowering import compiled
for n in range(9, 15):
    x = leaf("x", (n,))
    made = compiled([reduction(np.add, elementwise(np.exp, x), [0])])
    assert np.allclose(made({"x": np.ones((3, n))})[0], n * np.e)
"""


def test_two_processes_at_once(folder: Path) -> None:
    started = [subprocess.Popen([sys.executable, "-c", SCRIPT]) for _ in range(2)]
    assert [p.wait(120) for p in started] == [0, 0]
    names = [f.name for f in folder.iterdir()]
    assert len(names) == 6
    assert not [n for n in names if n.startswith(".")]


def test_without_llvmlite_nothing_is_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    machine.is_available.cache_clear()
    monkeypatch.setattr(machine.importlib.util, "find_spec", lambda name: None)
    try:
        with pytest.raises(TraceError, match=r"bayesmc\[fast\]"):
            compiled([elementwise(np.exp, leaf("x", ()))])
    finally:
        machine.is_available.cache_clear()


def test_llvmlite_is_imported_when_something_is_compiled() -> None:
    script = "import sys, bayesmc, bayesmc.lowering; sys.exit('llvmlite' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0


BROKEN = """
import sys, warnings
import numpy as np
import bayesmc as bmc
net = bmc.BayesNet(plates={"i": 50})
net.add("mu", bmc.Normal(0.0, 5.0))
net.add("y", lambda mu: bmc.StudentT(4.0, mu, 1.0), plates="i")
y = np.random.default_rng(0).normal(size=50)
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    for engine in (bmc.HamiltonianMonteCarlo(), bmc.Gibbs(compiled=True), bmc.Gibbs()):
        assert abs(bmc.infer(net, {"y": y}, engine=engine, rng=0).mean("mu")) < 1.0
words = [str(w.message) for w in caught if "llvmlite" in str(w.message)]
assert len(words) == 1 and "libffi" in words[0] and "reinstall" in words[0], words
"""


def test_llvmlite_that_does_not_load_is_named_and_numpy_does_the_work(tmp_path: Path) -> None:
    (tmp_path / "llvmlite").mkdir()
    (tmp_path / "llvmlite" / "__init__.py").write_text("raise OSError('libffi.so.6 is missing')\n")
    there = os.pathsep.join([str(tmp_path), *(p for p in sys.path if p)])
    found = subprocess.run(
        [sys.executable, "-c", BROKEN],
        env=os.environ | {"PYTHONPATH": there},
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.returncode == 0, found.stderr
