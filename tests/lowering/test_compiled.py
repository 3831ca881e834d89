"""Graphs of random functions give in machine code what they give in NumPy, and planted faults show."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest
from scipy import special

import bayesmc as bmc
from bayesmc.errors import TraceError
from bayesmc.expression import (
    Expression,
    Program,
    TracedArray,
    elementwise,
    evaluate,
    gather,
    leaf,
    pick,
    reduction,
    reshape,
    trace,
)
from bayesmc.expression.functions import product
from bayesmc.lowering import Compiled, compiled, kernel, machine, writer
from bayesmc.passes.derivatives import gradient
from tests.expression.random_functions import ARGUMENTS, random_arguments, random_function
from tests.expression.test_random_functions import BATCHES, close, stand_ins

pytest.importorskip("llvmlite", reason="llvmlite is not installed")


def lowered(root: Expression) -> Compiled | None:
    try:
        return compiled([root])
    except TraceError as error:
        assert "no machine code" in str(error)
        return None


def differs(run: Compiled, seed: Any) -> bool:
    rng = np.random.default_rng(seed)
    for batches in BATCHES:
        values = random_arguments(rng, batches)
        for found, expected in zip(run(values), run.program(values), strict=True):
            if found.shape != expected.shape or not close(found, expected, 1e-12):
                return True
    return False


def test_machine_code_computes_what_the_graph_does() -> None:
    done = 0
    for seed in range(25):
        root = trace(random_function(np.random.default_rng([18, seed])), stand_ins())
        run = lowered(root)
        if run is not None:
            done += 1
            assert not differs(run, seed), seed
    assert done > 18


def test_gradients_of_random_functions() -> None:
    done = 0
    for seed in range(10):
        root = trace(random_function(np.random.default_rng([19, seed])), stand_ins())
        total = reduction(np.add, root, range(len(root.shape)))
        try:
            slopes = gradient(total, ["a", "b", "v", "w"])
            run = compiled([total, *slopes.values()])
        except TraceError:
            continue
        done += 1
        assert not differs(run, seed), seed
    assert done > 5


def compare(roots: list[Any], values: dict[str, Any], tolerance: float = 1e-12) -> Compiled:
    run = compiled(roots)
    for found, expected in zip(run(values), evaluate(roots, values), strict=True):
        assert found.shape == expected.shape
        assert found.dtype.kind == expected.dtype.kind.replace("u", "i")
        assert close(1.0 * found, 1.0 * expected, tolerance)
    return run


@pytest.mark.parametrize("size", [1, 3, 8, 9, 40])
@pytest.mark.parametrize("batch", [(), (1,), (5,), (2, 3)])
def test_loops_of_all_sizes(size: int, batch: tuple[int, ...]) -> None:
    rng = np.random.default_rng(size)
    x, m, k = leaf("x", (size, 3)), leaf("m", (3,)), leaf("k", (size,), int, 3)
    table = elementwise(np.exp, m)
    chosen = gather(table, k)
    rows = reduction(np.add, elementwise(np.multiply, x, m), [1])
    columns = reduction(np.add, elementwise(np.multiply, x, reshape(chosen, (size, 1))), [0])
    turned = reshape(pick([x], np.arange(3 * size).reshape(size, 3).T), (3 * size,))
    both = pick([rows, chosen], np.arange(2 * size)[::-1])
    some = pick([elementwise(np.sin, rows)], rng.integers(size, size=size))
    largest = reduction(np.maximum, elementwise(np.cos, rows), [0])
    roots = [
        rows,
        columns,
        turned,
        both,
        some,
        largest,
        reduction(np.logaddexp, rows, [0]),
        x,
        chosen,
    ]
    roots += [
        reduction(np.add, k, [0]),
        reduction(np.logical_and, elementwise(np.less, x, 3.0), [0, 1]),
    ]
    values = {
        "x": rng.normal(size=(*batch, size, 3)),
        "m": rng.normal(size=(3,)),
        "k": rng.integers(3, size=(*batch, size)),
    }
    compare(roots, values)
    compare(roots, {**values, "m": rng.normal(size=(*batch, 3)), "k": values["k"].astype(np.uint8)})


def test_products_and_their_gradients() -> None:
    rng = np.random.default_rng(3)
    design, beta, y = rng.normal(size=(200, 10)), leaf("beta", (10,)), rng.integers(2, size=200)
    eta = TracedArray(product(np.matvec, leaf("X", (200, 10)), beta))
    density = np.sum(y * special.log_expit(eta) + (1 - y) * special.log_expit(-eta))
    total = density.expression
    roots = [total, gradient(total, ["beta"])["beta"]]
    compare(roots, {"beta": rng.normal(size=(7, 10)), "X": design})


def test_other_data_are_not_other_code() -> None:
    def text(y: np.ndarray, at: np.ndarray) -> str:
        mean = TracedArray(leaf("mean", (4,)))
        off = np.sum((y - np.take(mean, at)) ** 2)
        return kernel.Kernel([off.expression], frozenset(["mean"])).text

    rng = np.random.default_rng(0)
    texts = {text(rng.normal(size=50), rng.integers(4, size=50)) for _ in range(3)}
    assert len(texts) == 1


def hierarchy(rows: int) -> list[Expression]:
    rng = np.random.default_rng(rows)
    y, group = rng.normal(size=rows), rng.integers(30, size=rows)
    mean, effects, log_sd = (TracedArray(leaf(n, s)) for n, s in
                             (("mean", ()), ("effects", (30,)), ("log_sd", ())))  # fmt: skip
    sd = np.exp(log_sd)
    z = (y - mean - np.take(effects, group) * sd) / 2.0
    total = np.sum(-0.5 * z * z) + np.sum(-0.5 * effects**2) - 0.5 * (mean**2 + log_sd**2)
    root = total.expression
    return [root, *gradient(root, ["mean", "effects", "log_sd"]).values()]


def test_the_code_does_not_grow_with_the_data() -> None:
    names = frozenset(["mean", "effects", "log_sd"])
    small, large = (kernel.Kernel(hierarchy(n), names).text for n in (100, 5000))
    assert small.count("\n") == large.count("\n")
    rng = np.random.default_rng(1)
    values = {
        "mean": rng.normal(size=3),
        "effects": rng.normal(size=(3, 30)),
        "log_sd": rng.normal(size=3),
    }
    compare(hierarchy(500), values)


def test_an_index_outside_is_the_error_that_numpy_makes() -> None:
    table, k = leaf("table", (3,)), leaf("k", (20,), int)
    run = compiled([gather(table, k)])
    values = {"table": np.arange(3.0), "k": np.full(20, 2)}
    assert (run(values)[0] == 2.0).all()
    for wrong in (3, -1, 10**12):
        values["k"][7] = wrong
        with pytest.raises(IndexError, match="outside of 0..2"):
            run(values)


def test_what_has_no_machine_code_says_so() -> None:
    x = TracedArray(leaf("x", (3, 3)))
    with pytest.raises(TraceError, match="solve has no machine code"):
        compiled([np.linalg.solve(x, np.ones((3, 1))).expression])
    with pytest.raises(TraceError, match="zeta"):
        compiled([special.zeta(2.0, x).expression])
    many = np.stack([np.sin(x[0, 0] + k) for k in range(9000)]).expression
    with pytest.raises(TraceError, match="written out"):
        compiled([many])


def test_no_entries() -> None:
    x = leaf("x", (2,))
    (found,) = compiled([elementwise(np.exp, x)])({"x": np.ones((0, 2))})
    assert found.shape == (0, 2)


def test_labels_of_states() -> None:
    net = bmc.BayesNet("n", plates={"point": 12})
    net.add("k", bmc.Categorical([0.2, 0.3, 0.5]), plates="point")
    x = TracedArray(leaf("k", (12,), np.uint8, 3))
    run = compiled([np.where(x == 2, 1.5, -0.5).expression])
    k = np.arange(12, dtype=np.uint8) % 3
    np.testing.assert_array_equal(run({"k": k})[0], np.where(k == 2, 1.5, -0.5))


# planted faults: each must be seen by the comparisons above


def _seen(monkeypatch: pytest.MonkeyPatch) -> bool:
    seeds = range(12)
    for seed in seeds:
        root = trace(random_function(np.random.default_rng([18, seed])), stand_ins())
        try:
            run = compiled([root])
            if differs(run, seed):
                return True
        except (TraceError, RuntimeError, IndexError):
            continue
    return False


def test_a_leaf_that_is_not_broadcast_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    made = writer.Writer.read

    def wrong(self: Any, node: Any, flat: Any) -> Any:
        varying, self.varying = self.varying, frozenset()
        try:
            return made(self, node, flat)
        finally:
            self.varying = varying

    monkeypatch.setattr(writer.Writer, "read", wrong)
    assert _seen(monkeypatch)


def test_a_stale_constant_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    made = writer.Writer._table

    def wrong(self: Any, key: Any, values: np.ndarray, kind: str) -> int:
        return made(self, key, values + 1 if kind == "double" else values, kind)

    monkeypatch.setattr(writer.Writer, "_table", wrong)
    assert _seen(monkeypatch)


def test_a_mask_that_is_ignored_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    made = writer.lowered

    def wrong(code: Any, node: Any, values: Any) -> Any:
        return values[1] if node.function is np.where else made(code, node, values)

    monkeypatch.setattr(writer, "lowered", wrong)
    assert _seen(monkeypatch)


def test_a_value_that_is_not_kept_anew_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sums that do not begin at zero for the next entry."""
    x, m = leaf("x", (40, 3)), leaf("m", (3,))
    root = reduction(np.add, elementwise(np.multiply, elementwise(np.exp, x), m), [0])
    values = {"x": np.random.default_rng(0).normal(size=(5, 40, 3)), "m": np.ones(3)}
    compare([root], values)
    monkeypatch.setattr(writer, "STARTS", {**writer.STARTS, np.add: 1.0})
    with pytest.raises(AssertionError):
        compare([root], values)


