"""Kernels of discrete nodes leave their posteriors invariant: enumeration, tables, fields, blocks, jumps.

Geweke's test and the rank test at a chance of false alarm of 1e-4 each, at fixed seeds; ``--bayesmc-seed``
shifts them, and ``--bayesmc-thorough`` makes the tests longer. Each test is shown to fail on a
kernel with a deliberate error. All models have three
overlapping categories, or more.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.kernels.accepted import Accepted, finite_kernel
from bayesmc.kernels.base import Kernel
from bayesmc.kernels.enumerate import Enumerate, FiniteTerms, JointStates
from bayesmc.kernels.forest_block import ForestBlock
from bayesmc.kernels.jump import Jump
from bayesmc.kernels.labels import Labels, label_kernel
from bayesmc.kernels.lattice import SiteCounts, SiteSums, lattice_kernel
from bayesmc.kernels.tables import TableSweep, joint_states, table_kernel, table_kernels
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Target
from tests.kernels.invariance import (
    Case,
    Make,
    Model,
    Rows,
    Statistic,
    Still,
    backwards,
    each_test,
)

CENTRES = np.array([-1.0, 0.0, 1.5])
SHARES = [0.2, 0.3, 0.5]
RING, NEXT = np.arange(5), (np.arange(5) + 1) % 5
RNG = np.random.default_rng(4)


# ---- models ------------------------------------------------------------------------------------------


def labels() -> Model:
    net = bmc.BayesNet(plates={"i": 6})
    net.add("z", bmc.Categorical(SHARES), plates="i")
    net.add("y", lambda z: bmc.Normal(CENTRES[z], 1.0), plates="i")
    return Model(net, ("y",))


def totals() -> Model:
    """Labels that a count of one state ties."""
    net = bmc.BayesNet(plates={"i": 6})
    net.add("z", bmc.Categorical(SHARES), plates="i")
    net.add("y", lambda z: bmc.Normal(CENTRES[z], 1.0), plates="i")
    net.add("count", lambda z: (z == 2).sum("i"))
    net.add("total", lambda count: bmc.Normal(count, 0.7))
    return Model(net, ("y", "total"))


def ring(sd: float = 0.5) -> Model:
    """Neighbours share data: elements of three colours."""
    net = bmc.BayesNet(plates={"i": 5, "pair": 5})
    net.add("z", bmc.Categorical(SHARES), plates="i")
    net.add("y", lambda z: bmc.Normal(z[RING] + 0.7 * z[NEXT], sd), plates="pair")
    return Model(net, ("y",))


def _table(*shape: int) -> np.ndarray:
    return RNG.dirichlet(np.full(shape[-1], 1.5), shape[:-1])


def mixture(of_pixels: bool) -> Model:
    """Labels given weights and components, which stay; data are known beforehand."""
    net = bmc.BayesNet(plates={"k": 3, "i": 5})
    net.add("weights", bmc.Dirichlet([1.0, 2.0, 1.5]))
    net.add("label", lambda weights: bmc.Categorical(weights), plates="i")
    if of_pixels:
        net.add("x", bmc.Beta([1.0, 2.0, 3.0], 2.0), plates="k")
        net.add("y", lambda x, label: bmc.Bernoulli(x[label]), plates="i")
    else:
        net.add("x", bmc.Normal(CENTRES, 0.5), plates="k")
        net.add("y", lambda x, label: bmc.Normal(x[label], 0.8), plates="i")
    return Model(net, ("y",), ("label",))


def net_of_tables() -> Model:
    net = bmc.BayesNet()
    net.table("a", [], _table(3))
    net.table("b", ["a"], _table(3, 3))
    net.table("c", ["a"], _table(3, 8))
    net.table("d", ["b", "c"], _table(3, 8, 3))
    net.table("y", ["c", "d"], _table(8, 3, 3))
    net.table("w", ["a", "d"], _table(3, 3, 2))
    return Model(net, ("y", "w"))


def plate_of_tables() -> Model:
    first, second = _table(3, 3), _table(3, 3)
    net = bmc.BayesNet(plates={"i": 4})
    net.add("g", bmc.Categorical(SHARES))
    net.add("z", lambda g: bmc.Categorical(first[g]), plates="i")
    net.add("y", lambda z: bmc.Categorical(second[z]), plates="i")
    return Model(net, ("y",))


FIELD = np.indices((3,) * 5).reshape(5, -1).T.astype(np.uint8)
PAIR = np.array([[1.5, 0.0, -0.4], [0.2, 0.5, 0.0], [0.0, 0.3, 1.6]])
PIXEL = np.array([0.2, 0.5, 0.75])


def field() -> Model:
    """A ring of sites with three states, each with a pixel of two."""
    fg = bmc.FactorGraph("field", plates={"site": 5})
    fg.variable("s", 3, plates="site")
    fg.variable("y", 2, plates="site")
    fg.factor(PAIR, scope=("s", "s"), index=(RING, NEXT))
    fg.factor(np.log(np.stack([1 - PIXEL, PIXEL], axis=1)), scope=("s", "y"), index=(RING, RING))
    log = PAIR[FIELD[:, RING], FIELD[:, NEXT]].sum(axis=1)
    law = np.exp(log) / np.exp(log).sum()

    def draw(rng: np.random.Generator, rows: int) -> Rows:
        return {"s": FIELD[rng.choice(len(FIELD), size=rows, p=law)]}

    def respond(state: Rows, rng: np.random.Generator) -> Rows:
        return {"y": (rng.random(state["s"].shape) < PIXEL[state["s"]]).astype(np.uint8)}

    return Model(fg, ("y",), draw=draw, respond=respond)


def tied(plates: bool) -> Model:
    """Two labels that the data see by their sum alone."""
    net = bmc.BayesNet(plates={"i": 4} if plates else None)
    own: dict[str, Any] = {"plates": "i"} if plates else {}
    table = _table(5, 3)
    net.add("g", bmc.Categorical(SHARES))
    net.add("z", lambda g: bmc.Categorical(_rows_of(FIRST, g)), **own)
    net.add("w", bmc.Categorical(SHARES), **own)
    if plates:
        net.add("y", lambda z, w: bmc.Normal(1.0 * z + w, 0.5), **own)
    else:
        net.add("y", lambda z, w: bmc.Categorical(table[z + w]))
    return Model(net, ("y",), ("z", "w"))


FIRST = _table(3, 3)


def _rows_of(table: np.ndarray, index: Any) -> Any:
    return table[index]


def ordered() -> Model:
    """More states than are jumped between at random."""
    net = bmc.BayesNet(plates={"i": 4})
    net.add("z", bmc.Categorical(np.arange(1.0, 13.0) / 78), plates="i")
    net.add("y", lambda z: bmc.Normal(0.5 * z, 1.0), plates="i")
    return Model(net, ("y",))


def hidden_chain() -> Model:
    """States of five slices under rates and levels that stay where they are."""
    net = bmc.BayesNet(plates={"k": 3})
    net.add("row", bmc.Dirichlet([2.0, 1.0, 3.0]), plates="k")
    net.add("level", bmc.Normal(CENTRES, 0.5), plates="k")
    for t in range(5):
        before = ["row"] + ([f"s{t - 1}"] if t else [])
        moved = (
            (lambda row, s: bmc.Categorical(row[s])) if t else (lambda row: bmc.Categorical(row[0]))
        )
        net.add(f"s{t}", moved, parents=before)
        net.add(f"y{t}", lambda s, m: bmc.Normal(m[s], 0.8), parents=[f"s{t}", "level"])
    return Model(net, tuple(f"y{t}" for t in range(5)), ("s0", "s2", "s4"))


def counts() -> Model:
    net = bmc.BayesNet(plates={"k": 3, "i": 8})
    net.add("n", bmc.Poisson([2.0, 3.0, 5.0]), plates="k")
    net.add("label", bmc.Categorical(SHARES), plates="i")
    net.add("y", lambda n, label: bmc.Normal(1.0 * n[label], 4.0), plates="i")
    return Model(net, ("y",), ("n",))


def tallies() -> Model:
    net = bmc.BayesNet(plates={"k": 3})
    net.add("n", bmc.Multinomial(6, SHARES), plates="k")
    net.add("y", lambda n: bmc.Normal(n[..., 0] * 1.0 - n[..., 1], 3.0), plates="k")
    return Model(net, ("y",))


# ---- kernels, right and wrong ------------------------------------------------------------------------


def enumerate_(colours: bool = True, prior: bool = True) -> Make:
    def make(target: Target) -> Kernel:
        blanket = Blanket(target, "z")
        if not prior:
            blanket.own = None
        if not colours:
            blanket.classes = (None,)
        return Enumerate(blanket)

    return make


def at_once(tie: bool = True, proposal: bool = True) -> Make:
    def make(target: Target) -> Kernel:
        kernel = finite_kernel(Blanket(target, "z"))
        assert isinstance(kernel, Accepted) and len(kernel.left_out) == 1
        assert not kernel.constraints  # both moves in every sweep
        kernel.other = Still(kernel.names)
        if not tie:
            kernel.left_out = []
        if not proposal:
            kernel.proposal.blanket.own = None  # type: ignore[attr-defined]
        return kernel

    return make


def sweep(power: float = 1.0) -> Make:
    def make(target: Target) -> Kernel:
        (kernel,), left = table_kernels(target, [(n,) for n in "abcd"] + [("b", "d")])
        assert isinstance(kernel, TableSweep) and not left
        return TableSweep(target, [_tempered(c, power) for c in kernel.conditionals])

    return make


def _tempered(conditional: Any, power: float) -> Any:
    probs = conditional.probs**power
    return dataclasses.replace(conditional, probs=probs / probs.sum(axis=1, keepdims=True))


def sweep_backwards(make: Make, target: Target, memory: Any) -> tuple[Kernel, Any]:
    kernel: Any = make(target)
    kernel.groups = kernel.groups[::-1]
    return kernel, memory


def row_sums(terms: slice = slice(None)) -> Make:
    def make(target: Target) -> Kernel:
        kernel = table_kernel(Blanket(target, "z"))
        assert isinstance(kernel, JointStates) and not kernel.evaluated
        kernel.parts = kernel.parts[terms]
        return kernel

    return make


def products(factor: float = 1.0) -> Make:
    def make(target: Target) -> Kernel:
        kernel = label_kernel(Blanket(target, "label"))
        assert isinstance(kernel, Labels)
        kernel._features = factor * kernel._features
        return kernel

    return make


def lattice(kind: type[Kernel], colours: bool = True) -> Make:
    def make(target: Target) -> Kernel:
        blanket = Blanket(target, "s")
        assert len(blanket.classes) == 3
        if not colours:
            blanket.classes = (None,)
        kernel = lattice_kernel(blanket)
        assert isinstance(kernel, kind)
        return kernel

    return make


def lattice_backwards(make: Make, target: Target, memory: Any) -> tuple[Kernel, Any]:
    blanket = Blanket(target, "s")
    blanket.classes = blanket.classes[::-1]
    return lattice_kernel(blanket), memory  # type: ignore[return-value]


def joint(kind: Any, terms: slice = slice(None), power: float = 1.0) -> Make:
    def make(target: Target) -> Kernel:
        if kind is TableSweep:
            found: Any = joint_states(target, ("z", "w"))
            assert isinstance(found, TableSweep)
            return TableSweep(target, [_tempered(c, power) for c in found.conditionals])
        if kind is JointStates:
            found = JointStates(target, ("z", "w"))
            found.parts = found.parts[terms]
            return found
        found = JointStates(target, ("z", "w"), FiniteTerms(target))
        found.parts = found.parts[terms]
        return found

    return make


def forest(readers: slice = slice(None)) -> Make:
    def make(target: Target) -> Kernel:
        block = ForestBlock(target, [f"s{t}" for t in range(5)])
        block.read.all, block.places = block.read.all[readers], block.places[readers]
        return block

    return make


class Upwards(Jump):
    """Jumps up five times as often as down; around a circle of states in one direction alone."""

    def _jumped(self, now: Any, memory: Any, rng: Any, shape: Any) -> Any:
        node = self.blanket.node
        if self.anywhere:
            new = (now.astype(np.int64) + 1) % node.domain.size  # type: ignore[union-attr]
            return new.astype(now.dtype), np.zeros(shape, dtype=bool)
        if node.event_shape:
            change = np.array([1, -1, 0]) * np.where(rng.random(shape) < 5 / 6, 1, -1)[..., None]
            return now + change, (now + change < 0).any(axis=-1)
        new = now.astype(np.int64) + np.where(rng.random(shape) < 5 / 6, 1, -1)
        if node.domain is None:
            return new, new < 0
        dead = (new < 0) | (new >= node.domain.size)
        return np.where(dead, now, new).astype(now.dtype), dead


class Uncorrected(Jump):
    """Draws from the node's own density are accepted as if they were jumps."""

    def _proposed(self, values: Any, memory: Any, rng: Any) -> Any:
        new, dead, drawn = super()._proposed(values, memory, rng)
        return new, dead, np.zeros_like(drawn)


