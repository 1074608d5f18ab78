"""``preface-render`` as a user runs it, on a prior of ball-shaped heads that was hardly trained."""

import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
import pytest

from preface.artifacts import load_json, provenance, sha256, write_artifact
from preface.capture.images import read_exr, read_image
from preface.capture.rig import Rig, RigCamera, read_rig, write_rig
from preface.cli.render import main
from preface.cli.train import main as train
from preface.geometry import Camera, Rigid
from preface.model.training.prior_files import read_prior

sys.path.insert(0, str(Path(__file__).parents[1] / "model" / "training"))

SPECS = Path(__file__).parents[2] / "data_specs"
STEPS = ["--steps", "20", "--identities", "3", "--views", "2", "--rays", "32"]


@pytest.fixture(scope="module")
def prior(tmp_path_factory) -> Path:
    import ball_heads

    shards = tmp_path_factory.mktemp("balls")
    ball_heads.write_dataset(shards)
    folder = tmp_path_factory.mktemp("prior")
    arguments = ["--preset", "tiny", "--output", str(folder), "--final-views", "1", "--faces-between", "0"]
    assert train([str(shards), *arguments, *STEPS]) == 0
    return folder


def names(prior: Path | str) -> list[str]:
    return list(read_prior(prior).identities)


def test_one_image_from_the_front_with_everything_known_of_it(prior, tmp_path, capsys):
    arguments = [
        str(prior),
        "--identity",
        names(prior)[0],
        "--size",
        "20x30",
        "--output",
        str(tmp_path / "out"),
    ]
    assert main(arguments) == 0
    assert capsys.readouterr().out.splitlines()[-1] == str(tmp_path / "out" / "rig.json")
    written = sorted(file.name for file in (tmp_path / "out").iterdir())
    assert written == [
        "front.alpha.png",
        "front.depth.png",
        "front.exr",
        "front.normals.png",
        "front.png",
        "legend.png",
        "rig.json",
    ]
    channels = read_exr(tmp_path / "out" / "front.exr")
    assert set(channels) == {"R", "G", "B", "A", "Z", "N.X", "N.Y", "N.Z"}
    picture = read_image(tmp_path / "out" / "front.png")
    assert picture.shape == (30, 20, 3)
    np.testing.assert_allclose(picture[..., 0], np.clip(channels["R"], 0, 1) * 255, atol=0.51)
    seen = channels["A"] > 0.5
    # Depths lie inside the box, a metre away and at most its diagonal deep; normals have length one.
    assert (np.abs(channels["Z"][seen] - 1) < 0.6).all()
    lengths = np.sqrt(sum(channels[f"N.{axis}"][seen] ** 2 for axis in "XYZ"))
    np.testing.assert_allclose(lengths, 1, atol=1e-5)
    assert np.isnan(channels["Z"][~seen]).all()


def test_cameras_that_were_written_render_the_same_images(prior, tmp_path):
    first, again = tmp_path / "first", tmp_path / "again"
    who = ["--identity", names(prior)[1], "--no-normals"]
    assert main([str(prior), *who, "--orbit", "2", "--size", "12x16", "--output", str(first)]) == 0
    assert main([str(prior), *who, "--cameras", str(first / "rig.json"), "--output", str(again)]) == 0
    assert len(read_rig(first).cameras) == 2
    for name in ("0000.png", "0001.png", "0001.depth.png"):
        difference = read_image(first / name).astype(int) - read_image(again / name)
        assert np.abs(difference).max() <= 1


def test_a_colour_of_depth_is_the_same_depth_in_every_picture(tmp_path):
    """From cameras at other distances: the legend beside the pictures has one scale."""
    model = ["pretrained", "--identity", names("pretrained")[0], "--quality", "draft", "--no-normals"]
    cameras = {}
    for name, distance in (("close", "0.9"), ("away", "1.1")):
        how = ["--size", "8x12", "--distance", distance, "--output", str(tmp_path / name)]
        assert main([*model, *how]) == 0
        cameras[name] = read_rig(tmp_path / name).cameras["front"]
    (tmp_path / "both").mkdir()
    write_rig(tmp_path / "both" / "rig.json", replace(read_rig(tmp_path / "close"), cameras=cameras))
    out = tmp_path / "out"
    assert main([*model, "--cameras", str(tmp_path / "both" / "rig.json"), "--output", str(out)]) == 0
    depth = np.concatenate([read_exr(out / f"{name}.exr")["Z"].ravel() for name in cameras])
    colour = np.concatenate([read_image(out / f"{name}.depth.png").reshape(-1, 3) for name in cameras])
    seen = ~np.isnan(depth)
    assert np.ptp(depth[seen]) > 0.2
    brightness = (colour[seen] @ [0.3, 0.59, 0.11])[np.argsort(depth[seen])]
    assert (np.diff(brightness) > -1).all()
    assert brightness[-1] > brightness[0] + 20


