"""Labels: equal to the exact maps one basis function at a time, the same bits however they are made, and what their settings mean."""

import numpy as np
import pytest
from helpers import dumbbell, mirror, nodes, stokeslet_sum
from threadpoolctl import threadpool_limits

from biem import ExactMaps
from biem.curves.curve import arclength_weights, length
from biem.curves.fourier import derivative, read_back, resample
from biem.curves.pose import standardize
from biem.curves.reparam import redistribute
from biem.curves.shapes import equilibrium, perturbed
from biem.membrane.maps import LAYERS
from biem.stokes.near import layer_values
from datagen import label as module
from datagen.config import MAPS, Label
from datagen.label import basis_functions, label_arrays, label_shapes

ROUNDING = 1e-7  # of float32, relative to the largest of an array


def shapes(N=128, count=3, **options):
    return standardize(np.stack([perturbed(N, 0.65, seed=seed, **options) for seed in range(count)]))[0]


def pinched(neck=0.05, N=128):
    """A dumbbell whose inner layers reach through its neck."""
    X = redistribute(dumbbell(512, neck)[None])[0]
    return standardize(resample(X, N))[0]


def basis(k, part, direction, N, n):
    """e (2, n): cos or sin of k alpha on N nodes as their interpolant has it on n."""
    f = (np.cos, np.sin)[part](k * nodes(N)) if (k, part) not in ((0, 1), (N // 2, 1)) else np.zeros(N)
    e = np.zeros((2, n))
    f_hat = np.fft.rfft(f) * (n / N)
    if n > N:
        f_hat[-1] /= 2
    e[direction] = np.fft.irfft(f_hat, n)
    return e


def layer_points(X, N):
    """(M, 5 N, 2) on the layers, by layer, then by node."""
    at, tangent = read_back(X, N), read_back(derivative(X), N)
    normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1) / np.hypot(tangent[:, 0], tangent[:, 1])[:, None]
    h = length(X)[:, None, None] / N
    return np.concatenate([at + offset * h * normal for offset in LAYERS], axis=-1).transpose(0, 2, 1)


def assert_equal(got, want, scale=None):
    scale = np.abs(want).max() if scale is None else scale
    assert np.abs(got - want).max() <= ROUNDING * scale


def check_mode(labels, X, N, k):
    """All labels of one mode against maps of X, applied to one function at a time."""
    M, _, n = X.shape
    maps, points = ExactMaps(points=n), layer_points(X, N)
    for part in (0, 1):
        for direction in (0, 1):
            e = np.broadcast_to(basis(k, part, direction, N, n), X.shape).copy()
            got = [labels[f"advection/{k}"][:, part, direction], labels[f"flow_tension/{k}"][:, part, direction]]
            near = labels[f"near/{k}"][:, :, part, direction]
            if not e.any():
                assert part == 1
                assert not any(a.any() for a in (*got, near))
                continue
            assert_equal(got[0], resample(maps.advect(X, e), N), 1.0)
            tension = resample(maps.flow_tension(X, e), N)
            assert_equal(got[1], tension, max(1.0, np.abs(tension).max()))
            assert_equal(near, layer_values(X, e, points, 1.0).reshape(M, 5, N, 2).transpose(0, 1, 3, 2))


@pytest.mark.parametrize(("n", "N"), [(128, 32), (100, 24), (64, 64)])
def test_labels_are_the_exact_maps_one_function_at_a_time(n, N):
    """Also where the N nodes are none of the n, and where all are."""
    X = shapes(n, 2)
    labels = label_shapes(X, Label(points=N, operator_points=n, modes=[N // 2, 0, 1, 5]))
    maps = ExactMaps(points=n)
    assert_equal(labels["X_std"], resample(X, N))
    assert_equal(labels["relax"], resample(maps.relax(X, 1e-5), N) - resample(X, N))
    assert_equal(labels["self_tension"], resample(maps.self_tension(X), N))
    for k in (0, 1, 5, N // 2):
        check_mode(labels, X, N, k)


def test_all_modes_of_one_shape():
    X = shapes(128, 1)
    labels = label_shapes(X, Label())
    assert len(labels) == 3 + 3 * 17
    for k in range(17):
        check_mode(labels, X, 32, k)


def test_near_layers_are_those_of_maps_with_as_many_nodes():
    X = shapes(64, 2)
    labels = label_shapes(X, Label(points=64, operator_points=64, maps=["near"], modes=[3]))
    for direction in (0, 1):
        e = np.broadcast_to(basis(3, 1, direction, 64, 64), X.shape).copy()
        assert_equal(labels["near/3"][:, :, 1, direction], ExactMaps(points=64).near_layers(X, e))


def test_near_layers_by_the_sum_over_many_points():
    """Off the curve, against a plain sum over 8192 points, also where the layer at -h crosses the neck."""
    X = np.concatenate([shapes(128, 1), pinched()])
    labels = label_shapes(X, Label(maps=["near"], modes=[4]))["near/4"]
    fine = resample(X, 8192)
    off = [0, 1, 3, 4]
    for m, points in enumerate(layer_points(X, 32).reshape(2, 5, 32, 2)):
        gap = np.sqrt(((points[off].reshape(-1, 1, 2) - fine[m].T) ** 2).sum(-1).min(axis=1)).reshape(4, 32)
        clear = (gap > 2e-3)[:, None]
        assert (gap[0].min() < 0.5 / 32) == (m == 1)
        for direction in (0, 1):
            g = basis(4, 0, direction, 32, 8192) * arclength_weights(fine[m : m + 1])
            want = stokeslet_sum(points[off].reshape(-1, 2), fine[m], g).reshape(4, 32, 2).transpose(0, 2, 1)
            assert_equal(labels[m, off, 0, direction] * clear, want * clear)


def test_points_that_the_trapezoid_rule_cannot_reach():
    """A neck as wide as h/2: layers come within a hundredth of h of the curve."""
    X = pinched(0.0645)
    points = layer_points(X, 32)
    off = [0, 1, 3, 4]
    gap = np.sqrt(((points[0].reshape(5, 32, 2)[off].reshape(-1, 1, 2) - resample(X, 8192)[0].T) ** 2).sum(-1).min())
    assert gap < 0.05 / 32
    labels = label_shapes(X, Label(maps=["near"], modes=[2, 9]))
    fine = resample(X, 256)
    for k in (2, 9):
        e = basis(k, 0, 1, 32, 256)[None]
        want = layer_values(fine, e, points, 1.0, 1e-11).reshape(1, 5, 32, 2).transpose(0, 1, 3, 2)
        assert_equal(labels[f"near/{k}"][:, off, 0, 1], want[:, off])


def test_identities():
    """M is a projection; rigid motions stay; a constant force and the self-tension of a shape at rest."""
    X = np.concatenate([shapes(128, 2, modes=4), standardize(equilibrium(128, 0.65)[None])[0]])
    labels = label_shapes(X, Label())
    assert np.abs(labels["advection/0"][:, 0] - np.eye(2)[:, :, None]).max() < 1e-6
    assert np.abs(labels["flow_tension/0"]).max() < 1e-6
    assert np.abs(labels["relax"][2]).max() < 1e-9 < 1e-4 < np.abs(labels["relax"][:2]).max()
    # a turn about the origin, in modes of X_std: u = (-y, x) = sum of the basis with these amplitudes
    c = np.fft.rfft(labels["X_std"].astype(float)) / 32
    turn = np.zeros((3, 2, 32))
    for k in range(17):
        scale = 1 if k in (0, 16) else 2
        for part, amplitude in ((0, scale * c[..., k].real), (1, -scale * c[..., k].imag)):
            moved = labels[f"advection/{k}"][:, part]  # (M, in, out, N)
            turn += amplitude[:, 0, None, None] * moved[:, 1] - amplitude[:, 1, None, None] * moved[:, 0]
    want = np.stack([-labels["X_std"][:, 1], labels["X_std"][:, 0]], axis=1)
    assert np.abs(turn - want).max() < 5e-5  # what N = 32 cuts off of X
    assert np.abs(turn[2] - want[2]).max() < 1e-6


def test_mirrored_shapes_have_mirrored_labels():
    """Reflection in the x axis, re-indexed counterclockwise: cos stays cos, sin changes sign, y-components change sign."""
    X = shapes(128, 2, modes=4)
    Y = mirror(X * np.array([[1.0], [-1.0]]))
    a, b = (label_shapes(Z, Label(modes=[3])) for Z in (X, Y))
    side, part = np.array([1.0, -1.0]), np.array([1.0, -1.0])
    assert np.abs(mirror(a["relax"]) * side[:, None] - b["relax"]).max() < 1e-6 * np.abs(b["relax"]).max()
    inout = part[:, None, None, None] * side[:, None, None] * side[:, None]
    for name in ("advection/3", "near/3"):
        assert np.abs(mirror(a[name]) * inout - b[name]).max() < 1e-6
    flow = mirror(a["flow_tension/3"]) * part[:, None, None] * side[:, None]
    assert np.abs(flow - b["flow_tension/3"]).max() < 1e-6 * np.abs(flow).max()


def increments(X, dt, substeps=None):
    kind = {"relaxation": "converged", "substeps": substeps} if substeps else {}
    return label_shapes(X, Label(operator_points=64, maps=["relax"], dt=dt, **kind))["relax"].astype(float)


def test_the_converged_increment_is_of_second_order_in_its_steps():
    X = shapes(64, modes=4)
    want = increments(X, 1e-6, 64)
    errors = [np.abs(increments(X, 1e-6, m) - want).max() / np.abs(want).max() for m in (4, 8, 16)]
    assert errors[2] < 3e-6
    assert np.abs(np.log2(errors[0] / np.array(errors[1:])) - [2, 4]).max() < 0.25
    assert np.abs(increments(X, 1e-6, 5) - want).max() < 1.2 * errors[0] * np.abs(want).max()  # odd: extrapolated against two


def test_the_implicit_increment_is_that_of_the_flow_for_small_steps():
    """Their relative difference falls as dt; the flow over dt is the flow over dt/2, twice."""
    X = shapes(64, modes=4)
    errors = []
    for dt in (1e-7, 1e-8, 1e-9):
        a, b = increments(X, dt), increments(X, dt, 4)
        errors.append(np.abs(a - b).max() / np.abs(b).max())
    assert np.abs(np.diff(np.log10(errors)) + 1).max() < 0.1
    assert errors[-1] < 1e-5
    whole = increments(X, 1e-6)
    assert 1e-3 < np.abs(increments(X, 1e-6, 16) - whole).max() / np.abs(whole).max() < 1e-1


def same_bits(a, b):
    return all(np.array_equal(a[name].view(np.int32), b[name].view(np.int32)) for name in b)


def test_the_same_bits_alone_and_among_others_and_whatever_the_chunk(monkeypatch):
    X = np.concatenate([shapes(128, 9), pinched(0.0645), pinched(0.02)])
    label = Label(modes=[0, 7, 16])
    whole = label_shapes(X, label)
    for part in (slice(3, 4), slice(2, 11), slice(10, 11)):
        assert same_bits(label_shapes(X[part], label), {name: values[part] for name, values in whole.items()})
    for chunk in (1, 3, 64):
        monkeypatch.setattr(module, "CHUNK", chunk)
        assert same_bits(label_shapes(X, label), whole)


def test_the_same_bits_with_any_number_of_threads(monkeypatch):
    X = shapes(128, 4)
    labels = [Label(modes=[3]), Label(maps=["relax"], relaxation="converged", substeps=2)]
    want = [label_shapes(X, label) for label in labels]
    for threads in (1, 2, 5):
        monkeypatch.setenv("OMP_NUM_THREADS", str(threads))
        with threadpool_limits(limits=threads):
            assert all(same_bits(label_shapes(X, label), one) for label, one in zip(labels, want, strict=True))


@pytest.mark.parametrize("name", MAPS)
def test_only_what_is_asked_for_and_the_same_bits_then(name):
    X = shapes(64, 2)
    everything = label_shapes(X, Label(points=16, operator_points=64, modes=[2, 8]))
    label = Label(points=16, operator_points=64, maps=[name], modes=[8])
    alone = label_shapes(X, label)
    assert {key: (*values.shape[1:],) for key, values in alone.items()} == label_arrays(label)
    assert set(alone) == {"X_std", name if name in ("relax", "self_tension") else f"{name}/8"}
    assert all(values.dtype == np.float32 and len(values) == 2 for values in alone.values())
    assert same_bits(everything, alone)


def test_no_shapes_at_all():
    labels = label_shapes(np.zeros((0, 2, 128)), Label(modes=[1]))
    assert labels["near/1"].shape == (0, 5, 2, 2, 2, 32)


def test_basis_functions_are_a_basis():
    B = basis_functions(32, 32, tuple(range(17)))
    gram = B @ B.T
    assert np.abs(gram - np.diag(np.diag(gram))).max() < 1e-13
    assert np.count_nonzero(np.diag(gram)) == 32


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"points": 33}, "label.points is 33: expected an even number, at most label.operator_points = 128"),
        ({"points": 64, "operator_points": 48}, "label.points is 64: .* at most label.operator_points = 48"),
        ({"modes": [0, 17]}, r"label.modes has 17: expected different numbers from 0 to 16"),
        ({"modes": [-1]}, r"label.modes has -1"),
        ({"modes": [3, 4, 3]}, r"label.modes has a mode twice: expected different"),
    ],
)
def test_settings_that_cannot_be(settings, message):
    label = Label(**settings)
    with pytest.raises(ValueError, match=message):
        label_shapes(shapes(label.operator_points, 1), label)


def with_node(value):
    X = shapes(128, 3)
    X[2, 0, 5] = value
    return X


@pytest.mark.parametrize(
    ("X", "message"),
    [
        (shapes(64), r"\(3, 2, 64\): expected \(n, 2, 128\), nodes as label.operator_points says"),
        (shapes(128)[0], r"\(2, 128\): expected \(n, 2, 128\)"),
        (with_node(np.nan), r"shape 2 \(and 0 more\) is not finite"),
        (shapes(128) * (1 + 2e-3), r"shape 0 \(and 2 more\) is not standardized, its length is not 1 within 0.001"),
    ],
)
def test_shapes_that_cannot_be(X, message):
    with pytest.raises(ValueError, match=message) as error:
        label_shapes(X, Label())
    assert "\n" not in str(error.value)
