"""Gibbs over time: hidden Markov chains with unknown rates and emissions mix, whatever is asked of them.

What mixing takes is stated as a share of the draws: a must of 400 effective ones among the 4,000 that
``infer`` makes by default. Single-site moves, as a control, are seen to fall below it.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.diagnostics import chain_statistic
from bayesmc.engines.mcmc import gibbs
from bayesmc.errors import ConvergenceWarning
from bayesmc.testing import session
from bayesmc.testing.posteriors.matching import assert_matches

#: effective draws for each draw that is kept
SHARE = 0.1
SEED = session.seed()


def gaussian(states: int) -> bmc.DynamicBayesNet:
    """Unknown rates, levels and a common variance: symmetric in the states."""
    dbn = bmc.DynamicBayesNet(plates={"state": states})
    dbn.add_static("row", bmc.Dirichlet(np.ones(states)), plates="state")
    dbn.add_static("level", bmc.Normal(0.0, 3.0), plates="state")
    dbn.add_static("variance", bmc.InverseGamma(2.0, 1.0))
    start = bmc.Categorical(np.full(states, 1.0 / states))
    dbn.add("s", lambda s_prev, row: bmc.Categorical(row[s_prev]), initial=start)
    dbn.add("y", lambda s, level, variance: bmc.Normal(level[s], np.sqrt(variance)))
    return dbn


def noisy() -> bmc.DynamicBayesNet:
    """Unknown rates of a state that is changed seldom, and readings that say little of it."""
    dbn = bmc.DynamicBayesNet(plates={"state": 2})
    dbn.add_static("leave", bmc.Beta(1.0, 20.0), plates="state")

    def moved(s_prev: Any, leave: Any) -> Any:
        p = leave[s_prev]
        return bmc.Bernoulli(np.where(s_prev == 1, 1 - p, p))

    dbn.add("s", moved, initial=bmc.Bernoulli(0.5))
    dbn.add("y", lambda s: bmc.Normal(1.0 * s, 1.5))
    return dbn


def counting() -> bmc.DynamicBayesNet:
    """Two states with one unknown share each, and counts at unknown rates."""
    dbn = bmc.DynamicBayesNet(plates={"state": 2})
    dbn.add_static("leave", bmc.Beta(1.0, 4.0), plates="state")
    dbn.add_static("rate", bmc.Gamma(2.0, 0.5), plates="state")

    def moved(s_prev: Any, leave: Any) -> Any:
        p = leave[s_prev]
        return bmc.Bernoulli(np.where(s_prev == 1, 1 - p, p))

    dbn.add("s", moved, initial=bmc.Bernoulli(0.5))
    dbn.add("y", lambda s, rate: bmc.Poisson(rate[s]))
    return dbn


def left_to_right() -> bmc.DynamicBayesNet:
    """Three states of which none is gone back to, with an unknown rate of leaving: single sites are stuck."""
    dbn = bmc.DynamicBayesNet(plates={"state": 3})
    dbn.add_static("leave", bmc.Beta(1.0, 9.0))
    dbn.add_static("level", bmc.Normal([0.0, 1.5, 3.0], 1.0), plates="state")

    def moved(s_prev: Any, leave: Any) -> Any:
        go = np.where(s_prev == 2, 0.0, leave)
        ahead = [
            np.where(s_prev == k, 1 - go, np.where(s_prev == k - 1, go, 0.0)) for k in range(3)
        ]
        return bmc.Categorical(bmc.stack(ahead, axis=-1))

    dbn.add("s", moved, initial=bmc.Categorical([1.0, 0.0, 0.0]))
    dbn.add("y", lambda s, level: bmc.Normal(level[s], 0.8))
    return dbn


def visited(rng: np.random.Generator, steps: int, states: int) -> np.ndarray:
    """Runs of 4 to 16 slices in each state in turn."""
    lengths = rng.integers(4, 17, steps)
    return np.repeat(np.arange(steps) % states, lengths)[:steps]


def readings(rng: np.random.Generator, steps: int, levels: list[float]) -> np.ndarray:
    return np.array(levels)[visited(rng, steps, len(levels))] + rng.standard_normal(steps)


CASES = {
    "two states": (gaussian(2), lambda r, n: readings(r, n, [-1.4, 1.4])),
    "three states": (gaussian(3), lambda r, n: readings(r, n, [-3.0, 0.0, 3.0])),
    "counts": (counting(), lambda r, n: r.poisson(1.0 + 4.0 * visited(r, n, 2))),
    "noisy": (noisy(), lambda r, n: 1.0 * (visited(r, n, 6) > 2) + 1.5 * r.standard_normal(n)),
    "left to right": (
        left_to_right(),
        lambda r, n: np.repeat([0.0, 1.5, 3.0], -(-n // 3))[:n] + 0.8 * r.standard_normal(n),
    ),
}
#: by which parameter states are put in order, where they are symmetric
ORDERED = {
    "two states": "level",
    "three states": "level",
    "counts": "rate",
    "noisy": "",
    "left to right": "",
}


def effective(posterior: Any, names: Sequence[str], by: str) -> dict[str, np.ndarray]:
    """Effective draws of every parameter, the states in the order of one of them in each draw."""
    draws = {n: posterior[n] for n in names}
    order = np.argsort(draws[by], axis=-1) if by else None
    found = {}
    for name, value in draws.items():
        if order is not None and value.shape[2:3] == order.shape[-1:]:
            where = order.reshape(*order.shape, *(1,) * (value.ndim - order.ndim))
            value = np.take_along_axis(value, where, axis=2)
            if value.ndim == 4:
                value = np.take_along_axis(value, order[:, :, None, :], axis=3)
        found[name] = chain_statistic("ess", value)
    return found


def learnt(name: str, steps: int, engine: Any) -> tuple[dict[str, np.ndarray], Any]:
    dbn, made = CASES[name]
    rows = made(np.random.default_rng(SEED + 5), steps)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # labels may switch between chains
        keep = "draws" if engine is None else list(dbn.static_nodes)
        posterior = bmc.infer(dbn, {"y": rows}, engine=engine, rng=SEED, keep=keep)
    return effective(posterior, dbn.static_nodes, ORDERED[name]), posterior


FEW = bmc.Gibbs(draws=150, warmup=150)


OTHERS = [pytest.param(n, marks=pytest.mark.thorough) for n in CASES if n != "two states"]


@pytest.mark.parametrize("name", ["two states", *OTHERS])
def test_parameters_mix(name: str) -> None:
    """The least effective of the 4 x 150 draws were 185 at 24 trials of data and seeds; asked for are 60."""
    found, _ = learnt(name, 100, FEW)
    assert min(v.min() for v in found.values()) > SHARE * 600, found


def test_single_sites_mix_far_worse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks had 93 to 293 effective draws at six seeds, and single sites 8 to 30 % of that."""
    block = min(v.min() for v in learnt("noisy", 100, FEW)[0].values())
    monkeypatch.setattr(gibbs, "forest_blocks", lambda *_: [])
    alone = min(v.min() for v in learnt("noisy", 100, FEW)[0].values())
    assert block > SHARE * 600 and alone < 0.5 * block


