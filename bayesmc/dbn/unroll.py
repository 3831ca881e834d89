"""A template written out: a plain net with a node for every slice, and trajectories drawn from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bayesmc.dbn.given import check_steps
from bayesmc.dbn.series import Compiled, read_input_rows, read_series, sizes_of
from bayesmc.dbn.slices import PREVIOUS, TIME, Slices, Template
from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BayesmcError, UnsupportedError
from bayesmc.network import BayesNet
from bayesmc.network.forward import Pass, Step, refuse_unsampled, step_for
from bayesmc.network.node import Declaration, Numbered


def unroll(template: Template, steps: int, inputs: Mapping[str, Any] | None) -> BayesNet:
    """See ``DynamicBayesNet.unroll``."""
    check_steps("unroll", steps)
    template.check()
    rows = None
    if inputs is not None:
        sizes = sizes_of(template, inputs)
        rows = read_input_rows(template, sizes, inputs, steps)
    declarations = {n: template.later[n] for n in template.static}
    zero = template.slice_zero()
    for t in range(steps):
        source = zero if t == 0 else template.later
        for name in template.later:
            if name in template.static:
                continue
            own = indexed(name, t)
            if rows is not None and name in rows:
                declarations[own] = replace(
                    source[name], name=own, source="fixed", value=rows[name][t]
                )
            else:
                declarations[own] = _at(template, source[name], t)
    return BayesNet.of(template.name, declarations, template.plates)


def sampled(
    dbn: Compiled,
    steps: int,
    draws: int,
    inputs: Mapping[str, Any] | None,
    plates: Mapping[str, int] | None,
    rng: np.random.Generator,
) -> dict[str, np.ndarray]:
    """See ``DynamicBayesNet.sample``."""
    check_steps("sample", steps)
    if isinstance(draws, bool) or not isinstance(draws, (int, np.integer)) or draws < 0:
        raise ValueError(f"sample(draws={draws!r}): draws is a number of draws, 0 or more")
    slices, series = read_series(dbn, None, inputs, steps, plates)
    refusal = refuse_unsampled(slices.first, (), "sample") or refuse_unsampled(
        slices.later, (), "sample"
    )
    if refusal:
        raise UnsupportedError(refusal)
    found: dict[str, list[np.ndarray]] = {n: [] for n in slices.dynamic}
    values: dict[str, np.ndarray] = {}
    static: dict[str, np.ndarray] = {}
    with marking_invalid(), np.errstate(all="ignore"):
        for t in range(steps):
            known = {**static, **series.row(t).inputs}
            known |= {n + PREVIOUS: values[n] for n in slices.interface if t}
            state = Pass(rng, (int(draws),), known)
            try:
                for step in _steps(slices, t):
                    step(state)
            except BayesmcError as error:
                error.args = (f"slice {t}: {error}", *error.args[1:])
                raise
            values = state.values
            static = {n: values[n] for n in slices.template.static}
            for name in slices.dynamic:
                found[name].append(_full(values[name], draws, slices.first[name].value_shape))
    result = {n: _decoded(slices, n, np.stack(rows, axis=1)) for n, rows in found.items()}
    for name, value in static.items():
        result[name] = _decoded(slices, name, _full(value, draws, slices.first[name].value_shape))
    return {n: result[n] for n in slices.template.later if n in result}


def indexed(name: str, t: int) -> str:
    """What a node is called in slice ``t`` of the unrolled net."""
    return f"{name}[{t}]"


# ---- private ------------------------------------------------------------------------------------


def _at(template: Template, declaration: Declaration, t: int) -> Declaration:
    """A node's declaration in slice ``t``."""
    parents, places = [], []
    for place, parent in enumerate(declaration.parents):
        if parent == TIME:
            places.append(place)
        elif parent in template.static:
            parents.append(parent)
        elif parent.endswith(PREVIOUS):
            parents.append(indexed(parent.removesuffix(PREVIOUS), t - 1))
        else:
            parents.append(indexed(parent, t))
    function = declaration.function
    if places:
        assert function is not None
        function = Numbered(function, tuple(places), t)
    name = indexed(declaration.name, t)
    return replace(declaration, name=name, parents=tuple(parents), function=function)


def _steps(slices: Slices, t: int) -> Sequence[Step]:
    """Steps of a slice: of slice 0 with the static nodes."""
    model = slices.model(t)
    wanted = {*slices.dynamic, *(slices.template.static if t == 0 else ())}
    return [step_for(model, node, {}) for n, node in model.nodes.items() if n in wanted]


def _full(value: np.ndarray, draws: int, shape: tuple[int, ...]) -> np.ndarray:
    return np.broadcast_to(value, (int(draws), *shape))


def _decoded(slices: Slices, name: str, stored: np.ndarray) -> np.ndarray:
    """The user's own array."""
    return np.array(slices.first[name].decode(stored), subok=True)
