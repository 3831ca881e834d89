"""Posteriors, answers over time and beliefs out of files answer as before."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import BayesmcError, CheckpointError, ModelError, UnsupportedError

pytest.importorskip("h5netcdf", reason="needs the extra netcdf")


def net_of(scale: float = 0.5) -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"p": 2})
    net.table("kind", [], [0.3, 0.7], states=("u", "v"))
    net.add("sign", bmc.Bernoulli(0.5), states=(-1, 1))
    net.add("a", lambda kind: bmc.Normal(np.where(kind == "u", 1.0, -1.0), 1.0), plates="p")
    net.add("y", lambda a, sign: bmc.Normal(a + sign, scale), plates="p")
    return net


SEEN = {"y": [0.3, np.nan]}
STATIC = [
    bmc.Exact(), bmc.Gibbs(40, warmup=5), bmc.LikelihoodWeighting(500), bmc.Rejection(50),
    bmc.Importance(500, proposal={"a": lambda kind: bmc.Normal(0.0, 2.0)}), bmc.ExpectationPropagation(),
]  # fmt: skip


def answers(found: Any) -> dict[Any, Any]:
    """All that is answered by name, or the kind of refusal."""
    told: dict[Any, Any] = {}
    ask: dict[str, Callable[[str], Any]] = {
        "mean": found.mean, "var": found.var, "table": found.probabilities,
        "quantile": lambda n: found.quantile(n, 0.3),
    }  # fmt: skip
    if hasattr(found, "mcse"):
        ask["mcse"] = found.mcse
    for name in found.names:
        for what, question in ask.items():
            try:
                told[name, what] = np.asarray(question(name)).tolist()
            except BayesmcError as error:
                told[name, what] = type(error)
    return told


@pytest.mark.parametrize("engine", STATIC, ids=lambda e: type(e).__name__)
@pytest.mark.filterwarnings("ignore::bayesmc.errors.BayesmcWarning")
def test_posteriors(engine: Any, tmp_path: Path) -> None:
    path = tmp_path / "answer.nc"
    before = bmc.infer(net_of(), SEEN, engine=engine, rng=0)
    before.save(path)
    after = bmc.load(path)
    assert type(after) is type(before)
    assert str(answers(after)) == str(answers(before))
    assert after.log_marginal_likelihood == before.log_marginal_likelihood
    if isinstance(engine, bmc.ExpectationPropagation):
        with pytest.raises(UnsupportedError, match="without its functions"):
            bmc.load(path, net=net_of())
        return
    with pytest.raises(UnsupportedError, match="carry no functions"):
        after.predict("y", rng=0)
    whole = bmc.load(path, net=net_of())
    np.testing.assert_array_equal(
        whole.predict("y", rng=0).mean("y"), before.predict("y", rng=0).mean("y")
    )
    with pytest.raises(CheckpointError, match="the density of node 'y' is another one"):
        bmc.load(path, net=net_of(2.0))


@pytest.mark.filterwarnings("ignore::bayesmc.errors.BayesmcWarning")
def test_arviz_reads_them(tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray", reason="needs the extra arviz")
    path = tmp_path / "chains.nc"
    found = bmc.infer(net_of(), SEEN, engine=bmc.Gibbs(40, warmup=5), rng=0)
    found.save(path)
    with xarray.open_datatree(path) as tree:
        draws = tree["posterior"]
        assert draws["a"].dims == ("chain", "draw", "p")
        np.testing.assert_array_equal(draws["a"].values, found["a"])
        np.testing.assert_array_equal(draws["sign"].values, found["sign"])  # -1 and 1, not 0 and 1
        assert draws["kind"].attrs["flag_meanings"] == "u v"
        assert np.isnan(tree["observed_data"]["y"].values).tolist() == [False, True]
    bmc.infer(net_of(), SEEN, engine=bmc.LikelihoodWeighting(500), rng=0).save(path)
    with xarray.open_datatree(path) as tree:  # which no summary without weights is made of
        assert "posterior" not in tree.children
        assert "log_weights" in tree["weighted_posterior"]
    bmc.infer(net_of(), SEEN).save(path)
    with xarray.open_datatree(path) as tree:
        np.testing.assert_allclose(
            tree["answers"]["sign_mean"], bmc.infer(net_of(), SEEN).mean("sign")
        )


@pytest.mark.filterwarnings("ignore::bayesmc.errors.BayesmcWarning")
def test_chains_are_gone_on_with(tmp_path: Path) -> None:
    engine = bmc.Gibbs(30, warmup=5)
    first = bmc.infer(net_of(), SEEN, engine=engine, rng=0)
    first.save(tmp_path / "chains.nc")
    loaded = bmc.load(tmp_path / "chains.nc", net=net_of())
    more = bmc.infer(net_of(), SEEN, engine=engine, rng=1, resume=loaded)
    wanted = bmc.infer(net_of(), SEEN, engine=engine, rng=1, resume=first)
    np.testing.assert_array_equal(more["a"], wanted["a"])


def rain() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.table("rain", ["rain_prev"], [[0.7, 0.3], [0.3, 0.7]], ("no", "yes"), initial=[0.5, 0.5])
    dbn.table("wet", ["rain"], [[0.8, 0.2], [0.1, 0.9]])
    return dbn


def walk() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.table("mode", ["mode_prev"], [[0.9, 0.1], [0.2, 0.8]], initial=[0.5, 0.5])
    dbn.add(
        "x",
        lambda x_prev, mode: bmc.Normal(np.where(mode == 1, 0.9, -0.2) * x_prev, 1.0),
        initial=bmc.Normal(0.0, 1.0),
    )
    dbn.add("wet", lambda x: bmc.Normal(x, 0.5))
    return dbn


def line() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("wet", lambda x: bmc.Normal(x, 0.5))
    return dbn


OVER_TIME = [
    (rain, bmc.DiscreteFilter()), (rain, bmc.BoyenKoller()), (line, bmc.KalmanFilter()),
    (line, bmc.UnscentedKalmanFilter()), (walk, bmc.SwitchingKalmanFilter()), (line, bmc.ParticleFilter(40)),
    (line, bmc.ParticleFilter(40, delay=1)), (walk, bmc.ParticleFilter(20, marginalize="auto")),
]  # fmt: skip


@pytest.mark.parametrize(
    ("make", "engine"), OVER_TIME, ids=lambda v: getattr(v, "__name__", str(v)[:30])
)
@pytest.mark.filterwarnings("ignore::bayesmc.errors.BayesmcWarning")
def test_over_time(make: Callable[[], Any], engine: Any, tmp_path: Path) -> None:
    path, rows = tmp_path / "answer.nc", [1, 0, 1, 1]
    before = bmc.filter(make(), {"wet": rows}, engine=engine, rng=0)
    before.save(path)
    assert str(answers(bmc.load(path))) == str(answers(before))
    options = {"rng": 0} if isinstance(engine, bmc.ParticleFilter) else {}
    belief = engine.start(make(), **options)
    for row in rows[:3]:
        belief = engine.step(belief, {"wet": row})
    belief.save(path)
    loaded = bmc.load(path)
    assert str(answers(loaded)) == str(answers(belief))
    later = engine.step(engine.start(make(), belief=loaded), {"wet": rows[3]})
    assert str(answers(later)) == str(answers(engine.step(belief, {"wet": rows[3]})))


def test_a_belief_goes_on_with_its_own_template_alone(tmp_path: Path) -> None:
    """Saved, pickled or at hand; declared anew by the same lines it is the same."""

    def level(scale: float, table: float = 0.9) -> bmc.DynamicBayesNet:
        dbn = bmc.DynamicBayesNet()
        dbn.table("s", ["s_prev"], [[table, 1 - table], [0.2, 0.8]], initial=[0.5, 0.5])
        dbn.add("x", lambda x_prev: bmc.Normal(x_prev, scale), initial=bmc.Normal(0.0, 1.0))
        dbn.add("y", lambda x, s: bmc.Normal(x + s, 0.5))
        return dbn

    engine = bmc.ParticleFilter(50)
    belief = engine.step(engine.start(level(1.0), rng=0), {"y": 0.3})
    belief.save(tmp_path / "belief.nc")
    kept = [bmc.load(tmp_path / "belief.nc"), pickle.loads(pickle.dumps(belief)), belief]
    kept.append(pickle.loads(pickle.dumps(kept[0])))  # on its way twice
    wanted = engine.step(belief, {"y": 1.0}).mean("x")
    for one in kept:
        again = engine.start(level(1.0), belief=one)
        assert engine.step(again, {"y": 1.0}).mean("x") == wanted
        for other, what in (
            (level(2.0), "the density of node 'x' is another one"),
            (level(1.0, 0.7), "the table of 's'"),
        ):
            with pytest.raises(ModelError, match=f"in later slices {what}"):
                engine.start(other, belief=one)


def test_paths_that_cannot_be_written_are_told_apart(tmp_path: Path) -> None:
    found = bmc.infer(net_of(), SEEN, engine=bmc.Exact())
    for path, words in (
        (tmp_path / "none" / "a.nc", "there is no folder .*none; make it"),
        (tmp_path, "that is a folder; give the path of a file"),
    ):
        with pytest.raises(CheckpointError, match=words):
            found.save(path)
    with pytest.raises(CheckpointError, match="there is no folder .*none; make it"):
        bmc.infer(net_of(), SEEN, engine=bmc.Exact(), checkpoint=tmp_path / "none" / "a.nc")
