"""Scales drawn together with the Normal block they govern: each by a slice with the block integrated out.

A variance component and the effects it governs hold each other fast where the data say little about either;
drawn as one they do not. It costs several times as much as one after the other, so a scale is treated so only
if the warmup shows that it moves slowly.

References
----------
Liu, Wong and Kong (1994), Biometrika 81, on collapsing; van Dyk and Park (2008), JASA 103, on the order.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence

import numpy as np

from bayesmc.distributions.transforms import Transform, transform_of
from bayesmc.errors import DensityError
from bayesmc.kernels.base import Kernel, Memory
from bayesmc.kernels.gaussian_block import GaussianBlock, shortened
from bayesmc.kernels.slice import slice_move
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.like_terms import TermSum
from bayesmc.structure.target import Target, Values

#: first sweep of the warmup that is watched, and how many are, most and least: chains pool what they show
_WATCH_FROM, _WATCHED, _FEWEST = 40, 200, 30
#: draws of all chains that tell enough
_DRAWS = 800
#: sweeps of the watch without which nothing is called slow, where chains are few
_ENOUGH = 50
#: lags, and the autocorrelations there that count as slow
_SLOW = ((1, 0.6), (10, 0.1))
#: of so many chains one is not looked at
_FAR = 8
#: components of a block that is worth it
_MAX_DENSE, _MAX_LOCAL = 64, 2000
_KINDS = ("real", "interval")


class CollapsedBlock(Kernel):
    """A Gaussian block, after slices of the scales that move slowly with the block integrated out.

    Parameters
    ----------
    blankets : dict
        Of the scales.
    alone : dict
        Scale -> the kernel that moves it given the block, where it is not slow.
    """

    label = "conjugate block"

    def __init__(
        self,
        target: Target,
        block: GaussianBlock,
        blankets: Mapping[str, Blanket],
        alone: Mapping[str, Kernel],
    ) -> None:
        self.target, self.block = target, block
        self.alone = dict(alone)
        self.names = (*block.names, *blankets)
        self.blankets = dict(blankets)
        self.evaluations = 1.0 + sum(k.evaluations for k in self.alone.values())
        self.transforms: dict[str, Transform] = {}
        for name in blankets:
            support = target.model[name].support
            assert support is not None
            self.transforms[name] = transform_of(support)
        inside = {id(t) for t in block.terms}
        self.others = {
            name: TermSum(target, [c.term for c in b.children if id(c.term) not in inside])
            for name, b in blankets.items()
        }
        #: what follows from a node, the block apart
        self.links = {
            name: tuple(n for n in target.below((name,)) if n not in block.path)
            for name in blankets
        }
        self.needed = _alike(target, _scope(target, block, blankets))
        self.match = block.match

    def words(self, name: str) -> tuple[str, str]:
        if name not in self.blankets:
            return self.block.words(name)
        block = shortened(self.block.names)
        if name not in self.alone:
            return "collapsed slice", f"{block} integrated out, if slow otherwise"
        label, match = self.alone[name].words(name)
        return (
            f"{label} or collapsed slice",
            f"{match}{'; ' if match else ''}if slow, {block} integrated out",
        )

    def start(self, values: Values, chains: int) -> Memory:
        return {
            "sweep": 0,
            "until": _WATCH_FROM + min(_WATCHED, max(_DRAWS // chains, _FEWEST)),
            "slow": dict.fromkeys(self.blankets, False),
            "width": dict.fromkeys(self.blankets, 1.0),
            "step": dict.fromkeys(self.blankets, 0.0),
            "series": {n: np.zeros((0, chains)) for n in self.blankets},
            "alone": {n: k.start(values, chains) for n, k in self.alone.items()},
        }

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        state = values
        watching = warmup and memory["sweep"] < memory["until"]
        slow = [n for n in self.blankets if memory["slow"][n] and not watching]
        # those that are drawn given the block come first: after a collapsed move it must be drawn anew
        for name in self.alone:
            if name in slow:
                continue
            found, own = self.alone[name].step(state, memory["alone"][name], rng, warmup)
            state = {**state, **found}
            self.target.refresh(state, (name,))
            memory = {**memory, "alone": {**memory["alone"], name: own}}
        for name in slow:
            new, step = self._moved(state, name, memory["width"][name], rng)
            state = {**state, name: new}
            self.target.refresh(state, (name,))
            if warmup:
                memory = _widened(memory, name, step)
        drawn, _ = self.block.step(state, {}, rng, warmup)
        if warmup:
            memory = self._watched(state, memory)
        return {**{n: state[n] for n in self.blankets}, **drawn}, memory

    def end_warmup(self, memory: Memory) -> Memory:
        alone = {n: k.end_warmup(memory["alone"][n]) for n, k in self.alone.items()}
        memory = self._decided(memory)  # a short warmup may end within the watch
        return {**memory, "alone": alone}

    # ---- private -------------------------------------------------------------------------------

    def _moved(
        self, values: Values, name: str, width: float, rng: np.random.Generator
    ) -> tuple[np.ndarray, float]:
        """A slice of one node on its free scale, the block integrated out; and how far it went."""
        transform = self.transforms[name]
        u = transform.unconstrain(values[name])

        def log_density(tried: np.ndarray) -> np.ndarray:
            x = transform.constrain(tried)
            inside = np.isfinite(x) & np.isfinite(transform.unconstrain(x))
            x = np.where(inside, x, values[name])
            log = self._log(values, name, x) + transform.log_abs_det_jacobian(tried)
            return np.where(inside, log, -np.inf)

        try:
            moved = slice_move(log_density, u, np.full(u.shape, width), rng)
        except DensityError as error:
            raise DensityError(f"node {name!r}: {error}") from error
        return transform.constrain(moved), float(np.abs(moved - u).mean())

    def _log(self, values: Values, name: str, x: np.ndarray) -> np.ndarray:
        """Log density of a node with the block integrated out, at candidates ``(..., chains)``."""
        lead = x.shape
        count = math.prod(lead)
        state = dict(values)
        if count > lead[-1]:
            state.update(self._repeated(values, count // lead[-1]))
        state[name] = x.reshape(count)
        self.target.compute(state, self.links[name])
        log = self.block.log_integral(state, count) + self.blankets[name].own_log(state)
        log = log + self.others[name].log_density(state)
        return np.broadcast_to(log, (count,)).reshape(lead)

    def _repeated(self, values: Values, times: int) -> Values:
        """What is needed besides, once for each of several candidates, those of like shapes as one."""
        found: Values = {}
        for names in self.needed:
            first = values[names[0]]
            rows = np.concatenate([values[n] for n in names]).reshape(len(names), 1, *first.shape)
            wide = np.broadcast_to(rows, (len(names), times, *first.shape))
            wide = wide.reshape(len(names), times * len(first), *first.shape[1:])
            found.update(zip(names, wide, strict=True))
        return found

    def _watched(self, state: Values, memory: Memory) -> Memory:
        """Notes where the nodes are; at the end of the watch, which of them are slow."""
        sweep = memory["sweep"] + 1
        memory = {**memory, "sweep": sweep}
        if not _WATCH_FROM <= sweep <= memory["until"]:
            return memory
        series = {}
        for name, seen in memory["series"].items():
            series[name] = np.vstack([seen, self.transforms[name].unconstrain(state[name])])
        memory = {**memory, "series": series}
        return memory if sweep < memory["until"] else self._decided(memory)

    def _decided(self, memory: Memory) -> Memory:
        """Which nodes are slow, if enough was seen of them to tell."""
        series = memory["series"]
        enough = min(_ENOUGH, memory["until"] - _WATCH_FROM)
        if min(len(seen) for seen in series.values()) < enough:
            return memory
        slow = {
            name: any(_autocorrelation(_settled(seen), lag) > limit for lag, limit in _SLOW)
            for name, seen in series.items()
        }
        return {**memory, "slow": slow, "series": {n: s[:0] for n, s in series.items()}}


def governing(
    target: Target, block: GaussianBlock, blankets: Mapping[str, Blanket]
) -> dict[str, Blanket]:
    """The scales, and other numbers, that can be drawn with a block integrated out."""
    layout = block.layout
    found: dict[str, Blanket] = {}
    if layout.dg > _MAX_DENSE or layout.cut > _MAX_LOCAL:
        return found
    inside = {id(t) for t in block.terms}
    for name, blanket in blankets.items():
        node = target.model[name]
        if name in block.names or node.plates or node.event_shape or node.is_discrete:
            continue
        if node.support is None or node.support.kind not in _KINDS or not node.support.is_single:
            continue
        if blanket.own is None or id(blanket.own) in inside:
            continue
        if inside & {id(c.term) for c in blanket.children}:
            found[name] = blanket
    return found


# ---- private ------------------------------------------------------------------------------------


def _scope(
    target: Target, block: GaussianBlock, blankets: Mapping[str, Blanket]
) -> tuple[str, ...]:
    """Hidden nodes whose values the block's terms and the nodes' own read, the block's own apart."""
    terms = {t.name: t for t in block.terms}
    for blanket in blankets.values():
        terms.update({c.term.name: c.term for c in blanket.children})
        if blanket.own is not None:
            terms[blanket.own.name] = blanket.own
    read = (n for t in terms.values() for n in t.scope)
    found = set(target.model.above(read, lambda n: n in target.links and n not in target.known))
    found -= {*block.names, *block.path, *target.known}  # the block's are put at zero
    return tuple(n for n in (*target.chain, *target.links) if n in found)


