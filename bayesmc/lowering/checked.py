"""Machine code that is held against NumPy before it is used, and used where it saves time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from bayesmc.errors import TraceError
from bayesmc.expression import Expression, Program, ordered
from bayesmc.lowering.compiled import Compiled, compiled
from bayesmc.lowering.layout import written_out

#: seconds in NumPy of one node of a graph, and of one element
_NODE, _ELEMENT = 1e-6, 1.5e-9
#: seconds that a question takes in NumPy for which nothing is compiled
_WORTH = 0.1
#: seconds that compiling takes for one element that is written out, and for two of the same code
_ONE, _PAIR = 2e-4, 5e-8
#: how far results may be off, relative to the largest element of each
_RTOL = 1e-9
#: and relative to what one rounding of each matrix does to them
_ROUNDINGS = 1e3


def is_worth_it(roots: Sequence[Expression], calls: int, entries: int = 1, beside: int = 0) -> bool:
    """Whether so many calls, of so many entries each, take longer in NumPy than compiling.

    And longer than a tenth of a second. By a count of nodes and elements, not by a clock: the same question
    is answered the same way again.

    Parameters
    ----------
    roots : sequence of Expression
    calls, entries : int
    beside : int
        Steps in NumPy that each call takes besides, and machine code does not.
    """
    nodes = ordered(*roots)
    seconds = calls * (
        _NODE * (len(nodes) + beside) + _ELEMENT * entries * sum(n.size for n in nodes)
    )
    written = written_out(nodes)
    return seconds > max(_WORTH, _ONE * written + _PAIR * written**2)


def held_against_numpy(
    roots: Sequence[Expression],
    points: Iterable[Mapping[str, np.ndarray]],
    debug: bool = False,
    disturbed: Sequence[Expression] = (),
) -> Compiled | Compared:
    """Machine code that gives what ``Program`` does at some points.

    Parameters
    ----------
    roots : sequence of Expression
    points : iterable of dict
        Values of the leaves, with any batch.
    debug : bool
        Compare at every later call, too.
    disturbed : sequence of Expression, optional
        The same roots as rounding may change them (``passes.rounding``): how near they have to be.

    Raises
    ------
    TraceError
        There is no machine code, or it gives something else: which, and why.
    """
    made = Compared(compiled(roots), disturbed)
    for values in points:
        made(values)
    return made if debug else made.run


class Compared:
    """Machine code that is held against NumPy at every call.

    Parameters
    ----------
    run : Compiled
    disturbed : sequence of Expression, optional
    """

    def __init__(self, run: Compiled, disturbed: Sequence[Expression] = ()) -> None:
        self.run, self.disturbed = run, disturbed

    def __call__(self, values: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        """What both give.

        Raises
        ------
        TraceError
        """
        found, wanted = self.run(values), self.run.program(values)
        for root, a, b in zip(self.run.roots, found, wanted, strict=True):
            off = _difference(a, np.asarray(b))
            if off is not None and self.disturbed:
                off = _difference(a, np.asarray(b), self._doubts(values)[root])
            if off is not None:
                raise TraceError(f"machine code of {root!r} {off}")
        return found

    # ---- private -------------------------------------------------------------------------------

    def _doubts(self, values: Mapping[str, np.ndarray]) -> dict[Expression, _Doubt]:
        found, roots = {}, self.run.roots
        others = Program(self.disturbed)(values)
        for root, a, b in zip(roots, self.run.program(values), others, strict=True):
            event = tuple(range(-len(root.shape), 0))
            is_same = (a == b) | (np.isnan(a) & np.isnan(b))
            with np.errstate(invalid="ignore"):
                off = np.where(is_same, 0.0, np.abs(np.subtract(a, b, dtype=float)))
            open_ = ~np.isfinite(off)
            found[root] = _Doubt(np.where(open_, 0.0, off).max(axis=event, keepdims=True), open_)
        return found


class _Doubt(NamedTuple):
    """How far rounding takes a root, the most of any element; where it decides whether there is a number."""

    far: Any = 0.0
    undecided: Any = False


_NO_DOUBT = _Doubt()


# ---- private ------------------------------------------------------------------------------------


def _difference(found: np.ndarray, wanted: np.ndarray, doubt: _Doubt = _NO_DOUBT) -> str | None:
    if found.shape != wanted.shape:
        return f"has the shape {found.shape}, not {wanted.shape}"
    if wanted.dtype.kind != "f":
        same = found == wanted
    else:
        finite = np.isfinite(wanted)
        scale = 1.0 + np.abs(wanted[finite]).max(initial=0.0)
        with np.errstate(all="ignore"):
            near = np.abs(found - wanted) <= _RTOL * scale + _ROUNDINGS * doubt.far
        same = np.where(finite, near, (found == wanted) | (np.isnan(found) & np.isnan(wanted)))
        # two numbers have to be near each other all the same
        same = same | (doubt.undecided & ~(np.isfinite(found) & np.isfinite(wanted)))
    if same.all():
        return None
    at = int(np.argmin(same))
    return f"gives {found.flat[at]!s} at element {at}, and NumPy {wanted.flat[at]!s}"
