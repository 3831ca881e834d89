"""One transition of the No-U-Turn sampler leaves densities invariant, and grows the trees that are defined.

Densities here are written by hand. Geweke's test and the rank test have a chance of false alarm of 1e-4
each, at fixed seeds that ``--bayesmc-seed`` shifts; each fault is seen by both. The tree itself is held
against its definition: all balanced subtrees of a path, leaf by leaf. Machine code passes the same tests,
with the same faults planted, and grows the same trees.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import TraceError
from bayesmc.kernels import no_u_turn
from bayesmc.kernels.compiled_transition import CompiledTransition, SameNumbers
from bayesmc.kernels.no_u_turn import Place, Scale, transition, turning_back
from bayesmc.lowering import Trajectories, is_available
from bayesmc.lowering.no_u_turn import transitions
from bayesmc.network import pose
from bayesmc.structure.compiled_density import in_machine_code
from bayesmc.structure.target import target_of
from bayesmc.structure.unconstrained import unconstrained_density
from bayesmc.testing import JointModel, geweke_test, rank_test, session
from tests.mutants.faults import Edit

ALPHA = 1e-4
SHIFT = session.seed()
LONGER = session.scaled(1)

COV = np.array([[1.0, 0.6, 0.0], [0.6, 1.0, -0.3], [0.0, -0.3, 0.5]])
PRECISION = np.linalg.inv(COV)
ROOT = np.linalg.cholesky(COV)


# ---- the law ---------------------------------------------------------------------------------------
# x = (a, b, c) ~ N(0, COV); y ~ N(a + b^2 / 2, exp(c)): correlated, curved, and with a scale of its own


def prior(rng: np.random.Generator, rows: int) -> np.ndarray:
    return rng.standard_normal((rows, 3)) @ ROOT.T


def simulate(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return x[:, 0] + 0.5 * x[:, 1] ** 2 + np.exp(x[:, 2]) * rng.standard_normal(len(x))


def with_gradient(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    off = y - x[:, 0] - 0.5 * x[:, 1] ** 2
    pull = off * np.exp(-2 * x[:, 2])
    slope = -x @ PRECISION + np.stack([pull, pull * x[:, 1], off * pull - 1.0], axis=1)
    return -0.5 * np.vecdot(x @ PRECISION, x) - 0.5 * off * pull - x[:, 2], slope


MODEL = JointModel(
    prior,
    simulate,
    {
        "a": lambda x, y: x[:, 0],
        "b": lambda x, y: x[:, 1],
        "c": lambda x, y: x[:, 2],
        "a b": lambda x, y: x[:, 0] * x[:, 1],
        "b^2": lambda x, y: x[:, 1] ** 2,
        "log density": lambda x, y: with_gradient(x, y)[0],
        "a and y": lambda x, y: x[:, 0] * np.arctan(y),
    },
)
SCALES = {"diagonal": Scale(np.array([1.0, 0.8, 0.6])), "dense": Scale(0.8 * ROOT)}


def moves(kind: str = "diagonal", step: float = 1.0, max_depth: int = 10) -> Any:
    def move(x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        with np.errstate(all="ignore"):
            place = Place(x, *with_gradient(x, y))
            found = transition(
                lambda u, rows: with_gradient(u, y[rows]), place, np.full(len(x), step), SCALES[kind],
                rng, max_depth,
            )  # fmt: skip
        return found.place.u

    return move


def compiled(threads: int = 1) -> CompiledTransition:
    """The same density, read off a net whose ``y`` somebody else moves, in machine code."""
    net = bmc.BayesNet()
    net.add("x", bmc.MvNormal(np.zeros(3), COV))
    net.add("y", lambda x: bmc.Normal(x[..., 0] + 0.5 * x[..., 1] ** 2, np.exp(x[..., 2])))
    density = unconstrained_density(target_of(pose(net, {}), also=["x", "y"]), ("x",))
    fast = in_machine_code(density, 10**6, 2000)
    assert fast.code == "machine code"
    assert fast.trajectories is not None
    return CompiledTransition(fast.trajectories, fast, threads)


def compiled_moves(kind: str, step: float, stale: bool, check: bool = False) -> Any:
    run = compiled()
    run.is_checked = not check

    def move(x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        def gradient(u: np.ndarray, rows: np.ndarray) -> Any:
            return run.density.with_gradient(u, {"y": y[rows]})

        with np.errstate(all="ignore"):
            place = Place(x, *gradient(x, np.arange(len(x))))
            if stale:
                place = place._replace(slope=np.roll(place.slope, 1, axis=0))
            steps = np.full(len(x), step)
            return run(gradient, place, steps, SCALES[kind], rng, 10, {"y": y}).place.u

    return move


# ---- faults ----------------------------------------------------------------------------------------


class Unweighted(no_u_turn._Forest):
    """Leaves are drawn whatever they weigh."""

    def _leaf(self, leaf: int) -> Any:
        bad = super()._leaf(leaf)
        going = self.going
        taken = going["chances"][:, leaf] < -np.log(leaf + 1.0)
        going["u"] = np.where(taken[:, None], going["end"], going["u"])
        return bad


class Forwards(no_u_turn._Forest):
    """Time goes forwards only: the tree of a draw is not that of where it came from."""

    def double(self, depth: int) -> bool:
        rng, self.rng = self.rng, OneSided(self.rng)  # type: ignore[assignment]
        try:
            return super().double(depth)
        finally:
            self.rng = rng


class OneSided:
    def __init__(self, rng: np.random.Generator) -> None:
        self.standard_exponential = rng.standard_exponential

    def random(self, count: int) -> np.ndarray:
        return np.zeros(count)


class Stale(no_u_turn._Forest):
    """Trajectories begin with the gradient of another place."""

    def __init__(self, gradient: Any, place: Place, *others: Any) -> None:
        super().__init__(gradient, place._replace(slope=np.roll(place.slope, 1, axis=0)), *others)


class WholeTrees(no_u_turn._Forest):
    """Only whole trees are looked at, so that a tree may have stopped earlier from another of its leaves."""

    def _subtree(self, depth: int) -> Any:
        looked = no_u_turn.turning_back
        no_u_turn.turning_back = lambda first, second: np.zeros(len(first[0]), dtype=bool)
        try:
            return super()._subtree(depth)
        finally:
            no_u_turn.turning_back = looked


#: faults, and a step at which each tells most: short ones make deep trees
FAULTS = {
    "weights": (Unweighted, 1.0),
    "direction": (Forwards, 1.0),
    "stale": (Stale, 1.0),
    "subtrees": (WholeTrees, 0.35),
}


_CODE = "bayesmc.lowering.no_u_turn:_Text."
#: the same in machine code
EDITS = {
    "weights": Edit(f"{_CODE}_counted", "weight - total)",
                    '-elementary(c, "log", self._whole(self.leaf).to(REAL) + 1.0))'),
    "direction": Edit(f"{_CODE}_double", "< 0.5", "< 2.0"),
    "subtrees": Edit(f"{_CODE}_merged", " | turned.to(WHOLE)", ""),
}  # fmt: skip
with_compiler = pytest.mark.skipif(not is_available(), reason="llvmlite is not installed")


@contextmanager
def planted(fault: str) -> Iterator[None]:
    """Machine code with a fault."""
    with ExitStack() as stack:
        if fault in EDITS:
            stack.enter_context(EDITS[fault].planted())
        stack.callback(transitions.cache_clear)
        transitions.cache_clear()
        yield


def verdict(move: Any, test: str) -> Any:
    if test == "geweke":
        return geweke_test(move, MODEL, draws=20 * LONGER, chains=2000, alpha=ALPHA, rng=SHIFT)
    return rank_test(move, MODEL, replications=20_000 * LONGER, alpha=ALPHA, rng=SHIFT)


@pytest.mark.parametrize("kind", SCALES)
@pytest.mark.parametrize("test", ["geweke", "ranks"])
@pytest.mark.parametrize("fault", ["", *FAULTS])
def test_law(kind: str, test: str, fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    step = 1.0
    if fault:
        faulty, step = FAULTS[fault]
        monkeypatch.setattr(no_u_turn, "_Forest", faulty)
    found = verdict(moves(kind, step), test)
    assert bool(found) != bool(fault), found


@with_compiler
@pytest.mark.parametrize("kind", SCALES)
@pytest.mark.parametrize("test", ["geweke", "ranks"])
@pytest.mark.parametrize("fault", ["", *FAULTS])
def test_law_of_machine_code(kind: str, test: str, fault: str) -> None:
    step = FAULTS[fault][1] if fault else 1.0
    with planted(fault):
        found = verdict(compiled_moves(kind, step, fault == "stale"), test)
    assert bool(found) != bool(fault), found


@with_compiler
@pytest.mark.parametrize("fault", ["", *EDITS])
def test_machine_code_is_compared_before_its_first_use(fault: str) -> None:
    rng, seen = np.random.default_rng(SHIFT), 0
    step = FAULTS[fault][1] if fault else 0.35
    with planted(fault):
        for _ in range(10):
            x = prior(rng, 50)
            try:
                compiled_moves("dense", step, stale=False, check=True)(x, simulate(x, rng), rng)
            except TraceError as error:
                assert "in machine code ends at" in str(error)
                seen += 1
    assert (seen > 0) == bool(fault)


def test_law_of_short_trees() -> None:
    for depth in (1, 2):
        assert rank_test(
            moves(step=0.4, max_depth=depth), MODEL, replications=2000 * LONGER, alpha=ALPHA, rng=SHIFT
        )  # fmt: skip


# ---- the tree --------------------------------------------------------------------------------------


class Scripted:
    """Momenta and directions as told; the draw within a tree is its last leaf."""

    def __init__(self, momenta: np.ndarray, forwards: np.ndarray) -> None:
        self.momenta, self.forwards, self.depth = momenta, forwards, 0
        self.going = np.arange(len(momenta))

    def standard_normal(self, shape: Any) -> np.ndarray:
        return self.momenta

    def random(self, count: int) -> np.ndarray:
        # chains that ended are known by their number alone: each test has one chain
        side = self.forwards[:count, self.depth]
        self.depth += 1
        return np.where(side, 0.0, 1.0)

    def standard_exponential(self, shape: Any) -> np.ndarray:
        return np.full(shape, 1e9)


def by_definition(
    u: np.ndarray, momenta: np.ndarray, step: float, scale: np.ndarray, forwards: np.ndarray
) -> tuple[int, int]:
    """Doublings that stand, and leaves that were evaluated, of one trajectory: everything written out."""

    def slope(u: np.ndarray) -> np.ndarray:
        return with_gradient(u[None], np.zeros(1))[1][0]

    def log(u: np.ndarray) -> float:
        return float(with_gradient(u[None], np.zeros(1))[0][0])

    def leap(u: np.ndarray, p: np.ndarray, e: float) -> tuple[np.ndarray, np.ndarray]:
        p = p + 0.5 * e * slope(u)  # plain numbers here: p = whitened / scale
        u = u + e * scale**2 * p
        return u, p + 0.5 * e * slope(u)

    def turns(block: list[np.ndarray]) -> bool:
        """Of momenta of neighbouring leaves, whole or across the middle."""
        half = len(block) // 2
        left, right = block[:half], block[half:]
        pairs = [(block, block[0], block[-1])]
        pairs += [([*left, right[0]], left[0], right[0]), ([left[-1], *right], left[-1], right[-1])]
        return any(
            min(np.sum(part, axis=0) @ (scale**2 * a), np.sum(part, axis=0) @ (scale**2 * b)) <= 0
            for part, a, b in pairs
        )

    start = momenta / scale
    energy = 0.5 * momenta @ momenta - log(u)
    path, leaves = [(u, start)], 0
    for depth, forward in enumerate(forwards):
        new: list[tuple[np.ndarray, np.ndarray]] = []
        place = path[-1] if forward else path[0]
        for leaf in range(1 << depth):
            place = leap(*place, step if forward else -step)
            new.append(place)
            leaves += 1
            p = place[1] * scale
            if not 0.5 * p @ p - log(place[0]) - energy <= 1000:
                return depth, leaves
            for size in (2**k for k in range(1, depth + 1)):
                if (leaf + 1) % size == 0 and turns([p for _, p in new[-size:]]):
                    return depth, leaves
        path = path + new if forward else new[::-1] + path
        if turns([p for _, p in path]):
            return depth + 1, leaves
    return len(forwards), leaves


def test_trees_are_those_of_the_definition() -> None:
    rng = np.random.default_rng(SHIFT)
    scale, depths = np.array([1.0, 0.8, 0.6]), []
    for _ in range(300):
        u, momenta = prior(rng, 1), rng.standard_normal((1, 3))
        forwards = rng.random((1, 6)) < 0.5
        step = float(np.exp(rng.uniform(-4, 1)))
        count = 0

        def gradient(v: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            nonlocal count
            count += len(v)
            return with_gradient(v, np.zeros(len(v)))

        place = Place(u, *with_gradient(u, np.zeros(1)))
        script: Any = Scripted(momenta, forwards)
        with np.errstate(all="ignore"):
            found = transition(gradient, place, np.array([step]), Scale(scale), script, 6)
            expected = by_definition(u[0], momenta[0], step, scale, forwards[0])
        assert (int(found.depth[0]), count) == expected
        depths.append(expected[0])
    assert len(set(depths)) == 7  # all of them were seen


@with_compiler
def test_trees_of_machine_code_are_the_same() -> None:
    """The same momenta and uniform numbers: the same leaves, draws and counts, chain by chain."""
    rng, run = np.random.default_rng(SHIFT), compiled()
    run.is_checked = True
    for kind, scale in SCALES.items():
        x, steps = prior(rng, 300), np.exp(rng.uniform(-4, 1, 300))
        y = simulate(x, rng)
        momenta, seeds = rng.standard_normal(x.shape), rng.integers(0, 1 << 64, (300, 4), np.uint64)

        def gradient(u: np.ndarray, rows: Any, y: np.ndarray = y) -> Any:
            return run.density.with_gradient(u, {"y": y[rows]})

        with np.errstate(all="ignore"):
            place = Place(x, *gradient(x, np.arange(300)))
            found = run._moved(
                gradient, place, steps, scale, momenta, seeds.copy(), 6,
                {"y": y},
            )  # fmt: skip
            for k in range(300):
                row = slice(k, k + 1)
                wanted = transition(
                    lambda u, _, k=k: gradient(u, np.full(len(u), k)),
                    Place(*(part[row] for part in place)), steps[row], scale,
                    SameNumbers(momenta[row], seeds[k]), 6,
                )  # fmt: skip
                assert found.depth[k] == wanted.depth[0], kind
                assert found.divergent[k] == wanted.divergent[0]
                for a, b in zip(found.place, wanted.place, strict=True):
                    np.testing.assert_allclose(a[k], b[0], rtol=1e-6, atol=1e-6)
                np.testing.assert_allclose(found.acceptance[k], wanted.acceptance[0], atol=1e-7)
                np.testing.assert_allclose(found.energy[k], wanted.energy[0])
        assert len(np.unique(found.depth)) >= 6
        assert found.divergent.any()


@with_compiler
def test_trajectories_run_backwards() -> None:
    """From where a tree of the last leaf ended, with its momenta turned, the same leaves lead back."""
    half, count, run = 0.05, 8, Trajectories(None, "u")
    rng = np.random.default_rng(SHIFT)
    x, seen = prior(rng, 1), []

    def ask(chain: int, u: np.ndarray) -> Any:
        log, slope = with_gradient(u[None], np.full(1, 0.7))
        seen.append(u)
        return log[0], slope[0]

    momenta, root = rng.standard_normal((1, 3)), SCALES["diagonal"].root
    log, slope = with_gradient(x, np.full(1, 0.7))
    place = Place(x.copy(), log.copy(), slope.copy())
    seeds = rng.integers(0, 1 << 64, (1, 4), np.uint64)
    run.move(tuple(place), momenta, np.full(1, 2 * half), root, seeds, 3, ask)
    # the leapfrog integrator written out, from the first place to and fro
    path = {}
    for sign in (1.0, -1.0):
        u, p = x, momenta
        for k in range(1, count):
            p = p + sign * half * root * with_gradient(u, np.full(1, 0.7))[1]
            u = u + sign * 2 * half * root * p
            p = p + sign * half * root * with_gradient(u, np.full(1, 0.7))[1]
            path[sign * k] = u
    for u in seen:
        assert min(np.abs(u - v).max() for v in path.values()) < 1e-9
    assert len(seen) >= 3


@with_compiler
def test_threads_make_no_difference() -> None:
    rng = np.random.default_rng(SHIFT)
    x = prior(rng, 37)
    y, found = simulate(x, rng), []
    for threads in (1, 2, 5, 40):
        run, own = compiled(threads), np.random.default_rng(1)

        def gradient(u: np.ndarray, rows: np.ndarray) -> Any:
            return run.density.with_gradient(u, {"y": y[rows]})  # noqa: B023

        place = Place(x, *gradient(x, np.arange(37)))
        for _ in range(3):
            place = run(gradient, place, np.full(37, 0.3), SCALES["dense"], own, 10, {"y": y}).place
        found.append(place)
    for other in found[1:]:
        for a, b in zip(found[0], other, strict=True):
            assert np.array_equal(a, b)


@with_compiler
def test_errors_of_a_density_are_raised() -> None:
    def ask(chain: int, u: np.ndarray) -> Any:
        raise ArithmeticError(f"no density of chain {chain}")

    place = np.zeros((2, 1)), np.zeros(2), np.zeros((2, 1))
    seeds = np.arange(8, dtype=np.uint64).reshape(2, 4)
    with pytest.raises(ArithmeticError, match="chain 0"):
        Trajectories(None, "u").move(place, np.ones((2, 1)), np.ones(2), np.ones(1), seeds, 3, ask)


def test_criterion_looks_at_neighbours() -> None:
    """Two trees whose outer ends agree with the whole, and which turn where they meet."""
    ahead, back = np.array([1.0, 0.0]), np.array([-1.0, 0.0])
    first = ahead[None], back[None], 3 * ahead[None]
    second = back[None], ahead[None], 3 * ahead[None]
    straight = ahead[None], ahead[None], 3 * ahead[None]
    assert turning_back(first, second)[0]
    assert not turning_back(straight, straight)[0]


def test_chains_that_ended_cost_nothing() -> None:
    """Rows of all calls are the leaves of all trees."""
    rng, rows_asked = np.random.default_rng(SHIFT), 0

    def gradient(u: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        nonlocal rows_asked
        assert len(u) == len(rows)
        rows_asked += len(u)
        return with_gradient(u, np.zeros(len(u)))

    u = prior(rng, 200)
    place = Place(u, *with_gradient(u, np.zeros(200)))
    step = np.exp(rng.uniform(-4.0, 0.0, 200))
    found = transition(gradient, place, step, SCALES["diagonal"], rng)
    assert found.depth.min() < 3 < found.depth.max()
    assert rows_asked <= ((2 << found.depth) - 1).sum() < 200 * (2 << found.depth.max()) // 3


def test_divergences() -> None:
    """Chains that leave the support, or whose energy explodes, are told and stay where they were."""

    def gradient(u: np.ndarray, rows: Any) -> tuple[np.ndarray, np.ndarray]:
        inside = (np.abs(u) < 1.0).all(axis=1)
        return np.where(inside, 0.0, -np.inf), np.zeros_like(u)

    rng = np.random.default_rng(SHIFT)
    u = rng.uniform(-1.0, 1.0, (500, 2))
    ahead = transition(
        gradient, Place(u, *gradient(u, None)), np.full(500, 8.0), Scale(np.ones(2)), rng
    )
    assert ahead.divergent.mean() > 0.9
    gone = ahead.divergent & (ahead.depth == 0)
    assert gone.any() and np.array_equal(ahead.place.u[gone], u[gone])
    assert (np.abs(ahead.place.u) < 1.0).all()
    near = transition(
        gradient, Place(0.0 * u, *gradient(0.0 * u, None)), np.full(500, 1e-6), Scale(np.ones(2)), rng, 3
    )  # fmt: skip
    assert not near.divergent.any() and (near.depth == 3).all()


def test_place_knows_its_own_gradient() -> None:
    rng = np.random.default_rng(SHIFT)
    x = prior(rng, 300)
    y = simulate(x, rng)
    place = Place(x, *with_gradient(x, y))
    found = transition(
        lambda u, rows: with_gradient(u, y[rows]), place, np.full(300, 0.7), SCALES["dense"], rng
    )
    log, slope = with_gradient(found.place.u, y)
    assert (found.place.u != x).any(axis=1).mean() > 0.5
    np.testing.assert_allclose(found.place.log, log)
    np.testing.assert_allclose(found.place.slope, slope)
