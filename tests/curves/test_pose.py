"""Standard pose: what it is, what leaves it unchanged, the way back for points, vectors and scalars, and shapes with symmetries."""

import numpy as np
import pytest
import torch
from helpers import blob, circle, ellipse, nodes, rotate

from biem.curves.curve import arclength_weights, curvature, length, normal
from biem.curves.fourier import remove_nyquist, resample, shift
from biem.curves.pose import standardize
from biem.curves.shapes import equilibrium, perturbed
from biem.membrane.maps import ExactMaps

ANGLES = [0.0, 0.4, np.pi / 2, 2.5, np.pi, -2.0]


def shapes(N=64, **options):
    return np.stack([perturbed(N, 0.65, seed=seed, **options) for seed in range(4)])


def polynomial(r, size, bend=0.0, mirror="x", N=64):
    """A smooth curve with the fold symmetry of r (its mode) and, bent, one mirror: across x ("y") or across y ("x")."""
    t = nodes(N)
    X = (1 + size * np.cos(r * t)) * np.stack([np.cos(t), np.sin(t)])
    X = X + bend * np.stack([0 * t, X[0] ** 2])
    return remove_nyquist((X if mirror == "x" else X[::-1, ::-1])[None])


def moment(X, f, degree):
    """int f(x, y) dA (M,) of a homogeneous f, by 1/(degree + 2) of the flux of r f through 4096 edges of the interpolant."""
    fine = resample(X, 4096)
    r = 0.5 * (fine + np.roll(fine, -1, axis=-1))
    d = np.roll(fine, -1, axis=-1) - fine
    return (f(*r.swapaxes(0, 1)) * (r[:, 0] * d[:, 1] - r[:, 1] * d[:, 0])).sum(-1) / (degree + 2)


def first_mode(X):
    return np.fft.fft(X[:, 0] + 1j * X[:, 1])[:, 1] / X.shape[-1]


def test_the_standard_pose():
    X, pose = standardize(3 * rotate(shapes(), 1.1) + np.array([[5.0], [-2.0]]))
    assert np.abs(length(X) - 1).max() < 1e-14
    for f in (lambda x, y: x, lambda x, y: y):
        assert np.abs(moment(X, f, 1)).max() < 1e-7
    xx, yy, xy = (moment(X, f, 2) for f in (lambda x, y: x * x, lambda x, y: y * y, lambda x, y: x * y))
    assert np.abs(xy / yy).max() < 1e-5
    assert (yy > 1.5 * xx).all()
    third = moment(X, lambda x, y: (x * x + y * y) * (x + y), 3)
    size = moment(X, lambda x, y: (x * x + y * y) ** 1.5, 3)
    assert (third > 0).all()
    assert (third / size).max() > 0.01
    c = first_mode(X)
    assert np.abs(c.imag).max() < 1e-15
    assert c.real.min() > 0.05
    assert pose.scale == pytest.approx(3.0, rel=1e-6)
    assert np.abs(pose.center - np.array([5.0, -2.0])).max() < 1e-6


@pytest.mark.parametrize("N", [32, 64])
@pytest.mark.parametrize("angle", ANGLES)
def test_moved_turned_scaled_and_counted_from_another_node(angle, N):
    """Also at 32 nodes, which do not resolve the moments' integrands."""
    X = shapes(N, modes=8)
    want = standardize(X)[0]
    assert np.abs(standardize(rotate(X, angle))[0] - want).max() < 1e-13
    assert np.abs(standardize(0.02 * X)[0] - want).max() < 1e-13
    assert np.abs(standardize(np.roll(X, 7, axis=-1))[0] - want).max() < 1e-13
    assert np.abs(standardize(shift(X, np.full((4, 1), 0.3 + angle)))[0] - want).max() < 1e-13
    everything = 40 * rotate(shift(X, np.full((4, 1), angle - 1.0)), angle + 0.3) + np.array([[-7.0], [3.0]])
    assert np.abs(standardize(everything)[0] - want).max() < 1e-12


