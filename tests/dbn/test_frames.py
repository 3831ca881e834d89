"""Data frames over time: rows to slices, the clock that labels them, and what it is refused for."""

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.dbn.calendar import is_even, last_times
from bayesmc.errors import EvidenceError

pd = pytest.importorskip("pandas")
DAYS = pd.date_range("2024-03-01", periods=4, freq="D")


def sensors():
    dbn = bmc.DynamicBayesNet(plates={"city": ["Bonn", "Ulm"]})
    dbn.input("u")

    @dbn.node(initial=bmc.Normal(0.0, 1.0), plates="city")
    def x(x_prev, u):
        return bmc.Normal(x_prev + u, 1.0)

    dbn.add("y", lambda x: bmc.Normal(x, 1.0), plates="city")
    return dbn


def level():
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    return dbn


def long_rows():
    rows = pd.DataFrame([(d, c) for d in DAYS for c in ("Ulm", "Bonn")], columns=["date", "city"])
    rows["y"], rows["u"] = np.arange(8.0), np.repeat([0.0, 1.0, 0.0, 1.0], 2)
    rows.loc[3, "y"] = None
    return rows


def wide_rows():
    wide = long_rows().pivot(index="date", columns="city", values="y")
    return wide.rename(columns="y[{}]".format).assign(u=[0.0, 1.0, 0.0, 1.0])


Y, U = [[1, 0], [np.nan, 2], [5, 4], [7, 6]], [0.0, 1.0, 0.0, 1.0]


def test_long_and_wide_rows() -> None:
    dbn, rows = sensors(), long_rows()
    wanted = bmc.filter(dbn, {"y": Y}, inputs={"u": U})
    shuffled = rows.sample(frac=1.0, random_state=1)
    for frame in (rows, shuffled, rows.set_index(["date", "city"]), wide_rows()):
        found = bmc.filter(dbn, frame)
        np.testing.assert_allclose(found.mean("x"), wanted.mean("x"))
        assert (found.times == DAYS.to_numpy()).all()
    smoothed = bmc.smooth(dbn, wide_rows())
    np.testing.assert_allclose(bmc.infer(dbn, wide_rows()).mean("x"), smoothed.mean("x"))
    assert smoothed.sample_paths(3, rng=0)["x"].shape == (3, 4, 2)
    both = bmc.filter(dbn, [wide_rows(), rows])
    np.testing.assert_allclose(both[1].mean("x"), wanted.mean("x"))


def test_forecasts_go_on_with_inputs() -> None:
    dbn, wide = sensors(), wide_rows()
    longer = pd.DataFrame({"u": [*U, 1.0, 1.0]}, index=pd.date_range(DAYS[0], periods=6))
    found = bmc.forecast(dbn, wide.drop(columns="u"), inputs=longer, steps=2)
    wanted = bmc.forecast(dbn, {"y": Y}, inputs={"u": longer["u"].to_numpy()}, steps=2)
    np.testing.assert_allclose(found.mean("x"), wanted.mean("x"))
    assert found.times.astype("M8[D]").astype(str).tolist() == ["2024-03-05", "2024-03-06"]
    late = longer.shift(1, freq="D")
    with pytest.raises(EvidenceError, match="row 0 of the observations is of time 2024-03-01"):
        bmc.forecast(dbn, wide.drop(columns="u"), inputs=late, steps=2)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: f.iloc[::-1], "row 1 is of time 2024-03-03, before 2024-03-04 of row 0"),
        (lambda f: f.iloc[[0, 1, 3]], r"not at equal steps of time: .* \(rows 1 and 2\)"),
        (lambda f: f.iloc[[0, 1, 1]], "rows 1 and 2 are both of time 2024-03-02"),
        (lambda f: f.rename(columns={"u": "U"}), "'U' is no node, input or plate.*mean 'u'"),
        (lambda f: f.rename(columns={"y[Ulm]": "y[ulm]"}), r"no column 'y\[Ulm\]' \(did you mean"),
    ],
)
def test_rows_that_do_not_fit(change, words: str) -> None:
    with pytest.raises(EvidenceError, match=words):
        bmc.filter(sensors(), change(wide_rows()))
    if "equal" in words:
        with pytest.raises(EvidenceError, match=words):
            series = wide_rows().drop(columns="u")
            bmc.filter(sensors(), {"y": change(series)}, inputs={"u": U[:3]})


