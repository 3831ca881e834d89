"""A parameter under a name that a family does not have: the error says what it takes and which was meant."""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.distributions.parameters import signature


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (
            lambda: bmc.Gamma(2, scale=3),
            r"Gamma .* 'scale' .*mean rate = 1 / scale.* concentration, rate",
        ),
        (
            lambda: bmc.Normal(0, sigma=1),
            r"Normal .* 'sigma' \(did you mean scale\?\); it takes loc, scale",
        ),
        (lambda: bmc.Normal(0, var=4), r"mean scale = np.sqrt\(var\)"),
        (lambda: bmc.Beta(alpha=1, beta=2), "mean concentration1"),
        (lambda: bmc.MvNormal(np.zeros(2), covariance=np.eye(2)), "mean cov"),
        (lambda: bmc.Poisson(rat=2.0), "mean 'rate'"),
        (lambda: bmc.Uniform(wide=2.0), r"no parameter 'wide'; it takes low, high"),
    ],
)
def test_unknown_parameters_are_named(make, said):
    for _ in range(2):
        with pytest.raises(TypeError, match=said):
            make()


def test_known_parameters_pass_and_families_that_take_any_do():
    class Scaled(bmc.Distribution):
        def __init__(self, **parameters):
            self.scale = parameters["scale"]

    assert bmc.Gamma(concentration=2.0, rate=3.0).mean == pytest.approx(2 / 3)
    assert Scaled(scale=2.0).scale == 2.0


def test_parameters_are_those_of_the_constructor(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python 3.11.2 reads a class with an inherited ``__init__`` by its ``__new__``, which takes anything."""
    read = inspect.signature

    def early(called: Any) -> inspect.Signature:
        return read(called.__new__ if isinstance(called, type) else called)

    monkeypatch.setattr(inspect, "signature", early)
    assert list(signature.__wrapped__(bmc.Laplace).parameters) == ["loc", "scale"]
    assert list(signature.__wrapped__(bmc.Wishart).parameters) == ["df", "scale"]
