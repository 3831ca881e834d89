"""Tabulated full conditionals: against the model's own densities, and what is drawn from them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

import bayesmc as bmc
from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.mcmc.starts import start_states
from bayesmc.errors import BayesmcError, ZeroProbabilityError
from bayesmc.kernels import tables
from bayesmc.kernels.enumerate import FiniteTerms, JointStates, conditional_of
from bayesmc.kernels.tables import TableSweep, table_kernel, table_kernels
from bayesmc.network import pose
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Target, Values, target_of
from bayesmc.testing import random_evidence, random_net

#: false alarms of every statistical test here
ALPHA = 1e-4


def states_of(target: Target, name: str) -> int:
    domain = target.model[name].domain
    assert domain is not None
    return domain.size


def brute(blanket: Blanket, values: Values) -> np.ndarray:
    """Full conditional by the model's own functions, shape (states, chains, *plates)."""
    states = states_of(blanket.target, blanket.name)
    now = values[blanket.name]
    found = np.empty((states, *now.shape))
    with marking_invalid(), np.errstate(all="ignore"):
        for k in range(states):
            candidate = np.full_like(now, k)
            found[k] = blanket.log_density(values, candidate)
    return normalised(found)


def normalised(log: np.ndarray) -> np.ndarray:
    probs = np.exp(log - log.max(axis=0))
    return probs / probs.sum(axis=0)


def started(target: Target, chains: int, seed: int) -> Values:
    with marking_invalid(), np.errstate(all="ignore"):
        return start_states(target, chains, np.random.default_rng(seed))


def everything(target: Target) -> tuple[Values, np.ndarray]:
    """All joint states of finite chain nodes, as chains, and their posterior probabilities."""
    shapes = [target.model[n].plate_shape for n in target.chain]
    sizes = [int(np.prod(s)) for s in shapes]
    cards = [
        states_of(target, n) for n, k in zip(target.chain, sizes, strict=True) for _ in range(k)
    ]
    grid = np.indices(cards).reshape(len(cards), -1).T.astype(np.uint8)
    values: Values = dict(target.known)
    begin = 0
    for name, shape, size in zip(target.chain, shapes, sizes, strict=True):
        values[name] = grid[:, begin : begin + size].reshape(-1, *shape)
        begin += size
    with marking_invalid(), np.errstate(all="ignore"):
        target.refresh(values, target.chain)
        log = target.log_density(values)
    return values, normalised(log)


def chi_square(counts: np.ndarray, probs: np.ndarray) -> float:
    """p-value; what is impossible must not have happened."""
    assert not counts[probs == 0].any()
    expected = probs * counts.sum()
    order = np.argsort(expected)
    rare = np.cumsum(expected[order]) < 10
    cells = np.append(expected[order][~rare], expected[order][rare].sum())
    seen = np.append(counts[order][~rare], counts[order][rare].sum())
    keep = cells > 0
    statistic = ((seen[keep] - cells[keep]) ** 2 / cells[keep]).sum()
    return float(stats.chi2.sf(statistic, max(keep.sum() - 1, 1)))


def stationarity(target: Target, kernels: Any, chains: int, seed: int) -> float:
    """p-value that a step from exact posterior draws gives posterior draws, by the joint law."""
    everyone, probs = everything(target)
    rng = np.random.Generator(np.random.SFC64(seed))
    at = rng.choice(len(probs), chains, p=probs)
    values = {n: v[at] if n not in target.known else v for n, v in everyone.items()}
    for kernel in kernels:
        new, _ = kernel.step(values, {}, rng, False)
        values.update(new)
    code = np.zeros(chains, dtype=np.intp)
    for name in target.chain:
        flat = values[name].reshape(chains, -1)
        for element in range(flat.shape[1]):
            code = code * states_of(target, name) + flat[:, element]
    return chi_square(np.bincount(code, minlength=len(probs)).astype(float), probs)


def posed(seed: int, **options: Any) -> Target | None:
    """A random finite net with evidence, or None where the evidence leaves nothing to draw."""
    rng = np.random.default_rng([seed, 77])
    net = random_net(rng, **options)
    evidence = random_evidence(net, rng, chance=0.4)
    target = target_of(pose(net, evidence))
    return target if target.chain else None


