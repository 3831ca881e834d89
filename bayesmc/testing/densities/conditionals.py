"""Is a node's conditional density what it says? The checks of ``densities``, at parents drawn from the net.

A conditional density is a function of its parents, so that besides being a density at each of their values it
must keep the array rules: this room draws parents, asks for all of them at once and one by one, and hands
what comes back to `inspect`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution, marking_invalid
from bayesmc.errors import BayesmcError, ParameterError, UnknownNodeError, UnsupportedError
from bayesmc.network import BayesNet, CompiledNode, Model, forward, pose
from bayesmc.network.parts import ancestral, with_nodes
from bayesmc.randomness import seed_sequence
from bayesmc.shapes import first_index
from bayesmc.testing.densities.density import DensityCheck, inspect
from bayesmc.testing.densities.reports import Report
from bayesmc.testing.verdict import check_level, counted

#: configurations of the parents that are evaluated together
_BATCH = 64
#: of these, asked for one by one
_ALONE = 8


def check_cpd(
    net: BayesNet,
    name: str,
    *,
    parents: int = 3,
    draws: int = 4_000,
    inputs: Mapping[str, Any] | None = None,
    gaps: bool = False,
    alpha: float = 1e-3,
    rng: Any = None,
) -> DensityCheck:
    """Hold a node's conditional density against itself, at values of its parents drawn from the net.

    At 64 draws of the parents: its parameters are valid, its log density is finite at its own draws, and it
    gives the same whether asked for all of them at once or one by one, as ``net.validate`` promises, which is
    called, too. At the first few of them (of unlike values): everything that `check_density` looks at.

    Only the node and its ancestors are looked at. A right node fails with probability at most ``alpha``,
    with the same limits.

    Parameters
    ----------
    net : BayesNet
    name : str
        A stochastic node.
    parents : int
        Configurations of the parents at which the density is checked in full.
    draws : int
        To take from its sampler at each, 100 or more.
    inputs : dict, optional
        Values of input nodes.
    gaps : bool
        Whether the density may be zero inside its support.
    alpha : float
        Family-wise false-alarm rate.
    rng : seed, Generator or None

    Returns
    -------
    DensityCheck
        Its ``faults`` say all that is wrong, with the parents' values.

    Raises
    ------
    UnknownNodeError
        No such node.
    UnsupportedError
        The node is deterministic or an input, or an ancestor cannot be sampled.
    ModelError
        An ancestor is wrong.

    References
    ----------
    Koller and Friedman (2009), Probabilistic Graphical Models, section 5.1.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.testing import check_cpd
    >>> net = bmc.BayesNet()
    >>> net.add("a", bmc.Normal(0.0, 1.0))
    >>> net.add("x", lambda a: bmc.Normal(a, 2.0))
    >>> bool(check_cpd(net, "x", rng=0))
    True
    >>> net.add("y", lambda a: bmc.Normal(0.0, 1.5 + a))
    >>> check_cpd(net, "y", rng=3).faults[0]
    'at a=-2.5557: Normal: scale must be positive and finite; got -1.055665 (6 of 64 draws of the parents)'
    """
    call = f"check_cpd(net, {name!r})"
    if not isinstance(net, BayesNet):
        raise TypeError(f"{call}: the first argument is a BayesNet, not {type(net).__name__}")
    for key, value, least in (("parents", parents, 1), ("draws", draws, 100)):
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
            raise ValueError(f"{call}: {key}={value!r}; give a whole number, {least} or more")
    check_level("check_cpd", alpha)
    if not isinstance(name, str) or name not in net:
        raise UnknownNodeError(f"{call}: no node {name!r}; there are {', '.join(net.nodes)}")
    report = Report(alpha, np.random.default_rng(seed_sequence(rng)))
    # faults elsewhere are no faults of its
    family = ancestral(net, (name, *(inputs or ())))
    try:
        problem = pose(family, None, inputs)
    except BayesmcError as error:  # not even a model: nothing else can be asked
        _own_fault(error, name, report)
        if isinstance(error, ParameterError):
            report.comparisons.pop()
            report.fault(_with_parents(family, name, inputs, report) or str(error))
    else:
        try:
            family.validate(inputs)
            report.fine("validate")
        except BayesmcError as error:
            _own_fault(error, name, report)
        _check_node(problem.model, problem.inputs, name, report, parents, draws, gaps, call)
    check = DensityCheck("check_cpd", alpha, report.comparisons, 0, tuple(report.remarks))
    return counted(check)


# ---- private ------------------------------------------------------------------------------------


def _with_parents(
    family: BayesNet, name: str, inputs: Mapping[str, Any] | None, report: Report
) -> str | None:
    """A fault of the parameters so gross that no model is compiled, at values of the parents drawn."""
    own = family.declarations[name]
    above = ancestral(family, (*own.parents, *(inputs or ())))
    parents = [p for p in dict.fromkeys(own.parents) if p in above]
    try:
        drawn = above.sample(_BATCH, report.rng, inputs=inputs)
        for row in range(_BATCH):
            # inputs have their values already, and are the same in every draw
            values = {p: drawn[p][row] for p in parents if p in drawn and p not in (inputs or ())}
            fixed = above.do(values)
            try:
                pose(with_nodes(fixed, {name: own}), None, inputs)
            except ParameterError as error:
                if f"node {name!r}" in str(error):
                    told = ", ".join(f"{p}={_in_short(v)}" for p, v in values.items())
                    return (f"at {told}: " if told else "") + str(error)
    except BayesmcError:
        return None
    return None


def _own_fault(error: BayesmcError, name: str, report: Report) -> None:
    """A fault that the net itself has found, if it is this node's."""
    if f"node {name!r}" not in str(error):
        raise error
    report.fault(str(error))


