"""Digests: equal for equal values in any process, another one for each change that a function could see."""

import array
import collections
import decimal
import functools
import importlib
import os
import subprocess
import sys
import threading
import types

import numpy as np
import pytest
from scipy.spatial import cKDTree

import bayesmc as bmc
from bayesmc.network.digest import digest, is_installed
from bayesmc.network.fingerprint import fingerprint


def reading(value):
    return lambda x: (value, x)


def a_class(k, how):
    def own(self, v):
        return 2.0 * v

    def other(self, v):
        return 5.0 * v

    body = {"r": own if k == 2.0 else other}
    if how == "static":
        body = {"r": staticmethod(body["r"])}
    if how == "call":
        body = {"__call__": body["r"]}
    if how == "attribute":
        body = {"K": k}
    if how == "property":
        body = {"r": property(body["r"])}
    return type("Sensor", (), body)


def deep(k):
    for _ in range(30):
        k = [k]
    return k


def cached(k):
    return functools.lru_cache(None)(lambda v: k * v)


def wrapped(k):
    return functools.wraps(np.sin)(lambda v: k * v)


MAKERS = {
    "number": lambda k: k,
    "deque": lambda k: collections.deque([k]),
    "array.array": lambda k: array.array("d", [k]),
    "bytearray": lambda k: bytearray([int(k)]),
    "Decimal": lambda k: (decimal.Decimal(k),),
    "object array": lambda k: np.array([decimal.Decimal(k), types.SimpleNamespace(v=k)], dtype=object),
    "set": lambda k: {k, "a", (1, 2)},
    "mapping within a mapping": lambda k: {"a": {"b": 1}, "c": 2} if k == 2 else {"a": {"b": 1, "c": 2}},
    "ordered": lambda k: collections.OrderedDict(a=k),
    "search tree": lambda k: cKDTree([[0.0], [k]]),
    "thirty lists": deep,
    "np.vectorize": lambda k: np.vectorize(lambda v: k * v),
    "cache": cached,
    "wraps": wrapped,
    "partial": lambda k: functools.partial(max, k),
    "bound method of a builtin": lambda k: {"a": k}.get,
    "method": lambda k: a_class(k, "")(),
    "bound method": lambda k: a_class(k, "")().r,
    "static method": lambda k: a_class(k, "static"),
    "__call__": lambda k: a_class(k, "call")(),
    "class attribute": lambda k: a_class(k, "attribute")(),
    "property": lambda k: a_class(k, "property")(),
    "inherited": lambda k: type("Child", (a_class(k, ""),), {})(),
    "lock beside a number": lambda k: types.SimpleNamespace(lock=threading.Lock(), k=k),
    "distribution": lambda k: bmc.Normal(k, 1.0),
}  # fmt: skip


@pytest.mark.parametrize("what", MAKERS)
def test_a_change_that_a_function_could_see_is_seen(what):
    make = MAKERS[what]
    assert digest(reading(make(2.0))) == digest(reading(make(2.0)))
    assert digest(reading(make(2.0))) != digest(reading(make(5.0)))


def test_a_module_of_ones_own_counts_by_what_is_read_of_it(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)

    def found(body):
        (tmp_path / "own_helpers.py").write_text(body)
        sys.modules.pop("own_helpers", None)
        importlib.invalidate_caches()
        sys.dont_write_bytecode = True
        helpers = importlib.import_module("own_helpers")

        def late(x):
            import own_helpers

            return own_helpers.K * x

        return digest(lambda x: helpers.g(x)), digest(lambda x: helpers.K * x), digest(late)

    before = sys.dont_write_bytecode
    try:
        base = found("K = 2.0\ndef g(v):\n    return 2.0 * v\n")
        assert base == found("K = 2.0\ndef g(v):\n    return 2.0 * v\n")
        function, constant, late = found("K = 3.0\ndef g(v):\n    return 2.0 * v\n")
        assert function == base[0] and constant != base[1] and late != base[2]
        assert found("K = 2.0\ndef g(v):\n    return 3.0 * v\n")[0] != base[0]
    finally:
        sys.dont_write_bytecode = before
        sys.modules.pop("own_helpers", None)


SCRIPT = """
import collections, dataclasses, enum
import numpy as np
from bayesmc.network.digest import digest
class Kind(enum.Enum):
    A = 1
    B = 2
@dataclasses.dataclass
class Setting:
    names: set
    kind: Kind = Kind.A
    def of(self, x):
        return len(self.names) * x if self.kind is Kind.A else x
    @property
    def twice(self):
        return 2
own = Setting({"a", "b", "c", "long name"})
table = collections.defaultdict(list, {"x": [np.arange(3)]})
def helper(x):
    return own.of(x) + own.twice + np.where(x > 0, 1, 2) + len(table["x"])
print(digest(lambda x: helper(x) if x else helper(-x)))
"""


def test_another_process_with_other_hashes_finds_the_same(tmp_path):
    path = tmp_path / "script.py"
    path.write_text(SCRIPT)
    found = {
        subprocess.run(
            [sys.executable, str(path)],
            env={**os.environ, "PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed in ("1", "2")
    }
    assert len(found) == 1


def test_functions_that_read_each_other_end():
    def even(n):
        return n == 0 or odd(n - 1)

    def odd(n):
        return n != 0 and even(n - 1)

    many = [lambda x, k=k: (many, k) for k in range(40)]  # each reads all
    assert digest(even) != digest(odd)
    assert len(digest(many)) == 16


def test_packages_are_told_by_name():
    assert (
        is_installed("numpy.linalg")
        and is_installed("decimal")
        and not is_installed("numpyro_like")
    )
    assert not is_installed("__main__") and not is_installed("tests.network.test_digest")


def net_reading(large, lock=None):
    net = bmc.BayesNet()
    net.add("m", bmc.Normal(0.0, 1.0))
    net.add("y", lambda m: bmc.Normal(m * large[0] + 0 * large.sum(), 1.0))
    return net


def test_a_large_array_that_changes_in_place_is_seen():
    large = np.ones(5_000)
    net = net_reading(large)
    before = fingerprint(net.model({}, {}))
    assert before == fingerprint(net.model({}, {})) == fingerprint(net_reading(large).model({}, {}))
    large[:] = 2.0
    assert before != fingerprint(net.model({}, {}))


def test_what_cannot_be_looked_into_is_a_warning():
    counted = (k for k in range(3))
    net = bmc.BayesNet()
    net.add("m", bmc.Normal(0.0, 1.0))
    net.add("y", lambda m: bmc.Normal(float(m) + len([counted]), 1.0), vectorize=True)
    with pytest.warns(
        bmc.errors.CheckpointWarning, match=r"'y' reads a generator, .* cannot be compared"
    ):
        fingerprint(net.model({}, {}))
