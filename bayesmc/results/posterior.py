"""``Posterior``: the answers to a question, the same queries whatever engine made it.

What is common stands here: names, numbers of states, tables of figures, the snapshot. How an answer
comes about (from draws, from sums, from exact tables) is each subclass's own affair.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from bayesmc.errors import QueryError, UnknownNodeError, UnsupportedError, did_you_mean
from bayesmc.network import CompiledNode, Problem
from bayesmc.network.captured import check_captured
from bayesmc.network.fingerprint import fingerprint
from bayesmc.results.assessed import Assessed
from bayesmc.results.dataframes import Framed
from bayesmc.results.laws import Laws, TableLaws
from bayesmc.results.marginal import Marginal
from bayesmc.results.marginal_answers import MarginalAnswers
from bayesmc.results.over_time import expanded, take_templates, without_functions
from bayesmc.results.query import Query
from bayesmc.results.saving import save
from bayesmc.results.shown import posterior_html
from bayesmc.results.table import Summary, row_names, shown_rows

Plates = str | Sequence[str]
_QUANTILES = (0.05, 0.5, 0.95)


def quantile_levels(name: str, q: Any) -> np.ndarray:
    """The levels of asked quantiles as floats between 0 and 1."""
    try:
        levels = np.asarray(q, dtype=float)
    except (TypeError, ValueError):
        raise QueryError(
            f"quantile({name!r}, {q!r}): quantiles are numbers between 0 and 1; give one or an array of them"
        ) from None
    if not ((levels >= 0) & (levels <= 1)).all():
        raise QueryError(f"quantile({name!r}, {q!r}): quantiles lie between 0 and 1")
    return levels


@take_templates
class Posterior(Assessed, MarginalAnswers, Framed):
    """Answers about the nodes of a net given evidence.

    Attributes
    ----------
    engine : object
        The engine's options.
    log_marginal_likelihood : float or None
        Log probability (density) of the evidence.
    log_marginal_likelihood_mcse : float or None
        Its Monte Carlo standard error; 0 where exact.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet()
    >>> net.add("die", bmc.DiscreteUniform(1, 6))
    >>> net.add("odd", lambda die: die % 2 == 1)
    >>> posterior = bmc.infer(net)
    >>> high = posterior.probability(lambda die, odd: odd & (die > 1))
    >>> float(posterior.mean("die").round(6)), float(high.round(6))
    (3.5, 0.333333)
    """

    log_marginal_likelihood: float | None = None
    log_marginal_likelihood_mcse: float | None = None
    #: inputs of the question, where the problem is lost
    _known: Mapping[str, np.ndarray] = MappingProxyType({})
    #: importance weights normalised to sum to 1, shape (chain, draw); None where uniform or exact
    weights: np.ndarray | None = None
    log_weights: np.ndarray | None = None
    weight_ess: float | None = None
    pareto_k: float | None = None

    def __init_subclass__(cls, **options: Any) -> None:
        """Answers about one node take a template's node, too: all its slices, stacked (``over_time``)."""
        super().__init_subclass__(**options)
        take_templates(cls)

    def __init__(self, problem: Problem, engine: Any) -> None:
        self.problem: Problem | None = problem
        self.model = problem.model
        self.engine = engine
        self._seen = dict(problem.observed)
        self._observed = frozenset(n for n, o in self._seen.items() if o.mask is None)

    # ---- what every subclass answers ---------------------------------------------------------

    def mean(self, name: str) -> np.ndarray:
        """Posterior mean, shape ``(*plates, *event)``; circular for angles; labels have none."""
        raise NotImplementedError

    def var(self, name: str) -> np.ndarray:
        """Posterior variance of every scalar, shape ``(*plates, *event)``.

        For angles ``-2 log R``, with R the mean resultant length, so that ``std`` is the circular one.
        """
        raise NotImplementedError

    def std(self, name: str) -> np.ndarray:
        """Posterior standard deviation, shape ``(*plates, *event)``."""
        return np.sqrt(self.var(name))

    def cov(self, *names: str) -> np.ndarray:
        """Covariance matrix of all scalars of the named nodes, in order; of one scalar, its variance."""
        raise self._cannot("cov")

    def quantile(self, name: str, q: Any) -> np.ndarray:
        """Posterior quantiles, shape ``(*q.shape, *plates, *event)``."""
        raise self._cannot("quantile")

    def relabelled(self, by: str) -> Posterior:
        """The same draws with components named by the order of a node; only chains of draws can."""
        raise UnsupportedError(
            f"relabelled({by!r}): {type(self).__name__} keeps no chains whose draws could be put in order; "
            "ask an engine of chains, as engine=Gibbs(draws), or sort in the query, as "
            f"expectation(lambda {by}: numpy.sort({by}, axis=-1)) does"
        )

    def probabilities(self, *names: str) -> np.ndarray:
        """Probabilities of the states: ``(*plates, states)``, or the joint table of several nodes."""
        raise self._cannot("probabilities")

    def expectation(
        self,
        function: Callable[..., Any] | str,
        plates: Plates = (),
        names: Mapping[str, str] | None = None,
    ) -> np.ndarray:
        """Posterior expectation of a function whose arguments name nodes.

        Parameters
        ----------
        function : callable
            Receives ``(*batch, *plates, *event)`` of each node and keeps the batch axes.
        plates : str or sequence of str
            Hand the function what a node in these plates would receive.
        names : dict, optional
            Argument -> node, where a node's name is no identifier.
        """
        return self._averaged(Query(self.model, function, plates, names))

    def probability(
        self,
        function: Callable[..., Any],
        plates: Plates = (),
        names: Mapping[str, str] | None = None,
    ) -> np.ndarray:
        """Posterior probability of an event: a function of named nodes that returns booleans."""
        return self._averaged(Query(self.model, function, plates, names, is_event=True))

    def marginal(self, name: str, index: Any = ()) -> Marginal:
        """The marginal of a node (or of one scalar of it): histogram, kernel density, table."""
        raise self._cannot("marginal")

    def resample(self, draws: int | None = None, rng: Any = None) -> Posterior:
        """A posterior of equally weighted draws."""
        raise self._cannot("resample")

    def mcse(
        self, what: Any, plates: Plates = (), names: Mapping[str, str] | None = None
    ) -> np.ndarray:
        """Monte Carlo standard error of the mean of a node (of each state's probability, for labels)
        or of the expectation of a function, with ``plates`` and ``names`` as there.

        Of a share (a state's probability, an event) it is never 0 unless the answer is exact: what no draw
        has shown may have a probability of some draws' (``diagnostics.share_mcse``), so that two errors about
        a share of independent draws hold the truth 95 times in 100.
        """
        return self._mcse(self._asked(what, plates, names))

    def ess(
        self, what: Any, plates: Plates = (), names: Mapping[str, str] | None = None
    ) -> np.ndarray:
        """Effective number of independent draws behind the mean of a node or function."""
        return self._ess(self._asked(what, plates, names))

    def rhat(
        self, what: Any, plates: Plates = (), names: Mapping[str, str] | None = None
    ) -> np.ndarray:
        """Split R-hat across chains (NaN where draws are independent)."""
        return self._rhat(self._asked(what, plates, names))

    def __getitem__(self, name: str) -> np.ndarray:
        """Raw draws, shape ``(chain, draw, *plates, *event)``: unweighted, also where weights matter."""
        raise self._cannot("raw draws")

    def predict(
        self,
        names: str | Sequence[str],
        inputs: Mapping[str, Any] | None = None,
        plates: Mapping[str, int] | None = None,
        rng: Any = None,
        draws: int | None = None,
    ) -> Posterior:
        """Posterior predictive: ``names`` drawn anew given the posterior draws of everything else."""
        raise self._cannot("predict")

    def to_datatree(self, resample: int | None = None, rng: Any = None, **groups: Any) -> Any:
        """The draws as an ArviZ ``DataTree`` (extra ``arviz``), with the groups that PyMC writes.

        Always ``posterior``, and where there are some ``sample_stats``, ``observed_data``, ``constant_data``
        (inputs); dimensions are plates with their labels, ``time`` for slices. ``resample`` draws are made of
        weighted or exact answers. ``groups`` ask for more:

        ``log_likelihood=True`` has it point by point, for ``arviz_stats.loo``; ``predictive=True`` (or what
        ``predict`` returned) ``posterior_predictive``; ``prior=`` (of ``prior_predict``) ``prior`` and
        ``prior_predictive``; ``predictions=`` (of ``predict`` with new inputs) a group of that name.
        """
        raise self._cannot("to_datatree")

    def check(self, draws: int = 4000, rng: Any = None) -> Any:
        """Whether a deterministic approximation can be trusted; only posteriors of such engines answer."""
        raise UnsupportedError(
            f"check: {type(self).__name__} is no deterministic approximation, whose bias it tells; of draws "
            "ask mcse, ess, rhat and pareto_k"
        )

    # ---- what a posterior of its own kind knows of a node, by name, or of a query ----------------

    def _laws(self, name: str) -> Laws:
        node = self._node(name)
        if node.domain is None or node.event_shape:
            raise self._cannot(f"hdi, mode, cdf and entropy of {name!r}")
        numbers = None if _is_labelled(node) else np.asarray(node.domain.numbers, dtype=float)
        return TableLaws(self.probabilities(name), numbers, name)

    def _averaged(self, query: Query) -> np.ndarray:
        raise self._cannot("probability" if query.is_event else "expectation")

    def _mcse(self, what: str | Query) -> np.ndarray:
        raise self._cannot("mcse")

    def _ess(self, what: str | Query) -> np.ndarray:
        raise self._cannot("ess")

    def _rhat(self, what: str | Query) -> np.ndarray:
        raise self._cannot("rhat")

    # ---- shared ------------------------------------------------------------------------------

    @property
    def names(self) -> tuple[str, ...]:
        """Nodes that can be asked about."""
        return tuple(n for n, c in self.model.nodes.items() if c.kind != "input")

    def _asked(self, what: Any, plates: Plates, names: Mapping[str, str] | None) -> Any:
        """A function as a query; a node by its name."""
        is_query = callable(what) or plates or names
        return Query(self.model, what, plates, names) if is_query else what

    def summary(self, names: Sequence[str] | None = None) -> Summary:
        """Mean, sd, quantiles, Monte Carlo error, ESS and R-hat per scalar; probabilities per label.

        By default of all that was not observed; of nodes that are named the elements that were, too.
        """
        free = [n for n in self.names if self._is_free(n)]
        chosen = expanded(self.model, names) if names is not None else free
        labels: list[str] = []
        parts: dict[str, list[np.ndarray]] = {}
        for name in chosen:
            node = self._node(name)
            kept = shown_rows(node, self._seen.get(name) if names is None else None)
            for key, values in self._figures(name).items():
                parts.setdefault(key, []).append(np.asarray(values, dtype=float).ravel()[kept])
            labels.extend(itertools.compress(row_names(node, self.model.labels), kept))
        columns = {key: np.concatenate(values) for key, values in parts.items()}
        return Summary(tuple(labels), columns, self._title())

    def _figures(self, name: str) -> dict[str, np.ndarray]:
        """Columns of the summary for one node, each of the node's shape (and states, for labels)."""
        node = self._node(name)
        if _is_labelled(node):
            p = self.probabilities(name)
            nan = np.full(p.shape, np.nan)
            columns = {"mean": p, "sd": np.sqrt(np.maximum(p * (1 - p), 0.0))}
            columns.update(dict.fromkeys(self._quantile_names(), nan))
        else:
            columns = {"mean": self.mean(name), "sd": self.std(name)}
            columns.update(self._quantile_columns(name))
        columns["mcse"] = self.mcse(name)
        columns["ess"] = np.broadcast_to(self.ess(name), columns["mean"].shape)
        columns["rhat"] = np.broadcast_to(self.rhat(name), columns["mean"].shape)
        return columns

    def _quantile_columns(self, name: str) -> dict[str, np.ndarray]:
        values = self.quantile(name, list(_QUANTILES))
        return dict(zip(self._quantile_names(), values, strict=True))

    @staticmethod
    def _quantile_names() -> list[str]:
        return [f"{100 * q:g}%" for q in _QUANTILES]

    def _title(self) -> str:
        return type(self.engine).__name__

    def _node(self, name: str) -> CompiledNode:
        if callable(name):
            raise UnknownNodeError(
                "posterior: a function is asked for with expectation, probability, mcse, ess or rhat"
            )
        node = self.model.nodes.get(name) if isinstance(name, str) else None
        if node is None:
            known = list(self.model.nodes)
            raise UnknownNodeError(
                f"posterior: no node {name!r}{did_you_mean(name, known)}; its nodes are "
                f"{', '.join(known[:12])}"
            )
        return node

    def _numeric(self, name: str, what: str) -> CompiledNode:
        node = self._node(name)
        if _is_labelled(node):
            assert node.domain is not None
            raise UnsupportedError(
                f"{what}({name!r}): the states {node.domain.states} are labels and have no {what}; use "
                f"probabilities({name!r})"
            )
        return node

    def _finite(self, name: str) -> CompiledNode:
        node = self._node(name)
        if node.domain is None:
            raise UnsupportedError(
                f"probabilities({name!r}): the node has no finite set of states; use "
                f"probability(lambda {name}: ...), mean or quantile"
            )
        return node

    def _is_free(self, name: str) -> bool:
        return self.model.nodes[name].kind != "fixed" and name not in self._observed

    def _live(self, what: str) -> Problem:
        if self.problem is None:
            lost = [n for n, c in self.model.nodes.items() if c.declaration.source == "function"]
            shown = ", ".join(map(repr, lost[:6])) + (", ..." if len(lost) > 6 else "")
            raise UnsupportedError(
                f"{what}: this posterior was loaded or unpickled, and files and pickles carry no functions; "
                f"it misses those of the nodes {shown}: {self._reload()}"
            )
        model = self.problem.model
        check_captured(node.declaration for node in model.nodes.values())
        check_captured((potential for potential, _ in model.potentials.values()), "factor")
        return self.problem

    def _reload(self) -> str:
        """How to have the functions again."""
        return "bmc.load(path, net=net) has them again, or declare the net and call infer again"

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write it to a file that ``bmc.load`` reads, and ArviZ and xarray, too.

        It is NetCDF-4 (the extra ``netcdf``). Draws are under ``posterior``, weighted ones under
        ``weighted_posterior``; of answers without draws, means, variances and probabilities under
        ``answers``. The file takes the place of another one at once or not at all. Functions stay out.

        Parameters
        ----------
        path : path

        Raises
        ------
        MissingExtraError
        CheckpointError
            The disk is full, or may not be written.

        Examples
        --------
        >>> import bayesmc as bmc
        >>> net = bmc.BayesNet()
        >>> net.add("die", bmc.DiscreteUniform(1, 6))
        >>> bmc.infer(net).save("die.nc")  # doctest: +SKIP
        >>> bmc.load("die.nc").mean("die")  # doctest: +SKIP
        3.5
        """
        problem = self.problem
        save(self, path, None if problem is None else {"fingerprint": fingerprint(problem.model)})

    def bind(self, problem: Problem) -> None:
        """Answer with the functions of a problem again, which a file or a pickle carries none of."""
        self.problem, self.model = problem, problem.model

    def _cannot(self, what: str) -> UnsupportedError:
        return UnsupportedError(
            f"{what}: {type(self).__name__} cannot answer this; {self._remedy()}"
        )

    def _remedy(self) -> str:
        return "draw from it with resample(draws)"

    def __getstate__(self) -> dict[str, Any]:
        """Pickles travel without the model's functions."""
        inputs = self.problem.inputs if self.problem is not None else self._known
        bare = without_functions(self.model)
        return {**self.__dict__, "problem": None, "model": bare, "_known": inputs}

    def __copy__(self) -> Posterior:
        """A posterior is never changed; copied like a pickle it would lose its functions."""
        return self

    def __deepcopy__(self, memo: Any) -> Posterior:
        return self

    def _repr_html_(self) -> str:
        """As notebooks show it: the engine, the evidence, and the summary, where there is one."""
        return posterior_html(self)

    def __repr__(self) -> str:
        return f"{type(self).__name__}(engine={self.engine!r}, nodes={len(self.names)})"


def whole_draws(draws: Any) -> int:
    """A number of draws to resample, checked."""
    if isinstance(draws, bool) or not isinstance(draws, (int, np.integer)) or draws < 1:
        raise ValueError(f"resample(draws={draws!r}): draws is a whole number, 1 or more")
    return int(draws)


def _is_labelled(node: CompiledNode) -> bool:
    return node.domain is not None and node.domain.labels is not None
