"""Why particles are resampled: weights of whole trajectories collapse onto one of them.

Likelihood weighting of an unrolled net, and a particle filter that never resamples (sequential importance
sampling), are one algorithm: trajectories are drawn from the prior and weighted by every measurement. Each
measurement multiplies in another factor, so that the logs of the weights spread out with the square root of
time, and after some ten slices a single trajectory holds most of the weight, however many were drawn.

Resampling drops what has no weight before it is moved on, and the effective number stays where it is. It has
a price that shows when one looks back: all trajectories of today have the same few ancestors in the first
slice. A filter does not look back; smoothing does, and has to draw backwards anew.

The model is linear and Gaussian, so that the Kalman filter says what is right. Kong, Liu and Wong (1994),
Sequential imputations, JASA 89; Koller and Friedman (2009), Probabilistic Graphical Models, section 15.3.3.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.errors import LowEssWarning
from examples import picture

STEPS, PARTICLES, COPIES = 60, 1000, 20
SCHEMES = {"never resampled": 0.0, "below half": 0.5, "in every slice": 1.0}
COLOURS = dict(zip(SCHEMES, (picture.OTHER, picture.DRAWS, picture.EXACT), strict=True))
SHOWN = (1, 5, 20, 60)  # numbers of slices


def walk(copies: int | None = None) -> bmc.DynamicBayesNet:
    """A state that forgets slowly, seen through noise; or copies of it side by side."""
    dbn = bmc.DynamicBayesNet("walk", plates={"copy": copies} if copies else None)
    plates = ("copy",) if copies else ()

    @dbn.node(initial=bmc.Normal(0.0, 2.0), plates=plates)
    def x(x_prev):
        return bmc.Normal(0.9 * x_prev, 1.0)

    @dbn.node(plates=plates)
    def y(x):
        return bmc.Normal(x, 2.0)

    return dbn


def measurements() -> np.ndarray:
    """One series that the model has drawn, shape (STEPS,)."""
    return walk().sample(STEPS, rng=6)["y"][0]


def filtered(y: np.ndarray, threshold: float, copies: int = COPIES) -> Any:
    """Independent particle filters on the same series, all particles kept."""
    engine = bmc.ParticleFilter(PARTICLES, ess_threshold=threshold)
    rows = {"y": np.repeat(y[:, None], copies, axis=1)}
    with warnings.catch_warnings():  # the collapse is what is to be seen
        warnings.simplefilter("ignore", LowEssWarning)
        return bmc.filter(walk(copies), rows, engine=engine, rng=1, keep="particles")


def sequential_log_weights(found: Any, slices: int) -> np.ndarray:
    """Logs of the weights of all trajectories after so many slices, not normalised, as one row."""
    log_mean = found.log_marginal_increments[:slices].sum(axis=0)
    with np.errstate(divide="ignore"):  # a weight may be below the smallest number
        return (np.log(found.weights[slices - 1] * PARTICLES) + log_mean).ravel()


def unrolled_log_weights(y: np.ndarray, slices: int, draws: int) -> np.ndarray:
    """The same by likelihood weighting on the unrolled net, shape (draws,)."""
    net, dbn = walk().unroll(slices), walk()
    evidence = dbn.unrolled_evidence({"y": y[:slices]})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LowEssWarning)  # it is what is to be shown
        posterior = bmc.infer(net, evidence, engine=bmc.LikelihoodWeighting(draws), rng=2)
    return posterior.log_weights.ravel()


def ancestors_in_first_slice(found: Any) -> np.ndarray:
    """How many particles of slice 0 the particles of each slice come from, shape (time, copies)."""
    root = np.broadcast_to(np.arange(PARTICLES)[:, None], found.weights.shape[1:])
    counts = []
    for chosen in found.ancestors:
        root = np.take_along_axis(root, chosen, axis=0)
        counts.append((np.diff(root, axis=0) != 0).sum(axis=0) + 1)  # ancestors are sorted
    return np.array(counts)


def kolmogorov_smirnov(one: np.ndarray, other: np.ndarray) -> float:
    """The largest gap between two empirical distribution functions, in units of its standard size.

    Above 1.95 in one of a thousand cases if both samples have the same law.
    """
    points = np.concatenate([one, other])
    gap = [np.searchsorted(np.sort(a), points, side="right") / len(a) for a in (one, other)]
    size = np.sqrt(1 / len(one) + 1 / len(other))
    return float(np.abs(gap[0] - gap[1]).max() / size)


def report(
    found: dict[str, Any], y: np.ndarray, logs: dict[int, tuple[np.ndarray, np.ndarray]]
) -> None:
    """Print effective numbers, largest weights, errors, and whether both kinds of weights have one law."""
    exact = bmc.filter(walk(), {"y": y}, engine=bmc.KalmanFilter())
    copies = found["never resampled"].weights.shape[-1]
    print(
        f"  {'':17}effective number (largest weight) after so many slices, medians of {copies} filters"
    )
    print(f"  {'':17}" + "".join(f"{slices:>15}" for slices in SHOWN))
    for name, one in found.items():
        ess, top = np.median(one.weight_ess, axis=1), np.median(one.weights.max(axis=1), axis=1)
        print(f"  {name:17}" + "".join(f"{ess[s - 1]:8.0f} ({top[s - 1]:4.2f})" for s in SHOWN))
    print(
        "  error of the mean and of the log-likelihood, root of the mean square; ancestors in slice 0"
    )
    for name, one in found.items():
        mean = np.sqrt(((one.mean("x") - exact.mean("x")[:, None]) ** 2).mean())
        off = one.log_marginal_likelihood - exact.log_marginal_likelihood
        roots = np.median(ancestors_in_first_slice(one)[-1])
        print(f"  {name:17}{mean:15.3f}{np.sqrt((off**2).mean()):15.3f}{roots:15.0f}")
    print(
        "  never resampled, and likelihood weighting on the unrolled net: mean and sd of log weights"
    )
    for slices, (mine, unrolled) in logs.items():
        print(f"  {slices:4} slices  {mine.mean():10.2f} {mine.std():7.2f}   {unrolled.mean():10.2f} "
              f"{unrolled.std():7.2f}   gap of their laws {kolmogorov_smirnov(mine, unrolled):.2f} "
              "(1.95 in one of a thousand)")  # fmt: skip


def draw(found: dict[str, Any], logs: dict[int, tuple[np.ndarray, np.ndarray]]) -> Any:
    """Effective number, largest weight and ancestors over time, and the laws of log weights."""
    figure, panels = picture.axes([["ess", "top"], ["roots", "law"]], (12, 8))
    for name, one in found.items():
        curves = {
            "ess": one.weight_ess,
            "top": one.weights.max(axis=1),
            "roots": ancestors_in_first_slice(one),
        }
        time = np.arange(1, len(one.weights) + 1)
        for panel, curve in curves.items():
            ax, colour = panels[panel], COLOURS[name]
            low, middle, high = np.quantile(curve, (0.1, 0.5, 0.9), axis=1)
            ax.plot(time, middle, color=colour, label=name)
            ax.fill_between(time, low, high, color=colour, alpha=0.15, lw=0)
    panels["ess"].set(
        title=f"effective number of {PARTICLES} particles", yscale="log", ylim=(0.9, 1300)
    )
    panels["top"].set(title="largest weight", ylim=(0, 1.02))
    panels["roots"].set(title="ancestors in the first slice", yscale="log", ylim=(0.9, 1300))
    panels["ess"].legend(frameon=False, loc="lower left", bbox_to_anchor=(0.0, 0.3))
    for name in ("ess", "top", "roots"):
        panels[name].set(xlabel="slices", xlim=(1, STEPS))
    draw_laws(panels["law"], logs)
    return figure


def draw_laws(ax: Any, logs: dict[int, tuple[np.ndarray, np.ndarray]]) -> None:
    """Histograms of log weights by both algorithms, below their largest."""
    for k, (slices, (mine, unrolled)) in enumerate(logs.items()):
        top = max(mine.max(), unrolled.max())
        edges = np.linspace(-180.0, 0.0, 91)
        shares = [np.histogram(a - top, edges)[0] / len(a) for a in (mine, unrolled)]
        ax.stairs(shares[0], edges, fill=True, color=picture.OTHER, alpha=0.35,
                  label="never resampled" if k == 0 else None)  # fmt: skip
        ax.stairs(shares[1], edges, color=picture.EXACT, lw=1.1,
                  label="unrolled net, likelihood weighting" if k == 0 else None)  # fmt: skip
        at = int(shares[1].argmax())
        label = f"{slices} slice{'s' if slices > 1 else ''}"
        ax.text(
            edges[at] - 1,
            shares[1][at] * 1.15,
            label,
            ha="center" if k % 2 else "right",
            fontsize=9,
        )
    ax.set(title="log weights below the largest", xlabel="log weight", ylabel="share (log scale)",
           yscale="log", ylim=(3e-4, 3), xlim=(-180, 3))  # fmt: skip
    ax.legend(frameon=False, loc="upper left", fontsize=9)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print what becomes of the weights, and draw it."""
    options = picture.options(__doc__, arguments)
    copies, shown = (4, SHOWN[:3]) if options.fast else (COPIES, SHOWN)
    print(f"Weight collapse: {PARTICLES} particles, {STEPS} slices")
    y = measurements()
    found = {name: filtered(y, threshold, copies) for name, threshold in SCHEMES.items()}
    never = found["never resampled"]
    logs = {
        slices: (
            sequential_log_weights(never, slices),
            unrolled_log_weights(y, slices, PARTICLES * copies),
        )
        for slices in shown
    }
    report(found, y, logs)
    picture.save(draw(found, logs), options.out, "weight_collapse")


if __name__ == "__main__":
    main()
