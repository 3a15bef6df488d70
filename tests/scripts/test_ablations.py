"""Tables of ablations: which runs a study asks for, what is said of their numbers, and a small one from runs to the page."""

import json
import re
from dataclasses import replace

import ablations
import pytest
import typer
from ablations import QUICK, SPLIT, STUDIES, Extent, Row, Study, Variant
from scene_helpers import PAIR, write_scene
from studies.runs import Kept, resolved, run
from typer.testing import CliRunner

from biem.scene.build import build


def row(labels, position, own=None, cost=1.0, failure="", rung="a"):
    error = dict.fromkeys(ablations.MEASURES, position)
    return Row(tuple(labels), rung, failure, 4.0 if failure else 10.0, 0.5, cost, error, {"position": own, "shape": own} if own else {})


def test_networks_come_one_at_a_time_and_all_together():
    study = STUDIES["networks"](Extent())
    assert [len([v for v in study.variants if v.labels[0] == kind]) for kind in ("hybrid", "mlp", "ivnet")] == [5, 6, 6]
    scenes = {v.labels: ablations.scene_of(ablations.SCENE, v.rung, "10 t_gamma").scene for v in study.variants}
    for (kind, slot), scene in scenes.items():
        kinds = scene.solver.map_kinds
        expected = [] if slot == "none" else [s for s in kinds if (kind, s) != ("hybrid", "near")] if slot == "all" else [slot]
        assert [s for s in kinds if kinds[s] != "exact"] == expected
        assert all(kinds[s] == kind for s in expected)
    against = {v.labels[1]: v.against for v in study.variants if v.labels[0] == "mlp"}
    assert against["near"] == "split[time.order=2, solver.near_field=layers]"
    assert against["relax"] == against["all"] == SPLIT


@pytest.mark.parametrize("name", STUDIES)
@pytest.mark.parametrize("extent", [Extent(), QUICK])
def test_every_rung_is_a_scene_with_frames_at_the_same_times(name, extent):
    study = STUDIES[name](extent)
    named = {v.rung for v in study.variants}
    for variant in study.variants:
        assert len(variant.labels) == len(study.heads)
        assert not variant.against or variant.against in named
        scene = ablations.scene_of(ablations.SCENE, variant.rung, extent.horizon).scene
        assert build(scene).dt * scene.time.save_every == pytest.approx(2e-4, rel=1e-9)
        assert scene.time.horizon == extent.horizon


def test_shares_are_of_the_sum():
    rows = [row(["mlp", "relax"], 0.1, 0.03), row(["mlp", "near"], 0.1, 0.01), row(["mlp", "all"], 0.2, 0.05)]
    assert ablations.shares_of(rows[:2]) == pytest.approx({("mlp", "relax"): 0.75, ("mlp", "near"): 0.25})
    said = ablations.networks(Extent()).says([row(["exact", "none"], 0.02, rung=SPLIT), *rows])
    assert "The exact run is 0.02 R off the reference" in said
    assert "relax moves the vesicles most, 0.03 R, 75 % of the sum; all of them together 0.05 R, which leaves 0.2 R" in said
    text = ablations.table(ablations.networks(Extent()), rows)
    assert [re.search(r"(\d+) %", line)[1] for line in text.splitlines()[2:4]] == ["75", "25"]
    assert "%" not in text.splitlines()[4]


def test_the_order_in_time_is_fitted_and_dominated_runs_are_counted():
    of = lambda n, dt, error, cost: row(["split", str(n), f"{dt:g}"], 0.1, error, cost)
    rows = [of(1, 1e-5, 0.01, 4.0), of(1, 2e-5, 0.02, 2.0), of(2, 1e-5, 0.001, 6.0), of(2, 2e-5, 0.004, 3.0)]
    said = ablations.order(Extent()).says(rows)
    assert "order 1 errs in time by 0.01 to 0.02 R, falling as dt^1.0" in said
    assert "order 2 errs in time by 0.001 to 0.004 R, falling as dt^2.0" in said
    assert "1 of the 2 runs of order 1 cost no less and err no less than one of order 2" in said


