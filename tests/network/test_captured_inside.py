"""An object that changes in place under a node's function is an error that names the entry."""

import copy
import functools
import pickle
import time
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import ModelError

ENGINES = [bmc.Exact(), bmc.LikelihoodWeighting(100), bmc.Gibbs(draws=10, warmup=10)]


class Model:
    """The model of the report."""

    def __init__(self):
        self.net = bmc.BayesNet()
        self.net.add("a", bmc.Normal(0.0, 1.0))

    def sensor(self, i):
        self.i = i
        self.net.add(f"y{i}", lambda a: bmc.Normal(a + 10 * self.i, 1.0))


@dataclass
class Settings:
    shift: object = 0.0
    other: float = 0.0
    calls: int = 0

    def at(self, a):
        return a + self.shift

    def mean(self, a):
        self.calls += 1
        return bmc.Normal(self.at(a), 1.0)

    @property
    def doubled(self):
        return 2.0 * self.shift


class Callable(Settings):
    def __call__(self, a):
        return self.mean(a)


class Slotted:
    __slots__ = ("shift",)


def net_of(function):
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("y", function)
    return net


@pytest.mark.parametrize("engine", ENGINES, ids=lambda e: type(e).__name__)
def test_attribute_of_self_in_a_loop(engine):
    model = Model()
    for i in range(3):
        model.sensor(i)
    with pytest.raises(
        ModelError, match=r"'y0'.* reads self\.i, .* was 0 .* is 2 now; .*i=self\.i"
    ):
        bmc.infer(model.net, {"y0": 1.0}, engine=engine, rng=0)


@pytest.mark.parametrize("engine", ENGINES, ids=lambda e: type(e).__name__)
def test_entry_of_a_dict_between_two_questions(engine):
    cfg = {"shift": 0.0}
    net = net_of(lambda a: bmc.Normal(a + cfg["shift"], 1.0))
    assert bmc.infer(net, {"y": 1.0}, engine=bmc.Exact()).mean("a") == pytest.approx(0.5)
    cfg["shift"] = 1.0
    with pytest.raises(ModelError, match=r"reads cfg\['shift'\], .* 0\.0 .* 1\.0 now; .*shift=cfg"):
        bmc.infer(net, {"y": 1.0}, engine=engine, rng=0)


def shift_of(settings):
    return settings.shift


def cases():
    """What is held, a function that reads it, what changes it in place, and words of the error."""
    slotted = Slotted()
    slotted.shift = 0.0

    def put(thing, name, value):
        return lambda: setattr(thing, name, value)

    def item(thing, key, value):
        return lambda: thing.__setitem__(key, value)

    s = [0.0, 1.0]
    yield "list", lambda a: bmc.Normal(a + s[0], 1.0), item(s, 0, 2.0), r"s\[0\]"
    w = [1.0]
    yield "sum", lambda a: bmc.Normal(a + sum(w), 1.0), lambda: w.append(2.0), r"w \(its length\)"
    ns = SimpleNamespace(shift=0.0)
    yield "namespace", lambda a: bmc.Normal(a + ns.shift, 1.0), put(ns, "shift", 1.0), r"ns\.shift"
    d = Settings()
    yield "dataclass", lambda a: bmc.Normal(a + d.shift, 1.0), put(d, "shift", 1.0), r"d\.shift"
    h = Settings()
    yield "helper", lambda a: bmc.Normal(a + shift_of(h), 1.0), put(h, "shift", 1.0), r"h\.shift"
    p = Settings()
    yield "property", lambda a: bmc.Normal(a + p.doubled, 1.0), put(p, "shift", 1.0), r"p\.shift"
    m = Settings()
    yield "by_method", lambda a: m.mean(a), put(m, "shift", 1.0), r"m\.shift"
    b = Settings()
    yield "bound", b.mean, put(b, "shift", 1.0), r"self\.shift"
    c = Callable()
    yield "called", c, put(c, "shift", 1.0), r"self\.shift"
    yield (
        "slots",
        lambda a: bmc.Normal(a + slotted.shift, 1.0),
        put(slotted, "shift", 1.0),
        r"slotted\.shift",
    )
    n = Settings(shift={"by": [0.0]})
    yield (
        "nested",
        lambda a: bmc.Normal(a + n.shift["by"][0], 1.0),
        item(n.shift["by"], 0, 1.0),
        r"n\.shift\['by'\]\[0\]",
    )
    r = {"cov": np.zeros(2)}
    yield (
        "array",
        lambda a: bmc.Normal(a + r["cov"].sum(), 1.0),
        item(r["cov"], 0, 1.0),
        r"cov=r\['cov'\]\.copy\(\)",
    )
    k = {"shift": 0.0}
    yield (
        "default",
        lambda a, k=k: bmc.Normal(a + k["shift"], 1.0),
        item(k, "shift", 1.0),
        r"k=copy\.deepcopy\(k\)",
    )
    q = {"shift": 0.0}
    part = functools.partial(lambda a, opts: bmc.Normal(a + opts["shift"], 1.0), opts=q)
    yield "partial", part, item(q, "shift", 1.0), r"opts\['shift'\]"


