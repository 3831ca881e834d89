"""The growth benchmark: a belief with two hills, which particles carry and a Kalman filter cannot.

    x_t = x_{t-1} / 2 + 25 x_{t-1} / (1 + x_{t-1}^2) + 8 cos(1.2 t) + v_t,    y_t = x_t^2 / 20 + w_t

Only the square of the state is seen, so that its sign has to be found out from how it moves, and for some
slices it stays open. The table holds, over many runs, the error of the mean against the truth: of the exact
filter (a fine grid), of bootstrap filters with more and more particles, and of Kalman filters with one
Gaussian for a belief. The picture shows one run: the exact belief as it moves with the particles' mean on it,
and what both say about single slices.

All runs are elements of a plate and filtered at once; each has particles and a grid of its own.

Gordon, Salmond and Smith (1993), Novel approach to nonlinear/non-Gaussian Bayesian state estimation, IEE
Proceedings F 140; in the lectures of de Freitas the three variances are parameters, as they are here.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.errors import LowEssWarning, ModelMisfitWarning
from examples import picture

START, STATE, SEEN = (
    5.0,
    10.0,
    1.0,
)  # variances: of the first state, of its noise, of the measurements
STEPS, RUNS = 100, 200
PARTICLES = (50, 100, 200, 500, 1000)
CELLS = 450  # on -45 to 45: two tenths, where the narrowest density is three wide

#: mean error over 200 runs as other programs found it, and its standard error (0.09 at most for particles)
EXPECTED = {
    "exact grid": (4.60, 0.05),
    "bootstrap, 50 particles": (5.44, 0.05),
    "bootstrap, 100 particles": (5.05, 0.05),
    "bootstrap, 200 particles": (4.85, 0.05),
    "bootstrap, 500 particles": (4.70, 0.05),
    "bootstrap, 1000 particles": (4.63, 0.05),
    "extended Kalman": (21.4, 0.8),
    "unscented Kalman (1, 0, 2)": (11.65, 0.16),
}


def growth(
    runs: int, start: float = START, state: float = STATE, seen: float = SEEN
) -> bmc.DynamicBayesNet:
    """The template, of so many runs side by side, by its three variances."""
    dbn = bmc.DynamicBayesNet("growth", plates={"run": runs})
    initial = bmc.Normal(0.0, np.sqrt(start))

    @dbn.node(initial=initial, plates="run")
    def x(x_prev, t):
        mean = x_prev / 2 + 25 * x_prev / (1 + x_prev**2) + 8 * np.cos(1.2 * t)
        return bmc.Normal(mean, np.sqrt(state))

    @dbn.node(plates="run")
    def y(x):
        return bmc.Normal(x**2 / 20, np.sqrt(seen))

    return dbn


def simulated(dbn: bmc.DynamicBayesNet, seed: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """States and measurements, shape (time, run); slice 0 is not measured."""
    drawn = dbn.sample(STEPS + 1, rng=seed)
    x, y = drawn["x"][0], drawn["y"][0].copy()
    y[0] = np.nan
    return x, y


def grid(cells: int = CELLS) -> Any:
    """The exact filter, but for cells."""
    return bmc.GridFilter({"x": (-45.0, 45.0, cells)})


def engines(cells: int = CELLS) -> dict[str, Any]:
    """What is compared."""
    found: dict[str, Any] = {"exact grid": grid(cells)}
    for n in PARTICLES:
        found[f"bootstrap, {n} particles"] = bmc.ParticleFilter(n)
    found["extended Kalman"] = bmc.ExtendedKalmanFilter()
    found["unscented Kalman (1, 0, 2)"] = bmc.UnscentedKalmanFilter(1.0, 0.0, 2.0)
    return found


def filtered(dbn: bmc.DynamicBayesNet, y: np.ndarray, engine: Any) -> Any:
    """Beliefs of one engine about all runs; densities are not kept."""
    keep = "summaries" if isinstance(engine, bmc.GridFilter) else None
    with warnings.catch_warnings():  # fifty particles are few, which is what the table shows
        warnings.simplefilter("ignore", LowEssWarning)
        warnings.simplefilter("ignore", ModelMisfitWarning)  # Gaussians with one hill are too sure
        return bmc.filter(dbn, {"y": y}, engine=engine, rng=1, keep=keep)


def error(mean: np.ndarray, x: np.ndarray) -> tuple[float, float]:
    """Root mean squared error over slices 1, 2, ..., averaged over runs; and its standard error."""
    off = np.sqrt(((mean - x)[1:] ** 2).mean(axis=0))
    return float(off.mean()), float(off.std(ddof=1) / np.sqrt(len(off)))


def table(runs: int, cells: int = CELLS) -> dict[str, tuple[float, float]]:
    """For every engine the mean error and its standard error."""
    dbn = growth(runs)
    x, y = simulated(dbn)
    return {
        name: error(filtered(dbn, y, engine).mean("x"), x)
        for name, engine in engines(cells).items()
    }


def one_run(particles: int = 500, cells: int = CELLS) -> dict[str, Any]:
    """One run, with the exact densities and all particles kept."""
    dbn = growth(1)
    x, y = simulated(dbn, seed=8)
    cloud = bmc.ParticleFilter(particles)
    return {
        "x": x[:, 0],
        "exact": bmc.filter(dbn, {"y": y}, engine=grid(cells)),
        "cloud": bmc.filter(dbn, {"y": y}, engine=cloud, rng=2, keep="particles"),
        "one Gaussian": bmc.filter(dbn, {"y": y}, engine=bmc.UnscentedKalmanFilter(1.0, 0.0, 2.0)),
    }


def striking(exact: Any) -> list[int]:
    """Three slices: an open sign, one that leans, and the flattest."""
    points, density = exact.grid("x"), exact.density("x")[:, 0]
    right = density[:, points > 0].sum(axis=1) / density.sum(axis=1)
    far = exact.std("x")[:, 0] > 6.0
    open_ = np.where(far, np.abs(right - 0.5), 1.0)
    leans = np.where(far, np.abs(right - 0.85), 1.0)
    flat = density.max(axis=1)
    flat[:10] = np.inf
    return [int(a.argmin()) for a in (open_, leans, flat)]


def draw(run: dict[str, Any]) -> Any:
    """The exact belief over time with the particles' mean on it, and three slices of it."""
    slices = striking(run["exact"])
    figure, panels = picture.axes([["path"] * 3, [f"at {t}" for t in slices]], (12, 8.2))
    points, density = run["exact"].grid("x"), run["exact"].density("x")[:, 0]
    ax = panels["path"]
    # the root shows small hills beside high peaks
    ax.pcolormesh(np.arange(len(density)), points, np.sqrt(density).T, cmap="Blues", vmax=0.75)
    ax.plot(run["x"], ".", color=picture.EXACT, ms=5, label="true state")
    mean = run["cloud"].mean("x")[:, 0]
    ax.plot(mean, color=picture.OTHER, lw=1.1, label="mean of the particles")
    ax.set(xlim=(0, STEPS), ylim=(-27, 27), xlabel="t", ylabel="x", title="the exact belief")
    for t in slices:
        ax.annotate("", (t, -23), (t, -27), arrowprops={"arrowstyle": "->", "color": picture.EXACT})
        draw_slice(panels[f"at {t}"], run, t)
    ax.legend(loc="upper right", ncols=2, framealpha=0.9)
    panels[f"at {slices[-1]}"].legend(frameon=False, loc="upper left", fontsize=9)
    return figure


