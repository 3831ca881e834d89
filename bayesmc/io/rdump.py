"""Numbers as R's ``dump`` and the BUGS programs write them: ``N <- 3``, ``list(N = 3, y = c(1, NA, 2))``.

Text only. In R, and so for JAGS and Stan, the first index of ``structure(c(...), .Dim = c(2, 3))`` runs
fastest. WinBUGS and OpenBUGS write ``list(y = structure(.Data = c(...), .Dim = c(2, 3)))``, and there the
last index does (OpenBUGS user manual, "Model Specification: Formatting of Data").

Of what ``structure`` sets only the dimensions are numbers; names, levels and classes are passed over, so that
a factor is its codes, which R counts from 1. Lists within, and data frames, are no arrays and refused.

People write what no dump does, and some of it is read: names given before, and the calls of ``rcalls``.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from os import PathLike
from typing import Any, NamedTuple

import numpy as np

from bayesmc.errors import FileFormatError
from bayesmc.io.rcalls import CALLS, made

_TOKEN = re.compile(
    r"""(?P<space>[\s;]+|\#[^\n]*)
      | (?P<arrow><-|=)
      | (?P<number>(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?L?)
      | (?P<text>"(?:[^"\\]|\\.)*"|'(?:[^'\\]|\\.)*'|`[^`]*`)
      | (?P<name>[A-Za-z.][\w.]*)
      | (?P<mark>[(),:+-])""",
    re.VERBOSE,
)
_CONSTANTS = {"NA": np.nan, "NaN": np.nan, "Inf": np.inf, "TRUE": True, "FALSE": False,
              "T": True, "F": False, "NA_real_": np.nan, "NA_integer_": np.nan}  # fmt: skip
_RESERVED = _CONSTANTS.keys() - {"T", "F"}
_EMPTY = {"integer": np.int64, "numeric": np.float64, "double": np.float64, "logical": np.bool_}
#: conversions that older versions of R write around values, and ``as.vector``, which drops dimensions
_AS = ("as.integer", "as.numeric", "as.double", "as.logical", "as.vector")
_CALLS = ("c", "structure", *CALLS, *_EMPTY, *_AS)
#: arguments of ``structure`` that are numbers; others are texts or lists, and no part of an array
_NUMBERS = ("data", "dim")


class _Token(NamedTuple):
    kind: str
    text: str
    line: int


def parse_rdump(text: str, path: str | PathLike[str] | None = None) -> dict[str, np.ndarray]:
    """Name -> number or array, in the order of the text; whole numbers as integers, ``NA`` as NaN.

    Raises
    ------
    FileFormatError
        With the line.

    Examples
    --------
    >>> parse_rdump("y <- structure(c(1, 2, 3, 4, 5, 6), .Dim = c(2, 3))")["y"]
    array([[1, 3, 5],
           [2, 4, 6]])
    >>> parse_rdump("list(N = 2, y = structure(.Data = c(1, 2, 3, 4, 5, 6), .Dim = c(2, 3)))")["y"]
    array([[1, 2, 3],
           [4, 5, 6]])
    >>> parse_rdump('sex <- structure(as.integer(c(2, 1)), .Label = c("f", "m"), class = "factor")')
    {'sex': array([2, 1])}
    """
    return _Reader(text, path).everything()


class _Reader:
    """One pass over the tokens of a text."""

    def __init__(self, text: str, path: Any) -> None:
        self.path = path
        self.tokens = self._split(text)
        self.at = 0
        self.is_list = False
        self.found: dict[str, np.ndarray] = {}

    def everything(self) -> dict[str, np.ndarray]:
        found = self.found
        while self.now.kind != "end":
            if self.now.text == "list" and self.tokens[self.at + 1].text == "(":
                self._next()
                self.is_list = True
                for name, value in self._arguments():
                    self._keep(found, name, value)
                self.is_list = False
                continue
            name = self._named()
            if self.now.kind != "arrow":
                self._fail(f"'<-' is wanted after {name!r}, and {self._shown()} is there")
            self._next()
            self._keep(found, name, self._value())
        return found

    # -- tokens

    def _split(self, text: str) -> list[_Token]:
        found, at, line = [], 0, 1
        while at < len(text):
            match = _TOKEN.match(text, at)
            if match is None:
                raise FileFormatError(f"{text[at]!r} is not expected here", self.path, line)
            kind, part = str(match.lastgroup), match.group()
            if kind == "number" or match["number"]:
                kind = "number"
            if kind != "space":
                found.append(_Token(kind, part, line))
            line += part.count("\n")
            at = match.end()
        return [*found, _Token("end", "the end", line), _Token("end", "the end", line)]

    @property
    def now(self) -> _Token:
        return self.tokens[self.at]

    def _next(self) -> _Token:
        token = self.now
        self.at = min(self.at + 1, len(self.tokens) - 1)
        return token

    def _shown(self) -> str:
        return self.now.text if self.now.kind == "end" else repr(self.now.text)

    def _fail(self, message: str) -> Any:
        raise FileFormatError(message, self.path, self.now.line)

    def _take(self, mark: str) -> None:
        if self.now.text != mark:
            self._fail(f"{mark!r} is wanted, and {self._shown()} is there")
        self._next()

    # -- what tokens make

    def _named(self) -> str:
        token = self.now
        if token.kind not in ("name", "text"):
            self._fail(f"a name is wanted, and {self._shown()} is there")
        self._next()
        return token.text.strip("\"'`")

    def _keep(self, found: dict[str, np.ndarray], name: str | None, value: Any) -> None:
        if name is None:
            self._fail("an entry of the list has no name")
        assert name is not None
        if name in _RESERVED:
            self._fail(f"{name!r} is a word of R, and no name")
        if name in found:
            self._fail(f"{name!r} is given twice")
        found[name] = np.asarray(value)

    def _arguments(
        self, kept: Callable[[str], bool] = lambda name: True
    ) -> list[tuple[str | None, Any]]:
        """What stands in brackets: values, some with names; what is not kept by its name is passed over."""
        found: list[tuple[str | None, Any]] = []
        self._take("(")
        while self.now.text != ")":
            named = self.tokens[min(self.at + 1, len(self.tokens) - 1)].text == "="
            name = self._named() if named else None
            if named:
                self._next()
            if name is not None and not kept(name):
                self._skip()
            else:
                found.append((name, self._value()))
            if self.now.text != ")":
                self._take(",")
        self._next()
        return found

    def _skip(self) -> None:
        """Pass over one argument, whatever it is."""
        depth = 0
        while self.now.kind != "end" and (depth or self.now.text not in (",", ")")):
            depth += (self.now.text == "(") - (self.now.text == ")")
            self._next()

    def _value(self) -> Any:
        """One value; of two with a colon between, the whole numbers from one to the other."""
        first = self._signed()
        if self.now.text != ":":
            return first
        self._next()
        last = self._signed()
        if np.ndim(first) or np.ndim(last) or not np.isfinite([first, last]).all():
            self._fail("both ends of a:b are single numbers")
        step = 1 if last >= first else -1
        return _whole(np.arange(first, last + step * 0.5, step))

    def _signed(self) -> Any:
        sign = 1
        while self.now.text in "+-" and self.now.kind == "mark":
            sign *= -1 if self._next().text == "-" else 1
        value = self._single()
        return value if sign == 1 else -1 * value

    def _single(self) -> Any:
        token = self._next()
        if token.kind == "number":
            return _whole(np.asarray(float(token.text.removesuffix("L"))))[()]
        if token.kind == "name" and self.now.text == "(":
            return self._call(token)
        if token.kind == "name" and token.text in self.found and not self.is_list:
            return np.array(self.found[token.text])
        if token.kind == "name" and token.text in _CONSTANTS:
            return _CONSTANTS[token.text]
        self.at -= token.kind != "end"
        if token.kind == "name":
            return self._fail(f"{token.text!r} is no number, and nothing before gives it one")
        return self._fail(f"a number is wanted, and {self._shown()} is there")

    def _call(self, token: _Token) -> Any:
        if token.text == "list":
            raise FileFormatError(
                "list(...) within the data is no array (a data frame is one, too): dump its columns as "
                "variables of their own, in R with(d, dump(names(d), file))",
                self.path,
                token.line,
            )
        if token.text not in _CALLS:
            raise FileFormatError(
                f"{token.text}(...) is not known here (known are {', '.join(_CALLS)}); dump its value",
                self.path,
                token.line,
            )
        if token.text in CALLS:
            return self._made(token)
        if token.text == "structure":
            return self._array(self._arguments(lambda name: _bare(name) in _NUMBERS))
        given = self._arguments()
        if token.text == "c":
            parts = [np.ravel(value, order="F") for _, value in given]
            return _whole(np.concatenate(parts)) if parts else np.zeros(0)
        if token.text in _AS:
            if len(given) != 1:
                self._fail(f"{token.text}(...) takes one value, and {len(given)} are given")
            return _converted(token.text, given[0][1])
        count = given[0][1] if given else 0
        if len(given) > 1 or np.ndim(count) or not 0 <= count < np.inf:
            self._fail(f"{token.text}(n) takes one length")
        return np.zeros(int(count), _EMPTY[token.text])

    def _made(self, token: _Token) -> np.ndarray:
        given = self._arguments(lambda name: name != "dimnames")
        try:
            return _whole(made(token.text, given))
        except ValueError as error:
            raise FileFormatError(str(error), self.path, token.line) from None

    def _array(self, given: list[tuple[str | None, Any]]) -> np.ndarray:
        parts = {"" if name is None else _bare(name): value for name, value in given}
        data = parts.get("data", parts.get(""))
        if data is None:
            return np.asarray(self._fail("structure(...) holds no data"))
        by_rows = self.is_list and "data" in parts
        shape = tuple(int(n) for n in np.atleast_1d(parts.get("dim", np.size(data))))
        if np.prod(shape) != np.size(data):
            self._fail(
                f".Dim = {shape} takes {np.prod(shape)} numbers, and {np.size(data)} are given"
            )
        return np.asarray(data).reshape(shape, order="C" if by_rows else "F")


def _bare(name: str) -> str:
    """``.Dim`` and ``dim`` are one: older and newer versions of R."""
    return name.lstrip(".").lower()


def _converted(call: str, value: Any) -> np.ndarray:
    """As R converts: dimensions go, fractions are cut off towards zero, missing values stay."""
    flat = np.ravel(value, order="F") if np.ndim(value) > 1 else np.asarray(value)
    known = ~np.isnan(flat)
    if call == "as.integer":
        return _whole(np.where(np.isfinite(flat), np.trunc(flat), np.nan))[()]
    if call == "as.logical":
        return flat != 0 if known.all() else np.where(known, flat != 0, np.nan)
    return flat


def _whole(values: np.ndarray) -> np.ndarray:
    """As integers where that loses nothing."""
    if (
        np.isfinite(values).all()
        and (values == np.rint(values)).all()
        and (abs(values) < 2**53).all()
    ):
        return np.asarray(values).astype(np.int64)
    return values
