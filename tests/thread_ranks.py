"""Ranks on threads of one process: what processes do together, without MPI."""

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import numpy as np
from limits import LIMIT

from biem.ranks import Ranks


class Together:
    """As much of a communicator as Ranks needs, for threads of one process."""

    def __init__(self, size):
        self.size = size
        self.barrier = Barrier(size, timeout=LIMIT)
        self.board = [None] * size

    def of(self, rank):
        comm = Together.__new__(Together)
        comm.__dict__.update(self.__dict__, rank=rank)
        return comm

    def allgather(self, value):
        self.board[self.rank] = value
        self.barrier.wait()
        values = list(self.board)
        self.barrier.wait()
        return values

    def bcast(self, value, root=0):
        return self.allgather(value)[root]

    def Allgatherv(self, mine, into):
        joined, counts = into
        parts = self.allgather(np.array(mine))
        assert [p.size for p in parts] == counts
        joined.ravel()[:] = np.concatenate([p.ravel() for p in parts])


def on_threads(size, function):
    """function(ranks) on each of `size` ranks; what each returned, or the exception that it raised."""
    together = Together(size)

    def one(rank):
        try:
            return function(Ranks(together.of(rank)))
        except Exception as error:
            return error

    with ThreadPoolExecutor(size) as pool:
        return list(pool.map(one, range(size)))
