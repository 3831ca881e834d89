"""Configurations of the parents that cannot happen may have bad parameters, or none at all.

Only where one is possible is it an error; an engine that must evaluate all of them says so.
"""

from __future__ import annotations

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import ParameterError, UnsupportedError


def test_bad_parameters_in_a_plate_of_observed_parents() -> None:
    """The table's rows come without a batch axis there, the weights with one."""
    for size in (3, 1000):  # a plate as long as the batch, too
        net = bmc.BayesNet(plates={"p": size})
        net.add("h", bmc.Bernoulli(0.5))
        net.add("e", lambda h: bmc.Bernoulli(0.2 + 0.6 * h))
        net.add("a", bmc.Categorical(np.full(9, 1 / 9)), plates="p")
        net.add("c", bmc.Categorical(np.full(9, 1 / 9)), plates="p")
        net.add(
            "b",
            lambda a, c: bmc.Bernoulli(np.where((a == 8) & (c == 8), 2.0, 0.5)),
            plates="p",
        )
        seen = np.arange(size) % 8
        engine = bmc.LikelihoodWeighting(1000)
        p = bmc.infer(net, {"e": 1, "a": seen, "c": seen}, engine=engine, rng=0)
        error = 0.5 / np.sqrt(p.weight_ess)
        assert np.abs(p.mean("b") - 0.5).max() < 5.5 * error  # 1003 means: false alarm 4e-5
        seen = np.where(np.arange(size) == size - 1, 8, seen)
        with pytest.raises(ParameterError, match="node 'b'"):
            bmc.infer(net, {"e": 1, "a": seen, "c": seen}, engine=engine, rng=0)


def failing_where_impossible() -> bmc.BayesNet:
    """``table[a + c]`` with ``a + c <= 3`` always; an index of 4 to 6 raises."""
    table = np.array([0.1, 0.2, 0.3, 0.4])
    net = bmc.BayesNet()
    net.add("a", bmc.DiscreteUniform(0, 3))
    net.add(
        "c",
        lambda a: bmc.Categorical(
            np.where(np.arange(4) <= 3 - a[..., None], 1.0, 0.0) / (4 - a[..., None])
        ),
    )
    net.add("b", lambda a, c: bmc.Bernoulli(table[a + c]))
    net.add("s", lambda a, c: table[a + c] * 10)
    return net


def test_functions_that_raise_where_parents_never_are() -> None:
    net = failing_where_impossible()
    mean = np.mean([np.mean([0.1, 0.2, 0.3, 0.4][a:]) for a in range(4)])
    for engine in (bmc.LikelihoodWeighting(20_000), None):
        for keep in ("draws", "summaries"):
            p = bmc.infer(net, engine=engine, rng=0, keep=keep)
            assert abs(p.mean("b") - mean) < 4.5 * p.mcse("b")  # false alarm 7e-6
            assert abs(p.mean("s") - 10 * mean) < 4.5 * p.mcse("s")
        p = bmc.infer(net, {"b": 1, "a": 1}, engine=engine, rng=0)
        draws = np.min(p.ess("c")) if p.weight_ess is None else p.weight_ess
        assert abs(p.probabilities("c")[2] - 4 / 9) < 4.5 * np.sqrt(20 / 81 / draws)
    assert "LikelihoodWeighting" in str(bmc.explain(net).engine)


@pytest.mark.parametrize("evidence", [{}, {"b": 1}, {"a": 1}], ids=["none", "b", "a"])
def test_exact_says_why_it_cannot(evidence: dict) -> None:
    net = failing_where_impossible()
    reason = bmc.Exact().unsupported(net, evidence)
    assert reason is not None and "impossible" in reason and "node '" in reason
    with pytest.raises(
        UnsupportedError, match=r"all configurations.*IndexError.*LikelihoodWeighting"
    ):
        bmc.infer(net, evidence, engine=bmc.Exact())
    assert "IndexError" in bmc.explain(net, evidence).refused["Exact"]


def test_bad_parameters_that_later_evidence_excludes() -> None:
    """The evidence on ``z`` rules out the bad configuration of ``x``, which is declared before it."""
    net = bmc.BayesNet()
    net.add("a", bmc.Categorical(np.full(9, 1 / 9)))
    net.add("c", bmc.Categorical(np.full(9, 1 / 9)))
    net.add("x", lambda a, c: bmc.Normal(0.0, np.where((a == 8) & (c == 8), -1.0, 1.0)))
    net.add("z", lambda a: bmc.Bernoulli(np.where(a == 8, 0.0, 0.5)))
    evidence = {"x": 0.0, "z": 1}
    assert bmc.infer(net, evidence, engine=bmc.Exact()).mean("a") == pytest.approx(3.5)
    p = bmc.infer(net, evidence, engine=bmc.LikelihoodWeighting(5000), rng=0)
    assert abs(p.mean("a") - 3.5) < 4.5 * p.mcse("a")  # false alarm 7e-6
    for engine in (bmc.Exact(), bmc.LikelihoodWeighting(5000)):
        with pytest.raises(ParameterError, match="'x'"):  # and without it they count
            bmc.infer(net, {"x": 0.0}, engine=engine, rng=0)


def test_a_potential_excludes_before_later_nodes_are_evaluated() -> None:
    """A potential counts as soon as its nodes have values, so bad parameters behind it do not."""
    net = bmc.BayesNet()
    net.add("a", bmc.Categorical(np.ones(9) / 9))
    net.add("c", bmc.Categorical(np.ones(9) / 9))
    net.add("x", lambda a, c: bmc.Normal(0.0, np.where((a == 8) & (c == 8), -1.0, 1.0)))
    net.potential("no", lambda a, c: np.where((a == 8) & (c == 8), -np.inf, 0.0))
    exact = bmc.infer(net, {"x": 0.0}, engine=bmc.Exact())
    drawn = bmc.infer(net, {"x": 0.0}, engine=bmc.LikelihoodWeighting(20_000), rng=0)
    assert exact.mean("a") == pytest.approx(316 / 80)
    assert abs(drawn.mean("a") - 316 / 80) < 5 * drawn.mcse("a")  # false alarm 6e-7
