"""The run's last lines say how many reference tests ran, and how many lacked their data."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = """
import pytest

@pytest.mark.parametrize("net", ["asia", "alarm"])
def test_uses_the_fixture(reference_data, net):
    assert (reference_data / net).exists()

@pytest.mark.reference
def test_is_marked_only():
    pass

def test_is_neither():
    pass
"""


def last_lines(folder: Path, data: Path) -> list[str]:
    shutil.copy(Path(__file__).with_name("conftest.py"), folder)
    (folder / "test_some.py").write_text(TESTS)
    (folder / "pytest.ini").write_text("[pytest]\nmarkers = reference\n")
    ran = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(folder)],
        env={**os.environ, "BAYESMC_DATA": str(data)},
        text=True,
        capture_output=True,
    )
    return ran.stdout.splitlines()[-8:]


@pytest.mark.parametrize(
    ("nets", "expected"),
    [
        (["asia", "alarm"], "reference tests: 3 ran, 0 skipped for want of data"),
        pytest.param(  # a failure ran, too
            ["asia"],
            "reference tests: 3 ran, 0 skipped for want of data",
            marks=pytest.mark.thorough,
        ),
        (None, "reference tests: 1 ran, 2 skipped for want of data"),
    ],
)
def test_counts(tmp_path: Path, nets: list[str] | None, expected: str) -> None:
    (tmp_path / "suite").mkdir()
    for net in nets or []:
        (tmp_path / "data" / net).mkdir(parents=True)
    assert expected in last_lines(tmp_path / "suite", tmp_path / "data")