def test_conditionals_of_random_nets_equal_enumeration() -> None:
    compared = 0
    for seed in range(60):
        target = posed(seed, nodes=(3, 8), states=4)
        if target is None:
            continue
        try:
            values = started(target, 16, seed)
        except BayesmcError:
            continue  # impossible evidence
        terms = FiniteTerms(target)
        for name in target.chain:
            conditional = conditional_of(terms, (name,))
            if conditional is None:
                continue
            compared += 1
            expected = brute(Blanket(target, name), values)
            found = conditional.probabilities(values).T
            np.testing.assert_allclose(np.broadcast_to(found, expected.shape), expected, atol=1e-9)
    assert compared > 60


def test_row_sums_of_random_plated_nets_equal_enumeration() -> None:
    compared = plated = 0
    for seed in range(200):
        target = posed(seed, nodes=(3, 8), states=3, plates=True)
        if target is None:
            continue
        try:
            values = started(target, 8, seed)
        except BayesmcError:
            continue
        terms = FiniteTerms(target)
        for name in target.chain:
            blanket = Blanket(target, name)
            around = terms.around((name,))
            if around is None or any(c.relation.kind != "aligned" for c in blanket.children):
                continue
            kernel = JointStates(target, (name,), terms)
            compared += 1
            plated += bool(blanket.node.plates)
            free = target.free_elements(name)
            found, expected = normalised(kernel.log_density(values)), brute(blanket, values)
            if free is not None:
                flat = (*expected.shape[:2], -1)
                found, expected = found.reshape(flat)[..., free], expected.reshape(flat)[..., free]
            np.testing.assert_allclose(found, expected, atol=1e-9)
    assert compared > 40 and plated > 10


def test_a_conditional_without_a_child_is_noticed() -> None:
    # the negative control of the comparison above
    net = bmc.BayesNet()
    net.add("x", bmc.Bernoulli(0.3))
    net.add("y", lambda x: bmc.Bernoulli(0.2 + 0.6 * x))
    target = target_of(pose(net, {"y": 1}))
    blanket = Blanket(target, "x")
    own = target_of(pose(net, None))
    assert own.chain == ()  # nothing seen: the prior alone is no chain
    found = conditional_of(FiniteTerms(target), ("x",))
    assert found is not None
    expected = brute(blanket, {**target.known, "x": np.zeros(1, dtype=np.uint8)})[:, 0]
    np.testing.assert_allclose(found.probs[0], expected, atol=1e-12)
    assert abs(expected - [0.7, 0.3]).max() > 0.2


def wide(states: int) -> Target:
    """Two nodes of many states and one of few, tied to each other and to what is seen."""
    rng = np.random.default_rng(states)
    net = bmc.BayesNet()
    prior = rng.dirichlet(np.ones(states))
    prior[2] = 0.0
    net.add("x", bmc.Categorical(prior / prior.sum()))
    net.table("y", ["x"], rng.dirichlet(np.ones(states), size=states))
    net.table("z", ["x", "y"], rng.dirichlet(np.ones(3), size=(states, states)))
    net.table("seen", ["z"], rng.dirichlet(np.ones(2), size=3))
    return target_of(pose(net, {"seen": 1}))


@pytest.mark.parametrize("states", [3, 6, 7, 20])
def test_draws_follow_the_conditional(states: int) -> None:
    # few states are compared, many are searched; one chi-square per node and case
    target = wide(states)
    terms = FiniteTerms(target)
    chains = 200_000
    rng = np.random.Generator(np.random.SFC64(states))
    start = started(target, 1, states)
    values = {**target.known, **{n: np.repeat(start[n], chains) for n in target.chain}}
    for block in (("x",), ("y",), ("z",), ("x", "z"), ("y", "x")):
        conditional = conditional_of(terms, block)
        assert conditional is not None
        new, _ = TableSweep(target, (conditional,)).step(values, {}, rng, False)
        code = np.zeros(chains, dtype=np.intp)
        for name in block:
            code = code * states_of(target, name) + new[name]
        counts = np.bincount(code, minlength=conditional.states).astype(float)
        probs = conditional.probabilities(start)[0]
        assert chi_square(counts, probs) > ALPHA
        # negative control: the next row of the table does not pass
        other = np.roll(probs, 1)
        assert (
            stats.chisquare(counts + 1, (other + 1e-9) / (other + 1e-9).sum() * (counts + 1).sum())[
                1
            ]
            < ALPHA
        )


