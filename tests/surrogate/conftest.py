"""Small training pairs, made once."""

import pytest
import torch
from surrogate_cases import labelled, sample, write_pairs

from surrogate.pairs import open_pairs


@pytest.fixture(scope="session")
def pairs_path(tmp_path_factory):
    """Pairs of 32, 8 and 8 shapes; relax is one implicit step of 1e-5."""
    return write_pairs(tmp_path_factory.mktemp("pairs") / "pairs.h5", labelled(*sample()))


@pytest.fixture(scope="session")
def pairs(pairs_path):
    return open_pairs(pairs_path)


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)
