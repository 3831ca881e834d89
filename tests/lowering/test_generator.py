"""Random numbers of machine code are those of NumPy's generator, and leave it in the same state."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import pytest

from bayesmc.lowering import generator
from bayesmc.lowering.machine import loaded

pytest.importorskip("llvmlite", reason="llvmlite is not installed")


def normals(rng: np.random.Generator, count: int) -> np.ndarray:
    """Drawn by machine code; the generator goes on behind them."""
    state, tables, found = generator.state_of(rng), generator.ziggurat(), np.empty(count)
    pointers = [ctypes.c_void_p] * 3
    run = loaded(*generator.text()).function("normals", None, ctypes.c_int64, *pointers)
    run(count, state.ctypes.data, tables.ctypes.data, found.ctypes.data)
    generator.put_state(rng, state)
    return found


@pytest.mark.parametrize("seed", range(5))
def test_normals_are_numpys(seed: int) -> None:
    one, other = (np.random.Generator(np.random.SFC64(seed)) for _ in range(2))
    for count in (1, 7, 200_000):  # of the many, some fifty lie in the tail
        np.testing.assert_allclose(
            normals(one, count), other.standard_normal(count), rtol=1e-15, atol=0.0
        )
        assert one.random() == other.random()
    assert one.integers(1 << 60) == other.integers(1 << 60)


def test_a_generator_of_another_kind_is_refused() -> None:
    with pytest.raises(TypeError, match="PCG64"):
        generator.state_of(np.random.default_rng(0))


@pytest.fixture
def afresh() -> Any:
    generator.is_numpys.cache_clear()
    yield
    generator.is_numpys.cache_clear()


@pytest.mark.parametrize("fault", ["widths", "bounds", "heights"])
@pytest.mark.usefixtures("afresh")
def test_another_ziggurat_is_not_numpys(fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert generator.is_numpys()
    tables = generator.ziggurat().copy()
    if fault == "widths":
        tables[0, 17] *= 1.0 + 1e-9
    elif fault == "bounds":
        tables.view(np.int64)[1, 17] -= 1 << 48
    else:
        tables[2] *= 0.9
    monkeypatch.setattr(generator, "ziggurat", lambda: tables)
    generator.is_numpys.cache_clear()
    assert not generator.is_numpys()
