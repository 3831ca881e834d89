"""Units handed to an executor, and their results: lost ones are run again, Ctrl-C keeps what is done."""

from __future__ import annotations

import concurrent.futures
import os
import sys
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Future,
    ThreadPoolExecutor,
    wait,
)
from contextlib import suppress
from contextvars import copy_context
from typing import Any, NamedTuple

from bayesmc.errors import InterruptWarning, WorkerError, WorkerWarning
from bayesmc.progress import Progress
from bayesmc.workers.remote import Told, work
from bayesmc.workers.travel import Job, known_to, pack_job, packed, unpacked

#: bytes up to which a job is sent along with every unit; larger ones go to workers that ask
_SMALL = 1 << 16
#: how often a unit may lose its worker
_ATTEMPTS = 3
#: units handed out and not back yet, for each worker
_AHEAD = 3
#: seconds that running units have to come back after Ctrl-C
_GRACE = 5.0

#: of what all units share and a unit to its result
Work = Callable[[Mapping[str, Any], Any], Any]


def check_executor(call: str, executor: Any) -> None:
    """Refuse what is no executor, saying what to give.

    Raises
    ------
    TypeError
    """
    if executor is None or (callable(getattr(executor, "submit", None)) and _is_executor(executor)):
        return
    if hasattr(executor, "get_executor"):
        fix = "that is a Dask client; give client.get_executor()"
    elif isinstance(executor, type):
        fix = f"that is a class; give an instance: {executor.__name__}(2)"
    else:
        fix = (
            "give a concurrent.futures executor, such as ProcessPoolExecutor(4), "
            "loky.get_reusable_executor(4), client.get_executor() of a Dask client, or None"
        )
    raise TypeError(f"{call}(executor={executor!r}): {fix}")


def completed(
    function: Work,
    shared: Mapping[str, Any],
    units: Iterable[Any],
    executor: Any = None,
    **shown: Any,
) -> Iterator[tuple[int, Any]]:
    """Numbers of units with their results, as they come.

    Parameters
    ----------
    function : callable
        ``(shared, unit) -> result``, which reads both and changes neither; a function of a module.
    shared : dict
        What all units read.
    units : iterable
        Taken as there are workers for them, so that there may be no end of it.
    executor : concurrent.futures.Executor, optional
        None: one after the other, here.
    shown : label, total, progress
        Of the bar, which counts units: what stands beside it, how many there are (None, the default, shows
        none), and whether it is wanted.

    Raises
    ------
    WorkerError
        Something does not travel, or a unit lost its worker over and over.
    KeyboardInterrupt
        After everything that was done has been handed on.
    Exception
        What a unit raised.
    """
    for number, found in _worked(function, shared, units, executor, **shown):
        if isinstance(found, _Raised):
            raise found.error
        yield number, found


def in_order(
    function: Work,
    shared: Mapping[str, Any],
    units: Iterable[Any],
    executor: Any = None,
    **shown: Any,
) -> Iterator[Any]:
    """The results of ``completed`` in the order of the units, each as soon as those before are there.

    Units are worked out ahead; what one of them raises is raised when it is its turn, if it comes to that.
    """
    early: dict[int, Any] = {}
    following = 0
    results = _worked(function, shared, units, executor, **shown)
    try:
        for number, found in results:
            early[number] = found
            while following in early:
                due = early.pop(following)
                if isinstance(due, _Raised):
                    raise due.error
                yield due
                following += 1
    finally:
        results.close()


def told_of_interrupt(call: str, done: str, category: type[Warning]) -> None:
    """Warn that an answer rests on what was done before Ctrl-C."""
    warnings.warn(f"{call}: interrupted; the answer has {done}", category, stacklevel=4)


def gathered(
    results: Iterable[tuple[int, Any]], starts: Sequence[int], count: int, call: str, said: str
) -> list[Any]:
    """Answers of units, which come as lists, each from its start on; None for what Ctrl-C cut off."""
    found: list[Any] = [None] * count
    try:
        for number, answers in results:
            found[starts[number] : starts[number] + len(answers)] = answers
    except KeyboardInterrupt:
        done = sum(one is not None for one in found)
        if not done:
            raise
        made = f"{call}: interrupted; the answer has {said.format(done, count)}"
        warnings.warn(made, InterruptWarning, stacklevel=4)
    return found


