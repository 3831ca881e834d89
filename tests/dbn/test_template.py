"""Templates: what they refuse, what they compile to, and the net and trajectories they write out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import (
    BroadcastError,
    DuplicateNodeError,
    EvidenceError,
    ModelError,
    ParameterError,
    PlateError,
    UnknownNodeError,
    UnsupportedError,
)


def umbrella() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet("umbrella world")
    dbn.table("rain", ["rain_prev"], [[0.7, 0.3], [0.3, 0.7]], ("no", "yes"), initial=[0.5, 0.5])
    dbn.table("umbrella", ["rain"], [[0.8, 0.2], [0.1, 0.9]], ("no", "yes"))
    return dbn


def robot() -> bmc.DynamicBayesNet:
    """Controls, beacons in a plate, a static bias, time in a noise, a computed node, a parent's past."""
    dbn = bmc.DynamicBayesNet("robot", plates={"beacon": 2})
    dbn.input("u")
    dbn.add_static("bias", bmc.Normal(0.0, 0.1))

    @dbn.node(initial=bmc.Normal(0.0, 1.0))
    def x(x_prev, u, u_prev, t):
        return bmc.Normal(x_prev + u + 0.1 * u_prev, 0.5 + 0.1 * t)

    @dbn.node
    def speed(x, u):
        return x * u

    @dbn.node(plates="beacon", initial=lambda x, bias: bmc.Normal(x + bias, 1.0))
    def distance(x, x_prev, bias):
        return bmc.Normal(0.5 * (x + x_prev) + bias, 1.0)

    return dbn


def test_the_example_of_the_textbook() -> None:
    """Russell and Norvig, Artificial Intelligence, 3rd ed. (2010), sec. 15.2: .818, .883, smoothed .883."""
    dbn = umbrella()
    rows = {"umbrella": ["yes", "yes"]}
    posterior = bmc.infer(dbn.unroll(2), dbn.unrolled_evidence(rows))
    assert posterior.probabilities("rain[1]")[1] == pytest.approx(0.883, abs=5e-4)
    assert posterior.probabilities("rain[0]")[1] == pytest.approx(0.883, abs=5e-4)
    alone = bmc.infer(dbn.unroll(1), {"umbrella[0]": "yes"})
    assert alone.probabilities("rain[0]")[1] == pytest.approx(0.818, abs=5e-4)


def test_unrolled_densities_are_the_slices_put_together() -> None:
    """By hand, with inputs, inputs of the slice before, time, a static node and a plate."""
    dbn, u = robot(), np.array([0.5, -1.0, 2.0])
    net = dbn.unroll(3, {"u": u})
    rng = np.random.default_rng(0)
    x, bias, distance = rng.normal(size=3), 0.05, rng.normal(size=(3, 2))
    values = {"bias": bias, **{f"x[{t}]": x[t] for t in range(3)}}
    values |= {f"distance[{t}]": distance[t] for t in range(3)}

    def normal(v: Any, loc: Any, scale: Any) -> float:
        return float(bmc.Normal(loc, scale).log_prob(v).sum())

    expected = normal(bias, 0.0, 0.1) + normal(x[0], 0.0, 1.0)
    expected += normal(distance[0], x[0] + bias, 1.0)
    for t in (1, 2):
        expected += normal(x[t], x[t - 1] + u[t] + 0.1 * u[t - 1], 0.5 + 0.1 * t)
        expected += normal(distance[t], 0.5 * (x[t] + x[t - 1]) + bias, 1.0)
    assert float(net.log_prob(values)) == pytest.approx(expected, abs=1e-12)
    open_inputs = dbn.unroll(3)
    given = {f"u[{t}]": u[t] for t in range(3)}
    assert float(open_inputs.log_prob(values, inputs=given)) == pytest.approx(expected, abs=1e-12)


def test_names_and_order_of_an_unrolled_net() -> None:
    net = robot().unroll(2, {"u": [0.0, 1.0]})
    names = ["bias", "u[0]", "x[0]", "speed[0]", "distance[0]"]
    assert list(net) == [*names, "u[1]", "x[1]", "speed[1]", "distance[1]"]
    assert net["distance[1]"].parents == ("x[1]", "x[0]", "bias")
    assert net["distance[1]"].plates == ("beacon",)
    net.validate()


