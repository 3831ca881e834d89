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
