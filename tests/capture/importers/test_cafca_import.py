"""Cafca's layout as a capture: cameras, images and masks as they were, and a reason for all that is left out."""

import json
import os
import shutil

import layouts
import numpy as np
import pytest
from PIL import Image

from preface.artifacts import ArtifactError, load_json
from preface.capture.importers import ImportOptions, import_dataset
from preface.capture.manifest import read_capture
from preface.capture.rig import read_rig
from preface.cli.inspect import main as inspect

PLACES = ["00000/00000_000", "00000/00001_000", "00007/00000_000"]


@pytest.fixture
def source(tmp_path):
    layouts.write_cafca(tmp_path / "cafca", PLACES, layouts.cameras(4))
    return tmp_path / "cafca"


def imported(source, **options):
    return import_dataset("cafca", source, source.parent / "capture", ImportOptions(**options))


def test_every_frame_becomes_a_subject_with_its_images_and_masks(source):
    result = imported(source)
    assert (result.people, result.subjects, result.views, result.masks) == (2, 3, 12, 12)
    assert result.left_out == ()
    capture = read_capture(result.capture)
    names = ["00000-00000_000", "00000-00001_000", "00007-00000_000"]
    assert [subject.id for subject in capture.manifest.subjects] == names
    assert capture.missing_views == []
    for number, (name, place) in enumerate(zip(names, PLACES, strict=True)):
        for index in range(4):
            camera = f"C{index:02d}"
            image = capture.images[name, camera]
            assert image.samefile(source / place / "color_image" / f"{camera}.png")
            with Image.open(image) as pixels, Image.open(capture.masks[name, camera]) as mask:
                assert pixels.getpixel((3, 3)) == (10 * number + index, 100, 50)
                assert mask.getpixel((3, 3)) == 200 + index
    people = capture.manifest.metadata["imported"]["people"]
    assert people == {names[0]: "00000", names[1]: "00000", names[2]: "00007"}
    assert inspect([str(result.capture)]) == 0


def test_frames_with_the_same_cameras_share_a_take_and_others_do_not(source):
    layouts.write_cafca(source, ["00009/00003_002"], layouts.cameras(5)[1:])
    result = imported(source)
    takes = {subject.id: subject.take for subject in read_capture(result.capture).manifest.subjects}
    first, other = "00000-00000_000", "00009-00003_002"
    assert takes == {first: first, "00000-00001_000": first, "00007-00000_000": first, other: other}
    assert sorted(path.name for path in (result.capture / "rigs").iterdir()) == [
        f"{first}.json",
        f"{other}.json",
    ]
    assert any("--procrustes" in note for note in result.notes)


def test_the_rig_sees_points_where_the_dataset_does(source):
    rig = read_rig(imported(source).capture / "rigs" / "00000-00000_000.json")
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (20, 3))
    for index, truth in enumerate(layouts.cameras(4)):
        camera = rig.cameras[f"C{index:02d}"]
        homogeneous = (truth.K @ (truth.R @ points.T + truth.t[:, None])).T
        pixels, valid = camera.camera.project(camera.camera_from_rig.apply(points))
        assert valid.all()
        np.testing.assert_allclose(pixels, homogeneous[:, :2] / homogeneous[:, 2:], atol=1e-9)


def test_a_unit_of_millimetres_becomes_metres(source):
    result = imported(source, metres_per_unit=1e-3)
    rig = read_rig(result.capture / "rigs" / "00000-00000_000.json")
    centre = rig.cameras["C01"].camera_from_rig.inverse.translation
    truth = layouts.cameras(4)[1]
    np.testing.assert_allclose(centre, -truth.R.T @ truth.t / 1000, atol=1e-15)


def test_only_frames_that_match_are_imported(source):
    result = imported(source, patterns=("*/00000_000",))
    assert (result.people, result.subjects) == (2, 2)


def test_people_by_the_hundred_are_found(tmp_path):
    layouts.write_cafca(tmp_path / "cafca" / "00000-00099", PLACES, layouts.cameras(2))
    assert imported(tmp_path / "cafca").subjects == 3


def test_other_folders_of_the_dataset_are_no_frames(source):
    (source / "00000" / "flame_2023_000").mkdir()
    (source / "00000" / "flame_2023_000" / "tracked_flame_params_100.npz").write_bytes(b"")
    assert imported(source).subjects == 3


def test_a_copy_does_not_change_with_the_original(source):
    capture = read_capture(imported(source, link="copy").capture)
    image = capture.images["00000-00000_000", "C00"]
    assert not image.samefile(source / PLACES[0] / "color_image" / "C00.png")
    assert image.read_bytes() == (source / PLACES[0] / "color_image" / "C00.png").read_bytes()


def test_a_dataset_without_masks_becomes_a_capture_without_masks(tmp_path):
    layouts.write_cafca(tmp_path / "cafca", PLACES[:1], layouts.cameras(2), masks=False)
    result = imported(tmp_path / "cafca")
    assert (result.views, result.masks, result.left_out) == (2, 0, ())


# -------------------------------------------------------------------------------------- bad input


def rewrite(file, **changes):
    file.write_text(json.dumps({**load_json(file), **changes}))


def no_camera(frame):
    (frame / "cameras_json" / "C01.json").unlink()


def no_image(frame):
    (frame / "color_image" / "C01.png").unlink()


def no_mask(frame):
    (frame / "foreground_mask" / "C01.png").unlink()


def two_images(frame):
    layouts.write_image(frame / "color_image" / "C01.jpg", 1)


def another_mask_size(frame):
    layouts.write_image(frame / "foreground_mask" / "C01.png", 1, size=(47, 64), mode="L")


