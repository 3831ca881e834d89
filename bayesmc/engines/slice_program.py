"""A whole slice as one step: a program of NumPy's in place of its functions, called with distributions.

The same random numbers are drawn in the same order, so that a seed gives the same particles to rounding. The
first time, a template's program is held against the steps of its nodes; whatever is out of the ordinary later
(a parameter out of range, a weight that is no number) is done again by these, which say what is wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.distributions.base import all_finite
from bayesmc.engines.slice_densities import SliceDensities, read_slice
from bayesmc.errors import TraceError
from bayesmc.expression import Expression, Leaf, Program, ordered
from bayesmc.network import Model
from bayesmc.network.forward import Pass, Step
from bayesmc.network.forward import run as passed
from bayesmc.passes.arrays import for_arrays
from bayesmc.passes.elements import by_element, columns, together
from bayesmc.passes.ranges import TRUE

#: how far values and log weights may be off those of the plain steps
RTOL = 1e-9

#: what is kept with a model: programs by what is seen, or why there is none
_KEPT = "programs of slices"


class SliceProgram:
    """What is done in a slice of which some nodes are seen in full.

    Parameters
    ----------
    read : SliceDensities
    """

    def __init__(self, read: SliceDensities) -> None:
        self.drawn, self.names, self.every = read.drawn, tuple(read.values), read.every
        self.is_strict, self.weighs = read.good is not TRUE, bool(read.log.leaves)
        roots = [*read.values.values(), read.log, *([read.good] if self.is_strict else [])]
        self.program = evaluator(roots)
        own = {z.name for z in read.drawn}
        self._own = [k for k, n in enumerate(self.names) if n in own]
        #: None until it was held against the plain steps; then what came of it
        self.is_right: bool | None = None

    def __call__(self, state: Pass) -> tuple[dict[str, np.ndarray], Any] | None:
        """Values and the log weight; None where the plain steps must do it: whose draws are then gone."""
        values = dict(state.values)
        for z in self.drawn:
            values[z.noise] = z.draw(state.rng, state.batch)
        found = self.program(values)
        log = found[len(self.names)]
        good = all_finite(log)
        for k in self._own:
            good = good and all_finite(found[k])
        if good and self.is_strict:
            good = bool(found[-1].all())
        elif not good:  # a weight of zero is none of the faults
            good = self._is_sound(values, log)
        if not good:
            return None
        for k in self._own:
            found[k].flags.writeable = False
        return dict(zip(self.names, found, strict=False)), log

    def _is_sound(self, values: Mapping[str, np.ndarray], log: np.ndarray) -> bool:
        (every,) = Program([self.every])(values)
        return bool(every.all()) and bool((log < np.inf).all())


def evaluator(roots: Sequence[Expression]) -> Callable[[Mapping[str, Any]], list[np.ndarray]]:
    """A program for many particles: short vectors element by element, where that can be."""
    parts = by_element(roots) if any(n.shape for n in ordered(*roots) if n.leaves) else None
    if parts is None:
        return Program(for_arrays(roots))
    program = Program(for_arrays([e for part in parts for e in part.reshape(-1)]))
    leaves = [n for n in ordered(*roots) if isinstance(n, Leaf)]

    def evaluated(values: Mapping[str, Any]) -> list[np.ndarray]:
        found, whole = iter(program(columns(leaves, values))), []
        for root in roots:
            own = [next(found) for _ in range(root.size)]
            whole.append(together(own, root.shape, root.dtype))
        return whole

    return evaluated


class WholeSlice:
    """A step that makes all nodes of a slice, by the program or by the plain steps."""

    def __init__(self, made: SliceProgram, plain: Sequence[Step]) -> None:
        self._made, self._plain = made, plain

    def __call__(self, state: Pass) -> None:
        made, bits = self._made, state.rng.bit_generator
        before = bits.state
        if made.is_right:
            found = made(state)
            if found is not None:
                state.values.update(found[0])
                if made.weighs:
                    state.weigh(found[1])
                return
            bits.state = before
        elif made.is_right is None:
            self._hold(state)
            return
        passed(self._plain, state)

    def _hold(self, state: Pass) -> None:
        """The program held against the plain steps; what it gives is taken where it is right."""
        made, bits = self._made, state.rng.bit_generator
        start, other = bits.state, Pass(state.rng, state.batch, dict(state.values))
        found = made(state)
        end, bits.state = bits.state, start
        passed(self._plain, other)
        if found is not None:
            same = plainly(end) == plainly(bits.state)
            wanted = {n: other.values[n] for n in found[0]}
            made.is_right = same and agree(found, (wanted, other.log_weight))
        if found is None or not made.is_right:
            found = {n: other.values[n] for n in other.values}, other.log_weight
        state.values.update(found[0])
        if made.weighs:
            state.weigh(found[1])


def whole_slice(
    model: Model, dynamic: Collection[str], seen: Collection[str], plain: Sequence[Step]
) -> list[Step]:
    """The steps of a slice: one for all nodes where their densities can be followed, else the plain ones."""
    kept = model.cache.setdefault(_KEPT, {})
    key = frozenset(seen)
    if key not in kept:
        try:
            kept[key] = SliceProgram(read_slice(model, dynamic, seen, dynamic))
        except TraceError:
            kept[key] = None
    made = kept[key]
    return list(plain) if made is None or made.is_right is False else [WholeSlice(made, plain)]


def plainly(state: Any) -> Any:
    """The state of a generator, to be compared."""
    if isinstance(state, Mapping):
        return {k: plainly(v) for k, v in state.items()}
    return state.tolist() if isinstance(state, np.ndarray) else state


def agree(a: Sequence[Any], b: Sequence[Any]) -> bool:
    """Whether values and log weights of particles are the same to rounding."""
    (values, log), (wanted, wanted_log) = a, b
    if list(values) != list(wanted):
        return False
    pairs = [(values[k], wanted[k]) for k in values] + [(log, wanted_log)]
    return all(
        np.shape(x) == np.shape(y) and np.allclose(x, y, rtol=RTOL, atol=RTOL) for x, y in pairs
    )
