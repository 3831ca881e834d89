"""Expected counts of a template's tables over a series: by slices, by pairs of them, or all at once."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bayesmc.auto.static import infer
from bayesmc.dbn import UNCOMPARED, DynamicBayesNet, pose_series
from bayesmc.dbn.slices import PREVIOUS, TIME, SliceStore
from bayesmc.engines.discrete.filter import DiscreteFilter
from bayesmc.engines.exact.exact import Exact
from bayesmc.errors import EvidenceError, QueryError, UnsupportedError
from bayesmc.network.node import Declaration

#: what an initial table is called among those that are learned
INITIAL = " initial"


class SeriesCounts:
    """The E-step of a template: the discrete filter's forward and backward pass (Baum and Welch).

    Parameters
    ----------
    dbn : DynamicBayesNet
    data, inputs : dict
    learned : sequence of str
        Nodes whose tables are learned, initial ones included.

    References
    ----------
    Rabiner (1989), A tutorial on hidden Markov models, Proceedings of the IEEE 77, eqs. 37 to 40.
    """

    def __init__(
        self,
        dbn: DynamicBayesNet,
        data: Mapping[str, Any],
        inputs: Mapping[str, Any] | None,
        learned: Sequence[str],
    ) -> None:
        self.dbn, self.data, self.inputs, self.learned = dbn, data, inputs, tuple(learned)
        self.engine = DiscreteFilter()
        problem = pose_series(dbn, data, inputs)
        refused = self.engine.refusal(problem)
        if refused is not None:
            raise UnsupportedError(
                f"fit: tables of a template are learned where all that is hidden is finite: {refused}"
            )
        self.steps, self.model = problem.steps, problem.model
        seen = problem.series.observed
        if not any(o.mask is None or o.mask.any() for o in seen.values()):
            raise EvidenceError(
                "fit: nothing is observed: every entry of the series is missing; give rows with values"
            )
        #: whether entries of a node were observed, (steps, *plates), where some were not
        self.gaps: dict[str, np.ndarray] = {}
        for name in self.learned:
            own = seen.get(name)
            if own is None:
                plates = self.model[name].plate_shape
                self.gaps[name] = np.zeros((self.steps, *plates), dtype=bool)
            elif own.mask is not None:
                self.gaps[name] = own.mask
        read = {
            p.removesuffix(PREVIOUS)
            for level in (dbn.template.first, dbn.template.later)
            for declared in level.values()
            for p in declared.parents
        }
        self.leaves = frozenset(n for n in self.gaps if n not in read)

    def tables(self) -> dict[str, np.ndarray]:
        """The tables as they are declared."""
        template, found = self.dbn.template, {}
        for name in self.learned:
            found[name] = np.array(template.later[name].probs)
            first = template.first.get(name)
            if first is not None and first.source == "table":
                found[name + INITIAL] = np.array(first.probs)
        return found

    def filled(self, tables: Mapping[str, np.ndarray]) -> DynamicBayesNet:
        """The template with other tables."""
        own = self.dbn.template

        def put(declared: Mapping[str, Declaration], suffix: str) -> dict[str, Declaration]:
            return {
                n: replace(d, probs=tables[n + suffix]) if n + suffix in tables else d
                for n, d in declared.items()
            }

        other = self.dbn.copy()
        other._store = SliceStore(
            replace(own, later=put(own.later, ""), first=put(own.first, INITIAL))
        )
        return other

    def expected(self, tables: Mapping[str, np.ndarray]) -> tuple[float, Mapping[str, np.ndarray]]:
        """The log likelihood of the series, and the expected count of every entry."""
        dbn = self.filled(tables)
        problem = pose_series(dbn, self.data, self.inputs)
        problem.cache[UNCOMPARED] = True
        smoothed = self.engine.smooth(problem, np.random.SeedSequence(0))
        slices = _Slices(self, dbn, smoothed)
        counts: dict[str, np.ndarray] = {}
        for name in self.learned:
            counts[name] = slices.counts(name, tables[name].shape)
            if name + INITIAL in tables:
                counts[name + INITIAL] = slices.initial(name, tables[name + INITIAL].shape)
        return float(np.sum(smoothed.log_marginal_likelihood)), counts


# ---- private ------------------------------------------------------------------------------------


class _Slices:
    """A smoothed series, asked for counts of families."""

    def __init__(self, owner: SeriesCounts, dbn: DynamicBayesNet, smoothed: Any) -> None:
        self.owner, self.dbn, self.smoothed = owner, dbn, smoothed
        self._unrolled: Any = None

    def counts(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """Of a node given its parents in later slices (in all, where slice 0 has no table of its own)."""
        template = self.owner.dbn.template
        parents = template.later[name].parents
        first = 1 if name in template.first else 0
        if any(p == TIME or p in template.static for p in parents):
            raise UnsupportedError(
                f"fit: the table of {name!r} reads time or static nodes; tables that do are not learned"
            )
        own = self.owner.model[name]
        if parents == (name + PREVIOUS,):
            try:
                pairs = self.smoothed.pairs(name)
                return pairs.reshape(-1, *shape).sum(axis=0)
            except QueryError:
                pass  # observed, say
        if not any(p.endswith(PREVIOUS) for p in parents):
            joint = self._within((*parents, name))[first:]
            return joint.reshape(-1, *shape).sum(axis=0)
        if own.plates:
            raise UnsupportedError(
                f"fit: the table of {name!r} has plates and reads {parents}; in plates tables are "
                "learned that read "
                "their own slice, or their own value in the one before"
            )
        return self._at_once((*parents, name)).reshape(shape)

    def initial(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """Of the table of slice 0."""
        parents = self.owner.dbn.template.first[name].parents
        return self._within((*parents, name))[:1].reshape(-1, *shape).sum(axis=0)

    def _within(self, names: tuple[str, ...]) -> np.ndarray:
        """Joint tables of nodes of one slice, time first."""
        states = [self.owner.model[n].domain.states for n in names]  # type: ignore[union-attr]
        plates = self.owner.model[names[-1]].plates
        if any(self.owner.model[n].plates != plates for n in names):
            raise UnsupportedError(
                f"fit: the table of {names[-1]!r} reads nodes in other plates than its own; such "
                "tables are not learned"
            )
        if names[-1] in self.owner.leaves:
            return self._of_leaf(names)
        if len(names) == 1:
            return self.smoothed.probabilities(names[0])

        def joint(*values: Any) -> np.ndarray:
            total: Any = 1.0
            for k, (value, own) in enumerate(zip(values, states, strict=True)):
                hot = np.stack([np.asarray(value == s, dtype=float) for s in own], axis=-1)
                lead = hot.ndim - 1
                total = total * hot.reshape(
                    *hot.shape[:lead], *(1,) * k, hot.shape[-1], *(1,) * (len(names) - 1 - k)
                )
            return total

        # a function with the nodes' own names as arguments, as queries read them
        joint.__signature__ = _signature(names)  # type: ignore[attr-defined]
        return self.smoothed.expectation(joint)

    def _of_leaf(self, names: tuple[str, ...]) -> np.ndarray:
        """The same of a node that nobody reads: where it is missing the likelihood does not read its table.

        Such an entry is left out of the complete data, and nothing is counted.
        """
        own = self.smoothed.probabilities(names[-1])
        own = own * self.owner.gaps[names[-1]][..., None]
        if len(names) == 1:
            return own
        above = self._within(names[:-1])
        return above[..., None] * own.reshape(
            *own.shape[:-1], *(1,) * (len(names) - 1), own.shape[-1]
        )

    def _at_once(self, names: tuple[str, ...]) -> np.ndarray:
        """Sums of joint tables over pairs of slices, from the exact posterior of all slices."""
        if self._unrolled is None:
            self._unrolled = infer(
                self.dbn, self.owner.data, inputs=self.owner.inputs, engine=Exact()
            )
        total: Any = 0.0
        for t in range(1, self.owner.steps):
            rows = [
                f"{n.removesuffix(PREVIOUS)}[{t - 1}]" if n.endswith(PREVIOUS) else f"{n}[{t}]"
                for n in names
            ]
            total = total + self._unrolled.probabilities(*rows)
        return np.asarray(total)


def _signature(names: Sequence[str]) -> Any:
    kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
    return inspect.Signature([inspect.Parameter(n, kind) for n in names])
