"""Rejection sampling: ancestral draws, kept in proportion to the probability of the evidence."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import numpy as np

from bayesmc.engines.base import Engine
from bayesmc.engines.forward import CHUNK, chunk_sizes, fast_steps
from bayesmc.engines.weighted.bounds import Bounded, log_bounds, total_log_bound
from bayesmc.engines.weighted.drawing import Kept, check_count, no_memory, passes, treatment
from bayesmc.errors import BudgetError, UnsupportedError, ZeroProbabilityError
from bayesmc.network import Model, Problem
from bayesmc.network.forward import (
    Step,
    potential_factors,
    refuse_noiseless,
    refuse_parts,
    refuse_unsampled,
    whole,
    with_factors,
)
from bayesmc.progress import Progress
from bayesmc.results import DrawsPosterior, Posterior, Sums, SumsPosterior
from bayesmc.workers import in_order

#: draws of the first chunk; later ones double up to the size that all forward engines use, from where on so
#: many chunks are one unit of work
_FIRST, _TOGETHER = 1024, 4


@dataclass(frozen=True, repr=False)
class Rejection(Engine):
    """Independent draws from the exact posterior, all of the same weight.

    Hidden nodes are drawn given their parents, and the draw is accepted with probability p/bound, where p
    is the density of the evidence given the draw and the bound is above it whatever is drawn. For discrete
    evidence that is 1 or the largest entry of a table, so that fewer draws are rejected than by drawing
    the evidence and comparing. For continuous evidence the bound is found where it can be proved: parents
    with finitely many values are all tried, and a Normal, MvNormal, StudentT, Laplace or Cauchy is highest
    at its location if its other parameters do not depend on hidden continuous nodes. Elsewhere it must be
    given.

    Parameters
    ----------
    draws : int
        Accepted draws.
    bound : dict, optional
        Observed node or potential -> the most that the log density of one element (the log factor) can
        be, a number or an array over its plates. A draw above it raises: too low a bound would make the
        answer wrong.
    max_proposals : int
        Draws after which it gives up.

    Raises
    ------
    EnvelopeError
        A draw weighs more than its bound; ``point`` has the parents' values.
    BudgetError, ZeroProbabilityError
        ``max_proposals`` draws were not enough, or none was accepted.

    Notes
    -----
    The posterior has ``proposed``, the number of draws up to the last accepted one, and
    ``acceptance_rate``. The evidence is estimated by inverse binomial sampling: of ``N`` proposals up to
    the n-th acceptance, ``(n - 1) / (N - 1)`` times the bounds is unbiased (not so its log); it takes two
    accepted draws. With the same seed, more draws begin with the same ones.

    References
    ----------
    von Neumann (1951); Koller and Friedman (2009), sec. 12.1; Haldane (1945), Biometrika 33.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet()
    >>> net.add("a", bmc.Bernoulli(0.5))
    >>> net.add("x", lambda a: bmc.Normal(2.0 * a, 1.0))
    >>> posterior = bmc.infer(net, {"x": 1.5}, engine=bmc.Rejection(10_000), rng=0)
    >>> bool(abs(posterior.mean("a") - 0.7311) < 0.02), posterior.weights is None
    (True, True)
    """

    spreads: ClassVar[bool] = True

    draws: int = 1000
    bound: Mapping[str, Any] | None = field(default=None, hash=False)
    max_proposals: int = 10_000_000

    def __post_init__(self) -> None:
        check_count(self, "draws", self.draws, "10_000")
        check_count(self, "max_proposals", self.max_proposals, "10_000_000")
        if self.bound is not None:
            object.__setattr__(self, "bound", _checked_bounds(self.bound))

    def refusal(self, problem: Problem) -> str | None:
        parts = refuse_parts(problem.observed, "Rejection")
        if parts is not None:
            return parts
        reason = refuse_unsampled(problem.model, problem.observed, "Rejection")
        reason = reason or refuse_noiseless(problem.model, whole(problem.observed), "Rejection")
        if reason is not None:
            return reason
        missing = log_bounds(problem, self.bound or {})[1]
        if not missing:
            return None
        name = missing[0]
        what = "the potential" if name in problem.model.potentials else "the density of observed"
        return (
            f"Rejection needs an upper bound on {what} {name!r} whatever the hidden nodes are, and could "
            f"prove none; give bound={{{name!r}: ...}}, the most that its log can be, or use "
            "LikelihoodWeighting(draws), which needs none"
        )

    def describe(self, problem: Problem) -> dict[str, str]:
        found = {name: treatment(problem, name) for name in problem.model.nodes}
        given = self.bound or {}
        for name, bound in log_bounds(problem, given)[0].items():
            if name in found:
                total = total_log_bound(problem, name, bound)
                source = "given" if name in given else "proved"
                partly = problem.observed[name].mask is not None
                found[name] = (
                    f"accepts a draw with probability p/bound (log bound {total:.4g}, {source})"
                    + (", missing elements sampled" if partly else "")
                )
        return found

    def run(
        self,
        problem: Problem,
        seed: np.random.SeedSequence,
        keep: Any = "draws",
        progress: bool | None = None,
        resume: Posterior | None = None,
        executor: Any = None,
    ) -> Posterior:
        if resume is not None:
            raise UnsupportedError(
                "infer: Rejection has nothing to resume; with the same seed, more draws begin with the "
                "same ones"
            )
        names = tuple(n for n, c in problem.model.nodes.items() if c.kind != "input")
        log_bound = self._steps(problem)[1]
        summed = isinstance(keep, str) and keep == "summaries"
        kept = names if isinstance(keep, str) else tuple(keep)
        try:
            held = Sums(problem.model, names) if summed else Kept(problem.model, kept, self.draws)
            with Progress(self.draws, "rejection sampling", progress) as bar:
                shared = {"engine": self, "problem": problem, "seed": seed, "names": held.names}
                units = _units(problem.model, self.max_proposals)
                proposed = self._fill(held, in_order(_unit_tried, shared, units, executor), bar)
        except MemoryError as error:
            raise no_memory(self, self.draws, kept) from error
        return self._posterior(problem, held, proposed, log_bound)

    def _steps(self, problem: Problem) -> tuple[list[Step], float]:
        """Steps that turn weights into probabilities of acceptance, and the sum of all log bounds."""
        model = problem.model
        bounds = {
            name: total_log_bound(problem, name, bound)
            for name, bound in log_bounds(problem, self.bound or {})[0].items()
        }
        for name, bound in bounds.items():
            if bound == -np.inf:
                raise ZeroProbabilityError(
                    f"the evidence has probability zero: {name!r} is impossible whatever its parents are"
                )
        bare = replace(model, potentials={})  # they are bounded, too
        plain = fast_steps(bare, problem.observed, problem.inputs)
        steps: dict[str, Step] = {
            name: Bounded(problem, name, step, bounds[name]) if name in bounds else step
            for name, step in zip(model.nodes, plain, strict=True)
        }
        factors = [
            (needed, Bounded(problem, name, step, bounds[name]))
            for name, (needed, step) in zip(model.potentials, potential_factors(model), strict=True)
        ]
        return with_factors(steps, factors), sum(bounds.values())

    def _fill(self, held: Kept | Sums, units: Iterator[list[Tried]], bar: Progress) -> int:
        """Take accepted draws until there are enough; the number proposed up to the last of them."""
        accepted = proposed = 0
        for tried in (one for unit in units for one in unit):
            count = min(tried.proposed, self.max_proposals - proposed)
            picked = tried.picked[tried.picked < count][: self.draws - accepted]
            if len(picked):
                values = {
                    name: value[: len(picked)] if name in tried.varying else value
                    for name, value in tried.values.items()
                }
                if isinstance(held, Sums):
                    held.add(values, 0.0, len(picked))
                else:
                    held.add(values, len(picked))
            accepted += len(picked)
            bar.advance(len(picked))
            if accepted == self.draws:
                return proposed + int(picked[-1]) + 1
            proposed += count
            if proposed == self.max_proposals:
                break
        raise self._gave_up(accepted)

    def _gave_up(self, accepted: int) -> Exception:
        remedy = (
            "use LikelihoodWeighting(draws), or Exact() where explain(net, evidence) says it can"
        )
        if not accepted:
            return ZeroProbabilityError(
                f"Rejection: none of {self.max_proposals} proposals was accepted, so the evidence has "
                f"probability zero or far too small for this engine; check it, or {remedy}"
            )
        return BudgetError(
            f"Rejection: {self.max_proposals} proposals gave {accepted} of {self.draws} draws (acceptance "
            f"rate {accepted / self.max_proposals:.3g}); {remedy}, or raise max_proposals"
        )

    def _posterior(
        self, problem: Problem, held: Kept | Sums, proposed: int, log_bound: float
    ) -> Posterior:
        posterior: RejectionDraws | RejectionSums
        if isinstance(held, Sums):
            posterior = RejectionSums(problem, self, held, False)
        else:
            for array in held.stored.values():
                array.flags.writeable = False
            posterior = RejectionDraws(
                problem, self, held.stored, (1, self.draws), independent=True
            )
        posterior.proposed = proposed
        posterior.acceptance_rate = self.draws / proposed
        if not (problem.observed or problem.model.potentials):
            posterior.log_marginal_likelihood = posterior.log_marginal_likelihood_mcse = 0.0
        elif self.draws > 1:
            rate = (self.draws - 1) / (proposed - 1)
            posterior.log_marginal_likelihood = float(np.log(rate)) + log_bound
            # with no rejection yet, one may be just ahead: an error of zero would be too sure
            missed = max(1.0 - rate, 1.0 / (proposed + 1))
            error = float(np.sqrt(missed / (rate * max(proposed - 2, 1))))
            posterior.log_marginal_likelihood_mcse = error
        return posterior

    def __repr__(self) -> str:
        bound = None if self.bound is None else dict(self.bound)
        return f"Rejection(draws={self.draws}, bound={bound}, max_proposals={self.max_proposals})"

    def __getstate__(self) -> dict[str, Any]:
        """A mapping proxy cannot be pickled; what it shows can."""
        return {**self.__dict__, "bound": None if self.bound is None else dict(self.bound)}


class _Accepted(Posterior):
    """What a posterior by rejection tells besides."""

    #: draws proposed up to the last one accepted
    proposed: int
    acceptance_rate: float

    def _title(self) -> str:
        accepted = round(self.acceptance_rate * self.proposed)
        return (
            f"{super()._title()}: {accepted} of {self.proposed} proposals accepted "
            f"({100 * self.acceptance_rate:.3g} %)"
        )


class RejectionDraws(_Accepted, DrawsPosterior):
    """Accepted draws, with ``proposed`` and ``acceptance_rate``."""


class RejectionSums(_Accepted, SumsPosterior):
    """Sums of accepted draws, with ``proposed`` and ``acceptance_rate``."""


# ---- private ------------------------------------------------------------------------------------


class Tried(NamedTuple):
    """A chunk of proposed draws.

    Attributes
    ----------
    proposed : int
    picked : ndarray of int
        Which were accepted.
    values : dict
        Stored values of these.
    varying : set of str
        Nodes that have a value for each draw.
    """

    proposed: int
    picked: np.ndarray
    values: dict[str, np.ndarray]
    varying: set[str]


def _units(model: Model, most: int) -> Iterator[tuple[int, list[int]]]:
    """Units of work: the random stream of the first of some chunks, and how many draws each has.

    They do not depend on the draws asked for, so that more begin with the same ones.
    """
    largest = chunk_sizes(model, CHUNK)[0]
    size, number, proposed = min(_FIRST, largest), 0, 0
    while proposed < most:
        sizes = [size] * (_TOGETHER if size == largest else 1)
        yield number, sizes
        number, proposed = number + len(sizes), proposed + sum(sizes)
        size = min(2 * size, largest)


def _unit_tried(shared: Mapping[str, Any], unit: tuple[int, list[int]]) -> list[Tried]:
    """Draws proposed in some chunks, and which of them are accepted."""
    engine, problem, names = shared["engine"], shared["problem"], shared["names"]
    shapes = {n: len(problem.model[n].value_shape) for n in names}
    found = []
    for chunk in passes(
        engine._steps(problem)[0], unit[1], shared["seed"], problem.inputs, unit[0]
    ):
        level = np.broadcast_to(np.exp(chunk.log_weight), chunk.batch)
        picked = np.flatnonzero(chunk.rng.random(chunk.batch) < level)
        varying = {n for n in names if chunk.values[n].ndim > shapes[n]}
        values = {n: chunk.values[n][picked] if n in varying else chunk.values[n] for n in names}
        found.append(Tried(chunk.batch[0], picked, values, varying))
    return found


def _checked_bounds(bound: Any) -> Mapping[str, Any]:
    """A frozen copy: name -> a number, or nested tuples of them, which compare as a whole."""
    if not isinstance(bound, Mapping):
        raise TypeError(
            f"Rejection(bound={bound!r}): give a dict from observed node or potential to log bound"
        )
    checked = {}
    for name, value in bound.items():
        try:
            array = np.asarray(value, dtype=float)
        except (TypeError, ValueError):
            array = np.asarray(np.nan)
        if not np.isfinite(array).all():
            raise ValueError(
                f"Rejection: bound={{{name!r}: {value!r}}}: a log bound is a finite number, or an array "
                "of them over the node's plates"
            )
        checked[name] = _nested(array.tolist())
    return MappingProxyType(checked)


def _nested(value: Any) -> Any:
    return tuple(_nested(v) for v in value) if isinstance(value, list) else value
