"""``Exact`` as an engine: what it takes and refuses, what it says, what it keeps."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import scipy.stats

import bayesmc as bmc
from bayesmc.errors import (
    BudgetError,
    ParameterError,
    UnknownNodeError,
    UnsupportedError,
    ZeroProbabilityError,
)
from bayesmc.testing import assert_matches, enumerate_posterior

EXACT = bmc.Exact()


def chain(length: int = 3) -> bmc.BayesNet:
    net = bmc.BayesNet("chain")
    net.add("s0", bmc.Bernoulli(0.3))
    for i in range(1, length):
        net.add(f"s{i}", lambda a: bmc.Bernoulli(0.1 + 0.7 * a), parents=[f"s{i - 1}"])
    return net


def grid(side: int) -> bmc.BayesNet:
    """A net whose induced width grows with its side."""
    net = bmc.BayesNet("grid")
    for i in range(side):
        for j in range(side):
            parents = [f"n{a}_{b}" for a, b in ((i - 1, j), (i, j - 1)) if a >= 0 and b >= 0]
            table = np.full((3,) * len(parents) + (3,), 1 / 3)
            net.table(f"n{i}_{j}", parents, table)
    return net


def test_evidence_in_every_form() -> None:
    net = bmc.BayesNet(plates={"i": 3})
    net.table("a", probs=[0.2, 0.8], states=("no", "yes"))
    net.add("b", lambda a: bmc.Bernoulli(0.3 + 0.4 * (a == "yes")), plates="i")
    net.table("c", ["a"], [[0.5, 0.5], [0.9, 0.1]], states=(-1.0, 2.5))
    net.add("x", lambda b: bmc.Normal(b, 1.0), plates="i")
    for evidence in (
        {},
        {"a": "no"},
        {"c": 2.5},
        {"b": [1, 0, 1]},
        {"b": np.ma.MaskedArray([1, 0, 1], [False, True, True])},
        {"b": [1, np.nan, 0]},
        {"b": [1, None, 0], "c": None},
    ):
        full = {**evidence, "x": [0.1, 2.0, -0.3]}
        assert_matches(bmc.infer(net, full, engine=EXACT), enumerate_posterior(net, full))


def test_vector_evidence_is_a_likelihood() -> None:
    net = bmc.BayesNet()
    net.add("k", bmc.Categorical([0.5, 0.3, 0.2]))
    net.add("v", lambda k: bmc.MvNormal(bmc.stack([k, -1.0 * k]), np.diag([1.0, 4.0])))
    posterior = bmc.infer(net, {"v": [1.0, -2.0]}, engine=EXACT)
    joint = [
        p * scipy.stats.multivariate_normal.pdf([1.0, -2.0], [k, -k], np.diag([1.0, 4.0]))
        for k, p in enumerate([0.5, 0.3, 0.2])
    ]
    np.testing.assert_allclose(posterior.probabilities("k"), np.array(joint) / sum(joint))
    assert posterior.log_marginal_likelihood == pytest.approx(np.log(sum(joint)))


def test_observed_continuous_parents() -> None:
    """What is seen is a constant, also for the nodes below it."""
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.5))
    net.add("x", lambda a: bmc.Normal(a, 1.0))
    net.add("double", lambda x: 2 * x)
    net.add("b", lambda x, a: bmc.Bernoulli(1 / (1 + np.exp(-x - a))))
    net.add("y", lambda double: bmc.Normal(double, 1.0))
    for x in (0.3, -1.5):  # the second answer must not remember the first's evidence
        evidence = {"x": x, "y": 1.0}
        posterior = bmc.infer(net, evidence, engine=EXACT)
        assert_matches(posterior, enumerate_posterior(net, evidence))
        assert posterior.mean("double") == pytest.approx(2 * x)
        assert type(bmc.infer(net, evidence).engine) is bmc.Exact
    net.add("z", lambda x: bmc.StudentT(5.0, x, 1.0))
    with pytest.raises(UnsupportedError, match="'z' is StudentT"):
        bmc.infer(net, {"x": 0.3}, engine=EXACT)


def test_do_inputs_and_potentials() -> None:
    net = chain()
    assert bmc.infer(net.do(s1=1), {"s2": 1}, engine=EXACT).mean("s0") == pytest.approx(0.3)
    assert bmc.infer(net.do(s0=1), engine=EXACT).mean("s1") == pytest.approx(0.8)

    net = bmc.BayesNet()
    net.input("bias")
    net.add("a", lambda bias: bmc.Bernoulli(bias))
    net.add("b", lambda a: bmc.Bernoulli(0.2 + 0.6 * a))
    for bias in (0.1, 0.9, 0.1):
        posterior = bmc.infer(net, {"b": 1}, inputs={"bias": bias}, engine=EXACT)
        odds = bias * 0.8 / ((1 - bias) * 0.2)
        assert posterior.mean("a") == pytest.approx(odds / (1 + odds))
    net.potential("agree", lambda a, b: np.where(a == b, np.log(3.0), 0.0))
    found = bmc.infer(net, inputs={"bias": 0.4}, engine=EXACT)
    assert_matches(found, enumerate_posterior(net, inputs={"bias": 0.4}))


def test_a_plate_potential_is_counted_once_per_element() -> None:
    net = bmc.BayesNet(plates={"i": 3})
    net.add("z", bmc.Bernoulli(0.5), plates="i")
    net.potential("own", lambda z: 0.7 * z, plates="i")
    net.potential("all", lambda z: -0.4 * z.sum("i") ** 2)
    assert_matches(bmc.infer(net, engine=EXACT), enumerate_posterior(net))


def test_impossible_evidence_names_the_culprit() -> None:
    net = bmc.BayesNet()
    net.table("rain", probs=[0.5, 0.5], states=("no", "yes"))
    net.table("wet", ["rain"], [[1, 0], [0, 1]], states=("dry", "wet"))
    net.table("wind", probs=[0.5, 0.5], states=("calm", "storm"))
    evidence = {"wind": "storm", "rain": "no", "wet": "wet"}
    with pytest.raises(ZeroProbabilityError, match="wet='wet' is impossible given .*rain='no'"):
        bmc.infer(net, evidence, engine=EXACT)

    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.5))
    net.add("x", lambda a: bmc.Uniform(0.0, 1.0 + a))
    with pytest.raises(ZeroProbabilityError, match="probability zero"):
        bmc.infer(net, {"a": 0, "x": 1.5}, engine=EXACT)


def test_refuses_hidden_continuous_and_infinite_nodes() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.5))
    net.add("x", lambda a: bmc.Gamma(2.0 + a, 1.0))
    net.add("n", lambda a: bmc.Poisson(1.0 + a))
    assert "'x' is Gamma, not Normal" in EXACT.unsupported(net, {"n": 2})
    assert "'n' is discrete with too many values" in EXACT.unsupported(net, {"x": 0.2})
    assert EXACT.unsupported(net, {"x": 0.2, "n": 1}) is None
    with pytest.raises(UnsupportedError, match="'x' is Gamma.*LikelihoodWeighting"):
        bmc.infer(net, {"n": 2}, engine=EXACT)


def test_refuses_ahead_of_time_with_the_cost() -> None:
    net = grid(14)
    tracemalloc.start()
    with pytest.raises(BudgetError, match=r"induced width \d+.*max_bytes=1 MiB") as caught:
        bmc.infer(net, engine=bmc.Exact(max_bytes=2**20))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert caught.value.bytes > 2**20
    assert peak < caught.value.bytes  # nothing of that size was allocated
    small = bmc.infer(grid(3), engine=bmc.Exact(max_bytes=2**20))
    np.testing.assert_allclose(small.probabilities("n2_2"), 1 / 3)


def test_bad_parameters_matter_only_where_possible() -> None:
    """Nine by nine states, so that the net's own checks do not happen to try the bad ones."""
    for kind, bad in (
        ("discrete", lambda a, b: bmc.Bernoulli(np.where((a == 8) & (b == 8), 2.0, 0.3))),
        ("observed", lambda a, b: bmc.Normal(0.0, np.where((a == 8) & (b == 8), -1.0, 1.0))),
    ):
        net = bmc.BayesNet(kind)
        net.add("a", bmc.Categorical(np.full(9, 1 / 9)))
        net.add("b", bmc.Categorical(np.append(np.full(8, 1 / 8), 0.0)))
        net.add("x", bad, parents=["a", "b"])
        assert bmc.infer(net, {"x": 1}, engine=EXACT).mean("a") == pytest.approx(4.0)
        net.add("b", bmc.Categorical(np.full(9, 1 / 9)), replace=True)
        with pytest.raises(ParameterError, match="'x'"):
            bmc.infer(net, {"x": 1}, engine=EXACT)
        # made impossible by evidence, they do not matter again
        assert bmc.infer(net, {"x": 1, "b": 0}, engine=EXACT).mean("a") == pytest.approx(4.0)