def _alike(target: Target, names: Sequence[str]) -> tuple[list[str], ...]:
    """Nodes by the shape and the type of their values."""
    groups: dict[Hashable, list[str]] = {}
    for name in names:
        node = target.model[name]
        codes = None if node.domain is None else node.domain.dtype.str
        groups.setdefault((node.value_shape, node.is_discrete, codes), []).append(name)
    return tuple(groups.values())


def _widened(memory: Memory, name: str, step: float) -> Memory:
    before = memory["step"][name]
    mean = step if before == 0 else 0.9 * before + 0.1 * step
    width = 3.0 * mean if mean > 0 else memory["width"][name]
    return {
        **memory,
        "step": {**memory["step"], name: mean},
        "width": {**memory["width"], name: width},
    }


def _settled(series: np.ndarray) -> np.ndarray:
    """The chains but for those farthest from the rest: one that is not yet home makes all look slow."""
    far = ((series - np.median(series)) ** 2).mean(axis=0)
    kept = far.size - far.size // _FAR
    return series[:, np.argsort(far, kind="stable")[:kept]]


def _autocorrelation(series: np.ndarray, lag: int) -> float:
    """Autocorrelation of chains ``(sweeps, chains)``, about the mean of all."""
    centred = series - series.mean()
    power = float((centred**2).mean())
    return float((centred[lag:] * centred[:-lag]).mean()) / power if power > 0 else 1.0
