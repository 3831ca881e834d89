"""What a release says of itself agrees: version, citation, changelog, and the Pythons it was tried on."""

from __future__ import annotations

import re
import tomllib

import bayesmc
from tests.snippets import REPOSITORY

PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text("utf-8"))["project"]


def test_one_version() -> None:
    cited = (REPOSITORY / "CITATION.cff").read_text("utf-8")
    logged = (REPOSITORY / "CHANGELOG.md").read_text("utf-8")
    said = {
        "package": bayesmc.__version__,
        "CITATION.cff": re.search(r"^version: (\S+)$", cited, re.M)[1],
        "CHANGELOG.md": re.search(r"^## (\S+)", logged, re.M)[1],
    }
    assert said == dict.fromkeys(said, PROJECT["version"])


def test_one_day() -> None:
    cited = (REPOSITORY / "CITATION.cff").read_text("utf-8")
    logged = (REPOSITORY / "CHANGELOG.md").read_text("utf-8")
    day = re.search(r'^date-released: "(\S+)"$', cited, re.M)[1]
    assert re.search(r"^## \S+ — (\S+)$", logged, re.M)[1] == day


def test_pythons_fit_what_is_required() -> None:
    named = re.findall(r"Python :: 3\.(\d+)", "\n".join(PROJECT["classifiers"]))
    least = int(re.fullmatch(r">=3\.(\d+)", PROJECT["requires-python"])[1])
    assert [int(minor) for minor in named] == list(range(least, least + len(named)))
