"""Factor graphs: declaring them, what is refused, blankets, log densities and full conditionals.

Everything is held against brute force: sums over all configurations, textbook formulas or a fine grid.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy import stats

import bayesmc as bmc
from bayesmc import errors
from bayesmc.network.factor_scope import factor_scopes
from bayesmc.structure import core_size

NAN = float("nan")


def pairs_of(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Both ends of every edge of a grid, in flat positions."""
    g = np.arange(height * width).reshape(height, width)
    ends = [(g[:, :-1], g[:, 1:]), (g[:-1], g[1:])]
    return tuple(np.concatenate([e[k].ravel() for e in ends]) for k in (0, 1))


def ising(height: int, width: int, coupling: float = 0.4, field: Any = None) -> bmc.FactorGraph:
    graph = bmc.FactorGraph("ising", plates={"site": height * width})
    graph.variable("s", (-1, 1), plates="site")
    graph.factor(lambda a, b: coupling * a * b, scope=("s", "s"), index=pairs_of(height, width))
    if field is not None:
        sites = np.arange(height * width)
        graph.factor(lambda s: field * s, scope="s", index=(sites,), name="pixels")
    return graph


# ---- declaring ----------------------------------------------------------------------------------


def test_records_say_what_was_declared() -> None:
    graph = bmc.FactorGraph("odd", plates={"site": 4, "kind": ["a", "b"]})
    graph.variable("colour", ("red", "green", "blue"), plates="site")
    graph.variable("spin", (-1, 1), plates=("kind", "site"))
    graph.variable("count", 5)
    graph.variable("scale", "positive")
    graph.variable("w", "simplex", event_shape=(3,))
    graph.variable("v", "real", event_shape=2)
    graph.variable("die", bmc.DiscreteUniform(1, 6).support)
    found = graph.variables
    assert list(found) == ["colour", "spin", "count", "scale", "w", "v", "die"]
    assert found["colour"].states == ("red", "green", "blue")
    assert found["spin"].states == (-1, 1) and found["spin"].size == 8
    assert found["spin"].plates == ("kind", "site")
    assert found["count"].states == (0, 1, 2, 3, 4)
    assert found["scale"].states is None and found["scale"].support.describe() == "numbers > 0"
    assert found["w"].event_shape == (3,) and found["v"].event_shape == (2,)
    assert found["v"].support.kind == "real vector"
    assert found["die"].states == (1, 2, 3, 4, 5, 6)
    assert graph.plates == {"site": 4, "kind": 2}
    assert graph.factors == ()
    with pytest.raises(TypeError):
        found["new"] = None  # type: ignore[index]


def test_a_batch_of_factors_is_one_potential() -> None:
    graph = ising(5, 7, field=np.ones(35))
    model = graph.model()
    assert list(model.potentials) == ["factor_0", "pixels"]
    potential, _ = model.potentials["factor_0"]
    assert potential.scope == ("s", "s") and potential.rows == 58
    np.testing.assert_array_equal(potential.index, pairs_of(5, 7))
    assert [(f.name, f.rows, f.scope, f.kind, f.plates) for f in graph.factors] == [
        ("factor_0", 58, ("s",), "potential", ()),
        ("pixels", 35, ("s",), "potential", ()),
    ]
    assert model["s"].declaration.source == "variable"


def test_a_potential_with_an_index_gives_one_log_factor_per_row() -> None:
    graph = ising(2, 3, coupling=0.5)
    stored = np.array([[0, 1, 1, 0, 0, 1], [1, 1, 1, 1, 1, 1]], dtype=np.uint8)
    model = graph.model()
    rows = model.potential("factor_0", {"s": stored}, total=False)
    spins = 2.0 * stored - 1
    i, j = pairs_of(2, 3)
    np.testing.assert_allclose(rows, 0.5 * spins[:, i] * spins[:, j])
    np.testing.assert_allclose(model.potential("factor_0", {"s": stored}), rows.sum(axis=-1))
    one_end = model.potential_at("factor_0", [np.array([[[0]], [[1]]]), stored[:, j]])
    np.testing.assert_allclose(one_end[0], -0.5 * spins[:, j])
    np.testing.assert_allclose(one_end[1], 0.5 * spins[:, j])


def test_a_large_grid_is_declared_and_asked_in_array_time() -> None:
    height = width = 256
    start = time.perf_counter()
    graph = ising(height, width, field=np.linspace(-1, 1, height * width))
    spins = np.random.default_rng(0).choice([-1, 1], size=height * width)
    value = float(graph.log_prob({"s": spins}))
    blanket = graph.markov_blanket("s", 257 * 3)
    assert time.perf_counter() - start < 5.0  # a Python loop over rows takes far longer
    i, j = pairs_of(height, width)
    field = np.linspace(-1, 1, height * width)
    assert value == pytest.approx(0.4 * (spins[i] * spins[j]).sum() + (field * spins).sum())
    assert {at for _, (at,) in blanket} == {771 - 256, 771 + 256, 770, 772}


