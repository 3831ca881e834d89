"""Which functions of examples, docs, references and the tests' zoo the expression graph holds, and why not.

A function is followed if every model that it stands in has it as a graph that gave, at the probe points, what
the function gives. Functions are told apart by file, line and node.
"""

from __future__ import annotations

import contextlib
import functools
import io
import re
import tempfile
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import CodeType
from typing import Any
from unittest import mock

import pytest

from bayesmc.network import declaring, validate
from bayesmc.network.expressions import Opaque, density
from bayesmc.network.model import Model
from references import CASES
from references.case import data_folder
from tests.network import zoo
from tests.snippets import REPOSITORY, run_page

#: least share of the functions that is followed
BAR = 0.97
ROOMS = ("examples/", "docs/", "references/", "tests/network/zoo.py")

Place = tuple[str, int, str]


@dataclass
class Tally:
    """Functions by file, line and node: None where followed, else the reason."""

    found: dict[Place, str | None] = field(default_factory=dict)

    def add(self, model: Model) -> None:
        """The functions of a model."""
        for name, node in model.nodes.items():
            code = _code_of(node.declaration.function)
            place = None if code is None else _place(code, name)
            if place is None or self.found.get(place) is not None:
                continue
            read = density(model, name)
            self.found[place] = read.reason if isinstance(read, Opaque) else None

    @property
    def share(self) -> float:
        """Share of the functions that is followed."""
        return sum(why is None for why in self.found.values()) / max(len(self.found), 1)

    def lines(self) -> Iterator[str]:
        """The share, and the others with reasons."""
        followed = sum(why is None for why in self.found.values())
        yield f"{followed:7,}  of {len(self.found):,} functions followed: {self.share:.1%} (bar {BAR:.0%})"
        for (path, line, node), why in sorted(self.found.items()):
            if why is not None:
                yield f"         {path}:{line} {node}: {why}"


@contextlib.contextmanager
def tallied() -> Iterator[Tally]:
    """Counts the functions of every model that is validated within it."""
    tally = Tally()

    def validated(model: Model) -> None:
        validate.validate_model(model)
        tally.add(model)

    with mock.patch.object(declaring, "validate_model", validated), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield tally


def of_zoo() -> None:
    """Validates the tests' zoo."""
    for name in zoo.ZOO:
        zoo.build(name)[0].validate()


def of_references() -> None:
    """Validates the references' models, where their data is."""
    root = data_folder()
    if root.is_dir():
        for case in CASES:
            case.question(root).net.validate()


def of_docs() -> None:
    """Runs the snippets of the pages."""
    for page in sorted((REPOSITORY / "docs").glob("*.md")):
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            run_page(page)  # which writes files


def of_examples() -> None:
    """Runs the tests of the examples."""
    tests = sorted(str(path) for path in (REPOSITORY / "tests").glob("test_examples*.py"))
    with contextlib.redirect_stdout(io.StringIO()):
        code = pytest.main(
            ["-q", "-p", "no:xdist", "--assert=plain", "-p", "no:hypothesispytest", *tests]
        )
    if code:
        raise RuntimeError(f"the tests of the examples fail: pytest says {code}")


#: quick ones first
WAYS: dict[str, Callable[[], None]] = {
    "zoo": of_zoo,
    "references": of_references,
    "docs": of_docs,
    "examples": of_examples,
}


def report() -> Iterator[str]:
    """The lines of the table; docs and examples are run, which takes minutes."""
    with tallied() as tally:
        for run in WAYS.values():
            run()
    yield from tally.lines()


# ---- private ------------------------------------------------------------------------------------


def _code_of(function: Any) -> CodeType | None:
    while isinstance(function, functools.partial):
        function = function.func
    return getattr(function, "__code__", None)


def _place(code: CodeType, node: str) -> Place | None:
    path = Path(code.co_filename)
    if not path.is_relative_to(REPOSITORY):
        return None
    relative = path.relative_to(REPOSITORY).as_posix()
    if not relative.startswith(ROOMS):
        return None
    root = re.sub(r"\[.*\]$|_?\d+$", "", node).removesuffix("_prev")
    return relative, code.co_firstlineno, root
