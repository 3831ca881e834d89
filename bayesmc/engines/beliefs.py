"""Beliefs that travel: what goes on after a pickle, and whether a belief fits a template.

Pickles carry no functions. A belief that comes out of one answers as before, and goes on once ``start(dbn,
belief=...)`` has given it the template again.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.dbn import PREVIOUS, DynamicBayesNet, Row, Slices
from bayesmc.errors import ModelError, QueryError
from bayesmc.network import CompiledNode, Model
from bayesmc.results import SeriesPosterior, save
from bayesmc.results.marginal_answers import MarginalAnswers
from bayesmc.results.series import no_joint_table


class OnlineBelief:
    """Base of the beliefs about one slice: values that never change, so a copy is the belief itself."""

    @property
    def _as_series(self) -> MarginalAnswers:
        """The answers about a series of this one slice."""
        raise NotImplementedError

    def median(self, name: str) -> np.ndarray:
        """Median, shape ``(*plates, *event)``."""
        return self._as_series.median(name)[0]

    def hdi(self, name: str, prob: float = 0.89) -> np.ndarray:
        """Narrowest intervals that hold each number with probability ``prob``, ``(*plates, *event, 2)``."""
        return self._as_series.hdi(name, prob)[0]

    def mode(self, name: str) -> np.ndarray:
        """Where the marginal of each number is highest; labels where states have some."""
        return self._as_series.mode(name)[0]

    def cdf(self, name: str, points: Any) -> np.ndarray:
        """Probabilities that each number is at or below some points, ``(*points.shape, *plates, *event)``."""
        return self._as_series.cdf(name, points)[0]

    def entropy(self, name: str) -> np.ndarray:
        """Entropy of each number in nats, shape ``(*plates, *event)``."""
        return self._as_series.entropy(name)[0]

    def __copy__(self) -> Any:
        return self

    def __deepcopy__(self, memo: Any) -> Any:
        return self

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write it to a file; it goes on with ``engine.start(dbn, belief=bmc.load(path))``.

        Raises
        ------
        MissingExtraError, CheckpointError
        """
        save(self, path)


class SliceBelief(OnlineBelief):
    """Base of beliefs that answer as the posterior of a series of one slice, their own, does.

    Attributes
    ----------
    dbn : DynamicBayesNet or None
        None out of a pickle.
    static : dict
    t : int
        The slice; -1 before anything was absorbed.
    log_marginal_likelihood : float or ndarray
        Log density of all rows absorbed so far.
    inputs : dict
        Of the slice.
    slices : Slices or None
        What rows are read against; None before the first.
    state : object
        What a family goes on with; None before the first row.
    """

    def __init__(
        self,
        dbn: DynamicBayesNet | None,
        static: Mapping[str, Any],
        t: int = -1,
        log_marginal_likelihood: Any = 0.0,
        inputs: Mapping[str, np.ndarray] | None = None,
        slices: Slices | None = None,
        state: Any = None,
    ) -> None:
        self.dbn, self.static, self.t = dbn, dict(static), t
        self.log_marginal_likelihood = log_marginal_likelihood
        self.inputs, self.slices, self.state = dict(inputs or {}), slices, state

    def after(self, slices: Slices, row: Row, increment: np.ndarray, state: Any) -> Any:
        """The belief about the next slice, given the log density of its row."""
        total = self.log_marginal_likelihood + increment
        inputs = {n: row.inputs[n] for n in slices.template.inputs}
        total = total if np.ndim(total) else float(total)
        return type(self)(self.dbn, self.static, self.t + 1, total, inputs, slices, state)

    def bound(self, dbn: DynamicBayesNet, slices: Slices, state: Any) -> Any:
        """The same belief with the functions of a template."""
        total = self.log_marginal_likelihood
        return type(self)(dbn, self.static, self.t, total, self.inputs, slices, state)

    def __getstate__(self) -> dict[str, Any]:
        """Pickles travel without functions; ``start(dbn, belief=...)`` gives them back."""
        if self.t < 0:
            return {**self.__dict__, "dbn": None}
        _ = self._posterior  # it goes along
        return {**self.__dict__, "dbn": None, "state": self._without_functions()}

    def __repr__(self) -> str:
        if self.t < 0:
            return f"{type(self).__name__}(nothing absorbed yet)"
        return f"{type(self).__name__}(t={self.t}, {', '.join(self.names)})"

    @cached_property
    def _posterior(self) -> Any:
        if self.t < 0:
            raise QueryError(
                "the belief has absorbed nothing yet (t is -1); step(belief, row) takes in slice 0"
            )
        return self._answered()

    @property
    def _as_series(self) -> MarginalAnswers:
        found: MarginalAnswers = self._posterior
        return found

    def _answered(self) -> SeriesPosterior:
        """The posterior; it is worked out once."""
        raise NotImplementedError

    def _without_functions(self) -> Any:
        """The state as it travels."""
        raise NotImplementedError

    @property
    def _of_functions(self) -> Any:
        """The posterior, where it can answer for functions."""
        found = self._posterior
        if self.dbn is None:
            raise QueryError(
                "this belief was loaded or unpickled, and files and pickles carry no functions: it says "
                "means, variances, probabilities and densities of nodes; for the rest give it the template "
                "again, engine.start(dbn, belief=belief)"
            )
        return found

    @property
    def names(self) -> tuple[str, ...]:
        """Nodes that are answered for, parents first."""
        return self._posterior.names

    def mean(self, name: str) -> np.ndarray:
        """Mean, shape ``(*plates, *event)``; circular for angles; labels have none."""
        return self._posterior.mean(name)[0]

    def var(self, name: str) -> np.ndarray:
        """Variance, shape ``(*plates, *event)``; for angles ``-2 log R``."""
        return self._posterior.var(name)[0]

    def std(self, name: str) -> np.ndarray:
        """Standard deviation, shape ``(*plates, *event)``."""
        return self._posterior.std(name)[0]

    def probabilities(self, name: str, *others: str) -> np.ndarray:
        """Probabilities of the states of a finite node, shape ``(*plates, states)``; of one at a time."""
        if others:
            raise no_joint_table((name, *others), "ask", "expectation(%s)")
        return self._posterior.probabilities(name)[0]

    def quantile(self, name: str, q: Any) -> np.ndarray:
        """Quantiles of a node, number by number, shape ``(*q.shape, *plates, *event)``."""
        return self._posterior.quantile(name, q)[0]

    def expectation(self, function: Callable[..., Any]) -> np.ndarray:
        """Mean of a function of nodes of the slice, whose arguments have one leading axis."""
        return self._of_functions.expectation(function)[0]

    def probability(self, function: Callable[..., Any]) -> np.ndarray:
        """Probability of an event (a function that returns booleans)."""
        return self._of_functions.probability(function)[0]


