"""What mixtures over modes say of the nodes of a slice: tables, moments, quantiles, functions of nodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from bayesmc.dbn import PREVIOUS
from bayesmc.distributions import Mixture as MixtureOf
from bayesmc.distributions import Normal
from bayesmc.engines.averages import naming
from bayesmc.engines.filtering import Queries, refuse_forecast
from bayesmc.engines.kalman.queries import Spreads, View, expectation
from bayesmc.engines.kalman.slices import Layout
from bayesmc.engines.switching.modes import Modes
from bayesmc.engines.switching.stretches import Stretch
from bayesmc.errors import QueryError, UnsupportedError
from bayesmc.network import CompiledNode, Observed
from bayesmc.network.node import nodes_read
from bayesmc.results import SeriesPosterior
from bayesmc.results.laws import Laws, mixture_laws
from bayesmc.results.posterior import quantile_levels

#: standard deviation that stands for none, relative to the number
_POINT = 1e-13


class Beliefs(NamedTuple):
    """Mixtures over the modes of some slices.

    Attributes
    ----------
    layout : Layout
    modes : Modes
    now : ndarray of int, shape (modes,)
        The configurations that there are.
    weights : ndarray, shape (time, modes, *lead)
    mean : ndarray, shape (time, modes, *lead, n)
    factor : ndarray, shape (time, modes, *lead, n, m)
        Roots of covariances.
    known : dict
        Node -> stored values, shape (time, *value shape).
    by_mode : dict
        Computed node -> its values, shape (time, modes, *value shape), which the mode tells.
    """

    layout: Layout
    modes: Modes
    now: np.ndarray
    weights: np.ndarray
    mean: np.ndarray
    factor: np.ndarray
    known: Mapping[str, np.ndarray]
    by_mode: Mapping[str, np.ndarray]

    def last(self, steps: int) -> Beliefs:
        """Of the last so many slices."""
        known = {n: v[-steps:] for n, v in self.known.items()}
        by_mode = {n: v[-steps:] for n, v in self.by_mode.items()}
        return self._replace(
            weights=self.weights[-steps:],
            mean=self.mean[-steps:],
            factor=self.factor[-steps:],
            known=known,
            by_mode=by_mode,
        )

    def on_plates(self, node: CompiledNode) -> np.ndarray:
        """Weights as they broadcast with a node's values, shape (time, modes, *plates or ones)."""
        apart = self.layout.apart
        order = [apart.index(p) for p in node.plates if p in apart]
        ahead = self.weights.transpose(0, 1, *(2 + k for k in order))
        sizes = iter(ahead.shape[2:])
        return ahead.reshape(
            *ahead.shape[:2], *(next(sizes) if p in apart else 1 for p in node.plates)
        )

    def average(self, node: CompiledNode, values: np.ndarray) -> np.ndarray:
        """Of values by slice and mode, shape (time or 1, modes, *plates, ...) -> (time, *plates, ...)."""
        weights = self.on_plates(node)
        weights = weights.reshape(weights.shape + (1,) * (values.ndim - weights.ndim))
        return np.where(weights > 0, weights * values, 0.0).sum(axis=1)

    def view(self) -> View:
        """Every mode of every slice by itself."""
        steps, count = self.weights.shape[:2]

        def flat(array: np.ndarray) -> np.ndarray:
            return array.reshape(steps * count, *array.shape[2:])

        known = {
            n: flat(np.broadcast_to(v[:, None], (steps, count, *v.shape[1:])))
            for n, v in self.known.items()
        }
        at = self.modes.at(self.now)
        known |= {n: flat(np.broadcast_to(v, (steps, *v.shape))) for n, v in at.items()}
        known |= {n: flat(v) for n, v in self.by_mode.items()}
        spreads = Spreads(flat(self.factor), np.arange(steps * count))
        return View(self.layout, flat(self.mean), spreads, known)

    def split(self, values: np.ndarray) -> np.ndarray:
        """What ``view`` says, shape (time * modes, ...), as (time, modes, ...)."""
        return values.reshape(*self.weights.shape[:2], *values.shape[1:])

    def over_modes(self, values: np.ndarray) -> np.ndarray:
        """Averages, shape (time, modes, *lead, ...) -> (time, *lead, ...)."""
        weights = self.weights.reshape(
            self.weights.shape + (1,) * (values.ndim - self.weights.ndim)
        )
        return np.where(weights > 0, weights * values, 0.0).sum(axis=1)


