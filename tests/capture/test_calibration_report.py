"""The report of a calibration says what the rig says, shows what was left out, and reads as one page."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from preface.artifacts import read_artifact
from preface.capture.calibration import Candidate
from preface.capture.calibration_figures import CameraResiduals, residual_fields
from preface.capture.calibration_report import TakeDrift, calibration_report
from preface.capture.epipolar import epipolar_errors
from preface.capture.outlier_views import outlier_sheet, views_left_out
from preface.capture.takes import drift
from preface.capture.uncertainty_section import keypoint_deviations
from preface.geometry import Rigid, fit_similarity

GREY = np.full((960, 640), 120, np.uint8)


@pytest.fixture(scope="module")
def report(small_calibration, tmp_path_factory):
    shifted = [TakeDrift("before", drift(small_calibration, small_calibration))]
    page = calibration_report("now", small_calibration, {"seed": 1}, lambda *_: GREY, shifted)
    path = page.write(tmp_path_factory.mktemp("report") / "rig.report.html")
    return path, read_artifact(path.with_suffix(".json"), "preface/report")


def blocks(report, heading):
    (section,) = [section for section in report[1]["sections"] if section["heading"] == heading]
    return section["blocks"]


def table(report, heading, column):
    return next(b for b in blocks(report, heading) if b["kind"] == "table" and column in b["rows"][0])


def test_every_part_is_there_in_the_order_of_reading(report):
    assert [section["heading"] for section in report[1]["sections"]] == [
        "Summary",
        "Cameras",
        "Residuals over the image",
        "Frames",
        "Pairs of cameras",
        "Uncertainty",
        "The rig in space",
        "Outliers",
        "Drift between takes",
    ]


def test_the_page_needs_nothing_beside_itself(report):
    page = report[0].read_text()
    assert 'src="data:image/png;base64,' in page
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert 'href="http' not in page


def test_the_figures_are_those_of_the_rig(report, small_calibration):
    rig = small_calibration.rig("now")
    rows = {row["camera"]: row for row in table(report, "Cameras", "RMS")["rows"]}
    assert set(rows) == set(rig.cameras)
    for name, camera in rig.cameras.items():
        assert rows[name]["RMS"] == camera.reprojection_error.rms
        assert rows[name]["corners"] == camera.reprojection_error.count
        assert rows[name]["frames"] == camera.coverage.frames
    errors = [row["RMS"] for row in table(report, "Cameras", "RMS")["rows"]]
    assert errors == sorted(errors, reverse=True)


def test_the_summary_holds_the_held_out_error_against_a_target(report, small_calibration):
    figures = {f["name"]: f for block in blocks(report, "Summary")[1:] for f in block["figures"]}
    held_out = figures["Held-out error, RMS"]
    assert held_out["value"] == small_calibration.held_out.rms
    assert held_out["target"]["at_most"] == pytest.approx(1.1 * small_calibration.reprojection_rms)
    assert figures["Camera model"]["value"] == "PINHOLE"


def test_frames_account_for_every_corner(report, small_calibration):
    rows = table(report, "Frames", "corners")["rows"]
    assert sum(row["corners"] for row in rows) == small_calibration.inliers.sum()


def test_epipolar_errors_are_of_the_size_of_the_noise(small_scene, small_calibration):
    errors = epipolar_errors(small_calibration)
    assert {(pair.first, pair.second) for pair in errors} == {("C00", "C01"), ("C00", "C02"), ("C01", "C02")}
    for pair in errors:  # across the line, where two images each have one coordinate's noise
        assert pair.rms == pytest.approx(np.sqrt(2) * small_scene.config.noise, rel=0.15)


def test_epipolar_errors_show_a_camera_that_was_turned(small_calibration):
    rotation = small_calibration.camera_from_rig.rotation.copy()
    rotation[2] = Rotation.from_rotvec([0.002, 0.002, 0]).as_matrix() @ rotation[2]
    turned = Rigid(rotation, small_calibration.camera_from_rig.translation)
    errors = {
        (pair.first, pair.second): pair.rms
        for pair in epipolar_errors(replace(small_calibration, camera_from_rig=turned))
    }
    assert errors["C00", "C01"] < 0.5
    assert min(errors["C00", "C02"], errors["C01", "C02"]) > 2


def test_predicted_keypoint_errors_are_those_that_happen(small_scene, small_calibration):
    """Triangulate keypoints from their true images: the error must be a few predicted deviations at most."""
    predicted = keypoint_deviations(small_calibration)
    found = drift_of_points(small_scene, small_calibration, small_scene.keypoints)
    assert (found < 4 * predicted.max()).all()
    assert predicted.max() < 1e-3


def drift_of_points(scene, calibration, points):
    """How far the calibrated rig misplaces points that the true cameras see, after a rigid motion."""
    cloud = points + np.random.default_rng(0).uniform(-0.1, 0.1, (30, 1, 3))
    cloud = np.concatenate([points, cloud.reshape(-1, 3)])
    normal, right = np.zeros((len(cloud), 3, 3)), np.zeros((len(cloud), 3))
    for index, camera in enumerate(calibration.cameras):
        true = Rigid(scene.camera_from_rig.rotation[index], scene.camera_from_rig.translation[index])
        pose = Rigid(
            calibration.camera_from_rig.rotation[index], calibration.camera_from_rig.translation[index]
        )
        pixels, _ = scene.cameras[index].project(true.apply(cloud))
        rays = np.concatenate([camera.unproject(pixels)[0], np.ones((len(cloud), 1))], axis=1) @ pose.rotation
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
        normal += across
        right += across @ pose.inverse.translation
    found = np.linalg.solve(normal, right[..., None])[..., 0]
    return fit_similarity(found, cloud, fixed_scale=1.0).residuals[: len(points)]


def test_views_with_outliers_are_shown_worst_first(small_calibration):
    asked = []

    def load(camera, frame):
        asked.append((camera, frame))
        return GREY

    sheet = outlier_sheet(small_calibration, load)
    assert sheet.ndim == 3
    seen = small_calibration.observations
    lengths = np.where(small_calibration.inliers, 0, np.linalg.norm(small_calibration.residuals, axis=1))
    worst = int(np.argmax(lengths))
    assert asked[0] == (seen.camera_ids[seen.camera[worst]], seen.frame_ids[seen.frame[worst]])
    assert len(set(asked)) == len(asked) <= 9


def test_a_picture_of_another_instant_is_named(small_calibration):
    assert views_left_out(small_calibration) == []
    seen = small_calibration.observations
    late = (seen.camera == 1) & (seen.frame == seen.frame[seen.camera == 1][0])
    frame = seen.frame_ids[seen.frame[late][0]]
    wrong = replace(small_calibration, inliers=small_calibration.inliers & ~late)
    assert views_left_out(wrong) == [f"C01 {frame}"]
    text = json.dumps(calibration_report("now", wrong, {}, lambda *_: None, ()).twin())
    assert f"C01 {frame}: most likely these pictures are not of the same instant" in text


def test_outliers_without_images_leave_their_count(small_calibration):
    page = calibration_report("now", small_calibration, {}, lambda *_: None, ())
    section = next(section for section in page.sections if section.heading == "Outliers")
    wrong = (~small_calibration.inliers).sum()
    assert [block.kind for block in section.blocks] == ["text"]
    assert f"{wrong} of {len(small_calibration.inliers)} corners" in section.blocks[0].paragraphs[0]


def test_a_choice_of_models_is_explained(small_calibration):
    row = {"training_rms": 0.3, "excess": 0.0, "standard_error": 0.0}
    candidates = (
        Candidate("PINHOLE", False, 4, held_out_rms=0.4, refused="", chosen=True, **row),
        Candidate("OPENCV", True, 10, held_out_rms=0.3, refused="the lens would fold", chosen=False, **row),
    )
    page = calibration_report(
        "now", replace(small_calibration, selection=candidates), {}, lambda *_: None, ()
    )
    text = json.dumps(page.twin())
    assert "within one standard error of the best" in text
    rows = next(s for s in page.twin()["sections"] if s["heading"] == "Choice of the model")["blocks"][1][
        "rows"
    ]
    assert [row["verdict"] for row in rows] == ["chosen", "the lens would fold"]


def test_the_scale_of_a_residual_field_follows_the_errors():
    rng = np.random.default_rng(0)
    pixels = rng.uniform(0, 400, (4000, 2))
    units = [
        residual_fields([CameraResiduals("c", (400, 400), pixels, np.full((4000, 2), error))])[1]
        for error in (0.01, 0.1, 1.0)
    ]
    assert units == pytest.approx([0.02, 0.2, 2.0])  # the next round figure above error * sqrt(2)
