"""Units come back whatever happens to workers, in whatever order, and say what goes wrong."""

from __future__ import annotations

from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pytest

import bayesmc as bmc
from bayesmc.errors import WorkerError, WorkerWarning, ZeroProbabilityError
from bayesmc.workers import check_executor, completed, in_order
from tests.workers import functions


class Elsewhere(Executor):
    """Runs what it is given at once, as another process would: all that goes in and out travels."""

    def __init__(self, lost: int = 0) -> None:
        self.lost, self.sent = lost, 0

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        self.sent += 1
        future: Future[Any] = Future()
        future.set_running_or_notify_cancel()
        if self.sent <= self.lost:
            future.set_exception(ConnectionError("the worker is gone"))
            return future
        try:
            future.set_result(fn(*args, **kwargs))
        except BaseException as error:
            future.set_exception(error)
        return future


@pytest.fixture(params=["none", "threads", "elsewhere"])
def executor(request: pytest.FixtureRequest) -> Any:
    if request.param == "none":
        return None
    if request.param == "elsewhere":
        pytest.importorskip("cloudpickle", reason="units travel by cloudpickle: bayesmc[workers]")
        return Elsewhere()
    pool = ThreadPoolExecutor(2)
    request.addfinalizer(pool.shutdown)
    return pool


def test_results_come_in_order_of_units(executor: Any) -> None:
    found = list(in_order(functions.late, {}, range(5), executor))
    assert found == list(range(5))


def test_units_may_have_no_end(executor: Any) -> None:
    def endless() -> Any:
        k = 0
        while True:
            yield k
            k += 1

    results = in_order(functions.doubled, {"factor": 2}, endless(), executor)
    assert [next(results) for _ in range(20)] == [2 * k for k in range(20)]
    results.close()


def test_error_of_a_unit_is_raised_as_it_is(executor: Any) -> None:
    with pytest.raises(ZeroProbabilityError, match="impossible, this one"):
        list(in_order(functions.failing, {}, range(4), executor))


def test_error_of_a_unit_that_is_not_needed_is_not_raised(executor: Any) -> None:
    results = in_order(functions.failing, {}, range(6), executor)
    assert [next(results), next(results)] == [0, 1]
    results.close()
    with pytest.raises(ZeroProbabilityError):
        list(in_order(functions.failing, {}, range(6), executor))


def test_interrupt_keeps_what_is_done(executor: Any) -> None:
    found = []
    with pytest.raises(KeyboardInterrupt):
        for number, _ in completed(functions.stopped, {}, range(3), executor):
            found.append(number)
    assert set(found) == {0, 1}


def test_warnings_of_workers_are_given_here() -> None:
    pytest.importorskip("cloudpickle", reason="units travel by cloudpickle: bayesmc[workers]")
    with pytest.warns(UserWarning, match="beware of 0"):
        list(completed(functions.warned, {}, range(1), Elsewhere()))


def test_lost_units_are_run_again_but_not_for_ever() -> None:
    pytest.importorskip("cloudpickle", reason="units travel by cloudpickle: bayesmc[workers]")
    assert list(in_order(functions.doubled, {"factor": 3}, range(2), Elsewhere(lost=2))) == [0, 3]
    with pytest.raises(WorkerError, match="unit 0 lost its worker 3 times"):
        list(completed(functions.doubled, {"factor": 3}, range(1), Elsewhere(lost=9)))


@pytest.mark.thorough
def test_dead_process_is_replaced(tmp_path: Path) -> None:
    pytest.importorskip("cloudpickle", reason="units travel by cloudpickle: bayesmc[workers]")
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        shared = {"folder": str(tmp_path)}
        with pytest.warns(WorkerWarning, match="run again"):
            assert list(in_order(functions.dies_once, shared, range(4), pool)) == [0, 1, 2, 3]
    with (
        ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool,
        pytest.warns(WorkerWarning),
        pytest.raises(WorkerError, match="3 times in a row"),
    ):
        list(completed(functions.dies, {}, range(2), pool))


def test_progress_counts_units(capsys: pytest.CaptureFixture[str]) -> None:
    from bayesmc.progress import Progress

    counted = []
    original = Progress.advance
    try:
        Progress.advance = lambda self, units=1: counted.append(units)  # type: ignore[method-assign]
        list(completed(functions.doubled, {"factor": 1}, range(3), None, total=3))
    finally:
        Progress.advance = original  # type: ignore[method-assign]
    assert counted == [1, 1, 1]


@pytest.mark.parametrize(
    ("wrong", "fix"),
    [
        (4, "such as ProcessPoolExecutor"),
        (ProcessPoolExecutor, "give an instance"),
        (type("Client", (), {"get_executor": None})(), "client.get_executor"),
    ],
)
def test_what_is_no_executor_is_refused(wrong: Any, fix: str) -> None:
    with pytest.raises(TypeError, match=fix):
        check_executor("infer", wrong)
    with pytest.raises(TypeError, match=fix):
        bmc.infer(bmc.BayesNet(), executor=wrong)
