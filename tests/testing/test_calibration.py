"""Holds simulation-based calibration to its level, and lets it find planted faults.

Seeds are fixed; each check of a right sampler has a false-alarm rate of 1e-3 over fresh seeds.
"""

from __future__ import annotations

import itertools
import warnings
from typing import Any

import numpy as np
import pytest
from scipy import stats

import bayesmc as bmc
from bayesmc.errors import (
    DensityError,
    ModelError,
    ShapeError,
    UnknownNodeError,
    UnsupportedError,
)
from bayesmc.testing.kernels.joint import JointModel
from bayesmc.testing.posteriors.bands import _chance_of, ecdf_band, ecdf_points, ecdf_uniformity
from bayesmc.testing.posteriors.calibration import _in_words, simulation_based_calibration
from bayesmc.testing.posteriors.shares import Draws, posterior_draws, share_below
from bayesmc.testing.verdict import BUDGET


def normal_net() -> bmc.BayesNet:
    """``x | y`` is Normal(y / 2, 1 / 2)."""
    net = bmc.BayesNet("normal")
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda x: bmc.Normal(x, 1.0))
    return net


def hybrid_net() -> bmc.BayesNet:
    net = bmc.BayesNet("hybrid", plates={"i": 2})
    net.add("k", bmc.Bernoulli(0.4), states=("no", "yes"))
    net.add("m", lambda k: bmc.Normal(1.5 * (k == "yes"), 1.0))
    net.add("twice", lambda m: 2 * m)
    net.add("y", lambda twice: bmc.Normal(twice, 1.0), plates="i")
    return net


# ---- the law of distribution functions ----------------------------------------------------------


@pytest.mark.parametrize("count", [2, 3, 4, 5])
def test_the_p_value_is_the_one_of_all_outcomes(count: int) -> None:
    """With ``count`` values there are as many equal cells: all ``count ** count`` outcomes."""
    found = {}
    for cells in itertools.product(range(count), repeat=count):
        values = (np.array(cells) + 0.5) / count
        p = ecdf_uniformity(values).p_value
        found[p] = found.get(p, 0.0) + count**-count
    total = 0.0
    for p in sorted(found):
        total += found[p]
        assert p == pytest.approx(total, abs=1e-12)


def test_the_band_is_where_the_test_begins_to_reject() -> None:
    rng = np.random.default_rng(0)
    low, high = ecdf_band(60, 0.2)
    points = ecdf_points(60)
    left = 0
    for _ in range(300):
        values = rng.beta(1.0, rng.choice([1.0, 1.3]), size=60)
        share = (values[:, None] <= points).mean(axis=0)
        outside = bool(((share < low) | (share > high)).any())
        assert outside == (ecdf_uniformity(values).p_value <= 0.2)
        left += outside
    assert 60 < left < 240


def test_the_level_of_the_test_of_uniformity() -> None:
    """At most 52 alarms of 3000 at level 0.01 but for a chance of 1e-3."""
    rng = np.random.default_rng(1)
    alarms = sum(ecdf_uniformity(rng.random(40)).p_value <= 0.01 for _ in range(3000))
    assert alarms <= stats.binom.ppf(0.999, 3000, 0.01)
    assert _chance_of(1000, 1e-10) > 1e-10  # at any of many points rather than at one
    caught = sum(ecdf_uniformity(rng.beta(2.5, 2.5, 200)).p_value < 1e-3 for _ in range(20))
    assert caught == 20


@pytest.mark.parametrize("values", [[0.5], [0.2, 1.2], [[0.1, 0.2]], [0.1, np.nan]])
def test_what_is_no_row_of_shares_is_refused(values: Any) -> None:
    with pytest.raises(ValueError, match="numbers between 0 and 1"):
        ecdf_uniformity(values)


# ---- ranks --------------------------------------------------------------------------------------


def weighted_shares(known: bool, draws: int, weighted: bool = True) -> np.ndarray:
    """Shares of the truth among few draws of the prior, weighted by a likelihood."""
    rng = np.random.default_rng(2)
    shares = []
    for _ in range(1200):
        truth, x = rng.normal(), rng.normal(size=draws)
        y = rng.normal(truth, 0.5)
        log_weights, own = -2.0 * (y - x) ** 2, -2.0 * (y - truth) ** 2
        found = Draws({"x": x}, (draws, 1), log_weights if weighted else None, known)
        values = (x * y)[:, None]
        shares.append(share_below(np.array([truth * y]), values, found, own, rng)[0][0])
    return np.array(shares)


def test_weighted_shares_are_uniform_where_the_weight_of_the_truth_is_known() -> None:
    """Exactly, with three draws; without it in the limit; never where weights are forgotten."""
    assert ecdf_uniformity(weighted_shares(True, 3)).p_value > 1e-3
    assert ecdf_uniformity(weighted_shares(False, 300)).p_value > 1e-3
    assert ecdf_uniformity(weighted_shares(True, 300, weighted=False)).p_value < 1e-6


