"""FaceScape's layout as a capture, against OpenCV, and on to an alignment with landmarks that are given."""

import json

import cv2
import layouts
import made_up_studio as made
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from preface.align.keypoints import CANONICAL_KEYPOINTS
from preface.align.landmark_files import landmark_file, write_landmarks
from preface.align.landmarks import ViewLandmarks, box_around
from preface.artifacts import ArtifactError, load_json
from preface.capture.importers import ImportOptions, import_dataset
from preface.capture.manifest import read_capture
from preface.capture.rig import read_rig
from preface.cli.align import main as align
from preface.cli.build_shards import main as build
from preface.geometry import Similarity
from preface.reports import Report
from preface.shards import Dataset

POINTS = np.random.default_rng(1).uniform(-0.05, 0.05, (15, 3))


def imported(source, **options):
    return import_dataset("facescape", source, source.parent / "capture", ImportOptions(**options))


def seen(truth, points):
    """OpenCV's pixels, moved to the convention with the top-left pixel's centre at (0.5, 0.5)."""
    rotation, _ = cv2.Rodrigues(truth.R)
    pixels, _ = cv2.projectPoints(points, rotation, truth.t, truth.K, truth.distortion)
    return pixels[:, 0] + 0.5


def test_the_rig_sees_points_where_opencv_does(tmp_path):
    truths = layouts.cameras(3, distorted=True)
    layouts.write_facescape(tmp_path / "data", "12/3_mouth_stretch", truths)
    result = imported(tmp_path / "data")
    assert (result.people, result.subjects, result.views, result.left_out) == (1, 1, 3, ())
    rig = read_rig(result.capture / "rigs" / "12-3_mouth_stretch.json")
    assert list(rig.cameras) == ["SN000", "SN001", "SN002"]
    for camera, truth in zip(rig.cameras.values(), truths, strict=True):
        pixels, valid = camera.camera.project(camera.camera_from_rig.apply(POINTS))
        assert valid.all()
        np.testing.assert_allclose(pixels, seen(truth, POINTS), atol=1e-9)
    capture = read_capture(result.capture)
    for view, name in enumerate(rig.cameras):
        assert capture.images["12-3_mouth_stretch", name].samefile(
            tmp_path / "data" / "12" / "3_mouth_stretch" / f"{view}.jpg"
        )


def test_views_by_number_where_cameras_have_no_serial_numbers(tmp_path):
    layouts.write_facescape(tmp_path / "data", "1/1_neutral", layouts.cameras(12), serials=False)
    capture = read_capture(imported(tmp_path / "data").capture)
    assert capture.images["1-1_neutral", "10"].samefile(tmp_path / "data" / "1" / "1_neutral" / "10.jpg")


def test_a_view_that_is_not_valid_is_left_out_and_the_others_keep_their_images(tmp_path):
    layouts.write_facescape(tmp_path / "data", "1/1_neutral", layouts.cameras(4), invalid=(0, 2))
    result = imported(tmp_path / "data")
    assert [left.place for left in result.left_out] == ["1/1_neutral/0", "1/1_neutral/2"]
    assert "not valid" in result.left_out[0].error.problem
    capture = read_capture(result.capture)
    assert sorted(capture.images) == [("1-1_neutral", "SN001"), ("1-1_neutral", "SN003")]
    assert capture.images["1-1_neutral", "SN003"].samefile(tmp_path / "data/1/1_neutral/3.jpg")


def missing_image(folder, content):
    (folder / "1.jpg").unlink()


def unknown_image(folder, content):
    layouts.write_image(folder / "1000.jpg", 1)


def another_size(folder, content):
    layouts.write_image(folder / "1.jpg", 1, size=(64, 48))


@pytest.mark.parametrize(
    ("spoil", "view", "problem"),
    [
        (missing_image, "1", "has 0 images of '1'"),
        (unknown_image, "1000", "does not know"),
        (another_size, "1", "is 64x48, and its camera is 48x64"),
    ],
)
def test_a_bad_view_is_left_out_with_its_reason(tmp_path, spoil, view, problem):
    folder = tmp_path / "data" / "1" / "1_neutral"
    layouts.write_facescape(tmp_path / "data", "1/1_neutral", layouts.cameras(3))
    spoil(folder, load_json(folder / "params.json"))
    (left,) = imported(tmp_path / "data").left_out
    assert left.place == f"1/1_neutral/{view}"
    assert problem in left.error.problem


