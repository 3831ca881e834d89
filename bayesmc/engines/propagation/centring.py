"""Where coordinates are counted from: next to where they will end, so that natural parameters do not cancel.

The log integral of ``exp(h x - p x^2 / 2)`` is ``h^2 / (2 p)`` and more, which grows with the square of how
many standard deviations x is away from 0, and is taken out again by what the rows say there. Counted from a
first answer all of that is of the size of residuals.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from bayesmc.engines.propagation.beliefs import Beliefs
from bayesmc.engines.propagation.coordinates import Numbers
from bayesmc.engines.propagation.density import Read
from bayesmc.engines.propagation.kernels import Density, Probit
from bayesmc.engines.propagation.scopes import Rows
from bayesmc.gaussian import try_cholesky

#: standard deviations from 0 from which on it matters, and how often the first answer is made anew
_FAR, _PASSES = 100.0, 2

#: middles and spreads of all coordinates under the prior, roughly
Prior = Callable[[], tuple[np.ndarray, np.ndarray]]


def centre_of(
    component: np.ndarray,
    rows: Sequence[Rows],
    reads: Sequence[Read],
    numbers: Mapping[str, Numbers],
    prior: Prior,
) -> np.ndarray:
    """From where coordinates are counted, shape (coordinates,); zeros where nothing is far from 0.

    A first answer by the rows that no finite variable switches; of components that these leave improper, by
    the prior, too. Mapped coordinates are counted from 0.

    Parameters
    ----------
    component : ndarray of int, shape (coordinates,)
    rows, reads : what factors say of coordinates
    numbers : dict
    prior : callable
        Asked where it is needed.
    """
    centre, plain = np.zeros(len(component)), np.zeros(len(component), dtype=bool)
    for x in numbers.values():
        if x.is_plain:
            plain[x.at[x.at >= 0]] = True
    loose = any(read.name in numbers and numbers[read.name].is_plain for read in reads)
    if loose:
        middle, spread = prior()
        loose = bool((plain & (np.abs(middle) > _FAR * spread)).any())
    for _ in range(_PASSES):
        moved = [moved_rows(row, centre) for row in rows]
        far = any((np.abs(row.rows[..., -1]) > _FAR).any() for row in moved)
        if not (far or loose):
            break
        centre, loose = (
            centre + np.where(plain, _first(component, moved, centre, prior), 0.0),
            False,
        )
    return centre


def moved_rows(row: Rows, centre: np.ndarray) -> Rows:
    """Rows of coordinates that are counted from ``centre``.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.engines.propagation.centring import moved_rows
    >>> from bayesmc.engines.propagation.scopes import Rows
    >>> row = Rows("y", 0, (), np.array([0]), np.array([[2.0, 7.0]]), np.array(0.0), False)
    >>> moved_rows(row, np.array([3.0])).rows.tolist()
    [[2.0, 1.0]]
    """
    own = centre[row.coordinates]
    if not own.any():
        return row
    rows = row.rows.copy()
    rows[..., -1] -= rows[..., :-1] @ own
    return replace(row, rows=rows)


def moved_read(read: Read, centre: np.ndarray) -> Read:
    """Factors of directions of coordinates that are counted from ``centre``."""
    kernel, own = read.kernel, centre[read.coordinates]
    if not own.any():
        return read
    along = np.matvec(read.weights, own)
    if isinstance(kernel, Probit):
        moved: Probit | Density = replace(kernel, offset=kernel.offset + kernel.gain * along[:, 0])
    else:
        assert isinstance(kernel, Density)
        moved = replace(kernel, offset=kernel.offset + np.matvec(kernel.gain, along[:, None]))
    return replace(read, kernel=moved)


# ---- private ------------------------------------------------------------------------------------


def _first(
    component: np.ndarray, rows: Sequence[Rows], centre: np.ndarray, prior: Prior
) -> np.ndarray:
    """Means by rows that nothing switches, of coordinates as these count them."""
    beliefs = Beliefs.of(component, (), ())
    for row in rows:
        if not row.scope and len(row.coordinates):
            beliefs.enter(row.coordinates, row.rows[..., :-1], row.rows[..., -1])
    found = np.zeros(len(component))
    for k, block in enumerate(beliefs.blocks):
        if not len(block.linear):
            continue
        mine = np.flatnonzero(beliefs.size == k)
        place = beliefs.component[mine], beliefs.place[mine]
        _, bad = try_cholesky(block.precision)
        if bad is not None and bad.any():
            middle, spread = prior()
            weak, vague = np.zeros_like(block.linear), np.zeros_like(block.linear)
            weak[place], vague[place] = spread[mine] ** -2.0, (middle - centre)[mine]
            weak = np.where(bad[:, None], weak, 0.0)
            block.linear += weak * vague
            block.precision += weak[..., None] * np.eye(weak.shape[-1])
        if not block.refreshed().any():
            found[mine] = block.mean[place]
    return np.where(np.isfinite(found), found, 0.0)
