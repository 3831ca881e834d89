"""All benchmarks in one run: ``make bench`` (``make peers`` first to have the peers beside)."""

from __future__ import annotations

import sys

from benchmarks import (
    bench_approximate,
    bench_exact,
    bench_fading,
    bench_fit,
    bench_gaussian,
    bench_gibbs,
    bench_marginal,
    bench_mean_field,
    bench_robot_logs,
    bench_robots,
    bench_scale,
    bench_slam,
    bench_switching,
    bench_time,
    bench_vision,
    bench_weighting,
    prices,
)
from benchmarks.harness import data_folder, peer_python

if __name__ == "__main__":
    if peer_python() is None:
        print("no peers installed: run `make peers` to have their figures beside\n")
    bench_scale.main()
    print()
    if data_folder().exists():
        bench_weighting.main()
        bench_exact.main()
        bench_gaussian.main()
    else:
        print(f"no networks at {data_folder()}: set BAYESMC_DATA to time them")
    print()
    bench_gibbs.main(sys.argv[1:])
    print()
    bench_time.main(sys.argv[1:])
    print()
    bench_switching.main()
    print()
    bench_approximate.main()
    print()
    bench_marginal.main()
    print()
    prices.main()
    print()
    bench_mean_field.main()
    print()
    bench_robots.main(sys.argv[1:])
    print()
    if "--short" not in sys.argv[1:]:  # many minutes
        if data_folder().exists():
            bench_fit.main()
            print()
        bench_fading.main()
        print()
        bench_robot_logs.main()
        print()
        bench_slam.main(())
        print()
        bench_vision.main()
