"""Rejection sampling of one density under an envelope ``k q(z)``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.errors import EnvelopeError, ParameterError, UnsupportedError
from bayesmc.montecarlo.target import (
    CHUNK,
    check_proposal,
    count_of,
    log_density,
    number,
    show,
    single,
    streams,
)

_CALL = "rejection_sample"
#: by how much rounding may lift a log density above an envelope that touches it
_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class RejectionSample:
    """Independent draws of a density by rejection, and what the acceptance tells of its integral.

    Attributes
    ----------
    draws : ndarray, shape (n, *event)
    proposed : int
        Proposals up to and including the one that gave the last draw.
    log_normalizer : float
        Log of the estimated integral of the density, ``k (n - 1) / (proposed - 1)``, which is
        unbiased before the logarithm (sampling went on until n were accepted). NaN for one draw.
    standard_error : float
        Of ``log_normalizer`` (which is the relative one of the integral).

    References
    ----------
    Haldane, Biometrika 33, 1945 (inverse binomial sampling).

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.montecarlo import rejection_sample
    >>> rejection_sample(bmc.Beta(2.0, 2.0), bmc.Uniform(0.0, 1.0), 1.5, draws=1000, rng=0)
    RejectionSample(1,000 draws from 1,480 proposals, acceptance 0.676, log_normalizer 0.0131 +- 0.018)
    """

    draws: np.ndarray
    proposed: int
    log_normalizer: float
    standard_error: float

    @property
    def acceptance_rate(self) -> float:
        """Share of the proposals that was accepted."""
        return len(self.draws) / self.proposed

    def __repr__(self) -> str:
        return (
            f"RejectionSample({len(self.draws):,} draws from {self.proposed:,} proposals, acceptance "
            f"{self.acceptance_rate:.3g}, log_normalizer {self.log_normalizer:.3g} +- "
            f"{self.standard_error:.2g})"
        )


def rejection_sample(
    density: Any,
    proposal: Any,
    envelope: float | None = None,
    draws: int = 1000,
    rng: Any = None,
    *,
    log_envelope: float | None = None,
    max_proposals: int = 100_000_000,
) -> RejectionSample:
    """Exact independent draws of ``density``: propose from ``q``, accept with ``p~(z) / (k q(z))``.

    Parameters
    ----------
    density : Distribution, frozen scipy.stats distribution or callable
        The density p~, up to a constant factor; a function maps points of shape ``(n, *event)`` to
        ``n`` log densities.
    proposal : Distribution or frozen scipy.stats distribution
        The density q that is sampled; one distribution, not a batch.
    envelope : float
        ``k``, such that ``k q(z) >= p~(z)`` everywhere. Or give ``log_envelope``, its logarithm.
    draws : int
        How many draws are wanted, at least 1.
    rng : seed, SeedSequence, Generator or None
    max_proposals : int
        Where to give up.

    Returns
    -------
    RejectionSample

    Raises
    ------
    EnvelopeError
        A proposal was found where ``p~`` exceeds ``k q``; the error names the point and the least k
        that covers it. An envelope violated only where no proposal fell stays unnoticed.
    DensityError
        A log density is NaN or plus infinity.
    UnsupportedError
        ``max_proposals`` were not enough, ``proposal`` cannot be sampled, or one of density and
        proposal is discrete and the other continuous.

    Warns
    -----
    SupportWarning
        The proposal's support is narrower than the declared one of the density.

    References
    ----------
    von Neumann, Various techniques used in connection with random digits, 1951; Robert and Casella,
    Monte Carlo Statistical Methods, 2nd ed., 2004, section 2.3.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.montecarlo import rejection_sample
    >>> two_bumps = bmc.Density(lambda x: np.logaddexp(-((x - 2) ** 2), -((x + 2) ** 2)))
    >>> found = rejection_sample(two_bumps, bmc.Normal(0.0, 3.0), envelope=11.0, draws=5000, rng=1)
    >>> found.draws.shape, bool(abs(found.acceptance_rate - 2 * np.sqrt(np.pi) / 11) < 0.02)
    ((5000,), True)
    """
    wanted = count_of(_CALL, draws, 1)
    max_proposals = count_of(_CALL, max_proposals, 1, "max_proposals")
    log_k = _log_envelope(envelope, log_envelope)
    log_p = log_density(_CALL, "density", density)
    proposal = single(_CALL, "proposal", proposal)
    check_proposal(_CALL, density, proposal)
    log_q = log_density(_CALL, "proposal", proposal)
    most = max(1, CHUNK // max(1, int(np.prod(proposal.event_shape))))
    size = min(most, max(64, 2 * wanted))
    kept: list[np.ndarray] = []
    have = proposed = 0
    for generator in streams(rng):
        size = min(size, most, max_proposals - proposed)
        if size <= 0:
            raise UnsupportedError(
                f"{_CALL}: {have:,} of {wanted:,} draws accepted among {proposed:,} proposals "
                f"(acceptance {have / max(proposed, 1):.2g}); use a proposal nearer to the density "
                "and a smaller envelope, or raise max_proposals"
            )
        points = proposal.sample(generator, size)
        log_ratio = _log_ratio(points, log_p(points), log_q(points), log_k)
        accepted = np.flatnonzero(np.log1p(-generator.random(size)) <= log_ratio)[: wanted - have]
        kept.append(points[accepted])
        have += len(accepted)
        if have == wanted:
            proposed += int(accepted[-1]) + 1
            break
        proposed += size
        size *= 2
    return _result(np.concatenate(kept), proposed, log_k)


def _result(draws: np.ndarray, proposed: int, log_k: float) -> RejectionSample:
    n = len(draws)
    if n < 2:
        return RejectionSample(draws, proposed, float("nan"), float("nan"))
    rate = (n - 1) / (proposed - 1)
    # the unbiased estimate of the rate's variance is rate (1 - rate) / (proposed - 2)
    error = np.sqrt((1 - rate) / (rate * max(proposed - 2, 1)))
    return RejectionSample(draws, proposed, log_k + float(np.log(rate)), float(error))


def _log_envelope(envelope: float | None, log_envelope: float | None) -> float:
    if (envelope is None) == (log_envelope is None):
        raise ParameterError(f"{_CALL}: give exactly one of envelope and log_envelope")
    with np.errstate(all="ignore"):
        if envelope is not None:
            value = float(np.log(number(_CALL, "envelope", envelope)))
        else:
            value = number(_CALL, "log_envelope", log_envelope)
    if not np.isfinite(value):
        shown = envelope if envelope is not None else log_envelope
        raise ParameterError(f"{_CALL}: the envelope k must be positive and finite; got {shown!r}")
    return value


def _log_ratio(
    points: np.ndarray, log_p: np.ndarray, log_q: np.ndarray, log_k: float
) -> np.ndarray:
    """``log(p~ / (k q))`` at the points; a violated envelope raises with the worst of them."""
    allowed = log_k + log_q
    # equal infinities: neither has mass there
    log_ratio = np.where(log_p == -np.inf, -np.inf, log_p - allowed)
    worst = int(np.argmax(log_ratio))
    if log_ratio[worst] > _ROUNDING:
        least = np.exp(log_p[worst] - log_q[worst])
        raise EnvelopeError(
            f"{_CALL}: the envelope is violated at z = {show(points[worst])}: p~(z) = "
            f"{np.exp(log_p[worst]):.6g} exceeds k q(z) = {np.exp(allowed[worst]):.6g}; covering this "
            f"point takes k of at least {least:.6g} (log_envelope {np.log(least):.6g})",
            points[worst],
            float(np.exp(log_ratio[worst])),
        )
    return log_ratio