def draw_slice(ax: Any, run: dict[str, Any], t: int) -> None:
    """The exact density of one slice, the histogram of the particles, and a Gaussian filter's belief."""
    cloud, gauss = run["cloud"], run["one Gaussian"]
    points, density = run["exact"].grid("x"), run["exact"].density("x")[t, 0]
    particles, weights = cloud.particles("x")[t, :, 0], cloud.weights[t, :, 0]
    edges = np.arange(-27.0, 27.5, 0.75)
    ax.hist(particles, edges, weights=weights, density=True, color=picture.DRAWS, label="particles")
    ax.plot(points, density, color=picture.EXACT, label="exact")
    bell = bmc.Normal(gauss.mean("x")[t, 0], gauss.std("x")[t, 0])
    ax.plot(
        points, np.exp(bell.log_prob(points)), "--", color=picture.FAINT, label="unscented Kalman"
    )
    ax.axvline(run["x"][t], color=picture.OTHER, ls=":", label="true state")
    ax.set(title=f"t = {t}", xlim=(-27, 27), ylim=(0, 1.5 * density.max()), xlabel="x", yticks=[])


def report(found: dict[str, tuple[float, float]], runs: int) -> None:
    """Print the table, beside what is expected."""
    print(f"Growth benchmark: error of the mean, {runs} runs of {STEPS} slices")
    print(f"  {'':28}{'error':>7}  {'+-':>5}   expected")
    for name, (mean, spread) in found.items():
        print(f"  {name:28}{mean:7.2f}  {spread:5.2f}   {EXPECTED[name][0]:8.2f}")
    print(
        "  no filter is better than the exact one; a few hundred particles come near, one Gaussian does not"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table of errors, and draw one run."""
    options = picture.options(__doc__, arguments)
    runs, cells = (10, 225) if options.fast else (RUNS, CELLS)
    report(table(runs, cells), runs)
    picture.save(draw(one_run(cells=cells)), options.out, "growth_benchmark")


if __name__ == "__main__":
    main()
