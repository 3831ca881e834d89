"""A user's family brings its log density's form along: read where it is ``log_prob``, else opaque."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.distributions.base import as_float
from bayesmc.distributions.support import positive
from bayesmc.errors import BayesmcError, ShapeError, TraceError
from bayesmc.expression import evaluate
from bayesmc.network import pose
from bayesmc.network.expressions import log_density_of
from bayesmc.passes.features import statistics


class Rayleigh(bmc.Distribution):
    """Density ``rate x exp(-rate x**2 / 2)``."""

    parameter_ndim = {"rate": 0}
    support = positive

    def __init__(self, rate):
        rate = as_float(rate)
        self._set_batch(rate.shape)
        self.rate = self._positive("rate", rate)

    @staticmethod
    def log_density(x, rate):
        return np.where(x > 0, np.log(x) + np.log(rate) - 0.5 * rate * x**2, -np.inf)

    def _sample(self, rng, shape):
        return np.sqrt(rng.exponential(2.0 / self.rate, shape))


class Tuned(Rayleigh):
    """With a density of its own that is the form."""

    def _log_prob(self, x):
        with np.errstate(all="ignore"):
            return np.where(x > 0, np.log(x * self.rate) - 0.5 * self.rate * x * x, -np.inf)


class Wrong(Rayleigh):
    """Whose form is another one."""

    def _log_prob(self, x):
        return Rayleigh.log_density(x, self.rate) + 1e-6 * x


class Branching(Rayleigh):
    @staticmethod
    def log_density(x, rate):
        return Rayleigh.log_density(x, rate) if np.all(rate > 0) else -np.inf * x


class Clocked(Rayleigh):
    @staticmethod
    def log_density(x, rate):
        return Rayleigh.log_density(x, rate) * (time.time() > 0)


def model(family):
    net = bmc.BayesNet(plates={"hour": 3})
    net.add("rate", Rayleigh(2.0))
    net.add("speed", lambda rate: family(2.0 * rate), plates="hour")
    return pose(net, {}).model


@pytest.mark.parametrize("family", [Rayleigh, Tuned])
def test_a_form_is_read(family):
    form = log_density_of(model(family), "speed")
    x, rate = np.array([0.5, 1.0, -1.0]), np.array(0.7)
    (found,) = evaluate([form], {"speed": x, "rate": rate})
    np.testing.assert_allclose(found, Rayleigh(1.4).log_prob(x), rtol=1e-13)
    assert set(statistics(form, "rate").coefficients) == {"log x", 1.0}
    prior = log_density_of(model(family), "rate")  # of a distribution without parents
    assert evaluate([prior], {"rate": rate})[0] == pytest.approx(Rayleigh(2.0).log_prob(0.7))


@pytest.mark.parametrize(
    ("family", "why"),
    [(Wrong, "other values than its log_prob"), (Branching, "truth"), (Clocked, "time")],
)
def test_a_form_that_is_not_the_density_is_refused(family, why):
    with pytest.raises(TraceError, match=why):
        log_density_of(model(family), "speed")
    net = bmc.BayesNet()
    net.add("rate", bmc.Gamma(2.0, 1.0))
    net.add("speed", lambda rate: family(rate))
    assert np.isfinite(
        bmc.infer(net, {"speed": 1.0}, engine=bmc.LikelihoodWeighting(50), rng=0).mean("rate")
    )


# ---- families that are wrong ---------------------------------------------------------------------


def test_a_density_that_is_summed_over_all_draws_is_refused() -> None:
    class Summed(Rayleigh):
        @staticmethod
        def log_density(x: Any, rate: Any) -> Any:
            return np.sum(Rayleigh.log_density(x, rate))

    with pytest.raises(
        ShapeError, match=r"Summed.log_density gives shape \(\) for values of shape \(2,\)"
    ):
        Summed(1.0).log_prob([1.0, 2.0])
    net = bmc.BayesNet()
    net.add("rate", bmc.Gamma(2.0, 1.0))
    net.add("y", lambda rate: Summed(rate))
    for engine in (bmc.LikelihoodWeighting(100), bmc.Gibbs(draws=10, warmup=5)):
        with pytest.raises(BayesmcError, match="Summed.log_density gives shape"):
            bmc.infer(net, {"y": 1.0}, engine=engine, rng=0)


def test_a_form_is_a_static_method() -> None:
    with pytest.raises(TypeError, match="put @staticmethod above it"):

        class Bound(bmc.Distribution):
            parameter_ndim = {"rate": 0}

            def log_density(x: Any, rate: Any) -> Any:  # type: ignore[override]
                return -rate * x


@pytest.mark.parametrize("names", [{}, {"rte": 0}])
def test_a_form_names_the_parameters(names: dict[str, int]) -> None:
    with pytest.raises(
        TypeError, match=r"name the same in both, as in parameter_ndim = {'rate': 0}"
    ):

        class Misspelt(bmc.Distribution):
            parameter_ndim = names

            @staticmethod
            def log_density(x: Any, rate: Any) -> Any:
                return -rate * x


def test_what_is_missing_is_named() -> None:
    class Empty(bmc.Distribution):
        pass

    with pytest.raises(NotImplementedError, match="Empty has no property support"):
        Empty().support  # noqa: B018
    with pytest.raises(NotImplementedError, match=r"Empty has no method _sample\(rng, shape\)"):
        Empty().sample(rng=0)
    with pytest.raises(NotImplementedError, match=r"Empty has no log_density\(x, \*\*parameters\)"):
        Empty().log_prob(0.0)


@pytest.mark.parametrize("asked", ["log_prob", "sample"])
def test_what_checks_arguments_is_not_to_be_defined_anew(asked):
    with pytest.raises(TypeError, match=rf"define _{asked} instead"):
        type("Scaled", (bmc.Normal,), {asked: lambda self, x: 0.0})