def test_trajectories_have_the_moments_of_the_unrolled_net() -> None:
    """Means and spreads of 20,000 draws within 5 standard errors (two-sided 6e-7 each, 2e-5 in all)."""
    dbn, u, n = robot(), np.array([0.5, -1.0, 2.0, 0.1]), 20_000
    draws = dbn.sample(4, n, inputs={"u": u}, rng=3)
    assert draws["x"].shape == (n, 4) and draws["distance"].shape == (n, 4, 2)
    assert draws["bias"].shape == (n,) and "u" not in draws
    exact = bmc.infer(dbn.unroll(4, {"u": u}), engine=bmc.Exact())
    for t in range(4):
        for name, values in (("x", draws["x"]), ("distance", draws["distance"])):
            mean, sd = exact.mean(f"{name}[{t}]"), exact.std(f"{name}[{t}]")
            assert np.all(np.abs(values[:, t].mean(axis=0) - mean) < 5 * sd / np.sqrt(n))
            assert np.all(np.abs(values[:, t].std(axis=0) / sd - 1) < 5 / np.sqrt(2 * n))
    np.testing.assert_allclose(draws["speed"], draws["x"] * u)


def test_trajectories_of_labels_and_the_same_seed() -> None:
    dbn = umbrella()
    one, two = (dbn.sample(6, 4, rng=7) for _ in range(2))
    assert np.array_equal(one["rain"].codes, two["rain"].codes)
    assert set(np.unique(one["rain"].labels)) <= {"no", "yes"}
    agree = (dbn.sample(1, 50_000, rng=1)["rain"] == "yes").mean()
    assert abs(agree - 0.5) < 5 * 0.5 / np.sqrt(50_000)


def test_rows_that_are_missing_are_left_out_of_the_evidence() -> None:
    dbn = robot()
    gaps = np.ma.masked_array(np.ones((3, 2)), [[0, 0], [1, 1], [0, 1]])
    evidence = dbn.unrolled_evidence({"distance": gaps, "x": [None, 1.0, np.nan], "bias": 0.1})
    assert set(evidence) == {"distance[0]", "distance[2]", "x[1]", "bias"}
    assert evidence["bias"] == 0.1 and np.ma.getmaskarray(evidence["distance[2]"]).tolist() == [
        False,
        True,
    ]


def test_time_may_be_an_array() -> None:
    """A function of t that broadcasts is called with whole numbers in every slice."""
    seen = []
    dbn = bmc.DynamicBayesNet()

    @dbn.node(initial=bmc.Normal(0.0, 1.0))
    def x(x_prev, t):
        seen.append(np.asarray(t).dtype.kind)
        return bmc.Normal(np.where(t > 1, x_prev, -x_prev), 1.0)

    dbn.sample(4, 10, rng=0)
    dbn.unroll(4).validate()
    assert set(seen) == {"i"}


def test_a_copy_does_not_see_later_declarations() -> None:
    dbn = umbrella()
    other = dbn.copy()
    dbn.add("mood", lambda rain: bmc.Normal(np.where(rain == "yes", -1.0, 1.0), 1.0))
    assert "mood" in dbn and "mood" not in other and list(other) == ["rain", "umbrella"]


def test_a_declaration_may_be_replaced() -> None:
    dbn = umbrella()
    with pytest.raises(DuplicateNodeError, match="'rain' is declared already"):
        dbn.add("rain", bmc.Bernoulli(0.3))
    dbn.add("rain", bmc.Bernoulli(0.3), states=("no", "yes"), replace=True)
    assert dbn["rain"].parents == () and dbn.unroll(2)["rain[1]"].parents == ()


def test_the_picture_of_two_slices() -> None:
    graph = robot().graph
    where = {name: data["slice"] for name, data in graph.nodes(data=True)}
    assert where == {
        "u": "now", "u_prev": "prev", "bias": "static", "x": "now", "x_prev": "prev",
        "speed": "now", "distance": "now",
    }  # fmt: skip
    assert set(graph.predecessors("distance")) == {"x", "x_prev", "bias"}
    assert "t" not in graph


def changing() -> bmc.DynamicBayesNet:
    """Whether a state changed: never in slice 0; and how often so far, which has no end."""
    dbn = bmc.DynamicBayesNet()
    dbn.table("z", ["z_prev"], [[0.8, 0.2], [0.3, 0.7]], initial=[0.5, 0.5])
    dbn.add("change", lambda z, z_prev: (z != z_prev) * 1, initial=lambda z: 0 * z)
    dbn.add("count", lambda count_prev, z: count_prev + z, initial=lambda z: z)
    dbn.add("y", lambda z, change, count: bmc.Normal(z + 2.0 * change + 0.1 * count, 1.0))
    return dbn


