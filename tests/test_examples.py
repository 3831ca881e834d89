"""The examples run in smoke mode, and their nets say what the papers say."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import bayesmc as bmc
from examples import data_faithful, demo, diagnosis, old_faithful


@pytest.fixture(scope="module")
def tables() -> list[demo.Table]:
    return list(demo.questions(200_000))


def test_demo_prints_tables_and_writes_pictures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    demo.main(["--fast", "--out", str(tmp_path / "out")])
    printed = capsys.readouterr().out
    for figure in ("Monte Carlo error", "ESS", "seconds"):
        assert printed.count(figure) >= 6
    pictures = list((tmp_path / "out").iterdir())
    assert len(pictures) == 4
    for path in pictures:
        assert path.read_bytes().startswith(b"\x89PNG")
        assert str(path) in printed


def test_demo_engines_agree(tables: list[demo.Table]) -> None:
    """Every sampled figure lies within 4.5 of its Monte Carlo errors of the exact one.

    The false-alarm rate of that is below 1e-3 for all figures together, at a fixed seed, where at
    least 100 draws count; the table with one effective draw is left out.
    """
    checked = 0
    for table in tables:
        exact = [row for row in table.rows if row.errors == demo.EXACT]
        for row in exact[1:]:
            assert row.answers == pytest.approx(exact[0].answers)
        for row in table.rows:
            if row.ess is not None and row.ess > 100:
                difference = np.abs(np.subtract(row.answers, exact[0].answers))
                assert np.all(difference < 4.5 * np.array(row.errors)), (table.question, row)
                checked += 1
    assert checked == 8


def test_demo_says_what_does_not_work(tables: list[demo.Table]) -> None:
    refusals = [row.refusal for table in tables for row in table.rows if row.refusal]
    assert len(refusals) == 1
    assert "duration" in refusals[0]
    (warned,) = (table for table in tables if table.warned)
    assert min(row.ess for row in warned.rows if row.ess is not None) < 100


def test_chest_clinic_is_the_published_network(reference_data: Path) -> None:
    published = bmc.io.read(reference_data / "bn_discrete" / "bif" / "asia.bif.gz")
    names = {
        "asia": "asia", "tuberculosis": "tub", "smoking": "smoke", "cancer": "lung",
        "bronchitis": "bronc", "either": "either", "xray": "xray", "dyspnoea": "dysp",
    }  # fmt: skip
    net = diagnosis.chest_clinic()
    ours = bmc.infer(net, diagnosis.WITH_XRAY, engine=bmc.Exact())
    evidence = {names[name]: state for name, state in diagnosis.WITH_XRAY.items()}
    theirs = bmc.infer(published, evidence, engine=bmc.Exact())
    assert ours.log_marginal_likelihood == pytest.approx(theirs.log_marginal_likelihood)
    for name, other in names.items():
        # ours list no before yes, the file yes before no
        np.testing.assert_allclose(ours.probabilities(name), theirs.probabilities(other)[::-1])


def test_eruptions_are_the_published_table(reference_data: Path) -> None:
    table = np.genfromtxt(
        reference_data / "mixtures" / "faithful.csv", delimiter=",", skip_header=1
    )
    np.testing.assert_array_equal(np.array(data_faithful.ERUPTIONS), table[:, 1:])


def test_two_kinds_has_the_likelihood_of_the_published_fit() -> None:
    evidence = {"duration": old_faithful.DURATIONS, "waiting": old_faithful.WAITS}
    posterior = bmc.infer(old_faithful.two_kinds(), evidence, engine=bmc.Exact())
    assert posterior.log_marginal_likelihood == pytest.approx(old_faithful.LOG_LIKELIHOOD)


def test_closed_forms_hold_by_quadrature() -> None:
    """The comparisons that the demonstration prints are themselves held against sums on a grid."""
    net = old_faithful.two_kinds(1)
    grid = np.linspace(0.0, 8.0, 4001)
    density = np.stack([
        np.exp(net.log_prob({
            "kind": np.full((4001, 1), kind), "duration": grid[:, None],
            "waiting": np.full((4001, 1), 66.0),
        }))
        for kind in old_faithful.KINDS
    ])  # fmt: skip
    density /= density.sum()
    expected = density[1].sum(), density.sum(axis=0) @ grid
    assert old_faithful.kind_and_duration_given(66.0) == pytest.approx(expected)

    wait = old_faithful.typical_wait()
    waits = old_faithful.FIRST_LONG_WAITS
    grid = np.linspace(50.0, 110.0, 6001)
    joint = np.exp(
        wait.log_prob({"typical": grid, "wait": np.broadcast_to(waits, (6001, len(waits)))})
    )
    mass = joint / joint.sum()
    mean = mass @ grid
    sd = np.sqrt(mass @ (grid - mean) ** 2)
    log_p = np.log(joint.sum() * (grid[1] - grid[0]))
    assert old_faithful.typical_given(waits) == pytest.approx((mean, sd, log_p))
