"""The same robot without its laser: a ring of sonars finds out where it is, too.

Twenty-four sonars around a robot hear four metres far, each the nearest thing in a cone of 20 degrees; of
their echoes one in eight comes too soon, one in six not at all, and one in ten says anything. Here beams
are followed through the map: the expected range is the shortest of three rays in the cone, looked up in a
table of cast rays (``RayTable``), and the density of a reading about it is the beam model with its four
causes. Its shares and its width are not taken from the script that made the world, but learned by EM from a
short drive at known poses (``fit_beams``).

Neighbouring cones share walls and errors, so that the product over 24 beams is tempered, by an exponent of
.05. A ring looks all round, which makes up for how little each sonar sees; what takes long is to tell places
apart that look alike within four metres.

Thrun, Burgard and Fox (2005), Probabilistic Robotics, section 6.3 (beam model; table 6.2: learning it) and
8.3; Fox, Burgard and Thrun (1999), Markov localization for mobile robots in dynamic environments, JAIR 11
(sonars).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.robotics import BeamFit, BeamModel, Beams, RayTable, fit_beams
from examples import laser_localization, picture, robot_logs
from examples.laser_localization import Run
from examples.robot_logs import Log

SEED, PARTICLES, LEAST, TEMPERING = 1, 10_000, 1_000, 0.05
CONE = np.deg2rad([-7.0, 0.0, 7.0])  # rays that stand for a cone
HEADINGS = 120  # of the table
LESSON = slice(60, 120)  # scans at known poses from which the beam model is learned


def expected(table: RayTable, log: Log, pose: Any) -> np.ndarray:
    """What perfect sonars would read from poses, shape (..., beams): the nearest thing in each cone."""
    rays = table.ranges(pose, (log.angles[:, None] + CONE).ravel())
    return rays.reshape(*rays.shape[:-1], len(log.angles), len(CONE)).min(axis=-1)


def learned(table: RayTable, log: Log, scans: slice = LESSON) -> BeamFit:
    """The beam model of these sonars, by EM from scans at known poses."""
    assert log.truth is not None
    start = BeamModel(max_range=log.reach, sigma_hit=0.3)
    return fit_beams(log.scans[scans], expected(table, log, log.truth[scans]), start)


def model(log: Log, start: Any, tempering: float = TEMPERING) -> bmc.DynamicBayesNet:
    """The net of ``robot_logs`` with beams on cast rays for a sensor."""
    table = RayTable(log.grid, log.reach, HEADINGS)
    beams = replace(learned(table, log).model, tempering=tempering)
    return robot_logs.net(log, start, lambda pose: Beams(expected(table, log, pose), beams))


def located(log: Log, particles: int = PARTICLES, rng: int = SEED) -> Run:
    """Global localisation by sonar, for the pictures."""
    dbn = model(log, log.floor)
    engine = robot_logs.adaptive(particles, LEAST)
    return laser_localization.run(dbn, log, engine, rng, laser_localization.SHOWN)


def report(log: Log, fit: BeamFit, found: Run) -> None:
    """Print what was learned, and what it came to."""
    parts = ", ".join(
        f"{name} {share:.2f}"
        for name, share in zip(("hit", "short", "max", "random"), fit.model.shares, strict=True)
    )
    print(
        f"Learned from {LESSON.stop - LESSON.start} scans: {parts}; sigma {fit.model.sigma_hit:.2f} m"
    )
    laser_localization.report(log, found)


def main(arguments: Sequence[str] | None = None) -> None:
    """Localise with a ring of sonars on the made-up floor."""
    options = picture.options(__doc__, arguments)
    log = robot_logs.generated("sonar", every=1)
    if options.fast:
        log = robot_logs.first(log, laser_localization.QUICK)
    print(f"Global localisation with {len(log.angles)} sonars on: {log.name}")
    found = located(log, PARTICLES // 4 if options.fast else PARTICLES)
    report(log, learned(RayTable(log.grid, log.reach, HEADINGS), log), found)
    picture.save(laser_localization.draw(log, found), options.out, "sonar_localization")


if __name__ == "__main__":
    main()
