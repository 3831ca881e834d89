"""A few kills of the trial of ``python -m tests.kills``: processes that really end, disks that are full."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from tests import kills

pytest.importorskip("h5netcdf", reason="needs the extra netcdf")
pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked")


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_killed_runs_go_on(tmp_path: Path) -> None:
    case = kills.cases(0.1)["Metropolis"]
    rng = np.random.default_rng(4)
    found = kills.trial(case, tmp_path / "run.nc", 2, rng)
    assert found["same"] and found["kills"] == 2
    assert kills.full_disk(case, tmp_path / "run.nc", rng, 1)


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
@pytest.mark.parametrize("name", kills.cases())
def test_every_engine_goes_on(name: str, tmp_path: Path) -> None:
    case, rng = kills.cases(0.3)[name], np.random.default_rng()
    path = tmp_path / "run.nc"
    assert kills.trial(case, path, 5, rng)["same"]
    assert kills.full_disk(case, path, rng, 2)
    assert kills.cut_off(case, path, rng, 2)[0]
