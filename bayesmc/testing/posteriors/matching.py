"""Does a posterior match an exact one? Its figures, and its joint draws where asked, in one decision.

Monte Carlo answers are judged by their own standard errors, all comparisons together under a stated
false-alarm rate; answers without Monte Carlo error must agree to a tolerance. What draws say of an average
stands in ``samples``, what a decision is in ``verdict``; where exact answers come from is not known here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any

import numpy as np

from bayesmc.errors import ShapeError, UnknownNodeError, UnsupportedError
from bayesmc.network import Model, Problem
from bayesmc.network.evidence import store
from bayesmc.randomness import seed_sequence
from bayesmc.results.draws import DrawsPosterior
from bayesmc.results.series import SeriesPosterior
from bayesmc.testing.posteriors.figures import (
    MIN_ESS,
    Pair,
    Table,
    asked,
    compare_angles,
    compare_cov,
    compare_mean,
    compare_quantiles,
    compare_states,
    compare_var,
)
from bayesmc.testing.posteriors.samples import Draws, energy_comparison
from bayesmc.testing.posteriors.slices import SlicePosterior
from bayesmc.testing.verdict import NothingToCompare, Verdict, check_level, counted

#: rows of a joint sample below which it is not judged
_MIN_ROWS = 30
#: draws of a user's own from which an effective number can be told
_MIN_OWN = 8


@dataclass(frozen=True, eq=False, repr=False)
class Match(Verdict):
    """What was compared, and what does not match.

    Attributes
    ----------
    remarks : tuple of str
        What could not be compared though it was asked for, and why.
    of_nodes : int
        Comparisons that are about nodes, and not about the evidence.
    """

    remarks: tuple[str, ...] = ()
    of_nodes: int = 0

    def _remarks(self) -> list[str]:
        return [f"  {remark}" for remark in self.remarks]


def compare(
    posterior: Any,
    exact: Any,
    alpha: float = 1e-3,
    *,
    rtol: float = 1e-9,
    min_count: float = 10.0,
    names: Sequence[str] | None = None,
    quantiles: Sequence[float] = (0.05, 0.25, 0.5, 0.75, 0.95),
    draws: int = 0,
    rng: Any = None,
) -> Match:
    """What differs between a posterior and an exact one, and whether chance explains it.

    Compared are the log evidence, the probability of every state of every element of finite nodes, and of
    all other nodes means, variances, quantiles and, of nodes of up to five numbers, covariances; each where
    both can answer. With ``draws``, joint draws of all nodes are compared with draws of the exact answer,
    too, which shows wrong dependences between right marginals.

    How each is judged, at the effective number of draws:

    - a probability by binomial tails at ``n_eff`` (the smaller of the weights' ESS and the node's own), i.e.
      with the standard error under the exact value; one of exactly zero must have exactly none;
    - a quantile by the same law of the share of draws below the exact quantile, of chains at most at the
      effective number of draws of the node;
    - means by their standard error, at least that of the exact variance at ``n_eff``;
    - variances and covariances by the standard error of the squares, corrected for skewness (Hall 1992),
      and not at all where fewer than some 30 draws decide it: the variance may be infinite then;
    - angles by the means of their cosine and sine;
    - log evidence by its ratio to the exact one;
    - joint draws by their energy distance and relabelling (`same_distribution`), of weighted draws those
      that rejection leaves independent, of chains one in twice the draws that count as one.

    Holm's method keeps the chance of any false alarm in one call at ``alpha``. It is exact for
    probabilities and quantiles of numbers from independent draws and for their joint draws, and holds in
    the limit of many draws elsewhere. (Rare states that are too frequent are judged because of what the draws
    show; their p-values pay for that, but for at most a twentieth of ``alpha``.) A posterior whose ``ess`` is
    infinite is exact, and must agree within ``rtol * max(1, |value|)``. The ``accuracy`` of ``exact`` is
    added to every tolerance.

    It cannot see what the draws do not show: heavy weights that no draw has met (look at ``pareto_k``),
    faults below the Monte Carlo error; without ``draws``, errors of joint probabilities with right
    marginals. Sums (``keep="summaries"``) say nothing of quantiles, covariances and the errors of variances.

    Parameters
    ----------
    posterior : Posterior, SeriesPosterior or dict
        Of any engine; or draws of your own, node -> ``(draws, *plates, *event)``, in the order in which they
        were drawn: they are taken for one chain, and judged by their effective number. Of a template, what
        ``smooth`` answers, or ``filter`` of its last slice, by engines without Monte Carlo error; take a
        larger ``rtol`` for those that approximate.
    exact : Enumerated or Posterior
        Anything with ``names``, ``probabilities``, ``mean``, ``var``, ``log_marginal_likelihood``; its
        ``quantile(name, q)``, ``cdf(name, x)``, ``cov(name)`` and ``resample(draws, rng)`` are used where it
        has them.
    alpha : float
        Family-wise false-alarm rate.
    rtol : float
        Tolerance without Monte Carlo error.
    min_count : float
        Compare states and quantiles with ``n_eff * p * (1 - p)`` at least this, where ``p`` is exact; and
        rarer states whose share among the draws is as large.
    names : sequence of str, optional
        Nodes to compare; by default all that ``exact`` knows and the posterior kept, but for those that
        are wholly observed.
    quantiles : sequence of float
        Compare these; none where empty.
    draws : int
        Joint draws to compare, of each side, at most: 0, or 30 and more. A few hundred tell a lot, 1000 are
        used at most.
    rng : seed, Generator or None
        For ``draws``.

    Returns
    -------
    Match
        True where all is well, so that ``assert compare(posterior, exact)`` says what is not.

    Raises
    ------
    AssertionError
        Where the two do not even have the same shapes.
    UnsupportedError
        ``draws`` are asked for and ``exact`` has none to give; beliefs over time are a particle filter's,
        one run of which does not tell its error (`repeated_test`), or forecasts.
    ValueError
        Nothing is left to compare, or a level or number is out of range.
    TypeError
        ``posterior`` is none, or the two are swapped.
    UnknownNodeError
        The posterior is of another net, or a name is unknown.

    References
    ----------
    Holm (1979), Scand. J. Statist. 6; Hall (1992), JRSS B 54; Szekely and Rizzo (2004), InterStat 5.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.testing import compare, enumerate_posterior
    >>> net = bmc.BayesNet()
    >>> net.add("a", bmc.Bernoulli(0.3))
    >>> found = bmc.infer(net, engine=bmc.LikelihoodWeighting(5000), rng=0)
    >>> bool(compare(found, enumerate_posterior(net)))
    True
    """
    options = (alpha, rtol, min_count, names, quantiles, draws, rng)
    return _match("compare", posterior, exact, *options)


def assert_matches(posterior: Any, exact: Any, **options: Any) -> Match:
    """Raise unless a posterior matches an exact one.

    Parameters
    ----------
    posterior, exact
        As `compare` takes them; there stands what is compared, and what cannot be seen.
    **options
        Of `compare`: ``alpha`` (family-wise false-alarm rate, 1e-3), ``rtol`` (tolerance without
        Monte Carlo error, 1e-9), ``min_count`` (rarer states are not compared, 10), ``names``
        (nodes to compare, all), ``quantiles`` (five), ``draws`` (joint draws to compare, none), ``rng``.

    Returns
    -------
    Match

    Raises
    ------
    AssertionError
        Naming nodes, elements, states, both values and the number of standard errors; or because nothing
        could be judged: no figure of any node though some were skipped, or no joint draws though they were
        asked for.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.testing import assert_matches, enumerate_posterior
    >>> net = bmc.BayesNet()
    >>> net.add("a", bmc.Bernoulli(0.3))
    >>> net.add("x", lambda a: bmc.Normal(2.0 * a, 1.0))
    >>> weighted = bmc.infer(net, {"x": 1.5}, engine=bmc.LikelihoodWeighting(5000), rng=0)
    >>> match = assert_matches(weighted, enumerate_posterior(net, {"x": 1.5}))
    >>> len(match.comparisons)
    3
    """
    given = {"alpha": 1e-3, "rtol": 1e-9, "min_count": 10.0, "names": None, "draws": 0, "rng": None,
             "quantiles": (0.05, 0.25, 0.5, 0.75, 0.95)}  # fmt: skip
    for key in options.keys() - given.keys():
        raise TypeError(f"assert_matches: no option {key!r}; there are {', '.join(sorted(given))}")
    match = _match("assert_matches", posterior, exact, **{**given, **options})
    shown = "draws of your own" if isinstance(posterior, Mapping) else repr(posterior)
    if not match:
        raise AssertionError(f"{match!r}\n  of {shown}")
    if match.skipped and not match.of_nodes:
        raise AssertionError(
            f"assert_matches: nothing was judged: {match.skipped} figures have too few effective draws, and "
            f"no other is of a hidden node; take more draws\n  of {shown}"
        )
    if match.remarks:
        raise AssertionError(
            f"assert_matches(draws={options['draws']}): {'; '.join(match.remarks)}; take or keep more "
            f"draws, or leave draws= out\n  of {shown}"
        )
    return match


# ---- private ------------------------------------------------------------------------------------


def _match(
    test: str,
    posterior: Any,
    exact: Any,
    alpha: float,
    rtol: float,
    min_count: float,
    names: Sequence[str] | None,
    quantiles: Sequence[float],
    draws: int,
    rng: Any,
) -> Match:
    levels = np.asarray(quantiles)
    is_real = levels.dtype.kind in "iuf" or not levels.size
    if levels.ndim != 1 or not is_real or not np.all((levels > 0) & (levels < 1)):
        raise ValueError(
            f"{test}(quantiles={quantiles!r}): give a sequence of levels strictly between 0 and 1"
        )
    for what, number in (("rtol", rtol), ("min_count", min_count)):
        if np.ndim(number) or not isinstance(number, Real) or not 0.0 <= number < np.inf:
            raise ValueError(f"{test}({what}={number!r}): give a finite number, 0 or more")
    if isinstance(names, str):
        raise ValueError(f"{test}(names={names!r}): give a sequence of names, as in [{names!r}]")
    check_level(test, alpha)  # before work is done
    posterior = _read(test, posterior, exact)
    table = Table(rtol + getattr(exact, "accuracy", 0.0), min_count)
    sample = Draws(posterior) if isinstance(posterior, DrawsPosterior) else None
    chosen = _chosen(test, posterior, exact, names)
    _compare_evidence(table, posterior, exact)
    of_evidence = len(table.comparisons)
    for name in chosen:
        node = posterior.model[name]
        pair = Pair(table, posterior, exact, name, node, sample)
        if node.domain is not None:
            compare_states(pair)
        elif node.angles is not None:
            compare_angles(pair)
        else:
            compare_mean(pair)
            compare_var(pair)
            compare_cov(pair)
            compare_quantiles(pair, quantiles)
    table.settle()
    remarks = _compare_joint(table, posterior, exact, chosen, draws, rng, alpha) if draws else []
    if not table.comparisons and not table.skipped and not remarks:
        raise NothingToCompare(f"{test}: there is nothing to compare; name nodes that both know")
    of_nodes = len(table.comparisons) - of_evidence
    return counted(Match(test, alpha, table.comparisons, table.skipped, tuple(remarks), of_nodes))


def _chosen(test: str, posterior: Any, exact: Any, names: Sequence[str] | None) -> list[str]:
    kept = getattr(posterior, "names", None)
    nodes = posterior.model.nodes
    unknown = [n for n in (exact.names if names is None else names) if n not in nodes]
    if unknown and names is None:
        raise UnknownNodeError(
            f"{test}: the exact answer has a node {unknown[0]!r}, the posterior has {', '.join(nodes)}; give "
            "two answers about the same net, or names= of nodes that both have"
        )
    unknown += [n for n in names or () if n not in exact.names]
    if unknown:
        raise UnknownNodeError(
            f"{test}(names={list(names or ())!r}): {unknown[0]!r} is no node that both answers have; name "
            f"some of {', '.join(n for n in exact.names if n in nodes)}"
        )
    missing = [n for n in names or () if kept is not None and n not in kept]
    if missing:
        raise UnknownNodeError(
            f"{test}(names={list(names or ())!r}): the posterior does not answer for {missing[0]!r}, but for "
            f"{', '.join(kept or ())} (of a filter, the last slice alone is given all rows)"
        )
    wanted = list(exact.names if names is None else names)
    if names is None:
        seen = _observed(posterior) | _observed(exact)
        wanted = [n for n in wanted if (kept is None or n in set(kept)) and n not in seen]
    return [name for name in wanted if nodes[name].kind != "input"]


def _observed(answer: Any) -> set[str]:
    """Nodes all of whose elements are data."""
    problem = getattr(answer, "problem", None)
    if problem is None:
        return set(getattr(answer, "observed", ()))
    return {name for name, seen in problem.observed.items() if seen.mask is None}


def _read(test: str, posterior: Any, exact: Any) -> Any:
    """The posterior, or one made of a user's own draws; raises where the two are none."""
    if isinstance(exact, SeriesPosterior):
        hint = f"{test}(beliefs, exact(dbn, observations))"
        if not isinstance(posterior, SeriesPosterior):
            hint = f"it stands first, as in {hint}"
        raise TypeError(f"{test}: exact={exact!r:.200} is what an engine believes; {hint}")
    if not all(hasattr(exact, part) for part in ("names", "log_marginal_likelihood")):
        raise TypeError(
            f"{test}: exact={exact!r:.200} is no answer; give one, as exact(net, evidence) or bmc.Exact() "
            "finds it"
        )
    if isinstance(posterior, Mapping):
        return _own_draws(test, posterior, exact)
    if isinstance(posterior, SeriesPosterior):
        _model(test, "beliefs over time", exact)
        return SlicePosterior(test, posterior, exact)
    if all(hasattr(posterior, part) for part in ("model", "mean", "ess", "mcse")):
        return posterior
    if hasattr(exact, "ess") and hasattr(posterior, "log_marginal_likelihood"):
        fault = f"{type(posterior).__name__} is an exact answer and stands first"
        raise TypeError(f"{test}: {fault}; swap the two: {test}(posterior, exact)")
    raise TypeError(
        f"{test}: posterior={posterior!r:.200} is no posterior; give one of bmc.infer, or a dict of your own "
        "draws, node -> array of shape (draws, *plates, *event)"
    )


