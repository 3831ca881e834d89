"""Slices as programs of NumPy's, and sums over their particles: what the plain steps and blocks say."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.engines import slice_densities, slice_program
from bayesmc.engines.particles import sums, tracking
from bayesmc.engines.slice_program import SliceProgram
from bayesmc.errors import BayesmcError
from bayesmc.expression import elementwise
from tests.engines import test_compiled_step as compiled

pytestmark = pytest.mark.filterwarnings("ignore::bayesmc.errors.LowEssWarning")

NODES = {
    "growth": ("x", "y"),
    "several": ("level", "scale", "both", "count"),
    "vector": ("x",),
    "lagged": ("x", "b", "l"),
    "families": ("x", "u", "h"),
}


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch) -> list[SliceProgram]:
    """The programs that are made."""
    made: list[SliceProgram] = []
    monkeypatch.setattr(
        slice_program, "SliceProgram", lambda read: made.append(SliceProgram(read)) or made[-1]
    )
    return made


@pytest.mark.parametrize("name", NODES)
@pytest.mark.parametrize("particles", [200, 3000, 20_000])
def test_means_agree_in_every_slice(
    name: str, particles: int, monkeypatch: pytest.MonkeyPatch, tried: list[Any]
) -> None:
    for seed in range(2):
        options = {"particles": particles, "rng": seed}
        plain = compiled.passed(name, monkeypatch, False, **options)
        read = compiled.passed(name, monkeypatch, False, read=True, **options)
        assert sum(made.is_right is True for made in tried) >= 2
        assert not any(made.is_right is False for made in tried)
        for node in NODES[name]:
            for one, other in ((read.mean, plain.mean), (read.var, plain.var)):
                np.testing.assert_allclose(one(node), other(node), rtol=1e-8, atol=1e-9)
            np.testing.assert_allclose(read.mcse(node), plain.mcse(node), rtol=1e-6, atol=1e-9)
        np.testing.assert_array_equal(read.unique_ancestors, plain.unique_ancestors)
        assert read.log_marginal_likelihood == pytest.approx(
            plain.log_marginal_likelihood, abs=1e-9
        )


@pytest.mark.parametrize("what", ["scale", "rate", "loc"])
def test_what_is_out_of_range_is_the_error_of_the_plain_steps(
    what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(compiled.MODELS, what, lambda: compiled.failing(what))
    told = []
    for read in (False, True):
        with pytest.raises(BayesmcError) as caught:
            compiled.passed(what, monkeypatch, False, particles=400, read=read)
        told.append(str(caught.value))
    assert told[0] == told[1]


def bounded() -> tuple[Any, dict[str, Any]]:
    """Weights of zero, which are no fault."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(0.5 * x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Bernoulli(np.where(x > 0.0, 0.8, 0.0)))
    return dbn, {"y": np.array([1, 1, 0, 1, 0, 1])}


def test_weights_of_zero_are_no_fault(monkeypatch: pytest.MonkeyPatch, tried: list[Any]) -> None:
    monkeypatch.setitem(compiled.MODELS, "bounded", bounded)
    plain = compiled.passed("bounded", monkeypatch, False)
    held: list[bool] = []
    sound = SliceProgram._is_sound
    monkeypatch.setattr(
        SliceProgram,
        "_is_sound",
        lambda self, *given: held.append(sound(self, *given)) or held[-1],
    )
    read = compiled.passed("bounded", monkeypatch, False, read=True)
    assert held and all(held) and all(made.is_right for made in tried)
    np.testing.assert_allclose(read.mean("x"), plain.mean("x"), rtol=1e-9)


