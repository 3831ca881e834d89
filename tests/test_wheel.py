"""The built wheel, installed into an empty environment, answers questions there.

This is what ``pip install`` gives a stranger: no checkout, no extras, no test tools. It needs a
package index; without one it is skipped, except where ``CI`` is set.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
import venv
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.snippets import REPOSITORY

PLUGIN = "_bayesmc_pytestplugin.py"

# pip's words for "no index answers", as against a requirement that does not exist there
UNREACHABLE = ("connection", "timed out", "temporary failure", "name resolution", "network is")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    def build(folder: Path) -> None:
        _pip(sys.executable, "wheel", "--no-deps", "-w", str(folder), str(REPOSITORY))

    (built,) = _once(tmp_path_factory, "wheel", build).glob("*.whl")
    return built


@pytest.fixture(scope="module")
def stranger(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Python of an environment that holds the wheel and what it requires, nothing else."""

    def python(folder: Path) -> Path:
        found = folder / "env" / "bin" / "python"
        return found if found.exists() else folder / "env" / "Scripts" / "python.exe"

    def install(folder: Path) -> None:
        venv.create(folder / "env")  # pip comes from here: no need to install another one
        # most modules of what is required are never imported, and need no bytecode
        into = ("--python", str(python(folder)))
        _pip(sys.executable, *into, "install", "--no-compile", str(wheel))

    return python(_once(tmp_path_factory, "stranger", install))


def _once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], None]) -> Path:
    """A folder that the first of all workers fills; the others wait for it."""
    base = factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / f"once-{name}"
    done, failed = folder / "done", folder / "failed"
    try:
        folder.mkdir()
    except FileExistsError:
        for _ in range(3000):
            if done.exists() or failed.exists():
                break
            time.sleep(0.2)
        if not done.exists():  # the other could not; see why
            folder = factory.mktemp(name)
            make(folder)
        return folder
    try:
        make(folder)
    except BaseException:
        failed.touch()
        raise
    done.touch()
    return folder


def test_wheel_holds_the_package_only(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    assert "bayesmc/py.typed" in names
    assert any(name.endswith("licenses/LICENSE") for name in names)
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"bayesmc", PLUGIN}
    sources = REPOSITORY.glob("bayesmc/**/*.py")
    modules = {path.relative_to(REPOSITORY).as_posix() for path in sources}
    assert modules | {PLUGIN} == {name for name in names if name.endswith(".py")}


#: one question to an engine of each kind, and a file; the README's example runs from the checkout
ASKED = """
import numpy as np, bayesmc as bmc
net = bmc.BayesNet()
net.add("k", bmc.Categorical([0.25, 0.75]), states=("a", "b"))
net.add("x", lambda k: bmc.Normal(np.where(k == "b", 2.0, 0.0), 1.0))
net.add("y", lambda x: bmc.Normal(x, 1.0))
chains = bmc.Gibbs(draws=300, warmup=50, chains=4)
for engine in (bmc.Exact(), bmc.LikelihoodWeighting(5000), chains):
    print(bmc.infer(net, {"y": 1.4}, engine=engine, rng=1).probabilities("k")[1].round(1))
walk = bmc.DynamicBayesNet()
walk.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
walk.add("y", lambda x: bmc.Normal(x, 1.0))
for engine in (bmc.KalmanFilter(), bmc.ParticleFilter(5000)):
    print(bmc.filter(walk, {"y": [0.0, 0.0]}, engine=engine, rng=1).var("x").round(1))
table = bmc.BayesNet()
table.table("k", [], [0.25, 0.75], states=("a", "b"))
bmc.io.write(table, "net.bif")
print(bmc.infer(bmc.io.read("net.bif"), engine=bmc.Exact()).probabilities("k"))
"""


def test_engines_answer_from_the_wheel(stranger: Path, tmp_path: Path) -> None:
    script = tmp_path / "asked.py"
    script.write_text(ASKED, "utf-8")
    ran = _run([str(stranger), "-W", "error", str(script)], tmp_path)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.split("\n") == ["0.8"] * 3 + ["[0.5 0.6]"] * 2 + ["[0.25 0.75]", ""]


def test_the_wheel_is_what_ran(stranger: Path, tmp_path: Path) -> None:
    code = (
        "import bayesmc, importlib.metadata\n"
        "print(bayesmc.__file__)\nprint(importlib.metadata.version('bayesmc'))"
    )
    ran = _run([str(stranger), "-c", code], tmp_path)
    place, version = ran.stdout.split("\n")[:2]
    assert str(REPOSITORY) not in place
    assert "site-packages" in place
    assert version == _project()["version"]


def test_extras_are_absent_and_said_so(stranger: Path, tmp_path: Path) -> None:
    code = (
        "import bayesmc as bmc, bayesmc.plotting as p\n"
        "net = bmc.BayesNet()\nnet.add('x', bmc.Normal(0.0, 1.0))\np.plot_dag(net)"
    )
    ran = _run([str(stranger), "-c", code], tmp_path)
    assert ran.returncode != 0
    assert "pip install 'bayesmc[plot]'" in ran.stderr.splitlines()[-1]


@pytest.mark.thorough
def test_pytest_finds_the_plugin_of_the_wheel(
    stranger: Path, tmp_path_factory: pytest.TempPathFactory, tmp_path: Path
) -> None:
    def install(folder: Path) -> None:  # beside the environment, which other tests want without
        into = ("--python", str(stranger), "install", "--no-compile", "--target", str(folder))
        _pip(sys.executable, *into, "pytest>=8.2")

    found = _once(tmp_path_factory, "pytest", install)
    (tmp_path / "test_mine.py").write_text(
        "from bayesmc.testing import session\n"
        "from bayesmc.testing.verdict import Verdict, counted\n"
        "def test_mine(rng):\n"
        "    assert (session.seed(), session.scaled(10)) == (5, 80)\n"
        "    assert 0 <= rng.random() < 1\n"
        "    assert counted(Verdict('mine', 0.25, []))\n"
    )
    command = [
        str(stranger),
        "-m",
        "pytest",
        "-W",
        "error",
        "--bayesmc-thorough",
        "--bayesmc-seed=5",
    ]
    ran = _run(command, tmp_path, PYTHONPATH=str(found))
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "bayesmc: thorough run with seed 5" in ran.stdout
    assert "1 statistical test spent a false-alarm budget of 0.25" in ran.stdout


def _project() -> dict:
    import tomllib

    return tomllib.loads((REPOSITORY / "pyproject.toml").read_text("utf-8"))["project"]


def _pip(python: str, *arguments: str) -> None:
    command = [python, "-m", "pip", "--disable-pip-version-check", "-q", *arguments]
    ran = _run(command, Path(python).parent)
    if ran.returncode == 0:
        return
    unreachable = any(words in ran.stderr.lower() for words in UNREACHABLE)
    if unreachable and not os.environ.get("CI"):
        pytest.skip(f"no package index answers: {ran.stderr.strip().splitlines()[-1]}")
    pytest.fail(f"{' '.join(command)}\n{ran.stderr}", pytrace=False)


def _run(command: list[str], folder: Path, **more: str) -> subprocess.CompletedProcess[str]:
    outer = ("PYTHON", "VIRTUAL_ENV", "PYTEST_", "BAYESMC_")
    kept = {k: v for k, v in os.environ.items() if not k.startswith(outer)}
    return subprocess.run(command, cwd=folder, env={**kept, **more}, text=True, capture_output=True)