def jump(name: str, kind: type[Jump] = Jump, colours: bool = True, **options: Any) -> Make:
    def make(target: Target) -> Kernel:
        blanket = Blanket(target, name)
        if not colours:
            blanket.classes = (None,)
        return kind(blanket, **options)

    return make


def of_jumps(name: str, **options: Any) -> dict[str, Make]:
    faults = {"upwards": jump(name, Upwards, **options)}
    return faults if options else faults | {"uncorrected": jump(name, Uncorrected)}


def alike(name: str) -> dict[str, Statistic]:
    """How many neighbours are in the same state."""
    return {"alike": lambda s, y: (s[name][:, RING] == s[name][:, NEXT]).sum(axis=1)}


CASES = {
    "enumerate": Case(labels(), enumerate_(), {"no prior": enumerate_(prior=False)}),
    "enumerate by colours": Case(
        ring(), enumerate_(), {"colours merged": enumerate_(colours=False)}, backwards,
        statistics=alike("z"),
    ),
    "enumerate at once": Case(
        totals(), at_once(), {"tie left out": at_once(False), "no prior": at_once(proposal=False)},
        statistics={"top": lambda s, y: (s["z"] == 2).sum(axis=1)},
    ),
    "labels of pixels": Case(
        mixture(True), products(), {"steep": products(3.0)}, how="posed"
    ),
    "labels of numbers": Case(
        mixture(False), products(), {"steep": products(3.0)}, how="posed",
        sizes={"replications": 80},
    ),
    "table": Case(
        net_of_tables(), sweep(), {"tempered": sweep(0.6)}, sweep_backwards, how="moving"
    ),
    "table of the evidence": Case(
        net_of_tables(), sweep(), {"tempered": sweep(0.6)}, sweep_backwards, how="posed"
    ),
    "table rows": Case(
        plate_of_tables(), row_sums(), {"no prior": row_sums(slice(1, None))}, how="moving"
    ),
    "field": Case(
        field(), lattice(SiteSums), {"colours merged": lattice(SiteSums, False)},
        lattice_backwards, how="moving", statistics=alike("s"), sizes={"replications": 3000},
    ),
    "field of counts": Case(
        field(), lattice(SiteCounts), {"colours merged": lattice(SiteCounts, False)},
        lattice_backwards, how="posed", statistics=alike("s"), sizes={"replications": 3000},
    ),
    "joint states": Case(
        tied(True), joint(JointStates), {"no prior": joint(JointStates, slice(1, None))}
    ),
    "joint states, tabulated terms": Case(
        tied(False), joint("row sums"), {"no prior": joint("row sums", slice(1, None))},
        how="moving",
    ),
    "joint states, one table": Case(
        tied(False), joint(TableSweep), {"tempered": joint(TableSweep, power=0.6)}, how="moving"
    ),
    "forest": Case(
        hidden_chain(), forest(), {"factors are forgotten": forest(slice(3, None))},
        statistics={"pairs": lambda s, y: sum(s[f"s{t}"] * s[f"s{t + 1}"] for t in range(4)) * 1.0},
        sizes={"replications": 400},
    ),
    "jump anywhere": Case(labels(), jump("z"), of_jumps("z")),
    "jump by colours": Case(
        ring(1.5), jump("z"), {"colours merged": jump("z", colours=False)}, backwards,
        statistics=alike("z"), sizes={"draws": 150, "steps": 5, "replications": 8000},
    ),
    "jump in order": Case(
        ordered(), jump("z"), of_jumps("z"), warmup=20, sizes={"replications": 8000}
    ),
    "jump of counts": Case(counts(), jump("n"), of_jumps("n"), warmup=20),
    "jump of a given size": Case(counts(), jump("n", size=2), of_jumps("n", size=2)),
    "jump of tallies": Case(tallies(), jump("n"), of_jumps("n"), warmup=20),
}  # fmt: skip


