"""What a worker keeps: compiled nets and questions, known by all that travelled, and no more than it may."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.workers import in_order, remote
from tests.workers import functions
from tests.workers.test_units import Elsewhere

pytest.importorskip("cloudpickle", reason="units travel by cloudpickle: bayesmc[workers]")


@pytest.fixture(autouse=True)
def forgetful(monkeypatch: pytest.MonkeyPatch) -> None:
    """A worker that has nothing yet, and is sent only what it asks for."""
    monkeypatch.setattr(remote, "_parts", type(remote._parts)())
    monkeypatch.setattr("bayesmc.workers.units._SMALL", 0)


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Digests of parts as the worker reads them."""
    found: list[str] = []
    plain = remote._keep

    def keep(digest: str, part: Any, size: int) -> None:
        found.append(digest)
        plain(digest, part, size)

    monkeypatch.setattr(remote, "_keep", keep)
    yield found


def net(scale: float) -> bmc.BayesNet:
    found = bmc.BayesNet(plates={"i": 6})
    found.add("a", bmc.Normal(0.0, 1.0))
    found.add("y", lambda a: bmc.StudentT(4.0, a, scale), plates="i")
    return found


def asked(question: bmc.BayesNet, data: Any, seed: int, draws: int = 8) -> list[np.ndarray]:
    engine = bmc.Gibbs(draws, 4, 4, groups=2)
    found = []
    for executor in (None, Elsewhere()):
        with pytest.warns(bmc.errors.ConvergenceWarning):
            posterior = bmc.infer(question, data, engine=engine, rng=seed, executor=executor)
        found.append(posterior["a"])
    return found


def test_a_question_asked_again_is_read_once_and_another_one_anew(read: list[str]) -> None:
    data, one = {"y": np.linspace(-1.0, 1.0, 6)}, net(0.5)
    before, counts = asked(one, data, 1), [len(read)]
    for question, own, seed, draws in (
        (one, data, 2, 8),  # another seed: the same job
        (one, {"y": data["y"] + 1.0}, 2, 8),  # other evidence: the same net
        (one, data, 2, 9),  # another engine: the same net
        (net(2.0), data, 1, 8),  # a function that reads another number: all of it
    ):
        found = asked(question, own, seed, draws)
        assert np.array_equal(found[0], found[1])
        assert not np.array_equal(found[0], before[0])
        counts.append(len(read) - sum(counts))
    assert counts == [2, 0, 1, 1, 2]


def test_what_is_kept_is_bounded_and_asked_for_again(
    read: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(factor: Any) -> None:
        shared = {"factor": factor}
        wanted = [factor * 1, factor * 2]
        found = list(in_order(functions.scaled, shared, range(1, 3), Elsewhere()))
        assert all(np.array_equal(a, b) for a, b in zip(found, wanted, strict=True))

    monkeypatch.setattr(remote, "_KEPT", 3)
    for factor in (1, 2, 3, 1, 4, 1, 2):  # the one used longest ago goes first
        run(factor)
    assert len(remote._parts) == 3 and len(read) == 5
    monkeypatch.setattr(remote, "_BYTES", 20_000)
    for k in range(4):
        run(np.full(1000, float(k)))
        assert sum(size for _, size in remote._parts.values()) <= 20_000
    run(np.arange(4000.0))  # larger than all that may be kept: alone
    assert len(remote._parts) == 1
