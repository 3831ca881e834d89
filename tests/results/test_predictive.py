"""Filters say whether rows are what they expected: innovations, ranks, and the warning where they are not.

Draws are of fixed seeds. Tests of uniformity compare the counts of ranks in ten cells with their
expectation by chi-square, at a chance of 1e-4 each, and are seen to reject a filter of too narrow noise.
"""

from __future__ import annotations

import pickle
import shutil
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import special

import bayesmc as bmc
from bayesmc.engines.particles import predictive
from bayesmc.errors import (
    LowEssWarning,
    ModelMisfitWarning,
    QueryError,
    UnknownNodeError,
    UnsupportedError,
)
from bayesmc.results.predictive import Predictive
from bayesmc.robotics.logs import GroundTruth, heading_offset, read_plaza, stack
from bayesmc.testing import session
from examples import range_only
from examples.robot_landmarks import Drive, ranges_heard, write_plaza

GAUSSIAN = [bmc.KalmanFilter(), bmc.ExtendedKalmanFilter(), bmc.UnscentedKalmanFilter()]
ALL = [*GAUSSIAN, bmc.ParticleFilter(500)]
NAMES = ["kalman", "ekf", "ukf", "particles"]


def level(noise: float = 1.0, moves: float = 0.5, start: float = 0.0) -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet("level")
    dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, moves), initial=bmc.Normal(start, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, noise))
    return dbn


def drawn(dbn: bmc.DynamicBayesNet, steps: int, seed: int, name: str = "y") -> np.ndarray:
    return dbn.sample(steps, rng=session.seed() + seed)[name][0]


def cells(ranks: np.ndarray) -> float:
    """Chance of counts in ten cells as uneven as these, of uniform ranks."""
    ranks = ranks[np.isfinite(ranks)]
    count = np.histogram(ranks, 10, (0.0, 1.0))[0]
    expected = len(ranks) / 10
    return float(special.chdtrc(9, ((count - expected) ** 2).sum() / expected))


# ---- innovations -----------------------------------------------------------------------------------


@pytest.mark.parametrize("engine", GAUSSIAN, ids=NAMES[:3])
def test_innovations_are_those_of_the_textbook(engine: Any) -> None:
    rows = np.array([0.3, np.nan, -1.2, 2.0, 0.7])
    found = bmc.filter(level(), {"y": rows}, engine=engine)
    mean, var, expected = 0.0, 1.0, []
    for k, y in enumerate(rows):
        if k:
            mean, var = 0.9 * mean, 0.81 * var + 0.25
        if np.isnan(y):
            expected.append(np.nan)
            continue
        off, total = y - mean, var + 1.0
        expected.append(off / np.sqrt(total))
        mean, var = mean + var / total * off, var - var**2 / total
    np.testing.assert_allclose(found.innovations("y"), expected, rtol=1e-9)
    np.testing.assert_allclose(found.nis, np.nan_to_num(expected) ** 2, rtol=1e-9)
    assert found.nis_df.tolist() == [1, 0, 1, 1, 1]
    np.testing.assert_allclose(found.predictive_ranks("y"), special.ndtr(expected), rtol=1e-9)
    smoothed = bmc.smooth(level(), {"y": rows}, engine=engine)
    np.testing.assert_allclose(smoothed.innovations("y"), expected, rtol=1e-9)
    again = pickle.loads(pickle.dumps(found))
    np.testing.assert_array_equal(again.innovations("y"), found.innovations("y"))


def two_sensors(noise: float = 0.6) -> bmc.DynamicBayesNet:
    """A vector with a plate of sensors of which some are missing, in plates that never meet."""
    root = np.array([[1.0, 0.0], [0.8, 0.4]])
    dbn = bmc.DynamicBayesNet("two", plates={"robot": 3, "sensor": 2})
    dbn.add(
        "x", lambda x_prev: bmc.MvNormal(0.9 * x_prev, scale_tril=0.5 * root), plates="robot",
        initial=bmc.MvNormal(np.zeros(2), scale_tril=root),
    )  # fmt: skip
    dbn.add("y", lambda x: bmc.MvNormal(x, scale_tril=noise * root), plates="robot")
    dbn.add("z", lambda x: bmc.Normal(x[..., 0] + x[..., 1], noise), plates=("robot", "sensor"))
    return dbn


