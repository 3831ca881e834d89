"""A manoeuvring target seen by a radar: straight on, or turning left or right, and which of them nobody says.

    mode_t ~ table[mode_{t-1}]                                      (km and scans throughout)
    position_t ~ N(position_{t-1} + G[mode_t] speed_{t-1}, .01),    speed_t ~ N(R[mode_t] speed_{t-1}, .02)
    range_t ~ N(|position_t|, .1),    bearing_t ~ WrappedNormal(atan2(position_t), .01),
    doppler_t ~ N(speed_t . position_t / |position_t|, .02)         where the radar has it

Who answers, and what each of them approximates:

- ``SwitchingKalmanFilter`` (GPB1, IMM, GPB2) keeps one Gaussian for each mode, whose readings are linearised
  where it stands (``linearize=True``), and merges; its smoother is Kim's;
- ``ExpectationPropagation``, smoothed, passes messages between these Gaussians until they agree;
- an extended Kalman filter takes the target to fly straight on, pushed about by more noise;
- marginalised particles draw modes, and each has a Kalman filter. Its readings could be linearised by name,
  too; here those of a scan are converted to a position with the covariance that a reading there has (Lerro
  and Bar-Shalom), which is the approximation; Doppler is left out;
- particles that draw everything approximate nothing but by chance.

The bearing is an angle: the target crosses the west, where it jumps by a full turn, and innovations count
the short way round. Densities of converted readings are multiplied by the range, to be of the same readings.

Bar-Shalom, Li and Kirubarajan (2001), Estimation with Applications to Tracking and Navigation, sec. 10.4.3
(converted measurements), 11.6 and 11.7 (IMM, coordinated turns).
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

import bayesmc as bmc
from bayesmc.errors import ConvergenceWarning, LowEssWarning
from examples import picture

MODES = ("straight", "left", "right")
FOLLOW = np.array([[0.94, 0.03, 0.03], [0.08, 0.92, 0.0], [0.08, 0.0, 0.92]])
TURN = 0.25  # radians per scan
SCANS, RUNS, SHOWN, SWEEPS = 100, 6, 29, 50
FAR, ASIDE, ALONG = 0.1, 0.01, 0.02  # noise of range, bearing and Doppler
JOLT, PUSH, PUSHED = 0.01, 0.02, 0.1  # of positions, of speeds, and of speeds without modes
BOTH = np.eye(2)
START = (
    bmc.MvNormal(np.array([-25.0, 3.0]), BOTH),
    bmc.MvNormal(np.array([0.0, -0.3]), 0.04 * BOTH),
)


def turning(rate: float) -> tuple[np.ndarray, np.ndarray]:
    """How far a speed leads in a scan, and the speed after it, turning by so many radians."""
    s, c = (1.0, 0.0) if rate == 0.0 else (np.sin(rate) / rate, (1.0 - np.cos(rate)) / rate)
    after = [[np.cos(rate), -np.sin(rate)], [np.sin(rate), np.cos(rate)]]
    return np.array([[s, -c], [c, s]]), np.array(after)


GONE, TURNED = (np.stack(parts) for parts in zip(*map(turning, (0.0, TURN, -TURN)), strict=True))


def target(modes: bool = True) -> bmc.DynamicBayesNet:
    """A target that flies straight on, or turns; without modes, one that is pushed about."""
    dbn = bmc.DynamicBayesNet("manoeuvring target")
    if not modes:
        dbn.add(
            "position",
            lambda position_prev, speed_prev: bmc.MvNormal(
                position_prev + speed_prev, JOLT**2 * BOTH
            ),
            initial=START[0],
        )
        dbn.add(
            "speed", lambda speed_prev: bmc.MvNormal(speed_prev, PUSHED**2 * BOTH), initial=START[1]
        )
        return dbn
    dbn.table("mode", ["mode_prev"], FOLLOW, MODES, initial=[1.0, 0.0, 0.0])

    @dbn.node(initial=START[0])
    def position(position_prev, speed_prev, mode):
        return bmc.MvNormal(position_prev + np.matvec(GONE[mode], speed_prev), JOLT**2 * BOTH)

    @dbn.node(initial=START[1])
    def speed(speed_prev, mode):
        return bmc.MvNormal(np.matvec(TURNED[mode], speed_prev), PUSH**2 * BOTH)

    return dbn


def radar(dbn: bmc.DynamicBayesNet, doppler: bool = False) -> bmc.DynamicBayesNet:
    """What is read of the target."""

    @dbn.node
    def range(position):  # noqa: A001
        return bmc.Normal(np.hypot(position[..., 0], position[..., 1]), FAR)

    @dbn.node
    def bearing(position):
        return bmc.WrappedNormal(np.arctan2(position[..., 1], position[..., 0]), ASIDE)

    if doppler:

        @dbn.node
        def doppler(position, speed):
            away = np.hypot(position[..., 0], position[..., 1])
            return bmc.Normal(np.vecdot(position, speed) / away, ALONG)

    return dbn


def converting() -> bmc.DynamicBayesNet:
    """The target with readings as positions, whose noise is an input."""
    dbn = target()
    dbn.input("noise", event_shape=(2, 2))
    dbn.add("fix", lambda position, noise: bmc.MvNormal(position, noise))
    return dbn


def converted(rows: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Ranges and bearings as positions, and the covariances of these."""
    r, b = rows["range"], rows["bearing"]
    cos, sin = np.cos(b), np.sin(b)
    aside = np.stack([-r * sin, r * cos], axis=-1)
    along = np.stack([cos, sin], axis=-1)
    noise = FAR**2 * _outer(along) + ASIDE**2 * _outer(aside)
    return {"fix": np.stack([r * cos, r * sin], axis=-1)}, {"noise": noise}