def climbing_view(content):
    content["../../0_K"] = content["0_K"]


def no_validity(content):
    del content["1_valid"]


def text_validity(content):
    content["1_valid"] = "no"


def skew(content):
    content["1_K"][0][1] = 0.5


def mirrored(content):
    content["1_Rt"][0] = [-value for value in content["1_Rt"][0]]


def folding_lens(content):
    content["1_distortion"][0] = -30.0


def wrong_shape(content):
    content["1_Rt"].pop()


BAD_PARAMS = {
    climbing_view: "views are whole numbers",
    no_validity: "is missing",
    text_validity: "'no'",
    skew: "skew",
    mirrored: "rotation",
    folding_lens: "folds",
    wrong_shape: "shape",
}


@pytest.mark.parametrize("spoil", BAD_PARAMS, ids=lambda spoil: spoil.__name__)
def test_a_frame_whose_cameras_cannot_be_read_is_left_out_as_a_whole(tmp_path, spoil):
    for place in ("1/1_neutral", "2/1_neutral"):
        layouts.write_facescape(tmp_path / "data", place, layouts.cameras(3))
    content = load_json(tmp_path / "data" / "1" / "1_neutral" / "params.json")
    spoil(content)
    layouts.write_params(tmp_path / "data", "1/1_neutral", content)
    result = imported(tmp_path / "data")
    (left,) = result.left_out
    assert left.place == "1/1_neutral"
    assert BAD_PARAMS[spoil] in left.error.problem
    assert (result.subjects, result.views) == (1, 3)
    assert not list(result.capture.glob("subjects/1-*"))


def test_a_frame_without_params_is_left_out(tmp_path):
    for place in ("1/1_neutral", "2/1_neutral"):
        layouts.write_facescape(tmp_path / "data", place, layouts.cameras(3))
    (tmp_path / "data" / "1" / "1_neutral" / "params.json").unlink()
    (left,) = imported(tmp_path / "data").left_out
    assert left.place == "1/1_neutral"
    assert "does not exist" in left.error.problem


# ----------------------------------------------------------------------- registrations, and the chain


def heads_frame(number):
    """mm and axes of the registered heads from the world of a frame: scale, R, t."""
    rotation = Rotation.from_euler("xyz", [10 * number, -20, 5], degrees=True).as_matrix()
    return 250.0 + 30 * number, rotation, np.array([3.0, -4.0, 20.0 * number])


def write_registered(tmp_path, people):
    """Frames in worlds of their own, whose cameras in the heads' frame (metres) are `layouts.cameras`."""
    entries = {}
    for number, person in enumerate(people):
        scale, R, t = heads_frame(number)
        truths = [truth.moved(scale / 1000, R, t / 1000) for truth in layouts.cameras(5)]
        layouts.write_facescape(tmp_path / "data", f"{person}/1_neutral", truths)
        entries[person] = {"1": [scale, np.concatenate([R, t[:, None]], axis=1).tolist()]}
    path = tmp_path / "Rt_scale_dict.json"
    path.write_text(json.dumps(entries))
    return path


def test_registrations_bring_all_frames_to_one_frame_in_metres(tmp_path):
    result = imported(tmp_path / "data", registrations=write_registered(tmp_path, ["7", "8"]))
    for person in ("7", "8"):
        rig = read_rig(result.capture / "rigs" / f"{person}-1_neutral.json")
        for camera, truth in zip(rig.cameras.values(), layouts.cameras(5), strict=True):
            pixels, _ = camera.camera.project(camera.camera_from_rig.apply(POINTS))
            np.testing.assert_allclose(pixels, seen(truth, POINTS), atol=1e-7)
            centre = camera.camera_from_rig.inverse.translation
            np.testing.assert_allclose(centre, -truth.R.T @ truth.t, atol=1e-9)


