"""States of finite nodes that were summed out, drawn given the numbers: the way back of ``summing``."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from bayesmc.categorical import log_sum_exp, pick_log
from bayesmc.expression import Program
from bayesmc.passes.arrays import for_arrays
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
    """See ``StateDraws``; for those who ask once."""
    return StateDraws(density)(u, rng, given)


class StateDraws:
    """Stored values of the nodes that are summed out, and the log probability of these states given ``u``.

    Called with ``u`` of shape ``(draws, size)``, and

    - ``rng``, by which states are drawn;
    - ``given``, node -> states, shape ``(draws, *plates)``, whose probability is asked for instead;
    - ``values``, stored values of hidden nodes that do not move, shape ``(draws, *plates, *event)``,

    it returns node -> states, shape ``(draws, *plates)``, and log probabilities, shape ``(draws,)``.

    Parameters
    ----------
    density : UnconstrainedDensity

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.summed_states import StateDraws
    >>> from bayesmc.structure.target import target_of
    >>> from bayesmc.structure.unconstrained import unconstrained_density
    >>> net = bmc.BayesNet()
    >>> net.add("z", bmc.Bernoulli(0.5))
    >>> net.add("x", lambda z: bmc.Normal(4.0 * z, 1.0))
    >>> net.add("y", lambda x: bmc.Normal(x, 1.0))
    >>> density = unconstrained_density(target_of(pose(net, {"y": 1.0})), None, ["z"])
    >>> values, log = StateDraws(density)(np.array([[4.0], [-3.0]]), np.random.default_rng(0))
    >>> values["z"], log.round(4)
    (array([1, 0], dtype=uint8), array([-0.0003, -0.    ]))
    """

    def __init__(self, density: UnconstrainedDensity) -> None:
        self.density = density
        roots = [[t.rest] if t.table is None else [t.rest, t.table] for t in density.tables]
        self._programs = [Program(for_arrays(own)) for own in roots]
        self._entries = [max(sum(math.prod(r.shape) for r in own), 1) for own in roots]

    def __call__(
        self,
        u: np.ndarray,
        rng: np.random.Generator | None,
        given: Mapping[str, np.ndarray] | None = None,
        values: Mapping[str, np.ndarray] | None = None,
    ) -> tuple[Values, np.ndarray]:
        found: Values = {}
        log = np.zeros(len(u))
        read = {n: values[n] for n in self.density.others} if values is not None else {}
        for k, summed in enumerate(self.density.tables):
            names = (*summed.listed[0], *summed.labels)
            count, parts = max(_ENTRIES // self._entries[k], 1), []
            for first in range(0, len(u), count):
                at = slice(first, first + count)
                own = None if given is None else {n: given[n][at] for n in names}
                leaves = {FREE: u[at], **{n: v[at] for n, v in read.items()}}
                parts.append(_some(self.density, summed, self._programs[k], leaves, rng, own))
            found.update({n: np.concatenate([part[n] for part, _ in parts]) for n in names})
            log += np.concatenate([own for _, own in parts])
        return found, log


# ---- private ------------------------------------------------------------------------------------


def _some(
    density: UnconstrainedDensity,
    summed: Summed,
    program: Program,
    leaves: Mapping[str, np.ndarray],
    rng: np.random.Generator | None,
    given: Mapping[str, np.ndarray] | None,
) -> tuple[Values, np.ndarray]:
    model, draws = density.target.model, len(leaves[FREE])
    with np.errstate(all="ignore"):
        rest, *tables = program(leaves)
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
