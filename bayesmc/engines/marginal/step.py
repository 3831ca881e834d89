"""The step of a particle filter that integrates out what is linear-Gaussian given what it samples.

Sampled nodes are drawn as in any particle filter. Every particle carries a Gaussian belief about the others;
the predictive density of what is seen of these weighs it. Beside it stands one draw from that belief, so
that the particles, completed by these, are draws of all nodes as those of a plain filter are: functions of
nodes, smoothing and the errors of answers take them as they come.

References
----------
Doucet, de Freitas, Murphy and Russell (2000), Rao-Blackwellised particle filtering for dynamic Bayesian
networks, UAI 16; Chen and Liu (2000), Mixture Kalman filters, JRSS B 62.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from bayesmc.dbn import Row
from bayesmc.engines.kalman.data import Pattern, given_values, pattern_of, stacked
from bayesmc.engines.kalman.slices import Layout, unknown_nodes
from bayesmc.engines.marginal.choices import Choices
from bayesmc.engines.marginal.gaussians import Coefficients, Gaussians, Taken, nothing, take_in
from bayesmc.engines.marginal.lagging import newest, told_more
from bayesmc.engines.marginal.linearised import LinearisedReader
from bayesmc.engines.marginal.predictive import Weighed, weighed
from bayesmc.engines.marginal.reading import SliceReader, Values
from bayesmc.engines.marginal.scouting import MarginalScouting
from bayesmc.engines.marginal.split import Split, blocks_of
from bayesmc.engines.marginal.tables.afterwards import drawn_afterwards
from bayesmc.engines.marginal.tables.beliefs import Tables
from bayesmc.engines.marginal.tables.groups import Moved
from bayesmc.engines.marginal.tables.step import Known, TableFilter
from bayesmc.engines.particles.filter_step import FilterStep, has_weight
from bayesmc.engines.particles.smc import Particles, Selection
from bayesmc.engines.slice_steps import SlicePlan, SliceProposals
from bayesmc.errors import DegeneracyError, UnsupportedError
from bayesmc.network.forward import Step
from bayesmc.network.forward import nothing as no_step


class MarginalPlan(SlicePlan):
    """Steps of slices without the nodes whose values no particle has."""

    left_out: frozenset[str] = frozenset()

    def step(self, row: Row, name: str) -> Step:
        return no_step if name in self.left_out else super().step(row, name)

    def steps_without(self, row: Row, left_out: frozenset[str]) -> list[Step]:
        """The steps of a row's slice but for some nodes."""
        self.left_out = left_out
        return self._build(row)


class UnseenError(UnsupportedError):
    """A node is missing that everything rests on being seen; nothing was drawn yet."""


class Place(NamedTuple):
    """What rows in which the same nodes are seen have in common.

    Attributes
    ----------
    layout : Layout
    reader : SliceReader
    steps : list of Step, or None
        None where something is seen in part: they are built for each row.
    choices : Choices or None
        Of finite nodes, drawn with a look at the row.
    """

    layout: Layout
    reader: SliceReader
    steps: list[Step] | None
    choices: Choices | None


