"""Forward over the slices of a switching system, and back: one mixture over modes is carried along.

Forward, every mode has a Gaussian. What the rules differ in is when Gaussians are merged: GPB2 takes all of
them through all modes of the next slice and merges what meets in a mode; IMM merges before, with the weights
that the next mode gives them; GPB1 carries one Gaussian, merged over all modes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bayesmc.engines.kalman.covariances import full_factor
from bayesmc.engines.kalman.data import Pattern
from bayesmc.engines.kalman.means import absorbed
from bayesmc.engines.kalman.slices import Layout
from bayesmc.engines.switching.merging import Mixture, merged, shares
from bayesmc.engines.switching.stretches import Stretch
from bayesmc.linalg.square_root import Conditioned, condition, condition_many, log_densities
from bayesmc.lowering import GaussianLoops

#: directions of a root that are shorter than this share of the longest, row by row, are known exactly
_NOTHING = 1e-10


class Place(NamedTuple):
    """A slice with its row.

    Attributes
    ----------
    stretch : Stretch
    at : int
        Which slice of the stretch.
    pattern : Pattern
    row : ndarray, shape (*lead, observed)
    given : ndarray, shape (*lead, n), or None
        Values of unknown numbers that are observed; of several slices time is first.
    is_carried : bool
        Whether the next slice reads some of those.
    """

    stretch: Stretch
    at: int
    pattern: Pattern
    row: np.ndarray
    given: np.ndarray | None
    is_carried: bool

    @property
    def layout(self) -> Layout:
        return self.stretch.layout


def nothing(layout: Layout) -> Mixture:
    """What stands before slice 0."""
    lead = layout.lead
    return Mixture(np.zeros((1, *lead)), np.zeros((1, *lead, 0)), np.zeros((1, *lead, 0, 0)))


def advanced(
    merging: str, before: Mixture | None, place: Place, loops: GaussianLoops | None = None
) -> tuple[Mixture, np.ndarray]:
    """The modes of a slice given its row and those before, and the log density of the row.

    Parameters
    ----------
    merging : str
        "gpb1", "imm" or "gpb2".
    before : Mixture or None
        Of the modes of the slice before, normalised; None in slice 0.
    loops : GaussianLoops, optional
        Machine code for it.

    Returns
    -------
    Mixture
        Weights sum to one over the modes. Of the numbers that are worked out, those that the next slice reads
        first (``whole`` has all of them); where some of those are observed, of all.
    ndarray, shape (*lead,)
        Not finite where no mode can have the row.
    """
    pairs = place.stretch.pairs
    by_kind = merging != "gpb2" or len(pairs.of_kind) == len(pairs.dst)
    ahead = _ahead(merging, before, place, loops)
    taken = _quickly(place, by_kind, ahead, loops) or _taken(
        place, by_kind, ahead.mean, ahead.factor
    )
    by_dst = pairs.kinds_by_dst if by_kind else pairs.by_dst
    log = by_dst.logs(ahead.log + taken.log)
    if by_dst.are_single:
        found = Mixture(log[:, 0], taken.mean, taken.factor)
    else:
        found = merged(log, by_dst.of(taken.mean), by_dst.of(taken.factor), loops)
    top = np.maximum.reduce(found.log, axis=0)
    if np.minimum.reduce(top, axis=None) == -np.inf:
        return found, np.where(top > -np.inf, top, -np.inf)
    increment = np.log(np.add.reduce(np.exp(found.log - top), axis=0)) + top
    found = Mixture(found.log - increment, found.mean, found.factor)
    return whole(place, found) if place.is_carried else found, increment


class Taken(NamedTuple):
    """Kinds or pairs given a row, of the numbers that are worked out.

    Attributes
    ----------
    mean : ndarray, shape (size, *lead, kept)
    factor : ndarray, shape (size, *lead, kept, kept)
    log : ndarray, shape (size, *lead)
        Log densities of the row.
    made : Conditioned or None
        What smoothers need, and with it standardised innovations, shape (size, *lead, observed).
    eta : ndarray or None
    """

    mean: np.ndarray
    factor: np.ndarray
    log: np.ndarray
    made: Conditioned | None = None
    eta: np.ndarray | None = None


def _taken(
    place: Place, by_kind: bool, mean: np.ndarray, factor: np.ndarray, turning: bool = False
) -> Taken:
    """Kinds or pairs given a row; with ``turning`` they say what the slice before had to do with it."""
    layout, pattern = place.layout, place.pattern
    expected, rows, terms = place.stretch.expected(place.at, pattern, by_kind, mean, factor)
    p = len(pattern.observed)
    made = condition(rows, p, layout.n_prev) if turning else condition_many(rows, p)
    angles = layout.angles
    if angles is not None:
        angles = angles[pattern.observed]
    if pattern.absent is None and made.certain is None and angles is None:
        off = place.row - expected[..., :p]
        eta = (
            off / made.root[..., 0]
            if p == 1
            else np.linalg.solve(made.root, off[..., None])[..., 0]
        )
        after = expected[..., p:] + np.matvec(made.gain, eta)
        return Taken(after, made.factor, log_densities(made.root, eta), made, eta)
    after, eta, log = absorbed(
        layout, pattern, made, expected, place.row, place.given, angles, terms
    )
    after = after[..., pattern.kept - layout.p]
    wide = np.broadcast_to(made.factor, (*after.shape, after.shape[-1]))
    return Taken(after, wide, log, made, eta)


def _quickly(
    place: Place, by_kind: bool, ahead: Mixture, loops: GaussianLoops | None
) -> Taken | None:
    """The same in machine code, where it can be had."""
    stretch, pattern = place.stretch, place.pattern
    if loops is None or stretch.is_singular or pattern.absent is not None or ahead.log.ndim > 1:
        return None
    given = stretch.coefficients(place.at, pattern, by_kind)
    found = None
    if given.is_wide:
        mean, factor = np.ascontiguousarray(ahead.mean), np.ascontiguousarray(ahead.factor)
        found = loops.conditioned(given, mean, factor, np.ascontiguousarray(place.row))
    if found is None:  # what is known without noise is so in most slices
        stretch.is_singular = True
        return None
    return Taken(*found)


def whole(place: Place, found: Mixture) -> Mixture:
    """With all unknown numbers, those that are observed in this slice, too."""
    layout, pattern = place.layout, place.pattern
    if pattern.given is None or found.mean.shape[-1] > len(pattern.kept):
        return found
    assert place.given is not None
    given = place.given if place.given.ndim <= 1 + len(layout.lead) else place.given[:, None]
    mean = np.zeros((*found.log.shape, layout.n))
    mean[..., pattern.kept - layout.p] = found.mean
    mean = np.where(pattern.given, given, mean)
    return Mixture(found.log, mean, full_factor(layout, pattern, found.factor))


class Back(NamedTuple):
    """Every pair of modes, as a smoother goes back through it.

    The noise of the slice before is ``shift + link @ (noise of this slice)``, and what ``rest`` multiplies.

    Attributes
    ----------
    log : ndarray, shape (pairs, *lead)
        Log probabilities of the mode before given this one and the rows before.
    joint : ndarray, shape (pairs, *lead)
        Log probabilities of both modes given the rows before, times the density of the row.
    after : Mixture
        Of this slice, as the filter has them in every pair.
    shift : ndarray, shape (pairs, *lead, carried)
    link : ndarray, shape (pairs, *lead, carried, carried)
    rest : ndarray, shape (pairs, *lead, carried, k)
    """

    log: np.ndarray
    joint: np.ndarray
    after: Mixture
    shift: np.ndarray
    link: np.ndarray
    rest: np.ndarray


def turned_back(before: Mixture, place: Place) -> Back:
    """How a slice leads back to the one before, from the filter's beliefs about that.

    As Kim has it, rows from this one on tell of the mode before through this mode alone.
    """
    stretch, pattern = place.stretch, place.pattern
    pairs, c = stretch.pairs, place.layout.n_prev
    ahead = before.log[pairs.src] + stretch.log_of(place.at)
    total, _ = shares(pairs.by_dst.logs(ahead))
    own = total[pairs.dst]
    log = np.where(own > -np.inf, ahead - np.where(own > -np.inf, own, 0.0), -np.inf)
    start = before.first(c)
    found = _taken(place, False, start.mean[pairs.src], start.factor[pairs.src], True)
    p, carried = len(pattern.observed), place.layout.carried
    after = whole(place, Mixture(log, found.mean, found.factor))
    assert found.made is not None and found.eta is not None and found.made.turn is not None
    turn = np.broadcast_to(found.made.turn, (*log.shape, *found.made.turn.shape[-2:]))
    return Back(
        log,
        ahead + found.log,
        after,
        np.matvec(turn[..., :p], found.eta),
        turn[..., p : p + carried],
        turn[..., p + carried :],
    )


class Smoothed(NamedTuple):
    """Modes given later rows: numbers are ``mean + factor @ noise`` of the filter, with noise of moments.

    Attributes
    ----------
    log : ndarray, shape (modes, *lead)
    noise : ndarray, shape (modes, *lead, carried)
    spread : ndarray, shape (modes, *lead, carried, carried)
        Root of the noise's covariance.
    """

    log: np.ndarray
    noise: np.ndarray
    spread: np.ndarray


def unsmoothed(filtered: Mixture, carried: int) -> Smoothed:
    """The last slice, of which later rows tell nothing."""
    shape = filtered.log.shape
    spread = np.broadcast_to(np.eye(carried), (*shape, carried, carried))
    return Smoothed(filtered.log, np.zeros((*shape, carried)), spread)


def smoothed(back: Back, place: Place, filtered: Mixture, later: Smoothed) -> Smoothed:
    """The slice before, from beliefs about this one given later rows (``filtered`` without them)."""
    pairs, c = place.stretch.pairs, later.noise.shape[-1]
    left = filtered.factor[..., :c, :c]
    mean = filtered.mean[..., :c] + np.matvec(left, later.noise)
    root = left @ later.spread
    dst = pairs.dst
    after = back.after.first(c)
    off = (mean[dst] - after.mean)[..., None]
    noise, free = noise_of(after.factor, np.concatenate([off, root[dst]], axis=-1))
    found = back.link @ noise
    parts = [found[..., 1:], back.rest]
    if free is not None:
        parts.append(back.link @ free)
    log = later.log[dst] + back.log
    groups = pairs.by_src
    assert groups is not None
    whole = merged(
        groups.logs(log),
        groups.of(back.shift + found[..., 0]),
        groups.of(np.concatenate(parts, axis=-1)),
    )
    return Smoothed(*whole)


def noise_of(factor: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """What noise makes numbers, shape (..., c, k), by a root; and noise that makes none, if there is some.

    Numbers of unlike units count alike.
    """
    size = np.sqrt(np.vecdot(factor, factor))
    size = np.where(size > 0, size, 1.0)[..., None]
    left, values, right = np.linalg.svd(factor / size)
    longest = values[..., :1] if values.shape[-1] else values
    kept = values > _NOTHING * longest
    scaled = np.matrix_transpose(left) @ (numbers / size)
    inner = np.where(kept, 1.0 / np.where(kept, values, 1.0), 0.0)[..., None] * scaled
    turned = np.matrix_transpose(right)
    free = None if kept.all() else turned * ~kept[..., None, :]
    return turned @ inner, free


# ---- private ------------------------------------------------------------------------------------


def _ahead(
    merging: str, before: Mixture | None, place: Place, loops: GaussianLoops | None
) -> Mixture:
    """Gaussians to take through a slice, with their weights there; of kinds, or under GPB2 of pairs."""
    stretch = place.stretch
    pairs, log = stretch.pairs, stretch.log_of(place.at)
    if before is None:
        start = nothing(place.layout)
        count = len(pairs.dst)
        return Mixture(
            np.broadcast_to(log, (count, *log.shape[1:])),
            np.repeat(start.mean, count, axis=0),
            np.repeat(start.factor, count, axis=0),
        )
    start = before.first(place.layout.n_prev)
    log = start.log.take(pairs.src, axis=0) + log
    if merging == "gpb2":
        return Mixture(
            log, start.mean.take(pairs.src, axis=0), start.factor.take(pairs.src, axis=0)
        )
    groups = pairs.by_kind
    if merging == "imm":
        at = pairs.src[groups.members]
        return merged(groups.logs(log), start.mean[at], start.factor[at], loops)
    one = merged(start.log[None], start.mean[None], start.factor[None], loops)
    kinds = len(pairs.of_kind)
    total, _ = shares(groups.logs(log))
    return Mixture(total, np.repeat(one.mean, kinds, axis=0), np.repeat(one.factor, kinds, axis=0))
