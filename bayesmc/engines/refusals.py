"""What engines over time refuse of a template, whatever the family: unknown static nodes, and nodes of
objects.

A particle carries its objects along, whatever they are; everything else that engines do is done with numbers.
"""

from __future__ import annotations

from typing import Any

from bayesmc.dbn import SeriesProblem
from bayesmc.errors import UnsupportedError


def common_refusal(engine: Any, problem: SeriesProblem) -> str | None:
    """What engines over time do not take: static nodes of unknown value, and objects."""
    if why := not_numbers(engine, problem):
        return why
    if not problem.unknown_static:
        return None
    names = ", ".join(map(repr, problem.unknown_static))
    known = "infers static nodes" if isinstance(engine, str) else "takes static nodes as known"
    who = engine if isinstance(engine, str) else type(engine).__name__
    return (
        f"{who} {known}, and {names} is not observed; observe it (its value in observations=), or infer it "
        "with the trajectory: infer(dbn, observations), by itself or with engine=ParticleGibbs(draws), "
        "ParticleMetropolis(draws) or another static engine"
    )


def not_numbers(engine: Any, problem: SeriesProblem) -> str | None:
    """Why an engine that computes with numbers does not take a template with objects, or None."""
    objects = problem.objects
    if not objects or getattr(engine, "keeps", False):  # it has particles
        return None
    who = engine if isinstance(engine, str) else type(engine).__name__
    return (
        f"{who} computes with numbers, and node {objects[0]!r} holds objects; "
        "take ParticleFilter(particles)"
    )


def not_with_objects(engine: Any, problem: SeriesProblem) -> str | None:
    """Why a particle filter with these options does not take a template with objects, or None."""
    objects = problem.objects
    if not objects:
        return None
    name = objects[0]
    if engine.particles is None:
        return (
            f"ParticleFilter: nobody can tell beforehand what an object of node {name!r} takes, so "
            "how many particles there are is not chosen by itself; say how many, such as "
            "ParticleFilter(30)"
        )
    if engine.auxiliary is True or isinstance(engine.proposal, str):
        option = "auxiliary=True" if engine.auxiliary is True else 'proposal="optimal"'
        return (
            f"ParticleFilter: {option} reads densities, and those that depend on the objects of "
            f"{name!r} cannot be read; give a function"
        )
    if engine.recovery is not None or engine.rejuvenation is not None:
        option = "recovery=" if engine.recovery is not None else "rejuvenation="
        return (
            f"ParticleFilter: {option} draws numbers anew, and what the objects of {name!r} would be "
            "then is not known; leave it out"
        )
    if engine.marginalize is not None:
        return (
            f"ParticleFilter: marginalize= carries distributions of numbers along, and {name!r} holds "
            "objects; leave it "
            "out (an object may hold what a particle knows of something else)"
        )
    return None


def no_past_of_objects(
    problem: SeriesProblem, what: str, keep: str | None, delay: int | None
) -> str | None:
    """Why slices that are past, or ahead, are not answered for where nodes hold objects, or None.

    The past would hold the objects of all slices; and a path that is drawn backwards has no object of
    its own.
    """
    objects = problem.objects
    if not objects or (what == "filter" and keep is None and delay is None):
        return None
    if what == "forecast":
        return (
            f"ParticleFilter does not forecast with {objects[0]!r}, which holds objects; go on by step, "
            "with rows in which "
            "nothing is seen"
        )
    asked = "keep=" if keep is not None else "delay=" if delay is not None else "smooth"
    return (
        f"ParticleFilter: {asked} is for numbers, and {objects[0]!r} holds objects, which are kept of "
        "the last slice alone; "
        "filter, or go row by row with start and step and put aside what is wanted of each belief"
    )


def check_keep(problem: SeriesProblem, keep: str | None, delay: int | None) -> None:
    """Refuse what is to be kept of all slices where it cannot be.

    Raises
    ------
    ValueError, UnsupportedError
    """
    if keep not in (None, "particles"):
        raise ValueError(f'keep={keep!r}: give "particles", or None for answers of constant size')
    why = no_past_of_objects(problem, "filter", keep, delay)
    if why is not None:
        raise UnsupportedError(why)