def test_the_answer_does_not_depend_on_chance_or_change_later() -> None:
    net = chain()
    posterior = bmc.infer(net, {"s2": 1}, engine=EXACT, rng=1)
    before = posterior.probabilities("s0")
    before_again = posterior.probabilities("s0")
    before_again[:] = 0  # the user's own array
    np.testing.assert_array_equal(posterior.probabilities("s0"), before)
    net.add("s0", bmc.Bernoulli(0.9), replace=True)
    np.testing.assert_array_equal(posterior.probabilities("s0"), before)
    assert bmc.infer(net, {"s2": 1}, engine=EXACT).mean("s0") > before[1]


def test_figures_of_an_exact_answer() -> None:
    posterior = bmc.infer(chain(), {"s2": 1}, engine=EXACT)
    assert posterior.mcse("s0") == 0
    assert posterior.ess("s0") == np.inf
    assert posterior.log_marginal_likelihood_mcse == 0.0
    assert posterior.weights is None
    with pytest.raises(UnknownNodeError, match="no node 'zz'"):
        posterior.mean("zz")
    with pytest.raises(UnsupportedError, match="resample"):
        posterior["s0"]


def test_resample_draws_from_the_posterior() -> None:
    """400 comparisons' worth of draws against the exact answer, false-alarm rate 1e-3."""
    net = chain(5)
    evidence = {"s4": 1}
    posterior = bmc.infer(net, evidence, engine=EXACT)
    drawn = posterior.resample(20_000, rng=3)
    assert_matches(drawn, enumerate_posterior(net, evidence), alpha=1e-3)
    again = posterior.resample(20_000, rng=3)
    np.testing.assert_array_equal(drawn["s0"], again["s0"])


