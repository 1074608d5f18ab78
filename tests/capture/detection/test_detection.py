"""A take is detected on all cores, and what is wrong with its files is said by name."""

import csv
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
from board_pictures import CHARUCO, CHESSBOARD, HEIGHT, WIDTH, ask_for_rotation, homography, picture, seen

from preface.artifacts import ArtifactError
from preface.capture.boards import board_points, describe_board
from preface.capture.calibration_files import find_calibration
from preface.capture.detection import DetectionError, DetectionOptions, detect_corners
from preface.capture.images import write_png

CAMERAS, FRAMES = ("left", "right"), 3


def pose(camera, frame, board=CHARUCO):
    return homography(board, 10 * CAMERAS.index(camera) + frame)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    folder = tmp_path_factory.mktemp("capture")
    for camera in CAMERAS:
        (folder / "calibration" / camera).mkdir(parents=True)
        for frame in range(FRAMES):
            image = picture(CHARUCO, pose(camera, frame), seed=frame)
            write_png(folder / "calibration" / camera / f"{frame}.png", image)
    return folder


@pytest.fixture
def capture(drawn, tmp_path):
    return shutil.copytree(drawn, tmp_path / "capture")


def detect(folder, board=CHARUCO, **options):
    return detect_corners(find_calibration(folder)[0], board, DetectionOptions(**options))


def test_every_view_is_detected_where_it_is(capture):
    corners = detect(capture)
    assert corners.warnings == ()
    found = corners.observations
    assert found.camera_ids == CAMERAS
    assert found.image_sizes == ((WIDTH, HEIGHT),) * 2
    assert found.frame_ids == ("0", "1", "2")
    np.testing.assert_array_equal(found.board_points, board_points(CHARUCO))
    assert found.counts.min() > 20
    for camera, name in enumerate(CAMERAS):
        for frame in range(FRAMES):
            points, pixels = found.view(camera, frame)
            np.testing.assert_allclose(pixels, seen(CHARUCO, pose(name, frame))[points], atol=0.1)


def test_the_result_does_not_depend_on_the_number_of_processes(capture):
    alone, together = (detect(capture, jobs=jobs).observations for jobs in (1, 2))
    for name in ("camera", "frame", "point", "pixels"):
        np.testing.assert_array_equal(getattr(alone, name), getattr(together, name))


def test_a_file_that_cannot_be_read_is_named_and_left_out(capture):
    broken = capture / "calibration" / "left" / "1.png"
    broken.write_bytes(broken.read_bytes()[:3000])
    corners = detect(capture)
    assert str(broken) in corners.warnings[0]
    assert ("left", "1") in {(entry.camera, entry.frame) for entry in corners.unseen}
    assert corners.observations.counts[0].tolist().count(0) == 1


def test_nothing_but_broken_files_is_an_error(capture):
    for file in capture.rglob("*.png"):
        file.write_bytes(b"")
    with pytest.raises(ArtifactError, match=r"0\.png: header: is empty"):
        detect(capture)


