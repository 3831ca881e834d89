"""A proposal that is a conditional density: a user's function, read, and what can be asked of it.

Reading the function against a net is the engine's affair; moving a chain by it that of ``proposed``.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.errors import BayesmcError, DensityError, ModelError, ShapeError, SupportWarning
from bayesmc.network import CompiledNode, Model
from bayesmc.network.align import Aligner
from bayesmc.network.model import arguments_of, call, fit
from bayesmc.network.node import Declaration
from bayesmc.structure.target import Values


@dataclass(frozen=True, eq=False)
class Conditional:
    """A user's function, read as the density of a proposal.

    Attributes
    ----------
    key : str or tuple of str
        What it was given for; a tuple is a block that moves as one.
    names : tuple of str
    declaration : Declaration
        The function, what it takes, and the plates it is aligned for.
    links : tuple of (str, Aligner)
    """

    key: Any
    names: tuple[str, ...]
    declaration: Declaration
    links: tuple[tuple[str, Aligner], ...]

    @property
    def is_independent(self) -> bool:
        """Whether it proposes the same wherever its targets are."""
        return not set(self.names) & set(self.declaration.parents)

    def result(self, model: Model, values: Values) -> Any:
        """What the function returns at the current values: a distribution, or ``Parts``."""
        arguments, batch = arguments_of(self.links, values)
        plates = tuple(model.sizes[p] for p in self.declaration.plates)
        found = call(self.declaration, arguments, batch + plates, self.links)
        if not isinstance(found, Distribution):
            raise ModelError(
                f"the function returns an array of shape {np.shape(found)}; return the distribution to "
                "propose from"
            )
        if not isinstance(found, Parts):
            fit(self.declaration, found, batch, plates)
            refuse_invalid(found)
            return found
        for name, part in found.parts.items():
            fit(model[name].declaration, part, batch, model[name].plate_shape)
            refuse_invalid(part)
        return found


class Parts(Distribution):
    """Independent distributions of several nodes, as a block's function may return them."""

    def __init__(self, parts: Mapping[str, Distribution]) -> None:
        self.parts = dict(parts)


@contextmanager
def blaming(conditional: Conditional | None) -> Iterator[None]:
    """What goes wrong inside is the proposal's fault, not the node's."""
    try:
        yield
    except BayesmcError as error:
        if conditional is not None:
            node = f"node {conditional.declaration.name!r}"
            text = str(error)
            rest = text.removeprefix(node) if text.startswith(node) else f": {text}"
            what = f"MetropolisHastings: proposal for {conditional.key!r}"
            error.args = (f"{what}{rest}", *error.args[1:])
        raise


def to_stored(node: CompiledNode, draws: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Draws as stored values, and which are no value of a finite node, shape (chains, *plates)."""
    if node.domain is None:
        return draws, np.zeros(draws.shape[: draws.ndim - len(node.event_shape)], dtype=bool)
    positions = draws - node.domain.low
    outside = ~((positions >= 0) & (positions < node.domain.size))
    if outside.any():
        positions = np.where(outside, 0, positions)
    return positions.astype(node.domain.dtype), outside


def to_support(node: CompiledNode, stored: np.ndarray) -> np.ndarray:
    """Stored values as the values that distributions speak."""
    return stored if node.domain is None else node.domain.to_support(stored)


def check_kind(node: CompiledNode, dist: Distribution, shaped: bool = True) -> None:
    """Refuse a proposal whose draws are no values of the node."""
    if bool(dist.is_discrete) != node.is_discrete:
        kinds = {True: "discrete", False: "continuous"}
        raise ModelError(
            f"{node.name!r} is {kinds[node.is_discrete]}, but {type(dist).__name__} is "
            f"{kinds[not node.is_discrete]}; propose a {kinds[node.is_discrete]} distribution"
        )
    if shaped and dist.event_shape != node.event_shape:
        raise ShapeError(
            f"{type(dist).__name__} draws values of shape {dist.event_shape}, but one value of "
            f"{node.name!r} has shape {node.event_shape}"
        )


def warn_of_gaps(conditional: Conditional, node: CompiledNode, dist: Distribution) -> None:
    """Warn where a proposal never reaches what its target may be, as far as supports tell."""
    never = _never_proposed(node, dist)
    if never is not None:
        warnings.warn(
            f"MetropolisHastings: the proposal for {conditional.key!r} is on {dist.support.describe()} and "
            f"never gives {never}, which {node.name!r} may take; what is never proposed is missing from all "
            "answers: propose from a distribution that covers the node's support",
            SupportWarning,
            stacklevel=2,
        )


def refuse_invalid(dist: Distribution) -> None:
    """Raise for bad parameters: a proposal is asked only where the chains are, or may go."""
    if dist.invalid is not None and dist.invalid.any() and dist.problem is not None:
        raise dist.problem


def refuse_infinite(log: np.ndarray) -> None:
    """Raise where a proposal has no density at what it drew itself."""
    if not np.isfinite(log).all():
        found = log[~np.isfinite(log)].flat[0]
        raise DensityError(
            f"the log density at one of its own draws is {found}; sample= and log_prob of a proposal must "
            "describe the same, finite density"
        )


# ---- private ------------------------------------------------------------------------------------


def _never_proposed(node: CompiledNode, dist: Distribution) -> str | None:
    """Values of a node, in words, that no draw of its proposal can have; None if none is known."""
    if node.domain is None:
        known = node.support is not None and node.support.is_constant
        if not known or dist.support.covers(node.support):  # type: ignore[arg-type]
            return None
        return f"others of the {node.support.describe()}"  # type: ignore[union-attr]
    values = node.domain.low + np.arange(node.domain.size)
    at = values.reshape((-1,) + (1,) * len(dist.batch_shape))
    reached = np.isfinite(dist.log_prob(at)).reshape(len(values), -1).any(axis=1)
    missed = [repr(node.domain.states[k]) for k in np.flatnonzero(~reached)]
    return ", ".join(missed[:5]) + (", ..." if len(missed) > 5 else "") if missed else None
