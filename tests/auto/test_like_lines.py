"""``explain`` of an unrolled template says once what holds for all slices, and all that differs."""

from __future__ import annotations

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.auto.explanation import together


def walk() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("q", bmc.HalfNormal(1.0))
    dbn.add("x", lambda x_prev, q: bmc.Normal(x_prev, q), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Poisson(np.exp(x)))
    return dbn


@pytest.mark.parametrize("engine", [None, bmc.MetropolisHastings(), bmc.LikelihoodWeighting(10)])
def test_slices_share_a_line(engine: object, capsys: pytest.CaptureFixture) -> None:
    found = bmc.explain(walk(), {"y": np.ones(30, dtype=int)}, engine)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) < 12 and "more" not in lines[-1]
    assert sum(line.strip().startswith("y[0..29]") for line in lines) == 1
    assert set(found.nodes) == {"q", *(f"{n}[{t}]" for n in "xy" for t in range(30))}


def test_what_differs_stays_apart() -> None:
    lines = [("x[0]", "slice"), ("x[1]", "walk"), ("x[2]", "slice"), ("x[3]", "slice"), ("z", "")]
    assert together(lines) == [("x[0, 2..3]", "slice"), ("x[1]", "walk"), ("z", "")]
    assert together(lines[:3]) == lines[:3]  # two alike are too few
    scattered = [(f"x[{t}]", "slice", str(t)) for t in range(0, 20, 2)]
    (line,) = together(scattered[:5], [2])
    assert line == ("x[0..8, 5 of these]", "slice", "0, 2, 4, 6, 8")
    assert together(scattered) == scattered  # what they say differs


def test_costs_are_shares_and_those_of_like_nodes_add_up() -> None:
    net = bmc.BayesNet()
    for j in range(5):
        net.add(f"x[{j}]", lambda: bmc.Laplace(0.0, 1.0))
        net.add(f"y[{j}]", lambda x: bmc.Poisson(np.exp(x)), parents=[f"x[{j}]"])
    net.add("s", bmc.Bernoulli(0.3))
    net.add("z", lambda s: bmc.Normal(1.0 * s, 1.0))
    evidence = {f"y[{j}]": j for j in range(5)} | {"z": 1.0}
    explanation = bmc.explain(net, evidence, engine=bmc.Gibbs())
    cost = {row.node: row.cost for row in explanation.table}
    # five slices of a prior and a likelihood, six evaluations each; one tabulated state of two numbers
    assert cost["x[0]"] == pytest.approx(6 * 2 / (5 * 6 * 2 + 2))
    assert sum(cost.values()) == pytest.approx(1.0)
    lines = {line.split()[0]: line.split() for line in str(explanation).splitlines()}
    assert "97" in lines["x[0..4]"] and "3" in lines["s"]


def test_one_kernel_for_all_has_no_share_to_tell() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("x", lambda a: bmc.Normal(a, 1.0))
    assert "cost" not in str(bmc.explain(net, {"x": 1.0}, engine=bmc.Gibbs()))
