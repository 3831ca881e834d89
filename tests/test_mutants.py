"""Every planted fault is caught, and every test passes without its fault; the harness notices when not.

One fixed seed each; ``python -m tests.mutants`` takes 100 fresh ones. All tests have a false-alarm rate of
1e-6, and their sizes are such that a fault is missed less often than once in ten thousand seeds.
"""

from __future__ import annotations

import inspect

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.kernels import densities
from bayesmc.testing.densities.density import check_density
from bayesmc.testing.verdict import BUDGET, Verdict
from tests.mutants.__main__ import main
from tests.mutants.catalogue import MUTANTS
from tests.mutants.faults import Constant, Edit, StaleFault, planted
from tests.mutants.mutant import ALPHA, Mutant, examined, tried

WHERE = "bayesmc.distributions.discrete:DiscreteUniform._sample"
FAULT = Edit(WHERE, "endpoint=True", "endpoint=False")


def check(seed: int) -> Verdict:
    return check_density(bmc.DiscreteUniform(2, 9), draws=1000, alpha=ALPHA, rng=seed)


def blind(seed: int) -> Verdict:
    """Looks the other way, but draws what is wrong."""
    found = bmc.DiscreteUniform(2, 9).sample(seed, 50).mean()
    return Verdict("blind", ALPHA, check(seed).comparisons[-1:] if found > 100 else ())


@pytest.mark.parametrize(
    "mutant",
    [pytest.param(m, id=m.name, marks=[pytest.mark.thorough] * m.is_long) for m in MUTANTS],
)
def test_caught(mutant: Mutant) -> None:
    trial = tried(mutant, 1)
    assert not trial.broken, trial.broken
    assert not trial.alarm, "an alarm without the fault"
    assert not trial.idle, "the fault changes no figure of the test"
    assert trial.caught, f"missed: p = {trial.p_value:.2g}"


def test_there_are_enough() -> None:
    assert len(MUTANTS) >= 30
    assert len({m.name for m in MUTANTS}) == len(MUTANTS)


# ---- the harness ------------------------------------------------------------------------------------


def test_caught_and_counted() -> None:
    spent = dict(BUDGET.spent)
    row = examined(Mutant("last integer", (FAULT,), check, "check_density"), range(3))
    assert (row.caught, row.alarms, row.problems) == (3, 0, [])
    assert row.mutant.where == "distributions.discrete:DiscreteUniform._sample"
    assert BUDGET.spent == spent


def test_a_miss_is_reported() -> None:
    row = examined(Mutant("missed", (FAULT,), blind, "nothing"), range(2))
    assert row.caught == 0
    assert "not caught at 2 of 2 seeds, as 0" in row.problems


def test_a_fault_elsewhere_is_reported() -> None:
    elsewhere = Edit("bayesmc.kernels.densities:accepted", "< log_ratio", "< 2.0 * log_ratio")
    row = examined(Mutant("elsewhere", (elsewhere,), check, "check_density"), range(2))
    assert any("same figures" in problem for problem in row.problems)


def test_an_alarm_without_the_fault_is_reported() -> None:
    def wrong(seed: int) -> Verdict:
        odd = bmc.Density(lambda x: np.log(3 * x), support="unit interval")
        return check_density(odd, alpha=ALPHA, rng=seed)

    row = examined(Mutant("alarm", (FAULT,), wrong, "check_density"), range(2))
    assert row.alarms == 2
    assert any(
        problem.startswith("an alarm without the fault at 2 seeds") for problem in row.problems
    )


def test_an_error_is_no_catch() -> None:
    broken = Edit(WHERE, "endpoint=True", "endpoints=True")

    def test(seed: int) -> Verdict:
        bmc.DiscreteUniform(2, 9).sample(seed, 10)
        return check(seed)

    row = examined(Mutant("broken", (broken,), test, "check_density"), range(1))
    assert row.caught == 0
    assert any("with the fault: TypeError" in problem for problem in row.problems)


def test_no_verdict_is_no_catch() -> None:
    row = examined(Mutant("no verdict", (FAULT,), lambda seed: False, "bool"), range(1))  # type: ignore[arg-type, return-value]
    assert any("no verdict but False" in problem for problem in row.problems)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (Edit(WHERE, "endpoint=None", "endpoint=False"), "0 times, not once"),
        (Edit(WHERE, "self.", "other."), "2 times, not once"),
        (Edit(WHERE, "endpoint=True", "endpoint=True "), "changes nothing"),
        (Edit(WHERE + "d", "a", "b"), "there is no '_sampled'"),
        (Edit("bayesmc.resampling.schemes:SCHEMES", "a", "b"), "is no function"),
        (Constant("bayesmc.kernels.slice:GROWTH", 64), "is 64 already"),
    ],
)  # fmt: skip
def test_a_fault_that_the_library_has_outgrown(fault: Edit | Constant, words: str) -> None:
    with pytest.raises(StaleFault, match=words), planted(fault):
        pass


def test_the_library_is_then_as_before() -> None:
    codes = [f.__code__ for f in (bmc.DiscreteUniform._sample, densities.accepted)]
    before = [repr(c) for c in check(5).comparisons]
    for mutant in (m for m in MUTANTS if "ratio is squared" in m.name):
        with planted(*mutant.faults):
            assert densities.accepted.__code__ is not codes[1]
    with pytest.raises(RuntimeError), planted(FAULT, Constant("bayesmc.kernels.slice:GROWTH", 3)):
        raise RuntimeError  # an error within leaves nothing behind, either
    assert bmc.DiscreteUniform._sample.__code__ is codes[0]
    assert densities.accepted.__code__ is codes[1]
    assert inspect.getmodule(densities.accepted) is densities
    assert [repr(c) for c in check(5).comparisons] == before


def test_the_table(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    good = Mutant("last integer", (FAULT,), check, "check_density, 1000 draws")
    bad = Mutant("last integer, unseen", (FAULT,), blind, "nothing")
    monkeypatch.setattr("tests.mutants.__main__.MUTANTS", (good, bad))
    assert main(["--seeds", "2", "--only", "1000 DRAWS", "--seed", "3", "--jobs", "1"]) == 0
    out = capsys.readouterr().out
    assert "| last integer | distributions.discrete:DiscreteUniform._sample |" in out
    assert "| 2 of 2 | 0 |" in out and "--seed 3 repeats them" in out
    assert main(["--seeds", "2", "--seed", "3", "--jobs", "2"]) == 1
    out = capsys.readouterr().out
    assert "not caught at 2 of 2 seeds, as 3" in out and "1 of 2 mutants caught" in out
    assert main(["--only", "no such thing"]) == 1
