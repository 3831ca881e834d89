"""Coefficients, offsets and scales read off functions, in the many ways in which they are written.

What is read is laid out densely, one axis of components for a node and one for each hidden parent, and
compared with numbers written down by hand. All of these are short in binary, so that "equal" means equal.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import BayesmcError, BudgetError
from bayesmc.network import pose
from bayesmc.structure import LinearGaussian, linear_gaussian, why_not_linear

PLATES = {"group": 3, "point": 5, "row": 2}
GROUP_OF = np.array([2, 0, 0, 1, 2])
A = np.array([[0.5, -2.0], [1.0, 0.25]])
DESIGN = np.array([[1.0, 2.0], [0.5, -1.0], [0.0, 4.0], [3.0, 0.0], [-1.0, 1.0]])
PICK = np.eye(3)[GROUP_OF]
TRIL = np.array([[2.0, 0.0], [0.5, 0.25]])


def read(
    net: bmc.BayesNet, evidence: Mapping[str, Any] | None = None, inputs: Any = None
) -> LinearGaussian:
    problem = pose(net, evidence, inputs)
    assert why_not_linear(problem.model, problem.observed, problem.inputs) is None
    return linear_gaussian(problem.model, problem.observed, problem.inputs)


def scalars(net: bmc.BayesNet, name: str) -> int:
    node = net[name]
    sizes = [PLATES[p] for p in node.plates]
    return int(np.prod([*sizes, *node.event_shape], dtype=int))


def laid_out(
    net: bmc.BayesNet, part: LinearGaussian, name: str
) -> tuple[np.ndarray, dict[str, np.ndarray], np.ndarray]:
    """Offset ``(n,)``, coefficients ``(n, m)`` per parent and covariance ``(n, n)``, of no scope."""
    given = [c for c in (*part.conditionals, *part.computed) if c.block[0] == name]  # type: ignore[index]
    size = scalars(net, name)
    d = size // max(len({c.block for c in given}), 1) if given else 0
    offset, cov = np.full(size, np.nan), np.zeros((size, size))
    gains: dict[str, np.ndarray] = {}
    for c in given:
        assert c.scope == ()
        e = c.block[1]  # type: ignore[index]
        d = len(c.offset)
        own = slice(e * d, (e + 1) * d)
        offset[own] = c.offset
        cov[own, own] = c.root @ c.root.T
        first = 0
        for parent, at in c.parents:  # type: ignore[misc]
            width = part.dims[(parent, at)]
            into = gains.setdefault(parent, np.zeros((size, scalars(net, parent))))
            into[own, at * width : (at + 1) * width] = c.gain[:, first : first + width]
            first += width
        assert first == c.gain.shape[1]
    return offset, gains, cov


def base() -> bmc.BayesNet:
    """Hidden parents of every kind."""
    net = bmc.BayesNet(plates=PLATES)
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("z", bmc.Normal(1.0, 2.0))
    net.add("v", bmc.MvNormal([0.0, 1.0], np.eye(2)))
    net.add("m", bmc.Normal(0.0, 1.0), plates="group")
    net.add("w", bmc.MvNormal(np.zeros(2), np.eye(2)), plates="group")
    net.add("g", bmc.Normal(0.0, 1.0), plates=("group", "row"))
    net.add("p", bmc.Normal(0.0, 1.0), plates="point")
    return net


@dataclasses.dataclass(frozen=True)
class Idiom:
    """A way to write a node, and what it means."""

    function: Callable[..., Any]
    offset: Any
    gains: dict[str, Any]
    cov: Any
    plates: Any = ()


def repeated(value: float, count: int) -> np.ndarray:
    return np.full(count, value)


IDIOMS: dict[str, Idiom] = {
    "constant": Idiom(lambda: bmc.Normal(3.0, 0.5), [3.0], {}, [[0.25]]),
    "itself": Idiom(lambda x: bmc.Normal(x, 2.0), [0.0], {"x": [[1.0]]}, [[4.0]]),
    "a line": Idiom(lambda x: bmc.Normal(1.5 - 2 * x, 1.0), [1.5], {"x": [[-2.0]]}, [[1.0]]),
    "two parents": Idiom(
        lambda x, z: bmc.Normal((x - 3 * z) / 4 + 1, 1.0),
        [1.0],
        {"x": [[0.25]], "z": [[-0.75]]},
        [[1.0]],
    ),
    "a parent that cancels": Idiom(
        lambda x, z: bmc.Normal(x + z - x, 1.0), [0.0], {"z": [[1.0]]}, [[1.0]]
    ),
    "a parent times zero": Idiom(lambda x: bmc.Normal(0 * x + 2, 1.0), [2.0], {}, [[1.0]]),
    "own plate": Idiom(
        lambda m: bmc.Normal(3 * m - 1, 0.5),
        repeated(-1.0, 3),
        {"m": 3 * np.eye(3)},
        np.eye(3) / 4,
        "group",
    ),
    "a parent without plates": Idiom(
        lambda x: bmc.Normal(2 * x, 1.0),
        np.zeros(5),
        {"x": 2 * np.ones((5, 1))},
        np.eye(5),
        "point",
    ),
    "constants in the plate": Idiom(
        lambda x: bmc.Normal(DESIGN[:, 0] * x + DESIGN[:, 1], np.array([1.0, 2.0, 4.0, 0.5, 1.0])),
        DESIGN[:, 1],
        {"x": DESIGN[:, :1]},
        np.diag([1.0, 4.0, 16.0, 0.25, 1.0]),
        "point",
    ),
    "gather": Idiom(
        lambda m: bmc.Normal(2 * m[GROUP_OF] + 1, 1.0),
        repeated(1.0, 5),
        {"m": 2 * PICK},
        np.eye(5),
        "point",
    ),
    "gather of a function": Idiom(
        lambda m, x: bmc.Normal((m * 0.5 - x)[GROUP_OF], 1.0),
        np.zeros(5),
        {"m": PICK / 2, "x": -np.ones((5, 1))},
        np.eye(5),
        "point",
    ),
    "gather of one": Idiom(lambda m: bmc.Normal(m[1], 1.0), [0.0], {"m": [[0, 1, 0]]}, [[1.0]]),
    "gather in two plates": Idiom(
        lambda g: bmc.Normal(g[GROUP_OF, GROUP_OF % 2], 1.0),
        np.zeros(5),
        {"g": np.eye(6)[GROUP_OF * 2 + GROUP_OF % 2]},
        np.eye(5),
        "point",
    ),
    "foreign sum": Idiom(
        lambda m: bmc.Normal(m.sum("group"), 1.0), [0.0], {"m": [[1.0, 1.0, 1.0]]}, [[1.0]]
    ),
    "weights and foreign sum": Idiom(
        lambda m: bmc.Normal((m.array * np.array([1.0, 0.0, -4.0])).sum(axis=-1), 1.0),
        [0.0],
        {"m": [[1.0, 0.0, -4.0]]},
        [[1.0]],
    ),
    "foreign mean of one plate": Idiom(
        lambda g: bmc.Normal(g.mean("row"), 1.0),
        np.zeros(3),
        {"g": np.kron(np.eye(3), [[0.5, 0.5]])},
        np.eye(3),
        "group",
    ),
    "transposed plates": Idiom(
        lambda g: bmc.Normal(4 * g, 1.0),
        np.zeros(6),
        {"g": 4 * np.eye(6)[np.arange(6).reshape(3, 2).T.ravel()]},
        np.eye(6),
        ("row", "group"),
    ),
    "a plate that a parent lacks": Idiom(
        lambda m, x: bmc.Normal(m + x, 1.0),
        np.zeros(6),
        {"m": np.kron(np.eye(3), np.ones((2, 1))), "x": np.ones((6, 1))},
        np.eye(6),
        ("group", "row"),
    ),
    "a component": Idiom(
        lambda v: bmc.Normal(v[..., 1] * 2, 1.0), [0.0], {"v": [[0.0, 2.0]]}, [[1.0]]
    ),
    "a matrix": Idiom(
        lambda v: bmc.MvNormal(np.matvec(A, v) + [1.0, 2.0], scale_tril=TRIL),
        [1.0, 2.0],
        {"v": A},
        TRIL @ TRIL.T,
    ),
    "a matrix by einsum": Idiom(
        lambda v: bmc.MvNormal(np.einsum("ij,...j->...i", A, v), np.eye(2)),
        [0.0, 0.0],
        {"v": A},
        np.eye(2),
    ),
    "a matrix by hand": Idiom(
        lambda v: bmc.MvNormal(
            bmc.stack([0.5 * v[..., 0] - 2 * v[..., 1], v[..., 0] + 0.25 * v[..., 1]]),
            scale_diag=[1.0, 2.0],
        ),
        [0.0, 0.0],
        {"v": A},
        np.diag([1.0, 4.0]),
    ),
    "a vector of scalars": Idiom(
        lambda x, z: bmc.MvNormal(bmc.stack([x, z, x - z, 1.0]), np.eye(4)),
        [0.0, 0.0, 0.0, 1.0],
        {"x": [[1.0], [0.0], [1.0], [0.0]], "z": [[0.0], [1.0], [-1.0], [0.0]]},
        np.eye(4),
    ),
    "running sums": Idiom(
        lambda v: bmc.MvNormal(np.cumsum(v, axis=-1), np.eye(2)),
        [0.0, 0.0],
        {"v": [[1.0, 0.0], [1.0, 1.0]]},
        np.eye(2),
    ),
    "a design matrix": Idiom(
        lambda v: bmc.Normal(np.vecdot(DESIGN, v), 1.0),
        np.zeros(5),
        {"v": DESIGN},
        np.eye(5),
        "point",
    ),
    "vectors in a plate": Idiom(
        lambda w: bmc.MvNormal(np.matvec(A, w), np.eye(2)),
        np.zeros(6),
        {"w": np.kron(np.eye(3), A)},
        np.eye(6),
        "group",
    ),
    "gathered vectors": Idiom(
        lambda w: bmc.Normal(np.vecdot(DESIGN, w[GROUP_OF]), 1.0),
        np.zeros(5),
        {"w": (PICK[:, :, None] * DESIGN[:, None, :]).reshape(5, 6)},
        np.eye(5),
        "point",
    ),
    "a component of foreign vectors": Idiom(
        lambda w: bmc.Normal(w[..., 0].sum("group"), 1.0),
        [0.0],
        {"w": [[1.0, 0.0, 1.0, 0.0, 1.0, 0.0]]},
        [[1.0]],
    ),
    "a choice by constants": Idiom(
        lambda x, z: bmc.Normal(np.where(GROUP_OF == 2, x, 2 * z), 1.0),
        np.zeros(5),
        {
            "x": (GROUP_OF == 2)[:, None] * 1.0,
            "z": (GROUP_OF != 2)[:, None] * 2.0,
        },
        np.eye(5),
        "point",
    ),
    "directly and through a sum": Idiom(
        lambda m, total: bmc.Normal(m - total / 4, 1.0),
        repeated(-0.25, 3),
        {"m": np.eye(3) - 0.25},
        np.eye(3),
        "group",
    ),
    "through two functions": Idiom(
        lambda scaled: bmc.Normal(scaled[GROUP_OF] + 1, 1.0),
        repeated(0.0, 5),
        {"m": 2 * PICK - 0.5},
        np.eye(5),
        "point",
    ),
}


@pytest.mark.parametrize("what", IDIOMS)
def test_what_is_read_is_what_was_written(what: str) -> None:
    idiom = IDIOMS[what]
    net = base()
    net.add("total", lambda m: m.sum("group") + 1)
    net.add("scaled", lambda m, total: 2 * m - total / 2 - 0.5, plates="group")
    net.add("y", idiom.function, plates=idiom.plates)
    part = read(net)
    offset, gains, cov = laid_out(net, part, "y")
    np.testing.assert_array_equal(offset, idiom.offset)
    assert set(gains) == set(idiom.gains)
    for parent, wanted in idiom.gains.items():
        np.testing.assert_array_equal(gains[parent], wanted)
    np.testing.assert_array_equal(cov, idiom.cov)
    for block in part.dims:  # roots have their own blocks, each once
        assert sum(c.block == block for c in part.conditionals) == 1
    assert not part.likelihoods
    assert not part.invalid


def test_structure_is_no_denser_than_the_function() -> None:
    """Elements that an element does not vary with are no parents of it."""
    net = base()
    net.add("y", lambda m: bmc.Normal(m[GROUP_OF], 1.0), plates="point")
    given = {c.block: c.parents for c in read(net).conditionals}
    for e, group in enumerate(GROUP_OF.tolist()):
        assert given[("y", e)] == (("m", group),)


def test_computed_nodes_are_read_too() -> None:
    net = base()
    net.add("total", lambda m, x: 2 * m.sum("group") - x + 0.5)
    net.add("pair", lambda x, z: bmc.stack([x + z, z]))
    net.add("far", lambda total: 2 * total, plates="row")
    part = read(net)
    offset, gains, cov = laid_out(net, part, "total")
    assert offset.tolist() == [0.5]
    assert gains["m"].tolist() == [[2.0, 2.0, 2.0]]
    assert gains["x"].tolist() == [[-1.0]]
    assert not cov.any()
    _, gains, _ = laid_out(net, part, "pair")
    assert gains["x"].tolist() == [[1.0], [0.0]]
    offset, gains, _ = laid_out(net, part, "far")
    assert offset.tolist() == [1.0, 1.0]
    assert gains["m"].tolist() == [[4.0] * 3] * 2


# ---- what is known --------------------------------------------------------------------------------


def test_inputs_are_numbers() -> None:
    net = base()
    net.input("u", plates="point")
    net.add("y", lambda u, x: bmc.Normal(u * x + u**2, np.abs(u) + 1), plates="point")
    u = np.array([0.0, 1.0, -2.0, 4.0, 0.5])
    offset, gains, cov = laid_out(net, read(net, inputs={"u": u}), "y")
    np.testing.assert_array_equal(offset, u**2)
    np.testing.assert_array_equal(gains["x"], u[:, None])
    np.testing.assert_array_equal(np.diagonal(cov), (np.abs(u) + 1) ** 2)


def test_do_makes_numbers() -> None:
    net = base()
    net.add("y", lambda x, z: bmc.Normal(x * z + z, np.exp2(z)))
    cut = net.do(z=3.0)
    offset, gains, cov = laid_out(cut, read(cut), "y")
    assert (offset.tolist(), gains["x"].tolist(), cov.tolist()) == ([3.0], [[3.0]], [[64.0]])
    assert set(gains) == {"x"}


def test_seen_parents_are_numbers() -> None:
    net = base()
    net.add("y", lambda x, z: bmc.Normal(x * z**2, np.abs(z)))
    part = read(net, {"z": -2.0})
    offset, gains, cov = laid_out(net, part, "y")
    assert (offset.tolist(), gains["x"].tolist(), cov.tolist()) == ([0.0], [[4.0]], [[4.0]])
    assert ("z", 0) not in part.dims


def test_plates_seen_in_part() -> None:
    """Seen elements move into the offset; hidden ones stay parents."""
    net = base()
    net.add("y", lambda m: bmc.Normal(2 * m[GROUP_OF] + 1, 1.0), plates="point")
    net.add("all", lambda m: bmc.Normal(m.sum("group"), 1.0))
    part = read(net, {"m": [np.nan, 8.0, np.nan], "y": [1.0, np.nan, 3.0, 4.0, np.nan]})
    hidden = {c.block: (c.parents, c.offset.tolist()) for c in part.conditionals}
    assert {b for b in hidden if b[0] == "m"} == {("m", 0), ("m", 2)}  # type: ignore[index]
    assert hidden[("y", 1)] == ((("m", 0),), [1.0])
    assert hidden[("y", 4)] == ((("m", 2),), [1.0])
    assert hidden[("all", 0)] == ((("m", 0), ("m", 2)), [8.0])
    assert {f.blocks for f in part.likelihoods} == {(("m", 2),), (("m", 0),)}
    # what is seen and depends on nothing hidden is a number: y[3] = 4 given 2 * 8 + 1, and m[1] = 8
    constants = sum(float(table.values) for scope, table in part.tables if scope == ())
    assert constants == pytest.approx(-np.log(2 * np.pi) - 0.5 * (13.0**2 + 8.0**2))


def test_likelihoods_are_sums_of_squares() -> None:
    """Observed elements that depend on the same blocks make one factor: compare what it says of x."""
    rng = np.random.default_rng(0)
    net = bmc.BayesNet(plates={"point": 40})
    design = rng.integers(0, 3, size=(40, 2)).astype(float)
    net.add("v", bmc.MvNormal(np.zeros(2), np.eye(2)))
    net.add("y", lambda v: bmc.Normal(np.vecdot(design, v) + 1, 0.5), plates="point")
    seen = rng.normal(size=40)
    part = read(net, {"y": seen})
    for x in rng.normal(size=(5, 2)):
        residual = (seen - design @ x - 1) / 0.5
        wanted = -0.5 * (residual**2).sum() - 40 * np.log(0.5 * np.sqrt(2 * np.pi))
        found = sum(
            float(f.log_scale) - 0.5 * ((f.rows @ [*x, -1.0]) ** 2).sum() for f in part.likelihoods
        )
        found += sum(float(table.values) for _, table in part.tables)
        assert found == pytest.approx(wanted, rel=1e-12)
    assert all(f.rows.shape[-2] <= 2 for f in part.likelihoods)


# ---- switches -------------------------------------------------------------------------------------


def test_discrete_parents_switch_everything() -> None:
    net = bmc.BayesNet(plates=PLATES)
    net.add("s", bmc.Categorical([0.5, 0.25, 0.25]))
    net.add("t", bmc.Bernoulli(0.5), states=("no", "yes"))
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda s, t, x: bmc.Normal(np.where(t == "yes", s * x, 4 - x), 2.0**s))
    given = next(c for c in read(net).conditionals if c.block == ("y", 0))
    assert given.scope == (("s", 0), ("t", 0))
    np.testing.assert_array_equal(given.gain[..., 0, 0], [[-1, 0], [-1, 1], [-1, 2]])
    np.testing.assert_array_equal(given.offset[..., 0], [[4, 0]] * 3)
    roots = np.broadcast_to(given.root[..., 0, 0], (3, 2))
    np.testing.assert_array_equal(roots, np.broadcast_to([[1.0], [2.0], [4.0]], (3, 2)))


def test_seen_switches_have_no_axis() -> None:
    net = bmc.BayesNet(plates=PLATES)
    net.add("s", bmc.Categorical([0.5, 0.25, 0.25]), plates="point")
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda s, x: bmc.Normal(s * x, 1.0), plates="point")
    part = read(net, {"s": [2, None, 1, None, 0]})
    given = {c.block: c for c in part.conditionals}
    assert [given[("y", e)].scope for e in range(5)] == [(), (("s", 1),), (), (("s", 3),), ()]
    assert given[("y", 0)].gain.tolist() == [[2.0]]
    assert given[("y", 3)].gain[..., 0, 0].tolist() == [0.0, 1.0, 2.0]
    assert not given[("y", 4)].gain.any()


def test_switches_without_effect_have_no_axis() -> None:
    net = bmc.BayesNet()
    net.add("s", bmc.Bernoulli(0.5))
    net.add("x", lambda s: bmc.Normal(0 * s, 1.0))
    (given,) = read(net).conditionals
    assert given.scope == ()


def test_gathers_by_hidden_labels() -> None:
    """Every group may be meant, and each label switches its own element alone."""
    net = base()
    net.add("label", bmc.Categorical([0.25, 0.25, 0.5]), plates="point")
    net.add("y", lambda m, label: bmc.Normal(2 * m[label], 1.0), plates="point")
    for c in read(net).conditionals:
        name, e = c.block  # type: ignore[misc]
        if name == "y":
            assert c.scope == (("label", e),)
            assert c.parents == (("m", 0), ("m", 1), ("m", 2))
            np.testing.assert_array_equal(c.gain[:, 0], 2 * np.eye(3))


def test_whole_plates_of_switches() -> None:
    net = bmc.BayesNet(plates={"row": 3})
    net.add("s", bmc.Bernoulli(0.5), plates="row")
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda s, x: bmc.Normal(s.sum("row") * x, 1.0))
    given = next(c for c in read(net).conditionals if c.block == ("y", 0))
    assert given.scope == (("s", 0), ("s", 1), ("s", 2))
    np.testing.assert_array_equal(given.gain[..., 0, 0], np.indices((2, 2, 2)).sum(axis=0))


def test_bad_parameters_are_kept_for_later() -> None:
    net = bmc.BayesNet()
    net.add("s", bmc.Categorical([0.5, 0.5, 0.0]))
    net.add("x", lambda s: bmc.Normal(0.0, np.array([1.0, 2.0, -1.0])[s]))
    part = read(net)
    ((name, element, scope, mask),) = part.invalid
    assert (name, element, scope, mask.tolist()) == ("x", 0, (("s", 0),), [False, False, True])


def test_a_function_of_too_many_switches_is_refused() -> None:
    net = bmc.BayesNet(plates={"row": 40})
    net.add("s", bmc.Bernoulli(0.5), plates="row")
    net.add("x", lambda s: bmc.Normal(s.sum("row"), 1.0))
    problem = pose(net, {})
    with pytest.raises(BudgetError, match="'x'"):
        linear_gaussian(problem.model, problem.observed, problem.inputs)


# ---- numbers that are hard ------------------------------------------------------------------------


@pytest.mark.parametrize("offset", [1e3, 1e6, 1e9, 1e12, -1e12])
@pytest.mark.parametrize("spread", [1e-3, 1.0, 1e3])
def test_large_offsets_spoil_no_more_than_rounding(offset: float, spread: float) -> None:
    """One evaluation rounds to ``eps * offset``; a difference over one step cannot know better."""
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, spread))
    net.add("y", lambda x: bmc.Normal(offset + 0.7 * x, 1.0))
    found, gains, _ = laid_out(net, read(net), "y")
    assert found[0] == offset
    rounding = np.finfo(float).eps * abs(offset) / spread
    assert gains["x"][0, 0] == pytest.approx(0.7, abs=32 * rounding + 1e-14)


@pytest.mark.parametrize("scale", [1e-200, 1e-30, 1e-8, 1e8, 1e30, 1e200])
def test_extreme_units(scale: float) -> None:
    """Steps are of the parent's own size, so that no unit is special."""
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, scale))
    net.add("y", lambda x: bmc.Normal(x / scale + 1, 1.0))
    offset, gains, _ = laid_out(net, read(net), "y")
    assert offset.tolist() == [1.0]
    assert gains["x"][0, 0] * scale == pytest.approx(1.0, rel=1e-12)