def workers_of(executor: Any) -> int:
    """How many units an executor works on at a time, as far as can be told."""
    for name in ("_max_workers", "num_workers"):
        count = getattr(executor, name, None)
        if isinstance(count, int) and count > 0:
            return count
    client = getattr(executor, "_client", None)
    with suppress(Exception):
        return max(sum(client.nthreads().values()), 1)  # type: ignore[union-attr]
    return os.cpu_count() or 1


# ---- private ------------------------------------------------------------------------------------


class _Raised(NamedTuple):
    """What a unit raised."""

    error: BaseException


def _worked(
    function: Work,
    shared: Mapping[str, Any],
    units: Iterable[Any],
    executor: Any,
    label: str = "",
    total: int | None = None,
    progress: bool | None = None,
) -> Generator[tuple[int, Any], None, None]:
    """Numbers of units with their results, or what they raised, as they come."""
    with Progress(total or 0, label, False if total is None else progress) as bar:
        if executor is None:
            for number, unit in enumerate(units):
                yield number, function(shared, unit)
                bar.advance()
            return
        for found in _Crew(function, shared, executor).results(iter(units)):
            yield found
            bar.advance()


class _Crew:
    """One job on one executor, or on its successors where workers are lost."""

    def __init__(self, function: Work, shared: Mapping[str, Any], executor: Any) -> None:
        self.function, self.shared, self.executor = function, shared, executor
        self.own = False  # whether the executor is a successor, to be shut down here
        self.here = isinstance(executor, ThreadPoolExecutor) and not _is_interpreters(executor)
        self.job = Job({}, {}) if self.here else pack_job(function, shared)
        self.lasting = {n: v for n, v in shared.items() if n not in self.job.seeds}
        self.limit = _AHEAD * workers_of(executor)
        self.waiting: dict[Future[Any], tuple[int, Any]] = {}
        self.lost: dict[int, int] = {}
        self.breaks = 0

    def results(self, units: Iterator[Any]) -> Iterator[tuple[int, Any]]:
        numbered = enumerate(units)
        open_ = True
        try:
            while True:
                while open_ and len(self.waiting) < self.limit:
                    following = next(numbered, None)
                    open_ = following is not None
                    if following is not None:
                        self.submit(*following)
                if not self.waiting:
                    return
                yield from self.back()
        except KeyboardInterrupt:
            yield from self.rescued()
            raise
        finally:
            for future in self.waiting:
                future.cancel()
            if self.own:
                self.executor.shutdown(wait=False, cancel_futures=True)

    def submit(self, number: int, unit: Any, wanted: Sequence[str] = ()) -> None:
        """Hand out a unit; a large part of the job goes along only where a worker has asked for it."""
        if self.here:
            own = copy_context()  # errstate and the like are this thread's
            future = self.executor.submit(own.run, self.function, self.shared, unit)
        else:
            try:
                own_data = packed((unit, self.job.seeds), known_to(self.lasting))
            except Exception as error:
                raise WorkerError(
                    f"executor=: unit {number} does not travel to another process "
                    f"({type(error).__name__}: {error}); give a ThreadPoolExecutor, or leave executor= out"
                ) from error
            parts = self.job.parts.items()
            sent = {d: data for d, data in parts if d in wanted or len(data) <= _SMALL}
            given = self.job.digests, sent, own_data, self.lost.get(number, 0)
            try:
                future = self.executor.submit(work, *given)
            except BrokenExecutor as error:
                self.replace(error)
                future = self.executor.submit(work, *given)
        self.waiting[future] = number, unit

    def back(self) -> Iterator[tuple[int, Any]]:
        """What has come back by now, at least one unit."""
        done, _ = wait(self.waiting, return_when=FIRST_COMPLETED)
        broken: BaseException | None = None
        again = []
        for future in done:
            number, unit = self.waiting.pop(future)
            error = _error_of(future)
            if error is not None and _is_lost(error) and not self.here:
                if isinstance(error, BrokenExecutor):
                    broken = error  # all units of a broken pool fail, whoever broke it
                else:
                    self.count_loss(number, error)
                again.append((number, unit))
                continue
            if isinstance(error, KeyboardInterrupt):
                raise error
            if error is not None:
                yield number, _Raised(error)
                continue
            found = future.result()
            if self.here:
                yield number, found
                continue
            if found.kind == "wanted":
                self.submit(number, unit, found.wanted)
                continue
            self.breaks = 0
            yield number, self.opened(found, unit, number)
        if broken is not None:
            again += list(self.waiting.values())
            self.waiting = {}
            self.replace(broken)
        for number, unit in sorted(again, key=lambda pair: pair[0]):
            self.submit(number, unit)

    def opened(self, told: Told, unit: Any, number: int) -> Any:
        """The result in a worker's message, or what it raised; its warnings are given here."""
        for category, message in told.warned:
            warnings.warn(message, category, stacklevel=7)
        if told.kind == "failed":
            error, where = unpacked(told.data)
            error.add_note(f"in unit {number}, in a worker:\n{where}")
            return _Raised(error)
        return unpacked(told.data, known_to(self.shared, unit))

    def rescued(self) -> Iterator[tuple[int, Any]]:
        """After Ctrl-C: what is done, and what running units still bring in a few seconds."""
        for future in self.waiting:
            future.cancel()
        running = [f for f in self.waiting if not f.cancelled()]
        with suppress(KeyboardInterrupt):
            wait(running, timeout=_GRACE)
        for future in [f for f in running if f.done()]:
            number, unit = self.waiting.pop(future)
            with suppress(Exception, KeyboardInterrupt):
                found = future.result()
                if self.here:
                    yield number, found
                elif found.kind == "found":
                    yield number, self.opened(found, unit, number)

    def count_loss(self, number: int, error: BaseException) -> None:
        self.lost[number] = self.lost.get(number, 0) + 1
        if self.lost[number] >= _ATTEMPTS:
            raise WorkerError(
                f"executor=: unit {number} lost its worker {_ATTEMPTS} times ({type(error).__name__}: "
                f"{error}); it may need more memory than a worker has: ask for fewer draws or chains at a "
                'time, or for keep="summaries"'
            ) from error

    def replace(self, error: BaseException) -> None:
        """Another pool of the same kind, since a process pool that lost a worker takes no more work."""
        self.breaks += 1
        if self.breaks >= _ATTEMPTS:
            raise WorkerError(
                f"executor=: workers died {_ATTEMPTS} times in a row ({error}); they may need more memory "
                "than there is, or a function ends its process"
            ) from error
        successor = _successor(self.executor)
        if successor is None:
            raise WorkerError(
                f"executor=: {type(self.executor).__name__} lost a worker and takes no more work ({error}); "
                "call again with a new one"
            ) from error
        if self.own:
            self.executor.shutdown(wait=False)
        self.executor, self.own = successor
        warnings.warn(
            f"executor=: a worker died ({error}); its units are run again, by a new pool of the same size",
            WorkerWarning,
            stacklevel=7,
        )


