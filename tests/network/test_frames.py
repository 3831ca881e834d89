"""Data frames as evidence and inputs: the same answers as arrays, and errors that name the column."""

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import EvidenceError
from bayesmc.network.columns import array_of, columns_of, is_column, is_frame

pd = pytest.importorskip("pandas")


class Column:
    """What a column of pyarrow is to the library."""

    def __init__(self, values, kind="dictionary<values=string>"):
        self.values, self.type = list(values), kind
        self.null_count = self.values.count(None)

    def to_pylist(self):
        return self.values

    def __len__(self):
        return len(self.values)

    def __array__(self, dtype=None, copy=None):
        return np.array(self.values, dtype=dtype)


class Table:
    """A table of these; ``columns`` are no names, as in pyarrow."""

    def __init__(self, columns):
        self.column_names, self.columns = list(columns), list(columns.values())

    def __getitem__(self, name):
        return self.columns[self.column_names.index(name)]


def radon():
    """Houses in counties, with an input of each, and one that says where a house stands."""
    net = bmc.BayesNet(plates={"county": ["a", "b", "c"], "house": None})
    net.input("uranium", plates="county")
    net.input("floor", plates="house")
    net.input("county", plates="house")
    net.add("slope", bmc.Normal(0.0, 1.0))
    net.add("level", lambda uranium, slope: bmc.Normal(slope * uranium, 1.0), plates="county")

    @net.node(plates="house")
    def y(level, county, floor):
        return bmc.Normal(level[county] - floor, 1.0)

    return net


HOUSES = {
    "county": ["c", "a", "b", "a", "c"],
    "uranium": [3.0, 1.0, 2.0, 1.0, 3.0],
    "floor": [0, 1, 0, 1, 0],
    "y": [1.0, 2.0, None, 4.0, 5.0],
}


def two_plates():
    net = bmc.BayesNet(plates={"city": ["Bonn", "Ulm"], "year": [2001, 2002, 2003]})
    net.add("m", bmc.Normal(0.0, 1.0), plates="city")
    net.add("y", lambda m: bmc.Normal(m, 1.0), plates=("year", "city"))
    return net


def long_rows():
    return pd.DataFrame(
        {
            "year": [2003, 2001, 2002, 2001],
            "city": ["Ulm", "Ulm", "Bonn", "Bonn"],
            "y": [1.0, 2.0, 3.0, 4.0],
        }
    )


def test_columns_of_every_kind() -> None:
    frame = pd.DataFrame(
        {
            "int": pd.array([1, None, 3], dtype="Int64"),
            "truth": pd.array([True, None, False], dtype="boolean"),
            "kind": pd.Categorical(["x", None, "y"]),
            "text": ["p", None, "q"],
            "whole": [1, 2, 3],
            "vector": [[1, 2], None, [3, 4]],
        },
        index=pd.Index([5, 6, 7], name="key"),
    )
    found = columns_of(frame)
    np.testing.assert_array_equal(found["int"], [1.0, np.nan, 3.0])
    np.testing.assert_array_equal(found["truth"], [1.0, np.nan, 0.0])
    assert found["kind"].tolist() == ["x", None, "y"] and found["text"].tolist() == ["p", None, "q"]
    assert found["whole"].dtype.kind == "i" and found["key"].tolist() == [5, 6, 7]
    np.testing.assert_array_equal(found["vector"], [[1, 2], [np.nan, np.nan], [3, 4]])
    other = Table({"kind": Column(["x", None]), "number": Column([1, 2], "int64")})
    assert is_frame(other) and is_column(other["kind"]) and not is_column(frame["int"])
    assert columns_of(other)["kind"].tolist() == ["x", None]
    assert array_of(other["number"]).tolist() == [1, 2]


def test_one_frame_of_houses_counties_and_inputs() -> None:
    net = radon()
    inputs = {"uranium": [1.0, 2.0, 3.0], "floor": HOUSES["floor"], "county": [2, 0, 1, 0, 2]}
    y = np.array(HOUSES["y"], dtype=float)
    wanted = bmc.infer(net, {"y": y}, inputs=inputs, engine=bmc.Exact()).mean("level")
    frame = pd.DataFrame(HOUSES)
    frame["county"] = frame["county"].astype("category")
    shuffled = frame.sample(frac=1, random_state=0)
    arrow = Table({n: Column(v) for n, v in HOUSES.items()})
    for given in (frame, shuffled.reset_index(drop=True), arrow):
        np.testing.assert_allclose(bmc.infer(net, given).mean("level"), wanted)
    apart = bmc.infer(net, frame[["y"]], inputs=frame.drop(columns="y"))
    np.testing.assert_allclose(apart.mean("level"), wanted)


