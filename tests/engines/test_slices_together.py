"""Slices that are made in one call of machine code: what plain steps say, slice by slice."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.engines.particles import compiled_step, made
from bayesmc.errors import DegeneracyError, InterruptWarning
from bayesmc.lowering import filter_slices, lineage
from bayesmc.lowering.code import REAL, WHOLE
from tests.engines.test_compiled_step import MODELS, growth
from tests.engines.test_slice_program import NODES, wandering

pytest.importorskip("llvmlite", reason="llvmlite is not installed")
pytestmark = [
    pytest.mark.filterwarnings("ignore::bayesmc.errors.LowEssWarning"),
    pytest.mark.filterwarnings("ignore::bayesmc.errors.ModelMisfitWarning"),
]

FIGURES = ("weight_ess", "resampled", "rejuvenated", "counts", "anew", "unique_ancestors")


def lost() -> tuple[Any, dict[str, Any]]:
    """Two modes, of which one is lost, a jump that no particle has made, and a stretch of missing rows."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(0.95 * x_prev, 0.3), initial=bmc.Normal(0.0, 2.0))
    dbn.add("z", lambda z_prev, x: bmc.Normal(0.5 * z_prev + x, 0.1), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x, z: bmc.Normal(x**2 + 0.1 * z, 0.2))
    rng = np.random.default_rng(8)
    y = rng.gamma(2.0, size=120)
    y[60:63], y[80:90] = 30.0, np.nan
    return dbn, {"y": y}


def regression() -> tuple[Any, dict[str, Any]]:
    """What was seen a slice before, a known input, and nodes seen now and then."""
    dbn = bmc.DynamicBayesNet()
    dbn.input("u")
    dbn.add("x", lambda x_prev, u: bmc.Normal(0.9 * x_prev + u, 0.5), initial=bmc.Normal(0.0, 1.0))
    dbn.add(
        "y",
        lambda x, y_prev, u_prev: bmc.Normal(x + 0.3 * y_prev - u_prev, 0.4),
        initial=lambda x: bmc.Normal(x, 0.4),
    )
    dbn.add("z", lambda x, t: bmc.StudentT(4.0, x * np.cos(0.1 * t), 0.5))
    rng = np.random.default_rng(9)
    y, z = rng.normal(size=60), rng.normal(size=60)
    y[[5, 6, 30]], z[20:40:3] = np.nan, np.nan
    return dbn, {"y": y, "z": z}


def vague() -> tuple[Any, dict[str, Any]]:
    """Rows that say little, so that particles bring weights along."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 1.0), initial=bmc.Normal(0.0, 2.0))
    dbn.add("y", lambda x: bmc.Normal(x, 4.0))
    return dbn, {"y": np.random.default_rng(10).normal(0.0, 5.0, size=80)}


CASES: dict[str, Callable[[], tuple[Any, dict[str, Any]]]] = {
    **MODELS, "wandering": wandering, "lost": lost, "regression": regression, "vague": vague,
}  # fmt: skip
WANTED = {
    **NODES,
    "wandering": ("a", "b", "sum", "y"),
    "lost": ("x", "z"),
    "regression": ("x", "y", "z"),
    "vague": ("x",),
    "begun": ("x", "l"),
}


@pytest.fixture
def together(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many slices were made in each call."""
    found: list[int] = []
    several = compiled_step._Slice.several

    def counted(self: Any, *args: Any) -> Any:
        slices = several(self, *args)
        found.append(len(slices))
        return slices

    monkeypatch.setattr(compiled_step._Slice, "several", counted)
    return found


def filtered(name: str, compiled: bool, particles: int = 1000, seed: int = 0, **given: Any) -> Any:
    dbn, seen = CASES[name]()
    rows = len(next(iter(seen.values())))
    inputs = {"u": np.linspace(0, 1, rows)} if name in ("several", "regression") else None
    options = {k: given.pop(k) for k in ("resampling", "ess_threshold") if k in given}
    engine = bmc.ParticleFilter(particles, compiled=compiled, **options)
    return bmc.filter(dbn, seen, inputs=inputs, engine=engine, rng=seed, **given)


