"""Modules of the library in which code runs during one call."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

import numpy as np

import bayesmc as bmc
from tests.counts.lines import PACKAGE

#: most modules that a call may run in
BARS = {"infer(mixture, engine=Gibbs())": 40, "filter(benchmark, engine=ParticleFilter())": 20}


def modules_of(call: Callable[[], Any]) -> list[str]:
    """Paths of the modules, below the package, whose functions run during a call."""
    found: set[str] = set()

    def note(frame: FrameType, event: str, argument: Any) -> None:
        if event == "call":
            found.add(frame.f_code.co_filename)

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of few draws
            call()
    finally:
        sys.setprofile(before)
    prefix = f"{PACKAGE}/"
    return sorted(f.removeprefix(prefix) for f in found if f.startswith(prefix))


def calls() -> dict[str, Callable[[], Any]]:
    """The calls that are counted: the mixture and the benchmark of the README."""
    rng = np.random.default_rng(0)
    data = rng.normal(np.repeat([-5.0, 0.0, 5.0], 20), 1.0)
    net, dbn = mixture(data.size), benchmark()
    series = {"y": rng.normal(5.0, 3.0, 20)}
    infer, track = BARS
    # names load when first asked for: here, since what loading runs is no part of a call
    ask, follow, gibbs, particles = bmc.infer, bmc.filter, bmc.Gibbs, bmc.ParticleFilter
    return {
        infer: lambda: ask(net, {"x": data}, engine=gibbs(draws=20, warmup=20, chains=2), rng=1),
        track: lambda: follow(dbn, series, engine=particles(200), rng=1),
    }


def mixture(points: int) -> bmc.BayesNet:
    """Three normals of unknown means."""
    net = bmc.BayesNet("mixture", plates={"cluster": 3, "point": points})
    net.add("weights", bmc.Dirichlet(np.ones(3)))
    net.add("mean", bmc.Normal(0.0, 10.0), plates="cluster")
    net.add("label", lambda weights: bmc.Categorical(weights), plates="point")
    net.add("x", lambda label, mean: bmc.Normal(mean[label], 1.0), plates="point")
    return net


def benchmark() -> bmc.DynamicBayesNet:
    """The nonlinear series of Gordon, Salmond and Smith (1993)."""
    dbn = bmc.DynamicBayesNet("benchmark")

    @dbn.node(initial=bmc.Normal(0.0, np.sqrt(10.0)))
    def x(x_prev, t):
        drift = 0.5 * x_prev + 25 * x_prev / (1 + x_prev**2) + 8 * np.cos(1.2 * t)
        return bmc.Normal(drift, np.sqrt(10.0))

    @dbn.node
    def y(x):
        return bmc.Normal(x**2 / 20, 1.0)

    return dbn


def report(verbose: bool = False) -> Iterator[str]:
    """The lines of the table."""
    for name, call in calls().items():
        found = modules_of(call)
        yield f"{len(found):7,}  {name} (bar {BARS[name]})"
        if verbose:
            yield from (f"           {path}" for path in found)