def test_a_thousand_lengths_away():
    """Only the digits of the nodes themselves are lost."""
    X = shapes()
    far = X + np.array([[800.0], [-600.0]])
    X_std, pose = standardize(far)
    assert np.abs(X_std - standardize(X)[0]).max() < 1e-11
    assert np.abs(pose.points_back(X_std) - far).max() < 1e-12


def test_the_way_back():
    X = 2.5 * shapes() + 0.3
    X_std, pose = standardize(X)
    assert np.abs(pose.points_back(X_std) - X).max() < 1e-14
    assert np.abs(pose.points(X) - X_std).max() < 1e-14
    rng = np.random.default_rng(0)
    u = remove_nyquist(rng.normal(size=(4, 5, 2, 64)))
    for there, back in ((pose.points, pose.points_back), (pose.vectors, pose.vectors_back), (pose.scalars, pose.scalars_back)):
        assert np.abs(back(there(u)) - u).max() < 1e-13
        assert np.abs(there(u) - u).max() > 0.1
        assert np.abs(there(u)[:, 3] - there(u[:, 3])).max() < 1e-15  # axes in between are fields side by side


def test_fields_go_with_the_curve():
    """Curvature is a scalar over the scale, the normal a vector; a point beside a node stays beside it; a velocity moves the points."""
    X = 2.5 * rotate(shapes(128, modes=4), 0.8) + 0.3
    X_std, pose = standardize(X)
    assert np.abs(pose.scalars(curvature(X)) * pose.scale[:, None] - curvature(X_std)).max() < 1e-5 * curvature(X_std).max()
    assert np.abs(pose.vectors(normal(X)) - normal(X_std)).max() < 1e-6
    assert np.abs(pose.points(X + 0.1 * normal(X)) - X_std - 0.04 * normal(X_std)).max() < 1e-7
    u = np.cos(3 * X)
    assert np.abs(pose.points(X + u) - X_std - pose.vectors(u) / pose.scale[:, None, None]).max() < 1e-14


def test_maps_in_the_standard_frame_scale_as_documented():
    kappa_b, mu, N = 1.7, 0.6, 64
    maps, unit = ExactMaps(kappa_b, mu), ExactMaps()
    X = 2.5 * rotate(shapes(N, modes=4), 0.8) + 0.3
    X_std, pose = standardize(X)
    L = pose.scale[:, None]
    u = remove_nyquist(np.cos(3 * X))
    u_std = pose.vectors(u)
    close = lambda a, b: np.abs(remove_nyquist(a) - b).max() < 2e-4 * np.abs(b).max()
    assert close(maps.advect(X, u), pose.vectors_back(unit.advect(X_std, u_std)))
    assert close(maps.self_tension(X), kappa_b / L**2 * pose.scalars_back(unit.self_tension(X_std)))
    assert close(maps.flow_tension(X, u), mu * pose.scalars_back(unit.flow_tension(X_std, u_std)))
    scale, dt = float(L[0, 0]), 1e-5 * mu * float(L[0, 0]) ** 3 / kappa_b
    assert np.ptp(L) < 1e-5 * scale
    assert close(maps.relax(X, dt) - X, pose.points_back(unit.relax(X_std, 1e-5)) - X)
    layers = maps.near_layers(X, u)
    total = (u * arclength_weights(X)[:, None]).sum(axis=-1)[:, None, :, None]
    want = pose.vectors_back(unit.near_layers(X_std, u_std)) * scale / mu - np.log(scale) / (4 * np.pi * mu) * total
    assert close(layers, want)


def test_circle():
    for X in (circle(64, 0.7, (3.0, 1.0)), rotate(circle(64, 2.0), 1.234), np.roll(circle(64), 5, axis=-1)):
        assert np.abs(standardize(X[None])[0][0] - circle(64, 0.5 / np.pi)).max() < 1e-14


