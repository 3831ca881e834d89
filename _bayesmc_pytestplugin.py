"""The pytest plugin of bayesmc: seeds, the fixture ``rng``, what failing tests found, false alarms risked.

It stands outside the package, so that pytest's start imports neither bayesmc nor NumPy, in projects too that
have bayesmc installed and do not test with it. What tests ask of a run is in ``bayesmc.testing.session``; the
two meet in the environment variables ``BAYESMC_SEED`` and ``BAYESMC_THOROUGH``, which hold before conftest
files and test modules are imported, and which the processes that tests start inherit.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import os
import secrets
import shlex
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    import numpy

SEED, THOROUGH = "BAYESMC_SEED", "BAYESMC_THOROUGH"

#: fresh seeds lie below: short enough to be typed
_FRESH = 10**9
#: failures beyond those that the last line names come about by chance with this probability
_RARE = 1e-3
#: verdicts shown of a failing test, the latest
_SHOWN = 5


@dataclass
class Spending:
    """Chances of false alarms spent so far; ``spent`` and ``calls`` by test, as the kit's budget has them."""

    spent: dict[str, float] = field(default_factory=dict)
    calls: dict[str, int] = field(default_factory=dict)

    def add(self, spent: Mapping[str, float], calls: Mapping[str, int], sign: int = 1) -> None:
        for test, count in calls.items():
            self.calls[test] = self.calls.get(test, 0) + sign * count
            self.spent[test] = self.spent.get(test, 0.0) + sign * spent.get(test, 0.0)


@dataclass(frozen=True)
class Run:
    """What holds for a whole run, on each of its processes."""

    seed: int
    thorough: bool
    before: Spending = field(default_factory=Spending)
    workers: Spending = field(default_factory=Spending)
    lost: list[str] = field(default_factory=list)

    @property
    def repeat(self) -> str:
        """Options that give the same run again."""
        return ("--bayesmc-thorough " if self.thorough else "") + f"--bayesmc-seed {self.seed}"


RUN = pytest.StashKey[Run]()


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> numpy.random.Generator:
    """A NumPy generator of the run's seed (``--bayesmc-seed``) and the test's name.

    Each test has its own; it does not depend on which tests run, in which order, or on how many workers.
    """
    import numpy as np

    # not the test's own nodeid, to which pytest-xdist may append the name of a group
    node = request.node
    digest = hashlib.sha256(f"{node.parent.nodeid}::{node.name}".encode()).digest()
    words = [int.from_bytes(digest[k : k + 4], "little") for k in range(0, len(digest), 4)]
    seed = request.config.stash[RUN].seed
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=words))


# ---- the seed of the run ------------------------------------------------------------------------


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("bayesmc", "statistical tests (bayesmc)")
    group.addoption(
        "--bayesmc-seed",
        metavar="N",
        type=_seed,
        help="seed of the fixture `rng` and of bayesmc.testing.session.seed(); default: "
        f"${SEED}, else 0, or a fresh one under --bayesmc-thorough",
    )
    group.addoption(
        "--bayesmc-thorough",
        action="store_true",
        help="fresh seeds, and more draws where tests ask bayesmc.testing.session.scaled(n)",
    )


def _seed(text: str) -> int:
    if text.isascii() and text.isdigit():
        return int(text)
    raise argparse.ArgumentTypeError(f"{text!r} is not a seed; give a nonnegative whole number")


@pytest.hookimpl(tryfirst=True)
def pytest_load_initial_conftests(early_config: pytest.Config) -> None:
    """Choose the seed once, before a conftest file or a test module can ask for it."""
    _hold(early_config, _chosen(early_config.known_args_namespace))


def _chosen(options: argparse.Namespace) -> Run:
    thorough = options.bayesmc_thorough or os.environ.get(THOROUGH, "") not in ("", "0")
    seed = options.bayesmc_seed
    if seed is None:
        seed = _environment_seed()
    if seed is None:
        seed = 1 + secrets.randbelow(_FRESH - 1) if thorough else 0
    return Run(seed, thorough)


def _environment_seed() -> int | None:
    text = os.environ.get(SEED)
    if not text:
        return None
    try:
        return _seed(text)
    except argparse.ArgumentTypeError as error:
        raise pytest.UsageError(f"environment variable {SEED}: {error}") from None


def _hold(config: pytest.Config, run: Run) -> None:
    config.stash[RUN] = run
    kept = {name: os.environ.get(name) for name in (SEED, THOROUGH)}
    os.environ[SEED] = str(run.seed)
    os.environ[THOROUGH] = str(int(run.thorough))
    config.add_cleanup(lambda: _restore(kept))


def _restore(kept: Mapping[str, str | None]) -> None:
    for name, value in kept.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value


