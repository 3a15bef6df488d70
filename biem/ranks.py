"""Vesicles dealt out to processes: every rank holds the whole state and works on its own vesicles; results are gathered.

Without MPI, or on one process, everything is here. An error on one rank is raised on all, so that none waits for another.
"""

from __future__ import annotations

import os
import traceback
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
        value, other, error = None, None, None
        try:
            value, other = function(self.mine(M))
        except Exception as failure:
            error = failure
        answers = self.comm.allgather((other, error))
        for _, raised in answers:
            if raised is not None:
                raise raised
        mine = np.ascontiguousarray(to_numpy(value))
        counts = [(M * (r + 1) // self.size - M * r // self.size) * int(np.prod(mine.shape[1:])) for r in range(self.size)]
        joined = np.empty((M, *mine.shape[1:]), mine.dtype)
        self.comm.Allgatherv(mine, [joined, counts])
        return from_numpy(joined, like=value), [other for other, _ in answers]

    def on_root(self, function: Callable[[], Any], share: bool = True) -> Any:
        """function() of the first rank, on all ranks; not shared: None on the others, which still wait for it."""
        if self.comm is None:
            return function()
        value, error = None, None
        if self.rank == 0:
            try:
                value = function()
            except Exception as failure:
                error = failure
        shared, error = self.comm.bcast((value if share else None, error))
        if error is not None:
            raise error
        return value if self.rank == 0 else shared

    def abort(self) -> None:
        """Ends all processes, if there is more than this one, after an error that only this one knows of."""
        if self.comm is not None:
            traceback.print_exc()
            self.comm.Abort(1)

    def any(self, flag: bool) -> bool:
        """Whether the flag is raised on any rank."""
        return flag if self.comm is None else any(self.comm.allgather(flag))


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
    if "OMP_NUM_THREADS" not in os.environ:  # the processes of a machine share its cores
        beside = MPI.COMM_WORLD.Split_type(MPI.COMM_TYPE_SHARED).size
        os.environ["OMP_NUM_THREADS"] = str(max(1, len(os.sched_getaffinity(0)) // beside))
    return Ranks(MPI.COMM_WORLD)
