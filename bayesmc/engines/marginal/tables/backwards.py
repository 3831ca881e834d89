"""What later rows say of tables, and finite nodes drawn along whole paths of what is sampled.

Given a path of the sampled nodes the finite ones are hidden Markov models, one for each table. Messages go
backwards as in any of them: the message to a slice is, for each state there, the density of all rows after
it along the path. A particle's table times the message, summed, says how well the particle goes with a path;
the tables of a path's own forward pass times the messages are smoothed ones, and states drawn from the first
slice on, each given the one before, are joint draws.

References
----------
Rabiner (1989), A tutorial on hidden Markov models, Proc. IEEE 77, sec. III; Särkkä (2013), Bayesian Filtering
and Smoothing, sec. 11.4 (backward simulation of what is sampled, the rest integrated out).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bayesmc.categorical import log_sum_exp
from bayesmc.dbn import Row
from bayesmc.engines.marginal.tables.beliefs import Tables, drawn
from bayesmc.engines.marginal.tables.groups import Told
from bayesmc.engines.marginal.tables.reading import particle_rows
from bayesmc.engines.marginal.tables.step import Known, TableFilter

#: numbers that are looked at at once
_ENTRIES = 1 << 18
#: of each group, logs by path, element and state: densities of later rows
Messages = tuple[np.ndarray, ...]


class Along(NamedTuple):
    """Tables along paths.

    Attributes
    ----------
    smoothed : Tables
    codes : list of ndarray, shapes (paths, elements)
        A joint draw, given that of the slice before.
    forward : Tables
        Given the rows so far.
    """

    smoothed: Tables
    codes: list[np.ndarray]
    forward: Tables


def told_by(tables: TableFilter, row: Row, known: Known) -> list[Told]:
    """What a slice and its row say of the tables of each group, in it and in the slice before."""
    rows = particle_rows(row, known.values, known.own, known.particles)
    return [step.told(rows) for step in tables.steps]


def nothing_after(tables: TableFilter, paths: int) -> Messages:
    """To the last slice."""
    return tuple(np.zeros((paths, g.elements, g.states)) for g in tables.plan.groups)


def pulled_tables(told: Sequence[Told], messages: Messages) -> Messages:
    """To the slice before; ``told`` is of the one that has these."""
    found = []
    for (pair, log), message in zip(told, messages, strict=True):
        assert pair is not None
        found.append(log_sum_exp(pair + (log + message)[..., None, :], axis=-1))
    return tuple(found)


def log_evidence_of(
    messages: Messages, of: np.ndarray, tables: Tables, which: np.ndarray
) -> np.ndarray:
    """Log densities of later rows by some particles' tables, shape (pairs,).

    Parameters
    ----------
    of, which : ndarray of int, shape (pairs,)
        Places of the messages, and particles.
    """
    total = np.zeros(len(of))
    for message, log in zip(messages, tables.logs, strict=True):
        step = max(1, _ENTRIES // (log.shape[1] * log.shape[2]))
        for low in range(0, len(of), step):
            at = slice(low, low + step)
            both = message[of[at]] + log[which[at]]
            total[at] += log_sum_exp(both, axis=-1).sum(axis=-1)
    return total


def along(
    told: Sequence[Told],
    messages: Messages,
    before: Along | None,
    tables: TableFilter,
    rng: np.random.Generator,
) -> Along:
    """Tables of a slice given whole paths and all rows, and a draw."""
    forward, smoothed, codes = [], [], []
    for k, ((pair, log), message) in enumerate(zip(told, messages, strict=True)):
        now = log
        if pair is not None:
            assert before is not None
            now = log + log_sum_exp(before.forward.logs[k][..., :, None] + pair, axis=-2)
        forward.append(_normalised(now))
        smoothed.append(_normalised(now + message))
        given = log + message
        if pair is None:
            codes.append(drawn(_normalised(given), rng))
            continue
        assert before is not None
        own = before.codes[k]
        wide = np.broadcast_to(pair, (*own.shape, *pair.shape[-2:]))
        row = np.take_along_axis(wide, own[..., None, None], -2)[..., 0, :]
        codes.append(drawn(_normalised(given + row), rng))
    groups = tables.plan.groups
    return Along(Tables(groups, tuple(smoothed)), codes, Tables(groups, tuple(forward)))


# ---- private ------------------------------------------------------------------------------------


def _normalised(log: np.ndarray) -> np.ndarray:
    total = log_sum_exp(log, axis=-1)[..., None]
    return log - np.where(total > -np.inf, total, 0.0)