def test_unlike_components_have_steps_of_their_own() -> None:
    units = np.array([1e-12, 1.0, 1e12])
    net = bmc.BayesNet()
    net.add("v", bmc.MvNormal(np.zeros(3), scale_diag=units))
    net.add("y", lambda v: bmc.Normal((v / units).sum(axis=-1), 1.0))
    _, gains, _ = laid_out(net, read(net), "y")
    np.testing.assert_allclose(gains["v"][0] * units, 1.0, rtol=1e-12)


# ---- functions that lie ---------------------------------------------------------------------------


def lying_by_type(x: Any) -> Any:
    return x**2 if isinstance(x, np.ndarray) else x


def lying_by_attribute(x: Any) -> Any:
    return 2 * x if hasattr(x, "sources") else np.abs(x)


def lying_by_exception(x: Any) -> Any:
    """Refused a look at the numbers, it pretends that there is nothing to see."""
    try:
        known = np.asarray(x)
    except TypeError:
        return x
    return np.where(known > 0, x, 0.0)


def lying_by_copy(x: Any) -> Any:
    """Cubed behind the tracer's back."""
    try:
        bend = np.asarray(x) ** 3
    except TypeError:
        bend = 0.0
    return x + bend


def lying_by_method(x: Any) -> Any:
    """An array has ``max``; what stands for one has not."""
    return x * (1.0 if not hasattr(x, "max") else np.where(x > 0.5, 3.0, 1.0))


