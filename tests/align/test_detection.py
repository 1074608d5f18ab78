"""Finding the subject's landmarks in photographs of every kind, and saying so where there are none."""

import zipfile
from pathlib import Path

import cv2
import mediapipe
import numpy as np
import pytest
from face_pictures import EYE_DISTANCE, LEFT_EYE_BOX, RIGHT_EYE_BOX, canvas, portrait
from PIL import Image

from preface.align.detection import DetectionOptions, detect_views
from preface.align.face_search import find_landmarks
from preface.align.facemesh import FaceModelError, FaceModels
from preface.align.keypoints import FACEMESH478
from preface.align.landmarks import NoFace, ViewLandmarks
from preface.capture.images import write_exr, write_png

ROTATIONS = DetectionOptions().rotations


def found(image, models, jitters=4):
    result = find_landmarks(np.ascontiguousarray(image), models, 512, ROTATIONS, jitters)
    assert isinstance(result, ViewLandmarks), result
    return result


def distance(pixels, expected, unit=EYE_DISTANCE):
    """Median distance of landmarks in parts of the eye distance."""
    return float(np.nanmedian(np.linalg.norm(pixels - expected, axis=1))) / unit


@pytest.fixture(scope="module")
def upright(models):
    return found(portrait(), models)


def inside(point, box):
    return box[0] <= point[0] <= box[2] and box[1] <= point[1] <= box[3]


def test_right_is_the_subjects_right(upright):
    right, left, nose, mouth, chin = upright.keypoints
    assert inside(right, RIGHT_EYE_BOX)
    assert inside(left, LEFT_EYE_BOX)
    assert right[0] < nose[0] < left[0]
    assert right[1] < nose[1] < mouth[1] < chin[1]


def test_a_frontal_face_is_seen_whole_and_told_apart_from_guesses(upright):
    assert upright.scheme == "facemesh478"
    assert upright.seen.all()
    assert upright.others == 0
    assert upright.warnings == ()
    assert (upright.sigma > 0).all()
    assert np.nanmedian(upright.sigma) < 0.03 * EYE_DISTANCE
    nose, ear = 1, 234  # the cheek beside the ear is seen at a grazing angle
    assert upright.confidence[nose] > 0.7 > upright.confidence[ear]
    assert upright.sigma[ear] > upright.sigma[nose]


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_a_turned_photograph_gives_the_turned_landmarks(upright, models, quarters):
    result = found(np.rot90(portrait(), -quarters), models)
    height, width = portrait().shape[:2]
    x, y = upright.pixels.T
    turned = {1: (height - y, x), 2: (width - x, height - y), 3: (y, width - x)}[quarters]
    assert distance(result.pixels, np.stack(turned, -1)) < 0.02
    off = (result.rotation - upright.rotation - 90 * quarters + 180) % 360 - 180
    assert abs(off) < 3
    assert any("upside down" in warning for warning in result.warnings) == (quarters == 2)


def test_a_face_at_a_slant_is_found(upright, models):
    height, width = portrait().shape[:2]
    matrix = cv2.getRotationMatrix2D((width / 2, height / 2), 40, 0.7)
    result = found(cv2.warpAffine(portrait(), matrix, (width, height)), models)
    expected = (upright.pixels - 0.5) @ matrix[:, :2].T + matrix[:, 2] + 0.5
    assert distance(result.pixels, expected, 0.7 * EYE_DISTANCE) < 0.02


def test_a_mirrored_photograph_gives_the_twins(upright, models):
    result = found(portrait()[:, ::-1], models)
    expected = upright.pixels[FACEMESH478.mirror] * [-1, 1] + [portrait().shape[1], 0]
    assert distance(result.pixels, expected) < 0.015


def test_landmarks_of_a_large_photograph_are_those_of_the_small_one(upright, models):
    large = cv2.resize(portrait(), None, fx=6, fy=6, interpolation=cv2.INTER_CUBIC)
    assert distance(found(large, models).pixels, 6 * upright.pixels, 6 * EYE_DISTANCE) < 0.01


