"""Jams on a road: forty coupled chains, too many for an exact filter, with beliefs that are products.

Each stretch of a road is free or jammed, a jam creeps backwards from the stretch ahead, and a few detectors
count cars, with errors. All stretches hang together after a few slices, so that the exact filter needs one
probability for each of 2**40 states of the road. The filter of Boyen and Koller keeps a table for each of a
few clusters of stretches instead, on which it projects the belief in every slice; the factored frontier keeps
every stretch by itself and takes not even a slice exactly. Neither states an error, so it is looked at twice:
beside the exact filter on a road of ten stretches, and beside particles, many times over, on the long one.

Boyen and Koller (1998), Tractable inference for complex stochastic processes, UAI; Murphy and Weiss (2001),
The factored frontier algorithm for approximate inference in DBNs, UAI, whose example is traffic, too.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.errors import LowEssWarning
from examples import picture

SHORT, LONG, STEPS = 10, 40, 200
PARTICLES, RUNS = 100_000, 5
QUANTILE = 2.776  # of Student's t with so many runs, at 97.5 %
#: probability of a jam, by whether there was one here and on the stretch ahead
JAM = np.array([[0.02, 0.35], [0.50, 0.92]])
#: what a detector says of a free and of a jammed stretch
DETECTOR = [[0.9, 0.1], [0.2, 0.8]]
EVERY = 4  # one detector for so many stretches
SHOWN = 22  # a stretch without a detector


def road(stretches: int) -> bmc.DynamicBayesNet:
    """Stretches from the first to the last, which has nothing ahead of it."""
    dbn = bmc.DynamicBayesNet("road")
    creeping = np.stack([1 - JAM, JAM], axis=-1)
    for k in range(stretches):
        start = {"initial": [0.8, 0.2]}
        if k + 1 < stretches:
            dbn.table(f"jam{k}", [f"jam{k}_prev", f"jam{k + 1}_prev"], creeping, **start)
        else:
            dbn.table(f"jam{k}", [f"jam{k}_prev"], [[0.9, 0.1], [0.2, 0.8]], **start)
    for k in range(0, stretches, EVERY):
        dbn.table(f"count{k}", [f"jam{k}"], DETECTOR)
    return dbn


def drive(stretches: int, steps: int, rng: int) -> tuple[dict[str, Any], np.ndarray]:
    """What the detectors say, and where the jams are, shape (steps, stretches)."""
    drawn = road(stretches).sample(steps, rng=rng)
    rows = {n: v[0] for n, v in drawn.items() if n.startswith("count")}
    return rows, np.stack([drawn[f"jam{k}"][0] for k in range(stretches)], axis=1)


def groups(stretches: int, size: int) -> list[list[str]]:
    """Neighbours together."""
    names = [f"jam{k}" for k in range(stretches)]
    return [names[k : k + size] for k in range(0, stretches, size)]


def jams(found: Any, stretches: int) -> np.ndarray:
    """Probabilities of a jam, shape (time, stretches)."""
    return np.stack([found.mean(f"jam{k}") for k in range(stretches)], axis=1)


def errors_on_a_short_road(steps: int, roads: int) -> dict[str, float]:
    """Mean distance of probabilities of a jam from the exact ones, in per cent, by engine."""
    engines = {
        "factored frontier": bmc.FactoredFrontier(),
        "single stretches": bmc.BoyenKoller(groups(SHORT, 1)),
        "pairs": bmc.BoyenKoller(groups(SHORT, 2)),
        "pairs that overlap": bmc.BoyenKoller(
            [[f"jam{k}", f"jam{k + 1}"] for k in range(SHORT - 1)]
        ),
        "fives": bmc.BoyenKoller(groups(SHORT, 5)),
        "clusters found": bmc.BoyenKoller(),
    }
    total = dict.fromkeys(engines, 0.0)
    for seed in range(roads):
        rows, _ = drive(SHORT, steps, seed)
        right = jams(bmc.filter(road(SHORT), rows, engine=bmc.DiscreteFilter()), SHORT)
        for name, engine in engines.items():
            found = jams(bmc.filter(road(SHORT), rows, engine=engine), SHORT)
            total[name] += 100 * float(np.abs(found - right).mean()) / roads
    return total


def by_particles(rows: dict[str, Any], particles: int, seed: int) -> Any:
    """A filter that draws."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LowEssWarning)  # how far it is off is looked at by runs
        return bmc.filter(road(LONG), rows, engine=bmc.ParticleFilter(particles), rng=seed)