#: each row is posed anew, which is too slow for Geweke's test
SLOW = "labels of numbers"
ALL = each_test({name: case for name, case in CASES.items() if name != SLOW})
ALL += [(SLOW, fault, "ranks") for fault in ("", *CASES[SLOW].faults)]


@pytest.mark.parametrize(("name", "fault", "test"), ALL)
def test_kernel(name: str, fault: str, test: str) -> None:
    CASES[name].check(test, fault)


@pytest.mark.filterwarnings("ignore::bayesmc.errors.ConvergenceWarning")
def test_elements_move_alone_where_they_are_tied_tightly() -> None:
    """A count that is all but known: at once they are refused, and each element comes there all the same."""

    def run(total: float, sd: float) -> bmc.Posterior:
        net = bmc.BayesNet(plates={"i": 8})
        net.add("z", bmc.Bernoulli(0.3), plates="i")
        net.add("total", lambda z: bmc.Normal(z.sum("i"), sd))
        engine = bmc.Gibbs(50, warmup=100, chains=40)
        return bmc.infer(net, {"total": total}, engine=engine, rng=3)

    tight = run(7.6, 0.05)
    assert np.mean(tight.acceptance["z"]) < 0.25
    assert set(tight["z"].sum(axis=-1)[:, -1]) == {8}
    assert np.mean(run(3.0, 2.0).acceptance["z"]) > 0.5