@pytest.mark.parametrize("seed", range(6))
def test_a_sweep_leaves_the_posterior_invariant(seed: int) -> None:
    rng = np.random.default_rng([seed, 5])
    for _ in range(20):
        net = random_net(rng, nodes=(5, 8), states=3, zeros=bool(seed % 2), configurations=3000)
        target = target_of(pose(net, random_evidence(net, rng, chance=0.3)))
        if len(target.chain) >= 4:
            break
    kernels, left = table_kernels(target, [(n,) for n in target.chain] + [target.chain[:2]])
    assert not left
    assert stationarity(target, kernels, 200_000, seed) > ALPHA


def test_nodes_that_meet_are_not_drawn_together(monkeypatch: pytest.MonkeyPatch) -> None:
    target = wide(3)
    blocks = [(n,) for n in target.chain]
    [right], _ = table_kernels(target, blocks)
    assert stationarity(target, [right], 200_000, 1) > ALPHA
    # negative control: all at once is no Gibbs step
    monkeypatch.setattr(tables, "_colours", lambda conditionals: [list(conditionals)])
    [wrong], _ = table_kernels(target, blocks)
    assert stationarity(target, [wrong], 200_000, 1) < 1e-12


@pytest.mark.parametrize("gathered", [0, 4])
def test_positions_in_long_sweeps_are_right(gathered: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "_GATHERED", gathered)
    # differences to the neighbours are seen, so that each node follows from those beside it and no
    # state may change; more nodes than one group reads
    count, rng = 200, np.random.default_rng(3)
    net = bmc.BayesNet()
    truth = rng.integers(3, size=count)
    for t in range(count):
        net.add(f"x{t}", bmc.Categorical([0.2, 0.3, 0.5]))
    parity = np.zeros((3, 3, 3))
    for a in range(3):
        for b in range(3):
            parity[a, b, (a - b) % 3] = 1.0
    evidence = {}
    for t in range(count - 1):
        net.table(f"d{t}", [f"x{t}", f"x{t + 1}"], parity)
        evidence[f"d{t}"] = int((truth[t] - truth[t + 1]) % 3)
    target = target_of(pose(net, evidence))
    [kernel], left = table_kernels(target, [(n,) for n in target.chain])
    assert not left and isinstance(kernel, TableSweep)
    if gathered:
        assert any(group.near for group in kernel.groups)
    else:
        assert any(group.columns is not None for group in kernel.groups)
    shifts = np.arange(6) % 3
    values = {**target.known}
    for t in range(count):
        values[f"x{t}"] = ((truth[t] + shifts) % 3).astype(np.uint8)
    new, _ = kernel.step(values, {}, np.random.Generator(np.random.SFC64(0)), False)
    assert set(new) == set(target.chain)
    for name, value in new.items():
        assert value.dtype == np.uint8
        np.testing.assert_array_equal(value, values[name])
    # negative control: one chain out of step is at an impossible configuration, which is named
    broken = {**values, "x7": ((values["x7"] + 1) % 3).astype(np.uint8)}
    with pytest.raises(ZeroProbabilityError, match="'x"):
        kernel.step(broken, {}, np.random.Generator(np.random.SFC64(0)), False)


def test_gathered_and_multiplied_positions_draw_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(4)
    net = bmc.BayesNet()
    net.table("x0", [], [0.2, 0.3, 0.5])
    for t in range(1, 150):
        net.table(f"x{t}", [f"x{t - 1}"], rng.dirichlet(np.ones(3), size=3))
        net.table(f"y{t}", [f"x{t}"], rng.dirichlet(np.ones(2), size=3))
    target = target_of(pose(net, {f"y{t}": int(rng.integers(2)) for t in range(1, 150)}))
    values = started(target, 20, 0)
    drawn = []
    for gathered in (0, 4):
        monkeypatch.setattr(tables, "_GATHERED", gathered)
        [kernel], left = table_kernels(target, [(n,) for n in target.chain])
        assert not left and isinstance(kernel, TableSweep)
        assert len(kernel.groups) == (2 if gathered else 4)
        new, _ = kernel.step(values, {}, np.random.default_rng(1), False)
        drawn.append(np.stack([new[n] for n in target.chain]))
    np.testing.assert_array_equal(*drawn)
    before = np.stack([values[n] for n in target.chain])
    assert (drawn[0] != before).mean() > 0.2


