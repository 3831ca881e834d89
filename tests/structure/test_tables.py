"""Which finite nodes a function reads, and all their configurations as batch axes."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.network import pose
from bayesmc.structure.tables import Reads, configurations, configure, reads_of


def net() -> bmc.BayesNet:
    found = bmc.BayesNet(plates={"i": 2, "j": 3})
    found.add("a", bmc.Categorical([0.2, 0.3, 0.5]))
    found.add("k", bmc.Bernoulli(0.5), plates="i")
    found.add("m", bmc.Normal(0.0, 1.0), plates="j")
    found.add("n", bmc.Normal(0.0, 1.0))
    found.add("level", lambda k, a, n: 1.0 * k + 0.1 * a + n, plates="i")
    found.add("total", lambda level: level.sum("i"))
    found.add("even", lambda a: (a % 2 == 0) * 1, states=(0, 1))
    found.add("own", lambda level, even: bmc.Normal(level + even, 1.0), plates="i")
    found.add("all", lambda total, m: bmc.Normal(total + m, 1.0), plates="j")
    return found


@pytest.mark.parametrize(
    ("name", "known", "through", "expected"),
    [
        ("own", ("n",), False, Reads(("k", "a", "even"), (), ())),
        ("own", (), True, Reads(("k", "a"), (), ("n",))),
        ("own", ("level",), True, Reads(("a",), (), ())),
        ("all", ("n",), False, Reads((), ("k", "a"), ("m",))),
        ("all", ("k", "m", "n"), False, Reads((), ("a",), ())),
    ],
)
def test_what_stands_above(name, known, through, expected):
    """A node reached through another's plates counts as read whole: nothing tells which elements meet."""
    model = pose(net(), {}).model
    node = model[name]
    assert reads_of(model, node.parents, node.plates, known.__contains__, through) == expected


def test_every_configuration_stands_once():
    model = pose(net(), {}).model
    values, sizes = configure(model, {"n": np.asarray(5.0)}, ["a"], ["k"], ["level"])
    assert sizes == (3, 2, 2)
    level = np.broadcast_to(values["level"], (*sizes, 2))
    for a, first, second in itertools.product(range(3), range(2), range(2)):
        expected = 5.0 + np.array([first, second]) + 0.1 * a
        np.testing.assert_allclose(level[a, first, second], expected)


def test_plates_apart_share_an_axis():
    model = pose(net(), {}).model
    (a, k), sizes = configurations([model["a"]], [model["k"]], apart=["i"], ahead=1)
    assert sizes == (3, 2) and a.shape == (1, 3, 1) and k.shape == (1, 1, 2, 2)
    assert (k[0, 0] == [[0, 0], [1, 1]]).all()
