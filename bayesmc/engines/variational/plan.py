"""Which factor each hidden node has: closed forms where there are any."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.variational.factors import (
    Factor,
    NormalFactor,
    ScatterFactor,
    ShareFactor,
    State,
    TableFactor,
)
from bayesmc.engines.variational.free import FREE, FreeFactor
from bayesmc.engines.variational.jumping import refuse_jumps
from bayesmc.engines.variational.reading import TermReader, has_moments
from bayesmc.engines.variational.steps import Plan
from bayesmc.errors import TraceError, UnsupportedError
from bayesmc.passes.moments import Hidden, Meeting, NoMoment, moment
from bayesmc.structure.target import Target

#: elements of a plate that are made jointly normal where they meet
_JOINT = 400
#: joint states of a block of finite nodes
_STATES = 1 << 12
#: relative error that the energy of points may have
_ROUNDING = 1e-8


def plan_for(target: Target, blocks: Sequence[Sequence[str]]) -> Plan:
    """The factors of a posed problem.

    Raises
    ------
    UnsupportedError
        A node can have none.
    """
    chooser = _Chooser(target, blocks)
    while True:
        try:
            return chooser.attempt()
        except Meeting as error:
            for name in error.names:
                chooser.join(name)
        except NoMoment as error:
            chooser.release(error)


# ---- private ------------------------------------------------------------------------------------


class _Chooser:
    """Tries closed forms, and releases nodes that have none."""

    def __init__(self, target: Target, blocks: Sequence[Sequence[str]]) -> None:
        self.target = target
        self.free: dict[str, str] = {}
        self.joined: set[str] = set()
        self.scales: dict[str, str] = {}
        self.kinds: dict[str, str] = {}
        self.tables: dict[str, int] = {}
        self.groups: dict[str, tuple[str, ...]] = {}
        for name in target.chain:
            node = target.model[name]
            seen = target.seen(name)
            if node.domain is not None:
                self.tables[name] = node.domain.size
                continue
            if node.angles is not None:
                raise UnsupportedError(
                    f"MeanField: node {name!r} is an angle, and has no factor; use Gibbs() or "
                    "HamiltonianMonteCarlo()"
                )
            if node.is_discrete:
                raise UnsupportedError(
                    f"MeanField: node {name!r} is discrete and has no finite set of states; use Gibbs()"
                )
            kind = has_moments(target, name)
            if kind is None:
                self.free[name] = "its support has no closed form"
            else:
                self.kinds[name] = kind
            if seen is not None and seen.parts is not None:
                raise UnsupportedError(
                    f"MeanField: components of node {name!r} are observed one by one; use Gibbs()"
                )
        for block in blocks:
            self._block(tuple(block))

    def _block(self, block: tuple[str, ...]) -> None:
        for name in block:
            if name not in self.target.chain:
                raise UnsupportedError(
                    f"MeanField(blocks=): {name!r} is no hidden node that something observed depends on"
                )
        if any(name in self.tables for name in block):
            self._group(block)
            return
        scales = [n for n in block if self.kinds.get(n) in ("positive", "matrix")]
        means = [n for n in block if self.kinds.get(n) == "number"]
        if len(block) == 2 and len(scales) == len(means) == 1:
            shapes = [self.target.model[n] for n in (means[0], scales[0])]
            same = shapes[0].plate_shape == shapes[1].plate_shape
            if same and self.target.seen(means[0]) is None and self.target.seen(scales[0]) is None:
                self.scales[means[0]] = scales[0]
                return
        for name in block:
            self.free[name] = (
                f"it is asked for jointly with {', '.join(n for n in block if n != name)}"
            )

    def _group(self, block: tuple[str, ...]) -> None:
        """One table for several finite nodes."""
        target = self.target
        for name in block:
            if name not in self.tables:
                raise UnsupportedError(
                    f"MeanField(blocks=): {block} has finite nodes and node {name!r}, which has numbers"
                )
            if target.seen(name) is not None:
                raise UnsupportedError(
                    f"MeanField(blocks=): finite node {name!r} is observed in part, and can have no table "
                    "with others"
                )
        if len({target.model[n].plates for n in block}) > 1:
            raise UnsupportedError(
                f"MeanField(blocks=): finite nodes {block} have different plates"
            )
        count = math.prod(self.tables[n] for n in block)
        if count > _STATES:
            raise UnsupportedError(
                f"MeanField(blocks=): {block} have {count} joint states, more than {_STATES}"
            )
        self.groups |= dict.fromkeys(block, block)

    def join(self, name: str) -> None:
        """Make all elements of a node jointly normal."""
        size = math.prod(self.target.model[name].value_shape)
        if name in self.joined or size > _JOINT:
            self.free[name] = f"its {size} elements meet in one term"
        self.joined.add(name)

    def release(self, error: NoMoment) -> None:
        """Make nodes normal in unconstrained coordinates."""
        new = [n for n in error.names if n not in self.free]
        if not new:
            raise UnsupportedError(f"MeanField: {error}")
        for name in new:
            self.free[name] = str(error)
            for mean, scale in list(self.scales.items()):
                if name in (mean, scale):
                    other = scale if name == mean else mean
                    self.free.setdefault(other, f"it is a block with {name!r}: {error}")
                    del self.scales[mean]

    def attempt(self) -> Plan:
        target = self.target
        free = FreeFactor(target, list(self.free)) if self.free else None
        above = {} if free is None else free.above
        hidden = {n: self._hidden(n) for n in self.kinds if n not in self.free}
        reader = TermReader(target, hidden, self.tables, above, self.groups)
        sums = []
        for term in target.terms.values():
            try:
                sums.append(reader(term))
            except Meeting:
                raise
            except NoMoment as error:
                where = "potential" if term.is_potential else "density of"
                raise NoMoment(f"in the {where} {term.name!r} {error}", error.names) from error
            except UnsupportedError:
                raise
            except TraceError as error:
                kind = "potential" if term.is_potential else "node"
                raise UnsupportedError(f"MeanField: {kind} {term.name!r}: {error}") from error
        leaves = frozenset().union(*(s.total.leaves for s in sums))
        if free is not None:
            stray = free.volume.leaves & {*hidden, *self.tables}
            if stray:
                raise NoMoment("the bounds of another node depend on it", stray)
        factors = self._factors(hidden, leaves)
        if free is not None:
            factors.append(free)
        groups = dict.fromkeys(self.groups.get(n, (n,)) for n in self.tables)
        factors += [self._table(g, not reader.meeting.isdisjoint(g)) for g in groups]
        try:
            plan = Plan(target, tuple(factors), tuple(sums), free, self._why(factors))
            _ = plan.steps
        except TraceError as error:
            raise UnsupportedError(f"MeanField: {error}") from error
        hold_at_points(plan)
        return plan

    def _hidden(self, name: str) -> Hidden:
        node, kind = self.target.model[name], self.kinds[name]
        width = math.prod(node.event_shape) if kind == "number" else 1
        if name in self.joined:
            width = math.prod(node.value_shape)
        return Hidden(name, kind, node.value_shape, width, self.scales.get(name))

    def _factors(self, hidden: Mapping[str, Hidden], leaves: frozenset[str]) -> list[Factor]:
        found: list[Factor] = []
        means = {scale: mean for mean, scale in self.scales.items()}
        for name, own in hidden.items():
            seen = self.target.seen(name)
            mask = (
                None if seen is None else np.broadcast_to(np.asarray(seen.mask), self._plates(name))
            )
            uses = {f for f in ("x", "inv", "log", "log1m") if moment(name, f) in leaves}
            if own.kind == "number":
                if own.scale is None:
                    found.append(NormalFactor(own, mask))
            elif own.kind in ("positive", "matrix"):
                if {"x", "inv"} <= uses:
                    raise NoMoment("terms want its mean and that of its inverse", [name])
                mean = means.get(name)
                location = None if mean is None else hidden[mean]
                found.append(ScatterFactor(own, "inv" in uses, location, mask))
            elif "x" in uses:
                raise NoMoment("terms want its mean and that of its logarithm", [name])
            else:
                found.append(ShareFactor(own, mask))
        return found

    def _table(self, names: tuple[str, ...], meeting: bool) -> TableFactor:
        node, seen = self.target.model[names[0]], self.target.seen(names[0])
        mask = None if seen is None else np.broadcast_to(np.asarray(seen.mask), node.plate_shape)
        sizes = tuple(self.tables[n] for n in names)
        return TableFactor(names, sizes, node.plate_shape, mask, meeting)

    def _plates(self, name: str) -> tuple[int, ...]:
        return self.target.model[name].plate_shape

    def _why(self, factors: Sequence[Factor]) -> dict[str, str]:
        found = {}
        for factor in factors:
            for name in factor.names:
                found[name] = self._words(factor, name)
        return found

    def _words(self, factor: Factor, name: str) -> str:
        if isinstance(factor, FreeFactor):
            shape = "full" if factor.is_full else "diagonal"
            return (
                f"normal in unconstrained coordinates ({shape} covariance, {factor.size} in all, "
                f"{len(factor.weights)} points): {self.free[name]}"
            )
        if isinstance(factor, TableFactor):
            joint = "" if len(factor.names) == 1 else f", jointly ({', '.join(factor.names)})"
            return f"closed form: a table of {factor.size} states for every element{joint}"
        if isinstance(factor, NormalFactor):
            joint = ", all elements jointly, since they meet" if name in self.joined else ""
            return f"closed form: normal{joint}"
        if isinstance(factor, ScatterFactor):
            pair = {True: ("inverse gamma", "inverse Wishart"), False: ("gamma", "Wishart")}
            kind = pair[factor.is_inverse][factor.own.kind == "matrix"]
            if factor.location is not None:
                return (
                    f"closed form: normal and {kind} jointly ({factor.names[0]}, {factor.names[1]})"
                )
            return f"closed form: {kind}"
        return f"closed form: {'Dirichlet' if factor.own.kind == 'simplex' else 'beta'}"  # type: ignore


def hold_at_points(plan: Plan) -> None:
    """Refuse an energy that differs from the model's own log density where every factor is a point.

    Raises
    ------
    UnsupportedError
    """
    target = plan.target
    if target.states is None:
        return
    for row in (0, -1):
        values = {n: v if target.is_known(n) else v[row][None] for n, v in target.states.items()}
        for name in target.chain:
            seen = target.seen(name)
            if seen is not None:
                node = target.model[name]
                inner = (1,) * len(node.event_shape)
                mask = np.broadcast_to(np.asarray(seen.mask), node.plate_shape)
                mask = mask.reshape(node.plate_shape + inner)
                values[name] = np.where(mask, seen.value, values[name])
        with marking_invalid(), np.errstate(all="ignore"):
            target.refresh(values, target.chain)
            want = float(np.ravel(target.log_density(values))[0])
            state: State = {}
            plan.start(state, {n: values[n][0] for n in target.chain})
            if plan.free is not None:
                state[FREE] = np.broadcast_to(
                    plan.free.mean, (len(plan.free.weights), plan.free.size)
                )
            found = plan.energy_as_written(state)
            refuse_jumps(plan, state)
        if not np.isfinite(want):
            continue
        if not abs(found - want) <= _ROUNDING * (1.0 + abs(want)) * 10:
            raise UnsupportedError(
                f"MeanField: what was read of the net gives the log density {found:.10g} at a point where "
                f"its functions give {want:.10g}; use another engine, and report this"
            )
