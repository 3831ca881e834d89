"""The pytest plugin, seen from runs of pytest inside the test: seeds, the fixture ``rng``, the budget's line.

What the inner tests find is read from files that they write, so that runs can be compared.
"""

from __future__ import annotations

import os
import re
import shlex
import types
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest
import scipy.stats

import _bayesmc_pytestplugin as plugin
from bayesmc.testing import session
from bayesmc.testing.verdict import BUDGET, Comparison, Verdict, counted, uncounted

pytest_plugins = "pytester"

CONFTEST = Path(__file__).resolve().parents[1] / "conftest.py"

#: asks the session while the module is imported, and writes down what each test draws
DRAWING = """
import json, os, pathlib
import pytest
from bayesmc.testing import session

RUN = [session.seed(), session.is_thorough(), session.scaled(10)]

@pytest.fixture
def noted(rng, request):
    yield
    found = {"run": RUN, "environment": os.environ["BAYESMC_SEED"], "draw": rng.bytes(8).hex()}
    pathlib.Path(os.environ["NOTES"], request.node.name).write_text(json.dumps(found))

@pytest.mark.xdist_group("together")
@pytest.mark.parametrize("k", [1, 2])
def test_like(k, noted): pass

def test_other(noted): pass
"""

#: five calls of two tests spend 0.05 and 0.6
SPENDING = """
import pytest
from bayesmc.testing.verdict import Verdict, counted

@pytest.mark.parametrize("k", range(3))
def test_right(k):
    counted(Verdict("rank_test", 0.2, []))

@pytest.mark.parametrize("k", range(2))
def test_more(k):
    counted(Verdict("geweke_test", 0.025, []))
"""


