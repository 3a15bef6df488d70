"""Checks of a finished or running trajectory file, recomputed from its membranes."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np

from biem.curves.crossing import fluid_region, outside_region, pair_crossings, self_crossings
from biem.curves.curve import area, bending_energy, length
from biem.run.trajectory import Trajectory


@dataclass(frozen=True)
class Check:
    """One check: its name, whether it holds, and the number behind it."""

    name: str
    passed: bool
    detail: str


def verify(trajectory: Trajectory) -> list[Check]:
    """Finite values, rising times, areas and lengths against the first frame, crossings, stored energies."""
    X, t = trajectory.X, trajectory.t
    scene = json.loads(trajectory.attributes["scene"])
    finite = bool(np.isfinite(X).all() and np.isfinite(t).all() and (trajectory.sigma is None or np.isfinite(trajectory.sigma).all()))
    checks = [Check("finite values", finite, f"{len(t)} frames of {X.shape[1]} vesicles, {X.shape[-1]} nodes")]
    rising = bool(np.all(np.diff(t) > 0) and np.all(np.diff(trajectory.step) > 0))
    checks.append(Check("times rise", rising, f"{t[0]:g} to {t[-1]:.6g}"))
    if not finite:
        return checks
    bound = scene["solver"]["max_error"]
    corrected = "area_length" in scene["solver"]["corrections"]
    limit = 1e-9 if corrected else bound
    for name, measure in (("area", area), ("length", length)):
        drift = max(float(np.abs(measure(frame) / measure(X[0]) - 1.0).max()) for frame in X)
        checks.append(Check(f"{name} kept", drift <= limit, f"largest drift {drift:.1e}, allowed {limit:.0e}"))
    crossed = [k for k in range(len(t)) if self_crossings(X[k]) or pair_crossings(X[k], None, trajectory.lattice(k))]
    checks.append(Check("no crossing", not crossed, f"frames {crossed[:5]}" if crossed else "none"))
    if "walls" in trajectory.attributes:
        region = fluid_region(trajectory.attributes["walls"])
        out = [k for k in range(len(t)) if outside_region(X[k], region)]
        checks.append(Check("between the walls", not out, f"frames {out[:5]}" if out else "all vesicles"))
    stored = trajectory.diagnostics["bending_energy"]
    energy = np.array([float(bending_energy(frame, scene["physics"]["kappa_b"]).sum()) for frame in X])
    off = float(np.abs(energy / stored - 1.0).max())
    checks.append(Check("energies match", off < 1e-9, f"largest difference {off:.1e}"))
    return checks