def same(one: Any, other: Any, nodes: tuple[str, ...], rtol: float = 1e-9) -> None:
    """All that is told of slices."""
    for node in nodes:
        np.testing.assert_allclose(one.mean(node), other.mean(node), rtol=rtol, atol=1e-9)
        np.testing.assert_allclose(one.var(node), other.var(node), rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(one.mcse(node), other.mcse(node), rtol=1e-6, atol=1e-9)
    for what in FIGURES:
        np.testing.assert_allclose(
            getattr(one, what), getattr(other, what), rtol=1e-9, err_msg=what
        )
    np.testing.assert_allclose(
        one.log_marginal_increments, other.log_marginal_increments, rtol=1e-9, atol=1e-9
    )
    mcse = one.log_marginal_likelihood_mcse
    assert mcse == pytest.approx(other.log_marginal_likelihood_mcse, rel=1e-6)
    ranks = (found.predictive.row_ranks for found in (one, other))
    np.testing.assert_array_equal(*ranks)


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("particles", [3, 40, 1000, 9000])
def test_what_is_told_of_slices(name: str, particles: int, together: list[int]) -> None:
    for seed in range(2):
        plain = filtered(name, False, particles, seed)
        assert not together
        fast = filtered(name, True, particles, seed)
        if name != "several":  # counts that are not seen are no machine code
            assert sum(together) >= 0.6 * len(plain.weight_ess), together
            assert max(together) > 1
        together.clear()
        same(fast, plain, WANTED[name])


def followed_alike(name: str, monkeypatch: pytest.MonkeyPatch, particles: int = 300) -> int:
    """Families at the end of each call, beside those of slices made one by one; how many there were."""
    found, run, one = [], made._Following.run, made._Following._on

    def kept(self: Any) -> Any:
        families, sums = run(self)
        found.append((self._slices.t + len(self._slices) - 1, families))
        return families, sums

    def stopped(self: Any, row: int, families: Any) -> Any:
        stop, own = one(self, row, families)
        found.append((self._slices.t + min(stop - 1, self._count) - 1, own))
        return stop, own

    with monkeypatch.context() as patch:
        patch.setattr(made._Following, "run", kept)
        patch.setattr(made._Following, "_on", stopped)
        filtered(name, True, particles)
    plain = filtered(name, False, particles, keep="particles").held.families
    for t, own in found:
        wanted = plain[t]
        np.testing.assert_array_equal(own.bounds, wanted.bounds)
        np.testing.assert_array_equal(own.born, wanted.born)
        for what in ("shares", "explained", "settled"):
            np.testing.assert_allclose(
                getattr(own, what), getattr(wanted, what), rtol=1e-7, atol=1e-9
            )
        np.testing.assert_allclose(own.drift.moves, wanted.drift.moves, rtol=1e-7, atol=1e-8)
        assert own.drift.worst == pytest.approx(float(wanted.drift.worst), rel=1e-7)
        assert (own.lost is None) == (wanted.lost is None) and own.doubted == wanted.doubted
        if own.lost is not None:
            assert own.lost.since == wanted.lost.since
            np.testing.assert_array_equal(own.lost.where, wanted.lost.where)
            assert (own.lost.roots is None) == (wanted.lost.roots is None)
            if own.lost.roots is not None:
                np.testing.assert_array_equal(own.lost.roots, wanted.lost.roots)
            for a, b in zip(own.lost.gone, wanted.lost.gone, strict=True):
                np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-9)
    return len(found)


