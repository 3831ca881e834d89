"""Particle filters whose slices are machine code: the same particles to rounding, the same errors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.engines import slice_densities
from bayesmc.engines.particles import compiled_step
from bayesmc.errors import BayesmcError
from bayesmc.expression import elementwise
from bayesmc.lowering import machine, series, writer

pytest.importorskip("llvmlite", reason="llvmlite is not installed")


def growth() -> tuple[Any, dict[str, Any]]:
    dbn = bmc.DynamicBayesNet()

    def x(x_prev: Any, t: Any) -> Any:
        return bmc.Normal(0.5 * x_prev + 25 * x_prev / (1 + x_prev**2) + 8 * np.cos(1.2 * t), 3.0)

    dbn.add("x", x, initial=bmc.Normal(0.0, 3.0))
    dbn.add("y", lambda x: bmc.Normal(x**2 / 20, 1.0))
    y = np.random.default_rng(0).normal(3.0, 2.0, size=30)
    y[[0, 7, 8]] = np.nan
    return dbn, {"y": y}


def several() -> tuple[Any, dict[str, Any]]:
    """Nodes that are drawn in turn, one computed, counts and heavy tails seen."""
    dbn = bmc.DynamicBayesNet()
    dbn.input("u")
    dbn.add(
        "level",
        lambda level_prev, u: bmc.Normal(0.9 * level_prev + 0.1 * u, 0.3),
        initial=bmc.Normal(0.0, 1.0),
    )
    dbn.add(
        "scale",
        lambda scale_prev: bmc.LogNormal(0.5 * np.log(scale_prev), 0.2),
        initial=bmc.LogNormal(0, 0.5),
    )
    dbn.add("both", lambda level, scale: np.exp(0.5 * level) * scale)
    dbn.add("count", lambda both: bmc.Poisson(both))
    dbn.add("z", lambda level, scale: bmc.StudentT(4.0, level, scale))
    rng = np.random.default_rng(1)
    seen = {"count": rng.poisson(1.5, size=25).astype(float), "z": rng.normal(size=25)}
    seen["count"][3:6] = np.nan
    return dbn, seen


def vector() -> tuple[Any, dict[str, Any]]:
    dbn = bmc.DynamicBayesNet()
    matrix, cov = np.array([[0.9, 0.2], [-0.2, 0.9]]), np.array([[1.0, 0.3], [0.3, 0.5]])
    dbn.add(
        "x",
        lambda x_prev: bmc.MvNormal(np.matvec(matrix, x_prev), cov),
        initial=bmc.MvNormal(np.zeros(2), cov),
    )
    dbn.add("y", lambda x: bmc.Normal(np.hypot(x[..., 0], x[..., 1]), 0.5))
    return dbn, {"y": np.random.default_rng(2).gamma(2.0, size=20)}


def lagged() -> tuple[Any, dict[str, Any]]:
    """What the slice before computed is not what it would have computed as slice 0."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("b", lambda b_prev: bmc.Normal(b_prev, 0.5), initial=bmc.Normal(3.0, 1.0))
    dbn.add(
        "x",
        lambda x_prev, l_prev: bmc.Normal(1.2 * x_prev - 0.6 * l_prev, 0.8),
        initial=bmc.Normal(0.0, 1.0),
    )
    dbn.add("l", lambda x_prev: x_prev, initial=lambda b: b)
    dbn.add("y", lambda x, b: bmc.Normal(x + 0.3 * b, 0.7))
    return dbn, {"y": np.random.default_rng(3).normal(0.0, 2.0, size=30)}


def begun() -> tuple[Any, dict[str, Any]]:
    """What the slice before computed is a number in slice 0, which all particles agree on."""
    dbn = bmc.DynamicBayesNet()
    dbn.add(
        "x",
        lambda x_prev, l_prev: bmc.Normal(1.2 * x_prev - 0.6 * l_prev, 0.8),
        initial=bmc.Normal(0.0, 1.0),
    )
    dbn.add("l", lambda x_prev: x_prev, initial=lambda: 0.5)
    dbn.add("y", lambda x: bmc.Normal(x, 0.7))
    return dbn, {"y": np.random.default_rng(3).normal(0.0, 2.0, size=30)}


