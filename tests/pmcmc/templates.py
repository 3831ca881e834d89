"""Templates with an exact answer, one for each thing that particles must get right."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import bayesmc as bmc

NAN = np.nan


@dataclass(frozen=True)
class Case:
    """A template with its data, and how many particles show what is wrong."""

    dbn: bmc.DynamicBayesNet
    observations: dict[str, Any]
    inputs: dict[str, Any] = field(default_factory=dict)
    particles: int = 5


def gaussian() -> Case:
    """A missing row, and a transition that reads the time."""
    dbn = bmc.DynamicBayesNet()
    start = bmc.Normal(0.0, 1.0)
    dbn.add("x", lambda x_prev, t: bmc.Normal(0.9 * x_prev + 0.1 * t, 0.7), initial=start)
    dbn.add("y", lambda x: bmc.Normal(x, 0.6))
    return Case(dbn, {"y": [0.5, 1.5, NAN, 2.5, 0.3, 1.0]})


def markov() -> Case:
    """A hidden Markov model with labels, so that all steps are tables."""
    dbn = bmc.DynamicBayesNet()
    rows = [[0.7, 0.2, 0.1], [0.1, 0.8, 0.1], [0.3, 0.3, 0.4]]
    dbn.table("z", ["z_prev"], rows, ("a", "b", "c"), initial=[0.5, 0.3, 0.2])
    dbn.table("o", ["z"], [[0.7, 0.3], [0.4, 0.6], [0.1, 0.9]], ("no", "yes"))
    return Case(dbn, {"o": ["no", "yes", "yes", None, "no", "yes"]})


def switching() -> Case:
    """Discrete and continuous, an input, a deterministic node, and an observation that reads the last one."""
    dbn = bmc.DynamicBayesNet()
    dbn.input("u")
    dbn.table("s", ["s_prev"], [[0.8, 0.2], [0.3, 0.7]], initial=[0.6, 0.4])

    def x(x_prev, s, u):
        return bmc.Normal(np.where(s == 1, 0.3, 0.95) * x_prev + u, np.where(s == 1, 1.5, 0.5))

    dbn.add("x", x, initial=bmc.Normal(0.0, 1.0))
    dbn.add("m", lambda x, u: x + 2.0 * u)
    dbn.add(
        "y",
        lambda m, y_prev: bmc.Normal(m + 0.3 * y_prev, 0.5),
        initial=lambda m: bmc.Normal(m, 0.5),
    )
    inputs = {"u": [0.1, 0.5, -0.3, 0.2, 0.0]}
    return Case(dbn, {"y": [0.5, 1.5, 2.0, 2.5, -1.0]}, inputs)


def sequences() -> Case:
    """Independent sequences in a plate, partly seen, whose observations are read by the next slice."""
    dbn = bmc.DynamicBayesNet(plates={"i": 3})
    start = bmc.Normal(0.0, 1.0)
    dbn.add("x", lambda x_prev: bmc.Normal(0.8 * x_prev, 0.7), initial=start, plates="i")
    dbn.add(
        "y",
        lambda x, y_prev: bmc.Normal(x + 0.5 * y_prev, 0.6),
        initial=lambda x: bmc.Normal(x, 0.6),
        plates="i",
    )
    rows = [[0.5, 1.5, -1.0], [NAN, 2.0, 0.0], [NAN, NAN, 1.0], [NAN] * 3, [1.0, -1.0, 0.0]]
    return Case(dbn, {"y": rows})


def meeting() -> Case:
    """Sequences that share a hidden node, so that they have their weights in common."""
    dbn = bmc.DynamicBayesNet(plates={"i": 2})
    start = bmc.Normal(0.0, 1.0)
    dbn.add("g", lambda g_prev: bmc.Normal(0.8 * g_prev, 0.7), initial=start)
    dbn.add("x", lambda x_prev, g: bmc.Normal(0.5 * x_prev + g, 0.7), initial=start, plates="i")
    dbn.add("y", lambda x: bmc.Normal(x, 0.6), plates="i")
    return Case(dbn, {"y": [[0.5, 1.5], [NAN, 2.0], [0.3, NAN], [1.0, -1.0]]})


def carried() -> Case:
    """A running sum: what comes after a slice depends on all slices before."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("v", bmc.Normal(0.0, 1.0))
    dbn.add("p", lambda p_prev, v: p_prev + v, initial=lambda v: v)
    dbn.add("y", lambda p: bmc.Normal(p, 0.7))
    return Case(dbn, {"y": [0.5, 1.5, 2.0, 2.5]}, particles=3)


def gaps() -> Case:
    """Observations of the slice before, a state that is seen once, and rows missing at the end."""
    dbn = bmc.DynamicBayesNet()
    start = bmc.Normal(0.0, 1.0)
    dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 0.7), initial=start)
    dbn.add("y", lambda x_prev: bmc.Normal(x_prev, 0.6), initial=start)
    x = [NAN, NAN, 0.4, NAN, NAN, NAN, NAN]
    return Case(dbn, {"y": [0.5, 1.5, 0.7, NAN, 0.3, NAN, NAN], "x": x})


def static() -> Case:
    """Static nodes of every kind: looked up, conjugate, discrete, computed."""
    dbn = bmc.DynamicBayesNet(plates={"k": 2})
    dbn.add_static("mu", bmc.Normal(0.0, 2.0), plates="k")
    dbn.add_static("bias", bmc.Normal(0.0, 1.0))
    dbn.add_static("rich", bmc.Bernoulli(0.4))
    dbn.add_static("gain", lambda bias: 0.5 * bias - 0.2)
    dbn.table("z", ["z_prev"], [[0.7, 0.3], [0.2, 0.8]], initial=[0.5, 0.5])
    start = bmc.Normal(0.0, 1.0)
    dbn.add("x", lambda x_prev, bias: bmc.Normal(0.8 * x_prev + bias, 0.5), initial=start)
    dbn.add("y", lambda z, mu, x, gain, rich: bmc.Normal(mu[z] + x + gain + rich, 0.6))
    return Case(dbn, {"y": [0.5, 1.5, -2.0, NAN, 0.3]})


def loaded() -> Case:
    """A hidden Markov model whose emissions are coins of unknown bias, one of two for each state."""
    dbn = bmc.DynamicBayesNet(plates={"k": 2})
    dbn.add_static("fair", bmc.Bernoulli(0.7), plates="k")
    dbn.table("z", ["z_prev"], [[0.8, 0.2], [0.3, 0.7]], initial=[0.5, 0.5])
    dbn.add("o", lambda z, fair: bmc.Bernoulli(np.where(fair[z] == 1, 0.5, 0.9)))
    return Case(dbn, {"o": [1, 1, 0, 1, None, 1, 1]})


def static_sequences() -> Case:
    """Sequences with a static node each, one of which is seen."""
    dbn = bmc.DynamicBayesNet(plates={"i": 3})
    dbn.add_static("a", bmc.Normal(0.0, 1.0), plates="i")
    start = bmc.Normal(0.0, 1.0)
    dbn.add("x", lambda x_prev, a: bmc.Normal(0.8 * x_prev + a, 0.5), initial=start, plates="i")
    dbn.add("y", lambda x: bmc.Normal(x, 0.6), plates="i")
    rows = [[0.5, 1.5, -2.0], [0.3, NAN, 0.3], [0.0, 1.0, NAN]]
    return Case(dbn, {"y": rows, "a": [NAN, 0.3, NAN]})


CASES: tuple[Callable[[], Case], ...] = (
    gaussian,
    markov,
    switching,
    sequences,
    meeting,
    carried,
    gaps,
    static,
    loaded,
    static_sequences,
)