class SwitchingSeries(SeriesPosterior):
    """Mixtures of Gaussians about every slice, one Gaussian for each mode.

    Answers what ``SeriesPosterior`` does, quantiles of the mixtures, functions of continuous and finite nodes
    together, and ``cov``. All of it is approximate where modes switch, and nobody knows by how much.

    Attributes
    ----------
    log_marginal_likelihood : float or ndarray
        Approximate, as ``SwitchingKalmanFilter`` says; ``log_marginal_increments`` by slice.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc import SwitchingKalmanFilter
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.table("s", ["s_prev"], [[0.9, 0.1], [0.2, 0.8]], ("calm", "rough"), initial=[0.5, 0.5])
    >>> dbn.add("x", lambda x_prev, s: bmc.Normal(x_prev, np.where(s == "calm", 0.1, 2.0)),
    ...         initial=bmc.Normal(0.0, 1.0))
    >>> dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    >>> filtered = bmc.filter(dbn, {"y": [0.1, 0.2, 5.1]}, engine=SwitchingKalmanFilter())
    >>> filtered.quantile("x", [0.1, 0.9]).shape, filtered.cov("x").shape
    ((3, 2), (3, 1, 1))
    >>> filtered.probability(lambda x, s: (s == "rough") & (x > 4.0)).round(2).tolist()
    [0.0, 0.0, 0.95]
    """

    beliefs: Beliefs

    def expectation(self, function: Callable[..., Any]) -> np.ndarray:
        """Means of a function of nodes of a slice, time first, its arguments with an axis of points first.

        The function may read finite nodes of the mode, too. Within each mode it is averaged as Kalman filters
        do (``GaussianSeries.expectation``).
        """
        return _expectation(self.beliefs, function)[0]

    def probability(self, function: Callable[..., Any]) -> np.ndarray:
        """Probabilities of an event (a function that returns booleans), time first."""
        return _expectation(self.beliefs, function, event=True)[0]

    def quantile(self, name: str, q: Any) -> np.ndarray:
        """Quantiles, shape ``(time, *q.shape, *plates, *event)``, of the mixtures over modes."""
        self._node(name)
        if name not in self.beliefs.layout.rows:
            return super().quantile(name, q)
        levels = quantile_levels(name, q)
        mixture = self._mixture(name)
        flat = np.stack([mixture.ppf(level) for level in levels.reshape(-1)], axis=1)
        return flat.reshape(len(flat), *levels.shape, *flat.shape[2:])

    def _laws(self, name: str) -> Laws:
        if name not in self.beliefs.layout.rows:
            return super()._laws(name)
        return mixture_laws(self._mixture(name))

    def _mixture(self, name: str) -> MixtureOf:
        """The numbers of a node in every slice, time first, as mixtures over modes."""
        node = self._node(name)
        found = self.beliefs
        place = found.layout.rows[name]
        mean, var = (
            found.layout.unpacked(node, a[..., place])
            for a in (found.mean, np.vecdot(found.factor, found.factor))
        )
        weights = found.on_plates(node)
        weights = weights.reshape(weights.shape + (1,) * len(node.event_shape))
        weights, mean, var = (
            np.moveaxis(np.broadcast_to(a, mean.shape), 1, -1) for a in (weights, mean, var)
        )
        scale = np.sqrt(var)
        scale = np.maximum(scale, _POINT * (np.abs(mean) + 1e-300))
        return MixtureOf(weights, Normal(mean, scale))

    def cov(self, *names: str) -> np.ndarray:
        """Joint covariances of nodes in every slice.

        Parameters
        ----------
        names : str
            Nodes, whose numbers follow each other in this order; those of plates that are not filtered
            separately are stacked before the event's.

        Returns
        -------
        ndarray, shape (time, *plates, d, d)
            The plates are those that are filtered separately.

        Raises
        ------
        UnknownNodeError, UnsupportedError, QueryError
        """
        layout, beliefs = self.beliefs.layout, self.beliefs
        for name in names:
            self._node(name)
            if name not in layout.rows and name not in beliefs.known or name in self._tables:
                raise QueryError(
                    f"cov({name!r}): the node is finite, or averaged over; name numbers"
                )
        view = beliefs.view()
        within = beliefs.over_modes(beliefs.split(view.cov(names)))
        parts = [
            view.mean[..., layout.rows[n]] if n in layout.rows
            else np.zeros((*view.mean.shape[:-1], layout.size(n)))
            for n in names
        ]  # fmt: skip
        means = beliefs.split(np.concatenate(parts, axis=-1))
        centre = beliefs.over_modes(means)
        off = means - centre[:, None]
        weighted = np.sqrt(beliefs.weights)[..., None] * off
        between = np.moveaxis(weighted, 1, -1)
        return within + between @ np.matrix_transpose(between)

    def last(self, steps: int, kind: str) -> SeriesPosterior:
        """The last so many slices by themselves."""
        refuse_forecast(self, kind)
        found = object.__new__(SwitchingSeries)
        found.__dict__.update(super().last(steps, kind).__dict__)
        found.beliefs = self.beliefs.last(steps)
        return found


