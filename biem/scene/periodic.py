"""Periodic boxes of scenes, [domain] periodic = [Lx, Ly]: what goes with them, and the background flows that repeat themselves in them.

quiescent                   any box
shear                       any box: the images above and below slide along with the flow
taylor_green                sides that are multiples of 2 W
custom                      any velocity(x, y, t) with the periods Lx and Ly, tried at some points and times
"""

from __future__ import annotations

import numpy as np

from biem.curves.lattice import Box
from biem.scene.config import Scene, Vesicles
from biem.scene.flows import BackgroundFlow

POINTS, MOMENTS = 64, 3  # at which a custom flow is tried
REPEATS = 1e-6  # relative difference of a flow one period on, or of a side from a multiple of the flow's period


def box_of(scene: Scene, flow: BackgroundFlow) -> Box | None:
    """The periodic box of a scene in that flow, or None."""
    if scene.domain is None:
        return None
    rate = flow.rate if flow.kind == "shear" else None
    return Box(*scene.domain.periodic, rate or 0.0)


def check_domain(scene: Scene) -> None:
    """Raises ValueError for tables that a periodic box does not go with."""
    if scene.domain is None:
        return
    if scene.walls is not None:
        raise ValueError("[walls] enclose the fluid, domain.periodic repeats it without end: remove one of them")
    if np.any(np.asarray(scene.vesicles.contrast) != 1.0):
        raise ValueError("vesicles.contrast other than 1 does not go with domain.periodic, which has no sum of double layers: remove one")
    box, sides = scene.vesicles.box, scene.domain.periodic
    if box is not None and (box[0] > sides[0] or box[1] > sides[1]):
        raise ValueError(
            f"vesicles.box = {list(box)} does not fit into domain.periodic = {list(sides)}: leave it out, to fill the domain, or make it "
            "smaller"
        )


def in_domain(v: Vesicles, sides: tuple[float, float]) -> Vesicles:
    """The table with the domain as the box to be filled. Raises ValueError where it does not say how far."""
    if (v.count is None) == (v.area_fraction is None):
        raise ValueError(
            f'vesicles: placement = "{v.placement}" all over domain.periodic needs count or area_fraction, one of them (or a vesicles.box)'
        )
    return v.model_copy(update={"box": sides})


def check_size(box: Box, X: np.ndarray) -> None:
    """Raises ValueError where a vesicle of X (M, 2, N) is as large as the box."""
    extent = np.ptp(X, axis=-1)
    large = np.flatnonzero((extent >= [box.width, box.height]).any(axis=1))
    if len(large):
        w, h = extent[large[0]]
        raise ValueError(
            f"domain.periodic = [{box.width:g}, {box.height:g}] is no larger than vesicle {large[0]}, which measures {w:.4g} x {h:.4g}: "
            "choose a larger box"
        )


def check_flow(box: Box, flow: BackgroundFlow, horizon: float) -> None:
    """Raises ValueError for a flow that does not repeat itself in the box."""
    if flow.kind in ("extensional", "poiseuille", "rotation"):
        raise ValueError(
            f'flow.kind = "{flow.kind}" does not repeat itself from box to box, as domain.periodic needs it: choose quiescent, shear, '
            "taylor_green, a custom flow with the periods of the box, or leave out [domain]"
        )
    sides = (box.width, box.height)
    if flow.kind == "taylor_green":
        assert flow.width is not None
        for side in sides:
            periods = side / (2.0 * flow.width)
            if round(periods) < 1 or abs(periods - round(periods)) > REPEATS * periods:
                raise ValueError(
                    f"domain.periodic = [{box.width:g}, {box.height:g}]: the flow taylor_green of width {flow.width:g} repeats itself "
                    f"every {2 * flow.width:g}: choose multiples of that"
                )
    if flow.kind == "custom":
        x = np.random.default_rng(0).uniform(-0.5, 0.5, size=(1, 2, POINTS)) * np.array(sides)[:, None]
        for t in np.linspace(0.0, horizon, MOMENTS).tolist():
            u = flow.velocity(x, t)
            for name, period in (("x", [[box.width], [0.0]]), ("y", [[0.0], [box.height]])):
                off = float(np.abs(flow.velocity(x + np.array(period), t) - u).max())
                if off > REPEATS * float(np.abs(u).max()):
                    raise ValueError(
                        f"flow.function does not repeat itself in {name} with domain.periodic = [{box.width:g}, {box.height:g}]: one "
                        f"period on it differs by {off:.3g} at t = {t:g}; give it the periods of the box, or leave out [domain]"
                    )
