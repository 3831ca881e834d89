"""Labels of components that the model does not tell apart: no alarm where only they switch, else an alarm."""

from __future__ import annotations

import pickle
import warnings
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import ConvergenceWarning, UnsupportedError
from bayesmc.network import pose
from bayesmc.results.relabelling import symmetries

RNG = np.random.default_rng(5)
DATA = np.concatenate([RNG.normal(-3.0, 0.7, 40), RNG.normal(3.0, 0.7, 20)])


def mixture(prior: Any = (0.0, 0.0)) -> bmc.BayesNet:
    """Two clusters; with unlike priors they have names of their own."""
    net = bmc.BayesNet(plates={"cluster": 2, "point": 60})
    net.add("weights", bmc.Dirichlet(np.ones(2)))
    net.add("mean", bmc.Normal(np.array(prior), 10.0), plates="cluster")
    net.add("precision", bmc.Gamma(2.0, 1.0), plates="cluster")
    net.add("label", lambda weights: bmc.Categorical(weights), plates="point")
    net.add(
        "x",
        lambda label, mean, precision: bmc.Normal(mean[label], 1 / np.sqrt(precision[label])),
        plates="point",
    )
    return net


def vectors() -> bmc.BayesNet:
    """The same without a plate of components, and without labels."""
    net = bmc.BayesNet(plates={"point": 60})
    net.add("mean", bmc.MvNormal(np.zeros(2), scale_diag=np.full(2, 5.0)))
    net.add("x", lambda mean: bmc.Mixture([0.5, 0.5], bmc.Normal(mean, 0.7)), plates="point")
    return net


def markov() -> bmc.BayesNet:
    """A hidden Markov chain with unknown transitions: rows and columns change places together."""
    net = bmc.BayesNet(plates={"state": 2})
    net.add("rows", bmc.Dirichlet(np.ones(2)), plates="state")
    net.add("level", bmc.Normal(0.0, 5.0), plates="state")
    net.add("z0", bmc.Categorical([0.5, 0.5]))
    for t in range(6):
        if t:
            net.add(
                f"z{t}", lambda rows, z: bmc.Categorical(rows[z]), parents=["rows", f"z{t - 1}"]
            )
        net.add(f"y{t}", lambda level, z: bmc.Normal(level[z], 1.0), parents=["level", f"z{t}"])
    return net


def asked(net: bmc.BayesNet, data: Any, engine: Any) -> tuple[Any, list[str]]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", ConvergenceWarning)
        posterior = bmc.infer(net, data, engine=engine, rng=1)
    return posterior, [str(w.message) for w in caught]


@pytest.mark.parametrize("chains", [4, 8])
def test_labels_that_switch_are_no_alarm(chains: int) -> None:
    posterior, warned = asked(mixture(), {"x": DATA}, bmc.Gibbs(500, 200, chains))
    assert posterior.rhat("mean").max() > 1.1  # the case is there
    assert warned == []
    assert "plate 'cluster'" in posterior.label_switching
    assert "relabelled('mean')" in str(posterior.summary(["mean"]))
    named = posterior.relabelled("mean")
    np.testing.assert_allclose(named.mean("mean"), [-3.0, 3.0], atol=0.5)
    np.testing.assert_allclose(named.mean("weights"), [2 / 3, 1 / 3], atol=0.1)
    np.testing.assert_array_equal(named.mean("label").round(), np.repeat([0, 1], [40, 20]))
    for name in ("mean", "weights", "precision"):
        assert named.rhat(name).max() < 1.02
    assert named.expectation(lambda mean, label: mean[label], plates="point").shape == (60,)
    np.testing.assert_allclose(  # what does not depend on names is the same
        named.expectation(lambda mean: mean.sum(axis=-1)),
        posterior.expectation(lambda mean: mean.sum(axis=-1)),
    )
    assert pickle.loads(pickle.dumps(posterior)).label_switching == posterior.label_switching


def test_what_is_sorted_before_it_is_read_is_exchanged_alone() -> None:
    """Means in order have names, and so have the scales beside them; what they were sorted from has none."""
    net = bmc.BayesNet(plates={"cluster": 2, "point": 60})
    net.add("free", bmc.Normal(0.0, 10.0), plates="cluster")
    net.add("scale", bmc.HalfNormal(2.0), plates="cluster")
    net.add("mean", lambda free: np.sort(free.array, axis=-1))
    net.add(
        "x",
        lambda mean, scale: bmc.Mixture([0.5, 0.5], bmc.Normal(mean, scale.array)),
        plates="point",
    )
    values = {"free": np.array([[3.0, -3.0]]), "scale": np.array([[0.7, 0.9]]), "x": DATA[None]}
    (found,) = symmetries(pose(net, {"x": DATA}), values)
    assert (found.plate, tuple(found.axes)) == ("cluster", ("free",))


def test_components_without_a_plate() -> None:
    posterior, warned = asked(vectors(), {"x": DATA}, bmc.Gibbs(300, 150, 6))
    named = posterior.relabelled("mean")
    np.testing.assert_allclose(named.mean("mean"), [-3.0, 3.0], atol=0.5)
    assert not warned  # whether chains keep to one order of the components, or change it


