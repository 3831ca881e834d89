"""``fit``: which way of learning a question takes, and what is left of the net when it is learned."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Never

import numpy as np

from bayesmc.dbn import DynamicBayesNet, pose_series
from bayesmc.dbn.slices import SliceStore
from bayesmc.distributions.parameters import by_keyword, refuse_positions
from bayesmc.engines.approximate.evidence import log_constants
from bayesmc.engines.approximate.question import free_density
from bayesmc.engines.exact.exact import Exact
from bayesmc.engines.filtering import FilterEngine
from bayesmc.errors import (
    ConvergenceWarning,
    EvidenceError,
    ModelError,
    UnsupportedError,
    did_you_mean,
)
from bayesmc.learning.climbing import Maximum, maximum, told_part
from bayesmc.learning.fitted import Fit, lonely
from bayesmc.learning.objectives import Density, Evidence, Objective, hidden_numbers
from bayesmc.learning.series_evidence import of_template
from bayesmc.learning.tables import Climb, fit_tables
from bayesmc.learning.unknowns import Unknowns
from bayesmc.network import BayesNet, Problem, pose
from bayesmc.network.columns import columns_of
from bayesmc.progress import Progress
from bayesmc.randomness import seed_sequence
from bayesmc.structure.unconstrained import without_volume

#: starts drawn from priors
_STARTS = 32


@by_keyword
def fit(
    net: BayesNet | DynamicBayesNet,
    data: Any,
    *beyond: Never,
    inputs: Mapping[str, Any] | None = None,
    learn: str | Sequence[str] | None = None,
    prior: bool = False,
    counts: Any = 0.0,
    start: Mapping[str, Any] | None = None,
    engine: FilterEngine | None = None,
    tolerance: float = 1e-5,
    max_iterations: int = 1000,
    restarts: int | None = None,
    rng: Any = 0,
    progress: bool | None = None,
) -> Fit:
    """Parameters of a net or template by maximum likelihood, or the mode of their posterior.

    Parameters with a prior are *nodes*: of a template its static nodes, of a net hidden continuous nodes that
    read no other hidden node and share no plate with the data. What else is hidden is summed or integrated
    out. Where there are none, *tables* are learned: of a net that describes one case, from a table of cases;
    of a template from its series. The structure is not learned.

    Parameters
    ----------
    net : BayesNet or DynamicBayesNet
    data : dict or DataFrame
        As ``infer`` and ``filter`` take evidence; for tables of a net one column for each node, with one
        entry for each case (None, NaN or a masked entry is missing).
    inputs : dict, optional
    learn : str or sequence of str, optional
        Names of nodes, or of tables, to learn; None as said above; ``"tables"`` all tables. Other hidden
        nodes stay random.
    prior : bool
        Maximise the posterior density, in the nodes' own coordinates, in place of the likelihood.
    counts : float or dict
        Dirichlet counts that are added to every entry of a table (of those named), on top of what was seen: 0
        is maximum likelihood, 1 one more case of every kind.
    start : dict, optional
        Where to begin: node -> value, table -> probabilities, such as ``values`` of an earlier fit. Of nodes
        that are not named several draws of their prior are tried; tables begin as the net has them.
    engine : optional
        Of a template: whose log evidence is maximised. It must be deterministic; None takes an exact one.
    tolerance : float
        Of the slope at which it ends; of EM, of the rise by one plain step, in nats.
    max_iterations : int
    restarts : int, optional
        How many climbs are made, or how often EM begins; the highest end is taken, and ``climbs`` has them
        all. Starts are draws of the priors, of tables those of the net and then random rows. None: climbs go
        on until two have ended at the highest of all, three at least and eight at most; EM begins once.
    rng : seed, SeedSequence, Generator or None
        For starts.
    progress : bool, optional
        Show a bar after a second; None where the error stream is a terminal.

    Returns
    -------
    Fit
        ``net`` (with what was learned in place), ``values``, ``std_errors``, ``log_likelihood``,
        ``summary()``.

    Raises
    ------
    ModelError, EvidenceError
    UnsupportedError
        The evidence cannot be told without random error, or nothing can be learned.

    Warns
    -----
    ConvergenceWarning
        It ended before a maximum, at an edge, or where the curvature is singular: the data do not tell a
        number or a combination of several, or it ran off. They are named, and have no standard error. Or no
        other climb came as high, so that there may be higher ones.

    Notes
    -----
    Nodes are found by quasi-Newton steps on the log evidence in unconstrained coordinates, with the gradient
    of the expression graph where everything else hidden is finite, and by differences of exact evidences
    elsewhere; standard errors are those of the observed information. Tables are found by expectation-
    maximisation with extrapolated steps, whose objective never falls.

    References
    ----------
    Dempster, Laird and Rubin (1977), Maximum likelihood from incomplete data, JRSS B 39; Koller and Friedman
    (2009), Probabilistic Graphical Models, sec. 19.2; Durbin and Koopman (2012), sec. 7.3.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet(plates={"day": 4})
    >>> net.add("rate", bmc.Gamma(2.0, 1.0))
    >>> net.add("count", lambda rate: bmc.Poisson(rate), plates="day")
    >>> found = bmc.fit(net, {"count": [3, 1, 4, 2]})
    >>> float(found["rate"].round(4)), float(found.std_errors["rate"].round(4))
    (2.5, 0.7906)
    """
    if beyond:
        refuse_positions(fit, beyond)
    if not isinstance(net, (BayesNet, DynamicBayesNet)):
        raise ModelError(f"fit: expected a BayesNet or a DynamicBayesNet, not {type(net).__name__}")
    _check_options(start, max_iterations, restarts)
    start = start or {}
    data, inputs = _as_dicts(net, data, inputs)
    chosen = _chosen(net, data, inputs, learn)
    tables = [n for n in chosen if _is_table(net, n)]
    if tables:
        if len(tables) < len(chosen):
            other = next(n for n in chosen if n not in tables)
            raise UnsupportedError(
                f"fit: {tables[0]!r} is a table and {other!r} a node with a prior, and one call "
                "learns either; give "
                "the table's rows a Dirichlet prior as a node, Categorical(rows[parent]), or learn "
                "one after the "
                "other (learn=)"
            )
        chance = np.random.default_rng(seed_sequence(rng))
        with Progress(None, "fit", progress) as bar:
            climb = Climb(tolerance, max_iterations, restarts or 1, chance, bar)
            return fit_tables(net, data, inputs, tables, counts, start, climb)
    objective, unknowns = _objective(net, data, inputs, chosen, prior, engine)
    starts = _starts(unknowns, start, np.random.default_rng(seed_sequence(rng)), restarts)
    with Progress(None, "fit", progress) as bar:
        found = maximum(objective, starts, tolerance, max_iterations, restarts, bar)
    return _fitted(net, objective, unknowns, found, prior)


# ---- private ------------------------------------------------------------------------------------


def _as_dicts(net: BayesNet | DynamicBayesNet, data: Any, inputs: Any) -> tuple[Any, Any]:
    """Data and inputs of data frames; of a net without plates each row is a case."""
    if isinstance(net, DynamicBayesNet):
        data, inputs, _ = net.unframed(data, inputs)
    elif any(declaration.plates for declaration in net.declarations.values()):
        data, inputs = net.unframed(data, inputs)
    return columns_of(data), inputs


def _is_table(net: BayesNet | DynamicBayesNet, name: str) -> bool:
    declared = net.template.later if isinstance(net, DynamicBayesNet) else net.declarations
    return declared[name].source == "table"


def _chosen(
    net: BayesNet | DynamicBayesNet, data: Mapping[str, Any], inputs: Any, learn: Any
) -> tuple[str, ...]:
    """What is to be learned."""
    declared = net.template.later if isinstance(net, DynamicBayesNet) else net.declarations
    tables = tuple(n for n, d in declared.items() if d.source == "table")
    if learn == "tables" and "tables" not in declared:
        learn = tables
    if learn is not None:
        names = (learn,) if isinstance(learn, str) else tuple(learn)
        for name in names:
            if name not in declared:
                raise ModelError(
                    f"fit: learn= names {name!r}, which is no node{did_you_mean(name, declared)}"
                )
            if name in data and not _is_table(net, name):
                raise ModelError(
                    f"fit: {name!r} is to be learned, and the data have it; leave out one of both"
                )
        if not names:
            raise ModelError("fit: learn= names nothing; leave it out, or name nodes")
        return names
    nodes = (
        _static_nodes(net, data) if isinstance(net, DynamicBayesNet) else _roots(net, data, inputs)
    )
    if nodes and tables and isinstance(net, DynamicBayesNet):
        known = ", ".join(map(repr, nodes))
        raise ModelError(
            f"fit: there are nodes to be learned ({known}) and tables "
            f"({', '.join(map(repr, tables))}); say which with "
            f'learn=[...] or learn="tables"; tables that are known stay as they are'
        )
    found = nodes or tables
    if not found:
        raise ModelError(
            "fit: there is nothing to learn: no hidden node that reads no other (a parameter with a "
            "prior), and no "
            "table; name what is to be learned with learn=, or ask for posteriors with infer"
        )
    return found


def _static_nodes(dbn: DynamicBayesNet, data: Mapping[str, Any]) -> tuple[str, ...]:
    model = pose_series(dbn, data).model if not dbn.inputs else None
    return tuple(
        n for n in dbn.static_nodes if n not in data and (model is None or model[n].is_stochastic)
    )


def _roots(net: BayesNet, data: Mapping[str, Any], inputs: Any) -> tuple[str, ...]:
    """Hidden continuous nodes that read no hidden node, in no plate of the data."""
    if all(d.source == "table" for d in net.declarations.values()):
        return ()  # whose data are cases
    model = pose(net, data, inputs).model
    plates = {p for n in data if n in model.nodes for p in model[n].plates}
    found = []
    for name, node in model.nodes.items():
        above = model.above(node.parents, lambda n: model[n].kind == "deterministic")
        free = all(not model[p].is_stochastic for p in above)
        if node.is_stochastic and node.domain is None and not node.is_discrete and free:
            if name not in data and not plates & set(node.plates):
                found.append(name)
    return tuple(found)


def _objective(
    net: BayesNet | DynamicBayesNet,
    data: Mapping[str, Any],
    inputs: Any,
    names: tuple[str, ...],
    prior: bool,
    engine: FilterEngine | None,
) -> tuple[Objective, Unknowns]:
    if isinstance(net, DynamicBayesNet):
        series = pose_series(net, data, inputs)
        _check_observed(series.series.observed, prior)
        return of_template(net, series, data, inputs, names, prior, engine)
    if engine is not None:
        raise UnsupportedError("fit(engine=...): engines over time are for templates; leave it out")
    problem = pose(net, data, inputs)
    if not problem.model.potentials:
        _check_observed(problem.observed, prior)
    unknowns = Unknowns.of(problem.model, names, problem.inputs)
    others = hidden_numbers(problem, names)
    if not others:
        density = without_volume(free_density(problem, names, "fit"))
        if set(density.names) == set(names):
            return Density(density, log_constants(density.target), unknowns, prior), unknowns
    return _by_elimination(net, data, inputs, unknowns, prior, others), unknowns


def _check_observed(observed: Mapping[str, Any], prior: bool) -> None:
    """Something must be: a likelihood of nothing is flat, and any start is its maximum."""
    if prior or any(seen.mask is None or seen.mask.any() for seen in observed.values()):
        return
    raise EvidenceError(
        "fit: nothing is observed (no entry of the data has a value), so that every value is as likely as "
        "any other; give data, or use prior=True for the mode of the prior"
    )


def _by_elimination(
    net: BayesNet,
    data: Mapping[str, Any],
    inputs: Any,
    unknowns: Unknowns,
    prior: bool,
    others: list[str],
) -> Evidence:
    """Other hidden numbers are integrated out by exact elimination, given the unknowns."""
    exact, seed = Exact(), np.random.SeedSequence(0)

    def asked(values: Mapping[str, np.ndarray]) -> Problem:
        return pose(net.do(values), data, inputs)

    first = unknowns.values(unknowns.starts(1, np.random.default_rng(0))[0])
    refused = exact.refusal(asked(first))
    if refused is not None:
        raise UnsupportedError(
            f"fit: besides what is learned {', '.join(map(repr, others[:4]))} is hidden, and must be "
            "integrated out: "
            f"{refused}; name it in learn= (it is then learned, too), or infer the posterior of all"
        )

    def log_evidence(values: Mapping[str, np.ndarray]) -> float:
        return float(exact.run(asked(values), seed).log_marginal_likelihood)  # type: ignore[arg-type]

    return Evidence(unknowns, log_evidence, prior)


def _check_options(start: Any, max_iterations: int, restarts: Any) -> None:
    if not isinstance(start, Mapping | None):
        raise ModelError(
            f"fit: start= is a {type(start).__name__}; give a dict, node -> value or table -> probabilities"
        )
    if max_iterations < 1:
        raise ModelError(f"fit: max_iterations is {max_iterations}; give 1 or more")
    whole = isinstance(restarts, (int, np.integer)) and not isinstance(restarts, bool)
    if restarts is not None and not (whole and restarts > 0):
        raise ModelError(f"fit: restarts is {restarts!r}; give a whole number of climbs, 1 or more")


def _starts(
    unknowns: Unknowns, start: Mapping[str, Any], rng: np.random.Generator, restarts: int | None
) -> np.ndarray:
    for name in start:
        if name not in unknowns.names:
            raise ModelError(
                f"fit: start= names {name!r}, which is not learned{did_you_mean(name, unknowns.names)}: "
                f"{list(unknowns.names)}"
            )
    if start and len(start) == len(unknowns.names):
        given = unknowns.numbers(start)[None]
        if (restarts or 1) == 1:
            return given
        return np.vstack([given, unknowns.starts(max(_STARTS, restarts or 1), rng)])
    drawn = unknowns.starts(max(_STARTS, restarts or 1), rng)
    if not start:
        return drawn
    return np.array([unknowns.numbers({**unknowns.values(u), **start}) for u in drawn])


def _fitted(
    net: BayesNet | DynamicBayesNet,
    objective: Objective,
    unknowns: Unknowns,
    found: Maximum,
    prior: bool,
) -> Fit:
    values = unknowns.values(found.u)
    told, untold = told_part(objective, found)
    covariance = _covariance(unknowns, found, told)
    spread = np.sqrt(np.diagonal(covariance))
    errors, at = {}, 0
    for name, value in values.items():
        errors[name] = spread[at : at + value.size].reshape(value.shape)
        at += value.size
    if not found.converged or untold:
        _warn(unknowns, found, untold, spread, prior)
    elif (alone := lonely(found.ends)) is not None:
        warnings.warn(f"fit: {alone}", ConvergenceWarning, stacklevel=3)
    what = "posterior mode" if prior else "maximum likelihood"
    log_prior = unknowns.log_prior(found.u) if prior else 0.0
    return Fit(
        _filled(net, values), values, errors, found.value - log_prior, found.value, found.history,
        found.converged and not untold, found.steps, what, covariance, tuple(unknowns.labels()),
        found.ends,
    )  # fmt: skip


def _warn(
    unknowns: Unknowns, found: Maximum, untold: list[np.ndarray], spread: np.ndarray, prior: bool
) -> None:
    """That this is no maximum, or none that the data tell, and in which numbers."""
    remedy = "priors that say more" if prior else "prior=True with priors that say more"
    if untold:
        of = "posterior density" if prior else "likelihood"
        flat = "; ".join(unknowns.direction(group) for group in untold[:4])
        more = "; and more" if len(untold) > 4 else ""
        message = (
            f"fit: at the estimate the {of} is next to flat in {flat}{more}: the data do not tell it, or it "
            "runs to an edge or off to infinity (several with each other: only a combination of them); what "
            f"is returned is one point of many; observe more, simplify the model, or use {remedy}"
        )
    else:
        edge = [x for x, e in zip(unknowns.labels(), spread, strict=True) if not np.isfinite(e)]
        at = f" {', '.join(edge[:4])} may run to an edge:" if edge else ""
        message = (
            f"fit: the climb ended after {found.steps} steps before a maximum:{at} look at history, give "
            f"start=, or use {remedy}"
        )
    warnings.warn(message, ConvergenceWarning, stacklevel=4)


def _covariance(unknowns: Unknowns, found: Maximum, covariance: np.ndarray) -> np.ndarray:
    """Of the values, by the delta method; NaN where the curvature is none of a maximum's."""
    size = unknowns.size
    jacobian = np.empty((len(unknowns.flat(found.u)), size))
    for k in range(size):
        step = 1e-6 * max(1.0, abs(found.u[k]))
        at = np.array([found.u, found.u])
        at[0, k] -= step
        at[1, k] += step
        jacobian[:, k] = (unknowns.flat(at[1]) - unknowns.flat(at[0])) / (2 * step)
    with np.errstate(invalid="ignore"):
        spread = np.where(np.isnan(covariance), 0.0, covariance)
        result = jacobian @ spread @ jacobian.T
        lost = (np.abs(jacobian) > 0) @ np.isnan(np.diagonal(covariance))
    lost |= np.abs(jacobian).max(axis=1) < 1e-9  # at the edge for good
    result[lost], result[:, lost] = np.nan, np.nan
    return result


def _filled(
    net: BayesNet | DynamicBayesNet, values: Mapping[str, np.ndarray]
) -> BayesNet | DynamicBayesNet:
    """The net with nodes fixed at what was learned."""
    if isinstance(net, BayesNet):
        return net.do(values)
    plain = BayesNet.of(None, {}, net.template.plates)
    for name, value in values.items():
        plain.add(name, Known(value), plates=net.template.later[name].plates)
    fixed = plain.declarations
    other = net.copy()
    later = {n: fixed.get(n, d) for n, d in net.template.later.items()}
    other._store = SliceStore(replace(net.template, later=later))
    return other


class Known:
    """A node's value as a function of nothing: what a static node is once it is learned."""

    def __init__(self, value: np.ndarray) -> None:
        self.value = np.array(value)
        self.value.flags.writeable = False

    def __call__(self) -> np.ndarray:
        return self.value

    def __repr__(self) -> str:
        return f"Known({np.array2string(self.value, precision=4, threshold=6)})"