def families() -> tuple[Any, dict[str, Any]]:
    """Hidden nodes that are drawn by uniform numbers, or folded; a vector that is seen."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Laplace(0.8 * x_prev, 0.5), initial=bmc.Laplace(0.0, 1.0))
    dbn.add("u", lambda x: bmc.Uniform(np.minimum(x, 0.0) - 1.0, np.abs(x)))
    dbn.add("h", lambda h_prev: bmc.HalfNormal(0.5 + 0.3 * h_prev), initial=bmc.HalfNormal(1.0))
    cov = np.array([[0.5, 0.2], [0.2, 0.4]])
    dbn.add("y", lambda x, u, h: bmc.MvNormal(bmc.stack([x + u, h - u], axis=-1), cov))
    return dbn, {"y": np.random.default_rng(4).normal(0.0, 1.0, size=(25, 2))}


MODELS: dict[str, Callable[[], tuple[Any, dict[str, Any]]]] = {
    "growth": growth, "several": several, "vector": vector, "lagged": lagged,
    "begun": begun, "families": families,
}  # fmt: skip


def passed(name: str, monkeypatch: pytest.MonkeyPatch, code: bool, **options: Any) -> Any:
    made: list[compiled_step.SliceCode] = []
    kind, read = compiled_step.SliceCode, options.pop("read", False)
    with monkeypatch.context() as patch:
        patch.setattr(
            compiled_step, "SliceCode", lambda *a, **k: made.append(kind(*a, **k)) or made[-1]
        )
        patch.setattr(compiled_step, "_WORTH", 0.0 if code else np.inf)
        patch.setattr(compiled_step, "_READ", 0 if read else np.inf)
        dbn, seen = MODELS[name]()
        inputs = {"u": np.linspace(0, 1, 25)} if name == "several" else None
        seed = options.pop("rng", 0)
        engine = bmc.ParticleFilter(options.pop("particles", 3000), **options)
        found = bmc.filter(dbn, seen, inputs=inputs, engine=engine, rng=seed)
    assert bool(made) == code
    return (found, made[0]) if code else found


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("particles", [200, 3000, 20_000])
@pytest.mark.filterwarnings("ignore::bayesmc.errors.LowEssWarning")
def test_means_agree_in_every_slice(
    name: str, particles: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    for seed in range(3):
        plain = passed(name, monkeypatch, False, particles=particles, rng=seed)
        fast, code = passed(name, monkeypatch, True, particles=particles, rng=seed)
        fair = (
            "drawn from a family without machine code",  # counts that are not seen
            "the same for all particles",
        )
        assert all(any(f in why for f in fair) for why in code.refused.values())
        assert sum(made is not None for made in code._made.values()) >= 2
        for node in {
            "several": ("level", "scale", "both"),
            "lagged": ("x", "b", "l"),
            "families": ("x", "u", "h"),
        }.get(name, "x"):
            np.testing.assert_allclose(fast.mean(node), plain.mean(node), rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(fast.var(node), plain.var(node), rtol=1e-8, atol=1e-9)
        assert fast.log_marginal_likelihood == pytest.approx(
            plain.log_marginal_likelihood, abs=1e-9
        )


@pytest.mark.parametrize(
    "options",
    [
        {"resampling": "stratified"},
        {"ess_threshold": 1.0},
        {"ess_threshold": 0.0},
        {"resampling": "multinomial"},
        {"on_degeneracy": "rejuvenate", "rejuvenation": {"x": bmc.Normal(0.0, 9.0)}},
    ],
    ids=str,
)  # fmt: skip
@pytest.mark.filterwarnings("ignore::bayesmc.errors.LowEssWarning")
def test_options_of_resampling(options: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    plain = passed("growth", monkeypatch, False, **options)
    fast, _ = passed("growth", monkeypatch, True, **options)
    np.testing.assert_allclose(fast.mean("x"), plain.mean("x"), rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(fast.resampled, plain.resampled)


def test_short_series_are_not_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    machine.loaded.cache_clear()
    monkeypatch.setattr(machine, "Loaded", lambda *a: pytest.fail("compiled"))
    dbn, seen = growth()
    bmc.filter(dbn, seen, engine=bmc.ParticleFilter(500), rng=0)


def failing(what: str) -> tuple[Any, dict[str, Any]]:
    """Parameters that leave their range after some slices."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev + 1.0, 0.1), initial=bmc.Normal(0.0, 0.1))
    functions = {
        "scale": lambda x: bmc.Normal(0.0, 6.0 - x),
        "rate": lambda x: bmc.Poisson(6.0 - x),
        "loc": lambda x: bmc.Normal(1.0 / np.maximum(6.0 - x, 0.0), 50.0),
    }
    dbn.add("y", functions[what])
    return dbn, {"y": np.ones(12)}


