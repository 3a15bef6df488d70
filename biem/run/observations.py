"""Files of observables: HDF5 that grows with a run, HDF5 or CSV in one piece. Each names its units and its definitions.

    t (F,), step (F,), suspension/NAME (F,) or (F, C), vesicles/NAME (F, M) or (F, M, C), pairs/NAME (F, P), pairs/index (P, 2),
    bins/NAME (F, B), bins/edges (B + 1,)      with the attributes unit, definition and, of C components, components

CSV is a table a place: with more than one place, NAME.csv for the suspension, NAME.vesicles.csv, NAME.pairs.csv, NAME.bins.csv. While a
file grows, new rows lie beside it in NAME.h5.rows/; `read_observations` reads both. Every file appears by a rename after a sync.
"""

from __future__ import annotations

import io
import shutil
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

from biem.observe.observables import Observations, join
from biem.observe.quantities import QUANTITIES, Place, Quantity
from biem.run.files import atomic_h5, one_line, write_atomically
from biem.run.growing import Growing, read_growing

SCHEMA = "observables 1"
PLACES: tuple[Place, ...] = ("suspension", "vesicles", "pairs", "bins")
ENDINGS = (".csv", ".h5")


def check_ending(path: Path) -> None:
    """Raises ValueError for a path of neither format."""
    if path.suffix not in ENDINGS:
        raise ValueError(f"observables go to a file that ends in {' or '.join(ENDINGS)}, not to {path}")


def write_observations(path: Path, rows: Observations) -> list[Path]:
    """Writes the file, or the files of a CSV with several places; returns their paths."""
    check_ending(path)
    if path.suffix == ".h5":
        _write_h5(path, rows)
        return [path]
    places = [place for place in PLACES if any(q.place == place for q in rows.quantities)]
    written = []
    for place in places:
        file = path if place == "suspension" or len(places) == 1 else path.with_suffix(f".{place}.csv")
        write_atomically(file, _csv(rows, place).encode())
        written.append(file)
    return written


def read_observations(path: Path) -> Observations:
    """All committed rows of an HDF5 file of observables, finished or growing. Raises ValueError if it is none."""
    return join(read_growing(path, _folder(path), _read_h5, lambda rows: rows.about.get("run")))


def are_observations(path: Path) -> bool:
    """Whether an HDF5 file holds observables, and no trajectory."""
    try:
        with h5py.File(path, "r") as file:
            return file.attrs.get("schema") == SCHEMA
    except OSError:
        return False


class ObservationWriter(Growing):
    """Adds rows to an HDF5 file; what is added is on the disk when `append` returns, `close` leaves one plain file."""

    def __init__(self, path: Path, rows: Observations) -> None:
        """Starts the file with rows, replacing what was there."""
        path.absolute().parent.mkdir(parents=True, exist_ok=True)
        super().__init__(path, _folder(path), rows, read_observations, _write_h5)


def remove(path: Path) -> None:
    """Removes a file of observables, also one that was growing."""
    path.unlink(missing_ok=True)
    shutil.rmtree(_folder(path), ignore_errors=True)


def _folder(path: Path) -> Path:
    return path.with_name(path.name + ".rows")


def _write_h5(path: Path, rows: Observations) -> None:
    with atomic_h5(path) as file:
        file.attrs["schema"] = SCHEMA
        for name, value in rows.about.items():
            file.attrs[name] = value
        file["t"], file["step"] = rows.t, rows.step
        file["t"].attrs["unit"] = "time"
        for q in rows.quantities:
            data = file.create_dataset(f"{q.place}/{q.name}", data=rows.values[q.name])
            data.attrs["unit"], data.attrs["definition"] = q.unit, q.definition
            if q.components:
                data.attrs["components"] = list(q.components)
        if len(rows.edges):
            file["bins/edges"] = rows.edges
            file["bins/edges"].attrs["unit"] = "length"
        if len(rows.pairs):
            file["pairs/index"] = rows.pairs


def _read_h5(path: Path) -> Observations:
    if not path.exists():
        raise FileNotFoundError(f"observables {path} do not exist")
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("schema") != SCHEMA:
                raise ValueError(f"{path} holds no {SCHEMA}: its schema is {file.attrs.get('schema')}")
            quantities = tuple(q for q in QUANTITIES.values() if f"{q.place}/{q.name}" in file)
            return Observations(
                file["t"][:],
                file["step"][:],
                {q.name: file[f"{q.place}/{q.name}"][:] for q in quantities},
                quantities,
                file["bins/edges"][:] if "bins/edges" in file else np.zeros(0),
                file["pairs/index"][:] if "pairs/index" in file else np.zeros((0, 2), dtype=np.int64),
                {name: value for name, value in file.attrs.items() if name != "schema"},
            )
    except OSError as error:
        if not path.exists():
            raise FileNotFoundError(f"observables {path} do not exist") from None
        raise ValueError(f"{path} cannot be read as HDF5: {one_line(error)}") from None


def _csv(rows: Observations, place: Place) -> str:
    """The table of a place: comment lines, names of columns, values that read back bit for bit."""
    quantities = [q for q in rows.quantities if q.place == place]
    keys, values = _keys(rows, place)
    text = io.StringIO()
    text.write("".join(f"# {line}\n" for line in _header(rows, quantities, keys)))
    text.write(",".join([*keys, *(name for q in quantities for name in columns(q))]) + "\n")
    blocks = [rows.values[q.name] for q in quantities]
    flat = [block.reshape(*block.shape[: values[0].ndim], -1) for block in blocks]
    table = np.concatenate([b.reshape(-1, b.shape[-1]) for b in flat], axis=1) if flat else np.zeros((len(rows), 0))
    for key, row in zip(zip(*(v.ravel().tolist() for v in values), strict=True), table.tolist(), strict=True):
        text.write(",".join(repr(v) for v in (*key, *row)) + "\n")
    return text.getvalue()


def columns(quantity: Quantity) -> list[str]:
    """Names of its columns."""
    return [f"{quantity.name}_{c}" for c in quantity.components] or [quantity.name]


def _keys(rows: Observations, place: Place) -> tuple[list[str], list[np.ndarray]]:
    """Names and values of the columns that say what a line is of: arrays of one shape, (F,), (F, M), (F, P) or (F, B)."""
    t, step = rows.t, rows.step
    if place == "suspension":
        return ["t", "step"], [t, step]
    if place == "vesicles":
        own = {"vesicle": np.arange(next(rows.values[q.name].shape[1] for q in rows.quantities if q.place == place))}
    elif place == "pairs":
        own = {"i": rows.pairs[:, 0], "j": rows.pairs[:, 1]}
    else:
        own = {"bin_low": rows.edges[:-1], "bin_high": rows.edges[1:]}
    shape = (len(rows), len(next(iter(own.values()))))
    wide = [np.broadcast_to(a[:, None], shape) for a in (t, step)]
    return ["t", "step", *own], [*wide, *(np.broadcast_to(a, shape) for a in own.values())]


def _header(rows: Observations, quantities: list[Quantity], keys: list[str]) -> Iterator[str]:
    yield SCHEMA
    for name, value in rows.about.items():
        yield f"{name}: {value}"
    about = {
        "t": "t [time]",
        "step": "step [1]: number of the step",
        "vesicle": "vesicle [1]: its number, from 0",
        "i": "i, j [1]: vesicles",
    }
    about |= {"bin_low": "bin_low, bin_high [length]: edges of the bin in y"}
    for key in keys:
        if key in about:
            yield about[key]
    for q in quantities:
        yield f"{', '.join(columns(q))} [{q.unit}]: {q.definition}"