def chain_shares(thinned: bool) -> np.ndarray:
    """Shares of the truth in stationary chains with a correlation of 0.97."""
    rng = np.random.default_rng(3)
    x = np.empty((300, 4, 50))
    x[..., 0] = rng.normal(size=(300, 4))
    for t in range(1, 50):
        x[..., t] = 0.97 * x[..., t - 1] + np.sqrt(1 - 0.97**2) * rng.normal(size=(300, 4))
    shares = []
    for chains in x:
        shape = (4, 50) if thinned else (200, 1)
        draws = Draws({"x": chains.ravel()}, shape)
        truth = rng.normal(size=1)
        shares.append(share_below(truth, chains.reshape(-1, 1), draws, 0.0, rng)[0][0])
    return np.array(shares)


def test_chains_are_thinned_until_their_draws_are_nearly_independent() -> None:
    assert ecdf_uniformity(chain_shares(True)).p_value > 1e-3
    assert ecdf_uniformity(chain_shares(False)).p_value < 1e-3


def test_members_of_an_ensemble_are_chains() -> None:
    engine = bmc.MetropolisHastings(draws=40, warmup=20, chains=2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        posterior = bmc.infer(normal_net(), {"y": 1.0}, engine=engine, rng=0)
    members = posterior.ensemble_size
    found = posterior_draws(posterior, posterior.model, ("x",), 1, 0)
    assert found.shape == (2 * members, 40 // members)
    own = posterior["x"][1, ::members][: 40 // members]
    np.testing.assert_array_equal(found.values["x"].reshape(found.shape)[members], own)


def test_equal_values_tie_although_rounding_tells_them_apart() -> None:
    rng = np.random.default_rng(0)
    draws = Draws({}, (5, 1))
    values = np.array([[0.3]] * 5)
    shares = [share_below(np.array([0.1 + 0.2]), values, draws, 0.0, rng)[0][0] for _ in range(400)]
    assert ecdf_uniformity(shares).p_value > 1e-3


# ---- right samplers -----------------------------------------------------------------------------

LOOKING = {"x": lambda y: bmc.StudentT(4.0, y / 2, 1.0)}


@pytest.mark.parametrize(
    ("engine", "replications"),
    [
        (None, 100),
        (bmc.LikelihoodWeighting(5), 100),
        (bmc.Importance(200, LOOKING), 100),
        (bmc.Rejection(30), 100),
        (bmc.Gibbs(draws=25, warmup=20, chains=4), 60),
    ],
    ids=repr,
)
def test_right_engines_pass(engine: Any, replications: int) -> None:
    found = simulation_based_calibration(engine, normal_net(), replications=replications, rng=4)
    assert found
    assert list(found.ranks) == ["node 'x'", "log density of the data", "joint log density"]
    assert all(
        r.shape == (replications,) and (0 < r).all() and (r < 1).all() for r in found.ranks.values()
    )


@pytest.mark.parametrize("engine", [None, bmc.LikelihoodWeighting(20)], ids=repr)
def test_nets_with_labels_plates_and_computed_nodes(engine: Any) -> None:
    statistics = {
        "sum": lambda y, m: y.sum(axis=-1) * m,
        "yes": lambda k, twice: (k == "yes") * twice,
    }
    net = hybrid_net()
    assert simulation_based_calibration(engine, net, replications=60, rng=5)
    named = simulation_based_calibration(
        engine, net, replications=60, statistics=statistics, observed="y", rng=5
    )
    assert named
    assert list(named.ranks) == ["sum", "yes"]


def test_a_net_with_nothing_observed_is_drawn_from_its_prior() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Exponential(2.0))
    assert simulation_based_calibration(bmc.LikelihoodWeighting(20), net, replications=50, rng=0)


def test_inputs_reach_net_and_engine() -> None:
    net = bmc.BayesNet()
    net.input("scale")
    net.add("x", lambda scale: bmc.Normal(0.0, scale))
    net.add("y", lambda x: bmc.Normal(x, 1.0))
    assert simulation_based_calibration(None, net, inputs={"scale": 3.0}, replications=40, rng=0)


def test_a_function_may_return_a_posterior() -> None:
    def sampler(evidence: dict, rng: np.random.Generator) -> Any:
        return bmc.infer(normal_net(), evidence, rng=rng)

    assert simulation_based_calibration(sampler, normal_net(), replications=30, rng=0)


def test_the_same_seed_gives_the_same_ranks() -> None:
    one, two = (
        simulation_based_calibration(None, normal_net(), replications=20, rng=7) for _ in range(2)
    )
    np.testing.assert_array_equal(one.ranks["node 'x'"], two.ranks["node 'x'"])


# ---- planted faults -----------------------------------------------------------------------------


def sampler(mean: float, sd: float, slope: float = 0.5) -> Any:
    return lambda evidence, rng: {"x": rng.normal(slope * evidence["y"] + mean, sd, size=40)}


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (sampler(0.0, 0.5), "too narrow"),  # the variance for the standard deviation
        (sampler(0.0, 1.5), "too wide"),
        (sampler(0.4, 0.5**0.5), "too high"),
        (
            sampler(3.0, 0.5**0.5),
            "node 'x': draws lie too high",
        ),  # one tail holds nearly all truths
        (sampler(-10.0, 0.5**0.5), "node 'x': draws lie too low"),
        (sampler(0.0, 1.0, 1.0), "too low"),  # the prior ignored
        (sampler(0.0, 1.0, 0.0), "too low"),  # the data ignored
    ],
    ids=["narrow", "wide", "shifted", "far up", "far down", "no prior", "no data"],
)
def test_wrong_samplers_are_caught(wrong: Any, words: str) -> None:
    found = simulation_based_calibration(wrong, normal_net(), replications=120, rng=0)
    assert not found
    assert words in repr(found)
    assert "standard errors" in repr(found)


