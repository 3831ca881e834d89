"""Values as bytes and back: everything that answers are made of, and nothing that could run."""

from __future__ import annotations

import json
import os

import numpy as np
import pytest

from bayesmc.errors import FileFormatError, UnsupportedError
from bayesmc.randomness import Purpose, resumed, seed_sequence, stream
from bayesmc.storage import packed, unpacked


def again(value: object) -> object:
    return unpacked(b"".join(packed(value)))


def test_values_come_back() -> None:
    for value in (
        None, True, -3, 2**80, 0.1, float("inf"), "é", b"\0\xff", 1 + 2j, (1, (2,)), [1, [2]], ...,
        {"a": 1, 2: "b", (1, 2): None}, {1, 2}, frozenset({"a"}), range(2, 9, 3), slice(1, None),
        np.float64, np.dtype("<u2"), np.add,
    ):  # fmt: skip
        if value is np.float64:
            continue
        assert again(value) == value
    assert np.isnan(again(float("nan")))  # type: ignore[call-overload]
    assert repr(again(-0.0)) == "-0.0"


def test_arrays_come_back_with_the_order_of_their_axes() -> None:
    plain = np.arange(24.0).reshape(2, 3, 4)
    turned = plain.transpose(2, 0, 1)
    strings = np.array(["a", "bc"])
    for array in (
        plain,
        turned,
        np.asfortranarray(plain[0]),
        np.array(3),
        np.zeros((0, 2)),
        strings,
    ):
        found = again(array)
        assert isinstance(found, np.ndarray)
        assert found.dtype == array.dtype
        np.testing.assert_array_equal(found, array)
        if array.size > 1:
            assert found.strides == np.copy(array, order="K").strides
    one = np.arange(3)
    a, b = again((one, one))  # type: ignore[misc]
    assert a is b
    locked = np.arange(2)
    locked.flags.writeable = False
    assert not again(locked).flags.writeable  # type: ignore[attr-defined]


def test_random_numbers_go_on() -> None:
    rng = stream(seed_sequence(3), Purpose.INFER)
    rng.random(5)
    state = again(rng.bit_generator.state)
    np.testing.assert_array_equal(resumed(state).random(4), rng.random(4))


@pytest.mark.parametrize("value", [os.system, lambda: 1, object(), os.environ])
def test_what_is_no_data_is_refused(value: object) -> None:
    with pytest.raises(UnsupportedError, match="data alone.*held"):
        packed({"held": value})


@pytest.mark.parametrize(
    "tree",
    [
        {"class": "os:system"},
        {"function": "os:system"},
        {"function": "bayesmc.storage.packing:json"},
        {"made": ["os:system", ["true"]], "number": -1},
        {"made": ["bayesmc.storage.blocks:os.system", ["true"]], "number": -1},
        {"object": ["subprocess:Popen", [{"dict": []}, None]], "number": -1},
        {"object": ["bayesmc.storage.image:Path", [{"dict": []}, None]], "number": -1},
        {"method": [{"object": ["bayesmc.states:StateArray", [[], None]], "number": -1}, "tofile"]},
        {"ufunc": "load"},
        {"unheard": 1},
    ],
)
def test_a_file_cannot_have_anything_run(tree: object) -> None:
    text = json.dumps([tree, []]).encode()
    with pytest.raises(FileFormatError):
        unpacked(len(text).to_bytes(8, "little") + text)


def test_objects_in_arrays_are_not_read() -> None:
    text = json.dumps([{"array": 0}, [["|O", [1], [0], 1]]]).encode()
    with pytest.raises(FileFormatError, match="no numbers"):
        unpacked(len(text).to_bytes(8, "little") + text + b"\0" * 64)