@pytest.fixture(autouse=True)
def apart(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Inner runs have their own seed, and spend nothing of the outer run's budget."""
    monkeypatch.delenv("BAYESMC_SEED", raising=False)
    monkeypatch.delenv("BAYESMC_THOROUGH", raising=False)
    with uncounted():
        yield


class Runs:
    """Runs of one test file, in this process (workers of pytest-xdist are processes in any case)."""

    def __init__(self, pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
        self._pytester, self._monkeypatch, self._count = pytester, monkeypatch, 0

    def __call__(self, *options: str, source: str = DRAWING) -> tuple[str, dict[str, str]]:
        """Output, and what the tests have written down."""
        self._count += 1
        notes = self._pytester.mkdir(f"notes{self._count}")
        self._monkeypatch.setenv("NOTES", str(notes))
        if not any("::" in option for option in options):
            options = (*options, "test_inner.py")
        self._pytester.makepyfile(test_inner=source)
        done = self._pytester.runpytest_inprocess("-p", "no:cacheprovider", *options)
        assert done.ret == 0, done.stdout.str() + done.stderr.str()
        return done.stdout.str(), {file.name: file.read_text() for file in notes.iterdir()}

    def refused(self, *options: str) -> str:
        self._pytester.makepyfile(test_inner=DRAWING)
        done = self._pytester.runpytest_inprocess(*options)
        assert done.ret == pytest.ExitCode.USAGE_ERROR
        return done.stderr.str()


@pytest.fixture
def runs(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> Runs:
    return Runs(pytester, monkeypatch)


def said(output: str) -> list[str]:
    return [line for line in output.splitlines() if line.startswith("bayesmc: ")]


# ---- seeds --------------------------------------------------------------------------------------


def test_an_ordinary_run_has_seed_zero_and_says_nothing(runs: Runs) -> None:
    output, notes = runs()
    assert len(notes) == 3
    assert all('"run": [0, false, 10], "environment": "0"' in note for note in notes.values())
    assert said(output) == []


def test_the_option_gives_the_seed(runs: Runs, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BAYESMC_SEED", "9")
    output, notes = runs("--bayesmc-seed", "7")
    assert all('"run": [7, false, 10], "environment": "7"' in note for note in notes.values())
    assert said(output) == ["bayesmc: seed 7"]
    assert os.environ["BAYESMC_SEED"] == "9"  # as it was


def test_the_environment_gives_the_seed(runs: Runs, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BAYESMC_SEED", "9")
    _, notes = runs()
    assert all('"run": [9, false, 10]' in note for note in notes.values())
    monkeypatch.setenv("BAYESMC_SEED", "")
    monkeypatch.setenv("BAYESMC_THOROUGH", "0")
    _, notes = runs()
    assert all('"run": [0, false, 10]' in note for note in notes.values())


def test_a_thorough_run_is_fresh_and_can_be_repeated(runs: Runs) -> None:
    output, notes = runs("--bayesmc-thorough", "-q")
    (line,) = said(output)
    again = re.fullmatch(r"bayesmc: repeat with (--bayesmc-thorough --bayesmc-seed (\d+))", line)
    assert again
    assert all(f'"run": [{again[2]}, true, 80]' in note for note in notes.values())
    assert runs(*again[1].split())[1] == notes
    other, differing = runs("--bayesmc-thorough")
    assert set(differing.values()).isdisjoint(notes.values())
    header, last = said(other)
    assert header.startswith("bayesmc: thorough run with seed ")
    assert last.endswith(header.split()[-1])


@pytest.mark.parametrize("text", ["-1", "x", "1.5", "", "²"])
def test_a_wrong_seed_is_refused(runs: Runs, text: str) -> None:
    expected = f"argument --bayesmc-seed: {text!r} is not a seed; give a nonnegative whole number"
    assert expected in runs.refused(f"--bayesmc-seed={text}")


def test_a_wrong_seed_in_the_environment_is_refused(
    runs: Runs, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("BAYESMC_SEED", "seven")
    fault = "environment variable BAYESMC_SEED: 'seven' is not a seed"
    assert f"{fault}; give a nonnegative whole number" in runs.refused()
    runs("--bayesmc-seed=1")  # the option goes before
    with pytest.raises(ValueError, match=fault):  # without pytest
        session.seed()


def test_the_plugin_may_be_named_in_a_conftest_file(runs: Runs, pytester: pytest.Pytester) -> None:
    pytester.makeconftest("pytest_plugins = ['_bayesmc_pytestplugin']")
    options = ("-p", "no:bayesmc", "-W", "ignore::pytest.PytestAssertRewriteWarning")
    output, notes = runs(*options, "--bayesmc-seed", "7")
    assert said(output) == ["bayesmc: seed 7"]
    assert notes == runs("-p", "no:bayesmc", *options, "--bayesmc-seed", "7")[1]


# ---- the fixture --------------------------------------------------------------------------------


def test_draws_depend_on_the_seed_and_the_test_alone(runs: Runs) -> None:
    _, notes = runs()
    assert len(set(notes.values())) == 3
    assert runs()[1] == notes
    backwards = ["test_other", "test_like[2]", "test_like[1]"]
    assert runs(*(f"test_inner.py::{name}" for name in backwards))[1] == notes
    assert runs("-k", "other")[1] == {"test_other": notes["test_other"]}
    assert set(runs("--bayesmc-seed=1")[1].values()).isdisjoint(notes.values())


def test_a_project_may_have_its_own_rng(pytester: pytest.Pytester) -> None:
    pytester.makeconftest("import pytest\n@pytest.fixture\ndef rng(): return 'its own'")
    pytester.makepyfile("def test_it(rng): assert rng == 'its own'")
    pytester.runpytest_inprocess().assert_outcomes(passed=1)


# ---- the budget ---------------------------------------------------------------------------------


def test_the_budget_of_a_run_is_said(runs: Runs) -> None:
    counted(Verdict("before", 0.5, []))  # by whoever ran in this process before
    output, _ = runs("-q", source=SPENDING)
    line = "bayesmc: 5 statistical tests spent a false-alarm budget of 0.65 (seed 0)"
    assert said(output) == [line]
    output, _ = runs("-v", source=SPENDING)
    found = output.splitlines()
    assert found[found.index(line) :][1:3] == ["  rank_test: 0.6 in 3", "  geweke_test: 0.05 in 2"]


def test_workers_share_a_fresh_seed_and_their_budgets_are_summed(runs: Runs) -> None:
    source = DRAWING + SPENDING
    # a test's id ends in the name of its group then
    workers = ("-n", "2", "--dist", "loadgroup")
    output, notes = runs("--bayesmc-thorough", "-q", *workers, source=source)
    (line,) = said(output)
    found = re.fullmatch(
        "bayesmc: 5 statistical tests spent a false-alarm budget of 0.65 "
        r"\(repeat with (--bayesmc-thorough --bayesmc-seed (\d+))\); "
        "chance explains at most 0.65 failures on average, hardly ever more than 4",
        line,
    )
    assert found
    assert len(notes) == 3
    assert all(f'"run": [{found[2]}, true, 80]' in note for note in notes.values())
    alone, noted = runs(*found[1].split(), "-q", source=source)
    assert said(alone) == [line]
    assert noted == notes


def test_a_worker_that_ended_early_is_named() -> None:
    run = plugin.Run(seed=0, thorough=False)
    config = types.SimpleNamespace(stash={plugin.RUN: run})
    for worker, output in {"gw0": {"bayesmc_budget": [{"a": 0.25}, {"a": 1}]}, "gw1": None}.items():
        gateway = types.SimpleNamespace(id=worker)
        node = types.SimpleNamespace(config=config, gateway=gateway, workeroutput=output)
        plugin.pytest_testnodedown(node)
    assert plugin._summary(run, run.workers, by_test=False) == [
        "bayesmc: 1 statistical test spent a false-alarm budget of 0.25 (seed 0); "
        "not counted: gw1, which ended early"
    ]


# ---- verdicts of failing tests ------------------------------------------------------------------

FAILING = """
import pytest
from bayesmc.testing.verdict import Comparison, Verdict, counted

def verdict(test, p=1e-9, count=1):
    made = [Comparison(f"mean of {test} {k} " + "x" * 80, 1.0, 2.0, 9.0, p) for k in range(count)]
    return counted(Verdict(test, 0.001, made))

def test_passes():
    assert not verdict("quiet")

@pytest.mark.parametrize("k", [1])
@pytest.mark.xdist_group("together")
def test_fails(k):
    assert verdict("right", p=0.5)
    assert not verdict("wanted")
    assert verdict("wrong", count=3)

def test_other():
    assert 1 == 2

class TestMany:
    def test_many(self):
        for k in range(9):
            assert not verdict(f"number {k // 2}")
        for k in range(7):
            assert not verdict(f"late {k}")
        assert False

@pytest.mark.xfail
def test_expected():
    assert verdict("expected")

@pytest.fixture
def broken():
    assert verdict("fixture")

def test_of_a_fixture(broken): pass

@pytest.fixture
def late():
    yield
    assert False

def test_twice(late):
    assert verdict("once")
"""


def sections(output: str) -> list[list[str]]:
    """Lines below each heading of ours."""
    pattern = r"^-+ bayesmc verdicts -+\n(.*?^the same again: [^\n]*)$"
    return [found.split("\n") for found in re.findall(pattern, output, flags=re.M | re.S)]


@pytest.mark.parametrize(
    "workers", [(), ("-n", "1", "--dist", "loadgroup")], ids=["alone", "worker"]
)
def test_a_failing_test_shows_its_false_verdicts_whole(
    pytester: pytest.Pytester, workers: tuple[str, ...]
) -> None:
    pytester.makepyfile(test_inner=FAILING)
    done = pytester.runpytest_inprocess("-p", "no:cacheprovider", "--bayesmc-seed=3", *workers)
    done.assert_outcomes(failed=4, passed=1, errors=2, xfailed=1)
    output = done.stdout.str()
    found = {s[-1].rsplit("::")[-1]: s for s in sections(output)}
    assert len(sections(output)) == len(found)
    # not test_passes, whose false verdict was wanted, nor what others have left to test_other
    assert set(found) == {"test_fails[1]'", "test_many", "test_of_a_fixture", "test_twice"}
    figures = [Comparison(f"mean of wrong {k} " + "x" * 80, 1.0, 2.0, 9.0, 1e-9) for k in range(3)]
    assert found["test_fails[1]'"][2:] == [
        *repr(Verdict("wrong", 0.001, figures)).split("\n"),
        "the same again: pytest --bayesmc-seed 3 'test_inner.py::test_fails[1]'",
    ]
    assert found["test_fails[1]'"][0].startswith("wanted: ")  # it stays a candidate
    assert found["test_many"][0] == "the last 5 of 12 false verdicts:"
    assert [s.split(":")[0] for s in found["test_many"][1:-1:2]] == [
        f"late {k}" for k in range(2, 7)
    ]
    assert found["test_many"][-1].endswith(" test_inner.py::TestMany::test_many")
    assert found["test_twice"][0].startswith("once: ")


def test_one_test_can_be_run_again(pytester: pytest.Pytester) -> None:
    """With the command that its report gives: the same draws fail in the same way."""
    pytester.makepyfile(
        test_inner="""
        import pytest
        from bayesmc.testing.verdict import Comparison, Verdict, counted

        @pytest.mark.parametrize("k", range(3))
        def test_it(k, rng):
            what = f"draw {rng.bytes(8).hex()}"
            assert counted(Verdict("it", 0.01, [Comparison(what, 1.0, 2.0, 9.0, 1e-9)]))
        """
    )
    first = pytester.runpytest_inprocess("-p", "no:cacheprovider", "--bayesmc-thorough")
    shown = sections(first.stdout.str())[1]
    again = shlex.split(shown[-1].removeprefix("the same again: pytest "))
    second = pytester.runpytest_inprocess("-p", "no:cacheprovider", *again)
    assert sections(second.stdout.str()) == [shown]


@pytest.mark.parametrize("mean", [1e-6, 1e-3, 1.0005e-3, 0.41, 3.0, 50.0, 900.0])
def test_failures_that_chance_explains(mean: float) -> None:
    assert plugin._most_by_chance(mean) == scipy.stats.poisson.isf(1e-3, mean)


def test_what_is_uncounted_is_not_in_the_budget() -> None:
    @uncounted()
    def level() -> None:
        for test in ("rank_test", "another"):
            counted(Verdict(test, 0.01, []))

    counted(Verdict("rank_test", 0.125, []))
    before = dict(BUDGET.spent), dict(BUDGET.calls)
    level()
    with pytest.raises(ZeroDivisionError), uncounted():
        level()
        counted(Verdict("another", 1 / 0, []))
    assert (BUDGET.spent, BUDGET.calls) == before
    counted(Verdict("rank_test", 0.125, []))
    assert BUDGET.spent["rank_test"] == before[0]["rank_test"] + 0.125


@pytest.mark.parametrize("count", [0, -3, 2.5, "10"])
def test_scaled_wants_a_whole_number(count: object) -> None:
    with pytest.raises(ValueError, match=r"scaled\(count=.*\): give a positive whole number"):
        session.scaled(count)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"scaled\(times="):
        session.scaled(1, times=count)  # type: ignore[arg-type]


# ---- beside others ------------------------------------------------------------------------------


def test_the_start_of_pytest_imports_neither_numpy_nor_bayesmc(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        "import sys\n"
        "def test_it():\n"
        "    assert '_bayesmc_pytestplugin' in sys.modules\n"
        "    assert not {'numpy', 'bayesmc', 'hypothesis'} & set(sys.modules)"
    )
    pytester.runpytest_subprocess("--bayesmc-thorough").assert_outcomes(passed=1)


#: writes down the examples, and how many there are
EXAMPLES = """
import hashlib, os, pathlib
from hypothesis import given, strategies as st
SEEN = []

@given(st.integers(0, 10**9))
def test_examples(k): SEEN.append(k)

def test_note():
    text = hashlib.sha256(repr(SEEN).encode()).hexdigest()
    pathlib.Path(os.environ["NOTES"]).write_text(f"{len(SEEN)} {text}")
"""


@pytest.fixture
def untouched_hypothesis(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Inner runs load profiles, and set Hypothesis's seed, in this process."""
    outer = hypothesis.settings.default
    assert outer is not None
    monkeypatch.setattr(hypothesis.core, "global_force_seed", hypothesis.core.global_force_seed)
    yield
    hypothesis.settings.register_profile("bayesmc", outer)
    hypothesis.settings.load_profile("bayesmc")


@pytest.mark.usefixtures("untouched_hypothesis")
def test_hypothesis_of_our_own_tests(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without chance in an ordinary run; by the run's seed, and longer, in a thorough one."""
    pytester.makeconftest(CONFTEST.read_text("utf-8"))
    pytester.makepyfile(test_inner=EXAMPLES)
    monkeypatch.setenv("NOTES", str(pytester.path / "note"))

    def examples(seed: int, *options: str) -> str:
        monkeypatch.setattr(hypothesis.core, "global_force_seed", None)
        pytester.runpytest_inprocess(f"--bayesmc-seed={seed}", *options).assert_outcomes(passed=2)
        return (pytester.path / "note").read_text()

    ordinary, thorough = examples(1), examples(1, "--bayesmc-thorough")
    assert ordinary.startswith("30 ")
    assert examples(2) == ordinary
    assert thorough.startswith("300 ")
    assert examples(2, "--bayesmc-thorough") != thorough
    # Hypothesis's own option goes before, and the run's seed is nothing else to it
    assert examples(7, "--bayesmc-thorough", "--hypothesis-seed=1") == thorough