@pytest.mark.parametrize("case", list(cases()), ids=lambda c: c[0])
def test_changed_in_place(case):
    _, function, change, words = case
    net = net_of(function)
    net.sample(2, rng=0)
    change()
    with pytest.raises(ModelError, match=rf"node 'y': its function reads .*{words}"):
        net.sample(2, rng=0)


def test_what_may_change_inside():
    """Caches, counters and logs of the function, entries it does not read, entries added one by one."""
    cfg, offsets, log, cache = {"shift": 0.0, "other": 1.0}, [], [], {}
    settings = Settings()
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, 1.0))

    def remembered(a):
        known = cache
        known["last"] = len(known)
        cache.setdefault("first", 0)
        log.append(len(log))
        return bmc.Normal(a + cfg["shift"], 1.0)

    net.add("m", remembered)
    for i in range(3):
        offsets.append(float(i))
        net.add(f"y{i}", lambda a, i=i: bmc.Normal(a + offsets[i], 1.0))
    net.add("z", settings.mean)
    cfg["other"] = settings.other = 2.0
    for _ in range(2):
        net.sample(2, rng=0)
    assert bmc.infer(net, engine=bmc.Exact()).mean("y2") == pytest.approx(2.0)
    assert log and settings.calls and cache


def test_templates_copies_and_pickles():
    settings = Settings()
    dbn = bmc.DynamicBayesNet()
    dbn.add(
        "x", lambda x_prev: bmc.Normal(x_prev + settings.shift, 1.0), initial=bmc.Normal(0.0, 1.0)
    )
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    bmc.filter(dbn, {"y": [1.0]})
    settings.shift = 1.0
    with pytest.raises(ModelError, match=r"reads settings\.shift"):
        bmc.filter(dbn, {"y": [1.0]})
    bound = Settings()
    net = net_of(bound.mean)
    again = pickle.loads(pickle.dumps(net))
    other = copy.deepcopy(net)
    bound.shift = 1.0
    assert again.sample(2, rng=0)["y"].shape == other.sample(2, rng=0)["y"].shape
    with pytest.raises(ModelError, match=r"reads self\.shift"):
        net.sample(2)


def test_many_nodes_cost_little():
    from bayesmc.network.captured import captured, check_captured  # what a net pays for it

    settings, cfg = Settings(), {f"k{i}": float(i) for i in range(100)}
    functions = [
        lambda a, i=i: bmc.Normal(a + cfg[f"k{i}"] + settings.shift, 1.0) for i in range(3000)
    ]
    start = time.process_time()
    found = [SimpleNamespace(name="y", captured=captured(f)) for f in functions]
    check_captured(found)
    assert time.process_time() - start < 2.0