@pytest.mark.parametrize("what", ["scale", "rate", "loc"])
def test_what_is_out_of_range_is_the_error_of_the_plain_steps(
    what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(MODELS, what, lambda: failing(what))
    told = []
    for code in (False, True):
        with pytest.raises(BayesmcError) as caught:
            passed(what, monkeypatch, code, particles=400)
        told.append(str(caught.value))
    assert told[0] == told[1]


@pytest.mark.parametrize("fault", ["constant", "ancestors", "noise"])
@pytest.mark.filterwarnings("ignore::bayesmc.errors.LowEssWarning")
def test_planted_faults_leave_it_to_the_plain_steps(
    fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = passed("growth", monkeypatch, False)
    if fault == "constant":
        made = writer.Writer._table

        def wrong(self: Any, key: Any, values: np.ndarray, kind: str) -> int:
            return made(self, key, values * 1.01 if kind == "double" else values, kind)

        monkeypatch.setattr(writer.Writer, "_table", wrong)
    elif fault == "noise":
        draw = slice_densities._draw
        monkeypatch.setattr(
            slice_densities, "_draw", lambda n, f, z: draw(n, f, elementwise(np.multiply, z, 1.001))
        )
    else:
        call = series.SliceCall.__call__

        def turned(self: Any, least: float, cloud: Any, *args: Any) -> Any:
            rows = np.roll(np.arange(len(cloud.log)), 1)
            return call(self, least, cloud._replace(rows=rows), *args)

        monkeypatch.setattr(series.SliceCall, "__call__", turned)
    fast, code = passed("growth", monkeypatch, True)
    assert "other particles" in str(code.refused)
    np.testing.assert_allclose(fast.mean("x"), plain.mean("x"), rtol=1e-9, atol=1e-9)


def finite() -> tuple[Any, dict[str, Any]]:
    dbn = bmc.DynamicBayesNet()
    table = np.array([[0.9, 0.1], [0.2, 0.8]])
    dbn.add("k", lambda k_prev: bmc.Categorical(table[k_prev]), initial=bmc.Categorical([0.5, 0.5]))
    dbn.add("x", lambda x_prev, k: bmc.Normal(0.5 * x_prev + k, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    return dbn, {"y": np.ones(6)}


def test_what_has_no_machine_code_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(MODELS, "finite", finite)
    plain = passed("finite", monkeypatch, False)
    fast, code = passed("finite", monkeypatch, True)
    assert "family without machine code" in str(code.refused)
    np.testing.assert_allclose(fast.mean("x"), plain.mean("x"), rtol=1e-12)


def test_explain_says_what_makes_the_slices(monkeypatch: pytest.MonkeyPatch) -> None:
    engine = bmc.ParticleFilter(500)
    dbn, seen = growth()
    assert bmc.explain(dbn, seen, engine=engine, question="filter").effort == ""  # it takes no time
    monkeypatch.setattr(compiled_step, "_WORTH", 0.0)
    assert (
        bmc.explain(dbn, seen, engine=engine, question="filter").effort == "slices as machine code"
    )
    assert bmc.explain(dbn, seen, engine=engine, question="smooth").effort == ""
    dbn, seen = finite()
    told = bmc.explain(dbn, seen, engine=engine, question="filter").effort
    assert told == "slices in NumPy: node 'k' is drawn from a family without machine code"
    other = bmc.ParticleFilter(500, resampling="residual")
    told = bmc.explain(*growth(), engine=other, question="filter").effort
    assert told == "slices as machine code, but for resampling"
    guided = bmc.ParticleFilter(500, proposal={"x": lambda y: bmc.Normal(y, 9.0)})
    told = bmc.explain(*growth(), engine=guided, question="filter").effort
    assert "proposals are made by plain steps" in told
