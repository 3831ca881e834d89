"""A proposal that is a conditional density: a user's function, read, and what can be asked of it.

Reading the function against a net is ``engines.proposal``'s affair; moving a chain by it that of
``proposed``, weighing draws by it that of ``engines.proposing``.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.errors import (
    BayesmcError,
    DensityError,
    ModelError,
    ShapeError,
    SupportWarning,
    UnsupportedError,
)
from bayesmc.network import CompiledNode, Model
from bayesmc.network.calling import Aligner, call
from bayesmc.network.model import arguments_of, fit
from bayesmc.network.node import Declaration
from bayesmc.shapes import Shape
from bayesmc.structure.target import Values

#: a node's name, or several that are drawn, or move, as one
Key = str | tuple[str, ...]


def names_of(key: Key) -> tuple[str, ...]:
    """The nodes that a key of ``proposal=`` stands for."""
    return key if isinstance(key, tuple) else (key,)


@dataclass(frozen=True, eq=False)
class Proposal:
    """One proposal, read against a problem.

    Attributes
    ----------
    engine : str
        Whose it is, for messages.
    key : str or tuple of str
        As the user wrote it; a tuple is a joint block.
    names : tuple of str
        Nodes it draws.
    declaration : Declaration
        Its function, the names of what that takes, in order, and the plates it is aligned for.
    links : tuple of (str, Aligner)
    """

    engine: str
    key: Key
    names: tuple[str, ...]
    declaration: Declaration
    links: tuple[tuple[str, Aligner], ...]

    @property
    def parents(self) -> tuple[str, ...]:
        return self.declaration.parents

    @property
    def what(self) -> str:
        """What messages call it."""
        return f"{self.engine}: proposal for {self.key!r}"

    @property
    def is_independent(self) -> bool:
        """Whether it proposes the same wherever its targets are."""
        return not set(self.names) & set(self.parents)

    def distribution(self, model: Model, values: Values) -> tuple[Distribution, Shape]:
        """What the function returns, a distribution or ``Parts``, and the batch of what it read."""
        arguments, batch = arguments_of(self.links, values)
        plates = tuple(model.sizes[p] for p in self.declaration.plates)
        found = call(self.declaration, arguments, batch + plates, self.links)
        if not isinstance(found, Distribution):
            raise ModelError(
                f"the function returns an array of shape {np.shape(found)}; return the distribution to "
                "draw from"
            )
        return found, batch

    def fitted(self, model: Model, values: Values) -> Distribution:
        """The distribution, which must fit its targets and have good parameters throughout."""
        found, batch = self.distribution(model, values)
        if not isinstance(found, Parts):
            plates = tuple(model.sizes[p] for p in self.declaration.plates)
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
def blaming(proposal: Proposal | None) -> Iterator[None]:
    """What goes wrong inside is the proposal's fault, not the node's."""
    try:
        yield
    except BayesmcError as error:
        if proposal is not None:
            node = f"node {proposal.declaration.name!r}"
            text = str(error)
            rest = text.removeprefix(node) if text.startswith(node) else f": {text}"
            error.args = (f"{proposal.what}{rest}", *error.args[1:])
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


def check_vector(nodes: Sequence[CompiledNode], dist: Distribution, partly: Set[str]) -> None:
    """Refuse a block's vector that does not fit its nodes; those of ``partly`` are partly observed."""
    sizes = {node.name: math.prod(node.value_shape) for node in nodes}
    size = sum(sizes.values())
    if dist.event_shape != (size,):
        parts = ", ".join(f"{name} {n}" for name, n in sizes.items())
        raise ShapeError(
            f"the distribution draws values of shape {dist.event_shape}, but the block has {size} "
            f"components ({parts}); return one vector of them, or a dict from name to distribution"
        )
    for node in nodes:
        check_kind(node, dist, shaped=False)
        if node.name in partly:
            raise UnsupportedError(
                f"{node.name!r} is partly observed, and a vector cannot be drawn in part; propose "
                "its missing elements by a dict from name to distribution"
            )


def cut(nodes: Sequence[CompiledNode], draws: np.ndarray) -> list[np.ndarray]:
    """A block's vectors as values of its nodes, in order, batch first."""
    sizes = [math.prod(node.value_shape) for node in nodes]
    pieces = np.split(draws, np.cumsum(sizes)[:-1], axis=-1)
    return [
        piece.reshape(draws.shape[:-1] + node.value_shape)
        for node, piece in zip(nodes, pieces, strict=True)
    ]


def warn_of_gaps(proposal: Proposal, node: CompiledNode, dist: Distribution) -> None:
    """Warn where a proposal never reaches what its target may be, as far as supports tell."""
    never = _never_proposed(node, dist)
    if never is not None:
        warnings.warn(
            f"{proposal.what} is on {dist.support.describe()} and never gives {never}, which {node.name!r} "
            "may take; what is never proposed is missing from all answers, and nothing else shows it: "
            "propose from a distribution that covers the node's support",
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
    with np.errstate(all="ignore"):
        reached = np.isfinite(dist.log_prob(at)).reshape(len(values), -1).any(axis=1)
    missed = [repr(node.domain.states[k]) for k in np.flatnonzero(~reached)]
    return ", ".join(missed[:5]) + (", ..." if len(missed) > 5 else "") if missed else None
