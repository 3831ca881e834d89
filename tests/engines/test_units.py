"""Answers do not depend on the units that numbers come in: exact engines against themselves.

There is no chance in these tests: multipliers from 1e-6 to 1e6 have a fixed seed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import ZeroProbabilityError
from bayesmc.linalg.square_root import condition

ENGINES = (bmc.KalmanFilter(), bmc.ExtendedKalmanFilter(), bmc.UnscentedKalmanFilter())
NAN = np.nan


def units(seed: int, *names: str) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    return {n: 10 ** rng.uniform(-6, 6) for n in names}


# ---- rows that follow from others ----------------------------------------------------------------


@pytest.mark.parametrize("by", [1e-6, 1.0, 1e3, 1e6])
def test_rows_that_follow_from_those_before_are_found(by: float) -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        a, b = rng.normal(size=(2, 5))
        large, w = by * a, 10 ** rng.uniform(-6, 6, 3) * rng.normal(size=3)
        some = rng.normal(size=(3, 6)) * 10 ** rng.uniform(-6, 6, (3, 1))
        for rows in ([a, b, by * a + b], [large, large + b, b], [*some, w @ some]):
            found = condition(np.array(rows), len(rows))
            assert found.certain is not None
            assert found.certain.tolist() == [False] * (len(rows) - 1) + [True]
            assert not condition(np.array(rows), len(rows) - 1).factor.any()
        rows = rng.normal(size=(4, 6)) * 10 ** rng.uniform(-6, 6, (4, 1))
        assert condition(rows, 4).certain is None


def noiseless() -> bmc.BayesNet:
    net = bmc.BayesNet()
    for n in "ab":
        net.add(n, bmc.Normal(5e5, 10.0))
        net.add("y" + n, lambda a: bmc.Normal(a, 0.0), parents=[n])
    net.add("d", lambda a, b: bmc.Normal(a - b, 0.0))
    return net


def noiseless_series() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.add("a", lambda a_prev: bmc.Normal(a_prev, 10.0), initial=bmc.Normal(5e5, 10.0))
    dbn.add("b", lambda b_prev: bmc.Normal(b_prev, 10.0), initial=bmc.Normal(5e5, 10.0))
    dbn.add("ya", lambda a: bmc.Normal(a, 0.0))
    dbn.add("yb", lambda b: bmc.Normal(b, 0.0))
    dbn.add("d", lambda a, b: bmc.Normal(a - b, 0.0))
    return dbn


@pytest.mark.parametrize("seen", [("ya", "yb"), ("a", "b"), ("a", "yb")])
def test_a_small_difference_of_large_numbers_is_no_contradiction(seen: tuple[str, str]) -> None:
    """As an odometer's 5e5 m: the difference is rounded like what it is a difference of."""
    values = dict(zip(seen, (500000.001, 500000.0), strict=True))
    right = bmc.infer(noiseless(), values, engine=bmc.Exact()).log_marginal_likelihood
    found = bmc.infer(noiseless(), {**values, "d": 0.001}, engine=bmc.Exact())
    assert found.log_marginal_likelihood == pytest.approx(right)
    with pytest.raises(ZeroProbabilityError):
        bmc.infer(noiseless(), {**values, "d": 0.00101}, engine=bmc.Exact())


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("seen", [("ya", "yb"), ("a", "b")])
def test_small_differences_over_time(seen: tuple[str, str], engine: Any) -> None:
    rows: dict[str, Any] = {seen[0]: [500000.001, 500003.001], seen[1]: [500000.0, 500003.0]}
    right = bmc.filter(noiseless_series(), rows, engine=engine).log_marginal_likelihood
    rows["d"] = [0.001, 0.001]
    found = bmc.filter(noiseless_series(), rows, engine=engine)
    assert found.log_marginal_likelihood == pytest.approx(right)
    belief = engine.start(noiseless_series())
    for t in range(2):
        belief = engine.step(belief, {n: v[t] for n, v in rows.items()})
    assert belief.log_marginal_likelihood == pytest.approx(right)
    with pytest.raises(ZeroProbabilityError, match="slice 1"):
        bmc.filter(noiseless_series(), {**rows, "d": [0.001, 0.00101]}, engine=engine)


# ---- the same model in other units ------------------------------------------------------------------


