"""Faults of slices in machine code: levels, intervals, volumes, and what others did."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.kernels.base import How
from bayesmc.kernels.compiled_slice import CompiledSlice
from bayesmc.kernels.slice import Slice
from bayesmc.lowering import is_available
from bayesmc.lowering.slice_moves import slice_moves
from bayesmc.network import pose
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import target_of
from bayesmc.testing.kernels.geweke import geweke_test
from bayesmc.testing.kernels.joint import JointModel, NetJoint
from bayesmc.testing.verdict import Verdict
from tests.kernels.invariance import running
from tests.mutants.faults import Edit
from tests.mutants.mutant import ALPHA, Mutant

CODE = "bayesmc.lowering.slice_moves"
RING, NEXT = np.arange(4), (np.arange(4) + 1) % 4


def readings() -> bmc.BayesNet:
    """A scale, and numbers on a ring that are read in pairs: two of them move at once."""
    net = bmc.BayesNet(plates={"i": 4, "j": 4})
    net.add("s", bmc.Gamma(3.0, 3.0))
    net.add("x", lambda s: bmc.Laplace(0.5, s), plates="i")
    net.add("y", lambda x: bmc.Normal(x[RING] - 0.7 * x[NEXT], 1.0), plates="j")
    return net


def sweeps(draws: int) -> Callable[[int], Verdict]:
    """Geweke's test of a sweep of slices in machine code, which nobody compares."""

    def test(seed: int) -> Verdict:
        net = readings()
        target = target_of(pose(net, {}), also=["s", "x", "y"])
        kernels = [Slice(Blanket(target, name), how=How(True)) for name in ("x", "s")]
        slice_moves.cache_clear()  # the text is written anew, with the fault
        for kernel in kernels:
            kernel.expect(10**6, 2000)
            assert isinstance(kernel._code, CompiledSlice), kernel._code
            kernel._code.is_checked = True  # who compares would see most faults first
        slice_moves.cache_clear()
        joint = NetJoint(net, ("y",))

        def move(state: Any, data: Any, rng: np.random.Generator) -> Any:
            values, rows = {**state, **data}, len(data["y"])
            with running():
                for kernel in kernels:
                    new, _ = kernel.step(values, kernel.start(values, rows), rng, False)
                    values = {**values, **new}
            return {name: values[name] for name in state}

        model = JointModel(joint.prior, joint.simulate, STATISTICS)
        return geweke_test(move, model, draws=draws, chains=2000, alpha=ALPHA, rng=seed)

    return test


STATISTICS: dict[str, Callable[[Any, Any], np.ndarray]] = {
    "log s": lambda s, d: np.log(s["s"]),
    "log s^2": lambda s, d: np.log(s["s"]) ** 2,
    "x": lambda s, d: s["x"][:, 0],
    "|x|": lambda s, d: np.abs(s["x"] - 0.5).mean(axis=1),
    "x x": lambda s, d: (s["x"][:, 0] - 0.5) * (s["x"][:, 1] - 0.5),
    "misfit": lambda s, d: np.abs(d["y"] - s["x"] + 0.7 * s["x"][:, NEXT]).mean(axis=1),
    "of its scale": lambda s, d: np.log(s["s"]) * np.abs(s["x"] - 0.5).mean(axis=1),
}

MUTANTS: list[Mutant] = []
if is_available():
    MUTANTS = [
        Mutant(f"slices in machine code: {name}", (edit,), sweeps(draws),
               f"geweke_test of a sweep, 2000 chains of {draws} draws")
        for name, edit, draws in (
            ("points off the slice are taken",
             Edit(f"{CODE}:_Text._shrunk", "is_open & hit, at", "is_open, at",
                  also=(("is_open & ~hit)", "is_open & ~is_open)"),)), 20),
            ("intervals are shrunk to where a chain is",
             Edit(f"{CODE}:_Text._shrunk", "c.where(below, right, at)",
                  "c.where(below, right, c.load(self._vector(_NOW), i, REAL))"), 20),
            ("levels are too high",
             Edit(f"{CODE}:_Text._level", "self._drawn()))", "self._drawn()) * 0.5)"), 20),
            ("logarithms lack their volume",
             Edit(f"{CODE}:_look", "line.eq(1), at, c.number(0.0)", "line.eq(1), 0.0, c.number(0.0)"), 20),
            ("values that others moved are those of the first chain",
             Edit(f"{CODE}:_Text._point_at_others", "first + step * self.row", "first"), 20),
            ("elements of an earlier turn stand where they were last tried",
             Edit(f"{CODE}:_Text._turn", "c.loop(self.size, lambda k",
                  "c.loop(c.where(turn.eq(0), self.size, 1), lambda k"), 100),
        )
    ]  # fmt: skip
