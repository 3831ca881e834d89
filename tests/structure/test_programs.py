"""Expressions of like terms as one program give what they give one by one, with other data, too."""

from __future__ import annotations

from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.expression import elementwise, leaf
from bayesmc.network import pose
from bayesmc.passes.templates import stacked
from bayesmc.structure.programs import StateProgram
from bayesmc.structure.target import Target, Values, target_of

CHAINS, SLICES = 3, 6


def posed() -> tuple[Target, StateProgram, Values]:
    rng = np.random.default_rng(0)
    net = bmc.BayesNet(plates={"k": 2})
    net.add("level", bmc.Normal(0.0, 1.0))
    evidence: dict[str, Any] = {}
    for t in range(SLICES):
        net.add(f"x[{t}]", bmc.Normal(0.0, 1.0), plates="k")
        net.add(
            f"y[{t}]",
            lambda x, level, c=t / 3: bmc.Normal(level + c * x, 1.0),
            parents=[f"x[{t}]", "level"],
            plates="k",
        )
        evidence[f"y[{t}]"] = rng.normal(size=2)
    target = target_of(pose(net, evidence))
    roots = [target.terms[f"y[{t}]"].expression for t in range(SLICES)]
    made = stacked([r for r in roots if r is not None])
    assert made is not None
    program = StateProgram(target, [made.root], made.leaves, made.constants)
    values = dict(target.known)
    for name in target.chain:
        values[name] = rng.normal(size=(CHAINS, *target.model[name].value_shape))
    return target, program, values


def apart(target: Target, values: Values) -> np.ndarray:
    found = [target.terms[f"y[{t}]"].log(values) for t in range(SLICES)]
    return np.stack(found, axis=1)


def test_members_together_are_members_apart() -> None:
    target, program, values = posed()
    for _ in range(2):  # the second time what is known is not gathered again
        (found,) = program(values, program.are_known(values))
        np.testing.assert_allclose(found, apart(target, values), rtol=1e-12)


def test_data_that_are_replaced_are_noticed() -> None:
    target, program, values = posed()
    (before,) = program(values, program.are_known(values))
    other = {**values, "y[2]": values["y[2]"] + 1.0}
    assert program.are_known(values)
    assert not program.are_known(other)
    (found,) = program(other, program.are_known(other))
    np.testing.assert_allclose(found, apart(target, other), rtol=1e-12)
    assert np.abs(found - before)[:, 2].min() > 1e-3  # the control
    (again,) = program(values, program.are_known(values))
    np.testing.assert_array_equal(again, before)


def test_what_follows_from_the_data_alone_is_known() -> None:
    target, _, _ = posed()
    seen = leaf("y[0]", (2,))
    twice = elementwise(np.multiply, seen, 2.0)
    mixed = elementwise(np.add, twice, leaf("level", ()))
    program = StateProgram(target, [mixed, twice], [("y[0]", "level")], {})
    assert [program.is_known(r) for r in (mixed, twice)] == [False, True]
    unknown, found = program.known()
    assert unknown is None
    np.testing.assert_array_equal(found, 2 * target.known["y[0]"])