def test_what_a_user_passes_in_is_not_kept() -> None:
    i, j = (a.copy() for a in pairs_of(2, 2))
    table = np.array([[1.0, 0.0], [0.0, 1.0]])
    graph = bmc.FactorGraph(plates={"site": 4})
    graph.variable("s", 2, plates="site")
    graph.factor(table, scope=("s", "s"), index=(i, j))
    before = graph.log_prob({"s": [0, 0, 0, 0]})
    i[:], table[:] = 0, 9.0
    assert graph.log_prob({"s": [0, 0, 0, 0]}) == before == 4.0


def test_functions_receive_user_values() -> None:
    seen: dict[str, Any] = {}

    def look(colour: Any, spin: Any, x: Any) -> Any:
        seen.update(colour=colour == "green", spin=spin, shape=(np.shape(spin), np.shape(x)))
        return np.where(colour == "green", spin * x.sum(axis=-1), 0.0)

    graph = bmc.FactorGraph(plates={"site": 3})
    graph.variable("colour", ("red", "green"), plates="site")
    graph.variable("spin", (-1, 1))
    graph.variable("x", "real", plates="site", event_shape=2)
    graph.factor(look, scope=("colour", "spin", "x"), index=([2, 0], None, [0, 1]))
    x = np.arange(6.0).reshape(3, 2)
    value = graph.log_prob({"colour": ["green", "red", "green"], "spin": -1, "x": x})
    assert seen["shape"] == ((2,), (2, 2))
    np.testing.assert_array_equal(seen["colour"], [True, True])
    np.testing.assert_array_equal(seen["spin"], [-1, -1])
    assert value == -(x[0].sum() + x[1].sum())


def test_argument_names_are_the_scope() -> None:
    graph = bmc.FactorGraph(plates={"site": 2})
    graph.variable("s", 2, plates="site")
    graph.variable("t", 2)
    graph.factor(lambda s, t: 1.0 * (s == t))
    assert graph.factors[0].scope == ("s", "t") and graph.factors[0].rows == 2
    assert graph.log_prob({"s": [1, 0], "t": 1}) == 1.0


def test_without_index_one_factor_per_element_of_all_plates() -> None:
    weights = np.arange(6.0).reshape(2, 3)
    graph = bmc.FactorGraph(plates={"v": 2, "h": 3})
    graph.variable("visible", 2, plates="v")
    graph.variable("hidden", 2, plates="h")
    graph.factor(lambda visible, hidden: weights * visible * hidden)
    assert graph.factors[0].rows == 6 and graph.factors[0].plates == ("v", "h")
    v, h = np.array([1, 1]), np.array([0, 1, 1])
    assert graph.log_prob({"visible": v, "hidden": h}) == v @ weights @ h
    assert graph.markov_blanket("visible", 0) == {("hidden", (k,)) for k in range(3)}


def test_whole_plates_in_one_factor() -> None:
    graph = bmc.FactorGraph(plates={"site": 3})
    graph.variable("s", 2, plates="site")
    graph.factor(lambda s: np.where(s.sum("site") == 2, 0.0, -np.inf), plates=())
    assert graph.factors[0].rows == 1
    assert graph.log_prob({"s": [1, 1, 0]}) == 0.0
    assert graph.log_prob({"s": [1, 1, 1]}) == -np.inf
    assert graph.markov_blanket("s", 0) == {("s", (1,)), ("s", (2,))}
    posterior = bmc.infer(graph, engine=bmc.Exact())
    np.testing.assert_allclose(posterior.mean("s"), 2 / 3)
    assert posterior.log_marginal_likelihood == pytest.approx(np.log(3))


