"""Faults of Hamiltonian trajectories: volumes, gradients, trees, weights, and what is learnt."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.distributions.base import marking_invalid
from bayesmc.kernels.hamiltonian import Hamiltonian
from bayesmc.lowering import is_available
from bayesmc.lowering.no_u_turn import transitions
from bayesmc.network import pose
from bayesmc.structure.target import target_of
from bayesmc.structure.unconstrained import unconstrained_density
from bayesmc.testing.kernels.geweke import geweke_test
from bayesmc.testing.kernels.joint import JointModel
from bayesmc.testing.verdict import Verdict
from tests.mutants.chains import ranks
from tests.mutants.faults import Edit
from tests.mutants.mutant import ALPHA, Mutant

TREE = "bayesmc.kernels.no_u_turn"
CODE = "bayesmc.lowering.no_u_turn:_Text"


def readings() -> bmc.BayesNet:
    """A mean and a scale, with a hidden number and its reading."""
    net = bmc.BayesNet()
    net.add("m", bmc.Normal(0.0, 1.0))
    net.add("s", bmc.Gamma(3.0, 3.0))
    net.add("x", lambda m, s: bmc.Normal(m, s))
    net.add("y", lambda x: bmc.Normal(x, 1.0))
    return net


def trajectories(
    length: float, draws: int = 20, compiled: bool = False
) -> Callable[[int], Verdict]:
    """Geweke's test of a sweep: mean and scale along a trajectory, the hidden number exactly, twice."""

    def test(seed: int) -> Verdict:
        net = readings()
        target = target_of(pose(net, {}), also=["m", "s", "x", "y"])
        density = unconstrained_density(target, ("m", "s"))
        kernel = Hamiltonian(density, density.others, warmup=0)
        transitions.cache_clear()  # the text is written anew, with the fault
        if compiled:
            kernel.expect(10**6, 2000)
            assert kernel._moving.compiled is not None
            kernel._moving.compiled.is_checked = True  # who compares would see most faults first
        transitions.cache_clear()

        def prior(rng: np.random.Generator, rows: int) -> dict[str, np.ndarray]:
            drawn = net.sample(rows, rng=rng)
            return {name: drawn[name] for name in ("m", "s", "x")}

        def simulate(state: Any, rng: np.random.Generator) -> Any:
            return {"y": state["x"] + rng.standard_normal(len(state["x"]))}

        def move(state: Any, data: Any, rng: np.random.Generator) -> Any:
            values, rows = {**state, **data}, len(data["y"])
            with marking_invalid(), np.errstate(all="ignore"):
                memory = kernel.start(values, rows)
                memory["step"] = kernel.step_size.start(np.full(rows, np.log(length)))
                memory["metric"]["root"] = np.array([0.7, 0.6])
                for _ in range(2):
                    new, memory = kernel.step(values, memory, rng, False)
                    precision = new["s"] ** -2 + 1.0
                    mean = (new["m"] * new["s"] ** -2 + data["y"]) / precision
                    x = mean + precision**-0.5 * rng.standard_normal(rows)
                    values = {**values, **new, "x": x}
            return {name: values[name] for name in state}

        statistics = {
            "m": lambda s, d: s["m"],
            "m^2": lambda s, d: s["m"] ** 2,
            "log s": lambda s, d: np.log(s["s"]),
            "log s^2": lambda s, d: np.log(s["s"]) ** 2,
            "m x": lambda s, d: s["m"] * s["x"],
            "misfit": lambda s, d: np.log(s["s"]) * np.abs(s["x"] - s["m"]),
        }
        model = JointModel(prior, simulate, statistics)
        return geweke_test(move, model, draws=draws, chains=2000, alpha=ALPHA, rng=seed)

    return test


OF = "geweke_test of a sweep, 2000 chains of {} draws"

MUTANTS = [
    Mutant(
        "a Jacobian is missing: trajectories on free numbers",
        (Edit("bayesmc.structure.free_nodes:FreeNode.expressions",
              "return self._with_seen(broadcast(value, (*self.lead, *self.event))), volume",
              "return self._with_seen(broadcast(value, (*self.lead, *self.event))), "
              "constant(0.0)"),
         Edit("bayesmc.structure.unconstrained:unconstrained_density", "hold_against_model(", "0 or print(")),
        trajectories(0.8),
        OF.format(20),
    ),
    Mutant(
        "a gradient is stale: what others moved is not read anew",
        (Edit("bayesmc.kernels.hamiltonian:Hamiltonian._place", "same and not self.given", "same"),),
        trajectories(0.8, 150),
        OF.format(150),
    ),
    Mutant(
        "an unsymmetric tree: time goes forwards only",
        (Edit(f"{TREE}:_Forest.double", "(self.rng.random(count) < 0.5)", "(self.rng.random(count) < 2.0)"),),
        trajectories(0.8),
        OF.format(20),
    ),
    Mutant(
        "an unsymmetric tree: subtrees that turn are taken",
        (Edit(f"{TREE}:_Forest._subtree", "bad |= turning_back", "turning_back"),),
        trajectories(0.3, 40),
        OF.format(40),
    ),
    Mutant(
        "leaves of a trajectory are drawn whatever they weigh",
        (Edit(f"{TREE}:_Forest._leaf", "< weight - going[\"new\"]", "< -np.log(leaf + 1.0)"),),
        trajectories(1.0, 200),
        OF.format(200),
        is_long=True,
    ),
    Mutant(
        "adaptation of trajectories never freezes",
        (Edit("bayesmc.kernels.hamiltonian:Hamiltonian.step", "if warmup:\n", "if True:\n"),),
        ranks(lambda: lambda target: Hamiltonian(unconstrained_density(target)), readings, 20, warmup=10),
        "rank_test, 20 replications (for certain)",
        is_long=True,
    ),
]  # fmt: skip

JACOBIAN, STALE = MUTANTS[0].faults, MUTANTS[1].faults
if is_available():
    MUTANTS += [
        Mutant(
            f"{name}: machine code", faults, trajectories(length, draws, True), OF.format(draws),
            is_long=draws > 200,
        )
        for name, faults, length, draws in (
            ("a Jacobian is missing", JACOBIAN, 0.8, 20),
            ("a gradient is stale", STALE, 0.8, 400),
            ("values that others moved are those of the first chain",
             (Edit(f"{CODE}._point_at_others", "first + step * self.row", "first"),), 0.8, 20),
            ("time goes forwards only", (Edit(f"{CODE}._double", "< 0.5", "< 2.0"),), 0.8, 20),
            ("subtrees that turn are taken",
             (Edit(f"{CODE}._merged", " | turned.to(WHOLE)", ""),), 0.3, 40),
            ("leaves are drawn whatever they weigh",
             (Edit(f"{CODE}._counted", "weight - total)",
                   '-elementary(c, "log", self._whole(self.leaf).to(REAL) + 1.0))'),), 1.0, 200),
        )
    ]  # fmt: skip
