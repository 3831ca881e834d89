"""Exact answers to many questions on one net of finite nodes: blocks of evidence sets on one clique tree."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bayesmc.engines.exact.exact import Exact
from bayesmc.engines.exact.exact_posterior import ExactPosterior
from bayesmc.engines.exact.hybrid_plan import DiscretePlan, Solved, plan_for
from bayesmc.factors import BoundTree
from bayesmc.factors.many import OneOfMany, block_size, calibrate_many, is_worth_it
from bayesmc.network import Observed, Problem
from bayesmc.network.fingerprint import fingerprint
from bayesmc.results.many import Posteriors
from bayesmc.results.posterior import Posterior
from bayesmc.results.statistics import table_variance

#: blocks in a unit of work
_BLOCKS = 8


class Prepared:
    """A net of finite nodes with its tree, ready for evidence on nodes without plates.

    Parameters
    ----------
    problem : Problem
        Of one evidence set; all others have the same inputs.
    engine : Exact
    """

    def __init__(self, problem: Problem, engine: Exact) -> None:
        self.problem, self.engine = problem, engine
        plan = plan_for(problem)
        assert isinstance(plan, DiscretePlan)
        self.net, self.tree = plan.net, plan.tree
        self.bound: BoundTree = plan._bound(problem)[0]
        self._codes: dict[str, tuple[int, dict[Any, int]]] = {}
        for name, node in problem.model.nodes.items():
            if node.domain is not None and not node.value_shape and node.is_stochastic:
                states = {state: k for k, state in enumerate(node.domain.states)}
                at = self.tree.index.get((name, 0))
                if at is not None:
                    self._codes[name] = at, states

    @staticmethod
    def of(problem: Problem, engine: Exact) -> Prepared | None:
        """Of a question that can be asked many times at once; None of all others."""
        model = problem.model
        finite = all(n.domain is not None or n.kind == "input" for n in model.nodes.values())
        if not finite or engine.refusal(problem) is not None:
            return None
        plan = plan_for(problem)
        if not isinstance(plan, DiscretePlan) or plan.net.evidence_sources:
            return None
        if plan.net.invalid or not is_worth_it(plan._bound(problem)[0]):
            return None
        return Prepared(problem, engine)

    def states(self, evidence: Sequence[Mapping[str, Any]]) -> np.ndarray | None:
        """Positions of observed states, shape (sets, variables); None where a set needs a closer look."""
        found = np.full((len(evidence), len(self.tree.variables)), -1, dtype=np.int16)
        rows, columns, positions = [], [], []
        codes = self._codes
        try:
            for k, one in enumerate(evidence):
                for name, value in one.items():
                    if value is None:
                        continue
                    at, states = codes[name]
                    rows.append(k)
                    columns.append(at)
                    positions.append(states[value])
        except (KeyError, TypeError, AttributeError):  # arrays, plates, what is wrong
            return None
        found[rows, columns] = positions
        return found

    def units(self, states: np.ndarray) -> Iterator[np.ndarray]:
        """Evidence sets in units of work; how they are cut depends on the tree alone."""
        size = _BLOCKS * block_size(self.bound)
        return (states[k : k + size] for k in range(0, len(states), size))

    def answered(self, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Log evidence and marginals of some sets."""
        size = block_size(self.bound)
        starts = range(0, len(states), size)
        found = [calibrate_many(self.bound, states[k : k + size]) for k in starts]
        return (
            np.concatenate([f.log_z for f in found]),
            np.concatenate([f.marginals for f in found]),
        )

    def asked_of(self, problem: Problem | None) -> Prepared:
        """The same with the functions of a problem about the same net; None: with none."""
        if problem is None:
            own = self.problem
            bare: Any = replace(own, net=None, model=own.model.without_functions(), cache={})  # type: ignore[arg-type]
            problem = bare
        found = copy.copy(self)
        found.problem = replace(problem, observed={}, cache={})
        found.net = replace(self.net, model=problem.model, static=[])  # which the tree holds
        return found

    def posed(self, row: np.ndarray) -> tuple[Problem, dict[Any, int]]:
        """The question of one row of states."""
        variables = self.tree.variables
        seen = {variables[v]: int(row[v]) for v in np.flatnonzero(row >= 0)}
        observed = {}
        for variable, state in seen.items():
            name = str(variable[0])  # type: ignore[index]
            domain = self.problem.model[name].domain
            assert domain is not None
            value = np.array(state, dtype=domain.dtype)
            value.flags.writeable = False
            observed[name] = Observed(value)
        return replace(self.problem, observed=observed, cache={}), seen


