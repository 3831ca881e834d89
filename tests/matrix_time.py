"""The part of the matrix that is about time: random templates with data, their exact answers, the engines.

Templates of finite nodes are unrolled and enumerated, linear-Gaussian ones unrolled and conditioned as one
dense Gaussian.
"""

from __future__ import annotations

import functools
import itertools
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.dbn import pose_series
from bayesmc.engines.marginal.options import split_of_problem
from bayesmc.errors import (
    BudgetError,
    DegeneracyError,
    LowEssWarning,
    UnsupportedError,
    ZeroProbabilityError,
)
from bayesmc.results.series import SeriesPosterior
from bayesmc.testing import exact, random_dbn, session
from bayesmc.testing.makers.linear_dbns import random_linear_dbn
from bayesmc.testing.makers.switching_dbns import random_switching_dbn
from tests.matrix import DOUBTS, SHIFT

#: "static": a static node is unknown, which particle chains alone answer; "one number": linear ones of which
#: the default grid finds its range and cells; "switching": linear ones with modes that make no difference to
#: numbers, so that filters that merge Gaussians are exact; "modes": with ones that do
KINDS = ("finite", "linear", "static", "one number", "switching", "modes")
#: templates of each kind for engines that compute, and for those with particles, which take longer
MANY, FEW = session.scaled(5, 8), session.scaled(2, 15)
GRID = bmc.GridFilter()
#: runs of a particle filter
RUNS = session.scaled(30, 10)
#: spread of the logs of their estimates up to which so many runs have a mean with an error
EVEN = 0.7


@dataclass(frozen=True, eq=False)
class Series:
    """A template, data for it, and the exact answer given all of them."""

    dbn: bmc.DynamicBayesNet
    observations: dict[str, Any]
    inputs: dict[str, Any] | None
    exact: Any


@functools.cache
def series(kind: str, seed: int) -> Series | None:
    """None where it is too large to be answered exactly."""
    if kind == "finite":
        case: Any = random_dbn(seed, nodes=(1, 3), steps=(2, 4))
    elif kind == "switching":
        case = random_switching_dbn(seed, difference=0.0)
    elif kind == "modes":
        case = random_switching_dbn(seed)
    else:
        case = random_linear_dbn(seed, vague=2.0)
    data = dict(case.observations)
    if kind == "static":
        if "level" not in data:
            return series(kind, seed + 10_000)
        del data["level"]
    if kind == "one number" and GRID.unsupported(case.dbn, data, case.inputs or None) is not None:
        return None
    try:
        answer = exact(case.dbn, data, case.inputs or None)
    except (UnsupportedError, BudgetError):
        return None
    if any(n not in answer.names for n, node in answer.model.nodes.items() if node.is_stochastic):
        return None
    return Series(case.dbn, data, case.inputs or None, answer)


def cases(kind: str, count: int, first: int = 0) -> Iterator[tuple[int, Series]]:
    """The first so many templates of a kind that can be answered exactly, with their seeds."""
    every = ((seed, series(kind, seed)) for seed in itertools.count(SHIFT + first))
    found = ((seed, case) for seed, case in every if case is not None)
    return itertools.islice(found, count)


class Whole(bmc.BoyenKoller):
    """All that the next slice reads, of what ever meets, in one cluster: the exact filter by another road."""

    def _chosen(self, slices: Any, static: Any, series: Any) -> Callable[[Any], Any]:
        return lambda plan: [chain.state for chain in plan.chains]


#: engines that compute: engine, its tolerance, kinds of templates all of which it answers
COMPUTING: dict[str, tuple[Any, float, tuple[str, ...]]] = {
    "DiscreteFilter": (bmc.DiscreteFilter(), 1e-9, ("finite",)),
    "BoyenKoller, one cluster": (Whole(), 1e-9, ("finite",)),
    "GridFilter": (bmc.GridFilter(), 1e-9, ("finite",)),
    "GridFilter, found": (GRID, 1e-3, ("one number",)),
    "KalmanFilter": (bmc.KalmanFilter(), 1e-7, ("linear",)),
    "ExtendedKalmanFilter": (bmc.ExtendedKalmanFilter(), 1e-6, ("linear",)),
    "UnscentedKalmanFilter": (bmc.UnscentedKalmanFilter(), 1e-6, ("linear",)),
    "SwitchingKalmanFilter": (bmc.SwitchingKalmanFilter(), 1e-7, ("linear", "switching")),
    "SwitchingKalmanFilter, IMM": (bmc.SwitchingKalmanFilter("imm"), 1e-7, ("switching",)),
    "SwitchingKalmanFilter, GPB1": (bmc.SwitchingKalmanFilter("gpb1"), 1e-7, ("switching",)),
    "SwitchingKalmanFilter, linearised": (
        bmc.SwitchingKalmanFilter(linearize=True),
        1e-6,
        ("switching",),
    ),
    "ExpectationPropagation": (
        bmc.ExpectationPropagation(tolerance=1e-10),
        1e-7,
        ("linear", "switching"),
    ),
    "no engine named": (None, 1e-7, ("finite", "linear")),
}

