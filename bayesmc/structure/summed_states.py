"""States of finite nodes that were summed out, drawn given the numbers: the way back of ``summing``."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayesmc.categorical import log_sum_exp, pick_log
from bayesmc.expression import Program
from bayesmc.structure.free_density import FREE, UnconstrainedDensity
from bayesmc.structure.summing import Summed
from bayesmc.structure.target import Values

#: entries of tables that are looked at together
_ENTRIES = 1 << 22


def drawn_states(
    density: UnconstrainedDensity,
    u: np.ndarray,
    rng: np.random.Generator | None,
    given: Mapping[str, np.ndarray] | None = None,
) -> tuple[Values, np.ndarray]:
    """Stored values of the nodes that are summed out, and the log probability of these states given ``u``.

    Parameters
    ----------
    density : UnconstrainedDensity
    u : ndarray, shape (draws, size)
    rng : Generator or None
    given : dict, optional
        Node -> states, shape ``(draws, *plates)``, whose probability is asked for; else they are drawn.

    Returns
    -------
    dict
        Node -> shape ``(draws, *plates)``.
    ndarray, shape (draws,)

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.summed_states import drawn_states
    >>> from bayesmc.structure.target import target_of
    >>> from bayesmc.structure.unconstrained import unconstrained_density
    >>> net = bmc.BayesNet()
    >>> net.add("z", bmc.Bernoulli(0.5))
    >>> net.add("x", lambda z: bmc.Normal(4.0 * z, 1.0))
    >>> net.add("y", lambda x: bmc.Normal(x, 1.0))
    >>> density = unconstrained_density(target_of(pose(net, {"y": 1.0})), None, ["z"])
    >>> values, log = drawn_states(density, np.array([[4.0], [-3.0]]), np.random.default_rng(0))
    >>> values["z"], log.round(4)
    (array([1, 0], dtype=uint8), array([-0.0003, -0.    ]))
    """
    values: Values = {}
    log = np.zeros(len(u))
    for summed in density.tables:
        found, own = _of_component(density, summed, u, rng, given)
        values.update(found)
        log += own
    return values, log


# ---- private ------------------------------------------------------------------------------------


def _of_component(
    density: UnconstrainedDensity,
    summed: Summed,
    u: np.ndarray,
    rng: np.random.Generator | None,
    given: Mapping[str, np.ndarray] | None,
) -> tuple[Values, np.ndarray]:
    roots = [summed.rest] if summed.table is None else [summed.rest, summed.table]
    entries = sum(int(np.prod(root.shape)) for root in roots)
    program, count = Program(roots), max(_ENTRIES // max(entries, 1), 1)
    names = (*summed.listed[0], *summed.labels)
    parts = []
    for first in range(0, len(u), count):
        at = slice(first, first + count)
        own = None if given is None else {n: given[n][at] for n in names}
        parts.append(_some(density, summed, program, u[at], rng, own))
    values = {n: np.concatenate([part[n] for part, _ in parts]) for n in parts[0][0]}
    return values, np.concatenate([log for _, log in parts])


def _some(
    density: UnconstrainedDensity,
    summed: Summed,
    program: Program,
    u: np.ndarray,
    rng: np.random.Generator | None,
    given: Mapping[str, np.ndarray] | None,
) -> tuple[Values, np.ndarray]:
    model, draws = density.target.model, len(u)
    with np.errstate(all="ignore"):
        rest, *tables = program({FREE: u})
    rest = np.broadcast_to(rest, (draws, *summed.rest.shape))
    rows = rest
    if summed.table is not None:
        table = np.broadcast_to(tables[0], (draws, *summed.table.shape))
        each = log_sum_exp(table, axis=2)  # (draws, listed, elements)
        rows = rest + each.sum(axis=-1)
    what = "states that were summed out"
    if given is None:
        assert rng is not None
        row = pick_log(np.moveaxis(rows, -1, 0), rng.random(draws), what)
    else:
        row = _listed_at(summed, given, draws)
    at = np.arange(draws)
    log = rows[at, row] - log_sum_exp(rows, axis=1)
    values: Values = {}
    for name in summed.listed[0]:
        stack = np.stack([state[name] for state in summed.listed])
        values[name] = stack[row].astype(model[name].domain.dtype)  # type: ignore[union-attr]
    if summed.table is not None and summed.labels:
        own = table[at, row]  # (draws, states, elements)
        columns = np.array(summed.states, int)
        if given is None:
            assert rng is not None
            state = pick_log(np.moveaxis(own, 1, 0), rng.random(own[:, 0].shape), what)
        else:
            labels = np.stack([given[n].reshape(draws, -1) for n in summed.labels], axis=-1)
            state = (labels[:, None] == columns[:, None]).all(axis=-1).argmax(axis=1)
        chosen = np.take_along_axis(own, state[:, None], axis=1)[:, 0]
        log = log + (chosen - each[at, row]).sum(axis=-1)
        for k, name in enumerate(summed.labels):
            node = model[name]
            labels = columns[state, k].reshape(draws, *node.plate_shape)
            values[name] = labels.astype(node.domain.dtype)  # type: ignore[union-attr]
    return values, log


def _listed_at(summed: Summed, given: Mapping[str, np.ndarray], draws: int) -> np.ndarray:
    """Which of the listed joint states each draw is in."""
    found = np.zeros(draws, dtype=np.intp)
    if not summed.listed[0]:
        return found
    for k, state in enumerate(summed.listed):
        same = [(given[n] == v).reshape(draws, -1).all(axis=1) for n, v in state.items()]
        found[np.logical_and.reduce(same)] = k
    return found
