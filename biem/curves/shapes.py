"""Initial shapes: (2, N) nodes equally spaced in arclength, counterclockwise, centroid at the origin, long axis along x.

Shapes are made from their tangent angle theta(s), X_s = (cos theta, sin theta), so that they are arclength-parametrized exactly.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import optimize, special

from biem.curves.crossing import self_crossings
from biem.curves.curve import area, centroid, inclination, length
from biem.curves.fourier import remove_nyquist, resample
from biem.curves.reparam import redistribute

FINE = 1024  # nodes on which shapes are made before they are resampled
EQUILIBRIUM_MODES = 40


def ellipse(points: int, reduced_area: float, perimeter: float = 1.0) -> np.ndarray:
    """Ellipse of the given reduced area 4 pi A / L^2 in (0, 1]."""
    _check(points, reduced_area)

    def excess(aspect: float) -> float:
        return 4 * np.pi**2 * aspect / (4 * special.ellipe(1 - aspect**2)) ** 2 - reduced_area

    aspect = 1.0 if reduced_area == 1 else optimize.brentq(excess, 1e-6, 1.0, xtol=1e-15)
    t = 2 * np.pi * np.arange(FINE) / FINE
    X = np.stack([np.cos(t), aspect * np.sin(t)])
    return _finish(redistribute(X[None])[0][0], points, perimeter)


def equilibrium(points: int, reduced_area: float, perimeter: float = 1.0) -> np.ndarray:
    """Shape of least bending energy at the given area and length (biconcave at 0.65), by its stationarity conditions.

    Raises ValueError where that shape touches itself (small reduced areas).
    """
    _check(points, reduced_area)
    X = curve_of_angle(_equilibrium_angle(float(reduced_area)))
    if self_crossings(resample(X, 256)[None]):
        raise ValueError(f"the equilibrium shape of reduced area {reduced_area} touches itself: choose a larger one")
    return _finish(X, points, perimeter)


def perturbed(
    points: int,
    reduced_area: float,
    perimeter: float = 1.0,
    seed: int | np.random.Generator = 0,
    modes: int = 6,
    power: float = 1.5,
) -> np.ndarray:
    """Random smooth shape without self-crossing: tangent angle with modes k = 2..modes of normal amplitudes / k^power.

    The amplitudes are scaled together to the reduced area. Raises ValueError where 200 draws all cross themselves.
    """
    _check(points, reduced_area)
    rng = np.random.default_rng(seed)
    if reduced_area == 1:
        return ellipse(points, 1.0, perimeter)
    for _ in range(200):
        k = np.arange(2, modes + 1)
        X = _perturbed_curve(k, rng.normal(size=(2, len(k))) / k**power, reduced_area)
        if X is not None and not self_crossings(resample(X, 256)[None]):
            return _finish(X, points, perimeter)
    raise ValueError(f"no perturbed shape of reduced area {reduced_area} without self-crossing was found: choose a larger one")


def place(X: np.ndarray, center: np.ndarray, angle: float) -> np.ndarray:
    """X (2, N) turned by `angle` about the origin and moved to `center` (2,)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]]) @ X + np.asarray(center, dtype=np.float64)[:, None]


def _check(points: int, reduced_area: float) -> None:
    if points < 16 or points % 2:
        raise ValueError(f"points = {points}: expected an even number, at least 16")
    if not 0 < reduced_area <= 1:
        raise ValueError(f"reduced_area = {reduced_area}: expected a number in (0, 1]; 1 is a circle")


def _finish(X: np.ndarray, points: int, perimeter: float) -> np.ndarray:
    """Centroid to the origin, long axis along x, length to `perimeter`, resampled without a Nyquist mode."""
    batch = X[None] - centroid(X[None])[..., None]
    turn = -float(inclination(batch)[0])
    X = place(batch[0], np.zeros(2), turn)
    X = remove_nyquist(resample(X, points))
    return X * (perimeter / float(length(X[None])[0]))


def _arclength() -> np.ndarray:
    return np.arange(FINE) / FINE


