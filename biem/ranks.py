"""Vesicles dealt out to processes: every rank holds the whole state and works on its own vesicles; results are gathered.

Without MPI, or on one process, everything is here. Whatever the ranks do together begins with an exchange of messages, and a rank that
fails in between puts its error into the exchange that the others are at or will come to: it is raised on all, and none waits in vain.
"""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from biem.backend import Array, from_numpy, to_numpy


@dataclass(frozen=True)
class Ranks:
    """The processes of a run. comm: an mpi4py communicator, or None for one process."""

    comm: Any = None

    @property
    def size(self) -> int:
        return 1 if self.comm is None else int(self.comm.size)

    @property
    def rank(self) -> int:
        return 0 if self.comm is None else int(self.comm.rank)

    def mine(self, M: int) -> slice:
        """This rank's share of M vesicles."""
        return slice(self.rank * M // self.size, (self.rank + 1) * M // self.size)

    def gather(self, M: int, function: Callable[[slice], Array]) -> Array:
        """function(slice of vesicles) -> (m, ...) of every rank, joined to (M, ...) on every rank."""
        return self.gather_all(M, lambda mine: (function(mine), None))[0]

    def gather_all(self, M: int, function: Callable[[slice], tuple[Array, Any]]) -> tuple[Array, list[Any]]:
        """The same for function(slice) -> (array, anything): the joined array, and the other values of all ranks."""
        if self.comm is None:
            value, other = function(slice(0, M))
            return value, [other]
        value, other = self._or_tell(lambda: function(self.mine(M)))
        others = self._exchange(other)
        mine = np.ascontiguousarray(to_numpy(value))
        counts = [(M * (r + 1) // self.size - M * r // self.size) * int(np.prod(mine.shape[1:])) for r in range(self.size)]
        joined = np.empty((M, *mine.shape[1:]), mine.dtype)
        self.comm.Allgatherv(mine, [joined, counts])
        return from_numpy(joined, like=value), others

    def on_root(self, function: Callable[[], Any], share: bool = True) -> Any:
        """function() of the first rank, on all ranks; not shared: None on the others, which still wait for it."""
        if self.comm is None:
            return function()
        value = self._or_tell(function) if self.rank == 0 else None
        shared = self._exchange(value if share else None)[0]
        return value if self.rank == 0 else shared

    def together(self, function: Callable[[], Any]) -> Any:
        """function() of each rank; an error in it, also outside of what the ranks do together, is raised on all."""
        if self.comm is None:
            return function()
        value = self._or_tell(function)
        self._exchange(None)
        return value

    def any(self, flag: bool) -> bool:
        """Whether the flag is raised on any rank."""
        return flag if self.comm is None else any(self._exchange(flag))

    def _exchange(self, message: Any, error: Exception | None = None) -> list[Any]:
        """The messages of all ranks; raises the first error among them."""
        answers = self.comm.allgather((message, error))
        for _, told in answers:
            if told is not None:
                told.told = True
                raise told
        return [answer for answer, _ in answers]

    def _or_tell(self, function: Callable[[], Any]) -> Any:
        try:
            return function()
        except BaseException as error:
            if not getattr(error, "told", False):
                self._exchange(None, _portable(error))  # raises it, here as on all other ranks
            raise


def _portable(error: BaseException) -> Exception:
    """The error, or what it says where it cannot be sent."""
    try:
        copy = pickle.loads(pickle.dumps(error))
        if isinstance(copy, Exception) and str(copy) == str(error):
            return copy
    except Exception:  # whatever a foreign class does on its way
        pass
    return RuntimeError(f"{type(error).__name__}: {error}")


ALONE = Ranks()
LAUNCHERS = ("PMI_SIZE", "OMPI_COMM_WORLD_SIZE", "SLURM_STEP_NUM_TASKS")  # where mpirun and srun tell the number of processes


def world() -> Ranks:
    """The ranks that mpirun started, or this process alone; mpi4py is loaded only under mpirun (or srun)."""
    launched = next((int(os.environ[name]) for name in LAUNCHERS if name in os.environ), 1)
    if launched == 1:
        return Ranks()
    try:
        from mpi4py import MPI
    except ImportError:
        raise ValueError(f"started as one of {launched} processes, but mpi4py is not installed: pip install 'vesnet[mpi]'") from None
    if MPI.COMM_WORLD.size == 1:
        raise ValueError(f"one of {launched} processes, but mpi4py's MPI sees one: start it with the mpirun that mpi4py was installed for")
    if not os.environ.get("OMP_NUM_THREADS"):  # the processes of a machine share its cores
        beside = MPI.COMM_WORLD.Split_type(MPI.COMM_TYPE_SHARED).size
        os.environ["OMP_NUM_THREADS"] = str(max(1, len(os.sched_getaffinity(0)) // beside))
    return Ranks(MPI.COMM_WORLD)