def test_images_of_two_sizes_in_one_camera_are_named(capture):
    odd = capture / "calibration" / "right" / "2.png"
    write_png(odd, np.zeros((HEIGHT // 2, WIDTH // 2), np.uint8))
    with pytest.raises(DetectionError, match=rf"400x300, but {odd} is 200x150"):
        detect(capture)


def test_a_camera_that_never_sees_the_board_is_named_and_kept(capture):
    for frame in range(FRAMES):
        noise = np.random.default_rng(frame).integers(0, 255, (HEIGHT, WIDTH), np.uint8)
        write_png(capture / "calibration" / "right" / f"{frame}.png", noise)
    corners = detect(capture)
    assert "'right' never sees the board in 3 images: nothing like a board is seen" in corners.warnings[0]
    assert corners.observations.counts[1].sum() == 0
    assert corners.observations.camera_ids == CAMERAS


def test_a_repeated_image_is_named_and_counted_once(capture):
    folder = capture / "calibration" / "left"
    shutil.copy(folder / "0.png", folder / "2.png")
    corners = detect(capture)
    assert "2 images are identical" in corners.warnings[0]
    assert "left/0, left/2" in corners.warnings[0]
    assert corners.observations.counts[0].tolist()[2] == 0


def mirror(folder, cameras):
    for camera in cameras:
        for file in (folder / "calibration" / camera).iterdir():
            write_png(file, np.ascontiguousarray(cv2.imread(str(file), 0)[:, ::-1]))


def test_mirrored_footage_is_named(capture):
    mirror(capture, ["right"])
    corners = detect(capture)
    assert "'right': 3 of 3 images show the board mirrored" in corners.warnings[0]
    assert corners.observations.counts[1].sum() == 0


def test_a_take_of_mirrored_footage_is_refused(capture):
    mirror(capture, CAMERAS)
    with pytest.raises(DetectionError, match="the footage is mirrored"):
        detect(capture)


def test_images_that_share_no_name_are_pointed_out(capture):
    for file in (capture / "calibration" / "right").iterdir():
        file.rename(file.with_name(f"R{file.name}"))
    assert "No frame is seen by two cameras (left/0, right/R0)" in detect(capture).warnings[0]


# -------------------------------------------------------------------------- wrong descriptions

WRONG = {
    "squares": (replace(CHARUCO, squares=(9, 6)), "found markers of 5x7 squares, expected 9x6"),
    "fewer squares": (replace(CHARUCO, squares=(4, 5)), "found markers of 5x7 squares, expected 4x5"),
    "dictionary": (
        replace(CHARUCO, dictionary="DICT_5X5_100"),
        "found markers of DICT_4X4_50, expected DICT_5X5_100",
    ),
    "inverted": (replace(CHARUCO, inverted=True), "found markers printed black on white"),
    "kind": (CHESSBOARD, "found markers of DICT_4X4_1000, expected a chessboard"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_description_is_explained_by_what_is_seen(capture, name):
    board, explanation = WRONG[name]
    with pytest.raises(DetectionError, match=explanation):
        detect(capture, board)


def test_a_chessboard_of_another_size_is_explained(tmp_path):
    folder = tmp_path / "calibration" / "front"
    folder.mkdir(parents=True)
    write_png(folder / "0.png", picture(CHESSBOARD, homography(CHESSBOARD)))
    with pytest.raises(DetectionError, match="found a 6x5 inner-corner chessboard, expected 8x5"):
        detect(tmp_path, describe_board("chessboard", (8, 5), 0.03))


@pytest.mark.parametrize("printed", ["legacy", "current"])
def test_a_pattern_of_the_other_opencv_is_explained(tmp_path, printed):
    board = describe_board("charuco", (6, 6), 0.03, 0.022, "DICT_4X4_50", legacy=printed == "legacy")
    folder = tmp_path / "calibration" / "front"
    folder.mkdir(parents=True)
    write_png(folder / "0.png", picture(board, homography(board)))
    assert detect(tmp_path, board).observations.counts.sum() > 15
    other = replace(board, legacy=not board.legacy)
    with pytest.raises(DetectionError, match=f"found a {printed} pattern, expected the other .*'legacy'"):
        detect(tmp_path, other)


def test_a_chessboard_that_looks_the_same_upside_down_is_pointed_out(tmp_path):
    board = describe_board("chessboard", (6, 4), 0.03)
    folder = tmp_path / "calibration" / "front"
    folder.mkdir(parents=True)
    write_png(folder / "0.png", picture(board, homography(board)))
    assert "looks the same upside down" in detect(tmp_path, board).warnings[0]


# -------------------------------------------------------------------------------------- videos


def write_video(path, images):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 5, (WIDTH, HEIGHT))
    for image in images:
        writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()


def write_times(path, rows):
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["sync_index", "cam_id", "frame_index", "frame_time"])
        writer.writerows((*row, 0.1) for row in rows)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("film")
    blank = np.full((HEIGHT, WIDTH), 90, np.uint8)
    boards = [picture(CHARUCO, homography(CHARUCO, seed), seed=seed) for seed in range(3)]
    write_video(folder / "cam_0.mp4", boards)
    write_video(folder / "cam_1.mp4", [blank, *boards])
    return folder


def test_timestamps_say_which_frames_belong_together(filmed, tmp_path):
    folder = shutil.copytree(filmed, tmp_path / "film")
    write_times(folder / "timestamps.csv", [(s, 0, s) for s in range(3)] + [(s, 1, s + 1) for s in range(3)])
    found = detect(folder).observations
    assert found.frame_ids == ("000000", "000001", "000002")
    assert found.counts.min() > 20
    for frame in range(3):  # the same picture in both videos, one frame apart
        (left, at_left), (right, at_right) = found.view(0, frame), found.view(1, frame)
        both = np.intersect1d(left, right)
        moved = at_left[np.isin(left, both)] - at_right[np.isin(right, both)]
        assert np.abs(moved).max() < 0.3


def test_without_timestamps_frames_of_one_number_belong_together(filmed, tmp_path):
    folder = shutil.copytree(filmed, tmp_path / "film")
    corners = detect(folder)
    assert "no timestamps.csv" in corners.warnings[0]
    assert corners.observations.frame_ids == ("000000", "000001", "000002", "000003")
    assert (corners.observations.counts > 0).tolist() == [[True] * 3 + [False], [False] + [True] * 3]
    assert detect(folder, every=2).observations.frame_ids == ("000000", "000002")


def test_an_empty_video_is_an_error_that_names_it(filmed, tmp_path):
    folder = shutil.copytree(filmed, tmp_path / "film")
    (folder / "cam_1.mp4").write_bytes(b"")
    with pytest.raises(ArtifactError, match=r"cam_1\.mp4: file: is empty"):
        detect(folder)


def test_a_rotated_video_is_refused_before_any_frame_is_searched(filmed, tmp_path):
    folder = shutil.copytree(filmed, tmp_path / "film")
    ask_for_rotation(folder / "cam_1.mp4")
    with pytest.raises(ArtifactError, match=r"cam_1\.mp4: rotation: .*90 degrees.*Rotate the pixels"):
        detect(folder)
