"""The README opens with the two commands, and its example runs and prints what it shows."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.snippets import REPOSITORY, run_page

README = REPOSITORY / "README.md"


def test_example_runs_as_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert run_page(README) >= 1


def test_opens_with_the_two_commands() -> None:
    opening = README.read_text("utf-8").splitlines()[:12]
    assert any("make demo" in line for line in opening)
    assert any("make test" in line for line in opening)


def test_named_make_targets_exist() -> None:
    makefile = (REPOSITORY / "Makefile").read_text("utf-8")
    targets = set(re.findall(r"^([a-z]+):", makefile, re.MULTILINE))
    pattern = r"(?:^|`)make ([a-z]+)"
    pages = [README, REPOSITORY / "CONTRIBUTING.md", REPOSITORY / ".ci" / "run"]
    named = {t for page in pages for t in re.findall(pattern, page.read_text("utf-8"), re.M)}
    assert named <= targets
