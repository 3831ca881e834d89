from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import pytest


@pytest.fixture(scope="session")
def processes() -> Iterator[ProcessPoolExecutor]:
    """Two processes that import what they need themselves."""
    pytest.importorskip("cloudpickle", reason="units travel by cloudpickle: bayesmc[workers]")
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        yield pool