def test_what_is_seen_of_a_plate_stays() -> None:
    net = bmc.BayesNet(plates={"i": 4, "j": 3})
    net.add("g", bmc.Categorical([0.5, 0.5]))
    table = np.array([[0.7, 0.2, 0.1], [0.1, 0.3, 0.6]])
    net.table("z", ["g"], table, plates=("i", "j"))
    net.table("w", ["z"], np.array([[0.9, 0.1], [0.5, 0.5], [0.2, 0.8]]), plates=("i", "j"))
    seen = np.ma.masked_array(np.arange(12).reshape(4, 3) % 3, mask=np.arange(12).reshape(4, 3) % 2)
    target = target_of(pose(net, {"z": seen, "w": np.arange(12).reshape(4, 3) % 2}))
    values = started(target, 50, 0)
    kernel = table_kernel(Blanket(target, "z"))
    assert isinstance(kernel, JointStates) and not kernel.evaluated
    new, _ = kernel.step(values, {}, np.random.default_rng(0), False)
    kept = ~np.ma.getmaskarray(seen)
    assert (new["z"][:, kept] == seen.data[kept]).all()
    assert (new["z"][:, ~kept] != values["z"][:, ~kept]).any()
    # the one above all of the plate, by sums over its elements
    group = table_kernel(Blanket(target, "g"))
    assert isinstance(group, JointStates) and not group.evaluated
    found, expected = normalised(group.log_density(values)), brute(Blanket(target, "g"), values)
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_a_plated_sweep_leaves_the_posterior_invariant() -> None:
    net = bmc.BayesNet(plates={"i": 3})
    net.add("g", bmc.Categorical([0.3, 0.7]))
    net.table("z", ["g"], np.array([[0.7, 0.3], [0.2, 0.8]]), plates="i")
    net.table("w", ["z"], np.array([[0.9, 0.1], [0.4, 0.6]]), plates="i")
    target = target_of(pose(net, {"w": [1, 0, 1]}))
    kernels = [table_kernel(Blanket(target, n)) for n in ("z", "g")]
    assert stationarity(target, kernels, 200_000, 4) > ALPHA


def test_terms_that_are_no_tables_are_left_to_others() -> None:
    net = bmc.BayesNet(plates={"i": 3})
    net.add("share", bmc.Beta(1.0, 1.0))
    net.add("x", lambda share: bmc.Bernoulli(share))
    net.add("mean", bmc.Normal(0.0, 1.0))
    net.add("y", lambda x, mean: bmc.Normal(x + mean, 1.0), plates="i")
    net.add("far", bmc.Categorical([0.5, 0.5]), plates="i")
    net.add("sum", lambda far: bmc.Normal(far.sum("i"), 1.0))
    target = target_of(pose(net, {"y": [0.1, 0.2, 0.3], "sum": 1.2}))
    assert table_kernel(Blanket(target, "x")) is None
    assert table_kernel(Blanket(target, "far")) is None
    assert table_kernel(Blanket(target, "mean")) is None
    assert table_kernels(target, [("x",)])[1] == [("x",)]


def test_large_blankets_are_summed() -> None:
    rng = np.random.default_rng(0)
    net = bmc.BayesNet()
    net.add("x", bmc.Categorical([0.2, 0.3, 0.5]))
    for k in range(7):
        net.add(f"p{k}", bmc.Categorical(rng.dirichlet(np.ones(5))))
        net.table(f"y{k}", ["x", f"p{k}"], rng.dirichlet(np.ones(2), size=(3, 5)))
    target = target_of(pose(net, {f"y{k}": k % 2 for k in range(7)}))
    kernel = table_kernel(Blanket(target, "x"))
    assert isinstance(kernel, JointStates) and not kernel.evaluated
    values = started(target, 20, 1)
    expected = brute(Blanket(target, "x"), values)
    np.testing.assert_allclose(normalised(kernel.log_density(values)), expected, atol=1e-9)


def test_the_same_stream_gives_the_same_draws_and_arguments_stay() -> None:
    target = wide(7)
    [kernel], _ = table_kernels(target, [(n,) for n in target.chain])
    values = started(target, 10, 0)
    before = {n: v.copy() for n, v in values.items()}
    first, _ = kernel.step(values, {}, np.random.Generator(np.random.SFC64(5)), False)
    second, _ = kernel.step(values, {}, np.random.Generator(np.random.SFC64(5)), False)
    for name in target.chain:
        np.testing.assert_array_equal(first[name], second[name])
    for name, value in before.items():
        np.testing.assert_array_equal(values[name], value)
