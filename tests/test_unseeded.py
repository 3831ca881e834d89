"""Draws without a seed are the same in every run of the suite (``seeded_by_name`` of conftest)."""

from __future__ import annotations

import random

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.testing import session


def test_what_has_no_seed_is_seeded_by_the_tests_name(request: pytest.FixtureRequest) -> None:
    named = random.Random(f"{session.seed()} {request.node.nodeid}")
    drawn = [np.random.SeedSequence().entropy for _ in range(3)]
    assert drawn == [named.getrandbits(128) for _ in range(3)]
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    first, second = (net.sample(10)["x"] for _ in range(2))
    assert not np.array_equal(first, second)