LIES = [lying_by_type, lying_by_attribute, lying_by_exception, lying_by_copy, lying_by_method]


@pytest.mark.parametrize("lie", LIES)
@pytest.mark.parametrize("plates", [(), "group"])
def test_what_is_another_function_of_numbers_is_refused(lie: Any, plates: Any) -> None:
    """Who reads the function is told a tale; what it gives for numbers disagrees with that."""
    net = bmc.BayesNet(plates=PLATES)
    net.add("x", bmc.Normal(0.0, 1.0), plates=plates)
    net.add("y", lambda x: bmc.Normal(lie(x), 1.0), plates=plates)
    problem = pose(net, {})
    reason = why_not_linear(problem.model, problem.observed, problem.inputs)
    assert reason is not None
    for word in ("'y'", "'x'"):
        assert word in reason


def test_a_lie_about_foreign_elements_is_noticed() -> None:
    net = bmc.BayesNet(plates=PLATES)
    net.add("m", bmc.Normal(0.0, 1.0), plates="group")
    net.add("y", lambda m: bmc.Normal(lying_by_type(m.array).sum(axis=-1), 1.0))
    problem = pose(net, {})
    reason = why_not_linear(problem.model, problem.observed, problem.inputs)
    assert reason is not None
    assert "'y'" in reason


