"""The snippets of CONTRIBUTING and docs/ run and print what the pages show."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.snippets import REPOSITORY, refresh, run_page, snippets

PAGES = [REPOSITORY / "CONTRIBUTING.md", *sorted((REPOSITORY / "docs").glob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
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
    broken = [
        f"{page.name}: {target}"
        for page in [*PAGES, REPOSITORY / "README.md"]
        for target in _local_links(page.read_text("utf-8"))
        if not (page.parent / target).exists()
    ]
    assert broken == []


def _local_links(text: str) -> list[str]:
    targets = [part.split(")")[0].split("#")[0] for part in text.split("](")[1:]]
    return [target for target in targets if target and "://" not in target]


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
