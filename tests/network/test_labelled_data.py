"""Data that bring labels are lined up with the plate's, not taken by position."""

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import EvidenceError


class Series:
    """What a pandas Series is to the library: numbers, and an index beside them."""

    def __init__(self, values, index):
        self.values, self.index = np.asarray(values, dtype=float), list(index)

    def to_numpy(self):
        return self.values

    def __array__(self, dtype=None, copy=None):
        return np.array(self.values, dtype=dtype)

    def __len__(self):
        return len(self.values)

    def __iter__(self):
        return iter(self.values)


class Frame(Series):
    def __init__(self, values, index, columns):
        super().__init__(values, index)
        self.columns = list(columns)

    def __iter__(self):  # as pandas does: over names of columns
        return iter(self.columns)


def cities():
    """The model of the issue, with an input beside the evidence."""
    net = bmc.BayesNet(plates={"city": ["a", "b", "c"]})
    net.input("u", plates="city")
    net.add("m", lambda u: bmc.Normal(u, 1.0), plates="city")
    net.add("y", lambda m: bmc.Normal(m, 1.0), plates="city")
    return net


def sensors():
    dbn = bmc.DynamicBayesNet(plates={"city": ["a", "b"]})
    dbn.add(
        "x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0), plates="city"
    )
    dbn.add("y", lambda x: bmc.Normal(x, 1.0), plates="city")
    return dbn


def test_evidence_and_inputs_by_label():
    y, u = Series([3, 1, 2], "cab"), Series([20, 10, 30], "bac")
    net, plain = cities(), ({"y": [1.0, 2.0, 3.0]}, {"u": [10.0, 20.0, 30.0]})
    wanted = bmc.infer(net, plain[0], inputs=plain[1], engine=bmc.Exact()).mean("m")
    for evidence, inputs in ((y, u), (y, plain[1]["u"]), (plain[0]["y"], u)):
        found = bmc.infer(net, {"y": evidence}, inputs={"u": inputs}, engine=bmc.Exact())
        np.testing.assert_allclose(found.mean("m"), wanted)
    by_position = bmc.infer(net, {"y": y.to_numpy()}, inputs={"u": u}, engine=bmc.Exact())
    assert not np.allclose(by_position.mean("m"), wanted)


def test_log_prob_do_and_missing_elements_by_label():
    net, inputs = cities(), {"u": [10.0, 20.0, 30.0]}
    y = Series([3, 1, 2], "cab")
    wanted = net.log_prob({"y": [1, 2, 3], "m": [1, 2, 3]}, inputs=inputs)
    assert net.log_prob({"y": y, "m": y}, inputs=inputs) == pytest.approx(float(wanted))
    done = net.do(m=y).log_prob({"y": [1, 2, 3]}, inputs=inputs)
    assert done == pytest.approx(-1.5 * np.log(2 * np.pi))
    partly = bmc.infer(net, {"y": Series([3, np.nan, 2], "cab")}, inputs=inputs)
    assert partly.mean("m") == pytest.approx([10.0, 11.0, 16.5])