def test_honest_functions_pass_the_same_check() -> None:
    """Negative control: of the same make, but without the lie."""
    for function in (lambda x: 2 * x, lambda x: x if isinstance(x, np.ndarray) else 1 * x):
        net = bmc.BayesNet()
        net.add("x", bmc.Normal(0.0, 1.0))
        net.add("y", lambda x, function=function: bmc.Normal(function(x), 1.0))
        read(net)


# ---- reasons --------------------------------------------------------------------------------------

REASONS: dict[str, tuple[Callable[..., Any], tuple[str, ...]]] = {
    "a power": (lambda x: bmc.Normal(x**2, 1.0), ("'y'", "'x'", "np.power")),
    "an exponential": (lambda x, z: bmc.Normal(z + np.exp(x), 1.0), ("'y'", "'x'", "np.exp")),
    "a product": (lambda x, z: bmc.Normal(x * z, 1.0), ("'y'", "'x'", "'z'", "np.multiply")),
    "a quotient": (lambda x: bmc.Normal(1 / (x + 9), 1.0), ("'y'", "'x'", "np.divide")),
    "a branch": (lambda x: bmc.Normal(np.where(x > 0, x, 0.0), 1.0), ("'y'", "'x'", "np.greater")),
    "a maximum": (lambda m: bmc.Normal(m.max("group"), 1.0), ("'y'", "'m'", "np.max")),
    "a scale": (lambda x: bmc.Normal(0.0, 1 + x**2), ("'y'", "'x'", "scale")),
    "a covariance": (
        lambda x: bmc.MvNormal([0.0, 0.0], scale_diag=bmc.stack([1 + x**2, 1.0])),
        ("'y'", "'x'", "scale_diag"),
    ),
    "another family": (lambda x: bmc.Laplace(x, 1.0), ("'y'", "Laplace")),
    "a family of families": (
        lambda x: bmc.Mixture([0.5, 0.5], bmc.Normal(bmc.stack([x, -x]), 1.0)),
        ("'y'", "Mixture"),
    ),
    "a discrete child": (lambda x: bmc.Bernoulli(1 / (1 + np.exp(-x))), ("'y'", "'x'", "discrete")),
    "a look at the numbers": (
        lambda x: bmc.Normal(np.vectorize(lambda v: 2.0 * v)(x), 1.0),
        ("'y'", "'x'", "only NumPy operations"),
    ),
    "a function of no use": (
        lambda bent: bmc.Normal(bent, 1.0),
        ("'y'", "'x'", "np.sin", "'bent'"),
    ),
}


