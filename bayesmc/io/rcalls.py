"""Calls of R that make arrays out of others: ``rep``, ``seq``, ``matrix``, ``array``.

No dump writes them; people do, in data files for JAGS and Stan.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np


def made(call: str, given: Sequence[tuple[str | None, Any]]) -> np.ndarray:
    """What a call returns in R.

    Parameters
    ----------
    call : str
        A key of `CALLS`.
    given : sequence of (str or None, array)
        Arguments in order, with their names where they have some; a name may be cut short.

    Raises
    ------
    ValueError
        What is wrong with them, in words.

    References
    ----------
    R Core Team, R Language Definition, section 4.3.2 (argument matching).

    Examples
    --------
    >>> made("rep", [(None, np.array([1, 2])), ("each", 2)]).tolist()
    [1, 1, 2, 2]
    >>> made("matrix", [(None, np.arange(4)), ("nrow", 2), ("byrow", True)]).tolist()
    [[0, 1], [2, 3]]
    """
    known = CALLS[call]
    return known.make(**_matched(call, known.arguments, given))


# ---- private ------------------------------------------------------------------------------------


def _matched(
    call: str, arguments: Sequence[str], given: Sequence[tuple[str | None, Any]]
) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in given:
        if name is None:
            continue
        fits = [a for a in arguments if a == name] or [a for a in arguments if a.startswith(name)]
        if len(fits) != 1:
            raise ValueError(
                f"{call}(...) has no argument {name!r} here (it has {', '.join(arguments)})"
            )
        if fits[0] in found:
            raise ValueError(f"{call}(...) is given {fits[0]!r} twice")
        found[fits[0]] = value
    free = [a for a in arguments if a not in found]
    plain = [value for name, value in given if name is None]
    if len(plain) > len(free):
        raise ValueError(f"{call}(...) is given too much (it has {', '.join(arguments)})")
    found.update(zip(free, plain, strict=False))
    # "from" is no name of Python's
    return {f"{name.replace('.', '_')}{'_' * (name == 'from')}": v for name, v in found.items()}


def _rep(x: Any = None, times: Any = 1, length_out: Any = None, each: Any = 1) -> np.ndarray:
    if x is None:
        raise ValueError("rep(...) is given nothing to repeat")
    values = np.repeat(np.ravel(x, order="F"), _count("rep", "each", each))
    if length_out is not None:
        return _filled("rep", values, _count("rep", "length.out", length_out))
    if np.ndim(times) == 0 or np.size(times) == 1:
        return np.tile(values, _count("rep", "times", times))
    if np.size(times) != values.size:
        raise ValueError(
            f"rep(...) has {values.size} values, and times has {np.size(times)}: one for each, or one for all"
        )
    return np.repeat(values, [_count("rep", "times", n) for n in np.ravel(times)])


def _seq(from_: Any = 1, to: Any = None, by: Any = None, length_out: Any = None) -> np.ndarray:
    start = from_
    known = [v for v in (start, to, by) if v is not None]
    if any(np.size(v) != 1 for v in known) or not np.isfinite(np.asarray(known, dtype=float)).all():
        raise ValueError("seq(...) takes single numbers")
    if length_out is not None:
        count = _count("seq", "length.out", length_out)
        step = by if by is not None else (1 if to is None else (to - start) / max(count - 1, 1))
        return start + step * np.arange(count)
    if to is None:
        return np.arange(1, _count("seq", "from", start) + 1)
    step = by if by is not None else (1 if to >= start else -1)
    if step == 0 or (to - start) * step < 0:
        raise ValueError(f"seq(...) does not get from {start} to {to} by {step}")
    return start + step * np.arange(int((to - start) / step + 1e-10) + 1)


def _matrix(
    data: Any = np.nan, nrow: Any = None, ncol: Any = None, byrow: Any = False
) -> np.ndarray:
    size = np.size(data)
    rows = None if nrow is None else _count("matrix", "nrow", nrow)
    columns = None if ncol is None else _count("matrix", "ncol", ncol)
    if rows is None:
        rows = size if columns is None else -(-size // max(columns, 1))
    if columns is None:
        columns = -(-size // max(rows, 1))
    values = _filled("matrix", np.ravel(data, order="F"), rows * columns)
    return values.reshape((rows, columns), order="C" if byrow else "F")


def _array(data: Any = np.nan, dim: Any = None) -> np.ndarray:
    shape = [np.size(data)] if dim is None else [_count("array", "dim", n) for n in np.ravel(dim)]
    filled = _filled("array", np.ravel(data, order="F"), int(np.prod(shape)))
    return filled.reshape(shape, order="F")


def _filled(call: str, values: np.ndarray, size: int) -> np.ndarray:
    """Values from the first on again until there are enough, as R does; whole rounds for shapes."""
    if values.size == 0 and size:
        raise ValueError(f"{call}(...) has no values to fill {size} places with")
    if call != "rep" and values.size and size % values.size:
        raise ValueError(
            f"{call}(...) has {size} places, and {values.size} values do not fill them"
        )
    return np.resize(values, size)


def _count(call: str, name: str, value: Any) -> int:
    if np.size(value) != 1 or not np.isfinite(np.ravel(value)[0]) or np.ravel(value)[0] < 0:
        raise ValueError(f"{call}(...): {name} is one number, 0 or more")
    return int(np.ravel(value)[0])


class _Call(NamedTuple):
    arguments: tuple[str, ...]
    make: Callable[..., np.ndarray]


CALLS = {
    "rep": _Call(("x", "times", "length.out", "each"), _rep),
    "seq": _Call(("from", "to", "by", "length.out"), _seq),
    "matrix": _Call(("data", "nrow", "ncol", "byrow"), _matrix),
    "array": _Call(("data", "dim"), _array),
}
