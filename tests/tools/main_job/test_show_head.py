"""The picture of a head: photographs, renders in three kinds, a legend; and what it cannot be made of."""

import ball_heads
import numpy as np
import pytest
import small_runs

from preface.capture.images import read_image, write_png
from preface.cli import fit
from preface.cli.render_frames import LEGEND_FILE
from preface.model.training.prior import train_prior
from show_head import main

GREYS = {"": 200, ".depth": 120, ".normals": 40}
LEGEND = 77


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Shards, a prior, a head of two views, and an orbit of three frames."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "shards").mkdir()
    ball_heads.write_dataset(folder / "shards")
    training = {"steps": 2, "views": 2, "rays": 8, "holdout_views": 0}
    run = {"micro_rays": 512, "faces_between": 0}
    train_prior(small_runs.config(folder / "shards", folder / "prior", training, run), small_runs.quiet)
    who = ["--prior", str(folder / "prior"), "--identity", "id0003", "--views", "camera1", "camera4"]
    steps = ["--inversion.steps", "0", "--finetuning.steps", "0", "--quality", "draft", "--device", "cpu"]
    assert fit.main([str(folder / "shards"), *who, *steps, "--output", str(folder / "head")]) == 0
    (folder / "orbit").mkdir()
    for number in range(3):
        for kind, grey in GREYS.items():
            path = folder / "orbit" / f"{number:04d}{kind}.png"
            write_png(path, np.full((60, 40, 3), grey, np.uint8))
    write_png(folder / "orbit" / LEGEND_FILE, np.full((30, 90, 3), LEGEND, np.uint8))
    return folder


def flags(folder, output, head="head", orbit="orbit"):
    return [
        str(folder / head),
        str(folder / orbit),
        "--shards",
        str(folder / "shards"),
        "--output",
        str(output),
    ]


def test_renders_stand_below_each_other_and_the_legend_below_all(made, tmp_path, capsys):
    target = tmp_path / "head.jpg"
    assert main(flags(made, target)) == 0
    assert capsys.readouterr().out.strip() == str(target)
    picture = read_image(target).astype(int)
    rows = {
        grey: np.nonzero((abs(picture - grey) < 4).all(axis=-1).sum(axis=1) > 100)[0]
        for grey in GREYS.values()
    }
    assert all(50 < len(found) <= 62 for found in rows.values())  # edges are those of a JPEG
    assert rows[200].max() < rows[120].min() < rows[120].max() < rows[40].min()
    assert (abs(picture[rows[40].max() :] - LEGEND) < 4).all(axis=-1).sum() > 0.8 * 30 * 90


@pytest.mark.parametrize(("head", "orbit"), [("prior", "orbit"), ("nobody", "orbit"), ("head", "head")])
def test_what_is_no_head_or_no_orbit_is_said(made, tmp_path, capsys, head, orbit):
    assert main(flags(made, tmp_path / "head.jpg", head, orbit)) == 1
    wrong = head if head != "head" else orbit
    assert str(made / wrong) in capsys.readouterr().err
    assert not (tmp_path / "head.jpg").exists()