@pytest.mark.parametrize("name", ["growth", "wandering", "lost", "vague", "vector"])
def test_families_are_those_of_slices_made_one_by_one(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert followed_alike(name, monkeypatch) > 1


def test_what_was_lost_is_lost_in_both() -> None:
    fast, plain = (filtered("lost", compiled, 300) for compiled in (True, False))
    infinite = np.isinf(plain.mcse("x"))
    assert 10 < infinite.sum() < len(infinite)
    np.testing.assert_array_equal(np.isinf(fast.mcse("x")), infinite)


@pytest.mark.parametrize(
    "options",
    [
        {"ess_threshold": 1.0},
        {"ess_threshold": 0.0},
        {"resampling": "ssp"},
        {"resampling": "stratified"},
        {"resampling": "stratified", "ess_threshold": 1.0},
    ],
    ids=str,
)
def test_options_of_resampling(options: dict[str, Any]) -> None:
    fast, plain = (filtered("wandering", compiled, **options) for compiled in (True, False))
    same(fast, plain, WANTED["wandering"])


@pytest.mark.parametrize("particles", [500, 9000])
def test_particles_that_are_kept(particles: int, together: list[int]) -> None:
    given = {"keep": "particles", "queries": {"q": lambda x, z: x * z}}
    fast, plain = (filtered("lost", compiled, particles, **given) for compiled in (True, False))
    assert max(together) > 1
    same(fast, plain, WANTED["lost"])
    np.testing.assert_allclose(fast.queries["q"], plain.queries["q"], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(fast.weights, plain.weights, rtol=1e-8, atol=1e-12)
    np.testing.assert_array_equal(fast.ancestors, plain.ancestors)
    for node in ("x", "z"):
        np.testing.assert_allclose(
            fast.particles(node), plain.particles(node), rtol=1e-9, atol=1e-9
        )
    smooth = [
        bmc.smooth(*lost(), engine=bmc.ParticleFilter(particles, compiled=c), rng=0)
        for c in (True, False)
    ]
    np.testing.assert_allclose(smooth[0].mean("x"), smooth[1].mean("x"), rtol=1e-9, atol=1e-9)


def test_fixed_lags_and_threads() -> None:
    dbn, seen = lost()
    engine = bmc.ParticleFilter(300, compiled=True)
    plain = replace(engine, compiled=False)
    lagged = [bmc.smooth(dbn, seen, engine=e, rng=0, lag=3) for e in (engine, plain)]
    np.testing.assert_allclose(lagged[0].mean("x"), lagged[1].mean("x"), rtol=1e-9, atol=1e-9)
    alone = [bmc.filter(dbn, seen, engine=engine, rng=seed) for seed in range(8)]
    with ThreadPoolExecutor(4) as pool:
        beside = list(pool.map(lambda k: bmc.filter(dbn, seen, engine=engine, rng=k), range(8)))
    for one, other in zip(alone, beside, strict=True):
        np.testing.assert_array_equal(one.mean("x"), other.mean("x"))
        np.testing.assert_array_equal(one.mcse("x"), other.mcse("x"))


@pytest.mark.parametrize("stopped", [1, 2, 37, 64])
def test_slices_before_ctrl_c_are_handed_over(
    stopped: int, monkeypatch: pytest.MonkeyPatch, together: list[int]
) -> None:
    plain = filtered("wandering", False)
    passed = made.Ahead.passed

    def interrupted(self: Any, k: int, looks: Any) -> Any:
        if k == stopped:
            raise KeyboardInterrupt
        return passed(self, k, looks)

    monkeypatch.setattr(made.Ahead, "passed", interrupted)
    with pytest.warns(InterruptWarning):
        fast = filtered("wandering", True)
    assert max(together) > 1 and len(fast.weight_ess) == stopped
    for node in WANTED["wandering"]:
        np.testing.assert_allclose(
            fast.mean(node), plain.mean(node)[:stopped], rtol=1e-9, atol=1e-9
        )
    whole = filtered("wandering", False)
    dbn, seen = wandering()
    first = bmc.filter(
        dbn, {"y": seen["y"][:stopped]}, engine=bmc.ParticleFilter(1000, compiled=False), rng=0
    )
    told = fast.log_marginal_likelihood_mcse
    assert told == pytest.approx(first.log_marginal_likelihood_mcse, rel=1e-6)
    assert whole.log_marginal_likelihood_mcse != told


def degenerate() -> tuple[Any, dict[str, Any]]:
    """Rows that no particle explains, now and then."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 0.5), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Bernoulli(np.where(x > 6.0, 0.7, 0.0)))
    dbn.add("z", lambda x: bmc.Normal(x, 1.0))
    rng = np.random.default_rng(3)
    y, z = np.zeros(40), rng.normal(size=40)
    y[[17, 30]], y[20:25] = 1.0, np.nan
    return dbn, {"y": y, "z": z}


def test_rows_that_no_particle_explains(together: list[int]) -> None:
    dbn, seen = degenerate()
    told, filtered = [], []
    for compiled in (True, False):
        with pytest.raises(DegeneracyError) as caught:
            bmc.filter(dbn, seen, engine=bmc.ParticleFilter(400, compiled=compiled), rng=0)
        told.append(str(caught.value))
        filtered.append(caught.value.filtered)
    assert told[0] == told[1] and max(together) > 1
    np.testing.assert_allclose(filtered[0].mean("x"), filtered[1].mean("x"), rtol=1e-9)
    assert len(filtered[0].weight_ess) == 17
    renewed = {"x": bmc.Normal(7.0, 1.0)}
    engine = bmc.ParticleFilter(400, on_degeneracy="rejuvenate", rejuvenation=renewed)
    fast, plain = (
        bmc.filter(dbn, seen, engine=replace(engine, compiled=own), rng=1) for own in (True, False)
    )
    assert plain.rejuvenated.sum() == 2
    same(fast, plain, ("x",))


def test_a_template_that_is_compiled_is_machine_code_for_short_series(together: list[int]) -> None:
    dbn, seen = growth()
    short = {"y": seen["y"][:20]}
    bmc.filter(dbn, short, engine=bmc.ParticleFilter(100), rng=0)
    assert not together
    bmc.filter(dbn, short, engine=bmc.ParticleFilter(100, compiled=True), rng=0)
    assert together
    together.clear()
    found = bmc.filter(dbn, short, engine=bmc.ParticleFilter(100), rng=0)
    assert together
    together.clear()
    plain = bmc.filter(dbn, short, engine=bmc.ParticleFilter(100, compiled=False), rng=0)
    assert not together
    np.testing.assert_allclose(found.mean("x"), plain.mean("x"), rtol=1e-9, atol=1e-9)


def test_only_machine_code_that_is_kept_is_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled_step, "_LOAD", -1.0)
    monkeypatch.setattr(compiled_step, "_IMPORT", 0.0)
    asked: list[str] = []
    monkeypatch.setattr("bayesmc.lowering.series.is_kept", lambda text: bool(asked.append(text)))
    monkeypatch.setattr("bayesmc.lowering.machine._compiled", lambda text: pytest.fail("compiled"))
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(0.123456 * x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    bmc.filter(dbn, {"y": np.ones(5)}, engine=bmc.ParticleFilter(100), rng=0)
    assert asked


def test_explain_and_wrong_options() -> None:
    dbn, seen = growth()
    told = [
        bmc.explain(dbn, seen, engine=bmc.ParticleFilter(100, compiled=c), question="filter").effort
        for c in (True, False, None)
    ]
    assert told == ["slices as machine code", "slices in NumPy: compiled=False", ""]
    with pytest.raises(ValueError, match="compiled='yes'"):
        bmc.ParticleFilter(100, compiled="yes")  # type: ignore[arg-type]


# ---- planted faults ------------------------------------------------------------------------------


@pytest.fixture
def afresh() -> Iterator[None]:
    """Loops are written and compiled anew, before and after."""
    kept = (filter_slices.text, filter_slices.passes, lineage.text, lineage.followed)
    for function in kept:
        function.cache_clear()
    yield
    for function in kept:
        function.cache_clear()


def ancestors_are_stale(patch: pytest.MonkeyPatch) -> None:
    resample = filter_slices._Text._resample

    def stale(self: Any) -> None:
        rows = self.c.get(self.rows, WHOLE)
        resample(self)
        self.c.set(self.rows, rows)

    patch.setattr(filter_slices._Text, "_resample", stale)


def known_values_stay(patch: pytest.MonkeyPatch) -> None:
    call = filter_slices._Text._propagate

    def first(self: Any) -> None:
        self.slice, kept = self.c.variable(self.c.number(0, WHOLE), once=True), self.slice
        call(self)
        self.slice = kept

    patch.setattr(filter_slices._Text, "_propagate", first)


def log_weights_are_forgotten(patch: pytest.MonkeyPatch) -> None:
    level = filter_slices._Text._level
    patch.setattr(
        filter_slices._Text,
        "_level",
        lambda self, resampled: level(self, self.c.number(True, "i1")),
    )


def evidence_is_of_even_weights(patch: pytest.MonkeyPatch) -> None:
    weigh = filter_slices._Text._weigh

    def even(self: Any, resampled: Any) -> None:
        self.c.set(self.spent, filter_slices.Number(self.c, "%log_particles", REAL))
        weigh(self, resampled)

    patch.setattr(filter_slices._Text, "_weigh", even)


def prior_weights_are_even(patch: pytest.MonkeyPatch) -> None:
    moments = filter_slices._Text._moments
    patch.setattr(
        filter_slices._Text,
        "_moments",
        lambda self, k, resampled: moments(self, k, resampled.eq(resampled)),
    )


def families_stay(patch: pytest.MonkeyPatch) -> None:
    move = lineage._Followed._move

    def still(self: Any, resampled: Any, ess: Any) -> None:
        move(self, self.c.number(False, "i1"), ess)

    patch.setattr(lineage._Followed, "_move", still)


def roots_stay(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(lineage._Followed, "_root", lambda self: None)


def nothing_matters(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(lineage._Followed, "_look", lambda self: None)


def origins_are_never_given_up(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(lineage._Followed, "_begin_again", lambda self, t, gained: None)


def nothing_is_settled(patch: pytest.MonkeyPatch) -> None:
    begin = lineage._Followed._begin_again
    patch.setattr(
        lineage._Followed, "_begin_again", lambda self, t, gained: begin(self, t, gained * 0.0)
    )


@pytest.mark.usefixtures("afresh")
@pytest.mark.parametrize(
    "fault",
    [
        ancestors_are_stale, known_values_stay, log_weights_are_forgotten, evidence_is_of_even_weights,
        prior_weights_are_even, families_stay, roots_stay, nothing_matters,
        origins_are_never_given_up, nothing_is_settled,
    ],
)  # fmt: skip
def test_planted_faults_are_seen(fault: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    fault(monkeypatch)
    refused: dict[Any, str] = {}
    kind = compiled_step.SliceCode

    def made_by(*args: Any, **options: Any) -> Any:
        code = kind(*args, **options)
        code.refused = refused
        return code

    monkeypatch.setattr(compiled_step, "SliceCode", made_by)
    try:
        for name in ("wandering", "lost", "vague"):
            fast, plain = (filtered(name, compiled, 300) for compiled in (True, False))
            same(fast, plain, WANTED[name])
            followed_alike(name, monkeypatch)
    except AssertionError:
        return
    assert "other particles" in str(refused)