def test_a_camera_may_not_have_the_name_of_the_legend(prior, tmp_path, capsys):
    who = [str(prior), "--identity", names(prior)[0], "--no-normals"]
    assert main([*who, "--size", "4x6", "--output", str(tmp_path / "one")]) == 0
    rig = read_rig(tmp_path / "one")
    write_rig(tmp_path / "rig.json", replace(rig, cameras={"legend": rig.cameras["front"]}))
    assert main([*who, "--cameras", str(tmp_path / "rig.json"), "--output", str(tmp_path / "out")]) == 1
    assert "'legend' is the name of another file" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_codes_go_from_one_identity_to_another_and_a_video_has_every_frame(prior, tmp_path, capfd):
    one, other = names(prior)[:2]
    out = tmp_path / "out"
    arguments = ["--orbit", "3", "--size", "16x24", "--no-exr", "--no-normals", "--video", "--azimuth", "0"]
    assert (
        main(
            [
                str(prior),
                "--identity",
                one,
                "--towards",
                other,
                *arguments,
                "--elevation",
                "0",
                "--output",
                str(out),
            ]
        )
        == 0
    )
    assert (
        main(
            [str(prior), "--identity", other, *arguments, "--elevation", "0", "--output", str(tmp_path / "b")]
        )
        == 0
    )
    np.testing.assert_array_equal(read_image(out / "0002.png"), read_image(tmp_path / "b" / "0002.png"))
    assert (read_image(out / "0000.png") != read_image(out / "0002.png")).any()
    assert "OpenCV" not in capfd.readouterr().err
    video, frames = cv2.VideoCapture(str(out / "orbit.webm")), 0
    while video.read()[0]:
        frames += 1
    assert frames == 3
    assert not [file for file in out.iterdir() if file.name.startswith(".")]


def test_a_mesh_lies_where_the_model_is_dense_enough_and_an_empty_model_has_none(prior, tmp_path, capsys):
    path = tmp_path / "head.ply"
    who = ["--identity", names(prior)[0], "--size", "4x4", "--output", str(tmp_path / "out")]
    arguments = [str(prior), *who, "--mesh", str(path), "--mesh-resolution", "24"]
    assert main([*arguments, "--surface", "0.999"]) == 1
    assert "lower --surface" in capsys.readouterr().err
    assert not path.exists()
    assert main([*arguments, "--surface", "0.02"]) == 0
    mesh = o3d.io.read_triangle_mesh(str(path))
    assert mesh.has_vertex_colors()
    assert len(mesh.triangles) > 50


def test_qualities_and_single_shortcuts_stay_near_the_reference(prior, tmp_path):
    who = ["--identity", names(prior)[0], "--size", "20x30", "--no-normals", "--no-exr", "--background", "1"]
    pictures = {}
    for label, flags in {
        "reference": ["--quality", "reference"],
        "balanced": [],
        "draft": ["--quality", "draft"],
        "folded": ["--quality", "reference", "--folded"],
        "fp32": ["--quality", "balanced", "--matmul", "fp32", "--no-opaque-normals"],
    }.items():
        assert main([str(prior), *who, *flags, "--output", str(tmp_path / label)]) == 0
        pictures[label] = read_image(tmp_path / label / "front.png").astype(int)
    for label, picture in pictures.items():
        # A prior after 20 steps is fog, of which the bounds may drop a little everywhere.
        assert np.abs(picture - pictures["reference"]).mean() < (0.1 if label == "folded" else 4)


def test_an_image_that_takes_long_says_how_far_it_is(prior, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("preface.cli.render_frames.SECONDS_BETWEEN", -1.0)
    who = ["--identity", names(prior)[0], "--size", "10x12", "--no-normals", "--no-exr"]
    assert main([str(prior), *who, "--rays-at-a-time", "50", "--output", str(tmp_path / "out")]) == 0
    told = capsys.readouterr().err
    assert "row 5 of 12" in told
    assert "s left" in told
    assert "1 of 1 images" in told


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        ([], 2, "--identity is needed"),
        (["--identity", "nobody"], 1, "there is no 'nobody'"),
        (["--identity", "FIRST", "--size", "12by3"], 2, "12by3"),
        (["--identity", "FIRST", "--distance", "0.01"], 1, "move it away"),
        (["--identity", "FIRST", "--cameras", "absent.json"], 1, "absent.json"),
        (["--identity", "FIRST", "--alignment", "a.json"], 2, "--cameras"),
        (["--identity", "FIRST", "--device", "cuda:77"], 2, "--device"),
        (["--identity", "FIRST", "--mesh", "head.xyz"], 2, ".ply"),
        (["--identity", "FIRST", "--sample-share", "0"], 2, "--sample-share: 0.0"),
        (["--identity", "FIRST", "--quality", "best"], 2, "invalid choice"),
    ],
)
def test_what_cannot_be_is_told_before_anything_is_written(prior, tmp_path, arguments, status, words, capsys):
    arguments = [names(prior)[0] if a == "FIRST" else a for a in arguments]
    try:
        ended = main([str(prior), "--output", str(tmp_path / "out"), *arguments])
    except SystemExit as error:
        ended = error.code
    assert ended == status
    assert words in capsys.readouterr().err
    assert not list(tmp_path.rglob("*.png"))


