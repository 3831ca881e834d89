"""Labelled states: codes that compare with labels and with nothing else by accident."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

from bayesmc.errors import StateError
from bayesmc.states import NumberArray, StateArray, as_numbers, label_array, label_code

STATES = ("low", "mid", "high")


@pytest.fixture
def x():
    return StateArray(np.array([[0, 1, 2], [2, 1, 1]]), STATES)


def test_comparison_with_a_label_is_elementwise(x):
    for code, label in enumerate(STATES):
        np.testing.assert_array_equal(x == label, x.codes == code)
        np.testing.assert_array_equal(label == x, x.codes == code)
        np.testing.assert_array_equal(x != label, x.codes != code)
        np.testing.assert_array_equal(x == np.str_(label), x.codes == code)
        assert type(x == label) is np.ndarray


def test_comparison_with_arrays_of_labels(x):
    other = np.array([["low", "low", "high"], ["mid", "mid", "mid"]])
    np.testing.assert_array_equal(x == other, x.labels == other)
    np.testing.assert_array_equal(x == other.tolist(), x.labels == other)
    np.testing.assert_array_equal(x == other.astype(object), x.labels == other)


@pytest.mark.parametrize("label", ["hihg", "", "Low", None])
def test_an_unknown_label_raises_with_the_allowed_ones(x, label):
    for compare in (lambda: x == label, lambda: x != label, lambda: label == x):
        with pytest.raises(StateError, match="is not a state; the states are 'low', 'mid', 'high'"):
            compare()
    with pytest.raises(StateError, match="'bad' is not a state"):
        x == ["low", "bad", "mid"]  # noqa: B015


def test_comparison_between_nodes():
    a = StateArray([0, 1, 1], ("no", "yes"))
    b = StateArray([0, 0, 1], ("no", "yes"))
    assert (a == b).tolist() == [True, False, True]
    swapped = StateArray([1, 1, 0], ("yes", "no"))  # the same labels in another order
    assert swapped.tolist() == b.tolist() == ["no", "no", "yes"]
    assert (swapped == b).all() and (b == swapped).all() and not (b != swapped).any()
    assert (a == swapped).tolist() == [True, False, True]


def test_arithmetic_gives_integers_without_labels(x):
    for result in (x + 1, x * 2, np.maximum(x, 1), x < 2, -x, np.minimum(x, x), x & x):
        assert type(result) is NumberArray and not isinstance(result, StateArray)
        with pytest.raises(StateError, match=r"label 'mid'.*declare it with states="):
            result == "mid"  # noqa: B015
    np.testing.assert_array_equal(x + 1, x.codes + 1)
    assert x.sum() == x.codes.sum() and x.max() == 2
    assert x.astype(float).dtype == float and not isinstance(x.astype(float), StateArray)


def test_shape_operations_keep_the_labels(x):
    for part in (
        x[0],
        x[..., 1],
        x[:, None],
        x.T,
        x.reshape(-1),
        x[np.array([1, 0])],
        x[x == "mid"],
        np.take(x, [0, 1], axis=1),
        x.copy(),
        np.broadcast_to(x, (4, 2, 3), subok=True),
        x.squeeze(),
    ):
        assert isinstance(part, StateArray) and part.states == STATES
    one = x[0, 1]
    assert isinstance(one, StateArray) and one == "mid" and str(one) == "mid"
    assert [str(v) for v in x[0]] == list(STATES)


def test_functions_that_move_elements_keep_the_labels(x):
    y = StateArray(x.codes[::-1].copy(), STATES)
    for moved, codes in (
        (np.stack([x, y], axis=-1), np.stack([x.codes, y.codes], axis=-1)),
        (np.concatenate([x, y]), np.concatenate([x.codes, y.codes])),
        (np.where(x == "mid", x, y), np.where(x.codes == 1, x.codes, y.codes)),
        (np.broadcast_to(x[0], (2, 3)), np.broadcast_to(x.codes[0], (2, 3))),
        (np.broadcast_arrays(x, y[0])[1], np.broadcast_to(y.codes[0], (2, 3))),
        (np.copy(x), x.codes),
        (np.roll(x, 1, axis=-1), np.roll(x.codes, 1, axis=-1)),
        (np.take_along_axis(x, np.array([[0], [2]]), axis=1), x.codes[[0, 1], [0, 2]][:, None]),
        (np.moveaxis(x, 0, 1), x.codes.T),
    ):
        assert isinstance(moved, StateArray) and moved.states == STATES
        np.testing.assert_array_equal(moved.codes, codes)


def test_moving_unlike_things_together_loses_the_labels_loudly(x):
    other = StateArray([0, 1, 1], ("a", "b"))
    for moved in (
        np.stack([x[0], other]),
        np.concatenate([x[0], np.arange(3)]),
        np.where(x[0] == "mid", x[0], 0),
        np.where(x[0] == "mid", x[0], other),
    ):
        assert type(moved) is NumberArray
        with pytest.raises(StateError, match="'mid'.*states="):
            moved == "mid"  # noqa: B015


@pytest.mark.parametrize("label", ["mid", np.str_("mid"), np.array(["mid"]), np.array("mid")])
def test_numbers_refuse_labels(label):
    for numbers in (
        as_numbers(np.arange(3)),
        as_numbers(np.arange(3.0)) * 2,
        as_numbers(np.array(1)),
    ):
        for compare in (
            lambda n=numbers: n == label,
            lambda n=numbers: n != label,
            lambda n=numbers: label == n,
            lambda n=numbers: np.equal(n, label),
            lambda n=numbers: n[..., None] == label,
            lambda n=numbers: np.copy(n) == label,
        ):
            with pytest.raises(StateError, match="mid.*no labels.*states="):
                compare()


@pytest.mark.parametrize(
    "compare",
    [
        lambda n: n == ["mid"],
        lambda n: n != np.array(["mid"], dtype=object),
        lambda n: np.isin(n, ["mid", "high"]),
        lambda n: np.isin(n, "mid"),
    ],
    ids=["list", "objects", "isin", "isin one"],
)
def test_numbers_refuse_lists_of_labels(compare):
    for numbers in (as_numbers(np.arange(3)), as_numbers(np.array(1))):
        with pytest.raises(StateError, match="mid.*no labels.*states="):
            compare(numbers)
    assert np.isin(as_numbers(np.arange(3)), [1, 2]).tolist() == [False, True, True]


def test_numbers_are_numbers_otherwise():
    plain = np.array([[0.5, 2.0], [3.0, -1.0]])
    numbers = as_numbers(plain)
    for function in (
        lambda v: v + 1,
        lambda v: np.exp(v),
        lambda v: v == 2.0,
        lambda v: v[..., 0],
        lambda v: np.where(v > 0, v, 0.0),
        lambda v: np.vecdot(v, v),
        lambda v: v @ v,
        lambda v: v.sum(axis=-1),
        lambda v: np.cumsum(v, axis=-1),
        lambda v: np.linalg.norm(v, axis=-1),
    ):
        np.testing.assert_array_equal(np.asarray(function(numbers)), function(plain))
    assert repr(numbers) == repr(plain) and float(numbers[0, 0]) == 0.5
    assert as_numbers(plain) is not plain and type(plain) is np.ndarray
    out = np.empty(2)
    np.add(numbers[0], 1.0, out=out)
    assert out.tolist() == [1.5, 3.0]


def test_where_select_and_isin(x):
    np.testing.assert_array_equal(
        np.where(x == "low", 10.0, 0.0), np.where(x.codes == 0, 10.0, 0.0)
    )
    np.testing.assert_array_equal(
        np.select([x == "low", x == "high"], [1.0, 2.0], 0.0), np.array([1.0, 0, 2.0])[x.codes]
    )
    np.testing.assert_array_equal(x.isin(["low", "high"]), x.codes != 1)
    np.testing.assert_array_equal(np.isin(x, ["low", "high"]), x.codes != 1)
    with pytest.raises(StateError, match="'oops' is not a state"):
        np.isin(x, ["low", "oops"])


def test_labels_lists_and_text(x):
    assert x.tolist() == [["low", "mid", "high"], ["high", "mid", "mid"]]
    assert x.labels.tolist() == x.tolist()
    assert f"{x[0, 0]}" == "low" and f"{x[0, 0]:>5}" == "  low"
    assert repr(x[0]) == "StateArray(['low', 'mid', 'high'])"


def test_a_single_state_is_a_key():
    one = StateArray(np.array(1), STATES)
    assert {"low": 1, "mid": 2, "high": 3}[one] == 2
    with pytest.raises(TypeError, match="unhashable"):
        hash(StateArray([0, 1], STATES))


def test_copies_and_pickles_keep_the_labels(x):
    for twin in (copy.copy(x), copy.deepcopy(x), pickle.loads(pickle.dumps(x))):
        assert isinstance(twin, StateArray) and twin.states == STATES
        np.testing.assert_array_equal(twin.codes, x.codes)


def test_labels_need_not_be_text():
    x = StateArray([0, 1, 2], ("a", 1, None))
    assert (x == "a").tolist() == [True, False, False]
    assert (x == None).tolist() == [False, False, True]  # noqa: E711 - a label here
    with pytest.raises(StateError, match="'1' is not a state"):
        x == "1"  # noqa: B015
    assert label_code((True, "yes"), True) == 0


def test_label_arrays_and_codes():
    assert label_array(("a", "bb")).dtype.kind == "U"
    assert label_array(("a", 1)).dtype == object
    assert label_code(STATES, np.str_("high")) == 2
    assert label_code((0.5, "x"), np.float64(0.5)) == 0
