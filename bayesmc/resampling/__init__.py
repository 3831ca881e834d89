"""Resampling: indices of draws in proportion to their weights.

Every scheme has one signature, ``scheme(weights, draws, rng)``, and returns sorted indices, so schemes
swap freely; :class:`Adaptive` wraps any of them and resamples only where the effective sample size is
low. Weights are nonnegative and on their natural scale; they are normalised here. Particles lie on
axis 0, and every axis after it is a batch of independent resamplings.

This room knows arrays only: what moves with the indices, and what becomes of the weights, is the
caller's affair.
"""

from __future__ import annotations

from bayesmc.resampling.adaptive import Adaptive, Resampled, checked, scheme_of
from bayesmc.resampling.schemes import (
    SCHEMES,
    Scheme,
    ess,
    multinomial,
    residual,
    ssp,
    stratified,
    systematic,
)

__all__ = [
    "SCHEMES",
    "Adaptive",
    "Resampled",
    "Scheme",
    "checked",
    "ess",
    "multinomial",
    "residual",
    "scheme_of",
    "ssp",
    "stratified",
    "systematic",
]