def by_modes(stretches: Sequence[Stretch], now: np.ndarray) -> dict[str, tuple[Any, Any]]:
    """What is averaged over modes of nodes that they alone tell, by slice; see ``Stretch.told``.

    Slices of the first stretch have the modes possible there; others are filled with zeros.
    """
    found: dict[str, tuple[Any, Any]] = {}
    names: list[str] = []
    for stretch in stretches:
        layout, modes = stretch.layout, stretch.modes
        wanted = [n for n in layout.computed if modes.reach(layout, n) and n not in modes.names]
        names += [n for n in (*wanted, *modes.leaves) if n not in names]
    for name in names:
        parts = []
        for stretch in stretches:
            told = None
            if not stretch.modes.reach(stretch.layout, name, PREVIOUS):
                told = stretch.told(name)
            if told is None:
                break
            parts.append([_spread_out(a, stretch, now) for a in told])
        else:
            one, two = zip(*parts, strict=True)
            found[name] = np.concatenate(one), None if two[0] is None else np.concatenate(two)
    return found


def answers(
    engine: Any,
    beliefs: Beliefs,
    kind: str,
    increments: np.ndarray | None,
    told: Mapping[str, tuple[Any, Any]],
    observed: Mapping[str, Observed],
    start: int,
    queries: Queries | None = None,
) -> SwitchingSeries:
    """Answers for all nodes; ``told`` is what modes alone say of some, ``observed`` what is seen in part."""
    layout, model = beliefs.layout, beliefs.layout.slices.first
    tables, means, variances = {}, {}, {}
    for name, value in beliefs.known.items():
        node = model[name]
        if name in layout.slices.template.static:
            continue
        if node.domain is not None:
            tables[name] = np.eye(node.domain.size)[value.astype(np.intp)]
        else:
            means[name], variances[name] = value.astype(float), np.zeros(value.shape)
    for name, value in beliefs.modes.at(beliefs.now).items():
        one_hot = (value[..., None] == np.arange(model[name].domain.size)) * 1.0  # type: ignore[union-attr]
        tables[name] = beliefs.average(model[name], one_hot[None])
    for name, (one, two) in told.items():
        node = model[name]
        if two is None:
            tables[name] = beliefs.average(node, one)
        else:
            mean = means[name] = beliefs.average(node, one)
            variances[name] = beliefs.average(node, two + (one - mean[:, None]) ** 2)
        _put_seen(name, node, observed, tables, means, variances)
    whole = beliefs.over_modes(beliefs.mean)
    spread = np.vecdot(beliefs.factor, beliefs.factor) + (beliefs.mean - whole[:, None]) ** 2
    spread = beliefs.over_modes(spread)
    for name, place in layout.rows.items():
        means[name] = layout.unpacked(model[name], whole[..., place])
        variances[name] = layout.unpacked(model[name], spread[..., place])
    found = SwitchingSeries(
        model, engine, kind, increments, tables=tables, means=means, variances=variances,
        steps=len(whole), start=start,
    )  # fmt: skip
    found.beliefs = beliefs
    for name, function in (queries or {}).items():
        with naming(name):
            found.queries[name], found.queries_mcse[name] = _expectation(beliefs, function)
    return found


# ---- private ------------------------------------------------------------------------------------


def _expectation(
    beliefs: Beliefs, function: Callable[..., Any], event: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    for name in nodes_read(function):
        if name in beliefs.modes.leaves:
            raise UnsupportedError(
                f"a query reads {name!r}, which is averaged over where it is missing, and functions of it "
                "are not answered for; use a ParticleFilter"
            )
    mean, error = expectation(beliefs.view(), function, event)
    return tuple(beliefs.over_modes(beliefs.split(a)) for a in (mean, error))  # type: ignore[return-value]


def _spread_out(told: np.ndarray | None, stretch: Stretch, now: np.ndarray) -> np.ndarray | None:
    """By slice and by all modes that there are."""
    if told is None:
        return None
    found = np.zeros((stretch.count, len(now), *told.shape[2:]))
    found[:, np.searchsorted(now, stretch.pairs.now)] = told
    return found


def _put_seen(
    name: str,
    node: CompiledNode,
    observed: Mapping[str, Observed],
    tables: Mapping[str, np.ndarray],
    means: Mapping[str, np.ndarray],
    variances: Mapping[str, np.ndarray],
) -> None:
    """Elements that were seen have the value that was seen."""
    seen = observed.get(name)
    if seen is None or not node.is_stochastic:
        return
    mask = (
        np.ones(seen.value.shape[: 1 + len(node.plates)], dtype=bool)
        if seen.mask is None
        else seen.mask
    )
    if name in tables:
        assert node.domain is not None
        tables[name][mask] = np.eye(node.domain.size)[seen.value[mask].astype(np.intp)]
    else:
        means[name][mask], variances[name][mask] = seen.value[mask], 0.0