def test_a_run_that_ended_early_is_told_and_never_the_best():
    rows = [row(["32", "none"], 0.01, failure="step 7 rejected"), row(["32", "interpolated"], 0.03), row(["32", "upsampled"], 0.02)]
    study = ablations.near(QUICK)
    assert study.says(rows) == "At N = 32 positions are off by 0.01 R (until it ends at 4 t_gamma) without a correction, by 0.02 R with it."
    text = ablations.table(study, rows)
    assert "**0.02**" in text
    assert "**0.01**" not in text
    assert "- 32, none ended at 4 t_gamma: step 7 rejected" in text
    whole = [replace(rows[0], failure=""), *rows[1:]]
    assert study.says([replace(whole[0], error={"position": 0.2}), *whole[1:]]).endswith("by 0.02 R with it, 10 times less.")


def test_operators_are_compared_in_error_and_cost():
    rows = [row(["split", "N = 32"], 0.3, cost=1.0), row(["split", "2 N = 64"], 0.1, cost=1.5), row(["split", "4 N = 128"], 0.1)]
    said = ablations.operators(Extent()).says(rows)
    assert said == "split: positions are off by 0.3 R at N = 32, 0.1 R at 2 N = 64, 0.1 R at 4 N = 128; 1.5 times the cost of N at 2 N."


def in_this_process(tasks, desc):
    return {name: Kept(scene, path, run(scene, path)) for name, (scene, path) in tasks.items()}


def command(arguments):
    app = typer.Typer()
    app.command()(ablations.main)
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_from_runs_to_the_page(tmp_path, monkeypatch):
    (tmp_path / "out" / "runs").mkdir(parents=True)
    path = write_scene(tmp_path, PAIR, time={"dt": 2.0**-13, "save_every": 2})
    variants = (Variant(("fine",), "split[time.dt=6.103515625e-05]"), Variant(("coarse",), SPLIT, "split[time.dt=6.103515625e-05]"))
    says = lambda rows: f"{len(rows)} runs"
    tiny = Study("Tiny", "About it.", ("what",), variants, says, "the fine one")
    monkeypatch.setattr(ablations, "kept_all", in_this_process)
    monkeypatch.setattr(ablations, "STUDIES", {"tiny": lambda extent: tiny})
    monkeypatch.setattr(ablations, "QUICK", Extent(horizon="0.03 t_gamma", reference=24))
    found = command(["tiny", "--quick", "--scene", path, "-o", tmp_path / "out", "--page", tmp_path / "page.md"])
    assert found.exit_code == 0, found.output
    text = (tmp_path / "page.md").read_text()
    assert "the reference: implicit, N = 24, order 2, dt = 0.0001220703125." in text
    assert "## Tiny\n\n2 runs\n\nAbout it." in text
    rows = json.loads((tmp_path / "out" / "tiny.json").read_text())["rows"]
    assert [r["own"] != {} for r in rows] == [False, True]
    assert all(0 < r["error"]["position"] < 1e-2 and r["cost"] > 0 and r["until"] == pytest.approx(0.03) for r in rows)
    again = command(["tiny", "--quick", "--scene", path, "-o", tmp_path / "out", "--reference", tmp_path / "out/runs" / "none.h5"])
    assert again.exit_code == 2


def test_bad_input_is_one_line(tmp_path):
    still = write_scene(tmp_path, PAIR, flow={"kind": "quiescent", "rate": None}, time={"dt": 1e-4, "horizon": 1e-3})
    for arguments, words in ((["nets"], "there is no ablation nets"), (["near", "--scene", still], "the fluid is at rest")):
        found = command([*arguments, "-o", tmp_path / "out"])
        assert found.exit_code == 2
        assert words in found.output
        assert found.output.count("\n") == 1


def test_resolved_scenes_of_shared_rungs_are_one_run():
    """ "auto" of the two studies of near fields."""
    of = lambda name: {
        v.rung: resolved(ablations.scene_of(ablations.SCENE, v.rung, "1 t_gamma").scene) for v in STUDIES[name](Extent()).variants
    }
    near, layers = of("near"), of("layers")
    shared = near.keys() & layers.keys()
    assert len(shared) == 2
    assert all(near[name] == layers[name] for name in shared)