@pytest.mark.filterwarnings("ignore:evidence on .* is empty:bayesmc.errors.EvidenceWarning")
@pytest.mark.parametrize("keep", ["exact", "draws", "summaries"])
def test_plates_of_size_zero(keep: str) -> None:
    """An empty plate has no elements and no influence; its figures are empty arrays."""
    net = bmc.BayesNet(plates={"p": None, "q": 2})
    net.add("h", bmc.Bernoulli(0.3))
    net.add("x", lambda h: bmc.Bernoulli(0.5 + 0.1 * h), plates="p")
    net.add("w", lambda h: bmc.Categorical([0.2, 0.5, 0.3]), plates=("p", "q"))
    net.add("total", lambda x: x.sum("p"))
    engine = EXACT if keep == "exact" else bmc.LikelihoodWeighting(2000)
    posterior = bmc.infer(
        net, {"x": []}, engine=engine, rng=0, keep="draws" if keep == "exact" else keep
    )
    assert posterior.mean("h") == pytest.approx(0.3, abs=0.05)  # 4.9 standard errors of 0.0102
    assert posterior.log_marginal_likelihood == pytest.approx(0.0, abs=1e-12)
    assert posterior.mean("total") == 0
    for figure in ("mean", "std", "mcse", "ess"):
        assert getattr(posterior, figure)("x").shape == (0,)
        assert getattr(posterior, figure)("w").shape == (0, 2)
    assert posterior.probabilities("x").shape == (0, 2)
    assert posterior.probabilities("w").shape == (0, 2, 3)
    assert not any(n.startswith(("x", "w")) for n in posterior.summary().names)
    if keep != "summaries":
        assert posterior.probabilities("h", "x").shape == (0, 2, 2)
        assert posterior.resample(5, rng=0)["w"].shape == (1, 5, 0, 2)
        assert posterior.expectation(lambda h, x: h + x.sum(axis=-1)) == pytest.approx(
            float(posterior.mean("h"))
        )


def test_resume_is_refused() -> None:
    posterior = bmc.infer(chain(), engine=EXACT)
    with pytest.raises(UnsupportedError, match="resume"):
        bmc.infer(chain(), engine=EXACT, resume=posterior)


def test_explain(capsys: pytest.CaptureFixture) -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.5))
    net.add("twice", lambda a: 2 * a)
    net.add("x", lambda twice: bmc.Normal(twice, 1.0))
    found = bmc.explain(net, {"x": 1.0})
    assert isinstance(found.engine, bmc.Exact)
    assert "induced width" in found.reasons[0]
    assert found.nodes["x"] == "observed: a likelihood factor"
    assert found.nodes["a"] == "eliminated"
    assert str(found) in capsys.readouterr().out
    assert bmc.explain(net).nodes["x"] == "integrated out: linear-Gaussian"
    net.add("y", lambda x: bmc.Gamma(1.0 + x**2, 1.0))
    refused = bmc.explain(net, engine=EXACT)
    assert "'y' is Gamma" in refused.refused["Exact"]
    other = bmc.explain(net)
    assert isinstance(other.engine, bmc.LikelihoodWeighting)
    assert "'y' is Gamma" in other.refused["Exact"]