class MarginalStep(FilterStep):
    """The step of a Rao-Blackwellised particle filter on a template.

    Parameters
    ----------
    plan : SlicePlan
        Of all nodes, without proposals.
    split : Split
    proposals : SliceProposals or None
        Of sampled nodes; with None finite ones are drawn given the row.

    The others are those of ``FilterStep``.
    """

    def __init__(
        self,
        plan: SlicePlan,
        split: Split,
        particles: int,
        resample: Callable[..., np.ndarray],
        threshold: float,
        kept: Sequence[str] | None,
        proposals: SliceProposals | None,
    ) -> None:
        super().__init__(plan, particles, resample, threshold, kept=kept)
        self.split, self.looks = split, proposals is None
        #: the tables of finite nodes, if there are any
        self.tables = None
        self.integrated = frozenset(split.inner)
        if split.tables is not None:
            self.tables = TableFilter(plan.slices, plan.apart, split.tables)
            self.integrated |= split.tables.names
        self.sampling = MarginalPlan(plan.slices, plan.apart, plan.static, proposals)
        self.is_guided = self.looks or self.sampling.guided
        self._places: dict[Any, Place] = {}
        #: plates whose elements do not meet given what is sampled: small Gaussians instead of a large one
        whole = self.looks or plan.apart or not split.inner
        self.blocks = () if whole else blocks_of(plan.slices, split)

    def __call__(self, earlier: Particles | None, row: Row, rng: np.random.Generator) -> Particles:
        place = self.place(row, None if earlier is None else earlier.inner)
        before, selection = self.chosen(earlier, row, rng)
        hidden = self.hidden_before(place)
        before = {k: v for k, v in before.items() if k not in hidden}
        inner = nothing(place.layout, selection.particles)
        tables = None
        if earlier is not None:
            inner = earlier.inner.carried().taken(selection.ancestors)
            tables = earlier.tables and earlier.tables.taken(selection.ancestors)
        steps = place.steps
        if steps is None:
            steps = self.sampling.steps_without(row, self._left_out(place.layout))
        values, log = self.propagated(steps, row, before, selection, rng)
        taken = place, row, before, values, log, inner, tables, selection, rng
        values, log, inner = self._taken(*taken)
        after: Any = None
        if self.tables is not None:
            known = self._known(row, before, values, selection)
            more, after, moves = self.tables.advanced(row, known, tables)
            if self.lag and tables is not None:
                pairs = [m.pair for m in moves if m.pair is not None]
                after = after.looking_back(tables, pairs, self.lag)
            log = log if place.choices is not None else log + more
        found = self.weighted(row, values, log, selection)
        if not has_weight(found):
            raise degenerate(selection.particles, row)
        values |= inner.completed(rng)
        if self.tables is not None:
            values |= self.completed(row, known, values, (tables, after, moves), rng)
        for name in [n for n in values if n not in self.kept]:
            del values[name]
        return found._replace(inner=inner._replace(seen=self.split.seen), tables=after)

    def hidden_before(self, place: Place) -> frozenset[str]:
        """Nodes of the slice before of which no particle has a value that others may read."""
        hidden = place.reader.hidden_before
        return hidden if self.tables is None else hidden | self.tables.hidden_before

    def completed(
        self,
        row: Row,
        known: Known,
        values: Mapping[str, np.ndarray],
        tables: tuple[Tables | None, Tables, Sequence[Moved]],
        rng: np.random.Generator,
    ) -> dict[str, np.ndarray]:
        """A draw of all nodes with tables, and of what waits for these: tables before, now, and between."""
        assert self.tables is not None
        before, after, moves = tables
        now, past = self.tables.completed(after, before, moves, row, known, rng)
        every = {**known.values, **past, **values, **now}
        out = self.tables.left_out(row.t == 0) - self.tables.plan.names
        return now | drawn_afterwards(self.slices, row, out, every, known.particles, rng)

    def stored(self, row: Any, values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """All values of the slice that particles have; those that are not kept go later."""
        return {n: values[n] for n in self.slices.dynamic if n in values}

    @property
    def by_element(self) -> bool:
        """Whether particles carry a Gaussian of each element of a plate, not one of everything."""
        return False

    def scouting(self) -> MarginalScouting:
        return MarginalScouting(self)

    def recycle(self, particles: Particles) -> None:
        """Gaussians look at arrays of theirs for longer."""

    # ---- private -------------------------------------------------------------------------------

    def _taken(
        self,
        place: Place,
        row: Row,
        before: Mapping[str, np.ndarray],
        values: dict[str, np.ndarray],
        log: Any,
        inner: Gaussians,
        tables: Tables | None,
        selection: Selection,
        rng: np.random.Generator,
    ) -> tuple[dict[str, np.ndarray], Any, Gaussians]:
        """The row taken in by the Gaussians: all values that particles have, log weights, beliefs."""
        known = self._values(place, row, before, values, selection)
        if place.choices is None:
            pattern, target, given = seen_of(place.layout, row)
            coefficients = place.reader.at(inner).read(known)
            made = take_in(place.layout, pattern, inner, coefficients, target, given, self.lag > 0)
            own = made.log[:, 0]
            if self.blocks:
                own = own.sum(axis=tuple(range(1, own.ndim)))
            return values, log + own, self._looking_back(inner, made, made.chosen(None), pattern)
        joint, each, found = self.looked(place, place.choices, row, known, inner)
        if self.tables is not None:
            every = self._known(row, before, values, selection)
            joint = joint + self.tables.predicted(row, every, tables, place.choices.values)
        own, at = place.choices.drawn(joint, rng)
        values |= self.chosen_values(place, place.choices, known, values, at)
        level = np.where(own > -np.inf, own, 0.0)
        over = each.averaged(np.exp(joint - level[:, None]))
        after = each.chosen(at)
        if self.lag and found is not None:
            after = self._again(place, row, inner, found.chosen(at))
        return values, log + own, after._replace(over=over)

    def _again(self, place: Place, row: Row, before: Gaussians, chosen: Coefficients) -> Gaussians:
        """The row taken in with what was drawn, which tells of the slices before, too."""
        pattern, target, given = seen_of(place.layout, row)
        made = take_in(place.layout, pattern, before, chosen, target, given, True)
        return self._looking_back(before, made, made.chosen(None), pattern)

    def _looking_back(
        self, before: Gaussians, made: Taken, after: Gaussians, pattern: Pattern
    ) -> Gaussians:
        """With beliefs about the slices before, as many as later answers are about."""
        if made.turned is None:
            return after
        past = before.past[: self.lag]
        found = told_more(past, made.turned, made.group, len(pattern.observed))
        return after._replace(past=(newest(after.layout, after.mean, after.factors), *found))

    def looked(
        self, place: Place, choices: Choices, row: Row, known: Values, inner: Gaussians
    ) -> tuple[np.ndarray, Taken | Weighed, Coefficients | None]:
        """The row with every choice of finite nodes; logs have shape (particles, choices, *lead).

        There are no coefficients where the choices were weighed together.
        """
        pattern, target, given = seen_of(place.layout, row)
        together = given is None and not place.layout.lead and not self.lag and place.layout.p > 0
        if together and isinstance(place.reader, LinearisedReader):
            ahead = choices.expected(known, row, place.reader.at(inner))
            each = None if ahead is None else weighed(place.layout, ahead[1], target)
            if ahead is not None and each is not None:
                return ahead[0] + each.log, each, None
        prior, coefficients = choices.read(known, row, place.reader.at(inner))
        made = take_in(place.layout, pattern, inner, coefficients, target, given)
        return prior + made.log, made, coefficients

    def chosen_values(
        self,
        place: Place,
        choices: Choices,
        known: Values,
        values: Mapping[str, np.ndarray],
        at: np.ndarray,
    ) -> dict[str, np.ndarray]:
        """Values of finite nodes that were drawn, and of what is computed from them."""
        layout, found = place.layout, choices.values_at(at)
        whole = {**known.at(None), **values, **found}
        for name in layout.computed:
            found[name] = whole[name] = layout.model.evaluate(name, whole)[0]
        return found

    def _known(
        self,
        row: Row,
        before: Mapping[str, np.ndarray],
        values: Mapping[str, np.ndarray],
        selection: Selection,
    ) -> Known:
        """All values that tables may read."""
        taken = {k: self.taken(k, v, selection.ancestors) for k, v in before.items()}
        found = {**self.sampling.known(row), **taken, **values}
        own = {n for n, v in found.items() if n in self.ranks and v.ndim == self.ranks[n]}
        return Known(found, frozenset(own), selection.particles)

    def _left_out(self, layout: Layout) -> frozenset[str]:
        """Nodes of a slice that no particle has a value of yet, or whose density weighs beliefs."""
        found = layout.unknown | layout.seen.keys()
        return found if self.tables is None else found | self.tables.left_out(layout.first)

    def _values(
        self,
        place: Place,
        row: Row,
        before: Mapping[str, np.ndarray],
        values: Mapping[str, np.ndarray],
        selection: Selection,
    ) -> Values:
        """What is known given what was sampled."""
        plain, own = dict(self.sampling.known(row)), dict[str, np.ndarray]()
        taken = {
            k: self.taken(k, v, selection.ancestors)
            for k, v in before.items()
            if k in place.reader.needed
        }
        for name, value in {**taken, **values}.items():
            into = own if value.ndim == self.ranks[name] else plain
            into[name] = value
        return Values(plain, own, selection.particles)

    def place(self, row: Row, inner: Gaussians | None) -> Place:
        """The layout of a row's slice.

        Raises
        ------
        UnseenError
        """
        carried = () if inner is None else inner.layout.after
        partly = any(seen.mask is not None for seen in row.seen.values())
        full = frozenset(n for n, o in row.seen.items() if o.mask is None)
        key = (row.t == 0, carried, partly, full)
        if key not in self._places:
            late = (self.split.seen - full) & self.split.below
            known = full | (frozenset(self.slices.stochastic) - set(self.split.inner) - late)
            unknown = unknown_nodes(self.slices, row.t == 0, known, carried)
            apart = (*self.layout.apart, *self.blocks)
            layout = Layout(self.slices, apart, row.t == 0, carried, unknown)
            if self.tables is not None:
                layout = self.tables.without(layout)
            guarded = [n for n in layout.seen if n not in full]
            missed = sorted(late) or [n for n in layout.before if n in self.split.below]
            pair = (missed[0], guarded[0]) if guarded else None
            if self.tables is not None and pair is None:
                pair = self.tables.unexplained(full, self.split.seen)
            if pair is not None:
                when = "in the slice before" if not late and guarded else f"in slice {row.t}"
                raise UnseenError(
                    f"ParticleFilter(marginalize=...): {pair[0]!r} is missing {when}, and "
                    f"{pair[1]!r}, which is sampled, depends on it; start with a row that lacks it, or "
                    "give marginalize=None"
                )
            choices = Choices(layout, full, self.sampling) if self.looks else None
            if choices is not None and not choices.names:
                choices = None
            steps: list[Step] | None = [] if choices is not None else None
            if choices is None and not partly:
                steps = self.sampling.steps_without(row, self._left_out(layout))
            bent = any(n in self.split.linearised for n in layout.placed)
            reader = LinearisedReader(layout) if bent else SliceReader(layout)
            self._places[key] = Place(layout, reader, steps, choices)
        return self._places[key]


def seen_of(layout: Layout, row: Row) -> tuple[Pattern, np.ndarray, np.ndarray | None]:
    """What Gaussians see of a row: which numbers, their values, and values of unknown numbers."""
    partly = {n: o for n, o in row.seen.items() if o.mask is not None}
    found = given_values(layout, partly, ())
    empty = np.zeros((*layout.lead, layout.n), dtype=bool)
    pattern = pattern_of(layout, empty if found is None else found[1])
    target = stacked(layout, {n: row.seen[n].value for n in layout.seen}, ())
    if found is None:
        return pattern, target, None
    given = found[0]
    more = given[..., pattern.observed[layout.p :] - layout.p]
    return pattern, np.concatenate([target, more], axis=-1), given


def degenerate(particles: int, row: Row) -> DegeneracyError:
    """No particle explains a row."""
    return DegeneracyError(
        f"none of {particles} particles explains what was seen in slice {row.t}: every weight is zero; use "
        'more particles, proposal="optimal", a proposal= that looks at the observations, or less narrow '
        "noise",
        row.t,
        None,
    )
