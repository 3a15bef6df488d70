"""What NumPy and PyTorch do differently, in one place: FFT, dense solves, scatter, conversion, counting.

Array code in `biem` is written once through the array API standard; device and dtype come from the inputs.
Importing this module imports no torch.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar, copy_context
from functools import cache, lru_cache
from importlib import import_module
from typing import Any

import array_api_compat.numpy
import numpy as np
import scipy.fft
from array_api_compat import device, is_numpy_array, is_numpy_namespace, is_torch_array

Array = Any  # a NumPy array or a PyTorch tensor

# Total size of one batched transform above which FFTW's planning overhead is paid back (docs/measurements.md).
FFTW_PAYS_ABOVE = 50_000

_counts: ContextVar[Counter[str] | None] = ContextVar("counts", default=None)
_blas_single: ContextVar[bool] = ContextVar("blas_single", default=False)
_compiled = threading.local()  # threads that numba was told to use, of each thread
_timing: ContextVar[tuple[dict[str, float], Callable[[], None], Callable[[], float]] | None] = ContextVar("timing", default=None)


@contextmanager
def counting() -> Iterator[Counter[str]]:
    """Count what is built and evaluated inside the block: `with counting() as counts: ...; counts["pair_sum"]`."""
    counts: Counter[str] = Counter()
    token = _counts.set(counts)
    try:
        yield counts
    finally:
        _counts.reset(token)


def count(name: str, n: int = 1) -> None:
    """Add n to the counter `name` of the innermost `counting()` block, if there is one."""
    counts = _counts.get()
    if counts is not None:
        counts[name] += n


@contextmanager
def timing(wait: Callable[[], None] = lambda: None, clock: Callable[[], float] = time.perf_counter) -> Iterator[dict[str, float]]:
    """Seconds of the stages that run inside the block, by name. wait: called at both ends of a stage, to let a device finish."""
    seconds: dict[str, float] = {}
    token = _timing.set((seconds, wait, clock))
    try:
        yield seconds
    finally:
        _timing.reset(token)


@contextmanager
def stage(name: str) -> Iterator[None]:
    """Adds the time of the block to the stage `name` of the innermost `timing()` block, if there is one. Stages do not nest."""
    timed = _timing.get()
    if timed is None:
        yield
        return
    seconds, wait, clock = timed
    wait()
    begin = clock()
    yield
    wait()
    seconds[name] = seconds.get(name, 0.0) + clock() - begin


def array_namespace(*arrays: Array) -> Any:
    """The array API of the arrays, `array_api_compat.array_namespace`, at once where all are NumPy arrays."""
    if all(type(a) is np.ndarray for a in arrays):
        return array_api_compat.numpy
    return array_api_compat.array_namespace(*arrays)


def fft_backend(size: int) -> Any:
    """Context in which SciPy's FFTs of NumPy arrays run on FFTW, if arrays of `size` values are large enough for it to pay."""
    if size < FFTW_PAYS_ABOVE:
        return nullcontext()
    import pyfftw.interfaces

    pyfftw.interfaces.cache.enable()
    return scipy.fft.set_backend(pyfftw.interfaces.scipy_fft)


def rfft(f: Array) -> Array:
    """Real FFT along the last axis."""
    xp = array_namespace(f)
    return scipy.fft.rfft(f) if is_numpy_namespace(xp) else xp.fft.rfft(f)


def irfft(f_hat: Array, n: int) -> Array:
    """Inverse of `rfft` for n real values along the last axis."""
    xp = array_namespace(f_hat)
    return scipy.fft.irfft(f_hat, n) if is_numpy_namespace(xp) else xp.fft.irfft(f_hat, n=n)


def to_numpy(a: Array) -> np.ndarray:
    """The values as a NumPy array (no copy where the memory allows it)."""
    return a.detach().cpu().numpy() if is_torch_array(a) else np.asarray(a)


def from_numpy(a: np.ndarray, like: Array) -> Array:
    """A NumPy array on the device of `like`; floating values take its dtype."""
    if is_numpy_array(like):
        return a.astype(like.dtype, copy=False) if a.dtype.kind == "f" else a
    xp = array_namespace(like)
    return xp.asarray(a, dtype=like.dtype if a.dtype.kind == "f" else None, device=device(like))


