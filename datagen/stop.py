"""Stopping by SIGTERM or SIGINT: the work under way is given up, what was acknowledged before is kept.

Inside `stoppable()` a first signal is noted, and ends the work that `unless_stopped` is doing, by a KeyboardInterrupt. A second one ends
the process at once; nothing is damaged by that, since files are whole or not there.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TypeVar, cast

SIGNALS = (signal.SIGTERM, signal.SIGINT)
EXIT_CODE = 4
Result = TypeVar("Result")
TWIN = 1.0  # s: a terminal and mpirun may both pass on the same Ctrl-C


class Stopped(Exception):
    """A signal asked this process, or one of its companions, to stop."""


class _State:
    seen: float | None = None  # when the first signal came
    interruptible = False


@contextmanager
def stoppable() -> Iterator[None]:
    """Signals are noted inside the block. Outside of the main thread they stay with the program."""
    try:
        old = {number: signal.signal(number, _note) for number in SIGNALS}
    except ValueError:
        old = {}
    try:
        yield
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)
        _State.seen = None


def unless_stopped(work: Callable[[], Result]) -> Result:
    """work(), given up when a signal comes. Raises Stopped, also where work has caught the interrupt: no value of it is relied on then."""
    try:
        try:
            _State.interruptible = not stop_asked()
            value = work() if _State.interruptible else None
        finally:
            _State.interruptible = False
    except BaseException:
        if not stop_asked():
            raise
    if stop_asked():
        raise Stopped("stopped by a signal")
    return cast(Result, value)


def stop_asked() -> bool:
    """Whether a signal has come."""
    return _State.seen is not None


def _note(number: int, frame: FrameType | None) -> None:
    if _State.seen is None:
        _State.seen = time.monotonic()
        if _State.interruptible:
            raise KeyboardInterrupt
    elif time.monotonic() - _State.seen > TWIN:
        os._exit(EXIT_CODE)
