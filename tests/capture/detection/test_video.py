"""Timestamps are matched to videos, or it is said why they cannot be."""

import shutil

import cv2
import numpy as np
import pytest
from board_pictures import ask_for_rotation

from preface.capture.video import (
    VideoError,
    assign_cameras,
    frames_of_video,
    read_frames,
    read_timestamps,
    read_video_header,
)

HEADER = "sync_index,cam_id,frame_index,frame_time\n"


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    """Five frames of 64x48; frame n is of brightness 40 n."""
    path = tmp_path_factory.mktemp("video") / "cam_2.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 5, (64, 48))
    for index in range(5):
        writer.write(np.full((48, 64, 3), 40 * index, np.uint8))
    writer.release()
    return path


def times(tmp_path, rows, header=HEADER):
    path = tmp_path / "timestamps.csv"
    path.write_text(header + "".join(f"{row}\n" for row in rows))
    return path


def test_frames_come_in_order_with_their_numbers(video):
    frames = list(read_frames(video))
    assert [index for index, _ in frames] == [0, 1, 2, 3, 4]
    for index, image in frames:
        assert image.shape == (48, 64)
        assert abs(image.mean() - 40 * index) < 4
    assert [index for index, _ in read_frames(video, every=2)] == [0, 2, 4]
    assert [index for index, _ in read_frames(video, wanted=[3, 1])] == [1, 3]
    header = read_video_header(video)
    assert (header.width, header.height, header.frames) == (64, 48, 5)


def test_a_video_that_ends_too_early_says_so(video):
    with pytest.raises(VideoError, match="ends after 5 frames, but frame 9 is needed"):
        list(read_frames(video, wanted=[1, 9]))


@pytest.mark.parametrize("content", [b"", b"no video at all" * 100])
def test_what_is_no_video_is_refused(tmp_path, content):
    path = tmp_path / "a.mp4"
    path.write_bytes(content)
    with pytest.raises(VideoError, match=r"a\.mp4"):
        read_video_header(path)


def test_a_video_that_asks_to_be_rotated_is_refused(tmp_path, video):
    turned = shutil.copy(video, tmp_path / "cam_2.mp4")
    ask_for_rotation(turned)
    with pytest.raises(VideoError, match=r"cam_2\.mp4: rotation: the file asks to be rotated by 90 degrees"):
        read_video_header(turned)


def test_lines_count_the_frames_of_the_video(tmp_path, video):
    stamps = read_timestamps(times(tmp_path, [f"{s},2,{s - 7}" for s in (7, 8, 11)]))
    assert frames_of_video(stamps, 2, video) == {0: 7, 1: 8, 4: 11}


def test_a_video_cut_from_a_longer_recording_is_matched_by_order(tmp_path, video):
    stamps = read_timestamps(times(tmp_path, [f"{s},2,{s + 20}" for s in (4, 3, 2, 1, 0)]))
    assert frames_of_video(stamps, 2, video) == {0: 0, 1: 1, 2: 2, 3: 3, 4: 4}


def test_lines_that_fit_the_video_in_no_way_are_refused(tmp_path, video):
    stamps = read_timestamps(times(tmp_path, [f"{s},2,{s + 20}" for s in range(4)]))
    with pytest.raises(VideoError, match=r"reaches frame 23 in 4 lines, but cam_2\.mp4 has 5 frames"):
        frames_of_video(stamps, 2, video)


def test_names_tell_the_cam_id(tmp_path):
    stamps = read_timestamps(times(tmp_path, ["0,0,0", "0,1,0", "0,12,0"]))
    assert assign_cameras(stamps, ["cam_0", "1", "port12"]) == {"cam_0": 0, "1": 1, "port12": 12}
    with pytest.raises(VideoError, match=r"no cam_id belongs to the camera 'front' \(there are 0, 1, 12\)"):
        assign_cameras(stamps, ["front"])
    with pytest.raises(VideoError, match="1 could belong to 'cam_1' and to 'cam01'"):
        assign_cameras(stamps, ["cam_1", "cam01"])


@pytest.mark.parametrize(
    ("rows", "header", "said"),
    [
        (["0,0"], "sync_index,cam_id\n", "line 1: lacks the column frame_index"),
        (["0,0,0", "1,0,x"], HEADER, "line 3: frame_index is 'x', no whole number"),
        (["0,0,0", "0,0,1"], HEADER, "line 3: cam_id 0 has sync_index 0 a second time"),
        (["0,0,-1"], HEADER, "line 2: frame_index is negative"),
        ([], HEADER, "holds no line"),
    ],
)
def test_malformed_timestamps_are_refused(tmp_path, rows, header, said):
    with pytest.raises(VideoError, match=said):
        read_timestamps(times(tmp_path, rows, header))