def test_a_person_without_registration_is_left_out(tmp_path):
    registrations = write_registered(tmp_path, ["7", "8"])
    content = load_json(registrations)
    del content["8"]
    registrations.write_text(json.dumps(content))
    result = imported(tmp_path / "data", registrations=registrations)
    assert [left.place for left in result.left_out] == ["8/1_neutral"]
    assert result.subjects == 1


def give_landmarks(folder, people):
    """The face of each person as OpenCV sees it in the original cameras."""
    for person, offset in people.items():
        points = made.face(made.TEMPLATE + np.array(offset))
        for view, truth in enumerate(layouts.cameras(5)):
            pixels = seen(truth, points)
            count = len(points)
            found = ViewLandmarks("ibug68", pixels, np.full(count, 0.5), np.ones(count), box_around(pixels))
            where = (f"{person}-1_neutral", f"SN{view:03d}")
            path = landmark_file(folder, where)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_landmarks(path, where, (layouts.WIDTH, layouts.HEIGHT), found)


def test_an_import_aligns_and_becomes_shards_that_see_what_the_original_cameras_saw(tmp_path, monkeypatch):
    name = "preface.cli.align_studio.alignment_report"
    monkeypatch.setattr(name, lambda studio, provenance, load_image: Report("light", provenance))
    people = {"7": (0.0, 0.0, 0.0), "8": (0.004, 0.002, 0.0), "9": (-0.003, 0.0, 0.005)}
    result = imported(tmp_path / "data", registrations=write_registered(tmp_path, list(people)))
    give_landmarks(tmp_path / "landmarks", people)
    rigs, alignment, shards = (str(tmp_path / part) for part in ("capture/rigs", "alignment", "shards"))
    capture, landmarks = str(result.capture), str(tmp_path / "landmarks")
    assert align(["studio", capture, "--rig", rigs, "--landmarks", landmarks, "--output", alignment]) == 0
    flags = ["--resolution", "24x32", "--foreground", "none", "--jobs", "1"]
    assert build([capture, "--rig", rigs, "--alignment", alignment, "--output", shards, *flags]) == 0
    with Dataset(shards) as dataset:
        assert dataset.names == tuple(f"{person}-1_neutral" for person in people)
        for number, (person, offset) in enumerate(people.items()):
            aligned = load_json(tmp_path / "alignment" / f"{person}-1_neutral.json")
            keypoints = np.array([aligned["keypoints"][name] for name in CANONICAL_KEYPOINTS])
            np.testing.assert_allclose(keypoints, made.TEMPLATE + np.array(offset), atol=2e-5)
            found = aligned["canonical_from_rig"]
            canonical_from_rig = Similarity.from_quaternion(
                found["scale"], found["quaternion_wxyz"], found["translation"]
            )
            for view, truth in enumerate(layouts.cameras(5)):
                pixels = seen_by_shard(dataset, number, view, canonical_from_rig.apply(POINTS))
                assert np.abs(pixels - seen(truth, POINTS) / 2).max() < 0.01  # half the resolution


def seen_by_shard(dataset, identity, view, points):
    """Where OpenCV sees canonical points with the camera of a shard's view."""
    lens = dataset.tables["intrinsics"][identity, view]
    pose = dataset.tables["canonical_from_camera"][identity, view]
    K = np.array([[lens[0], 0, lens[2] - 0.5], [0, lens[1], lens[3] - 0.5], [0, 0, 1]])
    rotation, _ = cv2.Rodrigues(pose[:, :3].T)
    pixels, _ = cv2.projectPoints(points, rotation, -pose[:, :3].T @ pose[:, 3], K, lens[4:])
    return pixels[:, 0] + 0.5


def test_registrations_of_a_strange_shape_are_refused(tmp_path):
    registrations = write_registered(tmp_path, ["7"])
    registrations.write_text(json.dumps({"7": {"1": [250.0]}}))
    with pytest.raises(ArtifactError, match="has 1 parts"):
        imported(tmp_path / "data", registrations=registrations, strict=True)