def _error_of(future: Future[Any]) -> BaseException | None:
    try:
        return future.exception()
    except CancelledError as error:
        return error


def _is_lost(error: BaseException) -> bool:
    """Whether an exception says that a worker is gone, and nothing of the work."""
    lost = (BrokenExecutor, CancelledError, ConnectionError, EOFError)
    gone = ("KilledWorker", "CommClosedError", "TerminatedWorkerError", "FutureCancelledError")
    return isinstance(error, lost) or type(error).__name__ in gone


def _successor(executor: Any) -> tuple[Any, bool] | None:
    """A new pool in a broken one's place, and whether it is ours to shut down."""
    if type(executor).__module__.startswith("loky"):
        loky = sys.modules["loky"]
        return loky.get_reusable_executor(max_workers=executor._max_workers), False
    if not isinstance(executor, concurrent.futures.ProcessPoolExecutor):
        return None
    own: Any = executor
    return concurrent.futures.ProcessPoolExecutor(
        own._max_workers, own._mp_context, own._initializer, own._initargs
    ), True


def _is_executor(executor: Any) -> bool:
    return not isinstance(executor, type) and hasattr(executor, "shutdown")


def _is_interpreters(executor: Any) -> bool:
    """Interpreters in threads (Python 3.14) share no objects."""
    return type(executor).__name__ == "InterpreterPoolExecutor"