def _model(test: str, what: str, exact: Any) -> Model:
    model: Model | None = getattr(exact, "model", None)
    if model is None:
        raise TypeError(
            f"{test}: {what} need an exact answer with a model, as exact(net, evidence) gives it, "
            f"not {type(exact).__name__}"
        )
    return model


def _own_draws(test: str, draws: Mapping[str, Any], exact: Any) -> DrawsPosterior:
    """A user's draws as one chain of a posterior."""
    model = _model(test, "draws of your own", exact)
    stored = {}
    for name, values in draws.items():
        if name not in exact.names:
            raise UnknownNodeError(
                f"{test}: the draws have {name!r}, which is no node of the exact answer; it has "
                f"{', '.join(exact.names)}"
            )
        node, shape = model[name], np.shape(values)
        if len(shape) != 1 + len(node.value_shape) or shape[1:] != node.value_shape:
            raise ShapeError(
                f"{test}: draws of {name!r} have shape {shape}; give {('draws', *node.value_shape)}, one row "
                "for each draw"
            )
        stored[name] = store(node, values)[None]
    sizes = {name: values.shape[1] for name, values in stored.items()}
    if len(set(sizes.values())) != 1 or min(sizes.values()) < _MIN_OWN:
        raise ShapeError(
            f"{test}: the nodes have {sizes} draws; give one number for all, {_MIN_OWN} or more"
        )
    problem = Problem(None, model, {}, {})  # type: ignore[arg-type]
    return DrawsPosterior(problem, None, stored, (1, next(iter(sizes.values()))))


