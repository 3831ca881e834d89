"""Posteriors from Markov chains: draws or sums that know their chains, and where to go on from.

How a chain moves is the engines' affair; here stands what is asked of its draws. Figures for chains whose
every draw comes from the next member of an ensemble are taken over blocks of one draw per member.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np

from bayesmc.distributions import marking_invalid
from bayesmc.errors import BayesmcError, UnsupportedError
from bayesmc.network import CompiledNode, Model, Observed, Problem
from bayesmc.results.draws import DrawsPosterior
from bayesmc.results.posterior import Posterior
from bayesmc.results.relabelling import ordered, symmetries
from bayesmc.results.sums import RunningChains, SumsPosterior


class _Chains(Posterior):
    """What a posterior from Markov chains tells besides."""

    #: block of nodes -> share of accepted proposals since the warmup, shape (chain,)
    acceptance: dict[str, np.ndarray]
    #: members that a chain's draws come from in turn; 1 for an ordinary chain
    ensemble_size: int
    #: groups of consecutive chains, many and short, that started as one: between these R-hat compares (the
    #: nested one); 0 where every chain is judged by itself
    superchains: int = 0
    #: sweeps before the first draw, during which the engine adapted
    warmup: int
    checkpoint: Checkpoint | None
    #: finite node -> how often the hidden numbers below each element were drawn anew with it, at the least
    #: as often as chains started, shape (*plates,); only nodes that may wait for such numbers
    renewals: Mapping[str, np.ndarray] = MappingProxyType({})
    #: draws whose Hamiltonian trajectory diverged, shape (chain, draw); None without such, or without draws
    divergences: np.ndarray | None = None
    #: energy (minus log density, with momenta) of each draw's Hamiltonian trajectory, shape (chain, draw);
    #: None without such, or where several kernels make some
    energies: np.ndarray | None = None
    #: a sentence where chains name components differently that the model does not tell apart
    label_switching: str | None = None

    def _describe(
        self,
        shape: tuple[int, int],
        acceptance: Mapping[str, np.ndarray],
        ensemble_size: int,
        warmup: int,
        checkpoint: Checkpoint | None,
    ) -> None:
        self._chains_and_draws = shape
        self.acceptance = dict(acceptance)
        self.ensemble_size = ensemble_size
        self.warmup = warmup
        self.checkpoint = checkpoint

    def _renewed(self, nodes: Iterable[str]) -> dict[str, np.ndarray]:
        """Renewals of some nodes, or of those that they are computed from."""
        model, own = self.model, self.renewals
        above = model.above(nodes, lambda n: n not in own and model[n].kind == "deterministic")
        return {n: own[n] for n in above if n in own}

    def _title(self) -> str:
        chains, draws = self._chains_and_draws
        many = f"{chains} chain{'s' if chains > 1 else ''} of {draws} draws"
        title = f"{super()._title()}: {many} after {self.warmup} of warmup"
        return f"{title}\n{self.label_switching}" if self.label_switching else title

    def _reload(self) -> str:
        if self.checkpoint is None:
            return super()._reload()
        return "declare the net and call infer again (resume= this posterior adds to its draws)"

    def __getstate__(self) -> dict[str, Any]:
        state = super().__getstate__()
        if self.checkpoint is not None and self.problem is not None:
            state["checkpoint"] = self.checkpoint.noted(self.problem)
        return state


class ChainsPosterior(_Chains, DrawsPosterior):
    """Draws of Markov chains, shape ``(chain, draw, *plates, *event)``.

    Parameters
    ----------
    acceptance : dict
        Block of nodes -> acceptance rate since the warmup, shape (chain,); none where all is exact.
    ensemble_size : int
        Members that a chain's draws come from in turn.
    warmup : int
    checkpoint : Checkpoint, optional
        What ``resume`` needs.

    Notes
    -----
    With an ensemble, neighbouring draws are nearly independent while those ``ensemble_size`` apart are
    not, so errors, effective sizes and R-hat are those of block means (``diagnostics.chain_statistic``).
    """

    def __init__(
        self,
        problem: Problem,
        engine: Any,
        stored: Mapping[str, np.ndarray],
        shape: tuple[int, int],
        acceptance: Mapping[str, np.ndarray] | None = None,
        ensemble_size: int = 1,
        warmup: int = 0,
        checkpoint: Checkpoint | None = None,
    ) -> None:
        super().__init__(problem, engine, stored, shape)
        self._describe(shape, acceptance or {}, ensemble_size, warmup, checkpoint)

    def relabelled(self, by: str) -> ChainsPosterior:
        """The same draws with components named by the order of a node, draw by draw.

        A model that does not tell its components apart leaves chains free to name them differently. What
        is asked of the answer here is about the component with the smallest value of ``by``, the next, and
        so on. Nodes that are computed from others are computed again, and left out where ``keep=`` left out
        what they are computed from.

        Parameters
        ----------
        by : str
            A node with one number for each component, as ``label_switching`` names it.

        Raises
        ------
        UnsupportedError
            The components are told apart by the model or its evidence, or ``by`` has no number for each.

        References
        ----------
        Stephens (2000), Dealing with label switching in mixture models, JRSS B 62, sec. 2.

        Examples
        --------
        >>> import numpy as np
        >>> import bayesmc as bmc
        >>> net = bmc.BayesNet(plates={"cluster": 2, "point": 6})
        >>> net.add("mean", bmc.Normal(0.0, 10.0), plates="cluster")
        >>> net.add("label", bmc.Bernoulli(0.5), plates="point")
        >>> net.add("x", lambda label, mean: bmc.Normal(mean[label], 1.0), plates="point")
        >>> data = {"x": [-3.2, -2.8, -3.0, 1.8, 2.2, 2.0]}
        >>> posterior = bmc.infer(net, data, engine=bmc.Gibbs(500, warmup=200), rng=0)
        >>> posterior.relabelled("mean").mean("mean").round()
        array([-3.,  2.])
        """
        self._node(by)
        problem = self._live("relabelled")
        point = None if self.checkpoint is None else self.checkpoint.values
        for found in [] if point is None else symmetries(problem, point):
            if by in found.axes and self.model[by].value_shape == (found.size,):
                twin = copy.copy(self.__dict__)
                new = object.__new__(type(self))
                new.__dict__.update(twin)
                new.__dict__.pop("_slowest", None)
                new._stored = ordered(problem, self._stored, found, by)
                new.checkpoint = new.label_switching = None
                new.renewals = {
                    n: np.full_like(count, count.min(initial=np.inf))
                    for n, count in self.renewals.items()
                }
                return new
        raise UnsupportedError(
            f"relabelled({by!r}): its elements are no components that the model could name otherwise; if "
            "they should be, declare their weights as one Dirichlet with equal concentrations (a Beta and "
            "its complement are not seen to be alike); or order them in the model, "
            f"net.potential('ordered', lambda {by}: np.where({by}[0] < {by}[1], 0.0, -np.inf))"
        )

    def _behind_still(self, what: Any, values: np.ndarray) -> Any:
        """Those of the slowest scalar that moved, or renewals, where these are fewer."""
        if isinstance(what, str) and what in self.renewals:
            count = self.renewals[what]
            shape = count.shape + (1,) * (values.ndim - 2 - count.ndim)
            return np.minimum(self._slowest, count.reshape(shape))
        fewest = self._slowest
        nodes = [what] if isinstance(what, str) else what.nodes
        for name, count in self._renewed(nodes).items():
            stored = self._of(name)
            still = (stored == stored[:1, :1]).reshape(*self._shape, *count.shape, -1)
            still = still.all(axis=(0, 1, -1))
            fewest = min(fewest, count[still].min(initial=np.inf))
        return fewest

    def _predict(self, *arguments: Any) -> DrawsPosterior:
        drawn = super()._predict(*arguments)
        assert drawn.problem is not None
        found = ChainsPosterior(
            drawn.problem,
            self.engine,
            drawn._stored,
            self._shape,
            self.acceptance,
            self.ensemble_size,
            self.warmup,
        )
        found.superchains = self.superchains
        return found


class ChainsSums(_Chains, SumsPosterior):
    """Means, variances and probabilities of Markov chains, summed as they went.

    Monte Carlo errors come from batch means, never below those of independent draws, and effective sizes
    from the errors; R-hat compares halves of the chains by their batch means, without ranks. They are NaN
    with fewer than four batches, and for nodes of very many numbers.

    References
    ----------
    Flegal and Jones (2010), Annals of Statistics 38(2).
    """

    def __init__(
        self,
        problem: Problem,
        engine: Any,
        running: RunningChains,
        acceptance: Mapping[str, np.ndarray],
        warmup: int,
        checkpoint: Checkpoint,
    ) -> None:
        super().__init__(problem, engine, running.total(), False)
        self._running = running
        shape = (running.chains, running.draws)
        self._describe(shape, acceptance, running.ensemble, warmup, checkpoint)

    def _error(self, what: Any) -> np.ndarray:
        independent = super()._error(what)
        series = self._batch_means(what)
        if series is None:
            return np.where(independent == 0, 0.0, np.nan)
        batches, chains = series.shape[:2]
        error = np.sqrt(series.var(axis=(0, 1), ddof=1) / (batches * chains))
        return np.maximum(error, independent)

    def _share_count(self, what: str, error: np.ndarray) -> Any:
        """Effective draws behind shares; of those that never changed, of the slowest scalar that did."""
        found = self._moved(what)
        return np.where(np.isnan(found), self._behind_still(what, found), found)

    def _behind_still(self, what: str, figures: np.ndarray) -> Any:
        """Those of the slowest scalar that moved, or renewals, where these are fewer."""
        if what in self.renewals:
            count = self.renewals[what]
            shape = count.shape + (1,) * (figures.ndim - count.ndim)
            return np.minimum(self._slowest, count.reshape(shape))
        fewest = [c.min(initial=np.inf) for c in self._renewed([what]).values()]
        return min([self._slowest, *fewest])

    def _ess(self, what: Any) -> np.ndarray:
        found = self._moved(what)
        behind = self._behind_still(what, found)
        still = np.where(np.asarray(self._step(what)) > 0, behind, self._sums.draws)
        missing = np.isnan(self._error(what))
        return np.where(np.isnan(found) & ~missing, still, found)

    def moves(self, name: str) -> np.ndarray:
        """Whether each figure of a node ever changed, as far as is known."""
        return self._error(name) != 0

    def _moved(self, what: Any) -> np.ndarray:
        """Effective draws of what ever changed; NaN for all else."""
        error, independent = self._error(what), super()._error(what)
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.where(independent > 0, independent / error, np.nan)
        return self._sums.draws * share**2

    @cached_property
    def _slowest(self) -> float:
        """Effective draws of the scalar that moves slowest in these chains; the chains where none does."""
        names = [n for n in self._running.names if self._running.is_batched(n)]
        sizes = np.concatenate([np.zeros(0), *(self._moved(n).ravel() for n in names)])
        sizes = sizes[np.isfinite(sizes)]
        return float(sizes.min()) if sizes.size else float(self._running.chains)

    def _rhat(self, what: Any) -> np.ndarray:
        variance = self._sums.draws * super()._error(what) ** 2
        series = self._batch_means(what)
        if series is None:
            return np.full(variance.shape, np.nan)
        half = len(series) // 2
        means = np.concatenate([series[:half].mean(axis=0), series[-half:].mean(axis=0)])
        within = variance - means.var(axis=0)
        draws = self._running.draws / 2
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = means.var(axis=0, ddof=1) / np.where(within > 1e-12 * variance, within, 0.0)
            rhat = np.sqrt((draws - 1) / draws + ratio)
        return np.where(variance > 0, rhat, np.nan)

    def _batch_means(self, name: str) -> np.ndarray | None:
        """Means of batches, shape ``(batch, chain, *figure)``, of what the node's mean errs like."""
        series = self._running.batch_means(name)
        if series is None or len(series) < 4:
            return None
        node = self._node(name)
        shape = series.shape[:2] + node.value_shape
        if node.angles is not None:
            first, sine = np.moveaxis(series, 2, 0)
            mean, turns = self.mean(name), self._sums.turns(name)[0, :2] / self._sums.weight[0]
            with np.errstate(divide="ignore", invalid="ignore"):  # where numbers are no angles
                turned = (sine * np.cos(mean) - first * np.sin(mean)) / np.hypot(*turns)
            return np.where(node.angles, turned, first)
        labelled = node.domain is not None and node.domain.labels is not None
        return series.reshape((*shape, -1) if labelled else shape)

    def bind(self, problem: Problem) -> None:
        super().bind(problem)
        self._running._sums.model = problem.model

    def __getstate__(self) -> dict[str, Any]:
        state = super().__getstate__()
        return {**state, "_running": self._running.with_model(state["model"])}