@pytest.mark.parametrize("what", REASONS)
def test_reasons_name_node_parent_and_operation(what: str) -> None:
    function, wanted = REASONS[what]
    net = base()
    net.add("bent", lambda x: np.sin(x))
    net.add("y", function)
    problem = pose(net, {})
    reason = why_not_linear(problem.model, problem.observed, problem.inputs)
    assert reason is not None
    for word in wanted:
        assert word in reason, reason


def test_reasons_do_not_outlive_the_evidence() -> None:
    net = base()
    net.add("y", lambda x, z: bmc.Normal(x * z, 1.0))
    for evidence, refused in (({}, True), ({"x": 1.0}, False), ({"z": 1.0}, False), ({}, True)):
        problem = pose(net, evidence)
        reason = why_not_linear(problem.model, problem.observed, problem.inputs)
        assert (reason is not None) == refused


def test_vectorized_functions_are_unknown() -> None:
    net = base()
    net.add("y", bmc.Normal(0.0, 1.0))

    @net.node(vectorize=True, name="k")
    def _k(x):
        return bmc.Normal(2 * x, 1.0)

    problem = pose(net, {})
    reason = why_not_linear(problem.model, problem.observed, problem.inputs)
    assert reason is not None
    assert "'k'" in reason


# ---- size -----------------------------------------------------------------------------------------


