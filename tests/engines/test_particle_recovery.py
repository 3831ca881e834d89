"""Particles that begin anew in every slice, and numbers of particles that follow the belief."""

from __future__ import annotations

import functools
import pickle
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.dbn import Row
from bayesmc.engines.particles import recovery as recovering
from bayesmc.engines.particles import rejuvenation
from bayesmc.network import Observed
from bayesmc.testing import session

ROWS = {"y": np.r_[np.full(3, 2.0), np.full(4, 8.0)]}
ANYWHERE = bmc.Uniform(0.0, 10.0)
SHARE = 0.1

# few particles, so that many runs are cheap
pytestmark = pytest.mark.filterwarnings("ignore::bayesmc.errors.LowEssWarning")


def walk() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.3), initial=ANYWHERE)
    dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    return dbn


def jumping() -> bmc.DynamicBayesNet:
    """The same with the jump declared: what recovery with a constant share comes to."""
    dbn = bmc.DynamicBayesNet()
    weights = [1 - SHARE, SHARE]

    @dbn.node(initial=ANYWHERE)
    def x(x_prev):
        return bmc.Mixture(weights, [bmc.Normal(x_prev, 0.3), ANYWHERE])

    dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    return dbn


GRID = bmc.GridFilter({"x": (-3.0, 13.0, 1600)})


@functools.cache
def exact() -> Any:
    """Of the declared jump, by a grid."""
    return bmc.filter(jumping(), ROWS, engine=GRID)


@functools.cache
def short_log_evidence() -> float:
    return float(bmc.filter(jumping(), SHORT, engine=GRID).log_marginal_likelihood)


def ratios(recovery: bmc.Recovery) -> np.ndarray:
    engine = bmc.ParticleFilter(300, recovery=recovery)
    logs = [
        bmc.filter(walk(), ROWS, engine=engine, rng=seed).log_marginal_likelihood
        for seed in range(session.scaled(150))
    ]
    return np.exp(np.array(logs) - exact().log_marginal_likelihood)


def deviation(found: np.ndarray) -> float:
    return abs(found.mean() - 1.0) / (found.std(ddof=1) / np.sqrt(len(found)))


AIMED: dict[str, Any] = {"x": lambda y: bmc.Truncated(bmc.Normal(y, 0.8), 0.0, 10.0)}


@pytest.mark.parametrize("draws", [0.0, 0.3])
@pytest.mark.parametrize("proposal", [None, AIMED], ids=["from the density", "aimed"])
def test_the_evidence_is_that_of_the_declared_jump(proposal: Any, draws: float) -> None:
    # mean of Z-hat / Z is 1 within 4 standard errors (alpha 1e-4 each)
    found = ratios(bmc.Recovery({"x": ANYWHERE}, share=SHARE, draws=draws, proposal=proposal))
    assert deviation(found) < 4


SHORT = {"y": np.array([2.0, 2.0, 8.0, 8.0])}


def short_ratios(draws: float, runs: int = 200, **options: Any) -> np.ndarray:
    begin = bmc.Recovery({"x": ANYWHERE}, share=SHARE, draws=draws)
    engine = bmc.ParticleFilter(300, recovery=begin, **options)
    logs = [
        bmc.filter(walk(), SHORT, engine=engine, rng=seed).log_marginal_likelihood
        for seed in range(runs)
    ]
    return np.exp(np.array(logs) - short_log_evidence())


def of_their_ancestors(selection: Any, lost: np.ndarray) -> np.ndarray:
    """The weights that particles would have, had they not begun anew."""
    return np.broadcast_to(selection.log_weights, (selection.particles,))


@pytest.mark.parametrize("draws", [0.0, 0.3])
@pytest.mark.parametrize("auxiliary", [False, True])
@pytest.mark.parametrize("threshold", [0.0, 0.5, 1.0])
def test_the_evidence_however_particles_are_chosen(
    threshold: float, auxiliary: bool, draws: float
) -> None:
    # alpha 1.2e-4 each
    found = short_ratios(draws, session.scaled(100), ess_threshold=threshold, auxiliary=auxiliary)
    assert deviation(found) < 4
    assert np.log(found).std() < 1.2


