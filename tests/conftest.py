"""What every test file shares: the reference data, and a Hypothesis profile without chance, or with.

An ordinary run is the same every time: what draws without a seed is seeded by the test's name. A thorough
one (``--bayesmc-thorough``) lets Hypothesis draw other and more examples, by the seed of the run, so that
``--bayesmc-seed`` repeats them as well.

Tests that hold bayesmc against published numbers take the fixture ``reference_data`` (a path),
which marks them ``reference``; where the data is absent they are skipped, and the run's last lines
say how many, so that a green run without data is not mistaken for a checked one.

Tests marked ``thorough`` take long and are much like others; an ordinary run leaves them out.
"""

from __future__ import annotations

import os
import random
import sys
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import numpy as np
import pytest

from bayesmc.testing import session

REPOSITORY = Path(__file__).resolve().parents[1]
ABSENT = "reference data absent"

hypothesis.settings.register_profile(
    "bayesmc",
    max_examples=session.scaled(30, times=10),
    derandomize=not session.is_thorough(),
    deadline=None,
    print_blob=True,
    database=None,
)
hypothesis.settings.load_profile("bayesmc")


def pytest_configure(config: pytest.Config) -> None:
    # Hypothesis reads the option after this
    if session.is_thorough() and getattr(config.option, "hypothesis_seed", "") is None:
        config.option.hypothesis_seed = str(session.seed())


@pytest.fixture(autouse=True)
def seeded_by_name(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """``rng=None`` draws other numbers at every call, and the same ones in every run of the suite.

    A statistical test whose author forgot the seed would fail on some day, at its false-alarm rate.
    """
    fresh = random.Random(f"{session.seed()} {request.node.nodeid}")
    monkeypatch.setattr(np.random.bit_generator, "randbits", fresh.getrandbits)


@pytest.fixture(autouse=True)
def figures_closed() -> Iterator[None]:
    """Pictures that a test, a page or a docstring leaves open are not the next one's."""
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")


def data_root() -> Path:
    """Where the reference data is looked for: ``BAYESMC_DATA``, else beside the checkout."""
    named = os.environ.get("BAYESMC_DATA")
    return Path(named) if named else REPOSITORY.parent / "shared" / "data"


@pytest.fixture(scope="session")
def reference_data() -> Path:
    """Path of the reference data; a test that asks for it is skipped where there is none."""
    root = data_root()
    if not root.is_dir():
        pytest.skip(f"{ABSENT}: {root} is not a folder (set BAYESMC_DATA)")
    return root


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    for item in items:
        if "reference_data" in getattr(item, "fixturenames", ()):
            item.add_marker("reference")
    if not session.is_thorough():
        left = [item for item in items if item.get_closest_marker("thorough")]
        config.hook.pytest_deselected(items=left)
        items[:] = [item for item in items if not item.get_closest_marker("thorough")]


@pytest.hookimpl(trylast=True)
def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    ran, without_data, otherwise = _reference_counts(terminalreporter.stats)
    line = f"reference tests: {ran} ran, {without_data} skipped for want of data"
    if otherwise:
        line += f", {otherwise} skipped for other reasons"
    terminalreporter.write_line(line, yellow=without_data > 0)


def _reference_counts(stats: dict[str, list]) -> tuple[int, int, int]:
    ran: set[str] = set()
    skipped: dict[str, str] = {}
    for reports in stats.values():
        for report in reports:
            if "reference" not in getattr(report, "keywords", ()) or not hasattr(report, "when"):
                continue  # not a report: tests that -k leaves out are listed as items
            if report.skipped:
                skipped[report.nodeid] = str(report.longrepr)
            elif report.when == "call" or report.failed:
                ran.add(report.nodeid)
    # Without the folder no reference test can have another reason that matters.
    absent = not data_root().is_dir()
    without_data = sum(absent or ABSENT in reason for reason in skipped.values())
    return len(ran), without_data, len(skipped) - without_data
