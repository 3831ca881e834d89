"""Runs the Python of a Markdown page the way a reader would, and compares what it prints.

A page's ```python blocks run in order in one namespace. A ```text block that follows one directly
is what that block prints; a block without one must print nothing, so that no output stays unshown.
``python -m tests.snippets PAGE...`` writes the outputs anew; read the difference before keeping it.
"""

from __future__ import annotations

import contextlib
import io
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True)
class Snippet:
    """One block of Python with the line it starts at and the output the page shows for it."""

    line: int
    code: str
    shown: str = ""
    shown_at: tuple[int, int] | None = None


def snippets(page: str) -> list[Snippet]:
    """The Python blocks of a page's text, each with the ```text block right below it, if any."""
    found = []
    blocks = list(FENCE.finditer(page))
    for i, block in enumerate(blocks):
        if block[1] != "python":
            continue
        below = blocks[i + 1] if i + 1 < len(blocks) else None
        adjacent = below is not None and not page[block.end() : below.start()].strip()
        line = page.count("\n", 0, block.start(2)) + 1
        if adjacent and below[1] == "text":
            found.append(Snippet(line, block[2], below[2], below.span(2)))
        else:
            found.append(Snippet(line, block[2]))
    return found


def run_page(path: Path) -> int:
    """Run every snippet of the page, fail where one prints something else; return their number."""
    count = 0
    for snippet, printed in _outputs(path):
        count += 1
        if printed.rstrip() != snippet.shown.rstrip():
            pytest.fail(
                f"{path.name}, line {snippet.line}: the page shows\n{snippet.shown}\n"
                f"but the code printed\n{printed}",
                pytrace=False,
            )
    return count


def refresh(path: Path) -> None:
    """Write what the snippets print into the ```text blocks that the page already has."""
    page = path.read_text("utf-8")
    # from the end, so that earlier positions stay right
    for snippet, printed in reversed(list(_outputs(path))):
        if snippet.shown_at is not None:
            start, end = snippet.shown_at
            page = page[:start] + printed.rstrip() + "\n" + page[end:]
    path.write_text(page, "utf-8")


def _outputs(path: Path) -> Iterator[tuple[Snippet, str]]:
    namespace: dict = {"__name__": "__main__"}
    for snippet in snippets(path.read_text("utf-8")):
        # blank lines above put the page's own line numbers into tracebacks
        source = "\n" * (snippet.line - 1) + snippet.code
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(source, str(path), "exec"), namespace)
        yield snippet, printed.getvalue()


if __name__ == "__main__":
    for name in sys.argv[1:]:
        refresh(Path(name))
