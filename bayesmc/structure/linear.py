"""The continuous part of a hybrid net as linear-Gaussian conditionals, one per plate element.

Readings of functions outlive the question: they are taken again only where what a function sees has changed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bayesmc.distributions import MvNormal
from bayesmc.distributions.base import marking_invalid
from bayesmc.distributions.noiseless import plane_log_density
from bayesmc.errors import BudgetError, UnsupportedError
from bayesmc.factors import LogTable
from bayesmc.factors.gaussian import Conditional, GaussianFactor
from bayesmc.network import Model, Observed
from bayesmc.network.expressions import density
from bayesmc.structure.affine import affine_nodes, finite_leaves, gaussian_nodes
from bayesmc.structure.discrete import InvalidRows, Variable, known_values
from bayesmc.structure.reading import Reading, hidden_elements
from bayesmc.structure.tables import constants_of


@dataclass(frozen=True, eq=False)
class LinearGaussian:
    """Hidden continuous elements as blocks, and what is said of them.

    Attributes
    ----------
    nodes : frozenset of str
        The nodes whose densities are here.
    dims : dict
        Block (node, element) -> number of components.
    conditionals : list of Conditional
        Every block given its parents, as declared.
    likelihoods : list of GaussianFactor
        Observed elements, those that depend on the same blocks in one factor.
    tables : list of (scope, LogTable)
        Observed elements that turn out to depend on discrete variables alone.
    exact : list of (Conditional, ndarray)
        Observed elements of which some component has no noise, given their parents, and their values.
    computed : list of Conditional
        Elements of deterministic nodes that are affine in blocks, without noise.
    invalid : list
        Configurations with bad parameters.
    """

    nodes: frozenset[str]
    dims: dict[Variable, int]
    conditionals: list[Conditional] = field(default_factory=list)
    likelihoods: list[GaussianFactor] = field(default_factory=list)
    tables: list[tuple[tuple[Variable, ...], LogTable]] = field(default_factory=list)
    exact: list[tuple[Conditional, np.ndarray]] = field(default_factory=list)
    computed: list[Conditional] = field(default_factory=list)
    invalid: list[InvalidRows] = field(default_factory=list)


def linear_gaussian(
    model: Model, observed: Mapping[str, Observed], inputs: Mapping[str, np.ndarray]
) -> LinearGaussian:
    """The linear-Gaussian part of a net for which ``why_not_linear`` found no reason.

    Raises
    ------
    BudgetError
        A function has too many configurations.
    """
    names = gaussian_nodes(model, observed)
    dims = {
        (name, e): math.prod(model[name].event_shape)
        for name in names
        for e in hidden_elements(model[name], observed.get(name))
    }
    part = LinearGaussian(frozenset(names), dims)
    known = known_values(model, constants_of(model, inputs), observed)
    states: dict[Variable, int] = {}
    for name, seen in observed.items():
        if model[name].domain is None:
            continue
        if seen.mask is None:
            known[name] = seen.value
        else:
            at = np.flatnonzero(seen.mask)
            states.update({(name, int(e)): int(seen.value.flat[e]) for e in at})
    read = _Reader(model, observed, known)
    for name in names:
        _add(part, read(name), observed.get(name), states)
    for name in affine_nodes(model, observed, inputs):
        try:
            reading = read(name)
        except BudgetError:
            continue  # nothing depends on reading it: it is what a question may ask for
        part.computed.extend(reading.conditional(e, states) for e in range(reading.count))
    return part


# ---- private ------------------------------------------------------------------------------------


class _Reader:
    """The latest reading of every node, kept with the model."""

    def __init__(
        self, model: Model, observed: Mapping[str, Observed], known: Mapping[str, np.ndarray]
    ) -> None:
        self.model, self.observed, self.known = model, observed, known
        self.kept: dict[str, tuple[Any, Reading]] = model.cache.setdefault("linear readings", {})

    def __call__(self, name: str) -> Reading:
        leaves = density(self.model, name, finite_leaves(self.model)).leaves
        key = tuple((n, self._seen(n)) for n in sorted(leaves))
        latest = self.kept.get(name)
        if latest is None or latest[0] != key:
            latest = key, Reading(self.model, name, self.observed, self.known)
            self.kept[name] = latest
        return latest[1]

    def _seen(self, name: str) -> Any:
        """What evidence makes of a node, as far as a function of it goes."""
        if name in self.known:
            return self.known[name].tobytes()
        seen = self.observed.get(name)
        if seen is None or seen.mask is None:
            return None
        return seen.mask.tobytes(), seen.value.tobytes()


def _add(
    part: LinearGaussian,
    reading: Reading,
    seen: Observed | None,
    states: Mapping[Variable, int],
) -> None:
    """Append what one node says to the net's linear-Gaussian part."""
    if not reading.count:
        return
    part.invalid.extend(reading.invalid_rows())
    hidden = hidden_elements(reading.node, seen)
    part.conditionals.extend(reading.conditional(e, states) for e in hidden)
    if seen is not None and seen.parts is not None:
        for e in hidden:
            _add_parts(part, (reading.node.name, e), reading.d, seen)
    rest = np.delete(np.arange(reading.count), hidden)
    if not len(rest):
        return
    assert seen is not None
    values = seen.value.reshape(reading.count, reading.d)
    bare = reading.without_noise(rest)
    if bare.any():
        for e in rest[bare].tolist():
            _add_exact(part, reading.conditional(e, states), values[e])
        rest = rest[~bare]
        if not len(rest):
            return
    for group in reading.alike(rest):
        factor = reading.likelihood(group, values[group], states)
        if factor.blocks:
            part.likelihoods.append(factor)
        else:
            part.tables.append((factor.scope, LogTable(factor.log_scale)))


def _add_parts(part: LinearGaussian, block: Variable, d: int, seen: Observed) -> None:
    """Append some components of a block, seen as they are."""
    assert seen.parts is not None
    at = np.flatnonzero(seen.parts.reshape(-1, d)[block[1]])
    if len(at):
        m = len(at)
        itself = Conditional(block, (), (block,), np.zeros(m), np.eye(d)[at], np.zeros((m, m)))
        part.exact.append((itself, seen.value.reshape(-1, d)[block[1]][at]))


def _add_exact(part: LinearGaussian, given: Conditional, value: np.ndarray) -> None:
    """Append an observed element without noise; one that depends on discrete variables alone is a table."""
    if given.parents:
        part.exact.append((given, value))
        return
    pivots = np.linalg.diagonal(given.root) == 0
    flat = pivots.reshape(-1, pivots.shape[-1])
    if (flat != flat[:1]).any():
        raise UnsupportedError(
            f"{given.block[0]!r} is observed with noise at some configurations of the finite nodes and "
            "without at others, and densities do not compare with probabilities; give it a little noise at "
            "all of them"
        )
    with marking_invalid():
        log = plane_log_density(MvNormal(given.offset, scale_tril=given.root), value)
    assert log is not None
    part.tables.append((given.scope, LogTable(log)))
