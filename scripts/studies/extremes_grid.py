"""The extremes: a base scene, and every axis along which it is driven away from it, one axis at a time, by each rung.

The base is two relaxed vesicles of reduced area 0.65 in shear (Ca = 5, N = 32, dt = 1e-5 mu L^3/kappa_b, 40 steps), or one of them.
Networks take no other steps than multiples of 1e-5: theirs stay so where the exact rungs follow the flow, dt = 0.02 t_gamma.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from biem.curves.fourier import coefficients, evaluate, remove_nyquist
from biem.curves.shapes import equilibrium, place
from biem.run.files import atomic_h5, write_atomically

Tables = Mapping[str, Any]  # a scene file's
RUNGS = ("implicit", "split", "vesnet:hybrid", "vesnet:mlp", "vesnet:ivnet")
STEP, STEPS = 1e-5, 40
OF_T_GAMMA = 0.02  # dt of the exact rungs in fast flows
REDUCED_AREA = 0.65
FINER_TOLERANCE = 1e-4  # of a finer run whose steps must follow a gap
BOUND = 600.0  # s of a small case, seconds where nothing else runs
LONG_BOUND = 5400.0
REFINED = {16: 64, 32: 64, 64: 128, 128: 128, 512: 128}  # nodes of the finer run that a case is held against


@dataclass(frozen=True)
class Against:
    """What a case is held against: the run of `scene`, shifted by offset + velocity t and scaled in length and time."""

    what: str
    scene: Tables
    length: float = 1.0
    time: float = 1.0
    offset: tuple[float, float] = (0.0, 0.0)
    velocity: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Case:
    """One place of the grid. bound: wall seconds; long: not among the cases that run unless they are asked for; fast: of the tests."""

    axis: str
    value: str
    rung: str
    scene: Tables
    against: Against | None = None
    bound: float = BOUND
    long: bool = False
    fast: bool = False

    @property
    def name(self) -> str:
        return f"{self.axis}, {self.value}, {self.rung}"


def learned(rung: str) -> bool:
    """Whether its time steps are those of networks."""
    return rung.startswith("vesnet")


def radius(reduced_area: float = REDUCED_AREA) -> float:
    """R of a membrane of length 1."""
    return math.sqrt(reduced_area) / (2 * math.pi)


def merged(*tables: Tables) -> dict[str, Any]:
    """Tables of scenes, the keys of the later ones over those of the earlier ones; None takes a table, or a key, away."""
    scene: dict[str, Any] = {}
    for table in tables:
        for name, value in deepcopy(dict(table)).items():
            if isinstance(value, Mapping):
                own = scene.setdefault(name, {})
                own.update(value)
                scene[name] = {key: v for key, v in own.items() if v is not None}
            else:
                scene[name] = value
    return {name: value for name, value in scene.items() if value is not None}


def by_rung(scene: Tables, rung: str) -> dict[str, Any]:
    """The scene by that rung."""
    kind, _, maps = rung.partition(":")
    return merged(scene, {"solver": {"kind": kind, "maps": maps or None}})


def times(dt: float, steps: float = STEPS, save_every: int = 4) -> dict[str, Any]:
    """[time] of so many steps."""
    return {"time": {"dt": dt, "horizon": dt * steps, "save_every": save_every}}


def pair(dt: float = STEP, capillary: float = 5.0) -> dict[str, Any]:
    """The base of two vesicles."""
    return {
        "name": "pair",
        "vesicles": {
            "shape": "equilibrium",
            "reduced_area": REDUCED_AREA,
            "points": 32,
            "unit": "R",
            "centers": [[-2.3, 0.3], [0.0, 0.0]],
            "angles": [0.0, math.pi / 2],
        },
        "flow": {"kind": "shear", "capillary": capillary},
        **times(dt),
        "solver": {},
        "output": {"checkpoint_every": STEPS},
    }


def single(dt: float = STEP, capillary: float = 5.0) -> dict[str, Any]:
    """The base of one vesicle."""
    return merged(pair(dt, capillary), {"name": "single", "vesicles": {"unit": None, "centers": [[0.0, 0.0]], "angles": [1.0]}})


def refined(scene: Tables) -> dict[str, Any]:
    """The scene by the split solver of second order, at more nodes and half the step, with frames at the same times."""
    finer: dict[str, Any] = {"time": {"dt": 0.5 * scene["time"]["dt"], "save_every": 2 * scene["time"]["save_every"], "order": 2}}
    if "points" in scene["vesicles"]:
        finer["vesicles"] = {"points": REFINED[scene["vesicles"]["points"]]}
    return merged(merged(scene, {"solver": None}), finer, {"solver": {"kind": "split"}})


def against_refined(scene: Tables) -> Against:
    return Against("a finer run", refined(scene))


def grid() -> list[Case]:
    """All cases."""
    return [case for axis in AXES.values() for rung in RUNGS for case in axis(rung)]


def _capillary(rung: str) -> Iterator[Case]:
    for capillary in (0.0, 1e-3, 1.0, 5.0, 50.0, 500.0, 1e4):
        scene = pair(_step(capillary, rung), capillary)
        yield _finer("capillary", f"{capillary:g}", rung, scene, fast=(capillary, rung) == (1e4, "vesnet:hybrid"))


def _confinement(rung: str) -> Iterator[Case]:
    for confinement in (0.025, 0.2, 0.4, 0.75, 0.95):
        width = radius() / confinement
        flow = {"kind": "poiseuille", "capillary": 5.0, "confinement": confinement}
        vesicle = {"centers": [[0.0, 0.2 * width]], "angles": [0.0]}
        yield _finer("confinement", f"{confinement:g}", rung, merged(single(), {"flow": flow, "vesicles": vesicle}))


def _reduced_area(rung: str) -> Iterator[Case]:
    for reduced_area in (0.3, 0.5, 0.65, 0.9, 0.99, 1.0):
        scene = merged(single(), {"vesicles": {"reduced_area": reduced_area}})
        yield _finer("reduced-area", f"{reduced_area:g}", rung, scene)
    ellipse = merged(single(), {"vesicles": {"reduced_area": 0.3, "shape": "ellipse"}})
    yield _finer("reduced-area", "0.3, ellipse", rung, ellipse)
    wild = merged(single(), {"vesicles": {"reduced_area": 0.3, "shape": "perturbed"}})
    yield Case("reduced-area", "0.3, random shape", rung, by_rung(wild, rung))


def _gap(rung: str) -> Iterator[Case]:
    for gap in (1e-1, 1e-2, 1e-3, 1e-4):
        scene = merged(pair(), {"vesicles": facing(gap)})
        adaptive = merged(refined(scene), {"time": {"adaptive": True, "tolerance": FINER_TOLERANCE, "save_every": 1}})
        yield Case("gap", f"{gap:g}", rung, by_rung(scene, rung), Against("a finer run", adaptive))


def _points(rung: str) -> Iterator[Case]:
    for points in (16, 32, 64, 128, 512):
        steps = STEPS if points < 512 else 8
        scene = merged(pair(), {"vesicles": {"points": points}}, times(STEP, steps, 1))
        yield _finer("nodes", f"{points}", rung, scene, bound=BOUND if points < 512 else 900.0, long=points == 512 and not learned(rung))


def _count(rung: str) -> Iterator[Case]:
    yield _finer("vesicles", "1", rung, single())
    yield _finer("vesicles", "2", rung, pair())
    for count, steps in ((2000, 4), (10000, 2)):
        box = [33.6 * math.sqrt(count / 2000), 10.265 * math.sqrt(count / 2000)]
        crowd = {"placement": "random", "count": count, "box": box, "gap": 0.03, "seed": 1, "unit": None, "centers": None, "angles": None}
        flow = {"kind": "poiseuille", "capillary": 2.0, "width": 0.5 * box[1]}
        scene = merged(pair(), {"vesicles": crowd, "flow": flow}, times(STEP, steps, 1))
        yield Case("vesicles", f"{count}", rung, by_rung(scene, rung), bound=LONG_BOUND, long=True)


def _precision(rung: str) -> Iterator[Case]:
    for name, base in (("one", single()), ("two", pair())):
        scene = by_rung(base, rung)
        low = merged(scene, {"solver": {"dtype": "float32"}})
        yield _finer("precision", f"float64, {name}", rung, base)
        yield Case(
            "precision", f"float32, {name}", rung, low, Against("float64", scene), fast=name == "two" and rung in ("implicit", "split")
        )


def _far(rung: str) -> Iterator[Case]:
    """Shear is the same at (1000, 0); at (0, 1000) it adds a velocity."""
    rate = 5.0 / radius() ** 3
    base = merged(pair(), {"vesicles": {"unit": None, "centers": [[-2.3 * radius(), 0.3 * radius()], [0.0, 0.0]]}})
    for value, offset, velocity in (("(1000, 0)", (1000.0, 0.0), 0.0), ("(0, 1000)", (0.0, 1000.0), 1000.0 * rate)):
        centers = [[x + offset[0], y + offset[1]] for x, y in base["vesicles"]["centers"]]
        against = Against("the same at the origin", by_rung(base, rung), offset=offset, velocity=(velocity, 0.0))
        yield Case("far", value, rung, by_rung(merged(base, {"vesicles": {"centers": centers}}), rung), against)
    lost = merged(single(), {"vesicles": {"centers": [[1e17, 0.0]]}})
    yield Case("far", "(1e17, 0)", rung, by_rung(lost, rung))


def _clustered(rung: str) -> Iterator[Case]:
    even = merged(pair(), {"vesicles": dict.fromkeys(pair()["vesicles"]) | {"file": "clustered-0.h5"}})
    for strength in CLUSTERED:
        scene = merged(even, {"vesicles": {"file": f"clustered-{strength:g}.h5"}})
        yield Case("clustered", f"{strength:g}", rung, by_rung(scene, rung), Against("even nodes", by_rung(even, rung)))
    moved = merged(even, {"vesicles": {"file": "node-off.h5"}})
    yield Case("clustered", "a node one spacing off", rung, by_rung(moved, rung))


def _units(rung: str) -> Iterator[Case]:
    """The base in other units, which scale out: lengths by L, times by mu L^3 / kappa_b."""
    base = by_rung(pair(), rung)
    for kappa_b, mu, length in ((1e-19, 1e-3, 1e-5), (1e19, 1e3, 1e5), (1e-60, 1e-60, 1e-60)):
        unit = mu * length**3 / kappa_b
        own = {"physics": {"kappa_b": kappa_b, "mu": mu}, "vesicles": {"length": length}}
        against = Against("natural units", base, length=length, time=unit)
        yield Case("units", f"kappa_b {kappa_b:g}, mu {mu:g}, L {length:g}", rung, merged(base, own, times(STEP * unit)), against)


def _long(rung: str) -> Iterator[Case]:
    for name, base, steps in (("one vesicle, 1e5", single(), 100_000), ("two vesicles, 1e4", pair(), 10_000)):
        scene = merged(base, times(STEP, steps, save_every=steps // 100), {"output": {"checkpoint_every": steps // 100}})
        yield Case("steps", name, rung, by_rung(scene, rung), bound=4 * LONG_BOUND, long=True)


def _input(rung: str) -> Iterator[Case]:
    """What a scene may be told wrongly, or unusually: of the rungs with networks by one."""
    if rung in ("vesnet:mlp", "vesnet:ivnet"):
        return
    crowd = {"count": 20, "unit": None, "centers": None, "angles": None}
    flows = {"kind": "custom", "capillary": None}
    scenes = {
        "random packing, 90 %": {"vesicles": crowd | {"placement": "random", "area_fraction": 0.9}},
        "grid, 90 %": {"vesicles": crowd | {"placement": "grid", "area_fraction": 0.9}},
        "membranes touch": {"vesicles": facing(0.0)},
        "one within the other": {"vesicles": {"centers": [[0.0, 0.0], [0.0, 0.0]]}},
        "reduced area 1e-3": {"vesicles": single()["vesicles"] | {"reduced_area": 1e-3, "shape": "ellipse", "unit": None}},
        "reduced area 1.1": {"vesicles": {"reduced_area": 1.1}},
        "flow reversed": {"flow": {"capillary": -5.0}},
        "flow of Ca 1e30": {"flow": {"capillary": 1e30}},
        "flow of Ca 1e300": {"flow": {"capillary": 1e300}},
        "flow of Ca NaN": {"flow": {"capillary": math.nan}},
        "horizon 0": {"time": {"horizon": 0.0}},
        "dt 0": {"time": {"dt": 0.0}},
        "dt negative": {"time": {"dt": -STEP}},
        "dt beyond the horizon": {"time": {"dt": 10 * STEP, "horizon": STEP}},
        "dt 1e-9 of the base": {"time": {"dt": 1e-9 * STEP, "horizon": 4e-9 * STEP}},
        "kappa_b 1e-300": {"physics": {"kappa_b": 1e-300}},
        "repulsion without bound": {"solver": {"repulsion": {"reach": 0.1, "strength": 1e12}}},
        "custom flow, NaN at the start": {"flow": flows | {"function": "flows.nowhere"}},
        "custom flow, NaN later": {"flow": flows | {"function": "flows.ends"}},
        "custom flow, 1e300": {"flow": flows | {"function": "flows.huge"}},
        "custom flow, raises later": {"flow": flows | {"function": "flows.raises"}},
    }
    fast = {("horizon 0", "split"), ("custom flow, NaN later", "split")}
    for value, change in scenes.items():
        yield Case("input", value, rung, by_rung(merged(pair(), change), rung), fast=(value, rung) in fast)
    wave = merged(pair(), {"flow": flows | {"function": "flows.wave"}})
    yield _finer("input", "custom flow of time", rung, wave)


FLOWS = f"""import numpy as np