@pytest.mark.parametrize("threshold", [0.0, 0.5])
def test_lost_particles_have_no_weight_of_an_ancestor(
    threshold: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    # where they are chosen by what the row makes of their ancestors, those far off are never chosen;
    # where they are not resampled, few have a weight, and the lost rarely one of these
    monkeypatch.setattr(rejuvenation, "start_weights", of_their_ancestors)
    found = short_ratios(0.3, ess_threshold=threshold, auxiliary=threshold > 0)
    assert np.log(found).std() > 2
    assert threshold == 0.0 or deviation(found) > 8


def odometer(jumps: bool) -> bmc.DynamicBayesNet:
    """A second reading looks at the slice before: how far it came."""
    dbn = jumping() if jumps else walk()
    first = lambda x: bmc.Normal(0.0 * x, 1.0)  # noqa: E731
    dbn.add("came", lambda x, x_prev: bmc.Normal(x - x_prev, 1.0), initial=first)
    return dbn


@pytest.mark.parametrize("fault", [False, True])
@pytest.mark.parametrize("threshold", [0.0, 0.5])
def test_readings_of_two_slices(
    threshold: float, fault: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if fault:  # ancestors by number, as if they all had the same weight
        monkeypatch.setattr(
            rejuvenation.Injection, "_ancestors", lambda self, _, chosen, lost, rng: lost
        )
    rows = {**SHORT, "came": np.array([0.0, 0.1, 5.5, 0.2])}
    grid = bmc.GridFilter({"x": (-3.0, 13.0, 800)})
    wanted = bmc.filter(odometer(True), rows, engine=grid).log_marginal_likelihood
    begin = bmc.Recovery({"x": ANYWHERE}, share=SHARE, draws=0.3)
    engine = bmc.ParticleFilter(300, recovery=begin, ess_threshold=threshold)
    logs = [
        bmc.filter(odometer(False), rows, engine=engine, rng=seed).log_marginal_likelihood
        for seed in range(200 if fault else session.scaled(100))
    ]
    found = deviation(np.exp(np.array(logs) - wanted))
    assert found > 6 if fault else found < 4  # alpha 1.2e-4


def test_a_state_that_is_seen_may_have_jumped() -> None:
    begin = bmc.Recovery({"x": ANYWHERE}, share=SHARE, draws=0.5)
    engine = bmc.ParticleFilter(20_000, recovery=begin)
    found = bmc.filter(walk(), {"x": [2.0, 8.0]}, engine=engine, rng=0)
    # half of the particles weigh share * 0.1 / 0.5: standard error 1 / sqrt(n) = 0.7 %
    assert found.log_marginal_increments[1] == pytest.approx(np.log(SHARE * 0.1), abs=0.04)


def test_draws_beyond_the_share_are_weighed_down(monkeypatch: pytest.MonkeyPatch) -> None:
    recovery = bmc.Recovery({"x": ANYWHERE}, share=1e-3, draws=0.2, proposal=AIMED)
    found = bmc.filter(walk(), ROWS, engine=bmc.ParticleFilter(5000, recovery=recovery), rng=0)
    assert (abs(found.anew[1:] - 1000) < 6 * np.sqrt(1000)).all()
    monkeypatch.setattr(bmc.Recovery, "share_of", lambda self, averages: self.draws)
    assert deviation(ratios(bmc.Recovery({"x": ANYWHERE}, share=SHARE, draws=0.4))) > 8


def test_a_proposal_that_is_not_weighed_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rejuvenation._Density, "__call__", lambda self, state: None)
    assert deviation(ratios(bmc.Recovery({"x": ANYWHERE}, share=SHARE, proposal=AIMED))) > 8


def test_answers_find_back_after_a_jump() -> None:
    recovery = bmc.Recovery({"x": ANYWHERE}, share=SHARE, proposal=AIMED)
    engine = bmc.ParticleFilter(20_000, recovery=recovery)
    found = bmc.filter(walk(), ROWS, engine=engine, rng=0)
    # standard errors below .01; fourteen figures, alpha 1e-6
    np.testing.assert_allclose(found.mean("x"), exact().mean("x"), atol=0.08)
    np.testing.assert_allclose(found.std("x"), exact().std("x"), atol=0.08)
    assert found.anew[0] == 0 and (abs(found.anew[1:] - 2000) < 6 * np.sqrt(2000)).all()
    without = bmc.filter(walk(), ROWS, engine=bmc.ParticleFilter(20_000), rng=0)
    assert abs(without.mean("x")[3] - exact().mean("x")[3]) > 1  # the control


def test_the_share_follows_how_well_rows_are_explained() -> None:
    recovery = bmc.Recovery({"x": ANYWHERE}, slow=0.01, fast=0.9, proposal=AIMED)
    engine = bmc.ParticleFilter(5000, recovery=recovery)
    rows = {"y": np.r_[np.full(10, 2.0), np.full(6, 8.0)]}
    found = bmc.filter(walk(), rows, engine=engine, rng=0)
    assert found.anew[:10].mean() < 500 and found.anew[11] > 2000
    assert abs(found.mean("x")[-1] - 8.0) < 0.5
    # row by row it is the same
    belief = engine.start(walk(), rng=0)
    for row in rows["y"]:
        belief = engine.step(belief, {"y": row})
    assert belief.mean("x") == found.mean("x")[-1]


def in_view() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet(plates={"k": 3})
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.1), initial=ANYWHERE)
    dbn.add("y", lambda x: bmc.Normal(x, 0.05), plates="k")
    return dbn