def main(arguments: Sequence[str] | None = None) -> None:
    asked = picture.options(__doc__, arguments)
    steps, particles = (40, 2000) if asked.fast else (STEPS, PARTICLES)
    off = errors_on_a_short_road(steps // 2, 2 if asked.fast else 10)
    print(f"a road of {SHORT} stretches; probabilities of a jam are off on average by")
    for name, error in off.items():
        print(f"  {error:8.4f} %  {name}")
    rows, truth = drive(LONG, steps, rng=5)
    refused = bmc.DiscreteFilter().unsupported(road(LONG), rows)
    assert refused is not None
    print(f"the exact filter on {LONG}: ... {refused[refused.index('has') :]}")
    near = bmc.filter(road(LONG), rows)  # it is the engine chosen
    print(
        f"{type(near.engine).__name__}: {steps} slices of {LONG} stretches, log likelihood "
        f"{near.log_marginal_likelihood:.2f}"
    )
    runs = [by_particles(rows, particles, seed) for seed in range(RUNS)]
    drawn = np.stack([jams(run, LONG) for run in runs])
    mean, error = drawn.mean(axis=0), drawn.std(axis=0, ddof=1) / np.sqrt(RUNS)
    print(
        f"{RUNS} filters of {particles} particles: log likelihoods "
        f"{', '.join(f'{run.log_marginal_likelihood:.2f}' for run in runs)}"
    )
    apart = np.abs(jams(near, LONG) - mean)
    print(
        f"probabilities of a jam are {100 * apart.mean():.2f} % from the mean of these, whose own error is "
        f"{100 * error.mean():.2f} %; {np.mean(apart <= QUANTILE * error):.3f} are in its 95 % interval"
    )
    draw(asked, off, truth, jams(near, LONG), mean[:, SHOWN], error[:, SHOWN])


def draw(
    asked: Any,
    off: dict[str, float],
    truth: np.ndarray,
    near: np.ndarray,
    drawn: np.ndarray,
    error: np.ndarray,
) -> None:
    """The road over time, errors beside the exact filter, and one stretch beside particles."""
    figure, ax = picture.axes([["truth", "off"], ["belief", "one"]], (11.0, 7.0))
    for name, shown in (("truth", truth), ("belief", near)):
        ax[name].imshow(shown.T, aspect="auto", origin="lower", cmap="Blues", vmin=0, vmax=1,
                        interpolation="nearest")  # fmt: skip
        ax[name].plot([-1.5] * len(range(0, LONG, EVERY)), range(0, LONG, EVERY), ">",
                      color=picture.OTHER, markersize=4, clip_on=False)  # fmt: skip
        ax[name].set(ylabel="stretch", xlabel="slice", xlim=(-0.5, len(truth) - 0.5))
    ax["truth"].set_title("where the jams are (arrows: detectors)")
    ax["belief"].set_title("probability of a jam, given the detectors so far")
    names = list(off)
    ax["off"].barh(names, [off[n] for n in names], color=picture.DRAWS)
    ax["off"].invert_yaxis()
    ax["off"].set(
        xlabel="per cent", xscale="log", title=f"mean error on {SHORT} stretches, beside exact"
    )
    shown = slice(0, min(80, len(truth)))
    times = np.arange(len(truth))[shown]
    low, high = (drawn + sign * QUANTILE * error for sign in (-1, 1))
    ax["one"].fill_between(times, low[shown], high[shown], color=picture.FAINT, alpha=0.6,
                           label="particles, 95 % interval")  # fmt: skip
    ax["one"].plot(times, near[shown, SHOWN], color=picture.EXACT, label="clusters found")
    ax["one"].step(times, truth[shown, SHOWN], color=picture.OTHER, lw=0.8, where="mid",
                   label="a jam")  # fmt: skip
    ax["one"].set(xlabel="slice", ylim=(-0.05, 1.25), title=f"stretch {SHOWN}")
    ax["one"].legend(loc="upper right", frameon=False, fontsize=8, ncols=3)
    picture.save(figure, asked.out, "coupled_chains")


if __name__ == "__main__":
    main()
