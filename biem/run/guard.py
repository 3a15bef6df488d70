"""The step guard: what is not a valid state is rejected, with the numbers."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import shapely

from biem.backend import Array, to_numpy
from biem.curves.crossing import outside_region, pair_crossings, polygons, self_crossings
from biem.curves.lattice import Lattice
from biem.errors import NumericalFailure


def check_state(
    X: Array,
    sigma: Array | None,
    diagnostics: Mapping[str, float],
    max_error: float,
    region: shapely.Polygon | None = None,
    lattice: Lattice | None = None,
) -> None:
    """Raises NumericalFailure for values not finite, area or length errors above max_error, membranes that cross or leave the region.

    lattice: the images, in a periodic box: membranes must not cross these either.
    """
    values = to_numpy(X)
    bad = np.flatnonzero(~np.isfinite(values).all(axis=(1, 2)))
    if len(bad):
        raise NumericalFailure(f"vesicle {bad[0]} has non-finite nodes ({len(bad)} vesicle(s) do)")
    if sigma is not None and not np.isfinite(to_numpy(sigma)).all():
        raise NumericalFailure("the tension is not finite")
    for name in ("area", "length"):
        error = diagnostics.get(f"{name}_error", 0.0)
        if not error <= max_error:
            raise NumericalFailure(
                f"{name} of vesicle {int(diagnostics[f'{name}_error_vesicle'])} is off by {error:.2e} (solver.max_error = {max_error:g})"
            )
    shapes = polygons(values)
    crossed = self_crossings(values, shapes)
    if crossed:
        raise NumericalFailure(f"vesicle {crossed[0]} crosses itself")
    pairs = pair_crossings(values, shapes, lattice)
    if pairs and pairs[0][0] == pairs[0][1]:
        raise NumericalFailure(f"vesicle {pairs[0][0]} crosses its own image: the periodic box is too small for it")
    if pairs:
        raise NumericalFailure(f"vesicles {pairs[0][0]} and {pairs[0][1]} cross ({len(pairs)} pair(s) in all)")
    out = [] if region is None else outside_region(values, region, shapes)
    if out:
        raise NumericalFailure(f"vesicle {out[0]} crosses a wall ({len(out)} vesicle(s) do)")
