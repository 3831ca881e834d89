"""A question over time posed: a snapshot of the template, its slices, and the data as stored values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.dbn.series import Series, read_series
from bayesmc.dbn.slices import Slices
from bayesmc.dbn.template import DynamicBayesNet
from bayesmc.errors import BayesmcError, ModelError
from bayesmc.network import Model
from bayesmc.network.node import observed_links

#: in a problem's cache: rows are not to be held against what was expected, for askers of the evidence alone
UNCOMPARED = "rows are not compared"


@dataclass(frozen=True, eq=False)
class SeriesProblem:
    """What an engine is asked over time.

    Attributes
    ----------
    dbn : DynamicBayesNet
        A snapshot: later declarations do not reach it.
    slices : Slices
    series : Series
    times : ndarray or None
        What labels the slices that have rows, shape (rows,), where the data say.
    cache : dict
        What engines derived and may use again.
    """

    dbn: DynamicBayesNet
    slices: Slices
    series: Series
    cache: dict[str, Any] = field(default_factory=dict, repr=False)
    times: np.ndarray | None = None

    @property
    def model(self) -> Model:
        """Slice 0, where every node has its own name: for what nodes are, not for evaluating them."""
        return self.slices.first

    @property
    def steps(self) -> int:
        return self.series.steps

    @cached_property
    def seen(self) -> frozenset[str]:
        """Nodes that are observed in full in all slices."""
        return frozenset(n for n, o in self.series.observed.items() if o.mask is None)

    @cached_property
    def hidden(self) -> tuple[str, ...]:
        """Nodes of a slice that are not observed in full throughout, parents first.

        Objects apart, and what is observed and cannot be drawn where it is not.
        """
        apart = {*self.seen, *self.objects, *(undrawn(self.slices) & {*self.series.observed})}
        return tuple(n for n in self.slices.dynamic if n not in apart)

    @cached_property
    def objects(self) -> tuple[str, ...]:
        """Nodes of a slice whose values are objects."""
        return tuple(n for n in self.slices.dynamic if self.model[n].is_object)

    @cached_property
    def known_static(self) -> dict[str, np.ndarray]:
        """Values of the static nodes that are observed, and of those computed from these."""
        return with_computed(self.slices, {n: o.value for n, o in self.series.static.items()})

    @cached_property
    def unknown_static(self) -> tuple[str, ...]:
        """Static nodes with a density that nobody observed."""
        template, model = self.slices.template, self.slices.first
        return tuple(
            n
            for n in template.static
            if model[n].is_stochastic
            and (n not in self.series.static or self.series.static[n].mask is not None)
        )


def with_computed(slices: Slices, values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Values of static nodes, and of the static nodes that are computed from these alone."""
    found = dict(values)
    with np.errstate(all="ignore"):
        for name, node in slices.first.nodes.items():  # parents stand before their children
            if name in slices.template.static and name not in found and not node.is_stochastic:
                if all(p in found for p in node.parents):
                    found[name] = np.asarray(slices.first.evaluate(name, found)[0])
    return found


def undrawn(slices: Slices) -> frozenset[str]:
    """Nodes without a sampler that nothing reads: where one is not observed, it has no value.

    A density of whole pictures weighs them and cannot draw one; all else can be told without.
    """
    models = (slices.first, slices.later)
    read = {p for model in models for node in model.nodes.values() for p in node.parents}
    read |= {p for model in models for found, _ in model.potentials.values() for p in found.parents}
    read |= {*slices.interface}
    return frozenset(n for n in slices.stochastic if n not in read and slices.first[n].unsampled)


def pose_series(
    dbn: DynamicBayesNet,
    observations: Any,
    inputs: Any = None,
    ahead: int = 0,
) -> SeriesProblem:
    """Validate the template, read the data, and take the snapshot; ``ahead`` slices more have no rows.

    Raises
    ------
    ModelError, EvidenceError, PlateError
    """
    if not isinstance(dbn, DynamicBayesNet):
        raise ModelError(f"expected a DynamicBayesNet, not {type(dbn).__name__}")
    observations, inputs, times = dbn.unframed(observations, inputs)
    try:
        links = observed_links(dbn, observations if isinstance(observations, Mapping) else {})
    except BayesmcError:  # with stand-ins for inputs; the data may do better, or say it better
        links = {}
    dbn = dbn.with_links(links) if links else dbn
    slices, series = read_series(dbn, observations, inputs, ahead=ahead)
    return SeriesProblem(dbn.copy(), slices, series, times=times)