class TablePosteriors(Posteriors):
    """Posteriors of a net of finite nodes; marginals of all evidence sets are one array.

    Parameters
    ----------
    prepared : Prepared
    states : ndarray of int, shape (sets, variables)
    log_z : ndarray, shape (sets,)
    flat : ndarray, shape (sets, states of all variables)
    done : ndarray of bool, shape (sets,)
        Whether a set was answered; of what is impossible the rows of ``flat`` are NaN.
    impossible : dict, optional
    """

    def __init__(
        self,
        prepared: Prepared,
        states: np.ndarray,
        log_z: np.ndarray,
        flat: np.ndarray,
        done: np.ndarray,
        impossible: Mapping[int, str] | None = None,
    ) -> None:
        super().__init__([], impossible)
        self._prepared, self._states, self._log_z, self._flat = prepared, states, log_z, flat
        self._done = done

    def __getstate__(self) -> dict[str, Any]:
        """Pickles and files travel without functions."""
        return {**self.__dict__, "_prepared": self._prepared.asked_of(None)}

    def kept(self) -> Sequence[Posterior | None]:
        return (self._some(),)

    def bind(self, problems: Sequence[Problem | None]) -> None:
        one = next((problem for problem in problems if problem is not None), None)
        if one is not None:
            self._prepared = self._prepared.asked_of(one)

    def __len__(self) -> int:
        return len(self._states)

    @property
    def done(self) -> np.ndarray:
        return self._done.copy()

    @property
    def log_marginal_likelihood(self) -> np.ndarray:
        self._whole("log_marginal_likelihood")
        return self._log_z.copy()

    def probabilities(self, *names: str) -> np.ndarray:
        if len(names) != 1 or (where := self._place(names[0])) is None:
            return super().probabilities(*names)
        self._whole("probabilities")
        return self._flat[:, where].copy()

    def mean(self, name: str) -> np.ndarray:
        numbers = self._numbers(name)
        if numbers is None:
            return super().mean(name)
        return np.asarray(self.probabilities(name) @ numbers)

    def var(self, name: str) -> np.ndarray:
        numbers = self._numbers(name)
        if numbers is None:
            return super().var(name)
        return table_variance(self.probabilities(name), numbers)

    # ---- private -------------------------------------------------------------------------------

    def _one(self, k: int) -> Posterior | None:
        if not self._done[k]:
            return None
        own = self._prepared
        problem, seen = own.posed(self._states[k])
        row = OneOfMany(own.bound, seen, float(self._log_z[k]), self._flat[k].copy())
        found = ExactPosterior(problem, own.engine, Solved(own.net, row, None, []))
        if problem.net is None:  # of a file, or a pickle
            found.problem, found._known = None, problem.inputs
        return found

    def _some(self) -> Posterior | None:
        at = np.flatnonzero(self._done)
        return self._one(int(at[0])) if at.size else None

    def _each(self) -> Iterator[tuple[int, Posterior]]:
        """None is kept by itself: the arrays of all stand side by side."""
        return iter(())

    def _free(self) -> list[str]:
        own, known = self._prepared, np.flatnonzero((self._states >= 0).all(axis=0))
        fixed = {own.tree.variables[v] for v in known}
        kinds = own.problem.model.nodes
        return [n for n in self.names if kinds[n].kind != "fixed" and (n, 0) not in fixed]

    def _said(self) -> dict[str, Any]:
        problem = self._prepared.problem
        if problem.net is None:
            return {}
        return {"fingerprints": [fingerprint(problem.model)], "whose": [0]}

    def _whole(self, what: str) -> None:
        if self._done.sum() + len(self.impossible) < len(self._done):
            list(self._all(what))

    def _place(self, name: str) -> slice | None:
        """Where the probabilities of a node without plates stand."""
        tree = self._prepared.tree
        node = self._prepared.problem.model.nodes.get(name)
        at = tree.index.get((name, 0))
        if node is None or node.value_shape or at is None:
            return None
        return slice(*tree.program().place[at])

    def _numbers(self, name: str) -> np.ndarray | None:
        if self._place(name) is None:
            return None
        domain = self._prepared.problem.model[name].domain
        if domain is None or domain.labels is not None:
            return None
        return np.asarray(domain.numbers, dtype=float)
