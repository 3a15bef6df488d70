"""The choice of the pair sum, its errors, and the memory it is said to take."""

import tracemalloc

import numpy as np
import pytest

from biem.stokes import farfield, farfield_ewald
from biem.stokes.farfield import FAR_FIELDS, far_field_bytes, far_scheme, pair_sum
from biem.stokes.farfield_direct import DirectSum, direct_sum
from biem.stokes.farfield_ewald import EwaldSum

needs_finufft = pytest.mark.skipif(farfield.find_spec("finufft") is None, reason="finufft is not installed")


def points(M, N=32, side=None, seed=0):
    rng = np.random.default_rng(seed)
    X = rng.uniform(0, (0.17 * M) ** 0.5 if side is None else side, size=(M, 2, N))
    return X.transpose(0, 2, 1).reshape(-1, 2), X, rng.normal(size=X.shape)


@pytest.mark.parametrize("name", ["fmm", "", "Direct", "none"])
def test_unknown_names_are_refused_with_those_known(name):
    with pytest.raises(ValueError, match=f'far_field = "{name}": expected "auto", "direct", "ewald"$'):
        far_scheme(name, 10, 10, 1e-6)


@pytest.mark.parametrize("tolerance", [0.0, -1e-6, 1.0, np.nan])
def test_tolerances_that_mean_nothing_are_refused(tolerance):
    with pytest.raises(ValueError, match="between 0 and 1"):
        pair_sum(*points(2)[:2], 1.0, far_field="ewald", tolerance=tolerance)


@needs_finufft
@pytest.mark.parametrize("tolerance", [1e-4, 1e-6, 1e-9])
def test_auto_takes_ewald_for_many_points(tolerance):
    assert far_scheme("auto", 640, 640, tolerance) == "direct"
    assert far_scheme("auto", 6400, 6400, tolerance) == "ewald"
    assert far_scheme("auto", 5, 100_000, tolerance) == "direct"
    assert [far_scheme(name, 10, 10, tolerance) for name in FAR_FIELDS[1:]] == ["direct", "ewald"]


def test_without_finufft_auto_is_direct_and_ewald_says_what_to_install(monkeypatch):
    def missing(name, *args):
        raise ImportError(name)

    monkeypatch.setattr(farfield, "find_spec", lambda name: None)
    monkeypatch.setattr(farfield_ewald, "import_module", missing)
    assert far_scheme("auto", 10**6, 10**6, 1e-6) == "direct"
    with pytest.raises(ValueError, match=r"pip install 'vesnet\[fast\]'"):
        far_scheme("ewald", 10, 10, 1e-6)
    with pytest.raises(ValueError, match=r"pip install 'vesnet\[gpu\]'"):
        far_scheme("ewald", 10, 10, 1e-6, cuda=True)


@needs_finufft
def test_the_sum_that_was_asked_for():
    targets, X, f = points(100)
    exact = direct_sum(targets, X, f, 0.7)
    kinds = []
    for name in FAR_FIELDS:
        u = pair_sum(targets, X, 0.7, far_field=name, tolerance=1e-8)
        kinds.append(type(u))
        assert np.linalg.norm(u.velocity(f) - exact) < 1e-8 * np.linalg.norm(exact)
    assert kinds == [EwaldSum, DirectSum, EwaldSum]
    assert pair_sum(targets[:0], X, 1.0, far_field="ewald").velocity(f).shape == (0, 2)


@needs_finufft
def test_auto_is_direct_where_the_points_crowd_so_that_ewald_does_not_pay():
    targets, X, _ = points(100, side=0.01)
    X = np.concatenate([X, np.full((1, 2, 32), 1e6)])
    assert isinstance(pair_sum(targets, X, 1.0, far_field="auto"), DirectSum)
    assert isinstance(pair_sum(targets, X, 1.0, far_field="ewald"), EwaldSum)


@needs_finufft
@pytest.mark.parametrize("tolerance", [1e-4, 1e-9])
@pytest.mark.parametrize("extent", [(1.0, 1.0), (1e6, 1.0), (1e-3, 0.0)])
def test_memory_is_bounded_by_the_number_of_points_whatever_the_box(tolerance, extent):
    for M in (1000, 100_000):
        assert 200 < far_field_bytes(M * 32, M, 32, "ewald", tolerance, extent) / (M * 32) < 6000
    assert far_field_bytes(3200, 100, 32, "direct", tolerance, extent) < 1e6


def test_direct_memory_is_what_it_is_said_to_be():
    targets, X, f = points(1000)
    direct_sum(targets[:10], X, f, 1.0)
    tracemalloc.start()
    pair_sum(targets[:10], X, 1.0, far_field="direct").velocity(f)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert 0.3 < peak / far_field_bytes(10, 1000, 32, "direct", 1e-6, (1.0, 1.0)) < 1.2
