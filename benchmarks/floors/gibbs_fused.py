"""The samplers fused by numba, one chain, one thread: what NumPy's floors are measured against.

Runs in an environment that has numba (that of the peers), from the root of the repository, and
imports nothing of bayesmc. ``python -m benchmarks.floors.gibbs_fused`` compiles when first asked;
each line on stdin is an object ``{"job": name, "size": n, "sweeps": s}`` with the job ``mixture``,
``discrete`` or ``ising``, and is answered by ``{"seconds": ..., "updates": ...}``. The end of
stdin ends it.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable
from functools import cache
from typing import Any

import numba
import numpy as np

from benchmarks import models, models_gibbs
from benchmarks.floors import bif, gibbs_discrete
from benchmarks.harness import network

Job = Callable[[int], int]  # sweeps to updates made


def main() -> None:
    """Serve until stdin ends."""
    for line in sys.stdin:
        asked = json.loads(line)
        run = _prepared(asked["job"], asked["size"])
        start = time.perf_counter()
        updates = run(asked["sweeps"])
        seconds = time.perf_counter() - start
        print(json.dumps({"seconds": seconds, "updates": updates}), flush=True)


@cache
def _prepared(job: str, size: int) -> Job:
    run = {"mixture": _mixture, "discrete": _discrete, "ising": _ising}[job](size)
    run(1)  # compiles
    return run


def _mixture(size: int) -> Job:
    points = models_gibbs.mixture_points(size)
    prior = models_gibbs.MIXTURE_PRIOR
    numbers = prior.concentration, prior.variance, prior.df, prior.scatter
    means = np.array(models_gibbs.MIXTURE_START)
    statistics = np.zeros((3, 6))
    x, y = points.T
    sums = [(x * x).sum(), (x * y).sum(), (y * y).sum(), x.sum(), y.sum(), size]
    statistics[:] = np.array(sums) / 3.0
    rng = np.random.Generator(np.random.SFC64(1))

    def run(sweeps: int) -> int:
        _mixture_sweeps(points, means, statistics, numbers, sweeps, rng)
        return sweeps * size

    return run


@numba.njit
def _mixture_sweeps(points, means, statistics, prior, sweeps, rng):  # noqa: ANN001, ANN202
    linear = np.empty((3, 6))
    for _ in range(sweeps):
        for k in range(3):
            _component(statistics[k], means[k], linear[k], prior, rng)
        linear[1] -= linear[0]
        linear[2] -= linear[0]
        statistics[:] = 0.0
        for i in range(len(points)):
            x, y = points[i]
            a, b = linear[1], linear[2]
            one = math.exp(
                min(x * (a[0] * x + a[1] * y + a[3]) + y * (a[2] * y + a[4]) + a[5], 300.0)
            )
            two = math.exp(
                min(x * (b[0] * x + b[1] * y + b[3]) + y * (b[2] * y + b[4]) + b[5], 300.0)
            )
            u = rng.random() * (1.0 + one + two)
            s = statistics[(u >= 1.0) + (u >= 1.0 + one)]
            s[0] += x * x
            s[1] += x * y
            s[2] += y * y
            s[3] += x
            s[4] += y
            s[5] += 1.0


@numba.njit
def _component(row, mean, linear, prior, rng):  # noqa: ANN001, ANN202
    concentration, variance, df, scatter = prior
    xx, xy, yy, x, y, n = row
    m0, m1 = mean
    a = scatter + xx - 2.0 * m0 * x + n * m0 * m0
    b = xy - m0 * y - m1 * x + n * m0 * m1
    c = scatter + yy - 2.0 * m1 * y + n * m1 * m1
    l00 = math.sqrt(c / (a * c - b * b))
    l10 = -b / c * l00
    chi = math.sqrt(2.0 * rng.standard_gamma(0.5 * (df + n)))
    u00 = l00 * chi
    u10 = l10 * chi + rng.standard_normal() / math.sqrt(c)
    u11 = math.sqrt(2.0 * rng.standard_gamma(0.5 * (df + n - 1.0)) / c)
    p00, p01, p11 = u00 * u00, u00 * u10, u10 * u10 + u11 * u11
    q00, q01, q11 = 1.0 / variance + n * p00, n * p01, 1.0 / variance + n * p11
    h0, h1 = p00 * x + p01 * y, p01 * x + p11 * y
    det = q00 * q11 - q01 * q01
    r00 = math.sqrt(q00)
    r10 = q01 / r00
    y1 = rng.standard_normal() / math.sqrt(q11 - r10 * r10)
    m0 = (q11 * h0 - q01 * h1) / det + (rng.standard_normal() - r10 * y1) / r00
    m1 = (q00 * h1 - q01 * h0) / det + y1
    mean[0], mean[1] = m0, m1
    h0, h1 = p00 * m0 + p01 * m1, p01 * m0 + p11 * m1
    linear[0], linear[1], linear[2], linear[3], linear[4] = -0.5 * p00, -p01, -0.5 * p11, h0, h1
    log_weight = math.log(rng.standard_gamma(concentration + n))
    linear[5] = log_weight + 0.5 * math.log(p00 * p11 - p01 * p01) - 0.5 * (m0 * h0 + m1 * h1)


def _discrete(size: int) -> Job:
    """ALARM with the evidence of ``models``; ``size`` is unused: there is one chain."""
    records = bif.read(network("alarm"))
    nodes, codes = bif.as_arrays(records), bif.codes(records, models.ALARM_EVIDENCE)
    net = gibbs_discrete.read(nodes, codes)
    state = gibbs_discrete.start(net, 1, np.random.default_rng(1))[:, 0].astype(np.int64)
    width, offset = max(net.cards), 0
    tables: list[Any] = []
    begin: list[int] = []  # of each factor in the tables
    terms: list[tuple[int, int]] = []  # (node, stride), factor after factor
    term_ends: list[int] = []  # of each factor
    factor_ends: list[int] = []  # of each node
    for i in net.order:
        for factor in net.around[i]:
            index, table = gibbs_discrete.aligned(factor, i, net.cards)
            terms += index
            term_ends.append(len(terms))
            begin.append(offset)
            offset += table.shape[1]
            tables.append(np.pad(table.T, ((0, 0), (0, width - len(table)))))
        factor_ends.append(len(begin))
    lists = [np.vstack(tables), begin, terms, term_ends, factor_ends, net.order, net.cards]
    arrays = [np.ascontiguousarray(part) for part in lists]
    counts = np.zeros((len(net.cards), width), np.int64)
    rng = np.random.Generator(np.random.SFC64(1))

    def run(sweeps: int) -> int:
        _discrete_sweeps(state, counts, *arrays, sweeps, rng)
        return sweeps * len(net.cards)

    return run


@numba.njit
def _discrete_sweeps(  # noqa: ANN202
    state,
    counts,
    table,
    begin,
    terms,
    term_ends,
    factor_ends,
    order,
    cards,
    sweeps,
    rng,  # noqa: ANN001
):
    sums = np.empty(table.shape[1])
    for _ in range(sweeps):
        term, factor = 0, 0
        for n in range(len(order)):
            i = order[n]
            card = cards[i]
            sums[:card] = 1.0
            while factor < factor_ends[n]:
                row = begin[factor]
                while term < term_ends[factor]:
                    row += terms[term, 1] * state[terms[term, 0]]
                    term += 1
                for j in range(card):
                    sums[j] *= table[row, j]
                factor += 1
            for j in range(1, card):
                sums[j] += sums[j - 1]
            u, code = rng.random() * sums[card - 1], 0
            for j in range(card - 1):
                code += u >= sums[j]
            state[i] = code
            counts[i, code] += 1


def _ising(size: int) -> Job:
    spins = np.ones((size, size), np.int8)
    around = np.arange(-4, 5)
    field = models_gibbs.COUPLING * around + models_gibbs.FIELD
    up = 1.0 / (1.0 + np.exp(-2.0 * field))
    rng = np.random.Generator(np.random.SFC64(1))

    def run(sweeps: int) -> int:
        _ising_sweeps(spins, up, sweeps, rng)
        return sweeps * size * size

    return run


@numba.njit
def _ising_sweeps(spins, up, sweeps, rng):  # noqa: ANN001, ANN202
    rows, columns = spins.shape
    for _ in range(sweeps):
        for r in range(rows):
            for c in range(columns):
                around = 4
                if r > 0:
                    around += spins[r - 1, c]
                if r < rows - 1:
                    around += spins[r + 1, c]
                if c > 0:
                    around += spins[r, c - 1]
                if c < columns - 1:
                    around += spins[r, c + 1]
                spins[r, c] = 1 if rng.random() < up[around] else -1


if __name__ == "__main__":
    main()