def test_many_observations_are_read_in_groups() -> None:
    """A hundred thousand elements of fifty groups make fifty factors of one row each, within seconds."""
    count, groups = 100_000, 50
    rng = np.random.default_rng(0)
    group_of = rng.integers(groups, size=count)
    net = bmc.BayesNet(plates={"group": groups, "point": count})
    net.add("m", bmc.Normal(0.0, 1.0), plates="group")
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda m: bmc.Normal(m[group_of], 1.0), plates="point")
    problem = pose(net, {"y": rng.normal(size=count)})
    part = linear_gaussian(problem.model, problem.observed, problem.inputs)
    assert len(part.likelihoods) == groups
    assert all(f.rows.shape == (1, 2) for f in part.likelihoods)


def test_many_observations_of_one_parent() -> None:
    count = 100_000
    net = bmc.BayesNet(plates={"point": count})
    net.add("v", bmc.MvNormal(np.zeros(3), np.eye(3)))
    design = np.random.default_rng(1).normal(size=(count, 3))
    net.add("y", lambda v: bmc.Normal(np.vecdot(design, v), 1.0), plates="point")
    problem = pose(net, {"y": design.sum(axis=1)})
    (factor,) = linear_gaussian(problem.model, problem.observed, problem.inputs).likelihoods
    a, z = factor.rows[:, :-1], factor.rows[:, -1]
    np.testing.assert_allclose(a.T @ a, design.T @ design, rtol=1e-10)
    np.testing.assert_allclose(np.linalg.solve(a, z), np.ones(3), rtol=1e-10)


def test_a_net_error_is_still_a_net_error() -> None:
    """Reading evaluates impossible configurations; what fails there is the library's kind of error."""
    net = bmc.BayesNet()
    net.add("s", bmc.Bernoulli(0.0))
    net.add("x", lambda s: bmc.Normal(0.0, 1.0 - 2.0 * s))
    problem = pose(net, {})
    try:
        part = linear_gaussian(problem.model, problem.observed, problem.inputs)
    except BayesmcError:
        return
    assert [mask.tolist() for *_, mask in part.invalid] == [[False, True]]
