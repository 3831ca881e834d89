"""The exact law of Pearson's statistic, against enumeration of all samples and against its limit."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import scipy.special

from bayesmc.testing import uniformity_p_value


def samples(total: int, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """All count vectors and their multinomial probabilities."""
    heads = itertools.product(range(total + 1), repeat=cells - 1)
    counts = np.array([(*head, total - sum(head)) for head in heads if sum(head) <= total])
    log_prob = math.lgamma(total + 1) - scipy.special.gammaln(counts + 1.0).sum(axis=1)
    return counts, np.exp(log_prob - total * math.log(cells))


@pytest.mark.parametrize(("total", "cells"), [(1, 2), (5, 3), (12, 4), (9, 7), (40, 3), (150, 2)])
def test_tail_equals_enumeration(total: int, cells: int) -> None:
    counts, prob = samples(total, cells)
    uneven = (counts**2).sum(axis=1)
    for value in np.unique(uneven):
        exact = prob[uneven >= value].sum()
        found = uniformity_p_value(counts[uneven == value][0])
        assert found == pytest.approx(exact, rel=1e-6, abs=2e-12)


def test_limit_is_good_in_the_middle_and_wrong_in_the_tail() -> None:
    even, far = (
        np.array([20, 30, 25, 24, 26, 21, 29, 25]),
        np.array([53, 21, 21, 21, 21, 21, 21, 21]),
    )
    pearson = [8 / 200 * ((c - 25) ** 2).sum() for c in (even, far)]
    limit = [scipy.special.chdtrc(7, p) for p in pearson]
    assert uniformity_p_value(even) == pytest.approx(limit[0], rel=0.02)
    assert uniformity_p_value(far) > 1.3 * limit[1]


def test_limit_takes_over_smoothly() -> None:
    """Whatever the size, p-values at the 1e-4 level stay within a few per cent of the limit."""
    for total in (1500, 3000, 6000, 60000):
        step = round(math.sqrt(35.0 * total / 10 / 10))
        counts = np.full(10, total // 10) + step * np.array([1, -1] * 5)
        pearson = 10 / total * ((counts - total / 10) ** 2).sum()
        limit = scipy.special.chdtrc(9, pearson)
        assert 1e-5 < limit < 1e-3
        assert uniformity_p_value(counts) == pytest.approx(limit, rel=0.05)


def test_smallest_value_stands_for_less() -> None:
    assert uniformity_p_value([500, 0, 0, 0]) == 1e-12
    assert uniformity_p_value([50000, 0, 0, 0]) == 1e-12
    assert uniformity_p_value([0, 0, 0]) == 1.0


@pytest.mark.parametrize("counts", [[3], [[1, 2]], [1, -1], [0.5, 1.0]])
def test_not_counts(counts: list) -> None:
    with pytest.raises(ValueError, match="whole numbers, nonnegative"):
        uniformity_p_value(counts)
