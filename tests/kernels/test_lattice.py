"""Markov random fields: full conditionals against the model's own factors, and what is drawn."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy import stats

import bayesmc as bmc
from bayesmc.distributions.base import marking_invalid
from bayesmc.kernels.lattice import SiteCounts, SiteSums, lattice_kernel
from bayesmc.kernels.sites import sites_of
from bayesmc.network import pose
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Target, Values, target_of

#: false alarms of every statistical test here
ALPHA = 1e-4
POTTS = np.array(
    [[0.7, 0.0, -0.2, 0.1], [0.0, 0.4, 0.3, 0.0], [0.5, 0.1, 0.2, 0.0], [0.0, 0.2, 0.0, 0.6]]
)


def pairs(rows: int, columns: int, periodic: bool = False) -> tuple[Any, Any, Any, Any]:
    """Horizontal pairs, then vertical ones, of a grid in raster order."""
    site = np.arange(rows * columns).reshape(rows, columns)
    if periodic:
        return (
            site.ravel(),
            np.roll(site, -1, 1).ravel(),
            site.ravel(),
            np.roll(site, -1, 0).ravel(),
        )
    return site[:, :-1].ravel(), site[:, 1:].ravel(), site[:-1].ravel(), site[1:].ravel()


def graph(count: int, states: Any = (-1, 1)) -> bmc.FactorGraph:
    fg = bmc.FactorGraph("field", plates={"site": count})
    fg.variable("s", states, plates="site")
    return fg


def ising(rows: int, columns: int, periodic: bool = False, both: float = 0.4) -> bmc.FactorGraph:
    fg = graph(rows * columns)
    i, j, k, m = pairs(rows, columns, periodic)
    fg.factor(lambda a, b: 0.4 * a * b, scope=("s", "s"), index=(i, j))
    fg.factor(lambda a, b: both * a * b, scope=("s", "s"), index=(k, m))
    fg.factor(lambda s: 0.1 * s, scope=("s",), index=(np.arange(rows * columns),))
    return fg


def denoising() -> bmc.FactorGraph:
    fg = ising(4, 6)
    pixels = np.random.default_rng(0).normal(size=24)
    fg.factor(lambda s: -0.5 * (pixels - s) ** 2, scope=("s",), index=(np.arange(24),))
    return fg


def diagonals() -> bmc.FactorGraph:
    """Eight neighbours: four colours."""
    fg = ising(6, 6)
    site = np.arange(36).reshape(6, 6)
    i = np.concatenate([site[:-1, :-1].ravel(), site[:-1, 1:].ravel()])
    j = np.concatenate([site[1:, 1:].ravel(), site[1:, :-1].ravel()])
    fg.factor(lambda a, b: 0.2 * a * b, scope=("s", "s"), index=(i, j))
    return fg


def potts(directed: bool) -> bmc.FactorGraph:
    fg = graph(30, 4 if not directed else 3)
    i, j, k, m = pairs(5, 6)
    table = POTTS[:3, :3] if directed else 0.8 * np.eye(4)
    fg.factor(table, scope=("s", "s"), index=(np.append(i, k), np.append(j, m)))
    return fg


def own_couplings() -> bmc.FactorGraph:
    fg = graph(20)
    i, j, k, m = pairs(4, 5)
    first, second = np.append(i, k), np.append(j, m)
    strength = np.random.default_rng(1).normal(size=len(first))
    fg.factor(lambda a, b: strength * a * b, scope=("s", "s"), index=(first, second))
    return fg


def irregular() -> bmc.FactorGraph:
    """A random graph with isolated sites, a hub and a pair that stands twice."""
    fg = graph(25, 3)
    rng = np.random.default_rng(2)
    i = rng.integers(20, size=30)
    j = (i + rng.integers(1, 20, size=30)) % 20
    i, j = np.append(i, [0] * 10 + [3, 3]), np.append(j, [*range(1, 11), 7, 7])
    fg.factor(POTTS[:3, :3], scope=("s", "s"), index=(i, j))
    fg.factor(lambda s: 0.3 * (s == 1), scope=("s",), index=(np.array([2, 2, 9]),))
    return fg


def triples() -> bmc.FactorGraph:
    fg = ising(3, 4)
    i = np.arange(10)
    fg.factor(lambda a, b, c: 0.3 * a * b * c, scope=("s", "s", "s"), index=(i, i + 1, i + 2))
    return fg


def constrained() -> bmc.FactorGraph:
    """Proper colourings with three colours, softened nowhere."""
    fg = graph(12, 3)
    i, j, k, m = pairs(3, 4)
    first, second = np.append(i, k), np.append(j, m)
    table = np.where(np.eye(3) > 0, -np.inf, 0.0)
    fg.factor(table, scope=("s", "s"), index=(first, second))
    return fg


def two_fields() -> bmc.FactorGraph:
    fg = ising(3, 4)
    fg.variable("t", 3, plates="site")
    fg.factor(
        lambda s, t: 0.5 * s * t, scope=("s", "t"), index=(np.arange(12), np.arange(12)[::-1])
    )
    fg.factor(lambda s, t: 0.2 * s * (t == 1), scope=("s", "t"))
    return fg


CASES: dict[str, tuple[Callable[[], bmc.FactorGraph], type]] = {
    "grid": (lambda: ising(4, 6), SiteCounts),
    "odd grid": (lambda: ising(5, 7), SiteCounts),
    "torus": (lambda: ising(6, 8, periodic=True), SiteCounts),
    "two couplings": (lambda: ising(4, 6, both=-0.7), SiteCounts),
    "pixels": (denoising, SiteCounts),
    "eight neighbours": (diagonals, SiteCounts),
    "Potts": (lambda: potts(False), SiteCounts),
    "directed": (lambda: potts(True), SiteCounts),
    "own couplings": (own_couplings, SiteSums),
    "irregular": (irregular, SiteSums),
    "triples": (triples, SiteSums),
    "hard constraints": (constrained, SiteSums),
    "two fields": (two_fields, SiteSums),
}


def normalised(log: np.ndarray) -> np.ndarray:
    probs = np.exp(log - log.max(axis=0))
    return probs / probs.sum(axis=0)


def random_state(target: Target, chains: int, seed: int) -> Values:
    rng = np.random.default_rng(seed)
    values: Values = dict(target.known)
    for name in target.chain:
        node = target.model[name]
        assert node.domain is not None
        value = rng.integers(node.domain.size, size=(chains, *node.plate_shape))
        seen = target.seen(name)
        if seen is not None:
            value = np.where(seen.mask, seen.value, value)
        values[name] = value.astype(np.uint8)
    return values


def brute(blanket: Blanket, values: Values) -> np.ndarray:
    """Log full conditional by the model's own factors, class by class, shape (states, chains, sites)."""
    assert blanket.node.domain is not None
    states, now = blanket.node.domain.size, values[blanket.name]
    found = np.full((states, len(now), blanket.size), np.nan)
    with marking_invalid(), np.errstate(all="ignore"):
        for members in blanket.classes:
            at = np.arange(blanket.size) if members is None else members
            for k in range(states):
                shape = now.shape if members is None else (len(now), len(members))
                log = blanket.log_density(values, np.full(shape, k, dtype=np.uint8), members)
                found[k][:, at] = np.broadcast_to(log, shape).reshape(len(now), -1)
    return found


