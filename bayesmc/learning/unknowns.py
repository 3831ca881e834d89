"""Nodes that are to be learned, as unconstrained numbers and back."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.distributions.transforms import Transform, transform_of
from bayesmc.errors import BayesmcError, EvidenceError, UnsupportedError
from bayesmc.network import CompiledNode, Model
from bayesmc.network.evidence import store
from bayesmc.network.model import deterministic_above


@dataclass(frozen=True, eq=False)
class Unknown:
    """One node, and where its numbers stand."""

    node: CompiledNode
    transform: Transform
    start: int

    @property
    def shape(self) -> tuple[int, ...]:
        """Of its unconstrained numbers."""
        return (*self.node.plate_shape, *self.transform.unconstrained_shape)

    @property
    def stop(self) -> int:
        return self.start + math.prod(self.shape)


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Continuous nodes whose values are learned.

    Attributes
    ----------
    model : Model
        In which they have their priors.
    parts : tuple of Unknown
        Parents first.
    inputs : dict
        Values that priors may read.
    """

    model: Model
    parts: tuple[Unknown, ...]
    inputs: Mapping[str, np.ndarray]

    @classmethod
    def of(cls, model: Model, names: Sequence[str], inputs: Mapping[str, np.ndarray]) -> Unknowns:
        """Read off a model.

        Raises
        ------
        UnsupportedError
            A node is discrete, or its support has no unconstrained numbers.
        """
        parts: list[Unknown] = []
        start = 0
        for name in (n for n in model.nodes if n in names):
            node = model[name]
            if node.support is None and node.domain is None and not node.is_discrete:
                raise UnsupportedError(
                    f"fit: the bounds of node {name!r} depend on its parents, which are climbed too; declare "
                    "how far it lies from them instead, such as high = low + gap with gap > 0, or leave "
                    "it out of learn="
                )
            if node.domain is not None or node.is_discrete or node.support is None:
                raise UnsupportedError(
                    f"fit: node {name!r} is discrete, and values of discrete nodes are not climbed "
                    "to; leave it out "
                    "of learn= (it is summed out), or declare its table, which is learned"
                )
            transform = transform_of(node.support, node.event_shape)
            parts.append(Unknown(node, transform, start))
            start = parts[-1].stop
        return cls(model, tuple(parts), inputs)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(part.node.name for part in self.parts)

    @property
    def size(self) -> int:
        """How many unconstrained numbers there are."""
        return self.parts[-1].stop if self.parts else 0

    def values(self, u: np.ndarray) -> dict[str, np.ndarray]:
        """Values at unconstrained numbers, shape ``(size,)``."""
        return {
            p.node.name: p.transform.constrain(u[p.start : p.stop].reshape(p.shape))
            for p in self.parts
        }

    def numbers(self, values: Mapping[str, Any]) -> np.ndarray:
        """The unconstrained numbers behind values of all nodes.

        Raises
        ------
        EvidenceError
        """
        found = np.zeros(self.size)
        for p in self.parts:
            name = p.node.name
            try:
                value = np.broadcast_to(
                    np.asarray(store(p.node, values[name]), float), p.node.value_shape
                )
            except (TypeError, ValueError) as error:
                raise EvidenceError(f"fit: start of {name!r}: {error}") from error
            u = p.transform.unconstrain(value)
            if not np.isfinite(u).all():
                raise EvidenceError(
                    f"fit: start of {name!r} is not inside its support ({p.node.support.describe()})"  # type: ignore[union-attr]
                )
            found[p.start : p.stop] = u.ravel()
        return found

    def log_prior(self, u: np.ndarray) -> float:
        """Log prior density of the values at ``u``, in the nodes' own coordinates."""
        values: dict[str, Any] = {**self.inputs, **self.values(u)}
        total = 0.0
        with marking_invalid(), np.errstate(all="ignore"):
            for p in self.parts:
                name = p.node.name
                for above in deterministic_above(self.model, name, values):
                    values[above], _ = self.model.evaluate(above, values)
                prior, _ = self.model.evaluate(name, values)
                density = self.model.log_density(name, prior, values[name])
                total += float(np.broadcast_to(density, p.node.plate_shape).sum())
        return total if total == total else -math.inf

    def starts(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Unconstrained numbers to begin at: the middle of the prior first, then draws of it."""
        draws = []
        with marking_invalid(), np.errstate(all="ignore"):
            total = max(64, count)
            for _ in range(total):
                values: dict[str, Any] = dict(self.inputs)
                try:
                    for p in self.parts:
                        name = p.node.name
                        for above in deterministic_above(self.model, name, values):
                            values[above], _ = self.model.evaluate(above, values)
                        prior, _ = self.model.evaluate(name, values)
                        values[name] = self.model.sample_stored(name, prior, rng, ())
                    u = np.concatenate(
                        [p.transform.unconstrain(values[p.node.name]).ravel() for p in self.parts]
                    )
                except BayesmcError:  # a prior that cannot be drawn from: flat ones
                    u = rng.normal(size=self.size)
                draws.append(np.clip(np.nan_to_num(u), -30.0, 30.0 + 10.0 * np.abs(u)))
        draws_u = np.array(draws).reshape(total, self.size)
        return np.vstack([np.median(draws_u, axis=0), draws_u])[:count]

    def labels(self) -> list[str]:
        """A name for every number of the values."""
        found = []
        for p in self.parts:
            labels = [
                [str(x) for x in self.model.labels.get(plate, range(n))]
                for plate, n in zip(p.node.plates, p.node.plate_shape, strict=True)
            ]
            labels += [[str(i) for i in range(n)] for n in p.node.event_shape]
            for at in np.ndindex(p.node.value_shape):
                inside = ", ".join(axis[i] for axis, i in zip(labels, at, strict=True))
                found.append(f"{p.node.name}[{inside}]" if at else p.node.name)
        return found

    def direction(self, positions: np.ndarray) -> str:
        """What unconstrained numbers at positions are of: elements where each has its own, else nodes."""
        labels, found, at = self.labels(), [], 0
        for p in self.parts:
            own = labels[at : at + math.prod(p.node.value_shape)]
            at += len(own)
            inside = [k - p.start for k in positions if p.start <= k < p.stop]
            if inside:
                each = len(own) == p.stop - p.start
                found += [own[k] for k in inside] if each else [p.node.name]
        return " with ".join(found[:4]) + (" and others" if len(found) > 4 else "")

    def reads(self, positions: np.ndarray) -> np.ndarray:
        """Which of all numbers of the values unconstrained numbers at positions move."""
        found = []
        for p in self.parts:
            axes = len(p.transform.event_shape)
            inside = np.isin(np.arange(p.start, p.stop), positions).reshape(p.shape)
            each = p.shape == p.node.value_shape
            if not each:
                own = tuple(range(len(p.node.plate_shape), len(p.shape)))
                inside = np.asarray(inside.any(axis=own))
                inside = np.broadcast_to(
                    inside.reshape(*inside.shape, *(1,) * axes), p.node.value_shape
                )
            found.append(inside.ravel())
        return np.concatenate(found)

    def flat(self, u: np.ndarray) -> np.ndarray:
        """All numbers of the values at ``u``, in the order of ``labels``."""
        return np.concatenate([np.ravel(v) for v in self.values(u).values()])
