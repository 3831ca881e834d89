"""Many evidence sets at once answer as each would by itself."""

from __future__ import annotations

import pickle
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.engines.exact.many import TablePosteriors
from bayesmc.errors import (
    CheckpointError,
    EvidenceError,
    EvidenceWarning,
    InterruptWarning,
    ShapeError,
    UnsupportedError,
    ZeroProbabilityError,
)
from bayesmc.factors import CliqueTree
from bayesmc.factors import many as blocks
from bayesmc.testing import random_evidence, random_net

pytestmark = pytest.mark.filterwarnings("ignore::bayesmc.errors.LowEssWarning")

LABELS = ("no", "yes")


def chain() -> bmc.BayesNet:
    net = bmc.BayesNet()
    net.add("rain", bmc.Bernoulli(0.2), states=LABELS)
    net.table("wet", ["rain"], [[0.9, 0.1], [0.1, 0.9]], LABELS)
    net.table("slip", ["wet"], [[0.99, 0.01], [0.7, 0.3]], LABELS)
    return net


@pytest.mark.parametrize("seed", range(6))
def test_random_nets_answer_as_one_by_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    net = random_net(rng, nodes=(3, 9))
    sets = [random_evidence(net, rng) for _ in range(40)]
    posteriors = bmc.infer_many(net, sets)
    assert isinstance(posteriors, TablePosteriors)
    for k, evidence in enumerate(sets):
        one = bmc.infer(net, evidence, engine=bmc.Exact())
        assert posteriors.log_marginal_likelihood[k] == pytest.approx(
            one.log_marginal_likelihood, abs=1e-10
        )
        for name in net:
            if one.model[name].domain is not None:
                expected = one.probabilities(name)
                np.testing.assert_allclose(posteriors.probabilities(name)[k], expected, atol=1e-12)
                np.testing.assert_allclose(posteriors[k].probabilities(name), expected, atol=1e-12)


def test_each_posterior_answers_all_questions() -> None:
    posteriors = bmc.infer_many(chain(), [{"slip": "yes"}, {"rain": "no"}, {}])
    one = bmc.infer(chain(), {"slip": "yes"})
    joint = posteriors[0].probabilities("rain", "wet")
    np.testing.assert_allclose(joint, one.probabilities("rain", "wet"), atol=1e-12)
    drawn = posteriors[0].resample(100, rng=0)["wet"]
    assert drawn.shape == (1, 100)
    both = posteriors.expectation(lambda rain, wet: (rain == "yes") & (wet == "yes"))
    assert both.shape == (3,) and both[1] == 0.0
    assert [
        p.log_marginal_likelihood for p in posteriors
    ] == posteriors.log_marginal_likelihood.tolist()
    assert len(posteriors[1:]) == 2
    back = pickle.loads(pickle.dumps(posteriors))
    assert np.array_equal(back.probabilities("rain"), posteriors.probabilities("rain"))


def test_numbers_have_means() -> None:
    net = bmc.BayesNet()
    net.add("die", bmc.DiscreteUniform(1, 6))
    net.add("odd", lambda die: bmc.Bernoulli(0.9 * (die % 2) + 0.05))
    posteriors = bmc.infer_many(net, [{"odd": 1}, {"odd": 0}, {"die": 3}])
    ones = [bmc.infer(net, e) for e in ({"odd": 1}, {"odd": 0}, {"die": 3})]
    np.testing.assert_allclose(posteriors.mean("die"), [o.mean("die") for o in ones])
    np.testing.assert_allclose(posteriors.std("die"), [o.std("die") for o in ones], atol=1e-12)


def test_underflow_is_answered_with_logs() -> None:
    """A block in which something would be lost is answered set by set."""
    tiny = np.array([[1.0, 1e-200], [1e-200, 1.0]])
    scopes = [("a", "b"), ("b", "c"), ("c", "d")]
    bound = CliqueTree(dict.fromkeys("abcd", 2), scopes).bind([tiny, tiny, tiny])
    states = np.array([[0, 1, 0, -1], [-1, -1, -1, 0]])
    found = blocks.calibrate_many(bound, states)
    for k, seen in enumerate(({"a": 0, "b": 1, "c": 0}, {"d": 0})):
        one = bound.calibrate(seen)
        assert found.log_z[k] == pytest.approx(one.log_z)
        assert np.allclose(found.marginals[k, 6:], one.marginal("d"))


