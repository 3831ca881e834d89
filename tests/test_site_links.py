"""The built site's links are followed to their anchors, and those that lead nowhere are named."""

from __future__ import annotations

import runpy
from pathlib import Path

from tests.snippets import REPOSITORY

broken = runpy.run_path(str(REPOSITORY / "docs" / "links.py"))["broken"]


def test_links_that_lead_nowhere_are_named(tmp_path: Path) -> None:
    (tmp_path / "more").mkdir()
    (tmp_path / "more" / "other.html").write_text('<h1 id="here">x</h1>', "utf-8")
    good = ["more/other.html", "more/other.html#here", "#top", "https://example.org/x", "more/"]
    bad = ["more/none.html", "more/other.html#there", "#bottom"]
    links = "".join(f'<a href="{target}">x</a>' for target in good + bad)
    (tmp_path / "index.html").write_text(f'<p id="top">{links}<img src="no.png"></p>', "utf-8")
    assert broken(tmp_path) == [f"index.html: {target}" for target in [*bad, "no.png"]]
