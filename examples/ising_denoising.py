"""A noisy black-and-white image, cleaned by Gibbs sampling of an Ising model.

Neighbouring pixels tend to be alike, exp(J x_s x_t), and every pixel is seen through noise: Gaussian, whose
factor is the Normal density of the grey value around -1 or 1, or flips. A factor graph says it in two
calls. Each sweep draws every pixel given its neighbours. Chains start from random pixels, so that the first
sweep listens to nonsense from all neighbours; after five the shape stands, and an average weighs up what
the sweeps doubt.

Besag, On the statistical analysis of dirty pictures, J. R. Stat. Soc. B 48, 1986; Murphy, Machine Learning,
2012, section 24.2.2. The image is the horse of scikit-image where ``BAYESMC_DATA`` names the reference
data, else a fish.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.errors import ConvergenceWarning
from examples import picture

J, SIGMA, FLIPPED = 0.5, 2.0, 0.2
SWEEPS = 15


def fish() -> np.ndarray:
    """A fish that swims to the right: 1 where it is, -1 elsewhere, shape (82, 100)."""
    row, column = np.indices((82, 100)).astype(float)
    y, x = (row - 41.0) / 41.0, (column - 50.0) / 50.0
    body = ((x - 0.18) / 0.66) ** 2 + (y / (0.5 - 0.12 * x)) ** 2 < 1.0
    tail = (x > -0.9) & (x < -0.35) & (np.abs(y) < -0.12 - 0.75 * x) & (np.abs(y) > -1.1 * x - 0.86)
    fin = (x > -0.15) & (x < 0.3) & (y < -0.3) & (y > -0.72 + 0.5 * np.abs(x - 0.05))
    eye = np.hypot(x - 0.55, 1.1 * (y + 0.12)) < 0.06
    gill = np.abs(np.hypot(x - 0.72, 0.8 * y) - 0.42) < 0.02
    return np.where((body | tail | fin) & ~eye & ~(gill & (np.abs(y) < 0.3)), 1, -1)


def image() -> np.ndarray:
    """The horse of the reference data if it is there, else the fish; entries -1 and 1."""
    folder = os.environ.get("BAYESMC_DATA")
    path = Path(folder) / "ising" / "horse.dev.npz" if folder else None
    if path is None or not path.is_file():
        return fish()
    with np.load(path) as arrays:
        return np.where(arrays["clean_small"] > 0, 1, -1)


def noisy(clean: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """What is seen of an image through either noise."""
    flips = np.where(rng.random(clean.shape) < FLIPPED, -1, 1)
    return {"Gaussian": clean + SIGMA * rng.normal(size=clean.shape), "flips": clean * flips}


def ising(seen: np.ndarray, noise: str) -> bmc.FactorGraph:
    """The graph: one call for all pairs of neighbours, one for all pixels."""
    rows, columns = seen.shape
    graph = bmc.FactorGraph(f"Ising, {noise}", plates={"row": rows, "column": columns})
    graph.variable("x", (-1, 1), plates=("row", "column"))
    graph.factor(lambda a, b: J * a * b, scope=("x", "x"), index=neighbours(rows, columns))
    graph.factor(pixel_factor(seen, noise), scope="x")
    return graph


def neighbours(rows: int, columns: int) -> tuple[Any, Any]:
    """Positions of all pairs: each pixel with the one to its right and the one below."""
    row, column = np.indices((rows, columns))
    right = row[:, :-1].ravel(), column[:, :-1].ravel()
    down = row[:-1].ravel(), column[:-1].ravel()
    first = np.concatenate([right[0], down[0]]), np.concatenate([right[1], down[1]])
    second = np.concatenate([right[0], down[0] + 1]), np.concatenate([right[1] + 1, down[1]])
    return first, second


def pixel_factor(seen: np.ndarray, noise: str) -> Any:
    """Log-likelihood of what is seen of each pixel, up to a constant."""
    if noise == "Gaussian":
        return lambda x: -0.5 * ((seen - x) / SIGMA) ** 2
    log_odds = np.log((1 - FLIPPED) / FLIPPED)
    return lambda x: 0.5 * log_odds * x * seen


def sweeps(graph: bmc.FactorGraph, count: int = SWEEPS) -> np.ndarray:
    """The image after each of some sweeps from a random start, shape (count, rows, columns)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # a few sweeps, and meant to be
        posterior = bmc.infer(graph, engine=bmc.Gibbs(draws=count, warmup=0, chains=1), rng=7)
    return posterior["x"][0]


def stages(seen: np.ndarray, drawn: np.ndarray) -> dict[str, np.ndarray]:
    """What is shown: the noisy image, the first sweep, the fifth, and the average."""
    return {
        "seen": seen,
        "after 1 sweep": drawn[0],
        "after 5 sweeps": drawn[4],
        f"average of {len(drawn)}": drawn.mean(axis=0),
    }


def error(shown: np.ndarray, clean: np.ndarray) -> float:
    """Share of pixels whose sign is wrong; a grey one, exactly between, is half wrong."""
    return float(np.where(shown == 0, 0.5, np.sign(shown) != clean).mean())


def draw(clean: np.ndarray, shown: dict[str, dict[str, np.ndarray]]) -> Any:
    """A row for each noise: seen, 1 sweep, 5 sweeps, average; the true image before them."""
    mosaic = [["truth", *(f"{noise} {stage}" for stage in row)] for noise, row in shown.items()]
    figure, panels = picture.axes(mosaic, (13, 4.9), width_ratios=[1] * 5)
    everything = {"truth": ("the image", clean)}
    for noise, row in shown.items():
        for stage, pixels in row.items():
            title = f"{noise}: seen" if stage == "seen" else stage
            everything[f"{noise} {stage}"] = (f"{title}, {error(pixels, clean):.1%} wrong", pixels)
    for name, (title, pixels) in everything.items():
        reach = 3.0 if name == "Gaussian seen" else 1.0
        panels[name].imshow(pixels, cmap="gray_r", vmin=-reach, vmax=reach, interpolation="nearest")
        panels[name].set_title(title, fontsize=10)
        panels[name].set_axis_off()
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the pixels that are wrong at every stage, and draw them."""
    options = picture.options(__doc__, arguments)
    clean = image()
    step = 2 if options.fast else 1
    clean = clean[::step, ::step]
    rows, columns = clean.shape
    pairs = rows * (columns - 1) + columns * (rows - 1)
    print(f"Ising denoising: {rows} x {columns} pixels, {pairs:,} pairs, J = {J:g}; pixels wrong")
    shown = {}
    for noise, seen in noisy(clean, np.random.default_rng(5)).items():
        shown[noise] = stages(seen, sweeps(ising(seen, noise)))
        errors = "   ".join(f"{s} {error(p, clean):.1%}" for s, p in shown[noise].items())
        print(f"  {noise:8}  {errors}")
    print(
        "  a chain starts from the pixels one by one; five sweeps make the shape, averages the edges"
    )
    picture.save(draw(clean, shown), options.out, "ising_denoising")


if __name__ == "__main__":
    main()
