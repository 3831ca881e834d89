"""A cursor over BIF text: its words, names and numbers, and errors that know their line.

What the words mean is the reader's business.
"""

from __future__ import annotations

import re
from typing import Any, NoReturn

from bayesmc.errors import FileFormatError

# A word ends at white space, at the format's punctuation, or where a comment starts.
WORD = r'(?:[^\s{}()\[\];,|"/]|/(?![/*]))+'
NAME = rf'(?:"([^"\n]*)"|({WORD}))'

_COMMENT_OR_QUOTED = re.compile(r'"[^"\n]*"|//[^\n]*|/\*.*?\*/', re.S)
_NAMES = re.compile(rf"[\s,|]*{NAME}")
_TOKEN = re.compile(rf"{NAME}|[{{}}()\[\];,|]")
_GAP = re.compile(r"\s*")
_HEAD = re.compile(rf"{NAME}\s*")
_PROPERTY = re.compile(r'((?:"[^"\n]*"|[^";])*);')


class Cursor:
    """A place in the text; offsets are kept so that an error can name its line."""

    def __init__(self, text: str, path: Any) -> None:
        self.path = path
        self.at = 0
        # Comments become blanks of the same length, so that offsets and lines stay true.
        self.text = _COMMENT_OR_QUOTED.sub(_blank_comment, text)

    def keyword(self, inside: str) -> str | None:
        """The next word or punctuation mark; at the end of the text, None outside any block."""
        self.at = start = after_gap(self.text, self.at)
        if start == len(self.text):
            if not inside:
                return None
            self.fail(f"the file ends inside {inside}; it looks truncated")
        match = _TOKEN.match(self.text, start)
        if match is None:
            self.fail(f"cannot read {self.text[start : start + 20]!r}")
        if self.text[start] not in "{}()[];,|":
            self.at = after_gap(self.text, match.end())
        elif match[0] == "}" and inside:
            self.at = match.end()
        return match[0]

    def name_before_brace(self, at: int) -> str:
        """The name between a keyword at ``at`` and its block's opening brace."""
        match = _HEAD.match(self.text, self.at)
        if match is None or not self.text.startswith("{", match.end()):
            self.fail("expected 'variable name {'", at)
        self.at = match.end() + 1
        return match[1] if match[1] is not None else match[2]

    def property_text(self) -> str:
        """What stands between ``property`` and its semicolon."""
        match = _PROPERTY.match(self.text, self.at)
        if match is None:
            self.fail("this property is not closed by ';'")
        self.at = match.end()
        return match[1].strip()

    def names(self, text: str, at: int) -> tuple[str, ...]:
        """The names in a part of the text that starts at ``at``."""
        if '"' not in text:  # the common case, by string methods: five times faster
            return tuple(text.replace(",", " ").replace("|", " ").split())
        found, end = [], 0
        while (match := _NAMES.match(text, end)) is not None:
            found.append(match[1] if match[1] is not None else match[2])
            end = match.end()
        if text[end:].strip(" \t\r\n,|"):
            self.fail(f"cannot read the names in ({text.strip()})", at + end)
        return tuple(found)

    def numbers(self, text: str, at: int, inside: str) -> list[float]:
        """The numbers in a part of the text that starts at ``at``."""
        words = text.replace(",", " ").split()
        try:
            values = list(map(float, words))
        except ValueError:
            values = []
        if not values or "_" in text:  # float() would take 0_5 for 5
            for k, word in enumerate(words):
                if not _is_number(word):
                    self.fail(f"{inside}: {word!r} is not a number", at + word_offset(text, k))
        return values

    def fail(self, message: str, at: int | None = None) -> NoReturn:
        """Raise, naming the line of offset ``at``; by default the one where the cursor stands."""
        at = self.at if at is None else at
        raise FileFormatError(message, self.path, self.text.count("\n", 0, at) + 1)


def after_gap(text: str, at: int) -> int:
    """Where the next thing that is not white space starts."""
    match = _GAP.match(text, at)
    return match.end() if match else at


def word_offset(text: str, index: int) -> int:
    """Where the word number ``index`` of a list of numbers starts."""
    return list(re.finditer(r"[^\s,]+", text))[index].start()


def _blank_comment(match: re.Match[str]) -> str:
    found = match[0]
    if found[0] == '"':
        return found
    return re.sub(r"[^\n]", " ", found)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return "_" not in word
