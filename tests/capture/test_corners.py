"""Corners survive writing and reading, and corners of other detectors are checked before they are used."""

import json

import numpy as np
import pytest

from preface.artifacts import SCHEMA_DIRECTORY, ArtifactError, provenance
from preface.capture.boards import board_points, describe_board
from preface.capture.corners import Corners, Unseen, read_corners, write_corners
from preface.capture.observations import Observations

EXAMPLE = json.loads((SCHEMA_DIRECTORY / "corners.example.json").read_text())


def some_corners():
    board = describe_board("charuco", (5, 4), 0.03, 0.02, "DICT_4X4_50", inverted=True)
    random = np.random.default_rng(0)
    camera, frame, point = (a.ravel() for a in np.indices((2, 3, len(board_points(board)))))
    observations = Observations(
        ("a", "b"),
        ((640, 480), (320, 240)),
        ("f0", "f1", "f2"),
        board_points(board),
        camera,
        frame,
        point,
        random.uniform(0, 300, (len(camera), 2)),
    )
    return Corners(
        take="monday",
        observations=observations.subset((frame != 1) | (camera != 1)),
        board=board,
        files={("a", "f0"): "a/f0.png"},
        unseen=(Unseen("b", "f1", "no board found"),),
        warnings=("Something.",),
        provenance=provenance({}, {}),
        metadata={"note": 1},
    )


def test_corners_come_back_as_they_were(tmp_path):
    corners = some_corners()
    again = read_corners(write_corners(tmp_path / "corners.json", corners))
    for name in ("board_points", "camera", "frame", "point", "pixels"):
        np.testing.assert_array_equal(getattr(again.observations, name), getattr(corners.observations, name))
    for name in ("camera_ids", "image_sizes", "frame_ids"):
        assert getattr(again.observations, name) == getattr(corners.observations, name)
    for name in ("take", "board", "files", "unseen", "warnings", "provenance", "metadata"):
        assert getattr(again, name) == getattr(corners, name)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda c: c["views"][1].update(camera="rear"),
            r"views\[1\].camera: 'rear' is not one of the cameras",
        ),
        (lambda c: c["views"][0].update(frame="9"), r"views\[0\].frame: '9' is not one of the frames"),
        (lambda c: c["views"][0]["pixels"].pop(), r"views\[0\].pixels: has 5 entries for 6 points"),
        (lambda c: c["views"][0]["pixels"][0].pop(), r"views\[0\].pixels: holds something else than numbers"),
        (lambda c: c["views"][1].update(points=[0, 1, 3, 6]), "point: 6 is not an index below 6"),
        (lambda c: c["views"][1].update(points=[0, 1, 3, 3.5]), r"views\[1\].points: is not a list of whole"),
        (lambda c: c["views"][1].update(points=[0, 1, 3, 3]), "point: 3 is seen twice by 'left' in '0001'"),
        (lambda c: c["views"].append(c["views"][0]), "is seen twice"),
        (lambda c: c["cameras"].append(c["cameras"][1]), "camera_ids: 'left' appears twice"),
        (lambda c: c.pop("board_points"), "board_points: is missing"),
        (lambda c: c.update(units="mm"), "units: "),
    ],
)
def test_corners_that_contradict_themselves_are_refused_by_field(tmp_path, change, said):
    content = json.loads(json.dumps(EXAMPLE))
    change(content)
    path = tmp_path / "corners.json"
    path.write_text(json.dumps(content))
    with pytest.raises(ArtifactError, match=said):
        read_corners(path)
