"""A manoeuvring target seen by a radar: straight on, or turning left or right, and which of them nobody says.

    mode_t ~ table[mode_{t-1}],   x_t = F[mode_t] x_{t-1} + N(0, Q)   (positions in km, speeds in km per scan)
    range_t = |position_t| + N(0, 0.1),   bearing_t = atan2(position_t) + N(0, 0.01)

Given the modes this is an extended Kalman filter's. ``SwitchingKalmanFilter`` carries one Gaussian for each
mode, made linear where it stands; its three rules of merging are held against particles, which need no
straightening, and against an extended Kalman filter that takes the target to fly straight on, pushed about by
more noise. The smoother is Kim's.

Bar-Shalom, Li and Kirubarajan (2001), Estimation with Applications to Tracking and Navigation, sec. 11.6 and
11.7 (IMM, coordinated turns).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

import bayesmc as bmc
from examples import picture

MODES = ("straight", "left", "right")
FOLLOW = np.array([[0.94, 0.03, 0.03], [0.08, 0.92, 0.0], [0.08, 0.0, 0.92]])
TURN = 0.25  # radians per scan
SCANS, RUNS = 100, 20
START = bmc.MvNormal(np.array([25.0, 10.0, -0.3, 0.1]), np.diag([1.0, 1.0, 0.04, 0.04]))
PUSH = np.concatenate([0.5 * np.eye(2), np.eye(2)])
NOISE = 0.02**2 * PUSH @ PUSH.T + 1e-6 * np.eye(4)


def turning(rate: float) -> np.ndarray:
    """Positions and speeds a scan later, turning by so many radians."""
    s, c = (1.0, 0.0) if rate == 0.0 else (np.sin(rate) / rate, (1.0 - np.cos(rate)) / rate)
    found = np.eye(4)
    found[:2, 2:] = [[s, -c], [c, s]]
    found[2:, 2:] = [[np.cos(rate), -np.sin(rate)], [np.sin(rate), np.cos(rate)]]
    return found


MOVES = np.stack([turning(0.0), turning(TURN), turning(-TURN)])


def radar(dbn: bmc.DynamicBayesNet) -> bmc.DynamicBayesNet:
    """What is seen of the target."""
    dbn.add("range", lambda x: bmc.Normal(np.hypot(x[..., 0], x[..., 1]), 0.1))
    dbn.add("bearing", lambda x: bmc.Normal(np.arctan2(x[..., 1], x[..., 0]), 0.01))
    return dbn


def switching() -> bmc.DynamicBayesNet:
    """A target that flies straight on, or turns."""
    dbn = bmc.DynamicBayesNet("manoeuvring target")
    dbn.table("mode", ["mode_prev"], FOLLOW, MODES, initial=[1.0, 0.0, 0.0])

    @dbn.node(initial=START)
    def x(x_prev, mode):
        move = np.where(
            (mode == "straight")[..., None, None],
            MOVES[0],
            np.where((mode == "left")[..., None, None], MOVES[1], MOVES[2]),
        )
        return bmc.MvNormal(np.matvec(move, x_prev), NOISE)

    return radar(dbn)


def pushed(scale: float = 0.1) -> bmc.DynamicBayesNet:
    """A target that flies straight on, with speeds that change by more."""
    dbn = bmc.DynamicBayesNet("pushed target")
    noise = scale**2 * PUSH @ PUSH.T + 1e-6 * np.eye(4)
    dbn.add("x", lambda x_prev: bmc.MvNormal(np.matvec(MOVES[0], x_prev), noise), initial=START)
    return radar(dbn)


def engines(particles: int) -> dict[str, tuple[bmc.DynamicBayesNet, Any]]:
    """Template and engine by name."""
    target = switching()
    rules: dict[str, Any] = {
        rule.upper(): bmc.SwitchingKalmanFilter(rule, linearize=True)
        for rule in ("gpb1", "imm", "gpb2")
    }
    found = {name: (target, engine) for name, engine in rules.items()}
    found[f"{particles} particles"] = target, bmc.ParticleFilter(particles)
    found["EKF, straight on"] = pushed(), bmc.ExtendedKalmanFilter()
    return found


def simulated(seed: int, scans: int = SCANS) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """What was, and what was seen."""
    drawn = {n: v[0] for n, v in switching().sample(scans, rng=seed).items()}
    return drawn, {n: drawn[n] for n in ("range", "bearing")}


def miss(belief: Any, truth: np.ndarray) -> float:
    """Root mean square of the distance from the true position, in metres."""
    off = belief.mean("x")[:, :2] - truth[:, :2]
    return float(1000 * np.sqrt((off**2).sum(axis=-1).mean()))


def table(runs: int, particles: int) -> dict[str, tuple[float, float, float]]:
    """By engine: misses of filter, share of scans whose mode is right, mean log evidence."""
    found: dict[str, list[tuple[float, float, float]]] = {}
    for seed in range(runs):
        truth, seen = simulated(seed)
        for name, (dbn, engine) in engines(particles).items():
            belief = bmc.filter(dbn, seen, engine=engine, rng=seed)
            right = np.nan
            if "mode" in belief.names:
                right = float((belief.probabilities("mode").argmax(axis=1) == truth["mode"]).mean())
            entry = miss(belief, truth["x"]), right, float(belief.log_marginal_likelihood)
            found.setdefault(name, []).append(entry)
    return {name: tuple(np.mean(rows, axis=0)) for name, rows in found.items()}  # type: ignore[misc]


def report(found: dict[str, tuple[float, float, float]], runs: int) -> None:
    """Print the table."""
    print(f"a target in {runs} runs of {SCANS} scans   miss, m   modes right   log evidence")
    for name, (off, right, log) in found.items():
        share = "        " if np.isnan(right) else f"{100 * right:6.1f} %"
        print(f"  {name:<34}{off:9.0f}   {share}   {log:12.2f}")


def draw(seed: int) -> Any:
    """One flight: its path, and its modes, filtered and with hindsight."""
    truth, seen = simulated(seed)
    engine = bmc.SwitchingKalmanFilter("gpb2", linearize=True)
    filtered = bmc.filter(switching(), seen, engine=engine)
    smoothed = bmc.smooth(switching(), seen, engine=engine)
    figure, panels = picture.axes([["path", "filtered"], ["path", "smoothed"]], (12, 6))
    ax = panels["path"]
    reach, angle = seen["range"], seen["bearing"]
    ax.plot(reach * np.cos(angle), reach * np.sin(angle), ".", color=picture.FAINT, label="radar")
    ax.plot(*truth["x"][:, :2].T, color=picture.EXACT, lw=2.5, label="target")
    ax.plot(*filtered.mean("x")[:, :2].T, color=picture.DRAWS, label="filtered (GPB2)")
    ax.plot(*smoothed.mean("x")[:, :2].T, color=picture.OTHER, label="smoothed (Kim)")
    ax.set(xlabel="east, km", ylabel="north, km", title="a flight", aspect="equal")
    ax.legend(frameon=False)
    scans = np.arange(len(reach))
    colours = (picture.FAINT, picture.DRAWS, picture.OTHER)
    for name, belief in (("filtered", filtered), ("smoothed", smoothed)):
        ax = panels[name]
        ax.stackplot(scans, belief.probabilities("mode").T, colors=colours, alpha=0.6, labels=MODES)
        for k, colour in enumerate(colours):
            here = truth["mode"] == k
            ax.plot(scans[here], np.full(here.sum(), 1.05), "s", ms=4, color=colour, clip_on=False)
        ax.set(
            xlim=(0, len(scans) - 1), ylim=(0, 1.08), ylabel="probability", title=f"modes, {name}"
        )
    panels["smoothed"].set(xlabel="scan (squares above: what was)")
    panels["filtered"].legend(loc="lower right", fontsize=9)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table, and draw one flight."""
    options = picture.options(__doc__, arguments)
    runs = 2 if options.fast else RUNS
    report(table(runs, 500 if options.fast else 5000), runs)
    picture.save(draw(4), options.out, "switching_target")


if __name__ == "__main__":
    main()
