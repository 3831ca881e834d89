"""The snippets of CONTRIBUTING and docs/ run and print what the pages show."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.snippets import REPOSITORY, refresh, run_page, snippets

PAGES = [REPOSITORY / "CONTRIBUTING.md", *sorted((REPOSITORY / "docs").rglob("*.md"))]
HEADING = re.compile(r"^#{1,6} +(.+?) *$", re.MULTILINE)
FENCED = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: "-".join(page.parts[-2:]))
def test_page_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # a snippet may write files
    first = page.read_text("utf-8").partition("\n")[0]
    if first.startswith("<!-- needs: "):
        for module in first.removeprefix("<!-- needs: ").removesuffix(" -->").split(", "):
            pytest.importorskip(module, reason=f"{module}, which the page needs, is not installed")
    run_page(page)


def test_tour_has_snippets() -> None:
    tour = (REPOSITORY / "docs" / "index.md").read_text("utf-8")
    assert len(snippets(tour)) >= 3


def test_links_between_pages_hold() -> None:
    pages = [*PAGES, REPOSITORY / "README.md", REPOSITORY / "CHANGELOG.md"]
    broken = [f"{page.name}: {target}" for page in pages for target in _broken_links(page)]
    assert broken == []


def test_broken_links_are_found(tmp_path: Path) -> None:
    page, other = tmp_path / "page.md", tmp_path / "other.md"
    other.write_text("# Two words, `code`\n\n```python\n# no heading\n```\n", "utf-8")
    good = ["other.md", "other.md#two-words-code", "#here", "https://example.org/none.md"]
    bad = ["none.md", "other.md#three-words", "other.md#no-heading", "#there"]
    page.write_text("# Here\n\n" + " ".join(f"[x]({target})" for target in good + bad), "utf-8")
    assert _broken_links(page) == bad


def _broken_links(page: Path) -> list[str]:
    """Targets of a page's links that are no file, or no heading of it; those elsewhere are not looked up."""
    text = FENCED.sub("", page.read_text("utf-8"))
    targets = [part.split(")")[0] for part in text.split("](")[1:]]
    return [target for target in targets if "://" not in target and not _leads(page, target)]


def _leads(page: Path, target: str) -> bool:
    name, _, anchor = target.partition("#")
    file = page.parent / name if name else page
    if not file.exists():
        return False
    return not anchor or anchor in _anchors(file.read_text("utf-8"))


def _anchors(text: str) -> set[str]:
    """Where headings can be led to: their words, joined by hyphens, as GitHub and the site name them."""
    headings = HEADING.findall(FENCED.sub("", text))
    return {re.sub(r"[^\w\- ]", "", found.lower()).replace(" ", "-") for found in headings}


@pytest.mark.parametrize(
    ("page", "fault"),
    [
        ("```python\nprint(1)\n```\n```text\n2\n```\n", "the page shows"),
        ("```python\nprint(1)\n```\nwords between\n```text\n1\n```\n", "the page shows"),
    ],
)
def test_wrong_output_is_found(tmp_path: Path, page: str, fault: str) -> None:
    path = tmp_path / "page.md"
    path.write_text(page, "utf-8")
    with pytest.raises(pytest.fail.Exception, match=fault):
        run_page(path)


def test_failing_snippet_is_found_at_its_line(tmp_path: Path) -> None:
    path = tmp_path / "page.md"
    path.write_text("# Title\n\n```python\nx = 1\nx / 0\n```\n", "utf-8")
    with pytest.raises(ZeroDivisionError) as caught:
        run_page(path)
    assert caught.traceback[-1].lineno + 1 == 5


def test_blocks_share_a_namespace(tmp_path: Path) -> None:
    path = tmp_path / "page.md"
    path.write_text(
        "```python\nx = 1\n```\n\n```python\nprint(x)\n```\n\n```text\n1\n```\n", "utf-8"
    )
    assert run_page(path) == 2


def test_refreshed_page_passes(tmp_path: Path) -> None:
    path = tmp_path / "page.md"
    block = "```python\nprint(%d)\n```\n\n```text\n```\n\n"
    path.write_text(block % 1 + "```python\nx = 1\n```\n\n" + block % 2, "utf-8")
    refresh(path)
    assert path.read_text("utf-8").count("```text\n1\n```") == 1
    assert run_page(path) == 3
