"""Lines of code by room, and the longest modules and functions."""

from __future__ import annotations

import ast
import functools
import io
import tokenize
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[2] / "bayesmc"
#: rooms that stand beside the library and are not counted in its size
BESIDE = ("testing", "robotics")
#: most lines of a module, all in all, and of a function without its docstring
MODULE, FUNCTION = 450, 60
_SILENT = (
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
)
_WITH_DOCSTRING = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


@dataclass(frozen=True)
class Length:
    """How long something is: a module by its path, or a function by ``path:name``."""

    lines: int
    what: str


@functools.lru_cache(maxsize=2048)
def parsed(text: str) -> ast.Module:
    """The syntax tree of a module, which several counts read."""
    return ast.parse(text)


def code_lines(text: str) -> int:
    """Lines that hold code: docstrings, comments and blank lines apart."""
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in _SILENT:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(parsed(text)):
        if isinstance(node, _WITH_DOCSTRING):
            lines -= _docstring(node)
    return len(lines)


def sources() -> dict[str, str]:
    """Text of every module, by its path below the package."""
    return {
        path.relative_to(PACKAGE).as_posix(): path.read_text("utf-8")
        for path in sorted(PACKAGE.rglob("*.py"))
    }


def by_room(texts: dict[str, str]) -> Counter[str]:
    """Code lines of each room; a folder of engines is a room of its own."""
    found: Counter[str] = Counter()
    for path, text in texts.items():
        found[_room(path)] += code_lines(text)
    return found


def size(texts: dict[str, str]) -> int:
    """Code lines of the library, without the rooms beside it."""
    return sum(n for room, n in by_room(texts).items() if room not in BESIDE)


def long_modules(texts: dict[str, str]) -> list[Length]:
    """Modules above the bar, longest first."""
    lengths = [Length(len(text.splitlines()), path) for path, text in texts.items()]
    return _above(lengths, MODULE)


def long_functions(texts: dict[str, str]) -> list[Length]:
    """Functions above the bar, longest first; docstrings do not count."""
    lengths = [length for path, text in texts.items() for length in _functions(path, text)]
    return _above(lengths, FUNCTION)


def report() -> Iterator[str]:
    """The lines of the table."""
    texts = sources()
    for room, lines in sorted(by_room(texts).items()):
        yield f"{lines:7,}  {room}"
    yield f"{size(texts):7,}  the library, without {' and '.join(BESIDE)}"
    for bar, found in (
        (f"modules above {MODULE} lines", long_modules(texts)),
        (f"functions above {FUNCTION} lines", long_functions(texts)),
    ):
        yield f"{len(found):7,}  {bar}"
        yield from (f"{length.lines:7,}    {length.what}" for length in found)


# ---- private ------------------------------------------------------------------------------------


def _docstring(
    node: ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef,
) -> set[int]:
    if ast.get_docstring(node, clean=False) is None:
        return set()
    first = node.body[0]
    assert first.end_lineno is not None
    return set(range(first.lineno, first.end_lineno + 1))


def _functions(path: str, text: str) -> Iterator[Length]:
    for node in ast.walk(parsed(text)):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            assert node.end_lineno is not None
            lines = node.end_lineno - node.lineno + 1 - len(_docstring(node))
            yield Length(lines, f"{path}:{node.name}")


def _above(lengths: list[Length], bar: int) -> list[Length]:
    return sorted((x for x in lengths if x.lines > bar), key=lambda x: (-x.lines, x.what))


def _room(path: str) -> str:
    room, *rest = path.split("/")
    if not rest:
        return "(loose)"
    return f"{room}/{rest[0]}" if room == "engines" and len(rest) > 1 else room