@pytest.mark.parametrize("engine", GAUSSIAN, ids=NAMES[:3])
def test_squares_of_innovations_are_chi_square(engine: Any) -> None:
    """Sums over 60 slices within the quantiles of 1e-5 at both ends: six false alarms in 1e5 runs."""
    dbn = two_sensors()
    rows = {n: v[0].copy() for n, v in dbn.sample(60, rng=session.seed() + 1).items() if n != "x"}
    rows["z"][::3, 1, 0] = np.nan
    rows["y"][10:20] = np.nan
    found = bmc.filter(dbn, rows, engine=engine)
    assert found.nis.shape == found.nis_df.shape == found.row_ranks.shape == (60, 3)
    assert found.innovations("y").shape == (60, 3, 2) and found.innovations("z").shape == (60, 3, 2)
    assert found.nis_df[[0, 1, 12]].tolist() == [[4, 3, 4], [4, 4, 4], [2, 1, 2]]
    assert np.isnan(found.innovations("z")[::3, 1, 0]).all()
    assert np.isnan(found.innovations("y")).all(axis=(1, 2)).nonzero()[0].tolist() == list(
        range(10, 20)
    )
    total, df = found.nis.sum(axis=0), found.nis_df.sum(axis=0)
    low, high = special.chdtri(df, 1 - 1e-5), special.chdtri(df, 1e-5)
    assert ((low < total) & (total < high)).all()
    with pytest.warns(ModelMisfitWarning):  # the control
        wrong = bmc.filter(two_sensors(0.1), rows, engine=engine)
    assert (wrong.nis.sum(axis=0) > high).all()


def test_innovations_of_angles_go_the_short_way_round() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("a", lambda a_prev: bmc.WrappedNormal(a_prev, 0.1), initial=bmc.WrappedNormal(3.1, 0.1))
    dbn.add("y", lambda a: bmc.WrappedNormal(a, 0.1))
    found = bmc.filter(dbn, {"y": [-3.1, 3.1, -3.1, 3.1]}, engine=bmc.ExtendedKalmanFilter())
    assert np.abs(found.innovations("y")).max() < 2.0


# ---- ranks -----------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore::bayesmc.errors.LowEssWarning")
@pytest.mark.parametrize("engine", ALL, ids=NAMES)
def test_ranks_are_uniform_where_the_model_is_right(engine: Any) -> None:
    found = bmc.filter(level(), {"y": drawn(level(), 600, 2)}, engine=engine, rng=3)
    assert min(cells(found.row_ranks), cells(found.predictive_ranks("y"))) > 1e-4
    assert abs(np.nanmean(found.row_deficits)) < 5 * 0.75 / np.sqrt(
        np.isfinite(found.row_ranks).sum()
    )
    with pytest.warns(ModelMisfitWarning):  # the control
        wrong = bmc.filter(level(0.2, 0.1), {"y": drawn(level(), 600, 2)}, engine=engine, rng=3)
    assert max(cells(wrong.row_ranks), cells(wrong.predictive_ranks("y"))) < 1e-4


def counts(scale: float = 1.0) -> bmc.DynamicBayesNet:
    """Counts in a plate whose elements never meet, and a state read by an observed node's past."""
    dbn = bmc.DynamicBayesNet(plates={"site": 4})
    dbn.add("x", lambda x_prev: bmc.Normal(0.8 * x_prev, 0.4), plates="site",
            initial=bmc.Normal(0.0, 1.0))  # fmt: skip
    dbn.add("n", lambda x: bmc.Poisson(scale * np.exp(0.5 + x)), plates="site")
    dbn.add("wet", lambda n, wet_prev: bmc.Bernoulli(np.where(n > 2, 0.8, 0.1 + 0.3 * wet_prev)),
            plates="site", initial=bmc.Bernoulli(0.5), parents=["n", "wet_prev"])  # fmt: skip
    return dbn


@pytest.mark.parametrize("options", [{}, {"auxiliary": True}], ids=["bootstrap", "auxiliary"])
def test_ranks_of_counts_are_uniform_by_chance(options: dict[str, Any]) -> None:
    dbn = counts()
    rows = {n: v[0] for n, v in dbn.sample(200, rng=session.seed() + 4).items() if n != "x"}
    found = bmc.filter(dbn, rows, engine=bmc.ParticleFilter(400, **options), rng=5)
    for ranks in (found.row_ranks, found.predictive_ranks("n"), found.predictive_ranks("wet")):
        assert ranks.shape == (200, 4) and cells(ranks) > 1e-4
    with pytest.warns(ModelMisfitWarning):
        wrong = bmc.filter(counts(0.05), rows, engine=bmc.ParticleFilter(400, **options), rng=5)
    assert cells(wrong.predictive_ranks("n")) < 1e-4


