"""What travels to workers, what comes back, and what is said of things that do not."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import WorkerError
from bayesmc.network import pose
from bayesmc.workers.memory import Held, drop, folder, hold, opened
from tests.workers.test_units import Elsewhere

pytest.importorskip("cloudpickle", reason="units travel by cloudpickle: bayesmc[workers]")
travel = pytest.importorskip("bayesmc.workers.travel")


def net_with(scale: Any) -> bmc.BayesNet:
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda x: bmc.Normal(x, scale))
    return net


def test_engines_keep_their_functions_on_the_way() -> None:
    engine = bmc.Importance(100, proposal={"x": lambda y: bmc.Normal(0.5 * y, 0.8)})
    there = travel.unpacked(travel.packed(engine))
    posterior = bmc.infer(net_with(1.0), {"y": 0.7}, engine=engine, rng=0)
    again = bmc.infer(net_with(1.0), {"y": 0.7}, engine=there, rng=0)
    assert np.array_equal(posterior["x"], again["x"])


def test_what_both_sides_have_is_named() -> None:
    problem = pose(net_with(1.0), {"y": 0.7})
    known = travel.known_to({"problem": problem})
    data = travel.packed({"p": problem, "m": problem.model}, known)
    assert len(data) < 200
    back = travel.unpacked(data, known)
    assert back["p"] is problem and back["m"] is problem.model


def test_answers_from_workers_still_evaluate_functions() -> None:
    engine = bmc.LikelihoodWeighting(2000)
    posteriors = bmc.infer_many(
        net_with(0.5), [{"y": 0.7}, {"y": 1.0}], engine=engine, rng=0, executor=Elsewhere()
    )
    drawn = posteriors[0].predict("y", rng=1)
    assert drawn["y"].shape[1] == 2000


def test_what_does_not_travel_is_named_before_work_starts() -> None:
    lock = threading.Lock()
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))

    def seen(x: Any) -> Any:
        with lock:
            return bmc.Normal(x, 1.0)

    net.add("y", seen)
    executor = Elsewhere()
    engine = bmc.LikelihoodWeighting(1000)
    with pytest.raises(WorkerError, match="function of node 'y' reads 'lock', a lock"):
        bmc.infer(net, {"y": 0.2}, engine=engine, executor=executor)
    assert executor.sent == 0


def test_shared_memory_is_mapped_and_given_back() -> None:
    with folder() as where:
        value = {"a": np.arange(10.0), "b": (np.ones((2, 3)), "text"), "none": np.zeros(0)}
        held = hold(value, where)
        back = opened(held)
        assert np.array_equal(back["a"], value["a"]) and back["b"][1] == "text"
        assert not back["a"].flags.writeable
        drop([held], [held])
        opened(held)
        drop([held], [])
        with pytest.raises(FileNotFoundError):
            opened(held)
        assert isinstance(held, Held) and opened("other") == "other"
