"""Rows that the model draws may be more than functions take: filters answer, and say what they left out."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.engines.particles.predictive import Replicates
from bayesmc.errors import EngineWarning

COUNTS = np.repeat([1, 3, 6, 8, 10], 6)
LEVELS = np.arange(12.0)


def by_table(n: Any) -> bmc.Normal:
    """There is no thirteenth entry."""
    return bmc.Normal(LEVELS[n], 1.0)


def by_hand(n: Any) -> bmc.Normal:
    if np.any(np.asarray(n) > 11):
        raise RuntimeError("so many were never seen")
    return bmc.Normal(1.0 * n, 1.0)


def by_all(n: Any) -> bmc.Normal:
    return bmc.Normal(1.0 * n, 1.0)


def asked(reading: Callable[[Any], bmc.Normal]) -> Any:
    """Counts rise, and those that the model draws beside them rise further."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.3), initial=bmc.Normal(0.0, 0.1))
    dbn.add("n", lambda x: bmc.Poisson(np.exp(x)))
    dbn.add("k", reading)
    rows = {"n": COUNTS, "k": COUNTS.astype(float)}
    return bmc.filter(dbn, rows, engine=bmc.ParticleFilter(200), rng=0)


@pytest.mark.parametrize(
    "reading, said", [(by_table, "'k'.*IndexError"), (by_hand, "'k'.*never seen")]
)
def test_functions_that_break_on_drawn_rows_are_named(reading: Any, said: str) -> None:
    with pytest.warns(EngineWarning, match=f"slice \\d+: .*{said}") as caught:
        found = asked(reading)
    assert len(caught) == 1 and caught[0].filename == __file__
    compared = np.isfinite(found.row_ranks)
    assert 0 < compared.sum() < 8  # what was compared before stands
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        whole = asked(by_all)
    assert np.isfinite(whole.row_ranks).sum() > compared.sum()
    assert found.log_marginal_likelihood == whole.log_marginal_likelihood


def test_faults_of_the_comparison_itself_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: Any) -> None:
        raise TypeError("a fault of ours")

    monkeypatch.setattr(Replicates, "_judged", broken)
    with pytest.warns(EngineWarning, match="TypeError: a fault of ours"):
        asked(by_all)
