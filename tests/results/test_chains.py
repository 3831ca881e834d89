"""Posteriors of Markov chains: errors that see the chains, ensembles, sums in constant memory, pickles."""

from __future__ import annotations

import math
import pickle
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from arviz_stats.base import array_stats

import bayesmc as bmc
from bayesmc import diagnostics
from bayesmc.network import pose
from bayesmc.results import ChainsPosterior, ChainsSums, Checkpoint, RunningChains


@dataclass(frozen=True)
class Engine:
    draws: int = 1


def net_of() -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"p": 2})
    net.add("x", bmc.Normal(0.0, 1.0), plates="p")
    net.add("s", bmc.Categorical([0.2, 0.3, 0.5]), plates="p", states=("a", "b", "c"))
    net.add("n", bmc.DiscreteUniform(1, 3))
    net.add("angle", bmc.VonMises(3.0, 4.0))
    net.add("z", lambda x: bmc.Normal(x, 1.0), plates="p")
    return net


PROBLEM = pose(net_of(), {})


def autoregressive(rng: np.random.Generator, phi: float, shape: tuple[int, ...]) -> np.ndarray:
    """Stationary AR(1) along axis 1, of mean 0 and variance 1."""
    out = rng.normal(size=shape)
    for t in range(1, shape[1]):
        out[:, t] = phi * out[:, t - 1] + math.sqrt(1 - phi**2) * out[:, t]
    return out


