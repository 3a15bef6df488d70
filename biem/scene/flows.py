"""Background flows u_inf(x, y): each one is scaled by a shear rate, which gives its time unit t_gamma = 1/rate.

    kind          velocity                                                    rate is
    quiescent     0                                                           -
    shear         rate (y, 0)                                                 the shear rate
    extensional   rate (x, -y)                                                the strain rate
    poiseuille    u_max (1 - (y/W)^2, 0)                                      u_max / W
    taylor_green  U (sin(pi x/W) cos(pi y/W), -cos(pi x/W) sin(pi y/W))       U / W
    rotation      rate (W/r)^2 (-y, x), irrotational but at the origin        the angular velocity at r = W
    custom        a Python callable velocity(x, y, t) -> (u, v)               given in the scene, or none

Capillary numbers are mu R^3 rate / kappa_b, in Poiseuille flow twice that; Cn = R/W. Paper, section 4.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from biem.backend import Array, array_namespace, to_numpy

KINDS = ("quiescent", "shear", "extensional", "poiseuille", "taylor_green", "rotation", "custom")
NEEDS_WIDTH = ("poiseuille", "taylor_green", "rotation")
SINGULAR_WITHIN = 1e-6  # radius about the centre of `rotation`, in units of its width, where it is refused


@dataclass(frozen=True)
class BackgroundFlow:
    """velocity(X, t) for X (M, 2, N); rate is the shear rate (None for custom flows without one), width its length scale."""

    kind: str
    velocity: Callable[[Array, float], Array]
    rate: float | None
    width: float | None = None

    @property
    def time_scale(self) -> float | None:
        """t_gamma = 1/rate, or None."""
        return None if not self.rate else 1.0 / abs(self.rate)


def capillary_factor(kind: str) -> float:
    """Ca = factor mu R^3 rate / kappa_b."""
    return 2.0 if kind == "poiseuille" else 1.0


def make_flow(
    kind: str, rate: float | None = None, width: float | None = None, function: str | None = None, folder: Path = Path(".")
) -> BackgroundFlow:
    """The flow of that kind. Raises ValueError for an unknown kind or a missing rate, width or function.

    The module of a custom function is looked for in `folder`, then among the installed ones.
    """
    if kind not in KINDS:
        raise ValueError(f'flow.kind = "{kind}": expected one of ' + ", ".join(KINDS))
    if kind == "quiescent":
        return BackgroundFlow(kind, lambda X, t: 0.0 * X, None)
    if kind == "custom":
        return BackgroundFlow(kind, _custom(function, folder), rate, width)
    if rate is None:
        raise ValueError(f"flow {kind} needs a rate (or u_max, or capillary)")
    if kind in NEEDS_WIDTH and not width:
        raise ValueError(f"flow {kind} needs a width")
    W = width or 1.0
    formula: dict[str, Callable[[Any, Array, Array], tuple[Array, Array]]] = {
        "shear": lambda xp, x, y: (rate * y, 0.0 * y),
        "extensional": lambda xp, x, y: (rate * x, -rate * y),
        "poiseuille": lambda xp, x, y: (rate * W * (1.0 - (y / W) ** 2), 0.0 * y),
        "taylor_green": lambda xp, x, y: (
            rate * W * xp.sin(xp.pi * x / W) * xp.cos(xp.pi * y / W),
            -rate * W * xp.cos(xp.pi * x / W) * xp.sin(xp.pi * y / W),
        ),
        "rotation": lambda xp, x, y: _vortex(xp, x, y, rate, W),
    }

    def velocity(X: Array, t: float) -> Array:
        xp = array_namespace(X)
        return xp.stack(formula[kind](xp, X[:, 0], X[:, 1]), axis=1)

    return BackgroundFlow(kind, velocity, rate, width)


def _vortex(xp: Any, x: Array, y: Array, rate: float, W: float) -> tuple[Array, Array]:
    r2 = x * x + y * y
    if float(xp.min(r2)) < (SINGULAR_WITHIN * W) ** 2:
        raise ValueError("the flow rotation is singular at the origin: keep points away from it")
    scale = rate * W * W / r2
    return -scale * y, scale * x


def _custom(function: str | None, folder: Path) -> Callable[[Array, float], Array]:
    if not function:
        raise ValueError('flow custom needs function = "module.name"')
    module, _, name = function.replace(":", ".").rpartition(".")
    try:
        found = getattr(_import(module, folder), name)
    except Exception as error:  # whatever the user's module raises
        raise ValueError(
            f'flow.function = "{function}" cannot be imported ({type(error).__name__}: {error}): expected "module.name" of a callable'
        ) from error
    if not callable(found):
        raise ValueError(f'flow.function = "{function}" is not callable: expected velocity(x, y, t) -> (u, v)')

    def velocity(X: Array, t: float) -> Array:
        xp = array_namespace(X)
        try:
            u, v = found(X[:, 0], X[:, 1], t)
            stacked = xp.stack([u + 0.0 * X[:, 0], v + 0.0 * X[:, 1]], axis=1)
            if stacked.shape != X.shape:
                raise ValueError(f"arrays of shape {tuple(stacked.shape)}")
        except Exception as error:
            raise ValueError(
                f"{function}(x, y, t) must return (u, v) of the shape of x; it ended in {type(error).__name__}: {error}"
            ) from error
        if not bool(xp.all(xp.isfinite(stacked))):
            bad = to_numpy(X).transpose(0, 2, 1)[~to_numpy(xp.isfinite(stacked)).all(axis=1)][0]
            raise ValueError(f"{function} is not finite at x = {bad[0]:g}, y = {bad[1]:g}, t = {t:g}")
        return stacked

    return velocity


def _import(module: str, folder: Path) -> ModuleType:
    """The module of that dotted name in `folder`, else the installed one."""
    file = folder.joinpath(*module.split(".")).with_suffix(".py")
    if not file.is_file():
        return importlib.import_module(module)
    spec = importlib.util.spec_from_file_location(f"{module}_of_{abs(hash(file.resolve()))}", file)
    assert spec is not None
    assert spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded
