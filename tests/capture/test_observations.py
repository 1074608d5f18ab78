"""Observations refuse what does not fit together, and keep their numbering when they are thinned out."""

from dataclasses import replace

import numpy as np
import pytest

from preface.capture.observations import ObservationError, Observations

SEEN = Observations(
    camera_ids=("a", "b"),
    image_sizes=((640, 480), (320, 240)),
    frame_ids=("0", "1", "2"),
    board_points=np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]),
    camera=np.array([0, 0, 1, 1, 1]),
    frame=np.array([0, 0, 0, 2, 2]),
    point=np.array([0, 3, 1, 1, 2]),
    pixels=np.arange(10.0).reshape(5, 2),
)


def test_counts_and_views_tell_who_sees_what():
    assert SEEN.counts.tolist() == [[2, 0, 0], [1, 0, 2]]
    points, pixels = SEEN.view(1, 2)
    assert points.tolist() == [1, 2]
    assert pixels.tolist() == [[6, 7], [8, 9]]
    assert SEEN.points.tolist() == SEEN.board_points[[0, 3, 1, 1, 2]].tolist()


def test_a_part_keeps_the_numbering():
    part = SEEN.subset(SEEN.frame == 2)
    assert len(part) == 2
    assert part.frame_ids == SEEN.frame_ids
    assert part.counts.tolist() == [[0, 0, 0], [0, 0, 2]]
    assert len(SEEN.subset(SEEN.camera == 0)) == 2
    assert len(SEEN.subset(np.zeros(5, bool))) == 0


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"camera": np.array([0, 0, 1, 1, 2])}, "camera: 2 is not an index below 2"),
        ({"point": np.array([0, -1, 1, 1, 2])}, "point: -1 is not an index below 4"),
        ({"frame": np.array([0.0, 0, 0, 2, 2])}, "frame: has the shape .* whole numbers"),
        ({"pixels": np.full((5, 2), np.nan)}, "pixels: holds a number that is not finite"),
        ({"pixels": np.zeros((4, 2))}, "pixels: lengths differ"),
        ({"pixels": np.zeros((5, 3))}, r"pixels: has the shape \(5, 3\)"),
        ({"point": np.array([0, 0, 1, 1, 2])}, "point: 0 is seen twice by 'a' in '0'"),
        ({"camera_ids": ("a", "a")}, "camera_ids: 'a' appears twice"),
        ({"image_sizes": ((640, 480),)}, "image_sizes: has 1 entries for 2 cameras"),
        ({"image_sizes": ((640, 480), (0, 0))}, "image_sizes: .* of 'b' is no size"),
    ],
)
def test_what_does_not_fit_is_refused(change, said):
    with pytest.raises(ObservationError, match=said):
        replace(SEEN, **change)