def test_a_folder_without_a_model_and_one_that_cannot_be_written_are_errors(prior, tmp_path, capsys):
    assert main([str(tmp_path), "--output", str(tmp_path / "out")]) == 1
    assert "model.json" in capsys.readouterr().err
    (tmp_path / "file").touch()
    assert main([str(prior), "--identity", names(prior)[0], "--output", str(tmp_path / "file" / "out")]) == 1
    assert "file" in capsys.readouterr().err


def test_photographs_and_the_rig_of_a_capture_are_left_alone(prior, tmp_path, capsys):
    def render(folder):
        return main([str(prior), "--identity", names(prior)[0], "--size", "8x12", "--output", str(folder)])

    pictures, studio = tmp_path / "pictures", tmp_path / "studio"
    for folder, file in ((pictures, "left.JPG"), (studio, "rig.json")):
        folder.mkdir()
        (folder / file).write_text('{"take": "monday"}')
        assert render(folder) == 1
        assert f"{folder}: folder: holds other things than renders ({file})" in capsys.readouterr().err
        assert [entry.name for entry in folder.iterdir()] == [file]


def test_a_folder_of_renders_is_rendered_into_again_also_after_an_interruption(prior, tmp_path):
    arguments = [str(prior), "--identity", names(prior)[0], "--size", "8x12", "--output", str(tmp_path)]
    assert main(arguments) == 0
    assert main(arguments) == 0
    (tmp_path / "rig.json").unlink()
    assert main(arguments) == 0


def test_a_folder_with_frames_of_another_render_is_left_alone(prior, tmp_path, capsys):
    def render(*more):
        words = ["--size", "8x12", "--no-normals", "--no-exr", "--output", str(tmp_path), *more]
        return main([str(prior), "--identity", names(prior)[0], *words])

    assert render("--orbit", "2") == 0
    there = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    capsys.readouterr()
    assert render("--orbit", "1", "--video") == 1
    told = capsys.readouterr().err
    assert "holds another render: orbit is 2 there and 1 now; video is off there and on now" in told
    assert "Choose another --output" in told
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == there
    assert render("--orbit", "2", "--rays-at-a-time", "50", "--mesh-resolution", "9") == 0  # the same frames
    (tmp_path / "rig.json").unlink()  # as after an interruption
    capsys.readouterr()
    assert render() == 1
    assert "holds frames of another render (0000, 0001)" in capsys.readouterr().err


def test_a_rig_of_another_take_than_the_alignments_is_refused(prior, tmp_path, capsys):
    alignment = tmp_path / "alignment.json"
    alignment.write_text((SPECS / "alignment.example.json").read_text())
    (tmp_path / "rigs").mkdir()
    who = [
        str(prior),
        "--identity",
        names(prior)[0],
        "--no-normals",
        "--no-exr",
        "--alignment",
        str(alignment),
    ]

    def render(take, rig, of_person=None):
        lens = Camera("PINHOLE", 4, 6, np.array([8.0, 8.0, 2.0, 3.0]))
        pose = Rigid(np.eye(3), np.array([0.0, 0.0, 0.6]))
        written = write_rig(tmp_path / "rigs" / rig, Rig(take, {"only": RigCamera.at(lens, pose)}))
        content = load_json(alignment)
        inputs = {f"rigs/{content['take']}.json": of_person or sha256(written)}
        content["provenance"] = provenance({}, {}) | {"inputs": inputs}
        write_artifact(alignment, content)
        ended = main([*who, "--cameras", str(written), "--output", str(tmp_path / "out" / rig)])
        return ended, capsys.readouterr().err

    aligned_in = load_json(alignment)["take"]
    its = tmp_path / "rigs" / f"{aligned_in}.json"
    assert render(aligned_in, its.name, "0" * 64)[0] == 0
    status, told = render("tuesday", "tuesday.json", "0" * 64)
    assert status == 1
    assert f"tuesday.json: take: is 'tuesday', and {alignment} was made in take '{aligned_in}'" in told
    assert f"Give the rig of take '{aligned_in}', {its}." in told
    assert not (tmp_path / "out" / "tuesday.json").exists()
    status, told = render("canonical", "canonical.json", "0" * 64)
    assert (status, "leave --alignment away" in told) == (1, True)
    # What has no name of its own, and what the person was aligned with by whatever name.
    assert render("default", "default.json", "0" * 64)[0] == 0
    assert render("photos", "photos.json")[0] == 0


def test_an_unknown_identity_is_refused_and_a_text_is_no_prior(prior, tmp_path, capsys):
    (tmp_path / "note.txt").write_text("hello")
    assert main([str(tmp_path / "note.txt"), "--output", str(tmp_path / "out")]) == 1
    told = capsys.readouterr().err
    assert "note.txt: prior: is not a prior. Name the folder that preface-train wrote." in told
    with pytest.raises(SystemExit, match="2"):
        main([str(prior), "--output", str(tmp_path / "out"), "--size", "0x10"])
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("preface-render: error: argument --size: '0x10' is not WIDTHxHEIGHT")
    assert line.endswith("see preface-render --help")