def _outer(v: np.ndarray) -> np.ndarray:
    return v[..., :, None] * v[..., None, :]


class Score(NamedTuple):
    """How an engine did in one run.

    Attributes
    ----------
    miss : float
        Root mean square of the distance from the true position, in m.
    right : float
        Share of scans whose most probable mode is the true one; nan without modes.
    log : float
        Log evidence of ranges and bearings, and of Doppler.
    seconds : float
        Of processor time.
    settled : float
        Whether messages agree, where there are any.
    """

    miss: float
    right: float
    log: float
    seconds: float
    settled: float


def engines(particles: int, doppler: bool, sweeps: int = SWEEPS) -> dict[str, tuple[Any, Any, Any]]:
    """What is asked, the template and the engine by name."""
    seen = radar(target(), doppler)
    rules: dict[str, Any] = {
        r: bmc.SwitchingKalmanFilter(r, linearize=True) for r in ("gpb1", "imm", "gpb2")
    }
    found = {rule.upper(): (bmc.filter, seen, engine) for rule, engine in rules.items()}
    if not doppler:
        engine = bmc.ParticleFilter(particles // 10, marginalize="auto", proposal="optimal")
        found[f"{particles // 10} marginalised, converted"] = bmc.filter, converting(), engine
    found[f"{particles} particles"] = bmc.filter, seen, bmc.ParticleFilter(particles)
    found["EKF, straight on"] = (
        bmc.filter,
        radar(target(False), doppler),
        bmc.ExtendedKalmanFilter(),
    )
    found["GPB2 and Kim, smoothed"] = bmc.smooth, seen, rules["gpb2"]
    found["EP, smoothed"] = (
        bmc.smooth,
        seen,
        bmc.ExpectationPropagation(sweeps, tolerance=1e-3, linearize=True),
    )
    return found


def simulated(
    seed: int, doppler: bool = False
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """What was, and what was seen."""
    drawn = {n: v[0] for n, v in radar(target(), doppler).sample(SCANS, rng=seed).items()}
    return drawn, {n: drawn[n] for n in ("range", "bearing", "doppler") if n in drawn}


def answered(
    asked: tuple[Any, Any, Any],
    truth: dict[str, np.ndarray],
    rows: dict[str, np.ndarray],
    seed: int,
) -> tuple[Any, Score]:
    """A belief and how good it is."""
    ask, dbn, engine = asked
    begun = time.process_time()
    is_converted = "fix" in dbn.graph
    seen, inputs = converted(rows) if is_converted else (rows, None)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", (ConvergenceWarning, LowEssWarning))  # seen in the table
        belief = ask(dbn, seen, inputs=inputs, engine=engine, rng=seed)
    took = time.process_time() - begun
    off = belief.mean("position") - truth["position"]
    right = np.nan
    if "mode" in belief.names:
        right = float((belief.probabilities("mode").argmax(axis=1) == truth["mode"]).mean())
    log = float(belief.log_marginal_likelihood)
    if is_converted:
        log += float(np.log(rows["range"]).sum())
    miss = 1000 * float(np.sqrt((off**2).sum(axis=-1).mean()))
    return belief, Score(miss, right, log, took, float(getattr(belief, "converged", True)))


def table(
    runs: int, particles: int, doppler: bool = False, sweeps: int = SWEEPS
) -> dict[str, Score]:
    """Means over runs, by engine."""
    found: dict[str, list[Score]] = {}
    for seed in np.arange(runs).tolist():
        truth, seen = simulated(seed, doppler)
        for name, asked in engines(particles, doppler, sweeps).items():
            found.setdefault(name, []).append(answered(asked, truth, seen, seed)[1])
    return {name: Score(*np.mean(scores, axis=0)) for name, scores in found.items()}


def report(found: dict[str, Score], runs: int, what: str) -> None:
    """Print the table."""
    print(
        f"{what}, {runs} runs of {SCANS} scans     miss, m   modes right   log evidence   ms a scan"
    )
    for name, score in found.items():
        share = "        " if np.isnan(score.right) else f"{100 * score.right:6.1f} %"
        each = 1000 * score.seconds / SCANS
        note = "" if score.settled == 1 else f"  settled in {score.settled:.0%} of the runs"
        print(f"  {name:<36}{score.miss:12.0f}   {share}   {score.log:12.2f}{each:12.1f}{note}")


def draw(seed: int, particles: int, sweeps: int = SWEEPS) -> Any:
    """One flight: its path, and its modes, filtered and smoothed."""
    truth, seen = simulated(seed)
    asked = engines(particles, False, sweeps)
    marginalised = next(name for name in asked if "marginalised" in name)
    shown = {"GPB2": picture.DRAWS, marginalised: picture.FAINT, "EP, smoothed": picture.OTHER}
    beliefs = {name: answered(asked[name], truth, seen, seed)[0] for name in shown}
    figure, panels = picture.axes(
        [["path", "GPB2"], ["path", marginalised], ["miss", "EP, smoothed"]], (12, 8.5),
        height_ratios=[1, 1, 1],
    )  # fmt: skip
    ax, scans = panels["path"], np.arange(SCANS)
    r, b = seen["range"], seen["bearing"]
    ax.plot(r * np.cos(b), r * np.sin(b), ".", color=picture.FAINT, label="radar")
    ax.plot(*truth["position"].T, color=picture.EXACT, lw=2.5, label="target")
    for name, colour in shown.items():
        ax.plot(*beliefs[name].mean("position").T, color=colour, label=name)
        off = np.hypot(*(beliefs[name].mean("position") - truth["position"]).T)
        panels["miss"].plot(scans, 1000 * off, color=colour)
    ax.set(xlabel="east of the radar, km", ylabel="north, km", title="a flight", aspect="equal")
    ax.legend(frameon=False, fontsize=9, loc="lower left")
    panels["miss"].set(
        xlabel="scan", ylabel="m", title="distance from the target", xlim=(0, SCANS - 1)
    )
    colours = (picture.FAINT, picture.DRAWS, picture.OTHER)
    for name, belief in beliefs.items():
        ax = panels[name]
        ax.stackplot(scans, belief.probabilities("mode").T, colors=colours, alpha=0.6, labels=MODES)
        for k, colour in enumerate(colours):
            here = truth["mode"] == k
            ax.plot(scans[here], np.full(here.sum(), 1.06), "s", ms=4, color=colour, clip_on=False)
        ax.set(xlim=(0, SCANS - 1), ylim=(0, 1.1), ylabel="probability", title=f"modes: {name}")
    panels["EP, smoothed"].set(xlabel="scan (squares above: what was)")
    panels["GPB2"].legend(loc="lower right", fontsize=9)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Print tables, and draw one flight."""
    options = picture.options(__doc__, arguments)
    runs, particles, sweeps = (1, 500, 1) if options.fast else (RUNS, 5000, SWEEPS)
    for doppler, what in ((False, "range and bearing"), (True, "and Doppler")):
        if not (doppler and options.fast):
            report(table(runs, particles, doppler, sweeps), runs, what)
    picture.save(draw(SHOWN, particles, sweeps), options.out, "radar_target")


if __name__ == "__main__":
    main()
