"""The one loop behind all readers of logs: lines in, typed records out, and account of the rest.

A format is a function from a line to a record, or to ``Ignored`` for what is well formed and of no
interest; it raises ``FileFormatError`` with the reason for a line that does not read. Everything
else, from a damaged file to times that run backwards, is dealt with here, and the same for all.
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Generic, Literal, NamedTuple, TypeVar, cast

from bayesmc.errors import FileFormatError, LogWarning
from bayesmc.robotics.logs.records import Record, Timed
from bayesmc.robotics.logs.sources import Line, Source, checked, lines_of, name_of

R = TypeVar("R", bound=Record)

OnError = Literal["raise", "skip"]
BadRanges = Literal["fault", "max"]

_AHEAD = 100
"""Lines after a fault in which anything that reads shows that the log is of its kind."""

_NOTHING = ("blank", "comment")
"""Kinds of ignored lines that files of any kind have."""

MAX_GAP = 60.0
"""A time further ahead than this (s) counts only if the next record does not come back from it."""


@dataclass(frozen=True)
class LogFault:
    """A line that was left out.

    Parameters
    ----------
    line : int
        Its number, from 1; where a file breaks off, the number after the last line.
    text : str
        Its first 200 characters.
    why : str
    """

    line: int
    text: str
    why: str


class Ignored(NamedTuple):
    """A line that is well formed and says nothing of interest; ``kind`` is what it is counted as."""

    kind: str


_Result = Record | Ignored | str  # the last is why the line is a fault
_Outcome = tuple[
    int, str, _Result
]  # with the line's number and text; a plain tuple is quick to make

Format = Callable[[str], R | Ignored]
"""From a line to what it says; raises ``FileFormatError`` with the reason where it does not read."""


class Reading(Iterator[R], Generic[R]):
    """An iterator over a log's records that keeps account of every line.

    Always ``lines == records + len(faults) + sum(ignored.values())`` when it is exhausted. In the mode
    ``"raise"`` the error comes after all records before the line at fault, and the iterator can be
    asked on: the next record is the one after that line.

    A record is a fault where its time is more than ``tolerance`` before the latest one, and where it
    is more than ``MAX_GAP`` ahead and the next record comes back from there: one garbled time would
    make faults of all the rest. For that, the first record and one after a gap wait for the next.

    Parameters
    ----------
    source : path, open file or iterable of lines
        A path may be gzipped, whatever its name.
    parse : callable
        The format.
    on_error : {"raise", "skip"}
        Whether a fault is raised, or collected in ``faults`` and warned about once at the end.
    tolerance : float
        How far, in s, time may run backwards; ``math.inf`` for times in any order.
    kind : str
        What the log should be, for the message about one of which no line reads.

    Raises
    ------
    OSError
        At once, where a path cannot be opened.
    ValueError
        At once, for an unknown ``on_error`` or a negative ``tolerance``.
    FileFormatError
        At once for a file in UTF-16; in the mode ``"raise"`` at the first fault, with ``path`` and
        ``line``; in both modes at the end of a log of which no line reads: it is of another kind.

    Warns
    -----
    LogWarning
        When the log is exhausted and lines were skipped as faults.

    Examples
    --------
    >>> from bayesmc.robotics.logs import read_wean
    >>> log = read_wean(["O 100 0 0 0.1", "O 200 0 0", "O 300 0 0 0.3"])
    >>> next(log).pose
    array([1., 0., 0.])
    >>> next(log)
    Traceback (most recent call last):
      ...
    bayesmc.errors.FileFormatError: <lines>:2: O has 4 fields, not 5: 'O 200 0 0'; on_error='skip' ...
    >>> next(log).t, log.lines, log.records, log.faults[0].line
    (0.3, 3, 2, 2)
    """

    def __init__(
        self,
        source: Source,
        parse: Format[R],
        *,
        on_error: OnError = "raise",
        tolerance: float = 0.0,
        kind: str = "a log of this kind",
    ) -> None:
        if on_error not in ("raise", "skip"):
            raise ValueError(f"on_error={on_error!r}: give 'raise' or 'skip'")
        if not tolerance >= 0.0:
            raise ValueError(f"tolerance={tolerance!r}: give seconds, 0 or more")
        self.name = name_of(source)
        self._skips, self._kind = on_error == "skip", kind
        parsed = _parsed(lines_of(checked(source)), parse)
        self._outcomes: Iterator[_Outcome] = (
            parsed if tolerance == math.inf else in_order(parsed, tolerance)
        )
        self._faults: list[LogFault] = []
        self._ignored: Counter[str] = Counter()
        self._records = 0
        self._has_warned = False

    def __next__(self) -> R:
        for number, text, result in self._outcomes:
            if isinstance(result, Record):
                self._records += 1
                return cast("R", result)
            if isinstance(result, Ignored):
                self._ignored[result.kind] += 1
                continue
            self._faults.append(LogFault(number, text[:200], result))
            if not self._skips:
                advice = "on_error='skip' leaves such lines out"
                if not self._reads() and not self._will_read():
                    advice = f"is this {self._kind}?"
                raise FileFormatError(f"{result}: {_excerpt(text)}; {advice}", self.name, number)
        if self._faults and self._skips and not self._has_warned:
            self._has_warned = True
            if not self._reads():
                first = self._faults[0]
                raise FileFormatError(
                    f"no line reads, this one since {first.why}: {_excerpt(first.text)}; is this "
                    f"{self._kind}?",
                    self.name,
                    first.line,
                )
            warnings.warn(self._summary(), LogWarning, stacklevel=2)
        raise StopIteration

    @property
    def lines(self) -> int:
        """How many lines have been dealt with."""
        return self._records + len(self._faults) + self._ignored.total()

    @property
    def records(self) -> int:
        """How many records have been handed out."""
        return self._records

    @property
    def faults(self) -> tuple[LogFault, ...]:
        """The lines at fault so far, in their order."""
        return tuple(self._faults)

    @property
    def ignored(self) -> Mapping[str, int]:
        """How many lines of each kind said nothing of interest: comments, other messages."""
        return MappingProxyType(dict(self._ignored))

    def __repr__(self) -> str:
        return (
            f"<Reading of {self.name}: {self.records} records, {len(self._faults)} faults and "
            f"{self._ignored.total()} ignored in {self.lines} lines>"
        )

    def _reads(self) -> bool:
        """Whether any line has shown that the log is of its kind."""
        return bool(self._records) or any(kind not in _NOTHING for kind in self._ignored)

    def _will_read(self) -> bool:
        """Whether one of the next lines does."""
        ahead = list(itertools.islice(self._outcomes, _AHEAD))
        self._outcomes = itertools.chain(ahead, self._outcomes)
        results = (result for _, _, result in ahead)
        return any(
            isinstance(result, Record)
            or (isinstance(result, Ignored) and result.kind not in _NOTHING)
            for result in results
        )

    def _summary(self) -> str:
        first = self._faults[0]
        return (
            f"{self.name}: {len(self._faults)} of {self.lines} lines were skipped, the first at line "
            f"{first.line}: {first.why}; all are in the reader's faults"
        )


def numbers(fields: Sequence[str], first: int = 1) -> list[float]:
    """Finite numbers of fields; ``first`` is the place in the line that a message gives the first one.

    Raises
    ------
    FileFormatError
        For a field that is not a number, NaN or infinite. Python's own spellings ``1_000`` and digits
        of other scripts are no numbers of a log.

    Examples
    --------
    >>> from bayesmc.robotics.logs.reading import numbers
    >>> numbers(["1.5", "-2e-3"])
    [1.5, -0.002]
    """
    values = floats(fields, first)
    # one test for all; values that are finite and huge may get past it as well
    if not math.isfinite(sum(values)):
        for k, value in enumerate(values):
            if not math.isfinite(value):
                raise FileFormatError(f"field {first + k} is not finite ({fields[k]})")
    return values


def floats(fields: Sequence[str], first: int = 1) -> list[float]:
    """Numbers of fields as ``numbers`` takes them, NaN and infinities included."""
    joined = "".join(fields)
    try:
        if joined.isascii() and "_" not in joined:
            return list(map(float, fields))
    except ValueError:
        pass
    k = next(k for k, field in enumerate(fields) if not _is_number(field))
    raise FileFormatError(f"field {first + k} is not a number ({fields[k][:40]!r})")


def whole(field: str, place: int) -> int:
    """A field that is a number of things or of a thing: 0, 1, 2 ...

    Raises
    ------
    FileFormatError
        For anything else.
    """
    if not (field.isascii() and field.isdigit() and len(field) <= 9):
        raise FileFormatError(f"field {place} is not a whole number ({field[:40]!r})")
    return int(field)


def counted(fields: Sequence[str], count: int, what: str) -> None:
    """Nothing, where there are as many fields as there have to be.

    Raises
    ------
    FileFormatError
        Where there are fewer (the line is cut off) or more (two have run together).
    """
    if len(fields) != count:
        raise FileFormatError(f"{what} has {len(fields)} fields, not {count}")


def ranges(
    fields: Sequence[str], first: int, max_range: float, bad: BadRanges = "fault"
) -> list[float]:
    """The ranges of a scan, none of them negative.

    Parameters
    ----------
    fields : sequence of str
    first : int
        Place of the first one in the line.
    max_range : float
        What stands for a beam that saw nothing.
    bad : {"fault", "max"}
        Whether NaN, infinite and negative ranges condemn the scan or count as ``max_range``.

    Raises
    ------
    FileFormatError
        For a field that is no number, and for a bad range unless it counts as ``max_range``.
    """
    if bad == "max":
        return [v if 0.0 <= v < math.inf else max_range for v in floats(fields, first)]
    values = numbers(fields, first)
    if min(values, default=0.0) < 0.0:
        k = next(k for k, value in enumerate(values) if value < 0.0)
        raise FileFormatError(f"range {k + 1} is negative ({fields[k]})")
    return values


def check_ranges(who: str, max_range: float, bad: str) -> None:
    """Nothing, where a reader's arguments about ranges make sense.

    Raises
    ------
    ValueError
        Where they do not.
    """
    if not 0.0 < max_range < math.inf:
        raise ValueError(f"{who}(max_range={max_range!r}): give metres, more than 0")
    if bad not in ("fault", "max"):
        raise ValueError(f"{who}(bad_ranges={bad!r}): give 'fault' or 'max'")


def _parsed(lines: Iterator[Line], parse: Callable[[str], Record | Ignored]) -> Iterator[_Outcome]:
    for number, text, fault in lines:
        result: _Result
        try:
            result = parse(text) if fault is None else fault
        except FileFormatError as error:
            result = str(error)
        yield number, text, result


def in_order(outcomes: Iterator[_Outcome], tolerance: float) -> Iterator[_Outcome]:
    """The outcomes, with faults for the records whose time does not fit the others'.

    An outcome is a number, a text that is passed on, and a record or why there is none.
    """
    latest = -math.inf
    waiting: list[_Outcome] = []  # a record far ahead, and what came after it that has no say
    ahead = -math.inf  # its time
    for outcome in outcomes:
        number, text, result = outcome
        if isinstance(result, Timed):
            t = result.t
            if waiting and t >= latest - tolerance:
                if ahead - t > max(MAX_GAP, tolerance):
                    waiting[0] = (*waiting[0][:2], _leap(ahead - t))
                else:
                    latest = ahead
                yield from waiting
                waiting = []
            if t < latest - tolerance:
                outcome = number, text, f"time runs backwards by {latest - t:.6g} s"
            elif t > latest + MAX_GAP:
                waiting, ahead = [outcome], t
                continue
            else:
                latest = max(latest, t)
        if waiting:
            waiting.append(outcome)
        else:
            yield outcome
    yield from waiting


def _leap(by: float) -> str:
    return f"time leaps ahead by {by:.6g} s and comes back on the next record"


def _is_number(field: str) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return field.isascii() and "_" not in field


def _excerpt(text: str) -> str:
    return repr(text if len(text) <= 60 else text[:60] + "...")
