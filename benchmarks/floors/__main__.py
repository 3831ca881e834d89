"""The floors beside the peers: ``python -m benchmarks.floors`` (``make peers`` first)."""

from __future__ import annotations

from benchmarks import models
from benchmarks.floors import bif, lw_discrete, lw_hybrid
from benchmarks.harness import (
    DOES_NOT_COUNT,
    LW_BASELINE,
    Peer,
    interleave,
    network,
    reached,
    table,
)

DRAWS = 100_000


def main() -> None:
    """Time and print; a floor that misses its baseline says so."""
    path = network("alarm")
    records = bif.read(path)
    nodes, evidence = bif.as_arrays(records), bif.codes(records, models.ALARM_EVIDENCE)
    seeds = iter(range(10**6))
    floor = lw_discrete.likelihood_weighting
    with Peer("lw-pgmpy", path, DRAWS) as pgmpy, Peer("lw-pyagrum", path, DRAWS) as pyagrum:
        times = interleave(
            {
                "floor, uint32": lambda: floor(nodes, evidence, DRAWS, next(seeds)),
                "floor, float32": lambda: floor(
                    nodes, evidence, DRAWS, next(seeds), uniforms="float32"
                ),
                "hybrid floor": lambda: lw_hybrid.likelihood_weighting(DRAWS, next(seeds)),
                "lw-pgmpy": pgmpy.timed(models.ALARM_EVIDENCE),
                "lw-pyagrum": pyagrum.timed(models.ALARM_EVIDENCE),
            },
            repeats=5,
        )
    own = times["floor, uint32"].median
    rows = []
    for name, time in times.items():
        wanted = LW_BASELINE.get(name)
        verdict = "" if not wanted or reached(own, time.median, wanted) else DOES_NOT_COUNT
        rows.append([name, 1e3 * time.median, time.median / own, wanted or "", verdict])
    header = ["likelihood weighting", "ms", "over the floor", "baseline", ""]
    print(table(f"{DRAWS} draws; ALARM, and the hybrid net", header, rows))


if __name__ == "__main__":
    main()
