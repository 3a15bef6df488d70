"""Standard pose of closed curves X (M, 2, N), and the way back. Nodes are equally spaced in arclength already.

Standardized, a curve has its centroid at the origin, length 1, and its long axis (smallest moment of inertia) along y. Of the two turns
that do so, by pi apart, it takes the one whose third moment int |r|^2 r dA points into the half plane x + y > 0, well away from whose edge
are the third moments of shapes with a mirror: they lie along x or y. The first node is set by the fundamental mode: with z = x + i y =
sum_k c_k e^{i k alpha}, the parameter is shifted, by the Fourier series and not by whole nodes, until c_1 is real and positive.

Where the moments of inertia are equal (circle, threefold symmetry) the long axis is taken to be x, and where the third moment lies on the
edge it counts as inside. A shape that is its own image under the turn left open has one standard pose all the same.

Moments are taken on three times the nodes, where they are exact for the trigonometric interpolant: they do not depend on where its nodes
lie. The Nyquist mode is taken out, because it cannot be shifted.
"""

from __future__ import annotations

from dataclasses import dataclass

from biem.backend import Array, array_namespace, rfft
from biem.curves.curve import center_of_nodes, cross, dot, length
from biem.curves.fourier import derivative, remove_nyquist, resample, shift

REFINEMENT = 3  # the third moment is of fifth degree in the modes |k| < N/2 of X


@dataclass(frozen=True)
class Pose:
    """Where curves stand: X_std(alpha) = R(angle) (X(alpha + offset) - center) / scale, R(angle) the rotation by angle.

    Fields have the vesicle first and the node last; points and vectors have x, y before the node: (M, ..., 2, N), scalars (M, ..., N). A
    field's Nyquist mode is not one that a shift can undo. Units are the caller's: vectors and scalars are not scaled. For viscosity mu,
    bending stiffness kappa_b and L = scale, the maps of X in terms of those of X_std with mu = kappa_b = 1 are: advection the same,
    relaxation at dt kappa_b/(mu L^3) (its increments are points over L), self-tension times kappa_b/L^2, flow tension times mu and near
    layers times L/mu (and -log(L)/(4 pi mu) times the total force, int f ds).
    """

    center: Array  # (M, 2)
    angle: Array  # (M,)
    scale: Array  # (M,)
    offset: Array  # (M,)

    def points(self, X: Array) -> Array:
        """Points beside the nodes, such as the curves themselves, in the standard frame."""
        local = X - self._like(X, self.center[:, 0], self.center[:, 1])
        return self.vectors(local) / _beside(self.scale, X)

    def points_back(self, X_std: Array) -> Array:
        """Inverse of `points`."""
        turned = self.vectors_back(X_std) * _beside(self.scale, X_std)
        return turned + self._like(X_std, self.center[:, 0], self.center[:, 1])

    def vectors(self, u: Array) -> Array:
        """Vectors at the nodes, such as velocities, in the standard frame: turned and shifted, not scaled."""
        return _rotate(self.scalars(u), self.angle)

    def vectors_back(self, u_std: Array) -> Array:
        """Inverse of `vectors`."""
        return self.scalars_back(_rotate(u_std, -self.angle))

    def scalars(self, f: Array) -> Array:
        """Scalars at the nodes, such as tensions, at the nodes of the standard frame: shifted, not scaled."""
        return shift(f, _beside(self.offset, f)[..., 0])

    def scalars_back(self, f_std: Array) -> Array:
        """Inverse of `scalars`."""
        return shift(f_std, _beside(-self.offset, f_std)[..., 0])

    def _like(self, X: Array, x: Array, y: Array) -> Array:
        """x, y (M,) as (M, ..., 2, 1) beside X (M, ..., 2, N)."""
        return array_namespace(X).concat([_beside(x, X), _beside(y, X)], axis=-2)


def standardize(X: Array) -> tuple[Array, Pose]:
    """X_std (M, 2, N) in the standard pose, and the pose that X had: pose.points_back(X_std) is X, but for its Nyquist mode.

    Translation, rotation, scaling and another first node of X change X_std by rounding alone (of shapes whose moments of inertia are
    equal, a rotation turns X_std); a reflection is not undone.
    """
    origin = center_of_nodes(X)
    local = remove_nyquist(X - origin)
    fine = resample(local, REFINEMENT * X.shape[-1])
    slope = derivative(fine)
    weight = cross(fine, slope)
    xp = array_namespace(X)
    center = xp.sum(fine * weight[:, None], axis=-1) / (1.5 * xp.sum(weight, axis=-1))[:, None]
    fine = fine - center[..., None]
    angle = _upright(fine, slope)
    offset = -(angle + _fundamental_phase(local))
    placed = _rotate(shift(local - center[..., None], offset[:, None]), angle)
    scale = length(placed)
    return placed / scale[:, None, None], Pose(origin[..., 0] + center, angle, scale, offset)


def _upright(X: Array, slope: Array) -> Array:
    """Angle (M,) to turn X by, its centroid at the origin. slope: dX/dalpha."""
    xp = array_namespace(X)
    weight = cross(X, slope)
    x2, y2 = xp.sum(X**2 * weight[:, None], axis=-1).T
    twice, difference = 2.0 * xp.sum(X[:, 0] * X[:, 1] * weight, axis=-1), x2 - y2
    negligible = float(xp.finfo(X.dtype).eps) ** 0.5
    axis = xp.where(xp.hypot(twice, difference) > negligible * (x2 + y2), 0.5 * xp.atan2(twice, difference), xp.zeros_like(difference))
    angle = 0.5 * xp.pi - axis
    r2 = dot(X, X)
    third = _rotate(xp.sum(r2[:, None] * X * weight[:, None], axis=-1)[..., None], angle)[..., 0]
    size = xp.sum(r2**1.5 * xp.abs(weight), axis=-1)
    return xp.where(third[:, 0] + third[:, 1] < -negligible * size, angle + xp.pi, angle)


def _fundamental_phase(X: Array) -> Array:
    """Phase (M,) of c_1 of x + i y."""
    xp = array_namespace(X)
    c = rfft(X)[..., 1]
    return xp.atan2(xp.imag(c[:, 0]) + xp.real(c[:, 1]), xp.real(c[:, 0]) - xp.imag(c[:, 1]))


def _rotate(u: Array, angle: Array) -> Array:
    """u (M, ..., 2, N) turned counterclockwise by angle (M,)."""
    xp = array_namespace(u)
    c, s = _beside(xp.cos(angle), u)[..., 0, :], _beside(xp.sin(angle), u)[..., 0, :]
    x, y = u[..., 0, :], u[..., 1, :]
    return xp.stack([c * x - s * y, s * x + c * y], axis=-2)


def _beside(a: Array, u: Array) -> Array:
    """a (M,) with as many axes as u (M, ...)."""
    return array_namespace(a).reshape(a, (-1,) + (1,) * (u.ndim - 1))


__all__ = ["Pose", "standardize"]