def test_labels_that_say_nothing_go_by_position():
    net, inputs = cities(), {"u": [10.0, 20.0, 30.0]}
    found = bmc.infer(net, {"y": Series([1, 2, 3], range(3))}, inputs=inputs)
    assert found.mean("m") == pytest.approx([5.5, 11.0, 16.5])
    numbered = bmc.BayesNet(plates={"year": [2003, 2001, 2002]})
    numbered.add("y", bmc.Normal(0.0, 1.0), plates="year")
    for index, values in (((2001, 2002, 2003), [2, 3, 1]), (range(3), [1, 2, 3])):
        posterior = bmc.infer(numbered, {"y": Series(values, index)})
        assert posterior.mean("y") == pytest.approx([1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("index", "words"),
    [
        ("cbx", r"'y': plate 'city' has no element labelled 'x' \(its labels are 'a', 'b', 'c'\)"),
        ("cbb", r"'y': the label 'b' of plate 'city' stands twice"),
        ("cb", r"'y': nothing is labelled 'a' of plate 'city'"),
    ],
)
def test_labels_that_do_not_fit(index, words):
    with pytest.raises(EvidenceError, match=words):
        bmc.infer(
            cities(), {"y": Series(np.arange(len(index)), index)}, inputs={"u": [1.0, 2.0, 3.0]}
        )


def test_index_that_may_be_positions_or_labels():
    net = bmc.BayesNet(plates={"k": [2, 0, 1]})
    net.add("y", bmc.Normal(0.0, 1.0), plates="k")
    with pytest.raises(EvidenceError, match="may mean positions or the labels"):
        bmc.infer(net, {"y": Series([1, 2, 3], range(3))})


def test_two_series_of_a_plate_without_labels():
    net = bmc.BayesNet(plates={"p": None})
    net.input("u", plates="p")
    net.add("y", lambda u: bmc.Normal(u, 1.0), plates="p")
    y, u = Series([3, 1, 2], "cab"), Series([20, 10, 30], "bac")
    with pytest.raises(EvidenceError, match="'u' and 'y' are labelled unlike along 'p'"):
        bmc.infer(net, {"y": y}, inputs={"u": u})
    assert bmc.infer(net, {"y": y}, inputs={"u": [1.0, 2.0, 3.0]}).mean("y")[0] == 3.0


def test_tables_of_two_plates():
    net = bmc.BayesNet(plates={"row": ["a", "b"], "column": ["x", "y"]})
    net.add("y", bmc.Normal(0.0, 1.0), plates=("row", "column"))
    turned = Frame([[1, 2], [3, 4]], "ba", "yx")
    assert bmc.infer(net, {"y": turned}).mean("y").tolist() == [[4, 3], [2, 1]]
    with pytest.raises(EvidenceError, match="plate 'row' has no element labelled 'y'"):
        bmc.infer(net, {"y": Frame([[1, 2], [3, 4]], "yx", "ba")})  # transposed


def test_rows_over_time():
    dbn, rows = sensors(), [[10.0, 1.0], [20.0, 2.0], [30.0, 3.0]]
    wanted = bmc.filter(dbn, {"y": rows}).mean("x")
    turned = Frame([r[::-1] for r in rows], (11, 12, 13), "ba")
    np.testing.assert_allclose(bmc.filter(dbn, {"y": turned}).mean("x"), wanted)
    unrolled = bmc.infer(dbn.unroll(3), dbn.unrolled_evidence({"y": turned}))
    np.testing.assert_allclose(unrolled.mean("x[2]"), wanted[2])
    engine = bmc.KalmanFilter()
    belief = engine.step(engine.start(dbn), {"y": Series([1, 10], "ba")})
    np.testing.assert_allclose(belief.mean("x"), wanted[0])
    with pytest.raises(EvidenceError, match=r"row 1 is of time 12, before 13 of row 0"):
        bmc.filter(dbn, {"y": Frame(rows[::-1], (13, 12, 11), "ab")})


def test_inputs_of_other_times():
    dbn = bmc.DynamicBayesNet()
    dbn.input("u")
    dbn.add("x", lambda x_prev, u: bmc.Normal(x_prev + u, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    y, u = Series([1, 2], (5, 6)), Series([1, 2, 3], (5, 6, 7))
    assert bmc.forecast(dbn, {"y": y}, inputs={"u": u}, steps=1).mean("x").shape == (1,)
    with pytest.raises(EvidenceError, match="'u' and 'y' are labelled unlike along 'time'"):
        bmc.filter(dbn, {"y": y}, inputs={"u": Series([2, 3], (6, 7))})


def test_pandas_and_xarray():
    pandas = pytest.importorskip("pandas")
    y = pandas.Series({"c": 3.0, "a": 1.0, "b": 2.0})
    found = bmc.infer(cities(), {"y": y}, inputs={"u": pandas.Series([10.0, 20.0, 30.0])})
    assert found.mean("m") == pytest.approx([5.5, 11.0, 16.5])
    xarray = pytest.importorskip("xarray")
    net = bmc.BayesNet(plates={"row": ["a", "b"], "column": ["x", "y"]})
    net.add("y", bmc.Normal(0.0, 1.0), plates=("row", "column"))
    turned = xarray.DataArray([[1.0, 2.0], [3.0, 4.0]], dims=("column", "row"))
    assert bmc.infer(net, {"y": turned}).mean("y").tolist() == [[1, 3], [2, 4]]
