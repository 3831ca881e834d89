"""Resampling only where it is due: a wrapper around any scheme, and schemes by name."""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bayesmc.resampling.schemes import SCHEMES, Scheme, ess


class Resampled(NamedTuple):
    """What adaptive resampling did.

    Attributes
    ----------
    indices : ndarray of intp, shape (draws, *batch), or None
        None where nothing was resampled at all, so that nothing need be moved. Batch elements that were
        not resampled hold ``0 .. n - 1``.
    which : bool or ndarray of bool, shape batch
        Whether it was resampled; weights start anew there, and are carried on elsewhere.
    """

    indices: np.ndarray | None
    which: Any


@dataclass(frozen=True)
class Adaptive:
    """Resample where the effective sample size is below a share of the number of particles.

    Parameters
    ----------
    scheme : str or callable
        A name of ``SCHEMES``, or a function with the signature of one.
    threshold : float
        Resample if ``ess < threshold * n``: 0 never does, anything above 1 always does. With 1, only even
        weights are left alone (as far as rounding lets them be even).

    Raises
    ------
    ValueError
        If the scheme is unknown or adaptive itself, or the threshold is negative or NaN.

    References
    ----------
    Liu and Chen (1995), JASA 90(430); Del Moral, Doucet and Jasra (2012), Bernoulli 18(1).

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.resampling import Adaptive
    >>> adaptive, rng = Adaptive("stratified", threshold=0.5), np.random.default_rng(0)
    >>> adaptive(np.array([0.3, 0.2, 0.3, 0.2]), 4, rng)
    Resampled(indices=None, which=False)
    >>> indices, which = adaptive(np.array([1.0, 0.0, 0.0, 0.0]), 4, rng)
    >>> indices.tolist(), which
    ([0, 0, 0, 0], True)

    In a batch, each element decides for itself:

    >>> weights = np.array([[0.5, 1.0], [0.5, 0.0]])
    >>> indices, which = Adaptive(threshold=0.9)(weights, 2, rng)
    >>> indices.T.tolist(), which.tolist()
    ([[0, 1], [0, 0]], [False, True])
    """

    scheme: str | Scheme = "systematic"
    threshold: float = 0.5

    def __post_init__(self) -> None:
        self._plain_scheme()
        if not self.threshold >= 0:
            raise ValueError(
                f"Adaptive(threshold={self.threshold!r}): give a share of the particles, "
                "0 (never resample) or more (above 1: always)"
            )

    def __call__(
        self,
        weights: np.ndarray,
        draws: int,
        rng: np.random.Generator,
        *,
        weight_ess: Any = None,
    ) -> Resampled:
        """Resample what is due.

        Parameters
        ----------
        weights : ndarray, shape (n, *batch)
            Nonnegative, on any scale.
        draws : int
            Number of indices; it must be ``n`` unless the threshold is above 1, since particles may stay.
        rng : numpy.random.Generator
            Not drawn from where nothing is due.
        weight_ess : float or ndarray of shape batch, optional
            ``ess(weights)``, where the caller has it.
        """
        weights = np.asarray(weights, dtype=float)
        scheme = self._plain_scheme()
        batch = weights.shape[1:]
        if self.threshold > 1:
            return Resampled(scheme(weights, draws, rng), np.ones(batch, bool) if batch else True)
        if draws != len(weights):
            raise ValueError(
                f"Adaptive(threshold={self.threshold}): draws={draws} of {len(weights)} particles; "
                "particles that stay are as many as they were (above 1 it always resamples)"
            )
        sizes = ess(weights) if weight_ess is None else weight_ess
        due = sizes < self.threshold * len(weights)
        if not batch:
            return Resampled(scheme(weights, draws, rng) if due else None, bool(due))
        if not due.any():
            return Resampled(None, due)
        if due.all():
            return Resampled(scheme(weights, draws, rng), due)
        indices = np.empty(weights.shape, dtype=np.intp)
        indices[:] = np.arange(draws).reshape(draws, *(1,) * len(batch))
        indices[:, due] = scheme(weights[:, due], draws, rng)
        return Resampled(indices, due)

    def _plain_scheme(self) -> Scheme:
        scheme = scheme_of(self.scheme)
        if isinstance(scheme, Adaptive):
            raise ValueError("Adaptive(scheme=Adaptive(...)): give the scheme inside it")
        return scheme


def scheme_of(resampling: str | Scheme | Adaptive) -> Scheme | Adaptive:
    """The scheme that a name stands for; functions and :class:`Adaptive` as they are.

    Raises
    ------
    ValueError
        If the name is unknown, or the argument is neither a name nor callable.

    Examples
    --------
    >>> from bayesmc.resampling import scheme_of
    >>> scheme_of("ssp").__name__
    'ssp'
    >>> scheme_of("sistematic")
    Traceback (most recent call last):
        ...
    ValueError: resampling='sistematic' is no scheme (did you mean 'systematic'?); there are ...
    """
    if isinstance(resampling, str) and resampling in SCHEMES:
        return SCHEMES[resampling]
    if callable(resampling):
        return resampling
    near = difflib.get_close_matches(str(resampling), SCHEMES, n=1)
    hint = f" (did you mean {near[0]!r}?)" if near else ""
    raise ValueError(
        f"resampling={resampling!r} is no scheme{hint}; there are "
        f"{', '.join(map(repr, SCHEMES))}, or a function of (weights, draws, rng)"
    )


def checked(scheme: Scheme) -> Scheme:
    """A scheme that is given weights which sum to 1, and whose indices are looked at; ours need neither.

    Raises
    ------
    ValueError
        From the scheme returned: the indices have another shape, are no whole numbers, lie outside the
        particles, or are not sorted.
    """
    if scheme in SCHEMES.values():
        return scheme

    def looked_at(weights: np.ndarray, draws: int, rng: np.random.Generator) -> np.ndarray:
        found = np.asarray(scheme(weights / weights.sum(axis=0), draws, rng))
        name = getattr(scheme, "__name__", repr(scheme))
        shape = (draws, *weights.shape[1:])
        if found.shape != shape or found.dtype.kind not in "iu":
            raise ValueError(
                f"resampling={name} returns shape {found.shape} of dtype {found.dtype}; it returns {draws} "
                f"sorted indices, shape {shape}"
            )
        if found.size and not 0 <= found.min() <= found.max() < len(weights):
            raise ValueError(
                f"resampling={name} returns indices from {found.min()} to {found.max()}; there are "
                f"{len(weights)} particles, 0 to {len(weights) - 1}"
            )
        if (found[1:] < found[:-1]).any():
            raise ValueError(f"resampling={name} returns indices that are not sorted; sort them")
        return found.astype(np.intp, copy=False)

    return looked_at
