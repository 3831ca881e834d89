"""The Hamiltonian kernel on densities written by hand: what it learns, freezes, keeps and counts.

Means of many independent chains, which start from the law itself, are judged at 4.9 standard errors: a
false alarm in a million for each figure. Other tests are exact. Planted faults are seen.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from bayesmc import diagnostics
from bayesmc.errors import DensityError
from bayesmc.kernels import hamiltonian_warmup
from bayesmc.kernels.hamiltonian import Hamiltonian
from bayesmc.kernels.hamiltonian_warmup import MetricLearning, first_steps, windows
from bayesmc.kernels.no_u_turn import Place, Scale
from bayesmc.testing import session

SHIFT = session.seed()
#: standard errors: 1e-6 for each figure of a right kernel
LIMIT = 4.9

LogDensity = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


class OfNumbers:
    """A density of one vector, which is its own free numbers; it counts what is asked."""

    names = ("x",)

    def __init__(self, both: LogDensity, size: int) -> None:
        self.both, self.size, self.rows = both, size, 0

    def with_gradient(self, u: np.ndarray, values: Any = None) -> tuple[np.ndarray, np.ndarray]:
        self.rows += len(u)
        return self.both(u)

    def constrain(self, u: np.ndarray, values: Any = None) -> dict[str, np.ndarray]:
        return {"x": u}

    def unconstrain(self, values: Any) -> np.ndarray:
        return np.asarray(values["x"])


def normal(cov: np.ndarray) -> LogDensity:
    precision = np.linalg.inv(cov)
    return lambda u: (-0.5 * np.vecdot(u @ precision, u), -u @ precision)


def equicorrelated(size: int, correlation: float, scales: np.ndarray) -> np.ndarray:
    cov = np.full((size, size), correlation) + (1 - correlation) * np.eye(size)
    return cov * np.outer(scales, scales)


def warmed(kernel: Hamiltonian, start: np.ndarray, sweeps: int, rng: np.random.Generator) -> Any:
    values = {"x": start}
    with np.errstate(all="ignore"):
        memory = kernel.start(values, len(start))
        for _ in range(sweeps):
            values, memory = kernel.step(values, memory, rng, True)
    return values, kernel.end_warmup(memory)


def drawn(
    kernel: Hamiltonian, values: Any, memory: Any, draws: int, rng: np.random.Generator
) -> Any:
    """Draws (chain, draw, size), and the memory at the end."""
    found = []
    with np.errstate(all="ignore"):
        for _ in range(draws):
            values, memory = kernel.step(values, memory, rng, False)
            found.append(values["x"])
    return np.stack(found, axis=1), memory


def worst_ess(draws: np.ndarray) -> float:
    columns = np.moveaxis(draws, -1, 0)
    return min(float(diagnostics.chain_statistic("ess", c, 1)) for c in columns)


# ---- what is learnt --------------------------------------------------------------------------------


class Inverted(MetricLearning):
    """The metric in place of its inverse."""

    def renewed(self, memory: Any) -> Any:
        found = super().renewed(memory)
        return {**found, "root": 1.0 / found["root"]}


@pytest.mark.parametrize("fault", ["", "inverted"])
def test_scales_are_learnt(fault: str) -> None:
    """Numbers in units that differ by a factor of a million cost no more than in the same."""
    rng = np.random.default_rng(SHIFT)
    scales = np.logspace(-3, 3, 12)
    density = OfNumbers(normal(np.diag(scales**2)), 12)
    kernel = Hamiltonian(density, warmup=300, max_depth=6)
    if fault:
        kernel.metric = Inverted("diagonal")
    values, memory = warmed(kernel, 3.0 * scales * rng.standard_normal((4, 12)), 300, rng)
    density.rows = 0
    draws, memory = drawn(kernel, values, memory, 300, rng)
    cheap = density.rows <= 10 * 4 * 300
    right = bool(np.all(np.abs(np.log(memory["metric"]["root"] / scales)) < 0.5))
    fine = cheap and right and worst_ess(draws) > 300
    assert fine == (not fault)


def test_dense_metric_of_correlated_numbers() -> None:
    """Fifty numbers with correlation 0.99, in any units: as good as independent ones."""
    rng = np.random.default_rng(SHIFT)
    scales = np.logspace(-2, 2, 50)
    cov = equicorrelated(50, 0.99, scales)
    kernel = Hamiltonian(OfNumbers(normal(cov), 50), warmup=600, metric="dense")
    values, memory = warmed(kernel, scales * rng.standard_normal((4, 50)), 600, rng)
    draws, memory = drawn(kernel, values, memory, 400, rng)
    assert worst_ess(draws) > 600
    assert 0.6 < kernel.acceptance(memory).mean() < 0.95
    pooled = draws.reshape(-1, 50) / scales
    errors = np.sqrt(1.0 / 600)  # of a mean, at the least effective size
    assert np.all(np.abs(pooled.mean(axis=0)) < LIMIT * errors)


@pytest.mark.parametrize("seen", [1.0, 1e-4])
def test_a_metric_needs_few_draws_and_no_exploring(seen: float) -> None:
    """Fifteen draws of twelve numbers, far from all that there is to see: gradients tell the rest."""
    rng = np.random.default_rng(SHIFT)
    cov = equicorrelated(12, 0.99, np.logspace(-3, 3, 12))
    precision, root = np.linalg.inv(cov), np.linalg.cholesky(cov)
    learning = MetricLearning("dense")
    memory = learning.start(rng.standard_normal((1, 12)) @ np.linalg.inv(root))
    draws = seen * rng.standard_normal((15, 1, 12)) @ root.T + 3.0 * root.sum(axis=1)
    for u in draws:
        memory = learning.learnt(memory, u, -u @ precision)
    found = learning.renewed(memory)["root"]
    least, largest = _worst_ratio(found @ found.T, root)
    assert 0.3 < least and largest < 3.0
    own = np.cov(draws[:, 0].T)  # the negative control: what draws alone tell
    assert _worst_ratio(own, root)[0] < 0.1


@pytest.mark.parametrize("whole", [True, False])
def test_chains_that_have_met_in_some_numbers(whole: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Gradients by numbers that have met tell of those that have not: one verdict for all of them."""
    rng = np.random.default_rng(SHIFT)
    cov = equicorrelated(8, 0.95, np.ones(8))
    root, apart = np.linalg.cholesky(cov), 40.0 * (np.arange(8) < 4)
    centre = np.array([[-1.5], [-0.5], [0.5], [1.5]]) * apart
    learning = MetricLearning("dense")
    memory = learning.start(rng.standard_normal((4, 8)))
    for _ in range(60):
        u = centre + rng.standard_normal((4, 8)) @ root.T
        memory = learning.learnt(memory, u, -u @ np.linalg.inv(cov))
    if not whole:  # the negative control: what lies between chains is counted all the same
        monkeypatch.setattr(hamiltonian_warmup, "_met", lambda sums, count: np.arange(8) >= 4)
        plain = hamiltonian_warmup._spread

        def masked(sums: Any, count: int, met: Any) -> np.ndarray:
            mean = sums["mean"].mean(axis=0) + (sums["mean"] - sums["mean"].mean(axis=0)) * met
            return plain({**sums, "mean": mean}, count, True)

        monkeypatch.setattr(hamiltonian_warmup, "_spread", masked)
    found = learning.renewed(memory)["root"]
    least, largest = _worst_ratio(found @ found.T, root)
    assert bool(0.3 < least and largest < 3.0) == whole