def test_rows_and_columns_of_a_chain() -> None:
    data = {f"y{t}": v for t, v in enumerate([-3.0, -3.2, 3.1, 2.9, 3.0, -2.8])}
    posterior, _ = asked(markov(), data, bmc.Gibbs(100, 50, 4))
    (found,) = symmetries(pose(markov(), data), posterior.checkpoint.values)
    assert found.axes == {"rows": (-2, -1), "level": (-1,)}
    assert found.labels == {f"z{t}" for t in range(6)}
    named = posterior.relabelled("level")
    assert (np.diff(named["level"], axis=-1) >= 0).all()
    z, level = posterior["z2"], posterior["level"]
    at = np.take_along_axis(level, np.asarray(z)[..., None].astype(int), -1)
    again = np.take_along_axis(named["level"], np.asarray(named["z2"])[..., None].astype(int), -1)
    np.testing.assert_array_equal(at, again)  # the level of a slice has no name
    stay = np.take_along_axis(
        np.take_along_axis(posterior["rows"], np.asarray(z)[..., None, None].astype(int), -2),
        np.asarray(z)[..., None, None].astype(int), -1,
    )  # fmt: skip
    z = np.asarray(named["z2"])[..., None, None].astype(int)
    np.testing.assert_array_equal(
        stay, np.take_along_axis(np.take_along_axis(named["rows"], z, -2), z, -1)
    )


# ---- where an alarm is right ----------------------------------------------------------------------


def test_components_with_names_of_their_own() -> None:
    """A prior that tells them apart: chains that differ have not mixed."""
    net = mixture((-1.0, 1.0))
    for seed in range(20):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", ConvergenceWarning)
            posterior = bmc.infer(net, {"x": DATA}, engine=bmc.Gibbs(100, 50, 8), rng=seed)
        if posterior.rhat("mean").max() > 1.1:
            break
    assert posterior.rhat("mean").max() > 1.1 and any("not mixed" in str(w.message) for w in caught)
    assert posterior.label_switching is None
    with pytest.raises(UnsupportedError, match=r"relabelled\('mean'\)"):
        posterior.relabelled("mean")


def test_chains_that_differ_in_more_than_names() -> None:
    """Steps too small to get anywhere: every chain is where it started."""
    walk = {n: bmc.RandomWalk(1e-4) for n in ("mean", "precision")}
    engine = bmc.MetropolisHastings(200, 0, 4, proposal=walk)
    posterior, warned = asked(mixture(), {"x": DATA}, engine)
    assert any("named by the order of 'mean', the chains have not mixed" in w for w in warned)
    assert posterior.label_switching is None


def test_labels_of_components_are_shown_and_others_are_not_named_by_an_order() -> None:
    """A scale above components that the data do not tell apart, in a funnel: the fault is the scale's."""
    net = bmc.BayesNet(plates={"who": ["ann", "bob", "cy"]})
    net.add("v", bmc.Normal(0.0, 3.0))
    net.add("x", lambda v: bmc.Normal(0.0, np.exp(v / 2)), plates="who")
    net.add("y", lambda x: bmc.StudentT(3.0, x, 1.0), plates="who")
    _, warned = asked(net, {"y": np.zeros(3)}, bmc.Gibbs(60, 20))
    of_scale = [w for w in warned if "'v'" in w]
    assert of_scale and not any("order" in w for w in of_scale)
    net = bmc.BayesNet(plates={"who": ["ann", "bob", "cy"]})
    net.add("x", bmc.Normal(0.0, 3.0), plates="who")
    net.potential("sum", lambda x: -0.5 * x.sum("who") ** 2)
    engine = bmc.MetropolisHastings(60, 0, 4, proposal={"x": bmc.RandomWalk(1e-4)})
    _, warned = asked(net, {}, engine)
    assert any("of plate 'who' (ann, bob, cy) named by the order of 'x'" in w for w in warned)


def test_groups_with_data_have_names() -> None:
    net = bmc.BayesNet(plates={"group": 3})
    net.add("effect", bmc.Normal(0.0, 1.0), plates="group")
    net.add("y", lambda effect: bmc.Normal(effect, 1.0), plates="group")
    posterior, _ = asked(net, {"y": [0.0, 1.0, 2.0]}, bmc.Gibbs(50, 20, 4))
    with pytest.raises(UnsupportedError, match="no components"):
        posterior.relabelled("effect")


# ---- what is computed from components -------------------------------------------------------------


@pytest.mark.parametrize("keep", ["draws", ["mean", "twice", "own", "gap"]])
def test_computed_nodes_follow_their_components(keep: Any) -> None:
    """In the plate of the components, in that of the points (through labels), and of both in turn."""
    net = mixture()
    net.add("twice", lambda mean: 2.0 * mean, plates="cluster")
    net.add("thrice", lambda twice, mean: twice + mean, plates="cluster")
    net.add("own", lambda label, mean: mean[label], plates="point")
    net.add("gap", lambda mean: mean[1] - mean[0])
    engine = bmc.Gibbs(200, 100, 6)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        posterior = bmc.infer(net, {"x": DATA}, engine=engine, rng=1, keep=keep)
    named = posterior.relabelled("mean")
    assert (posterior["mean"] != named["mean"]).any()  # the case is there
    np.testing.assert_array_equal(named["twice"], 2.0 * named["mean"])
    np.testing.assert_array_equal(named["gap"], np.diff(named["mean"], axis=-1)[..., 0])
    assert (named["gap"] > 0).all() and (posterior["gap"] < 0).any()
    if keep == "draws":
        np.testing.assert_array_equal(named["thrice"], 3.0 * named["mean"])
        np.testing.assert_array_equal(named["own"], posterior["own"])  # a point's mean has no name
    else:  # computed from labels, which were not kept
        assert "own" not in named.names
        with pytest.raises(UnsupportedError, match="'own'"):
            named.mean("own")
