"""From XML to a tree of XMLBIF elements that know their lines.

It holds the format's grammar, which element may stand in which; what they mean is the reader's
business. Files come from strangers, so nothing outside the text is ever opened, and declarations of
entities, by which a small file can grow to fill the memory, are refused.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any, NoReturn
from xml.parsers import expat

from bayesmc.errors import FileFormatError

#: what may stand in an element; the others hold text
CHILDREN = {
    "": ("BIF",),
    "BIF": ("NETWORK",),
    "NETWORK": ("NAME", "PROPERTY", "VARIABLE", "DEFINITION"),
    "VARIABLE": ("NAME", "OUTCOME", "PROPERTY"),
    "DEFINITION": ("FOR", "GIVEN", "TABLE", "PROPERTY"),
}
BLANKS = " \t\r\n"


@dataclass
class Element:
    """One element: its tag in capitals, and what is in it.

    ``pieces`` are its text as the parser gave it, each with the line it starts on.
    """

    tag: str
    line: int
    attributes: dict[str, str] = field(default_factory=dict)
    children: list[Element] = field(default_factory=list)
    pieces: list[tuple[int, str]] = field(default_factory=list)

    @property
    def text(self) -> str:
        """Its text without the blanks around it."""
        return "".join(piece for _, piece in self.pieces).strip(BLANKS)

    def all(self, tag: str) -> list[Element]:
        """The children of one kind."""
        return [child for child in self.children if child.tag == tag]

    def words(self) -> list[str]:
        """The words of its text."""
        return "".join(piece for _, piece in self.pieces).split()

    def line_of(self, index: int) -> int:
        """The line on which the word number ``index`` starts."""
        text = "".join(piece for _, piece in self.pieces)
        offset = list(re.finditer(r"\S+", text))[index].start()
        for line, piece in self.pieces:
            if offset < len(piece):
                return line + piece.count("\n", 0, offset)
            offset -= len(piece)
        return self.line


def parse_elements(data: bytes | str, path: Any = None) -> Element:
    """The element ``BIF`` of a file.

    Tags may be in any case and carry a namespace prefix.

    Raises
    ------
    FileFormatError
        With the line (from 1): malformed XML, an entity declared, an element where the format has
        none, or text between elements.
    """
    return _Builder(path).build(data)


class _Builder:
    """The tree in the making; ``open`` are the elements that are not closed yet."""

    def __init__(self, path: Any) -> None:
        self.path = path
        self.root = Element("", 1)
        self.open = [self.root]
        parser = self.parser = expat.ParserCreate()
        parser.StartElementHandler = self.start
        parser.EndElementHandler = lambda tag: self.open.pop()
        parser.CharacterDataHandler = self.characters
        parser.CommentHandler = self.comment
        parser.EntityDeclHandler = self.entity
        parser.SkippedEntityHandler = self.skipped

    def build(self, data: bytes | str) -> Element:
        if isinstance(data, str):
            data = data.removeprefix("\ufeff")
        try:
            self.parser.Parse(data, True)
        except expat.ExpatError as error:
            reason = expat.ErrorString(error.code)
            raise FileFormatError(f"malformed XML: {reason}", self.path, error.lineno) from error
        except FileFormatError:
            raise
        except (LookupError, ValueError) as error:
            self.fail(f"the XML's encoding cannot be read: {error}")
        return self.root.children[0]

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        parent = self.open[-1]
        name = tag.rpartition(":")[2].upper()
        allowed = CHILDREN.get(parent.tag, ())
        if name not in allowed:
            within = f"in {parent.tag}" if parent.tag else "at the top"
            names = " or ".join(allowed) if allowed else "text only"
            self.fail(f"found the element {tag!r} {within}, where XMLBIF 0.3 has {names}")
        upper = {key.upper(): value for key, value in attributes.items()}
        element = Element(name, self.parser.CurrentLineNumber, upper)
        parent.children.append(element)
        self.open.append(element)

    def characters(self, text: str) -> None:
        element = self.open[-1]
        if element.tag not in CHILDREN:
            element.pieces.append((self.parser.CurrentLineNumber, text))
        elif text.strip(BLANKS):
            self.fail(f"stray text in {element.tag}: {text.strip(BLANKS)[:20]!r}")

    def comment(self, text: str) -> None:
        if self.open[-1].tag == "TABLE":  # it separates numbers, as a blank does
            self.open[-1].pieces.append((self.parser.CurrentLineNumber, " "))

    def entity(self, name: str, *_: Any) -> None:
        self.fail(f"the entity {name!r} is declared; bayesmc reads no entities, so write the text")

    def skipped(self, name: str, *_: Any) -> None:
        self.fail(f"the entity '&{name};' is not defined in the file; write the text")

    def fail(self, message: str) -> NoReturn:
        raise FileFormatError(message, self.path, self.parser.CurrentLineNumber)