def another_image_size(frame):
    rewrite(frame / "cameras_json" / "C01.json", image_size=[96, 128])


def truncated_camera(frame):
    (frame / "cameras_json" / "C01.json").write_text('{"K": [[1, 0')


def mirrored_pose(frame):
    rewrite(frame / "cameras_json" / "C01.json", world2cam=np.diag([1, 1, -1, 1.0]).tolist(), cam2world=None)
    content = load_json(frame / "cameras_json" / "C01.json")
    del content["cam2world"]
    (frame / "cameras_json" / "C01.json").write_text(json.dumps(content))


def not_finite(frame):
    text = (frame / "cameras_json" / "C01.json").read_text()
    (frame / "cameras_json" / "C01.json").write_text(text.replace("31.7", "NaN"))


def no_image_file(frame):
    (frame / "color_image" / "C01.png").write_bytes(b"<html>quota exceeded</html>")


def leads_out(frame):
    private = frame.parents[2] / "private.png"
    layouts.write_image(private, 9)
    (frame / "color_image" / "C01.png").unlink()
    (frame / "color_image" / "C01.png").symlink_to(private)


BAD_VIEWS = {
    no_camera: "does not exist",
    no_image: "has no image of this camera",
    no_mask: "has 0 images of 'C01'",
    two_images: "has 2 images of 'C01': C01.jpg, C01.png",
    another_mask_size: "foreground_mask/C01.png is 47x64, and its camera is 48x64",
    another_image_size: "color_image/C01.png is 48x64, and its camera is 96x128",
    truncated_camera: "not valid JSON",
    mirrored_pose: "rotation",
    not_finite: "not a finite float64",
    no_image_file: "not a PNG, JPEG, TIFF or EXR",
    leads_out: "symbolic link that leads out",
}


@pytest.mark.parametrize("spoil", BAD_VIEWS, ids=lambda spoil: spoil.__name__)
def test_a_bad_view_is_left_out_with_its_reason_and_the_rest_is_imported(source, spoil):
    spoil(source / PLACES[0])
    result = imported(source)
    (left,) = result.left_out
    assert left.place == f"{PLACES[0]}/C01"
    assert BAD_VIEWS[spoil] in left.error.problem
    assert left.error.remedy
    assert result.views == 11
    capture = read_capture(result.capture)
    assert capture.missing_views == [("00000-00000_000", "C01")]
    (noted,) = capture.manifest.metadata["imported"]["left_out"]
    assert noted["place"] == left.place
    assert BAD_VIEWS[spoil] in noted["why"]


@pytest.mark.parametrize("spoil", BAD_VIEWS, ids=lambda spoil: spoil.__name__)
def test_strict_stops_at_a_bad_view_and_leaves_nothing_behind(source, spoil):
    spoil(source / PLACES[0])
    before = sorted(source.parent.iterdir())
    with pytest.raises(ArtifactError) as caught:
        imported(source, strict=True)
    assert BAD_VIEWS[spoil] in caught.value.problem
    assert sorted(source.parent.iterdir()) == before


def test_names_that_differ_in_case_only_are_not_both_imported(source):
    layouts.write_cafca(source, ["a/0_0", "A/0_0"], layouts.cameras(2))
    result = imported(source)
    assert result.subjects == 4
    (left,) = result.left_out
    assert left.place == "a/0_0"
    assert "would have the name of A/0_0" in left.error.problem


@pytest.mark.parametrize("name", ["müller", "a b", "x" * 120])
def test_names_that_no_capture_can_have_are_left_out(source, name):
    layouts.write_cafca(source, [f"{name}/0_0"], layouts.cameras(2))
    result = imported(source)
    assert result.subjects == 3
    (left,) = result.left_out
    assert left.place == f"{name}/0_0"
    assert left.error.remedy == "Rename the folder"


def test_a_frame_without_a_single_usable_view_is_left_out(source):
    for index in range(4):
        (source / PLACES[1] / "cameras_json" / f"C{index:02d}.json").unlink()
    result = imported(source)
    assert (result.subjects, len(result.left_out)) == (2, 4)


def test_a_folder_of_another_layout_is_refused_with_the_shape_that_is_needed(tmp_path):
    layouts.write_facescape(tmp_path / "data", "1/1_neutral", layouts.cameras(2))
    with pytest.raises(ArtifactError, match=r"SUBJECT/EXP_ENV") as caught:
        imported(tmp_path / "data")
    assert "--layout" in caught.value.remedy


def test_a_dataset_without_one_usable_frame_is_refused(source):
    for place in PLACES:
        shutil.rmtree(source / place / "cameras_json")
    with pytest.raises(ArtifactError, match="none of its 3 frames can be used"):
        imported(source)
    assert not (source.parent / "capture").exists()


def test_a_capture_within_the_dataset_or_among_other_files_is_refused(source):
    with pytest.raises(ArtifactError, match="within the dataset"):
        import_dataset("cafca", source, source / "capture", ImportOptions())
    (source.parent / "capture").mkdir()
    (source.parent / "capture" / "mine.txt").write_text("mine")
    with pytest.raises(ArtifactError, match="not an empty folder"):
        imported(source)
    assert (source.parent / "capture" / "mine.txt").read_text() == "mine"


def test_a_file_system_without_links_names_the_remedy(source, monkeypatch):
    def refuse(*_):
        raise OSError(18, "Invalid cross-device link")

    monkeypatch.setattr(os, "link", refuse)
    with pytest.raises(ArtifactError, match="--link copy"):
        imported(source)
    assert sorted(path.name for path in source.parent.iterdir()) == ["cafca"]