def test_long_and_wide_tables_of_two_plates() -> None:
    net, rows = two_plates(), long_rows()
    wanted = [[4.0, 2.0], [3.0, np.nan], [np.nan, 1.0]]
    wide = rows.pivot(index="year", columns="city", values="y")
    named = wide.rename(columns="y[{}]".format)
    stacked = wide.copy()
    stacked.columns = pd.MultiIndex.from_product([["y"], wide.columns])
    for frame in (rows, rows.set_index(["year", "city"]), named):
        np.testing.assert_array_equal(net.unframed(frame)[0]["y"], wanted)
    means = bmc.infer(net, rows).mean("m")
    np.testing.assert_allclose(bmc.infer(net, stacked).mean("m"), means)
    np.testing.assert_allclose(bmc.infer(net, {"y": wide}).mean("m"), means)


def test_an_index_with_labels_and_series_with_missing_states() -> None:
    net = bmc.BayesNet(plates={"city": ["a", "b", "c"]})
    net.add("y", bmc.Bernoulli(0.4), plates="city", states=("no", "yes"))
    states, labels = pd.Categorical(["yes", None, "no"]), list("cab")
    wanted = [[0.6, 0.4], [1.0, 0.0], [0.0, 1.0]]
    for evidence in (
        {"y": pd.Series(states, index=labels)},
        pd.DataFrame({"y": states}, index=labels),
        pd.DataFrame({"y": states, "city": labels}),
        {"y": Column([None, "no", "yes"])},
    ):
        np.testing.assert_allclose(bmc.infer(net, evidence).probabilities("y"), wanted)


def test_vectors_by_their_components() -> None:
    net = bmc.BayesNet(plates={"i": None})
    net.add("m", bmc.MvNormal(np.zeros(2), np.eye(2)))
    net.add("x", lambda m: bmc.MvNormal(m, np.eye(2)), plates="i")
    frame = pd.DataFrame({"x[1]": [3.0, 4.0], "x[0]": [1.0, 2.0]})
    assert bmc.infer(net, frame).mean("m") == pytest.approx([1.0, 7.0 / 3.0])
    with pytest.raises(EvidenceError, match=r"no column 'x\[1\]'"):
        bmc.infer(net, frame.rename(columns={"x[1]": "x[2]"}))


def test_questions_in_rows() -> None:
    net = bmc.BayesNet()
    net.table("rain", [], [0.8, 0.2], states=("no", "yes"))
    net.table("wet", ["rain"], [[0.9, 0.1], [0.1, 0.9]], states=("no", "yes"))
    frame = pd.DataFrame({"wet": ["yes", None]})
    one = bmc.infer(net, frame[:1]).probabilities("rain")
    every = bmc.infer_many(net, frame).probabilities("rain")
    np.testing.assert_allclose(every, [one, [0.8, 0.2]])
    with pytest.raises(EvidenceError, match=r"'wet' has no plates, and there are 2 rows"):
        bmc.infer(net, frame)
    with pytest.raises(EvidenceError, match=r"'Yes' is not a state.*did you mean 'yes'"):
        bmc.infer(net, pd.DataFrame({"wet": ["Yes"]}))


def test_new_inputs_of_predictions_and_of_the_prior() -> None:
    net = bmc.BayesNet(plates={"i": None})
    net.input("x", plates="i")
    net.add("slope", bmc.Normal(0.0, 3.0))
    net.add("y", lambda slope, x: bmc.Normal(slope * x, 1.0), plates="i")
    frame = pd.DataFrame({"x": [1.0, 2.0, 3.0], "y": [1.0, 2.0, 3.0]})
    posterior = bmc.infer(net, frame)
    new = pd.DataFrame({"x": [4.0, 5.0]})
    wanted = posterior.predict("y", inputs={"x": [4.0, 5.0]}, rng=0)["y"]
    np.testing.assert_array_equal(posterior.predict("y", inputs=new, rng=0)["y"], wanted)
    assert bmc.prior_predict(net, 10, inputs=new, rng=0)["y"].shape == (1, 10, 2)
    assert bmc.fit(net, frame)["slope"] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: f.rename(columns={"floor": "flor"}), r"'flor' is no node.*did you mean 'floor'"),
        (lambda f: f.replace({"county": "b"}, "B"), r"row 2 is about 'B'.*did you mean 'b'"),
        (lambda f: f.assign(uranium=[3, 1, 2, 1, 4]), r"rows 0 and 4 are both about county 'c'"),
        (lambda f: f[f.county != "b"], r"no row is about 'b' of plate 'county'"),
        (lambda f: f.assign(county=[None, *f.county[1:]]), r"row 0 has no label of plate 'county'"),
    ],
)
def test_rows_that_do_not_fit(change, words: str) -> None:
    with pytest.raises(EvidenceError, match=words):
        bmc.infer(radon(), change(pd.DataFrame(HOUSES)))


