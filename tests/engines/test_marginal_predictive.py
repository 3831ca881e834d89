"""Choices that only what is seen depends on: weighed together, taken in once; the same as one by one."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.engines.marginal import predictive, step
from bayesmc.engines.marginal.linearised import LinearisedReader

ROWS = 25


def which_mark(vague: float = 5.0, moving: bool = False) -> bmc.DynamicBayesNet:
    """A walker among three marks reads one of them, nobody says which, or nothing at all.

    With ``moving`` what is read tells how fast it goes as well, so that numbers move by the choice.
    """
    dbn = bmc.DynamicBayesNet("walk", plates={"mark": 3})
    dbn.input("local", event_shape=(2,))
    dbn.add("which", bmc.Categorical([0.3, 0.3, 0.3, 0.1]))
    dbn.add("turn", lambda turn_prev: bmc.Normal(0.9 * turn_prev, 0.1), initial=bmc.Normal(0, 0.1))

    def gone(place, turn, speed):
        step = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        return bmc.MvNormal(place + speed * step, scale_diag=[0.05, 0.05])

    dbn.add(
        "place",
        (
            lambda place_prev, turn, which: gone(
                place_prev, turn, 0.1 + 0.4 * (which == 0)[..., None]
            )
        )
        if moving
        else (lambda place_prev, turn: gone(place_prev, turn, 0.1)),
        initial=bmc.MvNormal(np.zeros(2), scale_diag=[0.1, 0.1]),
    )
    dbn.add(
        "at",
        lambda at_prev: bmc.MvNormal(at_prev, scale_diag=[0.0, 0.0]),
        plates="mark",
        initial=bmc.MvNormal(np.zeros(2), scale_diag=[vague, vague]),
    )

    @dbn.node
    def off(place, turn, at, which, local):
        c, s = np.cos(turn), np.sin(turn)
        x, y = local[..., 0], local[..., 1]
        put = place + np.stack([c * x - s * y, s * x + c * y], axis=-1)
        none = (which == 3)[..., None]
        mean = np.where(none, 0.0, put - at[np.minimum(which, 2)])
        return bmc.MvNormal(mean, scale_diag=np.where(none, 3.0, 0.1) * np.ones(2))

    return dbn


def asked(dbn: bmc.DynamicBayesNet, seed: int = 0, **rows: Any) -> Any:
    rng = np.random.default_rng(seed)
    marks = np.array([[2.0, 0.0], [2.5, 1.0], [0.0, 3.0]])
    local = marks[rng.integers(3, size=ROWS)] - np.outer(np.arange(ROWS), [0.1, 0.0])
    local = local + 0.1 * rng.normal(size=(ROWS, 2))
    engine = bmc.ParticleFilter(30, marginalize=("place", "turn", "at"), proposal="optimal")
    seen = {"off": np.zeros((ROWS, 2))} | rows
    return bmc.filter(dbn, seen, inputs={"local": local}, engine=engine, rng=seed)


def one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(LinearisedReader, "seen_alone", lambda *_: False)


def counted(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Whether rows were weighed together, row by row."""
    calls: list[bool] = []

    def spy(*arguments: Any) -> Any:
        found = predictive.weighed(*arguments)
        calls.append(found is not None)
        return found

    monkeypatch.setattr(step, "weighed", spy)
    return calls


def same(found: Any, other: Any, names: Sequence[str], rel: float = 1e-9) -> None:
    assert found.log_marginal_likelihood == pytest.approx(other.log_marginal_likelihood, rel=rel)
    for name in names:
        np.testing.assert_allclose(found.mean(name), other.mean(name), rtol=rel, atol=1e-12)
        np.testing.assert_allclose(found.var(name), other.var(name), rtol=rel, atol=1e-12)


def test_as_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = counted(monkeypatch)
    found = asked(which_mark())
    assert len(calls) >= ROWS and all(calls)
    together = len(calls)
    one_by_one(monkeypatch)
    other = asked(which_mark())
    assert len(calls) == together
    same(found, other, ("place", "turn", "at", "which"))
    assert (found.var("at")[-1] < 4.0).all()  # of 25: all marks were met


@pytest.mark.parametrize("vague", [1.0, 1e3, 1e6, 1e8])
def test_two_readings_of_a_vague_number_keep_their_digits(
    monkeypatch: pytest.MonkeyPatch, vague: float
) -> None:
    """The second is a difference of numbers of the size of the first: 14 digits and more."""

    def net() -> bmc.DynamicBayesNet:
        dbn = bmc.DynamicBayesNet("two readings", plates={"look": 3})
        dbn.add("x", lambda x_prev: bmc.Normal(np.sin(x_prev), 0.1), initial=bmc.Normal(0, vague))
        dbn.add("stray", bmc.Bernoulli(0.2))

        def read(x, stray):
            return bmc.Normal(np.where(stray == 1, np.tanh(x), x), 0.001)

        dbn.add("y", read)
        dbn.add("z", lambda x, stray: read(x, stray), plates="look")
        return dbn

    engine = bmc.ParticleFilter(5, marginalize=("x",), proposal="optimal")
    looks = 3.0 + np.array([[0.002, -0.001, 0.0015]])
    rows = {"y": np.array([3.0, 0.2]), "z": np.concatenate([looks, looks - 2.8])}
    calls = counted(monkeypatch)
    found = bmc.filter(net(), rows, engine=engine, rng=0)
    assert all(calls) and calls
    assert found.mean("x")[0] == pytest.approx(3.000625, rel=1e-9 if vague > 1.0 else 1e-3)
    if vague > 1.0:
        assert found.var("x")[0] == pytest.approx(0.25e-6, rel=1e-9)
    one_by_one(monkeypatch)
    same(found, bmc.filter(net(), rows, engine=engine, rng=0), ("x", "stray"), 1e-8)