@pytest.mark.parametrize("case", CASES)
def test_full_conditionals_equal_the_models_own(case: str) -> None:
    make, kind = CASES[case]
    target = target_of(pose(make(), None))
    blanket = Blanket(target, "s")
    kernel = lattice_kernel(blanket)
    assert type(kernel) is kind
    assert kernel.constrained == (case == "hard constraints")
    values = random_state(target, 5, 1)
    if case == "hard constraints":  # a checkerboard of two colours is proper
        values["s"] = np.tile(np.indices((3, 4)).sum(axis=0).ravel() % 2, (5, 1)).astype(np.uint8)
    expected = normalised(brute(blanket, values))
    np.testing.assert_allclose(normalised(kernel.log_density(values)), expected, atol=1e-9)
    # both ways of summing agree; the negative control moves one site and must show
    sites = sites_of(blanket)
    assert sites is not None
    sums = SiteSums(blanket, sites)
    np.testing.assert_allclose(normalised(sums.log_density(values)), expected, atol=1e-9)
    other = {**values, "s": values["s"].copy()}
    other["s"][0, 1] = (other["s"][0, 1] + 1) % expected.shape[0]
    with np.errstate(invalid="ignore"):
        moved = normalised(kernel.log_density(other))
    assert not np.allclose(moved[:, 0], expected[:, 0], atol=1e-3)
    np.testing.assert_allclose(moved[:, 1:], expected[:, 1:], atol=1e-9)


