"""Random linear-Gaussian templates with data, whose answers exact conditioning of the unrolled net gives.

They hold what such templates may hold: several scalar and vector states that read each other, deterministic
nodes, nodes that the next slice does not read, observed nodes that it does, time, inputs, static nodes,
plates whose elements meet and plates whose elements do not, missing rows and elements, vague starts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from inspect import Parameter, Signature
from typing import Any

import numpy as np

from bayesmc.auto import infer
from bayesmc.dbn import DynamicBayesNet
from bayesmc.distributions import MvNormal, Normal
from bayesmc.engines.exact.exact import Exact
from bayesmc.network import BayesNet


@dataclass(frozen=True, eq=False)
class LinearSeries:
    """A template and a series for it.

    Attributes
    ----------
    dbn : DynamicBayesNet
    observations : dict
        Node -> rows, NaN where missing; static nodes without time.
    inputs : dict
    steps : int
    hidden : tuple of str
        Nodes that are not observed in full.
    """

    dbn: DynamicBayesNet
    observations: dict[str, np.ndarray]
    inputs: dict[str, np.ndarray]
    steps: int
    hidden: tuple[str, ...]

    def rows(self, count: int) -> dict[str, np.ndarray]:
        """The observations with only the first so many rows; the others are missing."""
        found = {}
        for name, value in self.observations.items():
            if name not in self.dbn.static_nodes:
                value = value.astype(float).copy()
                value[count:] = np.nan
            found[name] = value
        return found

    @cached_property
    def unrolled(self) -> BayesNet:
        """The plain net of all slices."""
        return self.dbn.unroll(self.steps, self.inputs)

    def exact(self, count: int) -> Any:
        """The exact posterior of the unrolled net given the first so many rows."""
        net = self.unrolled
        evidence = self.dbn.unrolled_evidence(self.rows(count))
        return infer(net, evidence, engine=Exact())


def random_linear_dbn(seed: int, vague: float = 1e3) -> LinearSeries:
    """A random linear-Gaussian template and a series of 3 to 6 rows.

    One start in ten has the scale ``vague``.

    Examples
    --------
    >>> from bayesmc.testing.makers.linear_dbns import random_linear_dbn
    >>> case = random_linear_dbn(3)
    >>> case.steps == len(case.observations[max(case.observations)])
    True
    """
    return LinearMaker(seed, vague).made()


_SIZES = {"site": 3, "run": 2}


class LinearMaker:
    """Declares one template from random choices."""

    def __init__(self, seed: int, vague: float) -> None:
        self.vague = vague
        self.rng = np.random.default_rng([seed, 77])
        self.steps = int(self.rng.integers(3, 7))
        self.kind = str(self.rng.choice(["none", "none", "apart", "joint", "both"]))
        self.plates: tuple[str, ...] = () if self.kind == "none" else ("site",)
        if self.kind == "both":  # elements of one plate never meet, those of the other do
            self.plates = ("run", "site") if self.rng.random() < 0.5 else ("site", "run")
        self.dbn = DynamicBayesNet(f"random {seed}", plates={p: _SIZES[p] for p in self.plates})
        #: node -> length of its vector, 0 for scalars
        self.sizes: dict[str, int] = {}
        self.within: dict[str, tuple[str, ...]] = {}

    def made(self) -> LinearSeries:
        rng = self.rng
        self.has_input, self.has_static = rng.random() < 0.5, rng.random() < 0.3
        if self.has_input:
            self.dbn.input("u")
            self._note("u", 0, ())
        if self.has_static:
            self.dbn.add_static("level", Normal(0.5, 1.0))
            self._note("level", 0, ())
        states = [f"x{k}" for k in range(int(rng.integers(1, 4)))]
        for name in states:
            size = int(rng.choice([0, 0, 2]))
            self._note(name, size, self.plates)
        if self.kind in ("joint", "both"):
            self._note("world", 0, tuple(p for p in self.plates if p == "run"))
            states.insert(0, "world")
        observed = ["y0", *(["y1"] if rng.random() < 0.5 else [])]
        for name in observed:
            self._note(name, int(rng.choice([0, 2])), self.plates)
        reads_seen = rng.random() < 0.3
        for k, name in enumerate(states):
            parents = [f"{n}_prev" for n in states if n == name or rng.random() < 0.4]
            parents += [n for n in states[:k] if rng.random() < 0.4]
            if reads_seen and k == len(states) - 1:
                parents.append("y0_prev")
            self._add(name, parents, initial=[n for n in states[:k] if rng.random() < 0.3])
        if rng.random() < 0.5:
            self._computed(states)
            states = [*states, "d"]
        if rng.random() < 0.3:
            self._note("leaf", 0, self.plates)
            self._add("leaf", [self._some(states)])
        for name in observed:
            self._add(
                name, [self._some(states), *([self._some(states)] if rng.random() < 0.5 else [])]
            )
        return self._with_data(observed)

    def _with_data(self, observed: Sequence[str]) -> LinearSeries:
        rng = self.rng
        inputs = {"u": rng.normal(size=self.steps)} if self.has_input else {}
        drawn = self.dbn.sample(self.steps, rng=rng, inputs=inputs)
        found = {n: drawn[n][0].astype(float) for n in observed}
        for name, value in found.items():
            if rng.random() < 0.5:
                value[rng.random(self.steps) < 0.3] = np.nan
            if self.plates and rng.random() < 0.4:
                value[rng.random(value.shape[:2]) < 0.3] = np.nan
            if np.isnan(value).all():
                value[...] = drawn[name][0]
        if self.has_static:
            found["level"] = np.asarray(0.3)
        full = {n for n, v in found.items() if not np.isnan(v).any()}
        names = [n for n in self.sizes if n not in (*full, "u", "level")]
        return LinearSeries(self.dbn, found, inputs, self.steps, tuple(names))

    def _note(self, name: str, size: int, plates: tuple[str, ...]) -> None:
        self.sizes[name], self.within[name] = size, plates

    def _some(self, names: Sequence[str]) -> str:
        return str(self.rng.choice([n for n in names if n != "world"] or list(names)))

    def _add(self, name: str, parents: Sequence[str], initial: Sequence[str] = ()) -> None:
        """Declare a node with a mean that is affine in its parents and whatever else there is."""
        parents = tuple(dict.fromkeys([*parents, *self._known()]))
        first = None
        if any(p.endswith("_prev") for p in parents):
            scale = self.vague if self.rng.random() < 0.1 else None
            function = self._function(name, tuple(initial), scale)
            first = named(function, tuple(initial))
        self.dbn.add(
            name, self._function(name, parents), parents, plates=self.within[name], initial=first
        )

    def _computed(self, states: Sequence[str]) -> None:
        """A deterministic node, sometimes one that accumulates."""
        plates = self.plates
        self._note("d", 0, plates)
        terms = self._terms("d", tuple(s for s in states if s != "world")[:2])
        names = tuple(s for s in states if s != "world")[:2]
        if self.rng.random() < 0.5:
            parents = (*names, "d_prev")
            self.dbn.add(
                "d", lambda *values: terms(values[:-1]) + 0.5 * values[-1], parents, plates=plates,
                initial=named(lambda *values: terms(values), names),
            )  # fmt: skip
        else:
            self.dbn.add("d", lambda *values: terms(values), names, plates=plates)

    def _known(self) -> list[str]:
        found = ["t"] if self.rng.random() < 0.3 else []
        found += ["u"] if self.has_input and self.rng.random() < 0.5 else []
        return found + (["level"] if self.has_static and self.rng.random() < 0.5 else [])

    def _function(
        self, name: str, parents: tuple[str, ...], scale: float | None = None
    ) -> Callable[..., Any]:
        size, terms = self.sizes[name], self._terms(name, parents)
        offset = self.rng.normal()
        spread = float(np.exp(self.rng.normal(0.0, 0.5))) if scale is None else scale
        if not size:
            return lambda *values: Normal(offset + terms(values), spread)
        root = spread * (np.eye(size) + np.tril(0.3 * self.rng.normal(size=(size, size)), -1))
        cov = root @ root.T
        wide = np.full(size, offset)
        return lambda *values: MvNormal(wide + terms(values), cov)

    def _terms(self, name: str, parents: tuple[str, ...]) -> Callable[[Sequence[Any]], Any]:
        size = self.sizes[name]
        parts = [self._term(p, name, size) for p in parents]

        def total(values: Sequence[Any]) -> Any:
            start: Any = np.zeros(size) if size else 0.0
            return sum((part(v) for part, v in zip(parts, values, strict=True)), start)

        return total

    def _term(self, parent: str, name: str, size: int) -> Callable[[Any], Any]:
        """One parent's part of a mean, in one of the ways in which people write it."""
        rng, stem = self.rng, parent.removesuffix("_prev")
        own = self.sizes.get(stem, 0)
        foreign = "site" in self.within.get(stem, ()) and "site" not in self.within[name]
        read = (lambda v: v.mean("site")) if foreign else (lambda v: v)
        if stem == "t":
            a = rng.normal(size=size or ())
            return (lambda v: a * np.cos(v)) if not size else (lambda v: a * np.cos(v)[..., None])
        if own and size:
            matrix = 0.5 * rng.normal(size=(size, own))
            return lambda v: np.matvec(matrix, read(v))
        if own:
            row = 0.5 * rng.normal(size=own)
            return lambda v: (read(v) * row).sum(axis=-1)
        if size:
            column = 0.5 * rng.normal(size=size)
            return lambda v: read(v)[..., None] * column
        number = 0.7 * rng.normal()
        return lambda v: number * read(v)


def named(function: Callable[..., Any], parents: tuple[str, ...]) -> Callable[..., Any]:
    """The function with arguments of these names, as ``initial=`` reads them."""

    def call(*values: Any) -> Any:
        return function(*values)

    kind = Parameter.POSITIONAL_OR_KEYWORD
    call.__signature__ = Signature([Parameter(p, kind) for p in parents])  # type: ignore[attr-defined]
    return call