#: particle filters, of few particles: what is tested has no bias whatever their number
PARTICLES: dict[str, dict[str, Any]] = {
    "bootstrap": {},
    "auxiliary": {"auxiliary": True},
    "optimal": {"proposal": "optimal"},
}
#: those that integrate numbers out given finite nodes
MARGINAL: dict[str, dict[str, Any]] = {
    "integrated": {"marginalize": "auto"},
    "mixture Kalman": {"marginalize": "auto", "proposal": "optimal"},
}
#: which is tried on which kind of template
TRIED = [(v, k) for v in PARTICLES for k in ("finite", "linear")]
TRIED += [(v, "modes") for v in MARGINAL]

#: engines of chains, and the kinds of templates that they answer, a third of them or more without a doubt of
#: their own
CHAINS: dict[str, tuple[Any, tuple[str, ...]]] = {
    "ParticleGibbs": (
        bmc.ParticleGibbs(draws=300, warmup=50, chains=16, particles=40),
        ("finite", "linear", "static"),
    ),
    "ParticleMetropolis": (
        bmc.ParticleMetropolis(draws=500, warmup=200, chains=16, particles=40),
        ("static",),
    ),
}


def answered(case: Series, engine: Any, seed: int) -> Any:
    """The posterior of all slices by an engine of chains; None where it refuses, or doubts its answer."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            posterior = bmc.infer(
                case.dbn, case.observations, inputs=case.inputs, engine=engine, rng=seed
            )
        except UnsupportedError:
            return None
    assert all(issubclass(w.category, DOUBTS) for w in caught)
    return None if caught else posterior


def tabled(case: Series, seed: int) -> bmc.ParticleFilter | None:
    """A filter with tables of one finite node of a template, or of two, and others sampled; or None."""
    problem = pose_series(case.dbn, case.observations, case.inputs)
    nodes = [n for n in problem.slices.stochastic if n not in problem.seen]
    rng = np.random.default_rng(seed)
    for count in (2, 1, 1, 1) if nodes else ():
        names = rng.permutation(nodes)[:count].tolist()
        proposal = "optimal" if seed % 2 else None
        engine = bmc.ParticleFilter(50, marginalize=names, proposal=proposal)
        if engine.unsupported(case.dbn, case.observations, inputs=case.inputs) is None:
            split = split_of_problem(engine, problem)
            if split is not None and split.tables is not None:
                if any(n not in split.waiting for n in nodes):
                    return engine
    return None


def bent(seed: int) -> tuple[Series, bmc.DynamicBayesNet, tuple[str, ...]] | None:
    """A case with modes, its template with means that do not look affine, and what "auto" integrates out.

    Tangents of these are the functions themselves, so that linearised nodes have exact answers.
    """
    case = series("modes", seed)
    if case is None:
        return None
    problem = pose_series(case.dbn, case.observations, case.inputs)
    split = split_of_problem(bmc.ParticleFilter(50, marginalize="auto"), problem)
    if split is None or not split.inner:
        return None
    other = random_switching_dbn(seed, mean=lambda x: np.log(np.exp(x)))
    return case, other.dbn, split.inner


def late(case: Series, found: SeriesPosterior, lag: int) -> dict[str, tuple[Any, Any]]:
    """Figures of every slice given rows up to so many slices later, answered and exact, by name."""
    names = [n for n in found.names if hidden(case, n)]
    finite = {n: found.model[n].domain is not None for n in names}
    right: dict[str, Any] = {n: [] for n in names}
    static = case.dbn.static_nodes
    for t in range(case.exact.steps):
        rows = {n: v if n in static else v[: t + lag + 1] for n, v in case.observations.items()}
        inputs = {n: v[: t + lag + 1] for n, v in (case.inputs or {}).items()}
        answer = exact(case.dbn, rows, inputs or None)
        for name in names:
            right[name].append(figure(answer, name, finite[name])[t])
    return {n: (figure(found, n, finite[n]), np.stack(right[n])) for n in names}


def unbiased(case: Series, engine: bmc.ParticleFilter) -> tuple[Callable[[Any], Any], Any]:
    """Estimates without bias, of any number of particles, and what they estimate.

    They are figures times estimated over exact evidence: filtered ones of the last slice, those of the slice
    before one row late, and smoothed ones of the first where the engine smooths (Del Moral 2004, Feynman-Kac
    formulae, sec. 7.4.2; Del Moral, Doucet and Singh 2010, A backward particle interpretation of Feynman-Kac
    formulae, M2AN 44).
    """
    last = case.exact.steps - 1
    questions: dict[str, Any] = {"filter": (bmc.filter, last), "smooth": (bmc.smooth, 0)}
    if last > 0 and engine.delay is None:  # one row late: what is said of the slice before the last
        questions["late"] = (functools.partial(bmc.smooth, lag=1), last - 1)
    log_exact = case.exact.log_marginal_likelihood - case.exact.log_static

    def ask(what: str, rng: Any) -> SeriesPosterior | None:
        """None where no particle is possible: an estimate of zero."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LowEssWarning)  # few particles are wanted here
            try:
                return questions[what][0](
                    case.dbn, case.observations, inputs=case.inputs, engine=engine, rng=rng
                )
            except (DegeneracyError, ZeroProbabilityError):
                return None

    right: dict[str, Any] = {}
    finite: dict[str, bool] = {}
    places: dict[str, Any] = {}
    for what, (_, t) in list(questions.items()):
        try:
            first = next(a for seed in range(100) if (a := ask(what, seed)) is not None)
        except UnsupportedError:  # a running sum is not drawn backwards
            del questions[what]
            continue
        finite |= {n: first.model[n].domain is not None for n in first.names}
        for name in first.names:
            if hidden(case, name):
                value = figure(case.exact, name, finite[name])[t]
                places[f"{what} {name}"] = place = common(value, finite[name])
                right[f"{what} {name}"] = value[place]

    def estimate(rng: np.random.Generator) -> dict[str, Any]:
        found = {key: np.zeros(np.shape(value)) for key, value in right.items()}
        for what, (_, t) in questions.items():
            answer = ask(what, rng)
            if answer is None:
                continue
            ratio = np.exp(np.sum(answer.log_marginal_likelihood) - log_exact)
            for name in answer.names:
                if f"{what} {name}" in right:
                    value = figure(answer, name, finite[name])[t]
                    found[f"{what} {name}"] = ratio * value[places[f"{what} {name}"]]
        return found

    return estimate, right


