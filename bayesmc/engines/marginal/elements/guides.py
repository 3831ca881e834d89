"""A sampled vector drawn with a look at what is read of elements: the proposal of FastSLAM 2.0.

Its density given the slice before is matched by a Gaussian, readings are made linear in it and in what they
pick, whose uncertainty adds to the noise, and it is drawn from what the readings leave of the
Gaussian; a tenth of the particles from its own density. Readings whose pick is not known count, in the
proposal, as of the likeliest pick. Whatever the proposal is, the weight has p/q, and picks are summed over.

References
----------
Montemerlo, Thrun, Koller and Wegbreit (2003), FastSLAM 2.0, IJCAI 18; Thrun, Burgard and Fox (2005),
Probabilistic Robotics, sec. 13.4; Hesterberg (1995), Technometrics 37 (mixtures that keep weights bounded).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from bayesmc.dbn import Row, Slices
from bayesmc.distributions.circular import wrap_angle
from bayesmc.engines.kalman.slices import covariance_root
from bayesmc.engines.marginal.elements.beliefs import ElementBeliefs
from bayesmc.engines.marginal.elements.beside import Beside
from bayesmc.engines.marginal.elements.plan import ElementPlan, Group, descendants
from bayesmc.engines.marginal.elements.pool import Pool
from bayesmc.engines.marginal.elements.rows import GroupRow, Looking
from bayesmc.engines.marginal.elements.step import ElementFilter, gathered, with_more
from bayesmc.engines.marginal.tables.step import Known
from bayesmc.errors import BayesmcError, TraceError

#: share of the particles that are drawn from the node's own density
DEFENCE = 0.1
#: times that readings are made linear
_ROUNDS = 3


def why_not_guided(slices: Slices, elements: ElementPlan, name: str) -> str | None:
    """Why a sampled node is not drawn with a look at readings of elements, to follow its name; or None."""
    for first, model in ((True, slices.first), (False, slices.later)):
        node = model[name]
        if node.plates or node.is_discrete or node.domain is not None or len(node.event_shape) > 1:
            return "is no single number or vector"
        angles = 0 if node.angles is None else int(np.count_nonzero(node.angles))
        if angles > 1:
            return "has more than one angle"
        below = descendants(slices, model, {name})
        late = elements.late
        others = [n for n in below if model[n].is_stochastic and n not in late]
        other = next((n for n in others if _goes_on(slices, model, n)), None)
        if other is not None:
            return f"is read by {other!r}, which other nodes read"
        if below & set(elements.states):
            return f"is read by {elements.states[0]!r}, which is integrated out"
        looks = [look for g in elements.groups[0 if first else 1] for look in g.looks]
        read = [look for look in looks if name in look.leaves]
        if not read and not first:
            return "is read by nothing that is read of elements"
        try:
            for look in read:
                look.prepare(name)
            own = model.evaluate(name, model.probe)[0]
            if covariance_root(own) is None:
                np.sqrt(own.var)
            np.asarray(own.mean)
        except (TraceError, BayesmcError, AttributeError, NotImplementedError) as error:
            return f"has no derivative, or no moments, that are known ({error})"
    return None


def read_beside(slices: Slices, elements: ElementPlan, name: str) -> list[str]:
    """Stochastic nodes below a guided one that are no readings of elements: they wait until it is drawn."""
    found = {n for m in (slices.first, slices.later) for n in descendants(slices, m, {name})
             if m[n].is_stochastic and n not in elements.late}  # fmt: skip
    return [n for n in slices.dynamic if n in found]


class Gaussian(NamedTuple):
    """Means, shape (particles, m), and roots of covariances, (particles, m, m)."""

    mean: np.ndarray
    root: np.ndarray


class Guide:
    """Draws one sampled node with a look at the row.

    Parameters
    ----------
    slices : Slices
    elements : ElementFilter
    name : str
    """

    def __init__(self, slices: Slices, elements: ElementFilter, name: str) -> None:
        self.slices, self.elements, self.name = slices, elements, name
        below = {
            n
            for model in (slices.first, slices.later)
            for n in descendants(slices, model, {name})
            if not model[n].is_stochastic
        }
        self.beside = Beside(slices, name, read_beside(slices, elements.plan, name))
        #: nodes that steps of a slice leave out: it, what is computed from it, and what else reads it
        self.waiting = frozenset(below | {name, *self.beside.others})

    def drawn(
        self, row: Row, known: Known, before: ElementBeliefs | None, rng: np.random.Generator
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Logs of p/q, shape (particles,), and values of the node and of what is computed from it.

        Raises
        ------
        ParameterError
        """
        model, n = self.slices.model(row.t), known.particles
        node = model[self.name]
        own = model.evaluate(self.name, known.values)[0]
        prior = _moments(own, node, n)
        angles = np.zeros(node.event_shape, bool) if node.angles is None else node.angles
        angles = np.broadcast_to(angles, node.event_shape).reshape(-1)
        told = self._told(row, known, before, prior, angles)
        is_plain = rng.random(n) < DEFENCE
        guided = told.mean + np.matvec(told.root, rng.standard_normal(told.mean.shape))
        plain = own.sample_to(rng, (n, *node.plate_shape)).reshape(n, -1)
        flat = np.where(is_plain[:, None], plain, guided)
        flat = np.where(angles, wrap_angle(flat), flat)
        value = flat.reshape(n, *node.event_shape)
        log_p = np.broadcast_to(model.log_density(self.name, own, value), (n,))
        log_q = np.logaddexp(
            math.log1p(-DEFENCE) + _log_density(told, flat, angles), math.log(DEFENCE) + log_p
        )
        value.flags.writeable = False
        found = self._with_computed(row, known, {self.name: value})
        more = self.beside.log(row, with_more(known, found))
        return log_p - log_q + more, found

    # ---- private -------------------------------------------------------------------------------

    def _with_computed(
        self, row: Row, known: Known, values: dict[str, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """Values with those that are computed from them."""
        model, every, found = self.slices.model(row.t), {**known.values, **values}, dict(values)
        for name in model.nodes:
            late = name in self.elements.plan.below
            beside = name == self.name or name in self.beside.others
            if name in self.waiting and not beside and not late:
                found[name] = every[name] = model.evaluate(name, every)[0]
        return found

    def _told(
        self,
        row: Row,
        known: Known,
        before: ElementBeliefs | None,
        prior: Gaussian,
        angles: np.ndarray,
    ) -> Gaussian:
        """What readings leave of the Gaussian."""
        n, node = known.particles, self.slices.model(row.t)[self.name]
        pool = self.elements.predicted(row, known, before)[1]
        m = prior.mean.shape[-1]
        z, precision = np.zeros((n, m)), np.broadcast_to(np.eye(m), (n, m, m))
        picks: dict[str, np.ndarray] = {}
        for k in range(_ROUNDS):
            point = prior.mean + np.matvec(prior.root, z)
            point = np.where(angles, wrap_angle(point), point)
            value = {self.name: point.reshape(n, *node.event_shape)}
            here = with_more(known, self._with_computed(row, known, value))
            if not k:
                picks = self._picked(row, here, pool, prior)
            here = with_more(here, picks)
            rows = [*self._rows(row, here, pool), *self.beside.rows(row, here)]
            if not rows:
                return prior
            seen = np.concatenate([r[0] for r in rows], axis=1) @ prior.root
            off = np.concatenate([r[1] for r in rows], axis=1)
            turned = np.matrix_transpose(seen)
            precision = np.eye(m) + turned @ seen
            target = np.matvec(turned, off + np.matvec(seen, z))
            z = np.linalg.solve(precision, target[..., None])[..., 0]
        covariance = np.linalg.inv(precision)
        root = prior.root @ np.linalg.cholesky(0.5 * (covariance + np.matrix_transpose(covariance)))
        return Gaussian(prior.mean + np.matvec(prior.root, z), root)

    def _rows(self, row: Row, known: Known, pool: Pool) -> list[Any]:
        """Of each group: how readings move with the node, and how far they are off, standardised."""
        found = []
        for group in self.elements.plan.groups[min(row.t, 1)]:
            data = GroupRow(group, row)
            some = data.some
            if not len(some) or self.name not in group.leaves:
                continue
            found.append(self._standardised(group, data, known, pool, some))
        return found

    def _standardised(
        self, group: Group, data: GroupRow, known: Known, pool: Pool, some: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        n = known.particles
        looking = Looking(group, known)
        at = np.where(looking.at < 0, 0, self.elements.order[looking.at])
        prior, _ = gathered(pool, at, n)
        mean = prior.mean.reshape(n, group.count, -1)
        root = prior.root.reshape(n, group.count, *prior.root.shape[1:])[:, some]
        made = looking.grid(mean)
        along = looking.slopes_along(self.name, mean)[:, some]
        slopes, noise, expected = made.slopes[:, some], made.noise[:, some], made.mean[:, some]
        left = slopes @ root
        both = left @ np.matrix_transpose(left) + noise @ np.matrix_transpose(noise)
        present = data.present[some]
        wide = present[:, :, None] & present[:, None, :]
        both = np.where(wide, both, np.eye(both.shape[-1]))
        own = data.of(some)
        off = own.off(expected)
        along = np.where(present[..., None], along, 0.0)
        good = np.isfinite(both).all((-2, -1)) & np.isfinite(along).all((-2, -1))
        good &= np.isfinite(off).all(-1)
        both = np.where(good[..., None, None], both, np.eye(both.shape[-1]))
        scale = np.linalg.cholesky(both)
        seen = np.linalg.solve(scale, np.where(good[..., None, None], along, 0.0))
        away = np.linalg.solve(scale, np.where(good[..., None], off, 0.0)[..., None])[..., 0]
        return seen.reshape(n, -1, seen.shape[-1]), away.reshape(n, -1)

    def _picked(self, row: Row, known: Known, pool: Pool, prior: Gaussian) -> dict[str, np.ndarray]:
        """The likeliest picks, the node's own spread taken for noise."""
        found = {}
        for group in self.elements.plan.groups[min(row.t, 1)]:
            seen = None if group.picker is None else row.seen.get(group.picker)
            if group.picker is None or (seen is not None and seen.mask is None):
                continue
            node = self.slices.model(row.t)[group.picker]
            assert node.domain is not None
            data, n, states = GroupRow(group, row), known.particles, node.domain.size
            log = self.elements.log_prior(row, group.picker, known)
            wide = self.elements.repeated(group.picker, known, row)
            each = wide.particles // n
            if len(data.some):
                spread = Gaussian(prior.mean.repeat(each, 0), prior.root.repeat(each, 0))
                told = self._likelihood(group, data, wide, pool, spread)
                log = log + told.reshape(n, states, -1)
            picks = log.argmax(axis=1).astype(node.domain.dtype)
            found[group.picker] = picks.reshape(n, *node.plate_shape)
        return found

    def _likelihood(
        self, group: Group, data: GroupRow, known: Known, pool: Pool, prior: Gaussian
    ) -> np.ndarray:
        """Log densities of readings, shape (batch, readings)."""
        n = known.particles
        looking = Looking(group, known)
        at = np.where(looking.at < 0, 0, self.elements.order[looking.at])
        mean, root = self.elements.of_batch(pool, at, n)
        made = looking.grid(mean)
        parts = [made.slopes @ root, made.noise]
        if self.name in group.leaves:
            parts.append(looking.slopes_along(self.name, mean) @ prior.root[:, None])
        both: Any = sum(p @ np.matrix_transpose(p) for p in parts)
        present = np.broadcast_to(data.present, made.mean.shape)
        wide = present[..., :, None] & present[..., None, :]
        both = np.where(wide, both, np.eye(both.shape[-1]))
        good = np.isfinite(both).all((-2, -1))
        scale = np.linalg.cholesky(np.where(good[..., None, None], both, np.eye(both.shape[-1])))
        off = data.of(np.arange(group.count)).off(made.mean)
        good &= np.isfinite(off).all(-1)
        eta = np.linalg.solve(scale, np.where(good[..., None], off, 0.0)[..., None])[..., 0]
        log = -0.5 * np.vecdot(eta, eta) - np.log(np.diagonal(scale, 0, -2, -1)).sum(-1)
        log = log - 0.5 * present.sum(-1) * math.log(2 * math.pi)
        return np.where(good, log, -np.inf)


# ---- private ------------------------------------------------------------------------------------


def _goes_on(slices: Slices, model: Any, name: str) -> bool:
    """Whether other stochastic nodes, of this slice or the next, read a node."""
    below = descendants(slices, model, {name})
    return name in slices.interface or any(model[n].is_stochastic for n in below)


def _moments(own: Any, node: Any, count: int) -> Gaussian:
    m = math.prod(node.event_shape)
    mean = np.broadcast_to(own.mean, (count, *node.event_shape)).reshape(count, m)
    root = covariance_root(own)
    if root is None:
        scale = np.sqrt(np.broadcast_to(own.var, (count, *node.event_shape))).reshape(count, m)
        root = scale[..., None] * np.eye(m)
    return Gaussian(mean, np.broadcast_to(root, (count, m, m)))


def _log_density(found: Gaussian, value: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Of Gaussians, whose angle may be turns away."""
    log_det = np.linalg.slogdet(found.root)[1]
    total = np.full(len(value), -np.inf)
    for turns in (0.0, -1.0, 1.0) if angles.any() else (0.0,):
        off = value - found.mean
        off = np.where(angles, wrap_angle(off) + 2 * np.pi * turns, off)
        eta = np.linalg.solve(found.root, off[..., None])[..., 0]
        total = np.logaddexp(total, -0.5 * np.vecdot(eta, eta))
    return total - log_det - 0.5 * value.shape[-1] * math.log(2 * math.pi)