@pytest.mark.parametrize("case", CASES)
def test_a_partly_seen_field(case: str) -> None:
    make, _ = CASES[case]
    fg = make()
    count = fg.variables["s"].size
    states = fg.variables["s"].states
    assert states is not None
    rng = np.random.default_rng(3)
    mask = rng.random(count) < 0.6
    shown = np.asarray(states)[rng.integers(len(states), size=count)]
    if case == "hard constraints":
        shown = np.indices((3, 4)).sum(axis=0).ravel() % 2
    target = target_of(pose(fg, {"s": np.ma.masked_array(shown, mask=mask)}))
    blanket = Blanket(target, "s")
    kernel = lattice_kernel(blanket)
    assert kernel is not None
    values = random_state(target, 4, 2)
    if case == "hard constraints":
        values["s"] = np.tile(shown, (4, 1)).astype(np.uint8)
    found, expected = kernel.log_density(values)[..., mask], brute(blanket, values)[..., mask]
    np.testing.assert_allclose(normalised(found), normalised(expected), atol=1e-9)
    new, _ = kernel.step(values, {}, np.random.Generator(np.random.SFC64(0)), False)
    np.testing.assert_array_equal(new["s"][:, ~mask], values["s"][:, ~mask])
    assert (new["s"][:, mask] != values["s"][:, mask]).any()


def joint(target: Target) -> tuple[Values, np.ndarray]:
    """All states of all variables, as chains, and their probabilities."""
    cards, names = [], []
    for name in target.chain:
        node = target.model[name]
        assert node.domain is not None
        names.append((name, int(np.prod(node.plate_shape)), node.plate_shape))
        cards += [node.domain.size] * names[-1][1]
    grid = np.indices(cards).reshape(len(cards), -1).T.astype(np.uint8)
    values: Values = dict(target.known)
    begin = 0
    for name, size, shape in names:
        values[name] = grid[:, begin : begin + size].reshape(-1, *shape)
        begin += size
    return values, normalised(target.log_density(values))


def small(kind: str) -> bmc.FactorGraph:
    if kind == "ising":
        return ising(3, 3, both=0.6)
    if kind == "potts":
        fg = graph(6, 3)
        i, j, k, m = pairs(2, 3)
        fg.factor(0.9 * np.eye(3), scope=("s", "s"), index=(np.append(i, k), np.append(j, m)))
        fg.factor(np.array([0.0, 0.4, -0.3]), scope=("s",), index=(np.arange(6),))
        return fg
    fg = graph(6, 3)
    i, j = np.array([0, 1, 2, 0, 4, 0]), np.array([1, 2, 0, 3, 3, 4])
    table = np.random.default_rng(4).normal(size=(6, 3, 3))
    table[0, 1, 2] = -np.inf
    fg.factor(table, scope=("s", "s"), index=(i, j))
    return fg


@pytest.mark.parametrize("kind", ["ising", "potts", "irregular"])
def test_a_step_leaves_the_law_invariant(kind: str) -> None:
    target = target_of(pose(small(kind), None))
    kernel = lattice_kernel(Blanket(target, "s"))
    assert isinstance(kernel, SiteSums if kind == "irregular" else SiteCounts)
    everyone, probs = joint(target)
    rng = np.random.Generator(np.random.SFC64(1))
    chains = 300_000
    at = rng.choice(len(probs), chains, p=probs)
    new, _ = kernel.step({"s": everyone["s"][at]}, {}, rng, False)
    cards = (int(everyone["s"].max()) + 1,) * everyone["s"].shape[1]
    code = np.ravel_multi_index(new["s"].T.astype(np.intp), cards)
    counts = np.bincount(code, minlength=len(probs))
    assert not counts[probs == 0].any()
    assert p_value(counts, probs) > ALPHA
    assert (new["s"] != everyone["s"][at]).mean() > 0.1
    # negative control: draws of another temperature do not pass
    warm = probs**0.95 / (probs**0.95).sum()
    assert p_value(counts, warm) < ALPHA


