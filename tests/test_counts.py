"""The counts count: lines, modules that a call runs in, functions that the graph follows."""

from __future__ import annotations

import contextlib
import io
import time
from pathlib import Path

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.shapes import as_shape
from tests.counts import followed, hops, lines
from tests.counts.__main__ import main

#: modules that the calls of ``hops`` ran in when this was written: may only shrink (short runs of starts are
#: two of those of the mixture)
HOPS = {"infer(mixture, engine=Gibbs())": 82, "filter(benchmark, engine=ParticleFilter())": 51}

MODULE = '''"""A docstring
of two lines."""

x = """text that
is code"""  # and a comment


def f(a):
    """Another."""
    # a comment alone
    return (a +
            1)
'''


def test_code_lines_leave_out_docstrings_comments_and_blanks() -> None:
    assert lines.code_lines(MODULE) == 5
    long = {"a/b.py": "x = 1\n" * 451, "c.py": "def f():\n" + "    x = 1\n" * 60}
    assert [(x.lines, x.what) for x in lines.long_modules(long)] == [(451, "a/b.py")]
    assert [(x.lines, x.what) for x in lines.long_functions(long)] == [(61, "c.py:f")]
    assert lines.by_room(long) == {"a": 451, "(loose)": 61}


def test_modules_of_a_call() -> None:
    assert hops.modules_of(lambda: as_shape(3)) == ["shapes.py"]
    with pytest.raises(ZeroDivisionError):
        hops.modules_of(lambda: 1 / 0)
    assert hops.modules_of(lambda: None) == []


def test_calls_run_in_fewer_modules() -> None:
    for name, call in hops.calls().items():
        assert len(hops.modules_of(call)) <= HOPS[name]


def test_functions_are_followed(reference_data: Path) -> None:
    """The bar for what takes seconds; ``make counts`` runs docs and examples as well."""
    with followed.tallied() as tally:
        followed.of_zoo()
        followed.of_references()
    assert len(tally.found) > 150
    assert tally.share >= followed.BAR, "\n".join(tally.lines())


def test_a_function_that_lies_lowers_the_share(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(followed, "ROOMS", ("tests/test_counts.py",))
    net = bmc.BayesNet()
    net.add("x", lambda: bmc.Normal(0.0, 1.0))
    net.add("y", lambda x: bmc.Normal(np.sin(x), 1.0))
    net.add("z", lambda x: bmc.Normal(x * (time.time() > 0), 1.0))
    with followed.tallied() as tally:
        net.validate()
    assert len(tally.found) == 3 and tally.share == pytest.approx(2 / 3)
    assert "z: it reads time" in "\n".join(tally.lines())


def test_the_command_prints_a_table(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["counts", "lines"])
    monkeypatch.setattr(lines, "sources", lambda: {"a.py": MODULE})
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        main()
    assert "      5  the library, without testing and robotics" in printed.getvalue()
    monkeypatch.setattr("sys.argv", ["counts", "words"])
    with pytest.raises(SystemExit), contextlib.redirect_stderr(printed):
        main()
    assert "no table words" in printed.getvalue()
