"""Shapes as Fourier coefficients in single precision: round trip, precision of high derivatives, files that are not shapes files."""

import h5py
import numpy as np
import pytest

from biem.curves.curve import center_of_nodes, d_ds, length, speed
from biem.curves.fourier import derivative, resample
from biem.curves.pose import standardize
from biem.curves.shapes import perturbed
from datagen.shapes import COLUMNS, decode, encode, read_shapes


def shapes(N=128, count=6, **options):
    return standardize(np.stack([perturbed(N, 0.65, seed=seed, **options) for seed in range(count)]))[0]


def fourth_derivative(X):
    """X_ssss (n, 2, N)."""
    v = speed(X)
    f = derivative(X - center_of_nodes(X)) / v[:, None]
    for _ in range(3):
        f = d_ds(f, v)
    return f


def relative(a, b):
    return np.abs(a - b).max() / np.abs(b).max()


def test_round_trip_keeps_fourth_derivatives_that_float32_nodes_lose():
    X = shapes(modes=4)
    resolved = resample(resample(X, 64), 128)  # no mode above 31
    c = encode(X, 32)
    assert c.dtype == np.complex64
    assert c.shape == (6, 64)
    Y = decode(c, 128)
    assert relative(Y, resolved) < 1e-7
    want = fourth_derivative(resolved)
    single = lambda nodes: resample(resample(resolved, nodes).astype(np.float32).astype(np.float64), 128)
    assert relative(fourth_derivative(Y), want) < 5e-7
    assert relative(fourth_derivative(single(64)), want) > 5e-5
    assert relative(fourth_derivative(single(128)), want) > 5e-4


def test_coefficients_are_those_of_the_series():
    """A curve with two modes: x + i y = 0.3 e^{i alpha} + (0.02 - 0.01i) e^{-3 i alpha} + 0.004 e^{5 i alpha}."""
    alpha = 2 * np.pi * np.arange(48) / 48
    z = 0.3 * np.exp(1j * alpha) + (0.02 - 0.01j) * np.exp(-3j * alpha) + 0.004 * np.exp(5j * alpha)
    c = encode(np.stack([z.real, z.imag])[None], 8)[0]
    want = np.zeros(16, dtype=complex)
    want[[1, -3, 5]] = 0.3, 0.02 - 0.01j, 0.004
    assert np.abs(c - want).max() < 2e-8
    assert abs(c[5] - 0.004) < 3e-10  # its own seven digits
    beta = 2 * np.pi * np.arange(20) / 20
    w = c[1] * np.exp(1j * beta) + c[-3] * np.exp(-3j * beta) + c[5] * np.exp(5j * beta)
    X = decode(c[None], 20)[0]
    assert np.abs(X[0] + 1j * X[1] - w).max() < 1e-8


def test_any_number_of_points_gives_the_same_curve():
    c = encode(shapes(), 32)
    assert np.abs(resample(decode(c, 64), 256) - decode(c, 256)).max() < 1e-15
    assert np.abs(length(decode(c, 128)) - 1).max() < 1e-7
    assert np.array_equal(encode(decode(c, 64), 32)[:, 32], np.zeros(6))  # the mode -32, which 64 nodes could hold
    assert np.abs(encode(decode(c, 96), 32) - c).max() < 1e-8


def test_a_mode_that_is_cut_off_goes_nowhere_else():
    X = np.zeros((1, 2, 64))
    X[0, 0] = np.cos(40 * np.pi * np.arange(64) / 32)  # mode 40 on 64 nodes is mode -24
    assert np.abs(encode(X, 24)).max() < 1e-14
    assert np.abs(encode(X, 25)).max() == pytest.approx(0.5, rel=1e-6)


def test_too_few_points_or_modes():
    with pytest.raises(ValueError, match=r"32 modes on 62 points: .* at least 64 points"):
        encode(shapes(62, 1), 32)
    with pytest.raises(ValueError, match="32 modes on 32 points"):
        decode(encode(shapes(128, 1), 32), 32)
    with pytest.raises(ValueError, match="1 modes"):
        encode(shapes(32, 1), 1)
    with pytest.raises(ValueError, match=r"\(2, 32\): expected \(n, 2, points\)"):
        encode(shapes(32, 1)[0], 8)
    with pytest.raises(ValueError, match=r"float64 of shape \(3, 64\), expected complex"):
        decode(np.ones((3, 64)), 128)


def contents(n=5):
    rng = np.random.default_rng(0)
    columns = {name: rng.integers(0, 3, n) for name in COLUMNS}
    return {"coefficients": encode(shapes(64, n), 16), **columns}


def write(path, arrays):
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            file[name] = values
    return path


def test_reading_gives_what_was_written(tmp_path):
    arrays = contents()
    got = read_shapes(write(tmp_path / "shapes.h5", {**arrays, "more": np.zeros(2)}))
    assert set(got) == set(arrays)
    assert all(np.array_equal(got[name], arrays[name]) and got[name].dtype == arrays[name].dtype for name in arrays)


def broken(name, values):
    return {**contents(), name: values}


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({k: v for k, v in contents().items() if k not in ("split", "time")}, "has no dataset time, split: expected a shapes file"),
        (broken("coefficients", np.zeros((5, 31), np.complex64)), r"complex64 of shape \(5, 31\), expected complex numbers \(n, 2 modes\)"),
        (broken("coefficients", np.full((5, 32), np.nan, np.complex64)), r"shape 0 \(and of 4 more\) are not finite"),
        (broken("coefficients", np.ones((5, 32), np.complex64)), "not zero for mode -16"),
        (broken("run", np.arange(4)), r"run has the shape \(4,\), expected \(5,\)"),
        (broken("split", np.array([0, 1, 2, 3, 0])), r"split has values outside 0\.\.2"),
    ],
)
def test_files_that_are_no_shapes_files(tmp_path, arrays, message):
    path = write(tmp_path / "shapes.h5", arrays)
    with pytest.raises(ValueError, match=message) as error:
        read_shapes(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_no_file_and_no_hdf5(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"does not exist: make it by `python -m datagen select`"):
        read_shapes(tmp_path / "shapes.h5")
    (tmp_path / "shapes.h5").write_text("x" * 4096)
    with pytest.raises(ValueError, match="cannot be read as HDF5"):
        read_shapes(tmp_path / "shapes.h5")
    with pytest.raises(ValueError, match="cannot be read as HDF5"):
        read_shapes(tmp_path)
