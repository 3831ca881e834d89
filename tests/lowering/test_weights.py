"""Loops of particle filters in machine code, beside those in NumPy."""

from __future__ import annotations

import ctypes
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

from bayesmc.lowering.code import Module
from bayesmc.lowering.machine import loaded
from bayesmc.lowering.weights import loops
from bayesmc.resampling import stratified, systematic

pytest.importorskip("llvmlite", reason="llvmlite is not installed")


@lru_cache(maxsize=1)
def compiled() -> Any:
    module = Module()
    texts = loops(module)
    return loaded("\n".join([str(module), *texts]), module.foreign)


@pytest.mark.parametrize("n", [1, 2, 7, 100, 5000])
def test_weights_and_their_sums(n: int) -> None:
    log = np.random.default_rng(n).normal(size=n) * 30
    log[n // 2 :: 7] = -np.inf
    level, weights, sums = float(log.max()) if n > 1 else 0.0, np.empty(n), np.empty(2)
    types = [ctypes.c_int64, ctypes.c_double, *[ctypes.c_void_p] * 3]
    run = compiled().function("exponentials", None, *types)
    run(n, level, log.ctypes.data, weights.ctypes.data, sums.ctypes.data)
    np.testing.assert_allclose(weights, np.exp(log - level), rtol=1e-15)
    np.testing.assert_allclose(sums, [weights.sum(), weights @ weights], rtol=1e-13)


def test_resampling_takes_the_same_ancestors() -> None:
    whole, real, pointer = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p
    running = compiled().function("running", real, whole, pointer, pointer)
    first = [whole, whole, real, real]
    comb = compiled().function("systematic", None, *first, real, pointer, pointer)
    strata = compiled().function("stratified", None, *first, pointer, pointer, pointer)
    for seed in range(300):
        rng = np.random.default_rng(seed)
        n = int(rng.integers(1, 60))
        weights = rng.exponential(size=n) * rng.choice([0.0, 1.0, 1e-12, 1e6], size=n)
        if seed % 3 == 0:
            weights = np.ones(n)
        if not weights.any():
            weights[0] = 1.0
        draws = int(rng.integers(1, 80)) if seed % 2 else n
        sums, found = np.empty(n), np.zeros(draws + 1, np.int64)
        total = running(n, weights.ctypes.data, sums.ctypes.data)
        scale, shift = draws / total, (1.0 - np.random.default_rng(seed).random()) % 1.0
        arrays = sums.ctypes.data, found.ctypes.data
        comb(n, draws, scale, sums[-1] * scale + shift, shift, *arrays)
        expected = systematic(weights, draws, np.random.default_rng(seed))
        np.testing.assert_array_equal(found[:draws], expected, err_msg=str(seed))
        points = np.append(np.random.default_rng(seed).random(draws), 2.0)
        found[:] = 0
        strata(n, draws, scale, sums[-1] * scale, points.ctypes.data, *arrays)
        expected = stratified(weights, draws, np.random.default_rng(seed))
        np.testing.assert_array_equal(found[:draws], expected, err_msg=str(seed))