def p_value(counts: np.ndarray, probs: np.ndarray) -> float:
    expected = probs * counts.sum()
    often = expected >= 10
    cells = np.append(expected[often], expected[~often].sum())
    seen = np.append(counts[often], counts[~often].sum())
    keep = cells > 0
    statistic = ((seen[keep] - cells[keep]) ** 2 / cells[keep]).sum()
    return float(stats.chi2.sf(statistic, keep.sum() - 1))


class Scripted:
    """A generator whose random words are given."""

    def __init__(self, words: list[np.ndarray]) -> None:
        self.words = words
        self.bit_generator = self

    def random_raw(self, count: int) -> np.ndarray:
        word = self.words.pop(0)
        assert len(word) == count
        return word


@pytest.mark.parametrize("step", [-1, 0])
def test_ties_of_the_leading_byte_are_decided_by_the_other_bits(step: int) -> None:
    # two sites without a factor between them would be no lattice: a pair, one of which is seen
    fg = graph(2)
    fg.factor(lambda a, b: 0.3 * a * b, scope=("s", "s"), index=([0], [1]))
    seen = np.ma.masked_array([1, 1], mask=[True, False])
    target = target_of(pose(fg, {"s": seen}))
    kernel = lattice_kernel(Blanket(target, "s"))
    assert isinstance(kernel, SiteCounts)
    low_state = 1 / (1 + np.exp(0.6))
    edge = round(low_state * 2**40)
    words = edge + step
    high = np.full(8, words >> 32, dtype=np.uint8).view(np.uint64)
    low = np.array([(words & 0xFFFFFFFF) << 32], dtype=np.uint64)
    new, _ = kernel.step(
        {"s": np.array([[0, 1]], dtype=np.uint8)},
        {},
        Scripted([high, low]),
        False,  # type: ignore[arg-type]
    )
    assert new["s"].tolist() == [[1 + step, 1]]


def test_hidden_quantities_in_the_factors_are_left_to_others() -> None:
    fg = ising(3, 3)
    fg.variable("strength", "positive")
    fg.factor(lambda strength: -strength, scope=("strength",))
    i, j, _, _ = pairs(3, 3)
    fg.factor(lambda c, a, b: c * a * b, scope=("strength", "s", "s"), index=(None, i, j))
    assert lattice_kernel(Blanket(target_of(pose(fg, None)), "s")) is None
    # once it is given, it is a constant
    given = target_of(pose(fg, {"strength": 0.3}))
    blanket = Blanket(given, "s")
    kernel = lattice_kernel(blanket)
    assert kernel is not None
    values = random_state(given, 3, 0)
    expected = normalised(brute(blanket, values))
    np.testing.assert_allclose(normalised(kernel.log_density(values)), expected, atol=1e-9)
    net = bmc.BayesNet(plates={"i": 3})
    net.add("far", bmc.Categorical([0.5, 0.5]), plates="i")
    net.add("sum", lambda far: bmc.Normal(far.sum("i"), 1.0))
    assert lattice_kernel(Blanket(target_of(pose(net, {"sum": 1.2})), "far")) is None


def test_arguments_stay_and_the_stream_decides() -> None:
    for case in ("Potts", "irregular"):
        target = target_of(pose(CASES[case][0](), None))
        kernel = lattice_kernel(Blanket(target, "s"))
        assert kernel is not None
        values = random_state(target, 3, 0)
        values["s"].flags.writeable = False
        first, _ = kernel.step(values, {}, np.random.Generator(np.random.SFC64(1)), False)
        second, _ = kernel.step(values, {}, np.random.Generator(np.random.SFC64(1)), False)
        np.testing.assert_array_equal(first["s"], second["s"])
        assert first["s"].dtype == np.uint8
