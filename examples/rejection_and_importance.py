"""One target density by rejection and by importance sampling, side by side.

The target is known up to a factor only. Rejection sampling throws points under an envelope k q that
lies above it everywhere, and keeps those under the target: exact draws, the fewer the looser the
envelope. Importance sampling keeps every draw of q and weights it by target over proposal, p / q
(not q / p): no envelope is needed, and the weights say how much each draw counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc import montecarlo
from examples import picture

PROPOSAL = bmc.Normal(1.0, 3.5)
GRID = np.linspace(-9.0, 11.0, 2001)


def target(z: np.ndarray) -> np.ndarray:
    """Log of the unnormalised target: a broad hump and a narrow one."""
    return np.logaddexp(-0.25 * (z + 2) ** 2, np.log(0.7) - 0.6 * (z - 4) ** 2)


# In practice k comes from an argument, not from a grid; a bound that fails raises an error.
K = 1.02 * float(np.exp((target(GRID) - PROPOSAL.log_prob(GRID)).max()))
INTEGRAL = np.sqrt(np.pi) * (1 / np.sqrt(0.25) + 0.7 / np.sqrt(0.6))
MEAN = np.sqrt(np.pi) * (-2 / np.sqrt(0.25) + 4 * 0.7 / np.sqrt(0.6)) / INTEGRAL


def draw(rng: np.random.Generator) -> Any:
    """Left points under the envelope, right draws of the proposal with their weights."""
    figure, panels = picture.axes([["rejection", "importance"]], (12, 4.6), sharex=True)
    left, right = panels.values()
    density, cover = np.exp(target(GRID)), K * np.exp(PROPOSAL.log_prob(GRID))
    z = PROPOSAL.sample(rng, 700)
    u = rng.random(700) * K * np.exp(PROPOSAL.log_prob(z))  # uniform below the envelope
    kept = u < np.exp(target(z))
    left.plot(z[kept], u[kept], ".", ms=5, color=picture.DRAWS, label=f"{kept.sum()} accepted")
    left.plot(
        z[~kept], u[~kept], "x", ms=3.5, color=picture.FAINT, label=f"{(~kept).sum()} rejected"
    )
    left.plot(GRID, cover, "--", color=picture.OTHER, label="envelope k q(z)")
    left.set(title="rejection", ylabel="height", ylim=0)

    z = np.sort(PROPOSAL.sample(rng, 60))
    weights = np.exp(target(z) - PROPOSAL.log_prob(z))
    right.vlines(z, 0, weights / K, color=picture.DRAWS, lw=2, label="60 draws, weight p / q")
    right.plot(z, 0 * z, "|", ms=9, color=picture.OTHER)
    right.plot(GRID, cover / cover.max(), "--", color=picture.OTHER, label="proposal q(z)")
    right.set(title="importance", ylabel="relative to the largest", ylim=0)
    for ax, scale in ((left, 1.0), (right, 1 / density.max())):
        ax.plot(GRID, scale * density, color=picture.EXACT, label="target p(z)")
        ax.set(xlabel="z", xlim=(-9, 11))
        ax.legend(frameon=False, loc="upper right", fontsize=9)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Print what both say of the mean and the integral, and draw them."""
    options = picture.options(__doc__, arguments)
    draws = 2_000 if options.fast else 50_000
    found = montecarlo.rejection_sample(target, PROPOSAL, K, draws, rng=1)
    error = found.draws.std() / np.sqrt(draws)
    weighted = montecarlo.integrate(
        lambda z: z, target, found.proposed, rng=2, proposal=PROPOSAL, normalised=True
    )
    area = montecarlo.integrate(np.ones_like, target, found.proposed, rng=2, proposal=PROPOSAL)
    integral = np.exp(found.log_normalizer)
    print(f"Rejection and importance: {found.proposed:,} draws of the proposal each")
    print(f"  rejection   accepts {found.acceptance_rate:.1%}; expected {INTEGRAL / K:.1%}")
    print(f"  mean        exact {MEAN:.4f}   rejection {found.draws.mean():.4f} +- {error:.4f}   "
          f"importance {weighted.value:.4f} +- {weighted.standard_error:.4f}")  # fmt: skip
    print(f"  integral    exact {INTEGRAL:.4f}   rejection {integral:.4f} +- "
          f"{integral * found.standard_error:.4f}   "
          f"importance {area.value:.4f} +- {area.standard_error:.4f}")  # fmt: skip
    picture.save(draw(np.random.default_rng(2)), options.out, "rejection_and_importance")


if __name__ == "__main__":
    main()
