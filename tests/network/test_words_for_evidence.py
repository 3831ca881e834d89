"""What is said of evidence that no parents allow, ragged lists, computed nodes and bad parameters."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.engines.mcmc import starts
from bayesmc.errors import EvidenceError, ModelError, ParameterError, UnsupportedError

#: runs are short
pytestmark = pytest.mark.filterwarnings("ignore::bayesmc.errors.ConvergenceWarning")


def net_of(**nodes: Any) -> bmc.BayesNet:
    net = bmc.BayesNet()
    for name, function in nodes.items():
        net.add(name, function)
    return net


IMPOSSIBLE = {
    "binomial, random N": (
        net_of(N=bmc.Poisson(5.0), k=lambda N: bmc.Binomial(N, 0.3)), -2, "integers >= 0",
    ),
    "binomial, half a count": (
        net_of(N=bmc.Poisson(5.0), p=bmc.Beta(1, 1), k=lambda N, p: bmc.Binomial(N, p)), 1.5,
        "integers >= 0",
    ),
    "uniform, random end": (
        net_of(r=bmc.Gamma(1, 1), k=lambda r: bmc.Uniform(0, r)), -1.0, "numbers >= 0",
    ),
    "uniform, the other end": (
        net_of(r=bmc.Gamma(1, 1), k=lambda r: bmc.Uniform(-r, 2.0)), 3.0, "numbers <= 2",
    ),
    "poisson": (net_of(r=bmc.Gamma(1, 1), k=lambda r: bmc.Poisson(r)), -1, "integers >= 0"),
    "poisson, half a count": (net_of(r=bmc.Gamma(1, 1), k=lambda r: bmc.Poisson(r)), 1.5, "1.5"),
    "beta": (net_of(r=bmc.Gamma(1, 1), k=lambda r: bmc.Beta(r, 1)), 1.2, r"numbers in \[0, 1\]"),
    "label": (net_of(p=bmc.Dirichlet([1, 1, 1]), k=lambda p: bmc.Categorical(p)), 3, "0, 1, 2"),
}  # fmt: skip


@pytest.mark.parametrize("name", IMPOSSIBLE)
def test_evidence_that_no_parents_allow_is_named_at_once(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def search(*_: Any, **__: Any) -> None:
        raise AssertionError("a start was looked for")

    monkeypatch.setattr(starts, "refuse_impossible", search)
    net, value, says = IMPOSSIBLE[name]
    for engine in (None, bmc.Gibbs(), bmc.LikelihoodWeighting(1000)):
        with pytest.raises(EvidenceError, match=f"'k'.*{says}"):
            bmc.infer(net, {"k": value}, engine=engine)


def test_evidence_that_some_parents_allow_is_taken() -> None:
    """The control: bounds that depend on parents refuse nothing beyond what is seen of none."""
    net = net_of(N=bmc.Poisson(5.0), k=lambda N: bmc.Binomial(N, 0.5))
    found = bmc.infer(net, {"k": 30}, engine=bmc.Gibbs(200, chains=2, warmup=100), rng=0)
    assert float(found.probability(lambda N: N >= 30)) == 1.0
    ends = net_of(a=bmc.Normal(0, 1), y=lambda a: bmc.Uniform(a, a + 2.0))
    for y in (-40.0, 40.0):
        with pytest.raises(bmc.errors.BayesmcError) as said:
            bmc.infer(ends, {"y": y}, engine=bmc.LikelihoodWeighting(100), rng=0)
        assert "support" not in str(said.value)


def test_rows_that_no_state_allows_are_named_at_once() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Poisson(x_prev + 1), initial=bmc.Poisson(3))
    dbn.add("y", lambda x: bmc.Binomial(x, 0.5))
    for rows, at in (([1, -1, 2], 1), ([1, 2, 2.5], 2)):
        with pytest.raises(EvidenceError, match=f"'y'.*index {at}.*integers >= 0"):
            bmc.filter(dbn, {"y": rows}, engine=bmc.ParticleFilter(100))


@pytest.mark.parametrize(
    ("value", "odd"),
    [([[1, 2], [3]], r"\(2,\) and entry 1 has shape \(1,\)"), ([[1, 2], 3], "entry 1")],
)
def test_ragged_lists_say_which_entry(value: Any, odd: str) -> None:
    net = bmc.BayesNet(plates={"i": 2, "j": 2})
    net.add("m", bmc.Normal(0, 1))
    net.add("y", lambda m: bmc.Normal(m, 1), plates=("i", "j"))
    with pytest.raises(EvidenceError, match=rf"ragged.*{odd}.*shape \(2, 2\).*i=2, j=2.*NaN"):
        bmc.infer(net, {"y": value})


def test_computed_nodes_that_are_observed_say_what_to_do() -> None:
    net = net_of(a=bmc.Gamma(1, 1), b=bmc.Gamma(2, 1), c=lambda a, b: a * b)
    for engine in (bmc.Gibbs(), bmc.MetropolisHastings(), bmc.LikelihoodWeighting(100)):
        with pytest.raises(UnsupportedError, match="'c'.*computed.*c_seen.*Normal") as said:
            bmc.infer(net, {"c": 1.2}, engine=engine)
        assert "declare a function" not in str(said.value)
    net.add("c_seen", lambda c: bmc.Normal(c, 0.1))  # as it says
    found = bmc.infer(net, {"c_seen": 1.2}, engine=bmc.Gibbs(100, chains=2, warmup=50), rng=0)
    assert abs(float(found.mean("c")) - 1.2) < 0.3
    net = net_of(a=bmc.Gamma(1, 1), c=lambda a: bmc.Normal(a, 0.0))  # the control: no link
    with pytest.raises(UnsupportedError, match="declare a function"):
        bmc.infer(net, {"c": 1.2}, engine=bmc.Gibbs())


@pytest.mark.parametrize("scale", [lambda t: np.where(t == 3, -1, 1), lambda t: 3.0 - t])
def test_parameters_that_no_draw_is_to_blame_for_are_not_blamed_on_priors(scale: Any) -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev, t: bmc.Normal(x_prev, scale(t)), initial=bmc.Normal(0, 1))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    at = 3 if scale(np.asarray(2)) == 1 and scale(np.asarray(4)) == 1 else 4
    with pytest.raises(ParameterError, match=rf"slice {at}.*'x'.*got -1.*t = {at}.*mend") as said:
        bmc.filter(dbn, {"y": np.zeros(6)}, engine=bmc.ParticleFilter(50))
    assert "prior" not in str(said.value)


def test_parameters_that_some_draws_are_to_blame_for_name_priors() -> None:
    net = net_of(s=bmc.Normal(1, 1), y=lambda s: bmc.Normal(0, s))
    with pytest.raises(ParameterError, match="HalfNormal"):
        bmc.infer(net, {"y": 1.0}, engine=bmc.LikelihoodWeighting(1000), rng=0)


@pytest.mark.parametrize("cpd", [{"a": 1}, [[0.5, 0.5], [1.0]]])
def test_what_is_no_table_is_refused(cpd: Any) -> None:
    with pytest.raises(
        ModelError, match="'x'.*no density; give a distribution, a function, or a table"
    ):
        bmc.BayesNet().add("x", cpd)