def test_short_warmups_keep_steps_of_their_own() -> None:
    kernel = Hamiltonian(OfNumbers(normal(np.eye(2)), 2), warmup=15)
    values, memory = kernel.density, kernel.start({"x": np.zeros((3, 2))}, 3)
    assert not kernel._is_pooled(memory) and values.size == 2


def _worst_ratio(cov: np.ndarray, root: np.ndarray) -> np.ndarray:
    """The least and the largest ratio of variances in any direction."""
    back = np.linalg.inv(root)
    return np.linalg.eigvalsh(back @ cov @ back.T)[[0, -1]]


@pytest.mark.parametrize("metric", ["diagonal", "dense"])
def test_units_do_not_matter(metric: Any) -> None:
    """The same random numbers make the same draws in any units that are powers of two."""
    precision = np.linalg.inv(equicorrelated(3, 0.7, np.ones(3)))
    units, found = np.array([2.0**-12, 1.0, 2.0**12]), []

    def both(u: np.ndarray, unit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        slope = -(u / unit) @ precision
        return 0.5 * np.vecdot(slope, u / unit), slope / unit

    for unit in (np.ones(3), units):
        rng = np.random.default_rng(SHIFT)
        density = OfNumbers(lambda u, unit=unit: both(u, unit), 3)
        kernel = Hamiltonian(density, warmup=150, metric=metric)
        start = rng.standard_normal((4, 3)) * unit
        values, memory = warmed(kernel, start, 150, rng)
        found.append(drawn(kernel, values, memory, 20, rng)[0] / unit)
    np.testing.assert_allclose(found[0], found[1], rtol=1e-6)


def test_chains_find_the_mass_with_steps_of_their_own() -> None:
    """A chain that starts a thousand deviations out does not stay there, whatever the other fifteen say."""
    rng = np.random.default_rng(SHIFT)
    start = rng.standard_normal((16, 5))
    start[3] = 1000.0

    def both(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return -np.log1p(u**2 / 5).sum(axis=1) * 3, -3 * 2 * u / (5 + u**2)

    for density in (OfNumbers(normal(np.eye(5)), 5), OfNumbers(both, 5)):
        kernel = Hamiltonian(density, warmup=200)
        values, memory = warmed(kernel, start, 200, rng)
        assert np.abs(values["x"]).max() < 60.0
        assert np.ptp(memory["step"]["log"]) == 0.0


@pytest.mark.parametrize("metric", ["diagonal", "dense"])
@pytest.mark.parametrize("apart", [hamiltonian_warmup._APART, np.inf])
def test_chains_in_two_modes(metric: Any, apart: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Chains at two hills, as those that name components differently, take steps that suit one."""
    monkeypatch.setattr(hamiltonian_warmup, "_APART", apart)
    rng = np.random.default_rng(SHIFT)

    def both(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        off = u - np.where(u[:, :1] > 0, 40.0, -40.0) * np.array([1.0, 0.0, 1.0])
        return -0.5 * np.vecdot(off, off), -off

    start = 40.0 * np.array([1.0, 0.0, 1.0]) * np.array([[1.0], [1.0], [-1.0], [-1.0]])
    kernel = Hamiltonian(OfNumbers(both, 3), warmup=200, metric=metric)
    _, memory = warmed(kernel, start + rng.standard_normal((4, 3)), 200, rng)
    root = memory["metric"]["root"]
    found = root if root.ndim == 1 else np.sqrt(np.diagonal(root @ root.T))
    assert bool(np.all(np.abs(np.log(found)) < 0.5)) == np.isfinite(apart)


def test_windows() -> None:
    """From the end of the beginning on those of the Stan Reference Manual."""
    assert windows(1000) == ((10, 30, 75, 100, 150, 250, 450, 950), 3)
    assert windows(500) == ((10, 30, 75, 100, 150, 250, 450), 3)
    assert windows(150) == ((10, 30, 75, 100), 3)
    assert windows(100) == ((15, 90), 1)
    assert windows(19) == ((), 0)
    for warmup in range(20, 3000, 7):
        ends, beginning = windows(warmup)
        assert list(ends) == sorted(set(ends))
        assert ends[-1] == warmup - (50 if warmup >= 150 else int(0.1 * warmup))
        assert ends[beginning - 1] == (75 if warmup >= 150 else int(0.15 * warmup))
    assert windows(None).ends[:6] == (10, 20, 40, 80, 160, 320) and windows(None).beginning == 2


@pytest.mark.parametrize("pooled", [False, True])
def test_first_steps_are_near_the_wanted_acceptance(pooled: bool) -> None:
    rng = np.random.default_rng(SHIFT)
    both = normal(np.eye(2))
    u = rng.standard_normal((50, 2))
    for begin in (-12.0, 8.0):
        log = first_steps(
            lambda u, rows: both(u), Place(u, *both(u)), np.full(50, begin), Scale(np.ones(2)), rng, 0.8,
            pooled,
        )  # fmt: skip
        assert np.all((log > -6.0) & (log < 3.0))
        assert (np.ptp(log) == 0.0) == pooled


# ---- what is frozen and kept -----------------------------------------------------------------------


class NeverFrozen(Hamiltonian):
    def step(self, values: Any, memory: Any, rng: np.random.Generator, warmup: bool) -> Any:
        return super().step(values, memory, rng, True)


@pytest.mark.parametrize("kind", [Hamiltonian, NeverFrozen])
def test_adaptation_ends(kind: type[Hamiltonian]) -> None:
    rng = np.random.default_rng(SHIFT)
    kernel = kind(OfNumbers(normal(np.eye(3)), 3), warmup=60)
    values, memory = warmed(kernel, rng.standard_normal((4, 3)), 60, rng)
    frozen = pickle.dumps([memory["metric"], memory["step"]])
    _, memory = drawn(kernel, values, memory, 30, rng)
    assert (pickle.dumps([memory["metric"], memory["step"]]) == frozen) == (kind is Hamiltonian)


class Rounded(OfNumbers):
    """Values hold less than the free numbers behind them, as near a bound."""

    def constrain(self, u: np.ndarray, values: Any = None) -> dict[str, np.ndarray]:
        return {"x": np.round(u)}


def test_free_numbers_are_kept_beside_values() -> None:
    rng = np.random.default_rng(SHIFT)
    scale = 0.05  # far below what values resolve
    kernel = Hamiltonian(Rounded(normal(scale**2 * np.eye(2)), 2), warmup=50)
    values, memory = warmed(kernel, np.zeros((400, 2)), 50, rng)
    _, memory = drawn(kernel, values, memory, 10, rng)
    spread = memory["place"]["u"].std() / scale
    assert abs(spread - 1.0) < LIMIT / np.sqrt(2 * 800)
    # somebody else moved it: the place is read anew
    moved = {"x": np.ones((400, 2))}
    place = kernel._place(moved, memory, kernel._gradient(moved))
    assert np.array_equal(place.u, moved["x"])
    assert np.array_equal(place.slope, -moved["x"] / scale**2)


class Conditional(OfNumbers):
    """``x`` given ``y``, of a Normal pair with correlation 0.8."""

    def with_gradient(self, u: np.ndarray, values: Any = None) -> tuple[np.ndarray, np.ndarray]:
        off = (u[:, 0] - 0.8 * values["y"]) / 0.36
        return -0.5 * 0.36 * off**2, -off[:, None]


class Stale(Hamiltonian):
    """Takes the gradient that it knows, though ``y`` has moved."""

    def _place(self, values: Any, memory: Any, gradient: Any) -> Place:
        return Place(**memory["place"])


@pytest.mark.parametrize("kind", [Hamiltonian, Stale])
def test_what_others_move_is_read_anew(kind: type[Hamiltonian]) -> None:
    """Gibbs: x by trajectories given y, y exactly given x; every chain is stationary from its start."""
    rng = np.random.default_rng(SHIFT)
    chains = 40_000
    y = rng.standard_normal(chains)
    x = 0.8 * y + 0.6 * rng.standard_normal(chains)
    kernel = kind(Conditional(normal(np.eye(1)), 1), given=("y",), warmup=0)
    values = {"x": x[:, None], "y": y}
    memory = kernel.start(values, chains)
    memory = {**memory, "step": kernel.step_size.start(np.full(chains, 0.7))}
    memory["metric"]["root"] = np.array([0.6])
    for _ in range(6):
        new, memory = kernel.step(values, memory, rng, False)
        y = 0.8 * new["x"][:, 0] + 0.6 * rng.standard_normal(chains)
        values = {**new, "y": y}
    x = values["x"][:, 0]
    figures = {"x^2": x**2 - 1.0, "y^2": y**2 - 1.0, "xy": x * y - 0.8}
    worst = max(abs(v.mean()) / (v.std() / np.sqrt(chains)) for v in figures.values())
    assert (worst < LIMIT) == (kind is Hamiltonian)


# ---- what is counted -------------------------------------------------------------------------------


def test_counts() -> None:
    rng = np.random.default_rng(SHIFT)

    def funnel(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        v, x = u[:, :1], u[:, 1:]
        inner = (x**2 * np.exp(-v)).sum(axis=1)
        log = -0.5 * (v[:, 0] / 3) ** 2 - 0.5 * inner - 0.5 * x.shape[1] * v[:, 0]
        slope = np.concatenate(
            [-v / 9 + 0.5 * inner[:, None] - 0.5 * x.shape[1], -x * np.exp(-v)], axis=1
        )
        return log, slope

    kernel = Hamiltonian(OfNumbers(funnel, 10), warmup=100)
    values, memory = warmed(kernel, rng.standard_normal((4, 10)), 100, rng)
    memory["step"] = kernel.step_size.start(np.full(4, 0.3))
    seen = np.zeros(4, dtype=int)
    for _ in range(300):
        values, memory = kernel.step(values, memory, rng, False)
        seen += memory["divergent"]
    assert memory["divergences"].sum() > 0
    assert np.array_equal(memory["divergences"], seen)
    short = Hamiltonian(OfNumbers(normal(np.eye(2)), 2), warmup=0, max_depth=2)
    values = {"x": rng.standard_normal((4, 2))}
    memory = short.start(values, 4)
    memory["step"] = short.step_size.start(np.full(4, -5.0))
    _, memory = drawn(short, values, memory, 10, rng)
    assert np.array_equal(memory["saturated"], np.full(4, 10))


def test_energy_ratio_is_that_of_the_energies() -> None:
    rng = np.random.default_rng(SHIFT)
    kernel = Hamiltonian(OfNumbers(normal(np.eye(4)), 4), warmup=50)
    values, memory = warmed(kernel, rng.standard_normal((4, 4)), 50, rng)
    energies = []
    for _ in range(200):
        values, memory = kernel.step(values, memory, rng, False)
        energies.append(memory["energy"]["last"])
    e = np.stack(energies)
    expected = np.square(np.diff(e, axis=0)).sum(axis=0) / np.square(e - e.mean(axis=0)).sum(axis=0)
    np.testing.assert_allclose(kernel.energy_ratio(memory), expected)


def test_start_of_no_density() -> None:
    kernel = Hamiltonian(OfNumbers(lambda u: (np.full(len(u), -np.inf), 0.0 * u), 2))
    with pytest.raises(DensityError, match="'x': the density is zero where chains start"):
        kernel.start({"x": np.zeros((4, 2))}, 4)


def test_memory_is_not_written_to() -> None:
    rng = np.random.default_rng(SHIFT)
    kernel = Hamiltonian(OfNumbers(normal(np.eye(2)), 2), warmup=40)
    values, memory = warmed(kernel, rng.standard_normal((4, 2)), 30, rng)
    before = pickle.dumps((values, memory))
    for warmup in (True, False):
        kernel.step(values, memory, rng, warmup)
    assert pickle.dumps((values, memory)) == before
