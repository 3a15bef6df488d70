"""Parts of outputs under the symmetries: whole, orthogonal, and with the signs that images have."""

import pytest
import torch

from surrogate.symmetric import CHARACTERS, Parts
from surrogate.targets import SYMMETRIES, TARGETS

SHAPES = {
    "relax": (2, 32),
    "self_tension": (1, 32),
    "advection": (2, 32, 1, 2, 32),
    "flow_tension": (2, 32, 1, 1, 32),
    "near": (2, 16, 5, 2, 16),
}


@pytest.mark.parametrize("name", SHAPES)
def test_parts_are_whole_keep_norms_and_change_sign_with_images(name):
    Y = torch.randn(3, *SHAPES[name], generator=torch.Generator().manual_seed(0), dtype=torch.float32)
    parts = Parts(name, SHAPES[name])
    flat = Y.flatten(1)
    y = parts.take(flat)
    assert y.shape[2] <= 0.3 * flat.shape[1]  # a quarter, and the points that a mirror leaves where they are
    assert torch.allclose(parts.put(y), flat, atol=1e-5)
    assert torch.allclose(y.square().sum((1, 2)), flat.square().sum(1), rtol=1e-5)
    for g, symmetry in enumerate(SYMMETRIES):
        image = (symmetry.kernel(Y) if TARGETS[name].operator else symmetry.parts(Y)).flatten(1)
        assert torch.allclose(parts.take(image), y * CHARACTERS[:, g, None], atol=1e-5)


def test_what_is_even_under_everything_has_one_part():
    Y = torch.randn(2, 2, 32, generator=torch.Generator().manual_seed(1))
    even = sum(g.parts(Y) for g in SYMMETRIES)
    y = Parts("relax", (2, 32)).take(even.flatten(1))
    assert y[:, 0].abs().max() > 1.0
    assert y[:, 1:].abs().max() < 1e-5