def test_ranks_in_two_heaps_are_no_shift() -> None:
    words = _in_words(np.repeat([0.15, 0.85], 200), True)
    assert "lie too" not in words


def test_ranks_of_a_node_do_not_see_that_data_are_ignored() -> None:
    """Modrak et al. (2023): it takes a statistic that depends on the data."""
    blind = {"x": lambda x: x}
    wrong = sampler(0.0, 1.0, 0.0)
    assert simulation_based_calibration(wrong, normal_net(), statistics=blind, rng=0)
    seeing = {"x*y": lambda x, y: x * y}
    caught = simulation_based_calibration(wrong, normal_net(), statistics=seeing, rng=0)
    assert not caught
    assert "x*y: its values at the draws lie too low" in repr(caught)


class Forgetful(bmc.LikelihoodWeighting):
    """Weighting that returns its draws as if they were the posterior's."""

    def is_weighted(self, problem: Any) -> bool:
        return False


def test_an_engine_that_forgets_its_weights_is_caught() -> None:
    found = simulation_based_calibration(Forgetful(50), hybrid_net(), replications=60, rng=0)
    assert "log density of the data" in found.deviating


# ---- what it says -------------------------------------------------------------------------------


def test_it_says_how_many_runs_warned_and_how_many_rest_on_little() -> None:
    found = simulation_based_calibration(
        bmc.Importance(20, LOOKING), normal_net(), replications=20, rng=0
    )
    assert found.uncertain > 10
    assert "of 20 runs warned: LowEssWarning" in repr(found)
    assert "fewer than 50 effective draws" in repr(found)


def test_its_alpha_is_in_the_budget() -> None:
    before = BUDGET.spent.get("simulation_based_calibration", 0.0)
    simulation_based_calibration(sampler(0, 1), normal_net(), replications=20, alpha=0.25, rng=0)
    assert BUDGET.spent["simulation_based_calibration"] == pytest.approx(before + 0.25)


def test_a_picture_has_a_panel_for_each_statistic() -> None:
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("agg")
    from matplotlib import pyplot

    found = simulation_based_calibration(
        sampler(0.6, 0.5**0.5), normal_net(), replications=80, rng=0
    )
    axes = found.plot()
    assert [ax.get_title() for ax in axes] == list(found.ranks)
    colours = {ax.get_title(): ax.lines[-1].get_color() for ax in axes}
    deviants = {colours[name] for name in found.deviating}
    assert len(deviants) == 1
    assert deviants.isdisjoint(colours[n] for n in found.ranks if n not in found.deviating)
    drawn = axes[0].lines[-1].get_ydata()[1:-1]
    np.testing.assert_allclose(drawn, found.ecdf_difference["node 'x'"])
    assert axes[0].figure.get_suptitle() == "band: 99.9% for all 3 statistics together"
    pyplot.close("all")


@pytest.mark.parametrize(("count", "named"), [(3, "all"), (25, "those that deviate")])
def test_a_picture_in_one_axes_tells_statistics_apart(count: int, named: str) -> None:
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("agg")
    from matplotlib import pyplot

    powers = {f"s{k}": lambda x, y, k=k: x if k == 1 else y + 0.0 * x for k in range(count)}
    found = simulation_based_calibration(
        sampler(0.6, 0.5**0.5), normal_net(), statistics=powers, replications=80, alpha=0.05, rng=0
    )
    assert found.deviating == ("s1",)
    _, ax = pyplot.subplots()
    assert all(one is ax for one in found.plot(ax))
    lines = {line.get_label(): line for line in ax.lines if line.get_label() in found.ranks}
    assert set(lines) == set(found.ranks)
    assert len({(line.get_color(), line.get_linestyle()) for line in lines.values()}) == count
    thick = max(lines.values(), key=lambda line: line.get_linewidth())
    assert thick is lines["s1"]
    assert thick is ax.lines[-1]
    legend = ax.get_legend()
    expected = list(found.ranks) if named == "all" else ["s1"]
    assert [t.get_text() for t in legend.get_texts()] == expected
    for text, handle in zip(legend.get_texts(), legend.legend_handles, strict=True):
        assert handle.get_color() == lines[text.get_text()].get_color()
    assert ax.get_title() == f"band: 95% for all {count} statistics together"
    pyplot.close("all")


