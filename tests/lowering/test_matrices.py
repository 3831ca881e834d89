"""Linear algebra in machine code is NumPy's, NaN where that raises; and as near to it as rounding allows."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import TraceError
from bayesmc.expression import Expression, Program, TracedArray, leaf
from bayesmc.lowering import compiled, held_against_numpy, kernel, machine, matrices
from bayesmc.network import pose
from bayesmc.passes.derivatives import gradient
from bayesmc.passes.guarded import guarded
from bayesmc.passes.rounding import disturbed
from bayesmc.structure.compiled_density import in_machine_code
from bayesmc.structure.target import target_of
from bayesmc.structure.unconstrained import unconstrained_density

pytest.importorskip("llvmlite", reason="llvmlite is not installed")


def functions(size: int, batch: tuple[int, ...]) -> list[Expression]:
    a, b = TracedArray(leaf("a", (*batch, size, size))), TracedArray(leaf("b", (*batch, size, 2)))
    factor, turned = np.linalg.cholesky(a), np.swapaxes(a, -1, -2) + np.tril(a)
    found = [
        factor, np.linalg.inv(factor), np.linalg.inv(a), np.linalg.det(a), np.linalg.solve(a, b),
        np.sum(np.linalg.solve(turned, b + 1.0), axis=-1), np.linalg.solve(a[..., :1, :1], b[..., :1, :]),
    ]  # fmt: skip
    return guarded([f.expression for f in found])


def points(size: int, batch: tuple[int, ...], seed: Any) -> list[dict[str, np.ndarray]]:
    """Matrices with factors, those with inverses alone, and those with neither."""
    rng = np.random.default_rng(seed)
    z, b = rng.normal(size=(5, *batch, size, size)), rng.normal(size=(5, *batch, size, 2))
    positive = z @ np.swapaxes(z, -1, -2) / size + 0.3 * np.eye(size)
    singular = positive.copy()
    singular[..., 0, :] = singular[..., :, 0] = 0.0
    return [{"a": a, "b": b} for a in (positive, z, singular)]


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
@pytest.mark.parametrize("size", [1, 2, 3, 8, 9, 20, 48])
def test_they_give_what_numpy_does(size: int, batch: tuple[int, ...]) -> None:
    held_against_numpy(functions(size, batch), points(size, batch, [size, len(batch)]))


def test_a_batch_of_right_sides_has_one_matrix() -> None:
    a, b = TracedArray(leaf("a", (3, 3))), TracedArray(leaf("b", (4, 3, 2)))
    found = guarded([np.linalg.solve(a, b).expression])
    rng = np.random.default_rng(0)
    values = {"a": rng.normal(size=(6, 3, 3)), "b": rng.normal(size=(6, 4, 3, 2))}
    run = compiled(found)
    wanted = np.linalg.solve(values["a"][:, None], values["b"])
    np.testing.assert_allclose(run(values)[0], wanted, rtol=1e-10)


@pytest.mark.parametrize("name", ["cholesky", "forward", "eliminated"])
def test_planted_faults_show(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    made = matrices._FUNCTIONS[name]
    change = ("fsub double", "fadd double")  # a sum with the wrong sign
    monkeypatch.setitem(matrices._FUNCTIONS, name, lambda module: made(module).replace(*change))
    machine.loaded.cache_clear()
    with pytest.raises(TraceError, match="machine code of"):
        held_against_numpy(functions(4, ()), points(4, (), 0)[:1])


def test_large_matrices_are_left_to_lapack() -> None:
    root = np.linalg.inv(TracedArray(leaf("a", (49, 49)))).expression
    with pytest.raises(TraceError, match=r"inv of 49 rows has no machine code \(48 at most\)"):
        compiled([root])


# ---- rounding ---------------------------------------------------------------------------------------


def nearly_singular(rows: int, added: float = 1e-9) -> list[Expression]:
    """The log density of a Gaussian process with a smooth kernel, and its gradient."""
    x, y = np.linspace(0, 1, rows), np.sin(np.arange(rows))
    width = TracedArray(leaf("w", ()))
    cov = np.exp(-0.5 * np.square((x[:, None] - x) / width)) + added * np.eye(rows)
    root = np.linalg.cholesky(cov)
    z = np.matvec(np.linalg.inv(root), y)
    total = -0.5 * np.sum(z * z) - np.sum(np.log(np.linalg.diagonal(root)))
    return guarded([total.expression, gradient(total.expression, ["w"])["w"]])


WIDTHS = [{"w": np.array([0.3, 0.5, 1.0])}]


def test_two_right_ways_differ_by_what_rounding_does() -> None:
    roots = nearly_singular(30)
    with pytest.raises(TraceError, match="and NumPy"):
        held_against_numpy(roots, WIDTHS)
    held_against_numpy(roots, WIDTHS, disturbed=disturbed(roots))


def test_a_wrong_one_differs_by_more(monkeypatch: pytest.MonkeyPatch) -> None:
    roots, made = nearly_singular(30), matrices._FUNCTIONS["forward"]
    machine.loaded.cache_clear()
    pairs = zip(Program(roots)(WIDTHS[0]), Program(disturbed(roots))(WIDTHS[0]), strict=True)
    assert all((1e3 * np.abs(a - b) < 0.1 * np.abs(a)).all() for a, b in pairs)
    wrong = lambda module: made(module).replace("fsub double", "fadd double")  # noqa: E731
    monkeypatch.setitem(matrices._FUNCTIONS, "forward", wrong)
    with pytest.raises(TraceError, match="and NumPy"):
        held_against_numpy(roots, WIDTHS, disturbed=disturbed(roots))


def test_a_wrong_one_is_seen_where_rounding_decides_whether_there_is_a_factor(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    roots, made = nearly_singular(30, 1e-15), matrices._FUNCTIONS["forward"]
    machine.loaded.cache_clear()
    wrong = lambda module: made(module).replace("fsub double", "fadd double")  # noqa: E731
    monkeypatch.setitem(matrices._FUNCTIONS, "forward", wrong)
    with pytest.raises(TraceError, match="and NumPy"):
        held_against_numpy(roots, WIDTHS, disturbed=disturbed(roots))


def test_determinants_overflow_no_sooner_than_they_are_large() -> None:
    root = guarded([np.linalg.det(TracedArray(leaf("a", (4, 4)))).expression])
    sizes = np.array([[1e200, 1e200, 1e-200, 1e-200], [1e-200, -1e-200, 1e200, 1e200]])
    found = compiled(root)({"a": sizes[:, :, None] * np.eye(4)})[0]
    np.testing.assert_allclose(found, [1.0, -1.0], rtol=1e-12)


def test_many_matrices_share_their_memory() -> None:
    a = TracedArray(leaf("a", (40, 40)))
    total = sum(np.linalg.inv(a + k)[0, 0] for k in range(40))
    run, text = compiled([total.expression]), kernel.Kernel([total.expression], frozenset("a")).text
    assert text.count(f"alloca double, i64 {40 * 40}") == 2  # of 40 inverses
    value = {"a": np.eye(40)[None] * 3.0}
    np.testing.assert_allclose(run(value), run.program(value), rtol=1e-9)


def test_nothing_is_disturbed_without_matrices() -> None:
    root = np.exp(TracedArray(leaf("x", ()))).expression
    assert disturbed([root]) == [root]


def test_correlated_effects_have_machine_code() -> None:
    net = bmc.BayesNet(plates={"group": 4, "row": 12})
    net.add("sd", bmc.Exponential(1.0))
    net.add("half", bmc.Beta(2.0, 2.0))

    @net.node(plates="group")
    def effect(sd, half):
        rho = 2 * half - 1
        cov = bmc.stack([sd**2, sd * rho, sd * rho, np.ones_like(rho)])
        return bmc.MvNormal(np.zeros(2), cov.reshape((*cov.shape[:-1], 2, 2)))

    at = np.arange(12) % 4
    net.add("y", lambda effect: bmc.Bernoulli(logits=effect.array[..., 0, at, 0]), plates="row")
    density = unconstrained_density(target_of(pose(net, {"y": at % 2})))
    fast = in_machine_code(density, calls=10**6, debug=True)
    u = np.random.default_rng(0).normal(size=(7, density.size))
    for a, b in zip(fast.with_gradient(u), density.with_gradient(u), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9)
    assert fast.code == "machine code"