def test_numbers_that_move_by_the_choice_are_linearised_for_each(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls = counted(monkeypatch)
    found = asked(which_mark(moving=True))
    assert calls == [True]  # the first row, before anything moved
    one_by_one(monkeypatch)
    other = asked(which_mark(moving=True))
    assert found.log_marginal_likelihood == pytest.approx(other.log_marginal_likelihood, rel=1e-9)


def test_rows_that_are_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = np.zeros((ROWS, 2))
    rows[[3, 10]] = np.nan
    rows[7, 1] = np.nan
    found = asked(which_mark(), off=rows)
    one_by_one(monkeypatch)
    other = asked(which_mark(), off=rows)
    assert found.log_marginal_likelihood == pytest.approx(other.log_marginal_likelihood, rel=1e-9)
    np.testing.assert_allclose(found.var("at"), other.var("at"), rtol=1e-8)


def test_an_angle_goes_the_short_way_round(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bearing of 3.1 rad is read as -3.1 or, by one in ten, as anything."""

    def net() -> bmc.DynamicBayesNet:
        dbn = bmc.DynamicBayesNet("bearing")
        dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.01), initial=bmc.Normal(3.1, 0.1))
        dbn.add("stray", bmc.Bernoulli(0.1))
        dbn.add(
            "y",
            lambda x, stray: bmc.WrappedNormal(
                np.where(stray == 1, 0.0, 1.0 * x), np.where(stray == 1, 1.0, 0.05)
            ),
        )
        return dbn

    calls = counted(monkeypatch)
    engine = bmc.ParticleFilter(20, marginalize=("x",), proposal="optimal")
    rows = {"y": np.array([-3.1, -3.12, -3.08, 0.3])}
    found = bmc.filter(net(), rows, engine=engine, rng=0)
    one_by_one(monkeypatch)
    other = bmc.filter(net(), rows, engine=engine, rng=0)
    assert found.log_marginal_likelihood == pytest.approx(other.log_marginal_likelihood, rel=1e-9)
    assert found.mean("x")[-1] == pytest.approx(2 * np.pi - 3.1, abs=0.03)
    assert len(calls) >= 4 and all(calls)


def test_what_is_certain_is_weighed_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two readings of one number without noise of their own: the second follows from the first."""

    def net() -> bmc.DynamicBayesNet:
        dbn = bmc.DynamicBayesNet("twice")
        dbn.add("x", lambda x_prev: bmc.Normal(np.sin(x_prev), 0.3), initial=bmc.Normal(0.0, 1.0))
        dbn.add("far", bmc.Bernoulli(0.5))
        dbn.add(
            "y",
            lambda x, far: bmc.MvNormal(
                np.stack([x + far, 2.0 * (x + far)], axis=-1), scale_diag=[0.0, 0.0]
            ),
        )
        return dbn

    calls = counted(monkeypatch)
    engine = bmc.ParticleFilter(20, marginalize=("x",), proposal="optimal")
    rows = {"y": np.array([[0.2, 0.4], [0.5, 1.0], [1.3, 2.6]])}
    found = bmc.filter(net(), rows, engine=engine, rng=0)
    assert len(calls) >= 3 and not any(calls)
    one_by_one(monkeypatch)
    other = bmc.filter(net(), rows, engine=engine, rng=0)
    assert found.log_marginal_likelihood == other.log_marginal_likelihood


def test_variances_after_a_vague_start_keep_their_digits() -> None:
    """x by 10^6, seen with a noise of .1: the variance left is .01, 14 digits below the first."""
    layout: Any = SimpleNamespace(p=1, angles=None)
    rows, seen = np.array([[[1e6]]]), np.array([[[[1e6, 0.1]], [[0.0, 1.0]]]])
    expected = predictive.Expected(np.array([[2.0]]), rows, np.array([[[2.0], [0.0]]]), seen)
    found = predictive.weighed(layout, expected, np.array([5.0]))
    assert found is not None
    mean, var = found.averaged(np.array([[1.0, 0.0]]))
    assert mean[0, 0] == pytest.approx(5.0, rel=1e-9)
    assert var[0, 0] == pytest.approx(0.01, rel=1e-9)
    mean, var = found.averaged(np.array([[0.5, 0.5]]))  # the other choice tells nothing of x
    assert var[0, 0] == pytest.approx(0.5 * (1e12 + 0.01) + 2.25, rel=1e-12)
    taken = found.chosen(np.array([0]))
    assert taken.factors[0] @ taken.factors[0].T == pytest.approx(0.01, rel=1e-9)