def views(*rows: tuple[int, float]) -> dict[str, np.ndarray]:
    """Rows that see so many of three readings, which read so much."""
    return {"y": np.array([[at if k < seen else np.nan for k in range(3)] for seen, at in rows])}


@pytest.mark.parametrize("one_for_all", [False, True])
def test_readings_out_of_view_are_no_surprise(
    one_for_all: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if one_for_all:  # the control: averages over rows of different content
        monkeypatch.setattr(recovering, "_what_is_seen", lambda row: ())
    begin = bmc.Recovery({"x": ANYWHERE}, slow=0.01, fast=0.9)
    engine = bmc.ParticleFilter(3000, recovery=begin)
    rows = [(3, 4.0)] * 8 + [(1, 4.0)] * 4 + [(3, 4.0)] * 4
    found = bmc.filter(in_view(), views(*rows), engine=engine, rng=0)
    assert (found.anew[9:].max() > 1000) == one_for_all


def test_what_comes_in_turns_has_averages_of_its_own() -> None:
    begin = bmc.Recovery({"x": ANYWHERE}, slow=0.2, fast=0.9)
    engine = bmc.ParticleFilter(3000, recovery=begin)
    rows = [(3, 4.0), (1, 4.0)] * 5 + [(3, 4.6), (1, 4.6)]
    found = bmc.filter(in_view(), views(*rows), engine=engine, rng=0)
    assert found.anew[4:11].max() < 600 and found.anew[11] > 2000


def test_averages_of_an_endless_series_stay_small() -> None:
    begin, averages = bmc.Recovery({"x": ANYWHERE}, slow=0.1, fast=0.5), None
    for k in range(200):
        mask = np.array([k >> i & 1 for i in range(8)], dtype=bool)
        row = Row(k, {"y": Observed(np.zeros(8), mask)}, {})
        averages = begin.averaged(averages, row, -1.0)
    assert averages is not None and len(averages.logs) == 64 and averages.last in averages.logs


def test_a_belief_that_narrows_needs_fewer_particles() -> None:
    engine = bmc.ParticleFilter(20_000, adapt=bmc.KLD({"x": 0.05}, least=200))
    found = bmc.filter(walk(), ROWS, engine=engine, rng=0, keep="particles")
    plain = bmc.filter(walk(), ROWS, engine=bmc.ParticleFilter(20_000), rng=0)
    assert found.counts[0] == 20_000 and (found.counts[1:3] < 2000).all()
    assert (found.counts >= 200).all()
    # some 600 particles: standard error .02; three figures, alpha 1e-4
    np.testing.assert_allclose(found.mean("x")[:3], plain.mean("x")[:3], atol=0.1)
    assert found.quantile("x", 0.5).shape == (7,)
    with pytest.raises(bmc.errors.QueryError, match="changes from slice to slice"):
        found.particles("x")


def test_the_evidence_of_an_adapted_number_is_unbiased() -> None:
    plain = bmc.filter(walk(), ROWS, engine=GRID)
    engine = bmc.ParticleFilter(2000, adapt=bmc.KLD({"x": 0.2}, least=400, error=0.02))
    rows = {"y": ROWS["y"][:3]}
    exact_log = plain.log_marginal_increments[:3].sum()
    logs = [
        bmc.filter(walk(), rows, engine=engine, rng=seed).log_marginal_likelihood
        for seed in range(session.scaled(200))
    ]
    # numbers that look at the particles are biased in theory, at the order of 1/N (alpha 6e-5)
    assert deviation(np.exp(np.array(logs) - exact_log)) < 4


@pytest.mark.parametrize("bins", [2, 10, 1000])
def test_the_bound_is_the_quantile_of_chi_square(bins: int) -> None:
    from scipy import stats

    exact = stats.chi2.ppf(0.99, bins - 1) / (2 * 0.05)  # Fox (2003), eq. 6
    assert bmc.KLD({"x": 1.0}, least=1).needed(bins) == pytest.approx(exact, rel=0.01, abs=2)


def test_bins_of_vectors_are_counted() -> None:
    values = {"v": np.array([[0.1, 0.1], [0.2, 0.3], [0.9, 0.1], [0.1, -0.1]])}
    assert bmc.KLD({"v": 0.5}).bins(values) == 3
    assert bmc.KLD({"v": [0.5, 5.0]}).bins(values) == 3
    assert bmc.KLD({"v": [5.0, 5.0]}).bins(values) == 2
    far = {"v": np.array([[0.0, 0.0], [1e17, 1e17], [1e17, 0.0]])}
    assert bmc.KLD({"v": 1.0}).bins(far) == 3


def test_options_travel_without_functions() -> None:
    recovery = bmc.Recovery({"x": ANYWHERE}, share=SHARE, proposal=AIMED)
    engine = bmc.ParticleFilter(100, recovery=recovery)
    found = bmc.filter(walk(), ROWS, engine=engine, rng=0)
    again = pickle.loads(pickle.dumps(found))
    np.testing.assert_array_equal(again.anew, found.anew)
    with pytest.raises(bmc.errors.UnsupportedError, match="hold no functions"):
        bmc.filter(walk(), ROWS, engine=again.engine)
    adapted = bmc.ParticleFilter(100, adapt=bmc.KLD({"x": 0.5}))
    assert pickle.loads(pickle.dumps(adapted)).adapt.widths == {"x": 0.5}


def test_widths_compare_and_hash() -> None:
    widths = bmc.KLD({"x": 0.5, "v": np.array([1.0, 2.0])})
    same = bmc.KLD({"v": (1, 2), "x": 0.5})
    assert widths == same and hash(widths) == hash(same)
    assert widths != bmc.KLD({"x": 0.5, "v": [1.0, 3.0]})
    assert bmc.ParticleFilter(10, adapt=widths) == bmc.ParticleFilter(10, adapt=same)


def test_all_may_begin_anew() -> None:
    # a share of one: every slice is a net of its own
    engine = bmc.ParticleFilter(20_000, recovery=bmc.Recovery({"x": ANYWHERE}, share=1.0))
    found = bmc.filter(walk(), SHORT, engine=engine, rng=0)
    assert (found.anew[1:] == 20_000).all()
    # the reading's density is 0.1 everywhere inside; standard error 2 %
    np.testing.assert_allclose(found.log_marginal_increments, np.log(0.1), atol=0.1)


WRONG: dict[str, tuple[Any, type[Exception], str]] = {
    "no share": (lambda: bmc.Recovery({"x": ANYWHERE}), ValueError, "nothing would begin anew"),
    "large share": (lambda: bmc.Recovery({"x": ANYWHERE}, share=1.5), ValueError, "0 to 1"),
    "draws": (lambda: bmc.Recovery({"x": ANYWHERE}, share=0.1, draws=-1.0), ValueError, "draws=-1"),
    "all drawn": (
        lambda: bmc.Recovery({"x": ANYWHERE}, share=0.1, draws=1.0),
        ValueError,
        "no particle would come from the slice before",
    ),
    "share in words": (
        lambda: bmc.Recovery({"x": ANYWHERE}, share="a"),  # type: ignore[arg-type]
        ValueError,
        "0 to 1",
    ),
    "array": (
        lambda: bmc.Recovery({"x": np.zeros(2)}, share=0.1),
        TypeError,
        "the density for 'x'",
    ),
    "nothing": (
        lambda: bmc.Recovery(None, share=0.1),  # type: ignore[arg-type]
        TypeError,
        r"Recovery\(density=None\): give a dict",
    ),
    "aimed array": (
        lambda: bmc.Recovery({"x": ANYWHERE}, share=0.1, proposal={"x": 1.0}),
        TypeError,
        "the proposal for 'x'",
    ),
    "rates": (lambda: bmc.Recovery({"x": ANYWHERE}, slow=0.5, fast=0.1), ValueError, "slow < fast"),
    "tuple": (lambda: bmc.Recovery({("x", "y"): ANYWHERE}, share=0.1), TypeError, "name one node"),
    "no dict": (lambda: bmc.Recovery(ANYWHERE, share=0.1), TypeError, r"\(density="),
    "width in words": (lambda: bmc.KLD({"x": "a"}), ValueError, "the width of 'x' is 'a'"),
    "no components": (lambda: bmc.KLD({"x": []}), ValueError, "the width of 'x'"),
    "half a particle": (
        lambda: bmc.KLD({"x": 1.0}, least=2.5),  # type: ignore[arg-type]
        ValueError,
        "1 or more",
    ),
    "no widths": (lambda: bmc.KLD({}), ValueError, "width of its bins"),
    "zero width": (lambda: bmc.KLD({"x": 0.0}), ValueError, "positive number"),
    "error": (lambda: bmc.KLD({"x": 1.0}, error=0.0), ValueError, "above 0"),
    "class": (lambda: bmc.ParticleFilter(10, adapt=bmc.KLD), TypeError, r"give a KLD\("),
    "both": (
        lambda: bmc.ParticleFilter(
            10,
            recovery=bmc.Recovery({"x": ANYWHERE}, share=0.1),
            on_degeneracy="rejuvenate",
            rejuvenation={"x": ANYWHERE},
        ),
        ValueError,
        "give one of them",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_options_are_named(name: str) -> None:
    make, error, message = WRONG[name]
    with pytest.raises(error, match=message):
        make()


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"recovery": bmc.Recovery({"q": ANYWHERE}, share=0.1)}, "UnknownNodeError", "'q'"),
        (
            {"recovery": bmc.Recovery({"y": ANYWHERE}, share=0.1)},
            "ModelError",
            "says nothing of 'x'",
        ),
        (
            {"recovery": bmc.Recovery({"x": lambda y: bmc.Normal(y, 1.0)}, share=0.1)},
            "ModelError",
            "reads 'y', which comes after it.*proposal=",
        ),
        (
            {"recovery": bmc.Recovery({"x": ANYWHERE}, share=0.1, proposal={"q": ANYWHERE})},
            "UnknownNodeError",
            "'q'",
        ),
        (
            {"recovery": bmc.Recovery({"x": ANYWHERE}, share=0.1, proposal={"y": ANYWHERE})},
            "ModelError",
            "density= says nothing",
        ),
        ({"adapt": bmc.KLD({"q": 1.0})}, "UnknownNodeError", "'q'"),
        ({"adapt": bmc.KLD({"y": 1.0})}, "ModelError", "does not read"),
        ({"adapt": bmc.KLD({"x": [1.0, 2.0]})}, "ModelError", "gives 2 for it"),
    ],
)
def test_options_that_do_not_fit_the_template(options: Any, error: str, message: str) -> None:
    with pytest.raises(getattr(bmc.errors, error), match=message):
        bmc.filter(walk(), ROWS, engine=bmc.ParticleFilter(50, **options), rng=0)


def test_neither_is_smoothed_or_for_plates_apart() -> None:
    engine = bmc.ParticleFilter(50, adapt=bmc.KLD({"x": 0.5}))
    with pytest.raises(bmc.errors.UnsupportedError, match="not smoothed"):
        bmc.smooth(walk(), ROWS, engine=engine)
    dbn = bmc.DynamicBayesNet(plates={"k": 2})
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.3), initial=ANYWHERE, plates="k")
    dbn.add("y", lambda x: bmc.Normal(x, 0.5), plates="k")
    with pytest.raises(bmc.errors.UnsupportedError, match="filtered separately"):
        bmc.filter(dbn, {"y": np.zeros((2, 2))}, engine=engine)