def curve_of_angle(theta_periodic: np.ndarray) -> np.ndarray:
    """Curve (2, n) of unit length with tangent angle 2 pi s + theta_periodic(s) at n nodes; the closure gap is left out."""
    n = len(theta_periodic)
    z_s = np.fft.fft(np.exp(1j * (2 * np.pi * np.arange(n) / n + theta_periodic)))
    k = np.fft.fftfreq(n, 1 / n)
    k[0] = 1
    z_hat = z_s / (2j * np.pi * k)
    z_hat[[0, n // 2]] = 0
    z = np.fft.ifft(z_hat)
    return np.stack([z.real, z.imag])


@lru_cache(maxsize=32)
def _equilibrium_angle(reduced_area: float) -> np.ndarray:
    """theta(s) - 2 pi s of the twofold-symmetric minimiser of int theta_s^2 ds at fixed area, followed down from the circle."""
    m = np.arange(1, EQUILIBRIUM_MODES + 1)
    s = _arclength()
    sines = np.sin(4 * np.pi * m[:, None] * s)
    stiffness = (m / m[-1]) ** 2.0

    def residual(unknown: np.ndarray, target: float) -> np.ndarray:
        b, multiplier = unknown[:-1], unknown[-1]
        X = curve_of_angle(b @ sines)
        angle = 2 * np.pi * s + b @ sines
        # dA/db_m = int delta z x dz with delta z_s = i e^{i theta} sin_m, by parts: -int delta theta (X . X_s) ds
        gradient = -(sines * (X[0] * np.cos(angle) + X[1] * np.sin(angle))).mean(axis=1)
        return np.append(stiffness * b - multiplier * gradient, 4 * np.pi * area(X[None])[0] - target)

    if reduced_area == 1:
        return np.zeros(FINE)
    path = np.append(np.arange(0.98, reduced_area, -0.03), reduced_area)
    unknown = np.zeros(EQUILIBRIUM_MODES + 1)
    unknown[0] = np.sqrt(1 - path[0])
    unknown[-1] = -0.01
    for target in path:
        found = optimize.root(residual, unknown, args=(target,), method="hybr", options={"xtol": 1e-13})
        if np.abs(found.fun).max() > 1e-9:
            raise ValueError(f"no equilibrium shape of reduced area {reduced_area} was found (stopped at {target:.3f})")
        unknown = found.x
    return unknown[:-1] @ sines


def _perturbed_curve(modes: np.ndarray, amplitude: np.ndarray, reduced_area: float) -> np.ndarray | None:
    """Curve of the given reduced area on the branch that leaves the circle, or None if the branch ends before."""
    s = _arclength()
    phase = 2 * np.pi * modes[:, None] * s
    shape = amplitude[0] @ np.cos(phase) + amplitude[1] @ np.sin(phase)
    first = np.stack([np.cos(2 * np.pi * s), np.sin(2 * np.pi * s)])
    closing = np.zeros(2)

    def closed_angle(scale: float) -> np.ndarray:
        nonlocal closing
        for _ in range(50):  # Newton's method on int X_s ds = 0
            X_s = np.exp(1j * (2 * np.pi * s + scale * shape + closing @ first))
            gap = X_s.mean()
            if abs(gap) < 1e-14:
                return scale * shape + closing @ first
            slope = (1j * X_s * first).mean(axis=1)
            closing = closing - np.linalg.solve([slope.real, slope.imag], [gap.real, gap.imag])
        raise np.linalg.LinAlgError

    def excess(scale: float) -> float:
        return float(4 * np.pi * area(curve_of_angle(closed_angle(scale))[None])[0]) - reduced_area

    try:
        high = 0.0
        while excess(high) > 0:
            high += 0.1
            if high > 10:
                return None
        scale = optimize.brentq(excess, max(0.0, high - 0.1), high, xtol=1e-14) if high > 0 else 0.0
        return curve_of_angle(closed_angle(scale))
    except np.linalg.LinAlgError:
        return None