def links(s: dict[str, Any]) -> bmc.BayesNet:
    """Links without noise, each number in its own unit."""
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(1.0 * s["x"], s["x"]))
    net.add("w", bmc.Normal(0.0, 2.0 * s["w"]))
    net.add("d", lambda x, w: bmc.Normal((2 * x / s["x"] - w / s["w"]) * s["d"], 0.0))
    net.add("e", lambda d, x: bmc.Normal((d / s["d"] + x / s["x"]) * s["e"], 0.0))
    net.add("y", lambda d: bmc.Normal(d / s["d"] * s["y"], 0.5 * s["y"]))
    return net


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(
    "evidence",
    [{"y": 1.5}, {"d": 1.0, "y": 2.0}, {"d": 0.5, "e": 1.5}, {"x": 1.0, "w": 0.5, "d": 1.5}],
)
def test_links_without_noise_in_other_units(evidence: dict[str, float], seed: int) -> None:
    s = units(seed, *"xwdey")
    right = bmc.infer(links(dict.fromkeys(s, 1.0)), evidence, engine=bmc.Exact())
    found = bmc.infer(links(s), {n: v * s[n] for n, v in evidence.items()}, engine=bmc.Exact())
    for n in set("xwdey") - set(evidence):
        assert found.mean(n) / s[n] == pytest.approx(right.mean(n), abs=1e-9)
        assert found.std(n) / s[n] == pytest.approx(right.std(n), abs=1e-7)
    follows = {"d"} if {"x", "w"} <= set(evidence) else set()  # a probability, in no unit
    moved = sum(np.log(s[n]) for n in evidence if n not in follows)
    wanted = right.log_marginal_likelihood - moved
    assert found.log_marginal_likelihood == pytest.approx(wanted, abs=1e-8)


def vectors(s: Any, r: Any) -> bmc.DynamicBayesNet:
    """A vector that moves, and rows of it, each component in its own unit."""
    step, noise = np.array([[1.0, 0.5], [0.0, 0.9]]), np.array([[1.0, 0.3], [0.3, 0.5]])
    scale, seen = np.outer(s, s), np.outer(r, r)
    dbn = bmc.DynamicBayesNet()
    dbn.add(
        "x", lambda x_prev: bmc.MvNormal(np.matvec(step, x_prev / s) * s, noise * scale),
        initial=bmc.MvNormal(np.zeros(2), np.eye(2) * scale),
    )  # fmt: skip
    dbn.add("y", lambda x: bmc.MvNormal(x / s * r, np.array([[0.5, 0.2], [0.2, 0.4]]) * seen))
    return dbn


ROWS = np.array([[1.0, NAN], [0.5, 0.3], [NAN, NAN], [NAN, 1.0]])


@pytest.mark.parametrize(
    ("engine", "call", "seed"),
    [
        (ENGINES[0], bmc.filter, 0),
        (ENGINES[0], bmc.smooth, 1),
        (ENGINES[1], bmc.filter, 2),
        (ENGINES[2], bmc.smooth, 3),
    ],
)
def test_partly_seen_vectors_and_queries_in_other_units(engine: Any, call: Any, seed: int) -> None:
    rng = np.random.default_rng(seed)
    s, r = 10 ** rng.uniform(-6, 6, (2, 2))

    def asked(s: Any) -> dict[str, Callable[..., Any]]:
        return {
            "first": lambda x, s=s: x[..., 0] > 0.2 * s[0],
            "second": lambda x, s=s: x[..., 1] > 0.2 * s[1],
            "square": lambda x, s=s: (x[..., 1] / s[1]) ** 2,
            "product": lambda x, s=s: x[..., 0] / s[0] * x[..., 1] / s[1],
        }

    one = np.ones(2)
    right = call(vectors(one, one), {"y": ROWS}, engine=engine, queries=asked(one))
    found = call(vectors(s, r), {"y": ROWS * r}, engine=engine, queries=asked(s))
    np.testing.assert_allclose(found.mean("x") / s, right.mean("x"), atol=1e-8)
    np.testing.assert_allclose(found.std("x") / s, right.std("x"), rtol=1e-6)
    moved = (np.isfinite(ROWS) * np.log(r)).sum()
    wanted = right.log_marginal_likelihood - moved
    assert found.log_marginal_likelihood == pytest.approx(wanted, abs=1e-7)
    for name in ("square", "product"):
        np.testing.assert_allclose(found.queries[name], right.queries[name], atol=1e-6)
    for name in ("first", "second"):
        np.testing.assert_allclose(found.queries[name], right.queries[name], atol=2e-3)


def test_events_of_a_vector_of_unlike_units() -> None:
    """Variances of 1e8 and 1e-8: the smaller one counts, and its half line has probability one half."""
    dbn = bmc.DynamicBayesNet()
    dbn.add(
        "x", lambda x_prev: bmc.MvNormal(x_prev, np.diag([1e8, 1e-8])),
        initial=bmc.MvNormal([0.0, 1e-4], np.diag([1e8, 1e-8])),
    )  # fmt: skip
    dbn.add("y", lambda x: bmc.Normal(x[..., 0], 1e4))
    found = bmc.filter(dbn, {"y": [0.0]}, engine=bmc.KalmanFilter())
    assert found.probability(lambda x: x[..., 1] > 1e-4)[0] == pytest.approx(0.5, abs=1e-3)
    assert found.probability(lambda x: x[..., 1] > 0)[0] == pytest.approx(0.841345, abs=1e-3)
