"""One seed, several kinds of work: independent numbers, fresh ones for every draw."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.randomness import Purpose, stream

#: correlations of 4000 independent pairs have a standard deviation of 0.0158; at 4.5 of them the
#: false-alarm rate is 7e-6 per pair at a fresh seed, and 2e-4 over the some 24 pairs here
N, LIMIT = 4000, 4.5 / np.sqrt(4000)


def chain() -> bmc.BayesNet:
    """Two continuous nodes, so that noise is recovered from the draws; one draw fits one chunk."""
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda x: bmc.Normal(x, 1.0))
    return net


def noise(draws: dict[str, np.ndarray] | bmc.Posterior, name: str) -> np.ndarray:
    x, y = np.ravel(draws["x"]), np.ravel(draws["y"])
    return x if name == "x" else y - x


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    return abs(float(np.corrcoef(a, b)[0, 1]))


def kinds(seed: int) -> dict[str, dict[str, np.ndarray]]:
    """The noise that each kind of work makes of one and the same seed."""
    net = chain()
    inferred = bmc.infer(net, engine=bmc.LikelihoodWeighting(N), rng=seed)
    sampled = net.sample(N, rng=seed)
    predicted = inferred.predict("y", rng=seed)
    moved = bmc.infer(net, {"y": 0.7}, engine=bmc.LikelihoodWeighting(N), rng=seed).resample(
        N, rng=seed
    )
    return {
        "infer": {n: noise(inferred, n) for n in "xy"},
        "sample": {n: noise(sampled, n) for n in "xy"},
        "predict": {"y": noise(predicted, "y")},
        "resample": {"x": np.ravel(moved["x"])},
    }


@pytest.mark.parametrize("seed", [0, 1])
def test_one_seed_gives_every_kind_of_work_its_own_numbers(seed: int) -> None:
    made = kinds(seed)
    parts = [(kind, n, values) for kind, of in made.items() for n, values in of.items()]
    for i, (kind, n, one) in enumerate(parts):
        for other, m, two in parts[:i]:
            assert correlation(one, two) < LIMIT, (kind, n, other, m)
    # negative control: the same kind twice is the same
    again = kinds(seed)
    assert correlation(made["infer"]["x"], again["infer"]["x"]) == pytest.approx(1.0)


def test_predictive_draws_have_the_predictive_variance() -> None:
    """y has variance 2; noise that repeats the draws' own gave 4. The estimate is within 0.16 of 2 but
    for 3e-4 (a standard deviation of 2 * sqrt(2 / 4000) = 0.045)."""
    p = bmc.infer(chain(), engine=bmc.LikelihoodWeighting(N), rng=1).predict("y", rng=1)
    assert p.var("y") == pytest.approx(2.0, abs=0.16)


def test_data_made_with_a_seed_is_not_the_first_draw_of_that_seed() -> None:
    net = bmc.BayesNet(plates={"p": 5})
    net.add("m", bmc.Normal(0.0, 1.0), plates="p")
    net.add("y", lambda m: bmc.Normal(m, 1.5), plates="p")
    truth = net.sample(1, rng=0)
    p = bmc.infer(net, {"y": truth["y"][0]}, engine=bmc.LikelihoodWeighting(20_000), rng=0)
    assert not np.isin(truth["m"][0], p["m"]).any()


def test_every_purpose_and_unit_has_its_own_stream() -> None:
    seed = np.random.SeedSequence(3)
    keys = [(p, u) for p in Purpose for u in range(4)]
    first = [int(stream(seed, p, u).integers(2**62)) for p, u in keys]
    assert len(set(first)) == len(keys)
    assert len({p.value for p in Purpose}) == len(Purpose)
    assert first == [int(stream(seed, p, u).integers(2**62)) for p, u in keys]


@pytest.mark.parametrize("sizes", [(300, 300, 300, 300), (40_000, 100, 17_000, 100)])
def test_resuming_never_repeats_a_draw(sizes: tuple[int, ...]) -> None:
    """Below, at and above a chunk of 16,384 draws; every number of a continuous node is new."""
    net = chain()
    p = None
    for size in sizes:
        p = bmc.infer(net, engine=bmc.LikelihoodWeighting(size), rng=1, resume=p)
    assert p is not None
    x = p["x"].ravel()
    assert len(np.unique(x)) == len(x) == sum(sizes)


@pytest.mark.parametrize(
    "make",
    [
        lambda p, seed: p.resample(50, rng=seed)["x"],
        lambda p, seed: p.predict("y", rng=seed)["y"],
    ],
    ids=["resample", "predict"],
)
def test_seeds_repeat_and_differ(make: Callable[[bmc.Posterior, int], np.ndarray]) -> None:
    p = bmc.infer(chain(), {"y": 1.0}, engine=bmc.LikelihoodWeighting(500), rng=0)
    np.testing.assert_array_equal(make(p, 1), make(p, 1))
    assert not np.array_equal(make(p, 1), make(p, 2))
