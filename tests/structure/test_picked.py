"""The one element that a density reads: found for any value of what picks it, or not claimed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.expression import Program
from bayesmc.network import pose
from bayesmc.structure.picked import picked_element


def scene() -> bmc.BayesNet:
    """Maps on a line, on a grid and of two robots, and who looks at them."""
    net = bmc.BayesNet(plates={"cell": 5, "row": 4, "col": 3, "beam": 2, "robot": 2})
    net.add("color", bmc.Bernoulli(0.5), plates="cell")
    net.add("wall", bmc.Bernoulli(0.5), plates="cell")
    net.add("level", bmc.Normal(0.0, 1.0), plates="cell")
    net.add(
        "floor", bmc.Categorical([0.2, 0.3, 0.5]), plates=("row", "col"), states=("a", "b", "c")
    )
    net.add("own", bmc.Bernoulli(0.5), plates=("robot", "cell"))
    net.add("i", bmc.DiscreteUniform(0, 3))
    net.add("j", bmc.DiscreteUniform(0, 2))
    net.add("k", bmc.DiscreteUniform(0, 4), plates="robot")
    return net


@pytest.mark.parametrize(
    ("function", "plates", "sources", "wanted"),
    [
        (lambda color, i: bmc.Normal(color[i], 1.0), (), ["color"], lambda i, j, k: i),
        (lambda level, i: bmc.Normal(2.0, np.exp(level[(i + 3) % 5])), (), ["level"],
         lambda i, j, k: (i + 3) % 5),
        (lambda floor, i, j: bmc.Bernoulli(np.where(floor[i, j] == "b", 0.1, 0.7)), (), ["floor"],
         lambda i, j, k: 3 * i + j),
        (lambda color, i: bmc.Normal(color[(i + np.arange(2)) % 5], 1.0), "beam", ["color"],
         lambda i, j, k: (i[:, None] + np.arange(2)) % 5),
        (lambda own, k: bmc.Normal(own[k], 1.0), "robot", ["own"], lambda i, j, k: 5 * np.arange(2) + k),
        (lambda color, wall, i: bmc.Normal(color[i] * wall[i], 1.0), (), ["color", "wall"],
         lambda i, j, k: i),
        (lambda color, wall, i, j: bmc.Normal(color[i] * wall[j], 1.0), (), ["color", "wall"], None),
        (lambda color, i: bmc.Normal(color[i] + color[0], 1.0), (), ["color"], None),
        (lambda color, i: bmc.Normal(color.sum("cell") + i, 1.0), (), ["color"], None),
        (lambda color, i: bmc.Normal(np.where(i > 1, color[i], color[0]), 1.0), (), ["color"], None),
        (lambda color, wall, i: bmc.Normal(color[wall[i]], 1.0), (), ["color", "wall"], None),
    ],
)  # fmt: skip
def test_elements_are_those_that_are_read(
    function: Any, plates: Any, sources: list[str], wanted: Any
) -> None:
    net = scene()
    net.add("y", function, plates=plates)
    model = pose(net, {}).model
    at = picked_element(model, "y", sources)
    assert (at is None) == (wanted is None)
    if at is None:
        return
    rng = np.random.default_rng(0)
    values = {
        "i": rng.integers(0, 4, 20),
        "j": rng.integers(0, 3, 20),
        "k": rng.integers(0, 5, (20, 2)),
    }
    (found,) = Program([at])({n: values[n] for n in at.leaves})
    assert np.array_equal(found, wanted(**values))
    # and it is true: other elements may be anything
    stored = {n: rng.integers(0, model[n].domain.size, (20, *model[n].value_shape))
              for n in ("color", "wall", "floor", "own")}  # fmt: skip
    stored |= {**values, "level": rng.normal(size=(20, 5))}
    y = np.zeros(model["y"].value_shape, dtype=int)
    right = model.log_density("y", model.evaluate("y", stored)[0], y)
    for name in sources:
        flat = stored[name].reshape(20, -1)
        other = flat[:, ::-1].copy() if name == "level" else (model[name].domain.size - 1 - flat)
        read = np.zeros(flat.shape, dtype=bool)
        np.put_along_axis(read, np.asarray(found).reshape(20, -1), True, 1)
        stored[name] = np.where(read, flat, other).reshape(stored[name].shape)
    assert np.array_equal(model.log_density("y", model.evaluate("y", stored)[0], y), right)


def test_what_cannot_be_followed_is_not_claimed() -> None:
    net = scene()

    def branch(color: Any, i: Any) -> Any:
        return bmc.Normal(color[i] if np.asarray(i).reshape(-1)[0] > 1 else color[i], 1.0)

    net.add("y", branch)
    assert picked_element(pose(net, {}).model, "y", ["color"]) is None
