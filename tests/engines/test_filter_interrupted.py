"""What was computed of the slices before is not lost: errors in a slice, and Ctrl-C."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.engines.filtering import FilterEngine
from bayesmc.errors import (
    BayesmcError,
    DegeneracyError,
    InterruptWarning,
    ModelError,
    ParameterError,
    ZeroProbabilityError,
)

STEPS, BROKEN = 12, 7
ROWS = np.random.default_rng(5).normal(size=STEPS).cumsum()
GAPS = np.where(np.arange(STEPS) % 4 == 2, np.nan, ROWS[::-1])

PARTICLES = bmc.ParticleFilter(200)
GAUSSIAN: list[FilterEngine] = [bmc.ExtendedKalmanFilter(), bmc.UnscentedKalmanFilter()]
GRID = bmc.GridFilter({"x": (-12.0, 12.0, 60), "z": (-12.0, 12.0, 60)})
SLICE_BY_SLICE: list[FilterEngine] = [PARTICLES, *GAUSSIAN, GRID]


def names(engine: Any) -> str:
    return type(engine).__name__


class Broken(Exception):
    """What a user's function may raise."""


class Sealed(Exception):
    """One that takes no attributes, but for the one that Python's own context managers set."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name != "__traceback__":
            raise AttributeError(name)
        super().__setattr__(name, value)


def walk(at: Callable[[float], None] = lambda t: None) -> bmc.DynamicBayesNet:
    """Two things seen of a walk, one of them now and then; ``at`` is called with every input."""

    def seen(x: Any, clock: Any) -> Any:
        at(float(np.ravel(clock)[0]))
        return bmc.Normal(x, 0.5)

    dbn = bmc.DynamicBayesNet()
    dbn.input("clock")
    dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 1.0), initial=bmc.Normal(0.0, 2.0))
    dbn.add("now", lambda clock: 2.0 * clock)
    dbn.add("y", seen)
    dbn.add("z", lambda x: bmc.Normal(x, 2.0))
    return dbn


def breaking(error: BaseException, time: float = BROKEN) -> Callable[[float], None]:
    """Raises in one slice."""

    def at(t: float) -> None:
        if t == time:
            raise error

    return at


def data(steps: int = STEPS) -> dict[str, Any]:
    return {
        "observations": {"y": ROWS[:steps], "z": GAPS[:steps]},
        "inputs": {"clock": np.arange(float(steps))},
    }


def filtered(dbn: bmc.DynamicBayesNet, steps: int = STEPS, **options: Any) -> Any:
    return bmc.filter(dbn, **data(steps), rng=3, **options)


def caught(kind: type[BaseException], call: Callable[[], Any]) -> Any:
    with pytest.raises(kind) as info:
        call()
    return info.value


def differences(one: Any, other: Any) -> list[str]:
    """What differs, to the bit, between two answers."""
    assert type(one) is type(other)
    found = [] if one.names == other.names else ["names"]
    for what in ("steps", "start", "kind"):
        if getattr(one, what) != getattr(other, what):
            found.append(what)
    found += [n for n in one.names if not np.array_equal(one.mean(n), other.mean(n))]
    found += [f"var {n}" for n in one.names if not np.array_equal(one.var(n), other.var(n))]
    figures = ["log_marginal_increments", "log_marginal_likelihood", "weight_ess", "resampled"]
    figures += ["unique_ancestors", "rejuvenated", "counts", "anew"]
    for what in figures:
        if not np.array_equal(getattr(one, what, None), getattr(other, what, None)):
            found.append(what)
    if one.queries.keys() != other.queries.keys():
        found.append("queries")
    found += [q for q in one.queries if not np.array_equal(one.queries[q], other.queries[q])]
    return found


@pytest.mark.parametrize("engine", SLICE_BY_SLICE, ids=names)
def test_an_error_has_the_answer_that_a_run_on_the_rows_before_gives(engine: FilterEngine) -> None:
    error = caught(ModelError, lambda: filtered(walk(breaking(Broken("no map"))), engine=engine))
    assert str(error).startswith(f"slice {BROKEN}: node 'y': Broken: no map")
    assert f"the answer about slices 0 to {BROKEN - 1} is in `error.filtered`" in error.__notes__
    assert len(error.filtered.log_marginal_increments) == error.filtered.steps == BROKEN
    assert error.filtered.mean("x").shape == error.filtered.mean("y").shape == (BROKEN,)
    whole = filtered(walk(), engine=engine)
    assert differences(error.filtered, filtered(walk(), BROKEN, engine=engine)) == []
    np.testing.assert_array_equal(error.filtered.mean("x"), whole.mean("x")[:BROKEN])
    # the comparison sees a row more, a row less and another value
    for steps in (BROKEN - 1, BROKEN + 1):
        assert "steps" in differences(error.filtered, filtered(walk(), steps, engine=engine))
    error.filtered._means["x"][BROKEN - 1] += 1e-12
    assert differences(error.filtered, filtered(walk(), BROKEN, engine=engine)) == ["x"]


@pytest.mark.parametrize("engine", SLICE_BY_SLICE, ids=names)
def test_ctrl_c_leaves_the_slices_that_are_done(engine: FilterEngine) -> None:
    message = (
        f"{names(engine)}: interrupted in slice {BROKEN}; the posterior has the {BROKEN} slices"
    )
    with pytest.warns(InterruptWarning, match=message) as caught_warnings:
        found = filtered(walk(breaking(KeyboardInterrupt())), engine=engine)
    assert [w.filename for w in caught_warnings] == [__file__]  # it stands at the user's call
    assert differences(found, filtered(walk(), BROKEN, engine=engine)) == []


@pytest.mark.parametrize("engine", [PARTICLES, GRID], ids=names)
@pytest.mark.parametrize("kind", [KeyboardInterrupt, Broken])
def test_in_the_first_slice_there_is_nothing_to_keep(
    engine: FilterEngine, kind: type[BaseException]
) -> None:
    def query(x: Any) -> Any:
        raise kind

    with warnings.catch_warnings():
        warnings.simplefilter("error", InterruptWarning)
        error = caught(kind, lambda: filtered(walk(), engine=engine, queries={"q": query}))
    assert error.filtered is None
    assert not any("filtered" in note for note in getattr(error, "__notes__", ()))


def broken_after(rows: int, error: BaseException) -> Callable[[Any], Any]:
    """A query that raises in the slice after so many; what queries raise is passed on as it is."""
    calls: list[int] = []

    def query(x: Any) -> Any:
        calls.append(0)
        if len(calls) > rows:
            raise error
        return x

    return query


@pytest.mark.parametrize("rows", [1, 2])
def test_somebody_elses_error_keeps_its_message(rows: int) -> None:
    error = Broken("no map", 3)
    queries = {"q": broken_after(rows, error)}
    assert caught(Broken, lambda: filtered(walk(), engine=PARTICLES, queries=queries)) is error
    assert error.args == ("no map", 3) and error.filtered.steps == rows  # type: ignore[attr-defined]
    before = "slice 0" if rows == 1 else "slices 0 to 1"
    told = [f"this was in slice {rows}", f"the answer about {before} is in `error.filtered`"]
    assert error.__notes__ == told


def test_one_that_takes_no_attributes_is_raised_all_the_same() -> None:
    error = Sealed("shut")
    queries = {"q": broken_after(4, error)}
    assert caught(Sealed, lambda: filtered(walk(), engine=PARTICLES, queries=queries)) is error
    assert not hasattr(error, "filtered")


@pytest.mark.parametrize("engine", [*SLICE_BY_SLICE, bmc.KalmanFilter()], ids=names)
def test_an_interrupted_forecast_is_none(engine: FilterEngine) -> None:
    dbn, rows = walk(breaking(KeyboardInterrupt())), np.arange(float(STEPS + 3))
    if isinstance(engine, bmc.KalmanFilter):  # it does not go slice by slice
        dbn = walk(breaking(KeyboardInterrupt(), 0.0))
    seen = data()["observations"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InterruptWarning)
        with pytest.raises(KeyboardInterrupt):
            bmc.forecast(dbn, seen, steps=3, inputs={"clock": rows}, engine=engine, rng=3)
    found = bmc.forecast(walk(), seen, steps=3, inputs={"clock": rows}, engine=engine, rng=3)
    assert found.steps == 3 and found.start == STEPS


@pytest.mark.parametrize("lag", [None, 0, 2])
@pytest.mark.parametrize("engine", [PARTICLES, *GAUSSIAN], ids=names)
@pytest.mark.parametrize("kind", [KeyboardInterrupt, Broken])
def test_a_smoother_hands_over_what_the_filter_had(
    engine: FilterEngine, lag: int | None, kind: type[BaseException]
) -> None:
    dbn, raised = walk(breaking(kind())), ModelError if kind is Broken else kind
    error = caught(raised, lambda: bmc.smooth(dbn, **data(), engine=engine, lag=lag, rng=3))
    np.testing.assert_allclose(
        error.filtered.mean("x"), filtered(walk(), BROKEN, engine=engine).mean("x"), rtol=1e-12
    )
    assert error.filtered.kind == "filter"
    smoothed = bmc.smooth(walk(), **data(), engine=engine, lag=lag, rng=3)
    assert smoothed.steps == STEPS and smoothed.kind != "filter"


# ---- particles ----------------------------------------------------------------------------------


def test_kept_particles_queries_and_counts_are_there_too() -> None:
    engine = bmc.ParticleFilter(400, adapt=bmc.KLD({"x": 0.5}, least=50))
    options: dict[str, Any] = {"engine": engine, "keep": "particles"}
    options["queries"] = {"above": lambda x: x > 0.0}
    error = caught(ModelError, lambda: filtered(walk(breaking(Broken())), **options))
    found, wanted = error.filtered, filtered(walk(), BROKEN, **options)
    assert differences(found, wanted) == []
    assert len(found.clouds) == BROKEN and len(set(found.counts.tolist())) > 1
    for one, other in zip(found.clouds, wanted.clouds, strict=True):
        np.testing.assert_array_equal(one.values["x"], other.values["x"])
        np.testing.assert_array_equal(one.weights, other.weights)
    np.testing.assert_array_equal(found.quantile("x", 0.3), wanted.quantile("x", 0.3))


def test_a_query_that_breaks_halfway_leaves_whole_rows() -> None:
    """The slice's means are written by then, and the first query's answer, too."""
    options: dict[str, Any] = {"engine": PARTICLES, "keep": "particles"}
    queries = {"first": lambda x: x + 1.0, "second": broken_after(BROKEN, Broken())}
    error = caught(Broken, lambda: filtered(walk(), queries=queries, **options))
    whole = {"first": lambda x: x + 1.0, "second": lambda x: x}
    assert differences(error.filtered, filtered(walk(), BROKEN, queries=whole, **options)) == []
    assert len(error.filtered.clouds) == BROKEN


def test_no_weight_left() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.3), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Uniform(x - 1.0, x + 1.0))
    rows = [0.1, 0.3, -0.1, 90.0, 0.0]
    error = caught(DegeneracyError, lambda: bmc.filter(dbn, {"y": rows}, engine=PARTICLES, rng=1))
    assert error.t == 3 and str(error).startswith(
        "none of 200 particles"
    )  # it names the slice itself
    wanted = bmc.filter(dbn, {"y": rows[:3]}, engine=PARTICLES, rng=1)
    assert differences(error.filtered, wanted) == []


def test_a_collapse_is_told_of_the_slices_that_are_done() -> None:
    rows = {"y": np.where(np.arange(STEPS) < 2, 0.0, 20.0), "z": GAPS}
    clock = {"clock": np.arange(float(STEPS))}
    with pytest.warns(bmc.errors.LowEssWarning, match=rf"of {BROKEN} slices"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", InterruptWarning)
            bmc.filter(
                walk(breaking(KeyboardInterrupt())), rows, inputs=clock, engine=PARTICLES, rng=0
            )


# ---- slices by name -----------------------------------------------------------------------------


def scaled() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.input("s")
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.3), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x, s: bmc.Normal(x, s))
    return dbn


SCALES = np.where(np.arange(STEPS) == BROKEN, -1.0, 1.0)


@pytest.mark.parametrize("engine", [PARTICLES, *GAUSSIAN], ids=names)
def test_the_librarys_own_errors_begin_with_the_slice(engine: FilterEngine) -> None:
    """Those of the grid say it in their own words."""
    wanted = f"slice {BROKEN}: node 'y': Normal: scale must be positive"
    seen, inputs = {"y": ROWS}, {"s": SCALES}
    call = lambda: bmc.filter(scaled(), seen, inputs=inputs, engine=engine, rng=0)  # noqa: E731
    error = caught(ParameterError, call)
    assert str(error).startswith(wanted)
    assert error.filtered.steps == BROKEN


@pytest.mark.parametrize("engine", [PARTICLES, *GAUSSIAN, bmc.KalmanFilter(), GRID], ids=names)
def test_so_do_those_of_a_step(engine: FilterEngine) -> None:
    if engine is GRID:
        engine = bmc.GridFilter({"x": (-12.0, 12.0, 60)})
    belief = engine.start(scaled(), rng=0)
    for k in range(BROKEN):
        belief = engine.step(belief, {"y": ROWS[k]}, inputs={"s": SCALES[k]})
    row, scale = {"y": ROWS[BROKEN]}, {"s": SCALES[BROKEN]}
    error = caught(ParameterError, lambda: engine.step(belief, row, inputs=scale))
    assert str(error).count(f"slice {BROKEN}") == 1 and error.filtered is None
    assert engine.step(belief, row, inputs={"s": 1.0}).t == BROKEN  # the belief is as it was


def test_what_is_computed_of_inputs_names_its_slice_too() -> None:
    """The extended filter computes it for all slices ahead, so nothing is done by then."""

    def decayed(total_prev: Any, clock: Any) -> Any:
        if float(np.ravel(clock)[0]) == BROKEN:
            raise Broken
        return total_prev + clock

    dbn = bmc.DynamicBayesNet()
    dbn.input("clock")
    dbn.add("total", decayed, initial=lambda clock: 0.0 * clock)
    dbn.add(
        "x", lambda x_prev, total: bmc.Normal(x_prev, 1.0 + total), initial=bmc.Normal(0.0, 1.0)
    )
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    clock = {"clock": np.arange(float(STEPS))}
    engine = bmc.ExtendedKalmanFilter()
    error = caught(ModelError, lambda: bmc.filter(dbn, {"y": ROWS}, inputs=clock, engine=engine))
    assert str(error).count(f"slice {BROKEN}: node 'total'") == 1 and error.filtered is None


# ---- exact engines ------------------------------------------------------------------------------


def test_the_kalman_filter_has_the_answers_before_a_row_without_a_density() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    dbn.add("u", bmc.Uniform(0.0, 1.0), initial=bmc.Uniform(0.0, 20.0))
    inside = np.full(STEPS, 0.5)
    inside[BROKEN] = 0.0
    dbn.add("v", lambda u: bmc.Uniform(0.0, u))
    seen = {"y": ROWS, "u": np.full(STEPS, 0.7), "v": np.where(inside > 0.0, 0.5, 0.9)}
    engine = bmc.KalmanFilter()
    error = caught(DegeneracyError, lambda: bmc.filter(dbn, seen, engine=engine))
    before = {n: v[:BROKEN] for n, v in seen.items()}
    assert error.t == BROKEN
    assert differences(error.filtered, bmc.filter(dbn, before, engine=engine)) == []


def test_the_grid_keeps_densities_before_a_row_that_no_cell_explains() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.3), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Uniform(x - 1.0, x + 1.0))
    engine = bmc.GridFilter({"x": (-5.0, 5.0, 200)}, tolerance=np.inf)
    rows = [0.1, 0.3, -0.1, 90.0, 0.0]
    error = caught(ZeroProbabilityError, lambda: bmc.filter(dbn, {"y": rows}, engine=engine))
    wanted = bmc.filter(dbn, {"y": rows[:3]}, engine=engine)
    assert differences(error.filtered, wanted) == []
    np.testing.assert_array_equal(error.filtered.density("x"), wanted.density("x"))


def test_every_error_of_the_library_can_be_asked() -> None:
    assert BayesmcError("elsewhere").filtered is None


# ---- options ------------------------------------------------------------------------------------


@pytest.mark.parametrize("option", ["proposal", "initial_proposal", "rejuvenation"])
def test_a_wrong_option_is_named(option: str) -> None:
    more = {"on_degeneracy": "rejuvenate"} if option == "rejuvenation" else {}
    for given, words in [
        (lambda y: bmc.Normal(y, 1.0), rf"ParticleFilter\({option}=<function"),
        ({3: lambda y: bmc.Normal(y, 1.0)}, f"the key 3 of {option}="),
        ({"x": 3.5}, f"the {option} for 'x' is 3.5"),
    ]:
        with pytest.raises(TypeError, match=words):
            bmc.ParticleFilter(10, **{option: given}, **more)