def test_computed_nodes_with_other_values_in_slice_zero() -> None:
    """Their values are counted together, or not at all; 100,000 particles against exact answers, to 0.01."""
    dbn, rows = changing(), [0.3, 1.5, 2.0, 2.8]
    filtered = bmc.filter(dbn, {"y": rows}, engine=bmc.ParticleFilter(100_000), rng=0)
    for t in range(4):
        evidence = dbn.unrolled_evidence({"y": rows[: t + 1]})
        exact = bmc.infer(dbn.unroll(t + 1), evidence, engine=bmc.Exact())
        for name in ("z", "change", "count"):
            assert abs(filtered.mean(name)[t] - exact.mean(f"{name}[{t}]")) < 0.01, (name, t)
    draws = dbn.sample(5, 100, rng=1)
    assert (draws["change"][:, 0] == 0).all() and (draws["count"] == draws["z"].cumsum(1)).all()
    assert (draws["change"][:, 1:] == (np.diff(draws["z"]) != 0)).all()


def test_computed_static_nodes() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("a", bmc.Normal(0.0, 1.0))
    dbn.add_static("double", lambda a: 2 * a)
    dbn.add(
        "x", lambda x_prev, double: bmc.Normal(x_prev + double, 1e-3), initial=bmc.Normal(0.0, 1e-3)
    )
    rows = {"a": 1.5, "x": [0.0, None, None]}
    filtered = bmc.filter(dbn, rows, engine=bmc.ParticleFilter(50), rng=0)
    np.testing.assert_allclose(filtered.mean("x"), [0.0, 3.0, 6.0], atol=0.01)


# ---- what is refused ----------------------------------------------------------------------------

NORMAL = bmc.Normal(0.0, 1.0)


def _add(*arguments: Any, **options: Any) -> Callable[[bmc.DynamicBayesNet], None]:
    return lambda dbn: dbn.add(*arguments, **options)


FAULTS: dict[str, tuple[Callable[[bmc.DynamicBayesNet], Any], type[Exception], str]] = {
    "no initial": (
        _add("x", lambda x_prev: bmc.Normal(x_prev, 1.0)), ModelError,
        "node 'x' reads 'x_prev', which slice 0 does not have; give its density there, initial=",
    ),
    "initial reads the past": (
        _add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=lambda x_prev: NORMAL),
        ModelError, "initial= reads 'x_prev', but before slice 0 there is no slice",
    ),
    "unknown parent": (
        _add("y", lambda xs: bmc.Normal(xs, 1.0)), UnknownNodeError, "has the parent 'xs'",
    ),
    "unknown past": (
        _add("y", lambda z_prev: bmc.Normal(z_prev, 1.0), initial=NORMAL), UnknownNodeError,
        "has the parent 'z_prev'",
    ),
    "unknown in initial": (
        _add("y", lambda y_prev: bmc.Normal(y_prev, 1.0), initial=lambda q: bmc.Normal(q, 1.0)),
        UnknownNodeError, "initial= has the parent 'q'",
    ),
    "named t": (_add("t", NORMAL), ModelError, "'t' is the index of the slice"),
    "named prev": (_add("x_prev", NORMAL), ModelError, "names that end in '_prev'"),
    "a cycle": (
        lambda dbn: (dbn.add("a", lambda b: bmc.Normal(b, 1.0)), dbn.add("b", lambda a: bmc.Normal(a, 1.0))),
        ModelError, "a -> b -> a|b -> a -> b",
    ),
    "other shape at first": (
        _add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.MvNormal([0.0, 0.0], np.eye(2))),
        ModelError, "node 'x'",
    ),
    "other states at first": (
        lambda dbn: dbn.table("z", ["z_prev"], [[0.9, 0.1], [0.2, 0.8]], initial=[0.2, 0.3, 0.5]),
        ModelError, "z",
    ),
    "another kind at first": (
        _add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Bernoulli(0.5)), ModelError,
        "initial= gives values on 2 states",
    ),
    "static reads a slice": (
        lambda dbn: (dbn.add("x", NORMAL), dbn.add_static("s", lambda x: bmc.Normal(x, 1.0))),
        ModelError, "static node 's' has the parent 'x'",
    ),
    "past of a static": (
        lambda dbn: (dbn.add_static("s", NORMAL),
                     dbn.add("x", lambda s_prev: bmc.Normal(s_prev, 1.0), initial=NORMAL)),
        ModelError, "'s' is static; it is the same in every slice, so name it 's'",
    ),
    "unknown plate": (
        _add("x", NORMAL, plates="row"), PlateError, r"node 'x' is in plate 'row'.*DynamicBayesNet\(plates=",
    ),
    "mixes draws": (
        _add("x", lambda x_prev: bmc.Normal(x_prev - np.mean(x_prev), 1.0), initial=NORMAL),
        BroadcastError, "node 'x'",
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_name_the_node_and_the_remedy(fault: str) -> None:
    declare, error, message = FAULTS[fault]
    dbn = bmc.DynamicBayesNet()
    with pytest.raises(error, match=message):
        declare(dbn)
        dbn.validate()


@pytest.mark.parametrize(
    ("initial", "error", "message"),
    [
        (np.array([1.0, 1.0, 0.0]), ParameterError, "the probabilities of a finite node"),
        (np.array([[0.5, 0.5], [0.2, 0.8]]), ModelError, "that reads no other; for others give"),
        ({"mean": 0.0}, ModelError, "initial= is of type dict; give the density of slice 0"),
    ],
)
def test_starts_that_are_no_densities(initial: Any, error: type[Exception], message: str) -> None:
    dbn = bmc.DynamicBayesNet()
    with pytest.raises(error) as caught:
        dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=initial)
    told = [str(caught.value), *getattr(caught.value, "__notes__", [])]
    assert message in " ".join(told)


