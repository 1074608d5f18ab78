"""The pictures of a board are found in every layout that is offered, or it is said what is in the way."""

import pytest

from preface.artifacts import ArtifactError
from preface.capture.calibration_files import find_calibration
from preface.capture.manifest import Board, CaptureCamera, Manifest, Take, write_capture


def touch(folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"content")


def found(folder):
    return {
        take.id: {camera: [f.name for f in files] for camera, files in take.cameras.items()}
        for take in find_calibration(folder)
    }


LAYOUTS = {
    "calibration/take/camera": ("calibration/{take}/{camera}/1.png", {"mon", "tue"}),
    "calibration/camera": ("calibration/{camera}/1.png", {"default"}),
    "camera": ("{camera}/1.png", {"default"}),
    "videos in folders": ("calibration/{take}/{camera}/video.mp4", {"mon", "tue"}),
    "videos of a take": ("calibration/{take}/{camera}.MP4", {"mon", "tue"}),
    "videos": ("{camera}.mp4", {"default"}),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_layout_is_inferred(tmp_path, layout):
    template, takes = LAYOUTS[layout]
    for take in ("mon", "tue"):
        touch(tmp_path, *(template.format(take=take, camera=camera) for camera in ("a", "b")))
    touch(tmp_path, "subjects/0001/a.png", "notes.txt", ".hidden/x.png")
    takes_found = found(tmp_path)
    assert set(takes_found) == takes
    for cameras in takes_found.values():
        assert set(cameras) == {"a", "b"}
        assert all(len(files) == 1 for files in cameras.values())


def test_timestamps_lie_beside_the_cameras(tmp_path):
    touch(tmp_path, "cam_0.mp4", "cam_1.mp4", "timestamps.csv")
    assert find_calibration(tmp_path)[0].timestamps == tmp_path / "timestamps.csv"


def test_a_manifest_says_which_takes_cameras_and_boards_there_are(tmp_path):
    board = Board("b", "chessboard", (7, 6), 0.02)
    cameras = (CaptureCamera("a"), CaptureCamera("b"), CaptureCamera("c"))
    write_capture(tmp_path, Manifest(cameras, (Take("mon"), Take("tue", calibration="other")), (), (board,)))
    touch(tmp_path, "calibration/mon/a/1.png", "calibration/mon/b/1.png", "other/c/2.jpg", "other/c/10.jpg")
    assert found(tmp_path) == {
        "mon": {"a": ["1.png"], "b": ["1.png"], "c": []},
        "tue": {"a": [], "b": [], "c": ["10.jpg", "2.jpg"]},
    }
    assert all(take.board == board for take in find_calibration(tmp_path))


@pytest.mark.parametrize(
    ("files", "said"),
    [
        (["readme.txt"], "holds no pictures of a board"),
        (["calibration/a/notes.txt"], "holds no pictures of a board"),
        (["a/1.png", "a/v.mp4"], "holds 1 images and 1 videos"),
        (["a/v.mp4", "a/w.mov"], "holds 0 images and 2 videos"),
        (["a/1.png", "a/1.jpg"], "two images are called 1"),
        (["a.mp4", "a.mov"], "has a folder and a video, or two videos"),
        (["a/1.png", "a.mp4"], "has a folder and a video"),
        (["my camera/1.png"], "'my camera' cannot be the name of a camera"),
    ],
)
def test_what_cannot_be_understood_is_said(tmp_path, files, said):
    touch(tmp_path, *files)
    with pytest.raises(ArtifactError, match=said):
        find_calibration(tmp_path)


def test_a_folder_that_is_not_there_is_said(tmp_path):
    with pytest.raises(ArtifactError, match="there is no such folder"):
        find_calibration(tmp_path / "nowhere")


def test_a_camera_that_the_manifest_does_not_know_is_refused(tmp_path):
    write_capture(tmp_path, Manifest((CaptureCamera("a"),), (Take("mon"),), ()))
    touch(tmp_path, "calibration/mon/a/1.png", "calibration/mon/z/1.png")
    with pytest.raises(ArtifactError, match="'z' is not one of the manifest's cameras"):
        find_calibration(tmp_path)