@pytest.hookimpl(tryfirst=True)
def pytest_configure(config: pytest.Config) -> None:
    if RUN not in config.stash:  # named in a conftest file, which comes too late for the hook above
        _hold(config, _chosen(config.option))
    given = getattr(config, "workerinput", {}).get("bayesmc_seed")
    if given not in (None, config.stash[RUN].seed):  # a worker elsewhere, with its own environment
        _hold(config, Run(given, config.stash[RUN].thorough))
    config.stash[RUN].before.add(*_budget())


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node: Any) -> None:
    node.workerinput["bayesmc_seed"] = node.config.stash[RUN].seed


def pytest_report_header(config: pytest.Config) -> str | None:
    run = config.stash[RUN]
    if not (run.thorough or run.seed or config.get_verbosity() > 0):
        return None
    return f"bayesmc: {'thorough run with ' if run.thorough else ''}seed {run.seed}"


# ---- what failing tests found -------------------------------------------------------------------


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    """Forget what earlier tests found."""
    _verdicts().clear()


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Iterator[None]:
    """Show the false verdicts of a failing test whole: pytest cuts what ``assert`` was given to one line."""
    outcome: Any = yield
    report = outcome.get_result()
    verdicts = _verdicts()
    if not report.failed:
        return
    # once each: Hypothesis repeats the example that fails
    false = list(dict.fromkeys(repr(v) for v in verdicts if not v))
    verdicts.clear()
    if false:
        lines = false[-_SHOWN:]
        if len(false) > _SHOWN:
            lines.insert(0, f"the last {_SHOWN} of {len(false)} false verdicts:")
        lines.append(f"the same again: pytest {item.config.stash[RUN].repeat} {_address(item)}")
        report.sections.append(("bayesmc verdicts", "\n".join(lines)))


def _address(item: pytest.Item) -> str:
    """What a shell gives pytest to run this test, where pytest was called."""
    path, here = item.path, item.config.invocation_params.dir
    file = path.relative_to(here) if path.is_relative_to(here) else path
    # not the item's own nodeid, as in `rng`; that of its parent has the classes
    _, *classes = str(getattr(item.parent, "nodeid", "")).split("::")
    return shlex.quote("::".join([file.as_posix(), *classes, item.name]))


def _verdicts() -> Any:
    """The verdicts of late in this process; nothing where bayesmc's tests were not even imported."""
    return getattr(sys.modules.get("bayesmc.testing.verdict"), "LAST", [])


# ---- the false alarms that were risked ----------------------------------------------------------


def pytest_sessionfinish(session: pytest.Session) -> None:
    output = getattr(session.config, "workeroutput", None)
    if output is not None:
        own = _spent_here(session.config.stash[RUN])
        output["bayesmc_budget"] = [own.spent, own.calls]


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    run, output = node.config.stash[RUN], getattr(node, "workeroutput", None) or {}
    if "bayesmc_budget" in output:
        run.workers.add(*output["bayesmc_budget"])
    else:
        run.lost.append(node.gateway.id)


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    run = config.stash[RUN]
    total = _spent_here(run)
    total.add(run.workers.spent, run.workers.calls)
    for line in _summary(run, total, config.get_verbosity() > 0):
        terminalreporter.write_line(line)


def _summary(run: Run, total: Spending, by_test: bool) -> list[str]:
    count, alpha = sum(total.calls.values()), math.fsum(total.spent.values())
    again = f"repeat with {run.repeat}" if run.thorough else f"seed {run.seed}"
    if not count:
        return [f"bayesmc: {again}"] if run.thorough else []
    tests = "1 statistical test" if count == 1 else f"{count} statistical tests"
    line = f"bayesmc: {tests} spent a false-alarm budget of {alpha:.3g} ({again})"
    if run.thorough:
        most = _most_by_chance(alpha)
        # some alarms that are counted cannot happen: levels are bounds, and some comparisons have no chance
        line += f"; chance explains at most {alpha:.3g} failures on average, hardly ever more than {most}"
    if run.lost:
        line += f"; not counted: {', '.join(run.lost)}, which ended early"
    parts = sorted(total.calls, key=lambda test: -total.spent[test]) if by_test else []
    return [line, *(f"  {test}: {total.spent[test]:.3g} in {total.calls[test]}" for test in parts)]


def _most_by_chance(mean: float) -> int:
    """Smallest k such that more than k false alarms are rare.

    By the tail of a Poisson number, which bounds that of independent tests with so many alarms on average
    (Hoeffding 1956).
    """
    k, beyond = 0, -math.expm1(-mean)
    while beyond > _RARE:
        k += 1
        beyond -= math.exp(k * math.log(mean) - mean - math.lgamma(k + 1))
    return k


def _spent_here(run: Run) -> Spending:
    own = Spending()
    own.add(*_budget())
    own.add(run.before.spent, run.before.calls, sign=-1)
    own.calls = {test: count for test, count in own.calls.items() if count}
    own.spent = {test: own.spent[test] for test in own.calls}
    return own


def _budget() -> tuple[Mapping[str, float], Mapping[str, int]]:
    """What this process has spent; nothing where bayesmc's tests were not even imported."""
    module = sys.modules.get("bayesmc.testing.verdict")
    budget = getattr(module, "BUDGET", None)
    return (budget.spent, budget.calls) if budget else ({}, {})