def test_impossible_evidence_is_named_with_its_number() -> None:
    net = bmc.BayesNet()
    net.table("a", [], [1.0, 0.0])
    net.table("b", ["a"], [[0.5, 0.5], [0.1, 0.9]])
    with pytest.raises(ZeroProbabilityError, match="evidence set 1: .*a=1 is impossible"):
        bmc.infer_many(net, [{"b": 1}, {"a": 1}, {"b": 0}])


@pytest.mark.parametrize(
    ("evidence", "fault"),
    [
        ({"wet": "yes"}, "a dict; give a list of dicts"),
        ([{"wet": "yes"}, {"wet": "perhaps"}], "evidence set 1: .*'perhaps'"),
        ([{"wet": "yes"}, {"wett": "yes"}], "evidence set 1: .*'wett'"),
        ([{"wet": "yes"}, 3], "evidence set 1 is a int"),
    ],
)
def test_wrong_evidence_is_named_before_work_starts(evidence: Any, fault: str) -> None:
    with pytest.raises(EvidenceError, match=fault):
        bmc.infer_many(chain(), evidence)


def test_none_is_unobserved_and_no_sets_are_no_answers() -> None:
    posteriors = bmc.infer_many(chain(), [{"wet": None}, {"wet": "yes", "slip": None}])
    assert posteriors.probabilities("rain")[0].tolist() == [0.8, 0.2]
    assert len(bmc.infer_many(chain(), [])) == 0


def test_plates_and_numbers_are_answered_one_by_one() -> None:
    net = bmc.BayesNet(plates={"i": None})
    net.add("mean", bmc.Normal(0.0, 1.0))
    net.add("x", lambda mean: bmc.Normal(mean, 1.0), plates="i")
    sets = [{"x": [1.0, 2.0]}, {"x": [1.0, 2.0, 3.0]}, {"x": [0.0]}]
    posteriors = bmc.infer_many(net, sets)
    np.testing.assert_allclose(posteriors.mean("mean"), [1.0, 1.5, 0.0], atol=1e-12)
    with pytest.raises(ShapeError, match="one by one"):
        posteriors.mean("x")


def test_answers_do_not_depend_on_the_other_questions() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("b", lambda a: bmc.StudentT(3.0, a, 1.0))
    engine = bmc.LikelihoodWeighting(200)
    sets = [{"b": float(k)} for k in range(5)]
    whole = bmc.infer_many(net, sets, engine=engine, rng=1).mean("a")
    first = bmc.infer_many(net, sets[:2], engine=engine, rng=1).mean("a")
    assert np.array_equal(whole[:2], first)
    assert len(set(whole.tolist())) == 5


def test_inputs_of_each_question() -> None:
    net = bmc.BayesNet()
    net.input("u")
    net.add("a", lambda u: bmc.Normal(u, 1.0))
    found = bmc.infer_many(net, [{}, {}], inputs=[{"u": 1.0}, {"u": 2.0}])
    assert found.mean("a").tolist() == [1.0, 2.0]
    with pytest.raises(EvidenceError, match="2 evidence sets and 1 inputs"):
        bmc.infer_many(net, [{}, {}], inputs=[{"u": 1.0}])


def test_ctrl_c_keeps_what_is_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("b", lambda a: bmc.StudentT(3.0, a, 1.0))
    run, calls = bmc.LikelihoodWeighting.run, []

    def stopped(*arguments: Any, **options: Any) -> Any:
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return run(*arguments, **options)

    monkeypatch.setattr(bmc.LikelihoodWeighting, "run", stopped)
    with pytest.warns(InterruptWarning, match="2 of 4 evidence sets"):
        found = bmc.infer_many(net, [{"b": 1.0}] * 4, engine=bmc.LikelihoodWeighting(100), rng=0)
    assert found.done.tolist() == [True, True, False, False]
    with pytest.raises(ValueError, match="stopped before evidence set 2"):
        found.mean("a")