@pytest.mark.parametrize("angle", ANGLES)
def test_shapes_that_a_turn_by_pi_leaves_unchanged(angle):
    """Which of the two turns is taken makes no difference."""
    for X in (ellipse(64, 1.0, 0.4), equilibrium(64, 0.65)):
        want = standardize(X[None])[0]
        assert np.abs(want + np.roll(want, 32, axis=-1)).max() < 1e-14
        assert np.ptp(want[0, 1]) > 2 * np.ptp(want[0, 0])
        moved = 3 * rotate(shift(X, np.array([0.6])), angle) + 1.0
        assert np.abs(standardize(moved[None])[0] - want).max() < 1e-13


@pytest.mark.parametrize("mirror", ["x", "y"])
@pytest.mark.parametrize("size", [0.3, -0.3])
def test_shapes_with_one_mirror_do_not_flip_with_what_breaks_it(size, mirror):
    """Bananas, mirrored across the long axis or along it: their third moment is far from the edge that decides on the turn by pi."""
    X = polynomial(2, size, 0.4, mirror)
    want = standardize(X)[0]
    rng = np.random.default_rng(1)
    for _ in range(20):
        noise = remove_nyquist(resample(1e-9 * rng.normal(size=(1, 2, 16)), 64))
        assert np.abs(standardize(rotate(X + noise, rng.uniform(-9, 9)))[0] - want).max() < 1e-7


@pytest.mark.parametrize("fold", [3, 4, 5])
def test_equal_moments_of_inertia_leave_the_axes_of_the_world(fold):
    X = polynomial(fold, 0.2)
    want, pose = standardize(X)
    assert np.isfinite(want).all()
    assert pose.angle[0] == np.pi / 2
    for moved in (X + np.array([[3.0], [-40.0]]), 17 * X, shift(X, np.array([[1.1]]))):
        assert np.abs(standardize(moved)[0] - want).max() < 1e-12
    other = standardize(rotate(X, 0.1))[0]
    assert np.abs(standardize(rotate(X, 0.1 + 2 * np.pi / fold))[0] - other).max() < 1e-12
    phase = np.exp(0.1j)  # turned with the shape, then counted from where c_1 is positive
    z, w = (a[0, 0] + 1j * a[0, 1] for a in (want, other))
    k = np.fft.fftfreq(64, 1 / 64)
    assert np.abs(np.fft.fft(w) - np.fft.fft(z) * phase ** (1 - k)).max() < 1e-8


def test_the_nyquist_mode_is_taken_out():
    X = shapes()
    zigzag = 1e-3 * (-1.0) ** np.arange(64)
    assert np.abs(standardize(X + zigzag)[0] - standardize(X)[0]).max() < 1e-15


def test_vesicles_of_a_batch_do_not_see_one_another():
    X = np.concatenate([shapes(), circle(64, 5.0)[None], blob(nodes(64))[None]])
    together, pose = standardize(X)
    for m in range(len(X)):
        alone, own = standardize(X[m : m + 1])
        assert np.array_equal(alone[0], together[m])
        assert own.angle[0] == pose.angle[m]


def test_torch_equals_numpy_and_float32_stays():
    X = 3 * shapes() + 0.2
    X_std, pose = standardize(X)
    T_std, T_pose = standardize(torch.from_numpy(X))
    assert np.abs(T_std.numpy() - X_std).max() < 1e-13
    u = np.cos(5 * X)
    for name in ("points", "points_back", "vectors", "vectors_back", "scalars", "scalars_back"):
        got = getattr(T_pose, name)(torch.from_numpy(u))
        assert np.abs(got.numpy() - getattr(pose, name)(u)).max() < 1e-12, name
    single, single_pose = standardize(torch.from_numpy(X).float())
    assert single.dtype == single_pose.points_back(single).dtype == torch.float32
    assert np.abs(single.numpy() - X_std).max() < 1e-5
