"""The kidnapped robot: it knows where it is, is carried off, and has to find out that it is somewhere else.

A log is cut in two and the second part begins more than ten metres away; the wheels say that nothing
happened. A particle filter has no particle where the robot is now, and stays with whatever looks least
unlike what it sees. ``ParticleFilter(recovery=...)`` gives it a few that begin anew, anywhere in free
space:

    never            the filter as it is
    always 5 %       in every slice one particle in twenty begins anew: a mixture of two transitions
    when surprised   as many as two running averages of the rows' densities ask for, one minus fast over slow:
                     many when the robot does not see what it expects (augmented Monte Carlo localization),
                     and some wherever it comes to a place that the map explains less well than the last
    where it looks   one in twenty is drawn from where the scan says the robot could be, though only one scan
                     in a hundred is thought to follow on a carriage: weights make up for both (the dual of
                     Monte Carlo localization)

The picture shows the error over time of all, the share that begins anew, and where the particles are
before and after. A robot has found itself when its error is below half a metre and stays so for twenty
scans.

Thrun, Burgard and Fox (2005), Probabilistic Robotics, section 8.3.5 and table 8.3; Gutmann and Fox (2002),
An experimental comparison of localization methods continued, IROS; Thrun, Fox, Burgard and Dellaert (2001),
Robust Monte Carlo localization for mobile robots, Artificial Intelligence 128.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

import bayesmc as bmc
from examples import picture, robot_logs
from examples.robot_logs import Log

SEED, PARTICLES = 1, 10_000
AT, TO = 70, 150  # of the made-up log: cut after the first so many scans, on from this one
RATES = (0.1, 0.8)  # slow and fast
DOTS = 2_000
GOLD = "#e0a030"
LATER = (-1, 10, 40)  # scans after the robot was carried off, at which particles are drawn


class Run(NamedTuple):
    """A filter's way through the spliced log.

    Attributes
    ----------
    error : ndarray, shape (time,)
        In m.
    anew : ndarray, shape (time,)
        Share of the particles that began anew.
    clouds : dict of int to ndarray, shape (dots, 3)
        Some particles of the slices ``LATER``.
    """

    error: np.ndarray
    anew: np.ndarray
    clouds: dict[int, np.ndarray]


def recoveries(log: Log) -> dict[str, bmc.Recovery | None]:
    """What is compared."""
    anywhere = {"pose": log.floor}
    slow, fast = RATES
    return {
        "never": None,
        "always 5 %": bmc.Recovery(anywhere, share=0.05),
        "when surprised": bmc.Recovery(anywhere, slow=slow, fast=fast),
        "where it looks": robot_logs.looking(log),
    }


def run(log: Log, recovery: bmc.Recovery | None, at: int, particles: int, rng: int = SEED) -> Run:
    """From a known start through the log, with some slices' particles put aside."""
    dbn = robot_logs.model(log, robot_logs.near(log), log.caution)
    engine = bmc.ParticleFilter(particles, recovery=recovery)
    found = robot_logs.localized(dbn, log, engine, rng, keep="particles")
    pick = np.random.default_rng(rng)
    clouds = {}
    for k in LATER:  # by their weights, so that every dot counts the same
        chosen = pick.choice(particles, DOTS, p=found.weights[at + k])
        clouds[k] = found.particles("pose")[at + k, chosen]
    return Run(robot_logs.errors(log, found.mean("pose")), found.anew / particles, clouds)


def report(found: dict[str, Run], at: int) -> None:
    """Print when each has found back."""
    print(
        f"  {'begins anew':16}{'error before':>13}{'found again after':>20}{'error at the end':>18}"
    )
    for name, each in found.items():
        back = robot_logs.recovery_time(each.error, at)
        when = "never" if back is None else f"{back} scans"
        before, after = np.median(each.error[:at]), np.median(each.error[-robot_logs.HELD :])
        print(f"  {name:16}{before:11.2f} m{when:>20}{after:16.2f} m")


def draw(log: Log, found: dict[str, Run], at: int) -> Any:
    """Error and share over time; the particles of the last one, before and after."""
    clouds = [f"cloud {k}" for k in LATER]
    figure, panels = picture.axes(
        [["error"] * 3, ["share"] * 3, clouds], (13, 10.5), height_ratios=[1.5, 0.8, 1.5]
    )
    colours = dict(zip(found, (picture.FAINT, picture.DRAWS, GOLD, picture.EXACT), strict=True))
    ax, share = panels["error"], panels["share"]
    for name, each in found.items():
        back = robot_logs.recovery_time(each.error, at)
        label = f"{name}: " + ("not found" if back is None else f"found after {back} scans")
        ax.semilogy(each.error, color=colours[name], lw=1.8, label=label)
        share.plot(100 * each.anew, color=colours[name], lw=1.5)
    ax.axhline(robot_logs.FOUND, color=picture.OTHER, lw=0.8, ls=":")
    for panel in (ax, share):
        panel.axvline(at - 0.5, color=picture.OTHER, lw=1.2)
        panel.set_xlim(0, len(log.scans) - 1)
    ax.set(ylabel="error [m]", title="error of the mean; the robot is carried off at the line")
    ax.legend(frameon=False, loc="upper left")
    share.set(xlabel="scans", ylabel="begin anew [%]")
    last = list(found)[-1]
    for k, name in zip(LATER, clouds, strict=True):
        robot_logs.draw_map(panels[name], log)
        assert log.truth is not None
        robot_logs.draw_cloud(panels[name], found[last].clouds[k], log.truth[at + k])
        when = "the scan before" if k == -1 else f"{k} scans after"
        panels[name].set_title(f"{last}: {when}")
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Carry the robot off, and see which filters notice."""
    options = picture.options(__doc__, arguments)
    whole = robot_logs.generated()
    log = robot_logs.spliced(whole, AT, TO, 60 if options.fast else None)
    assert whole.truth is not None
    far = np.hypot(*(whole.truth[TO] - whole.truth[AT - 1])[:2])
    particles = PARTICLES // 10 if options.fast else PARTICLES
    print(f"{log.name}: carried off after {AT} scans, {far:.0f} m away; {particles:,} particles")
    found = {name: run(log, recovery, AT, particles) for name, recovery in recoveries(log).items()}
    report(found, AT)
    picture.save(draw(log, found, AT), options.out, "kidnapped_robot")


if __name__ == "__main__":
    main()