RATE = {5.0 / radius() ** 3!r}
LATER = {STEP * 20!r}


def nowhere(x, y, t):
    return np.nan * y, 0.0


def ends(x, y, t):
    return (RATE if t < LATER else np.nan) * y, 0.0


def huge(x, y, t):
    return 1e300 * y, 0.0


def raises(x, y, t):
    if t > LATER:
        raise KeyError("no such time")
    return RATE * y, 0.0


def wave(x, y, t):
    return RATE * np.cos(RATE * t) * y, 0.0
"""
CLUSTERED = (0.5, 0.9, 0.99)  # nodes at alpha + strength sin(alpha), crowded about alpha = pi


def write_inputs(folder: Path) -> None:
    """The files that cases take: shapes and flows."""
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / "flows.py", FLOWS.encode())
    even = 2 * np.pi * np.arange(32) / 32
    for strength in (0.0, *CLUSTERED):
        _write_shapes(folder / f"clustered-{strength:g}.h5", _two(even + strength * np.sin(even)))
    off = _two(even)
    off[0, :, 5] = off[0, :, 6] + 0.02 * (off[0, :, 4] - off[0, :, 6])
    _write_shapes(folder / "node-off.h5", off)


def _two(alpha: np.ndarray) -> np.ndarray:
    """The pair of the base with nodes at the parameters alpha (N,): (2, 2, N)."""
    X = evaluate(coefficients(equilibrium(256, REDUCED_AREA)[None]), alpha[None])[0]
    places = zip(pair()["vesicles"]["centers"], pair()["vesicles"]["angles"], strict=True)
    return remove_nyquist(np.stack([place(X, radius() * np.array(center), angle) for center, angle in places]))


def _write_shapes(path: Path, X: np.ndarray) -> None:
    with atomic_h5(path) as file:
        file["X"] = X


@cache
def _width() -> float:
    """Of the base's vesicle across its long axis."""
    return float(np.ptp(equilibrium(1024, REDUCED_AREA)[1]))


def facing(gap: float) -> dict[str, Any]:
    """[vesicles] of two upright ones side by side, `gap` lengths between them."""
    x = 0.5 * (_width() + gap)
    return {"unit": "length", "centers": [[-x, 0.0], [x, 0.0]], "angles": [math.pi / 2, math.pi / 2]}


def _step(capillary: float, rung: str) -> float:
    return STEP if learned(rung) or not capillary else min(STEP, OF_T_GAMMA * radius() ** 3 / capillary)


def _finer(axis: str, value: str, rung: str, scene: Tables, **more: Any) -> Case:
    return Case(axis, value, rung, by_rung(scene, rung), against_refined(scene), **more)


AXES: Mapping[str, Callable[[str], Iterator[Case]]] = {
    "capillary": _capillary,
    "confinement": _confinement,
    "reduced-area": _reduced_area,
    "gap": _gap,
    "nodes": _points,
    "vesicles": _count,
    "precision": _precision,
    "far": _far,
    "clustered": _clustered,
    "units": _units,
    "steps": _long,
    "input": _input,
}
