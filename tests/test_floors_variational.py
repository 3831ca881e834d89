"""The loops by hand that mean field is timed against answer what bayesmc answers."""

from __future__ import annotations

import warnings

import numpy as np

import bayesmc as bmc
from benchmarks import bench_mean_field
from benchmarks.floors import variational_mixture


def test_mixtures_by_hand_climb_to_the_engines_bound() -> None:
    points, _ = variational_mixture.start(200, 2)
    posterior = bmc.infer(
        bench_mean_field.mixture(200, 2),
        {"x": points},
        engine=bmc.MeanField(restarts=3, blocks=[("mean", "cov")]),
        rng=0,
    )
    shares = posterior.probabilities("label")
    loops = [
        kind(points, shares) for kind in (variational_mixture.Plain, variational_mixture.Tuned)
    ]
    for loop in loops:
        np.testing.assert_allclose(loop.run(1), posterior.elbo, atol=1e-7)


def test_both_loops_are_the_same() -> None:
    points, shares = variational_mixture.start(500, 4)
    plain = variational_mixture.Plain(points, shares)
    tuned = variational_mixture.Tuned(points, shares)
    bounds = [(plain.run(1), tuned.run(1)) for _ in range(5)]
    np.testing.assert_allclose(*np.transpose(bounds), rtol=1e-11)
    assert (np.diff([b for b, _ in bounds]) > 0).all()


def test_a_sweep_can_be_timed() -> None:
    points, _ = variational_mixture.start(50, 2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert np.isfinite(bench_mean_field.own(bench_mean_field.mixture(50, 2), points))
