"""Faults of distributions: what they integrate to, and what their samplers draw."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.testing.densities.density import check_density
from bayesmc.testing.verdict import Verdict
from tests.mutants.faults import Edit
from tests.mutants.mutant import ALPHA, Mutant


def checked(make: Callable[[], Any], draws: int = 2000) -> Callable[[int], Verdict]:
    """A distribution, made anew, against itself."""
    return lambda seed: check_density(make(), draws=draws, alpha=ALPHA, rng=seed)


BY = "check_density, 2000 draws"

MUTANTS = [
    Mutant(
        "a truncated density lacks its normaliser",
        (Edit("bayesmc.distributions.truncated:Truncated._log_prob", " - self._log_mass", ""),),
        checked(lambda: bmc.Truncated(bmc.Normal(0.0, 1.0), -0.5, 2.0)),
        BY,
    ),
    Mutant(
        "Student's t is drawn as a Normal",
        (Edit("bayesmc.distributions.continuous:StudentT._sample",
              "rng.standard_t(self.df, shape)", "rng.standard_normal(shape)"),),
        checked(lambda: bmc.StudentT(4.0, 0.0, 1.0)),
        BY,
    ),
    Mutant(
        "a LogNormal density lacks 1/x",
        (Edit("bayesmc.distributions.positive:LogNormal._log_prob", "np.asarray(z - log_x)", "z"),),
        checked(lambda: bmc.LogNormal(0.3, 0.8)),
        BY,
    ),
    Mutant(
        "a WrappedNormal is not wrapped",
        (Edit("bayesmc.distributions.circular:WrappedNormal._sample",
              "return wrap_angle(draws)", "return np.clip(draws, -np.pi, np.pi - 1e-9)"),),
        checked(lambda: bmc.WrappedNormal(1.5, 1.2)),
        BY,
    ),
    Mutant(
        "a mixture's log-sum forgets the weights",
        (Edit("bayesmc.distributions.mixture:Mixture._log_prob",
              "terms + np.log(weights)", "terms - np.log(weights.shape[-1])"),),
        checked(lambda: bmc.Mixture([0.8, 0.2], bmc.Normal(np.array([-1.0, 2.0]), 1.0))),
        BY,
    ),
    Mutant(
        "the last integer is never drawn",
        (Edit("bayesmc.distributions.discrete:DiscreteUniform._sample",
              "endpoint=True", "endpoint=False"),),
        checked(lambda: bmc.DiscreteUniform(2, 9)),
        BY,
    ),
    Mutant(
        "a Geometric counts trials, not failures",
        (Edit("bayesmc.distributions.counts:Geometric._sample",
              ".astype(np.int64)", ".astype(np.int64) + 1"),),
        checked(lambda: bmc.Geometric(0.3)),
        BY,
    ),
    Mutant(
        "a covariance's root is transposed",
        (Edit("bayesmc.distributions.mvnormal:MvNormal._sample",
              "z @ self.scale_tril.T", "z @ self.scale_tril"),),
        checked(lambda: bmc.MvNormal(np.zeros(2), np.array([[1.0, 0.7], [0.7, 2.0]]))),
        BY,
    ),
]  # fmt: skip
