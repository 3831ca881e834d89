"""Elements that were observed have no rows in a summary, unless their node is asked for."""

import numpy as np
import pytest

import bayesmc as bmc


def answered(engine):
    net = bmc.BayesNet(plates={"row": 3})
    net.add("rain", bmc.Bernoulli(0.3), states=("no", "yes"), plates="row")
    net.add("x", bmc.MvNormal([0.0, 0.0], [[1.0, 0.5], [0.5, 1.0]]), plates="row")
    net.add("y", lambda x: bmc.Normal(x[..., 0], 1.0), plates="row")
    evidence = {
        "rain": [None, "yes", None],
        "x": [[1.0, 2.0], [0.3, np.nan], [np.nan, np.nan]],
        "y": [np.nan, 0.2, 0.1],
    }
    return bmc.infer(net, evidence, engine=engine, rng=0)


HIDDEN = ["rain[0, no]", "rain[0, yes]", "rain[2, no]", "rain[2, yes]"]
HIDDEN += ["x[1, 1]", "x[2, 0]", "x[2, 1]", "y[0]"]


@pytest.mark.parametrize("engine", [bmc.LikelihoodWeighting(500), bmc.Gibbs(1000, warmup=100)])
def test_rows_are_of_what_is_not_known(engine):
    posterior = answered(engine)
    summary = posterior.summary()
    assert list(summary.names) == HIDDEN
    whole = posterior.summary(["y", "x", "rain"])
    assert len(whole.names) == 3 + 6 + 6
    assert {"x[0, 1]", "x[1, 0]", "y[1]", "rain[1, yes]"} <= set(whole.names)
    for name in HIDDEN:
        assert summary[name]["mean"] == whole[name]["mean"]
    assert whole["x[1, 0]"]["mean"] == pytest.approx(0.3)


def test_data_frames_have_the_same_rows():
    pytest.importorskip("pandas")
    posterior = answered(bmc.Gibbs(1000, warmup=100))
    assert list(posterior.to_dataframe("summary").index) == HIDDEN
    assert len(posterior.to_dataframe("summary", names=["x"])) == 6