def on_cpu(a: Array) -> bool:
    """Whether compiled loops can work on the memory of `a`: a NumPy array, or a PyTorch tensor of the CPU."""
    return not is_torch_array(a) or a.device.type == "cpu"


def compiled(module: str) -> Any:
    """A module of compiled loops, set to run on `threads()` threads; numba is loaded here, where it is needed."""
    if "numba" not in sys.modules:
        os.environ.setdefault("NUMBA_NUM_THREADS", str(threads()))  # else it starts, and lets PyTorch start, one for every core
    import numba

    loops = import_module(module)
    wanted = min(threads(), numba.config.NUMBA_NUM_THREADS)
    if getattr(_compiled, "threads", None) != wanted:  # to ask numba takes a lock between processes
        numba.set_num_threads(wanted)
        _compiled.threads = wanted
    return loops


def solve(A: Array, b: Array) -> Array:
    """Batched dense solve. On the CPU always LAPACK through NumPy.

    PyTorch's batched LU on the CPU returns wrong values for n >= 160 with two threads (seen with torch 2.13).
    """
    if not on_cpu(A):
        return array_namespace(A).linalg.solve(A, b)
    return from_numpy(np.linalg.solve(to_numpy(A), to_numpy(b)), like=A)


def scatter_add(u: Array, index: Array, values: Array) -> Array:
    """u with values added at the rows `index` (repeated rows add up). u: (P, ...), index: (Q,), values: (Q, ...)."""
    if is_torch_array(u):
        return u.index_add(0, index, values)
    out = u.copy()
    np.add.at(out, index, values)
    return out


class Latest:
    """Remembers what was made for the `keep` objects last seen: known by their identity, so an array must not change in place."""

    def __init__(self, keep: int = 1) -> None:
        self._keep = keep
        self._seen: tuple[tuple[Any, Any], ...] = ()

    def of(self, key: Any, make: Callable[[], Any]) -> Any:
        """What `make()` gave for this very object, made now if it is another one."""
        for known, made in self._seen:
            if known is key:
                return made
        made = make()
        self._seen = (*self._seen, (key, made))[-self._keep :]
        return made


def threads() -> int:
    """Threads to use: OMP_NUM_THREADS where it is set, else the cores that this process may run on."""
    return max(1, int(os.environ.get("OMP_NUM_THREADS") or len(os.sched_getaffinity(0))))


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads())


@cache
def _blas() -> Any:
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController().select(user_api="blas")


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Context with BLAS on one thread: batches of small matrices gain nothing from more, and results do not depend on their number."""
    if _blas_single.get():
        yield
        return
    with _blas_on(1):
        yield


def all_blas_threads() -> Any:
    """Context with BLAS on all threads, for one large matrix, also within `one_blas_thread`."""
    return _blas_on(threads())


@contextmanager
def _blas_on(number: int) -> Iterator[None]:
    token = _blas_single.set(number == 1)
    try:
        with _blas().limit(limits=number):
            yield
    finally:
        _blas_single.reset(token)


def shares(start: int, stop: int, least: int, most: int) -> list[slice]:
    """[start, stop) in slices of nearly one size, at most `most`: a whole number for every thread where none is below `least` then."""
    count = max(1, stop - start)
    pieces = max(-(-count // most), min(count // least, threads() * -(-count // (threads() * most))), 1)
    return [slice(start + count * k // pieces, start + count * (k + 1) // pieces) for k in range(pieces)]


def parallel_map(function: Callable[[Any], Any], items: Sequence[Any]) -> list[Any]:
    """[function(item) for item in items], on threads; BLAS is kept to one thread in each. Counts of `counting()` are kept."""
    with one_blas_thread():
        if len(items) == 1 or threads() == 1:
            return [function(item) for item in items]
        contexts = [copy_context() for _ in items]
        return list(_pool().map(lambda c, item: c.run(function, item), contexts, items))


@lru_cache(maxsize=256)
def _cached(function: Any, args: tuple[Any, ...]) -> np.ndarray:
    return function(*args)


def constant(function: Any, *args: Any, like: Array) -> Array:
    """A table that depends on sizes alone, computed once in float64 and handed out on the device of `like`."""
    return from_numpy(_cached(function, args), like)
