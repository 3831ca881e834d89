"""How many particles are enough, at which price, and what is said where they were not."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from bayesmc.dbn.slices import Slices
from bayesmc.engines.particles.record import FilteredParticles
from bayesmc.errors import LowEssWarning

#: particles of a filter that is not told how many, at least, and at most
START, MOST = 1000, 100_000
#: those of the first short run; each next one has four times as many
FIRST, TIMES = 250, 4
#: error of the log evidence that is aimed at
TOLERANCE = 0.5
#: particles times slices that a run may take, and those whose particles are kept
BUDGET, KEPT = 30_000_000, 5_000_000
#: what a particle that looks at the row costs, in particles that do not: 4 where what is seen is affine in
#: what is hidden, 19 for Poisson counts; measured once, so that the same call gives the same answer anywhere
GUIDED = 20
#: numbers that a particle carries that cost as much as a draw
CARRIED = 2.0
#: error of a short run up to which it says how many particles are enough; beyond it is no longer normal
TRUSTED = 1.5
#: variance that is aimed at, as a share of the tolerance's
AIM = 0.6
#: error of a state's mean, in its standard deviations, that is aimed at, and the slices that keep it:
#: spreads are then off by some 7 %
STATE, SLICES = 0.1, 0.9
#: and the one up to which a short run says how many particles are enough
STATE_TRUSTED = 0.5
#: the one above which a warning says so
STATE_LARGE = 0.5
#: error of the log evidence above which a warning says so
LARGE = 1.0
#: the same where the number of particles is given
LARGE_GIVEN = 3.0
#: slices that rest on a single particle which are no accident any more, and their share of all
SEVERAL, OFTEN = 3, 0.005
#: equally weighted particles below which a slice rests on a single one
COLLAPSED = 2.0
#: and those below which a slice is named as one that is hard to explain
FEW = 30.0
#: share of such slices from which on a warning says so
MANY = 0.1


class Errors(NamedTuple):
    """Of a short run: of the log evidence, and of the states' means in their standard deviations."""

    evidence: float = math.inf
    states: float = math.inf


def enough(
    tried: Callable[[int, int], Errors], tolerance: float, slices: int, budget: int, keep: bool
) -> int:
    """Particles with which the errors of log evidence and states are likely to be as small as is asked.

    Parameters
    ----------
    tried : callable
        ``(particles, unit) -> errors`` of a run with a random stream of its own.
    tolerance : float
    slices : int
        Times the elements of plates that are filtered separately, and the price of a particle.
    budget : int
        Particles times slices.
    keep : bool
        Whether particles of all slices are held, which takes memory.

    Returns
    -------
    int
        A power of two times ``START``, or the most that the budget allows; ``START`` at least. The answer is
        that of a run of its own, so what chose the number has no part in it, and the evidence is unbiased.
    """
    most = affordable(slices, budget, keep)
    particles, unit = FIRST, 1
    while particles < most:
        errors = tried(particles, unit)
        if errors.evidence <= TRUSTED and errors.states <= STATE_TRUSTED:
            times = max(errors.evidence / tolerance, errors.states / STATE)
            wanted = particles * times**2 / AIM
            doublings = math.ceil(math.log2(max(wanted / START, 1.0)))
            return min(START * 2**doublings, most)
        particles, unit = particles * TIMES, unit + 1
    return most


def of_states(found: FilteredParticles, slices: Slices) -> dict[str, float]:
    """By node, the error of its mean in standard deviations: what nine tenths of the slices keep.

    Of a vector the worst number counts. States of finite nodes are told in parts of a half, which is the most
    that an indicator spreads by. Nodes without noise follow from others, or stay, and are left out.
    """
    assert found.mean_errors is not None
    by_name = {}
    for name, errors in found.mean_errors.items():
        node = slices.later[name]
        if node.noiseless or not node.is_stochastic or not errors.size:
            continue
        if node.domain is None:
            spread = found.std(name)
        elif node.domain.labels is None:
            spread = np.full(1, 0.5 * np.ptp(np.asarray(node.domain.numbers, dtype=float)))
        else:
            spread = np.full(1, 0.5)
        with np.errstate(divide="ignore", invalid="ignore"):
            off = np.where(errors > 0, errors / spread, 0.0)
        labelled = node.domain is not None and node.domain.labels is not None
        numbers = off.shape[-1] if labelled else math.prod(node.event_shape)
        ranked = np.sort(off.reshape(-1, numbers), axis=0)
        by_name[name] = float(ranked[math.ceil(SLICES * len(ranked)) - 1].max())
    return by_name


def errors_of(found: FilteredParticles, slices: Slices) -> Errors:
    """Those of a run: the worst of all series, and of all nodes."""
    states = max(of_states(found, slices).values(), default=0.0)
    return Errors(float(np.max(found.log_marginal_likelihood_mcse)), states)


def price(engine: Any, carried: float = 0.0) -> int:
    """What a particle of a slice costs, in draws from its own density.

    ``carried`` are numbers that it carries of what is integrated out.
    """
    guided = isinstance(engine.proposal, str) or engine.auxiliary is True
    return (GUIDED if guided else 1) * (1 + math.ceil(carried / CARRIED))