# ---- private ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """Where chains stand after their last kept draw, to go on from.

    Attributes
    ----------
    state : dict
        The sampler's state.
    generator : dict
        State of the bit generator.
    values : dict
        Stored values of the last draw.
    observed : dict
        The evidence, as stored.
    densities : dict or None
        Node or potential -> its log density at ``values`` (a deterministic node's sum) when the draws
        were made, so that a function that says something else by now is noticed.
    """

    state: Mapping[str, Any]
    generator: Mapping[str, Any]
    values: Mapping[str, np.ndarray]
    observed: Mapping[str, Observed]
    densities: Mapping[str, float] | None = None

    def noted(self, problem: Problem) -> Checkpoint:
        """The same with its densities under a problem, if they are not known."""
        if self.densities is not None:
            return self
        return replace(self, densities=noted_densities(problem, self.values))

    def fits(self, model: Model, problem: Problem) -> bool:
        """Whether it belongs to this question, though the functions of its ``model`` are lost."""
        if list(model.nodes) != list(problem.model.nodes) or model.sizes != problem.model.sizes:
            return False
        if any(outline(node) != outline(problem.model[n]) for n, node in model.nodes.items()):
            return False
        seen = problem.observed
        if self.observed.keys() != seen.keys() or not all(
            np.array_equal(o.value, seen[n].value) and np.array_equal(o.mask, seen[n].mask)  # type: ignore[arg-type]
            for n, o in self.observed.items()
        ):
            return False
        return (
            self.densities is not None
            and other_density(problem, self.values, self.densities) is None
        )


def outline(node: CompiledNode) -> tuple[Any, ...]:
    """What can be compared of a node whose function is lost."""
    arrays = (node.declaration.probs, node.declaration.value)
    tables = tuple(None if a is None else (a.shape, a.tobytes()) for a in arrays)
    states = None if node.domain is None else node.domain.states
    return (node.kind, node.parents, node.plates, node.value_shape, states, *tables)


def log_densities(problem: Problem, values: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Log density of every node and potential at some draws, summed; a deterministic node's values."""
    model = problem.model
    at = {**problem.inputs, **values}
    found = {name: float(np.sum(value)) for name, value in problem.inputs.items()}
    with marking_invalid(), np.errstate(all="ignore"):
        for name, node in model.nodes.items():
            if node.is_stochastic and node.declaration.source in ("function", "table"):
                given, _ = model.evaluate(name, at)
                found[name] = float(np.sum(model.log_density(name, given, at[name])))
            elif node.kind == "deterministic":
                found[name] = float(np.sum(model.evaluate(name, at)[0], dtype=float))
        for name in model.potentials:
            found[f"potential {name}"] = float(np.sum(model.potential(name, at)))
    return found


def noted_densities(problem: Problem, values: Mapping[str, np.ndarray]) -> dict[str, float] | None:
    """``log_densities``, to be held against later; None where a draw has none, at a pole for one."""
    try:
        return log_densities(problem, values)
    except BayesmcError:
        return None


def other_density(
    problem: Problem, values: Mapping[str, np.ndarray], densities: Mapping[str, float]
) -> str | None:
    """The first node or potential whose log density at some draws is another than was noted."""
    now = noted_densities(problem, values) or {}
    for name in dict.fromkeys([*densities, *now]):
        if name not in now or name not in densities:
            return name
        a, b = densities[name], now[name]
        if not (a == b or (a != a and b != b) or math.isclose(a, b, rel_tol=1e-9, abs_tol=1e-9)):
            return name
    return None