def test_long_rows_without_a_time_or_a_place() -> None:
    with pytest.raises(EvidenceError, match="say of which 'city' they are, and not of which time"):
        bmc.filter(sensors(), long_rows().drop(columns="date"))
    with pytest.raises(EvidenceError, match="no row is about 'Bonn'"):
        bmc.filter(sensors(), long_rows().assign(city="Ulm"))


def test_uneven_time_that_an_input_tells() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.input("dt")

    @dbn.node(initial=bmc.Normal(0.0, 1.0))
    def x(x_prev, dt):
        return bmc.Normal(x_prev, np.sqrt(dt))

    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    index = pd.to_datetime(["2020-01-01", "2020-01-02", "2020-01-05"])
    frame = pd.DataFrame({"y": [1.0, 2.0, 3.0]}, index=index)
    frame["dt"] = frame.index.diff().total_seconds().fillna(0.0) / 86400.0
    wanted = bmc.filter(dbn, {"y": [1.0, 2.0, 3.0]}, inputs={"dt": [0.0, 1.0, 3.0]})
    np.testing.assert_allclose(bmc.filter(dbn, frame).mean("x"), wanted.mean("x"))
    with pytest.raises(EvidenceError, match="declare the time that passes as an input"):
        bmc.filter(dbn, frame.assign(dt=1.0))


@pytest.mark.parametrize("freq", ["D", "B", "ME", "MS", "QE", "YE", "h", "W", "15min"])
def test_calendars_are_even_and_go_on(freq: str) -> None:
    every = pd.date_range("2023-12-29", periods=16, freq=freq).to_numpy()
    assert is_even(every[:14]) and not is_even(np.delete(every[:14], 5))
    ahead = last_times(every[:14], 16, 2)
    assert ahead is not None and (ahead == every[14:]).all()


@pytest.mark.parametrize("freq", ["D", "h"])
def test_an_hour_put_forward_is_no_gap(freq: str) -> None:
    index = pd.date_range("2024-03-30", periods=60, freq=freq, tz="Europe/Berlin")
    assert bmc.filter(level(), {"y": pd.Series(np.zeros(60), index=index)}).steps == 60