def test_what_rows_do_not_say() -> None:
    net, rows = two_plates(), long_rows()
    with pytest.raises(EvidenceError, match="the rows do not say of which 'city' they are"):
        bmc.infer(net, rows.drop(columns="city"))
    with pytest.raises(EvidenceError, match="rows 0 and 4 are both about year 2003, city 'Ulm'"):
        bmc.infer(net, pd.concat([rows, rows[:1]], ignore_index=True))
    with pytest.raises(EvidenceError, match="'floor' is a column of the data and is in inputs="):
        bmc.infer(radon(), pd.DataFrame(HOUSES), inputs={"floor": [0] * 5})
    unlabelled = bmc.BayesNet(plates={"city": None})
    unlabelled.add("y", bmc.Normal(0.0, 1.0), plates="city")
    with pytest.raises(EvidenceError, match="no labels, only positions"):
        bmc.infer(unlabelled, pd.DataFrame({"city": ["u", "v"], "y": [1.0, 2.0]}))
    numbered = pd.DataFrame({"city": [1, 0], "y": [1.0, 2.0]})
    assert bmc.infer(unlabelled, numbered).mean("y").tolist() == [2.0, 1.0]


def test_polars_and_pyarrow() -> None:
    polars = pytest.importorskip("polars")
    pytest.importorskip("pyarrow")
    wanted = bmc.infer(radon(), pd.DataFrame(HOUSES)).mean("level")
    frame = polars.DataFrame(HOUSES).with_columns(polars.col("county").cast(polars.Categorical))
    for given in (frame, frame.to_arrow()):
        np.testing.assert_allclose(bmc.infer(radon(), given).mean("level"), wanted)


def test_what_is_no_frame_and_texts_that_are_no_numbers() -> None:
    net = bmc.BayesNet(plates={"i": None})
    net.add("y", bmc.Normal(0.0, 1.0), plates="i")
    with pytest.raises(EvidenceError, match="evidence is a Series; give a dict .* or a data frame"):
        bmc.infer(net, pd.Series([1.0, 2.0], name="y"))
    with pytest.raises(EvidenceError, match="'y': .*'1', .* is not a number"):
        bmc.infer(net, pd.DataFrame({"y": ["1", "2"]}))
    with pytest.raises(EvidenceError, match="the data have two columns 'y'"):
        bmc.infer(net, pd.DataFrame([[1.0, 2.0]], columns=["y", "y"]))


def test_labels_and_names_say_which_axis_is_which() -> None:
    net = bmc.BayesNet(plates={"city": ["Bonn", "Ulm"], "year": None})
    net.add("m", bmc.Normal(0.0, 3.0), plates="city")
    net.add("y", lambda m: bmc.Normal(m, 1.0), plates=("city", "year"))
    for years in (2, 3):
        rows = [[1.0, 40.0], [2.0, 50.0], [3.0, 60.0]][:years]
        wide = pd.DataFrame(rows, columns=["Bonn", "Ulm"])
        wanted = bmc.infer(net, {"y": wide.to_numpy().T}).mean("m")
        stacked = wide.copy()
        stacked.columns = pd.MultiIndex.from_product([["y"], wide.columns])
        named = wide.set_axis([0, 1], axis=1).rename_axis(index="year", columns="city")
        flat = wide.rename(columns="y[{}]".format)
        for given in ({"y": wide}, {"y": wide.T}, {"y": named}, {"y": named.T}, stacked, flat):
            np.testing.assert_allclose(bmc.infer(net, given).mean("m"), wanted)
    both = wide[:2].set_axis(["Bonn", "Ulm"])
    twins = bmc.BayesNet(plates={"city": ["Bonn", "Ulm"], "to": ["Bonn", "Ulm"]})
    twins.add("y", bmc.Normal(0.0, 1.0), plates=("city", "to"))
    for asked, given in (
        (twins, {"y": both}),
        (net, {"y": wide[:2].rename_axis(index="city")}),
        (twins, both.reset_index(drop=True).rename(columns="y[{}]".format)),
    ):
        with pytest.raises(EvidenceError, match="may be (either|the elements) of"):
            bmc.infer(asked, given)


def test_indexes_in_another_order() -> None:
    net = bmc.BayesNet(plates={"i": None})
    net.input("x", plates="i")
    net.add("slope", bmc.Normal(0.0, 3.0))
    net.add("y", lambda slope, x: bmc.Normal(slope * x, 1.0), plates="i")
    rows = pd.DataFrame({"x": [1.0, 2.0, 3.0], "y": [1.0, 2.0, 3.0]})
    turned = rows.iloc[::-1]
    wanted = bmc.infer(net, rows).mean("slope")
    for y, x in ((turned["y"], turned["x"]), (turned["y"], turned["x"].to_numpy())):
        assert bmc.infer(net, {"y": y}, inputs={"x": x}).mean("slope") == pytest.approx(wanted)
    for evidence, inputs in (
        ({"y": turned["y"]}, {"x": rows["x"]}),
        (rows[["y"]], turned[["x"]]),
        (turned[["y"]], {"x": rows["x"]}),
    ):
        with pytest.raises(EvidenceError, match="labelled unlike along 'i'"):
            bmc.infer(net, evidence, inputs=inputs)