def test_one_net_is_used_by_many_threads_at_once() -> None:
    """Threads that ask, sample and filter with the same objects get what one alone gets."""
    net = bmc.BayesNet(plates={"i": 600})
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("s", bmc.Gamma(2.0, 2.0))
    net.add("y", lambda a, s: bmc.Normal(a, s**-0.5), plates="i")
    data = {"y": np.linspace(-1.0, 1.0, 600)}
    discrete = chain()
    walk = bmc.DynamicBayesNet()
    walk.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    walk.add("y", lambda x: bmc.Normal(x, 1.0))
    rows = {"y": np.linspace(-1.0, 1.0, 12)}
    particles, kalman = bmc.ParticleFilter(50), bmc.KalmanFilter()

    def ask(k: int) -> list[Any]:
        weighted = bmc.infer(net, data, engine=bmc.LikelihoodWeighting(300), rng=k)
        chains = bmc.infer(net, data, engine=bmc.Gibbs(6, 3, 2), rng=k, keep="summaries")
        exact = bmc.infer(discrete, {"slip": LABELS[k % 2]})
        filtered = bmc.filter(walk, rows, engine=particles, rng=k)
        online = particles.start(walk, rng=k)
        for y in rows["y"]:
            online = particles.step(online, {"y": y})
        found = [
            weighted.mean("a"),
            chains.mean("a"),
            exact.probabilities("rain"),
            filtered.mean("x"),
        ]
        found += [online.mean("x"), bmc.filter(walk, rows, engine=kalman).var("x")]
        found += [net.sample(4, rng=k)["y"], net.log_prob({"a": 0.1 * k, "s": 1.0, **data})]
        return [np.asarray(value).tolist() for value in found]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("warnings.warn", lambda *arguments, **options: None)
        often = sys.getswitchinterval()
        sys.setswitchinterval(1e-6)  # threads take turns wherever they can
        try:
            with ThreadPoolExecutor(
                8
            ) as pool:  # the first questions ever: they compile side by side
                together = list(pool.map(ask, range(16)))
        finally:
            sys.setswitchinterval(often)
        assert together == [ask(k) for k in range(16)]


def bounded() -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"i": 3})
    net.add("m", bmc.Normal(0.0, 1.0))
    net.add("u", bmc.Uniform(0.0, 1.0))
    net.add("x", lambda m: bmc.Normal(m, 1.0), plates="i")
    net.add("w", lambda u: bmc.Uniform(u, u + 1.0))
    return net


SOME = [{"x": [1.0, 2.0, 3.0], "w": 0.5}, {"x": [1.0, np.nan, 3.0], "w": 5.0}, {"w": 1.5}]


def test_impossible_sets_are_nan_and_the_others_as_without_them() -> None:
    """A block of sets, and questions one by one."""
    net = bmc.BayesNet()
    net.table("a", [], [1.0, 0.0])
    net.table("b", ["a"], [[0.5, 0.5], [0.1, 0.9]])
    sets = [{"b": 1}, {"a": 1}, {}, {"a": 1, "b": 0}]
    with pytest.raises(ZeroProbabilityError, match="set 1: .*so is that of set 3; on_impossible"):
        bmc.infer_many(net, sets)
    with pytest.warns(EvidenceWarning, match="no posterior of sets 1, 3"):
        found = bmc.infer_many(net, sets, on_impossible="nan")
    assert found.done.tolist() == [True, False, True, False] and [*found.impossible] == [1, 3]
    assert found[1] is None and found.log_marginal_likelihood[1] == -np.inf
    assert np.isnan(found.probabilities("a", "b")[1]).all() and np.isnan(found.mean("b")[3])
    alone = bmc.infer_many(net, [sets[0], sets[2]])
    np.testing.assert_array_equal(found.probabilities("b")[[0, 2]], alone.probabilities("b"))
    assert np.isnan(found[1:3].mean("b")).tolist() == [True, False]
    engine = bmc.LikelihoodWeighting(300)
    with pytest.warns(EvidenceWarning, match="set 1: .*none of 300 draws"):
        found = bmc.infer_many(bounded(), SOME, engine=engine, rng=0, on_impossible="nan")
    assert np.isnan(found.mean("x")).any(axis=1).tolist() == [False, True, False]
    assert np.isnan(found.log_marginal_likelihood).tolist() == [False, True, False]
    with pytest.raises(ZeroProbabilityError, match="evidence set 1: "):
        bmc.infer_many(bounded(), SOME, engine=engine, rng=0)
    with pytest.raises(ValueError, match='give "raise", or "nan"'):
        bmc.infer_many(net, sets, on_impossible="skip")


