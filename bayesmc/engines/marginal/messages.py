"""What later rows say of the numbers of a slice: likelihoods of Gaussians in square-root information form.

Given all that is sampled from a slice on, the density of the rows after it is, as a function of the numbers m
that the next slice reads,

    exp(-|matrix @ m - vector|^2 / 2)

up to a constant: a root of the information matrix, and the vector that goes with it. ``matrix`` has no more
rows than m has numbers, fewer where rows do not tell all of them. No density of a transition is asked for,
so numbers without noise of their own are nothing special: what is told without noise is told with 10^-9 of
its own size, which is far below what rounding leaves of a likelihood.

References
----------
Lindsten, Bunch, Särkkä, Schön and Godsill (2016), Rao-Blackwellized particle smoothers for conditionally
linear Gaussian models, IEEE J. Sel. Topics Signal Process. 10, sec. IV (backward information); Kailath, Sayed
and Hassibi (2000), Linear Estimation, ch. 12 (array algorithms).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bayesmc.engines.kalman.data import Pattern
from bayesmc.engines.kalman.slices import Layout
from bayesmc.engines.marginal.gaussians import Coefficients, Gaussians
from bayesmc.gaussian import solve_lower

#: noise of what is told without noise, relative to the size of the terms that it is the sum of
_EXACT = 1e-9
#: numbers of matrices of pairs that are worked on at once
_ENTRIES = 1 << 20


class Message(NamedTuple):
    """Of some draws, which share ``matrix`` where they sampled what it depends on alike.

    Attributes
    ----------
    matrix : ndarray, shape (kinds, *lead, r, c)
    vector : ndarray, shape (draws, *lead, r)
    kind : ndarray of int, shape (draws,)
    """

    matrix: np.ndarray
    vector: np.ndarray
    kind: np.ndarray

    def taken(self, at: np.ndarray) -> Message:
        """Of some of the draws."""
        return Message(self.matrix, self.vector.take(at, axis=0), self.kind.take(at))


def uninformative(draws: int, lead: tuple[int, ...], numbers: int) -> Message:
    """After the last row."""
    matrix, vector = np.zeros((1, *lead, 0, numbers)), np.zeros((draws, *lead, 0))
    return Message(matrix, vector, np.zeros(draws, dtype=np.intp))


def sizes_of(before: Gaussians) -> np.ndarray:
    """How large the numbers that a slice reads are, shape (*lead, c)."""
    c = before.layout.carried
    rows = before.factors[..., :c, :]
    spread = np.sqrt(np.vecdot(rows, rows)).min(axis=0)
    found: np.ndarray = np.abs(before.mean[..., :c]).max(axis=0) + spread
    return found


def pulled(
    after: Message,
    layout: Layout,
    pattern: Pattern,
    found: Coefficients,
    row: np.ndarray,
    sizes: np.ndarray,
) -> tuple[Message, np.ndarray]:
    """What a slice's row and those after it say of the slice before; and the logs of the constants.

    Parameters
    ----------
    after : Message
        To this slice.
    layout, pattern
        Of this slice, and what is observed in it.
    found : Coefficients
        Of this slice, for each draw, with one choice.
    row : ndarray, shape (*lead, observed)
    sizes : ndarray, shape (*lead, c)
        How large the numbers of the slice before are.

    Returns
    -------
    Message
    ndarray, shape (draws, *lead)
    """
    draws, places = len(after.vector), np.arange(layout.p, layout.p + layout.carried)
    theirs = np.arange(draws) if found.kind is None else found.kind
    pairs, kind = np.unique(after.kind * len(found.moves) + theirs, return_inverse=True)
    of_matrix, of_slice = pairs // len(found.moves), pairs % len(found.moves)
    matrix = after.matrix.take(of_matrix, axis=0)
    moves, noise = found.moves[of_slice, 0], found.noise[of_slice, 0]
    told = moves[..., pattern.observed, :]
    terms = np.abs(told) @ sizes[..., None] + np.abs(row)[..., None]
    own = _noise_of(pattern, matrix, noise, places, terms)
    whole = np.concatenate([told, matrix @ moves[..., places, :]], axis=-2)
    if pattern.absent is not None:
        whole[..., : len(pattern.observed), :][..., pattern.absent, :] = 0.0
    root = np.matrix_transpose(np.linalg.qr(np.matrix_transpose(own), mode="r"))
    diagonal = root.diagonal(0, -2, -1)
    root = root * np.where(diagonal < 0, -1.0, 1.0)[..., None, :]
    inverse = np.matrix_transpose(solve_lower(root[..., None, :, :], np.eye(root.shape[-1])))
    basis, short = np.linalg.qr(inverse @ whole)
    offset = found.offset[:, 0]
    off = np.concatenate(
        [row - offset[..., pattern.observed],
         after.vector - np.matvec(after.matrix[after.kind], offset[..., places])],
        axis=-1,
    )  # fmt: skip
    if pattern.absent is not None:
        off[..., : len(pattern.observed)] = np.where(
            pattern.absent, 0.0, off[..., : len(pattern.observed)]
        )
    eta = _times(inverse, kind, off)
    vector = _times(np.matrix_transpose(basis), kind, eta)
    left = eta - _times(basis, kind, vector)
    log = -0.5 * np.vecdot(left, left) - np.log(np.abs(diagonal)).sum(axis=-1)[kind]
    return Message(short, vector, kind), log


def log_evidence(
    message: Message, of: np.ndarray, beliefs: Gaussians, about: np.ndarray
) -> np.ndarray:
    """Log of the mean of ``exp(-|matrix @ m - vector|^2 / 2)``, by the beliefs about m.

    Parameters
    ----------
    message : Message
    of : ndarray of int, shape (pairs,)
        Which draw's message.
    beliefs : Gaussians
    about : ndarray of int, shape (pairs,)
        Which particle's belief.

    Returns
    -------
    ndarray, shape (pairs, *lead)
    """
    lead, (r, c) = beliefs.layout.lead, message.matrix.shape[-2:]
    found = np.zeros((len(of), *lead))
    if not r:
        return found
    pools = len(beliefs.factors)
    theirs = about if beliefs.which is None else beliefs.which[about]
    kinds = len(message.matrix) * pools
    shared = kinds <= max(len(of) // 4, 1)
    made = _joined(message.matrix[:, None], beliefs.factors[None, ..., :c, :]) if shared else None
    step = max(1, _ENTRIES // (r * beliefs.factors.shape[-1] * max(int(np.prod(lead)), 1)))
    for low in range(0, len(of), step):
        at = slice(low, low + step)
        matrix = message.matrix[message.kind[of[at]]]
        if made is not None:
            root = made[message.kind[of[at]], theirs[at]]
        else:
            root = _joined(matrix, beliefs.factors[theirs[at]][..., :c, :])
        off = message.vector[of[at]] - np.matvec(matrix, beliefs.mean[about[at]][..., :c])
        eta = solve_lower(root, off)
        log_det = np.log(root.diagonal(0, -2, -1)).sum(axis=-1)
        found[at] = -0.5 * np.vecdot(eta, eta) - log_det
    return found


def combined(message: Message, beliefs: Gaussians) -> Gaussians:
    """Each draw's belief with what later rows say."""
    r, c = message.matrix.shape[-2:]
    if not r:
        return beliefs._replace(over=None)
    draws = len(beliefs.mean)
    theirs = np.arange(draws) if beliefs.which is None else beliefs.which
    pools = len(beliefs.factors)
    pairs, which = np.unique(message.kind * pools + theirs, return_inverse=True)
    matrix, factors = message.matrix[pairs // pools], beliefs.factors[pairs % pools]
    seen = matrix @ factors[..., :c, :]
    unit = np.broadcast_to(np.eye(seen.shape[-1]), (*seen.shape[:-2], *[seen.shape[-1]] * 2))
    basis, upper = np.linalg.qr(np.concatenate([seen, unit], axis=-2))
    after = solve_lower(np.matrix_transpose(upper)[..., None, :, :], factors)
    gain = after, np.matrix_transpose(basis[..., :r, :])  # one after the other: rows may be huge
    off = message.vector - np.matvec(message.matrix[message.kind], beliefs.mean[..., :c])
    mean = beliefs.mean + _times(gain[0], which, _times(gain[1], which, off))
    return beliefs._replace(mean=mean, factors=after, which=which, over=None)


# ---- private ------------------------------------------------------------------------------------


def _noise_of(
    pattern: Pattern, matrix: np.ndarray, noise: np.ndarray, places: np.ndarray, terms: np.ndarray
) -> np.ndarray:
    """Rows of the noise of what is observed, and of what is told of the slice after, by its own."""
    seen, (r, q) = len(pattern.observed), (matrix.shape[-2], noise.shape[-1])
    lead = np.broadcast_shapes(matrix.shape[:-2], noise.shape[:-2])
    found = np.zeros((*lead, seen + r, q + seen + r))
    found[..., :seen, :q] = noise[..., pattern.observed, :]
    found[..., seen:, :q] = matrix @ noise[..., places, :]
    own = _EXACT * terms[..., 0] + 1e-300
    if pattern.absent is not None:
        found[..., :seen, :q][..., pattern.absent, :] = 0.0
        own = np.where(pattern.absent, 1.0, own)
    each = np.arange(seen)
    found[..., each, q + each] = own
    each = np.arange(seen, seen + r)
    found[..., each, q + each] = 1.0
    return found


def _joined(matrix: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """Roots of the covariances of what is looked at, with noise of its own."""
    seen = matrix @ factors
    return np.linalg.cholesky(seen @ np.matrix_transpose(seen) + np.eye(seen.shape[-2]))


def _times(matrices: np.ndarray, kind: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Each draw's matrix times its vector."""
    if len(matrices) == 1:
        return np.matvec(matrices[0], vectors)
    return np.matvec(matrices[kind], vectors)