def _check_node(
    model: Model,
    inputs: Mapping[str, np.ndarray],
    name: str,
    report: Report,
    parents: int,
    draws: int,
    gaps: bool,
    call: str,
) -> None:
    node = model[name]
    if not node.is_stochastic:
        raise UnsupportedError(f"{call}: a node of kind {node.kind} has no density")
    values = _drawn_parents(model, inputs, name, report.rng, call)
    with marking_invalid(), np.errstate(all="ignore"):
        try:
            dist, batch = model.evaluate(name, values)
        except BayesmcError as error:
            report.fault(str(error))
            return
        bad = _check_parameters(model, node, dist, values, batch, report)
        _check_draws(model, node, dist, values, batch, bad, report)
    for row in _unlike(node, values, bad)[:parents]:
        report.place = _told(model, node, values, row)
        try:
            alone, _ = model.evaluate(name, _rows(values, node, [row], True))
            inspect(alone, report, draws, gaps)
        except BayesmcError as error:
            report.fault(str(error))
    report.place = ""


def _drawn_parents(
    model: Model,
    inputs: Mapping[str, np.ndarray],
    name: str,
    rng: np.random.Generator,
    call: str,
) -> dict[str, np.ndarray]:
    """Draws of a node's ancestors, stored values of shape ``(64, *plates, *event)``."""
    wanted: set[str] = set(model[name].parents)
    for other in reversed(list(model.nodes)):
        if other in wanted:
            wanted |= set(model[other].parents)
    kept = [n for n in model.nodes if n not in wanted]
    refused = forward.refuse_unsampled(model, kept, call)
    if refused:
        raise UnsupportedError(refused)
    steps = [
        forward.step_for(model, node, {})
        for other, node in model.nodes.items()
        if other in wanted and node.kind != "input"
    ]
    with marking_invalid(), np.errstate(all="ignore"):
        return dict(forward.run(steps, forward.Pass(rng, (_BATCH,), dict(inputs))).values)


