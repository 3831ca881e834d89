"""Bananas: where a robot that senses nothing may be, and why that is no Gaussian.

A robot drives an S by its commands alone. A little noise on the heading of every second is a lot of noise on
the position a minute later: particles lie along an arc about the start, not in an ellipse. Three models of
the same drive, each of them one conditional density of a pose given the last:

- the notes': straight ahead along the old heading, then a turn, and Gaussian noise on all three numbers.
  Headings are the notes', 0 along +y and clockwise, so the step is ``(v sin h, v cos h)`` (the second
  component is misprinted there);
- the velocity model: noise on both velocities, and an arc driven by them exactly;
- the odometry model: a rotation, a translation and a rotation, as the wheels have counted them, with noise.

The clouds are draws of whole trajectories from the template; nothing is filtered, as nothing is seen. The
ellipses are what an extended Kalman filter predicts from the same declarations, with 95 % of a Gaussian
inside. It puts the robot at the end of the path without noise, while the mean of the cloud lies short of it:
whoever errs in heading, to the left or the right, gets less far. ``bend`` is the correlation between how far
ahead of its mean a particle lies (in the direction in which the cloud is narrow) and the square of how far
aside: 0 for every Gaussian, whatever its covariance.

Dellaert, Monte Carlo Inference (lecture notes), section 2.1 and figure 4; Thrun, Burgard and Fox (2005),
Probabilistic Robotics, tables 5.3 and 5.6.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc import robotics
from examples import picture

DRAWS = 20_000
SHOWN = (9, 20, 34, 57)  # slices with a picture of the cloud
WITHIN = 0.95

#: forward velocity (m/s) and turn to the left (rad/s), a row for each second; the first row is not driven
STRAIGHT, LEFT, RIGHT = (1.0, 0.0), (1.0, 0.16), (1.0, -0.16)
DRIVEN = np.array([STRAIGHT] * 16 + [LEFT] * 10 + [STRAIGHT] * 10 + [RIGHT] * 10 + [STRAIGHT] * 12)

# on purpose not the same: the second is unsure of its speed, the third of its direction
START = 0.01  # standard deviation of the first pose, in m, m and rad
NOISE = np.array([0.05, 0.05, 0.05])  # the notes' model: m, m and rad each second
VELOCITY = np.array([0.16, 0.0, 0.0025, 0.0, 0.0, 0.0])  # variances, see ``VelocityMotion``
ODOMETRY = np.array([0.01, 0.0025, 0.001, 0.0])  # variances, see ``OdometryMotion``


def notes(share: float = 1.0) -> bmc.DynamicBayesNet:
    """The notes' motion model; its headings are a compass's."""

    def moved(pose_prev: Any, u: Any) -> Any:
        at = robotics.euler_step(pose_prev, u[..., 0], -u[..., 1], 1.0, heading_zero="y")
        return robotics.PoseNormal(at, scale_diag=share * NOISE)

    return template(moved, robotics.compass(0.0), share)


def velocity(share: float = 1.0) -> bmc.DynamicBayesNet:
    """Noise on the velocities, and an exact arc."""

    def moved(pose_prev: Any, u: Any) -> Any:
        return robotics.VelocityMotion(pose_prev, u[..., 0], u[..., 1], 1.0, share**2 * VELOCITY)

    return template(moved, 0.0, share)


def odometry(share: float = 1.0) -> bmc.DynamicBayesNet:
    """What the wheels have counted, with noise on each part; they count the path that was commanded."""

    def moved(pose_prev: Any, u: Any) -> Any:
        counted = robotics.unicycle(np.zeros(3), u[..., 0], u[..., 1], 1.0)
        return robotics.OdometryMotion(pose_prev, counted, share**2 * ODOMETRY)

    return template(moved, 0.0, share)


#: a template by its share of the noise's standard deviations
MODELS: dict[str, Callable[..., bmc.DynamicBayesNet]] = {
    "the notes' steps": notes,
    "velocities, and an arc": velocity,
    "odometry": odometry,
}


def template(moved: Callable[..., Any], heading: Any, share: float) -> bmc.DynamicBayesNet:
    """A robot that starts in the origin and drives to the right."""
    dbn = bmc.DynamicBayesNet("robot without sensors")
    dbn.input("u", event_shape=(2,))
    start = robotics.PoseNormal([0.0, 0.0, float(heading)], scale_diag=np.full(3, share * START))
    dbn.add("pose", moved, initial=start)
    return dbn


def clouds(dbn: bmc.DynamicBayesNet, draws: int = DRAWS) -> np.ndarray:
    """Poses, shape (draw, slice, 3)."""
    return dbn.sample(len(DRIVEN), draws, inputs={"u": DRIVEN}, rng=1)["pose"]


def predicted(dbn: bmc.DynamicBayesNet) -> tuple[np.ndarray, np.ndarray]:
    """Means and covariances of position by an extended Kalman filter, shape (slice, 2) and (slice, 2, 2)."""
    belief: Any = bmc.filter(dbn, {}, inputs={"u": DRIVEN}, engine=bmc.ExtendedKalmanFilter())
    return belief.mean("pose")[:, :2], belief.cov("pose")[:, :2, :2]


def inside(places: np.ndarray, mean: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """Which places, shape (draw, 2), lie within the ellipse that holds 95 % of a Gaussian."""
    off = places - mean
    square = (off * np.linalg.solve(cov, off.T).T).sum(axis=1)
    return square <= -2 * np.log(1 - WITHIN)  # of two numbers the square is an exponential


def bend(places: np.ndarray) -> float:
    """Correlation of the deviation along the narrow axis with the square of that along the wide one."""
    off = places - places.mean(axis=0)
    narrow, wide = (off @ np.linalg.eigh(np.cov(off.T))[1]).T
    return abs(float(np.corrcoef(narrow, wide**2)[0, 1]))


def figures(dbn: bmc.DynamicBayesNet, cloud: np.ndarray) -> dict[str, float]:
    """What is said of the last slice of a model."""
    mean, cov = predicted(dbn)
    places = cloud[:, -1, :2]
    return {
        "EKF's end from start": float(np.hypot(*mean[-1])),
        "mean of the cloud from start": float(np.hypot(*places.mean(axis=0))),
        "cloud's mean to EKF's": float(np.hypot(*(places.mean(axis=0) - mean[-1]))),
        "inside of 95 %": float(inside(places, mean[-1], cov[-1]).mean()),
        "bend": bend(places),
    }


def report(found: dict[str, dict[str, float]]) -> None:
    """Print a row for each model."""
    names = list(next(iter(found.values())))
    print(f"  {'':24}" + "  ".join(names))
    for model, row in found.items():
        cells = (f"{row[name]:{len(name)}.2f}" for name in names)
        print(f"  {model:24}" + "  ".join(cells))
    print("  distances in metres; a Gaussian belief has 0.95 inside, a bend of 0 and one mean")


def ellipse(mean: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """Points around the ellipse, shape (2, point)."""
    turn = np.linspace(0, 2 * np.pi, 100)
    root = np.linalg.cholesky(cov) * np.sqrt(-2 * np.log(1 - WITHIN))
    return mean[:, None] + root @ np.stack([np.cos(turn), np.sin(turn)])


def draw(templates: dict[str, bmc.DynamicBayesNet], found: dict[str, np.ndarray]) -> Any:
    """A panel for each model: clouds, ellipses, and the path without noise."""
    figure, panels = picture.axes([list(found)], (15, 6.2), sharex=True, sharey=True)
    for name, cloud in found.items():
        ax, (mean, cov) = panels[name], predicted(templates[name])
        for k, t in enumerate(SHOWN):
            some = cloud[:2500, t]
            last = t == SHOWN[-1]
            ax.plot(*some[:, :2].T, ".", color=picture.DRAWS, ms=1.5, alpha=0.35, rasterized=True)
            label = {"label": "EKF, 95 %"} if k == 0 else {}
            ax.plot(*ellipse(mean[t], cov[t]), color=picture.OTHER, lw=1.4, **label)
            ax.plot(*cloud[:, t, :2].mean(axis=0), "o", color=picture.EXACT, ms=5, mfc="white",
                    **({"label": "mean of the cloud"} if last else {}))  # fmt: skip
        ax.plot(*mean.T, color=picture.EXACT, lw=1, label="path without noise")
        ax.plot([], [], ".", color=picture.DRAWS, label="particles")
        ax.set(title=name, xlabel="x (m)", aspect="equal")
        ax.set(xlim=(-3, 62), ylim=(-18, 52))
    first = panels[next(iter(found))]
    first.set_ylabel("y (m)")
    first.legend(frameon=False, loc="upper left", fontsize=9)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Print what is curved, and draw the clouds."""
    options = picture.options(__doc__, arguments)
    draws = 2_500 if options.fast else DRAWS
    templates = {name: model() for name, model in MODELS.items()}
    found = {name: clouds(dbn, draws) for name, dbn in templates.items()}
    print(f"Motion without sensing: {len(DRIVEN) - 1} s of driving, {draws} particles, last slice")
    report({name: figures(dbn, found[name]) for name, dbn in templates.items()})
    picture.save(draw(templates, found), options.out, "banana")


if __name__ == "__main__":
    main()
