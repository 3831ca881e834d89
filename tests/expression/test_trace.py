"""What is followed, what is not, and why."""

from __future__ import annotations

import datetime
import functools
import os
import random
import time
import types

import numpy as np
import pytest
from scipy import special, stats

import bayesmc as bmc
from bayesmc.errors import TraceError
from bayesmc.expression import (
    Family,
    Gather,
    TracedArray,
    TracedStates,
    elementwise,
    evaluate,
    expressions_of,
    leaf,
    pick,
    rebuilt,
    trace,
)
from bayesmc.plates import PlateArray

X = TracedArray(leaf("x", (3,)))
K = TracedArray(leaf("k", (), int))
GENERATOR = np.random.default_rng(0)
TABLE = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
CALLS = [0]


def values(traced, **leaves):
    return evaluate(list(expressions_of(traced)), {k: np.asarray(v) for k, v in leaves.items()})


def test_equal_expressions_are_one():
    first = trace(lambda x: np.exp(x[..., 0]) + 1, [X])
    assert first is trace(lambda y: np.exp(y[..., 0]) + (2 - 1), [X])
    assert first is not trace(lambda x: np.exp(x[..., 1]) + 1, [X])
    assert elementwise(np.add, 1.0, 2.0).value == 3.0
    assert pick([pick([leaf("x", (3,))], [2, 1, 0])], [2, 1, 0]) is leaf("x", (3,))


def test_a_distribution_is_a_family_of_expressions():
    traced = trace(lambda x, k: bmc.Normal(TABLE[k, 1] * x[..., 0], np.exp(x[..., 1])), [X, K])
    assert isinstance(traced, Family)
    assert traced.make is bmc.Normal
    x, k = np.array([[0.5, 0.1, 0.0], [1.0, 0.2, 9.0]]), np.array([2, 0])
    dist = rebuilt(traced, iter(values(traced, x=x, k=k)))
    np.testing.assert_allclose(dist.loc, [3.0, 2.0])
    np.testing.assert_allclose(dist.scale, np.exp([0.1, 0.2]))


def test_scipy_families_are_followed():
    traced = trace(lambda x: stats.gamma(2.0, scale=np.exp(x[..., 0])), [X])
    frozen = rebuilt(traced, iter(values(traced, x=np.zeros(3))))
    assert frozen.mean() == pytest.approx(2.0)


def test_gathers_along_a_plate_stay_gathers():
    mean = PlateArray(TracedArray(leaf("mean", (1, 3))), ("cluster",), own=1)
    label = TracedArray(leaf("label", (5,), int))
    found = trace(lambda mean, label: np.exp(mean)[label], [mean, label])
    assert isinstance(found, Gather)
    drawn = np.array([2, 0, 0, 1, 2])
    (result,) = values(found, mean=np.log([[1.0, 2.0, 3.0]]), label=drawn)
    np.testing.assert_allclose(result, [3.0, 1.0, 1.0, 2.0, 3.0])
    with pytest.raises(IndexError, match=r"outside of 0\.\.2"):
        values(found, mean=np.zeros((1, 3)), label=drawn - 1)


def test_labels_compare():
    weather = TracedStates(leaf("w", (), int), ("sun", "rain"))
    found = trace(lambda w: np.where((w == "rain") | w.isin(["sun"]), 1.0, 0.0), [weather])
    assert values(found, w=[0, 1])[0].tolist() == [1.0, 1.0]
    for function in (lambda w: w == "snow", lambda w: np.exp(w) > "sun"):
        with pytest.raises(TraceError):
            trace(function, [weather])


def test_an_index_from_the_end_wraps_as_in_numpy():
    found = trace(lambda k: TABLE[k - 1, 0], [K])
    assert values(found, k=[0, 1])[0].tolist() == [5.0, 1.0]


def test_arrays_that_are_filled():
    def function(x):
        out = np.zeros((2, 3))
        out[0] = x
        out[1, 1:] = x[1:] ** 2
        out += 1.0
        return out.sum(axis=-1)

    assert values(trace(function, [X]), x=[1.0, 2.0, 3.0])[0].tolist() == [9.0, 16.0]


def _branch(x):
    return x if x[0] > 0 else -x


def _swallowed(x):
    try:
        return x if x[0] > 0 else -x
    except Exception:
        return 2 * x


def _counting(x):
    CALLS[0] += 1
    return x * CALLS[0]


def _clock(x):
    return x * (time.time() > 0)


def _drawn(x):
    return x + GENERATOR.normal()


def _numpy_drawn(x):
    return x + np.random.default_rng(1).normal()


