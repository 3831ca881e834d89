"""What counts alarms spends nothing of the run's budget of false alarms."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext

import pytest

from bayesmc.testing import uncounted


@pytest.fixture(autouse=True)
def repetitions(request: pytest.FixtureRequest) -> Iterator[None]:
    """Tests of levels repeat a test many times, and judge the count."""
    name = request.node.name
    with uncounted() if "alarms" in name or "level" in name else nullcontext():
        yield