def test_a_face_of_a_fiftieth_of_the_photograph_is_found(upright, models):
    image = canvas(3000, 4000)
    small = cv2.resize(portrait(), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    image[2500:2800, 300:556] = small
    expected = 0.5 * upright.pixels + [300, 2500]
    assert distance(found(image, models).pixels, expected, 0.5 * EYE_DISTANCE) < 0.03


def test_of_two_faces_the_larger_one_is_taken_and_the_other_is_named(upright, models):
    image = canvas(600, 900)
    image[:, 388:] = portrait()
    image[:300, :256] = cv2.resize(portrait(), (256, 300), interpolation=cv2.INTER_AREA)
    result = found(image, models)
    assert distance(result.pixels, upright.pixels + np.array([388, 0])) < 0.02
    assert result.others == 1
    assert any(warning.startswith("1 other face is in the image") for warning in result.warnings)


def test_landmarks_beyond_the_border_count_as_not_seen(models):
    cut = portrait()[:, 230:]  # through the subject's right eye
    result = found(cut, models)
    right, _, nose, *_ = result.keypoints
    assert np.isnan(right).all()
    assert np.isfinite(nose).all()
    missing = ~result.seen
    assert np.isnan(result.sigma[missing]).all()
    assert (result.confidence[missing] == 0).all()
    assert any("outside the image" in warning for warning in result.warnings)


@pytest.mark.parametrize("kind", ["noise", "grey", "one pixel"])
def test_no_face_is_said_not_invented(models, kind):
    image = {
        "noise": np.random.default_rng(0).integers(0, 256, (300, 400, 3), np.uint8),
        "grey": canvas(300, 400),
        "one pixel": canvas(1, 1),
    }[kind]
    result = find_landmarks(image, models, 512, ROTATIONS, 4)
    assert isinstance(result, NoFace)
    assert "no face" in result.reason or "no consistent landmarks" in result.reason


def test_a_face_without_eyes_and_nose_is_no_face(models):
    covered = portrait().copy()
    covered[150:300, 180:350] = covered[20:30, 20:30].mean((0, 1))
    result = find_landmarks(covered, models, 512, (0.0, 180.0), 4)
    assert isinstance(result, NoFace)
    assert "no consistent landmarks" in result.reason


def test_a_single_crop_still_states_a_standard_deviation(upright, models):
    result = found(portrait(), models, jitters=1)
    assert (result.sigma > 0).all()
    assert distance(result.pixels, upright.pixels) < 0.02


@pytest.fixture
def capture(tmp_path):
    """Photographs in files: plain, in 16 bits, as linear light, to be rotated by EXIF, broken, and empty."""
    image = portrait()
    linear = (image / 255.0) ** 2.2
    write_png(tmp_path / "plain.png", image)
    write_png(tmp_path / "deep.png", image.astype(np.uint16) * 257)
    write_exr(
        tmp_path / "linear.exr", dict(zip("RGB", linear.astype(np.float32).transpose(2, 0, 1), strict=True))
    )
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(image).save(tmp_path / "rotated.jpg", exif=exif)
    (tmp_path / "broken.png").write_bytes((tmp_path / "plain.png").read_bytes()[:5000])
    write_png(tmp_path / "empty.png", canvas(200, 200))
    return {("someone", path.stem): path for path in sorted(tmp_path.iterdir())}


def test_a_capture_in_processes_is_that_in_one(capture, capfd):
    options = DetectionOptions(jitters=2, jobs=1)
    seen = []
    alone = detect_views(capture, options, lambda view, _: seen.append(view))
    assert list(alone) == list(capture)
    assert sorted(seen) == sorted(capture)
    assert alone["someone", "broken"].reason.startswith("pixels: ")
    assert alone["someone", "rotated"].reason.startswith("EXIF orientation: ")
    assert "no face" in alone["someone", "empty"].reason
    plain = alone["someone", "plain"].pixels
    assert distance(alone["someone", "deep"].pixels, plain) < 1e-3
    assert distance(alone["someone", "linear"].pixels, plain) < 0.02

    together = detect_views(capture, DetectionOptions(jitters=2, jobs=2))
    for view, result in alone.items():
        if isinstance(result, ViewLandmarks):
            np.testing.assert_array_equal(together[view].pixels, result.pixels)
            np.testing.assert_array_equal(together[view].sigma, result.sigma)
        else:
            assert together[view] == result
    said = capfd.readouterr().err
    assert "feedback_manager" not in said
    assert "XNNPACK" not in said


def test_a_landmark_model_that_is_none_is_named(tmp_path):
    missing, wrong = tmp_path / "missing.task", tmp_path / "wrong.task"
    wrong.write_bytes(b"no bundle")
    with pytest.raises(FaceModelError, match=r"missing\.task: file: "):
        FaceModels(missing)
    with pytest.raises(FaceModelError, match=r"wrong\.task: landmark model: is no face landmark model"):
        detect_views({("someone", "front"): tmp_path / "image.png"}, DetectionOptions(landmark_model=wrong))


def test_a_landmark_model_that_fails_on_an_image_is_named(tmp_path):
    shipped = Path(mediapipe.__file__).parent / "modules"
    bundle = tmp_path / "old.task"
    with zipfile.ZipFile(bundle, "w") as file:  # stored, as MediaPipe wants it
        file.write(shipped / "face_detection/face_detection_short_range.tflite", "face_detector.tflite")
        attention = shipped / "face_landmark/face_landmark_with_attention.tflite"
        file.write(attention, "face_landmarks_detector.tflite")  # has other outputs than a .task's model
    with pytest.raises(FaceModelError, match=r"old\.task: landmark model: fails .* Download"):
        find_landmarks(portrait(), FaceModels(bundle), 512, ROTATIONS, 2)


def test_impossible_options_are_refused():
    with pytest.raises(ValueError, match="jitters 1"):
        DetectionOptions(jitters=0)
