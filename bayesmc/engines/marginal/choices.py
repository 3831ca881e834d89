"""Finite sampled nodes drawn with a look at the row: p(s_t | s_{t-1}, y_t), the mixture Kalman filter.

Every particle's Kalman filter takes the row in for each joint state of these nodes. One is drawn by the
product of its probability and the predictive density; the particle's weight is the sum of these products,
whatever was drawn.

References
----------
Chen and Liu (2000), Mixture Kalman filters, J. R. Statist. Soc. B 62, sec. 3.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.categorical import log_sum_exp
from bayesmc.dbn import Row
from bayesmc.engines.kalman.reading import Linear
from bayesmc.engines.kalman.slices import Layout
from bayesmc.engines.marginal.gaussians import Coefficients
from bayesmc.engines.marginal.linearised import LinearisedReader
from bayesmc.engines.marginal.predictive import Expected
from bayesmc.engines.marginal.reading import Kinds, SliceReader, Values
from bayesmc.engines.particles.smc import along_plates
from bayesmc.engines.slice_steps import SlicePlan
from bayesmc.errors import UnsupportedError
from bayesmc.network.forward import summed
from bayesmc.structure.tables import configurations

#: kinds whose coefficients are kept
_KEPT = 1024
#: joint states of the finite nodes of a slice above which it refuses
MOST = 256


class Choices:
    """Joint states of the finite nodes that are sampled in slices of one layout.

    Parameters
    ----------
    layout : Layout
    full : frozenset of str
        Nodes that are seen in full.
    plan : SlicePlan

    Attributes
    ----------
    names : tuple of str
    values : dict
        Node -> stored values by choice, shape (choices, *plates).

    Raises
    ------
    UnsupportedError
        A sampled node is not finite, or there are too many joint states.
    """

    def __init__(self, layout: Layout, full: frozenset[str], plan: SlicePlan) -> None:
        self.layout, self.plan = layout, plan
        self.names = tuple(n for n in layout.certain if n not in full)
        nodes = [layout.model[n] for n in self.names]
        count = 1.0
        for node in nodes:
            if node.domain is None:
                raise UnsupportedError(
                    f'ParticleFilter(marginalize=..., proposal="optimal") draws finite nodes given the row, '
                    f"and {node.name!r}, which is sampled (as missing readings are), is not finite; "
                    "give proposal={...} or none"
                )
            others = [
                n
                for p, n in zip(node.plates, node.plate_shape, strict=True)
                if p not in layout.apart
            ]
            count *= float(node.domain.size) ** float(np.prod(others))
        if count > MOST:
            raise UnsupportedError(
                f'ParticleFilter(marginalize=..., proposal="optimal") goes through the joint states of '
                f"{', '.join(map(repr, self.names))}, which are {count:.4g}, more than "
                f"{MOST}; leave proposal= out"
            )
        found, sizes = configurations([], nodes, layout.apart)
        self.count = int(np.prod(sizes))
        self._kept: dict[tuple[tuple[str, ...], int], int] = {}
        self._made: list[np.ndarray] = []
        self._seen_alone: bool | None = None
        self.values = {
            n.name: np.broadcast_to(v, (*sizes, *n.plate_shape)).reshape(-1, *n.plate_shape)
            for n, v in zip(nodes, found, strict=True)
        }

    def read(
        self, values: Values, row: Row, reader: SliceReader
    ) -> tuple[np.ndarray, Coefficients]:
        """Log probabilities of all choices and of what is seen given these alone; and the coefficients.

        The first have shape ``(particles, choices, *lead)``.
        """
        kinds = reader.kinds(values, sorted(values.own))
        if kinds is None:
            log, made = self._worked_out(values, None, row, reader)
            return log, Coefficients(*made, None)
        if self._changes(values, row, reader):
            log, made = self._worked_out(values, kinds.of_kind, row, reader)
            kind = kinds.kind
        else:
            log, made, kind = self._remembered(values, kinds, row, reader)
        offset = made.offset.take(kind, axis=0)
        return log.take(kind, axis=0), Coefficients(offset, made.moves, made.noise, kind)

    def expected(
        self, values: Values, row: Row, reader: LinearisedReader
    ) -> tuple[np.ndarray, Expected] | None:
        """As `read`, where of all numbers only what is seen depends on the choice; else None."""
        if self._seen_alone is False:
            return None
        both = self._with_choices(values, None)
        if self._seen_alone is None:
            self._seen_alone = reader.seen_alone(self.names, both)
            if not self._seen_alone:
                return None
        log = self._log_factors(dict(both), row).reshape(values.particles, self.count)
        return log, reader.expected(values.at(None), both, self.count)

    def drawn(self, log: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """The logs' sums over choices, and one choice for each particle by them, shape (particles, *lead)."""
        total = log_sum_exp(log, axis=1)
        level = np.where(total > -np.inf, total, 0.0)
        shares = np.exp(log - level[:, None]).cumsum(axis=1)
        u = rng.random(total.shape) * shares[:, -1]
        at = (shares < u[:, None]).sum(axis=1)
        return total, np.minimum(at, self.count - 1)

    def values_at(self, at: np.ndarray) -> dict[str, np.ndarray]:
        """Stored values of the choices that were drawn."""
        found = {}
        for name, value in self.values.items():
            node = self.layout.model[name]
            if at.ndim == 1:
                own = value.take(at, axis=0)
            else:
                own = along_plates(value, at, node.plates, self.layout.apart)
            own.flags.writeable = False
            found[name] = own
        return found

    # ---- private -------------------------------------------------------------------------------

    def _changes(self, values: Values, row: Row, reader: SliceReader) -> bool:
        """Whether anything is read, or seen of a node with a value, that other slices have otherwise."""
        seen = any(name in row.seen for name in self.layout.certain)
        return seen or reader.changing(values, reader.needed)

    def _remembered(
        self, values: Values, kinds: Kinds, row: Row, reader: SliceReader
    ) -> tuple[np.ndarray, Linear, np.ndarray]:
        """Log densities and coefficients of all kinds so far, and which each particle has."""
        names = tuple(sorted(values.own))
        keys = [(names, code) for code in kinds.codes.tolist()]
        if len(self._kept.keys() | keys) > _KEPT:
            self._kept, self._made = {}, []
        new = [k for k, key in enumerate(keys) if key not in self._kept]
        if new:
            log, made = self._worked_out(values, kinds.of_kind[new], row, reader)
            for k in new:
                self._kept[keys[k]] = len(self._kept)
            old = self._made or [part[:0] for part in (log, *made)]
            self._made = [np.concatenate(p) for p in zip(old, (log, *made), strict=True)]
        place = np.array([self._kept[key] for key in keys], dtype=np.intp)
        log, *parts = self._made
        return log, Linear(*parts), place.take(kinds.kind)

    def _worked_out(
        self, values: Values, which: np.ndarray | None, row: Row, reader: SliceReader
    ) -> tuple[np.ndarray, Linear]:
        """Log densities and coefficients by kind and choice; every particle is a kind with None."""
        count = values.particles if which is None else len(which)
        both = self._with_choices(values, which)
        log = self._log_factors(dict(both), row).reshape(count, self.count, *self.layout.lead)
        return log, reader.read_choices(both, count, self.count)

    def _with_choices(self, values: Values, which: np.ndarray | None) -> dict[str, np.ndarray]:
        """Known values with an axis of kinds and choices together first."""
        count = values.particles if which is None else len(which)
        both = {
            name: value.repeat(self.count, axis=0) if name in values.own else value
            for name, value in values.at(which).items()
        }
        for name, value in self.values.items():
            both[name] = np.tile(value, (count, *(1,) * (value.ndim - 1)))
        return both

    def _log_factors(self, values: dict[str, np.ndarray], row: Row) -> np.ndarray:
        """Log densities of all nodes that have a value, shape (kinds * choices, *lead)."""
        layout, model = self.layout, self.layout.model
        batch = len(next(iter(values[n] for n in self.names)))
        total: Any = np.zeros((batch, *layout.lead))
        for name in layout.order:
            if name in layout.computed:
                values[name] = model.evaluate(name, values)[0]
            if name not in layout.certain:
                continue
            node = model[name]
            log = np.asarray(model.log_density(name, model.evaluate(name, values)[0], values[name]))
            seen = row.seen.get(name)
            if name in self.names and seen is not None and seen.mask is not None:
                off = (values[name] != seen.value) & seen.mask
                log = np.where(off, -np.inf, log)
            total = total + summed(log, node, layout.apart)
        return total
