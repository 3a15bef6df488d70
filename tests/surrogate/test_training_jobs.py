"""What there is to train: every map and mode once, from the right file, shared by costs."""

from dataclasses import replace
from functools import partial

import pytest

from biem.cli import read_part
from surrogate.config import load_training
from surrogate.grid import variants
from surrogate.jobs import cost, dealt, pick, pick_all

IVNET, MLP = load_training(None, ["network.arch=ivnet"]), load_training(None)
RESIDUAL = load_training(None, ["network.target=residual"])


def names(works):
    return [job.name for job, _ in works]


def test_an_ivnet_has_a_job_for_each_map_and_mode(pairs, tmp_path):
    found = names(pick_all(IVNET, [pairs], tmp_path))
    assert len(found) == len(set(found)) == 2 + 3 * 17
    assert {"relax-1e-05", "self_tension", "advection-00", "flow_tension-16", "near-07"} <= set(found)
    assert names(pick_all(IVNET, [pairs], tmp_path, grouped=True)) == [
        "relax-1e-05", "self_tension", "advection-00-16", "flow_tension-00-16", "near-00-16",
    ]  # fmt: skip


def test_an_mlp_has_one_for_each_map_and_no_residual_of_near(pairs, tmp_path):
    assert names(pick_all(MLP, [pairs], tmp_path)) == ["relax-1e-05", "self_tension", "advection", "flow_tension", "near"]
    assert names(pick_all(RESIDUAL, [pairs], tmp_path)) == ["relax-1e-05", "self_tension", "advection", "flow_tension"]


def test_relax_takes_every_time_step_and_of_one_step_the_last_file(pairs, tmp_path):
    flow, long = replace(pairs, relaxation="converged", maps=("relax",)), replace(pairs, dt=1e-4, maps=("relax",))
    works = pick(MLP, [pairs, flow, long], tmp_path, "relax", None)
    assert [(job.name, data.relaxation, data.dt) for job, data in works] == [
        ("relax-1e-05", "converged", 1e-5),
        ("relax-0.0001", "implicit", 1e-4),
    ]
    ((_, data),) = pick(MLP, [pairs, flow, long], tmp_path, "self_tension", None)
    assert data is pairs


def test_work_is_dealt_by_cost_and_nothing_is_lost(pairs, tmp_path):
    works = pick_all(IVNET, [pairs], tmp_path)
    hands = dealt(works, partial(cost, IVNET), 4)
    assert sorted(name for hand in hands for name in names(hand)) == sorted(names(works))
    loads = [sum(cost(IVNET, work) for work in hand) for hand in hands]
    assert max(loads) - min(loads) <= max(cost(IVNET, work) for work in works)
    assert cost(IVNET, works[-1]) == 5 * cost(IVNET, works[0])  # five layers


@pytest.mark.parametrize(
    ("name", "mode", "config", "message"),
    [
        ("advektion", None, MLP, "--map advektion: expected one of relax"),
        ("advection", 3, MLP, "--mode 3: only IVNets of advection"),
        ("relax", 0, IVNET, "leave it out for relax"),
        ("near", 17, IVNET, "--mode 17: curves of 32 nodes have modes 0 to 16"),
    ],
)
def test_what_there_is_not_is_refused(pairs, tmp_path, name, mode, config, message):
    with pytest.raises(ValueError, match=message):
        pick(config, [pairs], tmp_path, name, mode)


def test_a_mode_or_map_that_the_file_lacks_is_named(pairs, tmp_path):
    with pytest.raises(ValueError, match="has modes 0-3 of near, not 7: label them"):
        pick(IVNET, [replace(pairs, modes=(0, 1, 2, 3))], tmp_path, "near", 7)
    with pytest.raises(ValueError, match="has labels of relax, not of near"):
        pick(IVNET, [replace(pairs, maps=("relax",))], tmp_path, "near", None)


def test_parts():
    assert read_part("2/8") == (2, 8)
    for wrong in ("0/3", "4/3", "3", "a/b"):
        with pytest.raises(ValueError, match="expected K/P"):
            read_part(wrong)


def test_grid_variants_and_wrong_values():
    found = variants(IVNET, "1,2", "8", "1,3")
    assert list(found) == ["b1-w8-l1", "b1-w8-l3", "b2-w8-l1", "b2-w8-l3"]
    assert (found["b2-w8-l3"].network.blocks, found["b2-w8-l3"].network.width, found["b2-w8-l3"].network.levels) == (2, 8, 3)
    with pytest.raises(ValueError, match="--widths x: expected whole numbers"):
        variants(IVNET, "1", "x", "1")
