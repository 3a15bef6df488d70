"""The CUDA kernel in Triton's interpreter, against the compiled loop. Needs triton and no GPU."""

import os
import subprocess
import sys

import pytest

pytest.importorskip("triton")

# TRITON_INTERPRET is read when triton is imported, so the kernel runs in a process of its own
PROGRAM = """
import numpy as np, torch
from biem.stokes.farfield_direct import direct_sum
from biem.stokes.farfield_triton import sum_pairs
from biem.stokes.kernels import stokeslet_prefactor

rng = np.random.default_rng(0)
for P, M, N in ((3, 1, 1), (70, 60, 20)):
    X, g = rng.normal(size=(2, M, 2, N))
    x = rng.normal(size=(P, 2))
    x[::7] = X[0, :, 0]
    skip = np.arange(P) % (M + 1) - 1
    u = direct_sum(x, X, g, 0.7, skip)
    for dtype, bound in ((torch.float64, 1e-13), (torch.float32, 2e-6)):
        tensors = (torch.from_numpy(a).to(dtype) for a in (x, X, g))
        v = sum_pairs(*tensors, torch.from_numpy(skip), stokeslet_prefactor(0.7))
        assert v.dtype == dtype
        error = np.abs(v.double().numpy() - u).max() / np.abs(u).max()
        assert error < bound, (P, M, N, dtype, error)
x[3] = np.nan
v = sum_pairs(*map(torch.from_numpy, (x, X, g, skip)), 1.0)
assert v.isnan().any(dim=1).nonzero().tolist() == [[3]]
assert sum_pairs(*map(torch.from_numpy, (x[:0], X, g, skip[:0])), 1.0).shape == (0, 2)
"""


def test_fused_kernel_equals_the_compiled_loop():
    environment = os.environ | {"TRITON_INTERPRET": "1"}
    result = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
