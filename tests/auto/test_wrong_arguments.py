"""Wrong arguments of questions are refused with the call, the fault and what to give."""

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import ParameterError, QueryError, UnsupportedError


def walk():
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    return dbn


def pair():
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("y", lambda a: bmc.Normal(a, 1.0))
    return net


@pytest.mark.parametrize("engine", [None, bmc.ParticleFilter(50), bmc.KalmanFilter()])
@pytest.mark.parametrize("ask", [bmc.filter, bmc.smooth, bmc.forecast])
@pytest.mark.parametrize("queries", [[lambda x: x], {"q": "x"}, {1: lambda x: x}, lambda x: x])
def test_queries_that_are_no_functions_by_name(ask, engine, queries):
    options = {"steps": 1} if ask is bmc.forecast else {}
    with pytest.raises(
        QueryError, match=rf"{ask.__name__}\(queries=.*give queries=\{{'name': function"
    ):
        ask(walk(), {"y": [1.0]}, engine=engine, queries=queries, rng=0, **options)


def test_relabelled_without_chains():
    posterior = bmc.infer(pair(), {"y": 1.0}, engine=bmc.LikelihoodWeighting(1000), rng=0)
    with pytest.raises(
        UnsupportedError, match=r"relabelled\('a'\): .* keeps no chains.*Gibbs\(draws\)"
    ):
        posterior.relabelled("a")


@pytest.mark.parametrize("levels", [[0.1, "x"], {"q": 0.1}, 2.0, np.nan])
def test_quantiles_that_are_no_levels(levels):
    weighted = bmc.infer(pair(), {"y": 1.0}, engine=bmc.LikelihoodWeighting(1000), rng=0)
    for posterior, name in [
        (weighted, "a"),
        (bmc.filter(walk(), {"y": [1.0]}, engine=bmc.KalmanFilter()), "x"),
        (
            bmc.filter(
                walk(), {"y": [1.0]}, engine=bmc.ParticleFilter(50), keep="particles", rng=0
            ),
            "x",
        ),
    ]:
        with pytest.raises(QueryError, match=rf"quantile\('{name}', .*between 0 and 1"):
            posterior.quantile(name, levels)


@pytest.mark.parametrize("scale", ["1", [1.0, "1"], np.array(["1"]), np.array(["1"], dtype=object)])
def test_text_is_no_parameter(scale):
    with pytest.raises(ParameterError, match="which is text, not numbers; give "):
        bmc.Normal(0.0, scale)