def affordable(slices: int, budget: int, keep: bool) -> int:
    """The most particles that are tried where nobody says how many."""
    share = min(budget, KEPT) if keep else budget
    return max(START, min(MOST, share // max(slices, 1)))


def collapsed(filtered: FilteredParticles, engine: Any) -> str | None:
    """What is said where many slices rest on what is little more than one particle.

    A surprising row now and then does that to any filter, and the next rows mend it.
    """
    assert filtered.weight_ess is not None and filtered.counts is not None
    ess = filtered.weight_ess.reshape(filtered.steps, -1)
    most = int(filtered.counts.max())
    poor = ess < min(COLLAPSED, 0.9 * most)
    share = poor.mean(axis=0)
    worst = int(share.argmax())
    if share[worst] <= MANY:
        return None
    own = ess[:, worst]
    at = int(own.argmin())
    return (
        f"in {int(poor[:, worst].sum())} of {len(own)} slices the {most} particles are worth less than "
        f"{COLLAPSED:g} equally weighted ones (weight_ess; {own[at]:.1f} in slice {filtered.start + at}), so "
        f"means, spreads and the evidence rest on one of them: use more particles, {_looking(engine)}or less "
        "narrow noise"
    )


def unsteady(
    found: FilteredParticles, slices: Slices, engine: Any, carried: float = 0.0
) -> str | None:
    """What is said where means of states are off by much of their own spread, or nobody can tell.

    A number of particles that is given is taken as meant: few do for many a purpose.
    """
    assert found.counts is not None
    if engine.particles is not None:
        return None
    errors = of_states(found, slices)
    name = max(errors, key=errors.__getitem__, default="")
    if not name or not errors[name] >= STATE_LARGE:
        return None
    if math.isinf(errors[name]):
        said = f"cannot tell how far means of {name!r} are off (mcse is infinite)"
    else:
        said = f"leave means of {name!r} off by {errors[name]:.1f} of its standard deviation (mcse)"
    return (
        f"{int(found.counts.max())} particles {said} in a tenth of the slices or more, and its spread may be "
        f"as far off; use {_more(found, engine, carried)}, {_looking(engine)}or a model in which single rows "
        "say less"
    )


def uncertain(filtered: FilteredParticles, engine: Any, carried: float = 0.0) -> str | None:
    """What is said where the log evidence is not known well.

    Who gives a number of particles may ask for states alone, which few may follow well: then it takes a
    larger error; or a first row that next to no particle explains, since what is missing there is never found
    again, or several rows of that kind.
    """
    assert filtered.counts is not None and filtered.weight_ess is not None
    given = engine.particles is not None
    errors = np.atleast_1d(np.asarray(filtered.log_marginal_likelihood_mcse, dtype=float))
    worst = float(errors.max())
    if not worst > (LARGE_GIVEN if given else LARGE):
        return None
    ess = filtered.weight_ess.reshape(filtered.steps, -1)[:, int(errors.reshape(-1).argmax())]
    at = int(ess.argmin())
    if math.isinf(worst):
        weighed = np.flatnonzero(ess < 0.999 * filtered.counts)
        if given:
            at = int(weighed[0]) if len(weighed) else at
            single = np.count_nonzero(ess < COLLAPSED)
            if ess[at] >= COLLAPSED and single < max(SEVERAL, OFTEN * len(ess)):
                return None
            at = at if ess[at] < COLLAPSED else int(ess.argmin())
        said = "cannot tell how far their log evidence is off (log_marginal_likelihood_mcse is infinite)"
    else:
        said = f"leave an error of {worst:.1f} in the log evidence (log_marginal_likelihood_mcse)"
    why = (
        f"weight_ess is {ess[at]:.1f} in slice {filtered.start + at}"
        if ess[at] < FEW
        else "particles that later rows ask for were rare among those of earlier slices"
    )
    return (
        f"{int(filtered.counts.max())} particles {said}, and figures after rows that are hard to explain may "
        f"be off as well ({why}); use {_more(filtered, engine, carried)}, {_looking(engine)}or a model to "
        "which such rows are less of a surprise"
    )


def warn_of_errors(
    filtered: FilteredParticles,
    found: FilteredParticles,
    slices: Slices,
    engine: Any,
    carried: float = 0.0,
) -> None:
    """At most one warning: that slices rest on one particle, or that evidence or states are not known well.

    ``found`` is the answer, if it is not the filter's own; ``carried`` is what ``price`` takes.
    """
    text = (
        collapsed(filtered, engine)
        or uncertain(filtered, engine, carried)
        or unsteady(found, slices, engine, carried)
    )
    if text is not None:
        warnings.warn(f"ParticleFilter: {text}", LowEssWarning, stacklevel=4)


# ---- private ------------------------------------------------------------------------------------


def _looking(engine: Any) -> str:
    """How to have particles drawn with a look at the observations, where they are not."""
    if engine.proposal is None:
        return "a proposal= that looks at the observations, "
    return "" if engine.auxiliary else "auxiliary=True, "


def _more(filtered: FilteredParticles, engine: Any, carried: float) -> str:
    """How to have more particles, by what set their number."""
    assert filtered.counts is not None
    if engine.particles is not None or engine.adapt is not None:
        return "more particles"
    count, keep = int(filtered.counts.max()), filtered.held is not None
    if count >= MOST:
        return (
            f"more particles than the {MOST:_} that are tried at most, such as "
            f"ParticleFilter({4 * MOST:_})"
        )
    assert filtered.log_marginal_increments is not None
    slices = math.prod(filtered.log_marginal_increments.shape) * price(engine, carried)
    if count < affordable(slices, engine.budget, keep):
        return (
            f"a number of your own, such as ParticleFilter({4 * count:_}) (short runs found {count:_} "
            "enough)"
        )
    if keep and engine.budget > KEPT:
        return "more particles, whose number is held down where all slices are kept (smooth, keep=)"
    return f"a larger budget= than {engine.budget:_}"
