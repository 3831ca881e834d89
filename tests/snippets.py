"""Runs the Python of a Markdown page the way a reader would, and compares what it prints.

A page's ```python blocks run in order in one namespace. A ```text block that follows one directly
is what that block prints; a block without one must print nothing, so that no output stays unshown.
"""

from __future__ import annotations

import contextlib
import io
import re
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
    shown: str


def snippets(page: str) -> list[Snippet]:
    """The Python blocks of a page's text, each with the ```text block right below it, if any."""
    found = []
    blocks = list(FENCE.finditer(page))
    for i, block in enumerate(blocks):
        if block[1] != "python":
            continue
        below = blocks[i + 1] if i + 1 < len(blocks) else None
        adjacent = below is not None and not page[block.end() : below.start()].strip()
        shown = below[2] if adjacent and below[1] == "text" else ""
        found.append(Snippet(page.count("\n", 0, block.start(2)) + 1, block[2], shown))
    return found


def run_page(path: Path) -> int:
    """Run every snippet of the page, fail where one prints something else; return their number."""
    namespace: dict = {"__name__": "__main__"}
    found = snippets(path.read_text("utf-8"))
    for snippet in found:
        # blank lines above put the page's own line numbers into tracebacks
        source = "\n" * (snippet.line - 1) + snippet.code
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(source, str(path), "exec"), namespace)
        if printed.getvalue().rstrip() != snippet.shown.rstrip():
            pytest.fail(
                f"{path.name}, line {snippet.line}: the page shows\n{snippet.shown}\n"
                f"but the code printed\n{printed.getvalue()}",
                pytrace=False,
            )
    return len(found)
