"""Which reference models have a log density of free numbers with a gradient, and that it is one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bayesmc.errors import UnsupportedError
from bayesmc.network import pose
from bayesmc.structure.target import Target, target_of
from bayesmc.structure.unconstrained import UnconstrainedDensity, unconstrained_density
from references import CASES, Case
from tests.reference_densities import BY_NAME

#: models without hidden continuous nodes
FINITE = {"asia test1"}
#: models whose labels hang together, in a chain or in a condition on all of them: given labels, they have one
NOT_SUMMED = {"hmm_example", "eyes test1"}


def target(case: Case, root: Path) -> Target:
    question = case.question(root)
    return target_of(pose(question.net, question.evidence, question.inputs))


def finite_of(found: Target) -> list[str]:
    return [n for n in found.chain if found.model[n].is_discrete]


def start(density: UnconstrainedDensity) -> np.ndarray:
    states = density.target.states
    assert states is not None
    row = {n: v if density.target.is_known(n) else v[:1] for n, v in states.items()}
    return np.clip(density.unconstrain(row)[0], -3.0, 3.0)


@pytest.mark.parametrize("name", sorted(BY_NAME))
def test_every_model_has_a_gradient(name: str, reference_data: Path) -> None:
    """Along a random direction, beside differences of the sixth order."""
    found = target(BY_NAME[name], reference_data)
    finite = finite_of(found)
    if name in FINITE:
        with pytest.raises(UnsupportedError, match="no hidden node is continuous"):
            unconstrained_density(found)
        return
    values = {}
    if name in NOT_SUMMED:
        with pytest.raises(UnsupportedError, match="joint states"):
            unconstrained_density(found, None, finite)
        assert found.states is not None
        values, finite = {n: found.states[n][0] for n in finite}, []
    density = unconstrained_density(found, None, finite)
    rng = np.random.default_rng(0)
    u = start(density) + 0.1 * rng.normal(size=density.size)
    along = rng.normal(size=density.size)
    along /= np.linalg.norm(along)
    h = 1e-3
    value, slopes = density.with_gradient(u, values)
    assert np.isfinite(value)
    ups = density.value(u + h * np.arange(-3, 4)[:, None] * along, values)
    wanted = np.array([-1, 9, -45, 0, 45, -9, 1]) @ ups / (60 * h)
    assert slopes @ along == pytest.approx(wanted, rel=1e-6, abs=1e-7 * (1 + np.abs(ups).max()))


def test_how_many_there_are() -> None:
    assert (len(CASES), len(FINITE | NOT_SUMMED)) == (47, 3)