def stated(case: Series, engine: bmc.ParticleFilter, part: float = 1.0) -> tuple[Any, ...]:
    """What ``stated_errors_test`` takes: filtered figures of the last slice; a part of the stated errors."""
    t = case.exact.steps - 1
    one = ask_once(case, engine)
    names = [n for n in one.names if hidden(case, n)] if one is not None else []
    nodes = one.model.nodes if one is not None else {}
    log_exact = float(case.exact.log_marginal_likelihood - case.exact.log_static)
    right: dict[str, Any] = {}
    places: dict[str, Any] = {}

    def ask(seed: Any) -> SeriesPosterior:
        found = bmc.filter(case.dbn, case.observations, inputs=case.inputs, engine=engine, rng=seed)
        found.log_marginal_likelihood_mcse *= part
        return found

    for name in names:
        node = nodes[name]
        if node.domain is not None and node.domain.labels is None:
            continue  # a mean of numbers that may be one number in every run
        value = figure(case.exact, name, node.domain is not None)[t]
        places[name] = place = common(value, node.domain is not None)
        right[name] = value[place]

    def figures(found: Any) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        values = {}
        for name in right:
            finite = nodes[name].domain is not None
            value, error = figure(found, name, finite)[t], found.mcse(name)[t]
            values[name] = value[places[name]], part * error[places[name]]
        return values

    return ask, log_exact, right, figures


def ask_once(case: Series, engine: bmc.ParticleFilter) -> SeriesPosterior | None:
    """One run; None where no particle is possible."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LowEssWarning)
        try:
            return bmc.filter(case.dbn, case.observations, inputs=case.inputs, engine=engine, rng=0)
        except (DegeneracyError, ZeroProbabilityError):
            return None


def hidden(case: Series, name: str) -> bool:
    """Whether some of the node is not data."""
    rows = case.observations.get(name)
    if rows is None or np.ma.is_masked(rows):
        return True
    return rows.dtype.kind == "f" and bool(np.isnan(rows).any())


def figure(answer: Any, name: str, finite: bool) -> np.ndarray:
    """Probabilities of states, or means; time first."""
    return answer.probabilities(name) if finite else answer.mean(name)


def common(exact: np.ndarray, finite: bool) -> Any:
    """Where figures are judged: not those of states that no run may meet."""
    return np.where(exact >= 0.02) if finite else ...