def test_looking_leaves_the_particles_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = {"y": drawn(level(), 50, 6)}
    found = bmc.filter(level(), rows, engine=bmc.ParticleFilter(200), rng=7)
    again = bmc.filter(level(), rows, engine=bmc.ParticleFilter(200), rng=7)
    np.testing.assert_array_equal(found.row_ranks, again.row_ranks)
    monkeypatch.setattr(predictive, "_FEW", 1000)
    without = bmc.filter(level(), rows, engine=bmc.ParticleFilter(200), rng=7)
    assert without.row_ranks is None
    np.testing.assert_array_equal(found.mean("x"), without.mean("x"))
    assert found.log_marginal_likelihood == without.log_marginal_likelihood


def test_rows_that_cannot_be_drawn_are_not_compared() -> None:
    """No ranks and no noise about it: the density has no sampler, and the filter needs none."""
    dbn = level()
    dbn.add("z", lambda x: bmc.Density(lambda z: -((z - x) ** 2)))
    rows = {"y": drawn(level(), 30, 8), "z": np.zeros(30)}
    found = bmc.filter(dbn, rows, engine=bmc.ParticleFilter(100), rng=9)
    assert found.row_ranks is None and found.row_deficits is None
    with pytest.raises(UnsupportedError, match="random draws"):
        found.predictive_ranks("y")


def test_what_cannot_be_asked() -> None:
    rows = {"y": drawn(level(), 20, 10)}
    found = bmc.filter(level(), rows, engine=GAUSSIAN[0])
    for ask in (found.innovations, found.predictive_ranks):
        with pytest.raises(UnknownNodeError):
            ask("w")
        with pytest.raises(QueryError, match="not observed"):
            ask("x")
    few = bmc.filter(level(), {"y": rows["y"][:3]}, engine=bmc.GridFilter({"x": (-8.0, 8.0, 100)}))
    with pytest.raises(UnsupportedError, match="predictive_ranks.*five rows"):
        few.predictive_ranks("y")
    ahead = bmc.forecast(level(), rows, steps=3, engine=GAUSSIAN[0])
    with pytest.raises(QueryError, match="ahead of the data"):
        _ = ahead.nis


# ---- the warning -----------------------------------------------------------------------------------


@pytest.mark.parametrize("engine", ALL, ids=NAMES)
def test_no_warning_where_the_model_is_right_or_a_little_off(engine: Any) -> None:
    """Warnings are errors here. Each of the runs of a right model warns with a chance below 1e-6."""
    for seed in range(6):
        rows = {"y": drawn(level(), 80, 20 + seed)}
        bmc.filter(level(), rows, engine=engine, rng=seed)
        bmc.filter(level(0.7, 0.35), rows, engine=engine, rng=seed)  # of twice the variance
    rows["y"][40] = 60.0  # one outlier
    bmc.filter(level(moves=2.0), rows, engine=engine, rng=0)
    bmc.filter(level(), {"y": rows["y"][:4] + 5.0}, engine=engine, rng=0)  # too few to say so


@pytest.mark.parametrize("engine", ALL, ids=NAMES)
def test_rows_in_other_units_are_noticed(engine: Any) -> None:
    rows = {"y": 100.0 * drawn(level(), 60, 30)}
    with pytest.warns(ModelMisfitWarning, match=r"of \d+ rows compared in slices \d to 5\d"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LowEssWarning)  # which has another cause
            bmc.filter(level(), rows, engine=engine, rng=0)


@pytest.mark.parametrize("engine", GAUSSIAN, ids=NAMES[:3])
def test_a_filter_that_is_lost_for_a_while_says_when(engine: Any) -> None:
    y = drawn(level(moves=0.1), 600, 31)
    y[200:230] += 12.0
    with pytest.warns(ModelMisfitWarning, match="slices"):
        found = bmc.filter(level(moves=0.1), {"y": y}, engine=engine)
    misfit = found.predictive.misfit()
    assert 180 < misfit.first < misfit.last < 250