@pytest.mark.filterwarnings("ignore::bayesmc.errors.EvidenceWarning")
@pytest.mark.parametrize("kind", ["tables", "draws", "exact"])
def test_answers_are_saved_and_loaded_with_the_same_bits(kind: str, tmp_path: Path) -> None:
    pytest.importorskip("h5netcdf", reason="needs the extra netcdf")
    name, net, make = "rain", chain(), chain
    if kind == "tables":
        found = bmc.infer_many(net, [{"slip": "yes"}, {"rain": "no"}, {}])
    elif kind == "draws":
        name, net, make = "x", bounded(), bounded
        engine = bmc.LikelihoodWeighting(200)
        found = bmc.infer_many(net, SOME, engine=engine, rng=0, on_impossible="nan")
    else:
        name, make = "a", normal
        net = normal()
        found = bmc.infer_many(net, [{"b": 1.0}, {}])
    found.save(tmp_path / "many.nc")
    loaded = bmc.load(tmp_path / "many.nc")
    ask = loaded.probabilities if kind == "tables" else loaded.mean
    wanted = found.probabilities(name) if kind == "tables" else found.mean(name)
    np.testing.assert_array_equal(ask(name), wanted)
    logs = loaded.log_marginal_likelihood, found.log_marginal_likelihood
    assert np.array_equal(*logs, equal_nan=True)
    assert loaded.impossible == found.impossible and type(loaded) is type(found)
    if kind == "draws":
        np.testing.assert_array_equal(loaded[2]["m"], found[2]["m"])
    with pytest.raises(UnsupportedError, match=r"bmc\.load\(path, net=net\)"):
        loaded[0].predict(name, rng=0)
    whole = bmc.load(tmp_path / "many.nc", net=make())
    drawn = [np.asarray(one[0].predict(name, rng=0)[name] == 1.0) for one in (whole, found)]
    np.testing.assert_array_equal(*drawn)
    with pytest.raises(CheckpointError, match="about another net"):
        bmc.load(tmp_path / "many.nc", net=normal(2.0))


def normal(scale: float = 1.0) -> bmc.BayesNet:
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("b", lambda a: bmc.Normal(a, scale))
    return net


def test_xarray_reads_answers_side_by_side(tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray", reason="needs the extra arviz")
    engine = bmc.LikelihoodWeighting(50)
    found = bmc.infer_many(normal(), [{"b": 1.0}, {"b": 2.0}], engine=engine, rng=0)
    found.save(tmp_path / "many.nc")
    with xarray.open_datatree(tmp_path / "many.nc") as tree:
        assert tree["answers"]["a_mean"].dims == ("evidence_set",)
        np.testing.assert_array_equal(tree["answers"]["a_mean"], found.mean("a"))
        draws = tree["set1"]["weighted_posterior"]["a"]
        np.testing.assert_array_equal(draws, found[1]["a"])


def test_answers_as_a_table_and_in_a_notebook() -> None:
    pytest.importorskip("pandas", reason="needs the extra pandas")
    found = bmc.infer_many(chain(), [{"slip": "yes"}, {"slip": "no", "rain": "no"}])
    frame = found.to_dataframe()
    assert list(frame.columns.get_level_values("node").unique()) == ["rain", "wet"]
    np.testing.assert_array_equal(frame["rain", "", "yes"], found.probabilities("rain")[:, 1])
    assert frame.index.name == "evidence_set" and len(found.to_dataframe("slip").columns) == 2
    shown = found._repr_html_()
    assert "P(wet=yes)" in shown and shown.count("<tr>") == 3
    many = bmc.infer_many(normal(), [{"b": float(k)} for k in range(40)])
    assert many.to_dataframe()["a", "", "mean"].tolist() == many.mean("a").tolist()
    assert "16 more" in many._repr_html_() and "a, sd" in many._repr_html_()


@pytest.mark.filterwarnings("ignore::bayesmc.errors.EvidenceWarning")
def test_questions_that_are_done_are_kept_in_a_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("h5netcdf", reason="needs the extra netcdf")
    engine, options = bmc.LikelihoodWeighting(200), {"on_impossible": "nan"}
    wanted = bmc.infer_many(bounded(), SOME, engine=engine, rng=3, **options).mean("m")
    run, calls = bmc.LikelihoodWeighting.run, []

    def stopped(*arguments: Any, **more: Any) -> Any:
        calls.append(1)
        if len(calls) == 3:
            raise RuntimeError("the process ends")
        return run(*arguments, **more)

    def ask(**more: Any) -> Any:
        return bmc.infer_many(
            bounded(), SOME, engine=engine, checkpoint=tmp_path, **options, **more
        )

    monkeypatch.setattr(bmc.LikelihoodWeighting, "run", stopped)
    with pytest.raises(RuntimeError):
        ask(rng=3)
    found = ask()  # of the same seed; the first set is not asked again
    np.testing.assert_array_equal(found.mean("m"), wanted)
    assert len(calls) == 5
    with pytest.raises(CheckpointError, match="set 0: .*the seed .* was 3.* and is 4"):
        ask(rng=4)
    with pytest.raises(UnsupportedError, match=r"posteriors\.save\(path\)"):
        bmc.infer_many(chain(), [{"wet": "yes"}], checkpoint=tmp_path)
