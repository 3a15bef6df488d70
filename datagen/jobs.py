"""Tasks dealt out to processes one by one, each to whoever is free, the first rank among them.

The first rank holds the queue. Its main thread computes tasks from it; the manager thread of mpi4py's pool feeds the other ranks from the
same queue, and a third thread acknowledges results. No rank waits while there are tasks; nothing depends on which rank computes what.
"""

from __future__ import annotations

import os
import sys
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from threading import Condition
from typing import Any, Literal

from biem.backend import one_blas_thread
from biem.ranks import ALONE, Ranks
from datagen.stop import Stopped, stop_asked, unless_stopped

ATTEMPTS = 2
POLL = 0.1  # s between looks for a signal while the first rank waits for the others
SWITCH = 5e-4  # s after which the computing thread of the first rank lets the others speak (Python's default is ten times that)


@dataclass(frozen=True)
class Failure:
    """A task that raised in every attempt, and what it raised the last time."""

    task: Any
    error: str


@dataclass
class Report:
    """How a round of tasks ended. stopped: by a signal, before all were done. error: files could not be written."""

    failures: list[Failure] = field(default_factory=list)
    stopped: bool = False
    error: Exception | None = None


def run_tasks(make: Callable[[Any], Any], tasks: Sequence[Any], acknowledge: Callable[[list[Any]], None], ranks: Ranks = ALONE) -> Report:
    """make(task) of all tasks, shared among the ranks; acknowledge(what make returned for some of them) on the first rank, as they come.

    To be called on all ranks; tasks and acknowledge count on the first one alone. make, tasks and what make returns are sent as pickles.
    A task that raises, be it SystemExit, is tried once more and then set aside. OSError ends the round: what cannot be written now can
    not be written by the next task either. After a signal to any rank its task is given up, and no more are begun; the others finish
    theirs. An error of acknowledge ends the round too. Returns the report, on all ranks.
    """
    work = _Work(make, tasks, acknowledge)
    if ranks.comm is None:
        work.run()
        return work.report
    from mpi4py.futures import MPICommExecutor

    try:
        with MPICommExecutor(ranks.comm, root=0) as pool:  # the other ranks serve in here
            if pool is not None:
                work.run(pool, ranks.size - 1)
    except BaseException:
        if ranks.rank > 0:  # the service itself broke: the first rank would wait for it for ever
            traceback.print_exc()
            ranks.comm.Abort(1)
        raise
    return ranks.on_root(lambda: work.report)


@contextmanager
def one_thread() -> Iterator[None]:
    """One thread for BLAS, and for all that asks `biem.backend.threads()` or OpenMP: the cores belong to the tasks."""
    old = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"
    try:
        with one_blas_thread():
            yield
    finally:
        if old is None:
            del os.environ["OMP_NUM_THREADS"]
        else:
            os.environ["OMP_NUM_THREADS"] = old


@dataclass(frozen=True)
class _Outcome:
    """What became of one attempt; it can be sent, whatever was raised."""

    kind: Literal["done", "failed", "stopped", "file error"]
    value: Any = None
    error: str = ""


def _attempt(make: Callable[[Any], Any], task: Any) -> _Outcome:
    try:
        return _Outcome("done", unless_stopped(lambda: make(task)))
    except Stopped:
        return _Outcome("stopped")
    except OSError as error:
        return _Outcome("file error", error=str(error))
    except BaseException as error:
        return _Outcome("failed", error=_describe(error))


def _describe(error: BaseException) -> str:
    """An exception in one line, with the place where it was raised."""
    text = f"{type(error).__name__}: {' '.join(str(error).split())}"
    return text + "".join(f" ({os.path.basename(at.filename)}:{at.lineno})" for at in traceback.extract_tb(error.__traceback__)[-1:])


class _Work:
    """The queue of the first rank, and what comes back."""

    def __init__(self, make: Callable[[Any], Any], tasks: Sequence[Any], acknowledge: Callable[[list[Any]], None]) -> None:
        self.report = Report()
        self._make = make
        self._acknowledge = acknowledge
        self._waiting = deque((task, 1) for task in tasks)  # with the number of the attempt
        self._under_way = 0
        self._ended = False  # no more tasks are begun
        self._done: list[Any] = []  # to be acknowledged
        self._changed = Condition()  # held for every change of the above
        self._clerk: ThreadPoolExecutor

    def run(self, pool: Any = None, workers: int = 0) -> None:
        """Until all tasks are done or set aside and what came of them is acknowledged, or the round has ended and no task is under way."""
        interval = sys.getswitchinterval()
        with ThreadPoolExecutor(1) as self._clerk:
            try:
                if workers:
                    sys.setswitchinterval(SWITCH)
                for _ in range(workers):
                    self._send(pool)
                while (item := self._next(wait=True)) is not None:
                    self._settle(*item, _attempt(self._make, item[0]))
            finally:
                sys.setswitchinterval(interval)
                with self._changed:
                    self._ended = True

    def _next(self, wait: bool) -> tuple[Any, int] | None:
        """A task to begin, with the number of the attempt; None if there is none; wait: nor can one come back to be tried again."""
        with self._changed:
            while True:
                if stop_asked() and self._waiting:
                    self._end(stopped=True)
                if self._waiting and not self._ended:
                    self._under_way += 1
                    return self._waiting.popleft()
                if not wait or self._under_way == 0:
                    return None
                self._changed.wait(POLL)

    def _send(self, pool: Any) -> None:
        """Begins a task on another rank, and when that is done the next one."""
        item = self._next(wait=False)
        if item is None:
            return
        task, attempt = item

        def back(future: Future[_Outcome]) -> None:
            error = future.exception()  # of sending; what the task raised is in the outcome
            self._settle(task, attempt, future.result() if error is None else _Outcome("failed", error=_describe(error)))
            self._send(pool)

        pool.submit(_attempt, self._make, task).add_done_callback(back)

    def _settle(self, task: Any, attempt: int, outcome: _Outcome) -> None:
        with self._changed:
            self._under_way -= 1
            if outcome.kind == "done":
                self._done.append(outcome.value)
                self._clerk.submit(self._acknowledge_all)
            elif outcome.kind == "stopped":
                self._end(stopped=True)
            elif outcome.kind == "file error":
                self._end(error=OSError(outcome.error))
            elif attempt < ATTEMPTS:
                self._waiting.append((task, attempt + 1))
            else:
                self.report.failures.append(Failure(task, outcome.error))
            self._changed.notify_all()

    def _end(self, stopped: bool = False, error: Exception | None = None) -> None:
        self._ended = True
        self.report.stopped |= stopped
        self.report.error = self.report.error or error

    def _acknowledge_all(self) -> None:
        """All that has come since the last time: under many ranks several results for one look at the disk."""
        with self._changed:
            done, self._done = self._done, []
        try:
            if done:
                self._acknowledge(done)
        except Exception as error:
            with self._changed:
                self._end(error=error)