def test_the_warning_has_its_rate() -> None:
    """Ranks that are uniform never alarm; 8 elements that err together count as one."""
    rng = np.random.default_rng(session.seed() + 32)
    alarms = 0
    for _ in range(300):
        ranks = rng.random((100, 8))
        alarms += Predictive(ranks, np.full(ranks.shape, 5.0)).misfit() is not None
    assert alarms == 0
    shared = np.where(rng.random((6, 1)) < 0.4, 0.01, 0.5) * np.ones((1, 200))
    assert Predictive(shared, np.full(shared.shape, 5.0)).misfit() is None
    low = np.where(np.arange(100) % 2, 0.01, 0.6)[:, None] * np.ones((1, 8))
    assert Predictive(low, np.full(low.shape, 5.0)).misfit() is not None
    assert Predictive(low, np.full(low.shape, 0.1)).misfit() is None, "significant, but little"


# ---- a robot that is told a heading turned by pi ---------------------------------------------------


@pytest.fixture(scope="module")
def plaza(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_plaza(tmp_path_factory.mktemp("plaza"), 300.0)


def turned(drive: Drive, by: float) -> Drive:
    truth = drive.truth.copy()
    truth[:, 2] += by
    return replace(drive, truth=truth)


@pytest.mark.parametrize(
    "engine", [bmc.ExtendedKalmanFilter(), bmc.UnscentedKalmanFilter(), bmc.ParticleFilter(500)],
    ids=NAMES[1:],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore::bayesmc.errors.LowEssWarning")
@pytest.mark.parametrize(
    "bias_is", [pytest.param("constant", marks=pytest.mark.thorough), "growing"]
)
def test_a_start_that_is_turned_by_pi_is_noticed(plaza: Path, engine: Any, bias_is: str) -> None:
    drive = ranges_heard(plaza)
    right = range_only.filtered(drive, engine, bias_is)
    with pytest.warns(ModelMisfitWarning):
        wrong = range_only.filtered(turned(drive, np.pi), engine, bias_is)
    assert drive.rmse(wrong.mean("pose")) > 2 * drive.rmse(right.mean("pose"))
    assert np.nanmean(wrong.row_deficits) > 1.0 > np.nanmean(right.row_deficits)


@pytest.mark.parametrize("by", [np.pi, np.pi - 0.2, 0.0, 1.0])
def test_headings_that_point_backwards_are_turned(plaza: Path, tmp_path: Path, by: float) -> None:
    from scipy.io import loadmat, savemat

    for name in ("Plaza1_DR.txt", "Plaza1_TD.txt"):
        shutil.copy(plaza / name, tmp_path / name)
    content = loadmat(plaza / "Plaza1_.mat", variable_names=("TL", "GT"))
    content["GT"][:, 3] += by
    savemat(tmp_path / "Plaza1_.mat", {n: content[n] for n in ("TL", "GT")})
    truth, found = read_plaza(plaza), read_plaza(tmp_path)
    assert truth.turned == 0.0 and found.turned == (np.pi if by > 2.0 else 0.0)
    off = stack(found.truth)["pose"] - stack(truth.truth)["pose"]
    left = by - found.turned
    np.testing.assert_allclose(np.exp(1j * off[:, 2]), np.exp(1j * left), atol=1e-6)
    assert heading_offset(found.truth) == pytest.approx(-left, abs=0.1)


@pytest.mark.filterwarnings("ignore::bayesmc.errors.LowEssWarning")
def test_plaza_1_points_forwards_and_turned_round_is_noticed(reference_data: Path) -> None:
    folder = reference_data / "robot" / "plaza"
    assert read_plaza(folder).turned == 0.0
    drive = ranges_heard(folder)
    some = slice(0, 1200)
    drive = Drive(drive.times[some], drive.motion[some], drive.effort[some], drive.seen[some],
                  drive.marks, drive.truth[some])  # fmt: skip
    engine = bmc.ParticleFilter(300)
    range_only.filtered(drive, engine)
    with pytest.warns(ModelMisfitWarning):
        range_only.filtered(turned(drive, np.pi), engine)


def test_tracks_without_a_direction_have_no_offset() -> None:
    still = [GroundTruth(float(k), [0.0, 0.0, 1.0]) for k in range(20)]
    rng = np.random.default_rng(0)
    random = [
        GroundTruth(float(k), [float(k), 0.0, a]) for k, a in enumerate(rng.uniform(-3, 3, 200))
    ]
    assert np.isnan(heading_offset(still)) and np.isnan(heading_offset(random))
    with pytest.raises(ValueError, match="distance"):
        heading_offset(still, 0.0)