BAD_DATA: dict[str, tuple[Callable[[bmc.DynamicBayesNet], Any], type[Exception], str]] = {
    "an input observed": (
        lambda d: bmc.filter(d, {"u": [1.0]}, inputs={"u": [1.0]}), EvidenceError,
        "observations of 'u', which is an input; give it with inputs=",
    ),
    "an unknown node": (lambda d: bmc.filter(d, {"z": [1.0]}), EvidenceError, "no node 'z'"),
    "no time": (
        lambda d: bmc.filter(d, {"x": 1.0}, inputs={"u": [0.0]}), EvidenceError,
        "'x': 1.0 has no axis for time",
    ),
    "ragged rows": (
        lambda d: bmc.filter(d, {"x": [1.0, 2.0, [3.0, 4.0]]}, inputs={"u": [0.0] * 3}), EvidenceError,
        r"observations of 'x': row 2 is of shape \(2,\), others are of shape \(\); .*a missing row is None",
    ),
    "an input that is None": (
        lambda d: bmc.filter(d, {"x": [1.0, None]}, inputs={"u": [0.0, None]}), EvidenceError,
        "inputs of 'u': row 1 is None, .*an input is known in every slice",
    ),
    "other lengths": (
        lambda d: bmc.filter(d, {"x": [1.0, 2.0]}, inputs={"u": [0.0]}), EvidenceError,
        "differ in length .'x' 2, 'u' 1.; row k belongs to slice k",
    ),
    "no inputs": (lambda d: bmc.filter(d, {"x": [1.0]}), EvidenceError, "input 'u' has no values"),
    "inputs missing": (
        lambda d: bmc.filter(d, {"x": [1.0, 2.0]}, inputs={"u": [0.0, np.nan]}), EvidenceError,
        "input 'u' is nan at index .*must be finite, also where observations are missing",
    ),
    "an unknown input": (
        lambda d: bmc.filter(d, {"x": [1.0]}, inputs={"v": [0.0]}), EvidenceError,
        r"inputs= gives 'v'.*the inputs are \['u'\]",
    ),
    "a computed node": (
        lambda d: bmc.filter(d, {"speed": [1.0], "bias": 0.0}, inputs={"u": [0.0]},
                             engine=bmc.ParticleFilter(10)),
        UnsupportedError, "density of 'speed', which has none",
    ),
    "a list": (lambda d: bmc.filter(d, [1.0]), EvidenceError, "observations is a list"),
    "a wrong shape": (
        lambda d: bmc.filter(d, {"distance": [[1.0, 2.0, 3.0]]}, inputs={"u": [0.0]}),
        EvidenceError, r"'distance' has shape \(1, 3\).*time=1, beacon=2",
    ),
    "nothing": (lambda d: bmc.filter(d, {}), EvidenceError, "no observations and no inputs"),
    "steps": (lambda d: d.unroll(0), ValueError, r"unroll\(steps=0\): steps is a number of slices"),
    "draws": (lambda d: d.sample(2, -1, inputs={"u": [0.0, 0.0]}), ValueError, "number of draws"),
}  # fmt: skip


@pytest.mark.parametrize("fault", BAD_DATA)
def test_bad_data_name_the_call_and_the_remedy(fault: str) -> None:
    ask, error, message = BAD_DATA[fault]
    with pytest.raises(error, match=message):
        ask(robot())


def test_the_size_of_an_open_plate_comes_with_the_data() -> None:
    dbn = bmc.DynamicBayesNet(plates={"sensor": None})
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=NORMAL)
    dbn.add("y", lambda x: bmc.Normal(x, 1.0), plates="sensor")
    filtered = bmc.filter(dbn, {"y": np.zeros((3, 5))}, engine=bmc.ParticleFilter(100), rng=0)
    assert filtered.model.sizes == {"sensor": 5}
    with pytest.raises(PlateError, match="the size of plate 'sensor' is not known"):
        bmc.filter(dbn, {"x": [0.0]}, engine=bmc.ParticleFilter(100))
