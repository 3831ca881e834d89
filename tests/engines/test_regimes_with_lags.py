"""Autoregressions whose mean switches (Hamilton 1989): lags of states are nodes, lags of data are inputs."""

import json
from pathlib import Path

import numpy as np
import pytest

import bayesmc as bmc


def hamilton(rows, mean, phi, sd):
    """y_t - mean[s_t] = sum_i phi_i (y_{t-i} - mean[s_{t-i}]) + noise, of four lags."""
    stationary = np.array([rows[1, 0], rows[0, 1]]) / (rows[1, 0] + rows[0, 1])
    dbn = bmc.DynamicBayesNet("regimes")
    for k in (1, 2, 3, 4):
        dbn.input(f"y{k}")
    same = np.eye(2)
    dbn.add(
        "s4", lambda s3_prev: bmc.Categorical(same[s3_prev]), initial=bmc.Categorical(stationary)
    )
    follow = {
        "s3": (
            lambda s2_prev: bmc.Categorical(same[s2_prev]),
            lambda s4: bmc.Categorical(rows[s4]),
        ),
        "s2": (
            lambda s1_prev: bmc.Categorical(same[s1_prev]),
            lambda s3: bmc.Categorical(rows[s3]),
        ),
        "s1": (lambda s_prev: bmc.Categorical(same[s_prev]), lambda s2: bmc.Categorical(rows[s2])),
    }
    for name, (later, first) in follow.items():
        dbn.add(name, later, initial=first)
    dbn.add("s", lambda s1: bmc.Categorical(rows[s1]), initial=lambda s1: bmc.Categorical(rows[s1]))

    @dbn.node
    def y(s, s1, s2, s3, s4, y1, y2, y3, y4):
        lags = ((y1, s1), (y2, s2), (y3, s3), (y4, s4))
        return bmc.Normal(
            mean[s] + sum(f * (v - mean[r]) for f, (v, r) in zip(phi, lags, strict=True)), sd
        )

    return dbn


def test_gnp_is_filtered_as_hamilton_has_it(reference_data: Path) -> None:
    """Log likelihood and filtered probabilities as EViews prints them, at its estimates."""
    folder = reference_data / "statespace"
    if not (folder / "us_rgnp_hamilton.csv").exists():
        pytest.skip("no us_rgnp_hamilton.csv in the data folder")
    known = json.loads((folder / "us_rgnp_hamilton.ref.json").read_text())["hamilton_ar4"]
    p = known["params"]
    growth = np.genfromtxt(folder / "us_rgnp_hamilton.csv", delimiter=",", skip_header=1)[:, 1]
    rows = np.array([[p["p00"], 1 - p["p00"]], [p["p10"], 1 - p["p10"]]])
    phi = [p[f"phi{k}"] for k in (1, 2, 3, 4)]
    dbn = hamilton(rows, np.array([p["mu0"], p["mu1"]]), phi, np.sqrt(p["sigma2"]))
    lags = {f"y{k}": growth[4 - k : -k] for k in (1, 2, 3, 4)}
    found = bmc.filter(dbn, {"y": growth[4:]}, inputs=lags)
    assert type(found.engine).__name__ == "DiscreteFilter"
    assert found.log_marginal_likelihood == pytest.approx(known["loglik_at_params"], abs=1e-4)
    wanted = known["filtered_prob_state1_t5_onward"]
    np.testing.assert_allclose(found.probabilities("s")[:, 1], wanted, atol=1e-5)