@pytest.mark.parametrize("fault", ["noise", "order", "density"])
def test_planted_faults_leave_it_to_the_plain_steps(
    fault: str, monkeypatch: pytest.MonkeyPatch, tried: list[Any]
) -> None:
    name = "several" if fault == "order" else "growth"
    plain = compiled.passed(name, monkeypatch, False)
    read = slice_densities.read_slice
    if fault == "noise":
        draw = slice_densities._draw
        monkeypatch.setattr(
            slice_densities, "_draw", lambda n, f, z: draw(n, f, elementwise(np.multiply, z, 1.001))
        )
    elif fault == "order":
        monkeypatch.setattr(
            slice_program, "read_slice", lambda *a: replaced(read(*a), drawn=read(*a).drawn[::-1])
        )
    else:
        monkeypatch.setattr(
            slice_program,
            "read_slice",
            lambda *a: replaced(read(*a), log=elementwise(np.multiply, read(*a).log, 1.001)),
        )
    found = compiled.passed(name, monkeypatch, False, read=True)
    assert any(made.is_right is False for made in tried)
    node = NODES[name][0]
    np.testing.assert_allclose(found.mean(node), plain.mean(node), rtol=1e-9, atol=1e-9)


def replaced(read: slice_densities.SliceDensities, **fields: Any) -> slice_densities.SliceDensities:
    return slice_densities.SliceDensities(**{**vars(read), **fields})


def wandering() -> tuple[Any, dict[str, Any]]:
    """Three numbers and what is computed of them; rows that jump, and rows that say little."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("a", lambda a_prev: bmc.Normal(0.9 * a_prev, 0.5), initial=bmc.Normal(0.0, 1.0))
    dbn.add(
        "b",
        lambda a, b_prev: bmc.MvNormal(0.8 * b_prev + 0.1 * a[..., None], np.eye(2)),
        initial=bmc.MvNormal(np.zeros(2), np.eye(2)),
    )
    dbn.add("sum", lambda a, b: a + b[..., 0])
    dbn.add("y", lambda sum, b: bmc.StudentT(3.0, sum * b[..., 1], 0.4))
    y = np.random.default_rng(5).normal(0.0, 2.0, size=150)
    y[[0, 40, 41]], y[90:95] = np.nan, 25.0
    return dbn, {"y": y}


@pytest.mark.parametrize("keep", [None, "particles"])
@pytest.mark.parametrize("case", [compiled.growth, wandering], ids=["growth", "wandering"])
def test_sums_say_what_blocks_say(
    case: Any, keep: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    dbn, seen = case()
    found = []
    for many in (1, 10**9):
        monkeypatch.setattr(tracking, "MANY", many)
        engine = bmc.ParticleFilter(600)
        found.append(bmc.filter(dbn, seen, engine=engine, rng=3, keep=keep))
    one, other = found
    for node in ("x", "y") if "x" in one.names else ("a", "b", "sum", "y"):
        np.testing.assert_allclose(one.mean(node), other.mean(node), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(one.var(node), other.var(node), rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(one.mcse(node), other.mcse(node), rtol=1e-9, atol=1e-12)
    if case is wandering:
        assert np.isinf(one.mcse("sum")).any()  # the jump is noticed
    for key, value in one.diagnostics.items():
        np.testing.assert_array_equal(value, other.diagnostics[key], err_msg=key)
    assert one.log_marginal_likelihood_mcse == pytest.approx(other.log_marginal_likelihood_mcse)
    if keep:
        np.testing.assert_allclose(one.weights, other.weights, rtol=1e-12)
        for a, b in zip(one.held.families, other.held.families, strict=True):
            np.testing.assert_allclose(a.drift.moves, b.drift.moves, rtol=1e-8, atol=1e-9)
            np.testing.assert_allclose(a.drift.worst, b.drift.worst, rtol=1e-8, atol=1e-9)
            np.testing.assert_array_equal(a.bounds, b.bounds)


@pytest.mark.parametrize("fault", ["families", "prior"])
def test_faults_in_sums_are_seen(fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if fault == "families":
        by = sums._by_family
        monkeypatch.setattr(sums, "_by_family", lambda columns, bounds: by(columns, bounds // 2))
    else:
        taken = sums.Summing.moments
        monkeypatch.setattr(
            sums.Summing, "moments", lambda self, earlier, now: taken(self, None, now)
        )
    with pytest.raises(AssertionError):
        test_sums_say_what_blocks_say(wandering, "particles", monkeypatch)