def _python_drawn(x):
    return x + random.random()


def _shrunk(x):
    while x[0] > 1:
        x = x / 2
    return x


class _Sensor:
    """An object of a user's, whose methods lie."""

    def __init__(self):
        self.calls = 0

    def clock(self, x):
        return x * (time.time() > 0)

    def counted(self, x):
        self.calls += 1
        return x if self.calls < 100 else 2 * x

    def branch(self, x):
        return x if self.above(x) else -x

    def above(self, x):
        return x[..., 0] > 0


class _Clock:
    def __call__(self, x):
        return x * (time.time() > 0)


class _Loud(_Sensor):
    """Whose lie is inherited, and hidden behind another call."""

    def read(self, x):
        return self.clock(x)


SENSOR, LOUD = _Sensor(), _Loud()
HELPERS = types.ModuleType("helpers")
exec("import time\ndef clock(x):\n    return x * (time.time() > 0)", HELPERS.__dict__)


LIES = {
    "a branch": (_branch, "truth"),
    "a branch whose error is swallowed": (_swallowed, "truth"),
    "a counter": (_counting, "differ"),
    "the clock": (_clock, "time"),
    "random numbers": (_drawn, "random numbers from GENERATOR"),
    "random numbers of its own": (_numpy_drawn, "random"),
    "random numbers of Python": (_python_drawn, "random"),
    "a clock behind a method": (lambda x: SENSOR.clock(x), "time"),
    "a clock behind two methods": (lambda x: LOUD.read(x), "time"),
    "a clock in a method": (SENSOR.clock, "time"),
    "a clock in a callable object": (_Clock(), "time"),
    "a clock in an object that is made": (lambda x: _Clock()(x), "time"),
    "a clock in another module": (lambda x: HELPERS.clock(x), "time"),
    "a clock in a loop's function": (lambda x: sum(f(x) for f in [_clock, np.sin]), "time"),
    "a clock in a partial": (functools.partial(lambda f, x: f(x), _clock), "time"),
    "the date": (lambda x: x * (datetime.date.today().year > 2000), "datetime"),
    "the environment": (lambda x: x * len(os.environ), "os"),
    "random integers of NumPy": (lambda x: x + np.random.randint(3), "random"),  # noqa: NPY002
    "a branch in a method": (SENSOR.branch, "truth"),
    "a branch on a reduction": (lambda x: x if np.all(x > 0) else -x, "truth"),
    "a branch on a string of it": (lambda x: x * len(str(x.tolist())), "."),
    "a loop over a value": (lambda x: sum(x[0] for _ in range(x[0])), "."),
    "a while loop": (_shrunk, "truth"),
    "a key": (lambda x: {0.0: 1.0}.get(x[0], 2.0) * x, "hash"),
    "item()": (lambda x: x * x[0].item(), "."),
    "the largest of Python": (lambda x: x * sorted(x)[0], "truth"),
    "float()": (lambda x: float(x[0]) * x, r"float\(\)"),
    "math of Python": (lambda x: x * max(x[0], x[1]), "truth"),
    "a callback": (lambda x: np.apply_along_axis(lambda v: 2 * v, -1, x), "hands the numbers on"),
    "a parent that is written to": (lambda x: np.add(x, 1, out=x), "read-only"),
    "an index by floats": (lambda x: TABLE[x[0]], "whole number"),
}


@pytest.mark.parametrize("name", LIES)
def test_what_cannot_be_followed_is_refused(name):
    function, why = LIES[name]
    with pytest.raises(TraceError, match=why):
        trace(function, [X])


def test_scipy_functions_that_are_no_ufuncs():
    found = trace(
        lambda x: special.logsumexp(x, axis=-1) + special.softmax(x, axis=-1)[..., 0], [X]
    )
    x = np.array([[0.1, -2.0, 3.0], [0.0, 0.0, 0.0]])
    expected = special.logsumexp(x, axis=-1) + special.softmax(x, axis=-1)[..., 0]
    np.testing.assert_allclose(values(found, x=x)[0], expected, rtol=1e-14)


def test_an_index_out_of_a_plate_is_an_error_along_each_of_two_plates():
    table = PlateArray(TracedArray(leaf("t", (2, 3))), ("row", "column"), own=0)
    found = trace(lambda t, k: t[k - 1, k], [table, TracedArray(leaf("k", (), int, states=3))])
    t = np.arange(6.0).reshape(2, 3)
    assert values(found, t=t, k=[1, 2])[0].tolist() == [1.0, 5.0]
    with pytest.raises(IndexError):
        values(found, t=t, k=[0])