def _check_parameters(
    model: Model,
    node: CompiledNode,
    dist: Distribution,
    values: Mapping[str, np.ndarray],
    batch: tuple[int, ...],
    report: Report,
) -> np.ndarray:
    """Valid parameters at values that the parents can take; where they are not, shape (64,)."""
    rows = batch[0] if batch else 1
    if dist.invalid is None:
        report.fine("parameters are valid")
        return np.zeros(rows, dtype=bool)
    full = np.broadcast_to(dist.invalid, batch + node.plate_shape).reshape(rows, -1)
    bad = np.asarray(full.any(axis=1))
    row = int(np.argmax(bad))
    share = f" ({int(bad.sum())} of {rows} draws of the parents)" if node.links else ""
    try:
        alone, _ = model.evaluate(node.name, _rows(values, node, [row], True))
        problem = alone.problem
    except BayesmcError as error:
        problem = error
    report.fault(f"{_told(model, node, values, row)}{problem}{share}")
    return bad


def _check_draws(
    model: Model,
    node: CompiledNode,
    dist: Distribution,
    values: Mapping[str, np.ndarray],
    batch: tuple[int, ...],
    bad: np.ndarray,
    report: Report,
) -> None:
    """Finite log densities at own draws, the same one by one."""
    if not getattr(dist, "can_sample", True):
        return  # said where the density is checked
    name = node.name
    try:
        drawn = model.sample_stored(name, dist, report.rng, batch)
        log = np.broadcast_to(model.log_density(name, dist, drawn), batch + node.plate_shape)
    except UnsupportedError:
        return
    except BayesmcError as error:
        report.fault(str(error))
        return
    rows = log.reshape(len(bad), -1)
    lost = ~np.isfinite(rows).all(axis=1) & ~bad
    if lost.any():
        row = int(np.argmax(lost))
        at = first_index(~np.isfinite(rows[row]))
        report.fault(
            f"{_told(model, node, values, row)}the log density of a draw of its own is {rows[row][at]}"
        )
    else:
        report.fine("log density at own draws")
    if not batch:
        return
    for row in np.flatnonzero(~bad)[:: max(1, len(bad) // _ALONE)].tolist():
        try:
            alone, _ = model.evaluate(name, _rows(values, node, [row], True))
            again = np.broadcast_to(model.log_density(name, alone, drawn[row]), node.plate_shape)
        except BayesmcError as error:
            report.fault(f"{_told(model, node, values, row)}asked alone: {error}")
            return
        if not np.allclose(again.ravel(), rows[row], rtol=1e-8, atol=1e-10, equal_nan=True):
            report.fault(
                f"{_told(model, node, values, row)}the log density is {again.ravel()[0]:.6g} alone and "
                f"{rows[row][0]:.6g} in a batch of parents: every operation must act element by element "
                "(axis=-1, np.where for if)"
            )
            return
    report.fine("one by one as in a batch")


def _rows(
    values: Mapping[str, np.ndarray], node: CompiledNode, rows: list[int], single: bool
) -> dict[str, np.ndarray]:
    """The parents' values at some rows; without the batch axis for a single one."""
    picked = {}
    for parent, link in node.links:
        value = values[parent]
        batch = link.batch_shape(value)
        if batch:
            value = value[rows[0] if batch[0] > 1 else 0, ...] if single else value[rows]
        picked[parent] = value
    return picked


def _unlike(node: CompiledNode, values: Mapping[str, np.ndarray], bad: np.ndarray) -> list[int]:
    """Rows of good parameters whose parents differ from those before."""
    seen: set[bytes] = set()
    found = []
    for row in np.flatnonzero(~bad).tolist():
        picked = _rows(values, node, [row], True)
        key = b"".join(np.ascontiguousarray(picked[p]).tobytes() for p in dict.fromkeys(picked))
        if key not in seen:
            seen.add(key)
            found.append(row)
    return found


def _told(model: Model, node: CompiledNode, values: Mapping[str, np.ndarray], row: int) -> str:
    """The parents' values in words."""
    picked = _rows(values, node, [row], True)
    parts = []
    for parent, value in picked.items():
        shown = model[parent].decode(value)
        parts.append(f"{parent}={_in_short(shown)}")
    return f"at {', '.join(parts)}: " if parts else ""


def _in_short(value: Any) -> str:
    text = np.array2string(np.asarray(getattr(value, "labels", value)), precision=4, threshold=6)
    return " ".join(text.split())
