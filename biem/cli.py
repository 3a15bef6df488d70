"""What the command lines of all packages share: errors in one line with an exit code, work of the first rank alone.

Exit codes: 0 done, 2 bad input, 3 failed computation or check, 4 stopped by a signal, 5 file error.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

import typer

from biem.errors import NumericalFailure
from biem.ranks import ALONE, Ranks, world
from biem.run.simulate import Stopped


@contextmanager
def one_line_errors(ranks: Ranks = ALONE) -> Iterator[None]:
    """Errors that are the input's or the disk's end in one line, of the first rank, and an exit code, not in a traceback."""
    try:
        yield
    except NumericalFailure as error:
        fail(str(error), 3, ranks)
    except Stopped as stopped:
        fail(str(stopped), 4, ranks)
    except FileNotFoundError as error:
        fail(str(error), 2, ranks)
    except OSError as error:
        fail(f"file error: {error}", 5, ranks)
    except (ValueError, MemoryError) as error:
        fail(str(error), 2, ranks)


def fail(message: str, code: int, ranks: Ranks = ALONE) -> None:
    """Ends the command, on the first rank with a line."""
    if ranks.rank == 0:
        typer.echo(f"error: {message}", err=True)
    raise typer.Exit(code)


def read_part(text: str) -> tuple[int, int]:
    """(K, P) of --part "K/P": of P processes that share the work and do not know each other, the K-th, from 1. Raises ValueError."""
    found = re.fullmatch(r"(\d+)/(\d+)", text.strip())
    if not found or not 1 <= int(found[1]) <= int(found[2]):
        raise ValueError(f'--part {text}: expected K/P with K from 1 to P, as in "2/8"')
    return int(found[1]), int(found[2])


def first_rank_only() -> None:
    """The other ranks end here."""
    with one_line_errors():
        if world().rank > 0:
            raise typer.Exit