@pytest.mark.parametrize(
    ("returned", "error", "words"),
    [
        ([1.0], TypeError, "return a dict of node -> draws"),
        (
            {"z": np.zeros(3)},
            UnknownNodeError,
            r"no draws of 'x'; return all hidden nodes, \['x'\]",
        ),
        ({"x": 1.0}, ShapeError, "draws of 'x' have shape"),
        ({"x": np.zeros((2, 3))}, ShapeError, r"shape \(2, 3\); return \(draws,"),
    ],
)
def test_what_a_function_must_return(returned: Any, error: type, words: str) -> None:
    with pytest.raises(error, match=words) as caught:
        simulation_based_calibration(lambda evidence, rng: returned, normal_net(), rng=0)
    assert "in replication 0, with evidence {'y': " in caught.value.__notes__[0]


def test_wrong_arguments_are_named() -> None:
    net = normal_net()
    with pytest.raises(ValueError, match=r"replications=5\): give a whole number, at least 20"):
        simulation_based_calibration(None, net, replications=5)
    with pytest.raises(ValueError, match=r"alpha=1.5\): give a probability"):
        simulation_based_calibration(None, net, alpha=1.5)
    with pytest.raises(ValueError, match="no statistics"):
        simulation_based_calibration(None, net, statistics={})
    with pytest.raises(ModelError, match="leaves nothing hidden"):
        simulation_based_calibration(None, net, observed=["x", "y"])
    with pytest.raises(TypeError, match=r"Gibbs is a class; give an instance: Gibbs\(\)"):
        simulation_based_calibration(bmc.Gibbs, net)
    with pytest.raises(TypeError, match="is not an engine"):
        simulation_based_calibration("gibbs", net)
    with pytest.raises(DensityError, match="statistic 'root' is NaN"):
        with np.errstate(invalid="ignore"):
            simulation_based_calibration(
                None, net, statistics={"root": lambda x: np.sqrt(x)}, rng=0
            )


@pytest.mark.parametrize(
    ("statistics", "words"),
    [
        (["x"], "statistics is a list, not a dict; give a dict of name -> function of nodes"),
        (lambda x: x, "statistics is a function, not a dict; give a dict"),
        ({"a": "x"}, r"statistics\['a'\] is 'x', which is not a function; give a dict"),
        ({"a": 3}, r"statistics\['a'\] is 3, which is not a function; give a dict"),
        ({"a": np.zeros(2)}, r"statistics\['a'\] is array\(.*, which is not a function"),
        ({3: lambda x: x}, "the name 3 of a statistic is not a string"),
    ],
)
def test_statistics_that_are_no_dict_of_functions_are_refused(statistics: Any, words: str) -> None:
    with pytest.raises(TypeError, match=f"simulation_based_calibration: {words}"):
        simulation_based_calibration(None, normal_net(), statistics=statistics)


def test_what_is_no_net_is_refused_with_what_to_do() -> None:
    net = normal_net()
    dbn = bmc.DynamicBayesNet()
    joint = JointModel(lambda rng, n: rng.normal(size=n), lambda x, rng: x, {})
    call = "simulation_based_calibration"
    with pytest.raises(UnsupportedError, match=rf"{call}: .* {call}\(engine, dbn.unroll\(10\)\)"):
        simulation_based_calibration(bmc.ParticleFilter(10), dbn)
    with pytest.raises(
        UnsupportedError, match=rf"{call}: a JointModel .*rank_test\(kernel, model\)"
    ):
        simulation_based_calibration(bmc.Gibbs(), joint)  # type: ignore[arg-type]
    with pytest.raises(
        TypeError, match=rf"{call}: the engine comes first; write {call}\(engine, net\)"
    ):
        simulation_based_calibration(net, bmc.Gibbs())  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=f"{call}: net is a int; give a BayesNet"):
        simulation_based_calibration(None, 3)  # type: ignore[arg-type]


def test_the_net_of_a_template_is_calibrated_as_its_error_says() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 0.5), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    net = dbn.unroll(3)
    assert simulation_based_calibration(None, net, replications=20, rng=0)
