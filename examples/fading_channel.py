"""Digital signals through a fading channel: bits by particles that carry a Kalman filter, some symbols late.

    x_t = F x_{t-1} + g N(0, 1/2) twice,   alpha_t = h x_t       (gain of the channel: an ARMA(3, 3), complex)
    s_t = s_{t-1} or -s_{t-1} by bit_t,    y_t = alpha_t s_t + noise

A receiver sees y alone. Without pilots the sign of the channel cannot be told, so bits are coded as changes
of sign. The differential detector takes the channel to stand still for two symbols, which it does not: with
less and less noise it gets no better. Given the bits all is linear-Gaussian, so 50 streams of bits, each with
a Kalman filter of the channel and each bit drawn given its reading (``marginalize=``, ``proposal=``), follow
both. A bit is told better some symbols later (``delay=``): one pass has all delays (``belief.back``).
Beside it stands a receiver that knows the channel. Noise levels and repetitions are elements of a plate that
are filtered apart, all in one array.

The channel is flat Rayleigh fading with .05 Doppler shifts per symbol, by a Butterworth filter: Chen, Wang
and Liu (2000), Adaptive joint detection and decoding in flat-fading channels via mixture Kalman filtering,
IEEE Trans. Inform. Theory 46, sec. V.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

import bayesmc as bmc
from examples import picture

#: scipy.signal.butter(3, 0.1)
MOVING = np.array([0.00289819, 0.00869458, 0.00869458, 0.00289819])
RECURSIVE = np.array([-2.37409474, 1.92935567, -0.53207537])
STREAMS, DELAYS = 50, (0, 1, 2, 3)
#: the variance of the gain over that of the noise, in dB
SNRS = (10, 15, 20, 25, 30)
SYMBOLS, SEED = 2_000, 1


class Channel(NamedTuple):
    """Four values in a row of an autoregression, and the gain as their moving average."""

    moves: np.ndarray
    noise: np.ndarray
    gain: np.ndarray
    start: np.ndarray


def channel() -> Channel:
    """Of the real part of the gain, or of the imaginary: of variance 1/2 each."""
    moves = np.eye(4, k=-1)
    moves[0, :3] = -RECURSIVE
    noise = np.diag([math.sqrt(0.5), 0.0, 0.0, 0.0])
    still = np.eye(16) - np.kron(moves, moves)
    start = np.linalg.solve(still, (noise**2).reshape(-1)).reshape(4, 4)
    gain = MOVING / math.sqrt(2 * MOVING @ start @ MOVING)
    return Channel(moves, noise, gain, 0.5 * (start + start.T))


OWN = channel()


def fading(snrs: Sequence[float]) -> bmc.DynamicBayesNet:
    """Transmissions side by side, each with its own noise."""
    dbn = bmc.DynamicBayesNet("fading channel", plates={"sent": len(snrs)})
    sd = np.sqrt(0.5 * 10 ** (-np.asarray(snrs, dtype=float) / 10))
    start = bmc.MvNormal(np.zeros(4), OWN.start)
    dbn.add("bit", bmc.Bernoulli(0.5), plates="sent")

    @dbn.node(initial=lambda bit: 2 * bit - 1, plates="sent")
    def symbol(symbol_prev, bit):
        return symbol_prev * (2 * bit - 1)

    @dbn.node(initial=start, plates="sent")
    def real(real_prev):
        return bmc.MvNormal(np.matvec(OWN.moves, real_prev), scale_tril=OWN.noise)

    @dbn.node(initial=start, plates="sent")
    def imaginary(imaginary_prev):
        return bmc.MvNormal(np.matvec(OWN.moves, imaginary_prev), scale_tril=OWN.noise)

    @dbn.node(plates="sent")
    def seen_real(real, symbol):
        return bmc.Normal(symbol * np.vecdot(OWN.gain, real), sd)

    @dbn.node(plates="sent")
    def seen_imaginary(imaginary, symbol):
        return bmc.Normal(symbol * np.vecdot(OWN.gain, imaginary), sd)

    return dbn


class Sent(NamedTuple):
    """What was sent, the gain of the channel, and what came, shape ``(symbols, transmissions)``."""

    bits: np.ndarray
    gain: np.ndarray
    seen: np.ndarray


def sent(snrs: Sequence[float], symbols: int, seed: int = SEED) -> Sent:
    """Transmissions drawn from the template."""
    drawn = {name: v[0] for name, v in fading(snrs).sample(symbols, rng=seed).items()}
    gain = drawn["real"] @ OWN.gain + 1j * drawn["imaginary"] @ OWN.gain
    return Sent(drawn["bit"], gain, drawn["seen_real"] + 1j * drawn["seen_imaginary"])


def by_differences(seen: np.ndarray) -> np.ndarray:
    """Bits from the second on, if the channel stands still for two symbols."""
    return (seen[1:] * seen[:-1].conj()).real > 0


def by_streams(snrs: Sequence[float], seen: np.ndarray, seed: int) -> dict[int, np.ndarray]:
    """Bits from the second on, by the number of later symbols that are waited for."""
    engine = bmc.ParticleFilter(STREAMS, marginalize="auto", proposal="optimal", delay=max(DELAYS))
    ones = np.zeros((len(DELAYS), *seen.shape))
    belief = engine.start(fading(snrs), rng=seed)
    for t, y in enumerate(seen):
        belief = engine.step(belief, {"seen_real": y.real, "seen_imaginary": y.imag})
        for k, delay in enumerate(DELAYS):
            if t >= delay:
                ones[k, t - delay] = belief.back(delay).probabilities("bit")[:, 1]
    for k, delay in enumerate(DELAYS):  # no more comes: the last ones have what there is
        for late in range(min(delay, len(seen))):
            ones[k, len(seen) - 1 - late] = belief.back(late).probabilities("bit")[:, 1]
    return {delay: p[1:] > 0.5 for delay, p in zip(DELAYS, ones, strict=True)}


def rates(
    snrs: Sequence[float], symbols: int, runs: int = 1, seed: int = SEED
) -> dict[str, np.ndarray]:
    """Shares of bits that are wrong by receiver, for each noise level, of as many repetitions."""
    every = [snr for snr in snrs for _ in range(runs)]
    own = sent(every, symbols, seed)
    signs = (own.seen * own.gain.conj()).real > 0
    told = {"differential": by_differences(own.seen)}
    told |= {f"delay {d}": bits for d, bits in by_streams(every, own.seen, seed).items()}
    told["channel known"] = signs[1:] == signs[:-1]
    wrong = {name: (bits != own.bits[1:]).mean(axis=0) for name, bits in told.items()}
    return {name: each.reshape(len(snrs), runs).mean(axis=1) for name, each in wrong.items()}


def floor() -> float:
    """What the differential detector comes to without noise: half of what neighbours do not share."""
    return float(0.5 - OWN.gain @ OWN.moves @ OWN.start @ OWN.gain)


def report(snrs: Sequence[float], found: dict[str, np.ndarray], symbols: int) -> None:
    """Print the table."""
    print(f"share of wrong bits among {symbols:_} for each noise level; {STREAMS} streams")
    print(f"{'SNR, dB':>9}" + "".join(f"{name:>15}" for name in found))
    for k, snr in enumerate(snrs):
        print(f"{snr:9}" + "".join(f"{share[k]:15.5f}" for share in found.values()))
    print(f"{'no noise':>9}{floor():15.5f}")


def draw(snrs: Sequence[float], found: dict[str, np.ndarray], stretch: int) -> Any:
    """Wrong bits against noise; a stretch of the channel, and what is believed of it."""
    own = sent([20.0], stretch)
    rows = {"seen_real": own.seen.real, "seen_imaginary": own.seen.imag}
    figure, panels = picture.axes([["bits", "gain"]], (12, 5))
    ax = panels["bits"]
    for name, share in found.items():
        style = {"differential": "s--", "channel known": "k:"}.get(name, "o-")
        ax.semilogy(snrs, np.where(share > 0, share, np.nan), style, label=name)
    ax.axhline(floor(), color=picture.FAINT, lw=1)
    ax.set(xlabel="SNR, dB", ylabel="share of wrong bits", title="bits")
    ax.legend(frameon=False)
    ax = panels["gain"]
    ax.plot(np.abs(own.gain[:, 0]), color=picture.EXACT, lw=2.5, label="gain")
    for delay, colour in ((0, picture.OTHER), (2, picture.DRAWS)):
        engine = bmc.ParticleFilter(
            STREAMS, marginalize="auto", proposal="optimal", delay=delay or None
        )
        believed = bmc.filter(fading([20.0]), rows, engine=engine, rng=SEED, queries={"size": size})
        ax.plot(believed.queries["size"][:, 0], color=colour, label=f"believed, delay {delay}")
    ax.set(xlabel="symbol", ylabel="size", title="a stretch of the channel at 20 dB")
    ax.legend(frameon=False)
    return figure


def size(real: np.ndarray, imaginary: np.ndarray) -> np.ndarray:
    """Of the gain; its sign cannot be told."""
    return np.hypot(np.vecdot(OWN.gain, real), np.vecdot(OWN.gain, imaginary))


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table, and draw it."""
    options = picture.options(__doc__, arguments)
    snrs = SNRS[::2] if options.fast else SNRS
    symbols, stretch = (50, 40) if options.fast else (SYMBOLS, 150)
    found = rates(snrs, symbols)
    report(snrs, found, symbols)
    picture.save(draw(snrs, found, stretch), options.out, "fading_channel")


if __name__ == "__main__":
    main()
