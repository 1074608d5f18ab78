"""The figures of the bench of camera refinement, against motions that are known."""

import argparse
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

from bench.camera_refinement import PARTS, camera_errors, common_motion, markdown, perturbed, summarised
from preface.geometry import Rigid

POSES = {
    name: Rigid(
        Rotation.from_euler("xyz", [0.1, 2.9 + angle, 0.2]).as_matrix(),
        [math.sin(angle), 0.1, math.cos(angle)],
    )
    for name, angle in {"a": -0.5, "b": 0.1, "c": 0.6}.items()
}


def test_a_perturbation_has_the_angle_and_the_length_that_was_asked_for():
    moved = perturbed(POSES, ("a", "c"), 0.5, 2.0, "id7", seed=1)
    for name in ("a", "c"):
        turn = Rotation.from_matrix(moved[name].rotation @ POSES[name].rotation.T)
        assert np.degrees(turn.magnitude()) == pytest.approx(0.5)
        assert np.linalg.norm(moved[name].translation - POSES[name].translation) == pytest.approx(2e-3)
    assert moved["b"] is POSES["b"]
    other = perturbed(POSES, ("a",), 0.5, 2.0, "id7", seed=2)["a"]
    assert not np.allclose(other.rotation, moved["a"].rotation, atol=1e-4)


def test_a_motion_of_all_cameras_is_found_and_leaves_no_error():
    together = Rigid(Rotation.from_rotvec([0.02, -0.01, 0.03]).as_matrix(), [0.004, -0.002, 0.001])
    moved = {name: together @ pose for name, pose in POSES.items()}
    found = common_motion(POSES, moved)
    np.testing.assert_allclose(found.matrix, together.matrix, atol=1e-9)
    assert max(camera_errors(POSES, moved, found).values()) < 1e-5
    assert camera_errors(POSES, moved, Rigid.identity())["mm"] > 1


def test_a_turn_that_a_shift_makes_up_for_is_no_error_at_the_head():
    pose = POSES["b"]
    around = Rigid(Rotation.from_rotvec([0, 0.01, 0]).as_matrix(), np.zeros(3))
    errors = camera_errors({"b": pose}, {"b": around @ pose}, Rigid.identity())
    assert errors["degrees"] == pytest.approx(math.degrees(0.01))
    assert errors["mm"] == pytest.approx(10 * math.hypot(math.sin(0.1), math.cos(0.1)), rel=1e-3)
    assert errors["mm_at_head"] < 1e-9
    about = Rigid(around.rotation @ pose.rotation, pose.translation)
    assert camera_errors({"b": pose}, {"b": about}, Rigid.identity())["mm_at_head"] == pytest.approx(
        10, rel=0.02
    )


def test_half_of_a_loss_is_reported_as_half():
    cameras = {"degrees": 0.0, "mm": 0.0, "mm_at_head": 0.0}
    values = {"true": 30.0, "true, refined": 29.98, "perturbed": 26.0, "perturbed, refined": 28.0}
    rows = {
        row: {part: {"psnr": v} for part in PARTS} | {"cameras": cameras, "cameras_relative": cameras}
        for row, v in values.items()
    }
    found = summarised([{"rows": rows}, {"rows": rows}])
    assert found["absolute"]["recovered"] == pytest.approx(0.5)
    assert found["absolute"]["lost_db"] == pytest.approx(4.0)
    assert found["relative"]["cost_db"] == pytest.approx(0.02)
    text = markdown(found, argparse.Namespace(views=["a", "b"], degrees=0.5, millimetres=2.0))
    assert "4.00 dB lost, recovered 50%" in text
    assert "| perturbed, refined | 28.00 |" in text
