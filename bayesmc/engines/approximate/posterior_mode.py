"""``bmc.map``: the mode of a posterior density, in the nodes' own coordinates."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Never

import numpy as np

from bayesmc.distributions.parameters import by_keyword, refuse_positions
from bayesmc.engines.approximate.evidence import log_constants
from bayesmc.engines.approximate.modes import Mode, NoMode, modes_of
from bayesmc.engines.approximate.question import free_density, is_number, refuse_jumps, start_points
from bayesmc.engines.mcmc.given import read_start
from bayesmc.errors import BayesmcError, ConvergenceWarning, UnsupportedError
from bayesmc.network import BayesNet, FactorGraph, Problem, pose
from bayesmc.network.forward import refuse_noiseless, refuse_parts
from bayesmc.structure.free_density import UnconstrainedDensity
from bayesmc.structure.target import Target, Values, target_of
from bayesmc.structure.unconstrained import without_volume

#: climbs
_STARTS = 8
#: shares below this lie at the edge of their simplex
_NO_SHARE = 1e-9


@dataclass(frozen=True, eq=False)
class PosteriorMode:
    """Where a posterior density is largest; made by ``bmc.map``.

    Attributes
    ----------
    values : dict
        Node -> value, shape ``(*plates, *event)``, of the nodes that moved (with what was seen of
        them) and of those that are computed from them.
    log_density : float
        The log of the joint density of evidence and these values, in the nodes' own coordinates; finite
        hidden nodes and those that were left out are summed out.
    log_volume : float
        What the change of variables to unconstrained numbers adds to it there, which `LaplaceApproximation`
        counts and this does not.
    at_edge : tuple of str
        Numbers that lie at the edge of their support, where the density is largest in the limit; of shares
        (a Dirichlet node) those components that are 0.
    summed : tuple of str
        Finite hidden nodes, summed out.
    left_out : tuple of str
        Hidden nodes on which nothing observed depends.
    modes : int
        How many modes the climbs found; this is the highest.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet()
    >>> net.add("rate", bmc.Gamma(3.0, 1.0))
    >>> net.add("count", lambda rate: bmc.Poisson(rate))
    >>> mode = bmc.map(net, {"count": 4})
    >>> mode["rate"].round(4).item(), mode.modes  # (3 + 4 - 1) / 2
    (3.0, 1)
    """

    values: dict[str, np.ndarray]
    log_density: float
    log_volume: float
    at_edge: tuple[str, ...] = ()
    summed: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    modes: int = 1

    def __getitem__(self, name: str) -> np.ndarray:
        return self.values[name]

    def __repr__(self) -> str:
        shown = ", ".join(
            f"{n}={np.array2string(np.asarray(v), precision=4, threshold=6)}"
            for n, v in list(self.values.items())[:8]
        )
        return f"PosteriorMode({shown}, log_density={self.log_density:.6g})"


@by_keyword
def map(  # noqa: A001 - the name that everybody knows it by
    net: BayesNet | FactorGraph,
    evidence: Mapping[str, Any] | None = None,
    *beyond: Never,
    inputs: Mapping[str, Any] | None = None,
    start: Mapping[str, Any] | None = None,
) -> PosteriorMode:
    """The mode of the posterior density (maximum a posteriori), by climbing along its gradient.

    The density is that of the nodes' own coordinates: of a positive scale by the scale, not by its log, as
    PyMC's ``find_MAP`` and Stan's ``optimize`` (``jacobian=False``) have it. A mode is no summary of a
    posterior: it moves when a node is declared by its log instead, and in many dimensions lies where there is
    next to no mass. `LaplaceApproximation` climbs in unconstrained numbers, with the change of volume, and so
    to another point.

    Parameters
    ----------
    net : BayesNet or FactorGraph
    evidence : mapping, optional
        As of ``bmc.infer``.
    inputs : mapping, optional
    start : dict, optional
        Node -> value from which to climb; of the others several draws are tried. The highest mode is kept.

    Returns
    -------
    PosteriorMode

    Raises
    ------
    UnsupportedError
        A density cannot be followed or has no gradient, or jumps; a hidden node is discrete without finite
        states, or all are finite; no climb found a mode, with what it met by name (a ridge, a density that
        rises without end) and how far a step would still have gone.

    Warns
    -----
    ConvergenceWarning
        A climb went higher than the mode that is answered, without an end.

    Notes
    -----
    Finite hidden nodes are summed out. Nodes on which nothing observed depends are left out, which changes
    nothing for the others; where nothing at all is observed the mode is that of the prior.

    References
    ----------
    Koller and Friedman (2009), sec. 17.4 (maximum a posteriori); Stan Reference Manual, version 2.36, chapter
    "Optimization" (no Jacobian).

    Examples
    --------
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet(plates={"day": 3})
    >>> net.add("rate", bmc.Gamma(2.0, 1.0))
    >>> net.add("count", lambda rate: bmc.Poisson(rate), plates="day")
    >>> mode = bmc.map(net, {"count": [3, 1, 4]})
    >>> float(mode["rate"].round(6)), round(mode.log_density, 4)  # (2 + 8 - 1) / (1 + 3)
    (2.25, -6.6714)
    """
    if beyond:
        refuse_positions(map, beyond)
    problem = pose(net, evidence, inputs)
    target, density = _density(problem)
    full = free_density(problem, _also(problem), "map")
    found, lost = modes_of(density, _starts(problem, density, start), edges=True)
    if not found:
        best = max(lost, key=lambda end: end.log_density)
        raise UnsupportedError(f"map: {best.reason} (the same of {len(lost)} climbs, or worse)")
    best_mode = found[0]
    refuse_jumps(density, best_mode, "map")
    _warn(best_mode, lost)
    return PosteriorMode(
        _values(target, density, best_mode),
        best_mode.log_density + log_constants(target),
        float(full.log_volume(best_mode.u)),
        _at_edge(density, best_mode),
        density.summed,
        tuple(n for n in target.forward if problem.model[n].is_stochastic),
        len(found),
    )


# ---- private ------------------------------------------------------------------------------------


def _also(problem: Problem) -> tuple[str, ...]:
    """Nodes that move though nothing observed depends on them: all, where nothing is observed."""
    if target_of(problem).chain:
        return ()
    return tuple(n for n in problem.model.nodes if is_number(problem, n))


def _density(problem: Problem) -> tuple[Target, UnconstrainedDensity]:
    reason = refuse_parts(problem.observed, "map")
    if reason is not None:
        raise UnsupportedError(reason)
    full = free_density(problem, _also(problem), "map")
    terms = [n for n in full.target.terms if n in problem.model.nodes]
    reason = refuse_noiseless(problem.model, terms, "map")
    if reason is not None:
        raise UnsupportedError(reason)
    try:
        return full.target, without_volume(full)
    except UnsupportedError as error:
        raise UnsupportedError(f"map: {error}") from error


def _starts(
    problem: Problem, density: UnconstrainedDensity, start: Mapping[str, Any] | None
) -> np.ndarray:
    if start is None:
        return start_points(density, _STARTS)
    given = read_start("map", problem, start, _STARTS)
    return start_points(density, _STARTS, given)


def _values(target: Target, density: UnconstrainedDensity, mode: Mode) -> dict[str, np.ndarray]:
    model = target.model
    stored: Values = {**target.known, **density.constrain(mode.u)}
    found: dict[str, np.ndarray] = {}
    for name, node in model.nodes.items():
        moved = name in density.names
        computed = node.kind == "deterministic" and name not in target.known
        if computed and all(p in stored for p in node.parents) and set(node.parents) & found.keys():
            try:
                stored[name] = model.evaluate(name, stored)[0]
            except BayesmcError:
                continue
        if (moved or computed) and name in stored:
            value = np.array(np.broadcast_to(node.decode(stored[name]), node.value_shape))
            value.flags.writeable = False
            found[name] = value
    return found


def _at_edge(density: UnconstrainedDensity, mode: Mode) -> tuple[str, ...]:
    """Numbers at the edge of their support; of shares those that are 0, whichever free number led there."""
    found: list[str] = []
    values = density.constrain(mode.u)
    for node in density.nodes:
        out = mode.edge[node.start : node.start + node.size]
        if not out.any():
            continue
        own, name = node.node, node.name
        if own.support is None or own.support.kind != "simplex":
            found += [label for label, is_out in zip(node.labels, out, strict=True) if is_out]
            continue
        value = np.broadcast_to(values[name], own.value_shape)
        moved = np.ones(own.plate_shape, bool)
        if node.elements is not None:
            moved = np.isin(np.arange(moved.size), node.elements).reshape(own.plate_shape)
        for at in zip(*np.nonzero((value < _NO_SHARE) & moved[..., None]), strict=True):
            found.append(f"{name}[{', '.join(str(int(i)) for i in at)}]")
    return tuple(found)


def _warn(best: Mode, lost: list[NoMode]) -> None:
    higher = [end for end in lost if end.log_density > best.log_density + 1e-6]
    if higher:
        warnings.warn(
            f"map: {len(higher)} climbs went higher than the mode that is answered (by "
            f"{higher[0].log_density - best.log_density:.3g} and more), and had no end: {higher[0].reason}",
            ConvergenceWarning,
            stacklevel=3,
        )
