"""Pictures: the files that a trajectory must have, as images that show something."""

import numpy as np
import pytest
from PIL import Image
from scene_helpers import DT, PAIR, cli, scene_of

from biem.run.plot import draw_all, separation
from biem.run.simulate import simulate
from biem.run.trajectory import read_trajectory

CHANNEL = {"flow": {"kind": "poiseuille", "width": 0.6}}
CASES = {
    "one": ({}, {"frames.png", "energy.png"}),
    "pair": (PAIR, {"frames.png", "energy.png", "separation.png"}),
    "channel": (CHANNEL, {"frames.png", "energy.png", "lateral.png"}),
}


def pixels(path):
    """(height, width, 3) of an image of sensible size that is not blank."""
    with Image.open(path) as image:
        assert image.format == {".png": "PNG", ".gif": "GIF"}[path.suffix]
        shown = np.asarray(image.convert("RGB"), dtype=float)
    assert min(shown.shape[:2]) >= 150, shown.shape
    assert max(shown.shape[:2]) <= 2000, shown.shape
    assert shown.std() > 3  # something is drawn
    assert (shown == 255).all(axis=-1).mean() > 0.2  # on white
    return shown


@pytest.mark.parametrize("case", CASES)
def test_pictures_of_a_run(tmp_path, case):
    changes, expected = CASES[case]
    done = simulate(scene_of(changes, time={"horizon": 2 * DT})).trajectory
    files = draw_all(done, tmp_path / "pictures")
    assert set(files) == set((tmp_path / "pictures").iterdir())
    images = [f for f in files if f.suffix != ".mp4"]  # drawn too where ffmpeg is installed
    assert {f.name for f in images} == expected | {"movie.gif"}
    for file in images:
        pixels(file)
    with Image.open(tmp_path / "pictures" / "movie.gif") as movie:
        assert movie.n_frames == 3


def test_plot_command_names_its_files(tmp_path):
    simulate(scene_of(PAIR, time={"horizon": DT}), tmp_path / "out.h5")
    result = cli("plot", tmp_path / "out.h5")
    assert result.exit_code == 0, result.output
    assert set(result.stdout.split()) == {str(p) for p in (tmp_path / "out").iterdir()}
    result = cli("plot", tmp_path / "out.h5", "-o", tmp_path / "there", "--no-movie")
    assert result.exit_code == 0
    assert {p.name for p in (tmp_path / "there").iterdir()} == {"frames.png", "energy.png", "separation.png"}


def test_vesicles_are_drawn_where_they_are(tmp_path):
    """A vesicle high above another one leaves the left and right thirds of its frame white."""
    apart = {"vesicles": {"centers": [[0.0, -1.0], [0.0, 1.0]]}}
    done = simulate(scene_of(apart, time={"horizon": DT})).trajectory
    draw_all(done.until(0), tmp_path, movie=False)
    shown = pixels(tmp_path / "frames.png")
    filled = (np.abs(shown - [0xE8, 0xA3, 0x3D]).max(axis=-1) < 8).nonzero()  # the face colour
    rows = np.histogram(filled[0], bins=3, range=(filled[0].min(), filled[0].max() + 1))[0]
    assert rows[1] == 0
    assert rows[0] == pytest.approx(rows[2], rel=0.1)


def test_a_run_just_begun_can_be_drawn(tmp_path):
    simulate(scene_of(CHANNEL), tmp_path / "out.h5")
    first = read_trajectory(tmp_path / "out.h5").until(0)
    assert {f.name for f in draw_all(first, tmp_path / "pictures")} == {"frames.png", "energy.png", "lateral.png"}


def test_separation_is_the_distance_of_centroids_over_the_radius():
    scene = scene_of(vesicles={"centers": [[0.0, 0.0], [0.6, 0.8]], "points": 96})
    R = np.sqrt(0.8) / (2 * np.pi)  # pi R^2 = nu L^2 / (4 pi) at length 1
    assert separation(simulate(scene).trajectory)[0] == pytest.approx(1.0 / R, rel=1e-6)


def test_no_frames_are_refused(tmp_path):
    done = simulate(scene_of()).trajectory
    with pytest.raises(ValueError, match="no frames"):
        draw_all(done.until(-1), tmp_path)
