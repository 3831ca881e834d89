"""``python -m bayesmc``: a net in a file, asked from a shell."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.__main__ import main


@pytest.fixture
def path(tmp_path: Path) -> str:
    net = bmc.BayesNet("lungs")
    net.table("smoke", probs=[0.7, 0.3], states=("no", "yes"))
    net.table("cancer", ["smoke"], [[0.99, 0.01], [0.9, 0.1]], states=("no", "yes"))
    net.table("sure", ["smoke"], [[1.0, 0.0], [0.5, 0.5]], states=("no", "yes"))
    found = tmp_path / "lungs.bif"
    bmc.io.write(net, found)
    return str(found)


def test_json_is_what_the_library_answers(path: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([path, "--evidence", "cancer=yes", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    posterior = bmc.infer(bmc.io.read(path), {"cancer": "yes"})
    assert set(found["probabilities"]) == {"smoke", "sure"}
    for name, states in found["probabilities"].items():
        assert list(states) == ["no", "yes"]
        np.testing.assert_allclose(list(states.values()), posterior.probabilities(name), rtol=1e-14)
    assert found["log_evidence"] == pytest.approx(posterior.log_marginal_likelihood, rel=1e-14)


def test_a_table_in_a_shell_and_a_picture(path: str, tmp_path: Path) -> None:
    drawn = tmp_path / "answers.svg"
    run = subprocess.run(
        [sys.executable, "-m", "bayesmc", path, "-e", "cancer=yes", "-q", "smoke", "--picture", str(drawn)],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    rows = [line.split() for line in run.stdout.splitlines()]
    assert rows[1] == ["smoke"]
    assert [row[0] for row in rows[2:]] == ["no", "yes"]
    assert float(rows[3][1]) == pytest.approx(0.03 / 0.037, abs=1e-6)
    assert "<svg" in drawn.read_text()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["-e", "cancer=perhaps"], "'perhaps' is not a state; the states are 'no', 'yes'"),
        (["-e", "cancer"], "is not of the form NODE=STATE"),
        (["-e", "cancer=yes", "cancer=no"], "given twice, as 'yes' and 'no'"),
        (["-e", "cancr=yes"], "did you mean 'cancer'?"),
        (["-q", "smok"], "did you mean 'smoke'?"),
        (["-e", "sure=yes", "smoke=no"], "probability zero"),
        (["--picture", "answers.foo"], "Format 'foo' is not supported"),
    ],
)
def test_faults_are_named(
    path: str, capsys: pytest.CaptureFixture[str], arguments: list[str], said: str
) -> None:
    assert main([path, *arguments]) == 2
    caught = capsys.readouterr()
    assert said in caught.err and not caught.out


def test_no_file(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["nowhere.bif"]) == 2
    assert "nowhere.bif" in capsys.readouterr().err
