"""What is in a file, decompressed: bytes or text."""

from __future__ import annotations

import gzip
import zlib
from os import PathLike
from pathlib import Path

from bayesmc.errors import FileFormatError


def read_bytes(path: str | PathLike[str]) -> bytes:
    """The content of a file, decompressed where its first bytes say gzip.

    Raises
    ------
    FileFormatError
        If its gzip stream is damaged.
    OSError
        If it cannot be opened.
    """
    data = Path(path).read_bytes()
    try:
        return gzip.decompress(data) if data[:2] == b"\x1f\x8b" else data
    except (OSError, EOFError, zlib.error) as error:
        raise FileFormatError(f"not readable as a gzipped file: {error}", path) from error


def read_text(path: str | PathLike[str]) -> str:
    """The content of a UTF-8 text file, decompressed where its first bytes say gzip.

    Raises
    ------
    FileFormatError
        If the file is not UTF-8 text, or its gzip stream is damaged.
    OSError
        If it cannot be opened.
    """
    try:
        return read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FileFormatError(f"not readable as UTF-8 text: {error}", path) from error


def write_bytes(path: str | PathLike[str], data: bytes) -> None:
    """Write a file, compressed where its name ends in ``.gz``; equal data make equal files."""
    is_zipped = str(path).lower().endswith(".gz")
    Path(path).write_bytes(gzip.compress(data, mtime=0) if is_zipped else data)
