"""The seam between NumPy and PyTorch: solves, scatter, conversion, threads; and importing biem does not bring torch."""

import subprocess
import sys
import threading

import numpy as np
import pytest
import scipy.fft
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from biem import backend


def test_importing_biem_and_all_its_modules_does_not_import_torch():
    code = """
import importlib, pkgutil, sys, biem
for module in pkgutil.walk_packages(biem.__path__, "biem."):
    if module.name != "biem.stokes.farfield_triton":  # for CUDA tensors alone
        importlib.import_module(module.name)
assert "biem.stokes.near" in sys.modules
assert "torch" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("columns", [1, 3])
@pytest.mark.parametrize("convert", [torch.from_numpy, lambda a: a])
def test_solve_is_right_for_batches_of_large_matrices(convert, columns):
    rng = np.random.default_rng(0)
    A, x = rng.normal(size=(6, 200, 200)), rng.normal(size=(6, 200, columns))
    before = torch.get_num_threads()
    torch.set_num_threads(2)  # where torch's own batched LU goes wrong
    try:
        solved = backend.solve(convert(A), convert(A @ x))
    finally:
        torch.set_num_threads(before)
    assert type(solved) is type(convert(x))
    assert np.abs(backend.to_numpy(solved) - x).max() < 1e-8


def test_scatter_add_adds_repeated_rows_and_leaves_its_argument():
    u, index, values = np.ones((4, 2)), np.array([2, 0, 2]), np.array([[1.0, 2.0], [3.0, 4.0], [10.0, 20.0]])
    expected = np.array([[4.0, 5.0], [1.0, 1.0], [12.0, 23.0], [1.0, 1.0]])
    assert (backend.scatter_add(u, index, values) == expected).all()
    assert (u == 1).all()
    assert (backend.scatter_add(*map(torch.from_numpy, (u, index, values))).numpy() == expected).all()


def test_from_numpy_takes_the_dtype_of_floats_and_keeps_indices():
    like = torch.zeros(2, dtype=torch.float32)
    assert backend.from_numpy(np.ones(3), like).dtype == torch.float32
    assert backend.from_numpy(np.arange(3), like).dtype == torch.int64
    assert backend.from_numpy(np.ones(3), np.zeros(2, dtype=np.float32)).dtype == np.float32
    assert backend.from_numpy(np.arange(3), np.zeros(2)).dtype == np.int64


@pytest.mark.parametrize("size", [1000, backend.FFTW_PAYS_ABOVE])
def test_transforms_agree_with_the_definition_with_and_without_fftw(size):
    f = np.random.default_rng(0).normal(size=(size // 20, 20))
    modes = np.exp(-2j * np.pi * np.outer(np.arange(20), np.arange(11)) / 20)
    with backend.fft_backend(f.size):
        f_hat = backend.rfft(f)
        assert np.abs(f_hat - f @ modes).max() < 1e-12
        assert np.abs(backend.irfft(f_hat, 20) - f).max() < 1e-14
    assert np.abs(backend.rfft(torch.from_numpy(f)).numpy() - scipy.fft.rfft(f)).max() < 1e-12


def test_threads_follows_omp_num_threads_and_else_the_cores_of_this_process(monkeypatch):
    monkeypatch.setattr(backend.os, "sched_getaffinity", lambda pid: {0, 3, 5}, raising=False)
    for setting, expected in (("7", 7), ("1", 1), ("", 3), (None, 3)):
        monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
        if setting is not None:
            monkeypatch.setenv("OMP_NUM_THREADS", setting)
        assert backend.threads() == expected


@pytest.mark.parametrize("setting", ["1", "2"])
def test_parallel_map_keeps_the_order_and_the_counts(monkeypatch, setting):
    monkeypatch.setenv("OMP_NUM_THREADS", setting)
    others_done = threading.Event()

    def work(i):
        backend.count("work", i)
        if i == 49:
            others_done.set()
        elif i == 0 and setting == "2":
            assert others_done.wait(60)  # the first item ends last: they run at once
        return i * i

    with backend.counting() as counts:
        assert backend.parallel_map(work, range(50)) == [i * i for i in range(50)]
    assert counts["work"] == sum(range(50))


def test_parallel_map_hands_on_errors_and_keeps_blas_to_one_thread(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "2")

    def blas_threads(i):
        return {p["num_threads"] for p in threadpool_info() if p["user_api"] == "blas"}

    def fails(i):
        raise ArithmeticError(i)

    with threadpool_limits(2, user_api="blas"):
        assert backend.parallel_map(blas_threads, range(3)) == [{1}] * 3
        assert blas_threads(0) == {2}
    with pytest.raises(ArithmeticError):
        backend.parallel_map(fails, range(3))


def test_counting_blocks_nest_and_nothing_is_counted_outside():
    backend.count("a")
    with backend.counting() as outer:
        backend.count("a", 2)
        with backend.counting() as inner:
            backend.count("a", 5)
        backend.count("a")
    assert outer == {"a": 3}
    assert inner == {"a": 5}


def test_constant_is_computed_once_and_takes_the_dtype_of_its_model():
    calls = []

    def table(n):
        calls.append(n)
        return np.arange(n) / 3

    assert backend.constant(table, 4, like=torch.zeros(1, dtype=torch.float32)).dtype == torch.float32
    assert (backend.constant(table, 4, like=np.zeros(1)) == np.arange(4) / 3).all()
    assert calls == [4]
