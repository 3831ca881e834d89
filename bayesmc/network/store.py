"""The compiled models of one net, kept for the plate sizes and inputs they were made for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Self

import numpy as np

from bayesmc.errors import (
    DensityError,
    ModelError,
    ParameterError,
    UnknownNodeError,
    did_you_mean,
)
from bayesmc.network.captured import check_captured
from bayesmc.network.compile import compile_model
from bayesmc.network.declaring import DeclaredPlates
from bayesmc.network.model import Model
from bayesmc.network.node import Declaration, Potential, topological_order
from bayesmc.network.validate import validate_model
from bayesmc.shapes import owned, unused_sizes

#: bytes of inputs up to which a compiled model is kept for the next call with the same inputs
_KEEP_INPUTS = 1 << 20
#: compiled models kept for other plate sizes and inputs
_KEEP_MODELS = 8


class Declared:
    """What a net and a factor graph are made of: plates, declarations, and the models compiled of them."""

    def __init__(self, name: str | None, plates: DeclaredPlates) -> None:
        self.name = name
        self._plates = plates
        self._declarations: dict[str, Declaration] = {}
        self._potentials: dict[str, Potential] = {}
        self._kept_store: ModelStore | None = None

    def copy(self) -> Self:
        """An independent one with the same declarations."""
        other = type(self)(self.name)  # type: ignore[call-arg]
        other._declarations = dict(self._declarations)
        other._potentials = dict(self._potentials)
        other._plates = self._plates.copy()
        return other

    def snapshot(self) -> Self:
        """A copy that shares what is compiled already; what holds it never sees later declarations."""
        other = self.copy()
        other._kept_store = self._store
        return other

    def __contains__(self, name: object) -> bool:
        return name in self._declarations or name in self._potentials

    def _refuse_name(self, what: str, name: Any) -> None:
        if not isinstance(name, str) or not name:
            raise ModelError(f"a {what}'s name is a non-empty string, not {name!r}")

    def _changed(self) -> None:
        self._kept_store = None

    @property
    def _store(self) -> ModelStore:
        if self._kept_store is None:
            self._kept_store = ModelStore(
                self.name, self._declarations, self._potentials, self._plates
            )
        return self._kept_store


class ModelStore:
    """Compiles a net's declarations as they stand now, and remembers the last few models.

    A net that changes takes a new store; snapshots share the one they were taken with.
    """

    def __init__(
        self,
        name: str | None,
        declarations: Mapping[str, Declaration],
        potentials: Mapping[str, Potential],
        plates: DeclaredPlates,
    ) -> None:
        self.name = name
        self.declarations = dict(declarations)
        self.potentials = dict(potentials)
        self.plates = plates.copy()
        self._models: dict[Any, Model] = {}
        self._valid = False
        self._around = [d for d in declarations.values() if d.captured]

    def model(self, sizes: Mapping[str, int], inputs: Mapping[str, np.ndarray]) -> Model:
        """The net compiled for these plate sizes and inputs."""
        self.check_captured()
        small = sum(v.nbytes for v in inputs.values()) <= _KEEP_INPUTS
        key = (tuple(sizes.items()), tuple((n, v.tobytes()) for n, v in inputs.items() if small))
        model = self._models.get(key) if small else None
        if model is None:
            model = self._compile(sizes, inputs)
            if small:
                while len(self._models) >= _KEEP_MODELS:
                    self._models.pop(next(iter(self._models)), None)
                self._models[key] = model
        return model

    def check_captured(self) -> None:
        """Refuse functions that read a name which has changed since they were declared."""
        check_captured(self._around)
        check_captured(self.potentials.values(), "factor")

    def probe(self, sizes: Mapping[str, int | None]) -> Model:
        """A model when nobody has given data: open plates and inputs get stand-ins."""
        open_ = [p for p, n in sizes.items() if n is None]
        stand_in = unused_sizes([n for n in sizes.values() if n is not None], len(open_) + 2)[2:]
        settled = {p: n for p, n in sizes.items() if n is not None}
        settled.update(zip(open_, stand_in, strict=True))
        try:
            return self.model(settled, {})
        except (ModelError, ParameterError, DensityError):  # inputs may have to be integers
            zeros = {
                n: owned(np.zeros(tuple(settled[p] for p in d.plates) + d.event_shape, dtype=int))
                for n, d in self.declarations.items()
                if d.source == "input"
            }
            if not zeros:
                raise
            return self.model(settled, zeros)

    def validate(self, model: Model) -> None:
        """Once for a net, and again while a plate has been too small to show mixing."""
        if self._valid:
            return
        if not model.cache.get("valid"):
            validate_model(model)
            model.cache["valid"] = True
        used = {p for d in self.declarations.values() for p in d.plates}
        self._valid = all(model.sizes[p] > 1 for p in used)

    def _compile(self, sizes: Mapping[str, int], inputs: Mapping[str, np.ndarray]) -> Model:
        for name, declaration in self.declarations.items():
            check_parents(self.declarations, name, declaration.parents)
        for name, potential in self.potentials.items():
            check_parents(self.declarations, name, potential.parents, "potential")
        order = topological_order({n: d.parents for n, d in self.declarations.items()})
        labels = self.plates.fitting(sizes)
        return compile_model(
            self.name, self.declarations, self.potentials, sizes, labels, inputs, order
        )


def check_parents(
    declarations: Mapping[str, Declaration],
    name: str,
    parents: Sequence[str],
    what: str = "node",
) -> None:
    """Refuse a parent that was never declared."""
    for parent in parents:
        if parent not in declarations:
            raise UnknownNodeError(
                f"{what} {name!r} has the parent {parent!r}: {unknown(declarations, parent)}. Declare it, "
                "give the argument a default if it is no parent, or name the parents with parents="
            )


def unknown(declarations: Mapping[str, Declaration], name: str) -> str:
    """That there is no such node, and which one may be meant."""
    return f"the net has no node {name!r}{did_you_mean(name, declarations)}"
