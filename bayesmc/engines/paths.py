"""Joint draws of all slices given all rows, and forecasts that go on from a belief."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.dbn import SeriesProblem
from bayesmc.engines.beliefs import OnlineBelief
from bayesmc.engines.exact.exact import Exact
from bayesmc.errors import QueryError, UnsupportedError
from bayesmc.network import pose
from bayesmc.randomness import Purpose, seed_sequence, stream
from bayesmc.results import SeriesPosterior


class Paths:
    """Draws of trajectories behind an answer over time.

    Filters that are exact draw from the joint posterior of all slices (by elimination, and backwards through
    it), a ``ParticleFilter`` from the trajectories that it has drawn; others know slices, not how they hang
    together.

    Parameters
    ----------
    problem : SeriesProblem
    observations : dict
        As the user gave them.
    inputs : dict or None
    """

    def __init__(
        self,
        problem: SeriesProblem,
        observations: Mapping[str, Any],
        inputs: Mapping[str, Any] | None,
    ) -> None:
        self.problem, self.observations, self.inputs = problem, observations, inputs

    def __call__(self, found: SeriesPosterior, draws: int, rng: Any) -> dict[str, np.ndarray]:
        """Node -> user values, shape ``(draws, time, *plates, *event)``."""
        seed = seed_sequence(rng)
        clouds = getattr(found, "clouds", None)
        if clouds is not None and found.kind == "smooth":
            return self._of_trajectories(found, draws, stream(seed, Purpose.RESAMPLE))
        if not found.engine.is_exact:
            raise UnsupportedError(self._instead(found))
        dbn = self.problem.dbn
        net = dbn.unroll(self.problem.steps, self.inputs)
        asked, exact = pose(net, dbn.unrolled_evidence(self.observations)), Exact()
        refused = exact.refusal(asked)
        if refused is not None:
            raise UnsupportedError(f"sample_paths: {refused}")
        posterior = exact.run(asked, seed).resample(draws, seed)
        names = [n for n in self.problem.slices.dynamic if n in found.names]
        first = self.problem.steps - found.steps
        return {name: posterior[name][0][:, first:] for name in names}

    def _of_trajectories(
        self, found: Any, draws: int, rng: np.random.Generator
    ) -> dict[str, np.ndarray]:
        if any(now.inner is not None for now in found.clouds):
            raise UnsupportedError(
                "sample_paths: these trajectories have numbers integrated out (marginalize=); smooth with "
                "ParticleFilter(..., marginalize=None), whose trajectories are whole"
            )
        count = len(found.clouds[0].weights)
        picked = rng.integers(0, count, draws)
        return {name: np.moveaxis(found.particles(name), 0, 1)[picked] for name in found.names}

    def _instead(self, found: SeriesPosterior) -> str:
        who = type(found.engine).__name__
        if hasattr(found, "clouds"):
            return (
                f"sample_paths: a {who} keeps trajectories where it smooths without lag=; ask the result of "
                "smooth(dbn, observations, engine=ParticleFilter(...))"
            )
        return (
            f"sample_paths: {who} approximates each slice by itself and does not say how slices hang "
            "together; "
            "draw with smooth(..., engine=ParticleFilter(particles)), or take the chains of "
            "infer(dbn, observations), whose draws posterior[name] are paths"
        )


class BeliefForecast(SeriesPosterior):
    """Beliefs about slices ahead of one belief: all that the belief itself would say of each."""

    beliefs: Sequence[Any] = ()

    def quantile(self, name: str, q: Any) -> np.ndarray:
        """Quantiles, shape ``(time, *q.shape, *plates, *event)``."""
        return self._asked(name, lambda belief: belief.quantile(name, q))

    def expectation(self, function: Callable[..., Any]) -> np.ndarray:
        """Means of a function of nodes of a slice, time first."""
        return np.stack([belief.expectation(function) for belief in self.beliefs])

    def probability(self, function: Callable[..., Any]) -> np.ndarray:
        """Probabilities of an event, time first."""
        return np.stack([belief.probability(function) for belief in self.beliefs])

    def hdi(self, name: str, prob: float = 0.89) -> np.ndarray:
        """As of any series."""
        return self._asked(name, lambda belief: belief.hdi(name, prob))

    def mode(self, name: str) -> np.ndarray:
        """As of any series."""
        return self._asked(name, lambda belief: belief.mode(name))

    def cdf(self, name: str, points: Any) -> np.ndarray:
        """As of any series."""
        return self._asked(name, lambda belief: belief.cdf(name, points))

    def entropy(self, *names: str) -> np.ndarray:
        """As of any series."""
        if len(names) != 1:
            return super().entropy(*names)
        return self._asked(names[0], lambda belief: belief.entropy(names[0]))

    def _asked(self, name: str, ask: Callable[[Any], np.ndarray]) -> np.ndarray:
        self._node(name)
        return np.stack([ask(belief) for belief in self.beliefs])


def forecast_from(
    engine: Any, belief: Any, steps: int, inputs: Mapping[str, Any] | None, queries: Any
) -> BeliefForecast:
    """Beliefs about the ``steps`` slices after a belief's, as if their rows were missing.

    Raises
    ------
    QueryError
        The belief has absorbed nothing.
    """
    if belief.t < 0:
        raise QueryError(
            "forecast: the belief has absorbed nothing yet (t is -1); step(belief, row) takes in slice 0"
        )
    rows = {name: _rows(name, value, steps) for name, value in (inputs or {}).items()}
    beliefs = []
    for k in range(steps):
        belief = engine.step(belief, {}, inputs={n: v[k] for n, v in rows.items()} or None)
        beliefs.append(belief)
    names = [n for n in belief.names if n not in belief.slices.template.static]
    model = belief.slices.first
    finite = [n for n in names if model[n].domain is not None]
    numbers = [n for n in names if model[n].domain is None]
    found = BeliefForecast(
        model, engine, "forecast", None,
        tables={n: np.stack([b.probabilities(n) for b in beliefs]) for n in finite},
        means={n: np.stack([b.mean(n) for b in beliefs]) for n in numbers},
        variances={n: np.stack([b.var(n) for b in beliefs]) for n in numbers},
        queries={n: np.stack([b.expectation(f) for b in beliefs]) for n, f in queries.items()},
        steps=steps, start=beliefs[0].t,
    )  # fmt: skip
    found.beliefs = tuple(beliefs)
    return found


def is_belief(value: Any) -> bool:
    """Whether a forecast is to go on from a value."""
    return isinstance(value, OnlineBelief)


# ---- private ------------------------------------------------------------------------------------


def _rows(name: str, value: Any, steps: int) -> np.ndarray:
    """An input's rows, one for each slice ahead."""
    rows = np.asarray(value)
    if rows.ndim < 1 or len(rows) != steps:
        raise QueryError(
            f"forecast: the input {name!r} has shape {rows.shape}; give one row for each of the "
            f"{steps} slices "
            "ahead, time first"
        )
    return rows