def test_rows_named_as_the_templates_t() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev, t: bmc.Normal(x_prev + t, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    frame = pd.DataFrame({"t": [1, 2, 3], "y": [1.0, 2.0, 3.0]})
    with pytest.raises(EvidenceError, match="labelled from t = 1 on, and the template reads t"):
        bmc.filter(dbn, frame)
    assert bmc.filter(dbn, frame.assign(t=[0, 1, 2])).times.tolist() == [0, 1, 2]
    assert bmc.filter(level(), frame).steps == 3


def test_static_nodes_are_learned_from_a_frame() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("q", bmc.HalfNormal(2.0))
    dbn.add("x", lambda x_prev, q: bmc.Normal(x_prev, q), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    y = np.cumsum(np.random.default_rng(0).normal(size=20))
    frame = pd.DataFrame({"y": y}, index=pd.date_range("2020-01-01", periods=20, freq="MS"))
    assert bmc.fit(dbn, frame)["q"] == pytest.approx(float(bmc.fit(dbn, {"y": y})["q"]))


def test_texts_are_dates_or_are_refused() -> None:
    rows = pd.DataFrame({"date": ["2024-01-01", "2024-01-02", "2024-01-03"], "y": [1.0, 2.0, 3.0]})
    for frame in (rows, rows.set_index("date"), {"y": rows.set_index("date")["y"]}):
        found = bmc.forecast(level(), frame, steps=1)
        assert found.times.astype("M8[D]").astype(str).tolist() == ["2024-01-04"]
    for change, words in (
        (rows.iloc[[0, 2, 1]], "row 2 is of time 2024-01-02, before 2024-01-03"),
        (rows.assign(date=["2024-01-01", "2024-01-02", "2024-02-15"]), "not at equal steps"),
        (rows.assign(date=["2024-01-01", None, "2024-01-03"]), "row 1 has no time"),
        (
            rows.assign(date=["1/2/24", "2/2/24", "3/2/24"]),
            r"'date' .*pd.to_datetime\(frame\['date'\]",
        ),
        (rows[["y"]].set_axis(list("aba")), r"the index labels them with texts .*reset_index"),
    ):
        with pytest.raises(EvidenceError, match=words):
            bmc.filter(level(), change)


@pytest.mark.parametrize("count", [3, 60])
def test_zones_label_by_the_wall_and_compare_as_instants(count: int) -> None:
    index = pd.date_range("2024-10-26 23:00", periods=count, freq="h", tz="Europe/Berlin")
    rows = pd.DataFrame({"y": np.zeros(count)}, index=index)
    for frame in (rows, rows.rename_axis("time"), rows.assign(time=index)):
        assert (bmc.filter(level(), frame).times == index.tz_localize(None).to_numpy()).all()
    dbn = bmc.DynamicBayesNet()
    dbn.input("u")
    dbn.add("x", lambda x_prev, u: bmc.Normal(x_prev + u, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    same = pd.DataFrame({"u": np.zeros(count)}, index=index.tz_convert("UTC"))
    assert bmc.filter(dbn, rows, inputs=same).times[0] == np.datetime64("2024-10-26T23:00")
    wall = same.set_axis(same.index + pd.Timedelta("5h"))
    for inputs in (wall, {"u": wall["u"]}):
        with pytest.raises(EvidenceError, match="row 0 "):
            bmc.filter(dbn, rows, inputs=inputs)
    numbered = rows.reset_index(drop=True)
    with pytest.raises(EvidenceError, match="labelled unlike along 'time'"):
        bmc.filter(dbn, numbered, inputs={"u": numbered["y"].iloc[::-1]})


@pytest.mark.parametrize(
    "first, count, freq, wanted",
    [
        ("2024-03-30 22:00", 3, "h", ["2024-03-31T01", "2024-03-31T03", "2024-03-31T04"]),
        ("2024-03-31 00:00", 4, "h", ["2024-03-31T05", "2024-03-31T06", "2024-03-31T07"]),
        ("2024-10-27 00:00", 3, "h", ["2024-10-27T02", "2024-10-27T03", "2024-10-27T04"]),
        ("2024-03-29", 2, "D", ["2024-03-31T00", "2024-04-01T00", "2024-04-02T00"]),
        ("2024-03-29", 5, "D", ["2024-04-03T00", "2024-04-04T00", "2024-04-05T00"]),
    ],
)
def test_forecasts_are_labelled_by_the_wall_across_a_change_of_the_clock(
    first, count, freq, wanted
):
    """Hours are even in time, and days of the calendar."""
    index = pd.date_range(first, periods=count, freq=freq, tz="Europe/Berlin")
    rows = pd.DataFrame({"y": np.zeros(count)}, index=index)
    named = rows.rename_axis("time").reset_index()
    for frame in (rows, named):
        found = bmc.forecast(level(), frame, steps=3)
        np.testing.assert_array_equal(found.times, np.array(wanted, dtype="datetime64[h]"))
    ahead = pd.date_range(index[-1], periods=4, freq=freq)[1:].tz_localize(None)
    np.testing.assert_array_equal(found.times, ahead.to_numpy())  # pandas' own


def test_trees_have_the_dates_of_the_data() -> None:
    pytest.importorskip("arviz_base")
    pytest.importorskip("xarray")
    rows = pd.DataFrame({"y": [0.0, np.nan, 1.0, 2.0]}, index=DAYS)
    engine = bmc.LikelihoodWeighting(500)
    found = bmc.infer(level(), rows, engine=engine, rng=0).resample(50, rng=0)
    tree = found.to_datatree(log_likelihood=True)
    for group, name in (("posterior", "x"), ("observed_data", "y")):
        np.testing.assert_array_equal(tree[group][name].coords["time"], DAYS.to_numpy())
    told = tree["log_likelihood"]["y"]
    np.testing.assert_array_equal(told.coords["y_observed"], DAYS.to_numpy()[[0, 2, 3]])
    plain = bmc.infer(level(), {"y": rows["y"].to_numpy()}, engine=engine, rng=0).resample(
        50, rng=0
    )
    np.testing.assert_array_equal(plain.to_datatree()["posterior"]["x"].coords["time"], range(4))