@pytest.mark.thorough
@pytest.mark.parametrize("steps", [100, 1000])
@pytest.mark.parametrize("name", CASES)
def test_default_settings_are_enough(name: str, steps: int) -> None:
    """400 effective draws of every parameter within 20 s of processor time, planning included."""
    begin = time.process_time()
    found, posterior = learnt(name, steps, None)
    assert isinstance(posterior.engine, bmc.Gibbs)
    assert min(v.min() for v in found.values()) >= 400, found
    assert time.process_time() - begin < 20.0


@pytest.mark.parametrize("name", ["two states", "counts", "left to right"])
def test_states_are_those_of_the_exact_answer(name: str) -> None:
    """Everything known but the states; ``assert_matches`` has a false-alarm rate of 1e-4."""
    dbn, made = CASES[name]
    steps = 12
    rows = made(np.random.default_rng(SEED + 5), steps)
    statics = {
        "two states": {"row": [[0.9, 0.1], [0.3, 0.7]], "level": [-1.0, 1.0], "variance": 1.0},
        "counts": {"leave": [0.1, 0.3], "rate": [1.0, 4.0]},
        "left to right": {"leave": 0.2, "level": [0.0, 1.0, 2.0]},
    }[name]
    net = dbn.unroll(steps)
    evidence = {**dbn.unrolled_evidence({"y": rows}), **statics}
    exact = bmc.infer(net, evidence, engine=bmc.Exact())
    engine = bmc.Gibbs(draws=200, warmup=1, chains=10)
    found = bmc.infer(net, evidence, engine=engine, rng=SEED)
    names = [f"s[{t}]" for t in range(steps) if 0.01 < exact.probabilities(f"s[{t}]")[0] < 0.99]
    assert_matches(found, exact, names=names, alpha=1e-4, rng=SEED)
    assert min(found.ess(n) for n in names) > 1500  # all but independent


def test_explain_says_so() -> None:
    dbn, made = CASES["two states"]
    rows = made(np.random.default_rng(0), 20)
    text = str(bmc.explain(dbn, {"y": rows}, engine=bmc.Gibbs()))
    assert "filtering and sampling along 19 pairs of 20 nodes, 2 states" in text


def test_zeros_in_known_tables_are_no_reason_to_warn() -> None:
    """A chain that cannot go back is drawn whole, so that nothing holds it."""
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("level", bmc.Normal(0.0, 1.0))
    go = np.array([[0.8, 0.2, 0.0], [0.0, 0.8, 0.2], [0.0, 0.0, 1.0]])
    dbn.add(
        "s", lambda s_prev: bmc.Categorical(go[s_prev]), initial=bmc.Categorical([1.0, 0.0, 0.0])
    )
    dbn.add("y", lambda s, level: bmc.Normal(level * s, 0.5))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        rows = {"y": np.repeat([0.0, 1.0, 2.0], 8)}
        posterior = bmc.infer(dbn, rows, engine=bmc.Gibbs(draws=200, warmup=50), rng=SEED)
    assert abs(posterior.mean("level") - 1.0) < 0.2
    chosen = bmc.explain(dbn.unroll(24), dbn.unrolled_evidence(rows)).engine
    assert isinstance(chosen, bmc.Gibbs)