def draws_of(chains: int, draws: int, phi: float = 0.7, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    normal = autoregressive(rng, phi, (chains, draws, 8))
    return {
        "x": 1e6 + 3 * normal[..., :2],
        "s": np.digitize(normal[..., 2:4], [-0.84, 0.0]).astype(np.uint8),
        "n": np.digitize(normal[..., 4], [-0.4, 0.4]).astype(np.uint8),
        "angle": np.remainder(3.0 + 0.5 * normal[..., 5], 2 * np.pi),  # cuts the circle
        "z": normal[..., 6:8],
    }


def sums_of(stored: dict[str, np.ndarray], ensemble: int = 1) -> ChainsSums:
    chains, draws = stored["x"].shape[:2]
    running = RunningChains(PROBLEM.model, tuple(PROBLEM.model.nodes), chains, ensemble)
    for draw in range(draws):
        running.add({name: values[:, draw] for name, values in stored.items()})
    last = {name: values[:, -1] for name, values in stored.items()}
    return ChainsSums(PROBLEM, Engine(), running, {}, 5, Checkpoint({}, {}, last, {}))


def posterior_of(stored: dict[str, np.ndarray], ensemble: int = 1) -> ChainsPosterior:
    shape = stored["x"].shape[:2]
    return ChainsPosterior(PROBLEM, Engine(), stored, shape, {"x": np.ones(4)}, ensemble, 5)


# ---- figures -------------------------------------------------------------------------------------


def test_figures_are_arvizs() -> None:
    posterior = posterior_of(draws_of(4, 501))
    x, last = posterior["x"], (posterior["s"] == "c").astype(float)
    for kind in ("ess", "rhat", "mcse"):
        figure, statistic = getattr(posterior, kind), getattr(array_stats, kind)
        for k in range(2):
            reference = statistic(x[..., k], chain_axis=0, draw_axis=1)
            np.testing.assert_allclose(figure("x")[k], reference, rtol=1e-9)
            reference = statistic(last[..., k], chain_axis=0, draw_axis=1)
            if kind == "mcse":  # of a share, to which is added what was not seen
                count = (last[..., k].std(ddof=1) / reference) ** 2
                reference = np.hypot(reference, 2 / min(count, last[..., k].size))
            np.testing.assert_allclose(figure("s")[k, 2], reference, rtol=1e-9)
    tail = diagnostics.chain_statistic("tail_ess", x)
    reference = array_stats.ess(x[..., 1], chain_axis=0, draw_axis=1, method="tail", prob=0.05)
    np.testing.assert_allclose(tail[1], reference, rtol=1e-9)


ARVIZ: dict[str, tuple[str, dict[str, Any]]] = {
    "ess": ("ess", {}),
    "tail_ess": ("ess", {"method": "tail", "prob": 0.05}),
    "mean_ess": ("ess", {"method": "mean"}),
    "rhat": ("rhat", {}),
    "mcse": ("mcse", {}),
}


@pytest.mark.parametrize("kind", ARVIZ)
@pytest.mark.parametrize("draws", [4, 7, 60])
def test_short_chains_and_ties_too(draws: int, kind: str) -> None:
    smooth = autoregressive(np.random.default_rng(draws), 0.8, (3, draws, 4))
    method, options = ARVIZ[kind]
    for values in (smooth, np.floor(smooth)):
        with np.errstate(all="ignore"):
            statistic = getattr(array_stats, method)
            reference = statistic(values, chain_axis=0, draw_axis=1, **options)
        if kind == "rhat":  # of chains that stand still: ArviZ divides by a rounding error
            reference[reference > 1e8] = np.inf
        got = diagnostics.chain_statistic(kind, values)
        np.testing.assert_allclose(got, reference, rtol=1e-9)


def test_one_chain_is_compared_with_itself() -> None:
    rng = np.random.default_rng(0)
    steady = rng.normal(size=(1, 2001))
    drifting = steady + np.linspace(0, 3, 2001)
    assert diagnostics.chain_statistic("rhat", steady) < 1.01
    assert diagnostics.chain_statistic("rhat", drifting) > 1.3
    halves = np.concatenate([drifting[:, :1000], drifting[:, -1000:]])
    expected = array_stats.rhat(halves, chain_axis=0, draw_axis=1)
    assert diagnostics.chain_statistic("rhat", drifting) == pytest.approx(float(expected))
    assert np.isnan(diagnostics.chain_statistic("rhat", steady[:, :7]))  # halves of three draws


def test_chains_that_stand_still() -> None:
    apart = np.repeat(np.array([[1.0], [2.0], [2.0], [0.1]]), 100, axis=1)
    assert diagnostics.chain_statistic("rhat", apart) == np.inf
    assert diagnostics.chain_statistic("rhat", apart[[0, 3]], 5) == np.inf
    long = np.repeat(apart, 1000, axis=1)
    long[0, 7] = 1.1  # one move of one chain: large, and a number
    assert 10 < diagnostics.chain_statistic("rhat", long) < np.inf
    still = np.full((4, 100), 0.1)
    for block in (1, 5):
        assert np.isnan(diagnostics.chain_statistic("rhat", still, block))
        assert diagnostics.chain_statistic("mcse", still, block) == 0.0
        for kind in ("ess", "mean_ess", "tail_ess"):
            assert diagnostics.chain_statistic(kind, still, block) == 400.0
    still[2, 3] = np.nan
    for kind in ARVIZ:
        assert np.isnan(diagnostics.chain_statistic(kind, still))


@pytest.mark.parametrize("block", [1, 5])
def test_the_unit_does_not_matter(block: int) -> None:
    """Values as close as 1e-15 are no constants; by a power of 2 the figures are the same to the bit."""
    x, unit = draws_of(4, 500)["z"], 2.0**-70
    for kind in ARVIZ:
        got = diagnostics.chain_statistic(kind, unit * x, block)
        expected = diagnostics.chain_statistic(kind, x, block) * (unit if kind == "mcse" else 1.0)
        np.testing.assert_array_equal(got, expected)


# ---- ensembles -----------------------------------------------------------------------------------


def ensemble_draws(
    phi: float, members: int, visits: int, chains: int, n: int, seed: int = 5
) -> np.ndarray:
    """Draws of independent AR(1) members taken in turn, each moving once per draw; ``(chain, draw, n)``."""
    rng = np.random.default_rng(seed)
    per_visit = phi**members
    every = autoregressive(rng, per_visit, (chains * members, visits, n))
    parted = every.reshape(chains, members, visits, n)
    return parted.transpose(0, 2, 1, 3).reshape(chains, visits * members, n)


def test_errors_of_ensembles_are_the_errors_seen() -> None:
    """The errors of 400 means against the known one; the naive formula is the negative control.

    The spread of 400 means has a standard error of 3.5 %, so 12 % is exceeded in under 1 of 1000 seeds;
    the errors scatter less, but overstate by some per cent in chains as short.
    """
    members, visits, chains, n = 6, 400, 2, 400
    x = ensemble_draws(0.97, members, visits, chains, n)
    phi = 0.97**members
    lags = np.arange(1, visits)
    factor = 1 + 2 * ((1 - lags / visits) * phi**lags).sum()
    truth = math.sqrt(factor / (members * visits * chains))
    assert x.mean(axis=(0, 1)).std() == pytest.approx(truth, rel=0.12)
    error = diagnostics.chain_statistic("mcse", x, members)
    assert np.sqrt((error**2).mean()) == pytest.approx(truth, rel=0.12)
    ess = diagnostics.chain_statistic("mean_ess", x, members)
    assert ess.mean() == pytest.approx(1 / truth**2, rel=0.2)
    naive = diagnostics.chain_statistic("mcse", x)
    assert np.sqrt((naive**2).mean()) < 0.75 * truth


def test_effective_sizes_of_ensembles_are_at_most_the_draws() -> None:
    x = np.random.default_rng(0).normal(size=(2, 400, 50))
    x[:, 1::2] = 0.1 * x[:, 1::2] - x[:, ::2]  # members that mirror each other
    for kind in ("ess", "mean_ess", "tail_ess"):
        assert (diagnostics.chain_statistic(kind, x, 2) <= 800).all()
    assert (diagnostics.chain_statistic("mean_ess", x) > 900).all()  # negative control


def test_rhat_of_ensembles() -> None:
    x = ensemble_draws(0.5, 5, 400, 4, 20)
    assert (diagnostics.chain_statistic("rhat", x, 5) < 1.02).all()
    # members that stay apart do not make the ensembles differ, and a stray ensemble does
    member = x + np.tile(np.arange(5.0), 400)[:, None]
    assert (diagnostics.chain_statistic("rhat", member, 5) < 1.02).all()
    stray = x + np.array([0.0, 0.0, 0.0, 1.5])[:, None, None]
    assert (diagnostics.chain_statistic("rhat", stray, 5) > 1.05).all()


def test_partial_blocks_do_not_count() -> None:
    x = ensemble_draws(0.5, 5, 40, 4, 3)
    more = np.concatenate([x, np.full((4, 4, 3), 9.0)], axis=1)
    for kind in ("ess", "rhat", "mean_ess"):
        got = diagnostics.chain_statistic(kind, more, 5)
        np.testing.assert_array_equal(got, diagnostics.chain_statistic(kind, x, 5))
    assert np.isnan(diagnostics.chain_statistic("ess", x[:, :19], 5)).all()  # three blocks


def test_the_posterior_tells_of_its_ensembles() -> None:
    stored = draws_of(4, 300)
    plain, grouped = posterior_of(stored), posterior_of(stored, 5)
    for kind in ("ess", "rhat", "mcse"):
        expected = diagnostics.chain_statistic(kind, grouped["x"], 5)
        np.testing.assert_array_equal(getattr(grouped, kind)("x"), expected)
        if kind != "rhat":  # which compares ensembles as it compares chains
            assert (getattr(plain, kind)("x") != expected).any()
    function = grouped.mcse(lambda x: x[..., 0])
    np.testing.assert_array_equal(function, grouped.mcse("x")[0])
    predicted = grouped.predict("z", rng=0)
    assert isinstance(predicted, ChainsPosterior) and predicted.ensemble_size == 5
    expected = diagnostics.chain_statistic("mcse", predicted["z"], 5)
    np.testing.assert_array_equal(predicted.mcse("z"), expected)


# ---- summaries -----------------------------------------------------------------------------------


@pytest.mark.parametrize("draws", [1, 31, 500, 3000])
def test_sums_are_those_of_the_draws(draws: int) -> None:
    stored = draws_of(3, draws)
    sums, whole = sums_of(stored), posterior_of(stored)
    for name in ("x", "n", "angle", "z"):
        np.testing.assert_allclose(sums.mean(name), whole.mean(name), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(sums.var(name), whole.var(name), rtol=1e-7)
    np.testing.assert_allclose(sums.probabilities("s"), whole.probabilities("s"))
    assert sums._title() == f"Engine: 3 chains of {draws} draws after 5 of warmup"


@pytest.mark.parametrize("phi", [0.0, 0.9])
def test_errors_of_sums_are_those_of_the_draws(phi: float) -> None:
    """Batch means (4 chains of 23 batches) know an error to about 8 %; 35 % never by chance."""
    stored = draws_of(4, 3000, phi)
    sums, whole = sums_of(stored), posterior_of(stored)
    for name in ("x", "s", "n", "angle", "z"):
        np.testing.assert_allclose(sums.mcse(name), whole.mcse(name), rtol=0.35)
        assert sums.ess(name).shape == whole.ess(name).shape
        assert (sums.ess(name) <= 12000 + 1e-6).all()
        assert (sums.rhat(name) < 1.03).all() and (sums.rhat(name) >= 0.999).all()


def test_sums_see_chains_that_disagree() -> None:
    stored = draws_of(4, 1000)
    stored["x"][2] += 3.0
    stored["n"][2] = np.maximum(stored["n"][2], 1)
    stored["s"][2, ..., 0] = 2
    sums, whole = sums_of(stored), posterior_of(stored)
    assert (sums.rhat("x") > 1.05).all() and sums.rhat("n") > 1.02 and sums.rhat("s")[0, 2] > 1.05
    assert (sums.rhat("z") < 1.03).all() and (sums.rhat("s")[1] < 1.03).all()
    np.testing.assert_allclose(sums.rhat("x"), whole.rhat("x"), rtol=0.1)


def test_stuck_sums() -> None:
    stored = draws_of(4, 1000)
    stored["n"][:] = np.array([0, 1, 2, 1], dtype=np.uint8)[:, None]
    stored["x"][:] = 0.1 + np.arange(4.0)[:, None, None]
    stored["z"][:] = 5.0
    sums = sums_of(stored)
    assert sums.rhat("n") == np.inf and (sums.rhat("x") == np.inf).all()
    assert np.isnan(sums.rhat("z")).all() and (sums.mcse("z") == 0).all()
    assert (sums.ess("z") == 4000).all()


def test_few_draws_have_no_errors_in_sums() -> None:
    sums = sums_of(draws_of(4, 127))  # three batches of 32
    assert np.isnan(sums.mcse("x")).all() and np.isnan(sums.rhat("s")).all()
    assert np.isfinite(sums_of(draws_of(4, 128)).mcse("x")).all()


def test_sums_of_ensembles_take_whole_blocks() -> None:
    """With batches of a length that no block divides the members' differences would pass for noise."""
    rng = np.random.default_rng(0)
    stored = draws_of(4, 3000, 0.0)
    stored["x"] = rng.normal(size=(4, 3000, 2)) + 50 * np.tile(np.arange(12.0), 250)[:, None]
    errors = sums_of(stored, 12).mcse("x")
    independent = stored["x"].std(axis=(0, 1)) / math.sqrt(12000)
    np.testing.assert_allclose(errors, independent, rtol=1e-6)  # never below, and not above
    assert (sums_of(stored, 1).rhat("x") < 1.03).all()
    batches = sums_of(stored, 12)._running.batch_means("x")
    assert batches is not None and batches.std(axis=(0, 1)).max() < 1.0
    uneven = sums_of(stored, 1)._running.batch_means("x")
    assert uneven is not None and uneven.std(axis=(0, 1)).min() > 1.0  # negative control


def test_memory_of_sums_does_not_grow() -> None:
    def size(draws: int) -> int:
        return len(pickle.dumps(sums_of(draws_of(4, draws, 0.0))))

    assert size(4096) < 1.05 * size(1024 + 992)


def test_what_sums_cannot_answer_names_a_remedy() -> None:
    sums = sums_of(draws_of(4, 200))
    with pytest.raises(bmc.errors.UnsupportedError, match='keep="draws"'):
        sums.quantile("x", 0.5)


# ---- pickles and ArviZ ---------------------------------------------------------------------------


def test_pickles() -> None:
    stored = draws_of(4, 200)
    point = Checkpoint({"a": np.ones(3)}, {}, {n: v[:, -1] for n, v in stored.items()}, {})
    whole = ChainsPosterior(PROBLEM, Engine(), stored, (4, 200), {"x": np.ones(4)}, 5, 7, point)
    for before in (whole, sums_of(stored)):
        before.checkpoint = point
        after = pickle.loads(pickle.dumps(before))
        assert type(after) is type(before) and str(after.summary()) == str(before.summary())
        assert after.problem is None and after.acceptance.keys() == before.acceptance.keys()
        assert after.ensemble_size == before.ensemble_size and after.warmup == before.warmup
        again = pickle.loads(pickle.dumps(after))
        assert again.checkpoint.densities == after.checkpoint.densities
        assert after.checkpoint.fits(after.model, pose(net_of(), {}))
        assert not after.checkpoint.fits(after.model, pose(net_of(), {"n": 2}))


def test_the_wrong_functions_do_not_fit() -> None:
    stored = draws_of(2, 10)
    posterior = posterior_of(stored)
    posterior.checkpoint = Checkpoint({}, {}, {n: v[:, -1] for n, v in stored.items()}, {})
    loaded = pickle.loads(pickle.dumps(posterior))
    changes: list[dict[str, Any]] = [
        {"name": "z", "cpd": lambda x: bmc.Normal(x, 1.001), "plates": "p"},
        {"name": "z", "cpd": lambda x: bmc.Normal(x + 1e-3, 1.0), "plates": "p"},
        {"name": "n", "cpd": bmc.DiscreteUniform(0, 2)},
        {"name": "x", "cpd": bmc.StudentT(5.0, 0.0, 1.0), "plates": "p"},
    ]
    for change in changes:
        other = bmc.BayesNet(plates={"p": 2})
        for name in ("x", "s", "n", "angle", "z"):
            arguments = dict(ORIGINAL[name], name=name)
            other.add(**(change if change["name"] == name else arguments))
        assert not loaded.checkpoint.fits(loaded.model, pose(other, {})), change


ORIGINAL: dict[str, dict[str, Any]] = {
    "x": {"cpd": bmc.Normal(0.0, 1.0), "plates": "p"},
    "s": {"cpd": bmc.Categorical([0.2, 0.3, 0.5]), "plates": "p", "states": ("a", "b", "c")},
    "n": {"cpd": bmc.DiscreteUniform(1, 3)},
    "angle": {"cpd": bmc.VonMises(3.0, 4.0)},
    "z": {"cpd": lambda x: bmc.Normal(x, 1.0), "plates": "p"},
}


def test_to_datatree() -> None:
    pytest.importorskip("arviz_base")
    tree = posterior_of(draws_of(4, 50)).to_datatree()
    assert tree["posterior"]["x"].dims == ("chain", "draw", "p")
    assert tree["posterior"]["x"].shape == (4, 50, 2)
    assert "sample_stats" not in tree.children


def test_to_datatree_shows_which_trajectories_diverged() -> None:
    pytest.importorskip("arviz_base")
    diverged = np.zeros((4, 50), dtype=bool)
    diverged[2, 7] = True
    posterior = posterior_of(draws_of(4, 50))
    posterior.divergences = diverged
    found = posterior.to_datatree()["sample_stats"]["diverging"]
    assert found.dims == ("chain", "draw")
    assert (found.values == diverged).all()