def test_threads_do_not_share_memory() -> None:
    from concurrent.futures import ThreadPoolExecutor

    roots = hierarchy(500)
    run, rng = compiled(roots), np.random.default_rng(5)
    many = [
        {
            "mean": rng.normal(size=50),
            "effects": rng.normal(size=(50, 30)),
            "log_sd": rng.normal(size=50),
        }
        for _ in range(8)
    ]
    alone = [run(v) for v in many]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(run, many * 5))
    for k, found in enumerate(together):
        for a, b in zip(found, alone[k % 8], strict=True):
            np.testing.assert_array_equal(a, b)


def test_compiling_takes_a_third_of_a_second_at_most(tmp_path: Any, monkeypatch: Any) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    roots = hierarchy(500)
    values = {"mean": np.zeros(4), "effects": np.zeros((4, 30)), "log_sd": np.zeros(4)}
    machine.loaded.cache_clear()
    compiled([elementwise(np.exp, leaf("x", ()))])({"x": np.zeros(3)})  # the compiler itself
    start = time.process_time()
    compiled(roots)(values)
    assert time.process_time() - start < 0.3 * 3  # slow machines


def test_program_and_machine_code_are_interchangeable() -> None:
    root = trace(random_function(np.random.default_rng([18, 1])), stand_ins())
    values = random_arguments(np.random.default_rng(0), dict.fromkeys(ARGUMENTS, (4,)))
    (a,), (b,) = Program([root])(values), compiled([root])(values)
    assert a.shape == b.shape and a.dtype == b.dtype
