"""Size: two thousand scalar nodes, a plate of a hundred thousand elements. No timing here."""

from __future__ import annotations

import tracemalloc

import numpy as np

import bayesmc as bmc


def test_two_thousand_scalar_nodes():
    net = bmc.BayesNet()
    net.add("x0", bmc.Normal(0.0, 1.0))
    for i in range(1, 2000):
        if i % 3:
            net.add(f"x{i}", lambda x: bmc.Normal(0.5 * x, 1.0), parents=[f"x{i - 1}"])
        else:
            net.add(f"x{i}", lambda x, y: 0.5 * (x + y), parents=[f"x{i - 1}", f"x{i - 2}"])
    net.validate()
    draws = net.sample(100, rng=0)
    assert len(draws) == 2000
    np.testing.assert_allclose(draws["x1998"], 0.5 * (draws["x1997"] + draws["x1996"]))
    assert np.isfinite(net.log_prob(draws)).all()


def test_a_chain_of_two_thousand_is_no_recursion():
    net = bmc.BayesNet()
    net.table("x0", [], [0.5, 0.5])
    for i in range(1, 2000):
        net.table(f"x{i}", [f"x{i - 1}"], [[0.9, 0.1], [0.2, 0.8]])
    assert net.sample(10, rng=0)["x1999"].shape == (10,)
    np.testing.assert_allclose(
        bmc.infer(net, engine=bmc.Exact()).probabilities("x1999"), [2 / 3, 1 / 3], rtol=1e-9
    )


def test_a_large_plate_validates_in_bounded_memory():
    n = 100_000
    group = np.arange(n) % 50
    net = bmc.BayesNet(plates={"point": n, "group": 50})
    net.add("m", bmc.Normal(0.0, 1.0), plates="group")
    net.add("z", bmc.Bernoulli(0.3), plates="point")
    net.add("x", lambda m, z: bmc.Normal(m[group] + z, 1.0), plates="point")
    net.add("total", lambda x: x.sum("point"))
    tracemalloc.start()
    net.validate()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 400 * n * 8  # a few dozen arrays of the plate with the probe's batch
    assert net.sample(2, rng=0)["x"].shape == (2, n)
