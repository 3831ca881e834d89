"""Bits through a fading channel, 2 x 20,000 for each noise level, beside published shares of errors."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from benchmarks.harness import table
from examples import fading_channel

SYMBOLS, RUNS = 20_000, 2
#: SNR in dB -> delay -> share of wrong bits, and by which factor it may be off
EXPECTED = {10: (0, 0.054, 1.2), 20: (2, 0.0086, 1.2), 30: (2, 0.0013, 2.0)}
#: what the differential detector does not get below
FLOOR = 0.011


def main(arguments: Sequence[str] = ()) -> None:
    """Print shares of wrong bits; ``--seed N`` sends others."""
    seed = int(arguments[arguments.index("--seed") + 1]) if "--seed" in arguments else 1
    snrs = list(EXPECTED)
    found = fading_channel.rates(snrs, SYMBOLS, RUNS, seed)
    lines = []
    for k, (snr, (delay, wanted, factor)) in enumerate(EXPECTED.items()):
        share = float(found[f"delay {delay}"][k])
        is_near = max(share / wanted, wanted / max(share, 1e-9)) <= factor
        row = [found[f"delay {d}"][k] for d in fading_channel.DELAYS]
        both = found["differential"][k], found["channel known"][k]
        verdict = f"{wanted:g} at delay {delay}: {'within' if is_near else 'NOT within'} {factor:g}"
        lines.append([f"{snr} dB", *row, *both, verdict])
    title = f"share of wrong bits, {RUNS} x {SYMBOLS:_} symbols, {fading_channel.STREAMS} streams"
    names = [f"delay {d}" for d in fading_channel.DELAYS]
    print(table(title, ["SNR", *names, "differential", "channel known", "published"], lines))
    print(f"the differential detector without noise: {fading_channel.floor():.4f} ({FLOOR})")


if __name__ == "__main__":
    main(sys.argv[1:])
