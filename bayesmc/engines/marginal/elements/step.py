"""A slice taken in by beliefs about single elements: those that are read are gathered, updated and put back.

Elements that nothing reads cost nothing where they stay what they are; where they move, each is predicted.
A finite node that picks an element by itself is drawn from its posterior, p(pick | what was sampled, what is
believed, the reading), and the particle is weighed by the sum over all picks.

References
----------
Montemerlo, Thrun, Koller and Wegbreit (2002), FastSLAM, AAAI 18; Thrun, Burgard and Fox (2005),
Probabilistic Robotics, sec. 13.3 and 13.6 (data association by particle).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from bayesmc.categorical import log_sum_exp
from bayesmc.dbn import PREVIOUS, Row, Slices
from bayesmc.engines.kalman.data import given_values, pattern_of
from bayesmc.engines.kalman.slices import Layout
from bayesmc.engines.marginal.elements.beliefs import ElementBeliefs
from bayesmc.engines.marginal.elements.places import linearised
from bayesmc.engines.marginal.elements.plan import ElementPlan, Group
from bayesmc.engines.marginal.elements.pool import Pool
from bayesmc.engines.marginal.elements.rows import GroupRow, Looking, present_in
from bayesmc.engines.marginal.elements.updates import Belief, Tangent
from bayesmc.engines.marginal.gaussians import Gaussians, nothing, take_in
from bayesmc.engines.marginal.reading import SliceReader, Values
from bayesmc.engines.marginal.tables.step import Known
from bayesmc.network import Observed


class ElementFilter:
    """The forward step of all elements of the particles of a template.

    Parameters
    ----------
    slices : Slices
    plan : ElementPlan
    apart : tuple of str
        Plates that are filtered separately.
    """

    def __init__(self, slices: Slices, plan: ElementPlan, apart: tuple[str, ...]) -> None:
        self.slices, self.plan, self.apart = slices, plan, apart
        self.layouts = (self._layout(True), self._layout(False))
        self.readers = tuple(SliceReader(layout) for layout in self.layouts)
        self.hidden_before = frozenset(n + PREVIOUS for n in plan.states)
        lead = self.layouts[0].lead
        inner = math.prod(lead[len(apart) :])
        self.weights = lead[: len(apart)]
        self.group = np.arange(math.prod(lead)) // inner
        node = slices.first[plan.states[0]]
        order = np.arange(math.prod(node.plate_shape)).reshape(node.plate_shape)
        turned = order.transpose([node.plates.index(p) for p in (*apart, *plan.plates)])
        #: from flat elements in the plates of the nodes to those of layouts
        self.order = np.empty(order.size, dtype=np.intp)
        self.order[turned.reshape(-1)] = np.arange(order.size)
        self._still: bool | None = None

    def advanced(
        self, row: Row, known: Known, before: ElementBeliefs | None, rng: np.random.Generator
    ) -> tuple[np.ndarray, ElementBeliefs, dict[str, np.ndarray]]:
        """Log densities of the row, shape (particles, *apart), beliefs after it, and values that were drawn.

        Raises
        ------
        ParameterError, UnsupportedError
        """
        log, pool = self.predicted(row, known, before)
        drawn: dict[str, np.ndarray] = {}
        for group in self.plan.groups[min(row.t, 1)]:
            data = GroupRow(group, row)
            if group.picker is not None and not _is_seen(row.seen.get(group.picker)):
                more, pool, picks = self._picked(row, group, data, known, pool, rng)
                drawn[group.picker] = picks
                known = with_more(known, {group.picker: picks})
            elif len(data.some):
                more, pool = self._updated(group, data, known, pool)
            else:
                continue
            log = log + more
        below = self._computed(row, known)
        known = with_more(known, below)
        layout = self.layouts[min(row.t, 1)]
        found = ElementBeliefs(layout, pool, missing=self._missing(row, known, pool))
        return log, found, drawn | below

    def predicted(
        self, row: Row, known: Known, before: ElementBeliefs | None
    ) -> tuple[np.ndarray, Pool]:
        """Elements before anything is read of them, and log densities of those that are seen."""
        n, layout = known.particles, self.layouts[min(row.t, 1)]
        log = np.zeros((n, *self.weights))
        seen = self._seen(row)
        if before is not None and not seen and self._stays(known):
            return log, before.pool
        reader = self.readers[min(row.t, 1)]
        agreed = before is None and not reader.leaves & known.own
        copies = 1 if agreed else n
        start = nothing(layout, copies) if before is None else _dense(before)
        given = given_values(layout, seen, ())
        empty = np.zeros((*layout.lead, layout.n), dtype=bool)
        pattern = pattern_of(layout, empty if given is None else given[1])
        target = np.zeros((*layout.lead, 0))
        if given is not None:
            target = given[0][..., pattern.observed]
        values = Values(
            {k: v for k, v in known.values.items() if k not in known.own},
            {k: known.values[k] for k in known.own & reader.needed},
            copies,
        )
        made = take_in(
            layout, pattern, start, reader.read(values), target, None if given is None else given[0]
        )
        after = made.chosen(None)
        log = log + made.log[:, 0].reshape(copies, *self.weights, -1).sum(axis=-1)
        return log, Pool.of(self._flat(after.mean, 1), self._flat(after.roots(), 2), self.group, n)

    def repeated(self, name: str, known: Known, row: Row) -> Known:
        """Every particle with every state of a finite node."""
        node = self.slices.model(row.t)[name]
        assert node.domain is not None
        codes = np.arange(node.domain.size).astype(node.domain.dtype)
        codes = codes.reshape((-1, *(1,) * len(node.plates)))
        wide = np.broadcast_to(codes, (node.domain.size, *node.plate_shape))
        return known.repeated(node.domain.size, {name: wide})

    def of_batch(self, pool: Pool, at: np.ndarray, batch: int) -> tuple[np.ndarray, np.ndarray]:
        """Beliefs about elements of several copies of each particle, shape (batch, readings, ...)."""
        at = np.broadcast_to(at, (batch, at.shape[1]))
        prior, _ = gathered(pool, at.reshape(pool.particles, -1), pool.particles)
        n = prior.mean.shape[-1]
        return prior.mean.reshape(*at.shape, n), prior.root.reshape(*at.shape, n, n)

    # ---- private -------------------------------------------------------------------------------

    def _flat(self, array: np.ndarray, tail: int) -> np.ndarray:
        """With one axis for all elements, and square roots."""
        found = array.reshape(len(array), len(self.group), *array.shape[array.ndim - tail :])
        if tail == 1 or found.shape[-1] == found.shape[-2]:
            return found
        if found.shape[-1] < found.shape[-2]:
            short = found.shape[-2] - found.shape[-1]
            return np.concatenate([found, np.zeros((*found.shape[:-1], short))], axis=-1)
        turned = np.linalg.qr(np.matrix_transpose(found), mode="r")
        return np.matrix_transpose(turned)

    def _layout(self, is_first: bool) -> Layout:
        """Of the nodes of the plates alone."""
        states = frozenset(self.plan.states)
        before = tuple(n for n in self.slices.interface if n in states)
        layout = Layout(self.slices, (*self.apart, *self.plan.plates), is_first, before, states)
        above = layout.model.above(self.plan.states, lambda n: n in states or n in layout.computed)
        layout.seen, layout.p, layout.certain = {}, 0, ()
        layout.computed = tuple(n for n in layout.computed if n in above)
        layout.order = tuple(n for n in layout.order if n in states or n in layout.computed)
        layout.placed = tuple(n for n in layout.placed if n in states)
        return layout

    def _stays(self, known: Known) -> bool:
        """Whether elements stay what they are, without noise: looked up once."""
        if self._still is None:
            self._still = False
            if self.plan.still:
                static = self.slices.template.static
                plain = {k: v for k, v in known.values.items() if k in static}
                found = self.readers[1].read_choices(plain, 1, 1)
                n = found.moves.shape[-1]
                self._still = bool(
                    (found.moves == np.eye(n)).all()
                    and not found.offset.any()
                    and not found.noise.any()
                )
        return self._still

    def _seen(self, row: Row) -> dict[str, Observed]:
        """What a row says of elements themselves."""
        found = {}
        for name in self.plan.states:
            seen = row.seen.get(name)
            if seen is None:
                continue
            if seen.mask is None:
                found[name] = Observed(
                    seen.value, np.ones(self.slices.first[name].plate_shape, bool)
                )
            elif seen.mask.any() or (seen.parts is not None and seen.parts.any()):
                found[name] = seen
        return found

    def _updated(
        self, group: Group, data: GroupRow, known: Known, pool: Pool
    ) -> tuple[np.ndarray, Pool]:
        """Elements that are read, in rounds in which no particle reads one of them twice."""
        looking = Looking(group, known)
        n = known.particles
        log = np.zeros((n, math.prod(self.weights)))
        for readings in _rounds(looking.at, data.some):
            at = np.where(looking.at < 0, 0, self.order[looking.at])[:, readings]
            prior, put = gathered(pool, at, n)
            none = np.broadcast_to(looking.at[:, readings] < 0, (n, len(readings))).reshape(-1)
            which, reading = np.repeat(np.arange(n), len(readings)), np.tile(readings, n)
            every = len(which)

            def tangent(
                points: np.ndarray, some: np.ndarray, own: Any = (which, reading, every, none)
            ) -> Tangent:
                which, reading, every, none = own
                if len(some) == every:
                    grid = np.zeros((n, group.count, points.shape[-1]))
                    grid[which, reading] = points
                    found = Tangent(*(a[which, reading] for a in looking.grid(grid)))
                else:
                    found = looking.some(which[some], reading[some], points)
                if none.any():
                    found.slopes[none[some]] = 0.0
                return found

            made = linearised(prior, data.of(reading), tangent, group.bent)
            after, own = made.conditioned(prior)
            pool = put(after)
            np.add.at(
                log, (which, np.broadcast_to(self.group[at], (n, len(readings))).reshape(-1)), own
            )
        return log.reshape(n, *self.weights), pool

    def _picked(
        self,
        row: Row,
        group: Group,
        data: GroupRow,
        known: Known,
        pool: Pool,
        rng: np.random.Generator,
    ) -> tuple[np.ndarray, Pool, np.ndarray]:
        """Picks drawn given the readings, one after the other, and elements updated by them."""
        assert group.picker is not None
        node = self.slices.model(row.t)[group.picker]
        assert node.domain is not None
        n, states = known.particles, node.domain.size
        prior_log = self.log_prior(row, group.picker, known)
        looking = Looking(group, self.repeated(group.picker, known, row))
        places = np.broadcast_to(looking.at, (n * states, group.count)).reshape(n, states, -1)
        picks = np.zeros((n, group.count), dtype=node.domain.dtype)
        log = np.zeros((n, math.prod(self.weights)))
        for r in range(group.count):
            at = np.where(places[..., r] < 0, 0, self.order[places[..., r]])
            own = prior_log[..., r]
            possible = np.flatnonzero(own.reshape(-1) > -np.inf)
            prior, _ = gathered(pool, at, n)
            joint, made = np.array(own), None
            if data.present[r].any():
                some = Belief(prior.mean[possible], prior.root[possible])

                def tangent(
                    points: np.ndarray, which: np.ndarray, of: Any = (possible, r)
                ) -> Tangent:
                    chosen = of[0][which]
                    found = looking.some(chosen, np.full(len(which), of[1]), points)
                    found.slopes[looking_none(places, chosen, of[1])] = 0.0
                    return found

                given = data.of(np.full(len(possible), r))
                made = linearised(some, given, tangent, group.bent)
                flat = joint.reshape(-1)
                flat[possible] += made.log_predictive(some)
                joint = flat.reshape(own.shape)
            level = log_sum_exp(joint, axis=1)
            np.add.at(log, (np.arange(n), self.group[at[:, 0]]), level)
            chosen = _drawn(joint, rng)
            picks[:, r] = chosen
            if made is not None:
                flat = np.arange(n) * states + chosen
                back = np.searchsorted(possible, flat)
                back = np.minimum(back, len(possible) - 1)
                own_prior = Belief(prior.mean[flat], prior.root[flat])
                after, _ = made.of(back).conditioned(own_prior)
                gone = level == -np.inf
                after = Belief(
                    np.where(gone[:, None], own_prior.mean, after.mean),
                    np.where(gone[:, None, None], own_prior.root, after.root),
                )
                pool = gathered(pool, at[np.arange(n), chosen][:, None], n)[1](after)
        value = picks.reshape(n, *node.plate_shape)
        value.flags.writeable = False
        return log.reshape(n, *self.weights), pool, value

    def log_prior(self, row: Row, name: str, known: Known) -> np.ndarray:
        """Log probabilities of a finite node's states, shape (particles, states, elements)."""
        model = self.slices.model(row.t)
        node = model[name]
        assert node.domain is not None
        result = model.evaluate(name, known.values)[0]
        n, states = known.particles, node.domain.size
        found = np.empty((n, states, math.prod(node.plate_shape)))
        shape = (n, *node.plate_shape)
        for k in range(states):
            value = np.full(node.plate_shape, k, dtype=node.domain.dtype)
            log = np.broadcast_to(model.log_density(name, result, value), shape)
            found[:, k] = log.reshape(n, -1)
        seen = row.seen.get(name)
        if seen is not None and seen.mask is not None:
            off = seen.value.reshape(-1) != np.arange(states)[:, None]
            found = np.where(off & seen.mask.reshape(-1), -np.inf, found)
        return found

    def _computed(self, row: Row, known: Known) -> dict[str, np.ndarray]:
        """Nodes that are computed from what was picked."""
        model, found = self.slices.model(row.t), {}
        values = dict(known.values)
        for name in model.nodes:
            if name in self.plan.below:
                found[name] = values[name] = model.evaluate(name, values)[0]
        return found

    def _missing(
        self, row: Row, known: Known, pool: Pool
    ) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Means and variances of readings that are not there, where they are no angles."""
        found: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        n = known.particles
        for group in self.plan.groups[min(row.t, 1)]:
            nodes = [look.node for look in group.looks]
            lacking = [x for x in nodes if not present_in(x, row.seen.get(x.name)).all()]
            if not any(x.angles is None for x in lacking):
                continue
            looking = Looking(group, known)
            at = np.where(looking.at < 0, 0, self.order[looking.at])
            prior, _ = gathered(pool, at, n)
            mean = prior.mean.reshape(n, group.count, -1)
            root = prior.root.reshape(n, group.count, *prior.root.shape[1:])
            for node, (seen, slopes) in zip(nodes, looking.moments(mean), strict=True):
                if node not in lacking or node.angles is not None:
                    continue
                left = slopes @ root
                variance = np.vecdot(left, left) + np.vecdot(seen.noise, seen.noise)
                there, own = present_in(node, row.seen.get(node.name)), row.seen.get(node.name)
                value = 0.0 if own is None else own.value
                shape = (n, *node.value_shape)
                found[node.name] = (
                    np.where(there, value, seen.mean.reshape(shape)),
                    np.where(there, 0.0, variance.reshape(shape)),
                )
        return found


def gathered(pool: Pool, at: np.ndarray, particles: int) -> tuple[Belief, Any]:
    """Beliefs of each particle about its elements, one after the other, and what puts them back.

    Parameters
    ----------
    at : ndarray of int, shape (particles or 1, k)
        Elements, different ones where they are to be put back.
    """
    k = at.shape[1]
    if len(at) == 1:
        mean, root = pool.at(at[0])

        def put(after: Belief) -> Pool:
            n = after.mean.shape[-1]
            return pool.put(at[0], after.mean.reshape(-1, k, n), after.root.reshape(-1, k, n, n))

        return Belief(mean.reshape(-1, mean.shape[-1]), root.reshape(-1, *root.shape[2:])), put
    ids, local = np.unique(at, return_inverse=True)
    local = local.reshape(at.shape)
    mean, root = pool.at(ids)
    every = np.arange(particles)[:, None]

    def scatter(after: Belief) -> Pool:
        n = after.mean.shape[-1]
        means, roots = np.array(mean), np.array(root)
        means[every, local] = after.mean.reshape(-1, k, n)
        roots[every, local] = after.root.reshape(-1, k, n, n)
        return pool.put(ids, means, roots)

    own_mean, own_root = mean[every, local], root[every, local]
    return Belief(
        own_mean.reshape(-1, own_mean.shape[-1]), own_root.reshape(-1, *own_root.shape[2:])
    ), scatter


# ---- private ------------------------------------------------------------------------------------


def looking_none(places: np.ndarray, chosen: np.ndarray, reading: int) -> np.ndarray:
    """Which of some picks read no element."""
    return places.reshape(-1, places.shape[-1])[chosen, reading] < 0


def _rounds(at: np.ndarray, readings: np.ndarray) -> list[np.ndarray]:
    """Readings in rounds: in none of them any particle has an element twice."""
    own = at[:, readings]
    if len(at) > 1:
        each = np.sort(own, axis=1)
        if ((each[:, 1:] == each[:, :-1]) & (each[:, 1:] >= 0)).any():
            return [readings[k : k + 1] for k in range(len(readings))]
        return [readings]
    met: dict[int, int] = {}
    number = []
    for element in own[0].tolist():
        met[element] = met.get(element, -1) + 1
        number.append(met[element])
    rounds = np.array(number)
    return [readings[rounds == k] for k in range(rounds.max(initial=-1) + 1)]


def _drawn(log: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A state for each particle by the exponentials of logs, shape (particles, states)."""
    top = log.max(axis=1, keepdims=True)
    shares = np.exp(log - np.where(top > -np.inf, top, 0.0)).cumsum(axis=1)
    level = rng.random(len(log)) * shares[:, -1]
    return np.minimum((shares <= level[:, None]).sum(axis=1), log.shape[1] - 1)


def _dense(before: ElementBeliefs) -> Gaussians:
    mean, root = before.dense()
    c = before.layout.carried
    return Gaussians(before.layout, mean[..., :c], root[..., :c, :], None)


def _is_seen(seen: Observed | None) -> bool:
    return seen is not None and seen.mask is None


def with_more(known: Known, more: Mapping[str, np.ndarray]) -> Known:
    """What is known, with more values of each particle."""
    return Known({**known.values, **more}, known.own | more.keys(), known.particles)
