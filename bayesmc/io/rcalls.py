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

#: numbers beyond which a few characters of a file fill no memory
_MOST = 10**8


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
    flat = np.ravel(x, order="F")
    values = np.repeat(
        flat, _bounded("rep", flat.size * _count("rep", "each", each)) // max(flat.size, 1)
    )
    if length_out is not None:
        return _filled("rep", values, _count("rep", "length.out", length_out))
    if np.ndim(times) == 0 or np.size(times) == 1:
        count = _count("rep", "times", times)
        _bounded("rep", float(values.size) * count)
        return np.tile(values, count)
    if np.size(times) != values.size:
        raise ValueError(
            f"rep(...) has {values.size} values, and times has {np.size(times)}: one for each, or one for all"
        )
    counts = [_count("rep", "times", n) for n in np.ravel(times)]
    _bounded("rep", float(sum(counts)))
    return np.repeat(values, counts)


def _seq(from_: Any = None, to: Any = None, by: Any = None, length_out: Any = None) -> np.ndarray:
    given = [v for v in (from_, to, by) if v is not None]
    if to is None and by is None and length_out is None:
        if np.size(from_) > 1:
            return np.arange(1, np.size(from_) + 1)
        to, from_ = from_, 1
    if any(np.size(v) != 1 for v in given) or not np.isfinite(np.array(given, dtype=float)).all():
        raise ValueError("seq(...) takes single numbers")
    if length_out is None:
        return _stepped(1 if from_ is None else from_, 1 if to is None else to, by)
    if len(given) == 3:
        raise ValueError("seq(...) takes three of from, to, by and length.out")
    count = _count("seq", "length.out", np.ceil(length_out))
    if from_ is not None and to is not None:
        return np.linspace(from_, to, count)
    step = 1 if by is None else by
    first = to - (count - 1) * step if to is not None else 1 if from_ is None else from_
    return first + step * np.arange(count)


def _stepped(first: Any, last: Any, by: Any) -> np.ndarray:
    """From one number to another; the last one is not passed by what rounding adds."""
    step = by if by is not None else (1 if last >= first else -1)
    if first == last:
        return np.array([first])
    if step == 0 or (last - first) / step < 0:
        raise ValueError(f"seq(...) does not get from {first} to {last} by {step}")
    count = _bounded("seq", (last - first) / step + 1 + 1e-10)
    found = first + step * np.arange(count)
    return np.minimum(found, last) if step > 0 else np.maximum(found, last)


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
    if np.size(byrow) != 1:
        raise ValueError("matrix(...): byrow is TRUE or FALSE")
    values = _filled("matrix", np.ravel(data, order="F"), _bounded("matrix", float(rows) * columns))
    return values.reshape((rows, columns), order="C" if np.all(byrow) else "F")


def _array(data: Any = np.nan, dim: Any = None) -> np.ndarray:
    shape = [np.size(data)] if dim is None else [_count("array", "dim", n) for n in np.ravel(dim)]
    size = _bounded("array", np.prod(shape, dtype=float))
    filled = _filled("array", np.ravel(data, order="F"), size)
    return filled.reshape(shape, order="F")


def _filled(call: str, values: np.ndarray, size: int) -> np.ndarray:
    """Values from the first on again until there are enough; shapes take whole rounds, where R warns."""
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
    return _bounded(call, np.ravel(value)[0])


def _bounded(call: str, count: float) -> int:
    if count > _MOST:
        raise ValueError(f"{call}(...) makes {count:.3g} numbers, more than {_MOST:.0e}")
    return int(count)


class _Call(NamedTuple):
    arguments: tuple[str, ...]
    make: Callable[..., np.ndarray]


CALLS = {
    "rep": _Call(("x", "times", "length.out", "each"), _rep),
    "seq": _Call(("from", "to", "by", "length.out"), _seq),
    "matrix": _Call(("data", "nrow", "ncol", "byrow"), _matrix),
    "array": _Call(("data", "dim"), _array),
}