@pytest.mark.parametrize("each", [False, True])
@pytest.mark.parametrize("how", ["index", "plates", "unplated"])
def test_tables_equal_functions(how: str, each: bool) -> None:
    rng = np.random.default_rng(4)
    rows = {"index": 2, "plates": 3, "unplated": 1}[how]
    table = rng.normal(size=(rows, 3, 2) if each and how != "unplated" else (3, 2))
    full = np.broadcast_to(table, (rows, 3, 2))
    graphs = []
    for use in ("table", "function"):
        graph = bmc.FactorGraph(plates={"site": 3})
        plates = () if how == "unplated" else "site"
        graph.variable("a", ("x", "y", "z"), plates=plates)
        graph.variable("b", (-1, 1), plates=plates)
        index = ([0, 2], [1, 1]) if how == "index" else None
        if use == "table":
            graph.factor(table, scope=("a", "b"), index=index)
        else:
            at = np.arange(rows) if how != "unplated" else 0

            def look(a: Any, b: Any, at: Any = at) -> Any:
                return full[at, np.asarray(a, dtype=int), (b + 1) // 2]

            graph.factor(look, scope=("a", "b"), index=index)
        graphs.append(graph)
    labels = np.array(["x", "y", "z"])
    lead = () if how == "unplated" else (3,)
    values = {
        "a": labels[rng.integers(0, 3, size=(5, *lead))],
        "b": rng.choice([-1, 1], size=(5, *lead)),
    }
    np.testing.assert_allclose(graphs[0].log_prob(values), graphs[1].log_prob(values))
    exact = [bmc.infer(g, engine=bmc.Exact()) for g in graphs]
    np.testing.assert_allclose(exact[0].probabilities("a"), exact[1].probabilities("a"), atol=1e-14)


# ---- what is refused ----------------------------------------------------------------------------


def graph_with(*, plated: bool = True) -> bmc.FactorGraph:
    graph = bmc.FactorGraph(plates={"site": 3, "row": 2})
    graph.variable("s", 2, plates="site" if plated else ())
    graph.variable("t", 3)
    graph.variable("g", 2, plates=("row", "site"))
    graph.variable("x", "real", plates="site")
    return graph


def flat(*arguments: Any) -> float:
    return 0.0


FAULTS: list[tuple[str, Callable[[bmc.FactorGraph], Any], type[Exception], str]] = [
    ("unknown variable", lambda g: g.factor(flat, scope=("s", "q"), index=([0], [0])),
     errors.UnknownNodeError, "'q', which is no variable of the graph .*declare it before"),
    ("no variable", lambda g: g.factor(lambda: 0.0), errors.ModelError, "over no variable"),
    ("empty scope", lambda g: g.factor(flat, scope=()), errors.ModelError, "over no variable"),
    ("name twice", lambda g: g.variable("s", 2), errors.DuplicateNodeError, "declared already"),
    ("factor named as a variable", lambda g: g.factor(flat, scope="t", name="s"),
     errors.DuplicateNodeError, "declared already"),
    ("out of range", lambda g: g.factor(flat, scope=("s", "s"), index=([0, 1], [1, 3])),
     errors.ModelError, r"entry 1\) is 3 at row 1, outside plate 'site', whose positions are 0\.\.2"),
    ("negative", lambda g: g.factor(flat, scope=("s", "s"), index=([0, -1], [1, 2])),
     errors.ModelError, r"entry 0\) is -1 at row 1"),
    ("lengths", lambda g: g.factor(flat, scope=("s", "s"), index=([0, 1], [1])),
     errors.ShapeError, "differ in length"),
    ("floats", lambda g: g.factor(flat, scope=("s", "s"), index=([0.0], [1.0])),
     errors.ModelError, "array of float64"),
    ("booleans", lambda g: g.factor(flat, scope="s", index=(np.array([True, False, True]),)),
     errors.ModelError, "array of bool"),
    ("one array for two", lambda g: g.factor(flat, scope=("s", "s"), index=np.arange(3)),
     errors.ModelError, "3 entries, but the scope has 2"),
    ("one element twice", lambda g: g.factor(flat, scope=("s", "s"), index=([0, 1], [2, 1])),
     errors.ModelError, "row 1 of index= names one element of 's' twice"),
    ("variable twice, no index", lambda g: g.factor(flat, scope=("s", "s")),
     errors.ModelError, "stands twice in its scope, so index="),
    ("index without plates", lambda g: g.factor(flat, scope="t", index=([0],)),
     errors.ModelError, "in no plate; give None"),
    ("no rows", lambda g: g.factor(flat, scope="t", index=(None,)),
     errors.ModelError, "no variable of its scope is in a plate"),
    ("one array, two plates", lambda g: g.factor(flat, scope="g", index=([0, 1, 2],)),
     errors.ModelError, "give a tuple of 2 arrays"),
    ("index and plates", lambda g: g.factor(flat, scope="s", index=([0],), plates="site"),
     errors.ModelError, "index= or plates="),
    ("unknown plate", lambda g: g.variable("new", 2, plates="column"),
     errors.PlateError, "'column', which is not declared"),
    ("no support", lambda g: g.variable("new", "sometimes"), errors.ModelError, "is not known"),
    ("no states", lambda g: g.variable("new", 0), errors.ModelError, "too few"),
    ("states twice", lambda g: g.variable("new", ("a", "a")), errors.ModelError, "twice"),
    ("mixed states", lambda g: g.variable("new", ("a", 1)), errors.ModelError, "mixes"),
    ("True as support", lambda g: g.variable("new", True), errors.ModelError, "no support"),
    ("table shape", lambda g: g.factor(np.zeros((2, 2)), scope=("s", "t")),
     errors.ShapeError, r"shape \(2, 2\), but .* \(2, 3\) or \(3, 2, 3\)"),
    ("NaN in a table", lambda g: g.factor([0.0, NAN, 1.0], scope="t"),
     errors.DensityError, r"nan at \(1,\)"),
    ("continuous table", lambda g: g.factor([0.0, 1.0], scope="x"),
     errors.ModelError, "no finite set of states"),
    ("table without scope", lambda g: g.factor([0.0, 1.0]), errors.ModelError, "needs scope="),
    ("neither function nor table", lambda g: g.factor("s*t", scope="t"),
     errors.ModelError, "neither a function nor a table"),
    ("argument count", lambda g: g.factor(lambda a: a, scope=("s", "t")),
     errors.ModelError, "lists 2 names, but the function takes 1"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("act", "kind", "words"), [f[1:] for f in FAULTS], ids=[f[0] for f in FAULTS]
)
def test_faults_are_told_where_they_are_made(
    act: Callable[[bmc.FactorGraph], Any], kind: type[Exception], words: str
) -> None:
    graph = graph_with()
    with pytest.raises(kind, match=words):
        act(graph)
    assert graph.factors == ()  # nothing half-declared is left behind


ROWS = ([0, 1], [1, 2])
RESULTS: list[tuple[str, Callable[..., Any], type[Exception], str]] = [
    ("wrong shape", lambda a, b: np.zeros(5), errors.ShapeError, r"shape \(5,\).*per row"),
    ("no rows left", lambda a, b: (a * b).sum(axis=-1), errors.ModelError, "factor_0"),
    ("NaN", lambda a, b: a * NAN, errors.DensityError, "'factor_0' is NaN"),
    ("infinity", lambda a, b: a + np.inf, errors.DensityError, "plus infinity"),
    ("booleans", lambda a, b: a == b, errors.ModelError, "booleans"),
    ("None", lambda a, b: None, errors.ModelError, "None"),
    ("a distribution", lambda a, b: bmc.Bernoulli(0.5), errors.ModelError, "not a distribution"),
    ("mixes rows", lambda a, b: a * np.flip(b, -1), errors.BroadcastError, "some rows"),
    ("mixes the batch", lambda a, b: a - np.mean(b), errors.BroadcastError, "rows|broadcast"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("function", "kind", "words"), [r[1:] for r in RESULTS], ids=[r[0] for r in RESULTS]
)
def test_wrong_results_are_told_on_first_use(
    function: Callable[..., Any], kind: type[Exception], words: str
) -> None:
    graph = graph_with()
    graph.factor(function, scope=("s", "s"), index=ROWS)
    with pytest.raises(kind, match=words):
        graph.validate()


def test_plates_need_sizes() -> None:
    with pytest.raises(errors.PlateError, match="no data will tell its size"):
        bmc.FactorGraph(plates={"site": None})  # type: ignore[dict-item]


def test_a_graph_of_a_net_takes_no_more() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.5))
    graph = net.to_factor_graph()
    with pytest.raises(errors.ModelError, match="declare it in the net"):
        graph.variable("b", 2)
    with pytest.raises(errors.ModelError, match="net.potential"):
        graph.factor(lambda a: 1.0 * a)


@pytest.mark.parametrize(
    ("ask", "kind", "words"),
    [
        (lambda g: g.log_prob({}), errors.EvidenceError, "'s' has no value"),
        (lambda g: g.log_prob({"s": [1] * 4, "q": 1}), errors.EvidenceError, "'q' is no variable"),
        (lambda g: g.log_prob({"s": [1] * 5}), errors.EvidenceError, "shape"),
        (lambda g: g.log_prob({"s": [1, 1, 1, 2]}), errors.EvidenceError, "not among"),
        (lambda g: g.log_prob([1] * 4), errors.EvidenceError, "give a dict"),
        (lambda g: g.markov_blanket("q"), errors.UnknownNodeError, "no variable"),
        (lambda g: g.markov_blanket("s", 4), errors.QueryError, "outside its plates"),
        (lambda g: g.markov_blanket("s", -1), errors.QueryError, "outside its plates"),
        (lambda g: g.markov_blanket("s", (0, 0)), errors.QueryError, "one whole number"),
        (lambda g: g.markov_blanket("s", 0.5), errors.QueryError, "one whole number"),
        (lambda g: g.full_conditional("s", {"s": [1] * 4}), errors.QueryError, "give element="),
        (lambda g: g.full_conditional("s", {}, 0), errors.EvidenceError, "'s' has no value"),
    ],
)
def test_questions_that_make_no_sense_say_so(
    ask: Callable[[bmc.FactorGraph], Any], kind: type[Exception], words: str
) -> None:
    with pytest.raises(kind, match=words):
        ask(ising(2, 2))


# ---- graphs of nets -----------------------------------------------------------------------------


def sprinkler() -> bmc.BayesNet:
    net = bmc.BayesNet("sprinkler")
    net.add("rain", bmc.Bernoulli(0.2))
    net.add("sprinkler", lambda rain: bmc.Bernoulli(0.4 - 0.3 * rain))
    net.add("wet", lambda rain, sprinkler: rain | sprinkler)
    net.add("slip", lambda wet: bmc.Bernoulli(0.05 + 0.4 * wet))
    net.add("far", lambda slip: bmc.Bernoulli(0.1 + 0.3 * slip))
    return net


def test_scopes_reach_through_deterministic_nodes() -> None:
    graph = sprinkler().to_factor_graph({"far": 1})
    assert list(graph.variables) == ["rain", "sprinkler", "slip"]
    assert {(f.name, f.scope, f.kind) for f in graph.factors} == {
        ("rain", ("rain",), "conditional"),
        ("sprinkler", ("rain", "sprinkler"), "conditional"),
        ("slip", ("rain", "sprinkler", "slip"), "conditional"),
        ("far", ("slip",), "conditional"),
    }
    assert graph.markov_blanket("rain") == {"sprinkler", "slip"}
    assert graph.markov_blanket("slip") == {"rain", "sprinkler"}
    observed = sprinkler().to_factor_graph({"slip": 1, "far": 1})
    assert observed.markov_blanket("rain") == {"sprinkler"}
    assert [f.name for f in observed.factors] == ["rain", "sprinkler", "slip"]  # far is a constant
    assert observed.markov_blanket("rain", ()) == {("sprinkler", ())}


def test_log_prob_is_that_of_the_net() -> None:
    net = sprinkler()
    for values in itertools.product((0, 1), repeat=4):
        state = dict(zip(("rain", "sprinkler", "slip", "far"), values, strict=True))
        graph = net.to_factor_graph({"far": state["far"]})
        given = {n: v for n, v in state.items() if n != "far"}
        assert graph.log_prob(given) == pytest.approx(float(net.log_prob(state)), abs=1e-14)


def test_a_mixture_counts_all_components_of_hidden_labels() -> None:
    net = bmc.BayesNet(plates={"k": 3, "i": 4})
    net.add("mean", bmc.Normal(0.0, 10.0), plates="k")
    net.add("label", bmc.Categorical([0.2, 0.3, 0.5]), plates="i")
    net.add("x", lambda label, mean: bmc.Normal(mean[label], 1.0), plates="i")
    graph = net.to_factor_graph({"x": [1.0, 2.0, 3.0, 4.0]})
    labels = {("label", (i,)) for i in range(4)}
    assert graph.markov_blanket("mean", 1) == labels | {("mean", (0,)), ("mean", (2,))}
    assert graph.markov_blanket("label", 0) == {("mean", (k,)) for k in range(3)}
    assert graph.markov_blanket("mean") == {"label", "mean"}
    assert graph.markov_blanket("label") == {"mean"}


@pytest.mark.parametrize("through", [False, True])
def test_constant_gathers_count_what_they_take(through: bool) -> None:
    school = np.array([0, 1, 1, 2, 0])
    net = bmc.BayesNet(plates={"school": 3, "pupil": 5})
    net.add("effect", bmc.Normal(0.0, 1.0), plates="school")
    if through:
        net.add("level", lambda effect: effect[school], plates="pupil")
        net.add("score", lambda level: bmc.Normal(level, 1.0), plates="pupil")
    else:
        net.add("score", lambda effect: bmc.Normal(2 * effect[school], 1.0), plates="pupil")
    graph = net.to_factor_graph({"score": [0.1, NAN, 0.3, 0.4, NAN]})
    assert graph.markov_blanket("effect", 1) == {("score", (1,))}
    assert graph.markov_blanket("effect", 0) == {("score", (4,))}
    assert graph.markov_blanket("score", 1) == {("effect", (1,))}
    assert graph.markov_blanket("effect") == {"score"}
    assert graph.variables["score"].size == 2


def test_observed_labels_are_constant_and_hidden_ones_are_not() -> None:
    net = bmc.BayesNet(plates={"k": 3, "i": 4})
    net.add("mean", bmc.Normal(0.0, 10.0), plates="k")
    net.add("label", bmc.Categorical([0.2, 0.3, 0.5]), plates="i")
    net.add("x", lambda label, mean: bmc.Normal(mean[label], 1.0), plates="i")
    graph = net.to_factor_graph({"label": [0, 1, 1, 2]})
    assert graph.markov_blanket("mean", 1) == {("x", (1,)), ("x", (2,))}
    # the control: one hidden label, and every mean may be meant
    partly = net.to_factor_graph({"label": [0, 1, 1, NAN]})
    assert ("mean", (0,)) in partly.markov_blanket("mean", 1)


@pytest.mark.parametrize(
    "use",
    [
        lambda a: a.array.sum(axis=-1),
        lambda a: a.sum("k"),
        lambda a: np.exp(a).sum("k"),
        lambda a: a[np.array(0)] + a.max("k"),
    ],
)
def test_other_uses_of_a_foreign_plate_count_as_all_of_it(use: Callable[..., Any]) -> None:
    net = bmc.BayesNet(plates={"k": 3})
    net.add("a", bmc.Normal(0.0, 1.0), plates="k")
    net.add("y", lambda a: bmc.Normal(use(a), 1.0))
    graph = net.to_factor_graph({"y": 0.5})
    assert graph.markov_blanket("a", 0) == {("a", (1,)), ("a", (2,))}


def test_an_element_that_is_gathered_alone_couples_nothing() -> None:
    net = bmc.BayesNet(plates={"k": 3})
    net.add("a", bmc.MvNormal(np.zeros(2), np.eye(2)), plates="k")
    net.add("y", lambda a: bmc.Normal(a[..., 1][1] + a[0][..., 0], 1.0))
    graph = net.to_factor_graph({"y": 0.5})
    assert graph.markov_blanket("a", 0) == {("a", (1,))}
    assert graph.markov_blanket("a", 2) == frozenset()
    assert graph.markov_blanket("a") == {"a"}


def test_blankets_agree_with_dependence_of_full_conditionals() -> None:
    """What is outside the blanket never moves a full conditional; what is inside does for some state."""
    rng = np.random.default_rng(7)
    graph = bmc.FactorGraph(plates={"i": 3, "j": 2})
    graph.variable("a", 2, plates="i")
    graph.variable("b", 3, plates=("j", "i"))
    graph.variable("c", 2)
    graph.factor(rng.normal(size=(2, 2, 3)), ("a", "b"), index=([0, 2], ([1, 0], [1, 2])))
    graph.factor(rng.normal(size=(2, 2)), ("a", "c"), index=([1], None))
    graph.factor(rng.normal(size=(2, 3, 3)), ("b", "b"), index=(([0, 0], [0, 1]), ([1, 1], [0, 2])))
    shapes = {"a": (3,), "b": (2, 3), "c": ()}
    cards = {"a": 2, "b": 3, "c": 2}
    state = {n: rng.integers(0, cards[n], size=s) for n, s in shapes.items()}
    for name, shape in shapes.items():
        for at in np.ndindex(shape):
            blanket = graph.markov_blanket(name, at)
            base = graph.full_conditional(name, state, at).probs
            for other, other_shape in shapes.items():
                for there in np.ndindex(other_shape):
                    if (other, there) == (name, at):
                        continue
                    moved = {n: np.array(v) for n, v in state.items()}
                    moved[other][there] = (moved[other][there] + 1) % cards[other]
                    probs = graph.full_conditional(name, moved, at).probs
                    assert np.allclose(probs, base, atol=1e-12) != ((other, there) in blanket)


# ---- full conditionals --------------------------------------------------------------------------


def test_finite_full_conditional_is_the_normalised_joint() -> None:
    graph = ising(2, 3, coupling=0.7, field=np.linspace(-1, 1, 6))
    rng = np.random.default_rng(1)
    state = rng.choice([-1, 1], size=(4, 6))
    for site in range(6):
        found = graph.full_conditional("s", {"s": state}, site)
        assert isinstance(found, bmc.Categorical) and found.batch_shape == (4,)
        both = np.stack([state, state], axis=1)
        both[:, 0, site], both[:, 1, site] = -1, 1
        joint = np.exp(graph.log_prob({"s": both}))
        np.testing.assert_allclose(
            found.probs, joint / joint.sum(axis=1, keepdims=True), atol=1e-13
        )


def test_independent_elements_come_at_once() -> None:
    net = bmc.BayesNet(plates={"k": 3, "i": 5})
    net.add("mean", bmc.Normal(0.0, 10.0), plates="k")
    net.add("label", bmc.Categorical([0.2, 0.3, 0.5]), plates="i")
    net.add("x", lambda label, mean: bmc.Normal(mean[label], 1.0), plates="i")
    x = np.array([-1.0, 0.2, 0.9, 3.0, 8.0])
    graph = net.to_factor_graph({"x": x})
    mean = np.random.default_rng(0).normal(size=(2, 3))
    found = graph.full_conditional("label", {"mean": mean})
    weights = np.array([0.2, 0.3, 0.5]) * np.exp(-0.5 * (x[None, :, None] - mean[:, None]) ** 2)
    np.testing.assert_allclose(found.probs, weights / weights.sum(-1, keepdims=True), atol=1e-13)
    one = graph.full_conditional("label", {"mean": mean, "label": [0] * 5}, 3)
    np.testing.assert_allclose(one.probs, found.probs[:, 3], atol=1e-14)
    with pytest.raises(errors.QueryError, match="share factor 'x'"):
        graph.full_conditional("mean", {"label": [0, 1, 2, 0, 1]})


def test_partly_observed_elements_are_certain() -> None:
    net = bmc.BayesNet(plates={"i": 3})
    net.add("p", bmc.Beta(1.0, 1.0))
    net.add("z", lambda p: bmc.Bernoulli(p), plates="i")
    graph = net.to_factor_graph({"z": [1, NAN, NAN]})
    np.testing.assert_allclose(
        graph.full_conditional("z", {"p": 0.3}).probs, [[0, 1], [0.7, 0.3], [0.7, 0.3]]
    )
    assert graph.markov_blanket("p", ()) == {("z", (1,)), ("z", (2,))}
    with pytest.raises(errors.QueryError, match="observed"):
        graph.full_conditional("z", {"p": 0.3, "z": [0, 0, 0]}, 0)
    beta = graph.full_conditional(
        "p", {"z": [0, 0, 1]}
    )  # what stands at the observed element is not read
    assert beta.mean == pytest.approx(3 / 5, abs=1e-9)
    expected = stats.beta(3, 2).var()
    assert beta.var == pytest.approx(expected, rel=1e-8)


def test_continuous_full_conditional_is_the_conjugate_one() -> None:
    net = bmc.BayesNet(plates={"k": 3, "i": 6})
    group = np.array([0, 0, 1, 1, 1, 2])
    net.add("tau", bmc.Gamma(2.0, 1.0))
    net.add("mean", bmc.Normal(1.0, 2.0), plates="k")
    net.add("x", lambda mean, tau: bmc.Normal(mean[group], 1 / np.sqrt(tau)), plates="i")
    x = np.array([100.0, 100.5, -3.0, -2.0, 0.0, 1.0])
    graph = net.to_factor_graph({"x": x})
    tau = np.array([0.5, 40.0])
    found = graph.full_conditional("mean", {"tau": tau})
    count = np.bincount(group)
    precision = 1 / 4 + tau[:, None] * count
    centre = (1 / 4 + tau[:, None] * np.bincount(group, x)) / precision
    assert found.batch_shape == (2, 3)
    np.testing.assert_allclose(found.mean, centre, rtol=1e-9)
    np.testing.assert_allclose(found.var, 1 / precision, rtol=1e-8)
    np.testing.assert_allclose(found.cdf(centre), 0.5, atol=1e-8)
    one = graph.full_conditional("mean", {"tau": tau[1], "mean": [0.0, 0.0, 0.0]}, 2)
    np.testing.assert_allclose(one.mean, centre[1, 2], rtol=1e-9)
    mean = np.array([99.0, -1.0, 1.0])
    rate = 1.0 + 0.5 * ((x - mean[group]) ** 2).sum()
    gamma = graph.full_conditional("tau", {"mean": mean})
    expected = stats.gamma(5.0, scale=1 / rate)
    np.testing.assert_allclose(gamma.mean, expected.mean(), rtol=1e-9)
    np.testing.assert_allclose(gamma.ppf([0.1, 0.9]), expected.ppf([0.1, 0.9]), rtol=1e-6)


def test_bounds_that_depend_on_the_state() -> None:
    net = bmc.BayesNet(plates={"i": 2})
    net.add("top", bmc.Gamma(2.0, 1.0), plates="i")
    net.add("u", lambda top: bmc.Uniform(0.0, top), plates="i")
    net.add("y", lambda u: bmc.Normal(u, 1.0), plates="i")
    graph = net.to_factor_graph({"y": [0.5, 3.0]})
    assert graph.variables["u"].support is None
    top = np.array([1.0, 2.5])
    found = graph.full_conditional("u", {"top": top})
    y = np.array([0.5, 3.0])
    expected = stats.truncnorm(-y, top - y, loc=y)
    np.testing.assert_allclose(found.mean, expected.mean(), rtol=1e-8)
    one = graph.full_conditional("u", {"top": top, "u": [0.1, 0.1]}, 1)
    np.testing.assert_allclose(one.mean, expected.mean()[1], rtol=1e-8)


def test_vectors_and_unbounded_integers_give_unnormalised_densities() -> None:
    net = bmc.BayesNet()
    net.add("rate", bmc.Gamma(2.0, 1.0))
    net.add("n", lambda rate: bmc.Poisson(rate))
    net.add("v", bmc.MvNormal(np.zeros(2), np.eye(2)))
    net.add("y", lambda v, n: bmc.Normal(v.sum(axis=-1) + n, 1.0))
    graph = net.to_factor_graph({"y": 2.0})
    rng = np.random.default_rng(3)
    v, other = rng.normal(size=(2, 2))
    density = graph.full_conditional("v", {"rate": 1.5, "n": 2})
    assert isinstance(density, bmc.Density) and density.event_shape == (2,)
    state = {"rate": 1.5, "n": 2}
    expected = graph.log_prob({**state, "v": v}) - graph.log_prob({**state, "v": other})
    assert density.log_prob(v) - density.log_prob(other) == pytest.approx(float(expected))
    count = graph.full_conditional("n", {"rate": 1.5, "v": v})
    assert count.is_discrete and count.support.size is None
    logs = np.asarray([graph.log_prob({"rate": 1.5, "v": v, "n": n}) for n in (0, 4)])
    found = count.log_prob(np.array([0, 4]))
    assert found[1] - found[0] == pytest.approx(logs[1] - logs[0])
    assert count.log_prob(-1) == -np.inf


def test_full_conditionals_of_declared_variables() -> None:
    graph = bmc.FactorGraph(plates={"site": 3})
    graph.variable("x", "positive", plates="site")
    graph.variable("w", "simplex", event_shape=3)
    graph.factor(lambda x: -2.0 * x, scope="x")
    graph.factor(lambda a, b: -3.0 * a * b, scope=("x", "x"), index=([0, 1], [1, 2]))
    graph.factor(lambda w: np.log(w[..., 0]))
    found = graph.full_conditional("x", {"x": [0.5, 9.0, 0.25], "w": [0.2, 0.3, 0.5]}, 1)
    assert found.mean == pytest.approx(1 / (2 + 3 * 0.75), rel=1e-9)  # exponential with that rate
    w = graph.full_conditional("w", {"x": [0.5, 9.0, 0.25]})
    assert w.log_prob([0.2, 0.3, 0.5]) == pytest.approx(np.log(0.2))
    assert w.log_prob([0.2, 0.3, 0.6]) == -np.inf


def test_impossible_states_are_refused() -> None:
    graph = bmc.FactorGraph()
    graph.variable("a", 2)
    graph.variable("b", 3)
    table = np.zeros((2, 3))
    table[:, 2] = -np.inf
    graph.factor(table, scope=("a", "b"))
    assert graph.full_conditional("a", {"b": 0}).probs.tolist() == [0.5, 0.5]
    with pytest.raises(errors.ZeroProbabilityError, match="full_conditional.'a'"):
        graph.full_conditional("a", {"b": 2})


def test_bad_parameters_at_possible_states_are_heard_of() -> None:
    net = bmc.BayesNet()
    net.add("allowed", bmc.Bernoulli(0.5))
    net.add("a", lambda allowed: bmc.Bernoulli(0.5 * allowed))
    net.add("x", lambda a: bmc.Normal(0.0, 1.0 - 2.0 * a))  # scale -1 at a=1
    graph = net.to_factor_graph({"x": 0.1})
    assert graph.full_conditional("a", {"allowed": 0}).probs.tolist() == [1.0, 0.0]
    with pytest.raises(errors.ParameterError, match="node 'x'.*scale.*at a state of 'a'"):
        graph.full_conditional("a", {"allowed": 1})


def test_deterministic_and_observed_names_are_not_part_of_a_state() -> None:
    graph = sprinkler().to_factor_graph({"far": 1})
    state = {"sprinkler": 1, "slip": 1}
    with pytest.raises(errors.EvidenceError, match="'wet' is deterministic"):
        graph.full_conditional("rain", {**state, "wet": 1})
    with pytest.raises(errors.EvidenceError, match="'far' is observed"):
        graph.full_conditional("rain", {**state, "far": 1})
    weights = np.array([0.8 * 0.4, 0.2 * 0.1])
    np.testing.assert_allclose(
        graph.full_conditional("rain", state).probs, weights / weights.sum(), atol=1e-14
    )


# ---- structure ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("height", "width", "core"), [(1, 50, 0), (2, 30, 0), (6, 6, 32)])
def test_core_of_a_graph(height: int, width: int, core: int) -> None:
    """Chains and ladders have no core; a square grid loses its four corners."""
    assert core_size(ising(height, width).model(), {}) == core


def test_scopes_are_sound_for_random_functions() -> None:
    """Whatever a scope leaves out does not move the factor: columns are checked by changing elements."""
    rng = np.random.default_rng(11)
    school = rng.integers(0, 4, size=6)
    second = rng.integers(0, 4, size=6)
    net = bmc.BayesNet(plates={"k": 4, "i": 6, "j": 2})
    net.add("a", bmc.Normal(0.0, 1.0), plates=("j", "k"))
    net.add("b", bmc.Normal(0.0, 1.0), plates="i")
    net.add("d", lambda a: a.sum("k"), plates="j")
    net.add(
        "y",
        lambda a, b, d: bmc.Normal(a[school[:, None]] * b + a[second[:, None]] + d, 1.0),
        plates=("i", "j"),
    )
    model = net.model()
    scopes = {s.name: s for s in factor_scopes(model, {}, {})}
    reads = scopes["y"].reads
    assert reads["a"].columns is None  # through the sum
    (column,) = reads["b"].columns
    np.testing.assert_array_equal(column, np.repeat(np.arange(6), 2))

    other = bmc.BayesNet(plates={"k": 4, "i": 6, "j": 2})
    other.add("a", bmc.Normal(0.0, 1.0), plates=("j", "k"))
    other.add(
        "y", lambda a: bmc.Normal(a[school[:, None]] + a[second[:, None]], 1.0), plates=("i", "j")
    )
    (scope,) = (s for s in factor_scopes(other.model(), {}, {}) if s.name == "y")
    columns = {tuple(c) for c in scope.reads["a"].columns}
    i, j = np.indices((6, 2))
    expected = {tuple((4 * j + key[i]).ravel()) for key in (school, second)}
    assert columns == expected


def test_what_cannot_be_followed_reads_what_it_receives() -> None:
    """Aligned elements of parents, all of what it gathers or what others compute for it."""
    net = bmc.BayesNet(plates={"i": 3})
    net.add("a", bmc.Normal(0.0, 1.0), plates="i")
    net.add("s", lambda a: a.sum("i"))
    net.add("alone", lambda a: bmc.Normal(float(a), 1.0), plates="i", vectorize=True)
    net.add("both", lambda a, s: bmc.Normal(float(a + s), 1.0), plates="i", vectorize=True)
    scopes = {s.name: s for s in factor_scopes(net.model(), {}, {})}
    (column,) = scopes["alone"].reads["a"].columns
    np.testing.assert_array_equal(column, np.arange(3))
    assert scopes["both"].reads["a"].columns is None


def test_numbers_of_states_that_are_gathered_are_those_elements() -> None:
    net = bmc.BayesNet(plates={"k": 4, "i": 3})
    net.add("s", bmc.Bernoulli(0.5), plates="k", states=(-1, 1))
    at = np.array([0, 1, 2])
    net.add("y", lambda s: bmc.Normal(s[at] * s[at + 1], 1.0), plates="i")
    graph = net.to_factor_graph({"y": [0.1, 0.2, 0.3]})
    assert graph.markov_blanket("s", 1) == {("s", (0,)), ("s", (2,))}
