"""``ParticleFilter(marginalize=)``: read, refused, told, and the step that it makes."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from bayesmc.dbn import PREVIOUS, SeriesProblem, Slices
from bayesmc.engines.filtering import Asked
from bayesmc.engines.marginal.choices import MOST
from bayesmc.engines.marginal.elements.filter import ElementStep
from bayesmc.engines.marginal.elements.guides import why_not_guided
from bayesmc.engines.marginal.elements.plan import ElementPlan, element_plan
from bayesmc.engines.marginal.smoothing import why_not_backwards
from bayesmc.engines.marginal.split import AUTO, Split, blocks_of, split_of
from bayesmc.engines.marginal.step import MarginalStep
from bayesmc.engines.marginal.tables.step import refuse_seen_in_part
from bayesmc.engines.marginal.tables.telling import tables_told
from bayesmc.engines.particles.layers import endless
from bayesmc.engines.slice_steps import SlicePlan, SliceProposals, plates_apart
from bayesmc.errors import UnsupportedError

_SEEN = "observed, weights the particles by its predictive density"
#: said of nodes whose means are not affine
_BENT = "linearised at each particle's own mean"
#: joint states of finite nodes up to which plain particles do, in bits
FEW = 8.0
#: questions about slices given rows that come after them
PAST = ("smooth", "fixed-lag")
#: options that do not go with it
_ALONE = ("adapt", "recovery", "rejuvenation", "auxiliary")


def marginal_step(
    engine: Any,
    split: Split,
    slices: Slices,
    static: Mapping[str, np.ndarray],
    scheme: Any,
    threshold: float,
    kept: Any,
    asked: SliceProposals | None,
) -> MarginalStep:
    """The step of a filter that integrates out: by element where elements are proven independent."""
    plan = SlicePlan(slices, plates_apart(slices), static)
    given = plan, split, engine.particles, scheme, threshold, kept, asked
    elements = elements_of(slices, split, asked)
    if elements is None:
        return MarginalStep(*given)
    if engine.delay and (why := _joint_tangents(engine, slices, split, "delay=")):
        raise UnsupportedError(why)
    guided = None
    if asked is None:
        guided, is_wrong = guided_node(slices, split, elements)
        if is_wrong:
            return MarginalStep(*given)
    return ElementStep(*given, elements, guided)


def elements_of(slices: Slices, split: Split, asked: SliceProposals | None) -> ElementPlan | None:
    """What is integrated out element by element, where that pays; else None."""
    if not split.inner:
        return None
    proposed = () if asked is None else [n for p in (*asked.first, *asked.later) for n in p.names]
    key = (split, tuple(proposed))
    kept = slices.later.cache.setdefault("elements", {})
    if key not in kept:
        found = element_plan(
            slices, split.inner, split.seen, split.linearised, plates_apart(slices), proposed
        )
        pays = found is not None and (found.is_picked or found.still or bool(split.linearised))
        kept[key] = found if pays else None
    return kept[key]


def elements_asked(engine: Any, slices: Slices, split: Split) -> ElementPlan | None:
    """What this engine integrates out element by element, if anything."""
    asked = None if engine.proposal == "optimal" else engine._proposals(slices)
    elements = elements_of(slices, split, asked)
    if elements is not None and asked is None and guided_node(slices, split, elements)[1]:
        return None
    return elements


def drawn_by_element(
    engine: Any, slices: Slices, split: Split, elements: ElementPlan, name: str, plain: str
) -> str:
    """What is done to a sampled node beside elements."""
    if name in elements.pickers:
        return "sampled given what it picks and the reading"
    if engine.proposal == "optimal" and guided_node(slices, split, elements)[0] == name:
        return "sampled given the slice before and the row, made linear in it"
    return plain


def guided_node(slices: Slices, split: Split, elements: ElementPlan) -> tuple[str | None, bool]:
    """The sampled vector that is drawn with a look at readings of elements, and whether that cannot be.

    Finite nodes that pick are drawn so anyhow; others are not, by element.
    """
    free = [n for n in slices.stochastic if n not in split.seen and n not in split.waiting]
    free = [n for n in free if n not in elements.pickers]
    if any(slices.later[n].domain is not None for n in free):
        return None, True
    fits = [n for n in free if why_not_guided(slices, elements, n) is None]
    return (fits[0], False) if len(fits) == 1 else (None, bool(free))


def read_marginalize(engine: Any) -> Any:
    """``"auto"``, a tuple of names, or None.

    Raises
    ------
    TypeError, ValueError
    """
    given = engine.marginalize
    if given is None:
        return None
    names = (given,) if isinstance(given, str) else given
    if not isinstance(names, (list, tuple)) or not all(isinstance(n, str) for n in names):
        raise TypeError(
            f'ParticleFilter(marginalize={given!r}): give "auto", names of hidden nodes, or None'
        )
    if not names:
        raise ValueError(
            "ParticleFilter(marginalize=[]): nothing is named; give None to sample all that is hidden"
        )
    for option in _ALONE:
        if getattr(engine, option):
            raise ValueError(
                f"ParticleFilter: marginalize= and {option}= do not go together; leave one of them out"
            )
    if engine.compiled:
        raise ValueError(
            "ParticleFilter: what marginalize= integrates out has no machine code; leave compiled= out"
        )
    return AUTO if given == AUTO else tuple(dict.fromkeys(names))


def split_asked(
    engine: Any, slices: Slices, static: Mapping[str, np.ndarray], seen: Collection[str]
) -> Split | None:
    """What is integrated out; None where nothing is.

    Raises
    ------
    UnsupportedError
    """
    if engine.marginalize is None:
        return None
    found = _whole(engine, slices, static, seen)
    return found if found.inner or found.tables is not None else None


def split_of_problem(engine: Any, problem: SeriesProblem) -> Split | None:
    """The same for a series."""
    return split_asked(engine, problem.slices, problem.known_static, problem.seen)


def asking(engine: Any, what: str) -> Any:
    """The same engine as it answers a question about the past: it may integrate out less there."""
    if what not in PAST or getattr(engine, "marginalize", None) is None:
        return engine
    found = object.__new__(type(engine))
    found.__dict__.update(engine.__dict__, question=what)
    return found


def sampling(engine: Any) -> Any:
    """The same engine, which integrates nothing out."""
    found = object.__new__(type(engine))
    found.__dict__.update(engine.__dict__, marginalize=None)
    return found


def not_of_the_past(engine: Any, problem: SeriesProblem, what: str) -> str | None:
    """Why a question about the past has no answer, or None."""
    if what not in PAST:
        return None
    try:
        split = split_of_problem(asking(engine, what), problem)
    except UnsupportedError as error:
        return f"ParticleFilter: {error}"
    return None if split is None else _joint_tangents(engine, problem.slices, split, what)


def why_not(engine: Any, problem: SeriesProblem, asked: SliceProposals | None) -> str | None:
    """Why ``marginalize=`` cannot be followed, or None.

    ``asked`` are the proposals.
    """
    try:
        split = split_of_problem(engine, problem)
    except UnsupportedError as error:
        return f"ParticleFilter: {error}"
    if split is None:
        return None
    if engine.delay and (joint := _joint_tangents(engine, problem.slices, split, "delay=")):
        return joint
    if split.tables is not None:
        try:
            refuse_seen_in_part(split.tables, problem.series.observed)
        except UnsupportedError as error:
            return str(error)
    slices = problem.slices
    sampled = [n for n in slices.stochastic if n not in problem.seen and n not in split.waiting]
    if engine.proposal == "optimal":
        elements = elements_of(slices, split, None)
        if elements is not None and not guided_node(slices, split, elements)[1]:
            return None
        wrong = next((n for n in sampled if slices.later[n].domain is None), None)
        if wrong is not None and elements is not None:
            found = {n: why_not_guided(slices, elements, n) for n in sampled}
            whys = [f"{n!r} {why or 'is one of several'}" for n, why in found.items()]
            return (
                'ParticleFilter: with marginalize=, proposal="optimal" draws one vector given the row, which '
                f"readings of {elements.states[0]!r} read, and what is sampled here is not that: "
                f"{'; '.join(whys)}; give proposal={{...}}, or leave it out"
            )
        if wrong is not None:
            why = "which is sampled"
            if wrong in problem.series.observed:
                why = "which is sampled where its reading is missing"
            return (
                'ParticleFilter: with marginalize=, proposal="optimal" draws finite nodes given the row, and '
                f"{wrong!r}, {why}, is not finite; give proposal={{...}}, or leave it out"
            )
        count = 1.0
        for name in sampled:
            node = slices.later[name]
            assert node.domain is not None
            sizes = zip(node.plates, node.plate_shape, strict=True)
            others = [k for p, k in sizes if p not in plates_apart(slices)]
            count *= float(node.domain.size) ** float(np.prod(others))
        if count > MOST:
            return (
                f'ParticleFilter: with marginalize=, proposal="optimal" goes through the joint states of '
                f"{', '.join(map(repr, sampled))}, which are {count:.4g}, more than {MOST}; "
                "leave proposal= out"
            )
        return None
    for proposal in [] if asked is None else [*asked.first, *asked.later]:
        names = (*proposal.names, *proposal.parents)
        inner = next((n for n in names if n.removesuffix(PREVIOUS) in split.waiting), None)
        if inner is not None:
            return (
                f"{proposal.what} names {inner!r}, which marginalize= integrates out, so no particle has a "
                "value of it; name sampled nodes"
            )
    return None


def is_worth_it(engine: Any, problem: SeriesProblem) -> bool:
    """Whether it pays to integrate out where nobody asks for it: numbers do, and finite nodes by the many.

    Plain particles are machine code, and meet all of a few states.
    """
    split = split_of_problem(engine, problem)
    if split is None:
        return False
    return bool(split.inner) or (split.tables is not None and split.tables.joint > FEW)


def numbers_carried(engine: Any, problem: SeriesProblem) -> float:
    """Of a particle: entries of its tables, and of the roots of its covariances."""
    split = None if engine.marginalize is None else split_of_problem(engine, problem)
    if split is None:
        return 0.0
    slices = problem.slices
    sizes = [np.prod(slices.later[n].value_shape) for n in split.inner]
    apart = math.prod(slices.first.sizes[p] for p in blocks_of(slices, split))
    found = float(sum(sizes)) ** 2 / max(apart, 1)
    if split.tables is not None:
        found += sum(g.elements * g.states for g in split.tables.groups)
    return found


def reasons(engine: Any, problem: SeriesProblem) -> tuple[str, ...]:
    """Why this engine is taken, where something is integrated out."""
    split = split_of_problem(engine, problem)
    if split is None:
        return ()
    seen = problem.series.observed
    inner = ", ".join(repr(n) for n in split.names if n not in seen or n not in split.inner)
    return (
        (f"hidden nodes can be sampled, and {inner} integrated out given the others",)
        if inner
        else ()
    )


def endless_sums(engine: Any, problem: SeriesProblem) -> tuple[str, ...]:
    """Computed nodes that keep trajectories from being drawn backwards: none that is integrated out."""
    split = split_of_problem(asking(engine, PAST[0]), problem)
    if split is not None and why_not_backwards(problem.slices, split) is None:
        return ()
    return endless(problem.slices, problem.seen)


def back(engine: Any, problem: SeriesProblem, asked: Asked) -> str:
    """How smoothing is done, where something is integrated out."""
    split = split_of_problem(asking(engine, asked.what), problem)
    if split is None or asked.what not in PAST:
        return ""
    own = " and ".join(
        ["a Kalman smoother"] * bool(split.inner) + ["smoothed tables"] * (split.tables is not None)
    )
    if asked.what == "fixed-lag":
        return f"{own} along the ancestors of each particle"
    why = why_not_backwards(problem.slices, split)
    if why is None:
        return f"paths of what is sampled drawn backwards, {own} along each"
    return f"trajectories of all nodes drawn backwards: nothing stays integrated out, as {why}"


def told(engine: Any, problem: SeriesProblem, treated: Mapping[str, str]) -> dict[str, str]:
    """What is done to each node, given what plain particles do to it."""
    found, slices = dict(treated), problem.slices
    if engine.marginalize is None:
        return found
    split = _whole(engine, slices, problem.known_static, problem.seen)
    if not split.names:
        return found | {n: f"{found[n]}; not integrated out: {w}" for n, w in split.why.items()}
    each = "a Kalman filter for each particle"
    if engine.proposal != "optimal" and not plates_apart(slices) and blocks_of(slices, split):
        each += f" and element of {' and '.join(map(repr, blocks_of(slices, split)))}"
    elements = elements_asked(engine, slices, split)
    if elements is not None:
        lead = " and ".join(map(repr, elements.plates))
        how = "where it is read" if elements.still else "all of which move"
        each = f"a Kalman filter for each particle and element of {lead}, {how}"
    for name in slices.dynamic:
        if name in split.inner:
            found[name] = f"integrated out, {each}"
            if name in problem.series.observed:
                found[name] = f"{_SEEN}; integrated out where it is missing"
        elif name in split.below:
            found[name] = _SEEN
        else:
            drawn = name in slices.stochastic and name not in problem.seen
            if drawn and elements is not None:
                found[name] = drawn_by_element(engine, slices, split, elements, name, found[name])
            elif drawn and engine.proposal == "optimal":
                found[name] = "sampled given the slice before and the row"
            if name in split.why:
                found[name] += f"; not integrated out: {split.why[name]}"
    for name in split.linearised:
        found[name] += f"; {_BENT}"
    if split.tables is not None:
        found |= tables_told(split.tables, problem)
    return found


def effort_told(engine: Any, problem: SeriesProblem) -> str:
    """What a slice takes, and what of it is an approximation, where something is integrated out."""
    split = split_of_problem(engine, problem)
    assert split is not None
    parts = ["a Kalman filter"] * bool(split.inner) + ["tables"] * (split.tables is not None)
    each = f"{' and '.join(parts)} for each particle"
    if not split.linearised:
        return each
    names = ", ".join(repr(n) for n in problem.slices.dynamic if n in split.linearised)
    return f"{each}; the log marginal likelihood is an approximation of unknown error ({names} linearised)"


# ---- private ------------------------------------------------------------------------------------


def _joint_tangents(engine: Any, slices: Slices, split: Split, what: str) -> str | None:
    """Why slices that lie back are not asked about where elements are made linear one by one, or None."""
    elements = elements_asked(engine, slices, split)
    if elements is None or not any(g.bent for groups in elements.groups for g in groups):
        return None
    name = elements.states[0]
    count = math.prod(slices.first[name].plate_shape)
    asked = {"smooth": "smoothing", "fixed-lag": "lag="}.get(what, what)
    return (
        f"ParticleFilter: {asked} would make all {count} elements of {name!r} linear together, at the "
        "mean of their prior, and not each where its readings place it, as filter does; where that prior is "
        "vague they would be placed anywhere. Ask filter without delay=, follow belief.ancestors for the way "
        "that was taken, or give marginalize=None"
    )


def _whole(
    engine: Any, slices: Slices, static: Mapping[str, np.ndarray], seen: Collection[str]
) -> Split:
    """What is integrated out, though it be nothing."""
    known = frozenset(n for n in slices.stochastic if n in seen)
    what = "fixed-lag" if getattr(engine, "delay", None) else engine.question
    found = split_of(slices, known, engine.marginalize, static)
    why = _why_untabled(slices, found, what)
    return found if why is None else split_of(slices, known, engine.marginalize, static, why)


def _why_untabled(slices: Slices, split: Split, what: str) -> str | None:
    """Why what is asked about the past is not answered from tables, or None."""
    if split.tables is None or what not in PAST:
        return None
    if what == "smooth":
        return why_not_backwards(slices, split)
    late = split.waiting - frozenset(split.names)
    if not late:
        return None
    name = next(n for n in slices.dynamic if n in late)
    return (
        f"{name!r} is computed from them, or missing, and what a particle has of it was drawn before later "
        "rows came"
    )