def refuse_unbound(engine: Any, belief: Any) -> None:
    """Refuse a belief that was unpickled and has no functions to go on with.

    Raises
    ------
    ModelError
    """
    if belief.dbn is None:
        who = type(engine).__name__
        raise ModelError(
            f"{who}().step: this belief was loaded or unpickled, and files and pickles carry no "
            "functions; give it the template again, belief = engine.start(dbn, belief=belief), and go on"
        )


def slices_like(dbn: DynamicBayesNet, belief: Any) -> Slices | None:
    """A template compiled for the plates of a belief; None where that has absorbed nothing.

    Raises
    ------
    ModelError
        The belief is one about another template.
    """
    old: Slices | None = belief.slices
    if old is None:
        return None
    if old.template.inputs != dbn.inputs:
        raise _other(f"its inputs are {_names(old.template.inputs)}, not {_names(dbn.inputs)}")
    if old.template.static != dbn.static_nodes:
        raise _other(
            f"its static nodes are {_names(old.template.static)}, not {_names(dbn.static_nodes)}"
        )
    held = old.later.sizes
    if set(held) != set(dbn.plates):
        raise _other(f"its plates are {_names(held)}, not {_names(dbn.plates)}")
    sizes = {p: n if n is not None else held[p] for p, n in dbn.plates.items()}
    if sizes != held:
        plate = next(p for p in sizes if sizes[p] != held[p])
        raise _other(f"its plate {plate!r} has size {held[plate]}, not {sizes[plate]}")
    if old.template.plates.labels != dbn.template.plates.labels:
        raise _other("its plates have other labels")
    names = [*dbn.template.later]
    if {*old.template.later} != {*names}:
        raise _other(f"its nodes are {_names(old.template.later)}, not {_names(names)}")
    inputs = {**belief.inputs, **{n + PREVIOUS: v for n, v in belief.inputs.items()}}
    new = dbn.slices(sizes, inputs)
    for a, b, where in ((old.first, new.first, "slice 0"), (old.later, new.later, "later slices")):
        _check_alike(a, b, where)
    if new.first is not old.first or new.later is not old.later:
        now = new.prints
        for what, told in old.prints.items():
            if now.get(what, told) != told:
                raise _other(f"{what} is another one")
    return new


# ---- private ------------------------------------------------------------------------------------


def _check_alike(old: Model, new: Model, where: str) -> None:
    for name, node in old.nodes.items():
        if name not in new.nodes:
            raise _other(f"it has {name!r} in {where}")
        for what, (a, b) in _differences(node, new.nodes[name]).items():
            raise _other(f"in {where} {what} of {name!r} is {a}, not {b}")


def _differences(old: CompiledNode, new: CompiledNode) -> Mapping[str, tuple[Any, Any]]:
    """What tells two nodes apart, as far as it can be told without their functions."""
    faces: dict[str, tuple[Any, Any]] = {
        "the kind": (old.kind, new.kind),
        "the list of parents": (list(old.parents), list(new.parents)),
        "the list of plates": (list(old.plates), list(new.plates)),
        "the shape of a value": (old.value_shape, new.value_shape),
        "the list of states": (_states(old), _states(new)),
    }
    found = {what: both for what, both in faces.items() if both[0] != both[1]}
    tables = old.declaration.probs, new.declaration.probs
    if not found and any(t is not None for t in tables):
        one, other = (np.zeros(()) if t is None else t for t in tables)
        if not np.array_equal(one, other):
            found["the table"] = (one.tolist(), other.tolist())
    return found


def _states(node: CompiledNode) -> list[Any] | None:
    return None if node.domain is None else list(node.domain.states)


def _names(names: Any) -> str:
    return ", ".join(map(repr, names)) or "none"


def _other(why: str) -> ModelError:
    return ModelError(
        f"start(dbn, belief=...): the belief is one about another template: {why}; give the template that "
        "the belief was started with"
    )
