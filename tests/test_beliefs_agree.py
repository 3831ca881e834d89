"""Every online filter on random templates: a belief that is pickled half-way goes on to the same answers.

The part of the matrix over time about beliefs. There is no chance in it: the same numbers are drawn.
"""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import DegeneracyError, UnsupportedError, ZeroProbabilityError
from tests.matrix_time import MANY, Series, cases

#: online filters, and kinds of templates that they answer, some of them or all
ONLINE: dict[str, tuple[Any, tuple[str, ...]]] = {
    "DiscreteFilter": (bmc.DiscreteFilter(), ("finite",)),
    "BoyenKoller": (bmc.BoyenKoller(), ("finite",)),
    "FactoredFrontier": (bmc.FactoredFrontier(), ("finite",)),
    "GridFilter": (bmc.GridFilter(), ("finite",)),
    "KalmanFilter": (bmc.KalmanFilter(), ("linear",)),
    "ExtendedKalmanFilter": (bmc.ExtendedKalmanFilter(), ("linear",)),
    "UnscentedKalmanFilter": (bmc.UnscentedKalmanFilter(), ("linear",)),
    "SwitchingKalmanFilter": (bmc.SwitchingKalmanFilter(), ("linear", "switching")),
    "ExpectationPropagation": (bmc.ExpectationPropagation(), ("switching",)),
    "bootstrap": (bmc.ParticleFilter(100), ("finite", "linear")),
    "auxiliary": (bmc.ParticleFilter(100, auxiliary=True), ("finite", "linear")),
    "optimal": (bmc.ParticleFilter(100, proposal="optimal"), ("finite", "linear")),
}


def gone_through(case: Series, engine: Any, interrupt: Any) -> list[dict[str, Any]]:
    """What the beliefs say, slice by slice; ``interrupt`` gets each of them before the next row."""
    static = {n: case.observations[n] for n in case.dbn.static_nodes if n in case.observations}
    rows = {n: v for n, v in case.observations.items() if n not in static}
    belief, found = engine.start(case.dbn, static=static or None, rng=5), []
    for t in range(case.exact.steps):
        belief = interrupt(belief)
        row = {n: v[t] for n, v in rows.items()}
        belief = engine.step(belief, row, inputs={n: v[t] for n, v in (case.inputs or {}).items()})
        said = {"log": belief.log_marginal_likelihood}
        for name in belief.names:
            finite = belief.slices.first[name].domain is not None
            said[name] = belief.probabilities(name) if finite else belief.mean(name)
        found.append(said)
    return found


@pytest.mark.filterwarnings("ignore::bayesmc.errors.ProposalWarning")
@pytest.mark.parametrize(("name", "kind"), [(n, k) for n in ONLINE for k in ONLINE[n][1]])
def test_beliefs_go_on_after_a_pickle(name: str, kind: str) -> None:
    engine, tried = ONLINE[name][0], 0
    for _, case in cases(kind, MANY):
        dbn = case.dbn

        def travel(belief: Any, dbn: Any = dbn) -> Any:
            return engine.start(dbn, belief=pickle.loads(pickle.dumps(belief)))

        try:
            wanted = gone_through(case, engine, lambda belief: belief)
        except (DegeneracyError, UnsupportedError, ZeroProbabilityError):
            continue
        for one, other in zip(wanted, gone_through(case, engine, travel), strict=True):
            assert one.keys() == other.keys()
            for key, value in one.items():
                assert np.array_equal(value, other[key], equal_nan=True), (case.dbn, key)
        tried += 1
    assert tried >= MANY / 3


def test_a_belief_with_other_random_numbers_is_seen() -> None:
    """The negative control: a belief that draws anew says something else."""
    _, case = next(cases("linear", 1))
    engine = bmc.ParticleFilter(100)

    def forget(belief: Any) -> Any:
        fresh = engine.start(case.dbn, belief=pickle.loads(pickle.dumps(belief)))
        fresh.chance = None
        return fresh

    one, other = (gone_through(case, engine, f)[-1] for f in (lambda belief: belief, forget))
    assert not np.array_equal(one["log"], other["log"])