def _compare_evidence(table: Table, posterior: Any, exact: Any) -> None:
    found, value = posterior.log_marginal_likelihood, exact.log_marginal_likelihood
    if found is None or value is None:
        return
    error = posterior.log_marginal_likelihood_mcse
    if not np.isfinite(found):
        table.equal("log evidence", found, value)
    elif not error:
        table.equal("log evidence", found, value)
    elif error > 1.0 / np.sqrt(MIN_ESS):
        table.skipped += 1
    else:
        # the estimate of the likelihood itself is unbiased and nearly normal, its log is not
        table.normal("log evidence (ratio)", float(np.exp(found - value)), 1.0, error)


# ---- joint draws --------------------------------------------------------------------------------


def _compare_joint(
    table: Table,
    posterior: Any,
    exact: Any,
    names: Sequence[str],
    draws: int,
    rng: Any,
    alpha: float,
) -> list[str]:
    """One comparison of the joint law of all nodes; remarks where there are too few rows."""
    if isinstance(draws, bool) or not isinstance(draws, (int, np.integer)) or draws < _MIN_ROWS:
        raise ValueError(f"compare(draws={draws!r}): give a whole number, {_MIN_ROWS} or more")
    generator = np.random.default_rng(seed_sequence(rng))
    found = _rows(posterior, names, int(draws), generator)
    if found is None:
        return ["joint draws are not compared: the posterior holds none"]
    size = len(next(iter(found.values()), ()))
    if size < _MIN_ROWS:
        table.skipped += 1
        return [
            f"joint draws are not compared: only {size} of the posterior's are independent of each other"
        ]
    right = _rows(exact, names, size, generator)
    if right is None:
        raise UnsupportedError(
            f"compare(draws={draws}): {type(exact).__name__} has no draws to compare with (quadrature points "
            "are none); compare with bmc.Exact's posterior, or without draws="
        )
    nodes = {name: posterior.model[name] for name in found}
    angles = [name for name, node in nodes.items() if node.angles is not None and node.angles.all()]
    labels = [n for n, node in nodes.items() if node.domain is not None and node.domain.labels]
    level = alpha / (len(table.comparisons) + 1)
    table.comparisons.append(energy_comparison(found, right, level, generator, angles, labels))
    return []


def _rows(
    answer: Any, names: Sequence[str], most: int, rng: np.random.Generator
) -> dict[str, np.ndarray] | None:
    """Independent draws of an answer; None where it has none."""
    if isinstance(answer, DrawsPosterior):
        return Draws(answer).independent(names, most, rng)
    if hasattr(answer, "sample"):  # an oracle
        drawn = asked(answer, "sample", most, rng)
        return None if drawn is None else {name: drawn[name] for name in names}
    drawn = asked(answer, "resample", most, rng)
    return None if drawn is None else Draws(drawn).independent(names, most, rng)
