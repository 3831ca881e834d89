"""Numbered lines of text out of whatever a log comes in: a path, gzipped or not, or any lines.

A file that is cut off in the middle of its compression, or is no text at all, gives the lines that
can still be had and then says what is wrong. Nothing here knows what the lines mean.
"""

from __future__ import annotations

import codecs
import gzip
import io
import os
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path

from bayesmc.errors import FileFormatError

Source = str | os.PathLike[str] | Iterable[str] | Iterable[bytes]
"""A path, an open file, or any iterable of lines."""

LONGEST_LINE = 1 << 20
"""Characters after which a line is taken for no line: a scan of 10,000 beams has a tenth of them."""

_CHUNK = 1 << 14  # compressed bytes, which may be a thousand times as many inflated


Line = tuple[int, str, str | None]
"""A line's number from 1, its text, and what is wrong with it before anyone reads it (or None)."""


def name_of(source: Source) -> str:
    """What messages call the source."""
    if isinstance(source, (str, os.PathLike)):
        return os.fspath(source)
    name = getattr(source, "name", None)
    return name if isinstance(name, str) else "<lines>"


def checked(source: Source) -> Source:
    """The source, where lines can be had from it at all.

    Raises
    ------
    OSError
        For a path that cannot be opened.
    FileFormatError
        For a file in UTF-16 or UTF-32, of which no line could be read, or a text in place of a path.
    TypeError
        For what is neither a path nor iterable.
    """
    if isinstance(source, str) and "\n" in source:
        raise FileFormatError("a text was given for a path: pass text.splitlines()")
    if isinstance(source, (str, os.PathLike)):
        path = Path(source)
        is_pipe = path.exists() and not path.is_file() and not path.is_dir()
        if not is_pipe:  # which can be read only once
            with _Opened(source) as (stream, _):
                _refuse_wide(stream.peek(4), source)
    elif isinstance(source, (bytes, bytearray)) or not isinstance(source, Iterable):
        raise TypeError(
            f"{type(source).__name__} is no log: give a path, an open file or an iterable of lines"
        )
    return source


def lines_of(source: Source) -> Iterator[Line]:
    """Every line without its end; the last one carries the fault where the source breaks off.

    Examples
    --------
    >>> from bayesmc.robotics.logs.sources import lines_of
    >>> [text for _, text, _ in lines_of(["O 1 2 0 0.1\\r\\n", b"L 1"])]
    ['O 1 2 0 0.1', 'L 1']
    """
    if isinstance(source, (str, os.PathLike)):
        with _Opened(source) as (stream, inflated):
            text = io.TextIOWrapper(stream, "utf-8-sig", errors="replace", newline=None)
            yield from _readable(text, inflated)
    else:
        yield from _given(source)


class _Opened:
    """A file's bytes, inflated where its first two say gzip, and what inflates them."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._path = path

    def __enter__(self) -> tuple[io.BufferedReader, _Inflated | None]:
        self._file = open(Path(self._path), "rb")  # noqa: SIM115 - closed by __exit__
        if self._file.peek(2)[:2] != b"\x1f\x8b":
            return self._file, None
        inflated = _Inflated(self._file)
        return io.BufferedReader(inflated), inflated

    def __exit__(self, *error: object) -> None:
        self._file.close()


class _Inflated(io.RawIOBase):
    """A gzip stream that ends quietly where it is damaged, and then says how.

    ``gzip`` raises there, and with the exception goes all that it had inflated but not handed out.
    """

    def __init__(self, file: io.BufferedReader) -> None:
        self._file = file
        self._inflate = zlib.decompressobj(31)
        self._pending = self._rest = b""  # inflated bytes not handed out; bytes after the stream
        self._at_end = False
        self.damage: str | None = None

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        while not self._pending and not self._at_end:
            self._pending = self._more()
        count = min(len(buffer), len(self._pending))
        buffer[:count], self._pending = self._pending[:count], self._pending[count:]
        return count

    def _more(self) -> bytes:
        if not self._inflate.eof:
            fed = self._file.read(_CHUNK)
            return self._inflated(fed) if fed else self._end("the gzip stream is cut off")
        # another stream may follow, or zeros
        fed, self._rest = (self._rest or self._file.read(_CHUNK)).lstrip(b"\0"), b""
        if fed and not b"\x1f\x8b".startswith(fed[:2]):
            return self._end("the gzip stream is followed by other bytes")
        if fed:
            self._inflate = zlib.decompressobj(31)
            return self._inflated(fed)
        self._at_end = not self._file.peek(1)
        return b""

    def _inflated(self, fed: bytes) -> bytes:
        before = self._inflate.copy()
        try:
            data = self._inflate.decompress(fed)
            self._rest = self._inflate.unused_data
            return data
        except zlib.error:
            # byte by byte, to have all that comes before the damage
            good = []
            try:
                for k in range(len(fed)):
                    good.append(before.decompress(fed[k : k + 1]))
            except zlib.error as error:
                self._end(f"the gzip stream is damaged ({error})")
            return b"".join(good)

    def _end(self, damage: str) -> bytes:
        self.damage, self._at_end = damage, True
        return b""


def _readable(text: io.TextIOWrapper, inflated: _Inflated | None) -> Iterator[Line]:
    """The lines without their ends, and the damage of the file at the one where it struck."""
    number = 0
    while line := text.readline(LONGEST_LINE):
        number += 1
        if line[-1] == "\n":
            yield number, line[:-1], None
        elif len(line) < LONGEST_LINE:
            # the last one: half of it may be missing, and half a number is a number
            yield number, line, None if inflated is None else inflated.damage
            return
        else:
            _pass_over(text)
            yield number, line[:200], f"the line is longer than {LONGEST_LINE} characters"
    if inflated is not None and inflated.damage is not None:
        yield number + 1, "", inflated.damage
    elif number == 0:
        yield 1, "", "the file is empty"


def _pass_over(text: io.TextIOWrapper) -> None:
    """Read on to the end of the line."""
    while rest := text.readline(LONGEST_LINE):
        if rest[-1] == "\n":
            return


def _given(lines: Iterable[str] | Iterable[bytes]) -> Iterator[Line]:
    number, iterator = 0, iter(lines)
    while True:
        try:
            item = next(iterator)
        except StopIteration:
            break
        except (UnicodeDecodeError, EOFError, zlib.error, gzip.BadGzipFile) as error:
            yield number + 1, "", f"the stream breaks off ({error}); give the path instead"
            return
        number += 1
        if isinstance(item, bytes):
            item = item.decode("utf-8", errors="replace")
        if not isinstance(item, str):
            raise TypeError(f"line {number} is of type {type(item).__name__}; give lines of text")
        text = item.rstrip("\r\n").removeprefix("\ufeff" if number == 1 else "")
        yield number, text, None
    if number == 0:
        yield 1, "", "there is no line"


def _refuse_wide(head: bytes, path: str | os.PathLike[str]) -> None:
    # the marks of UTF-32 begin with those of UTF-16
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE, codecs.BOM_UTF32_BE)):
        raise FileFormatError("this is UTF-16 or UTF-32; save it as UTF-8", path)
